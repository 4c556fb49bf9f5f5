"""Captures and clouds in other programs' formats, read back by those formats' own libraries."""

import contextlib
import sys
from pathlib import Path

import cv2
import laspy
import numpy as np
import pye57
import pytest
import trimesh
from scipy.spatial.transform import Rotation

from tests.uwlts.storage.drawn_captures import a_header, record, small_sensor
from uwlts import cli
from uwlts.errors import CaptureError, OutputError, SetupError
from uwlts.runtime.console import run
from uwlts.storage.capture import Capture, Frame
from uwlts.storage.capture_writer import CaptureWriter
from uwlts.storage.cloud import PointCloud
from uwlts.storage.cloud_files import CLOUD_FORMATS, COLOURED_FORMATS, read_cloud, write_cloud
from uwlts.storage.export_ import export, export_capture
from uwlts.storage.foreign_clouds import FORMATS
from uwlts.storage.import_.folder import import_images
from uwlts.storage.las_file import LAZ_STEP_M


def a_cloud(count: int = 500, *, reach_mm: float = 300.0, **changes) -> PointCloud:
    rng = np.random.default_rng(3)
    known = {
        "points_mm": rng.uniform(-reach_mm, reach_mm, (count, 3)) + [0, 0, 400.0],
        "intensity": rng.uniform(0, 255, count),
        "frame": np.arange(count) // 10,
        "line": np.arange(count) % 10,
        "metadata": {"medium": "water"},
    }
    return PointCloud(**(known | changes))


def assert_same(first: Path, second: Path) -> None:
    """Check that two captures have identical content."""
    with Capture(first) as a, Capture(second) as b:
        assert a.header.model_dump_json() == b.header.model_dump_json()
        assert a.dtype == b.dtype and len(a) == len(b) > 0
        for name in ("stage_mm", "pose", "laser_on", "exposure_ms", "time_s"):
            assert np.array_equal(getattr(a, name), getattr(b, name), equal_nan=name == "pose")
        for index in range(len(a)):
            assert np.array_equal(a.image(index), b.image(index))


def export_and_import(folder: Path, **options: str) -> None:
    """Check that a capture is the same after an export to images and an import of these."""
    with Capture(folder / "a.h5") as capture:
        export_capture(capture, folder / "images", **options)
    import_images(folder / "images", folder / "b.h5")
    assert_same(folder / "a.h5", folder / "b.h5")


@pytest.mark.parametrize("dtype", [np.uint8, np.uint16])
@pytest.mark.parametrize("image_format", ["png", "tiff"])
def test_an_exported_capture_comes_back(tmp_path: Path, dtype: type, image_format: str):
    # Warnings about images without a stripe or unusual headers are irrelevant for a capture of the program.
    header = a_header(saturation_dn=int(np.iinfo(dtype).max), artefact={"kind": "plane", "flatness_mm": None})
    record(tmp_path / "a.h5", 7, dtype, header=header)
    export_and_import(tmp_path, image_format=image_format)
    assert sorted(path.suffix for path in (tmp_path / "images").iterdir()) == sorted(
        [".csv", ".json", ".toml"] + 7 * [f".{image_format}"]
    )


def test_poses_and_numbers_come_back_to_the_last_bit(tmp_path: Path):
    rng = np.random.default_rng(5)
    sensor = small_sensor()
    shape = (sensor.camera.height_px, sensor.camera.width_px)
    with CaptureWriter(tmp_path / "a.h5", a_header(sensor=sensor, target=None), dtype=np.uint8) as writer:
        for index in range(4):
            stage, exposure, time = rng.normal(), rng.uniform(0, 5), index + rng.uniform()
            pose = np.eye(4)
            pose[:3, :3], pose[:3, 3] = Rotation.random(random_state=index).as_matrix(), rng.normal(size=3)
            image = rng.integers(0, 255, shape, dtype=np.uint8)
            writer.append(Frame(image, stage, index < 2, exposure, time, pose if index % 2 else None))
    export_and_import(tmp_path)


