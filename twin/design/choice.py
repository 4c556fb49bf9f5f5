"""Choice of the design to build: the Pareto front, the best design, and others to look at."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from twin.design.description import Study
from twin.design.designs import Columns, Design, Marked, built, described, judged, row_of
from twin.design.refinement import refined
from uwlts.model.errors import DesignError, Error, RangeError


def pareto(values: np.ndarray) -> np.ndarray:
    """Which of N designs lie on the front of M values to minimise.

    A design lies on it if no other is at least as good in all values and better in one; equal designs stand or fall
    together. Two values take a sort, more a pass over the designs for every design of the front (Kung et al. 1975).

    Parameters
    ----------
    values : (N, M) float
        Smaller is better. A design with a value NaN is no candidate: it is not on the front and beats no other.

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


@dataclass(frozen=True)
class Chosen:
    """The base sensor if it works, then the best design, then the refined one if it is better: the last one wins."""

    marked: tuple[Marked, ...]
    further: tuple[Marked, ...]
    notes: tuple[str, ...]


def choose(study: Study, columns: Columns) -> Chosen:
    """The best design by the first objective among those that meet the constraints, and others to be looked at.

    Where none meets them, the one that misses them least is taken, and said so. ``further`` are designs spread over
    the Pareto front, as many as the study wants rendered beside the best.

    Raises
    ------
    DesignError
        No design works.
    """
    marked, notes = [], []
    base = study.sensor
    try:
        marked.append(Marked(f"{base.name} (as described)", base, described(study, "base", base)))
    except Error as error:
        notes.append(f"The base sensor itself cannot work: {error}.")
    violation = columns["violation"]
    if not np.isfinite(violation).any():
        raise DesignError(
            f"none of {len(violation)} designs can work; the first one: {columns['failure'][0]}: widen the ranges"
        )
    costs = np.stack([_cost(columns[o.figure], o.goal) for o in study.objectives], axis=1)
    meets = violation == 0
    if not meets.any():
        notes.append("No design meets all constraints; the chosen one misses them least.")
        meets = violation == violation.min()
    costs[~meets] = np.inf
    best = int(np.argmin(costs[:, 0]))
    front = np.flatnonzero(meets)[pareto(costs[meets])]
    winner = _design(columns, best)
    marked.append(Marked(f"best of the sweep (design {winner.number})", built(study, winner), row_of(columns, best)))
    if study.refine and (better := refined(study, winner, _better_than(study, columns, best))) is not None:
        marked.append(Marked("refined along the gradient", built(study, better), row_of(judged(study, [better]), 0)))
    front = front[np.argsort(costs[front, 0])]
    spread = front[np.unique(np.linspace(0, len(front) - 1, study.verify + 1).round().astype(int))]
    others = [_design(columns, int(place)) for place in spread if place != best][: max(study.verify - 1, 0)]
    further = [
        Marked(f"on the Pareto front (design {d.number})", built(study, d), row_of(judged(study, [d]), 0))
        for d in others
    ]
    return Chosen(tuple(marked), tuple(further), tuple(notes))


def _better_than(study: Study, columns: Columns, place: int) -> Callable[[Design], bool]:
    """Whether a design is better than one of the sweep, by the same formulas."""
    objective = study.objectives[0]
    best = _cost(columns[objective.figure][place], objective.goal)

    def better(design: Design) -> bool:
        found = judged(study, [design])
        cost = _cost(found[objective.figure][0], objective.goal)
        return bool(found["violation"][0] <= columns["violation"][place] and cost < best - 1e-6 * abs(best))

    return better


def _cost(values: np.ndarray, goal: str) -> np.ndarray:
    """What is to be small; NaN, where the objective has no value, is the worst."""
    cost = values if goal == "minimise" else -values
    return np.where(np.isnan(cost), np.inf, cost)


def _design(columns: Columns, place: int) -> Design:
    found = row_of(columns, place)
    return Design(found.number, {name: value for name, value in found.values.items() if value is not None})
