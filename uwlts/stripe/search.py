"""Search of each profile line for its stripe: blocks that stick out are looked at closely, one after another."""

from __future__ import annotations

import numpy as np

from uwlts.model.stripe import StripeStatus
from uwlts.runtime.compiled import compiled, compiled_inline, compiled_part
from uwlts.stripe.options import PeakRule, StripeOptions
from uwlts.stripe.peak_window import (
    FIRST,
    FLANK,
    FWHM_PER_SIGMA,
    LAST,
    STRONGEST,
    Peak,
    PeakWindow,
    SearchRules,
    cut,
    filtered,
    low_pass,
    measured,
)

_LOOKS = 4
"""Places looked at per line: hot pixels in front of the stripe and a second stripe after it."""

_MOST = 6
"""Most stripes on one line: two sheets, each with two reflections."""

_COARSE_SLACK = 0.75
"""Block contrasts of equal stripes differ by this factor through where the pixels fall on them (sigma 0.7 px)."""

_CLEAR = 3.0
"""From this multiple of the least height a block is no mere noise."""

_RIVAL = 1.3
"""From this multiple of the least height a block may be a second stripe: noise alone gets there on one line in a
hundred, and to the least height on every second one."""

_SPIKE = 0.85
"""Share of the least height below which three pixels' mean is noise; noise may lower that of a stripe a little."""

_BRIGHT = 0.25
"""Height over saturation from which something wide is a stripe rather than haze."""

_MINOR = 0.5
"""Share of another stripe's height up to which one that cannot be measured is left out."""

MARGIN = 2
"""Blocks on either side of a block's own that one window covers."""

_OK, _NO_STRIPE = int(StripeStatus.OK), int(StripeStatus.NO_STRIPE)
_AMBIGUOUS, _BORDER = int(StripeStatus.AMBIGUOUS), int(StripeStatus.BORDER)
_ORDER = {PeakRule.DIRECT: STRONGEST, PeakRule.STRONGEST: STRONGEST, PeakRule.FIRST: FIRST, PeakRule.LAST: LAST}


def search_rules(options: StripeOptions, *, coarse: float, fine: float, clip: float) -> SearchRules:
    """Rules of the search; blocks lower than ``coarse`` and peaks lower than ``fine`` are noise, and pixels clip."""
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
        bright=max(fine, _BRIGHT * clip),
    )


def search(
    profiles: np.ndarray, board: np.ndarray, rules: SearchRules
) -> tuple[np.ndarray, np.ndarray, np.ndarray, PeakWindow]:
    """Look at the blocks that stick out, in the order of the rule, until each line has its stripe or no block left.

    ``board`` (L, B + 2 `MARGIN`) holds the contrasts of the B blocks of each of the profiles (N, L), and zeros at
    either end; blocks that are done with are set to 0 in it. Under rule `strongest` a line with a stripe is searched
    once more for a second one.

    Returns the status (L,) of each line, whether something bright was too wide to be measured (L,), whether more may
    stand on it than one stripe (L,), and the windows of the lines with a stripe, in their order.
    """
    lines = profiles.shape[1]
    peaks = _windows(lines, rules)
    status = np.full(lines, _NO_STRIPE, np.uint8)
    wide, several = np.zeros((2, lines), np.bool_)
    count = _search_lines(profiles, board, *_room(peaks), rules, status, wide, several, peaks)
    return status, wide, several, peaks.first(count)


def _windows(count: int, rules: SearchRules) -> PeakWindow:
    """Room for so many windows."""
    return PeakWindow.empty(count, 2 * rules.half + rules.block, rules.smoothing)


def _room(peaks: PeakWindow) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """The low-pass, and room for the pixels of a window with its borders and for the window after the low-pass.

    Numba compiles longest for arrays that compiled code makes itself.
    """
    kernel, size = low_pass(peaks.smoothing), peaks.window.shape[1]
    return kernel, np.empty(size + kernel.size - 1, np.float32), np.empty(size, np.float32)


def search_all(
    profiles: np.ndarray, board: np.ndarray, lines: np.ndarray, rules: SearchRules, *, fewest: int = 1
) -> tuple[np.ndarray, np.ndarray, PeakWindow]:
    """All stripes on those of some lines (M,) that hold the ``fewest`` or more.

    The line of each, in their order, whether it can be measured, and its window.

    ``board`` (M, B + 2 `MARGIN`) are the contrasts on these lines, else as of `search`. Two stripes of which one
    reaches into the other's pixels cannot be measured, nor one that is bright and too wide, or cut off by the border.
    """
    rules, most = rules._replace(order=FIRST), _MOST * len(lines)
    peaks, found, clear = _windows(most, rules), np.empty(most, np.intp), np.empty(most, np.bool_)
    count = _search_all(profiles, board, lines, *_room(peaks), rules, found, clear, peaks)
    kept = np.flatnonzero(found[:count] >= 0)
    if fewest > 1:
        kept = kept[np.bincount(found[kept])[found[kept]] >= fewest]
    if not kept.size:
        return found[:0], clear[:0], peaks.first(0)
    return found[kept], clear[kept], peaks.keep(kept)


