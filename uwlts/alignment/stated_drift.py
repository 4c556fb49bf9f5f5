"""Size and kind of a navigation's drift by the covariance of its poses."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.integrate import cumulative_trapezoid
from scipy.optimize import minimize_scalar, nnls

from uwlts.alignment.path_prior import DriftKind
from uwlts.errors import EvaluationError
from uwlts.model.trajectory import Trajectory

_EXACT = np.repeat([1e-3, 1e-7], 3)
"""The least drift at the end, mm and rad: navigation is not better."""
_LEAST_RATE = 1e-3
"""Least part of a steady rate in the variance at the end."""
_LEAST = 1e-7
"""Smaller parts of a variance count as this one."""
_AS_DEAD_RECKONED = 0.5
"""Of the covariance of shift and heading by dead reckoning: positions with more are taken as dead-reckoned."""


@dataclass(frozen=True, eq=False)
class StatedDrift:
    """Drift at the end of a path, from an exact start.

    Attributes
    ----------
    size : (6,) float64
        Standard deviation of shift (mm) and turn (rad) by a steady rate.
    measured : (6,) bool
        What is measured all along, as depth and tilt.
    kind : DriftKind, optional
        What else there is, over the variance by a steady rate; None where that is not stated.
    """

    size: np.ndarray
    measured: np.ndarray
    kind: DriftKind | None


def stated_drift(trajectory: Trajectory, drift_mm: float | None, drift_deg: float | None) -> StatedDrift:
    """Drift by the covariance of a trajectory, or of a size along each axis.

    Raises
    ------
    EvaluationError
        The size is wrong, or not known.
    """
    if (drift_mm is None) != (drift_deg is None):
        raise EvaluationError("the drift needs both parts: drift_mm and drift_deg")
    if drift_mm is not None and drift_deg is not None:
        if not (0 < drift_mm < np.inf and 0 < drift_deg < 90):
            raise EvaluationError(f"the drift is {drift_mm:g} mm and {drift_deg:g} deg; expected positive numbers")
        return StatedDrift(np.repeat([drift_mm, float(np.radians(drift_deg))], 3), np.zeros(6, bool), None)
    if trajectory.covariance is None:
        raise EvaluationError("the trajectory states no covariance: give drift_mm and drift_deg")
    variance = np.einsum("nii->ni", trajectory.covariance).copy()
    by_heading = _is_dead_reckoned(trajectory)
    if by_heading:
        # The prior adds the part that the heading causes.
        variance[:, :2] -= trajectory.covariance[:, :2, 5] ** 2 / np.maximum(variance[:, 5:], _EXACT[5] ** 2)
    grown = np.maximum(variance.max(axis=0) - variance[0], _EXACT**2)
    # What is measured all along differs from its start by up to twice its variance.
    measured = (grown < variance[0]) & (2 * variance[0] < np.repeat(grown.reshape(2, 3).max(axis=1), 3))
    size, walks, wandering = np.where(measured, 2 * variance[0], 0.0), [], []
    for own in (np.arange(6) < 3, np.arange(6) >= 3):
        which = own & ~measured
        shares = _shares(trajectory.times_s, (variance / grown)[:, which])
        size[which] = shares[0] * grown[which]
        wandering.append(float(shares[1] / shares[0]))
        walks.append(max(float(shares[2] / shares[0]), _LEAST))
    kind = DriftKind(0.0, wandering[0], *walks, by_heading=float(by_heading))
    return StatedDrift(np.maximum(np.sqrt(size), _EXACT), measured, kind)


def _shares(times_s: np.ndarray, variances: np.ndarray) -> np.ndarray:
    """Parts (3,) of variances (N, K) at the end that a steady rate, one that wanders and a random walk have made since
    the start.

    The drift began before the first pose, as long before as explains the variances best, each by its own size.
    """
    count = variances.shape[1]
    if count == 0:
        return np.array([1.0, 0.0, 0.0])
    t = np.tile((times_s - times_s[0]) / (times_s[-1] - times_s[0]), count)[:, None]
    size = np.maximum(variances.T.reshape(-1, 1), _LEAST)

    def fit(before: float) -> tuple[np.ndarray, float]:
        return nnls((t + 10**before) ** (2, 3, 1) / size, np.ones(len(t)))

    tried = np.linspace(-4, 1, 51)
    near = tried[np.argmin([fit(before)[1] for before in tried])]
    best = minimize_scalar(lambda before: fit(before)[1], bounds=(near - 0.1, near + 0.1), method="bounded")
    parts, _ = fit(float(best.x))
    return np.maximum(parts, (_LEAST_RATE, 0.0, 0.0))


def _is_dead_reckoned(trajectory: Trajectory) -> bool:
    """Whether the covariance of shift and heading is that of positions which are dead-reckoned from velocities v.

    A heading whose error grows steadily to a variance V gives sqrt(V(t)) times the integral of sqrt(V) z x v until t.
    """
    assert trajectory.covariance is not None
    heading = np.sqrt(trajectory.covariance[:, 5, 5])
    velocity = trajectory.rates_at(trajectory.times_s)
    aside = heading[:, None] * np.column_stack([-velocity[:, 1], velocity[:, 0]])
    expected = heading[:, None] * cumulative_trapezoid(aside, trajectory.times_s, axis=0, initial=0.0)
    stated = trajectory.covariance[:, :2, 5]
    return bool(np.sum(stated * expected) > _AS_DEAD_RECKONED * np.sum(expected**2))
