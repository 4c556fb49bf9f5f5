"""Chooses Mitsuba's variant before any test module imports the renderer, and loads the sensor most tests start from."""

import signal

import pytest

from twin.options import use_variant
from uwlts.model.library import load_sensor
from uwlts.model.sensor import Sensor

use_variant()

# A shell starts what runs in its background with SIGINT ignored, and children inherit that: here Ctrl-C is tested.
signal.signal(signal.SIGINT, signal.default_int_handler)

# These tests serve cameras and pages at fixed ports of this machine, or look for
# what is served: only one of them can run at a time.
SERVING = {
    "test_serve.py",
    "test_gige_camera.py",
    "test_calibrate_live.py",
    "test_scan_command.py",
    "test_scan_exposure.py",
    "test_scan_faults.py",
    "test_live_view.py",
    "test_cameras.py",
    "test_doctor.py",
}


@pytest.hookimpl(tryfirst=True)  # before pytest-xdist reads the groups
def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Several processes share the tests by file, as fixtures are made once for a file."""
    for item in items:
        item.add_marker(pytest.mark.xdist_group("serving" if item.path.name in SERVING else str(item.path)))


@pytest.fixture(scope="session")
def thesis() -> Sensor:
    """The thesis's sensor as its drawings say."""
    return load_sensor("thesis")


@pytest.fixture(scope="session")
def thesis_as_built() -> Sensor:
    """The same sensor with distortion, tilted windows and a rolled sheet."""
    return load_sensor("thesis-as-built")
