"""Choice of the design to build: the Pareto front, the best design, and others to look at."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np

from twin.design.description import Study
from twin.design.designs import Columns, Design, Marked, built, described, judged, row_of
from twin.design.refinement import refined
from uwlts.model.errors import DesignError, Error, EvaluationError, RangeError


def pareto(values: np.ndarray) -> np.ndarray:
    """Which of N designs lie on the front of M values to minimise.

    A design lies on it if no other is at least as good in all values and better in one; equal designs stand or fall
    together. Two values take a sort, more a pass over the designs for every design of the front (Kung et al. 1975).

    Smaller is better. A design with a value NaN is no candidate: it is not on the front and beats no other. (N,) bool
    from ``values`` (N, M); RangeError where they are no table with at least one column.
    """
    values = np.asarray(values, dtype=np.float64)
    if values.ndim != 2 or values.shape[1] == 0:
        raise RangeError(f"the values have the shape {values.shape}; expected (designs, values), at least one value")
    front = np.zeros(len(values), dtype=bool)
    candidates = np.flatnonzero(~np.isnan(values).any(axis=1))
    if len(candidates):
        front[candidates] = (_front_of_two if values.shape[1] <= 2 else _front_of_many)(values[candidates])
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


@dataclass(frozen=True, eq=False)
class Judged:
    """A study and the columns of its N judged designs, perhaps none; EvaluationError for those of another study."""

    study: Study
    columns: Columns

    def __post_init__(self) -> None:
        expected = ["design", "violation", "failure", *self.study.free(), *(o.figure for o in self.study.objectives)]
        if self.columns and (missing := [name for name in expected if name not in self.columns]):
            raise EvaluationError(
                f"the results have no {', '.join(missing)}, but {', '.join(self.columns)}: they are of another study"
            )

    def __len__(self) -> int:
        return len(self.columns["design"]) if self.columns else 0

    def figure(self, name: str) -> np.ndarray:
        """A figure of all designs, (N,) float; NaN where it is unknown."""
        return np.asarray(self.columns.get(name, np.full(len(self), np.nan)), dtype=np.float64)

    def cost(self, place: int = 0) -> np.ndarray:
        """An objective of all designs, (N,), turned so that smaller is better."""
        objective = self.study.objectives[place]
        return self.figure(objective.figure) * (1 if objective.goal == "minimise" else -1)

    @cached_property
    def failures(self) -> list[str]:
        """Reasons why designs cannot work, "" for those that do."""
        return [text or "" for text in self.columns["failure"].tolist()] if self.columns else []

    @cached_property
    def works(self) -> np.ndarray:
        """Designs (N,) that work and whose first objective is known."""
        return np.array([not text for text in self.failures], dtype=bool) & np.isfinite(self.cost())

    @cached_property
    def feasible(self) -> np.ndarray:
        """Designs (N,) that work and meet all constraints."""
        return self.works & (self.figure("violation") <= 0)

    @cached_property
    def best_first(self) -> np.ndarray:
        """Places of the designs that work: those that miss the constraints least, then those of the best objective."""
        order = np.lexsort((self.cost(), self.figure("violation")))
        return order[self.works[order]]

    def front(self, among: np.ndarray) -> np.ndarray:
        """Designs (N,) that no other one ``among`` (N,) some beats in all objectives."""
        costs = np.column_stack([self.cost(k) for k in range(len(self.study.objectives))])
        return pareto(np.where(among[:, None], costs, np.nan))

    @property
    def of_interest(self) -> np.ndarray:
        """Designs (N,) that meet all constraints, or all that work if none does."""
        return self.feasible if self.feasible.any() else self.works

    def marked(self, place: int, words: str) -> Marked:
        """A design with its sensor as built, to point out in ``words``."""
        design = row_of(self.columns, place)
        return Marked(f"{words} (design {design.number})", built(self.study, design.again()), design)


@dataclass(frozen=True)
class Chosen:
    """The base sensor if it works, then the best design, then the refined one if it is better: the last one wins."""

    marked: tuple[Marked, ...]
    further: tuple[Marked, ...]
    notes: tuple[str, ...]


def choose(study: Study, columns: Columns) -> Chosen:
    """The best design by the first objective among those that meet the constraints, and others to be looked at.

    Where none meets them, the one that misses them least is taken, and said so. ``further`` are designs spread over
    the Pareto front, as many as the study wants rendered beside the best. DesignError where no design works.
    """
    marked, notes = [], []
    base, found = study.sensor, Judged(study, columns)
    try:
        marked.append(Marked(f"{base.name} (as described)", base, described(study, "base", base)))
    except Error as error:
        notes.append(f"The base sensor itself cannot work: {error}.")
    if not len(found.best_first):
        reason = found.failures[0]
        raise DesignError(f"none of {len(found)} designs can work; the first one: {reason}: widen the ranges")
    meets = found.feasible
    if not meets.any():
        notes.append("No design meets all constraints; the chosen one misses them least.")
        violation = np.where(found.works, columns["violation"], np.inf)
        meets = violation == violation.min()
    best = int(found.best_first[0])
    winner = found.marked(best, "best of the sweep")
    marked.append(winner)

    def better(design: Design) -> bool:
        """A design beats the best one by the same formulas."""
        one, known = Judged(study, judged(study, [design])), found.cost()[best]
        missed = one.figure("violation")[0]
        return bool(missed <= winner.design.violation and one.cost()[0] < known - 1e-6 * abs(known))

    if study.refine and (end := refined(study, winner.design.again(), better)) is not None:
        marked.append(Marked("refined along the gradient", built(study, end), row_of(judged(study, [end]), 0)))
    front = np.flatnonzero(found.front(meets))
    front = front[np.argsort(found.cost()[front])]
    spread = front[np.unique(np.linspace(0, len(front) - 1, study.verify + 1).round().astype(int))]
    others = [int(place) for place in spread if place != best][: max(study.verify - 1, 0)]
    further = [found.marked(place, "on the Pareto front") for place in others]
    return Chosen(tuple(marked), tuple(further), tuple(notes))
