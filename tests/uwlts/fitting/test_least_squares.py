"""Tukey's biweight, rigid transforms, and covariances: known solutions and efficiencies."""

import numpy as np
from scipy.spatial.transform import Rotation

from uwlts.fitting.least_squares import (
    biweight,
    fit_biweight,
    fit_rigid_transform,
    noise_factor,
    parameter_covariance,
    robust_std,
)

SEED = 4


def test_a_line_is_fitted_beside_outliers():
    rng = np.random.default_rng(SEED)
    x = np.linspace(-1, 1, 400)
    design = np.column_stack([np.ones_like(x), x])
    values = design @ [3.0, -2.0] + 0.01 * rng.standard_normal(len(x))
    values[::4] += 5.0
    counted = np.arange(len(x)) < 390
    rows, weights = fit_biweight(design, values, counted)
    assert (weights[::4] == 0).all() and (weights[~counted] == 0).all()
    # Five standard deviations of coefficients by 290 points, 95 % efficient; a slope's are 3 ** 0.5 as large.
    limit = 5 * 0.01 / np.sqrt(0.95 * 290) * np.array([1.0, np.sqrt(3)])
    assert (np.abs(rows @ values - [3.0, -2.0]) < limit).all()
    # Weighted residuals are orthogonal to the design, but for the change of weights that ends the rounds.
    left = values - design @ (rows @ values)
    assert np.abs((weights * left) @ design).max() < 1e-5


def test_normal_noise_costs_five_percent():
    rng, draws, count = np.random.default_rng(SEED), 1000, 200
    design, counted = np.ones((count, 1)), np.ones(count, bool)
    found = np.array([(fit_biweight(design, row, counted)[0] @ row)[0] for row in rng.standard_normal((draws, count))])
    # A variance estimated from n draws has the relative variance 2 / n: five standard errors.
    assert abs(count * found.var() * 0.95 - 1) < 5 * np.sqrt(2 / draws)


def test_exact_values_are_no_outliers():
    x = np.linspace(-1, 1, 50)
    rows, weights = fit_biweight(np.column_stack([np.ones_like(x), x]), 1e3 + 7 * x, np.ones(50, bool))
    np.testing.assert_allclose(rows @ (1e3 + 7 * x), [1e3, 7.0], rtol=1e-9)
    assert (weights > 0).all()


def test_scatter_is_that_of_normal_noise_and_never_less_than_stated():
    noise = np.random.default_rng(SEED).standard_normal(100_000)
    # The median absolute deviation is 37 % efficient: five standard errors of a standard deviation.
    limit = 5 * np.sqrt(0.5 / 0.37 / len(noise))
    assert abs(robust_std(noise) - 1) < limit and abs(noise_factor(3 * noise) / 3 - 1) < limit
    assert noise_factor(0.1 * noise) == 1.0 and noise_factor(np.empty(0)) == 1.0
    np.testing.assert_allclose(biweight(np.array([0.0, 4.685 / 2, 4.685, 9.0])), [1.0, 0.75**2, 0.0, 0.0], atol=1e-12)


def test_points_moved_rigidly_are_moved_back_without_a_reflection():
    rng = np.random.default_rng(SEED)
    source, turn = rng.normal(size=(6, 3)), Rotation.from_rotvec([1.0, -2.0, 0.3]).as_matrix()
    found = fit_rigid_transform(source, source @ turn.T + [5.0, -3.0, 100.0])
    np.testing.assert_allclose(
        found, np.block([[turn, np.array([[5.0], [-3.0], [100.0]])], [np.eye(4)[3:]]]), atol=1e-9
    )
    # A mirror image is approached by a rotation.
    assert np.linalg.det(fit_rigid_transform(source, source * [1, 1, -1])[:3, :3]) > 0


def test_a_straight_line_has_the_covariance_of_the_text_books():
    """Slope and mean of values at -2 to 2, with residuals of one size: s2 = 4 h2 / 3."""
    x = np.array([-2.0, -1.0, 0.0, 1.0, 2.0])
    residuals = 0.1 * np.array([1.0, -1.0, 0.0, -1.0, 1.0])
    covariance, std = parameter_covariance(
        np.column_stack([np.ones(5), x]), float(residuals @ residuals), what="a line"
    )
    assert std == np.sqrt(0.04 / 3)
    np.testing.assert_allclose(covariance, 0.04 / 3 * np.diag([1 / 5, 1 / 10]), atol=1e-15)
