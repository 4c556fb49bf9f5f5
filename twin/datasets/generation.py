"""Generation of data sets: draw scenes from a description and render them with labels, one shard at a time.

A shard is written atomically by one process. Its random numbers depend only on the seed and on the numbers of its
scenes. The files are therefore independent of the number of processes, and an interrupted run continues with the next
shard.
"""

from __future__ import annotations

import random
import re
from collections.abc import Callable
from dataclasses import dataclass
from importlib.metadata import version
from pathlib import Path
from typing import TYPE_CHECKING, Any

from pydantic import JsonValue

from twin.datasets.card import write_card
from twin.datasets.data_set import DataSetDescription, load_description
from twin.datasets.draws import DrawnScene, choose_split, draw_scene
from twin.datasets.labels import make_labels
from twin.recording.campaigns import PLAN, keep_to_plan, make_folder, require_at_least
from twin.rendering_options import CPU, Variant, use_variant
from uwlts.errors import DesignError
from uwlts.model.placement import camera_from_object
from uwlts.runtime.progress import ProgressListener, ignore_progress
from uwlts.runtime.workers import run_jobs
from uwlts.storage.data_set import CARD, SPLITS, SUFFIX, Sample, Split, open_shard

if TYPE_CHECKING:
    from twin.recording.sensor_simulator import SensorSimulator, SimulatedImage
    from twin.scene.motion import Shot

MOST_ATTEMPTS = 20
"""Largest number of draws of a scene until the sensor can measure it; more indicate an error in the description."""
_OUTPUT = re.compile(rf"({'|'.join(SPLITS)})-\d{{6}}\.tar|{re.escape(CARD)}|{re.escape(PLAN)}")


def dataset(
    description: str | Path | DataSetDescription,
    *,
    out: str | Path,
    scenes: int | None = None,
    seed: int | None = None,
    workers: int | None = None,
    overwrite: bool = False,
    variant: Variant = CPU,
    progress: ProgressListener = ignore_progress,
) -> Path:
    """Render a data set of labelled images, for training and testing, from a description of its random variations.

    An interrupted run continues when it is run again. Several runs can share the folder, also from other machines: each
    renders in its own order the shards that are still missing, and ends when all are complete. The folder is returned;
    `load_dataset` reads it.

    Parameters
    ----------
    description
        Name (see: twin scenes) or path of the data set's description.
    out
        Folder for the data set: shards and dataset.json.
    scenes
        Number of scenes; default: the description's.
    seed
        Seed of all random numbers; default: the description's.
    workers
        Number of shards that are rendered at the same time; default: one per processor. The frames do not depend on it.
    overwrite
        Remove an existing data set from the folder first.
    variant
        As for `simulate`.
    progress
        Called with the number of frames done, the number in all, and the name of the stage.

    Returns
    -------
    pathlib.Path
        The folder, which `load_dataset` reads.

    Raises
    ------
    DescriptionError
        The description is not valid, or the folder contains another data set.
    DesignError
        The sensor cannot measure the drawn scenes.
    OutputError
        A file cannot be written.
    SetupError
        Mitsuba cannot use the variant on this machine, or a process that renders was ended from outside.

    Examples
    --------
    >>> folder = twin.dataset("stripe-turbid", out="runs/turbid", scenes=200)
    >>> test = twin.load_dataset(folder, split="test")
    """
    require_at_least(1, workers=workers)
    described, folder = load_description(description, scenes=scenes, seed=seed), Path(out)
    draw_scene(described, 0)
    jobs = _jobs(described, folder, variant)
    plan = _plan(described, variant)
    make_folder(folder)
    if overwrite and (folder / PLAN).is_file():
        for path in folder.iterdir():
            if path.is_file() and _OUTPUT.fullmatch(path.name):
                path.unlink()
    files, pattern = {job.path for job in jobs}, f"*{SUFFIX}"
    keep_to_plan(folder, plan, files, recorded=pattern, called="a data set", overwrite=overwrite)
    waiting = [job for job in jobs if not job.path.is_file()]
    total = sum(job.frames for job in jobs)
    done = total - sum(job.frames for job in waiting)
    progress(done, total)

    def count(_: object) -> None:
        nonlocal done
        done += 1
        progress(done, total)

    # In an order of its own, so that runs that share the folder rarely render the same shard.
    random.shuffle(waiting)
    run_jobs(_render_shard, waiting, workers=workers, on_message=count)
    if not (folder / CARD).is_file():
        write_card(folder, described, [(job.path, job.split, job.frames) for job in jobs], plan)
    return folder


