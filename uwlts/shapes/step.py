"""Detection of the faces of a step standard, and the distance between them.

Points are (N, 2) of one profile (Y, Z) or (N, 3) of a scan (X, Y, Z). The last axis points away from the sensor.
"""

from dataclasses import dataclass
from enum import IntEnum
from typing import Literal

import numpy as np
from scipy.spatial import KDTree

from uwlts.errors import EvaluationError
from uwlts.fitting.least_squares import DEFAULT_K, check_points, principal_axes, robust_std, thin_evenly
from uwlts.runtime.compiled import compiled
from uwlts.shapes.flat import Line, Plane

_SEARCH_LIMIT = 0.05  # half width (unit: step height) of the band of points that support a proposed face
_HEIGHT_TOLERANCE = 0.25  # largest relative error of the described height
_SMALLEST_LIMIT = 0.01  # smallest half width (unit: step height) of the band of a face
_LARGEST_LIMIT = 0.3  # largest half width (unit: step height), so that the bands of both faces do not overlap
_LARGEST_STD = 0.125
"""Largest standard deviation of a face (unit: step height); a slope that fills the widest band has 0.17."""
_PROPOSALS = 500  # number of tested pairs (triples) of points
_THINNED = 800  # number of points for scoring them
_SMALLEST_FACE = 0.02  # least fraction of these points on a face
_ROUNDS = 5  # number of refinements of the best proposal


class StepFace(IntEnum):
    """Label of a point: on the face farther from the sensor (lower), on the nearer one (upper), or on neither."""

    NEITHER = 0
    LOWER = 1
    UPPER = 2

    @property
    def other(self) -> "StepFace":
        """The opposite face."""
        return StepFace(3 - self)


@dataclass(frozen=True)
class StepMeasurement:
    """Height of a step and its standard uncertainty from the scatter of the points alone, mm."""

    height_mm: float
    std_mm: float


def label_step_faces(points: np.ndarray, *, height_mm: float, edge_mm: float = 1.0) -> np.ndarray:
    """Label the face of each point (N, 2) of a profile or (N, 3) of a scan, mm, as `StepFace` (N,) int8.

    Random pairs (triples) of points propose directions of two parallel lines (planes) at the distance of the height,
    within a quarter. The faces may have any inclination and several parts (base - block - base). A point belongs to a
    face if its distance is at most five robust standard deviations, limited to 1 to 30 % of the height. It must also be
    farther than ``edge_mm`` from all points off the face, which excludes rounded edges and the riser.

    Raises EvaluationError if there are too few points, or no two such faces.
    """
    points = check_points(points, least=20, what="a step", dimensions=(2, 3))
    least = 10 if points.shape[1] == 2 else 40
    proposal = _choose_proposal(thin_evenly(points, _THINNED), height_mm, np.random.default_rng(0))
    if proposal is None:
        raise EvaluationError(
            f"no two parallel step faces at a distance of about {height_mm:g} mm among {len(points)} points; "
            f"show both faces, or correct the height"
        )
    normal, anchor, offset = proposal
    on_anchor = on_other = np.zeros(len(points), dtype=bool)
    for _ in range(_ROUNDS):
        on_anchor, on_other = _find_levels(points @ normal, anchor, offset)
        # Joint fit of two parallel lines or planes, each through the centroid of its points.
        faces = [face - face.mean(axis=0) for face in (points[on_anchor], points[on_other]) if len(face)]
        axis = principal_axes(np.vstack(faces))[1][-1]
        normal = axis if axis @ normal > 0 else -axis
        anchor = float(np.median(points[on_anchor] @ normal))
    lower, upper = (on_anchor, on_other) if offset > 0 else (on_other, on_anchor)
    labels = np.zeros(len(points), dtype=np.int8)
    along = points @ np.linalg.svd(normal[None])[2][1:].T
    for face, on_it in ((StepFace.LOWER, lower), (StepFace.UPPER, upper)):
        members = np.flatnonzero(on_it)
        if len(members) and edge_mm > 0 and not on_it.all():
            distance, _ = KDTree(along[~on_it]).query(along[members], distance_upper_bound=edge_mm)
            members = members[distance > edge_mm]
        labels[members] = face
    _require_faces(heights=points @ normal, labels=labels, height=height_mm, least=least)
    return labels


def step_height(
    points: np.ndarray, labels: np.ndarray, *, reference: Literal["lower", "upper"] = "lower"
) -> StepMeasurement:
    """Measure the mean distance of one face's points from the line (profile) or plane (scan) of the other face.

    Thesis, section 3.2.2. If the sheet of a profile is inclined to the step's normal, the result is the height divided
    by the cosine of the angle. Labels remain valid for small changes of the points, for example in a calibration.

    ``points`` are (N, 2) or (N, 3), ``labels`` (N,) those of `label_step_faces`. The line or plane is fitted to the
    ``reference``.

    Raises EvaluationError if a face has too few points.
    """
    base = StepFace[reference.upper()]
    points = np.asarray(points, dtype=np.float64)
    surface = (Line.fit if points.shape[1] == 2 else Plane.fit)(points[labels == base])
    across = check_points(points[labels == base.other], least=2, what="a step face", dimensions=(2, 3))
    distances = surface.distances_mm(across)
    lever = np.array([1.0, *(surface.axes @ (across.mean(axis=0) - surface.point_mm))])
    variance = lever @ surface.covariance @ lever + distances.var(ddof=1) / len(distances)
    return StepMeasurement(abs(float(distances.mean())), float(np.sqrt(variance)))


