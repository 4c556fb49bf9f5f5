"""Page of a radiometry: images of two captures side by side, their stripes, and the significance of all differences."""

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from uwlts.errors import CaptureError
from uwlts.pages.toolkit import (
    BLUE,
    RED,
    ComparisonTable,
    figure_svg,
    new_figure,
    png_data_uri,
    render_page,
    write_page,
)
from uwlts.radiometry.domain_gap import measure_domain_gap
from uwlts.radiometry.result import SIGNIFICANT, Radiometry
from uwlts.storage.capture import Capture, open_capture

_HALF_PX = 40
"""Half the height of the pictures, and of the mean stripe, across it."""


def write_radiometry(
    path: str | Path,
    radiometry: Radiometry,
    capture: Capture | str | Path,
    *,
    earlier_capture: Capture | str | Path,
    title: str = "Radiometry of two captures",
    overwrite: bool = False,
) -> None:
    """Write the page that compares the stripe in two captures, such as a rendered one and the scan that it follows.

    Parameters
    ----------
    path : str or Path
        Page to write.
    radiometry : Radiometry
        Result for the capture, with the changes since the earlier one.
    capture : Capture or path
        Capture of the result.
    earlier_capture : Capture or path
        Capture of the earlier result.
    title : str
        Title of the page.
    overwrite : bool
        Replace an existing page.

    Raises
    ------
    CaptureError
        A file cannot be read, or the images of both captures differ in size.
    OutputError
        The page exists and ``overwrite`` is not given, or cannot be written.
    """
    with open_capture(earlier_capture) as before, open_capture(capture) as after:
        names = before.path.name, after.path.name
        pictures = _views(before, after)
        stripes = measure_domain_gap([after.path], real=[before.path])
        explained = [each.line() for each in radiometry.changes if abs(each.significance) > SIGNIFICANT]
        text = render_page(
            "uwlts.report",
            "radiometry.html.j2",
            title=title,
            names=names,
            summary=radiometry.lines(),
            significant=f"{SIGNIFICANT:g}",
            not_explained=explained,
            pictures=_draw_pictures(pictures, names),
            residual=_draw_residual(pictures),
            profile=_draw_profile(pictures, names),
            estimates=_estimates(radiometry, names),
            statistics=stripes.statistics_table(),
            gaps=stripes.gap_table(),
            not_separable=radiometry.not_separable,
        )
    write_page(path, text, overwrite=overwrite)


def _views(before: Capture, after: Capture) -> list[np.ndarray]:
    """Return the images nearest to the middle of both scans, with the stripe along the width, cut about its row."""
    if before.header.sensor.camera.lines() != after.header.sensor.camera.lines():
        raise CaptureError(
            f"the images of {before.path.name} and {after.path.name} differ in size: render the scan with its own "
            "sensor"
        )
    stage = before.stage_mm[before.laser_on]
    middle = float(stage[np.argmin(np.abs(stage - np.median(stage)))])
    views: list[np.ndarray] = []
    for capture in (before, after):
        lit = np.flatnonzero(capture.laser_on)
        number = int(lit[np.argmin(np.abs(capture.stage_mm[lit] - middle))])
        image = capture.image(number).astype(float)
        views.append(image if capture.header.sensor.camera.stripe_along == "width" else image.T)
    row = int(np.argmax(views[0].mean(axis=1)))
    return [view[max(0, row - _HALF_PX) : row + _HALF_PX + 1] for view in views]


def _draw_pictures(views: Sequence[np.ndarray], names: Sequence[str]) -> str:
    """Draw both images with a common logarithmic grey scale, which shows the haze."""
    figure, axes = new_figure(11.0, 3.0, columns=2)
    low = min(float(view.min()) for view in views)
    logs = [np.log10(1 + view - low) for view in views]
    top = max(float(log.max()) for log in logs)
    for axis, log, name in zip(axes, logs, names, strict=True):
        axis.imshow(log, cmap="gray", vmin=0, vmax=top, aspect="auto")
        axis.set_title(name)
        axis.grid(visible=False)
    return png_data_uri(figure, dpi=120)


def _draw_residual(views: Sequence[np.ndarray]) -> str:
    figure, (axis,) = new_figure(11.0, 2.8)
    difference = views[1] - views[0]
    limit = max(float(np.quantile(np.abs(difference), 0.99)), 1.0)
    shown = axis.imshow(difference, cmap="RdBu", vmin=-limit, vmax=limit, aspect="auto")
    axis.grid(visible=False)
    figure.colorbar(shown, ax=axis, label="difference / DN")
    return png_data_uri(figure, dpi=120)


def _draw_profile(views: Sequence[np.ndarray], names: Sequence[str]) -> Any:
    """Draw the mean across the stripe of both images on a logarithmic scale, aligned by the brightest pixel."""
    figure, (axis,) = new_figure(6.5, 3.2)
    for view, name, colour in zip(views, names, (BLUE, RED), strict=True):
        column = np.arange(view.shape[1])
        place = np.argmax(view, axis=0) + np.arange(-_HALF_PX // 2, _HALF_PX // 2 + 1)[:, None]
        inside = (place >= 0) & (place < len(view))
        values = np.where(inside, view[np.clip(place, 0, len(view) - 1), column], np.nan)
        axis.semilogy(
            np.arange(-_HALF_PX // 2, _HALF_PX // 2 + 1), np.nanmean(values, axis=1), color=colour, label=name
        )
    axis.set(xlabel="distance from the brightest pixel / px", ylabel="mean grey value / DN")
    axis.legend(frameon=False)
    return figure_svg(figure)


def _estimates(radiometry: Radiometry, names: Sequence[str]) -> ComparisonTable:
    rows = [
        (
            each.meaning,
            each.unit,
            (f"{each.before:.4g}", f"{each.after:.4g}", f"{each.std:.2g}", f"{each.significance:+.1f}"),
        )
        for each in radiometry.changes
    ]
    return ComparisonTable((*names, "std", "in std"), tuple(rows))
