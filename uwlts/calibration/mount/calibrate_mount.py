"""Calibrate the mount of a laser profiler on a moving platform, from its profiles of an unknown fixed artefact."""

from collections.abc import Sequence
from contextlib import suppress
from dataclasses import replace
from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

from uwlts.calibration.camera.photographs import TARGET_NAME
from uwlts.calibration.mount.captured_profiles import CapturedProfiles, mount_covariance, reconstruct_profiles
from uwlts.calibration.mount.hand_eye import mount_by_capture, mount_by_photographs
from uwlts.calibration.mount.next_pose import NextPose, next_pose, require_determined, weaknesses
from uwlts.calibration.mount.profile_evidence import (
    Motion,
    MountState,
    PlaneShape,
    Problem,
    Scatter,
    SphereShape,
    detect_again,
    from_sheet,
    thin,
    to_sheet,
)
from uwlts.calibration.mount.restricted_likelihood import (
    LARGEST_ROUGH,
    NotSettled,
    RestrictedEstimate,
    settle,
    settle_agreeing,
)
from uwlts.calibration.mount.start_values import NoFit, start
from uwlts.errors import CalibrationError, DescriptionError
from uwlts.files.reading import is_regular_file
from uwlts.model.calibration import Calibration, rigid_transform
from uwlts.model.mount import Mount, MountPose
from uwlts.model.sensor import Table, to_rows
from uwlts.model.trajectory import Trajectory
from uwlts.shapes.profile_curves import LEAST_POINTS
from uwlts.storage.calibration_file import resolve_calibration
from uwlts.storage.capture import Capture
from uwlts.storage.mount_files import SENSOR_AXES, Artefact, MountEvidence, SensorAxis, read_mount_evidence
from uwlts.storage.number_tables import Unit
from uwlts.storage.pose_files import PoseFormat, read_poses

_MOST_POINTS = 100_000
"""Points of all profiles together; more take time without lower uncertainty, as pose errors dominate."""
_NO_FIT = 0.1  # pose error divided by the sphere's radius that no platform has; a wrong pose format exceeds it
_OTHER_SIZE = 0.03
"""Relative difference from the given radius that proves another radius: scale errors of profilers are smaller."""
_SURE = 5.0  # the same in standard uncertainties (one in a million for normal errors); the larger limit applies


