"""The unit of clouds and meshes of other programs: given by an option, or stated by the file."""

import re
import struct
from pathlib import Path

import laspy
import numpy as np
import pye57
import pytest
import trimesh
from laspy.vlrs.known import WktCoordinateSystemVlr
from laspy.vlrs.vlrlist import VLRList

import uwlts
from tests.uwlts.mount_views import sphere_campaign
from uwlts.cli import app
from uwlts.storage.cloud import make_foreign_cloud
from uwlts.storage.cloud_files import read_cloud, read_region, write_cloud, write_ply_points
from uwlts.storage.mesh_file import load_triangles

POINTS_MM = np.random.default_rng(1).uniform(-50, 50, (400, 3))


def write(path: Path, points: np.ndarray) -> Path:
    """A cloud as other programs write it."""
    if path.suffix == ".ply":
        write_ply_points(path, dict(zip("xyz", points.T, strict=True)), overwrite=True)
    else:
        np.savetxt(path, points, fmt="%.9f")
    return path


@pytest.mark.parametrize("ending", [".ply", ".xyz", ".txt", ".asc"])
def test_a_cloud_in_metres_is_read_as_told(tmp_path: Path, ending: str):
    path = write(tmp_path / f"a{ending}", POINTS_MM / 1000)
    for found in (read_cloud(path, unit="m"), uwlts.read(path, unit="m") if ending in (".ply", ".xyz") else None):
        assert found is None or np.abs(found.points_mm - POINTS_MM).max() < 1e-5
    region = read_region(path, (-1e3,) * 3, (1e3,) * 3, unit="m")
    assert len(region) == len(POINTS_MM) and np.abs(region.points_mm - POINTS_MM).max() < 1e-5


@pytest.mark.parametrize(("ending", "wrong", "stated"), [(".las", "mm", "m"), (".h5", "m", "mm"), (".ply", "m", "mm")])
def test_a_format_that_states_its_unit_is_obeyed(tmp_path: Path, ending: str, wrong: str, stated: str):
    path = tmp_path / f"a{ending}"
    cloud = make_foreign_cloud(POINTS_MM)
    cloud.metadata["sensor"] = "some"
    write_cloud(path, cloud)
    with pytest.raises(uwlts.Error, match=f"is in {stated}, as its format prescribes, but the unit {wrong} was given"):
        read_cloud(path, unit=wrong)
    assert np.abs(read_cloud(path, unit=stated).points_mm - POINTS_MM).max() < 1e-4


@pytest.mark.parametrize(("ending", "unit"), [(".ply", "mm"), (".xyz", "mm"), (".las", "m"), (".e57", "m")])
def test_export_reads_text_and_says_the_unit_that_it_wrote(tmp_path: Path, capsys, ending: str, unit: str):
    path = write(tmp_path / "a.txt", POINTS_MM / 1000)
    out = tmp_path / f"b{ending}"
    app(["export", str(path), "--out", str(out), "--unit", "m"], result_action="return_value")
    assert f"with {len(POINTS_MM)} points in {unit}\n" in capsys.readouterr().out
    # LAS has steps of 1e-4 mm, E57 32-bit numbers, and text nine decimals of a metre.
    assert np.abs(read_cloud(out).points_mm - POINTS_MM).max() < 6e-5


def las_with(path: Path, *, keys: tuple[tuple[int, int], ...] = (), wkt: str = "", evlr: bool = False) -> Path:
    """A LAS file of three points at 1, 2 and 3 units, whose coordinate system states the unit."""
    header = laspy.LasHeader(version="1.4", point_format=6)
    header.scales = [1e-4] * 3
    if keys:
        numbers = [1, 1, 0, len(keys), *(number for key, value in keys for number in (key, 0, 1, value))]
        content = struct.pack(f"<{len(numbers)}H", *numbers)
        header.vlrs.append(laspy.VLR("LASF_Projection", 34735, record_data=content))
    table = laspy.LasData(header)
    table.x = table.y = table.z = np.array([1.0, 2.0, 3.0])
    if wkt:
        table.evlrs = VLRList() if evlr else None
        (table.evlrs if evlr else header.vlrs).append(WktCoordinateSystemVlr(wkt))
    table.write(path)
    return path


