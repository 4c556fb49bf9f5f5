"""Plane and straight line by orthogonal distances."""

from dataclasses import dataclass
from typing import Any

import numpy as np

from uwlts.metrology.least_squares import accepted_points, is_flat, normalise, principal_axes
from uwlts.model.errors import EvaluationError


@dataclass(frozen=True, eq=False)
class PlaneFit:
    """A plane through points in space.

    Attributes
    ----------
    point_mm : (3,)
        Centroid of the points, on the plane.
    normal : (3,)
        Unit normal.
    axes : (2, 3)
        Unit directions in the plane, the longer extent of the points first.
    residuals_mm : (N,)
        Signed distances, positive on the side to which the normal points.
    std_mm : float
        Standard deviation of the residuals, with N - 3 degrees of freedom.
    covariance : (3, 3)
        Of the offset along the normal at `point_mm` (mm) and the slopes (rad) along the two axes.
    """

    point_mm: np.ndarray
    normal: np.ndarray
    axes: np.ndarray
    residuals_mm: np.ndarray
    std_mm: float
    covariance: np.ndarray

    def distances_mm(self, points: np.ndarray) -> np.ndarray:
        """Signed distances (M,) of any points (M, 3), as in `residuals_mm`."""
        return (np.asarray(points, dtype=np.float64) - self.point_mm) @ self.normal


@dataclass(frozen=True, eq=False)
class LineFit:
    """A straight line through points in a plane (D = 2) or in space (D = 3).

    Attributes
    ----------
    point_mm : (D,)
        Centroid of the points, on the line.
    direction : (D,)
        Unit direction.
    normals : (D - 1, D)
        Unit directions across the line.
    residuals_mm : (N,)
        Distances: in a plane signed, positive to the side of the normal; in space never negative.
    std_mm : float
        Standard deviation of one coordinate across the line, with (D - 1) (N - 2) degrees of freedom.
    covariance : (2 D - 2, 2 D - 2)
        Of the offsets along the normals at `point_mm` (mm), then of the slopes towards them (rad).
    """

    point_mm: np.ndarray
    direction: np.ndarray
    normals: np.ndarray
    residuals_mm: np.ndarray
    std_mm: float
    covariance: np.ndarray

    def distances_mm(self, points: np.ndarray) -> np.ndarray:
        """Distances (M,) of any points (M, D), as in `residuals_mm`."""
        across = (np.asarray(points, dtype=np.float64) - self.point_mm) @ self.normals.T
        return across[:, 0] if len(self.normals) == 1 else np.linalg.norm(across, axis=1)


def fit_plane(points: Any, towards: Any = None) -> PlaneFit:
    """Least-squares plane through points (N, 3), mm, its normal turned ``towards`` (3,) or its largest part positive.

    Raises
    ------
    EvaluationError
        Fewer than 4 points, points that are not finite, or points on one line.
    """
    what = "a plane fit"
    points = accepted_points(points, least=4, what=what)
    unit = normalise(points, what=what)
    extents, axes = principal_axes(unit.points)
    if is_flat(extents, 1):
        raise EvaluationError(f"{what}: all {len(points)} points lie on one line")
    normal = _turned(axes[2], towards)
    residuals = (points - unit.centroid_mm) @ normal
    std = float(np.sqrt(residuals @ residuals / (len(points) - 3)))
    leverage = np.array([len(points), *(extents[:2] * unit.scale_mm) ** 2])
    return PlaneFit(unit.centroid_mm, normal, axes[:2], residuals, std, np.diag(std**2 / leverage))


def fit_line(points: Any, towards: Any = None) -> LineFit:
    """Least-squares line through points (N, 2) or (N, 3), mm.

    Parameters
    ----------
    towards : (D,), optional
        The direction is turned to this side; without it its largest component is positive. In a plane the normal is
        the direction turned from the first axis towards the second by 90 degrees.

    Raises
    ------
    EvaluationError
        Fewer than 3 points, points that are not finite, or points without a longest direction.
    """
    what = "a line fit"
    points = accepted_points(points, least=3, what=what, dimensions=(2, 3))
    unit = normalise(points, what=what)
    extents, axes = principal_axes(unit.points)
    if extents[0] - extents[1] <= 1e-9 * extents[0]:
        raise EvaluationError(f"{what}: the {len(points)} points extend equally in two directions")
    direction = _turned(axes[0], towards)
    normals = np.array([[-direction[1], direction[0]]]) if points.shape[1] == 2 else axes[1:]
    across = (points - unit.centroid_mm) @ normals.T
    variance = float(np.sum(across**2)) / (len(normals) * (len(points) - 2))
    leverage = np.repeat([len(points), (extents[0] * unit.scale_mm) ** 2], len(normals))
    residuals = across[:, 0] if len(normals) == 1 else np.linalg.norm(across, axis=1)
    return LineFit(unit.centroid_mm, direction, normals, residuals, variance**0.5, np.diag(variance / leverage))


def _turned(direction: np.ndarray, towards: Any) -> np.ndarray:
    side = direction[np.argmax(np.abs(direction))] if towards is None else float(direction @ np.asarray(towards))
    return -direction if side < 0 else direction
