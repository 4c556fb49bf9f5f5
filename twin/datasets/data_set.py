"""Description of a data set: a base scene and sensor, what varies in them and how, labels, splits and files."""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from enum import IntEnum, IntFlag
from pathlib import Path
from typing import Annotated, Literal, Self, get_args

from pydantic import Field, PrivateAttr, ValidationInfo, field_validator, model_validator
from scipy.special import ndtr, ndtri

from twin.options import Effects, Flaws, Options
from twin.scene.description import AnyMotion, Printed, Scene, load_scene
from twin.scene.paths import Value, value_at
from uwlts.errors import DescriptionError
from uwlts.files.reading import is_regular_file
from uwlts.model.library import find, load_sensor, read_table, validated
from uwlts.model.sensor import Description, Positive, Sensor

FOLDER = "datasets"
ROOTS = ("sensor", "as_built", "scene", "effects")
"""First keys of the paths that vary with the scene; `EXPOSURE` alone varies with the frame."""
EXPOSURE = "frame.exposure"
_ONE_FOR_ALL = ("camera.width_px", "camera.height_px", "camera.stripe_along", "detector.bits", "motion.count")
_PRINT_ERRORS = ("centre_std_mm", "bow_mm", "detection_std_px")
Split = Literal["train", "validation", "test"]
SPLITS: tuple[Split, ...] = get_args(Split)
Label = Literal["centre", "quality", "points", "masks", "light", "depth", "target", "sensor"]


class LineStatus(IntEnum):
    """What a profile line shows of the stripe; the true centre is known of all but the lines without one."""

    VISIBLE = 0
    """The stripe is there, and its brightest pixel stands out of the noise."""
    NOT_CROSSED = 1
    """The line sees no surface at the sheet's middle: the stripe lies outside the image, or is hidden."""
    SHADOWED = 2
    """The line sees a surface at the sheet's middle, but none of the laser's light falls on it."""
    FAINT = 3
    """The brightest pixel's signal is below three standard deviations of its noise."""
    SATURATED = 4
    """Pixels within the stripe's full width at half maximum are saturated."""
    LASER_OFF = 5
    """The image was taken under the lamp."""


class Mask(IntFlag):
    """Bits of the mask of an image."""

    STRIPE = 1
    """Light straight from the lit surface is at least 1/e2 of the largest on the profile line, and an electron."""
    SATURATED = 2
    """The grey value is the largest."""
    HAZE = 4
    """Light that the water scattered once exceeds the standard deviation of the pixel's noise."""
    SECONDARY = 8
    """Light on longer ways exceeds it: from one surface to another, or scattered more often."""
    PARTICLES = 16
    """Light of grains and bubbles in the sheet exceeds it."""


FAINT_BELOW = 3.0
"""A stripe some 4 px wide has twice the signal to noise of its brightest pixel, and 5 to 6 is what detection takes
(A. Rose, J. Opt. Soc. Am. 38, 196, 1948)."""


class Distribution(Description, ABC):
    """Base of all distributions; `at` is the inverse of the distribution function."""

    @abstractmethod
    def at(self, share: float) -> Value:
        """The value below which the given share (0 to 1) of all values lies."""


class Constant(Distribution):
    """Always the same value."""

    kind: Literal["constant"]
    value: Value

    def at(self, share: float) -> Value:
        """The value."""
        return self.value


class OneOf(Distribution):
    """One of some values, each as probable as its weight says, all equally unless given."""

    kind: Literal["choice"]
    values: Annotated[tuple[Value, ...], Field(min_length=1)]
    weights: tuple[Positive, ...] | None = None

    @model_validator(mode="after")
    def _weighted(self) -> Self:
        if self.weights is not None and len(self.weights) != len(self.values):
            raise ValueError(f"{len(self.weights)} weights for {len(self.values)} values: give one for each")
        return self

    def at(self, share: float) -> Value:
        """The value whose part of all weights holds the share."""
        weights = self.weights or (1.0,) * len(self.values)
        left = share * math.fsum(weights)
        for value, weight in zip(self.values, weights, strict=True):
            if left < weight:
                return value
            left -= weight
        return self.values[-1]


class Between(Distribution):
    """Base of distributions between two ends."""

    least: float
    most: float

    @model_validator(mode="after")
    def _ordered(self) -> Self:
        if not self.least < self.most:
            raise ValueError(f"least {self.least:g} must be smaller than most {self.most:g}")
        return self


