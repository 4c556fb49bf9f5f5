"""Profiles of spheres and boards by a laser profiler on a robot, with NumPy only.

The profiler has noise, smooth errors, gaps and scattered points; the robot's poses have errors.
"""

from dataclasses import dataclass
from typing import Any, Literal

import numpy as np

Kind = Literal["sphere", "plane"]

_STEEPEST = np.radians(65)
"""Angle between a ray and a surface's normal beyond which a profiler returns no point."""


@dataclass(frozen=True, eq=False, kw_only=True)
class ProfilerSet:
    """Profiles (N, 2) with NaN for missing points, reported poses (P, 4, 4) in mm, and the truth.

    ``surface`` (N,) is 0 for points of a profile on the artefact, and -1 for background, scattered points and missing
    ones. ``artefact`` is the pose (4, 4) of the artefact, its z axis normal to the face.
    """

    kind: Kind
    size_mm: float
    profiles: list[np.ndarray]
    surface: list[np.ndarray]
    poses: np.ndarray
    mount: np.ndarray
    artefact: np.ndarray

    def select(self, rows: slice) -> "ProfilerSet":
        """Return some of the poses."""
        return ProfilerSet(
            kind=self.kind,
            size_mm=self.size_mm,
            profiles=self.profiles[rows],
            surface=self.surface[rows],
            poses=self.poses[rows],
            mount=self.mount,
            artefact=self.artefact,
        )


def turn_by(vector: np.ndarray) -> np.ndarray:
    """Return the rotation (3, 3) by a rotation vector, rad (Rodrigues)."""
    angle = float(np.linalg.norm(vector))
    x, y, z = vector / max(angle, 1e-300)
    cross = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
    return np.eye(3) + np.sin(angle) * cross + (1 - np.cos(angle)) * cross @ cross


def turn_between(one: np.ndarray, other: np.ndarray) -> np.ndarray:
    """Return the small rotation vector (3,) from a rotation (3, 3) to another, rad."""
    turn = other @ one.T
    return np.array([turn[2, 1] - turn[1, 2], turn[0, 2] - turn[2, 0], turn[1, 0] - turn[0, 1]]) / 2


def pose_of(turn: np.ndarray, shift: np.ndarray) -> np.ndarray:
    """Return a pose (4, 4)."""
    pose = np.eye(4)
    pose[:3, :3], pose[:3, 3] = turn, shift
    return pose


def draw_set(
    seed: int | list[int],
    kind: Kind,
    *,
    poses: int | None = None,
    points: int | None = None,
    noise_mm: float | None = None,
    smooth_mm: float | None = None,
    fixed_mm: float = 0.0,
    robot_mm: float | None = None,
    turn_rad: float | None = None,
    scattered: float | None = None,
    background: bool | None = None,
    steepest: float = _STEEPEST,
) -> ProfilerSet:
    """Draw profiler, robot, artefact and poses from a seed; arguments replace what is drawn.

    ``smooth_mm`` is the rms of a form error with a shape of its own in each profile, ``fixed_mm`` that of one that is
    the same in all. ``scattered`` is the fraction of points anywhere in the field of view. A plane is a board with two
    ridges. The robot's positions and rotations have errors of ``robot_mm`` in each coordinate and ``turn_rad``.
    """
    rng = np.random.default_rng(seed)
    drawn: dict[str, Any] = {
        "poses": int(rng.integers(16 if kind == "sphere" else 22, 36)),
        "points": int(np.exp(rng.uniform(np.log(150), np.log(2000)))),
        "noise_mm": float(np.exp(rng.uniform(np.log(0.008), np.log(0.06)))),
        "smooth_mm": float(rng.uniform(0.01, 0.08)),
        "robot_mm": float(np.exp(rng.uniform(np.log(0.01), np.log(0.12)))),
        "turn_rad": float(np.exp(rng.uniform(np.log(2e-5), np.log(2e-4)))),
        "scattered": float(rng.choice([0.0, 0.05, 0.15])),
        "background": bool(rng.integers(2)),
    }
    given = {
        "poses": poses,
        "points": points,
        "noise_mm": noise_mm,
        "smooth_mm": smooth_mm,
        "robot_mm": robot_mm,
        "turn_rad": turn_rad,
        "scattered": scattered,
        "background": background,
    }
    drawn |= {name: value for name, value in given.items() if value is not None}
    far = float(rng.uniform(150, 350))
    half = np.radians(rng.uniform(12, 20))
    wide = far * np.tan(half)
    size = {"sphere": rng.uniform(0.3, 0.8) * wide, "plane": rng.uniform(4.0, 10.0)}[kind]
    rng.random(2)  # unused: the sets of a seed are those of the published tables
    mount = pose_of(turn_by(rng.uniform(-2, 2, 3)), rng.uniform(-150, 150, 3))
    artefact = pose_of(turn_by(rng.uniform(-0.4, 0.4, 3)), rng.uniform(-600, 600, 3))
    fixed = _draw_form(rng)
    profiles, surfaces, reported = [], [], []
    while len(profiles) < drawn["poses"]:
        # The artefact as seen from the sensor, its z axis roughly against the sensor's.
        tilt = np.radians(rng.uniform(-28, 28, 3)) * [1, 1, 2]
        place = np.array([rng.uniform(-0.35, 0.35) * wide, 0.0, far * rng.uniform(0.88, 1.12)])
        if kind == "sphere":
            place[1] = rng.uniform(-0.7, 0.7) * size
            place[2] += size
        seen = pose_of(turn_by(tilt) @ np.diag([1.0, -1.0, -1.0]), place)
        profile, surface = _cut(
            kind, float(size), seen, half, drawn["points"], background=drawn["background"], steepest=steepest
        )
        if np.count_nonzero(surface >= 0) < 0.15 * len(surface):
            continue
        inside = profile[:, 0] / wide
        own = drawn["smooth_mm"] * _draw_form(rng)(inside, profile[:, 1] / far - 1)
        both = own + fixed_mm * fixed(inside, profile[:, 1] / far - 1)
        profile[:, 1] += both + drawn["noise_mm"] * rng.standard_normal(len(profile))
        stray = rng.random(len(profile)) < drawn["scattered"]
        depth = far * rng.uniform(0.8, 1.25, len(profile))
        slope = np.tan(np.linspace(-half, half, len(profile)))
        profile[stray] = np.column_stack([slope * depth, depth])[stray]
        gone = rng.random(len(profile)) < 0.02
        for _ in range(rng.integers(3)):
            first = int(rng.integers(len(profile)))
            gone[first : first + int(rng.uniform(0.01, 0.08) * len(profile))] = True
        profile[gone] = np.nan
        surface[stray | gone] = -1
        profiles.append(profile)
        surfaces.append(surface)
        pose = artefact @ np.linalg.inv(seen) @ np.linalg.inv(mount)
        pose[:3, :3] = turn_by(drawn["turn_rad"] * rng.standard_normal(3)) @ pose[:3, :3]
        pose[:3, 3] += drawn["robot_mm"] * rng.standard_normal(3)
        reported.append(pose)
    return ProfilerSet(
        kind=kind,
        size_mm=float(size),
        profiles=profiles,
        surface=surfaces,
        poses=np.array(reported),
        mount=mount,
        artefact=artefact,
    )


