"""Joint calibration from any mix of captures: target images in air and in water, stripes on targets, steps, scans."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Self

import numpy as np
from pydantic import JsonValue

from uwlts.calibration.camera.camera_parameters import CameraOptions
from uwlts.calibration.camera.lens import BESIDES, RATIONAL_BESIDES
from uwlts.calibration.joint.consistency import (
    Findings,
    check_consistency,
    compute_size_deviations,
    describe_wrong_sizes,
    deviations,
    estimate_birge_ratio,
)
from uwlts.calibration.joint.estimate import Estimate, Evidence, estimate
from uwlts.calibration.joint.gathering import Gathered, build_priors, gather_jointly
from uwlts.calibration.joint.initial import (
    build_all_scan_evidence,
    build_step_evidence,
    estimate_line_start,
    estimate_series_start,
)
from uwlts.calibration.joint.parameters import Parameters
from uwlts.calibration.joint.residuals import BENDS, STRETCH
from uwlts.calibration.joint.scanned_surfaces import Plane, SurfaceScanEvidence
from uwlts.calibration.joint.stored_estimate import build_calibration
from uwlts.calibration.sequential.sequential_calibration import CalibrationOptions
from uwlts.errors import CalibrationError
from uwlts.model.calibration import Calibration, KnownStage, WindowModel
from uwlts.model.parameter_keys import LensParameter, TargetParameter
from uwlts.model.sensor import Sensor
from uwlts.runtime.progress import ProgressListener, ignore_progress
from uwlts.storage.capture import Capture

_ROUNDS_LEFT_OUT = 3
_CLEARLY_LESS = 0.9  # scatter with free pixel shape, relative to that without
_NOTICED = 3.0  # standard uncertainties: a parameter wrongly considered less certain loses little


@dataclass(frozen=True, eq=False)
class JointProblem:
    """All evidence, the parameters to estimate from it, and their start values.

    The start values are ``global_values`` (P,) and ``local`` (b,) of every piece of evidence. ``diameter_mm`` is that
    of the target's circles for the correction of their images; None for no correction. ``misfits`` is as for
    `estimate`.
    """

    parameters: Parameters
    evidence: Sequence[Evidence]
    global_values: np.ndarray
    local: list[np.ndarray]
    sensor: Sensor
    diameter_mm: float | None
    warnings: list[str]
    misfits: frozenset[str] = frozenset()

    def solve(self) -> Estimate:
        """Return the estimate without consistency checks; errors as `estimate`."""
        return estimate(
            self.parameters,
            self.evidence,
            self.global_values,
            self.local,
            uncertainty=self.sensor.uncertainty,
            diameter_mm=self.diameter_mm,
            misfits=self.misfits,
        )

    def solve_and_check(self) -> tuple[Estimate, Findings]:
        """Return the estimate and the findings against it; errors as `estimate`.

        The sizes of scanned objects are first estimated and compared with their descriptions. Wrong sizes would change
        lens, window and stage, and would be barely visible in residuals. They are reported if there is no other
        contradiction.
        """
        free = [_free_sizes(piece) for piece in self.evidence]
        result, against = replace(self, evidence=free)._judged_as_described()
        sizes, alone = compute_size_deviations(result, self.evidence), not against.all_against() or bool(self.misfits)
        doubts = [each.words() for each in sizes if each.doubtful()]
        if not any(each.known() for each in sizes):
            return result, replace(against, doubts=doubts + against.doubts)
        wrong = describe_wrong_sizes(sizes)
        if not wrong:
            start = replace(self, global_values=result.values, local=result.local)
            result, with_sizes = start._judged_as_described()
            # Contradictions that appear only with known sizes are caused by these sizes.
            wrong = describe_wrong_sizes(sizes, least=_NOTICED) if alone and with_sizes.all_against() else []
            against = replace(with_sizes, doubts=doubts + with_sizes.doubts)
        if alone:
            against = replace(against, contradictions=wrong + against.contradictions)
        return result, against

    def _judged_as_described(self) -> tuple[Estimate, Findings]:
        """Return the estimate and the findings against it, with the sizes of scanned objects as in the evidence.

        If all prior knowledge deviates more than stated, or the target is bent or stretched more than stated, the prior
        uncertainties are enlarged to the observed deviations: parameters without evidence may be as wrong. This is not
        done if a single parameter contradicts prior knowledge.
        """
        result = self.solve()
        compared, factor = deviations(result, least=0.0), estimate_birge_ratio(result)
        of_target = [each for each in compared if isinstance(each.key, TargetParameter)]
        form = [each for each in of_target if each.sigmas > _NOTICED]
        # The largest deviation is taken as the cause: wrong spacings along both sides appear in the stage's scale.
        stretched = compared[0] in form and compared[0].key in STRETCH
        stretch = {each.key: each.alone for each in of_target if stretched and each.key in STRETCH}
        if not (form or factor > 1.0) or any(each.wrong() for each in compared if each not in of_target):
            return result, replace(check_consistency(result, self.evidence, sensor=self.sensor), stretch=stretch)
        off = {each.key: abs(each.alone - each.known) for each in of_target}
        priors = {key: replace(prior, std=factor * prior.std) for key, prior in self.parameters.priors.items()}
        for alike in (BENDS, STRETCH):
            if any(each.key in alike for each in form):
                together = sum(off.get(key, 0.0) for key in alike)
                priors |= {key: replace(priors[key], std=max(priors[key].std, together)) for key in alike}
        stated = self.sensor.uncertainty
        scaled = stated.model_copy(update={name: factor * value for name, value in stated})
        sensor = self.sensor.model_copy(update={"uncertainty": scaled})
        result = replace(self, parameters=replace(self.parameters, priors=priors), sensor=sensor).solve()
        against = check_consistency(result, self.evidence, sensor=sensor)
        doubts = [f"{each.words()}; its uncertainty was enlarged accordingly" for each in form]
        if factor > 1.0:
            doubts.append(
                f"the description's values of window, media, laser, stage and target deviate by {factor:.1f} times the "
                "stated uncertainties: all uncertainties were enlarged by this factor; check [uncertainty]"
            )
        return result, replace(against, doubts=doubts + against.doubts, stretch=stretch)


def _free_sizes(piece: Evidence) -> Evidence:
    return replace(piece, surface=piece.surface.free_sizes()) if isinstance(piece, SurfaceScanEvidence) else piece


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

    Parameters
    ----------
    targets
        Captures of a target in air or in a medium, with or without the camera's window. Each capture is a separate
        placement, unless the poses are free. Images with the laser on at the same stage positions show the sheet too.
    steps
        Captures of a step standard in a medium.
    scans
        Scans of spheres, a plane or a pipe that stand still while the stage moves the sensor.
    options
        Options. ``refractions`` is ignored: windows are glass plates as described.
    progress
        Called with the number of images done, the total, and the name of the stage.

    Raises
    ------
    CalibrationError
        No target is among the captures; the evidence does not determine the calibration or contradicts it.
    DescriptionError, CaptureError
        As for `gather_jointly`.
    """
    options = CalibrationOptions() if options is None else options
    return solve_jointly(gather_jointly(targets, steps, scans, options=options, progress=progress), options=options)


