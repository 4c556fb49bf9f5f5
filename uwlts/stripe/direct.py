"""Which of several stripes on a line is the laser's own on the surface, and which are reflections.

A mirror, or the inside corner of shining faces, shows stripes once more. Neither brightness nor order tells the right
one by itself: on a clean mirror the reflection of a painted sphere outshines the mirror's own stripe. But the laser's
stripe goes on from line to line over the whole profile, across corners, while a reflection begins or ends in the void.
Of all paths through the candidates of an image the one is sought that jumps least (`path_cost`); where two hardly
differ, the line stays ambiguous.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np

from uwlts.model.placement import camera_from_object
from uwlts.model.sensor import Sensor
from uwlts.model.stripe import Stripe, StripeCandidates, StripeStatus
from uwlts.runtime.compiled import compiled, compiled_part, compiled_with_arrays
from uwlts.stripe.extract import leave_ends_out
from uwlts.stripe.options import StripeOptions
from uwlts.stripe.path_cost import CROSSING_LINES, GAP, LONGEST_CROSSING, OPENING, SLACK_PX, own_cost, path_margins

_TURN = 0.3
"""Share of a new step in the slope with which a stripe is expected to go on."""

_MARGIN = 0.3
"""Jumps by which a path has to be the better one."""

_VOTE, _VOTES = 0.01, 100
"""Cost, in jumps, of a candidate that an image beside refuses at its place, and what one costs less that it takes; and
from how many lines on the votes for a stripe count no more: a stripe may end between two images."""

_REFUSED_BESIDE = 3
"""Lines between which a reflection that two stripes' crossing hides is the same one."""

_FEWEST_LINES = 6
"""Lines, at least, from which two stripes' distance shows where they cross."""

_BESIDE, _AS_BRIGHT = 4.0, 0.5
"""Distance, in jumps' lengths, within which stripes may run into each other, and share of the brightness from which the
other one matters."""

_GRAIN, _FEWEST_BESIDE, _STRAIGHT_PX, _STEEPEST = 3, 4, 2.5, 6.0
"""A stripe shows within `GAP` lines on so many others, at least, those next to it aside, over which a grain of speckle
may reach too, within so many px of a straight line of no more than so many px per line."""

_TAKEN, _OPEN, _REFUSED = 1, 0, -1
"""States of a candidate."""


def direct_stripes(
    images: Iterable[tuple[Stripe, StripeCandidates | None, StripeOptions]], *, farther: int
) -> Iterator[Stripe]:
    """The stripe of each of a recording's images without reflections; images without rivals keep theirs.

    ``images`` follow each other along the scan, as of `uwlts.stripe.extract.stripe_and_rivals`: the stripe with its
    ends, the candidates where there are several, and the options that found them. Candidates without a width cannot be
    measured: two stripes that run into each other, or one too wide. The path goes on through them, but their lines have
    no point. ``farther`` is as of `farther`, 0 where unknown.

    Lines on which it stays open which stripe is the laser's own are AMBIGUOUS, and ends are left out. Each stripe is
    given when the next image has come.
    """
    before: _Paths | None = None
    last: tuple[Stripe, _Paths | None, StripeOptions] | None = None
    for stripe, rivals, options in images:
        path = None if rivals is None else _Paths.of(stripe, rivals, options, farther=farther)
        if path is not None:
            path.decide(np.zeros(len(path.line)))
        if last is not None:
            yield _chosen(*last, beside=(before, path))
            before = last[1]
        last = stripe, path, options
    if last is not None:
        yield _chosen(*last, beside=(before,))


def _chosen(stripe: Stripe, path: _Paths | None, options: StripeOptions, *, beside: Sequence[_Paths | None]) -> Stripe:
    """The direct stripe of an image: decided once more where the images beside it, which show nearly the same, vote."""
    if path is not None:
        vote = sum((path.vote(other) for other in beside if other is not None), np.zeros(len(path.line)))
        if vote.any():
            path = replace(path, state=path.state.copy())
            path.decide(vote)
        stripe = path.stripe(stripe)
    return leave_ends_out(stripe, options)


