"""Commands for calibration and its quality: certificate and verification."""

import sys
from pathlib import Path
from typing import Annotated

from cyclopts import Parameter

import uwlts
from uwlts.cli.command_options import (
    STRIPE,
    CalibrationOut,
    Overwrite,
    a_file,
    a_page,
    app,
    wrote,
    wrote_files,
    wrote_page,
)
from uwlts.errors import DescriptionError, OutputError
from uwlts.runtime.command_line import Call, command_from, say, show, warn


@command_from(app, uwlts, "calibrate", job="Calibrate", shortcuts=STRIPE)
def calibrate(call: Call, *, out: CalibrationOut, overwrite: Overwrite = False) -> None:
    """Example: uwlts calibrate --air target.h5 --step step-near.h5 step-far.h5 --out calibration.json

    Example: uwlts calibrate --water target-water.h5 --out calibration.json

    Example: uwlts calibrate --calibration calibration.json --step step-today.h5 --new-water --out today.json
    """
    from uwlts.calibration.joint.next_shot import advice_lines
    from uwlts.report.file_description import calibration_lines

    calibration = call()
    advice = [] if calibration.joint is None else advice_lines(calibration)
    calibration.save(out, overwrite=overwrite)
    wrote([*calibration_lines(calibration), *advice], calibration.origin().warnings, out)


@command_from(app, uwlts, "calibrate_camera", job="Calibrate")
def camera(
    call: Call,
    *,
    out: Annotated[
        Path,
        a_file(".yaml", ".yml", beside=".html"),
        Parameter(
            help="ROS CameraInfo to write (YAML), which uwlts import reads as intrinsics; a page beside it shows all "
            "images, rejected ones with the reason."
        ),
    ],
    overwrite: Overwrite = False,
) -> None:
    """Example: uwlts camera photographs --target board.toml --out camera.yaml"""
    from uwlts.report.calibration_pages import camera_lines

    found, page = call(), out.with_suffix(".html")
    found.save(out, overwrite=overwrite)
    uwlts.report.write_camera(page, found, overwrite=overwrite)
    wrote(camera_lines(found), found.warnings, out, page)


@command_from(app, uwlts, "calibrate_mount", job="Calibrate")
def mount(
    call: Call,
    *,
    out: Annotated[Path, a_file(".json"), Parameter(help="Mount to write (JSON).")],
    overwrite: Overwrite = False,
) -> None:
    """Example: uwlts mount profiles poses.csv --pose-format quaternion-wxyz --radius-mm 19.05 --out mount.json"""
    from uwlts.report.file_description import mount_lines

    found = call()
    found.save(out, overwrite=overwrite)
    wrote(mount_lines(found), found.weaknesses, out)


@command_from(app, uwlts, "recalibrate", job="Calibrate", shortcuts=STRIPE)
def recalibrate(
    call: Call,
    *,
    out: Annotated[
        Path | None,
        a_file(".json"),
        Parameter(help="Calibration to write. Without it, the passes only check the old one."),
    ] = None,
    mount_out: Annotated[
        Path | None,
        a_file(".json"),
        Parameter(help="Mount to write: the one that belongs to the new calibration, if a mount is given."),
    ] = None,
    page: Annotated[
        Path | None,
        a_page("recalibration"),
        Parameter(help="Page to write, with all figures as JSON beside it: for a.html, a.recalibration.json."),
    ] = None,
    overwrite: Overwrite = False,
) -> None:
    """Example: uwlts recalibrate a.h5 b.h5 --calibration old.json --poses p.csv --pose-std-mm 0.01 --pose-std-deg 0.005

    The exit code is 1, and no calibration is written, if the passes contradict each other or the old calibration.
    """
    if (out is not None and "mount" in call.given) != (mount_out is not None):
        raise DescriptionError("a new calibration needs its own mount: give `mount`, `out` and `mount_out` together")
    found = call()
    show(found.lines())
    warn(*found.warnings, *found.doubts)
    if page is not None:
        uwlts.report.write_recalibration(page, found, overwrite=overwrite)
    if found.doubts:
        wrote_files(page)
        sys.exit(1)
    if out is not None:
        found.calibration.save(out, overwrite=overwrite)
    if mount_out is not None and found.mount is not None:
        found.mount.mount.save(mount_out, overwrite=overwrite)
    wrote_files(out, mount_out, page)


@command_from(app, uwlts, "calibrate_polynomials", job="Calibrate", shortcuts=STRIPE)
def polynomials(call: Call, *, out: CalibrationOut, overwrite: Overwrite = False) -> None:
    """Example: uwlts polynomials --captures target-water.h5 --out polynomials.json"""
    from uwlts.report.file_description import polynomial_lines

    found = call()
    found.calibration.save(out, overwrite=overwrite)
    wrote(polynomial_lines(found.calibration), found.warnings, out)


@command_from(app, uwlts.report, "write_certificate", job="Calibrate")
def certificate(
    call: Call,
    *,
    check: Annotated[
        Path | None,
        Parameter(
            help="Certificate (JSON) to verify against the calibration, instead of writing one: exit code 1 if it was "
            "changed or belongs to another calibration."
        ),
    ] = None,
) -> None:
    """Example: uwlts certificate calibration.json --out certificate.html

    Example: uwlts certificate calibration.json --check certificate.json
    """
    from uwlts.report.certificate import certificate_lines

    calibration = call.given["calibration"]
    if check is not None:
        if call.given.keys() & {"out", "before"}:
            raise DescriptionError("`check` verifies and writes nothing: give it without `out` and `before`")
        against = uwlts.report.check_certificate(check, calibration)
        say("\n".join(against) or f"{check} is unchanged, and belongs to {calibration}")
        if against:
            sys.exit(1)
        return
    page, content = call()
    show(certificate_lines(content))
    wrote_page(page)


@command_from(app, uwlts, "verify", job="Calibrate")
def verify(call: Call) -> None:
    """Answer pass or fail: exit code 0 or 1. The verdict is kept beside the calibration, for uwlts reconstruct.

    Example: uwlts verify step.h5 --calibration calibration.json --limit-mm 0.05
    """
    verification = call()
    show([verification.text, *verification.not_shown])
    warn(*verification.warnings)
    say("pass" if verification.passed else "FAIL")
    try:
        say(f"wrote {verification.save(call.given['calibration'])}")
    except OutputError as error:
        warn(f"the verdict is not kept: {error}")
    if not verification.passed:
        sys.exit(1)
