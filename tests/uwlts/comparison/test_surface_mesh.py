"""Meshes of exactly simulated scans: error against the true surface, stated uncertainty, holes and thin walls."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import trimesh

import uwlts
from uwlts.cli import app
from uwlts.comparison import surface_mesh
from uwlts.comparison.change_reference import read_reference
from uwlts.comparison.surface_mesh import _measure_walls, _orient_faces, _remove_small_pieces, _split_scans
from uwlts.errors import CaptureError, EvaluationError, OutputError
from uwlts.fitting.local_surface import SurfacePoints, surface_normals
from uwlts.storage.cloud import PAIRS, PointCloud, PointUncertainty
from uwlts.storage.mesh_file import read_mesh
from uwlts.storage.ply import read_ply

NOISE_MM, IMAGES_MM, STRIPE_MM = 0.02, 0.5, 0.25


def scan(rng, surface, *, half=15.0, turn=None, noise=NOISE_MM, shift=0.0):
    """A cloud of z(x, y), NaN where nothing is seen, by images along x; noise and a shared shift along the view."""
    along = np.arange(-half, half, IMAGES_MM)
    x, y = np.meshgrid(along, np.arange(-half, half, STRIPE_MM), indexing="ij")
    frame = np.repeat(np.arange(len(along)), x.shape[1])
    x, y = x.ravel(), y.ravel() + rng.uniform(-0.1, 0.1, x.size)
    points = np.column_stack([x, y, surface(x, y)])
    seen = np.isfinite(points[:, 2])
    turn = np.eye(3) if turn is None else turn
    points, view, count = points[seen] @ turn.T, turn @ [0.0, 0.0, 1.0], np.count_nonzero(seen)
    random = np.tile([noise**2 * view[i] * view[j] for i, j in PAIRS], (count, 1))
    pattern = np.tile(shift * view, (1, count, 1))
    points = points + noise * rng.standard_normal((count, 1)) * view + rng.standard_normal() * shift * view
    known = PointUncertainty(*(a.astype(np.float32) for a in (random, np.zeros((count, 3)), pattern)))
    return PointCloud(points, np.ones(count), frame[seen], np.zeros(count, int), uncertainty=known)


def about_y(degrees):
    c, s = np.cos(np.radians(degrees)), np.sin(np.radians(degrees))
    return np.array([[c, 0, s], [0, 1, 0], [-s, 0, c]])


def body(surface):
    return trimesh.Trimesh(surface.vertices_mm, surface.faces, process=False)


def assert_stated(error, surface):
    """Errors scatter as stated: the mean of some hundred independent patches' squares is known to a few per cent."""
    assert 0.8 < np.sqrt(np.mean((error / surface.std_mm) ** 2)) < 1.25


@pytest.mark.slow
def test_a_sphere_and_what_is_stated():
    rng, radius = np.random.default_rng(1), 20.0

    def cap(x, y):
        square = np.where(np.hypot(x, y) < 14, radius**2 - x**2 - y**2, np.nan)
        return -np.sqrt(square)

    surface = uwlts.mesh(scan(rng, cap))
    error = np.linalg.norm(surface.vertices_mm, axis=1) - radius
    # Noise of 0.02 mm over patches of 60 points with six coefficients, weights and all: a quarter of it.
    assert np.sqrt(np.mean(error**2)) < 0.3 * NOISE_MM and abs(error.mean()) < 0.02 * NOISE_MM * 3
    assert_stated(error, surface)
    outwards = np.einsum("ni,ni->n", surface.normals, surface.vertices_mm) / radius
    assert outwards.min() > 0.99
    # Triangles face outwards as well, and cover what was seen but for half a cube along the rim.
    assert body(surface).face_normals[:, 2].mean() < 0
    seen = 2 * np.pi * radius * (radius - np.sqrt(radius**2 - 14**2))
    assert seen - 2 * np.pi * 14 * 2 * surface.cube_mm < surface.area_mm2() < seen + 2 * np.pi * 14 * surface.cube_mm
    assert surface.left_out == 0


