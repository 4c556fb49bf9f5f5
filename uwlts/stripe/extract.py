"""From an image to one stripe centre per profile line."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import cv2
import numpy as np

from uwlts.errors import ImageError
from uwlts.model.stripe import Stripe, StripeStatus
from uwlts.stripe.candidates import MEDIAN_SURROUNDINGS, block_contrast, block_extremes, noise_from_contrast
from uwlts.stripe.direct import SeenStripes, direct_stripes
from uwlts.stripe.ends import copied, leave_ends_out
from uwlts.stripe.learned import find_learned
from uwlts.stripe.methods import amplitudes, place_centre
from uwlts.stripe.peak_window import FWHM_PER_SIGMA, noise_gain
from uwlts.stripe.result import LEARNED, PeakRule, StripeCandidates, StripeOptions
from uwlts.stripe.search import MARGIN, SearchRules, look_at, search, search_all, search_rules, with_rivals

_LARGEST = {np.dtype(np.uint8): 255.0, np.dtype(np.uint16): 65535.0, np.dtype(np.float32): math.inf}

_MANY = 0.25
"""Lines with a stripe that is too wide, over those with one that is measured, from which a wider window is tried."""

_WARM_LINES = 200
"""Lines of the image that warms up: enough for stripes to go on."""

_LEAST_NOISE = 0.3
"""Grey levels: standard deviation of rounding to whole ones."""

# NumPy compares with its own integers several times as fast as with an enumeration.
_OK, _NO_STRIPE, _AMBIGUOUS, _SATURATED = (
    np.uint8(StripeStatus[name]) for name in ("OK", "NO_STRIPE", "AMBIGUOUS", "SATURATED")
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
    return _extracted(image, stripe_along, options, background, saturation).without_ends()


def extract_candidates(
    image: np.ndarray,
    *,
    stripe_along: str,
    options: StripeOptions = StripeOptions(),
    background: np.ndarray | None = None,
    saturation: float | None = None,
) -> StripeCandidates:
    """All stripes on every profile line, up to six: of two sheets, of reflections.

    Arguments and errors are as of `extract_stripe`. Two stripes of which one reaches into the other's pixels cannot be
    measured, and neither is there. The method "learned" knows one stripe only.
    """
    found = _extracted(image, stripe_along, options, background, saturation)
    return found.candidates(np.arange(len(found.stripe.status)))


def see_stripes(
    image: np.ndarray | Stripe, *, stripe_along: str, options: StripeOptions, saturation: float
) -> SeenStripes:
    """The stripe as of `extract_stripe`, its ends included, and the candidates on lines that hold more than one.

    These only under the rule `PeakRule.DIRECT`. A 3D camera has found its stripe by itself.
    """
    if isinstance(image, Stripe):
        return SeenStripes(copied(image), None, options.threshold_floor, options.half_window_px / 2, options.end_lines)
    found = _extracted(image, stripe_along, options, None, saturation)
    seen, jump_px = found.detection, found.options.half_window_px / 2
    if seen is None or options.peak is not PeakRule.DIRECT:
        return SeenStripes(found.stripe, None, options.threshold_floor, jump_px, options.end_lines)
    lines = np.flatnonzero(found.several | found.glare)
    known = (found.stripe.status[lines] != _OK) | found.glare[lines]
    lines = lines[with_rivals(found.profiles, seen.left, lines, known, seen.rules)]
    rivals = found.candidates(lines, rivals=True) if len(lines) else None
    if rivals is not None and len(rivals.line) == 0:
        rivals = None
    return SeenStripes(found.stripe, rivals, seen.rules.fine, jump_px, options.end_lines)


def _extracted(
    image: np.ndarray,
    stripe_along: str,
    options: StripeOptions,
    background: np.ndarray | None,
    saturation: float | None,
) -> _Extracted:
    """The stripe of an image with its ends; arguments and errors as of `extract_stripe`."""
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
    found, several, glare, detection = _found(profiles, options, clip)
    # A wider window is taken only if it measures what was too wide.
    wider, widest = options, min(options.widest_window_px, length // 4)
    while found.too_wide() and 2 * wider.half_window_px <= widest:
        wider = wider.doubled()
        found_wider = _found(profiles, wider, clip)
        if not found_wider[0].too_wide():
            options, (found, several, glare, detection) = wider, found_wider

    none = found.status == _NO_STRIPE
    if none.any():
        white = found.white
        if signal is not image:
            _, low = block_extremes(_as_profiles(image, stripe_along=stripe_along), options.half_window_px // 2)
            white = low.max(axis=0) >= clip
        found.status[none & white] = _SATURATED
    stripe = Stripe(found.centre, found.amplitude, found.width, found.status, stripe_along)
    return _Extracted(stripe, several, glare, profiles, options, detection)


def stripe_in(
    seen: np.ndarray | Stripe, *, stripe_along: str, options: StripeOptions = StripeOptions(), saturation: float | None
) -> Stripe:
    """The stripe of what a camera saw: that of an image as by `extract_stripe`, that of a 3D camera without its ends.

    Of the ``options`` a 3D camera's stripe takes `StripeOptions.end_lines` alone.
    """
    if isinstance(seen, Stripe):
        return leave_ends_out(copied(seen), lines=options.end_lines, jump_px=options.half_window_px / 2)
    return extract_stripe(seen, stripe_along=stripe_along, options=options, saturation=saturation)


def warm_up(dtype: np.dtype | type = np.uint8, options: StripeOptions = StripeOptions()) -> None:
    """Load all that finding stripes in images of a type needs, or compile it where that was never done on this machine.

    Otherwise the first images of a stream wait for it: some tenths of a second, and some seconds once. The rule of
    direct light and `extract_candidates` are among it, and what only saturated stripes need.
    """
    half = options.half_window_px
    place, lines = np.arange(8 * half), np.arange(_WARM_LINES)[:, None]
    # A stripe, and beside it a dimmer one that comes and goes.
    beside = 0.3 * (lines % 20 < 10)
    seen = [share * np.exp(-0.5 * np.square((place - at * half) / 2.0)) for share, at in ((1.0, 2), (beside, 5))]
    image = np.broadcast_to(100.0 * sum(seen), (_WARM_LINES, 8 * half)).astype(dtype)
    for method in (options.method, "quadratic"):
        extract_stripe(image, stripe_along="height", options=replace(options, method=method))
    rivals = replace(options, peak=PeakRule.DIRECT)
    images = (see_stripes(image, stripe_along="height", options=rivals, saturation=_LARGEST[image.dtype]) for _ in "ab")
    list(direct_stripes(images, farther=1))


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


def _found(
    profiles: np.ndarray, options: StripeOptions, clip: float
) -> tuple[_Lines, np.ndarray, np.ndarray, _Detection | None]:
    """The stripe on each of the profiles (N, L), with one size of window.

    And which lines (L,) may hold several, and which something bright that is too wide to be measured.
    """
    if options.method == LEARNED:
        found = _found_by_model(profiles, options, clip if math.isfinite(clip) else max(float(profiles.max()), 1.0))
        nothing = np.zeros(len(found.status), bool)
        return found, nothing, nothing, None
    block = options.half_window_px // 2
    high, low = block_extremes(profiles, block)
    # Blocks more at either end of the lines, so that what one window covers can be crossed out without a check.
    board = np.zeros((high.shape[0] + 2 * MARGIN, high.shape[1]), high.dtype)
    contrast = block_contrast(high, low, out=board[MARGIN:-MARGIN])
    noise = noise_from_contrast(contrast, block)
    # 4 standard deviations over the median of the background, so that a stripe of 6 is hardly ever missed.
    coarse = max(options.threshold_floor, noise * (4.0 - MEDIAN_SURROUNDINGS))
    fine = max(options.threshold_floor, options.threshold_sigmas * noise * noise_gain(options.smoothing_px))
    left = cv2.transpose(board)
    detection = _Detection(board, left, noise, search_rules(options, coarse=coarse, fine=fine, clip=clip))
    status, wide, several, peak = search(profiles, left, detection.rules)
    glare = wide.copy()
    # A plateau wider than the window does not even stick out.
    white = low.max(axis=0) >= clip if low.max() >= clip else np.zeros(len(status), np.bool_)
    wide |= white
    amplitude, width = np.full((2, len(status)), np.nan, np.float32)
    found = _Lines(np.full(len(status), np.nan), amplitude, width, status, wide, white)
    if len(peak.start):
        good = np.flatnonzero(status == _OK)
        centre, found.amplitude[good] = place_centre(options.method, peak)
        found.centre[good] = peak.start + centre.astype(np.float64)
        found.width[good] = peak.sigma * FWHM_PER_SIGMA
    return found, several, glare, detection


@dataclass(frozen=True)
class _Detection:
    """Contrast of the blocks (B + 2 `MARGIN`, L), the same (L, B + 2 `MARGIN`) less what has been looked at, noise of a
    pixel, and the rules of the search."""

    board: np.ndarray
    left: np.ndarray
    noise: float
    rules: SearchRules


@dataclass(frozen=True)
class _Extracted:
    """The stripe of an image, and how it was sought on the profiles (N, L).

    ``several`` (L,) marks the lines that may hold more than one, ``glare`` (L,) those with something bright that is too
    wide to be measured.
    """

    stripe: Stripe
    several: np.ndarray
    glare: np.ndarray
    profiles: np.ndarray
    options: StripeOptions
    detection: _Detection | None

    def without_ends(self) -> Stripe:
        """The stripe without its ends."""
        return leave_ends_out(self.stripe, lines=self.options.end_lines, jump_px=self.options.half_window_px / 2)

    def candidates(self, lines: np.ndarray, *, rivals: bool = False) -> StripeCandidates:
        """All stripes on some lines (M,).

        With ``rivals`` those of lines with two or more alone, with what cannot be measured among them: its place is
        rough, its width NaN.
        """
        stripe, seen, options = self.stripe, self.detection, self.options
        if seen is None:
            return self._own(np.intersect1d(lines, stripe.lines))
        board = np.ascontiguousarray(seen.board[:, lines].T)
        line, clear, peak = search_all(self.profiles, board, lines, seen.rules, fewest=2 if rivals else 1)
        if not rivals:
            line, clear, peak = line[clear], clear[clear], peak.keep(clear)
        if not len(line):
            return self._own(line)
        place, amplitude = peak.start + peak.middle.astype(float), peak.height.copy()
        width, certainty = np.full(len(line), np.nan, np.float32), np.zeros(len(line))
        measured = peak.keep(clear)
        centre, amplitude[clear] = place_centre(options.method, measured)
        place[clear], width[clear] = measured.start + centre.astype(float), measured.sigma * FWHM_PER_SIGMA
        # A matched filter: the squared height over the noise, summed over the profile of a Gaussian.
        sharp = amplitude[clear] / max(seen.noise, _LEAST_NOISE)
        certainty[clear] = 0.5 * math.sqrt(math.pi) * measured.kernel_sigma() * sharp**2
        order = np.lexsort((place, line))
        line, place, certainty = line[order], place[order], certainty[order]
        return StripeCandidates(
            line, place, amplitude[order], width[order], certainty, len(stripe.status), stripe.stripe_along
        )

    def _own(self, lines: np.ndarray) -> StripeCandidates:
        """The stripe itself on some of its lines (M,)."""
        of = self.stripe
        centre, amplitude, width = (each[lines] for each in (of.centre_px, of.amplitude, of.width_px))
        return StripeCandidates(lines, centre, amplitude, width, np.zeros(len(lines)), len(of.status), of.stripe_along)


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
