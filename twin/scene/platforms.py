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
from scipy.interpolate import Akima1DInterpolator, CubicSpline
from scipy.optimize import least_squares
from scipy.spatial.transform import Rotation, RotationSpline

from twin.scene.motion import Light, Shot
from twin.scene.navigation import Navigation, Sea, drift_of, waves_of
from twin.scene.placed import Pose
from uwlts.errors import DescriptionError
from uwlts.model.sensor import Bracket, Description, NotNegative, Positive, Vector
from uwlts.storage.pose_files import Unit, read_trajectory

Poses = Callable[[np.ndarray], np.ndarray]
"""Poses (N, 4, 4) at times (N,) in s."""
LEAD_S = 1.0
"""A platform is on its way for so long before the first and after the last image: clocks may differ by less."""

_SPOT_MM = 1e-9
_ARC_S = 0.05
"""Step in which the joints of a robot follow a path."""


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
        poses = carried.reported(times).copy()
        poses[:, :3, 3] += self.position_std_mm * rng.standard_normal((len(times), 3))
        turned = Rotation.from_rotvec(turn_std * rng.standard_normal((len(times), 3))).as_matrix()
        poses[:, :3, :3] = turned @ poses[:, :3, :3]
        if not self.states_covariance:
            return poses, None
        white = np.diag([self.position_std_mm**2] * 3 + [turn_std**2] * 3)
        drift = np.zeros((len(times), 6, 6)) if carried.covariance is None else carried.covariance(times)
        return poses, drift + white


class _Route(Platform):
    """Base of platforms that follow a path of the sensor, as it is by the mount's drawing.

    ``waypoints`` are its places one after the other, or ``trajectory`` is a file of times and poses in
    ``trajectory_format`` and ``trajectory_unit`` (`uwlts.read`); a relative path starts at the scene's
    folder. Between them it follows Akima's curve (rotations a spline), at a speed of about ``speed_mm_per_s`` and at
    most ``turn_deg_per_s``. With a speed of 0 it stops at every waypoint.
    """

    waypoints: tuple[Pose, ...] = ()
    trajectory: str | None = None
    trajectory_format: str = "tum"
    trajectory_unit: Unit = "mm"
    speed_mm_per_s: NotNegative = 0.0
    turn_deg_per_s: Positive = 30.0

    @model_validator(mode="after")
    def _has_a_path(self) -> "_Route":
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


class IdealPath(_Route):
    """A platform without errors of its own: it is where it should be."""

    kind: Literal["path"]

    def carried(self, rng: np.random.Generator) -> Carried:
        commanded = self.commanded()
        return Carried(commanded, commanded)


class LinearGuide(_Route):
    """A linear guide from the first to the last waypoint, with the error motions of ISO 230-1:2012, 3.4.

    They are ranges over the travel, in um of the carriage (the platform's origin) and in arcsec of its rotation:
    ``positioning_um`` (EXX) along the guide, ``straightness_um`` across it (EYX) and square to both (EZX), ``roll``,
    ``pitch`` and ``yaw`` (EAX, EBX, ECX); X is the guide's axis and Z as near the scene's Z as can be. Each is a sum of
    waves of 1 to 4 periods over the travel, as bent rails make. ``periodic_um`` is the amplitude of what a screw of
    ``pitch_mm`` adds to EXX. The encoder reports the nominal place.
    """

    kind: Literal["linear_guide"]
    positioning_um: NotNegative = 0.0
    straightness_um: tuple[NotNegative, NotNegative] = (0.0, 0.0)
    roll_arcsec: NotNegative = 0.0
    pitch_arcsec: NotNegative = 0.0
    yaw_arcsec: NotNegative = 0.0
    periodic_um: NotNegative = 0.0
    pitch_mm: Positive = 5.0

    @model_validator(mode="after")
    def _is_straight(self) -> "LinearGuide":
        places = np.array([waypoint.position_mm for waypoint in self.waypoints])
        if len(places) < 2 or np.linalg.norm(places[-1] - places[0]) < _SPOT_MM:
            raise ValueError("a linear guide needs two waypoints or more, the last away from the first")
        return self

    def carried(self, rng: np.random.Generator) -> Carried:
        commanded = self.commanded()
        first, last = (self.waypoints[end].matrix()[:3, 3] for end in (0, -1))
        travel = float(np.linalg.norm(last - first))
        guide = _axes((last - first) / travel)
        ranges = np.array([self.positioning_um, *self.straightness_um]) * 1e-3
        turns = np.radians(np.array([self.roll_arcsec, self.pitch_arcsec, self.yaw_arcsec]) / 3600)
        bends = [_bend(size, rng) for size in (*ranges, *turns)]
        begun, phase = commanded(np.zeros(1))[0, :3, 3], rng.uniform(0, 2 * np.pi)

        def true(times: np.ndarray) -> np.ndarray:
            poses = commanded(times).copy()
            along = (poses[:, :3, 3] - begun) @ guide[:, 0]
            errors = np.stack([bend(along / travel) for bend in bends], axis=1)
            errors[:, 0] += 1e-3 * self.periodic_um * np.sin(2 * np.pi * along / self.pitch_mm + phase)
            poses[:, :3, 3] += errors[:, :3] @ guide.T
            poses[:, :3, :3] = Rotation.from_rotvec(errors[:, 3:] @ guide.T).as_matrix() @ poses[:, :3, :3]
            return poses

        return Carried(true, commanded)


