"""Published tables beside an experiment's figures: one row for each published value and each mean of a table."""

from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Self

import numpy as np
from matplotlib.figure import Figure
from pydantic import BaseModel, model_validator

from uwlts.model.library import find_description, read_table, validate_description
from uwlts.model.sensor import Description, Positive
from uwlts.pages.toolkit import BLUE, COLOURS, INK, RED, new_figure
from uwlts.storage.figure_table import FigureTable

MEAN = "mean"
"""Name of the mean over a table's scans."""
LARGEST_RATIO = 1.5
"""Means of the experiment should be within this factor of the published ones."""


class PublishedFigure(BaseModel, frozen=True):
    """A published value and that of every campaign.

    Attributes
    ----------
    table, method, scan, figure : str
        Table, and the method, scan and figure as in the experiment; the scan is "mean" for the mean of a table.
    published : float
        Published value, in mm unless the figure states another unit.
    measured : tuple of float
        Absolute values of the campaigns; errors for figures with a known true value.
    """

    table: str
    method: str
    scan: str
    figure: str
    published: float
    measured: tuple[float, ...]

    @property
    def mean(self) -> float:
        """Mean over the campaigns."""
        return float(np.mean(self.measured))

    @property
    def ratio(self) -> float:
        """Mean divided by the published value."""
        return self.mean / self.published

    def texts(self) -> tuple[str, ...]:
        """Return table, scan, figure, published value, mean, range of the campaigns, and ratio."""
        low, high = min(self.measured), max(self.measured)
        values = f"{self.published:.4g}", f"{self.mean:.4g}", f"{low:.4g} to {high:.4g}", f"{self.ratio:.2f}"
        return self.table, self.scan, self.figure, *values


class _Table(Description):
    """Published values of one method: lists with one value for each scan, by figure.

    With ``depth_mm``, each list has the largest value of all scans instead, in % of this depth.
    """

    name: str
    method: str
    scans: tuple[str, ...]
    figures: dict[str, tuple[Positive, ...]]
    means: bool = True
    depth_mm: Positive | None = None

    @model_validator(mode="after")
    def _check_lengths(self) -> Self:
        wanted = len(self.scans) if self.depth_mm is None else 1
        for figure, values in self.figures.items():
            if len(values) != wanted:
                raise ValueError(f"{figure} has {len(values)} values; expected {wanted}, as there are scans")
        return self

    def compare(self, measured: dict[tuple[str, str, str], dict[str, float]]) -> Iterator[PublishedFigure]:
        """Yield the rows for values by scan, method and figure, and then by campaign."""
        for figure, published in self.figures.items():
            about = {"table": self.name, "method": self.method, "figure": figure}
            found = [measured.get((scan, self.method, figure), {}) for scan in self.scans]
            known = [each for each in found if each]
            complete = [campaign for campaign in known[0] if all(campaign in each for each in known)] if known else []
            columns = [[each[campaign] for each in known] for campaign in complete]
            if self.depth_mm is not None:
                if complete and len(known) == len(found):
                    share = tuple(100 * max(values) / self.depth_mm for values in columns)
                    about["figure"] = f"largest {figure}, % of the depth"
                    yield PublishedFigure(**about, scan="all scans", published=published[0], measured=share)
                continue
            for scan, value, values in zip(self.scans, published, found, strict=True):
                if values:
                    yield PublishedFigure(**about, scan=scan, published=value, measured=tuple(values.values()))
            if self.means and complete and len(found) > 1:
                theirs = float(np.mean([value for value, values in zip(published, found, strict=True) if values]))
                ours = tuple(float(np.mean(values)) for values in columns)
                yield PublishedFigure(**about, scan=MEAN, published=theirs, measured=ours)


class Publication(Description):
    """Published tables; see ``scenes/references/thesis-tables.toml``."""

    title: str
    tables: tuple[_Table, ...]

    def compare(self, table: FigureTable) -> tuple[PublishedFigure, ...]:
        """Return a row for every published value that the experiment has measured, and the means of the tables."""
        measured: dict[tuple[str, str, str], dict[str, float]] = {}
        for row in table.rows:
            value = row.measured_mm if row.error_mm is None else row.error_mm
            measured.setdefault((row.scan, row.method, row.figure), {})[row.campaign] = abs(value)
        return tuple(row for each in self.tables for row in each.compare(measured))


def load_published(name_or_path: str | Path) -> Publication:
    """Read published tables by name or path; DescriptionError if the file contains none."""
    path = find_description(name_or_path, "references")
    return validate_description(Publication, read_table(path, "references"), str(path))


def select_means(rows: Sequence[PublishedFigure]) -> list[PublishedFigure]:
    """Return the means over the scans of the tables, the main results of a reproduction."""
    return [row for row in rows if row.scan == MEAN]


def state_agreement(rows: Sequence[PublishedFigure]) -> str:
    """Return how many means of the tables are close to the published ones, as a sentence."""
    means = select_means(rows)
    close = sum(1 / LARGEST_RATIO <= row.ratio <= LARGEST_RATIO for row in means)
    return (
        f"{close} of {len(means)} means over the positions are within a factor of {LARGEST_RATIO} of the published ones"
    )


def draw_means(rows: Sequence[PublishedFigure]) -> Figure:
    """Draw the means of the tables: bars with the campaigns' range, blue in water, red in air; diamonds published."""
    shown = select_means(rows)
    figure, (axes,) = new_figure(9.0, 0.8 + 0.25 * len(shown))
    places = np.arange(len(shown))
    colours = [RED if row.table.endswith("in air") else BLUE for row in shown]
    axes.barh(places, [row.mean for row in shown], height=0.55, color=colours, alpha=0.75)
    axes.hlines(places, [min(row.measured) for row in shown], [max(row.measured) for row in shown], color=INK)
    axes.plot([row.published for row in shown], places, "D", color=COLOURS[1], markeredgecolor=INK)
    axes.set_yticks(places, [f"{row.table}: {row.figure}" for row in shown])
    axes.invert_yaxis()
    axes.set_xlim(left=0.0)
    axes.set_xlabel("mean of the campaigns / mm")
    return figure