FOOT, SURVEY = 304.8, 1200e3 / 3937
GEOGRAPHIC = 'GEOGCS["NAD83",DATUM["d",SPHEROID["s",6378137,298.3]],UNIT["degree",0.0174532925199433]]'
PLANE = f'PROJCS["p",{GEOGRAPHIC},PARAMETER["false_easting",0],UNIT["US survey foot",0.3048006096012192]]'
PLANE_2 = (
    'PROJCRS["p",BASEGEOGCRS["b",DATUM["d",ELLIPSOID["e",6378137,298.3,LENGTHUNIT["metre",1]]]],CONVERSION["c",'
    'PARAMETER["e",0,LENGTHUNIT["metre",1]]],CS[Cartesian,2],AXIS["x",east],LENGTHUNIT["foot",0.3048]]'
)


@pytest.mark.parametrize(
    ("given", "across", "height"),
    [
        ({"keys": ((1024, 1), (3076, 9001))}, 1000, 1000),
        ({"keys": ((3072, 32632),)}, 1000, 1000),
        ({"keys": ((3076, 9002),)}, FOOT, FOOT),
        ({"keys": ((3076, 9003), (4099, 9001))}, SURVEY, 1000),
        ({"wkt": PLANE}, SURVEY, SURVEY),
        ({"wkt": f'COMPD_CS["c",{PLANE},VERT_CS["h",VERT_DATUM["v",2005],UNIT["metre",1]]]'}, SURVEY, 1000),
        ({"wkt": PLANE_2}, FOOT, FOOT),
        ({"wkt": PLANE, "evlr": True}, SURVEY, SURVEY),
    ],
)
def test_las_is_in_the_unit_of_its_coordinate_system(tmp_path: Path, given, across, height):
    found = uwlts.read(las_with(tmp_path / "a.las", **given))
    np.testing.assert_allclose(found.points_mm, np.outer([1, 2, 3], [across, across, height]), rtol=1e-6)
    assert bool(found.warnings) is (across != 1000)


def test_las_in_degrees_and_unknown_units_is_refused(tmp_path: Path):
    for given in ({"keys": ((1024, 2),)}, {"wkt": GEOGRAPHIC}, {"keys": ((3076, 9040),)}):
        with pytest.raises(uwlts.Error, match="convert it to a coordinate system in m first"):
            uwlts.read(las_with(tmp_path / "a.las", **given))
    with pytest.raises(uwlts.Error, match="states the unit foot, but the unit m was given"):
        uwlts.read(las_with(tmp_path / "a.las", keys=((3076, 9002),)), unit="m")
    (plain,) = uwlts.read(las_with(tmp_path / "a.las", wkt='PROJCS["no unit"]')).warnings
    assert "states no unit of length" in plain
    assert "is it in feet" in uwlts.read(las_with(tmp_path / "a.las", keys=((3072, 2927),))).warnings[0]