def with_rivals(
    profiles: np.ndarray, left: np.ndarray, lines: np.ndarray, known: np.ndarray, rules: SearchRules
) -> np.ndarray:
    """Mask (M,) of the lines on which something stands out in the board ``left`` by `search` that is no spike.

    Lines that are ``known`` (M,) to have it are not searched.
    """
    found = known.copy()
    _see_rivals(profiles, left, lines, np.empty(rules.block + 2, np.float32), rules, found)
    return found


def look_at(profiles: np.ndarray, lines: np.ndarray, centre: np.ndarray, options: StripeOptions) -> PeakWindow:
    """Windows about stripes whose centres (M,) on M lines of the profiles (N, L) are known from elsewhere.

    Their height is 0 where nothing stands out there.
    """
    rules = search_rules(options, coarse=0.0, fine=0.0, clip=np.inf)
    peaks = _windows(len(lines), rules)
    peaks.start[:] = np.rint(centre).astype(np.intp) - rules.half - rules.block // 2
    _look_at_lines(profiles, lines, *_room(peaks), rules, peaks)
    return peaks


@compiled
def _look_at_lines(
    profiles: np.ndarray,
    lines: np.ndarray,
    kernel: np.ndarray,
    pixels: np.ndarray,
    smooth: np.ndarray,
    rules: SearchRules,
    peaks: PeakWindow,
) -> None:
    """Fill the windows that begin at ``peaks.start``."""
    size, border = smooth.size, kernel.size // 2
    for m in range(lines.size):
        window = pixels[border : border + size]
        cut(profiles, lines[m], peaks.start[m], window)
        filtered(pixels, kernel, smooth)
        peak = measured(smooth, peaks.start[m], profiles.shape[0], rules)
        peaks.middle[m], peaks.sigma[m], peaks.reach[m] = peak.middle, peak.sigma, peak.reach
        peaks.base[m], peaks.slope[m] = peak.base, peak.slope
        peaks.height[m] = peak.height if peak.closed else np.float32(0.0)
        for k in range(size):
            peaks.window[m, k] = window[k]


@compiled
def _search_lines(
    profiles: np.ndarray,
    board: np.ndarray,
    kernel: np.ndarray,
    pixels: np.ndarray,
    smooth: np.ndarray,
    rules: SearchRules,
    status: np.ndarray,
    wide: np.ndarray,
    several: np.ndarray,
    peaks: PeakWindow,
) -> int:
    """Fill `status`, `wide`, `several` and the windows of the lines with a stripe; returns how many there are."""
    # A number that is no literal, for which functions would be compiled once more.
    size, border, count = smooth.size, kernel.size // 2, int(np.intp(0))
    window = pixels[border : border + size]
    near = window[rules.half - 1 : rules.half + rules.block + 1]
    for line in range(profiles.shape[1]):
        blocks, least, rival, of_rival = board[line], np.float32(rules.coarse), np.intp(-1), np.float32(0.0)
        for _ in range(_LOOKS):
            highest = _greatest_block(blocks)
            if status[line] == _OK and highest >= _RIVAL * rules.coarse:
                several[line] = True
            chosen = _next_block(blocks, highest, least, rules)
            if chosen < 0:
                break
            there = np.float32(blocks[chosen])
            blocks[chosen] = 0
            start = (chosen - MARGIN) * rules.block - rules.half
            if there < _CLEAR * rules.fine:
                cut(profiles, line, start + rules.half - 1, near)
                if _is_spike(near, there, rules.fine):
                    continue
            start, peak = _followed(profiles, line, start, kernel, pixels, window, smooth, rules)
            verdict = _judged(peak, start, profiles.shape[0], rules)
            if verdict == _NO_STRIPE:
                wide[line] |= _is_too_wide(peak, rules)
                continue
            # The window has been searched for rivals already.
            for k in range(chosen - MARGIN, chosen + MARGIN + 1):
                blocks[k] = 0
            if status[line] == _OK:
                # The flank of a wide stripe may stand out in a block of its own and lead back to the same stripe.
                away = abs(start + peak.middle - (peaks.start[count] + peaks.middle[count]))
                if away <= peaks.sigma[count] * np.float32(FWHM_PER_SIGMA):
                    continue
                if peak.height >= rules.share * peaks.height[count]:
                    status[line] = _AMBIGUOUS
                    several[line] = True
                    break
                rival, of_rival = chosen, there
                continue
            status[line] = verdict
            if verdict != _OK:
                several[line] = True
                break
            _keep(peaks, count, start, peak, window)
            if rules.order != STRONGEST:
                break
            least = max(least, there * np.float32(rules.share * _COARSE_SLACK))
        if status[line] == _OK:
            count += 1
        if rival >= 0:
            # Too dim to make the line ambiguous; whoever looks for all stripes finds it in the board.
            blocks[rival] = of_rival
    return count


