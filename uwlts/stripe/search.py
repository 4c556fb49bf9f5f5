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
    LAST,
    STRONGEST,
    WINDOW_RULE,
    Peak,
    PeakWindow,
    SearchRules,
    cut_window,
    filter_window,
    low_pass,
    measure_peak,
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
    """Contrast of a block, in least heights, that may be a second stripe. Noise reaches it on one line in a
    hundred, and the least height on every second line."""
    spike: float = 0.85
    """Least ratio of a stripe's three-pixel mean to the least height; noise may lower the mean a little."""
    bright: float = 0.25
    """Least height of a bright peak, as a fraction of the saturation. A wide peak that is lower is haze."""
    minor: float = 0.5
    """Largest height of an ignored stripe, as a fraction of another stripe's; it cannot be measured itself."""


_RULE = _SearchRule()

_FILLED = 32  # buffers of a window are a multiple of this number of pixels, which fills vector units

MARGIN = 2  # blocks on either side of its own block that a window covers

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

    ``profiles`` (N, L) are the pixels along the L lines. ``board`` (L, B + 2 `MARGIN`) contains the contrasts of the B
    blocks of each line, with zeros at both ends; examined blocks are set to 0.

    Returns the status (L,) of each line; whether a bright peak was too wide (L,); whether the line may contain more
    than one stripe (L,); and the windows of the lines with a stripe, in their order.
    """
    lines = profiles.shape[1]
    peaks = PeakWindow.empty(lines, rules)
    status = np.full(lines, _NO_STRIPE, np.uint8)
    wide, several = np.zeros((2, lines), np.bool_)
    count = _search_lines(profiles, board, _make_buffers(peaks), rules, (status, wide, several), peaks)
    return status, wide, several, peaks.select(slice(count))


class _Buffers(NamedTuple):
    """Low-pass, and buffers for a window with borders and for the filtered window.

    Compiled code takes its arrays as arguments, because Numba compiles longest for arrays made in compiled code.
    """

    kernel: np.ndarray
    pixels: np.ndarray
    smooth: np.ndarray


def _make_buffers(peaks: PeakWindow) -> _Buffers:
    kernel, size = low_pass(peaks.smoothing), -(-peaks.window.shape[1] // _FILLED) * _FILLED
    return _Buffers(kernel, np.zeros(size + kernel.size - 1, np.float32), np.empty(size, np.float32))


def search_all(
    profiles: np.ndarray, board: np.ndarray, lines: np.ndarray, rules: SearchRules, *, fewest: int = 1
) -> tuple[np.ndarray, np.ndarray, PeakWindow]:
    """Find all stripes on lines (M,) that contain at least ``fewest`` stripes.

    Returns the line of each stripe, whether it can be measured, and its window, in the order of the lines. ``board``
    (M, B + 2 `MARGIN`) contains the contrasts on these lines; for other parameters see `search_profiles`.

    A stripe cannot be measured if another one overlaps its pixels, if it is bright and too wide, or if it is cut off by
    the border.
    """
    rules, most = rules._replace(order=FIRST), _RULE.most_stripes * len(lines)
    peaks, found, clear = PeakWindow.empty(most, rules), np.empty(most, np.intp), np.empty(most, np.bool_)
    count = _search_all(profiles, board, lines, _make_buffers(peaks), rules, found, clear, peaks)
    kept = np.flatnonzero(found[:count] >= 0)
    if fewest > 1:
        kept = kept[np.bincount(found[kept])[found[kept]] >= fewest]
    if not kept.size:
        return found[:0], clear[:0], peaks.select(slice(0))
    return found[kept], clear[kept], peaks.select(kept)


def mark_rivals(
    profiles: np.ndarray, left: np.ndarray, lines: np.ndarray, rules: SearchRules, found: np.ndarray
) -> None:
    """Mark the profile lines ``lines`` (M,) in ``found`` (M,) that have a block of high contrast left.

    ``left`` (L, B + 2 `MARGIN`) contains the contrasts of the remaining blocks of all lines of the profiles (N, L);
    spikes are ignored. Lines that are marked already are not examined.
    """
    _mark_rivals(profiles, left, lines, np.empty(rules.block + 2, np.float32), rules, found)


@compiled
def _search_lines(
    profiles: np.ndarray,
    board: np.ndarray,
    buffers: _Buffers,
    rules: SearchRules,
    marks: tuple[np.ndarray, np.ndarray, np.ndarray],
    peaks: PeakWindow,
) -> int:
    """Fill status, wide, several (``marks``) and the windows; return the number of lines with a stripe."""
    status, wide, several = marks
    # Not a literal, which Numba would compile further specialisations for.
    size, border, count = peaks.window.shape[1], buffers.kernel.size // 2, int(np.intp(0))
    window = buffers.pixels[border : border + size]
    near = window[rules.half - 1 : rules.half + rules.block + 1]
    for line in range(profiles.shape[1]):
        blocks, least, rival, of_rival = board[line], np.float32(rules.coarse), np.intp(-1), np.float32(0.0)
        for _ in range(_RULE.looks):
            highest = _find_highest_block(blocks)
            if status[line] == _OK and highest >= _RULE.rival * rules.coarse:
                several[line] = True
            chosen = _choose_block(blocks, highest, least, rules)
            if chosen < 0:
                break
            there = np.float32(blocks[chosen])
            blocks[chosen] = 0
            if _is_spike(profiles, line, chosen, there, near, rules):
                continue
            start = (chosen - MARGIN) * rules.block - rules.half
            start, peak = _follow_peak(profiles, line, start, buffers, window, rules)
            verdict = _classify_peak(peak, start, profiles.shape[0], rules)
            if verdict == _NO_STRIPE:
                wide[line] |= _is_too_wide(peak, start, profiles.shape[0], rules)
                continue
            # `measure_peak` has searched this window for rivals.
            blocks[chosen - MARGIN : chosen + MARGIN + 1] = 0
            if status[line] == _OK:
                # The flank of a wide stripe may have contrast in another block, which leads to the same stripe.
                distance = abs(start + peak.middle - (peaks.start[count] + peaks.middle[count]))
                if distance <= peaks.sigma[count] * np.float32(FWHM_PER_SIGMA):
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
            _store_window(peaks, count, start, peak, window)
            if rules.order != STRONGEST:
                break
            least = max(least, there * np.float32(rules.share * _RULE.coarse_slack))
        if status[line] == _OK:
            count += 1
        if rival >= 0:
            # Too dim to make the line ambiguous, but left in the board for a search of all stripes.
            blocks[rival] = of_rival
    return count


@compiled
def _mark_rivals(
    profiles: np.ndarray, left: np.ndarray, lines: np.ndarray, near: np.ndarray, rules: SearchRules, found: np.ndarray
) -> None:
    """Mark the lines with a block of high contrast that is not a spike."""
    for m in range(lines.size):
        blocks = left[lines[m]]
        for k in range(MARGIN, blocks.size - MARGIN):
            if blocks[k] >= rules.coarse and not found[m]:
                found[m] = not _is_spike(profiles, lines[m], k, np.float32(blocks[k]), near, rules)


@compiled
def _search_all(
    profiles: np.ndarray,
    board: np.ndarray,
    lines: np.ndarray,
    buffers: _Buffers,
    rules: SearchRules,
    found: np.ndarray,
    clear: np.ndarray,
    peaks: PeakWindow,
) -> int:
    """Fill `found`, `clear` and the windows of all stripes on the given lines; return the number of stripes."""
    # Not a literal, which Numba would compile further specialisations for.
    size, border, count = peaks.window.shape[1], buffers.kernel.size // 2, int(np.intp(0))
    window = buffers.pixels[border : border + size]
    near = window[rules.half - 1 : rules.half + rules.block + 1]
    for m in range(lines.size):
        line, blocks, first = lines[m], board[m], count
        for _ in range(2 * _RULE.most_stripes):
            there = _find_highest_block(blocks)
            if there < rules.coarse or there <= 0 or count == first + _RULE.most_stripes:
                break
            chosen = _find_first_equal(blocks, there)
            blocks[chosen] = 0
            if _is_spike(profiles, line, chosen, np.float32(there), near, rules):
                continue
            start = (chosen - MARGIN) * rules.block - rules.half
            start, peak = _follow_peak(profiles, line, start, buffers, window, rules)
            verdict = _classify_peak(peak, start, profiles.shape[0], rules)
            if verdict == _NO_STRIPE and not _is_too_wide(peak, start, profiles.shape[0], rules):
                continue
            place, known = start + peak.middle, False
            for k in range(first, count):
                distance = abs(place - (peaks.start[k] + peaks.middle[k]))
                known |= distance <= np.float32(FWHM_PER_SIGMA) * max(peaks.sigma[k], peak.sigma)
            if known:
                continue
            found[count], clear[count] = line, verdict == _OK
            _store_window(peaks, count, start, peak, window)
            count += 1
        _ignore_minor(first, count, rules, found, clear, peaks)
    return count


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
            distance = abs(peaks.start[j] + peaks.middle[j] - peaks.start[k] - peaks.middle[k])
            share = 1.0 if distance <= rules.half + rules.block else _RULE.minor
            if clear[j] and not clear[k] and peaks.height[k] <= share * peaks.height[j]:
                found[k] = -1


@compiled_inline
def _follow_peak(
    profiles: np.ndarray, line: int, start: int, buffers: _Buffers, window: np.ndarray, rules: SearchRules
) -> tuple[int, Peak]:
    """Measure the peak in the window at `start`, moved to the peak if necessary; return its start and the peak.

    ``window`` contains the pixels without their borders.
    """
    kernel, pixels, smooth = buffers
    offset = 0
    while True:
        cut_window(profiles, line, start + offset, window)
        filter_window(pixels, window.size, kernel, smooth)
        peak = measure_peak(smooth[: window.size], start + offset, profiles.shape[0], rules)
        if offset != 0:
            break
        offset = _find_offset(peak, window.size, rules)
        if offset == 0:
            break
    return start + offset, peak


@compiled_inline
def _find_offset(peak: Peak, size: int, rules: SearchRules) -> int:
    """Return the shift of a window that does not contain a half-height crossing or a flank of its peak."""
    to_end = np.float32(0.5 * (size - 1))
    offset = peak.middle - to_end
    outside = abs(offset) + peak.reach > to_end - WINDOW_RULE.flank + np.float32(0.5)
    return int(np.rint(offset)) if (outside or not peak.closed) and peak.height >= rules.fine else 0


@compiled_inline
def _is_too_wide(peak: Peak, start: int, count: int, rules: SearchRules) -> bool:
    """Return True for a bright peak inside the image that is too wide to be measured."""
    wide = (not peak.closed or peak.sigma > rules.widest) and peak.height >= rules.bright
    return bool(wide and _is_inside(start + peak.top, count))


@compiled_part
def _is_inside(highest: int, count: int) -> bool:
    """Return True unless a maximum is at the border, where it may be any rise towards the border, such as a frame."""
    return 1 < highest < count - 2


@compiled_inline
def _store_window(peaks: PeakWindow, number: int, start: int, peak: Peak, window: np.ndarray) -> None:
    """Store a peak and its window at an index."""
    peaks.start[number], peaks.middle[number], peaks.sigma[number] = start, peak.middle, peak.sigma
    peaks.reach[number] = peak.reach
    peaks.base[number], peaks.slope[number], peaks.height[number] = peak.base, peak.slope, peak.height
    for k in range(window.size):
        peaks.window[number, k] = window[k]


@compiled_part
def _find_highest_block(blocks: np.ndarray) -> np.number:
    """Return the highest contrast of a line's blocks."""
    highest = blocks[0]
    for k in range(blocks.size):
        highest = max(highest, blocks[k])
    return highest