def joint_problem(gathered: Gathered, *, options: CalibrationOptions) -> JointProblem:
    """Build the problem from the captures, with start values; errors as `calibrate_jointly`."""
    sensor, views = gathered.sensor, gathered.views()
    if not gathered.series:
        raise CalibrationError("no capture shows a target; joint calibration needs one in air or in water")
    bare = next((v.medium for v in views if v.medium is not None and not v.window and set(views) != {v}), None)
    if bare is not None:
        raise CalibrationError(
            f"some captures in {list(gathered.media)[bare]} were taken without a window, others were not: a lens in "
            "contact with the medium has other parameters; calibrate it separately, or set window.mounted"
        )
    window = None
    if any(view.window for view in views):
        window = WindowModel.from_description(sensor.camera.window, sensor.laser.wavelength_nm)
    indices = gathered.indices(options)
    start = estimate_series_start(gathered.series, sensor, window, indices, options=options)
    found = start.sheet()
    if found is None:
        reasons = [each.found.no_stripe for each in gathered.series if each.found.no_stripe]
        raise CalibrationError(
            "; ".join(reasons) or "no stripe was found on the target: check its description and the stage positions"
        )
    sheet, turns = found
    first = start.calibration(sheet.model(np.append(turns, (0.0, 0.0))))
    steps, heights, left_out = build_step_evidence(gathered, first, window)
    scans, missed = build_all_scan_evidence(gathered.scans, first, sensor, indices, sizes_known=options.sizes_known)
    priors = build_priors(gathered, window, turns, heights, options)
    parameters = Parameters(start.intrinsics, sheet, window, tuple(gathered.media), priors)
    global_values = parameters.start(start.lens)
    lines = [estimate_line_start(step, parameters, global_values) for step in steps]
    return JointProblem(
        parameters,
        evidence=[*start.evidence, *steps, *(evidence for evidence, _ in scans)],
        global_values=global_values,
        local=[*start.local, *lines, *(local for _, local in scans)],
        sensor=sensor,
        diameter_mm=gathered.series[0].found.target.circle_diameter_mm if options.correct_circles else None,
        warnings=[*gathered.warnings, *left_out, *missed],
    )


