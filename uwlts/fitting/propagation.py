"""Propagation of point errors to derived figures: by patterns, by random draws, and linearly.

Systematic patterns are added one by one, and the squared changes are summed (GUM, JCGM 100:2008, section 5.1, for
independent inputs). Noise is simulated by random draws (GUM Supplement 1, JCGM 101:2008). If no errors are stated, the
covariance of parameters follows from fits without parts of the data (`jackknife`).
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import Any, Generic

import numpy as np

from uwlts.fitting.least_squares import FitT
from uwlts.storage.cloud import PointCloud, PointUncertainty, expand_covariances, project_image_errors, project_variance

_SEED = 635  # seed of the draws, so that a cloud always has the same uncertainties


@dataclass(frozen=True, eq=False)
class PointErrors:
    """Independent components of point errors, as shifts (N, 3) or as distances (N,) along normals, mm."""

    single_mm: np.ndarray
    """(N, 3) or (N,); shift of each point for one standard deviation of its own noise; zero if the cloud has no
    uncertainty."""
    image_mm: np.ndarray
    """(K, N, 3) or (K, N); shifts for one standard deviation of each component of an image's position and pose."""
    image: np.ndarray  # (N,) int; image of each point
    patterns_mm: np.ndarray | None
    """(M, N, 3) or (M, N) or None; shifts for one standard deviation of each systematic pattern; None if the cloud
    has no uncertainty."""

    @classmethod
    def from_uncertainty(cls, known: PointUncertainty, frame: np.ndarray) -> PointErrors:
        """Return the error components of points with an uncertainty and images (N,)."""
        return cls(noise_shifts(known), known.image_errors_mm(), frame, known.patterns_mm)

    @classmethod
    def along_normals(cls, cloud: PointCloud, chosen: np.ndarray, normals: np.ndarray) -> PointErrors:
        """Return the error components of chosen (K,) points of a cloud along normals (K, 3)."""
        frame = cloud.frame[chosen]
        image = frame if np.any(frame >= 0) else np.arange(len(chosen))
        if (known := cloud.uncertainty) is None:
            return cls(np.zeros(len(chosen)), np.empty((0, len(chosen))), image, None)
        known = known[chosen]
        single = np.sqrt(np.maximum(project_variance(known.random_mm2, normals), 0))
        patterns = np.einsum("mni,ni->mn", known.patterns_mm, normals)
        return cls(single, project_image_errors(known, normals), image, patterns)

    def __getitem__(self, chosen: np.ndarray) -> PointErrors:
        """Return the components of a selection of the points."""
        patterns = None if self.patterns_mm is None else self.patterns_mm[:, chosen]
        return PointErrors(self.single_mm[chosen], self.image_mm[:, chosen], self.image[chosen], patterns)

    def draw(self, count: int, rng: np.random.Generator | None = None) -> Iterator[np.ndarray]:
        """Draw ``count`` random shifts of all points by noise and image errors; by default with a fixed seed."""
        rng, image = rng or np.random.default_rng(_SEED), _group_numbers(self.image)
        one_each = (1,) * (self.single_mm.ndim - 1)
        for _ in range(count):
            move = np.zeros(self.single_mm.shape)
            for part in self.image_mm:
                move += rng.standard_normal((image.max() + 1, *one_each))[image] * part
            yield move + rng.standard_normal((len(image), *one_each)) * self.single_mm

    def by_patterns(self, change: Callable[[np.ndarray], Any]) -> np.ndarray | None:
        """Return the standard deviations (F,) of figures by systematic patterns; None without patterns.

        ``change`` returns the changes (F,) of the figures for given shifts of the points. Changes that are NaN are
        ignored.
        """
        if self.patterns_mm is None:
            return None
        return np.sqrt(np.nansum(np.square([change(pattern) for pattern in self.patterns_mm]), axis=0))

    def propagate(self, change: Callable[[np.ndarray], Any], *, draws: int) -> tuple[np.ndarray, np.ndarray | None]:
        """Return the standard deviations (F,) of figures by noise and by systematic patterns.

        ``change`` returns the changes (F,) of the figures for given shifts of the points.
        """
        return np.std([change(move) for move in self.draw(draws)], axis=0, ddof=1), self.by_patterns(change)

    def linear_std(self, by_points: np.ndarray) -> float:
        """Return the standard deviation by noise of a figure with derivatives (N, 3) by the points (GUM, Eq. 13)."""
        single = np.einsum("ni,ni->n", by_points, self.single_mm)
        image = _group_numbers(self.image)
        together = [np.bincount(image, np.einsum("ni,ni->n", by_points, part)) for part in self.image_mm]
        return float(np.sqrt(single @ single + sum(part @ part for part in together)))

    def covariances(
        self, weights: np.ndarray, residuals: np.ndarray, groups: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray | None]:
        """Return the covariances (K, K) of weighted sums of distances by noise and by systematic patterns.

        To first order, the parameters of a fitted shape are such sums (GUM, Eq. 13). The noise covariance is at least
        that of the residuals, correlated in groups (sandwich estimator: Liang and Zeger, Biometrika 73, 1986).

        ``weights`` (K, N) are those of the distances in each sum, ``residuals`` (N,) in mm. ``groups`` (N,) numbers the
        neighbourhood of each point, in which errors may be correlated.
        """
        noise = (weights * self.single_mm**2) @ weights.T + grouped_covariance(weights, self.image_mm, self.image)
        seen = grouped_covariance(weights, residuals[None], groups)
        size = np.maximum(np.diag(seen), 1e-300) / np.maximum(np.diag(noise), 1e-300)
        # The covariance is selected and scaled as a whole, so that it stays positive semidefinite.
        random = seen if np.median(size) > 1 else noise
        scale = np.sqrt(np.maximum(np.maximum(np.diag(seen), np.diag(noise)) / np.maximum(np.diag(random), 1e-300), 1))
        random = random * np.outer(scale, scale)
        if self.patterns_mm is None:
            return random, None
        moved = weights @ self.patterns_mm.T
        return random, moved @ moved.T


