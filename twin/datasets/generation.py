"""Generation of data sets: draw scenes from a description and render them with labels, one shard at a time.

Each path of each scene has its own random numbers, which depend only on the seed, the scene's number and the path's
name. More scenes do not change the first ones, and an additional path does not change the values of others.

A shard is written atomically by one process. Its random numbers depend only on the seed and on the numbers of its
scenes. The files are therefore independent of the number of processes, and an interrupted run continues with the next
shard.
"""

from __future__ import annotations

import random
import re
from collections import Counter
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from importlib.metadata import version
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeVar

import cv2
import numpy as np
from pydantic import JsonValue

from twin.datasets.data_set import EXPOSURE, DataSetDescription, LineStatus, load_description
from twin.datasets.labels import MEANINGS, make_labels
from twin.recording.campaigns import PLAN, keep_to_plan, make_folder, require_at_least
from twin.rendering_options import CPU, Options, Variant, use_variant
from twin.scene.campaign import AnySensor
from twin.scene.description import Scene, Value, with_values
from uwlts.errors import DesignError, Error
from uwlts.files.json_files import write_model
from uwlts.files.reading import log_warnings
from uwlts.files.writing import hash_file, write_file
from uwlts.model.library import validate_description
from uwlts.model.placement import camera_from_object
from uwlts.model.sensor import Sensor
from uwlts.runtime.progress import ProgressListener, ignore_progress
from uwlts.runtime.workers import run_jobs
from uwlts.storage.data_set import (
    CARD,
    CARD_FORMAT,
    CARD_VERSION,
    SPLITS,
    SUFFIX,
    DataCard,
    DataSet,
    Sample,
    Shard,
    Split,
    open_shard,
)

if TYPE_CHECKING:
    from twin.recording.sensor_simulator import SensorSimulator, SimulatedImage
    from twin.scene.platforms import Shot

Described = TypeVar("Described", Sensor, Scene)

_BRIGHT = 0.03
"""Largest fraction of pixels above `auto_level` by automatic exposure, and at the maximum without a warning: a stripe
of 20 px with all its pixels there has 2 to 4 %."""


