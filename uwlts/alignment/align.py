"""Self-consistency of a scan along a path: a correction of the path, by surfaces that it shows more than once.

`path_prior` is the prior of the correction, `stated_drift` reads its size and kind from the trajectory, `path_estimate`
finds the correction and `crossing_search` the crossings.
"""

from __future__ import annotations

import os
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

from uwlts.alignment.crossing_search import SIGMAS, close_crossings, complete
from uwlts.alignment.path_estimate import Pair, PathEstimate
from uwlts.alignment.path_prior import USUAL_DRIFT, DriftKind, PathSpline
from uwlts.alignment.stated_drift import stated_drift
from uwlts.errors import EvaluationError
from uwlts.files.json_files import write_record
from uwlts.fitting.patches import scatter
from uwlts.model.brief import Brief
from uwlts.model.sensor import Table
from uwlts.model.trajectory import Trajectory, on_clock
from uwlts.reconstruction.path_uncertainty import along_corrected_path
from uwlts.runtime.progress import ProgressListener, unheard
from uwlts.storage.cloud import PointCloud
from uwlts.storage.cloud_files import loaded_cloud
from uwlts.storage.pose_files import PoseFormat, Unit, read_trajectory

_ROUGH = DriftKind(smooth=0.0, wandering=0.3, walk=0.3, turn_walk=0.3)
"""Kind of drift that is assumed in the search where the stated or usual one finds no crossing: fewer false crossings
fit a stiffer path."""


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
        Standard uncertainty that the navigation has gathered at the end, along each axis. Of which kind the drift is, a
        steady or changing rate or a random walk, is estimated then. Unless given the covariance of the trajectory tells
        both, and what of the kind the surfaces strongly contradict is estimated.
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
        Points have no times, the drift is not known, or the path shows no surface twice that tells where it is.
    """
    cloud = loaded_cloud(cloud)
    if not isinstance(trajectory, Trajectory):
        trajectory = read_trajectory(Path(trajectory), pose_format=pose_format, unit=pose_unit)
    if cloud.time_s is None:
        raise EvaluationError("the cloud has no times of its points: reconstruct it with a trajectory")
    times = on_clock(cloud.time_s, offset_s=clock_offset_s, drift_ppm=clock_drift_ppm)
    drift = stated_drift(trajectory, drift_mm, drift_deg)
    path = PathSpline.of(trajectory, drift.size, drift.measured, times)
    left_out: tuple[tuple[float, float], ...] = ()
    for turn, kind in enumerate((drift.kind or USUAL_DRIFT, _ROUGH)):
        estimate = PathEstimate(cloud, times, path, kind, stated=drift.kind)

        def searched(done: int, total: int, stage: str = "", turn: int = turn) -> None:
            progress(turn * total + done, (turn + 1) * total)

        doubtful = close_crossings(estimate, searched)
        if estimate.pairs:
            estimate.settle()
            complete(estimate, len(estimate.pieces))
            estimate.average()
        left_out = tuple(_times(estimate, pair) for pair in doubtful if pair not in estimate.pairs)
        if estimate.pairs:
            return _result(estimate, trajectory, times, left_out)
    at = "".join(f"; at {first:.1f} s and {second:.1f} s it fits in several places" for first, second in left_out)
    raise EvaluationError(
        f"the path shows no surface twice, within {SIGMAS:g} standard deviations of its drift, that tells where "
        f"it is{at}: cross an earlier part of the path over a surface with features"
    )


def _result(
    estimate: PathEstimate, trajectory: Trajectory, times: np.ndarray, doubtful: tuple[tuple[float, float], ...]
) -> AlignedTrajectory:
    cloud = estimate.cloud
    correction = estimate.corrections(trajectory.times_s)
    poses = trajectory.poses.copy()
    poses[:, :3, :3] = Rotation.from_rotvec(correction[:, 3:]).as_matrix() @ poses[:, :3, :3]
    poses[:, :3, 3] += correction[:, :3]
    covariance = estimate.covariance_at(trajectory.times_s)
    moments, image = np.unique(times, return_inverse=True)
    by_point = estimate.corrections(moments)[image]
    platform = trajectory.poses_at(moments)[image, :3, 3]
    levers = Rotation.from_rotvec(by_point[:, 3:]).apply(cloud.points_mm - platform)
    known = cloud.uncertainty
    if known is not None:
        at_image, by_image = estimate.path.basis(moments), estimate.covariance_at(moments)
        known = along_corrected_path(known, by_point[:, 3:], levers, image, at_image, estimate.covariance, by_image)
    return AlignedTrajectory(
        Trajectory(trajectory.times_s, poses, covariance),
        correction,
        tuple(_crossing(estimate, pair) for pair in estimate.pairs),
        doubtful,
        replace(cloud, points_mm=levers + platform + by_point[:, :3], uncertainty=known),
    )


def _crossing(estimate: PathEstimate, pair: Pair) -> Crossing:
    now = estimate.matched(pair)[0]
    held = estimate.held_out(pair, now)
    # The same patches, as they lay by the path as it was.
    shift = np.zeros_like(now.places_mm)
    for number, rows, sign in zip(pair, (now.target, now.source), (-1.0, 1.0), strict=True):
        shift += sign * (estimate.moved(number).places_mm - estimate.pieces[number].places_mm)[rows]
    before = now.distance_mm - np.einsum("qi,qi->q", shift, now.normals)
    inside = np.abs(now.distance_mm) < 5 * now.std_mm * scatter(now.distance_mm / now.std_mm)

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
