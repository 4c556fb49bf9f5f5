"""Commands that calibrate."""

from pathlib import Path
from typing import Literal

import uwlts
from uwlts.cli.options import Coefficients, Files, Flag, Method, any_stage, app, say, show, stripe_options, warn
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

    From a target in air and steps it is sequential: camera and sheet first, then the window's distance. With a target
    in water, with scans, or with --joint, all parameters are estimated together (docs: joint calibration).

    Example: uwlts calibrate --air target.h5 --step step-near.h5 step-far.h5 --out calibration.json

    Example: uwlts calibrate --water target-water.h5 --out calibration.json

    Parameters
    ----------
    air
        Captures of the target in air: at every stage position one image under the lamp and one with the laser. If all
        are taken in the medium of use, and without steps, the calibration has a single viewpoint for that medium.
    water
        The same in the medium of use, seen through the window, whose distance is estimated too.
    step
        Captures of the step standard in the medium of use; without any the calibration is for air only.
    scan
        Scans of spheres, a plane or a pipe that stand still: round objects determine the stage's direction and the
        water's index, better if their size is known; a plane determines what bends it.
    new_water
        The scans were taken in other water than the target, or on another day: estimate its index too.
    unknown_sizes
        Estimate diameters and spacings of what was scanned, even if its description states their uncertainty.
    joint
        Estimate all parameters together; the sensor's description states what is known before and how well.
    live
        Plan (TOML, docs/how-to/calibrate-live.md) of a guided calibration with camera and stage, in place of captures:
        leads through the images, rejects bad ones with the reason, and records the good ones beside the calibration.
    out
        Calibration file to write.
    refractions
        2: window of known thickness, air images taken without it. 1: one interface, air images taken through the
        window. The joint calibration takes this from the captures.
    poses
        stage-normal: one target pose, moved by the stage along the target's normal (the thesis). stage: the same with a
        free direction, as always in the joint calibration. free: every image has a pose of its own.
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
        Guided: port of the page for the browser; the next free one is taken if it is in use.
    resume
        Guided: continue with what is recorded.
    overwrite
        Replace an existing file; guided, and without resume, its captures too.
    """
    from uwlts.calibration.joint.next_shot import advice_lines
    from uwlts.optics.window import require_index
    from uwlts.report.inventory import calibration_lines

    refuse_unsuitable(out, overwrite=overwrite)
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
            distortion=distortion,
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
            refractions=refractions,
            poses=poses,
            distortion=distortion,
            index=index,
            stripe=stripe_options(method),
            progress=any_stage(progress),
        )
    uwlts.write_calibration(out, calibration, overwrite=overwrite)
    show(calibration_lines(calibration))
    if calibration.joint is not None:
        show(advice_lines(calibration))
    warn(*calibration.origin().warnings)
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
    """Adapt a joint calibration to new water, or water of another temperature, by images of a step in it.

    All that the calibration found, correlations included, is what is known before; the new water's index is estimated
    too. The images of the calibration are not needed.

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
        Standard uncertainty of that index, in place of what follows from the sensor's description; 0.001 if hardly
        anything is known of the water.
    method
        How the stripe's centre is found.
    overwrite
        Replace an existing file.
    """
    from uwlts.calibration.joint.next_shot import advice_lines

    path = out or calibration.with_name(f"{calibration.stem}.refreshed.json")
    refuse_unsuitable(path, overwrite=overwrite)
    with progress_bar("refreshing") as progress:
        result = uwlts.refresh(
            calibration,
            step,
            index=index,
            index_std=index_std,
            stripe=stripe_options(method),
            progress=any_stage(progress),
        )
    uwlts.write_calibration(path, result.calibration, overwrite=overwrite)
    show(line for change in result.changes for line in change.lines())
    show(advice_lines(result.calibration))
    warn(*result.warnings)
    print(f"wrote {path}")


@app.command
def polynomials(
    *, target: Files, out: Path, degree: int = 6, method: Method | None = None, overwrite: Flag = False
) -> None:
    """Calibrate by polynomials, position to Z and Z to Y for each profile line, completely in the medium of use.

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
    from uwlts.report.inventory import polynomial_lines

    refuse_unsuitable(out, overwrite=overwrite)
    with progress_bar("calibrating") as progress:
        result = uwlts.calibrate_polynomials(
            target, degree=degree, stripe=stripe_options(method), progress=any_stage(progress)
        )
    uwlts.write_calibration(out, result.calibration, overwrite=overwrite)
    show(polynomial_lines(result.calibration))
    warn(*result.warnings)
    print(f"wrote {out}")
