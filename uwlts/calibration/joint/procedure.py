"""Joint calibration from any mix of captures: target images in air and in water, stripes on targets, steps, scans."""

from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from typing import Self

import numpy as np
from pydantic import JsonValue

from uwlts.calibration.camera.camera_parameters import CameraOptions
from uwlts.calibration.camera.lens import DISTORTIONS, HALVES_APART, RATIONAL, compare_models, select_model
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
from uwlts.calibration.joint.parameters import Parameters, Prior
from uwlts.calibration.joint.residuals import BENDS, STRETCH, TargetEvidence
from uwlts.calibration.joint.scanned_surfaces import Plane, SurfaceScanEvidence
from uwlts.calibration.joint.stored_estimate import build_calibration
from uwlts.calibration.joint.subsets import (
    HalfDifference,
    LinearisedEstimate,
    compare_estimates,
    keep_images,
    split_in_halves,
)
from uwlts.calibration.sequential.sequential_calibration import CalibrationOptions
from uwlts.errors import CalibrationError
from uwlts.model.calibration import Calibration, KnownStage, WindowModel
from uwlts.model.parameter_keys import LensParameter, ParameterKey, TargetParameter
from uwlts.model.sensor import Sensor
from uwlts.runtime.progress import ProgressListener, ignore_progress
from uwlts.storage.capture import Capture

