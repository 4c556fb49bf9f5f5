"""Files of other makers: CSV of Gocator and scanCONTROL sensors, and poses in robot programs."""

from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

import uwlts
from uwlts.storage.cloud_files import read_cloud
from uwlts.storage.number_tables import read_number_table
from uwlts.storage.pose_files import read_poses

INFO = "Info\nCSV Version,Sensor Count,Trigger Mode\n2,1,0\nEnd\nDeviceInfo\nID,Model\n13434,2M\nEnd\n"
COLUMNS = "Frame,Source,Time,Encoder,Z Encoder,Inputs,Exposure,Y,Axis"
ATTRIBUTES = "Frame Count,Column Count,X Offset,Y Offset,Z Offset\n2,3,{},0,0\n"


def test_profiles_of_a_gocator_are_read(tmp_path: Path):
    rows = "0,0,5,0,0,0,80,10.5,Z,1.5,,3.5\n0,0,5,0,0,0,80,10.5,I,7,8,9\n1,0,6,0,0,0,80,11,Z,4,5,6\n"
    (tmp_path / "a.csv").write_text(f"{INFO}Profile\n{ATTRIBUTES.format(0)}{COLUMNS},-0.5,0,0.5\n{rows}End\n")
    cloud = read_cloud(tmp_path / "a.csv")
    expected = [[-0.5, 10.5, 1.5], [0.5, 10.5, 3.5], [-0.5, 11, 4], [0, 11, 5], [0.5, 11, 6]]
    assert cloud.points_mm.tolist() == expected and cloud.intensity[:2].tolist() == [7, 9]
    assert "Profile of a Gocator" in cloud.warnings[0] and "1 of 6 points" in cloud.warnings[1]
    raw = "0,0,5,0,0,0,80,10.5,X,-1,0,1\n0,0,5,0,0,0,80,10.5,Z,2,3,4\n"
    (tmp_path / "b.csv").write_text(f"{INFO}RawProfile\n{ATTRIBUTES.format(2.5)}{COLUMNS},0,1,2\n{raw}End\n")
    found = read_number_table(tmp_path / "b.csv")
    assert (found.columns["x"].tolist(), found.columns["z"].tolist()) == ([-1, 0, 1], [2, 3, 4])
    assert found.notes[1] == "offsets are not added: X Offset 2.5 mm"


def test_a_surface_of_a_gocator_is_read(tmp_path: Path):
    part = "Part\nFrame,X Offset,Y Offset,Z Offset\n0,0,0,0\nY\\X,0,0.1,0.2\n5,1,2,3\n6,4,,6\nEnd\n"
    (tmp_path / "a.csv").write_text(INFO + part)
    cloud = read_cloud(tmp_path / "a.csv")
    assert cloud.points_mm.tolist() == [[0, 5, 1], [0.1, 5, 2], [0.2, 5, 3], [0, 6, 4], [0.2, 6, 6]]
    for text, message in (
        (INFO, "this reads Profile"),
        (INFO + part.replace("5,1,2,3", "5,1,2"), "section Part is damaged"),
    ):
        (tmp_path / "b.csv").write_text(text)
        with pytest.raises(uwlts.Error, match=message):
            read_cloud(tmp_path / "b.csv")


def test_a_point_cloud_of_a_gocator_is_read(tmp_path: Path):
    attributes = "Frame,Source,Time,Encoder,Z Encoder,Inputs,Row Count,Column Count,X Offset,Y Offset,Z Offset"
    part = f"SurfacePointCloud\n{attributes}\n0,0,1,2,0,0,2,2,0,0,0\nx,y,z,x,y,z\n0,5,1,0.1,5.1,2\n0,6,4,,,\nEnd\n"
    (tmp_path / "a.csv").write_text(INFO + part)
    cloud = read_cloud(tmp_path / "a.csv")
    assert cloud.points_mm.tolist() == [[0, 5, 1], [0.1, 5.1, 2], [0, 6, 4]]
    (tmp_path / "a.csv").write_text(INFO + part.replace("0,5,1,0.1", "0,5,0.1"))
    with pytest.raises(uwlts.Error, match="a row has 5 cells"):
        read_cloud(tmp_path / "a.csv")


BLOCK = "scanCONTROL 2950-100\nSerial number{0}218020023\nMeasuring range{0}100{0}mm\n\nDate{0}12.03.2024 10:11\n"
ROWS = [[0.5 * i, 0.25 * p, 90 + 0.125 * i, 300 + i] for p in range(3) for i in range(20)]


@pytest.mark.parametrize("mark", ";,\t")
@pytest.mark.parametrize("decimal", ".,")
@pytest.mark.parametrize(
    ("names", "scale"),
    [
        ("Profile X-Value[mm] Y-Value[mm] Z-Value[mm] Intensity", 1.0),
        ("Profile X/um Y/um Z/um Intensity", 1e-3),
        ("Profile X Y Z Intensity", 1.0),
    ],
)
def test_lines_before_the_names_of_columns_are_said_and_omitted(
    tmp_path: Path, mark: str, decimal: str, names: str, scale: float
):
    if mark == decimal:
        return
    rows = ["0 " + " ".join(map(str, row)) for row in ROWS]
    text = "\n".join([names, *rows]).replace(".", decimal).replace(" ", mark)
    for encoding in ("utf-8", "utf-16"):
        (tmp_path / "a.csv").write_text(BLOCK.format(mark) + text, encoding=encoding)
        cloud = read_cloud(tmp_path / "a.csv")
        assert np.allclose(cloud.points_mm, scale * np.array(ROWS)[:, :3], rtol=1e-15)
        assert cloud.intensity.tolist() == [row[3] for row in ROWS]
        assert "lines before the names of columns are omitted (4): scanCONTROL 2950-100" in cloud.warnings[0]


