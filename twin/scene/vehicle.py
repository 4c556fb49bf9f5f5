"""Underwater vehicle: motion by waves and vibration, and drift of its navigation.

Formulas follow T. I. Fossen, Handbook of Marine Craft Hydrodynamics and Motion Control (Wiley, 2011; "Fossen"), and J.
A. Farrell, Aided Navigation (McGraw-Hill, 2008; "Farrell").
"""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Literal

import numpy as np
from pydantic import model_validator

from twin.scene.platforms import LEAD_S, PlatformMotion, Route, displace_poses, interpolate_values
from uwlts.model.sensor import Description, NotNegative, Positive

GRAVITY_M_S2 = 9.81
_COMPONENTS = 24  # sines of a sea state; it does not repeat during a scan
_STEP_S = 0.05
"""Time step of the navigation errors, far below all their time constants."""


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
    still = sea.significant_height_mm == 0 and sea.tilt_deg == 0
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
        found = np.zeros((len(times), 6))
        if still:
            return found
        turns = np.multiply.outer(times, frequency)
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


@dataclass(frozen=True, eq=False)
class Drift:
    """Errors of the reported pose at times: displacement in mm and rotation in rad about the scene's axes."""

    times_s: np.ndarray
    values: np.ndarray
    covariances: np.ndarray

    def errors(self, times_s: np.ndarray) -> np.ndarray:
        """Return linearly interpolated errors (N, 6)."""
        return interpolate_values(self.times_s, self.values, times_s)

    def covariance(self, times_s: np.ndarray) -> np.ndarray:
        """Return the covariances (N, 6, 6) stated by the navigation."""
        flat = self.covariances.reshape(len(self.times_s), -1)
        return interpolate_values(self.times_s, flat, times_s).reshape(-1, 6, 6)


def simulate_drift(
    navigation: Navigation,
    poses: Callable[[np.ndarray], np.ndarray],
    *,
    lead_s: float,
    lasting_s: float,
    rng: np.random.Generator,
) -> Drift:
    """Simulate the navigation errors of a vehicle with true poses, starting from 0 at ``lead_s`` before time 0.

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
    values, covariances = np.empty((len(times), 9)), np.empty((len(times), 9, 9))
    for number, (x, y, _) in enumerate(velocity):
        values[number], covariances[number] = state, spread
        # A heading error e rotates the velocity v: the position error changes by e z x v.
        step[0, 5], step[1, 5] = -y * _STEP_S, x * _STEP_S
        state = step @ state + drawn[number]
        spread = step @ spread @ step.T + np.diag(noise)
    return Drift(times, values[:, :6], covariances[:, :6, :6])


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
        if self.stops:
            raise ValueError("a vehicle does not stop: give speed_mm_per_s, or a trajectory")
        return self

    def draw_motion(self, rng: np.random.Generator) -> PlatformMotion:
        commanded = self.command_poses()
        waves, phases = sample_waves(self.sea, rng), rng.uniform(0, 2 * np.pi, 6)
        sizes = np.append(np.full(3, self.vibration_mm), np.full(3, np.radians(self.vibration_deg)))

        def true(times: np.ndarray) -> np.ndarray:
            vibrations = sizes * np.sin(2 * np.pi * self.vibration_hz * times[:, None] + phases)
            return displace_poses(commanded(times), waves(times) + vibrations)

        drift = simulate_drift(self.navigation, true, lead_s=2 * LEAD_S, lasting_s=float(self._knots[0][-1]), rng=rng)

        def reported(times: np.ndarray) -> np.ndarray:
            return displace_poses(true(times), drift.errors(times))

        return PlatformMotion(true, reported, drift.covariance)
