"""The joint calibration from captures: target images in air and in water, stripes on it, steps, scans; in any mix."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import partial

import numpy as np
from pydantic import JsonValue

from uwlts.calibration.camera import centre_offsets
from uwlts.calibration.evidence import Progress
from uwlts.calibration.joint.consistency import findings
from uwlts.calibration.joint.estimate import Estimate, Evidence, estimate
from uwlts.calibration.joint.evidence import TargetEvidence
from uwlts.calibration.joint.evidence_summary import joint_estimate, lens_and_window_figures
from uwlts.calibration.joint.gathering import Gathered, gather_jointly, priors_of, refuse_two_lenses
from uwlts.calibration.joint.initial import line_start, series_start, sheet_start, step_profiles
from uwlts.calibration.joint.initial_scans import surface_scans
from uwlts.calibration.joint.parameters import Parameters, View
from uwlts.calibration.joint.scanned_surfaces import Plane, SurfaceScanEvidence
from uwlts.calibration.sequential import CalibrationOptions
from uwlts.calibration.sheet import object_frame
from uwlts.model.calibration import Calibration, KnownMedium, KnownStage, WindowModel
from uwlts.model.errors import CalibrationError
from uwlts.model.joint_estimate import JointEstimate
from uwlts.model.placement import laser_pose
from uwlts.model.sensor import Uncertainty
from uwlts.optics.camera import project_through_window
from uwlts.storage.capture import Capture


@dataclass(frozen=True, eq=False)
class JointProblem:
    """All evidence with what is to be estimated from it, and where that starts.

    Attributes
    ----------
    global_values : (P,); start
    local : list of (b,); starts of the evidence's local parameters
    diameter_mm : of the target's circles, whose images are to be corrected; None where nothing is
    sources : for every piece of evidence the names of its images by their numbers
    """

    parameters: Parameters
    evidence: list[Evidence]
    global_values: np.ndarray
    local: list[np.ndarray]
    uncertainty: Uncertainty
    diameter_mm: float | None
    sources: list[dict[int, str]]
    warnings: list[str]

    def solve(self) -> Estimate:
        """The estimate, not judged yet; errors as `estimate`."""
        return estimate(
            self.parameters,
            self.evidence,
            self.global_values,
            self.local,
            uncertainty=self.uncertainty,
            correct=None if self.diameter_mm is None else partial(centred, self.parameters, self.diameter_mm),
        )


@dataclass(frozen=True, eq=False)
class JointResult:
    """A joint calibration with what a report shows of its making."""

    calibration: Calibration
    estimate: Estimate
    warnings: list[str]


def calibrate_jointly(
    targets: Sequence[Capture],
    steps: Sequence[Capture] = (),
    scans: Sequence[Capture] = (),
    *,
    options: CalibrationOptions | None = None,
    progress: Progress | None = None,
) -> JointResult:
    """Calibrate a sensor from all captures at once.

    Parameters
    ----------
    targets : a target in air or in a medium, with or without the camera's window, as each capture says; each capture is
        a placement of its own, unless the poses are free. With the laser on at the same stage positions they show the
        sheet too.
    steps : a step standard in a medium
    scans : scans of spheres, a plane or a pipe that stand still while the stage moves the sensor
    options : its ``refractions`` do not count: windows are plates as described

    Raises
    ------
    CalibrationError
        No target is among the captures; the evidence does not determine the calibration or contradicts it.
    DescriptionError
        A capture describes its target wrongly, or not its step standard or what it scans.
    CaptureError
        A scan shows no stripe, or an image is damaged.
    """
    options = CalibrationOptions() if options is None else options
    return solve_jointly(gather_jointly(targets, steps, scans, options=options, progress=progress), options=options)


def joint_problem(gathered: Gathered, *, options: CalibrationOptions) -> JointProblem:
    """What is to be estimated from what the captures show, with a start; errors as `calibrate_jointly`."""
    sensor, warnings = gathered.sensor, list(gathered.warnings)
    if not gathered.series:
        raise CalibrationError("no capture shows a target: the joint calibration starts with one in air or in water")
    refuse_two_lenses(gathered)
    window = None
    if any(view.window for view in gathered.views()):
        window = WindowModel.described(sensor.camera.window, sensor.laser.wavelength_nm)
    wavelength, free = sensor.laser.wavelength_nm, options.poses == "free"
    indices = [options.medium_index or medium.refractive_index(wavelength) for medium in gathered.media.values()]
    start = series_start(
        gathered.series, sensor, window, indices, options=options.camera, free=free, margin_mm=options.margin_mm
    )
    found = sheet_start(start, sensor, window, indices)
    if found is None:
        reasons = [each.found.no_stripe for each in gathered.series if each.found.no_stripe]
        raise CalibrationError(
            "; ".join(reasons) or "no stripe was found on the target: check its description and the stage positions"
        )
    sheet, turns = found
    first = sheet.model(np.append(turns, (0.0, 0.0)))
    first_calibration = start.calibration(sensor, window, first)
    steps, left_out = step_profiles(gathered, first_calibration, window)
    scans, missed = surface_scans(gathered.scans, first_calibration, sensor, indices, sizes_known=options.sizes_known)
    warnings += [*left_out, *missed]
    priors = priors_of(gathered, window, indices, turns, {e.height: known for e, known in steps}, options)
    parameters = Parameters(start.intrinsics, sheet, window, tuple(gathered.media), priors)
    evidence: list[Evidence] = [*start.evidence, *(e for e, _ in steps), *(e for e, _ in scans)]
    global_values = parameters.start(start.lens)
    local = [
        *start.local,
        *(line_start(e, parameters, global_values) for e, _ in steps),
        *(local for _, local in scans),
    ]
    target = gathered.series[0].found.target
    diameter_mm = target.circle_diameter_mm if options.correct_circles else None
    sources = gathered.sources(free=free)
    sources += [{e.image: gathered.steps[e.image][0].source} for e, _ in steps]
    sources += [e.sources() for e, _ in scans]
    return JointProblem(parameters, evidence, global_values, local, sensor.uncertainty, diameter_mm, sources, warnings)


def solve_jointly(gathered: Gathered, *, options: CalibrationOptions) -> JointResult:
    """Calibrate from what the captures show, with the errors of `calibrate_jointly`."""
    sensor, problem = gathered.sensor, joint_problem(gathered, options=options)
    evidence, sources, warnings = problem.evidence, problem.sources, list(problem.warnings)
    parameters, result = problem.parameters, problem.solve()
    against = findings(result, evidence, sources, sensor=sensor)
    if against.contradictions:
        raise CalibrationError(against.refusal())
    warnings += against.doubts
    provenance: dict[str, JsonValue] = {
        **gathered.provenance,
        "poses": options.poses,
        "medium_index": options.medium_index,
        "known_before": sensor.uncertainty.model_dump(),
        "target": gathered.series[0].found.target.model_dump(mode="json"),
        "warnings": [*warnings],
    }
    frame = object_frame(parameters.sheet_model(result.values), laser_axis=laser_pose(sensor).axis)
    kept = joint_estimate(result, evidence, sources, frame)
    stages = [
        KnownStage(
            described=gathered.scans[0].stage_direction.tolist(),
            direction=(scan.moved_direction(parameters, result.values) @ frame[:3, :3]).tolist(),
        )
        for scan in [e for e in evidence if isinstance(e, SurfaceScanEvidence) and not isinstance(e.surface, Plane)][:1]
    ]
    calibration = _calibration(gathered, result, frame, stages, kept, provenance)
    return JointResult(calibration, result, warnings)


def _calibration(
    gathered: Gathered,
    result: Estimate,
    frame: np.ndarray,
    stages: list[KnownStage],
    joint: JointEstimate,
    provenance: dict[str, JsonValue],
) -> Calibration:
    sensor, parameters, values = gathered.sensor, result.parameters, result.values
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
        residuals={**lens_and_window_figures(result)},
        joint=joint,
        provenance=provenance,
    )


def centred(
    parameters: Parameters,
    diameter_mm: float,
    found: Sequence[Evidence],
    global_values: np.ndarray,
    local: Sequence[np.ndarray],
) -> list[Evidence]:
    """The evidence with the images of the circles' centres instead of the centres of the circles' images."""
    return [
        _with_centres(e, parameters, global_values, o, diameter_mm) if isinstance(e, TargetEvidence) else e
        for e, o in zip(found, local, strict=True)
    ]


def _with_centres(
    evidence: TargetEvidence, parameters: Parameters, global_values: np.ndarray, local: np.ndarray, diameter_mm: float
) -> TargetEvidence:
    view, placement = evidence.view, evidence.placement
    camera, index = parameters.camera(global_values), parameters.medium_index(global_values, view)
    window = parameters.window_model(global_values) if view.window else None
    seen_by = partial(project_through_window, camera, window, medium_index=index)
    pixels = placement.pixels.copy()
    for image in np.unique(placement.image):
        pose, here = evidence.pose(parameters, global_values, local, image), placement.image == image
        pixels[here] -= centre_offsets(seen_by, pose, placement.points_mm[here], diameter_mm=diameter_mm)
    return replace(evidence, placement=replace(placement, pixels=pixels))
