"""The part of a profile that shows the artefact: an arc of a sphere, the line of a plane, those of a step or ring."""

from collections.abc import Callable
from dataclasses import dataclass, replace
from itertools import combinations
from typing import Self

import numpy as np

from uwlts.fitting.least_squares import MAD_TO_STD, robust_std
from uwlts.fitting.shapes import algebraic_centres

LEAST_POINTS = 12
"""Points on the artefact that a profile needs: four for each of a circle's three parameters."""
_TRIALS = 400
"""Curves proposed for a profile: with a tenth of it on the artefact, and neighbours as proposals, some 40 are right."""
_REJECTED_BEYOND = 4.0
"""Robust standard deviations; of normal noise six points in a hundred thousand lie farther out."""
_DOUBLINGS = 3
"""Doublings of the distance at which points count as near, up to 30 times the noise: profilers err smoothly by less."""
_FEW_MORE = 1.1  # ratio of the numbers of points near a curve, below which a wider distance finds no more of its own
_LEAST_ARC = np.radians(30)
"""Smaller arcs are like straight lines, and their centres move by more than the noise along the sagitta."""
LEAST_WALL = 6
"""Points on a ring's wall that are used: twice the three numbers of their curve."""
_LARGEST_GAP = 5
"""Times the usual distance between neighbours by which points of one wall may lie apart, in number and in space."""
_LARGEST_ROUNDS = 20
_LINES = 4
"""Lines sought in a profile of a step or ring: its faces, and what lies beside them."""
_PARALLEL = 2e-3
"""By how much faces of a step may seem to be turned against each other besides noise, rad: bow of the profiler."""
_LEAST_SEEN = 0.95  # share of its height that a step shows at least: profilers' scales err by less
_LEAST_SEEN_COSINE = 0.5  # cosine of the angle by which the sheet may lean against a step: 60 deg


@dataclass(frozen=True, eq=False, kw_only=True)
class Seen:
    """Points of a profile on the artefact: their mask (N,), the surface (N,) of each (0 the first), scatter in mm."""

    members: np.ndarray
    part: np.ndarray
    std_mm: float

    def among(self, chosen: np.ndarray) -> Self:
        """The same in the profile from which the points were chosen by a mask."""
        members, part = np.zeros(len(chosen), dtype=bool), np.zeros(len(chosen), dtype=int)
        members[chosen], part[chosen] = self.members, self.part
        return replace(self, members=members, part=part)


@dataclass(frozen=True, eq=False, kw_only=True)
class ProfileArc(Seen):
    """Points on a circle: its centre (2,) and radius, mm."""

    centre_mm: np.ndarray
    radius_mm: float


@dataclass(frozen=True, eq=False, kw_only=True)
class ProfileLine(Seen):
    """Points on a line: their middle (2,), the line's direction (2,) and length, of a step or ring for the first face.

    The points are those of both faces of a step, or of face and wall of a ring.
    """

    middle_mm: np.ndarray
    direction: np.ndarray
    length_mm: float

    def with_parts(self, others: np.ndarray) -> "ProfileLine":
        """The line with points of other surfaces, whose numbers (N,) are not 0."""
        return replace(self, members=self.members | (others > 0), part=np.where(others > 0, others, self.part))


def noise_of(points: np.ndarray) -> float:
    """Scatter of a profile (N, 2) from second differences across it, robust against edges, mm."""
    depth = points[:, 1] - np.interp(points[:, 0], points[[0, -1], 0], points[[0, -1], 1])
    # The variance of a second difference is 1 + 4 + 1 times that of a point.
    second = np.diff(depth, 2)
    return robust_std(second - np.median(second)) / 6**0.5


