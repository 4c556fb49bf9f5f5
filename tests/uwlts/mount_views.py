"""Profiles of a sphere before a plane, or of a plane, by a profiler on a robot.

Independent of the code under test: every ray of the fan is intersected with the surfaces in the base frame.
"""

from dataclasses import dataclass
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from uwlts.model.mount import Mount, SphereFound

SPHERE_MM = np.array([812.0, -131.0, 215.0])
RADIUS_MM = 20.0
STANDOFF_MM = 220.0
RAYS = 500
MOUNT = np.eye(4)
MOUNT[:3, :3] = Rotation.from_euler("ZYX", [37.0, -12.0, 8.0], degrees=True).as_matrix()
MOUNT[:3, 3] = (63.0, -24.0, 118.0)
MOUNT_STD = np.array([0.05, 0.08, 0.03, 4e-4, 2e-4, 3e-4])


@dataclass(frozen=True, eq=False)
class Campaign:
    """Profiles (N, 2), NaN for rays that miss all surfaces, and the poses (P, 4, 4) reported by the robot, mm."""

    profiles: list[np.ndarray]
    poses: np.ndarray


def sphere_campaign(
    rng: np.random.Generator,
    *,
    poses: int = 15,
    noise_mm: float = 0.03,
    robot_mm: float = 0.0,
    tilt_deg: float = 25.0,
    background: bool = True,
    scale: float = 1.0,
    plane_only: bool = False,
    smooth_mm: float = 0.0,
    rays: int = RAYS,
) -> Campaign:
    """Simulate a campaign: the sensor looks down from all sides, with the sphere near the middle of its field of view.

    The positions reported by the robot have errors of ``robot_mm`` in each coordinate and are too short by the factor
    ``scale``. The plane is 1.1 radii below the sphere's centre, square to z of the base. The profiler has an additional
    error of ``smooth_mm`` (rms), correlated over about 8 mm of a profile.
    """
    profiles, reported = [], []
    for _ in range(poses):
        turn = rng.uniform(-1, 1, 3) * np.radians(tilt_deg)
        looking_down = Rotation.from_euler("x", np.pi) * Rotation.from_rotvec(turn)
        # The sphere's centre in the sensor's frame.
        place = np.array([rng.uniform(-35, 35), rng.uniform(-0.7, 0.7) * RADIUS_MM, STANDOFF_MM + rng.uniform(-30, 30)])
        base_sensor = np.eye(4)
        base_sensor[:3, :3] = looking_down.as_matrix()
        base_sensor[:3, 3] = SPHERE_MM - base_sensor[:3, :3] @ place
        base_platform = base_sensor @ np.linalg.inv(MOUNT)
        profile = profile_of(
            base_sensor, rng, noise_mm=noise_mm, background=background, sphere=not plane_only, count=rays
        )
        if smooth_mm:
            profile[:, 1] += smooth_mm * _smooth_errors(profile[:, 0], rng)
        profiles.append(profile)
        pose = base_platform.copy()
        pose[:3, 3] = (pose[:3, 3] + robot_mm * rng.standard_normal(3)) / scale
        reported.append(pose)
    return Campaign(profiles, np.array(reported))


def _smooth_errors(x: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """Normal errors (N,) with unit variance at x (N,), mm: noise averaged by a Gaussian kernel 8 mm wide."""
    knots = np.arange(-150.0, 150.0, 1.0)
    weights = np.exp(-(((x[:, None] - knots) / 8.0) ** 2))
    return weights @ rng.standard_normal(len(knots)) / np.sqrt(np.sum(weights**2, axis=1))


def profile_of(
    base_sensor: np.ndarray,
    rng: np.random.Generator,
    *,
    noise_mm: float,
    background: bool = True,
    sphere: bool = True,
    count: int = RAYS,
) -> np.ndarray:
    """Return the profile of a sensor at ``T_base_sensor``: x and z (N, 2) in mm, with noise along z and gaps."""
    angles = np.radians(np.linspace(-18, 18, count))
    rays = np.column_stack([np.sin(angles), np.zeros(count), np.cos(angles)])
    directions, origin = rays @ base_sensor[:3, :3].T, base_sensor[:3, 3]
    length = np.full(count, np.inf)
    if background:
        length = (SPHERE_MM[2] - 1.1 * RADIUS_MM - origin[2]) / directions[:, 2]
    if sphere:
        away = origin - SPHERE_MM
        half = directions @ away
        under = half**2 - (away @ away - RADIUS_MM**2)
        with np.errstate(invalid="ignore"):
            length = np.where(under > 0, np.minimum(length, -half - np.sqrt(under)), length)
    seen = np.where(np.isfinite(length), length, np.nan)
    profile = np.column_stack([rays[:, 0] * seen, rays[:, 2] * seen + noise_mm * rng.standard_normal(count)])
    # A gap at a random position, and single missing points.
    gap = int(rng.integers(count - 25))
    profile[gap : gap + 25] = np.nan
    profile[rng.random(count) < 0.03] = np.nan
    return profile


def errors_of(found: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Error of a mount (4, 4): translation (3,), mm, and rotation about the platform's axes (3,), rad."""
    turn = Rotation.from_matrix(MOUNT[:3, :3] @ found[:3, :3].T).as_rotvec()
    return MOUNT[:3, 3] - found[:3, 3], turn


def known_mount(transform: np.ndarray, **changed: Any) -> Mount:
    """Return a mount as from a calibration, with the standard uncertainties `MOUNT_STD` (mm, rad)."""
    fields: dict[str, Any] = {
        "T_platform_sensor": tuple(map(tuple, transform.tolist())),
        "covariance": tuple(map(tuple, np.diag(MOUNT_STD**2).tolist())),
        "coverage_factor": 2.0,
        "artefact": SphereFound(centre_mm=(0, 0, 0), radius_mm=20.0),
        "point_std_mm": 0.02,
        "pose_std_mm": 0.01,
        "rms_mm": 0.02,
        "held_out_rms_mm": 0.02,
        "poses": (),
    }
    return Mount(**fields | changed)
