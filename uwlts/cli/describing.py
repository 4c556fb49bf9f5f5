"""Commands about sensors and files: properties of a design, content of a file, and other formats."""

from pathlib import Path

import uwlts
from uwlts.cli.command_options import CalibrationOut, Overwrite, app, cloud_written, wrote_files
from uwlts.runtime.command_line import Call, command_from, say, show, warn


@command_from(app, uwlts, "design", job="Design")
def design(call: Call) -> None:
    """Example: uwlts design thesis --medium water"""
    from uwlts.optics.design_table import format_table

    show(format_table(call()))


@command_from(app, uwlts, "nominal", job="Design")
def nominal(call: Call, *, out: CalibrationOut, overwrite: Overwrite = False) -> None:
    """Example: uwlts nominal thesis --medium water --out nominal.json"""
    call().save(out, overwrite=overwrite)
    wrote_files(out)


@command_from(app, uwlts, "describe", job="Files")
def info(call: Call) -> None:
    """Example: uwlts info capture.h5"""
    say(call())


@command_from(app, uwlts, "import_images", job="Files")
def import_(call: Call) -> None:
    """Example: uwlts import photographs --out target.h5"""
    imported = call()
    warn(*imported.warnings)
    say(f"wrote {call.given['out']} with {imported.laser} laser and {imported.lamp} lamp images")


@command_from(app, uwlts, "export", job="Files")
def export(call: Call) -> None:
    """Example: uwlts export scan.cloud.h5 --out scan.laz"""
    out, written = Path(call.given["out"]), call()
    say(f"wrote {written} images and import.toml to {out}" if out.is_dir() else cloud_written(out, written))
