"""Poisson numbers for a whole image, several times faster than one at a time where few electrons are expected.

Most pixels of a laser image are nearly dark. Their mean is split, m = m_j + r, with m_j on a grid of steps h and
0 <= r < h. The part of m_j is found by inversion in a table: one of 4096 equal cells of the unit interval holds the
uniform number, and nearly all cells belong to a single count; the others, and with them the tail, are settled by a
further uniform number and the distribution function. The part of r is a Poisson process of density h over all pixels
of which each event is kept with probability r / h (L. Devroye, Non-Uniform Random Variate Generation, 1986, sections
III.2.4 and VI.1.3). Sums of Poisson numbers are Poisson's, so the result is exact to the resolution of a double.
"""

from functools import cache

import numpy as np
from scipy import special

STEP = 0.125
LARGEST_MEAN = 32.0
"""Means from here on are left to NumPy."""
_LEVELS = int(LARGEST_MEAN / STEP)
_CELLS = 4096
_COUNTS = 120
"""Counts with a probability above 1e-17 for every mean in the table."""
_SEVERAL = 255


def poisson_numbers(mean: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """Poisson random numbers, float32, of the shape of their means (float32, finite, not negative)."""
    flat = mean.ravel()
    large = np.flatnonzero(flat >= LARGEST_MEAN)
    if large.size == flat.size:
        return rng.poisson(mean).astype(np.float32)
    if large.size:
        flat = flat.copy()
        flat[large] = 0.0
    numbers = _small_poisson_numbers(flat, rng)
    numbers[large] = rng.poisson(mean.ravel()[large])
    return numbers.reshape(mean.shape)


def _small_poisson_numbers(mean: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """Poisson random numbers (N,), float32, of means (N,) below LARGEST_MEAN."""
    count_of_cell, distribution = _tables()
    share = mean * np.float32(1 / STEP)
    entry = share.astype(np.intp)
    share -= entry
    entry *= _CELLS
    # Sixteen bits at a time come fastest; the upper twelve choose the cell.
    entry += rng.integers(0, 2**16, mean.size, dtype=np.uint16) >> 4
    numbers = count_of_cell[entry]
    open_ = np.flatnonzero(numbers == _SEVERAL)
    level, cell = np.divmod(entry[open_], _CELLS)
    uniform = (cell + rng.random(open_.size)) / _CELLS
    numbers[open_] = np.count_nonzero(distribution[level] <= uniform[:, None], axis=1)
    events = rng.integers(0, mean.size, rng.poisson(STEP * mean.size))
    np.add.at(numbers, events[rng.random(events.size) < share[events]], np.uint8(1))
    return numbers.astype(np.float32)


@cache
def _tables() -> tuple[np.ndarray, np.ndarray]:
    """The count of every cell of every level (levels * cells,), and the distribution functions (levels, counts)."""
    distribution = special.pdtr(np.arange(_COUNTS), STEP * np.arange(_LEVELS)[:, None])
    edges = np.arange(_CELLS + 1) / _CELLS
    lowest = np.array([np.searchsorted(row, edges[:-1], side="right") for row in distribution])
    highest = np.array([np.searchsorted(row, edges[1:], side="left") for row in distribution])
    return np.where(lowest == highest, lowest, _SEVERAL).astype(np.uint8).ravel(), distribution