def _require_faces(*, heights: np.ndarray, labels: np.ndarray, height: float, least: int) -> None:
    """Raise EvaluationError unless both levels have enough points, a small scatter and the expected distance."""
    lower, upper = heights[labels == StepFace.LOWER], heights[labels == StepFace.UPPER]
    found = ""
    if min(len(lower), len(upper)) < least:
        found = f"{len(lower)} points on the lower level, {len(upper)} on the upper one; each needs at least {least}"
    elif (widest := max(float(lower.std()), float(upper.std()))) > _LARGEST_STD * height:
        found = f"the points at these levels have a standard deviation of {widest:.2g} mm and are inclined or curved"
    if found:
        raise EvaluationError(
            f"no two step faces at a distance of about {height:g} mm: {found}; show both faces, or correct the height"
        )
    distance = float(upper.mean() - lower.mean())
    if abs(distance - height) > _HEIGHT_TOLERANCE * height:
        raise EvaluationError(
            f"the distance of the step faces is {distance:.2f} mm; the step's description says {height:g} mm"
        )


def _choose_proposal(
    points: np.ndarray, height: float, rng: np.random.Generator
) -> tuple[np.ndarray, float, float] | None:
    """Return the normal towards the sensor, the level of one face and the signed offset of the best supported pair."""
    limit, least = _SEARCH_LIMIT * height, max(3, _SMALLEST_FACE * len(points))
    most, best = 0.0, None
    here, there = np.empty((2, len(points)), np.intp)
    for normal in _propose_normals(points, rng):
        heights = np.sort(points @ normal)
        _count_within(heights, -limit, limit, here)
        for side in (1.0, -1.0):
            _count_within(heights, (side - _HEIGHT_TOLERANCE) * height, (side + _HEIGHT_TOLERANCE) * height, there)
            support = np.where((here >= least) & (there >= least), here + there, 0)
            top = int(np.argmax(support))
            if support[top] > most:
                most = float(support[top])
                best = (normal, float(heights[top]), side * height)
    return best


@compiled
def _count_within(heights: np.ndarray, low: float, high: float, counts: np.ndarray) -> None:
    """Count, for each of the ascending heights (N,), those from ``low`` to ``high`` above it."""
    first = last = 0
    for n in range(len(heights)):
        while first < len(heights) and heights[first] < heights[n] + low:
            first += 1
        while last < len(heights) and heights[last] <= heights[n] + high:
            last += 1
        counts[n] = last - first


def _propose_normals(points: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """Return unit normals (M, D), towards the sensor, of lines (planes) through random pairs (triples) of points."""
    dimension = points.shape[1]
    corners = points[rng.integers(len(points), size=(_PROPOSALS, dimension))]
    side = corners[:, 1] - corners[:, 0]
    if dimension == 2:
        normals = np.column_stack([-side[:, 1], side[:, 0]])
    else:
        normals = np.cross(side, corners[:, 2] - corners[:, 0])
    length = np.linalg.norm(normals, axis=1)
    proper = length > 1e-6 * length.max()
    normals = normals[proper] / length[proper, None]
    return np.where(normals[:, -1:] > 0, -normals, normals)


def _find_levels(heights: np.ndarray, anchor: float, offset: float) -> tuple[np.ndarray, np.ndarray]:
    """Return masks (N,) of points on the face at the anchor's level, and on the densest level near the offset."""
    height = abs(offset)
    about = np.sort(heights[np.abs(heights - anchor - offset) <= _HEIGHT_TOLERANCE * height])
    window = _SEARCH_LIMIT * height
    crowd = np.searchsorted(about, about + 2 * window, side="right") - np.arange(len(about))
    other = float(about[np.argmax(crowd)]) + window if len(about) else anchor + offset
    return _select_near_level(heights, anchor, height), _select_near_level(heights, other, height)


def _select_near_level(heights: np.ndarray, level: float, height: float) -> np.ndarray:
    limit = 2 * _SEARCH_LIMIT * height
    for _ in range(3):
        near = heights[np.abs(heights - level) <= limit]
        if not len(near):
            break
        level = float(np.median(near))
        spread = robust_std(near - level)
        limit = float(np.clip(DEFAULT_K * spread, _SMALLEST_LIMIT * height, _LARGEST_LIMIT * height))
    return np.abs(heights - level) <= limit
