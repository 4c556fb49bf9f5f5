"""Methods that locate the centre of a stripe: each module of this package is a method, found by its name.

A method ``some-name`` is the module ``some_name`` with a function ``centres(peak)``. This function takes a `PeakWindow`
of M windows and subtracts the linear background between the flanks. It returns the centres (M,) float32, px from the
first pixel of each window.
"""

from __future__ import annotations

import math
import pkgutil
from functools import lru_cache
from importlib import import_module

import numpy as np

from uwlts.runtime.compiled import compiled
from uwlts.stripe.peak_window import WINDOW_RULE, PeakWindow, exponential

_ONE_PIXEL = 0.3  # sigma, px, of light within one pixel (1 / sqrt 12, rounded), the narrowest stripe in an image


@lru_cache
def method_names() -> tuple[str, ...]:
    """Return the names of all methods in alphabetical order."""
    return tuple(sorted(module.name.replace("_", "-") for module in pkgutil.iter_modules(__path__)))


def place_centre(method: str, peak: PeakWindow) -> tuple[np.ndarray, np.ndarray]:
    """Return the centre (M,) float32 of each peak, px from its window's first pixel, and its amplitude.

    The amplitude is the height of the best-fitting Gaussian at the centre, grey levels.
    """
    if not peak.start.size:
        return np.empty(0, np.float32), np.empty(0, np.float32)
    centre = import_module(f"{__name__}.{method.replace('-', '_')}").centres(peak)
    heights = np.empty(centre.size, np.float32)
    _best_heights(peak, centre, heights)
    return centre, heights


@compiled
def _best_heights(peak: PeakWindow, centre: np.ndarray, result: np.ndarray) -> None:
    size = peak.window.shape[1]
    for m in range(centre.size):
        pixels, ground, middle = peak.window[m], peak.base[m], centre[m]
        sigma = max(peak.sigma[m], np.float32(_ONE_PIXEL))
        width = max(peak.sigma[m], np.float32(WINDOW_RULE.least_kernel))
        near = min(max(math.floor(middle + np.float32(0.5)), 0), size - 1)
        # Gaussian by recurrence on both sides: the ratio of neighbouring values decreases by a constant factor.
        sharpness, offset, half = np.float32(1.0) / (width * width), np.float32(near) - middle, np.float32(0.5)
        weight = exponential(-half * sharpness * offset * offset)
        after, before = exponential(-sharpness * (half + offset)), exponential(-sharpness * (half - offset))
        falling = after * before
        total, right, left = weight * (pixels[near] - ground), weight * after, weight * before
        for k in range(1, math.ceil(np.float32(WINDOW_RULE.tail) * width) + 1):
            if near + k < size:
                total += right * (pixels[near + k] - ground)
            if near - k >= 0:
                total += left * (pixels[near - k] - ground)
            after, before = after * falling, before * falling
            right, left = right * after, left * before
        # Sum over the product of two Gaussians, solved for the height of the first.
        joint = np.float32(0.5 / math.pi) * (np.float32(1.0) / (sigma * sigma) + sharpness)
        result[m] = total * math.sqrt(joint)
