"""Scans of pipes with pits, bumps and welds of known position and size, in noise of any distribution, with NumPy only.

The pipe is generated about its own axis, then turned and moved as a whole, so findings do not depend on the axis.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Literal, Protocol

import numpy as np

Profile = Literal["cosine", "paraboloid", "bell", "pan"]
PROFILES = {
    "cosine": lambda t: 0.5 * (1 + np.cos(np.pi * np.minimum(t, 1))),
    "paraboloid": lambda t: np.maximum(1 - t * t, 0),
    "bell": lambda t: np.exp(-4.5 * t * t),
    "pan": lambda t: np.clip(2 * (1 - t), 0, 1),
}
"""Heights by the distance from the middle, in radii. A bell never ends, a paraboloid has a sharp rim, a pan is flat."""


class Relief(Protocol):
    """Anything with heights above the plain pipe."""

    def heights(self, along_mm: np.ndarray, angle: np.ndarray, radius_mm: float) -> np.ndarray: ...


@dataclass(frozen=True, kw_only=True)
class Bump:
    """A round bump on a pipe: middle (mm along, rad around), diameter and height; a pit has a negative height."""

    along_mm: float
    angle: float
    diameter_mm: float
    height_mm: float
    profile: Profile = "cosine"

    def heights(self, along_mm: np.ndarray, angle: np.ndarray, radius_mm: float) -> np.ndarray:
        """Return heights (N,) above the plain pipe at positions along and around it."""
        around = radius_mm * (np.mod(angle - self.angle + np.pi, 2 * np.pi) - np.pi)
        away = np.hypot(along_mm - self.along_mm, around) / (0.5 * self.diameter_mm)
        return self.height_mm * PROFILES[self.profile](away)


@dataclass(frozen=True, kw_only=True)
class WeldBead:
    """A bead of parabolic section: around the pipe at ``along_mm``, or along it at ``angle`` (the other one is None).

    A girth weld's plane may be inclined, so that its place varies by ``lean_mm`` around the pipe. The bead's height
    varies by ``ripple_mm`` along its length.
    """

    height_mm: float
    width_mm: float
    along_mm: float | None = None
    angle: float | None = None
    lean_mm: float = 0.0
    ripple_mm: float = 0.0

    def heights(self, along_mm: np.ndarray, angle: np.ndarray, radius_mm: float) -> np.ndarray:
        """Return heights (N,) above the plain pipe at positions along and around it."""
        if self.along_mm is not None:
            across, length = along_mm - self.along_mm - self.lean_mm * np.cos(angle), radius_mm * angle
        else:
            across = radius_mm * (np.mod(angle - self.angle + np.pi, 2 * np.pi) - np.pi)
            length = along_mm
        crest = self.height_mm + self.ripple_mm * np.sin(2 * np.pi * length / 6.0)
        return crest * np.maximum(1 - np.square(2 * across / self.width_mm), 0)


@dataclass(frozen=True, kw_only=True)
class Gouge:
    """A groove of parabolic section along a helix: middle (mm along, rad around), direction, length, width and depth.

    ``turn`` is the angle of its direction to the pipe's axis, rad. Its ends run out over a width.
    """

    along_mm: float
    angle: float
    turn: float
    length_mm: float
    width_mm: float
    depth_mm: float

    def heights(self, along_mm: np.ndarray, angle: np.ndarray, radius_mm: float) -> np.ndarray:
        """Return heights (N,) above the plain pipe at positions along and around it."""
        around = radius_mm * (np.mod(angle - self.angle + np.pi, 2 * np.pi) - np.pi)
        along = along_mm - self.along_mm
        cosine, sine = np.cos(self.turn), np.sin(self.turn)
        down, across = along * cosine + around * sine, around * cosine - along * sine
        run_out = np.clip((0.5 * self.length_mm - np.abs(down)) / self.width_mm, 0, 1)
        ends = 0.5 - 0.5 * np.cos(np.pi * run_out)
        return -self.depth_mm * ends * np.maximum(1 - np.square(2 * across / self.width_mm), 0)


@dataclass(frozen=True, kw_only=True)
class Patch:
    """An area of general corrosion: rough ground that is nowhere above the plain pipe, level at its rim.

    The ground is a sum of waves of random direction and phase, of lengths about ``grain_mm``.
    """

    along_mm: float
    angle: float
    length_mm: float
    width_mm: float
    depth_mm: float
    grain_mm: float
    seed: int

    def heights(self, along_mm: np.ndarray, angle: np.ndarray, radius_mm: float) -> np.ndarray:
        """Return heights (N,) above the plain pipe at positions along and around it."""
        around = radius_mm * (np.mod(angle - self.angle + np.pi, 2 * np.pi) - np.pi)
        along, rng = along_mm - self.along_mm, np.random.default_rng(self.seed)
        waves = np.zeros(np.shape(along))
        for _ in range(8):
            turn, phase, size = rng.uniform(0, np.pi), rng.uniform(0, 2 * np.pi), self.grain_mm * rng.uniform(0.7, 1.5)
            waves = waves + np.cos(2 * np.pi / size * (along * np.cos(turn) + around * np.sin(turn)) + phase)
        ground = np.clip(0.6 + 0.1 * waves, 0.2, 1.0)
        t2 = np.square(2 * along / self.length_mm) + np.square(2 * around / self.width_mm)
        return -self.depth_mm * ground * np.clip(3 * (1 - np.sqrt(t2)), 0, 1)


Noise = Callable[[np.random.Generator, tuple[int, int]], np.ndarray]


def student_noise(freedom: float) -> Noise:
    """Return Student's distribution, scaled to unit variance."""
    return lambda rng, shape: rng.standard_t(freedom, shape) / np.sqrt(freedom / (freedom - 2))


