"""A laser image with the stripe centres found in it: the stripe's surroundings, and some of its pixels enlarged."""

from dataclasses import dataclass

import cv2
import numpy as np

from uwlts.capture import Capture
from uwlts.report.canvas import INK, ORANGE, blank, dot, line, ticks, write, write_upwards
from uwlts.stripe import Stripe, extract_stripe

_WIDTH, _LEFT, _RIGHT, _TOP, _BOTTOM = 1120, 70, 14, 26, 44
_TALLEST = 460
_AROUND_PX = 24
_LINES_ENLARGED = 44
_LEAST_LINES = 8


@dataclass(frozen=True, eq=False)
class StripeView:
    """A laser image (H, W) of a capture, its number, and the stripe found in it."""

    frame: int
    image: np.ndarray
    stripe: Stripe


def stripe_view(capture: Capture) -> StripeView | None:
    """The laser image nearest to the middle of a capture that shows a stripe; None where none does."""
    header = capture.header
    laser = np.flatnonzero(capture.laser_on)
    for place in np.argsort(np.abs(np.arange(len(laser)) - (len(laser) - 1) / 2), kind="stable"):
        frame = int(laser[place])
        image = capture.image(frame)
        stripe = extract_stripe(image, stripe_along=header.sensor.camera.stripe_along, saturation=header.saturation_dn)
        if len(stripe.lines) >= _LEAST_LINES:
            return StripeView(frame, image, stripe)
    return None


def stripe_picture(view: StripeView) -> np.ndarray:
    """Picture (H, W, 3) uint8: above the stripe with its centres, below the brightest part of it pixel by pixel.

    The stripe always lies: an image in which it runs along the height is shown with rows and columns exchanged. The
    upper part shows the square root of the grey values, so that the faint ends can be seen; the lower part is linear.
    """
    along_width = view.stripe.stripe_along == "width"
    grey = (view.image if along_width else view.image.T).astype(np.float32)
    names = ("column u / px", "row v / px") if along_width else ("row v / px", "column u / px")
    lines, centres = view.stripe.lines, view.stripe.centre_px[view.stripe.lines]
    whole = _Crop.around(lines, centres, grey.shape, margin=_AROUND_PX)
    chosen = _brightest(view.stripe, min(_LINES_ENLARGED, len(lines)))
    enlarged = _Crop.around(lines[chosen], centres[chosen], grey.shape, margin=7)

    upper = _panel(np.sqrt(np.maximum(whole.of(grey), 0)), whole, names, cv2.INTER_AREA)
    upper.mark(enlarged)
    for number, centre in zip(lines, centres, strict=True):
        dot(upper.picture, *upper.at(number, centre), radius=0.5, colour=ORANGE)
    title = f"image {view.frame}: {len(lines)} stripe centres (orange); square root of grey values"
    write(upper.picture, title, _LEFT, 12)

    lower = _panel(enlarged.of(grey), enlarged, names, cv2.INTER_NEAREST)
    at = np.array([lower.at(n, c) for n, c in zip(lines[chosen], centres[chosen], strict=True)])
    for run in np.split(at, np.flatnonzero(np.diff(lines[chosen]) > 1) + 1):
        line(lower.picture, run, colour=ORANGE)
    for x, y in at:
        dot(lower.picture, x, y, radius=max(1.5, lower.scale[0] / 6), colour=ORANGE)
    write(lower.picture, "the marked part, pixel by pixel, with the centre found on each line", _LEFT, 12)
    return np.vstack([upper.picture, lower.picture])


@dataclass(frozen=True)
class _Crop:
    """Part of an image: first line and pixel, and the number of both."""

    line: int
    pixel: int
    lines: int
    pixels: int

    @classmethod
    def around(cls, lines: np.ndarray, centres: np.ndarray, shape: tuple[int, ...], *, margin: int) -> "_Crop":
        first, last = max(0, int(lines.min()) - 2), min(shape[1] - 1, int(lines.max()) + 2)
        low = max(0, int(np.floor(centres.min())) - margin)
        high = min(shape[0] - 1, int(np.ceil(centres.max())) + margin)
        return cls(first, low, last - first + 1, high - low + 1)

    def of(self, grey: np.ndarray) -> np.ndarray:
        return grey[self.pixel : self.pixel + self.pixels, self.line : self.line + self.lines]


@dataclass(frozen=True, eq=False)
class _Panel:
    picture: np.ndarray
    crop: _Crop
    scale: tuple[float, float]

    def at(self, number: float, pixel: float) -> tuple[float, float]:
        """Where the centre of a pixel is drawn: half a pixel after its edge."""
        return (
            _LEFT + (number - self.crop.line + 0.5) * self.scale[0] - 0.5,
            _TOP + (pixel - self.crop.pixel + 0.5) * self.scale[1] - 0.5,
        )

    def mark(self, crop: _Crop) -> None:
        """Frame a part of the image."""
        low = self.at(crop.line - 0.5, crop.pixel - 0.5)
        high = self.at(crop.line + crop.lines - 0.5, crop.pixel + crop.pixels - 0.5)
        corners = tuple(map(round, low)), tuple(map(round, high))
        cv2.rectangle(self.picture, *corners, (230, 230, 90), 1, cv2.LINE_AA)


def _panel(grey: np.ndarray, crop: _Crop, names: tuple[str, str], interpolation: int) -> _Panel:
    width = _WIDTH - _LEFT - _RIGHT
    height = min(_TALLEST, max(40, round(width * crop.pixels / crop.lines)))
    if height < _TALLEST or interpolation == cv2.INTER_NEAREST:
        # Square pixels; a tall part gets narrower instead.
        square = min(width / crop.lines, _TALLEST / crop.pixels)
        width, height = round(square * crop.lines), round(square * crop.pixels)
    else:
        width = round(height * crop.lines / crop.pixels)
    shown = cv2.resize(grey, (width, height), interpolation=interpolation)
    brightest = float(shown.max())
    shown = np.round(shown * (255 / brightest if brightest > 0 else 0)).astype(np.uint8)
    picture = blank(_WIDTH, _TOP + height + _BOTTOM)
    picture[_TOP : _TOP + height, _LEFT : _LEFT + width] = shown[:, :, None]
    panel = _Panel(picture, crop, (width / crop.lines, height / crop.pixels))
    for number in ticks(crop.line, crop.line + crop.lines - 1, count=max(2, width // 110)):
        x, bottom = panel.at(number, 0)[0], _TOP + height
        line(picture, np.array([(x, bottom), (x, bottom + 5)]), colour=INK)
        write(picture, f"{number:g}", x, bottom + 14, align="middle", size=0.45)
    for number in ticks(crop.pixel, crop.pixel + crop.pixels - 1, count=max(3, height // 60)):
        y = panel.at(0, number)[1]
        line(picture, np.array([(_LEFT - 5, y), (_LEFT, y)]), colour=INK)
        write(picture, f"{number:g}", _LEFT - 9, y, align="right", size=0.45)
    write(picture, names[0], _LEFT + width / 2, _TOP + height + 32, align="middle")
    write_upwards(picture, names[1], 14, _TOP + height / 2)
    return panel


def _brightest(stripe: Stripe, count: int) -> np.ndarray:
    """Indices into the stripe's lines: the ``count`` neighbouring image lines with the most light in the stripe."""
    amplitude = np.nan_to_num(stripe.amplitude)
    first = int(np.argmax(np.convolve(amplitude, np.ones(count), mode="valid")))
    return np.flatnonzero((stripe.lines >= first) & (stripe.lines < first + count))
