"""Measurements by hand: lengths, shapes and sections at picked places of a cloud or in images, and lists of the values.

Lists have limits, verdicts by the whole intervals, and files.
"""

from __future__ import annotations

import csv
import io
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Literal, Self

import numpy as np
from pydantic import ConfigDict, Field, computed_field, model_validator

from uwlts.errors import DescriptionError, EvaluationError
from uwlts.evaluation.figure_uncertainty import propagate_figures
from uwlts.evaluation.figures import FigureUncertainty
from uwlts.files.json_files import read_model, write_model
from uwlts.fitting.least_squares import fit_robustly
from uwlts.fitting.propagation import PointErrors, noise_shifts
from uwlts.inspection.findings_order import Verdict, judge_interval
from uwlts.model.library import validate_description
from uwlts.model.sensor import Description
from uwlts.pages.toolkit import MISSING, format_to_scale
from uwlts.shapes.cylinder import Cylinder
from uwlts.shapes.flat import Plane
from uwlts.shapes.sphere import Sphere
from uwlts.storage.cloud import PointCloud

Shape = Literal["sphere", "plane", "cylinder"]
_FITS: dict[Shape, Callable[[np.ndarray], Sphere | Plane | Cylinder]] = {
    "sphere": Sphere.fit,
    "plane": Plane.fit,
    "cylinder": Cylinder.fit,
}
_MOST_POINTS = 20_000
"""Most points of a fit; with more points the errors common to all of them dominate."""
_DRAWS = 8  # noise draws; eight give a standard deviation to 27 %


@dataclass(frozen=True, eq=False)
class PickedMeasurement:
    """Measured figures in mm by name, their uncertainties if the cloud has any, and the numbers of points.

    For a length, ``points_used`` is 2. For a shape, it counts the points that agree with the fit.
    """

    name: str
    figures_mm: dict[str, float]
    uncertainty: dict[str, FigureUncertainty]
    points_used: int
    points_rejected: int

    def text(self) -> str:
        """Return a line of text, with expanded uncertainties (k = 2) if they are known."""
        figures = []
        for name, value in self.figures_mm.items():
            known = self.uncertainty.get(name)
            stated = "" if known is None else f" ± {known.expanded_mm:.4f}"
            figures.append(f"{name} {value:.4f}{stated} mm")
        of = f" ({self.points_used} points" + (f", {self.points_rejected} left out)" if self.points_rejected else ")")
        return f"{self.name}: {', '.join(figures)}{of}"


def find_nearest_point(cloud: PointCloud, place_mm: np.ndarray) -> int:
    """Return the index of the point nearest to a place (3,)."""
    if len(cloud) == 0:
        raise EvaluationError("the cloud is empty: there are no points to measure")
    return int(np.argmin(np.sum((cloud.points_mm - place_mm) ** 2, axis=1)))


def measure_length(cloud: PointCloud, first: int, second: int) -> PickedMeasurement:
    """Return the distance between two points of a cloud.

    Its uncertainty includes errors that both points share (GUM, Eq. 13): the calibration's patterns, and the position
    of their image if both are in one image.
    """
    if first == second:
        raise EvaluationError("both ends of the length are the same point: pick another point")
    way = cloud.points_mm[second] - cloud.points_mm[first]
    length = float(np.linalg.norm(way))
    unit = way / length if length else np.array([0.0, 0.0, 1.0])
    stated = {}
    if (known := cloud.uncertainty) is not None:
        together = (known.patterns_mm[:, second] - known.patterns_mm[:, first]) @ unit
        ends = np.array([first, second])
        by_image = known[ends].image_errors_mm() @ unit
        if cloud.frame[first] == cloud.frame[second]:
            by_image = np.diff(by_image, axis=1)
        noise = noise_shifts(known[ends]) @ unit
        random = float(np.sqrt(noise @ noise + np.sum(by_image**2)))
        stated["distance"] = FigureUncertainty(random, float(np.linalg.norm(together)))
    return PickedMeasurement("length", {"distance": length}, stated, 2, 0)


