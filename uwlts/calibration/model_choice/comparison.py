"""The comparison of models from captures."""

from collections.abc import Sequence
from dataclasses import dataclass

from uwlts.calibration.evidence import Progress as Searched
from uwlts.calibration.joint.gathering import Gathered, gather_jointly
from uwlts.calibration.joint.observations import TargetEvidence
from uwlts.calibration.joint.procedure import JointProblem, joint_problem
from uwlts.calibration.model_choice.choice import Choice, Progress, choose
from uwlts.calibration.model_choice.held_out import INSIDE
from uwlts.calibration.model_choice.polynomials import PolynomialScore, polynomial_score
from uwlts.calibration.polynomial_evidence import common_header
from uwlts.calibration.procedure import CalibrationOptions
from uwlts.capture import Capture
from uwlts.errors import CalibrationError


@dataclass(frozen=True, eq=False)
class Comparison:
    """What models miss in images held out, of which sensor and which captures.

    ``polynomials`` is None without a target in a medium on the stage; ``why_none`` tells why there is no score of them.
    """

    sensor: str
    captures: list[str]
    choice: Choice
    polynomials: PolynomialScore | None
    why_none: str
    warnings: list[str]


def compare_models(
    targets: Sequence[Capture], steps: Sequence[Capture] = (), *, options: CalibrationOptions,
    workers: int | None = None, searched: Searched | None = None, progress: Progress = lambda done, total: None,
) -> Comparison:  # fmt: skip
    """Search the images once and compare all models by images held out.

    Parameters
    ----------
    targets, steps : sequence of Capture
        As `calibrate_jointly`.
    options : CalibrationOptions
        Its distortion and its refractions do not count: the models are compared in them.
    workers : int, optional
        Processes; as many as there are processors unless given.
    searched, progress : callable, optional
        Told of images searched, and of models calibrated.

    Raises
    ------
    CalibrationError
        There are too few images, or they do not determine a calibration.
    DescriptionError
        A capture does not describe its target or its step standard.
    """
    gathered = gather_jointly(targets, steps, options=options, progress=searched)
    problem = joint_problem(gathered, options=options)
    choice = choose(problem, workers=workers, progress=progress)
    score, why_none = _polynomials(gathered, problem, choice, targets, free=options.poses == "free")
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
