"""Window around a peak of a profile line, with the height, width and background of the peak."""

from __future__ import annotations

import math
from functools import lru_cache
from typing import NamedTuple

import cv2
import numpy as np

from uwlts.runtime.compiled import compiled_inline, compiled_part

FWHM_PER_SIGMA = 2.0 * math.sqrt(2.0 * math.log(2.0))
"""Full width at half maximum of a Gaussian, divided by its standard deviation."""

CONVERGED_PX = 1e-4
"""Step of a centre below which methods that iterate stop; on noisy stripes each step is about a fifth of the last."""


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

FIRST = -1  # order of `SearchRules` for the rule `PeakRule.FIRST`
STRONGEST = 0  # order of `SearchRules` for the rules `PeakRule.STRONGEST` and `PeakRule.DIRECT`
LAST = 1  # order of `SearchRules` for the rule `PeakRule.LAST`


_PAIRS = 4  # pairs of weights of the low-pass in one pass over a window


class SearchRules(NamedTuple):
    """Options of the search; lengths in px, heights in grey levels."""

    # A window consists of a block and ``half`` pixels on either side.
    half: int
    block: int
    smoothing: float  # sigma of the low-pass
    share: float
    """Height of a second peak, as a fraction of the first one's, that makes a window crowded. For the strongest
    stripe the whole window is searched, otherwise the pixels used."""
    order: int  # rule for several stripes: `FIRST`, `STRONGEST` or `LAST`
    # Range of a stripe's sigma.
    narrowest: float
    widest: float
    # Least height of a block, and of a peak after the low-pass; lower ones are noise
    coarse: float
    fine: float
    bright: float  # least height of a peak that is too wide to be measured and not haze


class Peak(NamedTuple):
    """Peak in a window; positions in px from the window's first pixel, heights in grey levels."""

    top: int  # highest pixel after the low-pass
    middle: np.floating  # midpoint of the half-height crossings
    sigma: float | np.floating  # half-height width divided by 2.355, without the low-pass (variances add)
    reach: int  # number of pixels from ``middle`` to the first background pixel
    # Background at ``middle``, and its slope per px, from the flanks beyond ``reach``
    base: np.floating
    slope: np.floating
    height: np.floating  # height of the top above ``base``; above the lowest surroundings unless ``closed``
    closed: bool  # both half-height crossings are in the window
    crowded: np.bool_
    """The profile rises again outside the crossings: above half height, or to the required fraction of the height
    after a valley of half its own height."""


class PeakWindow(NamedTuple):
    """Peaks in M windows of W pixels, in the form for compiled code."""

    start: np.ndarray  # (M,); first pixel of each window on its line
    window: np.ndarray  # (M, W) float32; pixels; beyond the image the border pixel is repeated
    # (M,) float32; see `Peak`.
    middle: np.ndarray
    sigma: np.ndarray
    reach: np.ndarray
    base: np.ndarray
    slope: np.ndarray
    height: np.ndarray
    smoothing: float  # sigma of the low-pass, px

    @classmethod
    def empty(cls, count: int, rules: SearchRules) -> PeakWindow:
        """Allocate windows for ``count`` peaks."""
        window = np.empty((count, 2 * rules.half + rules.block), np.float32)
        numbers = np.empty((6, count), np.float32)
        return cls(np.empty(count, np.intp), window, *numbers, smoothing=rules.smoothing)

    def select(self, which: np.ndarray | slice) -> PeakWindow:
        """Return the windows selected by a boolean mask, by indices or by a slice."""
        *values, smoothing = self
        return PeakWindow(*(value[which] for value in values), smoothing=smoothing)

    def smooth(self) -> np.ndarray:
        """Return the windows (M, W) float32 after the low-pass."""
        kernel = low_pass(self.smoothing)
        return cv2.sepFilter2D(self.window, cv2.CV_32F, kernel, np.ones(1, np.float32), borderType=cv2.BORDER_REPLICATE)

    def kernel_sigma(self) -> np.ndarray:
        """Return the sigma (M,) float32 of the Gaussian weight for each peak."""
        return np.maximum(self.sigma, np.float32(WINDOW_RULE.least_kernel))


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
def filter_window(pixels: np.ndarray, size: int, kernel: np.ndarray, out: np.ndarray) -> None:
    """Filter a window of ``size`` pixels with a symmetric low-pass of 2 R + 1 weights (`low_pass`).

    ``pixels`` has R further elements on either side, which are overwritten with the window's border pixels. Elements of
    ``out`` beyond the window's size have no meaning; they fill vector units.
    """
    reach = kernel.size // 2
    middle, behind, weight = pixels[reach:], pixels[reach + size :], kernel[reach]
    first, last = middle[0], middle[size - 1]
    for k in range(reach):
        pixels[k], behind[k] = first, last
    for k in range(out.size):
        out[k] = weight * middle[k]
    # Four pairs of weights in one pass: more passes over so few pixels would take longer.
    for j in range(0, reach, _PAIRS):
        before, after = pixels[j:], pixels[2 * reach - j - _PAIRS + 1 :]
        w0, w1, w2, w3 = kernel[j], kernel[j + 1], kernel[j + 2], kernel[j + 3]
        for k in range(out.size):
            outer = w0 * (before[k] + after[k + 3]) + w1 * (before[k + 1] + after[k + 2])
            out[k] += outer + w2 * (before[k + 2] + after[k + 1]) + w3 * (before[k + 3] + after[k])


