"""Scenes of a data set: values drawn for sensor, objects and frames.

Each path of each scene has its own random numbers, which depend only on the seed, the scene's number and the path's
name. More scenes do not change the first ones, and an additional path does not change the values of others.
"""

from dataclasses import dataclass

import numpy as np

from twin.datasets.data_set import EXPOSURE, DataSetDescription
from twin.rendering_options import Options
from twin.scene.description import Scene
from twin.scene.paths import Value, with_values
from uwlts.errors import Error
from uwlts.model.library import validate_description
from uwlts.model.sensor import Sensor
from uwlts.storage.data_set import SPLITS, Split

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

    motion = description.scene.motion
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
        table = description.scene.model_dump()
        drawn = (
            validate_description(Scene, with_values(table, by_root["scene"]), source)
            if by_root["scene"]
            else description.scene
        )
        seed = int(np.random.SeedSequence([description.seed, scene, attempt]).generate_state(1)[0])
        options = description.options(seed=seed, strengths=by_root["effects"])
    except Error as error:
        text = ", ".join(f"{path} = {value}" for path, value in values.items())
        raise type(error)(f"{error}\n  drawn: {text}; narrow the distributions of these paths in vary") from error
    motion = drawn.motion
    exposures = (1.0,) * motion.images()
    if EXPOSURE in description.vary:
        exposures = tuple(float(description.draw_value(EXPOSURE, share(EXPOSURE, k))) for k in range(len(exposures)))
    return DrawnScene(
        scene, attempt, choose_split(description, scene), values, exposures, described, as_built, drawn, options
    )


def _apply_values(sensor: Sensor, values: dict[str, Value], source: str) -> Sensor:
    return validate_description(Sensor, with_values(sensor.model_dump(), values), source) if values else sensor
