"""Search for pits and protrusions of all sizes on an unrolled surface, at a given probability of a false alarm.

At every place and for every size the depth of a bell (1 - t^2)^2 is fitted together with a tilted plane through its
surroundings. This is a matched filter that does not need complete sampling.

Divided by its local scatter, the depth on an undamaged surface is a random field of unit variance. The probability that
it exceeds a level anywhere is the expected Euler characteristic of the excursion set (Adler and Taylor, Random Fields
and Geometry, 2007; Worsley et al., Human Brain Mapping 4, 1996, Table I). The threshold follows from this probability.

Means of a few points have a normal distribution only if the points' own has no heavy tails. Deviations of points from
the median of their neighbours are therefore limited before the search (Huber, Robust Statistics, 1981, 1.7). The
remaining tail is measured on the map of the smallest size without the indications. Only indications that are
significant for this tail remain.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any, NamedTuple

import numpy as np
from scipy import fft, ndimage, optimize, stats
from scipy.spatial import KDTree

from uwlts.errors import EvaluationError
from uwlts.fitting.least_squares import MAD_TO_STD, fit_biweight, robust_std


@dataclass(frozen=True, kw_only=True)
class BlemishSearchRule:
    """Numbers of the search.

    The threshold of an indication follows from the probability of a false alarm. The numbers below were chosen by hand
    with the reasons stated, not fitted to data. Results with these numbers are checked on the rendered pipes of
    docs/studies/inspection.py and on the simulated surfaces of tests/uwlts/inspection/test_inspect.py.

    Attributes
    ----------
    points_in_smallest : int
        Points in a disc of the smallest size: at least three profiles, even if points are much denser along profiles.
    cells_per_radius : int
        Cells of the maps per radius of a bell.
    window : float
        Radius of the fitted surroundings, in radii of the bell.
    size_ratio : float
        Ratio of successive sizes: a bell of one size keeps 95 % of its signal at the next size.
    least_information : float
        Fraction of the median information on a bell's depth, below which a place is at an edge or in a hole.
    scatter_block : float
        Side of the squares for estimates of the local scatter, in radii: about 180 independent places.
    largest_size : float
        Largest radius as a fraction of the area's shorter side: larger bells leave no surroundings.
    most_cells : int
        Most cells of a map, limited by memory.
    cells_at_a_time : int
        Cells whose bells are fitted together, limited by memory: 400 bytes each.
    points_at_a_time : int
        Points whose neighbours are searched for together, limited by memory: 400 bytes each.
    rounds : int
        Most rounds of searching and removing indications.
    fewest_points : int
        Fewest points of an indication; twice as many are needed around it.
    tail : float
        Probability of the outer quantile that determines the tail. Nearer quantiles depend little on the tail.
    fewest_beyond : int
        Fewest independent places beyond this quantile; it is nearer on small surfaces.
    neighbours : int
        Nearest points that each point is compared with to find outliers.
    outlier : float
        Distance of an outlier from the median of its neighbours, in robust standard deviations.
    most_deviation : float
        Limit of a point's deviation from this median, in the same unit: 1 % of the efficiency for normal noise is lost.
        Deviations in a pit of the smallest size stay below it, because its slopes increase the standard deviation.
    enlargements : int
        Most enlargements of the window around a peak, while its region reaches the window's edge.
    enlargement : float
        Ratio of the window's sides before and after an enlargement.
    core : float
        Radius, in radii of the bell, within which all points belong to the indication.
    edge_share : float
        Height of the region's edge as a fraction of the blemish's height, as metal loss is boxed in pipe inspection.
    edge_std : float
        Least height of the region's edge, in standard deviations of a local mean.
    """

    points_in_smallest: int = 12
    cells_per_radius: int = 3
    window: float = 1.8
    size_ratio: float = np.sqrt(2.0)
    least_information: float = 0.4
    scatter_block: float = 24.0
    largest_size: float = 1 / 6
    most_cells: int = 4_000_000
    cells_at_a_time: int = 250_000
    points_at_a_time: int = 250_000
    rounds: int = 10
    fewest_points: int = 6
    tail: float = 1e-3
    fewest_beyond: int = 4
    neighbours: int = 9
    outlier: float = 6.0
    most_deviation: float = 2.0
    enlargements: int = 3
    enlargement: float = 1.7
    core: float = 0.8
    edge_share: float = 0.1
    edge_std: float = 3.0


SEARCH_RULE = BlemishSearchRule()

_MAD_EFFICIENCY = 0.37
"""Efficiency of the median absolute deviation for a normal distribution (Huber, Robust Statistics, 1981, 5.1)."""


@dataclass(frozen=True, eq=False)
class UnrolledSurface:
    """Unrolled surface of N points.

    Attributes
    ----------
    places : (N, 2) float64
        Places on the surface, mm.
    heights : (N,) float64
        Heights above the undamaged shape, mm.
    std : (N,) float64
        Standard deviations of the heights, mm.
    footprint_mm : (N, 2) float64
        Standard deviations, along both axes, of the part of the surface that a point averages over; zero if unknown.
    footprint_std : float
        Relative standard uncertainty of the squared footprints.
    """

    places: np.ndarray
    heights: np.ndarray
    std: np.ndarray
    footprint_mm: np.ndarray
    footprint_std: float = 0.0


@dataclass(frozen=True, eq=False)
class Indication:
    """Significant departure of a surface from its shape.

    Attributes
    ----------
    place : (2,) float64
        Middle, mm.
    radius_mm : float
        Radius of the bell.
    height_mm : float
        Signed height.
    z : float
        Height in standard deviations.
    false_alarm : float
        Probability that noise exceeds ``z`` anywhere.
    noise_mm : float
        Standard deviation of independent point noise that explains the scatter of local means of the heights.
    points : (K,) int
        Points of the indication.
    """

    place: np.ndarray
    radius_mm: float
    height_mm: float
    z: float
    false_alarm: float
    noise_mm: float
    points: np.ndarray


@dataclass(frozen=True, eq=False)
class UnresolvedDeparture:
    """Significant departure without a region: the nearest point, its signed height in mm, and the reason."""

    point: int
    height_mm: float
    reason: str


@dataclass(frozen=True, eq=False)
class BlemishSearch:
    """Result of a search on N points.

    Attributes
    ----------
    indications : tuple of Indication
    unresolved : tuple of UnresolvedDeparture
    outliers : (N,) bool
    undamaged : (N,) bool
        Points that are neither outliers nor in an indication.
    level_mm : (N,) float64
        Least significant height of an indication of the smallest size.
    noise_mm : (N,) float64
        Effective noise of each point.
    smallest_mm : float
        Smallest radius of the search.
    false_alarm : float
        Probability of any false indication.
    """

    indications: tuple[Indication, ...]
    unresolved: tuple[UnresolvedDeparture, ...]
    outliers: np.ndarray
    undamaged: np.ndarray
    level_mm: np.ndarray
    noise_mm: np.ndarray
    smallest_mm: float
    false_alarm: float


def search_blemishes(surface: UnrolledSurface, *, false_alarm: float, largest_mm: float = np.inf) -> BlemishSearch:
    """Find significant departures of a surface from its shape.

    The most significant indications are taken first. Their points are removed before the next round, until no
    indication is left.

    Parameters
    ----------
    surface
        Points on the unrolled surface.
    false_alarm
        Probability of any indication, inwards or outwards, on an undamaged surface.
    largest_mm
        Limit of the largest radius.

    Raises
    ------
    EvaluationError
        The surface has too few points.
    """
    places, tree = surface.places, KDTree(surface.places)
    if len(places) < 20 * SEARCH_RULE.points_in_smallest:
        raise EvaluationError(
            f"{len(places)} points are too few to search for blemishes; "
            f"{20 * SEARCH_RULE.points_in_smallest} are needed"
        )
    surface, outliers, wider = _limit_deviations(surface, tree)
    smallest = float(
        np.median(tree.query(places[:: max(1, len(places) // 2000)], k=SEARCH_RULE.points_in_smallest)[0][:, -1])
    )
    largest = min(SEARCH_RULE.largest_size * float(np.min(np.ptp(places, axis=0))), largest_mm)
    largest = max(largest, smallest)
    # The smallest size is larger if its map would not fit into memory.
    area = float(np.prod(np.ptp(places, axis=0)))
    smallest = max(smallest, SEARCH_RULE.cells_per_radius * float(np.sqrt(area / SEARCH_RULE.most_cells)))
    radii = smallest * SEARCH_RULE.size_ratio ** np.arange(
        1 + max(0, int(np.log(largest / smallest) / np.log(SEARCH_RULE.size_ratio)))
    )
    undamaged = ~outliers
    found: list[_Candidate] = []
    maps: list[_BellMap] = []
    threshold = np.inf
    for number in range(SEARCH_RULE.rounds + 1):
        maps = [_fit_bells(surface, undamaged, radius) for radius in radii]
        maps = [each for each in maps if each.area_mm2 > 0]
        if not maps:
            break
        threshold = _solve_threshold(maps, false_alarm)
        peaks = _choose_peaks(maps, threshold)
        if not peaks:
            break
        for peak in peaks:
            try:
                if number == SEARCH_RULE.rounds:
                    raise EvaluationError(f"{SEARCH_RULE.rounds} rounds of the search found it again each time")
                outcome = _delimit(surface, undamaged, tree, maps, peak, smallest)
                points = outcome.points
            except EvaluationError as error:
                outcome = UnresolvedDeparture(int(tree.query(peak.place)[1]), peak.height, str(error))
                points = np.array(tree.query_ball_point(peak.place, peak.radius), int)
            found.append(_Candidate(peak, outcome, points[undamaged[points]]))
            undamaged[points] = False
    level, noise = np.full(len(places), np.nan), np.full(len(places), np.nan)
    if maps:
        tail, found = _confirm(surface, undamaged, maps[0], threshold, found)
        level = tail.scatter_at(threshold) * maps[0].level_at(places)
        noise = maps[0].noise_at(places)
    kept: list[Indication] = []
    for peak, outcome, _ in found:
        if isinstance(outcome, Indication):
            chance = min(1.0, sum(each.false_alarms(peak.z) for each in maps))
            kept.append(replace(outcome, z=peak.z, false_alarm=chance, noise_mm=wider * outcome.noise_mm))
    departures = tuple(each.outcome for each in found if isinstance(each.outcome, UnresolvedDeparture))
    known = tuple(kept), departures, outliers, undamaged, level, wider * noise
    return BlemishSearch(*known, smallest, false_alarm)


@dataclass(frozen=True)
class _Tail:
    """Distribution of a map without indications: Student's, of the freedom that explains its outer quantiles."""

    freedom: float

    @classmethod
    def of_map(cls, clean: _BellMap) -> _Tail:
        """Determine the tail by the side of the smaller quantile, because weak blemishes remain on the other one."""
        z = clean.z[np.isfinite(clean.z)]
        share = max(SEARCH_RULE.tail, SEARCH_RULE.fewest_beyond * np.pi * SEARCH_RULE.cells_per_radius**2 / len(z))
        if share > 0.1:
            return cls(np.inf)
        ratio = min(np.quantile(z, 1 - share), -np.quantile(z, share)) / np.median(np.abs(z))

        def excess(inverse: float) -> float:
            return float(stats.t.isf(share, 1 / inverse) / stats.t.ppf(0.75, 1 / inverse) - ratio)

        if excess(1e-3) >= 0:
            return cls(np.inf)
        inverse: Any = optimize.brentq(excess, 1e-3, 0.5) if excess(0.5) > 0 else 0.5
        return cls(1 / float(inverse))

    @property
    def _scale(self) -> float:
        """Scale that gives the median absolute value of a standard normal variable."""
        return float(stats.norm.ppf(0.75) / stats.t.ppf(0.75, self.freedom))

    def normalise(self, strength: float) -> float:
        """Return the standard normal variable of equal probability for a height in robust standard deviations."""
        return float(_normal_of_log_tail(_log_tail_of_t(np.array(strength / self._scale), np.array(self.freedom))))

    def scatter_at(self, z: float) -> float:
        """Return the height, in robust standard deviations, for a standard normal variable."""
        return float(self._scale * stats.t.isf(stats.norm.sf(z), self.freedom))


