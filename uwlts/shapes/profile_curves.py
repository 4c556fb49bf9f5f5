"""Detection of the artefact in a profile: arc of a sphere or line of a plane."""

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Self

import numpy as np

from uwlts.errors import EvaluationError
from uwlts.fitting.least_squares import robust_std
from uwlts.shapes.flat import Circle, Line

LEAST_POINTS = 12  # points on the artefact that a profile needs: four for each of a circle's three parameters
_TRIALS = 400
"""Curves proposed for a profile: with a tenth of it on the artefact and neighbouring proposals, some 40 are right."""
_REJECTED_BEYOND = 4.0  # robust standard deviations; of normal noise, six points in a hundred thousand exceed it
_LEAST_TOLERANCE_MM = 1e-4  # smallest distance of a point from its curve; no profiler resolves less
_WIDEST = 0.02
"""Largest distance of a point from its curve, relative to the profile: of an arc as wide as its radius, with noise of a
30th of it, half of the points are still within."""
_LARGER = 1.25
"""Largest radius of a proposed circle, relative to the sphere's: a smooth error of 2 % of the height of the shortest
arc changes its radius by 2 %, and three single points vary more."""
_REFINED = 5  # best supported circles that are refined until one is an arc of the sphere
_LEAST_ARC = np.radians(30)
"""Shorter arcs are like straight lines; their centres shift by more than the noise along the sagitta."""
_LARGEST_GAP = 5  # largest distance of points that are beside each other, relative to the usual one
_LARGEST_ROUNDS = 20  # a set of inliers that still changes then alternates between two
_NEIGHBOURS, _LEAST_BESIDE = 8, 0.25
"""Neighbours of a point on each side, and their least fraction on the artefact; half at the end of an arc or line.

Scattered points on the continuation of a curve, or on the rear of a circle, have none. They would shift it most.
"""


@dataclass(frozen=True, eq=False, kw_only=True)
class Detection:
    """Points of a profile on the artefact: mask (N,), scatter in mm."""

    members: np.ndarray
    std_mm: float

    def expand(self, chosen: np.ndarray) -> Self:
        """Return the same points in the full profile; ``chosen`` is its mask of the points searched."""
        members = np.zeros(len(chosen), dtype=bool)
        members[chosen] = self.members
        return replace(self, members=members)

    def without_isolated(self, points: np.ndarray) -> Self:
        """Return the detection without points of the profile (N, 2) that have few others beside them."""
        count = len(points)
        spacing = float(np.median(np.linalg.norm(np.diff(points[np.flatnonzero(self.members)], axis=0), axis=1)))
        beside, there = np.zeros(count), np.zeros(count)
        for lag in range(1, min(_NEIGHBOURS, count - 1) + 1):
            near = np.linalg.norm(points[lag:] - points[:-lag], axis=1) < _LARGEST_GAP * spacing * lag
            beside[:-lag] += near & self.members[lag:]
            beside[lag:] += near & self.members[:-lag]
            there[:-lag] += 1
            there[lag:] += 1
        return replace(self, members=self.members & (beside >= _LEAST_BESIDE * there))


@dataclass(frozen=True, eq=False, kw_only=True)
class ProfileArc(Detection):
    """Points on a circle: its centre (2,) and radius, mm."""

    centre_mm: np.ndarray
    radius_mm: float


@dataclass(frozen=True, eq=False, kw_only=True)
class ProfileLine(Detection):
    """Points on a line: its middle (2,) and direction (2,)."""

    middle_mm: np.ndarray
    direction: np.ndarray


