"""Reading of any file of the program with one function, and saving of results."""

from pathlib import Path

import h5py
import numpy as np
import pytest

import uwlts
from uwlts.errors import CaptureError, OutputError
from uwlts.evaluation.evaluate import Evaluation
from uwlts.model.trajectory import Trajectory
from uwlts.optics.nominal import nominal_calibration
from uwlts.report.file_description import describe
from uwlts.storage.cloud import PointCloud


def cloud_of(count: int) -> PointCloud:
    rng = np.random.default_rng(1)
    return PointCloud(rng.normal(size=(count, 3)), np.ones(count), np.zeros(count), np.arange(count))


def test_results_are_saved_and_read_back(tmp_path: Path):
    cloud, calibration = cloud_of(7), uwlts.nominal("thesis", medium="water")
    path = Trajectory(np.arange(3.0), np.tile(np.eye(4), (3, 1, 1)))
    for result, name in ((cloud, "a.ply"), (cloud, "a.h5"), (calibration, "a.json"), (path, "a.csv")):
        result.save(tmp_path / name)
        found = uwlts.read(tmp_path / name)
        assert type(found) is type(result)
        with pytest.raises(OutputError, match="`overwrite`"):
            result.save(tmp_path / name)
        result.save(tmp_path / name, overwrite=True)
    np.testing.assert_array_equal(uwlts.read(tmp_path / "a.ply").points_mm, cloud.points_mm)
    assert uwlts.read(tmp_path / "a.json") == calibration
    np.testing.assert_array_equal(uwlts.read(tmp_path / "a.csv").times_s, path.times_s)


def test_a_saved_evaluation_is_read_as_an_evaluation(tmp_path: Path):
    points = np.random.default_rng(2).uniform(-20, 20, (500, 3)) * [1, 1, 0]
    cloud = PointCloud(points, np.ones(500), np.zeros(500), np.arange(500), metadata={"artefact": {"kind": "plane"}})
    evaluation = uwlts.evaluate(cloud)
    evaluation.save(tmp_path / "a.json")
    found = uwlts.read(tmp_path / "a.json")
    assert isinstance(found, Evaluation) and found == evaluation and found.figures == evaluation.figures
    assert found.std == evaluation.std and found.cloud is None


def test_an_unreadable_file_is_refused_with_the_readable_formats(tmp_path: Path):
    (tmp_path / "a.json").write_text('{"format": "uwlts-unknown", "version": 1}')
    (tmp_path / "a.doc").write_text("words")
    with h5py.File(tmp_path / "a.h5", "w") as file:
        file.attrs["format"] = np.bytes_("another")
    for name, found in (("a.json", "uwlts-unknown"), ("a.doc", ".doc"), ("a.h5", "another")):
        with pytest.raises(
            CaptureError, match=f"{found}.*this reads captures and ground truth .* evaluations .* trajectories"
        ):
            uwlts.read(tmp_path / name)
    with pytest.raises(CaptureError, match=r"missing\.h5"):
        uwlts.read(tmp_path / "missing.h5")
    (tmp_path / "a.csv").write_text("x,y\n1,2\n")
    with pytest.raises(CaptureError, match="expected x, y and z"):
        uwlts.read(tmp_path / "a.csv")


@pytest.mark.parametrize("ending", [".csv", ".txt", ".asc", ".xyz", ".mcap", ".laz"])
def test_the_commands_and_python_read_the_same_clouds(tmp_path: Path, ending: str):
    path = tmp_path / f"a{ending}"
    if ending in (".xyz", ".mcap", ".laz"):
        cloud_of(7).save(path)
    else:
        path.write_text("x,y,z,time\n" + "".join(f"{n},0,1,{n}\n" for n in range(7)))
    assert isinstance(uwlts.read(path), PointCloud) and describe(path).startswith("cloud of 7 points")


@pytest.mark.parametrize("ending", [".csv", ".txt"])
@pytest.mark.parametrize("names", ["time_s,x,y,z,qx,qy,qz,qw", "time_s,x,y,z,a,b,c,d"])
def test_times_and_rotations_are_a_trajectory(tmp_path: Path, ending: str, names: str):
    (tmp_path / f"a{ending}").write_text(f"{names}\n0,1,2,3,0,0,0,1\n1,1,2,3,0,0,0.6,0.8\n")
    assert isinstance(uwlts.read(tmp_path / f"a{ending}"), Trajectory)
    assert describe(tmp_path / f"a{ending}").startswith("trajectory of 2 poses")


def test_results_are_short_texts():
    """Sizes in place of arrays: a screen has some 40 lines of 100 characters."""
    evaluation = uwlts.evaluate(cloud_of(100), {"kind": "plane"})
    sensor = uwlts.load_sensor("thesis")
    for result in (cloud_of(100_000), uwlts.nominal("thesis", medium="water"), sensor, evaluation):
        lines = repr(result).splitlines()
        assert len(lines) < 40 and max(map(len, lines)) <= 100 and str(result) == repr(result)
    assert "points_mm: 100000 x 3 float64" in repr(cloud_of(100_000))
    assert "camera: width_px=1280, height_px=1024, pixel_size_um=5.3" in repr(sensor)
    assert dir(uwlts.plot) == ["cloud", "residuals", "stripe"]
    assert "<td>100000 x 3 float64</td>" in cloud_of(100_000)._repr_html_()


def test_a_nominal_calibration_reports_its_medium(tmp_path):
    """The name is the one that was asked for, as in captures; the kind is that of the medium's description."""
    sensor = uwlts.load_sensor("thesis")
    media = {"air": sensor.media["air"], "water": sensor.media["water"], "fresh": sensor.media["water"]}
    media["sea"] = sensor.media["water"].model_copy(update={"kind": "sea", "salinity_g_kg": 35.0})
    sensor = sensor.model_copy(update={"media": media})
    kinds = {"air": "air", "water": "fresh", "fresh": "fresh", "sea": "sea"}
    for name, kind in kinds.items():
        calibration = uwlts.nominal(sensor, medium=name)
        assert (calibration.medium_name, calibration.medium_kind) == (name, kind)
        assert f"medium_name: {name}" in repr(calibration)
        calibration.save(tmp_path / f"{name}.json")
        assert uwlts.read(tmp_path / f"{name}.json") == calibration
    # Without a name, files are as before, so that the digests in older clouds stay valid.
    assert "medium_name" not in nominal_calibration(sensor).model_dump_json()