class RotaryTable(Platform):
    """A rotary table on which the scene's objects stand, seen from them: the sensor turns the other way round.

    The platform's frame lies in ``axis`` at angle 0, its z axis along the table's; ``true_axis`` is where the table
    truly turns. Images are taken at ``count`` angles from ``start_deg`` over ``turn_deg``, at rest or at
    ``speed_deg_per_s``. The error motions of the axis (ISO 230-7:2015) are amplitudes at one turn, with a third of
    them at two: ``radial_um`` (EXC, EYC), ``axial_um`` (EZC) and the wobble ``tilt_arcsec`` (EAC, EBC); the scale is
    wrong by ``angle_arcsec`` (ECC), as a graduation is that sits eccentrically. The table reports its angle.
    """

    kind: Literal["rotary_table"]
    axis: Pose = Pose()
    true_axis: Pose | None = None
    start_deg: float = 0.0
    turn_deg: float = 360.0
    count: Annotated[int, Field(ge=1, le=100_000)]
    speed_deg_per_s: NotNegative = 0.0
    radial_um: NotNegative = 0.0
    axial_um: NotNegative = 0.0
    tilt_arcsec: NotNegative = 0.0
    angle_arcsec: NotNegative = 0.0

    @model_validator(mode="before")
    @classmethod
    def _paced(cls, table: object) -> object:
        """The rate of images follows from speed and angles."""
        if not isinstance(table, dict) or not table.get("speed_deg_per_s") or table.get("frame_rate_hz") is not None:
            return table
        steps = max(int(table.get("count", 2)) - 1, 1)
        turn = abs(float(table.get("turn_deg", 360.0))) or 360.0
        return table | {"frame_rate_hz": float(table["speed_deg_per_s"]) * steps / turn}

    @property
    def stops(self) -> bool:
        return self.speed_deg_per_s == 0

    def places(self) -> int:
        return self.count

    def carried(self, rng: np.random.Generator) -> Carried:
        nominal, true_axis = self.axis.matrix(), (self.true_axis or self.axis).matrix()
        sizes = np.array([self.radial_um, self.radial_um, self.axial_um]) * 1e-3
        tilt, scale = np.radians(self.tilt_arcsec / 3600), np.radians(self.angle_arcsec / 3600)
        phases = rng.uniform(0, 2 * np.pi, (6, 2))

        def angle(times: np.ndarray) -> np.ndarray:
            if self.stops:
                step = self.turn_deg / max(self.count - 1, 1)
                place = np.clip(np.floor(times / self.stop_s + 1e-9), 0, self.count - 1)
                return np.radians(self.start_deg + step * place)
            return np.radians(self.start_deg + np.sign(self.turn_deg) * self.speed_deg_per_s * times)

        def turned(axis: np.ndarray, by: np.ndarray, errors: np.ndarray | None) -> np.ndarray:
            local = np.tile(np.eye(4), (len(by), 1, 1))
            local[:, :3, :3] = Rotation.from_rotvec(np.outer(-by, (0, 0, 1))).as_matrix()
            if errors is not None:
                # The table with the objects errs in the frame in which the axis stands still.
                table = np.tile(np.eye(4), (len(by), 1, 1))
                table[:, :3, :3] = Rotation.from_rotvec(errors[:, 3:]).as_matrix()
                table[:, :3, 3] = errors[:, :3]
                local = local @ np.linalg.inv(table)
            return axis @ local

        def true(times: np.ndarray) -> np.ndarray:
            by = angle(times)
            waves = np.sin(by[:, None, None] * (1, 2) + phases) @ (1, 1 / 3)
            return turned(true_axis, by, waves * (*sizes, tilt, tilt, scale))

        return Carried(true, lambda times: turned(nominal, angle(times), None))


