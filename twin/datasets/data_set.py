"""Description of a data set: base scene and sensor, their random variations, labels, splits and files."""

from __future__ import annotations

import math
from enum import IntEnum, IntFlag
from pathlib import Path
from typing import Annotated, Literal, Self

import numpy as np
from pydantic import BeforeValidator, Field, PrivateAttr, ValidationInfo, field_validator, model_validator
from scipy.special import ndtr, ndtri

from twin.rendering_options import Effects, Flaws, Options
from twin.scene.campaign import AnySensor, choose_sensors
from twin.scene.description import AnyMotion, NamedSensor, PrintedPlate, Scene, Value, load_scene, value_at
from uwlts.errors import DescriptionError
from uwlts.files.reading import is_regular_file
from uwlts.model.library import find_description, read_table, validate_description
from uwlts.model.sensor import Description, Positive

FOLDER = "datasets"
EXPOSURE = "frame.exposure"  # path that varies between frames; all others vary between scenes
_ONE_FOR_ALL = ("camera.width_px", "camera.height_px", "camera.stripe_along", "detector.bits", "motion.count")
_PRINT_ERRORS = frozenset({"centre_std_mm", "stretch", "bow_mm", "detection_std_px"})
Label = Literal["centre", "quality", "points", "masks", "light", "depth", "target", "sensor"]


class LineStatus(IntEnum):
    """State of the stripe on a profile line."""

    VISIBLE = 0
    """The stripe is visible: its brightest pixel is well above the noise."""
    NOT_CROSSED = 1
    """No visible surface at the sheet's middle: the stripe is outside the image, or hidden."""
    SHADOWED = 2
    """There is a visible surface at the sheet's middle, but it is in the laser's shadow."""
    FAINT = 3
    """The brightest pixel's signal is below three standard deviations of its noise."""
    SATURATED = 4
    """Pixels within the stripe's full width at half maximum are saturated."""
    LASER_OFF = 5
    """The image was taken under the lamp."""


class Mask(IntFlag):
    """Bits of an image mask and their meaning."""

    STRIPE = 1
    """Direct light of the lit surface is at least 1/e^2 of its maximum on the profile line, and one electron."""
    SATURATED = 2
    """The pixel is saturated."""
    HAZE = 4
    """Light scattered once in the water exceeds the standard deviation of the pixel's noise."""
    SECONDARY = 8
    """Light on longer paths exceeds the noise: reflections between surfaces, and multiple scattering."""
    PARTICLES = 16
    """Light of grains and bubbles in the sheet exceeds the noise."""


FAINT_BELOW = 3.0
"""Limit of the signal-to-noise ratio of the brightest pixel. A stripe about 4 px wide has twice this ratio, and
detection requires 5 to 6 (A. Rose, J. Opt. Soc. Am. 38, 196, 1948)."""


class OneOf(Description):
    """One of several values, with probabilities proportional to ``weights``, by default equal.

    The ``quantile`` of a distribution is the inverse of its cumulative distribution function.
    """

    kind: Literal["choice"]
    values: Annotated[tuple[Value, ...], Field(min_length=1)]
    weights: tuple[Positive, ...] | None = None

    @model_validator(mode="after")
    def _check_weights(self) -> Self:
        if self.weights is not None and len(self.weights) != len(self.values):
            raise ValueError(f"{len(self.weights)} weights for {len(self.values)} values: give one for each")
        return self

    def quantile(self, share: float) -> Value:
        """Return the value at a cumulative probability."""
        below = np.cumsum(self.weights or (1.0,) * len(self.values))
        return self.values[min(int(np.searchsorted(below, share * below[-1], "right")), len(self.values) - 1)]


class Uniform(Description):
    """Uniform distribution on a range, of the value or, for "log_uniform", of its logarithm."""

    kind: Literal["uniform", "log_uniform"]
    least: float
    most: float

    @model_validator(mode="after")
    def _check_range(self) -> Self:
        if not self.least < self.most:
            raise ValueError(f"least {self.least:g} must be smaller than most {self.most:g}")
        if self.kind == "log_uniform" and self.least <= 0:
            raise ValueError(f"least of a log_uniform distribution is {self.least:g}; it must be above 0")
        return self

    def quantile(self, share: float) -> float:
        """Return the quantile of a probability."""
        if self.kind == "uniform":
            return self.least + share * (self.most - self.least)
        return self.least * (self.most / self.least) ** share


