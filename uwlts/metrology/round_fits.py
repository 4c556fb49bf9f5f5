"""Spheres and cylinders by orthogonal distances, with free or known radius."""

from dataclasses import dataclass
from typing import Any

import numpy as np
from scipy.spatial import KDTree

from uwlts.metrology.least_squares import (
    LARGEST_RELATIVE_STD,
    covariance_of,
    evenly_thinned,
    minimised,
    prepared_round,
    principal_axes,
    require_convergence,
)
from uwlts.model.errors import EvaluationError

# The search for a cylinder's axis: points, neighbours for a local normal, directions on the half sphere (some 15 deg
# apart), and how many of the best are refined.
_THINNED, _NEIGHBOURS, _DIRECTIONS, _TRIED = 600, 12, 80, 5
# Standard uncertainty of the axis's slope from which the direction is open: 11 deg.
_LARGEST_SLOPE_STD = 0.2


@dataclass(frozen=True, eq=False)
class SphereFit:
    """A sphere through points.

    Attributes
    ----------
    centre_mm : (3,)
    radius_mm : float
        Fitted, or the known one.
    residuals_mm : (N,)
        |p - centre| - radius, positive outside.
    std_mm : float
        Standard deviation of the residuals, with N less the number of parameters as degrees of freedom.
    covariance : (4, 4) or (3, 3), mm2
        Of the centre and, where it was free, the radius, for equal independent noise on all points.
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

    Raises
    ------
    EvaluationError
        Too few points (5, or 4 with known radius), points that are not finite or lie in one plane, or a cap so small
        or noisy that the centre is uncertain by more than a fifth of the radius.
    """
    what = "a sphere fit"
    points, unit, known = prepared_round(points, radius_mm, least=5, what=what)
    if known is None:
        centre, radius = algebraic_centres(unit.points)
        start = np.array([*centre, radius])
    else:
        start = centre_of_known_radius(unit.points, known)
    parameters, cost = minimised(
        lambda x: np.linalg.norm(unit.points - x[:3], axis=1) - (x[3] if known is None else known),
        lambda x: _sphere_jacobian(x, unit.points),
        start,
    )
    require_convergence(cost, what=what)
    covariance, std = covariance_of(_sphere_jacobian(parameters, unit.points), cost, what="a sphere")
    radius = known if known is not None else float(parameters[3])
    uncertainty = float(np.sqrt(np.trace(covariance[:3, :3])))
    if uncertainty > LARGEST_RELATIVE_STD * radius:
        raise EvaluationError(
            f"the {len(points)} points do not determine a sphere: its centre would be uncertain by "
            f"{uncertainty * unit.scale_mm:.3g} mm, its radius {radius * unit.scale_mm:.3g} mm; they may lie on a plane"
        )
    centre = unit.centroid_mm + unit.scale_mm * parameters[:3]
    radius = radius_mm if radius_mm is not None else radius * unit.scale_mm
    residuals = np.linalg.norm(points - centre, axis=1) - radius
    return SphereFit(centre, float(radius), residuals, std * unit.scale_mm, covariance * unit.scale_mm**2)


def _sphere_jacobian(parameters: np.ndarray, points: np.ndarray) -> np.ndarray:
    """d|p - c| / dc is minus the unit vector from the centre; d/dr is -1."""
    away = points - parameters[:3]
    away /= np.maximum(np.linalg.norm(away, axis=1, keepdims=True), np.finfo(float).tiny)
    jacobian = np.full((len(points), len(parameters)), -1.0)
    np.negative(away, out=jacobian[:, :3])
    return jacobian


