"""Profiles across a weld bead as linear functions of the heights of points, and their largest means despite noise.

Noise biases the maximum upwards: strongly if many values are nearly equal, not at all if one value stands out. Adding
the same noise once more shows the size of the bias (simulation extrapolation, Cook and Stefanski, Journal of the
American Statistical Association 89, 1994).

The interval does not depend on this assumption. Its upper end uses a one-sided bound for the noise of a single mean,
its lower end a bound for the largest noise of all means.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.lib.stride_tricks import sliding_window_view
from scipy import sparse

from uwlts.fitting.least_squares import robust_std
from uwlts.inspection.features import COVERAGE, COVERAGE_FACTOR, SEED

NODES = (-np.sqrt(3.0), 1 / 6), (0.0, 2 / 3), (np.sqrt(3.0), 1 / 6)
"""Places and weights of a normal distribution (Gauss-Hermite, exact to the fifth power)."""
NO_WEIGHT = 1e-9  # sum of absolute weights that counts as zero: rounding errors are smaller


@dataclass(frozen=True, eq=False)
class BeadProfiles:
    """Linear operators from point heights to profiles on a grid across each of S sections, G places each."""

    across_mm: np.ndarray  # (G,); places of the grid across the weld
    # (n,) each; places of the points across the weld, and the sizes of their footprints across it.
    places_mm: np.ndarray
    size_mm: np.ndarray
    sections: int  # number of sections S
    smooth: sparse.csr_array  # (S G, n) sparse; local quadratics through the points
    plates: tuple[tuple[np.ndarray, np.ndarray], tuple[np.ndarray, np.ndarray]]
    """Two pairs of (n, 3) and (3, n); for each plate: design of its level and slopes, weighted with its part in the
    reference, and its least-squares rows."""
    seen: sparse.csr_array  # (n, S G) sparse; heights that points with their footprints measure on given profiles
    sharp: sparse.csr_array  # (n, S G) sparse; heights that points without a footprint would measure

    def subtract_plates(self, heights: np.ndarray) -> np.ndarray:
        """Return heights (n,) of the points above the plates."""
        return heights - sum(base @ (rows @ heights) for base, rows in self.plates)

    def observe(self, middle: float, height: float, half: float, exponent: int) -> np.ndarray:
        """Return the heights (n,) that the points measure on a straight bead H (1 - (d / half)^2)^exponent."""
        parts = [(weight, (self.places_mm - middle + node * self.size_mm) / half) for node, weight in NODES]
        return sum((part * height * np.maximum(1 - t * t, 0) ** exponent for part, t in parts), np.zeros(1))

    def evaluate(self, heights: np.ndarray, *, steps: int = 1, share: float = 1.0) -> np.ndarray:
        """Return the profiles (S, G) for point heights (n,).

        Smoothing is corrected ``steps`` times. ``share`` scales the footprints' part in this correction.
        """
        left = self.subtract_plates(heights)
        profiles = self.smooth @ left
        known = np.isfinite(profiles)
        # Next to missing lines the correction is unknown.
        whole = abs(self.seen) @ ~known < NO_WEIGHT
        for _ in range(steps):
            filled = np.where(known, profiles, 0.0)
            there = share * (self.seen @ filled) + (1 - share) * (self.sharp @ filled)
            profiles = profiles + self.smooth @ np.where(whole, left - there, 0.0)
        return profiles.reshape(self.sections, len(self.across_mm))


def profile_rows(
    across: np.ndarray, section: np.ndarray, count: int, grid: np.ndarray, bandwidth: float
) -> sparse.csr_array:
    """Return rows (S G, n) that give local quadratics across each section as products with heights.

    Rows without enough points are NaN.
    """
    order = np.lexsort((across, section))
    starts = np.searchsorted(section[order], np.arange(count + 1))
    columns, values, lengths = [], [], [0]
    for k in range(count):
        members = order[starts[k] : starts[k + 1]]
        place = across[members]
        nothing = members[:1] if len(members) else order[:1]
        first, last = np.searchsorted(place, grid - bandwidth), np.searchsorted(place, grid + bandwidth)
        for middle, a, b in zip(grid, first, last, strict=True):
            u, row, near = (place[a:b] - middle) / bandwidth, np.array([np.nan]), nothing
            if len(u) >= 5 and u[0] <= -0.2 and u[-1] >= 0.2:
                design = np.stack([np.ones(len(u)), u, u * u], axis=1)
                loaded = (design * np.maximum(1 - u * u, 0)[:, None]).T
                if np.linalg.cond(normal := loaded @ design) <= 1e6:
                    row, near = np.linalg.solve(normal, np.eye(3)[0]) @ loaded, members[a:b]
            columns.append(near)
            values.append(row)
            lengths.append(lengths[-1] + len(row))
    parts = np.concatenate(values), np.concatenate(columns), np.array(lengths)
    return sparse.csr_array(parts, shape=(count * len(grid), len(across)))


def interpolation_rows(across: np.ndarray, section: np.ndarray, count: int, grid: np.ndarray) -> sparse.csr_array:
    """Return rows (n, S G) that interpolate profiles at places (n,) of given sections."""
    at, weight = cubic_weights((across - grid[0]) / (grid[1] - grid[0]), len(grid))
    columns, rows = section[:, None] * len(grid) + at, np.repeat(np.arange(len(across)), 4)
    return sparse.csr_array((weight.ravel(), (rows, columns.ravel())), shape=(len(across), count * len(grid)))


def cubic_weights(cells: np.ndarray, length: int) -> tuple[np.ndarray, np.ndarray]:
    """Return four nodes (n, 4) of a grid beside places (n,) in cells, and their weights, zero beyond the border.

    Cubic convolution, exact for quadratics (Keys, IEEE Transactions on Acoustics, Speech and Signal Processing 29,
    1981, Eq. 15).
    """
    at = np.floor(cells).astype(int)[:, None] + np.arange(-1, 3)
    dist = np.abs(cells[:, None] - at)
    weight = np.where(dist <= 1, (1.5 * dist - 2.5) * dist**2 + 1, ((-0.5 * dist + 2.5) * dist - 4) * dist + 2)
    return np.clip(at, 0, length - 1), np.where((at >= 0) & (at < length), weight, 0.0)


_DRAWS = 2000  # noise draws: fifty exceed the 97.5 % quantile, which is then known to a tenth of a standard deviation
BIAS_FACTOR = 1 / (np.sqrt(2) - 1)
"""Bias by the noise divided by the increase when the noise is added once more, for a bias proportional to its std."""


class Largest(NamedTuple):
    """Largest mean, the ends of its 95 % interval, and the weights (n,) of the values of each profile in it."""

    value: float
    low: float
    high: float
    weights: tuple[np.ndarray, ...]


def largest_mean(profiles: Sequence[np.ndarray], count: int, *, noise: float | None = None) -> Largest:
    """Return the largest mean of ``count`` neighbours in any of the profiles (n,), whose noise is independent.

    NaN values are unknown: means use known neighbours only. The result is NaN if all values are unknown.

    The standard deviation ``noise`` is estimated from differences of neighbours by default (von Neumann et al.,
    Annals of Mathematical Statistics 12, 1941). This estimate is robust to outliers and also contains real changes from
    one value to the next.
    """
    known = [np.flatnonzero(np.isfinite(profile)) for profile in profiles]
    owns = [profile[one] for profile, one in zip(profiles, known, strict=True) if len(one)]
    weights = [np.zeros(len(profile)) for profile in profiles]
    if not owns:
        return Largest(np.nan, np.nan, np.nan, tuple(weights))
    jumps = np.concatenate([np.diff(one) for one in owns])
    seen_noise = robust_std(jumps) / np.sqrt(2) if len(jumps) else 0.0
    std = seen_noise if noise is None else noise
    rng = np.random.default_rng(SEED)
    means = [_average_neighbours(one[None], count) for one in owns]
    drawn = [_average_neighbours(std * rng.standard_normal((_DRAWS, len(one))), count) for one in owns]
    seen = max(float(each.max()) for each in means)
    alone = np.max([each.max(axis=1) for each in drawn], axis=0)
    again = np.max([(mean + move).max(axis=1) for mean, move in zip(means, drawn, strict=True)], axis=0)
    tail = 0.5 * (1 - COVERAGE)
    low = seen - float(np.quantile(alone, 1 - tail))
    high = seen + COVERAGE_FACTOR * max(float(each.std(axis=0).max()) for each in drawn)
    value = float(np.clip(seen - BIAS_FACTOR * (again.mean() - seen), low, high))
    for number, one in enumerate(k for k in range(len(profiles)) if len(known[k])):
        if float(means[number].max()) == seen:
            first = int(np.argmax(means[number]))
            weights[one][known[one][first : first + min(count, len(known[one]))]] = 1 / min(count, len(known[one]))
            break
    return Largest(value, low, high, tuple(weights))


def _average_neighbours(values: np.ndarray, count: int) -> np.ndarray:
    """Return means (M, n - count + 1) of neighbours in rows of values (M, n)."""
    return sliding_window_view(values, min(count, values.shape[1]), axis=1).mean(axis=2)