@dataclass(frozen=True)
class _Job:
    """Shard to write; all its scenes belong to one split."""

    description: DataSetDescription
    path: Path
    split: Split
    scenes: tuple[int, ...]
    variant: str

    @property
    def frames(self) -> int:
        return len(self.scenes) * self.description.frames_per_scene()


def _jobs(description: DataSetDescription, folder: Path, variant: str) -> list[_Job]:
    """Return all shards, sorted by first scene."""
    members: dict[Split, list[int]] = {split: [] for split in SPLITS}
    for scene in range(description.scenes):
        members[choose_split(description, scene)].append(scene)
    size = description.scenes_per_shard
    jobs = [
        _Job(
            description,
            folder / f"{split}-{first // size:06d}{SUFFIX}",
            split,
            (*scenes[first : first + size],),
            variant,
        )
        for split, scenes in members.items()
        for first in range(0, len(scenes), size)
    ]
    return sorted(jobs, key=lambda job: job.scenes)


def _plan(description: DataSetDescription, variant: str) -> dict[str, JsonValue]:
    """Return the settings that determine the frames."""
    versions: dict[str, JsonValue] = {package: version(package) for package in ("uwlts", "mitsuba", "drjit")}
    return {"description": description.model_dump(mode="json"), "variant": variant, "versions": versions}


def _render_shard(job: _Job, report: Callable[[None], None]) -> None:
    """Render the scenes of a shard to its file, unless another run has done so, and call ``report`` for each frame."""
    if not job.path.is_file():
        _render(job, report)
        return
    for _ in range(job.frames):
        report(None)


def _render(job: _Job, report: Callable[[None], None]) -> None:
    use_variant(job.variant)
    import drjit as dr
    import mitsuba as mi

    dr.set_thread_count(1)
    # Mitsuba warns of shear in every scene, because of rounding errors of rotated cylinders.
    mi.set_log_level(mi.LogLevel.Error)
    with open_shard(job.path) as writer:
        for scene in job.scenes:
            drawn, studio = _measurable(job.description, scene)
            for index, shot in enumerate(drawn.scene.motion.shots()):
                taken = studio.expose(shot, index, exposure=drawn.exposures[index])
                arrays = make_labels(studio, shot, taken, job.description.labels)
                info = _make_frame_metadata(job.description, drawn, studio, shot, taken, index)
                writer.add(Sample(f"{scene:06d}-{index:02d}", taken.image, arrays, info))
                report(None)


def _measurable(description: DataSetDescription, scene: int) -> tuple[DrawnScene, SensorSimulator]:
    """Draw a scene until the sensor can measure it; return the scene and its studio."""
    from twin.recording.sensor_simulator import SensorSimulator

    why = None
    for attempt in range(MOST_ATTEMPTS):
        drawn = draw_scene(description, scene, attempt=attempt)
        try:
            return drawn, SensorSimulator(drawn.as_built, drawn.scene, drawn.options, probe="middle")
        except DesignError as error:
            why = error
    raise DesignError(
        f"scene {scene} of '{description.title}' was drawn {MOST_ATTEMPTS} times, but the sensor can measure none of "
        f"the draws: narrow the distributions in vary. The last one: {why}"
    ) from why


def _make_frame_metadata(
    description: DataSetDescription,
    drawn: DrawnScene,
    studio: SensorSimulator,
    shot: Shot,
    taken: SimulatedImage,
    index: int,
) -> dict[str, Any]:
    """Return the metadata of a frame as a JSON table."""
    known: dict[str, Any] = {
        "scene": drawn.number,
        "frame": index,
        "split": drawn.split,
        "seed": drawn.options.seed,
        "attempt": drawn.attempt,
        "light": shot.light,
        "stage_mm": shot.stage_mm,
        "exposure_ms": taken.exposure_ms,
        "at_maximum": float((taken.image >= studio.sensor.detector.full_scale_dn()).mean()),
        "drawn": drawn.values | {"frame.exposure": drawn.exposures[index]},
        "T_scene_object": studio.pose(shot).tolist(),
        "T_camera_object": camera_from_object(studio.sensor).tolist(),
    }
    if "sensor" in description.labels:
        tables = {"sensor": drawn.sensor, "as_built": studio.sensor, "medium": studio.medium}
        known |= {name: each.model_dump(mode="json", exclude_none=True) for name, each in tables.items()}
        known["scene_description"] = drawn.scene.model_dump(mode="json", exclude_none=True)
    return known
