"""Report of a reproduction: summary.json, tables.csv, summary.md and report.html."""

import csv
import io
import json
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from itertools import groupby
from pathlib import Path

import uwlts
from uwlts.model.errors import DescriptionError
from uwlts.report import plot
from uwlts.report.page_toolkit import png_data_uri, render_page, svg_of
from uwlts.report.pictures import stripe_picture, stripe_view
from uwlts.storage.capture import Capture
from uwlts.storage.cloud import read_cloud
from uwlts.storage.files import refuse_unsuitable, written_aside
from uwlts.thesis.campaign import campaign_folders
from uwlts.thesis.evaluation import TRIALS, evaluate_campaign
from uwlts.thesis.figures import comparison_figure, line_figure, polynomials_figures, window_distance_figure
from uwlts.thesis.joint_comparison import compare_campaigns, summary_lines, write_joint_comparison
from uwlts.thesis.measurements import FORGOTTEN
from uwlts.thesis.monte_carlo import LEAST_TRIALS
from uwlts.thesis.results import CampaignResults
from uwlts.thesis.tables import LARGEST_RATIO, MEAN, Published, TableRow, all_rows, headline_rows, load_published


@dataclass(frozen=True)
class ThesisReport:
    """Report of campaigns that were evaluated as in the thesis: its files, page first, and the headline as text."""

    files: tuple[Path, ...]
    headline: str


def evaluate_thesis(
    folder: str | Path,
    *,
    published: str | Path = "thesis-tables",
    trials: int = TRIALS,
    workers: int | None = None,
    joint: bool = False,
    again: bool = False,
    overwrite: bool = False,
    progress: Callable[[int, int], None] = lambda done, total: None,
) -> ThesisReport:
    """Evaluate campaigns as the thesis does, by all its methods, and set its tables beside the results.

    Parameters
    ----------
    folder : str or Path
        Folder with campaign-0, campaign-1, ..., each with the recordings of the whole evaluation. The report is written
        into it: report.html, summary.json, tables.csv and summary.md.
    published : str or Path
        Published tables: name or path of a TOML file.
    trials : int
        Trials of the Monte-Carlo propagation, at least 20, or 0 for none.
    workers : int, optional
        Scans measured at a time; as many as there are processors unless given.
    joint : bool
        Compare the joint calibration with the thesis's two ways instead, several campaigns at a time and without Monte
        Carlo; writes report.html and summary.json.
    again : bool
        Evaluate campaigns anew that have results already.
    overwrite : bool
        Replace an existing report.
    progress : callable, optional
        Called with the number of parts done and the number in all, starting again for every campaign.

    Raises
    ------
    DescriptionError
        An argument is out of its range, or the published tables cannot be read.
    CaptureError, CalibrationError, EvaluationError
        A recording is missing or damaged, does not determine a calibration, or does not show its artefact.
    OutputError
        A file exists and ``overwrite`` is not given, or cannot be written.
    """
    if trials != 0 and trials < LEAST_TRIALS:
        raise DescriptionError(f"trials is {trials}: take {LEAST_TRIALS} or more, or 0 for no Monte-Carlo propagation")
    if workers is not None and workers < 1:
        raise DescriptionError(f"workers is {workers}; it must be at least 1")
    folder = Path(folder)
    names = ("report.html", "summary.json") if joint else ("report.html", "summary.json", "tables.csv", "summary.md")
    files = tuple(folder / name for name in names)
    tables, campaigns = load_published(published), campaign_folders(folder)
    for file in files:
        refuse_unsuitable(file, overwrite=overwrite)
    if joint:
        compared = compare_campaigns(campaigns, workers=workers, again=again, progress=progress)
        summary = write_joint_comparison(folder, compared, overwrite=overwrite)
        return ThesisReport(files, "\n".join(summary_lines(summary)))
    results = [
        evaluate_campaign(
            campaign,
            trials=trials,
            workers=workers,
            overwrite=again,
            progress=lambda stage, done, total: progress(done, total),
        )
        for campaign in campaigns
    ]
    return ThesisReport(files, markdown(write_comparison(folder, results, tables, overwrite=overwrite), results))


