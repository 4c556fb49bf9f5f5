"""E57 (ASTM E2807): points in m with intensity, colour, image and line."""

from pathlib import Path
from typing import Any

import numpy as np

from uwlts.errors import CaptureError, OutputError
from uwlts.files.reading import require_regular_file
from uwlts.storage.cloud import FARTHEST_SINGLE_MM, FEW_ZEROS, PointCloud, find_float_step, make_foreign_cloud
from uwlts.storage.las_file import describe_units, load_library, shorten_error
from uwlts.storage.number_tables import Unit


def write_e57(aside: Path, cloud: PointCloud, colours: np.ndarray | None, path: Path) -> None:
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
    columns = dict(zip(("cartesianX", "cartesianY", "cartesianZ"), coordinates, strict=True))
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


def read_e57(path: Path, unit: Unit | None = None) -> PointCloud:
    """Read all points of a file in m, each scan at its pose.

    Raises CaptureError if the file is damaged or has no scans, or states a coordinate system in another unit than m,
    and ``unit`` is not given; SetupError if pye57 is not installed.
    """
    pye57 = load_library("pye57", "E57")
    require_regular_file(path, called="cloud")
    try:
        with pye57.E57(str(path)) as file:
            numbers = range(file.scan_count)
            scans = [file.read_scan(number, intensity=True, ignore_missing_fields=True) for number in numbers]
            headers = [file.get_header(number) for number in numbers]
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
    cloud = make_foreign_cloud(
        points,
        intensity=np.concatenate([scan["intensity"] for scan in scans]) if lit else None,
        omitted={"at the position of their scanner": at_scanner} if np.count_nonzero(at_scanner) > FEW_ZEROS else {},
        step_mm=1e3 * find_float_step(np.concatenate(placed)),
    )
    if total > len(points):
        cloud.warnings.insert(0, f"{total - len(points)} of {total} points marked as invalid are omitted")
    return cloud
