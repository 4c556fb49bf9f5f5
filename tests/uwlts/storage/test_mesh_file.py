"""Triangles from meshes of other programs, and damaged ones."""

import struct
from pathlib import Path

import numpy as np
import pytest
import trimesh

import uwlts
from uwlts.comparison.change_reference import read_reference
from uwlts.errors import CaptureError
from uwlts.storage.mesh_file import has_faces, load_triangles

VERTICES = np.array([[0.0, 0, 0], [10, 0, 0], [0, 10, 0], [0, 0, 10]])
FACES = np.array([[0, 2, 1], [0, 1, 3], [1, 2, 3], [0, 3, 2]])
AREA_MM2 = 3 * 50 + np.sqrt(3) / 4 * 200


@pytest.mark.parametrize("name", ["a.stl", "a.obj", "a.ply"])
def test_meshes_of_other_programs_are_read(tmp_path: Path, name: str):
    trimesh.Trimesh(VERTICES, FACES, process=False).export(tmp_path / name)
    found = load_triangles(tmp_path / name)
    assert found.area == pytest.approx(AREA_MM2, rel=1e-6), "STL has 32 bits"
    # The faces are anticlockwise from outside.
    assert found.volume == pytest.approx(1000 / 6, rel=1e-6)
    assert has_faces(tmp_path / name) == (name == "a.ply")


def test_the_vertices_of_a_mesh_are_a_cloud(tmp_path: Path):
    trimesh.Trimesh(VERTICES, FACES, process=False).export(tmp_path / "a.ply")
    np.testing.assert_array_equal(uwlts.read(tmp_path / "a.ply").points_mm, VERTICES)
    trimesh.Trimesh(VERTICES, FACES, process=False).export(tmp_path / "a.stl")
    with pytest.raises(CaptureError, match=r"a\.stl ends with \.stl; this reads captures"):
        uwlts.read(tmp_path / "a.stl")


def test_damaged_meshes_are_refused(tmp_path: Path):
    whole = trimesh.Trimesh(VERTICES, FACES, process=False).export(file_type="ply")
    (tmp_path / "a.ply").write_bytes(whole[:-20])
    with pytest.raises(CaptureError, match=r"a\.ply is not a complete"):
        load_triangles(tmp_path / "a.ply")
    (tmp_path / "a.obj").write_text("v 0 0 0\n")
    with pytest.raises(CaptureError, match=r"a\.obj"):
        load_triangles(tmp_path / "a.obj")
    with pytest.raises(CaptureError, match="no mesh at"):
        load_triangles(tmp_path / "missing.stl")


@pytest.mark.parametrize("ending", ["ply", "obj"])
def test_triangles_of_absent_vertices_are_refused(tmp_path: Path, ending: str):
    path, corners = tmp_path / f"a.{ending}", ("0 0 0", "1 0 0", "0 1 0", "0 0 1")
    if ending == "obj":
        path.write_text("".join(f"v {each}\n" for each in corners) + "f 1 2 3\nf 1 2 9\n")
    else:
        header = "ply\nformat ascii 1.0\nelement vertex 4\nproperty float x\nproperty float y\nproperty float z\n"
        header += "element face 2\nproperty list uchar int vertex_indices\nend_header\n"
        path.write_text(header + "".join(f"{each}\n" for each in corners) + "3 0 1 2\n3 0 1 8\n")
    for read in (load_triangles, lambda path: read_reference(path, unit=None, disc_mm=1.0)):
        with pytest.raises(CaptureError, match="damaged or incomplete|not a complete mesh"):
            read(path)


def test_damaged_headers_and_absurd_vertices_are_refused(tmp_path: Path):
    """trimesh alone reads a PLY whose format is misspelt."""
    content = trimesh.creation.box((9.0, 9.0, 9.0)).export(file_type="ply")
    (tmp_path / "a.ply").write_bytes(content.replace(b"binary_little_endian", b"binary_littl?_endian"))
    (tmp_path / "b.obj").write_text("v 0 0 0\nv 1e30 0 0\nv 0 1 0\nf 1 2 3\n")
    for name in ("a.ply", "b.obj"):
        with pytest.raises(CaptureError, match="not a complete PLY file|beyond 1e\\+10"):
            load_triangles(tmp_path / name)


def test_a_ply_with_two_lists_on_a_face_is_a_mesh(tmp_path: Path):
    header = "ply\nformat ascii 1.0\nelement vertex 4\nproperty float x\nproperty float y\nproperty float z\n"
    header += "element face 4\nproperty list uchar int vertex_indices\nproperty list uchar float other\nend_header\n"
    rows = [" ".join(map(str, row)) for row in VERTICES.tolist()]
    faces = FACES.tolist()
    rows += [f"3 {' '.join(map(str, face))} {n} {'0.5 ' * n}" for n, face in enumerate(faces)]
    (tmp_path / "a.ply").write_text(header + "\n".join(rows) + "\n")
    content = header.replace("ascii", "binary_little_endian").encode() + VERTICES.astype("<f4").tobytes()
    for n, face in enumerate(faces):
        content += struct.pack(f"<B3iB{n}f", 3, *face, n, *[0.5] * n)
    (tmp_path / "b.ply").write_bytes(content)
    for name in ("a.ply", "b.ply"):
        assert load_triangles(tmp_path / name).area == pytest.approx(AREA_MM2)


def test_comments_of_meshes_hold_any_bytes(tmp_path: Path):
    plain = trimesh.Trimesh(VERTICES, FACES, process=False).export(file_type="ply")
    comment = "comment Gebäude\nobj_info ".encode("latin-1") + b"\xff\xfe\n"
    (tmp_path / "a.ply").write_bytes(plain.replace(b"element vertex", comment + b"element vertex", 1))
    assert load_triangles(tmp_path / "a.ply").area == pytest.approx(AREA_MM2)


def test_a_missing_texture_is_silent(tmp_path: Path, caplog: pytest.LogCaptureFixture):
    (tmp_path / "a.mtl").write_text("newmtl m\nmap_Kd missing.png\n")
    (tmp_path / "a.obj").write_text("mtllib a.mtl\nusemtl m\nv 0 0 0\nv 1 0 0\nv 0 1 0\nvt 0 0\nf 1/1 2/1 3/1\n")
    assert load_triangles(tmp_path / "a.obj").area == pytest.approx(0.5) and not caplog.records
