"""Descriptions that a test module names in ``DESCRIPTIONS`` as files, and the sensor and board among them."""

from pathlib import Path

import pytest

from twin.scene.description import Scene, load_scene
from uwlts.model.library import load_sensor
from uwlts.model.sensor import Sensor


@pytest.fixture(scope="module")
def folder(request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Folder with the module's descriptions, as NAME.toml."""
    place = tmp_path_factory.mktemp("described")
    for name, text in request.module.DESCRIPTIONS.items():
        (place / f"{name}.toml").write_text(text, encoding="utf-8")
    return place


@pytest.fixture(scope="module")
def sensor(folder: Path) -> Sensor:
    return load_sensor(folder / "sensor.toml")


@pytest.fixture(scope="module")
def board(folder: Path) -> Scene:
    return load_scene(folder / "board.toml")