def test_comments_of_ply_obj_and_stl_state_a_unit(tmp_path: Path, caplog: pytest.LogCaptureFixture):
    columns = dict(zip("xyz", POINTS_MM.T / 1000, strict=True))
    for comment in ("unit: m", "Units = meters"):
        write_ply_points(tmp_path / "a.ply", columns, comments=[comment], overwrite=True)
        assert np.abs(uwlts.read(tmp_path / "a.ply").points_mm - POINTS_MM).max() < 1e-9
        with pytest.raises(uwlts.Error, match="states m, but the unit mm was given"):
            uwlts.read(tmp_path / "a.ply", unit="mm")
    (tmp_path / "a.ply").write_bytes((tmp_path / "a.ply").read_bytes().replace(b"comment Units =", b"obj_info units "))
    assert np.abs(uwlts.read(tmp_path / "a.ply").points_mm - POINTS_MM).max() < 1e-9
    write_ply_points(tmp_path / "a.ply", columns, comments=["coordinates in metres"], overwrite=True)
    assert np.abs(uwlts.read(tmp_path / "a.ply").points_mm - POINTS_MM / 1000).max() < 1e-9
    assert "may state another unit" in caplog.text
    box = trimesh.creation.box((1.0, 1.0, 1.0))
    (tmp_path / "a.obj").write_text("# File units = inches\n" + box.export(file_type="obj"))
    content = box.export(file_type="stl")
    (tmp_path / "a.stl").write_bytes(b"by some program;UNITS=in".ljust(80, b"\0") + content[80:])
    for name in ("a.obj", "a.stl"):
        assert load_triangles(tmp_path / name).area == pytest.approx(6 * 25.4**2)


def write_e57(path: Path, system: str, monkeypatch: pytest.MonkeyPatch) -> None:
    """Write points with a coordinate system; the library writes an empty one."""
    plain = pye57.libe57.StringNode
    with monkeypatch.context() as patch:
        patch.setattr(pye57.libe57, "StringNode", lambda image, text="": plain(image, text or system))
        write_cloud(path, make_foreign_cloud(POINTS_MM))


def test_e57_in_feet_is_asked_about(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    write_e57(tmp_path / "b.e57", PLANE, monkeypatch)
    with pytest.raises(uwlts.Error, match="in US survey foot, but E57 prescribes m"):
        uwlts.read(tmp_path / "b.e57")
    assert np.abs(uwlts.read(tmp_path / "b.e57", unit="m").points_mm - POINTS_MM).max() < 1e-3


@pytest.mark.parametrize(("system", "warned"), [("EPSG:2225", True), ("units: feet", True), ("", False)])
def test_e57_in_a_system_of_unknown_unit_is_warned_of(tmp_path: Path, monkeypatch, system: str, warned: bool):
    write_e57(tmp_path / "a.e57", system, monkeypatch)
    assert (
        any("states no unit of length: read in m" in text for text in uwlts.read(tmp_path / "a.e57").warnings) == warned
    )
    assert not uwlts.read(tmp_path / "a.e57", unit="m").warnings


def test_glb_is_in_metres(tmp_path: Path):
    # Axes of glTF: y up, z towards the viewer.
    corners = np.array([[-0.05, -0.005, 0.05], [-0.05, -0.005, -0.05], [0.05, -0.005, 0.05], [0.05, -0.005, -0.05]])
    trimesh.Trimesh(corners, [[0, 1, 2], [2, 1, 3]]).export(tmp_path / "plate.glb")
    x, y = np.meshgrid(np.linspace(-45, 45, 40), np.linspace(-45, 45, 40))
    write(tmp_path / "top.ply", np.column_stack([x.ravel(), y.ravel(), np.full(x.size, -5.25)]))
    change = uwlts.compare_clouds(tmp_path / "top.ply", tmp_path / "plate.glb")
    assert np.nanmedian(np.abs(change.distance_mm)) == pytest.approx(0.25, abs=0.01)
    with pytest.raises(uwlts.Error, match="states m, but the unit mm was given"):
        uwlts.compare_clouds(tmp_path / "top.ply", tmp_path / "plate.glb", reference_unit="mm")


@pytest.mark.parametrize("which", ["profile_unit", "pose_unit"])
def test_a_mount_in_metres_is_named_at_once(which: str):
    campaign = sphere_campaign(np.random.default_rng(3), poses=8)
    profiles, poses = [np.array(each) for each in campaign.profiles], np.array(campaign.poses)
    if which == "pose_unit":
        poses[:, :3, 3] /= 1000
    else:
        profiles = [each / 1000 for each in profiles]
    with pytest.raises(uwlts.Error, match=re.escape(f"`{which}` m")):
        uwlts.calibrate_mount(profiles, poses, radius_mm=20.0)