def find_arc(points: np.ndarray, radius_mm: float | None, rng: np.random.Generator) -> ProfileArc | None:
    """Find the best supported arc of a sphere's section in an ordered profile (N, 2), mm, or None.

    Circles through three points are scored by the number of points near them (RANSAC). Circles larger than the sphere
    are excluded, or larger than arcs within the profile can be if the radius is unknown.
    """
    count = len(points)
    if count < LEAST_POINTS:
        return None
    extent = float(np.linalg.norm(np.ptp(points, axis=0)))
    largest = extent / (2 * np.sin(_LEAST_ARC / 2)) if radius_mm is None else _LARGER * radius_mm
    # Short arcs among scattered points need short spans, long ones long spans: every octave has as many.
    widest = max(count // 2, LEAST_POINTS // 2 + 1)
    span = np.exp(rng.uniform(np.log(LEAST_POINTS // 2), np.log(widest), size=_TRIALS)).astype(int)
    first = (rng.random(_TRIALS) * np.maximum(count - 2 * span, 1)).astype(int)
    picked = points[np.minimum(first[:, None] + span[:, None] * np.arange(3), count - 1)]
    centres, radii = _compute_circles_through(picked)
    fits = np.isfinite(radii) & (radii < largest)
    if not fits.any():
        return None
    centres, radii = centres[fits], radii[fits]
    off = np.abs(np.linalg.norm(points - centres[:, None], axis=2) - radii[:, None])
    tolerance = _choose_tolerance(off, extent)
    for best in np.argsort(-np.count_nonzero(off < tolerance, axis=1))[:_REFINED]:
        arc = _refine_arc(points, off[best] < tolerance, tolerance)
        if arc is not None and (radius_mm is None or _fits_radius(arc, points, radius_mm, tolerance)):
            return arc
    return None


def _choose_tolerance(off: np.ndarray, extent_mm: float) -> float:
    """Return the distance within which points are on a curve; ``off`` (M, N) are distances from the proposed curves.

    The distance is doubled until the best supported curve becomes less significant. The logarithm of the probability
    that k scattered points are all within a distance d is k log(2 d / extent). No noise is estimated first, which
    scattered points would enlarge, and neither rounding nor the smooth error of a profiler matters.
    """

    def support(within: float) -> int:
        return int(np.count_nonzero(off < within, axis=1).max())

    tolerance = _LEAST_TOLERANCE_MM
    while (wider := 2 * tolerance) < _WIDEST * extent_mm:
        near = support(tolerance)
        if near >= LEAST_POINTS and support(wider) * np.log(2 * wider / extent_mm) >= near * np.log(wider / extent_mm):
            break
        tolerance = wider
    return tolerance


def _fits_radius(arc: ProfileArc, points: np.ndarray, radius_mm: float, tolerance: float) -> bool:
    """Return whether an arc of a sphere's largest section fits as well: by the heights of both above their chord."""
    half = float(np.linalg.norm(np.ptp(points[arc.members], axis=0))) / 2
    if arc.radius_mm <= radius_mm or half >= radius_mm:
        return arc.radius_mm < radius_mm + 2 * tolerance
    height, largest = (radius - np.sqrt(radius**2 - half**2) for radius in (arc.radius_mm, radius_mm))
    return largest - height < 2 * tolerance


def _compute_circles_through(triples: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return centres (M, 2) and radii (M,) of circles through triples (M, 3, 2); infinite for collinear points."""
    b, c = triples[:, 1] - triples[:, 0], triples[:, 2] - triples[:, 0]
    with np.errstate(divide="ignore", invalid="ignore"):
        double = 2 * (b[:, 0] * c[:, 1] - b[:, 1] * c[:, 0])
        bb, cc = np.sum(b**2, axis=1), np.sum(c**2, axis=1)
        offset = np.stack([c[:, 1] * bb - b[:, 1] * cc, b[:, 0] * cc - c[:, 0] * bb], axis=1) / double[:, None]
    return triples[:, 0] + offset, np.linalg.norm(offset, axis=1)


def _refit_inliers(
    members: np.ndarray, tolerance: float, off: Callable[[np.ndarray], np.ndarray]
) -> tuple[np.ndarray, float] | None:
    """Refit a curve and its inliers (N,) until they are stable; return inliers and scatter, or None if too few.

    ``off`` returns the distances (N,) of all points from the curve through some (N,).
    """
    std = 0.0
    for _ in range(_LARGEST_ROUNDS):
        if np.count_nonzero(members) < LEAST_POINTS:
            return None
        deviation = np.abs(off(members))
        std = robust_std(deviation[members])
        before, members = members, deviation < min(max(_REJECTED_BEYOND * std, _LEAST_TOLERANCE_MM), 2 * tolerance)
        if np.array_equal(before, members):
            break
    return (members, std) if np.count_nonzero(members) >= LEAST_POINTS else None


def _refine_arc(points: np.ndarray, members: np.ndarray, tolerance: float) -> ProfileArc | None:
    try:
        found = _refit_inliers(members, tolerance, lambda some: Circle.fit(points[some]).distances_mm(points))
        if found is None:
            return None
        members, std = found
        circle = Circle.fit(points[members])
    except EvaluationError:
        return None  # the points are on a line
    if _measure_arc_angle(points[members] - circle.centre_mm) < _LEAST_ARC:
        return None
    # Scattered points fill the band of 2 tolerances evenly: their robust standard deviation is 1.5 tolerances, that of
    # an arc at most 0.9. They are as dense beside the circle, in a band twice as wide.
    deviation = np.abs(circle.distances_mm(points))
    chance = np.count_nonzero((deviation > 2 * tolerance) & (deviation < 4 * tolerance)) / 2
    if std > tolerance or np.count_nonzero(members) < LEAST_POINTS + chance + _REJECTED_BEYOND * np.sqrt(chance):
        return None
    return ProfileArc(members=members, std_mm=std, centre_mm=circle.centre_mm, radius_mm=circle.radius_mm)


def _measure_arc_angle(offsets: np.ndarray) -> float:
    angles = np.sort(np.arctan2(offsets[:, 1], offsets[:, 0]))
    return float(2 * np.pi - np.diff(angles, append=angles[0] + 2 * np.pi).max())


def find_line(points: np.ndarray, rng: np.random.Generator) -> ProfileLine | None:
    """Find the best supported straight line in an ordered profile (N, 2), mm, or None."""
    if len(points) < LEAST_POINTS:
        return None
    first, second = rng.integers(len(points), size=(2, _TRIALS))
    along = points[second] - points[first]
    length = np.linalg.norm(along, axis=1)
    proper = length > 0
    normals = np.column_stack([-along[:, 1], along[:, 0]])[proper] / length[proper, None]
    off = np.abs(points @ normals.T - np.sum(points[first[proper]] * normals, axis=1)).T
    tolerance = _choose_tolerance(off, float(np.linalg.norm(np.ptp(points, axis=0))))
    members = off[np.argmax(np.count_nonzero(off < tolerance, axis=1))] < tolerance

    if (found := _refit_inliers(members, tolerance, lambda some: Line.fit(points[some]).distances_mm(points))) is None:
        return None
    members, std = found
    line = Line.fit(points[members])
    return ProfileLine(members=members, std_mm=std, middle_mm=line.point_mm, direction=line.direction)
