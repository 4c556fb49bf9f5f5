"""Cost of paths through the candidates of an image, in jumps: how much worse the best path by way of each one is.

A path goes from line to line through one candidate of each, or passes a line by. Paths of least cost with their
margins: the min-sum algorithm on a chain, forwards and backwards (Bishop, Pattern Recognition and Machine Learning,
section 8.4.5).
"""

from __future__ import annotations

import numpy as np

from uwlts.runtime.compiled import compiled, compiled_with_arrays

GAP, _LONG_GAP = 12, 24
"""Lines that a dim stripe may be lost for and go on; and those after which it still does where it goes on straight."""

SLACK_PX = 2.0
"""Further movement allowed for each line on which the stripe was not found."""

_SMOOTH_PX, _ROUGH, _ROUGHEST = 1.5, 0.03, 0.15
"""Departure from the straight way that noise explains, cost in jumps of each px beyond it, and the highest: stripes are
smooth, and chains of speckles are not."""

_SKIPPED, _LOST = 0.03, 0.005
"""Cost, in jumps, of a line whose candidates the path passes by: of a clear stripe, and of a faint one, which noise may
hide."""

_FAINT, _CLEAR = 4.0, 12.0
"""Mean heights, in least heights of a stripe, up to which one is faint and from which it is clear."""

_BEHIND, _DIMMER, _OCTAVES, _SOME_LINES = 0.35, 0.15, 3.0, 20.0
"""Cost, in jumps, of a stripe with another one nearer to the sensor on its lines, and of each halving of the brightness
below the brightest, up to so many; less on fewer lines than so many. They decide between paths with equally many jumps.
A surface hides what lies behind it, so that what is seen behind is a reflection; reflections are dimmer than what they
show, but brighter than the own stripe of a mirror."""

_BEHIND_CORNER = 1.5
"""The same for a stripe behind one that it meets: both begin in a corner, and the nearer one is the surface in which
the other one is seen; not where that goes on alone beyond it for more than twice as long."""

_CUT = 0.5
"""Cost, in jumps, of a jump away from a stripe that goes on there, and of one into the middle of a stripe, if the rest
has `_SOME_LINES` lines or more: where one surface ends before another one, both stripes have an end."""

CROSSING_LINES, OPENING, LONGEST_CROSSING = 12, 0.2, 24
"""Lines, at most, from which two stripes' distance shows where they cross, its least growth per line, and most lines of
a crossing."""

_CORNER_LINES = 30
"""As the first of them, for a corner: some show another stripe."""


def path_margins(
    line: np.ndarray,
    centre_px: np.ndarray,
    amplitude: np.ndarray,
    stripe: np.ndarray,
    cost: np.ndarray,
    *,
    jump_px: float,
    least: float,
) -> np.ndarray:
    """Cost (M,), in jumps beyond the best path, of the best path through each candidate (M,) of an image.

    ``line`` (M,) grows; ``stripe`` (M,) numbers the stripes that they belong to; ``cost`` (M,) is that of each
    candidate by itself. Neighbours more than ``jump_px`` apart are a jump.
    """
    mean = np.empty(len(line))
    _average(line, amplitude, stripe, mean)
    height = np.minimum(amplitude, mean) / least
    clear = np.clip((height - _FAINT) / (_CLEAR - _FAINT), 0.0, 1.0)
    skipped = _LOST + (_SKIPPED - _LOST) * clear
    before, after = np.empty((2, len(line)))
    _slopes(line, centre_px, stripe, before, after)
    enter, leave = _cuts(stripe)
    through, backwards = np.empty((2, len(line)))
    _least_cost(line, centre_px, before, after, cost, skipped, enter, leave, jump_px, through)
    turned = [
        values[::-1].copy() for values in (line.max() - line, centre_px, -after, -before, cost, skipped, leave, enter)
    ]
    _least_cost(*turned, jump_px=jump_px, result=backwards)
    through += backwards[::-1] - cost
    return through - through.min()


def own_cost(
    line: np.ndarray, centre_px: np.ndarray, amplitude: np.ndarray, stripe: np.ndarray, farther: int
) -> np.ndarray:
    """Cost (M,) of candidates by the others on their lines; that of a stripe does not grow with its length.

    ``farther`` is as of `uwlts.stripe.direct.farther`, 0 where unknown; else as of `path_margins`.
    """
    _, group, count = np.unique(line, return_inverse=True, return_counts=True)
    brightest = np.zeros(len(count))
    np.maximum.at(brightest, group, amplitude)
    dimmer = np.clip(np.log2(brightest[group] / np.maximum(amplitude, 1e-6)), 0.0, _OCTAVES)
    rivals = np.bincount(stripe, count[group] > 1, minlength=len(line))
    cost = _DIMMER * dimmer / np.maximum(rivals[stripe], _SOME_LINES)
    if farther:
        order = np.lexsort((farther * centre_px, line))
        behind = order[1:][np.diff(line[order]) == 0]
        before = order[:-1][np.diff(line[order]) == 0]
        apart = np.abs(centre_px[behind] - centre_px[before])
        pairs = stripe[behind] * (len(line) + 1) + stripe[before]
        for pair in np.unique(pairs):
            own = behind[pairs == pair]
            corner = _corner(line[own], apart[pairs == pair])
            alone = line[(stripe == stripe[own[0]]) & (count[group] == 1)]
            beyond = np.count_nonzero(alone > line[own[-1]] if corner < 0 else alone < line[own[0]])
            whole = _BEHIND_CORNER if corner and beyond <= 2 * len(own) else _BEHIND
            cost[own] += whole / max(len(own), _SOME_LINES)
    return cost