class _Candidate(NamedTuple):
    """Significant peak, the indication or departure at its place, and the points (K,) removed with it."""

    peak: _Peak
    outcome: Indication | UnresolvedDeparture
    points: np.ndarray


def _confirm(
    surface: UnrolledSurface, undamaged: np.ndarray, smallest: _BellMap, threshold: float, found: list[_Candidate]
) -> tuple[_Tail, list[_Candidate]]:
    """Return the tail of the noise and the candidates that are significant for it.

    Other candidates are noise: their points become undamaged again, and the tail is determined with them.
    """
    while True:
        tail = _Tail.of_map(smallest)
        kept = []
        for peak, outcome, points in found:
            z = min(peak.z, tail.normalise(peak.strength))
            if z > threshold:
                kept.append(_Candidate(replace(peak, z=z), outcome, points))
            else:
                undamaged[points] = True
        if len(kept) == len(found):
            return tail, kept
        found = kept
        smallest = _fit_bells(surface, undamaged, smallest.radius)


def _limit_deviations(surface: UnrolledSurface, tree: KDTree) -> tuple[UnrolledSurface, np.ndarray, float]:
    """Limit the deviations of the points from the medians of their neighbours.

    Returns
    -------
    surface : UnrolledSurface
        Surface with limited deviations.
    outliers : (N,) bool
        Points far from their neighbours, relative to the neighbours' scatter.
    ratio : float
        Standard deviation of the other points from the medians, divided by that of the limited deviations.
    """
    nearest = np.empty((len(surface.places), SEARCH_RULE.neighbours), np.int32)
    middle, spread = np.empty(len(nearest)), np.empty(len(nearest))
    parts = [
        slice(start, start + SEARCH_RULE.points_at_a_time)
        for start in range(0, len(nearest), SEARCH_RULE.points_at_a_time)
    ]
    for part in parts:
        nearest[part] = tree.query(surface.places[part], k=SEARCH_RULE.neighbours + 1)[1][:, 1:]
        beside = surface.heights[nearest[part]]
        middle[part] = np.median(beside, axis=1)
        spread[part] = MAD_TO_STD * np.median(np.abs(beside - middle[part, None]), axis=1)
    usually = float(np.median(spread))
    # Wild points nearby increase the scatter of one place, a blemish that of many.
    spread = np.concatenate([np.median(spread[nearest[part]], axis=1) for part in parts])
    spread = np.maximum(spread, usually)
    off, most = surface.heights - middle, SEARCH_RULE.most_deviation * spread
    outliers, limited = np.abs(off) > SEARCH_RULE.outlier * spread, np.clip(off, -most, most)
    usual = ~outliers & (spread <= 2 * usually)
    ratio = float(np.std(off[usual]) / max(np.std(limited[usual]), 1e-300)) if usual.any() else 1.0
    return replace(surface, heights=middle + limited), outliers, max(ratio, 1.0)


