"""Prior distribution of a path correction, given by values at nodes with linear interpolation in time.

Unknowns are ordered by component: translation along X at all C nodes, then Y and Z, then the rotations about them.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import numpy as np
from scipy.linalg import get_blas_funcs

from uwlts.alignment.drift_model import DriftModel
from uwlts.model.trajectory import Trajectory

_EXACT = 1e-10
"""Variance at the start of the path, relative to that at its end; the start defines the frame."""

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
        apart = np.min(np.abs(self.nodes_s[:, None] - closer), axis=1, initial=np.inf) > step_s
        apart[[0, -1]] = True
        inner = closer[(closer > first + step_s / 2) & (closer < last - step_s / 2)]
        nodes = np.union1d(self.nodes_s[apart], inner)
        return replace(self, nodes_s=nodes, order=np.argsort(~np.isin(nodes, inner), kind="stable"))

    @property
    def count(self) -> int:
        """Number C of nodes."""
        return len(self.nodes_s)

    def weights(self, times_s: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return the index (N,) of the node before each time (N,), and the weight (N,) of the next node."""
        before = np.clip(np.searchsorted(self.nodes_s, times_s, side="right") - 1, 0, self.count - 2)
        after = (times_s - self.nodes_s[before]) / np.diff(self.nodes_s)[before]
        return before, np.clip(after, 0.0, 1.0)

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
        parts[:, self.order] = self._times_triangles(matrix, transposed=False)
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
        return self._times_triangles(parts, transposed=True).reshape(matrix.shape)

    def _times_triangles(self, matrix: np.ndarray, *, transposed: bool) -> np.ndarray:
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
            result = self._times_triangles(parts, transposed=True).reshape(matrix.shape)
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
