"""Poses of a target before a camera: which are possible, what an image of each would add, and what is covered."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import product

import cv2
import numpy as np

from uwlts.calibration.guidance.solution import Setting
from uwlts.calibration.target_images import Placement, observe, pose_values
from uwlts.model.calibration import CameraModel
from uwlts.optics.camera import directions

TILT_RAD = np.radians(25.0)  # easily reached by hand, and printed circles stay detectable
_PLACES, _DEPTHS = (0.2, 0.5, 0.8), (0.1, 0.5, 0.9)  # shares of the image and of the working range, inside both
_MARGIN_PX = 10.0  # of the image, in which circles would be cut
_SAMPLE = 100  # points of a candidate that stand for all: more repeat what these say


@dataclass(frozen=True, eq=False)
class Candidate:
    """A pose ``T_camera_target`` (4, 4) with the pixels (N, 2) and the information (P, P) that its image would give.

    The information is for points that are found to 1 px.
    """

    pose: np.ndarray
    pixels: np.ndarray
    information: np.ndarray


def information_of(
    points_mm: np.ndarray, pixels: np.ndarray, pose: np.ndarray, camera: CameraModel, setting: Setting
) -> np.ndarray:
    """Information (P, P) on the camera's parameters in points of one image, each found to 1 px, the pose being unknown.

    The pose's part is eliminated from the normal equations (Schur complement). Zeros for a pose behind the camera.
    """
    intrinsics, count = setting.intrinsics(), len(points_mm)
    placement = Placement(points_mm, np.zeros(count), pixels, np.zeros(count, dtype=int), 1.0)
    seen = observe(placement, intrinsics, intrinsics.from_model(camera), pose_values(pose))
    if seen is None:
        return np.zeros((len(intrinsics.names),) * 2)
    by_global, basis = seen.by_global, np.linalg.qr(seen.by_local / np.linalg.norm(seen.by_local, axis=0))[0]
    left = by_global - basis @ (basis.T @ by_global)
    return left.T @ left


def candidates(setting: Setting, camera: CameraModel, *, spin_rad: float = 0.0) -> list[Candidate]:
    """Poses at three distances in the working range, nine places, nine tilts, in which the target could be found.

    Tilts are none and those that make one of eight sides of the image farther. ``spin_rad`` is how the target is turned
    in the image, from its x axis to the image's.
    """
    target, volume, window = setting.target, setting.sensor.volume, setting.sensor.camera.window
    outer = window.distance_mm + window.thickness_mm
    nearest, farthest = outer + volume.near_mm, outer + volume.far_mm
    points, middle = target.points_mm, target.points_mm.mean(axis=0)
    largest = [camera.width_px - _MARGIN_PX, camera.height_px - _MARGIN_PX]
    step = max(1, len(points) // _SAMPLE)
    spin = cv2.Rodrigues(np.array([0.0, 0.0, spin_rad]))[0]
    sides = np.arange(8) * np.pi / 4
    tilts = [np.zeros(3), *(TILT_RAD * np.array([np.sin(side), -np.cos(side), 0.0]) for side in sides)]
    found = []
    for depth, x, y, tilt in product(_DEPTHS, _PLACES, _PLACES, tilts):
        distance = nearest + depth * (farthest - nearest)
        ray = directions(camera, np.array([[x * camera.width_px, y * camera.height_px]]))[0]
        pose = np.eye(4)
        pose[:3, :3] = cv2.Rodrigues(tilt)[0] @ spin
        pose[:3, 3] = ray / ray[2] * distance - pose[:3, :3] @ middle
        rotation = cv2.Rodrigues(pose[:3, :3])[0]
        pixels = cv2.projectPoints(points, rotation, pose[:3, 3], camera.matrix(), camera.coefficients())[0][:, 0]
        ahead = points @ pose[2, :3] + pose[2, 3] > 0
        inside = ahead & np.all((pixels > _MARGIN_PX) & (pixels < largest), axis=1)
        if target.findable(inside):
            sample = np.flatnonzero(inside)[::step]
            added = information_of(points[sample], pixels[sample], pose, camera, setting)
            found.append(Candidate(pose, pixels[inside], added * inside.sum() / len(sample)))
    return found


_LONG_SIDE_CELLS = 8  # fine enough for distortion, coarse enough to be filled by some ten images
_POINTS_IN_CELL = 3  # one or two may be a corner of the target that touches the cell


@dataclass(frozen=True, eq=False)
class Coverage:
    """Points of all images in a grid of nearly square cells over the image: ``counts`` (rows, columns) in each."""

    counts: np.ndarray
    width_px: int
    height_px: int

    @property
    def covered(self) -> np.ndarray:
        """Which cells (rows, columns) hold points enough: three."""
        return self.counts >= _POINTS_IN_CELL

    @property
    def share(self) -> float:
        """Share of the cells that are covered."""
        return float(self.covered.mean())

    def with_points(self, pixels: np.ndarray) -> "Coverage":
        """The coverage with the points (N, 2) of one more image; points outside the image count nowhere."""
        rows, columns = self.counts.shape
        # Pixel (0, 0) is the centre of the first pixel, so the image begins half a pixel before it.
        place = np.floor((pixels + 0.5) / [self.width_px, self.height_px] * [columns, rows]).astype(int)
        column, row = place[((place >= 0) & (place < [columns, rows])).all(axis=1)].T
        counts = self.counts.copy()
        np.add.at(counts, (row, column), 1)
        return replace(self, counts=counts)

    def emptiest(self) -> str | None:
        """Ninth of the image with most empty cells, in words; None where none has any."""
        empty = ~self.covered
        if not empty.any():
            return None
        rows, columns = (np.minimum(3 * np.arange(n) // n, 2) for n in empty.shape)
        ninths = np.zeros((3, 3))
        np.add.at(ninths, (rows[:, None], columns[None, :]), empty)
        row, column = np.unravel_index(int(np.argmax(ninths)), (3, 3))
        return place_words((column + 0.5) / 3, (row + 0.5) / 3)


def coverage_of(views: Sequence[np.ndarray], *, width_px: int, height_px: int) -> Coverage:
    """Coverage by the points (N, 2) of several images, or of none."""
    side = max(width_px, height_px) / _LONG_SIDE_CELLS
    shape = max(2, round(height_px / side)), max(2, round(width_px / side))
    coverage = Coverage(np.zeros(shape, dtype=np.int64), width_px, height_px)
    for pixels in views:
        coverage = coverage.with_points(pixels)
    return coverage


def place_words(x: float, y: float) -> str:
    """A place in the image, x and y as shares of its width and height, in words."""
    across = "left" if x < 0.4 else "right" if x > 0.6 else ""
    if 0.4 <= y <= 0.6:
        return across or "middle"
    if across:
        return f"{'upper' if y < 0.4 else 'lower'} {across}"
    return "top" if y < 0.4 else "bottom"


def tilts_rad(pose: np.ndarray) -> tuple[float, float]:
    """Tilts of the target at a pose ``T_camera_target`` (4, 4): right side farther, lower side farther."""
    normal = pose[:3, 2] * np.sign(pose[2, 2] or 1.0)
    return float(np.arctan2(-normal[0], normal[2])), float(np.arctan2(-normal[1], normal[2]))
