"""Selection of the laser's own stripe among reflections.

A mirror, or the inner corner of shining faces, shows further stripes. Neither brightness nor order identifies the
laser's stripe: a clean mirror reflects a painted sphere brighter than the mirror's own stripe. But the laser's stripe
continues from line to line over the whole profile, across corners, while a reflection begins or ends without a surface.

The method finds the path through the candidates of an image with the fewest jumps and omitted lines. If two paths are
about equal, the line stays ambiguous. The costs of all paths follow from the min-sum algorithm on a chain, forwards and
backwards (Bishop, Pattern Recognition and Machine Learning, section 8.4.5).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from uwlts.model.stripe import Stripe, StripeCandidates, StripeStatus
from uwlts.runtime.compiled import compiled, compiled_with_arrays

_TAKEN = np.int8(1)  # state of a candidate on the direct stripe
_OPEN = np.int8(0)  # state of a candidate that may be on the direct stripe
_REFUSED = np.int8(-1)  # state of a candidate of a reflection


@dataclass(frozen=True, kw_only=True)
class DirectRule:
    """Numbers of the rule; the unit of path costs is one jump between stripes.

    All were chosen on the scenes `NAMED` of docs/studies/stripe_reflections.py, rendered for a small camera, with 0.40
    % wrong points. The effects of other values are stated below. They were determined at 0.02 for ``skipped``, with an
    earlier version of the rule that gave 0.45 % wrong points.
    """

    gap_lines: int = 36
    """Largest gap of a stripe, in lines: noise and speckle hide parts of a faint stripe. 20 gives 0.53 %; 28 and 48
    give the same as 36."""
    fewest_lines: int = 6
    """Fewest lines of a stripe next to others; shorter ones are grains of speckle. 4 to 10 give the same."""
    skipped: float = 0.0125
    """Cost of a line whose candidates a path omits: 80 lines cost as much as a jump. For a stripe with gaps the cost is
    multiplied by its fraction of lines with a candidate. 0.02 and 0.03 give the same with fewer ambiguous lines, but
    make a corner with a faint wall ambiguous (drawn in tests/uwlts/stripe/test_direct.py)."""
    margin: float = 0.3
    """Least difference of the costs of the best and the second-best path. 0.2 and 0.4 give the same; 0.4 leaves more
    lines ambiguous."""
    meeting_jumps: float = 4.0
    """Largest distance of merging stripes, in jump lengths: one window. 3 gives 0.48 %, 6 the same as 4."""
    meeting_lines: int = 20
    """Most lines omitted where stripes merge. 12 gives 0.66 %; 36 gives 0.36 % with 1 % more lines lost."""


_RULE = DirectRule()


def direct_stripe(stripe: Stripe, rivals: StripeCandidates, *, jump_px: float) -> Stripe:
    """Return the stripe of an image without reflections, including its ends.

    Lines without a unique choice become AMBIGUOUS. Candidates without a width cannot be measured: two merging stripes,
    or a stripe too wide. The path may use them, but their lines get no point. ``rivals`` are all candidates on lines
    with more than one. Centres on neighbouring lines that are farther apart than ``jump_px`` belong to two stripes.
    """
    alone = np.setdiff1d(stripe.lines, rivals.line)
    line = np.concatenate([alone, rivals.line])
    order = np.argsort(line, kind="stable")
    names = "centre_px", "amplitude", "width_px"
    columns = [np.concatenate([getattr(stripe, name)[alone], getattr(rivals, name)])[order] for name in names]
    line, number = line[order], np.empty(len(order), np.intp)
    _number_stripes(line, columns[0], _RULE.gap_lines, jump_px, number)
    # Short stripes are grains of speckle, unless they are alone.
    long = np.bincount(number)[number] >= _RULE.fewest_lines
    kept = long | ~np.isin(line, line[long])
    line, number, centre, amplitude, width = (each[kept] for each in (line, number, *columns))
    number = np.unique(number, return_inverse=True)[1]
    single = np.bincount(line)[line] == 1
    before, after = np.empty((2, len(line)))
    _fit_slopes(line, centre, number, _RULE.gap_lines, before, after)
    state = _take_best(line, _compute_path_margins(line, centre, number, before, after, jump_px), single, _RULE.margin)
    _refuse_single_runs(number, single, state)
    reach_px = _RULE.meeting_jumps * jump_px
    _open_meetings(line, centre, number, before, after, _RULE.meeting_lines, reach_px, state)
    taken = (state == _TAKEN) & np.isfinite(width)
    status = stripe.status.copy()
    status[line], status[line[taken]] = StripeStatus.AMBIGUOUS, StripeStatus.OK
    found = line[taken], centre[taken], amplitude[taken], width[taken]
    return Stripe.from_lines(*found, status=status, stripe_along=stripe.stripe_along)


def _compute_path_margins(
    line: np.ndarray, centre: np.ndarray, number: np.ndarray, before: np.ndarray, after: np.ndarray, jump_px: float
) -> np.ndarray:
    """Return the cost (M,) of the best path through each candidate, in jumps more than the best path of all."""
    through, backwards = np.empty((2, len(line)))
    # A faint stripe has gaps by chance: omitting it costs less, by the fraction of its lines with a candidate.
    first, last = np.full(number.max() + 1, line.max()), np.zeros(number.max() + 1, line.dtype)
    np.minimum.at(first, number, line)
    np.maximum.at(last, number, line)
    missed = _RULE.skipped * (np.bincount(number) / (last - first + 1))[number]
    gap, skipped = _RULE.gap_lines, _RULE.skipped
    _compute_costs(line, centre, (before, after), missed, gap, jump_px, skipped, through)
    turned, at, *slopes, lost = (each[::-1].copy() for each in (line.max() - line, centre, -after, -before, missed))
    _compute_costs(turned, at, (slopes[0], slopes[1]), lost, gap, jump_px, skipped, backwards)
    through += backwards[::-1]
    return through - through.min()


@compiled_with_arrays
def _number_stripes(line: np.ndarray, centre: np.ndarray, gap: int, jump_px: float, number: np.ndarray) -> None:
    """Assign each candidate (M,) the stripe of the nearest candidate within a jump on an earlier line.

    The latest line with such a candidate counts. Each candidate has at most one successor.
    """
    first, goes_on = 0, np.zeros(line.size, np.bool_)
    for k in range(line.size):
        while line[k] - line[first] > gap:
            first += 1
        before, nearest, j = -1, np.inf, k - 1
        while j >= first and (before < 0 or line[j] == line[before]):
            distance = abs(centre[k] - centre[j])
            if line[j] < line[k] and not goes_on[j] and distance <= jump_px and distance < nearest:
                before, nearest = j, distance
            j -= 1
        number[k] = k if before < 0 else number[before]
        if before >= 0:
            goes_on[before] = True


@compiled
def _fit_slopes(
    line: np.ndarray, centre: np.ndarray, number: np.ndarray, gap: int, before: np.ndarray, after: np.ndarray
) -> None:
    """Fit slopes (M,) of each candidate's stripe on the lines before and after it by least squares; 0 at its ends."""
    for side, result in ((-1, before), (1, after)):
        for k in range(line.size):
            products, squares, j = 0.0, 0.0, k + side
            while 0 <= j < line.size and abs(line[j] - line[k]) <= gap:
                if number[j] == number[k]:
                    distance = float(line[j] - line[k])
                    products, squares = products + distance * (centre[j] - centre[k]), squares + distance * distance
                j += side
            result[k] = products / squares if squares > 0.0 else 0.0


