"""Local surfaces against surfaces of second order in closed form, and against NumPy's weighted least squares."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from uwlts.fitting.local_surface import LocalPatches, LocalSurface, SurfacePoints, surface_normals

RADIUS_MM = 2.0
TURN = Rotation.from_rotvec([0.3, 2.5, -0.8]).as_matrix()
SHAPE = np.array([0.4, 0.2, -0.1, 0.03, -0.05, 0.02])


def terms(x: np.ndarray, y: np.ndarray) -> np.ndarray:
    return np.stack([np.ones_like(x), x, y, x * x, x * y, y * y], axis=-1)


def scattered(seed: int, count: int = 2500) -> np.ndarray:
    """Return places (N, 2) over 20 mm x 20 mm, with 31 in a disc of the radius."""
    return np.random.default_rng(seed).uniform(-10, 10, (count, 2))


def surface_of(
    flat: np.ndarray,
    height: np.ndarray,
    *,
    up: np.ndarray | float = 1.0,
    weight: np.ndarray | float = 1.0,
    noise: np.ndarray | float = 0.0,
    position: np.ndarray | float = 0.0,
    image: np.ndarray | int = 0,
    patterns: np.ndarray | None = None,
    scan: np.ndarray | int = 0,
) -> LocalSurface:
    """Return a surface of heights (N,) over places (N, 2), turned; its normals are ``up`` times the third axis."""
    count = len(flat)

    def each(value: np.ndarray | float, dtype: type = float) -> np.ndarray:
        return np.broadcast_to(np.asarray(value, dtype), count).copy()

    return LocalSurface(
        SurfacePoints(
            np.column_stack([flat, height]) @ TURN.T,
            each(up)[:, None] * TURN[:, 2],
            each(weight),
            each(noise),
            each(position),
            each(image, np.int64),
            np.zeros((0, count)) if patterns is None else patterns,
            each(scan, np.int64),
        ),
        radius_mm=RADIUS_MM,
    )


def patches_at(surface: LocalSurface, places: np.ndarray, *, with_uncertainty: bool = False) -> LocalPatches:
    return surface.patches(places @ TURN.T, with_uncertainty=with_uncertainty)


def test_a_surface_of_second_order_is_exact() -> None:
    """Heights and normals at places within the radius of the surface, whatever the weights; the ridge is 1e-6."""
    flat = scattered(1)
    height = terms(*flat.T) @ SHAPE
    places = np.column_stack([scattered(2, 50) / 2, np.zeros(50)])
    true = terms(*places[:, :2].T) @ SHAPE
    places[:, 2] = true + np.random.default_rng(3).uniform(-0.3, 0.3, 50)
    weight = np.random.default_rng(4).uniform(0.5, 2.0, len(flat))
    found = patches_at(surface_of(flat, height, weight=weight), places)
    assert found.found.all()
    np.testing.assert_allclose(found.height_mm, true - places[:, 2], atol=1e-4)
    x, y = places[:, :2].T
    slopes = np.stack([SHAPE[1] + 2 * SHAPE[3] * x + SHAPE[4] * y, SHAPE[2] + SHAPE[4] * x + 2 * SHAPE[5] * y])
    normals = np.column_stack([-slopes[0], -slopes[1], np.ones(50)])
    normals /= np.linalg.norm(normals, axis=1)[:, None]
    np.testing.assert_allclose(found.normals @ TURN, normals, atol=1e-4)


def test_normals_of_points_are_those_of_planes_towards_the_sensor() -> None:
    """A plane is exact; of a sphere, about 30 points each give the direction within the slope over a tenth radius."""
    flat = scattered(5)
    plane = np.column_stack([flat, np.full(len(flat), 3.0)]) @ TURN.T
    for sign in (1.0, -1.0):
        found = surface_normals(plane, radius_mm=RADIUS_MM, towards=sign * TURN[:, 2])
        np.testing.assert_allclose(found, np.broadcast_to(sign * TURN[:, 2], plane.shape), atol=1e-9)
    way = np.random.default_rng(6).normal(size=(5000, 3))
    way /= np.linalg.norm(way, axis=1)[:, None]
    way = way[way[:, 2] > 0.3]
    found = surface_normals(20.0 * way, radius_mm=RADIUS_MM, towards=np.array([0.0, 0.0, 1.0]))
    inner = way[:, 2] > 0.5
    assert np.median(np.einsum("ni,ni->n", found, way)[inner]) > np.cos(0.2 * RADIUS_MM / 20.0)


def test_uncertainty_is_that_of_weighted_least_squares() -> None:
    """Noise of points and of images, patterns of two scans, and roughness where the scatter is larger."""
    rng, flat = np.random.default_rng(7), scattered(8)
    count = len(flat)
    weight, noise = rng.uniform(0.5, 2.0, count), rng.uniform(0.5, 1.5, count) * 1e-2
    position, image, scan = rng.normal(size=count) * 0.1, rng.integers(0, 9, count), rng.integers(0, 2, count)
    patterns, place = rng.normal(size=(3, count)), np.array([[0.7, -0.4, 0.0]])
    off = (flat - place[:, :2]) / RADIUS_MM
    square = np.sum(off**2, axis=1)
    near = square < 1
    kernel = ((1 - square) ** 2 * weight)[near]
    root = np.sqrt(kernel)[:, None]
    rows = (np.linalg.pinv(root * terms(*off[near].T)) * root.T)[0]
    for rough in (0.0, 0.5):
        height = rough * rng.normal(size=count)
        found = patches_at(
            surface_of(flat, height, weight=weight, noise=noise, position=position, image=image, scan=scan,
                       patterns=patterns),
            place, with_uncertainty=True,
        )  # fmt: skip
        # An unturned ridge of 1e-6 of the total weight changes sums by as much.
        assert found.height_mm[0] == pytest.approx(rows @ height[near], abs=1e-4)
        left = (
            height[near]
            - terms(*off[near].T) @ np.linalg.lstsq(root * terms(*off[near].T), root[:, 0] * height[near])[0]
        )
        scatter = kernel @ left**2 / kernel.sum() * near.sum() / (near.sum() - 6) * np.sum(rows**2)
        by_images = np.bincount(image[near], rows * position[near])
        variance = max(rows**2 @ noise[near], scatter) + np.sum(by_images**2)
        assert (scatter > rows**2 @ noise[near]) == (rough > 0)
        assert found.noise_mm[0] == pytest.approx(np.sqrt(variance), rel=1e-3)
        shared = [np.bincount(scan[near], rows * pattern[near], minlength=2) for pattern in patterns]
        assert found.shared_mm[0] == pytest.approx(np.linalg.norm(shared), rel=1e-3)


def test_each_side_of_a_thin_wall_is_its_own() -> None:
    """Two planes 1 mm apart, half the radius, with opposite normals: a patch has the points of the nearest side."""
    flat = scattered(9, 5000)
    upper = np.arange(5000) % 2 == 0
    surface = surface_of(flat, np.where(upper, 0.0, -1.0), up=np.where(upper, 1.0, -1.0))
    found = patches_at(surface, np.array([[1.0, 2.0, 0.2], [1.0, 2.0, -1.2]]))
    np.testing.assert_allclose(found.height_mm, [-0.2, -0.2], atol=1e-6)
    np.testing.assert_allclose(found.normals @ TURN, [[0, 0, 1], [0, 0, -1]], atol=1e-6)


def test_nothing_is_extrapolated() -> None:
    """A half plane to x = 0: at the border the centroid is 0.29 radii inside; 0.4 radii outside it is beyond 0.4."""
    flat = scattered(10)
    flat = flat[flat[:, 0] < 0]
    surface = surface_of(flat, np.zeros(len(flat)), noise=1e-4)
    y = np.linspace(-6, 6, 9)
    found = [
        patches_at(surface, np.column_stack([np.full(9, at * RADIUS_MM), y, np.zeros(9)])).found
        for at in (-1.0, 0.0, 0.4, 2.0)
    ]
    assert found[0].all() and found[1].mean() > 0.8
    assert not found[2].any() and not found[3].any()
    # Seven points are too few for six coefficients.
    few = flat[np.argsort(np.hypot(*(flat + 4).T))[:7]]
    assert not patches_at(surface_of(few, np.zeros(7)), np.array([[-4.0, -4.0, 0.0]])).found.any()
