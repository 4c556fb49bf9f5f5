"""Local means of points along surface normals, and their variance (M3C2)."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from itertools import chain, pairwise
from typing import NamedTuple

import numpy as np
from scipy import special
from scipy.spatial import KDTree

from uwlts.registration.surface_registration import SurfaceSample
from uwlts.storage.cloud import PointUncertainty, project_variance


@dataclass(frozen=True)
class ComparisonOptions:
    """Settings that decide what a comparison reports.

    ``quiet_share`` was chosen on simulated pairs of clouds without a change. The history of the other values names no
    data; the reasons beside them follow from the method.
    """

    most_places: int = 20_000
    """Largest number of compared places. More take longer without a finer result."""
    depth_per_disc: float = 3.0  # default search depth along the normal, in disc diameters
    fewest_points: int = 5  # least number of points in a disc: with fewer, the roughness is unknown
    quiet_share: float = 0.8
    """Fraction of the places, those of the lowest scatter, used to estimate the noise correlation within an image.
    The others may contain edges."""
    area_neighbours: int = 12  # number of neighbours used to estimate the area of a place
    fewest_of_region: int = 4
    """Least number of places of a reported region. Discs of neighbours overlap, so chance also produces pairs."""
    other_unit_ratio: float = 50.0
    """Ratio of two sizes that indicates different units: between 1 and the 1000 of mm and m."""


OPTIONS = ComparisonOptions()


TWO_SIDED = 1.96  # standard normal quantile of 97.5 %
_NEARLY_NORMAL = 200  # least number of points with Student's quantile within 1 % of the normal one
_PAIRS_AT_A_TIME = 2_000_000  # to limit memory


class LocalMeans(NamedTuple):
    """Mean (P,) along the normal of the points at P places, and its variance (P,); NaN with too few points.

    The variance excludes the systematic patterns. One standard deviation of each shifts the mean by ``patterns_mm``
    (P, M).
    """

    mean_mm: np.ndarray
    variance_mm2: np.ndarray
    patterns_mm: np.ndarray


def average_locally(
    places: np.ndarray,
    normals: np.ndarray,
    surface: SurfaceSample,
    *,
    distance_mm: np.ndarray | None = None,
    disc_mm: float,
    deep_mm: float | np.ndarray,
) -> LocalMeans:
    """Average the signed distances of points in discs perpendicular to the normals at P places.

    The variance is the larger of the propagated variance (noise of points, position of images) and the empirical
    scatter. The scatter is corrected for correlation within an image, and by Student's t for the number of points.

    ``places`` and ``normals`` (P, 3) are the centres of the discs and unit normals there. ``distance_mm`` (N,) is by
    default measured from each place along its normal. Points farther than ``deep_mm`` (one number, or one for each
    place) along the normal are left out.
    """
    points, uncertainty, frame = surface.points_mm, surface.uncertainty, surface.frame
    count, mean, rough, stated, other = (np.zeros(len(places)) for _ in range(5))
    together, alone = np.zeros(len(places)), np.zeros(len(places))
    patterns = np.zeros((len(places), 0 if uncertainty is None else len(uncertainty.patterns_mm)))
    deep = np.broadcast_to(deep_mm, len(places))
    radius = float(np.hypot(disc_mm / 2, deep.max(initial=0.0)))
    for block, place, point in _pair_blocks(KDTree(points), places, radius):
        # The numbers of places count within the block: no array of a block has the size of all places.
        size, own_normals = block.stop - block.start, normals[block]
        offset = points[point] - places[block][place]
        along = np.einsum("ni,ni->n", offset, own_normals[place])
        across = np.einsum("ni,ni->n", offset, offset) - along**2
        inside = (across <= (disc_mm / 2) ** 2) & (np.abs(along) <= deep[block][place])
        if distance_mm is not None:
            along = distance_mm[point]
            inside &= np.isfinite(along)
        place, point, along = place[inside], point[inside], along[inside]
        number = np.bincount(place, minlength=size)
        centre = np.bincount(place, along, minlength=size) / np.maximum(number, 1)
        off = along - centre[place]
        scatter = np.bincount(place, off**2, minlength=size) / np.maximum(number - 1, 1)
        count[block], mean[block] = number, centre
        rough[block] = scatter / np.maximum(number, 1) * _compute_student_ratio(number) ** 2
        if frame is not None:
            together[block], alone[block] = _sum_by_images(place, frame[point], off, scatter, number)
        if uncertainty is not None:
            found = _propagate_variance(place, point, own_normals, uncertainty, frame, number)
            stated[block], other[block], patterns[block] = found
    # The empirical scatter includes that between images.
    variance = np.maximum(_estimate_correlation_factor(together, alone, count) * rough, stated + other)
    mean[count < OPTIONS.fewest_points] = np.nan
    return LocalMeans(mean, variance, patterns)


def _compute_student_ratio(number: np.ndarray) -> np.ndarray:
    """Return the ratio (P,) of Student's quantile to the normal one for numbers of points (P,)."""
    table = np.ones(_NEARLY_NORMAL + 1)
    table[2:_NEARLY_NORMAL] = special.stdtrit(np.arange(1, _NEARLY_NORMAL - 1), 0.975) / TWO_SIDED
    return table[np.minimum(number, _NEARLY_NORMAL)]


