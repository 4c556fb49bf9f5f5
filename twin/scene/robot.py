"""Robot arm with six joints: kinematics, and errors of joints and links."""

from typing import Literal

import numpy as np
from scipy.interpolate import CubicSpline
from scipy.optimize import least_squares
from scipy.spatial.transform import Rotation

from twin.scene.platforms import LEAD_S, PlatformMotion, Route, find_stop, interpolate_values
from twin.scene.scene_object import Pose
from uwlts.errors import DescriptionError
from uwlts.model.sensor import NotNegative, Positive, Vector

_ARC_S = 0.05
"""Time step of the joint trajectory along a path."""
_STARTS = 40
"""Number of random starts of the search for joint angles: up to 8 postures reach a pose, and some starts find none."""
_REACHED = 1e-6
"""Largest residual of a reached pose, relative to the arm's length, and in rad."""


class Robot(Route):
    """A robot arm with six joints and errors of joints and links.

    ``base`` is its pose in the scene, with z along the first joint. ``links`` are its Denavit-Hartenberg parameters
    (distal): d and a in mm, alpha in deg. Joints have zero errors of ``joint_zero_std_deg`` and a repeatability of
    ``joint_repeat_std_deg`` per position. Their gear errors of ``joint_gear_std_deg`` have two periods per motor turn,
    with ``gear_ratio`` motor turns per joint turn, as in strain-wave gears. Links have errors of ``link_std_mm`` in d
    and a. The controller reports the flange pose from nominal lengths and angles.
    """

    kind: Literal["robot"]
    base: Pose = Pose(position_mm=(-600.0, 0.0, 0.0))
    # Universal Robots UR5e, manufacturer's table "DH parameters for calculations of kinematics and dynamics".
    links: tuple[Vector, Vector, Vector, Vector, Vector, Vector] = (
        (162.5, 0.0, 90.0),
        (0.0, -425.0, 0.0),
        (0.0, -392.2, 0.0),
        (133.3, 0.0, 90.0),
        (99.7, 0.0, -90.0),
        (99.6, 0.0, 0.0),
    )
    joint_zero_std_deg: NotNegative = 0.0
    joint_repeat_std_deg: NotNegative = 0.0
    joint_gear_std_deg: NotNegative = 0.0
    gear_ratio: Positive = 101.0
    link_std_mm: NotNegative = 0.0

    def draw_motion(self, rng: np.random.Generator) -> PlatformMotion:
        times = self._knots[0]
        if not self.stops:
            times = np.linspace(-LEAD_S, times[-1] + LEAD_S, 2 + int((times[-1] + 2 * LEAD_S) / _ARC_S))
        base, links = self.base.matrix(), np.array(self.links)
        angles = _joint_angles(np.linalg.inv(base) @ self.command_poses()(times), links)
        wrong = links + self.link_std_mm * rng.standard_normal((6, 3)) * (1, 1, 0)
        zero, gear = (
            np.radians(std) * rng.standard_normal(6) for std in (self.joint_zero_std_deg, self.joint_gear_std_deg)
        )
        places = len(self._knots[0])
        repeat = np.radians(self.joint_repeat_std_deg) * rng.standard_normal((places, 6))
        phases = rng.uniform(0, 2 * np.pi, 6)

        def over_time(at: np.ndarray, values: np.ndarray, wanted: np.ndarray) -> np.ndarray:
            if self.stops:
                return values[find_stop(at, wanted)]
            return interpolate_values(at, values, wanted)

        smooth = None if self.stops else CubicSpline(times, angles)

        def joints(wanted: np.ndarray) -> np.ndarray:
            return over_time(times, angles, wanted) if smooth is None else smooth(wanted)

        def true(wanted: np.ndarray) -> np.ndarray:
            at = joints(wanted)
            errors = zero + over_time(self._knots[0], repeat, wanted) + gear * np.sin(2 * self.gear_ratio * at + phases)
            return base @ _flange(at + errors, wrong)

        return PlatformMotion(true, lambda wanted: base @ _flange(joints(wanted), links))


def _flange(angles: np.ndarray, links: np.ndarray) -> np.ndarray:
    """Return the pose (N, 4, 4) of the flange in the robot's base for joint angles (N, 6) in rad.

    Denavit and Hartenberg 1955.
    """
    pose = np.tile(np.eye(4), (len(angles), 1, 1))
    for joint, (d, a, alpha) in zip(angles.T, links, strict=True):
        c, s, ca, sa = np.cos(joint), np.sin(joint), np.cos(np.radians(alpha)), np.sin(np.radians(alpha))
        link = np.zeros((len(joint), 4, 4))
        link[:, 0] = np.stack([c, -s * ca, s * sa, a * c], axis=1)
        link[:, 1] = np.stack([s, c * ca, -c * sa, a * s], axis=1)
        link[:, 2] = (0, sa, ca, d)
        link[:, 3, 3] = 1
        pose = pose @ link
    return pose


def _joint_angles(poses: np.ndarray, links: np.ndarray) -> np.ndarray:
    """Return joint angles (N, 6) in rad that move the flange to poses (N, 4, 4) of the base.

    The angles of each pose are close to the previous ones. DescriptionError if the arm does not reach a pose.
    """
    length = float(np.abs(links[:, :2]).sum())

    def misfit(angles: np.ndarray, wanted: np.ndarray) -> np.ndarray:
        found = _flange(angles[None], links)[0]
        turn = Rotation.from_matrix(found[:3, :3] @ wanted[:3, :3].T).as_rotvec()
        return np.append((found[:3, 3] - wanted[:3, 3]) / length, turn)

    rng, found, start = np.random.default_rng(0), [], None
    for number, wanted in enumerate(poses):
        starts = rng.uniform(-np.pi, np.pi, (_STARTS, 6))
        for begin in starts if start is None else [start, *(start + 0.3 * starts)]:
            solution = least_squares(misfit, begin, args=(wanted,), method="lm", xtol=1e-12, ftol=1e-14, gtol=1e-14)
            if np.abs(solution.fun).max() < _REACHED:
                break
        else:
            place = ", ".join(f"{x:.0f}" for x in wanted[:3, 3])
            raise DescriptionError(
                f"the robot does not reach place {number + 1}, with its flange at ({place}) mm from its base: move the "
                "base, or use longer links"
            )
        start = solution.x
        found.append(start)
    return np.array(found)
