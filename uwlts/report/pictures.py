"""Pictures of a campaign's measurements: stripe and cloud as PNG, deviations as SVG."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from markupsafe import Markup
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.patches import Rectangle

from uwlts.files.writing import write_atomically
from uwlts.pages.cloud_display import choose_points
from uwlts.pages.cloud_figure import CloudPoints
from uwlts.pages.toolkit import figure_png, figure_svg, new_figure
from uwlts.report import plot
from uwlts.report.gather import GatheredCampaign, GatheredMeasurement
from uwlts.runtime.workers import Send, run_jobs
from uwlts.storage.capture import Capture, drawable_image
from uwlts.storage.cloud import PointCloud
from uwlts.stripe import Stripe, find_stripe

# Width of a picture, inches.
_WIDTH_IN = 11.2
# Largest height of a picture, inches.
_TALLEST_IN = 4.4
# An image with fewer stripe centres than this is regarded as having no stripe.
_LEAST_LINES = 8
MOST_POINTS = 12_000
"""Largest number of points in an interactive cloud, which take about 60 kB of a page."""


@dataclass(frozen=True, eq=False)
class StripeView:
    """A laser image (H, W) of a capture (black if only centre lines exist), its number, and its stripe."""

    frame: int
    image: np.ndarray
    stripe: Stripe


def stripe_view(capture: Capture) -> StripeView | None:
    """Return the laser image nearest to the middle of a capture that shows a stripe; None if no image does."""
    header = capture.header
    laser = np.flatnonzero(capture.laser_on)
    for place in np.argsort(np.abs(np.arange(len(laser)) - (len(laser) - 1) / 2), kind="stable"):
        frame = int(laser[place])
        seen, camera = capture.read_observation(frame), header.sensor.camera
        stripe = find_stripe(seen, stripe_along=camera.stripe_along, saturation=header.saturation_dn)
        if len(stripe.lines) >= _LEAST_LINES:
            return StripeView(frame, drawable_image(seen, camera), stripe)
    return None


def stripe_picture(view: StripeView) -> Figure:
    """Draw the stripe with its centres on top, and the brightest part of it pixel by pixel below."""
    shape = view.image.shape if view.stripe.stripe_along == "width" else view.image.T.shape
    windows = [plot.stripe_window(view.stripe, shape, enlarged=enlarged) for enlarged in (False, True)]
    # Pixels are square; axis labels and titles need about 0.8 inches.
    heights = [
        0.8 + min(_TALLEST_IN, _WIDTH_IN * (bottom - top + 1) / (right - left + 1))
        for left, right, top, bottom in windows
    ]
    figure, (upper, lower) = new_figure(_WIDTH_IN, sum(heights), rows=2, height_ratios=heights)
    plot.stripe(view.image, view.stripe, upper)
    plot.stripe(view.image, view.stripe, lower, enlarged=True)
    left, right, top, bottom = windows[1]
    part = Rectangle((left - 0.5, top - 0.5), right - left + 1, bottom - top + 1, fill=False, edgecolor="#5ae6e6")
    upper.add_patch(part)
    centres = f"{len(view.stripe.lines)} stripe centres (orange)"
    upper.set_title(f"image {view.frame}: {centres}; square root of grey values", fontsize=9)
    lower.set_title("marked part, magnified, with the centre found on each line", fontsize=9)
    return figure


@dataclass(frozen=True)
class MeasurementPictures:
    """A measurement's stripe and cloud as PNG, and its deviations (histogram, along the stripe) as SVG.

    A picture is None without a capture that shows a stripe, without a cloud, or without deviations.
    """

    name: str
    stripe: bytes | None
    cloud: bytes | None
    histogram: Markup | None
    along: Markup | None


def draw_pictures(campaign: GatheredCampaign, *, workers: int = 1) -> list[MeasurementPictures]:
    """Draw the pictures of a campaign's measurements, in order, in ``workers`` processes.

    CaptureError if an image of a capture is damaged.
    """
    return run_jobs(_draw_measurement, campaign.measurements, workers=workers)


def _draw_measurement(measurement: GatheredMeasurement, send: Send) -> MeasurementPictures:
    view, cloud = None, measurement.cloud
    if measurement.capture is not None:
        with Capture(measurement.capture.path) as capture:
            view = stripe_view(capture)
    return MeasurementPictures(
        measurement.name,
        None if view is None else figure_png(stripe_picture(view), few_colours=True),
        None if cloud is None else figure_png(plot.cloud(cloud), few_colours=True),
        None if cloud is None else svg_if_any(plot.deviation_histogram, cloud),
        None if cloud is None else svg_if_any(plot.along_stripe, cloud),
    )


def cloud_points(cloud: PointCloud) -> tuple[CloudPoints, str]:
    """Return points for an interactive view, seen from the sensor, and its caption."""
    if cloud.deviation_mm is not None:
        return choose_points(cloud.points_mm, "deviation", cloud.field_values("deviation"), most=MOST_POINTS)
    shown, caption = choose_points(cloud.points_mm, "depth", None, most=MOST_POINTS)
    return shown, f"{caption} The file holds no deviations; let the evaluation write a coloured cloud to see them here."


def svg_if_any(draw: Callable[..., Axes], shown: object, **options: Any) -> Markup | None:
    """Return a plot as SVG; None if there is nothing to draw."""
    try:
        return figure_svg(draw(shown, **options))
    except plot.NothingToDrawError:
        return None


def write_pictures(
    folder: str | Path, pictures: Sequence[MeasurementPictures], *, overwrite: bool = False
) -> list[Path]:
    """Write ``stripe-NAME.png`` and ``cloud-NAME.png`` of every measurement, if available; return the paths.

    OutputError if the folder is missing, or a picture exists and ``overwrite`` is not given.
    """
    written = []
    for each in pictures:
        for kind, picture in (("stripe", each.stripe), ("cloud", each.cloud)):
            if picture is not None:
                path = Path(folder) / f"{kind}-{each.name}.png"
                with write_atomically(path, overwrite=overwrite) as aside:
                    aside.write_bytes(picture)
                written.append(path)
    return written