def calibrate_mount(
    profiles: str | Path | Sequence[np.ndarray] | CapturedProfiles,
    poses: str | Path | np.ndarray | None = None,
    *,
    artefact_kind: Artefact | None = None,
    radius_mm: float | None = None,
    calibration: Calibration | str | Path | None = None,
    pose_format: PoseFormat = "matrix",
    profile_unit: Unit | None = None,
    pose_unit: Unit | None = None,
    axis: SensorAxis | None = None,
    scale: bool = False,
    time: bool = False,
    profile_times_s: np.ndarray | None = None,
    pose_times_s: np.ndarray | None = None,
) -> Mount:
    """Calibrate the mount of a laser profiler on a robot or stage, from its profiles of a sphere or plane.

    Also calibrates the mount of a calibrated sensor, from a capture of such an artefact or of a target, or the axis of
    a rotary table. A camera without a laser is calibrated from photographs. The result is ``T_platform_sensor`` with
    its uncertainty, the rejected poses, the weakly determined directions, and the best pose to add.

    The platform's poses ``T_base_platform`` are known, for example from a robot's flange. A least-squares fit of the
    distances of all points from the artefact estimates the artefact's place and the mount together. The weights follow
    from the noise of the points, the smooth error along each profile and the scatter of the poses. Restricted maximum
    likelihood estimates these too. Background beside the artefact and poses that contradict the others are rejected.

    Parameters
    ----------
    profiles
        Folder with one CSV file (columns x and z) for each pose, or one CSV file with a column pose. A cloud whose
        frames are the poses. With a calibration: a capture of the artefact, or of a target in images with the laser
        off. A folder of photographs with target.toml, as for `uwlts.calibrate_camera`, of a camera without a laser: its
        frame is then the sensor's. Or one array for each pose in the order along the profile, mm, NaN for missing
        points: (N, 2) with x along the profile and z, or (N, 3) with x, y, z in the sensor's frame.
    poses
        CSV file with the pose of the platform in the base frame for each profile or target image, or
        ``T_base_platform`` (P, 4, 4), mm. Default: the poses of the capture.
    artefact_kind
        Artefact in the profiles: a sphere or a plane. Default: a sphere.
    radius_mm
        Radius of the sphere. Default: it is estimated.
    calibration
        Calibration of the sensor that took the capture. It is not changed; the covariance of a joint calibration is
        propagated to the mount.
    pose_format
        matrix, quaternion-xyzw, quaternion-wxyz, rotvec-rad, rotvec-deg, euler-ZYX-deg (about the moved axes),
        euler-zyx-deg (about the fixed axes) or another order, -rad for radians; angle-deg of a rotary table.
    profile_unit
        Unit of the profiles; by default that in the names of columns, else mm.
    pose_unit
        Unit of the positions; by default that in the names of columns, else mm.
    axis
        Set if the sphere or target stands on a rotary table with unknown axis. Direction in the sensor's frame nearest
        to the axis about which positive angles turn counter-clockwise. The mount then maps to a frame whose z axis is
        the axis of the table.
    scale
        Also estimate the robot's scale.
    time
        Estimate the offset to add to the profiles' times (columns time_s; the poses are a trajectory).
    profile_times_s, pose_times_s
        Times (P,) of the profiles and (M,) of the poses. The poses are then a trajectory with any number M of poses
        (`uwlts.Trajectory`).

    Returns
    -------
    Mount
        ``T_platform_sensor`` (4, 4), mm, its covariance (6, 6), the poses with reasons for rejection, and a next one.

    Raises
    ------
    DescriptionError
        Files or options cannot be read or contradict each other.
    CalibrationError
        Too few profiles show the artefact, or the motions do not determine the mount. The message names the missing
        motions.

    Examples
    --------
    >>> mount = uwlts.calibrate_mount("profiles", "poses.csv", pose_format="quaternion-wxyz", radius_mm=19.05)
    >>> mount.transform(), mount.std()
    """
    if not isinstance(poses, str | Path) and (pose_format != "matrix" or pose_unit is not None):
        raise DescriptionError("`pose_format` and `pose_unit` describe a file of poses; there is none: leave them out")
    if profile_unit is not None and (calibration is not None or not isinstance(profiles, str | Path)):
        raise DescriptionError("`profile_unit` describes files of profiles; these are in mm: leave it out")
    photographs = isinstance(profiles, str | Path) and is_regular_file(Path(profiles) / TARGET_NAME)
    if calibration is not None or photographs:
        if not isinstance(profiles, str | Path):
            raise DescriptionError("a calibration needs a capture: give the capture's path as `profiles`")
        artefact = artefact_kind or radius_mm is not None or scale or time
        table, times = poses, pose_times_s
        if isinstance(poses, str | Path):
            table, times = read_poses(poses, pose_format=pose_format, unit=pose_unit)
        assert not isinstance(table, str | Path)
        if calibration is None or photographs:
            if artefact or table is None or calibration is not None:
                raise DescriptionError("photographs of a target need poses, and nothing else but `axis`")
            return mount_by_photographs(Path(profiles), table, axis=axis)
        known = resolve_calibration(calibration)
        if not isinstance(known, Calibration):
            raise DescriptionError("a polynomial calibration cannot locate a target: give one with a camera model")
        with Capture(profiles) as capture:
            if capture.header.target is not None and not capture.laser_on.all():
                if artefact:
                    raise DescriptionError("the capture shows a target: give no artefact, radius, scale or time")
                return mount_by_capture(capture, known, table, axis=axis)
            profiles = reconstruct_profiles(capture, known, table, times)
    captured = None
    if isinstance(profiles, CapturedProfiles):
        captured, poses = profiles, profiles.poses
        profiles, profile_times_s, pose_times_s = captured.profiles, captured.times_s, captured.pose_times_s
    options: Table = {"artefact": artefact_kind or "sphere", "radius_mm": radius_mm, "scale": scale, "time": time}
    options |= {"pose_format": pose_format, "profile_unit": profile_unit, "pose_unit": pose_unit, "axis": axis}
    times_s = {"profile_times_s": profile_times_s, "pose_times_s": pose_times_s}
    evidence = read_mount_evidence(profiles, poses, options, **times_s)
    try:
        return _Calibration(evidence, captured).make_result()
    except (NoFit, NotSettled) as error:
        raise CalibrationError(f"{error}. {_make_advice(evidence)}") from error