@dataclass(frozen=True, eq=False)
class _BellMap:
    """Fitted bells of one radius on a grid of places.

    Attributes
    ----------
    radius, cell : float
        Radius of the bells and side of a cell, mm.
    origin : (2,) float64
        Corner of the grid.
    height : (I, J) float64
        Heights of the bells, mm.
    information : (I, J) float64
        Inverse variances of the heights for unit point noise.
    spread : (I, J) float64
        Local standard deviation of height times root information.
    z : (I, J) float64
        Significance, as a standard normal variable.
    area_mm2 : float
        Searched area.
    moments : (2,) float64
        Root spectral moments along both axes, 1/mm.
    sides : (2,) float64
        Sides of the searched area, mm.
    """

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
        """Return the expected Euler characteristic of the region where |z| exceeds a level."""
        bell = np.exp(-0.5 * level**2)
        flat = self.area_mm2 * float(np.prod(self.moments)) * level * bell / (2 * np.pi) ** 1.5
        edge = float(self.sides @ self.moments) * bell / (2 * np.pi)
        return 2 * (flat + edge + float(stats.norm.sf(level)))

    def _cells(self, places: np.ndarray) -> tuple[np.ndarray, ...]:
        at = np.floor((places - self.origin) / self.cell).astype(int)
        return tuple(np.clip(at.T, 0, np.array(self.z.shape)[:, None] - 1))

    def level_at(self, places: np.ndarray) -> np.ndarray:
        """Return the standard deviation (N,) of a bell's height at places."""
        at = self._cells(places)
        with np.errstate(invalid="ignore", divide="ignore"):
            return np.where(np.isfinite(self.z[at]), self.spread[at] / np.sqrt(self.information[at]), np.nan)

    def noise_at(self, places: np.ndarray) -> np.ndarray:
        """Return the effective standard deviation (N,) of a point of unit weight at places."""
        return self.spread[self._cells(places)]


