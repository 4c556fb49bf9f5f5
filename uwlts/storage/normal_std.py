"""Random and common standard deviation of each point along the surface normal, to show and for lean files."""

import numpy as np

from uwlts.storage.cloud import NO_INDEX, PointCloud, PointUncertainty, project_variance

_STEPS_STD = 20.0
"""Ratio of the distance between the points that give a direction and their noise: 0.07 rad of error, whose cosine
changes the result by 0.3 %."""
_SAMPLED = 2000  # number of points for the median distance between neighbours


def compute_normal_std(cloud: PointCloud) -> tuple[np.ndarray | None, np.ndarray | None]:
    """Return the random and the common standard deviation (N,) in mm along the surface normal; None if unknown.

    The random one is by noise and by errors of single images, the common one by errors that all points share. Those
    stored with a cloud are returned if it contains no more.

    The normal is that of the directions to a point on the same image line in another image, and to another point of the
    same image. Of both sides the nearer point is used, which is on the same side of an edge. For a point without such
    neighbours, the direction of its largest standard deviation is used.
    """
    known = cloud.uncertainty
    if known is None:
        return cloud.random_std_mm, cloud.common_std_mm
    normals = np.cross(_directions(cloud, known, "frame"), _directions(cloud, known, "line"))
    length = np.linalg.norm(normals, axis=1)
    lost = length == 0
    normals = normals / np.where(lost, 1.0, length)[:, None]
    normals[lost] = np.linalg.eigh(known[lost].covariance_mm2().astype(np.float64))[1][:, :, -1]
    random, common = (
        np.sqrt(np.maximum(project_variance(pairs, normals), 0)).astype(np.float32)
        for pairs in (known.independent_mm2(), known.systematic_mm2())
    )
    return random, common


PointCloud.normal_std = staticmethod(compute_normal_std)


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
