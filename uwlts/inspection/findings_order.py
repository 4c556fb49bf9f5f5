"""Order of an inspection with its datum and limits: verdicts on findings by the limits, and places by the datum."""

import datetime
import math
from pathlib import Path
from typing import Literal, get_args

import numpy as np
from pydantic import Field

from uwlts.errors import EvaluationError
from uwlts.inspection.features import Feature, FeatureValue
from uwlts.model.library import read_table, validate_description
from uwlts.model.sensor import Description, Positive, Vector

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


class FindingLimits(Description):
    """Limits of findings: largest depth, least remaining wall, largest ovality and undercut; None: not limited.

    The values are the user's, by the specification of the object: there are no defaults.
    """

    depth_mm: Positive | None = None
    remaining_wall_mm: Positive | None = None
    ovality_percent: Positive | None = None
    undercut_mm: Positive | None = None

    def of(self, name: str) -> float | None:
        """Return the limit of a value by its name in `uwlts.inspection.features.DEFINITIONS`; None without one."""
        return {
            "depth": self.depth_mm,
            "remaining wall": self.remaining_wall_mm,
            "ovality share": self.ovality_percent,
            "largest undercut": self.undercut_mm,
        }.get(name)


class FindingDatum(Description):
    """Datum of places: its name and place, the direction in which distances count, and that of 12 o'clock.

    Coordinates are those of the cloud. Without a place, distances count from the first scanned point. Directions that
    are not given are chosen by `resolve_datum`.
    """

    name: str = "first scanned point"
    place_mm: Vector | None = None
    direction: Vector | None = None
    twelve_o_clock: Vector | None = None


class FindingOrder(Description):
    """Order of an inspection, read from TOML; what it does not state is taken from the files or shown as missing."""

    client: str | None = None
    object: str | None = None  # title of the report
    report: str | None = None  # number of the report
    revision: str | None = None
    operator: str | None = None
    checked_by: str | None = None
    approved_by: str | None = None
    date: datetime.date | None = None
    sensor: str | None = None
    water: str | None = None
    datum: FindingDatum = Field(default_factory=FindingDatum)
    limits: FindingLimits = Field(default_factory=FindingLimits)


def load_order(path: str | Path | None) -> FindingOrder:
    """Return the order in a TOML file, or an empty one; raises DescriptionError if the file is no order."""
    return FindingOrder() if path is None else validate_description(FindingOrder, read_table(Path(path)), path)


def judge_value(value: FeatureValue, limits: FindingLimits) -> Verdict:
    """Return the verdict on a value by its coverage interval (`judge_interval`); a remaining wall has a lower limit."""
    limit = limits.of(value.name)
    if value.name == "remaining wall":
        return judge_interval(value.low, value.high, lower=limit)
    return judge_interval(value.low, value.high, upper=limit)


def judge_feature(feature: Feature, limits: FindingLimits) -> tuple[Verdict, list[str]]:
    """Return the most severe verdict on a feature's values, and the names of the values that give it."""
    found: dict[str, Verdict] = {value.name: judge_value(value, limits) for value in feature.values}
    worst: Verdict = VERDICTS[min(map(VERDICTS.index, found.values()), default=-1)]
    return worst, [name for name, each in found.items() if each == worst and worst != "no limit"]


def sort_by_severity(features: list[Feature], limits: FindingLimits) -> list[Feature]:
    """Return features from the most severe on: by verdict, then by the share of the limit used, then by size."""

    def used(feature: Feature) -> float:
        limited = [(value, limit) for value in feature.values if (limit := limits.of(value.name)) is not None]
        shares = [
            limit / max(value.value, 1e-9) if value.name == "remaining wall" else value.value / limit
            for value, limit in limited
        ]
        return max(shares, default=0.0)

    return sorted(
        features, key=lambda f: (VERDICTS.index(judge_feature(f, limits)[0]), -used(f), -abs(f.values[0].value))
    )


_SIDES = np.array([4.0, 2.0, 1.0])
"""Weights of X, Y and Z that choose the direction of a pipe. Axes along edges or diagonals of a cube, where pipes
usually lie, are at least 7 deg away from those at which the choice changes."""
_ACROSS = 0.1
"""Least component of a direction along a pipe, or of 12 o'clock across it: nearer ones (6 deg) follow the noise."""
_UPRIGHT = 0.3  # component of 12 o'clock (-Z) across a pipe below which +X replaces it: pipes within 17 deg of Z


def resolve_datum(datum: FindingDatum, axis: np.ndarray) -> tuple[np.ndarray, np.ndarray, str | None]:
    """Return the direction of distances along a pipe's axis (3,), that of 12 o'clock across it, and a note on a choice.

    If the datum states no direction, the larger one of 4 X + 2 Y + Z is taken. If it states no 12 o'clock, this is -Z,
    or +X for a pipe along Z. The note is None if the datum states both.

    Raises EvaluationError if stated directions do not determine them.
    """
    along = _SIDES if datum.direction is None else np.array(datum.direction)
    direction = axis * np.copysign(1.0, float(axis @ along))
    if (up := datum.twelve_o_clock) is None:
        up = (0.0, 0.0, -1.0) if np.hypot(*axis[:2]) > _UPRIGHT else (1.0, 0.0, 0.0)
    across = np.array(up) - (axis @ np.array(up)) * axis
    slope = 1.0 if datum.direction is None else abs(float(axis @ along)) / max(float(np.linalg.norm(along)), 1e-300)
    if slope < _ACROSS or np.linalg.norm(across) < _ACROSS * np.linalg.norm(up):
        raise EvaluationError(
            "the order's datum does not determine the clock: expected a direction along the pipe's axis and a "
            f"twelve_o_clock across it; the axis is {np.round(axis, 3).tolist()}"
        )
    across = across / np.linalg.norm(across)
    chosen = [
        f"{label} ({', '.join(f'{number:.2f}' for number in way + 0.0)})"
        for label, given, way in (
            ("distances increase along", datum.direction, direction),
            ("12 o'clock is", datum.twelve_o_clock, across),
        )
        if given is None
    ]
    note = f"chosen by the pipe's axis, as the order does not state it: {', '.join(chosen)}" if chosen else None
    return direction, across, note


def format_place(feature: Feature, pipe: Feature, points_mm: np.ndarray, datum: FindingDatum) -> tuple[str, str]:
    """Return clock position and distance from the datum, mm, of a feature of a pipe as text.

    The clock is read looking along the direction in which distances count. If the datum states no place, they count
    from the first of the cloud's points (N, 3).

    Raises EvaluationError if the datum's directions do not determine the clock.
    """
    axis, up, _ = resolve_datum(datum, pipe.axes[2])
    start = float(np.min(points_mm @ axis)) if datum.place_mm is None else float(np.array(datum.place_mm) @ axis)
    about = feature.place_mm - pipe.place_mm
    minutes = round(720 * float(np.arctan2(about @ np.cross(axis, up), about @ up)) / (2 * np.pi)) % 720
    return f"{minutes // 60 or 12}:{minutes % 60:02d}", f"{round(float(feature.place_mm @ axis) - start)}"
