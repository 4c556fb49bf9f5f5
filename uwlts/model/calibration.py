"""The calibrated sensor: everything reconstruction needs, stored as readable JSON with residuals and provenance."""

from itertools import product
from pathlib import Path
from typing import Annotated, Literal

import numpy as np
from pydantic import (
    AfterValidator,
    Field,
    SerializerFunctionWrapHandler,
    ValidationError,
    model_serializer,
    model_validator,
)

from uwlts.errors import problems_of
from uwlts.files.json_files import write_model
from uwlts.model.brief import Brief
from uwlts.model.joint_estimate import JointEstimate, Origin
from uwlts.model.sensor import Camera, Description, Distortion, Medium, Positive, Table, UnitVector, Vector, Window

FORMAT, VERSION = "uwlts-calibration", 1

_Rows = tuple[tuple[float, float, float, float], ...]


def is_rigid(matrices: np.ndarray, *, within: float) -> bool:
    """Whether matrices (..., 4, 4) are rotations, not reflections, with a shift, their elements ``within`` that."""
    rotation = matrices[..., :3, :3]
    if not (np.abs(rotation) < 2).all():
        return False
    square = np.allclose(rotation @ np.swapaxes(rotation, -1, -2), np.eye(3), atol=within)
    last = np.allclose(matrices[..., 3, :], (0, 0, 0, 1), atol=within)
    return square and last and bool((np.linalg.det(rotation) > 0).all())


def rigid_transform(rotation: np.ndarray, shift: np.ndarray) -> np.ndarray:
    """Matrix (4, 4) of a rotation (3, 3) and a shift (3,)."""
    result = np.eye(4)
    result[:3, :3], result[:3, 3] = rotation, shift
    return result


def _rigid(matrix: _Rows) -> _Rows:
    """A matrix (4, 4) that is a rotation, not a reflection, and a shift, to 1e-6, as text may be rounded."""
    if len(matrix) == 4 and is_rigid(np.array(matrix), within=1e-6):
        return matrix
    raise ValueError("must be a 4x4 rigid transform: a rotation, a shift, and 0 0 0 1")


def _with_numbers(figures: Table) -> Table:
    """Figures of a step of which those that commands print and plot, where they are given, are numbers."""
    for name in ("rms_px", "rms_mm", "max_mm", "std_mm"):
        if not isinstance(value := figures.get(name), int | float | None):
            raise ValueError(f"{name} is {value!r}; expected a number")
    return figures


def _numbers_in(figures: object) -> dict[str, float]:
    """The finite numbers among figures by their names; none where there are no figures."""
    known = figures.items() if isinstance(figures, dict) else ()
    return {name: value for name, value in known if isinstance(value, int | float) and np.isfinite(value)}


def _with_origin(provenance: Table) -> Table:
    """A provenance from which `Calibration.origin` can be read."""
    try:
        Origin.model_validate(provenance)
    except ValidationError as error:
        raise ValueError(problems_of(error)) from error
    return provenance


RigidTransform = Annotated[_Rows, AfterValidator(_rigid)]
Residuals = dict[str, Annotated[Table, AfterValidator(_with_numbers)]]
"""Named figures of each step of a calibration."""


class CameraModel(Description):
    """Pinhole with Brown-Conrady distortion, as OpenCV has it; pixel (0, 0) is the centre of the first pixel."""

    width_px: Annotated[int, Field(gt=0)]
    height_px: Annotated[int, Field(gt=0)]
    fx_px: Positive
    fy_px: Positive
    cx_px: float
    cy_px: float
    distortion: Distortion = Distortion()

    @classmethod
    def described(cls, camera: Camera, *, magnified: float = 1.0) -> "CameraModel":
        """A camera as described; with a focal length ``magnified`` by refraction the distortion is not known: zero."""
        (fx, fy), (cx, cy) = camera.focal_lengths_px(), camera.principal_point()
        size = {"width_px": camera.width_px, "height_px": camera.height_px}
        distortion = camera.distortion if magnified == 1.0 else Distortion()
        return cls(**size, fx_px=fx * magnified, fy_px=fy * magnified, cx_px=cx, cy_px=cy, distortion=distortion)

    def matrix(self) -> np.ndarray:
        """Camera matrix K (3, 3)."""
        return np.array([[self.fx_px, 0, self.cx_px], [0, self.fy_px, self.cy_px], [0, 0, 1.0]])

    def parameters(self) -> dict[str, float]:
        """All parameters by their names; f, where the pixels' shape is known, is fx."""
        f = {"f": self.fx_px, "fx": self.fx_px, "fy": self.fy_px}
        return f | {"cx": self.cx_px, "cy": self.cy_px} | self.distortion.model_dump()

    def coefficients(self) -> np.ndarray:
        """Distortion coefficients (8,) in OpenCV's order k1 k2 p1 p2 k3 k4 k5 k6."""
        return np.array(list(self.distortion.model_dump().values()))