def fit_shape_near(cloud: PointCloud, place_mm: np.ndarray, radius_mm: float, shape: Shape) -> PickedMeasurement:
    """Fit a shape robustly to the points within a radius of a place (3,).

    Uncertainties are propagated as for artefacts (`uwlts.evaluation.figure_uncertainty`): the fit is repeated with each
    pattern of the calibration and with drawn noise. EvaluationError if the points do not determine the shape.
    """
    near = np.flatnonzero(np.sum((cloud.points_mm - place_mm) ** 2, axis=1) <= radius_mm**2)
    if len(near) == 0:
        raise EvaluationError(f"no points within {radius_mm:g} mm of the place: pick another place or a larger radius")
    near = near[:: -(-len(near) // _MOST_POINTS)]
    points, fit = cloud.points_mm[near], _FITS[shape]
    robust = fit_robustly(fit, points)
    used = near[robust.inliers]
    figures = _list_figures(robust.fit)
    stated = _state_uncertainty(cloud, used, lambda moved: _list_figures(fit(moved)))
    return PickedMeasurement(shape, figures, stated, len(used), robust.rejected)


def _state_uncertainty(
    cloud: PointCloud, used: np.ndarray, measure: Callable[[np.ndarray], dict[str, float]]
) -> dict[str, FigureUncertainty]:
    """Return the uncertainties of figures that ``measure`` returns for positions (K, 3) of used points (K,) of a cloud.

    The result is empty for a cloud without uncertainty.
    """
    if (known := cloud.uncertainty) is None:
        return {}
    points, errors = cloud.points_mm[used], PointErrors.from_uncertainty(known[used], cloud.frame[used])
    return propagate_figures(errors, measure(points), lambda moves: measure(points + moves), draws=_DRAWS)


def _list_figures(fit: Sphere | Plane | Cylinder) -> dict[str, float]:
    form = {"standard deviation": fit.std_mm}
    return form if isinstance(fit, Plane) else {"diameter": 2 * fit.radius_mm} | form


_FEWEST_POINTS = 3  # fewest points on each side of a step
_SMALLEST_MM = 1e-6  # shorter ways between two places have no direction


@dataclass(frozen=True, eq=False)
class Section:
    """Points in a strip of a cloud, in the order along it."""

    cloud: PointCloud  # points of the strip
    direction: np.ndarray  # (3,); unit vector along the strip, perpendicular to Z
    origin_mm: np.ndarray  # (3,); place where ``along_mm`` is zero

    @property
    def along_mm(self) -> np.ndarray:
        """Distance (N,) along the strip, mm."""
        return (self.cloud.points_mm - self.origin_mm) @ self.direction

    @property
    def depth_mm(self) -> np.ndarray:
        """Coordinate Z (N,), mm, which increases away from the sensor."""
        return self.cloud.points_mm[:, 2]

    def find_nearest(self, along_mm: float) -> int:
        """Return the index of the point nearest to a distance along the strip."""
        if len(self.cloud) == 0:
            raise EvaluationError("the section is empty: there are no points to measure")
        return int(np.argmin(np.abs(self.along_mm - along_mm)))


def cut_section(cloud: PointCloud, first_mm: np.ndarray, second_mm: np.ndarray, *, width_mm: float) -> Section:
    """Return the section of a cloud along the strip through two places (3,), ``width_mm`` wide and parallel to Z.

    EvaluationError if one place lies behind the other, or if there are no points in the strip.
    """
    way = np.array([*(second_mm - first_mm)[:2], 0.0])
    length = float(np.linalg.norm(way))
    if length < _SMALLEST_MM:
        raise EvaluationError("both places of the section have the same X and Y: pick places beside each other")
    direction = way / length
    distance = (cloud.points_mm - first_mm) @ np.array([-direction[1], direction[0], 0.0])
    inside = np.flatnonzero(np.abs(distance) <= width_mm / 2)
    if len(inside) == 0:
        raise EvaluationError(f"no points within the strip of {width_mm:g} mm: give a wider one")
    order = np.argsort(cloud.points_mm[inside] @ direction, kind="stable")
    return Section(cloud.select(inside[order]), direction, np.array(first_mm, dtype=float))


def order_profile(cloud: PointCloud) -> Section:
    """Return the points of a single image as a section along Y."""
    order = np.argsort(cloud.points_mm[:, 1], kind="stable")
    return Section(cloud.select(order), np.array([0.0, 1.0, 0.0]), np.zeros(3))


def measure_step(section: Section, first_mm: float, second_mm: float, *, width_mm: float) -> PickedMeasurement:
    """Return the height of the surface about the second place of a section above that about the first one.

    Two parallel lines are fitted to the points within ``width_mm`` / 2 of each place along the section (least squares).
    The height is their distance, as in ISO 5436-1 for type A1 standards, positive towards the sensor.

    EvaluationError if the ranges overlap or contain fewer than three points.
    """
    if abs(second_mm - first_mm) < width_mm:
        raise EvaluationError(
            f"the ranges of {width_mm:g} mm about {first_mm:.3f} and {second_mm:.3f} mm overlap: give a smaller width, "
            "or pick places further apart"
        )
    along = section.along_mm
    sides = [np.flatnonzero(np.abs(along - place) <= width_mm / 2) for place in (first_mm, second_mm)]
    for side, place in zip(sides, (first_mm, second_mm), strict=True):
        if len(side) < _FEWEST_POINTS:
            raise EvaluationError(
                f"{len(side)} points within {width_mm / 2:g} mm of {place:.3f} mm along the section: expected at least "
                f"{_FEWEST_POINTS}; give a larger width"
            )
    used, on_first = np.concatenate(sides), np.repeat([1.0, 0.0], [len(side) for side in sides])
    middle = (first_mm + second_mm) / 2

    def measure(points: np.ndarray) -> dict[str, float]:
        place = (points - section.origin_mm) @ section.direction - middle
        table = np.column_stack([on_first, 1 - on_first, place])
        lower, upper, slope = np.linalg.lstsq(table, points[:, 2], rcond=None)[0]
        return {"height": float((lower - upper) / np.hypot(1.0, slope))}

    stated = _state_uncertainty(section.cloud, used, measure)
    return PickedMeasurement("step", measure(section.cloud.points_mm[used]), stated, len(used), 0)


FORMAT = "uwlts-measured-values"
VERSION = 1  # of the file format
MEASURED_ENDINGS = (".measured.html", ".measured.json", ".measured.csv")
"""Endings of page, list and table."""
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
        return MISSING if value_mm is None else format_to_scale(value_mm, self.expanded_mm or _SHOWN_MM)


class MeasuredValues(Description):
    """List of measured values. Changes return a new list, which remembers the one before for `undo`.

    ``edited`` is set if its file was edited by hand.
    """

    model_config = ConfigDict(extra="ignore")

    coverage_factor: float = 2.0  # that of `FigureUncertainty.expanded_mm`
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

    def save(self, path: str | Path, *, overwrite: bool = False) -> None:
        """Write the list as sealed JSON; OutputError if writing fails."""
        write_model(path, self, file_format=FORMAT, version=VERSION, overwrite=overwrite)


def read_measured(path: str | Path) -> MeasuredValues:
    """Read a list written by `MeasuredValues.save`; CaptureError if it cannot be read."""
    return read_model(path, MeasuredValues, file_format=FORMAT, version=VERSION, called="list of measured values")
