"""Search of each profile line for its stripe: blocks of high contrast are examined one after another."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from uwlts.model.stripe import StripeStatus
from uwlts.runtime.compiled import compiled, compiled_inline, compiled_part
from uwlts.stripe.options import PeakRule, StripeOptions
from uwlts.stripe.peak_window import (
    BASE,
    CLOSED,
    CROWDED,
    FIRST,
    FWHM_PER_SIGMA,
    HEIGHT,
    LANES,
    LAST,
    MEASURED,
    MIDDLE,
    REACH,
    SIGMA,
    SLOPE,
    STRONGEST,
    TOP,
    WINDOW_RULE,
    PeakWindow,
    SearchRules,
    cut_window,
    filter_windows,
    low_pass,
    measure_peaks,
)


class _SearchRule(NamedTuple):
    """Numbers of the search that are not options; a named tuple, which compiled code reads as constants.

    Chosen by hand with the reasons below; tests/uwlts/stripe/test_unchanged.py keeps the results on drawn stripes. The
    least height is that of `SearchRules`.

    Attributes
    ----------
    looks : int
        Places examined per line: hot pixels before the stripe, and a second stripe after it.
    most_stripes : int
        Most stripes on one line: two sheets, each with two reflections.
    coarse_slack : float
        Ratio of the block contrasts of equal stripes that have different pixel phases (sigma 0.7 px).
    clear : float
        Contrast of a block, in least heights, that cannot be noise in single pixels.
    rival : float
        Contrast of a block, in least heights, that may be a second stripe. Noise reaches it on one line in a hundred,
        and the least height on every second line.
    spike : float
        Least ratio of a stripe's three-pixel mean to the least height; noise may lower the mean a little.
    bright : float
        Least height of a bright peak, as a fraction of the saturation. A wide peak that is lower is haze.
    minor : float
        Largest height of an ignored stripe, as a fraction of another stripe's; it cannot be measured itself.
    """

    looks: int = 4
    most_stripes: int = 6
    coarse_slack: float = 0.75
    clear: float = 3.0
    rival: float = 1.3
    spike: float = 0.85
    bright: float = 0.25
    minor: float = 0.5


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


class _Buffers(NamedTuple):
    """Arrays of a search on M lines, allocated outside of compiled code, which Numba compiles longest for them.

    Attributes
    ----------
    kernel : (2 R + 1,) float32
        The low-pass.
    cut : (lanes, W)
        Pixels of the windows of a group of lines, as in the image.
    pixels, smooth : (lanes (W + 2 R),), (lanes W,) float32
        The same in lanes, before and after the low-pass.
    inner, rows : (W, lanes) float32
        Views of these arrays, without borders.
    found : (`MEASURED`,) float32
        Measurements of the group.
    highest : (M,)
        Highest contrast of the blocks of each line.
    chosen : (M,) uint16
        Block of this contrast.
    least : (M,) float32
        Least contrast of a block that is examined; infinite if the search has ended on the line.
    queue, starts : (M + lanes,) int
        Index of the lines whose chosen block is examined, and the first pixel of its window.
    """

    kernel: np.ndarray
    cut: np.ndarray
    pixels: np.ndarray
    smooth: np.ndarray
    inner: np.ndarray
    rows: np.ndarray
    found: np.ndarray
    highest: np.ndarray
    chosen: np.ndarray
    least: np.ndarray
    queue: np.ndarray
    starts: np.ndarray

    @classmethod
    def empty(cls, profiles: np.ndarray, contrast: np.dtype, count: int, rules: SearchRules) -> _Buffers:
        """Allocate the buffers for ``count`` lines of the profiles (N, L)."""
        kernel, size = low_pass(rules.smoothing), _window_size(rules)
        # Whole groups of lines: the last one is filled up.
        queue, starts = np.zeros((2, count + LANES), np.intp)
        pixels, smooth = np.empty((size + kernel.size - 1, LANES), np.float32), np.empty((size, LANES), np.float32)
        border = kernel.size // 2
        return cls(
            kernel,
            np.empty((LANES, size), profiles.dtype),
            pixels.ravel(),
            smooth.ravel(),
            pixels[border : border + size],
            smooth,
            np.empty(MEASURED, np.float32),
            np.empty(count, contrast),
            np.empty(count, np.uint16),
            np.full(count, rules.coarse, np.float32),
            queue,
            starts,
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
        Contrasts (B + 2 `MARGIN`, L) of the B blocks of each line, with zeros at both ends. Examined blocks are set to
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
    peaks, status = PeakWindow.empty(lines, _window_size(rules), rules.smoothing), np.full(lines, _NO_STRIPE, np.uint8)
    wide, several = np.zeros((2, lines), np.bool_)
    rival, of_rival = np.full(lines, -1), np.empty(lines, np.float32)
    buffers = _Buffers.empty(profiles, board.dtype, lines, rules)
    own = np.arange(lines)
    count = _search_lines(profiles, board, own, rules, buffers, rival, of_rival, status, wide, several, peaks)
    return status, wide, several, peaks.first(count)


def _window_size(rules: SearchRules) -> int:
    """Return the number of pixels of a window."""
    return 2 * rules.half + rules.block


def search_all(
    profiles: np.ndarray, board: np.ndarray, lines: np.ndarray, rules: SearchRules, *, fewest: int = 1
) -> tuple[np.ndarray, np.ndarray, PeakWindow]:
    """Find all stripes on lines (M,) that contain at least ``fewest`` stripes.

    Returns the line of each stripe, whether it can be measured, and its window, in the order of the lines. ``board``
    (B + 2 `MARGIN`, M) contains the contrasts on these lines; for other parameters see `search_profiles`.

    A stripe cannot be measured if another one overlaps its pixels, if it is bright and too wide, or if it is cut off by
    the border.
    """
    rules, most = rules._replace(order=FIRST), _RULE.most_stripes * len(lines)
    peaks, clear = PeakWindow.empty(most, _window_size(rules), rules.smoothing), np.zeros(most, np.bool_)
    found, numbers = np.full(most, -1), np.zeros(len(lines), np.intp)
    buffers = _Buffers.empty(profiles, board.dtype, len(lines), rules)
    _search_all(profiles, board, lines, rules, buffers, numbers, found, clear, peaks)
    kept = np.flatnonzero(found >= 0)
    if fewest > 1:
        kept = kept[np.bincount(found[kept])[found[kept]] >= fewest]
    return found[kept], clear[kept], peaks.select(kept)


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
    _mark_rivals(profiles, left, lines, rules, found)
    return found


def measure_at(profiles: np.ndarray, lines: np.ndarray, centre: np.ndarray, options: StripeOptions) -> PeakWindow:
    """Measure peaks at given centres (M,) on M lines of the profiles (N, L).

    Their height is 0 if there is no peak.
    """
    rules = search_rules(options, coarse=0.0, fine=0.0, clip=np.inf)
    peaks = PeakWindow.empty(len(lines), _window_size(rules), rules.smoothing)
    buffers = _Buffers.empty(profiles, profiles.dtype, len(lines), rules)
    buffers.queue[: len(lines)] = np.arange(len(lines))
    buffers.starts[: len(lines)] = np.rint(centre).astype(np.intp) - rules.half - rules.block // 2
    _measure_lines(profiles, lines, rules, buffers, peaks)
    return peaks


@compiled
def _measure_lines(
    profiles: np.ndarray, lines: np.ndarray, rules: SearchRules, buffers: _Buffers, peaks: PeakWindow
) -> None:
    """Fill the windows of all lines (M,), which are in the queue."""
    for m in range(lines.size):
        k = m % LANES
        if k == 0:
            _measure_group(profiles, lines, m, rules, buffers, False)
        _store_window(peaks, m, buffers.starts[m], buffers.found[k:], buffers.cut[k])
        peaks.height[m] *= buffers.found[CLOSED + k]


@compiled
def _search_lines(
    profiles: np.ndarray,
    board: np.ndarray,
    own: np.ndarray,
    rules: SearchRules,
    buffers: _Buffers,
    rival: np.ndarray,
    of_rival: np.ndarray,
    status: np.ndarray,
    wide: np.ndarray,
    several: np.ndarray,
    peaks: PeakWindow,
) -> int:
    """Fill `status`, `wide`, `several` and the windows; return the number of lines with a stripe.

    ``own`` (L,) contains the numbers of the lines. ``rival`` (L,) and ``of_rival`` (L,) are block and contrast of a
    second stripe on each line, with -1 for none.
    """
    least, highest, chosen = buffers.least, buffers.highest, buffers.chosen
    for _ in range(_RULE.looks):
        _find_highest_blocks(board, highest, chosen)
        for line in range(status.size):
            if status[line] == _OK and least[line] < np.inf and highest[line] >= _RULE.rival * rules.coarse:
                several[line] = True
            if rules.order != STRONGEST and highest[line] >= least[line]:
                wanted = np.float32(highest[line]) * np.float32(rules.share * _RULE.coarse_slack)
                chosen[line] = _choose_outermost(board, line, max(least[line], wanted), rules)
        count = _queue_blocks(profiles, board, own, rules, buffers)
        if count < 0:
            break
        for number in range(count):
            k = number % LANES
            if k == 0:
                _measure_group(profiles, own, number, rules, buffers, True)
            line, start, found = buffers.queue[number], buffers.starts[number], buffers.found[k:]
            block = int(chosen[line])
            verdict = _classify_peak(found, start, profiles.shape[0], rules)
            if verdict == _NO_STRIPE:
                wide[line] |= _is_too_wide(found, start, profiles.shape[0], rules)
                continue
            # `measure_peaks` has searched this window for rivals.
            there = highest[line]
            for near in range(block - MARGIN, block + MARGIN + 1):
                board[near, line] = 0
            if status[line] == _OK:
                # The flank of a wide stripe may have contrast in another block, which leads to the same stripe.
                away = abs(start + found[MIDDLE] - (peaks.start[line] + peaks.middle[line]))
                if away <= peaks.sigma[line] * np.float32(FWHM_PER_SIGMA):
                    continue
                if found[HEIGHT] >= rules.share * peaks.height[line]:
                    status[line], several[line], least[line] = _AMBIGUOUS, True, np.inf
                else:
                    rival[line], of_rival[line] = block, there
                continue
            status[line], several[line] = verdict, several[line] or verdict != _OK
            if verdict != _OK or rules.order != STRONGEST:
                least[line] = np.inf
            else:
                least[line] = max(least[line], np.float32(there) * np.float32(rules.share * _RULE.coarse_slack))
            _store_window(peaks, line, start, found, buffers.cut[k])
    count = 0
    for line in range(status.size):
        if rival[line] >= 0:
            # Too dim to make the line ambiguous, but left in the board for a search of all stripes.
            board[rival[line], line] = of_rival[line]
        if status[line] == _OK:
            _move_window(peaks, line, count)
            count += 1
    return count


@compiled
def _mark_rivals(
    profiles: np.ndarray, left: np.ndarray, lines: np.ndarray, rules: SearchRules, found: np.ndarray
) -> None:
    """Mark the lines with a block of high contrast that is not a spike."""
    for m in range(lines.size):
        for block in range(MARGIN, left.shape[0] - MARGIN):
            there = np.float32(left[block, lines[m]])
            if there >= rules.coarse and not found[m]:
                found[m] = not _is_spike(profiles, lines[m], block, there, rules)


@compiled
def _search_all(
    profiles: np.ndarray,
    board: np.ndarray,
    lines: np.ndarray,
    rules: SearchRules,
    buffers: _Buffers,
    numbers: np.ndarray,
    found: np.ndarray,
    clear: np.ndarray,
    peaks: PeakWindow,
) -> None:
    """Fill `found`, `clear` and the windows of all stripes on the given lines, and their number on each line."""
    most = _RULE.most_stripes
    for _ in range(2 * most):
        _find_highest_blocks(board, buffers.highest, buffers.chosen)
        count = _queue_blocks(profiles, board, lines, rules, buffers)
        if count < 0:
            break
        for number in range(count):
            k = number % LANES
            if k == 0:
                _measure_group(profiles, lines, number, rules, buffers, True)
            m, start, peak = buffers.queue[number], buffers.starts[number], buffers.found[k:]
            verdict = _classify_peak(peak, start, profiles.shape[0], rules)
            if verdict == _NO_STRIPE and not _is_too_wide(peak, start, profiles.shape[0], rules):
                continue
            place, known, slot = start + peak[MIDDLE], False, m * most + numbers[m]
            for j in range(m * most, slot):
                apart = abs(place - (peaks.start[j] + peaks.middle[j]))
                known |= apart <= np.float32(FWHM_PER_SIGMA) * max(peaks.sigma[j], peak[SIGMA])
            if known:
                continue
            found[slot], clear[slot] = lines[m], verdict == _OK
            _store_window(peaks, slot, start, peak, buffers.cut[k])
            numbers[m] += 1
            if numbers[m] == most:
                buffers.least[m] = np.inf
    for m in range(lines.size):
        _ignore_minor(m * most, m * most + numbers[m], rules, found, clear, peaks)


@compiled_part
def _ignore_minor(
    first: int, count: int, rules: SearchRules, found: np.ndarray, clear: np.ndarray, peaks: PeakWindow
) -> None:
    """Set `found` to -1 for stripes that cannot be measured next to a measurable stripe.

    They are ignored if the other stripe is close and at least as high, or at least twice as high. Only stripes that
    might be the line's own matter.
    """
    for k in range(first, count):
        for j in range(first, count):
            apart = abs(peaks.start[j] + peaks.middle[j] - peaks.start[k] - peaks.middle[k])
            share = 1.0 if apart <= rules.half + rules.block else _RULE.minor
            if clear[j] and not clear[k] and peaks.height[k] <= share * peaks.height[j]:
                found[k] = -1


@compiled_part
def _find_highest_blocks(board: np.ndarray, highest: np.ndarray, chosen: np.ndarray) -> None:
    """Find the highest contrast of each line, and the first block of this contrast, on all lines in parallel."""
    for line in range(highest.size):
        highest[line], chosen[line] = board[0, line], 0
    for block in range(1, board.shape[0]):
        blocks, number = board[block], np.uint16(block)
        for line in range(highest.size):
            chosen[line] = number if blocks[line] > highest[line] else chosen[line]
            highest[line] = max(highest[line], blocks[line])


@compiled_part
def _choose_outermost(board: np.ndarray, line: int, least: np.float32, rules: SearchRules) -> int:
    """Return the first or last block of a line, by the rule, with a contrast of at least `least`."""
    step = 1 if rules.order == FIRST else -1
    block = 0 if rules.order == FIRST else board.shape[0] - 1
    while board[block, line] < least:
        block += step
    return block


@compiled_part
def _queue_blocks(
    profiles: np.ndarray, board: np.ndarray, lines: np.ndarray, rules: SearchRules, buffers: _Buffers
) -> int:
    """Fill the queue with the lines (M,) whose chosen block is to be examined, and set its contrast in the board to 0.

    ``highest`` becomes the contrast of the chosen block. Returns the length of the queue, or -1 if no line has a block
    of sufficient contrast left.
    """
    count, ended = 0, True
    for m in range(lines.size):
        if buffers.highest[m] < buffers.least[m] or buffers.highest[m] <= 0:
            continue
        block, ended = int(buffers.chosen[m]), False
        there = board[block, m]
        buffers.highest[m], board[block, m] = there, 0
        if not _is_spike(profiles, lines[m], block, np.float32(there), rules):
            buffers.queue[count], buffers.starts[count] = m, (block - MARGIN) * rules.block - rules.half
            count += 1
    return -1 if ended else count


@compiled_part
def _measure_group(
    profiles: np.ndarray, lines: np.ndarray, number: int, rules: SearchRules, buffers: _Buffers, follow: bool
) -> None:
    """Measure the peaks of a group in the queue, from `number` on; the queue refers to profile lines (M,).

    If a peak is not in the middle, its window and start are moved, unless ``follow`` is False.
    """
    starts, moved = buffers.starts[number:], 1
    for attempt in range(2):
        if attempt == 1:
            moved = 0
            for k in range(LANES if follow else 0):
                offset = _window_offset(buffers.found[k:], buffers.cut.shape[1], rules)
                starts[k] += offset
                moved += offset != 0
        if moved == 0:
            break
        for k in range(LANES):
            cut_window(profiles, lines[buffers.queue[number + k]], starts[k], k, buffers.cut, buffers.inner)
        filter_windows(buffers.pixels, buffers.kernel, buffers.smooth)
        measure_peaks(buffers.rows, starts, profiles.shape[0], rules, buffers.found)


@compiled_inline
def _window_offset(found: np.ndarray, size: int, rules: SearchRules) -> int:
    """Return the shift of a window that does not contain a half-height crossing or a flank of its peak."""
    to_end = np.float32(0.5 * (size - 1))
    offset = found[MIDDLE] - to_end
    outside = abs(offset) + found[REACH] > to_end - WINDOW_RULE.flank + np.float32(0.5)
    if (outside or not found[CLOSED]) and found[HEIGHT] >= rules.fine:
        return int(np.rint(offset))
    return 0


@compiled_part
def _is_too_wide(found: np.ndarray, start: int, count: int, rules: SearchRules) -> bool:
    """Return True for a bright peak inside the image that is too wide to be measured."""
    wide = (not found[CLOSED] or found[SIGMA] > rules.widest) and found[HEIGHT] >= rules.bright
    return bool(wide and _is_inside(start + int(found[TOP]), count))


@compiled_part
def _is_inside(highest: int, count: int) -> bool:
    """Return True unless a maximum is at the border, where it may be any rise towards the border, such as a frame."""
    return 1 < highest < count - 2


@compiled_part
def _store_window(peaks: PeakWindow, number: int, start: int, found: np.ndarray, cut: np.ndarray) -> None:
    """Store a peak and its window at an index."""
    peaks.start[number], peaks.middle[number], peaks.sigma[number] = start, found[MIDDLE], found[SIGMA]
    peaks.reach[number] = found[REACH]
    peaks.base[number], peaks.slope[number], peaks.height[number] = found[BASE], found[SLOPE], found[HEIGHT]
    for k in range(cut.size):
        peaks.window[number, k] = cut[k]


@compiled_inline
def _move_window(peaks: PeakWindow, number: int, to: int) -> None:
    """Move a peak and its window to another index."""
    if number == to:
        return
    peaks.start[to], peaks.middle[to], peaks.sigma[to] = peaks.start[number], peaks.middle[number], peaks.sigma[number]
    peaks.reach[to], peaks.base[to] = peaks.reach[number], peaks.base[number]
    peaks.slope[to], peaks.height[to] = peaks.slope[number], peaks.height[number]
    for k in range(peaks.window.shape[1]):
        peaks.window[to, k] = peaks.window[number, k]


@compiled_part
def _is_spike(profiles: np.ndarray, line: int, block: int, there: np.float32, rules: SearchRules) -> bool:
    """Return True if the contrast `there` of a block is due to noise in single pixels.

    This cheap test avoids a closer examination of most lines without light. The mean of three pixels reduces a stripe
    less than the low-pass, after which it must still be ``fine`` high.
    """
    if there >= _RULE.clear * rules.fine:
        return False
    first, last = (block - MARGIN) * rules.block, profiles.shape[0] - 1
    before, here = np.float32(profiles[max(first - 1, 0), line]), np.float32(profiles[min(first, last), line])
    single, mean = here, np.float32(-np.inf)
    for k in range(first + 1, first + rules.block + 1):
        after = np.float32(profiles[min(k, last), line])
        single, mean = max(single, here), max(mean, before + here + after)
        before, here = here, after
    return there - (single - mean * np.float32(1.0 / 3.0)) < _RULE.spike * rules.fine


@compiled_part
def _classify_peak(found: np.ndarray, start: int, count: int, rules: SearchRules) -> int:
    """Return the status; NO_STRIPE for a peak too low, narrow or wide, or one that rises towards the border."""
    if found[HEIGHT] < rules.fine:
        return _NO_STRIPE
    size, highest = 2 * rules.half + rules.block, start + int(found[TOP])
    if not found[CLOSED]:
        # The far side is outside the image.
        outside = start < 0 or start + size > count
        return _BORDER if outside and _is_inside(highest, count) else _NO_STRIPE
    if not rules.narrowest <= found[SIGMA] <= rules.widest:
        return _NO_STRIPE
    middle, extent = start + found[MIDDLE], found[REACH] + WINDOW_RULE.flank - 1
    if middle - extent < 0 or middle + extent > count - 1:
        return _BORDER
    return _AMBIGUOUS if found[CROWDED] else _OK
