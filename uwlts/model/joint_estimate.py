"""The joint estimate that a calibration holds: parameters, values, covariance, and a summary of its evidence."""

from typing import Annotated

import numpy as np
from pydantic import BaseModel, ConfigDict, Field, FiniteFloat, JsonValue, model_validator

from uwlts.model.parameter_keys import ParameterInFile, ParameterKey
from uwlts.model.sensor import Table, Uncertainty, Vector

_Count = Annotated[int, Field(ge=0)]
_Std = Annotated[FiniteFloat, Field(ge=0)]
_ROUNDED = 1e-6  # of a correlation; files hold all digits
_Pair = tuple[FiniteFloat, FiniteFloat]


class _Stored(BaseModel):
    """Base of what files hold of a joint estimate; keys that other versions add are kept."""

    model_config = ConfigDict(frozen=True, extra="allow", populate_by_name=True, allow_inf_nan=False)

    def in_file(self) -> dict[str, JsonValue]:
        """Plain JSON with the keys of files."""
        return self.model_dump(mode="json", by_alias=True, exclude_unset=True)


class CoveredRegion(_Stored):
    """A region of the sheet that stripes cover, seen through the window or not in one medium.

    ``medium`` is its number among the calibration's media, None for air; ``outline_mm`` is convex, Y and Z of the OCS;
    ``camera_depth_mm`` are the nearest and farthest depths along the camera's axis from its entrance pupil.
    """

    medium: _Count | None
    name: str
    window: bool
    point_count: Annotated[_Count, Field(alias="points")]
    camera_depth_mm: _Pair
    outline_mm: tuple[_Pair, ...]


class ImageFit(_Stored):
    """Fit of one image: the kind of its residuals, their rms without outliers, and their numbers."""

    source: str
    kind: str
    rms_px: FiniteFloat | None
    residual_count: Annotated[_Count, Field(alias="residuals")]
    outlier_count: Annotated[_Count, Field(alias="strays")]


class NominalSheet(_Stored):
    """The sheet as described, for which sheet parameters of zero stand: camera frame, mm.

    ``normal`` is the sheet's in air, ``axis`` the laser's axis, square to it; the sheet turns about ``middle_mm``,
    the fan begins at ``apex_mm`` and leaves the laser's window at ``pivot_mm``.
    """

    normal: Vector
    axis: Vector
    middle_mm: Vector
    apex_mm: Vector
    pivot_mm: Vector


class JointEstimate(_Stored):
    """All P parameters that were estimated together, by iterated least squares, and the evidence.

    ``values``, ``std`` and ``std_before`` are (P,) in the parameters' units, ``covariance`` (P, P); ``std_before`` is
    None where nothing was known before. ``scatter_px`` is the standard deviation of every kind of residual,
    ``shared_variance`` the variance of a mean of many residuals of a kind over that of as many independent ones.
    ``rounds`` and ``stopped`` give the number of iterations and why they ended.
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
    def _sized(self) -> "JointEstimate":
        count = len(self.parameters)
        if {count} != {*map(len, (self.values, self.std, self.std_before, self.covariance, *self.covariance))}:
            raise ValueError(f"not all of it is of its {count} parameters")
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
        """Standard uncertainty of a parameter; None where it was not estimated."""
        return self.std[self.parameters.index(key)] if key in self.parameters else None

    def covariance_matrix(self) -> np.ndarray:
        """The covariance as an array (P, P)."""
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
    temperature_c: float | None = None
    salinity_g_kg: float | None = None
    target: Table | None = None
    artefact: Table | None = None


class Origin(BaseModel):
    """Captures and target that a calibration was made from, how well the sensor was known before, and warnings."""

    known_before: Uncertainty = Uncertainty()
    air_captures: tuple[CaptureSource, ...] = ()
    step_captures: tuple[CaptureSource, ...] = ()
    scan_captures: tuple[CaptureSource, ...] = ()
    target: Table | None = None
    warnings: tuple[str, ...] = ()

    def captures(self) -> tuple[CaptureSource, ...]:
        """All captures: of targets, of steps and of scans."""
        return self.air_captures + self.step_captures + self.scan_captures
