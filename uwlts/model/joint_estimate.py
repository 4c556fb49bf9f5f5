"""Joint estimate of a calibration: parameters, values, covariance, and a summary of the evidence."""

from typing import Annotated

import numpy as np
from pydantic import BaseModel, ConfigDict, Field, FiniteFloat, JsonValue, model_validator

from uwlts.model.parameter_keys import ParameterInFile, ParameterKey
from uwlts.model.sensor import Table, Uncertainty, Vector

_Count = Annotated[int, Field(ge=0)]
_Std = Annotated[FiniteFloat, Field(ge=0)]
_ROUNDED = 1e-6  # tolerance of correlations; files contain all digits
_Pair = tuple[FiniteFloat, FiniteFloat]


class _Stored(BaseModel):
    """Base of stored parts of a joint estimate; unknown keys of other versions are kept."""

    model_config = ConfigDict(frozen=True, extra="allow", populate_by_name=True, allow_inf_nan=False)

    def in_file(self) -> dict[str, JsonValue]:
        """Return plain JSON with the keys of files."""
        return self.model_dump(mode="json", by_alias=True, exclude_unset=True)


class CoveredRegion(_Stored):
    """Region of the sheet that stripes cover, in one medium, with or without the camera's window.

    ``medium`` is the index of the medium in the calibration's media, None for air. ``outline_mm`` is a convex polygon
    in Y and Z of the OCS. ``camera_depth_mm`` are the smallest and largest depths along the camera's axis from its
    entrance pupil.
    """

    medium: _Count | None
    name: str
    window: bool
    point_count: Annotated[_Count, Field(alias="points")]
    camera_depth_mm: _Pair
    outline_mm: tuple[_Pair, ...]


class ImageFit(_Stored):
    """Fit of one image: kind of its residuals, rms without outliers, and numbers of residuals and outliers."""

    source: str
    kind: str
    rms_px: FiniteFloat | None
    residual_count: Annotated[_Count, Field(alias="residuals")]
    outlier_count: Annotated[_Count, Field(alias="strays")]


class NominalSheet(_Stored):
    """Described sheet, the reference of the sheet parameters: camera frame, mm.

    ``normal`` is the sheet's normal in air, and ``axis`` the laser's axis, perpendicular to it. The sheet turns about
    ``middle_mm``. The fan starts at ``apex_mm`` and leaves the laser's window at ``pivot_mm``.
    """

    normal: Vector
    axis: Vector
    middle_mm: Vector
    apex_mm: Vector
    pivot_mm: Vector


class JointEstimate(_Stored):
    """Joint estimate of P parameters by iterated least squares, and the evidence.

    ``values``, ``std`` and ``std_before`` are (P,) in the parameters' units, and ``covariance`` is (P, P).
    ``std_before`` is the prior standard uncertainty, None without a prior. ``scatter_px`` is the standard deviation of
    each kind of residual. ``shared_variance`` is the variance of the mean of many residuals of a kind, divided by its
    value for independent residuals. ``rounds`` is the number of iterations, and ``stopped`` the reason of their end.
    """

    parameters: tuple[ParameterInFile, ...]
    values: tuple[FiniteFloat, ...]
    std: tuple[_Std, ...]
    std_before: tuple[_Std | None, ...]
    covariance: tuple[tuple[FiniteFloat, ...], ...]
    nominal_sheet: Annotated[NominalSheet, Field(alias="described_sheet")]
    scatter_px: dict[str, _Std]
    shared_variance: dict[str, _Std] = {}
    residual_count: Annotated[_Count, Field(alias="residuals")]
    outlier_count: Annotated[_Count, Field(alias="strays")]
    rounds: _Count | None = None
    stopped: str | None = None
    images: tuple[ImageFit, ...] = ()
    covered: tuple[CoveredRegion, ...] = ()

    @model_validator(mode="after")
    def _check_sizes(self) -> "JointEstimate":
        count = len(self.parameters)
        if {count} != {*map(len, (self.values, self.std, self.std_before, self.covariance, *self.covariance))}:
            raise ValueError(f"values, std, std_before and covariance must have the size of the {count} parameters")
        if any(row[place] < 0 for place, row in enumerate(self.covariance)):
            raise ValueError("a variance is negative")
        covariance, std = self.covariance_matrix(), np.array(self.std)
        scale = np.where(std > 0, std, 1.0)
        correlation = covariance / scale[:, None] / scale
        if np.abs(correlation - correlation.T).max(initial=0.0) > _ROUNDED:
            raise ValueError("the covariance is not symmetric: the file was edited, or is damaged")
        if np.abs(np.diag(correlation) - (std > 0)).max(initial=0.0) > _ROUNDED:
            raise ValueError("the variances are not the squares of std: the file was edited, or is damaged")
        if count and np.linalg.eigvalsh(correlation).min() < -_ROUNDED:
            raise ValueError("the covariance has a negative eigenvalue: the file was edited, or is damaged")
        return self

    def std_of(self, key: ParameterKey) -> float | None:
        """Return the standard uncertainty of a parameter; None if it was not estimated."""
        return self.std[self.parameters.index(key)] if key in self.parameters else None

    def covariance_matrix(self) -> np.ndarray:
        """Return the covariance as an array (P, P)."""
        return np.array(self.covariance, dtype=np.float64).reshape(len(self.parameters), -1)


class CaptureSource(_Stored):
    """A capture that a calibration was made from: its file, numbers of images, medium and subject."""

    file: str
    name: str | None = None
    sha256: str
    lamp_images: _Count | None = None
    laser_images: _Count | None = None
    medium: str | None = None
    window: bool | None = None
    offset_px: tuple[int, int] | None = None
    black_level: float | None = None
    temperature_c: float | None = None
    salinity_g_kg: float | None = None
    target: Table | None = None
    artefact: Table | None = None


class Origin(BaseModel):
    """Sources of a calibration: captures, target, prior uncertainties of the sensor, and warnings."""

    known_before: Uncertainty = Uncertainty()
    air_captures: tuple[CaptureSource, ...] = ()
    step_captures: tuple[CaptureSource, ...] = ()
    scan_captures: tuple[CaptureSource, ...] = ()
    target: Table | None = None
    warnings: tuple[str, ...] = ()

    def captures(self) -> tuple[CaptureSource, ...]:
        """Return all captures: of targets, of steps and of scans."""
        return self.air_captures + self.step_captures + self.scan_captures
