"""A measured surface as triangles, and its files: STL, PLY with the uncertainty of every vertex, and binary glTF."""

from __future__ import annotations

import math
import os
import re
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from uwlts.argument_types import check_arguments
from uwlts.errors import CaptureError, OutputError
from uwlts.files.reading import log_warnings, open_regular, require_regular_file
from uwlts.files.writing import write_file
from uwlts.model.sensor import Table
from uwlts.model.short_text import Brief
from uwlts.storage.cloud import FARTHEST_SINGLE_MM
from uwlts.storage.number_tables import Unit, choose_scale, find_stated_unit
from uwlts.storage.ply import encode_ply, read_comments, read_ply

if TYPE_CHECKING:
    import trimesh

MESH_FORMATS = (".stl", ".ply", ".glb")
READ_FORMATS = (".ply", ".stl", ".obj", ".glb")
"""Endings of the meshes that can be read."""

_Y_UP = (".glb", ".gltf")
_TO_Z_UP = np.array([[1.0, 0, 0], [0, 0, -1], [0, 1, 0]])
"""Rotation from glTF's axes, whose y axis points up."""
_LONGEST_START = 2**16  # bytes in which comments are looked for
_FARTHEST = 1e10
"""Largest coordinate in the file's unit: in mm the circumference of the Earth is 4e10; larger ones are damage."""


@dataclass(frozen=True, eq=False, repr=False)
class SurfaceMesh(Brief):
    """Triangles with the uncertainty of their vertices.

    Attributes
    ----------
    vertices_mm, normals : (V, 3) float64
        Vertices in the clouds' frame, and unit normals at them, towards the sensor.
    faces : (F, 3) int64
        Vertices of each triangle, anticlockwise from the sensor.
    noise_mm, shared_mm : (V,) float64
        Standard uncertainty along the normal due to noise and the positions of images, and due to errors common to a
        scan; 0 if the clouds do not state it.
    cube_mm, radius_mm : float
        Edge of the cubes, and radius of the patches; NaN for a mesh from a file.
    left_out : float
        Fraction of the clouds' points farther from the mesh than the patches' radius; NaN for a mesh from a file.
    metadata : dict
        Origin of the clouds; empty for a mesh from a file.
    """

    vertices_mm: np.ndarray
    normals: np.ndarray
    faces: np.ndarray
    noise_mm: np.ndarray
    shared_mm: np.ndarray
    cube_mm: float = math.nan
    radius_mm: float = math.nan
    left_out: float = math.nan
    metadata: Table = field(default_factory=dict)

    @property
    def std_mm(self) -> np.ndarray:
        """Standard uncertainty (V,) of each vertex along its normal, mm."""
        return np.hypot(self.noise_mm, self.shared_mm)

    def area_mm2(self) -> float:
        """Return the area of all triangles."""
        a, b, c = (self.vertices_mm[self.faces[:, k]] for k in range(3))
        return float(np.linalg.norm(np.cross(b - a, c - a), axis=1).sum() / 2)

    def lines(self) -> list[str]:
        """Return the summary as lines of text."""
        lines = [
            f"mesh                      {len(self.vertices_mm)} vertices, {len(self.faces)} triangles, "
            f"{self.area_mm2():.5g} mm2"
        ]
        # Meshes of other programs state none.
        if self.std_mm.any():
            std = np.quantile(self.std_mm, [0.5, 0.95])
            lines.append(f"standard uncertainty, mm  {std[0]:.4f} (median), {std[1]:.4f} (95 % of the vertices)")
        if math.isfinite(self.cube_mm):
            lines.insert(1, f"cubes, patches            {self.cube_mm:.3g} mm, radius {self.radius_mm:.3g} mm")
            lines.append(f"points without a surface  {100 * self.left_out:.2f} %")
        return lines

    @check_arguments
    def save(self, path: str | os.PathLike[str], *, overwrite: bool = False) -> None:
        """Write the mesh in the format of the path's ending, completely or not at all.

        - ``.ply``: binary, mm. Vertices have x, y, z (double), nx, ny, nz, and the standard uncertainty along the
          normal: uncertainty, and its parts uncertainty_noise and uncertainty_shared (float, mm).
        - ``.glb``: glTF 2.0, in m about the origin of the mesh's node, with normals and the attribute _uncertainty
          (mm).
        - ``.stl``: binary, mm, triangles alone.

        Raises
        ------
        OutputError
            The ending is unknown, or the mesh is too far from the origin for STL. The file exists and ``overwrite`` is
            not set, or it cannot be written.
        """
        path = Path(path)
        if (encode := {".ply": _encode_ply, ".stl": _encode_stl, ".glb": _encode_glb}.get(path.suffix.lower())) is None:
            raise OutputError(f"{path} ends with none of {', '.join(MESH_FORMATS)}, which name the format of a mesh")
        content = encode(self)
        write_file(path, content, overwrite=overwrite)


