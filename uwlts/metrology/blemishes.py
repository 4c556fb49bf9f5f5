"""Depth, extent and lost metal of a blemish on an unrolled surface, with uncertainty.

The surface is a local quadratic through the points near each place of a grid; the undamaged surface is a plane through
the points around the blemish. Both are sums over the points, so that the points' errors run through to every value: by
each pattern that all points share, and by noise drawn anew (GUM Supplement 1, JCGM 101:2008).
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from scipy import ndimage, sparse
from scipy.spatial import KDTree

from uwlts.metrology.blemish_search import BlemishSearch, Indication, UnrolledSurface
from uwlts.metrology.features import FeatureKind, FeatureValue
from uwlts.metrology.least_squares import MAD_TO_STD
from uwlts.metrology.propagation import NormalErrors, plain_value
from uwlts.model.errors import EvaluationError

_DRAWS, _SEED = 48, 635
"""The standard deviation of so many is right to 10 %."""
_BANDWIDTH, _POINTS = 0.35, 150
"""Radius of the local quadratic in the blemish's, with which it lowers the depth of a bell by 0.3 %, or less where a
smaller one holds so many points: with these the noise is a sixth of one point's."""
_EDGE_SHARE, _EDGE_STD = 0.1, 3.0
"""Depth of the contour: a tenth of the blemish's, as metal loss is boxed in pipe inspection, and above the noise."""
_RING = 0.6
"""Width of the surroundings in the blemish's radius."""
_FEWEST = 12
_TUKEY = 4.685
_MOST_VARIANCE = 12.0
"""Of a quadratic's value times the number of its points; amid them it is 3 to 5."""
_CELLS = 26
"""Cells of the grid across the blemish."""
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
    errors: NormalErrors,
    *,
    diameter_mm: float,
    wall_mm: float | None = None,
) -> Blemish | None:
    """Values of an indication, or None where too few points lie around it for an undamaged surface."""
    try:
        field = _Field.about(surface, search, indication)
    except EvaluationError:
        return None
    sign = float(np.sign(indication.height_mm))
    heights = surface.heights[field.near]
    depths = sign * field.depths(heights)
    deepest = int(np.argmax(np.where(field.region, depths, -np.inf)))
    depth = float(depths[deepest])
    # Single points that, were they independent, would scatter local means as these do.
    noise = indication.noise_mm * surface.std[field.near] / float(np.median(surface.std))
    by_noise = np.sqrt(np.asarray(field.rows.power(2) @ noise**2).ravel())
    edge = max(_EDGE_SHARE * depth, _EDGE_STD * float(np.median(by_noise)))
    plain = field.figures(depths, edge, deepest)
    rng, own = np.random.default_rng(_SEED), errors[field.near]
    drawn = []
    for _ in range(_DRAWS):
        moves = rng.standard_normal(len(noise)) * noise
        moves += own.drawn_of_images(rng)
        drawn.append(field.figures(depths + sign * field.depths(moves), edge, None) - plain)
    # Half of the middle 68 %: some draws let the contour run into its neighbour.
    random = 0.5 * np.diff(np.quantile(drawn, [0.1587, 0.8413], axis=0), axis=0)[0]
    # A noisy contour reaches farther, by about as much as it does with as much noise again; wider quadratics show what
    # these blur.
    bias, blur = np.median(drawn, axis=0), field.figures(sign * field.wide @ heights, edge, None) - plain
    bias[0] = blur[0] = 0.0
    seen, plain, random = plain, np.maximum(plain - bias, 0), np.sqrt(random**2 + bias**2 + blur**2)
    # The depth at its own place: the deepest of a noisy surface is too deep.
    at = np.array([sign * field.depths_at(deepest, moves) for moves in _draws(rng, noise, own)])
    random[0] = float(np.std(at, ddof=1))
    # A quadratic over a radius cuts the bottom by its fourth power: Richardson's estimate from a narrower one.
    cut = field.richardson * (float(sign * field.narrow @ heights) - depth)
    random[0] = float(np.hypot(random[0], cut))
    common = None
    if own.patterns_mm is not None:
        moved = [field.figures(depths + sign * field.depths(p), edge, deepest) - seen for p in own.patterns_mm]
        common = np.sqrt(np.sum(np.square(moved), axis=0))
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


def _draws(rng: np.random.Generator, noise: np.ndarray, own: NormalErrors) -> list[np.ndarray]:
    return [rng.standard_normal(len(noise)) * noise + own.drawn_of_images(rng) for _ in range(_DRAWS)]


