"""The joint calibration from captures: target images in air and in water, the stripes on it, steps; in any mix."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import Any

import numpy as np

from uwlts.calibration.evidence import Progress, StepEvidence, air_evidence, no_stripe_in, step_evidence
from uwlts.calibration.joint.account import evidence_figures
from uwlts.calibration.joint.contradictions import findings
from uwlts.calibration.joint.estimate import Estimate, Evidence, estimate
from uwlts.calibration.joint.figures import joint_figures
from uwlts.calibration.joint.observations import StepProfileEvidence, TargetEvidence
from uwlts.calibration.joint.parameters import Parameters, Prior, View
from uwlts.calibration.joint.sheet_jets import PARAMETERS as SHEET
from uwlts.calibration.joint.sphere_scans import SLOPES, SphereScanEvidence
from uwlts.calibration.joint.sphere_start import SphereStripes, sphere_evidence, sphere_stripes
from uwlts.calibration.joint.start import Series, series_start, sheet_start
from uwlts.calibration.model import Calibration, KnownMedium, KnownStage, WindowModel
from uwlts.calibration.procedure import CalibrationOptions, common_sensor, nominal_window, sources_of, step_image
from uwlts.calibration.sheet import object_frame
from uwlts.camera import project_through_window
from uwlts.capture import Capture
from uwlts.errors import CalibrationError, EvaluationError
from uwlts.metrology.treads import Tread
from uwlts.placement import laser_pose
from uwlts.sensor import Medium, Sensor
from uwlts.targets import CircleTarget, circle_centre_bias


@dataclass(frozen=True, eq=False)
class JointResult:
    """A joint calibration with what a report shows of its making.

    Attributes
    ----------
    calibration : Calibration
    estimate : Estimate
    warnings : list of str
    """

    calibration: Calibration
    estimate: Estimate
    warnings: list[str]


@dataclass(frozen=True, eq=False)
class Gathered:
    """All that the captures show.

    Attributes
    ----------
    sensor : Sensor
        As the first capture describes it, with the window as mounted in the medium of use.
    media : dict
        Media other than air by their names.
    series : list of Series
        Target images, by what they were seen through.
    steps : list of (StepEvidence, View)
    spheres : list of SphereStripes
    provenance : dict
    warnings : list of str
    """

    sensor: Sensor
    media: dict[str, Medium]
    series: list[Series]
    steps: list[tuple[StepEvidence, View]]
    spheres: list[SphereStripes]
    provenance: dict[str, Any]
    warnings: list[str]


def calibrate_jointly(
    targets: Sequence[Capture],
    steps: Sequence[Capture] = (),
    spheres: Sequence[Capture] = (),
    *,
    options: CalibrationOptions | None = None,
    progress: Progress | None = None,
) -> JointResult:
    """Calibrate a sensor from all captures at once.

    Parameters
    ----------
    targets : sequence of Capture
        A target in air or in a medium, with or without the camera's window, as each capture says; each capture is a
        placement of its own, unless the poses are free. With the laser on at the same stage positions they show the
        sheet too.
    steps : sequence of Capture
        A step standard in a medium.
    spheres : sequence of Capture
        Scans of spheres that stand still while the stage moves the sensor.
    options : CalibrationOptions
        Its ``refractions`` do not count: windows are plates as described.
    progress : callable, optional

    Raises
    ------
    CalibrationError
        The evidence does not determine the calibration or contradicts it.
    DescriptionError
        A capture does not describe its target or its step standard.
    """
    options = CalibrationOptions() if options is None else options
    return solve_jointly(gather_jointly(targets, steps, spheres, options=options, progress=progress), options=options)


def gather_jointly(
    targets: Sequence[Capture], steps: Sequence[Capture], spheres: Sequence[Capture] = (), *,
    options: CalibrationOptions, progress: Progress | None = None,
) -> Gathered:  # fmt: skip
    """Find the target, the stripes on it and those on steps and spheres in all images."""
    sensor = common_sensor([*targets, *steps, *spheres])
    media: dict[str, Medium] = {}
    views: dict[View, list[Capture]] = {}
    for capture in targets:
        views.setdefault(_view(capture, media), []).append(capture)
    series, warnings = [], []
    for view, captures in views.items():
        found = air_evidence(captures, stripe=options.stripe, progress=progress)
        warnings += found.warnings
        series.append(Series(view, found, _approaching(captures), [c.path.name for c in captures]))
    on_steps = []
    for capture in steps:
        view = _view(capture, media)
        found_steps, left_out = step_evidence(
            [capture], medium_index=options.medium_index, stripe=options.stripe, progress=progress
        )
        on_steps += [(step, view) for step in found_steps]
        warnings += left_out
    if steps and not on_steps:
        raise CalibrationError(no_stripe_in(steps))
    on_spheres = []
    for capture in spheres:
        name = capture.header.medium_name if options.same_water else f"{capture.header.medium_name} of the spheres"
        on_spheres.append(sphere_stripes(capture, _view(capture, media, name), stripe=options.stripe))
    windowed = [c for c in [*steps, *targets, *spheres] if c.header.sensor.camera.window.mounted]
    return Gathered(
        sensor=windowed[0].header.sensor if windowed else sensor, media=media, series=series, steps=on_steps,
        spheres=on_spheres, provenance=sources_of(targets, steps, spheres), warnings=warnings,
    )  # fmt: skip


def solve_jointly(gathered: Gathered, *, options: CalibrationOptions) -> JointResult:
    """Calibrate from what the captures show, with the errors of `calibrate_jointly`."""
    sensor, warnings = gathered.sensor, list(gathered.warnings)
    seen_through = [s.view for s in [*gathered.series, *gathered.spheres]] + [view for _, view in gathered.steps]
    _refuse_two_lenses(seen_through, gathered)
    window = None
    if any(view.window for view in seen_through):
        window = nominal_window(sensor.camera.window, sensor, refractions=2)
    media = tuple(gathered.media)
    indices = [_index(medium, sensor, options) for medium in gathered.media.values()]
    start = series_start(
        gathered.series, sensor, window, indices, options=options.camera, free=options.poses == "free",
        margin_mm=options.margin_mm,
    )  # fmt: skip
    found = sheet_start(start, sensor, window, indices)
    if found is None:
        reasons = [each.found.no_stripe for each in gathered.series if each.found.no_stripe]
        raise CalibrationError(
            "; ".join(reasons) or "no stripe was found on the target: check its description and the stage positions"
        )
    sheet, turns = found
    first = sheet.model(np.append(turns, (0.0, 0.0)))
    first_calibration = start.calibration(sensor, window, first)
    steps, left_out = _steps(gathered, first_calibration, window, options)
    scans, missed = _spheres(gathered, first_calibration, indices, options)
    warnings += [*left_out, *missed]
    heights = {e.height: known for e, known in steps}
    priors = _priors(sensor, gathered, window, indices, turns, heights, options)
    parameters = Parameters(start.intrinsics, sheet, window, media, priors)
    evidence: list[Evidence] = [*start.evidence, *(e for e, _ in steps), *(e for e, _ in scans)]
    shared = parameters.start(start.lens)
    own = [*start.own, *(_step_start(e, parameters, shared) for e, _ in steps), *(own for _, own in scans)]
    target = gathered.series[0].found.target
    circles = options.correct_circles and isinstance(target, CircleTarget)
    result = estimate(
        parameters, evidence, shared, own, uncertainty=sensor.uncertainty,
        correct=partial(_centred, parameters, target.diameter_mm) if circles else None,
    )  # fmt: skip
    sources = _sources(gathered.series, free=options.poses == "free")
    sources += [{e.image: gathered.steps[e.image][0].source} for e, _ in steps]
    sources += [e.sources() for e, _ in scans]
    against = findings(result, evidence, sources, sensor=sensor)
    if against.contradictions:
        raise CalibrationError(against.refusal())
    warnings += against.doubts
    provenance = gathered.provenance | {"poses": options.poses, "medium_index": options.medium_index}
    provenance |= {"known_before": sensor.uncertainty.model_dump(), "target": target.model_dump(mode="json")}
    frame = object_frame(parameters.sheet_model(result.values), laser_axis=laser_pose(sensor).axis)
    kept = evidence_figures(result, evidence, sources, frame)
    stages = [
        KnownStage(
            described=stripes.stage_direction.tolist(),
            direction=(scan.moved_direction(parameters, result.values) @ frame[:3, :3]).tolist(),
        )
        for stripes, (scan, _) in zip(gathered.spheres, scans, strict=False)
    ]
    calibration = _calibration(gathered, result, frame, stages[:1], kept, provenance | {"warnings": warnings})
    return JointResult(calibration, result, warnings)


def _refuse_two_lenses(views: Sequence[View], gathered: Gathered) -> None:
    """CalibrationError where a lens that looks straight into a medium would have to be the one seen otherwise."""
    wet = next((view for view in views if view.medium is not None and not view.window), None)
    if wet is not None and any(view != wet for view in views):
        raise CalibrationError(
            f"some captures in {list(gathered.media)[wet.medium]} were taken without a window and others were not: a "
            "lens that touches the medium is another lens; calibrate it by itself, or set window.mounted"
        )


def _sources(series: Sequence[Series], *, free: bool) -> list[dict[int, str]]:
    """Capture and frame of every image of every placement, in the order of `series_start`."""
    return [
        {
            int(image): f"{part.names[part.found.frames[image][0]]}, frame {part.found.frames[image][1]}"
            for image in np.unique(placement.image)
        }
        for part in series
        for placement in part.placements(free=free)
    ]


def _view(capture: Capture, media: dict[str, Medium], name: str | None = None) -> View:
    """Through what a capture was taken; ``name`` is the medium's own unless given."""
    header = capture.header
    window = header.sensor.camera.window.mounted
    if header.medium.kind == "air":
        return View(window, None)
    name = name or header.medium_name
    if media.setdefault(name, header.medium) != header.medium:
        raise CalibrationError(f"the captures mean different media by '{name}': {media[name]} and {header.medium}")
    return View(window, list(media).index(name))


