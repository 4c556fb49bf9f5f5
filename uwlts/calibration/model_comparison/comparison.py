"""Comparison of models of the sensor: each is calibrated and scored, and the simplest that is as good is found."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import partial
from itertools import count
from pathlib import Path
from typing import Literal, TypeVar

import numpy as np
from numpy.polynomial import legendre

from uwlts.calibration.joint.estimate import outlier_limit
from uwlts.calibration.joint.gathering import Gathered, Series, gather_jointly
from uwlts.calibration.joint.procedure import JointProblem, joint_problem
from uwlts.calibration.joint.residuals import STRIPE, TARGET, TargetEvidence
from uwlts.calibration.model_comparison.held_out import (
    FEWEST_HELD,
    INSIDE,
    Candidate,
    Image,
    Prediction,
    dimensions_of,
    predict,
    splits,
)
from uwlts.calibration.polynomial.polynomial_calibration_fit import fit_line_polynomials
from uwlts.calibration.polynomial.polynomial_evidence import common_header, object_coordinates, stripes_on_plate
from uwlts.calibration.sequential.sequential_calibration import CalibrationOptions
from uwlts.errors import CalibrationError, DescriptionError
from uwlts.model.brief import Brief
from uwlts.optics.window import require_index
from uwlts.runtime.progress import ProgressListener, unheard
from uwlts.runtime.workers import Send, work_through
from uwlts.storage.capture import Capture, CaptureHeader, opened_captures
from uwlts.stripe import StripeSettings

Level = TypeVar("Level")

_Captures = Sequence[Capture | str | Path]


POINTS, STRIPES = "points", "stripes"
"""The target's points; stripes on target and steps."""

_DRAWS = 2000  # standard errors to 2 %


@dataclass(frozen=True)
class Score:
    """Root mean square miss of a model in the images held out in one way.

    ``px`` are those of the target's points and of the stripes, ``mm`` the same on the object, ``all_mm`` of both
    together, ``std_mm`` its standard error, by drawing the images anew.
    """

    px: dict[str, float]
    mm: dict[str, float]
    all_mm: float
    std_mm: float


@dataclass(frozen=True, eq=False)
class Tally:
    """Sums over the points of each image held out, for C models and I images; outliers do not count.

    ``px`` and ``mm`` are squares (C, I) of misses, of points and of stripes, ``counts`` numbers (I,) of points.
    """

    px: dict[str, np.ndarray]
    mm: dict[str, np.ndarray]
    counts: dict[str, np.ndarray]

    def score(self, model: int) -> Score:
        """Score of a model."""
        seen = [kind for kind in self.counts if self.counts[kind].any()]
        all_mm, std_mm = rms_of_images(self._all(model), self._number())
        return Score(
            px={kind: _rms(self.px[kind][model], self.counts[kind]) for kind in seen},
            mm={kind: _rms(self.mm[kind][model], self.counts[kind]) for kind in seen},
            all_mm=all_mm,
            std_mm=std_mm,
        )

    def beyond(self, model: int, other: int) -> tuple[float, float]:
        """By how much a model's mean square in mm2 is above another's, image by image, and its standard error."""
        difference, draws = self._all(model) - self._all(other), _draws(len(self._number()))
        drawn = draws @ difference / (draws @ self._number())
        return float(difference.sum() / self._number().sum()), float(drawn.std(ddof=1))

    def as_good(self, model: int, other: int) -> bool:
        """Whether a model is no worse than another, within the standard error of their difference."""
        difference, std = self.beyond(model, other)
        return difference <= std

    def _all(self, model: int) -> np.ndarray:
        return np.sum([squares[model] for squares in self.mm.values()], axis=0)

    def _number(self) -> np.ndarray:
        return np.sum(list(self.counts.values()), axis=0)


def tally(predictions: Sequence[Prediction], *, among: frozenset[Image] | None = None) -> Tally:
    """The sums of several predictions of the same images, of all or only some of these."""
    used, first = _used(predictions), predictions[0].misses
    images = sorted({miss.image for miss in first if among is None or miss.image in among})
    shape = len(predictions), len(images)
    sums = {what: {kind: np.zeros(shape) for kind in (POINTS, STRIPES)} for what in ("px", "mm")}
    counts = {kind: np.zeros(len(images)) for kind in (POINTS, STRIPES)}
    for place, miss in enumerate(first):
        if miss.image not in images:
            continue
        kind, image = POINTS if miss.kind == TARGET else STRIPES, images.index(miss.image)
        counts[kind][image] += used[place].sum()
        for model, prediction in enumerate(predictions):
            for what, squares in sums.items():
                squares[kind][model, image] += np.sum(getattr(prediction.misses[place], what)[used[place]] ** 2)
    return Tally(sums["px"], sums["mm"], counts)


