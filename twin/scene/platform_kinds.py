"""Platforms by kind: underwater vehicle, linear guide, rotary table, and robot arm, with the errors of their motion.

Formulas of the vehicle follow T. I. Fossen, Handbook of Marine Craft Hydrodynamics and Motion Control (Wiley, 2011;
"Fossen"), and J. A. Farrell, Aided Navigation (McGraw-Hill, 2008; "Farrell").
"""

from collections.abc import Callable
from typing import Annotated, Literal

import numpy as np
from pydantic import Field, model_validator
from scipy.interpolate import CubicSpline
from scipy.optimize import least_squares
from scipy.spatial.transform import Rotation

from twin.scene.platforms import LEAD_S, Platform, PlatformMotion, Route, displace_poses, find_stop, interpolate_values
from twin.scene.scene_object import Pose
from uwlts.errors import DescriptionError
from uwlts.model.sensor import Description, NotNegative, Positive, Vector

GRAVITY_M_S2 = 9.81  # standard gravity (9.80665), rounded
_COMPONENTS = 24  # sines of a sea state; it does not repeat during a scan
_STEP_S = 0.05  # time step of the navigation errors, far below all their time constants


class Sea(Description):
    """Waves above a vehicle, given by their significant height at the surface, and the vehicle's response.

    At ``depth_mm`` the water moves in circles, horizontally along ``towards_deg`` (from X to Y of the scene) and
    vertically. The vehicle follows the fraction ``share`` of this motion that its control leaves, and rolls and pitches
    by ``tilt_deg`` (rms).
    """

    significant_height_mm: NotNegative = 0.0
    depth_mm: NotNegative = 10_000.0
    towards_deg: float = 0.0
    share: NotNegative = 1.0
    tilt_deg: NotNegative = 0.0


def sample_waves(sea: Sea, rng: np.random.Generator) -> Callable[[np.ndarray], np.ndarray]:
    """Return a function from times (N,) in s to displacements in mm and rotations in rad, (N, 6) in the scene.

    Pierson-Moskowitz spectrum for the significant height H (Fossen, section 8.2.1), with the peak at w0 = 0.4 sqrt(g /
    H): S(w) = 5/16 H^2 w0^4 w^-5 exp(-1.25 (w0 / w)^4). Deep-water waves decay with depth by exp(-w^2 depth / g). Each
    component is a sinusoid of random phase. Frequencies are random within bands, so that the motion is not periodic.
    """
    height = max(sea.significant_height_mm, 100.0) * 1e-3
    peak = 0.4 * np.sqrt(GRAVITY_M_S2 / height)
    edges = np.linspace(0.5 * peak, 3.0 * peak, _COMPONENTS + 1)
    frequency, band = rng.uniform(edges[:-1], edges[1:]), edges[1] - edges[0]
    spectrum = 5 / 16 * height**2 * peak**4 * frequency**-5 * np.exp(-1.25 * (peak / frequency) ** 4)
    size = 1e3 * np.sqrt(2 * spectrum * band)
    if sea.significant_height_mm == 0:
        size = 0 * size
    size = sea.share * size * np.exp(-(frequency**2) * sea.depth_mm * 1e-3 / GRAVITY_M_S2)
    weight = np.sqrt(spectrum / spectrum.sum() * 2) * np.radians(sea.tilt_deg)
    phases, tilt_phases = rng.uniform(0, 2 * np.pi, _COMPONENTS), rng.uniform(0, 2 * np.pi, (2, _COMPONENTS))
    towards = np.radians(sea.towards_deg)

    def evaluate(times: np.ndarray) -> np.ndarray:
        found, turns = np.zeros((len(times), 6)), np.multiply.outer(times, frequency)
        surge = np.cos(turns + phases) @ size
        found[:, 0], found[:, 1] = surge * np.cos(towards), surge * np.sin(towards)
        found[:, 2] = np.sin(turns + phases) @ size
        for axis in (0, 1):
            found[:, 3 + axis] = np.sin(turns + tilt_phases[axis]) @ weight
        return found

    return evaluate


