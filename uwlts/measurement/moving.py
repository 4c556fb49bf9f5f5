"""Scans by a moving platform: the sensor's poses from a mount and a trajectory, and what the mount leaves open."""

from dataclasses import replace

import numpy as np

from uwlts.calibration.joint.stored_estimate import covariance_root
from uwlts.measurement.point_uncertainty import independent_patterns
from uwlts.model.errors import CalibrationError, DescriptionError
from uwlts.model.mount import Mount
from uwlts.model.trajectory import Trajectory
from uwlts.storage.capture import Capture, FrameTable
from uwlts.storage.cloud import PointUncertainty


def platform_poses(
    capture: Capture, trajectory: Trajectory | None, *, mount: Mount | None, clock_offset_s: float | None
) -> np.ndarray:
    """``T_base_platform`` (N, 4, 4) of all images, by the trajectory at their times or as the capture holds them, mm.

    Raises
    ------
    CalibrationError
        There is no trajectory, and an image with the laser has no pose.
    DescriptionError
        Images were taken before or after the trajectory.
    """
    if trajectory is None:
        if clock_offset_s is not None:
            raise DescriptionError("an offset of the clocks was given without a trajectory")
        poses = capture.pose.copy()
        if missing := int(np.count_nonzero(capture.laser_on & ~np.isfinite(poses).all(axis=(1, 2)))):
            raise CalibrationError(
                f"{missing} of {int(capture.laser_on.sum())} laser images have no pose: a mount needs that of the "
                "platform for each. Give a trajectory, or import the images with poses"
            )
    else:
        found = mount.time_offset_s if mount is not None else None
        offset = clock_offset_s if clock_offset_s is not None else found or 0.0
        poses = np.full((len(capture.time_s), 4, 4), np.nan)
        poses[capture.laser_on] = trajectory.poses_at(capture.time_s[capture.laser_on] + offset)
    if mount is not None and mount.robot_scale is not None:
        poses[:, :3, 3] *= mount.robot_scale
    return poses


def carried(capture: Capture, poses: np.ndarray, mount: Mount | None) -> FrameTable:
    """The images of a capture with the poses of the sensor on a platform (N, 4, 4)."""
    of_sensor = poses if mount is None else poses @ mount.transform()
    return FrameTable(
        capture.header, capture.path, capture.stage_mm, capture.exposure_ms, of_sensor, capture.speed_mm_per_s
    )


def with_mount(
    uncertainty: PointUncertainty, points_mm: np.ndarray, poses: np.ndarray, mount: Mount
) -> PointUncertainty:
    """The uncertainty of points (N, 3) in the base frame with that of the mount, which moves all points together.

    A shift d and a turn w of the mount, both in the platform's frame, move a point p of the platform by
    d + w x (p - t), t being the sensor's place there. ``poses`` (N, 4, 4) are the platform's of each point. Errors of
    the poses themselves are not added.
    """
    rotations = poses[:, :3, :3]
    from_sensor = np.einsum("nji,nj->ni", rotations, points_mm - poses[:, :3, 3]) - mount.transform()[:3, 3]
    moved = []
    for shift, turn in covariance_root(np.array(mount.covariance)).T.reshape(-1, 2, 3):
        moved.append(np.einsum("nij,nj->ni", rotations, shift + np.cross(turn, from_sensor)))
    together = np.concatenate([uncertainty.patterns_mm, np.array(moved)])
    return replace(uncertainty, patterns_mm=independent_patterns(together))
