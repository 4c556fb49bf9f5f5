"""The ``uwlts`` command: the sensor's software, from captures to judged point clouds."""

import sys
import threading
import tomllib
from pathlib import Path
from typing import Annotated, Literal

from cyclopts import App, Parameter

import uwlts
from uwlts.console import progress_bar, run
from uwlts.errors import CaptureError, DescriptionError, OutputError, RangeError
from uwlts.files import refuse_unsuitable

app = App(
    name="uwlts",
    help="Software of an underwater laser triangulation sensor.",
    version=uwlts.__version__,
    help_format="plaintext",
)

Flag = Annotated[bool, Parameter(negative="")]
Files = Annotated[tuple[Path, ...], Parameter(consume_multiple=True, negative="")]
Coefficients = Annotated[
    tuple[Literal["k1", "k2", "p1", "p2", "k3"], ...], Parameter(consume_multiple=True, negative="")
]
Method = Literal["centre-of-mass", "profile-fit", "quadratic", "zero-crossing"]


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
        TOML file that tells sensor, medium, positions, and which image is what; import.toml in the folder unless given.
    overwrite
        Replace an existing file.
    """
    from uwlts.importing import import_folder

    with progress_bar(f"importing {folder.name}") as progress:
        imported = import_folder(folder, out, description=description, overwrite=overwrite, progress=progress)
    for warning in imported.warnings:
        print(f"warning: {warning}", file=sys.stderr)
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


@app.command
def scan(
    plan: Path,
    *,
    out: Path,
    camera: str | None = None,
    stage: str | None = None,
    home: Flag = False,
    unlock: Flag = False,
    watch: Flag = False,
    calibration: Path | None = None,
    resume: Flag = False,
    overwrite: Flag = False,
) -> None:
    """Record a scan with a camera and a stage into a capture.

    Moves, lets the stage settle, switches the laser, takes an image and stores it with the position read back. The plan
    is checked against travel and volume before anything moves; the laser goes off however the scan ends.

    Example: uwlts scan plan.toml --camera gige:192.168.1.10 --stage /dev/ttyACM0 --home --out scan.h5

    Parameters
    ----------
    plan
        TOML file that tells sensor, medium, positions, lights and exposures (docs/scan.md).
    out
        Capture to write.
    camera
        Address of the camera, in place of the plan's: gige:NAME, genicam:PRODUCER.cti, replay:PATH.
    stage
        Serial port of the stage, in place of the plan's.
    home
        Find the limit switch first.
    unlock
        Take the stage's position as it is, without homing.
    watch
        Show the recording in a browser meanwhile, as uwlts watch does.
    calibration
        Watched: calibration of the sensor, or one by polynomials, for the cloud.
    resume
        Go on with an interrupted scan.
    overwrite
        Replace an existing capture.
    """
    from contextlib import ExitStack

    from uwlts.calibration.polynomial_model import read_any_calibration
    from uwlts.hardware.camera import open_camera
    from uwlts.hardware.grbl import GrblStage
    from uwlts.hardware.page_beside import PageBeside
    from uwlts.hardware.scan_plan import load_plan
    from uwlts.hardware.scanning import Seen, plan_text, record_scan

    described = load_plan(plan)
    address, port = camera or described.camera, stage or described.stage.port
    if address is None or port is None:
        what = "camera" if address is None else "stage"
        raise DescriptionError(f"neither the plan nor the command line tells the {what}: give --{what}")
    if not resume:
        refuse_unsuitable(out, overwrite=overwrite)
    if calibration:
        if not watch:
            raise DescriptionError("--calibration is for the cloud on the page: give --watch too")
        read_any_calibration(calibration)
    print(plan_text(described), flush=True)
    with ExitStack() as stack:
        page = None
        if watch:
            page = stack.enter_context(
                PageBeside(out, calibration=calibration, say=lambda line: print(line, flush=True))
            )
        progress = stack.enter_context(progress_bar(described.title))
        moved, opened = stack.enter_context(GrblStage(port)), stack.enter_context(open_camera(address))
        if home:
            moved.home()
        elif unlock:
            moved.unlock()

        def report(done: int, total: int, seen: Seen) -> None:
            progress(done, total)
            if page:
                page.start()

        seen = record_scan(
            described, out, camera=opened, stage=moved, overwrite=overwrite, resume=resume, progress=report, warn=_warn
        )
    for warning in seen.warnings():
        _warn(warning)
    exposures = ", ".join(f"{light} {value:.3g} ms" for light, value in seen.exposure_ms.items())
    print(f"wrote {out}, {seen.found} of {seen.lines} profile lines with a stripe; exposure {exposures or 'as before'}")


@app.command
def watch(capture: Path, *, calibration: Path | None = None, host: str = "127.0.0.1", port: int = 8080) -> None:
    """Show a recording while it grows, in a browser: the latest image with its stripe, and the cloud so far.

    Example: uwlts watch scan.h5 --calibration calibration.json

    Parameters
    ----------
    capture
        Capture that is being recorded, or is to be.
    calibration
        Calibration of the sensor, or one by polynomials, for the cloud.
    host
        Address at which the page is served; the usual one can be reached from this machine only.
    port
        Port of the page; the next free one is taken where it is in use.
    """
    from uwlts.calibration.polynomial_model import read_any_calibration
    from uwlts.live_view import LiveView
    from uwlts.live_view import watch as show

    known = read_any_calibration(calibration) if calibration else None
    view = LiveView(capture.name, host=host, port=port)
    try:
        print(f"open {view.address}; Ctrl-C ends it", flush=True)
        images = show(capture, view, known)
        print(f"{capture} is finished with {images} images; the page stays until Ctrl-C", flush=True)
        threading.Event().wait()
    except KeyboardInterrupt:
        print("closed")
    finally:
        view.close()


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
    live: Path | None = None,
    out: Path,
    refractions: Literal[1, 2] = 2,
    poses: Literal["stage-normal", "stage", "free"] = "stage-normal",
    distortion: Coefficients = ("k1", "k2"),
    index: float | None = None,
    method: Method | None = None,
    camera: str | None = None,
    stage: str | None = None,
    port: int = 8080,
    resume: Flag = False,
    overwrite: Flag = False,
) -> None:
    """Calibrate camera, window and sheet from images of a target in air or in water, and of a step standard in water.

    From a target in air and steps it goes by turns: camera and sheet first, then the window's distance. With a target
    in water, or with --joint, all is estimated together (docs/joint-calibration.md).

    Example: uwlts calibrate --air target.h5 --step step-near.h5 step-far.h5 --out calibration.json

    Example: uwlts calibrate --water target-water.h5 --out calibration.json

    Parameters
    ----------
    air
        Captures of the target in air: at every stage position one image under the lamp and one with the laser. All
        taken in the medium of use, and without steps, they give a calibration of a single viewpoint for that medium.
    water
        The same in the medium of use, seen through the window, whose distance is found with all else.
    step
        Captures of the step standard in the medium of use; without any in it the calibration is for air only.
    scan
        Scans of spheres, a plane or a pipe that stand still: what is round tells the stage's direction and the water's
        index, the better where its size is known; a plane tells what bends it.
    new_water
        The scans were taken in other water than the target, or on another day: find its index for itself.
    unknown_sizes
        Take diameters and spacings of what was scanned for unknown, whatever uncertainty its description states.
    joint
        Estimate all together; what is known before and how well is the sensor's description's.
    live
        Plan (TOML, docs/calibrate-live.md) of a guided calibration with camera and stage, in place of captures: leads
        through the images, refuses bad ones with the reason, and records the good ones beside the calibration.
    out
        Calibration file to write.
    refractions
        2: glass plate of known thickness, air images taken without the window. 1: one interface, air images taken
        through the window. Jointly, the captures tell what they were taken through.
    poses
        stage-normal: one plate pose, moved by the stage along the plate's normal (the thesis). stage: the same with a
        free direction, as always jointly. free: every image has a pose of its own.
    distortion
        Distortion coefficients to estimate; the others stay 0.
    index
        Refractive index of the medium, in place of the one that follows from the captures.
    method
        How the stripe's centre is found.
    camera
        Guided: address of the camera, in place of the plan's.
    stage
        Guided: serial port of the stage, in place of the plan's.
    port
        Guided: port of the page for the browser; the next free one is taken where it is in use.
    resume
        Guided: go on with what is recorded.
    overwrite
        Replace an existing file; guided, and without resume, its captures too.
    """
    from contextlib import ExitStack

    from uwlts.calibration.intrinsics import CameraOptions
    from uwlts.calibration.joint.advice import advice_lines
    from uwlts.calibration.joint.procedure import calibrate_jointly
    from uwlts.calibration.joint.stored import is_joint
    from uwlts.calibration.model import write_calibration
    from uwlts.calibration.procedure import CalibrationOptions
    from uwlts.calibration.procedure import calibrate as solve
    from uwlts.capture import Capture
    from uwlts.inventory import calibration_lines
    from uwlts.scan import require_index
    from uwlts.stripe import StripeOptions

    if index is not None:
        require_index(index)
    refuse_unsuitable(out, overwrite=overwrite)
    if live is not None:
        if air or water or step or scan:
            raise DescriptionError("--live records its own captures: give either it, or --air, --water and --step")
        air, water, step, poses = _led_through(
            live, out, camera=camera, stage=stage, port=port, resume=resume, overwrite=overwrite and not resume,
            refractions=refractions, distortion=distortion,
        )  # fmt: skip
    elif not (air or water):
        raise DescriptionError("nothing to calibrate from: give --air or --water with captures of a target, or --live")
    if (new_water or unknown_sizes) and not scan:
        raise DescriptionError("--new-water and --unknown-sizes tell of scans: give these with --scan")
    options = CalibrationOptions(
        refractions=refractions, poses=poses, camera=CameraOptions(distortion=distortion), medium_index=index,
        same_water=not new_water, sizes_known=not unknown_sizes,
        stripe=StripeOptions(method=method) if method else StripeOptions(),
    )  # fmt: skip
    with ExitStack() as stack, progress_bar("calibrating") as progress:
        air_captures = [stack.enter_context(Capture(path)) for path in air]
        step_captures = [stack.enter_context(Capture(path)) for path in step]
        water_captures = [stack.enter_context(Capture(path)) for path in water]
        scan_captures = [stack.enter_context(Capture(path)) for path in scan]

        def report(stage: str, done: int, total: int) -> None:
            progress(done, total)

        result = (
            calibrate_jointly(
                [*air_captures, *water_captures], step_captures, scan_captures, options=options, progress=report
            )
            if water or joint or scan
            else solve(air_captures, step_captures, options=options, progress=report)
        )
    write_calibration(out, result.calibration, overwrite=overwrite)
    print("\n".join(calibration_lines(result.calibration)))
    if is_joint(result.calibration):
        print("\n".join(advice_lines(result.calibration)))
    for warning in result.warnings:
        print(f"warning: {warning}", file=sys.stderr)
    print(f"wrote {out}")


@app.command
def refresh(
    calibration: Path,
    *,
    step: Files,
    out: Path | None = None,
    index: float | None = None,
    index_std: float | None = None,
    method: Method | None = None,
    overwrite: Flag = False,
) -> None:
    """Carry a joint calibration over to new water, or water of another temperature, by images of a step in it.

    All that the calibration found, correlations included, is what is known before; the new water's index is found
    besides. The images of the calibration are not needed.

    Example: uwlts refresh calibration.json --step step-today.h5 --out today.json

    Parameters
    ----------
    calibration
        Joint calibration of the sensor.
    step
        Captures of the step standard in the new water.
    out
        Calibration to write; CALIBRATION.refreshed.json unless given.
    index
        Refractive index of the new water as far as it is known, in place of the one that follows from the captures.
    index_std
        How well that index is known before (standard uncertainty), in place of what follows from the sensor's
        description; 0.001 where hardly anything is known of the water.
    method
        How the stripe's centre is found.
    overwrite
        Replace an existing file.
    """
    from contextlib import ExitStack

    from uwlts.calibration.joint.advice import advice_lines
    from uwlts.calibration.joint.refresh import refresh as refreshed
    from uwlts.calibration.model import read_calibration, write_calibration
    from uwlts.calibration.procedure import CalibrationOptions
    from uwlts.capture import Capture
    from uwlts.scan import require_index
    from uwlts.stripe import StripeOptions

    if index is not None:
        require_index(index)
    path = out or calibration.with_name(f"{calibration.stem}.refreshed.json")
    refuse_unsuitable(path, overwrite=overwrite)
    known = read_calibration(calibration)
    options = CalibrationOptions(medium_index=index, stripe=StripeOptions(method=method) if method else StripeOptions())
    with ExitStack() as stack, progress_bar("refreshing") as progress:
        captures = [stack.enter_context(Capture(each)) for each in step]
        result = refreshed(
            known, captures, options=options, index_std=index_std,
            progress=lambda stage, done, total: progress(done, total),
        )  # fmt: skip
    write_calibration(path, result.calibration, overwrite=overwrite)
    print("\n".join(line for change in result.changes for line in change.lines()))
    print("\n".join(advice_lines(result.calibration)))
    for warning in result.warnings:
        _warn(warning)
    print(f"wrote {path}")


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

    from uwlts.calibration.model_choice import (
        compare_models,
        content_of,
        lines_of,
        refuse_unsuitable_outputs,
        write_models,
    )
    from uwlts.calibration.procedure import CalibrationOptions
    from uwlts.capture import Capture
    from uwlts.scan import require_index
    from uwlts.stripe import StripeOptions

    if index is not None:
        require_index(index)
    if workers is not None and workers < 1:
        raise DescriptionError(f"workers is {workers}; it must be at least 1")
    if not (air or water):
        raise DescriptionError("nothing to compare models by: give --air or --water with captures of a target")
    if out is not None:
        refuse_unsuitable_outputs(out, overwrite=overwrite)
    options = CalibrationOptions(
        poses=poses, medium_index=index, stripe=StripeOptions(method=method) if method else StripeOptions()
    )
    with ExitStack() as stack:
        targets = [stack.enter_context(Capture(path)) for path in (*air, *water)]
        steps = [stack.enter_context(Capture(path)) for path in step]
        progress = stack.enter_context(progress_bar("comparing models"))
        comparison = compare_models(
            targets, steps, options=options, workers=workers, progress=progress,
            searched=lambda stage, done, total: progress(done, total),
        )  # fmt: skip
    content = content_of(comparison)
    print("\n".join(lines_of(content)))
    for warning in comparison.warnings:
        _warn(warning)
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

    from uwlts.calibration.model import read_calibration
    from uwlts.certificate import (
        certificate_lines,
        certificate_of,
        check_certificate,
        refuse_unsuitable_page,
        write_certificate,
    )

    if check is not None:
        if out is not None or before is not None:
            raise DescriptionError("--check verifies and writes nothing: give it without --out and --before")
        against = check_certificate(check, calibration)
        print("\n".join(against) or f"{check} is as it was issued, and is about {calibration}")
        if against:
            sys.exit(1)
        return
    page = out or calibration.with_name(f"{calibration.stem}.certificate.html")
    refuse_unsuitable_page(page, calibration, overwrite=overwrite)
    known = read_calibration(calibration)
    beside = None if before is None else (before.name, read_calibration(before))
    content = certificate_of(known, calibration, issued=datetime.now(UTC).isoformat(timespec="seconds"))
    write_certificate(page, content, known, before=beside, overwrite=overwrite)
    print("\n".join(certificate_lines(content)))
    print(f"wrote {page} and {page.with_suffix('.json').name}")


@app.command
def polynomials(
    *,
    target: Files,
    out: Path,
    degree: int = 6,
    method: Method | None = None,
    overwrite: Flag = False,
) -> None:
    """Calibrate by polynomials, position to Z and Z to Y for each profile line, wholly in the medium of use.

    Example: uwlts polynomials --target target-water.h5 --out polynomials.json

    Parameters
    ----------
    target
        Captures of a target that stands still, square to the laser's axis, while the stage moves the sensor along Z:
        at every stage position one image under the lamp and one with the laser.
    out
        Calibration file to write.
    degree
        Degree of the polynomials; there must be more stage positions.
    method
        How the stripe's centre is found.
    overwrite
        Replace an existing file.
    """
    from contextlib import ExitStack

    from uwlts.calibration.polynomial import calibrate_polynomials
    from uwlts.calibration.polynomial_model import write_polynomials
    from uwlts.capture import Capture
    from uwlts.inventory import polynomial_lines
    from uwlts.stripe import StripeOptions

    refuse_unsuitable(out, overwrite=overwrite)
    stripe = StripeOptions(method=method) if method else StripeOptions()
    with ExitStack() as stack, progress_bar("calibrating") as progress:
        captures = [stack.enter_context(Capture(path)) for path in target]
        result = calibrate_polynomials(
            captures, degree=degree, stripe=stripe, progress=lambda stage, done, total: progress(done, total)
        )
    write_polynomials(out, result.calibration, overwrite=overwrite)
    print("\n".join(polynomial_lines(result.calibration)))
    for warning in result.warnings:
        print(f"warning: {warning}", file=sys.stderr)
    print(f"wrote {out}")


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
    from uwlts.design_table import design_table, table_lines
    from uwlts.library import load_sensor

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
    from uwlts.calibration.model import write_calibration
    from uwlts.calibration.nominal import nominal_calibration
    from uwlts.library import load_sensor

    described = load_sensor(sensor)
    write_calibration(out, nominal_calibration(described, described.medium(medium)), overwrite=overwrite)
    print(f"wrote {out}")


@app.command
def reconstruct(
    capture: Path,
    *,
    calibration: Path,
    out: Path,
    index: float | None = None,
    method: Method | None = None,
    peak: Literal["strongest", "first", "last"] = "strongest",
    overwrite: Flag = False,
) -> None:
    """Turn a capture into a point cloud.

    Example: uwlts reconstruct scan.h5 --calibration calibration.json --out scan.ply

    Parameters
    ----------
    capture
        Capture of a scan.
    calibration
        Calibration of the sensor, or one by polynomials.
    out
        Cloud to write, PLY or by its ending HDF5 (.h5), with intensity, frame and line of every point, and by a joint
        calibration its uncertainty.
    index
        Refractive index of the medium, in place of the one that follows from the capture.
    method
        How the stripe's centre is found.
    peak
        Which of several stripes on a line counts.
    overwrite
        Replace an existing file.
    """
    from uwlts.calibration.joint.stored import is_joint
    from uwlts.calibration.polynomial_model import read_any_calibration
    from uwlts.capture import Capture
    from uwlts.cloud import write_cloud
    from uwlts.scan import reconstruct_capture
    from uwlts.stripe import StripeOptions

    refuse_unsuitable(out, overwrite=overwrite)
    options = StripeOptions(peak=peak) if method is None else StripeOptions(method=method, peak=peak)
    known = read_any_calibration(calibration)
    with Capture(capture) as opened, progress_bar(f"reconstructing {capture.name}") as progress:
        scan = reconstruct_capture(
            opened, known, options=options, index=index, with_uncertainty=is_joint(known), progress=progress
        )
        lit = int(opened.laser_on.sum())
    write_cloud(out, scan.cloud, overwrite=overwrite)
    lines = ", ".join(f"{count} {name.replace('_', ' ')}" for name, count in scan.lines_by_status.items() if count)
    print(f"laser images with a point: {len(set(scan.cloud.frame.tolist()))} of {lit}")
    print(f"profile lines: {lines}")
    lost = {name: count for name, count in scan.rays_by_status.items() if count and name != "ok"}
    if lost:
        reasons = ", ".join(f"{count} {name.replace('_', ' ')}" for name, count in lost.items())
        print(f"stripe centres without a point: {reasons}")
    print(f"wrote {out} with {len(scan.cloud)} points")


@app.command
def evaluate(
    cloud: Path,
    *,
    out: Path,
    artefact: Path | None = None,
    truth: Path | None = None,
    coloured: Path | None = None,
    overwrite: Flag = False,
) -> None:
    """Judge a cloud by its artefact's calibrated values, and point by point by a truth file.

    Example: uwlts evaluate spheres.ply --truth spheres.truth.h5 --out spheres.evaluation.json

    Parameters
    ----------
    cloud
        Point cloud (.ply or .h5).
    out
        Evaluation to write (JSON).
    artefact
        TOML file with the artefact's kind and calibrated values, in place of what the capture says.
    truth
        Ground truth of the capture, if it was rendered.
    coloured
        Also write the cloud with the deviation of every point to this file.
    overwrite
        Replace existing files.
    """
    from uwlts.cloud import read_cloud, write_cloud
    from uwlts.evaluate import judge, parse_artefact, write_evaluation
    from uwlts.inventory import evaluation_lines
    from uwlts.truth import read_truth

    for path in (out, coloured):
        if path:
            refuse_unsuitable(path, overwrite=overwrite)
    points = read_cloud(cloud)
    table = _read_toml(artefact) if artefact else points.metadata.get("artefact")
    judgement = judge(
        points,
        artefact=parse_artefact(table) if table else None,
        truth=read_truth(truth)[1] if truth else None,
        source=cloud.name,
    )
    write_evaluation(out, judgement, overwrite=overwrite)
    if coloured:
        write_cloud(coloured, judgement.cloud, overwrite=overwrite)
    print("\n".join(evaluation_lines(judgement.content)))
    print(f"wrote {out}")


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
        Calibration of the sensor; a joint one tells how well it measures.
    limit
        Largest permissible error in mm.
    """
    from uwlts.calibration.polynomial_model import read_any_calibration
    from uwlts.capture import Capture
    from uwlts.verify import verify as measured

    if limit is not None and not limit > 0:
        raise RangeError(f"--limit is {limit:g} mm; a permissible error is positive")
    known = read_any_calibration(calibration)
    with Capture(capture) as opened:
        verdicts = measured(opened, known, limit_mm=limit)
    print("\n".join(verdict.words() for verdict in verdicts))
    if not all(verdict.passed for verdict in verdicts):
        print("FAIL")
        sys.exit(1)
    print("pass")


