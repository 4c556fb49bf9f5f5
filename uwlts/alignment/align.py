"""Trajectory correction from surfaces that a scan shows more than once.

`path_prior` describes the drift of the navigation and converts it into a prior of the correction. `crossing_search`
finds the crossings, and `path_solution` the correction that they determine.
"""

from __future__ import annotations

import os
from dataclasses import asdict, dataclass, replace
from pathlib import Path

import numpy as np
from scipy.linalg import eigh
from scipy.spatial.transform import Rotation

from uwlts.alignment.crossing_search import Search, accept_crossings
from uwlts.alignment.path_prior import PathPrior, choose_drift_model
from uwlts.alignment.path_solution import Pair, PathEstimate, initial_estimate, settle
from uwlts.alignment.pieces import AlignmentOptions, Survey
from uwlts.argument_types import check_arguments
from uwlts.errors import EvaluationError
from uwlts.files.json_files import write_record
from uwlts.fitting.least_squares import noise_factor
from uwlts.model.sensor import Table
from uwlts.model.short_text import Brief
from uwlts.model.trajectory import Trajectory, convert_to_platform_clock
from uwlts.reconstruction.moving import correct_path_uncertainty
from uwlts.runtime.progress import ProgressListener, ignore_progress
from uwlts.storage.cloud import PointCloud
from uwlts.storage.cloud_files import load_cloud
from uwlts.storage.number_tables import Unit
from uwlts.storage.pose_files import PoseFormat, read_trajectory


@dataclass(frozen=True)
class Crossing:
    """Crossing of the path, where it shows a surface again.

    Attributes
    ----------
    times_s : (float, float)
        Times of both passes.
    patches : int
        Number of agreeing patches used by the estimate.
    before_mm, after_mm : float
        Root-mean-square distance of these patches along the original and the corrected path.
    held_out_before_mm, held_out_after_mm : float
        The same for patches that the estimate does not use.
    missed_mm : float
        Relative position error of the navigation between both passes.
    """

    times_s: tuple[float, float]
    patches: int
    before_mm: float
    after_mm: float
    held_out_before_mm: float
    held_out_after_mm: float
    missed_mm: float


@dataclass(frozen=True, eq=False, repr=False)
class AlignedTrajectory(Brief):
    """Trajectory corrected to agree with the scanned surfaces.

    Attributes
    ----------
    trajectory : Trajectory
        Corrected poses at the given times, with the covariance of each.
    correction : (N, 6) float64
        Translation (mm) and rotation vector (rad) of each pose.
    crossings : tuple of Crossing
    doubtful_s : tuple of (float, float)
        Times of both passes of ambiguous crossings, which were not used: several positions within the drift fit.
    margins_s : (float, float)
        How long the trajectory starts before the first point and ends after the last.
    cloud : PointCloud
        Cloud along the corrected path. Its uncertainty combines that of the corrected path with that of the
        calibrations of sensor and mount.
    """

    trajectory: Trajectory
    correction: np.ndarray
    crossings: tuple[Crossing, ...]
    doubtful_s: tuple[tuple[float, float], ...]
    margins_s: tuple[float, float]
    cloud: PointCloud

    def record(self) -> Table:
        """Return crossings and size of the correction as JSON."""
        shift, turn = (np.linalg.norm(part, axis=1) for part in (self.correction[:, :3], self.correction[:, 3:]))
        return {
            "largest_shift_mm": float(shift.max()),
            "largest_turn_deg": float(np.degrees(turn.max())),
            "crossings": [asdict(each) for each in self.crossings],
            "doubtful_s": [list(each) for each in self.doubtful_s],
            "margins_s": list(self.margins_s),
        }

    @check_arguments
    def save(self, path: str | Path, *, overwrite: bool = False) -> None:
        """Write the corrected trajectory as CSV with covariances, and the crossings as JSON beside it."""
        self.trajectory.save(path, overwrite=overwrite)
        write_record(Path(path).with_suffix(".json"), self.record(), overwrite=overwrite)

    def lines(self) -> list[str]:
        """Return a summary as text."""
        known = self.record()
        lines = [
            f"path corrected by up to {known['largest_shift_mm']:.3f} mm and {known['largest_turn_deg']:.4f} deg, "
            f"{len(self.crossings)} crossings",
            "points from {:.3f} s after the start to {:.3f} s before the end of the trajectory".format(*self.margins_s),
        ]
        for each in self.crossings:
            first, second = each.times_s
            lines.append(
                f"  {first:.1f} s and {second:.1f} s: {each.patches} patches, missed by {each.missed_mm:.2f} mm; rms "
                f"{each.before_mm:.3f} to {each.after_mm:.4f} mm, held out {each.held_out_before_mm:.3f} to "
                f"{each.held_out_after_mm:.4f} mm"
            )
        for first, second in self.doubtful_s:
            lines.append(f"  {first:.1f} s and {second:.1f} s: not used, the surface fits in several positions")
        return lines