@compiled_part
def measure_peak(smooth: np.ndarray, start: int, count: int, rules: SearchRules) -> Peak:
    """Measure the peak in the filtered window `smooth`, which starts at pixel `start` of `count`.

    The window may extend beyond the image. The peak is the highest pixel of the central block and half a block on
    either side.
    """
    half, block = rules.half, rules.block
    size, first = smooth.size, half - block // 2
    highest = find_greatest(smooth, first, first + 2 * block)
    top = first
    while smooth[top] != highest:
        top += 1
    # Repeated border pixels may belong to the stripe: use only sides inside the image.
    ground = np.float32(-np.inf)
    for side in range(2):
        begin = side * (size - block)
        if start + begin >= 0 and start + begin + block <= count:
            ground = max(ground, _find_least(smooth, begin, begin + block))
    rise = highest - ground
    level = ground + np.float32(0.5) * rise

    if rise <= 0:
        # The surroundings are as high: there is no peak.
        zero = np.float32(0.0)
        return Peak(top, np.float32(top), zero, 0, ground, zero, zero, False, rise > 0)

    left, right = top, top
    while left >= 0 and smooth[left] >= level:
        left -= 1
    while right < size and smooth[right] >= level:
        right += 1
    closed = left >= 0 and right < size
    x_left = np.float32(left) + _interpolate_level(smooth[max(left, 0)], smooth[left + 1], level)
    x_right = np.float32(right) - _interpolate_level(smooth[min(right, size - 1)], smooth[right - 1], level)
    middle = np.float32(0.5) * (x_left + x_right)
    smooth_sigma = (x_right - x_left) * np.float32(1.0 / FWHM_PER_SIGMA)
    sigma = math.sqrt(max(smooth_sigma * smooth_sigma - np.float32(rules.smoothing * rules.smoothing), np.float32(0.0)))

    reach = min(math.ceil(np.float32(WINDOW_RULE.background) * smooth_sigma), half - WINDOW_RULE.flank)
    near = math.floor(middle + np.float32(0.5))
    before = _estimate_flank(smooth, near - reach - WINDOW_RULE.flank + 1)
    after = _estimate_flank(smooth, near + reach - 1)
    slope = (after - before) / np.float32(2 * reach + WINDOW_RULE.flank - 2)
    base = np.float32(0.5) * (before + after) + slope * (middle - np.float32(near))
    extent = size if rules.order == STRONGEST else reach + WINDOW_RULE.flank - 1
    begin, end = max(near - extent, 0), min(near + extent + 1, size)
    beside = max(find_greatest(smooth, begin, left + 1), find_greatest(smooth, right, end))
    crowded = beside >= ground + np.float32(rules.share) * rise
    if crowded:
        # A monotonic tail is no second stripe.
        crowded = beside < ground
        for side in (-1, 1):
            first, last = (left, begin - 1) if side < 0 else (right, end)
            crowded |= _has_rise(smooth, first, last, side, ground, rise, rules)
    return Peak(top, middle, sigma, reach, base, slope, highest - (base if closed else ground), closed, crowded)


