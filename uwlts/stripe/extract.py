"""From an image to one stripe centre per profile line."""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import partial

import cv2
import numpy as np

from uwlts.model.errors import ImageError
from uwlts.stripe import candidates
from uwlts.stripe.candidates import block_contrast, block_extremes, first_true, last_true
from uwlts.stripe.methods import place_centre
from uwlts.stripe.peak_window import FLANK, FWHM_PER_SIGMA, PeakWindow, measure_windows, noise_gain, peak_row
from uwlts.stripe.result import PeakRule, Stripe, StripeOptions, StripeStatus

_LARGEST = {np.dtype(np.uint8): 255.0, np.dtype(np.uint16): 65535.0, np.dtype(np.float32): math.inf}

_LONGEST_SIDE = 32766
"""OpenCV's remap addresses pixels with 16 bits."""

_SHORT_GAP = 2
"""A stripe that is lost for so few lines, as in noise, goes on."""

_LOOKS = 4
"""Places looked at per line: hot pixels in front of the stripe and a second stripe after it."""

_COARSE_SLACK = 0.75
"""Block contrasts of equal stripes differ by this factor through where the pixels fall on them (sigma 0.7 px)."""

_CLEAR = 3.0
"""From this multiple of the least height a block is no mere noise."""

_SPIKE = 0.85
"""Share of the least height below which three pixels' mean is noise; noise may lower that of a stripe a little."""

_BRIGHT = 0.25
"""Height over saturation from which something wide is a stripe rather than haze."""

_MANY = 0.25
"""Lines with a stripe that is too wide, over those with one that is measured, from which a wider window is tried."""

_SEARCHED_BLOCKS = np.array([[-2], [-1], [0], [1], [2]])
"""Blocks that one window covers."""

# NumPy compares with its own integers several times as fast as with an enumeration.
_OK, _NO_STRIPE, _AMBIGUOUS, _BORDER, _SATURATED, _END = (np.uint8(status) for status in StripeStatus)


