"""Views of free-form surfaces and of uneven pipes with errors of several kinds, with NumPy only.

A surface is a sum of waves of random direction and length. Each view has profiles of its own direction and phase, so
that no two views share a point.
"""

from dataclasses import dataclass
from typing import Literal, get_args

import numpy as np

from tests.oracles.profilers import pose_of, turn_by

Shape = Literal["free form", "pipe", "dome"]
Errors = Literal[
    "white",
    "white, not stated",
    "correlated along profiles",
    "offsets of profiles",
    "systematic",
    "heavy tails",
    "offsets and tilts of profiles",
    "none",
]
SHAPES = get_args(Shape)
ERRORS = tuple(each for each in get_args(Errors) if each != "none")


@dataclass(frozen=True, eq=False, kw_only=True)
class View:
    """Points (N, 3) of a view in its own frame, their profile (N,) and place in it (N,), and its true pose (4, 4).

    ``towards`` (3,) is the viewing direction in the view's frame, along which all errors lie. Stated standard
    deviations are those of a point's own error, of the independent errors of a profile (J, N), and of systematic errors
    (M, N). ``stated`` is False if the view comes without uncertainty.
    """

    points_mm: np.ndarray
    frame: np.ndarray
    line: np.ndarray
    pose: np.ndarray
    towards: np.ndarray
    own_mm: float
    profile_mm: np.ndarray
    systematic_mm: np.ndarray
    stated: bool


def draw_views(seed: int | list[int], shape: Shape, errors: Errors) -> list[View]:
    """Draw the views of a surface: their number, overlap, spacing, noise and poses, and the surface itself."""
    rng = np.random.default_rng(seed)
    count = int(rng.integers(4, 6)) if shape == "pipe" else int(rng.integers(2, 5))
    radius = float(rng.uniform(40, 90))
    # Lengths of the waves, mm, and their heights: slopes of some 10 deg in all.
    length = np.exp(rng.uniform(np.log(14), np.log(60), 14))
    way = rng.uniform(0, 2 * np.pi, 14)
    waves = 2 * np.pi / length[:, None] * np.column_stack([np.cos(way), np.sin(way)])
    size, phase = rng.uniform(0.3, 1.0) * 0.012 * length * rng.standard_normal(14), rng.uniform(0, 2 * np.pi, 14)

    dome = 1 / rng.uniform(150, 400) if shape == "dome" else 0.0

    def height(u: np.ndarray, v: np.ndarray) -> np.ndarray:
        if shape == "pipe":
            # Only whole waves around the pipe close.
            around = np.round(waves[:, 1] * radius) / radius
            return np.sin(np.multiply.outer(u, waves[:, 0]) + np.multiply.outer(v, around) + phase) @ size
        return np.sin(
            np.multiply.outer(u, waves[:, 0]) + np.multiply.outer(v, waves[:, 1]) + phase
        ) @ size + dome / 2 * (u**2 + v**2)

    step, spacing = rng.uniform(0.8, 1.5, 2)
    noise = float(np.exp(rng.uniform(np.log(0.005), np.log(0.05))))
    amount, apart = rng.uniform(0.3, 2.0), rng.uniform(0.3, 0.6)
    views = []
    for number in range(count):
        if shape != "pipe":
            half = 32.0
            turn = rng.uniform(-np.pi, np.pi)
            along, across = _profiles(rng, half, half, step, spacing)
            middle = apart * 2 * half * np.array([[0, 0], [1, 0], [0.5, 0.9], [-0.5, 0.9]])[number]
            u = middle[0] + np.cos(turn) * along - np.sin(turn) * across
            v = middle[1] + np.sin(turn) * along + np.cos(turn) * across
            world = np.column_stack([u, v, height(u, v)])
            towards = np.array([0.0, 0.0, 1.0])
        else:
            # Each view sees the sector up to the middles of its neighbours' overlap, and 0.3 rad more.
            half = (np.pi / count + 0.3) * radius
            along, across = _profiles(rng, 30.0, half, step, spacing)
            centre = 2 * np.pi * number / count
            angle, far = centre + across / radius, radius + height(along, radius * centre + across)
            world = np.column_stack([along, far * np.cos(angle), far * np.sin(angle)])
            towards = -np.array([0.0, np.cos(centre), np.sin(centre)])
        profile = np.unique(np.round(along, 9), return_inverse=True)[1].ravel()
        line = np.unique(np.round(across, 9), return_inverse=True)[1].ravel()
        error, profile_mm, systematic = _errors(rng, errors, profile, line, along, across, noise, amount)
        world = world + error[:, None] * towards
        pose = _pose_seeing(rng, towards, world.mean(axis=0))
        kept = rng.random(len(world)) > 0.02
        views.append(
            View(
                points_mm=((world - pose[:3, 3]) @ pose[:3, :3])[kept],
                frame=profile[kept],
                line=line[kept],
                pose=pose,
                towards=towards @ pose[:3, :3],
                own_mm=noise,
                profile_mm=profile_mm[:, kept],
                systematic_mm=systematic[:, kept],
                stated=errors != "white, not stated",
            )
        )
    return views


