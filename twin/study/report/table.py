"""The judged designs of a study as its page shows them: which work, which meet the constraints, which are best."""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np

from twin.study.description import Study
from twin.study.pareto import pareto
from twin.study.report.names import value_text, without_numbers, words_of
from uwlts.errors import EvaluationError


@dataclass(frozen=True, eq=False)
class Judged:
    """A study and the columns of its judged designs, as `twin.study.results.read_parts` gives them."""

    study: Study
    columns: Mapping[str, np.ndarray]

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
        if name not in self.columns:
            return np.full(len(self), np.nan)
        return np.asarray(self.columns[name], dtype=np.float64)

    def cost(self, place: int = 0) -> np.ndarray:
        """An objective of all designs, (N,), turned so that smaller is better."""
        objective = self.study.objectives[place]
        return self.figure(objective.figure) * (1 if objective.goal == "minimise" else -1)

    @cached_property
    def failures(self) -> list[str]:
        """Why designs cannot work, "" for those that do."""
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

    @cached_property
    def front(self) -> np.ndarray:
        """Designs (N,) that no other of those that count beats in all objectives, see `of_interest`."""
        values = np.column_stack([self.cost(k) for k in range(len(self.study.objectives))])
        return pareto(np.where(self.of_interest[:, None], values, np.nan))

    @property
    def of_interest(self) -> np.ndarray:
        """Designs (N,) that meet all constraints, or all that work if none does."""
        return self.feasible if self.feasible.any() else self.works

    def text(self, name: str, place: int) -> str:
        """A design's value in words, with its unit."""
        return value_text(name, self.columns[name][place])

    def failure_counts(self) -> list[tuple[str, int]]:
        """Why designs cannot work, without the numbers, and how many; the most frequent first."""
        return Counter(without_numbers(text) for text in self.failures if text).most_common()

    def miss_counts(self) -> list[tuple[str, int]]:
        """Constraints in words, and how many of the working designs miss each."""
        counts = []
        for name, sign, bound in bounds_of(self.study):
            missed = sign * (self.figure(name)[self.works] - bound) > 0
            counts.append((bound_text(name, sign, bound), int(missed.sum())))
        return counts


def bounds_of(study: Study) -> list[tuple[str, int, float]]:
    """All bounds: the figure, 1 for one from above and -1 for one from below, and the bound."""
    return [
        (name, sign, bound)
        for name, constraint in study.constraints.items()
        for sign, bound in ((-1, constraint.least), (1, constraint.most))
        if bound is not None
    ]


def bound_text(name: str, sign: int, bound: float) -> str:
    """A bound in words."""
    return f"{words_of(name)} {'at most' if sign > 0 else 'at least'} {value_text(name, bound)}"


def misses(study: Study, row: Mapping[str, Any]) -> list[str]:
    """Which constraints a design misses, in words."""
    found = []
    for name, sign, bound in bounds_of(study):
        value = row.get(name)
        if value is not None and sign * (value - bound) > 0:
            limit = f"{'at most' if sign > 0 else 'at least'} {value_text(name, bound)} is asked"
            found.append(f"{words_of(name)} is {value_text(name, value)}, {limit}")
    return found
