"""Reproduction of the thesis's evaluation: campaigns are recorded, then evaluated by the sensor's software."""

import subprocess
import sys
from pathlib import Path

from twin.recording.campaigns import record_campaigns, require_at_least
from twin.rendering_options import CPU, Variant
from twin.scene.campaign import load_campaign
from uwlts.errors import CommandFailed, DescriptionError
from uwlts.runtime.progress import ProgressListener, ignore_progress

_LEAST_TRIALS = 20
"""Smallest number of trials in `uwlts thesis`, checked before anything is rendered."""


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
        Compare the joint calibration with both methods of the thesis on the same images; writes OUT/report.html and
        summary.json.
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
        The report, ``OUT/report.html``.

    Raises
    ------
    DescriptionError, DesignError, OutputError, SetupError
        As `record_campaigns`, or an argument is out of its range.
    CommandFailed
        The evaluation failed; its output gives the reason.
    """
    require_at_least(1, campaigns=campaigns, every=every, workers=workers)
    if first < 0:
        raise DescriptionError(f"first is {first}; a seed must not be negative")
    if trials != 0 and trials < _LEAST_TRIALS:
        raise DescriptionError(
            f"trials is {trials}; expected at least {_LEAST_TRIALS}, or 0 for no Monte-Carlo propagation"
        )
    campaign = campaign or ("joint" if joint else "thesis")
    folder = Path(out or Path("runs") / Path(campaign).stem)
    described = load_campaign(campaign)
    record_campaigns(
        described,
        folder,
        seeds=range(first, first + campaigns),
        every=every,
        spp=spp,
        variant=variant,
        workers=workers,
        overwrite=overwrite,
        progress=progress,
    )
    # The sensor's software runs as a separate program, which shares no mathematics with the twin.
    command = [sys.executable, "-m", "uwlts", "thesis", str(folder), "--trials", str(trials), "--overwrite"]
    command += ["--joint"] if joint else []
    command += ["--again"] if overwrite else []
    command += ["--workers", str(workers)] if workers else []
    if code := subprocess.run(command, check=False).returncode:
        raise CommandFailed("uwlts thesis", code)
    return folder / "report.html"