class Robot(_Route):
    """A robot arm of six joints, whose joints and links err.

    ``base`` is where it stands in the scene, its z axis along the first joint. ``links`` are its Denavit-Hartenberg
    parameters (distal): d and a in mm, alpha in deg. Joints have wrong zeros by ``joint_zero_std_deg``, scatter from
    place to place by ``joint_repeat_std_deg``, and their gears err twice per turn of the motor by
    ``joint_gear_std_deg`` (``gear_ratio`` motor turns per turn, as strain-wave gears do); links are wrong by
    ``link_std_mm`` in d and a. The controller reports the flange by its own lengths and angles.
    """

    kind: Literal["robot"]
    base: Pose = Pose(position_mm=(-600.0, 0.0, 0.0))
    # Universal Robots UR5e, the maker's table "DH parameters for calculations of kinematics and dynamics".
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

    def carried(self, rng: np.random.Generator) -> Carried:
        times = self._knots[0]
        if not self.stops:
            times = np.linspace(-LEAD_S, times[-1] + LEAD_S, 2 + int((times[-1] + 2 * LEAD_S) / _ARC_S))
        base, links = self.base.matrix(), np.array(self.links)
        angles = _joint_angles(np.linalg.inv(base) @ self.commanded()(times), links)
        wrong = links + self.link_std_mm * rng.standard_normal((6, 3)) * (1, 1, 0)
        zero, gear = (
            np.radians(std) * rng.standard_normal(6) for std in (self.joint_zero_std_deg, self.joint_gear_std_deg)
        )
        places = len(self._knots[0])
        repeat = np.radians(self.joint_repeat_std_deg) * rng.standard_normal((places, 6))
        phases = rng.uniform(0, 2 * np.pi, 6)

        def over_time(at: np.ndarray, values: np.ndarray, wanted: np.ndarray) -> np.ndarray:
            if self.stops:
                return values[_stop(at, wanted)]
            return np.stack([np.interp(wanted, at, column) for column in values.T], axis=1)

        smooth = None if self.stops else CubicSpline(times, angles)

        def joints(wanted: np.ndarray) -> np.ndarray:
            return over_time(times, angles, wanted) if smooth is None else smooth(wanted)

        def true(wanted: np.ndarray) -> np.ndarray:
            at = joints(wanted)
            errors = zero + over_time(self._knots[0], repeat, wanted) + gear * np.sin(2 * self.gear_ratio * at + phases)
            return base @ _flange(at + errors, wrong)

        return Carried(true, lambda wanted: base @ _flange(joints(wanted), links))


class Vehicle(_Route):
    """An underwater vehicle that waves move and thrusters shake, and that navigates by INS and DVL.

    The scene's Z points down. See `twin.scene.navigation` for the sea and for the drift of the navigation. The sensor
    vibrates along each axis by ``vibration_mm`` and turns by ``vibration_deg`` at ``vibration_hz`` (amplitudes).
    """

    kind: Literal["vehicle"]
    sea: Sea = Sea()
    navigation: Navigation = Navigation()
    vibration_hz: Positive = 25.0
    vibration_mm: NotNegative = 0.0
    vibration_deg: NotNegative = 0.0

    @model_validator(mode="after")
    def _moves(self) -> "Vehicle":
        if self.stops:
            raise ValueError("a vehicle does not stop: give speed_mm_per_s, or a trajectory")
        return self

    def carried(self, rng: np.random.Generator) -> Carried:
        commanded = self.commanded()
        waves, phases = waves_of(self.sea, rng), rng.uniform(0, 2 * np.pi, 6)
        sizes = np.append(np.full(3, self.vibration_mm), np.full(3, np.radians(self.vibration_deg)))

        def true(times: np.ndarray) -> np.ndarray:
            poses = commanded(times).copy()
            moved = waves(times) + sizes * np.sin(2 * np.pi * self.vibration_hz * times[:, None] + phases)
            poses[:, :3, 3] += moved[:, :3]
            poses[:, :3, :3] = Rotation.from_rotvec(moved[:, 3:]).as_matrix() @ poses[:, :3, :3]
            return poses

        drift = drift_of(self.navigation, true, lead_s=2 * LEAD_S, lasting_s=float(self._knots[0][-1]), rng=rng)

        def reported(times: np.ndarray) -> np.ndarray:
            poses, errors = true(times).copy(), drift.errors(times)
            poses[:, :3, 3] += errors[:, :3]
            poses[:, :3, :3] = Rotation.from_rotvec(errors[:, 3:]).as_matrix() @ poses[:, :3, :3]
            return poses

        return Carried(true, reported, drift.covariance)


