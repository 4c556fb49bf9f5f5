"""Descriptions of the files in a folder."""

from pathlib import Path

import pytest
import trimesh

from uwlts.errors import CaptureError
from uwlts.model.sensor import Sensor
from uwlts.optics.nominal import nominal
from uwlts.report.inventory import calibration_lines, describe


@pytest.mark.parametrize(
    ("kind", "said"),
    [
        ("air", "for use in air only"),
        ("fresh", "for use in fresh water only, as seen from a single viewpoint"),
        ("sea", "for use in sea water only, as seen from a single viewpoint"),
        ("custom", "for use in the medium of its images only, as seen from a single viewpoint"),
    ],
)
def test_a_calibration_without_a_window_is_for_the_medium_of_its_images(thesis: Sensor, kind: str, said: str):
    known = nominal(thesis, medium="water").model_copy(update={"window": None, "medium_kind": kind})
    assert f"window: none; {said}" in calibration_lines(known)


def test_all_that_is_read_is_described(thesis: Sensor, tmp_path: Path):
    trimesh.creation.box().export(tmp_path / "box.stl")
    nominal(thesis, medium="water").save(tmp_path / "water.json")
    # A mesh of another program states no uncertainty.
    assert describe(tmp_path / "box.stl") == "mesh                      8 vertices, 12 triangles, 6 mm2"
    assert describe(tmp_path / "water.json").startswith("calibration of the sensor")
    assert describe("thesis").startswith("sensor 'thesis'")


@pytest.mark.parametrize(("name", "text"), [("other.json", '{"format": "other"}'), ("notes.doc", "notes")])
def test_other_files_are_refused_with_what_is_read(tmp_path: Path, name: str, text: str):
    (tmp_path / name).write_text(text)
    with pytest.raises(CaptureError, match=r"this reads captures"):
        describe(tmp_path / name)
