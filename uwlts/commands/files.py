"""Commands about files: what they hold, and other formats."""

from pathlib import Path
from typing import Literal

from uwlts.commands.options import Flag, app, warn
from uwlts.console import progress_bar


@app.command
def info(path: str) -> None:
    """Say what a file holds: a capture, cloud, calibration, evaluation, or a sensor description (by name or path).

    Example: uwlts info capture.h5

    Parameters
    ----------
    path
        File, or name of a shipped sensor such as thesis.
    """
    from uwlts.inventory import describe

    print(describe(path))


@app.command(name="import")
def import_images(folder: Path, *, out: Path, description: Path | None = None, overwrite: Flag = False) -> None:
    """Turn a folder of images of any camera into a capture.

    Example: uwlts import photographs --out target.h5

    Parameters
    ----------
    folder
        Folder of PNG, TIFF, BMP or JPEG images.
    out
        Capture to write.
    description
        TOML file with sensor, medium, positions, and which image is what; import.toml in the folder unless given.
    overwrite
        Replace an existing file.
    """
    from uwlts.importing import import_folder

    with progress_bar(f"importing {folder.name}") as progress:
        imported = import_folder(folder, out, description=description, overwrite=overwrite, progress=progress)
    for warning in imported.warnings:
        warn(warning)
    print(f"wrote {out} with {imported.laser} laser and {imported.lamp} lamp images")


@app.command
def export(file: Path, *, out: Path, images: Literal["png", "tiff"] = "png", overwrite: Flag = False) -> None:
    """Write a capture as a folder of images that `uwlts import` reads back, or a cloud in another format.

    Example: uwlts export scan.ply --out scan.laz

    Parameters
    ----------
    file
        Capture (.h5) or cloud (.ply or .h5).
    out
        New folder for a capture; for a cloud a file whose ending names the format: .ply, .h5, .xyz (text), .laz or
        .e57.
    images
        Format of a capture's images; both keep all bits.
    overwrite
        Replace an existing cloud.
    """
    from uwlts.capture import Capture
    from uwlts.cloud import is_cloud, read_cloud
    from uwlts.exporting import export_capture, export_cloud

    if is_cloud(file):
        cloud = read_cloud(file)
        export_cloud(cloud, out, overwrite=overwrite)
        print(f"wrote {out} with {len(cloud)} points")
        return
    with Capture(file) as capture, progress_bar(f"exporting {file.name}") as progress:
        export_capture(capture, out, image_format=images, progress=progress)
        print(f"wrote {len(capture)} images and import.toml to {out}")
