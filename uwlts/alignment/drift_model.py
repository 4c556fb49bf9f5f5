"""Model of a navigation's drift: each component is the integral of a rate, plus a random walk.

These are the two errors that a navigation filter itself carries for a velocity or a gyroscope: a bias, and white noise
(Farrell, Aided Navigation, 2008, sections 4.6 and 4.9). Where positions are dead-reckoned from velocities v, a heading
error e adds the integral of e z x v to the error of the position (ibid., chapter 12).
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from scipy.integrate import cumulative_trapezoid
from scipy.optimize import nnls

from uwlts.errors import EvaluationError
from uwlts.model.trajectory import Trajectory

_EXACT = np.repeat([1e-3, 1e-7], 3)
"""The least drift at the end, mm and rad: navigation is not better."""
_START = 1e-7
"""Variance relative to that at the end that counts as none: 0.1 mm of 0.3 m."""
_AS_DEAD_RECKONED = 0.5
"""Of the covariance of shift and heading by dead reckoning: positions with more are taken as dead-reckoned."""
_WALKS = (0.0, 1e-6, 1e-5, 1e-4, 1e-3, 3e-3, 0.01, 0.03, 0.1, 0.3)
"""Shares of a walk in the variance at the end that are compared where none is stated."""
_CORRELATION = 0.3
"""Correlation time of rates, relative to the pass, where none is stated: they change several times at most. Chosen on
simulated loops 0 and 1 of 4 m: gains and coverage hardly differ from 0.2 to 0.5, and a steady rate states too little.
"""


@dataclass(frozen=True, eq=False)
class DriftModel:
    """Drift of a navigation from an exact start.

    Attributes
    ----------
    std : (6,) float64
        Standard deviation of shift (mm) and turn (rad) at the end, along and about each axis, without what the
        heading causes.
    walk : (6,) float64
        Share of the random walk in this variance; the rest is by the rates.
    correlation : float
        Correlation time of the rates, relative to the duration of the path; inf if they are steady.
    dead_reckoned : bool
        Whether a wrong heading turns the way travelled.
    stated : bool
        Whether a covariance says all this; else the share of the walk is estimated.
    """

    std: np.ndarray
    walk: np.ndarray
    correlation: float
    dead_reckoned: bool
    stated: bool

    @classmethod
    def of_size(cls, drift_mm: float, drift_deg: float) -> DriftModel:
        """Return the model of a drift whose size (standard deviation at the end) is all that is known."""
        if not (0 < drift_mm < np.inf and 0 < drift_deg < 90):
            raise EvaluationError(f"the drift is {drift_mm:g} mm and {drift_deg:g} deg; expected positive numbers")
        std = np.repeat([drift_mm, float(np.radians(drift_deg))], 3)
        return cls(std, np.full(6, 0.01), _CORRELATION, False, False)

    def covariance(self, earlier_s: np.ndarray, later_s: np.ndarray, lasting_s: float) -> np.ndarray:
        """Return the covariances (6, ...) of each component between times since the start, of so many at the end."""
        t, u = earlier_s / lasting_s, later_s / lasting_s
        variance, walk = (each.reshape(6, *np.ones(np.ndim(t - u), int)) for each in (self.std**2, self.walk))
        if np.isinf(self.correlation):
            by_rates = t * u
        else:
            # Increments of a stationary rate are stationary: their variance gives the covariance.
            of_t, of_u, of_both, of_end = map(self._increment, (t, u, np.abs(t - u), 1.0))
            by_rates = (of_t + of_u - of_both) / (2 * of_end)
        return variance * ((1 - walk) * by_rates + walk * np.minimum(t, u))

    def _increment(self, t: np.ndarray | float) -> np.ndarray:
        """Variance of the integral over a time t of a rate with Matern's correlation (1 + a) exp(-a).

        It changes smoothly (Rasmussen and Williams, Gaussian Processes for Machine Learning, 2006, section 4.2).
        """
        a = np.asarray(t) / self.correlation
        return 2 * a - 3 + (3 + a) * np.exp(-a)

    def with_walks(self) -> list[DriftModel]:
        """Return the same drift with each share of a walk that is compared."""
        return [replace(self, walk=np.full(6, share)) for share in _WALKS]


def drift_of(trajectory: Trajectory, drift_mm: float | None, drift_deg: float | None) -> DriftModel:
    """Return the drift by the covariance of a trajectory, or by a size along each axis.

    Raises
    ------
    EvaluationError
        The size is wrong, or not known.
    """
    if drift_mm is not None and drift_deg is not None:
        return DriftModel.of_size(drift_mm, drift_deg)
    if drift_mm is not None or drift_deg is not None:
        raise EvaluationError("the drift needs both parts: drift_mm and drift_deg")
    if trajectory.covariance is None:
        raise EvaluationError("the trajectory states no covariance: give drift_mm and drift_deg")
    variance = np.einsum("nii->ni", trajectory.covariance).copy()
    dead_reckoned = _is_dead_reckoned(trajectory)
    if dead_reckoned:
        # The prior adds the part that the heading causes.
        variance[:, :2] -= trajectory.covariance[:, :2, 5] ** 2 / np.maximum(variance[:, 5:], _EXACT[5] ** 2)
    grown = np.maximum(variance.max(axis=0) - variance[0], _EXACT**2)
    # What is measured all along differs from its start by up to twice its variance.
    measured = (grown < variance[0]) & (2 * variance[0] < np.repeat(grown.reshape(2, 3).max(axis=1), 3))
    parts = np.array([_rate_and_walk(trajectory.times_s, each) for each in (variance / grown).T])
    parts *= grown[:, None]
    parts[measured] = np.column_stack([np.zeros(6), 2 * variance[0]])[measured]
    size = np.maximum(parts.sum(axis=1), _EXACT**2)
    return DriftModel(np.sqrt(size), parts[:, 1] / size, np.inf, dead_reckoned, True)


def _rate_and_walk(times_s: np.ndarray, variance: np.ndarray) -> np.ndarray:
    """Parts (2,) of a variance (N,) at the end that a steady rate and a random walk have made since the start.

    The drift began before the first pose, as long before as explains the variance best, relative to its size.
    """
    t = ((times_s - times_s[0]) / (times_s[-1] - times_s[0]))[:, None]
    # Only the first poses tell a walk from a rate that began before them: errors count by their size.
    size = np.maximum(variance[:, None], _START)

    fits = [nnls((t + before) ** (2, 1) / size, np.ones(len(t))) for before in (0.0, *np.logspace(-4, 1, 201))]
    return min(fits, key=lambda fit: fit[1])[0]


def _is_dead_reckoned(trajectory: Trajectory) -> bool:
    """Check whether the covariance of shift and heading is that of positions dead-reckoned from velocities v.

    A heading whose error grows steadily to a variance V gives sqrt(V(t)) times the integral of sqrt(V) z x v until t.
    """
    assert trajectory.covariance is not None
    heading = np.sqrt(trajectory.covariance[:, 5, 5])
    velocity = trajectory.rates_at(trajectory.times_s)
    aside = heading[:, None] * np.column_stack([-velocity[:, 1], velocity[:, 0]])
    expected = heading[:, None] * cumulative_trapezoid(aside, trajectory.times_s, axis=0, initial=0.0)
    stated = trajectory.covariance[:, :2, 5]
    return bool(np.sum(stated * expected) > _AS_DEAD_RECKONED * np.sum(expected**2))
