"""Reproduction of the thesis's evaluation: campaigns are recorded, then evaluated by the sensor's software.

The comparison of calibrations is an experiment on scans that no calibration has used. The thesis's two methods use the
target in air, without or with the camera's window, and the steps. The joint calibration uses these, then also the
target in water, then also half of the scans of spheres in water, which were recorded in other water; their sizes are
not used. The errors are those of the other half, and of all scans in air.
"""

from pathlib import Path

from twin.experiments.experiment import run_experiment
from twin.experiments.result import PAGE
from twin.experiments.runner import Method, run_program
from twin.recording.campaigns import RecordingOptions, record_campaigns, require_at_least
from twin.rendering_options import CPU, Variant
from twin.scene.campaign import load_campaign
from uwlts.errors import DescriptionError
from uwlts.runtime.progress import ProgressListener, ignore_progress

_LEAST_TRIALS = 20
"""Smallest number of trials in `uwlts thesis`, checked before anything is rendered."""
_PLACES = "near", "standoff", "far"
_STEPS = tuple(f"step-{place}-water" for place in _PLACES)
_IN_AIR = tuple(f"spheres-{place}{again}-air" for place in _PLACES for again in ("", "-2"))
_HELD_OUT = (*(f"spheres-{place}-2-water" for place in _PLACES), *_IN_AIR)
_BOTH = ("target-bare", "target-air")
_IN_WATER = {"air": _BOTH, "water": ("target-water",), "step": _STEPS}
METHODS = (
    Method("one refraction", {"air": ("target-air",), "step": _STEPS}, _HELD_OUT, "--refractions 1", "-one-refraction"),
    Method(
        "two refractions",
        {"air": ("target-bare",), "step": _STEPS},
        [scan for scan in _HELD_OUT if scan not in _IN_AIR],
        "--refractions 2",
        "-two-refractions",
    ),
    Method("joint, same evidence", {"air": _BOTH, "step": _STEPS}, _HELD_OUT, "--joint", "-joint-same-evidence"),
    Method("joint, with the target in water", _IN_WATER, _HELD_OUT, "--joint", "-joint-with-target-in-water"),
    Method(
        "joint, with scans too",
        _IN_WATER | {"scan": [f"spheres-{place}-water" for place in _PLACES]},
        (*_HELD_OUT, "plane-standoff-water", "plane-standoff-air"),
        "--joint --new-water --unknown-sizes",
        "-joint-with-scans",
    ),
)
"""Calibrations of the comparison: the thesis's two methods, and the joint one by its evidence."""


def reproduce(
    campaign: str | Path | None = None,
    *,
    joint: bool = False,
    out: str | Path | None = None,
    campaigns: int = 2,
    first: int = 0,
    every: int = 1,
    spp: int = 16,
    trials: int = 100,
    workers: int | None = None,
    overwrite: bool = False,
    variant: Variant = CPU,
    progress: ProgressListener = ignore_progress,
) -> Path:
    """Render the campaigns of the thesis, evaluate them by all its methods, and compare the results with its tables.

    Every campaign has its own imperfections and noise. An interrupted run is resumed, and campaigns are added if
    the number is increased. The path of the report, OUT/report.html, is returned.

    Parameters
    ----------
    campaign
        Name or path of the campaign's description; default: "thesis", or "joint" with ``joint``.
    joint
        Compare the joint calibration with both methods of the thesis on the same images, as an `experiment`; writes
        OUT/experiment.html and experiment.json.
    out
        Folder for campaigns and report (default: runs/CAMPAIGN). Complete recordings in it are kept.
    trials
        Trials of the Monte Carlo propagation of every campaign: at least 20, or 0 to skip it.
    overwrite
        Render and evaluate everything again.
    campaigns, first, every, workers
        As for `predict`.
    spp, variant
        As for `simulate`.
    progress
        Called with the number of images rendered, the total number, and the name of the stage.

    Returns
    -------
    pathlib.Path
        The report, ``OUT/report.html``, or ``OUT/experiment.html`` with ``joint``.

    Raises
    ------
    DescriptionError, DesignError, OutputError, SetupError
        As `record_campaigns`, or an argument is out of its range.
    CommandFailed
        The evaluation failed; its output gives the reason.
    """
    options = RecordingOptions(every, spp, variant, workers, overwrite=overwrite)
    require_at_least(1, campaigns=campaigns)
    require_at_least(0, first=first)
    if trials != 0 and trials < _LEAST_TRIALS:
        raise DescriptionError(
            f"trials is {trials}; expected at least {_LEAST_TRIALS}, or 0 for no Monte-Carlo propagation"
        )
    campaign = campaign or ("joint" if joint else "thesis")
    folder = Path(out or Path("runs") / Path(campaign).stem)
    described = load_campaign(campaign)
    seeds = range(first, first + campaigns)
    if joint:
        how = {"name": str(campaign), "methods": METHODS, "with_truth": True, "progress": progress}
        print("\n".join(run_experiment(described, folder, seeds, options, **how).lines()))
        return folder / PAGE
    record_campaigns(described, folder, seeds=seeds, options=options, progress=progress)
    # The sensor's software runs as a separate program, which shares no mathematics with the twin.
    command = ["uwlts", "thesis", str(folder), "--trials", str(trials), "--overwrite"]
    command += ["--again"] if overwrite else []
    command += ["--workers", str(workers)] if workers else []
    run_program(*command)
    return folder / "report.html"
