"""Drift model of a navigation: each component is the integral of a rate error, plus a random walk.

A navigation filter models the same two errors for a velocity sensor or a gyroscope: a bias, constant or a first-order
Gauss-Markov process, and white noise (Farrell, Aided Navigation, 2008, sections 4.6 and 4.9). If positions are
dead-reckoned from velocities v, a heading error e adds the integral of e z x v to the position error (ibid.,
chapter 12).
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from itertools import product

import numpy as np
from scipy.integrate import cumulative_trapezoid
from scipy.optimize import nnls

from uwlts.errors import EvaluationError
from uwlts.model.trajectory import Trajectory

_EXACT = np.repeat([1e-3, 1e-7], 3)
"""Lower bound of the drift at the end, mm and rad; no navigation is more accurate."""
_START = 1e-7
"""Variance relative to that at the end, below which it counts as zero: 0.1 mm of 0.3 m."""
_AS_DEAD_RECKONED = 0.5
"""Least ratio of the position-heading covariance to that of dead reckoning, for positions to count as dead-reckoned."""
_WALKS = (0.0, 1e-6, 1e-5, 1e-4, 1e-3, 3e-3, 0.01, 0.03, 0.1, 0.3, 0.6, 1.0)
"""Candidate fractions of a random walk in the variance at the end, if none is stated."""
RATES = (0.03, False), (0.1, False), (0.3, False), (1.0, False), (3.0, False), (0.3, True)
"""Candidates for the rates if none is stated: correlation time relative to the path, and whether they are smooth.

