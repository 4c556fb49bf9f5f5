"""Methods that place the centre of a stripe; a new one is a function and an entry of `METHODS`.

A method takes a `PeakWindow` of M windows, whose linear background between the flanks it takes out, and the sigma (M,)
of the kernel that weights the amplitude. It returns the centres (M,), px from the windows' first pixel, and the sum
under the kernel there, or None where that is still to be calculated.
"""

from __future__ import annotations

import math
from collections.abc import Callable

import numpy as np

from uwlts.stripe.peak_window import (
    FWHM_PER_SIGMA,
    LEAST_KERNEL,
    PeakWindow,
    above_background,
    gaussian_moments,
    part_inside,
)
from uwlts.stripe.profile_fit import profile_fit

CentreMethod = Callable[[PeakWindow, np.ndarray], tuple[np.ndarray, np.ndarray | None]]

_ROUNDS = 6
"""Repetitions of the methods that follow their own result."""


def centre_of_mass(peak: PeakWindow, kernel: np.ndarray) -> tuple[np.ndarray, np.ndarray | None]:
    """Centre of mass in a window symmetric about itself.

    The window reaches 2.25 sigma to either side, pixels cut by its ends count in part, and it follows the centre until
    both agree, so that nothing is cut off more on one side than on the other. A wider window would collect noise.
    """
    x, signal = above_background(peak, peak.window)
    half = 2.25 * np.maximum(peak.sigma, LEAST_KERNEL)
    centre = peak.middle
    for _ in range(_ROUNDS):
        u = x - centre
        share = signal * part_inside(u, half)
        step = (share * u).sum(axis=0) / np.maximum(share.sum(axis=0), 0.1 * peak.height)
        centre = centre + np.clip(step, -half, half)
    return centre, None


def quadratic(peak: PeakWindow, kernel: np.ndarray) -> tuple[np.ndarray, np.ndarray | None]:
    """Vertex of the parabola fitted by least squares to the low-passed profile around its peak.

    The fit takes the pixels within the half-height width, those cut by its ends in part, and is repeated about its own
    vertex, for a Gaussian is no parabola and pixels that reach further on one side would pull. With Sk = sum w u^k and
    Tk = sum w f u^k, the normal equations of f = a0 + a1 u + a2 u^2 are solved for a1 and a2; the vertex is
    -a1 / (2 a2).
    """
    x, signal = above_background(peak, peak.smooth)
    half = 0.5 * FWHM_PER_SIGMA * np.maximum(peak.sigma, LEAST_KERNEL)
    centre = peak.middle
    for _ in range(_ROUNDS):
        u = x - centre
        w = part_inside(u, half)
        s0, s1, s2, s3, s4 = ((w * u**k).sum(axis=0) for k in range(5))
        t0, t1, t2 = ((w * signal * u**k).sum(axis=0) for k in range(3))
        # Cramer's rule for a1 and a2; their common denominator drops out of the vertex.
        a1 = t1 * (s0 * s4 - s2 * s2) - t0 * (s1 * s4 - s2 * s3) - t2 * (s0 * s3 - s1 * s2)
        a2 = t2 * (s0 * s2 - s1 * s1) - t1 * (s0 * s3 - s1 * s2) + t0 * (s1 * s3 - s2 * s2)
        step = -a1 / np.minimum(2.0 * a2, -1e-6 * np.abs(a1) - 1e-20)
        centre = centre + np.clip(step, -half, half)
    return centre, None


def zero_crossing(peak: PeakWindow, kernel: np.ndarray) -> tuple[np.ndarray, np.ndarray | None]:
    """Zero of the profile's correlation with the derivative of a Gaussian as wide as the stripe, and M0 there.

    With t = (x - c) / s and g = exp(-t^2 / 2), F(c) = sum f t g is proportional to the derivative, at c, of the
    profile f smoothed with g. As wide as the stripe, the kernel is the matched filter: the zero is the least-squares
    position of a Gaussian, of least variance in white noise. The kernel is evaluated at a real-valued c0, the midpoint
    of the half-height crossings, instead of interpolating between pixels. With Mk = sum f t^k g the slope of F by c / s
    is M2 - M0, so that Newton's step is r = M1 / (M0 - M2). For a Gaussian f of sigma s, F(c) is proportional to
    d exp(-d^2 / 4), d being the step that is sought, and r = d / (1 - d^2 / 2): d is r - r^3 / 2 to fourth order.

    A background of slope b adds b sqrt(2 pi) s^2 to F everywhere, which is taken out.
    """
    zeroth, first, second = gaussian_moments(peak, peak.middle, kernel, 2)
    first -= peak.slope * math.sqrt(2.0 * math.pi) * kernel * kernel
    step = first / np.maximum(zeroth - second, 0.1 * np.abs(zeroth))
    step = np.minimum(np.maximum(step, -0.5), 0.5)
    step -= 0.5 * step * step * step
    # The sum under the Gaussian at its top, from its value a step away.
    top = zeroth * (1.0 + 0.25 * step**2)
    return peak.middle + kernel * step, top


METHODS: dict[str, CentreMethod] = {
    "centre-of-mass": centre_of_mass,
    "profile-fit": profile_fit,
    "quadratic": quadratic,
    "zero-crossing": zero_crossing,
}


def method_names() -> tuple[str, ...]:
    """Names of all methods, in alphabetical order."""
    return tuple(sorted(METHODS))


def place_centre(method: str, peak: PeakWindow) -> tuple[np.ndarray, np.ndarray]:
    """Centre (M,) float32 of the peak in each window, px from its first pixel, and amplitude (M,) float32.

    The amplitude is the height, in grey levels, of the best-fitting Gaussian of the peak's sigma at the centre.
    """
    sigma = np.maximum(peak.sigma, 0.3)
    kernel = np.maximum(sigma, LEAST_KERNEL)
    centre, under = METHODS[method](peak, kernel)
    if under is None:
        (under,) = gaussian_moments(peak, centre, kernel, 0)
    # The sum of the product of two Gaussians over the pixels, solved for the height of the first.
    joint = 0.5 / math.pi * (1 / (sigma * sigma) + 1 / (kernel * kernel))
    return centre, under * np.sqrt(joint)
