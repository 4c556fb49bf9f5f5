"""Commands that calibrate, and about the quality of a calibration: model comparison, certificate and verification."""

import sys
from collections.abc import Iterable
from pathlib import Path
from typing import Literal

import uwlts
from uwlts.cli.options import (
    AUTO,
    JSON,
    CalibrationOut,
    Coefficients,
    Files,
    Flag,
    Index,
    Method,
    Overwrite,
    Stripe,
    Workers,
    any_stage,
    app,
    chosen_distortion,
    say,
    show,
    stripe_settings,
    warn,
)
from uwlts.errors import DescriptionError
from uwlts.files.writing import refuse_unsuitable
from uwlts.runtime.console import progress_bar


@app.command
def calibrate(
    *,
    air: Files = (),
    water: Files = (),
    step: Files = (),
    scan: Files = (),
    new_water: Flag = False,
    unknown_sizes: Flag = False,
    joint: Flag = False,
    strict: Flag = False,
    live: Path | None = None,
    out: CalibrationOut,
    refractions: Literal[1, 2] = 2,
    poses: Literal["stage-normal", "stage", "free"] = "stage-normal",
    distortion: Coefficients = AUTO,
    pixels: Literal["auto", "square", "free"] = "auto",
    index: Index = None,
    method: Method = None,
    stripe: Stripe = (),
    camera: str | None = None,
    stage: str | None = None,
    port: int = 8080,
    resume: Flag = False,
    overwrite: Flag = False,
) -> None:
    """Calibrate camera, window and sheet from images of a target in air or in water, and of a step standard in water.

    From a target in air and steps it is sequential: camera and sheet first, then the window's distance. With a target
    in water, with scans, or with --joint, all parameters are estimated together (docs: joint calibration).

    Example: uwlts calibrate --air target.h5 --step step-near.h5 step-far.h5 --out calibration.json

    Example: uwlts calibrate --water target-water.h5 --out calibration.json

    Args:
        air: Captures of the target in air: at every stage position one image under the lamp and one with the laser. If
            all are taken in the medium of use, and without steps, the calibration has a single viewpoint for that
            medium.
        water: The same in the medium of use, seen through the window, whose distance is estimated too.
        step: Captures of the step standard in the medium of use; without any the calibration is for air only.
        scan: Scans of spheres, a plane or a pipe that stand still: round objects determine the stage's direction and
            the water's index, better if their size is known; a plane determines what bends it.
        new_water: The scans were taken in other water than the target, or on another day: estimate its index too.
        unknown_sizes: Estimate diameters and spacings of what was scanned, even if its description states their
            uncertainty.
        joint: Estimate all parameters together; the sensor's description states what is known before and how well.
        strict: Refuse images that do not fit together. Jointly, single ones are otherwise left out, and what most
            images show is stated as an error of the model, which makes uncertainties larger; both with a warning.
        live: Plan (TOML, docs/how-to/calibrate-live.md) of a guided calibration with camera and stage, in place of
            captures: leads through the images, rejects bad ones with the reason, and records the good ones beside the
            calibration.
        refractions: 2: window of known thickness, air images taken without it. 1: one interface, air images taken
            through the window. The joint calibration takes this from the captures.
        poses: stage-normal: one target pose, moved by the stage along the target's normal (the thesis). stage: the same
            with a free direction, as always in the joint calibration. free: every image has a pose of its own.
        distortion: Distortion coefficients to estimate; the others stay 0. auto: with the poses stage and
            free those that predict images left out best; with stage-normal k1 and k2; jointly k1 and k2, p1 and
            p2 as far as the description leaves them open, and more where the images contradict that.
        pixels: Whether pixels are square, or else as the sensor's description says, or free to be not; auto: as
            distortion, with free poses; else square.
        camera: Guided: address of the camera, in place of the plan's.
        stage: Guided: serial port of the stage, in place of the plan's.
        port: Guided: port of the page for the browser; the next free one is taken if it is in use.
        resume: Guided: continue with what is recorded.
        overwrite: Replace an existing file; guided, and without resume, its captures too.
    """
    from uwlts.calibration.joint.next_shot import advice_lines
    from uwlts.optics.window import require_index
    from uwlts.report.inventory import calibration_lines

    estimated = chosen_distortion(distortion)
    refuse_unsuitable(out, overwrite=overwrite, endings=JSON)
    if live is not None:
        if air or water or step or scan:
            raise DescriptionError("--live records its own captures: give either it, or --air, --water and --step")
        if index is not None:
            require_index(index)
        recording = uwlts.record_guided(
            live,
            out,
            camera=camera,
            stage=stage,
            port=port,
            refractions=refractions,
            distortion=("k1", "k2") if estimated == "auto" else estimated,
            resume=resume,
            overwrite=overwrite,
            report=say,
        )
        warn(*(f"still missing: {line}; --resume takes more images" for line in recording.missing))
        air, water, step, poses = recording.air, recording.water, recording.step, recording.poses
    with progress_bar("calibrating") as progress:
        calibration = uwlts.calibrate(
            air=air,
            water=water,
            step=step,
            scan=scan,
            method="joint" if joint else "auto",
            new_water=new_water,
            unknown_sizes=unknown_sizes,
            strict=strict,
            refractions=refractions,
            poses=poses,
            distortion=estimated,
            pixels=pixels,
            index=index,
            stripe=stripe_settings(stripe, method),
            progress=any_stage(progress),
        )
    advice = [] if calibration.joint is None else advice_lines(calibration)
    uwlts.write_calibration(out, calibration, overwrite=overwrite)
    _finish(out, [*calibration_lines(calibration), *advice], calibration.origin().warnings)