@app.command
def report(
    folder: Path,
    *,
    reference: str | None = None,
    out: Path | None = None,
    pictures: Path | None = None,
    overwrite: Flag = False,
) -> None:
    """Gather a campaign's files into one page with pictures, a summary and a table on the terminal.

    The folder holds captures NAME.h5, coloured clouds NAME.ply (or .h5), evaluations NAME.evaluation.json and
    calibrations.

    Example: uwlts report runs/demo --reference thesis

    Parameters
    ----------
    folder
        Folder of the campaign.
    reference
        Published values to set beside the measured ones: name (thesis) or path of a TOML file.
    out
        Page to write; FOLDER/report.html unless given. The summary goes beside it, to summary.json.
    pictures
        Also write every measurement's stripe and cloud as PNG files into this folder.
    overwrite
        Replace an existing report, summary and pictures.
    """
    from uwlts.report import (
        gather_campaign,
        load_reference,
        print_table,
        summary_table,
        write_pictures,
        write_report,
        write_summary,
    )

    campaign = gather_campaign(folder)
    published = load_reference(reference) if reference else None
    page = out or folder / "report.html"
    write_summary(page.with_name("summary.json"), campaign, published, overwrite=overwrite)
    write_report(page, campaign, published, overwrite=overwrite)
    if pictures:
        try:
            pictures.mkdir(parents=True, exist_ok=True)
        except OSError as error:
            raise OutputError(f"cannot make the folder {pictures}: {error.strerror}") from error
        write_pictures(pictures, campaign, overwrite=overwrite)
    print_table(summary_table(campaign, published))
    print(f"wrote {page} and {page.with_name('summary.json')}")


