"""Page of a registration: scans, overlaps with their distances, and undetermined movements."""

from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from markupsafe import Markup

from uwlts.files.json_files import json_text
from uwlts.pages.toolkit import BLUE, COLOURS, RED, figure_svg, new_figure, png_data_uri, render_page, write_page
from uwlts.registration.register import RegisteredScans
from uwlts.report.plot import surface_limit_mm

_SHOWN = 30_000
"""Number of points shown per picture for all scans together; more would overlap."""
_VIEWS = ((0, 1), (0, 2), (1, 2))  # axes of plan, front and side view


REGISTRATION = "registration"
"""Kind of the page, in the name of its JSON file."""


def write_registration(
    path: str | Path, registered: RegisteredScans, *, title: str = "Registration of scans", overwrite: bool = False
) -> None:
    """Write the page of a registration, and its figures, poses and their covariance as JSON beside it.

    Parameters
    ----------
    path : str or Path
        Page to write; the figures go into a JSON file of the same name.
    registered : RegisteredScans
        Result of `uwlts.register`.
    title : str
        Title of the page.
    overwrite : bool
        Replace existing files.

    Raises
    ------
    OutputError
        A file exists and ``overwrite`` is not given, or cannot be written.
    """
    text = render_page(
        "uwlts.report",
        "registration.html.j2",
        title=title,
        first=registered.names[0],
        summary=[line for line in registered.lines() if not line.startswith("  open")],
        open_movements=[(registered.names[each.scan], each.describe()) for each in registered.open_movements],
        scans=_scans(registered),
        overlaps=_overlaps(registered),
        histograms=_histograms(registered),
    )
    write_page(path, text, beside=json_text(registered.record()), kind=REGISTRATION, overwrite=overwrite)


def _scans(registered: RegisteredScans) -> str:
    listed: Any = registered.cloud.metadata["scans"]
    firsts = [each["first_frame"] for each in listed]
    number = np.searchsorted(firsts, registered.cloud.frame, side="right") - 1
    every = slice(None, None, max(1, len(number) // _SHOWN))
    points, number = registered.cloud.points_mm[every], number[every]

    def draw(axes: Any, first: int, second: int) -> None:
        for scan, name in enumerate(registered.names):
            own = number == scan
            colour = COLOURS[scan % len(COLOURS)]
            axes.plot(points[own, first], points[own, second], ",", color=colour, rasterized=True)
            axes.plot([], [], "o", color=colour, label=name)
        if (first, second) == _VIEWS[-1]:
            axes.legend(frameon=False, fontsize=7, loc="upper left", bbox_to_anchor=(1.0, 1.0))

    return draw_views(draw)


def _overlaps(registered: RegisteredScans) -> str:
    places = np.vstack([each.places_mm for each in registered.overlaps])
    distance = np.concatenate([each.distance_mm for each in registered.overlaps])
    limit = surface_limit_mm(distance)
    every = slice(None, None, max(1, len(registered.cloud) // _SHOWN))
    beneath = registered.cloud.points_mm[every]

    def draw(axes: Any, first: int, second: int) -> Any:
        axes.plot(beneath[:, first], beneath[:, second], ",", color="#d5d5d5", rasterized=True)
        known: dict[str, Any] = {"c": distance, "cmap": "RdBu", "vmin": -limit, "vmax": limit, "linewidths": 0}
        return axes.scatter(places[:, first], places[:, second], s=4, **known)

    return draw_views(draw, label="distance / mm")


def draw_views(
    draw: Callable[[Any, int, int], Any], *, label: str | None = None, ticks: Sequence[int] | None = None
) -> str:
    """Draw three views along the axes, side by side; with a label, a bar of the colours has ``ticks``."""
    figure, axes = new_figure(11.0, 3.8, columns=3)
    drawn = None
    for (first, second), ax in zip(_VIEWS, axes, strict=True):
        drawn = draw(ax, first, second)
        ax.set(xlabel=f"{'XYZ'[first]} / mm", ylabel=f"{'XYZ'[second]} / mm", aspect="equal")
    if label is not None and drawn is not None:
        figure.colorbar(drawn, ax=axes, label=label, ticks=ticks, shrink=0.8)
    return png_data_uri(figure, dpi=130)


def _histograms(registered: RegisteredScans) -> Markup:
    count = len(registered.pairs)
    columns = min(count, 3)
    figure, axes = new_figure(9.0, 2.0 * -(-count // columns), rows=-(-count // columns), columns=columns)
    for pair, overlap, ax in zip(registered.pairs, registered.overlaps, axes, strict=False):
        distance = overlap.distance_mm
        limit = surface_limit_mm(distance)
        ax.hist(np.clip(distance, -limit, limit), bins=41, color=BLUE)
        ax.axvline(pair.mean_mm, color=RED, linewidth=1)
        first, second = (registered.names[number] for number in pair.scans)
        ax.set_title(f"{first} - {second}", fontsize=8)
        ax.set(xlabel="distance / mm", ylabel="patches")
    for ax in axes[count:]:
        ax.set_visible(False)
    return figure_svg(figure)
