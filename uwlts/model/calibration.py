"""Calibrations of a sensor for reconstruction, by models or by polynomials, stored as JSON with their residuals."""

import hashlib
import json
import weakref
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

from uwlts.argument_types import check_arguments
from uwlts.errors import describe_problems
from uwlts.files.json_files import add_seal, numbers_in, write_model
from uwlts.files.writing import require_ending, write_file
from uwlts.model.joint_estimate import JointEstimate, Origin
from uwlts.model.parameter_keys import SheetParameter
from uwlts.model.sensor import (
    Camera,
    Description,
    Distortion,
    Medium,
    Positive,
    RigidTransform,
    Rows,
    Table,
    UnitVector,
    Vector,
    Window,
)
from uwlts.model.short_text import Brief

FORMAT, POLYNOMIALS_FORMAT, VERSION = "uwlts-calibration", "uwlts-polynomials", 1
_Pair = tuple[float, float]


def rigid_transform(rotation: np.ndarray, shift: np.ndarray) -> np.ndarray:
    """Return the matrix (4, 4) of a rotation (3, 3) and a translation (3,)."""
    result = np.eye(4)
    result[:3, :3], result[:3, 3] = rotation, shift
    return result


def _check_figures(figures: Table) -> Table:
    """Raise ValueError unless the figures that commands print and plot are numbers or missing."""
    for name in ("rms_px", "rms_mm", "max_mm", "std_mm"):
        if not isinstance(value := figures.get(name), int | float | None):
            raise ValueError(f"{name} is {value!r}; expected a number")
    return figures


def _check_provenance(provenance: Table) -> Table:
    """Raise ValueError unless `Calibration.origin` can read the provenance."""
    try:
        Origin.model_validate(provenance)
    except ValidationError as error:
        raise ValueError(describe_problems(error)) from error
    return provenance


Residuals = dict[str, Annotated[Table, AfterValidator(_check_figures)]]
"""Named figures of each step of a calibration."""


class CameraModel(Description):
    """Pinhole camera with OpenCV's distortion model; pixel (0, 0) is the centre of the first pixel."""

    width_px: Annotated[int, Field(gt=0)]
    height_px: Annotated[int, Field(gt=0)]
    fx_px: Positive
    fy_px: Positive
    cx_px: float
    cy_px: float
    distortion: Distortion = Distortion()

    @classmethod
    def from_description(cls, camera: Camera, *, magnified: float = 1.0) -> "CameraModel":
        """Return the described camera; refraction multiplies its focal length by ``magnified``.

        If the focal length is magnified, the distortion is unknown and set to zero.
        """
        (fx, fy), (cx, cy) = camera.focal_lengths_px(), camera.principal_point()
        size = {"width_px": camera.width_px, "height_px": camera.height_px}
        distortion = camera.distortion if magnified == 1.0 else Distortion()
        return cls(**size, fx_px=fx * magnified, fy_px=fy * magnified, cx_px=cx, cy_px=cy, distortion=distortion)

    def matrix(self) -> np.ndarray:
        """Return the camera matrix K (3, 3)."""
        return np.array([[self.fx_px, 0, self.cx_px], [0, self.fy_px, self.cy_px], [0, 0, 1.0]])

    def parameters(self) -> dict[str, float]:
        """Return all parameters by name; f equals fx, for a known pixel aspect."""
        f = {"f": self.fx_px, "fx": self.fx_px, "fy": self.fy_px}
        return f | {"cx": self.cx_px, "cy": self.cy_px} | self.distortion.model_dump()

    def coefficients(self) -> np.ndarray:
        """Return the distortion coefficients (8,) in OpenCV's order k1 k2 p1 p2 k3 k4 k5 k6."""
        return np.array(list(self.distortion.model_dump().values()))


