"""Result of an experiment: its table of figures, probabilities of detection, and page."""

from collections.abc import Mapping, Sequence
from itertools import groupby
from pathlib import Path

import numpy as np
from markupsafe import Markup
from matplotlib.figure import Figure
from pydantic import BaseModel

from twin.experiments.detection import ProbabilityOfDetection
from twin.experiments.figures import PublishedFigure, draw_means, select_means, state_agreement
from twin.scene.campaign import Understated
from uwlts.files.json_files import write_model
from uwlts.model.short_text import Brief, align_columns
from uwlts.pages.cloud_display import choose_points
from uwlts.pages.toolkit import (
    BLUE,
    COLOURS,
    FigureCollector,
    figure_svg,
    legend_below,
    new_figure,
    render_page,
    write_page,
)
from uwlts.storage.cloud_files import read_cloud
from uwlts.storage.figure_table import FigureErrors, FigureTable, format_errors

RESULT = "experiment.json"
PAGE = "experiment.html"
_MOST_POINTS = 12_000
"""Largest number of points in a cloud of the page, which take about 60 kB."""
_PUBLISHED_HEAD = "table", "scan", "figure", "published", "reproduced", "range of the campaigns", "ratio"
_DETECTION_HEAD = "flaw", "method", "width / mm", "found", "false", "a90 / mm", "a90/95", "limits"


class ExperimentResult(Brief, BaseModel, frozen=True):
    """Errors and stated uncertainties of a sensor in rendered campaigns, and its probabilities of detection.

    Attributes
    ----------
    campaign, sensor, as_built : str
        Names or paths of the descriptions.
    water : str or float or None
        Water of all scenes, by its name or turbidity; None for that of the scenes or the sensor.
    seeds : tuple of int
        Seeds of the campaigns.
    table : FigureTable
        All figures, one row for each of every campaign.
    conditions : dict
        Where each statement was checked, by scan: scene, place, profiles and water.
    detections : tuple of ProbabilityOfDetection
        Probabilities of detection, by kind and width of the flaws.
    understated : tuple of Understated
        Deviations of the campaign that are larger than the sensor states: U does not contain them.
    published : tuple of PublishedFigure
        Published values that the experiment reproduces.
    """

    campaign: str
    sensor: str
    as_built: str
    water: str | float | None = None
    seeds: tuple[int, ...]
    table: FigureTable
    conditions: dict[str, str]
    detections: tuple[ProbabilityOfDetection, ...] = ()
    understated: tuple[Understated, ...] = ()
    published: tuple[PublishedFigure, ...] = ()

    def verdict(self) -> str:
        """Return the main result as a sentence."""
        if self.published:
            return state_agreement(self.published)
        if np.isnan(covered := self.table.covered_share()):
            return "no errors to judge"
        share = f"{100 * covered:.0f} % of all errors are within U"
        doubted = ", ".join(each.quantity for each in self.understated)
        return f"{share}, which is too small: the sensor understates {doubted}" if doubted else share

    def lines(self) -> list[str]:
        """Return the result as lines of text."""
        if self.published:
            means = [each.texts() for each in select_means(self.published)]
            return [*align_columns([_PUBLISHED_HEAD, *means], right=range(3, 7)), self.verdict()]
        lines = [
            f"sensor {self.sensor}, built as {self.as_built}; campaigns {self.campaign}: {len(self.seeds)}",
            *format_errors(self.errors()),
            self.verdict(),
            "U: expanded uncertainty (k = 2) by propagation; found: twice the rms error of the campaigns",
            *(f"understated: {each.text()}" for each in self.understated),
        ]
        if self.detections:
            lines += align_columns([_DETECTION_HEAD, *map(_make_detection_row, self.detections)], right=range(2, 7))
            lines += ["a90: depth found with 90 % probability; a90/95: its upper bound with 95 % confidence"]
        return [*lines, "valid for this sensor, and for imperfections as in the campaign, where it was checked:"] + [
            f"  {scan}: {text}" for scan, text in self.conditions.items()
        ]

    def errors(self) -> tuple[FigureErrors, ...]:
        """Return the errors of every figure of every scan; with several calibrations, those of each object together."""
        return self.table.pooled_errors() if len(self._list_methods()) > 1 else self.table.errors()

    def _list_methods(self) -> list[str]:
        return list(dict.fromkeys(row.method for row in self.table.rows))

    def _list_mean_values(self) -> list[tuple[str, ...]]:
        """Return scan, or object with several calibrations, then calibration, figure and mean without a true value."""
        pooled = len(self._list_methods()) > 1
        groups: dict[tuple[str, ...], list[float]] = {}
        for row in self.table.rows:
            if row.true_mm is None:
                key = row.pooled_key() if pooled else (row.scan, row.method, row.figure)
                groups.setdefault(key, []).append(row.measured_mm)
        return [(*key, f"{np.mean(values):.4f}") for key, values in groups.items()]

    def errors_figure(self) -> Figure:
        """Return a chart: bars for the stated uncertainties, and a dot for the error of every measurement."""
        methods, groups = self._list_methods(), self.errors()
        places = [len(list(group)) for _, group in groupby(groups, lambda each: (each.scan, each.name))]
        figure, (axes,) = new_figure(8.0, 1.2 + 0.3 * len(groups))
        for place, each in enumerate(groups):
            colour = COLOURS[methods.index(each.method) % len(COLOURS)]
            axes.barh(place, 2 * each.stated_mm, left=-each.stated_mm, height=0.6, color=colour, alpha=0.2)
            axes.plot(each.errors_mm, [place] * len(each.errors_mm), "o", color=colour, markersize=4, label=each.method)
        axes.axvline(0.0, color="black", linewidth=0.5)
        firsts = np.cumsum([0, *places[:-1]]) if places else []
        axes.set_yticks(firsts, [f"{groups[first].scan}, {groups[first].name}" for first in firsts])
        axes.invert_yaxis()
        axes.set_xlabel("measured minus true value, mm")
        if len(methods) > 1:
            legend_below(figure)
        return figure

    def write(self, folder: Path, clouds: Mapping[str, Path] | None = None) -> None:
        """Write experiment.json and experiment.html into a folder; OutputError if that fails.

        ``clouds`` are files of clouds for the page, by name.
        """
        write_model(folder / RESULT, self, file_format="twin-experiment", version=1, overwrite=True)
        write_page(folder / PAGE, self._render(clouds or {}), overwrite=True)

    def _render(self, clouds: Mapping[str, Path]) -> str:
        """Return a page with the uncertainties and errors, the probabilities of detection, and clouds."""
        count, collected, shown = len(self.seeds), FigureCollector(), []
        for name, path in clouds.items():
            cloud = read_cloud(path)
            points = choose_points(cloud.points_mm, "deviation", cloud.field_values("deviation"), most=_MOST_POINTS)
            shown.append((name, collected.add_cloud(*points)))
        return render_page(
            "twin.experiments",
            "page.html.j2",
            interactive=collected,
            sensor=Path(self.sensor).stem,
            verdict=f"{self.verdict()}, in {count} rendered campaign{'s' if count > 1 else ''}.",
            result=self,
            figure=figure_svg(draw_means(self.published) if self.published else self.errors_figure()),
            published_head=_PUBLISHED_HEAD,
            published=[each.texts() for each in self.published],
            rows=[each.texts() for each in self.errors()],
            values=self._list_mean_values(),
            clouds=shown,
            curves=_draw_curves(self.detections) if self.detections else None,
            detection_head=_DETECTION_HEAD,
            detections=[*map(_make_detection_row, self.detections)],
        )


