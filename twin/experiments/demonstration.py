"""Demonstration of all commands: record a virtual campaign, calibrate, reconstruct, evaluate, report."""

import json
import shlex
import time
from pathlib import Path

from twin.experiments.runner import AT_ONCE, CommandLine, Method, plan_lines, run_stages
from twin.scene.campaign import list_takes, load_campaign

CAMPAIGN = "demo"
_STEPS = ("step-near-water", "step-standoff-water", "step-far-water")
_SPHERES = ("spheres-near", "spheres-standoff", "spheres-far")
METHODS = (
    Method(
        "joint",
        {"air": ("target-bare", "target-air"), "water": ("target-water",), "step": _STEPS},
        (*_SPHERES, "step-scan", "pipe"),
    ),
    Method(
        "two refractions",
        {"air": ("target-bare",), "step": _STEPS},
        _SPHERES,
        options="--refractions 2",
        suffix="-two-refractions",
    ),
    Method(
        "one refraction",
        {"air": ("target-air",), "step": _STEPS},
        _SPHERES,
        options="--refractions 1",
        suffix="-one-refraction",
    ),
)
"""The joint calibration, and both methods of the thesis."""


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
    begun = time.perf_counter()
    name = shlex.quote(str(folder))
    takes = {take.name: take for take in list_takes(load_campaign(CAMPAIGN), seed=0)}
    made = folder / "report.html"
    record = CommandLine("render", f"twin record {CAMPAIGN} --out {name} --overwrite", (), None)
    seconds = run_stages([record, *plan_lines(folder, takes, METHODS, with_truth=True, coloured=True)], quiet=False)
    (folder / "seconds.json").write_text(json.dumps(seconds, indent=2) + "\n", encoding="utf-8")
    report = f"uwlts report {name} --published thesis --workers {AT_ONCE} --overwrite"
    seconds |= run_stages([CommandLine("report", report, (), None)], quiet=False)
    total = ", ".join(f"{stage} {value:.1f} s" for stage, value in seconds.items())
    print(f"done in {time.perf_counter() - begun:.1f} s ({total}); open {made}")
    return made