class Normal(Description):
    """Normal distribution, truncated to ``least`` and ``most`` if they are given."""

    kind: Literal["normal"]
    mean: float
    std: Positive
    least: float | None = None
    most: float | None = None

    @model_validator(mode="after")
    def _check_range(self) -> Self:
        low, high = self._find_ends()
        if high - low < 1e-6:
            raise ValueError(
                f"less than a millionth of the normal distribution with mean {self.mean:g} and std {self.std:g} is "
                f"between least {self.least} and most {self.most}: widen the range"
            )
        return self

    def quantile(self, share: float) -> float:
        """Return the quantile of a probability."""
        low, high = self._find_ends()
        return float(self.mean + self.std * ndtri(low + share * (high - low)))

    def _find_ends(self) -> tuple[float, float]:
        low = 0.0 if self.least is None else float(ndtr((self.least - self.mean) / self.std))
        return low, 1.0 if self.most is None else float(ndtr((self.most - self.mean) / self.std))


AnyDistribution = Annotated[OneOf | Uniform | Normal, Field(discriminator="kind")]


class Splits(Description):
    """Fractions of the scenes in each split; all frames of a scene are in the same split."""

    train: Annotated[float, Field(ge=0, le=1)] = 0.8
    validation: Annotated[float, Field(ge=0, le=1)] = 0.1
    test: Annotated[float, Field(ge=0, le=1)] = 0.1

    @model_validator(mode="after")
    def _check_sum(self) -> Self:
        if not math.isclose(total := self.train + self.validation + self.test, 1.0, abs_tol=1e-9):
            raise ValueError(f"train, validation and test add up to {total:g}; expected 1")
        return self


