"""Profiles of a sphere before a plane, a plane, a step or a ring, by a profiler on a robot.

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
RING_MM = {"inner": 25.0, "outer": 42.5, "height": 24.0}
"""Radii and height of a ring gauge of 50 mm."""
RING_AXIS = np.array([0.28, -0.35, 0.894]) / np.linalg.norm([0.28, -0.35, 0.894])
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


def step_campaign(
    rng: np.random.Generator, *, height_mm: float, poses: int = 20, noise_mm: float = 0.03, tilt_deg: float = 25.0
) -> Campaign:
    """Simulate a campaign on a block with its edge along y of the base, at the sphere's position, by an ideal robot.

    The top of the block is ``height_mm`` above the table and extends 55 mm from the edge towards -x.
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
    # A ray that is not on the top but reaches the table's level below it meets the side of the block.
    length = np.where(on_top(at_top), top, np.where(on_top(at_table), side, table))
    profile = np.column_stack([rays[:, 0] * length, rays[:, 2] * length + noise_mm * rng.standard_normal(RAYS)])
    profile[rng.random(RAYS) < 0.03] = np.nan
    profile[(length < 0) | (length > 3 * STANDOFF_MM)] = np.nan
    return profile


def ring_campaign(
    rng: np.random.Generator,
    *,
    poses: int = 24,
    noise_mm: float = 0.03,
    robot_mm: float = 0.0,
    outside: bool = False,
    table: bool = True,
    tilt_deg: float = 30.0,
    towards_sensor: bool = False,
) -> Campaign:
    """Simulate a campaign on a ring gauge (`RING_MM`) on a table, with its face normal along `RING_AXIS`.

    The sheet meets its bore or its outer wall. With ``towards_sensor``, the profiler's z grows towards the sensor, and
    its x is reversed.
    """
    axes = _ring_axes()
    profiles, reported = [], []
    for _ in range(poses):
        turn = rng.uniform(-1, 1, 3) * np.radians([tilt_deg, tilt_deg, 60.0])
        base_sensor = np.eye(4)
        base_sensor[:3, :3] = axes @ (Rotation.from_euler("x", np.pi) * Rotation.from_rotvec(turn)).as_matrix()
        place = np.array([rng.uniform(-15, 15), rng.uniform(-8, 8), STANDOFF_MM + rng.uniform(-30, 30)])
        aimed = SPHERE_MM + axes[:, 0] * (RING_MM["outer"] * 0.8 * outside)
        base_sensor[:3, 3] = aimed - base_sensor[:3, :3] @ place
        profile = _ring_profile(base_sensor, axes, rng, noise_mm=noise_mm, table=table)
        if towards_sensor:
            profile *= -1
            base_sensor[:3, [0, 2]] *= -1
        profiles.append(profile)
        pose = base_sensor @ np.linalg.inv(MOUNT)
        pose[:3, 3] += robot_mm * rng.standard_normal(3)
        reported.append(pose)
    return Campaign(profiles, np.array(reported))


def _ring_axes() -> np.ndarray:
    """Directions of the ring in the base (3, 3): the third is its axis."""
    first = np.cross([0.0, 1.0, 0.0], RING_AXIS)
    first /= np.linalg.norm(first)
    return np.column_stack([first, np.cross(RING_AXIS, first), RING_AXIS])


def _ring_profile(
    base_sensor: np.ndarray, axes: np.ndarray, rng: np.random.Generator, *, noise_mm: float, table: bool
) -> np.ndarray:
    """Return the nearest intersection of each ray with the ring's face, its walls, or the table under it."""
    angles = np.radians(np.linspace(-18, 18, RAYS))
    rays = np.column_stack([np.sin(angles), np.zeros(RAYS), np.cos(angles)])
    # In the ring's frame, with the middle of its face as origin.
    directions = rays @ (axes.T @ base_sensor[:3, :3]).T
    origin = axes.T @ (base_sensor[:3, 3] - SPHERE_MM)
    inner, outer, high = RING_MM["inner"], RING_MM["outer"], RING_MM["height"]
    length = -origin[2] / directions[:, 2]
    at = np.hypot(*(origin[:2] + length[:, None] * directions[:, :2]).T)
    lengths = [np.where((at > inner) & (at < outer), length, np.inf)]
    if table:
        lengths.append((-high - origin[2]) / directions[:, 2])
    a = np.sum(directions[:, :2] ** 2, axis=1)
    b = directions[:, :2] @ origin[:2]
    for radius in (inner, outer):
        with np.errstate(invalid="ignore"):
            root = np.sqrt(b**2 - a * (origin[:2] @ origin[:2] - radius**2))
        for side in (-root, root):
            length = (-b + side) / a
            depth = origin[2] + length * directions[:, 2]
            lengths.append(np.where((depth < 0) & (depth > -high) & (length > 0), length, np.inf))
    length = np.min(np.where(np.isnan(lengths), np.inf, lengths), axis=0)
    seen = np.where(np.isfinite(length), length, np.nan)
    profile = np.column_stack([rays[:, 0] * seen, rays[:, 2] * seen + noise_mm * rng.standard_normal(RAYS)])
    profile[rng.random(RAYS) < 0.03] = np.nan
    return profile


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
