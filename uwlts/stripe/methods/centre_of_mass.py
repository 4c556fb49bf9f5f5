"""The stripe's centre of mass."""

from __future__ import annotations

import numpy as np

from uwlts.stripe.peak_window import LEAST_KERNEL, PeakWindow, above_background, part_inside

_ITERATIONS = 6


def centres(peak: PeakWindow, kernel: np.ndarray) -> tuple[np.ndarray, np.ndarray | None]:
    """Centre of mass in a window symmetric about itself.

    The window reaches 2.25 sigma to either side, pixels cut by its ends count in part, and it follows the centre until
    both agree, so that nothing is cut off more on one side than on the other. A wider window would collect noise.
    """
    x, signal = above_background(peak, peak.window)
    half = 2.25 * np.maximum(peak.sigma, LEAST_KERNEL)
    centre = peak.middle
    for _ in range(_ITERATIONS):
        u = x - centre
        share = signal * part_inside(u, half)
        step = (share * u).sum(axis=0) / np.maximum(share.sum(axis=0), 0.1 * peak.height)
        centre = centre + np.clip(step, -half, half)
    return centre, None
