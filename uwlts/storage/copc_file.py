"""Large clouds as COPC (cloud-optimised point cloud, copc.io): written in bounded memory, read by region and level.

A COPC file is LAZ 1.4 with its points in an octree. Every level of the tree holds a random sample of the points of its
nodes, four times as many as the level above, as suits a surface. All levels down to one form an even sample.
"""

from __future__ import annotations

import os
import struct
import tempfile
from collections.abc import Callable, Iterable
from dataclasses import dataclass, field
from io import BufferedReader
from pathlib import Path
from typing import Any

import numpy as np

from uwlts.errors import CaptureError, OutputError
from uwlts.files.reading import open_regular
from uwlts.files.writing import write_atomically
from uwlts.runtime.progress import ProgressListener, ignore_progress
from uwlts.storage.cloud import PointCloud, make_foreign_cloud
from uwlts.storage.las_file import (
    INTENSITY_LIMITS,
    LAZ_STEP_M,
    RECORD_BYTES,
    START_BYTES,
    las_middle,
    load_library,
    require_in_box,
    shorten_error,
    unwanted_points,
)

SUFFIX = ".copc.laz"

_POINTS_OF_NODE = 60_000
"""Points of the root, and of a typical node: compressed about 500 kB, one request of a viewer."""
_DEEPEST = 7  # levels written: 4**7 nodes on a surface
_MOST_LEVELS = 16  # read; more only occur in damaged files
_INFO, _INFO_BYTES, _ENTRY, _EXTENDED = 429, 160, 32, 60
"""Place and size of the description of the octree, and sizes of its entries and of an extended record's header."""
_ITEMS = 32  # place of the number of items in the record of LASzip
_LAYERS = {6: (30, 9), 7: (36, 10), 8: (38, 11)}
"""Bytes of a point (LAS 1.4, 2.6) and compressed layers of a node, by point format; each extra byte is one more."""
_POINT, _RGB, _RGB_NIR, _EXTRA_BYTES = 10, 11, 12, 14
_ITEMS_OF_FORMAT = {6: ((_POINT, 30),), 7: ((_POINT, 30), (_RGB, 6)), 8: ((_POINT, 30), (_RGB_NIR, 8))}
"""Types and bytes of the compressed items of a point by point format, before those of extra bytes (LASzip 3)."""
_LARGEST_RATIO = 10_000
"""Largest number of points in a byte; equal points have 600. Higher ones are damage, and exhaust the memory."""
_FIELDS: dict[str, type] = {"amplitude": np.float32, "frame": np.int32, "line": np.int32, "deviation_mm": np.float32}


def is_copc(path: str | os.PathLike[str]) -> bool:
    """Return whether a file's name ends with ``.copc.laz``."""
    return Path(path).name.lower().endswith(SUFFIX)


@dataclass(eq=False)
class _Sorter:
    """Points of nodes in a temporary file in the order of their arrival, and the position of each node's runs in it."""

    file: Any
    kind: np.dtype
    runs: dict[int, list[tuple[int, int]]] = field(default_factory=dict)
    end: int = 0

    def add(self, nodes: np.ndarray, table: np.ndarray) -> None:
        """Add records of a table (N,) that belong to nodes (N,)."""
        order = np.argsort(nodes, kind="stable")
        keys, starts = np.unique(nodes[order], return_index=True)
        table[order].tofile(self.file)
        for key, start, stop in zip(keys.tolist(), starts, np.append(starts[1:], len(nodes)), strict=True):
            self.runs.setdefault(key, []).append((self.end + int(start), int(stop - start)))
        self.end += len(nodes)

    def merge(self, node: int, into: int) -> None:
        """Assign the records of one node to another."""
        self.runs.setdefault(into, []).extend(self.runs.pop(node))

    def read_node(self, node: int) -> np.ndarray:
        """Read all records of a node."""
        parts = []
        for start, count in self.runs[node]:
            self.file.seek(start * self.kind.itemsize)
            parts.append(np.fromfile(self.file, self.kind, count))
        return np.concatenate(parts)


