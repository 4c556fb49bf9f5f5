"""Compare sensor models by cross-validation, and select the simplest of the best."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import partial
from itertools import count
from pathlib import Path
from typing import Literal, TypeVar

import numpy as np

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
    predict,
    select_dimensions,
    split_images,
)
from uwlts.calibration.polynomial.polynomial_calibration_fit import fit_line_polynomials
from uwlts.calibration.polynomial.polynomial_evidence import common_header, object_coordinates, stripes_on_plate
from uwlts.calibration.sequential.sequential_calibration import CalibrationOptions
from uwlts.errors import CalibrationError, DescriptionError
from uwlts.model.brief import Brief
from uwlts.optics.window import require_index
from uwlts.runtime.progress import ProgressListener, ignore_progress
from uwlts.runtime.workers import Send, run_jobs
from uwlts.storage.capture import Capture, CaptureHeader, open_captures
from uwlts.stripe import StripeSettings

Level = TypeVar("Level")

Captures = Sequence[Capture | str | Path]


POINTS, STRIPES = "points", "stripes"
"""Point kinds: points of the target; stripe points on targets and steps."""

_DRAWS = 2000  # standard errors to 2 %


@dataclass(frozen=True)
class Score:
    """Root mean square (RMS) error of a model in the held-out images.

    ``px`` and ``mm`` are the errors in the image and on the object, for each point kind. ``all_mm`` covers both kinds.
    ``std_mm`` is its standard error (bootstrap over images).
    """

    px: dict[str, float]
    mm: dict[str, float]
    all_mm: float
    std_mm: float


@dataclass(frozen=True, eq=False)
class Tally:
    """Sums over the points in each held-out image, for C models and I images, without outliers.

    ``px`` and ``mm`` contain the sums of squared errors (C, I) for each point kind, ``counts`` the numbers of points
    (I,).
    """

    px: dict[str, np.ndarray]
    mm: dict[str, np.ndarray]
    counts: dict[str, np.ndarray]

    def score(self, model: int) -> Score:
        """Return the score of a model."""
        seen = [kind for kind in self.counts if self.counts[kind].any()]
        all_mm, std_mm = rms_of_images(self._all(model), self._number())
        return Score(
            px={kind: _rms(self.px[kind][model], self.counts[kind]) for kind in seen},
            mm={kind: _rms(self.mm[kind][model], self.counts[kind]) for kind in seen},
            all_mm=all_mm,
            std_mm=std_mm,
        )

    def compute_excess(self, model: int, other: int) -> tuple[float, float]:
        """Return a model's mean squared error minus another's, and the standard error of this difference, mm2."""
        difference, draws = self._all(model) - self._all(other), _draws(len(self._number()))
        drawn = draws @ difference / (draws @ self._number())
        return float(difference.sum() / self._number().sum()), float(drawn.std(ddof=1))

    def as_good(self, model: int, other: int) -> bool:
        """Return whether a model is no worse than another, within the standard error of their difference."""
        difference, std = self.compute_excess(model, other)
        return difference <= std

    def _all(self, model: int) -> np.ndarray:
        return np.sum([squares[model] for squares in self.mm.values()], axis=0)

    def _number(self) -> np.ndarray:
        return np.sum(list(self.counts.values()), axis=0)


def sum_errors(predictions: Sequence[Prediction], *, among: frozenset[Image] | None = None) -> Tally:
    """Sum the errors of several predictions of the same images; ``among`` selects images."""
    used, first = _mask_inliers(predictions), predictions[0].misses
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


def _mask_inliers(predictions: Sequence[Prediction]) -> list[np.ndarray]:
    """Return a mask (n,) for each set of errors; it excludes points that are outliers for every model."""
    limits = {
        kind: min(outlier_limit(np.concatenate([m.px for m in p.misses if m.kind == kind])) for p in predictions)
        for kind in {miss.kind for miss in predictions[0].misses}
    }
    each = zip(*(p.misses for p in predictions), strict=True)
    return [np.min([miss.px for miss in same], axis=0) <= limits[same[0].kind] for same in each]


def rms_of_images(squares: np.ndarray, counts: np.ndarray) -> tuple[float, float]:
    """Return the RMS over all images, from sums of squares (I,) and counts (I,), and its standard error."""
    draws = _draws(len(counts))
    return _rms(squares, counts), float(np.sqrt(draws @ squares / (draws @ counts)).std(ddof=1))


def _draws(images: int) -> np.ndarray:
    """Return how often each image is drawn in each bootstrap sample (B, I); the samples are always the same."""
    return np.random.default_rng(0).multinomial(images, np.full(images, 1 / images), size=_DRAWS)


def _rms(squares: np.ndarray, counts: np.ndarray) -> float:
    return float(np.sqrt(squares.sum() / counts.sum()))


DEGREE = 6  # degree of the polynomials (thesis, section 4.7)


@dataclass(frozen=True)
class PolynomialScore:
    """RMS error of polynomial calibration for stripes on the target, inside the calibrated volume, mm.

    Polynomials lack a camera model and do not extrapolate: errors in px or outside the volume do not exist. ``all_mm``
    and ``std_mm`` are the polynomials' error and its standard error. ``model_mm`` and ``model_std_mm`` are those of the
    compared model in the same images.
    """

    medium: str
    images: int
    all_mm: float
    std_mm: float
    model_mm: float
    model_std_mm: float


def score_polynomials(
    series: Series, header: CaptureHeader, images: Sequence[Image], model: Prediction
) -> PolynomialScore | None:
    """Return the score of polynomials in the held-out images of a series, or None without such an image.

    Raises CalibrationError if polynomials cannot be fitted to the series.
    """
    if not images:
        return None
    stripes, _, _ = stripes_on_plate(series.found, header, DEGREE)
    depth_mm, _ = object_coordinates(stripes, header)
    held = np.isin(stripes.pose, [image for _, image in images])
    fit = fit_line_polynomials(stripes.lines[~held], stripes.centres_px[~held], depth_mm[~held], degree=DEGREE)
    off, pose = fit.evaluate(stripes.lines[held], stripes.centres_px[held]) - depth_mm[held], stripes.pose[held]
    off, pose = off[np.isfinite(off)], pose[np.isfinite(off)]
    by_model = [m.mm for m in model.misses if m.image in images and m.kind == STRIPE]
    own = _robust_rms([off[pose == image] for image in np.unique(pose)])
    return PolynomialScore(header.medium_name, len(images), *own, *_robust_rms(by_model))


def _robust_rms(misses: Sequence[np.ndarray]) -> tuple[float, float]:
    """Return the RMS of the errors in several images, without outliers, and its standard error."""
    limit = outlier_limit(np.concatenate(misses))
    kept = [off[np.abs(off) <= limit] for off in misses]
    squares, counts = np.array([np.sum(off**2) for off in kept]), np.array([len(off) for off in kept])
    return rms_of_images(squares, counts)


@dataclass(frozen=True, eq=False)
class ScoredModel:
    """Model with its score for each split, or the reason for a missing score."""

    candidate: Candidate
    parameters: int | None
    scores: dict[str, Score]
    reason: str = ""


@dataclass(frozen=True, eq=False)
class Choice:
    """All models, the usual one first, with their predictions and scores.

    ``ways`` maps each split to its held-out images. ``predictions`` contains only models with scores, and the models in
    ``tallies`` have the same order. ``wet`` is the number of held-out images in a medium. ``wet_tallies`` covers only
    these images, and is empty if they are too few.
    """

    judged: list[ScoredModel]
    splits: dict[str, frozenset[Image]]
    predictions: dict[Candidate, dict[str, Prediction]]
    tallies: dict[str, Tally]
    wet: dict[str, int]
    wet_tallies: dict[str, Tally]

    def best(self) -> Candidate:
        """Return the model with the smallest mean squared error, summed over the splits."""
        return self._good_among()[0].candidate

    def list_equivalent(self) -> list[Candidate]:
        """Return the models that are no worse than the best in any split, within chance."""
        return [each.candidate for each in self._good_among()[1]]

    def simplest(self, among: Sequence[Candidate] | None = None) -> Candidate:
        """Return the model with the fewest parameters of those as good as the best; ``among`` restricts the models."""
        return min(self._good_among(among)[1], key=lambda each: each.parameters or 0).candidate

    def level(self, name: str, levels: Sequence[Level]) -> Level:
        """Return the simplest value of a model property that predicts as well as the best value."""
        return getattr(self.simplest([replace(Candidate(), **{name: value}) for value in levels]), name)

    def number(self, candidate: Candidate) -> int:
        """Return the number of a model among those with scores."""
        return list(self.predictions).index(candidate)

    def predicts_as_well(self, candidate: Candidate, other: Candidate, where: str, *, wet: bool = False) -> bool:
        """Return whether a model predicts as well as another in a split; ``wet`` restricts it to images in a medium.

        Held-out images can share errors of the stage and of poses, which favour one model by more than chance. A model
        with fewer free parameters therefore also counts as good if the other's estimate of the additional parameters
        does not differ significantly from the fixed values.
        """
        separate = self.predictions[other][INSIDE].separates_from(self.predictions[candidate][INSIDE])
        tallies = self.wet_tallies if wet else self.tallies
        return not separate or tallies[where].as_good(self.number(candidate), self.number(other))

    def _good_among(self, among: Sequence[Candidate] | None = None) -> tuple[ScoredModel, list[ScoredModel]]:
        """Return the best model and all models as good as it in every split; ``among`` restricts the models."""
        able = [each for each in self.judged if each.scores and (among is None or each.candidate in among)]
        best = min(able, key=lambda each: sum(score.all_mm**2 for score in each.scores.values()))
        good = [
            e for e in able if all(self.predicts_as_well(e.candidate, best.candidate, where) for where in self.splits)
        ]
        return best, good


Found = dict[Candidate, dict[str, Prediction] | str]
"""For each model its predictions for each split, or the reason for their absence."""


def choose(
    problem: JointProblem, *, workers: int | None = None, progress: ProgressListener = ignore_progress
) -> Choice:
    """Compare the usual model, models that differ from it by one property, and the simplest sufficient one.

    Raises CalibrationError if there are too few images, or the usual model cannot be calibrated without the held-out
    images.
    """
    ways, usual, done = split_images(problem), Candidate(), count(1)
    dimensions = select_dimensions(problem.parameters)
    singles = [usual, *(replace(usual, **{name: other}) for name, others in dimensions.items() for other in others)]
    total = len(ways) * (len(singles) + 1)

    def predicted(candidates: Sequence[Candidate]) -> Found:
        jobs = [(problem, candidate, held) for candidate in candidates for held in ways.values()]
        results = run_jobs(_work, jobs, workers=workers, on_message=lambda _: progress(next(done), total))
        found: Found = {}
        for place, candidate in enumerate(candidates):
            own = results[place * len(ways) : (place + 1) * len(ways)]
            by_way = {where: each for where, each in zip(ways, own, strict=True) if not isinstance(each, str)}
            found[candidate] = next((each for each in own if isinstance(each, str)), by_way)
        return found

    in_medium = frozenset(number for number, each in enumerate(problem.evidence) if each.view.medium is not None)
    found = predicted(singles)
    if isinstance(found[usual], str):
        raise CalibrationError(f"the usual model cannot be calibrated without the held-out images: {found[usual]}")
    first = build_choice(found, ways, in_medium)
    needed = {name: first.level(name, [getattr(usual, name), *others]) for name, others in dimensions.items()}
    simple = replace(usual, **needed)
    if simple not in found:
        found |= predicted([simple])
    progress(total, total)
    return build_choice(found, ways, in_medium)


def _work(job: tuple[JointProblem, Candidate, frozenset[Image]], send: Send) -> Prediction | str:
    try:
        return predict(*job)
    except CalibrationError as error:
        return str(error)
    finally:
        send(None)


def build_choice(found: Found, ways: dict[str, frozenset[Image]], in_medium: frozenset[int]) -> Choice:
    """Score and compare models from their predictions, or the reasons for missing ones.

    ``in_medium`` contains the numbers of the pieces of evidence in a medium.
    """
    predictions = {candidate: result for candidate, result in found.items() if not isinstance(result, str)}
    tallies = {where: sum_errors([each[where] for each in predictions.values()]) for where in ways}
    judged, number = [], count()
    for candidate, result in found.items():
        if isinstance(result, str):
            judged.append(ScoredModel(candidate, None, {}, result))
        else:
            place = next(number)
            scores = {where: each.score(place) for where, each in tallies.items()}
            judged.append(ScoredModel(candidate, len(result[INSIDE].parameters.keys), scores))
    wet = {where: frozenset(image for image in held if image[0] in in_medium) for where, held in ways.items()}
    wet_tallies: dict[str, Tally] = {}
    if min(map(len, wet.values())) >= FEWEST_HELD:
        wet_tallies = {w: sum_errors([each[w] for each in predictions.values()], among=wet[w]) for w in ways}
    return Choice(judged, ways, predictions, tallies, {where: len(held) for where, held in wet.items()}, wet_tallies)


@dataclass(frozen=True, eq=False, repr=False)
class Comparison(Brief):
    """Comparison of sensor models by their errors in held-out images.

    ``polynomials`` is None without a stage-moved target in a medium; ``why_none`` is the reason.
    """

    sensor: str
    captures: list[str]
    choice: Choice
    polynomials: PolynomialScore | None
    why_none: str
    warnings: list[str]


def compare_models(
    *,
    air: Captures = (),
    water: Captures = (),
    step: Captures = (),
    target_poses: Literal["stage", "free"] = "stage",
    index: float | None = None,
    stripe: StripeSettings = None,
    workers: int | None = None,
    progress: ProgressListener = ignore_progress,
) -> Comparison:
    """Compare sensor models; arguments and errors as for `uwlts.report.write_models`."""
    if index is not None:
        require_index(index)
    if workers is not None and workers < 1:
        raise DescriptionError(f"workers is {workers}; it must be at least 1")
    if not (air or water):
        raise DescriptionError("no captures of a target to compare models with: give `air` or `water`")
    options = CalibrationOptions(poses=target_poses, medium_index=index, stripe=stripe)
    with open_captures([*air, *water]) as targets, open_captures(step) as steps:
        gathered = gather_jointly(targets, steps, options=options, progress=progress)
        problem = joint_problem(gathered, options=options)
        choice = choose(problem, workers=workers, progress=partial(progress, stage="models"))
        score, why_none = _score_polynomials(gathered, problem, choice, targets, free=target_poses == "free")
        captures = [capture.path.name for capture in [*targets, *steps]]
    return Comparison(gathered.sensor.name, captures, choice, score, why_none, problem.warnings)


def _score_polynomials(
    gathered: Gathered, problem: JointProblem, choice: Choice, targets: Sequence[Capture], *, free: bool
) -> tuple[PolynomialScore | None, str]:
    """Score polynomials on a stage-moved target in a medium, or return the reason why this is not possible."""
    wet = [part for part in gathered.series if part.view.medium is not None]
    if not wet or free:
        return None, "polynomials need a target in the medium of use that is moved by the stage"
    part = wet[0]
    alike = [n for n, e in enumerate(problem.evidence) if isinstance(e, TargetEvidence) and e.view == part.view]
    images = [image for image in choice.splits[INSIDE] if image[0] in alike]
    try:
        header = common_header([c for c in targets if c.path.name in part.names and c.header.medium.kind != "air"])
        return score_polynomials(part, header, images, choice.predictions[choice.simplest()][INSIDE]), ""
    except CalibrationError as error:
        return None, f"no polynomials: {error}"
