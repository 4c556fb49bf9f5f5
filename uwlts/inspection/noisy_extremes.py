"""Largest mean of neighbours in noisy profiles, with an interval that holds whatever the profiles without noise are.

The largest of noisy values lies too high: by much where many are alike, by nothing where one stands out. How much shows
when the profiles get their noise once more (simulation extrapolation, Cook and Stefanski, Journal of the American
Statistical Association 89, 1994). The interval needs no such assumption. Where the true profile is largest the noise
is below a one-sided bound of a single mean; nowhere it is above a bound of the largest noise of all means.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from numpy.lib.stride_tricks import sliding_window_view

from uwlts.fitting.least_squares import robust_std
from uwlts.inspection.features import COVERAGE, COVERAGE_FACTOR

_DRAWS = 2000
"""Draws of noise: fifty are beyond a quantile of 97.5 %, which is right to a tenth of a standard deviation."""
_SEED = 635
"""Of the draws, so that the same profiles have the same values."""
_TO_NO_NOISE = 1 / (np.sqrt(2) - 1)
"""Noise once more adds this part of what the noise itself has added, where that is proportional to its deviation."""


class Largest(NamedTuple):
    """Largest mean, the ends of its 95 % interval, and the weights (n,) that values of each profile have in it."""

    value: float
    low: float
    high: float
    weights: tuple[np.ndarray, ...]


def largest_mean(profiles: Sequence[np.ndarray], count: int, *, noise: float | None = None) -> Largest:
    """Largest mean of ``count`` neighbours in any of some profiles (n,) of values with independent noise of one kind.

    Values that are NaN are not known; means are of known neighbours. NaN where nothing is known. Without a ``noise``,
    its standard deviation, it is that of differences of neighbours (von Neumann et al., Annals of Mathematical
    Statistics 12, 1941), outliers aside, so that what varies from one value to the next counts as noise.
    """
    known = [np.flatnonzero(np.isfinite(profile)) for profile in profiles]
    owns = [profile[own] for profile, own in zip(profiles, known, strict=True) if len(own)]
    weights = [np.zeros(len(profile)) for profile in profiles]
    if not owns:
        return Largest(np.nan, np.nan, np.nan, tuple(weights))
    jumps = np.concatenate([np.diff(own) for own in owns])
    seen_noise = robust_std(jumps) / np.sqrt(2) if len(jumps) else 0.0
    std = seen_noise if noise is None else noise
    rng = np.random.default_rng(_SEED)
    means = [_means(own[None], count) for own in owns]
    drawn = [_means(std * rng.standard_normal((_DRAWS, len(own))), count) for own in owns]
    seen = max(float(each.max()) for each in means)
    alone = np.max([each.max(axis=1) for each in drawn], axis=0)
    again = np.max([(mean + move).max(axis=1) for mean, move in zip(means, drawn, strict=True)], axis=0)
    tail = 0.5 * (1 - COVERAGE)
    low = seen - float(np.quantile(alone, 1 - tail))
    high = seen + COVERAGE_FACTOR * max(float(each.std(axis=0).max()) for each in drawn)
    value = float(np.clip(seen - _TO_NO_NOISE * (again.mean() - seen), low, high))
    for number, own in enumerate(k for k in range(len(profiles)) if len(known[k])):
        if float(means[number].max()) == seen:
            first = int(np.argmax(means[number]))
            weights[own][known[own][first : first + min(count, len(known[own]))]] = 1 / min(count, len(known[own]))
            break
    return Largest(value, low, high, tuple(weights))


def _means(values: np.ndarray, count: int) -> np.ndarray:
    """Means (M, n - count + 1) of neighbours in rows of values (M, n)."""
    return sliding_window_view(values, min(count, values.shape[1]), axis=1).mean(axis=2)
