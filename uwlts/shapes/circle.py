"""Circles: orthogonal-distance fit; algebraic fits and checks that all round shapes share."""

from dataclasses import dataclass
from typing import Any, Self

import numpy as np

from uwlts.errors import EvaluationError
from uwlts.fitting.least_squares import Normalised, normalise_points

_CIRCLE_STEPS = 20
"""Largest number of Gauss-Newton steps to a circle; they converge in about five."""
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
            away = points - result[:2]
            distance = np.maximum(np.linalg.norm(away, axis=1), 1e-12 * extent)
            design = np.column_stack([away / distance[:, None], np.ones(len(away))])
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
    radii = np.sqrt(np.sum(centres**2, axis=-1) + mean)
    return centres, radii


def initial_centre(points: np.ndarray, radius: float) -> np.ndarray:
    """Return an initial centre (D,) of a circle or sphere of known radius through centred points (N, D).

    It has the direction of the algebraic centre, and the depth that follows from the lateral extent of the points.
    """
    centre, _ = fit_algebraic_centres(points)
    direction = centre / max(float(np.linalg.norm(centre)), 1e-12)
    across = np.sum(points**2, axis=-1) - (points @ direction) ** 2
    depth = np.sqrt(max(radius**2 - float(across.mean()), (0.1 * radius) ** 2))
    return direction * depth


def prepare_round(points: Any, radius_mm: float | None, *, least: int, what: str) -> tuple[Normalised, float | None]:
    """Normalise points for a fit of a sphere or cylinder, and a known radius; with it, one point fewer is needed."""
    unit = normalise_points(points, least=least if radius_mm is None else least - 1, what=what)
    if radius_mm is not None and not (np.isfinite(radius_mm) and radius_mm > 0):
        raise ValueError(f"the radius is {radius_mm}; expected a positive number")
    if unit.is_flat(2):
        raise EvaluationError(f"{what}: all {len(unit.points)} points lie in one plane")
    return unit, None if radius_mm is None else radius_mm / unit.scale_mm


def unit_vectors(vectors: np.ndarray) -> np.ndarray:
    """Return vectors (N, D) of length 1; those of length 0 stay."""
    return vectors / np.maximum(np.linalg.norm(vectors, axis=1, keepdims=True), np.finfo(float).tiny)
