"""Chebyshev tables of smooth functions of profile line and stripe centre, for fast evaluation.

Ray tracing through lens, window and medium to the sheet takes hundreds of operations per pixel. The result is so smooth
over the image that a polynomial of 10 to 30 terms approximates it to rounding. A table holds one for each profile line.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Hashable
from dataclasses import dataclass, replace

import numpy as np
from numpy.polynomial import chebyshev

from uwlts.runtime.compiled import compiled, compiled_part

_NODES = (12, 8), (24, 24)  # numbers of nodes along lines and centres, tried in turn

_KEPT = 16  # number of cached tables, of the most recently used functions

_WIDER = 64
"""Numbers of lines and pixels of a table are rounded up to multiples of this, so that it covers the next scan with
the same calibration."""

_WORTH = 5000  # least number of centres that is worth a table: making one costs about as much as a thousand evaluations


@dataclass(frozen=True, eq=False)
class LineTable:
    """Chebyshev series in line and centre of a function with K values."""

    terms: np.ndarray  # (T, n, K); coefficients by term of the line, term of the centre, and value
    of_lines: np.ndarray  # (L, T); Chebyshev polynomials at each line, from ``first_line`` on
    first_line: int
    # Limits of the centres.
    low_px: float
    high_px: float

    @classmethod
    def from_function(
        cls,
        exact: Callable[[np.ndarray, np.ndarray], np.ndarray],
        lines: tuple[int, int],
        places_px: tuple[float, float],
        *,
        tolerance: float | np.ndarray,
        share: float = 0.0,
    ) -> LineTable | None:
        """Tabulate a function, or return None if it is not finite everywhere or not smooth enough.

        ``exact`` returns the values (N, K) for lines (N,) and centres (N,), both float. ``lines`` and ``places_px`` are
        the lowest and highest line and centre. The last two coefficients of the series are limited by ``tolerance``, a
        number or (K,). The limit is at least the fraction ``share`` of each largest absolute value.
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
            into_lines, into_places = map(_make_series_matrix, count)
            series = np.tensordot(into_places, values.reshape(*count[::-1], -1), (1, 0))
            series = np.tensordot(into_lines, series, (1, 1))
            error = np.maximum(tolerance, share * np.abs(values).max(axis=0))
            if (np.abs(series[-2:]) <= error).all() and (np.abs(series[:, -2:]) <= error).all():
                at_lines = (np.arange(lines[0], lines[1] + 1) - line) / half_lines
                of_lines = chebyshev.chebvander(at_lines, count[0] - 1)
                whole = cls(series, of_lines, lines[0], place - half_places, place + half_places)
                # The truncation error must stay far below the tolerance.
                return whole.shorten(1e-3 * error)
        return None

    @classmethod
    def over_range(
        cls,
        exact: Callable[[np.ndarray, np.ndarray], np.ndarray],
        line: np.ndarray,
        place_px: np.ndarray,
        *,
        tolerance: float | np.ndarray,
        share: float = 0.0,
        key: Hashable = None,
    ) -> LineTable | None:
        """Tabulate a function over the range of given lines and centres, as `from_function`.

        Return None also if there are fewer than 5000 centres, or if a centre is not finite.

        Lines and centres are (N,). Tables are cached under the ``key``, which determines the function completely. Their
        limits are rounded outwards, so that a table depends only on its limits and the key.
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
                _tables[known] = cls.from_function(exact, wide, wide_px, tolerance=tolerance, share=share)
                for oldest in [*_tables][:-_KEPT]:
                    _tables.pop(oldest, None)
            if (table := _tables.get(known)) is not None:
                return table
        return cls.from_function(exact, lines, places_px, tolerance=tolerance, share=share)

    def combine(self, weights: np.ndarray) -> LineTable:
        """Return the table of linear combinations of the values, with weights (K, M)."""
        return replace(self, terms=self.terms @ weights)

    def shorten(self, tolerance: float | np.ndarray) -> LineTable:
        """Return the table without trailing terms whose absolute sum is within the tolerance, in lines and centres."""
        size = np.abs(self.terms)
        of_lines, of_places = (_count_needed_terms(size.sum(axis=axis), tolerance) for axis in (1, 0))
        terms = np.ascontiguousarray(self.terms[:of_lines, :of_places])
        return replace(self, terms=terms, of_lines=np.ascontiguousarray(self.of_lines[:, :of_lines]))

    def series(self, line: np.ndarray, place_px: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Return the series (L, n, K) of lines, and the row (N,) and argument (N,) in them of each line and centre."""
        row, of_lines = np.ascontiguousarray(line, dtype=np.intp) - self.first_line, self.of_lines
        if len(row) < len(of_lines):
            row, of_lines = np.arange(len(row)), of_lines[row]
        scale = 2.0 / (self.high_px - self.low_px)
        at = np.ascontiguousarray((np.asarray(place_px, dtype=float) - self.low_px) * scale - 1.0)
        return np.tensordot(of_lines, self.terms, 1), row, at

    def values(self, line: np.ndarray, place_px: np.ndarray) -> np.ndarray:
        """Return values (N, K) for lines (N,) int and centres (N,) within the limits of the table."""
        result = np.empty((len(line), self.terms.shape[2]))
        sum_series(*self.series(line, place_px), result)
        return result


_tables: dict[Hashable, LineTable | None] = {}


def _make_series_matrix(count: int) -> np.ndarray:
    """Return the matrix from values at ``count`` Chebyshev nodes to coefficients of the series."""
    into_series = 2.0 / count * chebyshev.chebvander(chebyshev.chebpts1(count), count - 1).T
    into_series[0] *= 0.5
    return into_series


def _count_needed_terms(size: np.ndarray, tolerance: float | np.ndarray) -> int:
    """Return the number of leading terms, at least 1, after which sizes (T, K) sum to no more than the tolerance."""
    left = np.cumsum(size[::-1], axis=0)[::-1]
    return max(1, int(np.count_nonzero((left > tolerance).any(axis=1))))


@compiled
def sum_series(series: np.ndarray, row: np.ndarray, at: np.ndarray, result: np.ndarray) -> None:
    """Write values (N, K) of Chebyshev series at arguments (N,) from -1 to 1; ``row`` (N,) selects the series."""
    for n in range(row.size):
        sum_terms(series[row[n]], at[n], result[n])


@compiled_part
def sum_terms(terms: np.ndarray, x: float, sums: np.ndarray) -> None:
    """Write values (K,) of a Chebyshev series with coefficients (n, K) at x, by the three-term recurrence."""
    before, polynomial, first = 1.0, x, terms[0]
    for k in range(sums.size):
        sums[k] = first[k]
    for term in range(1, terms.shape[0]):
        weights = terms[term]
        for k in range(sums.size):
            sums[k] += polynomial * weights[k]
        before, polynomial = polynomial, 2.0 * x * polynomial - before
