"""From an image to one stripe centre per profile line."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import cv2
import numpy as np

from uwlts.errors import ImageError
from uwlts.model.stripe import Stripe, StripeCandidates, StripeStatus
from uwlts.stripe.block_contrast import MEDIAN_SURROUNDINGS, block_contrast, block_extremes, noise_from_contrast
from uwlts.stripe.direct import direct_stripe
from uwlts.stripe.learned import find_learned
from uwlts.stripe.methods import amplitudes, place_centre
from uwlts.stripe.options import LEARNED, PeakRule, StripeOptions
from uwlts.stripe.peak_window import FWHM_PER_SIGMA, noise_gain
from uwlts.stripe.search import MARGIN, SearchRules, look_at, search, search_all, search_rules, with_rivals

_LARGEST = {np.dtype(np.uint8): 255.0, np.dtype(np.uint16): 65535.0, np.dtype(np.float32): math.inf}
"""Grey value at which pixels of each type clip at the latest."""

_MANY = 0.25
"""Lines with a stripe that is too wide, over those with one that is measured, from which a wider window is tried."""

_WARM_LINES = 200
"""Lines of the image that warms up: enough for stripes to go on."""

_LEAST_NOISE = 0.3
"""Grey levels: standard deviation of rounding to whole ones."""

_COARSE_SIGMAS = 4.0
"""Standard deviations of a block's contrast above the median of the background, from which it is looked at closely: a
stripe of six standard deviations is hardly ever missed."""

_SHORT_GAP = 2
"""Lines for which a stripe may be lost, as in noise, and go on."""

# NumPy compares with its own integers several times as fast as with an enumeration.
_OK, _NO_STRIPE = np.uint8(StripeStatus.OK), np.uint8(StripeStatus.NO_STRIPE)


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
    found = _searched(image, stripe_along, options, background, saturation)
    return leave_ends_out(found.stripe, found.options)


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
    found = _searched(image, stripe_along, options, background, saturation)
    return found.candidates(np.arange(len(found.stripe.status)))


def stripe_in(
    seen: np.ndarray | Stripe, *, stripe_along: str, options: StripeOptions = StripeOptions(), saturation: float | None
) -> Stripe:
    """The stripe of what a camera saw: that of an image as by `extract_stripe`, that of a 3D camera without its ends.

    Of the ``options`` a 3D camera's stripe takes `StripeOptions.end_lines` alone.
    """
    if isinstance(seen, Stripe):
        return leave_ends_out(seen, options)
    return extract_stripe(seen, stripe_along=stripe_along, options=options, saturation=saturation)


def direct_stripe_in(
    seen: np.ndarray | Stripe, *, stripe_along: str, options: StripeOptions, saturation: float
) -> Stripe:
    """As `stripe_in`, without reflections under the rule `PeakRule.DIRECT` (`uwlts.stripe.direct`)."""
    if isinstance(seen, Stripe) or options.peak is not PeakRule.DIRECT:
        return stripe_in(seen, stripe_along=stripe_along, options=options, saturation=saturation)
    found = _searched(seen, stripe_along, options, None, saturation)
    stripe, rivals = found.stripe, found.rivals()
    if rivals is not None:
        stripe = direct_stripe(stripe, rivals, jump_px=found.options.jump_px)
    return leave_ends_out(stripe, found.options)


def leave_ends_out(stripe: Stripe, options: StripeOptions) -> Stripe:
    """Return the stripe without its last lines before it ends or jumps, which are END; see `StripeOptions.end_lines`.

    A stripe ends where more than a few lines in a row have no centre. The image's own border is no end.
    """
    lines, found = options.end_lines, stripe.lines
    if not lines or not len(found):
        return stripe
    place, count = stripe.centre_px[found], len(stripe.status)
    # Breaks stand before these of the lines found, and after all of them.
    apart = np.abs(place[1:] - place[:-1]) > options.jump_px
    if len(found) < count:
        apart |= found[1:] - found[:-1] > _SHORT_GAP + 1
    breaks = (1 + np.flatnonzero(apart)).tolist()
    if found[0] > _SHORT_GAP:
        breaks.append(0)
    if count - 1 - found[-1] > _SHORT_GAP:
        breaks.append(len(found))
    if not breaks:
        return stripe
    beside = np.zeros(len(found) + 2 * lines, np.bool_)
    for each in breaks:
        beside[each : each + 2 * lines] = True
    return stripe.without(found[beside[lines : lines + len(found)]], StripeStatus.END)


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
    direct_stripe_in(image, stripe_along="height", options=rivals, saturation=_LARGEST[image.dtype])


def _searched(
    image: np.ndarray,
    stripe_along: str,
    options: StripeOptions,
    background: np.ndarray | None,
    saturation: float | None,
) -> _Search:
    """Search an image with the window that suits its stripe; arguments and errors as of `extract_stripe`."""
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
    found = _search(profiles, options, clip, stripe_along)
    # A wider window is taken only if it measures what was too wide.
    wider, widest = options, min(options.widest_window_px, length // 4)
    while found.too_wide() and 2 * wider.half_window_px <= widest:
        wider = wider.doubled()
        found_wider = _search(profiles, wider, clip, stripe_along)
        if not found_wider.too_wide():
            found = found_wider

    none = found.stripe.status == _NO_STRIPE
    if none.any():
        white = found.white
        if signal is not image:
            _, low = block_extremes(_as_profiles(image, stripe_along=stripe_along), found.options.half_window_px // 2)
            white = low.max(axis=0) >= clip
        if (none & white).any():
            found = replace(found, stripe=found.stripe.without(none & white, StripeStatus.SATURATED))
    return found


@dataclass(frozen=True, eq=False)
class _Search:
    """The stripe found in profiles (N, L) with one size of window, ends included, and what the search knows beside it.

    ``several`` (L,) marks the lines that may hold more than one stripe, ``wide`` (L,) those with something bright that
    is too wide to be measured, ``white`` (L,) those with pixels that are saturated over a whole block. ``board``
    (B + 2 `MARGIN`, L) holds the contrasts of the blocks, ``left`` (L, B + 2 `MARGIN`) those not looked at, and
    ``noise`` is that of a pixel; a network, which knows one stripe only, has no ``rules``.
    """

    stripe: Stripe
    profiles: np.ndarray
    options: StripeOptions
    several: np.ndarray
    wide: np.ndarray
    white: np.ndarray
    board: np.ndarray
    left: np.ndarray
    noise: float
    rules: SearchRules | None

    def too_wide(self) -> bool:
        """Whether many lines show a stripe that is too wide to be measured."""
        good = self.stripe.status == _OK
        return int(np.count_nonzero((self.wide | self.white) & ~good)) > _MANY * int(np.count_nonzero(good))

    def rivals(self) -> StripeCandidates | None:
        """All stripes on lines with two or more, None if there are none.

        What cannot be measured is among them: its place is rough, its width NaN.
        """
        if self.rules is None:
            return None
        lines = np.flatnonzero(self.several | self.wide)
        known = (self.stripe.status[lines] != _OK) | self.wide[lines]
        lines = lines[with_rivals(self.profiles, self.left, lines, known, self.rules)]
        found = self.candidates(lines, rivals=True) if len(lines) else None
        return found if found is not None and len(found.line) else None

    def candidates(self, lines: np.ndarray, *, rivals: bool = False) -> StripeCandidates:
        """All stripes on some lines (M,); ``rivals`` as of the method of this name."""
        stripe, count, along = self.stripe, len(self.stripe.status), self.stripe.stripe_along
        if self.rules is None:
            own = np.intersect1d(lines, stripe.lines)
            columns = (each[own] for each in (stripe.centre_px, stripe.amplitude, stripe.width_px))
            return StripeCandidates(own, *columns, log_likelihood=np.zeros(len(own)), count=count, stripe_along=along)
        board = np.ascontiguousarray(self.board[:, lines].T)
        line, clear, peak = search_all(self.profiles, board, lines, self.rules, fewest=2 if rivals else 1)
        if not rivals:
            line, clear, peak = line[clear], clear[clear], peak.keep(clear)
        place, amplitude = peak.start + peak.middle.astype(float), peak.height.copy()
        width, certainty = np.full(len(line), np.nan, np.float32), np.zeros(len(line))
        measured = peak.keep(clear)
        centre, amplitude[clear] = place_centre(self.options.method, measured)
        place[clear], width[clear] = measured.start + centre.astype(float), measured.sigma * FWHM_PER_SIGMA
        # A matched filter: the squared height over the noise, summed over the profile of a Gaussian.
        sharp = amplitude[clear] / max(self.noise, _LEAST_NOISE)
        certainty[clear] = 0.5 * math.sqrt(math.pi) * measured.kernel_sigma() * sharp**2
        return StripeCandidates(line, place, amplitude, width, certainty, count, along)[np.lexsort((place, line))]


def _search(profiles: np.ndarray, options: StripeOptions, clip: float, along: str) -> _Search:
    """Search the profiles (N, L) with one size of window."""
    if options.method == LEARNED:
        return _search_by_network(profiles, options, clip, along)
    block = options.half_window_px // 2
    high, low = block_extremes(profiles, block)
    # Blocks more at either end of the lines, so that what one window covers can be crossed out without a check.
    board = np.zeros((high.shape[0] + 2 * MARGIN, high.shape[1]), high.dtype)
    noise = noise_from_contrast(block_contrast(high, low, out=board[MARGIN:-MARGIN]), block)
    coarse = max(options.threshold_floor, noise * (_COARSE_SIGMAS - MEDIAN_SURROUNDINGS))
    fine = max(options.threshold_floor, options.threshold_sigmas * noise * noise_gain(options.smoothing_px))
    left, rules = cv2.transpose(board), search_rules(options, coarse=coarse, fine=fine, clip=clip)
    status, wide, several, peak = search(profiles, left, rules)
    # A plateau wider than the window does not even stick out.
    white = low.max(axis=0) >= clip if low.max() >= clip else np.zeros(len(status), np.bool_)
    centre, amplitude = place_centre(options.method, peak)
    columns = peak.start + centre.astype(np.float64), amplitude, peak.sigma * FWHM_PER_SIGMA
    stripe = Stripe.on_lines(np.flatnonzero(status == _OK), *columns, status=status, stripe_along=along)
    return _Search(stripe, profiles, options, several, wide, white, board, left, noise, rules)


def _search_by_network(profiles: np.ndarray, options: StripeOptions, clip: float, along: str) -> _Search:
    """Search the profiles (N, L) by a trained network; height and width are measured at the places that it gives."""
    scale = clip if math.isfinite(clip) else max(float(profiles.max()), 1.0)
    status, centre = find_learned(profiles, options.model, clip=scale)
    lines = np.flatnonzero(status == _OK)
    peak = look_at(profiles, lines, centre[lines], options)
    amplitude = amplitudes(peak, (centre[lines] - peak.start).astype(np.float32))
    columns = centre[lines], amplitude, peak.sigma * FWHM_PER_SIGMA
    stripe = Stripe.on_lines(lines, *columns, status=status, stripe_along=along)
    stripe = stripe.without(lines[~((peak.height > 0) & (amplitude > 0))], StripeStatus.AMBIGUOUS)
    nothing, empty = np.zeros(len(status), bool), np.empty((0, 0))
    return _Search(stripe, profiles, options, nothing, nothing, nothing, empty, empty, 0.0, None)


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
