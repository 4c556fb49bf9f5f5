"""Stripes of all laser images of a capture, and reasons for missing stripes."""

import math
from collections.abc import Iterable, Iterator
from typing import Literal

import cv2
import numpy as np

from uwlts.errors import CaptureError, ImageError
from uwlts.model.stripe import CaptureStripes, Stripe, StripeStatus
from uwlts.runtime.progress import ProgressListener, ignore_progress
from uwlts.runtime.workers import map_in_threads
from uwlts.stripe.exposures import BracketImages, fuse_brackets
from uwlts.stripe.extract import direct_stripe_in
from uwlts.stripe.options import StripeOptions, StripeSettings

BLACK = 0.02
"""Largest grey value of a black image, as a fraction of the full scale: above offset and noise of a covered lens."""

WHITE = 0.5
"""Fraction of clipped pixels above which an image is white: lit targets and stripes clip in small regions only."""

FEWEST_LINES = 20  # fewest profile lines of a stripe; on single lines noise may resemble a stripe

_ACROSS_RATIO = 3
"""Ratio of lines with a stripe in both reading directions above which the stripe runs across. A stripe along the given
side has a ratio of about 0.2, from its steep places."""

_REFUSED = {
    StripeStatus.AMBIGUOUS: "show several stripes, and none is certainly the laser's own: remove or cover what "
    "reflects, or choose one by the setting peak",
    StripeStatus.BORDER: "show a stripe cut off by the image's border: move the sensor or the object",
    StripeStatus.SATURATED: "are saturated over more than the width of a stripe: reduce the exposure",
    StripeStatus.END: "show pieces of a stripe shorter than the ends that are left out: increase the exposure, or "
    "reduce the setting end_lines",
}
"""Content of lines with light but without a centre, and advice."""


def find_stripes(
    capture: BracketImages, *, options: StripeSettings = None, progress: ProgressListener = ignore_progress
) -> CaptureStripes:
    """Find the stripe in all laser images of a recording, such as an open `uwlts.storage.capture.Capture`.

    Images of one place at several exposures are fused (`uwlts.stripe.exposures`). Their stripe has the number of the
    longest exposure, and amplitudes in its grey levels. Under the default rule `PeakRule.DIRECT`, reflections are
    removed (`uwlts.stripe.direct`).

    One thread reads the images, and one thread per processor extracts stripes. A few images are in memory at a time,
    and the result does not depend on the number of processors.

    `StripeOptions.of` describes the options. ``progress`` is called after each image with the number of processed
    images and the total number. CaptureError if the recording has no laser image, or none that shows a stripe.
    """
    (whole,) = find_stripes_in_parts(capture, math.inf, options=options, progress=progress)
    return whole


def find_stripes_in_parts(
    capture: BracketImages, most: float, *, options: StripeSettings = None, progress: ProgressListener = ignore_progress
) -> Iterator[CaptureStripes]:
    """Find the stripes as `find_stripes`, and yield them in parts of ``most`` to twice as many centres, or all."""
    along, full_dn = capture.header.sensor.camera.stripe_along, capture.header.saturation_dn
    chosen = StripeOptions.resolve(capture.header.sensor, options)
    # Image, statuses of its lines, and lines, centres, amplitudes and widths of its stripe.
    found: list[tuple[int, np.ndarray, list[np.ndarray]]] = []
    held = 0

    def extract(place: tuple[int, np.ndarray, float]) -> Stripe:
        return direct_stripe_in(place[1], stripe_along=along, options=chosen, saturation=place[2])

    for (number, _, _), stripe in map_in_threads(extract, fuse_brackets(capture)):
        good = stripe.lines
        of_lines = (values[good] for values in (stripe.centre_px, stripe.amplitude, stripe.width_px))
        found.append((number, stripe.status, [good, *of_lines]))
        held += len(good)
        progress(number + 1, len(capture))
        if held >= 2 * most:
            counts = np.cumsum([len(columns[0]) for _, _, columns in found])
            first = 1 + int(np.searchsorted(counts, most))
            yield _join(found[:first])
            found, held = found[first:], held - int(counts[first - 1])
    if not found:
        raise CaptureError(
            f"{capture.path.name} has {len(capture)} images, none of them with the laser on: nothing to reconstruct"
        )
    if not held:
        lit = (capture.image(number) for number in np.flatnonzero(capture.laser_on).tolist())
        reason = explain_missing_stripe(lit, stripe_along=along, full_dn=full_dn)
        raise CaptureError(f"no stripe in any of the {len(found)} laser images of {capture.path.name}: {reason}")
    yield _join(found)


