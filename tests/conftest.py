"""Chooses Mitsuba's variant before any test module imports the renderer, and loads the sensor most tests start from."""

import signal

import pytest

from twin.options import use_variant
from uwlts.model.library import load_sensor
from uwlts.model.sensor import Sensor

use_variant()

# A shell starts what runs in its background with SIGINT ignored, and children inherit that: here Ctrl-C is tested.
signal.signal(signal.SIGINT, signal.default_int_handler)


@pytest.fixture(scope="session")
def thesis() -> Sensor:
    """The thesis's sensor as its drawings say."""
    return load_sensor("thesis")


@pytest.fixture(scope="session")
def thesis_as_built() -> Sensor:
    """The same sensor with distortion, tilted windows and a rolled sheet."""
    return load_sensor("thesis-as-built")
