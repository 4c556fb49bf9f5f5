"""Demonstration of all commands: record a virtual campaign, calibrate, reconstruct, evaluate, report."""

import json
import shlex
import subprocess
import sys
import time
from concurrent.futures import ThreadPoolExecutor
from itertools import groupby
from pathlib import Path

STAGES = ("render", "calibrate", "reconstruct", "evaluate", "report")
AT_ONCE = 2
"""Commands of one stage run at a time: none but the rendering keeps all processors busy."""
CAMPAIGN = "demo"
PLACEMENTS = ("near", "standoff", "far")
SPHERES = tuple(f"spheres-{place}" for place in PLACEMENTS)
OTHERS = ("step-scan", "pipe")


def commands(out: Path) -> list[tuple[str, str]]:
    """Stage and command line of everything the demo does into a folder, in order."""
    folder = shlex.quote(str(out))
    rows = [("render", f"twin record {CAMPAIGN} --out {folder} --overwrite")]
    steps = f"--step {' '.join(f'{folder}/step-{place}-water.h5' for place in PLACEMENTS)}"
    bare, window, water = (f"{folder}/target-{kind}.h5" for kind in ("bare", "air", "water"))
    for evidence, suffix, scans in (
        (f"--air {bare} {window} --water {water} {steps}", "", (*SPHERES, *OTHERS)),
        (f"--air {bare} {steps} --refractions 2", "-two-refractions", SPHERES),
        (f"--air {window} {steps} --refractions 1", "-one-refraction", SPHERES),
    ):
        calibration = f"{folder}/calibration{suffix}.json"
        rows.append(("calibrate", f"uwlts calibrate {evidence} --out {calibration} --overwrite"))
        for scan in scans:
            capture, cloud = f"{folder}/{scan}", f"{folder}/{scan}{suffix}"
            made = f"{capture}.h5 --calibration {calibration} --out {cloud}.ply --overwrite"
            rows.append(("reconstruct", f"uwlts reconstruct {made}"))
            judged = f"--out {cloud}.evaluation.json --coloured {cloud}-coloured.ply --overwrite"
            rows.append(("evaluate", f"uwlts evaluate {cloud}.ply --truth {capture}.truth.h5 {judged}"))
    rows.append(("report", f"uwlts report {folder} --reference thesis --overwrite"))
    return rows


def demo(out: str | Path = "runs/demo") -> Path:
    """Do the main job in a row of commands: record a virtual campaign, calibrate, reconstruct, judge, report.

    The campaign has imperfections as a real one has, and is calibrated jointly and by the thesis's two ways. Runs
    exactly the commands that it prints, two at a time; each could be typed by hand. The report is OUT/report.html,
    whose path is returned.

    Parameters
    ----------
    out
        Folder for all results.

    Raises
    ------
    subprocess.CalledProcessError
        A command failed; what it printed says why.
    """
    folder = Path(out)
    folder.mkdir(parents=True, exist_ok=True)
    seconds: dict[str, float] = {}
    begun = time.perf_counter()
    in_order = sorted(commands(folder), key=lambda row: STAGES.index(row[0]))
    for stage, rows in groupby(in_order, key=lambda row: row[0]):
        if stage == "report":
            (folder / "seconds.json").write_text(json.dumps(seconds, indent=2) + "\n", encoding="utf-8")
        start = time.perf_counter()
        lines = [line for _, line in rows]
        # Commands of one stage need nothing of each other.
        with ThreadPoolExecutor(AT_ONCE) as pool:
            codes = list(pool.map(_run, lines))
        for line, code in zip(lines, codes, strict=True):
            if code:
                raise subprocess.CalledProcessError(code, line)
        seconds[stage] = round(time.perf_counter() - start, 2)
    total = ", ".join(f"{stage} {value:.1f} s" for stage, value in seconds.items())
    report = folder / "report.html"
    print(f"done in {time.perf_counter() - begun:.1f} s ({total}); open {report}")
    return report


def _run(line: str) -> int:
    """Run a command and print what it says once it has ended; its exit code."""
    sys.stdout.write(f"$ {line}\n")  # at once: print would write the line's end on its own, among other lines
    sys.stdout.flush()
    program, *arguments = shlex.split(line)
    done = subprocess.run(
        [sys.executable, "-m", f"{program}.cli", *arguments], check=False, capture_output=True, text=True
    )
    print(done.stdout, end="", flush=True)
    print(done.stderr, end="", file=sys.stderr, flush=True)
    return done.returncode