def test_a_step_stays_open_where_its_wall_was_not_seen():
    rng = np.random.default_rng(2)
    surface = uwlts.mesh(scan(rng, lambda x, y: np.where(x < 0, 0.0, 5.0)))
    assert body(surface).body_count == 2
    z = surface.vertices_mm[:, 2]
    error = np.where(z < 2.5, z, z - 5.0)
    flat = np.abs(surface.vertices_mm[:, 0]) > 2 * surface.radius_mm
    # Five standard deviations of a vertex: one of a million.
    assert np.abs(error[flat]).max() < 5.5 * surface.std_mm[flat].max()
    # At the edge the normals are those of both faces; no vertex leaves its face by more than the cubes.
    assert np.abs(error).max() < 0.5 * surface.cube_mm


@pytest.mark.parametrize("thickness", [1.0, 0.4])
def test_a_thin_wall_keeps_both_sides_and_its_hole(thickness):
    rng = np.random.default_rng(3)

    def plate(x, y):
        return np.where(np.hypot(x, y) > 4, 0.0, np.nan)

    front = scan(rng, plate, half=10.0)
    back = scan(rng, lambda x, y: plate(x, y) - thickness, half=10.0, turn=about_y(180))
    surface = uwlts.mesh(front, back, towards=[(0, 0, -1), (0, 0, 1)])
    assert body(surface).body_count == 2
    before = surface.normals[:, 2] < 0
    error = surface.vertices_mm[:, 2] - np.where(before, 0.0, thickness)
    assert 0.4 < before.mean() < 0.6 and np.sqrt(np.mean(error**2)) < 0.5 * NOISE_MM
    assert_stated(error, surface)
    assert np.hypot(*surface.vertices_mm[:, :2].T).min() > 4 - surface.radius_mm / 2


def test_the_better_of_two_clouds_counts_more():
    """One of two clouds of a plane has ten times the shared error."""
    rng = np.random.default_rng(4)
    good, bad = scan(rng, lambda x, y: 0 * x, shift=0.005), scan(rng, lambda x, y: 0 * x + 0.2, shift=0.05)
    surface = uwlts.mesh(good, bad)
    # Weights of 1 / (0.02^2 + 0.005^2) and 1 / (0.02^2 + 0.05^2) move the mean by an eighth of the difference.
    share = (1 / (NOISE_MM**2 + 0.05**2)) / (1 / (NOISE_MM**2 + 0.05**2) + 1 / (NOISE_MM**2 + 0.005**2))
    expected = share * bad.points_mm[:, 2].mean() + (1 - share) * good.points_mm[:, 2].mean()
    assert surface.vertices_mm[:, 2].mean() == pytest.approx(expected, abs=0.003)
    shared = np.hypot(share * 0.05, (1 - share) * 0.005)
    assert np.median(surface.shared_mm) == pytest.approx(shared, rel=0.05)


def test_a_pipe_of_three_scans_is_one_surface():
    rng, radius = np.random.default_rng(5), 12.0

    def side(x, y):
        square = np.where(np.abs(x) < 0.93 * radius, radius**2 - x**2, np.nan)
        return -np.sqrt(square)

    turns = [about_y(angle) for angle in (0, 120, 240)]
    # Merged as `uwlts register` does: the directions follow from the scans' poses.
    scans = [scan(rng, side, turn=turn) for turn in turns]
    count = [int(each.frame.max()) + 1 for each in scans]
    listed = []
    for number, turn in enumerate(turns):
        pose = np.eye(4)
        pose[:3, :3] = turn
        listed.append({"name": str(number), "first_frame": sum(count[:number]), "pose": pose.tolist()})
    known = [each.uncertainty for each in scans]
    merged = PointCloud(
        np.concatenate([each.points_mm for each in scans]),
        np.concatenate([each.intensity for each in scans]),
        np.concatenate([each.frame + sum(count[:k]) for k, each in enumerate(scans)]),
        np.concatenate([each.line for each in scans]),
        uncertainty=PointUncertainty(
            np.concatenate([each.random_mm2 for each in known]),
            np.concatenate([each.position_mm for each in known]),
            np.concatenate([each.patterns_mm for each in known], axis=1),
        ),
        metadata={"scans": listed},
    )
    surface = uwlts.mesh(merged)
    error = np.hypot(surface.vertices_mm[:, 0], surface.vertices_mm[:, 2]) - radius
    assert body(surface).body_count == 1 and np.sqrt(np.mean(error**2)) < 0.5 * NOISE_MM
    assert surface.area_mm2() == pytest.approx(2 * np.pi * radius * 30, rel=0.03)


