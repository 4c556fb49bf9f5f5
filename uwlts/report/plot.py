"""Static plots with matplotlib axes: `cloud`, `stripe` (a laser image with its centres) and `residuals`.

Every function draws into ``ax``, or into a new figure in the style of the pages, and returns the axes;
``ax.figure.savefig(...)`` saves them. `uwlts.pages.toolkit.figure_svg` converts a figure for a page.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from itertools import product
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.colors import LinearSegmentedColormap
from matplotlib.ticker import MaxNLocator
from mpl_toolkits.mplot3d import Axes3D, proj3d

from uwlts.argument_types import check_arguments
from uwlts.errors import CalibrationError, ImageError
from uwlts.files.json_files import number_list
from uwlts.model.calibration import Calibration
from uwlts.pages.cloud_figure import AZIMUTH_DEG, ELEVATION_DEG, STOPS, CloudField, scale_values, view_direction
from uwlts.pages.toolkit import BLUE, INK, make_figure, new_figure, plain_text
from uwlts.storage.capture import Frame
from uwlts.storage.cloud import PointCloud
from uwlts.stripe import Stripe

__all__ = ["cloud", "residuals", "stripe"]
__dir__ = __all__.copy  # what notebooks offer

DEVIATIONS = LinearSegmentedColormap.from_list(
    "deviations", [(place, (red / 255, green / 255, blue / 255)) for place, (red, green, blue) in STOPS]
)
"""Blue below, grey at zero, red above."""

_STYLES: dict[CloudField, tuple[str, Any]] = {
    "deviation": ("deviation", DEVIATIONS),
    "depth": ("Z", "viridis"),
    "intensity": ("brightness", "cividis"),
    "random": ("random standard uncertainty", "viridis"),
    "common": ("common standard uncertainty", "viridis"),
}
"""Names and colours of the quantities of points."""

UNKNOWN = "#555550"
"""Colour of points without a deviation in a cloud with deviations."""
PLAIN = "#5d82a8"
"""Colour of points in a cloud without deviations."""
ORANGE = "#ff7800"
"""Colour of stripe centres."""
_SHORT_LIST = 3  # lists of residuals up to this length are not drawn

_UNITS = {"px": "px", "mm": "mm", "deg": "°", "rad": "rad", "nm": "nm"}  # of names of residuals
# Residuals within this ratio are drawn as dots: bars, which start at zero, would all look the same.
_FLAT = 1.2
# Fraction of a surface's points within the colour range.
_SHOWN_SHARE = 0.995
# Margin shown on either side of a stripe, px.
_AROUND_PX = 24
# Image lines in the enlarged part.
_LINES_ENLARGED = 44
# Margin on either side of a stripe in the enlarged part, px.
_AROUND_ENLARGED_PX = 7


@check_arguments
def cloud(cloud: PointCloud, ax: Axes3D | None = None, colour: CloudField = "deviation") -> Axes3D:
    """Draw all points of a cloud, seen obliquely from the sensor's side, with equal scales and without perspective.

    Parameters
    ----------
    cloud
        The cloud; X, Y and Z in mm, Z pointing away from the sensor.
    ax
        Three-dimensional axes.
    colour
        Quantity shown by colour: "deviation" from the fitted or true surface, limited to two standard deviations;
        "depth" Z; "intensity", the brightness of the stripe; or "random" or "common", the standard
        uncertainty along the surface normal by noise, or by errors that all points share.
    """
    if ax is None:
        # The axes are square, as wide as the space beside the colour bar, and clipped by the figure vertically.
        figure, side, room = make_figure(11.2, 6.0, layout=None, shown=True), 0.86, (0.84, 0.84 * 6.0 / (0.86 * 11.2))
        height = side * 11.2 / 6.0
        ax = Axes3D(figure, (0.02, 0.5 - height / 2, side, height))
        figure.add_axes(ax)
        legend_at, bar = figure.transFigure, figure.add_axes((0.92, 0.2, 0.02, 0.6))
    else:
        room, legend_at, bar = (0.8, 0.8), ax.transAxes, None
    ax.view_init(elev=-ELEVATION_DEG, azim=180 + AZIMUTH_DEG, roll=180)
    ax.set_proj_type("ortho")
    if not len(cloud):
        ax.set_axis_off()
        ax.text2D(0.5, 0.5, "the cloud has no points", transform=ax.transAxes, ha="center")
        return ax
    low, high = cloud.points_mm.min(axis=0), cloud.points_mm.max(axis=0)
    half = np.maximum(0.52 * (high - low), 0.02 * max(1e-6, float((high - low).max())))
    low, high = (low + high) / 2 - half, (low + high) / 2 + half
    # The farthest points are drawn first, so that the nearest remain visible.
    points = cloud.points_mm[order := np.argsort(-(cloud.points_mm @ view_direction()), kind="stable")]
    values = cloud.field_values(colour)
    size = float(np.clip(1e5 / len(cloud), 1.0, 16.0))
    style: dict[str, Any] = {"s": size, "linewidths": 0, "depthshade": False, "rasterized": True}
    if values is None or not np.isfinite(values).any():
        ax.scatter(*points.T, color=PLAIN, **style)
        if bar is not None:
            bar.remove()
    else:
        values, unit, limit = scale_values(values[order], colour)
        known = np.isfinite(values)
        if not known.all():
            ax.scatter(*points[~known].T, color=UNKNOWN, label="not evaluated", **style)
            ax.legend(loc="upper left", bbox_to_anchor=(0, 1), bbox_transform=legend_at, markerscale=3, frameon=False)
        style |= {} if limit is None else {"vmin": -limit, "vmax": limit}
        name, colours = _STYLES[colour]
        drawn = ax.scatter(*points[known].T, c=values[known], cmap=colours, **style)
        ax.figure.colorbar(drawn, cax=bar, ax=None if bar else ax, label=f"{name} / {unit}")
    for axis, name, start, end in zip((ax.xaxis, ax.yaxis, ax.zaxis), "XYZ", low, high, strict=True):
        axis.set_label_text(f"{name} / mm")
        axis.labelpad = 18
        axis.set_view_interval(start, end, ignore=True)
        axis.set_major_locator(MaxNLocator(max(2, round(9 * (end - start) / (high - low).max()))))
        axis.pane.set_facecolor("white")  # pyright: ignore[reportAttributeAccessIssue]
    ax.set_box_aspect(high - low)
    corners = np.array(list(product(*zip(low, high, strict=True))))
    x, y, _ = proj3d.proj_transform(corners[:, 0], corners[:, 1], corners[:, 2], ax.get_proj())
    width, height = room[0] * ax.viewLim.width / np.ptp(x), room[1] * ax.viewLim.height / np.ptp(y)
    ax.set_box_aspect(high - low, zoom=min(width, height))
    return ax


def deviation_colours(deviation_mm: np.ndarray, limit_mm: float) -> np.ndarray:
    """Return red, green and blue (N, 3) uint8 of deviations (N,): `DEVIATIONS` up to the limit, `UNKNOWN` for NaN."""
    shown = DEVIATIONS.with_extremes(bad=UNKNOWN)
    return shown(np.ma.masked_invalid((deviation_mm / limit_mm + 1) / 2), bytes=True)[:, :3]


def surface_limit_mm(distance_mm: np.ndarray) -> float:
    """Return the limit of a surface's distance colours: the 99.5 % quantile of absolute distances, above zero."""
    known = distance_mm[np.isfinite(distance_mm)]
    return (float(np.quantile(np.abs(known), _SHOWN_SHARE)) if len(known) else 0.0) or 1e-3


