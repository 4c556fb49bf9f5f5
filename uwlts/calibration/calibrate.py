"""Calibration of a sensor from its captures: the appropriate method, or the joint one from any mix."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Literal

from pydantic import JsonValue

from uwlts.calibration.camera.camera_parameters import CameraOptions
from uwlts.calibration.camera.lens import Distortion, LensChoice, Pixels, require_coefficients
from uwlts.calibration.camera.target_poses import Poses
from uwlts.calibration.joint.earlier import join_media, merge_with_earlier, read_earlier, require_suitable
from uwlts.calibration.joint.estimate import Estimate
from uwlts.calibration.joint.gathering import Gathered, gather_jointly, hold_camera
from uwlts.calibration.joint.policy import explain_refusal, solve_consistently
from uwlts.calibration.joint.scanned_surfaces import ScannedPlane, SurfaceScanEvidence
from uwlts.calibration.joint.stored_estimate import build_calibration
from uwlts.calibration.sequential.sequential_calibration import CalibrationOptions, calibrate_sequentially
from uwlts.errors import CalibrationError, DescriptionError, RangeError
from uwlts.fitting.least_squares import robust_std
from uwlts.model.calibration import Calibration, KnownStage
from uwlts.optics.window import require_index
from uwlts.runtime.progress import ProgressListener, ignore_progress
from uwlts.storage.calibration_file import read_calibration
from uwlts.storage.capture import Capture, open_captures
from uwlts.stripe import StripeSettings


@dataclass(frozen=True, eq=False)
class JointResult:
    """Joint calibration with the data of its report."""

    calibration: Calibration
    estimate: Estimate
    warnings: list[str]


def calibrate_jointly(
    targets: Sequence[Capture],
    steps: Sequence[Capture] = (),
    scans: Sequence[Capture] = (),
    *,
    options: CalibrationOptions | None = None,
    progress: ProgressListener = ignore_progress,
) -> JointResult:
    """Calibrate a sensor from all captures at once.

    Each capture of a target, in air or in a medium, with or without the camera's window, is a separate placement,
    unless the poses are free. Its images with the laser on at the same stage positions show the sheet, too. In scans of
    spheres, a plane or a pipe the stage moves the sensor. The option ``refractions`` is ignored: windows are glass
    plates as described.

    Raises CalibrationError if no target is among the captures; the evidence does not determine the calibration or
    contradicts it; DescriptionError, CaptureError as for `gather_jointly`.
    """
    options = CalibrationOptions() if options is None else options
    if options.earlier is not None:
        require_suitable([*targets, *steps, *scans], options.earlier)
    return solve_jointly(gather_jointly(targets, steps, scans, options=options, progress=progress), options=options)


def solve_jointly(gathered: Gathered, *, options: CalibrationOptions) -> JointResult:
    """Calibrate from gathered evidence; errors as `calibrate_jointly`."""
    earlier = options.earlier
    if earlier is not None:
        gathered = join_media(gathered, earlier, new=not options.same_water)
        options = replace(options, camera=read_earlier(earlier, gathered).parameters.intrinsics.options, lens=None)
    options, off_px = hold_camera(gathered, options), dict[str, list[float]]()
    try:
        problem, result, against, changes = solve_consistently(gathered, options)
        if against.all_against():
            for piece, parts in zip(problem.evidence, result.residuals, strict=True):
                for part in parts:
                    off_px.setdefault(piece.sources[part.image], []).append(robust_std(part.values))
            raise CalibrationError(explain_refusal(problem, against))
    except CalibrationError as error:
        table = "".join(series.found.table(off_px) for series in gathered.series)
        raise CalibrationError(f"{error}{table}") from error
    sensor, warnings = gathered.sensor, [*problem.warnings, *changes, *against.doubts]
    provenance: dict[str, JsonValue] = {
        **gathered.provenance,
        "poses": options.poses,
        "medium_index": options.medium_index,
        "known_before": sensor.uncertainty.model_dump(),
        "warnings": [*warnings],
    }
    for series in gathered.series[:1]:
        provenance["target"] = series.found.target.model_dump(mode="json")
    calibration = build_calibration(result, problem.evidence, sensor, list(gathered.media.values()), provenance)
    scans = [
        e for e in problem.evidence if isinstance(e, SurfaceScanEvidence) and not isinstance(e.surface, ScannedPlane)
    ]
    if scans:
        direction = scans[0].stage_direction(problem.parameters, result.values)[0]
        stage = KnownStage(
            described=gathered.scans[0].stage_direction.tolist(),
            direction=(direction @ calibration.object_transform()[:3, :3]).tolist(),
        )
        calibration = calibration.model_copy(update={"stages": (stage,)})
    if earlier is not None:
        calibration = merge_with_earlier(calibration, earlier)
    return JointResult(calibration, result, warnings)


_Captures = Sequence[Capture | str | Path]


def calibrate(
    *,
    air: _Captures = (),
    water: _Captures = (),
    step: _Captures = (),
    scan: _Captures = (),
    joint: bool = False,
    new_water: bool = False,
    unknown_sizes: bool = False,
    strict: bool = False,
    refractions: Literal[1, 2] = 2,
    target_poses: Poses = "stage-normal",
    calibration: Calibration | str | Path | None = None,
    distortion: Distortion = "auto",
    pixels: Pixels = "auto",
    index: float | None = None,
    index_std: float | None = None,
    stripe: StripeSettings = None,
    progress: ProgressListener = ignore_progress,
) -> Calibration:
    """Calibrate camera, window and sheet from images of a target in air or in water, and of a step standard in water.

    From a target in air and steps the calibration is sequential: camera and sheet first, then the window's distance.
    With a target in water, with scans, with ``uncertainty.focal_length`` in the description, or with ``joint``, all are
    estimated together, with their covariance (docs: joint calibration).

    Parameters
    ----------
    air : sequence of Capture or path
        Captures of the target in air, with one lamp image and one laser image at every stage position. If all captures
        are in the medium of use and there are no steps, the result is a single-viewpoint model for this medium.
    water : sequence of Capture or path
        Captures of the target in the medium of use through the window, whose distance is then estimated.
    step : sequence of Capture or path
        Captures of the step standard in the medium of use; without them, the calibration is for air only.
    scan : sequence of Capture or path
        Scans of spheres, a plane or a pipe at rest. Round objects determine the stage's direction and the water's
        index, more accurately if their size is known; a plane determines parameters that would bend it.
    joint : bool
        Estimate all parameters together, as always with ``water`` or ``scan``. Prior knowledge and its uncertainty are
        taken from the sensor's description.
    calibration : Calibration or path, optional
        Earlier joint calibration of the sensor: its estimate, with all correlations, is prior knowledge in place of the
        description. Images of a target, of a step or a scan then suffice each, also for other water.
    new_water : bool
        The scans were taken in other water than the target, or on another day: also estimate its index. With
        an earlier ``calibration``, all captures were.
    unknown_sizes : bool
        Estimate diameters and spacings of scanned objects, even if their descriptions state an uncertainty.
    strict : bool
        Raise an error if images do not fit together. Otherwise the joint calibration rejects single images with a
        warning, and enlarges uncertainties with a warning if most images deviate from the model.
    refractions : {1, 2}
        2: window of known thickness, air images taken without it. 1: one interface, air images taken through the
        window, with its effect included in the distortion. The joint calibration reads this from the captures.
    target_poses : {"stage-normal", "stage", "free"}
        stage-normal: one target pose, moved by the stage along the target's normal (the thesis). stage: the same with a
        free direction, as always in the joint calibration. free: every image has its own pose.
    distortion : "auto" or tuple of str
        Distortion coefficients to estimate; the others stay 0. auto: with the poses stage and free, those that best
        predict held-out images; with stage-normal, k1 and k2; jointly, k1 and k2, p1 and p2 within the limits of the
        description, and more if the images require it.
    pixels : {"auto", "square", "free"}
        Whether pixels are square (or as the sensor's description says), or have a free shape. auto: as distortion for
        free poses, else square.
    index : float, optional
        Refractive index of the medium relative to air. Default: the index that follows from the captures.
    index_std : float, optional
        Joint: its standard uncertainty. Default: that of the sensor's description. Use 0.001 if little is known about
        the water.
    stripe : StripeOptions or dict, optional
        As for `reconstruct`.
    progress : callable, optional
        Called with the number of images done, the total, and the name of the stage.

    Returns
    -------
    Calibration
        Its `Calibration.origin` contains the warnings about the evidence.

    Raises
    ------
    CalibrationError
        The captures do not determine the calibration or contradict it.
    DescriptionError
        There is no capture of a target, or a capture does not describe its target, step standard or scanned object.
    CaptureError
        A file is missing or damaged, or a scan shows no stripe.
    RangeError
        The refractive index is out of range.
    """
    if index is not None:
        require_index(index)
    require_coefficients(distortion)
    if index_std is not None and not index_std > 0:
        raise RangeError(f"the standard uncertainty of the index is {index_std:g}; it must be positive")
    if not (air or water or (calibration is not None and (step or scan))):
        raise DescriptionError(
            "no captures of a target to calibrate from: give `air` or `water`, or an earlier `calibration` with `step` "
            "or `scan`"
        )
    if not scan and (unknown_sizes or (new_water and calibration is None)):
        raise DescriptionError("`new_water` and `unknown_sizes` apply to scans: give `scan`, too")
    if calibration is not None:
        if (distortion, pixels) != ("auto", "auto"):
            raise DescriptionError("the earlier `calibration` states the lens: leave out `distortion` and `pixels`")
        calibration = calibration if isinstance(calibration, Calibration) else read_calibration(calibration)
    options = CalibrationOptions(
        refractions=refractions,
        poses=target_poses,
        camera=CameraOptions(
            ("k1", "k2") if distortion == "auto" else distortion, pixel_aspect=None if pixels == "free" else 1.0
        ),
        lens=LensChoice(distortion, pixels),
        stripe=stripe,
        medium_index=index,
        index_std=index_std,
        same_water=not new_water,
        sizes_known=not unknown_sizes,
        strict=strict,
        earlier=calibration,
    )
    with (
        open_captures(air) as in_air,
        open_captures(step) as steps,
        open_captures(water) as in_water,
        open_captures(scan) as scans,
    ):
        for capture in in_water:
            if capture.header.medium.kind == "air":
                raise DescriptionError(
                    f"{capture.path.name} says that it was taken in air: give it with `air`, or correct the medium in "
                    "its description"
                )
        targets = [*in_air, *in_water]
        # The sequential calibration does not use prior knowledge of the lens.
        known = any(capture.header.sensor.uncertainty.focal_length is not None for capture in targets)
        if joint or water or scan or known or calibration is not None:
            return calibrate_jointly(targets, steps, scans, options=options, progress=progress).calibration
        return calibrate_sequentially(in_air, steps, options=options, progress=progress).calibration
