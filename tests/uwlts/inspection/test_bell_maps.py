"""Noise of bell maps: expected number of excursions, and the uncertainty of a scatter from few places."""

from typing import Any

import numpy as np
import pytest
from scipy import fft, ndimage, stats
from scipy.spatial import KDTree

from uwlts.fitting.least_squares import robust_std
from uwlts.inspection.bell_maps import _MAD_EFFICIENCY, BellMap, Tail, UnrolledSurface, fit_bells, limit_deviations


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
    limited = limit_deviations(surface, KDTree(places), together_mm=1.0, false_alarm=0.05)[0].heights
    # Two standard deviations, of local scatters up to 1.7 times as large, above a median of nine points.
    assert np.median(limited[wild]) < 0.06
    deep = pit < -0.3
    assert np.mean(limited[deep]) == pytest.approx(np.mean(heights[deep]), abs=0.01)


def test_a_bell_is_as_high_as_it_is_beside_a_tilted_plane() -> None:
    """Points in the cells' middles, bell and plane without noise: the height of the bell at its place is exact."""
    radius = 3.0
    x, y = (each.ravel() for each in np.meshgrid(np.arange(40.0), np.arange(30.0), indexing="ij"))
    bell = np.square(np.maximum(1 - ((x - 22) ** 2 + (y - 13) ** 2) / radius**2, 0))
    noise = 1e-3 * np.random.default_rng(4).standard_normal(x.size)
    heights = 5 + 0.1 * x - 0.2 * y - 0.7 * bell
    surface = UnrolledSurface(np.column_stack([x, y]), heights + noise, np.full(x.size, 0.02), np.zeros((x.size, 2)))
    found = fit_bells(surface, np.ones(x.size, bool), radius)
    i, j = np.unravel_index(np.nanargmin(found.height), found.height.shape)
    np.testing.assert_allclose(found.origin + (np.array([i, j]) + 0.5) * found.cell, [22, 13])
    # The window has 89 points; a bell's height is as uncertain as about two of them.
    assert found.height[i, j] == pytest.approx(-0.7, abs=5e-3)
    disc = np.hypot(x - 22, y - 13) <= 1.8 * radius
    design = np.column_stack([np.ones(x.size), x, y, bell])[disc]
    assert 1 / found.information[i, j] == pytest.approx(np.linalg.inv(design.T @ design)[3, 3])
    level, noise_there = found.level_at(np.array([[22.0, 13.0]]))[0], found.noise_at(np.array([[22.0, 13.0]]))[0]
    assert level == pytest.approx(noise_there / np.sqrt(found.information[i, j]))
    # Noise of a quarter of the variance has four times the weight.
    uneven = UnrolledSurface(surface.places, heights, np.where(x < 22, 0.02, 0.01), surface.footprint_mm)
    weights = np.where(x < 22, 1.0, 4.0)[disc] * (np.median(uneven.std) / 0.02) ** 2
    expected = np.linalg.inv((design * weights[:, None]).T @ design)[3, 3]
    assert 1 / fit_bells(uneven, np.ones(x.size, bool), radius).information[i, j] == pytest.approx(expected)


def test_the_tail_of_a_map_is_that_of_its_values() -> None:
    """Normal values have none; quantiles of Student's t with five degrees of freedom give five."""
    shares = (np.arange(40_000) + 0.5) / 40_000
    nothing = np.zeros((1, 1))

    def tail(values: np.ndarray) -> Tail:
        shown = values.reshape(200, 200)
        return Tail.of_map(BellMap(1.0, np.zeros(2), 1.0, shown, nothing, nothing, shown, 1.0, np.ones(2), np.ones(2)))

    assert tail(stats.norm.ppf(shares)).freedom > 300
    heavy = tail(stats.t.ppf(shares, 5))
    assert heavy.freedom == pytest.approx(5.0, rel=0.01)
    # Equal probabilities; in units of the robust standard deviation both have the same median absolute value.
    for z in (0.6745, 2.0, 4.0):
        assert heavy.normalise(heavy.scatter_at(z)) == pytest.approx(z, rel=1e-6)
    assert heavy.scatter_at(0.6744898) == pytest.approx(0.6744898, rel=1e-6)
    assert heavy.scatter_at(4.0) == pytest.approx(
        0.6744898 / stats.t.ppf(0.75, 5) * stats.t.isf(stats.norm.sf(4), 5), rel=0.02
    )
    assert Tail(np.inf).normalise(3.0) == pytest.approx(3.0)
