"""Grains and bubbles in the sheet: their scattered light, image positions and sizes."""

import math
from dataclasses import replace

import numpy as np
import pytest

from tests.virtual_sensors import altered, clear, plate, scene_of, sensor_at
from twin.light.particles import Spots, bubble, diffuse_sphere
from twin.light.renderer import Renderer
from twin.rendering_options import NONE
from uwlts.model.placement import camera_from_object
from uwlts.model.sensor import Sensor

FAR_AWAY = plate(5000.0)
SHARES = {"particles": diffuse_sphere, "bubbles": bubble}


@pytest.fixture(scope="module")
def small(thesis: Sensor) -> Sensor:
    return altered(thesis, {"camera": {"width_px": 160, "height_px": 128, "pixel_size_um": 42.4}})


def test_a_diffuse_sphere_and_a_mirror_send_all_that_they_reflect():
    cosine, weight = np.polynomial.legendre.leggauss(400)
    # The power that a sphere of radius 1 meets in an irradiance of 1 is pi; the grain reflects 30 % of it.
    assert 2 * math.pi * weight @ diffuse_sphere(cosine) == pytest.approx(0.3 * math.pi, rel=1e-6)
    # Total reflection up to twice the angle that the critical one of asin(1 / 1.33) leaves to 90 deg.
    critical = math.pi - 2 * math.asin(1 / 1.33)
    np.testing.assert_allclose(bubble(np.cos(critical * np.linspace(0.01, 0.999, 9))), 0.25)
    # Straight back it is Fresnel's ((n - 1) / (n + 1))^2.
    assert bubble(np.array([-1.0]))[0] == pytest.approx((0.33 / 2.33) ** 2 / 4)
    assert (2 * math.pi * weight @ bubble(cosine)) < math.pi


@pytest.mark.parametrize("body", ["particles", "bubbles"])
def test_many_bodies_scatter_as_a_haze_of_the_same_cross_section(small, body):
    medium = clear(0.3, 1.0, phase="henyey-greenstein", asymmetry=0.0)
    hazy = Renderer(small, medium, scene_of(FAR_AWAY), effects=replace(NONE, haze=True))
    haze = hazy.laser_frame(sensor_at(), spp=1).haze
    count = 20_000.0
    drifting = Renderer(small, medium, scene_of(FAR_AWAY), effects=NONE, drifting={body: count})
    frames = [drifting.laser_frame(sensor_at(), spp=1, seed=seed).particles for seed in range(40)]
    middle = np.s_[44:84, 60:100]
    # N(> d) as d^-3 between 0.1 and 5 mm: the mean of d^2 is 3 d0^2 (1 - d0 / d1) / (1 - (d0 / d1)^3).
    mean_square_radius = 3 * 0.05**2 * (1 - 0.02) / (1 - 0.02**3)
    # In the middle the camera looks along its axis at light that runs along Z; in 20 deg of field it changes little.
    cosine = -camera_from_object(small)[2, 2]
    per_sr = 1e-6 * count * mean_square_radius * SHARES[body](np.array([cosine]))[0]
    # Isotropic haze of 1 per m scatters 1e-3 / 4 pi per mm and sr. Spots cross the border of the centre inwards and
    # outwards.
    expected = haze[middle].mean() * per_sr / (1e-3 / (4 * math.pi))
    values = np.array([frame[middle].mean() for frame in frames])
    assert np.count_nonzero(values) > 20
    # The frames are independent: 4.5 standard deviations of their mean are exceeded once in 150,000 runs; the angle of
    # scattering changes over the middle by some 5 deg, which changes both shares by less than 10 %.
    assert abs(values.mean() - expected) < 4.5 * values.std(ddof=1) / math.sqrt(len(values)) + 0.1 * expected


def test_nothing_is_seen_behind_a_plate_or_without_light(small):
    medium = clear()
    dark = Renderer(small, medium, scene_of(FAR_AWAY), effects=NONE, drifting={"particles": 0.0})
    assert not dark.laser_frame(sensor_at(), spp=1).particles.any()
    near = scene_of(plate(-60.0, side=600.0))
    free, hidden = (
        Renderer(small, medium, scene, effects=NONE, drifting={"particles": 20_000.0})
        .laser_frame(sensor_at(), spp=1)
        .particles
        for scene in (scene_of(FAR_AWAY), near)
    )
    lit = free.sum(axis=1) > 0
    assert lit.mean() > 0.8
    # A plate 60 mm before the stand-off ends the sheet within the image.
    assert 0 < np.count_nonzero(hidden.sum(axis=1) > 0) < 0.8 * np.count_nonzero(lit)


def test_equal_seeds_give_equal_bodies_and_a_flat_disc_keeps_its_light(small):
    renderer = Renderer(small, clear(), scene_of(FAR_AWAY), effects=NONE, drifting={"particles": 5000.0})
    first, again, other = (renderer.laser_frame(sensor_at(), spp=1, seed=seed).particles for seed in (1, 1, 2))
    np.testing.assert_array_equal(first, again)
    assert not np.array_equal(first, other)
    for radius in (0.0, 0.7, 4.0, 11.3):
        one = Spots(*(np.array([each]) for each in (40.3, 30.8, 2.0, radius)))
        image = one.draw(64, 80)
        assert image.sum() == pytest.approx(2.0, rel=0.01)
        y, x = np.nonzero(image)
        assert np.hypot(y - 30.8, x - 40.3).max() <= radius + 0.5
    cut = Spots(*(np.array([each]) for each in (40.0, 0.0, 2.0, 9.0))).draw(64, 80)
    # Half of it and the row through its middle.
    assert cut.sum() == pytest.approx(1.0 + 18 / (math.pi * 81), rel=0.03)
