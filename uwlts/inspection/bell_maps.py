"""Bells of one size fitted everywhere on an unrolled surface, and the distribution of their heights by noise.

At every place the depth of a bell (1 - t^2)^2 is fitted together with a tilted plane through its surroundings. This is
a matched filter that does not need complete sampling.

Means of a few points have a normal distribution only if the points' own has no heavy tails. Deviations of points from
the median of their neighbours are therefore limited first (Huber, Robust Statistics, 1981, 1.7). The tail that remains
is measured on a map.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import numpy as np
from scipy import fft, ndimage, optimize, special, stats
from scipy.spatial import KDTree

from uwlts.fitting.least_squares import MAD_TO_STD, robust_std


@dataclass(frozen=True, kw_only=True)
class BlemishSearchRule:
    """Numbers of the search; the threshold of an indication follows from the probability of a false alarm."""

    points_in_smallest: int = 12
    """Points in a disc of the smallest size: at least three profiles, even if points are much denser along profiles."""
    gap: float = 2.1
    """Distance from all points from which a place is not seen, in the 90 % quantile of these distances. One of 26,000
    places is as far among points at random places, and none among profiles."""
    cells_per_radius: int = 3  # cells of the maps per radius of a bell
    window: float = 1.8  # radius of the fitted surroundings, in radii of the bell
    size_ratio: float = np.sqrt(2.0)
    """Ratio of successive sizes: a bell of one size keeps 95 % of its signal at the next size."""
    least_information: float = 0.4
    """Fraction of the median information on a bell's depth, below which a place is at an edge or in a hole."""
    scatter_block: float = 24.0
    """Side of the squares for estimates of the local scatter, in radii: about 180 independent places."""
    largest_size: float = 1 / 6
    """Largest radius as a fraction of the area's shorter side: larger bells leave no surroundings."""
    most_cells: int = 4_000_000  # most cells of a map, limited by memory
    cells_at_a_time: int = 250_000  # cells whose bells are fitted together, limited by memory: 400 bytes each
    points_at_a_time: int = 250_000
    """Points whose neighbours are searched for together, limited by memory: 400 bytes each."""
    rounds: int = 10  # most rounds of searching and removing indications
    fewest_points: int = 6  # fewest points of an indication; twice as many are needed around it
    tail: float = 1e-3
    """Probability of the outer quantile that determines the tail. Nearer quantiles depend little on the tail."""
    fewest_beyond: int = 4  # fewest independent places beyond this quantile; it is nearer on small surfaces
    neighbours: int = 9  # odd number of nearest points that each point is compared with to find outliers
    outlier: float = 6.0  # distance of an outlier from the median of its neighbours, in robust standard deviations
    most_deviation: float = 2.0
    """Limit of a point's deviation from this median, in the same unit: 1 % of the efficiency for normal noise is
    lost. Deviations in a pit of the smallest size stay below it, because its slopes increase the standard deviation."""
    enlargement: float = 1.7  # ratio of the window's sides before and after an enlargement
    core: float = 0.8  # radius, in radii of the bell, within which all points belong to the indication
    edge_share: float = 0.1
    """Height of the region's edge as a fraction of the blemish's height, as metal loss is boxed in pipe inspection."""
    saddle: float = 0.75
    """Height of a region beside another one, as a fraction of its largest height, from which it is the rest of that."""
    edge_std: float = 3.0  # least height of the region's edge, in standard deviations of a local mean


SEARCH_RULE = BlemishSearchRule()

_MAD_EFFICIENCY = 0.37
"""Efficiency of the median absolute deviation for a normal distribution (Huber, Robust Statistics, 1981, 5.1)."""


