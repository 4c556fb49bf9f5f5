"""The stripe's centre of mass."""

from __future__ import annotations

import math

import numpy as np

from uwlts.runtime.compiled import compiled
from uwlts.stripe.peak_window import PeakWindow, part_inside

_ITERATIONS = 6


def centres(peak: PeakWindow) -> np.ndarray:
    """Centre of mass in a window symmetric about itself.

    The window reaches 2.25 sigma to either side, pixels cut by its ends count in part, and it follows the centre until
    both agree, so that nothing is cut off more on one side than on the other. A wider window would collect noise.
    """
    half = np.float32(2.25) * peak.kernel_sigma()
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
