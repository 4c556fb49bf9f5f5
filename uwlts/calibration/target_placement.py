"""All images of one placement of the target: where its points should appear, and how that depends on the parameters."""

from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np

from uwlts.calibration.intrinsics import Intrinsics
from uwlts.calibration.schur_least_squares import Observation
from uwlts.calibration.target_image import TargetImage, z_away
from uwlts.errors import CalibrationError


@dataclass(frozen=True, eq=False)
class Placement:
    """Images that share one pose of the target, but for the known displacement of the stage.

    Attributes
    ----------
    points_mm : (N, 3)
        In the target's frame.
    shifts_mm : (N,)
        Stage position s - s0 of each point's image, s0 that of the first image.
    pixels : (N, 2)
    image : (N,)
        Number of each point's image.
    along_z : float
        +1 or -1: the stage moves the sensor roughly along +z or -z of the target.
    """

    points_mm: np.ndarray
    shifts_mm: np.ndarray
    pixels: np.ndarray
    image: np.ndarray
    along_z: float

    def direction(self, tilt: np.ndarray) -> np.ndarray:
        """Unit direction (3,) of the stage in the target's frame: (a, b, along_z) for a tilt (a, b), z for none."""
        raw = np.array([*(tilt if len(tilt) else (0.0, 0.0)), self.along_z])
        return raw / np.linalg.norm(raw)

    def displaced(self, direction: np.ndarray) -> np.ndarray:
        """Points (N, 3) in the target's frame at s0, as if the sensor had not moved: the stage moves them back."""
        return self.points_mm - self.shifts_mm[:, None] * direction


def placements(images: Sequence[TargetImage], *, approaching: bool) -> list[Placement]:
    """Group images by their placement number; refuse targets that appear mirrored in some images."""
    numbers = sorted({image.placement for image in images})
    groups = [[i for i, image in enumerate(images) if image.placement == number] for number in numbers]
    return [_joined(images, group, approaching=approaching) for group in groups]


def single_images(images: Sequence[TargetImage]) -> list[Placement]:
    """Every image as a placement of its own."""
    return [_joined(images, [index], approaching=True) for index in range(len(images))]


def _joined(images: Sequence[TargetImage], group: list[int], *, approaching: bool) -> Placement:
    members = [images[index] for index in group]
    counts = [len(member.points_mm) for member in members]
    facing = {z_away(member) for member in members}
    if len(facing) > 1:
        raise CalibrationError("the target is mirrored in some of its images: its columns or rows run backwards")
    return Placement(
        points_mm=np.vstack([member.points_mm for member in members]),
        shifts_mm=np.repeat([member.stage_mm - members[0].stage_mm for member in members], counts),
        pixels=np.vstack([member.pixels for member in members]),
        image=np.repeat(group, counts),
        along_z=1.0 if facing.pop() == approaching else -1.0,
    )


def observe(
    placement: Placement, intrinsics: Intrinsics, global_values: np.ndarray, local: np.ndarray
) -> Observation | None:
    """Residuals (found minus calculated) of a placement and their derivatives; None with points behind the camera.

    Parameters
    ----------
    global_values : (P,)
        Camera parameters, as `Intrinsics` names them.
    local : (6,) or (8,)
        Rotation vector, translation in mm and, where the stage's direction is free, its tilt (a, b).
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
        by_global=-jacobian[:, 6:15] @ intrinsics.map,
        by_local=-by_local,
    )
