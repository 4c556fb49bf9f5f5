"""Scans of a pipe from several sides: rays of a laser fan intersected with the surface by Newton's method.

Independent of the code under test, which gets points, their stated uncertainty, and wrong poses.
"""

from collections.abc import Callable
from functools import cache

import numpy as np
from scipy.interpolate import RectBivariateSpline
from scipy.spatial.transform import Rotation

from uwlts.storage.cloud import PointCloud, PointUncertainty

RADIUS_MM, OVALITY_MM = 150.0, 0.6
NOISE_MM = 0.02
AWAY_MM, FAN_DEG, RAYS, LINES, STEP_MM = 380.0, 44.0, 320, 61, 2.0

Radius = Callable[[np.ndarray, np.ndarray], np.ndarray]


def plain(angle: np.ndarray, along: np.ndarray) -> np.ndarray:
    """A round pipe."""
    return RADIUS_MM + 0 * angle


def oval(angle: np.ndarray, along: np.ndarray) -> np.ndarray:
    """An oval pipe: the largest diameter is larger than the smallest by `OVALITY_MM`."""
    return RADIUS_MM + OVALITY_MM / 4 * np.cos(2 * angle - 0.7)


@cache
def _pits() -> RectBivariateSpline:
    """Return the height by angle and length of pits and bumps of 8 to 16 mm, as a smooth function."""
    rng = np.random.default_rng(99)
    angle, along = np.linspace(-np.pi, np.pi, 945), np.linspace(-80, 80, 161)
    height = np.zeros((len(angle), len(along)))
    for _ in range(150):
        at, place, wide, high = *rng.uniform([-3.0, -75], [3.0, 75]), rng.uniform(4, 8), rng.uniform(-2.5, 1.5)
        off = np.angle(np.exp(1j * (angle - at))) * RADIUS_MM
        height += high * np.outer(np.exp(-(off**2) / (2 * wide**2)), np.exp(-((along - place) ** 2) / (2 * wide**2)))
    return RectBivariateSpline(angle, along, height)


def pitted(angle: np.ndarray, along: np.ndarray) -> np.ndarray:
    """An oval pipe with shallow pits and bumps all over."""
    return oval(angle, along) + _pits().ev(angle, along)


def side_pose(angle: float) -> np.ndarray:
    """``T_pipe_scan`` of a scan from one side: its X along the pipe, its Z towards the axis, square to it."""
    pose = np.eye(4)
    inwards = -np.array([0.0, np.cos(angle), np.sin(angle)])
    pose[:3, 2], pose[:3, 0] = inwards, (1.0, 0.0, 0.0)
    pose[:3, 1] = np.cross(inwards, pose[:3, 0])
    pose[:3, 3] = -AWAY_MM * inwards
    return pose