def differences(rows: Sequence[TableRow]) -> list[str]:
    """Sentences with the measured numbers; those whose rows were not measured are left out."""
    found = {(row.table, row.row, row.quantity): row for row in rows}

    def value(table: str, row: str, quantity: str) -> float | None:
        known = found.get((table, row, quantity))
        return None if known is None else known.mean

    def mean(table: str, medium: str, quantity: str, thing: str = "spheres") -> float | None:
        return value(table, f"{thing}, {MEAN}, {medium}", quantity)

    sentences = [
        _said(
            "Standard deviation and range come from speckle and from how the peak is found. With LabVIEW's low-pass "
            "filter, which leaves pixels within 40 % of their neighbours as they are, and a quadratic over 5 pixels, "
            "the spheres in water spread by {} mm (published 0.115); with a plain 5x5 mean it would be {} mm, with a "
            "quadratic over three pixels {} mm, over seven {} mm. Our own profile fit leaves {} mm.",
            mean("Table 6", "water", "STD"),
            mean("Experiment: thesis, mean of 5x5", "water", "STD"),
            mean("Experiment: thesis, fit over 3 px", "water", "STD"),
            mean("Experiment: thesis, fit over 7 px", "water", "STD"),
            mean("Our stripe centre, proposed", "water", "STD"),
        ),
        _said(
            "The published ranges are 4 to 6 standard deviations, which thousands of points with nearly normal errors "
            "cannot have; PE and RE here leave out the 0.3 % that VDI/VDE 2634 allows. Over all points PE in water is "
            "{} mm instead of {} mm, RE {} mm instead of {} mm.",
            mean("Experiment: no point left out", "water", "PE of all points"),
            mean("Table 6", "water", "PE"),
            mean("Experiment: no point left out", "water", "RE of all points", "plane"),
            mean("Table 7", "water", "RE", "plane"),
        ),
        _said(
            "In air the thesis's spheres stand 0.28 and 0.37 mm too far apart or too close, by either method, and ours "
            "{} and {} mm. No imperfection of the list does that. A window that one of the two, calibration or scan, "
            "did not look through does: scans through the window by a calibration made without it err by {} mm. The "
            "thesis suspects its step calibration, which its results in air do not use.",
            mean("Table 2", "air", "SSE"),
            mean("Table 6", "air", "SSE"),
            mean("Experiment: window forgotten in air", "air", "SSE"),
        ),
        _said(
            "In water the sphere spacing of the proposed method errs by {} mm with one refraction and {} mm with two "
            "(published 0.09 and 0.14). It follows the step standard's height, at 48 mm of window distance per mm, and "
            "differs from campaign to campaign more than from position to position: the published standard deviation "
            "over six positions of one campaign does not show it.",
            value("Table 5", f"one refraction, {MEAN}", "SSE"),
            value("Table 5", f"two refractions, {MEAN}", "SSE"),
        ),
        _said(
            "The polynomials in water err by {} mm (published 0.115). All profile lines are fitted together here: each "
            "has its own polynomials, but their coefficients change smoothly from line to line, which takes out the "
            "noise of single lines.",
            mean("Table 2", "water", "SSE"),
        ),
        _said(
            "A single viewpoint in water, refraction taken for distortion, errs by {} mm in the sphere spacing with "
            "our stripe centre; two refractions err by {} mm.",
            mean("Our stripe centre, single viewpoint", "water", "SSE"),
            mean("Our stripe centre, two refractions", "water", "SSE"),
        ),
        _said(
            "The stripe on the pipe is {} mm long along the image's longer side and {} mm along the shorter one; the "
            "thesis says 185.27 mm. A 12.5 mm lens on 1280 pixels of 5.3 um sees that much in water only farther away "
            "than the described stand-off, or 204 mm in air.",
            value("Figure 67", "300 mm pipe at the stand-off, stripe along the width", "line length"),
            value("Figure 67", "300 mm pipe at the stand-off, stripe along the height", "line length"),
        ),
    ]
    return [sentence for sentence in sentences if sentence]


def far_off(rows: Sequence[TableRow]) -> list[TableRow]:
    """Rows whose mean lies outside the factor that a reproduction should keep to."""
    return [row for row in rows if row.ratio is not None and not 1 / LARGEST_RATIO <= row.ratio <= LARGEST_RATIO]


def _said(text: str, *values: float | None) -> str:
    """The text with its numbers, nothing if one is missing."""
    return "" if None in values else text.format(*(f"{value:.3f}" for value in values))