def _join(found: list[tuple[int, np.ndarray, list[np.ndarray]]]) -> CaptureStripes:
    """Return the stripes of images: number, status of each line, and columns of the lines with a centre."""
    numbers, status, columns = zip(*found, strict=True)
    statuses = np.bincount(np.concatenate(status), minlength=len(StripeStatus))
    by_status = {each.name.lower(): int(statuses[each]) for each in StripeStatus}
    frame = np.repeat(numbers, [len(good) for good, *_ in columns])
    return CaptureStripes(frame, *map(np.concatenate, zip(*columns, strict=True)), lines_by_status=by_status)


def is_black(image: np.ndarray, full_dn: float) -> bool:
    """Return True if nothing in an image (H, W) exceeds offset and noise, except for single hot pixels."""
    return bool(cv2.medianBlur(image, 3).max() < BLACK * full_dn)


def find_stripe_direction(
    image: np.ndarray, *, stripe_along: str, saturation: float
) -> Literal["along", "across"] | None:
    """Return the direction of the stripes in an image (H, W): along the given side, across it, or None."""
    dark = StripeStatus.NO_STRIPE, StripeStatus.SATURATED
    along, across = (
        np.count_nonzero(~np.isin(_find_status(image, side, saturation), dark))
        for side in (stripe_along, "height" if stripe_along == "width" else "width")
    )
    if across >= FEWEST_LINES and across > _ACROSS_RATIO * along:
        return "across"
    return "along" if along >= FEWEST_LINES else None


def explain_missing_stripe(images: Iterable[np.ndarray], *, stripe_along: str, full_dn: int) -> str:
    """Return the reason why images (H, W) show no stripe, and advice; pixels clip at ``full_dn``."""
    count = black = white = across = 0
    statuses = np.zeros(len(StripeStatus), int)
    for image in images:
        count += 1
        if is_black(image, full_dn):
            black += 1
        elif np.mean(image >= full_dn) > WHITE:
            white += 1
        else:
            across += find_stripe_direction(image, stripe_along=stripe_along, saturation=full_dn) == "across"
            statuses += np.bincount(_find_status(image, stripe_along, full_dn), minlength=len(StripeStatus))

    def count_of(some: int) -> str:
        return "all are" if some == count else f"{some} of {count} are"

    if black > count / 2:
        return (
            f"{count_of(black)} black, no pixel reaches {100 * BLACK:g} % of full scale: is the laser on, the "
            "exposure long enough, the lens open?"
        )
    if white > count / 2:
        return f"{count_of(white)} white, saturated in more than half of their pixels: reduce the exposure"
    if across:
        return (
            f"{across} of {count} images show a stripe across the given direction: the images are rotated by 90 deg, "
            f"or the sensor's stripe_along ('{stripe_along}') is wrong"
        )
    most = max(_REFUSED, key=lambda status: statuses[status])
    if statuses[most] >= FEWEST_LINES * count:
        return f"{statuses[most]} of {statuses.sum()} profile lines {_REFUSED[most]}"
    return (
        "no bright line is above the background: are they laser images, is the exposure long enough, is the object "
        "in view?"
    )


def _find_status(image: np.ndarray, along: str, saturation: float) -> np.ndarray:
    """Return the status (L,) of each profile line; no line if they are too short to search for a stripe."""
    try:
        return direct_stripe_in(image, stripe_along=along, options=StripeOptions(), saturation=saturation).status
    except ImageError:
        return np.empty(0, np.uint8)
