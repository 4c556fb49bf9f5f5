"""Step standard: distance of its treads in a whole scan and in each of its profiles."""

from dataclasses import dataclass
from functools import partial
from typing import ClassVar

import numpy as np

from uwlts.metrology.artefact_descriptions import StepStandard
from uwlts.metrology.evaluation import TOWARDS_SENSOR, Evaluation
from uwlts.metrology.flat_fits import PlaneFit, fit_plane
from uwlts.metrology.robust_fit import RobustFit, fit_robustly
from uwlts.metrology.treads import Tread, label_treads, step_height_of_profile, step_height_of_scan

_LEAST_OF_PROFILE = 5


@dataclass(frozen=True, eq=False, kw_only=True)
class StepEvaluation(Evaluation):
    """A step, mm. Deviations are from the reference tread's plane, and from that plane at the calibrated height.

    Attributes
    ----------
    height_mm, height_error_mm, height_std_mm : float
        Mean distance of one tread's points to the plane through the other's; its standard uncertainty from the
        scatter of the points alone.
    profile_height_mm, profile_height_error_mm, profile_height_std_mm : float or None
        Mean and standard deviation of the heights of the single profiles, measured within the sheet and turned to
        the treads' normal; None where no profile shows both treads.
    profiles : int
        Profiles that show both treads.
    lower_std_mm, upper_std_mm : float
        Standard deviations about each tread's own plane.
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

    @property
    def figures_mm(self) -> dict[str, float]:
        figures = {"height error": self.height_error_mm, "STD": max(self.lower_std_mm, self.upper_std_mm)}
        if self.profile_height_error_mm is not None:
            figures["profile height error"] = self.profile_height_error_mm
        return figures


def evaluate_step(points: np.ndarray, frame: np.ndarray, artefact: StepStandard, *, seed: int = 0) -> StepEvaluation:
    """Find the treads in points (N, 3), mm, OCS, of the images `frame` (N,) and measure their distance.

    Raises
    ------
    EvaluationError
        No two treads at this height.
    """
    labels = label_treads(points, height_mm=artefact.height_mm, edge_mm=artefact.edge_mm, seed=seed)
    lower, upper = (_tread(points, labels, tread) for tread in (Tread.LOWER, Tread.UPPER))
    height = step_height_of_scan(points, labels, reference=artefact.reference)
    base, direction = (lower, 1.0) if artefact.reference == "lower" else (upper, -1.0)
    other = Tread.UPPER if artefact.reference == "lower" else Tread.LOWER
    # The sheet cuts the step at an angle to its normal, where it is longer by one over the cosine.
    cosine_of_sheet = float(np.linalg.norm(base.fit.normal[1:]))
    by_profile = cosine_of_sheet * _heights_by_profile(points, frame, labels, artefact.reference)
    deviation = base.fit.distances_mm(points)
    deviation[labels == other] -= direction * artefact.height_mm
    deviation[labels == Tread.NEITHER] = np.nan
    cosine = min(1.0, float(abs(lower.fit.normal @ upper.fit.normal)))
    mean = float(by_profile.mean()) if len(by_profile) else None
    return StepEvaluation(
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


def _tread(points: np.ndarray, labels: np.ndarray, tread: Tread) -> RobustFit[PlaneFit]:
    """The plane of one tread; its stray points lose their label."""
    members = np.flatnonzero(labels == tread)
    robust = fit_robustly(partial(fit_plane, towards=TOWARDS_SENSOR), points[members])
    labels[members[~robust.inliers]] = Tread.NEITHER
    return robust


def _heights_by_profile(points: np.ndarray, frame: np.ndarray, labels: np.ndarray, reference: str) -> np.ndarray:
    heights = []
    for number in np.unique(frame[frame >= 0]):
        profile = frame == number
        counts = [np.count_nonzero(labels[profile] == tread) for tread in (Tread.LOWER, Tread.UPPER)]
        if min(counts) >= _LEAST_OF_PROFILE:
            height = step_height_of_profile(points[profile, 1:], labels[profile], reference=reference)
            heights.append(height.height_mm)
    return np.array(heights)
