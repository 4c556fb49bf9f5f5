"""Tables of other programs: separators, encodings, names and units are recognised, contradictions are refused."""

from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

import uwlts
from uwlts.report.file_description import trajectory_lines
from uwlts.storage.cloud_files import read_cloud
from uwlts.storage.pose_files import read_poses

POINTS_MM = [[0.5, 2.0, 400.25], [1.5, -2.0, 401.5], [2.5, 0.0, 402.75]]


def text_of(header: str, separator: str, scale: float, comma: bool = False) -> str:
    rows = [separator.join(f"{scale * value:.9f}" for value in point) for point in POINTS_MM]
    text = "\n".join([*([header] if header else []), *rows]) + "\n"
    return text.replace(".", ",") if comma else text


@pytest.mark.parametrize(
    ("header", "separator", "scale"),
    [
        ("x_m,y_m,z_m", ",", 1e-3),
        ("X [m];Y [m];Z [m]", ";", 1e-3),
        ("x(cm)\ty(cm)\tz(cm)", "\t", 0.1),
        ("x [µm],y [µm],z [µm]", ",", 1e3),
        ("x_inch,y_inch,z_inch", ",", 1 / 25.4),
        ("# x [m] y [m] z [m]", " ", 1e-3),
        ("//Xmm Ymm Zmm", " ", 1.0),
        ("Position X / mm,Position Y / mm,Position Z / mm", ",", 1.0),
        ("X (millimetres),Y (millimetres),Z (millimetres)", ",", 1.0),
        ("# scanned in Basel, twice\n", ",", 1.0),
        ("3", " ", 1.0),
        ("# x y z in the frame of the camera", " ", 1.0),
    ],
)
@pytest.mark.parametrize("encoding", ["utf-8", "utf-8-sig", "utf-16", "latin-1"])
def test_units_in_names_are_obeyed(tmp_path: Path, header: str, separator: str, scale: float, encoding: str):
    (tmp_path / "a.csv").write_bytes(text_of(header, separator, scale).encode(encoding))
    found = read_cloud(tmp_path / "a.csv")
    # Nine decimals in inches are 1e-8 mm.
    assert np.abs(found.points_mm - POINTS_MM).max() < 2e-6 and not found.warnings


@pytest.mark.parametrize("separator", [";", "\t", " ", "  "])
@pytest.mark.parametrize("header", ["", "X Y Z", "3"])
def test_decimal_commas(tmp_path: Path, separator: str, header: str):
    (tmp_path / "a.txt").write_text(text_of(header, separator, 1.0, comma=True))
    found = read_cloud(tmp_path / "a.txt")
    assert np.abs(found.points_mm - POINTS_MM).max() < 1e-9
    assert any("decimal commas" in warning for warning in found.warnings) == separator.isspace() * (separator != "\t")


def test_columns_are_taken_by_name_and_the_others_left(tmp_path: Path):
    (tmp_path / "a.csv").write_text("Intensity,nx,Z_m,Y_m,X_m,\n7,1,0.3,0.2,0.1,\n8,1,0.6,0.5,0.4,\n")
    found = read_cloud(tmp_path / "a.csv")
    assert np.abs(found.points_mm - [[100, 200, 300], [400, 500, 600]]).max() < 1e-9
    assert found.intensity.tolist() == [7, 8]


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("x_m,y_mm,z_m\n1,2,3\n", "x in m, y in mm"),
        ("x,y,z_m\n1,2,3\n", "x in no stated unit"),
        ("x [furlong],y [furlong],z [furlong]\n1,2,3\n", "unknown unit"),
        ("x_deg,y_deg,z_deg\n1,2,3\n", "unknown unit"),
        ("5\n1 2 3\n4 5 6\n", "states 5 rows"),
        ("1,25,2,05,3,50\n4,25,5,05,6,50\n", "both decimal and separators"),
        ("x,y,z\n1,2\n", "no table of numbers"),
        ("x_px,y_px,z_px\n1,2,3\n", "columns x_px, y_px, z_px; expected x, y and z"),
        ("x,y,z,label\n1,2,3,a\n", "no table of numbers"),
        ("x,p_x,y,z\n1,2,3,4\n", "each name once"),
        ("x_mm,y_mm,z_mm\nm,m,m\n1,2,3\n", "'x_mm' and the unit m in the row below"),
        ("# Northing Easting Elevation\n1 0 0\n0 1 0\n0 0 1\n", "north, east, up, a left-handed frame"),
    ],
)
def test_contradictions_are_refused(tmp_path: Path, text: str, message: str):
    (tmp_path / "a.csv").write_text(text)
    with pytest.raises(uwlts.Error, match=message):
        read_cloud(tmp_path / "a.csv")


