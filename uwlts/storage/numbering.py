"""Numbers, times and encoder counts of images: gaps, duplicates, mixtures of naming, and counters that start again."""

import re
from collections.abc import Sequence
from itertools import pairwise
from pathlib import PurePosixPath
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from uwlts.errors import DescriptionError

_LARGEST = 2**63 - 1  # number of 64 bits
_UNIX_TIME = re.compile(r"(?<![0-9])(1[0-9]{9})[._]?((?:[0-9]{3}){0,3})(?![0-9])")
"""Seconds since 1970, and what is behind their decimal point, which may be left out."""
_OF_CLOCK = 6  # fewest digits of a time of day (HHMMSS)
_REGULAR = 0.2  # largest relative deviation of regular time steps, and largest fraction of steps that exceed it
_FEWEST_STEPS = 5
_WIDTHS = (16, 24, 32)
"""Bits of usual counters."""
_PLAIN = 3.0
"""Largest ratio of the step at an overflow to the largest other step, for a stage that accelerates meanwhile."""


class Counted(NamedTuple):
    """Increasing numbers (N,) of images, multiples of a step from each other."""

    numbers: np.ndarray
    step: int

    def places(self, first: int | None = None) -> np.ndarray:
        """Return the number of steps (N,) from a first number, by default that of the first image."""
        return (self.numbers - (self.numbers[0] if first is None else first)) // self.step


def count_names(names: Sequence[str], *, series: bool = False) -> Counted | None:
    """Return the increasing numbers of images in their names.

    The names differ in one number, or in several; then the one with the fewest gaps counts, or one with a decimal point
    and fewer gaps than images. None if no number counts, as in names without digits and in times. ``series``: numbers
    may start again, as for poses in a list of their own.

    Raises DescriptionError for a mixture of naming, a number that occurs twice, and numbers that decrease or restart.
    """
    parts = [re.split(r"([0-9]+)", name.casefold()) for name in names]
    forms = {tuple(part[::2]): name for name, part in zip(reversed(names), reversed(parts), strict=True)}
    if len(names) < 2 or all(len(form) == 1 for form in forms):
        return None
    if len(forms) > 1:
        other, one, *_ = forms.values()
        raise DescriptionError(
            f"{one} and {other} are named in different ways, so that their order is unknown: narrow the patterns, or "
            "give a table with a column stage_mm"
        )
    columns = [[int(number) for number in column] for column in zip(*(part[1::2] for part in parts), strict=True)]
    varying = [column for column in columns if len(set(column)) > 1]
    counts = [_count(np.array(column)) for column in varying if max(column) <= _LARGEST]
    decimal = [
        _count(np.array([int(part[at] + part[at + 2]) for part in parts]))
        for at in range(1, len(parts[0]) - 2, 2)
        if parts[0][at + 1] == "." and len({len(part[at + 2]) for part in parts}) == 1
    ]
    counts += [each for each in decimal if each is not None and each.places()[-1] < 2 * len(names)]
    if known := [each for each in counts if each is not None]:
        return min(known, key=lambda each: each.places()[-1])
    alone = len(varying) < 2
    for column in varying or columns[:1]:
        if alone or not series:
            _check_order(names, column, alone=alone)
    return None


def _check_order(names: Sequence[str], numbers: list[int], *, alone: bool) -> None:
    """Raise DescriptionError for the only numbers that vary if they do not increase, else if a second scan follows."""
    falls = [place for place, (one, two) in enumerate(pairwise(numbers)) if one > two or (alone and one == two)]
    if not falls:
        return
    place = falls[0]
    last, following = numbers[place : place + 2]
    problem = "have the same number: remove one" if last == following else "are in the reverse order of their numbers"
    if not alone:
        # Counts of several scans return to 0 or 1; so do seconds and minutes of times, but after 59.
        in_time = last < 60 <= 2 * last - numbers[place - 1] + 1
        if in_time or numbers[0] > 1 or any(numbers[each + 1] != numbers[0] for each in falls):
            return
        problem = "are the last and first of two scans: narrow the patterns"
    raise DescriptionError(f"{names[place]} and {names[place + 1]} {problem}, or give a table with a column stage_mm")


