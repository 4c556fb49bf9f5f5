"""The centre of a stripe within its window, by three methods.

All take the same `Lobe` and return (M,) positions counted from the window's first pixel, so that they differ in
nothing but the method. The linear background between the lobe's flanks is taken out in each.
"""

from __future__ import annotations

import math

import cv2
import numpy as np

from uwlts.stripe.lobe import Lobe
from uwlts.stripe.result import StripeMethod

_MASS_STEPS = 6


def place_centre(method: StripeMethod, lobe: Lobe, sigma: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Centre and amplitude of each lobe.

    Parameters
    ----------
    method : StripeMethod
        Which of the methods below.
    lobe : Lobe
        M windows.
    sigma : (M,) float32
        Sigma of the stripe itself, px, the low-pass taken out.

    Returns
    -------
    centre : (M,) float32
        Position from the window's first pixel, px.
    amplitude : (M,) float32
        Height of the best-fitting Gaussian of that sigma at the centre, grey levels.
    """
    if method is StripeMethod.ZERO_CROSSING:
        return _zero_crossing(lobe, sigma)
    centre = _centre_of_mass(lobe) if method is StripeMethod.CENTRE_OF_MASS else _quadratic(lobe)
    (zeroth,) = _gaussian_moments(lobe, centre, sigma, 0)
    return centre, zeroth / (np.float32(math.sqrt(math.pi)) * sigma)


def _zero_crossing(lobe: Lobe, sigma: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Zero of the profile's correlation with the derivative of a Gaussian as wide as the stripe.

    With t = (x - c) / s and g = exp(-t^2 / 2), F(c) = sum f t g is proportional to the derivative, at c, of the
    profile f smoothed with g. As wide as the stripe, the kernel is the matched filter: the zero is the least-squares
    position of a Gaussian, of least variance in white noise. The kernel is evaluated at a real-valued c0, the midpoint
    of the half-height crossings, instead of interpolating between pixels. With Mk = sum f t^k g the slope of F by c / s
    is M2 - M0, so that Newton's step is r = M1 / (M0 - M2). For a Gaussian f of sigma s, F(c) is proportional to
    d exp(-d^2 / 4), d being the step that is sought, and r = d / (1 - d^2 / 2): the step is r - r^3 / 2 to fourth order.

    A background of slope b adds b sqrt(2 pi) s^2 to F everywhere, which is taken out.
    """
    zeroth, first, second = _gaussian_moments(lobe, lobe.middle, sigma, 2)
    first -= lobe.slope * np.float32(math.sqrt(2.0 * math.pi)) * sigma * sigma
    step = first / np.maximum(zeroth - second, np.float32(0.1) * np.abs(zeroth))
    step = np.minimum(np.maximum(step, np.float32(-0.5)), np.float32(0.5))
    step -= np.float32(0.5) * step * step * step
    # The sum under the Gaussian at its top, from its value a step away.
    top = zeroth * (np.float32(1.0) + np.float32(0.25) * step**2)
    return lobe.middle + sigma * step, top / (np.float32(math.sqrt(math.pi)) * sigma)


def _gaussian_moments(lobe: Lobe, centre: np.ndarray, sigma: np.ndarray, highest: int) -> list[np.ndarray]:
    """M0 ... Mk of the profile above `lobe.base` under the Gaussian weight at `centre`; see `_zero_crossing`."""
    # Rows beyond the weight of every lobe, less than 4e-4 there, are left out.
    size = lobe.window.shape[0]
    reach = 4.0 * float(sigma.max())
    rows = slice(max(0, math.floor(float(centre.min()) - reach)), min(size, math.ceil(float(centre.max()) + reach) + 1))
    t = np.arange(rows.start, rows.stop, dtype=np.float32)[:, None] - centre
    t *= np.float32(1.0) / sigma
    weighted = t * t
    weighted *= np.float32(-0.5)
    # OpenCV's exponential is several times as fast as NumPy's.
    weighted = cv2.exp(weighted)
    weighted *= lobe.window[rows] - lobe.base
    moments = [weighted.sum(axis=0)]
    for _ in range(highest):
        weighted *= t
        moments.append(weighted.sum(axis=0))
    return moments


def _centre_of_mass(lobe: Lobe) -> np.ndarray:
    """Centre of mass in a window symmetric about itself.

    The window's half-width is the distance to the background flank. Pixels cut by its ends count in part and the
    window follows the centre until both agree, so that nothing is cut off more on one side than on the other.
    """
    x = np.arange(lobe.window.shape[0], dtype=np.float32)[:, None]
    signal = lobe.window - (lobe.base + lobe.slope * (x - lobe.middle))
    half = lobe.reach.astype(np.float32) + np.float32(0.5)
    centre = lobe.middle
    for _ in range(_MASS_STEPS):
        u = x - centre
        share = signal * np.clip(half + np.float32(0.5) - np.abs(u), 0.0, 1.0)
        step = np.einsum("ij,ij->j", share, u) / np.maximum(share.sum(axis=0), np.float32(0.1) * lobe.height)
        centre = centre + np.clip(step, -half, half)
    return centre


def _quadratic(lobe: Lobe) -> np.ndarray:
    """Vertex of the parabola fitted to the low-passed profile around its peak.

    Least squares over the whole pixels x = -q ... q around the midpoint of the half-height crossings, q being about
    half of the full width at half maximum: f = a0 + a1 x + a2 x^2 has a1 = S(x f) / S(x^2) and
    a2 = S((x^2 - m) f) / S((x^2 - m)^2) with m the mean of x^2; the vertex lies at -a1 / (2 a2).
    """
    rows = np.arange(lobe.smooth.shape[0])[:, None]
    near = np.rint(lobe.middle).astype(np.intp)
    q = np.maximum(1, np.rint(1.1 * lobe.sigma)).astype(np.intp)
    x = rows - near
    inside = np.abs(x) <= q
    count = 2 * q + 1
    squares = q * (q + 1) * (2 * q + 1) / 3.0
    fourths = squares * (3 * q * (q + 1) - 1) / 5.0
    signal = np.where(inside, lobe.smooth - (lobe.base + lobe.slope * (rows - lobe.middle)), 0.0)
    first, second = (signal * x).sum(axis=0), (signal * (x * x - squares / count)).sum(axis=0)
    a1, a2 = first / squares, second / (fourths - squares**2 / count)
    step = -a1 / np.minimum(2.0 * a2, -1e-9)
    return (near + np.clip(step, -q, q)).astype(np.float32)
