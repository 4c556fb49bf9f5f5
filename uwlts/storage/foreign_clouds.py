"""Clouds in formats of other programs and scanners: text, LAS, LAZ, E57 and ROS bags."""

import os
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Literal

import numpy as np

from uwlts.errors import CaptureError, DescriptionError, OutputError
from uwlts.files.reading import require_regular_file
from uwlts.storage.cloud import (
    FARTHEST_SINGLE_MM,
    FEW_ZEROS,
    PointCloud,
    compute_normal_std,
    find_float_step,
    make_foreign_cloud,
)
from uwlts.storage.las_file import describe_units, encode_las, load_library, read_las, shorten_error
from uwlts.storage.number_tables import Unit, read_number_table
from uwlts.storage.ros_messages import covariance_columns, mcap_content, read_bag_cloud

Colours = np.ndarray | None


@dataclass(frozen=True)
class CloudFormat:
    """Format of files with a cloud."""

    read: Callable[[Path, Unit | None], PointCloud]
    """Reads a file whose numbers are in a unit if it states none."""
    write: Callable[[Path, PointCloud, Colours, Path], object] | None = None
    """Writes a cloud with colours (N, 3) or None to a path that is renamed to the second one afterwards. None if
    files are only read."""
    libraries: tuple[Literal["laspy", "lazrs", "pye57"], ...] = ()  # optional libraries that writing needs
    coloured: bool = False  # whether points can have colours
    unit: Unit | None = None  # unit that the format prescribes, or None if files can be in any unit
    ambiguous: bool = False  # whether files with this ending usually contain something else


def find_format(path: str | os.PathLike[str]) -> CloudFormat | None:
    """Return the format of a file by its ending; None if it is no foreign format."""
    return FORMATS.get(Path(path).suffix.lower())


def _read_text(path: Path, unit: Unit | None) -> PointCloud:
    try:
        table = read_number_table(path, named=False)
        columns, scale = table.columns, table.mm_per_unit(unit=unit)
    except DescriptionError as error:
        raise CaptureError(str(error)) from error
    used = next((names for names in ("xyz", "012") if set(names) <= columns.keys()), None)
    if used is None:
        raise CaptureError(f"{path} has the columns {table.titles}; expected x, y and z in mm")
    points = np.column_stack([columns[name] for name in used])
    if used == "012" and len(columns) > 3 and len(points) > 2 and (np.diff(points[:, 0]) == 1).all():
        raise CaptureError(f"{path} counts its rows in the first column: name the columns, such as n x y z")
    step = scale * max(find_float_step(points), *(table.steps.get(name, 0.0) for name in used))
    cloud = make_foreign_cloud(scale * points, intensity=columns.get("intensity"), step_mm=step)
    return replace(cloud, warnings=[*table.notes, *cloud.warnings])


def _write_text(aside: Path, cloud: PointCloud, colours: Colours, path: Path) -> None:
    rows = zip(*cloud.points_mm.T.tolist(), cloud.intensity, strict=True)
    with open(aside, "w", encoding="utf-8") as file:
        # CloudCompare reads the names from a first line that begins with two slashes.
        file.write("//X Y Z Intensity\n")
        file.writelines(f"{x!r} {y!r} {z!r} {intensity!s}\n" for x, y, z, intensity in rows)


def _write_las(aside: Path, cloud: PointCloud, colours: Colours, path: Path) -> None:
    random, common = compute_normal_std(cloud)
    fields = {
        "amplitude": cloud.intensity,
        "frame": cloud.frame,
        "line": cloud.line,
        "deviation_mm": cloud.deviation_mm,
    }
    fields |= covariance_columns(cloud) | {"random_std_mm": random, "common_std_mm": common}
    known = {name: values for name, values in fields.items() if values is not None}
    compressed = path.suffix.lower() == ".laz"
    aside.write_bytes(
        encode_las(cloud.points_mm, cloud.intensity, known, time_s=cloud.time_s, colours=colours, compressed=compressed)
    )


