"""Points that a cloud contains several times: exactly, or rounded differently in each copy."""

from __future__ import annotations

from typing import Any

import numpy as np
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components
from scipy.spatial import KDTree

from uwlts.storage.cloud import PointCloud

_FINEST_MM = 1e-3  # a micrometre: finer steps of coordinates are below the uncertainty of any scanner
_NO_STEP_MM = 1e-6  # differences up to a nanometre come from the conversion of units
_MULTIPLE = 0.01  # largest difference of a gap between coordinates from a multiple of their step, in steps
_STEPS = (0.5, 2.0)  # radii of copies, in steps of the coordinates: only equal points, and points rounded differently
_MOVED_MM = 0.008
"""Largest radius of copies in coordinates with fine steps: copies were rounded to 0.01 mm, or moved by a micrometre."""
_WIDER = 4.0
"""Ratio of the radius in which other points are counted to that of copies. Points of a surface have 16 times as many
neighbours there, points of a line 4 times as many; copies have no more."""
_FEWEST_PER_COPY = 2.0  # least ratio of these numbers of neighbours for a cloud without copies: between 1 and 4
_SAMPLED = 500  # number of points whose neighbours are counted
_FEWEST_COPIES = 5  # least number of copies of the sample, that of a repeated part of 1 %: fewer may be near by chance
_FEWEST = 30  # least number of points: fewer do not show how often points have neighbours
_LINKED = 8  # neighbours that one pass links


def omit_repeated(cloud: PointCloud) -> tuple[PointCloud, list[str]]:
    """Return a cloud without repeated points, and a warning if there were any.

    Points with an image and line of their own are measurements of their own, also those of a sensor at rest.
    """
    known = len(cloud) > 0 and cloud.frame.min() >= 0 and cloud.line.min() >= 0
    if known and len(np.unique(cloud.frame.astype(np.int64) << 32 | cloud.line)) == len(cloud):
        return cloud, []
    repeated = find_repeated(cloud.points_mm)
    if not repeated.any():
        return cloud, []
    some = f"{np.count_nonzero(repeated)} of {len(cloud)} points"
    return cloud.select(~repeated), [f"{some} repeat others and are omitted: they are no new evidence"]


def find_repeated(points_mm: np.ndarray) -> np.ndarray:
    """Return a mask (N,) of the points (N, 3) that repeat an earlier one.

    Points are copies if they have more neighbours within a few steps of the coordinates than between that radius and
    four times as much. Neighbours on a surface or on a line, at any spacing and noise, are more frequent farther away.
    If coordinates are rounded so coarsely that different points coincide, only copies of the whole cloud are found.
    """
    kept = np.arange(len(points_mm))
    while len(kept) >= _FEWEST:
        points = points_mm[kept]
        radius, equal = _judge_neighbours(points)
        copies = _find_whole_copies(points) if equal else None
        if copies is None and radius is None:
            break
        # A larger radius is tried after the copies within the smaller one are gone: it may contain other points.
        kept = kept[~copies] if copies is not None else kept[_keep_one_per_group(points, radius or 0.0)]
    repeated = np.ones(len(points_mm), bool)
    repeated[kept] = False
    return repeated


def _find_whole_copies(points: np.ndarray) -> np.ndarray | None:
    """Return a mask (N,) of copies if all places occur a multiple of a number of times; None if they do not."""
    _, place, number = np.unique(points, axis=0, return_inverse=True, return_counts=True)
    copies = int(np.gcd.reduce(number))
    if copies < 2:
        return None
    order = np.argsort(place.reshape(-1), kind="stable")
    rank = np.arange(len(order)) - np.repeat(np.cumsum(number) - number, number)
    repeated = np.empty(len(points), bool)
    repeated[order] = rank >= np.repeat(number // copies, number)
    return repeated


def _keep_one_per_group(points: np.ndarray, radius: float) -> np.ndarray:
    """Return the indices of the first point of each group, whose points (N, 3) are linked by distances to a radius."""
    kept = np.sort(np.unique(points, axis=0, return_index=True)[1])
    while len(kept) > 1:
        left = points[kept]
        found: Any = KDTree(left).query(left, k=min(_LINKED, len(kept)), distance_upper_bound=radius, workers=-1)
        place, rank = np.nonzero(np.isfinite(found[0]))
        links = coo_array((np.ones(len(place), bool), (place, found[1][place, rank])), shape=(len(kept),) * 2)
        first = np.unique(connected_components(links, directed=False)[1], return_index=True)[1]
        if len(first) == len(kept):
            break
        kept = kept[np.sort(first)]
    return kept


def _judge_neighbours(points: np.ndarray) -> tuple[float | None, bool]:
    """Return the radius that contains the copies of a point, None without copies; and whether most points have equals.

    Neighbours are counted for a sample of the points (N, 3).
    """
    sample = points[:: max(1, len(points) // _SAMPLED)]
    steps = np.multiply(_STEPS, _find_step(points))
    radii = np.multiply.outer([*steps, max(steps[-1], _MOVED_MM)], (1.0, _WIDER))
    # Each point of the sample is also a neighbour of itself.
    counts = KDTree(sample).count_neighbors(KDTree(points), radii.ravel()).reshape(radii.shape) - len(sample)
    copies = (counts[:, 0] >= _FEWEST_COPIES) & (counts[:, 1] < _FEWEST_PER_COPY * counts[:, 0])
    radius = float(radii[np.argmax(copies), 0]) if copies.any() else None
    return radius, bool(counts[0, 0] >= len(sample))


def _find_step(points: np.ndarray) -> float:
    """Return the step in which the coordinates of points (N, 3) are stored, at least a micrometre.

    Different points coincide only if all axes have steps, so the step is that of the finest axis.
    """
    steps = []
    for values in points.T:
        gaps = np.diff(np.unique(values).astype(float))
        gaps = gaps[gaps > _NO_STEP_MM]
        if len(gaps):
            counted = gaps / gaps.min()
            steps.append(float(gaps.min()) if np.abs(counted - np.round(counted)).max() < _MULTIPLE else 0.0)
    return max(min(steps, default=0.0), _FINEST_MM)
