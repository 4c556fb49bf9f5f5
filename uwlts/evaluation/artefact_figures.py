"""Evaluation of clouds against spheres (VDI/VDE 2634), planes, pipes and steps; detection of spheres."""

from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from itertools import pairwise, permutations
from typing import Any, assert_never

import numpy as np

from uwlts.errors import EvaluationError
from uwlts.evaluation.figures import TOWARDS_SENSOR, ArtefactEvaluation
from uwlts.fitting.least_squares import RobustFit, fit_robustly
from uwlts.model.artefacts import Artefact, PipeStandard, PlaneStandard, SphereStandard, StepStandard
from uwlts.shapes.cylinder import Cylinder
from uwlts.shapes.flat import Plane
from uwlts.shapes.sphere import LEAST_POINTS, FoundSphere, Sphere
from uwlts.shapes.step import StepFace, label_step_faces, step_height
from uwlts.storage.cloud import PointCloud

_SAME_SIZE = 0.005
"""Difference in misfit, relative to the smallest diameter, below which two orders of spheres are equivalent."""


@dataclass(frozen=True)
class SphereResult:
    """Sphere measured by its fit of free radius, mm, OCS.

    The probing error ``pe_mm`` is the range of the radial residuals, ``std_mm`` their standard deviation.
    ``diameter_std_mm`` is the standard uncertainty by the scatter of the points alone. ``points_mixed`` counts points
    that were excluded because another surface crosses the sphere there.
    """

    centre_mm: tuple[float, float, float]
    diameter_mm: float
    diameter_error_mm: float
    diameter_std_mm: float
    pe_mm: float
    std_mm: float
    points_used: int
    points_rejected: int
    points_mixed: int


@dataclass(frozen=True)
class SpacingResult:
    """Distance of two consecutive centres, mm, with its error for fits of free and of known radius."""

    spacing_mm: float
    sse_mm: float
    sse_known_radius_mm: float
    spacing_std_mm: float


@dataclass(frozen=True, eq=False, kw_only=True)
class SphereEvaluation(ArtefactEvaluation):
    """Evaluation of spheres in the order of the artefact's description, and of their consecutive spacings."""

    artefact: SphereStandard
    spheres: tuple[SphereResult, ...]
    spacings: tuple[SpacingResult, ...]
    labels: np.ndarray  # (N,) int; number, from 0, of the sphere of each used point; -1 for others

    @property
    def pe_mm(self) -> float:
        """Probing error of the worst sphere."""
        return max(sphere.pe_mm for sphere in self.spheres)

    @property
    def std_mm(self) -> float:
        """Largest standard deviation of the radial residuals of a sphere."""
        return max(sphere.std_mm for sphere in self.spheres)

    def part_of(self, spheres: tuple[int, ...]) -> object:
        if not spheres:
            return self
        return (self.spheres if len(spheres) == 1 else self.spacings)[spheres[0] - 1]


