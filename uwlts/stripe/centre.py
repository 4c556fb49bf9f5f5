"""The centre of a stripe within its window, by four methods, of which `profile_fit` has a file of its own.

All take the same `Lobe` and return (M,) positions counted from the window's first pixel, so that they differ in
nothing but the method. The linear background between the lobe's flanks is taken out in each.
"""

from __future__ import annotations

import math

import cv2
import numpy as np

from uwlts.stripe.lobe import Lobe
from uwlts.stripe.profile_fit import fit_profiles
from uwlts.stripe.result import FWHM_PER_SIGMA, StripeMethod

_ITERATIONS = 6

_LEAST_KERNEL = 1.0
"""Sigma of the narrowest weight, px. A narrower one rests on too few pixels: for a stripe of sigma 0.7 px the centre
would err by 0.015 px with the pixel phase instead of 0.005."""


def place_centre(method: StripeMethod, lobe: Lobe) -> tuple[np.ndarray, np.ndarray]:
    """Centre and amplitude of each lobe.

    Returns
    -------
    centre : (M,) float32
        Position from the window's first pixel, px.
    amplitude : (M,) float32
        Height of the best-fitting Gaussian of the lobe's sigma at the centre, grey levels.
    """
    sigma = np.maximum(lobe.sigma, 0.3)
    kernel = np.maximum(sigma, _LEAST_KERNEL)
    if method is StripeMethod.ZERO_CROSSING:
        centre, under = _zero_crossing(lobe, kernel)
    else:
        match method:
            case StripeMethod.CENTRE_OF_MASS:
                centre = _centre_of_mass(lobe)
            case StripeMethod.QUADRATIC:
                centre = _quadratic(lobe)
            case StripeMethod.PROFILE_FIT:
                centre = fit_profiles(lobe)
        (under,) = _gaussian_moments(lobe, centre, kernel, 0)
    # The sum of the product of two Gaussians over the pixels, solved for the height of the first.
    joint = 0.5 / math.pi * (1 / (sigma * sigma) + 1 / (kernel * kernel))
    return centre, under * np.sqrt(joint)


