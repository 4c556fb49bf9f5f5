"""Planes, straight lines, spheres and cylinders by orthogonal distances, the round ones with free or known radius."""

from dataclasses import dataclass
from typing import Any

import numpy as np
from scipy.spatial import KDTree

from uwlts.errors import EvaluationError
from uwlts.fitting.least_squares import (
    LARGEST_RELATIVE_STD,
    Normalised,
    covariance_of,
    evenly_thinned,
    minimised,
    normalised,
    principal_axes,
)

_THINNED = 600
"""Points for the search of a cylinder's axis."""
_NEIGHBOURS = 12
"""Neighbours of a point for its local normal."""
_DIRECTIONS = 80
"""Directions of the axis that are tried on the half sphere, some 15 deg apart."""
_TRIED = 5
"""Best directions that are refined."""
_LARGEST_SLOPE_STD = 0.2
"""Standard uncertainty of the axis's slope from which the direction is open: 11 deg."""


@dataclass(frozen=True, eq=False)
class FlatFit:
    """A straight line (K = 1) or plane (K = 2) through points with D coordinates.

    ``point_mm`` (D,) is the centroid of the points, ``axes`` (K, D) are unit directions in the shape, the longest
    extent of the points first, ``normals`` (D - K, D) those across it. ``residuals_mm`` (N,) are distances: with one
    normal signed, positive on the side to which it points; with two never negative. ``std_mm`` is the standard
    deviation of one coordinate across the shape, with (D - K) (N - K - 1) degrees of freedom. ``covariance`` is of the
    offsets along the normals at the point (mm), then of the slopes (rad) towards them along the axes.
    """

    point_mm: np.ndarray
    axes: np.ndarray
    normals: np.ndarray
    residuals_mm: np.ndarray
    std_mm: float
    covariance: np.ndarray

    @property
    def normal(self) -> np.ndarray:
        """Unit normal (D,) of a plane, or of a line in a plane."""
        return self.normals[0]

    @property
    def direction(self) -> np.ndarray:
        """Unit direction (D,) of a line."""
        return self.axes[0]

    def distances_mm(self, points: np.ndarray) -> np.ndarray:
        """Distances (M,) of any points (M, D), as in `residuals_mm`."""
        return _lengths((np.asarray(points, dtype=np.float64) - self.point_mm) @ self.normals.T)


def fit_plane(points: Any, towards: Any = None) -> FlatFit:
    """Least-squares plane through points (N, 3), mm, its normal turned ``towards`` (3,) or its largest part positive.

    EvaluationError for fewer than 4 points, points that are not finite, or points on one line.
    """
    unit = normalised(points, least=4, what="a plane fit")
    if unit.is_flat(1):
        raise EvaluationError(f"a plane fit: all {len(unit.points)} points lie on one line")
    return _flat_fit(unit, unit.axes[:2], _turned(unit.axes[2], towards)[None])


def fit_line(points: Any, towards: Any = None) -> FlatFit:
    """Least-squares line through points (N, 2) or (N, 3), mm, turned ``towards`` (D,) or its largest part positive.

    In a plane the normal is the direction turned from the first axis towards the second by 90 degrees. EvaluationError
    for fewer than 3 points, points that are not finite, or points without a longest direction.
    """
    unit = normalised(points, least=3, what="a line fit", dimensions=(2, 3))
    if unit.extents[0] - unit.extents[1] <= 1e-9 * unit.extents[0]:
        raise EvaluationError(f"a line fit: the {len(unit.points)} points extend equally in two directions")
    x, y, *z = direction = _turned(unit.axes[0], towards)
    return _flat_fit(unit, direction[None], unit.axes[1:] if z else np.array([[-y, x]]))


def _turned(direction: np.ndarray, towards: Any) -> np.ndarray:
    side = direction[np.argmax(np.abs(direction))] if towards is None else float(direction @ np.asarray(towards))
    return -direction if side < 0 else direction


def _flat_fit(unit: Normalised, axes: np.ndarray, normals: np.ndarray) -> FlatFit:
    across = (unit.given_mm - unit.centroid_mm) @ normals.T
    variance = float(np.sum(across**2)) / (len(normals) * (len(across) - len(axes) - 1))
    leverage = np.array([len(across), *(unit.extents[: len(axes)] * unit.scale_mm) ** 2])
    covariance = np.diag(variance / np.repeat(leverage, len(normals)))
    return FlatFit(unit.centroid_mm, axes, normals, _lengths(across), variance**0.5, covariance)