def _approaching(captures: Sequence[Capture]) -> bool | None:
    """Whether the stage moves the sensor towards the target; None where it does not move along the OCS's Z."""
    along = {float(capture.header.stage_direction[2]) for capture in captures}
    return min(along) > 0 if min(map(abs, along)) >= 0.9 and min(along) * max(along) > 0 else None


def _index(medium: Medium, sensor: Sensor, options: CalibrationOptions) -> float:
    return options.medium_index or medium.refractive_index(sensor.laser.wavelength_nm)


def _priors(
    sensor: Sensor, gathered: Gathered, window: WindowModel | None, indices: list[float], turns: np.ndarray,
    heights: dict[str, Prior], options: CalibrationOptions,
) -> dict[str, Prior]:  # fmt: skip
    known = sensor.uncertainty
    priors = {}
    if window is not None:
        tilt = float(np.tan(np.radians(known.window_tilt_deg)))
        normal = np.array(window.normal) / window.normal[2]
        priors |= {
            "window_distance": Prior(window.distance_mm, known.window_distance_mm),
            "window_slope_x": Prior(float(normal[0]), tilt),
            "window_slope_y": Prior(float(normal[1]), tilt),
            "glass_thickness": Prior(window.thickness_mm, known.glass_thickness_mm),
            "glass_index": Prior(window.glass_index, known.glass_index),
        }
    for (name, medium), index in zip(gathered.media.items(), indices, strict=True):
        std = medium.index_uncertainty(sensor.laser.wavelength_nm, known)
        priors[f"index of {name}"] = Prior(index, known.index if options.medium_index else std)
    priors |= {name: Prior(float(value), np.inf) for name, value in zip(SHEET[:3], turns, strict=True)}
    bow, turn = np.radians([known.bow_deg, known.laser_window_tilt_deg])
    priors["sheet_bow"] = Prior(float(np.radians(sensor.laser.bow_deg)), float(bow))
    if gathered.media and sensor.laser.window.mounted:
        priors["laser_window_turn"] = Prior(float(np.arcsin(sensor.laser.window.normal()[0])), float(turn))
    if gathered.spheres:
        lean = float(np.tan(np.radians(known.stage_alignment_deg)))
        priors |= dict.fromkeys(SLOPES, Prior(0.0, lean))
    if options.poses != "free" or gathered.spheres:
        priors["stage_scale"] = Prior(0.0, known.stage_scale)
    priors["target_bow"] = Prior(0.0, known.target_bow_mm)
    return priors | heights


