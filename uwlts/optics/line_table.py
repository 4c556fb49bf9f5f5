"""Smooth functions of the stripe's place, tabulated for every profile line, so that many places cost little.

Where a pixel's ray meets the sheet, and how that depends on the calibration, takes hundreds of operations to follow
through lens, window and medium, and yet is so smooth over the image that a polynomial of some ten to thirty terms
holds it to rounding. One is kept for every profile line.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Hashable
from dataclasses import dataclass, replace

import numpy as np
from numpy.polynomial import chebyshev

from uwlts.runtime.compiled import compiled, compiled_part

_NODES = (12, 8), (24, 24)
"""Numbers of nodes along lines and places that are tried, one after another."""

_KEPT = 16
"""Number of cached tables, of the most recently used functions."""

_WIDER = 64
"""Numbers of lines and pixels of a table are rounded up to multiples of this, so that it covers the next scan with
the same calibration."""

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
        tolerance: float | np.ndarray,
        share: float = 0.0,
    ) -> LineTable | None:
        """Table of a function for the lines and places between two, ends included.

        ``exact`` gives the values (N, K) for lines (N,) and places (N,), both float. None where one is not finite, or
        where the last terms of the series are not below the tolerance, of all values or of each (K,), or that ``share``
        of the largest value where it is more, as of a function that is not smooth.
        """
        (line, half_lines), (place, half_places) = (
            (0.5 * (low + high), max(0.5 * (high - low), 0.5)) for low, high in (lines, places_px)
        )
        for count in _NODES:
            at_line, at_place = np.meshgrid(*map(chebyshev.chebpts1, count))
            values = exact(line + half_lines * at_line.ravel(), place + half_places * at_place.ravel())
            if not np.isfinite(values).all():
                return None
            # Axes: term of the line, term of the place, value.
            into_lines, into_places = map(_into_series, count)
            series = np.tensordot(into_places, values.reshape(*count[::-1], -1), (1, 0))
            series = np.tensordot(into_lines, series, (1, 1))
            error = np.maximum(tolerance, share * np.abs(values).max(axis=0))
            if (np.abs(series[-2:]) <= error).all() and (np.abs(series[:, -2:]) <= error).all():
                at_lines = (np.arange(lines[0], lines[1] + 1) - line) / half_lines
                of_lines = chebyshev.chebvander(at_lines, count[0] - 1)
                whole = cls(series, of_lines, lines[0], place - half_places, place + half_places)
                # What is left out besides stays far below the tolerance.
                return whole.shortened(1e-3 * error)
        return None

    @classmethod
    def about(
        cls,
        exact: Callable[[np.ndarray, np.ndarray], np.ndarray],
        line: np.ndarray,
        place_px: np.ndarray,
        *,
        tolerance: float | np.ndarray,
        share: float = 0.0,
        key: Hashable = None,
    ) -> LineTable | None:
        """Table for all of the places (N,) on lines (N,) int; None also where they are too few to be worth one.

        Of what says all about the function, as a ``key``, tables are kept. They are for some places more, so that a
        table depends on nothing but these and the key.
        """
        if len(line) < _WORTH or line.dtype.kind not in "iu" or not np.isfinite(place_px).all():
            return None
        lines, places_px = (int(line.min()), int(line.max())), (float(place_px.min()), float(place_px.max()))
        if key is not None:
            wide, wide_px = (
                (_WIDER * math.floor(low / _WIDER), _WIDER * math.ceil(high / _WIDER))
                for low, high in (lines, places_px)
            )
            known = key, wide, wide_px
            if known not in _tables:
                _tables[known] = cls.of(exact, wide, wide_px, tolerance=tolerance, share=share)
                for oldest in [*_tables][:-_KEPT]:
                    _tables.pop(oldest, None)
            if (table := _tables.get(known)) is not None:
                return table
        return cls.of(exact, lines, places_px, tolerance=tolerance, share=share)

    def combined(self, weights: np.ndarray) -> LineTable:
        """Table of the sums of its values with weights (K, M)."""
        return replace(self, terms=self.terms @ weights)

    def shortened(self, tolerance: float | np.ndarray) -> LineTable:
        """Table without the last terms, of lines and of places, that add up to no more than the tolerance in each."""
        size = np.abs(self.terms)
        of_lines, of_places = (_needed(size.sum(axis=axis), tolerance) for axis in (1, 0))
        terms = np.ascontiguousarray(self.terms[:of_lines, :of_places])
        return replace(self, terms=terms, of_lines=np.ascontiguousarray(self.of_lines[:, :of_lines]))

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
        sum_series(*self.series(line, place_px), result)
        return result


_tables: dict[Hashable, LineTable | None] = {}


def _into_series(count: int) -> np.ndarray:
    """Matrix that makes a Chebyshev series' terms of the values at so many nodes."""
    into_series = 2.0 / count * chebyshev.chebvander(chebyshev.chebpts1(count), count - 1).T
    into_series[0] *= 0.5
    return into_series


def _needed(size: np.ndarray, tolerance: float | np.ndarray) -> int:
    """Number of the first terms, at least one, after which sizes (T, K) add up to no more than the tolerance."""
    left = np.cumsum(size[::-1], axis=0)[::-1]
    return max(1, int(np.count_nonzero((left > tolerance).any(axis=1))))


@compiled
def sum_series(series: np.ndarray, row: np.ndarray, at: np.ndarray, result: np.ndarray) -> None:
    """Sums of Chebyshev polynomials at places (N,)."""
    for n in range(row.size):
        sum_terms(series[row[n]], at[n], result[n])


@compiled_part
def sum_terms(terms: np.ndarray, x: float, sums: np.ndarray) -> None:
    """Sums (K,) of a line's terms (n, K) times Chebyshev polynomials, each by recurrence from the two before."""
    before, polynomial, first = 1.0, x, terms[0]
    for k in range(sums.size):
        sums[k] = first[k]
    for term in range(1, terms.shape[0]):
        weights = terms[term]
        for k in range(sums.size):
            sums[k] += polynomial * weights[k]
        before, polynomial = polynomial, 2.0 * x * polynomial - before
