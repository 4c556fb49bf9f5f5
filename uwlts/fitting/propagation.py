"""Propagation of the errors of points to figures: by patterns, by draws, and linearly.

Patterns, which all points share, are added one by one, and the squares of the changes add up (GUM, JCGM 100:2008,
section 5.1, with independent inputs). Noise is drawn anew (GUM Supplement 1, JCGM 101:2008).
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np

from uwlts.storage.cloud import PointCloud, PointUncertainty, images_along, matrices_of, variance_along

_SEED = 635
"""Of all draws: the same cloud has the same uncertainties."""


@dataclass(frozen=True, eq=False)
class PointErrors:
    """Independent parts of the errors of points, as moves (N, 3) or as distances (N,) along given normals, mm.

    Attributes
    ----------
    single_mm : (N, 3) or (N,)
        Move of each point for one standard deviation of its own noise; zero if the cloud states none.
    image_mm : (K, N, 3) or (K, N)
        Moves for one standard deviation of each part of the position and pose of an image.
    image : (N,) int
        Image of each point.
    patterns_mm : (M, N, 3) or (M, N) or None
        Moves for one standard deviation of each pattern that all points share; None if the cloud states nothing.
    """

    single_mm: np.ndarray
    image_mm: np.ndarray
    image: np.ndarray
    patterns_mm: np.ndarray | None

    @classmethod
    def of(cls, known: PointUncertainty, frame: np.ndarray) -> PointErrors:
        """Return the errors of points with an uncertainty and images (N,)."""
        return cls(noise_mm(known), known.by_image_mm(), frame, known.patterns_mm)

    @classmethod
    def along(cls, cloud: PointCloud, chosen: np.ndarray, normals: np.ndarray) -> PointErrors:
        """Return the errors of the chosen (K,) points of a cloud along normals (K, 3)."""
        frame = cloud.frame[chosen]
        image = frame if np.any(frame >= 0) else np.arange(len(chosen))
        if (known := cloud.uncertainty) is None:
            return cls(np.zeros(len(chosen)), np.empty((0, len(chosen))), image, None)
        known = known[chosen]
        single = np.sqrt(np.maximum(variance_along(known.random_mm2, normals), 0))
        patterns = np.einsum("mni,ni->mn", known.patterns_mm, normals)
        return cls(single, images_along(known, normals), image, patterns)

    def __getitem__(self, chosen: np.ndarray) -> PointErrors:
        """Those of a selection of the points."""
        patterns = None if self.patterns_mm is None else self.patterns_mm[:, chosen]
        return PointErrors(self.single_mm[chosen], self.image_mm[:, chosen], self.image[chosen], patterns)

    def drawn(self, count: int, rng: np.random.Generator | None = None) -> list[np.ndarray]:
        """Draw moves of all points by noise and images, as often as ``count``; with a fixed seed unless given."""
        rng, image = rng or np.random.default_rng(_SEED), _numbered(self.image)
        one_each = (1,) * (self.single_mm.ndim - 1)
        moves = []
        for _ in range(count):
            move = np.zeros(self.single_mm.shape)
            for part in self.image_mm:
                move += rng.standard_normal((image.max() + 1, *one_each))[image] * part
            moves.append(move + rng.standard_normal((len(image), *one_each)) * self.single_mm)
        return moves

    def by_patterns(self, change: Callable[[np.ndarray], Any]) -> np.ndarray | None:
        """Return the standard deviations (F,) of figures by the patterns, by the changes (F,) for moves of the points.

        Changes that are NaN do not count. None if the cloud states nothing.
        """
        if self.patterns_mm is None:
            return None
        return np.sqrt(np.nansum(np.square([change(pattern) for pattern in self.patterns_mm]), axis=0))

    def propagate(self, change: Callable[[np.ndarray], Any], *, draws: int) -> tuple[np.ndarray, np.ndarray | None]:
        """Return the standard deviations (F,) of figures by noise and by patterns.

        ``change`` gives the changes (F,) of the figures for moves of the points.
        """
        return np.std([change(move) for move in self.drawn(draws)], axis=0, ddof=1), self.by_patterns(change)

    def covariances(
        self, weights: np.ndarray, residuals: np.ndarray, groups: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray | None]:
        """Return the covariances (K, K) of sums of distances with weights (K, N): by noise, and by patterns.

        To first order the values of a fitted shape are such sums (GUM, Eq. 13). ``residuals`` (N,) are the distances
        that are left, ``groups`` (N,) numbers of neighbourhoods whose points may err together. Noise counts at least as
        much as the residuals show in groups (the sandwich estimator of Liang and Zeger, Biometrika 73, 1986):
        neighbours err together, and roughness is noise.
        """
        noise = (weights * self.single_mm**2) @ weights.T + covariance_of_groups(weights, self.image_mm, self.image)
        seen = covariance_of_groups(weights, residuals[None], groups)
        size = np.maximum(np.diag(seen), 1e-300) / np.maximum(np.diag(noise), 1e-300)
        # As a whole, so that what is left stays a covariance.
        random = seen if np.median(size) > 1 else noise
        scale = np.sqrt(np.maximum(np.maximum(np.diag(seen), np.diag(noise)) / np.maximum(np.diag(random), 1e-300), 1))
        random = random * np.outer(scale, scale)
        if self.patterns_mm is None:
            return random, None
        moved = weights @ self.patterns_mm.T
        return random, moved @ moved.T


def neighbours_in_order(count: int) -> np.ndarray:
    """Return groups (N,) of neighbours that may err together: eight points that follow each other."""
    return np.arange(count) // 8


def covariance_of_groups(weights: np.ndarray, parts_mm: np.ndarray, group: np.ndarray) -> np.ndarray:
    """Return the covariance (K, K) of sums of errors with weights (K, N).

    ``parts_mm`` (P, N) are standard deviations of independent parts of the errors. Each part is fully correlated within
    a group (N,) and independent between groups.
    """
    number, covariance = _numbered(group), np.zeros((len(weights),) * 2)
    for part in parts_mm:
        sums = np.stack([np.bincount(number, row) for row in weights * part])
        covariance += sums @ sums.T
    return covariance


def noise_mm(uncertainty: PointUncertainty) -> np.ndarray:
    """Return the move (N, 3) of each point for one standard deviation of its stripe centre; of either sign."""
    covariance = matrices_of(uncertainty.random_mm2.astype(np.float64))
    # The covariance is v v^T: its column with the largest element on the diagonal is v times that of v.
    largest = np.argmax(np.einsum("nii->ni", covariance), axis=1)
    rows = np.arange(len(covariance))
    size = np.sqrt(covariance[rows, largest, largest])[:, None]
    return np.divide(covariance[rows, largest], size, out=np.zeros((len(rows), 3)), where=size > 0)


def _numbered(group: np.ndarray) -> np.ndarray:
    """Numbers (N,) of groups from 0."""
    return np.unique(group, return_inverse=True)[1].ravel()
