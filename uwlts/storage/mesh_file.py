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
from uwlts.files.reading import open_regular, require_regular_file
from uwlts.files.writing import write_atomically
from uwlts.model.brief import Brief
from uwlts.model.sensor import Table
from uwlts.storage.number_tables import MM_PER_UNIT, Unit, check_unit
from uwlts.storage.ply import encode_ply, open_ply, read_ply

if TYPE_CHECKING:
    import trimesh

MESH_FORMATS = (".stl", ".ply", ".glb")
READ_FORMATS = (".ply", ".stl", ".obj")
"""Endings of the meshes that can be read."""

_FARTHEST = 1e10
"""Largest coordinate in the file's unit: in mm the circumference of the Earth is 4e10; larger ones are damage."""
_FARTHEST_SINGLE_MM = 16_000.0
"""Beyond this distance 32-bit numbers are coarser than a micrometre."""


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
        match path.suffix.lower():
            case ".ply" | ".stl" | ".glb" as ending:
                content = {".ply": _ply, ".stl": _stl, ".glb": _glb}[ending](self)
                with write_atomically(path, overwrite=overwrite) as aside:
                    aside.write_bytes(content)
            case _:
                raise OutputError(
                    f"{path} ends with none of {', '.join(MESH_FORMATS)}, which name the format of a mesh"
                )


def has_faces(path: Path) -> bool:
    """Return whether a PLY file contains a mesh rather than a cloud, by its header."""
    with open_regular(path, called="mesh or cloud") as file:
        header = file.read(2**20).partition(b"end_header")[0]
    found = re.search(rb"^element +face +0*[1-9]", header, flags=re.MULTILINE)
    return header.startswith(b"ply") and found is not None


def load_triangles(path: Path) -> trimesh.Trimesh:
    """Load the triangles of a mesh in any format of trimesh, with vertices (V, 3) and faces (F, 3) as in the file.

    Raises CaptureError if the file is missing, damaged or without triangles, or vertices are not finite.
    """
    import trimesh

    require_regular_file(path, called="mesh")
    ending = path.suffix.lower()
    source = open_ply(path, called="mesh") if ending == ".ply" else str(path)
    try:
        loaded: Any = trimesh.load(source, file_type=ending[1:], force="mesh", process=False)
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
    return loaded


def read_mesh(path: str | Path, *, unit: Unit | None = None) -> SurfaceMesh:
    """Read a mesh from PLY, STL or OBJ in mm or ``unit``.

    The standard uncertainties are those of a PLY file written by `SurfaceMesh.save`, otherwise 0. Normals that are not
    in the file are averages over the adjacent triangles.

    Raises CaptureError if the file is missing, damaged or without triangles, or vertices are not finite.
    """
    path = Path(path)
    loaded = load_triangles(path)
    if path.suffix.lower() == ".stl":
        # STL repeats each vertex for every triangle.
        loaded.merge_vertices()
    scale, faces = MM_PER_UNIT[check_unit(unit or "mm")], np.asarray(loaded.faces, np.int64)
    vertices = scale * np.asarray(loaded.vertices, float)
    known = read_ply(path, "vertex", called="mesh")[0] if path.suffix.lower() == ".ply" else None
    known = np.empty(len(vertices), []) if known is None else known
    names = known.dtype.names or ()
    normals = np.asarray(loaded.vertex_normals, float)
    if {"nx", "ny", "nz"} <= set(names):
        normals = np.column_stack([known[name] for name in ("nx", "ny", "nz")]).astype(float)
    noise, shared = (
        scale * known[name].astype(float) if name in names else np.zeros(len(vertices))
        for name in ("uncertainty_noise", "uncertainty_shared")
    )
    return SurfaceMesh(vertices, normals, faces, noise, shared)


def _ply(mesh: SurfaceMesh) -> bytes:
    columns = dict(zip("xyz", mesh.vertices_mm.T, strict=True))
    columns |= dict(zip(("nx", "ny", "nz"), mesh.normals.T.astype(np.float32), strict=True))
    parts = {"uncertainty": mesh.std_mm, "uncertainty_noise": mesh.noise_mm, "uncertainty_shared": mesh.shared_mm}
    columns |= {name: values.astype(np.float32) for name, values in parts.items()}
    return encode_ply(columns, faces=mesh.faces)


def _stl(mesh: SurfaceMesh) -> bytes:
    import trimesh

    farthest = float(np.abs(mesh.vertices_mm).max())
    if farthest > _FARTHEST_SINGLE_MM:
        raise OutputError(
            f"the mesh reaches {farthest:.6g} mm from the origin, where the numbers of STL are coarser than a "
            "micrometre: write PLY or glTF"
        )
    content: Any = trimesh.Trimesh(mesh.vertices_mm, mesh.faces, process=False).export(file_type="stl")
    return content


def _glb(mesh: SurfaceMesh) -> bytes:
    import trimesh

    # Coordinates about the middle keep their precision in 32 bits.
    middle = np.round(1e-3 * mesh.vertices_mm.mean(axis=0), 3)
    local = trimesh.Trimesh(1e-3 * mesh.vertices_mm - middle, mesh.faces, vertex_normals=mesh.normals, process=False)
    local.vertex_attributes["_uncertainty"] = mesh.std_mm.astype(np.float32)
    place = np.eye(4)
    place[:3, 3] = middle
    scene = trimesh.Scene()
    scene.add_geometry(local, transform=place)
    content: Any = scene.export(file_type="glb", include_normals=True)
    return content
