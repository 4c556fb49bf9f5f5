"""Sequential calibration: camera and sheet from captures in air, then the window's distance from a step."""

from collections.abc import Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from datetime import UTC, datetime
from functools import partial
from itertools import chain
from typing import Literal

import numpy as np
from pydantic import JsonValue

from uwlts._version import __version__
from uwlts.calibration.camera.camera_parameters import CameraOptions, TargetImage
from uwlts.calibration.camera.lens import LensCalibration, LensChoice, calibrate_lens, half_doubt
from uwlts.calibration.camera.target_poses import CameraSolution, Poses, refuse_turned_travel, solve_camera
from uwlts.calibration.capture_evidence import (
    AirEvidence,
    StepEvidence,
    common_sensor,
    explain_captures_without_stripe,
    find_air_evidence,
    find_approach,
    step_evidence,
)
from uwlts.calibration.sequential.sheet_fit import (
    SheetSolution,
    StripePoints,
    fit_sheet,
    object_frame,
    points_on_target,
)
from uwlts.calibration.sequential.step_images import (
    WindowSolution,
    doubt_step_height,
    doubt_target_size,
    label_steps,
    solve_window,
)
from uwlts.calibration.target_stripes import doubt_sheet_at_rest
from uwlts.errors import CalibrationError
from uwlts.fitting.propagation import jackknife
from uwlts.model.calibration import Calibration, WindowModel
from uwlts.model.placement import camera_from_object, laser_pose
from uwlts.model.sensor import Sensor, Window, to_rows
from uwlts.runtime.progress import ProgressListener, ignore_progress
from uwlts.storage.capture import Capture, describe_source
from uwlts.stripe import StripeSettings

_FEWEST_LEFT_OUT = 4  # images; with fewer, the jackknife is unreliable
_CLEARLY_LESS = 0.7  # ratio of residuals: a smaller one with a free stage direction is significant
_LARGEST_SHIFT = 1e-3
"""Largest standard uncertainty of depth by the sheet, or of lengths by the lens, relative to the volume's depth: a
tenth of a millimetre in 100 mm."""
_LARGEST_USUAL_TURN = np.radians(5)  # design values are rough, so only larger deviations are reported


@dataclass(frozen=True)
class CalibrationOptions:
    """Settings of the calibration.

    Attributes
    ----------
    refractions : 2: glass plate of known thickness and index; the images in air are taken without the window. 1: single
        interface; the images in air are taken through the window, with its effect included in the distortion
    poses : as for `solve_camera`
    camera : camera parameters to estimate
    lens : in place of ``camera``: select the lens model from the images, and reject outlier points and images. The
        joint calibration takes only coefficients from it
    correct_circles : correct the offset between a circle's image and the image of its centre
    medium_index, index_std : replace the index of the medium of the step images, and its standard uncertainty
    same_water : jointly: whether captures were taken in the same water as the earlier calibration, and scans in that of
        the target, if they describe it equally
    sizes_known : jointly: whether diameters and spacings of scanned objects are known if their uncertainty is stated;
        otherwise they are estimated
    strict : jointly: raise an error for images that do not fit, instead of rejecting them or stating an error of the
        model
    earlier : jointly: calibration whose estimate is prior knowledge
    """

    refractions: Literal[1, 2] = 2
    poses: Poses = "stage-normal"
    camera: CameraOptions = CameraOptions()
    lens: LensChoice | None = None
    stripe: StripeSettings = None
    correct_circles: bool = True
    medium_index: float | None = None
    index_std: float | None = None
    same_water: bool = True
    sizes_known: bool = True
    strict: bool = False
    earlier: Calibration | None = None


@dataclass(frozen=True, eq=False)
class CalibrationResult:
    """Calibration with the data of its report."""

    calibration: Calibration
    air: AirEvidence
    camera: CameraSolution
    stripe_points: StripePoints
    sheet: SheetSolution
    steps: Sequence[StepEvidence]  # step images used for the window, in the order of its figures
    window: WindowSolution | None
    warnings: list[str]


@dataclass(frozen=True, eq=False)
class Evidence:
    """Evidence from the captures of a calibration."""

    sensor: Sensor  # as described by the captures of the target
    medium_kind: Literal["air", "fresh", "sea", "custom"]  # kind of the medium of the target's images
    stage_direction: np.ndarray  # (3,); nominal direction of the stage for the target, in the OCS
    approaching: bool  # whether the stage moves the sensor towards the target; unused for free poses
    air: AirEvidence
    window: Window | None  # description of the camera's window for the step standard; None without step captures
    steps: list[StepEvidence]
    sources: dict[str, JsonValue]  # origin of the captures, for the calibration's provenance
    warnings: list[str]


