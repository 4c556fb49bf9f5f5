"""Demonstration: an experiment that compares the joint calibration with both methods of the thesis."""

from pathlib import Path

from twin.experiments.experiment import run_experiment
from twin.experiments.result import PAGE
from twin.experiments.runner import Method
from twin.recording.campaigns import RecordingOptions
from twin.scene.campaign import load_campaign
from uwlts.runtime.progress import ProgressListener, ignore_progress

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


def demo(out: str | Path = "runs/demo", *, progress: ProgressListener = ignore_progress) -> Path:
    """Demonstrate the whole process as an experiment: render a campaign, calibrate, reconstruct, evaluate, compare.

    The campaign has realistic imperfections. It is calibrated jointly and by both methods of the thesis. The commands
    that calibrate and measure are in OUT/commands.sh; each can also be typed by hand. An interrupted demonstration is
    resumed. The path of the page, OUT/experiment.html, is returned.

    Parameters
    ----------
    out
        Folder for all results.
    progress
        As for `predict`.

    Returns
    -------
    pathlib.Path
        The page, ``OUT/experiment.html``.

    Raises
    ------
    CommandFailed
        A command failed; its output gives the reason.
    DescriptionError, OutputError, SetupError
        As for `experiment`.
    """
    how = {"name": "demo", "methods": METHODS, "with_truth": True, "progress": progress}
    result = run_experiment(load_campaign("demo"), Path(out), [0], RecordingOptions(), **how)
    print("\n".join(result.lines()))
    return Path(out) / PAGE
