"""Doubts about a trajectory at the images of a scan: units, clocks, outliers, standstill and direction."""

from collections.abc import Iterator

import numpy as np
from scipy.spatial.transform import Rotation

from uwlts.model.trajectory import Trajectory, format_time

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
_LEAST_ACROSS = 0.1
"""Least part of the motion across the laser sheet: scans along it have no points beside each other."""


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
    gaps = (steps > _LONGEST_STEP * np.median(steps)) & (moves > np.median(moves))
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
