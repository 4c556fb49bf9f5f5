"""Scatter of stripe centres from line to line, to compare methods on the stripe at hand."""

from __future__ import annotations

from functools import lru_cache
from types import ModuleType

import numpy as np
from numpy.lib.stride_tricks import sliding_window_view

from uwlts.stripe.peak_window import WINDOW_RULE, PeakWindow


class _Rule:
    """Numbers of the comparison, chosen for the reasons below.

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
    largest_px: float = 3.0
    """Limit of the distances, px; larger ones are due to edges and would conceal the others. Squares, as in the fits
    for which the centres are used."""
    jump: float = 0.2
    """Largest distance of neighbouring centres, as a fraction of the window; other lines belong to two surfaces."""


def least_scattered(
    peak: PeakWindow, centre: np.ndarray, first: ModuleType, others: tuple[ModuleType, ...]
) -> np.ndarray:
    """Return the centres (M,), px from each window's first pixel, of the method that scatters least along the stripe.

    ``peak`` are windows of M lines in their order, with centres (M,) of the preferred method. All methods are compared
    only if that method lacks its advantage over ``first``. Another one is used if it scatters less by
    `_Rule.gain` and ``gain_px``.
    """
    rows = _select_runs(peak.start.size)
    # The median of the lines that are compared, because only their scatter decides; counting is faster than sorting.
    narrow = np.count_nonzero(peak.sigma[rows[::2]] < _Rule.narrowest)
    if rows.shape[1] <= 2 * _Rule.reach or 2 * narrow > rows[::2].size:
        return centre
    own, (of_first,) = _measure_scatters(peak, centre, (first,), rows[::2])
    if not of_first <= _Rule.advantage * own:
        return centre
    own, scatters = _measure_scatters(peak, centre, (first, *others), rows)
    best = int(np.argmin(scatters))
    if not own - scatters[best] > max(_Rule.gain * own, _Rule.gain_px):
        return centre
    return (first, *others)[best].centres(peak)


def _measure_scatters(
    peak: PeakWindow, centre: np.ndarray, others: tuple[ModuleType, ...], rows: np.ndarray
) -> tuple[float, list[float]]:
    """Return the root mean square distance, px, from parabolas through neighbours: of centres, and of other methods.

    ``rows`` (R, K) are the lines of R runs. The distances are NaN if too few lines belong to a smooth stripe.
    """
    some, reach = peak.select(rows.ravel()), _Rule.reach
    middle = (some.start + some.middle).reshape(rows.shape)
    broken = np.abs(np.diff(middle, axis=1)) > _Rule.jump * peak.window.shape[1]
    # Lines without a jump to a neighbour within the reach.
    smooth = ~sliding_window_view(broken, 2 * reach, axis=1).any(axis=2)
    centres = [centre[rows.ravel()], *(other.centres(some) for other in others)]
    places = np.reshape([some.start + values.astype(float) for values in centres], (-1, *rows.shape))
    left = sliding_window_view(places, 2 * reach + 1, axis=2) @ _residual_weights(reach)
    count = np.count_nonzero(smooth)
    squares = np.minimum(np.abs(left[:, smooth]), _Rule.largest_px) ** 2
    scatters = np.sqrt(squares.sum(axis=1) / count if count >= _Rule.fewest else np.full(len(places), np.nan)).tolist()
    return scatters[0], scatters[1:]


@lru_cache(maxsize=16)
def _select_runs(count: int) -> np.ndarray:
    """Return the indices (R, K) of runs spread over ``count`` lines, or all lines as one run if they are few."""
    if count <= _Rule.run * _Rule.runs:
        return np.arange(count)[None]
    return np.linspace(0, count - _Rule.run, _Rule.runs).astype(np.intp)[:, None] + np.arange(_Rule.run)


@lru_cache
def _residual_weights(reach: int) -> np.ndarray:
    """Return weights (2 R + 1,) of centres that give the middle one's distance from their least-squares parabola."""
    powers = np.vander(np.arange(-reach, reach + 1, dtype=float), 3)
    weights = -np.linalg.pinv(powers)[-1]
    weights[reach] += 1.0
    return weights
