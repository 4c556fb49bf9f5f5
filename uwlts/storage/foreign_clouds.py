"""Clouds in formats of other programs and scanners: text, PCD, LAS, E57; LAZ, COPC and MCAP are only written here."""

from dataclasses import replace
from pathlib import Path
from typing import Literal

import numpy as np

from uwlts.errors import CaptureError, DescriptionError, OutputError
from uwlts.files.writing import write_atomically
from uwlts.storage.cloud import PointCloud, find_float_step, make_foreign_cloud
from uwlts.storage.copc_file import is_copc, write_copc
from uwlts.storage.e57_file import COLOURS, read_e57, write_e57
from uwlts.storage.las_file import encode_las, load_library, read_las
from uwlts.storage.mcap_clouds import mcap_content
from uwlts.storage.number_tables import MM_PER_UNIT, Unit, check_unit, read_number_table
from uwlts.storage.pcd_file import read_pcd
from uwlts.storage.point_cloud2 import covariance_columns

TEXT_FORMATS = (".xyz", ".txt", ".csv", ".asc")
"""Columns x, y, z by name, or the first three, in mm or the unit of their names; and optionally intensity."""
FOREIGN_FORMATS = (*TEXT_FORMATS, ".las", ".e57", ".pcd")
WRITTEN_FORMATS = (".xyz", ".laz", ".e57", ".las", ".mcap")


def read_foreign(path: Path, *, unit: Unit | None = None) -> PointCloud:
    """Read all points of a file in one of `FOREIGN_FORMATS`.

    Text is in the unit that the names of its columns state, else in ``unit``, by default mm; PCD is in ``unit``; LAS
    and E57 are in m, as they prescribe. The scans of an E57 file are combined, each at its pose.

    Raises CaptureError if the file is damaged or foreign, SetupError if the library for its format is not installed.
    """
    match path.suffix.lower():
        case ".las":
            return read_las(path)
        case ".e57":
            return read_e57(path)
        case ".pcd":
            return _read_pcd(path, unit)
        case _:
            return _read_text(path, unit)


def _read_pcd(path: Path, unit: Unit | None) -> PointCloud:
    columns, warnings = read_pcd(path)
    if missing := [axis for axis in "xyz" if axis not in columns]:
        raise CaptureError(f"{path} has no {', '.join(missing)}, only {', '.join(columns) or 'nothing'}")
    points, scale = np.column_stack([columns[axis] for axis in "xyz"]), MM_PER_UNIT[check_unit(unit or "mm")]
    step = scale * find_float_step(points)
    cloud = make_foreign_cloud(scale * points.astype(np.float64), intensity=columns.get("intensity"), step_mm=step)
    return replace(cloud, warnings=[*warnings, *cloud.warnings])


def _read_text(path: Path, unit: Unit | None) -> PointCloud:
    try:
        table = read_number_table(path, named=False)
        columns, scale = table.columns, table.mm_per_unit(unit=unit)
    except DescriptionError as error:
        raise CaptureError(str(error)) from error
    used = next((names for names in ("xyz", "012") if set(names) <= columns.keys()), None)
    if used is None:
        raise CaptureError(f"{path} has the columns {', '.join(columns)}; expected x, y and z in mm")
    points = np.column_stack([columns[name] for name in used])
    if used == "012" and len(columns) > 3 and len(points) > 2 and (np.diff(points[:, 0]) == 1).all():
        raise CaptureError(f"{path} counts its rows in the first column: name the columns, such as n x y z")
    step = scale * max(find_float_step(points), *(table.steps.get(name, 0.0) for name in used))
    cloud = make_foreign_cloud(scale * points, intensity=columns.get("intensity"), step_mm=step)
    return replace(cloud, warnings=[*table.notes, *cloud.warnings])


def write_foreign(path: Path, cloud: PointCloud, *, overwrite: bool, colours: np.ndarray | None = None) -> None:
    """Write a cloud in one of `WRITTEN_FORMATS`, by the path's suffix, completely or not at all.

    Raises OutputError if the file exists, the cloud is empty, too wide for LAS, or lacks some intensities in E57, or
    writing fails; SetupError if the format's library is not installed.
    """
    if len(cloud) == 0:
        raise OutputError(f"the cloud has no points, and {path.suffix} cannot hold none: write PLY or HDF5")
    if is_copc(path):
        write_copc(path, lambda: [cloud], overwrite=overwrite)
        return
    with write_atomically(path, overwrite=overwrite) as aside:
        match path.suffix.lower():
            case ".xyz":
                rows = zip(*cloud.points_mm.T.tolist(), cloud.intensity, strict=True)
                with open(aside, "w", encoding="utf-8") as file:
                    # CloudCompare reads the names from a first line that begins with two slashes.
                    file.write("//X Y Z Intensity\n")
                    file.writelines(f"{x!r} {y!r} {z!r} {intensity!s}\n" for x, y, z, intensity in rows)
            case ".laz" | ".las" as suffix:
                fields = {"amplitude": cloud.intensity, "frame": cloud.frame, "line": cloud.line}
                if cloud.deviation_mm is not None:
                    fields["deviation_mm"] = cloud.deviation_mm
                fields |= covariance_columns(cloud)
                content = encode_las(
                    cloud.points_mm,
                    cloud.intensity,
                    fields,
                    time_s=cloud.time_s,
                    colours=colours,
                    compressed=suffix == ".laz",
                )
                aside.write_bytes(content)
            case ".mcap":
                aside.write_bytes(mcap_content(cloud, foxglove=path.name.lower().endswith(".foxglove.mcap")))
            case _:
                _write_e57(cloud, aside, path, colours)


_LIBRARIES: dict[str, tuple[Literal["laspy", "lazrs", "copclib", "pye57"], ...]] = {
    ".copc.laz": ("copclib",),
    ".laz": ("laspy", "lazrs"),
    ".las": ("laspy",),
    ".e57": ("pye57",),
}


def require_libraries(path: Path) -> None:
    """Raise SetupError if a library for writing a file with this ending is not installed."""
    ending = next((each for each in _LIBRARIES if path.name.lower().endswith(each)), "")
    for name in _LIBRARIES.get(ending, ()):
        load_library(name, ending.strip(".").upper())


def _write_e57(cloud: PointCloud, aside: Path, path: Path, colours: np.ndarray | None) -> None:
    unknown = np.isnan(cloud.intensity)
    if unknown.any() and not unknown.all():
        raise OutputError(
            f"{np.count_nonzero(unknown)} of {len(cloud)} points have no intensity, which this program's E57 cannot "
            "mark: write PLY, XYZ or LAZ"
        )
    columns = {} if unknown.any() else {"intensity": cloud.intensity}
    if colours is not None:
        columns |= dict(zip(COLOURS, colours.T, strict=True))
    if all(numbers.min() >= 0 and numbers.max() < 2**16 for numbers in (cloud.frame, cloud.line)):
        columns |= {"columnIndex": cloud.frame.astype(np.uint16), "rowIndex": cloud.line.astype(np.uint16)}
    further = covariance_columns(cloud)
    write_e57(aside, cloud.points_mm, columns, to=path, time_s=cloud.time_s, further=further)
