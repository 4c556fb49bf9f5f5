"""Clouds of other programs: exported ones are read back, foreign ones are read, damaged ones are refused."""

import struct
from pathlib import Path

import laspy
import numpy as np
import pye57
import pytest

from tests.uwlts.storage.test_cloud import some_cloud
from uwlts.errors import CaptureError
from uwlts.storage.cloud import PointCloud
from uwlts.storage.cloud_files import is_cloud, read_cloud, read_parts, read_thinned_cloud, write_cloud


# All digits; half a unit in the last of 24 binary digits of coordinates below 2 m; half a step of 1e-4 mm.
@pytest.mark.parametrize(
    ("suffix", "apart_mm"), [(".xyz", 0.0), (".e57", 1e3 * 2.0**-24), (".las", 0.51e-4), (".laz", 0.51e-4)]
)
def test_exported_clouds_come_back(tmp_path: Path, suffix: str, apart_mm: float):
    path, cloud = tmp_path / f"a{suffix}", some_cloud(300, time_s=5 + np.arange(300.0))
    write_cloud(path, cloud)
    back = read_cloud(path)
    assert is_cloud(path) and np.abs(back.points_mm - cloud.points_mm).max() <= apart_mm
    assert np.array_equal(back.intensity, cloud.intensity)
    thinned, total = read_thinned_cloud(path, 100)
    assert total == 300 and np.array_equal(thinned.points_mm, back.points_mm[::3])
    parts = list(read_parts(path, 128))
    assert [len(part) for part in parts] == [128, 128, 44] and np.array_equal(
        parts[1].points_mm, back.points_mm[128:256]
    )


@pytest.mark.parametrize(
    ("name", "text"),
    [
        ("blanks.xyz", "1 2 3\n4 5 6\n"),
        ("names.csv", "n,z,y,x\n7,3,2,1\n8,6,5,4\n9,,,\n"),
        ("units.txt", "# of a scanner\nX [mm];Y [mm];Z [mm];Intensity\n1,0;2,0;3,0;0,5\n4,0;5,0;6,0;0,7\n"),
        ("tabs.asc", "1\t2\t3\t255\t0\t0\n4\t5\t6\t0\t0\t0\n"),
    ],
)
def test_text_of_other_programs(tmp_path: Path, name: str, text: str):
    (tmp_path / name).write_text(text)
    found = read_cloud(tmp_path / name)
    assert found.points_mm.tolist() == [[1, 2, 3], [4, 5, 6]] and (found.line == -1).all()
    assert np.isnan(found.intensity).all() or found.intensity.tolist() == pytest.approx([0.5, 0.7])


