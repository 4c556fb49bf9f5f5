"""The page on sensor descriptions: its example is complete and works, and its figure shows the keys of the geometry."""

import re
import warnings
from pathlib import Path

import pytest

from tests.documented import ROOT, blocks
from uwlts.errors import DescriptionError
from uwlts.model.library import load_sensor
from uwlts.model.placement import check_design
from uwlts.model.sensor import Camera, Laser, Volume, Window

PAGE = ROOT / "docs" / "how-to" / "describe-your-sensor.md"
FIGURE = ROOT / "docs" / "pictures" / "sensor-keys.svg"


@pytest.fixture
def reef(tmp_path: Path) -> Path:
    whole, variant = (block.text for block in blocks(PAGE) if block.kind == "toml")
    (tmp_path / "reef.toml").write_text(whole, encoding="utf-8")
    (tmp_path / "reef-close.toml").write_text(variant, encoding="utf-8")
    return tmp_path / "reef.toml"


def test_the_example_and_its_variant_work_in_all_media_without_a_warning(reef):
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        sensors = [load_sensor(path) for path in (reef, reef.with_name("reef-close.toml"))]
    for sensor in sensors:
        assert set(sensor.media) == {"air", "water"}
        for medium in sensor.media.values():
            assert sensor.volume.near_mm < check_design(sensor, medium).standoff_mm < sensor.volume.far_mm


def test_the_example_has_no_key_to_spare(reef):
    # Each line with one key of the camera or the laser is required: without it, the description is refused.
    lines = reef.read_text(encoding="utf-8").splitlines()
    required = [
        k
        for k, line in enumerate(lines)
        if re.match(r"\w+ = ", line) and not line.startswith(("notes", "uncertainty", "air"))
    ]
    assert len(required) > 15
    for k in required:
        if lines[k].startswith("water"):
            continue
        reef.write_text("\n".join([*lines[:k], *lines[k + 1 :]]), encoding="utf-8")
        with pytest.raises(DescriptionError):
            load_sensor(reef)


def test_the_figure_shows_the_required_keys():
    shown = " ".join(re.findall(r"<!-- (.*?) -->", FIGURE.read_text(encoding="utf-8"), re.DOTALL))
    placed = {"baseline_mm", "triangulation_angle_deg"}
    keys = {
        key for kind in (Camera, Laser, Volume, Window) for key, one in kind.model_fields.items() if one.is_required()
    }
    assert len(keys | placed) > 15
    assert {key for key in keys | placed if key not in shown} - {"window"} == set()
