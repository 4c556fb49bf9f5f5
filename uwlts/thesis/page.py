"""The reproduction's report: one HTML page that holds everything it shows and asks nothing of the network."""

from collections.abc import Sequence
from itertools import groupby
from pathlib import Path
from typing import Any

from markupsafe import Markup

import uwlts
from uwlts.capture import Capture
from uwlts.cloud import read_cloud
from uwlts.report import plot
from uwlts.report.page_toolkit import png_data_uri, render_page
from uwlts.report.pictures import stripe_picture, stripe_view
from uwlts.thesis.differences import differences, far_off
from uwlts.thesis.figures import (
    comparison_figure,
    line_figure,
    polynomials_figures,
    window_distance_figure,
)
from uwlts.thesis.folder import campaign_folders
from uwlts.thesis.methods import FORGOTTEN
from uwlts.thesis.published import Published
from uwlts.thesis.tables import LARGEST_RATIO, TableRow, headline_rows

_MOST_COLUMNS = 3
_TITLES = {
    "Table 2": "spheres by the polynomials",
    "Table 3": "planes by the polynomials",
    "Table 4": "window distance by the step images used",
    "Table 5": "one and two refractions",
    "Table 6": "spheres by the proposed method",
    "Table 7": "planes by the proposed method",
    "Table 8": "largest sphere spacing error as a share of the volume's depth",
    "Table 9": "uncertainty budget of the sphere spacing in water",
    "Figure 58": "residual of the polynomials Z(v)",
    "Figure 66": "objects without calibrated values: spread about the true surface after a best fit",
    "Figure 67": "line length on the pipe",
    "Experiment: window forgotten in air": "scans through the window by a calibration made without it",
    "Experiment: thesis, mean of 5x5": "a plain mean for LabVIEW's low-pass filter",
    "Experiment: thesis, fit over 3 px": "a narrower quadratic",
    "Experiment: thesis, fit over 7 px": "a wider quadratic",
    "Experiment: no point left out": "ranges over all points",
}


def report_page(folder: Path, results: Sequence[dict[str, Any]], rows: Sequence[TableRow], published: Published) -> str:
    """The page as text, with pictures from the first campaign in the folder."""
    first = results[0]
    z_of_v, y_of_z = polynomials_figures(first)
    headline = headline_rows(rows)
    shown = [
        row
        for row in rows
        if row.table == "Figure 66" and row.quantity == "STD" and row.row.endswith("thesis image processing")
        and FORGOTTEN not in row.row
    ]  # fmt: skip
    return render_page(
        "uwlts.thesis",
        "template.html.j2",
        published=published.title,
        campaigns=len(results),
        headline=headline,
        far_off=far_off(headline),
        far=LARGEST_RATIO,
        tables=[
            (name, _TITLES.get(name, ""), *_folded(list(group))) for name, group in groupby(rows, lambda row: row.table)
        ],
        differences=differences(rows),
        figures=[
            ("Figure 66", "Means over the positions: bars are ours (blue in water, red in air), the line spans the "
             "campaigns, diamonds are the thesis's.", Markup(comparison_figure([*headline, *shown]))),
            ("Figure 45", "Points on a step for several window distances.", Markup(window_distance_figure(first))),
            ("Figure 58", "Polynomials Z(v).", Markup(z_of_v)),
            ("Figure 59", "Polynomials Y(Z).", Markup(y_of_z)),
        ]
        + ([("Figure 67", "Stripe on a 300 mm pipe.", Markup(line_figure(first)))] if first["line_profiles"] else []),
        monte_carlo=_monte_carlo(results),
        failures=[
            (number, m) for number, result in enumerate(results) for m in result["measurements"] if m["failure"]
        ],
        pictures=_pictures(folder),
        version=uwlts.__version__,
    )  # fmt: skip


def _folded(rows: Sequence[TableRow]) -> tuple[list[str], list[tuple[str, list[TableRow | None]]]]:
    """A table's quantities side by side: their names, and by row one value for each of them."""
    quantities = list(dict.fromkeys(row.quantity for row in rows))
    if len(quantities) > _MOST_COLUMNS:
        return ["value"], [(f"{row.row}, {row.quantity}", [row]) for row in rows]
    values = {(row.row, row.quantity): row for row in rows}
    names = dict.fromkeys(row.row for row in rows)
    return quantities, [(name, [values.get((name, quantity)) for quantity in quantities]) for name in names]


def _monte_carlo(results: Sequence[dict[str, Any]]) -> dict[str, Any] | None:
    """How often the Monte-Carlo interval and the budget's hold the truth."""
    trials = [each for result in results for each in result["monte_carlo"]]
    if not trials:
        return None
    held = [
        abs(each["observed_mm"]) <= result["budget"]["expanded"]
        for result in results
        if "expanded" in result["budget"]
        for each in result["monte_carlo"]
    ]
    return {
        "intervals": [
            (number, each) for number, result in enumerate(results) for each in result["monte_carlo"]
        ],
        "held": sum(each["contains_truth"] for each in trials),
        "budget_held": sum(held),
        "count": len(trials),
    }  # fmt: skip


def _pictures(folder: Path) -> list[tuple[str, str, str]]:
    """Name, stripe and cloud of the objects of the first campaign that have a coloured cloud."""
    campaign = campaign_folders(folder)[0]
    found = []
    for cloud in sorted((campaign.path / "clouds").glob("*-proposed.ply")):
        name = cloud.stem.removesuffix("-proposed")
        with Capture(campaign.path / f"{name}.h5") as capture:
            view = stripe_view(capture)
        stripe = "" if view is None else png_data_uri(stripe_picture(view))
        found.append((name, stripe, png_data_uri(plot.cloud(read_cloud(cloud)).figure)))
    return found