@dataclass(frozen=True, eq=False)
class CylinderFit:
    """A cylinder through points.

    Attributes
    ----------
    point_mm : (3,)
        Point of the axis nearest to the centroid of the points.
    axis : (3,)
        Unit direction, its largest component positive.
    across : (2, 3)
        Unit directions normal to the axis and to each other.
    radius_mm : float
        Fitted, or the known one.
    residuals_mm : (N,)
        Distance to the axis less the radius, positive outside.
    std_mm : float
        Standard deviation of the residuals, with N less the number of parameters as degrees of freedom.
    covariance : (5, 5) or (4, 4)
        Of the offsets of the axis along `across` at `point_mm` (mm), its slopes towards them (rad) and, where it was
        free, the radius (mm), for equal independent noise on all points.
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

    Parameters
    ----------
    axis_start : (3,), optional
        Approximate direction of the axis. Without it the direction is searched: the principal axes of the points, the
        direction most nearly normal to all local surface normals, and an even grid over the half sphere are judged by
        a circle through the points seen along them; the best few are refined on some of the points.

    Raises
    ------
    EvaluationError
        Too few points (6, or 5 with known radius), points that are not finite or lie in one plane, or a patch so
        small or noisy that it leaves the axis open.
    """
    what = "a cylinder fit"
    points, unit, known = prepared_round(points, radius_mm, least=6, what=what)
    thinned = evenly_thinned(unit.points, _THINNED)
    trials = [_refined_cylinder(thinned, *start, known) for start in _cylinder_starts(thinned, known, axis_start)]
    frame, start, _ = min(trials, key=lambda trial: trial[2])
    frame, parameters, cost = _refined_cylinder(unit.points, frame, start, known)
    require_convergence(cost, what=what)

    covariance, std = covariance_of(_cylinder_jacobian(parameters, unit.points, frame), cost, what="a cylinder")
    radius = known if known is not None else float(parameters[4])
    sigma = np.sqrt(np.diag(covariance))
    if np.hypot(*sigma[:2]) > LARGEST_RELATIVE_STD * radius or np.hypot(*sigma[2:4]) > _LARGEST_SLOPE_STD:
        raise EvaluationError(
            f"the {len(points)} points do not determine a cylinder: its axis would be uncertain by "
            f"{np.hypot(*sigma[:2]) * unit.scale_mm:.3g} mm and {np.degrees(np.hypot(*sigma[2:4])):.3g} deg, "
            f"its radius {radius * unit.scale_mm:.3g} mm"
        )
    units = np.array([unit.scale_mm, unit.scale_mm, 1.0, 1.0, unit.scale_mm])[: len(parameters)]
    point = unit.centroid_mm + unit.scale_mm * parameters[:2] @ frame[:2]
    radius = float(radius_mm if radius_mm is not None else radius * unit.scale_mm)
    across = (points - point) @ frame[:2].T
    return CylinderFit(
        point_mm=point,
        axis=frame[2],
        across=frame[:2],
        radius_mm=radius,
        residuals_mm=np.hypot(across[:, 0], across[:, 1]) - radius,
        std_mm=std * unit.scale_mm,
        covariance=covariance * np.outer(units, units),
    )


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
    radial /= np.maximum(np.linalg.norm(radial, axis=1, keepdims=True), np.finfo(float).tiny)
    across = radial @ frame[:2].T
    jacobian = np.full((len(points), len(parameters)), -1.0)
    jacobian[:, :2] = -across
    jacobian[:, 2:4] = -across * (along / stretch)[:, None]
    return jacobian


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
    """Right-handed unit directions (u, v, axis) in rows; the largest component of the axis becomes positive."""
    axis = axis / np.linalg.norm(axis)
    if axis[np.argmax(np.abs(axis))] < 0:
        axis = -axis
    first = np.cross(axis, np.eye(3)[np.argmin(np.abs(axis))])
    first /= np.linalg.norm(first)
    return np.array([first, np.cross(axis, first), axis])


def _cylinder_starts(points: np.ndarray, known: float | None, axis_start: Any) -> list[tuple[np.ndarray, np.ndarray]]:
    if axis_start is None:
        directions = np.vstack([principal_axes(points)[1], _normal_to_normals(points), _half_sphere(_DIRECTIONS)])
    else:
        directions = np.asarray(axis_start, dtype=np.float64).reshape(1, 3)
        if not np.isfinite(directions).all() or not directions.any():
            raise ValueError(f"axis_start must be a direction, not {axis_start}")
    frames = np.array([_frame(direction) for direction in directions])
    seen = np.einsum("nd,kcd->knc", points, frames[:, :2])
    seen_mean = seen.mean(axis=1, keepdims=True)
    centres, radii = algebraic_centres(seen - seen_mean)
    centres += seen_mean[:, 0]
    misfit = np.sum((np.linalg.norm(seen - centres[:, None], axis=2) - radii[:, None]) ** 2, axis=1)
    starts = []
    for best in np.argsort(misfit)[:_TRIED]:
        if known is None:
            starts.append((frames[best], np.array([*centres[best], 0.0, 0.0, radii[best]])))
        else:
            centre = seen_mean[best, 0] + centre_of_known_radius(seen[best] - seen_mean[best], known)
            starts.append((frames[best], np.array([*centre, 0.0, 0.0])))
    return starts


def _normal_to_normals(points: np.ndarray) -> np.ndarray:
    """The direction most nearly normal to the surface normals of small neighbourhoods."""
    _, nearest = KDTree(points).query(points, k=min(_NEIGHBOURS, len(points)))
    patches = points[nearest] - points[nearest].mean(axis=1, keepdims=True)
    _, vectors = np.linalg.eigh(np.swapaxes(patches, 1, 2) @ patches)
    normals = vectors[:, :, 0]
    return np.linalg.eigh(normals.T @ normals)[1][:, 0]


def _half_sphere(count: int) -> np.ndarray:
    """Evenly spread directions (count, 3) with z > 0: a Fibonacci lattice."""
    step = np.arange(count) + 0.5
    z = step / count
    angle = np.pi * (3.0 - 5.0**0.5) * step
    radius = np.sqrt(1.0 - z**2)
    return np.column_stack([radius * np.cos(angle), radius * np.sin(angle), z])


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