def test_all_sixteen_bits_are_in_the_files(tmp_path: Path):
    record(tmp_path / "a.h5", 1, np.uint16)
    with Capture(tmp_path / "a.h5") as capture:
        export_capture(capture, tmp_path / "images")
        stored = cv2.imread(str(tmp_path / "images" / "00000-lamp.png"), cv2.IMREAD_UNCHANGED)
        assert stored.dtype == np.uint16 and np.array_equal(stored, capture.image(0)) and stored.max() > 60000


def test_a_folder_that_exists_stays(tmp_path: Path):
    record(tmp_path / "a.h5", 2)
    (tmp_path / "images").mkdir()
    with Capture(tmp_path / "a.h5") as capture:
        with pytest.raises(OutputError, match="exists already"):
            export_capture(capture, tmp_path / "images")
        with pytest.raises(OutputError, match="does not exist; create it first"):
            export_capture(capture, tmp_path / "no" / "images")
    assert sorted(path.name for path in tmp_path.iterdir()) == ["a.h5", "images"]


def test_an_interruption_leaves_nothing(tmp_path: Path):
    def interrupt(done: int, total: int) -> None:
        raise KeyboardInterrupt

    record(tmp_path / "a.h5", 2)
    with Capture(tmp_path / "a.h5") as capture, contextlib.suppress(KeyboardInterrupt):
        export_capture(capture, tmp_path / "images", progress=interrupt)
    assert [path.name for path in tmp_path.iterdir()] == ["a.h5"]


def test_xyz_keeps_every_digit(tmp_path: Path):
    cloud = a_cloud(intensity=np.r_[np.nan, np.random.default_rng(1).uniform(0, 255, 499)])
    write_cloud(tmp_path / "a.xyz", cloud)
    assert (tmp_path / "a.xyz").read_text().startswith("//X Y Z Intensity\n")
    back = np.loadtxt(tmp_path / "a.xyz", comments="//")
    assert np.array_equal(back[:, :3], cloud.points_mm)
    assert np.array_equal(back[:, 3].astype(np.float32), cloud.intensity, equal_nan=True)


def test_laz_keeps_a_tenth_of_a_micrometre(tmp_path: Path):
    cloud = a_cloud(deviation_mm=np.linspace(-1, 1, 500), intensity=np.r_[np.nan, np.linspace(0, 300, 499)])
    write_cloud(tmp_path / "a.laz", cloud)
    content = laspy.read(tmp_path / "a.laz")
    assert (tmp_path / "a.laz").read_bytes()[:4] == b"LASF" and content.header.are_points_compressed
    # Rounded to half a step, and the sum with the offset to double precision.
    assert np.abs(content.xyz - 1e-3 * cloud.points_mm).max() <= 0.5001 * LAZ_STEP_M
    assert np.array_equal(np.array(content["amplitude"]), cloud.intensity, equal_nan=True)
    assert content.intensity[0] == 0 and np.abs(content.intensity[1:] - cloud.intensity[1:]).max() <= 0.5
    assert np.array_equal(content["frame"], cloud.frame) and np.array_equal(content["line"], cloud.line)
    assert np.array_equal(np.array(content["deviation_mm"]), cloud.deviation_mm)


def test_laz_refuses_what_its_steps_do_not_reach(tmp_path: Path):
    wide = a_cloud(2, points_mm=np.array([[0.0, 0, 0], [500e3, 0, 0]]))
    with pytest.raises(OutputError, match="reaches 250 m from its middle"):
        write_cloud(tmp_path / "a.laz", wide)
    assert list(tmp_path.iterdir()) == []


def test_e57_keeps_single_precision(tmp_path: Path):
    cloud = a_cloud()
    write_cloud(tmp_path / "a.e57", cloud)
    file = pye57.E57(str(tmp_path / "a.e57"))
    back = file.read_scan_raw(0)
    file.close()
    found = np.column_stack([back[f"cartesian{axis}"] for axis in "XYZ"])
    # Half a unit in the last of 24 binary digits, of coordinates below 1 m.
    assert np.abs(found - 1e-3 * cloud.points_mm).max() <= 2.0**-25
    assert np.array_equal(np.asarray(back["intensity"], dtype=np.float32), cloud.intensity)


