"""Draws of parts that are no plain straight pipe: bends, T-pieces, flanged ends, reducers, growth; and of welds.

A kind is a function of a random generator that returns a `Part`, as in `tests.oracles.damaged_pipes`. With NumPy only.
"""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from tests.oracles.damaged_pipes import Part, Truth
from tests.oracles.pipes import WeldBead, scan_pipe, turn_towards


def _place(rng: np.random.Generator, parts: list[np.ndarray], names: tuple[str, ...]) -> Part:
    """Return a part of points (N, 3) in any place and direction, with no order of images."""
    points = np.vstack(parts)
    points = points @ turn_towards(rng.standard_normal(3).tolist(), rng.uniform(-3, 3)).T + rng.uniform(-300, 300, 3)
    none = np.full(len(points), -1)
    return Part(points_mm=points, frame=none, line=none, names=names)


def _tube(
    rng: np.random.Generator, radius: float, length: tuple[float, float], density: float, noise: float, arc: float
) -> np.ndarray:
    """Return points (N, 3) on a tube along Z, seen over an arc about +X; ``density`` in points per mm2."""
    count = int(density * arc * radius * (length[1] - length[0]))
    angle, along = rng.uniform(-arc / 2, arc / 2, count), rng.uniform(*length, count)
    size = radius + noise * rng.standard_normal(count)
    return np.column_stack([size * np.cos(angle), size * np.sin(angle), along])


def _draw(rng: np.random.Generator, points: float = 15_000) -> tuple[float, float, float, float, float]:
    """Return radius, length, density, noise and arc of a pipe with a number of points."""
    radius = float(rng.uniform(30, 160))
    length, arc = radius * float(rng.uniform(4, 7)), float(rng.choice([2 * np.pi, rng.uniform(2.2, 4.5)]))
    return radius, length, points / (arc * radius * length), float(rng.uniform(0.01, 0.05)), arc


def elbow(rng: np.random.Generator) -> Part:
    """A bend of 20 to 90 deg and of 1.5 to 5 diameters, half of them with straight ends."""
    radius, _, _, noise, arc = _draw(rng)
    bend, turn = 2 * radius * float(rng.uniform(1.5, 5)), np.radians(rng.uniform(20, 90))
    ends = float(rng.uniform(0, 2)) * radius if rng.random() < 0.5 else 0.0
    points = _tube(
        rng, radius, (-ends, bend * turn + ends), 15_000 / (arc * radius * (bend * turn + 2 * ends)), noise, arc
    )
    # The tube is bent within the length, towards any side of the seen arc.
    x, y, along = points.T
    side = rng.uniform(-np.pi, np.pi)
    u, v = x * np.cos(side) + y * np.sin(side), y * np.cos(side) - x * np.sin(side)
    at = np.clip(along, 0, bend * turn) / bend
    left, out = along - at * bend, bend + u
    bent = [out * np.cos(at) - left * np.sin(at), v, out * np.sin(at) + left * np.cos(at)]
    return _place(rng, [np.column_stack(bent)], ("bend",))


def tee(rng: np.random.Generator) -> Part:
    """A pipe with a branch of 0.3 to 0.9 of its diameter, at 60 to 90 deg."""
    radius, length, density, noise, arc = _draw(rng)
    own = radius * float(rng.uniform(0.3, 0.9))
    run = _tube(rng, radius, (-length / 2, length / 2), density, noise, arc)
    lean, at = np.radians(rng.uniform(0, 30)), float(rng.uniform(-0.2, 0.2)) * length
    branch = _tube(rng, own, (0.0, radius * float(rng.uniform(2, 4))), density, noise, 2 * np.pi)
    # The branch's axis is turned from Z to X, inclined towards Z.
    axis = np.array([np.cos(lean), 0.0, np.sin(lean)])
    across = np.array([[0.0, 1, 0], np.cross(axis, [0.0, 1, 0])])
    branch = branch[:, :2] @ across + branch[:, 2:] * axis + [0, 0, at]
    branch = branch[np.hypot(branch[:, 0], branch[:, 1]) > radius]
    away = run - [0, 0, at]
    inside = (np.linalg.norm(away - np.outer(away @ axis, axis), axis=1) < own) & (away @ axis > 0)
    return _place(rng, [run[~inside], branch], ("second body",))


