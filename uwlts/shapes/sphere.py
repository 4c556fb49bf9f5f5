"""Spheres: orthogonal-distance fit, and detection of spheres of known radius in clouds."""

from dataclasses import dataclass
from typing import Any, Self

import numpy as np
from scipy.spatial import KDTree
from scipy.spatial.distance import cdist

from uwlts.errors import EvaluationError
from uwlts.fitting.least_squares import (
    DEFAULT_K,
    LARGEST_RELATIVE_STD,
    RobustFit,
    fit_robustly,
    minimise_squares,
    parameter_covariance,
    robust_std,
)
from uwlts.fitting.local_surface import number_cubes
from uwlts.shapes.flat import fit_algebraic_centres, initial_centre, prepare_round, unit_vectors

LEAST_POINTS = 50  # least number of points of a sphere

_SEARCH_LIMIT = 0.05  # half width (unit: radius) of the band of points that support a proposed sphere
_LARGEST_LIMIT = 0.1  # largest half width (unit: radius) of the band of a sphere's points
_SMALLEST_LIMIT = 1e-4  # smallest half width (unit: radius), for exact points without scatter
_RADIUS_TOLERANCE = 0.1  # largest relative error of a fitted radius
_CELL = 0.12  # size (unit: radius) of cells for the detection of other surfaces
_THINNING = 1 / 15  # size (unit: radius) of cells that keep one point each for the search
_THINNED = 4000  # number of points for scoring centres; more take longer without a benefit
_SCREENED = 1000  # number of points for the first screening
_SEEDS = 2000  # number of proposed centres
_KEPT_OF_SCREENING = 150  # number of centres kept by the screening
_KEPT = 8  # number of refined centres
_ATTEMPTS = 3  # number of searches, each with new random seeds
_OUTER_SHARE = 0.1
"""Fraction of a cell's points beyond the limit that indicates another surface; for noise it is 6 in ten million."""
_OUTER_COUNT = 2  # least number of such points