class Navigation(Description):
    """Errors of an inertial navigation aided by a Doppler velocity log, a depth sensor and inclinometers.

    Velocity has white noise of ``velocity_mm_per_sqrt_s`` (mm/s per root Hz): after t s, the random walk of the
    position is this value times sqrt(t). Velocity also has a bias of ``velocity_bias_mm_per_s`` with the time constant
    ``bias_time_s``. The heading has a random walk of ``heading_deg_per_sqrt_s`` and a gyro bias of
    ``gyro_bias_deg_per_s``; heading errors rotate the travelled path. Roll and pitch (``tilt_std_deg``) and depth
    (``depth_std_mm``) are measured, so their errors are bounded, with the time constant ``aided_time_s``. The
    navigation states the covariance of exactly these errors.
    """

    velocity_mm_per_sqrt_s: NotNegative = 0.0
    velocity_bias_mm_per_s: NotNegative = 0.0
    heading_deg_per_sqrt_s: NotNegative = 0.0
    gyro_bias_deg_per_s: NotNegative = 0.0
    bias_time_s: Positive = 300.0
    tilt_std_deg: NotNegative = 0.0
    depth_std_mm: NotNegative = 0.0
    aided_time_s: Positive = 60.0


def simulate_drift(
    navigation: Navigation,
    poses: Callable[[np.ndarray], np.ndarray],
    *,
    lead_s: float,
    lasting_s: float,
    rng: np.random.Generator,
) -> tuple[Callable[[np.ndarray], np.ndarray], Callable[[np.ndarray], np.ndarray]]:
    """Simulate the navigation errors of a vehicle with true poses, starting from 0 at ``lead_s`` before time 0.

    Two functions of times (N,) are returned: linearly interpolated errors (N, 6) of the reported pose, displacement in
    mm and rotation in rad about the scene's axes; and their covariances (N, 6, 6) as the navigation states them.

    The state contains errors of position (3), roll and pitch (2) and heading, and biases of velocity (2) and gyro. It
    is propagated with its covariance: x' = F x + w, P' = F P F^T + Q (Farrell, sections 4.6 and 4.9). Depth, roll and
    pitch are stationary first-order Gauss-Markov processes.
    """
    n = navigation
    times = np.arange(-lead_s, lasting_s + lead_s + _STEP_S, _STEP_S)
    velocity = np.gradient(poses(times)[:, :3, 3], times, axis=0)
    aided, biased = np.exp(-_STEP_S / n.aided_time_s), np.exp(-_STEP_S / n.bias_time_s)
    bounded = np.array([n.depth_std_mm, *np.radians([n.tilt_std_deg] * 2)])
    bias = np.array([n.velocity_bias_mm_per_s] * 2 + [np.radians(n.gyro_bias_deg_per_s)])
    walk = np.array([n.velocity_mm_per_sqrt_s] * 2 + [np.radians(n.heading_deg_per_sqrt_s)])
    noise = np.zeros(9)
    noise[[0, 1, 5]] = walk**2 * _STEP_S
    noise[2:5] = bounded**2 * (1 - aided**2)
    noise[6:] = bias**2 * (1 - biased**2)
    start = np.zeros(9)
    start[2:5], start[6:] = bounded**2, bias**2
    state, spread = np.sqrt(start) * rng.standard_normal(9), np.diag(start)
    drawn = np.sqrt(noise) * rng.standard_normal((len(times), 9))
    step = np.diag([1.0, 1.0, aided, aided, aided, 1.0, biased, biased, biased])
    step[[0, 1, 5], [6, 7, 8]] = _STEP_S
    values, covariances = np.empty((len(times), 6)), np.empty((len(times), 36))
    for number, (x, y, _) in enumerate(velocity):
        values[number], covariances[number] = state[:6], spread[:6, :6].ravel()
        # A heading error e rotates the velocity v: the position error changes by e z x v.
        step[0, 5], step[1, 5] = -y * _STEP_S, x * _STEP_S
        state = step @ state + drawn[number]
        spread = step @ spread @ step.T + np.diag(noise)
    return (
        lambda at: interpolate_values(times, values, at),
        lambda at: interpolate_values(times, covariances, at).reshape(-1, 6, 6),
    )


