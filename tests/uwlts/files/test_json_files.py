"""The seal of result files: edited numbers are noticed and recorded."""

import json
import logging
from collections.abc import Iterator
from contextlib import suppress
from pathlib import Path
from typing import Any

import pytest

import uwlts
from tests.fuzz.readers import READERS
from tests.uwlts.reconstruction.test_reconstruct import CALIBRATION, write
from uwlts.cli import app
from uwlts.errors import CaptureError, OutputError
from uwlts.evaluation.evaluate import FORMAT, VERSION, read_evaluation
from uwlts.files.json_files import compute_seal, read_json, write_model, write_record


def _written(kind: str, folder: Path) -> Path:
    """A file of a calibration, mount or evaluation as the program writes it."""
    made, path = folder / f"made-{kind}.json", folder / f"{kind}.json"
    READERS[kind].make(made)
    if kind == "evaluation":
        write_model(path, read_evaluation(made), file_format=FORMAT, version=VERSION, overwrite=False)
    else:
        uwlts.read(made).save(path)
    return path


def _numbers(content: Any) -> Iterator[tuple[dict | list, Any]]:
    """Places of the numbers in a JSON value."""
    for key, value in content.items() if isinstance(content, dict) else enumerate(content):
        if isinstance(value, dict | list):
            yield from _numbers(value)
        elif isinstance(value, int | float) and not isinstance(value, bool):
            yield content, key


@pytest.mark.parametrize("kind", ["calibration", "joint", "polynomials", "mount", "evaluation"])
def test_every_number_that_is_changed_by_five_percent_is_noticed(kind, tmp_path, caplog):
    path = _written(kind, tmp_path)
    caplog.clear()
    uwlts.read(path)
    assert not caplog.text
    content = json.loads(path.read_text())
    places = [place for place in _numbers(content) if place[0][place[1]]]
    assert len(places) > 5
    for place, key in places[:: 1 + len(places) // 40]:
        before = place[key]
        place[key] = 1.05 * before
        path.write_text(json.dumps(content))
        with caplog.at_level(logging.WARNING, "uwlts"), suppress(CaptureError):
            uwlts.read(path)
        assert "was edited after it was written" in caplog.text, key
        caplog.clear()
        place[key] = before
    path.write_text(json.dumps(content))
    uwlts.read(path)
    assert not caplog.text


def test_edits_are_recorded_in_what_is_saved_from_them(tmp_path, caplog):
    for kind in ("calibration", "mount", "evaluation"):
        path = _written(kind, tmp_path)
        content = json.loads(path.read_text())
        place, key = next(place for place in _numbers(content) if place[1] not in ("version",))
        place[key] *= 1 + 1e-9
        path.write_text(json.dumps(content))
        with caplog.at_level(logging.WARNING, "uwlts"):
            found = uwlts.read(path)
        assert "was edited after it was written" in caplog.text
        assert found.edited if kind != "calibration" else found.provenance["edited"]
        if kind != "evaluation":
            found.save(path, overwrite=True)
            assert uwlts.read(path) == found


def test_an_evaluation_records_that_the_calibration_of_its_cloud_has_no_seal(tmp_path, caplog):
    CALIBRATION.save(path := tmp_path / "calibration.json")
    capture = write(tmp_path / "plane.h5")
    for edited in (False, True):
        with caplog.at_level(logging.WARNING, "uwlts"):
            cloud = uwlts.reconstruct(capture, path)
        evaluation = uwlts.evaluate(cloud, {"kind": "plane"})
        evaluation.save(tmp_path / "evaluation.json", overwrite=True)
        assert uwlts.read(tmp_path / "evaluation.json").edited == edited
        assert caplog.text.count("has no seal") == edited
        content = json.loads(path.read_text())
        content.pop("sha256", None)
        path.write_text(json.dumps(content))


def test_a_file_without_seal_is_treated_as_an_edited_one(tmp_path, caplog):
    path = _written("calibration", tmp_path)
    expected = uwlts.read(path)
    content = json.loads(path.read_text())
    del content["sha256"]
    path.write_text(json.dumps(content))
    with caplog.at_level(logging.WARNING, "uwlts"):
        found = uwlts.read(path)
    assert found.provenance == expected.provenance | {"edited": True}
    assert "has no seal" in caplog.text


def test_records_are_sealed_too(tmp_path, caplog):
    path = tmp_path / "found.json"
    write_record(path, {"depth_mm": 1.25, "by_number": {10: 1, 9: 2}, "name": "hull ☃"}, overwrite=False)
    content = read_json(path, called="record")
    assert content["sha256"] == compute_seal(content) and content["depth_mm"] == 1.25
    path.write_text(path.read_text().replace("1.25", "1.35"))
    with caplog.at_level(logging.WARNING, "uwlts"):
        read_json(path, called="record")
    assert "was edited after it was written" in caplog.text


def test_the_command_warns_of_an_edited_calibration(tmp_path, caplog, capsys):
    path = _written("calibration", tmp_path)
    path.write_text(path.read_text().replace('"width_px": 1', '"width_px": 2', 1))
    app(["info", str(path)], result_action="return_value")
    assert "edited" in caplog.text and "calibration of the sensor" in capsys.readouterr().out


def test_numbers_that_are_not_finite_are_named(tmp_path):
    with pytest.raises(OutputError, match=r"a result cannot be written: a\.b\.1 is nan; expected a finite"):
        write_record(tmp_path / "a.json", {"a": {"b": [1.0, float("nan")]}}, overwrite=False)
    assert not [*tmp_path.iterdir()]
