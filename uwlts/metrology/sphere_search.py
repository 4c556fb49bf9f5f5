"""Finds a sphere of known radius in a cloud that may hold other surfaces and outliers."""

from dataclasses import dataclass

import numpy as np
from scipy.spatial import KDTree
from scipy.spatial.distance import cdist

from uwlts.errors import EvaluationError
from uwlts.metrology.robust_fit import DEFAULT_K, MAD_TO_STD, RobustFit, fit_robustly
from uwlts.metrology.round_fits import SphereFit, fit_sphere

LEAST_POINTS = 50
"""A sphere is judged by at least so many points."""

# All shares are of the known radius.
_SEARCH_LIMIT = 0.05
_LARGEST_LIMIT = 0.1
_SMALLEST_LIMIT = 1e-4
_RADIUS_TOLERANCE = 0.1
_CELL = 0.12
_THINNING = 1 / 15

_THINNED = 4000
_SCREENED = 1000
_SEEDS = 2000
_KEPT = (150, 8)
_ATTEMPTS = 3
_OUTER_SHARE = 0.1
_OUTER_COUNT = 2


@dataclass(frozen=True, eq=False)
class FoundSphere:
    """A sphere in a cloud and which points belong to it.

    Attributes
    ----------
    robust : RobustFit of SphereFit
        Free-radius fit to the points that belong to the sphere, `members` in their order.
    members : (M,) int
        Indices of those points in the cloud.
    near : (N,) bool
        All points of the cloud within three limits of the sphere, mixed ones included.
    points_mixed : int
        Points on the sphere where another surface crosses it, which do not belong.
    """

    robust: RobustFit[SphereFit]
    members: np.ndarray
    near: np.ndarray
    points_mixed: int

    @property
    def used(self) -> np.ndarray:
        """Indices (K,) in the cloud of the points that the fit rests on."""
        return self.members[self.robust.inliers]


def find_sphere(
    points: np.ndarray, radius_mm: float, *, usable: np.ndarray, rng: np.random.Generator
) -> FoundSphere | None:
    """The best supported sphere of this radius among the usable points, or None.

    Centres are proposed by triples of neighbouring points (two spheres of known radius pass through three points),
    judged by the number of points near the surface of the thinned cloud (RANSAC), refined, and accepted when the
    points found there have the known radius within a tenth by themselves.

    Points belong to the sphere when they lie within three limits of it (a limit is five robust standard deviations,
    at most a tenth of the radius), except where two points and more than 10 % of those within a patch of about 0.12
    radius lie beyond one limit: there another surface, a wall or a stem, crosses the sphere.

    Parameters
    ----------
    points : (N, 3), mm
    usable : (N,) bool
    """
    usable = usable.copy()
    for _ in range(_ATTEMPTS):
        if np.count_nonzero(usable) < LEAST_POINTS:
            return None
        thinned = _thinned(points[usable], radius_mm * _THINNING, rng)
        centre = _best_centre(thinned, radius_mm, rng)
        if centre is None:
            return None
        found = _accepted(points, usable, centre, radius_mm)
        if found is not None:
            return found
        usable &= np.abs(np.linalg.norm(points - centre, axis=1) - radius_mm) > _SEARCH_LIMIT * radius_mm
    return None


def _thinned(points: np.ndarray, cell_mm: float, rng: np.random.Generator) -> np.ndarray:
    """One point of each cell of a cubic grid, so that density does not count, and at most 4000 of them."""
    cells = np.floor((points - points.min(axis=0)) / cell_mm).astype(np.int64)
    _, first = np.unique(cells @ _key_factors(cells), return_index=True)
    return points[rng.permutation(first)[:_THINNED]]


def _key_factors(cells: np.ndarray) -> np.ndarray:
    size = cells.max(axis=0) + 1
    return np.array([size[1] * size[2], size[2], 1])


def _best_centre(points: np.ndarray, radius: float, rng: np.random.Generator) -> np.ndarray | None:
    """The proposed and refined centre with most points near its sphere."""
    centres = _proposed_centres(points, radius, rng)
    limit = _SEARCH_LIMIT * radius
    for sample, kept in zip((points[:_SCREENED], points), _KEPT, strict=True):
        if not len(centres):
            return None
        support = np.count_nonzero(np.abs(cdist(centres, sample) - radius) < limit, axis=1)
        centres = centres[np.argsort(-support, kind="stable")[:kept]]
    refined = np.array([_refined_centre(points, centre, radius) for centre in centres])
    support = np.count_nonzero(np.abs(cdist(refined, points) - radius) < limit, axis=1)
    return refined[np.argmax(support)]


