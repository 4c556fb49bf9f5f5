"""Draws of damaged pipes, and of parts like them, over axis, size, spacing and noise, with their true values.

A kind is a function of a random generator that returns a `Part`; `KINDS` lists them for the study
docs/studies/inspection_verdicts.py and for the tests. With NumPy only.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from tests.oracles.pipes import Bump, Gouge, Patch, Profile, Relief, ScannedPipe, scan_pipe


@dataclass(frozen=True, kw_only=True)
class Truth:
    """Something that is there: true values by their names, and whether places (M, 3) in the cloud belong to it."""

    values: dict[str, float]
    covers: Callable[[np.ndarray], np.ndarray]


@dataclass(frozen=True, kw_only=True)
class Part:
    """A scanned part of N points with its truths.

    One of the words ``names`` must stand in the notes or in the refusal, such as the name of a part that is no straight
    pipe. Without any, the inspection must not refuse.
    """

    points_mm: np.ndarray
    frame: np.ndarray
    line: np.ndarray
    truths: tuple[Truth, ...] = ()
    names: tuple[str, ...] = ()
    options: dict[str, Any] = field(default_factory=dict)


def of_pipe(pipe: ScannedPipe, *reliefs: Relief, reach_mm: float = 2.0) -> Part:
    """Return the part of a scanned pipe, with the greatest depth of each relief on a fine grid as its true value.

    Places up to ``reach_mm`` beside a relief belong to it.
    """
    along, _ = pipe.own_places(pipe.points_mm)
    low, high = along.min() - 60, along.max() + 60
    count = [int((high - low) / 0.2), int(2 * np.pi * pipe.radius_mm / 0.2)]
    sides = np.linspace(low, high, count[0]), np.linspace(-np.pi, np.pi, count[1])
    steps = reach_mm * np.array([(a, b) for a in (-1, -0.5, 0, 0.5, 1) for b in (-1, -0.5, 0, 0.5, 1)])
    truths = []
    for relief in reliefs:
        depth = _greatest_depth(relief, *sides, pipe.radius_mm)

        def covers(places: np.ndarray, relief: Relief = relief, depth: float = depth) -> np.ndarray:
            at, around = pipe.own_places(places)
            near = [relief.heights(at + a, around + b / pipe.radius_mm, pipe.radius_mm) for a, b in steps]
            return np.max(np.abs(near), axis=0) > 1e-3 * abs(depth)

        truths.append(Truth(values={"depth": depth}, covers=covers))
    return Part(points_mm=pipe.points_mm, frame=pipe.frame, line=pipe.line, truths=tuple(truths))


def _greatest_depth(relief: Relief, along_mm: np.ndarray, angle: np.ndarray, radius_mm: float) -> float:
    """Return the depth on a grid, searched where every eighth point of it shows the relief, and a cell around."""
    coarse = np.abs(relief.heights(*np.meshgrid(along_mm[::8], angle[::8], indexing="ij"), radius_mm))
    shown = np.nonzero(coarse > 1e-3 * coarse.max())
    near = (
        side[8 * max(at.min() - 1, 0) : 8 * (at.max() + 2)] for side, at in zip((along_mm, angle), shown, strict=True)
    )
    return -float(np.min(relief.heights(*np.meshgrid(*near, indexing="ij"), radius_mm)))


def _draw_pipe(rng: np.random.Generator, *, points: float = 12_000) -> dict[str, Any]:
    """Return the options of a scan with any axis, radius, noise, and a spacing for a number of points."""
    radius = float(rng.uniform(40, 160))
    length = float(rng.uniform(1.5, 3.0)) * radius
    spacing = float(np.sqrt(2 * np.pi * radius * length / (points * rng.uniform(0.7, 1.5))))
    axis = rng.standard_normal(3)
    sizes = {"radius_mm": radius, "length_mm": length, "spacing_mm": spacing}
    return {"axis": axis.tolist(), "noise_mm": float(rng.uniform(0.01, 0.05))} | sizes


def _draw_pit(rng: np.random.Generator, scan: dict[str, Any], along_mm: float, angle: float) -> Bump:
    diameter = scan["spacing_mm"] * float(rng.uniform(7, 14))
    depth = float(rng.uniform(0.05, 0.2)) * diameter
    profile: Profile = "cosine" if rng.random() < 0.5 else "paraboloid"
    return Bump(along_mm=along_mm, angle=angle, diameter_mm=diameter, height_mm=-depth, profile=profile)


def _scan(rng: np.random.Generator, scan: dict[str, Any], reliefs: Sequence[Relief], **options: Any) -> Part:
    reach = max(2.0, 1.5 * scan["spacing_mm"])
    return of_pipe(scan_pipe(rng, **scan, bumps=reliefs, **options), *reliefs, reach_mm=reach)


def clean_pipe(rng: np.random.Generator) -> Part:
    """An undamaged pipe; half of them seen over a part of the circumference."""
    arc = 2 * np.pi if rng.random() < 0.5 else float(rng.uniform(1.5, 4.5))
    return _scan(rng, _draw_pipe(rng), [], arc=arc)


def border_pits(rng: np.random.Generator) -> Part:
    """Pits cut by an end of the scan, by the end of the arc, and by a hole; their middles are seen or not."""
    scan, arc = _draw_pipe(rng), float(rng.uniform(3.0, 5.0))
    half, radius = 0.5 * scan["length_mm"], scan["radius_mm"]
    pits = [_draw_pit(rng, scan, 0.0, 0.0) for _ in range(4)]

    def cut(pit: Bump) -> float:
        """Return a distance of a middle from a border, mm, positive inside; a sixth to five sixths are seen."""
        return 0.5 * pit.diameter_mm * float(rng.uniform(-0.65, 0.65))

    placed = [
        (half - cut(pits[0]), arc * 0.5),
        (-half + cut(pits[1]), arc * 0.5),
        (0.0, cut(pits[2]) / radius),
        (0.0, 0.5 * arc),
    ]
    pits = [
        Bump(along_mm=at, angle=around, diameter_mm=p.diameter_mm, height_mm=p.height_mm, profile=p.profile)
        for p, (at, around) in zip(pits, placed, strict=True)
    ]
    hole = pits[3].diameter_mm * float(rng.uniform(0.4, 1.0))
    holes = [(pits[3].along_mm + 0.5 * hole + cut(pits[3]), pits[3].angle, hole)]
    return _scan(rng, scan, pits, arc=arc, holes=holes)


def deep_dent(rng: np.random.Generator) -> Part:
    """A smooth dent of 2 to 15 % of the diameter."""
    scan = _draw_pipe(rng)
    radius = scan["radius_mm"]
    depth, width = 2 * radius * float(rng.uniform(0.02, 0.15)), radius * float(rng.uniform(0.7, 1.4))
    profile: Profile = "cosine" if rng.random() < 0.5 else "bell"
    at = float(rng.uniform(-0.1, 0.1)) * scan["length_mm"]
    # A bell has 1 % of its depth at its full width.
    dent = Bump(along_mm=at, angle=float(rng.uniform(0, 6)), diameter_mm=width, height_mm=-depth, profile=profile)
    return _scan(rng, scan, [dent])


def deep_pit(rng: np.random.Generator) -> Part:
    """A pit of 4 to 15 % of the diameter's depth in a small pipe."""
    scan = _draw_pipe(rng, points=20_000)
    scan |= {"radius_mm": (radius := float(rng.uniform(30, 60))), "length_mm": 3 * radius}
    scan["spacing_mm"] = float(np.sqrt(6 * np.pi * radius**2 / 20_000))
    depth, width = 2 * radius * float(rng.uniform(0.04, 0.15)), 2 * radius * float(rng.uniform(0.15, 0.3))
    at, angle = float(rng.uniform(-0.5, 0.5)) * radius, float(rng.uniform(0, 6))
    return _scan(rng, scan, [Bump(along_mm=at, angle=angle, diameter_mm=width, height_mm=-depth)])


