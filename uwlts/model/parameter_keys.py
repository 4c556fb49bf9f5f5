"""Keys of the parameters of a joint estimate, with description, unit and text in files."""

from dataclasses import dataclass
from enum import Enum
from typing import Annotated, get_args

import numpy as np
from pydantic import PlainSerializer, PlainValidator

_DEG = float(np.degrees(1.0))


@dataclass(frozen=True)
class ParameterLabel:
    """Description of a parameter, its displayed unit, and the factor from the estimate's unit to the displayed one.

    Slopes are displayed as angles; at 1 deg, the error is 1 in 10 000.
    """

    words: str
    unit: str = ""
    factor: float = 1.0

    def format_value(self, value: float, std: float) -> str:
        """Format a value of the estimate in the displayed unit, with the significant digits of its uncertainty."""
        digits = max(0, int(np.ceil(1 - np.log10(self.factor * std))))
        return f"{self.factor * value:.{digits}f}"

    def format_with_std(self, value: float, std: float) -> str:
        """Format a value with its standard uncertainty and unit."""
        return f"{self.format_value(value, std)} +- {self.factor * std:.2g}{self.unit and ' '}{self.unit}"


class _SingleParameter(Enum):
    """Base of the kinds with a fixed list of parameters, each at most once in an estimate."""

    text: str
    quantity: ParameterLabel

    def __init__(self, text: str, label: str, unit: str = "", factor: float = 1.0):
        self.text = text
        self.quantity = ParameterLabel(label, unit, factor)


class LensParameter(_SingleParameter):
    """Parameters of the camera's lens; ``F`` replaces ``FX`` and ``FY`` for square pixels."""

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
    """Parameters of the camera's window; its normal is parallel to (``SLOPE_X``, ``SLOPE_Y``, 1)."""

    DISTANCE = "window_distance", "window distance", "mm"
    SLOPE_X = "window_slope_x", "window tilt to the right", "°", _DEG
    SLOPE_Y = "window_slope_y", "window tilt downwards", "°", _DEG
    THICKNESS = "glass_thickness", "thickness of the window's glass", "mm"
    GLASS_INDEX = "glass_index", "index of the window's glass"


class SheetParameter(_SingleParameter):
    """Parameters of the laser sheet: rotations of its normal in rad, offset in mm, and angles of `FanModel`."""

    TURN_FAN = "sheet_turn_fan", "turn of the sheet about its fan's direction", "°", _DEG
    TURN_AXIS = "sheet_turn_axis", "turn of the sheet about the laser's axis", "°", _DEG
    OFFSET = "sheet_offset", "offset of the sheet", "mm"
    BOW = "sheet_bow", "bow of the sheet", "°", _DEG
    WINDOW_TURN = "laser_window_turn", "turn of the laser's window", "°", _DEG


class StageParameter(_SingleParameter):
    """Parameters of the stage: relative scale error, and slopes of a scan's direction towards two other axes."""

    SCALE = "stage_scale", "scale of the stage", "µm/m", 1e6
    SLOPE_1 = "scan_slope_1", "lean of the scan's direction (X towards Y)", "°", _DEG
    SLOPE_2 = "scan_slope_2", "lean of the scan's direction (X towards Z)", "°", _DEG


class TargetParameter(_SingleParameter):
    """Errors of the target.

    ``BOW`` is the deviation of the corners in mm for a bowl shape. ``SADDLE`` is twice the deviation in mm of the
    midpoints of the sides that the x axis crosses, for a saddle shape. ``TWIST`` is the deviation of the corners of a
    square target in mm for a saddle turned by 45 degrees. ``STRETCH_X`` and ``STRETCH_Y`` are relative.
    ``STRIPE`` is the shift of the stripe in px, caused for example by gloss.
    """

    BOW = "target_bow", "bend of the target", "µm", 1e3
    SADDLE = "target_saddle", "saddle of the target", "µm", 1e3
    TWIST = "target_twist", "twist of the target", "µm", 1e3
    STRETCH_X = "target_stretch_x", "stretch of the target along its rows", "µm/m", 1e6
    STRETCH_Y = "target_stretch_y", "stretch of the target along its columns", "µm/m", 1e6
    STRIPE = "target_stripe", "shift of the stripe on the target", "px"


_INDEX_OF, _HEIGHT_OF, _STEP = "index of ", "height of the ", " mm step"


@dataclass(frozen=True)
class MediumIndex:
    """Refractive index of a named medium, relative to air."""

    medium: str

    @property
    def text(self) -> str:
        """Text of the parameter in files."""
        return f"{_INDEX_OF}{self.medium}"

    @property
    def quantity(self) -> ParameterLabel:
        """Label of the parameter."""
        return ParameterLabel(self.text)


@dataclass(frozen=True)
class StepHeight:
    """Height in mm of a step standard, identified by its nominal height to six digits, as in files."""

    nominal_mm: float

    def __post_init__(self) -> None:
        object.__setattr__(self, "nominal_mm", float(f"{self.nominal_mm:g}"))

    @property
    def text(self) -> str:
        """Text of the parameter in files."""
        return f"{_HEIGHT_OF}{self.nominal_mm:g}{_STEP}"

    @property
    def quantity(self) -> ParameterLabel:
        """Label of the parameter."""
        return ParameterLabel(self.text, "mm")


SingleParameter = LensParameter | WindowParameter | SheetParameter | StageParameter | TargetParameter
ParameterKey = SingleParameter | MediumIndex | StepHeight

_SINGLE: dict[str, SingleParameter] = {key.text: key for kind in get_args(SingleParameter) for key in kind}


def parse_parameter(text: str) -> ParameterKey:
    """Return the parameter with a text in files; ValueError if there is none."""
    if text in _SINGLE:
        return _SINGLE[text]
    if text.startswith(_INDEX_OF):
        return MediumIndex(text.removeprefix(_INDEX_OF))
    if text.startswith(_HEIGHT_OF) and text.endswith(_STEP):
        return StepHeight(float(text.removeprefix(_HEIGHT_OF).removesuffix(_STEP)))
    raise ValueError(f"unknown parameter {text!r}")


def _decode(value: object) -> ParameterKey:
    if not isinstance(value, ParameterKey | str):
        raise ValueError(f"a parameter is {value!r}; expected its text")
    return parse_parameter(value) if isinstance(value, str) else value


ParameterInFile = Annotated[ParameterKey, PlainValidator(_decode), PlainSerializer(lambda key: key.text)]
"""Parameter as a field of a pydantic model: a text in files, a key in the program."""
