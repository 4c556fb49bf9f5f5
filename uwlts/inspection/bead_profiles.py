"""Profiles across a weld bead as linear functions of the heights of points."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy import sparse

NODES = (-np.sqrt(3.0), 1 / 6), (0.0, 2 / 3), (np.sqrt(3.0), 1 / 6)
"""Places and weights of a normal distribution (Gauss-Hermite, exact to the fifth power)."""
NO_WEIGHT = 1e-9
"""Sum of absolute weights that counts as zero: rounding errors are smaller."""


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
        own = order[starts[k] : starts[k + 1]]
        place = across[own]
        nothing = own[:1] if len(own) else order[:1]
        first, last = np.searchsorted(place, grid - bandwidth), np.searchsorted(place, grid + bandwidth)
        for middle, a, b in zip(grid, first, last, strict=True):
            u = (place[a:b] - middle) / bandwidth
            row = _quadratic_row(u)
            columns.append(own[a:b] if row is not None else nothing)
            values.append(row if row is not None else np.array([np.nan]))
            lengths.append(lengths[-1] + len(values[-1]))
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
    away = np.abs(cells[:, None] - at)
    weight = np.where(away <= 1, (1.5 * away - 2.5) * away**2 + 1, ((-0.5 * away + 2.5) * away - 4) * away + 2)
    return np.clip(at, 0, length - 1), np.where((at >= 0) & (at < length), weight, 0.0)


def _quadratic_row(u: np.ndarray) -> np.ndarray | None:
    """Return the weights of values at places u of the value at 0 of a local quadratic; None if undetermined."""
    if len(u) < 5 or u.min() > -0.2 or u.max() < 0.2:
        return None
    weight = np.maximum(1 - u * u, 0)
    design = np.stack([np.ones(len(u)), u, u * u], axis=1)
    normal = (design * weight[:, None]).T @ design
    if np.linalg.cond(normal) > 1e6:
        return None
    return np.linalg.solve(normal, np.eye(3)[0]) @ (design * weight[:, None]).T