def _finish(out: Path, lines: Iterable[str], warnings: Iterable[str]) -> None:
    show(lines)
    warn(*warnings)
    print(f"wrote {out}")


@app.command
def camera(
    folder: Path,
    *,
    target: Path | None = None,
    out: Path,
    channel: str | None = None,
    distortion: Coefficients = AUTO,
    pixels: Literal["auto", "square", "free"] = "auto",
    overwrite: Overwrite = False,
) -> None:
    """Calibrate a camera alone, from photographs of a target that is held differently in each.

    Writes the camera as ROS CameraInfo (YAML), and a page with all images beside it, those left out with the reason.

    Example: uwlts camera photographs --target board.toml --out camera.yaml

    Args:
        folder: Folder of PNG, TIFF, BMP or JPEG images.
        target: Description of the target (TOML); target.toml or import.toml in the folder unless given.
        out: File to write; `uwlts import` reads it as intrinsics.
        channel: Channel of colour images, or a formula of channels; their luminance unless given.
        distortion: Distortion coefficients to estimate; auto: those that predict images left out best.
        pixels: Whether pixels are square or free to be not; auto: as distortion.
    """
    from uwlts.report.camera_page import camera_lines

    estimated = chosen_distortion(distortion)
    page = out.with_suffix(".html")
    refuse_unsuitable(out, overwrite=overwrite, endings=(".yaml", ".yml"))
    refuse_unsuitable(page, overwrite=overwrite)
    with progress_bar("calibrating") as progress:
        found = uwlts.calibrate_camera(
            folder, target=target, channel=channel, distortion=estimated, pixels=pixels, progress=any_stage(progress)
        )
    uwlts.write_camera(out, found, overwrite=overwrite)
    uwlts.write_camera_page(page, found, overwrite=overwrite)
    show(camera_lines(found))
    warn(*found.warnings)
    print(f"wrote {out} and {page}")