@dataclass(eq=False)
class _Paths:
    """Candidates (M,) of an image on all of its lines.

    ``number`` is that of the stripe of each (`_number_stripes`), ``alone`` which are alone on their lines, ``cost``
    what each costs by the others, ``state`` what is decided.
    """

    line: np.ndarray
    centre_px: np.ndarray
    amplitude: np.ndarray
    width_px: np.ndarray
    number: np.ndarray
    alone: np.ndarray
    cost: np.ndarray
    state: np.ndarray
    least: float
    jump_px: float

    @classmethod
    def of(cls, stripe: Stripe, rivals: StripeCandidates, options: StripeOptions, *, farther: int) -> _Paths:
        """The candidates of an image; those that are alone on their lines are the stripe's."""
        least, jump_px = options.threshold_floor, options.jump_px
        alone = np.setdiff1d(stripe.lines, rivals.line)
        line = np.concatenate([alone, rivals.line])
        order = np.argsort(line, kind="stable")
        columns = (
            np.concatenate([getattr(stripe, name)[alone], getattr(rivals, name)])[order]
            for name in ("centre_px", "amplitude", "width_px")
        )
        line, centre, amplitude, width = line[order], *columns
        # Spots of a few lines are no stripe, unless nothing else is there.
        kept = np.zeros(len(line), np.bool_)
        _keep_stripes(line, centre, amplitude, kept)
        line, centre, amplitude, width = (values[kept] for values in (line, centre, amplitude, width))
        single = np.bincount(line)[line] == 1
        number, state = np.empty(len(line), np.intp), np.full(len(line), _OPEN, np.int8)
        _number_stripes(line, centre, jump_px, number)
        cost = own_cost(line, centre, amplitude, number, farther)
        return cls(line, centre, amplitude, width, number, single, cost, state, least, jump_px)

    def decide(self, vote: np.ndarray) -> None:
        """Take the candidates that the best path goes through, if it is clearly the best."""
        candidates = self.line, self.centre_px, self.amplitude, self.number, vote + self.cost
        margin = path_margins(*candidates, jump_px=self.jump_px, least=self.least)
        _take(self.line, margin, self.alone, self.state)
        _refuse_alone(self.line, self.number, self.alone, self.state)
        _refuse_crossings(self.line, self.centre_px, self.amplitude, self.state, self.jump_px)

    def vote(self, other: _Paths) -> np.ndarray:
        """What each candidate costs (M,) by what another image has decided at its place."""
        result = np.zeros(len(self.line))
        _vote(self.line, self.centre_px, other.line, other.centre_px, other.state, other.alone, self.jump_px, result)
        return result * np.minimum(_VOTES / np.bincount(self.number)[self.number], 1.0)

    def stripe(self, before: Stripe) -> Stripe:
        """The stripe of the taken candidates; lines without any that had one are AMBIGUOUS."""
        taken = (self.state == _TAKEN) & np.isfinite(self.width_px)
        status, lines = before.status.copy(), self.line[taken]
        status[self.line], status[lines] = StripeStatus.AMBIGUOUS, StripeStatus.OK
        columns = self.centre_px[taken], self.amplitude[taken], self.width_px[taken]
        return Stripe.on_lines(lines, *columns, status=status, stripe_along=before.stripe_along)


def farther(sensor: Sensor) -> int:
    """1 where a stripe that is farther away lies at a larger pixel index of its line, -1 where at a smaller one."""
    depths = np.array([(0.0, 0.0, -1.0, 1.0), (0.0, 0.0, 1.0, 1.0)])
    seen = depths @ camera_from_object(sensor).T
    across = 1 if sensor.camera.stripe_along == "width" else 0
    near, far = seen[:, across] / seen[:, 2]
    return 1 if far > near else -1


