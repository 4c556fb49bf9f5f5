"""Noise of bell maps: expected number of excursions, and the uncertainty of a scatter from few places."""

from typing import Any

import numpy as np
import pytest
from scipy import fft, ndimage
from scipy.spatial import KDTree

from uwlts.fitting.least_squares import robust_std
from uwlts.inspection.bell_maps import _MAD_EFFICIENCY, BellMap, UnrolledSurface, fit_bells, limit_deviations


def test_excursions_are_as_frequent_as_expected() -> None:
    """Connected regions beyond 3.2 standard deviations of 400 smooth fields, which have no holes at this level.

    The count of about 530 has a standard deviation of 4.3 %; the gate is 4.5 of them.
    """
    rng, side, width = np.random.default_rng(6), 128, 4.0
    frequency = fft.fftfreq(2 * side)
    filtered = np.exp(-2 * np.square(np.pi * width * frequency))
    count = 0
    for _ in range(400):
        spectrum: Any = fft.fft2(rng.standard_normal((2 * side, 2 * side))) * np.outer(filtered, filtered)
        # Only a quarter is used, so that its sides are not periodic.
        whole: Any = fft.ifft2(spectrum)
        labelled: Any = ndimage.label(np.abs(whole.real[:side, :side]) * 2 * np.sqrt(np.pi) * width > 3.2)
        count += labelled[1]
    moments, nothing = np.full(2, 1 / (np.sqrt(2) * width)), np.zeros((1, 1))
    sides = np.full(2, float(side))
    clean = BellMap(1.0, np.zeros(2), 1.0, nothing, nothing, nothing, nothing, float(side**2), moments, sides)
    assert count == pytest.approx(400 * clean.false_alarms(3.2), rel=4.5 * 0.043)


def test_the_scatter_from_few_values_is_as_uncertain_as_assumed() -> None:
    """Relative variance of the robust standard deviation of 400 normal values, known to 2.2 % from 4000 draws."""
    drawn = np.random.default_rng(7).standard_normal((4000, 400))
    spread = np.array([robust_std(each) for each in drawn])
    assert spread.var() * 2 * 400 == pytest.approx(1 / _MAD_EFFICIENCY, rel=0.1)


def test_the_scatter_is_local() -> None:
    """Four bands of 24 radii, with noise of 0.01 and 0.03 mm in turn; each scatter is known to 9 %.

    A band's own scatter is within 4.5 deviations of its noise. A scatter of two bands together would be 0.016 mm.
    """
    rng = np.random.default_rng(9)
    places = rng.uniform(0, 1, (20_000, 2)) * (96.0, 24.0)
    noise = np.where(places[:, 0] // 24 % 2 == 0, 0.01, 0.03)
    surface = UnrolledSurface(places, noise * rng.standard_normal(20_000), np.full(20_000, 0.02), np.zeros((20_000, 2)))
    found = fit_bells(surface, np.ones(20_000, bool), 1.0)
    middles = np.column_stack([np.arange(12.0, 96.0, 24.0), np.full(4, 12.0)])
    np.testing.assert_allclose(found.noise_at(middles), [0.01, 0.03, 0.01, 0.03], rtol=0.4)


def test_single_wild_points_are_limited_and_pits_are_not() -> None:
    rng = np.random.default_rng(8)
    places = rng.uniform(0, 40, (6000, 2))
    pit = -0.5 * np.square(np.maximum(1 - np.sum(np.square(places - 20), axis=1) / 9, 0))
    heights = pit + 0.02 * rng.standard_normal(6000)
    wild = rng.choice(np.flatnonzero(pit == 0), 60, replace=False)
    heights[wild] += 0.1
    surface = UnrolledSurface(places, heights, np.full(6000, 0.02), np.zeros((6000, 2)))
    limited = limit_deviations(surface, KDTree(places))[0].heights
    # Two standard deviations, of local scatters up to 1.7 times as large, above a median of nine points.
    assert np.median(limited[wild]) < 0.06
    deep = pit < -0.3
    assert np.mean(limited[deep]) == pytest.approx(np.mean(heights[deep]), abs=0.01)
