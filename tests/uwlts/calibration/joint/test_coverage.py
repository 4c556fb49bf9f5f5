"""Coverage of stated uncertainties of the joint calibration, in whole simulated campaigns.

200 campaigns of each kind are measured by ``python -m tests.bench.coverage``.
"""

import numpy as np
import pytest
from scipy.stats import binom, chi2

from tests.bench.coverage import Campaign, judged, run_campaign, within

pytestmark = pytest.mark.slow

WET, DRY = 8, 4
BY_CHANCE = 1e-3
"""Probability that a test of a correct uncertainty fails."""


@pytest.fixture(scope="module")
def outcomes():
    """Results of all campaigns."""
    return [run_campaign(Campaign(seed, wet=seed < WET)) for seed in range(WET + DRY)]


@pytest.fixture(scope="module")
def measured(outcomes):
    """Return errors divided by standard uncertainties, and fractions within 95 %, of all scans, by quantity."""
    found = judged(outcomes)
    return {
        quantity: [m for (_, other), some in found.items() if other == quantity for m in some]
        for quantity in ("spacing", "diameter")
    }


@pytest.mark.parametrize("quantity", ["spacing", "diameter"])
def test_95_percent_intervals_hold_the_truth(measured, quantity):
    """Two scans of each campaign: 24 spacings, and as many pairs of diameters, which can be correlated.

    If the standard uncertainties were half of the correct ones, 67 % would be inside, so that 77 of 100 such tests
    fail, and 95 of 100 of the next one.
    """
    found = measured[quantity]
    scans = 2 * (WET + DRY)
    assert len(found) == (scans if quantity == "spacing" else 2 * scans)
    assert within(found) >= binom.ppf(BY_CHANCE, scans, 0.95) / scans


@pytest.mark.parametrize("quantity", ["spacing", "diameter"])
def test_errors_are_as_large_as_stated(measured, quantity):
    """The mean square of error over standard uncertainty is one.

    Uncertainties wrong by a factor of two either way make it 4 or 0.25; the interval reaches from 0.33 to 2.2. The mean
    square of pairs of diameters scatters no more than that of as many single ones.
    """
    scans = 2 * (WET + DRY)
    square = np.mean([(m.error_mm / m.std_mm) ** 2 for m in measured[quantity]])
    lowest, highest = chi2.ppf([BY_CHANCE, 1 - BY_CHANCE], scans) / scans
    assert lowest < square < highest


def test_the_covariance_is_that_of_the_errors(outcomes):
    """Errors of lens, window, water, stage, target and step, whitened by their covariance: some 240 with unit variance.

    Their mean square is within 0.74 and 1.32. A covariance too large by a factor of 1.5 gives 0.67, one too small by
    that factor 1.5.
    """
    pulls = np.concatenate([outcome.pulls for outcome in outcomes])
    assert len(pulls) == 21 * WET + 19 * DRY
    lowest, highest = chi2.ppf([BY_CHANCE, 1 - BY_CHANCE], len(pulls)) / len(pulls)
    assert lowest < np.mean(pulls**2) < highest
