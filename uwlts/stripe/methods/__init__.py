"""Methods that place the centre of a stripe: each module of this package is one, found by its name.

A method ``some-name`` is the module ``some_name`` with a function ``centres(peak)``. It takes a `PeakWindow` of M
windows, whose linear background between the flanks it takes out, and returns the centres (M,) float32, px from the
windows' first pixel.
"""

from __future__ import annotations

import math
import pkgutil
from collections.abc import Callable
from functools import lru_cache
from importlib import import_module

import numpy as np

from uwlts.stripe.peak_window import PeakWindow, gaussian_moments


@lru_cache
def method_names() -> tuple[str, ...]:
    """Names of all methods, in alphabetical order."""
    return tuple(sorted(module.name.replace("_", "-") for module in pkgutil.iter_modules(__path__)))


def place_centre(method: str, peak: PeakWindow) -> tuple[np.ndarray, np.ndarray]:
    """Centre (M,) float32 of the peak in each window, px from its first pixel, and amplitude as of `amplitudes`."""
    centre = _method(method)(peak)
    return centre, amplitudes(peak, centre)


def amplitudes(peak: PeakWindow, centre: np.ndarray) -> np.ndarray:
    """Height (M,) float32, in grey levels, of the best-fitting Gaussian of each peak's sigma at the centre (M,)."""
    sigma, kernel = np.maximum(peak.sigma, np.float32(0.3)), peak.kernel_sigma()
    moments = np.empty((centre.size, 3), np.float32)
    gaussian_moments(peak, centre, kernel, moments)
    # The sum of the product of two Gaussians over the pixels, solved for the height of the first.
    joint = 0.5 / math.pi * (1 / (sigma * sigma) + 1 / (kernel * kernel))
    return moments[:, 0] * np.sqrt(joint)


@lru_cache
def _method(name: str) -> Callable[[PeakWindow], np.ndarray]:
    return import_module(f"{__name__}.{name.replace('-', '_')}").centres