@pytest.mark.parametrize("words", ["coordinates in metres", "unit: US survey feet", "1 unit = 1 m", "unit: furlong"])
def test_a_unit_in_prose_is_doubted(tmp_path: Path, words: str):
    (tmp_path / "a.xyz").write_text(f"# {words}\n1 2 3\n4 5 6\n")
    found = read_cloud(tmp_path / "a.xyz")
    assert found.points_mm[0].tolist() == [1, 2, 3] and "another unit" in found.warnings[0]


TURN = Rotation.from_euler("zyx", [0.3, -0.2, 0.5])
X, Y, Z, W = (f"{value:.12f}" for value in TURN.as_quat())


@pytest.mark.parametrize("pose_format", ["quaternion-xyzw", "quaternion-wxyz"])
@pytest.mark.parametrize(
    ("header", "rotation"),
    [
        ("x_m,y_m,z_m,qw,qx,qy,qz", (W, X, Y, Z)),
        ("x [m],y [m],z [m],qx,qy,qz,qw", (X, Y, Z, W)),
        ("# p_x [m], p_y [m], p_z [m], q_z, q_y, q_x, q_w", (Z, Y, X, W)),
        ("x_m,y_m,z_m,q0,q1,q2,q3", (W, X, Y, Z)),
        ("position.x_m,position.y_m,position.z_m,rotation.x,rotation.y,rotation.z,rotation.w", (X, Y, Z, W)),
    ],
)
def test_names_decide_the_order_of_a_quaternion(tmp_path: Path, pose_format: str, header: str, rotation: tuple[str]):
    (tmp_path / "a.csv").write_text("\n".join([header, ",".join(("0.1", "0.2", "0.3", *rotation))]) + "\n")
    poses, _ = read_poses(tmp_path / "a.csv", pose_format=pose_format)
    assert poses[0, :3, :3] == pytest.approx(TURN.as_matrix(), abs=1e-9)
    assert poses[0, :3, 3] == pytest.approx([100, 200, 300])


@pytest.mark.parametrize(
    ("header", "angles"),
    [
        ("roll_rad,pitch_rad,yaw_rad", (0.5, -0.2, 0.3)),
        ("Yaw [rad],Pitch [rad],Roll [rad]", (0.3, -0.2, 0.5)),
        ("rx,ry,rz", (0.5, -0.2, 0.3)),
        ("a,b,c", (0.3, -0.2, 0.5)),
        ("phi,theta,psi", (0.5, -0.2, 0.3)),
        ("psi_rad,theta_rad,phi_rad", (0.3, -0.2, 0.5)),
        ("Omega,Phi,Kappa", (0.5, -0.2, 0.3)),
    ],
)
@pytest.mark.parametrize("places", ["X_mm,Y_mm,Z_mm", "x,y,height", "# easting northing z"])
def test_names_decide_the_axes_of_euler_angles(tmp_path: Path, caplog, places: str, header: str, angles: tuple[float]):
    (tmp_path / "a.csv").write_text(f"{places},{header}\n1,2,3,{','.join(map(str, angles))}\n")
    poses, _ = read_poses(tmp_path / "a.csv", pose_format="euler-zyx-rad")
    assert poses[0, :3, :3] == pytest.approx(TURN.as_matrix(), abs=1e-12)
    assert poses[0, :3, 3].tolist() == [1, 2, 3]
    assert ("a, b, c are read as angles about z, y, x, in this order" in caplog.text) is (header == "a,b,c")


def test_proper_euler_angles_keep_their_order(tmp_path: Path, caplog: pytest.LogCaptureFixture):
    (tmp_path / "a.csv").write_text("x,y,z,phi,theta,psi\n1,2,3,0.5,-0.2,0.3\n")
    poses, _ = read_poses(tmp_path / "a.csv", pose_format="euler-ZXZ-rad")
    assert poses[0, :3, :3] == pytest.approx(Rotation.from_euler("ZXZ", [0.5, -0.2, 0.3]).as_matrix())
    assert "about Z, X, Z" in caplog.text