@compiled_with_arrays
def _number_stripes(line: np.ndarray, centre: np.ndarray, jump_px: float, stripe: np.ndarray) -> None:
    """Number (M,) of the stripe of each candidate: that of the one before it that it goes on from most straight.

    Only one goes on from each.
    """
    first, goes_on, slope = 0, np.zeros(line.size, np.bool_), np.zeros(line.size)
    for k in range(line.size):
        while line[k] - line[first] > GAP:
            first += 1
        before, nearest, j = -1, np.inf, k - 1
        while j >= first and (before < 0 or line[j] == line[before]):
            away = abs(centre[k] - centre[j] - slope[j] * (line[k] - line[j]))
            if line[j] < line[k] and not goes_on[j] and away < nearest and _linked(line, centre, k, j, jump_px):
                before, nearest = j, away
            j -= 1
        stripe[k] = k if before < 0 else stripe[before]
        if before >= 0:
            goes_on[before] = True
            step = (centre[k] - centre[before]) / (line[k] - line[before])
            slope[k] = slope[before] + _TURN * (step - slope[before])


@compiled
def _keep_stripes(line: np.ndarray, centre: np.ndarray, amplitude: np.ndarray, kept: np.ndarray) -> None:
    """Mark candidates that go on straight over neighbouring lines, and the brightest ones of lines without any such."""
    slopes = int(4.0 * _STEEPEST) + 1
    for k in range(line.size):
        for number in range(slopes):
            slope, beside = _STEEPEST * (2.0 * number / (slopes - 1) - 1.0), 0
            for side in (-1, 1):
                j, last = k + side, line[k]
                while 0 <= j < line.size and abs(line[j] - line[k]) <= GAP:
                    away = line[j] - line[k]
                    if (
                        abs(away) > _GRAIN
                        and line[j] != last
                        and abs(centre[j] - centre[k] - slope * away) <= _STRAIGHT_PX
                    ):
                        beside, last = beside + 1, line[j]
                    j += side
            if beside >= _FEWEST_BESIDE:
                kept[k] = True
                break
    first = 0
    while first < line.size:
        last, best, some = first, first, False
        while last < line.size and line[last] == line[first]:
            some |= kept[last]
            best = last if amplitude[last] > amplitude[best] else best
            last += 1
        for k in range(first, last):
            kept[k] |= not some and amplitude[k] >= _AS_BRIGHT * amplitude[best]
        first = last


@compiled
def _take(line: np.ndarray, margin: np.ndarray, alone: np.ndarray, state: np.ndarray) -> None:
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
                if margin[k] < margin[best]:
                    second, best = margin[best], k
                else:
                    second = min(second, margin[k])
            clear = second - margin[best] >= _MARGIN
            for k in range(first, last):
                state[k] = _REFUSED if margin[k] > _MARGIN and (clear or margin[best] > _MARGIN) else _OPEN
            if clear and margin[best] <= _MARGIN:
                state[best] = _TAKEN
        first = last


@compiled_with_arrays
def _refuse_alone(line: np.ndarray, stripe: np.ndarray, alone: np.ndarray, state: np.ndarray) -> None:
    """Refuse candidates that are alone, as noise hides the true one, between refused ones of the same stripe.

    So are those at the end of a stripe that is refused on more lines than they are.
    """
    count = line.size
    # Of each candidate the next ones of its stripe, -1 for none.
    before, after, last = np.full(count, -1), np.full(count, -1), np.full(count, -1)
    for k in range(count):
        before[k] = last[stripe[k]]
        if before[k] >= 0:
            after[before[k]] = k
        last[stripe[k]] = k
    for k in range(count):
        if not alone[k] or (before[k] >= 0 and alone[before[k]]):
            continue
        end = k
        while after[end] >= 0 and alone[after[end]]:
            end = after[end]
        refused, known = 0, 0
        for first, onwards in ((before[k], before), (after[end], after)):
            j = first
            while j >= 0 and (alone[j] or state[j] != _TAKEN):
                refused, j = refused + (0 if alone[j] else 1), onwards[j]
            known += 1 if first >= 0 else 0
            if first >= 0 and state[first] == _TAKEN:
                refused = -count
        lines = line[end] - line[k] + 1
        state_of_run = _REFUSED if refused > lines or (known == 2 and refused > 0 and lines <= 2 * GAP) else _TAKEN
        j = k
        while j >= 0 and alone[j]:
            state[j] = state_of_run
            j = after[j]