Faster rates are like a random walk, slower ones like a constant rate with a random walk of its own.
"""


@dataclass(frozen=True, eq=False)
class DriftModel:
    """Drift of a navigation that starts without error."""

    std: np.ndarray
    """(6,); standard deviation of position (mm) and rotation (rad) at the end, for each axis, without the effect of
    heading errors on position."""
    walk: np.ndarray  # (6,); fraction of the random walk in this variance; the rest is due to the rates
    correlation: float  # correlation time of the rates, relative to the duration of the path; inf for constant rates
    smooth: bool
    """Rates are correlated as in a smooth process, instead of a first-order Gauss-Markov process."""
    dead_reckoned: bool  # heading errors rotate the direction of travel
    stated: bool  # a covariance states these values; otherwise walk and correlation are estimated

    @classmethod
    def of_size(cls, drift_mm: float, drift_deg: float) -> DriftModel:
        """Return the default model for a given standard deviation at the end."""
        if not (0 < drift_mm < np.inf and 0 < drift_deg < 90):
            raise EvaluationError(
                f"the drift is {drift_mm:g} mm and {drift_deg:g} deg; expected positive numbers, below 90 deg"
            )
        std = np.repeat([drift_mm, float(np.radians(drift_deg))], 3)
        return cls(std, np.full(6, 0.01), 1.0, False, False, False)

    def covariance(self, earlier_s: np.ndarray, later_s: np.ndarray, lasting_s: float) -> np.ndarray:
        """Return the covariances (6, ...) of each component between times since the start, for a given duration."""
        t, u = earlier_s / lasting_s, later_s / lasting_s
        variance, walk = (each.reshape(6, *np.ones(np.ndim(t - u), int)) for each in (self.std**2, self.walk))
        if np.isinf(self.correlation):
            by_rates = t * u
        else:
            # A stationary rate has stationary increments, whose variance determines the covariance.
            of_t, of_u, of_both, of_end = map(self._increment, (t, u, np.abs(t - u), 1.0))
            by_rates = (of_t + of_u - of_both) / (2 * of_end)
        return variance * ((1 - walk) * by_rates + walk * np.minimum(t, u))

    def deviation(self, step: float) -> np.ndarray:
        """Return the standard deviation (6,) of the drift in the middle of a step from the mean of both ends.

        ``step`` is relative to the duration of the path.
        """
        by_rates, by_walk = 0.0, step / 4
        if np.isfinite(self.correlation):
            by_rates = (self._increment(step / 2) - self._increment(step) / 4) / self._increment(1.0)
        return self.std * np.sqrt(np.maximum((1 - self.walk) * by_rates + self.walk * by_walk, 0.0))

    def _increment(self, t: np.ndarray | float) -> np.ndarray:
        """Return the variance of the integral over a time t of a rate with the correlation exp(-a).

        A smooth rate has the correlation (1 + a) exp(-a) (Matern: Rasmussen and Williams, Gaussian Processes for
        Machine Learning, 2006, section 4.2).
        """
        a = np.asarray(t) / self.correlation
        return 2 * a - 3 + (3 + a) * np.exp(-a) if self.smooth else 2 * (a + np.expm1(-a))

    def candidates(self) -> list[DriftModel]:
        """Return the drift with each candidate for the rates and each fraction of a random walk."""
        return [
            replace(self, walk=np.full(6, share), correlation=correlation, smooth=smooth)
            for (correlation, smooth), share in product(RATES, _WALKS)
        ]


def candidates_beside(number: int, *, walk_only: bool) -> list[int]:
    """Return the numbers of a given candidate and of those beside it.

    These have the same rates and the next walks or, unless ``walk_only``, the same walk and other rates.
    """
    walk = number % len(_WALKS)
    next_walks = [number + step for step in (-1, 1) if 0 <= walk + step < len(_WALKS)]
    return ([number] if walk_only else [len(_WALKS) * each + walk for each in range(len(RATES))]) + next_walks


def choose_drift_model(trajectory: Trajectory, drift_mm: float | None, drift_deg: float | None) -> DriftModel:
    """Return the drift model from the covariance of a trajectory, or from given standard deviations.

    Raises EvaluationError if the given values are not valid, or no covariance is stated.
    """
    if drift_mm is not None and drift_deg is not None:
        return DriftModel.of_size(drift_mm, drift_deg)
    if drift_mm is not None or drift_deg is not None:
        raise EvaluationError("only one of drift_mm and drift_deg was given; give both")
    if trajectory.covariance is None:
        raise EvaluationError("the trajectory states no covariance: give drift_mm and drift_deg")
    variance = np.einsum("nii->ni", trajectory.covariance).copy()
    dead_reckoned = _is_dead_reckoned(trajectory)
    if dead_reckoned:
        # The prior adds the effect of heading errors.
        variance[:, :2] -= trajectory.covariance[:, :2, 5] ** 2 / np.maximum(variance[:, 5:], _EXACT[5] ** 2)
    grown = np.maximum(variance.max(axis=0) - variance[0], _EXACT**2)
    # The difference between two absolute measurements has up to twice the variance of one.
    measured = (grown < variance[0]) & (2 * variance[0] < np.repeat(grown.reshape(2, 3).max(axis=1), 3))
    parts = np.array([_rate_and_walk(trajectory.times_s, each) for each in (variance / grown).T])
    parts *= grown[:, None]
    parts[measured] = np.column_stack([np.zeros(6), 2 * variance[0]])[measured]
    size = np.maximum(parts.sum(axis=1), _EXACT**2)
    return DriftModel(np.sqrt(size), parts[:, 1] / size, np.inf, False, dead_reckoned, True)


def _rate_and_walk(times_s: np.ndarray, variance: np.ndarray) -> np.ndarray:
    """Split a variance (N,) into contributions (2,) of a constant rate and a random walk at the end of the path.

    The drift may begin before the first pose. The best such time is found by least squares of relative errors.
    """
    t = ((times_s - times_s[0]) / (times_s[-1] - times_s[0]))[:, None]
    # Errors are relative, since only the first poses discriminate between a walk and an earlier start of a rate.
    size = np.maximum(variance[:, None], _START)

    fits = [nnls((t + before) ** (2, 1) / size, np.ones(len(t))) for before in (0.0, *np.logspace(-4, 1, 201))]
    return min(fits, key=lambda fit: fit[1])[0]


def _is_dead_reckoned(trajectory: Trajectory) -> bool:
    """Check whether the covariance of position and heading corresponds to dead reckoning from velocities v.

    For a heading error of variance V from a constant rate, it is sqrt(V(t)) times the integral of sqrt(V) z x v.
    """
    assert trajectory.covariance is not None
    heading = np.sqrt(trajectory.covariance[:, 5, 5])
    velocity = trajectory.rates_at(trajectory.times_s)
    aside = heading[:, None] * np.column_stack([-velocity[:, 1], velocity[:, 0]])
    expected = heading[:, None] * cumulative_trapezoid(aside, trajectory.times_s, axis=0, initial=0.0)
    stated = trajectory.covariance[:, :2, 5]
    return bool(np.sum(stated * expected) > _AS_DEAD_RECKONED * np.sum(expected**2))