def _zero_crossing(lobe: Lobe, sigma: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Zero of the profile's correlation with the derivative of a Gaussian as wide as the stripe, and M0 there.

    With t = (x - c) / s and g = exp(-t^2 / 2), F(c) = sum f t g is proportional to the derivative, at c, of the
    profile f smoothed with g. As wide as the stripe, the kernel is the matched filter: the zero is the least-squares
    position of a Gaussian, of least variance in white noise. The kernel is evaluated at a real-valued c0, the midpoint
    of the half-height crossings, instead of interpolating between pixels. With Mk = sum f t^k g the slope of F by c / s
    is M2 - M0, so that Newton's step is r = M1 / (M0 - M2). For a Gaussian f of sigma s, F(c) is proportional to
    d exp(-d^2 / 4), d being the step that is sought, and r = d / (1 - d^2 / 2): d is r - r^3 / 2 to fourth order.

    A background of slope b adds b sqrt(2 pi) s^2 to F everywhere, which is taken out.
    """
    zeroth, first, second = _gaussian_moments(lobe, lobe.middle, sigma, 2)
    first -= lobe.slope * math.sqrt(2.0 * math.pi) * sigma * sigma
    step = first / np.maximum(zeroth - second, 0.1 * np.abs(zeroth))
    step = np.minimum(np.maximum(step, -0.5), 0.5)
    step -= 0.5 * step * step * step
    # The sum under the Gaussian at its top, from its value a step away.
    top = zeroth * (1.0 + 0.25 * step**2)
    return lobe.middle + sigma * step, top


def _gaussian_moments(lobe: Lobe, centre: np.ndarray, sigma: np.ndarray, highest: int) -> list[np.ndarray]:
    """M0 ... Mk of the profile above `lobe.base` under the Gaussian weight at `centre`; see `_zero_crossing`."""
    # Rows beyond the weight of every lobe, less than 0.003 there, are left out.
    size = lobe.window.shape[0]
    reach = 3.5 * float(sigma.max())
    rows = slice(max(0, math.floor(float(centre.min()) - reach)), min(size, math.ceil(float(centre.max()) + reach) + 1))
    t = np.arange(rows.start, rows.stop, dtype=np.float32)[:, None] - centre
    t *= 1.0 / sigma
    # OpenCV's exponential is several times as fast as NumPy's.
    weighted = cv2.exp(cv2.multiply(t, t, scale=-0.5))
    weighted *= lobe.window[rows] - lobe.base
    moments = [cv2.reduce(weighted, 0, cv2.REDUCE_SUM)[0]]
    for _ in range(highest):
        weighted *= t
        moments.append(cv2.reduce(weighted, 0, cv2.REDUCE_SUM)[0])
    return moments


def _centre_of_mass(lobe: Lobe) -> np.ndarray:
    """Centre of mass in a window symmetric about itself.

    The window reaches 2.25 sigma to either side, pixels cut by its ends count in part, and it follows the centre until
    both agree, so that nothing is cut off more on one side than on the other. A wider window would collect noise.
    """
    x, signal = _above_background(lobe, lobe.window)
    half = 2.25 * np.maximum(lobe.sigma, _LEAST_KERNEL)
    centre = lobe.middle
    for _ in range(_ITERATIONS):
        u = x - centre
        share = signal * _part_inside(u, half)
        step = (share * u).sum(axis=0) / np.maximum(share.sum(axis=0), 0.1 * lobe.height)
        centre = centre + np.clip(step, -half, half)
    return centre


def _quadratic(lobe: Lobe) -> np.ndarray:
    """Vertex of the parabola fitted by least squares to the low-passed profile around its peak.

    The fit takes the pixels within the half-height width, those cut by its ends in part, and is repeated about its own
    vertex, for a Gaussian is no parabola and pixels that reach further on one side would pull. With Sk = sum w u^k and
    Tk = sum w f u^k, the normal equations of f = a0 + a1 u + a2 u^2 are solved for a1 and a2; the vertex is
    -a1 / (2 a2).
    """
    x, signal = _above_background(lobe, lobe.smooth)
    half = 0.5 * FWHM_PER_SIGMA * np.maximum(lobe.sigma, _LEAST_KERNEL)
    centre = lobe.middle
    for _ in range(_ITERATIONS):
        u = x - centre
        w = _part_inside(u, half)
        s0, s1, s2, s3, s4 = ((w * u**k).sum(axis=0) for k in range(5))
        t0, t1, t2 = ((w * signal * u**k).sum(axis=0) for k in range(3))
        # Cramer's rule for a1 and a2; their common denominator drops out of the vertex.
        a1 = t1 * (s0 * s4 - s2 * s2) - t0 * (s1 * s4 - s2 * s3) - t2 * (s0 * s3 - s1 * s2)
        a2 = t2 * (s0 * s2 - s1 * s1) - t1 * (s0 * s3 - s1 * s2) + t0 * (s1 * s3 - s2 * s2)
        step = -a1 / np.minimum(2.0 * a2, -1e-6 * np.abs(a1) - 1e-20)
        centre = centre + np.clip(step, -half, half)
    return centre


def _above_background(lobe: Lobe, values: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """(W, 1) row numbers and (W, M) values above the line through the two flanks."""
    x = np.arange(values.shape[0], dtype=np.float32)[:, None]
    return x, values - (lobe.base + lobe.slope * (x - lobe.middle))


def _part_inside(u: np.ndarray, half: np.ndarray) -> np.ndarray:
    """Share of each pixel, u from the centre, that lies within `half` of it."""
    return np.clip(half + 0.5 - np.abs(u), 0.0, 1.0)
