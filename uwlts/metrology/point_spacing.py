"""Spacing of a cloud's points, which lie dense along a stripe and sparse from image to image."""

from __future__ import annotations

import numpy as np
from scipy.spatial import KDTree

POINTS_PER_DISC = 30
"""Points of a disc over which they are averaged: their mean's noise is a fifth of theirs."""
_IMAGES_PER_DISC = 3.0
_SAMPLED, _ASKED = 2000, 64


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
