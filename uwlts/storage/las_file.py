"""LAS and LAZ for other programs: points in m, in steps of 0.1 um, with extra fields; units of coordinate systems."""

import os
import re
import struct
from dataclasses import dataclass, replace
from io import BufferedReader, BytesIO
from pathlib import Path
from types import ModuleType
from typing import Any, Literal

import numpy as np

from uwlts.errors import CaptureError, OutputError
from uwlts.files.reading import open_regular
from uwlts.runtime.optional_library import optional_library
from uwlts.storage.cloud import PointCloud, make_foreign_cloud
from uwlts.storage.number_tables import Unit

LAZ_STEP_M = 1e-7
"""Resolution of coordinates in LAZ, integers relative to the middle of the cloud: up to 214 m to either side."""

_REACH_M = LAZ_STEP_M * (2**31 - 1)  # of 32-bit coordinates
_NOISE_CLASSES = 7, 18  # low and high noise
_BOX_MARGIN = 1e-3  # distance of points outside the stated box that is allowed, in its longest edges
_LONGEST_HEADER = 375  # bytes (LAS 1.4, table 3)
_RECORD_BYTES = 54  # smallest size of a variable length record in bytes: its header (LAS 1.4, 2.5)
_LONGEST_SYSTEM = 2**20  # bytes
_WKT = re.compile(rb"(?:COMPD_CS|COMPOUNDCRS|BOUNDCRS|PROJCS|PROJCRS|GEOGCS|GEOGCRS|LOCAL_CS|ENGCRS)\[[^\0]*")
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
_UNIT = re.compile(r'UNIT\s*\[\s*"(?!deg|rad|grad|gon|arc|unity)([^"]*)"\s*,\s*([-+.0-9eE]+)', re.IGNORECASE)
_VERTICAL = re.compile(r"VERT_CS|VERTCRS|VERTICALCRS")
_PLANE, _ANGULAR = re.compile(r"PROJ|LOCAL_CS|ENG"), re.compile(r"GEOG|GEOD|GEODETICCRS")
_MODEL, _SYSTEM, _LINEAR, _VERTICAL_UNIT = 1024, 3072, 3076, 4099
"""Keys of GeoTIFF: type of model (2: degrees), projected system, its unit, and that of heights (OGC 19-008)."""
_DEGREES = 2
_OF_CODE = {9001: ("m", 1.0), 9002: ("foot", 0.3048), 9003: ("US survey foot", 1200 / 3937)}
_UTM = (258, 269, 322, 326, 327)
"""Codes of the EPSG register in hundreds, with metres."""


@dataclass(frozen=True)
class SystemUnits:
    """Units of x, y and z in m, None for degrees and unknown ones; their name if stated; and notes for the user."""

    metres: tuple[float, float, float] | None = (1.0, 1.0, 1.0)
    name: str = ""
    notes: tuple[str, ...] = ()

    def require(self, path: Path, unit: Unit | None) -> tuple[float, float, float]:
        """Return the units in m; raises CaptureError if they are unknown, or not ``unit``."""
        if self.metres is None:
            raise CaptureError(f"{path} has coordinates in {self.name}: convert it to a coordinate system in m first")
        if unit is not None and self.notes and self.name:
            raise CaptureError(f"{path} states the unit {self.name}, but the unit {unit} was given: omit it")
        return self.metres


