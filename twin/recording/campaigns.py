"""Recording of campaigns: all recordings of a seed, several in parallel; interrupted runs are resumed."""

import json
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from itertools import count, islice
from pathlib import Path
from typing import Any

from pydantic import JsonValue

from twin.backend.llvm import preserve_threads
from twin.rendering_options import CPU, Flaws, Options, Variant, use_variant
from twin.scene.campaign import Campaign, Take, list_takes, load_campaign
from twin.scene.description import Scene
from uwlts.errors import CaptureError, DescriptionError, Error, OutputError, SetupError
from uwlts.files.json_files import describe_differences, read_json
from uwlts.files.writing import write_file
from uwlts.model.sensor import Sensor
from uwlts.runtime.progress import ProgressListener, ignore_progress
from uwlts.runtime.workers import open_workers, run_jobs
from uwlts.storage.capture import part_path
from uwlts.storage.truth import truth_path

PLAN = "plan.json"


@dataclass(frozen=True)
class RecordingOptions:
    """Options of campaigns' recordings, as those of `record`; DescriptionError if one is out of its range.

    ``scheduler`` is the address of a Dask scheduler whose workers render, instead of processes on this machine.
    """

    every: int = 1
    spp: int = 16
    variant: str = CPU
    workers: int | None = None
    scheduler: str | None = None
    overwrite: bool = False

    def __post_init__(self) -> None:
        require_at_least(1, every=self.every, workers=self.workers)


def record(
    campaign: str | Path,
    *,
    out: str | Path,
    seed: int = 0,
    every: int = 1,
    spp: int = 16,
    effects: Sequence[str] = (),
    workers: int | None = None,
    overwrite: bool = False,
    variant: Variant = CPU,
    progress: ProgressListener = ignore_progress,
) -> Path:
    """Render all recordings of a campaign into a folder, with imperfections drawn from a seed.

    An interrupted run is resumed. The folder is returned.

    Parameters
    ----------
    campaign
        Name (see: twin scenes) or path of the campaign's description.
    out
        Folder for the captures and their ground truth. Complete recordings in it are kept.
    seed
        Seed of imperfections and noise.
    every
        Take only every n-th profile of the scans; calibrations keep all images.
    workers
        Number of parallel recordings (default: number of processors).
    overwrite
        Render everything again.
    spp, effects, variant
        As for `simulate`.
    progress
        Called with the number of images done, the total number, and the name of the stage.

    Returns
    -------
    pathlib.Path
        The folder of the campaign.

    Raises
    ------
    DescriptionError, DesignError, OutputError, SetupError
        As `record_campaigns`, or an argument is out of its range.
    """
    options = RecordingOptions(every=every, spp=spp, variant=variant, workers=workers, overwrite=overwrite)
    require_at_least(0, seed=seed)
    described, folder = load_campaign(campaign), Path(out)
    flaws = Flaws.parse(*effects)
    jobs = _list_jobs(described, folder, options, seed=seed, flaws=flaws)
    plan = _plan(described, options) | {"seed": seed, "effects": flaws.names()}
    _record_all(jobs, folder, plan, options, recorded="*.h5*", progress=progress)
    return folder


def require_at_least(least: int, **values: int | None) -> None:
    """Raise DescriptionError for a value below the least one; None is the default of a function."""
    for name, value in values.items():
        if value is not None and value < least:
            raise DescriptionError(f"{name} is {value}; it must be at least {least}")


@dataclass(frozen=True)
class _Job:
    """A recording to render into a file. ``files`` are the capture, its truth, and the unfinished capture."""

    take: Take
    path: Path
    options: Options
    variant: str

    @property
    def images(self) -> int:
        return self.take.scene.motion.images()

    @property
    def files(self) -> tuple[Path, Path, Path]:
        return self.path, truth_path(self.path), part_path(self.path)


def record_campaigns(
    campaign: Campaign,
    folder: Path,
    *,
    seeds: Sequence[int],
    options: RecordingOptions,
    progress: ProgressListener = ignore_progress,
) -> list[Path]:
    """Render all recordings of a campaign for each seed into ``folder/campaign-SEED``; return these folders.

    Each seed draws its own sensor and noise. ``every`` takes only every n-th profile of the scans; calibrations keep
    all images. Complete recordings are kept and interrupted ones resumed, unless ``overwrite`` removes those of these
    seeds. ``progress(done, total)`` counts images; with a scheduler, those of whole recordings.

    Raises DescriptionError if the folder contains a campaign with other settings or a description is wrong; DesignError
    if the sensor cannot measure a scene; OutputError if a file cannot be written; SetupError if a rendering process was
    terminated from outside.
    """
    folders = [folder / f"campaign-{seed}" for seed in seeds]
    jobs = [
        job
        for seed, place in zip(seeds, folders, strict=True)
        for job in _list_jobs(campaign, place, options, seed=seed, flaws=Flaws())
    ]
    _record_all(jobs, folder, _plan(campaign, options), options, recorded="campaign-*/*.h5*", progress=progress)
    return folders