def align_trajectory(
    cloud: PointCloud | str | os.PathLike[str],
    trajectory: Trajectory | str | os.PathLike[str],
    *,
    pose_format: PoseFormat = "quaternion-xyzw",
    pose_unit: Unit | None = None,
    clock_offset_s: float = 0.0,
    clock_drift_ppm: float = 0.0,
    drift_mm: float | None = None,
    drift_deg: float | None = None,
    progress: ProgressListener = ignore_progress,
) -> AlignedTrajectory:
    """Correct a trajectory so that surfaces scanned twice agree, and move the cloud accordingly.

    Reconstruct the scan along the corrected trajectory afterwards: its points then have the remaining uncertainty.

    Parameters
    ----------
    cloud
        Cloud along the trajectory with the time of each point (uwlts reconstruct --trajectory).
    trajectory
        CSV file or ROS bag with times and poses of the platform, the same as for the reconstruction.
    pose_format, pose_unit
        As for `reconstruct`.
    clock_offset_s
        Offset from the times of the points to those of the trajectory.
    clock_drift_ppm
        Rate difference of the trajectory's clock, positive if it runs faster, as for `reconstruct`.
    drift_mm
        Standard uncertainty of the navigation's position at the end of the path, along each axis. The fraction of a
        random walk is then estimated. By default the covariance of the trajectory states both.
    drift_deg
        Standard uncertainty of the navigation's rotation at the end of the path, about each axis.
    progress
        Called with the number of steps done and the total number.

    Returns
    -------
    AlignedTrajectory
        Corrected trajectory with its covariance, the cloud along it, and the crossings.

    Raises
    ------
    CaptureError
        The file cannot be read.
    DescriptionError
        Points were measured before or after the trajectory.
    EvaluationError
        Points have no times, the drift is unknown, or no crossing determines the correction.
    """
    cloud = load_cloud(cloud)
    if not isinstance(trajectory, Trajectory):
        trajectory = read_trajectory(Path(trajectory), pose_format=pose_format, unit=pose_unit)
    if cloud.time_s is None:
        raise EvaluationError("the cloud has no times of its points: reconstruct it with a trajectory")
    times = convert_to_platform_clock(cloud.time_s, offset_s=clock_offset_s, drift_ppm=clock_drift_ppm)
    drift = choose_drift_model(trajectory, drift_mm, drift_deg)
    options = AlignmentOptions()
    prior = PathPrior.from_times(times, drift, trajectory, intervals=options.intervals)
    search = accept_crossings(initial_estimate(Survey.from_cloud(cloud, times, trajectory), prior, options), progress)
    estimate = settle(search.estimate) if search.estimate.pairs else search.estimate
    left_out = tuple(_pair_times(estimate, pair) for pair in search.doubtful)
    if not estimate.pairs:
        raise EvaluationError(_explain_no_crossing(search, left_out))
    _require_gain(estimate)
    return _make_result(estimate, trajectory, left_out)


def _explain_no_crossing(search: Search, left_out: tuple[tuple[float, float], ...]) -> str:
    """Explain why no crossing was accepted, and what to do."""
    within = f"within {search.estimate.options.search_sigmas:g} standard deviations of its drift"
    if not search.within_reach:
        found = f"no part of it is {within} above an earlier part. Let the path cross itself, or state a larger drift"
    elif left_out:
        at = ", ".join(f"{first:.1f} s and {second:.1f} s" for first, second in left_out)
        found = f"at {at}, the surface fits in several positions. Cross over a surface with distinct features"
    elif not search.hypotheses:
        found = f"no surfaces coincide {within}. Cross over a surface with features, or state a larger drift"
    else:
        found = (
            f"{search.hypotheses} positions {within} fit roughly, but none within the noise of the points. Cross over "
            "a surface with features, with a smaller spacing of the images"
        )
    return f"no crossing of the path determines its correction: {found}"