def _fit_bells(surface: UnrolledSurface, undamaged: np.ndarray, radius: float) -> _BellMap:
    cell = radius / SEARCH_RULE.cells_per_radius
    places = surface.places[undamaged]
    origin = surface.places.min(axis=0) - 0.5 * cell
    shape = tuple((np.floor(np.ptp(surface.places, axis=0) / cell).astype(int) + 2).tolist())
    # Weights relative to a point of median noise: heights stay in mm, and the scatter refers to such a point.
    weight = np.square(np.median(surface.std) / surface.std[undamaged])
    flat = np.ravel_multi_index(tuple(np.floor((places - origin) / cell).astype(int).T), shape)
    size = int(np.prod(shape))
    mass = np.bincount(flat, weight, size).reshape(shape)
    load = np.bincount(flat, weight * surface.heights[undamaged], size).reshape(shape)
    reach = int(np.ceil(SEARCH_RULE.window * SEARCH_RULE.cells_per_radius))
    axis = np.arange(-reach, reach + 1) / SEARCH_RULE.cells_per_radius
    u, v = np.meshgrid(axis, axis, indexing="ij")
    window = (np.hypot(u, v) <= SEARCH_RULE.window).astype(float)
    base = [window, window * u, window * v, np.square(np.maximum(1 - u**2 - v**2, 0))]
    pairs = [(i, j) for i in range(4) for j in range(i, 4)]
    mass, load = np.pad(mass, reach), np.pad(load, reach)
    rows = int(np.clip(SEARCH_RULE.cells_at_a_time // shape[1], 1, shape[0]))
    padded = [fft.next_fast_len(length + 2 * reach, real=True) for length in (rows, shape[1])]
    spectra: list[Any] = [
        fft.rfft2(each[::-1, ::-1], padded) for each in (*(base[i] * base[j] for i, j in pairs), *base)
    ]
    amplitude, information = np.empty(shape), np.empty(shape)
    filled = np.empty(shape, bool)
    for start in range(0, shape[0], rows):
        here = slice(start, min(start + rows, shape[0]))
        parts: list[Any] = [fft.rfft2(each[start : here.stop + 2 * reach], padded) for each in (mass, load)]
        sums = [
            np.asarray(fft.irfft2(parts[number >= len(pairs)] * kernel, padded))[
                2 * reach : 2 * reach + here.stop - start, 2 * reach : 2 * reach + shape[1]
            ]
            for number, kernel in enumerate(spectra)
        ]
        filled[here] = sums[0] > 1e-6
        normal = np.empty((*sums[0].shape, 4, 4))
        for (i, j), each in zip(pairs, sums, strict=False):
            normal[..., i, j] = normal[..., j, i] = each
        right = np.stack(sums[len(pairs) :], axis=-1)
        # In a nearly empty window neither the plane nor the bell is determined.
        inner = normal[..., :3, :3] + 1e-9 * (sums[0] + 1e-9)[..., None, None] * np.eye(3)
        inner[~filled[here]] = np.eye(3)
        solved = np.linalg.solve(inner, np.stack([normal[..., :3, 3], right[..., :3]], axis=-1))
        by_plane = np.einsum("...i,...ij->...j", normal[..., :3, 3], solved)
        information[here] = normal[..., 3, 3] - by_plane[..., 0]
        amplitude[here] = right[..., 3] - by_plane[..., 1]
    seen = filled & (information > 1e-9)
    usual = float(np.median(information[seen])) if seen.any() else np.inf
    seen &= information > SEARCH_RULE.least_information * usual
    root = np.sqrt(np.where(seen, information, 1.0))
    scaled = np.where(seen, amplitude / root, np.nan)
    spread, z = _standardise(scaled, max(1, round(SEARCH_RULE.scatter_block * SEARCH_RULE.cells_per_radius)))
    height = np.where(seen, amplitude / np.where(seen, information, 1.0), np.nan)
    moments = np.array([_spectral_moment(z, axis, cell) for axis in (0, 1)])
    area = cell**2 * float(np.count_nonzero(seen))
    sides = cell * np.array([np.count_nonzero(seen.any(axis=1)), np.count_nonzero(seen.any(axis=0))])
    return _BellMap(radius, origin, cell, height, information, spread, z, area, moments, sides)


def _standardise(values: np.ndarray, block: int) -> tuple[np.ndarray, np.ndarray]:
    """Return the local standard deviation of a field, and the field as a standard normal variable."""
    counts = [max(1, round(length / block)) for length in values.shape]
    edges = [np.linspace(0, length, count + 1).astype(int) for length, count in zip(values.shape, counts, strict=True)]
    middle, spread, freedom = (np.full(counts, np.nan) for _ in range(3))
    for i in range(counts[0]):
        for j in range(counts[1]):
            own = values[edges[0][i] : edges[0][i + 1], edges[1][j] : edges[1][j + 1]]
            own = own[np.isfinite(own)]
            if len(own) < 4 * np.pi * SEARCH_RULE.cells_per_radius**2:
                continue
            middle[i, j] = np.median(own)
            spread[i, j] = MAD_TO_STD * np.median(np.abs(own - middle[i, j]))
            freedom[i, j] = max(3.0, _MAD_EFFICIENCY * len(own) / (np.pi * SEARCH_RULE.cells_per_radius**2))
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
    # A scatter from few places is uncertain: map Student's t to the normal variable of equal probability.
    log_tail = np.minimum(_log_tail_of_t(np.abs(t), freedom), np.log(0.5))
    return spread, np.sign(t) * _normal_of_log_tail(log_tail)


def _log_tail_of_t(t: np.ndarray, freedom: np.ndarray) -> np.ndarray:
    tail = stats.t.sf(np.nan_to_num(t), freedom)
    return np.where(np.isfinite(t), np.log(np.maximum(tail, 1e-300)), np.nan)


def _normal_of_log_tail(log_tail: np.ndarray) -> np.ndarray:
    return np.where(np.isfinite(log_tail), -stats.norm.ppf(np.exp(np.nan_to_num(log_tail, nan=np.log(0.5)))), np.nan)


def _spectral_moment(z: np.ndarray, axis: int, cell: float) -> float:
    """Return the root second spectral moment, 1/mm: standard deviation of the slope of a unit-variance field."""
    step = np.diff(z, axis=axis)
    step = step[np.isfinite(step)]
    if len(step) < 10:
        return 0.0
    return robust_std(step) / cell


def _solve_threshold(maps: Sequence[_BellMap], false_alarm: float) -> float:
    """Return the level that noise exceeds with the given probability. The sum over sizes is an upper bound."""
    level: Any = optimize.brentq(lambda z: sum(m.false_alarms(z) for m in maps) - false_alarm, 1.0, 40.0)
    return float(level)


@dataclass(frozen=True, eq=False)
class _Peak:
    """Peak of a map: place (2,), radius, height, z, and height divided by the noise of independent points."""

    place: np.ndarray
    radius: float
    height: float
    z: float
    strength: float


def _choose_peaks(maps: Sequence[_BellMap], threshold: float) -> list[_Peak]:
    """Return the strongest significant peaks that do not touch each other.

    A peak is also taken if it covers a significant peak of a smaller size: large blemishes increase the scatter in the
    maps of their own size. Strength therefore refers to the scatter at the smallest size.
    """
    peaks = []
    for each in maps:
        size = np.nan_to_num(np.abs(each.height) * np.sqrt(np.maximum(each.information, 0)))
        top = (size == ndimage.maximum_filter(size, 2 * SEARCH_RULE.cells_per_radius + 1)) & (size > 0)
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


def _delimit(
    surface: UnrolledSurface,
    undamaged: np.ndarray,
    tree: KDTree,
    maps: Sequence[_BellMap],
    peak: _Peak,
    smallest: float,
) -> Indication:
    """Return a peak with its region: adjacent cells that depart in the same direction.

    EvaluationError if the region or its surroundings have too few points.
    """
    noise, reach, points = float(maps[0].noise_at(peak.place[None])[0]), 3.0 * peak.radius, np.zeros(0, int)
    for _ in range(SEARCH_RULE.enlargements):
        near = np.array(tree.query_ball_point(peak.place, reach), int)
        near = near[undamaged[near]]
        places, heights = surface.places[near] - peak.place, surface.heights[near]
        inside, cut = _grow_region(places, heights, peak, noise=noise, reach=reach, step=max(smallest, peak.radius / 4))
        points = near[inside]
        if not cut:
            break
        reach *= SEARCH_RULE.enlargement
    if len(points) < SEARCH_RULE.fewest_points:
        raise EvaluationError(f"it has {len(points)} points; {SEARCH_RULE.fewest_points} are needed")
    chance = min(1.0, sum(each.false_alarms(peak.z) for each in maps))
    return Indication(peak.place, peak.radius, peak.height, peak.z, chance, noise, points)


def _grow_region(
    places: np.ndarray, heights: np.ndarray, peak: _Peak, *, noise: float, reach: float, step: float
) -> tuple[np.ndarray, bool]:
    """Return a mask (n,) of the points of a peak at the origin, and whether the region reaches the window's edge."""
    away = np.hypot(*places.T)
    ring = away > 0.5 * reach
    if np.count_nonzero(ring) < 2 * SEARCH_RULE.fewest_points:
        raise EvaluationError(
            f"{np.count_nonzero(ring)} undamaged points surround it; {2 * SEARCH_RULE.fewest_points} are needed"
        )
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
    level = np.maximum(
        SEARCH_RULE.edge_share * float(mean.max()), SEARCH_RULE.edge_std * noise / np.sqrt(np.maximum(count, 1))
    )
    labelled: Any = ndimage.label(mean > level)
    middle = int(reach / step)
    own = labelled[0][middle - 1 : middle + 2, middle - 1 : middle + 2]
    region = np.isin(labelled[0], own[own > 0])
    wide = ndimage.binary_dilation(region)
    cut = bool(region[[0, 1, -2, -1], :].any() or region[:, [0, 1, -2, -1]].any())
    return wide[cells[:, 0], cells[:, 1]] | (away < SEARCH_RULE.core * peak.radius), cut