def _used(predictions: Sequence[Prediction]) -> list[np.ndarray]:
    """Masks (n,) of the points that count in each of the misses: not those that all models miss by far."""
    limits = {
        kind: min(outlier_limit(np.concatenate([m.px for m in p.misses if m.kind == kind])) for p in predictions)
        for kind in {miss.kind for miss in predictions[0].misses}
    }
    each = zip(*(p.misses for p in predictions), strict=True)
    return [np.min([miss.px for miss in same], axis=0) <= limits[same[0].kind] for same in each]


def rms_of_images(squares: np.ndarray, counts: np.ndarray) -> tuple[float, float]:
    """Root of the mean square over all images, from sums of squares (I,) and counts (I,), and its standard error."""
    draws = _draws(len(counts))
    return _rms(squares, counts), float(np.sqrt(draws @ squares / (draws @ counts)).std(ddof=1))


def _draws(images: int) -> np.ndarray:
    """Numbers (B, I) of times that each image is drawn; the same draws for all."""
    return np.random.default_rng(0).multinomial(images, np.full(images, 1 / images), size=_DRAWS)


def _rms(squares: np.ndarray, counts: np.ndarray) -> float:
    return float(np.sqrt(squares.sum() / counts.sum()))


DEGREE = 6  # of the polynomials (thesis, section 4.7)


@dataclass(frozen=True)
class PolynomialScore:
    """Root mean square misses in mm of stripes on the target, inside the calibrated volume.

    Polynomials have no camera, so that they are judged on the object only; outside they do not measure. ``all_mm`` and
    ``std_mm`` are by polynomials, with the standard error, ``model_mm`` and ``model_std_mm`` in the same images by the
    model they are compared with.
    """

    medium: str
    images: int
    all_mm: float
    std_mm: float
    model_mm: float
    model_std_mm: float


def polynomial_score(
    series: Series, header: CaptureHeader, images: Sequence[Image], model: Prediction
) -> PolynomialScore | None:
    """Score of polynomials in the images of a series that are held out; None where there is no such image.

    Raises CalibrationError: the series is not fit for polynomials.
    """
    if not images:
        return None
    stripes, _, _ = stripes_on_plate(series.found, header, DEGREE)
    depth_mm, _ = object_coordinates(stripes, header)
    held = np.isin(stripes.pose, [image for _, image in images])
    fit = fit_line_polynomials(stripes.lines[~held], stripes.centres_px[~held], depth_mm[~held], degree=DEGREE)
    low, high = fit.range
    rows, x = stripes.lines[held] - fit.first_line, stripes.centres_px[held]
    known = (rows >= 0) & (rows < len(fit.coefficients)) & (x >= low) & (x <= high)
    argument = (2 * x[known] - low - high) / (high - low)
    found = legendre.legval(argument, fit.coefficients[rows[known]].T, tensor=False)
    off, pose = found - depth_mm[held][known], stripes.pose[held][known]
    by_model = [m.mm for m in model.misses if m.image in images and m.kind == STRIPE]
    own = _robust_rms([off[pose == image] for image in np.unique(pose)])
    return PolynomialScore(header.medium_name, len(images), *own, *_robust_rms(by_model))


def _robust_rms(misses: Sequence[np.ndarray]) -> tuple[float, float]:
    """Root mean square of the misses in several images, without outliers, and its standard error."""
    limit = outlier_limit(np.concatenate(misses))
    kept = [off[np.abs(off) <= limit] for off in misses]
    squares, counts = np.array([np.sum(off**2) for off in kept]), np.array([len(off) for off in kept])
    return rms_of_images(squares, counts)


@dataclass(frozen=True, eq=False)
class JudgedModel:
    """A model with its score for each way of holding out, or the reason why it has none."""

    candidate: Candidate
    parameters: int | None
    scores: dict[str, Score]
    reason: str = ""


