"""Changes of a joint calibration because of what its residuals show: uncertainties, lens, images, weights."""

from collections.abc import Callable, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from typing import Self

import numpy as np

from uwlts.calibration.camera.camera_parameters import CameraOptions
from uwlts.calibration.camera.lens import DISTORTIONS, HALVES_APART, RATIONAL, compare_models, select_model
from uwlts.calibration.joint.diagnose import (
    DOUBTFUL,
    NOTICED,
    Deviation,
    Findings,
    PriorDeviations,
    check_consistency,
    compute_size_deviations,
    describe_wrong_sizes,
    deviations,
    format_deviation,
)
from uwlts.calibration.joint.estimate import Estimate, Evidence, prior_observations
from uwlts.calibration.joint.gathering import Gathered
from uwlts.calibration.joint.initial import find_odd_images
from uwlts.calibration.joint.parameters import Parameters
from uwlts.calibration.joint.problem import (
    HalfDifference,
    JointProblem,
    compare_estimates,
    joint_problem,
    mean_squares,
    split_in_halves,
)
from uwlts.calibration.joint.residuals import BENDS, STRETCH, STRIPE
from uwlts.calibration.joint.scanned_surfaces import SurfaceScanEvidence
from uwlts.calibration.sequential.sequential_calibration import CalibrationOptions
from uwlts.calibration.target_stripes import doubt_sheet_at_rest
from uwlts.errors import CalibrationError
from uwlts.fitting.schur_least_squares import normal_equations
from uwlts.model.parameter_keys import LensParameter, MediumIndex, ParameterKey, TargetParameter

_LEAST_GAIN = 0.0
"""Relative gain of a coefficient in predicted mean squares: any that is significant, since the uncertainties of other
coefficients do not contain what a missing one does to them."""
_CLEARLY_LESS = 0.9  # scatter with free pixel shape, relative to that without
_MOST_WIDENED = 10.0
"""Largest factor of a target's stated uncertainty for its observed form or size; more is another target."""
_NOT_BELIEVED = "it is not believed"
_MOST_HALVES = 3  # parameters whose halves disagree that a message names
_ANY_INDEX = 0.02  # standard uncertainty of the index of an unknown liquid


def solve_consistently(
    gathered: Gathered, options: CalibrationOptions
) -> tuple[JointProblem, Estimate, Findings, tuple[str, ...]]:
    """Solve for gathered evidence, and change the problem until it fits, unless ``options.strict``.

    Returns the problem, its estimate, the findings against it, and the changes.
    """
    attempt = _solve_first(gathered, options)
    # Before images are left out, which may all be from one side of a move.
    moved = _doubt_sheet_at_rest(attempt.problem.evidence, attempt.result)
    if not options.strict:
        attempt = attempt.improve()
    return attempt.problem, attempt.result, attempt.against, (*moved, *attempt.said)


def _doubt_sheet_at_rest(evidence: Sequence[Evidence], result: Estimate) -> list[str]:
    lit = [
        (piece.sources[part.image], piece.pixels[piece.stripe_pixels(part.image)], part.values)
        for piece, parts in zip(evidence, result.residuals, strict=True)
        for part in parts
        if part.kind == STRIPE
    ]
    return doubt_sheet_at_rest(*zip(*lit, strict=True), across=evidence[0].across, unit="px") if lit else []


