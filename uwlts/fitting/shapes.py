"""Orthogonal-distance fits of planes, straight lines, spheres and cylinders; the radius may be free or known."""

from dataclasses import dataclass
from typing import Any

import numpy as np
from scipy.spatial import KDTree

from uwlts.errors import EvaluationError
from uwlts.fitting.least_squares import (
    LARGEST_RELATIVE_STD,
    Normalised,
    minimise_squares,
    normalise_points,
    parameter_covariance,
    principal_axes,
    thin_evenly,
)

_THINNED = 600
"""Number of points for the search of a cylinder axis."""
_NEIGHBOURS = 12
"""Number of neighbours for a local normal."""
_DIRECTIONS = 80
"""Number of axis directions tried on the half sphere, about 15 deg apart."""
_TRIED = 5
"""Number of best directions that are refined."""
_CIRCLE_STEPS = 20
"""Largest number of Gauss-Newton steps to a circle; they converge in about five."""
_LARGEST_CIRCLE = 1e6
"""Radius of a circle, relative to the extent of its points, above which they are collinear within rounding errors."""
_LARGEST_SLOPE_STD = 0.2
"""Largest standard uncertainty of the axis slope (11 deg); beyond, the direction is undetermined."""


@dataclass(frozen=True, eq=False)
class FlatFit:
    """Straight line (K = 1) or plane (K = 2) fitted to N points with D coordinates."""

    point_mm: np.ndarray  # (D,); centroid of the points
    axes: np.ndarray  # (K, D); unit directions in the shape, the longest extent of the points first
    normals: np.ndarray  # (D - K, D); unit directions normal to the shape
    residuals_mm: np.ndarray  # (N,); distances of the points: signed if there is one normal, else non-negative
    std_mm: float  # standard deviation of one normal coordinate, with (D - K) (N - K - 1) degrees of freedom
    covariance: np.ndarray
    """Covariance of the offsets along the normals at the point (mm), then of the slopes (rad) along the axes."""

    @property
    def normal(self) -> np.ndarray:
        """Unit normal (D,) of a plane, or of a line in a plane."""
        return self.normals[0]

    @property
    def direction(self) -> np.ndarray:
        """Unit direction (D,) of a line."""
        return self.axes[0]

    def distances_mm(self, points: np.ndarray) -> np.ndarray:
        """Return the distances (M,) of points (M, D), as in `residuals_mm`."""
        return _norms((np.asarray(points, dtype=np.float64) - self.point_mm) @ self.normals.T)

    def normals_at(self, points: np.ndarray) -> np.ndarray:
        """Return the unit normals (M, D) of the distances of points (M, D) from a plane, or from a line in a plane."""
        return np.broadcast_to(self.normal, points.shape)

    def derivatives(self, points: np.ndarray) -> np.ndarray:
        """Return the derivatives (M, K + 1) of these distances by the parameters, in the order of the covariance."""
        return -np.column_stack([np.ones(len(points)), (points - self.point_mm) @ self.axes.T])


def fit_plane(points: Any, towards: Any = None) -> FlatFit:
    """Fit a plane to points (N, 3), mm, by least squares.

    The normal is oriented ``towards`` (3,); by default its largest component is positive. EvaluationError for fewer
    than 4 points, points that are not finite, or points on one line.
    """
    unit = normalise_points(points, least=4, what="a plane fit")
    if unit.is_flat(1):
        raise EvaluationError(f"a plane fit: all {len(unit.points)} points lie on one line")
    return _flat_fit(unit, unit.axes[:2], _orient(unit.axes[2], towards)[None])


def fit_line(points: Any, towards: Any = None) -> FlatFit:
    """Fit a straight line to points (N, 2) or (N, 3), mm, by least squares.

    The direction is oriented ``towards`` (D,); by default its largest component is positive. For D = 2, the normal is
    the direction rotated by 90 degrees from the first axis to the second. EvaluationError for fewer than 3 points,
    points that are not finite, or points without a longest direction.
    """
    unit = normalise_points(points, least=3, what="a line fit", dimensions=(2, 3))
    if unit.extents[0] - unit.extents[1] <= 1e-9 * unit.extents[0]:
        raise EvaluationError(f"a line fit: the {len(unit.points)} points extend equally in two directions")
    x, y, *z = direction = _orient(unit.axes[0], towards)
    return _flat_fit(unit, direction[None], unit.axes[1:] if z else np.array([[-y, x]]))


