"""Scans by a moving platform: the sensor's poses from a mount and a trajectory, and what both leave open.

Errors of poses move all points of an image together. Where each pose errs by itself they are independent from image to
image. The errors of a navigation go along the path: those of a filter in its estimates before and after a step of time,
or before and after a measurement, are correlated by the root of the smaller over the larger variance (a prediction adds
independent noise; for an update Cov(e+, e-) = P+, J. A. Farrell, Aided Navigation, 2008, section 5.4), and over many
steps by the product. So the correlation of any two moments follows from the stated covariances.
"""

from dataclasses import dataclass, replace
from hashlib import sha256

import numpy as np

from uwlts.calibration.joint.stored_estimate import covariance_root
from uwlts.errors import CalibrationError, DescriptionError
from uwlts.model.mount import Mount
from uwlts.model.trajectory import Trajectory, on_clock
from uwlts.reconstruction.path_uncertainty import chief_parts, moved_by_poses, pose_roots, sampled
from uwlts.storage.capture import Capture, FrameTable
from uwlts.storage.cloud import PointUncertainty

_MOST_SHAPES = 8
"""Shapes in time of errors along a path; faster ones are taken as independent from image to image."""
_LEFT = 0.01
"""Share of the variance in time that may be left to these."""
_LEFT_OF_SHAPES = 1e-3
"""The same of all parts of the poses together."""
_MOST_MOMENTS = 400
"""By which shapes are found: they change slowly."""
_LEAST = 1e-6
"""Of the largest variance: where a path begins exactly known, nothing is correlated with it."""


@dataclass(frozen=True, eq=False)
class Ride:
    """Poses of a platform at the N images of a capture.

    ``poses`` (N, 4, 4) are ``T_base_platform``, mm, NaN for images without one. ``covariance`` (N, 6, 6), as of a
    `Trajectory`, is that of each, or None; ``times_s`` (N,) are the images'. ``rates`` (N, 6) are velocity in mm/s and
    turn in rad/s in the base frame, or None where the poses are not from a trajectory.
    """

    poses: np.ndarray
    covariance: np.ndarray | None
    times_s: np.ndarray
    rates: np.ndarray | None = None


def platform_ride(
    capture: Capture,
    trajectory: Trajectory | None,
    *,
    mount: Mount | None,
    clock_offset_s: float | None,
    clock_drift_ppm: float = 0.0,
) -> Ride:
    """Poses of the platform at all images, by the trajectory at their times or as the capture holds them.

    Raises
    ------
    CalibrationError
        There is no trajectory, and an image with the laser has no pose.
    DescriptionError
        Images were taken before or after the trajectory.
    """
    scale = 1.0 if mount is None or mount.robot_scale is None else mount.robot_scale
    if trajectory is None:
        if clock_offset_s is not None or clock_drift_ppm:
            raise DescriptionError("an offset or drift of the clocks was given without a trajectory")
        poses = capture.pose.copy()
        if missing := int(np.count_nonzero(capture.laser_on & ~np.isfinite(poses).all(axis=(1, 2)))):
            raise CalibrationError(
                f"{missing} of {int(capture.laser_on.sum())} laser images have no pose: a mount needs that of the "
                "platform for each. Give a trajectory, or import the images with poses"
            )
        poses[:, :3, 3] *= scale
        return Ride(poses, capture.pose_covariance, capture.time_s)
    found = mount.time_offset_s if mount is not None else None
    offset, laser = clock_offset_s if clock_offset_s is not None else found or 0.0, capture.laser_on
    times = on_clock(capture.time_s[laser], offset_s=offset, drift_ppm=clock_drift_ppm)
    poses, rates = np.full((len(laser), 4, 4), np.nan), np.full((len(laser), 6), np.nan)
    poses[laser], rates[laser] = trajectory.poses_at(times), trajectory.rates_at(times)
    covariance, stated = None, trajectory.covariance_at(times)
    if stated is not None:
        covariance = np.full((len(laser), 6, 6), np.nan)
        covariance[laser] = stated
    poses[:, :3, 3] *= scale
    rates[:, :3] *= scale
    return Ride(poses, covariance, capture.time_s, rates)


def carried(capture: Capture, ride: Ride, mount: Mount | None) -> FrameTable:
    """The images of a capture with the poses of the sensor on a platform."""
    header = capture.header
    if mount is not None:
        header = header.model_copy(update={"T_platform_sensor": tuple(map(tuple, mount.transform().tolist()))})
    known = capture.stage_mm, capture.exposure_ms, ride.poses, capture.speed_mm_per_s
    return FrameTable(header, capture.path, *known)


