"""Platforms that carry a sensor along a path: where it truly is, what the platform reports, and the images on the way.

A platform's frame is carried by it; the sensor is mounted in it by ``T_platform_sensor``. Poses are given and reported
in the scene's frame.
"""

from abc import ABC, abstractmethod
from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property, lru_cache
from typing import Annotated, Literal

import numpy as np
from pydantic import Field, model_validator
from scipy.interpolate import Akima1DInterpolator
from scipy.spatial.transform import Rotation, RotationSpline

from twin.scene.motion import Light, Shot
from twin.scene.placed import Pose
from uwlts.errors import DescriptionError
from uwlts.model.sensor import Bracket, Description, NotNegative, Positive
from uwlts.storage.pose_files import Unit, read_trajectory

Poses = Callable[[np.ndarray], np.ndarray]
"""Poses (N, 4, 4) at times (N,) in s."""
LEAD_S = 1.0
"""A platform is on its way for so long before the first and after the last image: clocks may differ by less."""

SPOT_MM = 1e-9
"""Places closer together are the same: the rounding of numbers of some m."""


@dataclass(frozen=True, eq=False)
class Course:
    """Images on the way of a platform: where the sensor truly is, and what the platform says.

    ``poses`` gives ``T_scene_sensor``. ``reported`` (S, 4, 4) is ``T_scene_platform`` as it is stored with each of the
    S ``shots``, ``covariance`` (S, 6, 6) that which the platform states, of the shift in mm and the rotation in rad
    about the scene's axes, or None. ``report`` holds times of the platform's own clock (M,) with its poses and
    covariances then; None where it stands still at every image.
    """

    shots: tuple[Shot, ...]
    poses: Poses
    reported: np.ndarray
    covariance: np.ndarray | None
    report: tuple[np.ndarray, np.ndarray, np.ndarray | None] | None

    @cached_property
    def numbers(self) -> dict[Shot, int]:
        """Number of each shot."""
        return {shot: number for number, shot in enumerate(self.shots)}

    def twist(self, shot: Shot, *, exposure_s: float) -> tuple[np.ndarray, np.ndarray]:
        """Mean velocity (3,) in mm/s of the sensor's origin and turn (3,) in rad/s over an exposure, in the scene."""
        assert shot.time_s is not None
        half = max(exposure_s / 2, 1e-4)
        before, after = self.poses(shot.time_s + np.array([-half, half]))
        turn = Rotation.from_matrix(after[:3, :3] @ before[:3, :3].T).as_rotvec()
        return (after[:3, 3] - before[:3, 3]) / (2 * half), turn / (2 * half)


@dataclass(frozen=True, eq=False)
class Carried:
    """A platform over time: its true poses, those that it reports, and their covariances (N, 6, 6) if it knows any."""

    true: Poses
    reported: Poses
    covariance: Callable[[np.ndarray], np.ndarray] | None = None


