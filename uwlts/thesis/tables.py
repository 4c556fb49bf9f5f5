"""The thesis's published tables, and ours beside them: one row for every value, over all campaigns."""

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from itertools import product
from operator import attrgetter
from pathlib import Path
from typing import Any

import numpy as np

from uwlts.model.errors import DescriptionError
from uwlts.model.library import find, read_table
from uwlts.thesis.campaign import MEDIA, STEP_PLACES
from uwlts.thesis.measurements import FORGOTTEN, OURS, POLYNOMIALS, PROPOSED, SINGLE, THESIS, TWO, VARIANTS
from uwlts.thesis.results import CampaignResults, Measurement


@dataclass(frozen=True)
class Published:
    """Published values by the names of the file; see ``scenes/references/thesis-tables.toml``."""

    title: str
    content: dict[str, Any]

    def value(self, *keys: str | int) -> float | None:
        """The value at a path of keys and list places, None where nothing was published."""
        found: Any = self.content
        for key in keys:
            try:
                found = found[key]
            except (KeyError, IndexError, TypeError):
                return None
        return float(found) if isinstance(found, int | float) else None

    def positions(self, thing: str) -> list[str]:
        """Placements of the spheres or the plane in the order of the published lists."""
        return list(self.content["positions"][thing])


def load_published(name_or_path: str | Path = "thesis-tables") -> Published:
    """Published tables by name or path; DescriptionError where the file holds none."""
    path = find(name_or_path, "references")
    table = read_table(path, "references")
    if not isinstance(table.get("positions"), dict) or not {"spheres", "plane"} <= table["positions"].keys():
        raise DescriptionError(f"{path} holds no published tables: it needs [positions] with spheres and plane")
    return Published(str(table.pop("title", path.stem)), table)


MEAN = "mean"
LARGEST_RATIO = 1.5
"""Our means should be within this factor of the published ones."""


@dataclass(frozen=True)
class TableRow:
    """One value of a table: published, and ours in every campaign; errors count without their sign."""

    table: str
    row: str
    quantity: str
    published: float | None
    ours: tuple[float, ...]

    @property
    def mean(self) -> float | None:
        """Mean of ours over the campaigns."""
        return float(np.mean(self.ours)) if self.ours else None

    @property
    def ratio(self) -> float | None:
        """Our mean over the published value."""
        return self.mean / self.published if self.published and self.mean is not None else None

    def as_dict(self) -> dict[str, str | float | None]:
        """As the summary file holds it."""
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
    """Rows of all tables from the results of campaigns."""
    spheres, planes = ("spheres", ("PE", "STD", "SSE")), ("plane", ("RE", "STD"))
    seen = _Seen(results, published)
    rows = [
        *seen.objects("Table 2", *spheres, POLYNOMIALS, THESIS),
        *seen.objects("Table 3", *planes, POLYNOMIALS, THESIS),
        *_window(results, published),
        *_refractions(seen),
        *seen.objects("Table 6", *spheres, PROPOSED, THESIS),
        *seen.objects("Table 7", *planes, PROPOSED, THESIS),
        *_shares(seen),
        *_budget(results, published),
        *_line(results, published),
    ]
    for method in (PROPOSED, POLYNOMIALS, TWO, SINGLE):
        table = f"Our stripe centre, {method}"
        rows += [*seen.objects(table, *spheres, method, OURS), *seen.objects(table, *planes, method, OURS)]
    rows += seen.objects("Experiment: window forgotten in air", "spheres", ("SSE",), FORGOTTEN, THESIS)
    for processing in VARIANTS:
        rows += seen.objects(f"Experiment: {processing}", "spheres", ("PE", "STD"), PROPOSED, processing)
    for thing, name in (("spheres", "PE of all points"), ("plane", "RE of all points")):
        rows += seen.objects("Experiment: no point left out", thing, (name,), PROPOSED, THESIS)
    return [*rows, *_free_forms(seen)]


def headline_rows(rows: Sequence[TableRow]) -> list[TableRow]:
    """The means over the positions of Tables 2, 3, 6 and 7, by which a reproduction is judged."""
    return [
        row for row in rows if row.table in ("Table 2", "Table 3", "Table 6", "Table 7") and f", {MEAN}," in row.row
    ]


def _collected(
    results: Sequence[CampaignResults], value: Callable[[CampaignResults], float | None]
) -> tuple[float, ...]:
    """A value of every campaign that has it, without its sign."""
    found = (value(result) for result in results)
    return tuple(abs(number) for number in found if number is not None)


def _with_mean(rows: list[TableRow], name: str) -> Iterator[TableRow]:
    """Rows of one quantity and their mean over the positions that were measured, campaign by campaign."""
    yield from rows
    theirs = [row.published for row in rows if row.ours]
    published = [value for value in theirs if value is not None]
    complete = [row.ours for row in rows if row.ours]
    counts = {len(values) for values in complete}
    if complete and len(counts) == 1:
        yield TableRow(
            rows[0].table,
            name,
            rows[0].quantity,
            float(np.mean(published)) if len(published) == len(theirs) else None,
            tuple(np.mean(complete, axis=0).tolist()),
        )


def _key(found: Measurement) -> tuple[str, str, str, str, str]:
    return found.thing, found.placement, found.medium, found.method, found.processing


