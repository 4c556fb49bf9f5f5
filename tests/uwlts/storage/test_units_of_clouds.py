"""The unit of clouds and meshes of other programs: given by an option, or stated by the file."""

import re
from pathlib import Path

import numpy as np
import pytest
import trimesh

import uwlts
from tests.uwlts.mount_views import sphere_campaign
from uwlts.cli import app
from uwlts.storage.cloud import make_foreign_cloud
from uwlts.storage.cloud_files import read_cloud, read_region, write_cloud, write_ply_points

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


def test_glb_is_in_metres(tmp_path: Path):
    corners = np.array([[-0.05, -0.05, -0.005], [-0.05, 0.05, -0.005], [0.05, -0.05, -0.005], [0.05, 0.05, -0.005]])
    trimesh.Trimesh(corners, [[0, 1, 2], [2, 1, 3]]).export(tmp_path / "plate.glb")
    x, y = np.meshgrid(np.linspace(-45, 45, 40), np.linspace(-45, 45, 40))
    write(tmp_path / "top.ply", np.column_stack([x.ravel(), y.ravel(), np.full(x.size, -5.25)]))
    change = uwlts.compare_clouds(tmp_path / "top.ply", tmp_path / "plate.glb")
    assert np.nanmedian(np.abs(change.distance_mm)) == pytest.approx(0.25, abs=0.01)
    with pytest.raises(uwlts.Error, match="is in m, as glTF prescribes"):
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