def write_card(
    folder: Path, description: DataSetDescription, shards: Sequence[tuple[Path, Split, int]], plan: dict[str, JsonValue]
) -> DataCard:
    """Write the card of a data set.

    ``shards`` are path, split and number of frames of the complete shards.
    """
    per_scene, versions = description.scene.motion.images(), plan["versions"]
    frames: dict[Split, int] = {split: sum(count for _, part, count in shards if part == split) for split in SPLITS}
    card = DataCard(
        title=description.title,
        notes=description.notes,
        licence=description.licence,
        seed=description.seed,
        versions={str(k): str(v) for k, v in versions.items()} if isinstance(versions, dict) else {},
        image={
            "width_px": description.sensor.camera.width_px,
            "height_px": description.sensor.camera.height_px,
            "bits": description.sensor.detector.bits,
        },
        scenes={split: frames[split] // per_scene for split in SPLITS},
        frames=frames,
        redrawn=0,
        labels={},
        drawn={},
        status={},
        description=description.model_dump(mode="json"),
        shards=tuple(Shard(name=path.name, split=part, frames=n, sha256=hash_file(path)) for path, part, n in shards),
    )
    values: dict[str, list[Value]] = {}
    status: Counter[int] = Counter()
    redrawn: set[int] = set()
    bright = 0
    for sample in DataSet(folder, card, None, ("info", "status")):
        info = sample["info"]
        bright += info.get("at_maximum", 0.0) > _BRIGHT
        for path, value in info["drawn"].items():
            # Values that all frames of a scene share count once.
            if info["frame"] == 0 or path == EXPOSURE:
                values.setdefault(path, []).append(value)
        if info["attempt"]:
            redrawn.add(info["scene"])
        if "status" in sample:
            numbers, counts = np.unique(sample["status"], return_counts=True)
            status.update(dict(zip(numbers.tolist(), counts.tolist(), strict=True)))
    names = [name for name in DataSet(folder, card, None, None)[0] if name in MEANINGS]
    card = card.model_copy(
        update={
            "redrawn": len(redrawn),
            "labels": {name: MEANINGS[name] for name in names},
            "drawn": {path: _summarise(drawn) for path, drawn in values.items()},
            "status": {LineStatus(number).name.lower(): count for number, count in sorted(status.items())},
        }
    )
    if bright:
        text = f"{bright} of {sum(frames.values())} images have more than {100 * _BRIGHT:g} % of their pixels"
        log_warnings(folder, [f"{text} at the maximum: lower exposure.auto_level, frame.exposure or the ambient light"])
    # The last file: with it the data set is complete.
    write_model(folder / CARD, card, file_format=CARD_FORMAT, version=CARD_VERSION, overwrite=True)
    return card


def _summarise(values: Sequence[Value]) -> dict[str, float | str]:
    if any(isinstance(value, str | bool) for value in values):
        return {str(value): float(count) for value, count in sorted(Counter(map(str, values)).items())}
    numbers = np.array(values, float)
    return {"least": float(numbers.min()), "mean": float(numbers.mean()), "most": float(numbers.max())}


_GOLDEN = (5**0.5 - 1) / 2
"""Golden ratio conjugate: the fractional parts of its first n multiples are evenly spread for every n."""


@dataclass(frozen=True)
class DrawnScene:
    """Scene of a data set, ready to be rendered.

    ``values`` are the drawn values by path. ``exposures`` (frames,) are factors of the frames' exposure times.
    ``attempt`` is the number of earlier draws that were rejected.
    """

    number: int
    attempt: int
    split: Split
    values: dict[str, Value]
    exposures: tuple[float, ...]
    sensor: Sensor
    as_built: Sensor
    scene: Scene
    options: Options


def choose_split(description: DataSetDescription, scene: int) -> Split:
    """Return the split of a scene; it does not depend on the number of scenes."""
    start = np.random.default_rng([description.seed, *b"splits"]).random()
    place = (start + scene * _GOLDEN) % 1.0
    for name in SPLITS:
        place -= getattr(description.splits, name)
        if place < 0:
            return name
    # The fractions can sum to less than 1 because of rounding.
    return max(SPLITS, key=lambda name: getattr(description.splits, name))


def draw_scene(description: DataSetDescription, scene: int, *, attempt: int = 0) -> DrawnScene:
    """Draw a scene by its number; DescriptionError if its values are not valid for a scene or sensor."""

    def share(path: str, frame: int = 0) -> float:
        return float(np.random.default_rng([description.seed, scene, attempt, frame, *path.encode()]).random())

    values = {path: description.draw_value(path, share(path)) for path in description.vary if path != EXPOSURE}
    by_root: dict[str, dict[str, Value]] = {"sensor": {}, "as_built": {}, "scene": {}, "effects": {}}
    for path, value in values.items():
        root, _, rest = path.partition(".")
        by_root[root][rest] = value
    source = f"scene {scene} of '{description.title}'"
    try:
        described = _apply_values(description.sensor, by_root["sensor"], source)
        as_built = _apply_values(description.as_built or description.sensor, by_root["sensor"], source)
        as_built = _apply_values(as_built, by_root["as_built"], source)
        drawn = _apply_values(description.scene, by_root["scene"], source)
        seed = int(np.random.SeedSequence([description.seed, scene, attempt]).generate_state(1)[0])
        options = description.options(seed=seed, strengths=by_root["effects"])
    except Error as error:
        text = ", ".join(f"{path} = {value}" for path, value in values.items())
        raise type(error)(f"{error}\n  drawn: {text}; narrow the distributions of these paths in vary") from error
    exposures = (1.0,) * drawn.motion.images()
    if EXPOSURE in description.vary:
        exposures = tuple(float(description.draw_value(EXPOSURE, share(EXPOSURE, k))) for k in range(len(exposures)))
    return DrawnScene(
        scene, attempt, choose_split(description, scene), values, exposures, described, as_built, drawn, options
    )


def _apply_values(described: Described, values: dict[str, Value], source: str) -> Described:
    table = with_values(described.model_dump(), values)
    return validate_description(type(described), table, source) if values else described


MOST_ATTEMPTS = 20
"""Largest number of draws of a scene until the sensor can measure it; more indicate an error in the description."""
SHEET = "contact-sheet.png"
_OUTPUT = re.compile(rf"({'|'.join(SPLITS)})-\d{{6}}\.tar|{re.escape(CARD)}|{re.escape(PLAN)}|{SHEET}")


def dataset(
    description: str | Path | DataSetDescription,
    *,
    out: str | Path,
    sensor: AnySensor | None = None,
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
        Folder for the data set: shards, dataset.json and a contact sheet.
    sensor
        Name or path of the sensor description to use in place of the data set's; of its values only the lamp's vary.
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
    described, folder = load_description(description, sensor=sensor, scenes=scenes, seed=seed), Path(out)
    draw_scene(described, 0)
    jobs = _list_jobs(described, folder, variant)
    versions: dict[str, JsonValue] = {package: version(package) for package in ("uwlts", "mitsuba", "drjit")}
    plan = {"description": described.model_dump(mode="json"), "variant": variant, "versions": versions}
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
        card = write_card(folder, described, [(job.path, job.split, job.frames) for job in jobs], plan)
        _write_sheet(folder / SHEET, DataSet(folder, card, None, ("image",)))
    return folder


def _write_sheet(path: Path, samples: DataSet) -> None:
    """Write a contact sheet of 12 frames, from the first to the last, with square roots of grey values."""
    images = [samples[place]["image"] for place in np.linspace(0, len(samples) - 1, 12).astype(int).tolist()]
    size, full = (320, round(320 * images[0].shape[0] / images[0].shape[1])), 2 ** samples.card.image["bits"] - 1
    small = [cv2.resize(np.sqrt(one / full), size, interpolation=cv2.INTER_AREA) for one in images]
    sheet = cv2.vconcat([cv2.hconcat(small[row : row + 4]) for row in (0, 4, 8)])
    write_file(path, cv2.imencode(".png", (255 * sheet).astype(np.uint8))[1].tobytes(), overwrite=True)


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
        return len(self.scenes) * self.description.scene.motion.images()


def _list_jobs(description: DataSetDescription, folder: Path, variant: str) -> list[_Job]:
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


def _render_shard(job: _Job, report: Callable[[None], None]) -> None:
    """Render the scenes of a shard to its file, unless another run has done so, and call ``report`` for each frame."""
    if job.path.is_file():
        for _ in range(job.frames):
            report(None)
        return
    use_variant(job.variant)
    import drjit as dr
    import mitsuba as mi

    dr.set_thread_count(1)
    # Mitsuba warns of shear in every scene, because of rounding errors of rotated cylinders.
    mi.set_log_level(mi.LogLevel.Error)
    with open_shard(job.path) as writer:
        for scene in job.scenes:
            for sample in _render_measurable(job.description, scene):
                writer.add(sample)
                report(None)


def _render_measurable(description: DataSetDescription, scene: int) -> list[Sample]:
    """Draw a scene until the sensor can measure it; return its frames."""
    why = None
    for attempt in range(MOST_ATTEMPTS):
        drawn = draw_scene(description, scene, attempt=attempt)
        try:
            return _render_scene(description, drawn)
        except DesignError as error:
            why = error
    raise DesignError(
        f"scene {scene} of '{description.title}' was drawn {MOST_ATTEMPTS} times, but the sensor can measure none of "
        f"the draws: narrow the distributions in vary. The last one: {why}"
    ) from why


def _render_scene(description: DataSetDescription, drawn: DrawnScene) -> list[Sample]:
    """Render the frames of a scene; DesignError if the sensor cannot measure it, or sees too little of the stripe."""
    from twin.recording.sensor_simulator import SensorSimulator

    simulator, samples = SensorSimulator(drawn.as_built, drawn.scene, drawn.options, probe="middle"), []
    for index, shot in enumerate(drawn.scene.motion.shots()):
        taken = simulator.expose(shot, index, exposure=drawn.exposures[index], bright_share=_BRIGHT)
        arrays = make_labels(simulator, shot, taken, description.labels)
        stripe = np.isin(arrays.get("status", LineStatus.VISIBLE), (LineStatus.VISIBLE, LineStatus.SATURATED)).mean()
        if shot.light == "laser" and stripe < description.least_stripe:
            raise DesignError(f"image {index} has the stripe on {stripe:.2%} of its lines, less than least_stripe")
        info = _make_frame_metadata(description, drawn, simulator, shot, taken, index)
        samples.append(Sample(f"{drawn.number:06d}-{index:02d}", taken.image, arrays, info))
    return samples


def _make_frame_metadata(
    description: DataSetDescription,
    drawn: DrawnScene,
    simulator: SensorSimulator,
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
        "at_maximum": float((taken.image >= simulator.sensor.detector.full_scale_dn()).mean()),
        "drawn": drawn.values | {EXPOSURE: drawn.exposures[index]},
        "T_scene_object": simulator.pose(shot).tolist(),
        "T_camera_object": camera_from_object(simulator.sensor).tolist(),
    }
    if "sensor" in description.labels:
        tables = {"sensor": drawn.sensor, "as_built": simulator.sensor, "medium": simulator.medium}
        known |= {name: each.model_dump(mode="json", exclude_none=True) for name, each in tables.items()}
        known["scene_description"] = drawn.scene.model_dump(mode="json", exclude_none=True)
    return known
