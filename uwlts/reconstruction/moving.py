"""Scans from a moving platform: sensor poses from a mount and a trajectory, also a corrected one, and uncertainty.

Pose errors move all points of an image together. They may be independent between images. Navigation errors, however,
are correlated along the path. A filter's errors before and after a time step or an update have a correlation. It is
the square root of the ratio of the smaller to the larger variance. A prediction adds independent noise; for an update,
Cov(e+, e-) = P+ (J. A. Farrell, Aided Navigation, 2008, section 5.4). Over many steps the correlation is the product.
The correlation of any two times therefore follows from the stated covariances.
"""

from collections.abc import Iterator
from dataclasses import dataclass, replace
from hashlib import sha256

import numpy as np
from scipy.ndimage import median_filter
from scipy.spatial.transform import Rotation

from uwlts.errors import CalibrationError, DescriptionError
from uwlts.fitting.next_observation import CovarianceRoot
from uwlts.model.mount import Mount
from uwlts.model.sensor import to_rows
from uwlts.model.trajectory import Trajectory, convert_to_platform_clock, format_time
from uwlts.runtime.compiled import compiled
from uwlts.storage.capture import Capture, FrameTable
from uwlts.storage.cloud import PointUncertainty, rotate_covariances

_MOST_SHAPES = 8
"""Largest number of temporal modes of errors along a path; faster modes count as independent between images."""
_MOST_CORRECTED = 12
"""The same along a corrected path."""
_SAMPLE = 1500
"""Number of points used to choose the modes of a correction."""
_BLOCK = 50_000  # points, to limit memory
_LEFT = 0.01
"""Largest fraction of the temporal variance outside these modes."""
_LEFT_OF_SHAPES = 1e-3
"""Largest fraction of the variance of all pose components outside the retained patterns."""
_MOST_MOMENTS = 400
"""Number of times used to compute the modes; they vary slowly."""
_LEAST = 1e-6
"""Lower bound of a variance relative to the largest one, for a path with an exact start."""
_REACH_MM = 300.0
"""Distance of the surface at which a rotation counts as a motion: the stand-off of the reference sensor."""
_SMALLEST_STEP_MM = 5e-3
"""Slower scans would take over a hundred images of each spot of the laser; positions in metres are a thousandth."""
_LARGEST_STEP_MM = 300.0
"""Scans with a profile every 300 mm show no surface; positions in mm that are read as metres are a thousandfold."""
_LEAST_COVER = 5e-3
"""Least part of a trajectory's time with images, if it also has few poses among them; times in ms give a thousandth."""
_OUTLIER, _LEAST_OUTLIER_MM = 30.0, 1.0
"""Least deviation of an outlier from its neighbours, in medians of all deviations, and in mm."""
_STEPS_OF_OUTLIER = 5.0
"""The same in steps between poses (their 90th percentile), as a platform that starts to move deviates by half."""
_STOPS, _LEAST_TURN, _LIKE = 13, np.radians(30), 0.2
"""Places along the way at which course and turn are compared, least turn, and its largest relative difference."""
_LONGEST_STEP = 10.0
"""Longest step between poses that is no gap, in medians of all steps."""
_CLOCK_STEP, _AROUND = 3.0, 7
"""Least step between times in medians, so that a missing pose is none, and number of steps for the usual speed."""
_LEAST_ACROSS = 0.1
"""Least part of the motion across the laser sheet: scans along it have no points beside each other."""


@dataclass(frozen=True, eq=False)
class PlatformPoses:
    """Poses of a platform at the N images of a capture."""

    poses: np.ndarray  # (N, 4, 4); ``T_base_platform``, mm; NaN for images without a pose
    covariance: np.ndarray | None  # (N, 6, 6); covariance of each pose, as in `Trajectory`
    times_s: np.ndarray  # (N,); times of the images
    rates: np.ndarray | None = None
    """(N, 6); velocity (mm/s) and angular velocity (rad/s) in the base frame; None without a
    trajectory."""
    doubts: tuple[str, ...] = ()  # warnings about the trajectory
    margins_s: tuple[float, float] | None = None  # of the trajectory before and after the images

    def __getitem__(self, images: np.ndarray) -> "PlatformPoses":
        """Return the poses at some images (M,)."""
        covariance, rates = (None if each is None else each[images] for each in (self.covariance, self.rates))
        return PlatformPoses(self.poses[images], covariance, self.times_s[images], rates)


