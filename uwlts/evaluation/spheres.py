"""Detection of spheres of known radius in clouds, and their evaluation by VDI/VDE 2634."""

from dataclasses import dataclass
from itertools import pairwise, permutations
from typing import ClassVar

import numpy as np
from scipy.spatial import KDTree
from scipy.spatial.distance import cdist

from uwlts.errors import EvaluationError
from uwlts.evaluation.figures import TOWARDS_SENSOR, ArtefactEvaluation, FigureId, Quantity, spread_mm
from uwlts.fitting.least_squares import DEFAULT_K, RobustFit, fit_robustly, robust_std
from uwlts.fitting.point_groups import number_cubes
from uwlts.fitting.shapes import SphereFit, fit_sphere
from uwlts.model.artefacts import SphereStandard

LEAST_POINTS = 50
"""Least number of points of a sphere."""

_SEARCH_LIMIT = 0.05
"""Half width (unit: radius) of the band of points that support a proposed sphere."""
_LARGEST_LIMIT = 0.1
"""Largest half width (unit: radius) of the band of a sphere's points."""
_SMALLEST_LIMIT = 1e-4
"""Smallest half width (unit: radius), for exact points without scatter."""
_RADIUS_TOLERANCE = 0.1
"""Largest relative error of a fitted radius."""
_CELL = 0.12
"""Size (unit: radius) of cells for the detection of other surfaces."""
_THINNING = 1 / 15
"""Size (unit: radius) of cells that keep one point each for the search."""
_THINNED = 4000
"""Number of points for scoring centres; more take longer without a benefit."""
_SCREENED = 1000
"""Number of points for the first screening."""
_SEEDS = 2000
"""Number of proposed centres."""
_KEPT_OF_SCREENING = 150
"""Number of centres kept by the screening."""
_KEPT = 8
"""Number of refined centres."""
_ATTEMPTS = 3
"""Number of searches, each with new random seeds."""
_OUTER_SHARE = 0.1
"""Fraction of a cell's points beyond the limit that indicates another surface; for noise it is 6 in ten million."""
_OUTER_COUNT = 2
"""Least number of such points."""


@dataclass(frozen=True, eq=False)
class FoundSphere:
    """Sphere in a cloud."""

    robust: RobustFit[SphereFit]  # fit of free radius to its points
    members: np.ndarray  # (M,) int; indices of these points in the cloud
    near: np.ndarray  # (N,) bool; points of the cloud within three limits of the sphere
    points_mixed: int  # number of points on the sphere that were excluded, because another surface crosses it there


def find_sphere(
    points: np.ndarray, radius_mm: float, *, usable: np.ndarray, rng: np.random.Generator
) -> FoundSphere | None:
    """Find the best supported sphere of a radius among the ``usable`` (N,) points (N, 3), mm; None without one.

    RANSAC: triples of neighbouring points propose centres, and the number of points near the surface scores them. The
    best centres are refined. A sphere is accepted if a free fit to its points gives the known radius within 10 %.

    Points belong to the sphere if they are within three limits of it. A limit is five robust standard deviations, at
    most a tenth of the radius. Another surface crosses the sphere in a patch of about 0.12 radii if at least two of its
    points, and more than 10 %, exceed one limit. Such a patch is excluded.
    """
    usable = usable.copy()
    for _ in range(_ATTEMPTS):
        if np.count_nonzero(usable) < LEAST_POINTS:
            return None
        # One point per cell removes the influence of point density.
        left = points[usable]
        _, first = np.unique(number_cubes(left - left.min(axis=0), radius_mm * _THINNING), return_index=True)
        centre = _best_centre(left[rng.permutation(first)[:_THINNED]], radius_mm, rng)
        if centre is None:
            return None
        found = _accept_sphere(points, usable, centre, radius_mm)
        if found is not None:
            return found
        usable &= np.abs(np.linalg.norm(points - centre, axis=1) - radius_mm) > _SEARCH_LIMIT * radius_mm
    return None


def _best_centre(points: np.ndarray, radius: float, rng: np.random.Generator) -> np.ndarray | None:
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
        away = points - centre
        distance = np.linalg.norm(away, axis=1)
        near = np.abs(distance - radius) < _SEARCH_LIMIT * radius
        if np.count_nonzero(near) < 4:
            return centre
        unit = away[near] / distance[near, None]
        step, *_ = np.linalg.lstsq(unit, distance[near] - radius, rcond=1e-3)
        centre = centre + step
    return centre


def _accept_sphere(points: np.ndarray, usable: np.ndarray, centre: np.ndarray, radius: float) -> FoundSphere | None:
    """Return the sphere at a centre if its points confirm the radius; else None."""
    distances = np.linalg.norm(points - centre, axis=1) - radius
    limit = _SEARCH_LIMIT * radius
    for _ in range(8):
        mixed = _mark_crossed(points - centre, distances, limit, usable)
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
    return FoundSphere(fit_robustly(fit_sphere, points[members]), members, near, points_mixed)