@compiled_part
def find_greatest(values: np.ndarray, first: int, end: int) -> np.float32:
    """Return the maximum of ``values[first:end]``; -inf if empty."""
    result, part = np.float32(-np.inf), values[first:end]
    for k in range(part.size):
        result = max(result, part[k])
    return result


@compiled_inline
def _find_least(values: np.ndarray, first: int, end: int) -> np.float32:
    """Return the minimum of ``values[first:end]``; inf if empty."""
    result, part = np.float32(np.inf), values[first:end]
    for k in range(part.size):
        result = min(result, part[k])
    return result


@compiled_inline
def _has_rise(
    values: np.ndarray, first: int, end: int, step: int, ground: np.floating, rise: np.floating, rules: SearchRules
) -> np.bool_:
    """Return True if the profile outside a peak reaches half height, or the required fraction after a valley.

    The valley is at most half as high as the values after it. They must exceed it by at least ``fine``, the noise
    limit.
    """
    level, share, fine = np.float32(0.5) * rise, np.float32(rules.share) * rise, np.float32(rules.fine)
    lowest, found = np.float32(np.inf), rise < 0
    for k in range(first, end, step):
        lowest, above = min(lowest, values[k]), values[k] - ground
        found |= above >= level or (above >= share and values[k] - lowest >= max(np.float32(0.5) * above, fine))
    return found


@compiled_part
def _interpolate_level(low: np.floating, high: np.floating, level: np.floating) -> np.float32:
    """Return the position, from 0 to 1, of a level on the straight line between two neighbouring pixels."""
    return np.float32(min(max((level - low) / max(high - low, np.float32(1e-6)), np.float32(0.0)), np.float32(1.0)))


@compiled_part
def _estimate_flank(smooth: np.ndarray, first: int) -> np.float32:
    """Return the background in a flank: the lower of two low-passed values, to ignore hot pixels."""
    first = min(max(first, 0), smooth.size - WINDOW_RULE.flank)
    return min(smooth[first + 1], smooth[first + WINDOW_RULE.flank - 1])


@lru_cache(maxsize=16)
def low_pass(sigma: float) -> np.ndarray:
    """Return Gaussian weights of sum 1, with zeros at both ends for a reach of a multiple of `_PAIRS`."""
    reach = math.ceil(WINDOW_RULE.low_pass * sigma)
    weight = np.exp(-0.5 * (np.arange(-reach, reach + 1) / sigma) ** 2)
    return np.pad(weight / weight.sum(), -reach % _PAIRS).astype(np.float32)


@lru_cache(maxsize=16)
def noise_gain(sigma: float) -> float:
    """Return the standard deviation of white unit noise after the low-pass."""
    return float(np.sqrt(np.sum(low_pass(sigma) ** 2)))


@compiled_part
def gaussian_moments(
    peak: PeakWindow, number: int, centre: np.float32
) -> tuple[np.float32, np.float32, np.float32, np.float32]:
    """Return moments M0, M1, M2 of a window above `base`, weighted at ``centre``, and the weight's sigma.

    See `uwlts.stripe.methods.zero_crossing` for the moments.
    """
    sigma = max(peak.sigma[number], np.float32(WINDOW_RULE.least_kernel))
    half, last, inverse = np.float32(0.5), peak.window.shape[1] - 1, np.float32(1.0) / sigma
    # The centre may be outside its window.
    reach, near = math.ceil(np.float32(WINDOW_RULE.tail) * sigma), min(max(math.floor(centre + half), 0), last)
    first, end = max(near - reach, 0), min(near + reach, last) + 1
    pixels, start, ground = peak.window[number, first:end], np.float32(first) - centre, peak.base[number]
    m0, m1, m2 = np.float32(0.0), np.float32(0.0), np.float32(0.0)
    for k in range(pixels.size):
        t = (start + np.float32(k)) * inverse
        value = exponential(-half * t * t) * (pixels[k] - ground)
        m0, m1, m2 = m0 + value, m1 + value * t, m2 + value * t * t
    return m0, m1, m2, sigma


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
