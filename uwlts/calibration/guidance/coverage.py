"""Which parts of the image the target's points have covered, and how far tilts and distances are spread."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

_LONG_SIDE_CELLS = 8
_POINTS_IN_CELL = 3


@dataclass(frozen=True, eq=False)
class Coverage:
    """Points of all images in a grid of nearly square cells over the image.

    Attributes
    ----------
    counts : (rows, columns)
        Points in each cell.
    width_px, height_px : int
        Size of the image.
    """

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
        """The coverage with the points (N, 2) of one more image."""
        return Coverage(self.counts + cell_counts(pixels, self), self.width_px, self.height_px)

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


def empty_coverage(width_px: int, height_px: int) -> Coverage:
    """No points yet."""
    side = max(width_px, height_px) / _LONG_SIDE_CELLS
    shape = max(2, round(height_px / side)), max(2, round(width_px / side))
    return Coverage(np.zeros(shape, dtype=np.int64), width_px, height_px)


def coverage_of(views: Sequence[np.ndarray], *, width_px: int, height_px: int) -> Coverage:
    """Coverage by the points (N, 2) of several images."""
    coverage = empty_coverage(width_px, height_px)
    for pixels in views:
        coverage = coverage.with_points(pixels)
    return coverage


def cell_counts(pixels: np.ndarray, grid: Coverage) -> np.ndarray:
    """Points (rows, columns) of one image in each cell of a grid; points outside the image count nowhere."""
    rows, columns = grid.counts.shape
    # Pixel (0, 0) is the centre of the first pixel, so the image begins half a pixel before it.
    place = np.floor((pixels + 0.5) / [grid.width_px, grid.height_px] * [columns, rows]).astype(int)
    inside = ((place >= 0) & (place < [columns, rows])).all(axis=1)
    counts = np.zeros((rows, columns), dtype=np.int64)
    np.add.at(counts, (place[inside, 1], place[inside, 0]), 1)
    return counts


def place_words(x: float, y: float) -> str:
    """A place in the image, x and y as shares of its width and height, in words."""
    across = "left" if x < 0.4 else "right" if x > 0.6 else ""
    down = "upper" if y < 0.4 else "lower" if y > 0.6 else ""
    if across and down:
        return f"{down} {across}"
    return across or {"upper": "top", "lower": "bottom", "": "middle"}[down]


@dataclass(frozen=True)
class Spread:
    """How differently the target stood: range of its tilts in rad about the image's two axes, and of its distances.

    ``horizontal_rad`` is the tilt that brings its right side farther, ``vertical_rad`` its lower side; each as lowest
    and highest. ``distance_mm`` are the nearest and the farthest middle of the points seen.
    """

    horizontal_rad: tuple[float, float]
    vertical_rad: tuple[float, float]
    distance_mm: tuple[float, float]


def tilts_rad(pose: np.ndarray) -> tuple[float, float]:
    """How far the target of a pose ``T_camera_target`` (4, 4) is tilted: right side farther, lower side farther."""
    normal = pose[:3, 2] * np.sign(pose[2, 2] or 1.0)
    return float(np.arctan2(-normal[0], normal[2])), float(np.arctan2(-normal[1], normal[2]))


def spread_of(poses: Sequence[np.ndarray], middles_mm: Sequence[np.ndarray]) -> Spread | None:
    """Spread of poses (4, 4) with the middles (3,) of the points seen, in the target's frame; None without any."""
    if not poses:
        return None
    across, down = np.array([tilts_rad(pose) for pose in poses]).T
    depth = [float(pose[2, :3] @ middle + pose[2, 3]) for pose, middle in zip(poses, middles_mm, strict=True)]

    def ends(values: Sequence[float]) -> tuple[float, float]:
        return float(min(values)), float(max(values))

    return Spread(ends(across), ends(down), ends(depth))
