"""Prior distribution of a path correction, from a model of the navigation's drift.

Unknowns are ordered by component: translation along X at all C nodes, then Y and Z, then the rotations about them.

A navigation filter models the same two errors for a velocity sensor or a gyroscope: a bias, constant or a first-order
Gauss-Markov process, and white noise (Farrell, Aided Navigation, 2008, sections 4.6 and 4.9). If positions are
dead-reckoned from velocities v, a heading error e adds the integral of e z x v to the position error (ibid.,
chapter 12).
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property
from itertools import product
from typing import Any

import numpy as np
from scipy.integrate import cumulative_trapezoid
from scipy.linalg import get_blas_funcs
from scipy.optimize import nnls

from uwlts.errors import EvaluationError
from uwlts.model.trajectory import Trajectory

_LEAST_DRIFT = np.repeat([1e-3, 1e-7], 3)
"""Lower bound of the drift at the end, mm and rad; no navigation is more accurate."""
_START = 1e-7  # variance relative to that at the end, below which it counts as zero: 0.1 mm of 0.3 m
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
            of_t, of_u, of_both, of_end = map(self._integrate_rate, (t, u, np.abs(t - u), 1.0))
            by_rates = (of_t + of_u - of_both) / (2 * of_end)
        return variance * ((1 - walk) * by_rates + walk * np.minimum(t, u))

    def deviation(self, step: float) -> np.ndarray:
        """Return the standard deviation (6,) of the drift in the middle of a step from the mean of both ends.

        ``step`` is relative to the duration of the path.
        """
        by_rates, by_walk = 0.0, step / 4
        if np.isfinite(self.correlation):
            by_rates = (self._integrate_rate(step / 2) - self._integrate_rate(step) / 4) / self._integrate_rate(1.0)
        return self.std * np.sqrt(np.maximum((1 - self.walk) * by_rates + self.walk * by_walk, 0.0))

    def _integrate_rate(self, t: np.ndarray | float) -> np.ndarray:
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
        variance[:, :2] -= trajectory.covariance[:, :2, 5] ** 2 / np.maximum(variance[:, 5:], _LEAST_DRIFT[5] ** 2)
    grown = np.maximum(variance.max(axis=0) - variance[0], _LEAST_DRIFT**2)
    # The difference between two absolute measurements has up to twice the variance of one.
    measured = (grown < variance[0]) & (2 * variance[0] < np.repeat(grown.reshape(2, 3).max(axis=1), 3))
    parts = np.array([_split_rate_and_walk(trajectory.times_s, each) for each in (variance / grown).T])
    parts *= grown[:, None]
    parts[measured] = np.column_stack([np.zeros(6), 2 * variance[0]])[measured]
    size = np.maximum(parts.sum(axis=1), _LEAST_DRIFT**2)
    return DriftModel(np.sqrt(size), parts[:, 1] / size, np.inf, False, dead_reckoned, True)


def _split_rate_and_walk(times_s: np.ndarray, variance: np.ndarray) -> np.ndarray:
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
    return bool(np.sum(trajectory.covariance[:, :2, 5] * expected) > _AS_DEAD_RECKONED * np.sum(expected**2))


_EXACT = 1e-10  # variance at the start of the path, relative to that at its end; the start defines the frame

_multiply_by_triangle: Any = get_blas_funcs("trmm", dtype=np.float64)


@dataclass(frozen=True, eq=False)
class PathPrior:
    """Normal distribution of the values at nodes (C,) that follows from the drift along a trajectory.

    The values are a root R (6 C, 6 C) times whitened coordinates. R is not formed explicitly, since the components are
    independent except for the effect of heading errors on position.
    """

    nodes_s: np.ndarray
    drift: DriftModel
    trajectory: Trajectory
    order: np.ndarray
    """(C,) int; nodes in the order of the whitened coordinates of each component: those in crossings first, so that
    observations there involve the first coordinates only."""

    @classmethod
    def from_times(cls, times_s: np.ndarray, drift: DriftModel, trajectory: Trajectory, *, intervals: int) -> PathPrior:
        """Return the prior with regular nodes over the times (N,) of the points."""
        nodes = np.linspace(times_s.min(), times_s.max(), intervals + 1)
        return cls(nodes, drift, trajectory, np.arange(intervals + 1))

    def with_nodes(self, times_s: np.ndarray, step_s: float, *, most: int) -> PathPrior:
        """Return the prior with additional nodes around times (N,).

        Their spacing is ``step_s``, or larger if more than ``most`` nodes would be needed.
        """
        first, last = self.nodes_s[[0, -1]]
        while True:
            cells = np.unique(np.floor((times_s - first) / step_s))
            closer = first + step_s * np.union1d(cells, cells + 1)
            if len(closer) <= most:
                break
            step_s *= 2
        # Drop regular nodes between dense ones, which would create short intervals.
        separate = np.min(np.abs(self.nodes_s[:, None] - closer), axis=1, initial=np.inf) > step_s
        separate[[0, -1]] = True
        inner = closer[(closer > first + step_s / 2) & (closer < last - step_s / 2)]
        nodes = np.union1d(self.nodes_s[separate], inner)
        return replace(self, nodes_s=nodes, order=np.argsort(~np.isin(nodes, inner), kind="stable"))

    @property
    def count(self) -> int:
        """Number C of nodes."""
        return len(self.nodes_s)

    def weights(self, times_s: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return the index (N,) of the node before each time (N,), and the weight (N,) of the next node."""
        before = np.clip(np.searchsorted(self.nodes_s, times_s, side="right") - 1, 0, self.count - 2)
        return before, np.clip((times_s - self.nodes_s[before]) / np.diff(self.nodes_s)[before], 0.0, 1.0)

    def basis(self, times_s: np.ndarray) -> np.ndarray:
        """Return the weights (N, C) of all nodes at times (N,)."""
        (before, after), rows = self.weights(times_s), np.arange(len(times_s))
        result = np.zeros((len(times_s), self.count))
        result[rows, before], result[rows, before + 1] = 1 - after, after
        return result

    def evaluate(self, values: np.ndarray, times_s: np.ndarray) -> np.ndarray:
        """Interpolate translations and rotations (N, 6) at times (N,) from the values (6 C,) at the nodes."""
        return np.stack([np.interp(times_s, self.nodes_s, each) for each in values.reshape(6, -1)], axis=1)

    def times_root(self, matrix: np.ndarray) -> np.ndarray:
        """Return R times a matrix (6 C, K)."""
        parts = np.empty((6, self.count, matrix.shape[1]))
        parts[:, self.order] = self._multiply_by_triangles(matrix, transposed=False)
        if self.drift.dead_reckoned:
            parts[0] -= self._turned[1] @ parts[5]
            parts[1] += self._turned[0] @ parts[5]
        return parts.reshape(matrix.shape)

    def times_transposed_root(self, matrix: np.ndarray) -> np.ndarray:
        """Return the transpose of R times a matrix (6 C, K)."""
        if self.drift.dead_reckoned:
            matrix = matrix.copy()
            parts = matrix.reshape(6, self.count, -1)
            parts[5] += self._turned[0].T @ parts[1] - self._turned[1].T @ parts[0]
        parts = matrix.reshape(6, self.count, -1)[:, self.order]
        return self._multiply_by_triangles(parts, transposed=True).reshape(matrix.shape)

    def _multiply_by_triangles(self, matrix: np.ndarray, *, transposed: bool) -> np.ndarray:
        """Return products (6, M, K) of the roots of the first M coordinates, or of their transposes, with a matrix.

        BLAS multiplies triangles in half the time of full matrices; it takes and returns transposed arrays.
        """
        parts = np.array(matrix, np.float64, order="C").reshape(6, -1, matrix.shape[-1])
        for number, root in enumerate(self._roots[:, : parts.shape[1], : parts.shape[1]]):
            flags = {"side": 1, "lower": 0, "trans_a": int(transposed), "overwrite_b": 1}
            parts[number] = _multiply_by_triangle(1.0, root.T, parts[number].T, **flags).T
        return parts

    def factor(self, normal: np.ndarray) -> np.ndarray:
        """Return the lower Cholesky factor (6 C, 6 C) of the normal matrix of the whitened coordinates.

        ``normal`` (6 C, 6 C) is that of the values without prior. Coordinates after the last node that it contains keep
        their prior, except those of a heading that positions are dead-reckoned with.
        """
        seen = np.flatnonzero(normal.any(axis=0)) % self.count
        count = 1 + int(np.flatnonzero(np.isin(self.order, seen)).max(initial=0))
        of_component = self.count * np.arange(6)[:, None]
        nodes, numbers = (of_component + self.order[:count]).ravel(), (of_component + np.arange(count)).ravel()
        aside = None
        if self.drift.dead_reckoned:
            numbers = np.append(numbers[: 5 * count], 5 * self.count + np.arange(self.count))
            # Position changes (2, N, C) at the first N nodes per unit of each whitened coordinate of the heading.
            aside = self._turned[:, self.order[:count, None], self.order] @ self._roots[5]

        def times_seen_root(matrix: np.ndarray) -> np.ndarray:
            parts = matrix.reshape(6, count, -1)
            result = self._multiply_by_triangles(parts, transposed=True).reshape(matrix.shape)
            if aside is not None:
                heading = aside[0].T @ parts[1] - aside[1].T @ parts[0]
                heading[:count] += result[5 * count :]
                result = np.vstack([result[: 5 * count], heading])
            return result

        inner = times_seen_root(times_seen_root(normal[np.ix_(nodes, nodes)]).T)
        inner[np.diag_indices(len(inner))] += 1
        result = np.eye(len(normal))
        result[np.ix_(numbers, numbers)] = np.linalg.cholesky(inner)
        return result

    @cached_property
    def _roots(self) -> np.ndarray:
        """Lower triangular roots (6, C, C) of the covariance of each component at the nodes."""
        at = self.nodes_s - self.nodes_s[0]
        at, lasting = at[self.order], at[-1]
        covariance = self.drift.covariance(at[:, None], at, lasting)
        return np.linalg.cholesky(covariance + _EXACT * self.drift.std[:, None, None] ** 2 * np.eye(len(at)))

    @cached_property
    def _turned(self) -> np.ndarray:
        """Position changes (2, C, C) along X and Y, mm, at each node per unit of rotation at each node."""
        steps = np.diff(self.trajectory.poses_at(self.nodes_s)[:, :2, 3], axis=0)
        mean = (np.eye(self.count)[1:] + np.eye(self.count)[:-1]) / 2
        until = np.tri(self.count, self.count - 1, -1)
        return np.array([until @ (along[:, None] * mean) for along in steps.T])
