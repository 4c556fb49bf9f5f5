"""Lattice of samples in a pixel: even along every axis, and in pairs about the centre, so that nothing is shifted."""

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings, strategies as st

from tests.virtual_sensors import altered, clear, plate, scene_of, sensor_at
from twin.light.image_sampling import _evaluate_kernel, make_lattice, pupil_shifts
from twin.light.renderer import Renderer
from twin.rendering_options import NONE

BLURRED = replace(NONE, defocus=True)


@settings(deadline=None, max_examples=60)
@given(count=st.integers(1, 400), axes=st.integers(1, 6))
def test_samples_are_even_along_every_axis_and_their_own_mirror_image(count: int, axes: int):
    points = make_lattice(count, axes)
    assert points.shape == (axes, count)
    # Coordinates are odd multiples of half a strip; rounding leaves some 1e-13 of a strip.
    numbers = np.rint(2 * count * points).astype(int)
    np.testing.assert_allclose(2 * count * points, numbers, atol=1e-9 * count)
    assert (np.sort(numbers, axis=1) == 2 * np.arange(count) + 1).all(), "one in the middle of every strip"
    assert {*zip(*numbers, strict=True)} == {*zip(*(2 * count - numbers), strict=True)}


@pytest.mark.parametrize("count", [3, 16, 17, 64])
def test_samples_have_no_first_moment(count: int):
    """Odd moments of the coordinates in pixel and pupil vanish, single and combined."""
    points = make_lattice(count, 5) - 0.5
    for factors in ([0], [1], [2], [3], [4], [0, 1, 2], [0, 2, 3], [1, 1, 3]):
        assert abs(np.prod(points[factors], axis=0).mean()) < 1e-12, factors


def test_the_pupils_shifts_are_spread_over_a_block_of_pixels():
    rows, columns = np.mgrid[0:8, 0:8].reshape(2, -1)
    shifts = pupil_shifts(rows, columns)
    assert shifts.shape == (2, 64)
    assert (shifts >= 0).all()
    assert (shifts < 1).all()
    np.testing.assert_array_equal(shifts, pupil_shifts(rows + 4, columns + 12))
    block = pupil_shifts(*np.mgrid[0:4, 0:4].reshape(2, -1))
    apart = block[:, :, None] - block[:, None]
    distance = np.hypot(*(apart - np.rint(apart)))[~np.eye(16, dtype=bool)]
    # In a square grid on the torus, 16 points have a spacing of 1/4; two thirds of that is well spread.
    assert distance.min() > 2 / 3 / 4
    mirrored = np.abs(block[:, :, None] + block[:, None] - 1).max(axis=0).min(axis=1)
    assert mirrored.max() < 1e-12


@pytest.mark.parametrize("along", ["width", "height"])
def test_few_samples_leave_a_blurred_stripe_where_it_is(thesis, along: str):
    """Compare the centroid of every profile line with that of many samples; in water, the stand-off is out of focus."""
    camera = {"stripe_along": along, "width_px": 96, "height_px": 96, "f_number": 2.0}
    sensor = altered(thesis, {"camera": camera})
    blurred, sharp = (Renderer(sensor, clear(0.3), scene_of(plate()), effects=effects) for effects in (BLURRED, NONE))
    centre, width = {}, {}
    cases = {"few": (blurred, 16), "odd": (blurred, 17), "many": (blurred, 1024), "sharp": (sharp, 64)}
    for name, (renderer, spp) in cases.items():
        image = renderer.laser_frame(sensor_at(), spp=spp).irradiance().astype(float)
        image = image if along == "width" else image.T
        across = np.arange(96)[:, None]
        centre[name] = (across * image).sum(axis=0) / image.sum(axis=0)
        width[name] = np.sqrt((np.square(across - centre[name]) * image).sum(axis=0) / image.sum(axis=0)).mean()
    assert width["many"] > 2 * width["sharp"], "the stripe is blurred"
    for name in ("few", "odd"):
        assert np.abs(centre[name] - centre["many"]).max() < 0.005, name


def test_the_error_kernel_is_its_fourier_series():
    """1 + the sum over all integers but zero of exp(2 pi i h x) / h^2; the rest of the series is 2 / 10,000 at most."""
    x, order = np.linspace(0, 1, 21), np.arange(1, 10001)[:, None]
    series = 1 + 2 * np.sum(np.cos(2 * np.pi * order * x) / order**2, axis=0)
    np.testing.assert_allclose(_evaluate_kernel(x), series, atol=2e-4)
