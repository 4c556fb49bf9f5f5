"""Motion of a sensor in a scene: linear stage, and platforms with true and reported poses along a path.

The sensor is mounted on the platform with the pose ``T_platform_sensor``. Poses are given and reported in the scene.
"""

from abc import ABC, abstractmethod
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from functools import cached_property, lru_cache
from typing import Annotated, Literal

import numpy as np
from pydantic import Field, model_validator
from scipy.interpolate import Akima1DInterpolator
from scipy.spatial.transform import Rotation, RotationSpline

from twin.scene.scene_object import Pose
from uwlts.errors import DescriptionError
from uwlts.model.sensor import Bracket, Description, NotNegative, Positive, Vector
from uwlts.storage.number_tables import Unit
from uwlts.storage.pose_files import read_trajectory

Light = Literal["lamp", "laser", "day"]


class Motion(Description):
    """Steps of a linear stage that moves the sensor: ``count`` positions from ``start_mm`` in steps of ``step_mm``.

    ``direction`` is the true direction of travel; the capture records ``nominal_direction``. At every position, the
    images in ``lights`` are taken in turn, those with the laser at every exposure factor in ``bracket``.
    ``position_errors_mm`` is the true minus the recorded position (default: 0). ``speed_mm_per_s`` is the speed of the
    stage along ``direction`` during an exposure, 0 if it stops.
    """

    start_mm: float = 0.0
    step_mm: float = 1.0
    count: Annotated[int, Field(ge=1, le=100000)] = 1
    direction: Vector = (1.0, 0.0, 0.0)
    nominal_direction: Vector | None = None
    position_errors_mm: tuple[float, ...] = ()
    lights: tuple[Literal["lamp", "laser"], ...] = ("laser",)
    bracket: Bracket = (1.0,)
    speed_mm_per_s: NotNegative = 0.0

    @model_validator(mode="after")
    def _check_direction(self) -> "Motion":
        for vector in (self.direction, self.nominal_direction):
            if vector is not None and np.linalg.norm(vector) < 1e-9:
                raise ValueError(f"direction {vector} has no length")
        if self.position_errors_mm and len(self.position_errors_mm) != self.count:
            raise ValueError(f"position_errors_mm has {len(self.position_errors_mm)} values for {self.count} positions")
        if not self.lights:
            raise ValueError("lights is empty: name 'lamp', 'laser' or both")
        if self.speed_mm_per_s > 0 and self.images() > self.count:
            raise ValueError(
                "a moving stage takes one image at each position: name one light and no bracket, or stop with speed 0"
            )
        return self

    def unit_direction(self) -> np.ndarray:
        """Return the true unit direction (3,) of the sensor's travel in the scene."""
        return np.array(self.direction) / np.linalg.norm(self.direction)

    def recorded_direction(self) -> tuple[float, float, float]:
        """Return the unit direction that the capture records."""
        vector = np.array(self.nominal_direction or self.direction)
        x, y, z = (vector / np.linalg.norm(vector)).tolist()
        return x, y, z

    def shots(self) -> Iterator["Shot"]:
        """Yield all images of the scan in order."""
        for index in range(self.count):
            stage_mm = self.start_mm + index * self.step_mm
            error = self.position_errors_mm[index] if self.position_errors_mm else 0.0
            for light, exposure in _list_exposures(self):
                yield Shot(stage_mm=stage_mm, travelled_mm=stage_mm + error, light=light, exposure=exposure)

    def moves(self) -> bool:
        """Return whether the sensor moves during exposures."""
        return self.speed_mm_per_s > 0

    def stage_speed_mm_s(self) -> float:
        """Return the speed of the stage along its positions during an exposure."""
        return self.speed_mm_per_s * (1 if self.step_mm >= 0 else -1)

    def images(self) -> int:
        """Return the number of images of the scan."""
        return self.count * len(_list_exposures(self))

    def pose(self, shot: "Shot") -> np.ndarray:
        """Return ``T_scene_object`` (4, 4) of the sensor's OCS at a shot, in the middle of its exposure."""
        transform = np.eye(4)
        transform[:3, 3] = shot.travelled_mm * self.unit_direction()
        return transform

    def twist(self, _shot: "Shot", *, exposure_s: float) -> tuple[np.ndarray, np.ndarray]:
        """Return velocity (3,) of the sensor in mm/s and rotation rate (3,) in rad/s, which is 0 on a stage."""
        return self.stage_speed_mm_s() * self.unit_direction(), np.zeros(3)


