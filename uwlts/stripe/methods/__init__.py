"""Methods that place the centre of a stripe: each module of this package is one, found by its name.

A method ``some-name`` is the module ``some_name`` with a function ``centres(peak, kernel)``. It takes a `PeakWindow` of
M windows, whose linear background between the flanks it takes out, and the sigma (M,) of the kernel that weights the
amplitude. It returns the centres (M,), px from the windows' first pixel, and the sum under the kernel there, or None
where that is still to be calculated.
"""

from __future__ import annotations

import math
import pkgutil
from functools import lru_cache
from importlib import import_module
from typing import Protocol

import numpy as np

from uwlts.stripe.peak_window import LEAST_KERNEL, PeakWindow, gaussian_moments


class CentreMethod(Protocol):
    """The function of a method; see the package."""

    def __call__(self, peak: PeakWindow, kernel: np.ndarray) -> tuple[np.ndarray, np.ndarray | None]: ...


@lru_cache
def method_names() -> tuple[str, ...]:
    """Names of all methods, in alphabetical order."""
    return tuple(sorted(module.name.replace("_", "-") for module in pkgutil.iter_modules(__path__)))


def place_centre(method: str, peak: PeakWindow) -> tuple[np.ndarray, np.ndarray]:
    """Centre (M,) float32 of the peak in each window, px from its first pixel, and amplitude (M,) float32.

    The amplitude is the height, in grey levels, of the best-fitting Gaussian of the peak's sigma at the centre.
    """
    sigma = np.maximum(peak.sigma, 0.3)
    kernel = np.maximum(sigma, LEAST_KERNEL)
    centre, under = _method(method)(peak, kernel)
    if under is None:
        (under,) = gaussian_moments(peak, centre, kernel, 0)
    # The sum of the product of two Gaussians over the pixels, solved for the height of the first.
    joint = 0.5 / math.pi * (1 / (sigma * sigma) + 1 / (kernel * kernel))
    return centre, under * np.sqrt(joint)


@lru_cache
def _method(name: str) -> CentreMethod:
    return import_module(f"{__name__}.{name.replace('-', '_')}").centres
