"""The stripe's centre by maximum likelihood: a Gaussian profile fitted under the noise that laser stripes have.

Speckle multiplies the light, so that a pixel errs in proportion to what it shows. Above the floor of noise the faint
flanks then locate a stripe better than its bright middle, where the profile is level.
"""

from __future__ import annotations

import math

import cv2
import numpy as np

from uwlts.stripe.candidates import count_true
from uwlts.stripe.methods import quadratic
from uwlts.stripe.peak_window import FLANK, FWHM_PER_SIGMA, PeakWindow

_STEPS, _FIRST_STEPS = 5, 2
"""Steps in all, and those before the contrast is taken from what the fit leaves."""

_UNMODELLED = 0.02
"""Part of the height by which haze, flare and blur may make a stripe differ from a Gaussian. Pixels count ever less
where the wings fall below that part over the contrast, 2.5 sigma from the centre at a contrast of one half."""

_LEAST_NOISE = 0.5
"""Grey levels: values are rounded to whole ones, and cut off at black."""

_USUAL_CONTRAST, _PRIOR_PIXELS = 0.3, 5.0
"""Speckle contrast assumed before anything is measured, and the number of pixels whose evidence it counts as."""

_NARROWEST, _WIDENING, _LONGEST_STEP = 0.4, 1.5, 0.5
"""Least sigma in px, its largest ratio to the half-height width's, and the largest change of a parameter at a time."""

_SPECKLED_HALO, _MOSTLY, _PLATEAU = 0.023, 0.5, 5
"""Noise beside a stripe over its height, and plateau over width and in px, above which its flanks tell less than its
middle."""

_SAMPLED = 256
"""Lines from which noise and contrast are taken; more would not make the fit better."""

_MEDIAN_MEAN_SQUARE = 0.934
"""Median of the mean square of 2 x 5 unit Gaussian numbers (chi-square of 10 degrees)."""


