"""Propagation of point errors to figures: draws and patterns against the covariance of sums over the points."""

import numpy as np

from uwlts.fitting.propagation import PointErrors, grouped_covariance, jackknife, noise_shifts
from uwlts.storage.cloud import PAIRS, PointUncertainty

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


def test_scatter_beyond_the_stated_noise_counts_by_neighbourhoods():
    """Residuals of 0.3 mm common to groups of six: the variance of their mean is 0.09 over the number of groups."""
    count, groups = 60, np.arange(60) // 6
    errors = PointErrors(np.full(count, 0.01), np.zeros((0, count)), np.arange(count), None)
    residuals = 0.3 * (-1.0) ** groups
    random, common = errors.covariances(np.full((1, count), 1 / count), residuals, groups)
    np.testing.assert_allclose(random, [[0.09 / 10]])
    assert common is None
    # With less scatter than stated, 0.01 mm of each point count.
    random, _ = errors.covariances(np.full((1, count), 1 / count), 0.001 * residuals, groups)
    np.testing.assert_allclose(random, [[0.01**2 / 60]])


def test_covariances_of_groups_are_those_of_their_sums():
    """Two sums over four points: a part of the first two points, and one of each pair."""
    weights = np.array([[1.0, 2.0, 3.0, 4.0], [1.0, -1.0, 0.0, 0.5]])
    parts = np.array([[1.0, 1.0, 0.0, 0.0], [0.1, 0.1, 0.1, 0.1]])
    sums = np.array([[3.0, 0.0], [0.3, 0.0], [0.7, 0.05]])
    np.testing.assert_allclose(grouped_covariance(weights, parts, np.array([7, 7, 2, 2])), sums.T @ sums)


def test_a_jackknife_of_means_is_their_variance():
    values = np.array([1.0, 4.0, 2.0, 8.0, 5.0])
    without = np.array([np.delete(values, k).mean() for k in range(5)]) - values.mean()
    np.testing.assert_allclose(jackknife(without[:, None]), [[values.var(ddof=1) / 5]])


def test_a_shift_of_noise_is_the_root_of_its_covariance():
    shifts = np.array([[0.3, -0.1, 0.2], [0.0, 0.0, -0.5], [0.0, 0.0, 0.0]])
    random = np.stack([shifts[:, i] * shifts[:, j] for i, j in PAIRS], axis=1)
    found = noise_shifts(PointUncertainty(random, np.zeros((3, 3)), np.zeros((0, 3, 3))))
    np.testing.assert_allclose(found, shifts * [[1], [-1], [1]], atol=1e-12)
