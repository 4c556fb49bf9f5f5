"""Errors of a registration to a surface against its covariance, and the uncertainty of fitted shapes."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from scipy.stats import chi2

from uwlts.registration.surface_registration import Registration, SurfaceSample, register_to_surface, shape_registration
from uwlts.storage.cloud import PointUncertainty


def height(x: np.ndarray, y: np.ndarray) -> np.ndarray:
    """Return the height of a surface without symmetry: every motion changes it."""
    return 2.0 * np.sin(x / 9.0) + 1.5 * np.cos(y / 7.0) + 0.002 * x * y


def white(points: np.ndarray, normals: np.ndarray, std: float) -> PointUncertainty:
    pairs = ((0, 0), (0, 1), (0, 2), (1, 1), (1, 2), (2, 2))
    random = std**2 * np.stack([normals[:, i] * normals[:, j] for i, j in pairs], axis=1)
    return PointUncertainty(random, np.zeros_like(points), np.zeros((0, len(points), 3)))


def drawn(rng: np.random.Generator, std: float, *, change_mm: float = 0.0) -> SurfaceSample:
    """Return 6,000 points of the surface at random places, with noise along z and a wide bump on 8 % of the area."""
    x, y = rng.uniform(-30, 30, (2, 6000))
    z = height(x, y) + change_mm * np.exp(-((x - 10) ** 2 + (y - 5) ** 2) / 50)
    points = np.column_stack([x, y, z + std * rng.standard_normal(len(x))])
    return SurfaceSample(points, white(points, np.tile([0.0, 0.0, 1.0], (len(x), 1)), std))


def errors_of(found: Registration, turn: np.ndarray, shift: np.ndarray) -> np.ndarray:
    """Return the error (6,) of a registration that should undo a motion: at its middle, and of its turn."""
    rotation = found.transform[:3, :3] @ turn
    at = np.linalg.solve(found.transform, np.append(found.middle_mm, 1.0))[:3]
    return np.concatenate([found.middle_mm - turn.T @ (at - shift), Rotation.from_matrix(rotation).as_rotvec()])


def test_the_covariance_is_that_of_the_errors() -> None:
    """15 registrations of six parameters; the sum of squares is within limits exceeded 1 time in 10,000."""
    rng, squares, draws = np.random.default_rng(8), 0.0, 15
    for _ in range(draws):
        reference, cloud = drawn(rng, 0.02), drawn(rng, 0.01)
        turn, shift = Rotation.from_rotvec(rng.normal(0, 0.003, 3)).as_matrix(), rng.normal(0, 0.3, 3)
        moved = replace(cloud, points_mm=cloud.points_mm @ turn.T + shift)
        found = register_to_surface(moved, reference, reach_mm=2.0)
        error = errors_of(found, turn, shift)
        squares += float(error @ np.linalg.solve(found.covariance, error))
    low, high = chi2.ppf([5e-5, 1 - 5e-5], 6 * draws)
    assert low < squares < high


def test_a_wide_change_moves_the_result_little() -> None:
    """A bump fifteen times the noise high: far from it the cloud stays within the noise of a single point."""
    rng = np.random.default_rng(11)
    found = register_to_surface(drawn(rng, 0.02, change_mm=0.3), drawn(rng, 0.02), reach_mm=2.0)
    corners = np.array([(x, y, height(x, y)) for x in (-25.0, 25.0) for y in (-25.0, 25.0)])
    off = corners @ found.transform[:3, :3].T + found.transform[:3, 3] - corners
    assert np.abs(off).max() < 0.02


def test_what_a_plane_does_not_determine_is_left() -> None:
    """Errors of images tilt the normals of a plane, and do not determine a shift across it."""
    rng, std = np.random.default_rng(5), 0.01
    x, y = (each.ravel() for each in np.meshgrid(np.arange(-20.0, 20.5, 0.5), np.arange(-20.0, 20.5, 0.5)))
    flat = np.column_stack([x, y, np.zeros(len(x))])
    reference = flat + np.outer(std * rng.standard_normal(81)[((x + 20) * 2).astype(int)], [0, 0, 1])
    cloud = flat + [0.3, -0.2, 0.1] + np.outer(std * rng.standard_normal(len(x)), [0, 0, 1])
    cloud[0, 2] += 0.5
    found = register_to_surface(SurfaceSample(cloud), SurfaceSample(reference), reach_mm=1.0)
    # The three motions are equally undetermined, so that any combinations of them may be named.
    names = {name for words in found.open_directions for name in words.split(" with ")}
    assert names == {"shift along x", "shift along y", "turn about z"} and len(found.open_directions) == 3
    # The mean of 81 images; five standard deviations.
    np.testing.assert_allclose(found.transform[:3, 3], [0, 0, -0.1], atol=5 * std / 9)
    assert np.abs(found.covariance[[0, 1, 5]]).max() < 1e-3 * found.covariance[2, 2]


def test_the_uncertainty_of_a_fitted_plane_is_that_of_its_residuals() -> None:
    """Residuals of one size and alternating signs, which no motion reduces; five images, and two patterns."""
    side = np.arange(-4.5, 5.0)
    x, y = (each.ravel() for each in np.meshgrid(side, side, indexing="ij"))
    points, up = np.column_stack([x, y, np.zeros(100)]), np.tile([0.0, 0.0, 1.0], (100, 1))
    size, image = 0.03, np.repeat(np.arange(5), 20)
    near = (size * np.where((x + y) % 2 == 0, 1.0, -1.0), up)
    known = PointUncertainty(np.zeros((100, 6)), 0.2 * up, np.stack([0.5 * up, 0.01 * y[:, None] * up]))
    plain = shape_registration(SurfaceSample(points), *near, sized=False)
    assert plain.rms_mm == pytest.approx(size) and plain.counted == 100
    assert plain.by_cloud.shape == plain.by_reference.shape == (0, 6)
    expected = size**2 * np.array([0, 0, 1 / 100, 1 / (y @ y), 1 / (x @ x), 0])
    np.testing.assert_allclose(plain.covariance, np.diag(expected), atol=1e-12)
    # Halfway to the border: the offset and one tilt.
    std = plain.std_along(np.array([[0.0, 3.0, 0.0]]), up[:1])
    np.testing.assert_allclose(std, size * np.sqrt(1 / 100 + 9 / (y @ y)))
    found = shape_registration(SurfaceSample(points, known, image), *near, sized=False)
    assert found.covariance[2, 2] == pytest.approx(expected[2] + 0.2**2 / 5)
    # The motion undoes the errors: a shift, and a turn by the slope.
    np.testing.assert_allclose(found.by_cloud, [[0, 0, -0.5, 0, 0, 0], [0, 0, 0, -0.01, 0, 0]], atol=1e-12)
    np.testing.assert_allclose(found.moves_mm(found.by_cloud[1], points), -0.01 * y[:, None] * up, atol=1e-12)


def test_the_uncertainty_of_a_fitted_sphere_includes_its_radius() -> None:
    """Points on all axes: their normals have a third of the sum of squares each, and turns are undetermined."""
    normals = np.tile(np.vstack([np.eye(3), -np.eye(3)]), (4, 1))
    size, radius = 0.02, 10.0
    near = (size * np.repeat([1.0, -1.0, 1.0, -1.0], 6), normals)
    found = shape_registration(SurfaceSample(radius * normals), *near, sized=True)
    expected = size**2 * np.array([1 / 8, 1 / 8, 1 / 8, 0, 0, 0, 1 / 24])
    np.testing.assert_allclose(found.covariance, np.diag(expected), atol=1e-12)
    assert found.std_along(radius * normals[:1], normals[:1])[0] == pytest.approx(size * np.sqrt(1 / 8 + 1 / 24))
    grown = found.moves_mm(np.array([0, 0, 0, 0, 0, 0, 0.1]), radius * normals, normals)
    np.testing.assert_allclose(grown, 0.1 * normals)
