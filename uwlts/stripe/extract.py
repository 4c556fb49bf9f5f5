"""From an image to one stripe centre per profile line."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import cv2
import numpy as np

from uwlts.model.errors import ImageError
from uwlts.model.stripe import Stripe, StripeStatus
from uwlts.stripe.candidates import MEDIAN_SURROUNDINGS, block_contrast, block_extremes, noise_from_contrast
from uwlts.stripe.learned import find_learned
from uwlts.stripe.methods import amplitudes, place_centre
from uwlts.stripe.peak_window import FWHM_PER_SIGMA, noise_gain
from uwlts.stripe.result import LEARNED, StripeOptions
from uwlts.stripe.search import MARGIN, look_at, search

_LARGEST = {np.dtype(np.uint8): 255.0, np.dtype(np.uint16): 65535.0, np.dtype(np.float32): math.inf}

_SHORT_GAP = 2
"""A stripe that is lost for so few lines, as in noise, goes on."""

_MANY = 0.25
"""Lines with a stripe that is too wide, over those with one that is measured, from which a wider window is tried."""

# NumPy compares with its own integers several times as fast as with an enumeration.
_OK, _NO_STRIPE, _AMBIGUOUS, _SATURATED, _END = (
    np.uint8(StripeStatus[name]) for name in ("OK", "NO_STRIPE", "AMBIGUOUS", "SATURATED", "END")
)


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
        white = found.white
        if signal is not image:
            _, low = block_extremes(_as_profiles(image, stripe_along=stripe_along), options.half_window_px // 2)
            white = low.max(axis=0) >= clip
        found.status[none & white] = _SATURATED
    if options.end_lines:
        good = found.status == _OK
        jump_px = options.half_window_px / 2
        found.discard(_half_lit(good, found.centre, lines=options.end_lines, jump_px=jump_px), _END)
    return Stripe(found.centre, found.amplitude, found.width, found.status, stripe_along)


def stripe_in(
    seen: np.ndarray | Stripe, *, stripe_along: str, options: StripeOptions = StripeOptions(), saturation: float | None
) -> Stripe:
    """The stripe of what a camera saw: that of an image as by `extract_stripe`, that of a 3D camera as it is."""
    if isinstance(seen, Stripe):
        return seen
    return extract_stripe(seen, stripe_along=stripe_along, options=options, saturation=saturation)


def warm_up(dtype: np.dtype | type = np.uint8, options: StripeOptions = StripeOptions()) -> None:
    """Load what extraction from images of a type needs, or compile it where that was never done on this machine.

    Otherwise the first image of a stream waits for it: some tenths of a second, and some seconds once.
    """
    half = options.half_window_px
    profile = 100.0 * np.exp(-0.5 * np.square((np.arange(4 * half) - 2 * half) / 2.0))
    lines = np.tile(profile, (16, 1)).astype(dtype)
    for method in (options.method, "quadratic"):
        extract_stripe(lines, stripe_along="height", options=replace(options, method=method))


def _found_by_model(profiles: np.ndarray, options: StripeOptions, clip: float) -> _Lines:
    """The stripe on each of the profiles (N, L) as a trained network sees it; height and width are measured there."""
    status, centre = find_learned(profiles, options.model, clip=clip)
    lines = np.flatnonzero(status == _OK)
    peak = look_at(profiles, lines, centre[lines], options)
    amplitude, width = np.full((2, len(status)), np.nan, np.float32)
    amplitude[lines] = amplitudes(peak, (centre[lines] - peak.start).astype(np.float32))
    width[lines] = peak.sigma * FWHM_PER_SIGMA
    nothing = np.zeros(len(status), bool)
    found = _Lines(centre, amplitude, width, status, nothing, nothing)
    found.discard(lines[~((peak.height > 0) & (amplitude[lines] > 0))], _AMBIGUOUS)
    return found


def _found(profiles: np.ndarray, options: StripeOptions, clip: float) -> _Lines:
    """The stripe on each of the profiles (N, L), sought with one size of window."""
    if options.method == LEARNED:
        return _found_by_model(profiles, options, clip if math.isfinite(clip) else max(float(profiles.max()), 1.0))
    block = options.half_window_px // 2
    high, low = block_extremes(profiles, block)
    # Blocks more at either end of the lines, so that what one window covers can be crossed out without a check.
    board = np.zeros((high.shape[0] + 2 * MARGIN, high.shape[1]), high.dtype)
    contrast = block_contrast(high, low, out=board[MARGIN:-MARGIN])
    noise = noise_from_contrast(contrast, block)
    # 4 standard deviations over the median of the background, so that a stripe of 6 is hardly ever missed.
    coarse = max(options.threshold_floor, noise * (4.0 - MEDIAN_SURROUNDINGS))
    fine = max(options.threshold_floor, options.threshold_sigmas * noise * noise_gain(options.smoothing_px))
    status, wide, peak = search(profiles, cv2.transpose(board), coarse=coarse, fine=fine, options=options, clip=clip)
    # A plateau wider than the window does not even stick out.
    white = low.max(axis=0) >= clip
    wide |= white
    amplitude, width = np.full((2, len(status)), np.nan, np.float32)
    found = _Lines(np.full(len(status), np.nan), amplitude, width, status, wide, white)
    good = status == _OK
    if len(peak.start):
        centre, found.amplitude[good] = place_centre(options.method, peak)
        found.centre[good] = peak.start + centre.astype(np.float64)
        found.width[good] = peak.sigma * FWHM_PER_SIGMA
    return found


@dataclass(frozen=True)
class _Lines:
    """Results (L,) of L lines."""

    centre: np.ndarray
    amplitude: np.ndarray
    width: np.ndarray
    status: np.ndarray
    wide: np.ndarray
    """Whether something bright was too wide to be measured."""
    white: np.ndarray
    """Whether pixels are saturated over a whole block."""

    def too_wide(self) -> bool:
        """Whether many lines show a stripe that is too wide to be measured."""
        good = self.status == _OK
        return int(np.count_nonzero(self.wide & ~good)) > _MANY * int(np.count_nonzero(good))

    def discard(self, lines: np.ndarray, status: np.uint8) -> None:
        self.status[lines] = status
        for values in (self.centre, self.amplitude, self.width):
            values[lines] = np.nan


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
    profiles = cv2.transpose(image) if stripe_along == "height" else np.ascontiguousarray(image).view()
    # Compiled code is made once for arrays that can be written and once more for others, as some cameras give.
    profiles.flags.writeable = False
    return profiles
