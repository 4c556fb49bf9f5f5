"""Picture of the stripe in a capture."""

from dataclasses import dataclass

import numpy as np
from matplotlib.figure import Figure
from matplotlib.patches import Rectangle

from uwlts.pages.toolkit import new_figure
from uwlts.report import plot
from uwlts.storage.capture import Capture, drawable_image
from uwlts.stripe import Stripe, find_stripe

# Width of a picture, inches.
_WIDTH_IN = 11.2
# Largest height of a picture, inches.
_TALLEST_IN = 4.4
# An image with fewer stripe centres than this is regarded as having no stripe.
_LEAST_LINES = 8


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