@compiled
def _compute_costs(
    line: np.ndarray,
    centre: np.ndarray,
    slopes: tuple[np.ndarray, np.ndarray],
    missed: np.ndarray,
    gap: int,
    jump_px: float,
    skipped: float,
    result: np.ndarray,
) -> None:
    """Compute the cost (M,) of the best path from the first line to each candidate.

    A path may continue at a candidate near the last one, or near the linear continuation of either stripe: ``slopes``
    are those before and after each candidate (`_fit_slopes`). Otherwise it jumps.

    A line with candidates between them costs the smaller ``missed`` of both candidates, or ``skipped`` at a jump.
    """
    (before, after), elsewhere, best_of_line, first = slopes, 0.0, np.inf, 0
    for k in range(line.size):
        if k > 0 and line[k] != line[k - 1]:
            elsewhere, best_of_line = min(elsewhere + skipped, best_of_line), np.inf
        while line[k] - line[first] > gap:
            first += 1
        best, passed, j = elsewhere, -1.0, k - 1
        while j >= first:
            lines_on = line[k] - line[j]
            if line[j] != line[j + 1]:
                passed += 1.0
            if lines_on > 0:
                moved = centre[k] - centre[j]
                off = min(abs(moved), abs(moved - before[j] * lines_on), abs(moved - after[k] * lines_on))
                if off <= jump_px:
                    best = min(best, result[j] + min(missed[j], missed[k]) * passed)
            j -= 1
        result[k] = best
        best_of_line = min(best_of_line, best + 1.0)


