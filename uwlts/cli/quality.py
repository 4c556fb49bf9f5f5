"""Commands that tell what a calibration is worth."""

import sys
from pathlib import Path
from typing import Literal

from uwlts.cli.options import Files, Flag, Method, app, warn
from uwlts.model.errors import DescriptionError
from uwlts.runtime.console import progress_bar


@app.command
def models(
    *,
    air: Files = (),
    water: Files = (),
    step: Files = (),
    out: Path | None = None,
    poses: Literal["stage", "free"] = "stage",
    index: float | None = None,
    method: Method | None = None,
    workers: int | None = None,
    overwrite: Flag = False,
) -> None:
    """Compare models of the sensor by how well each predicts images that its calibration has not seen.

    One refraction or two, window tilted or not, sheet with bow or turned by the laser's window or not, distortion:
    each model is calibrated without every fourth image, and without the nearest and the farthest ones.

    Example: uwlts models --air target-air.h5 --water target-water.h5 --step step-*.h5 --out models.html

    Parameters
    ----------
    air
        Captures of the target in air, as for uwlts calibrate.
    water
        The same in the medium of use.
    step
        Captures of the step standard in the medium of use.
    out
        Page to write, with the figures as JSON beside it.
    poses
        stage: one pose of the target for each capture, moved by the stage. free: every image has a pose of its own.
    index
        Refractive index of the medium, in place of the one that follows from the captures.
    method
        How the stripe's centre is found.
    workers
        Models calibrated at a time; as many as there are processors unless given.
    overwrite
        Replace existing files.
    """
    from contextlib import ExitStack

    from uwlts.calibration.model_comparison.comparison import compare_models
    from uwlts.calibration.sequential import CalibrationOptions
    from uwlts.optics.window import require_index
    from uwlts.report.model_comparison import content_of, lines_of, write_models
    from uwlts.report.page_toolkit import refuse_unsuitable_page
    from uwlts.storage.capture import Capture
    from uwlts.stripe import StripeOptions

    if index is not None:
        require_index(index)
    if workers is not None and workers < 1:
        raise DescriptionError(f"workers is {workers}; it must be at least 1")
    if not (air or water):
        raise DescriptionError("nothing to compare models by: give --air or --water with captures of a target")
    if out is not None:
        refuse_unsuitable_page(out, example="models.html", overwrite=overwrite)
    options = CalibrationOptions(
        poses=poses, medium_index=index, stripe=StripeOptions(method=method) if method else StripeOptions()
    )
    with ExitStack() as stack:
        targets = [stack.enter_context(Capture(path)) for path in (*air, *water)]
        steps = [stack.enter_context(Capture(path)) for path in step]
        progress = stack.enter_context(progress_bar("comparing models"))
        comparison = compare_models(
            targets,
            steps,
            options=options,
            workers=workers,
            progress=progress,
            searched=lambda stage, done, total: progress(done, total),
        )
    content = content_of(comparison)
    print("\n".join(lines_of(content)))
    for warning in comparison.warnings:
        warn(warning)
    if out is not None:
        write_models(out, content, overwrite=overwrite)
        print(f"wrote {out} and {out.with_suffix('.json').name}")


@app.command
def certificate(
    calibration: Path,
    *,
    out: Path | None = None,
    before: Path | None = None,
    check: Path | None = None,
    overwrite: Flag = False,
) -> None:
    """Write a calibration's certificate: what it was made from, where it holds, what lengths are worth, what is weak.

    A page to read and print, and beside it the same as sealed JSON. With --check it is verified instead: exit code 1
    where the certificate was changed or belongs to another calibration.

    Example: uwlts certificate calibration.json --out certificate.html

    Example: uwlts certificate calibration.json --check certificate.json

    Parameters
    ----------
    calibration
        Calibration file; only a joint one tells uncertainties.
    out
        Page to write; CALIBRATION.certificate.html unless given. The JSON goes beside it.
    before
        Another calibration of the same sensor to set beside it.
    check
        Certificate (JSON) to verify against the calibration.
    overwrite
        Replace existing files.
    """
    from datetime import UTC, datetime

    from uwlts.report.certificate import certificate_lines, certificate_of, check_certificate
    from uwlts.report.certificate_page import refuse_unsuitable_certificate, write_certificate
    from uwlts.storage.calibration_file import read_calibration

    if check is not None:
        if out is not None or before is not None:
            raise DescriptionError("--check verifies and writes nothing: give it without --out and --before")
        against = check_certificate(check, calibration)
        print("\n".join(against) or f"{check} is as it was issued, and is about {calibration}")
        if against:
            sys.exit(1)
        return
    page = out or calibration.with_name(f"{calibration.stem}.certificate.html")
    refuse_unsuitable_certificate(page, calibration, overwrite=overwrite)
    known = read_calibration(calibration)
    beside = None if before is None else (before.name, read_calibration(before))
    content = certificate_of(known, calibration, issued=datetime.now(UTC).isoformat(timespec="seconds"))
    write_certificate(page, content, known, before=beside, overwrite=overwrite)
    print("\n".join(certificate_lines(content)))
    print(f"wrote {page} and {page.with_suffix('.json').name}")


@app.command
def verify(capture: Path, *, calibration: Path, limit: float | None = None) -> None:
    """Measure a known object and answer pass or fail: exit code 0 or 1.

    Each calibrated size must agree with its certificate within both uncertainties (E_n at most 1, ISO/IEC 17043) and,
    with a limit, keep it beyond doubt (ISO 14253-1).

    Example: uwlts verify step.h5 --calibration calibration.json --limit 0.05

    Parameters
    ----------
    capture
        Scan of an artefact with calibrated sizes.
    calibration
        Calibration of the sensor; a joint one holds its uncertainty.
    limit
        Largest permissible error in mm.
    """
    from uwlts.measurement.verification import verify as verified

    verification = verified(capture, calibration, limit)
    print(verification.text)
    if not verification.passed:
        print("FAIL")
        sys.exit(1)
    print("pass")