class WindowModel(Description):
    """The camera's window as the reconstruction sees it, in the camera frame.

    ``refractions`` is 2 for a pane of glass (air, glass, medium), 1 for a single interface between air and medium, as
    in the thesis's first model; then thickness and glass index are not used. ``distance_mm`` runs along the camera's
    axis from the entrance pupil to the inner face (or to the single interface).
    """

    refractions: Literal[1, 2]
    distance_mm: Positive
    normal: UnitVector = (0.0, 0.0, 1.0)
    thickness_mm: Annotated[float, Field(ge=0)] = 0.0
    glass_index: Annotated[float, Field(ge=1, lt=4)] = 1.0

    @classmethod
    def described(cls, window: Window, wavelength_nm: float, *, refractions: Literal[1, 2] = 2) -> "WindowModel":
        """A window as described, for light of a wavelength: a pane of glass, or one interface."""
        x, y, z = window.normal().tolist()
        model = cls(refractions=refractions, distance_mm=window.distance_mm, normal=(x, y, z))
        if refractions == 1:
            return model
        glass = {"thickness_mm": window.thickness_mm, "glass_index": window.index(wavelength_nm)}
        return model.model_copy(update=glass)


class FanModel(Description):
    """Departure of the laser sheet from a plane, and the laser's window, in the camera frame.

    The fan begins at ``apex_mm`` and runs along the unit vector ``axis``. A beam that enters the line optics tilted by
    the angle ``bow_rad`` gives a cone rather than a plane. The normal of the laser's window is turned by
    ``window_turn_rad`` against the sheet, about axis x normal, so that a medium turns the sheet about ``pivot_mm``.
    """

    apex_mm: Vector
    axis: UnitVector
    pivot_mm: Vector
    bow_rad: float = 0.0
    window_turn_rad: float = 0.0


class SheetModel(Description):
    """The laser sheet in the camera frame: in air, without bow, the points x with ``normal . x = offset_mm``.

    Without a ``fan`` it is that plane in every medium; `uwlts.optics.sheet` says what it is with one.
    """

    normal: UnitVector
    offset_mm: float
    fan: FanModel | None = None


class KnownMedium(Description):
    """A medium as captures describe it, and the refractive index that its calibration found."""

    medium: Medium
    index: Annotated[float, Field(ge=1, lt=2)]


class KnownStage(Description):
    """A stage by the direction in which captures say it moves the sensor, and the one found, both in the OCS."""

    described: Vector
    direction: Vector


class CalibrationStd(Description):
    """Standard uncertainties of the parameters of a calibration; None for those that were not estimated, or not alone.

    A single focal length for square pixels gives both ``fx_px`` and ``fy_px``. ``distortion`` is by the names of the
    coefficients.
    """

    fx_px: float | None = None
    fy_px: float | None = None
    cx_px: float | None = None
    cy_px: float | None = None
    distortion: dict[str, float] = {}
    sheet_normal_deg: float | None = None
    window_distance_mm: float | None = None