def evaluate_spheres(points: np.ndarray, artefact: SphereStandard) -> SphereEvaluation:
    """Find the spheres in points (N, 3), mm, in the OCS, and evaluate them.

    EvaluationError for missing spheres, or for hollow spheres, which indicate rotated images.
    """
    found = _sort_spheres(_find_spheres(points, artefact, np.random.default_rng(0)), artefact)
    deviation, labels = np.full(len(points), np.nan), np.full(len(points), -1)
    spheres, fits = [], []
    for sphere, diameter in zip(found, artefact.diameters_mm, strict=True):
        members, robust = sphere.members, sphere.robust
        if artefact.cap_angle_deg is not None:
            members, robust = _fit_cap(points, sphere, artefact.cap_angle_deg)
        used, fit = members[robust.inliers], robust.fit
        if np.mean((points[used] - fit.centre_mm) @ TOWARDS_SENSOR) < 0:
            raise EvaluationError(
                "the spheres are hollow: their points are behind their centres, where the sensor cannot see them. The "
                "images may be rotated by 180 deg or mirrored relative to those of the calibration"
            )
        deviation[used], labels[used] = fit.residuals_mm, len(fits)
        fits.append((fit, Sphere.fit(points[used], diameter / 2)))
        spheres.append(
            SphereResult(
                centre_mm=tuple(fit.centre_mm.tolist()),
                diameter_mm=2 * fit.radius_mm,
                diameter_error_mm=2 * fit.radius_mm - diameter,
                diameter_std_mm=2 * float(np.sqrt(fit.covariance[3, 3])),
                pe_mm=float(np.ptp(fit.residuals_mm)),
                std_mm=fit.std_mm,
                points_used=len(used),
                points_rejected=robust.rejected,
                points_mixed=sphere.points_mixed,
            )
        )
    spacings = []
    for ((free_1, known_1), (free_2, known_2)), calibrated in zip(pairwise(fits), artefact.spacings_mm, strict=True):
        between = free_2.centre_mm - free_1.centre_mm
        spacing = float(np.linalg.norm(between))
        direction = between / spacing
        variance = direction @ (free_1.covariance + free_2.covariance)[:3, :3] @ direction
        by_known = float(np.linalg.norm(known_2.centre_mm - known_1.centre_mm)) - calibrated
        spacings.append(SpacingResult(spacing, spacing - calibrated, by_known, float(np.sqrt(variance))))
    counts = sum(each.points_used for each in spheres), sum(each.points_rejected for each in spheres)
    return SphereEvaluation(
        artefact=artefact,
        points_used=counts[0],
        points_rejected=counts[1],
        deviation_mm=deviation,
        spheres=tuple(spheres),
        spacings=tuple(spacings),
        labels=labels,
        points_excluded=sum(len(sphere.members) for sphere in found) - sum(counts),
    )


def _find_spheres(points: np.ndarray, artefact: SphereStandard, rng: np.random.Generator) -> list[FoundSphere]:
    usable = np.ones(len(points), dtype=bool)
    found: list[FoundSphere] = []
    for diameter in artefact.diameters_mm:
        sphere = Sphere.find(points, diameter / 2, usable=usable, rng=rng)
        if sphere is None:
            place = "{:.2f} mm at ({:.1f}, {:.1f}, {:.1f}) with {} points".format
            fits = [(robust.fit, len(robust.inliers) - robust.rejected) for robust in (other.robust for other in found)]
            places = ", ".join(place(2 * fit.radius_mm, *fit.centre_mm, count) for fit, count in fits)
            raise EvaluationError(
                f"{len(found)} of {len(artefact.diameters_mm)} spheres found among {len(points)} points"
                f"{places and ': ' + places}; no other surface has a diameter near {diameter:g} mm "
                f"on at least {LEAST_POINTS} points. Scan all spheres of the artefact, or correct its description"
            )
        found.append(sphere)
        usable &= ~sphere.near
    return found


def _sort_spheres(found: list[FoundSphere], artefact: SphereStandard) -> list[FoundSphere]:
    """Sort the spheres in the order of the description by sizes and spacings; equivalent orders by position."""
    centres = np.array([sphere.robust.fit.centre_mm for sphere in found])
    diameters = np.array([2 * sphere.robust.fit.radius_mm for sphere in found])
    along = int(np.ptp(centres[:, 1]) >= np.ptp(centres[:, 0]))
    orders = np.array(list(permutations(range(len(found)))))
    spacings = np.linalg.norm(np.diff(centres[orders], axis=1), axis=2)
    sizes, calibrated = np.hstack([diameters[orders], spacings]), [*artefact.diameters_mm, *artefact.spacings_mm]
    misfits = np.abs(sizes - np.array(calibrated)).max(axis=1)
    equal = np.flatnonzero(misfits <= misfits.min() + _SAME_SIZE * min(artefact.diameters_mm))
    best = max(equal, key=lambda number: centres[orders[number][-1], along] - centres[orders[number][0], along])
    return [found[position] for position in orders[best]]


def _fit_cap(points: np.ndarray, sphere: FoundSphere, cap_angle_deg: float) -> tuple[np.ndarray, RobustFit[Sphere]]:
    offset = points[sphere.members] - sphere.robust.fit.centre_mm
    cosine = offset @ TOWARDS_SENSOR / np.linalg.norm(offset, axis=1)
    members = sphere.members[cosine >= np.cos(np.radians(cap_angle_deg))]
    if len(members) < LEAST_POINTS:
        raise EvaluationError(
            f"only {len(members)} of {len(offset)} points of the sphere are within {cap_angle_deg:g} deg of the point "
            f"nearest to the sensor (-Z); {LEAST_POINTS} are needed. Increase cap_angle_deg"
        )
    return members, fit_robustly(Sphere.fit, points[members])


