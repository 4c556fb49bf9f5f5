"""Largest mean of neighbours in noisy profiles, with a coverage interval for any noise-free profile.

Noise biases the maximum upwards: strongly if many values are nearly equal, not at all if one value stands out. Adding
the same noise once more shows the size of the bias (simulation extrapolation, Cook and Stefanski, Journal of the
American Statistical Association 89, 1994).

The interval does not depend on this assumption. Its upper end uses a one-sided bound for the noise of a single mean,
its lower end a bound for the largest noise of all means.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from numpy.lib.stride_tricks import sliding_window_view

from uwlts.fitting.least_squares import robust_std
from uwlts.inspection.features import COVERAGE, COVERAGE_FACTOR, SEED

_DRAWS = 2000
"""Noise draws: fifty exceed the 97.5 % quantile, which is then known to a tenth of a standard deviation."""
BIAS_FACTOR = 1 / (np.sqrt(2) - 1)
"""Bias by the noise divided by the increase when the noise is added once more, for a bias proportional to its std."""


class Largest(NamedTuple):
    """Largest mean, the ends of its 95 % interval, and the weights (n,) of the values of each profile in it."""

    value: float
    low: float
    high: float
    weights: tuple[np.ndarray, ...]


def largest_mean(profiles: Sequence[np.ndarray], count: int, *, noise: float | None = None) -> Largest:
    """Return the largest mean of ``count`` neighbours in any of the profiles (n,), whose noise is independent.

    NaN values are unknown: means use known neighbours only. The result is NaN if all values are unknown.

    The standard deviation ``noise`` is estimated from differences of neighbours by default (von Neumann et al.,
    Annals of Mathematical Statistics 12, 1941). This estimate is robust to outliers and also contains real changes from
    one value to the next.
    """
    known = [np.flatnonzero(np.isfinite(profile)) for profile in profiles]
    owns = [profile[own] for profile, own in zip(profiles, known, strict=True) if len(own)]
    weights = [np.zeros(len(profile)) for profile in profiles]
    if not owns:
        return Largest(np.nan, np.nan, np.nan, tuple(weights))
    jumps = np.concatenate([np.diff(own) for own in owns])
    seen_noise = robust_std(jumps) / np.sqrt(2) if len(jumps) else 0.0
    std = seen_noise if noise is None else noise
    rng = np.random.default_rng(SEED)
    means = [_average_neighbours(own[None], count) for own in owns]
    drawn = [_average_neighbours(std * rng.standard_normal((_DRAWS, len(own))), count) for own in owns]
    seen = max(float(each.max()) for each in means)
    alone = np.max([each.max(axis=1) for each in drawn], axis=0)
    again = np.max([(mean + move).max(axis=1) for mean, move in zip(means, drawn, strict=True)], axis=0)
    tail = 0.5 * (1 - COVERAGE)
    low = seen - float(np.quantile(alone, 1 - tail))
    high = seen + COVERAGE_FACTOR * max(float(each.std(axis=0).max()) for each in drawn)
    value = float(np.clip(seen - BIAS_FACTOR * (again.mean() - seen), low, high))
    for number, own in enumerate(k for k in range(len(profiles)) if len(known[k])):
        if float(means[number].max()) == seen:
            first = int(np.argmax(means[number]))
            weights[own][known[own][first : first + min(count, len(known[own]))]] = 1 / min(count, len(known[own]))
            break
    return Largest(value, low, high, tuple(weights))


def _average_neighbours(values: np.ndarray, count: int) -> np.ndarray:
    """Return means (M, n - count + 1) of neighbours in rows of values (M, n)."""
    return sliding_window_view(values, min(count, values.shape[1]), axis=1).mean(axis=2)