@dataclass(eq=False)
class ErrorPatterns:
    """Weights of independent errors in the patterns of a cloud's parts, chosen for the first points and then kept.

    ``of_path`` are times (T,), temporal modes (K, T) and weights (6 K, C) of pose errors.
    """

    of_sensor: np.ndarray | None = None
    of_path: tuple[np.ndarray, np.ndarray, np.ndarray] | None = None


def find_platform_poses(
    capture: Capture,
    trajectory: Trajectory | None,
    *,
    mount: Mount | None,
    clock_offset_s: float | None,
    clock_drift_ppm: float = 0.0,
) -> PlatformPoses:
    """Return the poses of the platform at all images: of a trajectory, or those stored in the capture.

    A ``mount`` may state the scale of a robot's lengths. ``clock_offset_s`` is the lead of the platform's clock at the
    first laser image, by default that of the mount.

    Raises CalibrationError if there is no trajectory and a laser image has no pose; DescriptionError if images were
    taken before or after the trajectory.
    """
    scale = 1.0 if mount is None or mount.robot_scale is None else mount.robot_scale
    if trajectory is None:
        if clock_offset_s is not None or clock_drift_ppm:
            raise DescriptionError("a clock offset or drift was given without a trajectory; give the trajectory too")
        poses = capture.pose.copy()
        if missing := int(np.count_nonzero(capture.laser_on & ~np.isfinite(poses).all(axis=(1, 2)))):
            raise CalibrationError(
                f"{missing} of {int(capture.laser_on.sum())} laser images have no pose. With a mount, each needs the "
                "pose of the platform: give a trajectory, or import the images with poses"
            )
        poses[:, :3, 3] *= scale
        return PlatformPoses(poses, capture.pose_covariance, capture.time_s)
    found = mount.time_offset_s if mount is not None else None
    offset, laser = clock_offset_s if clock_offset_s is not None else found or 0.0, capture.laser_on
    times = convert_to_platform_clock(capture.time_s[laser], offset_s=offset, drift_ppm=clock_drift_ppm)
    poses, rates = np.full((len(laser), 4, 4), np.nan), np.full((len(laser), 6), np.nan)
    poses[laser], rates[laser] = trajectory.poses_at(times), trajectory.rates_at(times)
    covariance, stated = None, trajectory.covariance_at(times)
    if stated is not None:
        covariance = np.full((len(laser), 6, 6), np.nan)
        covariance[laser] = stated
    poses[:, :3, 3] *= scale
    rates[:, :3] *= scale
    transform = capture.header.T_platform_sensor if mount is None else mount.transform()
    doubts = find_trajectory_doubts(
        trajectory, times, poses[laser] if transform is None else poses[laser] @ np.array(transform)
    )
    return PlatformPoses(poses, covariance, capture.time_s, rates, tuple(doubts), trajectory.margins_s(times))


def add_platform_poses(capture: Capture, ride: PlatformPoses, mount: Mount | None) -> FrameTable:
    """Return the frames of a capture with the poses of the platform and the transform of the mount."""
    header = capture.header
    if mount is not None:
        header = header.model_copy(update={"T_platform_sensor": to_rows(mount.transform())})
    known = capture.stage_mm, capture.exposure_ms, ride.poses, capture.speed_mm_per_s
    return FrameTable(header, capture.path, *known)


