"""Export of captures as folders of images that `uwlts import` reads back, and of clouds in other formats."""

import csv
import os
import secrets
import shutil
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Literal

import cv2
import numpy as np
import tomli_w

from uwlts.errors import CaptureError, OutputError
from uwlts.files.command_files import keeps_inputs
from uwlts.files.writing import refuse_unsuitable, require_possible_name, written_aside
from uwlts.model.stripe import rows_of
from uwlts.storage.capture import Capture
from uwlts.storage.cloud import PointCloud
from uwlts.storage.cloud_files import cloud_parts, is_cloud, read_cloud, read_region, read_thinned_cloud, write_cloud
from uwlts.storage.copc_file import is_copc, write_copc
from uwlts.storage.e57_file import write_e57
from uwlts.storage.import_.folder_description import NAME
from uwlts.storage.import_.matching import POSE_COLUMNS
from uwlts.storage.las_file import laz_content
from uwlts.storage.mcap_clouds import covariance_columns, mcap_of
from uwlts.stripe import Stripe

HEADER, TABLE = "header.json", "frames.csv"
_COLUMNS = ("file", "light", "stage_mm", "exposure_ms", "time_s")


@keeps_inputs
def export(
    file: str | Path,
    out: str | Path,
    *,
    images: Literal["png", "tiff"] = "png",
    region_mm: tuple[Sequence[float], Sequence[float]] | None = None,
    at_most: int | None = None,
    overwrite: bool = False,
    progress: Callable[[int, int], None] = lambda done, total: None,
) -> int:
    """Write a capture as a folder of images that `import_images` reads back, or a cloud in another format.

    Parameters
    ----------
    file : str or Path
        Capture (.h5) or cloud (.ply, .h5 or .copc.laz).
    out : str or Path
        New folder for a capture; for a cloud a file whose ending names the format: .ply, .h5, .xyz (text), .laz,
        .e57, .mcap (ROS 2), .foxglove.mcap, or .copc.laz, which is written a part at a time.
    images : {"png", "tiff"}
        Format of a capture's images; both keep all bits.
    region_mm : pair of (3,), optional
        Only the points in the box from the first to the second corner.
    at_most : int, optional
        Only an even sample of about so many points.
    overwrite : bool
        Replace an existing cloud.
    progress : callable, optional
        Called with the number of images done and the number in all.

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
    if region_mm is not None or at_most is not None:
        if not is_cloud(file):
            raise CaptureError(f"{file} is no cloud: only clouds have regions and points")
        cloud = read_thinned_cloud(file, at_most)[0] if region_mm is None else read_region(file, *region_mm, at_most)
        export_cloud(cloud, Path(out), overwrite=overwrite)
        return len(cloud)
    if is_cloud(file) and is_copc(out):
        refuse_unsuitable(Path(out), overwrite=overwrite)
        return write_copc(out, lambda: cloud_parts(file), overwrite=overwrite, progress=progress)
    if is_cloud(file):
        cloud = read_cloud(file)
        export_cloud(cloud, Path(out), overwrite=overwrite)
        return len(cloud)
    with Capture(file) as capture:
        export_capture(capture, Path(out), image_format=images, progress=progress)
        return len(capture)


def export_capture(
    capture: Capture,
    folder: Path,
    *,
    image_format: Literal["png", "tiff"] = "png",
    progress: Callable[[int, int], None] = lambda done, total: None,
) -> None:
    """Write a capture's frames as images of its own depth, without loss, into a new folder; whole or not at all.

    Centre lines become arrays (.npy) of a profile (1, 4, L): centre, amplitude, width and status of every line.

    Beside them stand frames.csv (file, light, stage_mm, exposure_ms, time_s, and the pose's elements if any frame has
    one), header.json and import.toml. OutputError where the folder exists, its parent is missing, or storage fails;
    CaptureError where a frame's data are damaged.
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
            if isinstance(frame.seen, Stripe):
                name = f"{index:05d}-{light}.npy"
                np.save(aside / name, rows_of(frame.seen)[None])
            else:
                name = f"{index:05d}-{light}.{image_format}"
                _, encoded = cv2.imencode(f".{image_format}", frame.seen)
                (aside / name).write_bytes(encoded.tobytes())
            pose = [] if frame.pose is None else frame.pose.ravel().tolist()
            encoder = [] if not capture.holds_lines else ["" if frame.encoder is None else frame.encoder]
            rows.append([name, light, frame.stage_mm, frame.exposure_ms, frame.time_s, *encoder, *pose])
            progress(index + 1, len(capture))
        # Only captures with a pose have its columns, which stand last.
        columns = (*_COLUMNS, "encoder") if capture.holds_lines else _COLUMNS
        width = max(map(len, rows), default=len(columns))
        with open(aside / TABLE, "w", newline="", encoding="utf-8") as file:
            table = csv.writer(file, lineterminator="\n")
            table.writerow((*columns, *POSE_COLUMNS)[:width])
            table.writerows([*row, *[""] * (width - len(row))] for row in rows)
        (aside / HEADER).write_text(capture.header.model_dump_json(indent=2) + "\n", encoding="utf-8")
        description = {"header": HEADER, "table": TABLE, "repeated": True}
        if capture.holds_lines:
            description |= {"centre_lines": {}}
        (aside / NAME).write_text(tomli_w.dumps(description), encoding="utf-8")
        os.rename(aside, folder)
    except OSError as error:
        raise OutputError(f"cannot write {folder}: {error.strerror or error}") from error
    finally:
        shutil.rmtree(aside, ignore_errors=True)


