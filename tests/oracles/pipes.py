"""Scans of pipes with pits and bumps of known position and depth, with NumPy only.

The pipe is generated about its own axis, then turned and moved as a whole, so findings do not depend on the axis.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np


@dataclass(frozen=True, kw_only=True)
class Bump:
    """A raised cosine on a pipe: middle (mm along, rad around), diameter and height; a pit has a negative height."""

    along_mm: float
    angle: float
    diameter_mm: float
    height_mm: float

    def heights(self, along_mm: np.ndarray, angle: np.ndarray, radius_mm: float) -> np.ndarray:
        """Return heights (N,) above the plain pipe at positions along and around it."""
        around = radius_mm * (np.mod(angle - self.angle + np.pi, 2 * np.pi) - np.pi)
        away = np.hypot(along_mm - self.along_mm, around) / (0.5 * self.diameter_mm)
        return np.where(away < 1, 0.5 * self.height_mm * (1 + np.cos(np.pi * np.minimum(away, 1))), 0.0)


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
    bumps: Sequence[Bump] = (),
    holes: Sequence[tuple[float, float, float]] = (),
    lost: float = 0.02,
) -> ScannedPipe:
    """Scan a pipe along an axis, with a random roll and place.

    ``arc`` is the visible part of the circumference, from angle 0. ``noise_mm`` is the standard deviation along the
    normals, half of it in common with the next line. ``holes`` are discs (mm along, rad around, mm diameter) without
    points, and ``lost`` is the fraction of points that are lost at random.
    """
    count = max(8, round(arc * radius_mm / spacing_mm))
    angles = arc * (np.arange(count) + 0.5) / count
    places = np.arange(-0.5 * length_mm, 0.5 * length_mm, spacing_mm)
    along, angle = np.meshgrid(places, angles, indexing="ij")
    frame, line = np.indices(along.shape)
    # Points are not aligned between stripes: each stripe has its own phase.
    angle = angle + (rng.uniform(-0.5, 0.5, len(places)) * spacing_mm / radius_mm)[:, None]
    drawn = rng.standard_normal((len(places), count + 1))
    noise = noise_mm * (drawn[:, 1:] + drawn[:, :-1]) / np.sqrt(2)
    height = noise + sum((bump.heights(along, angle, radius_mm) for bump in bumps), np.zeros(along.shape))
    size = radius_mm + height
    own = np.stack([size * np.cos(angle), size * np.sin(angle), along], axis=-1)
    kept = rng.random(along.shape) >= lost
    for at, around, diameter in holes:
        kept &= (
            Bump(along_mm=at, angle=around, diameter_mm=diameter, height_mm=1.0).heights(along, angle, radius_mm) == 0
        )
    turn, shift = turn_towards(axis, rng.uniform(-np.pi, np.pi)), rng.uniform(-200, 200, 3)
    return ScannedPipe(
        points_mm=own[kept] @ turn.T + shift,
        frame=frame[kept],
        line=line[kept],
        turn=turn,
        shift_mm=shift,
        radius_mm=radius_mm,
    )
