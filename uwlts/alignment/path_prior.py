"""Prior distribution of the correction of a path: how far, and in which ways, its navigation drifts.

A navigation drifts from an exact start by a steady rate (a bias of velocity or gyroscope), by a rate that changes
smoothly (temperature), by one that wanders (instability of the bias), and by a random walk (noise of the velocity);
these are the integrated Wiener processes of orders two, one and none. Where positions are dead-reckoned from velocities
v, a heading error e adds the integral of e z x v to the error of the position (Farrell, Aided Navigation, 2008,
chapter 12).
What is measured all along, as a depth or a tilt, walks within the bounds of its variance. The correction is a cubic
B-spline in time.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property
from typing import NamedTuple

import numpy as np
from scipy.interpolate import BSpline

from uwlts.model.trajectory import Trajectory

_INTERVALS = 100
"""Of the spline where the path crosses nothing: a random walk goes a tenth of that of the whole path within one."""
_MOST_KNOTS = 500
"""Normal matrices of 3000 unknowns take 72 MB; where more cross, knots are farther apart."""
_EXACT = 1e-10
"""Of the variance at the end: variance of the start of the path, which is the frame's and as good as exact."""


class DriftKind(NamedTuple):
    """Variances at the end of a rate that changes smoothly, of one that wanders, and of random walks of shifts and of
    turns, over that of a steady rate, which alone would come to the drift as it is stated; and whether positions are
    dead-reckoned with the heading (1 or 0)."""

    smooth: float
    wandering: float
    walk: float
    turn_walk: float
    by_heading: float = 0.0


USUAL_DRIFT = DriftKind(smooth=0.0, wandering=0.3, walk=0.01, turn_walk=0.01)
"""Assumed first where no kind is stated."""


