"""LAS and LAZ for other programs: points in m, in steps of 0.1 um, with extra fields."""

import os
import struct
from io import BufferedReader, BytesIO
from pathlib import Path
from types import ModuleType
from typing import Any, Literal

import numpy as np

from uwlts.errors import CaptureError, OutputError
from uwlts.files.reading import open_regular
from uwlts.runtime.optional_library import optional_library
from uwlts.storage.cloud import PointCloud, make_foreign_cloud

LAZ_STEP_M = 1e-7
"""Resolution of coordinates in LAZ, integers relative to the middle of the cloud: up to 214 m to either side."""

_REACH_M = LAZ_STEP_M * (2**31 - 1)  # of 32-bit coordinates
_INTENSITY_LIMITS = 0, 2**16 - 1  # 16 bits
_NOISE_CLASSES = 7, 18
"""Low and high noise."""
_BOX_MARGIN = 1e-3
"""Distance of points outside the stated box that is allowed, in its longest edges."""
_LONGEST_HEADER = 375  # bytes (LAS 1.4, table 3)
_RECORD_BYTES = 54
"""Smallest size of a variable length record in bytes: its header (LAS 1.4, 2.5)."""
_COMPRESSED = 0x80  # bit of the point format
_POINT_BYTES = {0: (20, 0), 1: (28, 0), 2: (26, 0), 3: (34, 0), 6: (30, 9), 7: (36, 10), 8: (38, 11)}
"""Bytes of a point (LAS 1.4, 2.6) and compressed layers of a chunk by point format; each extra byte is one more."""
_ITEMS = 32  # place of the number of items in the record of LASzip
_POINT10, _TIME, _RGB12, _POINT14, _RGB14, _RGB_NIR, _EXTRA_BYTES = 6, 7, 8, 10, 11, 12, 14
_ITEMS_OF_FORMAT = {
    0: ((_POINT10, 20),),
    1: ((_POINT10, 20), (_TIME, 8)),
    2: ((_POINT10, 20), (_RGB12, 6)),
    3: ((_POINT10, 20), (_TIME, 8), (_RGB12, 6)),
    6: ((_POINT14, 30),),
    7: ((_POINT14, 30), (_RGB14, 6)),
    8: ((_POINT14, 30), (_RGB_NIR, 8)),
}
"""Types and bytes of the compressed items of a point by point format, before those of extra bytes (LASzip)."""
_LARGEST_RATIO = 10_000
"""Largest number of points in a byte; equal points have 600. Higher ones are damage, and exhaust the memory."""


def encode_las(
    points_mm: np.ndarray,
    intensity: np.ndarray,
    fields: dict[str, np.ndarray],
    *,
    time_s: np.ndarray | None = None,
    colours: np.ndarray | None = None,
    compressed: bool,
) -> bytes:
    """Return the content of a LAS or LAZ file (``compressed``) of points (N, 3).

    Intensities (N,) are stored as integers of 16 bits, ``fields`` (N,) by name as extra fields.
    """
    laspy = load_library("laspy", "LAZ" if compressed else "LAS")
    if compressed:
        load_library("lazrs", "LAZ")
    points = 1e-3 * points_mm
    middle = _las_middle(points.min(axis=0), points.max(axis=0))
    header = laspy.LasHeader(version="1.4", point_format=6 if colours is None else 7)
    header.offsets, header.scales = middle, np.full(3, LAZ_STEP_M)
    header.add_extra_dims([laspy.ExtraBytesParams(name=name, type=values.dtype) for name, values in fields.items()])
    table = laspy.LasData(header)
    table.x, table.y, table.z = points.T
    table.intensity = np.rint(np.nan_to_num(intensity)).clip(*_INTENSITY_LIMITS).astype(np.uint16)
    if time_s is not None:
        table.gps_time = time_s
    if colours is not None:
        # The standard requires 16 bits per colour that use the full range.
        table.red, table.green, table.blue = 257 * colours.T.astype(np.uint16)
    for name, values in fields.items():
        table[name] = values
    # In memory: the compressor raises errors of its own if writing fails.
    content = BytesIO()
    table.write(content, do_compress=compressed)
    return content.getvalue()


def _las_middle(low_m: np.ndarray, high_m: np.ndarray) -> np.ndarray:
    """Return the middle (3,) of a cloud in m, the origin of its coordinates; raises OutputError if it is too wide."""
    middle = np.round((low_m + high_m) / 2, 3)
    reach = max(np.abs(low_m - middle).max(), np.abs(high_m - middle).max())
    if not reach <= _REACH_M:
        raise OutputError(
            f"the cloud reaches {reach:.9g} m from its middle, LAZ in steps of {LAZ_STEP_M:g} m "
            f"only {_REACH_M:.0f} m: write PLY or E57"
        )
    return middle