CLOUD_FORMATS = (".ply", ".h5", ".xyz", ".laz", ".e57", ".mcap")


def export_cloud(cloud: PointCloud, path: Path, *, overwrite: bool = False) -> None:
    """Write a cloud in the format that the path's suffix names, whole or not at all.

    - ``.ply``, ``.h5``: as `uwlts.storage.cloud_files.write_cloud`; mm, everything kept.
    - ``.xyz``: text, a line of names, then X Y Z in mm and the intensity (nan where unknown) of every point, with all
      the digits that they have.
    - ``.laz``: LAS 1.4, point format 6, metres in steps of 1e-7 m. The standard intensity is rounded to whole numbers
      (0 where unknown); ``amplitude`` holds it as it is, the standard ``gps_time`` the time in s where it is known,
      ``frame``, ``line``, ``deviation_mm`` and the covariance ``cov_xx_mm2`` to ``cov_zz_mm2`` the rest.
    - ``.copc.laz``: the same without times and covariances as COPC, in an octree with levels of detail.
    - ``.e57``: metres and intensity as 32-bit floating point numbers, that is to 6e-8 of the coordinate; the
      image as column, the line as row where both are known and below 65536; ``timeStamp`` in 64 bits since
      ``acquisitionStart`` where times are known; the covariance as extension, ``uwlts:cov_xx_mm2`` to
      ``uwlts:cov_zz_mm2``.
    - ``.mcap``: messages sensor_msgs/msg/PointCloud2 of ROS 2, and where the name ends with ``.foxglove.mcap``
      foxglove.PointCloud; one for each image where the points' times are known (`uwlts.storage.mcap_clouds`).

    OutputError where the suffix is none of these, the file exists, the cloud is empty, too wide for LAZ, or lacks
    intensities that E57 cannot leave out, or storage fails; SetupError where the format's library is not installed.
    """
    suffix = path.suffix.lower()
    if suffix not in CLOUD_FORMATS:
        raise OutputError(f"{path} ends with none of {', '.join(CLOUD_FORMATS)}, which name the format of a cloud")
    refuse_unsuitable(path, overwrite=overwrite)
    if len(cloud) == 0:
        raise OutputError("the cloud has no points: there is nothing to export")
    if suffix in (".ply", ".h5"):
        write_cloud(path, cloud, overwrite=overwrite)
        return
    if is_copc(path):
        write_copc(path, lambda: [cloud], overwrite=overwrite)
        return
    with written_aside(path, overwrite=overwrite) as aside:
        if suffix == ".xyz":
            rows = zip(*cloud.points_mm.T.tolist(), cloud.intensity, strict=True)
            with open(aside, "w", encoding="utf-8") as file:
                # CloudCompare takes the names from a first line that begins so.
                file.write("//X Y Z Intensity\n")
                file.writelines(f"{x!r} {y!r} {z!r} {intensity!s}\n" for x, y, z, intensity in rows)
        elif suffix == ".laz":
            fields = {"amplitude": cloud.intensity, "frame": cloud.frame, "line": cloud.line}
            if cloud.deviation_mm is not None:
                fields["deviation_mm"] = cloud.deviation_mm
            fields |= covariance_columns(cloud)
            aside.write_bytes(laz_content(cloud.points_mm, cloud.intensity, fields, time_s=cloud.time_s))
        elif suffix == ".mcap":
            aside.write_bytes(mcap_of(cloud, foxglove=path.name.lower().endswith(".foxglove.mcap")))
        else:
            _write_e57(cloud, aside, path)


def _write_e57(cloud: PointCloud, aside: Path, path: Path) -> None:
    unknown = np.isnan(cloud.intensity)
    if unknown.any() and not unknown.all():
        raise OutputError(
            f"{np.count_nonzero(unknown)} of {len(cloud)} points have no intensity, which E57 as written here cannot "
            "mark: write PLY, XYZ or LAZ"
        )
    columns = {} if unknown.any() else {"intensity": cloud.intensity}
    if all(numbers.min() >= 0 and numbers.max() < 2**16 for numbers in (cloud.frame, cloud.line)):
        columns |= {"columnIndex": cloud.frame.astype(np.uint16), "rowIndex": cloud.line.astype(np.uint16)}
    further = covariance_columns(cloud)
    write_e57(aside, cloud.points_mm, columns, to=path, time_s=cloud.time_s, further=further)
