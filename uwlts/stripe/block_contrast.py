"""Contrast of blocks of pixels: blocks brighter than both surroundings may contain a stripe.

A frame is reduced to the maximum and the background of blocks of a few pixels along each line. This is the only
operation on all pixels.

The contrast of a block is its maximum minus the larger background of the two blocks two steps away. Thus neither an
edge between a dark and a bright region nor a slope has contrast. Hot pixels or a second stripe in the surroundings do
not reduce the contrast of a stripe.
"""

from __future__ import annotations

import math
from functools import lru_cache
from statistics import NormalDist

import cv2
import numpy as np

from uwlts.runtime.compiled import compiled

_NOISE_SAMPLES = 1024
"""Number of blocks for the estimate of the noise."""

MEDIAN_SURROUNDINGS = NormalDist().inv_cdf(1.0 - (1.0 - math.sqrt(0.5)) ** 0.5)
"""Median of max(min(a, b), min(c, d)) for unit Gaussian noise: each minimum is below x with 1 - (1 - P(x))^2."""


def block_extremes(profiles: np.ndarray, block: int) -> tuple[np.ndarray, np.ndarray]:
    """Return the maximum and the background of each block of profiles (N, L), as two arrays (ceil(N / block), L).

    The background is the smaller of two pixels half a block apart, which a single hot pixel does not raise. The last
    block of a line may be smaller.
    """
    high, low = np.empty((2, math.ceil(profiles.shape[0] / block), profiles.shape[1]), profiles.dtype)
    _fill_extremes(profiles, block, high, low)
    return high, low


@compiled
def _fill_extremes(profiles: np.ndarray, block: int, high: np.ndarray, low: np.ndarray) -> None:
    """Fill the extremes of `block_extremes` in the order of the pixels in memory, which limits the speed."""
    count = profiles.shape[0]
    for first in range(0, count, block):
        largest, least = high[first // block], low[first // block]
        middle = first + min(block, count - first) // 2
        for n in range(first, min(first + block, count)):
            pixels = profiles[n]
            if n == first:
                for k in range(pixels.size):
                    largest[k] = least[k] = pixels[k]
            elif n == middle:
                for k in range(pixels.size):
                    largest[k], least[k] = max(largest[k], pixels[k]), min(least[k], pixels[k])
            else:
                for k in range(pixels.size):
                    largest[k] = max(largest[k], pixels[k])


def block_contrast(high: np.ndarray, low: np.ndarray, *, out: np.ndarray) -> np.ndarray:
    """Return the non-negative height of each block above its surroundings, grey levels; arrays as in `block_extremes`.

    At the ends of a line only one side has surroundings, which are used alone.
    """
    surroundings = np.empty_like(low)
    np.maximum(low[:-4], low[4:], out=surroundings[2:-2])
    surroundings[:2] = low[2:4]
    surroundings[-2:] = low[-4:-2]
    # OpenCV's difference of unsigned integers saturates at 0.
    cv2.subtract(high, surroundings, dst=out)
    return out if out.dtype.kind == "u" else np.maximum(out, 0, out=out)


def noise_from_contrast(contrast: np.ndarray, block: int) -> float:
    """Estimate the standard deviation of the background noise per pixel, grey levels.

    The median contrast of all blocks is divided by its value for unit Gaussian noise. Most blocks do not contain a
    stripe. For a background clipped at black, this estimate is more accurate than the deviation of single pixels.
    """
    sample = contrast.ravel()[:: max(1, contrast.size // _NOISE_SAMPLES)].copy()
    sample.partition(sample.size // 2)
    middle = sample[sample.size // 2]
    median = float(middle)
    if contrast.dtype.kind in "iu":
        # The median of integers is quantised: interpolate the cumulative histogram linearly.
        below, equal = np.count_nonzero(sample < middle), np.count_nonzero(sample == middle)
        median += (0.5 * sample.size - below) / equal - 0.5
    return max(median, 0.0) / _median_contrast(block)


@lru_cache
def _median_contrast(block: int) -> float:
    """Return the median contrast of a block of unit Gaussian noise."""
    return NormalDist().inv_cdf(0.5 ** (1.0 / block)) - MEDIAN_SURROUNDINGS
