"""Which of several stripes on a line is the laser's own on the surface, and which are reflections.

A mirror, or the inside corner of shining faces, shows stripes once more. Neither brightness nor order tells the right
one: on a clean mirror the reflection of a painted sphere outshines the mirror's own stripe. But the laser's stripe goes
on from line to line over the whole profile, across corners, while a reflection begins or ends in the void. Of all paths
through the candidates of an image the one is sought that jumps least and leaves fewest lines out. Where two hardly
differ, the line stays ambiguous. The costs of paths follow from the min-sum algorithm on a chain, forwards and
backwards (Bishop, Pattern Recognition and Machine Learning, section 8.4.5).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from uwlts.model.stripe import Stripe, StripeCandidates, StripeStatus
from uwlts.runtime.compiled import compiled, compiled_with_arrays

_TAKEN, _OPEN, _REFUSED = np.int8(1), np.int8(0), np.int8(-1)
"""States of a candidate."""


@dataclass(frozen=True, kw_only=True)
class DirectRule:
    """Numbers of the rule. Costs of paths are counted in jumps from one stripe to another.

    All were chosen on the scenes `NAMED` of docs/studies/stripe_reflections.py, rendered for a small camera, where
    0.40 % of the points are wrong. What other numbers give there is stated beside them, found at 0.02 for ``skipped``
    by a state of the rule that left 0.45 % of the points wrong.

    Attributes
    ----------
    gap_lines : int
        Lines for which a stripe may be lost and go on: those that noise and speckle hide of a faint one. 20 give
        0.53 %; 28 and 48 give the same.
    fewest_lines : int
        Lines of a stripe at least, beside others: shorter ones are grains of speckle. 4 to 10 give the same.
    skipped : float
        Cost of a line whose candidates a path leaves out: 80 lines outweigh a jump. Of a stripe that is lost on some of
        its lines the cost is less by their share. 0.02 and 0.03 give the same and leave fewer lines open, but leave a
        corner open whose wall is faint, which tests/uwlts/stripe/test_direct.py draws.
    margin : float
        Cost by which a path has to be the better one. 0.2 and 0.4 give the same; at 0.4 more lines stay open.
    meeting_jumps : float
        Distance, in jumps' lengths, within which two stripes may run into each other: one window. 3 give 0.48 %, 6 the
        same.
    meeting_lines : int
        Lines that are left out there at most. 12 give 0.66 %, 36 give 0.36 % and lose 1 % more lines.
    """

    gap_lines: int = 36
    fewest_lines: int = 6
    skipped: float = 0.0125
    margin: float = 0.3
    meeting_jumps: float = 4.0
    meeting_lines: int = 20


def direct_stripe(
    stripe: Stripe, rivals: StripeCandidates, *, jump_px: float, rule: DirectRule = DirectRule()
) -> Stripe:
    """Return the stripe of an image without reflections, its ends included.

    Lines on which it stays open which stripe is the laser's own are AMBIGUOUS. ``stripe`` is the one that extraction
    has found, ``rivals`` are all candidates on lines with more than one. Candidates without a width cannot be measured:
    two stripes that run into each other, or one too wide. The path goes on through them, but their lines have no point.
    Centres of neighbouring lines more than ``jump_px`` apart are on two stripes.
    """
    alone = np.setdiff1d(stripe.lines, rivals.line)
    line = np.concatenate([alone, rivals.line])
    order = np.argsort(line, kind="stable")
    names = "centre_px", "amplitude", "width_px"
    columns = [np.concatenate([getattr(stripe, name)[alone], getattr(rivals, name)])[order] for name in names]
    line, number = line[order], np.empty(len(order), np.intp)
    _number_stripes(line, columns[0], rule.gap_lines, jump_px, number)
    # Grains are no stripe, unless nothing else is there.
    long = np.bincount(number)[number] >= rule.fewest_lines
    kept = long | ~np.isin(line, line[long])
    line, number, centre, amplitude, width = (each[kept] for each in (line, number, *columns))
    number = np.unique(number, return_inverse=True)[1]
    single, state = np.bincount(line)[line] == 1, np.empty(len(line), np.int8)
    before, after = np.empty((2, len(line)))
    _fit_slopes(line, centre, number, rule.gap_lines, before, after)
    _take(line, _margins(line, centre, number, before, after, jump_px, rule), single, rule.margin, state)
    _refuse_alone(number, single, state)
    reach_px = rule.meeting_jumps * jump_px
    _open_meetings(line, centre, number, before, after, rule.meeting_lines, reach_px, state)
    taken = (state == _TAKEN) & np.isfinite(width)
    status = stripe.status.copy()
    status[line], status[line[taken]] = StripeStatus.AMBIGUOUS, StripeStatus.OK
    found = line[taken], centre[taken], amplitude[taken], width[taken]
    return Stripe.on_lines(*found, status=status, stripe_along=stripe.stripe_along)


def _margins(
    line: np.ndarray,
    centre: np.ndarray,
    number: np.ndarray,
    before: np.ndarray,
    after: np.ndarray,
    jump_px: float,
    rule: DirectRule,
) -> np.ndarray:
    """Cost (M,), in jumps beyond the best path, of the best path through each candidate."""
    through, backwards = np.empty((2, len(line)))
    # Of its lines, a stripe is seen on this share; that of a faint one is missed on others by chance.
    first, last = np.full(number.max() + 1, line.max()), np.zeros(number.max() + 1, line.dtype)
    np.minimum.at(first, number, line)
    np.maximum.at(last, number, line)
    missed = rule.skipped * (np.bincount(number) / (last - first + 1))[number]
    gap, skipped = rule.gap_lines, rule.skipped
    _least_cost(line, centre, before, after, missed, gap, jump_px, skipped, through)
    turned = (values[::-1].copy() for values in (line.max() - line, centre, -after, -before, missed))
    _least_cost(*turned, gap=gap, jump_px=jump_px, skipped=skipped, result=backwards)
    through += backwards[::-1]
    return through - through.min()


@compiled_with_arrays
def _number_stripes(line: np.ndarray, centre: np.ndarray, gap: int, jump_px: float, number: np.ndarray) -> None:
    """Number (M,) of the stripe of each candidate: that of the nearest one on the last line with one near enough.

    Only one goes on from each.
    """
    first, goes_on = 0, np.zeros(line.size, np.bool_)
    for k in range(line.size):
        while line[k] - line[first] > gap:
            first += 1
        before, nearest, j = -1, np.inf, k - 1
        while j >= first and (before < 0 or line[j] == line[before]):
            away = abs(centre[k] - centre[j])
            if line[j] < line[k] and not goes_on[j] and away <= jump_px and away < nearest:
                before, nearest = j, away
            j -= 1
        number[k] = k if before < 0 else number[before]
        if before >= 0:
            goes_on[before] = True


@compiled
def _fit_slopes(
    line: np.ndarray, centre: np.ndarray, number: np.ndarray, gap: int, before: np.ndarray, after: np.ndarray
) -> None:
    """Slopes (M,) of the stripe of each candidate on the lines before and after it, by least squares; 0 at its ends."""
    for side, result in ((-1, before), (1, after)):
        for k in range(line.size):
            products, squares, j = 0.0, 0.0, k + side
            while 0 <= j < line.size and abs(line[j] - line[k]) <= gap:
                if number[j] == number[k]:
                    away = float(line[j] - line[k])
                    products, squares = products + away * (centre[j] - centre[k]), squares + away * away
                j += side
            result[k] = products / squares if squares > 0.0 else 0.0


@compiled
def _least_cost(
    line: np.ndarray,
    centre: np.ndarray,
    before: np.ndarray,
    after: np.ndarray,
    missed: np.ndarray,
    gap: int,
    jump_px: float,
    skipped: float,
    result: np.ndarray,
) -> None:
    """Cost (M,) of the best path that ends in each candidate, from the first line on.

    A path goes on to a candidate near the last one, or near where the slope of either one's stripe leads, ``before`` of
    the last one and ``after`` of the next one; else it jumps. Each line with candidates between costs what it does of
    the stripe that is ``missed`` more often, or ``skipped`` at a jump.
    """
    elsewhere, best_of_line, first = 0.0, np.inf, 0
    for k in range(line.size):
        if k > 0 and line[k] != line[k - 1]:
            elsewhere, best_of_line = min(elsewhere + skipped, best_of_line), np.inf
        while line[k] - line[first] > gap:
            first += 1
        best, passed, j = elsewhere, -1.0, k - 1
        while j >= first:
            apart = line[k] - line[j]
            if line[j] != line[j + 1]:
                passed += 1.0
            if apart > 0:
                moved = centre[k] - centre[j]
                off = min(abs(moved), abs(moved - before[j] * apart), abs(moved - after[k] * apart))
                if off <= jump_px:
                    best = min(best, result[j] + min(missed[j], missed[k]) * passed)
            j -= 1
        result[k] = best
        best_of_line = min(best_of_line, best + 1.0)


@compiled
def _take(line: np.ndarray, cost: np.ndarray, alone: np.ndarray, margin: float, state: np.ndarray) -> None:
    """Take on each line the candidate on the best path, if every path by way of another one is clearly worse.

    Candidates that are alone are taken.
    """
    first = 0
    while first < line.size:
        last = first
        while last < line.size and line[last] == line[first]:
            state[last] = _TAKEN
            last += 1
        if not alone[first]:
            best, second = first, np.inf
            for k in range(first + 1, last):
                if cost[k] < cost[best]:
                    second, best = cost[best], k
                else:
                    second = min(second, cost[k])
            clear = second - cost[best] >= margin
            for k in range(first, last):
                state[k] = _REFUSED if cost[k] > margin and (clear or cost[best] > margin) else _OPEN
            if clear and cost[best] <= margin:
                state[best] = _TAKEN
        first = last


@compiled_with_arrays
def _refuse_alone(number: np.ndarray, alone: np.ndarray, state: np.ndarray) -> None:
    """Refuse runs of candidates that are alone, because noise hides the true one, in a stripe that is not taken.

    The stripe is refused somewhere and goes on untaken on both sides of the run, or it is untaken on at least as many
    lines as the run has.
    """
    # Of each candidate the next ones of its stripe, -1 for none.
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
        sides, doubtful, refused, taken = 0, 0, 0, False
        for beside, onwards in ((before[k], before), (after[end], after)):
            if beside >= 0:
                taken |= state[beside] == _TAKEN
                sides += 1
            while beside >= 0 and (alone[beside] or state[beside] != _TAKEN):
                refused += 1 if state[beside] == _REFUSED else 0
                doubtful += 1 if state[beside] == _OPEN else 0
                beside = onwards[beside]
        if not taken and ((sides == 2 and refused > 0) or count <= refused + doubtful):
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
    """Open what is taken beyond the end of a stripe that is not taken, where another one runs into it.

    The image may show both as one there. By their slopes they meet within so many lines at ``most``.
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
                    apart = centre[j] - centre[k]
                    goes_on &= abs(apart) > reach_px or apart * (apart + side * most * (slope[j] - slope[k])) > 0.0
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