def centres(peak: PeakWindow, kernel: np.ndarray) -> tuple[np.ndarray, np.ndarray | None]:
    """Centre (M,) float32 of the best-fitting Gaussian profile, px from the window's first pixel.

    The model is f = A exp(-u^2 / 2) with u = (x - c) / s, above the line through the peak's flanks. A pixel's variance
    is v = r^2 + (C f)^2: r is the floor of detector and surroundings, C the contrast of speckle, which stands for shot
    noise too. Both are measured on all lines together, r beside the stripes, C on what a first fit leaves.

    Each step solves sum (y - f) df/dp / v = 0, linearised in p = (ln A, c / s^2, ln s / s^2), with v of the step
    before: Fisher scoring of the quasi-likelihood, which needs no more of the noise than its variance (McCullagh and
    Nelder, Generalized Linear Models, Ch. 9). As df/dp = f (1, d, d^2) with d = x - c, the equations hold moments of
    f^2 / v up to d^4.

    Saturated pixels get no special care: the contrast gives the top so little weight that it would change little. But
    where they are most of the stripe, in a halo that has speckle too, the flanks are no Gaussian's: there the parabola
    of `quadratic` scatters less.
    """
    near = np.rint(peak.middle)
    # About each peak's own pixel the powers of x stay small, and one matrix product sums them for all peaks.
    most = int(peak.reach.max())
    x = np.arange(-most, most + 1, dtype=np.float32)
    powers = x ** np.arange(5, dtype=np.float32)[:, None]
    pixels = _pixels(near, x[:, None])
    middle = peak.middle - near
    signal = peak.window.take(pixels, mode="clip") - (peak.base + peak.slope * (x[:, None] - middle))
    sampled = slice(None, None, max(1, near.size // _SAMPLED))
    noise = _floor(peak, near, sampled)
    floor = np.where(np.abs(x)[:, None] > peak.reach, np.inf, noise**2 + np.square(_UNMODELLED * peak.height))

    half_width = (0.5 * FWHM_PER_SIGMA) * peak.sigma
    first, last = middle - half_width, middle + half_width
    centre, contrast = middle, _USUAL_CONTRAST
    log_height = np.log(np.maximum(peak.height, np.finfo(np.float32).tiny))
    log_sigma = np.log(np.maximum(peak.sigma, _NARROWEST))
    widest = log_sigma + math.log(_WIDENING)
    for step in range(_STEPS):
        variance = np.exp(2.0 * log_sigma)
        # The logarithm of the Gaussian is a parabola in x.
        slope = centre / variance
        model = cv2.exp(powers[:3].T @ np.stack([log_height - 0.5 * slope * centre, slope, -0.5 / variance]))
        left = signal - model
        squared = model * model
        if step == _FIRST_STEPS:
            core = squared[:, sampled] > 0.25 * np.exp(2.0 * log_height[sampled])
            contrast = _contrast(left[:, sampled][core], squared[:, sampled][core], floor=noise)
        weight = model / (squared * contrast**2 + floor)
        matrix, right = _about(centre, powers @ (weight * model)), _about(centre, powers[:3] @ (weight * left))
        change = _solved(matrix, right, variance)
        log_height = log_height + change[0]
        centre = np.minimum(np.maximum(centre + np.sqrt(variance) * change[1], first), last)
        log_sigma = np.minimum(np.maximum(log_sigma + change[2], math.log(_NARROWEST)), widest)
    centre = near + centre
    haloed = np.flatnonzero((noise > _SPECKLED_HALO * peak.height) & (2.0 * half_width > _PLATEAU))
    if haloed.size:
        window = peak.window.take(haloed, axis=1)
        plateau = count_true(window == window.max(axis=0))
        flat = haloed[plateau > np.maximum(2.0 * _MOSTLY * half_width[haloed], _PLATEAU)]
        centre[flat] = quadratic.centres(peak.keep(flat), kernel[flat])[0]
    return centre, None


def _pixels(near: np.ndarray, x: np.ndarray, lines: slice = slice(None)) -> np.ndarray:
    """(X, S) int: places in the flat window of the pixels x, (X, 1) or (X, S), away from ``near`` (M,) on S lines."""
    width = near.size
    return x.astype(np.intp) * width + (near.astype(np.intp) * width + np.arange(width))[lines]


def _floor(peak: PeakWindow, near: np.ndarray, sampled: slice) -> float:
    """Standard deviation of the pixels of both flanks about the line through them, grey levels: the usual line's."""
    away = peak.reach[sampled] + np.arange(FLANK, dtype=np.float32)[:, None]
    away = np.vstack([-away, away])
    values = peak.window.take(_pixels(near, away, sampled), mode="clip")
    left = values - (peak.base + peak.slope * (near - peak.middle))[sampled] - peak.slope[sampled] * away
    return max(_LEAST_NOISE, math.sqrt(np.median(np.square(left).mean(axis=0)) / _MEDIAN_MEAN_SQUARE))


def _contrast(left: np.ndarray, squared: np.ndarray, *, floor: float) -> float:
    """Contrast of the pixels above half height: what the fit leaves of them over the model, less the floor's share.

    ``squared`` is the model's square. The degrees of freedom of the fit are not accounted for.
    """
    total = float(((left * left - floor**2) / squared).sum(dtype=float)) + _PRIOR_PIXELS * _USUAL_CONTRAST**2
    return math.sqrt(max(total, 0.0) / (squared.size + _PRIOR_PIXELS))


def _about(centre: np.ndarray, sums: np.ndarray) -> list[np.ndarray]:
    """Moments of x - c from the sums over x^0, x^1 ... (K, M), by the binomial theorem in Horner's form."""
    moments = [sums[0]]
    for k in range(1, len(sums)):
        moment = sums[0]
        for j in range(1, k + 1):
            moment = math.comb(k, j) * sums[j] - centre * moment
        moments.append(moment)
    return moments


def _solved(m: list[np.ndarray], b: list[np.ndarray], variance: np.ndarray) -> tuple[np.ndarray, ...]:
    """Changes (M,) of ln A, c / s and ln s from the normal equations, by Cramer's rule; none above the limit.

    The matrix is m[i + j]. A thousandth more on its diagonal keeps it regular where two pixels carry all weight.
    """
    m0, m2, m4 = (m[k] * np.float32(1.001) for k in (0, 2, 4))
    _, m1, mid, m3, _ = m
    c00, c01, c02 = m2 * m4 - m3 * m3, mid * m3 - m1 * m4, m1 * m3 - m2 * mid
    c11, c12, c22 = m0 * m4 - mid * mid, m1 * mid - m0 * m3, m0 * m2 - m1 * m1
    scale = 1.0 / np.maximum(m0 * c00 + m1 * c01 + mid * c02, np.finfo(np.float32).tiny)
    changes = (
        scale * (c00 * b[0] + c01 * b[1] + c02 * b[2]),
        scale * np.sqrt(variance) * (c01 * b[0] + c11 * b[1] + c12 * b[2]),
        scale * variance * (c02 * b[0] + c12 * b[1] + c22 * b[2]),
    )
    return tuple(np.minimum(np.maximum(change, -_LONGEST_STEP), _LONGEST_STEP) for change in changes)