def _require_gain(estimate: PathEstimate) -> None:
    """Raise EvaluationError unless some crossing reduces the position uncertainty by the factor ``least_gain``."""
    navigation = replace(estimate, factor=np.eye(len(estimate.factor)))
    for pair in estimate.pairs:
        middle = estimate.surface(pair[1]).places_mm.mean(axis=0)
        after, before = (each.relative_covariance(pair, middle)[:3, :3] for each in (estimate, navigation))
        if eigh(after, before, eigvals_only=True)[0] < 1 / estimate.options.least_gain**2:
            return
    raise EvaluationError(
        f"the {len(estimate.pairs)} crossings do not determine a correction: the navigation is about as accurate as "
        "they are. Use the trajectory without correction"
    )


def _make_result(
    estimate: PathEstimate, trajectory: Trajectory, doubtful: tuple[tuple[float, float], ...]
) -> AlignedTrajectory:
    cloud = estimate.survey.cloud
    correction = estimate.corrections(trajectory.times_s)
    poses = trajectory.poses.copy()
    poses[:, :3, :3] = Rotation.from_rotvec(correction[:, 3:]).as_matrix() @ poses[:, :3, :3]
    poses[:, :3, 3] += correction[:, :3]
    covariance = estimate.covariance_at(trajectory.times_s)
    survey, image = estimate.survey, estimate.survey.image
    by_point, platform = estimate.image_corrections[image], survey.platform_mm[image]
    levers = Rotation.from_rotvec(by_point[:, 3:]).apply(cloud.points_mm - platform)
    known = cloud.uncertainty
    if known is not None:
        basis, by_image = estimate.prior.basis(survey.moments_s), estimate.covariance_at(survey.moments_s)
        of_nodes = estimate.covariance.reshape(6, -1, 6, estimate.prior.count).transpose(1, 0, 3, 2)
        of_nodes = of_nodes.reshape(estimate.covariance.shape)
        known = correct_path_uncertainty(known, by_point[:, 3:], levers, image, basis, of_nodes, by_image)
    return AlignedTrajectory(
        Trajectory(trajectory.times_s, poses, covariance),
        correction,
        tuple(_make_crossing(estimate, pair) for pair in estimate.pairs),
        doubtful,
        trajectory.margins_s(estimate.survey.moments_s),
        replace(cloud, points_mm=levers + platform + by_point[:, :3], uncertainty=known),
    )


def _make_crossing(estimate: PathEstimate, pair: Pair) -> Crossing:
    now, held = estimate.measure_distances(pair)
    # Distances of the same patches along the original path.
    shift = np.zeros_like(now.places_mm)
    for number, rows, sign in zip(pair, (now.target, now.source), (-1.0, 1.0), strict=True):
        shift += sign * (estimate.surface(number).places_mm - estimate.pieces[number].places_mm)[rows]
    before = now.distance_mm - np.einsum("qi,qi->q", shift, now.normals)
    inside = np.abs(now.distance_mm) < estimate.options.agreeing_sigmas * now.std_mm * noise_factor(
        now.distance_mm / now.std_mm
    )

    def rms(values: np.ndarray, which: np.ndarray) -> float:
        return float(np.sqrt(np.mean(values[which] ** 2))) if which.any() else 0.0

    return Crossing(
        times_s=_pair_times(estimate, pair),
        patches=int(np.count_nonzero(inside & ~held)),
        before_mm=rms(before, inside & ~held),
        after_mm=rms(now.distance_mm, inside & ~held),
        held_out_before_mm=rms(before, inside & held),
        held_out_after_mm=rms(now.distance_mm, inside & held),
        missed_mm=float(np.linalg.norm(np.median(shift, axis=0))),
    )


def _pair_times(estimate: PathEstimate, pair: Pair) -> tuple[float, float]:
    """Return the times of both passes, s."""
    earlier, later = (estimate.pieces[number].middle_s for number in pair)
    return earlier, later