@pytest.mark.parametrize("places", ["easting,northing,z", "east,north,h", "lon,latitude,height"])
def test_named_quaternions_are_read_beside_any_names_of_positions(tmp_path: Path, places: str):
    (tmp_path / "a.csv").write_text(f"{places},qw,qx,qy,qz\n1,2,3,0,0,0,1\n")
    if "lat" in places:
        with pytest.raises(uwlts.Error, match="latitudes, which are angles"):
            read_poses(tmp_path / "a.csv", pose_format="quaternion-xyzw")
        return
    poses, _ = read_poses(tmp_path / "a.csv", pose_format="quaternion-xyzw")
    assert poses[0].round(12).tolist() == [[-1, 0, 0, 1], [0, -1, 0, 2], [0, 0, 1, 3], [0, 0, 0, 1]]


def test_radians_read_as_degrees_are_doubted(tmp_path: Path, caplog: pytest.LogCaptureFixture):
    for top, doubted in ((3.14, True), (2.5, False), (30.0, False)):
        caplog.clear()
        rows = "".join(f"1,2,3,{angle},0,0\n" for angle in (-top, 0.1, top))
        (tmp_path / "a.csv").write_text(f"x,y,z,roll,pitch,yaw\n{rows}")
        read_poses(tmp_path / "a.csv", pose_format="euler-zyx-deg")
        assert ("are they radians" in caplog.text) == doubted


@pytest.mark.parametrize(
    ("header", "pose_format", "unit", "message"),
    [
        ("x_m,y_m,z_m,roll,pitch,yaw", "euler-zyx-deg", "mm", "states m, but the unit mm"),
        ("x_mm,y_mm,z_mm,roll,pitch,yaw", "euler-zyx-deg", "m", "states mm, but the unit m"),
        ("x,y,z,roll_rad,pitch_rad,yaw_rad", "euler-zyx-deg", None, "roll|yaw in rad"),
        ("x,y,z,roll [deg],pitch [deg],yaw [deg]", "euler-zyx-rad", None, "in deg, but"),
        ("x,y,z,roll [turn],pitch [turn],yaw [turn]", "euler-zyx-rad", None, "unknown unit"),
        ("x,y,z,roll,pitch,yaw", "rotvec-deg", None, "the format that the names describe"),
        ("x,y,z,roll,pitch,yaw", "euler-zyz-deg", None, "twice about one axis"),
        ("a,b,c,x,y,z", "rotvec-rad", None, "x, y and z first"),
        ("x,y,depth,roll,pitch,yaw", "euler-zyx-deg", None, "axes x, y, down, a left-handed frame .* if they are"),
        ("x,y,z,psi_rad,theta_rad,phi_rad", "euler-zyx-deg", None, "in rad, but"),
    ],
)
def test_names_that_contradict_the_format_are_refused(tmp_path, header, pose_format, unit, message):
    (tmp_path / "a.csv").write_text(f"{header}\n1,2,3,0.1,0.2,0.3\n")
    with pytest.raises(uwlts.Error, match=message):
        read_poses(tmp_path / "a.csv", pose_format=pose_format, unit=unit)


@pytest.mark.parametrize(
    "header",
    ["x,y,z\nm,m,m", 'x,y,z\n"[m]","[m]","[m]"', "x,y,z,note\nm,m,m,-", "# made in Basel\nX,Y,Z\nmetres,metres,metres"],
)
def test_a_row_of_units_below_the_names_is_obeyed(tmp_path: Path, header: str):
    rows = [",".join(f"{value / 1000:.9f}" for value in point) + ",1" * ("note" in header) for point in POINTS_MM]
    (tmp_path / "a.csv").write_text("\n".join([header, *rows]) + "\n")
    assert np.abs(read_cloud(tmp_path / "a.csv").points_mm - POINTS_MM).max() < 2e-6


def test_numbers_of_poses_have_no_gaps(tmp_path: Path, caplog: pytest.LogCaptureFixture):
    path = tmp_path / "a.csv"
    path.write_text("pose,x,y,z,rx,ry,rz\n" + "".join(f"{n},{n},0,0,0,0,0\n" for n in (1, 2, 4)))
    assert read_poses(path, pose_format="rotvec-rad")[0][:, 0, 3].tolist() == [1, 2, 4]
    assert "there is no pose between 2 and 4" in caplog.text
    path.write_text("pose,x,y,z,rx,ry,rz\n" + "".join(f"{n},{n},0,0,0,0,0\n" for n in (1, 2, 2)))
    with pytest.raises(uwlts.Error, match="pose 2 follows pose 2"):
        read_poses(path, pose_format="rotvec-rad")


