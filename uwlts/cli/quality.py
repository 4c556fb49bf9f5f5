"""Commands about the quality of a calibration: model comparison, certificate and verification."""

import sys
from pathlib import Path
from typing import Literal

import uwlts
from uwlts.cli.options import Files, Flag, Method, any_stage, app, show, stripe_options, warn
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
    from uwlts.report.model_comparison import content_of, lines_of
    from uwlts.report.page_toolkit import refuse_unsuitable_page

    if out is not None:
        refuse_unsuitable_page(out, example="models.html", overwrite=overwrite)
    with progress_bar("comparing models") as progress:
        comparison = uwlts.compare_models(
            air=air,
            water=water,
            step=step,
            poses=poses,
            index=index,
            stripe=stripe_options(method),
            workers=workers,
            progress=any_stage(progress),
        )
    show(lines_of(content_of(comparison)))
    warn(*comparison.warnings)
    if out is not None:
        uwlts.write_models(out, comparison, overwrite=overwrite)
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
    """Write a calibration's certificate: its evidence, where it holds, the uncertainty of lengths, and what is weak.

    A page to read and print, and beside it the same as sealed JSON. With --check it is verified instead: exit code 1
    if the certificate was changed or belongs to another calibration.

    Example: uwlts certificate calibration.json --out certificate.html

    Example: uwlts certificate calibration.json --check certificate.json

    Parameters
    ----------
    calibration
        Calibration file; only a joint one has uncertainties.
    out
        Page to write; CALIBRATION.certificate.html unless given. The JSON goes beside it.
    before
        Another calibration of the same sensor to set beside it.
    check
        Certificate (JSON) to verify against the calibration.
    overwrite
        Replace existing files.
    """
    from uwlts.report.certificate import certificate_lines

    if check is not None:
        if out is not None or before is not None:
            raise DescriptionError("--check verifies and writes nothing: give it without --out and --before")
        against = uwlts.check_certificate(check, calibration)
        print("\n".join(against) or f"{check} is as it was issued, and is about {calibration}")
        if against:
            sys.exit(1)
        return
    page, content = uwlts.write_certificate(calibration, out=out, before=before, overwrite=overwrite)
    show(certificate_lines(content))
    print(f"wrote {page} and {page.with_suffix('.json').name}")


@app.command
def verify(capture: Path, *, calibration: Path, limit: float | None = None) -> None:
    """Measure a known object and answer pass or fail: exit code 0 or 1.

    Each calibrated size must agree with its certificate within both uncertainties (E_n at most 1, ISO/IEC 17043) and,
    with a limit, conform to it beyond doubt (ISO 14253-1).

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
    verification = uwlts.verify(capture, calibration, limit_mm=limit)
    print(verification.text)
    print("pass" if verification.passed else "FAIL")
    if not verification.passed:
        sys.exit(1)
