"""What rendering says of the formulas, in words and as rows of a table."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import Any

from twin.study.description import Study
from twin.study.report.names import MISSING, number_text, value_text


def agreement(study: Study, row: Mapping[str, Any]) -> str:
    """Whether formulas and rendering agree on a design, in a sentence."""
    if row["failure"]:
        return f"It could not be verified: {row['failure']}."
    factor = number_text(row["ratio"], 3)
    if row["agrees"]:
        return (
            f"Formulas and rendering agree: their scatters differ by a factor {factor}, up to "
            f"{number_text(study.verify_tolerance, 3)} is allowed."
        )
    worst = _worst(row)
    if factor == MISSING or worst is None:
        return "Formulas and rendering could not be compared: rendering found no scatter at any depth."
    z, predicted, rendered = worst
    return (
        f"Formulas and rendering disagree by a factor {factor}, more than the {number_text(study.verify_tolerance, 3)} "
        f"allowed: most at Z = {number_text(z)} mm, where {number_text(1e3 * predicted)} µm were predicted and "
        f"{number_text(1e3 * rendered)} µm rendered. Do not rely on the formulas for designs like this one."
    )


def _worst(row: Mapping[str, Any]) -> tuple[float, float, float] | None:
    """Z, predicted and rendered scatter where they differ most; None where nothing can be compared."""
    triples = [
        (z, predicted, rendered)
        for z, predicted, rendered in zip(row["z_mm"], row["predicted_mm"], row["rendered_mm"], strict=True)
        if _positive(predicted) and _positive(rendered)
    ]
    return max(triples, key=lambda one: abs(math.log(one[2] / one[1])), default=None)


def _positive(value: float | None) -> bool:
    return value is not None and math.isfinite(value) and value > 0


def verification_rows(verified: Sequence[Mapping[str, Any]]) -> list[list[str]]:
    """Rows of the table of what was rendered."""
    rows = []
    for row in verified:
        errors = [abs(value) for value in row["error_mm"] if value is not None and math.isfinite(value)]
        lines = [value for value in row["line_mm"] if value is not None and math.isfinite(value)]
        number = row["design"]
        rows.append(
            [
                row["label"], str(number) if number >= 0 else MISSING,
                "failed" if row["failure"] else "agree" if row["agrees"] else "DISAGREE",
                number_text(row["ratio"], 3),
                number_text(1e3 * max(errors)) if errors else MISSING,
                f"{number_text(min(lines))} to {number_text(max(lines))}" if lines else MISSING,
                value_text("exposure_ms", row["predicted_exposure_ms"], unit=False),
                value_text("exposure_ms", row["exposure_ms"], unit=False),
                number_text(row["seconds"], 3),
            ]
        )  # fmt: skip
    return rows
