"""Search of each profile line for its stripe: blocks of high contrast are examined one after another."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from uwlts.model.stripe import StripeStatus
from uwlts.runtime.compiled import compiled, compiled_inline, compiled_part
from uwlts.stripe.options import PeakRule, StripeOptions
from uwlts.stripe.peak_window import (
    FIRST,
    FWHM_PER_SIGMA,
    LANES,
    LAST,
    STRONGEST,
    WINDOW_RULE,
    Buffers,
    PeakShape,
    PeakWindow,
    SearchRules,
    cut_window,
    measure_group,
)


class _SearchRule(NamedTuple):
    """Numbers of the search that are not options; a named tuple, which compiled code reads as constants.

    Chosen by hand with the reasons below; tests/uwlts/stripe/test_unchanged.py keeps the results on drawn stripes. The
    least height is that of `SearchRules`.
    """

    looks: int = 4  # places examined per line: hot pixels before the stripe, and a second stripe after it
    most_stripes: int = 6  # most stripes on one line: two sheets, each with two reflections
    coarse_slack: float = 0.75
    """Ratio of the block contrasts of equal stripes that have different pixel phases (sigma 0.7 px)."""
    clear: float = 3.0  # contrast of a block, in least heights, that cannot be noise in single pixels
    rival: float = 1.3
    """Contrast of a block, in least heights, that may be a second stripe. Noise reaches it on one line in a hundred,
    and the least height on every second line."""
    spike: float = 0.85
    """Least ratio of a stripe's three-pixel mean to the least height; noise may lower the mean a little."""
    bright: float = 0.25
    """Least height of a bright peak, as a fraction of the saturation. A wide peak that is lower is haze."""
    minor: float = 0.5
    """Largest height of an ignored stripe, as a fraction of another stripe's; it cannot be measured itself."""


_RULE = _SearchRule()

MARGIN = 2
"""Blocks on either side of its own block that a window covers."""

_OK = int(StripeStatus.OK)
_NO_STRIPE = int(StripeStatus.NO_STRIPE)
_AMBIGUOUS = int(StripeStatus.AMBIGUOUS)
_BORDER = int(StripeStatus.BORDER)
_ORDER = {PeakRule.DIRECT: STRONGEST, PeakRule.STRONGEST: STRONGEST, PeakRule.FIRST: FIRST, PeakRule.LAST: LAST}


def search_rules(options: StripeOptions, *, coarse: float, fine: float, clip: float) -> SearchRules:
    """Return the rules of the search for thresholds ``coarse`` and ``fine``, and saturation at ``clip``."""
    half = options.half_window_px
    return SearchRules(
        half=half,
        block=half // 2,
        smoothing=options.smoothing_px,
        share=options.ambiguous_ratio,
        order=_ORDER[options.peak],
        narrowest=options.min_fwhm_px / FWHM_PER_SIGMA,
        widest=half / FWHM_PER_SIGMA,
        coarse=coarse,
        fine=fine,
        bright=max(fine, _RULE.bright * clip),
    )


def search_profiles(
    profiles: np.ndarray, board: np.ndarray, rules: SearchRules
) -> tuple[np.ndarray, np.ndarray, np.ndarray, PeakWindow]:
    """Examine blocks of high contrast in the order of the rule, until each line has a stripe or no such block left.

    Under the rule `strongest`, a line with a stripe is searched again for a second stripe.

    Parameters
    ----------
    profiles
        Pixels (N, L) along the L lines.
    board
        Contrasts (L, B + 2 `MARGIN`) of the B blocks of each line, with zeros at both ends. Examined blocks are set to
        0.
    rules
        Rules of the search.

    Returns
    -------
    tuple
        Status (L,) of each line; whether a bright peak was too wide (L,); whether the line may contain more than one
        stripe (L,); and the windows of the lines with a stripe, in their order.
    """
    lines = profiles.shape[1]
    jobs = _Jobs.allocate(_RULE.looks * lines, lines, board.dtype, rules)
    status = np.full(lines, _NO_STRIPE, np.uint8)
    wide, several = np.zeros((2, lines), np.bool_)
    own, rival = np.full((2, lines), -1, np.intp)
    count = _search_lines(profiles, board, jobs, rules, status, wide, several, own, rival)
    peaks = jobs.peaks.first(count) if count >= 0 else jobs.peaks.select(own[status == _OK])
    return status, wide, several, peaks