def write_copc(
    path: str | os.PathLike[str],
    parts: Callable[[], Iterable[PointCloud]],
    *,
    overwrite: bool = False,
    progress: ProgressListener = ignore_progress,
) -> int:
    """Write the parts of a cloud as COPC, completely or not at all, and return the number of points.

    ``parts`` is called twice and returns an iterable of all parts each time. One part and one node are in memory at a
    time. The other points are in a temporary file beside the output, about 46 bytes per point. Coordinates are in m in
    steps of 1e-7 m, and the fields those of LAZ (`uwlts.export`).

    Raises OutputError if the file exists, the cloud is empty or too wide, or writing fails; SetupError without copclib.
    """
    copc, _ = load_library("copclib", "COPC"), load_library("laspy", "COPC")
    low, high, total = np.full(3, np.inf), np.full(3, -np.inf), 0
    for part in parts():
        if len(part.points_mm):
            low, high = np.minimum(low, part.points_mm.min(axis=0)), np.maximum(high, part.points_mm.max(axis=0))
            total += len(part.points_mm)
    if not total:
        raise OutputError("the cloud has no points: there is nothing to export")
    middle = las_middle(1e-3 * low, 1e-3 * high)
    # The root's cube is not filled completely, so that no point is on its last face.
    half = max(5.05e-4 * float((high - low).max()), 1e-3)
    centre = 5e-4 * (low + high)
    depth = int(np.clip(np.ceil(np.log(max(0.75 * total / _POINTS_OF_NODE, 1)) / np.log(4)), 0, _DEEPEST))
    share = np.cumsum(4.0 ** np.arange(depth + 1)) / np.sum(4.0 ** np.arange(depth + 1))
    shape, rng, done = (depth + 1,) + (2**depth,) * 3, np.random.default_rng(0), 0
    with write_atomically(path, overwrite=overwrite) as aside, tempfile.TemporaryFile(dir=aside.parent) as file:
        header = _header(middle)
        kind = header.point_format.dtype()
        sorter = _Sorter(file, kind)
        for part in parts():
            if not len(part.points_mm):
                continue
            level = np.searchsorted(share, rng.random(len(part.points_mm)), side="right")
            cell = np.floor((1e-3 * part.points_mm - (centre - half)) / (2 * half) * 2**depth).astype(np.int64)
            cell = cell.clip(0, 2**depth - 1) >> (depth - level)[:, None]
            sorter.add(np.ravel_multi_index((level, *cell.T), shape), _table(part, kind, middle))
            done += len(part.points_mm)
            progress(done, 2 * total)
        for node in sorted(sorter.runs, reverse=True):
            level, *cell = np.unravel_index(node, shape)
            above = int(np.ravel_multi_index((level - 1, *(n >> 1 for n in cell)), shape)) if level else node
            # A reader reaches a node through its ancestors; with few points an ancestor may be missing.
            if level and above not in sorter.runs:
                sorter.merge(node, above)
        writer = _writer(copc, header, aside, low=1e-3 * low, high=1e-3 * high, centre=centre, half=half)
        for node in sorted(sorter.runs):
            table = sorter.read_node(node)
            key = [int(n) for n in np.unravel_index(node, shape)]
            writer.AddNode(copc.VoxelKey(*key), copc.VectorChar(table.view(np.int8).ravel()))
            done += len(table)
            progress(done, 2 * total)
        writer.Close()
    return total


def _header(middle: np.ndarray) -> Any:
    laspy = load_library("laspy", "COPC")
    header = laspy.LasHeader(version="1.4", point_format=6)
    header.offsets, header.scales = middle, np.full(3, LAZ_STEP_M)
    # copclib requires this for point format 6.
    header.global_encoding.wkt = True
    header.add_extra_dims([laspy.ExtraBytesParams(name=name, type=kind) for name, kind in _FIELDS.items()])
    return header