def contaminated_noise(share: float, ratio: float) -> Noise:
    """Return a normal distribution, with a share of the values of a larger standard deviation, at unit variance."""
    size = np.sqrt(1 - share + share * ratio**2)
    return lambda rng, shape: rng.standard_normal(shape) * np.where(rng.random(shape) < share, ratio, 1.0) / size


@dataclass(frozen=True, kw_only=True)
class ScannedPipe:
    """Points (N, 3), their stripe (N,) and line (N,), and the pose (3, 3), (3,) that moves the pipe's own frame there.

    In its own frame the pipe runs along Z, and angles count from X towards Y.
    """

    points_mm: np.ndarray
    frame: np.ndarray
    line: np.ndarray
    turn: np.ndarray
    shift_mm: np.ndarray
    radius_mm: float

    def own_places(self, points_mm: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return positions along (mm) and angles around (rad) the pipe of points (M, 3)."""
        own = (np.atleast_2d(points_mm) - self.shift_mm) @ self.turn
        return own[:, 2], np.arctan2(own[:, 1], own[:, 0])

    def distance_mm(self, bump: Bump, point_mm: np.ndarray) -> float:
        """Distance of a point from the middle of a bump, on the surface."""
        along, angle = self.own_places(point_mm)
        around = self.radius_mm * (np.mod(angle - bump.angle + np.pi, 2 * np.pi) - np.pi)
        return float(np.hypot(along - bump.along_mm, around)[0])


def turn_towards(axis: Sequence[float], roll: float) -> np.ndarray:
    """Return a rotation (3, 3) that maps Z to an axis, after a rotation about Z by ``roll``, rad."""
    third = np.asarray(axis, float) / np.linalg.norm(axis)
    # Householder reflections of Z to the axis and of X to -X: both together are a rotation.
    across = third - [0.0, 0.0, 1.0]
    size = float(across @ across)
    mirror = np.eye(3) - (2 / size * np.outer(across, across) if size > 1e-24 else 0.0)
    if size > 1e-24:
        mirror = mirror @ np.diag([-1.0, 1.0, 1.0])
    cosine, sine = np.cos(roll), np.sin(roll)
    return mirror @ np.array([[cosine, -sine, 0.0], [sine, cosine, 0.0], [0.0, 0.0, 1.0]])


def scan_pipe(
    rng: np.random.Generator,
    *,
    axis: Sequence[float],
    radius_mm: float = 60.0,
    length_mm: float = 120.0,
    arc: float = 2 * np.pi,
    spacing_mm: float = 1.2,
    noise_mm: float = 0.02,
    noise: Noise = np.random.Generator.standard_normal,
    bumps: Sequence[Relief] = (),
    holes: Sequence[tuple[float, float, float]] = (),
    lost: float = 0.02,
) -> ScannedPipe:
    """Scan a pipe along an axis, with a random roll and place.

    ``arc`` is the visible part of the circumference, from angle 0. ``noise_mm`` is the standard deviation along the
    normals, half of it in common with the next line. ``noise`` draws it at unit variance. ``holes`` are discs (mm
    along, rad around, mm diameter) without points, and ``lost`` is the fraction of points that are lost at random.
    """
    count = max(8, round(arc * radius_mm / spacing_mm))
    angles = arc * (np.arange(count) + 0.5) / count
    places = np.arange(-0.5 * length_mm, 0.5 * length_mm, spacing_mm)
    along, angle = np.meshgrid(places, angles, indexing="ij")
    frame, line = np.indices(along.shape)
    # Points are not aligned between stripes: each stripe has its own phase.
    angle = angle + (rng.uniform(-0.5, 0.5, len(places)) * spacing_mm / radius_mm)[:, None]
    drawn = noise(rng, (len(places), count + 1))
    moved = noise_mm * (drawn[:, 1:] + drawn[:, :-1]) / np.sqrt(2)
    height = moved + sum((bump.heights(along, angle, radius_mm) for bump in bumps), np.zeros(along.shape))
    size = radius_mm + height
    own = np.stack([size * np.cos(angle), size * np.sin(angle), along], axis=-1)
    kept = rng.random(along.shape) >= lost
    for at, around, diameter in holes:
        hole = Bump(along_mm=at, angle=around, diameter_mm=diameter, height_mm=1.0)
        kept &= hole.heights(along, angle, radius_mm) == 0
    turn, shift = turn_towards(axis, rng.uniform(-np.pi, np.pi)), rng.uniform(-200, 200, 3)
    return ScannedPipe(
        points_mm=own[kept] @ turn.T + shift,
        frame=frame[kept],
        line=line[kept],
        turn=turn,
        shift_mm=shift,
        radius_mm=radius_mm,
    )