def _lengths(across: np.ndarray) -> np.ndarray:
    """Distances from components (..., C) across a line or plane, signed where there is one."""
    return across[..., 0] if across.shape[-1] == 1 else np.linalg.norm(across, axis=-1)


@dataclass(frozen=True, eq=False)
class SphereFit:
    """A sphere of a fitted or known radius through points.

    ``residuals_mm`` (N,) are |p - centre| - radius, positive outside, ``std_mm`` their standard deviation with N less
    the number of parameters as degrees of freedom. ``covariance`` (4, 4) or (3, 3), mm2, is of the centre and, where it
    was free, the radius, for equal independent noise on all points.
    """

    centre_mm: np.ndarray
    radius_mm: float
    residuals_mm: np.ndarray
    std_mm: float
    covariance: np.ndarray

    def distances_mm(self, points: np.ndarray) -> np.ndarray:
        """Signed distances (M,) of any points (M, 3), as in `residuals_mm`."""
        return np.linalg.norm(np.asarray(points, dtype=np.float64) - self.centre_mm, axis=1) - self.radius_mm


def fit_sphere(points: Any, radius_mm: float | None = None) -> SphereFit:
    """Least-squares sphere through points (N, 3), mm, with free or known radius; a cap is enough.

    EvaluationError for too few points (5, or 4 with known radius), points that are not finite or lie in one plane, or a
    cap so small or noisy that the centre is uncertain by more than a fifth of the radius.
    """
    unit, known = _prepared_round(points, radius_mm, least=5, what="a sphere fit")

    def jacobian(x: np.ndarray) -> np.ndarray:
        """d|p - c| / dc is minus the unit vector from the centre; d/dr is -1."""
        return np.hstack([-_units(unit.points - x[:3]), np.full((len(unit.points), len(x) - 3), -1.0)])

    parameters, cost = minimised(
        lambda x: np.linalg.norm(unit.points - x[:3], axis=1) - (x[3] if known is None else known),
        jacobian,
        np.hstack(algebraic_centres(unit.points)) if known is None else centre_of_known_radius(unit.points, known),
    )
    covariance, std = covariance_of(jacobian(parameters), cost, what="a sphere")
    centre = unit.centroid_mm + unit.scale_mm * parameters[:3]
    radius = float(radius_mm if radius_mm is not None else parameters[3] * unit.scale_mm)
    uncertainty = float(np.sqrt(np.trace(covariance[:3, :3]))) * unit.scale_mm
    if uncertainty > LARGEST_RELATIVE_STD * radius:
        raise EvaluationError(
            f"the {len(unit.points)} points do not determine a sphere: its centre would be uncertain by "
            f"{uncertainty:.3g} mm, its radius {radius:.3g} mm; they may lie on a plane"
        )
    residuals = np.linalg.norm(unit.given_mm - centre, axis=1) - radius
    return SphereFit(centre, radius, residuals, std * unit.scale_mm, covariance * unit.scale_mm**2)


def _prepared_round(points: Any, radius_mm: float | None, *, least: int, what: str) -> tuple[Normalised, float | None]:
    """Points for a fit of a round surface, and the known radius in their unit, if any, which saves one point."""
    unit = normalised(points, least=least if radius_mm is None else least - 1, what=what)
    if radius_mm is not None and not (np.isfinite(radius_mm) and radius_mm > 0):
        raise ValueError(f"a radius is positive, not {radius_mm}")
    if unit.is_flat(2):
        raise EvaluationError(f"{what}: all {len(unit.points)} points lie in one plane")
    return unit, None if radius_mm is None else radius_mm / unit.scale_mm


def _units(vectors: np.ndarray) -> np.ndarray:
    return vectors / np.maximum(np.linalg.norm(vectors, axis=1, keepdims=True), np.finfo(float).tiny)


@dataclass(frozen=True, eq=False)
class CylinderFit:
    """A cylinder of a fitted or known radius through points.

    ``point_mm`` (3,) of the axis is nearest to the centroid of the points, the largest component of the unit ``axis``
    (3,) is positive, ``across`` (2, 3) are unit directions normal to it and to each other. ``residuals_mm`` (N,) are
    distances to the axis less the radius, ``std_mm`` as of `SphereFit`. ``covariance`` (5, 5) or (4, 4) is of the
    offsets of the axis along ``across`` (mm), its slopes towards them (rad) and, where it was free, the radius (mm).
    """

    point_mm: np.ndarray
    axis: np.ndarray
    across: np.ndarray
    radius_mm: float
    residuals_mm: np.ndarray
    std_mm: float
    covariance: np.ndarray

    def distances_mm(self, points: np.ndarray) -> np.ndarray:
        """Signed distances (M,) of any points (M, 3), as in `residuals_mm`."""
        across = (np.asarray(points, dtype=np.float64) - self.point_mm) @ self.across.T
        return np.hypot(across[:, 0], across[:, 1]) - self.radius_mm


