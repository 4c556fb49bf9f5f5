"""Pages of comparisons: surface change, registration, and domain gap between real and rendered images."""

from collections.abc import Callable, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from markupsafe import Markup
from matplotlib import colormaps
from matplotlib.colors import to_rgb

from uwlts.comparison.change import SurfaceChange
from uwlts.files.json_files import json_text
from uwlts.files.writing import require_ending, write_file
from uwlts.pages.toolkit import (
    BLUE,
    COLOURS,
    INK,
    RED,
    figure_svg,
    new_figure,
    plain_text,
    png_data_uri,
    refuse_unsuitable_page,
    render_page,
    write_page,
)
from uwlts.radiometry.domain_gap import DomainGap, measure_domain_gap
from uwlts.radiometry.stripe_windows import STATISTICS
from uwlts.registration.register import RegisteredScans
from uwlts.report.plot import UNKNOWN, surface_limit_mm
from uwlts.runtime.progress import ProgressListener, ignore_progress
from uwlts.storage.cloud_files import PLY_COLOURS, write_ply_points
from uwlts.storage.las_file import encode_las
from uwlts.stripe import StripeSettings

if TYPE_CHECKING:
    from matplotlib.figure import Figure

PLACES_FORMATS = (".ply", ".laz", ".las")  # supported endings of the coloured cloud
_COLOURS = colormaps["RdBu"]
_NOT_SIGNIFICANT = "#cccccc"
_INK = 60_000  # total area of all dots (square points), such that they nearly touch
_MOST_ROWS = 20
"""Number of regions listed and numbered on the page; the JSON file lists all."""


def write_change(
    path: str | Path,
    change: SurfaceChange,
    *,
    title: str = "Change of a surface",
    coloured: str | Path | None = None,
    pdf: bool = False,
    overwrite: bool = False,
) -> None:
    """Write the page of a change, its figures as JSON beside it, and its points as a cloud.

    Fields of the cloud are x, y, z (mm in PLY, else m), the colours of the map, nx, ny, nz, distance, level (mm; NaN if
    not compared) and significant (0, 1).

    Parameters
    ----------
    path : str or Path
        Page to write; the figures go into a JSON file of the same name.
    change : SurfaceChange
        Result of `uwlts.compare_clouds`.
    title : str
        Title of the page.
    coloured : str or Path, optional
        Cloud to write, in PLY, LAZ or LAS depending on its ending.
    pdf : bool
        Also print the page to a PDF beside it, with an installed Chromium or Chrome.
    overwrite : bool
        Replace existing files.

    Raises
    ------
    OutputError
        A file exists and ``overwrite`` is not given, or cannot be written.
    SetupError
        A PDF is requested, but no browser is installed.
    """
    text = render_page(
        "uwlts.report",
        "change.html.j2",
        title=title,
        summary=[line for line in change.lines() if not line.startswith("warning: ")],
        warnings=change.warnings,
        regions=change.regions()[:_MOST_ROWS],
        more=max(len(change.regions()) - _MOST_ROWS, 0),
        map=_draw_map(change),
        histogram=_draw_histogram(change),
    )
    if coloured is not None:
        _write_places(Path(coloured), change, overwrite=overwrite)
    write_page(path, text, beside=json_text(change.record()), pdf=pdf, overwrite=overwrite)


def _write_places(path: Path, change: SurfaceChange, *, overwrite: bool) -> None:
    require_ending(path, PLACES_FORMATS)
    fields = dict(zip(("nx", "ny", "nz"), change.normals.T.astype(np.float32), strict=True))
    fields |= {"distance": change.distance_mm.astype(np.float32), "level": change.level_mm.astype(np.float32)}
    fields["significant"] = change.significant.astype(np.uint8)
    colours = _colour_points(change)
    if path.suffix.lower() == ".ply":
        places = dict(zip("xyz", change.points_mm.T, strict=True)) | dict(zip(PLY_COLOURS, colours.T, strict=True))
        write_ply_points(path, places | fields, overwrite=overwrite)
        return
    none = np.zeros(len(change.points_mm), np.float32)
    compressed = path.suffix.lower() == ".laz"
    content = encode_las(change.points_mm, none, fields, colours=colours, compressed=compressed)
    write_file(path, content, overwrite=overwrite)


def _colour_points(change: SurfaceChange) -> np.ndarray:
    """Return red, green and blue (P, 3) uint8 of the points, as on the map; `UNKNOWN` if not compared."""
    limit = surface_limit_mm(change.distance_mm[change.compared])
    colours = _COLOURS((np.nan_to_num(change.distance_mm) / limit + 1) / 2, bytes=True)[:, :3]
    for where, colour in ((~change.significant, _NOT_SIGNIFICANT), (~change.compared, UNKNOWN)):
        colours[where] = np.rint(255 * np.array(to_rgb(colour)))
    return colours