def find_arc(points: np.ndarray, radius_mm: float | None, rng: np.random.Generator) -> ProfileArc | None:
    """The best supported arc of a sphere's section in a profile (N, 2), mm, in the order along it, or None.

    Circles through three points in their order along the profile are judged by the number of points near them (RANSAC);
    none is larger than the sphere, or than the profile where the sphere's radius is not known.
    """
    count = len(points)
    if count < LEAST_POINTS:
        return None
    tolerance = max(_REJECTED_BEYOND * noise_of(points), 1e-4)
    extent = float(np.linalg.norm(np.ptp(points, axis=0)))
    largest = extent if radius_mm is None else radius_mm + 2 * tolerance
    span = rng.integers(LEAST_POINTS // 2, max(count // 2, LEAST_POINTS // 2 + 1), size=_TRIALS)
    first = (rng.random(_TRIALS) * np.maximum(count - 2 * span, 1)).astype(int)
    picked = points[np.minimum(first[:, None] + span[:, None] * np.arange(3), count - 1)]
    centres, radii = circles_through(picked)
    fits = np.isfinite(radii) & (radii < largest) & (radii > 10 * tolerance)
    if not fits.any():
        return None
    centres, radii = centres[fits], radii[fits]
    off = np.abs(np.linalg.norm(points - centres[:, None], axis=2) - radii[:, None])
    tolerance = _widened(off, tolerance)
    if radius_mm is not None:
        largest = radius_mm + 2 * tolerance
    for best in np.argsort(-np.count_nonzero(off < tolerance, axis=1))[:5]:
        arc = _refined_arc(points, off[best] < tolerance, tolerance)
        if arc is not None and arc.radius_mm < largest:
            return arc
    return None


def _widened(off: np.ndarray, tolerance: float) -> float:
    """Tolerance at which a wider one would find few points more, given distances (M, N) from the curves proposed.

    A profiler's smooth error shifts points by more than their noise.
    """
    for _ in range(_DOUBLINGS):
        near, wider = (int(np.count_nonzero(off < each, axis=1).max()) for each in (tolerance, 2 * tolerance))
        if wider < _FEW_MORE * near:
            break
        tolerance *= 2
    return tolerance


def circles_through(triples: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Centres (M, 2) and radii (M,) of circles through triples (M, 3, 2); infinite where these lie on a line."""
    b, c = triples[:, 1] - triples[:, 0], triples[:, 2] - triples[:, 0]
    with np.errstate(divide="ignore", invalid="ignore"):
        double = 2 * (b[:, 0] * c[:, 1] - b[:, 1] * c[:, 0])
        bb, cc = np.sum(b**2, axis=1), np.sum(c**2, axis=1)
        away = np.stack([c[:, 1] * bb - b[:, 1] * cc, b[:, 0] * cc - c[:, 0] * bb], axis=1) / double[:, None]
    return triples[:, 0] + away, np.linalg.norm(away, axis=1)


def _settled(
    members: np.ndarray, tolerance: float, off: Callable[[np.ndarray], np.ndarray]
) -> tuple[np.ndarray, float] | None:
    """Points (N,) on a curve, found anew until they stay the same, and their scatter; None where they are too few.

    ``off`` returns the distances (N,) of all points from the curve through some (N,).
    """
    std = 0.0
    for _ in range(_LARGEST_ROUNDS):
        if np.count_nonzero(members) < LEAST_POINTS:
            return None
        away = np.abs(off(members))
        std = robust_std(away[members])
        before, members = members, away < min(max(_REJECTED_BEYOND * std, 1e-4), 2 * tolerance)
        if np.array_equal(before, members):
            break
    return (members, std) if np.count_nonzero(members) >= LEAST_POINTS else None


def _refined_arc(points: np.ndarray, members: np.ndarray, tolerance: float) -> ProfileArc | None:
    def off(some: np.ndarray) -> np.ndarray:
        centre, radius = _fitted_circle(points[some])
        return np.linalg.norm(points - centre, axis=1) - radius

    if (found := _settled(members, tolerance, off)) is None:
        return None
    members, std = found
    centre, radius = _fitted_circle(points[members])
    if _arc_angle(points[members] - centre) < _LEAST_ARC:
        return None
    part = np.zeros(len(points), dtype=int)
    return ProfileArc(members=members, part=part, std_mm=std, centre_mm=centre, radius_mm=radius)


def _fitted_circle(points: np.ndarray) -> tuple[np.ndarray, float]:
    """Circle with the least sum of squared distances, by Gauss-Newton steps from the algebraic one."""
    middle = points.mean(axis=0)
    centre, radius = algebraic_centres(points - middle)
    centre = middle + centre
    radius = float(radius)
    for _ in range(5):
        away = points - centre
        distance = np.linalg.norm(away, axis=1)
        design = np.column_stack([away / distance[:, None], np.ones(len(points))])
        step, *_ = np.linalg.lstsq(design, distance - radius, rcond=None)
        centre, radius = centre + step[:2], radius + float(step[2])
    return centre, abs(radius)


def _arc_angle(away: np.ndarray) -> float:
    angles = np.sort(np.arctan2(away[:, 1], away[:, 0]))
    gaps = np.diff(angles, append=angles[0] + 2 * np.pi)
    return float(2 * np.pi - gaps.max())


def find_line(points: np.ndarray, rng: np.random.Generator) -> ProfileLine | None:
    """The best supported straight line in a profile (N, 2), mm, in the order along it, or None."""
    if len(points) < LEAST_POINTS:
        return None
    tolerance = max(_REJECTED_BEYOND * noise_of(points), 1e-4)
    first, second = rng.integers(len(points), size=(2, _TRIALS))
    along = points[second] - points[first]
    length = np.linalg.norm(along, axis=1)
    proper = length > 0
    normals = np.column_stack([-along[:, 1], along[:, 0]])[proper] / length[proper, None]
    off = np.abs(points @ normals.T - np.sum(points[first[proper]] * normals, axis=1)).T
    tolerance = _widened(off, tolerance)
    members = off[np.argmax(np.count_nonzero(off < tolerance, axis=1))] < tolerance

    def line(some: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        middle = points[some].mean(axis=0)
        return middle, np.linalg.svd(points[some] - middle, full_matrices=False)[2][0]

    def beside(some: np.ndarray) -> np.ndarray:
        middle, direction = line(some)
        return (points - middle) @ np.array([-direction[1], direction[0]])

    if (found := _settled(members, tolerance, beside)) is None:
        return None
    members, std = found
    middle, direction = line(members)
    return ProfileLine(
        members=members,
        part=np.zeros(len(points), dtype=int),
        std_mm=std,
        middle_mm=middle,
        direction=direction,
        length_mm=float(np.ptp(points[members] @ direction)),
    )


def find_step(points: np.ndarray, height_mm: float | None, rng: np.random.Generator) -> ProfileLine | None:
    """The two best supported parallel lines in a profile (N, 2), mm, in the order along it, or None.

    The first is that at smaller z. Of a step of known height they lie as far apart as a sheet shows it that leans by up
    to 60 deg.
    """
    best: tuple[int, float, np.ndarray, np.ndarray, ProfileLine] | None = None
    for (rows, first), (others, second) in combinations(_lines_of(points, rng), 2):
        apart = _apart(first, second)
        if apart is None:
            continue
        if height_mm is not None and not _LEAST_SEEN * height_mm < abs(apart) < height_mm / _LEAST_SEEN_COSINE:
            continue
        if best is None or len(rows) + len(others) > best[0]:
            nearer, farther, line = (rows, others, first) if apart > 0 else (others, rows, second)
            best = len(rows) + len(others), max(first.std_mm, second.std_mm, 1e-4), nearer, farther, line
    if best is None:
        return None
    _, noise, nearer, farther, line = best
    members, part = np.zeros(len(points), bool), np.zeros(len(points), int)
    members[nearer] = members[farther] = part[farther] = True
    return replace(line, members=members, part=part, std_mm=noise)


def find_face(points: np.ndarray, rng: np.random.Generator) -> ProfileLine | None:
    """Of the best supported line in a profile (N, 2) and those parallel to it that at smallest z, mm, or None."""
    lines = _lines_of(points, rng)
    if not lines:
        return None
    beside = [(0.0, *lines[0])]
    beside += [(apart, *line) for line in lines[1:] if (apart := _apart(lines[0][1], line[1])) is not None]
    _, rows, face = min(beside, key=lambda each: each[0])
    members = np.zeros(len(points), dtype=bool)
    members[rows] = True
    return replace(face, members=members, part=np.zeros(len(points), dtype=int))


def find_walls(points: np.ndarray, near: np.ndarray) -> np.ndarray:
    """Number (N,) of the wall on which each point of a profile (N, 2) lies, from 1; 0 for none.

    Walls are the runs of points ``near`` (N,) the artefact's wall, without those that lie beside their smooth curve.
    """
    rows = np.flatnonzero(near)
    walls, number = np.zeros(len(points), dtype=int), 0
    if len(rows) < LEAST_WALL:
        return walls
    apart = np.linalg.norm(np.diff(points[rows], axis=0), axis=1)
    ends = (np.diff(rows) > _LARGEST_GAP) | (apart > _LARGEST_GAP * np.median(apart))
    for run in np.split(rows, np.flatnonzero(ends) + 1):
        for _ in range(_LARGEST_ROUNDS):
            if len(run) < LEAST_WALL:
                break
            centred = points[run] - points[run].mean(axis=0)
            along, off = (centred @ np.linalg.svd(centred, full_matrices=False)[2].T).T
            curve = np.vander(along / max(np.ptp(along), 1e-9), 3)
            off = off - curve @ np.linalg.lstsq(curve, off, rcond=None)[0]
            kept = np.abs(off) <= max(_REJECTED_BEYOND * MAD_TO_STD * float(np.median(np.abs(off))), 1e-4)
            if kept.all():
                number += 1
                walls[run] = number
                break
            run = run[kept]
    return walls


def _lines_of(points: np.ndarray, rng: np.random.Generator) -> list[tuple[np.ndarray, ProfileLine]]:
    """Rows (n,) of the points on the best supported lines of a profile, and these lines."""
    lines: list[tuple[np.ndarray, ProfileLine]] = []
    left = np.arange(len(points))
    for _ in range(_LINES):
        line = find_line(points[left], rng)
        if line is None:
            break
        lines.append((left[line.members], line))
        left = left[~line.members]
    return lines


def _apart(first: ProfileLine, second: ProfileLine) -> float | None:
    """How far a line lies beyond another to larger z, mm; None where they are not parallel, or are one."""
    normal = np.array([-first.direction[1], first.direction[0]]) * np.sign(first.direction[0] or 1.0)
    apart = float((second.middle_mm - first.middle_mm) @ normal)
    noise = max(first.std_mm, second.std_mm, 1e-4)
    lean = [line.std_mm / max(line.length_mm, 1e-9) * np.sqrt(12 / line.members.sum()) for line in (first, second)]
    turned = abs(float(first.direction[0] * second.direction[1] - first.direction[1] * second.direction[0]))
    if turned > _REJECTED_BEYOND * float(np.hypot(*lean)) + _PARALLEL or abs(apart) < 2 * _REJECTED_BEYOND * noise:
        return None
    return apart
