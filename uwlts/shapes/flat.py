"""Planes, straight lines and circles: orthogonal-distance fits."""

from dataclasses import dataclass
from typing import Any, Self

import numpy as np

from uwlts.errors import EvaluationError
from uwlts.fitting.least_squares import Normalised, normalise_points


@dataclass(frozen=True, eq=False)
class Flat:
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
        return _compute_norms((np.asarray(points, dtype=np.float64) - self.point_mm) @ self.normals.T)

    def normals_at(self, points: np.ndarray) -> np.ndarray:
        """Return the unit normals (M, D) of the distances of points (M, D) from a plane, or from a line in a plane."""
        return np.broadcast_to(self.normal, points.shape)

    def derivatives(self, points: np.ndarray) -> np.ndarray:
        """Return the derivatives (M, K + 1) of these distances by the parameters, in the order of the covariance."""
        return -np.column_stack([np.ones(len(points)), (points - self.point_mm) @ self.axes.T])

    @classmethod
    def _make_from_axes(cls, unit: Normalised, axes: np.ndarray, normals: np.ndarray) -> Self:
        across = (unit.given_mm - unit.centroid_mm) @ normals.T
        variance = float(np.sum(across**2)) / (len(normals) * (len(across) - len(axes) - 1))
        leverage = np.array([len(across), *(unit.extents[: len(axes)] * unit.scale_mm) ** 2])
        covariance = np.diag(variance / np.repeat(leverage, len(normals)))
        return cls(unit.centroid_mm, axes, normals, _compute_norms(across), variance**0.5, covariance)


@dataclass(frozen=True, eq=False)
class Plane(Flat):
    """Plane fitted to N points (N, 3)."""

    @classmethod
    def fit(cls, points: Any, towards: Any = None) -> Self:
        """Fit a plane to points (N, 3), mm, by least squares.

        The normal is oriented ``towards`` (3,); by default its largest component is positive. EvaluationError for fewer
        than 4 points, points that are not finite, or points on one line.
        """
        unit = normalise_points(points, least=4, what="a plane fit")
        if unit.rank < 2:
            raise EvaluationError(f"a plane fit: all {len(unit.points)} points lie on one line")
        return cls._make_from_axes(unit, unit.axes[:2], _orient(unit.axes[2], towards)[None])


@dataclass(frozen=True, eq=False)
class Line(Flat):
    """Straight line fitted to N points (N, 2) or (N, 3)."""

    @classmethod
    def fit(cls, points: Any, towards: Any = None) -> Self:
        """Fit a straight line to points (N, 2) or (N, 3), mm, by least squares.

        The direction is oriented ``towards`` (D,); by default its largest component is positive. For D = 2, the normal
        is the direction rotated by 90 degrees from the first axis to the second. EvaluationError for fewer than 3
        points, points that are not finite, or points without a longest direction.
        """
        unit = normalise_points(points, least=3, what="a line fit", dimensions=(2, 3))
        if unit.extents[0] - unit.extents[1] <= 1e-9 * unit.extents[0]:
            raise EvaluationError(f"a line fit: the {len(unit.points)} points extend equally in two directions")
        x, y, *z = direction = _orient(unit.axes[0], towards)
        return cls._make_from_axes(unit, direction[None], unit.axes[1:] if z else np.array([[-y, x]]))


def _orient(direction: np.ndarray, towards: Any) -> np.ndarray:
    side = direction[np.argmax(np.abs(direction))] if towards is None else float(direction @ np.asarray(towards))
    return -direction if side < 0 else direction


def _compute_norms(across: np.ndarray) -> np.ndarray:
    """Return distances from normal components (..., C), signed if there is one component."""
    return across[..., 0] if across.shape[-1] == 1 else np.linalg.norm(across, axis=-1)


def perpendicular_to(direction: np.ndarray) -> np.ndarray:
    """Return two unit directions (2, 3) perpendicular to a unit direction and to each other."""
    first = np.cross(direction, np.eye(3)[np.argmin(np.abs(direction))])
    first /= np.linalg.norm(first)
    return np.array([first, np.cross(direction, first)])


_CIRCLE_STEPS = 20  # largest number of Gauss-Newton steps to a circle; they converge in about five
_LARGEST_CIRCLE = 1e6
"""Radius of a circle, relative to the extent of its points, above which they are collinear within rounding errors."""


@dataclass(frozen=True, eq=False)
class Circle:
    """Circle in a plane."""

    centre_mm: np.ndarray  # (2,)
    radius_mm: float

    @classmethod
    def fit(cls, points: np.ndarray) -> Self:
        """Fit a circle to points (N, 2), mm, by least squares of the distances.

        Gauss-Newton steps from the algebraic circle. EvaluationError if the points are on a line within rounding
        errors, or the fit does not converge.
        """
        middle = points.mean(axis=0)
        extent = float(np.ptp(points, axis=0).max())
        offset, radius = fit_algebraic_centres(points - middle)
        result = np.append(middle + offset, radius)
        for _ in range(_CIRCLE_STEPS):
            from_centre = points - result[:2]
            distance = np.maximum(np.linalg.norm(from_centre, axis=1), 1e-12 * extent)
            design = np.column_stack([from_centre / distance[:, None], np.ones(len(from_centre))])
            step = np.linalg.lstsq(design, distance - result[2], rcond=None)[0]
            result = result + step
            if np.abs(step).max() <= 1e-9 * extent and 0 < result[2] < _LARGEST_CIRCLE * extent:
                return cls(result[:2], float(result[2]))
        raise EvaluationError(
            f"no circle fits the {len(points)} points: they lie on a line, or the fit does not converge"
        )

    def distances_mm(self, points: np.ndarray) -> np.ndarray:
        """Return the signed distances (N,) of points (N, 2), positive outside."""
        return np.linalg.norm(points - self.centre_mm, axis=1) - self.radius_mm


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
    return centres, np.sqrt(np.sum(centres**2, axis=-1) + mean)


def initial_centre(points: np.ndarray, radius: float) -> np.ndarray:
    """Return an initial centre (D,) of a circle or sphere of known radius through centred points (N, D).

    It has the direction of the algebraic centre, and the depth that follows from the lateral extent of the points.
    """
    centre, _ = fit_algebraic_centres(points)
    direction = centre / max(float(np.linalg.norm(centre)), 1e-12)
    across = np.sum(points**2, axis=-1) - (points @ direction) ** 2
    return direction * np.sqrt(max(radius**2 - float(across.mean()), (0.1 * radius) ** 2))


def prepare_round(points: Any, radius_mm: float | None, *, least: int, what: str) -> tuple[Normalised, float | None]:
    """Normalise points for a fit of a sphere or cylinder, and a known radius; with it, one point fewer is needed."""
    unit = normalise_points(points, least=least if radius_mm is None else least - 1, what=what)
    if radius_mm is not None and not (np.isfinite(radius_mm) and radius_mm > 0):
        raise ValueError(f"the radius is {radius_mm}; expected a positive number")
    if unit.rank < 3:
        raise EvaluationError(f"{what}: all {len(unit.points)} points lie in one plane")
    return unit, None if radius_mm is None else radius_mm / unit.scale_mm


def unit_vectors(vectors: np.ndarray) -> np.ndarray:
    """Return vectors (N, D) of length 1; those of length 0 stay."""
    return vectors / np.maximum(np.linalg.norm(vectors, axis=1, keepdims=True), np.finfo(float).tiny)
