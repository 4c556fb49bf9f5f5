"""Uncertainty of a fitted shape: its changes by small shifts of its points."""

from typing import Generic, TypeVar

import numpy as np

from uwlts.shapes.cylinder import Cylinder
from uwlts.shapes.flat import Plane
from uwlts.shapes.sphere import Sphere

ShapeT = TypeVar("ShapeT", bound=Plane | Sphere | Cylinder)


class LinearisedFit(Generic[ShapeT]):
    """Linearised fit of a shape to the ``used`` (K,) of points (N, 3).

    A point's shift along the normal changes its distance from the shape. Normals and the distances' derivatives by the
    shape's parameters are constant, since shifts are small compared with the shape.
    """

    def __init__(self, shape: ShapeT, points: np.ndarray, used: np.ndarray):
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