def has_faces(path: Path) -> bool:
    """Return whether a PLY file contains a mesh rather than a cloud, by its header."""
    with open_regular(path, called="mesh or cloud") as file:
        header = file.read(2**20).partition(b"end_header")[0]
    found = re.search(rb"^element +face +0*[1-9]", header, flags=re.MULTILINE)
    return header.startswith(b"ply") and found is not None


def load_triangles(path: Path, *, unit: Unit | None = None) -> trimesh.Trimesh:
    """Load the triangles of a mesh in any format of trimesh, in mm and with z up.

    The unit is that which the format prescribes or a comment states, else ``unit``, by default mm. Raises CaptureError
    if the file is missing, damaged or without triangles, vertices are not finite, or the unit is not ``unit``.
    """
    import trimesh

    require_regular_file(path, called="mesh")
    ending = path.suffix.lower()
    if ending == ".ply":
        loaded: Any = trimesh.Trimesh(*_read_ply_triangles(path), process=False)
    else:
        try:
            loaded = trimesh.load(str(path), force="mesh", process=False, skip_materials=True)
        except Exception as error:
            # trimesh passes on all exceptions of its parsers.
            raise CaptureError(f"{path} is not a complete mesh (such as .stl, .obj, .off or .ply): {error}") from error
    vertices, faces = np.asarray(loaded.vertices), np.asarray(loaded.faces)
    if vertices.shape[1:] != (3,) or faces.shape[1:] != (3,):
        raise CaptureError(f"{path} is not a complete mesh: expected vertices and triangles of three numbers each")
    if not len(faces) or not (np.abs(vertices) < _FARTHEST).all():
        raise CaptureError(f"{path} has no triangles, or vertices that are not finite or beyond {_FARTHEST:g}")
    if faces.min() < 0 or faces.max() >= len(vertices):
        raise CaptureError(
            f"{path} has {len(vertices)} vertices, and triangles of the vertices {faces.min()} to {faces.max()}: the "
            "file is damaged or incomplete"
        )
    stated, doubts = _find_unit(path, loaded.units)
    log_warnings(path, doubts)
    if (scale := choose_scale(stated, unit, path, CaptureError)) != 1 or ending in _Y_UP:
        loaded.vertices = scale * vertices @ (_TO_Z_UP if ending in _Y_UP else np.eye(3)).T
    return loaded


def _find_unit(path: Path, known: str | None) -> tuple[str, list[str]]:
    """Return the unit that a mesh's format or comments state, empty without, and doubts; ``known`` is trimesh's."""
    match path.suffix.lower():
        case ".glb" | ".gltf":
            return "m", []
        case ".ply":
            return find_stated_unit(read_comments(path))
    with open_regular(path, called="mesh") as file:
        start = file.read(_LONGEST_START).decode("latin-1")
    comments = [line for line in start.splitlines() if line.startswith("#")]
    # Programs write such entries into the first 80 bytes of STL.
    comments += re.split("[;,\0]", start[:80]) if path.suffix.lower() == ".stl" else []
    return find_stated_unit([*comments, *([f"unit: {known}"] if known else [])])