@compiled_part
def _find_first_equal(blocks: np.ndarray, height: np.number) -> int:
    """Return the first block of a given height. All blocks are compared, which is faster in vector units."""
    chosen = np.int32(blocks.size)
    for k in range(np.int32(blocks.size)):
        chosen = min(chosen, np.int32(k) if blocks[k] == height else np.int32(blocks.size))
    return int(chosen)


@compiled_part
def _choose_block(blocks: np.ndarray, highest: np.number, least: np.float32, rules: SearchRules) -> int:
    """Return the next block by the rule among those of at least `least` contrast; -1 without such blocks.

    First and last are chosen among the blocks whose contrast is a sufficient fraction of the highest one on their line.
    """
    if highest < least or highest <= 0:
        return -1
    if rules.order == STRONGEST:
        return _find_first_equal(blocks, highest)
    wanted = max(least, np.float32(highest) * np.float32(rules.share * _RULE.coarse_slack))
    chosen = 0 if rules.order == FIRST else blocks.size - 1
    while blocks[chosen] < wanted:
        chosen += 1 if rules.order == FIRST else -1
    return chosen


@compiled_part
def _is_spike(
    profiles: np.ndarray, line: int, block: int, there: np.float32, near: np.ndarray, rules: SearchRules
) -> bool:
    """Return True if the contrast ``there`` of a block is due to noise in single pixels.

    This cheap test avoids a closer examination of most lines without light. ``near`` has room for the pixels of the
    block and one on either side. The mean of three pixels reduces a stripe less than the low-pass, after which it must
    still be ``rules.fine`` high.
    """
    if there >= _RULE.clear * rules.fine:
        return False
    cut_window(profiles, line, (block - MARGIN) * rules.block - 1, near)
    single, mean = near[1], np.float32(-np.inf)
    for k in range(1, near.size - 1):
        single = max(single, near[k])
        mean = max(mean, near[k - 1] + near[k] + near[k + 1])
    return there - (single - mean * np.float32(1.0 / 3.0)) < _RULE.spike * rules.fine


@compiled_part
def _classify_peak(peak: Peak, start: int, count: int, rules: SearchRules) -> int:
    """Return the status; NO_STRIPE for a peak too low, narrow or wide, or one that rises towards the border."""
    if peak.height < rules.fine:
        return _NO_STRIPE
    size, highest = 2 * rules.half + rules.block, start + peak.top
    if not peak.closed:
        # The far side is outside the image.
        outside = start < 0 or start + size > count
        return _BORDER if outside and _is_inside(highest, count) else _NO_STRIPE
    if not rules.narrowest <= peak.sigma <= rules.widest:
        return _NO_STRIPE
    middle, extent = start + peak.middle, peak.reach + WINDOW_RULE.flank - 1
    if middle - extent < 0 or middle + extent > count - 1:
        return _BORDER
    return _AMBIGUOUS if peak.crowded else _OK