@app.command
def mount(
    profiles: Path,
    poses: Path | None = None,
    *,
    out: Path,
    artefact: Literal["sphere", "plane", "step", "ring"] = "sphere",
    radius_mm: float | None = None,
    height_mm: float | None = None,
    calibration: Path | None = None,
    pose_format: str = "matrix",
    profile_unit: Literal["mm", "m"] = "mm",
    pose_unit: Literal["mm", "m"] = "mm",
    axis: Literal["x", "-x", "y", "-y", "z", "-z"] | None = None,
    scale: Flag = False,
    time: Flag = False,
    overwrite: Overwrite = False,
) -> None:
    """Calibrate the mount of any laser profiler on a robot or stage, from its profiles of a sphere, plane, step or
    ring; or that of a calibrated sensor, from a capture of one of them or of a target; or the axis of a rotary table.

    The artefact stands still at an unknown place. Prints the transform from the sensor to the platform with its
    uncertainty, the poses that were left out, what the motions determine badly, and the pose to add next.

    Example: uwlts mount profiles poses.csv --pose-format quaternion-wxyz --radius-mm 19.05 --out mount.json

    Args:
        profiles: Folder with one CSV file (columns x and z) for each pose, one CSV file with a column pose, a cloud
            whose frames are the poses, or a description of everything (.toml; docs/how-to/calibrate-a-mount.md). With
            a calibration, a capture of the artefact, or of a target that images with the laser off show.
        poses: CSV file with the pose of the platform in the base frame for each profile, or image of the target;
            those of the capture unless given.
        out: Mount to write (JSON).
        artefact: What the profiles show.
        radius_mm: Radius of the sphere, or of the ring's wall; estimated unless given.
        height_mm: Height of the step; estimated unless given.
        calibration: Calibration of the sensor that took the capture.
        pose_format: matrix, quaternion-xyzw, quaternion-wxyz, rotvec-rad, rotvec-deg, euler-ZYX-deg (about the moved
            axes), euler-zyx-deg (about the fixed axes) or another order, -rad for radians; angle-deg of a rotary table.
        profile_unit: Unit of the profiles.
        pose_unit: Unit of the positions.
        axis: The sphere or target stands on a rotary table whose axis is not known: direction in the sensor's frame
            nearest to the axis about which angles turn it counter-clockwise.
        scale: Estimate the robot's scale too.
        time: Estimate the offset to add to the profiles' times (columns time_s; the poses are a trajectory).
    """
    from uwlts.report.inventory import mount_lines

    refuse_unsuitable(out, overwrite=overwrite, endings=JSON)
    found = uwlts.calibrate_mount(
        profiles,
        poses,
        artefact=artefact,
        radius_mm=radius_mm,
        height_mm=height_mm,
        calibration=calibration,
        pose_format=pose_format,
        profile_unit=profile_unit,
        pose_unit=pose_unit,
        axis=axis,
        scale=scale,
        time=time,
    )
    uwlts.write_mount(out, found, overwrite=overwrite)
    show(mount_lines(found))
    warn(*found.weaknesses)
    print(f"wrote {out}")


@app.command
def refresh(
    calibration: Path,
    *,
    step: Files,
    out: Path | None = None,
    index: float | None = None,
    index_std: float | None = None,
    method: Method = None,
    stripe: Stripe = (),
    overwrite: Overwrite = False,
) -> None:
    """Adapt a joint calibration to new water, or water of another temperature, by images of a step in it.

    All that the calibration found, correlations included, is what is known before; the new water's index is estimated
    too. The images of the calibration are not needed.

    Example: uwlts refresh calibration.json --step step-today.h5 --out today.json

    Args:
        calibration: Joint calibration of the sensor.
        step: Captures of the step standard in the new water.
        out: Calibration to write; CALIBRATION.refreshed.json unless given.
        index: Refractive index of the new water as far as it is known, in place of the one that follows from the
            captures.
        index_std: Standard uncertainty of that index, in place of what follows from the sensor's description; 0.001 if
            hardly anything is known of the water.
    """
    from uwlts.calibration.joint.next_shot import advice_lines

    path = out or calibration.with_name(f"{calibration.stem}.refreshed.json")
    refuse_unsuitable(path, overwrite=overwrite, endings=JSON)
    with progress_bar("refreshing") as progress:
        result = uwlts.refresh(
            calibration,
            step,
            index=index,
            index_std=index_std,
            stripe=stripe_settings(stripe, method),
            progress=any_stage(progress),
        )
    uwlts.write_calibration(path, result.calibration, overwrite=overwrite)
    changes = (line for change in result.changes for line in change.lines())
    _finish(path, [*changes, *advice_lines(result.calibration)], result.warnings)


