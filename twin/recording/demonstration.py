"""Demonstration of all commands: record a virtual campaign, calibrate, reconstruct, evaluate, report."""

import json
import shlex
import time
from itertools import groupby
from pathlib import Path

from twin.recording.command_lines import AT_ONCE, run_lines
from uwlts.runtime.workers import open_workers

STAGES = ("render", "calibrate", "reconstruct", "evaluate", "report")
CAMPAIGN = "demo"
PLACEMENTS = ("near", "standoff", "far")
SPHERES = tuple(f"spheres-{place}" for place in PLACEMENTS)
OTHERS = ("step-scan", "pipe")


def commands(out: Path) -> list[tuple[str, str]]:
    """Return stage and command line of all steps of the demonstration, in order."""
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
            made = f"{capture}.h5 --calibration {calibration} --out {cloud}.cloud.h5 --overwrite"
            rows.append(("reconstruct", f"uwlts reconstruct {made}"))
            judged = f"--out {cloud}.evaluation.json --coloured {cloud}-coloured.ply --overwrite"
            rows.append(("evaluate", f"uwlts evaluate {cloud}.cloud.h5 --truth {capture}.truth.h5 {judged}"))
    rows.append(("report", f"uwlts report {folder} --published thesis --workers {AT_ONCE} --overwrite"))
    return rows


def demo(out: str | Path = "runs/demo") -> Path:
    """Demonstrate the whole process: record a virtual campaign, calibrate, reconstruct, evaluate, report.

    The campaign has realistic imperfections. It is calibrated jointly and by both methods of the thesis. The commands
    are printed and run two at a time; each can also be typed by hand. The path of the report, OUT/report.html, is
    returned.

    Parameters
    ----------
    out
        Folder for all results.

    Returns
    -------
    pathlib.Path
        The report, ``OUT/report.html``.

    Raises
    ------
    CommandFailed
        A command failed; its output gives the reason.
    SetupError
        A worker process ended unexpectedly.
    """
    folder = Path(out)
    folder.mkdir(parents=True, exist_ok=True)
    seconds: dict[str, float] = {}
    begun = time.perf_counter()
    in_order = sorted(commands(folder), key=lambda row: STAGES.index(row[0]))
    with open_workers(workers=AT_ONCE) as workers:
        for stage, rows in groupby(in_order, key=lambda row: row[0]):
            if stage == "report":
                (folder / "seconds.json").write_text(json.dumps(seconds, indent=2) + "\n", encoding="utf-8")
            start = time.perf_counter()
            # Commands of one stage are independent.
            run_lines(workers, [line for _, line in rows])
            seconds[stage] = round(time.perf_counter() - start, 2)
    total = ", ".join(f"{stage} {value:.1f} s" for stage, value in seconds.items())
    report = folder / "report.html"
    print(f"done in {time.perf_counter() - begun:.1f} s ({total}); open {report}")
    return report