def add_platform_uncertainty(
    uncertainty: PointUncertainty,
    points_mm: np.ndarray,
    frame: np.ndarray,
    ride: PlatformPoses,
    mount: Mount | None,
    *,
    mount_covariance: np.ndarray | None = None,
    correlation_s: float | None = None,
    chosen: ErrorPatterns | None = None,
) -> PointUncertainty:
    """Add the uncertainty of mount, time offset and poses to that of points (N, 3) in the base frame.

    ``mount_covariance`` (6, 6) replaces the mount's own covariance if ``uncertainty`` already contains a part of it.
    ``correlation_s`` is the correlation time of pose errors, 0 for independent errors. By default it is 0 without a
    trajectory; with a trajectory, the correlation is that of a navigation filter. Images without a covariance have no
    pose uncertainty. Parts of one cloud have the patterns ``chosen`` in common.
    """
    images, frame = np.unique(frame, return_inverse=True)
    ride = ride[images]
    levers, errors, poses_mm = points_mm - ride.poses[frame, :3, 3], [], uncertainty.poses_mm
    count, shared = len(uncertainty.patterns_mm), dict(uncertainty.shared)
    if mount is not None:
        own = np.array(mount.covariance) if mount_covariance is None else mount_covariance
        root = CovarianceRoot.from_covariance(own).root
        errors.append(_convert_mount_errors(ride.poses, mount.transform()[:3, 3], root))
        digest = sha256(mount.transform().tobytes() + own.tobytes()).hexdigest()[:16]
        shared[f"mount {digest}"] = np.eye(count + 6, 6, -count)
        if ride.rates is not None and mount.time_offset_std_s:
            by_mount, alone = mount.clock_errors(root)
            errors[0] = errors[0] + ride.rates[:, :, None] * by_mount
            errors.append(ride.rates[:, :, None] * alone)
    if ride.covariance is not None:
        left = ride.covariance
        if correlation_s is None and ride.rates is None:
            correlation_s = 0.0
        if correlation_s != 0:
            chosen = ErrorPatterns() if chosen is None else chosen
            modes = _make_path_modes(ride, correlation_s) if chosen.of_path is None else chosen.of_path[:2]
            of_path = _make_path_errors(ride, *modes)
            if chosen.of_path is None:
                some = sample_indices(len(frame))
                shifts = propagate_pose_errors(of_path, frame[some], levers[some])
                chosen.of_path = *modes, principal_components(shifts, left=_LEFT_OF_SHAPES)
            errors.append(of_path @ chosen.of_path[2])
            left = left - errors[-1] @ errors[-1].transpose(0, 2, 1)
        poses_mm = propagate_pose_errors(root_covariances(left), frame, levers)
    if not errors:
        return replace(uncertainty, poses_mm=poses_mm)
    patterns = propagate_pose_errors(np.concatenate(errors, axis=2), frame, levers, after=uncertainty.patterns_mm)
    # Clouds share none of the patterns that follow.
    shared = {name: np.pad(each, ((0, len(patterns) - len(each)), (0, 0))) for name, each in shared.items()}
    return replace(uncertainty, patterns_mm=patterns, poses_mm=poses_mm, shared=shared)


def _convert_mount_errors(poses: np.ndarray, place_mm: np.ndarray, root: np.ndarray) -> np.ndarray:
    """Return errors (F, 6, K) of poses (F, 4, 4) that are equivalent to those of the mount by components, (6, K).

    A translation d and a rotation w of the mount move a point p by d + w x (p - t), all in the platform's frame. The
    sensor's position t is ``place_mm`` (3,).
    """
    turns, shifts = poses[:, :3, :3] @ root[3:], poses[:, :3, :3] @ root[:3]
    return np.concatenate([shifts - np.cross(turns, (poses[:, :3, :3] @ place_mm)[:, :, None], axis=1), turns], axis=1)


def _make_path_modes(ride: PlatformPoses, correlation_s: float | None) -> tuple[np.ndarray, np.ndarray]:
    """Return times (T,) of a path, and the temporal modes (K, T) of the errors of its poses."""
    assert ride.covariance is not None
    some = sample_indices(len(ride.times_s), _MOST_MOMENTS)
    times = ride.times_s[some]
    return times, _find_temporal_modes(_compute_pose_correlation(ride.covariance[some], times, correlation_s))


def _make_path_errors(ride: PlatformPoses, times_s: np.ndarray, modes: np.ndarray) -> np.ndarray:
    """Return independent errors (F, 6, 6 K) of poses along a path, by temporal modes (K, T) at times (T,)."""
    assert ride.covariance is not None
    at = np.stack([np.interp(ride.times_s, times_s, mode) for mode in modes], axis=1)
    return (root_covariances(ride.covariance)[:, :, None] * at[:, None, :, None]).reshape(len(at), 6, -1)


def _compute_pose_correlation(covariances: np.ndarray, times_s: np.ndarray, correlation_s: float | None) -> np.ndarray:
    """Return the correlation (F, F) of pose errors at times (F,)."""
    if correlation_s is not None:
        return np.exp(-np.abs(times_s[:, None] - times_s) / correlation_s)
    variances = np.einsum("nii->ni", np.nan_to_num(covariances))
    largest = variances.max(axis=0)
    size = (variances / np.where(largest > 0, largest, 1.0)).sum(axis=1)
    steps = np.abs(np.diff(np.log(np.maximum(size, _LEAST * size.max() or 1.0))))
    way = 0.5 * np.append(0.0, np.cumsum(steps))
    return np.exp(-np.abs(way[:, None] - way))


