"""Values measured by hand, with their file, table and page; order of an inspection with limits, and verdicts."""

from __future__ import annotations

import csv
import datetime
import io
from collections.abc import Sequence
from pathlib import Path
from typing import Annotated, Self

import numpy as np
from pydantic import ConfigDict, Field, computed_field, model_validator

from uwlts.errors import DescriptionError, EvaluationError
from uwlts.evaluation.figures import VERDICTS, Verdict, judge_interval
from uwlts.files.json_files import read_model, write_model
from uwlts.files.writing import refuse_unsuitable, write_file
from uwlts.inspection.features import Feature, FeatureKind, FeatureValue
from uwlts.inspection.picking import PickedMeasurement
from uwlts.model.library import read_table, validate_description
from uwlts.model.sensor import Description, Positive, Vector
from uwlts.pages.toolkit import MISSING, format_to_scale, render_page, write_page

FORMAT = "uwlts-measured-values"
VERSION = 1  # of the file format
MEASURED = "measured"  # kind of the files, in their names
MEASURED_ENDINGS = tuple(f".{MEASURED}{ending}" for ending in (".html", ".json", ".csv"))
"""Endings of page, list and table."""
COVERAGE_FACTOR = 2.0  # coverage factor of the expanded uncertainties, that of `FigureUncertainty.expanded_mm`
COLUMNS = ("name", "quantity", "value / mm", "U (k = 2) / mm", "lower limit", "upper limit", "verdict", "source")
_SHOWN_MM = 1e-4
"""Precision of values without uncertainty."""


class MeasuredValue(Description):
    """Value measured by hand."""

    model_config = ConfigDict(extra="ignore")

    number: int  # number of the value in its list
    name: Annotated[str, Field(min_length=1, max_length=100)]  # name given by the user
    quantity: str  # measured quantity, such as "distance" or "diameter"
    value_mm: float
    expanded_mm: Annotated[float, Field(ge=0)] | None  # expanded uncertainty (k = 2); None if it is unknown
    without_interval: str  # reason why the uncertainty is unknown; empty if it is known
    # Limits of the value; None: not limited.
    lower_mm: float | None = None
    upper_mm: float | None = None
    source: str  # cloud or image that was measured
    points: int  # number of measured points

    @model_validator(mode="after")
    def _check_limits(self) -> Self:
        if self.lower_mm is not None and self.upper_mm is not None and self.lower_mm > self.upper_mm:
            raise ValueError(
                f"the lower limit {self.lower_mm:g} mm is above the upper one, {self.upper_mm:g} mm: exchange them"
            )
        return self

    @computed_field
    @property
    def verdict(self) -> Verdict:
        """Verdict on the whole interval (ISO 14253-1); undecided if a limit is given and the uncertainty is unknown."""
        if self.expanded_mm is None:
            return "no limit" if self.lower_mm is None and self.upper_mm is None else "undecided"
        low, high = self.value_mm - self.expanded_mm, self.value_mm + self.expanded_mm
        return judge_interval(low, high, lower=self.lower_mm, upper=self.upper_mm)

    def interval_text(self) -> str:
        """Return quantity, value and interval as text, or the reason why there is no interval."""
        known = self.expanded_mm is not None
        stated = f"± {self._format_figure(self.expanded_mm)} mm" if known else f"mm ({self.without_interval})"
        return f"{self.quantity} {self._format_figure(self.value_mm)} {stated}"

    def row(self) -> tuple[str, ...]:
        """Return the texts of a table with `COLUMNS`."""
        limits = [MISSING if each is None else f"{each:g}" for each in (self.lower_mm, self.upper_mm)]
        stated = self.without_interval if self.expanded_mm is None else self._format_figure(self.expanded_mm)
        return self.name, self.quantity, self._format_figure(self.value_mm), stated, *limits, self.verdict, self.source

    def _format_figure(self, value_mm: float | None) -> str:
        return MISSING if value_mm is None else format_to_scale(value_mm, self.expanded_mm or _SHOWN_MM, digits=2)


