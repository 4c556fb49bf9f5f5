"""Camera parameters to estimate, and their camera model."""

from dataclasses import dataclass, field, replace

import numpy as np

from uwlts.errors import DescriptionError
from uwlts.model.calibration import CameraModel
from uwlts.model.parameter_keys import LensParameter
from uwlts.model.sensor import Camera, Distortion

DISTORTION = tuple(Distortion.model_fields)
"""Names of the coefficients in OpenCV's order."""


@dataclass(frozen=True)
class CameraOptions:
    """Camera parameters to estimate."""

    distortion: tuple[str, ...] = ("k1", "k2")  # estimated coefficients of k1 to k6, p1 and p2; others are zero
    pixel_aspect: float | None = 1.0  # known fy / fx, with f = fx; None: fx and fy are estimated
    principal_point_px: tuple[float, float] | None = None  # known (cx, cy); None: it is estimated
    tangential: tuple[float, float] | None = None  # prior standard deviation of p1 and p2 about zero, and of the
    # points in px, by which it is weighted; None: no prior
    soft_limit_px: float | None = None  # larger residuals have linear loss ("soft L1")

    def __post_init__(self) -> None:
        unknown = set(self.distortion) - set(DISTORTION)
        if unknown or len(set(self.distortion)) < len(self.distortion):
            raise DescriptionError(f"expected each of {', '.join(DISTORTION)} at most once, found {self.distortion}")
        if self.soft_limit_px is not None and not self.soft_limit_px > 0:
            raise DescriptionError(f"soft_limit_px must be positive, not {self.soft_limit_px}")

    def with_described_pixels(self, camera: Camera) -> "CameraOptions":
        """Return these options with the described pixel shape, unless it is estimated."""
        return self if self.pixel_aspect is None else replace(self, pixel_aspect=camera.pixel_aspect)


@dataclass(frozen=True, eq=False)
class Intrinsics:
    """Estimated parameters (P,) as a part of (fx, fy, cx, cy, *DISTORTION): fixed + map @ estimated."""

    options: CameraOptions
    width_px: int
    height_px: int
    names: tuple[str, ...] = field(init=False)
    map: np.ndarray = field(init=False)
    fixed: np.ndarray = field(init=False)

    def __post_init__(self) -> None:
        order = ("fx", "fy", "cx", "cy", *DISTORTION)
        centre = self.options.principal_point_px
        names = [*(("fx", "fy") if self.options.pixel_aspect is None else ("f",)), *(() if centre else ("cx", "cy"))]
        names += [name for name in DISTORTION if name in self.options.distortion]
        of_f = {"fx": 1.0, "fy": self.options.pixel_aspect or 1.0}
        rows = [[of_f.get(row, 0.0) if name == "f" else float(name == row) for name in names] for row in order]
        object.__setattr__(self, "names", tuple(names))
        object.__setattr__(self, "map", np.array(rows))
        object.__setattr__(self, "fixed", np.array([0.0, 0.0, *(centre or (0.0, 0.0)), *(0.0 for _ in DISTORTION)]))

    @property
    def keys(self) -> tuple[LensParameter, ...]:
        """Estimated parameters."""
        return tuple(key for name in self.names for key in LensParameter if key.text == name)

    def _all(self, estimated: np.ndarray) -> np.ndarray:
        return self.fixed + self.map @ estimated

    def matrix(self, estimated: np.ndarray) -> np.ndarray:
        """Return the camera matrix K (3, 3)."""
        fx, fy, cx, cy = self._all(estimated)[:4]
        return np.array([[fx, 0, cx], [0, fy, cy], [0, 0, 1.0]])

    def coefficients(self, estimated: np.ndarray) -> np.ndarray:
        """Return the distortion coefficients (8,) in OpenCV's order."""
        return self._all(estimated)[4:]

    def from_matrix(self, matrix: np.ndarray) -> np.ndarray:
        """Return start values (P,) from a camera matrix of any skew and aspect, without distortion."""
        fx, fy, cx, cy = matrix[0, 0], matrix[1, 1], matrix[0, 2], matrix[1, 2]
        values = {"f": (fx + fy / (self.options.pixel_aspect or 1.0)) / 2, "fx": fx, "fy": fy, "cx": cx, "cy": cy}
        return np.array([values.get(name, 0.0) for name in self.names])

    def from_model(self, model: CameraModel) -> np.ndarray:
        """Return the estimated parameters (P,) of a camera model."""
        known = model.parameters()
        return np.array([known[name] for name in self.names])

    def model(self, estimated: np.ndarray) -> CameraModel:
        """Return the camera model."""
        fx, fy, cx, cy, *coefficients = self._all(estimated).tolist()
        return CameraModel(
            width_px=self.width_px,
            height_px=self.height_px,
            fx_px=fx,
            fy_px=fy,
            cx_px=cx,
            cy_px=cy,
            distortion=Distortion(**dict(zip(DISTORTION, coefficients, strict=True))),
        )