def _pair_blocks(tree: KDTree, places: np.ndarray, radius: float) -> Iterator[tuple[slice, np.ndarray, np.ndarray]]:
    """Yield blocks of places, with the numbers of places within the block and of points of nearby pairs."""
    counts = tree.query_ball_point(places, radius, return_length=True, workers=-1)
    starts = np.flatnonzero(np.diff(np.cumsum(counts) // _PAIRS_AT_A_TIME, prepend=-1)).tolist()
    for start, end in pairwise([*starts, len(places)]):
        found = tree.query_ball_point(places[start:end], radius, workers=-1)
        lengths = counts[start:end]
        if lengths.sum():
            point = np.fromiter(chain.from_iterable(found), np.intp, int(lengths.sum()))
            yield slice(start, end), np.repeat(np.arange(end - start), lengths), point


def _propagate_variance(
    place: np.ndarray,
    point: np.ndarray,
    normals: np.ndarray,
    known: PointUncertainty,
    frame: np.ndarray | None,
    number: np.ndarray,
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return the variance (P,) of each mean by points and by images, and its shift (P, M) by systematic patterns."""
    size, normal, many = len(number), normals[place], np.maximum(number, 1)
    single = np.bincount(place, project_variance(known.random_mm2[point], normal), minlength=size) / many**2
    image = np.arange(len(point)) if frame is None else frame[point].astype(np.int64)
    # Position errors are fully correlated within an image and independent between images.
    group, owner = _place_images(place, image)
    result = np.zeros(size)
    for part in known.image_errors_mm():
        moved = np.einsum("ni,ni->n", part[point], normal)
        together = np.bincount(owner, moved / many[place])
        result += np.bincount(group, together**2, minlength=size)
    moves = np.zeros((size, len(known.patterns_mm)))
    for number_of, pattern in enumerate(known.patterns_mm):
        along = np.einsum("ni,ni->n", pattern[point], normal)
        moves[:, number_of] = np.bincount(place, along, minlength=size) / many
    return single, result, moves


def _sum_by_images(
    place: np.ndarray, image: np.ndarray, off: np.ndarray, scatter: np.ndarray, number: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Return the squared sums (P,) of residuals of each image, and their expectation for independent points.

    The residuals of a place sum to zero, which reduces the expectation by the squared fraction of each image.
    """
    group, owner = _place_images(place, image)
    sums, counts = np.bincount(owner, off), np.bincount(owner)
    size = len(number)
    squares = np.bincount(group, sums**2, minlength=size)
    shares = np.bincount(group, counts.astype(float) ** 2, minlength=size) / np.maximum(number, 1)
    return squares, scatter * np.maximum(number - shares, 0)


def _place_images(place: np.ndarray, image: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the place (G,) of each group of pairs of one place and one image, and the group (N,) of each pair."""
    least = int(image.min(initial=0))
    many = int(image.max(initial=0)) - least + 1
    keys, owner = np.unique(place * many + (image - least), return_inverse=True)
    return keys // many, owner


def _estimate_correlation_factor(together: np.ndarray, alone: np.ndarray, count: np.ndarray) -> float:
    """Return the factor (at least 1) by which correlated noise within an image increases the variance of means.

    It is estimated from all places together, because each has few images. Places of high scatter are excluded, since
    they may hold edges.
    """
    full = (count >= OPTIONS.fewest_points) & (alone > 0)
    if not full.any():
        return 1.0
    usual = full & (alone <= np.quantile(alone[full], OPTIONS.quiet_share))
    return max(1.0, float(together[usual].sum() / alone[usual].sum()))
