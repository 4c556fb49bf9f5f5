"""Random numbers for every pixel of an image: Poisson numbers with individual means, and normal ones.

Each takes a few nanoseconds, several times less than NumPy's, whose generators are called once per number.
"""

from __future__ import annotations

import math
from functools import cache

import numpy as np
from scipy import special

from uwlts.runtime.compiled import compiled, compiled_part

POISSON_STEP = 0.125
"""Step of the means tabulated by `poisson_numbers`; smaller steps need a larger table and fewer events."""
LARGEST_MEAN = 32.0  # NumPy generates numbers with means from here on
_LEVELS = int(LARGEST_MEAN / POISSON_STEP)
_CELLS = 4096
"""Cells of the unit interval in a table; twelve bits of a random number select one."""
_COUNTS = 120  # number of tabulated counts: those with a probability above 1e-17 for some mean in the table
_SEVERAL = 255  # marks a cell that belongs to several counts

_LAYERS = 256  # of the ziggurat, with the edge and area below (Marsaglia and Tsang 2000)
_LAST_EDGE = 3.6541528853610088
"""Start of the tail, the outer edge of the last layer under exp(-x^2 / 2) (Marsaglia and Tsang 2000)."""
_LAYER_AREA = 4.92867323399e-3  # area of each layer
_MANTISSA = 2**24  # number of positions within a layer, the resolution of single precision