def with_platform(
    uncertainty: PointUncertainty,
    points_mm: np.ndarray,
    frame: np.ndarray,
    ride: Ride,
    mount: Mount | None,
    *,
    mount_covariance: np.ndarray | None = None,
    correlation_s: float | None = None,
) -> PointUncertainty:
    """The uncertainty of points (N, 3) of images (N,) in the base frame with those of mount, time offset and poses.

    ``mount_covariance`` (6, 6) replaces the mount's own, where ``uncertainty`` holds a part of it already.
    ``correlation_s`` is the time over which errors of poses stay alike, 0 where each errs by itself; by default 0
    without and as of a navigation filter with a trajectory. Images without a covariance have none of their pose.
    """
    levers, errors, poses_mm = points_mm - ride.poses[frame, :3, 3], [], uncertainty.poses_mm
    count, shared = len(uncertainty.patterns_mm), dict(uncertainty.shared)
    if mount is not None:
        own = np.array(mount.covariance) if mount_covariance is None else mount_covariance
        errors.append(_by_mount(ride.poses, mount.transform()[:3, 3], own))
        digest = sha256(mount.transform().tobytes() + own.tobytes()).hexdigest()[:16]
        shared[f"mount {digest}"] = np.eye(count + 6, 6, -count)
        if ride.rates is not None and mount.time_offset_std_s:
            errors.append(ride.rates[:, :, None] * mount.time_offset_std_s)
    if ride.covariance is not None:
        left = ride.covariance
        if correlation_s is None and ride.rates is None:
            correlation_s = 0.0
        if correlation_s != 0:
            of_path = _along_path(ride, np.flatnonzero(np.bincount(frame)), correlation_s)
            some = sampled(len(frame))
            parts = chief_parts(moved_by_poses(of_path, frame[some], levers[some]), left=_LEFT_OF_SHAPES)
            errors.append(of_path @ parts)
            left = left - errors[-1] @ errors[-1].transpose(0, 2, 1)
        poses_mm = moved_by_poses(pose_roots(left), frame, levers)
    if not errors:
        return replace(uncertainty, poses_mm=poses_mm)
    patterns = moved_by_poses(np.concatenate(errors, axis=2), frame, levers, after=uncertainty.patterns_mm)
    # Of what comes behind them clouds have nothing in common.
    shared = {name: np.pad(each, ((0, len(patterns) - len(each)), (0, 0))) for name, each in shared.items()}
    return replace(uncertainty, patterns_mm=patterns, poses_mm=poses_mm, shared=shared)


def _by_mount(poses: np.ndarray, place_mm: np.ndarray, covariance: np.ndarray) -> np.ndarray:
    """Errors (F, 6, 6) of poses (F, 4, 4) that are like independent parts of the mount's error.

    A shift d and a turn w of the mount, both in the platform's frame, move a point p of the platform by
    d + w x (p - t), t being the sensor's place there, ``place_mm`` (3,).
    """
    root = covariance_root(covariance)
    turns, shifts = poses[:, :3, :3] @ root[3:], poses[:, :3, :3] @ root[:3]
    return np.concatenate([shifts - np.cross(turns, (poses[:, :3, :3] @ place_mm)[:, :, None], axis=1), turns], axis=1)


def _along_path(ride: Ride, used: np.ndarray, correlation_s: float | None) -> np.ndarray:
    """Independent errors (F, 6, K) of the poses of some images (U,) along a path, by shapes in time of each part."""
    covariances, times = ride.covariance, ride.times_s
    assert covariances is not None
    some = used[sampled(len(used), _MOST_MOMENTS)]
    shapes = _shapes(_alike(covariances[some], times[some], correlation_s))
    at_images = np.stack([np.interp(times[used], times[some], shape) for shape in shapes], axis=1)
    result = np.zeros((*covariances.shape[:2], 6 * len(shapes)))
    result[used] = (pose_roots(covariances[used])[:, :, None] * at_images[:, None, :, None]).reshape(len(used), 6, -1)
    return result


def _alike(covariances: np.ndarray, times_s: np.ndarray, correlation_s: float | None) -> np.ndarray:
    """Correlation (F, F) of the errors of poses at times."""
    if correlation_s is not None:
        return np.exp(-np.abs(times_s[:, None] - times_s) / correlation_s)
    variances = np.einsum("nii->ni", np.nan_to_num(covariances))
    largest = variances.max(axis=0)
    size = (variances / np.where(largest > 0, largest, 1.0)).sum(axis=1)
    steps = np.abs(np.diff(np.log(np.maximum(size, _LEAST * size.max() or 1.0))))
    way = 0.5 * np.append(0.0, np.cumsum(steps))
    return np.exp(-np.abs(way[:, None] - way))


def _shapes(alike: np.ndarray) -> np.ndarray:
    """Shapes (K, F) in time whose squares add up to the correlations, but for what is left out."""
    values, vectors = np.linalg.eigh(alike)
    values, vectors = np.maximum(values[::-1], 0.0), vectors[:, ::-1]
    share = 1 - np.cumsum(values) / values.sum()
    count = min(1 + int(np.argmax(share <= _LEFT)), _MOST_SHAPES, len(values))
    return (vectors[:, :count] * np.sqrt(values[:count])).T
