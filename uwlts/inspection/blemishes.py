"""Depth, extent and lost metal of a blemish on an unrolled surface, with uncertainty.

The surface is a local quadratic through the points near each place of a grid; the undamaged surface is a plane through
the points around the blemish. What the quadratic and the footprint of each point smooth is put back: what points would
see of the surface that was found is taken off them, and the rest, smoothed, is added to it (twicing: Tukey, Exploratory
Data Analysis, 1977, 16C; Van Cittert, Z. Phys. 69, 1931). All are sums over the points, so that the points' errors run
through to every value: by each pattern that all points share, and by noise drawn anew (GUM Supplement 1, JCGM
101:2008).
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import numpy as np
from scipy import ndimage, sparse
from scipy.spatial import KDTree

from uwlts.errors import EvaluationError
from uwlts.fitting.least_squares import fit_biweight
from uwlts.fitting.propagation import PointErrors
from uwlts.inspection.blemish_search import BlemishSearch, Indication, UnrolledSurface
from uwlts.inspection.features import COVERAGE, COVERAGE_FACTOR, FeatureKind, FeatureValue, plain_value

_DRAWS = 120
"""Draws of noise: three are beyond either end of a 95 % interval."""
_TO_LEVEL = 48
"""Draws for the noise of depths: their standard deviation is right to 10 %."""
_SEED = 635
"""Of the draws, so that the same cloud has the same values."""
_EXPONENTS = 1, 2, 3
"""Of bells (1 - t^2)^p: from a paraboloid with a sharp edge to one that runs out slowly."""
_BANDWIDTH = 0.35
"""Radius of the local quadratic, relative to the blemish's: it lowers the depth of a bell by 0.3 %."""
_POINTS = 150
"""Points in the local quadratic from which its radius is smaller: the noise is a sixth of one point's."""
_EDGE_SHARE = 0.1
"""Depth of the contour, relative to the blemish's, as metal loss is boxed in pipe inspection."""
_EDGE_STD = 3.0
"""Least depth of the contour in standard deviations of the depths."""
_RING = 0.6
"""Width of the surroundings in the blemish's radius."""
_FEWEST = 12
_NODES = [
    (np.sqrt(3.0) * np.array([a, b]), (2 / 3 if a == 0 else 1 / 6) * (2 / 3 if b == 0 else 1 / 6))
    for a in (-1, 0, 1)
    for b in (-1, 0, 1)
]
"""Places and weights of a normal distribution in two dimensions (Gauss-Hermite, exact to the fifth power)."""
_MOST_VARIANCE = 12.0
"""Of a quadratic's value times the number of its points; amid them it is 3 to 5."""
_CELLS = 26
"""Cells of the grid across the blemish."""
_FINER = 2
"""Parts of a cell in which contours are followed, on a cubic spline."""
_DENT_SHARE = 0.1
"""Of the diameter: a hollow that is longer and wider is called a dent. Shape alone does not tell what made it."""


@dataclass(frozen=True, eq=False)
class Blemish:
    """A measured blemish: its values, its deepest place (2,) and its size along both axes, mm, and its points."""

    kind: FeatureKind
    values: tuple[FeatureValue, ...]
    place: np.ndarray
    extent_mm: np.ndarray
    points: np.ndarray


