"""Where the iteration for camera and poses starts."""

import cv2
import numpy as np

from uwlts.calibration.direct_linear import direct_linear
from uwlts.calibration.intrinsics import Intrinsics
from uwlts.calibration.target_placement import Placement
from uwlts.errors import CalibrationError


def linear_start(placements: list[Placement], intrinsics: Intrinsics) -> tuple[np.ndarray, list[np.ndarray]]:
    """Camera parameters (P,) and poses (6,) of a target that the stage displaces along its normal.

    The placement that reaches farthest gives both by the linear method, the others then have their poses found.
    """
    farthest = int(np.argmax([np.ptp(placement.shifts_mm) for placement in placements]))
    points = placements[farthest].displaced(placements[farthest].direction(np.empty(0)))
    start = direct_linear(points, placements[farthest].pixels)
    global_values = intrinsics.from_matrix(start.matrix)
    poses = [placement_pose(placement, intrinsics.matrix(global_values)) for placement in placements]
    poses[farthest] = np.r_[cv2.Rodrigues(start.rotation)[0].ravel(), start.translation_mm]
    return global_values, poses


def planar_start(placements: list[Placement], intrinsics: Intrinsics) -> tuple[np.ndarray, list[np.ndarray]]:
    """Camera parameters (P,) and poses (6,) of single images: f from homographies, the principal point in the middle.

    `cv2.initCameraMatrix2D`, after Zhang, A flexible new technique for camera calibration, PAMI 2000.
    """
    size = (intrinsics.width_px, intrinsics.height_px)
    points = [placement.points_mm.astype(np.float32) for placement in placements]
    pixels = [placement.pixels.astype(np.float32) for placement in placements]
    matrix = cv2.initCameraMatrix2D(points, pixels, size, 1.0)
    if not (np.isfinite(matrix).all() and 0.1 < matrix[0, 0] / max(size) < 100):
        raise CalibrationError(
            "the target images do not show the focal length: tilt the target against the camera's axis, differently "
            "from image to image"
        )
    global_values = intrinsics.from_matrix(matrix)
    return global_values, [placement_pose(placement, intrinsics.matrix(global_values)) for placement in placements]


def placement_pose(placement: Placement, matrix: np.ndarray) -> np.ndarray:
    """Rotation vector and shift (6,) of a placement seen by a camera without distortion."""
    points = placement.displaced(placement.direction(np.empty(0)))
    found, rotation, translation = cv2.solvePnP(points, placement.pixels, matrix, None)
    if not found:
        raise CalibrationError("no pose of the target explains one of its images: is it the right target?")
    return np.r_[rotation.ravel(), translation.ravel()]
