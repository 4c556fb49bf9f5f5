"""Window around a peak of a profile line, with the height, width and background of the peak."""

from __future__ import annotations

import math
from functools import lru_cache
from typing import NamedTuple

import numpy as np

from uwlts.runtime.compiled import compiled, compiled_inline, compiled_part

FWHM_PER_SIGMA = 2.0 * math.sqrt(2.0 * math.log(2.0))
"""Full width at half maximum of a Gaussian, divided by its standard deviation."""


class WindowRule(NamedTuple):
    """Numbers of the measurement of a peak; a named tuple, which compiled code reads as constants.

    They follow from the reasons below; tests/uwlts/stripe/test_unchanged.py keeps the results on drawn stripes.
    """

    least_kernel: float = 1.0
    """Sigma of the narrowest weight, px. A narrower weight covers too few pixels: for a stripe of sigma 0.7 px the
    error of the centre with the pixel phase would be 0.015 px instead of 0.005 px."""
    flank: int = 5
    """Pixels of background on either side of a peak, for two low-passed values at a distance of three pixels."""
    tail: float = 4.0  # range of sums with Gaussian weights, in sigmas: further weights are below 0.0004 of the largest
    background: float = 3.0
    """Distance of the background from a peak's middle, in sigmas: a Gaussian has fallen to 0.011 of its height."""
    low_pass: float = 3.5  # range of the low-pass, in sigmas: its last weight is below 0.0022 of the largest


WINDOW_RULE = WindowRule()

FIRST = -1
"""Order of `SearchRules` for the rule `PeakRule.FIRST`."""
STRONGEST = 0
"""Order of `SearchRules` for the rules `PeakRule.STRONGEST` and `PeakRule.DIRECT`."""
LAST = 1
"""Order of `SearchRules` for the rule `PeakRule.LAST`."""


class SearchRules(NamedTuple):
    """Options of the search; lengths in px, heights in grey levels."""

    # A window consists of a block and ``half`` pixels on either side.
    half: int
    block: int
    smoothing: float  # sigma of the low-pass
    share: float
    """Height of a second peak, as a fraction of the first one's, that makes a window crowded. For the strongest stripe
    the whole window is searched, otherwise the pixels used."""
    order: int  # rule for several stripes: `FIRST`, `STRONGEST` or `LAST`
    # Range of a stripe's sigma.
    narrowest: float
    widest: float
    # Least height of a block, and of a peak after the low-pass; lower ones are noise.
    coarse: float
    fine: float
    bright: float  # least height of a peak that is too wide to be measured and not haze


LANES = 64
"""Number of windows that are measured together: a multiple of the width of vector units."""


