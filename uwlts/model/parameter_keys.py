"""Keys of the parameters of a joint estimate: what each is, its unit, how it is shown, and its text in files."""

from dataclasses import dataclass
from enum import Enum
from typing import Annotated, get_args

import numpy as np
from pydantic import PlainSerializer, PlainValidator

_DEG = float(np.degrees(1.0))


@dataclass(frozen=True)
class ParameterLabel:
    """A parameter in words, its unit as shown, and the factor from the estimate's unit to that one.

    Slopes are shown as angles: at 1 deg that is right to a part in 10 000.
    """

    words: str
    unit: str = ""
    factor: float = 1.0

    def format_value(self, value: float, std: float) -> str:
        """A value of the estimate in the unit shown, to the digits that its standard uncertainty leaves."""
        digits = max(0, int(np.ceil(1 - np.log10(self.factor * std))))
        return f"{self.factor * value:.{digits}f}"

    def format_with_std(self, value: float, std: float) -> str:
        """The same with the standard uncertainty and the unit."""
        return f"{self.format_value(value, std)} +- {self.factor * std:.2g}{self.unit and ' '}{self.unit}"


class _SingleParameter(Enum):
    """Base of the kinds of which an estimate has at most one of each."""

    text: str
    quantity: ParameterLabel

    def __init__(self, text: str, words: str, unit: str = "", factor: float = 1.0):
        self.text = text
        self.quantity = ParameterLabel(words, unit, factor)


class LensParameter(_SingleParameter):
    """Parameters of the camera's lens; ``F`` stands for ``FX`` and ``FY`` where pixels are square."""

    F = "f", "focal length", "px"
    FX = "fx", "focal length along the rows", "px"
    FY = "fy", "focal length along the columns", "px"
    CX = "cx", "column of the principal point", "px"
    CY = "cy", "row of the principal point", "px"
    K1 = "k1", "distortion k1"
    K2 = "k2", "distortion k2"
    P1 = "p1", "distortion p1"
    P2 = "p2", "distortion p2"
    K3 = "k3", "distortion k3"
    K4 = "k4", "distortion k4"
    K5 = "k5", "distortion k5"
    K6 = "k6", "distortion k6"


class WindowParameter(_SingleParameter):
    """Parameters of the camera's window; its normal runs along (``SLOPE_X``, ``SLOPE_Y``, 1)."""

    DISTANCE = "window_distance", "window distance", "mm"
    SLOPE_X = "window_slope_x", "window tilt to the right", "°", _DEG
    SLOPE_Y = "window_slope_y", "window tilt downwards", "°", _DEG
    THICKNESS = "glass_thickness", "thickness of the window's glass", "mm"
    GLASS_INDEX = "glass_index", "index of the window's glass"


class SheetParameter(_SingleParameter):
    """Parameters of the laser sheet: turns of its normal in rad, shift in mm, numbers of `FanModel`."""

    TURN_FAN = "sheet_turn_fan", "turn of the sheet about its fan's direction", "°", _DEG
    TURN_AXIS = "sheet_turn_axis", "turn of the sheet about the laser's axis", "°", _DEG
    OFFSET = "sheet_offset", "offset of the sheet", "mm"
    BOW = "sheet_bow", "bow of the sheet", "°", _DEG
    WINDOW_TURN = "laser_window_turn", "turn of the laser's window", "°", _DEG


class StageParameter(_SingleParameter):
    """Relative error of the stage's scale; slopes of a scan's direction towards two directions across it."""

    SCALE = "stage_scale", "scale of the stage", "µm/m", 1e6
    SLOPE_1 = "scan_slope_1", "lean of the scan's direction (X towards Y)", "°", _DEG
    SLOPE_2 = "scan_slope_2", "lean of the scan's direction (X towards Z)", "°", _DEG


class TargetParameter(_SingleParameter):
    """Errors of the target: bends in mm, as a dish at its corners, and as a saddle twice that of the middles of the
    sides that its x axis crosses; relative stretch along x and y; shift of the stripe on it in px, as by gloss.
    """

    BOW = "target_bow", "bend of the target", "µm", 1e3
    SADDLE = "target_saddle", "saddle of the target", "µm", 1e3
    STRETCH_X = "target_stretch_x", "stretch of the target along its rows", "µm/m", 1e6
    STRETCH_Y = "target_stretch_y", "stretch of the target along its columns", "µm/m", 1e6
    STRIPE = "target_stripe", "shift of the stripe on the target", "px"


_INDEX_OF, _HEIGHT_OF, _STEP = "index of ", "height of the ", " mm step"


@dataclass(frozen=True)
class MediumIndex:
    """Refractive index of a medium, by the medium's name, relative to air."""

    medium: str

    @property
    def text(self) -> str:
        """The parameter in files."""
        return f"{_INDEX_OF}{self.medium}"

    @property
    def quantity(self) -> ParameterLabel:
        """The parameter as it is shown."""
        return ParameterLabel(self.text)


@dataclass(frozen=True)
class StepHeight:
    """Height in mm of a step standard, by its nominal height to six digits, as files have it."""

    nominal_mm: float

    def __post_init__(self) -> None:
        object.__setattr__(self, "nominal_mm", float(f"{self.nominal_mm:g}"))

    @property
    def text(self) -> str:
        """The parameter in files."""
        return f"{_HEIGHT_OF}{self.nominal_mm:g}{_STEP}"

    @property
    def quantity(self) -> ParameterLabel:
        """Name that the parameter is shown by."""
        return ParameterLabel(self.text, "mm")


SingleParameter = LensParameter | WindowParameter | SheetParameter | StageParameter | TargetParameter
ParameterKey = SingleParameter | MediumIndex | StepHeight

_SINGLE: dict[str, SingleParameter] = {key.text: key for kind in get_args(SingleParameter) for key in kind}


def parameter_of(text: str) -> ParameterKey:
    """The parameter that a file means by a text; ValueError where there is none."""
    if text in _SINGLE:
        return _SINGLE[text]
    if text.startswith(_INDEX_OF):
        return MediumIndex(text.removeprefix(_INDEX_OF))
    if text.startswith(_HEIGHT_OF) and text.endswith(_STEP):
        return StepHeight(float(text.removeprefix(_HEIGHT_OF).removesuffix(_STEP)))
    raise ValueError(f"there is no parameter {text!r}")


def _decoded(value: object) -> ParameterKey:
    if not isinstance(value, ParameterKey | str):
        raise ValueError(f"a parameter is given by its text, not by {value!r}")
    return parameter_of(value) if isinstance(value, str) else value


ParameterInFile = Annotated[ParameterKey, PlainValidator(_decoded), PlainSerializer(lambda key: key.text)]
"""A parameter as a field of a pydantic model: a text in the file, a key in the program."""