@dataclass(frozen=True, eq=False)
class _Field:
    """Depths on a grid (G, 2) of shape ``shape`` as sums over the points ``near`` (n,), by ``rows`` (G, n).

    ``region`` (G,) are the cells of the blemish, ``narrow`` (n,) the row of the deepest place by a narrower quadratic,
    ``richardson`` the factor of the difference that leads to none at all, ``stride`` half a bandwidth in cells,
    ``wide`` (G, n) the rows of wider quadratics.
    """

    near: np.ndarray
    grid: np.ndarray
    shape: tuple[int, int]
    cell: float
    rows: sparse.csr_array
    narrow: np.ndarray
    richardson: float
    stride: int
    wide: sparse.csr_array
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
            raise EvaluationError("too few points around")
        near = np.concatenate([indication.points, around])
        middle = 0.5 * (low + high)
        places, heights = surface.places[near] - middle, surface.heights[near]
        ring = np.arange(len(near)) >= len(indication.points)
        plane = _plane(places, heights, ring)
        dense = len(indication.points) / max(float(np.prod(high - low)), 1e-9)
        bandwidth = max(min(_BANDWIDTH * radius, float(np.sqrt(_POINTS / np.pi / dense))), search.smallest_mm)
        cell = float(np.max(high - low)) / _CELLS
        sides = [np.arange(a - cell, b + 2 * cell, cell) for a, b in zip(low - middle, high - middle, strict=True)]
        shape = len(sides[0]), len(sides[1])
        grid = np.stack(np.meshgrid(*sides, indexing="ij"), axis=-1).reshape(-1, 2)
        tree = KDTree(places)
        smooth = _quadratic_rows(grid, places, tree, bandwidth)
        base = sparse.csr_array(np.column_stack([np.ones(len(grid)), grid]) @ plane)
        rows = sparse.csr_array(smooth - base)
        wide = sparse.csr_array(_quadratic_rows(grid, places, tree, np.sqrt(2) * bandwidth) - base)
        region = KDTree(places[~ring]).query(grid)[0] < bandwidth
        depths = np.sign(indication.height_mm) * (rows @ heights)
        deepest = int(np.argmax(np.where(region, depths, -np.inf)))
        at = grid[deepest : deepest + 1]
        narrower = max(bandwidth / np.sqrt(2), 0.8 * search.smallest_mm)
        narrow = _quadratic_rows(at, places, tree, narrower)
        row = np.asarray((narrow - sparse.csr_array(np.column_stack([[1.0], at]) @ plane)).todense()).ravel()
        stride = max(1, round(0.5 * bandwidth / cell))
        share = 1 / (1 - (narrower / bandwidth) ** 4)
        return cls(near, grid + middle, shape, cell, rows, row, share, stride, wide, region)

    def depths(self, heights: np.ndarray) -> np.ndarray:
        """Heights (G,) over the undamaged surface for heights (n,) of the points."""
        return self.rows @ heights

    def depths_at(self, cell: int, heights: np.ndarray) -> float:
        """The same in one cell."""
        return float((self.rows[[cell]] @ heights)[0])

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

    def figures(self, depths: np.ndarray, edge: float, deepest: int | None) -> np.ndarray:
        """Depth, length, width, area and lost area of depths (G,) within the contour of an edge's depth.

        The depth is that of a given cell, or the largest.
        """
        inside = (np.where(self.region, depths, -np.inf) > edge).reshape(self.shape)
        top = int(np.argmax(np.where(self.region, depths, -np.inf))) if deepest is None else deepest
        labelled: Any = ndimage.label(inside, structure=np.ones((3, 3)))
        labels = labelled[0]
        label, depth = labels[np.unravel_index(top, self.shape)], self.vertex(depths, top)
        if label == 0:
            return np.array([depth, 0.0, 0.0, 0.0, 0.0])
        grown = ndimage.binary_dilation(labels == label, structure=np.ones((3, 3)))
        field = np.where(grown, depths.reshape(self.shape), -np.inf)
        length, lost = _crossing(field.max(axis=1), edge, self.cell)
        width, _ = _crossing(field.max(axis=0), edge, self.cell)
        slopes = np.gradient(depths.reshape(self.shape), self.cell)
        steep = np.maximum(np.hypot(*slopes) * self.cell, 1e-9)
        share = np.clip((np.where(grown, depths.reshape(self.shape), -1e9) - edge) / steep + 0.5, 0, 1)
        return np.array([depth, length, width, float(share.sum()) * self.cell**2, lost])


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


def _plane(places: np.ndarray, heights: np.ndarray, ring: np.ndarray) -> np.ndarray:
    """Rows (3, n) whose products with heights are the coefficients of the plane through the ring, outliers aside."""
    design = np.column_stack([np.ones(len(places)), places])
    weight = ring.astype(float)
    rows = np.zeros((3, len(places)))
    for _ in range(8):
        normal = (design * weight[:, None]).T @ design
        rows = np.linalg.pinv(normal, rcond=1e-10, hermitian=True) @ (design * weight[:, None]).T
        left = heights - design @ (rows @ heights)
        spread = max(MAD_TO_STD * float(np.median(np.abs(left[ring]))), 1e-12)
        weight = ring * np.square(np.clip(1 - np.square(left / (_TUKEY * spread)), 0, None))
    return rows


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
