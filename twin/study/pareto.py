"""Which designs nothing beats in every respect: the Pareto front."""

from __future__ import annotations

import numpy as np

from uwlts.errors import RangeError


def pareto(values: np.ndarray) -> np.ndarray:
    """Which of N designs lie on the front of M values to minimise.

    A design lies on it if no other is at least as good in all values and better in one; equal designs stand or fall
    together. Two values take a sort, more a pass over the designs for every design of the front (Kung et al. 1975).

    Parameters
    ----------
    values : (N, M) float
        Smaller is better. A design with a value NaN is no candidate: it is not on the front and beats nobody.

    Returns
    -------
    (N,) bool

    Raises
    ------
    RangeError
        The values are no table with at least one column.
    """
    values = np.asarray(values, dtype=np.float64)
    if values.ndim != 2 or values.shape[1] == 0:
        raise RangeError(f"the values have the shape {values.shape}; expected (designs, values), at least one value")
    front = np.zeros(len(values), dtype=bool)
    candidates = np.flatnonzero(~np.isnan(values).any(axis=1))
    if len(candidates):
        of_two = values.shape[1] <= 2
        front[candidates] = (_front_of_two if of_two else _front_of_many)(values[candidates])
    return front


def _front_of_two(values: np.ndarray) -> np.ndarray:
    """The front of one or two values: of equal first ones the least second, if it is less than all before."""
    first, second = values[:, 0], values[:, -1]
    order = np.lexsort((second, first))
    first, second = first[order], second[order]
    starts = np.concatenate([[True], first[1:] > first[:-1]])
    least, group = second[starts], np.cumsum(starts) - 1
    better = np.concatenate([[True], least[1:] < np.minimum.accumulate(least)[:-1]])
    front = np.empty(len(values), dtype=bool)
    front[order] = (second == least[group]) & better[group]
    return front


def _front_of_many(values: np.ndarray) -> np.ndarray:
    """The front by elimination: nothing beats the lexicographically first of those that are left."""
    left = np.lexsort(values.T[::-1])
    front = np.zeros(len(values), dtype=bool)
    while len(left):
        best = values[left[0]]
        front[left[(values[left] == best).all(axis=1)]] = True
        left = left[(values[left] < best).any(axis=1)]
    return front