@dataclass(frozen=True)
class Shot:
    """One image to take.

    ``stage_mm`` and ``travelled_mm`` are the recorded and the true position of the stage; on other platforms,
    ``travelled_mm`` is the path length of the sensor and ``time_s`` the time since the first image. ``light`` is on in
    addition to daylight; ``exposure`` multiplies the exposure time.
    """

    stage_mm: float
    travelled_mm: float
    light: Light
    exposure: float = 1.0
    time_s: float | None = None


def _list_exposures(motion: "Motion | Platform") -> list[tuple[Light, float]]:
    """Return light and exposure factor of the images at each position."""
    return [(light, each) for light in motion.lights for each in (motion.bracket if light == "laser" else (1.0,))]


Poses = Callable[[np.ndarray], np.ndarray]  # poses (N, 4, 4) at times (N,) in s
LEAD_S = 1.0  # a platform moves for this time before the first and after the last image; clock offsets must be smaller

SPOT_MM = 1e-9  # positions closer together are identical: above the rounding error of coordinates of some metres


@dataclass(frozen=True, eq=False)
class Course:
    """Images along the path of a platform, with true and reported poses.

    ``poses`` returns ``T_scene_sensor``. ``reported`` (S, 4, 4) is ``T_scene_platform`` as stored with each of the S
    shots. ``covariance`` (S, 6, 6), if the platform states it, is that of displacement in mm and rotation in rad about
    the scene's axes. ``report`` contains times (M,) of the platform's own clock with poses and covariances; None if it
    stops for each image.
    """

    shots: tuple[Shot, ...]
    poses: Poses
    reported: np.ndarray
    covariance: np.ndarray | None
    report: tuple[np.ndarray, np.ndarray, np.ndarray | None] | None

    @cached_property
    def numbers(self) -> dict[Shot, int]:
        """Index of each shot."""
        return {shot: number for number, shot in enumerate(self.shots)}


@dataclass(frozen=True, eq=False)
class PlatformMotion:
    """Motion of a platform: true poses, reported poses, and covariances (N, 6, 6) if it states them."""

    true: Poses
    reported: Poses
    covariance: Callable[[np.ndarray], np.ndarray] | None = None


