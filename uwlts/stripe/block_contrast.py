"""Contrast of blocks of pixels: blocks that stick out of both their surroundings may hold a stripe.

A frame is reduced to the largest value and the background in blocks of a few pixels along each line, which is the
only work done on all pixels. A block sticks out by its largest value minus the larger of the background values two
blocks away on either side. Thus an edge between a dark and a bright region does not stick out, nor does a slope, and
hot pixels or a second stripe in the surroundings do no harm.
"""

from __future__ import annotations

import math
from functools import lru_cache
from statistics import NormalDist

import cv2
import numpy as np

from uwlts.runtime.compiled import compiled

_NOISE_SAMPLES = 1024

MEDIAN_SURROUNDINGS = NormalDist().inv_cdf(1.0 - (1.0 - math.sqrt(0.5)) ** 0.5)
"""Median of the larger of two smaller-of-two of unit Gaussian noise: each stays below x with 1 - (1 - P(x))^2."""


def block_extremes(profiles: np.ndarray, block: int) -> tuple[np.ndarray, np.ndarray]:
    """Largest value and background of each block of profiles (N, L): two arrays (ceil(N / block), L) of the same type.

    The largest of all pixels, and the smaller of two pixels half a block apart, which no hot pixel raises. The last
    block of a line may be smaller.
    """
    high, low = np.empty((2, math.ceil(profiles.shape[0] / block), profiles.shape[1]), profiles.dtype)
    _fill_extremes(profiles, block, high, low)
    return high, low


@compiled
def _fill_extremes(profiles: np.ndarray, block: int, high: np.ndarray, low: np.ndarray) -> None:
    """Fill the extremes of `block_extremes`, pixel by pixel as they lie in memory, which is what takes the time."""
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
    """Height of each block above its surroundings, grey levels, 0 or more; arrays as of `block_extremes`.

    At the ends of a line, where there is nothing two blocks away, the other side counts alone.
    """
    surroundings = np.empty_like(low)
    np.maximum(low[:-4], low[4:], out=surroundings[2:-2])
    surroundings[:2] = low[2:4]
    surroundings[-2:] = low[-4:-2]
    # OpenCV's difference of unsigned integers stops at 0 by itself.
    cv2.subtract(high, surroundings, dst=out)
    return out if out.dtype.kind == "u" else np.maximum(out, 0, out=out)


def noise_from_contrast(contrast: np.ndarray, block: int) -> float:
    """Standard deviation of the background noise per pixel, grey levels.

    The median contrast of all blocks, most of which hold no stripe, divided by its value for unit Gaussian noise. A
    background cut off at black is met better this way than by the deviation of single pixels.
    """
    sample = contrast.ravel()[:: max(1, contrast.size // _NOISE_SAMPLES)].copy()
    sample.partition(sample.size // 2)
    middle = sample[sample.size // 2]
    median = float(middle)
    if contrast.dtype.kind in "iu":
        # Whole grey levels make the plain median jump; read it off the cumulative histogram with straight bins.
        below, equal = np.count_nonzero(sample < middle), np.count_nonzero(sample == middle)
        median += (0.5 * sample.size - below) / equal - 0.5
    return max(median, 0.0) / _median_contrast(block)


@lru_cache
def _median_contrast(block: int) -> float:
    """Median contrast of a block of unit Gaussian noise: the largest of its pixels minus the surroundings."""
    return NormalDist().inv_cdf(0.5 ** (1.0 / block)) - MEDIAN_SURROUNDINGS
