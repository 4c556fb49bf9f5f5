"""Search for pits and protrusions on an unrolled surface, at all sizes, with a stated probability of a false alarm.

At every place and for every size the depth of a bell (1 - t^2)^2 is fitted together with a tilted plane through its
surroundings (a matched filter that needs no full sampling). Over its local scatter this is a random field of unit
variance where nothing is, and the probability that it exceeds a level anywhere on the area is the expected Euler
characteristic of what lies above (Adler and Taylor, Random Fields and Geometry, 2007; Worsley et al., Human Brain
Mapping 4, 1996, Table I). So the threshold follows from the probability, not the other way round.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from scipy import fft, ndimage, optimize, stats
from scipy.spatial import KDTree

from uwlts.errors import EvaluationError
from uwlts.fitting.least_squares import MAD_TO_STD, fit_biweight, robust_std

_POINTS_IN_SMALLEST = 12
"""Points in the disc of the smallest size: three profiles or more where points are far denser along than across."""
_CELLS_PER_RADIUS = 3
_WINDOW = 1.8
"""Radius of the fitted surroundings in those of the bell."""
_RATIO = np.sqrt(2.0)
"""Of sizes that follow each other: the bell of one size keeps 95 % of its signal in the next."""
_LEAST_INFORMATION = 0.4
"""Of the usual information on a bell's depth: with less the place is at an edge or in a hole."""
_BLOCK = 24.0
"""Side of the squares in which the local scatter is taken, in radii: some 180 independent places."""
_MAD_EFFICIENCY = 0.37
"""Efficiency of the median absolute deviation at the normal distribution (Huber, Robust Statistics, 1981, 5.1)."""
_LARGEST_SHARE = 1 / 6
"""Of the area's shorter side: larger bells leave no surroundings."""
_MOST_CELLS = 4_000_000
_ROUNDS = 10
_FEWEST = 6
"""Points of an indication."""
_NEIGHBOURS = 9
"""Nearest points with which each is compared."""
_OUTLIER = 6.0
"""Robust standard deviations from their median that make an outlier."""
_EDGE_SHARE = 0.1
"""Of a blemish's depth, where its region ends."""
_GROWN = 3
"""Times that the window about a peak grows at most, if its region reaches the edge."""
_GROWTH = 1.7
"""Growth of the window's side."""
_CORE = 0.8
"""Of the bell's radius: points that belong to the peak in any case."""
_EDGE_STD = 3.0
"""Standard deviations of a cell's mean from which it belongs to a blemish that holds its neighbour."""


@dataclass(frozen=True, eq=False)
class UnrolledSurface:
    """An unrolled surface: places (N, 2) in mm, heights (N,) over the undamaged shape, and standard deviations (N,).

    ``footprint_mm`` (N, 2) are standard deviations along both axes of the part of the surface that a point is the mean
    of, zero where not known; ``footprint_std`` is the relative standard uncertainty of their squares.
    """

    places: np.ndarray
    heights: np.ndarray
    std: np.ndarray
    footprint_mm: np.ndarray
    footprint_std: float = 0.0


@dataclass(frozen=True, eq=False)
class Indication:
    """A place where a surface departs from its shape: its middle (2,), radius, signed height, and its points.

    ``z`` is its height in standard deviations, ``false_alarm`` the probability that noise exceeds it anywhere;
    ``noise_mm`` the standard deviation of a point that gives the local means their scatter.
    """

    place: np.ndarray
    radius_mm: float
    height_mm: float
    z: float
    false_alarm: float
    noise_mm: float
    points: np.ndarray


@dataclass(frozen=True, eq=False)
class Unresolved:
    """A significant departure whose region was not found: the nearest point, its signed height, and why."""

    point: int
    height_mm: float
    reason: str


@dataclass(frozen=True, eq=False)
class BlemishSearch:
    """Indications, and significant departures that became none.

    ``outliers`` (N,) bool are outliers, ``plain`` (N,) bool the points that are none and belong to no indication.
    ``level_mm`` (N,) is the depth from which the smallest size counts, ``noise_mm`` (N,) a point's effective noise.
    """

    indications: tuple[Indication, ...]
    unresolved: tuple[Unresolved, ...]
    outliers: np.ndarray
    plain: np.ndarray
    level_mm: np.ndarray
    noise_mm: np.ndarray
    smallest_mm: float
    false_alarm: float