def _steps(
    gathered: Gathered, start: Calibration, window: WindowModel | None, options: CalibrationOptions
) -> tuple[list[tuple[StepProfileEvidence, Prior]], list[str]]:
    transform = start.object_transform()
    usual = gathered.sensor.uncertainty.step_height_mm
    found, warnings = [], []
    for number, (step, view) in enumerate(gathered.steps):
        try:
            image = step_image(start, window, step)
        except EvaluationError as error:
            warnings.append(f"{step.source}: left out, {error}")
            continue
        on_tread = image.labels != Tread.NEITHER
        height, stated = step.standard.height_mm, step.standard.height_uncertainty_mm
        evidence = StepProfileEvidence(
            view=view, pixels=image.pixels[on_tread], upper=image.labels[on_tread] == Tread.UPPER,
            upward=-transform[:3, 2], along=transform[:3, 1],
            across=1 if gathered.sensor.camera.stripe_along == "width" else 0,
            height=f"height of the {height:g} mm step", image=number,
        )  # fmt: skip
        found.append((evidence, Prior(height, stated / 2 if stated else usual)))
    return found, warnings


def _spheres(
    gathered: Gathered, start: Calibration, indices: list[float], options: CalibrationOptions
) -> tuple[list[tuple[SphereScanEvidence, np.ndarray]], list[str]]:
    found, warnings, image = [], [], 0
    for stripes in gathered.spheres:
        index = 1.0 if stripes.view.medium is None else indices[stripes.view.medium]
        through = start if stripes.view.window else start.model_copy(update={"window": None})
        try:
            evidence, own = sphere_evidence(
                stripes, through, medium_index=index, sizes_known=options.sizes_known, image=image
            )
        except EvaluationError as error:
            warnings.append(f"{stripes.source}: left out, {error}")
            continue
        found.append((evidence, own))
        image += len(evidence.stage_mm)
    return found, warnings


