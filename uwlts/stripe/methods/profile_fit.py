"""Stripe centre by maximum likelihood: a Gaussian profile fitted with the noise model of laser stripes.

Speckle multiplies the light, so that the noise of a pixel is proportional to its grey value. Above the noise floor, the
faint flanks therefore determine the position better than the bright middle, where the profile is flat.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from functools import lru_cache
from types import ModuleType

import numpy as np

from uwlts.runtime.compiled import compiled, compiled_inline, compiled_part
from uwlts.stripe.methods import centre_of_mass, quadratic, zero_crossing
from uwlts.stripe.peak_window import FWHM_PER_SIGMA, WINDOW_RULE, PeakWindow, exponential

_STEPS = 5  # number of steps of the fit, equal for all lines, which are fitted in parallel

_FIRST_STEPS = 2  # number of steps before the contrast is estimated from the residuals

_UNMODELLED = 0.02
"""Deviation of a stripe from a Gaussian by haze, flare and blur, as a fraction of its height. It limits the weight of
the wings, from 2.5 sigma on for a contrast of one half."""

_LEAST_NOISE = 0.5  # least noise, grey levels: values are rounded to integers and clipped at black

_USUAL_CONTRAST = 0.3
"""Speckle contrast assumed for the first steps; fully developed speckle resolved by the pixels has contrast 1."""

_PRIOR_PIXELS = 5.0  # weight of the assumed contrast as a number of pixels: fewer than one stripe has

_NARROWEST = 0.4  # least sigma, px; a stripe within one pixel has 0.29

_WIDENING = 1.5  # largest ratio of the fitted sigma and the sigma from the half-height width

_LONGEST_STEP = 0.5
"""Largest change per step of the logarithms of height and width, and of the centre in sigmas: the linearised model is
invalid beyond it."""

_SPECKLED_HALO = 0.023
"""Ratio of noise and height above which the flanks of a plateau are less informative than its middle."""

_NEARLY = 0.03
"""Fraction of a stripe's height by which noise and compression lower the pixels of a plateau. A Gaussian is as high
over a fifth of its width only."""

_MOSTLY = 0.5  # fraction of the width above which a plateau is most of its stripe

_PLATEAU = 5  # fewest pixels of a plateau, and of the width of its stripe

_SAMPLED = 256  # number of lines for the estimates of noise and contrast; more lines would not improve the fit

_LANES = 16  # number of lines fitted in parallel, which fills the processor's vector units

_KNOWN = 8  # number of rows of lanes with parameters of the lines, from `_CENTRE` to `_REACH`
_CENTRE = 0 * _LANES
_HEIGHT = 1 * _LANES
_SIGMA = 2 * _LANES
_FIRST = 3 * _LANES
"""Least centre."""
_LAST = 4 * _LANES  # largest centre
_WIDEST = 5 * _LANES  # largest sigma
_FLOOR = 6 * _LANES  # floor of the variance
_REACH = 7 * _LANES  # pixels on either side

_SUMS = 15  # number of rows of lanes with sums: eight moments, then the rows from `_AFTER` to `_FLATNESS`
_AFTER = 8 * _LANES  # model at the pixel after the middle
_BEFORE = 9 * _LANES  # model at the pixel before the middle
_RISE_AFTER = 10 * _LANES  # ratio of the model at the next pixel after
_RISE_BEFORE = 11 * _LANES  # ratio of the model at the next pixel before
_FALLING = 12 * _LANES  # factor of these ratios per pixel
_INVERSE = 13 * _LANES  # inverse of sigma
_FLATNESS = 14 * _LANES  # fourth cumulant of the pixel, divided by 24 sigma^4

_PIXEL_CUMULANT = -1.0 / 120.0
"""Fourth cumulant of the light sensitivity of a square pixel, px^4. Its second one, 1 / 12, belongs to sigma."""

_TINY = np.finfo(np.float32).tiny

_MEDIAN_MEAN_SQUARE = 0.934
"""Median of the mean square of 2 x 5 unit Gaussian numbers (chi-square of 10 degrees of freedom)."""


def centres(peak: PeakWindow) -> np.ndarray:
    """Fit a Gaussian profile and return its centre (M,) float32, px from the window's first pixel.

    The model is f = A exp(-u^2 / 2) with u = (x - c) / s, averaged over the pixel, above the line through the peak's
    flanks. The variance of a pixel is v = r^2 + (C f)^2. The noise floor r is that of detector and surroundings; the
    speckle contrast C includes shot noise. Both are estimated from all lines together: r beside the stripes, C from the
    residuals of a first fit.

    Each step solves sum (y - f) df/dp / v = 0, linearised in p = (ln A, c / s, ln s), with v of the previous step. This
    is Fisher scoring of the quasi-likelihood, which depends on the variance of the noise only (McCullagh and Nelder,
    Generalized Linear Models, Ch. 9). Because df/dp = f (1, u, u^2), the equations contain moments of f^2 / v up to
    u^4.

    Saturated pixels are not treated separately, because the contrast gives the top little weight. If they are most of
    the stripe, in a halo with speckle, the flanks are not Gaussian: then the parabola of `quadratic` scatters less.

    Real flanks may be no Gaussian for other reasons, such as flare, texture, sharpening or compression by the camera.
    The noise model then gives them too much weight. Another method is used for all lines if it scatters less along the
    stripe.
    """
    sampled = np.arange(0, peak.start.size, max(1, peak.start.size // _SAMPLED))
    flanks = np.zeros(sampled.size, np.float32)
    _measure_flanks(peak, sampled, flanks)
    # Floor of the median line. NumPy's median is several times slower for a few hundred values.
    flanks.sort()
    usual = 0.5 * (float(flanks[(sampled.size - 1) // 2]) + float(flanks[sampled.size // 2]))
    noise = max(_LEAST_NOISE, math.sqrt(usual / _MEDIAN_MEAN_SQUARE))
    groups, most = -(-peak.start.size // _LANES), int(peak.reach.max())
    # Flat rows: the compiler knows that their parts do not overlap.
    signal, known, sums = _allocate_aligned((groups, 2 * most + 1), (groups, _KNOWN), (1, _SUMS))
    centre, flat = np.empty(peak.start.size, np.float32), np.empty(peak.start.size, np.bool_)
    _fit_profiles(peak, noise, sampled, signal, known, sums[0], centre, flat)
    if flat.any():
        centre[flat] = quadratic.centres(peak.select(flat))
    return _select_least_scattered(peak, centre)


def _allocate_aligned(*shapes: tuple[int, int]) -> Iterator[np.ndarray]:
    """Yield arrays (G, K lanes) for shapes (G, K) at addresses aligned for vector units.

    Without alignment a fit takes a third longer.
    """
    sizes = [groups * count * _LANES for groups, count in shapes]
    room = np.empty(sum(sizes) + _LANES, np.float32)
    first = -(room.__array_interface__["data"][0] // room.itemsize) % _LANES
    for (groups, count), size in zip(shapes, sizes, strict=True):
        yield room[first : first + size].reshape(groups, count * _LANES)
        first += size


@compiled
def _measure_flanks(peak: PeakWindow, sampled: np.ndarray, result: np.ndarray) -> None:
    """Compute the mean square (S,) of the pixels of both flanks about the line through them, for sampled lines."""
    for number in range(sampled.size):
        m = sampled[number]
        near = math.floor(peak.middle[m] + np.float32(0.5))
        for offset in range(-WINDOW_RULE.flank, WINDOW_RULE.flank):
            x = near + offset + (int(peak.reach[m]) if offset >= 0 else 1 - int(peak.reach[m]))
            x = min(max(x, 0), peak.window.shape[1] - 1)
            left = peak.window[m, x] - (peak.base[m] + peak.slope[m] * (np.float32(x) - peak.middle[m]))
            result[number] += left * left / np.float32(2 * WINDOW_RULE.flank)


@compiled
def _fit_profiles(
    peak: PeakWindow,
    noise: float,
    sampled: np.ndarray,
    signal: np.ndarray,
    known: np.ndarray,
    sums: np.ndarray,
    centre: np.ndarray,
    flat: np.ndarray,
) -> None:
    """Fill the centres (M,), and mark the lines (M,) with a plateau in a halo; other arrays are buffers."""
    _arrange_lanes(peak, noise, signal, known)
    contrast = _USUAL_CONTRAST
    for step in range(_STEPS):
        if step == _FIRST_STEPS:
            contrast = _estimate_contrast(known, signal, sampled, noise)
        for group in range(known.shape[0]):
            _sum_moments(known[group], signal[group], np.float32(contrast * contrast), sums)
            _update_fit(known[group], sums)
    size = peak.window.shape[1]
    for m in range(centre.size):
        centre[m] = math.floor(peak.middle[m] + np.float32(0.5)) + known[m // _LANES, _CENTRE + m % _LANES]
        width, plateau, highest = np.float32(FWHM_PER_SIGMA) * peak.sigma[m], 0, np.float32(-np.inf)
        if noise > _SPECKLED_HALO * peak.height[m] and width > _PLATEAU:
            window = peak.window[m]
            for k in range(size):
                highest = max(highest, window[k])
            for k in range(size):
                plateau += window[k] >= highest - np.float32(_NEARLY) * peak.height[m]
        flat[m] = plateau > max(_MOSTLY * width, _PLATEAU)


@compiled_inline
def _arrange_lanes(peak: PeakWindow, noise: float, signal: np.ndarray, known: np.ndarray) -> None:
    """Arrange the signal (G, (2 R + 1) lanes) and the parameters (G, 8 lanes) of G groups of lines.

    Positions are relative to the pixel nearest to each peak's middle. The last group is padded with the last line.
    """
    count, size = peak.window.shape
    most = signal.shape[1] // (2 * _LANES)
    for group in range(known.shape[0]):
        for k in range(_LANES):
            m = min(group * _LANES + k, count - 1)
            near = math.floor(peak.middle[m] + np.float32(0.5))
            centre, offset = (
                peak.middle[m] - np.float32(near),
                peak.base[m] + peak.slope[m] * (np.float32(near) - peak.middle[m]),
            )
            for x in range(-most, most + 1):
                pixel = peak.window[m, min(max(near + x, 0), size - 1)]
                signal[group, (most + x) * _LANES + k] = pixel - (offset + peak.slope[m] * np.float32(x))
            half_width = np.float32(0.5 * FWHM_PER_SIGMA) * peak.sigma[m]
            broad = max(peak.sigma[m], np.float32(_NARROWEST))
            known[group, _CENTRE + k], known[group, _HEIGHT + k] = centre, max(peak.height[m], _TINY)
            known[group, _SIGMA + k], known[group, _WIDEST + k] = broad, broad * np.float32(_WIDENING)
            known[group, _FIRST + k], known[group, _LAST + k] = centre - half_width, centre + half_width
            unmodelled = np.float32(_UNMODELLED) * peak.height[m]
            known[group, _FLOOR + k] = np.float32(noise * noise) + unmodelled * unmodelled
            known[group, _REACH + k] = peak.reach[m]


@compiled_inline
def _estimate_contrast(known: np.ndarray, signal: np.ndarray, sampled: np.ndarray, noise: float) -> float:
    """Estimate the contrast of pixels above half height: residuals divided by the model, without the noise floor.

    The degrees of freedom of the fit are not taken into account.
    """
    most = signal.shape[1] // (2 * _LANES)
    total, count = _PRIOR_PIXELS * _USUAL_CONTRAST * _USUAL_CONTRAST, _PRIOR_PIXELS
    for m in sampled:
        fit, k = known[m // _LANES], m % _LANES
        centre, height, sigma = fit[_CENTRE + k], fit[_HEIGHT + k], fit[_SIGMA + k]
        half = 0.5 * FWHM_PER_SIGMA * sigma
        for x in range(max(math.ceil(centre - half), -most), min(math.floor(centre + half), most) + 1):
            scaled = (x - centre) / sigma
            model = height * math.exp(-0.5 * scaled * scaled)
            left = signal[m // _LANES, (most + x) * _LANES + k] - model
            total += (left * left - noise * noise) / (model * model)
            count += 1.0
    return math.sqrt(max(total, 0.0) / count)


@compiled_part
def _sum_moments(known: np.ndarray, signal: np.ndarray, squared_contrast: np.float32, sums: np.ndarray) -> None:
    """Compute moments of f^2 / v up to u^4, then of (y - f) f / v up to u^2.

    The model is evaluated from the middle outwards on both sides. The ratio of neighbouring values decreases by a
    constant factor per pixel.
    """
    most, reach = signal.size // (2 * _LANES), 0
    for k in range(_LANES):
        reach = max(reach, int(known[_REACH + k]))
    y = signal[most * _LANES :][:_LANES]
    for k in range(_LANES):
        centre, inverse = known[_CENTRE + k], np.float32(1.0) / known[_SIGMA + k]
        u, sharpness = -centre * inverse, inverse * inverse
        square = u * u
        f = known[_HEIGHT + k] * exponential(np.float32(-0.5) * square)
        weight = f / (f * f * squared_contrast + known[_FLOOR + k])
        flatness = np.float32(_PIXEL_CUMULANT / 24.0) * sharpness * sharpness
        left, weight = weight * (y[k] - f * _average_over_pixel(square, flatness)), weight * f
        sums[k], sums[_LANES + k], sums[2 * _LANES + k] = weight, weight * u, weight * square
        sums[3 * _LANES + k], sums[4 * _LANES + k] = weight * square * u, weight * square * square
        sums[5 * _LANES + k], sums[6 * _LANES + k], sums[7 * _LANES + k] = left, left * u, left * square
        after = exponential(sharpness * (centre - np.float32(0.5)))
        before = exponential(sharpness * (-centre - np.float32(0.5)))
        falling = exponential(-sharpness)
        sums[_AFTER + k], sums[_BEFORE + k], sums[_INVERSE + k] = f * after, f * before, inverse
        sums[_RISE_AFTER + k], sums[_RISE_BEFORE + k] = after * falling, before * falling
        sums[_FALLING + k], sums[_FLATNESS + k] = falling, flatness
    for offset in range(1, reach + 1):
        y_after, y_before = signal[(most + offset) * _LANES :][:_LANES], signal[(most - offset) * _LANES :][:_LANES]
        x = np.float32(offset)
        for k in range(_LANES):
            f, g = sums[_AFTER + k], sums[_BEFORE + k]
            u, t = (x - known[_CENTRE + k]) * sums[_INVERSE + k], (-x - known[_CENTRE + k]) * sums[_INVERSE + k]
            v = f / (f * f * squared_contrast + known[_FLOOR + k])
            w = g / (g * g * squared_contrast + known[_FLOOR + k])
            if x > known[_REACH + k]:
                v, w = np.float32(0.0), np.float32(0.0)
            right = v * (y_after[k] - f * _average_over_pixel(u * u, sums[_FLATNESS + k]))
            left = w * (y_before[k] - g * _average_over_pixel(t * t, sums[_FLATNESS + k]))
            v, w = v * f, w * g
            sums[5 * _LANES + k] += right + left
            sums[6 * _LANES + k] += right * u + left * t
            sums[7 * _LANES + k] += right * u * u + left * t * t
            sums[k] += v + w
            v, w = v * u, w * t
            sums[_LANES + k] += v + w
            v, w = v * u, w * t
            sums[2 * _LANES + k] += v + w
            v, w = v * u, w * t
            sums[3 * _LANES + k] += v + w
            sums[4 * _LANES + k] += v * u + w * t
            sums[_AFTER + k], sums[_BEFORE + k] = f * sums[_RISE_AFTER + k], g * sums[_RISE_BEFORE + k]
            sums[_RISE_AFTER + k] *= sums[_FALLING + k]
            sums[_RISE_BEFORE + k] *= sums[_FALLING + k]


@compiled_inline
def _average_over_pixel(square: np.float32, flatness: np.float32) -> np.float32:
    """Return the mean of a Gaussian over a pixel, divided by the Gaussian of equal variance, at a squared distance u^2.

    Edgeworth's series to the fourth cumulant: 1 + k4 / (24 s^4) (u^4 - 6 u^2 + 3). For light of sigma 0.35 px, the
    errors of centres with the place in the pixel are 0.003 px rms instead of 0.015 px.
    """
    return np.float32(1.0) + flatness * (square * square - np.float32(6.0) * square + np.float32(3.0))


@compiled_part
def _update_fit(known: np.ndarray, sums: np.ndarray) -> None:
    """Update the fit from the normal equations by Cramer's rule, with limited changes.

    The matrix is m[i + j]. Its diagonal is increased by a thousandth, to be regular if two pixels have all the weight.
    """
    regular, longest = np.float32(1.001), np.float32(_LONGEST_STEP)
    for k in range(_LANES):
        m1, mid, m3 = sums[_LANES + k], sums[2 * _LANES + k], sums[3 * _LANES + k]
        m0, m2, m4 = sums[k] * regular, mid * regular, sums[4 * _LANES + k] * regular
        b0, b1, b2 = sums[5 * _LANES + k], sums[6 * _LANES + k], sums[7 * _LANES + k]
        c00, c01, c02 = m2 * m4 - m3 * m3, mid * m3 - m1 * m4, m1 * m3 - m2 * mid
        c11, c12, c22 = m0 * m4 - mid * mid, m1 * mid - m0 * m3, m0 * m2 - m1 * m1
        scale = np.float32(1.0) / max(m0 * c00 + m1 * c01 + mid * c02, _TINY)
        higher = min(max(scale * (c00 * b0 + c01 * b1 + c02 * b2), -longest), longest)
        further = min(max(scale * (c01 * b0 + c11 * b1 + c12 * b2), -longest), longest)
        wider = min(max(scale * (c02 * b0 + c12 * b1 + c22 * b2), -longest), longest)
        known[_HEIGHT + k] *= exponential(higher)
        moved = known[_CENTRE + k] + known[_SIGMA + k] * further
        known[_CENTRE + k] = min(max(moved, known[_FIRST + k]), known[_LAST + k])
        broad = min(known[_SIGMA + k] * exponential(wider), known[_WIDEST + k])
        known[_SIGMA + k] = max(broad, np.float32(_NARROWEST))


_LARGEST_PX = 3.0
"""Limit of the distances from parabolas; larger ones are due to edges and would conceal the others. Squares, as in the
fits for which the centres are used."""


class _Comparison:
    """Numbers of the comparison with simple methods on the stripe at hand, chosen for the reasons below.

    ``reach``, ``run`` and the use of squares were chosen on the real stripes of docs/results/stripe-methods.md, where
    the result is compared on drawn stripes that were not used.
    """

    reach: int = 12
    """Lines on either side of a line, through whose centres a parabola is fitted. Surfaces are smooth over them, and
    errors by texture and flare are longer than a few lines."""
    # Consecutive lines of a run, and number of runs. Their 320 evaluated lines compare methods to some percent, and the
    # comparison costs little more than the fit of an image.
    run: int = 64
    runs: int = 8
    fewest: int = 64
    """Fewest evaluated lines. With fewer lines the difference of two methods may be chance."""
    advantage: float = 1.3
    """Ratio of the scatters of the zero crossing and the profile fit above which the noise model describes the stripe:
    the ratio is 2 in speckle and 1 in white noise. Half of the runs are used, so that speckle costs little time."""
    # Least gain by another method, relative and in px. Methods that differ less would be exchanged by chance from image
    # to image. Errors of 0.005 px with the pixel phase (`WindowRule.least_kernel`) are no scatter if the stripe is
    # inclined little: their root mean square is the least gain.
    gain: float = 0.02
    gain_px: float = 0.0035
    narrowest: float = WINDOW_RULE.least_kernel
    """Least median sigma of a stripe, px. The simple methods pull the centres of narrower stripes to the pixels'
    middles, which lowers their scatter."""
    jump: float = 0.2
    """Largest distance of neighbouring centres, as a fraction of the window; other lines belong to two surfaces."""


def _select_least_scattered(peak: PeakWindow, centre: np.ndarray) -> np.ndarray:
    """Return the given centres (M,), or those of a simple method that scatters less along the stripe.

    All methods are compared only if the given centres lack their advantage over the zero crossing. ``peak`` are windows
    of M lines in their order.
    """
    rows, others = _select_runs(peak.start.size), (zero_crossing, quadratic, centre_of_mass)
    if rows.shape[1] <= 2 * _Comparison.reach:
        return centre
    some = peak.select(rows[::2].ravel())
    # The median of the lines that are compared, because only their scatter decides; counting is faster than sorting.
    if 2 * np.count_nonzero(some.sigma < _Comparison.narrowest) > some.sigma.size:
        return centre
    scatter, of_first = _measure_scatters(some, centre, rows[::2], zero_crossing)
    if not of_first <= _Comparison.advantage * scatter:
        return centre
    scatter, *scatters = _measure_scatters(peak.select(rows.ravel()), centre, rows, *others)
    best = int(np.argmin(scatters))
    if not scatter - scatters[best] > max(_Comparison.gain * scatter, _Comparison.gain_px):
        return centre
    return others[best].centres(peak)


def _measure_scatters(some: PeakWindow, centre: np.ndarray, rows: np.ndarray, *others: ModuleType) -> list[float]:
    """Return the root mean square distance, px, from parabolas through neighbours: of centres, and of other methods.

    ``some`` are the peaks of the lines ``rows`` (R, K) of R runs. The distances are NaN if too few lines belong to a
    smooth stripe.
    """
    weights, jump = _compute_residual_weights(_Comparison.reach), _Comparison.jump * some.window.shape[1]
    scatters = []
    for values in (centre[rows.ravel()], *(other.centres(some) for other in others)):
        total, count = _sum_squares((some.start, some.middle, values), rows.shape[1], weights, jump)
        scatters.append(math.sqrt(total / count) if count >= _Comparison.fewest else math.nan)
    return scatters


@compiled
def _sum_squares(
    places: tuple[np.ndarray, np.ndarray, np.ndarray], run: int, weights: np.ndarray, jump_px: float
) -> tuple[float, int]:
    """Return the sum of the squared, limited residuals of centres, and the number of lines on smooth stripes.

    ``places`` (M,) are start, middle and centre on the lines of runs of ``run`` lines. The residual of a line is the
    sum of its neighbours' places with the weights (2 reach + 1,). A stripe is smooth if the middles of neighbouring
    lines are nowhere farther apart than ``jump_px``.
    """
    start, middle, centre = places
    reach, total, count = weights.size // 2, 0.0, 0
    for first in range(0, centre.size, run):
        broken = -1
        for line in range(1, run):
            m = first + line
            if abs(start[m] - start[m - 1] + middle[m] - middle[m - 1]) > jump_px:
                broken = line
            at = line - reach
            if at < reach or broken > at - reach:
                continue
            residual = 0.0
            for k in range(weights.size):
                residual += weights[k] * (start[m - 2 * reach + k] + float(centre[m - 2 * reach + k]))
            total += min(abs(residual), _LARGEST_PX) ** 2
            count += 1
    return total, count


@lru_cache(maxsize=16)
def _select_runs(count: int) -> np.ndarray:
    """Return the indices (R, K) of runs spread over ``count`` lines, or all lines as one run if they are few."""
    if count <= _Comparison.run * _Comparison.runs:
        return np.arange(count)[None]
    return np.linspace(0, count - _Comparison.run, _Comparison.runs).astype(np.intp)[:, None] + np.arange(
        _Comparison.run
    )


@lru_cache
def _compute_residual_weights(reach: int) -> np.ndarray:
    """Return weights (2 R + 1,) of centres that give the middle one's distance from their least-squares parabola."""
    powers = np.vander(np.arange(-reach, reach + 1, dtype=float), 3)
    weights = -np.linalg.pinv(powers)[-1]
    weights[reach] += 1.0
    return weights