def fit_cylinder(points: Any, radius_mm: float | None = None, axis_start: Any = None) -> CylinderFit:
    """Least-squares cylinder through points (N, 3), mm, with free or known radius.

    ``axis_start`` (3,) is an approximate direction of the axis. Without it the direction is searched: the principal
    axes of the points, the direction most nearly normal to all local surface normals, and an even grid over the half
    sphere are judged by a circle through the points seen along them; the best few are refined on some of the points.
    EvaluationError for too few points (6, or 5 with known radius), points that are not finite or lie in one plane, or
    a patch so small or noisy that it leaves the axis open.
    """
    unit, known = _prepared_round(points, radius_mm, least=6, what="a cylinder fit")
    thinned = evenly_thinned(unit.points, _THINNED)
    trials = [_refined_cylinder(thinned, *start, known) for start in _cylinder_starts(thinned, known, axis_start)]
    frame, start, _ = min(trials, key=lambda trial: trial[2])
    frame, parameters, cost = _refined_cylinder(unit.points, frame, start, known)
    covariance, std = covariance_of(_cylinder_jacobian(parameters, unit.points, frame), cost, what="a cylinder")
    units = np.array([unit.scale_mm, unit.scale_mm, 1.0, 1.0, unit.scale_mm])[: len(parameters)]
    covariance = covariance * np.outer(units, units)
    point = unit.centroid_mm + unit.scale_mm * parameters[:2] @ frame[:2]
    radius = float(radius_mm if radius_mm is not None else parameters[4] * unit.scale_mm)
    sigma = np.sqrt(np.diag(covariance))
    place, slope = np.hypot(*sigma[:2]), np.hypot(*sigma[2:4])
    if place > LARGEST_RELATIVE_STD * radius or slope > _LARGEST_SLOPE_STD:
        raise EvaluationError(
            f"the {len(unit.points)} points do not determine a cylinder: its axis would be uncertain by "
            f"{place:.3g} mm and {np.degrees(slope):.3g} deg, its radius {radius:.3g} mm"
        )
    across = (unit.given_mm - point) @ frame[:2].T
    residuals = np.hypot(across[:, 0], across[:, 1]) - radius
    return CylinderFit(point, frame[2], frame[:2], radius, residuals, std * unit.scale_mm, covariance)


def _cylinder_geometry(
    parameters: np.ndarray, points: np.ndarray, frame: np.ndarray
) -> tuple[np.ndarray, np.ndarray, float]:
    """Radial vectors (N, 3), positions along the axis (N,), stretch of the direction a + s u + t v."""
    direction = frame[2] + parameters[2:4] @ frame[:2]
    stretch = float(np.linalg.norm(direction))
    direction = direction / stretch
    away = points - parameters[:2] @ frame[:2]
    along = away @ direction
    return away - along[:, None] * direction, along, stretch


def _cylinder_jacobian(parameters: np.ndarray, points: np.ndarray, frame: np.ndarray) -> np.ndarray:
    """With the radial unit vector e, normal to the axis: -e.u, -e.v; -along e.u / stretch, same with v; -1."""
    radial, along, stretch = _cylinder_geometry(parameters, points, frame)
    across = -_units(radial) @ frame[:2].T
    by_radius = np.full((len(points), len(parameters) - 4), -1.0)
    return np.hstack([across, across * (along / stretch)[:, None], by_radius])


def _refined_cylinder(
    points: np.ndarray, frame: np.ndarray, start: np.ndarray, known: float | None
) -> tuple[np.ndarray, np.ndarray, float]:
    """Solution as (frame, parameters, cost) with the frame turned so that both slopes are zero."""
    parameters, cost = minimised(
        lambda x: np.linalg.norm(_cylinder_geometry(x, points, frame)[0], axis=1) - (x[4] if known is None else known),
        lambda x: _cylinder_jacobian(x, points, frame),
        start,
    )
    turned = _frame(frame[2] + parameters[2:4] @ frame[:2])
    foot = turned[:2] @ (parameters[:2] @ frame[:2])
    return turned, np.array([*foot, 0.0, 0.0, *parameters[4:]]), cost