@dataclass(frozen=True, eq=False)
class Choice:
    """The models, the usual one first, and what their scores say.

    ``ways`` are the images held out, by the name of the way; ``predictions`` those of the models that have scores, by
    the way; ``tallies`` belong to each way, of those models in their order. ``wet`` are the numbers of images held out
    that were seen in a medium; ``wet_tallies`` are of these alone, none where they are too few.
    """

    judged: list[JudgedModel]
    ways: dict[str, frozenset[Image]]
    predictions: dict[Candidate, dict[str, Prediction]]
    tallies: dict[str, Tally]
    wet: dict[str, int]
    wet_tallies: dict[str, Tally]

    def best(self) -> Candidate:
        """The model of the smallest mean square miss, both ways of holding out counting alike."""
        return self._good_among()[0].candidate

    def as_good(self) -> list[Candidate]:
        """Those that are no worse than the best in either way, but for chance."""
        return [each.candidate for each in self._good_among()[1]]

    def simplest(self, among: Sequence[Candidate] | None = None) -> Candidate:
        """Of all models or some, of those as good as the best that with the fewest parameters."""
        return min(self._good_among(among)[1], key=lambda each: each.parameters or 0).candidate

    def level(self, name: str, levels: Sequence[Level]) -> Level:
        """Of the ways in which one thing can be modelled, the simplest that is as good as the best of them."""
        return getattr(self.simplest([replace(Candidate(), **{name: value}) for value in levels]), name)

    def number(self, candidate: Candidate) -> int:
        """Number of a model among those that have scores."""
        return list(self.predictions).index(candidate)

    def no_worse(self, candidate: Candidate, other: Candidate, where: str, *, wet: bool = False) -> bool:
        """Whether a model predicts as well as another in one way of holding out, in all images or those in a medium.

        Where images held out differ by more than chance, all may yet share errors of the stage and of poses that favour
        one model. So a model that holds parameters of the other also counts as good if the other's estimate cannot
        separate these from what is held.
        """
        separate = self.predictions[other][INSIDE].separates_from(self.predictions[candidate][INSIDE])
        tallies = self.wet_tallies if wet else self.tallies
        return not separate or tallies[where].as_good(self.number(candidate), self.number(other))

    def _good_among(self, among: Sequence[Candidate] | None = None) -> tuple[JudgedModel, list[JudgedModel]]:
        """Of all models or some the best, and those that are as good in both ways."""
        able = [each for each in self.judged if each.scores and (among is None or each.candidate in among)]
        best = min(able, key=lambda each: sum(score.all_mm**2 for score in each.scores.values()))
        good = [e for e in able if all(self.no_worse(e.candidate, best.candidate, where) for where in self.ways)]
        return best, good


Found = dict[Candidate, dict[str, Prediction] | str]
"""For each model its predictions by the way of holding out, or why there are none."""


def choose(problem: JointProblem, *, workers: int | None = None, progress: ProgressListener = unheard) -> Choice:
    """Compare models on the evidence of a joint problem: the usual one, what differs by one thing, and the simplest.

    Raises CalibrationError: there are too few images, or the usual model cannot be calibrated without those held out.
    """
    ways, usual, done = splits(problem), Candidate(), count(1)
    dimensions = dimensions_of(problem.parameters)
    singles = [usual, *(replace(usual, **{name: other}) for name, others in dimensions.items() for other in others)]
    total = len(ways) * (len(singles) + 1)

    def predicted(candidates: Sequence[Candidate]) -> Found:
        jobs = [(problem, candidate, held) for candidate in candidates for held in ways.values()]
        results = work_through(_work, jobs, workers=workers, on_message=lambda _: progress(next(done), total))
        found: Found = {}
        for place, candidate in enumerate(candidates):
            own = results[place * len(ways) : (place + 1) * len(ways)]
            by_way = {where: each for where, each in zip(ways, own, strict=True) if not isinstance(each, str)}
            found[candidate] = next((each for each in own if isinstance(each, str)), by_way)
        return found

    in_medium = frozenset(number for number, each in enumerate(problem.evidence) if each.view.medium is not None)
    found = predicted(singles)
    if isinstance(found[usual], str):
        raise CalibrationError(f"without the images held out there is no calibration: {found[usual]}")
    first = choice_of(found, ways, in_medium)
    needed = {name: first.level(name, [getattr(usual, name), *others]) for name, others in dimensions.items()}
    simple = replace(usual, **needed)
    if simple not in found:
        found |= predicted([simple])
    progress(total, total)
    return choice_of(found, ways, in_medium)


def _work(job: tuple[JointProblem, Candidate, frozenset[Image]], send: Send) -> Prediction | str:
    try:
        return predict(*job)
    except CalibrationError as error:
        return str(error)
    finally:
        send(None)


