"""Generation of data sets: scenes drawn from a description, rendered with their labels, shard by shard.

A shard is written by one process and appears whole. Everything random in it depends on the seed and on the numbers of
its scenes, so that any number of processes write the same files, and a run that was interrupted goes on with the next
shard.
"""

from __future__ import annotations

import math
import re
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from importlib.metadata import version
from pathlib import Path
from typing import TYPE_CHECKING, Any

from pydantic import JsonValue

from twin.datasets.card import PAGE, README, write_card
from twin.datasets.data_set import SPLITS, DataSetDescription, Split, load_description
from twin.datasets.draws import DrawnScene, draw_scene, split_of
from twin.datasets.labels import labelled
from twin.datasets.loading import CARD
from twin.datasets.shards import SUFFIXES, Sample, written_shard
from twin.options import CPU, Variant, use_variant
from twin.recording.campaigns import PLAN, keep_to_plan, made_folder
from uwlts.errors import DescriptionError, DesignError
from uwlts.files.inputs import inputs_kept
from uwlts.files.writing import OtherWriterError, one_writer, refuse_other_writer
from uwlts.model.placement import camera_from_object
from uwlts.runtime.progress import ProgressListener, unheard
from uwlts.runtime.workers import work_through

if TYPE_CHECKING:
    from twin.recording.studio import Exposed, Studio
    from twin.scene.motion import Shot

MOST_ATTEMPTS = 20
"""A scene that the sensor cannot measure is drawn anew; where so many in a row are, the description is at fault."""
_PATIENCE_S = 30.0
"""Other runs hold the plan for a moment at their beginning."""
_OUTPUT = re.compile(
    rf"({'|'.join(SPLITS)})-\d{{6}}\.(tar|h5)|coco-({'|'.join(SPLITS)})\.json|{re.escape(CARD)}|{re.escape(README)}|{re.escape(PAGE)}|{re.escape(PLAN)}"
)
_UNFINISHED = re.compile(r"\.[0-9a-f]{16}\.(tar|h5|json|md|html)")


@inputs_kept()
def dataset(
    description: str | Path | DataSetDescription,
    *,
    out: str | Path,
    scenes: int | None = None,
    seed: int | None = None,
    workers: int | None = None,
    overwrite: bool = False,
    variant: Variant = CPU,
    progress: ProgressListener = unheard,
) -> Path:
    """Render a data set of images with labels, for training and testing, from a description of what varies and how.

    Run again, it goes on where it was interrupted; run at the same time, also on other machines that share the folder,
    each run takes shards that no other one is writing, and ends when all are there. The folder is returned;
    `load_dataset` reads it.

    Parameters
    ----------
    description
        Name (see: twin scenes) or path of the data set's description.
    out
        Folder for the data set: shards, dataset.json, README.md and dataset.html.
    scenes
        Number of scenes, in place of the description's.
    seed
        Number from which everything random is drawn, in place of the description's.
    workers
        Shards rendered at a time; as many as there are processors unless given. It does not change the frames.
    overwrite
        Remove the data set that the folder holds, and start afresh.
    variant
        As for `simulate`.
    progress
        Called with the number of frames done, the number in all, and the name of the stage.

    Raises
    ------
    DescriptionError
        The description is not valid, or the folder holds another data set.
    DesignError
        The sensor cannot measure the scenes that are drawn.
    OutputError
        A file cannot be written.
    SetupError
        Mitsuba cannot use the variant on this machine, or a process that renders was ended from outside.

    Examples
    --------
    >>> folder = twin.dataset("stripe-turbid", out="runs/turbid", scenes=200)
    >>> test = twin.load_dataset(folder, split="test")
    """
    if workers is not None and workers < 1:
        raise DescriptionError(f"workers is {workers}; it must be at least 1")
    described, folder = load_description(description, scenes=scenes, seed=seed), Path(out)
    draw_scene(described, 0)
    jobs = _jobs(described, folder, variant)
    plan = _plan(described, variant)
    made_folder(folder)
    with one_writer(folder / PLAN, patience_s=_PATIENCE_S):
        _prepare(folder, jobs, plan, overwrite=overwrite)
    waiting = [job for job in jobs if not job.path.is_file()]
    total = sum(job.frames for job in jobs)
    done = total - sum(job.frames for job in waiting)
    progress(done, total)

    def count(_: object) -> None:
        nonlocal done
        done += 1
        progress(done, total)

    # What others are writing is left to them at first, and then waited for: should they fail, it is done here.
    for patience_s in (0.0, math.inf):
        waiting = [job for job in waiting if not job.path.is_file()]
        work_through(partial(_render_shard, patience_s), waiting, workers=workers, on_message=count)
    with one_writer(folder / CARD, patience_s=math.inf):
        if not (folder / CARD).is_file():
            write_card(folder, described, [(job.path, job.split, job.frames) for job in jobs], plan)
    return folder


@dataclass(frozen=True)
class _Job:
    """A shard to write: its scenes, all of one split."""

    description: DataSetDescription
    path: Path
    split: Split
    scenes: tuple[int, ...]
    variant: str

    @property
    def frames(self) -> int:
        return len(self.scenes) * self.description.frames_per_scene()