def group_neighbours(count: int) -> np.ndarray:
    """Return the group (N,) of each point: eight consecutive points, whose errors may be correlated."""
    return np.arange(count) // 8


def grouped_covariance(weights: np.ndarray, parts_mm: np.ndarray, group: np.ndarray) -> np.ndarray:
    """Return the covariance (K, K) of sums of errors with weights (K, N).

    ``parts_mm`` (P, N) are standard deviations of independent parts of the errors. Each part is fully correlated within
    a group (N,) and independent between groups.
    """
    number, covariance = _group_numbers(group), np.zeros((len(weights),) * 2)
    for part in parts_mm:
        sums = np.stack([np.bincount(number, row) for row in weights * part])
        covariance += sums @ sums.T
    return covariance


def noise_shifts(uncertainty: PointUncertainty) -> np.ndarray:
    """Return the shift (N, 3) of each point for one standard deviation of its stripe centre, up to its sign."""
    covariance = expand_covariances(uncertainty.random_mm2.astype(np.float64))
    # The covariance is v v^T: its column with the largest element on the diagonal is v times that of v.
    largest = np.argmax(np.einsum("nii->ni", covariance), axis=1)
    rows = np.arange(len(covariance))
    size = np.sqrt(covariance[rows, largest, largest])[:, None]
    return np.divide(covariance[rows, largest], size, out=np.zeros((len(rows), 3)), where=size > 0)


def _group_numbers(group: np.ndarray) -> np.ndarray:
    """Return consecutive group numbers (N,), starting at 0."""
    return np.unique(group, return_inverse=True)[1].ravel()


def jackknife(changes: np.ndarray) -> np.ndarray:
    """Return the covariance (P, P) of parameters from their changes (F, P) without each group of observations.

    Delete-one-group jackknife: (F - 1) / F times the sum of squares (Efron and Stein, 1981, eq. 1.4).
    """
    return (len(changes) - 1) / max(len(changes), 1) * changes.T @ changes


def differences(values: Callable[[np.ndarray], np.ndarray], at: np.ndarray, steps: np.ndarray) -> np.ndarray:
    """Return derivatives (N, K) of flattened values by central differences with steps (K,); 0 for a zero step."""
    columns = [
        (values(at + step) - values(at - step)).ravel() / (2 * step.sum()) if step.any() else 0.0
        for step in np.diag(steps)
    ]
    return np.stack(np.broadcast_arrays(*columns), axis=1)


class LinearisedFit(Generic[FitT]):
    """Linearised fit of a shape to the ``used`` (K,) of points (N, 3).

    A point's shift along the normal changes its distance from the shape. Normals and the distances' derivatives by the
    shape's parameters are constant, since shifts are small compared with the shape.
    """

    def __init__(self, shape: FitT, points: np.ndarray, used: np.ndarray):
        self.used, self.shape, self._outward = used, shape, shape.normals_at(points[used])
        self._design = -shape.derivatives(points[used])
        self._solve = np.linalg.solve(self._design.T @ self._design, self._design.T)

    def shift(self, moves: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return changes (P,) of the parameters and residuals (K,) after shifts (N, 3) of points."""
        change = np.einsum("ni,ni->n", self._outward, moves[self.used])
        step = self._solve @ change
        return step, self.shape.residuals_mm + change - self._design @ step

    def std_mm(self, residuals: np.ndarray) -> float:
        """Return the standard deviation of residuals (K,), with the degrees of freedom of the fit."""
        return float(np.sqrt(residuals @ residuals / (len(residuals) - len(self._solve))))

    def gradient(self, weights: np.ndarray, count: int) -> np.ndarray:
        """Return the derivatives (N, 3) of a weighted sum of the parameters by the shifts of N = ``count`` points."""
        result = np.zeros((count, 3))
        result[self.used] = (weights @ self._solve)[:, None] * self._outward
        return result