def _mark_crossed(away: np.ndarray, distances: np.ndarray, limit: float, usable: np.ndarray) -> np.ndarray:
    """Return a mask (N,) of points in patches where many points are between one and three limits from the sphere.

    For the sphere alone this band is nearly empty. A crossing surface has twice as many points in it as within one
    limit.
    """
    near = np.flatnonzero(usable & (np.abs(distances) <= 3 * limit))
    crossed = np.zeros(len(away), dtype=bool)
    if not len(near):
        return crossed
    direction = away[near] / np.linalg.norm(away[near], axis=1, keepdims=True)
    _, cell = np.unique(number_cubes(direction + 1.0, _CELL), return_inverse=True)
    outer = np.bincount(cell, weights=np.abs(distances[near]) > limit)
    total = np.bincount(cell)
    crossed[near] = ((outer >= _OUTER_COUNT) & (outer > _OUTER_SHARE * total))[cell]
    return crossed


_SAME_SIZE = 0.005
"""Difference in misfit, relative to the smallest diameter, below which two orders of spheres are equivalent."""


@dataclass(frozen=True)
class SphereResult:
    """Sphere measured by its fit of free radius, mm, OCS.

    The probing error ``pe_mm`` is the range of the radial residuals, ``std_mm`` their standard deviation.
    ``diameter_std_mm`` is the standard uncertainty by the scatter of the points alone. ``points_mixed`` counts points
    that were excluded because another surface crosses the sphere there.
    """

    centre_mm: tuple[float, float, float]
    diameter_mm: float
    diameter_error_mm: float
    diameter_std_mm: float
    pe_mm: float
    std_mm: float
    points_used: int
    points_rejected: int
    points_mixed: int


@dataclass(frozen=True)
class SpacingResult:
    """Distance of two consecutive centres, mm, with its error for fits of free and of known radius."""

    spacing_mm: float
    sse_mm: float
    sse_known_radius_mm: float
    spacing_std_mm: float


@dataclass(frozen=True, eq=False, kw_only=True)
class SphereEvaluation(ArtefactEvaluation):
    """Evaluation of spheres in the order of the artefact's description, and of their consecutive spacings."""

    kind: ClassVar[str] = "spheres"

    artefact: SphereStandard
    spheres: tuple[SphereResult, ...]
    spacings: tuple[SpacingResult, ...]

    @property
    def pe_mm(self) -> float:
        """Probing error of the worst sphere."""
        return max(sphere.pe_mm for sphere in self.spheres)

    @property
    def std_mm(self) -> float:
        """Largest standard deviation of the radial residuals of a sphere."""
        return max(sphere.std_mm for sphere in self.spheres)

    @property
    def sse_mm(self) -> float | None:
        """Signed sphere spacing error of the largest absolute value; None for a single sphere."""
        return max((spacing.sse_mm for spacing in self.spacings), key=abs, default=None)

    def values_mm(self) -> dict[FigureId, float | None]:
        kind = Quantity
        values: dict[FigureId, float | None] = {(kind.PROBING_ERROR, ()): self.pe_mm, (kind.STD, ()): self.std_mm}
        for number, sphere in enumerate(self.spheres, start=1):
            values[kind.PROBING_ERROR, (number,)] = sphere.pe_mm
            values[kind.STD, (number,)] = sphere.std_mm
            values[kind.DIAMETER_ERROR, (number,)] = sphere.diameter_error_mm
        for number, spacing in enumerate(self.spacings, start=1):
            values[kind.SPACING_ERROR, (number, number + 1)] = spacing.sse_mm
            values[kind.SPACING_ERROR_KNOWN_RADIUS, (number, number + 1)] = spacing.sse_known_radius_mm
        return values