def _find_temporal_modes(correlations: np.ndarray) -> np.ndarray:
    """Return temporal modes (K, F) whose outer products sum to the correlation, up to a small remainder."""
    values, vectors = np.linalg.eigh(correlations)
    values, vectors = np.maximum(values[::-1], 0.0), vectors[:, ::-1]
    share = 1 - np.cumsum(values) / values.sum()
    count = min(1 + int(np.argmax(share <= _LEFT)), _MOST_SHAPES, len(values))
    return (vectors[:, :count] * np.sqrt(values[:count])).T


def find_trajectory_doubts(trajectory: Trajectory, times_s: np.ndarray, sensor_poses: np.ndarray) -> Iterator[str]:
    """Yield warnings about a trajectory, for the poses (N, 4, 4) of the sensor at the times (N,) of N laser images."""
    if len(times_s) < 2:
        return
    known, first, last = trajectory.times_s, times_s.min(), times_s.max()
    inside = int(np.count_nonzero((known >= first) & (known <= last)))
    cover = (last - first) / (known[-1] - known[0])
    if cover < _LEAST_COVER and inside < len(times_s) / 2:
        yield (
            f"the images cover {100 * cover:.2g} % of the trajectory's time, with {inside} of its {len(known)} poses: "
            "are its times in s?"
        )
    moves, turns = np.diff(sensor_poses[:, :3, 3], axis=0), sensor_poses[:, :3, :3]
    turned = np.linalg.norm(np.diff(turns, axis=0), axis=(1, 2)) / np.sqrt(2)
    way = np.linalg.norm(moves, axis=1)
    if np.mean(way + _REACH_MM * turned) < _SMALLEST_STEP_MM:
        yield (
            f"the sensor moves by {way.sum():.3g} mm in {len(times_s)} images: does the platform stand still, or are "
            "positions in metres (`pose_unit`)?"
        )
    if way.mean() > _LARGEST_STEP_MM:
        yield f"the sensor moves by {way.mean():.4g} mm per image: are positions in mm (`pose_unit`)?"
    across = np.abs(np.einsum("ni,ni->n", moves, turns[:-1, :, 0]))
    if way.sum() > _REACH_MM * turned.sum() and across.sum() < _LEAST_ACROSS * way.sum():
        yield (
            f"{100 * across.sum() / way.sum():.2g} % of the motion is across the laser sheet: check the order of "
            "quaternions and angles, and the mount"
        )
    yield from _find_outliers(trajectory)
    yield from _find_standstill_and_gaps(trajectory, times_s)
    yield from _find_opposite_turn(trajectory)


def _find_outliers(trajectory: Trajectory) -> Iterator[str]:
    """Yield a warning about positions far from the line between their neighbours."""
    times, places = trajectory.times_s, trajectory.poses[:, :3, 3]
    if len(times) < 4:
        return
    part = ((times[1:-1] - times[:-2]) / (times[2:] - times[:-2]))[:, None]
    off = np.linalg.norm(places[1:-1] - (1 - part) * places[:-2] - part * places[2:], axis=1)
    steps = np.linalg.norm(np.diff(places, axis=0), axis=1)
    limit = max(_OUTLIER * np.median(off), _STEPS_OF_OUTLIER * np.percentile(steps, 90), _LEAST_OUTLIER_MM)
    if off[worst := int(np.argmax(off))] > limit:
        at = format_time(times[worst + 1])
        yield f"the trajectory jumps by up to {off[worst]:.4g} mm, at {at}: remove outliers, or fill the gap"


def _find_standstill_and_gaps(trajectory: Trajectory, times_s: np.ndarray) -> Iterator[str]:
    """Yield warnings about images between equal poses, and in gaps in which the trajectory moves."""
    poses, steps = trajectory.poses, np.diff(trajectory.times_s)
    before = np.clip(np.searchsorted(trajectory.times_s, times_s, side="right") - 1, 0, len(steps) - 1)
    frozen = times_s[(poses[1:] == poses[:-1]).all(axis=(1, 2))[before]]
    if len(frozen) > 1:
        yield (
            f"{len(frozen)} of {len(times_s)} images, from {format_time(frozen[0])} to {format_time(frozen[-1])}, are "
            "at times at which the trajectory repeats the same pose: did it freeze?"
        )
    moves = np.linalg.norm(np.diff(poses[:, :3, 3], axis=0), axis=1)
    # A clock that is set adds time without motion. A platform that stops is slower before and after.
    idle = (steps > _CLOCK_STEP * np.median(steps)) & (moves < 0.5 * median_filter(moves / steps, _AROUND) * steps)
    if idle.any():
        when = f"{steps[idle].max():.3g} s after {format_time(trajectory.times_s[:-1][idle][0])}"
        yield f"the times jump by {when}, but the platform moves on: was a clock set, or did the log pause?"
    gaps = (steps > _LONGEST_STEP * np.median(steps)) & (moves > np.median(moves)) & ~idle
    if gaps[before].any():
        yield (
            f"{np.count_nonzero(gaps[before])} of {len(times_s)} images are in gaps of the trajectory of up to "
            f"{steps[gaps].max():.3g} s, whose poses are {np.median(steps):.3g} s apart otherwise"
        )


