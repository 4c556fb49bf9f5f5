"""Propagation of the independent errors of a cloud to the heights of its surface patches.

Overlapping patches share points, and patches along an image share its position. Their heights are therefore correlated:
positively by errors of images. Noise correlates some of them negatively, because a second-order fit subtracts points
near the border of its disc. The variance of a sum of heights follows from the errors themselves.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from scipy.sparse import csr_array, hstack


@dataclass(frozen=True, eq=False)
class PatchErrors:
    """Independent errors of a cloud, and the changes of the heights of P patches by them."""

    near: np.ndarray  # (P, K) int; averages of points in each disc
    rows: np.ndarray
    """(P, K) float32; derivatives of the height in the middle of a disc by the heights of these averages."""
    noise_mm: np.ndarray  # (P,); standard deviation of one point along the normal
    normals: np.ndarray  # (P, 3); normals of the patches in the cloud's frame
    counts: np.ndarray  # (C,); number of points in each average
    images: csr_array  # (C, I) sparse; fraction of the points of each average in each image
    image_shifts_mm: np.ndarray
    """(J, C, 3); shift of each average for one standard deviation of each error of its image."""

    def __getitem__(self, selection: Any) -> PatchErrors:
        """Select patches by a slice, indices or a mask."""
        names = ("near", "rows", "noise_mm", "normals")
        return replace(self, **{name: getattr(self, name)[selection] for name in names})

    def height_changes(self) -> csr_array:
        """Return the changes (P, C + J I), mm, of the heights for one standard deviation of each independent error."""
        return csr_array(hstack([self._by_noise(), *self._by_images()], format="csr"))

    def noise_variance(self) -> np.ndarray:
        """Return the variance (P,), mm2, of the heights by noise."""
        return self.noise_mm**2 * np.sum(self.rows**2 / self.counts[self.near], axis=1)

    def image_variance(self) -> np.ndarray:
        """Return the variance (P,), mm2, of the heights by errors of images."""
        return sum(
            (np.asarray((each * each).sum(axis=1)).ravel() for each in self._by_images()), np.zeros(len(self.rows))
        )

    def correlation(self, *, by_images: bool) -> float:
        """Return the variance of the sum of all heights relative to the sum of their variances, by noise or images."""
        parts = self._by_images() if by_images else [self._by_noise()]
        together = sum(float(np.sum(np.asarray(each.sum(axis=0)) ** 2)) for each in parts)
        apart = sum(float((each * each).sum()) for each in parts)
        return together / apart if apart > 0 else 1.0

    def _by_noise(self) -> csr_array:
        return self._sparse(self.rows * self.noise_mm[:, None] / np.sqrt(self.counts[self.near]))

    def _by_images(self) -> list[csr_array]:
        along = (np.einsum("pki,pi->pk", shift[self.near], self.normals) for shift in self.image_shifts_mm)
        return [csr_array(self._sparse(self.rows * each) @ self.images) for each in along]

    def _sparse(self, values: np.ndarray) -> csr_array:
        ends = np.arange(0, self.near.size + 1, self.near.shape[1])
        return csr_array((values.ravel(), self.near.ravel(), ends), shape=(len(self.near), len(self.counts)))