def _cuts(stripe: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """What it costs (M,) to jump to each candidate, and from it, beyond the jump, by the rest of its stripe."""
    order = np.argsort(stripe, kind="stable")
    before = np.empty(len(stripe))
    before[order] = np.arange(len(stripe)) - np.searchsorted(stripe[order], stripe[order])
    after = np.bincount(stripe)[stripe] - 1 - before
    enter, leave = (_CUT * np.minimum(rest / _SOME_LINES, 1.0) for rest in (before, after))
    return enter, leave


def _corner(line: np.ndarray, apart_px: np.ndarray) -> int:
    """Where distances (K,) of a stripe from the one before it shrink to nothing: -1 before the first line, 1 behind the
    last one, 0 nowhere.

    By the median slope (Theil and Sen), as the one before it may be lost on lines where still another one is seen.
    """
    if len(line) < CROSSING_LINES:
        return 0
    for end, inwards in ((slice(None, _CORNER_LINES), 1), (slice(-_CORNER_LINES, None), -1)):
        lines, apart = line[end], apart_px[end]
        away = inwards * (lines - lines[0 if inwards > 0 else -1])
        one, other = np.triu_indices(len(lines), 1)
        growth = float(np.median((apart[other] - apart[one]) / (away[other] - away[one])))
        if growth > OPENING and np.median(apart - growth * away) <= LONGEST_CROSSING * growth:
            return -inwards
    return 0


@compiled_with_arrays
def _least_cost(
    line: np.ndarray,
    centre: np.ndarray,
    before: np.ndarray,
    after: np.ndarray,
    cost: np.ndarray,
    skipped: np.ndarray,
    enter: np.ndarray,
    leave: np.ndarray,
    jump_px: float,
    result: np.ndarray,
) -> None:
    """Cost (M,) of the best path that ends in each candidate, its own included.

    ``before`` and ``after`` are the slopes of its stripe on either side of each, ``enter`` and ``leave`` what a jump to
    it and from it costs more.
    """
    count = line.size
    # What it costs to pass by, from the first line on: the number of lines with candidates before each one.
    lines_before = np.zeros(count)
    for k in range(1, count):
        lines_before[k] = lines_before[k - 1] + (1.0 if line[k] != line[k - 1] else 0.0)
    elsewhere, best_of_line, first = 0.0, np.inf, 0
    for k in range(count):
        if k > 0 and line[k] != line[k - 1]:
            elsewhere = min(elsewhere + _SKIPPED, best_of_line)
            best_of_line = np.inf
        while line[k] - line[first] > _LONG_GAP:
            first += 1
        best = elsewhere + enter[k]
        for j in range(first, k):
            apart = line[k] - line[j]
            if apart == 0:
                break
            moved, allowed = centre[k] - centre[j], jump_px + SLACK_PX * (apart - 1)
            straight = min(abs(moved - before[j] * apart), abs(moved - after[k] * apart))
            off = min(abs(moved), straight)
            if off <= allowed if apart <= GAP else straight <= jump_px:
                way = result[j] + min(skipped[j], skipped[k]) * (lines_before[k] - lines_before[j] - 1.0)
                way += min(max(off - _SMOOTH_PX, 0.0) * _ROUGH, _ROUGHEST)
                best = min(best, way)
        result[k] = best + cost[k]
        best_of_line = min(best_of_line, result[k] + 1.0 + leave[k])


@compiled
def _slopes(line: np.ndarray, centre: np.ndarray, stripe: np.ndarray, before: np.ndarray, after: np.ndarray) -> None:
    """Slopes (M,) of the stripe of each candidate on the lines before and after it, by least squares; 0 at its ends."""
    for side, result in ((-1, before), (1, after)):
        for k in range(line.size):
            products, squares, j = 0.0, 0.0, k + side
            while 0 <= j < line.size and abs(line[j] - line[k]) <= GAP:
                if stripe[j] == stripe[k]:
                    away = float(line[j] - line[k])
                    products, squares = products + away * (centre[j] - centre[k]), squares + away * away
                j += side
            result[k] = products / squares if squares > 0.0 else 0.0


@compiled
def _average(line: np.ndarray, amplitude: np.ndarray, stripe: np.ndarray, mean: np.ndarray) -> None:
    """Mean height (M,) of each candidate and those of its stripe on the lines beside it."""
    for k in range(line.size):
        total, count = amplitude[k] * 1.0, 1
        for side in (-1, 1):
            j = k + side
            while 0 <= j < line.size and abs(line[j] - line[k]) <= GAP:
                if stripe[j] == stripe[k]:
                    total, count = total + amplitude[j], count + 1
                j += side
        mean[k] = total / count