def _orient(direction: np.ndarray, towards: Any) -> np.ndarray:
    side = direction[np.argmax(np.abs(direction))] if towards is None else float(direction @ np.asarray(towards))
    return -direction if side < 0 else direction


def _flat_fit(unit: Normalised, axes: np.ndarray, normals: np.ndarray) -> FlatFit:
    across = (unit.given_mm - unit.centroid_mm) @ normals.T
    variance = float(np.sum(across**2)) / (len(normals) * (len(across) - len(axes) - 1))
    leverage = np.array([len(across), *(unit.extents[: len(axes)] * unit.scale_mm) ** 2])
    covariance = np.diag(variance / np.repeat(leverage, len(normals)))
    return FlatFit(unit.centroid_mm, axes, normals, _norms(across), variance**0.5, covariance)


def _norms(across: np.ndarray) -> np.ndarray:
    """Return distances from normal components (..., C), signed if there is one component."""
    return across[..., 0] if across.shape[-1] == 1 else np.linalg.norm(across, axis=-1)


@dataclass(frozen=True, eq=False)
class SphereFit:
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
        return _unit_vectors(points - self.centre_mm)

    def derivatives(self, points: np.ndarray) -> np.ndarray:
        """Return the derivatives (M, 4) or (M, 3) of the distances by the parameters, in the order of the covariance.

        The derivative of |p - c| - r is minus the unit vector from the centre, and -1 for a free radius.
        """
        by_radius = np.full((len(points), len(self.covariance) - 3), -1.0)
        return np.hstack([-self.normals_at(points), by_radius])


def fit_sphere(points: Any, radius_mm: float | None = None) -> SphereFit:
    """Fit a sphere of free or known radius to points (N, 3), mm, by least squares; a cap suffices.

    Raises EvaluationError if there are fewer than 5 points (4 with known radius), or they are not finite or in one
    plane. The same if the standard uncertainty of the centre exceeds a fifth of the radius.
    """
    unit, known = _prepare_round(points, radius_mm, least=5, what="a sphere fit")

    def jacobian(x: np.ndarray) -> np.ndarray:
        """Return d|p - c| / dc, minus the unit vector from the centre, and -1 for the radius."""
        return np.hstack([-_unit_vectors(unit.points - x[:3]), np.full((len(unit.points), len(x) - 3), -1.0)])

    parameters, cost = minimise_squares(
        lambda x: np.linalg.norm(unit.points - x[:3], axis=1) - (x[3] if known is None else known),
        jacobian,
        np.hstack(fit_algebraic_centres(unit.points)) if known is None else initial_centre(unit.points, known),
    )
    covariance, std = parameter_covariance(jacobian(parameters), cost, what="a sphere")
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


def _prepare_round(points: Any, radius_mm: float | None, *, least: int, what: str) -> tuple[Normalised, float | None]:
    """Normalise points for a fit of a sphere or cylinder, and a known radius; with it, one point fewer is needed."""
    unit = normalise_points(points, least=least if radius_mm is None else least - 1, what=what)
    if radius_mm is not None and not (np.isfinite(radius_mm) and radius_mm > 0):
        raise ValueError(f"the radius is {radius_mm}; expected a positive number")
    if unit.is_flat(2):
        raise EvaluationError(f"{what}: all {len(unit.points)} points lie in one plane")
    return unit, None if radius_mm is None else radius_mm / unit.scale_mm


def _unit_vectors(vectors: np.ndarray) -> np.ndarray:
    return vectors / np.maximum(np.linalg.norm(vectors, axis=1, keepdims=True), np.finfo(float).tiny)


