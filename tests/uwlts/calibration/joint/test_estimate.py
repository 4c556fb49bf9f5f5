"""Number of independent residuals among correlated ones, and deviations of an estimate from prior knowledge."""

from types import SimpleNamespace

import numpy as np
import pytest

from uwlts.calibration.joint.diagnose import deviations
from uwlts.calibration.joint.estimate import Estimate, estimate_noise
from uwlts.calibration.joint.residuals import STRIPE, TARGET, Residuals
from uwlts.model.parameter_keys import StageParameter, TargetParameter

IMAGES = 9


def together(images):
    """Return the variance factor for the points (n, 2) of images and their residuals (n, 2).

    Each image shows its own points, slightly beside those of the others.
    """
    places = [np.column_stack([at + 0.01 * number, np.zeros(len(at))]) for number, (at, _) in enumerate(images)]
    parts = [
        Residuals(TARGET, found.ravel(), np.empty((found.size, 0)), np.empty((found.size, 0)), np.arange(0), number)
        for number, (_, found) in enumerate(images)
    ]
    return estimate_noise(TARGET, parts, places).together


def lattice(columns, rows):
    x, y = np.meshgrid(np.linspace(-1, 1, columns), np.linspace(-1, 1, rows))
    return 100.0 * np.column_stack([x.ravel(), y.ravel()])


@pytest.mark.parametrize(("columns", "rows", "expected"), [(10, 10, 10.0), (20, 10, 20.0), (6, 4, 1.0)])
def test_what_a_cubic_describes_says_as_much_as_its_ten_coefficients(columns, rows, expected):
    """n points of an image with errors from a polynomial of third order are equivalent to ten; 24 are too few to
    decide.

    The polynomials 4 x^3 - 3 x and x (2 y^2 - 1) vary so little that none of the points is an outlier.
    """
    at = lattice(columns, rows)
    x, y = at.T / 100.0
    residuals = 0.1 * np.column_stack([4 * x**3 - 3 * x, x * (2 * y**2 - 1)])
    assert together([(at, residuals)] * IMAGES) == pytest.approx(expected, rel=1e-9)


def test_independent_residuals_say_as_much_as_they_are():
    """Twenty squares of each image have the mean one; of nine images five exceed 1.8 once in ten million times."""
    rng = np.random.default_rng(0)
    at = lattice(10, 10)
    assert 1.0 <= together([(at, rng.normal(0, 0.1, at.shape)) for _ in range(IMAGES)]) < 1.8


@pytest.mark.parametrize("correlation", [0.0, 0.5, 0.8])
def test_neighbouring_residuals_of_a_stripe_count_as_fewer(correlation):
    """The variance of the mean of a first-order autoregressive process is (1 + r) / (1 - r) times that of white noise.

    For 16 images of 2000 lines, the estimate has a standard error of about 3 %. Correlations below 0.05 are left out,
    which makes it 4 to 5 % smaller.
    """
    rng = np.random.default_rng(4)
    parts = []
    for number in range(16):
        values = rng.standard_normal(2000)
        for line in range(1, len(values)):
            values[line] = correlation * values[line - 1] + np.sqrt(1 - correlation**2) * values[line]
        parts.append(Residuals(STRIPE, values, np.empty((2000, 0)), np.empty((2000, 0)), np.arange(0), number))
    factor = estimate_noise(STRIPE, parts, []).together
    assert factor == pytest.approx((1 + correlation) / (1 - correlation), rel=0.15)


@pytest.mark.parametrize("tied", [False, True])
def test_a_deviation_is_compared_with_its_own_scatter(tied: bool) -> None:
    """One reading of the sum of two parameters with prior knowledge 0; the second may be tied to its prior.

    Over all values of the parameters, the first estimate scatters about 0 as the weighted sum of both parameters and
    the noise.
    """
    std, noise, reading = np.array([5e-5, 1e-4]), 4e-5, 3e-4
    information = np.ones((2, 2)) / noise**2 + np.diag(std**-2.0)
    weights = np.linalg.inv(information) @ np.ones(2) / noise**2
    covariance = formal = np.linalg.inv(information)
    if tied:
        formal = np.diag([1 / information[0, 0], 0.0])
        weights = np.array([formal[0, 0] / noise**2, 0.0])
        covariance = np.diag([formal[0, 0] + (weights[0] * std[1]) ** 2, std[1] ** 2])
    keys = (StageParameter.SCALE, TargetParameter.STRETCH_X)
    parameters = SimpleNamespace(keys=keys, prior_mean=lambda: np.zeros(2), prior_std=lambda: std)
    found = Estimate(parameters, weights * reading, covariance, [], [], {}, [], 0, 1, "", formal if tied else None)
    scatter = weights[0] * np.sqrt(np.sum(std**2) + noise**2)
    (scale,) = (each for each in deviations(found, least=0.0) if each.key is StageParameter.SCALE)
    assert scale.sigmas == pytest.approx(weights[0] * reading / scatter)
