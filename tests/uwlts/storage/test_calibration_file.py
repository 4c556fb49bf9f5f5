"""The calibration file: readable JSON with exact numbers; other contents are refused."""

import json
import math
from pathlib import Path

import numpy as np
import pytest

import uwlts
from uwlts.errors import CaptureError, OutputError
from uwlts.model.calibration import Calibration
from uwlts.model.library import load_sensor
from uwlts.optics.nominal import nominal_calibration
from uwlts.storage.calibration_file import load_calibration


@pytest.fixture(scope="module")
def calibration() -> Calibration:
    sensor = load_sensor("thesis-as-built")
    found = nominal_calibration(sensor, sensor.media["water"])
    return found.model_copy(update={"residuals": {"camera": {"rms_px": 0.1 + 0.2}}, "provenance": {"by": "Jürgen"}})


@pytest.fixture
def path(tmp_path: Path, calibration: Calibration) -> Path:
    calibration.save(tmp_path / "calibration.json")
    return tmp_path / "calibration.json"


def refused(path: Path, *words: str) -> None:
    with pytest.raises(CaptureError) as caught:
        load_calibration(path)
    assert all(word in str(caught.value) for word in (str(path), *words)), str(caught.value)


def edited(path: Path, **changes) -> Path:
    """The file with values replaced and without seal; keys are written as camera__fx_px."""
    content = json.loads(path.read_text(encoding="utf-8"))
    content.pop("sha256", None)
    for key, value in changes.items():
        *tables, name = key.split("__")
        table = content
        for step in tables:
            table = table[step]
        table[name] = value
    path.write_text(json.dumps(content), encoding="utf-8")
    return path


def test_everything_comes_back_exactly(path: Path, calibration: Calibration):
    assert load_calibration(path) == calibration
    content = json.loads(path.read_text(encoding="utf-8"))
    assert (content["format"], content["version"]) == ("uwlts-calibration", 1)
    assert content["residuals"]["camera"]["rms_px"] == 0.1 + 0.2
    assert len(path.read_text(encoding="utf-8").splitlines()) > 30, "for people to read"


def test_calibration_for_air_only(tmp_path: Path, calibration: Calibration):
    dry = calibration.model_copy(update={"window": None})
    dry.save(tmp_path / "dry.json")
    assert load_calibration(tmp_path / "dry.json") == dry


def test_existing_file_is_only_replaced_on_demand(path: Path, calibration: Calibration):
    before = path.read_bytes()
    other = calibration.model_copy(update={"sensor_name": "other"})
    with pytest.raises(OutputError, match="exists already"):
        other.save(path)
    assert path.read_bytes() == before
    other.save(path, overwrite=True)
    assert load_calibration(path).sensor_name == "other"
    assert list(path.parent.iterdir()) == [path]


def test_folder_must_exist(tmp_path: Path, calibration: Calibration):
    with pytest.raises(OutputError, match="missing does not exist"):
        calibration.save(tmp_path / "missing" / "a.json")


@pytest.mark.parametrize(
    ("content", "words"),
    [
        (b"", "is not a calibration, or is truncated"),
        (b"not json", "is not a calibration"),
        (b"\xff\xfe", "is not a calibration"),
        (b"[" * 100000, "is not a calibration"),
        (b"[1, 2]", "JSON but not a calibration"),
        (b"{}", "JSON but not a calibration"),
        (b'{"format": "uwlts-evaluation", "version": 1}', "JSON but not a calibration"),
        (b'{"format": "uwlts-calibration", "version": 2}', "version 2; this program reads 1"),
        (b'{"format": "uwlts-calibration"}', "version None"),
        (b'{"format": "uwlts-calibration", "version": 1}', "sensor_name: Field required"),
    ],
)
def test_foreign_files(tmp_path: Path, content: bytes, words: str):
    path = tmp_path / "a.json"
    path.write_bytes(content)
    refused(path, words)


def test_missing_file(tmp_path: Path):
    refused(tmp_path / "none.json", "no calibration at")
    refused(tmp_path, "directory")


@pytest.mark.parametrize("share", [0.0, 0.02, 0.5, 0.99])
def test_truncated_file(path: Path, share: float):
    content = path.read_bytes()
    path.write_bytes(content[: int(share * len(content))])
    refused(path, "truncated")


TURN = np.array([[0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]])