@app.command
def thesis(
    folder: Path,
    *,
    published: str = "thesis-tables",
    trials: int = 100,
    workers: int | None = None,
    joint: Flag = False,
    again: Flag = False,
    overwrite: Flag = False,
) -> None:
    """Evaluate campaigns as the thesis does, by all its methods, and set its tables beside the results.

    The folder holds campaign-0, campaign-1, ..., each with the recordings of the whole evaluation; `twin reproduce`
    renders such. Writes report.html, summary.json, tables.csv and summary.md into it.

    Example: uwlts thesis runs/thesis

    Parameters
    ----------
    folder
        Folder of the campaigns.
    published
        Published tables: name or path of a TOML file.
    trials
        Trials of the Monte-Carlo propagation, at least 20, or 0 for none.
    workers
        Scans measured at a time; as many as there are processors unless given.
    joint
        Compare the joint calibration with the thesis's two ways instead; writes report.html and summary.json.
    again
        Evaluate campaigns anew that have results already.
    overwrite
        Replace an existing report.
    """
    from uwlts.thesis.comparison import markdown, write_comparison
    from uwlts.thesis.evaluation import evaluate_campaign
    from uwlts.thesis.folder import campaign_folders
    from uwlts.thesis.published import load_published

    if trials != 0 and trials < 20:
        raise DescriptionError(f"trials is {trials}: take 20 or more, or 0 for no Monte-Carlo propagation")
    if workers is not None and workers < 1:
        raise DescriptionError(f"workers is {workers}; it must be at least 1")
    if joint:
        _compare_jointly(folder, workers=workers, again=again, overwrite=overwrite)
        return
    tables, campaigns = load_published(published), campaign_folders(folder)
    refuse_unsuitable(folder / "report.html", overwrite=overwrite)
    results = []
    for campaign in campaigns:
        with progress_bar(f"evaluating {campaign.path.name}") as progress:
            results.append(
                evaluate_campaign(
                    campaign, trials=trials, workers=workers, overwrite=again,
                    progress=lambda stage, done, total: progress(done, total),
                )
            )  # fmt: skip
    rows = write_comparison(folder, results, tables, overwrite=overwrite)
    print(markdown(rows, results), end="")
    print(f"wrote {folder / 'report.html'}, summary.json, tables.csv and summary.md")