def scan_from(
    pose: np.ndarray,
    rng: np.random.Generator,
    *,
    radius: Radius = oval,
    noise_mm: float = NOISE_MM,
    systematic: float = 0.0,
    amounts: np.ndarray | None = None,
) -> PointCloud:
    """Simulate the scan of a sensor that moves along its X: a fan in its YZ plane, noise along the rays.

    ``systematic`` scales errors that all points share: a scale along Y, a bow of the sheet, and a tilt. Their amounts
    have a standard deviation of one in units of the stated patterns. ``amounts`` (3,) are amounts common to several
    scans; by default, they are drawn.
    """
    fan = np.radians(np.linspace(-FAN_DEG / 2, FAN_DEG / 2, RAYS))
    rays = np.column_stack([np.zeros(RAYS), np.sin(fan), np.cos(fan)])
    stage = STEP_MM * (np.arange(LINES) - LINES // 2)
    frame, line = (each.ravel() for each in np.meshgrid(np.arange(LINES), np.arange(RAYS), indexing="ij"))
    origin = pose[:3, 3] + stage[frame, None] * pose[:3, 0]
    ray = rays[line] @ pose[:3, :3].T
    across, towards = origin[:, 1:], ray[:, 1:]
    # Intersections of the rays with a circle round the axis, then with the surface itself.
    square, half = np.sum(towards**2, 1), np.sum(across * towards, 1)
    with np.errstate(invalid="ignore"):
        length = (-half - np.sqrt(half**2 - square * (np.sum(across**2, 1) - RADIUS_MM**2))) / square
    hit = np.isfinite(length)
    origin, ray, frame, line, length = origin[hit], ray[hit], frame[hit], line[hit], length[hit]

    def above(length: np.ndarray) -> np.ndarray:
        point = origin + length[:, None] * ray
        return np.hypot(point[:, 1], point[:, 2]) - radius(np.arctan2(point[:, 2], point[:, 1]), point[:, 0])

    for _ in range(6):
        height = above(length)
        slope = (above(length + 1e-3) - height) / 1e-3
        length = length - np.clip(height / np.minimum(slope, -0.2), -3, 3)
    point = origin + length[:, None] * ray
    lean = (above(length + 1e-3) - above(length)) / 1e-3
    seen = (np.abs(above(length)) < 1e-6) & (lean < -0.35)
    local = (point[seen] - pose[:3, 3]) @ pose[:3, :3]
    beam = ray[seen] @ pose[:3, :3]
    frame, line, count = frame[seen], line[seen], int(seen.sum())
    y, depth = local[:, 1] / 90, (local[:, 2] - AWAY_MM + RADIUS_MM) / 50
    patterns = np.zeros((3, count, 3))
    patterns[0, :, 1], patterns[0, :, 2] = 0.03 * y, 0.01 * depth
    patterns[1, :, 2] = 0.03 * y**2
    patterns[2, :, 2] = 0.03 * y
    known = PointUncertainty(
        (
            noise_mm**2
            * np.stack([beam[:, i] * beam[:, j] for i, j in ((0, 0), (0, 1), (0, 2), (1, 1), (1, 2), (2, 2))], 1)
        ),
        np.zeros((count, 3)),
        max(systematic, 1e-3) * patterns,
        shared={} if amounts is None else {"sensor": np.eye(3)},
    )
    moved = local + noise_mm * rng.standard_normal(count)[:, None] * beam
    moved += systematic * np.tensordot(rng.standard_normal(3) if amounts is None else amounts, patterns, axes=1)
    return PointCloud(moved, np.full(count, 100.0), frame, line, uncertainty=known, metadata={"medium": "water"})


def views(
    rng: np.random.Generator,
    *,
    count: int = 5,
    shift_mm: float = 2.0,
    turn_deg: float = 0.5,
    one_sensor: bool = False,
    **how: object,
) -> tuple[list[PointCloud], np.ndarray, np.ndarray]:
    """Return scans from ``count`` sides, their true poses (N, 4, 4) in the frame of the first, and wrong poses.

    With ``one_sensor``, all scans have the same calibration errors, otherwise each has its own.
    """
    true = np.array([side_pose(angle) for angle in 2 * np.pi * np.arange(count) / count])
    if one_sensor:
        how["amounts"] = rng.standard_normal(3)
    scans = [scan_from(pose, rng, **how) for pose in true]
    true = np.linalg.inv(true[0]) @ true
    wrong = true.copy()
    for number in range(1, count):
        turn = Rotation.from_rotvec(np.radians(turn_deg) * rng.uniform(-1, 1, 3)).as_matrix()
        middle = true[number] @ np.append(scans[number].points_mm.mean(axis=0), 1)
        wrong[number, :3, :3] = turn @ true[number, :3, :3]
        wrong[number, :3, 3] = turn @ (true[number, :3, 3] - middle[:3]) + middle[:3] + shift_mm * rng.uniform(-1, 1, 3)
    return scans, true, wrong


def pose_errors(found: np.ndarray, true: np.ndarray, middles_mm: np.ndarray) -> np.ndarray:
    """Return pose errors (N, 6) in the frame of the first: shift (mm) at the scan's middle and rotation (rad)."""
    back = true @ np.linalg.inv(found)
    turn = Rotation.from_matrix(back[:, :3, :3]).as_rotvec()
    shift = np.einsum("nij,nj->ni", back[:, :3, :3], middles_mm) + back[:, :3, 3] - middles_mm
    return -np.hstack([shift, turn])