def solve_and_check(problem: JointProblem) -> tuple[Estimate, Findings]:
    """Return the estimate and the findings against it; errors as `estimate`.

    The sizes of scanned objects are first estimated and compared with their descriptions. Wrong sizes would change
    lens, window and stage, and would be barely visible in residuals. They are reported if there is no other
    contradiction.
    """
    free = [
        replace(piece, surface=piece.surface.free_sizes()) if isinstance(piece, SurfaceScanEvidence) else piece
        for piece in problem.evidence
    ]
    result, against = _solve_with_observed_uncertainties(replace(problem, evidence=free))
    sizes, alone = compute_size_deviations(result, problem.evidence), not against.all_against() or bool(problem.misfits)
    doubts = [each.words() for each in sizes if each.doubtful()]
    if not any(each.known() for each in sizes):
        return result, replace(against, doubts=doubts + against.doubts)
    wrong = describe_wrong_sizes(sizes)
    if not wrong:
        start = replace(problem, global_values=result.values, local=result.local)
        result, with_sizes = _solve_with_observed_uncertainties(start)
        # Contradictions that appear only with known sizes are caused by these sizes.
        wrong = describe_wrong_sizes(sizes, least=NOTICED) if alone and with_sizes.all_against() else []
        against = replace(with_sizes, doubts=doubts + with_sizes.doubts)
    if alone:
        against = replace(against, contradictions=wrong + against.contradictions)
    return result, against


def explain_refusal(problem: JointProblem, against: Findings) -> str:
    """Describe what contradicts an estimate, after an earlier calibration also by an index that would explain it."""
    priors = problem.parameters.priors
    new = [key for key in problem.parameters.keys if isinstance(key, MediumIndex) and np.isfinite(priors[key].std)]
    if problem.parameters.earlier is None:
        return against.refusal()
    if not new:
        return f"{against.refusal()}; if the water is other than before, give `new_water`"
    free = priors | {key: replace(priors[key], std=_ANY_INDEX) for key in new}
    result, left = solve_and_check(replace(problem, parameters=replace(problem.parameters, priors=free)))
    found, std = dict(zip(result.parameters.keys, result.values.tolist(), strict=True)), result.std()
    off = {key: abs(found[key] - priors[key].mean) / float(np.hypot(std[key], priors[key].std)) for key in new}
    words = [
        format_deviation(key, found[key], priors[key].mean, priors[key].std, sigmas=sigmas)
        for key, sigmas in off.items()
        if sigmas >= DOUBTFUL and not left.all_against()
    ]
    return "; ".join(words) or against.refusal()


@dataclass(frozen=True)
class _FormVerdict:
    """Decision on noticeable deviations ``form`` of the target's form and size.

    If both halves of the images agree, the prior uncertainty becomes the observed deviation. If the halves disagree
    (``apart``), or the deviation is many times what is stated (``refused``, with this factor), the value stays as
    described. Its stated uncertainty is then multiplied by the deviation in standard uncertainties.

    ``tied`` are these factors of the parameters that stay as described.
    """

    form: list[Deviation]
    apart: list[HalfDifference]
    refused: dict[Deviation, float]
    tied: dict[ParameterKey, float]

    def describe(self, against: Findings) -> tuple[list[str], list[str]]:
        """Return contradictions and doubts about the target."""
        doubts = [
            f"{each.words()}; its uncertainty was enlarged accordingly"
            for each in self.form
            if each.key not in self.tied
        ]
        doubts += [f"{each.words()}: {_NOT_BELIEVED}, the target is taken as described" for each in self.apart]
        contradictions = []
        # Systematic deviations enlarge all uncertainties; without them, nothing would.
        covered = not against.contradictions and against.all_against()
        for each, times in self.refused.items() if not self.apart else ():
            found = f"{each.words()}; {times:.0f} times what is stated"
            if each.wrong() and not covered:
                contradictions.append(f"{found}: state it if this is so")
            else:
                doubts.append(f"{found}: {_NOT_BELIEVED}; state it if so")
        if self.tied:
            doubts.append(
                f"the target's form or size is taken to be {max(self.tied.values()):.1f} times less certain than stated"
            )
        return contradictions, doubts


