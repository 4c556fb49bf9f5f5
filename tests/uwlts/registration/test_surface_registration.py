"""Covariance of a registration to a surface: that of the errors, with the noise of either side once."""

import numpy as np
import pytest
from scipy.stats import chi2

from uwlts.registration.surface_registration import SampledSurface, register_to_surface
from uwlts.storage.cloud import PointUncertainty


def height(x: np.ndarray, y: np.ndarray) -> np.ndarray:
    """Return the height of a surface without symmetry: every motion changes it."""
    return 2.0 * np.sin(x / 9.0) + 1.5 * np.cos(y / 7.0) + 0.002 * x * y


def white(points: np.ndarray, normals: np.ndarray, std: float) -> PointUncertainty:
    pairs = ((0, 0), (0, 1), (0, 2), (1, 1), (1, 2), (2, 2))
    random = std**2 * np.stack([normals[:, i] * normals[:, j] for i, j in pairs], axis=1)
    return PointUncertainty(random, np.zeros_like(points), np.zeros((0, len(points), 3)))


@pytest.mark.parametrize("points_each", [1, 6])
def test_the_covariance_is_that_of_the_errors(points_each: int) -> None:
    """40 registrations of six parameters; the sum of squares is within limits exceeded 1 time in 10,000.

    A point of the reference serves one or six points of the cloud, and has twice their noise.
    """
    rng, std, own_std, squares, draws = np.random.default_rng(8), 0.02, 0.01, 0.0, 40
    side = np.arange(-30, 30, 1.5)
    x, y = (each.ravel() for each in np.meshgrid(side, side))
    surface = np.column_stack([x, y, height(x, y)])
    step = 1e-4
    slopes = [(height(x + step, y) - height(x - step, y)), (height(x, y + step) - height(x, y - step))]
    normals = np.column_stack([-slopes[0] / (2 * step), -slopes[1] / (2 * step), np.ones(len(x))])
    normals /= np.linalg.norm(normals, axis=1)[:, None]
    # Points of the cloud are those of the surface, so that planes add no error.
    own = np.repeat(np.arange(len(x)), points_each)
    for _ in range(draws):
        moved = surface + std * rng.standard_normal(len(x))[:, None] * normals
        cloud = surface[own] + own_std * rng.standard_normal(len(own))[:, None] * normals[own]
        found = register_to_surface(
            cloud,
            SampledSurface(moved, normals, uncertainty=white(moved, normals, std)),
            reach_mm=1.0,
            uncertainty=white(cloud, normals[own], own_std),
        )
        turn = found.transform[:3, :3]
        error = np.concatenate(
            [found.transform[:3, 3] + turn @ found.middle_mm - found.middle_mm, [turn[2, 1], turn[0, 2], turn[1, 0]]]
        )
        squares += float(error @ np.linalg.solve(found.covariance, error))
    low, high = chi2.ppf([5e-5, 1 - 5e-5], 6 * draws)
    assert low < squares < high