class Uniform(Between):
    """Every number of a range equally probable."""

    kind: Literal["uniform"]

    def at(self, share: float) -> float:
        """The value at a share of the range."""
        return self.least + share * (self.most - self.least)


class LogUniform(Between):
    """Every factor of a range equally probable: the logarithm is uniform."""

    kind: Literal["log_uniform"]

    @model_validator(mode="after")
    def _positive(self) -> Self:
        if self.least <= 0:
            raise ValueError(f"a logarithm needs a least above 0, found {self.least:g}")
        return self

    def at(self, share: float) -> float:
        """The value at a share of the range of logarithms."""
        return self.least * (self.most / self.least) ** share


class Normal(Distribution):
    """Normal with a mean and a standard deviation, cut off below ``least`` and above ``most`` if they are given."""

    kind: Literal["normal"]
    mean: float
    std: Positive
    least: float | None = None
    most: float | None = None

    @model_validator(mode="after")
    def _holds_values(self) -> Self:
        low, high = self._ends()
        if high - low < 1e-6:
            raise ValueError(
                f"less than a millionth of normal values about {self.mean:g} with std {self.std:g} lies between least "
                f"{self.least} and most {self.most}: widen them"
            )
        return self

    def at(self, share: float) -> float:
        """The value below which the share of the values between the ends lies."""
        low, high = self._ends()
        return float(self.mean + self.std * ndtri(low + share * (high - low)))

    def _ends(self) -> tuple[float, float]:
        low, high = (
            default if end is None else float(ndtr((end - self.mean) / self.std))
            for end, default in ((self.least, 0.0), (self.most, 1.0))
        )
        return low, high


AnyDistribution = Annotated[Constant | OneOf | Uniform | LogUniform | Normal, Field(discriminator="kind")]


class Splits(Description):
    """Shares of the scenes in each split; all frames of a scene are in the same one."""

    train: Annotated[float, Field(ge=0, le=1)] = 0.8
    validation: Annotated[float, Field(ge=0, le=1)] = 0.1
    test: Annotated[float, Field(ge=0, le=1)] = 0.1

    @model_validator(mode="after")
    def _whole(self) -> Self:
        if not math.isclose(total := self.train + self.validation + self.test, 1.0, abs_tol=1e-9):
            raise ValueError(f"train, validation and test add up to {total:g}; expected 1")
        return self