class Platform(Description, ABC):
    """Base of motions along a path.

    ``mount`` is ``T_platform_sensor`` by the drawing, ``true_mount`` as built, the same unless given. At every place
    the images in ``lights`` are taken in turn, those with the laser at every multiple of its exposure in ``bracket``;
    a moving platform takes one image each ``1 / frame_rate_hz``, one that stops spends ``stop_s`` at every place. What
    the platform reports scatters by ``position_std_mm`` and ``rotation_std_deg`` about each axis, independently from
    report to report, and its clock is ahead of the camera's by ``clock_offset_s``. A moving platform reports at
    ``report_hz``; with ``states_covariance`` it says how well it knows its pose. ``errors_seed`` chooses all errors.
    """

    mount: Pose = Pose()
    true_mount: Pose | None = None
    lights: tuple[Literal["lamp", "laser"], ...] = ("laser",)
    bracket: Bracket = (1.0,)
    frame_rate_hz: Positive | None = None
    stop_s: Positive = 1.0
    position_std_mm: NotNegative = 0.0
    rotation_std_deg: NotNegative = 0.0
    clock_offset_s: Annotated[float, Field(gt=-LEAD_S, lt=LEAD_S)] = 0.0
    report_hz: Positive = 50.0
    states_covariance: bool = False
    errors_seed: Annotated[int, Field(ge=0)] = 0

    def moves(self) -> bool:
        """Whether the sensor moves while it exposes."""
        return not self.stops

    @property
    @abstractmethod
    def stops(self) -> bool:
        """Whether the platform stands still at every image."""

    @abstractmethod
    def places(self) -> int:
        """Number of places at which images are taken."""

    @abstractmethod
    def carried(self, rng: np.random.Generator) -> Carried:
        """The platform over time, with errors drawn from a generator."""

    @model_validator(mode="after")
    def _takes_images(self) -> "Platform":
        if not self.lights:
            raise ValueError("lights is empty: name 'lamp', 'laser' or both")
        if self.stops and self.frame_rate_hz is not None:
            raise ValueError(f"frame_rate_hz {self.frame_rate_hz:g} without a speed: give the speed, or leave it out")
        if not self.stops and self.frame_rate_hz is None:
            raise ValueError("a moving platform needs frame_rate_hz")
        if not self.stops and self.images_per_place() > 1:
            raise ValueError(
                "a moving platform takes one image at a time: name one light and no bracket, or let it stop"
            )
        return self

    def images_per_place(self) -> int:
        """Number of images taken at every place."""
        laser = self.lights.count("laser")
        return len(self.lights) + laser * (len(self.bracket) - 1)

    def images(self) -> int:
        """Number of images of the scan."""
        return self.places() * self.images_per_place()

    def shots(self) -> tuple[Shot, ...]:
        """Every image of the scan in its order."""
        return self.course().shots

    def course(self) -> Course:
        """The sensor's way, drawn with the platform's errors."""
        # Frozen descriptions are hashable.
        return _course(self)  # pyright: ignore[reportArgumentType]

    def _drawn(self) -> Course:
        rng = np.random.default_rng(self.errors_seed)
        carried, mount = self.carried(rng), (self.true_mount or self.mount).matrix()
        period_s = self.stop_s if self.frame_rate_hz is None else 1 / self.frame_rate_hz
        kinds: list[tuple[Light, float]]
        kinds = [(light, each) for light in self.lights for each in (self.bracket if light == "laser" else (1.0,))]
        # At a stop the images are spread over the time of rest.
        times = period_s / len(kinds) * (np.arange(self.images()) + (0.5 if self.stops else 0.0))

        def sensor(at_s: np.ndarray) -> np.ndarray:
            return carried.true(at_s) @ mount

        way = _way_mm(sensor(times))
        shots = tuple(
            Shot(stage_mm=0.0, travelled_mm=float(way[number]), light=light, exposure=exposure, time_s=float(time))
            for number, time in enumerate(times)
            for light, exposure in [kinds[number % len(kinds)]]
        )
        # Who takes both clocks for the same stores with an image what the platform reported at another moment.
        reported, covariance = self._said(carried, times - self.clock_offset_s, rng)
        report = None
        if not self.stops:
            own = np.arange(-LEAD_S, times[-1] + LEAD_S, 1 / self.report_hz)
            report = (own + self.clock_offset_s, *self._said(carried, own, rng))
        return Course(shots, sensor, reported, covariance, report)

    def _said(
        self, carried: Carried, times: np.ndarray, rng: np.random.Generator
    ) -> tuple[np.ndarray, np.ndarray | None]:
        """Poses that the platform reports at times of the camera's clock, and their covariances."""
        turn_std = np.radians(self.rotation_std_deg)
        shifts = self.position_std_mm * rng.standard_normal((len(times), 3))
        turns = turn_std * rng.standard_normal((len(times), 3))
        poses = displaced(carried.reported(times), np.hstack([shifts, turns]))
        if not self.states_covariance:
            return poses, None
        white = np.diag([self.position_std_mm**2] * 3 + [turn_std**2] * 3)
        drift = np.zeros((len(times), 6, 6)) if carried.covariance is None else carried.covariance(times)
        return poses, drift + white


class Route(Platform):
    """Base of platforms that follow a path of the sensor, as it is by the mount's drawing.

    ``waypoints`` are its places one after the other, or ``trajectory`` is a file of times and poses in
    ``trajectory_format`` and ``trajectory_unit`` (`uwlts.read`); a relative path starts at the scene's folder. Between
    them it follows Akima's curve (rotations a spline), at a speed of about ``speed_mm_per_s`` and at most
    ``turn_deg_per_s``. With a speed of 0 it stops at every waypoint.
    """

    waypoints: tuple[Pose, ...] = ()
    trajectory: str | None = None
    trajectory_format: str = "tum"
    trajectory_unit: Unit = "mm"
    speed_mm_per_s: NotNegative = 0.0
    turn_deg_per_s: Positive = 30.0

    @model_validator(mode="after")
    def _has_a_path(self) -> "Route":
        if bool(self.waypoints) == (self.trajectory is not None):
            raise ValueError("give either waypoints or a trajectory")
        if self.speed_mm_per_s > 0 and len(self.waypoints) < 2:
            raise ValueError("speed_mm_per_s needs two waypoints or more; a trajectory has its own times")
        return self

    @property
    def stops(self) -> bool:
        return self.trajectory is None and self.speed_mm_per_s == 0

    def places(self) -> int:
        if self.stops:
            return len(self.waypoints)
        assert self.frame_rate_hz is not None
        return 1 + int(self._knots[0][-1] * self.frame_rate_hz + 1e-9)

    @property
    def _knots(self) -> tuple[np.ndarray, np.ndarray]:
        """Times (K,), s, and ``T_scene_sensor`` (K, 4, 4) through which the path goes."""
        return _knots(self)  # pyright: ignore[reportArgumentType]

    def commanded(self) -> Poses:
        """``T_scene_platform`` by the path and the mount's drawing."""
        times, poses = self._knots
        return _path(times, poses @ np.linalg.inv(self.mount.matrix()), stops=self.stops)