def evaluate_spheres(points: np.ndarray, artefact: SphereStandard) -> SphereEvaluation:
    """Find the spheres in points (N, 3), mm, in the OCS, and evaluate them.

    EvaluationError for missing spheres, or for hollow spheres, which indicate rotated images.
    """
    found = _sort_spheres(_find_spheres(points, artefact, np.random.default_rng(0)), artefact)
    deviation = np.full(len(points), np.nan)
    spheres, fits = [], []
    for sphere, diameter in zip(found, artefact.diameters_mm, strict=True):
        members, robust = _fit_cap(points, sphere, artefact.cap_angle_deg)
        used, fit = members[robust.inliers], robust.fit
        if np.mean((points[used] - fit.centre_mm) @ TOWARDS_SENSOR) < 0:
            raise EvaluationError(
                "the spheres are hollow: their points are behind their centres, where the sensor cannot see them. The "
                "images may be rotated by 180 deg or mirrored relative to those of the calibration"
            )
        deviation[used] = fit.residuals_mm
        fits.append((fit, fit_sphere(points[used], diameter / 2)))
        spheres.append(
            SphereResult(
                centre_mm=tuple(fit.centre_mm.tolist()),
                diameter_mm=2 * fit.radius_mm,
                diameter_error_mm=2 * fit.radius_mm - diameter,
                diameter_std_mm=2 * float(np.sqrt(fit.covariance[3, 3])),
                pe_mm=spread_mm(fit.residuals_mm),
                std_mm=fit.std_mm,
                points_used=len(used),
                points_rejected=robust.rejected,
                points_mixed=sphere.points_mixed,
            )
        )
    spacings = []
    for ((free_1, known_1), (free_2, known_2)), calibrated in zip(pairwise(fits), artefact.spacings_mm, strict=True):
        between = free_2.centre_mm - free_1.centre_mm
        spacing = float(np.linalg.norm(between))
        direction = between / spacing
        variance = direction @ (free_1.covariance + free_2.covariance)[:3, :3] @ direction
        by_known = float(np.linalg.norm(known_2.centre_mm - known_1.centre_mm)) - calibrated
        spacings.append(SpacingResult(spacing, spacing - calibrated, by_known, float(np.sqrt(variance))))
    return SphereEvaluation(
        artefact=artefact,
        points_used=sum(sphere.points_used for sphere in spheres),
        points_rejected=sum(sphere.points_rejected for sphere in spheres),
        deviation_mm=deviation,
        spheres=tuple(spheres),
        spacings=tuple(spacings),
    )


def _find_spheres(points: np.ndarray, artefact: SphereStandard, rng: np.random.Generator) -> list[FoundSphere]:
    usable = np.ones(len(points), dtype=bool)
    found: list[FoundSphere] = []
    for diameter in artefact.diameters_mm:
        sphere = find_sphere(points, diameter / 2, usable=usable, rng=rng)
        if sphere is None:
            place = "{:.2f} mm at ({:.1f}, {:.1f}, {:.1f}) with {} points".format
            fits = [(robust.fit, len(robust.inliers) - robust.rejected) for robust in (other.robust for other in found)]
            places = ", ".join(place(2 * fit.radius_mm, *fit.centre_mm, count) for fit, count in fits)
            raise EvaluationError(
                f"{len(found)} of {len(artefact.diameters_mm)} spheres found among {len(points)} points"
                f"{places and ': ' + places}; no other surface has a diameter near {diameter:g} mm "
                f"on at least {LEAST_POINTS} points. Scan all spheres of the artefact, or correct its description"
            )
        found.append(sphere)
        usable &= ~sphere.near
    return found


def _sort_spheres(found: list[FoundSphere], artefact: SphereStandard) -> list[FoundSphere]:
    """Sort the spheres in the order of the description by sizes and spacings; equivalent orders by position."""
    centres = np.array([sphere.robust.fit.centre_mm for sphere in found])
    diameters = np.array([2 * sphere.robust.fit.radius_mm for sphere in found])
    along = int(np.ptp(centres[:, 1]) >= np.ptp(centres[:, 0]))
    orders = np.array(list(permutations(range(len(found)))))
    spacings = np.linalg.norm(np.diff(centres[orders], axis=1), axis=2)
    sizes, calibrated = np.hstack([diameters[orders], spacings]), [*artefact.diameters_mm, *artefact.spacings_mm]
    misfits = np.abs(sizes - np.array(calibrated)).max(axis=1)
    equal = np.flatnonzero(misfits <= misfits.min() + _SAME_SIZE * min(artefact.diameters_mm))
    best = max(equal, key=lambda number: centres[orders[number][-1], along] - centres[orders[number][0], along])
    return [found[position] for position in orders[best]]


def _fit_cap(
    points: np.ndarray, sphere: FoundSphere, cap_angle_deg: float | None
) -> tuple[np.ndarray, RobustFit[SphereFit]]:
    if cap_angle_deg is None:
        return sphere.members, sphere.robust
    away = points[sphere.members] - sphere.robust.fit.centre_mm
    cosine = away @ TOWARDS_SENSOR / np.linalg.norm(away, axis=1)
    members = sphere.members[cosine >= np.cos(np.radians(cap_angle_deg))]
    if len(members) < LEAST_POINTS:
        raise EvaluationError(
            f"only {len(members)} of {len(away)} points of the sphere are within {cap_angle_deg:g} deg of the point "
            f"nearest to the sensor (-Z); {LEAST_POINTS} are needed. Increase cap_angle_deg"
        )
    return members, fit_robustly(fit_sphere, points[members])