def _take_best(line: np.ndarray, cost: np.ndarray, alone: np.ndarray, margin: float) -> np.ndarray:
    """Return states (M,): the candidate on the best path of each line is taken if others cost more by the margin.

    Candidates that are alone are taken.
    """
    order, first = np.lexsort((cost, line)), np.flatnonzero(np.diff(line, prepend=-1))
    best, second = order[first], order[np.minimum(first + 1, len(order) - 1)]
    clear, good = cost[second] - cost[best] >= margin, cost[best] <= margin
    refused = np.repeat(clear | ~good, np.diff(first, append=len(line))) & (cost > margin)
    state = np.where(refused, _REFUSED, _OPEN)
    state[best[clear & good]] = _TAKEN
    state[alone] = _TAKEN
    return state


@compiled_with_arrays
def _refuse_single_runs(number: np.ndarray, alone: np.ndarray, state: np.ndarray) -> None:
    """Refuse runs of candidates that are alone on their lines, if their stripe is not taken elsewhere.

    In such a run, noise hides the true stripe. A run is refused if its stripe continues on both sides and is refused at
    least once. It is also refused if its stripe is refused or open on at least as many lines as the run has.
    """
    # Neighbours of each candidate along its stripe, -1 at its ends.
    before, after, last = np.full(number.size, -1), np.full(number.size, -1), np.full(number.size, -1)
    for k in range(number.size):
        before[k] = last[number[k]]
        if before[k] >= 0:
            after[before[k]] = k
        last[number[k]] = k
    for k in range(number.size):
        if not alone[k] or (before[k] >= 0 and alone[before[k]]):
            continue
        end, count = k, 1
        while after[end] >= 0 and alone[after[end]]:
            end, count = after[end], count + 1
        sides, opened, refused, taken = 0, 0, 0, False
        for beside, onwards in ((before[k], before), (after[end], after)):
            if beside >= 0:
                taken |= state[beside] == _TAKEN
                sides += 1
            while beside >= 0 and (alone[beside] or state[beside] != _TAKEN):
                refused += 1 if state[beside] == _REFUSED else 0
                opened += 1 if state[beside] == _OPEN else 0
                beside = onwards[beside]
        if not taken and ((sides == 2 and refused > 0) or count <= refused + opened):
            j = k
            while j >= 0 and alone[j]:
                state[j] = _REFUSED
                j = after[j]


@compiled_with_arrays
def _open_meetings(
    line: np.ndarray,
    centre: np.ndarray,
    number: np.ndarray,
    before: np.ndarray,
    after: np.ndarray,
    most: int,
    reach_px: float,
    state: np.ndarray,
) -> None:
    """Open candidates beyond the end of another stripe that may merge with theirs.

    The image may show both as one stripe. By their slopes they meet within ``most`` lines.
    """
    opened = np.zeros(line.size, np.bool_)
    for k in range(line.size):
        if state[k] == _TAKEN:
            continue
        for side in (-1, 1):
            slope, goes_on = before if side > 0 else after, True
            for way in (-1, 1):
                j = k + way
                while 0 <= j < line.size and line[j] == line[k]:
                    gap_px = centre[j] - centre[k]
                    goes_on &= abs(gap_px) > reach_px or gap_px * (gap_px + side * most * (slope[j] - slope[k])) > 0.0
                    j += way
            j = k + side
            while 0 <= j < line.size and abs(line[j] - line[k]) <= most and not goes_on:
                goes_on = number[j] == number[k] and state[j] != _TAKEN and line[j] != line[k]
                j += side
            j = line.size if goes_on else k + side
            while 0 <= j < line.size and abs(line[j] - line[k]) <= most:
                opened[j] |= line[j] != line[k] and abs(centre[j] - centre[k]) <= reach_px
                j += side
    for k in range(line.size):
        if opened[k] and state[k] == _TAKEN:
            state[k] = _OPEN
