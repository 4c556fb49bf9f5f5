"""Commands about sensors and files: what they hold, what they give, and other formats."""

from pathlib import Path
from typing import Literal

from uwlts.cli.options import Flag, app, warn
from uwlts.runtime.console import progress_bar


@app.command
def design(sensor: str, *, medium: str) -> None:
    """Say what a sensor can do by the design formulas: resolution, line length, depth range, speckle limit.

    Example: uwlts design thesis --medium water

    Parameters
    ----------
    sensor
        Name or path of a sensor description.
    medium
        One of the sensor's media.
    """
    from uwlts.model.library import load_sensor
    from uwlts.report.inventory import design_table, table_lines

    described = load_sensor(sensor)
    print("\n".join(table_lines(design_table(described, described.medium(medium)))))


@app.command
def nominal(sensor: str, *, medium: str, out: Path, overwrite: Flag = False) -> None:
    """Write the calibration that a sensor would have if it were built exactly as described.

    Example: uwlts nominal thesis --medium water --out nominal.json

    Parameters
    ----------
    sensor
        Name or path of a sensor description.
    medium
        One of the sensor's media; the laser's window may turn the sheet in it.
    out
        Calibration file to write.
    overwrite
        Replace an existing file.
    """
    from uwlts.model.library import load_sensor
    from uwlts.optics.nominal import nominal_calibration
    from uwlts.storage.calibration_file import write_calibration

    described = load_sensor(sensor)
    write_calibration(out, nominal_calibration(described, described.medium(medium)), overwrite=overwrite)
    print(f"wrote {out}")


@app.command
def info(path: str) -> None:
    """Say what a file holds: a capture, cloud, calibration, evaluation, or a sensor description (by name or path).

    Example: uwlts info capture.h5

    Parameters
    ----------
    path
        File, or name of a shipped sensor such as thesis.
    """
    from uwlts.report.inventory import describe

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
    from uwlts.storage.import_ import import_folder

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
    from uwlts.storage.capture import Capture
    from uwlts.storage.cloud import is_cloud, read_cloud
    from uwlts.storage.export_ import export_capture, export_cloud

    if is_cloud(file):
        cloud = read_cloud(file)
        export_cloud(cloud, out, overwrite=overwrite)
        print(f"wrote {out} with {len(cloud)} points")
        return
    with Capture(file) as capture, progress_bar(f"exporting {file.name}") as progress:
        export_capture(capture, out, image_format=images, progress=progress)
        print(f"wrote {len(capture)} images and import.toml to {out}")
