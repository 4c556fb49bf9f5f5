"""Evaluation of clouds against artefacts: planes, pipes and steps; spheres by `uwlts.metrology.spheres`."""

from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from typing import Any, ClassVar, Literal, assert_never

import numpy as np

from uwlts.metrology.evaluation import TOWARDS_SENSOR, ArtefactEvaluation, FigureId, Quantity, spread_mm
from uwlts.metrology.flat_fits import PlaneFit, fit_plane
from uwlts.metrology.least_squares import RobustFit, fit_robustly
from uwlts.metrology.round_fits import CylinderFit, fit_cylinder
from uwlts.metrology.spheres import evaluate_spheres
from uwlts.metrology.step_faces import StepFace, label_step_faces, step_height
from uwlts.model.artefacts import Artefact, Pipe, PlaneStandard, SphereStandard, StepStandard
from uwlts.model.errors import EvaluationError
from uwlts.storage.cloud import PointCloud

# A larger share of outliers is another surface; a diameter that differs by more is another pipe.
_MOST_REJECTED, _DIAMETER_TOLERANCE = 0.1, 0.2
# Arc in rad that must be seen for the ovality, counted in sectors of 5 deg.
_LEAST_ARC, _SECTORS = np.pi, 72
# Points on each face for the height of one profile; a line through fewer is uncertain by its own noise.
_LEAST_OF_PROFILE = 5


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
        case Pipe():
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
    robust = _fitted(partial(fit_plane, towards=TOWARDS_SENSOR), points, artefact.kind)
    return PlaneEvaluation(
        artefact=artefact,
        **_point_counts(robust),
        re_mm=spread_mm(robust.fit.residuals_mm),
        std_mm=robust.fit.std_mm,
        point_mm=tuple(robust.fit.point_mm.tolist()),
        normal=tuple(robust.fit.normal.tolist()),
    )


def evaluate_pipe(points: np.ndarray, artefact: Pipe) -> PipeEvaluation:
    """Diameter and form of the best cylinder of points (N, 3), mm, OCS.

    EvaluationError for too few points, a tenth of them away from the cylinder, a patch that leaves the cylinder open,
    or a diameter that is not the artefact's within a fifth.
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
        artefact=artefact,
        **_point_counts(robust),
        diameter_mm=2 * fit.radius_mm,
        diameter_error_mm=error,
        diameter_std_mm=2 * float(np.sqrt(fit.covariance[4, 4])),
        range_mm=spread_mm(fit.residuals_mm),
        std_mm=fit.std_mm,
        ovality_mm=_ovality(points[robust.inliers], fit),
        point_mm=tuple(fit.point_mm.tolist()),
        axis=tuple(fit.axis.tolist()),
    )


def _fitted(fit: Callable[[np.ndarray], Any], points: np.ndarray, kind: str) -> RobustFit[Any]:
    robust = fit_robustly(fit, points)
    if robust.rejected_share > _MOST_REJECTED:
        raise EvaluationError(
            f"{robust.rejected} of {len(points)} points lie more than {robust.limit_mm:.3g} mm off the best {kind}; "
            f"the cloud holds other surfaces, cut them off"
        )
    return robust


def _point_counts(robust: RobustFit[Any]) -> dict[str, Any]:
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


@dataclass(frozen=True, eq=False, kw_only=True)
class StepEvaluation(ArtefactEvaluation):
    """A step, mm. Deviations are from the reference face's plane, and from that plane at the calibrated height.

    Attributes
    ----------
    height_mm, height_error_mm, height_std_mm : float
        Mean distance of one face's points to the plane through the other's; its standard uncertainty from the
        scatter of the points alone.
    profile_height_mm, profile_height_error_mm, profile_height_std_mm : float or None
        Mean and standard deviation of the heights of the single profiles, measured within the sheet and turned to
        the faces' normal; None where no profile shows both faces.
    profiles : int
        Profiles that show both faces.
    lower_std_mm, upper_std_mm : float
        Standard deviations about each face's own plane.
    parallelism_deg : float
        Angle between the two planes.
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
    lower, upper = (_step_face(points, labels, face) for face in (StepFace.LOWER, StepFace.UPPER))
    height = step_height(points, labels, reference=artefact.reference)
    base, direction = (lower, 1.0) if artefact.reference == "lower" else (upper, -1.0)
    other = StepFace.UPPER if artefact.reference == "lower" else StepFace.LOWER
    # The sheet cuts the step at an angle to its normal, where it is longer by one over the cosine.
    cosine_of_sheet = float(np.linalg.norm(base.fit.normal[1:]))
    by_profile = cosine_of_sheet * _heights_by_profile(points, frame, labels, artefact.reference)
    deviation = base.fit.distances_mm(points)
    deviation[labels == other] -= direction * artefact.height_mm
    deviation[labels == StepFace.NEITHER] = np.nan
    cosine = min(1.0, float(abs(lower.fit.normal @ upper.fit.normal)))
    mean = float(by_profile.mean()) if len(by_profile) else None
    return StepEvaluation(
        artefact=artefact,
        points_used=int(np.count_nonzero(labels)),
        points_rejected=lower.rejected + upper.rejected,
        deviation_mm=deviation,
        height_mm=height.height_mm,
        height_error_mm=height.height_mm - artefact.height_mm,
        height_std_mm=height.std_mm,
        profile_height_mm=mean,
        profile_height_error_mm=None if mean is None else mean - artefact.height_mm,
        profile_height_std_mm=float(by_profile.std(ddof=1)) if len(by_profile) > 1 else None,
        profiles=len(by_profile),
        lower_std_mm=lower.fit.std_mm,
        upper_std_mm=upper.fit.std_mm,
        parallelism_deg=float(np.degrees(np.arccos(cosine))),
    )


def _step_face(points: np.ndarray, labels: np.ndarray, face: StepFace) -> RobustFit[PlaneFit]:
    """The plane of one face; its outliers lose their label."""
    members = np.flatnonzero(labels == face)
    robust = fit_robustly(partial(fit_plane, towards=TOWARDS_SENSOR), points[members])
    labels[members[~robust.inliers]] = StepFace.NEITHER
    return robust


def _heights_by_profile(
    points: np.ndarray, frame: np.ndarray, labels: np.ndarray, reference: Literal["lower", "upper"]
) -> np.ndarray:
    heights = []
    for number in np.unique(frame[frame >= 0]):
        profile = frame == number
        counts = [np.count_nonzero(labels[profile] == face) for face in (StepFace.LOWER, StepFace.UPPER)]
        if min(counts) >= _LEAST_OF_PROFILE:
            height = step_height(points[profile, 1:], labels[profile], reference=reference)
            heights.append(height.height_mm)
    return np.array(heights)
