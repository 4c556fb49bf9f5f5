"""Sphere by orthogonal distances, with free or known radius."""

from dataclasses import dataclass
from typing import Any

import numpy as np

from uwlts.errors import EvaluationError
from uwlts.metrology.least_squares import (
    LARGEST_RELATIVE_STD,
    covariance_of,
    minimised,
    prepared_round,
    require_convergence,
)
from uwlts.metrology.round_starts import algebraic_centres, centre_of_known_radius


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
    """Least-squares sphere through points (N, 3), mm; a cap is enough.

    Parameters
    ----------
    radius_mm : float, optional
        Known radius; without it the radius is fitted.

    Raises
    ------
    EvaluationError
        Too few points (5, or 4 with known radius), points that are not finite or lie in one plane, or a cap so small
        or noisy that the centre is uncertain by more than a fifth of the radius.
    """
    what = "a sphere fit"
    points, unit, known = prepared_round(points, radius_mm, least=5, what=what)
    parameters, cost = minimised(
        lambda x: _residuals(x, unit.points, known),
        lambda x: _jacobian(x, unit.points),
        _start(unit.points, known),
    )
    require_convergence(cost, what=what)
    covariance, std = covariance_of(_jacobian(parameters, unit.points), cost, what="a sphere")
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


def _residuals(parameters: np.ndarray, points: np.ndarray, known: float | None) -> np.ndarray:
    radius = parameters[3] if known is None else known
    return np.linalg.norm(points - parameters[:3], axis=1) - radius


def _jacobian(parameters: np.ndarray, points: np.ndarray) -> np.ndarray:
    """d|p - c| / dc is minus the unit vector from the centre; d/dr is -1."""
    away = points - parameters[:3]
    away /= np.maximum(np.linalg.norm(away, axis=1, keepdims=True), np.finfo(float).tiny)
    jacobian = np.full((len(points), len(parameters)), -1.0)
    np.negative(away, out=jacobian[:, :3])
    return jacobian


def _start(points: np.ndarray, known: float | None) -> np.ndarray:
    if known is not None:
        return centre_of_known_radius(points, known)
    centre, radius = algebraic_centres(points)
    return np.array([*centre, radius])
