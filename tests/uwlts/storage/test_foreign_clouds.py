"""Clouds of other programs: exported ones are read back, foreign ones are read, damaged ones are refused."""

from pathlib import Path

import laspy
import numpy as np
import pye57
import pytest

from tests.uwlts.storage.test_cloud import some_cloud
from uwlts.errors import CaptureError
from uwlts.storage.cloud_files import is_cloud, read_cloud, read_parts, read_thinned_cloud, write_cloud


# All digits; half a unit in the last of 24 binary digits of coordinates below 2 m.
@pytest.mark.parametrize(("suffix", "apart_mm"), [(".xyz", 0.0), (".e57", 1e3 * 2.0**-24)])
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