def test_e57_of_unknown_intensity(tmp_path: Path):
    write_cloud(tmp_path / "a.e57", a_cloud(intensity=np.full(500, np.nan)))
    file = pye57.E57(str(tmp_path / "a.e57"))
    assert "intensity" not in file.read_scan_raw(0)
    file.close()
    with pytest.raises(OutputError, match="1 of 500 points have no intensity"):
        write_cloud(tmp_path / "b.e57", a_cloud(intensity=np.r_[np.nan, np.ones(499)]))


@pytest.mark.parametrize("suffix", CLOUD_FORMATS)
def test_one_point_and_a_flat_cloud(tmp_path: Path, suffix: str):
    write_cloud(tmp_path / f"one{suffix}", a_cloud(1))
    write_cloud(tmp_path / f"flat{suffix}", a_cloud(points_mm=a_cloud().points_mm * [1, 1, 0]))


@pytest.mark.parametrize("suffix", CLOUD_FORMATS)
def test_what_exists_stays_and_nothing_is_made_of_nothing(tmp_path: Path, suffix: str):
    path = tmp_path / f"a{suffix}"
    path.write_bytes(b"precious")
    with pytest.raises(OutputError, match="exists already"):
        write_cloud(path, a_cloud())
    assert path.read_bytes() == b"precious"
    write_cloud(path, a_cloud(), overwrite=True)
    assert path.stat().st_size > 1000
    empty = a_cloud(0)
    write_cloud(tmp_path / "empty.ply", empty)
    with pytest.raises(OutputError, match="has no points"):
        export(tmp_path / "empty.ply", tmp_path / f"b{suffix}")
    assert {left.name for left in tmp_path.iterdir()} == {path.name, "empty.ply"}


@pytest.mark.parametrize("suffix", [ending for ending, each in FORMATS.items() if each.write])
def test_formats_that_hold_no_empty_cloud_say_so(tmp_path: Path, suffix: str):
    empty = a_cloud(0)
    with pytest.raises(OutputError, match="has no points"):
        write_cloud(tmp_path / f"a{suffix}", empty)
    assert list(tmp_path.iterdir()) == []


def test_las_is_laz_that_is_not_compressed(tmp_path: Path):
    cloud = a_cloud()
    for suffix in (".las", ".laz"):
        write_cloud(tmp_path / f"a{suffix}", cloud)
    plain, packed = (laspy.read(tmp_path / f"a{suffix}") for suffix in (".las", ".laz"))
    assert not plain.header.are_points_compressed
    assert np.array_equal(plain.points.array, packed.points.array)
    # To half a step.
    assert np.abs(read_cloud(tmp_path / "a.las").points_mm - cloud.points_mm).max() <= 0.5001e3 * LAZ_STEP_M


def test_colours_are_those_that_other_programs_read(tmp_path: Path):
    cloud, colours = a_cloud(), np.random.default_rng(5).integers(0, 256, (500, 3)).astype(np.uint8)
    for suffix in COLOURED_FORMATS:
        write_cloud(tmp_path / f"a{suffix}", cloud, colours=colours)
    seen = trimesh.load(tmp_path / "a.ply")
    assert np.array_equal(seen.colors[:, :3], colours) and (seen.colors[:, 3] == 255).all()
    for suffix in (".las", ".laz"):
        table = laspy.read(tmp_path / f"a{suffix}")
        assert np.array_equal(np.column_stack([table.red, table.green, table.blue]), 257 * colours.astype(int))
    file = pye57.E57(str(tmp_path / "a.e57"))
    found = file.read_scan(0, colors=True, ignore_missing_fields=True)
    file.close()
    assert np.array_equal(np.column_stack([found[f"color{each}"] for each in ("Red", "Green", "Blue")]), colours)
    again = read_cloud(tmp_path / "a.ply")
    assert np.array_equal(again.points_mm, cloud.points_mm) and np.array_equal(again.intensity, cloud.intensity)
    # MeshLab shows a property with this name as grey, in place of the colours.
    header = (tmp_path / "a.ply").read_bytes().partition(b"end_header")[0]
    assert b"float scalar_intensity" in header and b"float intensity" not in header