def measure_blemish(
    surface: UnrolledSurface,
    search: BlemishSearch,
    indication: Indication,
    errors: PointErrors,
    *,
    diameter_mm: float,
    wall_mm: float | None = None,
) -> Blemish:
    """Values of an indication. EvaluationError where too few points lie around it for an undamaged surface."""
    field = _Field.about(surface, search, indication)
    sign = float(np.sign(indication.height_mm))
    heights = sign * surface.heights[field.near]
    depths = field.depths(heights)
    deepest, between = field.deepest(heights)
    depth = float(depths[deepest]) + between
    # Single points that, were they independent, would scatter local means as these do.
    noise = indication.noise_mm * surface.std[field.near] / float(np.median(surface.std))
    rng, own = np.random.default_rng(_SEED), errors[field.near]
    moves = replace(own, single_mm=noise).drawn(_DRAWS, rng)
    inside = np.arange(len(noise)) < len(indication.points)
    scale = np.where(inside, field.scatter_over(heights, moves[:_TO_LEVEL], inside), 1.0)
    moves = [scale * each for each in moves]
    by_noise = np.std([field.depths(each) for each in moves[:_TO_LEVEL]], axis=0, ddof=1)
    edge = max(_EDGE_SHARE * depth, _EDGE_STD * float(np.median(by_noise[field.region])))
    seen = field.figures(depths, edge, deepest)
    seen[0] += between
    # Errors of blemishes of this size, known exactly, that are seen by these points: noise, sampling and smoothing.
    wrong = []
    for move in moves:
        bell = _Bell.like(seen, edge, field.grid[deepest], indication.radius_mm, rng)
        shift = rng.uniform(-0.5, 0.5, 2) * search.smallest_mm
        wrong.append(field.measured(field.seen_of(bell, shift) + move, edge) - bell.figures(edge))
    low, bias, high = np.quantile(wrong, [0.5 - 0.5 * COVERAGE, 0.5, 0.5 + 0.5 * COVERAGE], axis=0)
    random = 0.5 * (high - low) / COVERAGE_FACTOR
    plain = np.maximum(seen - bias, 0)
    # What hangs on the footprint's size.
    resolved = field.figures(field.depths(heights, share=1 - field.footprint_std), edge, deepest) - seen
    resolved[0] += between
    random = np.sqrt(random**2 + bias**2 + resolved**2)

    def changed(pattern: np.ndarray) -> np.ndarray:
        found = field.figures(depths + field.depths(pattern), edge, deepest) - seen
        found[0] += between
        return found

    common = own.by_patterns(changed)
    length, width = plain[1], plain[2]
    kind = FeatureKind.PROTRUSION
    if sign < 0:
        kind = FeatureKind.DENT if min(length, width) >= _DENT_SHARE * diameter_mm else FeatureKind.PIT
    names = ("height" if sign > 0 else "depth", "length", "width", "area", *(("lost area",) if sign < 0 else ()))
    values = [
        plain_value(kind, name, plain[k], random[k], None if common is None else common[k], least=0.0)
        for k, name in enumerate(names)
    ]
    values.insert(1, plain_value(kind, "edge depth", edge, 0.0, None if common is None else 0.0))
    if wall_mm is not None and sign < 0:
        shared = None if common is None else common[0]
        values.append(plain_value(kind, "remaining wall", wall_mm - plain[0], random[0], shared))
    extent = np.array([length, width, depth])
    return Blemish(kind, tuple(values), field.grid[deepest], extent, indication.points)


@dataclass(frozen=True, eq=False)
class _Bell:
    """A blemish depth (1 - t^2)^p of elliptic outline with half axes (2,) about a middle (2,), mm."""

    middle: np.ndarray
    half: np.ndarray
    depth: float
    exponent: int

    @classmethod
    def like(cls, seen: np.ndarray, edge: float, middle: np.ndarray, radius: float, rng: np.random.Generator) -> _Bell:
        """One with the depth, length and width that were ``seen`` at an edge; of the radius where they are zero."""
        exponent = int(rng.choice(_EXPONENTS))
        rim = float(np.sqrt(1 - min(edge / seen[0], 0.99) ** (1 / exponent)))
        half = np.where(seen[1:3] > 0, 0.5 * seen[1:3] / rim, radius)
        return cls(middle, half, float(seen[0]), exponent)

    def at(self, places: np.ndarray) -> np.ndarray:
        """Depths (N,) at places (N, 2)."""
        t2 = np.sum(np.square((places - self.middle) / self.half), axis=1)
        return self.depth * np.maximum(1 - t2, 0) ** self.exponent

    def figures(self, edge: float) -> np.ndarray:
        """Depth; length, width, area and lost area within the contour of an edge's depth."""
        rim = float(np.sqrt(1 - min(edge / self.depth, 1.0) ** (1 / self.exponent)))
        t = np.linspace(0, rim, 101)
        lost = 2 * self.half[0] * self.depth * float(np.trapezoid((1 - t * t) ** self.exponent, t))
        length, width = 2 * self.half * rim
        return np.array([self.depth, length, width, 0.25 * np.pi * length * width, lost])


