"""Clouds of other programs and scanners: text, LAS, E57.

LAZ is read as COPC only: the decompressor ends the process on some damaged files.
"""

import struct
from pathlib import Path
from typing import NamedTuple

import numpy as np

from uwlts.errors import CaptureError, DescriptionError
from uwlts.files.reading import opened
from uwlts.storage.e57_file import read_e57
from uwlts.storage.las_file import brief, library
from uwlts.storage.pose_files import read_columns

TEXT_FORMATS = (".xyz", ".txt", ".csv", ".asc")
"""Columns x, y, z by name, or the first three, in mm; and perhaps intensity."""
FOREIGN_FORMATS = (*TEXT_FORMATS, ".las", ".e57")

_LAS_START, _LAS_RECORD = 104, 54
"""Bytes of a LAS header up to its number of variable length records, and fewest bytes of such a record."""


class ForeignPoints(NamedTuple):
    """Points (N, 3) in mm and columns (N,) of a file, None where it has no such field."""

    points_mm: np.ndarray
    intensity: np.ndarray | None = None
    frame: np.ndarray | None = None
    line: np.ndarray | None = None
    deviation_mm: np.ndarray | None = None
    time_s: np.ndarray | None = None


def read_foreign(path: Path) -> ForeignPoints:
    """All points of a file whose suffix is one of `FOREIGN_FORMATS`: text in mm; LAS and E57 in m, as they prescribe.

    Scans of an E57 file are taken together, each at its pose. Raises CaptureError where the file is damaged or foreign,
    SetupError where the library of its format is not installed.
    """
    with opened(path, called="cloud") as file:
        start = file.read(_LAS_START)
    suffix = path.suffix.lower()
    if suffix in TEXT_FORMATS:
        return _read_text(path)
    if suffix == ".las":
        return _read_las(path, start)
    found = read_e57(path)
    return ForeignPoints(found.points_mm, found.intensity, time_s=found.time_s)


def _read_text(path: Path) -> ForeignPoints:
    try:
        columns = read_columns(path, {}, named=False)
    except DescriptionError as error:
        raise CaptureError(str(error)) from error
    # CloudCompare's first line begins with two strokes.
    columns = {name.lstrip("/").strip(): values for name, values in columns.items()}
    axes = [columns[axis] for axis in "xyz" if axis in columns]
    if len(axes) < 3:
        if "0" not in columns or len(columns) < 3:
            raise CaptureError(f"{path} has the columns {', '.join(columns)}; expected x, y and z in mm")
        axes = [columns[number] for number in "012"]
    points = np.column_stack(axes)
    seen = np.isfinite(points).all(axis=1)
    intensity = columns.get("intensity")
    return ForeignPoints(points[seen], None if intensity is None else intensity[seen])


def _read_las(path: Path, start: bytes) -> ForeignPoints:
    laspy = library("laspy", "LAS")
    try:
        # The library reads as many records before the points as the header declares, however many.
        points_begin, records = struct.unpack("<II", start[96:_LAS_START])
        if records * _LAS_RECORD > points_begin:
            raise ValueError(f"{records} records do not fit before its points")
        with laspy.open(path, read_evlrs=False) as reader:
            header = reader.header
            needed = header.offset_to_point_data + header.point_count * header.point_format.size
            if header.are_points_compressed or needed > path.stat().st_size:
                raise ValueError("its points are compressed, or fewer than its header declares")
            found = reader.read_points(header.point_count)
        points = 1e3 * np.column_stack([found.x, found.y, found.z])
        names = set(found.point_format.dimension_names)
        column = {name: np.asarray(found[name]) for name in names & {"frame", "line", "deviation_mm", "gps_time"}}
        intensity = np.asarray(found["amplitude" if "amplitude" in names else "intensity"], np.float32)
    except (
        OSError,
        RuntimeError,
        ValueError,
        KeyError,
        MemoryError,
        struct.error,
        laspy.errors.LaspyException,
    ) as error:
        raise CaptureError(f"{path} is not a complete LAS file: {brief(error)}") from error
    times = column.get("gps_time")
    return ForeignPoints(
        points,
        intensity,
        column.get("frame"),
        column.get("line"),
        column.get("deviation_mm"),
        # Programs leave it 0 where they know no times.
        None if times is None or not times.any() else times,
    )
