"""Records whole campaigns: every recording of each seed, several at a time, going on where an earlier run stopped."""

import json
import subprocess
import sys
from collections.abc import Callable
from contextlib import nullcontext
from dataclasses import dataclass
from itertools import count
from pathlib import Path

from twin.options import CPU, Options, Variant, use_variant
from twin.scene.campaign import Campaign, Take, load_campaign, takes
from uwlts.model.errors import DescriptionError, Error, OutputError
from uwlts.runtime.console import progress_bar
from uwlts.runtime.workers import work_through
from uwlts.storage.capture import part_path
from uwlts.storage.files import written_aside
from uwlts.storage.truth import truth_path

PLAN = "plan.json"
_LEAST_TRIALS = 20
"""As `uwlts thesis` demands, to refuse fewer before anything is rendered."""


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
    show_progress: bool = False,
) -> Path:
    """Render the thesis's whole evaluation, evaluate it by all its methods, and set its tables beside the results.

    Every campaign has imperfections and noise of its own. Run again, it goes on where it was stopped, and adds
    campaigns if more are asked for. The report is OUT/report.html, whose path is returned.

    Parameters
    ----------
    campaign
        Name or path of the campaign's description; "thesis" unless given, or "joint" with ``joint``.
    joint
        Compare the joint calibration with the thesis's two ways on the same images; writes OUT/report.html and
        summary.json.
    out
        Folder for campaigns and report; runs/CAMPAIGN unless given. What is complete in it is not rendered again.
    campaigns
        Number of campaigns.
    first
        Seed of the first campaign; the others follow.
    every
        Take only every n-th profile of the scans; calibrations keep all their images.
    trials
        Trials of the Monte-Carlo propagation of every campaign, at least 20, or 0 for none.
    workers
        Recordings rendered at a time; as many as there are processors unless given.
    overwrite
        Render and evaluate everything anew.
    spp, variant
        As for `simulate`.
    show_progress
        Draw progress bars on the terminal.

    Raises
    ------
    DescriptionError, DesignError, OutputError, SetupError
        As `record_campaigns`, or an argument is out of its range.
    subprocess.CalledProcessError
        The evaluation failed; it has printed why.
    """
    for name, value in (("campaigns", campaigns), ("every", every), ("workers", 1 if workers is None else workers)):
        if value < 1:
            raise DescriptionError(f"{name} is {value}; it must be at least 1")
    if first < 0:
        raise DescriptionError(f"first is {first}; a seed must not be negative")
    if trials != 0 and trials < _LEAST_TRIALS:
        raise DescriptionError(f"trials is {trials}: take {_LEAST_TRIALS} or more, or 0 for no Monte-Carlo propagation")
    campaign = campaign or ("joint" if joint else "thesis")
    folder = Path(out or Path("runs") / Path(campaign).stem)
    described = load_campaign(campaign)
    bar = progress_bar(f"rendering {described.title}") if show_progress else nullcontext(lambda done, total: None)
    with bar as progress:
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
    # The sensor's software is a program of its own, which shares no mathematics with the twin.
    command = [sys.executable, "-m", "uwlts.cli", "thesis", str(folder), "--trials", str(trials), "--overwrite"]
    command += ["--joint"] if joint else []
    command += ["--again"] if overwrite else []
    command += ["--workers", str(workers)] if workers else []
    subprocess.run(command, check=True)
    return folder / "report.html"


@dataclass(frozen=True)
class _Job:
    """A take to render into a file, with its number of images and its files: capture, truth, unfinished capture."""

    take: Take
    path: Path
    options: Options
    variant: str

    @property
    def images(self) -> int:
        return self.take.scene.motion.count * len(self.take.scene.motion.lights)

    @property
    def files(self) -> tuple[Path, Path, Path]:
        return self.path, truth_path(self.path), part_path(self.path)


