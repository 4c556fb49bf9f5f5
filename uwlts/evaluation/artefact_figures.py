"""Evaluation of clouds against artefacts: planes, pipes and steps; spheres by `uwlts.evaluation.spheres`."""

from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from typing import Any, ClassVar, assert_never

import numpy as np

from uwlts.errors import EvaluationError
from uwlts.evaluation.figures import TOWARDS_SENSOR, ArtefactEvaluation, FigureId, Quantity, spread_mm
from uwlts.evaluation.spheres import evaluate_spheres
from uwlts.evaluation.step_faces import StepFace, label_step_faces, step_height
from uwlts.fitting.least_squares import RobustFit, fit_robustly
from uwlts.fitting.shapes import CylinderFit, FlatFit, fit_cylinder, fit_plane
from uwlts.model.artefacts import Artefact, PipeStandard, PlaneStandard, SphereStandard, StepStandard
from uwlts.storage.cloud import PointCloud

_MOST_REJECTED = 0.1
"""Share of outliers: a larger one is another surface."""
_DIAMETER_TOLERANCE = 0.2
"""Relative error of a diameter: one that differs by more is another pipe's."""
_LEAST_ARC = np.pi
"""Arc, rad, that must be seen for the ovality."""
_SECTORS = 72
"""Sectors of 5 deg, in which the arc is counted."""
_LEAST_OF_PROFILE = 5
"""Points on each face for the height of one profile; a line through fewer is uncertain by its own noise."""

_fit_facing_plane = partial(fit_plane, towards=TOWARDS_SENSOR)


def evaluate_cloud(cloud: PointCloud, artefact: Artefact) -> ArtefactEvaluation:
    """Measure the artefact in the cloud and compare it with its calibrated sizes.

    EvaluationError where the cloud does not show what the artefact's description says, with what was found.
    """
    match artefact:
        case SphereStandard():
            return evaluate_spheres(cloud.points_mm, artefact)
        case PlaneStandard():
            return evaluate_plane(cloud.points_mm, artefact)
        case StepStandard():
            return evaluate_step(cloud.points_mm, cloud.frame, artefact)
        case PipeStandard():
            return evaluate_pipe(cloud.points_mm, artefact)
        case _:
            assert_never(artefact)


@dataclass(frozen=True, eq=False, kw_only=True)
class PlaneEvaluation(ArtefactEvaluation):
    """A plane: `re_mm` is the range of the residuals (range error), `std_mm` their standard deviation.

    `normal` points to the sensor; positive deviations lie on that side.
    """

    kind: ClassVar[str] = "plane"

    re_mm: float
    std_mm: float
    point_mm: tuple[float, float, float]
    normal: tuple[float, float, float]

    def values_mm(self) -> dict[FigureId, float | None]:
        return {(Quantity.RANGE_ERROR, ()): self.re_mm, (Quantity.STD, ()): self.std_mm}


@dataclass(frozen=True, eq=False, kw_only=True)
class PipeEvaluation(ArtefactEvaluation):
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

    def values_mm(self) -> dict[FigureId, float | None]:
        return {
            (Quantity.DIAMETER_ERROR, ()): self.diameter_error_mm,
            (Quantity.RANGE, ()): self.range_mm,
            (Quantity.STD, ()): self.std_mm,
            (Quantity.OVALITY, ()): self.ovality_mm,
        }


def evaluate_plane(points: np.ndarray, artefact: PlaneStandard) -> PlaneEvaluation:
    """Range and standard deviation about the best plane of points (N, 3), mm, OCS.

    EvaluationError for too few points, or a tenth of them away from the plane.
    """
    robust, counts = _fitted(_fit_facing_plane, points, artefact.kind)
    return PlaneEvaluation(
        artefact=artefact,
        **counts,
        re_mm=spread_mm(robust.fit.residuals_mm),
        std_mm=robust.fit.std_mm,
        point_mm=tuple(robust.fit.point_mm.tolist()),
        normal=tuple(robust.fit.normal.tolist()),
    )


def evaluate_pipe(points: np.ndarray, artefact: PipeStandard) -> PipeEvaluation:
    """Diameter and form of the best cylinder of points (N, 3), mm, OCS.

    EvaluationError for too few points, a tenth of them away from the cylinder, a patch that leaves the cylinder open,
    or a diameter that is not the artefact's within a fifth.
    """
    robust, counts = _fitted(fit_cylinder, points, artefact.kind)
    fit = robust.fit
    error = 2 * fit.radius_mm - artefact.diameter_mm
    if abs(error) > _DIAMETER_TOLERANCE * artefact.diameter_mm:
        raise EvaluationError(
            f"the cloud holds a cylinder of {2 * fit.radius_mm:.1f} mm diameter; the artefact is described with "
            f"{artefact.diameter_mm:g} mm"
        )
    return PipeEvaluation(
        artefact=artefact,
        **counts,
        diameter_mm=2 * fit.radius_mm,
        diameter_error_mm=error,
        diameter_std_mm=2 * float(np.sqrt(fit.covariance[4, 4])),
        range_mm=spread_mm(fit.residuals_mm),
        std_mm=fit.std_mm,
        ovality_mm=_ovality(points[robust.inliers], fit),
        point_mm=tuple(fit.point_mm.tolist()),
        axis=tuple(fit.axis.tolist()),
    )


