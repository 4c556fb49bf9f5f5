"""Judges a cloud: against its artefact's calibrated values and, where a truth file lies beside it, point by point."""

import json
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from uwlts.cloud import PointCloud
from uwlts.errors import CaptureError, EvaluationError
from uwlts.files import written_aside
from uwlts.json_file import read_json
from uwlts.metrology.artefacts import Artefact, evaluate_cloud
from uwlts.metrology.truth import TruthComparison, best_fit_motion, compare_with_truth
from uwlts.truth import Truth
from uwlts.uncertainty.figures import figure_uncertainties

FORMAT = "uwlts-evaluation"
VERSION = 1
TOLERANCE_MM = 0.010


@dataclass(frozen=True)
class Judgement:
    """What an evaluation says: plain JSON for the file, and the cloud with the deviation of every point."""

    content: dict[str, Any]
    cloud: PointCloud


def judge(cloud: PointCloud, *, artefact: Artefact | None, truth: Truth | None, source: str) -> Judgement:
    """Evaluate a cloud. Its points are coloured by their deviation from the artefact's fit, else from the true surface
    after a best fit.

    Raises
    ------
    EvaluationError
        There is neither an artefact nor a truth, or the cloud does not show the artefact.
    """
    if artefact is None and truth is None:
        raise EvaluationError(
            "nothing to judge by: the capture names no artefact (give --artefact) and there is no truth file (--truth)"
        )
    content: dict[str, Any] = {"format": FORMAT, "version": VERSION, "cloud": source, **cloud.metadata}
    content |= {"artefact": None, "evaluation": None, "truth": None}
    deviation = np.full(len(cloud), np.nan)
    if truth is not None:
        compared, fitted = _against_truth(cloud, truth)
        content["truth"] = compared.as_dict() | {"after_best_fit": fitted.as_dict()}
        deviation = fitted.distance_mm
    if artefact is not None:
        evaluation = evaluate_cloud(cloud, artefact)
        content |= {"artefact": artefact.model_dump(mode="json"), "evaluation": evaluation.as_dict()}
        content["uncertainty"] = {
            name: {"random_mm": known.random_mm, "systematic_mm": known.systematic_mm, "expanded_mm": known.expanded_mm}
            for name, known in figure_uncertainties(cloud, artefact, evaluation).items()
        }
        deviation = evaluation.deviation_mm
    return Judgement(content, replace(cloud, deviation_mm=deviation))


def _against_truth(cloud: PointCloud, truth: Truth) -> tuple[TruthComparison, TruthComparison]:
    """Comparison as measured, and after the rigid motion that takes out the difference of the coordinate systems."""

    def compared(points: np.ndarray) -> TruthComparison:
        return compare_with_truth(
            points, cloud.frame, cloud.line,
            point_mm=truth.point_mm, normal=truth.normal, status=truth.status, tolerance_mm=TOLERANCE_MM,
        )  # fmt: skip

    plain = compared(cloud.points_mm)
    motion = best_fit_motion(plain, cloud.points_mm)
    return plain, compared(cloud.points_mm @ motion[:3, :3].T + motion[:3, 3])


def write_evaluation(path: str | Path, judgement: Judgement, *, overwrite: bool = False) -> None:
    """Write an evaluation as indented JSON, whole or not at all; OutputError where that fails."""
    with written_aside(path, overwrite=overwrite) as aside:
        aside.write_text(json.dumps(judgement.content, indent=2) + "\n", encoding="utf-8")


def read_evaluation(path: str | Path) -> dict[str, Any]:
    """Content of an evaluation file; CaptureError where it is missing, foreign, newer or damaged."""
    content = read_json(path, called="evaluation")
    if (content.get("format"), content.get("version")) != (FORMAT, VERSION):
        raise CaptureError(f"{path} is JSON but not an evaluation that this program reads (version {VERSION})")
    return content
