"""Pieces of a path: time gradients over a surface, and the maps between navigated and corrected paths."""

import numpy as np

from uwlts.alignment.pieces import _fit_time_gradients, correct_places


def test_time_gradients_are_those_of_a_plane_and_of_lonely_patches_zero() -> None:
    """Times that are linear over an inclined plane: the gradient along it, without a part along its normal."""
    flat = np.random.default_rng(1).uniform(0, 20, (400, 2))
    normal = np.array([0.36, 0.48, 0.8])
    first = np.array([0.8, -0.6, 0.0])
    places = flat @ np.array([first, np.cross(normal, first)])
    gradient = 0.02 * first - 0.01 * np.cross(normal, first)
    lonely, pair = np.array([[100.0, 0, 0]]), np.array([[200.0, 0, 0], [200.01, 0, 0]])
    times = np.concatenate([5 + places @ gradient, [3.0], [1.0, 1.5]])
    found = _fit_time_gradients(np.vstack([places, lonely, pair]), times, 3.0)
    # The ridge is 1e-6 of the neighbours' sum of squares.
    np.testing.assert_allclose(found[:400], np.broadcast_to(gradient, (400, 3)), atol=1e-4 * 0.02)
    np.testing.assert_array_equal(found[400], 0.0)
    # Two patches 0.01 mm apart: the ridges are 1e-10 and 1e-9 mm2 beside their sum of squares of 1e-4 mm2.
    np.testing.assert_allclose(found[401:], [[50 / (1 + 1.1e-5), 0, 0]] * 2, rtol=1e-8)


def test_corrections_turn_about_the_platform() -> None:
    """A quarter turn about z, and a shift."""
    corrections = np.array([[1.0, 2.0, 3.0, 0, 0, np.pi / 2]])
    found = correct_places(corrections, np.array([[10.0, 0, 50]]), np.array([[14.0, 0, 300]]))
    np.testing.assert_allclose(found, [[11.0, 6.0, 303.0]], atol=1e-12)
