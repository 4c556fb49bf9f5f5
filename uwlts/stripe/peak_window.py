"""A window about a peak of a profile line: height, width and background of what stands in it."""

from __future__ import annotations

import math
from functools import lru_cache
from typing import NamedTuple

import cv2
import numpy as np

from uwlts.runtime.compiled import compiled, compiled_inline, compiled_part

FWHM_PER_SIGMA = 2.0 * math.sqrt(2.0 * math.log(2.0))
"""Full width at half maximum of a Gaussian over its standard deviation."""

LEAST_KERNEL = 1.0
"""Sigma of the narrowest weight, px. A narrower one rests on too few pixels: for a stripe of sigma 0.7 px the centre
would err by 0.015 px with the pixel phase instead of 0.005."""

FLANK = 5
"""Pixels of background taken on either side of a peak: room for two low-passed values three pixels apart."""

TAIL_SIGMAS = 4.0
"""Sigmas to which Gaussian weights are summed; beyond, each is below 0.0004 of the highest."""

_PEAK_SIGMAS = 3.0
"""Sigmas from a peak's middle to its background, where a Gaussian has fallen to 0.011 of its height."""

_LOW_PASS_SIGMAS = 3.5
"""Sigmas to which the low-pass reaches; its last weight is below 0.0022 of the middle one."""

FIRST = -1
STRONGEST = 0
LAST = 1
"""Which of several stripes on a line counts, as `SearchRules` has it for compiled code."""


class SearchRules(NamedTuple):
    """Options of the search: lengths in px, heights in grey levels.

    A window is ``block`` pixels and ``half`` pixels on either side, ``smoothing`` the sigma of the low-pass. ``order``
    says which of several stripes counts: `FIRST`, `STRONGEST` or `LAST`. A second peak of ``share`` of the first one's
    height makes a window crowded; for the strongest it is looked for in the whole window, else only as far as the
    pixels used reach. A stripe's sigma lies between ``narrowest`` and ``widest``. Blocks lower than ``coarse`` and
    peaks lower than ``fine`` are noise; what is too wide is noticed from ``bright`` on.
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


class Peak(NamedTuple):
    """What stands in a window; positions in px from the window's first pixel, heights in grey levels.

    ``top`` is the highest pixel after the low-pass; ``middle`` lies between the half-height crossings; ``sigma`` is the
    half-height width over 2.355 with the low-pass taken out (variances add); ``reach`` the whole number of pixels from
    ``middle`` to the first background pixel; ``base`` the background at ``middle`` and ``slope`` its rise per px, from
    the flanks beyond ``reach``; ``height`` that of the top above ``base``, or above the lowest surroundings where not
    ``closed``: both half-height crossings lie in the window; ``crowded`` where something outside the crossings rises
    again to the given share of the peak: above its half height, or out of a valley of half its own height.
    """

    top: int
    middle: np.floating
    sigma: float | np.floating
    reach: int
    base: np.floating
    slope: np.floating
    height: np.floating
    closed: bool
    crowded: np.bool_


class PeakWindow(NamedTuple):
    """Peaks in M windows of W pixels, as compiled code takes them.

    ``start`` (M,) int is the first pixel's position on its line, ``window`` (M, W) float32 the pixels, with the border
    pixel repeated beyond the border, ``smoothing`` the sigma of the low-pass, px. All others are (M,) float32; see
    `Peak`.
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
        """Room for so many windows of so many pixels."""
        numbers = np.empty((6, count), np.float32)
        window = np.empty((count, size), np.float32)
        return cls(np.empty(count, np.intp), window, *numbers, smoothing=smoothing)

    def keep(self, which: np.ndarray) -> PeakWindow:
        """The windows chosen by a boolean mask or by their numbers."""
        *values, smoothing = self
        return PeakWindow(*(value[which] for value in values), smoothing=smoothing)

    def first(self, count: int) -> PeakWindow:
        """The first windows."""
        *values, smoothing = self
        return PeakWindow(*(value[:count] for value in values), smoothing=smoothing)

    def smooth(self) -> np.ndarray:
        """(M, W) float32: the windows after the low-pass."""
        kernel = low_pass(self.smoothing)
        return cv2.sepFilter2D(self.window, cv2.CV_32F, kernel, np.ones(1, np.float32), borderType=cv2.BORDER_REPLICATE)

    def kernel_sigma(self) -> np.ndarray:
        """(M,) float32: sigma of the Gaussian weight for each peak."""
        return np.maximum(self.sigma, np.float32(LEAST_KERNEL))