@dataclass(frozen=True)
class _Seen:
    """All campaigns' measurements, looked up by what was measured and how."""

    results: Sequence[CampaignResults]
    published: Published

    def figures(
        self, thing: str, place: str, medium: str, method: str, processing: str, name: str
    ) -> tuple[float, ...]:
        """A figure of every campaign that has it, without its sign."""
        wanted = thing, place, medium, method, processing
        return tuple(
            abs(found.figures_mm[name])
            for result in self.results
            for found in result.measurements
            if _key(found) == wanted and name in found.figures_mm
        )

    def objects(self, table: str, thing: str, names: Sequence[str], method: str, processing: str) -> Iterator[TableRow]:
        """Rows of a thing's positions in both media and their means; published values are those of the same method."""
        source = method if method in (PROPOSED, POLYNOMIALS) else PROPOSED
        for medium, name in product(MEDIA, names):
            rows = []
            for number, place in enumerate(self.published.positions(thing)):
                theirs = self.published.value(thing, source, medium, name.removesuffix(" of all points"), number)
                ours = self.figures(thing, place, medium, method, processing, name)
                rows.append(TableRow(table, f"{thing}, {place}, {medium}", name, theirs, ours))
            if any(row.ours for row in rows):
                yield from _with_mean(rows, f"{thing}, {MEAN}, {medium}")


def _window(results: Sequence[CampaignResults], published: Published) -> Iterator[TableRow]:
    sets = [(f"{place} {n}", (place, n - 1)) for place in STEP_PLACES for n in (1, 2, 3)]
    sets += [(place, (place, 3)) for place in STEP_PLACES] + [("all", ("all",))]
    for quantity, key, source in (
        ("window distance", attrgetter("distance_mm"), "window"),
        ("mean SSE", attrgetter("mean_sse_mm"), "window_sse"),
    ):
        for name, path in sets:
            ours = _collected(results, lambda r, n=name, k=key: k(r.window[n]) if n in r.window else None)
            yield TableRow("Table 4", f"step images: {name}", quantity, published.value(source, *path), ours)
    ours = _collected(results, lambda r: r.two_refractions_distance_mm)
    yield TableRow(
        "Table 4", "two refractions, all", "window distance", published.value("window", "two_refractions"), ours
    )


def _refractions(seen: _Seen) -> Iterator[TableRow]:
    for (key, method), name in product((("one", PROPOSED), ("two", TWO)), ("STD", "SSE")):
        rows = [
            TableRow(
                "Table 5",
                f"{key} refraction{'s' if key == 'two' else ''}, {place}",
                name,
                seen.published.value("refractions", key, name, number),
                seen.figures("spheres", place, "water", method, THESIS, name),
            )
            for number, place in enumerate(seen.published.positions("spheres"))
        ]
        yield from _with_mean(rows, f"{key} refraction{'s' if key == 'two' else ''}, {MEAN}")


def _shares(seen: _Seen) -> Iterator[TableRow]:
    """The thesis's percentages are those of the largest error, though it calls them the division of the error."""
    for medium, method in product(MEDIA, (POLYNOMIALS, PROPOSED)):
        places = seen.published.positions("spheres")
        found = [seen.figures("spheres", place, medium, method, THESIS, "SSE") for place in places]
        depth = seen.published.value("depth_mm", medium)
        complete = [errors for errors in found if len(errors) == len(seen.results)]
        shares = tuple((100 / depth * np.max(complete, axis=0)).tolist()) if depth and complete else ()
        theirs = seen.published.value("share_percent", medium, method)
        yield TableRow("Table 8", f"{method}, {medium}", "largest SSE over depth, %", theirs, shares)


def _budget(results: Sequence[CampaignResults], published: Published) -> Iterator[TableRow]:
    names = list(published.content.get("budget", {}))
    for name in names:
        ours = _collected(results, lambda r, n=name: r.budget.get(n))
        yield TableRow("Table 9", name.replace("_", " "), _unit_of(name), published.value("budget", name), ours)


def _unit_of(name: str) -> str:
    known = {"degrees_of_freedom": "effective", "expanded": "U, 95 %", "correction": "C", "largest_error": "C + U"}
    return known.get(name, "u")


def _line(results: Sequence[CampaignResults], published: Published) -> Iterator[TableRow]:
    theirs = {"width": published.value("line", "length_mm"), "height": None}
    for side, length in theirs.items():
        ours = _collected(results, lambda r, s=side: r.line_profiles[s].length_mm if s in r.line_profiles else None)
        yield TableRow(
            "Figure 67", f"300 mm pipe at the stand-off, stripe along the {side}", "line length", length, ours
        )
    for medium in MEDIA:
        ours = _collected(results, lambda r, m=medium: r.polynomials[m].residual_mm)
        theirs_mm = published.value("line", "polynomial_residual_mm")
        yield TableRow("Figure 58", f"Z(v) in {medium}", "residual", theirs_mm, ours)


def _free_forms(seen: _Seen) -> Iterator[TableRow]:
    """STD of the objects of Figure 66 whose values the thesis draws and does not print."""
    keys = {
        _key(found)
        for result in seen.results
        for found in result.measurements
        if found.thing in ("pipe", "head", "weld")
    }
    for thing, place, medium, method, processing in sorted(keys):
        for name in ("STD", "diameter error") if thing == "pipe" else ("STD",):
            row = f"{thing}, {medium}, {method}, {processing} image processing"
            yield TableRow("Figure 66", row, name, None, seen.figures(thing, place, medium, method, processing, name))
