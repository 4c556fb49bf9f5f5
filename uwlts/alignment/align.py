"""Self-consistency of a scan along a path: a correction of the path, by surfaces that it shows more than once.

`drift_model` describes how the navigation drifts, `path_prior` makes it the prior of the correction, `crossing_search`
finds the crossings, and `path_estimate` the correction by them.
"""

from __future__ import annotations

import os
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from scipy.linalg import eigh
from scipy.spatial.transform import Rotation

from uwlts.alignment.crossing_search import Search, close_crossings
from uwlts.alignment.drift_model import drift_of
from uwlts.alignment.options import AlignmentOptions
from uwlts.alignment.path_estimate import Pair, PathEstimate
from uwlts.alignment.path_prior import PathPrior
from uwlts.alignment.path_solution import settle, uncorrected
from uwlts.alignment.pieces import Survey
from uwlts.errors import EvaluationError
from uwlts.files.json_files import write_record
from uwlts.fitting.least_squares import noise_factor
from uwlts.model.brief import Brief
from uwlts.model.sensor import Table
from uwlts.model.trajectory import Trajectory, on_clock
from uwlts.reconstruction.path_uncertainty import along_corrected_path
from uwlts.runtime.progress import ProgressListener, unheard
from uwlts.storage.cloud import PointCloud
from uwlts.storage.cloud_files import loaded_cloud
from uwlts.storage.pose_files import PoseFormat, Unit, read_trajectory