@dataclass(frozen=True, eq=False)
class UnrolledSurface:
    """Unrolled surface of N points."""

    places: np.ndarray  # (N, 2); places on the surface, mm
    heights: np.ndarray  # (N,); heights above the undamaged shape, mm
    std: np.ndarray  # (N,); standard deviations of the heights, mm
    footprint_mm: np.ndarray
    """(N, 2); standard deviations, along both axes, of the part of the surface that a point averages over; zero if
    unknown."""
    footprint_std: float = 0.0  # relative standard uncertainty of the squared footprints

    @cached_property
    def corners(self) -> np.ndarray:
        """Least and greatest places (2, 2), mm. NumPy reduces columns ten times as fast as rows of two."""
        return np.array([[of(column) for column in self.places.T] for of in (np.min, np.max)])

    @cached_property
    def usual_std(self) -> float:
        """Median standard deviation of the heights, mm."""
        return float(np.median(self.std))

    def points_between(self, low: np.ndarray, high: np.ndarray) -> np.ndarray:
        """Return the points (K,) int between two corners (2,)."""
        points = np.flatnonzero((self.places[:, 0] > low[0]) & (self.places[:, 0] < high[0]))
        return points[(self.places[points, 1] > low[1]) & (self.places[points, 1] < high[1])]

    @cached_property
    def _cell_sums(self) -> dict[float, tuple[np.ndarray, np.ndarray, np.ndarray]]:
        return {}

    def sum_in_cells(
        self, counted: np.ndarray, origin: np.ndarray, cell: float, shape: tuple[int, int]
    ) -> tuple[np.ndarray, np.ndarray]:
        """Return the sums (I, J) of weights, and of weighted heights, of the ``counted`` (N,) bool points in cells.

        Weights are relative to a point of median noise: heights stay in mm, and the scatter refers to such a point.
        The sums are kept for each size of cells, so that later calls only add or subtract points that differ.
        """
        before, mass, load = self._cell_sums.get(cell, (np.zeros(len(counted), bool), np.zeros(shape), np.zeros(shape)))
        for sign, points in ((1.0, np.flatnonzero(counted > before)), (-1.0, np.flatnonzero(before > counted))):
            if len(points):
                weight = sign * np.square(self.usual_std / self.std[points])
                flat = np.ravel_multi_index(_find_cells(self.places[points], origin, cell, shape), shape)
                mass = mass + np.bincount(flat, weight, mass.size).reshape(shape)
                load = load + np.bincount(flat, weight * self.heights[points], mass.size).reshape(shape)
        self._cell_sums[cell] = counted.copy(), mass, load
        return mass, load


def _find_cells(
    places: np.ndarray, origin: np.ndarray, cell: float, shape: tuple[int, int]
) -> tuple[np.ndarray, np.ndarray]:
    """Return the row and the column (N,) of the cell nearest to each place (N, 2), on a grid with a given corner."""
    rows, columns = (np.clip(((places[:, k] - origin[k]) / cell).astype(np.int32), 0, shape[k] - 1) for k in (0, 1))
    return rows, columns


def limit_deviations(
    surface: UnrolledSurface, tree: KDTree, *, together_mm: float, false_alarm: float
) -> tuple[UnrolledSurface, np.ndarray, float]:
    """Limit the deviations of the points from the medians of their neighbours.

    Outliers of one direction within ``together_mm`` of each other, more than chance explains with the given probability
    of a false alarm, show a small blemish: they are no outliers, and keep their heights.

    Returns the surface with limited deviations; a mask (N,) of outliers, far from their neighbours relative to these
    neighbours' scatter; and the standard deviation of the other points from the medians, divided by that of the limited
    deviations.
    """
    nearest = np.empty((len(surface.places), SEARCH_RULE.neighbours), np.int32)
    middle, spread = np.empty(len(nearest)), np.empty(len(nearest))
    parts = [
        slice(start, start + SEARCH_RULE.points_at_a_time)
        for start in range(0, len(nearest), SEARCH_RULE.points_at_a_time)
    ]
    for part in parts:
        found: Any = tree.query(surface.places[part], k=SEARCH_RULE.neighbours + 1, workers=-1)
        nearest[part] = found[1][:, 1:]
        beside = surface.heights[nearest[part]]
        middle[part] = _find_row_medians(beside)
        spread[part] = MAD_TO_STD * _find_row_medians(np.abs(beside - middle[part, None]))
    usually = float(np.median(spread))
    # Wild points nearby increase the scatter of one place, a blemish that of many.
    spread = np.concatenate([_find_row_medians(spread[nearest[part]]) for part in parts])
    spread = np.maximum(spread, usually)
    off, most = surface.heights - middle, SEARCH_RULE.most_deviation * spread
    outliers, limited = np.abs(off) > SEARCH_RULE.outlier * spread, np.clip(off, -most, most)
    for sign in (-1, 1):
        together = find_together(surface.places, outliers & (sign * off > 0), together_mm, false_alarm)
        outliers[together], limited[together] = False, off[together]
    usual = ~outliers & (spread <= 2 * usually)
    ratio = float(np.std(off[usual]) / max(np.std(limited[usual]), 1e-300)) if usual.any() else 1.0
    return replace(surface, heights=middle + limited), outliers, max(ratio, 1.0)