class WindowModel(Description):
    """Model of the camera's window for reconstruction, in the camera frame.

    ``refractions`` is 2 for a pane of glass (air, glass, medium). It is 1 for a single interface between air and medium
    (the thesis's first model), which ignores thickness and glass index. ``distance_mm`` is measured along the camera's
    axis from the entrance pupil to the inner face or the single interface.
    """

    refractions: Literal[1, 2]
    distance_mm: Positive
    normal: UnitVector = (0.0, 0.0, 1.0)
    thickness_mm: Annotated[float, Field(ge=0)] = 0.0
    glass_index: Annotated[float, Field(ge=1, lt=4)] = 1.0

    @classmethod
    def from_description(cls, window: Window, wavelength_nm: float, *, refractions: Literal[1, 2] = 2) -> "WindowModel":
        """Return a window as described, for a wavelength: a pane of glass, or a single interface."""
        x, y, z = window.normal().tolist()
        model = cls(refractions=refractions, distance_mm=window.distance_mm, normal=(x, y, z))
        if refractions == 1:
            return model
        glass = {"thickness_mm": window.thickness_mm, "glass_index": window.index(wavelength_nm)}
        return model.model_copy(update=glass)


class FanModel(Description):
    """Deviation of the laser sheet from a plane, and the laser's window, in the camera frame.

    The fan starts at ``apex_mm`` and runs along the unit vector ``axis``. A beam with a tilt ``bow_rad`` at the line
    optics gives a cone instead of a plane. The normal of the laser's window is turned by ``window_turn_rad`` out of the
    sheet, about axis x normal. Refraction at the window therefore turns the sheet about ``pivot_mm``.
    """

    apex_mm: Vector
    axis: UnitVector
    pivot_mm: Vector
    bow_rad: float = 0.0
    window_turn_rad: float = 0.0


class SheetModel(Description):
    """Laser sheet in the camera frame: in air and without bow, the plane ``normal . x = offset_mm``.

    Without a ``fan``, the sheet is this plane in every medium; `uwlts.optics.triangulation` describes the sheet with a
    fan.
    """

    normal: UnitVector
    offset_mm: float
    fan: FanModel | None = None


class KnownMedium(Description):
    """Medium as described in captures, and its calibrated refractive index."""

    medium: Medium
    index: Annotated[float, Field(ge=1, lt=2)]


class KnownStage(Description):
    """Stage direction as described in captures, and the calibrated direction, both in the OCS."""

    described: Vector
    direction: Vector


class CalibrationStd(Description):
    """Standard uncertainties of a calibration's parameters; None if a parameter was not estimated individually.

    ``fx_px`` and ``fy_px`` are equal if a single focal length was estimated. ``distortion`` has the coefficients' names
    as keys.
    """

    fx_px: float | None = None
    fy_px: float | None = None
    cx_px: float | None = None
    cy_px: float | None = None
    distortion: dict[str, float] = {}
    sheet_normal_deg: float | None = None
    window_distance_mm: float | None = None