def choice_of(found: Found, ways: dict[str, frozenset[Image]], in_medium: frozenset[int]) -> Choice:
    """The choice among models by what each predicts in both ways, or the reason why it does not.

    ``in_medium`` are the numbers of the pieces of evidence that were seen in a medium.
    """
    predictions = {candidate: result for candidate, result in found.items() if not isinstance(result, str)}
    tallies = {where: tally([each[where] for each in predictions.values()]) for where in ways}
    judged, number = [], count()
    for candidate, result in found.items():
        if isinstance(result, str):
            judged.append(JudgedModel(candidate, None, {}, result))
        else:
            place = next(number)
            scores = {where: each.score(place) for where, each in tallies.items()}
            judged.append(JudgedModel(candidate, len(result[INSIDE].parameters.keys), scores))
    wet = {where: frozenset(image for image in held if image[0] in in_medium) for where, held in ways.items()}
    wet_tallies: dict[str, Tally] = {}
    if min(map(len, wet.values())) >= FEWEST_HELD:
        wet_tallies = {w: tally([each[w] for each in predictions.values()], among=wet[w]) for w in ways}
    return Choice(judged, ways, predictions, tallies, {where: len(held) for where, held in wet.items()}, wet_tallies)


@dataclass(frozen=True, eq=False, repr=False)
class Comparison(Brief):
    """Misses of models in images held out, with the sensor and the captures.

    ``polynomials`` is None without a target in a medium on the stage; ``why_none`` is why they have no score.
    """

    sensor: str
    captures: list[str]
    choice: Choice
    polynomials: PolynomialScore | None
    why_none: str
    warnings: list[str]


def compare_models(
    *,
    air: _Captures = (),
    water: _Captures = (),
    step: _Captures = (),
    poses: Literal["stage", "free"] = "stage",
    index: float | None = None,
    stripe: StripeSettings = None,
    workers: int | None = None,
    progress: ProgressListener = unheard,
) -> Comparison:
    """Compare models of the sensor by how well each predicts images that its calibration has not seen.

    One refraction or two, window tilted or not, sheet with bow or turned by the laser's window or not, distortion:
    each model is calibrated without every fourth image, and without the nearest and the farthest ones.

    Parameters
    ----------
    air : sequence of Capture or path
        Captures of the target in air, as for uwlts calibrate.
    water : sequence of Capture or path
        The same in the medium of use.
    step : sequence of Capture or path
        Captures of the step standard in the medium of use.
    poses : {"stage", "free"}
        stage: one pose of the target for each capture, moved by the stage. free: every image has a pose of its own.
    index : float, optional
        Refractive index of the medium relative to air, in place of the one that follows from the captures.
    stripe : StripeOptions or dict, optional
        As for `reconstruct`.
    workers : int, optional
        Models calibrated at a time; as many as there are processors unless given.
    progress : callable, optional
        Called with the number of images or models done, the number in all, and the name of the stage.

    Raises
    ------
    CalibrationError
        There are too few images, or they do not determine a calibration.
    DescriptionError
        There is no capture of a target, one does not describe its target or its step standard, or ``workers`` is less
        than 1.
    CaptureError
        A file is missing or damaged.
    RangeError
        The refractive index is not that of a medium.
    """
    if index is not None:
        require_index(index)
    if workers is not None and workers < 1:
        raise DescriptionError(f"workers is {workers}; it must be at least 1")
    if not (air or water):
        raise DescriptionError("nothing to compare models by: give `air` or `water` with captures of a target")
    options = CalibrationOptions(poses=poses, medium_index=index, stripe=stripe)
    with opened_captures([*air, *water]) as targets, opened_captures(step) as steps:
        gathered = gather_jointly(targets, steps, options=options, progress=progress)
        problem = joint_problem(gathered, options=options)
        choice = choose(problem, workers=workers, progress=partial(progress, stage="models"))
        score, why_none = _polynomials(gathered, problem, choice, targets, free=poses == "free")
        captures = [capture.path.name for capture in [*targets, *steps]]
    return Comparison(gathered.sensor.name, captures, choice, score, why_none, problem.warnings)


def _polynomials(
    gathered: Gathered, problem: JointProblem, choice: Choice, targets: Sequence[Capture], *, free: bool
) -> tuple[PolynomialScore | None, str]:
    """Score of polynomials where a target on the stage was seen in a medium, or why there is none."""
    wet = [part for part in gathered.series if part.view.medium is not None]
    if not wet or free:
        return None, "polynomials need a target in the medium of use that the stage moves"
    part = wet[0]
    alike = [n for n, e in enumerate(problem.evidence) if isinstance(e, TargetEvidence) and e.view == part.view]
    images = [image for image in choice.ways[INSIDE] if image[0] in alike]
    try:
        header = common_header([c for c in targets if c.path.name in part.names and c.header.medium.kind != "air"])
        return polynomial_score(part, header, images, choice.predictions[choice.simplest()][INSIDE]), ""
    except CalibrationError as error:
        return None, f"no polynomials: {error}"