@pytest.mark.parametrize("line", ["Unit;m", "# units = [m]", "// Length unit: metres", "Unit,m"])
@pytest.mark.parametrize("names", ["X;Y;Z", ""])
def test_a_line_beside_a_table_may_state_the_unit(tmp_path: Path, line: str, names: str):
    if not names and line[0] not in "#/":
        return
    rows = "\n".join(";".join(map(str, row[:3])) for row in ROWS)
    (tmp_path / "a.csv").write_text(f"{line}\n{names}\n{rows}\n")
    assert np.array_equal(read_cloud(tmp_path / "a.csv").points_mm, 1000 * np.array(ROWS)[:, :3])
    assert np.array_equal(read_cloud(tmp_path / "a.csv", unit="m").points_mm, read_cloud(tmp_path / "a.csv").points_mm)
    with pytest.raises(uwlts.Error, match="states m, but the unit mm was given"):
        read_cloud(tmp_path / "a.csv", unit="mm")
    (tmp_path / "a.csv").write_text(f"{line}\nX [mm];Y [mm];Z [mm]\n{rows}\n")
    with pytest.raises(uwlts.Error, match="names columns in mm, and states the unit m"):
        read_cloud(tmp_path / "a.csv")
    (tmp_path / "a.csv").write_text(f"# unit: mm\n{line}\nX;Y;Z\n{rows}\n")
    assert "may state another unit" in " ".join(read_cloud(tmp_path / "a.csv").warnings)


def test_rows_that_are_counted_need_names(tmp_path: Path):
    text = "".join(f"{number} {row[0]} {row[1]} {row[2]}\n" for number, row in enumerate(ROWS, start=1))
    (tmp_path / "a.xyz").write_text(text)
    with pytest.raises(uwlts.Error, match="counts its rows in the first column: name the columns"):
        read_cloud(tmp_path / "a.xyz")
    (tmp_path / "a.xyz").write_text(f"n x y z\n{text}")
    assert np.array_equal(read_cloud(tmp_path / "a.xyz").points_mm, np.array(ROWS)[:, :3])


def test_profiles_without_positions_and_repeated_names_are_refused(tmp_path: Path):
    rows = "\n".join(";".join(map(str, row[:3])) for row in ROWS)
    (tmp_path / "a.csv").write_text(f"scanCONTROL\nProfile;X;Z\n{rows}\n")
    with pytest.raises(uwlts.Error, match="expected x, y and z"):
        read_cloud(tmp_path / "a.csv")
    (tmp_path / "a.csv").write_text(f"scanCONTROL\nX;Y;Z\n{rows}\nX;Y;Z\n{rows}\n")
    with pytest.raises(uwlts.Error, match="no table of numbers"):
        read_cloud(tmp_path / "a.csv")


PROGRAMS = {
    "abb": (
        "MODULE a\n! CONST robtarget p0:=[[9,9,9],[1,0,0,0],[0,0,0,0],[9E9,9E9,9E9,9E9,9E9,9E9]];\n"
        "CONST robtarget p1:=[[600.5,-20,300],[0.5,0.5,-0.5,0.5],[0,-1,0,0],[9E9,9E9,9E9,9E9,9E9,9E9]];\n"
        "MoveL [ [6.1E2, 0, 310], [0.5, 0.5, -0.5, 0.5], [0,0,0,0], [9E9,9E9,9E9,9E9,9E9,9E9] ], v100, fine, tool0;\n",
        [[600.5, -20, 300], [610, 0, 310]],
        Rotation.from_quat([0.5, -0.5, 0.5, 0.5]),
    ),
    "kuka": (
        "DECL E6POS XP1={X 600.5,Y -20.0,Z 300.0,A 30.0,B 40.0,C -50.0,S 6,T 27,E1 0.0}\n"
        ";FOLD X 1,Y 1,Z 1,A 0,B 0,C 0\n"
        "PTP {x 610, y 0, z 310, a 30, b 40, c -50}\n",
        [[600.5, -20, 300], [610, 0, 310]],
        Rotation.from_euler("ZYX", [30, 40, -50], degrees=True),
    ),
    "ur": (
        "global p1 = p[0.6005, -0.020, 0.3, 0.1, -1.2, 0.3]\n# p[9,9,9,0,0,0]\nmovej([0,0,0,0,0,0])\n"
        "movel(p[.61, 0, 3.1e-1, 0.1, -1.2, 0.3], a=1.2)\n",
        [[600.5, -20, 300], [610, 0, 310]],
        Rotation.from_rotvec([0.1, -1.2, 0.3]),
    ),
}


@pytest.mark.parametrize("robot", PROGRAMS)
def test_poses_of_robot_programs_are_read(tmp_path: Path, robot: str):
    text, places, rotation = PROGRAMS[robot]
    (tmp_path / "a.mod").write_text(text)
    poses, times = read_poses(tmp_path / "a.mod", pose_format=robot)
    assert times is None and np.allclose(poses[:, :3, 3], places, atol=1e-9)
    assert np.allclose(poses[:, :3, :3], rotation.as_matrix(), atol=1e-9)
    with pytest.raises(uwlts.Error, match="are in m"):
        read_poses(tmp_path / "a.mod", pose_format=robot, unit="mm" if robot == "ur" else "m")
    (tmp_path / "b.mod").write_text("no pose")
    with pytest.raises(uwlts.Error, match=f"no pose in the form of {robot}"):
        read_poses(tmp_path / "b.mod", pose_format=robot)
