"""Spacing of points, which differs along a stripe and between images, their footprint, and groups of points."""

from __future__ import annotations

import numpy as np
from scipy.spatial import KDTree

from uwlts.storage.cloud import FOOTPRINT, FOOTPRINT_STD, PointCloud

POINTS_PER_DISC = 30
"""Number of points of an averaging disc: the mean has about a fifth of their noise."""
_IMAGES_PER_DISC = 3.0
"""Least number of images in a disc, so that errors of single images average."""
_SAMPLED = 2000
"""Number of points for the median spacing, which is then accurate to a few percent."""
_ASKED = 64
"""Number of points for the median distance between images."""
_STEEPEST = 0.3
"""Least cosine of the angle between surface normal and laser, which limits the length of a footprint."""


def choose_disc_diameter(points_mm: np.ndarray, frame: np.ndarray | None = None) -> float:
    """Return the diameter of discs with about thirty points (N, 3) and, given ``frame`` (N,), at least three images."""
    tree, sample = KDTree(points_mm), points_mm[:: max(1, len(points_mm) // _SAMPLED)]
    seventh = np.asarray(tree.query(sample, k=7)[0])[:, 6]
    # A disc with the radius of the sixth neighbour holds six points. Thirty points need five times its area.
    disc = float(2 * np.median(seventh) * np.sqrt(POINTS_PER_DISC / 6.0))
    if frame is None or (frame < 0).any() or frame.min() == frame.max():
        return disc
    return max(disc, _IMAGES_PER_DISC * _between_images(points_mm, frame))


def _between_images(points_mm: np.ndarray, frame: np.ndarray) -> float:
    """Return the median distance between a point and the nearest point of another image."""
    middle = np.unique(frame)
    chosen = np.isin(frame, middle[:: max(1, len(middle) // 20)])
    sample = np.flatnonzero(chosen)
    sample = sample[:: max(1, len(sample) // _ASKED)]
    least = [np.linalg.norm(points_mm[frame != frame[k]] - points_mm[k], axis=1).min() for k in sample]
    return float(np.median(least))


def measure_spacing(places: np.ndarray, chosen: np.ndarray) -> np.ndarray:
    """Return the median spacings (2,) of places (N, 2) near chosen (K,) ones, along the first and the second direction.

    The next place along a direction lies within 45 deg of it: points of the same profile do not count across it.
    """
    sample = chosen[:: max(1, len(chosen) // _ASKED)]
    least = np.full((len(sample), 2), np.inf)
    for number, point in enumerate(sample):
        away = np.abs(places - places[point])
        for k in (0, 1):
            ahead = away[:, k][away[:, k] > away[:, 1 - k]]
            least[number, k] = ahead.min(initial=np.inf)
    known = np.isfinite(least)
    return np.array([np.median(least[known[:, k], k]) if known[:, k].any() else 0.0 for k in (0, 1)])


def project_footprint(cloud: PointCloud, chosen: np.ndarray, tangents: np.ndarray) -> tuple[np.ndarray, float]:
    """Return the footprints of chosen (K,) points along tangents (K, 2, 3), and their relative uncertainty.

    A footprint is a pair of standard deviations (K, 2) in mm. The uncertainty is that of their squares. Both are zero
    if the cloud states no footprint, for example for moved sensors or clouds of other programs.
    """
    known = cloud.metadata.get(FOOTPRINT)
    if not (isinstance(known, list) and len(known) == 2 and all(isinstance(each, float) for each in known)):
        return np.zeros((len(chosen), 2)), 0.0
    size, std = np.array(known, float), cloud.metadata.get(FOOTPRINT_STD)
    # The laser is parallel to Z. Its footprint in X and Y is longer on an inclined surface.
    flat = tangents[:, :, :2]
    leaning = np.abs(flat[:, 0, 0] * flat[:, 1, 1] - flat[:, 0, 1] * flat[:, 1, 0])
    # Inverse times its determinant, without the signs of its elements.
    inverse = flat[:, ::-1, ::-1]
    spread = np.linalg.norm(inverse * size, axis=2) / np.maximum(leaning, _STEEPEST)[:, None]
    return spread, float(std) if isinstance(std, float) else 0.0


def number_cubes(points: np.ndarray, side: float) -> np.ndarray:
    """Return the cube (N,) of each point (N, 3) in a cubic grid; coordinates must not be negative."""
    cells = np.floor(points / side).astype(np.int64)
    _, rows, layers = cells.max(axis=0) + 1
    return (cells[:, 0] * rows + cells[:, 1]) * layers + cells[:, 2]


def group_rows(keys: np.ndarray) -> dict[int, np.ndarray]:
    """Return the rows with each key, in order; keys (N,) must not be negative."""
    order = np.argsort(keys, kind="stable")
    starts = np.flatnonzero(np.diff(keys[order], prepend=-1))
    return dict(zip(keys[order][starts].tolist(), np.split(order, starts[1:]), strict=True)) if len(order) else {}