def gouges(rng: np.random.Generator) -> Part:
    """Two gouges in any direction, each one finding."""
    scan = _draw_pipe(rng)
    drawn = []
    for k in range(2):
        width = scan["spacing_mm"] * float(rng.uniform(5, 9))
        drawn.append(
            Gouge(
                along_mm=float(rng.uniform(-0.1, 0.1)) * scan["length_mm"], angle=k * np.pi + float(rng.uniform(0, 1)),
                turn=float(rng.uniform(0, np.pi)), length_mm=scan["length_mm"] * float(rng.uniform(0.3, 0.6)),
                width_mm=width, depth_mm=width * float(rng.uniform(0.06, 0.2)),
            )
        )  # fmt: skip
    return _scan(rng, scan, drawn)


def corroded_patch(rng: np.random.Generator) -> Part:
    """A patch of general corrosion, one finding."""
    scan = _draw_pipe(rng)
    spacing, radius = scan["spacing_mm"], scan["radius_mm"]
    patch = Patch(
        along_mm=float(rng.uniform(-0.1, 0.1)) * scan["length_mm"], angle=float(rng.uniform(0, 6)),
        length_mm=radius * float(rng.uniform(0.5, 1.2)), width_mm=radius * float(rng.uniform(0.5, 1.2)),
        depth_mm=spacing * float(rng.uniform(0.3, 1.2)), grain_mm=spacing * float(rng.uniform(8, 16)),
        seed=int(rng.integers(1 << 30)),
    )  # fmt: skip
    return _scan(rng, scan, [patch])