@pytest.mark.parametrize("point_format", [0, 1, 2, 3, 6, 7, 8])
def test_laz_of_every_point_format(tmp_path: Path, point_format: int):
    """Two chunks of points with a field of another program; LAS 1.4 compresses layer by layer."""
    count = 60_000
    points = np.random.default_rng(2).uniform(-1000, 1000, (count, 3))
    header = laspy.LasHeader(version="1.4" if point_format >= 6 else "1.2", point_format=point_format)
    header.scales = np.full(3, 1e-6)
    header.add_extra_dims([laspy.ExtraBytesParams(name="range", type=np.float32)])
    table = laspy.LasData(header)
    table.x, table.y, table.z = 1e-3 * points.T
    table["range"] = np.arange(count, dtype=np.float32)
    table.write(tmp_path / "a.laz")
    found = read_cloud(tmp_path / "a.laz")
    # Half a step of 1e-6 m.
    assert is_cloud(tmp_path / "a.laz") and np.abs(found.points_mm - points).max() < 0.501e-3
    content = (tmp_path / "a.laz").read_bytes()
    for damaged in (content[: len(content) // 2], content[:-4], content[:400] + content[500:]):
        (tmp_path / "a.laz").write_bytes(damaged)
        with pytest.raises(CaptureError, match=r"a\.laz is not a complete LAZ file"):
            read_cloud(tmp_path / "a.laz")


@pytest.mark.parametrize("timed", [False, True])
def test_las_in_metres(tmp_path: Path, timed: bool):
    header = laspy.LasHeader(version="1.2", point_format=int(timed))
    header.scales, header.offsets = np.full(3, 1e-3), np.array([1.0, 2.0, 0.0])
    table = laspy.LasData(header)
    table.x, table.y, table.z, table.intensity = [1.5, 1.25], [2.0, 2.5], [-0.5, 0.125], [10, 65535]
    if timed:
        table.gps_time = [3.0, 4.5]
    table.write(str(tmp_path / "a.las"))
    found = read_cloud(tmp_path / "a.las")
    assert np.abs(found.points_mm - [[1500, 2000, -500], [1250, 2500, 125]]).max() < 1e-9
    assert found.intensity.tolist() == [10, 65535] and found.deviation_mm is None
    assert (None if found.time_s is None else found.time_s.tolist()) == ([3.0, 4.5] if timed else None)


def test_every_scan_of_e57_at_its_pose(tmp_path: Path):
    file = pye57.E57(str(tmp_path / "a.e57"), mode="w")
    local = np.array([[1.0, 0.0, 0.0], [0.0, 2.0, 0.0]])
    columns = {f"cartesian{axis}": values for axis, values in zip("XYZ", local.T.copy(), strict=True)}
    file.write_scan_raw(columns)
    # A quarter turn about z, then a metre along it.
    file.write_scan_raw(
        columns, rotation=np.array([np.sqrt(0.5), 0, 0, np.sqrt(0.5)]), translation=np.array([0, 0, 1.0])
    )
    file.close()
    found = read_cloud(tmp_path / "a.e57")
    expected = 1e3 * np.vstack([local, [[0, 1, 1], [-2, 0, 1]]])
    assert np.abs(found.points_mm - expected).max() < 1e-9 and np.isnan(found.intensity).all()


def ply(points: np.ndarray, *, comment: bytes = b"", names: str = "x y z") -> bytes:
    properties = "".join(f"property float {name}\n" for name in names.split()).encode()
    start = b"ply\nformat binary_little_endian 1.0\n" + comment + b"element vertex %d\n" % len(points) + properties
    return start + b"end_header\n" + points.astype("<f4").tobytes()


@pytest.mark.parametrize("text", ["Gebäude 3", "Ж \u2192"])
@pytest.mark.parametrize("encoding", ["utf-8", "latin-1"])
def test_ply_comments_hold_any_bytes(tmp_path: Path, text: str, encoding: str):
    comment = b"comment " + text.encode(encoding, "replace") + b"\nobj_info \xff\xfe\n"
    (tmp_path / "a.ply").write_bytes(ply(np.arange(12.0).reshape(4, 3), comment=comment))
    assert read_cloud(tmp_path / "a.ply").points_mm.tolist() == np.arange(12.0).reshape(4, 3).tolist()


@pytest.mark.parametrize("name", ["intensity", "Intensity", "scalar_Intensity", "SCALAR_INTENSITY"])
def test_ply_names_in_any_capitals(tmp_path: Path, name: str):
    (tmp_path / "a.ply").write_bytes(ply(np.arange(8.0).reshape(2, 4), names=f"X Y Z {name}"))
    found = read_cloud(tmp_path / "a.ply")
    assert found.intensity.tolist() == [3, 7] and found.points_mm.tolist() == [[0, 1, 2], [4, 5, 6]]


def _write(path: Path, points: np.ndarray) -> None:
    """Write points in mm as other programs do."""
    match path.suffix:
        case ".ply":
            path.write_bytes(ply(points))
        case ".xyz":
            np.savetxt(path, points)
        case ".las":
            table = laspy.LasData(laspy.LasHeader(version="1.2", point_format=0))
            table.header.scales = np.full(3, 1e-6)
            table.x, table.y, table.z = 1e-3 * points.T
            table.write(str(path))
        case _:
            with pye57.E57(str(path), mode="w") as file:
                columns = {f"cartesian{axis}": 1e-3 * each for axis, each in zip("XYZ", points.T, strict=True)}
                file.write_scan_raw(columns, translation=np.array([0.0, 0.0, 1.0]))


@pytest.mark.parametrize("suffix", [".ply", ".xyz", ".las", ".e57"])
@pytest.mark.parametrize(("zeros", "kept"), [(300, 1000), (3, 1003)])
def test_points_at_zero_are_omitted_and_counted(tmp_path: Path, suffix: str, zeros: int, kept: int):
    """Around the origin a few points at zero may be measured."""
    points = np.vstack([np.random.default_rng(3).uniform(-9, 9, (1000, 3)), np.zeros((zeros, 3))])
    _write(tmp_path / f"a{suffix}", points)
    found = read_cloud(tmp_path / f"a{suffix}")
    assert len(found) == kept
    assert [warning.split(" points")[0] for warning in found.warnings] == ([] if zeros == 3 else ["300 of 1300"])
    assert read_thinned_cloud(tmp_path / f"a{suffix}", 100)[0].warnings or zeros == 3


def test_rounded_coordinates_may_coincide(tmp_path: Path):
    (tmp_path / "a.ply").write_bytes(ply(np.random.default_rng(3).integers(-3, 4, (5000, 3)).astype(float)))
    assert len(read_cloud(tmp_path / "a.ply")) == 5000


@pytest.mark.parametrize("value", [np.nan, np.inf])
@pytest.mark.parametrize("suffix", [".ply", ".xyz"])
def test_points_without_coordinates_are_omitted_and_counted(tmp_path: Path, suffix: str, value: float, caplog):
    points = np.random.default_rng(3).uniform(1, 2, (50, 3))
    points[[4, 9, 20], [0, 1, 2]] = value
    _write(tmp_path / f"a{suffix}", points)
    found = read_cloud(tmp_path / f"a{suffix}")
    assert np.abs(found.points_mm - np.delete(points, [4, 9, 20], axis=0)).max() < 1e-6
    assert found.warnings == ["3 of 50 points without finite coordinates are omitted"]
    assert caplog.messages == [f"warning: {tmp_path}/a{suffix}: {found.warnings[0]}"]
    assert [len(part) for part in read_parts(tmp_path / f"a{suffix}", 25)] in ([22, 25], [25, 22])


@pytest.mark.parametrize(("version", "point_format"), [("1.2", 0), ("1.4", 6)])
def test_noise_and_withheld_points_of_las(tmp_path: Path, version: str, point_format: int):
    table = laspy.LasData(laspy.LasHeader(version=version, point_format=point_format))
    table.x = table.y = table.z = np.arange(1.0, 7.0)
    table.classification = np.array([1, 7, 18, 2, 2, 2], np.uint8)
    table.withheld = np.array([0, 0, 0, 1, 0, 0], np.uint8)
    table.intensity = np.arange(6, dtype=np.uint16)
    table.write(str(tmp_path / "a.las"))
    found = read_cloud(tmp_path / "a.las")
    assert found.intensity.tolist() == [0, 4, 5] and found.points_mm[:, 0].tolist() == [1000, 5000, 6000]
    assert [warning.split(" are")[0] for warning in found.warnings] == [
        "1 of 6 points marked as withheld",
        "2 of 6 points classified as noise",
    ]


def test_invalid_points_of_e57_are_counted(tmp_path: Path):
    with pye57.E57(str(tmp_path / "a.e57"), mode="w") as file:
        columns = {f"cartesian{axis}": np.arange(1.0, 6.0) for axis in "XYZ"}
        file.write_scan_raw(columns | {"cartesianInvalidState": np.array([0, 1, 0, 2, 0], np.int8)})
    found = read_cloud(tmp_path / "a.e57")
    assert found.points_mm[:, 0].tolist() == [1000, 3000, 5000]
    assert found.warnings == ["2 of 5 points marked as invalid are omitted"]


@pytest.mark.parametrize(
    ("name", "message"),
    [
        ("a.xyz", "no table of numbers"),
        ("a.csv", "no table of numbers"),
        ("a.las", "not a complete LAS file"),
        ("a.e57", "not a complete E57 file"),
    ],
)
def test_what_is_none_is_refused(tmp_path: Path, name: str, message: str):
    path = tmp_path / name
    with pytest.raises(CaptureError, match="a.(xyz|csv|las|e57)"):
        read_cloud(path)
    path.write_bytes(b"this is\n\0no 1 cloud, 3\n" * 20)
    with pytest.raises(CaptureError, match=message):
        read_cloud(path)
    path.write_text("1 2\n3 4\n" if name == "a.xyz" else "")
    with pytest.raises(CaptureError, match=r"expected x, y and z in mm|is empty|not a complete"):
        read_cloud(path)


@pytest.mark.parametrize("name", ["a.xyz", "a.ply", "a.las", "a.laz", "a.e57"])
@pytest.mark.parametrize(("mark", "share"), [(-99.9999, 0.2), (0.0, 0.01), (1.5e4, 0.003)])
def test_a_height_that_recurs_beyond_chance_is_doubted(tmp_path, name, mark, share):
    """Points without a height have that of the mark, which is outside the others or between them."""
    rng, marked = np.random.default_rng(9), int(share * 5000)
    points = rng.normal(0, 30, (5000, 3)).astype(np.float32).astype(float)
    rows = rng.permutation(5000)[:marked]

    def warnings() -> list[str]:
        write_cloud(tmp_path / name, PointCloud(points, *np.ones((3, 5000))), overwrite=True)
        return read_cloud(tmp_path / name).warnings

    assert not any("have exactly" in each for each in warnings())
    points[rows, 2] = mark
    (said,) = (each for each in warnings() if "have exactly" in each)
    assert said.startswith(f"{marked} of 5000 points have exactly z = ")
    # More than half a step of 32-bit numbers in m below 16 m.
    assert float(said.split(" = ")[1].split(":")[0]) == pytest.approx(mark, abs=4e-3)
    points[:, 2] = np.round(points[:, 2] / 10) * 10
    assert not any("have exactly" in each for each in warnings())


@pytest.mark.parametrize("name", ["a.las", "a.laz"])
@pytest.mark.parametrize("axes", [[0], [2], [0, 1, 2]])
@pytest.mark.parametrize("scale", [1e-4, 1e-8, 1e-11, 0.98e-7])
def test_points_that_contradict_the_stated_box_are_refused(tmp_path, name, axes, scale):
    """Scales, at their place in the header (LAS 1.4, table 3), are changed: larger ones, and smaller ones."""
    path = tmp_path / name
    points = np.random.default_rng(1).uniform(-100, 100, (500, 3))
    write_cloud(path, PointCloud(points, np.ones(500, np.float32), np.zeros(500, np.int32), np.zeros(500, np.int32)))
    np.testing.assert_allclose(np.sort(read_cloud(path).points_mm, axis=0), np.sort(points, axis=0), atol=1e-4)
    content = bytearray(path.read_bytes())
    for axis in axes:
        assert struct.unpack_from("<d", content, 131 + 8 * axis) == (1e-7,)
        struct.pack_into("<d", content, 131 + 8 * axis, scale)
    path.write_bytes(content)
    with pytest.raises(CaptureError, match="its scale or offset is wrong: points are from .* the box of its header"):
        read_cloud(path)


def las(path: Path, points_m: np.ndarray, box_m: np.ndarray, offset_m, scale: float = 1e-5) -> Path:
    """Write a LAS file, with a box (2, 3) of its own in the header."""
    header = laspy.LasHeader(version="1.2", point_format=0)
    header.offsets, header.scales = np.broadcast_to(np.asarray(offset_m, float), 3), np.full(3, scale)
    table = laspy.LasData(header)
    table.x, table.y, table.z = points_m.T
    table.write(path)
    content = bytearray(path.read_bytes())
    for axis in range(3):
        struct.pack_into("<2d", content, 179 + 16 * axis, box_m[1, axis], box_m[0, axis])
    path.write_bytes(content)
    return path


def test_boxes_of_the_header_that_scales_do_not_explain_are_accepted(tmp_path: Path):
    """Programs round boxes, leave them empty, or keep those of the cloud that they cropped."""
    points = np.random.default_rng(6).uniform([10, 20, 5], [11, 22, 5.3], (400, 3))
    box = np.stack([points.min(axis=0), points.max(axis=0)])
    boxes = {
        "rounded": np.stack([np.floor(1e3 * box[0]), np.ceil(1e3 * box[1])]) / 1e3,
        "empty": np.zeros((2, 3)),
        "of a larger cloud": np.array([[0, 0, 0], [40, 40, 10.0]]),
        "of a cloud around": np.stack([2 * box[0] - box[1] - 0.1, box[1] + 0.3]),
        "cropped along one axis": box + [[0, 0, 0], [3, 0, 0]],
    }
    for name, stated in boxes.items():
        for offset in (0.0, box[0], [10, 20, 5], box.mean(axis=0)):
            found = read_cloud(las(tmp_path / "a.las", points, stated, offset))
            assert len(found) == 400, name
    for offset in (0.0, box[0], box.mean(axis=0)):
        origin = np.broadcast_to(offset, 3)
        with pytest.raises(CaptureError, match="its scale or offset is wrong"):
            read_cloud(las(tmp_path / "a.las", points, origin + (box - origin) * 1.2, offset))
    with pytest.raises(CaptureError, match="its scale or offset is wrong"):
        read_cloud(las(tmp_path / "a.las", points, box * [[1, 1, 1], [1, 1, 1e6]], 0.0))