class Vehicle(Route):
    """An underwater vehicle moved by waves and vibrations, navigated by INS and DVL.

    The scene's Z points down. `Sea` moves the vehicle, and its `Navigation` drifts. The sensor vibrates at
    ``vibration_hz`` with the amplitudes ``vibration_mm`` along and ``vibration_deg`` about each axis.
    """

    kind: Literal["vehicle"]
    sea: Sea = Sea()
    navigation: Navigation = Navigation()
    vibration_hz: Positive = 25.0
    vibration_mm: NotNegative = 0.0
    vibration_deg: NotNegative = 0.0

    @model_validator(mode="after")
    def _moves(self) -> "Vehicle":
        if not self.moves():
            raise ValueError("a vehicle does not stop: give speed_mm_per_s, or a trajectory")
        return self

    def draw_motion(self, rng: np.random.Generator) -> PlatformMotion:
        commanded = self.command_poses()
        waves, phases = sample_waves(self.sea, rng), rng.uniform(0, 2 * np.pi, 6)
        sizes = np.append(np.full(3, self.vibration_mm), np.full(3, np.radians(self.vibration_deg)))

        def true(times: np.ndarray) -> np.ndarray:
            vibrations = sizes * np.sin(2 * np.pi * self.vibration_hz * times[:, None] + phases)
            return displace_poses(commanded(times), waves(times) + vibrations)

        lasting_s = float(self._knots[0][-1])
        errors, covariance = simulate_drift(self.navigation, true, lead_s=2 * LEAD_S, lasting_s=lasting_s, rng=rng)
        return PlatformMotion(true, lambda times: displace_poses(true(times), errors(times)), covariance)


# --- rotary table -----------------------------------------------------------------------------------------------------


