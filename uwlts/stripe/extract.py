"""Extraction of one stripe centre per profile line from an image.

A frame is reduced to the maximum and the background of blocks of a few pixels along each line. This is the only
operation on all pixels.

The contrast of a block is its maximum minus the larger background of the two blocks two steps away. Thus neither an
edge between a dark and a bright region nor a slope has contrast. Hot pixels or a second stripe in the surroundings do
not reduce the contrast of a stripe.

G. S. de Matos (UFSC 2017, section 4.5) applies a 5x5 low-pass filter and a quadratic "every few columns". The filter
IMAQ LowPass replaces a pixel by the mean of its neighbours only if it differs from them by more than a tolerance
(default: 40 %); it is not a plain mean. "Every few columns" is interpreted as five pixels, the size of the filter.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from functools import lru_cache
from statistics import NormalDist

import cv2
import numpy as np

from uwlts.errors import ImageError
from uwlts.model.stripe import Stripe, StripeCandidates, StripeStatus
from uwlts.runtime.compiled import compiled
from uwlts.stripe.direct import direct_stripe
from uwlts.stripe.exposures import has_marks, split_clipped
from uwlts.stripe.methods import method_names, place_centre
from uwlts.stripe.options import PeakRule, StripeOptions
from uwlts.stripe.peak_window import FWHM_PER_SIGMA, noise_gain
from uwlts.stripe.search import MARGIN, SearchRules, mark_rivals, search_all, search_profiles, search_rules

_NOISE_SAMPLES = 1024  # number of blocks for the estimate of the noise

MEDIAN_SURROUNDINGS = NormalDist().inv_cdf(1.0 - (1.0 - math.sqrt(0.5)) ** 0.5)
"""Median of max(min(a, b), min(c, d)) for unit Gaussian noise: each minimum is below x with 1 - (1 - P(x))^2."""


def block_contrast(profiles: np.ndarray, block: int, clip: float) -> tuple[np.ndarray, np.ndarray]:
    """Return the contrasts (B + 2 `MARGIN`, L) of the B blocks of profiles (N, L), with zeros at both ends.

    A contrast is the non-negative height of a block above its surroundings, grey levels. The background of a block is
    the smaller of two pixels half a block apart, which a single hot pixel does not raise. The last block of a line may
    be smaller.

    The second array (L,) is True for lines with a block whose background is ``clip`` or more. The contrast of such a
    plateau is zero if it is wider than the window.
    """
    blocks, lines = math.ceil(profiles.shape[0] / block), profiles.shape[1]
    high, low = np.empty((2, blocks, lines), profiles.dtype)
    board, brightest = np.zeros((blocks + 2 * MARGIN, lines), profiles.dtype), np.zeros(lines, profiles.dtype)
    _fill_contrasts(profiles, block, (high, low), board[MARGIN:-MARGIN], brightest)
    return board, brightest >= clip


@compiled
def _fill_contrasts(
    profiles: np.ndarray,
    block: int,
    buffers: tuple[np.ndarray, np.ndarray],
    contrast: np.ndarray,
    brightest: np.ndarray,
) -> None:
    """Fill the contrasts of `block_contrast` and the brightest background (L,), in the pixels' order in memory.

    ``buffers`` are maximum and background (B, L) of each block. At the ends of a line only one side has surroundings,
    which are used alone.
    """
    (high, low), count = buffers, profiles.shape[0]
    for number in range(high.shape[0] + 2):
        first, end = number * block, min(number * block + block, count)
        for n in range(first, end):
            pixels, largest = profiles[n], high[number]
            for k in range(pixels.size):
                largest[k] = pixels[k] if n == first else max(largest[k], pixels[k])
        if first < end:
            start, middle, least = profiles[first], profiles[(first + end) // 2], low[number]
            for k in range(least.size):
                least[k] = min(start[k], middle[k])
        # The blocks on both sides of the block before the previous one are known by now.
        done, last = number - 2, high.shape[0] - 1
        if done >= 0:
            largest, least, heights = high[done], low[done], contrast[done]
            before, after = low[done - 2 if done >= 2 else number], low[number if number <= last else done - 2]
            for k in range(heights.size):
                ground = max(before[k], after[k])
                heights[k] = max(largest[k], ground) - ground
                brightest[k] = max(brightest[k], least[k])


def noise_from_contrast(contrast: np.ndarray, block: int) -> float:
    """Estimate the standard deviation of the background noise per pixel, grey levels.

    The median contrast of all blocks is divided by its value for unit Gaussian noise. Most blocks do not contain a
    stripe. For a background clipped at black, this estimate is more accurate than the deviation of single pixels.
    """
    sample = contrast.ravel()[:: max(1, contrast.size // _NOISE_SAMPLES)].copy()
    sample.sort()
    middle = sample[sample.size // 2]
    median = float(middle)
    if contrast.dtype.kind in "iu":
        # The median of integers is quantised: interpolate the cumulative histogram linearly.
        below, end = sample.searchsorted(middle), sample.searchsorted(middle, side="right")
        median += (0.5 * sample.size - below) / (end - below) - 0.5
    return max(median, 0.0) / _median_contrast(block)


@lru_cache
def _median_contrast(block: int) -> float:
    """Return the median contrast of a block of unit Gaussian noise."""
    return NormalDist().inv_cdf(0.5 ** (1.0 / block)) - MEDIAN_SURROUNDINGS


_SIZE_PX = 5  # of the window of the thesis's filter
_SEARCHED_PX = 8  # half width of the window around the stripe in which its peak is searched


def fit_low_passed(profiles: np.ndarray, stripe: Stripe, *, tolerance: float, fitted_px: int) -> Stripe:
    """Return the stripe with the centres of the low-passed profiles (N, L), position first, on the same lines.

    ``tolerance`` is that of the filter; 0 makes it a mean of the neighbours. ``fitted_px`` is an odd number.
    """
    smooth, centre = apply_low_pass(profiles, tolerance=tolerance), stripe.centre_px.copy()
    lines = stripe.lines
    centre[lines] = _find_peaks(smooth, lines, centre[lines], half=fitted_px // 2)
    return replace(stripe, centre_px=centre)


def apply_low_pass(image: np.ndarray, *, tolerance: float) -> np.ndarray:
    """Filter an image (H, W) with IMAQ LowPass of 5x5 pixels; return float32."""
    grey = image.astype(np.float32)
    count = _SIZE_PX**2
    neighbours = (cv2.blur(grey, (_SIZE_PX, _SIZE_PX)) * count - grey) / (count - 1)
    return np.where(np.abs(grey - neighbours) > tolerance * neighbours, neighbours, grey)


def _find_peaks(smooth: np.ndarray, line: np.ndarray, near_px: np.ndarray, *, half: int) -> np.ndarray:
    """Return vertices (N,) of parabolas through pixels around the maximum of columns (N,) near rows (N,)."""
    # On a plateau, the maximum nearest to the stripe's position is used.
    around = np.array(sorted(range(-_SEARCHED_PX, _SEARCHED_PX + 1), key=abs))
    rows = np.clip(np.rint(near_px).astype(int)[:, None] + around, 0, len(smooth) - 1)
    top = rows[np.arange(len(line)), smooth[rows, line[:, None]].argmax(axis=1)]
    offset = np.arange(-half, half + 1)
    rows = np.clip(top[:, None] + offset, 0, len(smooth) - 1)
    # Relative to the maximum, so that a plateau is exactly zero. It has no vertex; its position is used instead.
    below = smooth[rows, line[:, None]] - smooth[top, line][:, None]
    second, first, _ = np.linalg.pinv(np.vander(offset, 3)) @ below.T
    vertex = np.where(second < 0, -first / np.where(second < 0, 2 * second, 1.0), 0.0)
    return top + np.clip(vertex, -half, half)


_LARGEST = {np.dtype(np.uint8): 255.0, np.dtype(np.uint16): 65535.0, np.dtype(np.float32): math.inf}
"""Largest grey value of each type."""


class _Rule:
    """Numbers of the extraction that are not options.

    Chosen by hand with the reasons below; tests/uwlts/stripe/test_unchanged.py keeps the results on drawn stripes.
    """

    too_wide: float = 0.25
    """Ratio of lines with a stripe too wide to be measured to lines with a measured stripe, above which a wider window
    is tried."""
    coarse_sigmas: float = 4.0
    """Least contrast of closely examined blocks above the background's median, in standard deviations. A stripe of six
    standard deviations is rarely missed."""
    least_noise: float = 0.3  # least standard deviation of the noise, grey levels: that of rounding to integers
    short_gap: int = 2  # most consecutive lines without a centre inside a stripe, as caused by noise
    warm_lines: int = 200  # lines of the image for `warm_up`: enough for stripes that continue


# NumPy compares its own integers several times faster than an enumeration.
_OK = np.uint8(StripeStatus.OK)
_NO_STRIPE = np.uint8(StripeStatus.NO_STRIPE)


def extract_stripe(
    image: np.ndarray,
    *,
    stripe_along: str,
    options: StripeOptions = StripeOptions(),
    background: np.ndarray | None = None,
    saturation: float | None = None,
) -> Stripe:
    """Find the sub-pixel stripe centre on every profile line.

    Parameters
    ----------
    image : (H, W) uint8, uint16 or float32
        Grey levels, also in a float32 image: scale it, or set ``options.threshold_floor``.
    stripe_along : str
        ``"height"``: the stripe runs along the image height, and the H rows are the lines. ``"width"``: the W columns
        are.
    options : StripeOptions, optional
        Method, rules and thresholds.
    background : (H, W) array of the image's type, optional
        The same view with the laser off, which is subtracted. A linear background is fitted beside each stripe in any
        case.
    saturation : float, optional
        Grey value of clipped pixels. By default the largest value of the integer type, none for float32. It is
        needed for 10- or 12-bit images in uint16. Values above 2^k - 1 are marks (`uwlts.stripe.exposures`).

    Returns
    -------
    Stripe
        Centres on the L lines, with L = H or W.

    Raises
    ------
    ImageError
        An argument does not have the form described above, or the lines are shorter than two search windows, too short
        to distinguish stripe and background.
    """
    found = _search_image(image, stripe_along, options, background, saturation)
    return found.complete(found.stripe)


def extract_candidates(
    image: np.ndarray,
    *,
    stripe_along: str,
    options: StripeOptions = StripeOptions(),
    background: np.ndarray | None = None,
    saturation: float | None = None,
) -> StripeCandidates:
    """Find up to six stripes on every profile line: of two sheets, or of reflections.

    See `extract_stripe` for parameters and errors. Two stripes are both omitted if one overlaps the pixels used for the
    other.
    """
    found = _search_image(image, stripe_along, options, background, saturation)
    return found.find_candidates(np.arange(len(found.stripe.status)))


def direct_stripe_in(image: np.ndarray, *, stripe_along: str, options: StripeOptions, saturation: float) -> Stripe:
    """Return the stripe as `extract_stripe`, under the rule `PeakRule.DIRECT` without reflections."""
    if options.peak is not PeakRule.DIRECT:
        return extract_stripe(image, stripe_along=stripe_along, options=options, saturation=saturation)
    found = _search_image(image, stripe_along, options, None, saturation)
    stripe, rivals = found.stripe, found.find_rivals()
    if rivals is not None:
        stripe = direct_stripe(stripe, rivals, jump_px=found.options.jump_px)
    return found.complete(stripe)


def _leave_ends_out(stripe: Stripe, options: StripeOptions) -> Stripe:
    """Return the stripe without its last lines before an end or a jump; see `StripeOptions.end_lines`.

    The omitted lines have the status END. A stripe ends if more than two consecutive lines lack a centre. The border
    of the image is not an end.
    """
    lines, found = options.end_lines, stripe.lines
    if not lines or not len(found):
        return stripe
    place, count = stripe.centre_px[found], len(stripe.status)
    # Indices in `found` before which the stripe is interrupted.
    jumps = np.abs(place[1:] - place[:-1]) > options.jump_px
    if len(found) < count:
        jumps |= found[1:] - found[:-1] > _Rule.short_gap + 1
    breaks = (1 + np.flatnonzero(jumps)).tolist()
    if found[0] > _Rule.short_gap:
        breaks.append(0)
    if count - 1 - found[-1] > _Rule.short_gap:
        breaks.append(len(found))
    if not breaks:
        return stripe
    beside = np.zeros(len(found) + 2 * lines, np.bool_)
    for each in breaks:
        beside[each : each + 2 * lines] = True
    return stripe.remove_lines(found[beside[lines : lines + len(found)]], StripeStatus.END)


def warm_up() -> None:
    """Load or compile all functions that find stripes in images of 8 bits.

    Without it, the first images of a stream are delayed by some tenths of a second; by some seconds if the functions
    have to be compiled. It covers the rule of direct light, `extract_candidates` and saturated stripes.
    """
    options = StripeOptions()
    half = options.half_window_px
    place, lines = np.arange(8 * half), np.arange(_Rule.warm_lines)[:, None]
    # A stripe, and a dimmer one with gaps beside it.
    beside = 0.3 * (lines % 20 < 10)
    seen = [share * np.exp(-0.5 * np.square((place - at * half) / 2.0)) for share, at in ((1.0, 2), (beside, 5))]
    image = np.broadcast_to(100.0 * sum(seen), (_Rule.warm_lines, 8 * half)).astype(np.uint8)
    # The default method uses all others for some images.
    for method in dict.fromkeys((options.method, *method_names())):
        extract_stripe(image, stripe_along="height", options=replace(options, method=method))
    rivals = replace(options, peak=PeakRule.DIRECT)
    direct_stripe_in(image, stripe_along="height", options=rivals, saturation=_LARGEST[image.dtype])


def _search_image(
    image: np.ndarray,
    stripe_along: str,
    options: StripeOptions,
    background: np.ndarray | None,
    saturation: float | None,
) -> _SearchedImage:
    """Search an image with the window that fits its stripe; see `extract_stripe` for parameters and errors."""
    half = options.half_window_px
    _check_image(image, name="image")
    if stripe_along not in ("height", "width"):
        raise ImageError(f'stripe_along is {stripe_along!r}; use "height" (lines are rows) or "width" (columns)')
    if (length := image.shape[1 if stripe_along == "height" else 0]) < 4 * half:
        raise ImageError(
            f"the image's lines have {length} pixels; the search needs {4 * half}: reduce half_window_px or check "
            "stripe_along"
        )
    if saturation is not None and not 0 < saturation < math.inf:
        raise ImageError(f"saturation is {saturation!r}; expected the positive grey value of clipped pixels")
    clip = _LARGEST[image.dtype] if saturation is None else saturation

    signal, clipped = image, None
    if background is not None or options.smoothing_lines > 1 or has_marks(image, clip):
        signal, clipped = split_clipped(image, clip)
    if background is not None:
        _check_image(background, name="background")
        if background.shape != image.shape or background.dtype != image.dtype:
            raise ImageError(
                f"the background is {background.shape} {background.dtype} but the image {image.shape} {image.dtype}; "
                "take both with the same camera settings"
            )
        # The sign is kept.
        signal = cv2.subtract(signal, background, dtype=cv2.CV_16S if image.dtype == np.uint8 else cv2.CV_32F)
    if clipped is not None:
        signal = _level_clipped(signal, clipped, stripe_along)
        clipped = _turn_to_profiles(clipped.view(np.uint8), stripe_along=stripe_along)
    if (count := options.smoothing_lines) > 1:
        kernel = (1, count) if stripe_along == "height" else (count, 1)
        signal = cv2.blur(signal.astype(np.float32), kernel, borderType=cv2.BORDER_REPLICATE)
    profiles = _turn_to_profiles(signal, stripe_along=stripe_along)
    found = _search_profiles(profiles, options, clip, stripe_along, clipped)
    # A wider window is used only if it measures the wide stripes.
    wider, widest = options, min(options.widest_window_px, length // 4)
    while found.is_too_wide() and 2 * wider.half_window_px <= widest:
        wider = wider.double_width()
        found_wider = _search_profiles(profiles, wider, clip, stripe_along, clipped)
        if not found_wider.is_too_wide():
            found = found_wider

    none = (found.stripe.status == _NO_STRIPE) & found.white
    return replace(found, stripe=found.stripe.remove_lines(none, StripeStatus.SATURATED)) if none.any() else found


def _level_clipped(image: np.ndarray, clipped: np.ndarray, along: str) -> np.ndarray:
    """Return an image (H, W) in which neighbouring clipped pixels of a profile line have the largest of their values.

    After a subtraction their values depend on the background and on other channels rather than on the laser, whose
    light is at least the largest value. Unequal values would shift the stripe or split it.
    """
    lines, of_lines = (image, clipped) if along == "height" else (image.T, clipped.T)
    place = np.flatnonzero(of_lines)
    if not place.size:
        return image
    line, pixel = np.divmod(place, lines.shape[1])
    first = np.flatnonzero((np.diff(place, prepend=-2) > 1) | (pixel == 0))
    levelled = image.copy()
    result = levelled if along == "height" else levelled.T
    highest = np.maximum.reduceat(lines[line, pixel], first)
    result[line, pixel] = np.repeat(highest, np.diff(first, append=place.size))
    return levelled


@dataclass(frozen=True, eq=False)
class _SearchedImage:
    """Result of the search with one window size, including the ends of the stripe."""

    stripe: Stripe
    profiles: np.ndarray  # (N, L); pixels along the L lines
    options: StripeOptions
    several: np.ndarray  # (L,) bool; lines that may contain more than one stripe
    wide: np.ndarray  # (L,) bool; lines with a bright peak too wide to be measured
    white: np.ndarray  # (L,) bool; lines with a completely saturated block
    board: np.ndarray  # (B + 2 `MARGIN`, L); contrasts of the blocks
    left: np.ndarray  # (L, B + 2 `MARGIN`); contrasts of the blocks not examined by the search
    noise: float  # standard deviation of a pixel's noise, grey levels
    rules: SearchRules

    def complete(self, stripe: Stripe) -> Stripe:
        """Return the stripe without its ends, with the centres of `StripeOptions.low_pass` if it is set."""
        stripe, tolerance = _leave_ends_out(stripe, self.options), self.options.low_pass
        if tolerance is None:
            return stripe
        return fit_low_passed(self.profiles, stripe, tolerance=tolerance, fitted_px=self.options.low_pass_fit_px)

    def is_too_wide(self) -> bool:
        """Return True if many lines show a stripe too wide to be measured."""
        good = self.stripe.status == _OK
        return int(np.count_nonzero((self.wide | self.white) & ~good)) > _Rule.too_wide * int(np.count_nonzero(good))

    def find_rivals(self) -> StripeCandidates | None:
        """Return all stripes on lines with two or more stripes; None without such lines.

        Stripes that cannot be measured are included: their centre is approximate, their width NaN.
        """
        lines = np.flatnonzero(self.several | self.wide)
        known = (self.stripe.status[lines] != _OK) | self.wide[lines]
        mark_rivals(self.profiles, self.left, lines, self.rules, known)
        found = self.find_candidates(lines[known], rivals=True) if known.any() else None
        return found if found is not None and len(found.line) else None

    def find_candidates(self, lines: np.ndarray, *, rivals: bool = False) -> StripeCandidates:
        """Return all stripes on given lines (M,); with ``rivals`` as described in `find_rivals`."""
        board = np.ascontiguousarray(self.board[:, lines].T)
        line, clear, peak = search_all(self.profiles, board, lines, self.rules, fewest=2 if rivals else 1)
        if not rivals:
            line, clear, peak = line[clear], clear[clear], peak.select(clear)
        # The middle of a stripe that is cut off by the border may be outside the image.
        place = np.clip(peak.start + peak.middle.astype(float), 0, len(self.profiles) - 1)
        amplitude = peak.height.copy()
        width, certainty = np.full(len(line), np.nan, np.float32), np.zeros(len(line))
        measured = peak.select(clear)
        centre, amplitude[clear] = place_centre(self.options.method, measured)
        place[clear], width[clear] = measured.start + centre.astype(float), measured.sigma * FWHM_PER_SIGMA
        # Matched filter: squared ratio of height and noise, summed over a Gaussian profile.
        sharp = amplitude[clear] / max(self.noise, _Rule.least_noise)
        certainty[clear] = 0.5 * math.sqrt(math.pi) * measured.kernel_sigma() * sharp**2
        count, along = len(self.stripe.status), self.stripe.stripe_along
        return StripeCandidates(line, place, amplitude, width, certainty, count, along)[np.lexsort((place, line))]


def _search_profiles(
    profiles: np.ndarray, options: StripeOptions, clip: float, along: str, clipped: np.ndarray | None
) -> _SearchedImage:
    """Search the profiles (N, L) with one window size; ``clipped`` (N, L) is None if ``clip`` distinguishes pixels."""
    block = options.half_window_px // 2
    board, white = block_contrast(profiles, block, clip)
    noise = noise_from_contrast(board[MARGIN:-MARGIN], block)
    coarse = max(options.threshold_floor, noise * (_Rule.coarse_sigmas - MEDIAN_SURROUNDINGS))
    fine = max(options.threshold_floor, options.threshold_sigmas * noise * noise_gain(options.smoothing_px))
    left, rules = cv2.transpose(board), search_rules(options, coarse=coarse, fine=fine, clip=clip)
    status, wide, several, peak = search_profiles(profiles, left, rules)
    if clipped is not None:
        white = block_contrast(clipped, block, 1)[1]
    centre, amplitude = place_centre(options.method, peak)
    columns = peak.start + centre.astype(np.float64), amplitude, peak.sigma * FWHM_PER_SIGMA
    stripe = Stripe.from_lines(np.flatnonzero(status == _OK), *columns, status=status, stripe_along=along)
    return _SearchedImage(stripe, profiles, options, several, wide, white, board, left, noise, rules)


def _check_image(image: np.ndarray, *, name: str) -> None:
    """Raise ImageError unless the image is a two-dimensional, finite uint8, uint16 or float32 array."""
    if not isinstance(image, np.ndarray):
        raise ImageError(f"the {name} is a {type(image).__name__}; expected a NumPy array")
    if image.dtype not in _LARGEST:
        raise ImageError(f"the {name} has type {image.dtype}; convert it to uint8, uint16 or float32")
    if image.ndim != 2:
        raise ImageError(f"the {name} has shape {image.shape}; expected (height, width): choose one channel")
    if image.size == 0:
        raise ImageError(f"the {name} is empty, its shape is {image.shape}")
    if image.dtype == np.float32 and (count := np.count_nonzero(~np.isfinite(image))):
        raise ImageError(f"the {name} has {count} pixels that are not finite; repair or mask them first")


def _turn_to_profiles(image: np.ndarray, *, stripe_along: str) -> np.ndarray:
    """Return a contiguous array (N, L) with the position along the line first, for operations on whole lines."""
    profiles = cv2.transpose(image) if stripe_along == "height" else np.ascontiguousarray(image).view()
    # Make all arrays read-only: compiled code is specialised for writable and for read-only arrays.
    profiles.flags.writeable = False
    return profiles