def _count(numbers: np.ndarray) -> Counted | None:
    """Return increasing numbers (N,) with their commonest step; None if others are no multiples of it, or for times.

    The seconds and minutes of a time of day are below 60, which no count through a hundred is.
    """
    steps = np.diff(numbers)
    if steps.min() <= 0:
        return None
    values, occurrences = np.unique(steps, return_counts=True)
    step = int(values[np.argmax(occurrences)])
    in_time = numbers[-1] >= 10 ** (_OF_CLOCK - 1) and numbers[-1] // 100 > numbers[0] // 100
    return None if (steps % step).any() or (in_time and (numbers % 100 < 60).all()) else Counted(numbers, step)


def name_gaps(names: Sequence[str], counted: Counted | None) -> list[str]:
    """Return a warning about gaps in the numbers of images, if there are any."""
    if counted is None or not (missing := np.diff(counted.places()) - 1).any():
        return []
    place = int(np.argmax(missing > 0))
    between = f"between {PurePosixPath(names[place]).name} and {PurePosixPath(names[place + 1]).name}"
    total = int(missing.sum())
    return [f"{total} file{'s are' if total > 1 else ' is'} missing by the numbers in the names, first {between}"]


def time_gaps(names: Sequence[str], times_s: np.ndarray) -> list[str]:
    """Return a warning about a gap in the times (N,) of images that are otherwise regular, if there is any.

    Times that are NaN are those since 1970 in the names, if there are any.
    """
    found = [_UNIX_TIME.search(PurePosixPath(name).name) for name in names]
    named_s = [float(f"{each[1]}.{each[2]}") if each else np.nan for each in found]
    times_s = np.where(np.isnan(times_s), named_s, times_s)
    steps = np.diff(times_s)
    if len(steps) < _FEWEST_STEPS or not np.isfinite(steps).all() or not steps.min() > 0:
        return []
    usual = np.median(steps)
    if np.mean(np.abs(steps - usual) > _REGULAR * usual) > _REGULAR or steps.max() < (2 - _REGULAR) * usual:
        return []
    place = int(np.argmax(steps))
    after = f"after image {place + 1}, {PurePosixPath(names[place]).name}"
    return [f"the times jump by {steps[place]:.4g} s {after}, usually by {usual:.4g} s: images may be missing"]


def unwrap_counts(counts: ArrayLike, bits: int | None = None) -> np.ndarray:
    """Return counts (N,) that continue where the counter passes the end of its range.

    Counts are in the order of time. The width ``bits`` is by default that for which the steps at overflows are like the
    others.

    Raises DescriptionError if the counts exceed the counter, a jump may be an overflow of a counter of unknown width,
    or the counter starts again.
    """
    counts = np.asarray(counts, np.float64)
    steps, extent = np.diff(counts), np.ptp(counts) if len(counts) else 0.0
    if bits is not None and extent >= 2.0**bits:
        raise DescriptionError(f"the encoder counts over {extent:.0f}, more than its {bits} bits (encoder_bits)")
    for width in _WIDTHS if bits is None else (bits,):
        span = 2.0**width
        over = np.abs(steps) > span / 2
        if extent >= span or not over.any():
            continue
        continued = np.unwrap(counts, period=span)
        others = np.abs(steps[~over]).max(initial=0)
        if bits is None and not np.abs(np.diff(continued)[over]).max() <= _PLAIN * others:
            place = int(np.argmax(over))
            raise DescriptionError(
                f"the encoder jumps from {counts[place]:.0f} to {counts[place + 1]:.0f}: give the width of its counter "
                "(encoder_bits), such as 16 or 32"
            )
        counts, steps = continued, np.diff(continued)
        break
    # A jump against the motion that no other step comes near is a restart.
    against = steps * -np.sign(np.median(steps)) if len(steps) else steps
    if (worst := against.max(initial=0)) > _PLAIN * max(-against.min(initial=0), 1):
        place = int(np.argmax(against))
        raise DescriptionError(
            f"the encoder jumps back from {counts[place]:.0f} to {counts[place + 1]:.0f} after image {place + 1}, by "
            f"{worst:.0f} counts: its counter started again"
        )
    return counts