def calibrate_sequentially(
    air: Sequence[Capture],
    steps: Sequence[Capture] = (),
    *,
    options: CalibrationOptions | None = None,
    progress: ProgressListener = ignore_progress,
) -> CalibrationResult:
    """Calibrate a sensor from its captures; without step captures, for the medium of the target's images only.

    Each capture of a target is a separate placement, moved by the stage. Its images with the laser off show the target,
    those with the laser on, at the same stage positions, the stripe on it. In another medium through the window and
    without step captures, they give a single-viewpoint calibration: refraction is included in focal length and
    distortion.

    Raises CalibrationError if the evidence does not determine the calibration or contradicts it; DescriptionError if a
    capture does not describe its target or its step standard.
    """
    options = CalibrationOptions() if options is None else options
    evidence = gather(air, steps, options=options, progress=progress)
    try:
        return solve(evidence, options=options)
    except CalibrationError as error:
        raise CalibrationError(f"{error}{evidence.air.table({})}") from error


def gather(
    air: Sequence[Capture],
    steps: Sequence[Capture],
    *,
    options: CalibrationOptions,
    progress: ProgressListener = ignore_progress,
) -> Evidence:
    """Find the target, and the stripes on it and on the step standard, in all images.

    Raises errors as `calibrate_sequentially`, and CalibrationError if a capture is given twice.
    """
    sensor = common_sensor([*air, *steps])
    media = {capture.header.medium.kind for capture in air}
    if len(media) > 1 or (steps and media != {"air"}):
        raise CalibrationError(
            f"the target was seen in {' and '.join(sorted(media))}: take all images of it in air if a step standard "
            "determines the window, else all in the medium of use"
        )
    sources = sources_of(air, steps)
    found = find_air_evidence(air, stripe=options.stripe, progress=progress)
    approaching = find_approach(air)
    if approaching is None and options.poses != "free":
        along = sorted({capture.header.stage_direction[2] for capture in air})
        raise CalibrationError(
            "the stage must move the sensor along the laser's axis (OCS Z), in the same direction in all captures; "
            f"the captures' stage_direction has the Z component {', '.join(f'{z:.2f}' for z in along)}: use "
            "poses='free' with a tilted target"
        )
    warnings = [*found.warnings, *_warn_of_window(air, steps, options)]
    on_steps: list[StepEvidence] = []
    if steps:
        on_steps, left_out = step_evidence(
            steps, medium_index=options.medium_index, stripe=options.stripe, progress=progress
        )
        warnings += left_out
        if not on_steps:
            raise CalibrationError(explain_captures_without_stripe(steps))
    return Evidence(
        sensor=sensor,
        medium_kind=air[0].header.medium.kind,
        stage_direction=np.array(air[0].header.stage_direction),
        approaching=approaching is not False,
        air=found,
        window=steps[0].header.sensor.camera.window if steps else None,
        steps=on_steps,
        sources=sources,
        warnings=warnings,
    )