def _read_ply_triangles(path: Path) -> tuple[np.ndarray, np.ndarray]:
    """Read the vertices (V, 3) and triangles (F, 3) of a PLY file; polygons become fans."""
    vertices, faces = (read_ply(path, element, called="mesh")[0] for element in ("vertex", "face"))
    if vertices is None or faces is None or not {"x", "y", "z"} <= {*(vertices.dtype.names or ())}:
        raise CaptureError(f"{path} is not a complete mesh: expected vertices with x, y and z, and faces")
    lists = [faces[name] for name in ("vertex_indices", "vertex_index") if name in (faces.dtype.names or ())]
    polygons = lists[0] if lists else np.empty((0, 3))
    sizes = {polygons.shape[1]} if polygons.ndim == 2 else {len(each) for each in polygons}
    triangles = [np.empty((0, 3), np.int64)]
    for size in sizes - {0, 1, 2}:
        chosen = polygons if polygons.ndim == 2 else np.stack([each for each in polygons if len(each) == size])
        triangles += [chosen[:, [0, corner, corner + 1]].astype(np.int64) for corner in range(1, size - 1)]
    return np.column_stack([np.asarray(vertices[axis], float) for axis in "xyz"]), np.concatenate(triangles)


def read_mesh(path: str | Path, *, unit: Unit | None = None) -> SurfaceMesh:
    """Read a mesh from PLY, STL, OBJ or binary glTF, in mm and with z up (`load_triangles`).

    The standard uncertainties are those of a PLY file written by `SurfaceMesh.save`, otherwise 0. Normals that are not
    in the file are averages over the adjacent triangles.

    Raises CaptureError like `load_triangles`.
    """
    path = Path(path)
    loaded = load_triangles(path, unit=unit)
    if path.suffix.lower() == ".stl":
        # STL repeats each vertex for every triangle.
        loaded.merge_vertices()
    vertices, faces = np.asarray(loaded.vertices, float), np.asarray(loaded.faces, np.int64)
    known = read_ply(path, "vertex", called="mesh")[0] if path.suffix.lower() == ".ply" else None
    known = np.empty(len(vertices), []) if known is None else known
    names = known.dtype.names or ()
    normals = np.asarray(loaded.vertex_normals, float)
    if {"nx", "ny", "nz"} <= set(names):
        normals = np.column_stack([known[name] for name in ("nx", "ny", "nz")]).astype(float)
    noise, shared = (
        known[name].astype(float) if name in names else np.zeros(len(vertices))
        for name in ("uncertainty_noise", "uncertainty_shared")
    )
    return SurfaceMesh(vertices, normals, faces, noise, shared)


def _encode_ply(mesh: SurfaceMesh) -> bytes:
    columns = dict(zip("xyz", mesh.vertices_mm.T, strict=True))
    columns |= dict(zip(("nx", "ny", "nz"), mesh.normals.T.astype(np.float32), strict=True))
    parts = {"uncertainty": mesh.std_mm, "uncertainty_noise": mesh.noise_mm, "uncertainty_shared": mesh.shared_mm}
    columns |= {name: values.astype(np.float32) for name, values in parts.items()}
    return encode_ply(columns, faces=mesh.faces)


def _encode_stl(mesh: SurfaceMesh) -> bytes:
    import trimesh

    farthest = float(np.abs(mesh.vertices_mm).max())
    if farthest > FARTHEST_SINGLE_MM:
        raise OutputError(
            f"the mesh reaches {farthest:.6g} mm from the origin, where the numbers of STL are coarser than a "
            "micrometre: write PLY or glTF"
        )
    content: Any = trimesh.Trimesh(mesh.vertices_mm, mesh.faces, process=False).export(file_type="stl")
    return content


def _encode_glb(mesh: SurfaceMesh) -> bytes:
    import trimesh

    # Coordinates about the middle keep their precision in 32 bits.
    middle = np.round(1e-3 * mesh.vertices_mm.mean(axis=0), 3)
    local = trimesh.Trimesh(1e-3 * mesh.vertices_mm - middle, mesh.faces, vertex_normals=mesh.normals, process=False)
    local.vertex_attributes["_uncertainty"] = mesh.std_mm.astype(np.float32)
    place = np.eye(4)
    place[:3] = np.column_stack([_TO_Z_UP.T, _TO_Z_UP.T @ middle])
    scene = trimesh.Scene()
    scene.add_geometry(local, transform=place)
    content: Any = scene.export(file_type="glb", include_normals=True)
    return content
