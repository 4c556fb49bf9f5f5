"""Plane and pipe: one surface fills the cloud."""

from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from typing import Any, ClassVar

import numpy as np

from uwlts.errors import EvaluationError
from uwlts.metrology.artefact_descriptions import Pipe, PlaneStandard
from uwlts.metrology.cylinder_fit import CylinderFit, fit_cylinder
from uwlts.metrology.evaluation import TOWARDS_SENSOR, Evaluation, spread_mm
from uwlts.metrology.flat_fits import fit_plane
from uwlts.metrology.robust_fit import RobustFit, fit_robustly

_MOST_REJECTED = 0.1
_DIAMETER_TOLERANCE = 0.2
_LEAST_ARC = np.pi
_SECTORS = 72


@dataclass(frozen=True, eq=False, kw_only=True)
class PlaneEvaluation(Evaluation):
    """A plane: `re_mm` is the range of the residuals (range error), `std_mm` their standard deviation.

    `normal` points to the sensor; positive deviations lie on that side.
    """

    kind: ClassVar[str] = "plane"

    re_mm: float
    std_mm: float
    point_mm: tuple[float, float, float]
    normal: tuple[float, float, float]

    @property
    def figures_mm(self) -> dict[str, float]:
        return {"RE": self.re_mm, "STD": self.std_mm}


@dataclass(frozen=True, eq=False, kw_only=True)
class PipeEvaluation(Evaluation):
    """A pipe: diameter and range and standard deviation of the radial residuals, positive outside.

    `ovality_mm` is the largest less the smallest diameter of the elliptic part of the residuals; None where less than
    half of the circumference was seen, because a shift of the axis would pass for ovality.
    """

    kind: ClassVar[str] = "pipe"

    diameter_mm: float
    diameter_error_mm: float
    diameter_std_mm: float
    range_mm: float
    std_mm: float
    ovality_mm: float | None
    point_mm: tuple[float, float, float]
    axis: tuple[float, float, float]

    @property
    def figures_mm(self) -> dict[str, float]:
        figures = {"diameter error": self.diameter_error_mm, "range": self.range_mm, "STD": self.std_mm}
        return figures if self.ovality_mm is None else {**figures, "ovality": self.ovality_mm}


def evaluate_plane(points: np.ndarray, artefact: PlaneStandard) -> PlaneEvaluation:
    """Range and standard deviation about the best plane of points (N, 3), mm, OCS.

    Raises
    ------
    EvaluationError
        Too few points, or a tenth of them away from the plane.
    """
    robust = _fitted(partial(fit_plane, towards=TOWARDS_SENSOR), points, artefact.kind)
    return PlaneEvaluation(
        **_account(robust),
        re_mm=spread_mm(robust.fit.residuals_mm),
        std_mm=robust.fit.std_mm,
        point_mm=tuple(robust.fit.point_mm.tolist()),
        normal=tuple(robust.fit.normal.tolist()),
    )


def evaluate_pipe(points: np.ndarray, artefact: Pipe) -> PipeEvaluation:
    """Diameter and form of the best cylinder of points (N, 3), mm, OCS.

    Raises
    ------
    EvaluationError
        Too few points, a tenth of them away from the cylinder, a patch that leaves the cylinder open, or a diameter
        that is not the artefact's within a fifth.
    """
    robust = _fitted(fit_cylinder, points, artefact.kind)
    fit = robust.fit
    error = 2 * fit.radius_mm - artefact.diameter_mm
    if abs(error) > _DIAMETER_TOLERANCE * artefact.diameter_mm:
        raise EvaluationError(
            f"the cloud holds a cylinder of {2 * fit.radius_mm:.1f} mm diameter; the artefact is described with "
            f"{artefact.diameter_mm:g} mm"
        )
    return PipeEvaluation(
        **_account(robust),
        diameter_mm=2 * fit.radius_mm,
        diameter_error_mm=error,
        diameter_std_mm=2 * float(np.sqrt(fit.covariance[4, 4])),
        range_mm=spread_mm(fit.residuals_mm),
        std_mm=fit.std_mm,
        ovality_mm=_ovality(points[robust.inliers], fit),
        point_mm=tuple(fit.point_mm.tolist()),
        axis=tuple(fit.axis.tolist()),
    )


def _fitted(fit: Callable[[np.ndarray], Any], points: np.ndarray, kind: str) -> RobustFit:
    robust = fit_robustly(fit, points)
    if robust.rejected_share > _MOST_REJECTED:
        raise EvaluationError(
            f"{robust.rejected} of {len(points)} points lie more than {robust.limit_mm:.3g} mm off the best {kind}; "
            f"the cloud holds other surfaces, cut them off"
        )
    return robust


def _account(robust: RobustFit) -> dict[str, Any]:
    return {
        "points_used": int(np.count_nonzero(robust.inliers)),
        "points_rejected": robust.rejected,
        "deviation_mm": np.where(robust.inliers, robust.distances_mm, np.nan),
    }


def _ovality(points: np.ndarray, fit: CylinderFit) -> float | None:
    """4 sqrt(a2 + b2) of the part a cos 2w + b sin 2w of the radius, solved beside a circle's shift and size."""
    across = (points - fit.point_mm) @ fit.across.T
    angle = np.arctan2(across[:, 1], across[:, 0])
    sectors = np.unique(np.floor((angle / (2 * np.pi) + 0.5) * _SECTORS).astype(int) % _SECTORS)
    if len(sectors) * 2 * np.pi / _SECTORS < _LEAST_ARC:
        return None
    waves = np.column_stack([np.ones_like(angle), np.cos(angle), np.sin(angle), np.cos(2 * angle), np.sin(2 * angle)])
    amplitude, *_ = np.linalg.lstsq(waves, fit.residuals_mm, rcond=None)
    return 4 * float(np.hypot(amplitude[3], amplitude[4]))
