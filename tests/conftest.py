"""Chooses Mitsuba's variant before any test module imports the renderer, and loads the sensor most tests start from."""

import pytest

from twin.variant import use_variant
from uwlts.library import load_sensor
from uwlts.sensor import Sensor

use_variant()


@pytest.fixture(scope="session")
def thesis() -> Sensor:
    """The thesis's sensor as its drawings say."""
    return load_sensor("thesis")


@pytest.fixture(scope="session")
def thesis_as_built() -> Sensor:
    """The same sensor with distortion, tilted windows and a rolled sheet."""
    return load_sensor("thesis-as-built")