@compiled_part
def cut(profiles: np.ndarray, line: int, start: int, out: np.ndarray) -> None:
    """Pixels of one of the profiles (N, L) from `start` on, the border pixel repeated beyond the border."""
    last = profiles.shape[0] - 1
    if start >= 0 and start + out.size - 1 <= last:
        for k in range(out.size):
            out[k] = profiles[start + k, line]
    else:
        for k in range(out.size):
            out[k] = profiles[min(max(start + k, 0), last), line]


@compiled_part
def filtered(pixels: np.ndarray, kernel: np.ndarray, out: np.ndarray) -> None:
    """Low-pass of a window with a symmetric kernel of 2 R + 1 weights.

    ``pixels`` reach R further than the window on either side; what they hold there is replaced by its border pixels.
    """
    size, reach = out.size, kernel.size // 2
    middle = pixels[reach : reach + size]
    for k in range(reach):
        pixels[k], pixels[reach + size + k] = middle[0], middle[size - 1]
    for k in range(size):
        out[k] = kernel[reach] * middle[k]
    for j in range(reach):
        before, after = pixels[j : j + size], pixels[2 * reach - j : 2 * reach - j + size]
        for k in range(size):
            out[k] += kernel[j] * (before[k] + after[k])


@compiled_part
def measured(smooth: np.ndarray, start: int, count: int, rules: SearchRules) -> Peak:
    """What stands in the window `smooth`, which begins at pixel `start` of `count` and may run over the image border.

    The peak is sought in the block in the middle and half a block on either side.
    """
    half, block = rules.half, rules.block
    size, first = smooth.size, half - block // 2
    highest = greatest(smooth, first, first + 2 * block)
    top = first
    while smooth[top] != highest:
        top += 1
    # Repeated border pixels may belong to the stripe itself, so that only the other side shows the background.
    ground = np.float32(-np.inf)
    for side in range(2):
        begin = side * (size - block)
        if start + begin >= 0 and start + begin + block <= count:
            ground = max(ground, _least(smooth, begin, begin + block))
    rise = highest - ground
    level = ground + np.float32(0.5) * rise

    if rise <= 0:
        # Its surroundings are as high: nothing stands there.
        zero = np.float32(0.0)
        return Peak(top, np.float32(top), zero, 0, ground, zero, zero, False, rise > 0)

    left, right = top, top
    while left >= 0 and smooth[left] >= level:
        left -= 1
    while right < size and smooth[right] >= level:
        right += 1
    closed = left >= 0 and right < size
    x_left = np.float32(left) + _part(smooth[max(left, 0)], smooth[left + 1], level)
    x_right = np.float32(right) - _part(smooth[min(right, size - 1)], smooth[right - 1], level)
    middle = np.float32(0.5) * (x_left + x_right)
    smooth_sigma = (x_right - x_left) * np.float32(1.0 / FWHM_PER_SIGMA)
    sigma = math.sqrt(max(smooth_sigma * smooth_sigma - np.float32(rules.smoothing * rules.smoothing), np.float32(0.0)))

    reach = min(math.ceil(np.float32(_PEAK_SIGMAS) * smooth_sigma), half - FLANK)
    near = math.floor(middle + np.float32(0.5))
    before = _flank(smooth, near - reach - FLANK + 1)
    after = _flank(smooth, near + reach - 1)
    slope = (after - before) / np.float32(2 * reach + FLANK - 2)
    base = np.float32(0.5) * (before + after) + slope * (middle - np.float32(near))
    extent = size if rules.order == STRONGEST else reach + FLANK - 1
    begin, end = max(near - extent, 0), min(near + extent + 1, size)
    beside = max(greatest(smooth, begin, left + 1), greatest(smooth, right, end))
    crowded = beside >= ground + np.float32(rules.share) * rise
    if crowded:
        # A tail that falls steadily is no second stripe.
        crowded = beside < ground
        for side in (-1, 1):
            first, last = (left, begin - 1) if side < 0 else (right, end)
            crowded |= _rises_again(smooth, first, last, side, ground, rise, rules)
    return Peak(top, middle, sigma, reach, base, slope, highest - (base if closed else ground), closed, crowded)