@check_arguments
def stripe(
    image: np.ndarray | Frame, stripe: Stripe | None = None, ax: Axes | None = None, *, enlarged: bool = False
) -> Axes:
    """Draw a laser image; with a stripe, draw the part around it and the centres found.

    The stripe is horizontal: images with the stripe along the height are transposed. Integers on the axes are pixel
    centres.

    Parameters
    ----------
    image
        Image (H, W), or a frame of a capture. Square roots of its grey values are shown, which makes faint ends of a
        stripe visible.
    stripe
        The stripe found in the image.
    ax
        Axes to draw into.
    enlarged
        Show the brightest part of the stripe, with linear grey values and connected centres.
    """
    grey = image.image if isinstance(image, Frame) else image
    if grey.ndim != 2:
        raise ImageError(f"`image` has the shape {grey.shape}; expected rows and columns of grey values")
    ax = _choose_axes(ax, 11.2, 4.0)
    names = ("column u / px", "row v / px")
    if stripe is not None and stripe.stripe_along == "height":
        grey, names = grey.T, names[::-1]
    grey_values = grey.astype(np.float32)
    if enlarged:
        ax.imshow(grey_values, cmap="gray", interpolation="nearest", vmin=0)
    else:
        ax.imshow(np.sqrt(np.maximum(grey_values, 0)), cmap="gray", interpolation="antialiased", vmin=0)
    ax.set(xlabel=names[0], ylabel=names[1])
    for axis in (ax.xaxis, ax.yaxis):
        axis.set_major_locator(MaxNLocator(integer=True))
    ax.grid(visible=False)
    if stripe is None or not len(stripe.lines):
        return ax
    lines = _choose_lines(stripe, enlarged=enlarged)
    centres = stripe.centre_px[lines]
    margin = _AROUND_ENLARGED_PX if enlarged else _AROUND_PX
    left, right = max(0, int(lines.min()) - 2), min(grey.shape[1] - 1, int(lines.max()) + 2)
    top = max(0, int(np.floor(centres.min())) - margin)
    bottom = min(grey.shape[0] - 1, int(np.ceil(centres.max())) + margin)
    ax.set(xlim=(left - 0.5, right + 0.5), ylim=(bottom + 0.5, top - 0.5))
    if not enlarged:
        ax.plot(lines, centres, ".", color=ORANGE, markersize=1.5, label=f"{len(lines)} stripe centres")
        return ax
    # Keep gaps between image lines.
    gaps = np.flatnonzero(np.diff(lines) > 1) + 1
    x, y = (np.insert(values.astype(float), gaps, np.nan) for values in (lines, centres))
    ax.plot(x, y, ".-", color=ORANGE, linewidth=1, markersize=7, label="centre found on each line")
    ax.images[0].set_clim(0, float(grey[top : bottom + 1, left : right + 1].max()) or 1)
    return ax