def _frame(axis: np.ndarray) -> np.ndarray:
    """Right-handed unit directions (u, v, axis) in rows; the largest component of the axis becomes positive.

    The first is square to the coordinate axis that follows the largest component's, so that noise of an axis along a
    coordinate axis does not turn it.
    """
    axis = axis / np.linalg.norm(axis)
    largest = int(np.argmax(np.abs(axis)))
    if axis[largest] < 0:
        axis = -axis
    first = np.cross(axis, np.eye(3)[(largest + 1) % 3])
    first /= np.linalg.norm(first)
    return np.array([first, np.cross(axis, first), axis])


def _cylinder_starts(points: np.ndarray, known: float | None, axis_start: Any) -> list[tuple[np.ndarray, np.ndarray]]:
    if axis_start is None:
        # Evenly spread directions with z > 0: a Fibonacci lattice.
        step = np.arange(_DIRECTIONS) + 0.5
        z, angle = step / _DIRECTIONS, np.pi * (3.0 - 5.0**0.5) * step
        lattice = np.sqrt(1.0 - z**2) * np.array([np.cos(angle), np.sin(angle)])
        directions = np.vstack([principal_axes(points)[1], _normal_to_normals(points), np.vstack([lattice, z]).T])
    else:
        directions = np.asarray(axis_start, dtype=np.float64).reshape(1, 3)
        if not np.isfinite(directions).all() or not directions.any():
            raise ValueError(f"axis_start must be a direction, not {axis_start}")
    frames = np.array([_frame(direction) for direction in directions])
    seen = np.einsum("nd,kcd->knc", points, frames[:, :2])
    middle = seen.mean(axis=1)
    centred = seen - middle[:, None]
    centres, radii = algebraic_centres(centred)
    misfit = np.sum((np.linalg.norm(centred - centres[:, None], axis=2) - radii[:, None]) ** 2, axis=1)
    starts = []
    for best in np.argsort(misfit)[:_TRIED]:
        centre = centres[best] if known is None else centre_of_known_radius(centred[best], known)
        free = [radii[best]] if known is None else []
        starts.append((frames[best], np.array([*(middle[best] + centre), 0.0, 0.0, *free])))
    return starts


def _normal_to_normals(points: np.ndarray) -> np.ndarray:
    """The direction most nearly normal to the surface normals of small neighbourhoods."""
    _, nearest = KDTree(points).query(points, k=min(_NEIGHBOURS, len(points)))
    patches = points[nearest] - points[nearest].mean(axis=1, keepdims=True)
    _, vectors = np.linalg.eigh(np.swapaxes(patches, 1, 2) @ patches)
    normals = vectors[:, :, 0]
    return np.linalg.eigh(normals.T @ normals)[1][:, 0]


def algebraic_centres(points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Centres (..., D) and radii (...) of circles (D = 2) or spheres (D = 3) through centred points (..., N, D).

    Taubin's fit, nearly unbiased on short arcs where the simpler one of Kasa shrinks the radius: the eigenvector of
    the smallest eigenvalue of the moments of (|p|^2 - m) / (2 sqrt m) and p, with m the mean of |p|^2 (N. Chernov,
    Circular and linear regression, 2010, section 5.10). Points on a line or plane give huge, finite radii.
    """
    squares = np.sum(points**2, axis=-1)
    mean = squares.mean(axis=-1)
    half = 2.0 * np.sqrt(mean)
    design = np.concatenate([((squares - mean[..., None]) / half[..., None])[..., None], points], axis=-1)
    _, vectors = np.linalg.eigh(np.swapaxes(design, -1, -2) @ design)
    vector = vectors[..., :, 0]
    curvature = vector[..., 0] / half
    curvature = np.where(np.abs(curvature) < 1e-9, np.copysign(1e-9, curvature), curvature)
    centres = -vector[..., 1:] / (2.0 * curvature[..., None])
    radii = np.sqrt(np.sum(centres**2, axis=-1) + mean)
    return centres, radii


def centre_of_known_radius(points: np.ndarray, radius: float) -> np.ndarray:
    """Start centre (D,) of a circle or sphere of known radius through centred points (N, D).

    In the direction of the algebraic centre, as deep below the points as their extent across it demands.
    """
    centre, _ = algebraic_centres(points)
    direction = centre / max(float(np.linalg.norm(centre)), 1e-12)
    across = np.sum(points**2, axis=-1) - (points @ direction) ** 2
    depth = np.sqrt(max(radius**2 - float(across.mean()), (0.1 * radius) ** 2))
    return direction * depth
