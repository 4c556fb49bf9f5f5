"""E57 (ASTM E2807): points in m with intensity, image, line and time, and further fields as an extension."""

from __future__ import annotations

import uuid
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from uwlts.errors import CaptureError, OutputError
from uwlts.files.reading import require_regular_file
from uwlts.storage.cloud import FARTHEST_SINGLE_MM, FEW_ZEROS, PointCloud, find_float_step, make_foreign_cloud
from uwlts.storage.las_file import describe_units, load_library, shorten_error
from uwlts.storage.number_tables import Unit

PREFIX, EXTENSION = "uwlts", "urn:uwlts:point-fields"
"""Extension for fields that the standard does not define: the prefix of their names, and its name as a URI."""

COLOURS = "colorRed", "colorGreen", "colorBlue"
"""Columns of the standard for 8 bits of each colour."""
_LIMITS: tuple[tuple[str, Callable[[np.ndarray], Any]], ...] = (("Minimum", np.min), ("Maximum", np.max))
_PLACES = ("cartesianInvalidState", "sphericalInvalidState")
"""Fields that mark points without a position."""


def write_e57(
    path: Path,
    points_mm: np.ndarray,
    columns: dict[str, np.ndarray],
    *,
    to: Path,
    time_s: np.ndarray | None = None,
    further: dict[str, np.ndarray] | None = None,
) -> None:
    """Write points as one scan.

    Real numbers have 32 bits, coordinates farther than 16 m from the origin and times 64. A time is the sum of
    ``acquisitionStart``, the whole second before all of them, and a positive ``timeStamp``.

    ``columns`` and ``further`` hold columns (N,) by their names: those of the standard, and others that are stored as
    ``uwlts:NAME``. ``to`` is the final name of the file.

    Raises OutputError if writing fails; SetupError if pye57 is not installed.
    """
    pye57 = load_library("pye57", "E57")
    lib = pye57.libe57
    # Rounded first, so that the bounds in the file apply to the numbers in the file.
    single = np.abs(points_mm).max() <= FARTHEST_SINGLE_MM
    coordinates = (1e-3 * points_mm).astype(np.float32 if single else np.float64).astype(np.float64).T
    fields = dict(zip(("cartesianX", "cartesianY", "cartesianZ"), coordinates, strict=True)) | columns
    fields |= {f"{PREFIX}:{label}": values for label, values in (further or {}).items()}
    start = 0.0 if time_s is None else float(np.floor(time_s.min()))
    if time_s is not None:
        fields["timeStamp"] = time_s - start
    fields = {label: np.ascontiguousarray(values) for label, values in fields.items()}
    file: Any = None
    try:
        # The library's own scan writer supports neither times nor extensions.
        with (file := pye57.E57(str(path), mode="w")):
            image = file.image_file
            if further:
                image.extensionsAdd(PREFIX, EXTENSION)

            scan, prototype, buffers = lib.StructureNode(image), lib.StructureNode(image), lib.VectorSourceDestBuffer()
            scan.set("guid", lib.StringNode(image, f"{{{uuid.uuid4()}}}"))
            scan.set("name", lib.StringNode(image, to.stem))
            named = list(zip(("x", "y", "z"), coordinates, strict=True))
            scan.set("cartesianBounds", _structure(lib, image, _limits(named, float)))
            if "intensity" in fields:
                scan.set(
                    "intensityLimits", _structure(lib, image, _limits([("intensity", fields["intensity"])], float))
                )
            if COLOURS[0] in fields:
                limits = {
                    f"{label}{end}": full for label in COLOURS for end, full in (("Minimum", 0), ("Maximum", 255))
                }
                scan.set("colorLimits", _structure(lib, image, limits))
            if "rowIndex" in fields:
                named = [(each, fields[f"{each}Index"]) for each in ("row", "column")]
                scan.set("indexBounds", _structure(lib, image, _limits(named, int)))
            if time_s is not None:
                scan.set(
                    "acquisitionStart", _structure(lib, image, {"dateTimeValue": start, "isAtomicClockReferenced": 0})
                )
            for label, values in fields.items():
                double = label == "timeStamp" or (label.startswith("cartesian") and not single)
                prototype.set(label, _field_node(lib, image, values, double=double))
                buffers.append(lib.SourceDestBuffer(image, label, values, len(values), True, True))
            points = lib.CompressedVectorNode(image, prototype, lib.VectorNode(image, True))
            scan.set("points", points)
            file.data3d.append(scan)
            writer = points.writer(buffers)
            writer.write(len(points_mm))
            writer.close()
    except lib.E57Exception as error:
        # The library closes its file again when it is deleted.
        if file is not None:
            file.close = lambda: None
        full = " (is the disk full?)" if "ErrorWriteFailed" in str(error) else ""
        raise OutputError(f"cannot write {to}: {shorten_error(error).partition(' ****')[0]}{full}") from error