def _write_e57(aside: Path, cloud: PointCloud, colours: Colours, path: Path) -> None:
    """Write points as one scan, with real numbers of 32 bits; columns have the names of the standard (ASTM E2807)."""
    unknown = np.isnan(cloud.intensity)
    if unknown.any() and not unknown.all():
        raise OutputError(
            f"{np.count_nonzero(unknown)} of {len(cloud)} points have no intensity, which this program's E57 cannot "
            "mark: write PLY, XYZ or LAZ"
        )
    pye57 = load_library("pye57", "E57")
    if (farthest := np.abs(cloud.points_mm).max()) > FARTHEST_SINGLE_MM:
        raise OutputError(
            f"cannot write {path}: points are {farthest / 1e3:.6g} m from the origin, where 32-bit "
            "numbers are coarser than a micrometre: write HDF5, PLY or LAZ, or move the cloud"
        )
    # Rounded first, so that the bounds in the file apply to the numbers in the file.
    coordinates = (1e-3 * cloud.points_mm).astype(np.float32).astype(np.float64).T
    columns: dict[str, Any] = dict(zip(("cartesianX", "cartesianY", "cartesianZ"), coordinates, strict=True))
    if not unknown.any():
        columns["intensity"] = cloud.intensity
    if colours is not None:
        columns |= dict(zip(("colorRed", "colorGreen", "colorBlue"), colours.T, strict=True))
    if all(numbers.min() >= 0 and numbers.max() < 2**16 for numbers in (cloud.frame, cloud.line)):
        columns |= {"columnIndex": cloud.frame.astype(np.uint16), "rowIndex": cloud.line.astype(np.uint16)}
    file: Any = None
    try:
        with (file := pye57.E57(str(aside), mode="w")):
            file.write_scan_raw({name: np.ascontiguousarray(each) for name, each in columns.items()}, name=path.stem)
    except pye57.libe57.E57Exception as error:
        # The library closes its file again when it is deleted.
        if file is not None:
            file.close = lambda: None
        full = " (is the disk full?)" if "ErrorWriteFailed" in str(error) else ""
        raise OutputError(f"cannot write {path}: {shorten_error(error).partition(' ****')[0]}{full}") from error


def _read_e57(path: Path, unit: Unit | None = None) -> PointCloud:
    """Read all points of a file in m, each scan at its pose.

    Raises CaptureError if the file is damaged or has no scans, or states a coordinate system in another unit than m,
    and ``unit`` is not given; SetupError if pye57 is not installed.
    """
    pye57 = load_library("pye57", "E57")
    require_regular_file(path, called="cloud")
    try:
        with pye57.E57(str(path)) as file:
            headers = [file.get_header(number) for number in range(file.scan_count)]
            scans = [file.read_scan(k, intensity=True, ignore_missing_fields=True) for k in range(len(headers))]
            system = file.root["coordinateMetadata"].value() if file.root.isDefined("coordinateMetadata") else ""
            total = sum(header.point_count for header in headers)
            origins = [header.translation if header.has_pose() else np.zeros(3) for header in headers]
    except (pye57.libe57.E57Exception, OSError, RuntimeError, ValueError, KeyError, TypeError, MemoryError) as error:
        raise CaptureError(f"{path} is not a complete E57 file: {shorten_error(error)}") from error
    if not scans:
        raise CaptureError(f"{path} is an E57 file without scans")
    stated = describe_units(system if unit is None else "")
    if stated.metres != (1.0, 1.0, 1.0):
        raise CaptureError(
            f"{path} states a coordinate system in {stated.name}, but E57 prescribes m: give the unit m if it is right"
        )
    placed = [np.column_stack([scan[f"cartesian{axis}"] for axis in "XYZ"]) for scan in scans]
    points = 1e3 * np.concatenate(placed)
    # Unmeasured points at 0 0 0 of their scan.
    at_scanner = np.concatenate([(xyz == origin).all(axis=1) for xyz, origin in zip(placed, origins, strict=True)])
    lit = all("intensity" in scan for scan in scans)
    cloud = make_foreign_cloud(
        points,
        intensity=np.concatenate([scan["intensity"] for scan in scans]) if lit else None,
        omitted={"at the position of their scanner": at_scanner} if np.count_nonzero(at_scanner) > FEW_ZEROS else {},
        step_mm=1e3 * find_float_step(np.concatenate(placed)),
    )
    if total > len(points):
        cloud.warnings.insert(0, f"{total - len(points)} of {total} points marked as invalid are omitted")
    cloud.warnings.extend(stated.notes)
    return cloud


FORMATS = {
    ".xyz": CloudFormat(_read_text, _write_text),
    ".laz": CloudFormat(read_las, _write_las, libraries=("laspy", "lazrs"), coloured=True, unit="m"),
    ".e57": CloudFormat(_read_e57, _write_e57, libraries=("pye57",), coloured=True, unit="m"),
    ".las": CloudFormat(read_las, _write_las, libraries=("laspy",), coloured=True, unit="m"),
    ".mcap": CloudFormat(
        read_bag_cloud, lambda aside, cloud, *_: aside.write_bytes(mcap_content(cloud)), unit="m", ambiguous=True
    ),
    ".bag": CloudFormat(read_bag_cloud, unit="m", ambiguous=True),
    ".txt": CloudFormat(_read_text, ambiguous=True),
    ".csv": CloudFormat(_read_text, ambiguous=True),
    ".asc": CloudFormat(_read_text, ambiguous=True),
}
"""Formats by the file's ending. Text has columns x, y, z by name, or the first three, and optionally intensity. Its
unit is that in these names, else the given one, by default mm."""