def _find_opposite_turn(trajectory: Trajectory) -> Iterator[str]:
    """Yield a warning if the platform turns about the base's z axis as much as its course, in the other sense."""
    way = np.append(0, np.cumsum(np.linalg.norm(np.diff(trajectory.poses[:, :2, 3], axis=0), axis=1)))
    stops = np.searchsorted(way, np.linspace(0, way[-1], _STOPS))
    if len(np.unique(stops)) < _STOPS:
        return
    moves = np.diff(trajectory.poses[stops, :2, 3], axis=0)
    course = float(np.diff(np.unwrap(np.arctan2(moves[:, 1], moves[:, 0]))[[0, -1]])[0])
    turns = Rotation.from_matrix(trajectory.poses[stops, :3, :3])
    # From the middle of the first move to that of the last.
    about_z = (turns[1:] * turns[:-1].inv()).as_rotvec()[:, 2]
    turned = float(about_z.sum() - (about_z[0] + about_z[-1]) / 2)
    if abs(course) >= _LEAST_TURN and abs(course + turned) <= _LIKE * abs(course):
        yield (
            f"the course turns by {np.degrees(course):+.0f} deg about z, the platform by {np.degrees(turned):+.0f} "
            "deg: is yaw a compass angle, or the frame mirrored?"
        )


def propagate_pose_errors(
    errors: np.ndarray, image: np.ndarray, levers_mm: np.ndarray, *, after: np.ndarray | None = None
) -> np.ndarray:
    """Return the shifts (K, N, 3) float32 of points by K pose errors, preceded by given patterns ``after`` (M, N, 3).

    ``errors`` (F, 6, K) are translations (mm) and rotations (rad) of the poses of F images, ``image`` (N,) the image of
    each point. ``levers_mm`` (N, 3) are positions relative to the platform, along the axes of the base.
    """
    first = 0 if after is None else len(after)
    moved = np.empty((first + errors.shape[2], len(image), 3), np.float32)
    if after is not None:
        moved[:first] = after
    by_image = np.ascontiguousarray(errors.transpose(0, 2, 1), dtype=float)
    _fill_shifts(by_image, image.astype(np.int64), np.ascontiguousarray(levers_mm, dtype=float), moved[first:])
    return moved


@compiled
def _fill_shifts(errors: np.ndarray, image: np.ndarray, levers: np.ndarray, moved: np.ndarray) -> None:
    """Fill the shifts (K, N, 3) by errors (F, K, 6); points sorted by image are fastest."""
    first = 0
    while first < image.size:
        end = first + 1
        while end < image.size and image[end] == image[first]:
            end += 1
        for k in range(errors.shape[1]):
            by, out = errors[image[first], k], moved[k]
            a, b, c, u, v, w = by[0], by[1], by[2], by[3], by[4], by[5]
            for n in range(first, end):
                x, y, z = levers[n, 0], levers[n, 1], levers[n, 2]
                out[n, 0], out[n, 1], out[n, 2] = a + v * z - w * y, b + w * x - u * z, c + u * y - v * x
        first = end


def sample_indices(count: int, most: int = _SAMPLE) -> np.ndarray:
    """Return at most ``most`` evenly spaced indices below ``count``."""
    return np.linspace(0, count - 1, min(most, count)).astype(int)