@compiled
def _see_rivals(
    profiles: np.ndarray, left: np.ndarray, lines: np.ndarray, near: np.ndarray, rules: SearchRules, found: np.ndarray
) -> None:
    """Mark the lines on which a block stands out that is no spike."""
    for m in range(lines.size):
        blocks = left[lines[m]]
        for k in range(MARGIN, blocks.size - MARGIN):
            if blocks[k] >= rules.coarse and not found[m]:
                cut(profiles, lines[m], (k - MARGIN) * rules.block - 1, near)
                there = np.float32(blocks[k])
                found[m] = there >= _CLEAR * rules.fine or not _is_spike(near, there, rules.fine)


@compiled
def _search_all(
    profiles: np.ndarray,
    board: np.ndarray,
    lines: np.ndarray,
    kernel: np.ndarray,
    pixels: np.ndarray,
    smooth: np.ndarray,
    rules: SearchRules,
    found: np.ndarray,
    clear: np.ndarray,
    peaks: PeakWindow,
) -> int:
    """Fill `found`, `clear` and the windows of all stripes on some lines; returns how many there are."""
    # A number that is no literal, for which functions would be compiled once more.
    size, border, count = smooth.size, kernel.size // 2, int(np.intp(0))
    window = pixels[border : border + size]
    near = window[rules.half - 1 : rules.half + rules.block + 1]
    for m in range(lines.size):
        line, blocks, first = lines[m], board[m], count
        for _ in range(2 * _MOST):
            there = _greatest_block(blocks)
            if there < rules.coarse or there <= 0 or count == first + _MOST:
                break
            chosen = _first_equal(blocks, there)
            blocks[chosen] = 0
            start = (chosen - MARGIN) * rules.block - rules.half
            if there < _CLEAR * rules.fine:
                cut(profiles, line, start + rules.half - 1, near)
                if _is_spike(near, np.float32(there), rules.fine):
                    continue
            start, peak = _followed(profiles, line, start, kernel, pixels, window, smooth, rules)
            verdict = _judged(peak, start, profiles.shape[0], rules)
            if verdict == _NO_STRIPE and not _is_too_wide(peak, rules):
                continue
            place, known = start + peak.middle, False
            for k in range(first, count):
                apart = abs(place - (peaks.start[k] + peaks.middle[k]))
                known |= apart <= np.float32(FWHM_PER_SIGMA) * max(peaks.sigma[k], peak.sigma)
            if known:
                continue
            found[count], clear[count] = line, verdict == _OK
            _keep(peaks, count, start, peak, window)
            count += 1
        _leave_minor_out(first, count, rules, found, clear, peaks)
    return count


@compiled_part
def _leave_minor_out(
    first: int, count: int, rules: SearchRules, found: np.ndarray, clear: np.ndarray, peaks: PeakWindow
) -> None:
    """Set `found` to -1 for those of a line that cannot be measured beside a much higher one that can, or in its light.

    Of what cannot be measured only stripes that might be the line's own matter.
    """
    for k in range(first, count):
        for j in range(first, count):
            apart = abs(peaks.start[j] + peaks.middle[j] - peaks.start[k] - peaks.middle[k])
            share = 1.0 if apart <= rules.half + rules.block else _MINOR
            if clear[j] and not clear[k] and peaks.height[k] <= share * peaks.height[j]:
                found[k] = -1


