"""Commands that calibrate."""

from pathlib import Path
from typing import Literal

from uwlts.cli.options import Coefficients, Files, Flag, Method, app, warn
from uwlts.model.errors import DescriptionError
from uwlts.runtime.console import progress_bar
from uwlts.storage.files import refuse_unsuitable


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
    in water, with scans, or with --joint, all is estimated together (docs/explanation/joint-calibration.md).

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
        Plan (TOML, docs/how-to/calibrate-live.md) of a guided calibration with camera and stage, in place of captures:
        leads through the images, refuses bad ones with the reason, and records the good ones beside the calibration.
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
    from uwlts.calibration.calibrate import calibrate as calibrated
    from uwlts.calibration.intrinsics import CameraOptions
    from uwlts.calibration.joint.next_shot import advice_lines
    from uwlts.calibration.sequential import CalibrationOptions
    from uwlts.optics.window import require_index
    from uwlts.report.inventory import calibration_lines
    from uwlts.storage.calibration_file import write_calibration
    from uwlts.stripe import StripeOptions

    if index is not None:
        require_index(index)
    refuse_unsuitable(out, overwrite=overwrite)
    if live is not None:
        if air or water or step or scan:
            raise DescriptionError("--live records its own captures: give either it, or --air, --water and --step")
        air, water, step, poses = _led_through(
            live,
            out,
            camera=camera,
            stage=stage,
            port=port,
            resume=resume,
            overwrite=overwrite and not resume,
            refractions=refractions,
            distortion=distortion,
        )
    elif not (air or water):
        raise DescriptionError("nothing to calibrate from: give --air or --water with captures of a target, or --live")
    if (new_water or unknown_sizes) and not scan:
        raise DescriptionError("--new-water and --unknown-sizes tell of scans: give these with --scan")
    options = CalibrationOptions(
        refractions=refractions,
        poses=poses,
        camera=CameraOptions(distortion=distortion),
        medium_index=index,
        same_water=not new_water,
        sizes_known=not unknown_sizes,
        stripe=StripeOptions(method=method) if method else StripeOptions(),
    )
    with progress_bar("calibrating") as progress:
        calibration = calibrated(
            air=air,
            water=water,
            step=step,
            scan=scan,
            method="joint" if joint else "auto",
            options=options,
            progress=lambda stage, done, total: progress(done, total),
        )
    write_calibration(out, calibration, overwrite=overwrite)
    print("\n".join(calibration_lines(calibration)))
    if calibration.joint is not None:
        print("\n".join(advice_lines(calibration)))
    for warning in calibration.origin().warnings:
        warn(warning)
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

    from uwlts.calibration.joint.next_shot import advice_lines
    from uwlts.calibration.joint.refresh import refresh as refreshed
    from uwlts.calibration.sequential import CalibrationOptions
    from uwlts.optics.window import require_index
    from uwlts.storage.calibration_file import read_calibration, write_calibration
    from uwlts.storage.capture import Capture
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
            known,
            captures,
            options=options,
            index_std=index_std,
            progress=lambda stage, done, total: progress(done, total),
        )
    write_calibration(path, result.calibration, overwrite=overwrite)
    print("\n".join(line for change in result.changes for line in change.lines()))
    print("\n".join(advice_lines(result.calibration)))
    for warning in result.warnings:
        warn(warning)
    print(f"wrote {path}")


@app.command
def polynomials(
    *, target: Files, out: Path, degree: int = 6, method: Method | None = None, overwrite: Flag = False
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
    from uwlts.report.inventory import polynomial_lines
    from uwlts.storage.calibration_file import write_polynomials
    from uwlts.storage.capture import Capture
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
        warn(warning)
    print(f"wrote {out}")


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
    from uwlts.hardware.guided.operator import GuidedPage, Operator
    from uwlts.hardware.guided.plan import load_guided_plan
    from uwlts.hardware.guided.recording import record_guided

    plan = load_guided_plan(live).connected(camera=camera, port=stage)
    page = GuidedPage(plan.title, port=port)
    try:
        print(f"open {page.address}; Ctrl-C ends it, what was accepted is kept", flush=True)
        operator = Operator(lambda line: print(line, flush=True), button=page.pressed)
        recording = record_guided(
            plan,
            out,
            page=page,
            operator=operator,
            resume=resume,
            overwrite=overwrite,
            refractions=refractions,
            camera=CameraOptions(distortion=distortion),
        )
    finally:
        page.close()
    for line in recording.missing:
        warn(f"still missing: {line}; --resume takes more images")
    step = () if recording.step is None else (recording.step,)
    target = (recording.target,)
    return (target, (), step, plan.poses) if plan.target_in_air() else ((), target, step, plan.poses)
