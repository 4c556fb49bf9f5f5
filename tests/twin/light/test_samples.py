"""Samples per pixel: evenly placed, they integrate the stripe as well as a thousand random ones would."""

import math
from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from tests.virtual_sensors import altered, block, clear, cropped, plate, scene_of, sensor_at
from twin.light.image_sampling import PixelSampler, golden_step
from twin.light.renderer import Renderer
from twin.rendering_options import NONE


@pytest.fixture(scope="module")
def renderer(thesis):
    return Renderer(cropped(thesis, 64, 64), clear(0.3), scene_of(plate()), effects=NONE)


@pytest.fixture(scope="module")
def reference(renderer):
    """Irradiance with 16384 samples per pixel."""
    return renderer.laser_frame(sensor_at(), spp=16384).irradiance().astype(float)


@pytest.fixture(scope="module")
def stripe(reference):
    """The stripe's pixels, where brighter than 1 % of its middle."""
    chosen = reference > 0.01 * reference.max()
    assert 300 < chosen.sum() < 600
    return chosen


def worst(renderer: Renderer, reference: np.ndarray, stripe: np.ndarray, spp: int) -> float:
    """Return the largest error of a stripe's pixel, relative to the brightest pixel."""
    image = renderer.laser_frame(sensor_at(), spp=spp).irradiance().astype(float)
    return np.abs(image - reference)[stripe].max() / reference.max()


def test_error_falls_with_the_square_of_the_samples(renderer, reference, stripe):
    # Midpoint rule with n strips in a Gaussian of sigma 1.1 px and height 1: at most |f''| / (24 n^2) = 1 / (29 n^2).
    for spp in (4, 8, 16):
        assert worst(renderer, reference, stripe, spp) < 1 / (24 * spp**2) + 2e-4, spp
    assert worst(renderer, reference, stripe, 4) > 10 * worst(renderer, reference, stripe, 32)
    # One sample, the pixel's middle, leaves out the pixel's own width: the test would notice that.
    assert worst(renderer, reference, stripe, 1) > 0.01


def test_stripe_pixels_are_unbiased_in_the_mean(renderer, reference, stripe):
    for spp in (3, 5, 16):
        image = renderer.laser_frame(sensor_at(), spp=spp).irradiance().astype(float)
        assert image[stripe].sum() == pytest.approx(reference[stripe].sum(), rel=1e-3), spp


@pytest.mark.parametrize("along", ["width", "height"])
def test_sixteen_samples_find_the_stripes_centre(thesis, along):
    # The detector's noise leaves some 0.02 px of a stripe's centre; samples must add far less than that.
    sensor = altered(thesis, {"camera": {"stripe_along": along, "width_px": 64, "height_px": 64}})
    renderer = Renderer(sensor, clear(0.3), scene_of(plate()), effects=NONE)
    images = [renderer.laser_frame(sensor_at(), spp=spp).irradiance().astype(float) for spp in (16, 4096)]
    if along == "height":
        images = [image.T for image in images]
    few, many = (np.arange(64) @ image / image.sum(axis=0) for image in images)
    assert np.abs(few - many).max() < 0.002


def test_equal_arguments_give_equal_images(renderer):
    first, again = (renderer.laser_frame(sensor_at(), spp=4).irradiance() for _ in range(2))
    np.testing.assert_array_equal(first, again)


@pytest.mark.parametrize("count", [1, 2, 3, 7, 16, 64, 100, 4096])
def test_lattice_is_even_along_either_side(count):
    step = golden_step(count)
    assert math.gcd(step, count) == 1
    assert sorted(k * step % count for k in range(count)) == list(range(count))
    if count >= 16:
        # No two samples closer than a third of what an even spread over the square would give.
        k = np.arange(1, count)
        across, along = np.minimum(k, count - k) / count, np.minimum(k * step % count, -k * step % count) / count
        assert np.hypot(across, along).min() > 0.33 / math.sqrt(count)