@dataclass(frozen=True, eq=False)
class Sphere:
    """Sphere of fitted or known radius."""

    centre_mm: np.ndarray  # (3,)
    radius_mm: float
    residuals_mm: np.ndarray  # (N,); signed distances |p - centre| - radius, positive outside
    std_mm: float  # standard deviation of the residuals; the degrees of freedom are N minus the number of parameters
    covariance: np.ndarray
    """(4, 4) or (3, 3); covariance of the centre and, if free, the radius, mm2, for equal independent noise of all
    points."""

    def distances_mm(self, points: np.ndarray) -> np.ndarray:
        """Return the signed distances (M,) of points (M, 3), as in `residuals_mm`."""
        return np.linalg.norm(np.asarray(points, dtype=np.float64) - self.centre_mm, axis=1) - self.radius_mm

    def normals_at(self, points: np.ndarray) -> np.ndarray:
        """Return the unit normals (M, 3) of the distances of points (M, 3), outwards."""
        return unit_vectors(points - self.centre_mm)

    def derivatives(self, points: np.ndarray) -> np.ndarray:
        """Return the derivatives (M, 4) or (M, 3) of the distances by the parameters, in the order of the covariance.

        The derivative of |p - c| - r is minus the unit vector from the centre, and -1 for a free radius.
        """
        return _compute_derivatives(points, self.centre_mm, free=len(self.covariance) - 3)

    @classmethod
    def fit(cls, points: Any, radius_mm: float | None = None) -> Self:
        """Fit a sphere of free or known radius to points (N, 3), mm, by least squares; a cap suffices.

        Raises EvaluationError if there are fewer than 5 points (4 with known radius), or they are not finite or in one
        plane. The same if the standard uncertainty of the centre exceeds a fifth of the radius.
        """
        unit, known = prepare_round(points, radius_mm, least=5, what="a sphere fit")
        parameters, cost = minimise_squares(
            lambda x: np.linalg.norm(unit.points - x[:3], axis=1) - (x[3] if known is None else known),
            lambda x: _compute_derivatives(unit.points, x[:3], free=len(x) - 3),
            np.hstack(fit_algebraic_centres(unit.points)) if known is None else initial_centre(unit.points, known),
        )
        jacobian = _compute_derivatives(unit.points, parameters[:3], free=len(parameters) - 3)
        covariance, std = parameter_covariance(jacobian, cost, what="a sphere")
        centre = unit.centroid_mm + unit.scale_mm * parameters[:3]
        radius = float(radius_mm if radius_mm is not None else parameters[3] * unit.scale_mm)
        uncertainty = float(np.sqrt(np.trace(covariance[:3, :3]))) * unit.scale_mm
        if uncertainty > LARGEST_RELATIVE_STD * radius:
            raise EvaluationError(
                f"the {len(unit.points)} points do not determine a sphere: its centre would be uncertain by "
                f"{uncertainty:.3g} mm, its radius {radius:.3g} mm; they may lie on a plane"
            )
        residuals = np.linalg.norm(unit.given_mm - centre, axis=1) - radius
        return cls(centre, radius, residuals, std * unit.scale_mm, covariance * unit.scale_mm**2)

    @classmethod
    def find(
        cls, points: np.ndarray, radius_mm: float, *, usable: np.ndarray, rng: np.random.Generator
    ) -> "FoundSphere | None":
        """Find the best supported sphere of a radius among the ``usable`` (N,) points (N, 3), mm; None without one.

        RANSAC: triples of neighbouring points propose centres, and the number of points near the surface scores them.
        The best centres are refined. A sphere is accepted if a free fit to its points gives the known radius within
        10 %.

        Points belong to the sphere if they are within three limits of it. A limit is five robust standard deviations,
        at most a tenth of the radius. Another surface crosses the sphere in a patch of about 0.12 radii if at least two
        of its points, and more than 10 %, exceed one limit. Such a patch is excluded.
        """
        usable = usable.copy()
        for _ in range(_ATTEMPTS):
            if np.count_nonzero(usable) < LEAST_POINTS:
                return None
            # One point per cell removes the influence of point density.
            left = points[usable]
            _, first = np.unique(number_cubes(left - left.min(axis=0), radius_mm * _THINNING), return_index=True)
            centre = _find_best_centre(left[rng.permutation(first)[:_THINNED]], radius_mm, rng)
            if centre is None:
                return None
            found = _accept(points, usable, centre, radius_mm)
            if found is not None:
                return found
            usable &= np.abs(np.linalg.norm(points - centre, axis=1) - radius_mm) > _SEARCH_LIMIT * radius_mm
        return None


def _compute_derivatives(points: np.ndarray, centre: np.ndarray, *, free: int) -> np.ndarray:
    return np.hstack([-unit_vectors(points - centre), np.full((len(points), free), -1.0)])


@dataclass(frozen=True, eq=False)
class FoundSphere:
    """Sphere in a cloud."""

    robust: RobustFit[Sphere]  # fit of free radius to its points
    members: np.ndarray  # (M,) int; indices of these points in the cloud
    near: np.ndarray  # (N,) bool; points of the cloud within three limits of the sphere
    points_mixed: int  # number of points on the sphere that were excluded, because another surface crosses it there


def _find_best_centre(points: np.ndarray, radius: float, rng: np.random.Generator) -> np.ndarray | None:
    """Return the refined centre with the most points near its sphere; None without proposals."""
    centres = _propose_centres(points, radius, rng)
    limit = _SEARCH_LIMIT * radius

    def best(centres: np.ndarray, sample: np.ndarray, count: int) -> np.ndarray:
        support = np.count_nonzero(np.abs(cdist(centres, sample) - radius) < limit, axis=1)
        return centres[np.argsort(-support, kind="stable")[:count]]

    if not len(centres):
        return None
    centres = best(best(centres, points[:_SCREENED], _KEPT_OF_SCREENING), points, _KEPT)
    return best(np.array([_refine_centre(points, centre, radius) for centre in centres]), points, 1)[0]