@dataclass(frozen=True)
class Crossing:
    """Where a path shows a surface again: times of both passes, patches, and distances in mm.

    ``before_mm`` and ``after_mm`` are root mean square distances of the patches near each other by the path as it was
    and as it is. ``held_out_before_mm`` and ``held_out_after_mm`` are of patches that the estimate has not used.
    ``missed_mm`` is the shift by which the navigation missed here.
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
    """A path that agrees with the surfaces that it shows.

    Attributes
    ----------
    trajectory : Trajectory
        Corrected poses at the times of the given ones, with the covariance of each.
    correction : (N, 6) float64
        Shift (mm) and turn (rad) that each pose was given.
    crossings : tuple of Crossing
    doubtful_s : tuple of (float, float)
        Times of both passes where the surface fits in several places as well as the drift allows: left out.
    cloud : PointCloud
        The cloud along the corrected path. Its uncertainty is that of the corrected path, and what the given cloud's
        holds of the calibrations of sensor and mount.
    """

    trajectory: Trajectory
    correction: np.ndarray
    crossings: tuple[Crossing, ...]
    doubtful_s: tuple[tuple[float, float], ...]
    cloud: PointCloud

    def record(self) -> Table:
        """Crossings and size of the correction as JSON."""
        shift, turn = (np.linalg.norm(part, axis=1) for part in (self.correction[:, :3], self.correction[:, 3:]))
        return {
            "largest_shift_mm": float(shift.max()),
            "largest_turn_deg": float(np.degrees(turn.max())),
            "crossings": [
                {name: list(value) if isinstance(value, tuple) else value for name, value in vars(each).items()}
                for each in self.crossings
            ],
            "doubtful_s": [list(each) for each in self.doubtful_s],
        }

    def save(self, path: str | Path, *, overwrite: bool = False) -> None:
        """Write the corrected trajectory as CSV with covariances, and the crossings as JSON beside it."""
        self.trajectory.save(path, overwrite=overwrite)
        write_record(Path(path).with_suffix(".json"), self.record(), overwrite=overwrite)

    def lines(self) -> list[str]:
        """The summary as text."""
        known = self.record()
        lines = [
            f"path corrected by up to {known['largest_shift_mm']:.3f} mm and {known['largest_turn_deg']:.4f} deg, "
            f"{len(self.crossings)} crossings"
        ]
        for each in self.crossings:
            first, second = each.times_s
            lines.append(
                f"  {first:.1f} s and {second:.1f} s: {each.patches} patches, missed by {each.missed_mm:.2f} mm; rms "
                f"{each.before_mm:.3f} to {each.after_mm:.4f} mm, held out {each.held_out_before_mm:.3f} to "
                f"{each.held_out_after_mm:.4f} mm"
            )
        for first, second in self.doubtful_s:
            lines.append(f"  {first:.1f} s and {second:.1f} s: left out, the surface fits in several places")
        return lines


def align_trajectory(
    cloud: PointCloud | str | os.PathLike[str],
    trajectory: Trajectory | str | os.PathLike[str],
    *,
    pose_format: PoseFormat = "quaternion-xyzw",
    pose_unit: Unit = "mm",
    clock_offset_s: float = 0.0,
    clock_drift_ppm: float = 0.0,
    drift_mm: float | None = None,
    drift_deg: float | None = None,
    progress: ProgressListener = unheard,
) -> AlignedTrajectory:
    """Correct a trajectory so that surfaces which the scan shows twice agree, and move the cloud with it.

    Reconstruct the scan along the corrected trajectory afterwards: its points then have the uncertainty that is left.

    Parameters
    ----------
    cloud
        Cloud along the trajectory with the time of each point (uwlts reconstruct --trajectory).
    trajectory
        CSV file or ROS bag with times and poses of the platform, as the cloud was reconstructed with.
    pose_format, pose_unit
        As for `reconstruct`.
    clock_offset_s
        What to add to the times of the points for those of the trajectory.
    clock_drift_ppm
        By how many parts in a million the trajectory's clock runs faster, as for `reconstruct`.
    drift_mm
        Standard uncertainty that the navigation has gathered at the end, along each axis. The share of a random walk is
        estimated then. Unless given the covariance of the trajectory states both.
    drift_deg
        The same of its turns.
    progress
        Called with the number of steps done and the number in all.

    Raises
    ------
    CaptureError
        The file cannot be read.
    DescriptionError
        Points were measured before or after the trajectory.
    EvaluationError
        Points have no times, the drift is not known, or no crossing determines the correction.
    """
    cloud = loaded_cloud(cloud)
    if not isinstance(trajectory, Trajectory):
        trajectory = read_trajectory(Path(trajectory), pose_format=pose_format, unit=pose_unit)
    if cloud.time_s is None:
        raise EvaluationError("the cloud has no times of its points: reconstruct it with a trajectory")
    times = on_clock(cloud.time_s, offset_s=clock_offset_s, drift_ppm=clock_drift_ppm)
    drift = drift_of(trajectory, drift_mm, drift_deg)
    options = AlignmentOptions()
    prior = PathPrior.over(times, drift, trajectory, intervals=options.intervals)
    search = close_crossings(uncorrected(Survey.along(cloud, times, trajectory), prior, options), progress)
    estimate = settle(search.estimate) if search.estimate.pairs else search.estimate
    left_out = tuple(_times(estimate, pair) for pair in search.doubtful)
    if not estimate.pairs:
        raise EvaluationError(_no_crossing(search, left_out))
    _require_gain(estimate)
    return _result(estimate, trajectory, left_out)


def _no_crossing(search: Search, left_out: tuple[tuple[float, float], ...]) -> str:
    """The reason why no crossing was closed, and what to do."""
    within = f"within {search.estimate.options.search_sigmas:g} standard deviations of its drift"
    if not search.within_reach:
        found = f"no part of the path is {within} above an earlier one: let it cross itself, or state a larger drift"
    elif left_out:
        at = ", ".join(f"{first:.1f} s and {second:.1f} s" for first, second in left_out)
        found = f"at {at} it fits in several places: cross over a surface with features that differ"
    elif not search.hypotheses:
        found = f"the surfaces coincide nowhere {within}: cross over a surface with features, or state a larger drift"
    else:
        found = (
            f"{search.hypotheses} places {within} fit roughly, none within the noise of the points: cross at a smaller "
            "distance of the images, over a surface with features"
        )
    return f"the path shows no surface twice that determines its correction; {found}"


def _require_gain(estimate: PathEstimate) -> None:
    """EvaluationError unless a shift at a crossing is known ``least_gain`` times as well as by the navigation."""
    navigation = replace(estimate, factor=np.eye(len(estimate.factor)))
    for pair in estimate.pairs:
        middle = estimate.surfaces[pair[1]].places_mm.mean(axis=0)
        after, before = (each.relative_covariance(pair, middle)[:3, :3] for each in (estimate, navigation))
        if eigh(after, before, eigvals_only=True)[0] < 1 / estimate.options.least_gain**2:
            return
    raise EvaluationError(
        f"the {len(estimate.pairs)} crossings do not determine a correction: the navigation is known about as well as "
        "they are; use the trajectory as it is"
    )


def _result(
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
        known = along_corrected_path(known, by_point[:, 3:], levers, image, basis, of_nodes, by_image)
    return AlignedTrajectory(
        Trajectory(trajectory.times_s, poses, covariance),
        correction,
        tuple(_crossing(estimate, pair) for pair in estimate.pairs),
        doubtful,
        replace(cloud, points_mm=levers + platform + by_point[:, :3], uncertainty=known),
    )


def _crossing(estimate: PathEstimate, pair: Pair) -> Crossing:
    now, held = estimate.compared(pair)
    # The same patches, as they lay by the path as it was.
    shift = np.zeros_like(now.places_mm)
    for number, rows, sign in zip(pair, (now.target, now.source), (-1.0, 1.0), strict=True):
        shift += sign * (estimate.surfaces[number].places_mm - estimate.pieces[number].places_mm)[rows]
    before = now.distance_mm - np.einsum("qi,qi->q", shift, now.normals)
    inside = np.abs(now.distance_mm) < estimate.options.agreeing_sigmas * now.std_mm * noise_factor(
        now.distance_mm / now.std_mm
    )

    def rms(values: np.ndarray, which: np.ndarray) -> float:
        return float(np.sqrt(np.mean(values[which] ** 2))) if which.any() else 0.0

    return Crossing(
        times_s=_times(estimate, pair),
        patches=int(np.count_nonzero(inside & ~held)),
        before_mm=rms(before, inside & ~held),
        after_mm=rms(now.distance_mm, inside & ~held),
        held_out_before_mm=rms(before, inside & held),
        held_out_after_mm=rms(now.distance_mm, inside & held),
        missed_mm=float(np.linalg.norm(np.median(shift, axis=0))),
    )


def _times(estimate: PathEstimate, pair: Pair) -> tuple[float, float]:
    """Times of both passes, s."""
    earlier, later = (estimate.pieces[number].middle_s for number in pair)
    return earlier, later
