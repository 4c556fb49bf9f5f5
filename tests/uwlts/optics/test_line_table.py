"""Tables of smooth functions: their values equal those of the function; other functions get no table."""

import numpy as np
import pytest

from uwlts.model.library import load_sensor
from uwlts.optics.line_table import LineTable
from uwlts.optics.nominal import nominal_calibration
from uwlts.optics.triangulation import reconstruct_pixels, reconstruct_profile


def waves(line, place):
    """Two values that vary a few times over the image."""
    return np.stack([np.sin(line / 200 + place / 150), np.exp(-place / 300) * np.cos(line / 400)], axis=1)


@pytest.mark.parametrize(
    ("lines", "places"), [((0, 1279), (0.0, 1023.0)), ((100, 100), (50.0, 50.0)), ((3, 4), (7, 90))]
)
def test_values_are_those_of_the_function(lines, places):
    table = LineTable.from_function(waves, lines, places, tolerance=1e-10)
    assert table is not None
    rng = np.random.default_rng(1)
    line, place = rng.integers(lines[0], lines[1] + 1, 500), rng.uniform(*places, 500)
    np.testing.assert_allclose(table.values(line, place), waves(line, place), rtol=0, atol=1e-9)


@pytest.mark.parametrize("count", [50, 5000])
def test_combined_values_are_sums_whether_lines_or_places_are_more(count):
    table = LineTable.from_function(waves, (0, 1279), (0.0, 1023.0), tolerance=1e-10)
    weights = np.array([[1.0, 0.0, 2.0], [0.0, 1.0, -3.0]])
    assert table is not None
    rng = np.random.default_rng(5)
    line, place = rng.integers(0, 1280, count), rng.uniform(0, 1023, count)
    sums = waves(line, place) @ weights
    # The largest of the weights times the table's error.
    np.testing.assert_allclose(table.combine(weights).values(line, place), sums, rtol=0, atol=5e-9)


def test_terms_are_left_out_up_to_an_error():
    table = LineTable.from_function(waves, (0, 1279), (0.0, 1023.0), tolerance=1e-10)
    assert table is not None
    short = table.shorten(1e-4)
    assert short.terms.shape[0] < table.terms.shape[0] and short.terms.shape[1] < table.terms.shape[1]
    rng = np.random.default_rng(6)
    line, place = rng.integers(0, 1280, 500), rng.uniform(0, 1023, 500)
    off = np.abs(short.values(line, place) - waves(line, place)).max(axis=0)
    # Once for terms of lines, once for those of places; and some of it, else nothing was left out.
    assert 1e-6 < off.max() <= 2e-4


def test_a_table_is_kept_for_the_next_places_of_the_same_function():
    """A table is reused for places within the same multiples of 64, in any order; other functions have their own."""
    calls = []

    def counted(line, place):
        calls.append(len(line))
        return waves(line, place)

    def table(seed, key, *, places=(70.0, 500.0)):
        rng = np.random.default_rng(seed)
        line, place = rng.integers(5, 1200, 6000), rng.uniform(*places, 6000)
        found = LineTable.over_range(counted, line, place, tolerance=1e-10, key=key)
        assert found is not None
        np.testing.assert_allclose(found.values(line, place), waves(line, place), rtol=0, atol=1e-9)
        return found

    first = table(1, "waves")
    count = len(calls)
    assert table(2, "waves") is first and len(calls) == count
    assert table(1, "other waves") is not first and table(1, None) is not first
    wider = table(3, "waves", places=(70.0, 600.0))
    assert wider is not first and table(4, "waves") is first
    # The oldest are forgotten.
    for number in range(20):
        table(5, number)
    assert table(1, "waves") is not first


def test_a_table_that_would_reach_too_far_covers_only_the_given_places():
    def up_to_500(line, place):
        return np.where(place[:, None] <= 500.0, waves(line, place), np.nan)

    rng = np.random.default_rng(8)
    line, place = rng.integers(0, 1280, 6000), rng.uniform(70.0, 500.0, 6000)
    for _ in range(2):
        table = LineTable.over_range(up_to_500, line, place, tolerance=1e-10, key="up to 500")
        assert table is not None and table.high_px <= 500.0
        np.testing.assert_allclose(table.values(line, place), waves(line, place), rtol=0, atol=1e-9)


def test_the_error_is_a_share_of_each_value_where_that_is_more():
    def large(line, place):
        return waves(line, place) * [1e8, 1.0]

    table = LineTable.from_function(large, (0, 1279), (0.0, 1023.0), tolerance=1e-9, share=1e-9)
    assert table is not None
    assert LineTable.from_function(large, (0, 1279), (0.0, 1023.0), tolerance=1e-14) is None
    rng = np.random.default_rng(7)
    line, place = rng.integers(0, 1280, 500), rng.uniform(0, 1023, 500)
    assert (np.abs(table.values(line, place) - large(line, place)).max(axis=0) <= [1.0, 1e-8]).all()


def test_a_function_that_is_not_smooth_or_partly_undefined_has_no_table():
    def kinked(line, place):
        return np.abs(place - 400.3)[:, None]

    def partly(line, place):
        return np.where(line < 300, np.nan, place)[:, None]

    for function in (kinked, partly):
        assert LineTable.from_function(function, (0, 1279), (0.0, 1023.0), tolerance=1e-7) is None


@pytest.mark.parametrize("along", ["width", "height"])
@pytest.mark.parametrize("name", ["thesis-as-built", "thesis"])
def test_points_of_many_stripes_are_those_of_each(name, along):
    sensor = load_sensor(name)
    sensor = sensor.model_copy(update={"camera": sensor.camera.model_copy(update={"stripe_along": along})})
    calibration, index = nominal_calibration(sensor, sensor.media["water"]), 1.33
    rng = np.random.default_rng(2)
    lines, across = (1280, 1024) if along == "width" else (1024, 1280)
    line, place = rng.integers(0, lines, 12_000), rng.uniform(100.0, across - 100.0, 12_000)
    motion = {"stage_mm": rng.uniform(-30, 30, 12_000), "stage_direction": np.array([1.0, 0.0, 0.0])}
    found = reconstruct_profile(calibration, line, place, medium_index=index, **motion)
    pixels = np.stack([line, place] if along == "width" else [place, line], axis=1)
    each = reconstruct_pixels(calibration, pixels, medium_index=index, **motion)
    np.testing.assert_array_equal(found.status, each.status)
    np.testing.assert_allclose(found.points_mm, each.points_mm, rtol=0, atol=1e-7)
    assert np.isfinite(found.points_mm).mean() > 0.9