@compiled_part
def _linked(line: np.ndarray, centre: np.ndarray, one: int, other: int, jump_px: float) -> bool:
    """Whether two candidates may be of the same stripe."""
    return abs(centre[one] - centre[other]) <= jump_px + SLACK_PX * max(abs(line[one] - line[other]) - 1, 0)


@compiled_with_arrays
def _refuse_crossings(
    line: np.ndarray, centre: np.ndarray, amplitude: np.ndarray, state: np.ndarray, jump_px: float
) -> None:
    """Open what is taken where a refused stripe and another one run into each other."""
    count = line.size
    hidden = np.zeros(count, np.bool_)
    for i in range(count):
        rival = _nearest_beside(line, centre, i)
        if state[i] == _TAKEN or rival < 0 or amplitude[i] < _AS_BRIGHT * amplitude[rival]:
            continue
        away = centre[i] - centre[rival]
        if abs(away) > _BESIDE * jump_px:
            continue
        for side in (-1, 1):
            if _pair_beside(line, centre, state, i, -side, away, _REFUSED_BESIDE, jump_px) >= 0:
                continue
            # How the distance grows from here on.
            seen, at, apart = 1, i, away
            while seen < CROSSING_LINES:
                j = _pair_beside(line, centre, state, at, side, away, _REFUSED_BESIDE + 1, jump_px)
                if j < 0:
                    break
                seen, at, apart = seen + 1, j, centre[j] - centre[_nearest_beside(line, centre, j)]
            if seen < _FEWEST_LINES:
                continue
            growth = (abs(apart) - abs(away)) / abs(line[at] - line[i])
            if growth > OPENING:
                reach = min(abs(away) / growth, LONGEST_CROSSING) + 2.0
                j = i - side
                while 0 <= j < count and abs(line[j] - line[i]) <= reach:
                    hidden[j] |= line[j] != line[i]
                    j -= side
    for k in range(count):
        if hidden[k] and state[k] == _TAKEN:
            state[k] = _OPEN


@compiled_part
def _nearest_beside(line: np.ndarray, centre: np.ndarray, number: int) -> int:
    """Number of the candidate on the same line that is nearest; -1 where none is."""
    first, best = number, -1
    while first > 0 and line[first - 1] == line[number]:
        first -= 1
    while first < line.size and line[first] == line[number]:
        if first != number and (best < 0 or abs(centre[first] - centre[number]) < abs(centre[best] - centre[number])):
            best = first
        first += 1
    return best


@compiled_part
def _pair_beside(
    line: np.ndarray,
    centre: np.ndarray,
    state: np.ndarray,
    number: int,
    side: int,
    away: float,
    most: int,
    jump_px: float,
) -> int:
    """Number of the next candidate of a refused stripe, to some side, that has another one on the same side of it."""
    j = number + side
    while 0 <= j < line.size and abs(line[j] - line[number]) <= most:
        if line[j] != line[number] and state[j] != _TAKEN and _linked(line, centre, number, j, jump_px):
            other = _nearest_beside(line, centre, j)
            if other >= 0 and (centre[j] - centre[other]) * away > 0:
                return j
        j += side
    return -1


@compiled
def _vote(
    line: np.ndarray,
    centre: np.ndarray,
    other_line: np.ndarray,
    other_centre: np.ndarray,
    other_state: np.ndarray,
    other_alone: np.ndarray,
    jump_px: float,
    result: np.ndarray,
) -> None:
    """Add the votes of another image's candidates on the same lines, at places no farther than a jump."""
    first = 0
    for k in range(line.size):
        while first < other_line.size and other_line[first] < line[k]:
            first += 1
        nearest, j = jump_px, first
        while j < other_line.size and other_line[j] == line[k]:
            if abs(other_centre[j] - centre[k]) < nearest:
                nearest = abs(other_centre[j] - centre[k])
                result[k] = 0.0 if other_alone[j] else -_VOTE * other_state[j]
            j += 1
