"""Random numbers for every pixel of an image: Poisson's, each of its own mean, and normal ones.

They take a few nanoseconds each, several times less than NumPy's, whose generators are called once for each number.
"""

from __future__ import annotations

import math
from functools import cache

import numpy as np
from scipy import special

from uwlts.runtime.compiled import compiled, compiled_part

POISSON_STEP = 0.125
"""Step of the means for which `poisson_numbers` has a table; smaller ones make a larger table and fewer events."""
LARGEST_MEAN = 32.0
"""Means from here on are left to NumPy."""
_LEVELS = int(LARGEST_MEAN / POISSON_STEP)
_CELLS = 4096
"""Cells of the unit interval in a table: twelve bits of a random number choose one."""
_COUNTS = 120
"""Counts with a probability above 1e-17 for every mean in the table."""
_SEVERAL = 255
"""Marks a cell that does not belong to a single count."""

_LAYERS = 256
_LAST_EDGE = 3.6541528853610088
"""Of layers under exp(-x^2 / 2), where the last one begins its tail (Marsaglia and Tsang 2000)."""
_LAYER_AREA = 4.92867323399e-3
"""Area of each of them."""
_MANTISSA = 2**24
"""Numbers that a layer is divided into: as many as 32 bits tell apart."""


def poisson_numbers(mean: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """Poisson random numbers, float32, of the shape of their means (float32, finite, not negative).

    Most pixels of a laser image are nearly dark, for which this is many times faster than NumPy. A mean is split,
    m = m_j + r, with m_j on a grid of steps h and 0 <= r < h. The part of m_j is found by inversion in a table: one of
    4096 equal cells of the unit interval holds the uniform number, and nearly all cells belong to a single count; the
    others, and with them the tail, are settled by a further uniform number and the distribution function. The part of r
    is a Poisson process of density h over all pixels of which each event is kept with probability r / h (L. Devroye,
    Non-Uniform Random Variate Generation, 1986, sections III.2.4 and VI.1.3). Sums of Poisson numbers are Poisson's, so
    the result is exact to the resolution of a double.
    """
    flat = np.ascontiguousarray(mean).ravel()
    numbers = np.empty(flat.shape, np.float32)
    _small_poisson_numbers(flat, *_poisson_tables(), _start(rng), rng.poisson(POISSON_STEP * flat.size), numbers)
    large = np.flatnonzero(flat >= LARGEST_MEAN)
    numbers[large] = rng.poisson(flat[large])
    return numbers.reshape(mean.shape)


def add_normal_numbers(values: np.ndarray, deviation: float, rng: np.random.Generator) -> None:
    """Add normal random numbers of mean 0 and a standard deviation to a contiguous array, float32, in place.

    They come from layers of the density, most of which is a pile of rectangles (Marsaglia and Tsang, "The ziggurat
    method for generating random variables", J. Statist. Software 5, 2000), exact to the resolution of 32 bits.
    """
    _add_normal_numbers(values.ravel(), deviation, *_layers(), _start(rng))


def _start(rng: np.random.Generator) -> np.uint64:
    """A state from which `_next` goes on, another one at every call."""
    return rng.integers(0, 2**64, dtype=np.uint64)


@compiled_part
def _next(state: np.uint64) -> np.uint64:
    """The next state; its bits are made random by `_mixed` (SplitMix64: Steele, Lea and Flood 2014, Fig. 17)."""
    return _later(state, 1)


@compiled_part
def _later(state: np.uint64, steps: int) -> np.uint64:
    """The state after so many steps."""
    return state + np.uint64(steps) * np.uint64(0x9E3779B97F4A7C15)


@compiled_part
def _mixed(state: np.uint64) -> np.uint64:
    """Random 64 bits of a state."""
    z = (state ^ (state >> np.uint64(30))) * np.uint64(0xBF58476D1CE4E5B9)
    z = (z ^ (z >> np.uint64(27))) * np.uint64(0x94D049BB133111EB)
    return z ^ (z >> np.uint64(31))


@compiled_part
def _uniform(state: np.uint64) -> float:
    """A uniform number from 0 to 1, without 1, of a state."""
    return np.float64(_mixed(state) >> np.uint64(11)) * 2.0**-53


@compiled
def _small_poisson_numbers(
    mean: np.ndarray,
    count_of_cell: np.ndarray,
    distribution: np.ndarray,
    state: np.uint64,
    events: int,
    numbers: np.ndarray,
) -> None:
    """Poisson random numbers (N,) of means (N,) below LARGEST_MEAN; others are left 0. ``events`` are drawn in all.

    Each number has states of its own, so that rounding of one mean, as on another processor, changes no other number.
    """
    step = np.float32(POISSON_STEP)
    for i in range(len(mean)):
        if mean[i] >= LARGEST_MEAN:
            numbers[i] = 0
            continue
        level = np.int64(mean[i] / step)
        own = _later(state, 2 * i)
        cell = np.int64(_mixed(own) >> np.uint64(52))
        count = np.int64(count_of_cell[level, cell])
        if count == _SEVERAL:
            uniform = (cell + _uniform(_next(own))) / _CELLS
            count = 0
            while distribution[level, count] <= uniform:
                count += 1
        numbers[i] = count
    state = _later(state, 2 * len(mean))
    for _ in range(events):
        state = _next(state)
        i = np.int64(_uniform(state) * len(mean))
        state = _next(state)
        if mean[i] < LARGEST_MEAN and _uniform(state) < mean[i] / step - np.floor(mean[i] / step):
            numbers[i] += 1


@cache
def _poisson_tables() -> tuple[np.ndarray, np.ndarray]:
    """The count of every cell of every level (levels, cells), and the distribution functions (levels, counts)."""
    distribution = special.pdtr(np.arange(_COUNTS), POISSON_STEP * np.arange(_LEVELS)[:, None])
    distribution[:, -1] = 1.0  # in rounding it may stay below the largest uniform number
    edges = np.arange(_CELLS + 1) / _CELLS
    lowest = np.array([np.searchsorted(row, edges[:-1], side="right") for row in distribution])
    highest = np.array([np.searchsorted(row, edges[1:], side="left") for row in distribution])
    return np.where(lowest == highest, lowest, _SEVERAL).astype(np.uint8), distribution


@compiled
def _add_normal_numbers(
    values: np.ndarray, deviation: float, edges: np.ndarray, heights: np.ndarray, inner: np.ndarray, state: np.uint64
) -> None:
    """As `add_normal_numbers`, with the layers' ``edges``, ``heights`` and ``inner`` parts of `_layers`."""
    for i in range(len(values)):
        while True:
            state = _next(state)
            bits = _mixed(state)
            layer = np.int64(bits & np.uint64(_LAYERS - 1))
            place = np.int64(bits >> np.uint64(40))
            x = place * edges[layer]
            if place < inner[layer]:
                break
            state = _next(state)
            if layer == 0:
                # The tail beyond the last edge r: of x = r - log(u) / r the share exp(-(x - r)^2 / 2) is accepted
                # (Marsaglia 1964).
                beyond = -math.log(1 - _uniform(state)) / _LAST_EDGE
                state = _next(state)
                while -2 * math.log(1 - _uniform(state)) < beyond * beyond:
                    state = _next(state)
                    beyond = -math.log(1 - _uniform(state)) / _LAST_EDGE
                    state = _next(state)
                x = _LAST_EDGE + beyond
                break
            if heights[layer] + (heights[layer + 1] - heights[layer]) * _uniform(state) < math.exp(-0.5 * x * x):
                break
        values[i] += np.float32(deviation * (-x if bits & np.uint64(_LAYERS) else x))


@cache
def _layers() -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Of layers from below: outer edges over `_MANTISSA` (L,), heights of their floors (L + 1,), inner parts (L,).

    The lowest one holds the tail, and is as wide as a rectangle of its area would be. Of the numbers up to
    `_MANTISSA`, those below the inner part lie under the density at all of the layer's heights.
    """
    edges = [_LAYER_AREA / math.exp(-0.5 * _LAST_EDGE**2), _LAST_EDGE]
    while len(edges) < _LAYERS:
        edges.append(math.sqrt(-2 * math.log(_LAYER_AREA / edges[-1] + math.exp(-0.5 * edges[-1] ** 2))))
    outer, above = np.array(edges), np.array([*edges[1:], 0.0])
    heights = np.concatenate([[0.0], np.exp(-0.5 * above**2)])
    return outer / _MANTISSA, heights, (above / outer * _MANTISSA).astype(np.int64)