def read_las(path: Path) -> PointCloud:
    """Read all points of a LAS or LAZ file; raises CaptureError if it is damaged, SetupError without laspy or lazrs."""
    form = path.suffix.strip(".").upper()
    laspy = load_library("laspy", form)
    if form == "LAZ":
        load_library("lazrs", form)
    try:
        with open_regular(path, called="cloud") as file:
            _require_sound_points(file)
            # One thread: several would read whole chunks, of any size that the file declares.
            with laspy.open(file, read_evlrs=False, laz_backend=laspy.LazBackend.Lazrs, closefd=False) as reader:
                header = reader.header
                if header.are_points_compressed:
                    _require_sound_items(header)
                found = reader.read_points(header.point_count)
        points, step = 1e3 * np.column_stack([found.x, found.y, found.z]), 1e3 * float(np.max(header.scales))
        _require_in_box(points, header)
        names = set(found.point_format.dimension_names)
        column = {name: np.asarray(found[name]) for name in names & {"frame", "line", "deviation_mm", "gps_time"}}
        intensity = np.asarray(found["amplitude" if "amplitude" in names else "intensity"], np.float32)
        omitted = _unwanted_points(found)
    except BaseException as error:
        # The decompressor, in Rust, panics at damaged chunks: the exception is no Exception.
        if isinstance(error, Exception) or type(error).__name__ == "PanicException":
            raise CaptureError(f"{path} is not a complete {form} file: {shorten_error(error)}") from error
        raise
    if np.isnan(column.get("deviation_mm", np.nan)).all():
        column.pop("deviation_mm", None)
    times = column.pop("gps_time", None)
    # Programs write 0 if times are unknown.
    return make_foreign_cloud(
        points,
        intensity=intensity,
        time_s=None if times is None or not times.any() else times,
        omitted=omitted,
        step_mm=step,
        **column,
    )


def _require_sound_points(file: BufferedReader) -> None:
    """Raise ValueError if a header (LAS 1.4, 2.4) declares more records, points or chunks than the file has.

    The library would reserve memory for as many as are declared, and terminate the process.
    """
    size = file.seek(0, os.SEEK_END)
    file.seek(0)
    start = file.read(_LONGEST_HEADER)
    file.seek(0)
    points_begin, records, point_format, point_bytes, count = struct.unpack_from("<IIBHI", start, 96)
    if start[25] >= 4:
        count = max(count, *struct.unpack_from("<Q", start, 247))
    if points_begin > size or records * _RECORD_BYTES > points_begin:
        raise ValueError(f"{records} records do not fit before its points, or these begin beyond its end")
    stored = size - points_begin
    if not point_format & _COMPRESSED:
        if count * point_bytes > stored:
            raise ValueError(f"its header declares {count} points of {point_bytes} bytes; it has {stored} bytes")
        return
    bytes_of_format, layers = _POINT_BYTES.get(point_format & 0x3F, (0, 0))
    if not bytes_of_format or point_bytes < bytes_of_format:
        raise ValueError(f"its point format is none of {', '.join(map(str, _POINT_BYTES))}")
    if count > _LARGEST_RATIO * stored:
        raise ValueError(f"its header declares {count} points in {stored} bytes")
    file.seek(points_begin)
    (table,) = struct.unpack("<q", file.read(8))
    if table == -1:  # written to a stream: the place is at the end
        file.seek(-8, os.SEEK_END)
        (table,) = struct.unpack("<q", file.read(8))
    if not points_begin < table <= size - 8:
        raise ValueError("the table of its chunks is outside the file")
    file.seek(table)
    _, chunks = struct.unpack("<II", file.read(8))
    if chunks * point_bytes > stored:
        raise ValueError(f"it declares {chunks} chunks of points in {stored} bytes")
    if layers:
        layers += point_bytes - bytes_of_format
        found = _count_layered_points(file, points_begin + 8, table, point_bytes=point_bytes, layers=layers)
        if found != count:
            raise ValueError(f"its chunks have {found} points and its header {count}")
    file.seek(0)


