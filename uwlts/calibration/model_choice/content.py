"""The comparison's figures as plain JSON, and as lines for a terminal."""

from datetime import UTC, datetime
from typing import Any

import uwlts
from uwlts.calibration.model_choice.choice import Judged
from uwlts.calibration.model_choice.comparison import Comparison
from uwlts.calibration.model_choice.held_out import INSIDE, OUTSIDE
from uwlts.calibration.model_choice.scores import POINTS, STRIPES
from uwlts.calibration.model_choice.verdicts import adds, verdicts
from uwlts.report.numbers import fixed, small_length
from uwlts.report.page_toolkit import MISSING


def content_of(comparison: Comparison) -> dict[str, Any]:
    """All figures, lengths in mm."""
    choice, polynomials = comparison.choice, comparison.polynomials
    return {
        "format": "uwlts-models",
        "version": 1,
        "sensor": comparison.sensor,
        "captures": comparison.captures,
        "software": f"uwlts {uwlts.__version__}",
        "date": datetime.now(UTC).isoformat(timespec="seconds"),
        "held_out": {where: len(split.held) for where, split in choice.ways.items()},
        "models": [_model(comparison, judged) for judged in choice.judged],
        "best": choice.best().words(),
        "simplest": choice.simplest().words(),
        "polynomials": None if polynomials is None else vars(polynomials),
        "verdicts": [*verdicts(choice), _of_polynomials(comparison)],
        "warnings": comparison.warnings,
    }


def _model(comparison: Comparison, judged: Judged) -> dict[str, Any]:
    choice = comparison.choice
    row: dict[str, Any] = {"model": judged.candidate.words(), "parameters": judged.parameters}
    if judged.reason:
        return row | {"reason": judged.reason}
    for where, score in judged.scores.items():
        cost = adds(choice, judged.candidate, choice.best(), where)
        row[where] = {
            "px": score.px, "mm": score.mm, "all_mm": score.all_mm, "std_mm": score.std_mm,
            "adds_mm": None if cost is None else cost[0], "adds_std_mm": None if cost is None else cost[1],
        }  # fmt: skip
    return row | {"as_good": judged.candidate in choice.as_good()}


def _of_polynomials(comparison: Comparison) -> str:
    score = comparison.polynomials
    if score is None:
        return comparison.why_none
    return (
        f"polynomials, fitted to the target in {score.medium} alone, miss stripes in {score.images} images inside the "
        f"calibrated volume by {small_length(score.all_mm)} ± {small_length(score.std_mm)}, the simplest model by "
        f"{small_length(score.model_mm)} ± {small_length(score.model_std_mm)}; outside they do not measure"
    )


def lines_of(content: dict[str, Any]) -> list[str]:
    """The table and the verdicts, as text."""
    width = max(len(row["model"]) for row in content["models"])
    heads = [f"{where} the volume, {content['held_out'][where]} images held out" for where in (INSIDE, OUTSIDE)]
    columns = f"{'points':>8}{'stripes':>9}{'all':>15}{'adds':>14}"
    units = f"{'px':>8}{'px':>9}{'µm':>15}{'µm':>14}"
    lines = [
        f"{'':{width}} {'':>4}" + "".join(f"{head:>{len(columns)}}" for head in heads),
        f"{'model':{width}} {'free':>4}{columns}{columns}",
        f"{'':{width}} {'':>4}{units}{units}",
    ]
    for row in content["models"]:
        start = f"{row['model']:{width}}"
        if "reason" in row:
            lines.append(f"{start} no calibration: {row['reason']}")
        else:
            lines.append(f"{start} {row['parameters']:>4}" + "".join(_cells(row[where]) for where in (INSIDE, OUTSIDE)))
    return [*lines, "", *content["verdicts"]]


def _cells(score: dict[str, Any]) -> str:
    everything = f"{fixed(1e3 * score['all_mm'], 1)} ± {fixed(1e3 * score['std_mm'], 1)}"
    cost = "as good"
    if score["adds_mm"] is not None:
        cost = f"{fixed(1e3 * score['adds_mm'], 1)} ± {fixed(1e3 * score['adds_std_mm'], 1)}"
    points, stripes = (fixed(score["px"][kind], 4) if kind in score["px"] else MISSING for kind in (POINTS, STRIPES))
    return f"{points:>8}{stripes:>9}{everything:>15}{cost:>14}"