def _choose_lines(stripe: Stripe, *, enlarged: bool) -> np.ndarray:
    """Return the image lines shown: all of the stripe, or in the enlarged view adjacent ones with the most light."""
    if not enlarged:
        return stripe.lines
    count = min(_LINES_ENLARGED, len(stripe.lines))
    first = int(np.argmax(np.convolve(np.nan_to_num(stripe.amplitude), np.ones(count), mode="valid")))
    return stripe.lines[(stripe.lines >= first) & (stripe.lines < first + count)]


@check_arguments
def residuals(calibration: Calibration, ax: Axes | None = None, *, which: str | None = None) -> Axes:
    """Draw one list of a calibration's residuals by image.

    Parameters
    ----------
    calibration
        The calibration.
    ax
        Axes to draw into.
    which
        Step and name of the list, such as "camera.image_rms_px"; by default the first one with more than three numbers.

    Raises
    ------
    CalibrationError
        The calibration does not contain this list, or none.
    """
    lists = {
        f"{group}.{name}": values
        for group, name, value in _list_entries(calibration.residuals_in_file())
        if len(values := number_list(value) or ()) > _SHORT_LIST and any(each is not None for each in values)
    }
    if which is None and not lists:
        raise CalibrationError("the calibration stores no list of residuals")
    which = which or next(iter(lists))
    if which not in lists:
        raise CalibrationError(f"the calibration stores no list of residuals {which}; it has {', '.join(lists)}")
    (group, _, name), values = which.rpartition("."), lists[which]
    stored = calibration.figures(group).get("images")
    images = [image for image in stored if isinstance(image, str)] if isinstance(stored, list) else []
    images = images if len(images) == len(values) else []
    ax = _choose_axes(ax)
    places = np.arange(1, len(values) + 1)
    heights = np.array([np.nan if value is None else value for value in values])
    if np.nanmin(heights) > 0 and np.nanmax(heights) < _FLAT * np.nanmin(heights):
        ax.plot(places, heights, "o", color=BLUE, markersize=5)
    else:
        ax.bar(places, heights, color="#7fa6cc")
        ax.axhline(0, color=INK, linewidth=0.8)
    stem, _, ending = name.rpartition("_")
    unit = _UNITS.get(ending, "") if stem else ""
    text = (stem if unit else name).replace("_", " ")
    ax.set(
        xlabel="image" if images or "image" in name else "number",
        ylabel=plain_text(f"{text} / {unit}" if unit else text),
    )
    if images:
        ax.set_xticks(
            places, list(map(plain_text, images)), rotation=40, ha="right", rotation_mode="anchor", fontsize=7
        )
    return ax


def _list_entries(table: Mapping[str, Any], group: str = "") -> Iterator[tuple[str, str, Any]]:
    """Iterate over group, name and value of the entries of nested tables; a group is the names of its tables."""
    for name, value in table.items():
        if isinstance(value, dict):
            yield from _list_entries(value, f"{group} {name}".strip())
        else:
            yield group, name, value


def _choose_axes(ax: Axes | None, *size: float) -> Axes:
    return new_figure(*size, shown=True)[1][0] if ax is None else ax