def _draw_form(rng: np.random.Generator) -> Any:
    """Draw a smooth error of unit rms over the field of view: Legendre polynomials up to order 5, falling."""
    weights = rng.standard_normal((6, 2)) / np.arange(1, 7)[:, None]
    weights[:, 1] /= 2
    powers = (2 * np.arange(6)[:, None] + 1) * (2 * np.arange(2) + 1)
    weights /= np.sqrt(np.sum(weights**2 / powers))
    return lambda x, z: np.polynomial.legendre.legval2d(np.clip(x, -1.2, 1.2), np.clip(6 * z, -1, 1), weights)


def _cut(
    kind: Kind, size: float, seen: np.ndarray, half: float, count: int, *, background: bool, steepest: float
) -> tuple[np.ndarray, np.ndarray]:
    """Return the exact profile (N, 2) of an artefact at ``seen`` (4, 4) in the sensor's frame, and surfaces (N,)."""
    angles = np.arctan(np.linspace(-np.tan(half), np.tan(half), count))
    rays = np.column_stack([np.sin(angles), np.zeros(count), np.cos(angles)])
    directions, origin = rays @ seen[:3, :3], -seen[:3, 3] @ seen[:3, :3]
    flat = np.broadcast_to([0.0, 0.0, 1.0], (count, 3))
    hits: list[tuple[np.ndarray, np.ndarray, int]] = []

    def add_level(height: float, label: int, inside: Any = None) -> None:
        lengths = (height - origin[2]) / directions[:, 2]
        at = origin + lengths[:, None] * directions
        hits.append((np.where((lengths > 0) & (True if inside is None else inside(at)), lengths, np.inf), flat, label))

    match kind:
        case "sphere":
            along = directions @ origin
            root = along**2 - origin @ origin + size**2
            lengths = np.where(root > 0, -along - np.sqrt(np.maximum(root, 0)), np.inf)
            finite = np.where(np.isfinite(lengths), lengths, 0.0)
            hits.append((lengths, (origin + finite[:, None] * directions) / size, 0))
            if background:
                add_level(-1.1 * size, -1)
        case "plane":
            add_level(0.0, 0)
            for middle in (-25.0, 25.0):
                add_level(size, -1, lambda at, middle=middle: np.abs(at[:, 0] - middle) < 6)
    lengths = np.array([each for each, _, _ in hits])
    first = np.argmin(lengths, axis=0)
    length = lengths[first, np.arange(count)]
    normals = np.array([each for _, each, _ in hits])[first, np.arange(count)]
    steep = np.abs(np.sum(normals * directions, axis=1)) < np.cos(steepest)
    missing = ~np.isfinite(length) | steep
    profile = np.column_stack([rays[:, 0], rays[:, 2]]) * np.where(missing, np.nan, length)[:, None]
    return profile, np.where(missing, -1, np.array([label for _, _, label in hits])[first])


def scatter_mm(
    given: ProfilerSet, mount: np.ndarray, place: np.ndarray, axis: np.ndarray, size_mm: float
) -> np.ndarray:
    """Return the distances (N,) of all points of the artefact from it: its place (3,), axis (3,) and size."""
    off = []
    for profile, surface, pose in zip(given.profiles, given.surface, given.poses, strict=True):
        rows = surface >= 0
        points = np.column_stack([profile[rows, 0], np.zeros(np.count_nonzero(rows)), profile[rows, 1]])
        away = points @ (pose @ mount)[:3, :3].T + (pose @ mount)[:3, 3] - place
        off.append(np.linalg.norm(away, axis=1) - size_mm if given.kind == "sphere" else away @ axis)
    return np.concatenate(off)