def _count_layered_points(file: BufferedReader, begin: int, end: int, *, point_bytes: int, layers: int) -> int:
    """Return the number of points in chunks from ``begin`` to ``end``; ValueError if their layers are not within.

    A chunk starts with a whole point, the number of points, and the sizes of its layers (LASzip 3).
    """
    found, length = 0, point_bytes + 4 + 4 * layers
    while begin < end:
        file.seek(begin)
        count, *sizes = struct.unpack_from(f"<{layers + 1}I", file.read(length), point_bytes)
        found += count
        begin += length + sum(sizes)
    if begin != end:
        raise ValueError("a chunk of its points is incomplete")
    return found


def _require_sound_items(header: Any) -> None:
    """Raise ValueError if a LASzip record contradicts the point format: sizes of layers depend on its items."""
    record = header.vlrs.get("LasZipVlr")[0].record_data
    compressor, *_ = struct.unpack_from("<H", record)
    (count,) = struct.unpack_from("<H", record, _ITEMS)
    items = [(kind, size) for kind, size, _ in struct.iter_unpack("<3H", record[_ITEMS + 2 :])]
    expected = [*_ITEMS_OF_FORMAT[header.point_format.id]]
    layered = header.point_format.id >= 6
    if extra := header.point_format.size - sum(size for _, size in expected):
        expected.append((_EXTRA_BYTES if layered else 0, extra))
    if len(items) != count or items != expected or compressor != (3 if layered else 2):
        raise ValueError(f"its compressed points have the items {items}; expected {expected}, as type and bytes")


def _require_in_box(points_mm: np.ndarray, header: Any) -> None:
    """Raise ValueError if points (N, 3) contradict the box that a header states, which a wrong scale or offset causes.

    Points are outside the box; or its corners are beyond the largest integers; or the points' own box is that of the
    header scaled about the origin of the integers. Boxes that are empty state nothing.
    """
    low, high = 1e3 * np.asarray(header.mins), 1e3 * np.asarray(header.maxs)
    if not len(points_mm) or not (np.isfinite([low, high]).all() and (high > low).any()):
        return
    # Programs round the box, some to the decimals of text.
    margin = np.maximum(2e3 * np.asarray(header.scales), _BOX_MARGIN * (high - low).max())
    found_low, found_high = points_mm.min(axis=0), points_mm.max(axis=0)
    step, origin = 1e3 * np.asarray(header.scales), 1e3 * np.asarray(header.offsets)
    stated, found = np.stack([low, high]) - origin, np.stack([found_low, found_high]) - origin
    beyond = (found_low < low - margin).any() or (found_high > high + margin).any()
    unreachable = (np.abs(stated) > 2**31 * step + margin).any()
    if beyond or unreachable or _is_scaled(stated, found, margin, step):
        raise ValueError(
            f"its scale or offset is wrong: points are from {_numbers(found_low)} to {_numbers(found_high)} mm, the "
            f"box of its header from {_numbers(low)} to {_numbers(high)} mm"
        )


def _is_scaled(stated: np.ndarray, found: np.ndarray, margin: np.ndarray, step: np.ndarray) -> bool:
    """Return whether corners (2, 3) are others times a factor, on one axis or all, that exceeds the ``margin`` (3,)."""
    for axes in ([0], [1], [2], [0, 1, 2]):
        one, other = stated[:, axes], found[:, axes]
        if np.count_nonzero(np.abs(one) > margin[axes]) > 1 and (np.abs(one - other) > margin[axes]).any():
            rest = other - np.sum(one * other) / np.sum(one**2) * one
            if (np.abs(rest) <= 2 * step[axes] + _BOX_MARGIN * np.abs(other).max()).all():
                return True
    return False


def _numbers(values: np.ndarray) -> str:
    """Return numbers in a few digits, in brackets."""
    return f"({', '.join(f'{value:.5g}' for value in values.tolist())})"


def _unwanted_points(found: Any) -> dict[str, np.ndarray]:
    """Return masks (N,) of LAS points that are marked as unwanted, by reason (LAS 1.4, tables 8, 16 and 17)."""
    return {
        "marked as withheld": np.asarray(found.withheld, bool),
        "classified as noise": np.isin(np.asarray(found.classification), _NOISE_CLASSES),
    }


def load_library(name: Literal["laspy", "lazrs", "pye57"], file_format: str) -> ModuleType:
    """Import a library for clouds; raises SetupError if it is not installed."""
    return optional_library(name, needed_by=file_format, extra="clouds", instead=", or write PLY or XYZ")


def shorten_error(error: BaseException) -> str:
    """Return a library's error message in one line of at most 200 characters."""
    return " ".join(str(error).split())[:200]
