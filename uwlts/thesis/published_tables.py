"""The thesis's published tables with our values: one row for every value, over all campaigns."""

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from itertools import product
from operator import attrgetter
from pathlib import Path
from typing import Any

import numpy as np

from uwlts.errors import DescriptionError
from uwlts.model.library import find_description, read_table
from uwlts.thesis.campaign_folder import MEDIA, STEP_PLACES
from uwlts.thesis.measurements import FORGOTTEN, OURS, POLYNOMIALS, PROPOSED, SINGLE, THESIS, TWO, VARIANTS
from uwlts.thesis.results import CampaignResults


@dataclass(frozen=True)
class Published:
    """Published values with the names of the file; see ``scenes/references/thesis-tables.toml``."""

    title: str
    content: dict[str, Any]

    def value(self, *keys: str | int) -> float | None:
        """Return the value at a path of keys and list indices; None if nothing was published."""
        found: Any = self.content
        for key in keys:
            try:
                found = found[key]
            except (KeyError, IndexError, TypeError):
                return None
        return float(found) if isinstance(found, int | float) else None

    def positions(self, thing: str) -> list[str]:
        """Return placements of the spheres or the plane in the order of the published lists."""
        return list(self.content["positions"][thing])


def load_published(name_or_path: str | Path = "thesis-tables") -> Published:
    """Read published tables by name or path; DescriptionError if the file contains none."""
    path = find_description(name_or_path, "references")
    table = read_table(path, "references")
    positions = table.get("positions")
    if not isinstance(positions, dict) or not {"spheres", "plane"} <= positions.keys():
        raise DescriptionError(f"{path} contains no published tables; expected [positions] with spheres and plane")
    return Published(str(table.pop("title", path.stem)), table)


MEAN = "mean"
LARGEST_RATIO = 1.5
"""Our means should be within this factor of the published ones."""


@dataclass(frozen=True)
class TableRow:
    """Value of a table: published, and ours in every campaign; errors are absolute values."""

    table: str
    row: str
    quantity: str
    published: float | None
    ours: tuple[float, ...]

    @property
    def mean(self) -> float | None:
        """Mean of our values over the campaigns."""
        return float(np.mean(self.ours)) if self.ours else None

    @property
    def ratio(self) -> float | None:
        """Our mean divided by the published value."""
        return self.mean / self.published if self.published and self.mean is not None else None

    def as_dict(self) -> dict[str, str | float | None]:
        """Return the row as in the summary file."""
        return {
            "table": self.table,
            "row": self.row,
            "quantity": self.quantity,
            "published": self.published,
            "ours_mean": self.mean,
            "ours_min": min(self.ours, default=None),
            "ours_max": max(self.ours, default=None),
        }


def all_rows(results: Sequence[CampaignResults], published: Published) -> list[TableRow]:
    """Return the rows of all tables from the results of campaigns."""
    spheres, planes = ("spheres", ("PE", "STD", "SSE")), ("plane", ("RE", "STD"))
    tables = _Tables(results, published)
    rows = [
        *tables.objects("Table 2", *spheres, POLYNOMIALS, THESIS),
        *tables.objects("Table 3", *planes, POLYNOMIALS, THESIS),
        *tables.window(),
        *tables.refractions(),
        *tables.objects("Table 6", *spheres, PROPOSED, THESIS),
        *tables.objects("Table 7", *planes, PROPOSED, THESIS),
        *tables.shares(),
        *tables.budget(),
        *tables.lines(),
    ]
    for method in (PROPOSED, POLYNOMIALS, TWO, SINGLE):
        table = f"Our stripe centre, {method}"
        rows += [*tables.objects(table, *spheres, method, OURS), *tables.objects(table, *planes, method, OURS)]
    rows += tables.objects("Experiment: window forgotten in air", "spheres", ("SSE",), FORGOTTEN, THESIS)
    for processing in VARIANTS:
        rows += tables.objects(f"Experiment: {processing}", "spheres", ("PE", "STD"), PROPOSED, processing)
    for thing, name in (("spheres", "PE of all points"), ("plane", "RE of all points")):
        rows += tables.objects("Experiment: no point left out", thing, (name,), PROPOSED, THESIS)
    return [*rows, *tables.free_forms()]


def headline_rows(rows: Sequence[TableRow]) -> list[TableRow]:
    """Return the means over the positions of Tables 2, 3, 6 and 7, the main results of a reproduction."""
    return [
        row for row in rows if row.table in ("Table 2", "Table 3", "Table 6", "Table 7") and f", {MEAN}," in row.row
    ]


_KEY = attrgetter("thing", "placement", "medium", "method", "processing")


def _sizes(values: Iterable[float | None]) -> tuple[float, ...]:
    """Return absolute values without None."""
    return tuple(abs(value) for value in values if value is not None)


def _with_mean(rows: list[TableRow], name: str, sizes: list[list[float | None]]) -> Iterator[TableRow]:
    """Yield rows of one quantity, and its mean over the measured positions, for each campaign that has all of them.

    ``sizes`` are those of each row by campaign.
    """
    yield from rows
    measured = [number for number, row in enumerate(rows) if row.ours]
    published = [each for number in measured if (each := rows[number].published) is not None]
    mean = float(np.mean(published)) if measured and len(published) == len(measured) else None
    campaigns = zip(*(sizes[number] for number in measured), strict=True)
    ours = [[each for each in campaign if each is not None] for campaign in campaigns]
    complete = _sizes(float(np.mean(each)) for each in ours if len(each) == len(measured))
    if complete:
        yield TableRow(rows[0].table, name, rows[0].quantity, mean, complete)


