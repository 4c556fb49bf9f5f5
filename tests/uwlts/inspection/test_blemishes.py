"""Depths of shallow pits without the bias of a maximum in noise; sizes of known shapes, and exact quadratics."""

from collections.abc import Callable
from functools import partial

import numpy as np
import pytest
from scipy.spatial import KDTree

from uwlts.fitting.propagation import PointErrors
from uwlts.inspection.bead_profiles import interpolation_rows, profile_rows
from uwlts.inspection.bell_maps import UnrolledSurface
from uwlts.inspection.blemish_search import search_blemishes
from uwlts.inspection.blemishes import (
    NotSignificantError,
    _Bell,
    _interpolate,
    _make_quadratic_rows,
    _measure_section,
    measure_blemish,
)
from uwlts.inspection.features import FeatureValue


@pytest.mark.slow
def test_shallow_pits_are_as_deep_as_they_are_on_average() -> None:
    """Sixteen pits four times as deep as the noise: the largest of noisy depths is 0.017 mm too deep on average.

    The mean error of the corrected depths has a standard deviation of 0.0026 mm.
    """
    rng, noise, depth = np.random.default_rng(1), 0.02, 0.08
    places = np.stack(np.meshgrid(np.arange(0, 60, 0.6), np.arange(0, 60, 0.6)), axis=-1).reshape(-1, 2)
    count, heights = len(places), noise * rng.standard_normal(len(places))
    for middle in np.stack(np.meshgrid((9, 23, 37, 51), (9, 23, 37, 51)), axis=-1).reshape(-1, 2):
        heights -= depth * np.square(np.maximum(1 - np.sum(np.square(places - middle), axis=1) / 16, 0))
    surface = UnrolledSurface(places, heights, np.full(count, noise), np.zeros((count, 2)))
    search = search_blemishes(surface, false_alarm=0.05)
    errors = PointErrors(np.zeros(count), np.zeros((0, count)), np.arange(count), None)
    measured = [measure_blemish(surface, search, each, errors, diameter_mm=100.0) for each in search.indications]
    wrong = [each.values[0].value - depth for each in measured]
    assert len(wrong) >= 12
    assert abs(np.mean(wrong)) < 0.015


def measure_deepest(depths: Callable[[np.ndarray], np.ndarray], side: float, seed: int) -> FeatureValue:
    """Return the depth of the deepest indication of depths over places (N, 2), with a noise of 0.01 mm."""
    rng, noise = np.random.default_rng(seed), 0.01
    places = np.stack(np.meshgrid(np.arange(side), np.arange(side)), axis=-1).reshape(-1, 2)
    places, count = places + rng.uniform(-0.3, 0.3, places.shape), len(places)
    heights = noise * rng.standard_normal(count) - depths(places - side / 2)
    surface = UnrolledSurface(places, heights, np.full(count, noise), np.zeros((count, 2)))
    search = search_blemishes(surface, false_alarm=0.05)
    errors = PointErrors(np.zeros(count), np.zeros((0, count)), np.arange(count), None)
    deepest = max(search.indications, key=lambda each: abs(each.height_mm))
    return measure_blemish(surface, search, deepest, errors, diameter_mm=100.0).values[0]


def test_the_interval_of_a_dent_contains_its_tail_in_the_surroundings() -> None:
    """A tenth of a normal distribution's depth is its edge: its tail raises the undamaged surface by 0.01 mm of 2."""
    found = measure_deepest(lambda places: 2 * np.exp(-np.sum(places**2, axis=1) / 128), 90, 0)
    assert found.low < 2.0 < found.high
    assert found.high - found.low < 0.08


def test_steep_sides_do_not_lower_the_depth_of_a_gouge() -> None:
    """Gouges 1.2 mm deep and six points wide, in five directions: their sides scatter more than the noise.

    With this scatter as noise of the maximum they would be 0.04 mm too shallow on average; 0.016 mm are smoothed away.
    """

    def depths(places: np.ndarray, turn: float) -> np.ndarray:
        along, across = places @ [np.cos(turn), np.sin(turn)], places @ [-np.sin(turn), np.cos(turn)]
        section = np.where(np.abs(across) < 3, 0.6 + 0.6 * np.cos(np.pi * across / 3), 0.0)
        return section * np.clip(2 - np.abs(along) / 9, 0, 1)

    found = [measure_deepest(partial(depths, turn=0.7 * k), 60, k) for k in range(5)]
    assert abs(np.mean([each.value for each in found]) - 1.2) < 0.025
    assert all(each.low < 1.2 < each.high for each in found)


def quadratic(u: np.ndarray, v: np.ndarray) -> np.ndarray:
    return 1.0 + 0.2 * u - 0.3 * v + 0.04 * u * u - 0.05 * u * v + 0.06 * v * v