def _proposed_centres(points: np.ndarray, radius: float, rng: np.random.Generator) -> np.ndarray:
    """Centres (M, 3) of the spheres through triples of points that lie within one radius of their first point."""
    seeds = rng.integers(len(points), size=_SEEDS)
    balls = KDTree(points).query_ball_point(points[seeds], radius)
    picks = rng.random((_SEEDS, 2))
    triples = np.array(
        [
            (seed, *(ball[int(pick * len(ball))] for pick in pair))
            for seed, ball, pair in zip(seeds, balls, picks, strict=True)
        ]
    )
    first, second, third = points[triples[:, 0]], points[triples[:, 1]], points[triples[:, 2]]
    # Circumcentre of a triangle with the sides a, b from its first corner: ((|a|2 b - |b|2 a) x (a x b)) / 2 |a x b|2.
    a, b = second - first, third - first
    normal = np.cross(a, b)
    area = np.sum(normal**2, axis=1)
    proper = area > (1e-3 * radius**2) ** 2
    a, b, normal, area, first = a[proper], b[proper], normal[proper], area[proper, None], first[proper]
    foot = np.cross(np.sum(a**2, axis=1)[:, None] * b - np.sum(b**2, axis=1)[:, None] * a, normal) / (2 * area)
    height = radius**2 - np.sum(foot**2, axis=1)
    fits = height > 0
    rise = normal[fits] * np.sqrt(height[fits, None] / area[fits])
    return np.vstack([first[fits] + foot[fits] + rise, first[fits] + foot[fits] - rise])


def _refined_centre(points: np.ndarray, centre: np.ndarray, radius: float) -> np.ndarray:
    """A few Gauss-Newton steps with known radius on the points within the search limit."""
    for _ in range(4):
        away = points - centre
        distance = np.linalg.norm(away, axis=1)
        near = np.abs(distance - radius) < _SEARCH_LIMIT * radius
        if np.count_nonzero(near) < 4:
            return centre
        unit = away[near] / distance[near, None]
        step, *_ = np.linalg.lstsq(unit, distance[near] - radius, rcond=1e-3)
        centre = centre + step
    return centre


def _accepted(points: np.ndarray, usable: np.ndarray, centre: np.ndarray, radius: float) -> FoundSphere | None:
    """The sphere at this place if its points bear out the radius."""
    distances = np.linalg.norm(points - centre, axis=1) - radius
    limit = _SEARCH_LIMIT * radius
    for _ in range(8):
        mixed = _crossed_by_others(points - centre, distances, limit, usable)
        members = np.flatnonzero(usable & ~mixed & (np.abs(distances) <= limit))
        if len(members) < LEAST_POINTS:
            return None
        try:
            fit = fit_sphere(points[members])
        except EvaluationError:
            return None
        if abs(fit.radius_mm - radius) > _RADIUS_TOLERANCE * radius:
            return None
        centre, distances, last = fit.centre_mm, fit.distances_mm(points), limit
        spread = MAD_TO_STD * float(np.median(np.abs(fit.residuals_mm - np.median(fit.residuals_mm))))
        limit = min(max(DEFAULT_K * spread, _SMALLEST_LIMIT * radius), _LARGEST_LIMIT * radius)
        if abs(limit - last) <= 0.05 * last:
            break
    mixed = _crossed_by_others(points - centre, distances, limit, usable)
    near = np.abs(distances) <= 3 * limit
    members = np.flatnonzero(usable & ~mixed & near)
    points_mixed = int(np.count_nonzero(usable & mixed & (np.abs(distances) <= limit)))
    if points_mixed > len(members):
        return None
    robust = fit_robustly(fit_sphere, points[members])
    return FoundSphere(robust, members, near, points_mixed)


def _crossed_by_others(away: np.ndarray, distances: np.ndarray, limit: float, usable: np.ndarray) -> np.ndarray:
    """Points (N,) bool in patches where many points lie between one and three limits from the sphere.

    The sphere itself leaves that band nearly empty; a surface that crosses it fills the band twice as much as the
    limit itself.
    """
    near = np.flatnonzero(usable & (np.abs(distances) <= 3 * limit))
    crossed = np.zeros(len(away), dtype=bool)
    if not len(near):
        return crossed
    direction = away[near] / np.linalg.norm(away[near], axis=1, keepdims=True)
    cells = np.floor((direction + 1.0) / _CELL).astype(np.int64)
    _, cell = np.unique(cells @ _key_factors(cells), return_inverse=True)
    outer = np.bincount(cell, weights=np.abs(distances[near]) > limit)
    total = np.bincount(cell)
    crossed[near] = ((outer >= _OUTER_COUNT) & (outer > _OUTER_SHARE * total))[cell]
    return crossed