class DataSetDescription(Description):
    """Data set as read from TOML.

    Each of the ``scenes`` is the base ``scene``, recorded by the base ``sensor``. The paths in ``vary`` have random
    values. The frames of a scene are the images of its motion, or of ``motion`` if it is given. ``sensor`` is the
    nominal description, and ``as_built`` the rendered sensor, by default the same. Scene and sensors are given by name
    or path.

    ``vary`` maps paths to distributions:

    - ``sensor.`` and a path of the sensor's description: changes the nominal and the rendered sensor.
    - ``as_built.`` and such a path: changes only the rendered sensor.
    - ``scene.`` and a path of the scene's description.
    - ``effects.`` and the name of an effect: its strength (`twin.rendering_options.Flaws`).
    - ``frame.exposure``: a factor of the exposure time, drawn for each frame.

    Indices in lists start at 0. Values of integers are rounded.

    Scenes are drawn again if any laser image has the stripe on less than the fraction ``least_stripe`` of its profile
    lines. ``spp``, ``effects`` and ``without`` are those of `twin.simulate`. ``labels`` are the arrays stored with each
    image. Each file has ``scenes_per_shard`` scenes.
    """

    title: str
    notes: str = ""
    licence: str = "not stated"
    sensor: NamedSensor = Field(default="thesis", validate_default=True)
    as_built: NamedSensor | None = None
    motion: AnyMotion | None = None
    scene: Annotated[Scene, BeforeValidator(lambda given: load_scene(given) if isinstance(given, str) else given)]
    seed: Annotated[int, Field(ge=0)] = 0
    scenes: Annotated[int, Field(ge=1, le=1_000_000)] = 100
    least_stripe: Annotated[float, Field(ge=0, le=1)] = 0.0
    scenes_per_shard: Annotated[int, Field(ge=1, le=100_000)] = 16
    splits: Splits = Splits()
    spp: Annotated[int, Field(ge=1, le=65536)] = 16
    effects: tuple[str, ...] = ()
    without: tuple[str, ...] = ()
    labels: tuple[Label, ...] = ("centre", "quality", "masks", "sensor")
    vary: dict[str, AnyDistribution] = {}
    _whole: frozenset[str] = PrivateAttr(default=frozenset())

    @field_validator("scene")
    @classmethod
    def _apply_motion(cls, scene: Scene, info: ValidationInfo) -> Scene:
        motion = info.data.get("motion")
        return scene if motion is None else scene.model_copy(update={"motion": motion})

    @model_validator(mode="after")
    def _check_vary(self) -> Self:
        self.options(seed=0)
        whole = set()
        for path, distribution in self.vary.items():
            found = self._look_up_base(path)
            if path.partition(".")[2] in _ONE_FOR_ALL:
                raise ValueError(f"vary '{path}': all frames of a data set have the same size; make two data sets")
            ends = [distribution.quantile(share) for share in (1e-3, 0.5)]
            if isinstance(found, int) and not isinstance(found, bool):
                whole.add(path)
            if isinstance(found, float | int) and not all(isinstance(end, float | int) for end in ends):
                raise ValueError(f"vary '{path}' gives {ends[0]!r} in place of the number {found:g}")
        if self.least_stripe > 0 and "centre" not in self.labels:
            raise ValueError(f"least_stripe {self.least_stripe:g} needs the label 'centre': add it to labels")
        if "target" in self.labels:
            printed = [thing for thing in self.scene.objects if isinstance(thing, PrintedPlate)]
            if not printed:
                raise ValueError("the label 'target' is for scenes with a calibration target: leave it out")
            varied = {path.rpartition(".")[2] for path in self.vary}
            if any(np.any(getattr(one, error)) for one in printed for error in _PRINT_ERRORS) or varied & _PRINT_ERRORS:
                raise ValueError("the label 'target' does not include errors of print, plate and detection: omit them")
        if EXPOSURE in self.vary and self.scene.motion.moves():
            raise ValueError(
                f"{EXPOSURE} does not change the blur by a moving stage: vary sensor.exposure.laser_ms instead"
            )
        self._whole = frozenset(whole)
        return self

    def options(self, *, seed: int, strengths: dict[str, Value] | None = None) -> Options:
        """Return the options for rendering a scene; ``strengths`` are the drawn strengths of effects by name."""
        drawn = [f"{name}={value}" for name, value in (strengths or {}).items()]
        return Options(self.spp, seed, Effects().remove(*self.without), Flaws.parse(*self.effects, *drawn))

    def draw_value(self, path: str, share: float) -> Value:
        """Return the quantile of a path's distribution at a probability from 0 to 1, rounded for integers."""
        value = self.vary[path].quantile(share)
        if path.endswith((".path", ".texture")):  # from the folder of the scene, as in its file
            return str(Path(str(self._look_up_base(path))).parent / str(value))
        return round(value) if path in self._whole and not isinstance(value, str) else value

    def _look_up_base(self, path: str) -> Value | None:
        """Return the value of a path in the base description; DescriptionError if the path is unknown."""
        root, _, rest = path.partition(".")
        if path == EXPOSURE:
            return 1.0
        described = {"sensor": self.sensor, "as_built": self.as_built or self.sensor, "scene": self.scene}
        if root in described:
            return value_at(described[root], rest, f"vary '{path}'", called="scene" if root == "scene" else "sensor")
        if root != "effects":
            known = ", ".join(f"{each}." for each in (*described, "effects"))
            raise DescriptionError(f"vary '{path}': a path begins with {known} or is {EXPOSURE}")
        strength = getattr(Flaws.parse(rest), rest.replace("-", "_"))
        if isinstance(strength, bool):
            raise DescriptionError(f"vary '{path}': {rest} does not have a strength; name it in effects")
        return strength


def load_description(
    given: str | Path | DataSetDescription, *, sensor: AnySensor | None = None, **numbers: int | None
) -> DataSetDescription:
    """Load the description of a data set by name (``stripe-clean``) or path, or check a given one.

    Scene and sensors can be names of files in the description's folder. ``numbers``, such as scenes and seed, replace
    those of the description. Of a ``sensor``, only the lamp varies, and JPEG is for 8 bits. Raises DescriptionError if
    the description is not valid.
    """
    if isinstance(given, DataSetDescription):
        path, table = Path("the description"), given.model_dump()
    else:
        path = find_description(given, FOLDER)
        table = dict(read_table(path, FOLDER))
        for key in ("sensor", "as_built", "scene"):
            beside = path.parent / str(table.get(key, ""))
            if beside.suffix == ".toml" and is_regular_file(beside):
                table[key] = str(beside)
    table |= {key: value for key, value in numbers.items() if value is not None}
    found = validate_description(DataSetDescription, table, path)
    if sensor is None:
        return found
    own, _ = choose_sensors(sensor, None)
    fixed = ("sensor.", "as_built.", "effects.jpeg") if own.detector.bits > 8 else ("sensor.", "as_built.")
    vary = {k: v for k, v in found.vary.items() if not k.startswith(fixed) or k.startswith("sensor.lamp.")}
    return validate_description(DataSetDescription, dict(found) | {"sensor": own, "as_built": None, "vary": vary}, path)
