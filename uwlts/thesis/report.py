"""Report of a reproduction: summary.json, tables.csv, summary.md, and report.html with the thesis's figures."""

import csv
import io
import json
import tomllib
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import groupby
from pathlib import Path

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from uwlts.errors import DescriptionError
from uwlts.files.writing import refuse_unsuitable, write_atomically
from uwlts.pages.toolkit import (
    BLUE,
    COLOURS,
    INK,
    RED,
    figure_svg,
    legend_below,
    new_figure,
    plain_text,
    png_data_uri,
    render_page,
)
from uwlts.report import plot
from uwlts.report.pictures import stripe_picture, stripe_view
from uwlts.runtime.progress import ProgressListener, ignore_progress
from uwlts.storage.capture import Capture
from uwlts.storage.cloud_files import read_cloud
from uwlts.thesis.campaign_folder import campaign_folders
from uwlts.thesis.evaluate_campaign import TRIALS, evaluate_campaign
from uwlts.thesis.measurements import FORGOTTEN, POLYNOMIALS, PROPOSED
from uwlts.thesis.monte_carlo import LEAST_TRIALS
from uwlts.thesis.published_tables import (
    LARGEST_RATIO,
    MEAN,
    Published,
    TableRow,
    all_rows,
    headline_rows,
    load_published,
)
from uwlts.thesis.results import CampaignResults, Points

_TEXTS = tomllib.loads(Path(__file__).with_name("texts.toml").read_text(encoding="utf-8"))
# A table with more quantities has one value per line.
_MOST_COLUMNS = 3


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
    again: bool = False,
    overwrite: bool = False,
    progress: ProgressListener = ignore_progress,
) -> ThesisReport:
    """Evaluate campaigns with all methods of the thesis, and compare the results with its tables.

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
        Number of scans measured in parallel. Default: number of processors.
    again : bool
        Evaluate campaigns again that already have results.
    overwrite : bool
        Replace an existing report.
    progress : callable, optional
        Called with the number of parts done and the total, starting again for every campaign.

    Returns
    -------
    ThesisReport
        Paths of the written files, page first, and the headline as text.

    Raises
    ------
    DescriptionError
        An argument is out of range, or the published tables cannot be read.
    CaptureError, CalibrationError, EvaluationError
        A recording is missing or damaged, does not determine a calibration, or does not show its artefact.
    OutputError
        A file exists and ``overwrite`` is not given, or cannot be written.
    """
    if trials != 0 and trials < LEAST_TRIALS:
        raise DescriptionError(
            f"trials is {trials}; expected at least {LEAST_TRIALS}, or 0 for no Monte-Carlo propagation"
        )
    if workers is not None and workers < 1:
        raise DescriptionError(f"workers is {workers}; it must be at least 1")
    folder = Path(folder)
    files = tuple(folder / name for name in ("report.html", "summary.json", "tables.csv", "summary.md"))
    tables, campaigns = load_published(published), campaign_folders(folder)
    for file in files:
        refuse_unsuitable(file, overwrite=overwrite)
    results = [
        evaluate_campaign(campaign, trials=trials, workers=workers, overwrite=again, progress=progress)
        for campaign in campaigns
    ]
    return ThesisReport(files, format_markdown(write_comparison(folder, results, tables, overwrite=overwrite), results))


def differences(rows: Sequence[TableRow]) -> list[str]:
    """Return the texts on differences with the measured values; texts without measured values are omitted."""
    means = {(row.table, row.row, row.quantity): row.mean for row in rows}
    found = [(each["text"], [means.get(tuple(key)) for key in each["values"]]) for each in _TEXTS["differences"]]
    return [text.format(*(f"{mean:.3f}" for mean in values)) for text, values in found if None not in values]


def select_outlying_rows(rows: Sequence[TableRow]) -> list[TableRow]:
    """Return rows whose mean differs from the published one by more than the expected factor."""
    return [row for row in rows if row.ratio is not None and not 1 / LARGEST_RATIO <= row.ratio <= LARGEST_RATIO]


