"""Spacing of a cloud's points, which lie dense along a stripe and sparse from image to image, and their footprint."""

from __future__ import annotations

import numpy as np
from scipy.spatial import KDTree

from uwlts.storage.cloud import FOOTPRINT, FOOTPRINT_STD, PointCloud

POINTS_PER_DISC = 30
"""Points of a disc over which they are averaged: their mean's noise is a fifth of theirs."""
_IMAGES_PER_DISC = 3.0
"""Images across a disc, at least: in fewer, errors of single images do not average."""
_SAMPLED = 2000
"""Points of which the spacing is the median: right to a few percent."""
_ASKED = 64
"""Neighbours among which one of another image is looked for."""
_STEEPEST = 0.3
"""Least cosine of a surface towards the laser: on steeper ones a footprint counts as no longer."""


def disc_of(points_mm: np.ndarray, frame: np.ndarray | None = None) -> float:
    """Diameter of discs that hold some thirty points (N, 3), and by their images ``frame`` (N,) lines of three."""
    tree, sample = KDTree(points_mm), points_mm[:: max(1, len(points_mm) // _SAMPLED)]
    seventh = np.asarray(tree.query(sample, k=7)[0])[:, 6]
    # A disc of radius r about a point holds six neighbours more: the area for thirty is five times as large.
    disc = float(2 * np.median(seventh) * np.sqrt(POINTS_PER_DISC / 6.0))
    if frame is None or (frame < 0).any() or frame.min() == frame.max():
        return disc
    return max(disc, _IMAGES_PER_DISC * _between_images(points_mm, frame))


def _between_images(points_mm: np.ndarray, frame: np.ndarray) -> float:
    """Median distance of a point from the nearest point of another image."""
    middle = np.unique(frame)
    chosen = np.isin(frame, middle[:: max(1, len(middle) // 20)])
    sample = np.flatnonzero(chosen)
    sample = sample[:: max(1, len(sample) // _ASKED)]
    least = [np.linalg.norm(points_mm[frame != frame[k]] - points_mm[k], axis=1).min() for k in sample]
    return float(np.median(least))


def footprint_on(cloud: PointCloud, chosen: np.ndarray, tangents: np.ndarray) -> tuple[np.ndarray, float]:
    """Standard deviations (K, 2) of the footprints of chosen (K,) points along tangents (K, 2, 3) of the surface, mm.

    And the relative standard uncertainty of their squares. Zeros where the cloud does not state a footprint, as it is
    for clouds of moved sensors and of other programs.
    """
    known = cloud.metadata.get(FOOTPRINT)
    if not (isinstance(known, list) and len(known) == 2 and all(isinstance(each, float) for each in known)):
        return np.zeros((len(chosen), 2)), 0.0
    size, std = np.array(known, float), cloud.metadata.get(FOOTPRINT_STD)
    # The laser's light comes along Z: what it covers across it, X and Y, is longer on a surface that leans.
    flat = tangents[:, :, :2]
    leaning = np.abs(flat[:, 0, 0] * flat[:, 1, 1] - flat[:, 0, 1] * flat[:, 1, 0])
    inverse = np.stack([flat[:, 1, ::-1] * [1, -1], flat[:, 0, ::-1] * [-1, 1]], axis=1)
    spread = np.linalg.norm(inverse * size, axis=2) / np.maximum(leaning, _STEEPEST)[:, None]
    return spread, float(std) if isinstance(std, float) else 0.0