@dataclass(frozen=True, eq=False)
class _Attempt:
    """Problem with its estimate and the findings against it; ``said`` lists previous changes."""

    gathered: Gathered
    options: CalibrationOptions
    problem: JointProblem
    result: Estimate
    against: Findings
    said: tuple[str, ...]

    @classmethod
    def solve(cls, gathered: Gathered, options: CalibrationOptions, said: tuple[str, ...] = ()) -> Self:
        """Solve the problem for this evidence and these options."""
        problem = joint_problem(gathered, options=options)
        return cls(gathered, options, problem, *problem.solve_and_check(), said)

    def improve(self) -> "_Attempt":
        """Try a richer lens, then remove images that do not fit; contradictions of the description remain.

        If images still show systematic deviations, all residuals of an image count as one.
        """
        attempt = self._with_richer_lens()
        if attempt.against.contradictions:
            return attempt
        for _ in range(_ROUNDS_LEFT_OUT):
            if not attempt.against.unfit or (fewer := attempt._without_unfit()) is None:
                break
            attempt = fewer
        return attempt._with_error_of_model() if attempt.against.all_against() else attempt

    def _without_unfit(self) -> "_Attempt | None":
        """Remove the images that contradict all others; None if too few remain, or more contradictions appear."""
        kept = self.gathered.remove_images(self.against.unfit)
        if kept is None:
            return None
        said = [f"{words}; left out" for words in self.against.unfit.values()]
        fewer = _Attempt.solve(kept, self.options, (*self.said, *said))
        return None if fewer.against.contradictions else fewer

    def _with_richer_lens(self) -> "_Attempt":
        """Try more distortion coefficients, free pixel shape, or both; return the attempt that fits the evidence best.

        Only parameters that the options leave open are changed. The pixel shape of a sensor on a stage is not freed for
        contradictions only: a wrong spacing along one side has the same effect.
        """
        choice, camera, best = self.options.lens, self.options.camera, self
        if choice is None or choice.distortion != "auto":
            return best
        odd = any(isinstance(each.key, LensParameter) for each in deviations(self.result, least=_NOTICED))
        for further in (BESIDES, RATIONAL_BESIDES) if odd or self.against.all_against() else ():
            tried = [best._with_lens(replace(camera, distortion=(*camera.distortion, *names))) for names in further]
            best = _select_best([best, *filter(None, tried)])
            if "k3" not in best.options.camera.distortion:
                break
        free_poses = self.options.poses == "free"
        if choice.pixels == "auto" and (free_poses or best.against.misfits):
            free = best._with_lens(replace(best.options.camera, pixel_aspect=None))
            if free is not None and (free_poses or free._scatter() < _CLEARLY_LESS * best._scatter()):
                best = _select_best([best, free])
        if best is not self:
            given = [name for name in best.options.camera.distortion if name not in camera.distortion]
            given += ["free pixels"] if best.options.camera.pixel_aspect != camera.pixel_aspect else []
            said = f"{', '.join(given)} were added to the lens: without them, images and description disagree"
            best = replace(best, said=(*best.said, said))
        if choice.pixels == "auto" and not free_poses:
            best = best._with_spacings_and_pixels_free() or best
        return best

    def _with_spacings_and_pixels_free(self) -> "_Attempt | None":
        """Estimate the target's spacings and the pixel shape; None if the spacings are as described.

        On a stage, wrong spacings along one side have the same effect as pixels of another shape. Only placements of
        the target that are rotated against each other distinguish them.
        """
        found = list(self.against.stretch.values())
        if not found or self.options.camera.pixel_aspect is None:
            return None
        stated = self.gathered.sensor.uncertainty.target_stretch
        known = {"target_stretch": max(stated, sum(map(abs, found)))}
        uncertainty = self.gathered.sensor.uncertainty.model_copy(update=known)
        sensor = self.gathered.sensor.model_copy(update={"uncertainty": uncertainty})
        camera = replace(self.options.camera, pixel_aspect=None)
        freed = replace(self, gathered=replace(self.gathered, sensor=sensor))._with_lens(camera)
        said = (
            f"the target's spacings are off by {' and '.join(f'{1e6 * value:+.0f}' for value in found)} µm/m along "
            "rows and columns, or the pixels' shape is not as described: both are estimated. To distinguish them, use "
            "placements of the target rotated by 90° against each other, or set `pixels` to square or free"
        )
        return None if freed is None else replace(freed, said=(*freed.said, said))

    def _with_lens(self, camera: CameraOptions) -> "_Attempt | None":
        """Solve with another lens; None if it is not determined, or the evidence contradicts the description."""
        try:
            richer = _Attempt.solve(self.gathered, replace(self.options, camera=camera), self.said)
        except CalibrationError:
            return None
        return None if richer.against.contradictions else richer

    def _criterion(self, like: Estimate) -> float:
        """Return -2 ln of the likelihood, plus the cost of parameters without prior knowledge.

        The number of independent residuals is that of ``like``.
        """
        number = {
            kind: sum(len(part.values) for parts in like.residuals for part in parts if part.kind == kind)
            / (noise.together + noise.besides)
            for kind, noise in like.noise.items()
        }
        result, parameters = self.result, self.result.parameters
        scatter = sum(2 * n * np.log(result.noise[kind].sigma_px) for kind, n in number.items())
        off = [(result.values - parameters.prior_mean()) / parameters.prior_std()]
        for piece, local in zip(self.problem.evidence, result.local, strict=True):
            off.append(piece.known_before(local, self.problem.sensor.uncertainty)[0])
        known = np.sum(np.concatenate(off) ** 2)
        return float(scatter + known + np.isinf(parameters.prior_std()).sum() * np.log(sum(number.values())))

    def _scatter(self) -> float:
        """Return the geometric mean of the scatter of target points and stripes, px."""
        return float(np.exp(np.mean(np.log([noise.sigma_px for noise in self.result.noise.values()]))))

    def _with_error_of_model(self) -> "_Attempt":
        """Treat misfits as an error that all residuals of an image share, for every kind of residual.

        An incomplete model also biases lens and poses, so that kinds that fit well are affected too.
        """
        problem = replace(self.problem, misfits=frozenset(self.result.noise))
        result, against = problem.solve_and_check()
        before, after = self.result.std(), result.std()
        factor = float(np.median([after[key] / before[key] for key in before if key in after]))
        said = [f"{words}; kept, as too many images are like this" for words in self.against.unfit.values()]
        said += self.against.misfits.values()
        said.append(
            "images show systematic deviations from the model: all points of an image count as one, which makes "
            f"uncertainties {factor:.1f} times larger (median)"
        )
        against = replace(against, unfit={}, misfits={})
        return replace(self, problem=problem, result=result, against=against, said=(*self.said, *said))


