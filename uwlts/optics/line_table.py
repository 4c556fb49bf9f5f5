"""Smooth functions of the stripe's place, tabulated for every profile line, so that many places cost little.

Where a pixel's ray meets the sheet, and how that depends on the calibration, takes hundreds of operations to follow
through lens, window and medium, and yet is so smooth over the image that a polynomial of some ten to thirty terms
holds it to rounding. One is kept for every profile line.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
from numpy.polynomial import chebyshev

from uwlts.runtime.compiled import compiled, compiled_part

_NODES = (12, 24)
"""Numbers of nodes along either direction that are tried, one after another."""

_WORTH = 5000
"""Places from which a table is worth making: it costs as much as some thousand of them."""


@dataclass(frozen=True, eq=False)
class LineTable:
    """A function of line and place on it with K values, as Chebyshev series of both.

    ``terms`` (T, n, K) are those of line and place, ``of_lines`` (L, T) the polynomials of each line from
    ``first_line`` on, for places from ``low_px`` to ``high_px``.
    """

    terms: np.ndarray
    of_lines: np.ndarray
    first_line: int
    low_px: float
    high_px: float

    @classmethod
    def of(
        cls,
        exact: Callable[[np.ndarray, np.ndarray], np.ndarray],
        lines: tuple[int, int],
        places_px: tuple[float, float],
        *,
        tolerance: float,
    ) -> LineTable | None:
        """Table of a function for the lines and places between two, ends included.

        ``exact`` gives the values (N, K) for lines (N,) and places (N,), both float. None where one is not finite, or
        where the last terms of the series are not below the tolerance, as of a function that is not smooth.
        """
        (line, half_lines), (place, half_places) = (
            (0.5 * (low + high), max(0.5 * (high - low), 0.5)) for low, high in (lines, places_px)
        )
        for count in _NODES:
            nodes = chebyshev.chebpts1(count)
            into_series = 2.0 / count * chebyshev.chebvander(nodes, count - 1).T
            into_series[0] *= 0.5
            at_line, at_place = np.meshgrid(line + half_lines * nodes, place + half_places * nodes)
            values = exact(at_line.ravel(), at_place.ravel()).reshape(count, count, -1)
            if not np.isfinite(values).all():
                return None
            # Axes: term of the line, term of the place, value.
            series = np.tensordot(into_series, np.tensordot(into_series, values, (1, 0)), (1, 1))
            if max(np.abs(series[-2:]).max(), np.abs(series[:, -2:]).max()) <= tolerance:
                of_lines = chebyshev.chebvander((np.arange(lines[0], lines[1] + 1) - line) / half_lines, count - 1)
                return cls(series, of_lines, lines[0], place - half_places, place + half_places)
        return None

    @classmethod
    def about(
        cls,
        exact: Callable[[np.ndarray, np.ndarray], np.ndarray],
        line: np.ndarray,
        place_px: np.ndarray,
        *,
        tolerance: float,
    ) -> LineTable | None:
        """Table for all of the places (N,) on lines (N,) int; None also where they are too few to be worth one."""
        if len(line) < _WORTH or line.dtype.kind not in "iu" or not np.isfinite(place_px).all():
            return None
        lines, places_px = (int(line.min()), int(line.max())), (float(place_px.min()), float(place_px.max()))
        return cls.of(exact, lines, places_px, tolerance=tolerance)

    def combined(self, weights: np.ndarray) -> LineTable:
        """Table of the sums of its values with weights (K, M)."""
        return replace(self, terms=self.terms @ weights)

    def series(self, line: np.ndarray, place_px: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Series (L, n, K) of lines and, for lines (N,) int and places (N,), their rows (N,) and arguments (N,)."""
        row, of_lines = np.ascontiguousarray(line, dtype=np.intp) - self.first_line, self.of_lines
        if len(row) < len(of_lines):
            row, of_lines = np.arange(len(row)), of_lines[row]
        scale = 2.0 / (self.high_px - self.low_px)
        at = np.ascontiguousarray((np.asarray(place_px, dtype=float) - self.low_px) * scale - 1.0)
        return np.tensordot(of_lines, self.terms, 1), row, at

    def values(self, line: np.ndarray, place_px: np.ndarray) -> np.ndarray:
        """Values (N, K) for lines (N,) int and places (N,) within the table."""
        result = np.empty((len(line), self.terms.shape[2]))
        _sum_series(*self.series(line, place_px), result)
        return result


@compiled
def _sum_series(series: np.ndarray, row: np.ndarray, at: np.ndarray, result: np.ndarray) -> None:
    """Sums of Chebyshev polynomials at places (N,)."""
    for n in range(row.size):
        sum_terms(series[row[n]], at[n], result[n])


@compiled_part
def sum_terms(terms: np.ndarray, x: float, sums: np.ndarray) -> None:
    """Sums (K,) of a line's terms (n, K) times Chebyshev polynomials, each by recurrence from the two before."""
    before, polynomial = x, 1.0
    for k in range(sums.size):
        sums[k] = 0.0
    for term in range(terms.shape[0]):
        weights = terms[term]
        for k in range(sums.size):
            sums[k] += polynomial * weights[k]
        before, polynomial = polynomial, 2.0 * x * polynomial - before