@dataclass(frozen=True, eq=False)
class PathSpline:
    """A trajectory, the knots of the spline over the times of the points, and the drift (6,) at its end, mm and rad, of
    components of which some (6,) are measured all along.

    Knots lie evenly, and closer where the path crosses itself: there the surface determines the random walk.
    """

    trajectory: Trajectory
    knots: np.ndarray
    drift: np.ndarray
    measured: np.ndarray
    first_s: float
    last_s: float

    @classmethod
    def of(cls, trajectory: Trajectory, drift: np.ndarray, measured: np.ndarray, times_s: np.ndarray) -> PathSpline:
        """The spline over the times (N,) of the points."""
        first, last = float(times_s.min()), float(times_s.max())
        return cls(trajectory, _knots(np.linspace(first, last, _INTERVALS + 1)), drift, measured, first, last)

    def resolved(self, times_s: np.ndarray, step_s: float) -> PathSpline:
        """The spline with knots about every ``step_s`` around times (N,), evenly elsewhere."""
        interval = (self.last_s - self.first_s) / _INTERVALS
        halvings = max(0, round(float(np.log2(interval / step_s))))
        while True:
            parts = 2**halvings
            cells = np.unique(np.floor((times_s - self.first_s) / interval * parts).astype(int))
            # A cell more on both sides: a spline bends over three intervals.
            closer = np.clip(cells[:, None] + np.arange(-1, 3), 0, _INTERVALS * parts)
            inner = np.union1d(np.arange(_INTERVALS + 1) * parts, closer)
            if len(inner) <= _MOST_KNOTS or halvings == 0:
                at = self.first_s + inner * (interval / parts)
                at[-1] = self.last_s
                return replace(self, knots=_knots(at))
            halvings -= 1

    @property
    def count(self) -> int:
        """Number C of coefficients, each of six numbers."""
        return len(self.knots) - 4

    @cached_property
    def at_s(self) -> np.ndarray:
        """Times (C,) at which each coefficient is about the correction: the mean of its knots (Greville)."""
        return np.array([self.knots[k + 1 : k + 4].mean() for k in range(self.count)])

    def weights(self, times_s: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Weights (N, 4) that are not zero at times (N,), and numbers (N, 4) of their coefficients."""
        matrix = BSpline.design_matrix(self._inside(times_s), self.knots, 3)
        return matrix.data.reshape(-1, 4), matrix.indices.reshape(-1, 4)

    def basis(self, times_s: np.ndarray) -> np.ndarray:
        """Weights (N, C) of the coefficients at times (N,)."""
        return BSpline.design_matrix(self._inside(times_s), self.knots, 3).toarray()

    def corrections(self, coefficients: np.ndarray, times_s: np.ndarray, *, rates: bool = False) -> np.ndarray:
        """Shift and turn (N, 6) at times (N,) by coefficients (6 C,), or their rates per second."""
        spline = BSpline(self.knots, coefficients.reshape(-1, 6), 3)
        return (spline.derivative() if rates else spline)(self._inside(times_s))

    def _inside(self, times_s: np.ndarray) -> np.ndarray:
        return np.clip(times_s, self.first_s, self.last_s)


@dataclass(frozen=True, eq=False)
class PathPrior:
    """Normal distribution of the coefficients of a path, by the kind of its drift.

    The coefficients are a root R (6 C, 6 C) times as many independent numbers of variance one. R is not formed:
    components are independent, but for the way that the heading turns.
    """

    path: PathSpline
    kind: DriftKind

    def times_root(self, matrix: np.ndarray) -> np.ndarray:
        """R times a matrix (6 C, K)."""
        result = self._drift[:, None] * self._of_components(matrix)
        if self.kind.by_heading:
            result[0::6] -= self._turned[1] @ result[5::6]
            result[1::6] += self._turned[0] @ result[5::6]
        return result

    def times_transposed_root(self, matrix: np.ndarray) -> np.ndarray:
        """R^T times a matrix (6 C, K)."""
        if self.kind.by_heading:
            matrix = matrix.copy()
            matrix[5::6] += self._turned[0].T @ matrix[1::6] - self._turned[1].T @ matrix[0::6]
        return self._of_components(self._drift[:, None] * matrix, transposed=True)

    def with_evidence(self, normal: np.ndarray) -> np.ndarray:
        """Normal matrix (6 C, 6 C) of the independent numbers by that of the coefficients without this prior."""
        half = self.times_transposed_root(normal)
        return np.eye(len(normal)) + self.times_transposed_root(half.T)

    def covariance(self, of_numbers: np.ndarray) -> np.ndarray:
        """Covariance (6 C, 6 C) of the coefficients by that of the independent numbers."""
        return self.times_root(self.times_root(of_numbers).T)

    def unresolved(self, times_s: np.ndarray) -> np.ndarray:
        """Variances (N, 6) of the drift at times (N,) that the spline cannot follow."""
        inside = np.clip(times_s, self.path.first_s, self.path.last_s)
        basis = BSpline.design_matrix(inside, self.path.knots, 3)
        result = np.empty((len(times_s), 6))
        for components, shares, root in self._groups:
            left = self._kernel(shares, inside, inside) - np.sum((basis @ root) ** 2, axis=1)
            result[:, components] = np.maximum(left, 0.0)[:, None]
        return result * self.path.drift**2

    def _kernel(self, shares: tuple[float, ...], earlier_s: np.ndarray, later_s: np.ndarray) -> np.ndarray:
        """Covariance of a component between times, over the variance that is stated for the end."""
        t, u = ((each - self.path.first_s) / (self.path.last_s - self.path.first_s) for each in (earlier_s, later_s))
        first, second = np.minimum(t, u), np.maximum(t, u)
        # Integrals of a random walk from zero, twice and once; each is one at the end.
        smooth = first**3 * (10 * second**2 - 5 * first * second + first**2) / 6
        wandering = first**2 * (3 * second - first) / 2
        kinds = t * u, smooth, wandering, first
        return sum((share * each for share, each in zip(shares, kinds, strict=True)), np.zeros_like(first))

    @cached_property
    def _groups(self) -> list[tuple[np.ndarray, tuple[float, ...], np.ndarray]]:
        """Components that drift alike, shares of the steady rate and of `DriftKind`, and the lower triangular root
        (C, C) of the covariance of their coefficients over the variance at the end."""
        shift, measured, at = np.arange(6) < 3, self.path.measured, self.path.at_s
        rates, walk = (1.0, self.kind.smooth, self.kind.wandering), (0.0, 0.0, 0.0, 1.0)
        groups = []
        for which, shares in (
            (shift & ~measured, (*rates, self.kind.walk)),
            (~shift & ~measured, (*rates, self.kind.turn_walk)),
            (measured, walk),
        ):
            if which.any():
                root = np.linalg.cholesky(self._kernel(shares, at[:, None], at) + _EXACT * np.eye(len(at)))
                groups.append((np.flatnonzero(which), shares, root))
        return groups

    @cached_property
    def _drift(self) -> np.ndarray:
        """Drift (6 C,) at the end that belongs to each unknown, mm and rad."""
        return np.tile(self.path.drift, self.path.count)

    @cached_property
    def _turned(self) -> np.ndarray:
        """Ways (2, C, C) along X and Y, mm, by which a unit of each coefficient turns the path until each.

        Integrals of velocity times basis, by two points of Gauss between all knots and times of coefficients.
        """
        edges = np.union1d(self.path.knots, self.path.at_s)
        middle, half = (edges[1:] + edges[:-1]) / 2, np.diff(edges) / 2
        times = np.concatenate([middle - half / np.sqrt(3), middle + half / np.sqrt(3)])
        until = (times < self.path.at_s[:, None]) * np.tile(half, 2)
        velocity, basis = self.path.trajectory.rates_at(times)[:, :2], self.path.basis(times)
        return np.array([until @ (along[:, None] * basis) for along in velocity.T])

    def _of_components(self, matrix: np.ndarray, *, transposed: bool = False) -> np.ndarray:
        """The roots of the components, or their transposes, times the rows of each in a matrix (6 C, K)."""
        parts = matrix.reshape(self.path.count, 6, -1)
        result = np.empty_like(parts)
        for components, _, lower in self._groups:
            rows = parts[:, components].reshape(self.path.count, -1)
            # Matches depend on coefficients near crossings alone.
            used = rows.any(axis=1)
            root = (lower.T if transposed else lower)[:, used]
            result[:, components] = (root @ rows[used]).reshape(self.path.count, len(components), -1)
        return result.reshape(matrix.shape)


def _knots(inner: np.ndarray) -> np.ndarray:
    """Knots of a cubic spline by those (M,) from its first to its last time."""
    return np.concatenate([np.repeat(inner[0], 3), inner, np.repeat(inner[-1], 3)])