def solve(evidence: Evidence, *, options: CalibrationOptions) -> CalibrationResult:
    """Calibrate from gathered evidence; errors as `calibrate_sequentially`."""
    sensor = evidence.sensor
    camera, lens, found, doubts = _calibrate_camera(evidence, options)
    if found.no_stripe:
        raise CalibrationError(found.no_stripe)
    stripe_points = points_on_target(camera.model, found.stripes, camera.target_poses, plate_mm=found.target.plate_mm)
    pose = laser_pose(sensor)
    sheet = fit_sheet(
        stripe_points.points_mm, nominal_normal=pose.normal, nominal_offset_mm=float(pose.normal @ pose.origin_mm)
    )
    figures, angle = {"camera": camera.figures()}, None
    warnings = [*evidence.warnings, *doubts]
    rays = stripe_points.points_mm[:, :2] / stripe_points.points_mm[:, 2:]
    of_image = [stripe_points.image == number for number in range(len(found.stripes))]
    warnings += doubt_sheet_at_rest(
        found.names(),
        [rays[here] for here in of_image],
        [sheet.residuals_mm[here] for here in of_image],
        across=1 if sensor.camera.stripe_along == "width" else 0,
        unit="mm",
    )
    if lens is not None:
        sheet, angle = _add_image_uncertainty(sheet, lens, found), _compare_halves(sheet, lens, found)
        figures["camera"] |= _list_lens_figures(lens, found)
        warnings += lens.half_doubts()
        if angle is not None:
            text = f"their sheets differ by {np.degrees(angle):.3f} deg"
            warnings += half_doubt(text, difference=angle, std=sheet.normal_std_rad)
    figures["sheet"] = sheet.figures(stripe_points, angle)
    warnings += _warn_of_turns(camera, sheet, evidence)
    warnings += _warn_of_uncertainty(camera, sheet, sensor)
    calibration = Calibration(
        sensor_name=sensor.name,
        stripe_along=sensor.camera.stripe_along,
        wavelength_nm=sensor.laser.wavelength_nm,
        medium_kind=evidence.medium_kind,
        camera=camera.model,
        window=None,
        sheet=sheet.model,
        camera_from_object=to_rows(object_frame(sheet.model, laser_axis=pose.axis)),
    )
    used, on_steps, window = [], [], None
    if evidence.window is not None:
        described = WindowModel.from_description(
            evidence.window, sensor.laser.wavelength_nm, refractions=options.refractions
        )
        labelled, on_steps = label_steps(calibration, described, evidence.steps, uncertainty=sensor.uncertainty)
        used = [image for image in labelled if image is not None]
        if not used:
            why = "; ".join([*evidence.warnings, *on_steps][:3])
            raise CalibrationError(f"no step image can be used for the window's distance; {why}")
        window = solve_window(calibration, described, used, known=sensor.uncertainty)
        figures["window"] = window.figures(used)
        off = abs(window.model.distance_mm - described.distance_mm)
        # Three standard uncertainties of the described distance and of the found one.
        if options.refractions == 2 and off > 3 * np.hypot(
            sensor.uncertainty.window_distance_mm, window.uncertainty_mm
        ):
            warnings.append(
                f"the window is {window.model.distance_mm:.1f} mm from the pupil and described at "
                f"{described.distance_mm:.1f} ± {sensor.uncertainty.window_distance_mm:g} mm: check the medium and "
                "step of each step capture, and the description"
            )
        warnings += doubt_step_height(window, used, known=sensor.uncertainty)
    warnings += on_steps
    how = {"refractions": options.refractions, "poses": options.poses, "medium_index": options.medium_index}
    calibration = calibration.model_copy(
        update={
            "window": None if window is None else window.model,
            "residuals": figures,
            "provenance": evidence.sources | how | {"warnings": warnings},
        }
    )
    return CalibrationResult(calibration, found, camera, stripe_points, sheet, used, window, warnings)


def _calibrate_camera(
    evidence: Evidence, options: CalibrationOptions
) -> tuple[CameraSolution, LensCalibration | None, AirEvidence, list[str]]:
    """Calibrate the camera from the images of the target, with lens selection if that is wanted.

    Return the camera, the selected lens or None, the used images, and warnings.
    """
    air = evidence.air
    width_px, height_px = evidence.sensor.camera.width_px, evidence.sensor.camera.height_px
    diameter_mm = air.target.circle_diameter_mm if options.correct_circles else None
    approaching = evidence.approaching
    solved = partial(
        solve_camera, width_px=width_px, height_px=height_px, approaching=approaching, circle_diameter_mm=diameter_mm
    )

    def size_doubts(images: Sequence[TargetImage], estimated: CameraOptions) -> list[str]:
        # Refraction in the focal length would change with distance.
        if options.poses == "free" or evidence.medium_kind != "air":
            return []
        with suppress(CalibrationError):
            free = solved(images, poses="free", options=estimated)
            return doubt_target_size(images, free, known=evidence.sensor.uncertainty)
        return []

    if options.lens is None:
        estimated = options.camera.with_described_pixels(evidence.sensor.camera)
        camera = solved(air.images, poses=options.poses, options=estimated)
        return camera, None, air, size_doubts(air.images, estimated)
    lens = calibrate_lens(
        air.images,
        width_px=width_px,
        height_px=height_px,
        poses=options.poses,
        approaching=approaching,
        choice=replace(
            options.lens,
            tangential=evidence.sensor.uncertainty.tangential,
            pixel_aspect=evidence.sensor.camera.pixel_aspect,
        ),
        circle_diameter_mm=diameter_mm,
    )
    camera, used = replace(lens.solution, covariance=lens.covariance), air.only(lens.used, lens.images)
    warnings = [f"{air.names()[place]}: left out, {reason}" for place, reason in lens.left_out.items()]
    warnings += size_doubts(used.images, lens.options)
    if options.poses == "stage-normal" and lens.options.pixel_aspect is not None:
        freer = solved(used.images, poses="stage", options=lens.options)
        if freer.stage_tilt_rad is not None and freer.sigma_px <= _CLEARLY_LESS * camera.sigma_px:
            unsquare = solved(used.images, poses=options.poses, options=replace(lens.options, pixel_aspect=None))
            warnings.append(_describe_stage_tilt(camera, freer, unsquare, tilt_rad=freer.stage_tilt_rad))
    return camera, lens, used, warnings