def sparse_pits(rng: np.random.Generator) -> Part:
    """Pits with few points, each many standard deviations deep."""
    scan = _draw_pipe(rng)
    length, spacing = scan["length_mm"], scan["spacing_mm"]
    pits = [
        Bump(
            along_mm=float(rng.uniform(-0.3, 0.3)) * length, angle=2.0 * k,
            diameter_mm=spacing * float(rng.uniform(2.5, 5)), height_mm=-scan["noise_mm"] * float(rng.uniform(40, 100)),
            profile="paraboloid",
        )
        for k in range(3)
    ]  # fmt: skip
    return _scan(rng, scan, pits)


def overlapping_pits(rng: np.random.Generator) -> Part:
    """Two pits of the same depth that overlap: one finding, as deep as one of them."""
    scan = _draw_pipe(rng)
    first = _draw_pit(rng, scan, 0.0, float(rng.uniform(0, 6)))
    apart, turn = first.diameter_mm * float(rng.uniform(0.6, 0.9)), float(rng.uniform(0, np.pi))
    second = Bump(
        along_mm=apart * np.cos(turn), angle=first.angle + apart * np.sin(turn) / scan["radius_mm"],
        diameter_mm=first.diameter_mm, height_mm=first.height_mm, profile=first.profile,
    )  # fmt: skip
    return _scan(rng, scan, [Deepest(first, second)])


@dataclass(frozen=True)
class Deepest:
    """The deeper one of two reliefs at each place."""

    first: Relief
    second: Relief

    def heights(self, along_mm: np.ndarray, angle: np.ndarray, radius_mm: float) -> np.ndarray:
        """Return heights (N,) above the plain pipe at positions along and around it."""
        return np.minimum(*(each.heights(along_mm, angle, radius_mm) for each in (self.first, self.second)))


KINDS: dict[str, Callable[[np.random.Generator], Part]] = {
    "clean pipe": clean_pipe,
    "pits cut by a border": border_pits,
    "dent of 2 to 15 % of the diameter": deep_dent,
    "pit of 4 to 15 % of the diameter": deep_pit,
    "gouges": gouges,
    "patch of corrosion": corroded_patch,
    "pits with few points": sparse_pits,
    "overlapping pits": overlapping_pits,
}
"""Kinds of parts by their names in the table of results."""
