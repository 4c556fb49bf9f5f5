"""Window around a peak of a profile line, with the height, width and background of the peak."""

from __future__ import annotations

import math
from functools import lru_cache
from typing import NamedTuple

import cv2
import numpy as np

from uwlts.runtime.compiled import compiled, compiled_inline, compiled_part

FWHM_PER_SIGMA = 2.0 * math.sqrt(2.0 * math.log(2.0))
"""Full width at half maximum of a Gaussian, divided by its standard deviation."""


class WindowRule(NamedTuple):
    """Numbers of the measurement of a peak; a named tuple, which compiled code reads as constants.

    They follow from the reasons below; tests/uwlts/stripe/test_unchanged.py keeps the results on drawn stripes.

    Attributes
    ----------
    least_kernel : float
        Sigma of the narrowest weight, px. A narrower weight covers too few pixels: for a stripe of sigma 0.7 px the
        error of the centre with the pixel phase would be 0.015 px instead of 0.005 px.
    flank : int
        Pixels of background on either side of a peak, for two low-passed values at a distance of three pixels.
    tail : float
        Range of sums with Gaussian weights, in sigmas: further weights are below 0.0004 of the largest.
    background : float
        Distance of the background from a peak's middle, in sigmas: a Gaussian has fallen to 0.011 of its height.
    low_pass : float
        Range of the low-pass, in sigmas: its last weight is below 0.0022 of the largest.
    """

    least_kernel: float = 1.0
    flank: int = 5
    tail: float = 4.0
    background: float = 3.0
    low_pass: float = 3.5


WINDOW_RULE = WindowRule()

LANES = 64
"""Number of lines processed in parallel, which fills the processor's vector units.

A number per line is a row of lanes, a window of W pixels W rows. Rows are parts of flat arrays.
"""

# Rows of lanes that `measure_peaks` fills; the names are those of `PeakWindow`, or explained beside them.
TOP = 0 * LANES
"""Highest pixel after the low-pass."""
MIDDLE, SIGMA, REACH, BASE, SLOPE, HEIGHT = range(1 * LANES, 7 * LANES, LANES)
CLOSED = 7 * LANES
"""1 if both half-height crossings are in the window, otherwise 0."""
CROWDED = 8 * LANES
"""1 if the profile rises again outside the crossings, otherwise 0: above half height, or to the required fraction of
the height after a valley of half its own height."""
_GROUND = 9 * LANES
"""Lowest value of the higher surroundings."""
_LEVEL = 10 * LANES
"""Half height."""
_LEFT, _RIGHT = 11 * LANES, 12 * LANES
"""Nearest pixels below half height on both sides; -1 and the window's size if there is none."""
_BEGIN, _END = 13 * LANES, 14 * LANES
"""Pixels that are searched for a second stripe."""
_BESIDE = 15 * LANES
"""Greatest value of these pixels outside the half-height crossings."""
MEASURED = 16 * LANES
"""Number of elements of all rows."""

_LOWEST = np.float32(-1e38)
"""Lower than all pixels, and finite: surroundings of a window without a side inside the image."""
_HALF = np.float32(0.5)

FIRST = -1
"""Order of `SearchRules` for the rule `PeakRule.FIRST`."""
STRONGEST = 0
"""Order of `SearchRules` for the rules `PeakRule.STRONGEST` and `PeakRule.DIRECT`."""
LAST = 1
"""Order of `SearchRules` for the rule `PeakRule.LAST`."""


class SearchRules(NamedTuple):
    """Options of the search; lengths in px, heights in grey levels.

    Attributes
    ----------
    half, block : int
        A window consists of a block and ``half`` pixels on either side.
    smoothing : float
        Sigma of the low-pass.
    share : float
        Height of a second peak, as a fraction of the first one's, that makes a window crowded. For the strongest stripe
        the whole window is searched, otherwise the pixels used.
    order : int
        Rule for several stripes: `FIRST`, `STRONGEST` or `LAST`.
    narrowest, widest : float
        Range of a stripe's sigma.
    coarse, fine : float
        Least height of a block, and of a peak after the low-pass; lower ones are noise.
    bright : float
        Least height of a peak that is too wide to be measured and not haze.
    """

    half: int
    block: int
    smoothing: float
    share: float
    order: int
    narrowest: float
    widest: float
    coarse: float
    fine: float
    bright: float