def _propose_centres(points: np.ndarray, radius: float, rng: np.random.Generator) -> np.ndarray:
    """Return the centres (M, 3) of spheres through triples of points within one radius of their first point."""
    seeds = rng.integers(len(points), size=_SEEDS)
    balls = KDTree(points).query_ball_point(points[seeds], radius)
    picks = rng.random((_SEEDS, 2))
    pairs = [[ball[int(pick * len(ball))] for pick in pair] for ball, pair in zip(balls, picks, strict=True)]
    first, (second, third) = points[seeds], points[np.array(pairs).T]
    # Circumcentre of a triangle with sides a, b relative to its first corner:
    # ((|a|2 b - |b|2 a) x (a x b)) / (2 |a x b|2).
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


def _refine_centre(points: np.ndarray, centre: np.ndarray, radius: float) -> np.ndarray:
    """Refine a centre by Gauss-Newton steps with known radius on the points within the search limit."""
    for _ in range(4):
        offset = points - centre
        distance = np.linalg.norm(offset, axis=1)
        near = np.abs(distance - radius) < _SEARCH_LIMIT * radius
        if np.count_nonzero(near) < 4:
            return centre
        step, *_ = np.linalg.lstsq(offset[near] / distance[near, None], distance[near] - radius, rcond=1e-3)
        centre = centre + step
    return centre


def _accept(points: np.ndarray, usable: np.ndarray, centre: np.ndarray, radius: float) -> FoundSphere | None:
    """Return the sphere at a centre if its points confirm the radius; else None."""
    distances = np.linalg.norm(points - centre, axis=1) - radius
    limit = _SEARCH_LIMIT * radius
    for _ in range(8):
        mixed = _mark_crossed(points - centre, distances, limit, usable)
        members = np.flatnonzero(usable & ~mixed & (np.abs(distances) <= limit))
        if len(members) < LEAST_POINTS:
            return None
        try:
            fit = Sphere.fit(points[members])
        except EvaluationError:
            return None
        if abs(fit.radius_mm - radius) > _RADIUS_TOLERANCE * radius:
            return None
        centre, distances, last = fit.centre_mm, fit.distances_mm(points), limit
        spread = robust_std(fit.residuals_mm - np.median(fit.residuals_mm))
        limit = min(max(DEFAULT_K * spread, _SMALLEST_LIMIT * radius), _LARGEST_LIMIT * radius)
        if abs(limit - last) <= 0.05 * last:
            break
    mixed = _mark_crossed(points - centre, distances, limit, usable)
    near = np.abs(distances) <= 3 * limit
    members = np.flatnonzero(usable & ~mixed & near)
    points_mixed = int(np.count_nonzero(usable & mixed & (np.abs(distances) <= limit)))
    if points_mixed > len(members):
        return None
    return FoundSphere(fit_robustly(Sphere.fit, points[members]), members, near, points_mixed)


def _mark_crossed(offsets: np.ndarray, distances: np.ndarray, limit: float, usable: np.ndarray) -> np.ndarray:
    """Return a mask (N,) of points in patches where many points are between one and three limits from the sphere.

    For the sphere alone this band is nearly empty. A crossing surface has twice as many points in it as within one
    limit.
    """
    near = np.flatnonzero(usable & (np.abs(distances) <= 3 * limit))
    crossed = np.zeros(len(offsets), dtype=bool)
    if not len(near):
        return crossed
    direction = offsets[near] / np.linalg.norm(offsets[near], axis=1, keepdims=True)
    _, cell = np.unique(number_cubes(direction + 1.0, _CELL), return_inverse=True)
    outer = np.bincount(cell, weights=np.abs(distances[near]) > limit)
    crossed[near] = ((outer >= _OUTER_COUNT) & (outer > _OUTER_SHARE * np.bincount(cell)))[cell]
    return crossed
