"""Images of the calibration target: the points of one image, and all images of one placement with their derivatives."""

from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np

from uwlts.calibration.camera.camera_parameters import Intrinsics
from uwlts.errors import CalibrationError
from uwlts.fitting.schur_least_squares import Observation

_FEWEST = 6  # points; a pose has six parameters, a point gives two of them
_COLLINEAR = 1e-3  # extent across over extent along, of points that lie on a line but for their noise


@dataclass(frozen=True, eq=False)
class TargetImage:
    """Target points found in one image."""

    points_mm: np.ndarray  # (N, 3); in the target's frame, z = 0
    pixels: np.ndarray  # (N, 2); where they appear, (u, v)
    stage_mm: float = 0.0  # position of the stage that moves the sensor
    placement: int = 0  # counts how often the target was put up anew; in between only the stage moved

    def __post_init__(self) -> None:
        points = np.ascontiguousarray(self.points_mm, dtype=np.float64)
        pixels = np.ascontiguousarray(self.pixels, dtype=np.float64)
        if points.shape != (len(points), 3) or pixels.shape != (len(points), 2):
            raise ValueError(f"(N, 3) points and (N, 2) pixels expected, not {points.shape} and {pixels.shape}")
        if not (np.isfinite(points).all() and np.isfinite(pixels).all() and np.isfinite(self.stage_mm)):
            raise CalibrationError("a target image holds points, pixels or a stage position that are not finite")
        if len(points) < _FEWEST:
            raise CalibrationError(f"a target image needs at least {_FEWEST} points; there are {len(points)}")
        if np.abs(points[:, 2]).max() > 1e-9 * np.abs(points).max():
            raise CalibrationError("the target's points must lie in its plane z = 0")
        extents = np.linalg.svd(points[:, :2] - points[:, :2].mean(axis=0), compute_uv=False)
        if extents[1] <= _COLLINEAR * extents[0]:
            raise CalibrationError("all points of a target image lie on one line: more of the target must be seen")
        object.__setattr__(self, "points_mm", points)
        object.__setattr__(self, "pixels", pixels)


def z_away(image: TargetImage) -> bool:
    """Whether the target's z axis points away from the camera, by the sense in which x turns into y."""
    flat = np.column_stack([image.points_mm[:, :2], np.ones(len(image.points_mm))])
    linear = np.linalg.lstsq(flat, image.pixels, rcond=None)[0][:2]
    return bool(np.linalg.det(linear) > 0)


@dataclass(frozen=True, eq=False)
class Placement:
    """Images that share one pose of the target, but for the known displacement of the stage."""

    points_mm: np.ndarray  # (N, 3); in the target's frame
    shifts_mm: np.ndarray  # (N,); stage position s - s0 of each point's image, s0 that of the first image
    pixels: np.ndarray  # (N, 2)
    image: np.ndarray  # (N,); number of each point's image
    along_z: float  # +1 or -1: the stage moves the sensor roughly along +z or -z of the target

    def direction(self, tilt: np.ndarray) -> np.ndarray:
        """Unit direction (3,) of the stage in the target's frame: (a, b, along_z) for a tilt (a, b), z for none."""
        raw = np.array([*(tilt if len(tilt) else (0.0, 0.0)), self.along_z])
        return raw / np.linalg.norm(raw)

    def displaced(self, direction: np.ndarray | None = None) -> np.ndarray:
        """Points (N, 3) in the target's frame at s0, as if the sensor had not moved: the stage moves them back."""
        along = self.direction(np.empty(0)) if direction is None else direction
        return self.points_mm - self.shifts_mm[:, None] * along


def pose_values(pose: np.ndarray) -> np.ndarray:
    """Rotation vector and translation in mm (6,) of a transform (4, 4)."""
    return np.r_[cv2.Rodrigues(pose[:3, :3])[0].ravel(), pose[:3, 3]]


def placements(images: Sequence[TargetImage], *, approaching: bool | None) -> list[Placement]:
    """Images joined by their placement number, or one by one if the stage's sense is None.

    Raises CalibrationError: the target appears mirrored in some images of a placement.
    """
    numbers = [index if approaching is None else image.placement for index, image in enumerate(images)]
    joined = []
    for number in sorted(set(numbers)):
        group = [index for index, own in enumerate(numbers) if own == number]
        members = [images[index] for index in group]
        counts = [len(member.points_mm) for member in members]
        facing = {z_away(member) for member in members}
        if len(facing) > 1:
            raise CalibrationError("the target is mirrored in some of its images: its columns or rows run backwards")
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
    """Residuals (found minus calculated) of a placement and their derivatives; None with points behind the camera.

    Parameters
    ----------
    global_values : (P,); camera parameters, as `Intrinsics` names them
    local : (6,) or (8,); rotation vector, translation in mm and, where the stage's direction is free, its tilt (a, b)
    """
    direction = placement.direction(local[6:])
    points = placement.displaced(direction)
    rotation = cv2.Rodrigues(local[:3])[0]
    if np.min(points @ rotation[2] + local[5]) <= 0:
        return None
    projected, jacobian = cv2.projectPoints(
        points, local[:3], local[3:6], intrinsics.matrix(global_values), intrinsics.coefficients(global_values)
    )
    by_local = jacobian[:, :6]
    if len(local) > 6:
        # Moving a point along a vector acts like translating the target by the rotated vector.
        turning = (np.eye(3) - np.outer(direction, direction))[:, :2] * abs(direction[2])
        by_tilt = -np.repeat(placement.shifts_mm, 2)[:, None] * (jacobian[:, 3:6] @ (rotation @ turning))
        by_local = np.hstack([by_local, by_tilt])
    return Observation(
        residuals=placement.pixels - projected.reshape(-1, 2),
        by_global=-jacobian[:, 6 : 6 + len(intrinsics.map)] @ intrinsics.map,
        by_local=-by_local,
    )