def search_blemishes(surface: UnrolledSurface, *, false_alarm: float) -> BlemishSearch:
    """Find where a surface departs from its shape.

    ``false_alarm`` is the probability that anything is found, inwards or outwards, where nothing is. The most
    significant are taken first and their points left out of all that follows, until nothing is left.
    """
    places, tree = surface.places, KDTree(surface.places)
    if len(places) < 20 * _POINTS_IN_SMALLEST:
        raise EvaluationError(f"{len(places)} points are too few to search for blemishes")
    outliers = _isolated(surface, tree)
    smallest = float(np.median(tree.query(places[:: max(1, len(places) // 2000)], k=_POINTS_IN_SMALLEST)[0][:, -1]))
    largest = max(_LARGEST_SHARE * float(np.min(np.ptp(places, axis=0))), smallest)
    # A mesh of cells that memory cannot hold is not needed to see the larger sizes.
    area = float(np.prod(np.ptp(places, axis=0)))
    smallest = max(smallest, _CELLS_PER_RADIUS * float(np.sqrt(area / _MOST_CELLS)))
    radii = smallest * _RATIO ** np.arange(1 + max(0, int(np.log(largest / smallest) / np.log(_RATIO))))
    plain, found, unresolved = ~outliers, [], []
    maps: list[_Map] = []
    threshold = np.inf
    for number in range(_ROUNDS + 1):
        maps = [_matched(surface, plain, radius) for radius in radii]
        maps = [each for each in maps if each.area_mm2 > 0]
        if not maps:
            break
        threshold = _threshold(maps, false_alarm)
        peaks = _chosen(maps, threshold)
        if not peaks:
            break
        for peak in peaks:
            try:
                if number == _ROUNDS:
                    raise EvaluationError(f"{_ROUNDS} rounds of the search did not come to an end there")
                found.append(_indication(surface, plain, tree, maps, peak, smallest))
                points = found[-1].points
            except EvaluationError as error:
                unresolved.append(Unresolved(int(tree.query(peak.place)[1]), peak.height, str(error)))
                points = tree.query_ball_point(peak.place, peak.radius)
            plain[points] = False
    level, noise = np.full(len(places), np.nan), np.full(len(places), np.nan)
    if maps:
        level = threshold * maps[0].level_at(places)
        noise = maps[0].noise_at(places)
    known = tuple(found), tuple(unresolved), outliers, plain, level, noise
    return BlemishSearch(*known, smallest, false_alarm)


def _isolated(surface: UnrolledSurface, tree: KDTree) -> np.ndarray:
    """Points (N,) bool that stand alone off their neighbours, on slopes measured by how these scatter."""
    found: Any = tree.query(surface.places, k=_NEIGHBOURS + 1)
    nearest = found[1][:, 1:]
    beside = surface.heights[nearest]
    middle = np.median(beside, axis=1)
    spread = MAD_TO_STD * np.median(np.abs(beside - middle[:, None]), axis=1)
    usual = float(np.median(spread))
    return np.abs(surface.heights - middle) > _OUTLIER * np.maximum(spread, usual)


@dataclass(frozen=True, eq=False)
class _Map:
    """Fitted bells of one radius on a grid of places: heights, information (1 / variance for unit noise), the local
    mean and standard deviation of height times root information, significance z as of a normal variable, and the
    area, half perimeters and root spectral moments that give false alarms."""

    radius: float
    origin: np.ndarray
    cell: float
    height: np.ndarray
    information: np.ndarray
    spread: np.ndarray
    z: np.ndarray
    area_mm2: float
    moments: np.ndarray
    sides: np.ndarray

    def false_alarms(self, level: float) -> float:
        """Expected Euler characteristic of where either sign exceeds a level."""
        bell = np.exp(-0.5 * level**2)
        flat = self.area_mm2 * float(np.prod(self.moments)) * level * bell / (2 * np.pi) ** 1.5
        edge = float(self.sides @ self.moments) * bell / (2 * np.pi)
        return 2 * (flat + edge + float(stats.norm.sf(level)))

    def _cells(self, places: np.ndarray) -> tuple[np.ndarray, ...]:
        at = np.floor((places - self.origin) / self.cell).astype(int)
        return tuple(np.clip(at.T, 0, np.array(self.z.shape)[:, None] - 1))

    def level_at(self, places: np.ndarray) -> np.ndarray:
        """Standard deviation (N,) of a bell's height at places."""
        at = self._cells(places)
        with np.errstate(invalid="ignore", divide="ignore"):
            return np.where(np.isfinite(self.z[at]), self.spread[at] / np.sqrt(self.information[at]), np.nan)

    def noise_at(self, places: np.ndarray) -> np.ndarray:
        """Effective standard deviation (N,) of a point of unit weight at places."""
        return self.spread[self._cells(places)]


def _matched(surface: UnrolledSurface, plain: np.ndarray, radius: float) -> _Map:
    cell = radius / _CELLS_PER_RADIUS
    places = surface.places[plain]
    origin = surface.places.min(axis=0) - 0.5 * cell
    shape = tuple((np.floor(np.ptp(surface.places, axis=0) / cell).astype(int) + 2).tolist())
    # Weights over those of the usual point: heights stay in mm, and the scatter is that of such a point.
    weight = np.square(np.median(surface.std) / surface.std[plain])
    flat = np.ravel_multi_index(tuple(np.floor((places - origin) / cell).astype(int).T), shape)
    size = int(np.prod(shape))
    mass = np.bincount(flat, weight, size).reshape(shape)
    load = np.bincount(flat, weight * surface.heights[plain], size).reshape(shape)
    reach = int(np.ceil(_WINDOW * _CELLS_PER_RADIUS))
    axis = np.arange(-reach, reach + 1) / _CELLS_PER_RADIUS
    u, v = np.meshgrid(axis, axis, indexing="ij")
    window = (np.hypot(u, v) <= _WINDOW).astype(float)
    bell = np.square(np.maximum(1 - u**2 - v**2, 0))
    padded = [fft.next_fast_len(length + 2 * reach, real=True) for length in shape]
    base = [window, window * u, window * v, bell]
    spectra: list[Any] = [fft.rfft2(each, padded) for each in (mass, load)]

    def correlated(spectrum: Any, kernel: np.ndarray) -> np.ndarray:
        whole: Any = fft.irfft2(spectrum * fft.rfft2(kernel[::-1, ::-1], padded), padded)
        return whole[reach : reach + shape[0], reach : reach + shape[1]]

    normal = np.empty((*shape, 4, 4))
    pairs = {(i, j): base[i] * base[j] for i in range(4) for j in range(i, 4)}
    for (i, j), kernel in pairs.items():
        normal[..., i, j] = normal[..., j, i] = correlated(spectra[0], kernel)
    right = np.stack([correlated(spectra[1], kernel) for kernel in base], axis=-1)
    # Where the window holds next to nothing the plane is not determined, and neither is the bell.
    ridge = 1e-9 * (normal[..., 0, 0] + 1e-9)
    inner = normal[..., :3, :3] + ridge[..., None, None] * np.eye(3)
    filled = normal[..., 0, 0] > 1e-6
    inner[~filled] = np.eye(3)
    solved = np.linalg.solve(inner, np.stack([normal[..., :3, 3], right[..., :3]], axis=-1))
    information = normal[..., 3, 3] - np.einsum("...i,...i->...", normal[..., :3, 3], solved[..., 0])
    amplitude = right[..., 3] - np.einsum("...i,...i->...", normal[..., :3, 3], solved[..., 1])
    seen = filled & (information > 1e-9)
    usual = float(np.median(information[seen])) if seen.any() else np.inf
    seen &= information > _LEAST_INFORMATION * usual
    root = np.sqrt(np.where(seen, information, 1.0))
    scaled = np.where(seen, amplitude / root, np.nan)
    spread, z = _standardised(scaled, max(1, round(_BLOCK * _CELLS_PER_RADIUS)))
    height = np.where(seen, amplitude / np.where(seen, information, 1.0), np.nan)
    moments = np.array([_moment(z, axis, cell) for axis in (0, 1)])
    area = cell**2 * float(np.count_nonzero(seen))
    sides = cell * np.array([np.count_nonzero(seen.any(axis=1)), np.count_nonzero(seen.any(axis=0))])
    return _Map(radius, origin, cell, height, information, spread, z, area, moments, sides)


def _standardised(values: np.ndarray, block: int) -> tuple[np.ndarray, np.ndarray]:
    """Local standard deviation of a field, and its value over that as of a normal variable."""
    counts = [max(1, round(length / block)) for length in values.shape]
    edges = [np.linspace(0, length, count + 1).astype(int) for length, count in zip(values.shape, counts, strict=True)]
    middle, spread, freedom = (np.full(counts, np.nan) for _ in range(3))
    for i in range(counts[0]):
        for j in range(counts[1]):
            own = values[edges[0][i] : edges[0][i + 1], edges[1][j] : edges[1][j + 1]]
            own = own[np.isfinite(own)]
            if len(own) < 4 * np.pi * _CELLS_PER_RADIUS**2:
                continue
            middle[i, j] = np.median(own)
            spread[i, j] = MAD_TO_STD * np.median(np.abs(own - middle[i, j]))
            freedom[i, j] = max(3.0, _MAD_EFFICIENCY * len(own) / (np.pi * _CELLS_PER_RADIUS**2))
    known = np.isfinite(spread)
    if not known.any():
        return np.full(values.shape, np.nan), np.full(values.shape, np.nan)
    if not known.all():
        nearest: Any = ndimage.distance_transform_edt(~known, return_distances=False, return_indices=True)
        middle, spread, freedom = (each[tuple(nearest)] for each in (middle, spread, freedom))
    at = [
        np.interp(np.arange(length) + 0.5, 0.5 * (edge[:-1] + edge[1:]), np.arange(count))
        for length, edge, count in zip(values.shape, edges, counts, strict=True)
    ]
    grid = np.meshgrid(*at, indexing="ij")
    middle, spread, freedom = (
        ndimage.map_coordinates(each, grid, order=1, mode="nearest") for each in (middle, spread, freedom)
    )
    spread = np.maximum(spread, 1e-12)
    t = (values - middle) / spread
    # A scatter of few places is itself uncertain: Student's t, turned into the normal variable of the same probability.
    log_tail = np.minimum(_log_tail_of_t(np.abs(t), freedom), np.log(0.5))
    return spread, np.sign(t) * _normal_of_log_tail(log_tail)


def _log_tail_of_t(t: np.ndarray, freedom: np.ndarray) -> np.ndarray:
    tail = stats.t.sf(np.nan_to_num(t), freedom)
    return np.where(np.isfinite(t), np.log(np.maximum(tail, 1e-300)), np.nan)


def _normal_of_log_tail(log_tail: np.ndarray) -> np.ndarray:
    return np.where(np.isfinite(log_tail), -stats.norm.ppf(np.exp(np.nan_to_num(log_tail, nan=np.log(0.5)))), np.nan)


def _moment(z: np.ndarray, axis: int, cell: float) -> float:
    """Root of the second spectral moment, 1 / mm: standard deviation of the slope of a field of unit variance."""
    step = np.diff(z, axis=axis)
    step = step[np.isfinite(step)]
    if len(step) < 10:
        return 0.0
    return robust_std(step) / cell


def _threshold(maps: Sequence[_Map], false_alarm: float) -> float:
    """The level that noise exceeds with a probability anywhere at any size: the sizes' sum is an upper bound."""
    level: Any = optimize.brentq(lambda z: sum(m.false_alarms(z) for m in maps) - false_alarm, 1.0, 40.0)
    return float(level)


@dataclass(frozen=True, eq=False)
class _Peak:
    """A peak of a map: its place (2,), radius, height, z, and its height over the noise of independent points."""

    place: np.ndarray
    radius: float
    height: float
    z: float
    strength: float


def _chosen(maps: Sequence[_Map], threshold: float) -> list[_Peak]:
    """The strongest peaks that are significant, or cover one that is, and do not touch each other.

    Large blemishes raise the scatter in the maps of their own size; their parts are significant in those of smaller
    ones. Strength is by the scatter of the smallest size, which blemishes raise least.
    """
    peaks = []
    for each in maps:
        size = np.nan_to_num(np.abs(each.height) * np.sqrt(np.maximum(each.information, 0)))
        top = (size == ndimage.maximum_filter(size, 2 * _CELLS_PER_RADIUS + 1)) & (size > 0)
        for i, j in np.argwhere(top):
            place = each.origin + (np.array([i, j]) + 0.5) * each.cell
            noise = float(maps[0].noise_at(place[None])[0])
            if size[i, j] > 0.5 * threshold * noise:
                height, z = float(each.height[i, j]), float(np.nan_to_num(np.abs(each.z[i, j])))
                peaks.append(_Peak(place, each.radius, height, z, float(size[i, j]) / noise))
    significant = [peak for peak in peaks if peak.z > threshold]
    if not significant:
        return []
    tree = KDTree([peak.place for peak in significant])
    kept: list[_Peak] = []
    passed: list[_Peak] = []
    for peak in sorted(peaks, key=lambda peak: peak.strength, reverse=True):
        z = peak.z
        if z <= threshold:
            covered = [significant[k] for k in tree.query_ball_point(peak.place, peak.radius)]
            z = max((other.z for other in covered if other.height * peak.height > 0), default=0.0)
        if z <= threshold:
            continue
        if all(np.hypot(*(peak.place - other.place)) > 1.5 * (peak.radius + other.radius) for other in passed):
            kept.append(_Peak(peak.place, peak.radius, peak.height, z, peak.strength))
        passed.append(peak)
    return kept


def _indication(
    surface: UnrolledSurface, plain: np.ndarray, tree: KDTree, maps: Sequence[_Map], peak: _Peak, smallest: float
) -> Indication:
    """A peak with its region: cells about it that depart from the surroundings in the same direction.

    EvaluationError where too few points are in the region or around it.
    """
    noise, reach, points = float(maps[0].noise_at(peak.place[None])[0]), 3.0 * peak.radius, np.zeros(0, int)
    for _ in range(_GROWN):
        near = np.array(tree.query_ball_point(peak.place, reach), int)
        near = near[plain[near]]
        places, heights = surface.places[near] - peak.place, surface.heights[near]
        inside, cut = _region(places, heights, peak, noise=noise, reach=reach, step=max(smallest, peak.radius / 4))
        points = near[inside]
        if not cut:
            break
        reach *= _GROWTH
    if len(points) < _FEWEST:
        raise EvaluationError(f"it has {len(points)} points of its own; {_FEWEST} are needed")
    chance = min(1.0, sum(each.false_alarms(peak.z) for each in maps))
    return Indication(peak.place, peak.radius, peak.height, peak.z, chance, noise, points)


def _region(
    places: np.ndarray, heights: np.ndarray, peak: _Peak, *, noise: float, reach: float, step: float
) -> tuple[np.ndarray, bool]:
    """Points (n,) bool of a peak at the origin, and whether its region reaches the window's edge."""
    away = np.hypot(*places.T)
    ring = away > 0.5 * reach
    if np.count_nonzero(ring) < 2 * _FEWEST:
        raise EvaluationError(f"{np.count_nonzero(ring)} undamaged points are around it; {2 * _FEWEST} are needed")
    base = np.column_stack([np.ones(len(places)), places])
    left = heights - base @ (fit_biweight(base, heights, ring)[0] @ heights)
    side = int(np.ceil(2 * reach / step)) + 1
    cells = np.floor((places + reach) / step).astype(int)
    flat = cells[:, 0] * side + cells[:, 1]
    # Sums over three by three cells.
    count = 9 * ndimage.uniform_filter(np.bincount(flat, minlength=side**2).reshape(side, side) * 1.0, 3)
    total = 9 * ndimage.uniform_filter(np.bincount(flat, left, side**2).reshape(side, side), 3)
    filled = count > 0.5
    mean = np.where(filled, np.sign(peak.height) * total / np.maximum(count, 0.5), -np.inf)
    level = np.maximum(_EDGE_SHARE * float(mean.max()), _EDGE_STD * noise / np.sqrt(np.maximum(count, 1)))
    labelled: Any = ndimage.label(mean > level)
    middle = int(reach / step)
    own = labelled[0][middle - 1 : middle + 2, middle - 1 : middle + 2]
    region = np.isin(labelled[0], own[own > 0])
    wide = ndimage.binary_dilation(region)
    cut = bool(region[[0, 1, -2, -1], :].any() or region[:, [0, 1, -2, -1]].any())
    return wide[cells[:, 0], cells[:, 1]] | (away < _CORE * peak.radius), cut