def test_files_hold_the_mesh(tmp_path, monkeypatch):
    rng = np.random.default_rng(6)
    monkeypatch.chdir(tmp_path)
    scan(rng, lambda x, y: 0.02 * x * y, half=6.0).save("scan.ply")
    for name in ("mesh.ply", "mesh.stl", "mesh.glb"):
        app(["mesh", "scan.ply", "--out", name, "--towards", "0", "0", "-1"], result_action="return_value")
    table, _ = read_ply(Path("mesh.ply"), "vertex", called="mesh")
    vertices = np.column_stack([table[axis] for axis in "xyz"])
    assert np.median(table["uncertainty"]) == pytest.approx(0.3 * NOISE_MM, rel=0.5)
    assert len(trimesh.load("mesh.ply").faces) == len(trimesh.load("mesh.stl").faces)
    scene = trimesh.load("mesh.glb")
    (geometry,) = scene.geometry.values()
    placed = scene.to_geometry().vertices
    # glTF has y up: z of the cloud.
    np.testing.assert_allclose(1e3 * placed @ [[1, 0, 0], [0, 0, 1], [0, -1, 0]], vertices, atol=1e-4)
    np.testing.assert_allclose(uwlts.read("mesh.glb").vertices_mm, vertices, atol=1e-4)
    assert len(geometry.vertex_attributes["_uncertainty"]) == len(vertices)
    with pytest.raises(OutputError, match=r"mesh.obj ends with none of"):
        app(["mesh", "scan.ply", "--out", "mesh.obj"], result_action="return_value")


def test_wrong_requests_are_refused():
    rng = np.random.default_rng(7)
    cloud = scan(rng, lambda x, y: 0 * x, half=3.0)
    with pytest.raises(EvaluationError, match="at least one"):
        uwlts.mesh()
    with pytest.raises(EvaluationError, match="`cube_mm` is 0"):
        uwlts.mesh(cloud, cube_mm=0)
    with pytest.raises(EvaluationError, match="at most the patches' radius"):
        uwlts.mesh(cloud, cube_mm=3, patch_radius_mm=2)
    with pytest.raises(EvaluationError, match="the directions are not valid; expected"):
        uwlts.mesh(cloud, towards=[(0, 0, -1), (0, 0, 1)])
    with pytest.raises(EvaluationError, match="points may be too sparse"):
        uwlts.mesh(cloud, patch_radius_mm=0.2)
    few = PointCloud(cloud.points_mm[:9], cloud.intensity[:9], cloud.frame[:9], cloud.line[:9])
    with pytest.raises(EvaluationError, match="has 9 points"):
        uwlts.mesh(few)


@pytest.mark.parametrize("ending", ["ply", "obj"])
def test_triangles_of_absent_vertices_are_refused(tmp_path, ending):
    path, corners = tmp_path / f"a.{ending}", ("0 0 0", "1 0 0", "0 1 0", "0 0 1")
    if ending == "obj":
        path.write_text("".join(f"v {each}\n" for each in corners) + "f 1 2 3\nf 1 2 9\n")
    else:
        header = "ply\nformat ascii 1.0\nelement vertex 4\nproperty float x\nproperty float y\nproperty float z\n"
        header += "element face 2\nproperty list uchar int vertex_indices\nend_header\n"
        path.write_text(header + "".join(f"{each}\n" for each in corners) + "3 0 1 2\n3 0 1 8\n")
    for read in (read_mesh, lambda path: read_reference(path, unit=None, disc_mm=1.0)):
        with pytest.raises(CaptureError, match="damaged or incomplete|not a complete mesh"):
            read(path)


def test_damaged_headers_and_absurd_vertices_are_refused(tmp_path):
    """trimesh alone reads a PLY whose format is misspelt."""
    content = trimesh.creation.box((9.0, 9.0, 9.0)).export(file_type="ply")
    (tmp_path / "a.ply").write_bytes(content.replace(b"binary_little_endian", b"binary_littl?_endian"))
    (tmp_path / "b.obj").write_text("v 0 0 0\nv 1e30 0 0\nv 0 1 0\nf 1 2 3\n")
    for name in ("a.ply", "b.obj"):
        with pytest.raises(CaptureError, match="not a complete PLY file|beyond 1e\\+10"):
            read_mesh(tmp_path / name)