def _list_jobs(campaign: Campaign, place: Path, options: RecordingOptions, *, seed: int, flaws: Flaws) -> list[_Job]:
    return [
        _Job(take, place / f"{take.name}.h5", Options(spp=options.spp, seed=take.seed, flaws=flaws), options.variant)
        for take in list_takes(campaign, seed=seed, every=options.every)
    ]


def _plan(campaign: Campaign, options: RecordingOptions) -> dict[str, JsonValue]:
    described = campaign.model_dump(mode="json")
    return {"campaign": described, "every": options.every, "spp": options.spp, "variant": options.variant}


def _record_all(
    jobs: list[_Job],
    folder: Path,
    plan: dict[str, JsonValue],
    options: RecordingOptions,
    *,
    recorded: str,
    progress: ProgressListener,
) -> None:
    """Render incomplete recordings into a folder that follows a plan; ``recorded`` is the pattern of its captures."""
    make_folder(folder)
    files = {file for job in jobs for file in job.files}
    keep_to_plan(folder, plan, files, recorded=recorded, called="recordings", overwrite=options.overwrite)
    for place in {job.path.parent for job in jobs}:
        place.mkdir(exist_ok=True)
    if options.overwrite:
        # Remove all files first: after an interruption, old recordings must not pass for new ones.
        for path in (path for job in jobs for path in job.files):
            path.unlink(missing_ok=True)
    # The longest first, so that the processes finish at about the same time.
    waiting = [job for job in jobs if [path.is_file() for path in job.files] != [True, True, False]]
    waiting.sort(key=lambda job: job.images, reverse=True)
    total = sum(job.images for job in jobs)
    counted = count(total - sum(job.images for job in waiting))
    progress(next(counted), total)
    if options.scheduler is None:
        run_jobs(_record, waiting, workers=options.workers, on_message=lambda _: progress(next(counted), total))
        return
    with open_workers(scheduler=options.scheduler) as cluster:
        for job, lost in cluster.map_unordered(_record, waiting):
            if lost is not None:
                raise SetupError(f"{job.path}: {lost.reason}")
            for done in islice(counted, job.images):
                progress(done, total)


def make_folder(folder: Path) -> Path:
    """Create a folder if it does not exist, and return it; OutputError if that fails."""
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise OutputError(f"cannot use the folder {folder}: {error.strerror}") from error
    return folder


def keep_to_plan(
    folder: Path, plan: dict[str, JsonValue], files: set[Path], *, recorded: str, called: str, overwrite: bool
) -> None:
    """Write the settings ``plan`` of an existing folder's contents, or check that they are unchanged.

    ``files`` belong to the plan, and ``recorded`` is the glob pattern of such files, which messages call ``called``.
    Raises DescriptionError if the folder contains files of another plan, and ``overwrite`` does not replace all of
    them.
    """
    path = folder / PLAN
    text = json.dumps(plan, indent=2) + "\n"
    plan = json.loads(text)
    found = set(folder.glob(recorded))
    try:
        known = read_json(path, called="plan") if path.is_file() else None
    except CaptureError:
        known = None
    if known == plan:
        return
    how = f"that {PLAN} does not describe"
    if known is not None:
        other = ", ".join(key for key in plan if known.get(key) != plan[key])
        how = f"made with another {other} ({describe_differences(known, plan)})"
    if found and not overwrite:
        raise DescriptionError(
            f"{folder} holds {called} {how}: give another folder, the same settings, or `overwrite` to start again"
        )
    if kept := found - files:
        raise DescriptionError(
            f"{folder} would keep {called} {how}, such as {min(kept)}: give another folder, or remove them first"
        )
    write_file(path, text, overwrite=True)


def _record(job: _Job, report: Callable[[None], None] = lambda _: None) -> None:
    """Render a recording; call ``report`` after every image."""
    take = job.take
    how: dict[str, Any] = {"as_built": take.built, "options": job.options}
    # An incomplete recording either has a part to resume, or lacks its truth and is rendered again.
    how |= {"resume": part_path(job.path).exists(), "progress": lambda done, total, stage="": report(None)}
    try:
        record_on_one_thread(take.scene, take.sensor, job.path, job.variant, **how)
    except Error as error:
        raise type(error)(f"{job.path}: {error}") from error


def record_on_one_thread(scene: Scene, sensor: Sensor, path: Path, variant: str, **how: Any) -> None:
    """Record a scene as `record_scene` does, with one thread: several processes render at the same time."""
    use_variant(variant)
    import drjit as dr

    from twin.recording.record_scene import record_scene

    with preserve_threads():
        dr.set_thread_count(1)
        record_scene(scene, sensor, path, overwrite=True, **how)