def _jobs(description: DataSetDescription, folder: Path, variant: str) -> list[_Job]:
    """All shards, in the order of their first scenes."""
    members: dict[Split, list[int]] = {split: [] for split in SPLITS}
    for scene in range(description.scenes):
        members[split_of(description, scene)].append(scene)
    suffix, size = SUFFIXES[description.format], description.scenes_per_shard
    jobs = [
        _Job(
            description,
            folder / f"{split}-{first // size:06d}{suffix}",
            split,
            (*scenes[first : first + size],),
            variant,
        )
        for split, scenes in members.items()
        for first in range(0, len(scenes), size)
    ]
    return sorted(jobs, key=lambda job: job.scenes)


def _plan(description: DataSetDescription, variant: str) -> dict[str, JsonValue]:
    """What the frames follow from."""
    versions: dict[str, JsonValue] = {package: version(package) for package in ("uwlts", "mitsuba", "drjit")}
    return {"description": description.model_dump(mode="json"), "variant": variant, "versions": versions}


def _prepare(folder: Path, jobs: list[_Job], plan: dict[str, JsonValue], *, overwrite: bool) -> None:
    """Make the folder ready for a plan; OutputError where another run is at work in what is to be replaced."""
    try:
        for job in jobs:
            refuse_other_writer(job.path)
    except OtherWriterError:
        if overwrite:
            raise
    else:
        _clear(folder, all_of_it=overwrite and (folder / PLAN).is_file())
    files = {job.path for job in jobs}
    pattern = f"*{SUFFIXES[jobs[0].description.format]}"
    keep_to_plan(folder, plan, files, recorded=pattern, called="a data set", overwrite=overwrite)


def _clear(folder: Path, *, all_of_it: bool) -> None:
    """Remove what a killed run has left unfinished, and with ``all_of_it`` the data set itself; other files stay."""
    for path in folder.iterdir():
        if path.is_file() and (_UNFINISHED.fullmatch(path.name) or (all_of_it and _OUTPUT.fullmatch(path.name))):
            path.unlink()


def _render_shard(patience_s: float, job: _Job, report: Callable[[None], None]) -> None:
    """Render the scenes of a shard into its file; calls ``report`` after every frame.

    A shard that another process is still writing after ``patience_s`` is left to it.
    """
    try:
        with one_writer(job.path, patience_s=patience_s):
            if not job.path.is_file():
                _render(job, report)
                return
    except OtherWriterError:
        return
    # Another process has written it meanwhile.
    for _ in range(job.frames):
        report(None)


def _render(job: _Job, report: Callable[[None], None]) -> None:
    use_variant(job.variant)
    import drjit as dr
    import mitsuba as mi

    dr.set_thread_count(1)
    # Mitsuba takes the rounding of turned cylinders for shear, and says so of every scene.
    mi.set_log_level(mi.LogLevel.Error)
    with written_shard(job.path, job.description.format, frames=job.frames) as writer:
        for scene in job.scenes:
            drawn, studio = _measurable(job.description, scene)
            for index, shot in enumerate(drawn.scene.motion.shots()):
                taken = studio.exposed(shot, index, exposure=drawn.exposures[index])
                arrays = labelled(studio, shot, taken, job.description.labels)
                info = _known(job.description, drawn, studio, shot, taken, index)
                writer.add(Sample(f"{scene:06d}-{index:02d}", taken.image, arrays, info))
                report(None)


def _measurable(description: DataSetDescription, scene: int) -> tuple[DrawnScene, Studio]:
    """A scene as first drawn so that the sensor can measure it, and the sensor before it."""
    from twin.recording.studio import Studio

    why = None
    for attempt in range(MOST_ATTEMPTS):
        drawn = draw_scene(description, scene, attempt=attempt)
        try:
            return drawn, Studio(drawn.as_built, drawn.scene, drawn.options, probe="middle")
        except DesignError as error:
            why = error
    raise DesignError(
        f"scene {scene} of '{description.title}' was drawn {MOST_ATTEMPTS} times, and the sensor can measure none of "
        f"them: narrow what vary says. The last one: {why}"
    ) from why


def _known(
    description: DataSetDescription, drawn: DrawnScene, studio: Studio, shot: Shot, taken: Exposed, index: int
) -> dict[str, Any]:
    """What is known of a frame, as a table of JSON."""
    known: dict[str, Any] = {
        "scene": drawn.number,
        "frame": index,
        "split": drawn.split,
        "seed": drawn.options.seed,
        "attempt": drawn.attempt,
        "light": shot.light,
        "stage_mm": shot.stage_mm,
        "exposure_ms": taken.exposure_ms,
        "drawn": drawn.values | {"frame.exposure": drawn.exposures[index]},
        "T_scene_object": studio.pose(shot).tolist(),
        "T_camera_object": camera_from_object(studio.sensor).tolist(),
    }
    if "sensor" in description.labels:
        tables = {"sensor": drawn.sensor, "as_built": studio.sensor, "medium": studio.medium}
        known |= {name: each.model_dump(mode="json", exclude_none=True) for name, each in tables.items()}
        known["scene_description"] = drawn.scene.model_dump(mode="json", exclude_none=True)
    return known