@compiled_inline
def _followed(
    profiles: np.ndarray,
    line: int,
    start: int,
    kernel: np.ndarray,
    pixels: np.ndarray,
    window: np.ndarray,
    smooth: np.ndarray,
    rules: SearchRules,
) -> tuple[int, Peak]:
    """What stands in the window that begins at `start`, moved with its pixels to the peak, and its beginning.

    ``window`` are the pixels without their borders.
    """
    offset = 0
    while True:
        cut(profiles, line, start + offset, window)
        filtered(pixels, kernel, smooth)
        peak = measured(smooth, start + offset, profiles.shape[0], rules)
        if offset != 0:
            break
        offset = _offset(peak, smooth.size, rules)
        if offset == 0:
            break
    return start + offset, peak


@compiled_inline
def _offset(peak: Peak, size: int, rules: SearchRules) -> int:
    """How far a window is to follow a peak of which a half-height crossing or a flank lies outside it."""
    to_end = np.float32(0.5 * (size - 1))
    offset = peak.middle - to_end
    outside = abs(offset) + peak.reach > to_end - FLANK + np.float32(0.5)
    if (outside or not peak.closed) and peak.height >= rules.fine:
        return int(np.rint(offset))
    return 0


@compiled_inline
def _is_too_wide(peak: Peak, rules: SearchRules) -> bool:
    """Whether what is no stripe is a bright one all the same that is too wide to be measured."""
    return bool((not peak.closed or peak.sigma > rules.widest) and peak.height >= rules.bright)


@compiled_inline
def _keep(peaks: PeakWindow, number: int, start: int, peak: Peak, window: np.ndarray) -> None:
    """Keep a peak and its window under a number."""
    peaks.start[number], peaks.middle[number], peaks.sigma[number] = start, peak.middle, peak.sigma
    peaks.reach[number] = peak.reach
    peaks.base[number], peaks.slope[number], peaks.height[number] = peak.base, peak.slope, peak.height
    for k in range(window.size):
        peaks.window[number, k] = window[k]


@compiled_part
def _greatest_block(blocks: np.ndarray) -> np.number:
    """The highest contrast of a line's blocks."""
    highest = blocks[0]
    for k in range(blocks.size):
        highest = max(highest, blocks[k])
    return highest


@compiled_part
def _first_equal(blocks: np.ndarray, height: np.number) -> int:
    """The first block of a height that one has. All are looked at, many at a time: faster than to stop at the first."""
    chosen = np.int32(blocks.size)
    for k in range(np.int32(blocks.size)):
        chosen = min(chosen, np.int32(k) if blocks[k] == height else np.int32(blocks.size))
    return int(chosen)


@compiled_part
def _next_block(blocks: np.ndarray, highest: np.number, least: np.float32, rules: SearchRules) -> int:
    """The block that the rule names among those that reach `least`; -1 where none does.

    First and last are taken among the blocks with a share of the highest contrast on their line.
    """
    if highest < least or highest <= 0:
        return -1
    if rules.order == STRONGEST:
        return _first_equal(blocks, highest)
    chosen = 0
    wanted = max(least, np.float32(highest) * np.float32(rules.share * _COARSE_SLACK))
    if rules.order == FIRST:
        while blocks[chosen] < wanted:
            chosen += 1
        return chosen
    chosen = blocks.size - 1
    while blocks[chosen] < wanted:
        chosen -= 1
    return chosen


@compiled_part
def _is_spike(near: np.ndarray, there: np.float32, fine: float) -> bool:
    """Whether a block sticks out by noise in single pixels: a cheap look that spares most unlit lines a close one.

    ``near`` are the pixels of the block and one on either side. The mean of three pixels lowers a stripe less than the
    low-pass does, after which it must still be ``fine`` high.
    """
    single, mean = near[1], np.float32(-np.inf)
    for k in range(1, near.size - 1):
        single = max(single, near[k])
        mean = max(mean, near[k - 1] + near[k] + near[k + 1])
    return there - (single - mean * np.float32(1.0 / 3.0)) < _SPIKE * fine


@compiled_part
def _judged(peak: Peak, start: int, count: int, rules: SearchRules) -> int:
    """`StripeStatus`: NO_STRIPE for what is too low, too narrow or too wide, or rises towards the border."""
    if peak.height < rules.fine:
        return _NO_STRIPE
    size, highest = 2 * rules.half + rules.block, start + peak.top
    if not peak.closed:
        # A peak whose far side is not in the image; one on the last pixel itself may be any rise towards the border.
        outside = start < 0 or start + size > count
        return _BORDER if outside and 1 < highest < count - 2 else _NO_STRIPE
    if not rules.narrowest <= peak.sigma <= rules.widest:
        return _NO_STRIPE
    middle, extent = start + peak.middle, peak.reach + FLANK - 1
    if middle - extent < 0 or middle + extent > count - 1:
        return _BORDER
    return _AMBIGUOUS if peak.crowded else _OK