def _solve_with_observed_uncertainties(problem: JointProblem) -> tuple[Estimate, Findings]:
    """Return the estimate and the findings against it, with the sizes of scanned objects as in the evidence.

    If all prior knowledge deviates more than stated, all prior uncertainties are multiplied by Birge's ratio, because
    parameters without evidence may be as wrong. For the form and size of the target, see `_FormVerdict`. Both are not
    done if a single other parameter contradicts prior knowledge, nor again for an incomplete model.
    """
    result = problem.solve()
    seen, sensor = PriorDeviations(deviations(result, least=0.0)), problem.sensor
    contradictions, doubts, factor = [], [], 1.0
    if problem.misfits or not seen.show_understated():
        against = check_consistency(result, problem.evidence, sensor=sensor)
    else:
        factor = seen.birge_ratio
        parameters, verdict = _judge_form(problem, seen, result)
        sensor = sensor.model_copy(update={"uncertainty": sensor.uncertainty.scaled(factor)})
        result = replace(problem, parameters=parameters, sensor=sensor).solve()
        against = check_consistency(result, problem.evidence, sensor=sensor)
        contradictions, doubts = verdict.describe(against)
        if factor > 1.0:
            doubts.append(
                f"the description's values of window, media, laser, stage and target deviate by {factor:.1f} times the "
                "stated uncertainties: all uncertainties were enlarged by this factor; check [uncertainty]"
            )
    found = {"contradictions": [*contradictions, *against.contradictions], "doubts": [*doubts, *against.doubts]}
    judged = {"judged": tuple(doubts), "enlarged": factor}
    return result, replace(against, **found, **judged, stretch=seen.stretch(), form=bool(seen.form()))


def _judge_form(problem: JointProblem, seen: PriorDeviations, near: Estimate) -> tuple[Parameters, _FormVerdict]:
    """Return the parameters with the prior uncertainties of the verdict, and the verdict."""
    form, known = seen.form(), problem.parameters
    scaled = {key: replace(prior, std=seen.birge_ratio * prior.std) for key, prior in known.priors.items()}
    priors, off = dict(scaled), {each.key: abs(each.alone - each.known) for each in seen.of_target()}
    for group in (BENDS, STRETCH):
        if any(each.key in group for each in form):
            together = sum(off.get(key, 0.0) for key in group)
            priors |= {key: replace(priors[key], std=max(priors[key].std, together)) for key in group}
    wider = replace(known, priors=priors)
    halves = _compare_halves_of_form(replace(problem, parameters=wider), near) if form else []
    times = {each: priors[each.key].std / scaled[each.key].std for each in form}
    refused = {each: many for each, many in times.items() if many > _MOST_WIDENED or halves is None}
    tied = {}
    for group in (BENDS, STRETCH):
        if any(each.key in group for each in (*(halves or ()), *refused)):
            # The stated uncertainty is multiplied by the deviation's ratio to it (Birge's ratio of one value).
            less_sure = max((each.sigmas for each in form if each.key in group), default=1.0)
            tied |= {key: less_sure for key in group if key in known.keys}
    if tied:
        stated = {key: replace(scaled[key], std=less_sure * scaled[key].std) for key, less_sure in tied.items()}
        wider = replace(known, priors=priors | stated, tied=frozenset(tied))
    return wider, _FormVerdict(form, halves or [], refused, tied)