@dataclass(frozen=True, eq=False)
class CylinderFit:
    """Cylinder of fitted or known radius."""

    point_mm: np.ndarray  # (3,); point of the axis nearest to the centroid of the points
    axis: np.ndarray  # (3,); unit direction of the axis; its largest component is positive
    across: np.ndarray  # (2, 3); orthogonal unit directions normal to the axis
    radius_mm: float
    residuals_mm: np.ndarray  # (N,); distances from the axis minus the radius
    std_mm: float  # standard deviation of the residuals, as for `SphereFit`
    covariance: np.ndarray
    """(5, 5) or (4, 4); covariance of the axis offsets along ``across`` (mm), the axis slopes along them (rad), and
    a free radius (mm)."""

    def distances_mm(self, points: np.ndarray) -> np.ndarray:
        """Return the signed distances (M,) of points (M, 3), as in `residuals_mm`."""
        across = (np.asarray(points, dtype=np.float64) - self.point_mm) @ self.across.T
        return np.hypot(across[:, 0], across[:, 1]) - self.radius_mm

    def normals_at(self, points: np.ndarray) -> np.ndarray:
        """Return the unit normals (M, 3) of the distances of points (M, 3), outwards."""
        return _unit_vectors((points - self.point_mm) @ self.across.T) @ self.across

    def derivatives(self, points: np.ndarray) -> np.ndarray:
        """Return the derivatives (M, 5) or (M, 4) of the distances by the parameters, ordered as the covariance."""
        offsets = -self.normals_at(points) @ self.across.T
        along = ((points - self.point_mm) @ self.axis)[:, None]
        by_radius = np.full((len(points), len(self.covariance) - 4), -1.0)
        return np.hstack([offsets, along * offsets, by_radius])


def fit_cylinder(points: Any, radius_mm: float | None = None, axis_start: Any = None) -> CylinderFit:
    """Fit a cylinder of free or known radius to points (N, 3), mm, by least squares.

    ``axis_start`` (3,) is an approximate axis direction. By default the direction is searched. The candidates are the
    principal axes, the direction most nearly normal to all local surface normals, and an even grid over the half
    sphere. Each is scored by a circle fit to the projected points, and the best few are refined on a subset.

    Raises EvaluationError if there are too few points (fewer than 6, or 5 with known radius), points are not finite or
    in one plane, or the axis is not determined.
    """
    unit, known = _prepare_round(points, radius_mm, least=6, what="a cylinder fit")
    thinned = thin_evenly(unit.points, _THINNED)
    trials = [_refined_cylinder(thinned, *start, known) for start in _cylinder_starts(thinned, known, axis_start)]
    frame, start, _ = min(trials, key=lambda trial: trial[2])
    frame, parameters, cost = _refined_cylinder(unit.points, frame, start, known)
    covariance, std = parameter_covariance(_cylinder_jacobian(parameters, unit.points, frame), cost, what="a cylinder")
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
    """Return radial vectors (N, 3), positions along the axis (N,), and the norm of the direction a + s u + t v."""
    direction = frame[2] + parameters[2:4] @ frame[:2]
    stretch = float(np.linalg.norm(direction))
    direction = direction / stretch
    away = points - parameters[:2] @ frame[:2]
    along = away @ direction
    return away - along[:, None] * direction, along, stretch


def _cylinder_jacobian(parameters: np.ndarray, points: np.ndarray, frame: np.ndarray) -> np.ndarray:
    """Return the derivatives -e.u, -e.v, -along e.u / stretch, the same with v, and -1, for radial unit vectors e."""
    radial, along, stretch = _cylinder_geometry(parameters, points, frame)
    across = -_unit_vectors(radial) @ frame[:2].T
    by_radius = np.full((len(points), len(parameters) - 4), -1.0)
    return np.hstack([across, across * (along / stretch)[:, None], by_radius])


def _refined_cylinder(
    points: np.ndarray, frame: np.ndarray, start: np.ndarray, known: float | None
) -> tuple[np.ndarray, np.ndarray, float]:
    """Return frame, parameters and cost of the solution, with the frame rotated so that both slopes are zero."""
    parameters, cost = minimise_squares(
        lambda x: np.linalg.norm(_cylinder_geometry(x, points, frame)[0], axis=1) - (x[4] if known is None else known),
        lambda x: _cylinder_jacobian(x, points, frame),
        start,
    )
    turned = _axis_frame(frame[2] + parameters[2:4] @ frame[:2])
    foot = turned[:2] @ (parameters[:2] @ frame[:2])
    return turned, np.array([*foot, 0.0, 0.0, *parameters[4:]]), cost