class PeakWindow(NamedTuple):
    """Peaks in M windows of W pixels, in the form for compiled code.

    Attributes
    ----------
    start : (M,) int
        First pixel of each window on its line.
    window : (M, W) float32
        Pixels; beyond the image the border pixel is repeated.
    middle : (M,) float32
        Midpoint of the half-height crossings, px from the window's first pixel.
    sigma : (M,) float32
        Half-height width divided by 2.355, px, without the low-pass (variances add).
    reach : (M,) float32
        Number of pixels from ``middle`` to the first background pixel.
    base, slope : (M,) float32
        Background at ``middle``, and its slope per px, from the flanks beyond ``reach``.
    height : (M,) float32
        Height of the highest pixel above ``base``; above the lowest surroundings if a crossing is outside the window.
    smoothing : float
        Sigma of the low-pass, px.
    """

    start: np.ndarray
    window: np.ndarray
    middle: np.ndarray
    sigma: np.ndarray
    reach: np.ndarray
    base: np.ndarray
    slope: np.ndarray
    height: np.ndarray
    smoothing: float

    @classmethod
    def empty(cls, count: int, size: int, smoothing: float) -> PeakWindow:
        """Allocate ``count`` windows of ``size`` pixels."""
        numbers = np.empty((6, count), np.float32)
        window = np.empty((count, size), np.float32)
        return cls(np.empty(count, np.intp), window, *numbers, smoothing=smoothing)

    def select(self, which: np.ndarray) -> PeakWindow:
        """Return the windows selected by a boolean mask or by indices."""
        *values, smoothing = self
        return PeakWindow(*(value[which] for value in values), smoothing=smoothing)

    def first(self, count: int) -> PeakWindow:
        """Return the first ``count`` windows."""
        *values, smoothing = self
        return PeakWindow(*(value[:count] for value in values), smoothing=smoothing)

    def smooth(self) -> np.ndarray:
        """Return the windows (M, W) float32 after the low-pass."""
        kernel = low_pass(self.smoothing)
        return cv2.sepFilter2D(self.window, cv2.CV_32F, kernel, np.ones(1, np.float32), borderType=cv2.BORDER_REPLICATE)

    def kernel_sigma(self) -> np.ndarray:
        """Return the sigma (M,) float32 of the Gaussian weight for each peak."""
        return np.maximum(self.sigma, np.float32(WINDOW_RULE.least_kernel))


@compiled_part
def cut_window(profiles: np.ndarray, line: int, start: int, k: int, cut: np.ndarray, pixels: np.ndarray) -> None:
    """Copy pixels of a line of the profiles (N, L) from `start` on to row `k` of `cut`, and to lane `k` of `pixels`.

    Beyond the image the border pixel is repeated.
    """
    last = profiles.shape[0] - 1
    if start >= 0 and start + pixels.shape[0] - 1 <= last:
        for x in range(pixels.shape[0]):
            cut[k, x] = pixels[x, k] = profiles[start + x, line]
    else:
        for x in range(pixels.shape[0]):
            cut[k, x] = pixels[x, k] = profiles[min(max(start + x, 0), last), line]