class Calibration(Brief, Description):
    """Calibrated sensor.

    ``window`` is None if no window is mounted, or if focal length and distortion approximate its effect (a single
    viewpoint). Without a window, the calibration is valid only in the kind of medium around the target,
    ``medium_kind``. With a window, it is valid in all media. A calibration by `uwlts.nominal` has the kind and the
    name, ``medium_name``, of the medium that was asked for.

    ``camera_from_object`` is the 4x4 matrix ``T_camera_object`` of the OCS: X normal to the sheet, Z along the laser's
    axis, Y along the stripe. ``stripe_along`` is as in the sensor description. ``media`` are the media of the evidence
    with their calibrated indices, which replace the described ones. ``stages`` are stages with a calibrated direction.
    ``residuals`` contains the figures of each calibration step, and ``provenance`` the sources. ``joint`` is the joint
    estimate, if there is one; the file stores it among the residuals.
    """

    sensor_name: str
    stripe_along: Literal["width", "height"]
    wavelength_nm: Positive
    medium_kind: Literal["air", "fresh", "sea", "custom"] = "air"
    medium_name: str | None = None
    camera: CameraModel
    window: WindowModel | None
    sheet: SheetModel
    camera_from_object: RigidTransform
    media: tuple[KnownMedium, ...] = ()
    stages: tuple[KnownStage, ...] = ()
    residuals: Residuals = {}
    provenance: Annotated[Table, AfterValidator(_check_provenance)] = {}
    joint: JointEstimate | None = None

    @model_validator(mode="before")
    @classmethod
    def _convert_from_file(cls, content: object) -> object:
        if not isinstance(content, dict):
            return content
        residuals = content.get("residuals")
        if not (isinstance(residuals, dict) and "joint" in residuals):
            return content
        figures = {key: each for key, each in residuals.items() if key != "joint"}
        return content | {"residuals": figures, "joint": residuals["joint"]}

    @model_serializer(mode="wrap")
    def _convert_to_file(self, handler: SerializerFunctionWrapHandler) -> Table:
        content = handler(self) | {"residuals": self.residuals_in_file()}
        del content["joint"]
        if self.medium_name is None:
            del content["medium_name"]  # as in older files, so that their digests do not change
        return content

    def residuals_in_file(self) -> Table:
        """Return the residuals as plain JSON for files, including the joint estimate."""
        if self.joint is None:
            return {**self.residuals}
        # The joint estimate follows the camera's figures, as in older files, so that digests do not change.
        figures = list(self.residuals.items())
        place = 1 + next((number for number, (key, _) in enumerate(figures) if key == "camera"), -1)
        return dict([*figures[:place], ("joint", self.joint.in_file()), *figures[place:]])

    @check_arguments
    def save(self, path: str | Path, *, overwrite: bool = False) -> None:
        """Write the calibration as JSON, completely or not at all; OutputError if that fails."""
        write_model(path, self, file_format=FORMAT, version=VERSION, overwrite=overwrite)

    def figures(self, step: str) -> Table:
        """Return the figures of a calibration step; an empty table if there are none."""
        return self.residuals.get(step, {})

    def std(self) -> CalibrationStd:
        """Return the stated standard uncertainties of camera, sheet and window."""
        camera = numbers_in(self.figures("camera").get("std"))
        focal = camera.pop("f", None)
        known: Table = {f"{name}_px": camera.pop(name, focal) for name in ("fx", "fy")}
        known |= {f"{name}_px": camera.pop(name, None) for name in ("cx", "cy")}
        others = {
            "distortion": camera,
            "sheet_normal_deg": self._find_sheet_normal_std_deg(),
            "window_distance_mm": numbers_in(self.figures("window")).get("std_mm"),
        }
        return CalibrationStd.model_validate(known | others)

    def _find_sheet_normal_std_deg(self) -> float | None:
        """Return the largest standard uncertainty of the direction of the sheet's normal, deg."""
        turns = SheetParameter.TURN_FAN, SheetParameter.TURN_AXIS  # about two orthogonal axes in the sheet
        if self.joint is None or not set(turns) <= set(self.joint.parameters):
            return numbers_in(self.figures("sheet")).get("normal_std_deg")
        places = [self.joint.parameters.index(turn) for turn in turns]
        covariance = self.joint.covariance_matrix()[np.ix_(places, places)]
        return float(np.degrees(np.sqrt(np.linalg.eigvalsh(covariance)[-1])))

    def origin(self) -> Origin:
        """Return the evidence of the calibration, from its provenance."""
        return Origin.model_validate(self.provenance)

    def medium_index(self, medium: Medium) -> float:
        """Return the index of a medium at the laser's wavelength, calibrated or from its description.

        Raises RangeError if the description is outside the formula's range.
        """
        known = next((found.index for found in reversed(self.media) if found.medium == medium), None)
        return medium.refractive_index(self.wavelength_nm) if known is None else known

    def stage_direction_of(self, described: Vector) -> Vector:
        """Return the unit direction in the OCS of a stage with a described direction, calibrated if it was."""
        if (found := self.stage_of(described)) is None:
            return described
        (x, y, z), forth = found[0].direction, found[1]
        return (x, y, z) if forth else (-x, -y, -z)

    def stage_of(self, described: Vector) -> tuple[KnownStage, bool] | None:
        """Return the calibrated stage of a described direction, and whether its sign is the same or opposite."""
        for stage, forth in product(self.stages, (True, False)):
            if np.allclose(stage.described, np.array(described) * (1 if forth else -1)):
                return stage, forth
        return None

    def object_transform(self) -> np.ndarray:
        """Return ``T_camera_object`` as an array (4, 4)."""
        return np.array(self.camera_from_object)