@app.command
def polynomials(
    *,
    target: Files,
    out: CalibrationOut,
    degree: int = 6,
    method: Method = None,
    stripe: Stripe = (),
    overwrite: Overwrite = False,
) -> None:
    """Calibrate by polynomials, position to Z and Z to Y for each profile line, completely in the medium of use.

    Example: uwlts polynomials --target target-water.h5 --out polynomials.json

    Args:
        target: Captures of a target that stands still, square to the laser's axis, while the stage moves the sensor
            along Z: at every stage position one image under the lamp and one with the laser.
        degree: Degree of the polynomials; there must be more stage positions.
    """
    from uwlts.report.inventory import polynomial_lines

    refuse_unsuitable(out, overwrite=overwrite, endings=JSON)
    with progress_bar("calibrating") as progress:
        result = uwlts.calibrate_polynomials(
            target, degree=degree, stripe=stripe_settings(stripe, method), progress=any_stage(progress)
        )
    uwlts.write_calibration(out, result.calibration, overwrite=overwrite)
    _finish(out, polynomial_lines(result.calibration), result.warnings)


@app.command
def models(
    *,
    air: Files = (),
    water: Files = (),
    step: Files = (),
    out: Path | None = None,
    poses: Literal["stage", "free"] = "stage",
    index: Index = None,
    method: Method = None,
    stripe: Stripe = (),
    workers: Workers = None,
    overwrite: Overwrite = False,
) -> None:
    """Compare models of the sensor by how well each predicts images that its calibration has not seen.

    One refraction or two, window tilted or not, sheet with bow or turned by the laser's window or not, distortion:
    each model is calibrated without every fourth image, and without the nearest and the farthest ones.

    Example: uwlts models --air target-air.h5 --water target-water.h5 --step step-near.h5 step-far.h5 --out models.html

    Args:
        air: Captures of the target in air, as for uwlts calibrate.
        water: The same in the medium of use.
        step: Captures of the step standard in the medium of use.
        out: Page to write, with the figures as JSON beside it.
        poses: stage: one pose of the target for each capture, moved by the stage. free: every image has a pose of its
            own.
    """
    from uwlts.pages.toolkit import refuse_unsuitable_page
    from uwlts.report.model_comparison import content_of, lines_of

    if out is not None:
        refuse_unsuitable_page(out, overwrite=overwrite)
    with progress_bar("comparing models") as progress:
        comparison = uwlts.compare_models(
            air=air,
            water=water,
            step=step,
            poses=poses,
            index=index,
            stripe=stripe_settings(stripe, method),
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
    overwrite: Overwrite = False,
) -> None:
    """Write a calibration's certificate: evidence, calibrated volume, uncertainty of lengths, weak parameters.

    A page to read and print, and beside it the same as sealed JSON. With --check it is verified instead: exit code 1
    if the certificate was changed or belongs to another calibration.

    Example: uwlts certificate calibration.json --out certificate.html

    Example: uwlts certificate calibration.json --check certificate.json

    Args:
        calibration: Calibration file; only a joint one has uncertainties.
        out: Page to write; CALIBRATION.certificate.html unless given. The JSON goes beside it.
        before: Another calibration of the same sensor to set beside it.
        check: Certificate (JSON) to verify against the calibration.
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

    Args:
        capture: Scan of an artefact with calibrated sizes.
        calibration: Calibration of the sensor; a joint one holds its uncertainty.
        limit: Largest permissible error in mm.
    """
    verification = uwlts.verify(capture, calibration, limit_mm=limit)
    show([verification.text, *verification.not_shown])
    print("pass" if verification.passed else "FAIL")
    if not verification.passed:
        sys.exit(1)