def test_noise_makes_no_walls(monkeypatch):
    """Patches of 0.7 mm about points with 0.3 mm of noise have normals of all directions."""
    rng, count = np.random.default_rng(9), 20_000
    points = np.column_stack([rng.uniform(-7, 7, (count, 2)), 0.3 * rng.normal(size=count)])
    normals = surface_normals(points, radius_mm=0.7, towards=np.array([0.0, 0.0, -1.0]))
    rest = (
        np.ones(count),
        np.zeros(count),
        np.zeros(count),
        np.arange(count),
        np.zeros((0, count)),
        np.zeros(count, int),
    )
    found = SurfacePoints(points, normals, *rest)
    assert _measure_walls(found, 0.7) == np.inf
    monkeypatch.setattr(surface_mesh, "_RESOLVED", 0.0)
    assert _measure_walls(found, 0.7) < 0.1


def test_the_thinnest_wall_is_that_of_opposite_normals():
    """Plates 1.5 mm apart with outward normals, also turned; facing each other across a gap, they form no wall."""
    flat = np.random.default_rng(8).uniform(-10, 10, (3000, 2))
    upper = np.arange(3000) % 2 == 0
    turn = about_y(70.0)
    points = np.column_stack([flat, np.where(upper, 0.0, -1.5)]) @ turn.T
    up = np.where(upper, 1.0, -1.0)[:, None] * turn[:, 2]
    rest = np.ones(3000), np.zeros(3000), np.zeros(3000), np.zeros(3000, int), np.zeros((0, 3000)), np.zeros(3000, int)
    assert _measure_walls(SurfacePoints(points, up, *rest), 2.0) == pytest.approx(1.5)
    assert _measure_walls(SurfacePoints(points, -up, *rest), 2.0) == np.inf
    assert _measure_walls(SurfacePoints(points, up, *rest), 1.4) == np.inf


def test_triangles_face_outwards_and_small_pieces_go():
    sheet = trimesh.creation.icosphere(subdivisions=2)
    faces = np.where((np.arange(len(sheet.faces)) % 3 == 0)[:, None], sheet.faces[:, [0, 2, 1]], sheet.faces)
    flat = [[0, 0, 1]]
    oriented = _orient_faces(sheet.vertices, np.vstack([faces, flat]), sheet.vertices)
    assert len(oriented) == len(faces)
    assert (trimesh.Trimesh(sheet.vertices, oriented, process=False).volume) == pytest.approx(sheet.volume)
    # A triangle beside the sphere, and vertices without a triangle.
    first = len(sheet.vertices) + 4
    used, kept = _remove_small_pieces(np.vstack([[[first, first + 1, first + 2]], oriented + 2]), first + 3)
    np.testing.assert_array_equal(used, 2 + np.arange(len(sheet.vertices)))
    np.testing.assert_array_equal(kept, oriented)


def test_a_merged_cloud_is_split_by_its_images():
    """Each scan has the direction to its sensor, -Z of its pose; a given direction counts for the whole cloud."""
    frame, poses = np.array([0, 1, 2, 5, 6, 6]), [np.eye(4), np.eye(4)]
    poses[1][:3, :3] = about_y(90.0)
    listed = [{"first_frame": first, "pose": pose.tolist()} for first, pose in zip((0, 5), poses, strict=True)]
    cloud = PointCloud(np.arange(18.0).reshape(6, 3), np.ones(6), frame, np.arange(6), metadata={"scans": listed})
    (one, front), (other, side) = _split_scans(cloud, None)
    np.testing.assert_array_equal(one.frame, [0, 1, 2])
    np.testing.assert_array_equal(other.points_mm, cloud.points_mm[3:])
    np.testing.assert_allclose([front, side], [[0, 0, -1], [-1, 0, 0]], atol=1e-12)
    ((whole, way),) = _split_scans(cloud, np.array([0.0, 3.0, 4.0]))
    assert len(whole) == 6 and way == pytest.approx([0, 0.6, 0.8])
    with pytest.raises(EvaluationError, match="list of scans is not valid"):
        _split_scans(replace(cloud, metadata={"scans": [{"first_frame": 0}]}), None)
