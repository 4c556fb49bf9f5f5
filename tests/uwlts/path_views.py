"""Scan by a vehicle over a sea bed with stones that crosses its own path: rays intersected with the bed.

The navigation has a smooth drift. The code under test gets only the points and the reported path.
"""

from collections.abc import Callable
from functools import cache

import numpy as np
from scipy.interpolate import RectBivariateSpline
from scipy.spatial.transform import Rotation

from uwlts.model.trajectory import Trajectory
from uwlts.storage.cloud import PointCloud

ALTITUDE_MM, FAN_DEG, RAYS, STEP_MM, SPEED_MM_S = 400.0, 40.0, 120, 2.5, 200.0
NOISE_MM = 0.05


@cache
def bed(size_mm: float = 4000.0, seed: int = 7) -> RectBivariateSpline:
    """Return the height over x and y: waves of sand, and stones of 20 to 80 mm."""
    rng = np.random.default_rng(seed)
    axis = np.arange(-500.0, size_mm, 5.0)
    x, y = np.meshgrid(axis, axis, indexing="ij")
    height = 15 * np.sin(x / 310 + 1.3 * np.sin(y / 480)) + 10 * np.cos(y / 270)
    for _ in range(int(size_mm**2 / 9000)):
        u, v = rng.uniform(-450, size_mm - 50, 2)
        wide, high = rng.uniform(12, 35), rng.uniform(3, 18)
        i, j = np.searchsorted(axis, [u - 4 * wide, v - 4 * wide])
        k, m = np.searchsorted(axis, [u + 4 * wide, v + 4 * wide])
        part = slice(i, k), slice(j, m)
        height[part] += high * np.exp(-((x[part] - u) ** 2 + (y[part] - v) ** 2) / (2 * wide**2))
    return RectBivariateSpline(axis, axis, height)


def route(corners: np.ndarray, *, radius_mm: float = 250.0) -> np.ndarray:
    """Return positions (N, 2) every `STEP_MM` along lines between corners (C, 2), rounded by a moving mean."""
    lengths = np.append(0.0, np.cumsum(np.linalg.norm(np.diff(corners, axis=0), axis=1)))
    way = np.arange(0, lengths[-1], STEP_MM)
    places = np.stack([np.interp(way, lengths, column) for column in corners.T], axis=1)
    kernel = np.hanning(int(2 * radius_mm / STEP_MM)) + 1e-9
    padded = np.pad(places, ((len(kernel) // 2,) * 2, (0, 0)), mode="edge")
    return np.stack([np.convolve(c, kernel / kernel.sum(), mode="same") for c in padded.T], 1)[len(kernel) // 2 :][
        : len(way)
    ]


def scan(
    rng: np.random.Generator, poses: np.ndarray, height: Callable[[np.ndarray, np.ndarray], np.ndarray]
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return frame, line (N,) and points (N, 3) in the sensor frame, from its poses (F, 4, 4) and the bed height."""
    fan = np.radians(np.linspace(-FAN_DEG / 2, FAN_DEG / 2, RAYS))
    rays = np.column_stack([np.zeros(RAYS), np.sin(fan), np.cos(fan)])
    frame, line = (each.ravel() for each in np.meshgrid(np.arange(len(poses)), np.arange(RAYS), indexing="ij"))
    ray = np.einsum("nij,nj->ni", poses[frame, :3, :3], rays[line])
    origin, length = poses[frame, :3, 3], np.full(len(frame), ALTITUDE_MM)
    for _ in range(25):
        point = origin + length[:, None] * ray
        gap = point[:, 2] - height(point[:, 0], point[:, 1])
        length = length - 0.9 * gap / ray[:, 2]
    return frame, line, (length + NOISE_MM * rng.standard_normal(len(frame)))[:, None] * rays[line]


def ride(
    rng: np.random.Generator,
    corners: np.ndarray,
    *,
    drift_mm: float,
    drift_deg: float,
    walk: float = 0.0,
    ground: Callable[[np.ndarray, np.ndarray], np.ndarray] | None = None,
    navigation: Callable[[Trajectory], tuple[np.ndarray, np.ndarray]] | None = None,
) -> tuple[PointCloud, Trajectory, Trajectory]:
    """Return the cloud along the reported path, the reported path, and the true path.

    The drift at the end has the stated size along each axis. It is a steady rate with a slow wave of a fifth of it,
    plus a random walk of ``walk`` times that size. Alternatively, ``navigation`` gives errors (N, 6) and their
    covariances (N, 6, 6) along the true path. ``ground`` is the height over x and y; by default, that of `bed`.
    """
    places = route(corners)
    heading = np.unwrap(np.arctan2(*np.gradient(places, axis=0).T[::-1]))
    times = np.arange(len(places)) * STEP_MM / SPEED_MM_S
    true = np.tile(np.eye(4), (len(places), 1, 1))
    rolling = 0.02 * np.stack([np.sin(times / 1.7), np.cos(times / 2.3)], axis=1)
    down = Rotation.from_euler("x", np.pi)
    turns = Rotation.from_euler("ZYX", np.column_stack([heading, rolling])) * down
    true[:, :3, :3] = turns.as_matrix()
    true[:, :3, 3] = np.column_stack([places, ALTITUDE_MM + 20 * np.sin(times / 3)])
    frame, line, local = scan(rng, true, bed().ev if ground is None else ground)
    t = times / times[-1]
    sizes = np.array([drift_mm] * 3 + [np.radians(drift_deg)] * 3)
    rate, phase = rng.choice([-1, 1], 6) * rng.uniform(0.7, 1.2, 6), rng.uniform(0, 2 * np.pi, 6)
    drift = t[:, None] * rate + 0.2 * (np.sin(2 * np.pi * 0.8 * t[:, None] + phase) - np.sin(phase))
    drift += walk * np.cumsum(rng.standard_normal((len(t), 6)), axis=0) / np.sqrt(len(t))
    drift, covariance = (drift - drift[0]) * sizes, None
    if navigation is not None:
        drift, covariance = navigation(Trajectory(times, true))
    reported = true.copy()
    reported[:, :3, :3] = Rotation.from_rotvec(drift[:, 3:]).as_matrix() @ true[:, :3, :3]
    reported[:, :3, 3] += drift[:, :3]
    points = np.einsum("nij,nj->ni", reported[frame, :3, :3], local) + reported[frame, :3, 3]
    cloud = PointCloud(points, np.ones(len(points)), frame, line, time_s=times[frame])
    return cloud, Trajectory(times, reported, covariance), Trajectory(times, true)