@pytest.fixture
def rendered(monkeypatch) -> list[int]:
    """Samples of what is rendered; the last number counts on."""
    counts, whole = list[int](), PixelSampler.render

    def counted(self: PixelSampler, *arguments: Any, spp: int, **kwargs: Any) -> np.ndarray:
        counts[-1] += len(arguments[2]) * spp
        return whole(self, *arguments, spp=spp, **kwargs)

    monkeypatch.setattr(PixelSampler, "render", counted)
    return counts


def test_faint_side_lobes_take_fewer_samples(thesis, monkeypatch, rendered):
    changes = {"laser": {"waist_radius_mm": 0.4, "side_lobes": ((0.0, 30.0, 0.1),)}}
    scene = scene_of(plate(), block((40.0, 6.0, 12.0), (0.0, 0.0, -6.0), reflectance=0.5))
    sensor, images = altered(cropped(thesis, 160, 160), changes), []
    monkeypatch.setattr("twin.light.renderer._WIDE_PX", math.inf)
    for faint in (0.01, 0.0):
        monkeypatch.setattr("twin.light.sheet._FAINT_PEAK", faint)
        renderer = Renderer(sensor, clear(0.3), scene, effects=replace(NONE, defocus=True))
        rendered.append(0)
        images.append(renderer.laser_frame(sensor_at(), spp=16).irradiance().astype(float))
    assert 0.2 * rendered[1] < rendered[0] < 0.7 * rendered[1]
    change = np.abs(images[0] - images[1]) / images[1].max()
    # The main stripe is the same. Means over a pixel of the pedestal are off by a part of its second difference, which
    # is 1e-3 at most, as in wide stripes.
    assert (change[images[1] > 0.1 * images[1].max()] == 0).all()
    assert np.quantile(change, 0.999) < 1e-3
    assert images[0].sum() == pytest.approx(images[1].sum(), rel=3e-4)


def test_slight_texture_takes_fewer_samples_in_lamp_images(thesis, monkeypatch, rendered):
    spotted = plate(reflectance=0.5) | {"mottle": 0.15, "mottle_mm": 3.0}
    scene = scene_of(spotted, block((40.0, 6.0, 12.0), (0.0, 0.0, -6.0), reflectance=0.1))
    sensor, images = cropped(thesis, 160, 160), []
    for share in (0.05, 0.0):
        monkeypatch.setattr("twin.light.renderer.EDGE_SHARE", share)
        rendered.append(0)
        images.append(Renderer(sensor, clear(0.3), scene, effects=NONE).irradiance("lamp", sensor_at(), spp=16))
    assert 0.1 * rendered[1] < rendered[0] < 0.5 * rendered[1]
    change = np.abs(images[0] - images[1]) / images[1].max()
    assert (change == 0).sum() > 100, "edges are rendered as finely as before"
    # Corners that differ by 5 % of the maximum at most; four samples average their difference to a fifth or less.
    assert change.max() < 0.01
    assert images[0].sum() == pytest.approx(images[1].sum(), rel=3e-4)


def test_wide_stripes_take_fewer_samples_where_they_are_smooth(thesis, monkeypatch, rendered):
    # 23 px of standard deviation, broken by the edges and the shadow of a block.
    sensor = altered(cropped(thesis, 160, 160), {"laser": {"waist_radius_mm": 8.0}})
    scene = scene_of(plate(), block((40.0, 6.0, 12.0), (0.0, 0.0, -6.0), reflectance=0.5))
    renderer = Renderer(sensor, clear(0.3), scene, effects=replace(NONE, defocus=True))
    rendered.append(0)
    image = renderer.laser_frame(sensor_at(), spp=16).irradiance()
    rendered.append(0)
    monkeypatch.setattr("twin.light.renderer._WIDE_PX", math.inf)
    everywhere = renderer.laser_frame(sensor_at(), spp=16).irradiance()
    assert 0.2 * rendered[1] < rendered[0] < 0.7 * rendered[1]
    change = np.abs(image - everywhere) / everywhere.max()
    # Means over a pixel by four samples are off by a part of the second difference, which is 1e-3 at most.
    assert (change == 0).sum() > 500, "edges are rendered as finely as before"
    assert np.quantile(change, 0.999) < 1e-3
    assert image.sum() == pytest.approx(everywhere.sum(), rel=3e-4)