def describe_units(wkt: str = "", keys: dict[int, int] | None = None) -> SystemUnits:
    """Return the units of a coordinate system; heights have that of x and y if they state none."""
    keys = keys or {}
    plane, *heights = _VERTICAL.split(wkt.partition("TARGETCRS")[0])
    if (_ANGULAR.search(plane) and not _PLANE.search(plane)) or (not wkt and keys.get(_MODEL) == _DEGREES):
        return SystemUnits(None, "degrees")
    # The unit of a system follows those of what it is based on.
    found = [units[-1] for part in (plane, *heights[:1]) if (units := _UNIT.findall(part))]
    stated = [(name, float(factor)) for name, factor in found]
    if not wkt:
        codes = [code for key in (_LINEAR, _VERTICAL_UNIT) if (code := keys.get(key))]
        if unknown := [code for code in codes if code not in _OF_CODE]:
            return SystemUnits(None, f"the unit EPSG:{unknown[0]}")
        stated = [_OF_CODE[code] for code in codes]
        if _LINEAR not in keys and _SYSTEM in keys and keys[_SYSTEM] // 100 not in _UTM:
            return SystemUnits(
                notes=(f"its coordinate system EPSG:{keys[_SYSTEM]} is taken as one in m: is it in feet?",)
            )
    if not stated:
        return SystemUnits(notes=("its coordinate system states no unit of length: read in m",) if wkt else ())
    (name, across), (high, height) = stated[0], stated[-1]
    if {across, height} == {1.0}:
        return SystemUnits(name=name)
    names = name if name == high else f"{name}, heights in {high}"
    note = f"its coordinates are in {names}, as its coordinate system states ({across:.7g} m), and read as such"
    return SystemUnits((across, across, height), name, (note,))


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

    Intensities (N,) are stored as integers of 16 bits, ``fields`` (N,) by name as extra fields. Raises OutputError if
    the cloud is too wide.
    """
    laspy = load_library("laspy", "LAZ" if compressed else "LAS")
    if compressed:
        load_library("lazrs", "LAZ")
    points = 1e-3 * points_mm
    low, high = points.min(axis=0), points.max(axis=0)
    middle = np.round((low + high) / 2, 3)
    if not (reach := max(np.abs(low - middle).max(), np.abs(high - middle).max())) <= _REACH_M:
        raise OutputError(
            f"the cloud reaches {reach:.9g} m from its middle, LAZ in steps of {LAZ_STEP_M:g} m "
            f"only {_REACH_M:.0f} m: write PLY or HDF5"
        )
    header = laspy.LasHeader(version="1.4", point_format=6 if colours is None else 7)
    header.offsets, header.scales = middle, np.full(3, LAZ_STEP_M)
    header.add_extra_dims([laspy.ExtraBytesParams(name=name, type=values.dtype) for name, values in fields.items()])
    table = laspy.LasData(header)
    table.x, table.y, table.z = points.T
    table.intensity = np.rint(np.nan_to_num(intensity)).clip(0, 2**16 - 1).astype(np.uint16)
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


def read_las(path: Path, unit: Unit | None = None) -> PointCloud:
    """Read all points of a LAS or LAZ file, in the unit that its coordinate system states, by default m.

    Raises CaptureError if the file is damaged, states another unit than ``unit``, or is in degrees; SetupError without
    laspy or lazrs.
    """
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
            file.seek(header.start_of_first_evlr)
            system = describe_units(*_decode(header, file.read(_LONGEST_SYSTEM) if header.number_of_evlrs else b""))
        points = np.column_stack([found.x, found.y, found.z])
        _require_in_box(1e3 * points, header)
        names = set(found.point_format.dimension_names)
        column = {name: np.asarray(found[name]) for name in names & {"frame", "line", "deviation_mm", "gps_time"}}
        intensity = np.asarray(found["amplitude" if "amplitude" in names else "intensity"], np.float32)
        # LAS 1.4, tables 8, 16 and 17
        omitted = {
            "marked as withheld": np.asarray(found.withheld, bool),
            "classified as noise": np.isin(np.asarray(found.classification), _NOISE_CLASSES),
        }
    except BaseException as error:
        # The decompressor, in Rust, panics at damaged chunks: the exception is no Exception.
        if isinstance(error, Exception) or type(error).__name__ == "PanicException":
            raise CaptureError(f"{path} is not a complete {form} file: {shorten_error(error)}") from error
        raise
    if np.isnan(column.get("deviation_mm", np.nan)).all():
        column.pop("deviation_mm", None)
    times = column.pop("gps_time", None)
    scale_mm = 1e3 * np.array(system.require(path, unit))
    # Programs write 0 if times are unknown.
    cloud = make_foreign_cloud(
        scale_mm * points,
        intensity=intensity,
        time_s=None if times is None or not times.any() else times,
        omitted=omitted,
        step_mm=float(np.max(scale_mm * header.scales)),
        **column,
    )
    return replace(cloud, warnings=[*system.notes, *cloud.warnings])


def _decode(header: Any, behind: bytes) -> tuple[str, dict[int, int]]:
    """Return the coordinate system as WKT, also from the records ``behind`` the points, and as keys of GeoTIFF."""
    texts = [record.string for record in header.vlrs.get("WktCoordinateSystemVlr")]
    if match := _WKT.search(behind):
        texts.append(match[0].decode("latin-1"))
    directories = header.vlrs.get("GeoKeyDirectoryVlr")
    return "".join(texts[:1]), {key.id: key.value_offset for each in directories for key in each.geo_keys}


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
    layers += point_bytes - bytes_of_format if layers else 0
    _require_sound_chunks(file, points_begin, size, count=count, point_bytes=point_bytes, layers=layers)
    file.seek(0)


def _require_sound_chunks(
    file: BufferedReader, points_begin: int, size: int, *, count: int, point_bytes: int, layers: int
) -> None:
    """Raise ValueError if the table of chunks of compressed points declares other points than the header."""
    file.seek(points_begin)
    (table,) = struct.unpack("<q", file.read(8))
    if table == -1:  # written to a stream: the place is at the end
        file.seek(-8, os.SEEK_END)
        (table,) = struct.unpack("<q", file.read(8))
    if not points_begin < table <= size - 8:
        raise ValueError("the table of its chunks is outside the file")
    file.seek(table)
    _, chunks = struct.unpack("<II", file.read(8))
    if chunks * point_bytes > size - points_begin:
        raise ValueError(f"it declares {chunks} chunks of points in {size - points_begin} bytes")
    if layers:
        found = _count_layered_points(file, points_begin + 8, table, point_bytes=point_bytes, layers=layers)
        if found != count:
            raise ValueError(f"its chunks have {found} points and its header {count}")


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
            f"its scale or offset is wrong: points are from {_format(found_low)} to {_format(found_high)} mm, the "
            f"box of its header from {_format(low)} to {_format(high)} mm"
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


def _format(values: np.ndarray) -> str:
    """Return numbers in a few digits, in brackets."""
    return f"({', '.join(f'{value:.5g}' for value in values.tolist())})"


def load_library(name: Literal["laspy", "lazrs", "pye57"], file_format: str) -> ModuleType:
    """Import a library for clouds; raises SetupError if it is not installed."""
    return optional_library(name, needed_by=file_format, extra="clouds", instead=", or write PLY or XYZ")


def shorten_error(error: BaseException) -> str:
    """Return a library's error message in one line of at most 200 characters."""
    return " ".join(str(error).split())[:200]