def rigid(rotation: np.ndarray, last=(0.0, 0.0, 0.0, 1.0)) -> list[list[float]]:
    matrix = np.eye(4)
    matrix[:3, :3], matrix[3] = rotation, last
    return matrix.tolist()


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        ({"camera__fx_px": math.nan}, "camera.fx_px"),
        ({"camera__fx_px": math.inf}, "camera.fx_px"),
        ({"camera__fx_px": -2000.0}, "camera.fx_px"),
        ({"camera__cx_px": math.nan}, "camera.cx_px"),
        ({"camera__width_px": 0}, "camera.width_px"),
        ({"camera__width_px": 1280.5}, "camera.width_px"),
        ({"camera__distortion": {"k1": math.nan}}, "camera.distortion.k1"),
        ({"camera__distortion": {"k9": 0.0}}, "camera.distortion.k9"),
        ({"window__distance_mm": 0.0}, "window.distance_mm"),
        ({"window__refractions": 3}, "window.refractions"),
        ({"window__normal": [0.0, 0.0, 2.0]}, "window.normal: Value error, (0.0, 0.0, 2.0) is not a unit vector"),
        ({"window__normal": [0.0, 0.0]}, "window.normal"),
        ({"sheet__normal": [0.0, 0.0, 0.0]}, "sheet.normal: Value error, (0.0, 0.0, 0.0) is not a unit vector"),
        ({"sheet__normal": [0.6, 0.6, 0.6]}, "sheet.normal: Value error, (0.6, 0.6, 0.6) is not a unit vector"),
        ({"sheet__offset_mm": math.nan}, "sheet.offset_mm"),
        ({"stripe_along": "diagonal"}, "stripe_along"),
        ({"residuals": {"camera": {"rms_px": math.nan}}}, "finite number"),
        ({"residuals": {"camera": "good"}}, "residuals.camera"),
        ({"residuals": {"camera": {"rms_px": "good"}}}, "rms_px is 'good'; expected a number"),
        ({"colour": "red"}, "colour"),
        ({"camera_from_object": rigid(1.001 * TURN)}, "rigid"),
        ({"camera_from_object": rigid(TURN + 1e-5)}, "rigid"),
        ({"camera_from_object": rigid(np.diag([1.0, 1.0, -1.0]))}, "rigid"),
        ({"camera_from_object": rigid(np.zeros((3, 3)))}, "rigid"),
        ({"camera_from_object": rigid(TURN, (0.0, 0.0, 0.1, 1.0))}, "rigid"),
        ({"camera_from_object": rigid(TURN, (0.0, 0.0, 0.0, 2.0))}, "rigid"),
        ({"camera_from_object": rigid(TURN)[:3]}, "rigid"),
        ({"camera_from_object": []}, "rigid"),
        ({"camera_from_object": [[1.0, 0.0]]}, "camera_from_object"),
        ({"camera_from_object": rigid(math.nan * TURN)}, "camera_from_object"),
    ],
)
def test_values_that_describe_no_sensor(path: Path, changes: dict, words: str):
    refused(edited(path, **changes), "is not a valid calibration", words)


def test_rotation_rounded_to_seven_digits_is_accepted(path: Path, calibration: Calibration):
    rounded = np.round(calibration.object_transform(), 7).tolist()
    assert load_calibration(edited(path, camera_from_object=rounded)).camera_from_object == tuple(map(tuple, rounded))


def test_missing_keys_are_named(path: Path):
    content = json.loads(path.read_text(encoding="utf-8"))
    del content["camera"]["fx_px"], content["sheet"], content["sha256"]
    path.write_text(json.dumps(content), encoding="utf-8")
    refused(path, "camera.fx_px: Field required", "sheet: Field required")


def test_uncertainties_of_a_sequential_calibration_have_names():
    residuals = {
        "camera": {"std": {"f": 1.5, "cx": 0.25, "k1": 0.001}},
        "sheet": {"normal_std_deg": 0.02},
        "window": {"std_mm": 0.125},
    }
    known = uwlts.nominal("thesis", medium="water").model_copy(update={"residuals": residuals}).std()
    assert (known.fx_px, known.fy_px, known.cx_px, known.cy_px) == (1.5, 1.5, 0.25, None)
    assert known.distortion == {"k1": 0.001}
    assert (known.sheet_normal_deg, known.window_distance_mm) == (0.02, 0.125)
    assert uwlts.nominal("thesis", medium="water").std().fx_px is None
