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
from collections.abc import Callable
from functools import partial
from pathlib import Path

import numpy as np
from cyclopts import App
from result_tables import publish, table

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


def spheres(cloud, stops: np.ndarray | None = None) -> tuple[list[str], np.ndarray]:
    """Return spacing error and shift along the stage from ``stops``, µm, as cells, and the centres (2, 3)."""
    result = uwlts.evaluate(cloud)
    centres = np.array([sphere["centre_mm"] for sphere in result.evaluation.spheres])
    shift = "-" if stops is None else f"{1e3 * float((centres - stops)[:, 0].mean()):+.1f}"
    return [f"{1e3 * result.sphere_spacing.value_mm:.1f}", shift], centres


def later(
    compare: Callable[..., tuple[float, int | None]], by_s: float, *about: object, **settings: object
) -> tuple[float, int | None]:
    """Return the comparison of clocks with the camera's ``by_s`` later."""
    offset_s, encoder = compare(*about, **settings)
    return offset_s + by_s, encoder


def main(*, write: bool = False) -> None:
    """Scan and print the table; with `--write`, put it into its page."""
    rows = []
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        (folder / "fast.toml").write_text(SENSOR)
        command = [sys.executable, "-m", "twin", "serve", "spheres", "--sensor", str(folder / "fast.toml")]
        command += ["--water", "clear"]
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
            cells, stops = spheres(uwlts.reconstruct(folder / "stops.h5", calibration))
            rows.append(["stops", "-", "-", *cells])
            usual = recorder._compare_clocks
            for speed in SPEEDS_MM_S:
                for shift in SHIFTS_S:
                    recorder._compare_clocks = partial(later, usual, shift)
                    said_by: list[str] = []
                    moving = f"{{ speed_mm_per_s = {speed} }}"
                    uwlts.scan(
                        plan(continuous=moving), folder / "moving.h5", report=said_by.append, home=True, overwrite=True
                    )
                    latency = re.search(r"latency of the stage (\S+) ms", said_by[-1])[1]
                    cells, _ = spheres(uwlts.reconstruct(folder / "moving.h5", calibration), stops)
                    rows.append([f"{speed:.0f}", f"{1e3 * shift:.0f}", f"{float(latency):+.2f}", *cells])
                    print(*rows[-1], flush=True)
        finally:
            served.terminate()
            served.communicate()
    head = ["speed, mm/s", "added, ms", "latency measured, ms", "spacing error, µm"]
    publish({"continuous scans": table([*head, "centres along the stage, against the stops, µm"], rows)}, write=write)


if __name__ == "__main__":
    App(help=__doc__, help_format="plaintext", default_command=main)()
