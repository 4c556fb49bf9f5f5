"""Camera to estimate: its parameters and model, and images of the calibration target with derivatives."""

from collections.abc import Sequence
from dataclasses import dataclass, field, replace

import cv2
import numpy as np

from uwlts.errors import CalibrationError, DescriptionError
from uwlts.fitting.schur_least_squares import Observation
from uwlts.model.calibration import CameraModel
from uwlts.model.parameter_keys import LensParameter
from uwlts.model.sensor import Camera, Distortion

DISTORTION = tuple(Distortion.model_fields)  # names of the coefficients in OpenCV's order


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

    @property
    def name(self) -> str:
        """Coefficients and pixel shape of the lens model."""
        names, shape = " ".join(self.distortion) or "no distortion", {None: "free pixels", 1.0: "square pixels"}
        return f"{names}, {shape.get(self.pixel_aspect) or f'pixels of aspect {self.pixel_aspect:g}'}"

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

    def _complete(self, estimated: np.ndarray) -> np.ndarray:
        return self.fixed + self.map @ estimated

    def matrix(self, estimated: np.ndarray) -> np.ndarray:
        """Return the camera matrix K (3, 3)."""
        fx, fy, cx, cy = self._complete(estimated)[:4]
        return np.array([[fx, 0, cx], [0, fy, cy], [0, 0, 1.0]])

    def coefficients(self, estimated: np.ndarray) -> np.ndarray:
        """Return the distortion coefficients (8,) in OpenCV's order."""
        return self._complete(estimated)[4:]

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
        fx, fy, cx, cy, *coefficients = self._complete(estimated).tolist()
        return CameraModel(
            width_px=self.width_px,
            height_px=self.height_px,
            fx_px=fx,
            fy_px=fy,
            cx_px=cx,
            cy_px=cy,
            distortion=Distortion(**dict(zip(DISTORTION, coefficients, strict=True))),
        )


_FEWEST = 6  # points; a pose has six parameters, and a point gives two equations
_COLLINEAR = 1e-3  # ratio of extents of points that are collinear except for noise


@dataclass(frozen=True, eq=False)
class TargetImage:
    """Target points found in one image."""

    points_mm: np.ndarray  # (N, 3); in the target's frame, z = 0
    pixels: np.ndarray  # pixel coordinates (u, v)
    stage_mm: float = 0.0  # position of the stage that moves the sensor
    placement: int = 0  # number of the target's placement; within one, only the stage moves

    def __post_init__(self) -> None:
        points = np.ascontiguousarray(self.points_mm, dtype=np.float64)
        pixels = np.ascontiguousarray(self.pixels, dtype=np.float64)
        if points.shape != (len(points), 3) or pixels.shape != (len(points), 2):
            raise ValueError(f"expected (N, 3) points and (N, 2) pixels, found {points.shape} and {pixels.shape}")
        if not (np.isfinite(points).all() and np.isfinite(pixels).all() and np.isfinite(self.stage_mm)):
            raise CalibrationError("a target image contains points, pixels or a stage position that are not finite")
        if len(points) < _FEWEST:
            raise CalibrationError(f"a target image needs at least {_FEWEST} points; there are {len(points)}")
        if np.abs(points[:, 2]).max() > 1e-9 * np.abs(points).max():
            raise CalibrationError("the target's points must be in its plane z = 0")
        extents = np.linalg.svd(points[:, :2] - points[:, :2].mean(axis=0), compute_uv=False)
        if extents[1] <= _COLLINEAR * extents[0]:
            raise CalibrationError("all points of a target image are on one line: more of the target must be visible")
        object.__setattr__(self, "points_mm", points)
        object.__setattr__(self, "pixels", pixels)


def z_away(image: TargetImage) -> bool:
    """Return whether the target's z axis points away from the camera, from the handedness of x and y in the image."""
    flat = np.column_stack([image.points_mm[:, :2], np.ones(len(image.points_mm))])
    linear = np.linalg.lstsq(flat, image.pixels, rcond=None)[0][:2]
    return bool(np.linalg.det(linear) > 0)


