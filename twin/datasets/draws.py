"""Scenes of a data set: what each number draws for its sensor, its objects and its frames.

Every path of every scene has random numbers of its own, which depend on the seed, the scene's number and the path's
name only: a data set of more scenes begins with those of a smaller one, and a path added leaves the others' values.
"""

from dataclasses import dataclass

import numpy as np

from twin.datasets.data_set import EXPOSURE, SPLITS, DataSetDescription, Split
from twin.options import Options
from twin.scene.description import Scene
from twin.scene.paths import Value, with_values
from uwlts.errors import Error
from uwlts.model.library import validated
from uwlts.model.sensor import Sensor

_GOLDEN = (5**0.5 - 1) / 2
"""Multiples of the golden section, without their whole part, are spread evenly however many of them there are."""


@dataclass(frozen=True)
class DrawnScene:
    """One scene of a data set, ready to be rendered.

    ``values`` are those drawn, by their paths, ``exposures`` (frames,) the factors of the frames' times of exposure.
    ``attempt`` counts from 0 how often it had to be drawn anew.
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


def split_of(description: DataSetDescription, scene: int) -> Split:
    """The split of a scene, which more scenes do not change."""
    start = np.random.default_rng([description.seed, *b"splits"]).random()
    place = (start + scene * _GOLDEN) % 1.0
    for name in SPLITS:
        place -= getattr(description.splits, name)
        if place < 0:
            return name
    # The shares add up to 1 but for rounding.
    return max(SPLITS, key=lambda name: getattr(description.splits, name))


def draw_scene(description: DataSetDescription, scene: int, *, attempt: int = 0) -> DrawnScene:
    """A scene by its number; DescriptionError where its values make no description of a scene or sensor."""

    def share(path: str, frame: int = 0) -> float:
        return float(np.random.default_rng([description.seed, scene, attempt, frame, *path.encode()]).random())

    motion = description.scene.motion
    values = {path: description.drawn(path, share(path)) for path in description.vary if path != EXPOSURE}
    by_root: dict[str, dict[str, Value]] = {"sensor": {}, "as_built": {}, "scene": {}, "effects": {}}
    for path, value in values.items():
        root, _, rest = path.partition(".")
        by_root[root][rest] = value
    source = f"scene {scene} of '{description.title}'"
    try:
        described = _changed(description.sensor, by_root["sensor"], source)
        as_built = _changed(description.as_built or description.sensor, by_root["sensor"], source)
        as_built = _changed(as_built, by_root["as_built"], source)
        table = description.scene.model_dump()
        drawn = (
            validated(Scene, with_values(table, by_root["scene"]), source) if by_root["scene"] else description.scene
        )
        seed = int(np.random.SeedSequence([description.seed, scene, attempt]).generate_state(1)[0])
        options = description.options(seed=seed, strengths=by_root["effects"])
    except Error as error:
        text = ", ".join(f"{path} = {value}" for path, value in values.items())
        raise type(error)(f"{error}\n  drawn were {text}: narrow what vary says of them") from error
    motion = drawn.motion
    exposures = (1.0,) * motion.images()
    if EXPOSURE in description.vary:
        exposures = tuple(float(description.drawn(EXPOSURE, share(EXPOSURE, k))) for k in range(len(exposures)))
    return DrawnScene(
        scene, attempt, split_of(description, scene), values, exposures, described, as_built, drawn, options
    )


def _changed(sensor: Sensor, values: dict[str, Value], source: str) -> Sensor:
    return validated(Sensor, with_values(sensor.model_dump(), values), source) if values else sensor