@dataclass(frozen=True, eq=False)
class _Field:
    """Depths on a grid (G, 2) of shape ``shape`` as sums over the points ``near`` (n,).

    ``places`` and ``size`` (n, 2) are those of the points and their footprints, ``smooth`` (G, n) are local
    quadratics, ``design`` (n, 3) and ``plane`` (3, n) the undamaged plane's terms and their sums over the points,
    ``seen`` (n, G) is what points of their footprint see of depths on the grid, ``sharp`` (n, G) what points without
    one would. ``region`` (G,) are the cells of the blemish, ``stride`` half a bandwidth in cells.
    """

    near: np.ndarray
    places: np.ndarray
    size: np.ndarray
    grid: np.ndarray
    shape: tuple[int, int]
    cell: float
    smooth: sparse.csr_array
    design: np.ndarray
    plane: np.ndarray
    seen: sparse.csr_array
    sharp: sparse.csr_array
    footprint_std: float
    stride: int
    region: np.ndarray

    @classmethod
    def about(cls, surface: UnrolledSurface, search: BlemishSearch, indication: Indication) -> _Field:
        own = surface.places[indication.points]
        low, high = own.min(axis=0), own.max(axis=0)
        radius = 0.25 * float(np.sum(high - low))
        reach = max(_RING * radius, 3 * search.smallest_mm)
        inside = np.all((surface.places > low - reach) & (surface.places < high + reach), axis=1)
        is_own = np.zeros(len(surface.places), bool)
        is_own[indication.points] = True
        around = np.flatnonzero(inside & search.plain)
        around = around[KDTree(own).query(surface.places[around])[0] <= reach]
        if len(around) < _FEWEST:
            raise EvaluationError(f"{len(around)} undamaged points are around it; {_FEWEST} are needed")
        near = np.concatenate([indication.points, around])
        middle = 0.5 * (low + high)
        places, heights = surface.places[near] - middle, surface.heights[near]
        ring = np.arange(len(near)) >= len(indication.points)
        dense = len(indication.points) / max(float(np.prod(high - low)), 1e-9)
        bandwidth = max(min(_BANDWIDTH * radius, float(np.sqrt(_POINTS / np.pi / dense))), search.smallest_mm)
        cell = float(np.max(high - low)) / _CELLS
        sides = [np.arange(a - cell, b + 2 * cell, cell) for a, b in zip(low - middle, high - middle, strict=True)]
        shape = len(sides[0]), len(sides[1])
        grid = np.stack(np.meshgrid(*sides, indexing="ij"), axis=-1).reshape(-1, 2)
        tree = KDTree(places)
        smooth = _quadratic_rows(grid, places, tree, bandwidth)
        region = KDTree(places[~ring]).query(grid)[0] < bandwidth
        stride = max(1, round(0.5 * bandwidth / cell))
        size = surface.footprint_mm[near]
        sharp = seen = _interpolation((places - grid[0]) / cell, shape)
        if np.any(size > 0):
            parts = [weight * _interpolation((places + node * size - grid[0]) / cell, shape) for node, weight in _NODES]
            seen = sparse.csr_array(sum(parts[1:], parts[0]))
        design = np.column_stack([np.ones(len(places)), places])
        plane = fit_biweight(design, heights, ring)[0]
        known = surface.places[near], size, grid + middle, shape, cell
        return cls(near, *known, smooth, design, plane, seen, sharp, surface.footprint_std, stride, region)

    def depths(self, heights: np.ndarray, *, steps: int = 1, share: float = 1.0) -> np.ndarray:
        """Heights (G,) over the undamaged surface for heights (n,) of the points.

        What smoothing hides is put back in so many ``steps``, with a ``share`` of what the footprint makes of that.
        """
        left = heights - self.design @ (self.plane @ heights)
        first = self.smooth @ left
        depths = first
        for _ in range(steps):
            there = self.seen @ depths
            if share != 1.0:
                there = share * there + (1 - share) * (self.sharp @ depths)
            depths = depths + self.smooth @ (left - there)
        return depths

    def deepest(self, heights: np.ndarray) -> tuple[int, float]:
        """The deepest cell of the smooth surface, as a sharp one's noise is too deep, and how much cells miss."""
        smooth = self.depths(heights, steps=0)
        top = int(np.argmax(np.where(self.region, smooth, -np.inf)))
        return top, self.vertex(smooth, top) - float(smooth[top])

    def measured(self, heights: np.ndarray, edge: float) -> np.ndarray:
        """Figures of heights (n,) at their own deepest place."""
        top, between = self.deepest(heights)
        found = self.figures(self.depths(heights), edge, top)
        found[0] += between
        return found

    def scatter_over(self, heights: np.ndarray, moves: list[np.ndarray], inside: np.ndarray) -> float:
        """Scatter of heights (n,) about their depths ``inside`` (n,) over that around it; 1 at least.

        Each is over that of the noise ``moves``, as depths take up a part of it. On the slopes of a blemish a stripe
        scatters more than beside it.
        """

        def squares(each: np.ndarray) -> np.ndarray:
            left = each - self.design @ (self.plane @ each) - self.seen @ self.depths(each)
            return np.array([np.mean(np.square(left[part])) for part in (inside, ~inside)])

        own, around = squares(heights) / np.maximum(np.mean([squares(each) for each in moves], axis=0), 1e-300)
        return max(1.0, float(np.sqrt(own / max(around, 1e-300))))

    def seen_of(self, bell: _Bell, shift: np.ndarray) -> np.ndarray:
        """Heights (n,) that the points, with their footprints, would see of a bell elsewhere."""
        if not np.any(self.size > 0):
            return bell.at(self.places - shift)
        return sum((weight * bell.at(self.places - shift + node * self.size) for node, weight in _NODES), np.zeros(1))

    def vertex(self, depths: np.ndarray, top: int) -> float:
        """Largest depth between the cells: of the parabolas through the deepest cell and its neighbours."""
        field, at = depths.reshape(self.shape), np.array(np.unravel_index(top, self.shape))
        depth = float(field[tuple(at)])
        for step in self.stride * np.eye(2, dtype=int):
            if np.all(at - step >= 0) and np.all(at + step < self.shape):
                before, after = float(field[tuple(at - step)]), float(field[tuple(at + step)])
                bend = before + after - 2 * float(field[tuple(at)])
                if bend < 0 and abs(after - before) <= -bend:
                    depth -= (after - before) ** 2 / (8 * bend)
        return depth

    @cached_property
    def fine_region(self) -> np.ndarray:
        """The cells of the blemish on the grid in which contours are followed."""
        size = [_FINER * (n - 1) + 1 for n in self.shape]
        return np.asarray(ndimage.zoom(self.region.reshape(self.shape), np.divide(size, self.shape), order=0))

    def figures(self, depths: np.ndarray, edge: float, deepest: int) -> np.ndarray:
        """Depth in the ``deepest`` cell; length, width, area and lost area within the contour of an edge's depth."""
        size = [_FINER * (n - 1) + 1 for n in self.shape]
        cell, top = self.cell / _FINER, tuple(_FINER * k for k in np.unravel_index(deepest, self.shape))
        fine = np.asarray(ndimage.zoom(depths.reshape(self.shape), np.divide(size, self.shape), order=3))
        labelled: Any = ndimage.label(self.fine_region & (fine > edge), structure=np.ones((3, 3)))
        labels, depth = labelled[0], float(depths[deepest])
        if (label := labels[top]) == 0:
            return np.array([depth, 0.0, 0.0, 0.0, 0.0])
        grown = ndimage.binary_dilation(labels == label, structure=np.ones((3, 3)))
        field = np.where(grown, fine, -np.inf)
        length, lost = _crossing(field.max(axis=1), edge, cell)
        width, _ = _crossing(field.max(axis=0), edge, cell)
        steep = np.maximum(np.hypot(*np.gradient(fine, cell)) * cell, 1e-9)
        share = np.clip((np.where(grown, fine, -1e9) - edge) / steep + 0.5, 0, 1)
        return np.array([depth, length, width, float(share.sum()) * cell**2, lost])