def _compare_halves_of_form(problem: JointProblem, near: Estimate) -> list[HalfDifference] | None:
    """Estimate from both halves of the images; return parameters of the target that they disagree on.

    None if a half determines no estimate.

    Each half has its own noise: that of all images contains the disagreement.
    """
    found = []
    for half in split_in_halves(problem.evidence):
        with suppress(CalibrationError):
            found.append(problem.with_images(half, near).solve())
    if len(found) < 2:
        return None
    count = len(near.values)
    shared = normal_equations(prior_observations(problem.parameters, near.values), count, 0)[0][:count, :count]
    values, covariances = [each.values for each in found], [each.covariance for each in found]
    halves = compare_estimates(problem.parameters.keys, values, covariances, shared)
    return [h for h in halves if isinstance(h.key, TargetParameter) and h.sigmas() > HALVES_APART]


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
    def solve(cls, gathered: Gathered, options: CalibrationOptions, texts: tuple[str, ...] = ()) -> Self:
        """Solve the problem for this evidence and these options."""
        problem = joint_problem(gathered, options=options)
        return cls(gathered, options, problem, *solve_and_check(problem), texts)

    def improve(self) -> "_Attempt":
        """Change the problem by all rules in turn; contradictions of the description remain."""
        attempt = self
        for change, times in _RULES:
            for _ in range(times):
                if (changed := change(attempt)) is None:
                    break
                attempt = changed
            if attempt.against.contradictions:
                break
        return attempt

    def _drop_unfit(self) -> "_Attempt | None":
        """Remove the images that contradict all others; None if too few remain, or more contradictions appear."""
        if not self.against.unfit or (kept := self.gathered.remove_images(self.against.unfit)) is None:
            return None
        texts = [f"{text}; left out" for text in self.against.unfit.values()]
        fewer = _Attempt.solve(kept, self.options, (*self.said, *texts))
        return None if fewer.against.contradictions else fewer

    def _try_lenses(self) -> "_Attempt":
        """Try more distortion coefficients, free pixel shape, or both, if something is odd.

        Only parameters that the options leave open are changed. The pixel shape of a sensor on a stage is not freed for
        contradictions only: a wrong spacing along one side has the same effect.
        """
        choice, camera, best = self.options.lens, self.options.camera, self
        if choice is None or choice.distortion != "auto":
            return best
        odd = any(isinstance(each.key, LensParameter) for each in deviations(self.result, least=NOTICED))
        odd |= bool(self.against.all_against() or self.against.form)
        free_pixels = choice.pixels == "auto" and self.options.poses == "free"
        # All are compared at once: pixels that are not square hide the gain of a coefficient.
        shapes = dict.fromkeys((camera.pixel_aspect, None) if free_pixels else (camera.pixel_aspect,))
        known = [each for each in DISTORTIONS if {*camera.distortion} <= {*each}] if odd else (camera.distortion,)
        if len(lenses := [replace(camera, distortion=d, pixel_aspect=shape) for shape in shapes for d in known]) > 1:
            chosen = self._select_lens(lenses)
            if "k3" in chosen.distortion and odd:
                chosen = self._select_lens([chosen, *(replace(chosen, distortion=names) for names in RATIONAL)])
            best = self._use_lens(chosen) or self if chosen != camera else self
        if any(isinstance(each.key, LensParameter) and each.wrong() for each in deviations(best.result)):
            # Before the usual size of p1 and p2 refuses anything, they are free.
            freer = replace(camera, distortion=tuple(dict.fromkeys((*best.options.camera.distortion, "p1", "p2"))))
            freed = (best._use_lens(replace(freer, pixel_aspect=shape)) for shape in shapes)
            best = next((each for each in freed if each is not None), best)
        if choice.pixels == "auto" and not free_pixels:
            if best.against.misfits:
                free = best._use_lens(replace(best.options.camera, pixel_aspect=None))
                best = free if free is not None and _score(free.result) < _CLEARLY_LESS * _score(best.result) else best
            best = best._describe_lens(camera)
            return best._free_spacings_and_pixels() or best
        return best._describe_lens(camera)

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
        noise = min((result for _, result in tried.values()), key=_score).noise
        squares = {options: mean_squares(held, noise) for options, (held, _) in tried.items()}
        return select_model(compare_models(squares, least_gain=_LEAST_GAIN), self.options.camera)

    def _describe_lens(self, before: CameraOptions) -> "_Attempt":
        """Add a warning on additions to the lens."""
        camera = self.options.camera
        given = [name for name in camera.distortion if name not in before.distortion]
        given += ["free pixels"] if camera.pixel_aspect != before.pixel_aspect else []
        text = f"{', '.join(given)} were added to the lens: images are predicted better, or not refused, with them"
        return replace(self, said=(*self.said, text)) if given else self

    def _free_spacings_and_pixels(self) -> "_Attempt | None":
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
        freed = replace(self, gathered=replace(self.gathered, sensor=sensor))._use_lens(camera)
        text = (
            f"the target's spacings are off by {' and '.join(f'{1e6 * value:+.0f}' for value in found)} µm/m along "
            "rows and columns, or the pixels' shape is not as described: both are estimated. To distinguish them, use "
            "placements of the target rotated by 90° against each other, or set `pixels` to square or free"
        )
        return None if freed is None else replace(freed, said=(*freed.said, text))

    def _use_lens(self, camera: CameraOptions) -> "_Attempt | None":
        """Solve with another lens; None if it is not determined, or the evidence contradicts the description."""
        try:
            richer = _Attempt.solve(self.gathered, replace(self.options, camera=camera), self.said)
        except CalibrationError:
            return None
        return None if richer.against.contradictions else richer

    def _add_error_of_model(self) -> "_Attempt | None":
        """Count all residuals of an image as one if images show systematic deviations, or their halves disagree.

        An incomplete model also biases lens and poses, so that kinds of residuals that fit well are affected too.
        Without images of a target, the model is that of an earlier calibration, which they then contradict.
        """
        if self.options.earlier is not None and not self.gathered.series:
            return None
        halves = [h for h in self.problem.linearise(self.result).compare_halves() if h.sigmas() > HALVES_APART]
        if not halves and not self.against.all_against():
            return None
        stated = self.problem.sensor
        sensor = stated.model_copy(update={"uncertainty": stated.uncertainty.scaled(self.against.enlarged)})
        problem = replace(
            self.problem, misfits=frozenset(self.result.noise), parameters=self.result.parameters, sensor=sensor
        )
        result, against = solve_and_check(problem)
        result = result.no_surer_than(self.result)
        factor = float(np.median(list(result.std().values()) / np.sqrt(np.diag(self.result.covariance))))
        texts = [each.words() for each in sorted(halves, key=HalfDifference.sigmas, reverse=True)[:_MOST_HALVES]]
        texts += [f"{text}; kept, as too many images are like this" for text in self.against.unfit.values()]
        texts += [*self.against.misfits.values(), *self.against.judged]
        texts.append(
            "images show systematic deviations from the model: all points of an image count as one, which makes "
            f"uncertainties {factor:.1f} times larger (median)"
        )
        against = replace(against, unfit={}, misfits={})
        return replace(self, problem=problem, result=result, against=against, said=(*self.said, *texts))