class DataSetDescription(Description):
    """A data set as read from TOML.

    Each of the ``scenes`` is the base ``scene`` seen by the base ``sensor`` with values drawn for what ``vary`` names;
    its frames are the images of the scene's motion, or of ``motion`` if it is given. The ``sensor`` is what is
    described to those who measure, ``as_built`` what is rendered, the same unless given. Scene and sensors are given by
    name or path.

    ``vary`` gives a distribution for each path: ``sensor.`` and a path of the sensor's description, which changes what
    is described and what is built; ``as_built.``, which changes only what is built; ``scene.`` and a path of the
    scene's description; ``effects.`` and the name of an effect to add, by its strength (`twin.options.Flaws`); and
    ``frame.exposure``, a factor of the time of exposure that is drawn anew for every frame. Places in lists count from
    0. Numbers that the description counts are rounded.

    ``spp``, ``effects`` and ``without`` are those of `twin.simulate`. ``labels`` are what is stored with each image.
    Files of ``format`` "webdataset" are tar archives, of "hdf5" HDF5 files, each with ``scenes_per_shard`` scenes.
    """

    title: str
    notes: str = ""
    licence: str = "not stated"
    sensor: Sensor = Field(default="thesis", validate_default=True)
    as_built: Sensor | None = None
    motion: AnyMotion | None = None
    scene: Scene
    seed: Annotated[int, Field(ge=0)] = 0
    scenes: Annotated[int, Field(ge=1, le=1_000_000)] = 100
    scenes_per_shard: Annotated[int, Field(ge=1, le=100_000)] = 16
    splits: Splits = Splits()
    spp: Annotated[int, Field(ge=1, le=65536)] = 16
    effects: tuple[str, ...] = ()
    without: tuple[str, ...] = ()
    labels: tuple[Label, ...] = ("centre", "quality", "masks", "sensor")
    format: Literal["webdataset", "hdf5"] = "webdataset"
    vary: dict[str, AnyDistribution] = {}
    _whole: frozenset[str] = PrivateAttr(default=frozenset())

    @field_validator("sensor", "as_built", mode="before")
    @classmethod
    def _sensor_found(cls, value: object) -> object:
        return load_sensor(value) if isinstance(value, str) else value

    @field_validator("scene", mode="before")
    @classmethod
    def _scene_found(cls, value: object) -> object:
        return load_scene(value) if isinstance(value, str) else value

    @field_validator("scene")
    @classmethod
    def _scene_moved(cls, scene: Scene, info: ValidationInfo) -> Scene:
        motion = info.data.get("motion")
        return scene if motion is None else scene.model_copy(update={"motion": motion})

    @model_validator(mode="after")
    def _can_be_drawn(self) -> Self:
        self.options(seed=0)
        whole = set()
        for path, distribution in self.vary.items():
            found = self._base_value(path)
            ends = [distribution.at(share) for share in (1e-3, 0.5)]
            if isinstance(found, int) and not isinstance(found, bool):
                whole.add(path)
            if isinstance(found, float | int) and not all(isinstance(end, float | int) for end in ends):
                raise ValueError(f"vary '{path}' gives {ends[0]!r} in place of the number {found:g}")
        for path in self.vary:
            if path.partition(".")[2] in _ONE_FOR_ALL:
                raise ValueError(f"vary '{path}': all frames of a data set have the same size; make two data sets")
        if "target" in self.labels:
            printed = [thing for thing in self.scene.objects if isinstance(thing, Printed)]
            if not printed:
                raise ValueError("the label 'target' is for scenes with a calibration target: leave it out")
            varied = {path.rpartition(".")[2] for path in self.vary}
            if any(getattr(one, error) for one in printed for error in _PRINT_ERRORS) or varied & set(_PRINT_ERRORS):
                raise ValueError("the label 'target' knows no errors of print, plate and detection: leave them out")
        if EXPOSURE in self.vary and self.scene.motion.moves():
            raise ValueError(f"{EXPOSURE} leaves a moving stage's blur as it is: vary sensor.exposure.laser_ms instead")
        self._whole = frozenset(whole)
        return self

    def frames_per_scene(self) -> int:
        """Images of each scene's motion."""
        return self.scene.motion.images()

    def options(self, *, seed: int, strengths: dict[str, Value] | None = None) -> Options:
        """Options of rendering a scene; ``strengths`` are those drawn of effects to add, by their names."""
        drawn = [f"{name}={value}" for name, value in (strengths or {}).items()]
        return Options(self.spp, seed, Effects().without(*self.without), Flaws.of(*self.effects, *drawn))

    def drawn(self, path: str, share: float) -> Value:
        """The value of a path at a share from 0 to 1 of its distribution, rounded where the description counts."""
        value = self.vary[path].at(share)
        return round(value) if path in self._whole and not isinstance(value, str) else value

    def _base_value(self, path: str) -> Value | None:
        """The value that a path has without being varied; DescriptionError where there is no such path."""
        root, _, rest = path.partition(".")
        if path == EXPOSURE:
            return 1.0
        match root:
            case "sensor":
                return value_at(self.sensor, rest, f"vary '{path}'")
            case "as_built":
                return value_at(self.as_built or self.sensor, rest, f"vary '{path}'")
            case "scene":
                return value_at(self.scene, rest, f"vary '{path}'", called="scene")
            case "effects":
                strength = getattr(Flaws.of(rest), rest.replace("-", "_"))
                if isinstance(strength, bool):
                    raise DescriptionError(f"vary '{path}': {rest} has no strength; name it in effects")
                return strength
            case _:
                known = ", ".join(f"{each}." for each in ROOTS)
                raise DescriptionError(f"vary '{path}': a path begins with {known} or is {EXPOSURE}")


def load_description(
    given: str | Path | DataSetDescription, *, scenes: int | None = None, seed: int | None = None
) -> DataSetDescription:
    """Description of a data set by name (``stripe-clean``) or path; scene and sensors beside it are found by file name.

    ``scenes`` and ``seed`` replace the description's own. DescriptionError where it is not valid.
    """
    if isinstance(given, DataSetDescription):
        path, table = Path("the description"), given.model_dump()
    else:
        path = find(given, FOLDER)
        table = dict(read_table(path, FOLDER))
        for key in ("sensor", "as_built", "scene"):
            beside = path.parent / str(table.get(key, ""))
            if beside.suffix == ".toml" and is_regular_file(beside):
                table[key] = str(beside)
    table |= {key: value for key, value in (("scenes", scenes), ("seed", seed)) if value is not None}
    return validated(DataSetDescription, table, path)