class IdealPath(Route):
    """A platform without errors of its own: it is where it should be."""

    kind: Literal["path"]

    def carried(self, rng: np.random.Generator) -> Carried:
        commanded = self.commanded()
        return Carried(commanded, commanded)


# Kept beside the descriptions, not in them: arrays in them would make the comparison of equal ones fail.
@lru_cache(maxsize=8)
def _knots(route: Route) -> tuple[np.ndarray, np.ndarray]:
    if route.trajectory is not None:
        read = read_trajectory(route.trajectory, pose_format=route.trajectory_format, unit=route.trajectory_unit)
        return read.times_s - read.times_s[0], np.array(read.poses)
    poses = np.array([waypoint.matrix() for waypoint in route.waypoints])
    if route.stops:
        return route.stop_s * np.arange(len(poses)), poses
    ways = np.linalg.norm(np.diff(poses[:, :3, 3], axis=0), axis=1) / route.speed_mm_per_s
    turns = Rotation.from_matrix(poses[1:, :3, :3] @ np.swapaxes(poses[:-1, :3, :3], 1, 2)).magnitude()
    lasting = np.maximum(ways, turns / np.radians(route.turn_deg_per_s))
    if (lasting < SPOT_MM).any():
        raise DescriptionError(f"waypoint {int(np.argmin(lasting)) + 2} is at the same place as the one before")
    return np.append(0.0, np.cumsum(lasting)), poses


@lru_cache(maxsize=8)
def _course(platform: Platform) -> Course:
    return platform._drawn()


# --- geometry -------------------------------------------------------------------------------------------------------


def _path(times: np.ndarray, poses: np.ndarray, *, stops: bool) -> Poses:
    """Poses through (K, 4, 4) at times (K,): standing at each, or along splines and straight on beyond both ends."""
    if stops or len(times) == 1:
        return lambda wanted: poses[stop_at(times, wanted)]
    # Cubic pieces that do not swing beyond the points, as splines of two continuous derivatives do at tight turns.
    positions = Akima1DInterpolator(times, poses[:, :3, 3], method="makima")
    velocities = positions.derivative()
    rotations = RotationSpline(times, Rotation.from_matrix(poses[:, :3, :3]))

    def at(wanted: np.ndarray) -> np.ndarray:
        inside = np.clip(wanted, times[0], times[-1])
        beyond = (np.asarray(wanted) - inside)[:, None]
        found = np.tile(np.eye(4), (len(inside), 1, 1))
        found[:, :3, 3] = positions(inside) + beyond * velocities(inside)
        found[:, :3, :3] = (rotations(inside) * Rotation.from_rotvec(beyond * rotations(inside, 1))).as_matrix()
        return found

    return at


def displaced(poses: np.ndarray, errors: np.ndarray) -> np.ndarray:
    """Return poses (N, 4, 4) with errors (N, 6): a shift, then a turn in rad about the own place, by scene axes."""
    moved = poses.copy()
    moved[:, :3, 3] += errors[:, :3]
    moved[:, :3, :3] = Rotation.from_rotvec(errors[:, 3:]).as_matrix() @ moved[:, :3, :3]
    return moved


def interpolated(times: np.ndarray, values: np.ndarray, wanted: np.ndarray) -> np.ndarray:
    """Return values (N, K) between those (T, K) at times, linearly."""
    return np.stack([np.interp(wanted, times, column) for column in values.T], axis=1)


def stop_at(times: np.ndarray, wanted: np.ndarray) -> np.ndarray:
    """Number of the stop at times."""
    return np.clip(np.searchsorted(times, np.asarray(wanted) + 1e-9, side="right") - 1, 0, len(times) - 1)


def _way_mm(poses: np.ndarray) -> np.ndarray:
    """Length (N,) of the way of a sensor's origin to each pose: there the surface passes by the sheet."""
    steps = np.linalg.norm(np.diff(poses[:, :3, 3], axis=0), axis=1)
    return np.append(0.0, np.cumsum(steps))