def extract_stripe(
    image: np.ndarray,
    *,
    stripe_along: str,
    options: StripeOptions = StripeOptions(),
    background: np.ndarray | None = None,
    saturation: float | None = None,
) -> Stripe:
    """Sub-pixel stripe centre on every profile line, of which there are L = H or W.

    Parameters
    ----------
    image : (H, W) uint8, uint16 or float32
        Grey levels. A float32 image is in grey levels too: scale it, or set ``options.threshold_floor``.
    stripe_along : str
        ``"height"``: the stripe runs along the image height, the H rows are the lines. ``"width"``: the W columns are.
    options : StripeOptions, optional
        Method, rules and thresholds.
    background : (H, W) array of the image's type, optional
        The same view with the laser off, subtracted. A linear background is fitted beside each stripe in any case.
    saturation : float, optional
        Grey value at which pixels clip. By default the largest of the integer type, none for float32; 10- or 12-bit
        images in uint16 need it given.

    Raises
    ------
    ImageError
        If the image, the background, `stripe_along` or `saturation` is not as described, or the lines are shorter
        than two search windows, too short to distinguish stripe and background.
    """
    half = options.half_window_px
    _check_image(image, name="image")
    if stripe_along not in ("height", "width"):
        raise ImageError(f'stripe_along is {stripe_along!r}; use "height" (lines are rows) or "width" (columns)')
    if max(image.shape) > _LONGEST_SIDE:
        raise ImageError(f"the image is {image.shape}; each side may have at most {_LONGEST_SIDE} pixels: crop it")
    if (length := image.shape[1 if stripe_along == "height" else 0]) < 4 * half:
        raise ImageError(
            f"the image's lines have {length} pixels; the search needs {4 * half}: lower half_window_px or check "
            "stripe_along"
        )
    if saturation is not None and not 0 < saturation < math.inf:
        raise ImageError(f"saturation is {saturation!r}; expected the positive grey value at which pixels clip")
    clip = _LARGEST[image.dtype] if saturation is None else saturation

    signal = image
    if background is not None:
        _check_image(background, name="background")
        if background.shape != image.shape or background.dtype != image.dtype:
            raise ImageError(
                f"the background is {background.shape} {background.dtype} but the image {image.shape} {image.dtype}; "
                "take both with the same camera settings"
            )
        # The sign is kept.
        signal = cv2.subtract(image, background, dtype=cv2.CV_16S if image.dtype == np.uint8 else cv2.CV_32F)
    if (count := options.smoothing_lines) > 1:
        kernel = (1, count) if stripe_along == "height" else (count, 1)
        signal = cv2.blur(signal.astype(np.float32), kernel, borderType=cv2.BORDER_REPLICATE)
    profiles = _as_profiles(signal, stripe_along=stripe_along)
    found = _found(profiles, options, clip)
    # A wider window is taken only if it measures what was too wide.
    wider, widest = options, min(options.widest_window_px, length // 4)
    while found.too_wide() and 2 * wider.half_window_px <= widest:
        wider = wider.doubled()
        measured = _found(profiles, wider, clip)
        if not measured.too_wide():
            found, options = measured, wider

    none = found.status == _NO_STRIPE
    if none.any():
        raw = profiles if signal is image else _as_profiles(image, stripe_along=stripe_along)
        _, low = block_extremes(raw, options.half_window_px // 2)
        found.status[none & (low.max(axis=0) >= clip)] = _SATURATED
    if options.end_lines:
        good = found.status == _OK
        jump_px = options.half_window_px / 2
        found.discard(_half_lit(good, found.centre, lines=options.end_lines, jump_px=jump_px), _END)
    return Stripe(found.centre, found.amplitude, found.width, found.status, stripe_along)


def _found(profiles: np.ndarray, options: StripeOptions, clip: float) -> _Lines:
    """The stripe on each of the profiles (N, L), sought with one size of window."""
    block = options.half_window_px // 2
    high, low = block_extremes(profiles, block)
    # Two blocks more at either end of the lines, so that what one window covers can be crossed out without a check.
    board = np.zeros((high.shape[0] + 4, high.shape[1]), high.dtype)
    contrast = block_contrast(high, low, out=board[2:-2])
    found = _search(profiles, board, candidates.noise_from_contrast(contrast, block), options, clip)
    # A plateau wider than the window does not even stick out.
    found.wide[low.max(axis=0) >= clip] = True
    return found


@dataclass(frozen=True)
class _Lines:
    """Results (L,) of L lines, filled while the search goes on."""

    centre: np.ndarray
    amplitude: np.ndarray
    width: np.ndarray
    status: np.ndarray
    height: np.ndarray
    wide: np.ndarray
    """Whether something bright was too wide to be measured."""

    @classmethod
    def empty(cls, count: int) -> _Lines:
        amplitude, width, height = np.full((3, count), np.nan, np.float32)
        return cls(
            np.full(count, np.nan), amplitude, width, np.full(count, _NO_STRIPE), height, np.zeros(count, np.bool_)
        )

    def too_wide(self) -> bool:
        """Whether many lines show a stripe that is too wide to be measured."""
        good = self.status == _OK
        return int(np.count_nonzero(self.wide & ~good)) > _MANY * int(np.count_nonzero(good))

    def enter(self, lines: np.ndarray, peak: PeakWindow, method: str) -> None:
        centre, self.amplitude[lines] = place_centre(method, peak)
        self.centre[lines] = peak.start + centre.astype(np.float64)
        self.width[lines] = peak.sigma * FWHM_PER_SIGMA
        self.height[lines] = peak.height

    def discard(self, lines: np.ndarray, status: np.uint8) -> None:
        self.status[lines] = status
        for values in (self.centre, self.amplitude, self.width):
            values[lines] = np.nan


def _search(profiles: np.ndarray, board: np.ndarray, noise: float, options: StripeOptions, clip: float) -> _Lines:
    """Look at the blocks that stick out, in the order of the rule, until each line has its stripe or no block left.

    Under rule `strongest` a line with a stripe is searched once more for a second one. `board` holds the contrasts with
    two blocks more at either end; blocks that are done with are set to 0 in it.
    """
    block = options.half_window_px // 2
    found = _Lines.empty(board.shape[1])
    # 4 standard deviations over the median of the background, so that a stripe of 6 is hardly ever missed.
    coarse = max(options.threshold_floor, noise * (4.0 - candidates.MEDIAN_SURROUNDINGS))
    fine = max(options.threshold_floor, options.threshold_sigmas * noise * noise_gain(options.smoothing_px))
    share = options.ambiguous_ratio * _COARSE_SLACK
    lines = np.arange(board.shape[1])
    least = np.full(lines.size, coarse, np.float32)

    for _ in range(_LOOKS):
        lines, least, chosen, there = _next_blocks(board, lines, least, options.peak, share)
        if lines.size == 0:
            break
        spikes = _spikes(profiles, lines, (chosen - 2) * block, there, block=block, fine=fine)
        passed, passed_least = lines[:0], least[:0]
        if spikes.any():
            board[chosen[spikes], lines[spikes]] = 0
            passed, passed_least = lines[spikes], least[spikes]
            lines, least, chosen, there = (values[~spikes] for values in (lines, least, chosen, there))
            if lines.size == 0:
                lines, least = passed, passed_least
                continue
        peak = _centred_windows(profiles, lines, (chosen - 2) * block, fine, options)
        verdict = _judge(peak, profiles.shape[0], fine, options)
        stripe = verdict != _NO_STRIPE
        if not stripe.all():
            too_wide = ~peak.closed | (peak.sigma > options.half_window_px / FWHM_PER_SIGMA)
            found.wide[lines[too_wide & (peak.height >= max(fine, _BRIGHT * clip))]] = True
        status = found.status[lines]
        again = status == _OK
        new = stripe & ~again
        if again.any():
            # The flank of a wide stripe may stand out in a block of its own and lead back to the same stripe.
            other = np.abs(peak.start + peak.middle - found.centre[lines]) > found.width[lines]
            rival = stripe & again & other & (peak.height >= options.ambiguous_ratio * found.height[lines])
            found.discard(lines[rival], _AMBIGUOUS)
            status[rival] = _AMBIGUOUS
        status = np.where(new, verdict, status)
        found.status[lines] = status
        if (which := new & (verdict == _OK)).any():
            found.enter(lines[which], peak if which.all() else peak.keep(which), options.method)

        # The window has been searched for rivals already; of what is no stripe only the block itself is done with.
        place = chosen * board.shape[1] + lines
        if not stripe.all():
            board.ravel()[place] = 0
            place = place[stripe]
        board.ravel()[place + _SEARCHED_BLOCKS * board.shape[1]] = 0
        least = np.where(new, np.maximum(coarse, there * share), least)
        unsettled = status == _NO_STRIPE
        if options.peak is PeakRule.STRONGEST:
            unsettled |= status == _OK
        if not unsettled.all():
            lines, least = lines[unsettled], least[unsettled]
        if passed.size:
            lines, least = np.concatenate([lines, passed]), np.concatenate([least, passed_least])
    return found


def _spikes(
    profiles: np.ndarray, lines: np.ndarray, place: np.ndarray, there: np.ndarray, *, block: int, fine: float
) -> np.ndarray:
    """Blocks (M,) bool that stick out by noise in single pixels: a cheap look that spares most unlit lines a close one.

    The mean of three pixels lowers a stripe less than the low-pass does, after which it must still be ``fine`` high.
    Blocks that stick out clearly are not asked.
    """
    spikes = np.zeros(lines.size, bool)
    doubtful = np.flatnonzero(there < _CLEAR * fine)
    if doubtful.size:
        rows = place[doubtful] + np.arange(-1, block + 1)[:, None]
        near = profiles[rows.clip(0, profiles.shape[0] - 1), lines[doubtful]].astype(np.float32)
        mean = (near[:-2] + near[1:-1] + near[2:]) / np.float32(3.0)
        lost = near[1:-1].max(axis=0) - mean.max(axis=0)
        spikes[doubtful] = there[doubtful] - lost < _SPIKE * fine
    return spikes


def _next_blocks(
    board: np.ndarray, lines: np.ndarray, least: np.ndarray, rule: PeakRule, share: float
) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """The lines on which a block reaches `least`, their `least`, the block the rule names and its contrast.

    First and last are taken among the blocks with at least `share` of the highest contrast on their line.
    """
    columns = board if lines.size == board.shape[1] else board.take(lines, axis=1)
    highest = columns.max(axis=0)
    stands_out = highest >= least
    if not stands_out.any():
        nothing = np.empty(0, np.intp)
        return nothing, least[:0], nothing, highest[:0]
    if not stands_out.all():
        lines, least, highest = lines[stands_out], least[stands_out], highest[stands_out]
        columns = columns.compress(stands_out, axis=1)
    wanted = columns == highest if rule is PeakRule.STRONGEST else columns >= np.maximum(least, share * highest)
    chosen = first_true(wanted) if rule is not PeakRule.LAST else last_true(wanted)
    there = highest if rule is PeakRule.STRONGEST else columns[chosen, np.arange(lines.size)]
    return lines, least, chosen, there.astype(np.float32)


def _centred_windows(
    profiles: np.ndarray, lines: np.ndarray, place: np.ndarray, fine: float, options: StripeOptions
) -> PeakWindow:
    """`measure_windows`, and a second time where what is seen is not in the middle, as with a wide plateau."""
    measured = partial(
        measure_windows,
        profiles,
        half=options.half_window_px,
        block=options.half_window_px // 2,
        smoothing=options.smoothing_px,
        share=options.ambiguous_ratio,
        whole=options.peak is PeakRule.STRONGEST,
    )
    peak = measured(lines, place)
    # The window follows a peak of which a half-height crossing or a flank lies outside it.
    to_end = 0.5 * (peak.window.shape[0] - 1)
    offset = peak.middle - to_end
    needed = (np.abs(offset) + peak.reach > to_end - FLANK + 0.5) | ~peak.closed
    needed &= peak.height >= fine
    if needed.any():
        shifted = place[needed] + np.rint(offset[needed]).astype(np.intp)
        peak = peak.replaced(needed, measured(lines[needed], shifted))
    return peak


def _judge(peak: PeakWindow, count: int, fine: float, options: StripeOptions) -> np.ndarray:
    """(M,) uint8 `StripeStatus`: NO_STRIPE for what is too low, too narrow or too wide, or rises towards the border."""
    size = peak.window.shape[0]
    narrowest, widest = options.min_fwhm_px / FWHM_PER_SIGMA, options.half_window_px / FWHM_PER_SIGMA
    stripe = peak.closed & (peak.sigma >= narrowest) & (peak.sigma <= widest)
    verdict = np.where(stripe, _OK, _NO_STRIPE)
    if peak.crowded.any():
        verdict[stripe & peak.crowded] = _AMBIGUOUS
    if peak.start.min() < 0 or peak.start.max() + size > count:
        outside = (peak.start < 0) | (peak.start + size > count)
        middle, extent = peak.start + peak.middle, peak.reach + FLANK - 1
        half = options.half_window_px
        highest = peak.start + peak_row(peak.smooth, half=half, block=half // 2)
        verdict[stripe & ((middle - extent < 0) | (middle + extent > count - 1))] = _BORDER
        # A peak whose far side is not in the image; one on the last pixel itself may be any rise towards the border.
        verdict[outside & ~peak.closed & (highest > 1) & (highest < count - 2)] = _BORDER
    verdict[peak.height < fine] = _NO_STRIPE
    return verdict


def _half_lit(good: np.ndarray, centre: np.ndarray, *, lines: int, jump_px: float) -> np.ndarray:
    """Numbers (M,) of the lines with a centre that are among the ``lines`` last before a stripe ends or jumps.

    ``good`` (L,) marks the lines with a centre. A stripe ends where more than a few lines in a row have none, and
    jumps where neighbouring centres lie more than ``jump_px`` apart. The image's own border is no end.
    """
    if good.all() and np.abs(centre[1:] - centre[:-1]).max(initial=0.0) <= jump_px:
        return np.empty(0, np.intp)
    found = np.flatnonzero(good)
    if len(found) == 0:
        return found
    # breaks[k] stands before found[k], the last one after all of them.
    breaks = np.empty(len(found) + 1, bool)
    breaks[1:-1] = (np.diff(found) > _SHORT_GAP + 1) | (np.abs(np.diff(centre[found])) > jump_px)
    breaks[0], breaks[-1] = found[0] > _SHORT_GAP, len(good) - 1 - found[-1] > _SHORT_GAP
    before = np.concatenate([[0], np.cumsum(breaks)])
    place = np.arange(len(found))
    return found[before[np.minimum(place + lines + 1, len(breaks))] > before[np.maximum(place - lines + 1, 0)]]


def _check_image(image: np.ndarray, *, name: str) -> None:
    """ImageError for what is not a two-dimensional, finite uint8, uint16 or float32 array."""
    if not isinstance(image, np.ndarray):
        raise ImageError(f"the {name} is a {type(image).__name__}; expected a NumPy array")
    if image.dtype not in _LARGEST:
        raise ImageError(f"the {name} has type {image.dtype}; convert it to uint8, uint16 or float32")
    if image.ndim != 2:
        raise ImageError(f"the {name} has shape {image.shape}; expected (height, width): choose one channel")
    if image.size == 0:
        raise ImageError(f"the {name} is empty, its shape is {image.shape}")
    if image.dtype == np.float32 and (count := np.count_nonzero(~np.isfinite(image))):
        raise ImageError(f"the {name} has {count} pixels that are not finite; repair or mask them before")


def _as_profiles(image: np.ndarray, *, stripe_along: str) -> np.ndarray:
    """(N, L) contiguous array: position along the line first, so that whole-line steps run over adjacent memory."""
    return cv2.transpose(image) if stripe_along == "height" else np.ascontiguousarray(image)