def _select_best(tried: Sequence[_Attempt]) -> _Attempt:
    """Select the attempt that fits the evidence best, by the Bayesian information criterion.

    The number of independent residuals is that of the attempt with the least scatter. Attempts that contradict the
    description are excluded.
    """
    tried = [each for each in tried if not each.against.contradictions] or tried
    like = min(tried, key=_Attempt._scatter).result
    return min(tried, key=lambda each: each._criterion(like))


def solve_jointly(gathered: Gathered, *, options: CalibrationOptions) -> JointResult:
    """Calibrate from gathered evidence; errors as `calibrate_jointly`."""
    attempt = _Attempt.solve(gathered, options)
    if not options.strict:
        attempt = attempt.improve()
    sensor, problem, result, against = gathered.sensor, attempt.problem, attempt.result, attempt.against
    if against.all_against():
        raise CalibrationError(against.refusal())
    warnings = [*problem.warnings, *attempt.said, *against.doubts]
    provenance: dict[str, JsonValue] = {
        **gathered.provenance,
        "poses": options.poses,
        "medium_index": options.medium_index,
        "known_before": sensor.uncertainty.model_dump(),
        "target": gathered.series[0].found.target.model_dump(mode="json"),
        "warnings": [*warnings],
    }
    calibration = build_calibration(result, problem.evidence, sensor, list(gathered.media.values()), provenance)
    scans = [e for e in problem.evidence if isinstance(e, SurfaceScanEvidence) and not isinstance(e.surface, Plane)]
    if scans:
        direction = scans[0].stage_direction(problem.parameters, result.values)[0]
        stage = KnownStage(
            described=gathered.scans[0].stage_direction.tolist(),
            direction=(direction @ calibration.object_transform()[:3, :3]).tolist(),
        )
        calibration = calibration.model_copy(update={"stages": (stage,)})
    return JointResult(calibration, result, warnings)