def _draw_map(change: SurfaceChange) -> str:
    """Plot the points along their two longest extents, coloured if the change is significant."""
    first, second = np.sort(np.argsort(np.ptp(change.points_mm, axis=0), kind="stable")[1:])
    shown, changed = change.compared, change.significant
    limit = surface_limit_mm(change.distance_mm[shown])
    figure, (axes,) = new_figure(9.0, 6.0)
    u, v = change.points_mm[:, first], change.points_mm[:, second]
    size = float(np.clip(_INK / len(u), 2, 60))
    axes.scatter(u[shown & ~changed], v[shown & ~changed], s=size, color=_NOT_SIGNIFICANT, linewidths=0)
    colours = axes.scatter(
        u[changed],
        v[changed],
        s=size,
        c=change.distance_mm[changed],
        cmap=_COLOURS,
        vmin=-limit,
        vmax=limit,
        linewidths=0,
    )
    figure.colorbar(colours, ax=axes, label="distance / mm (grey: within its level of detection)")
    for number, region in enumerate(change.regions()[:_MOST_ROWS], start=1):
        place = region.centre_mm[first], region.centre_mm[second]
        axes.annotate(str(number), place, xytext=(6, 6), textcoords="offset points", fontsize=8, color=INK)
    axes.set(xlabel=f"{'XYZ'[first]} / mm", ylabel=f"{'XYZ'[second]} / mm", aspect="equal")
    return png_data_uri(axes, dpi=130)


def _draw_histogram(change: SurfaceChange) -> Markup:
    distance, level = change.distance_mm[change.compared], change.level_mm[change.compared]
    limit = surface_limit_mm(distance)
    figure, (axes,) = new_figure(9.0, 3.2)
    axes.hist(np.clip(distance, -limit, limit), bins=81, color=BLUE)
    for side in (-1, 1):
        label = "level of detection (median)" if side > 0 else None
        axes.axvline(side * float(np.median(level)), color=RED, linewidth=1, label=label)
    axes.set(xlabel="distance / mm", ylabel="points")
    axes.legend(frameon=False)
    return figure_svg(figure)


_SHOWN = 30_000  # number of points shown per picture for all scans together; more would overlap
_VIEWS = ((0, 1), (0, 2), (1, 2))  # axes of plan, front and side view


REGISTRATION = "registration"  # kind of the page, in the name of its JSON file