def _profiles(
    rng: np.random.Generator, half_along: float, half_across: float, step: float, spacing: float
) -> tuple[np.ndarray, np.ndarray]:
    """Return positions along the motion and across it of profiles with a random phase."""
    along = np.arange(-half_along, half_along, step) + rng.uniform(0, step)
    across = np.arange(-half_across, half_across, spacing) + rng.uniform(0, spacing)
    first, second = np.meshgrid(along, across, indexing="ij")
    return first.ravel(), second.ravel()


def _errors(
    rng: np.random.Generator,
    kind: Errors,
    profile: np.ndarray,
    line: np.ndarray,
    along: np.ndarray,
    across: np.ndarray,
    noise: float,
    amount: float,
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return errors (N,), and standard deviations of those of a profile (J, N) and of systematic ones (M, N)."""
    x, y = along / np.abs(along).max(), across / np.abs(across).max()
    own, by_profile, systematic = rng.standard_normal(len(x)), np.zeros((0, len(x))), np.zeros((0, len(x)))
    if kind == "correlated along profiles":
        # Moving average over a few points: errors of one profile have a common part with their neighbours.
        wide = int(rng.integers(3, 9))
        drawn = rng.standard_normal((profile.max() + 1, line.max() + wide + 1))
        total = np.cumsum(np.pad(drawn, ((0, 0), (1, 0))), axis=1)
        own = (total[:, wide:] - total[:, :-wide])[profile, line] / np.sqrt(wide)
    elif kind == "heavy tails":
        own = rng.standard_t(4, len(x)) / np.sqrt(2)
    elif kind == "offsets of profiles":
        by_profile = np.full((1, len(x)), 0.5 * amount * noise)
    elif kind == "offsets and tilts of profiles":
        by_profile = 0.5 * amount * noise * np.stack([np.ones(len(x)), y])
    elif kind == "systematic":
        systematic = amount * noise * np.stack([y**2, x * y, y**3, x**2])
    elif kind == "none":
        own = np.zeros(len(x))
    error = noise * own + rng.standard_normal(len(systematic)) @ systematic
    for each in by_profile:
        error = error + each * rng.standard_normal(profile.max() + 1)[profile]
    return error, by_profile, systematic


def _pose_seeing(rng: np.random.Generator, towards: np.ndarray, middle: np.ndarray) -> np.ndarray:
    """Return a pose whose Z is nearly the viewing direction, some 200 mm before the middle."""
    side = np.cross(towards, [1.0, 0.0, 0.0] if abs(towards[0]) < 0.9 else [0.0, 1.0, 0.0])
    side /= np.linalg.norm(side)
    turn = turn_by(rng.uniform(-0.15, 0.15, 3)) @ np.column_stack([side, np.cross(towards, side), towards])
    return pose_of(turn, middle - 200.0 * turn[:, 2])
