"""LAS and LAZ for other programs: points in m, in steps of 0.1 um, with extra fields.

LAZ is read as COPC only: the decompressor terminates the process on some damaged files.
"""

import struct
from io import BytesIO
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
INTENSITY_LIMITS = 0, 2**16 - 1  # 16 bits
_NOISE_CLASSES = 7, 18
"""Low and high noise."""
_BOX_MARGIN = 1e-3
"""Distance of points outside the stated box that is allowed, in its longest edges."""
START_BYTES = 104
"""Bytes of a LAS header up to its number of variable length records (LAS 1.4, 2.4)."""
RECORD_BYTES = 54
"""Smallest size of such a record in bytes: its header (LAS 1.4, 2.5)."""


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
    middle = las_middle(points.min(axis=0), points.max(axis=0))
    header = laspy.LasHeader(version="1.4", point_format=6 if colours is None else 7)
    header.offsets, header.scales = middle, np.full(3, LAZ_STEP_M)
    header.add_extra_dims([laspy.ExtraBytesParams(name=name, type=values.dtype) for name, values in fields.items()])
    table = laspy.LasData(header)
    table.x, table.y, table.z = points.T
    table.intensity = np.rint(np.nan_to_num(intensity)).clip(*INTENSITY_LIMITS).astype(np.uint16)
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


def las_middle(low_m: np.ndarray, high_m: np.ndarray) -> np.ndarray:
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
    """Read all points of a LAS file; raises CaptureError if it is damaged or compressed, SetupError without laspy."""
    laspy = load_library("laspy", "LAS")
    with open_regular(path, called="cloud") as file:
        start = file.read(START_BYTES)
    try:
        # The library reads as many records before the points as the header declares, without a limit.
        points_begin, records = struct.unpack("<II", start[96:START_BYTES])
        if points_begin > path.stat().st_size or records * RECORD_BYTES > points_begin:
            raise ValueError(f"{records} records do not fit before its points, or these begin beyond its end")
        with laspy.open(path, read_evlrs=False) as reader:
            header = reader.header
            needed = header.offset_to_point_data + header.point_count * header.point_format.size
            if header.are_points_compressed or needed > path.stat().st_size:
                raise ValueError("its points are compressed, or fewer than its header declares")
            found = reader.read_points(header.point_count)
        points, step = 1e3 * np.column_stack([found.x, found.y, found.z]), 1e3 * float(np.max(header.scales))
        require_in_box(points, header, whole=True)
        names = set(found.point_format.dimension_names)
        column = {name: np.asarray(found[name]) for name in names & {"frame", "line", "deviation_mm", "gps_time"}}
        intensity = np.asarray(found["amplitude" if "amplitude" in names else "intensity"], np.float32)
        omitted = unwanted_points(found)
    except (
        OSError,
        RuntimeError,
        ValueError,
        KeyError,
        MemoryError,
        struct.error,
        laspy.errors.LaspyException,
    ) as error:
        raise CaptureError(f"{path} is not a complete LAS file: {shorten_error(error)}") from error
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


def require_in_box(points_mm: np.ndarray, header: Any, *, whole: bool) -> None:
    """Raise ValueError if points (N, 3) contradict the box that a header states, which a wrong scale or offset causes.

    Points are outside the box; or its corners are beyond the largest integers; or the points' own box is that of the
    header scaled about the origin of the integers, if the points are those of the ``whole`` file. Boxes that are empty
    state nothing.
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
    if beyond or unreachable or (whole and _is_scaled(stated, found, margin, step)):
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


def unwanted_points(found: Any) -> dict[str, np.ndarray]:
    """Return masks (N,) of LAS points that are marked as unwanted, by reason (LAS 1.4, tables 8, 16 and 17)."""
    return {
        "marked as withheld": np.asarray(found.withheld, bool),
        "classified as noise": np.isin(np.asarray(found.classification), _NOISE_CLASSES),
    }


def load_library(name: Literal["laspy", "lazrs", "copclib", "pye57"], file_format: str) -> ModuleType:
    """Import a library for clouds; raises SetupError if it is not installed."""
    return optional_library(name, needed_by=file_format, extra="clouds", instead=", or write PLY or XYZ")


def shorten_error(error: BaseException) -> str:
    """Return a library's error message in one line of at most 200 characters."""
    return " ".join(str(error).split())[:200]