def turning_left(path: Path, names: str, columns: str) -> Path:
    """A quarter circle from course east to course north in columns e, n, u, d, yaw, heading (deg)."""
    angle = np.radians(np.linspace(0, 90, 31))
    known = {"e": np.sin(angle), "n": 1 - np.cos(angle), "u": 0 * angle - 10, "d": 0 * angle + 10, "0": 0 * angle}
    known |= {"y": np.degrees(angle), "h": 90 - np.degrees(angle), "t": np.arange(31.0)}
    table = np.column_stack([known[column] for column in columns])
    np.savetxt(path, table, delimiter=",", header=names, comments="", fmt="%.9f")
    return path


@pytest.mark.parametrize(
    ("names", "columns", "first", "last"),
    [
        ("time_s,x_m,y_m,z_m,roll,pitch,yaw", "tenu00y", [1, 0, 0], [0, 1, 0]),
        ("time_s,easting_m,northing_m,height_m,roll,pitch,yaw", "tenu00y", [1, 0, 0], [0, 1, 0]),
        ("time_s,north [m],east [m],down [m],roll,pitch,heading_deg", "tned00h", [0, 1, 0], [1, 0, 0]),
        ("time_s,North_m,East_m,Depth_m,roll,pitch,azimuth", "tned00h", [0, 1, 0], [1, 0, 0]),
        ("time_s,N_m,E_m,D_m,roll,pitch,true_heading", "tned00h", [0, 1, 0], [1, 0, 0]),
        ("time_s,x_north_m,y_east_m,z_down_m,roll,pitch,HDG_deg", "tned00h", [0, 1, 0], [1, 0, 0]),
    ],
)
def test_headings_belong_to_north_east_down(tmp_path: Path, names, columns, first, last):
    path = turning_left(tmp_path / "a.csv", names, columns)
    found = uwlts.read(path, pose_format="euler-xyz-deg")
    np.testing.assert_allclose(found.poses[[0, -1], :3, 0], [first, last], atol=1e-6)
    assert np.ptp(found.poses[:, :2, 3], axis=0) == pytest.approx([1000, 1000])
    assert f"pose: x along +{'XYZ'[first.index(1)]}, y along" in "".join(trajectory_lines(found))


@pytest.mark.parametrize(
    ("names", "columns", "words"),
    [
        ("time_s,x_m,y_m,z_m,roll,pitch,heading", "tenu00h", "clockwise from north"),
        ("time_s,east_m,north_m,up_m,roll,pitch,heading", "tenu00h", "clockwise from north"),
        ("time_s,x_m,y_m,z_m,roll,pitch,course", "tenu00h", "clockwise from north"),
        ("time_s,x_m,y_m,z_m,roll,pitch,compass_heading_deg", "tenu00h", "clockwise from north"),
        ("time_s,northing,easting,height,roll,pitch,yaw", "tneu00y", "left-handed frame"),
        ("# time_s,N,E,U,roll,pitch,yaw", "tneu00y", "left-handed frame"),
        ("time_s,pos_north,pos_east,alt,roll,pitch,yaw", "tneu00y", "left-handed frame"),
        ("time_s,east,north,depth,roll,pitch,yaw", "tend00y", "left-handed frame"),
        ("time_s,northing,easting,z,roll,pitch,yaw", "tneu00y", "left-handed frame"),
    ],
)
def test_compass_angles_and_mirrored_frames_are_refused(tmp_path: Path, names, columns, words):
    with pytest.raises(uwlts.Error, match=words):
        uwlts.read(turning_left(tmp_path / "a.csv", names, columns), pose_format="euler-xyz-deg")


def test_decimal_commas_between_commas_are_refused(tmp_path: Path):
    points = np.random.default_rng(2).uniform(-20, 20, (40, 3))
    for digits in (1, 3):
        rows = [",".join(f"{value:.{digits}f}".replace(".", ",") for value in row) for row in points]
        (tmp_path / "a.csv").write_text("\n".join(rows) + "\n")
        with pytest.raises(uwlts.Error, match="commas seem to be both decimal and separators"):
            read_cloud(tmp_path / "a.csv")
    np.savetxt(tmp_path / "a.csv", np.rint(100 * np.tile(points, 2)), fmt="%d", delimiter=",")
    assert len(read_cloud(tmp_path / "a.csv")) == 40