@compiled_part
def filter_windows(pixels: np.ndarray, kernel: np.ndarray, out: np.ndarray) -> None:
    """Filter windows in lanes with a symmetric low-pass of 2 R + 1 weights.

    ``pixels`` has R further rows on either side, which are overwritten with the windows' border pixels.
    """
    size, border = out.size, kernel.size // 2 * LANES
    middle = pixels[border : border + size]
    for x in range(0, border, LANES):
        for k in range(LANES):
            pixels[x + k], pixels[border + size + x + k] = middle[k], middle[size - LANES + k]
    for k in range(size):
        out[k] = kernel[kernel.size // 2] * middle[k]
    for j in range(kernel.size // 2):
        before, after = pixels[j * LANES :][:size], pixels[2 * border - j * LANES :][:size]
        for k in range(size):
            out[k] += kernel[j] * (before[k] + after[k])


@compiled_part
def measure_peaks(smooth: np.ndarray, starts: np.ndarray, count: int, rules: SearchRules, found: np.ndarray) -> None:
    """Measure the peaks in filtered windows `smooth` (W, lanes), which start at pixels `starts` (lanes,) of `count`.

    The windows may extend beyond the image. The peak is the highest pixel of the central block and half a block on
    either side.
    """
    block, size, first = rules.block, smooth.shape[0], rules.half - rules.block // 2
    none, end = np.float32(-1.0), np.float32(size)
    for k in range(LANES):
        found[HEIGHT + k], found[_GROUND + k], found[_BESIDE + k] = _LOWEST, _LOWEST, _LOWEST
        found[_LEFT + k], found[_RIGHT + k] = none, end
    for x in range(first, first + 2 * block):
        pixels, place = smooth[x], np.float32(x)
        for k in range(LANES):
            value, highest, top = pixels[k], found[HEIGHT + k], found[TOP + k]
            found[TOP + k] = place if value > highest else top
            found[HEIGHT + k] = max(highest, value)
    # Repeated border pixels may belong to the stripe: use only sides inside the image.
    for begin in (0, size - block):
        for k in range(LANES):
            found[_LEVEL + k] = -_LOWEST
        for x in range(begin, begin + block):
            pixels = smooth[x]
            for k in range(LANES):
                found[_LEVEL + k] = min(found[_LEVEL + k], pixels[k])
        for k in range(LANES):
            inside = (starts[k] + begin >= 0) & (starts[k] + begin + block <= count)
            ground = max(found[_GROUND + k], found[_LEVEL + k] if inside else _LOWEST)
            found[_GROUND + k], found[_LEVEL + k] = ground, ground + _HALF * (found[HEIGHT + k] - ground)
    for x in range(size):
        pixels, place = smooth[x], np.float32(x)
        for k in range(LANES):
            top, low = found[TOP + k], pixels[k] < found[_LEVEL + k]
            found[_LEFT + k] = max(found[_LEFT + k], place if low & (place < top) else none)
            found[_RIGHT + k] = min(found[_RIGHT + k], place if low & (place > top) else end)
    for k in range(LANES):
        _measure_width(smooth, k, rules, found)
    for x in range(size):
        pixels, place = smooth[x], np.float32(x)
        for k in range(LANES):
            before = (place >= found[_BEGIN + k]) & (place <= found[_LEFT + k])
            after = (place >= found[_RIGHT + k]) & (place < found[_END + k])
            found[_BESIDE + k] = max(found[_BESIDE + k], pixels[k] if before | after else _LOWEST)
    for k in range(LANES):
        _finish_peak(smooth, k, rules, found)


@compiled_part
def _measure_width(smooth: np.ndarray, k: int, rules: SearchRules, found: np.ndarray) -> None:
    """Measure middle, width and background of the peak in lane `k`."""
    left, right, level, size = int(found[_LEFT + k]), int(found[_RIGHT + k]), found[_LEVEL + k], smooth.shape[0]
    x_left = found[_LEFT + k] + _interpolate_level(smooth[max(left, 0), k], smooth[left + 1, k], level)
    last = smooth[min(right, size - 1), k]
    x_right = found[_RIGHT + k] - _interpolate_level(last, smooth[right - 1, k], level)
    middle, smooth_sigma = _HALF * (x_left + x_right), (x_right - x_left) * np.float32(1.0 / FWHM_PER_SIGMA)
    square = smooth_sigma * smooth_sigma - np.float32(rules.smoothing * rules.smoothing)
    reach = min(math.ceil(np.float32(WINDOW_RULE.background) * smooth_sigma), rules.half - WINDOW_RULE.flank)
    near = math.floor(middle + _HALF)
    before = _flank(smooth, k, near - reach - WINDOW_RULE.flank + 1)
    after = _flank(smooth, k, near + reach - 1)
    slope = (after - before) / np.float32(2 * reach + WINDOW_RULE.flank - 2)
    extent = size if rules.order == STRONGEST else reach + WINDOW_RULE.flank - 1
    found[MIDDLE + k], found[REACH + k], found[SLOPE + k] = middle, reach, slope
    found[SIGMA + k] = math.sqrt(max(square, np.float32(0.0)))
    found[BASE + k] = _HALF * (before + after) + slope * (middle - np.float32(near))
    found[CLOSED + k] = left >= 0 and right < size
    found[_BEGIN + k], found[_END + k] = max(near - extent, 0), min(near + extent + 1, size)


@compiled_part
def _finish_peak(smooth: np.ndarray, k: int, rules: SearchRules, found: np.ndarray) -> None:
    """Compute height and crowding of the peak in lane `k`, from its highest pixel and the highest one beside."""
    ground, rise = found[_GROUND + k], found[HEIGHT + k] - found[_GROUND + k]
    crowded = False
    if rise <= 0:
        # The surroundings are as high: there is no peak.
        found[MIDDLE + k], found[SIGMA + k], found[REACH + k] = found[TOP + k], 0, 0
        found[BASE + k], found[SLOPE + k], found[HEIGHT + k], found[CLOSED + k] = ground, 0, 0, 0
    else:
        found[HEIGHT + k] -= found[BASE + k] if found[CLOSED + k] else ground
        if found[_BESIDE + k] >= ground + np.float32(rules.share) * rise:
            # A monotonic tail is no second stripe.
            for side in (-1, 1):
                begin, end = (
                    (found[_LEFT + k], found[_BEGIN + k] - 1) if side < 0 else (found[_RIGHT + k], found[_END + k])
                )
                crowded |= _rises_again(smooth, k, int(begin), int(end), side, ground, rise, rules)
    found[CROWDED + k] = crowded


@compiled_inline
def _rises_again(
    smooth: np.ndarray,
    lane: int,
    first: int,
    end: int,
    step: int,
    ground: np.floating,
    rise: np.floating,
    rules: SearchRules,
) -> np.bool_:
    """Return True if a lane outside a peak reaches half height, or the required fraction after a valley.

    The valley is at most half as high as the values after it. They must exceed it by at least ``fine``, the noise
    limit.
    """
    level, share, fine = np.float32(0.5) * rise, np.float32(rules.share) * rise, np.float32(rules.fine)
    lowest, found = np.float32(np.inf), rise < 0
    for k in range(first, end, step):
        value = smooth[k, lane]
        lowest, above = min(lowest, value), value - ground
        found |= above >= level or (above >= share and value - lowest >= max(np.float32(0.5) * above, fine))
    return found


@compiled_part
def _interpolate_level(low: np.floating, high: np.floating, level: np.floating) -> np.float32:
    """Return the position, from 0 to 1, of a level on the straight line between two neighbouring pixels."""
    return np.float32(min(max((level - low) / max(high - low, np.float32(1e-6)), np.float32(0.0)), np.float32(1.0)))


@compiled_part
def _flank(smooth: np.ndarray, k: int, first: int) -> np.float32:
    """Return the background in a flank of lane `k`: the lower of two low-passed values, to ignore hot pixels."""
    first = min(max(first, 0), smooth.shape[0] - WINDOW_RULE.flank)
    return min(smooth[first + 1, k], smooth[first + WINDOW_RULE.flank - 1, k])


@lru_cache(maxsize=16)
def low_pass(sigma: float) -> np.ndarray:
    """Return Gaussian weights of sum 1."""
    reach = math.ceil(WINDOW_RULE.low_pass * sigma)
    weight = np.exp(-0.5 * (np.arange(-reach, reach + 1) / sigma) ** 2)
    return (weight / weight.sum()).astype(np.float32)


@lru_cache(maxsize=16)
def noise_gain(sigma: float) -> float:
    """Return the standard deviation of white unit noise after the low-pass."""
    return float(np.sqrt(np.sum(low_pass(sigma) ** 2)))


@compiled
def gaussian_moments(peak: PeakWindow, centre: np.ndarray, sigma: np.ndarray, moments: np.ndarray) -> None:
    """Compute moments M0, M1, M2 (M, 3) of the windows above `base`, weighted at `centre`; see `zero_crossing`."""
    count, size = peak.window.shape
    for m in range(count):
        pixels, ground, middle, width = peak.window[m], peak.base[m], float(centre[m]), float(sigma[m])
        reach, sharpness = math.ceil(WINDOW_RULE.tail * width), 1.0 / (width * width)
        # The centre may be outside its window.
        near = min(max(math.floor(middle + 0.5), 0), size - 1)
        # Gaussian by recurrence: the ratio of neighbouring values decreases by a constant factor per pixel.
        falling = math.exp(-sharpness)
        highest = math.exp(-0.5 * sharpness * (near - middle) ** 2)
        total, first, second = 0.0, 0.0, 0.0
        for side in (1, -1):
            weight, ratio = highest, math.exp(-sharpness * (side * (near - middle) + 0.5))
            pixel, last = near, min(near + reach, size - 1) if side > 0 else max(near - reach, 0)
            if side < 0:
                weight, ratio, pixel = weight * ratio, ratio * falling, near - 1
            while (last - pixel) * side >= 0:
                t, value = (pixel - middle) / width, weight * (pixels[pixel] - ground)
                total, first, second = total + value, first + value * t, second + value * t * t
                weight, ratio, pixel = weight * ratio, ratio * falling, pixel + side
        moments[m, 0], moments[m, 1], moments[m, 2] = total, first, second


@compiled_part
def covered_fraction(u: float, half: float) -> float | np.floating:
    """Return the fraction of a pixel at distance u from the centre that is within `half` of the centre."""
    return min(max(half + np.float32(0.5) - abs(u), np.float32(0.0)), np.float32(1.0))