AnyPlatform = IdealPath | LinearGuide | RotaryTable | Robot | Vehicle


# Kept beside the descriptions, not in them: arrays in them would make the comparison of equal ones fail.
@lru_cache(maxsize=8)
def _knots(route: _Route) -> tuple[np.ndarray, np.ndarray]:
    if route.trajectory is not None:
        read = read_trajectory(route.trajectory, pose_format=route.trajectory_format, unit=route.trajectory_unit)
        return read.times_s - read.times_s[0], np.array(read.poses)
    poses = np.array([waypoint.matrix() for waypoint in route.waypoints])
    if route.stops:
        return route.stop_s * np.arange(len(poses)), poses
    ways = np.linalg.norm(np.diff(poses[:, :3, 3], axis=0), axis=1) / route.speed_mm_per_s
    turns = Rotation.from_matrix(poses[1:, :3, :3] @ np.swapaxes(poses[:-1, :3, :3], 1, 2)).magnitude()
    lasting = np.maximum(ways, turns / np.radians(route.turn_deg_per_s))
    if (lasting < _SPOT_MM).any():
        raise DescriptionError(f"waypoint {int(np.argmin(lasting)) + 2} is at the same place as the one before")
    return np.append(0.0, np.cumsum(lasting)), poses


@lru_cache(maxsize=8)
def _course(platform: Platform) -> Course:
    return platform._drawn()


# --- geometry -------------------------------------------------------------------------------------------------------


def _path(times: np.ndarray, poses: np.ndarray, *, stops: bool) -> Poses:
    """Poses through (K, 4, 4) at times (K,): standing at each, or along splines and straight on beyond both ends."""
    if stops or len(times) == 1:
        return lambda wanted: poses[_stop(times, wanted)]
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


def _stop(times: np.ndarray, wanted: np.ndarray) -> np.ndarray:
    """Number of the stop at times."""
    return np.clip(np.searchsorted(times, np.asarray(wanted) + 1e-9, side="right") - 1, 0, len(times) - 1)


def _way_mm(poses: np.ndarray) -> np.ndarray:
    """Length (N,) of the way of a sensor's origin to each pose: there the surface passes by the sheet."""
    steps = np.linalg.norm(np.diff(poses[:, :3, 3], axis=0), axis=1)
    return np.append(0.0, np.cumsum(steps))


def _axes(along: np.ndarray) -> np.ndarray:
    """Axes (3, 3), in columns, of a frame with x along a direction and z as near the scene's as can be."""
    up = np.array([0.0, 0.0, 1.0]) if abs(along[2]) < 0.9 else np.array([0.0, 1.0, 0.0])
    across = np.cross(up, along)
    across /= np.linalg.norm(across)
    return np.column_stack([along, across, np.cross(along, across)])


def _bend(size: float, rng: np.random.Generator) -> Callable[[np.ndarray], np.ndarray]:
    """An error motion of a range over the share of the travel from 0 to 1: waves of 1 to 4 periods, falling as 1/n."""
    orders = np.arange(1, 5)
    weights, phases = rng.standard_normal(4) / orders, rng.uniform(0, 2 * np.pi, 4)

    def raw(share: np.ndarray) -> np.ndarray:
        return np.sin(2 * np.pi * np.multiply.outer(share, orders) + phases) @ weights

    over = raw(np.linspace(0, 1, 201))
    scale = size / float(np.ptp(over))
    return lambda share: scale * (raw(share) - over[0])


def _flange(angles: np.ndarray, links: np.ndarray) -> np.ndarray:
    """Pose (N, 4, 4) of the flange in the robot's base at joint angles (N, 6) in rad (Denavit, Hartenberg 1955)."""
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


_STARTS = 40
_REACHED = 1e-6


def _joint_angles(poses: np.ndarray, links: np.ndarray) -> np.ndarray:
    """Joint angles (N, 6) in rad that bring the flange to poses (N, 4, 4) of the base, each near the one before.

    DescriptionError where the arm does not reach a pose.
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
                f"the robot does not reach place {number + 1}, its flange at ({place}) mm of its base: move the base, "
                "or give longer links"
            )
        start = solution.x
        found.append(start)
    return np.array(found)