@app.command
def doctor(*, folder: Path = Path(), camera: str | None = None, stage: str | None = None) -> None:
    """Examine libraries, libLLVM, cameras, serial ports, permissions and speed of this machine, and say what to do.

    Ends with exit code 1 if something required, or something named here, is missing or does not work.

    Example: uwlts doctor --camera gige: --stage /dev/ttyACM0

    Parameters
    ----------
    folder
        Where captures are to be written; 64 MB are, and removed.
    camera
        Address of a camera to take ten frames with: gige:NAME, genicam:PRODUCER.cti or replay:PATH.
    stage
        Serial port of a stage to ask for its version, settings and state. It is not moved and the laser stays off, but
        an Arduino Uno restarts: home before the next scan.
    """
    from uwlts.doctor import examine, print_findings

    with progress_bar("examining") as progress:
        findings = examine(folder, camera=camera, stage=stage, progress=progress)
    print_findings(findings)
    if any(each.status == "missing" for each in findings):
        sys.exit(1)


def _led_through(
    live: Path,
    out: Path,
    *,
    camera: str | None,
    stage: str | None,
    port: int,
    resume: bool,
    overwrite: bool,
    refractions: Literal[1, 2],
    distortion: tuple[str, ...],
) -> tuple[tuple[Path, ...], tuple[Path, ...], tuple[Path, ...], Literal["stage-normal", "stage", "free"]]:
    """Record a guided calibration: captures of the target in air or in water, of steps, and how the poses are tied."""
    from uwlts.calibration.intrinsics import CameraOptions
    from uwlts.hardware.guided.operator import Operator
    from uwlts.hardware.guided.page import GuidedPage
    from uwlts.hardware.guided.plan import load_guided_plan
    from uwlts.hardware.guided.recording import record_guided

    plan = load_guided_plan(live).connected(camera=camera, port=stage)
    page = GuidedPage(plan.title, port=port)
    try:
        print(f"open {page.address}; Ctrl-C ends it, what was accepted is kept", flush=True)
        operator = Operator(lambda line: print(line, flush=True), button=page.pressed)
        recording = record_guided(
            plan, out, page=page, operator=operator, resume=resume, overwrite=overwrite, refractions=refractions,
            camera=CameraOptions(distortion=distortion),
        )  # fmt: skip
    finally:
        page.close()
    for line in recording.missing:
        _warn(f"still missing: {line}; --resume takes more images")
    step = () if recording.step is None else (recording.step,)
    target = (recording.target,)
    return (target, (), step, plan.poses) if plan.target_in_air() else ((), target, step, plan.poses)


