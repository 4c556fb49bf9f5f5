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
from uwlts.stripe.peak_window import PeakWindow, gaussian_moments

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
    _find_best_heights(peak, centre, heights)
    return centre, heights


@compiled
def _find_best_heights(peak: PeakWindow, centre: np.ndarray, result: np.ndarray) -> None:
    for m in range(centre.size):
        sigma = max(peak.sigma[m], np.float32(_ONE_PIXEL))
        total, _, _, width = gaussian_moments(peak, m, centre[m])
        # Sum over the product of two Gaussians, solved for the height of the first.
        inverse = np.float32(1.0) / (sigma * sigma) + np.float32(1.0) / (width * width)
        result[m] = total * math.sqrt(np.float32(0.5 / math.pi) * inverse)