def test_a_paraboloid_has_its_sizes_at_an_edge() -> None:
    """Depth 2 (1 - t^2) with half axes of 3 and 5 mm, at an edge of 0.5: three quarters of the squared axes."""
    bell = _Bell(np.array([1.0, -2.0]), np.array([3.0, 5.0]), 2.0, 1)
    rim = np.sqrt(0.75)
    lost = 2 * 3 * 2 * (rim - rim**3 / 3)
    expected = [2.0, 6 * rim, 10 * rim, np.pi * 15 * 0.75, lost]
    # The trapezoidal rule of 100 steps.
    np.testing.assert_allclose(bell.figures(0.5), expected, rtol=1e-4)
    np.testing.assert_allclose(bell.depths_at(np.array([[1.0, -2], [2.5, -2], [1, 3], [9, 9]])), [2, 1.5, 0, 0])
    for p in (1, 2, 3):
        sharp = _Bell(np.zeros(2), np.array([3.0, 5.0]), 2.0, p)
        at = np.column_stack([0.5 * sharp.figures(0.5)[1:2], [0.0]])
        np.testing.assert_allclose(sharp.depths_at(at), 0.5)
    again = _Bell.resembling(bell.figures(0.5), 0.5, bell.middle, 1.0, 1)
    np.testing.assert_allclose(again.figures(0.5)[:4], expected[:4], rtol=1e-4)
    with pytest.raises(NotSignificantError, match="does not depart"):
        _Bell.resembling(np.array([-0.1, 1.0, 1.0, 1.0, 1.0]), 0.01, bell.middle, 1.0, 2)


def test_a_section_ends_where_it_crosses_the_edge() -> None:
    """A triangle with slopes of 1 and 1/2: cut at 0.5 it is 4.5 long, with an area of 6 - 1/8 - 1/4 beneath."""
    profile = np.array([0.0, 1.0, 2.0, 1.5, 1.0, 0.5 - 1e-12, 0.0])
    length, area = _measure_section(profile, 0.5, 1.0)
    assert length == pytest.approx(4.5)
    assert area == pytest.approx(6 - 1 / 8 - 1 / 4, abs=1e-9)
    assert _measure_section(profile, 0.5, 0.1) == pytest.approx((0.45, 0.5625), abs=1e-9)
    assert _measure_section(profile, 3.0, 1.0) == (0.0, 0.0)
    # Half a cell beyond the border of a grid.
    assert _measure_section(np.ones(4), 0.5, 1.0)[0] == pytest.approx(4.0)


def test_interpolation_and_smoothing_are_exact_for_quadratics() -> None:
    rng = np.random.default_rng(2)
    shape, inner = (9, 12), rng.uniform([1.5, 1.5], [6.5, 9.5], (40, 2))
    u, v = (each.ravel() for each in np.indices(shape).astype(float))
    rows = _interpolate(inner, shape)
    np.testing.assert_allclose(rows @ quadratic(u, v), quadratic(*inner.T))
    assert not (_interpolate(np.array([[-5.0, 3.0], [4.0, 40.0]]), shape) @ quadratic(u, v)).any()
    places = rng.uniform(-1, 10, (1500, 2))
    smooth = _make_quadratic_rows(inner, places, KDTree(places), 1.2)
    np.testing.assert_allclose(smooth @ quadratic(*places.T), quadratic(*inner.T))
    # Fewer than nine points in the window: the mean of the three nearest.
    few = _make_quadratic_rows(np.zeros((1, 2)), places[:40] + 50.0, KDTree(places[:40] + 50.0), 1.2)
    nearest = np.argsort(np.hypot(*(places[:40] + 50.0).T))[:3]
    assert (few @ np.arange(40.0))[0] == pytest.approx(nearest.mean())


def test_profiles_of_beads_are_exact_for_quadratics() -> None:
    """Two sections of other quadratics; beside a section's points the profile is unknown."""
    rng = np.random.default_rng(3)
    section, across = np.repeat([0, 1], 200), rng.uniform(-5, 5, 400)
    heights = np.where(section == 0, quadratic(across, 0 * across), 2 - quadratic(0 * across, across))
    grid = np.linspace(-6, 6, 25)
    found = (profile_rows(across, section, 2, grid, 1.0) @ heights).reshape(2, 25)
    inner = np.abs(grid) < 4.6
    np.testing.assert_allclose(found[0, inner], quadratic(grid, 0 * grid)[inner])
    np.testing.assert_allclose(found[1, inner], 2 - quadratic(0 * grid, grid)[inner])
    assert np.isnan(found[:, np.abs(grid) > 5.5]).all()
    true = np.concatenate([quadratic(grid, 0 * grid), 2 - quadratic(0 * grid, grid)])
    np.testing.assert_allclose(interpolation_rows(across, section, 2, grid) @ true, heights)
