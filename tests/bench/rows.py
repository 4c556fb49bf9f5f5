"""Rows of the measurements: a value, its limit, and its ratio to a floor measured in the same run."""

import statistics
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace


@dataclass(frozen=True)
class Floor:
    """Speed of a plain computation on the same data, in the unit of its row, and the largest ratio to it.

    A ratio is always a ratio of times: 3 means that the measured work takes three times as long.
    """

    name: str
    value: float
    most: float


@dataclass(frozen=True)
class Row:
    """Measured value with its limit, and the same as a ratio to a floor; ``ok`` is True if both limits are kept.

    ``range`` is that of the values of several runs.
    """

    name: str
    value: float
    unit: str
    limit: float
    ok: bool
    floor: Floor | None = None
    ratio: float | None = None
    range: tuple[float, float] | None = None


def median_row(rows: Sequence[Row]) -> Row:
    """Return the row with the median value of several runs, and their range."""
    ordered = sorted(rows, key=lambda row: row.value)
    return replace(ordered[(len(rows) - 1) // 2], range=(ordered[0].value, ordered[-1].value))


def at_most(name: str, value: float, unit: str, limit: float, floor: Floor | None = None) -> Row:
    """Return a row with a value, such as a time, that must not exceed the limit."""
    return _row(name, value, unit, limit, value <= limit, floor, None if floor is None else value / floor.value)


def at_least(name: str, value: float, unit: str, limit: float, floor: Floor | None = None) -> Row:
    """Return a row with a value, such as a rate, that must reach the limit."""
    return _row(name, value, unit, limit, value >= limit, floor, None if floor is None else floor.value / value)


def _row(name: str, value: float, unit: str, limit: float, kept: bool, floor: Floor | None, ratio: float | None) -> Row:
    ok = bool(kept and (floor is None or ratio is None or ratio <= floor.most))
    return Row(name, round(float(value), 4), unit, limit, ok, floor, None if ratio is None else round(float(ratio), 2))


def median_seconds(
    action: Callable[[int], object], *, warm_up: int = 3, runs: int = 15, clock: Callable[[], float] = time.perf_counter
) -> float:
    """Return the median duration of ``action(k)`` after a warm-up.

    On a busy machine the ``clock`` of processor time, `time.process_time`, is right for work in one thread.
    """
    seconds = []
    for k in range(warm_up + runs):
        start = clock()
        action(k)
        seconds.append(clock() - start)
    return statistics.median(seconds[warm_up:])