def poisson_numbers(mean: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """Return Poisson random numbers, float32, for means (float32, finite, not negative) of any shape.

    Most pixels of a laser image are nearly dark; for these, this is many times faster than NumPy. A mean is split into
    m = m_j + r, with m_j on a grid of step h and 0 <= r < h. The number for m_j is found by table inversion. A uniform
    number selects one of 4096 equal cells of the unit interval, and nearly all cells belong to a single count. In the
    other cells, which include the tail, another uniform number and the distribution function determine the count.

    The number for r comes from a Poisson process of density h over all pixels. Each of its events is kept with the
    probability r / h (L. Devroye, Non-Uniform Random Variate Generation, 1986, sections III.2.4 and VI.1.3). A sum of
    Poisson numbers is a Poisson number, so the result is exact to double precision.
    """
    flat = np.ascontiguousarray(mean).ravel()
    numbers = np.empty(flat.shape, np.float32)
    _fill_small_poisson(flat, *_make_poisson_tables(), _start(rng), rng.poisson(POISSON_STEP * flat.size), numbers)
    large = np.flatnonzero(flat >= LARGEST_MEAN)
    numbers[large] = rng.poisson(flat[large])
    return numbers.reshape(mean.shape)


def add_normal_numbers(values: np.ndarray, deviation: float, rng: np.random.Generator) -> None:
    """Add normal random numbers with mean 0 and a standard deviation to a contiguous array, float32, in place.

    The ziggurat method is used, which divides the density into layers, mostly rectangles (Marsaglia and Tsang, "The
    ziggurat method for generating random variables", J. Statist. Software 5, 2000). It is exact to the resolution of 32
    bits.
    """
    _add_normal_numbers(values.ravel(), deviation, *_make_layers(), _start(rng))


def _start(rng: np.random.Generator) -> np.uint64:
    """Return an initial state for `_next`, different at every call."""
    return rng.integers(0, 2**64, dtype=np.uint64)


@compiled_part
def _next(state: np.uint64) -> np.uint64:
    """Return the next state of SplitMix64 (Steele, Lea and Flood 2014, Fig. 17); `_mix` turns it into random bits."""
    return _advance(state, 1)


@compiled_part
def _advance(state: np.uint64, steps: int) -> np.uint64:
    """Return the state after a number of steps."""
    return state + np.uint64(steps) * np.uint64(0x9E3779B97F4A7C15)


@compiled_part
def _mix(state: np.uint64) -> np.uint64:
    """Return 64 random bits from a state."""
    z = (state ^ (state >> np.uint64(30))) * np.uint64(0xBF58476D1CE4E5B9)
    z = (z ^ (z >> np.uint64(27))) * np.uint64(0x94D049BB133111EB)
    return z ^ (z >> np.uint64(31))


@compiled_part
def _draw_uniform(state: np.uint64) -> float:
    """Return a uniform number in [0, 1) from a state."""
    return np.float64(_mix(state) >> np.uint64(11)) * 2.0**-53


@compiled
def _fill_small_poisson(
    mean: np.ndarray,
    count_of_cell: np.ndarray,
    distribution: np.ndarray,
    state: np.uint64,
    events: int,
    numbers: np.ndarray,
) -> None:
    """Write Poisson random numbers (N,) for means (N,) below LARGEST_MEAN to ``numbers``, and 0 for others.

    ``events`` is the number of events of the process for the remainders. Each number has its own states: a rounding
    difference in one mean, as on another processor, does not change other numbers.
    """
    step = np.float32(POISSON_STEP)
    for i in range(len(mean)):
        if mean[i] >= LARGEST_MEAN:
            numbers[i] = 0
            continue
        level = np.int64(mean[i] / step)
        stream = _advance(state, 2 * i)
        cell = np.int64(_mix(stream) >> np.uint64(52))
        count = np.int64(count_of_cell[level, cell])
        if count == _SEVERAL:
            uniform = (cell + _draw_uniform(_next(stream))) / _CELLS
            count = 0
            while distribution[level, count] <= uniform:
                count += 1
        numbers[i] = count
    state = _advance(state, 2 * len(mean))
    for _ in range(events):
        state = _next(state)
        i = np.int64(_draw_uniform(state) * len(mean))
        state = _next(state)
        if mean[i] < LARGEST_MEAN and _draw_uniform(state) < mean[i] / step - np.floor(mean[i] / step):
            numbers[i] += 1


@cache
def _make_poisson_tables() -> tuple[np.ndarray, np.ndarray]:
    """Return the count of every cell (levels, cells), and the distribution functions (levels, counts)."""
    distribution = special.pdtr(np.arange(_COUNTS), POISSON_STEP * np.arange(_LEVELS)[:, None])
    distribution[:, -1] = 1.0  # rounding may leave it below the largest uniform number
    edges = np.arange(_CELLS + 1) / _CELLS
    lowest = np.array([np.searchsorted(row, edges[:-1], side="right") for row in distribution])
    highest = np.array([np.searchsorted(row, edges[1:], side="left") for row in distribution])
    return np.where(lowest == highest, lowest, _SEVERAL).astype(np.uint8), distribution


@compiled
def _add_normal_numbers(
    values: np.ndarray, deviation: float, edges: np.ndarray, heights: np.ndarray, inner: np.ndarray, state: np.uint64
) -> None:
    """Add normal numbers as `add_normal_numbers`; ``edges``, ``heights`` and ``inner`` come from `_make_layers`."""
    for i in range(len(values)):
        while True:
            state = _next(state)
            bits = _mix(state)
            layer = np.int64(bits & np.uint64(_LAYERS - 1))
            place = np.int64(bits >> np.uint64(40))
            x = place * edges[layer]
            if place < inner[layer]:
                break
            state = _next(state)
            if layer == 0:
                # Tail beyond the last edge r: accept x = r - log(u) / r with the probability exp(-(x - r)^2 / 2)
                # (Marsaglia 1964).
                beyond = -math.log(1 - _draw_uniform(state)) / _LAST_EDGE
                state = _next(state)
                while -2 * math.log(1 - _draw_uniform(state)) < beyond * beyond:
                    state = _next(state)
                    beyond = -math.log(1 - _draw_uniform(state)) / _LAST_EDGE
                    state = _next(state)
                x = _LAST_EDGE + beyond
                break
            if heights[layer] + (heights[layer + 1] - heights[layer]) * _draw_uniform(state) < math.exp(-0.5 * x * x):
                break
        values[i] += np.float32(deviation * (-x if bits & np.uint64(_LAYERS) else x))


@cache
def _make_layers() -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return outer edges divided by `_MANTISSA` (L,), floor heights (L + 1,) and inner parts (L,) of the layers.

    Layers are numbered from below. The lowest one contains the tail; its width is that of a rectangle with its area. A
    position, from 0 to `_MANTISSA`, that is below the inner part is under the density at every height of the layer.
    """
    edges = [_LAYER_AREA / math.exp(-0.5 * _LAST_EDGE**2), _LAST_EDGE]
    while len(edges) < _LAYERS:
        edges.append(math.sqrt(-2 * math.log(_LAYER_AREA / edges[-1] + math.exp(-0.5 * edges[-1] ** 2))))
    outer, above = np.array(edges), np.array([*edges[1:], 0.0])
    heights = np.concatenate([[0.0], np.exp(-0.5 * above**2)])
    return outer / _MANTISSA, heights, (above / outer * _MANTISSA).astype(np.int64)
