"""Propagation of the independent errors of a cloud to its surface patches.

Overlapping patches share points, and patches along an image share its position. Their heights are therefore correlated:
positively by image errors, and negatively in part by noise, because a second-order fit weights points at the border of
its disc against those in the middle. Sums over patches are propagated from the errors themselves.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from scipy.sparse import csr_array, hstack


@dataclass(frozen=True, eq=False)
class PatchErrors:
    """Independent errors of a cloud, as heights along normals, and the change of P patches by them.

    Attributes
    ----------
    near : (P, K) int
        Averages of points in each disc.
    rows : (P, 6, K) float32
        Derivatives of the shape's coefficients by the heights of these averages.
    noise_mm : (P,) float64
        Standard deviation of one point of a patch along its normal.
    counts : (C,) float64
        Number of points in each average.
    images : (C, I) sparse
        Fraction of the points of each average in each image.
    image_shifts_mm : (J, C, 3) float64
        Shift of each average for one standard deviation of each error of its image.
    """

    near: np.ndarray
    rows: np.ndarray
    noise_mm: np.ndarray
    counts: np.ndarray
    images: csr_array
    image_shifts_mm: np.ndarray

    def __getitem__(self, selection: Any) -> PatchErrors:
        """Select patches by a slice, indices or a mask."""
        return replace(
            self, near=self.near[selection], rows=self.rows[selection], noise_mm=self.noise_mm[selection]
        )

    def loadings(self, rows: np.ndarray, columns: np.ndarray, normals: np.ndarray) -> csr_array:
        """Return the changes (Q, E) of heights of patches for one standard deviation of each independent error.

        Parameters
        ----------
        rows : (Q,) int
            Numbers of the patches.
        columns : (Q, 6)
            Terms of the second-order surface at the place of each height.
        normals : (Q, 3)
            Normals of the patches in the cloud's frame.
        """
        near = self.near[rows]
        by_average = np.einsum("qa,qak->qk", columns, self.rows[rows])
        noise = by_average * self.noise_mm[rows, None] / np.sqrt(self.counts[near])
        parts = [self._sparse(noise, near)]
        for shift in self.image_shifts_mm:
            moved = by_average * np.einsum("qki,qi->qk", shift[near], normals)
            parts.append(self._sparse(moved, near) @ self.images)
        return csr_array(hstack(parts, format="csr"))

    def correlation(self) -> float:
        """Return the variance of the mean height by noise, relative to that of as many independent patches."""
        noise = self.rows[:, 0] * self.noise_mm[:, None] / np.sqrt(self.counts[self.near])
        together = np.bincount(self.near.ravel(), noise.ravel(), len(self.counts))
        return float(np.sum(together**2) / np.sum(noise**2))

    def _sparse(self, values: np.ndarray, near: np.ndarray) -> csr_array:
        ends = np.arange(0, near.size + 1, near.shape[1])
        return csr_array((values.ravel(), near.ravel(), ends), shape=(len(near), len(self.counts)))