def write_registration(path: str | Path, registered: RegisteredScans, *, overwrite: bool = False) -> None:
    """Write the page of a registration, and its figures, poses and their covariance as JSON beside it.

    Parameters
    ----------
    path : str or Path
        Page to write; the figures go into a JSON file of the same name.
    registered : RegisteredScans
        Result of `uwlts.register`.
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
        title="Registration of scans",
        first=registered.names[0],
        summary=[line for line in registered.lines() if not line.startswith("  open")],
        open_movements=[(registered.names[each.scan], each.describe()) for each in registered.open_movements],
        scans=_draw_scans(registered),
        overlaps=_draw_overlaps(registered),
        histograms=_draw_histograms(registered),
    )
    write_page(path, text, beside=json_text(registered.record()), kind=REGISTRATION, overwrite=overwrite)


def _draw_scans(registered: RegisteredScans) -> str:
    listed: Any = registered.cloud.metadata["scans"]
    firsts = [each["first_frame"] for each in listed]
    number = np.searchsorted(firsts, registered.cloud.frame, side="right") - 1
    every = slice(None, None, max(1, len(number) // _SHOWN))
    points, number = registered.cloud.points_mm[every], number[every]

    def draw(axes: Any, first: int, second: int) -> None:
        for scan, name in enumerate(registered.names):
            members = number == scan
            colour = COLOURS[scan % len(COLOURS)]
            axes.plot(points[members, first], points[members, second], ",", color=colour, rasterized=True)
            axes.plot([], [], "o", color=colour, label=name)
        if (first, second) == _VIEWS[-1]:
            axes.legend(frameon=False, fontsize=7, loc="upper left", bbox_to_anchor=(1.0, 1.0))

    return draw_views(draw)


def _draw_overlaps(registered: RegisteredScans) -> str:
    places = np.vstack([each.places_mm for each in registered.overlaps])
    distance = np.concatenate([each.distance_mm for each in registered.overlaps])
    limit = surface_limit_mm(distance)
    beneath = registered.cloud.points_mm[slice(None, None, max(1, len(registered.cloud) // _SHOWN))]

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


def _draw_histograms(registered: RegisteredScans) -> Markup:
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


# --- domain gap -------------------------------------------------------------------------------------------------------


_MOST_PIECES = 8  # pictures of each set
_GAMMA = 0.5  # exponent of the displayed brightness, which makes a halo visible


def write_domain_gap(
    generated: Sequence[str | Path] = (),
    *,
    real: Sequence[str | Path] = (),
    out: str | Path,
    most_images: int = 200,
    stripe: StripeSettings = None,
    overwrite: bool = False,
    progress: ProgressListener = ignore_progress,
) -> DomainGap:
    """Compare the stripe in generated and real images by its statistics, and measure the domain gap.

    Sets of images are folders of data sets, captures (.h5), folders of image files, image files, or quoted patterns
    such as "bust/laser_*.png". Statistics are of windows of 64 profile lines of a stripe without a jump. The gap is the
    energy coefficient of inhomogeneity of their distributions: 0 if they are equal, at most 1. The page also has the
    gaps between random halves of each real set, as the least value that means anything, and between the real sets.

    Parameters
    ----------
    generated : sequence of paths
        Sets of rendered images.
    real : sequence of paths
        Sets of real images.
    out : str or Path
        Page to write; all figures go into a JSON file of the same name.
    most_images : int
        Largest number of images of each set, evenly chosen.
    stripe : StripeOptions or dict, optional
        Options for finding the stripe, all or some: see `uwlts.StripeOptions`.
    overwrite : bool
        Replace existing files.
    progress : callable, optional
        Called after each set with the number of sets done and the total number.

    Returns
    -------
    DomainGap
        Statistics of all windows, gaps, and the fractions of real windows that generated ones cover.

    Raises
    ------
    CaptureError, ImageError
        A set cannot be read, shows no stripe, or too little of it.
    DescriptionError, RangeError
        No set is given, a setting of the stripe is unknown, or a number is out of range.
    OutputError
        A file exists and ``overwrite`` is not given, or cannot be written.
    """
    refuse_unsuitable_page(Path(out), overwrite=overwrite)
    found = measure_domain_gap(generated, real=real, most_images=most_images, stripe=stripe, progress=progress)
    text = render_page(
        "uwlts.report",
        "domain.html.j2",
        title="Generated and real stripes",
        gaps=found.gap_table() if found.real else None,
        covered=found.covered_table() if found.real and found.generated else None,
        statistics=found.statistics_table(),
        definitions=[(each.name, each.unit or "1", each.meaning) for each in STATISTICS],
        distributions=figure_svg(_draw_distributions(found)),
        pictures=_draw_pictures(found),
    )
    write_page(out, text, beside=json_text(found.record()), overwrite=overwrite)
    return found


def _draw_distributions(found: DomainGap) -> "Figure":
    """Draw 5 %, quartiles and 95 % of all statistics: generated sets in blue, real ones in red."""
    sets, rows = found.sets(), -(-len(STATISTICS) // 3)
    figure, axes = new_figure(11.0, rows * (0.8 + 0.2 * len(sets)), rows=rows, columns=3)
    for k, (axis, each) in enumerate(zip(axes, STATISTICS, strict=False)):
        boxes = axis.boxplot(
            [one.values[:, k] for one in sets], whis=(5, 95), showfliers=False, orientation="horizontal", widths=0.6
        )
        for number, one in enumerate(sets):
            colour = RED if one in found.real else BLUE
            parts = [boxes["boxes"][number], boxes["medians"][number]]
            parts += boxes["whiskers"][2 * number : 2 * number + 2] + boxes["caps"][2 * number : 2 * number + 2]
            for part in parts:
                part.set_color(colour)
        labels = [plain_text(one.name) for one in sets] if k % 3 == 0 else [""] * len(sets)
        axis.set_yticks(range(1, len(sets) + 1), labels)
        axis.invert_yaxis()
        axis.set_xlabel(f"{each.name} / {each.unit}" if each.unit else each.name)
    for axis in axes[len(STATISTICS) :]:
        axis.set_axis_off()
    return figure


def _draw_pictures(found: DomainGap) -> str:
    """Draw windows of all sets, one row for each set."""
    sets = found.sets()
    figure, axes = new_figure(11.0, 2.3 * len(sets), rows=len(sets), columns=_MOST_PIECES)
    for row, one in enumerate(sets):
        chosen = np.unique(np.linspace(0, len(one.pictures) - 1, _MOST_PIECES).astype(int))
        cells = axes[row * _MOST_PIECES : (row + 1) * _MOST_PIECES]
        for cell in cells:
            cell.set_axis_off()
        for cell, number in zip(cells, chosen.tolist(), strict=False):
            cell.imshow(np.clip(one.pictures[number], 0, 1) ** _GAMMA, cmap="gray", vmin=0, vmax=1)
        cells[0].set_title(plain_text(one.name), loc="left")
    return png_data_uri(figure, dpi=110)