def _make_advice(evidence: MountEvidence) -> str:
    """Return advice on the usual mistakes; a wrong radius is tested by estimating it."""
    if evidence.options.radius_mm is not None:
        unknown = evidence.options.model_copy(update={"radius_mm": None})
        with suppress(CalibrationError):
            found = _Calibration(replace(evidence, options=unknown)).make_result()
            if 2 * sum(pose.reason is None for pose in found.poses) > len(found.poses):
                return (
                    f"The profiles fit with {found.rms_mm:.3g} mm rms if the sphere has another radius, "
                    f"{found.radius_mm():.3f} mm"
                )
    return (
        "Check that the poses are T_base_platform, not their inverses T_platform_base; their format (Euler angles "
        "about moved axes, such as ZYX, or about fixed axes, such as xyz; position of w in a quaternion); the units; "
        "and that profiles and poses have the same order"
    )


class _Calibration:
    """Steps of one calibration, in the order needed by `make_result`."""

    def __init__(self, evidence: MountEvidence, captured: CapturedProfiles | None = None) -> None:
        self.evidence = evidence
        self.captured = captured
        self.shape = PlaneShape() if evidence.options.artefact == "plane" else SphereShape(evidence.options.radius_mm)
        self.rng = np.random.default_rng(0)
        most = max(_MOST_POINTS // len(evidence.profiles), 5 * LEAST_POINTS)
        self.rows = [thin(np.flatnonzero(np.isfinite(each).all(axis=1)), most) for each in evidence.profiles]
        chosen = [each[rows] for each, rows in zip(evidence.profiles, self.rows, strict=True)]
        self.profiles = [each if each.shape[1] == 3 else from_sheet(each) for each in chosen]
        self.sheet = _find_sheet_frame(self.profiles)
        self.flat = to_sheet(self.profiles, self.sheet)
        self.reasons: dict[int, str] = {}

    def make_result(self) -> Mount:
        """Return the mount with its uncertainty, rejected poses and advice."""
        try:
            return self._make_result()
        except NotSettled as error:
            # A direction that the poses do not determine may keep the estimate moving: it is the better reason.
            used = error.last.evidence
            assert isinstance(used, Problem)
            self._require_determined(used, error.last, used.free @ error.last.covariance @ used.free.T)
            raise

    def _make_result(self) -> Mount:
        shapes = [self.shape.find(points, self.rng) for points in self.flat]
        for number, shape in enumerate(shapes):
            if shape is None:
                self.reasons[number] = f"no {self.shape.kind} found in the profile"
        seen = [shape for shape in shapes if shape is not None]
        self._require_enough(len(seen))
        whole = Problem(
            self.profiles,
            _make_motion(self.evidence),
            self.sheet[:3, 1],
            self.shape,
            self.evidence.options.scale,
            self.evidence.options.time,
            self.evidence.options.axis is not None,
        )
        problem = whole.select_detected(shapes)
        towards = None if self.evidence.options.axis is None else SENSOR_AXES[self.evidence.options.axis]
        state = start(problem, seen, self.sheet, towards, self.rng)
        misfit = problem.rms_mm(state)
        noise = float(np.median([shape.std_mm for shape in seen]))
        typical = max(float(np.median(misfit)), noise, 1e-6)
        self._require_small(typical, state, len(misfit))
        good = misfit < max(LARGEST_ROUGH * float(np.median(misfit)), 5 * noise)
        scatter = Scatter(max(noise, 1e-6), typical, typical, typical, 1e-3)
        # Detect the artefact again, near the place that the other profiles give, to correct errors of the first search.
        for _ in range(2):
            found = settle(problem.select(good), [(state, np.array(scatter))])
            scatter = Scatter(*found.scatter)
            reach = 4 * float(np.hypot(np.hypot(scatter.point_mm, scatter.smooth_mm), 2 * scatter.pose_mm))
            state = found.state
            shapes = detect_again(whole, state, self.flat, reach, self.rng)
            problem = whole.select_detected(shapes)
            good = np.ones(len(problem.points), dtype=bool)
            self._require_enough(len(good))

        # Select the likelier estimate of two starts: this one, and unweighted least squares of all distances.
        starts = [(each, np.array(scatter)) for each in (state, problem.solve(state))]
        found, good = settle_agreeing(problem, starts, require=lambda good: self._require_enough(int(good.sum())))
        used, state = problem.select(good), found.state
        numbers = np.flatnonzero([shape is not None for shape in shapes])
        names = self.evidence.names
        for number in range(len(names)):
            if number in numbers[good]:
                self.reasons.pop(number, None)
            elif number in numbers:
                off = problem.rms_mm(state)[np.flatnonzero(numbers == number)[0]]
                self.reasons[number] = f"contradicts the other poses: {off:.3g} mm off"
            else:
                self.reasons.setdefault(number, f"no {self.shape.kind} found where the other poses show it")
        self._require_fit(used, found)
        points = zip(self.flat, shapes, strict=True)
        members = [np.zeros(len(profile), bool) if shape is None else shape.members for profile, shape in points]
        return self._make_mount(used, found, members)

    def _require_enough(self, usable: int) -> None:
        if usable < self.shape.fewest_poses:
            raise CalibrationError(
                f"{usable} of {len(self.profiles)} profiles show the {self.shape.kind} and agree; at least "
                f"{self.shape.fewest_poses} are needed. Record more poses, or check artefact, size and units"
            )

    def _require_small(self, wrong_mm: float, state: MountState, poses: int) -> None:
        extent = float(np.median([np.linalg.norm(np.ptp(each, axis=0)) for each in self.flat if len(each)]))
        if wrong_mm > _NO_FIT * (0.1 * extent if self.shape.flat else state.artefact[3]):
            raise NoFit(
                f"no mount fits the profiles: {poses} of {len(self.profiles)} poses would have errors of "
                f"{wrong_mm:.3g} mm (rms)"
            )

    def _require_fit(self, used: Problem, estimate: RestrictedEstimate[MountState]) -> None:
        state, scatter = estimate.state, Scatter(*estimate.scatter)
        self._require_small(float(np.hypot(scatter.pose_mm, scatter.smooth_mm)), state, len(used.points))
        if self.shape.radius_mm is None:
            return
        free = replace(used, shape=SphereShape())
        other = RestrictedEstimate(free, state, estimate.scatter)
        at = free.size - free.scale - free.time - 1
        step, std = float(other.propagate(other.residuals[:, :, None])[at, 0]), float(np.sqrt(other.covariance[at, at]))
        if abs(step) > max(_OTHER_SIZE * self.shape.radius_mm, _SURE * std):
            raise NoFit(
                f"no mount fits the profiles of a sphere of radius {self.shape.radius_mm:g} mm: the "
                f"profiles show one that differs by {step:.2g} mm (standard uncertainty "
                f"{std:.2g} mm)"
            )

    def _require_determined(
        self, used: Problem, estimate: RestrictedEstimate[MountState], covariance: np.ndarray
    ) -> tuple[list[str], NextPose | None]:
        """Return weakly determined directions and the best next pose; an error if a direction is undetermined."""
        state, scatter = estimate.state, Scatter(*estimate.scatter)
        turns = Rotation.from_matrix(used.motion(state.offset_s)[0])
        weak = weaknesses(covariance[:6, :6], turns, table=used.table)
        names = [name for number, name in enumerate(self.evidence.names) if number not in self.reasons]
        advised = next_pose(used, state, scatter, self.sheet, names)
        try:
            require_determined(covariance, weak, advised)
        except CalibrationError as error:
            # A wrong radius or format also makes the scatter large.
            wrong = float(np.hypot(scatter.pose_mm, scatter.smooth_mm))
            if self.shape.flat or wrong < 0.2 * _NO_FIT * state.artefact[3]:
                raise
            raise NoFit(f"no mount fits the profiles: the poses would have errors of {wrong:.3g} mm (rms)") from error
        return weak, advised

    def _make_mount(self, used: Problem, estimate: RestrictedEstimate[MountState], members: list[np.ndarray]) -> Mount:
        state, scatter = estimate.state, Scatter(*estimate.scatter)
        known = None if self.captured is None else self.captured.known
        covariance, share, factor = mount_covariance(
            estimate, used.free, state.rotation, known, lambda: self._differentiate_by_calibration(used, state, members)
        )
        weak, advised = self._require_determined(used, estimate, covariance)
        moved = [used.apply_step(state, step) for step, _ in estimate.without_each]
        rms, held = used.rms_mm(state), np.array([used.rms_mm(each)[place] for place, each in enumerate(moved)])
        off = zip(used.counts.tolist(), rms.tolist(), held.tolist(), strict=True)
        poses = []
        for number, (name, profile) in enumerate(zip(self.evidence.names, self.profiles, strict=True)):
            reason = self.reasons.get(number)
            count, rms_mm, without = (0, None, None) if reason else next(off)
            poses.append(
                MountPose(
                    name=name,
                    points=count,
                    points_left_out=len(profile) - count,
                    rms_mm=rms_mm,
                    held_out_mm=without,
                    reason=reason,
                )
            )
        std, at = np.sqrt(np.diag(covariance)), 6 + self.shape.count
        found = self.shape.to_stored(state.artefact, float(std[at - 1]) if self.shape.count == 4 else None)
        transform = rigid_transform(Rotation.from_matrix(state.rotation).as_matrix(), state.translation)
        weights = used.counts / used.counts.sum()
        return Mount(
            T_platform_sensor=to_rows(transform),
            covariance=to_rows(covariance[:6, :6]),
            coverage_factor=factor,
            artefact=found,
            robot_scale=state.scale if used.scale else None,
            robot_scale_std=float(std[at]) if used.scale else None,
            time_offset_s=state.offset_s if used.time else None,
            time_offset_std_s=float(std[at + used.scale]) if used.time else None,
            point_std_mm=scatter.point_mm,
            pose_std_mm=scatter.pose_mm,
            rms_mm=float(np.sqrt(weights @ rms**2)),
            held_out_rms_mm=float(np.sqrt(weights @ held**2)),
            poses=tuple(poses),
            weaknesses=tuple(weak),
            table=used.table,
            sensor=share,
            next_pose=advised,
            inputs=self.evidence.digests,
        )

    def _differentiate_by_calibration(self, used: Problem, state: MountState, members: list[np.ndarray]) -> np.ndarray:
        """Return derivatives (P, q, Q) of the residuals by the parameters of the sensor's calibration."""
        assert self.captured is not None
        numbers = [n for n in range(len(members)) if n not in self.reasons]
        by = np.vstack(
            [self.captured.point_derivatives(number, self.rows[number][members[number]]) for number in numbers]
        )
        return used.project(state, used.project_on_lines(np.einsum("ni,niq->nq", used.normals(state), by)))


def _find_sheet_frame(profiles: list[np.ndarray]) -> np.ndarray:
    """Return the frame (4, 4) of the plane of all points, with x and z in it; the identity if y is 0 everywhere."""
    points = np.vstack(profiles)
    if not points[:, 1].any():
        return np.eye(4)
    middle = points.mean(axis=0)
    extents, axes = np.linalg.svd(thin(points - middle, 20_000), full_matrices=False)[1:]
    if extents[2] > 0.02 * extents[1]:
        raise CalibrationError(
            "the profiles are not in one plane of the sensor's frame; expected points of a laser sheet, in the "
            "sensor's frame and without the motion of the platform"
        )
    return rigid_transform(np.column_stack([axes[0], np.cross(axes[1], axes[0]), axes[1]]), middle)


def _make_motion(evidence: MountEvidence) -> Motion:
    """Return a function of the time offset that gives the platform's rotations and positions at the profiles."""
    rotations, positions = evidence.poses[:, :3, :3], evidence.poses[:, :3, 3]
    if evidence.pose_times_s is None or evidence.profile_times_s is None:
        return lambda offset: (rotations, positions)
    trajectory, wanted = Trajectory(evidence.pose_times_s, evidence.poses), evidence.profile_times_s
    first, last = trajectory.times_s[[0, -1]]

    def motion(offset: float) -> tuple[np.ndarray, np.ndarray]:
        poses = trajectory.poses_at(np.clip(wanted + offset, first, last))
        return poses[:, :3, :3], poses[:, :3, 3]

    return motion
