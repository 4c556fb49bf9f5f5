"""Every effect can be left out on its own, and each changes what it should."""

from dataclasses import fields, replace

import numpy as np
import pytest

from tests.virtual_sensors import altered, plate, scene_of, sensor_at
from twin.light.renderer import Renderer
from twin.recording.sensor_simulator import SensorSimulator
from twin.rendering_options import ALL, NONE, Effects, Options
from uwlts.errors import DescriptionError
from uwlts.model.sensor import Sensor

NAMES = [field.name for field in fields(Effects)]


def test_names_are_those_of_the_command_line():
    assert ALL.names() == [name.replace("_", "-") for name in NAMES]
    assert NONE.names() == []
    assert ALL.remove("speckle", "multiple-scattering") == replace(ALL, speckle=False, multiple_scattering=False)
    with pytest.raises(DescriptionError, match="unknown effect 'speckles'; known are defocus, haze"):
        ALL.remove("speckles")


@pytest.fixture(scope="module")
def sensor(thesis: Sensor) -> Sensor:
    """A small sensor in turbid water in daylight, with a detector of uneven pixels."""
    changes = {
        "camera": {"width_px": 160, "height_px": 128, "pixel_size_um": 42.4},
        "exposure": {"laser_ms": 20.0},
        "detector": {"bits": 12, "full_well_e": 200000.0},
        "lamp": {"ambient_w_per_m2": 0.05},
        "media": {"water": {"water": "coastal"}},
    }
    return altered(thesis, changes)


def groove(**motion: float):
    """A gloss and a matte plate at right angles, so that light goes between them."""
    sides = (
        plate(20.0, side=80.0, y=sign * 28.0) | {"rotation_deg": (-sign * 45.0, 25.0, 0.0), "finish": finish}
        for sign, finish in ((1, "painted"), (-1, "diffuse"))
    )
    return scene_of(*sides, motion={"count": 1, "speed_mm_per_s": 40.0} | motion)


def image(sensor: Sensor, effects: Effects) -> np.ndarray:
    studio = SensorSimulator(sensor, groove(), Options(spp=16, seed=3, effects=effects))
    return studio.frame(next(iter(studio.scene.motion.shots())), 0).image.astype(float)


@pytest.mark.slow
@pytest.mark.parametrize("name", NAMES)
def test_each_effect_alone_changes_the_image(sensor, name):
    plain, changed = image(sensor, NONE), image(sensor, replace(NONE, **{name: True}))
    assert np.abs(changed - plain).max() >= 1, name
    np.testing.assert_array_equal(plain, image(sensor, NONE))


@pytest.mark.parametrize("name", NAMES)
def test_each_effect_can_be_left_out(sensor, name):
    assert (image(sensor, ALL) != image(sensor, replace(ALL, **{name: False}))).any(), name


def test_walks_depend_on_the_seed_only(sensor):
    renderer = Renderer(sensor, sensor.media["water"], groove(), effects=ALL)
    one, again, other = (renderer.laser_frame(sensor_at(), spp=8, seed=seed).irradiance() for seed in (1, 1, 2))
    np.testing.assert_array_equal(one, again)
    assert (one != other).mean() > 0.3


def test_multiply_scattered_light_has_no_fireflies(sensor):
    renderer = Renderer(sensor, sensor.media["water"], groove(), effects=ALL)
    frames = [renderer.laser_frame(sensor_at(), spp=16, seed=seed) for seed in range(10)]
    scattered = np.stack([frame.scattered for frame in frames])
    stripe = np.quantile(frames[0].stripe, 0.99)
    # A walk returns at most the radiance of the stripe, times about 30 if its directions had a low probability (limits
    # of 0.3 for each choice). In the mean of 35 walks of a cell, a single walk is never brighter than the stripe.
    assert scattered.max() < stripe
    spread = scattered.std(axis=0).mean() / scattered.mean()
    assert 0 < spread < 1.5