def _list_lens_figures(lens: LensCalibration, found: AirEvidence) -> dict[str, JsonValue]:
    """Return compared models and used images for files; None for missing values."""
    rms = lens.solution.image_rms_px()
    columns = zip(found.names(), found.images, rms, lens.moved, found.stripes, found.outliers, strict=True)
    table: list[JsonValue] = [
        {
            "image": name,
            "points": len(image.pixels),
            "rms_px": float(miss),
            "moves": None if np.isnan(moved) else float(moved),
            "stripe_points": len(stripe),
            "stripe_outliers": outliers,
        }
        for name, image, miss, moved, stripe, outliers in columns
    ]
    tried: list[JsonValue] = [
        {"model": each.options.name, "rms_px": each.rms_px if np.isfinite(each.rms_px) else None}
        for each in lens.candidates
    ]
    return {
        "halves": [{**half} for half in lens.half_values()],
        "lens_model": lens.options.name,
        "models_tried": tried,
        "rejected_share": lens.rejected_share,
        "images_left_out": len(lens.left_out),
        "image_table": table,
    }


def _warn_of_window(air: Sequence[Capture], steps: Sequence[Capture], options: CalibrationOptions) -> list[str]:
    if not all(capture.header.sensor.camera.window.mounted for capture in steps):
        raise CalibrationError("a step capture has no window (window.mounted): its distance cannot be determined")
    if not steps:
        return []
    mounted = [capture.header.sensor.camera.window.mounted for capture in air]
    if options.refractions == 2 and any(mounted):
        return [
            "the window was mounted in air, so its shift of the rays is included in the camera's parameters: with two "
            "refractions, take the images in air without it, or use refractions=1"
        ]
    if options.refractions == 1 and not all(mounted):
        return ["the window was removed in air and is one interface in the medium: its thickness is ignored"]
    return []


def _add_image_uncertainty(sheet: SheetSolution, lens: LensCalibration, found: AirEvidence) -> SheetSolution:
    """Estimate the uncertainty of the sheet's normal by leaving out one image at a time.

    Camera and poses are those without the image, so that errors common to its points are included.
    """
    normal = np.array(sheet.model.normal)
    changes = [
        other - normal
        for number, solution in enumerate(lens.without)
        if len(found.stripes[number])
        and (other := _estimate_normal(solution, np.delete(np.arange(len(found.stripes)), number), normal, found))
        is not None
    ]
    if len(changes) < _FEWEST_LEFT_OUT:
        return sheet
    std = float(np.sqrt(np.linalg.eigvalsh(jackknife(np.array(changes))).max()))
    return replace(sheet, normal_std_rad=max(sheet.normal_std_rad, std))


def _estimate_normal(
    solution: CameraSolution | None, numbers: np.ndarray, near: np.ndarray, found: AirEvidence
) -> np.ndarray | None:
    """Return the sheet's normal (3,) with a camera from some of the images; None if they do not determine it."""
    if solution is None:
        return None
    stripes = [found.stripes[number] for number in numbers]
    with suppress(CalibrationError):
        points = points_on_target(solution.model, stripes, solution.target_poses, plate_mm=found.target.plate_mm)
        return np.array(fit_sheet(points.points_mm, nominal_normal=near).model.normal)
    return None


def _compare_halves(sheet: SheetSolution, lens: LensCalibration, found: AirEvidence) -> float | None:
    """Return the angle between the sheet normals of two halves of the images, each with its own camera."""
    numbers, near = np.arange(len(found.stripes)), np.array(sheet.model.normal)
    one, two = (_estimate_normal(half, numbers[first::2], near, found) for first, half in enumerate(lens.halves))
    return None if one is None or two is None else float(np.arccos(np.clip(one @ two, -1.0, 1.0)))