@compiled_part
def greatest(values: np.ndarray, first: int, end: int) -> np.float32:
    """The greatest of some numbers; less than any where there are none."""
    result, part = np.float32(-np.inf), values[first:end]
    for k in range(part.size):
        result = max(result, part[k])
    return result


@compiled_inline
def _least(values: np.ndarray, first: int, end: int) -> np.float32:
    """The least of some numbers; more than any where there are none."""
    result, part = np.float32(np.inf), values[first:end]
    for k in range(part.size):
        result = min(result, part[k])
    return result


@compiled_inline
def _rises_again(
    values: np.ndarray, first: int, end: int, step: int, ground: np.floating, rise: np.floating, rules: SearchRules
) -> np.bool_:
    """Whether values, from a peak outwards, reach half its height, or the given share of it after a valley.

    The valley is half as high as they are themselves. What rises by less than ``fine`` out of it may be noise.
    """
    level, share, fine = np.float32(0.5) * rise, np.float32(rules.share) * rise, np.float32(rules.fine)
    lowest, found = np.float32(np.inf), rise < 0
    for k in range(first, end, step):
        lowest, above = min(lowest, values[k]), values[k] - ground
        found |= above >= level or (above >= share and values[k] - lowest >= max(np.float32(0.5) * above, fine))
    return found


@compiled_part
def _part(low: np.floating, high: np.floating, level: np.floating) -> np.float32:
    """Share of the way from one pixel to the next at which the straight line between them meets a level."""
    return np.float32(min(max((level - low) / max(high - low, np.float32(1e-6)), np.float32(0.0)), np.float32(1.0)))


@compiled_part
def _flank(smooth: np.ndarray, first: int) -> np.float32:
    """Background in a flank: the lower of two low-passed values three pixels apart, which no hot pixel raises."""
    first = min(max(first, 0), smooth.size - FLANK)
    return min(smooth[first + 1], smooth[first + FLANK - 1])


@lru_cache(maxsize=16)
def low_pass(sigma: float) -> np.ndarray:
    """Gaussian weights, sum 1."""
    reach = math.ceil(_LOW_PASS_SIGMAS * sigma)
    weight = np.exp(-0.5 * (np.arange(-reach, reach + 1) / sigma) ** 2)
    return (weight / weight.sum()).astype(np.float32)


@lru_cache(maxsize=16)
def noise_gain(sigma: float) -> float:
    """Standard deviation of white unit noise after the low-pass."""
    return float(np.sqrt(np.sum(low_pass(sigma) ** 2)))


@compiled
def gaussian_moments(peak: PeakWindow, centre: np.ndarray, sigma: np.ndarray, moments: np.ndarray) -> None:
    """M0, M1 and M2 (M, 3) of the windows above `base` under a Gaussian weight at `centre`; see `zero_crossing`."""
    count, size = peak.window.shape
    for m in range(count):
        pixels, ground, middle, width = peak.window[m], peak.base[m], float(centre[m]), float(sigma[m])
        reach, sharpness = math.ceil(TAIL_SIGMAS * width), 1.0 / (width * width)
        # A centre that has left its window has a sum all the same.
        near = min(max(math.floor(middle + 0.5), 0), size - 1)
        # A Gaussian by recurrence: the ratio of neighbouring values falls by the same factor from pixel to pixel.
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
def part_inside(u: float, half: float) -> float | np.floating:
    """Share of a pixel, u from the centre, that lies within `half` of it."""
    return min(max(half + np.float32(0.5) - abs(u), np.float32(0.0)), np.float32(1.0))
