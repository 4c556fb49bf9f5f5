"""Methods that locate the centre of a stripe: each module of this package is a method, found by its name.

A method ``some-name`` is the module ``some_name`` with a function ``centres(peak)``. This function takes a `PeakWindow`
of M windows and subtracts the linear background between the flanks. It returns the centres (M,) float32, px from the
first pixel of each window.
"""

from __future__ import annotations

import math
import pkgutil
from collections.abc import Callable
from functools import lru_cache
from importlib import import_module

import numpy as np

from uwlts.stripe.peak_window import PeakWindow, gaussian_moments

_ONE_PIXEL = 0.3
"""Sigma, px, of light within one pixel (1 / sqrt 12, rounded), the narrowest stripe in an image."""


@lru_cache
def method_names() -> tuple[str, ...]:
    """Return the names of all methods in alphabetical order."""
    return tuple(sorted(module.name.replace("_", "-") for module in pkgutil.iter_modules(__path__)))


def place_centre(method: str, peak: PeakWindow) -> tuple[np.ndarray, np.ndarray]:
    """Return the centre (M,) float32 of each peak, px from its window's first pixel, and its amplitude."""
    if not peak.start.size:
        return np.empty(0, np.float32), np.empty(0, np.float32)
    centre = _method(method)(peak)
    return centre, amplitudes(peak, centre)


def amplitudes(peak: PeakWindow, centre: np.ndarray) -> np.ndarray:
    """Return the height (M,) float32, grey levels, of the best-fitting Gaussian at each centre (M,)."""
    # Sum over the product of two Gaussians, solved for the height of the first.
    kernel, sigma = peak.kernel_sigma(), np.maximum(peak.sigma, np.float32(_ONE_PIXEL))
    joint = np.float32(0.5 / math.pi) * (1 / (sigma * sigma) + 1 / (kernel * kernel))
    return gaussian_moments(peak, centre, kernel)[0] * np.sqrt(joint)


@lru_cache
def _method(name: str) -> Callable[[PeakWindow], np.ndarray]:
    return import_module(f"{__name__}.{name.replace('-', '_')}").centres