def find_together(places: np.ndarray, chosen: np.ndarray, radius: float, false_alarm: float) -> np.ndarray:
    """Return the ``chosen`` (N,) bool points (K,) int near more of them than random places would give anywhere.

    Chosen points count as pairs of a binomial distribution, because neighbours along a stripe share their noise.
    """
    points = np.flatnonzero(chosen)
    if len(points) < 2:
        return points[:0]
    tree = KDTree(places[points])
    beside = tree.query_ball_point(places[points], radius, return_length=True) - 1
    pairs, neighbours = 0.5 * len(points), SEARCH_RULE.points_in_smallest - 1
    chances = pairs * stats.binom.sf(np.arange(neighbours + 1) // 2 - 1, neighbours, pairs / len(places))
    rare = chances < false_alarm
    fewest = int(np.argmax(rare)) if rare.any() else neighbours + 1
    full = tree.query_ball_point(places[points[beside >= fewest]], radius)
    return points[np.unique(np.concatenate([np.zeros(0, int), *(np.array(each, int) for each in full)]))]


def _find_row_medians(values: np.ndarray) -> np.ndarray:
    """Return the medians (N,) of rows (N, K) of an odd number of values without NaN, for which NumPy's would look."""
    middle = values.shape[1] // 2
    return np.partition(values, middle, axis=1)[:, middle]


@dataclass(frozen=True, eq=False)
class BellMap:
    """Fitted bells of one radius on a grid of places."""

    radius: float  # radius of the bells, mm
    origin: np.ndarray  # (2,); corner of the grid
    cell: float  # side of a cell, mm
    height: np.ndarray  # (I, J); heights of the bells, mm
    information: np.ndarray  # (I, J); inverse variances of the heights for unit point noise
    spread: np.ndarray  # (I, J); local standard deviation of height times root information
    z: np.ndarray  # (I, J); significance, as a standard normal variable
    area_mm2: float  # searched area
    moments: np.ndarray  # (2,); root spectral moments along both axes, 1/mm
    sides: np.ndarray  # (2,); sides of the searched area, mm

    def false_alarms(self, level: float) -> float:
        """Return the expected Euler characteristic of the region where |z| exceeds a level."""
        bell = np.exp(-0.5 * level**2)
        flat = self.area_mm2 * float(np.prod(self.moments)) * level * bell / (2 * np.pi) ** 1.5
        edge = float(self.sides @ self.moments) * bell / (2 * np.pi)
        return 2 * (flat + edge + float(stats.norm.sf(level)))

    def level_at(self, places: np.ndarray) -> np.ndarray:
        """Return the standard deviation (N,) of a bell's height at places."""
        with np.errstate(invalid="ignore", divide="ignore"):
            level = np.where(np.isfinite(self.z), self.spread / np.sqrt(self.information), np.nan)
        return level[_find_cells(places, self.origin, self.cell, level.shape)]

    def noise_at(self, places: np.ndarray) -> np.ndarray:
        """Return the effective standard deviation (N,) of a point of unit weight at places."""
        return self.spread[_find_cells(places, self.origin, self.cell, self.spread.shape)]


def fit_bells(surface: UnrolledSurface, undamaged: np.ndarray, radius: float) -> BellMap:
    cell = radius / SEARCH_RULE.cells_per_radius
    origin = surface.corners[0] - 0.5 * cell
    shape = tuple((np.floor((surface.corners[1] - surface.corners[0]) / cell).astype(int) + 2).tolist())
    mass, load = surface.sum_in_cells(undamaged, origin, cell, shape)
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
        normal, right = dict(zip(pairs, sums, strict=False)), sums[len(pairs) :]
        # In a nearly empty window neither the plane nor the bell is determined.
        ridge = 1e-9 * (sums[0] + 1e-9)
        # Elimination of the plane for all cells together: a fifth of the time of LAPACK for each.
        for k in range(3):
            pivot = np.where(filled[here], normal[k, k] + ridge, 1.0)
            for i in range(k + 1, 4):
                share = normal[k, i] / pivot
                right[i] = right[i] - share * right[k]
                for j in range(i, 4):
                    normal[i, j] = normal[i, j] - share * normal[k, j]
        information[here], amplitude[here] = normal[3, 3], right[3]
    seen = filled & (information > 1e-9)
    usual = float(np.median(information[seen])) if seen.any() else np.inf
    seen &= information > SEARCH_RULE.least_information * usual
    scaled = np.where(seen, amplitude / np.sqrt(np.where(seen, information, 1.0)), np.nan)
    spread, z = _standardise(scaled, max(1, round(SEARCH_RULE.scatter_block * SEARCH_RULE.cells_per_radius)))
    height = np.where(seen, amplitude / np.where(seen, information, 1.0), np.nan)
    moments = np.array([_estimate_spectral_moment(z, axis, cell) for axis in (0, 1)])
    area = cell**2 * float(np.count_nonzero(seen))
    sides = cell * np.array([np.count_nonzero(seen.any(axis=1)), np.count_nonzero(seen.any(axis=0))])
    return BellMap(radius, origin, cell, height, information, spread, z, area, moments, sides)


def _standardise(values: np.ndarray, block: int) -> tuple[np.ndarray, np.ndarray]:
    """Return the local standard deviation of a field, and the field as a standard normal variable."""
    counts = [max(1, round(length / block)) for length in values.shape]
    edges = [np.linspace(0, length, count + 1).astype(int) for length, count in zip(values.shape, counts, strict=True)]
    middle, spread, freedom = (np.full(counts, np.nan) for _ in range(3))
    for i in range(counts[0]):
        for j in range(counts[1]):
            tile = values[edges[0][i] : edges[0][i + 1], edges[1][j] : edges[1][j + 1]]
            tile = tile[np.isfinite(tile)]
            if len(tile) < 4 * np.pi * SEARCH_RULE.cells_per_radius**2:
                continue
            middle[i, j] = np.median(tile)
            spread[i, j] = MAD_TO_STD * np.median(np.abs(tile - middle[i, j]))
            freedom[i, j] = max(3.0, _MAD_EFFICIENCY * len(tile) / (np.pi * SEARCH_RULE.cells_per_radius**2))
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
    return spread, np.sign(t) * _convert_t_to_normal(np.abs(t), freedom)


def _convert_t_to_normal(t: np.ndarray | float, freedom: np.ndarray | float) -> np.ndarray:
    """Return the standard normal variable of the same tail probability as Student's ``t``, which is not negative."""
    return -special.ndtri(np.clip(special.stdtr(freedom, -np.asarray(t)), 1e-300, 0.5))


def _estimate_spectral_moment(z: np.ndarray, axis: int, cell: float) -> float:
    """Return the root second spectral moment, 1/mm: standard deviation of the slope of a unit-variance field."""
    step = np.diff(z, axis=axis)
    step = step[np.isfinite(step)]
    return 0.0 if len(step) < 10 else robust_std(step) / cell


@dataclass(frozen=True)
class Tail:
    """Distribution of a map without indications: Student's, of the freedom that explains its outer quantiles."""

    freedom: float

    @classmethod
    def of_map(cls, clean: BellMap) -> Tail:
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
        return float(_convert_t_to_normal(strength / self._scale, self.freedom))

    def scatter_at(self, z: float) -> float:
        """Return the height, in robust standard deviations, for a standard normal variable."""
        return float(self._scale * stats.t.isf(stats.norm.sf(z), self.freedom))
