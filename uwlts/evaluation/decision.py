"""Decision rule for values with a coverage interval and limits (ISO 14253-1)."""

import math
from typing import Literal, get_args

Verdict = Literal["exceeds the limit", "undecided", "within the limit", "no limit"]
VERDICTS: tuple[Verdict, ...] = get_args(Verdict)
"""Verdicts in order of severity."""


def judge_interval(low: float, high: float, *, lower: float | None = None, upper: float | None = None) -> Verdict:
    """Return the verdict on a coverage interval from ``low`` to ``high``: conformity and non-conformity are proven.

    This is the decision rule of ISO 14253-1. An interval that contains a limit leaves the verdict undecided.
    """
    if lower is None and upper is None:
        return "no limit"
    least, most = -math.inf if lower is None else lower, math.inf if upper is None else upper
    if least <= low and high <= most:
        return "within the limit"
    return "exceeds the limit" if high < least or low > most else "undecided"