class PolynomialCalibration(Brief, Description):
    """Sensor calibrated by polynomials for each line: stripe position to Z, and Z to Y (thesis section 4.7).

    The calibration is valid only in its own medium, with the same window, and within the range of its evidence.

    Both Legendre polynomials of a line have the degree ``degree``. ``depth_coefficients`` (Z of position) and
    ``along_coefficients`` (Y of Z) have one row of coefficients in mm for each line; the first row belongs to
    ``first_line``. In all lines, the arguments -1 to 1 correspond to ``position_range_px`` (stripe position) and
    ``depth_range_mm`` (Z in the OCS). ``domains_px`` is the calibrated range of stripe positions of each line, None for
    a line without calibration.
    """

    sensor_name: str
    stripe_along: Literal["width", "height"]
    wavelength_nm: Positive
    medium_name: str
    medium: Medium
    window_mounted: bool
    width_px: Annotated[int, Field(gt=0)]
    height_px: Annotated[int, Field(gt=0)]
    degree: Annotated[int, Field(ge=1)]
    first_line: Annotated[int, Field(ge=0)]
    position_range_px: _Pair
    depth_range_mm: _Pair
    domains_px: tuple[_Pair | None, ...]
    depth_coefficients: Rows
    along_coefficients: Rows
    residuals: Residuals = {}
    provenance: Table = {}

    @property
    def joint(self) -> None:
        """Always None: polynomials come without a joint estimate."""

    @model_validator(mode="after")
    def _check_consistency(self) -> "PolynomialCalibration":
        count, lines = len(self.domains_px), self.width_px if self.stripe_along == "width" else self.height_px
        if not 0 < count <= lines - self.first_line:
            raise ValueError(f"{count} lines from line {self.first_line} on do not fit an image of {lines} lines")
        for name in ("depth_coefficients", "along_coefficients"):
            if [*map(len, getattr(self, name))] != [self.degree + 1] * count:
                expected = f"{count} rows of {self.degree + 1} numbers"
                raise ValueError(f"{name} must have {expected}, as domains_px and degree")
        for name in ("position_range_px", "depth_range_mm"):
            low, high = getattr(self, name)
            if not low < high:
                raise ValueError(f"{name} must increase; found {low:g} to {high:g}")
        low, high = self.position_range_px
        known = [domain for domain in self.domains_px if domain is not None]
        if not known or not all(low <= a <= b <= high for a, b in known):
            raise ValueError("domains_px must have increasing ranges within position_range_px")
        return self

    @check_arguments
    def save(self, path: str | Path, *, overwrite: bool = False) -> None:
        """Write the calibration as JSON, completely or not at all; OutputError if that fails."""
        # One line for each key; with indentation, each of thousands of coefficients would take a line.
        require_ending(Path(path), (".json",))
        content = add_seal({"format": POLYNOMIALS_FORMAT, "version": VERSION} | self.model_dump(mode="json"))
        lines = ",\n".join(f"  {json.dumps(key)}: {json.dumps(value)}" for key, value in content.items())
        write_file(path, f"{{\n{lines}\n}}\n", overwrite=overwrite)

    def figures(self, step: str) -> Table:
        """Return the figures of a calibration step; an empty table if there are none."""
        return self.residuals.get(step, {})

    def medium_index(self, medium: Medium) -> float:
        """Return the index of a medium at the laser's wavelength, relative to air; RangeError outside the formula."""
        return medium.refractive_index(self.wavelength_nm)

    def domains(self) -> np.ndarray:
        """Return ``domains_px`` as an array (L, 2) with NaN for None."""
        return np.array([(np.nan, np.nan) if domain is None else domain for domain in self.domains_px])


AnyCalibration = Calibration | PolynomialCalibration


def calibration_digest(calibration: AnyCalibration) -> str:
    """Return the short digest that identifies a calibration in clouds."""
    if (digest := _digests.get(id(calibration))) is None:
        digest = hashlib.sha256(calibration.model_dump_json().encode()).hexdigest()[:16]
        _digests[id(calibration)] = digest
        weakref.finalize(calibration, _digests.pop, id(calibration), None).atexit = False
    return digest


_digests: dict[int, str] = {}  # digests of calibrations in use, by `id`
