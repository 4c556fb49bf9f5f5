"""Order of an inspection: client, object, datum and limits as the user states them, and the verdicts that follow."""

from __future__ import annotations

import datetime
from pathlib import Path

import numpy as np
from pydantic import Field

from uwlts.errors import EvaluationError
from uwlts.evaluation.decision import VERDICTS, Verdict, judge_interval
from uwlts.inspection.features import Feature, FeatureKind, FeatureValue
from uwlts.model.library import read_table, validate_description
from uwlts.model.sensor import Description, Positive, Vector


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

    Coordinates are those of the cloud. Without a place, distances count from the first scanned point.
    """

    name: str = "first scanned point"
    place_mm: Vector | None = None
    direction: Vector = (1.0, 0.0, 0.0)
    twelve_o_clock: Vector = (0.0, 0.0, -1.0)


class FindingOrder(Description):
    """Order of an inspection, read from TOML; what it does not state is taken from the files or shown as missing."""

    client: str | None = None
    object: str | None = None
    operator: str | None = None
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


def format_place(feature: Feature, whole: Feature | None, start_mm: np.ndarray, datum: FindingDatum) -> tuple[str, str]:
    """Return clock position and distance from the datum, mm, as text; for objects other than pipes X and Y.

    The clock is read looking along the direction in which distances count. ``start_mm`` (3,) is the datum's place if it
    states none.

    Raises EvaluationError if the datum's directions do not determine the clock.
    """
    away = feature.place_mm - (start_mm if datum.place_mm is None else np.array(datum.place_mm))
    if whole is None or whole.kind != FeatureKind.PIPE:
        return f"X {away[0]:.0f}, Y {away[1]:.0f}", f"{np.linalg.norm(away):.0f}"
    slope = float(whole.axes[2] @ np.array(datum.direction))
    axis = whole.axes[2] * np.sign(slope)
    up = np.array(datum.twelve_o_clock) - (axis @ np.array(datum.twelve_o_clock)) * axis
    if abs(slope) < 1e-6 or np.linalg.norm(up) < 1e-6:
        raise EvaluationError(
            "the order's datum does not determine the clock: expected a direction along the pipe's axis and a "
            f"twelve_o_clock across it; the axis is {np.round(whole.axes[2], 3).tolist()}"
        )
    about = feature.place_mm - whole.place_mm
    minutes = round(720 * float(np.arctan2(about @ np.cross(axis, up), about @ up)) / (2 * np.pi)) % 720
    return f"{minutes // 60 or 12}:{minutes % 60:02d}", f"{away @ axis:.0f}"
