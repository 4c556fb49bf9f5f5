"""Triangles of a mesh from STL, PLY, OBJ, glTF and other files that trimesh reads."""

from __future__ import annotations

import re
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from uwlts.errors import CaptureError
from uwlts.files.reading import log_warnings, open_regular, require_regular_file
from uwlts.storage.number_tables import Unit, choose_scale, find_stated_unit
from uwlts.storage.ply import read_comments, read_ply

if TYPE_CHECKING:
    import trimesh

_Y_UP = (".glb", ".gltf")
_TO_Z_UP = np.array([[1.0, 0, 0], [0, 0, -1], [0, 1, 0]])
"""Rotation from glTF's axes, whose y axis points up."""
_LONGEST_START = 2**16  # bytes in which comments are looked for
_FARTHEST = 1e10
"""Largest coordinate in the file's unit: in mm the circumference of the Earth is 4e10; larger ones are damage."""


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