def _compare_jointly(folder: Path, *, workers: int | None, again: bool, overwrite: bool) -> None:
    """Compare the joint calibration with the thesis's ways on all campaigns of a folder."""
    from uwlts.thesis.folder import campaign_folders
    from uwlts.thesis.joint_comparison import compare_campaigns, summary_lines
    from uwlts.thesis.joint_page import write_joint_comparison

    for name in ("report.html", "summary.json"):
        refuse_unsuitable(folder / name, overwrite=overwrite)
    campaigns = campaign_folders(folder)
    with progress_bar("comparing campaigns") as progress:
        results = compare_campaigns(campaigns, workers=workers, again=again, progress=progress)
    print("\n".join(summary_lines(write_joint_comparison(folder, results, overwrite=overwrite))))
    print(f"wrote {folder / 'report.html'} and summary.json")


def _warn(text: str) -> None:
    print(f"warning: {text}", file=sys.stderr, flush=True)


def _read_toml(path: Path) -> dict[str, object]:
    try:
        return tomllib.loads(path.read_text(encoding="utf-8"))
    except OSError as error:
        raise CaptureError(f"cannot read {path}: {error.strerror}") from error
    except (tomllib.TOMLDecodeError, UnicodeDecodeError, RecursionError) as error:
        raise DescriptionError(f"{path} is not valid TOML: {error}") from error


def main() -> None:
    """Entry point."""
    sys.exit(run(app))


if __name__ == "__main__":
    main()
