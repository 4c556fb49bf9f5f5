"""Pictures of a campaign's measurements as PNG: the stripe in one image, and the cloud."""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from matplotlib.figure import Figure
from matplotlib.patches import Rectangle

from uwlts.report import plot
from uwlts.report.gather import GatheredCampaign
from uwlts.report.page_toolkit import new_figure, png_of
from uwlts.storage.capture import Capture, picture_of
from uwlts.storage.files import written_aside
from uwlts.stripe import Stripe, stripe_in

_WIDTH_IN, _TALLEST_IN = 11.2, 4.4
# An image with fewer stripe centres than this shows no stripe to speak of.
_LEAST_LINES = 8


@dataclass(frozen=True, eq=False)
class StripeView:
    """A laser image (H, W) of a capture, dark for a centre line, its number, and the stripe found in it."""

    frame: int
    image: np.ndarray
    stripe: Stripe


def stripe_view(capture: Capture) -> StripeView | None:
    """The laser image nearest to the middle of a capture that shows a stripe; None where none does."""
    header = capture.header
    laser = np.flatnonzero(capture.laser_on)
    for place in np.argsort(np.abs(np.arange(len(laser)) - (len(laser) - 1) / 2), kind="stable"):
        frame = int(laser[place])
        seen, camera = capture.seen(frame), header.sensor.camera
        stripe = stripe_in(seen, stripe_along=camera.stripe_along, saturation=header.saturation_dn)
        if len(stripe.lines) >= _LEAST_LINES:
            return StripeView(frame, picture_of(seen, camera), stripe)
    return None


def stripe_picture(view: StripeView) -> Figure:
    """Above the stripe with its centres, below the brightest part of it pixel by pixel."""
    shape = view.image.shape if view.stripe.stripe_along == "width" else view.image.T.shape
    windows = [plot.stripe_window(view.stripe, shape, enlarged=enlarged) for enlarged in (False, True)]
    # Pixels are square; the axes' labels and titles need some 0.8 inches more.
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
    lower.set_title("the marked part, pixel by pixel, with the centre found on each line", fontsize=9)
    return figure


@dataclass(frozen=True)
class MeasurementPictures:
    """A measurement's stripe and cloud as PNG; None without a capture that shows a stripe, or without a cloud."""

    name: str
    stripe: bytes | None
    cloud: bytes | None


def draw_pictures(campaign: GatheredCampaign) -> list[MeasurementPictures]:
    """Pictures of a campaign's measurements, in order; CaptureError where an image of a capture is damaged."""
    drawn = []
    for measurement in campaign.measurements:
        view = stripe = cloud = None
        if measurement.capture is not None:
            with Capture(measurement.capture.path) as capture:
                view = stripe_view(capture)
        if view is not None:
            stripe = png_of(stripe_picture(view))
        if measurement.cloud is not None:
            cloud = png_of(plot.cloud(measurement.cloud), few_colours=True)
        drawn.append(MeasurementPictures(measurement.name, stripe, cloud))
    return drawn


def write_pictures(
    folder: str | Path, pictures: Sequence[MeasurementPictures], *, overwrite: bool = False
) -> list[Path]:
    """Write ``stripe-NAME.png`` and ``cloud-NAME.png`` of every measurement that has them; returns what was written.

    Raises OutputError: the folder is missing, or a picture exists and ``overwrite`` is not given.
    """
    written = []
    for each in pictures:
        for kind, picture in (("stripe", each.stripe), ("cloud", each.cloud)):
            if picture is not None:
                path = Path(folder) / f"{kind}-{each.name}.png"
                with written_aside(path, overwrite=overwrite) as aside:
                    aside.write_bytes(picture)
                written.append(path)
    return written
