"""Evaluates a cloud against the artefact that was measured."""

from uwlts.cloud import PointCloud
from uwlts.metrology.artefact_descriptions import Artefact, Pipe, PlaneStandard, SphereStandard, StepStandard
from uwlts.metrology.evaluation import Evaluation
from uwlts.metrology.sphere_evaluation import SphereEvaluation, evaluate_spheres
from uwlts.metrology.step_evaluation import StepEvaluation, evaluate_step
from uwlts.metrology.surface_evaluation import PipeEvaluation, PlaneEvaluation, evaluate_pipe, evaluate_plane

__all__ = [
    "Artefact",
    "Evaluation",
    "Pipe",
    "PipeEvaluation",
    "PlaneEvaluation",
    "PlaneStandard",
    "SphereEvaluation",
    "SphereStandard",
    "StepEvaluation",
    "StepStandard",
    "evaluate_cloud",
]


def evaluate_cloud(cloud: PointCloud, artefact: Artefact) -> Evaluation:
    """Measure the artefact in the cloud and compare it with its calibrated sizes.

    Raises
    ------
    EvaluationError
        The cloud does not show what the artefact's description says; the message says what was found.
    """
    match artefact:
        case SphereStandard():
            return evaluate_spheres(cloud.points_mm, artefact)
        case PlaneStandard():
            return evaluate_plane(cloud.points_mm, artefact)
        case StepStandard():
            return evaluate_step(cloud.points_mm, cloud.frame, artefact)
        case Pipe():
            return evaluate_pipe(cloud.points_mm, artefact)
    raise TypeError(f"no evaluation for {type(artefact).__name__}")