def write_comparison(
    folder: Path, results: Sequence[CampaignResults], published: Published, *, overwrite: bool = False
) -> list[TableRow]:
    """Write all four files into a folder, each atomically; return the rows of the tables.

    Raises OutputError if a file exists and ``overwrite`` is not given, or it cannot be written.
    """
    rows = all_rows(results, published)
    plain, lines = [row.as_dict() for row in rows], io.StringIO()
    table = csv.DictWriter(lines, plain[0], lineterminator="\n")
    table.writeheader()
    table.writerows(plain)
    found = {
        "summary.json": json.dumps(plain, indent=1, allow_nan=False) + "\n",
        "tables.csv": lines.getvalue(),
        "summary.md": format_markdown(rows, results),
        "report.html": report_page(folder, results, rows, published),
    }
    for name, text in found.items():
        with write_atomically(folder / name, overwrite=overwrite) as aside:
            aside.write_text(text, encoding="utf-8")
    return rows


def format_markdown(rows: Sequence[TableRow], results: Sequence[CampaignResults]) -> str:
    """Format the headline as a Markdown table."""
    campaigns = f"{len(results)} campaign{'s' if len(results) != 1 else ''}"
    lines = [
        f"| mean over the positions | | published, mm | ours, mm | range of {campaigns} | ours / published |",
        "| --- | --- | --- | --- | --- | --- |",
    ]
    lines += [
        f"| {row.table}: {row.row.replace(f', {MEAN},', ',')} | {row.quantity} | {row.published:.2f} | "
        f"{row.mean:.3f} | {min(row.ours):.3f} to {max(row.ours):.3f} | {row.ratio:.2f} |"
        for row in headline_rows(rows)
        if row.ours
    ]
    return "\n".join(lines) + "\n"


def report_page(
    folder: Path, results: Sequence[CampaignResults], rows: Sequence[TableRow], published: Published
) -> str:
    """Render the page, with pictures from the first campaign in the folder."""
    first, headline = results[0], headline_rows(rows)
    z_of_v, y_of_z = polynomials_figures(first)
    free = [row for row in rows if (row.table, row.quantity) == ("Figure 66", "STD") and FORGOTTEN not in row.row]
    shown = [*headline, *(row for row in free if row.row.endswith("thesis image processing"))]
    means = (
        "Means over the positions: bars show our values (blue in water, red in air), lines the range over the "
        "campaigns, diamonds the thesis's values."
    )
    figures = [
        ("Figure 66", means, comparison_figure(shown)),
        ("Figure 45", "Points on a step for several window distances.", window_distance_figure(first)),
        ("Figure 58", "Polynomials Z(v).", z_of_v),
        ("Figure 59", "Polynomials Y(Z).", y_of_z),
    ]
    if first.line_profiles:
        figures.append(("Figure 67", "Stripe on a 300 mm pipe.", line_figure(first)))
    intervals = [(number, each) for number, result in enumerate(results) for each in result.monte_carlo]
    return render_page(
        "uwlts.thesis",
        "template.html.j2",
        published=published.title,
        campaigns=len(results),
        headline=headline,
        far_off=select_outlying_rows(headline),
        far=LARGEST_RATIO,
        tables=[
            (name, _TEXTS["titles"].get(name, ""), *_fold_table(list(group)))
            for name, group in groupby(rows, lambda row: row.table)
        ],
        differences=differences(rows),
        figures=[(name, caption, figure_svg(figure)) for name, caption, figure in figures],
        intervals=intervals,
        held_by_budget=sum(abs(each.observed_mm) <= results[n].budget.get("expanded", -1.0) for n, each in intervals),
        failures=[(number, m) for number, result in enumerate(results) for m in result.measurements if m.failure],
        pictures=_pictures(folder),
    )


def _fold_table(rows: Sequence[TableRow]) -> tuple[list[str], list[tuple[str, list[TableRow | None]]]]:
    """Arrange a table's quantities side by side: their names, and for each row one value for each of them."""
    quantities = list(dict.fromkeys(row.quantity for row in rows))
    if len(quantities) > _MOST_COLUMNS:
        return ["value"], [(f"{row.row}, {row.quantity}", [row]) for row in rows]
    values = {(row.row, row.quantity): row for row in rows}
    names = dict.fromkeys(row.row for row in rows)
    return quantities, [(name, [values.get((name, quantity)) for quantity in quantities]) for name in names]


def _pictures(folder: Path) -> list[tuple[str, str, str]]:
    """Return name, stripe and cloud of the first campaign's objects that have a coloured cloud."""
    campaign = campaign_folders(folder)[0]
    found = []
    for cloud in sorted((campaign.path / "clouds").glob("*-proposed.ply")):
        name = cloud.stem.removesuffix("-proposed")
        with Capture(campaign.path / f"{name}.h5") as capture:
            view = stripe_view(capture)
        stripe = "" if view is None else png_data_uri(stripe_picture(view))
        found.append((name, stripe, png_data_uri(plot.cloud(read_cloud(cloud)).figure)))
    return found