def _fitted(fit: Callable[[np.ndarray], Any], points: np.ndarray, kind: str) -> tuple[RobustFit[Any], dict[str, Any]]:
    """A shape fitted to nearly all points, and the fields of its evaluation that concern the points."""
    robust = fit_robustly(fit, points)
    if robust.rejected_share > _MOST_REJECTED:
        raise EvaluationError(
            f"{robust.rejected} of {len(points)} points lie more than {robust.limit_mm:.3g} mm off the best {kind}; "
            f"the cloud holds other surfaces, cut them off"
        )
    deviation = np.where(robust.inliers, robust.distances_mm, np.nan)
    used = len(points) - robust.rejected
    return robust, {"points_used": used, "points_rejected": robust.rejected, "deviation_mm": deviation}


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


@dataclass(frozen=True, eq=False, kw_only=True)
class StepEvaluation(ArtefactEvaluation):
    """A step, mm. Deviations are from the reference face's plane, and from that plane at the calibrated height.

    The height is the mean distance of one face's points to the plane through the other's, its standard uncertainty that
    by the scatter of the points alone. The height by profiles is the mean of the heights of the ``profiles`` that show
    both faces, measured within the sheet and turned to the faces' normal, with their standard deviation; None where
    there is no such profile. Standard deviations of the faces are about their own planes, between which the
    parallelism is the angle.
    """

    kind: ClassVar[str] = "step"

    height_mm: float
    height_error_mm: float
    height_std_mm: float
    profile_height_mm: float | None
    profile_height_error_mm: float | None
    profile_height_std_mm: float | None
    profiles: int
    lower_std_mm: float
    upper_std_mm: float
    parallelism_deg: float

    def values_mm(self) -> dict[FigureId, float | None]:
        return {
            (Quantity.HEIGHT_ERROR, ()): self.height_error_mm,
            (Quantity.STD, ()): max(self.lower_std_mm, self.upper_std_mm),
            (Quantity.PROFILE_HEIGHT_ERROR, ()): self.profile_height_error_mm,
        }


def evaluate_step(points: np.ndarray, frame: np.ndarray, artefact: StepStandard, *, seed: int = 0) -> StepEvaluation:
    """Find the faces in points (N, 3), mm, OCS, of the images `frame` (N,) and measure their distance.

    EvaluationError where there are no two faces at this height.
    """
    labels = label_step_faces(points, height_mm=artefact.height_mm, edge_mm=artefact.edge_mm, seed=seed)
    planes: dict[StepFace, FlatFit] = {}
    rejected = 0
    for face in (StepFace.LOWER, StepFace.UPPER):
        members = np.flatnonzero(labels == face)
        robust = fit_robustly(_fit_facing_plane, points[members])
        labels[members[~robust.inliers]] = StepFace.NEITHER
        planes[face] = robust.fit
        rejected += robust.rejected
    height = step_height(points, labels, reference=artefact.reference)
    base = StepFace[artefact.reference.upper()]
    deviation = planes[base].distances_mm(points)
    deviation[labels == base.other] += artefact.height_mm * (-1 if base == StepFace.LOWER else 1)
    deviation[labels == StepFace.NEITHER] = np.nan
    heights = []
    for number in np.unique(frame[frame >= 0]):
        own = frame == number
        if min(np.count_nonzero(labels[own] == face) for face in planes) >= _LEAST_OF_PROFILE:
            heights.append(step_height(points[own, 1:], labels[own], reference=artefact.reference).height_mm)
    # The sheet cuts the step at an angle to its normal, where it is longer by one over the cosine.
    by_profile = float(np.linalg.norm(planes[base].normal[1:])) * np.array(heights)
    mean = float(by_profile.mean()) if heights else None
    lower, upper = planes.values()
    return StepEvaluation(
        artefact=artefact,
        points_used=int(np.count_nonzero(labels)),
        points_rejected=rejected,
        deviation_mm=deviation,
        height_mm=height.height_mm,
        height_error_mm=height.height_mm - artefact.height_mm,
        height_std_mm=height.std_mm,
        profile_height_mm=mean,
        profile_height_error_mm=None if mean is None else mean - artefact.height_mm,
        profile_height_std_mm=float(by_profile.std(ddof=1)) if len(heights) > 1 else None,
        profiles=len(heights),
        lower_std_mm=lower.std_mm,
        upper_std_mm=upper.std_mm,
        parallelism_deg=float(np.degrees(np.arccos(min(1.0, abs(lower.normal @ upper.normal))))),
    )
