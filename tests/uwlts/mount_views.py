"""Profiles of a sphere before a plane, or of a plane, by a profiler on a robot: rays of its fan met with the surfaces.

Independent of the code under test: every ray of the fan is intersected in the base frame with the surfaces as they are.
"""

from dataclasses import dataclass

import numpy as np
from scipy.spatial.transform import Rotation

SPHERE_MM = np.array([812.0, -131.0, 215.0])
RADIUS_MM = 20.0
STANDOFF_MM = 220.0
RAYS = 500
MOUNT = np.eye(4)
MOUNT[:3, :3] = Rotation.from_euler("ZYX", [37.0, -12.0, 8.0], degrees=True).as_matrix()
MOUNT[:3, 3] = (63.0, -24.0, 118.0)


@dataclass(frozen=True, eq=False)
class Campaign:
    """Profiles (N, 2) with NaN where a ray met nothing, and the poses (P, 4, 4) that the robot reports, mm."""

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
) -> Campaign:
    """A campaign: the sensor looks down from all sides, the sphere anywhere in the middle of its field of view.

    The robot reports other positions than it has, by ``robot_mm`` in each coordinate, and lengths too short by
    ``scale``. The plane lies 1.1 radius below the sphere's centre, square to z of the base.
    """
    profiles, reported = [], []
    for _ in range(poses):
        turn = rng.uniform(-1, 1, 3) * np.radians(tilt_deg)
        looking_down = Rotation.from_euler("x", np.pi) * Rotation.from_rotvec(turn)
        # Where the sphere's centre lies in the sensor's frame.
        place = np.array([rng.uniform(-35, 35), rng.uniform(-0.7, 0.7) * RADIUS_MM, STANDOFF_MM + rng.uniform(-30, 30)])
        base_sensor = np.eye(4)
        base_sensor[:3, :3] = looking_down.as_matrix()
        base_sensor[:3, 3] = SPHERE_MM - base_sensor[:3, :3] @ place
        base_platform = base_sensor @ np.linalg.inv(MOUNT)
        profiles.append(profile_of(base_sensor, rng, noise_mm=noise_mm, background=background, sphere=not plane_only))
        pose = base_platform.copy()
        pose[:3, 3] = (pose[:3, 3] + robot_mm * rng.standard_normal(3)) / scale
        reported.append(pose)
    return Campaign(profiles, np.array(reported))


def profile_of(
    base_sensor: np.ndarray, rng: np.random.Generator, *, noise_mm: float, background: bool = True, sphere: bool = True
) -> np.ndarray:
    """What the fan of a sensor at ``T_base_sensor`` sees: x and z (N, 2), with noise along z and gaps, mm."""
    angles = np.radians(np.linspace(-18, 18, RAYS))
    rays = np.column_stack([np.sin(angles), np.zeros(RAYS), np.cos(angles)])
    directions, origin = rays @ base_sensor[:3, :3].T, base_sensor[:3, 3]
    length = np.full(RAYS, np.inf)
    if background:
        length = (SPHERE_MM[2] - 1.1 * RADIUS_MM - origin[2]) / directions[:, 2]
    if sphere:
        away = origin - SPHERE_MM
        half = directions @ away
        under = half**2 - (away @ away - RADIUS_MM**2)
        with np.errstate(invalid="ignore"):
            length = np.where(under > 0, np.minimum(length, -half - np.sqrt(under)), length)
    seen = np.where(np.isfinite(length), length, np.nan)
    profile = np.column_stack([rays[:, 0] * seen, rays[:, 2] * seen + noise_mm * rng.standard_normal(RAYS)])
    # A gap somewhere, and single points without an echo.
    gap = int(rng.integers(RAYS - 25))
    profile[gap : gap + 25] = np.nan
    profile[rng.random(RAYS) < 0.03] = np.nan
    return profile


def errors_of(found: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Error of a mount (4, 4): translation (3,), mm, and rotation about the platform's axes (3,), rad."""
    turn = Rotation.from_matrix(MOUNT[:3, :3] @ found[:3, :3].T).as_rotvec()
    return MOUNT[:3, 3] - found[:3, 3], turn


def step_campaign(
    rng: np.random.Generator, *, height_mm: float, poses: int = 20, noise_mm: float = 0.03, tilt_deg: float = 25.0
) -> Campaign:
    """A block with its edge along y of the base, through the place of the sphere, seen by an ideal robot.

    Its top lies ``height_mm`` above the table, and reaches to x = 55 mm before that place; beyond lies the table again.
    """
    profiles, reported = [], []
    for _ in range(poses):
        turn = rng.uniform(-1, 1, 3) * np.radians([tilt_deg, tilt_deg, 40.0])
        base_sensor = np.eye(4)
        base_sensor[:3, :3] = (Rotation.from_euler("x", np.pi) * Rotation.from_rotvec(turn)).as_matrix()
        place = np.array([rng.uniform(-25, 25), 0.0, STANDOFF_MM + rng.uniform(-30, 30)])
        base_sensor[:3, 3] = SPHERE_MM - base_sensor[:3, :3] @ place
        profiles.append(_step_profile(base_sensor, rng, height_mm=height_mm, noise_mm=noise_mm))
        reported.append(base_sensor @ np.linalg.inv(MOUNT))
    return Campaign(profiles, np.array(reported))


def _step_profile(
    base_sensor: np.ndarray, rng: np.random.Generator, *, height_mm: float, noise_mm: float
) -> np.ndarray:
    angles = np.radians(np.linspace(-18, 18, RAYS))
    rays = np.column_stack([np.sin(angles), np.zeros(RAYS), np.cos(angles)])
    directions, origin = rays @ base_sensor[:3, :3].T, base_sensor[:3, 3]

    def on_top(x: np.ndarray) -> np.ndarray:
        return (x < SPHERE_MM[0]) & (x > SPHERE_MM[0] - 55)

    top, table = ((SPHERE_MM[2] + z - origin[2]) / directions[:, 2] for z in (height_mm, 0.0))
    at_top, at_table = origin[0] + top * directions[:, 0], origin[0] + table * directions[:, 0]
    with np.errstate(divide="ignore"):
        side = (SPHERE_MM[0] - origin[0]) / directions[:, 0]
    # A ray that leaves the space above the block below its top meets the side that faces it, or misses the block.
    length = np.where(on_top(at_top), top, np.where(on_top(at_table), side, table))
    profile = np.column_stack([rays[:, 0] * length, rays[:, 2] * length + noise_mm * rng.standard_normal(RAYS)])
    profile[rng.random(RAYS) < 0.03] = np.nan
    profile[(length < 0) | (length > 3 * STANDOFF_MM)] = np.nan
    return profile
