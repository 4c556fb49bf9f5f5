"""Export of captures as folders of images for `uwlts import`, and of clouds in other formats."""

import csv
import os
import secrets
import shutil
from pathlib import Path
from typing import Literal

import cv2
import tomli_w

from uwlts.errors import CaptureError, OutputError
from uwlts.files.writing import require_possible_name
from uwlts.runtime.progress import ProgressListener, ignore_progress
from uwlts.storage.capture import Capture
from uwlts.storage.cloud_files import (
    CLOUD_FORMATS,
    is_readable_cloud,
    read_region,
    read_thinned_cloud,
    refuse_unsuitable_cloud,
    write_cloud,
)
from uwlts.storage.import_.folder_description import NAME
from uwlts.storage.import_.matching import POSE_COLUMNS
from uwlts.storage.number_tables import Unit

HEADER, TABLE = "header.json", "frames.csv"
_COLUMNS = ("file", "light", "stage_mm", "exposure_ms", "time_s")

Corner = tuple[float, float, float]


def export(
    file: str | Path,
    out: str | Path,
    *,
    images: Literal["png", "tiff"] = "png",
    region_mm: tuple[Corner, Corner] | None = None,
    at_most: int | None = None,
    unit: Unit | None = None,
    overwrite: bool = False,
    progress: ProgressListener = ignore_progress,
) -> int:
    """Write a capture as a folder of images that uwlts import reads back, or a cloud in another format.

    Parameters
    ----------
    file : str or Path
        Capture (.h5) or cloud (.ply, .h5, or .xyz, .txt, .csv, .asc, .las, .laz, .e57 of other programs).
    out : str or Path
        New folder for a capture; for a cloud a file whose ending names the format: .ply, .h5, .xyz (text), .laz,
        .las, .e57 or .mcap (ROS 2).
    images : {"png", "tiff"}
        Format of a capture's images; both keep all bits.
    region_mm : pair of (3,), optional
        Only the points in a box: x y z of one corner, x y z of the other.
    at_most : int, optional
        Only an even sample of about this many points.
    unit : {"mm", "m"}, optional
        Unit of clouds of other programs, if neither format nor names of columns state it; by default mm.
    overwrite : bool
        Replace an existing cloud.
    progress : callable, optional
        Called with the number of finished images and the total.

    Returns
    -------
    int
        Number of images or points that were written.

    Raises
    ------
    OutputError
        The folder or file exists already, or cannot be written.
    CaptureError
        The capture or cloud cannot be read.
    SetupError
        The library for the cloud's format is not installed.
    """
    if is_readable_cloud(file):
        refuse_unsuitable_cloud(out, overwrite=overwrite)
        cloud = (
            read_thinned_cloud(file, at_most, unit=unit)[0]
            if region_mm is None
            else read_region(file, *region_mm, at_most, unit=unit)
        )
        if len(cloud) == 0:
            raise OutputError("the cloud has no points: there is nothing to export")
        write_cloud(out, cloud, overwrite=overwrite)
        return len(cloud)
    if region_mm is not None or at_most is not None:
        raise CaptureError(f"{file} is not a cloud: only clouds have regions and points")
    with Capture(file) as capture:
        if Path(out).name.lower().endswith(CLOUD_FORMATS):
            raise OutputError(
                f"{file} is a capture, which is exported to a folder of images, but {out} is named like a cloud; "
                "give the name of a new folder, or make a cloud of it first (uwlts reconstruct)"
            )
        export_capture(capture, Path(out), image_format=images, progress=progress)
        return len(capture)


def export_capture(
    capture: Capture,
    folder: Path,
    *,
    image_format: Literal["png", "tiff"] = "png",
    progress: ProgressListener = ignore_progress,
) -> None:
    """Write a capture's frames without loss as images of the same depth into a new folder, completely or not at all.

    The folder also contains header.json, import.toml, and frames.csv with the columns file, light, stage_mm,
    exposure_ms, time_s and, if any frame has one, the elements of the pose.

    Raises OutputError if the folder exists, its parent is missing, or writing fails; CaptureError if a frame is
    damaged.
    """
    require_possible_name(folder)
    if folder.exists():
        raise OutputError(f"{folder} exists already; give the name of a new folder")
    if not folder.parent.is_dir():
        raise OutputError(f"cannot make {folder}: the folder {folder.parent} does not exist; create it first")
    aside = folder.parent / f".{secrets.token_hex(8)}"
    try:
        aside.mkdir()
        rows = []
        for index, frame in enumerate(capture):
            light = "laser" if frame.laser_on else "lamp"
            name = f"{index:05d}-{light}.{image_format}"
            _, encoded = cv2.imencode(f".{image_format}", frame.image)
            (aside / name).write_bytes(encoded.tobytes())
            pose = [] if frame.pose is None else frame.pose.ravel().tolist()
            rows.append([name, light, frame.stage_mm, frame.exposure_ms, frame.time_s, *pose])
            progress(index + 1, len(capture))
        # Only captures with a pose have its columns, which are the last ones.
        width = max(map(len, rows), default=len(_COLUMNS))
        with open(aside / TABLE, "w", newline="", encoding="utf-8") as file:
            table = csv.writer(file, lineterminator="\n")
            table.writerow((*_COLUMNS, *POSE_COLUMNS)[:width])
            table.writerows([*row, *[""] * (width - len(row))] for row in rows)
        (aside / HEADER).write_text(capture.header.model_dump_json(indent=2) + "\n", encoding="utf-8")
        description = {"header": HEADER, "table": TABLE, "repeated": True}
        (aside / NAME).write_text(tomli_w.dumps(description), encoding="utf-8")
        os.rename(aside, folder)
    except OSError as error:
        raise OutputError(f"cannot write {folder}: {error.strerror or error}") from error
    finally:
        shutil.rmtree(aside, ignore_errors=True)
