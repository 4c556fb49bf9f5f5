"""Covariance of a registration to a surface: that of the errors, with the noise of either side once."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from scipy.stats import chi2

from uwlts.registration.surface_registration import Nearest, SampledSurface, register_to_surface, shape_registration
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


def test_the_result_does_not_depend_on_the_start() -> None:
    """A cloud in place, and the same moved by 2.7 mm and 1 deg: one motion more, equal covariances and middles."""
    rng, side = np.random.default_rng(9), np.arange(-30, 30, 1.0)
    x, y = (each.ravel() for each in np.meshgrid(side, side))
    slopes = [2 / 9 * np.cos(x / 9) + 0.002 * y, -1.5 / 7 * np.sin(y / 7) + 0.002 * x]
    normals = np.column_stack([-slopes[0], -slopes[1], np.ones(len(x))])
    normals /= np.linalg.norm(normals, axis=1)[:, None]
    surface = SampledSurface(np.column_stack([x, y, height(x, y)]), normals)
    inner = np.flatnonzero(np.hypot(x - 5, y + 3) < 20)
    cloud = surface.points_mm[inner] + 0.01 * rng.standard_normal(len(inner))[:, None] * normals[inner]
    turn, shift = Rotation.from_rotvec([0.01, -0.01, 0.01]).as_matrix(), np.array([1.5, -1.0, 2.0])
    still = register_to_surface(cloud, surface, reach_mm=6.0)
    moved = register_to_surface(cloud @ turn.T + shift, surface, reach_mm=6.0)
    motion = np.eye(4)
    motion[:3, :3], motion[:3, 3] = turn, shift
    np.testing.assert_allclose(moved.transform @ motion, still.transform, atol=2e-4)
    placed = cloud @ still.transform[:3, :3].T + still.transform[:3, 3]
    np.testing.assert_allclose(still.middle_mm, placed.mean(axis=0), atol=1e-9)
    np.testing.assert_allclose(moved.middle_mm, still.middle_mm, atol=2e-4)
    std = np.sqrt(np.diag(still.covariance))
    np.testing.assert_allclose(moved.covariance / np.outer(std, std), still.covariance / np.outer(std, std), atol=0.02)


def test_what_a_plane_does_not_determine_is_left() -> None:
    """Normals that are tilted by 1e-3 alone give less than a thousandth of the information on a shift across."""
    rng, std = np.random.default_rng(5), 0.01
    x, y = (each.ravel() for each in np.meshgrid(np.arange(-20.0, 21.0), np.arange(-20.0, 21.0)))
    points = np.column_stack([x, y, np.zeros(len(x))])
    normals = np.column_stack([*1e-3 * rng.standard_normal((2, len(x))), np.ones(len(x))])
    normals /= np.linalg.norm(normals, axis=1)[:, None]
    cloud = points + [0.3, -0.2, 0.1] + np.outer(std * rng.standard_normal(len(x)), [0, 0, 1])
    cloud[0, 2] += 0.5
    found = register_to_surface(cloud, SampledSurface(points, normals), reach_mm=1.0)
    # The three motions are equally undetermined, so that any combinations of them may be named.
    names = {name for words in found.open_directions for name in words.split(" with ")}
    assert names == {"shift along x", "shift along y", "turn about z"} and len(found.open_directions) == 3
    # The mean of 1,681 points; five standard deviations.
    np.testing.assert_allclose(found.transform[:3, 3], [0, 0, -0.1], atol=5 * std / 41 + 1e-3 * std)
    # The biweight of normal noise is 95 % efficient.
    assert found.covariance[2, 2] == pytest.approx(std**2 / len(x) / 0.95, rel=0.15)
    assert found.covariance[3, 3] == pytest.approx(std**2 / (y @ y) / 0.95, rel=0.15)
    assert np.abs(found.covariance[[0, 1, 5]]).max() < 1e-3 * found.covariance[2, 2]
    assert found.rms_mm == pytest.approx(std, rel=0.1) and len(x) - 20 < found.points < len(x)


def test_the_uncertainty_of_a_fitted_plane_is_that_of_its_residuals() -> None:
    """Residuals of one size and alternating signs, which no motion reduces; five images, and two patterns."""
    side = np.arange(-4.5, 5.0)
    x, y = (each.ravel() for each in np.meshgrid(side, side, indexing="ij"))
    points, up = np.column_stack([x, y, np.zeros(100)]), np.tile([0.0, 0.0, 1.0], (100, 1))
    size, image = 0.03, np.repeat(np.arange(5), 20)
    near = Nearest(size * np.where((x + y) % 2 == 0, 1.0, -1.0), up, np.arange(100))
    known = PointUncertainty(np.zeros((100, 6)), 0.2 * up, np.stack([0.5 * up, 0.01 * y[:, None] * up]))
    plain = shape_registration(points, near, sized=False, uncertainty=None, frame=None)
    assert plain.rms_mm == pytest.approx(size) and plain.points == 100
    assert plain.by_cloud.shape == plain.by_reference.shape == (0, 6)
    expected = size**2 * np.array([0, 0, 1 / 100, 1 / (y @ y), 1 / (x @ x), 0])
    np.testing.assert_allclose(plain.covariance, np.diag(expected), atol=1e-12)
    # Halfway to the border: the offset and one tilt.
    std = plain.std_along(np.array([[0.0, 3.0, 0.0]]), up[:1])
    np.testing.assert_allclose(std, size * np.sqrt(1 / 100 + 9 / (y @ y)))
    found = shape_registration(points, near, sized=False, uncertainty=known, frame=image)
    assert found.covariance[2, 2] == pytest.approx(expected[2] + 0.2**2 / 5)
    # The motion undoes the errors: a shift, and a turn by the slope.
    np.testing.assert_allclose(found.by_cloud, [[0, 0, -0.5, 0, 0, 0], [0, 0, 0, -0.01, 0, 0]], atol=1e-12)
    np.testing.assert_allclose(found.moves_mm(found.by_cloud[1], points), -0.01 * y[:, None] * up, atol=1e-12)


def test_the_uncertainty_of_a_fitted_sphere_includes_its_radius() -> None:
    """Points on all axes: their normals have a third of the sum of squares each, and turns are undetermined."""
    normals = np.tile(np.vstack([np.eye(3), -np.eye(3)]), (4, 1))
    size, radius = 0.02, 10.0
    near = Nearest(size * np.repeat([1.0, -1.0, 1.0, -1.0], 6), normals, np.arange(24))
    found = shape_registration(radius * normals, near, sized=True, uncertainty=None, frame=None)
    expected = size**2 * np.array([1 / 8, 1 / 8, 1 / 8, 0, 0, 0, 1 / 24])
    np.testing.assert_allclose(found.covariance, np.diag(expected), atol=1e-12)
    assert found.std_along(radius * normals[:1], normals[:1])[0] == pytest.approx(size * np.sqrt(1 / 8 + 1 / 24))
    grown = found.moves_mm(np.array([0, 0, 0, 0, 0, 0, 0.1]), radius * normals, normals)
    np.testing.assert_allclose(grown, 0.1 * normals)