@dataclass(frozen=True)
class _Tables:
    """Rows of the tables from all campaigns' results."""

    results: Sequence[CampaignResults]
    published: Published

    def figures(self, *key: str, name: str) -> list[float | None]:
        """Return the size of a figure by campaign, for thing, place, medium, method and image processing."""
        found = [{_KEY(measured): measured.figures_mm for measured in result.measurements} for result in self.results]
        values = [figures[key].get(name) if key in figures else None for figures in found]
        return [None if value is None else abs(value) for value in values]

    def objects(self, table: str, thing: str, names: Sequence[str], method: str, processing: str) -> Iterator[TableRow]:
        """Yield rows of a thing's positions in both media and their means, with the values published for the method."""
        source = method if method in (PROPOSED, POLYNOMIALS) else PROPOSED
        for medium, name in product(MEDIA, names):
            rows, sizes = [], []
            for number, place in enumerate(self.published.positions(thing)):
                theirs = self.published.value(thing, source, medium, name.removesuffix(" of all points"), number)
                sizes.append(self.figures(thing, place, medium, method, processing, name=name))
                rows.append(TableRow(table, f"{thing}, {place}, {medium}", name, theirs, _sizes(sizes[-1])))
            if any(row.ours for row in rows):
                yield from _with_mean(rows, f"{thing}, {MEAN}, {medium}", sizes)

    def window(self) -> Iterator[TableRow]:
        sets = {f"{place} {n}": (place, n - 1) for place in STEP_PLACES for n in (1, 2, 3)}
        sets |= {place: (place, 3) for place in STEP_PLACES} | {"all": ("all",)}
        columns = ("window distance", "distance_mm", "window"), ("mean SSE", "mean_sse_mm", "window_sse")
        for (quantity, attribute, source), (name, path) in product(columns, sets.items()):
            ours = _sizes(getattr(result.window.get(name), attribute, None) for result in self.results)
            yield TableRow("Table 4", f"step images: {name}", quantity, self.published.value(source, *path), ours)
        ours = _sizes(result.two_refractions_distance_mm for result in self.results)
        theirs = self.published.value("window", "two_refractions")
        yield TableRow("Table 4", "two refractions, all", "window distance", theirs, ours)

    def refractions(self) -> Iterator[TableRow]:
        cases = ("one", "one refraction", PROPOSED), ("two", "two refractions", TWO)
        for (key, title, method), name in product(cases, ("STD", "SSE")):
            rows, sizes = [], []
            for number, place in enumerate(self.published.positions("spheres")):
                theirs = self.published.value("refractions", key, name, number)
                sizes.append(self.figures("spheres", place, "water", method, THESIS, name=name))
                rows.append(TableRow("Table 5", f"{title}, {place}", name, theirs, _sizes(sizes[-1])))
            yield from _with_mean(rows, f"{title}, {MEAN}", sizes)

    def shares(self) -> Iterator[TableRow]:
        """Yield the largest errors relative to the depth; the thesis's text describes them as mean errors."""
        places = self.published.positions("spheres")
        for medium, method in product(MEDIA, (POLYNOMIALS, PROPOSED)):
            found = [self.figures("spheres", place, medium, method, THESIS, name="SSE") for place in places]
            depth = self.published.value("depth_mm", medium)
            complete = [_sizes(errors) for errors in found if None not in errors]
            shares = tuple((100 / depth * np.max(complete, axis=0)).tolist()) if depth and complete else ()
            theirs = self.published.value("share_percent", medium, method)
            yield TableRow("Table 8", f"{method}, {medium}", "largest SSE over depth, %", theirs, shares)

    def budget(self) -> Iterator[TableRow]:
        known = {"degrees_of_freedom": "effective", "expanded": "U, 95 %", "correction": "C", "largest_error": "C + U"}
        for name in self.published.content.get("budget", {}):
            ours = _sizes(result.budget.get(name) for result in self.results)
            theirs = self.published.value("budget", name)
            yield TableRow("Table 9", name.replace("_", " "), known.get(name, "u"), theirs, ours)

    def lines(self) -> Iterator[TableRow]:
        for side, theirs in (("width", self.published.value("line", "length_mm")), ("height", None)):
            ours = _sizes(getattr(result.line_profiles.get(side), "length_mm", None) for result in self.results)
            row = f"300 mm pipe at the stand-off, stripe along the {side}"
            yield TableRow("Figure 67", row, "line length", theirs, ours)
        theirs = self.published.value("line", "polynomial_residual_mm")
        for medium in MEDIA:
            ours = _sizes(result.polynomials[medium].residual_mm for result in self.results)
            yield TableRow("Figure 58", f"Z(v) in {medium}", "residual", theirs, ours)

    def free_forms(self) -> Iterator[TableRow]:
        """Yield STD of the objects of Figure 66, whose values the thesis plots but does not print."""
        keys = {_KEY(measured) for result in self.results for measured in result.measurements}
        for key in sorted(keys):
            thing, _, medium, method, processing = key
            names = {"pipe": ("STD", "diameter error"), "head": ("STD",), "weld": ("STD",)}.get(thing, ())
            for name in names:
                row = f"{thing}, {medium}, {method}, {processing} image processing"
                yield TableRow("Figure 66", row, name, None, _sizes(self.figures(*key, name=name)))
