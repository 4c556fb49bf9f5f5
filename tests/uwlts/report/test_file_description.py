"""Descriptions of the files in a folder."""

from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from tests.uwlts.storage.test_ros_bags import write_ros2
from uwlts.errors import CaptureError
from uwlts.model.sensor import Sensor
from uwlts.optics.nominal import nominal
from uwlts.report.file_description import calibration_lines, describe


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
    nominal(thesis, medium="water").save(tmp_path / "water.json")
    assert describe(tmp_path / "water.json").startswith("calibration of the sensor")
    assert describe("thesis").startswith("sensor 'thesis'")


@pytest.mark.parametrize(
    ("keys", "kind"),
    [
        ("motion = 1", "scene"),
        ('kind = "chessboard"\ncolumns = 9\nrows = 6', "target"),
        ("limits = 1", "order of a report"),
        ('client = "d"\n[datum]\n', "order of a report"),
        ('title = "t"\nchoices = 1', "design study: t"),
        ('title = "c"\n[variables]\n', "design study: c"),
        ('base = "demo"\ntitle = "b"\nrecordings = []\n', "campaign: b"),
        ('title = "e"\nsensor = "thesis"\nmedium = "air"\n[stage]\n', "plan of a scan: e"),
        ('base = "thesis"\nname = "f"\n', "sensor 'f'"),
    ],
)
def test_descriptions_are_named_by_their_keys(tmp_path: Path, keys: str, kind: str):
    (tmp_path / "a.toml").write_text(keys)
    first = describe(tmp_path / "a.toml").splitlines()[0]
    assert first.startswith(kind) and (kind.startswith("sensor") or first == kind)


@pytest.mark.parametrize(
    ("keys", "kind"),
    [
        ('{"format": "twin-experiment", "campaign": 1, "water": 1}', "result of an experiment"),
        ('{"campaign": 1, "every": 1, "variant": 1}', "plan of recordings"),
        ('{"description": 1, "variant": 1}', "plan of recordings"),
        ('{"format": "uwlts-verification", "calibration": 1, "passed": 1}', "result of a verification"),
        ('{"format": "uwlts-dataset", "title": "t", "licence": 1, "seed": 1}', "card of a data set: t"),
        ('{"format": "uwlts-measured-values", "limits": 1}', "measured values of a report"),
    ],
)
def test_results_without_a_reader_are_named_by_their_format(tmp_path: Path, keys: str, kind: str):
    (tmp_path / "a.json").write_text(keys)
    assert describe(tmp_path / "a.json").splitlines()[0] == kind


def test_a_folder_is_described_by_a_line_for_each_file(thesis: Sensor, tmp_path: Path):
    nominal(thesis, medium="water").save(tmp_path / "water.json")
    (tmp_path / "a").mkdir()
    (tmp_path / "notes.txt").write_text("notes")
    (tmp_path / "damaged.h5").write_text("{")
    a, damaged, notes, water = describe(tmp_path).splitlines()
    assert (a, notes) == ("a: folder", "notes.txt: not a file that `uwlts info` describes")
    assert damaged.startswith("damaged.h5: not a file")
    assert water.startswith("water.json: calibration of the sensor 'thesis'")


@pytest.mark.parametrize(("name", "text"), [("other.json", '{"format": "other"}'), ("notes.doc", "notes")])
def test_other_files_are_refused_with_what_is_read(tmp_path: Path, name: str, text: str):
    (tmp_path / name).write_text(text)
    with pytest.raises(CaptureError, match=r"this reads captures"):
        describe(tmp_path / name)


@pytest.mark.parametrize("seed", range(4))
def test_trajectories_of_each_format_are_described_alike(tmp_path: Path, seed: int):
    rng = np.random.default_rng(seed)
    turns, places, times = Rotation.random(6, random_state=seed), rng.uniform(-2.0, 2.0, (6, 3)), np.arange(6.0)
    euler = np.column_stack([times, places, turns.as_euler("xyz", degrees=bool(seed % 2))])
    unit = "deg" if seed % 2 else "rad"
    np.savetxt(tmp_path / "path.tum", np.column_stack([times, places, turns.as_quat()]), fmt="%.12f")
    names = f"time_s,x_m,y_m,z_m,roll_{unit},pitch_{unit},yaw_{unit}"
    np.savetxt(tmp_path / "path.csv", euler, fmt="%.12f", delimiter=",", header=names, comments="")
    text = describe(tmp_path / "path.tum")
    assert text.startswith("trajectory of 6 poses from 0 s to 5 s") and "axes of the platform in the last pose" in text
    assert describe(tmp_path / "path.csv", pose_format=f"euler-xyz-{unit}") == text


def test_a_bag_of_poses_is_described(tmp_path: Path):
    bag = write_ros2(tmp_path / "bag", {"/odom": "nav_msgs/msg/Odometry"})
    assert describe(bag, pose_format="ros").startswith("trajectory of 6 poses")
    assert "bag" in describe(bag).splitlines()[0], "a list of the files without the format"