def _crossing(profile: np.ndarray, edge: float, cell: float) -> tuple[float, float]:
    """Length over which a profile exceeds an edge, between interpolated crossings, and its area there."""
    above = np.flatnonzero(profile > edge)
    if not len(above):
        return 0.0, 0.0
    first, last = int(above[0]), int(above[-1])

    def part(inner: int, outer: int) -> float:
        if not 0 <= outer < len(profile) or not np.isfinite(profile[outer]):
            return 0.5
        return float((profile[inner] - edge) / max(profile[inner] - profile[outer], 1e-12))

    ends = part(first, first - 1), part(last, last + 1)
    length = cell * (last - first + sum(ends))
    body = float(np.trapezoid(np.maximum(profile[first : last + 1], 0), dx=cell))
    rims = sum(cell * end * 0.5 * (edge + float(profile[k])) for end, k in zip(ends, (first, last), strict=True))
    return length, body + rims


def _interpolation(places: np.ndarray, shape: tuple[int, int]) -> sparse.csr_array:
    """Rows (n, G) of values on a grid at places (n, 2) in cells, exact for quadratics; nothing beyond its border.

    Cubic convolution (Keys, IEEE Transactions on Acoustics, Speech and Signal Processing 29, 1981, Eq. 15).
    """
    first = np.floor(places).astype(int)
    steps = np.arange(-1, 3)
    away = np.abs((places - first)[:, :, None] - steps)
    weight = np.where(away <= 1, (1.5 * away - 2.5) * away**2 + 1, ((-0.5 * away + 2.5) * away - 4) * away + 2)
    at = first[:, :, None] + steps
    weight = np.where((at >= 0) & (at < np.array(shape)[:, None]), weight, 0.0)
    at = np.clip(at, 0, np.array(shape)[:, None] - 1)
    columns = (at[:, 0, :, None] * shape[1] + at[:, 1, None, :]).reshape(len(places), -1)
    values = (weight[:, 0, :, None] * weight[:, 1, None, :]).reshape(len(places), -1)
    rows = np.repeat(np.arange(len(places)), columns.shape[1])
    return sparse.csr_array((values.ravel(), (rows, columns.ravel())), shape=(len(places), shape[0] * shape[1]))