def _make_detection_row(each: ProbabilityOfDetection) -> tuple[str, ...]:
    """Return the cells of a probability of detection."""
    depths = ("-" if depth is None else f"{depth:.3f}" for depth in (each.a90_mm, each.a90_95_mm))
    found = f"{sum(each.found)} of {len(each.found)}"
    return each.flaw, each.method, f"{each.width_mm:g}", found, str(each.false_calls), *depths, each.limits()


def _draw_curves(detections: Sequence[ProbabilityOfDetection]) -> Markup:
    """Draw the probability of detection against the depth, with all hits and misses, and a90/95 as dots."""
    from matplotlib.ticker import LogLocator

    figure, panels = new_figure(8.0, 2.6 * len(detections), rows=len(detections))
    for axes, each in zip(panels, detections, strict=True):
        depth = np.array(each.depths_mm)
        shown = np.geomspace(depth.min(), depth.max(), 200)
        axes.semilogx(shown, each.probability(shown), color=BLUE)
        axes.plot(depth, np.where(each.found, 1.0, 0.0), "|", color=BLUE)
        if each.a90_95_mm is not None:
            axes.plot([each.a90_95_mm], [0.9], "o", color=BLUE)
        axes.axhline(0.9, color="black", linewidth=0.5)
        axes.set_ylim(-0.05, 1.05)
        axes.xaxis.set_major_locator(LogLocator(subs=(1.0, 2.0, 5.0)))
        axes.xaxis.set_major_formatter("{x:g}")
        axes.xaxis.set_minor_formatter("")
        axes.set_title(f"{each.flaw}s, {each.width_mm:g} mm wide")
        axes.set_ylabel("probability of detection")
    panels[-1].set_xlabel("depth, mm")
    return figure_svg(figure)