class MeasuredValues(Description):
    """List of measured values. Changes return a new list, which remembers the one before for `undo`.

    ``edited`` is set if its file was edited by hand.
    """

    model_config = ConfigDict(extra="ignore")

    coverage_factor: float = COVERAGE_FACTOR
    values: tuple[MeasuredValue, ...] = ()
    edited: bool = False
    before: MeasuredValues | None = Field(default=None, exclude=True, repr=False)

    def add(self, measured: PickedMeasurement, *, source: str, without_interval: str) -> MeasuredValues:
        """Add all figures of a measurement, named after it and numbered.

        ``without_interval`` is the reason if a figure has no uncertainty.
        """
        taken, count = {each.name for each in self.values}, 1
        while (name := f"{measured.name} {count}") in taken:
            count += 1
        first = max((each.number for each in self.values), default=0) + 1
        added = []
        for number, (quantity, value) in enumerate(measured.figures_mm.items(), start=first):
            known = measured.uncertainty.get(quantity)
            added.append(
                MeasuredValue(
                    number=number,
                    name=name,
                    quantity=quantity,
                    value_mm=value,
                    expanded_mm=None if known is None else known.expanded_mm,
                    without_interval=without_interval if known is None else "",
                    source=source,
                    points=measured.points_used,
                )
            )
        return self.replace((*self.values, *added))

    def rename(self, number: int, name: str) -> MeasuredValues:
        """Rename a value; DescriptionError if the name is empty or longer than 100 characters."""
        return self._change(number, name=name.strip())

    def limit(self, number: int, lower_mm: float | None, upper_mm: float | None) -> MeasuredValues:
        """Set the limits of a value; DescriptionError if the lower one is above the upper one."""
        return self._change(number, lower_mm=lower_mm, upper_mm=upper_mm)

    def remove(self, number: int) -> MeasuredValues:
        """Remove a value."""
        self.find(number)
        return self.replace([each for each in self.values if each.number != number])

    def undo(self) -> MeasuredValues:
        """Return the list before the last change; DescriptionError if there was none."""
        if self.before is None:
            raise DescriptionError("there is no change of the list to undo")
        return self.before

    def replace(self, values: Sequence[MeasuredValue]) -> MeasuredValues:
        """Return a list of other values, which remembers this one."""
        return MeasuredValues(values=tuple(values), before=self)

    def find(self, number: int) -> MeasuredValue:
        """Return the value with a number; DescriptionError if it was removed."""
        found = next((each for each in self.values if each.number == number), None)
        if found is None:
            raise DescriptionError(f"value {number} was removed from the list")
        return found

    def _change(self, number: int, **changed: object) -> MeasuredValues:
        old = self.find(number)
        new = validate_description(MeasuredValue, old.model_dump() | changed, f"the value '{old.name}'")
        return self if new == old else self.replace([new if each is old else each for each in self.values])

    def table(self) -> str:
        """Return the list as CSV with a line of names; intervals that are unknown are empty."""
        names = [name for name in MeasuredValue.model_fields if name != "number"]
        text = io.StringIO()
        writer = csv.DictWriter(text, [*names, "verdict"], extrasaction="ignore", lineterminator="\n")
        writer.writeheader()
        writer.writerows(each.model_dump() for each in self.values)
        return text.getvalue()


def write_measured(page: str | Path, measured: MeasuredValues, *, title: str, overwrite: bool = False) -> list[Path]:
    """Write a list as a page NAME.measured.html, and beside it as JSON and CSV; return the paths.

    Raises DescriptionError if the list is empty; OutputError if a file exists and ``overwrite`` is not set, or cannot
    be written.
    """
    if not measured.values:
        raise DescriptionError("the list of measured values is empty: measure something first")
    paths = [Path(page).with_suffix(Path(each).suffix) for each in MEASURED_ENDINGS]
    for path, ending in zip(paths, MEASURED_ENDINGS, strict=True):
        refuse_unsuitable(path, overwrite=overwrite, endings=(ending,))
    rows = [each.row() for each in measured.values]
    text = render_page("uwlts.report", "measured.html.j2", title=title, columns=COLUMNS, rows=rows)
    write_model(paths[1], measured, file_format=FORMAT, version=VERSION, overwrite=overwrite)
    write_file(paths[2], measured.table(), overwrite=overwrite)
    write_page(paths[0], text, overwrite=overwrite)
    return paths


def read_measured(path: str | Path) -> MeasuredValues:
    """Read a list written by `write_measured`; CaptureError if it cannot be read."""
    return read_model(path, MeasuredValues, file_format=FORMAT, version=VERSION, called="list of measured values")


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


def format_place(feature: Feature, whole: Feature | None, start_mm: np.ndarray, datum: FindingDatum) -> tuple[str, str]:
    """Return clock position and distance from the datum, mm, as text; for objects other than pipes X and Y.

    The clock is read looking along the direction in which distances count. ``start_mm`` (3,) is the datum's place if it
    states none.

    Raises EvaluationError if the datum's directions do not determine the clock.
    """
    offset = feature.place_mm - (start_mm if datum.place_mm is None else np.array(datum.place_mm))
    if whole is None or whole.kind != FeatureKind.PIPE:
        return f"X {offset[0]:.0f}, Y {offset[1]:.0f}", f"{np.linalg.norm(offset):.0f}"
    axis, up, _ = resolve_datum(datum, whole.axes[2])
    about = feature.place_mm - whole.place_mm
    minutes = round(720 * float(np.arctan2(about @ np.cross(axis, up), about @ up)) / (2 * np.pi)) % 720
    return f"{minutes // 60 or 12}:{minutes % 60:02d}", f"{round(float(offset @ axis))}"