def _solve_first(gathered: Gathered, options: CalibrationOptions) -> _Attempt:
    """Solve for all images, or without those that contradict most others if these prevent a solution."""
    try:
        return _Attempt.solve(gathered, options)
    except CalibrationError as refusal:
        odd: dict[str, str] = {}
        for series in gathered.series:
            odd |= find_odd_images(series, gathered.sensor, options=options)
        kept = gathered.remove_images(odd) if odd and not options.strict else None
        if kept is None:
            raise CalibrationError("; ".join([str(refusal), *odd.values()])) from refusal
        return _Attempt.solve(kept, options, tuple(f"{text}; left out" for text in odd.values()))


# Changes of the problem, and how often each is made at most, in the order in which they change least of what was
# described. They return None if nothing calls for them.
_RULES: tuple[tuple[Callable[[_Attempt], _Attempt | None], int], ...] = (
    # Other coefficients or another pixel shape, if something is odd and the options leave the lens open.
    (_Attempt._try_lenses, 1),
    # Images that contradict all others are left out; what remains after three rounds has another cause.
    (_Attempt._drop_unfit, 3),
    # Images still show systematic deviations, or their halves disagree: all residuals of an image count as one.
    (_Attempt._add_error_of_model, 1),
)


def _score(result: Estimate) -> float:
    """Return the geometric mean of the scatter of target points and stripes, px."""
    return float(np.exp(np.mean(np.log([noise.sigma_px for noise in result.noise.values()]))))
