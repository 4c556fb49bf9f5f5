"""Cylinders: orthogonal-distance fit with a search of the axis."""

from dataclasses import dataclass
from typing import Any, Self

import numpy as np
from scipy.spatial import KDTree

from uwlts.errors import EvaluationError
from uwlts.fitting.least_squares import (
    LARGEST_RELATIVE_STD,
    minimise_squares,
    parameter_covariance,
    principal_axes,
    thin_evenly,
)
from uwlts.shapes.flat import fit_algebraic_centres, initial_centre, prepare_round, unit_vectors

_THINNED = 600  # number of points for the search of a cylinder axis
_NEIGHBOURS = 12  # number of neighbours for a local normal
_DIRECTIONS = 80  # number of axis directions tried on the half sphere, about 15 deg apart
_TRIED = 5  # number of best directions that are refined
_LARGEST_SLOPE_STD = 0.2
"""Largest standard uncertainty of the axis slope (11 deg); beyond, the direction is undetermined."""


@dataclass(frozen=True, eq=False)
class Cylinder:
    """Cylinder of fitted or known radius."""

    point_mm: np.ndarray  # (3,); point of the axis nearest to the centroid of the points
    axis: np.ndarray  # (3,); unit direction of the axis; its largest component is positive
    across: np.ndarray  # (2, 3); orthogonal unit directions normal to the axis
    radius_mm: float
    residuals_mm: np.ndarray  # (N,); distances from the axis minus the radius
    std_mm: float  # standard deviation of the residuals, as for `Sphere`
    covariance: np.ndarray
    """(5, 5) or (4, 4); covariance of the axis offsets along ``across`` (mm), the axis slopes along them (rad), and
    a free radius (mm)."""

    def distances_mm(self, points: np.ndarray) -> np.ndarray:
        """Return the signed distances (M,) of points (M, 3), as in `residuals_mm`."""
        across = (np.asarray(points, dtype=np.float64) - self.point_mm) @ self.across.T
        return np.hypot(across[:, 0], across[:, 1]) - self.radius_mm

    def normals_at(self, points: np.ndarray) -> np.ndarray:
        """Return the unit normals (M, 3) of the distances of points (M, 3), outwards."""
        return unit_vectors((points - self.point_mm) @ self.across.T) @ self.across

    def derivatives(self, points: np.ndarray) -> np.ndarray:
        """Return the derivatives (M, 5) or (M, 4) of the distances by the parameters, ordered as the covariance."""
        offsets = -self.normals_at(points) @ self.across.T
        along = ((points - self.point_mm) @ self.axis)[:, None]
        return np.hstack([offsets, along * offsets, np.full((len(points), len(self.covariance) - 4), -1.0)])

    @classmethod
    def fit(cls, points: Any, radius_mm: float | None = None, axis_start: Any = None) -> Self:
        """Fit a cylinder of free or known radius to points (N, 3), mm, by least squares.

        ``axis_start`` (3,) is an approximate axis direction. By default the direction is searched. The candidates are
        the principal axes, the direction most nearly normal to all local surface normals, and an even grid over the
        half sphere. Each is scored by a circle fit to the projected points, and the best few are refined on a subset.

        Raises EvaluationError if there are too few points (fewer than 6, or 5 with known radius), points are not finite
        or in one plane, or the axis is not determined.
        """
        unit, known = prepare_round(points, radius_mm, least=6, what="a cylinder fit")
        thinned = thin_evenly(unit.points, _THINNED)
        trials = [_refine_cylinder(thinned, *start, known) for start in _list_starts(thinned, known, axis_start)]
        frame, start, _ = min(trials, key=lambda trial: trial[2])
        frame, parameters, cost = _refine_cylinder(unit.points, frame, start, known)
        covariance, std = parameter_covariance(
            _compute_jacobian(parameters, unit.points, frame), cost, what="a cylinder"
        )
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
        return cls(point, frame[2], frame[:2], radius, residuals, std * unit.scale_mm, covariance)


def _compute_geometry(
    parameters: np.ndarray, points: np.ndarray, frame: np.ndarray
) -> tuple[np.ndarray, np.ndarray, float]:
    """Return radial vectors (N, 3), positions along the axis (N,), and the norm of the direction a + s u + t v."""
    direction = frame[2] + parameters[2:4] @ frame[:2]
    stretch = float(np.linalg.norm(direction))
    direction = direction / stretch
    offset = points - parameters[:2] @ frame[:2]
    along = offset @ direction
    return offset - along[:, None] * direction, along, stretch


def _compute_jacobian(parameters: np.ndarray, points: np.ndarray, frame: np.ndarray) -> np.ndarray:
    """Return the derivatives -e.u, -e.v, -along e.u / stretch, the same with v, and -1, for radial unit vectors e."""
    radial, along, stretch = _compute_geometry(parameters, points, frame)
    across = -unit_vectors(radial) @ frame[:2].T
    by_radius = np.full((len(points), len(parameters) - 4), -1.0)
    return np.hstack([across, across * (along / stretch)[:, None], by_radius])


def _refine_cylinder(
    points: np.ndarray, frame: np.ndarray, start: np.ndarray, known: float | None
) -> tuple[np.ndarray, np.ndarray, float]:
    """Return frame, parameters and cost of the solution, with the frame rotated so that both slopes are zero."""
    parameters, cost = minimise_squares(
        lambda x: np.linalg.norm(_compute_geometry(x, points, frame)[0], axis=1) - (x[4] if known is None else known),
        lambda x: _compute_jacobian(x, points, frame),
        start,
    )
    turned = _find_axis_frame(frame[2] + parameters[2:4] @ frame[:2])
    foot = turned[:2] @ (parameters[:2] @ frame[:2])
    return turned, np.array([*foot, 0.0, 0.0, *parameters[4:]]), cost


def _find_axis_frame(axis: np.ndarray) -> np.ndarray:
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


def _list_starts(points: np.ndarray, known: float | None, axis_start: Any) -> list[tuple[np.ndarray, np.ndarray]]:
    if axis_start is None:
        # Evenly spread directions with z > 0: a Fibonacci lattice.
        step = np.arange(_DIRECTIONS) + 0.5
        z, angle = step / _DIRECTIONS, np.pi * (3.0 - 5.0**0.5) * step
        lattice = np.sqrt(1.0 - z**2) * np.array([np.cos(angle), np.sin(angle)])
        normals = local_normals(points)
        # The direction most nearly normal to the surface's normals.
        along = np.linalg.eigh(normals.T @ normals)[1][:, 0]
        directions = np.vstack([principal_axes(points)[1], along, np.vstack([lattice, z]).T])
    else:
        directions = np.asarray(axis_start, dtype=np.float64).reshape(1, 3)
        if not np.isfinite(directions).all() or not directions.any():
            raise ValueError(f"axis_start is {axis_start}; expected a direction")
    frames = np.array([_find_axis_frame(direction) for direction in directions])
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


def local_normals(points: np.ndarray) -> np.ndarray:
    """Return the surface normals (N, 3) of small neighbourhoods of points, with any sign."""
    _, nearest = KDTree(points).query(points, k=min(_NEIGHBOURS, len(points)))
    patches = points[nearest] - points[nearest].mean(axis=1, keepdims=True)
    return np.linalg.eigh(np.swapaxes(patches, 1, 2) @ patches)[1][:, :, 0]