def _structure(lib: Any, image: Any, values: dict[str, Any]) -> Any:
    node = lib.StructureNode(image)
    for label, value in values.items():
        node.set(label, (lib.IntegerNode if isinstance(value, int) else lib.FloatNode)(image, value))
    return node


def _field_node(lib: Any, image: Any, values: np.ndarray, *, double: bool) -> Any:
    """Return the node of a column, with its limits."""
    low, high = values.min().item(), values.max().item()
    if values.dtype.kind in "iu":
        return lib.IntegerNode(image, low, low, high)
    return lib.FloatNode(image, low, lib.E57_DOUBLE if double else lib.E57_SINGLE, low, high)


def _limits(named: Sequence[tuple[str, np.ndarray]], kind: type[int] | type[float]) -> dict[str, int | float]:
    """Return ``xMinimum``, ``xMaximum`` and so on of columns (N,) by name."""
    return {f"{label}{end}": kind(of(values)) for label, values in named for end, of in _LIMITS}


def read_e57(path: Path, unit: Unit | None = None) -> PointCloud:
    """Read all points of a file in m, each scan at its pose; times are on the scanner's clock.

    Raises CaptureError if the file is damaged or has no scans, or states a coordinate system in another unit than m,
    and ``unit`` is not given; SetupError if pye57 is not installed.
    """
    pye57 = load_library("pye57", "E57")
    require_regular_file(path, called="cloud")
    try:
        with pye57.E57(str(path)) as file:
            scans = [
                file.read_scan(number, intensity=True, ignore_missing_fields=True)
                | {"time_s": _times(pye57, file, number)}
                for number in range(file.scan_count)
            ]
            headers = [file.get_header(number) for number in range(file.scan_count)]
            system = file.root["coordinateMetadata"].value() if file.root.isDefined("coordinateMetadata") else ""
            total = sum(header.point_count for header in headers)
            origins = [header.translation if header.has_pose() else np.zeros(3) for header in headers]
    except (pye57.libe57.E57Exception, OSError, RuntimeError, ValueError, KeyError, TypeError, MemoryError) as error:
        raise CaptureError(f"{path} is not a complete E57 file: {shorten_error(error)}") from error
    if not scans:
        raise CaptureError(f"{path} is an E57 file without scans")
    if unit is None and (stated := describe_units(system)).metres != (1.0, 1.0, 1.0):
        raise CaptureError(
            f"{path} states a coordinate system in {stated.name}, but E57 prescribes m: give the unit m if it is right"
        )
    placed = [np.column_stack([scan[f"cartesian{axis}"] for axis in "XYZ"]) for scan in scans]
    points = 1e3 * np.concatenate(placed)
    # Unmeasured points at 0 0 0 of their scan.
    at_scanner = np.concatenate([(xyz == origin).all(axis=1) for xyz, origin in zip(placed, origins, strict=True)])
    lit = all("intensity" in scan for scan in scans)
    timed = all(scan["time_s"] is not None for scan in scans)
    cloud = make_foreign_cloud(
        points,
        intensity=np.concatenate([scan["intensity"] for scan in scans]) if lit else None,
        time_s=np.concatenate([scan["time_s"] for scan in scans]) if timed else None,
        omitted={"at the position of their scanner": at_scanner} if np.count_nonzero(at_scanner) > FEW_ZEROS else {},
        step_mm=1e3 * find_float_step(np.concatenate(placed)),
    )
    if total > len(points):
        cloud.warnings.insert(0, f"{total - len(points)} of {total} points marked as invalid are omitted")
    return cloud


def _times(pye57: Any, file: Any, number: int) -> np.ndarray | None:
    """Return the times (N,) in s of a scan's valid points; None if some are unknown."""
    header = file.get_header(number)
    if "timeStamp" not in header.point_fields:
        return None
    labels = [each for each in ("timeStamp", "isTimeStampInvalid", *_PLACES) if each in header.point_fields]
    columns = {label: np.zeros(header.point_count) for label in labels}
    buffers = pye57.libe57.VectorSourceDestBuffer()
    for label, values in columns.items():
        buffers.append(pye57.libe57.SourceDestBuffer(file.image_file, label, values, len(values), True, True))
    header.points.reader(buffers).read()
    if columns.get("isTimeStampInvalid", np.zeros(1)).any():
        return None
    placed = np.ones(header.point_count, bool)
    for label in _PLACES:
        placed &= columns.get(label, 0) == 0
    scan = file.data3d[number]
    start = scan["acquisitionStart"]["dateTimeValue"].value() if scan.isDefined("acquisitionStart") else 0.0
    return start + columns["timeStamp"][placed]