def _quadratic_rows(grid: np.ndarray, places: np.ndarray, tree: KDTree, bandwidth: float) -> sparse.csr_array:
    """Rows (G, n) whose products with heights are the values of local quadratics at the grid's places.

    Weights are Epanechnikov's; where fewer than nine points are near, the mean of the three nearest is taken.
    """
    columns, values, starts = [], [], [0]
    nearest: Any = tree.query(grid, k=3)
    for place, close, fallback in zip(grid, tree.query_ball_point(grid, bandwidth), nearest[1], strict=True):
        chosen = np.asarray(close, np.intp)
        away = (places[chosen] - place) / bandwidth if len(chosen) >= 9 else np.zeros((0, 2))
        row = None
        if len(away):
            u, v = away.T
            design = np.stack([np.ones(len(u)), u, v, u * u, u * v, v * v], axis=1)
            weight = np.maximum(1 - u * u - v * v, 0)
            normal = (design * weight[:, None]).T @ design
            if np.linalg.cond(normal) < 1e8:
                row = np.linalg.solve(normal, np.eye(6)[0]) @ (design * weight[:, None]).T
                # Beside the points a quadratic runs away.
                row = row if row @ row < _MOST_VARIANCE / len(chosen) else None
        if row is None:
            chosen, row = fallback, np.full(3, 1 / 3)
        columns.append(chosen)
        values.append(row)
        starts.append(starts[-1] + len(chosen))
    parts = np.concatenate(values), np.concatenate(columns), np.array(starts)
    return sparse.csr_array(parts, shape=(len(grid), len(places)))