def perpendicular_to(direction: np.ndarray) -> np.ndarray:
    """Return two unit directions (2, 3) perpendicular to a unit direction and to each other."""
    first = np.cross(direction, np.eye(3)[np.argmin(np.abs(direction))])
    first /= np.linalg.norm(first)
    return np.array([first, np.cross(direction, first)])


def _axis_frame(axis: np.ndarray) -> np.ndarray:
    """Return right-handed unit directions (u, v, axis) in rows; the largest component of the axis becomes positive.

    The first is normal to the coordinate axis after that of the largest component. Noise of an axis along a coordinate
    axis therefore does not rotate the frame.
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
            raise ValueError(f"axis_start is {axis_start}; expected a direction")
    frames = np.array([_axis_frame(direction) for direction in directions])
    seen = np.einsum("nd,kcd->knc", points, frames[:, :2])
    middle = seen.mean(axis=1)
    centred = seen - middle[:, None]
    centres, radii = fit_algebraic_centres(centred)
    misfit = np.sum((np.linalg.norm(centred - centres[:, None], axis=2) - radii[:, None]) ** 2, axis=1)
    starts = []
    for best in np.argsort(misfit)[:_TRIED]:
        centre = centres[best] if known is None else initial_centre(centred[best], known)
        free = [radii[best]] if known is None else []
        starts.append((frames[best], np.array([*(middle[best] + centre), 0.0, 0.0, *free])))
    return starts


def _normal_to_normals(points: np.ndarray) -> np.ndarray:
    """Return the direction most nearly normal to the surface normals of small neighbourhoods."""
    _, nearest = KDTree(points).query(points, k=min(_NEIGHBOURS, len(points)))
    patches = points[nearest] - points[nearest].mean(axis=1, keepdims=True)
    _, vectors = np.linalg.eigh(np.swapaxes(patches, 1, 2) @ patches)
    normals = vectors[:, :, 0]
    return np.linalg.eigh(normals.T @ normals)[1][:, 0]


def fit_algebraic_centres(points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Fit centres (..., D) and radii (...) of circles (D = 2) or spheres (D = 3) to centred points (..., N, D).

    Taubin's fit, which is nearly unbiased on short arcs. It is the eigenvector of the smallest eigenvalue of the
    moments of (|p|^2 - m) / (2 sqrt m) and p, where m is the mean of |p|^2 (N. Chernov, Circular and linear
    regression, 2010, section 5.10). Points on a line or plane give huge, finite radii.
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


def fit_circle(points: np.ndarray) -> tuple[np.ndarray, float]:
    """Fit a circle to points (N, 2) by least squares of the distances; return its centre (2,) and radius.

    Gauss-Newton steps from the algebraic circle. EvaluationError if the points are on a line within rounding errors, or
    the fit does not converge.
    """
    middle = points.mean(axis=0)
    extent = float(np.ptp(points, axis=0).max())
    offset, radius = fit_algebraic_centres(points - middle)
    result = np.append(middle + offset, radius)
    for _ in range(_CIRCLE_STEPS):
        away = points - result[:2]
        distance = np.maximum(np.linalg.norm(away, axis=1), 1e-12 * extent)
        design = np.column_stack([away / distance[:, None], np.ones(len(away))])
        step = np.linalg.lstsq(design, distance - result[2], rcond=None)[0]
        result = result + step
        if np.abs(step).max() <= 1e-9 * extent and 0 < result[2] < _LARGEST_CIRCLE * extent:
            return result[:2], float(result[2])
    raise EvaluationError(f"no circle fits the {len(points)} points: they lie on a line, or the fit does not converge")


def initial_centre(points: np.ndarray, radius: float) -> np.ndarray:
    """Return an initial centre (D,) of a circle or sphere of known radius through centred points (N, D).

    It has the direction of the algebraic centre, and the depth that follows from the lateral extent of the points.
    """
    centre, _ = fit_algebraic_centres(points)
    direction = centre / max(float(np.linalg.norm(centre)), 1e-12)
    across = np.sum(points**2, axis=-1) - (points @ direction) ** 2
    depth = np.sqrt(max(radius**2 - float(across.mean()), (0.1 * radius) ** 2))
    return direction * depth
