"""Interactive view of a cloud in notebooks, and in the browser for other programs: a page that contains everything."""

import html
import sys
import tempfile
import webbrowser
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from uwlts.pages.cloud_figure import LIMIT_STD, PARTS, CloudField, CloudPoints, scale_values
from uwlts.pages.toolkit import FigureCollector, render_page, write_page

MOST_SHOWN = 200_000
"""Largest number of points in a view of its own: about 1 MB, which every browser turns without delay."""
_HEIGHT_PX = 600  # height of a view in a notebook


def choose_points(
    points_mm: np.ndarray, field: CloudField, values: np.ndarray | None, *, most: int
) -> tuple[CloudPoints, str]:
    """Choose points (N, 3) for a view, and return them with a caption.

    ``values`` (N,) are those of the ``field``, in mm or grey values; NaN where unknown, None if all of it is. Of more
    than ``most`` points that many are drawn at random, always the same. Lengths of a fraction of a millimetre are in
    µm. The caption states their number, the range of the colours, and the directions of the axes.
    """
    count, chosen, caption = len(points_mm), slice(None), f"All {len(points_mm):,} points."
    if count > most:
        chosen = np.sort(np.random.default_rng(0).choice(count, most, replace=False))
        caption = f"{most:,} of {count:,} points, drawn at random."
    axes = "X: direction of the scan; Y: along the stripe; Z: away from the sensor."
    if field == "depth":
        return CloudPoints(points_mm[chosen], field, None, "mm", None), f"{caption} {axes}"
    values = np.full(count, np.nan) if values is None else values.astype(np.float64)
    scaled, unit, limit = scale_values(values, field)
    if limit is not None:
        caption += f" The colours end at {LIMIT_STD:g} standard deviations, ±{limit:.3g} {unit}."
    if np.isnan(shown := scaled[chosen]).any():
        caption += " Dark points were not evaluated: outliers, near an edge, or beside the artefact." if limit else ""
    caption += f" {PARTS[field]}" if field in PARTS else ""
    return CloudPoints(points_mm[chosen], field, shown, unit, limit), f"{caption} {axes}"


@dataclass(frozen=True)
class CloudDisplay:
    """View of a cloud for the output of a notebook's cell."""

    page: str  # HTML page with the points, and with the scripts that show them

    def _repr_html_(self) -> str:
        """Return the page within a frame: scripts and styles of several views in a notebook stay apart."""
        return (
            f'<iframe class="cloud-display" sandbox="allow-scripts" srcdoc="{html.escape(self.page)}" '
            f'style="width: 100%; height: {_HEIGHT_PX}px; border: none" title="point cloud"></iframe>'
        )


def display_points(points_mm: np.ndarray, field: CloudField, values: np.ndarray | None) -> CloudDisplay:
    """Return the view of points (N, 3) in the OCS, mm, coloured by values; see `choose_points`."""
    figures = FigureCollector()
    points, caption = choose_points(points_mm, field, values, most=MOST_SHOWN)
    view = figures.add_cloud(points, caption)
    return CloudDisplay(render_page("uwlts.pages", "cloud_display.html.j2", interactive=figures, view=view))


def show(display: CloudDisplay) -> None:
    """Show a view in the running notebook's cell, or else in the browser, by a file whose path is printed.

    OutputError if the file cannot be written.
    """
    # Kernels of notebooks have imported ipykernel; IPython in a terminal shows no HTML.
    if "ipykernel" in sys.modules:
        sys.modules["IPython"].display.display(display)
        return
    path = Path(tempfile.mkdtemp(prefix="uwlts-")) / "cloud.html"
    write_page(path, display.page)
    opened = webbrowser.open(path.as_uri())
    print(f"point cloud: {path}{'' if opened else ' (no browser was found: open this file)'}")