_MOST_REJECTED = 0.1  # largest fraction of outliers; a larger one indicates another surface
_DIAMETER_TOLERANCE = 0.2  # largest relative error of a diameter; a larger one indicates another pipe
_LEAST_ARC = np.pi  # least visible arc, rad, for the ovality
_SECTORS = 72  # number of sectors (5 deg each) for measuring the arc
_LEAST_OF_PROFILE = 5
"""Least number of points on each face for the height of a profile; noise dominates a line through fewer."""

_fit_facing_plane = partial(Plane.fit, towards=TOWARDS_SENSOR)


def evaluate_cloud(cloud: PointCloud, artefact: Artefact) -> ArtefactEvaluation:
    """Measure an artefact in a cloud and compare it with its calibrated sizes.

    EvaluationError if the cloud does not match the artefact's description.
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
    """Evaluation of a plane; `re_mm` is the range of the residuals (range error), `std_mm` their standard deviation.

    `normal` points to the sensor; deviations are positive on that side.
    """

    re_mm: float
    std_mm: float
    point_mm: tuple[float, float, float]
    normal: tuple[float, float, float]


@dataclass(frozen=True, eq=False, kw_only=True)
class PipeEvaluation(ArtefactEvaluation):
    """Evaluation of a pipe: diameter, and range and standard deviation of the radial residuals, positive outside.

    `ovality_mm` is the difference between the largest and smallest diameter of the elliptic component. It is None if
    less than half of the circumference is visible, since a shift of the axis then resembles ovality.
    """

    diameter_mm: float
    diameter_error_mm: float
    diameter_std_mm: float
    range_mm: float
    std_mm: float
    ovality_mm: float | None
    point_mm: tuple[float, float, float]
    axis: tuple[float, float, float]


def evaluate_plane(points: np.ndarray, artefact: PlaneStandard) -> PlaneEvaluation:
    """Evaluate points (N, 3), mm, in the OCS as a plane.

    EvaluationError for too few points, or more than a tenth of outliers.
    """
    robust, counts = _fit_robustly_checked(_fit_facing_plane, points, artefact.kind)
    return PlaneEvaluation(
        artefact=artefact,
        **counts,
        re_mm=float(np.ptp(robust.fit.residuals_mm)),
        std_mm=robust.fit.std_mm,
        point_mm=tuple(robust.fit.point_mm.tolist()),
        normal=tuple(robust.fit.normal.tolist()),
    )


def evaluate_pipe(points: np.ndarray, artefact: PipeStandard) -> PipeEvaluation:
    """Evaluate points (N, 3), mm, in the OCS as a pipe.

    EvaluationError for too few points, more than a tenth of outliers, an undetermined cylinder, or a diameter that
    differs from the artefact's by more than a fifth.
    """
    robust, counts = _fit_robustly_checked(Cylinder.fit, points, artefact.kind)
    fit = robust.fit
    error = 2 * fit.radius_mm - artefact.diameter_mm
    if abs(error) > _DIAMETER_TOLERANCE * artefact.diameter_mm:
        raise EvaluationError(
            f"the cloud shows a cylinder of {2 * fit.radius_mm:.1f} mm diameter; the artefact's description says "
            f"{artefact.diameter_mm:g} mm"
        )
    return PipeEvaluation(
        artefact=artefact,
        **counts,
        diameter_mm=2 * fit.radius_mm,
        diameter_error_mm=error,
        diameter_std_mm=2 * float(np.sqrt(fit.covariance[4, 4])),
        range_mm=float(np.ptp(fit.residuals_mm)),
        std_mm=fit.std_mm,
        ovality_mm=measure_ovality(points[robust.inliers], fit),
        point_mm=tuple(fit.point_mm.tolist()),
        axis=tuple(fit.axis.tolist()),
    )


def _fit_robustly_checked(
    fit: Callable[[np.ndarray], Any], points: np.ndarray, kind: str
) -> tuple[RobustFit[Any], dict[str, Any]]:
    """Fit a shape robustly; return it with the fields of its evaluation that concern the points."""
    robust = fit_robustly(fit, points)
    if robust.rejected_share > _MOST_REJECTED:
        raise EvaluationError(
            f"{robust.rejected} of {len(points)} points deviate by more than {robust.limit_mm:.3g} mm from the best "
            f"{kind}; the cloud contains other surfaces, remove them"
        )
    deviation = np.where(robust.inliers, robust.distances_mm, np.nan)
    used = len(points) - robust.rejected
    return robust, {"points_used": used, "points_rejected": robust.rejected, "deviation_mm": deviation}


def measure_ovality(points: np.ndarray, fit: Cylinder) -> float | None:
    """Return 4 sqrt(a2 + b2) of the radius component a cos 2w + b sin 2w; circle shift and size are fitted too."""
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
    """Evaluation of a step, mm. Deviations refer to the reference face's plane, shifted by the calibrated height."""

    # Mean distance of the points of one face from the plane of the other; standard uncertainty by their scatter alone.
    height_mm: float
    height_error_mm: float
    height_std_mm: float
    # Mean and standard deviation of the heights of single profiles, projected onto the normal of the faces; None
    # without a profile of both faces.
    profile_height_mm: float | None
    profile_height_error_mm: float | None
    profile_height_std_mm: float | None
    profiles: int  # number of profiles that show both faces
    # Standard deviation of each face about its own plane.
    lower_std_mm: float
    upper_std_mm: float
    parallelism_deg: float  # angle between both planes
    # Unit normal of the reference face towards the sensor, and the mean of the points of both faces.
    normal: tuple[float, float, float]
    point_mm: tuple[float, float, float]
    labels: np.ndarray  # (N,) int8; face of each point (`StepFace`)

    @property
    def std_mm(self) -> float:
        """Larger one of both standard deviations."""
        return max(self.lower_std_mm, self.upper_std_mm)


