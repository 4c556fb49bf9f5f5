"""Stripe centre at the zero crossing of the smoothed profile's derivative."""

from __future__ import annotations

import math

import numpy as np

from uwlts.runtime.compiled import compiled
from uwlts.stripe.peak_window import PeakWindow, gaussian_moments


def centres(peak: PeakWindow) -> np.ndarray:
    """Compute the zero of the profile's correlation with the derivative of a Gaussian as wide as the stripe.

    Let t = (x - c) / s and g = exp(-t^2 / 2). F(c) = sum f t g is proportional to the derivative at c of the profile f
    smoothed with g. A kernel as wide as the stripe is the matched filter. Its zero is the least-squares position of a
    Gaussian, with the least variance in white noise. The kernel is evaluated at a real-valued c0, the midpoint of the
    half-height crossings, instead of interpolating between pixels.

    With Mk = sum f t^k g, the derivative of F by c / s is M2 - M0, and Newton's step is r = M1 / (M0 - M2). For a
    Gaussian f of sigma s, F(c) is proportional to d exp(-d^2 / 4), where d is the required step. Then r = d / (1 - d^2
    / 2), and d = r - r^3 / 2 to fourth order.

    A background of slope b adds b sqrt(2 pi) s^2 to F everywhere, which is subtracted.
    """
    centre = np.empty(peak.start.size, np.float32)
    _step_to_zeros(peak, centre)
    return centre


@compiled
def _step_to_zeros(peak: PeakWindow, centre: np.ndarray) -> None:
    half = np.float32(0.5)
    for m in range(centre.size):
        m0, m1, m2, sigma = gaussian_moments(peak, m, peak.middle[m])
        m1 -= peak.slope[m] * np.float32(math.sqrt(2.0 * math.pi)) * sigma * sigma
        step = min(max(m1 / max(m0 - m2, np.float32(0.1) * abs(m0)), -half), half)
        centre[m] = peak.middle[m] + sigma * (step - half * step * step * step)