@dataclass(frozen=True, eq=False)
class Placement:
    """Images with one target pose, except for the known displacement of the stage."""

    points_mm: np.ndarray  # (N, 3); in the target's frame
    shifts_mm: np.ndarray  # (N,); stage position s - s0 of each point's image, s0 that of the first image
    pixels: np.ndarray  # (N, 2)
    image: np.ndarray  # (N,); number of each point's image
    along_z: float  # +1 or -1: the stage moves the sensor roughly along +z or -z of the target

    def direction(self, tilt: np.ndarray) -> np.ndarray:
        """Return the unit direction (3,) of the stage in the target's frame: (a, b, along_z) for a tilt (a, b)."""
        raw = np.array([*(tilt if len(tilt) else (0.0, 0.0)), self.along_z])
        return raw / np.linalg.norm(raw)

    def displace(self, direction: np.ndarray | None = None) -> np.ndarray:
        """Return points (N, 3) in the target's frame at s0, shifted back by the stage's motion."""
        along = self.direction(np.empty(0)) if direction is None else direction
        return self.points_mm - self.shifts_mm[:, None] * along


def pose_values(pose: np.ndarray) -> np.ndarray:
    """Return rotation vector and translation in mm (6,) of a transform (4, 4)."""
    return np.r_[cv2.Rodrigues(pose[:3, :3])[0].ravel(), pose[:3, 3]]


def placements(images: Sequence[TargetImage], *, approaching: bool | None) -> list[Placement]:
    """Group images by placement number, or use single images if ``approaching`` is None.

    Raises CalibrationError if the target appears mirrored in some images of a placement.
    """
    numbers = [index if approaching is None else image.placement for index, image in enumerate(images)]
    joined = []
    for number in sorted(set(numbers)):
        group = [index for index, each in enumerate(numbers) if each == number]
        members = [images[index] for index in group]
        counts = [len(member.points_mm) for member in members]
        facing = {z_away(member) for member in members}
        if len(facing) > 1:
            raise CalibrationError("the target is mirrored in some images: its columns or rows are in reverse order")
        joined.append(
            Placement(
                points_mm=np.vstack([member.points_mm for member in members]),
                shifts_mm=np.repeat([member.stage_mm - members[0].stage_mm for member in members], counts),
                pixels=np.vstack([member.pixels for member in members]),
                image=np.repeat(group, counts),
                along_z=1.0 if facing.pop() == (approaching is not False) else -1.0,
            )
        )
    return joined


def observe(
    placement: Placement, intrinsics: Intrinsics, global_values: np.ndarray, local: np.ndarray
) -> Observation | None:
    """Return residuals (found minus calculated) of a placement with derivatives; None for points behind the camera.

    ``global_values`` (P,) are camera parameters as `Intrinsics` names them. ``local`` is the rotation vector and
    translation in mm (6,), followed by the tilt (a, b) of a free stage direction (8,).
    """
    direction = placement.direction(local[6:])
    points = placement.displace(direction)
    rotation = cv2.Rodrigues(local[:3])[0]
    if np.min(points @ rotation[2] + local[5]) <= 0:
        return None
    projected, jacobian = cv2.projectPoints(
        points, local[:3], local[3:6], intrinsics.matrix(global_values), intrinsics.coefficients(global_values)
    )
    by_local = jacobian[:, :6]
    if len(local) > 6:
        # Shifting a point along a vector is equivalent to translating the target by the rotated vector.
        turning = (np.eye(3) - np.outer(direction, direction))[:, :2] * abs(direction[2])
        by_tilt = -np.repeat(placement.shifts_mm, 2)[:, None] * (jacobian[:, 3:6] @ (rotation @ turning))
        by_local = np.hstack([by_local, by_tilt])
    return Observation(
        residuals=placement.pixels - projected.reshape(-1, 2),
        by_global=-jacobian[:, 6 : 6 + len(intrinsics.map)] @ intrinsics.map,
        by_local=-by_local,
    )