def evaluate_step(points: np.ndarray, frame: np.ndarray, artefact: StepStandard) -> StepEvaluation:
    """Evaluate points (N, 3), mm, in the OCS with images ``frame`` (N,) as a step.

    EvaluationError if the points show no two faces of this height.
    """
    labels = label_step_faces(points, height_mm=artefact.height_mm, edge_mm=artefact.edge_mm)
    rejected = 0
    for face in (StepFace.LOWER, StepFace.UPPER):
        members = np.flatnonzero(labels == face)
        robust = fit_robustly(_fit_facing_plane, points[members])
        labels[members[~robust.inliers]] = StepFace.NEITHER
        rejected += robust.rejected
    return measure_step(points, frame, labels, artefact, rejected=rejected)


def measure_step(
    points: np.ndarray, frame: np.ndarray, labels: np.ndarray, artefact: StepStandard, *, rejected: int = 0
) -> StepEvaluation:
    """Evaluate points (N, 3), mm, of a step with known faces ``labels`` (N,); EvaluationError for too few points."""
    planes: dict[StepFace, Plane] = {
        face: _fit_facing_plane(points[labels == face]) for face in (StepFace.LOWER, StepFace.UPPER)
    }
    height = step_height(points, labels, reference=artefact.reference)
    base = StepFace[artefact.reference.upper()]
    deviation = planes[base].distances_mm(points)
    deviation[labels == base.other] += artefact.height_mm * (-1 if base == StepFace.LOWER else 1)
    deviation[labels == StepFace.NEITHER] = np.nan
    heights = []
    for number in np.unique(frame[frame >= 0]):
        members = frame == number
        if min(np.count_nonzero(labels[members] == face) for face in planes) >= _LEAST_OF_PROFILE:
            heights.append(step_height(points[members, 1:], labels[members], reference=artefact.reference).height_mm)
    # The sheet is inclined to the step's normal, so a height within the sheet is divided by the cosine.
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
        normal=tuple(planes[base].normal.tolist()),
        point_mm=tuple(points[labels != StepFace.NEITHER].mean(axis=0).tolist()),
        labels=labels,
    )