class _Jobs(NamedTuple):
    """Peaks to be measured, in groups of `LANES`: places of up to M windows on L lines, and memory for the search.

    Compiled code takes its arrays as arguments, because Numba compiles longest for arrays made in compiled code.
    """

    peaks: PeakWindow
    shape: PeakShape
    buffers: Buffers
    line: np.ndarray  # (M,), -1 without a window
    block: np.ndarray  # (M,)
    contrast: np.ndarray  # (M,), of the block
    highest: np.ndarray  # (L,), contrast of the blocks to be examined
    chosen: np.ndarray  # (L,), the block of this contrast
    active: np.ndarray  # (L,) bool, lines to be examined further

    @classmethod
    def allocate(cls, most: int, lines: int, dtype: np.dtype, rules: SearchRules) -> _Jobs:
        """Allocate memory for ``most`` windows, and groups that are not full."""
        most += LANES * 2 * _RULE.most_stripes
        peaks = PeakWindow.empty(most, 2 * rules.half + rules.block, rules.smoothing)
        shape = PeakShape(np.empty(most, np.int32), *np.empty((2, most), np.bool_))
        line, block = np.empty((2, most), np.intp)
        of_lines = np.empty(lines, dtype), np.empty(lines, np.uint16), np.ones(lines, np.bool_)
        return cls(peaks, shape, Buffers.for_windows(peaks), line, block, np.empty(most, np.float32), *of_lines)


def search_all(
    profiles: np.ndarray, board: np.ndarray, lines: np.ndarray, rules: SearchRules, *, fewest: int = 1
) -> tuple[np.ndarray, np.ndarray, PeakWindow]:
    """Find all stripes on lines (M,) that contain at least ``fewest`` stripes.

    Returns the line of each stripe, whether it can be measured, and its window, in the order of the lines. ``board``
    (B + 2 `MARGIN`, M) contains the contrasts on these lines; for other parameters see `search_profiles`.

    A stripe cannot be measured if another one overlaps its pixels, if it is bright and too wide, or if it is cut off by
    the border.
    """
    rules = rules._replace(order=FIRST)
    jobs = _Jobs.allocate(2 * _RULE.most_stripes * len(lines), len(lines), board.dtype, rules)
    own = np.full((len(lines), _RULE.most_stripes), -1, np.intp)
    clear = np.zeros(own.shape, np.bool_)
    _search_all(profiles, board, lines, jobs, rules, own, clear)
    found = own >= 0
    found[found.sum(axis=1) < fewest] = False
    return np.repeat(lines, found.sum(axis=1)), clear[found], jobs.peaks.select(own[found])


def mark_rivals(
    profiles: np.ndarray, left: np.ndarray, lines: np.ndarray, known: np.ndarray, rules: SearchRules
) -> np.ndarray:
    """Return a mask (M,) of the lines that have a block of high contrast left.

    Parameters
    ----------
    profiles : (N, L)
        Grey values of all lines.
    left : (B + 2 MARGIN, L)
        Contrasts of the remaining blocks of all lines; spikes are ignored.
    lines : (M,)
        Profile lines to examine.
    known : (M,)
        Lines that are marked already and not examined.
    rules
        Rules of the search.
    """
    found = known.copy()
    _mark_rivals(profiles, left, lines, np.empty(rules.block + 2, np.float32), rules, found)
    return found


def measure_at(profiles: np.ndarray, lines: np.ndarray, centre: np.ndarray, options: StripeOptions) -> PeakWindow:
    """Measure peaks at given centres (M,) on M lines of the profiles (N, L).

    Their height is 0 if there is no peak.
    """
    rules = search_rules(options, coarse=0.0, fine=0.0, clip=np.inf)
    jobs = _Jobs.allocate(len(lines), 0, np.dtype(np.uint8), rules)
    jobs.line[: len(lines)] = lines
    jobs.peaks.start[: len(lines)] = np.rint(centre).astype(np.intp) - rules.half - rules.block // 2
    _measure_lines(profiles, jobs, len(lines), rules)
    peaks = jobs.peaks.first(len(lines))
    peaks.height[~jobs.shape.closed[: len(lines)]] = 0.0
    return peaks


@compiled
def _measure_lines(profiles: np.ndarray, jobs: _Jobs, count: int, rules: SearchRules) -> None:
    """Measure the first windows without moving them."""
    _measure_jobs(profiles, jobs, 0, count, 0, rules)


