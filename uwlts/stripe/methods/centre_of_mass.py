"""Stripe centre as the centre of mass."""

from __future__ import annotations

import math

import numpy as np

from uwlts.runtime.compiled import compiled
from uwlts.stripe.peak_window import CONVERGED_PX, PeakWindow, covered_fraction

_ITERATIONS = 6  # most updates of the window's position

_HALF_SIGMAS = 2.25
"""Half width of the window, sigmas: it contains most of the light; further pixels add more noise than light."""


def centres(peak: PeakWindow) -> np.ndarray:
    """Compute the centre of mass in a window symmetric about the centre itself.

    Pixels at the window's ends count by the covered fraction. The window is moved to the centre repeatedly, so that it
    cuts off equally much on both sides.
    """
    half = np.float32(_HALF_SIGMAS) * peak.kernel_sigma()
    centre = peak.middle.copy()
    _follow(peak, half, centre)
    return centre


@compiled
def _follow(peak: PeakWindow, half: np.ndarray, centre: np.ndarray) -> None:
    for m in range(centre.size):
        for _ in range(_ITERATIONS):
            total, moment = 0.0, 0.0
            first, last = math.ceil(centre[m] - half[m] - 0.5), math.floor(centre[m] + half[m] + 0.5)
            for x in range(max(first, 0), min(last + 1, peak.window.shape[1])):
                u = x - centre[m]
                share = covered_fraction(u, half[m]) * (
                    peak.window[m, x] - (peak.base[m] + peak.slope[m] * (x - peak.middle[m]))
                )
                total, moment = total + share, moment + share * u
            step = moment / max(total, 0.1 * peak.height[m])
            centre[m] += min(max(step, -half[m]), half[m])
            if abs(step) < CONVERGED_PX:
                break