def _writer(copc: Any, header: Any, aside: Path, *, low: Any, high: Any, centre: np.ndarray, half: float) -> Any:
    laspy = load_library("laspy", "COPC")
    with tempfile.TemporaryDirectory() as folder:
        # copclib reads the names of fields from files only.
        empty = os.path.join(folder, "fields.laz")
        table = laspy.LasData(header)
        table.x = table.y = table.z = np.zeros(1)
        table.write(empty)
        named = copc.LazReader(empty).laz_config.extra_bytes_vlr
    scale, offset = copc.Vector3(*[LAZ_STEP_M] * 3), copc.Vector3(*header.offsets.tolist())
    settings = copc.CopcConfigWriter(6, scale, offset, "", named)
    settings.las_header.min, settings.las_header.max = copc.Vector3(*low.tolist()), copc.Vector3(*high.tolist())
    info = settings.copc_info
    info.center_x, info.center_y, info.center_z = centre.tolist()
    # About 250 points along the edge of a node on a surface.
    info.halfsize, info.spacing = half, 2 * half / np.sqrt(_POINTS_OF_NODE)
    return copc.FileWriter(str(aside), settings)


def _table(part: PointCloud, kind: np.dtype, middle: np.ndarray) -> np.ndarray:
    table = np.zeros(len(part.points_mm), kind)
    for name, values in zip("XYZ", (1e-3 * part.points_mm - middle).T / LAZ_STEP_M, strict=True):
        table[name] = np.rint(values)
    # Return 1 of 1.
    table["bit_fields"] = 0b0001_0001
    table["intensity"] = np.rint(np.nan_to_num(part.intensity)).clip(*INTENSITY_LIMITS)
    deviation = np.float32(np.nan) if part.deviation_mm is None else part.deviation_mm
    for name, values in zip(_FIELDS, (part.intensity, part.frame, part.line, deviation), strict=True):
        table[name] = values
    return table


def read_copc(
    path: str | os.PathLike[str], *, box_mm: tuple[np.ndarray, np.ndarray] | None = None, at_most: int | None = None
) -> tuple[PointCloud, int]:
    """Read the points of a COPC file within a box, and the number of points in the file.

    With ``at_most``, levels are read until they hold about that many points in the box; the result is an even sample
    of at most that many. Fields missing in other programs' files are left out.

    Raises CaptureError if the file cannot be read or is not COPC; SetupError without laspy.
    """
    laspy, path = load_library("laspy", "COPC"), Path(path)
    try:
        with open_regular(path, called="cloud") as file:
            _require_sound_octree(file)
            reader = laspy.CopcReader(file)
            _require_sound_items(
                reader.laszip_vlr.record_data, reader.header.point_format.id, reader.header.point_format.size
            )
            total = int(reader.header.point_count)
            box = None if box_mm is None else laspy.copc.Bounds(1e-3 * box_mm[0], 1e-3 * box_mm[1])
            found = _query(reader, box, at_most)
            points = 1e3 * np.column_stack([found.x, found.y, found.z])
            require_in_box(points, reader.header, whole=len(points) == total)
    except BaseException as error:
        # The decompressor, in Rust, panics at damaged chunks: the exception is no Exception.
        if isinstance(error, Exception) or type(error).__name__ == "PanicException":
            raise CaptureError(f"{path} is not a complete COPC file: {shorten_error(error)}") from error
        raise
    columns = {name: np.asarray(found[name]) for name in found.point_format.dimension_names if name in _FIELDS}
    intensity = columns.pop("amplitude", found["intensity"])
    if np.isnan(columns.get("deviation_mm", np.nan)).all():
        columns.pop("deviation_mm", None)
    step, omitted = 1e3 * float(np.max(found.scales)), unwanted_points(found)
    return make_foreign_cloud(points, intensity=intensity, omitted=omitted, step_mm=step, **columns), total