class PeakWindow(NamedTuple):
    """Peaks in M windows of W pixels, in groups of `LANES`, in the form for compiled code.

    Positions are in px from the window's first pixel, heights in grey levels.
    """

    start: np.ndarray  # (M,) int; first pixel of each window on its line
    window: np.ndarray
    """(ceil(M / LANES), W, LANES) float32; pixels of groups of windows; beyond the image the border pixel is
    repeated."""
    middle: np.ndarray  # (M,) float32; midpoint of the half-height crossings
    sigma: np.ndarray  # (M,) float32; half-height width divided by 2.355, without the low-pass (variances add)
    reach: np.ndarray  # (M,) float32; number of pixels from ``middle`` to the first background pixel
    # (M,) float32; background at ``middle``, and its slope per px, from the flanks beyond ``reach``.
    base: np.ndarray
    slope: np.ndarray
    height: np.ndarray
    """(M,) float32; height of the top above ``base``; above the lowest surroundings unless the peak is closed."""
    smoothing: float  # sigma of the low-pass, px

    @classmethod
    def empty(cls, count: int, size: int, smoothing: float) -> PeakWindow:
        """Allocate ``count`` windows of ``size`` pixels."""
        numbers = np.empty((6, count), np.float32)
        window = np.empty((-(-count // LANES), size, LANES), np.float32)
        return cls(np.empty(count, np.intp), window, *numbers, smoothing=smoothing)

    def select(self, which: np.ndarray) -> PeakWindow:
        """Return the windows selected by a boolean mask or by indices."""
        which = np.flatnonzero(which) if which.dtype == np.bool_ else which
        chosen = PeakWindow.empty(len(which), self.window.shape[1], self.smoothing)
        _copy_windows(self, which, chosen)
        return chosen

    def first(self, count: int) -> PeakWindow:
        """Return the first ``count`` windows."""
        start, window, *numbers, smoothing = self
        groups = -(-count // LANES)
        return PeakWindow(start[:count], window[:groups], *(each[:count] for each in numbers), smoothing=smoothing)

    def smooth(self) -> np.ndarray:
        """Return the windows (groups, W, LANES) float32 after the low-pass."""
        smooth = np.empty_like(self.window)
        _smooth_windows(self.window, low_pass(self.smoothing), smooth)
        return smooth

    def kernel_sigma(self) -> np.ndarray:
        """Return the sigma (M,) float32 of the Gaussian weight for each peak."""
        return np.maximum(self.sigma, np.float32(WINDOW_RULE.least_kernel))


class PeakShape(NamedTuple):
    """Further properties of M peaks for the search, as arrays (M,)."""

    top: np.ndarray  # int32; highest pixel after the low-pass
    closed: np.ndarray  # bool; both half-height crossings are in the window
    crowded: np.ndarray
    """bool; the profile rises again outside the crossings: above half height, or to the required fraction of the height
    after a valley of half its own height."""


_FLOATS = 6
"""Number of rows of lanes with values of the peaks, from `_HIGHEST` to `_BESIDE`."""
_HIGHEST = 0 * LANES
_GROUND = 1 * LANES
"""Lowest surroundings."""
_LEAST = 2 * LANES
"""Least value of one side."""
_LEVEL = 3 * LANES
"""Half height."""
_BESIDE = 4 * LANES
"""Highest value outside the crossings."""

_WHOLES = 5
"""Number of rows of lanes with pixels of the peaks, from `_TOP` to `_END`."""
_TOP = 0 * LANES
_LEFT = 1 * LANES
"""Last pixel before the peak below half height."""
_RIGHT = 2 * LANES
"""First pixel after the peak below half height."""
_BEGIN = 3 * LANES
_END = 4 * LANES
"""Range in which a second peak makes the window crowded."""


class Buffers(NamedTuple):
    """Memory for the measurement of a group of peaks.

    Compiled code takes its arrays as arguments, because Numba compiles longest for arrays made in compiled code.
    """

    kernel: np.ndarray
    smooth: np.ndarray  # (W, LANES) float32
    values: np.ndarray  # float32, rows of lanes; flat, so that the compiler knows that they do not overlap
    pixels: np.ndarray  # int32, rows of lanes

    @classmethod
    def for_windows(cls, peaks: PeakWindow) -> Buffers:
        """Allocate memory for windows."""
        smooth, values = np.empty(peaks.window.shape[1:], np.float32), np.empty(_FLOATS * LANES, np.float32)
        return cls(low_pass(peaks.smoothing), smooth, values, np.empty(_WHOLES * LANES, np.int32))


@compiled_part
def cut_window(profiles: np.ndarray, line: int, start: int, out: np.ndarray) -> None:
    """Copy pixels of a line of the profiles (N, L) from `start` on; beyond the image the border pixel is repeated."""
    last = profiles.shape[0] - 1
    if start >= 0 and start + out.size - 1 <= last:
        for k in range(out.size):
            out[k] = profiles[start + k, line]
    else:
        for k in range(out.size):
            out[k] = profiles[min(max(start + k, 0), last), line]


@compiled_part
def filter_windows(window: np.ndarray, kernel: np.ndarray, lanes: int, out: np.ndarray) -> None:
    """Filter windows (W, LANES) with a symmetric low-pass of 2 R + 1 weights; their border pixels are repeated."""
    last, reach = window.shape[0] - 1, kernel.size // 2
    for x in range(last + 1):
        weight = kernel[reach]
        for k in range(lanes):
            out[x, k] = weight * window[x, k]
        for j in range(reach):
            weight, before, after = kernel[j], max(x - reach + j, 0), min(x + reach - j, last)
            for k in range(lanes):
                out[x, k] += weight * (window[before, k] + window[after, k])


@compiled_part
def measure_group(
    group: int, lanes: int, count: int, rules: SearchRules, buffers: Buffers, peaks: PeakWindow, shape: PeakShape
) -> None:
    """Measure the first peaks of a group of windows on lines of ``count`` pixels.

    The windows may extend beyond the image. The peak is the highest pixel of the central block and half a block on
    either side.
    """
    half, block, smooth, values, pixels = rules.half, rules.block, buffers.smooth, buffers.values, buffers.pixels
    size, first, m0 = smooth.shape[0], half - block // 2, group * LANES
    filter_windows(peaks.window[group], buffers.kernel, lanes, smooth)
    for k in range(lanes):
        values[_HIGHEST + k], pixels[_TOP + k] = smooth[first, k], np.int32(first)
    for x in range(first + 1, first + 2 * block):
        for k in range(lanes):
            higher = smooth[x, k] > values[_HIGHEST + k]
            pixels[_TOP + k] = np.int32(x) if higher else pixels[_TOP + k]
            values[_HIGHEST + k] = max(values[_HIGHEST + k], smooth[x, k])
    # Repeated border pixels may belong to the stripe: use only sides inside the image.
    for k in range(lanes):
        values[_GROUND + k] = np.float32(-np.inf)
    for side in range(2):
        begin = side * (size - block)
        for k in range(lanes):
            values[_LEAST + k] = smooth[begin, k]
        for x in range(begin + 1, begin + block):
            for k in range(lanes):
                values[_LEAST + k] = min(values[_LEAST + k], smooth[x, k])
        for k in range(lanes):
            inside = peaks.start[m0 + k] + begin >= 0 and peaks.start[m0 + k] + begin + block <= count
            least = values[_LEAST + k] if inside else np.float32(-np.inf)
            values[_GROUND + k] = max(values[_GROUND + k], least)
    for k in range(lanes):
        values[_LEVEL + k] = values[_GROUND + k] + np.float32(0.5) * (values[_HIGHEST + k] - values[_GROUND + k])
        pixels[_LEFT + k], pixels[_RIGHT + k] = np.int32(-1), np.int32(size)
    for x in range(size):
        for k in range(lanes):
            below, top = smooth[x, k] < values[_LEVEL + k], pixels[_TOP + k]
            pixels[_LEFT + k] = np.int32(x) if below and x < top else pixels[_LEFT + k]
            pixels[_RIGHT + k] = min(pixels[_RIGHT + k], np.int32(x) if below and x > top else np.int32(size))
    for k in range(lanes):
        _measure_peak(k, m0 + k, half, rules, smooth, values, pixels, peaks, shape)
    for x in range(size):
        for k in range(lanes):
            before = x <= pixels[_LEFT + k] and x >= pixels[_BEGIN + k]
            beside = before or (x >= pixels[_RIGHT + k] and x < pixels[_END + k])
            values[_BESIDE + k] = max(values[_BESIDE + k], smooth[x, k] if beside else np.float32(-np.inf))
    for k in range(lanes):
        ground, rise = values[_GROUND + k], values[_HIGHEST + k] - values[_GROUND + k]
        crowded = rise > 0 and values[_BESIDE + k] >= ground + np.float32(rules.share) * rise
        if crowded:
            # A monotonic tail is no second stripe.
            left, right, begin, end = pixels[_LEFT + k], pixels[_RIGHT + k], pixels[_BEGIN + k], pixels[_END + k]
            crowded = _rises_again(smooth, k, left, begin - 1, -1, ground, rise, rules)
            crowded |= _rises_again(smooth, k, right, end, 1, ground, rise, rules)
        shape.crowded[m0 + k] = crowded


@compiled_inline
def _measure_peak(
    k: int,
    m: int,
    half: int,
    rules: SearchRules,
    smooth: np.ndarray,
    values: np.ndarray,
    pixels: np.ndarray,
    peaks: PeakWindow,
    shape: PeakShape,
) -> None:
    """Measure the peak m of lane k from its crossings of the half height."""
    size, top, left, right = smooth.shape[0], pixels[_TOP + k], pixels[_LEFT + k], pixels[_RIGHT + k]
    ground, highest, level = values[_GROUND + k], values[_HIGHEST + k], values[_LEVEL + k]
    # Otherwise the surroundings are as high: there is no peak.
    rises, zero = highest > ground, np.float32(0.0)
    closed = left >= 0 and right < size and rises
    x_left = np.float32(left) + _interpolate_level(smooth[max(left, 0), k], smooth[left + 1, k], level)
    x_right = np.float32(right) - _interpolate_level(smooth[min(right, size - 1), k], smooth[right - 1, k], level)
    middle = np.float32(0.5) * (x_left + x_right)
    smooth_sigma = (x_right - x_left) * np.float32(1.0 / FWHM_PER_SIGMA)
    squared = max(smooth_sigma * smooth_sigma - np.float32(rules.smoothing * rules.smoothing), zero)
    reach = min(math.ceil(np.float32(WINDOW_RULE.background) * smooth_sigma), half - WINDOW_RULE.flank)
    near = math.floor(middle + np.float32(0.5))
    before = _flank(smooth, k, near - reach - WINDOW_RULE.flank + 1)
    after = _flank(smooth, k, near + reach - 1)
    slope = (after - before) / np.float32(2 * reach + WINDOW_RULE.flank - 2)
    base = np.float32(0.5) * (before + after) + slope * (middle - np.float32(near))
    extent = size if rules.order == STRONGEST else reach + WINDOW_RULE.flank - 1
    pixels[_BEGIN + k], pixels[_END + k] = max(near - extent, 0), min(near + extent + 1, size)
    values[_BESIDE + k] = np.float32(-np.inf)
    shape.top[m], shape.closed[m] = top, closed
    peaks.middle[m] = middle if rises else np.float32(top)
    peaks.sigma[m] = np.sqrt(squared) if rises else zero
    peaks.reach[m] = np.float32(reach) if rises else zero
    peaks.base[m] = base if rises else ground
    peaks.slope[m] = slope if rises else zero
    peaks.height[m] = (highest - (base if closed else ground)) if rises else zero


@compiled
def _smooth_windows(window: np.ndarray, kernel: np.ndarray, out: np.ndarray) -> None:
    """Filter all groups of windows."""
    for group in range(window.shape[0]):
        filter_windows(window[group], kernel, LANES, out[group])


@compiled
def _copy_windows(peaks: PeakWindow, which: np.ndarray, out: PeakWindow) -> None:
    """Copy chosen windows."""
    for m in range(which.size):
        chosen = which[m]
        group, k, to_group, to_k = chosen // LANES, chosen % LANES, m // LANES, m % LANES
        for x in range(out.window.shape[1]):
            out.window[to_group, x, to_k] = peaks.window[group, x, k]
        out.start[m], out.middle[m], out.sigma[m] = peaks.start[chosen], peaks.middle[chosen], peaks.sigma[chosen]
        out.reach[m], out.base[m] = peaks.reach[chosen], peaks.base[chosen]
        out.slope[m], out.height[m] = peaks.slope[chosen], peaks.height[chosen]


@compiled_part
def _rises_again(
    values: np.ndarray, k: int, first: int, end: int, step: int, ground: float, rise: float, rules: SearchRules
) -> bool:
    """Return True if the profile of a lane outside a peak reaches half height, or the required fraction after a valley.

    The valley is at most half as high as the values after it. They must exceed it by at least ``fine``, the noise
    limit.
    """
    level, share, fine = np.float32(0.5) * rise, np.float32(rules.share) * rise, np.float32(rules.fine)
    lowest, found = np.float32(np.inf), rise < 0
    for x in range(first, end, step):
        lowest, above = min(lowest, values[x, k]), values[x, k] - ground
        found |= above >= level or (above >= share and values[x, k] - lowest >= max(np.float32(0.5) * above, fine))
    return bool(found)


@compiled_part
def _interpolate_level(low: np.floating, high: np.floating, level: np.floating) -> np.float32:
    """Return the position, from 0 to 1, of a level on the straight line between two neighbouring pixels."""
    return np.float32(min(max((level - low) / max(high - low, np.float32(1e-6)), np.float32(0.0)), np.float32(1.0)))


@compiled_part
def _flank(smooth: np.ndarray, k: int, first: int) -> np.float32:
    """Return the background in a lane's flank: the lower of two low-passed values, to ignore hot pixels."""
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
    """Compute moments M0, M1, M2 (3, M) of the windows above `base`, weighted at `centre`; see `zero_crossing`."""
    half, last = np.float32(0.5), peak.window.shape[1] - 1
    for m in range(centre.size):
        ground, middle, inverse = peak.base[m], centre[m], np.float32(1.0) / sigma[m]
        # The centre may be outside its window.
        reach, near = math.ceil(np.float32(WINDOW_RULE.tail) * sigma[m]), min(max(math.floor(middle + half), 0), last)
        m0, m1, m2 = np.float32(0.0), np.float32(0.0), np.float32(0.0)
        for x in range(max(near - reach, 0), min(near + reach, last) + 1):
            t = (np.float32(x) - middle) * inverse
            value = exponential(-half * t * t) * (peak.window[m // LANES, x, m % LANES] - ground)
            m0, m1, m2 = m0 + value, m1 + value * t, m2 + value * t * t
        moments[0, m], moments[1, m], moments[2, m] = m0, m1, m2


@compiled_part
def exponential(x: np.float32) -> np.float32:
    """Return e^x as (e^(x / 16))^16, which vector units can compute.

    The relative error is below 2e-5 for |x| < 5; below x = -12 the value of e^-12 is returned.
    """
    y = max(x, np.float32(-12.0)) * np.float32(1.0 / 16.0)
    rest = np.float32(1 / 6) + y * (np.float32(1 / 24) + y * np.float32(1 / 120))
    power = np.float32(1.0) + y * (np.float32(1.0) + y * (np.float32(0.5) + y * rest))
    power *= power
    power *= power
    power *= power
    return power * power


@compiled_part
def covered_fraction(u: float, half: float) -> float | np.floating:
    """Return the fraction of a pixel at distance u from the centre that is within `half` of the centre."""
    return min(max(half + np.float32(0.5) - abs(u), np.float32(0.0)), np.float32(1.0))
