"""Standard deviation of each point along the surface normal, for files that hold no more of the uncertainty."""

import numpy as np

from uwlts.storage.cloud import NO_INDEX, PointCloud, PointUncertainty

_STEPS_STD = 20.0
"""Ratio of the distance between the points that give a direction and their noise: 0.07 rad of error, whose cosine
changes the result by 0.3 %."""
_SAMPLED = 2000
"""Number of points for the median distance between neighbours."""


def compute_normal_std(cloud: PointCloud) -> np.ndarray | None:
    """Return the total standard deviation (N,) in mm along the surface normal; None if the uncertainty is unknown.

    The normal is that of the directions to a point on the same image line in another image, and to another point of the
    same image. Of both sides the nearer point is used, which is on the same side of an edge. A point without such
    neighbours has the largest standard deviation of all directions.
    """
    known = cloud.uncertainty
    if known is None:
        return None
    covariance = known.covariance_mm2().astype(np.float64)
    normals = np.cross(_directions(cloud, known, "frame"), _directions(cloud, known, "line"))
    length = np.linalg.norm(normals, axis=1)
    found = length > 0
    variance = np.empty(len(cloud))
    units = normals[found] / length[found, None]
    variance[found] = np.einsum("ni,nij,nj->n", units, covariance[found], units)
    variance[~found] = np.linalg.eigvalsh(covariance[~found])[:, -1]
    return np.sqrt(np.maximum(variance, 0)).astype(np.float32)


def _directions(cloud: PointCloud, known: PointUncertainty, along: str) -> np.ndarray:
    """Return vectors (N, 3) to a neighbour whose ``along`` ("frame" or "line") alone differs; 0 without neighbours."""
    result = np.zeros((len(cloud), 3))
    frame, line = cloud.frame.astype(np.int64), cloud.line.astype(np.int64)
    if not len(cloud) or (frame == NO_INDEX).any() or (line == NO_INDEX).any():
        return result
    # Lines beyond the last one keep neighbours of the next image apart.
    count = 2 * int(line.max() + 1)
    keys = frame * count + line
    order = np.argsort(keys, kind="stable")
    ordered, unit = keys[order], count if along == "frame" else 1
    noise = float(np.sqrt(np.median(known.random_mm2[:, [0, 3, 5]].sum(axis=1))))
    sample = np.arange(0, len(cloud), max(1, len(cloud) // _SAMPLED))
    near = np.linalg.norm(_to_neighbours(cloud.points_mm, keys, ordered, order, sample, unit), axis=1)
    spacing = float(np.median(near[near < np.inf])) if (near < np.inf).any() else 0.0
    steps = max(1, int(np.ceil(_STEPS_STD * noise / spacing))) if spacing else 1
    steps = min(steps, max(1, count // 4 if along == "line" else int(np.ptp(frame))))
    every = np.arange(len(cloud))
    sides = [_to_neighbours(cloud.points_mm, keys, ordered, order, every, side * steps * unit) for side in (1, -1)]
    lengths = [np.linalg.norm(side, axis=1) for side in sides]
    chosen = np.where((lengths[0] <= lengths[1])[:, None], sides[0], sides[1])
    return np.where(np.isfinite(chosen), chosen, 0.0)


def _to_neighbours(
    points_mm: np.ndarray, keys: np.ndarray, ordered: np.ndarray, order: np.ndarray, chosen: np.ndarray, away: int
) -> np.ndarray:
    """Return vectors (K, 3) from chosen (K,) points to those whose key differs by ``away``; infinite without one."""
    wanted = keys[chosen] + away
    place = np.minimum(np.searchsorted(ordered, wanted), len(ordered) - 1)
    found = ordered[place] == wanted
    return np.where(found[:, None], points_mm[order[place]] - points_mm[chosen], np.inf)
