"""Continuous scan of spheres by the served twin through its real protocols, compared with a scan that stops.

The twin runs in its own process. Its free-running camera exposes frames in real time and renders them afterwards.
Therefore time stamps, the stage's reports and their latency are those of the protocols. Spheres are compared with their
certificate and with a scan that stops. The time stamps of the camera are shifted by a known latency, which is compared
with the measured one.

    python docs/studies/continuous_scan.py
"""

import re
import subprocess
import sys
import tempfile
from pathlib import Path
from typing import Annotated

import numpy as np
from cyclopts import App, Parameter

import uwlts
from uwlts.hardware import continuous as recorder

SPEEDS_MM_S = 20.0, 50.0, 100.0
STEP_MM = 1.0
SHIFTS_S = 0.0, 0.010
SPHERES = "diameters_mm = [50.12, 50.14]\nspacings_mm = [99.18]\n"
ROOT = Path(__file__).resolve().parents[2]
SENSOR = """
base = "thesis"
[exposure]
laser_ms = 2.0
[stage]
speed_mm_per_s = 120.0
acceleration_mm_per_s2 = 1000.0
settling_s = 0.05
"""


def spheres(cloud, stops: np.ndarray | None = None) -> tuple[str, np.ndarray]:
    """Return the figures of a cloud of spheres as text, with shifts along X from ``stops``, and its centres (2, 3)."""
    result = uwlts.evaluate(cloud)
    centres = np.array([sphere["centre_mm"] for sphere in result.evaluation.spheres])
    text = f"spacing {1e3 * result.sphere_spacing.value_mm:+6.1f} um, std {1e3 * result.std.value_mm:5.1f} um"
    if stops is not None:
        text += f", centres {1e3 * float((centres - stops)[:, 0].mean()):+6.1f} um along the stage"
    return f"{text}, {len(cloud)} points", centres


def main(*options: Annotated[str, Parameter(allow_leading_hyphen=True)]) -> None:
    """Scan with options of `twin serve`, and print a line for each."""
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        (folder / "fast.toml").write_text(SENSOR)
        command = [sys.executable, "-m", "twin", "serve", "spheres", "--sensor", str(folder / "fast.toml")]
        command += ["--water", "clear", *options]
        served = subprocess.Popen(command, cwd=ROOT, stdout=subprocess.PIPE, text=True)
        try:
            said = ""
            assert served.stdout is not None
            for line in served.stdout:
                said += line
                if line.startswith("serving"):
                    break
            else:
                # It has said what is wrong.
                sys.exit(served.wait())
            port = re.search(r"stage: +(\S+)", said)[1]
            camera = re.search(r"camera: +(\S+)", said)[1]
            start, end = map(float, re.search(r"positions, (\S+) to (\S+) mm", said).groups())
            exposure = float(re.search(r"laser (\S+) ms", said)[1])
            calibration = uwlts.nominal(str(folder / "fast.toml"), medium="water")

            def plan(**more: object) -> Path:
                top = "\n".join(f"{key} = {value}" for key, value in more.items() if "." not in key)
                path = folder / "plan.toml"
                count = int((end - start) / STEP_MM) + 1
                path.write_text(
                    f'title = "spheres"\nsensor = "{folder / "fast.toml"}"\nmedium = "water"\ncamera = "{camera}"\n'
                    f"laser_ms = {exposure}\ncheck_steps = false\n{top}\n"
                    f'[stage]\nport = "{port}"\nstart_mm = {start}\nstep_mm = {STEP_MM}\ncount = {count}\n'
                    "feed_mm_per_min = 6000\n"
                    '[artefact]\nkind = "spheres"\n' + SPHERES
                )
                return path

            uwlts.scan(plan(), folder / "stops.h5", home=True)
            text, stops = spheres(uwlts.reconstruct(folder / "stops.h5", calibration))
            print(f"stop and go:      {text}", flush=True)
            usual = recorder._compare_clocks
            for speed in SPEEDS_MM_S:
                for shift in SHIFTS_S:
                    recorder._compare_clocks = lambda *about, by=shift: ((found := usual(*about))[0] + by, found[1])
                    said_by: list[str] = []
                    moving = f"{{ speed_mm_per_s = {speed} }}"
                    uwlts.scan(
                        plan(continuous=moving), folder / "moving.h5", report=said_by.append, home=True, overwrite=True
                    )
                    print(f"{speed:5.0f} mm/s, {1e3 * shift:+.0f} ms:", said_by[-1], flush=True)
                    print(f"    {spheres(uwlts.reconstruct(folder / 'moving.h5', calibration), stops)[0]}", flush=True)
        finally:
            served.terminate()
            served.communicate()


if __name__ == "__main__":
    App(help=__doc__, help_format="plaintext", default_command=main)()
