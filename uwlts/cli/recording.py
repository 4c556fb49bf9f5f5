"""Commands at the sensor (scan, desk, ROS node, doctor), and about sensors and files."""

import sys
from pathlib import Path

import uwlts
from uwlts.cli.command_options import CalibrationOut, Overwrite, app, cloud_written, wrote_files
from uwlts.runtime.command_line import Call, command_from, say, show, warn


@command_from(app, uwlts, "scan", job="Scan")
def scan(call: Call) -> None:
    """Example: uwlts scan plan.toml --camera gige:192.168.1.10 --stage /dev/ttyACM0 --home --out scan.h5"""
    seen = call()
    warn(*seen.warnings())
    exposures = ", ".join(f"{light} {value:.3g} ms" for light, value in seen.exposure_ms.items())
    lines = f"{seen.found} of {seen.lines} profile lines with a stripe"
    say(f"wrote {call.given['out']}, {lines}; exposure {exposures or 'as before'}")


@command_from(app, uwlts.desk, "serve_desk", job="Scan")
def desk(call: Call) -> None:
    """Example: uwlts desk tank --plan plan.toml"""
    call()


@command_from(app, uwlts.desk, "serve_ros", job="Scan")
def ros(call: Call) -> None:
    """Example: uwlts ros plan.toml --calibration calibration.json --home"""
    call()


@command_from(app, uwlts, "examine", job="Scan")
def doctor(call: Call) -> None:
    """End with exit code 1 if something required, or something named here, is missing or does not work.

    Example: uwlts doctor --camera gige: --stage /dev/ttyACM0
    """
    from uwlts.doctor import print_findings

    findings = call()
    print_findings(findings)
    if any(each.status == "missing" for each in findings):
        sys.exit(1)


@command_from(app, uwlts, "design", job="Design")
def design(call: Call) -> None:
    """Example: uwlts design thesis --medium water"""
    from uwlts.optics.nominal import format_table

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


@command_from(app, uwlts, "write_template", job="Files")
def template(call: Call) -> None:
    """Example: uwlts template photographs"""
    say(f'wrote {call()}: replace each "?" in it, then run uwlts import')


@command_from(app, uwlts, "export", job="Files")
def export(call: Call) -> None:
    """Example: uwlts export scan.cloud.h5 --out scan.laz"""
    out, written = Path(call.given["out"]), call()
    say(f"wrote {written} images and import.toml to {out}" if out.is_dir() else cloud_written(out, written))