_COLUMNS = ("table", "row", "quantity", "published", "ours_mean", "ours_min", "ours_max")


def write_comparison(
    folder: Path, results: Sequence[CampaignResults], published: Published, *, overwrite: bool = False
) -> list[TableRow]:
    """Write all four files into a folder, each whole or not at all; returns the rows of the tables.

    Raises
    ------
    OutputError
        A file exists and ``overwrite`` is not given, or cannot be written.
    """
    rows = all_rows(results, published)
    found = {
        "summary.json": json.dumps([row.as_dict() for row in rows], indent=1, allow_nan=False) + "\n",
        "tables.csv": _csv(rows),
        "summary.md": markdown(rows, results),
        "report.html": report_page(folder, results, rows, published),
    }
    for name, text in found.items():
        with written_aside(folder / name, overwrite=overwrite) as aside:
            aside.write_text(text, encoding="utf-8")
    return rows


def markdown(rows: Sequence[TableRow], results: Sequence[CampaignResults]) -> str:
    """The headline as a Markdown table."""
    campaigns = len(results)
    lines = [
        "| mean over the positions | | published, mm | ours, mm | range of "
        f"{campaigns} campaign{'s' if campaigns != 1 else ''} | ours / published |",
        "| --- | --- | --- | --- | --- | --- |",
    ]
    for row in headline_rows(rows):
        if row.ours:
            lines.append(
                f"| {row.table}: {row.row.replace(f', {MEAN},', ',')} | {row.quantity} | {row.published:.2f} | "
                f"{row.mean:.3f} | {min(row.ours):.3f} to {max(row.ours):.3f} | {row.ratio:.2f} |"
            )
    return "\n".join(lines) + "\n"


def _csv(rows: Sequence[TableRow]) -> str:
    text = io.StringIO()
    writer = csv.writer(text, lineterminator="\n")
    writer.writerow(_COLUMNS)
    writer.writerows(row.as_dict().values() for row in rows)
    return text.getvalue()


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


def report_page(
    folder: Path, results: Sequence[CampaignResults], rows: Sequence[TableRow], published: Published
) -> str:
    """The page as text, with pictures from the first campaign in the folder."""
    first = results[0]
    z_of_v, y_of_z = polynomials_figures(first)
    headline = headline_rows(rows)
    shown = [
        row
        for row in rows
        if row.table == "Figure 66"
        and row.quantity == "STD"
        and row.row.endswith("thesis image processing")
        and FORGOTTEN not in row.row
    ]
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
            (
                "Figure 66",
                "Means over the positions: bars are ours (blue in water, red in air), the line spans the "
                "campaigns, diamonds are the thesis's.",
                svg_of(comparison_figure([*headline, *shown])),
            ),
            ("Figure 45", "Points on a step for several window distances.", svg_of(window_distance_figure(first))),
            ("Figure 58", "Polynomials Z(v).", svg_of(z_of_v)),
            ("Figure 59", "Polynomials Y(Z).", svg_of(y_of_z)),
        ]
        + ([("Figure 67", "Stripe on a 300 mm pipe.", svg_of(line_figure(first)))] if first.line_profiles else []),
        intervals=[(number, each) for number, result in enumerate(results) for each in result.monte_carlo],
        held_by_budget=sum(
            abs(each.observed_mm) <= result.budget.get("expanded", -1.0)
            for result in results
            for each in result.monte_carlo
        ),
        failures=[(number, m) for number, result in enumerate(results) for m in result.measurements if m.failure],
        pictures=_pictures(folder),
        version=uwlts.__version__,
    )


def _folded(rows: Sequence[TableRow]) -> tuple[list[str], list[tuple[str, list[TableRow | None]]]]:
    """A table's quantities side by side: their names, and by row one value for each of them."""
    quantities = list(dict.fromkeys(row.quantity for row in rows))
    if len(quantities) > _MOST_COLUMNS:
        return ["value"], [(f"{row.row}, {row.quantity}", [row]) for row in rows]
    values = {(row.row, row.quantity): row for row in rows}
    names = dict.fromkeys(row.row for row in rows)
    return quantities, [(name, [values.get((name, quantity)) for quantity in quantities]) for name in names]


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
