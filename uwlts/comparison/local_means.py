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
_WITHOUT_EDGES = 0.8
"""Share of the places from which the noise that neighbours share is taken: the others scatter more than noise does."""
_PAIRS_AT_A_TIME = 2_000_000


class LocalMeans(NamedTuple):
    """Mean (P,) of the points at P places along the normal, NaN where there are too few, and its variance (P,).

    The variance is without that by the patterns that all points share, which move the mean by ``patterns_mm`` (P, M).
    """

    mean_mm: np.ndarray
    variance_mm2: np.ndarray
    patterns_mm: np.ndarray


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
    that is known everywhere. The variance is by the points' noise and the position of each image, or by the points'
    scatter, more where those of an image err together, where that is larger.
    A scatter from n points counts as much more as Student's t of n - 1 degrees of freedom is wider than the normal
    distribution.
    """
    count, mean, rough, stated, other = (np.zeros(len(places)) for _ in range(5))
    together, alone = np.zeros(len(places)), np.zeros(len(places))
    patterns = np.zeros((len(places), 0 if uncertainty is None else len(uncertainty.patterns_mm)))
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
        centre = np.bincount(place, along, minlength=len(places)) / np.maximum(number, 1)
        off = along - centre[place]
        scatter = np.bincount(place, off**2, minlength=len(places)) / np.maximum(number - 1, 1)
        count[here], mean[here] = number[here], centre[here]
        rough[here] = (scatter / np.maximum(number, 1) * _wider(number) ** 2)[here]
        if frame is not None:
            sums, expected = _of_images(place, frame[point], off, scatter, number)
            together[here], alone[here] = sums[here], expected[here]
        if uncertainty is not None:
            single, images, shared = _stated(place, point, normals, uncertainty, frame, number)
            stated[here], other[here], patterns[here] = single[here], images[here], shared[here]
    # The scatter of whole images is part of what is seen.
    variance = np.maximum(_neighbours_share(together, alone, count) * rough, stated + other)
    mean[count < FEWEST] = np.nan
    return LocalMeans(mean, variance, patterns)


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


def _stated(
    place: np.ndarray,
    point: np.ndarray,
    normals: np.ndarray,
    known: PointUncertainty,
    frame: np.ndarray | None,
    number: np.ndarray,
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Variances (P,) of each place's mean by single points and by images, and its moves (P, M) by patterns."""
    size, normal, many = len(number), normals[place], np.maximum(number, 1)
    single = np.bincount(place, variance_along(known.random_mm2[point], normal), minlength=size) / many**2
    image = np.arange(len(point)) if frame is None else frame[point].astype(np.int64)
    # Points of one image move together, those of different images do not.
    group, owner = np.unique(np.column_stack([place, image]), axis=0, return_inverse=True)
    result = np.zeros(size)
    for part in known.by_image_mm():
        moved = np.einsum("ni,ni->n", part[point], normal)
        together = np.bincount(owner.ravel(), moved / many[place])
        result += np.bincount(group[:, 0], together**2, minlength=size)
    moves = np.zeros((size, len(known.patterns_mm)))
    for number_of, pattern in enumerate(known.patterns_mm):
        along = np.einsum("ni,ni->n", pattern[point], normal)
        moves[:, number_of] = np.bincount(place, along, minlength=size) / many
    return single, result, moves


def _of_images(
    place: np.ndarray, image: np.ndarray, off: np.ndarray, scatter: np.ndarray, number: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Squares of the sums (P,) of each image's points off their place's mean, and what independent points would give.

    The sums of all images of a place add up to zero, which takes the squares of the images' shares off.
    """
    group, owner = np.unique(np.column_stack([place, image]), axis=0, return_inverse=True)
    sums, counts = np.bincount(owner.ravel(), off), np.bincount(owner.ravel())
    size = len(number)
    squares = np.bincount(group[:, 0], sums**2, minlength=size)
    shares = np.bincount(group[:, 0], counts.astype(float) ** 2, minlength=size) / np.maximum(number, 1)
    return squares, scatter * np.maximum(number - shares, 0)


def _neighbours_share(together: np.ndarray, alone: np.ndarray, count: np.ndarray) -> float:
    """Factor (1 or more) on the variance of means because neighbours in an image err together.

    Of all places at once, as each has few images; those that scatter most, which hold edges, do not count.
    """
    full = (count >= FEWEST) & (alone > 0)
    if not full.any():
        return 1.0
    usual = full & (alone <= np.quantile(alone[full], _WITHOUT_EDGES))
    return max(1.0, float(together[usual].sum() / alone[usual].sum()))