@compiled_part
def _measure_jobs(profiles: np.ndarray, jobs: _Jobs, first: int, end: int, moves: int, rules: SearchRules) -> None:
    """Cut and measure the windows from `first`, the beginning of a group, to `end`.

    If ``moves`` is 1, windows that do not contain a half-height crossing or a flank of their peak are moved to it, and
    measured again.
    """
    peaks, size = jobs.peaks, jobs.peaks.window.shape[1]
    for m in range(end, -(-end // LANES) * LANES):
        peaks.start[m], jobs.line[m] = peaks.start[end - 1], jobs.line[end - 1]
    for group in range(first // LANES, -(-end // LANES)):
        for attempt in range(1 + moves):
            _cut_group(profiles, peaks.start, jobs.line, group, jobs.buffers.place, peaks.window[group])
            measure_group(group, profiles.shape[0], rules, jobs.buffers, peaks, jobs.shape)
            moved = False
            for m in range(group * LANES, (group + 1) * LANES if attempt < moves else 0):
                offset = _window_offset(jobs, m, size, rules)
                peaks.start[m] += offset
                moved |= offset != 0
            if not moved:
                break


@compiled_inline
def _cut_group(
    profiles: np.ndarray, start: np.ndarray, line: np.ndarray, group: int, place: np.ndarray, out: np.ndarray
) -> None:
    """Copy the pixels of a group of windows; beyond the image the border pixel is repeated."""
    m0, last, size, lines = group * LANES, profiles.shape[0] - 1, out.shape[0], profiles.shape[1]
    pixels, lowest, highest = profiles.reshape(profiles.size), np.intp(0), np.intp(0)
    for k in range(LANES):
        lowest, highest = min(lowest, start[m0 + k]), max(highest, start[m0 + k])
        place[k] = start[m0 + k] * lines + line[m0 + k]
    if lowest >= 0 and highest + size - 1 <= last:
        for x in range(size):
            row = pixels[x * lines :]
            for k in range(LANES):
                out[x, k] = row[place[k]]
    else:
        for k in range(LANES):
            for x in range(size):
                out[x, k] = profiles[min(max(start[m0 + k] + x, 0), last), line[m0 + k]]


@compiled
def _search_lines(
    profiles: np.ndarray,
    board: np.ndarray,
    jobs: _Jobs,
    rules: SearchRules,
    status: np.ndarray,
    wide: np.ndarray,
    several: np.ndarray,
    own: np.ndarray,
    rival: np.ndarray,
) -> int:
    """Fill `status`, `wide`, `several`, and the numbers of the windows of each line's stripe and a dimmer one.

    Return the number of lines with a stripe, or -1 if their windows are not the first ones in the lines' order.
    """
    near, peaks, end = jobs.buffers.values[: rules.block + 2], jobs.peaks, int(np.intp(0))
    for _ in range(_RULE.looks):
        _find_highest_blocks(board, jobs.highest, jobs.chosen)
        first = -(-end // LANES) * LANES
        end, looked = first, False
        for line in range(status.size):
            if not jobs.active[line]:
                continue
            highest, least = jobs.highest[line], np.float32(rules.coarse)
            if status[line] == _OK:
                several[line] |= highest >= _RULE.rival * rules.coarse
                least = max(least, np.float32(jobs.contrast[own[line]]) * np.float32(rules.share * _RULE.coarse_slack))
            if highest < least or highest <= 0:
                jobs.active[line] = False
            else:
                chosen = _choose_block(board, line, highest, int(jobs.chosen[line]), least, rules)
                end += _add_job(profiles, board, chosen, line, line, jobs, end, near, rules)
                looked = True
        if not looked:
            break
        _measure_jobs(profiles, jobs, first, end, 1, rules)
        for m in range(first, end):
            line = jobs.line[m]
            verdict = _classify_peak(jobs, m, profiles.shape[0], rules)
            if verdict == _NO_STRIPE:
                wide[line] |= _is_too_wide(jobs, m, profiles.shape[0], rules)
                continue
            # `measure_group` has searched this window for rivals.
            for k in range(jobs.block[m] - MARGIN, jobs.block[m] + MARGIN + 1):
                board[k, line] = 0
            if status[line] != _OK:
                status[line], own[line] = verdict, m
                several[line] |= verdict != _OK
                jobs.active[line] = verdict == _OK and rules.order == STRONGEST
                continue
            # The flank of a wide stripe may have contrast in another block, which leads to the same stripe.
            stripe = int(own[line])
            if _distance(peaks, m, stripe) <= peaks.sigma[stripe] * np.float32(FWHM_PER_SIGMA):
                continue
            if peaks.height[m] >= rules.share * peaks.height[stripe]:
                status[line], several[line], jobs.active[line] = _AMBIGUOUS, True, False
            else:
                rival[line] = m
    count, in_order = int(np.intp(0)), True
    for line in range(status.size):
        if status[line] == _OK:
            in_order &= own[line] == count
            count += 1
        if rival[line] >= 0:
            # Too dim to make the line ambiguous, but left in the board for a search of all stripes.
            board[jobs.block[rival[line]], line] = jobs.contrast[rival[line]]
    return count if in_order else -1


@compiled_part
def _add_job(
    profiles: np.ndarray,
    board: np.ndarray,
    chosen: int,
    row: int,
    line: int,
    jobs: _Jobs,
    m: int,
    near: np.ndarray,
    rules: SearchRules,
) -> int:
    """Clear a block in a row of the board and add it as window m, unless it is a spike; return the number added."""
    there = np.float32(board[chosen, row])
    board[chosen, row] = 0
    start = (chosen - MARGIN) * rules.block - rules.half
    if there < _RULE.clear * rules.fine:
        cut_window(profiles, line, start + rules.half - 1, near)
        if _is_spike(near, there, rules.fine):
            return 0
    jobs.peaks.start[m], jobs.line[m], jobs.block[m], jobs.contrast[m] = start, line, chosen, there
    return 1


@compiled_part
def _find_highest_blocks(board: np.ndarray, highest: np.ndarray, chosen: np.ndarray) -> None:
    """Find the highest contrast of each line's blocks, and the first block with it."""
    for k in range(highest.size):
        highest[k], chosen[k] = board[0, k], np.uint16(0)
    for number in range(1, board.shape[0]):
        blocks = board[number]
        for k in range(highest.size):
            chosen[k] = np.uint16(number) if blocks[k] > highest[k] else chosen[k]
            highest[k] = max(highest[k], blocks[k])


@compiled
def _mark_rivals(
    profiles: np.ndarray, left: np.ndarray, lines: np.ndarray, near: np.ndarray, rules: SearchRules, found: np.ndarray
) -> None:
    """Mark the lines with a block of high contrast that is not a spike."""
    for m in range(lines.size):
        for k in range(MARGIN, left.shape[0] - MARGIN):
            there = np.float32(left[k, lines[m]])
            if there >= rules.coarse and not found[m]:
                cut_window(profiles, lines[m], (k - MARGIN) * rules.block - 1, near)
                found[m] = there >= _RULE.clear * rules.fine or not _is_spike(near, there, rules.fine)


@compiled
def _search_all(
    profiles: np.ndarray,
    board: np.ndarray,
    lines: np.ndarray,
    jobs: _Jobs,
    rules: SearchRules,
    own: np.ndarray,
    clear: np.ndarray,
) -> None:
    """Fill the numbers of the windows of all stripes (M, `most_stripes`) on given lines, and whether they are clear."""
    near, peaks, end = jobs.buffers.values[: rules.block + 2], jobs.peaks, int(np.intp(0))
    for _ in range(2 * _RULE.most_stripes):
        _find_highest_blocks(board, jobs.highest, jobs.chosen)
        first = -(-end // LANES) * LANES
        end, looked = first, False
        for row in range(lines.size):
            there = jobs.highest[row]
            if own[row, -1] < 0 and there >= rules.coarse and there > 0:
                added = _add_job(profiles, board, int(jobs.chosen[row]), row, lines[row], jobs, end, near, rules)
                # Until the windows are measured, the number of the row.
                jobs.block[end] = row
                end, looked = end + added, True
        if not looked:
            break
        _measure_jobs(profiles, jobs, first, end, 1, rules)
        for m in range(first, end):
            row, count, known = jobs.block[m], 0, False
            verdict = _classify_peak(jobs, m, profiles.shape[0], rules)
            if verdict == _NO_STRIPE and not _is_too_wide(jobs, m, profiles.shape[0], rules):
                continue
            while own[row, count] >= 0:
                stripe = own[row, count]
                widest = max(peaks.sigma[stripe], peaks.sigma[m])
                known |= _distance(peaks, m, stripe) <= np.float32(FWHM_PER_SIGMA) * widest
                count += 1
            if not known:
                own[row, count], clear[row, count] = m, verdict == _OK
    for row in range(lines.size):
        _ignore_minor(own[row], clear[row], rules, peaks)


@compiled_part
def _ignore_minor(own: np.ndarray, clear: np.ndarray, rules: SearchRules, peaks: PeakWindow) -> None:
    """Remove the stripes of a line that cannot be measured next to a measurable stripe.

    They are ignored if the other stripe is close and at least as high, or at least twice as high. Only stripes that
    might be the line's own matter.
    """
    for k in range(own.size):
        for j in range(own.size):
            if own[k] >= 0 and own[j] >= 0 and clear[j] and not clear[k]:
                share = 1.0 if _distance(peaks, own[j], own[k]) <= rules.half + rules.block else _RULE.minor
                if peaks.height[own[k]] <= share * peaks.height[own[j]]:
                    own[k] = -1


@compiled_part
def _distance(peaks: PeakWindow, one: int, other: int) -> float:
    """Return the distance of two peaks on the same line, px."""
    return abs(peaks.start[one] + peaks.middle[one] - (peaks.start[other] + peaks.middle[other]))


@compiled_inline
def _window_offset(jobs: _Jobs, m: int, size: int, rules: SearchRules) -> int:
    """Return the shift of a window that does not contain a half-height crossing or a flank of its peak."""
    to_end = np.float32(0.5 * (size - 1))
    offset = jobs.peaks.middle[m] - to_end
    outside = abs(offset) + jobs.peaks.reach[m] > to_end - WINDOW_RULE.flank + np.float32(0.5)
    if (outside or not jobs.shape.closed[m]) and jobs.peaks.height[m] >= rules.fine:
        return int(np.rint(offset))
    return 0


@compiled_part
def _is_too_wide(jobs: _Jobs, m: int, count: int, rules: SearchRules) -> bool:
    """Return True for a bright peak inside the image that is too wide to be measured."""
    wide = not jobs.shape.closed[m] or jobs.peaks.sigma[m] > rules.widest
    return bool(
        wide and jobs.peaks.height[m] >= rules.bright and _is_inside(jobs.peaks.start[m] + jobs.shape.top[m], count)
    )


@compiled_part
def _is_inside(highest: int, count: int) -> bool:
    """Return True unless a maximum is at the border, where it may be any rise towards the border, such as a frame."""
    return 1 < highest < count - 2


@compiled_part
def _choose_block(
    board: np.ndarray, line: int, highest: np.number, chosen: int, least: float | np.floating, rules: SearchRules
) -> int:
    """Return a line's block by the rule, among those of at least `least` contrast; `chosen` is the highest one.

    First and last are chosen among the blocks whose contrast is a sufficient fraction of the highest one on their line.
    """
    wanted = max(least, np.float32(highest) * np.float32(rules.share * _RULE.coarse_slack))
    if rules.order == FIRST:
        chosen = 0
        while board[chosen, line] < wanted:
            chosen += 1
    elif rules.order == LAST:
        chosen = board.shape[0] - 1
        while board[chosen, line] < wanted:
            chosen -= 1
    return chosen


@compiled_part
def _is_spike(near: np.ndarray, there: np.float32, fine: float) -> bool:
    """Return True if the contrast of a block is due to noise in single pixels.

    This cheap test avoids a closer examination of most lines without light. ``near`` contains the pixels of the block
    and one on either side. The mean of three pixels reduces a stripe less than the low-pass, after which it must still
    be ``fine`` high.
    """
    single, mean = near[1], np.float32(-np.inf)
    for k in range(1, near.size - 1):
        single = max(single, near[k])
        mean = max(mean, near[k - 1] + near[k] + near[k + 1])
    return there - (single - mean * np.float32(1.0 / 3.0)) < _RULE.spike * fine


@compiled_part
def _classify_peak(jobs: _Jobs, m: int, count: int, rules: SearchRules) -> int:
    """Return the status; NO_STRIPE for a peak too low, narrow or wide, or one that rises towards the border."""
    peaks, start = jobs.peaks, jobs.peaks.start[m]
    if peaks.height[m] < rules.fine:
        return _NO_STRIPE
    if not jobs.shape.closed[m]:
        # The far side is outside the image.
        outside = start < 0 or start + peaks.window.shape[1] > count
        return _BORDER if outside and _is_inside(start + jobs.shape.top[m], count) else _NO_STRIPE
    if not rules.narrowest <= peaks.sigma[m] <= rules.widest:
        return _NO_STRIPE
    middle, extent = start + peaks.middle[m], peaks.reach[m] + WINDOW_RULE.flank - 1
    if middle - extent < 0 or middle + extent > count - 1:
        return _BORDER
    return _AMBIGUOUS if jobs.shape.crowded[m] else _OK