def _step_start(evidence: StepProfileEvidence, parameters: Parameters, shared: np.ndarray) -> np.ndarray:
    """The lower tread's line (2,) at the parameters' start."""
    points = parameters.on_sheet(shared, evidence.view, evidence.pixels)
    if points is None:
        raise CalibrationError("the stripe on a step meets no sheet at the calibration's start: check the window")
    up = evidence.upward @ points.points - evidence.upper * parameters.value(shared, evidence.height)
    along = evidence.along @ points.points
    slope, offset = np.polyfit(along, up, 1)
    return np.array([-slope, offset / np.hypot(1.0, slope)])


def _centred(
    parameters: Parameters, diameter_mm: float, found: Sequence[Evidence], shared: np.ndarray,
    own: Sequence[np.ndarray],
) -> list[Evidence]:  # fmt: skip
    """The evidence with the images of the circles' centres instead of the centres of the circles' images."""
    return [
        _with_centres(e, parameters, shared, o, diameter_mm) if isinstance(e, TargetEvidence) else e
        for e, o in zip(found, own, strict=True)
    ]


def _with_centres(
    evidence: TargetEvidence, parameters: Parameters, shared: np.ndarray, own: np.ndarray, diameter_mm: float
) -> TargetEvidence:
    view, placement = evidence.view, evidence.placement
    camera, index = parameters.camera(shared), parameters.medium_index(shared, view)
    window = parameters.window_model(shared) if view.window else None
    pixels = placement.pixels.copy()
    for image in np.unique(placement.image):
        pose, here = evidence.pose(parameters, shared, own, image), placement.image == image

        def project(points: np.ndarray, pose: np.ndarray = pose) -> np.ndarray:
            seen = points @ pose[:3, :3].T + pose[:3, 3]
            return project_through_window(camera, window, seen, medium_index=index)

        pixels[here] -= circle_centre_bias(
            project, placement.points_mm[here], diameter_mm=diameter_mm, axis_u=np.eye(3)[0], axis_v=np.eye(3)[1]
        )
    return replace(evidence, placement=replace(placement, pixels=pixels))


def _calibration(
    gathered: Gathered, result: Estimate, frame: np.ndarray, stages: list[KnownStage], evidence: dict[str, Any],
    provenance: dict[str, Any],
) -> Calibration:  # fmt: skip
    sensor, parameters, values = gathered.sensor, result.parameters, result.values
    figures = joint_figures(result)
    figures["joint"] |= evidence
    sheet = parameters.sheet_model(values)
    wet = parameters.window is None and gathered.media
    return Calibration(
        sensor_name=sensor.name,
        stripe_along=sensor.camera.stripe_along,
        wavelength_nm=sensor.laser.wavelength_nm,
        medium_kind=next(iter(gathered.media.values())).kind if wet else "air",
        camera=parameters.camera(values),
        window=parameters.window_model(values),
        sheet=sheet,
        camera_from_object=tuple(map(tuple, frame.tolist())),
        stages=tuple(stages),
        media=tuple(
            KnownMedium(medium=medium, index=parameters.medium_index(values, View(True, number)))
            for number, medium in enumerate(gathered.media.values())
        ),
        residuals=figures,
        provenance=provenance,
    )
