"""Clouds in formats of other programs and scanners: text, LAS, LAZ, E57 and ROS bags."""

import os
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Literal

import numpy as np

from uwlts.errors import CaptureError, DescriptionError
from uwlts.storage.cloud import PointCloud, compute_normal_std, find_float_step, make_foreign_cloud
from uwlts.storage.e57_file import read_e57, write_e57
from uwlts.storage.las_file import encode_las, read_las
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


FORMATS = {
    ".xyz": CloudFormat(_read_text, _write_text),
    ".laz": CloudFormat(read_las, _write_las, libraries=("laspy", "lazrs"), coloured=True, unit="m"),
    ".e57": CloudFormat(read_e57, write_e57, libraries=("pye57",), coloured=True, unit="m"),
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