def flanged_end(rng: np.random.Generator) -> Part:
    """A pipe with a flange at one end: hub, back face and rim are seen."""
    radius, length, density, noise, arc = _draw(rng)
    rim, thick = radius * float(rng.uniform(1.4, 2.0)), radius * float(rng.uniform(0.15, 0.4))
    hub, top = radius * float(rng.uniform(0.0, 0.5)), radius * float(rng.uniform(1.05, 1.25))
    pipe = _tube(rng, radius, (0, length - hub), density, noise, arc)
    neck = _tube(rng, radius, (length - hub, length), density, noise, arc)
    neck[:, :2] *= 1 + (top / radius - 1) * (neck[:, 2:] - length + hub) / max(hub, 1e-9)
    face = _tube(rng, 1.0, (0, 1), density * (rim**2 - top**2) / 2, 0.0, arc)
    size = np.sqrt(top**2 + (rim**2 - top**2) * face[:, 2:])
    face = np.hstack([face[:, :2] * size, length + noise * rng.standard_normal((len(face), 1))])
    edge = _tube(rng, rim, (length, length + thick), density, noise, arc)
    return _place(rng, [pipe, neck, face, edge], ("second body",))


def reducer(rng: np.random.Generator) -> Part:
    """A pipe that narrows to 0.5 to 0.85 of its diameter in its middle."""
    radius, length, density, noise, arc = _draw(rng)
    points = _tube(rng, radius, (0, length), density, noise, arc)
    small, cone = float(rng.uniform(0.5, 0.85)), float(rng.uniform(0.2, 0.4))
    points[:, :2] *= 1 - (1 - small) * np.clip((points[:, 2:] / length - 0.5) / cone + 0.5, 0, 1)
    return _place(rng, [points], ("reducer", "second body", "cone"))


def growth(rng: np.random.Generator) -> Part:
    """A perfect pipe with clumps of growth, 2 to 10 % of the radius high, on 15 to 75 % of its surface."""
    radius, length, density, noise, arc = _draw(rng)
    points = _tube(rng, radius, (0, length), density, noise, arc)
    angle, cover = np.arctan2(points[:, 1], points[:, 0]), float(rng.uniform(0.15, 0.75))
    high, height = radius * float(rng.uniform(0.02, 0.1)), np.zeros(len(points))
    while np.mean(height > 0) < cover:
        size = radius * float(rng.uniform(0.1, 0.4))
        middle, at = rng.uniform(-arc / 2, arc / 2), rng.uniform(0, length)
        around = radius * np.angle(np.exp(1j * (angle - middle)))
        away = np.hypot(around, points[:, 2] - at) / size
        height = np.maximum(height, high * rng.uniform(0.4, 1) * np.sqrt(np.maximum(1 - away**2, 0)))
    height *= rng.uniform(0.7, 1.0, len(points))
    points[:, :2] *= 1 + (height / radius)[:, None]
    return _place(rng, [points], ("not inspected", "bare"))


@dataclass(frozen=True)
class Weld:
    """A weld of a pipe and its part."""

    bead: WeldBead
    part: Part


_LOW, _HIGH = np.sqrt(1 - 0.1), np.sqrt(1 - 0.5)
TOES = float(_LOW + 0.1 * (_LOW - _HIGH) / (0.5 - 0.1))
"""Distance of the toes of a parabola divided by its width: lines through 10 and 50 % of its height end beyond it."""


def weld(rng: np.random.Generator) -> Weld:
    """A girth or seam weld of a pipe: 6 to 12 point spacings wide, 1 to 4 % of the radius high."""
    radius = float(rng.uniform(60, 160))
    spacing = radius * float(rng.uniform(0.012, 0.02))
    width, height = spacing * float(rng.uniform(6, 12)), radius * float(rng.uniform(0.01, 0.04))
    along, angle = radius * float(rng.uniform(-0.2, 0.2)), float(rng.uniform(-np.pi, np.pi))
    if girth := rng.random() < 0.5:
        bead = WeldBead(height_mm=height, width_mm=width, along_mm=along, lean_mm=radius * float(rng.uniform(0, 0.05)))
    else:
        bead = WeldBead(height_mm=height, width_mm=width, angle=angle)
    axis, noise = rng.standard_normal(3).tolist(), float(rng.uniform(0.01, 0.05))
    pipe = scan_pipe(
        rng, axis=axis, radius_mm=radius, length_mm=2 * radius, spacing_mm=spacing, noise_mm=noise, bumps=[bead]
    )

    def covers(places: np.ndarray) -> np.ndarray:
        at, around = pipe.own_places(places)
        if girth:
            return np.abs(at - along - bead.lean_mm * np.cos(around)) < width
        return np.abs(radius * np.angle(np.exp(1j * (around - angle)))) < width

    truth = Truth(values={"height": height, "width": TOES * width}, covers=covers)
    return Weld(bead, Part(points_mm=pipe.points_mm, frame=pipe.frame, line=pipe.line, truths=(truth,)))


KINDS: dict[str, Callable[[np.random.Generator], Part]] = {
    "bend": elbow,
    "T-piece": tee,
    "flanged end": flanged_end,
    "reducer": reducer,
    "marine growth": growth,
    "weld": lambda rng: weld(rng).part,
}
"""Kinds of parts by their names in the table of results."""