def window_distance_figure(results: CampaignResults) -> Figure:
    """Plot Figure 45: a step's profile for several window distances."""
    profiles = {f"d = {each.distance_mm:.1f} mm": each.points_mm for each in results.window_profiles}
    figure, (whole, upper) = new_figure(9.0, 3.2, columns=2)
    _draw_profiles(whole, "One step image for different window distances", profiles)
    _draw_profiles(upper, "Its upper face", profiles)
    depths = [z for points in profiles.values() for _, z in points if np.isfinite(z)]
    if depths:
        # The face is flat within a few tenths of a millimetre for every plotted window distance.
        upper.set_ylim(min(depths) - 0.2, min(depths) + 1.2)
    legend_below(figure)
    return figure


def polynomials_figures(results: CampaignResults) -> tuple[Figure, Figure]:
    """Plot Figures 58 and 59: Z(v) and Y(Z) of three profile lines in air and in water."""
    (by_row, rows), (by_depth, depths) = (new_figure(9.0, 3.2, columns=2) for _ in range(2))
    for z_axes, y_axes, (medium, found) in zip(rows, depths, results.polynomials.items(), strict=True):
        for name, line in found.lines.items():
            z_axes.plot(line.centre_px, line.z_mm, label=f"profile line, {name}")
            y_axes.plot(line.z_mm, line.y_mm, label=f"profile line, {name}")
        z_axes.set(title=f"Z(v) in {medium}", xlabel="stripe position v / px", ylabel="Z / mm")
        y_axes.set(title=f"Y(Z) in {medium}", xlabel="Z / mm", ylabel="Y / mm")
    legend_below(by_row)
    legend_below(by_depth)
    return by_row, by_depth


def line_figure(results: CampaignResults) -> Figure:
    """Plot Figure 67: the stripe on a 300 mm pipe at the stand-off, for either orientation of the camera."""
    figure, (axes,) = new_figure(4.8, 3.2)
    profiles = {
        f"along the image's {side}: {profile.length_mm:.1f} mm": profile.points_mm
        for side, profile in results.line_profiles.items()
    }
    _draw_profiles(axes, "Stripe on a 300 mm pipe in water", profiles)
    legend_below(figure, columns=1)
    return figure


def comparison_figure(rows: Sequence[TableRow]) -> Figure:
    """Plot Figure 66: means over the positions as bars with the campaigns' range, published values as diamonds."""
    shown = [row for row in rows if row.ours]
    figure, (axes,) = new_figure(9.0, 0.8 + 0.25 * len(shown))
    places = np.arange(len(shown))
    colours = [BLUE if "water" in row.row else RED for row in shown]
    axes.barh(places, [np.mean(row.ours) for row in shown], height=0.55, color=colours, alpha=0.75)
    axes.hlines(places, [min(row.ours) for row in shown], [max(row.ours) for row in shown], color=INK)
    published = [(row.published, place) for place, row in enumerate(shown) if row.published is not None]
    axes.plot(*np.array(published).reshape(-1, 2).T, "D", color=COLOURS[1], markeredgecolor=INK)
    methods = {"Table 2": POLYNOMIALS, "Table 3": POLYNOMIALS, "Table 6": PROPOSED, "Table 7": PROPOSED}
    names = [row.row.replace(f", {MEAN}", "").removesuffix(", thesis image processing") for row in shown]
    labels = [
        ", ".join(filter(None, (f"{row.quantity}: {name}", methods.get(row.table))))
        for row, name in zip(shown, names, strict=True)
    ]
    axes.set_yticks(places, [plain_text(label) for label in labels])
    axes.invert_yaxis()
    axes.set_xlim(left=0.0)
    axes.set_xlabel("mean of the campaigns / mm")
    return figure


def _draw_profiles(axes: Axes, title: str, profiles: Mapping[str, Points]) -> None:
    """Plot named profiles of points (Y, Z) in mm."""
    for name, points in profiles.items():
        axes.plot(*np.array(points, float).reshape(-1, 2).T, ".", markersize=3, label=name)
    axes.set(title=title, xlabel="Y / mm", ylabel="Z / mm")