class RotaryTable(Platform):
    """A rotary table that carries the scene's objects, in their frame: the sensor rotates in the opposite sense.

    The platform's frame is ``axis`` at angle 0, with z along the table's axis; ``true_axis`` is the true axis of
    rotation. Images are taken at ``count`` angles from ``start_deg`` over ``turn_deg``, at rest or at
    ``speed_deg_per_s``. The table reports its angle.

    The error motions of the axis (ISO 230-7:2015) are amplitudes at one cycle per turn, with a third of them at two
    cycles: ``radial_um`` (EXC, EYC), ``axial_um`` (EZC) and the wobble ``tilt_arcsec`` (EAC, EBC). The error of the
    scale is ``angle_arcsec`` (ECC), as caused by an eccentric graduation.
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
    def _derive_frame_rate(cls, table: object) -> object:
        """Derive the frame rate from speed and angles."""
        if not isinstance(table, dict) or not table.get("speed_deg_per_s") or table.get("frame_rate_hz") is not None:
            return table
        steps = max(int(table.get("count", 2)) - 1, 1)
        turn = abs(float(table.get("turn_deg", 360.0))) or 360.0
        return table | {"frame_rate_hz": float(table["speed_deg_per_s"]) * steps / turn}

    def moves(self) -> bool:
        return self.speed_deg_per_s > 0

    def places(self) -> int:
        return self.count

    def draw_motion(self, rng: np.random.Generator) -> PlatformMotion:
        nominal, true_axis = self.axis.matrix(), (self.true_axis or self.axis).matrix()
        sizes = np.array([self.radial_um, self.radial_um, self.axial_um]) * 1e-3
        tilt, scale = np.radians(self.tilt_arcsec / 3600), np.radians(self.angle_arcsec / 3600)
        phases = rng.uniform(0, 2 * np.pi, (6, 2))

        def angle(times: np.ndarray) -> np.ndarray:
            if self.moves():
                return np.radians(self.start_deg + np.sign(self.turn_deg) * self.speed_deg_per_s * times)
            step = self.turn_deg / max(self.count - 1, 1)
            place = np.clip(np.floor(times / self.stop_s + 1e-9), 0, self.count - 1)
            return np.radians(self.start_deg + step * place)

        def turned(by: np.ndarray) -> np.ndarray:
            about_z = np.column_stack([np.zeros((len(by), 5)), -by])
            return displace_poses(np.tile(np.eye(4), (len(by), 1, 1)), about_z)

        def true(times: np.ndarray) -> np.ndarray:
            by = angle(times)
            waves = np.sin(by[:, None, None] * (1, 2) + phases) @ (1, 1 / 3)
            # The error motion of the table with the objects, in the frame of the fixed axis.
            still = np.tile(np.eye(4), (len(by), 1, 1))
            table = displace_poses(still, waves * (*sizes, tilt, tilt, scale))
            return true_axis @ (turned(by) @ np.linalg.inv(table))

        return PlatformMotion(true, lambda times: nominal @ turned(angle(times)))


# --- robot arm --------------------------------------------------------------------------------------------------------


_ARC_S = 0.05  # time step of the joint trajectory along a path
_STARTS = 40
"""Number of random starts of the search for joint angles: up to 8 postures reach a pose, and some starts find none."""
_REACHED = 1e-6  # largest residual of a reached pose, relative to the arm's length, and in rad


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
        if self.moves():
            times = np.linspace(-LEAD_S, times[-1] + LEAD_S, 2 + int((times[-1] + 2 * LEAD_S) / _ARC_S))
        base, links = self.base.matrix(), np.array(self.links)
        angles = _solve_joint_angles(np.linalg.inv(base) @ self.command_poses()(times), links)
        wrong = links + self.link_std_mm * rng.standard_normal((6, 3)) * (1, 1, 0)
        zero, gear = (
            np.radians(std) * rng.standard_normal(6) for std in (self.joint_zero_std_deg, self.joint_gear_std_deg)
        )
        places = len(self._knots[0])
        repeat = np.radians(self.joint_repeat_std_deg) * rng.standard_normal((places, 6))
        phases = rng.uniform(0, 2 * np.pi, 6)

        def at_stops(values: np.ndarray) -> Callable[[np.ndarray], np.ndarray]:
            return lambda wanted: values[find_stop(self._knots[0], wanted)]

        def between(wanted: np.ndarray) -> np.ndarray:
            return interpolate_values(self._knots[0], repeat, wanted)

        joints, repeated = (CubicSpline(times, angles), between) if self.moves() else map(at_stops, (angles, repeat))

        def true(wanted: np.ndarray) -> np.ndarray:
            at = joints(wanted)
            errors = zero + repeated(wanted) + gear * np.sin(2 * self.gear_ratio * at + phases)
            return base @ _compute_flange(at + errors, wrong)

        return PlatformMotion(true, lambda wanted: base @ _compute_flange(joints(wanted), links))


def _compute_flange(angles: np.ndarray, links: np.ndarray) -> np.ndarray:
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


def _solve_joint_angles(poses: np.ndarray, links: np.ndarray) -> np.ndarray:
    """Return joint angles (N, 6) in rad that move the flange to poses (N, 4, 4) of the base.

    The angles of each pose are close to the previous ones. DescriptionError if the arm does not reach a pose.
    """
    length = float(np.abs(links[:, :2]).sum())

    def misfit(angles: np.ndarray, wanted: np.ndarray) -> np.ndarray:
        found = _compute_flange(angles[None], links)[0]
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