_ROUNDS_LEFT_OUT = 3  # what remains after three rounds has another cause than single images
_LEAST_GAIN = 0.0
"""Relative gain of a coefficient in predicted mean squares: any that is significant, since the uncertainties of other
coefficients do not contain what a missing one does to them."""
_CLEARLY_LESS = 0.9  # scatter with free pixel shape, relative to that without
_MOST_WIDENED = 10.0
"""Largest factor of a target's stated uncertainty for its observed form or size; more is another target."""
_NOT_BELIEVED = "it is not believed"
_UNDETERMINED = 1e-3  # relative shift of the outermost point by a coefficient's uncertainty: a pixel in a thousand
_TRIAL_LINES = slice(None, None, 4)  # stripe pixels for the comparison of lenses: neighbours are correlated
_MOST_HALVES = 3  # parameters whose halves disagree that a message names
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
        """Return the estimate without consistency checks; errors as `estimate`.

        Parameters that are tied to their prior contribute its uncertainty to all others.
        """
        result = estimate(
            self.parameters,
            self.evidence,
            self.global_values,
            self.local,
            uncertainty=self.sensor.uncertainty,
            diameter_mm=self.diameter_mm,
            misfits=self.misfits,
        )
        if not self.parameters.tied:
            return result
        free = replace(self.parameters, tied=frozenset())
        parts = [e.residuals(free, result.values, own) for e, own in zip(self.evidence, result.local, strict=True)]
        full = replace(result, residuals=[each or [] for each in parts])
        covariance = self.linearise(full).covariance_with(self.parameters.tied)
        return replace(result, covariance=covariance, formal_covariance=result.covariance)

    def linearise(self, result: Estimate) -> LinearisedEstimate:
        """Return the normal equations of an estimate of this problem."""
        return LinearisedEstimate(result, self.evidence, self.sensor.uncertainty)

    def _compare_halves_of_form(self, near: Estimate) -> list[HalfDifference] | None:
        """Estimate from both halves of the images; return parameters of the target that they disagree on.

        None if a half determines no estimate.

        Each half has its own noise: that of all images contains the disagreement.
        """
        found = []
        for half in split_in_halves(self.evidence):
            evidence, local, _ = keep_images(self.evidence, near.local, half.__contains__)
            with suppress(CalibrationError):
                found.append(replace(self, evidence=evidence, local=local, global_values=near.values).solve())
        if len(found) < 2:
            return None
        std = self.parameters.prior_std()
        shared = np.diag(np.where(np.isfinite(std), std, np.inf) ** -2.0)
        values, covariances = [each.values for each in found], [each.covariance for each in found]
        halves = compare_estimates(self.parameters.keys, values, covariances, shared)
        return [h for h in halves if isinstance(h.key, TargetParameter) and h.sigmas() > HALVES_APART]

    def with_lens(self, camera: CameraOptions, near: Estimate) -> Self:
        """Return the problem with another lens and fewer stripe pixels, near an estimate: for its prediction only.

        The target is as described, and all other distortion is zero: else both would replace the lens.
        """
        known, fixed = self.parameters, Prior(0.0, 0.0)
        intrinsics = replace(known.intrinsics, options=camera)
        priors = {
            key: fixed if isinstance(key, TargetParameter) else prior
            for key, prior in known.priors.items()
            if not isinstance(key, LensParameter)
        }
        parameters = replace(known, intrinsics=intrinsics, priors=priors)
        start = dict(zip(known.keys, near.values, strict=True))
        start |= {LensParameter.FX: start.get(LensParameter.F, start.get(LensParameter.FX))}
        start |= {LensParameter.F: start[LensParameter.FX]}
        start |= {LensParameter.FY: start.get(LensParameter.FY, start[LensParameter.F])}
        evidence = [e.with_stripes(_TRIAL_LINES) if isinstance(e, TargetEvidence) else e for e in self.evidence]
        return replace(self.with_parameters(parameters, start), evidence=evidence, local=near.local)

    def with_parameters(self, parameters: Parameters, start: Mapping[ParameterKey, float]) -> Self:
        """Return the problem with other parameters; those without a start value begin at zero."""
        values = np.array([start.get(key, 0.0) for key in parameters.keys])
        return replace(self, parameters=parameters, global_values=values)

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
        done if a single parameter contradicts prior knowledge. Form and size of the target are only believed if both
        halves of the images agree on them, and never for many times what is stated. Otherwise they stay as described,
        with an uncertainty as many times larger as they deviate in standard uncertainties.
        """
        result = self.solve()
        compared, factor = deviations(result, least=0.0), estimate_birge_ratio(result)
        of_target = [each for each in compared if isinstance(each.key, TargetParameter)]
        form = [each for each in of_target if each.sigmas > _NOTICED]
        # The largest deviation is taken as the cause: wrong spacings along both sides appear in the stage's scale.
        stretched = compared[0] in form and compared[0].key in STRETCH
        stretch = {each.key: each.alone for each in of_target if stretched and each.key in STRETCH}
        if not (form or factor > 1.0) or any(each.wrong() for each in compared if each not in of_target):
            against = check_consistency(result, self.evidence, sensor=self.sensor)
            return result, replace(against, stretch=stretch, form=bool(form))
        off = {each.key: abs(each.alone - each.known) for each in of_target}
        scaled = {key: replace(prior, std=factor * prior.std) for key, prior in self.parameters.priors.items()}
        priors = dict(scaled)
        for alike in (BENDS, STRETCH):
            if any(each.key in alike for each in form):
                together = sum(off.get(key, 0.0) for key in alike)
                priors |= {key: replace(priors[key], std=max(priors[key].std, together)) for key in alike}
        sensor = self.sensor.model_copy(update={"uncertainty": self.sensor.uncertainty.scaled(factor)})
        parameters = replace(self.parameters, priors=priors)
        apart = replace(self, parameters=parameters)._compare_halves_of_form(result) if form else []
        many = {each.key: priors[each.key].std / scaled[each.key].std for each in form}
        refused = [each for each in form if many[each.key] > _MOST_WIDENED or apart is None]
        apart = apart or []
        tied = {key for alike in (BENDS, STRETCH) for each in (*apart, *refused) if each.key in alike for key in alike}
        # The stated uncertainty is multiplied by the deviation's ratio to it (Birge's ratio of one value).
        less_sure = {
            key: max((each.sigmas for each in form if (each.key in BENDS) == (key in BENDS)), default=1.0)
            for key in tied
        }
        doubts = [f"{each.words()}; its uncertainty was enlarged accordingly" for each in form if each.key not in tied]
        doubts += [f"{each.words()}: {_NOT_BELIEVED}, the target is taken as described" for each in apart]
        said = {each: f"{each.words()}; {many[each.key]:.0f} times what is stated" for each in refused if not apart}
        if tied := tied & set(self.parameters.keys):
            known = priors | {key: replace(scaled[key], std=less_sure[key] * scaled[key].std) for key in tied}
            parameters = replace(parameters, priors=known, tied=frozenset(tied))
        result = replace(self, parameters=parameters, sensor=sensor).solve()
        against = check_consistency(result, self.evidence, sensor=sensor)
        # Systematic deviations enlarge all uncertainties; without them, nothing would.
        covered = self.misfits or (not against.contradictions and against.all_against())
        contradictions = [f"{words}: state it if this is so" for e, words in said.items() if e.wrong() and not covered]
        doubts += [f"{words}: {_NOT_BELIEVED}; state it if so" for e, words in said.items() if covered or not e.wrong()]
        if tied:
            doubts.append(
                f"the target's form or size is taken to be {max(less_sure.values()):.1f} times less certain than stated"
            )
        if factor > 1.0:
            doubts.append(
                f"the description's values of window, media, laser, stage and target deviate by {factor:.1f} times the "
                "stated uncertainties: all uncertainties were enlarged by this factor; check [uncertainty]"
            )
        against = replace(
            against, contradictions=[*contradictions, *against.contradictions], doubts=[*doubts, *against.doubts]
        )
        return result, replace(against, stretch=stretch, form=bool(form))


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

    Each capture of a target, in air or in a medium, with or without the camera's window, is a separate placement,
    unless the poses are free. Its images with the laser on at the same stage positions show the sheet, too. In scans of
    spheres, a plane or a pipe the stage moves the sensor. The option ``refractions`` is ignored: windows are glass
    plates as described.

    Raises CalibrationError if no target is among the captures; the evidence does not determine the calibration or
    contradicts it; DescriptionError, CaptureError as for `gather_jointly`.
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
        """Try other lenses, then remove images that do not fit; contradictions of the description remain.

        If images still show systematic deviations, or their halves disagree, all residuals of an image count as one.
        """
        attempt = self._with_better_lens()
        if attempt.against.contradictions:
            return attempt
        for _ in range(_ROUNDS_LEFT_OUT):
            if not attempt.against.unfit or (fewer := attempt._without_unfit()) is None:
                break
            attempt = fewer
        halves = attempt.problem.linearise(attempt.result).disagreements()
        words = [each.words() for each in halves[:_MOST_HALVES]]
        attempt = attempt if not words else replace(attempt, said=(*attempt.said, *words))
        return attempt._with_error_of_model() if words or attempt.against.all_against() else attempt

    def _without_unfit(self) -> "_Attempt | None":
        """Remove the images that contradict all others; None if too few remain, or more contradictions appear."""
        kept = self.gathered.remove_images(self.against.unfit)
        if kept is None:
            return None
        said = [f"{words}; left out" for words in self.against.unfit.values()]
        fewer = _Attempt.solve(kept, self.options, (*self.said, *said))
        return None if fewer.against.contradictions else fewer

    def _with_better_lens(self) -> "_Attempt":
        """Try fewer and more distortion coefficients, free pixel shape, or both, if something is odd.

        Only parameters that the options leave open are changed. The pixel shape of a sensor on a stage is not freed for
        contradictions only: a wrong spacing along one side has the same effect.
        """
        choice, camera, best = self.options.lens, self.options.camera, self
        if choice is None or choice.distortion != "auto":
            return best
        odd = any(isinstance(each.key, LensParameter) for each in deviations(self.result, least=_NOTICED))
        odd |= bool(self.against.all_against() or self.against.form or self._undetermined())
        free_pixels = choice.pixels == "auto" and self.options.poses == "free"
        # All are compared at once: pixels that are not square hide the gain of a coefficient.
        shapes = dict.fromkeys((camera.pixel_aspect, None) if free_pixels else (camera.pixel_aspect,))
        known = DISTORTIONS if odd else (camera.distortion,)
        if len(lenses := [replace(camera, distortion=d, pixel_aspect=shape) for shape in shapes for d in known]) > 1:
            chosen = self._select_lens(lenses)
            if "k3" in chosen.distortion and odd:
                chosen = self._select_lens([chosen, *(replace(chosen, distortion=names) for names in RATIONAL)])
            best = self._with_lens(chosen) or self if chosen != camera else self
        if choice.pixels == "auto" and not free_pixels:
            if best.against.misfits:
                free = best._with_lens(replace(best.options.camera, pixel_aspect=None))
                best = free if free is not None and free._scatter() < _CLEARLY_LESS * best._scatter() else best
            best = best._describe_lens(camera)
            return best._with_spacings_and_pixels_free() or best
        return best._describe_lens(camera)

    def _undetermined(self) -> list[str]:
        """Describe distortion coefficients that the images do not determine.

        Their uncertainty alone shifts the outermost point of the target noticeably, and zero is as likely.
        """
        camera, std, found = self.result.parameters.camera(self.result.values), self.result.std(), []
        points = [e.placement.pixels for e in self.problem.evidence if isinstance(e, TargetEvidence)]
        off = (np.vstack(points) - [camera.cx_px, camera.cy_px]) / [camera.fx_px, camera.fy_px]
        reach = float(np.linalg.norm(off, axis=1).max())
        for key, power in ((LensParameter.K1, 2), (LensParameter.K2, 4), (LensParameter.K3, 6)):
            value = getattr(camera.distortion, key.text)
            if key in std and std[key] * reach**power > _UNDETERMINED and abs(value) < 2 * std[key]:
                found.append(f"{key.quantity.words} is not determined: {key.quantity.format_with_std(value, std[key])}")
        return found

    def _select_lens(self, lenses: Sequence[CameraOptions]) -> CameraOptions:
        """Select the lens with the fewest parameters of those that predict held-out images as well as the best."""
        stated, tried = joint_problem(self.gathered, options=self.options), {}
        for options in lenses:
            with suppress(CalibrationError):
                trial = stated.with_lens(options, self.result)
                result = trial.solve()
                tried[options] = trial.linearise(result).predict(), result
        if not tried:
            return self.options.camera
        noise = min((result for _, result in tried.values()), key=_scatter).noise
        squares = {options: held.squares(noise) for options, (held, _) in tried.items()}
        return select_model(compare_models(squares, least_gain=_LEAST_GAIN), self.options.camera)

    def _describe_lens(self, before: CameraOptions) -> "_Attempt":
        """Add warnings on changes of the lens, and on coefficients that remain undetermined."""
        camera, said = self.options.camera, []
        given = [name for name in camera.distortion if name not in before.distortion]
        given += ["free pixels"] if camera.pixel_aspect != before.pixel_aspect else []
        if given:
            said.append(f"{', '.join(given)} were added to the lens: held-out images are predicted better with them")
        if fewer := [name for name in before.distortion if name not in camera.distortion]:
            said.append(f"{', '.join(fewer)} were left out of the lens: images are predicted as well without them")
        return replace(self, said=(*self.said, *said, *self._undetermined()))

    def _with_spacings_and_pixels_free(self) -> "_Attempt | None":
        """Estimate the target's spacings and the pixel shape; None if the spacings are as described.

        On a stage, wrong spacings along one side have the same effect as pixels of another shape. Only placements of
        the target that are rotated against each other distinguish them.
        """
        found = list(self.against.stretch.values())
        if not found or self.options.camera.pixel_aspect is None:
            return None
        stated = self.gathered.sensor.uncertainty.stretch_by_axis()
        known = {"target_stretch": tuple(max(each, sum(map(abs, found))) for each in stated)}
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

    def _scatter(self) -> float:
        """Return the geometric mean of the scatter of target points and stripes, px."""
        return _scatter(self.result)

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
        # Larger uncertainties hide what the halves disagree on.
        said += [words for words in self.against.doubts if _NOT_BELIEVED in words and words not in against.doubts]
        said.append(
            "images show systematic deviations from the model: all points of an image count as one, which makes "
            f"uncertainties {factor:.1f} times larger (median)"
        )
        against = replace(against, unfit={}, misfits={})
        return replace(self, problem=problem, result=result, against=against, said=(*self.said, *said))


def _scatter(result: Estimate) -> float:
    return float(np.exp(np.mean(np.log([noise.sigma_px for noise in result.noise.values()]))))


def _first_attempt(gathered: Gathered, options: CalibrationOptions) -> _Attempt:
    """Solve with the usual lens, or with fewer coefficients if the images do not determine them."""
    try:
        return _Attempt.solve(gathered, options)
    except CalibrationError as refusal:
        if options.lens is None or options.lens.distortion != "auto":
            raise
        for fewer in (("k1",), ()):
            said = f"the lens has {' '.join(fewer) or 'no distortion'}: with {' '.join(options.camera.distortion)}, "
            with suppress(CalibrationError):
                camera = replace(options.camera, distortion=fewer)
                return _Attempt.solve(gathered, replace(options, camera=camera), (said + str(refusal),))
        raise


def solve_jointly(gathered: Gathered, *, options: CalibrationOptions) -> JointResult:
    """Calibrate from gathered evidence; errors as `calibrate_jointly`."""
    attempt = _first_attempt(gathered, options)
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