def principal_components(
    moved: np.ndarray, *, left: float = 0.0, left_mm: float = 0.0, most: int | None = None
) -> np.ndarray:
    """Return weights (K, C) of the principal components of K shifts (K, N, 3).

    The number of components is the smallest that omits at most the fraction ``left`` of the variance, or ``left_mm``
    root mean square, but never more than ``most``.
    """
    flat = moved.reshape(len(moved), -1).astype(float)
    strengths, ways = np.linalg.eigh(flat @ flat.T)
    strengths, ways = np.maximum(strengths[::-1], 0.0), ways[:, ::-1]
    missing = np.append(np.cumsum(strengths[::-1])[::-1][1:], 0.0)
    count = 1 + int(np.argmax(missing <= max(left * strengths.sum(), left_mm**2 * moved.shape[1])))
    return np.ascontiguousarray(ways[:, :most][:, :count])


def root_covariances(covariances: np.ndarray) -> np.ndarray:
    """Return symmetric square roots (F, 6, 6) of covariances, which vary smoothly with them; 0 for NaN."""
    known = np.where(np.isfinite(covariances).all(axis=(1, 2), keepdims=True), covariances, 0.0)
    # Scale to unit variances, because rotations are numerically far smaller than translations.
    sizes = np.sqrt(np.maximum(np.einsum("nii->ni", known), 1e-30))
    values, vectors = np.linalg.eigh(known / (sizes[:, :, None] * sizes[:, None]))
    root = (vectors * np.sqrt(np.maximum(values, 0.0))[:, None]) @ np.swapaxes(vectors, 1, 2)
    return sizes[:, :, None] * root


def correct_path_uncertainty(
    known: PointUncertainty,
    turns: np.ndarray,
    levers_mm: np.ndarray,
    image: np.ndarray,
    basis: np.ndarray,
    covariance: np.ndarray,
    poses: np.ndarray,
) -> PointUncertainty:
    """Return the uncertainty of N points after a correction of the path, which replaces that of the navigation.

    Noise and the patterns of sensor and mount calibration (``shared`` of ``known``) are kept and rotated by ``turns``
    (N, 3) in rad. All other patterns come from the navigation and are dropped. ``levers_mm`` (N, 3) are positions
    relative to the platform after the correction. ``basis`` (F, C) holds the weights of the C nodes at the F images.
    ``covariance`` (6 C, 6 C) is that of the correction at the nodes, translation (mm) and rotation (rad) about the
    platform. ``poses`` (F, 6, 6) are covariances of the corrected poses; the part beyond that of the nodes is
    independent between images.
    """
    values, vectors = np.linalg.eigh(covariance)
    root = (vectors * np.sqrt(np.maximum(values, 0.0))).reshape(-1, 6, len(values))

    some = sample_indices(len(image))
    by_pose = np.einsum("nc,cik->kni", basis[image[some]], root, optimize=True)
    by_pose = by_pose[:, :, :3] + np.cross(by_pose[:, :, 3:], levers_mm[some])
    shapes = np.einsum(
        "fc,cik->fik", basis, root @ principal_components(by_pose, left=_LEFT, most=_MOST_CORRECTED), optimize=True
    )
    rest = root_covariances(poses - shapes @ shapes.transpose(0, 2, 1))
    # Compress the patterns to those that contain parts of sensor and mount.
    names = list(known.shared)
    parts = np.vstack([known.shared[name].T for name in names]) if names else np.zeros((0, len(known.patterns_mm)))
    factors, sizes, rows = np.linalg.svd(parts, full_matrices=False)
    kept = sizes > 1e-6
    mixing, factors = sizes[kept, None] * rows[kept], factors[:, kept]
    random, position = np.empty_like(known.random_mm2), np.empty_like(known.position_mm)
    kept_patterns = np.empty((len(mixing), len(image), 3), np.float32)
    for start in range(0, len(image), _BLOCK):
        here = slice(start, start + _BLOCK)
        matrices = Rotation.from_rotvec(turns[here]).as_matrix()
        random[here] = rotate_covariances(known.random_mm2[here], matrices)
        position[here] = np.einsum("nij,nj->ni", matrices, known.position_mm[here])
        kept_patterns[:, here] = np.einsum(
            "nij,knj->kni", matrices, np.tensordot(mixing, known.patterns_mm[:, here], axes=1)
        )
    patterns = propagate_pose_errors(shapes, image, levers_mm, after=kept_patterns)
    shared, first = {}, 0
    for name in names:
        last = first + known.shared[name].shape[1]
        shared[name] = np.vstack([factors[first:last].T, np.zeros((shapes.shape[2], last - first))])
        first = last
    return PointUncertainty(random, position, patterns, propagate_pose_errors(rest, image, levers_mm), shared)