def record_campaigns(
    campaign: Campaign,
    folder: Path,
    *,
    seeds: range,
    every: int = 1,
    spp: int = 16,
    variant: str = CPU,
    workers: int | None = None,
    overwrite: bool = False,
    progress: Callable[[int, int], None] = lambda done, total: None,
) -> list[Path]:
    """Render all recordings of a campaign for each seed into ``folder/campaign-SEED``; returns these folders.

    Complete recordings stay as they are and interrupted ones are gone on with; ``overwrite`` removes those of the
    seeds and renders all anew. ``progress(done, total)`` counts images. DescriptionError where the folder holds a
    campaign that was rendered differently, or a description is wrong; DesignError where the sensor cannot measure a
    scene; OutputError where a file cannot be written; SetupError where a process that renders was ended from outside.
    """
    folders = [folder / f"campaign-{seed}" for seed in seeds]
    jobs = [
        _Job(take, place / f"{take.name}.h5", Options(spp=spp, seed=take.seed), variant)
        for seed, place in zip(seeds, folders, strict=True)
        for take in takes(campaign, seed=seed, every=every)
    ]
    plan = {"campaign": campaign.model_dump(mode="json"), "every": every, "spp": spp, "variant": variant}
    _keep_to_plan(folder, plan, {file for job in jobs for file in job.files}, overwrite=overwrite)
    for place in folders:
        place.mkdir(exist_ok=True)
    if overwrite:
        # All at once and not one by one: what an interrupted run leaves must not be taken for its own.
        for path in (path for job in jobs for path in job.files):
            path.unlink(missing_ok=True)
    # The longest first, so that no process is left alone with a long one at the end.
    waiting = [job for job in jobs if [path.is_file() for path in job.files] != [True, True, False]]
    waiting.sort(key=lambda job: job.images, reverse=True)
    total = sum(job.images for job in jobs)
    counted = count(total - sum(job.images for job in waiting))
    progress(next(counted), total)
    work_through(_record, waiting, workers=workers, on_message=lambda _: progress(next(counted), total))
    return folders


def _keep_to_plan(folder: Path, plan: dict[str, object], files: set[Path], *, overwrite: bool) -> None:
    """Write the settings of a folder's campaigns, or check that they are the same as before; ``files`` are theirs."""
    path = folder / PLAN
    text = json.dumps(plan, indent=2) + "\n"
    plan = json.loads(text)
    try:
        folder.mkdir(parents=True, exist_ok=True)
        recorded = set(folder.glob("campaign-*/*.h5*"))
        content = path.read_bytes() if path.is_file() else b"null"
    except OSError as error:
        raise OutputError(f"cannot use the folder {folder}: {error.strerror}") from error
    try:
        known = json.loads(content)
    except ValueError:
        known = None
    if known == plan:
        return
    how = f"that {PLAN} does not describe"
    if isinstance(known, dict):
        how = f"made with another {', '.join(key for key in plan if known.get(key) != plan[key])}"
    if recorded and not overwrite:
        raise DescriptionError(
            f"{folder} holds recordings {how}: give another folder, the same settings, or --overwrite to start afresh"
        )
    if kept := recorded - files:
        raise DescriptionError(
            f"{folder} would keep recordings {how}, such as {min(kept)}: give another folder, or remove them first"
        )
    with written_aside(path, overwrite=True) as aside:
        aside.write_text(text, encoding="utf-8")


def _record(job: _Job, report: Callable[[None], None]) -> None:
    """Render a take; calls ``report`` after every image."""
    use_variant(job.variant)
    import drjit as dr

    from twin.recording.studio import record_scene

    dr.set_thread_count(1)
    take = job.take
    try:
        record_scene(
            take.scene,
            take.sensor,
            job.path,
            as_built=take.built,
            options=job.options,
            overwrite=True,
            # What is there of an incomplete recording is a part to go on with, or lacks its truth.
            resume=part_path(job.path).exists(),
            progress=lambda images, total: report(None),
        )
    except Error as error:
        raise type(error)(f"{job.path}: {error}") from error