class Calibration(Brief, Description):
    """A calibrated sensor.

    ``window`` is None where none stands in the light's way, or where its effect was left to focal length and
    distortion. Without a window the calibration holds in the kind of medium in which the target was seen,
    ``medium_kind``; in water that is the approximation of a single viewpoint. With a window it holds in all media, and
    ``medium_kind`` is that of the target, or of a `uwlts.nominal` calibration that of the sheet.
    ``camera_from_object`` is the 4x4 matrix ``T_camera_object`` of the OCS: X normal to the sheet, Z along the laser's
    axis, Y along the stripe.
    ``stripe_along`` is as in the sensor description. ``media`` are those of the evidence: in just these the index
    found replaces the one that follows from the description. ``stages`` are those whose direction was found.
    ``residuals`` are named figures of each step, ``provenance`` what the calibration was made from. ``joint`` is the
    joint estimate where there is one; in the file it is among the residuals.
    """

    sensor_name: str
    stripe_along: Literal["width", "height"]
    wavelength_nm: Positive
    medium_kind: Literal["air", "fresh", "sea", "custom"] = "air"
    camera: CameraModel
    window: WindowModel | None
    sheet: SheetModel
    camera_from_object: RigidTransform
    media: tuple[KnownMedium, ...] = ()
    stages: tuple[KnownStage, ...] = ()
    residuals: Residuals = {}
    provenance: Annotated[Table, AfterValidator(_with_origin)] = {}
    joint: JointEstimate | None = None

    @model_validator(mode="before")
    @classmethod
    def _from_file(cls, content: object) -> object:
        if not isinstance(content, dict):
            return content
        residuals = content.get("residuals")
        if not (isinstance(residuals, dict) and "joint" in residuals):
            return content
        figures = {key: each for key, each in residuals.items() if key != "joint"}
        return content | {"residuals": figures, "joint": residuals["joint"]}

    @model_serializer(mode="wrap")
    def _into_file(self, handler: SerializerFunctionWrapHandler) -> Table:
        content = handler(self) | {"residuals": self.residuals_in_file()}
        del content["joint"]
        return content

    def residuals_in_file(self) -> Table:
        """The residuals as files have them, the joint estimate among them as plain JSON."""
        if self.joint is None:
            return {**self.residuals}
        # After the camera's figures, as files have always had it, so that digests stay.
        figures = list(self.residuals.items())
        place = 1 + next((number for number, (key, _) in enumerate(figures) if key == "camera"), -1)
        return dict([*figures[:place], ("joint", self.joint.in_file()), *figures[place:]])

    def save(self, path: str | Path, *, overwrite: bool = False) -> None:
        """Write the calibration as JSON, whole or not at all; OutputError if that fails."""
        write_model(path, self, format=FORMAT, version=VERSION, overwrite=overwrite)

    def figures(self, step: str) -> Table:
        """Figures of a step among the residuals; none where there are none of it."""
        return self.residuals.get(step, {})

    def std(self) -> CalibrationStd:
        """Standard uncertainties of camera, sheet and window as far as the calibration states them."""
        camera = _numbers_in(self.figures("camera").get("std"))
        focal = camera.pop("f", None)
        known: Table = {f"{name}_px": camera.pop(name, focal) for name in ("fx", "fy")}
        known |= {f"{name}_px": camera.pop(name, None) for name in ("cx", "cy")}
        others = {
            "distortion": camera,
            "sheet_normal_deg": _numbers_in(self.figures("sheet")).get("normal_std_deg"),
            "window_distance_mm": _numbers_in(self.figures("window")).get("std_mm"),
        }
        return CalibrationStd.model_validate(known | others)

    def origin(self) -> Origin:
        """Evidence that the calibration was made from, by its provenance."""
        return Origin.model_validate(self.provenance)

    def index_of(self, medium: Medium) -> float:
        """Refractive index of a medium at the laser's wavelength, as last calibrated where it was; else RangeError."""
        known = next((found.index for found in reversed(self.media) if found.medium == medium), None)
        return medium.refractive_index(self.wavelength_nm) if known is None else known

    def stage_direction_of(self, described: Vector) -> Vector:
        """Unit direction in the OCS of a stage that is described so, or as going back, as calibrated where it was."""
        if (found := self.stage_of(described)) is None:
            return described
        (x, y, z), forth = found[0].direction, found[1]
        return (x, y, z) if forth else (-x, -y, -z)

    def stage_of(self, described: Vector) -> tuple[KnownStage, bool] | None:
        """The stage that was calibrated along a direction of the OCS, and whether it goes that way or back."""
        for stage, forth in product(self.stages, (True, False)):
            if np.allclose(stage.described, np.array(described) * (1 if forth else -1)):
                return stage, forth
        return None

    def object_transform(self) -> np.ndarray:
        """``T_camera_object`` as an array (4, 4)."""
        return np.array(self.camera_from_object)
