"""Camera parameters that a calibration estimates, and the camera model that they give."""

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
    """Camera parameters that are estimated."""

    distortion: tuple[str, ...] = ("k1", "k2")  # those of k1 to k6, p1 and p2 that are estimated; others are zero
    pixel_aspect: float | None = 1.0  # fy / fx where it is known, f being fx; None: both are estimated
    principal_point_px: tuple[float, float] | None = None  # (cx, cy), optional; given, it is not estimated
    tangential: tuple[float, float] | None = None  # known before: standard deviation of p1 and p2 about zero, and the
    # points' in px, over which it is weighed; optional
    soft_limit_px: float | None = None  # distances well beyond it count linearly ("soft L1") rather than squared

    def __post_init__(self) -> None:
        unknown = set(self.distortion) - set(DISTORTION)
        if unknown or len(set(self.distortion)) < len(self.distortion):
            raise DescriptionError(f"distortion takes each of {', '.join(DISTORTION)} once, not {self.distortion}")
        if self.soft_limit_px is not None and not self.soft_limit_px > 0:
            raise DescriptionError(f"soft_limit_px must be positive, not {self.soft_limit_px}")

    def described(self, camera: Camera) -> "CameraOptions":
        """These options, with the pixels' described shape where it is not estimated."""
        return self if self.pixel_aspect is None else replace(self, pixel_aspect=camera.pixel_aspect)


@dataclass(frozen=True, eq=False)
class Intrinsics:
    """The estimated parameters (P,) as a part of (fx, fy, cx, cy, *DISTORTION): fixed + map @ estimated."""

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
        """The estimated parameters."""
        return tuple(key for name in self.names for key in LensParameter if key.text == name)

    def _all(self, estimated: np.ndarray) -> np.ndarray:
        return self.fixed + self.map @ estimated

    def matrix(self, estimated: np.ndarray) -> np.ndarray:
        """Camera matrix K (3, 3)."""
        fx, fy, cx, cy = self._all(estimated)[:4]
        return np.array([[fx, 0, cx], [0, fy, cy], [0, 0, 1.0]])

    def coefficients(self, estimated: np.ndarray) -> np.ndarray:
        """Distortion coefficients (8,) in OpenCV's order."""
        return self._all(estimated)[4:]

    def from_matrix(self, matrix: np.ndarray) -> np.ndarray:
        """Start (P,) from a camera matrix of whatever skew and aspect, without distortion."""
        fx, fy, cx, cy = matrix[0, 0], matrix[1, 1], matrix[0, 2], matrix[1, 2]
        values = {"f": (fx + fy / (self.options.pixel_aspect or 1.0)) / 2, "fx": fx, "fy": fy, "cx": cx, "cy": cy}
        return np.array([values.get(name, 0.0) for name in self.names])

    def from_model(self, model: CameraModel) -> np.ndarray:
        """The estimated parameters (P,) of a camera model."""
        known = model.parameters()
        return np.array([known[name] for name in self.names])

    def model(self, estimated: np.ndarray) -> CameraModel:
        """The camera model."""
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
