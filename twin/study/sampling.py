"""Which designs a study judges: grids, random draws and Sobol sequences, every design known by its number alone."""

from __future__ import annotations

import math
import warnings

import numpy as np
from scipy.stats import qmc

from twin.study.description import Study
from twin.study.designs import Design


def number_of_designs(study: Study) -> int:
    """How many designs a study judges."""
    if study.sampling.kind != "grid":
        return study.sampling.designs
    return math.prod(len(variable.grid()) for variable in study.free().values())


def designs_of(study: Study, first: int, count: int) -> list[Design]:
    """Designs ``first`` to ``first + count - 1`` of a grid (the last variable runs fastest), random or Sobol study."""
    numbers = range(first, min(first + count, number_of_designs(study)))
    free = study.free()
    if study.sampling.kind == "grid":
        grids = [variable.grid() for variable in free.values()]
        places = np.unravel_index(np.array(numbers), [len(grid) for grid in grids])
        chosen = ([grid[k] for grid, k in zip(grids, row, strict=True)] for row in zip(*places, strict=True))
    else:
        shares = _shares(study, numbers)
        chosen = ([v.taken(v.at(float(s))) for v, s in zip(free.values(), row, strict=True)] for row in shares)
    return [
        Design(number, dict(zip(free, values, strict=True))) for number, values in zip(numbers, chosen, strict=True)
    ]


def _shares(study: Study, numbers: range) -> np.ndarray:
    """Points (N, V) of the unit cube."""
    variables, seed = len(study.free()), study.sampling.seed
    if study.sampling.kind == "random":
        return np.array([np.random.default_rng([seed, number]).random(variables) for number in numbers])
    sequence = qmc.Sobol(variables, rng=np.random.default_rng(seed))
    with warnings.catch_warnings():
        # A part of the sequence need not be a power of two long: the whole counts.
        warnings.simplefilter("ignore", UserWarning)
        if numbers.start > 0:
            sequence.fast_forward(numbers.start)
        return sequence.random(len(numbers))
