"""Comparison of models of the sensor: each is calibrated and scored, and the simplest that is as good is found."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Literal, TypeVar

from uwlts.calibration.evidence import Progress as Searched
from uwlts.calibration.joint.evidence import TargetEvidence
from uwlts.calibration.joint.gathering import Gathered, gather_jointly
from uwlts.calibration.joint.procedure import JointProblem, joint_problem
from uwlts.calibration.model_comparison.candidates import Candidate, dimensions_of
from uwlts.calibration.model_comparison.held_out import INSIDE, Prediction, Split, predict, splits
from uwlts.calibration.model_comparison.scores import PolynomialScore, Score, Tally, polynomial_score, tally
from uwlts.calibration.polynomial_evidence import common_header
from uwlts.calibration.sequential import CalibrationOptions
from uwlts.model.errors import CalibrationError, DescriptionError
from uwlts.optics.window import require_index
from uwlts.runtime.workers import Send, work_through
from uwlts.storage.capture import Capture, opened_captures
from uwlts.stripe import StripeOptions

Level = TypeVar("Level")

Progress = Callable[[int, int], None]
_Captures = Sequence[Capture | str | Path]


@dataclass(frozen=True, eq=False)
class Judged:
    """A model with its score for each way of holding out, or the reason why it has none."""

    candidate: Candidate
    parameters: int | None
    scores: dict[str, Score]
    reason: str = ""


@dataclass(frozen=True, eq=False)
class Choice:
    """The models, the usual one first, and what their scores say.

    Attributes
    ----------
    ways : `Split` by its name
    predictions : of the models that have scores, by the way of holding out
    tallies : for each way of holding out, of those models in their order
    """

    judged: list[Judged]
    ways: dict[str, Split]
    predictions: dict[Candidate, dict[str, Prediction]]
    tallies: dict[str, Tally]

    def best(self) -> Candidate:
        """The model of the smallest mean square miss, both ways of holding out counting alike."""
        return self.good_among(self._able())[0].candidate

    def as_good(self) -> list[Candidate]:
        """Those that are no worse than the best in either way, but for chance."""
        return [each.candidate for each in self.good_among(self._able())[1]]

    def simplest(self) -> Candidate:
        """Of these that with the fewest parameters."""
        return min(self.good_among(self._able())[1], key=self._size).candidate

    def _able(self) -> list[Judged]:
        return [each for each in self.judged if each.scores]

    def _size(self, judged: Judged) -> int:
        return len(self.predictions[judged.candidate][INSIDE].parameters.keys)

    def number(self, candidate: Candidate) -> int:
        """Number of a model among those that have scores."""
        return list(self.predictions).index(candidate)

    def no_worse(self, candidate: Candidate, other: Candidate, where: str) -> bool:
        """Whether a model predicts as well as another in one way of holding out.

        Where images held out differ by more than chance, all may yet share errors of the stage and of poses that favour
        one model. So a model that holds parameters of the other also counts as good if the other's estimate cannot
        separate these from what is held.
        """
        separate = self.predictions[other][INSIDE].separates_from(self.predictions[candidate][INSIDE])
        return not separate or self.tallies[where].as_good(self.number(candidate), self.number(other))

    def good_among(self, judged: Sequence[Judged]) -> tuple[Judged, list[Judged]]:
        """Of some models the best, and those that are as good in both ways."""
        best = min(judged, key=lambda each: sum(score.all_mm**2 for score in each.scores.values()))
        good = [e for e in judged if all(self.no_worse(e.candidate, best.candidate, where) for where in self.ways)]
        return best, good

    def level(self, name: str, levels: Sequence[Level]) -> Level:
        """Of the ways in which one thing can be modelled, the simplest that is as good as the best of them."""
        alternatives = [replace(Candidate(), **{name: value}) for value in levels]
        _, good = self.good_among([e for e in self.judged if e.scores and e.candidate in alternatives])
        return getattr(min(good, key=self._size).candidate, name)


def choose(
    problem: JointProblem, *, workers: int | None = None, progress: Progress = lambda done, total: None
) -> Choice:
    """Compare models on the evidence of a joint problem: the usual one, what differs by one thing, and the simplest.

    Raises CalibrationError: there are too few images, or the usual model cannot be calibrated without those held out.
    """
    ways, usual = splits(problem), Candidate()
    dimensions = dimensions_of(problem.parameters)
    singles = [usual, *(replace(usual, **{name: other}) for name, others in dimensions.items() for other in others)]
    total = len(ways) * (len(singles) + 1)
    found = _predicted(problem, singles, ways, workers=workers, progress=lambda done: progress(done, total))
    if isinstance(found[usual], str):
        raise CalibrationError(f"without the images held out there is no calibration: {found[usual]}")
    first = choice_of(found, ways)
    needed = {name: first.level(name, [getattr(usual, name), *others]) for name, others in dimensions.items()}
    simple, before = replace(usual, **needed), len(ways) * len(singles)
    if simple not in found:
        found |= _predicted(
            problem, [simple], ways, workers=workers, progress=lambda done: progress(before + done, total)
        )
    progress(total, total)
    return choice_of(found, ways)


def _predicted(
    problem: JointProblem,
    candidates: Sequence[Candidate],
    ways: Sequence[Split],
    *,
    workers: int | None,
    progress: Callable[[int], None],
) -> dict[Candidate, dict[str, Prediction] | str]:
    """For each model its predictions by the way of holding out, or why there are none."""
    done = 0

    def on_message(message: object) -> None:
        nonlocal done
        done += 1
        progress(done)

    jobs = [(problem, candidate, way) for candidate in candidates for way in ways]
    results = work_through(_work, jobs, workers=workers, on_message=on_message)
    found: dict[Candidate, dict[str, Prediction] | str] = {}
    for place, candidate in enumerate(candidates):
        own = results[place * len(ways) : (place + 1) * len(ways)]
        reasons = [each for each in own if isinstance(each, str)]
        predicted = {way.where: each for way, each in zip(ways, own, strict=True) if not isinstance(each, str)}
        found[candidate] = reasons[0] if reasons else predicted
    return found


def _work(job: tuple[JointProblem, Candidate, Split], send: Send) -> Prediction | str:
    try:
        return predict(*job)
    except CalibrationError as error:
        return str(error)
    finally:
        send(None)


def choice_of(found: dict[Candidate, dict[str, Prediction] | str], ways: Sequence[Split]) -> Choice:
    """The choice among models by what each predicts in both ways, or the reason why it does not."""
    predictions = {candidate: result for candidate, result in found.items() if not isinstance(result, str)}
    tallies = {way.where: tally([each[way.where] for each in predictions.values()]) for way in ways}
    judged = []
    for candidate, result in found.items():
        if isinstance(result, str):
            judged.append(Judged(candidate, None, {}, result))
        else:
            number = list(predictions).index(candidate)
            scores = {where: each.score(number) for where, each in tallies.items()}
            judged.append(Judged(candidate, len(result[INSIDE].parameters.keys), scores))
    return Choice(judged, {way.where: way for way in ways}, predictions, tallies)


@dataclass(frozen=True, eq=False)
class Comparison:
    """What models miss in images held out, of which sensor and which captures.

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
    stripe: StripeOptions = StripeOptions(),
    workers: int | None = None,
    progress: Searched = lambda stage, done, total: None,
) -> Comparison:
    """Compare models of the sensor by how well each predicts images that its calibration has not seen.

    Parameters
    ----------
    air, water, step : sequence of Capture or path
        A target in air, the same in the medium of use, and a step standard in the medium of use.
    poses : {"stage", "free"}
        stage: one pose of the target for each capture, moved by the stage. free: every image has a pose of its own.
    index : float, optional
        Refractive index of the medium relative to air, in place of the one that follows from the captures.
    stripe : StripeOptions, optional
        How stripes are found.
    workers : int, optional
        Models calibrated at a time; as many as there are processors unless given.
    progress : callable, optional
        Called with the name of the stage, the number of images or models done, and the number in all.

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
        raise DescriptionError("nothing to compare models by: give --air or --water with captures of a target")
    options = CalibrationOptions(poses=poses, medium_index=index, stripe=stripe)
    with opened_captures([*air, *water]) as targets, opened_captures(step) as steps:
        gathered = gather_jointly(targets, steps, options=options, progress=progress)
        problem = joint_problem(gathered, options=options)
        choice = choose(problem, workers=workers, progress=lambda done, total: progress("models", done, total))
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
    images = [image for image in choice.ways[INSIDE].held if image[0] in alike]
    try:
        header = common_header([c for c in targets if c.path.name in part.names and c.header.medium.kind != "air"])
        return polynomial_score(part, header, images, choice.predictions[choice.simplest()][INSIDE]), ""
    except CalibrationError as error:
        return None, f"no polynomials: {error}"
