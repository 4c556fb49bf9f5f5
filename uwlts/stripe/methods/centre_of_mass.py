"""The stripe's centre of mass."""

from __future__ import annotations

import math

import numpy as np

from uwlts.runtime.compiled import compiled
from uwlts.stripe.peak_window import PeakWindow, part_inside

_ITERATIONS = 6
"""Passes in which the window follows the centre, as many for each line."""

_HALF_SIGMAS = 2.25
"""Sigmas from the centre to the ends of the window: most of the light; further pixels add more noise than light."""


def centres(peak: PeakWindow) -> np.ndarray:
    """Centre of mass in a window symmetric about itself.

    Pixels cut by the window's ends count in part, and it follows the centre until both agree, so that nothing is cut
    off more on one side than on the other.
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
                share = part_inside(u, half[m]) * (
                    peak.window[m, x] - (peak.base[m] + peak.slope[m] * (x - peak.middle[m]))
                )
                total, moment = total + share, moment + share * u
            step = moment / max(total, 0.1 * peak.height[m])
            centre[m] += min(max(step, -half[m]), half[m])