class Platform(Description, ABC):
    """Base of motions along a path.

    ``mount`` is the nominal ``T_platform_sensor``, ``true_mount`` the actual one (default: the same). At every
    position, the images in ``lights`` are taken in turn, those with the laser at every exposure factor in ``bracket``.
    A moving platform takes one image every ``1 / frame_rate_hz``; one that stops spends ``stop_s`` at every position.

    Reported poses have independent noise of ``position_std_mm`` and ``rotation_std_deg`` about each axis. The
    platform's clock is ahead of the camera's by ``clock_offset_s``. A moving platform reports at ``report_hz``; with
    ``states_covariance`` it also reports covariances. ``errors_seed`` is the seed of all errors.
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

    @abstractmethod
    def moves(self) -> bool:
        """Return whether the sensor moves during exposures; else the platform stops for each image."""

    @abstractmethod
    def places(self) -> int:
        """Return the number of image positions."""

    @abstractmethod
    def draw_motion(self, rng: np.random.Generator) -> PlatformMotion:
        """Return the motion of the platform, with errors drawn from a generator."""

    @model_validator(mode="after")
    def _check_images(self) -> "Platform":
        if not self.lights:
            raise ValueError("lights is empty: name 'lamp', 'laser' or both")
        if not self.moves() and self.frame_rate_hz is not None:
            raise ValueError(f"frame_rate_hz {self.frame_rate_hz:g} without a speed: give the speed, or omit the rate")
        if self.moves() and self.frame_rate_hz is None:
            raise ValueError("a moving platform needs frame_rate_hz")
        if self.moves() and len(_list_exposures(self)) > 1:
            raise ValueError(
                "a moving platform takes one image at a time: name one light and no bracket, or let it stop"
            )
        return self

    def images(self) -> int:
        """Return the number of images of the scan."""
        return self.places() * len(_list_exposures(self))

    def shots(self) -> tuple[Shot, ...]:
        """Return all images of the scan in order."""
        return self.course().shots

    def stage_speed_mm_s(self) -> float:
        """Return the speed of a stage: 0, as a platform has none."""
        return 0.0

    def pose(self, shot: Shot) -> np.ndarray:
        """Return ``T_scene_object`` (4, 4) of the sensor's OCS at a shot, in the middle of its exposure."""
        assert shot.time_s is not None
        return self.course().poses(np.array([shot.time_s]))[0]

    def twist(self, shot: Shot, *, exposure_s: float) -> tuple[np.ndarray, np.ndarray]:
        """Return the mean velocity (3,) of the sensor in mm/s and its rotation rate (3,) in rad/s in an exposure."""
        assert shot.time_s is not None
        half = max(exposure_s / 2, 1e-4)
        before, after = self.course().poses(shot.time_s + np.array([-half, half]))
        turn = Rotation.from_matrix(after[:3, :3] @ before[:3, :3].T).as_rotvec()
        return (after[:3, 3] - before[:3, 3]) / (2 * half), turn / (2 * half)

    def course(self) -> Course:
        """Return the path of the sensor, drawn with the platform's errors."""
        # Frozen descriptions are hashable.
        return _course(self)  # pyright: ignore[reportArgumentType]

    def _draw_course(self) -> Course:
        rng = np.random.default_rng(self.errors_seed)
        motion, mount = self.draw_motion(rng), (self.true_mount or self.mount).matrix()
        period_s = self.stop_s if self.frame_rate_hz is None else 1 / self.frame_rate_hz
        kinds = _list_exposures(self)
        # Images at a stop are spread over its duration.
        times = period_s / len(kinds) * (np.arange(self.images()) + (0.0 if self.moves() else 0.5))

        def sensor(at_s: np.ndarray) -> np.ndarray:
            return motion.true(at_s) @ mount

        steps = np.linalg.norm(np.diff(sensor(times)[:, :3, 3], axis=0), axis=1)
        way = np.append(0.0, np.cumsum(steps))
        shots = tuple(
            Shot(stage_mm=0.0, travelled_mm=float(way[number]), light=light, exposure=exposure, time_s=float(time))
            for number, time in enumerate(times)
            for light, exposure in [kinds[number % len(kinds)]]
        )
        # Images are stored with the pose reported at the same reading of both clocks, despite their offset.
        reported, covariance = self._report_poses(motion, times - self.clock_offset_s, rng)
        report = None
        if self.moves():
            times_s = np.arange(-LEAD_S, times[-1] + LEAD_S, 1 / self.report_hz)
            report = (times_s + self.clock_offset_s, *self._report_poses(motion, times_s, rng))
        return Course(shots, sensor, reported, covariance, report)

    def _report_poses(
        self, motion: PlatformMotion, times: np.ndarray, rng: np.random.Generator
    ) -> tuple[np.ndarray, np.ndarray | None]:
        """Return the poses that the platform reports at times of the camera's clock, and their covariances."""
        turn_std = np.radians(self.rotation_std_deg)
        shifts = self.position_std_mm * rng.standard_normal((len(times), 3))
        turns = turn_std * rng.standard_normal((len(times), 3))
        poses = displace_poses(motion.reported(times), np.hstack([shifts, turns]))
        if not self.states_covariance:
            return poses, None
        white = np.diag([self.position_std_mm**2] * 3 + [turn_std**2] * 3)
        drift = np.zeros((len(times), 6, 6)) if motion.covariance is None else motion.covariance(times)
        return poses, drift + white


class Route(Platform):
    """Base of platforms that follow a nominal path of the sensor.

    The path is given by ``waypoints``, or by a ``trajectory`` file of times and poses in ``trajectory_format`` and
    ``trajectory_unit`` (`uwlts.read`); a relative path starts at the scene's folder. It is interpolated by Akima's
    method (rotations by a spline), at about ``speed_mm_per_s`` and at most ``turn_deg_per_s``. With a speed of 0 the
    platform stops at every waypoint.
    """

    waypoints: tuple[Pose, ...] = ()
    trajectory: str | None = None
    trajectory_format: str = "tum"
    trajectory_unit: Unit = "mm"
    speed_mm_per_s: NotNegative = 0.0
    turn_deg_per_s: Positive = 30.0

    @model_validator(mode="after")
    def _check_path(self) -> "Route":
        if bool(self.waypoints) == (self.trajectory is not None):
            raise ValueError("give either waypoints or a trajectory")
        if self.speed_mm_per_s > 0 and len(self.waypoints) < 2:
            raise ValueError("speed_mm_per_s needs two waypoints or more; a trajectory has its own times")
        return self

    def moves(self) -> bool:
        return self.trajectory is not None or self.speed_mm_per_s > 0

    def places(self) -> int:
        if not self.moves():
            return len(self.waypoints)
        assert self.frame_rate_hz is not None
        return 1 + int(self._knots[0][-1] * self.frame_rate_hz + 1e-9)

    @property
    def _knots(self) -> tuple[np.ndarray, np.ndarray]:
        """Times (K,) in s, and poses ``T_scene_sensor`` (K, 4, 4), which the path interpolates."""
        return _knots(self)  # pyright: ignore[reportArgumentType]

    def command_poses(self) -> Poses:
        """Return the nominal poses ``T_scene_platform`` of the path."""
        times, poses = self._knots
        return _interpolate_path(times, poses @ np.linalg.inv(self.mount.matrix()), stops=not self.moves())


