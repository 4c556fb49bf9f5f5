"""The stripe's centre as the vertex of a parabola."""

from __future__ import annotations

import numpy as np

from uwlts.stripe.peak_window import FWHM_PER_SIGMA, LEAST_KERNEL, PeakWindow, above_background, part_inside

_ITERATIONS = 6


def centres(peak: PeakWindow, kernel: np.ndarray) -> tuple[np.ndarray, np.ndarray | None]:
    """Vertex of the parabola fitted by least squares to the low-passed profile around its peak.

    The fit takes the pixels within the half-height width, those cut by its ends in part, and is repeated about its own
    vertex, for a Gaussian is no parabola and pixels that reach further on one side would pull. With Sk = sum w u^k and
    Tk = sum w f u^k, the normal equations of f = a0 + a1 u + a2 u^2 are solved for a1 and a2; the vertex is
    -a1 / (2 a2).
    """
    x, signal = above_background(peak, peak.smooth)
    half = 0.5 * FWHM_PER_SIGMA * np.maximum(peak.sigma, LEAST_KERNEL)
    centre = peak.middle
    for _ in range(_ITERATIONS):
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
