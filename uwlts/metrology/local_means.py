"""Means of a surface's points within discs across its normals, and their variance: the two sides of M3C2."""

from __future__ import annotations

from collections.abc import Iterator
from typing import NamedTuple

import numpy as np
from scipy.spatial import KDTree
from scipy.stats import t as t_distribution

from uwlts.storage.cloud import PointUncertainty, variance_along

TWO_SIDED = 1.96
"""Standard normal quantile of 97.5 %."""
FEWEST = 5
"""Points in a disc; with fewer the roughness is not known."""
_NEARLY_NORMAL = 200
"""Points from which Student's quantile is within 1 % of the normal one."""
_PAIRS_AT_A_TIME = 2_000_000


class LocalMeans(NamedTuple):
    """Mean (P,) of the points at P places along the normal, NaN where there are too few, and its variance (P,)."""

    mean_mm: np.ndarray
    variance_mm2: np.ndarray


def local_means(
    places: np.ndarray,
    normals: np.ndarray,
    points: np.ndarray,
    *,
    distance_mm: np.ndarray | None = None,
    uncertainty: PointUncertainty | None,
    frame: np.ndarray | None,
    disc_mm: float,
    deep_mm: float,
) -> LocalMeans:
    """Average points (N, 3) within discs across normals (P, 3) at places (P, 3).

    What is averaged are the points' distances from the place along its normal, or ``distance_mm`` (N,) from a reference
    that is known everywhere. The variance is by the points' noise, or by their scatter where that is larger, over their
    number; by the position of each image; and by what all points share. That of a scatter from n points counts as much
    more as Student's t of n - 1 degrees of freedom is wider than the normal distribution.
    """
    count, mean, variance = (np.zeros(len(places)) for _ in range(3))
    radius = float(np.hypot(disc_mm / 2, deep_mm))
    for place, point in _neighbours(KDTree(points), places, radius):
        away = points[point] - places[place]
        along = np.einsum("ni,ni->n", away, normals[place])
        across = np.einsum("ni,ni->n", away, away) - along**2
        inside = (across <= (disc_mm / 2) ** 2) & (np.abs(along) <= deep_mm)
        if distance_mm is not None:
            along = distance_mm[point]
            inside &= np.isfinite(along)
        place, point, along = place[inside], point[inside], along[inside]
        here = np.unique(place)
        number = np.bincount(place, minlength=len(places))
        total = np.bincount(place, along, minlength=len(places))
        centre = total / np.maximum(number, 1)
        scatter = np.bincount(place, (along - centre[place]) ** 2, minlength=len(places)) / np.maximum(number - 1, 1)
        count[here], mean[here] = number[here], centre[here]
        rough = scatter / np.maximum(number, 1) * _wider(number) ** 2
        if uncertainty is not None:
            rough = _known_variance(place, point, normals, uncertainty, frame, number, rough)
        variance[here] = rough[here]
    mean[count < FEWEST] = np.nan
    return LocalMeans(mean, variance)


def _wider(number: np.ndarray) -> np.ndarray:
    """Ratio (P,) of Student's quantile to the normal one, for a standard deviation from so many points."""
    table = np.ones(_NEARLY_NORMAL + 1)
    table[2:_NEARLY_NORMAL] = t_distribution.ppf(0.975, np.arange(1, _NEARLY_NORMAL - 1)) / TWO_SIDED
    return table[np.minimum(number, _NEARLY_NORMAL)]


def _neighbours(tree: KDTree, places: np.ndarray, radius: float) -> Iterator[tuple[np.ndarray, np.ndarray]]:
    """Numbers of places and of the points near them, pair by pair, some places at a time."""
    counts = tree.query_ball_point(places, radius, return_length=True, workers=-1)
    part = np.cumsum(counts) // _PAIRS_AT_A_TIME
    for number in np.unique(part):
        chosen = np.flatnonzero(part == number)
        found = tree.query_ball_point(places[chosen], radius, workers=-1)
        lengths = np.array([len(each) for each in found])
        if lengths.sum():
            yield np.repeat(chosen, lengths), np.concatenate([np.asarray(each, np.intp) for each in found])


def _known_variance(
    place: np.ndarray,
    point: np.ndarray,
    normals: np.ndarray,
    known: PointUncertainty,
    frame: np.ndarray | None,
    number: np.ndarray,
    rough: np.ndarray,
) -> np.ndarray:
    """Variance (P,) of the mean of each place's points along the normal: single points, images, and what all share."""
    size, normal, many = len(number), normals[place], np.maximum(number, 1)
    single = variance_along(known.random_mm2[point], normal)
    result = np.maximum(rough, np.bincount(place, single, minlength=size) / many**2)
    moved = np.einsum("ni,ni->n", known.position_mm[point], normal)
    image = np.arange(len(point)) if frame is None else frame[point].astype(np.int64)
    # Points of one image move together, those of different images do not.
    group, owner = np.unique(np.column_stack([place, image]), axis=0, return_inverse=True)
    together = np.bincount(owner.ravel(), moved / many[place])
    result += np.bincount(group[:, 0], together**2, minlength=size)
    for pattern in known.patterns_mm:
        along = np.einsum("ni,ni->n", pattern[point], normal)
        result += (np.bincount(place, along, minlength=size) / many) ** 2
    return result