def _describe_stage_tilt(
    camera: CameraSolution, freer: CameraSolution, unsquare: CameraSolution, *, tilt_rad: float
) -> str:
    """Describe that a free stage direction, or another pixel shape, fits better than motion along the normal.

    Images of one pose that is moved by the stage barely distinguish the two.
    """
    tilt, f, other_f = np.degrees(tilt_rad), camera.model.fx_px, freer.model.fx_px
    warning = (
        f"the stage moves at {tilt:.2f} deg to the target's normal: with poses 'stage' the residuals are "
        f"{freer.sigma_px:.3f} instead of {camera.sigma_px:.3f} px, and f is {other_f:.1f} instead of {f:.1f} px"
    )
    if unsquare.sigma_px <= _CLEARLY_LESS * camera.sigma_px:
        model = unsquare.model
        warning += (
            f"; or the pixels' shape is not as described: with free pixels, residuals are {unsquare.sigma_px:.3f} px, "
            f"fx {model.fx_px:.1f} and fy {model.fy_px:.1f} px. Views of the target tilted by "
            "20 deg or more would show which"
        )
    return warning


def _warn_of_turns(camera: CameraSolution, sheet: SheetSolution, evidence: Evidence) -> list[str]:
    warnings = []
    if sheet.turn_rad > _LARGEST_USUAL_TURN:
        warnings.append(f"the sheet's normal is {np.degrees(sheet.turn_rad):.1f} deg away from the description's")
    if camera.stage_direction is not None:
        nominal = camera_from_object(evidence.sensor)[:3, :3] @ evidence.stage_direction
        refuse_turned_travel(camera.stage_direction, nominal)
        cosine = camera.stage_direction @ nominal / np.linalg.norm(nominal)
        turn = float(np.degrees(np.arccos(np.clip(cosine, -1, 1))))
        if turn > np.degrees(_LARGEST_USUAL_TURN):
            warnings.append(f"the stage's direction is {turn:.1f} deg away from the capture's stage_direction")
    return warnings


def _warn_of_uncertainty(camera: CameraSolution, sheet: SheetSolution, sensor: Sensor) -> list[str]:
    """Return warnings if sheet or focal length are too uncertain for the described measuring volume.

    Let the sheet turn about the middle of the volume. A point at the volume's end then moves along the camera's axis,
    by the sheet's shift there divided by the normal's component along that axis. The focal length scales all lengths.
    """
    warnings, depth = [], sensor.volume.far_mm - sensor.volume.near_mm
    shift = float(np.tan(sheet.normal_std_rad) * depth / 2 / abs(sheet.model.normal[2]))
    if shift > _LARGEST_SHIFT * depth:
        warnings.append(
            f"the sheet's normal has a standard uncertainty of {np.degrees(sheet.normal_std_rad):.2g} deg, which is "
            f"{shift:.2g} mm of depth at the ends of the measuring volume of {depth:g} mm: take more images of the "
            "target, near and far, tilted in several directions"
        )
    std, values = camera.std(), camera.values()
    share = max(std[name] / values[name] for name in ("f", "fx", "fy") if name in std)
    if share > _LARGEST_SHIFT:
        warnings.append(
            f"the focal length has a standard uncertainty of {100 * share:.2g} %, and so have all lengths: "
            f"{share * depth:.2g} mm of {depth:g} mm; take more images of the target, near and far, and tilted"
        )
    return warnings


def sources_of(air: Sequence[Capture], steps: Sequence[Capture], scans: Sequence[Capture] = ()) -> dict[str, JsonValue]:
    """Return captures, software and date of a calibration, for its provenance.

    Raises CalibrationError if a capture is given twice, so its noise would count twice.
    """
    kinds = {"air_captures": air, "step_captures": steps, "scan_captures": scans}
    sources = {kind: [describe_source(capture) for capture in captures] for kind, captures in kinds.items()}
    names: dict[str, str] = {}
    for source in chain.from_iterable(sources.values()):
        if source.sha256 in names:
            raise CalibrationError(f"{names[source.sha256]} and {source.file} are the same capture: give it once")
        names[source.sha256] = source.file
    origin: dict[str, JsonValue] = {
        "source": "calibration from captures",
        "date": datetime.now(UTC).isoformat(timespec="seconds"),
        "software": f"uwlts {__version__}",
    }
    for kind, each in sources.items():
        origin[kind] = [source.in_file() for source in each]
    return origin