@pytest.mark.parametrize("name", ["a.xyz", "a.mcap"])
def test_formats_without_colours_are_refused(tmp_path: Path, name: str):
    with pytest.raises(OutputError, match=r"ends with none of .ply"):
        write_cloud(tmp_path / name, a_cloud(), colours=np.zeros((500, 3), np.uint8))
    assert list(tmp_path.iterdir()) == []


def test_unknown_endings_are_refused(tmp_path: Path):
    with pytest.raises(OutputError, match=r"ends with none of .ply, .h5, .xyz, .laz, .e57"):
        write_cloud(tmp_path / "a.obj", a_cloud())


@pytest.mark.parametrize(("library", "suffix"), [("laspy", ".laz"), ("lazrs", ".laz"), ("pye57", ".e57")])
def test_a_library_that_is_missing_is_named(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, library: str, suffix: str):
    monkeypatch.setitem(sys.modules, library, None)
    with pytest.raises(
        SetupError, match=rf"needs the library {library}, .*-m pip install 'laspy\[lazrs\]>=2.7' 'pye57>=[^;]*$"
    ):
        write_cloud(tmp_path / f"a{suffix}", a_cloud())
    assert list(tmp_path.iterdir()) == []


def test_the_command(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]):
    record(tmp_path / "a.h5", 3)
    write_cloud(tmp_path / "a.ply", a_cloud())

    def called(*arguments: str) -> int:
        monkeypatch.setattr("sys.argv", ["uwlts", *arguments])
        return run(cli.app)

    assert called("export", str(tmp_path / "a.h5"), "--out", str(tmp_path / "images"), "--images", "tiff") == 0
    assert "wrote 3 images" in capsys.readouterr().out
    assert called("import", str(tmp_path / "images"), "--out", str(tmp_path / "b.h5")) == 0
    assert called("export", str(tmp_path / "a.ply"), "--out", str(tmp_path / "a.laz")) == 0
    assert called("export", str(tmp_path / "a.ply"), "--out", str(tmp_path / "a.laz")) == 2
    assert "exists already" in capsys.readouterr().err
    assert called("export", str(tmp_path / "a.ply"), "--out", str(tmp_path / "a.laz"), "--overwrite") == 0
    assert_same(tmp_path / "a.h5", tmp_path / "b.h5")


@pytest.mark.parametrize("reach_mm", [1.0, 300.0, 7000.0])
def test_ply_with_float_is_read_by_programs_without_double(tmp_path: Path, reach_mm: float):
    """Declared as float, as PCL needs it, and exact to the rounding of 24 bits."""
    cloud = a_cloud(reach_mm=reach_mm)
    write_cloud(tmp_path / "a.float.ply", cloud)
    head = (tmp_path / "a.float.ply").read_bytes().partition(b"end_header")[0]
    assert all(f"property float {axis}\n".encode() in head for axis in "xyz")
    found = read_cloud(tmp_path / "a.float.ply")
    assert np.abs(found.points_mm - cloud.points_mm).max() <= 2.0**-24 * np.abs(cloud.points_mm).max()
    assert np.array_equal(found.frame, cloud.frame) and found.metadata["medium"] == "water"
    with pytest.raises(OutputError, match="beyond 16 m from the origin"):
        write_cloud(tmp_path / "b.float.ply", a_cloud(reach_mm=1e5))
    assert not (tmp_path / "b.float.ply").exists()


def test_a_folder_is_not_called_a_capture(tmp_path: Path):
    (tmp_path / "bag").mkdir()
    with pytest.raises(CaptureError, match="bag: it is a directory"):
        export(tmp_path / "bag", tmp_path / "a.ply")
