"""Propagation of point errors to figures: draws and patterns against the covariance of sums over the points."""

import numpy as np

from uwlts.fitting.propagation import PointErrors

DRAWS = 4000


def test_draws_and_patterns_give_the_covariance_of_sums():
    rng = np.random.default_rng(2)
    count, images = 60, 6
    image = np.arange(count) // (count // images) + 10
    errors = PointErrors(
        rng.uniform(0.5, 1.5, count), rng.standard_normal((2, count)), image, rng.standard_normal((3, count))
    )
    weights = rng.standard_normal((4, count))
    random, systematic = errors.propagate(lambda moves: weights @ moves, draws=DRAWS)
    # Residuals of zero: what is stated counts.
    expected, common = errors.covariances(weights, np.zeros(count), image)
    assert systematic is not None and common is not None
    np.testing.assert_allclose(systematic, np.sqrt(np.diag(common)))
    # Five standard errors of a standard deviation from `DRAWS` draws.
    np.testing.assert_allclose(random, np.sqrt(np.diag(expected)), rtol=5 / np.sqrt(2 * DRAWS))


def test_a_selection_has_the_errors_of_its_points():
    errors = PointErrors(np.ones((5, 3)), np.ones((1, 5, 3)), np.array([0, 0, 1, 1, 2]), None)
    chosen = errors[np.array([0, 1, 4])]
    (move,) = chosen.draw(1)
    assert move.shape == (3, 3) and chosen.by_patterns(lambda moves: moves.sum()) is None
    # Noise along (1, 1, 1), and images that move their points together by the same.
    np.testing.assert_allclose(move, np.repeat(move[:, :1], 3, axis=1))
