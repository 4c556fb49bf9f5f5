"""Largest means of noisy profiles of known shape."""

import numpy as np
import pytest

from uwlts.inspection.bead_profiles import largest_mean

NOISE, COUNT, TOGETHER, PAIRS = 0.08, 36, 5, 40

SHAPES = {
    "level": np.zeros(COUNT),
    "rising": np.linspace(0, 0.4, COUNT),
    "one deep place": 0.3 * (np.abs(np.arange(COUNT) - 12) < 3),
}


@pytest.mark.parametrize("shape", SHAPES)
def test_the_largest_of_noisy_values_is_not_too_large(shape):
    """The uncorrected maximum of equal values is 0.07 too large, two standard deviations of a mean.

    Fewer than 31 of 40 intervals of 95 % contain the truth once in 80,000 times. The limit for the mean error of 40 is
    four standard deviations of 0.05 / sqrt(40), plus the bias of the extrapolation. The bias is a quarter of the
    standard deviation of a mean.
    """
    rng, truth = np.random.default_rng(7), SHAPES[shape]
    largest = np.convolve(truth, np.full(TOGETHER, 1 / TOGETHER), "valid").max()
    errors, inside, plain = [], 0, []
    for _ in range(PAIRS):
        profiles = truth + NOISE * rng.standard_normal((2, COUNT))
        profiles[1, 20:24] = np.nan
        found = largest_mean(list(profiles), TOGETHER)
        errors.append(found.value - largest)
        inside += found.low <= largest <= found.high
        plain.append(np.convolve(profiles[0], np.full(TOGETHER, 1 / TOGETHER), "valid").max() - largest)
        assert sum(each.sum() for each in found.weights) == pytest.approx(1)
    assert inside >= 31
    assert abs(np.mean(errors)) < 4 * 0.05 / np.sqrt(PAIRS) + 0.25 * NOISE / np.sqrt(TOGETHER)
    assert shape != "level" or np.mean(plain) > 2 * abs(np.mean(errors))


def test_what_is_not_known_has_no_largest():
    found = largest_mean([np.full(6, np.nan), np.zeros(0)], 3)
    assert np.isnan(found.value)
    assert largest_mean([np.array([0.5])], 3)[:3] == (0.5, 0.5, 0.5)


def test_the_lower_end_allows_for_the_largest_noise_of_all_means():
    """Two equal values: the larger error is below z with the probability Phi(z)^2, which is 97.5 % for z = 2.239.

    Of 2000 draws, this quantile has a standard deviation of 0.054; the limit is 4.5 of these.
    """
    found = largest_mean([np.zeros(1), np.zeros(1)], 1, noise=1.0)
    assert found.low == pytest.approx(-2.239, abs=4.5 * 0.054)
