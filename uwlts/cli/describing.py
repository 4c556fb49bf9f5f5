"""Commands about sensors and files: what a design can do, what a file holds, and other formats."""

from pathlib import Path
from typing import Literal

import uwlts
from uwlts.cli.options import JSON, CalibrationOut, Flag, Overwrite, app, show, warn
from uwlts.files.writing import refuse_unsuitable
from uwlts.runtime.console import progress_bar

Box = tuple[tuple[float, float, float], tuple[float, float, float]]


@app.command
def design(sensor: str, *, medium: str) -> None:
    """Print what a sensor can do by the design formulas: resolution, line length, depth range, speckle limit.

    Example: uwlts design thesis --medium water

    Args:
        sensor: Name or path of a sensor description.
        medium: One of the sensor's media.
    """
    from uwlts.optics.design_table import table_lines

    show(table_lines(uwlts.design(sensor, medium=medium)))


@app.command
def nominal(sensor: str, *, medium: str, out: CalibrationOut, overwrite: Overwrite = False) -> None:
    """Write the calibration that a sensor would have if it were built exactly as described.

    Example: uwlts nominal thesis --medium water --out nominal.json

    Args:
        sensor: Name or path of a sensor description.
        medium: One of the sensor's media; the laser's window may turn the sheet in it.
    """
    refuse_unsuitable(out, overwrite=overwrite, endings=JSON)
    uwlts.write_calibration(out, uwlts.nominal(sensor, medium=medium), overwrite=overwrite)
    print(f"wrote {out}")


@app.command
def info(path: str) -> None:
    """Describe a file: a capture, cloud, calibration, evaluation, or a sensor description (by name or path).

    Example: uwlts info capture.h5

    Args:
        path: File, or name of a shipped sensor such as thesis.
    """
    print(uwlts.describe(path))


@app.command(name="import")
def import_images(folder: Path, *, out: Path, description: Path | None = None, overwrite: Overwrite = False) -> None:
    """Turn a folder of images of any camera into a capture.

    Example: uwlts import photographs --out target.h5

    Args:
        folder: Folder of PNG, TIFF, BMP or JPEG images.
        out: Capture to write.
        description: TOML file with sensor, medium, positions, and which image is what; import.toml in the folder unless
            given.
    """
    with progress_bar(f"importing {folder.name}") as progress:
        imported = uwlts.import_images(folder, out, description=description, overwrite=overwrite, progress=progress)
    warn(*imported.warnings)
    print(f"wrote {out} with {imported.laser} laser and {imported.lamp} lamp images")


@app.command
def export(
    file: Path,
    *,
    out: Path,
    images: Literal["png", "tiff"] = "png",
    region_mm: Box | None = None,
    at_most: int | None = None,
    overwrite: Flag = False,
) -> None:
    """Write a capture as a folder of images that `uwlts import` reads back, or a cloud in another format.

    Example: uwlts export scan.ply --out scan.laz

    Args:
        file: Capture (.h5) or cloud (.ply, .h5, .copc.laz; of other programs .xyz, .las, .e57).
        out: New folder for a capture; for a cloud a file whose ending names the format: .ply, .h5, .xyz (text), .laz,
            .las, .e57, .mcap (ROS 2), .foxglove.mcap, or .copc.laz (an octree for viewers, written a part at a time).
        images: Format of a capture's images; both keep all bits.
        region_mm: Only the points in a box: x y z of one corner, x y z of the other.
        at_most: Only an even sample of about so many points.
        overwrite: Replace an existing cloud.
    """
    with progress_bar(f"exporting {file.name}") as progress:
        written = uwlts.export(
            file, out, images=images, region_mm=region_mm, at_most=at_most, overwrite=overwrite, progress=progress
        )
    print(f"wrote {written} images and import.toml to {out}" if out.is_dir() else f"wrote {out} with {written} points")