class IdealPath(Route):
    """A platform without errors: true poses equal nominal ones."""

    kind: Literal["path"]

    def draw_motion(self, rng: np.random.Generator) -> PlatformMotion:
        commanded = self.command_poses()
        return PlatformMotion(commanded, commanded)


# Cached outside the descriptions, whose comparison would fail with array fields.
@lru_cache(maxsize=8)
def _knots(route: Route) -> tuple[np.ndarray, np.ndarray]:
    if route.trajectory is not None:
        read = read_trajectory(route.trajectory, pose_format=route.trajectory_format, unit=route.trajectory_unit)
        return read.times_s - read.times_s[0], np.array(read.poses)
    poses = np.array([waypoint.matrix() for waypoint in route.waypoints])
    if not route.moves():
        return route.stop_s * np.arange(len(poses)), poses
    ways = np.linalg.norm(np.diff(poses[:, :3, 3], axis=0), axis=1) / route.speed_mm_per_s
    turns = Rotation.from_matrix(poses[1:, :3, :3] @ np.swapaxes(poses[:-1, :3, :3], 1, 2)).magnitude()
    lasting = np.maximum(ways, turns / np.radians(route.turn_deg_per_s))
    if (lasting < SPOT_MM).any():
        raise DescriptionError(f"waypoint {int(np.argmin(lasting)) + 2} is at the same place as the one before")
    return np.append(0.0, np.cumsum(lasting)), poses


@lru_cache(maxsize=8)
def _course(platform: Platform) -> Course:
    return platform._draw_course()


# --- geometry -------------------------------------------------------------------------------------------------------


def _interpolate_path(times: np.ndarray, poses: np.ndarray, *, stops: bool) -> Poses:
    """Interpolate poses (K, 4, 4) at times (K,): stepwise at stops, else by splines with linear extrapolation."""
    if stops or len(times) == 1:
        return lambda wanted: poses[find_stop(times, wanted)]
    # Akima interpolation does not overshoot at tight turns, as cubic splines do.
    positions = Akima1DInterpolator(times, poses[:, :3, 3], method="makima")
    velocities = positions.derivative()
    rotations = RotationSpline(times, Rotation.from_matrix(poses[:, :3, :3]))

    def evaluate(wanted: np.ndarray) -> np.ndarray:
        inside = np.clip(wanted, times[0], times[-1])
        beyond = (np.asarray(wanted) - inside)[:, None]
        found = np.tile(np.eye(4), (len(inside), 1, 1))
        found[:, :3, 3] = positions(inside) + beyond * velocities(inside)
        found[:, :3, :3] = (rotations(inside) * Rotation.from_rotvec(beyond * rotations(inside, 1))).as_matrix()
        return found

    return evaluate


def displace_poses(poses: np.ndarray, errors: np.ndarray) -> np.ndarray:
    """Return poses (N, 4, 4) with errors (N, 6): a translation, and a rotation in rad about their position.

    Both are in scene axes.
    """
    moved = poses.copy()
    moved[:, :3, 3] += errors[:, :3]
    moved[:, :3, :3] = Rotation.from_rotvec(errors[:, 3:]).as_matrix() @ moved[:, :3, :3]
    return moved


def interpolate_values(times: np.ndarray, values: np.ndarray, wanted: np.ndarray) -> np.ndarray:
    """Return values (N, K), interpolated linearly from values (T, K) at times."""
    return np.stack([np.interp(wanted, times, column) for column in values.T], axis=1)


def find_stop(times: np.ndarray, wanted: np.ndarray) -> np.ndarray:
    """Return the index of the stop at times."""
    return np.clip(np.searchsorted(times, np.asarray(wanted) + 1e-9, side="right") - 1, 0, len(times) - 1)
