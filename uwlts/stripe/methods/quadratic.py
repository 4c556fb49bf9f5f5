"""Stripe centre as the vertex of a parabola."""

from __future__ import annotations

import math

import numpy as np

from uwlts.runtime.compiled import compiled
from uwlts.stripe.peak_window import CONVERGED_PX, FWHM_PER_SIGMA, PeakWindow, covered_fraction

_ITERATIONS = 6  # most fits, each about the vertex of the previous one


def centres(peak: PeakWindow) -> np.ndarray:
    """Compute the vertex of the parabola fitted by least squares to the low-passed profile around its peak.

    The fit uses the pixels within the half-height width; pixels at its ends count by the covered fraction. It is
    repeated about its own vertex, because a Gaussian is no parabola and pixels further out on one side would bias the
    vertex.

    The sums Sk = sum w u^k and Tk = sum w f u^k form the normal equations of f = a0 + a1 u + a2 u^2. The vertex is
    -a1 / (2 a2).
    """
    half = np.float32(0.5 * FWHM_PER_SIGMA) * peak.kernel_sigma()
    centre = peak.middle.copy()
    _fit(peak, peak.smooth(), half, centre)
    return centre


@compiled
def _fit(peak: PeakWindow, smooth: np.ndarray, half: np.ndarray, centre: np.ndarray) -> None:
    for m in range(centre.size):
        for _ in range(_ITERATIONS):
            s0 = s1 = s2 = s3 = s4 = t0 = t1 = t2 = 0.0
            first, last = math.ceil(centre[m] - half[m] - 0.5), math.floor(centre[m] + half[m] + 0.5)
            for x in range(max(first, 0), min(last + 1, smooth.shape[1])):
                u = x - centre[m]
                w = covered_fraction(u, half[m])
                f = w * (smooth[m, x] - (peak.base[m] + peak.slope[m] * (x - peak.middle[m])))
                s0, s1, s2 = s0 + w, s1 + w * u, s2 + w * u * u
                s3, s4 = s3 + w * u**3, s4 + w * u**4
                t0, t1, t2 = t0 + f, t1 + f * u, t2 + f * u * u
            # Cramer's rule for a1 and a2; the vertex does not depend on their common denominator.
            a1 = t1 * (s0 * s4 - s2 * s2) - t0 * (s1 * s4 - s2 * s3) - t2 * (s0 * s3 - s1 * s2)
            a2 = t2 * (s0 * s2 - s1 * s1) - t1 * (s0 * s3 - s1 * s2) + t0 * (s1 * s3 - s2 * s2)
            step = -a1 / min(2.0 * a2, -1e-6 * abs(a1) - 1e-20)
            centre[m] += min(max(step, -half[m]), half[m])
            if abs(step) < CONVERGED_PX:
                break
