"""Images of the calibration target: points of one image, and images of one placement with derivatives."""

from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np

from uwlts.calibration.camera.camera_parameters import Intrinsics
from uwlts.errors import CalibrationError
from uwlts.fitting.schur_least_squares import Observation

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
        group = [index for index, own in enumerate(numbers) if own == number]
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