def _require_sound_octree(file: BufferedReader) -> None:
    """Raise ValueError if header or octree (LAS 1.4, 2.4; COPC 1.0) point beyond the file, or declare other points."""
    size = file.seek(0, os.SEEK_END)
    file.seek(0)
    start = file.read(_INFO + _INFO_BYTES)
    if len(start) < _INFO + _INFO_BYTES or start[:4] != b"LASF":
        raise ValueError("its header is incomplete")
    points_begin, records, point_format, point_bytes = struct.unpack("<IIBH", start[96 : START_BYTES + 3])
    extended, extended_count, total = struct.unpack("<QIQ", start[235:255])
    if points_begin > size or records * RECORD_BYTES > points_begin or extended + _EXTENDED * extended_count > size:
        raise ValueError("its header declares more records than it has")
    bytes_of_format, layers = _LAYERS.get(point_format & 0x3F, (0, 0))
    if not layers or point_bytes < bytes_of_format:
        raise ValueError("its point format is none of 6, 7 and 8")
    layers += point_bytes - bytes_of_format
    bytes_before_layers = point_bytes + 4 + 4 * layers
    pages, seen, found = [struct.unpack("<QQ", start[_INFO + 40 : _INFO + 56])], set(), 0
    while pages:
        offset, length = pages.pop()
        if offset in seen or length % _ENTRY or offset + length > size:
            raise ValueError("a page of its octree is outside the file, or occurs twice")
        seen.add(offset)
        file.seek(offset)
        for entry in struct.iter_unpack("<4iQii", file.read(length)):
            place, stored, count = entry[4:]
            if count < 0:
                pages.append((place, stored))
                continue
            if stored < 0 or place + stored > size or count > _LARGEST_RATIO * stored:
                raise ValueError("a node of its octree is outside the file, or holds too many points")
            if count:
                # A node starts with a whole point, the number of points, and the sizes of its layers.
                file.seek(place)
                node = file.read(bytes_before_layers)
                if len(node) < bytes_before_layers:
                    raise ValueError("a node of its octree is incomplete")
                stated, *sizes = struct.unpack_from(f"<{layers + 1}I", node, point_bytes)
                if stated != count or len(node) + sum(sizes) > stored:
                    raise ValueError("a node of its octree declares more points or bytes than it has")
            found += count
    if found != total:
        raise ValueError(f"its octree has {found} points and its header {total}")
    file.seek(0)


def _require_sound_items(record: bytes, point_format: int, point_bytes: int) -> None:
    """Raise ValueError if the items of a LASzip record are not those of the points: sizes of layers depend on them."""
    (count,) = struct.unpack_from("<H", record, _ITEMS)
    items = [(kind, size) for kind, size, _ in struct.iter_unpack("<3H", record[_ITEMS + 2 :])]
    expected = [*_ITEMS_OF_FORMAT[point_format]]
    if extra := point_bytes - sum(size for _, size in expected):
        expected.append((_EXTRA_BYTES, extra))
    if len(items) != count or items != expected:
        raise ValueError(f"its compressed points have the items {items}; expected {expected}, as type and bytes")


def _query(reader: Any, box: Any, at_most: int | None) -> Any:
    """Read the points of the levels that are needed, each level once."""
    if at_most is None:
        return reader.query(bounds=box)
    count, found = 0, []
    for level in range(_MOST_LEVELS):
        part = reader.query(bounds=box, level=level)
        if count and not len(part):
            break
        found.append(part)
        count += len(part)
        # The next level holds four times as many.
        if count >= at_most or count + 4 * len(part) > 2 * at_most:
            break
    array = np.concatenate([part.array for part in found])
    array = array[:: max(1, -(-len(array) // at_most))]
    return type(found[0])(array, found[0].point_format, found[0].scales, found[0].offsets)
