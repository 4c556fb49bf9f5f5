"""The stripes of all laser images of a capture, and why images show none."""

from collections.abc import Iterable
from typing import Literal

import cv2
import numpy as np

from uwlts.errors import CaptureError, ImageError
from uwlts.model.stripe import CaptureStripes, StripeStatus
from uwlts.runtime.progress import ProgressListener, unheard
from uwlts.stripe.exposures import BracketImages, fused_images
from uwlts.stripe.extract import direct_stripe_in, extract_stripe
from uwlts.stripe.options import StripeOptions, StripeSettings

BLACK = 0.02
"""Share of the full scale that no pixel of a black image reaches: above offset and noise of a covered lens."""

WHITE = 0.5
"""Share of clipped pixels above which an image is white: lit targets and stripes clip in spots only."""

FEWEST_LINES = 20
"""Profile lines with a stripe from which an image shows one; noise passes for it on single lines."""

_CLEARLY = 3
"""A stripe runs across if so many times as many lines show it when the image is read the other way; a right one is
seen on a fifth of as many, at its steep places."""


def find_stripes(
    capture: BracketImages, *, options: StripeSettings = None, progress: ProgressListener = unheard
) -> CaptureStripes:
    """Find the stripe in all laser images of a recording, such as an opened `uwlts.storage.capture.Capture`.

    Centre lines of a 3D camera are taken as they are, less the lines at their ends (`StripeOptions.end_lines`).

    Images of one place at several exposures are fused (`uwlts.stripe.exposures`); their stripe has the number of the
    longest exposure, and amplitudes are in its grey levels. Under the rule `PeakRule.DIRECT`, the default, reflections
    are left out (`uwlts.stripe.direct`).

    ``options`` are as for `StripeOptions.of`. ``progress`` is called after each image with the number of images done
    and the number in all. CaptureError where the recording holds no laser image, or none of them shows a stripe.
    """
    along, full_dn = capture.header.sensor.camera.stripe_along, capture.header.saturation_dn
    chosen = StripeOptions.of(capture.header.sensor, options)
    found: list[tuple[np.ndarray, ...]] = []
    numbers: list[int] = []

    for number, seen, saturation in fused_images(capture):
        stripe = direct_stripe_in(seen, stripe_along=along, options=chosen, saturation=saturation)
        numbers.append(number)
        good = stripe.lines
        of_lines = (values[good] for values in (stripe.centre_px, stripe.amplitude, stripe.width_px))
        found.append((stripe.status, good, *of_lines))
        progress(number + 1, len(capture))
    if not found:
        raise CaptureError(
            f"{capture.path.name} holds no image with the laser on among {len(capture)}: nothing to reconstruct"
        )
    status_of_lines, *columns = map(np.concatenate, zip(*found, strict=True))
    statuses = np.bincount(status_of_lines, minlength=len(StripeStatus))
    by_status = {status.name.lower(): int(statuses[status]) for status in StripeStatus}
    if statuses[StripeStatus.OK] == 0:
        if not capture.has_image[capture.laser_on].all():
            raise CaptureError(
                f"no stripe in any of the {len(found)} centre lines of {capture.path.name}: is the laser on, the "
                "camera's threshold low enough, the object in view?"
            )
        lit = (capture.image(number) for number in np.flatnonzero(capture.laser_on).tolist())
        reason = why_no_stripe(lit, stripe_along=along, full_dn=full_dn)
        raise CaptureError(f"no stripe in any of the {len(found)} laser images of {capture.path.name}: {reason}")
    frame = np.repeat(numbers, [len(good) for _, good, *_ in found])
    return CaptureStripes(frame, *columns, lines_by_status=by_status)


def is_black(image: np.ndarray, full_dn: float) -> bool:
    """Whether nothing in an image (H, W) is above offset and noise; single hot pixels shine in the dark too."""
    return bool(cv2.medianBlur(image, 3).max() < BLACK * full_dn)


def white_share(image: np.ndarray, full_dn: float) -> float:
    """Share of the pixels of an image (H, W) that clip."""
    return float(np.mean(image >= full_dn))


def shown_stripe(image: np.ndarray, *, stripe_along: str) -> Literal["along", "across"] | None:
    """Direction in which an image (H, W) shows a stripe, or several: along the side that is given, or the other one."""
    along = _lines_with_stripe(image, stripe_along)
    across = _lines_with_stripe(image, "height" if stripe_along == "width" else "width")
    if across >= FEWEST_LINES and across > _CLEARLY * along:
        return "across"
    return "along" if along >= FEWEST_LINES else None


def why_no_stripe(images: Iterable[np.ndarray], *, stripe_along: str, full_dn: int) -> str:
    """Reason why images (H, W) show no stripe, and what to do about it; ``full_dn`` is where pixels clip."""
    count = black = white = across = 0
    for image in images:
        count += 1
        if is_black(image, full_dn):
            black += 1
        elif white_share(image, full_dn) > WHITE:
            white += 1
        else:
            across += shown_stripe(image, stripe_along=stripe_along) == "across"

    def so_many(some: int) -> str:
        return "all are" if some == count else f"{some} of {count} are"

    if black > count / 2:
        return (
            f"{so_many(black)} black, no pixel reaches {100 * BLACK:g} % of full scale: is the laser on, the "
            "exposure long enough, the lens open?"
        )
    if white > count / 2:
        return f"{so_many(white)} white, saturated over more than half of their pixels: expose shorter"
    if across:
        return (
            f"in {across} of {count} one runs across: the images are turned by a quarter turn, or the sensor's "
            f"stripe_along ('{stripe_along}') is wrong"
        )
    return (
        "no bright line stands out of their background: are they laser images, is the exposure long enough, the "
        "object in view?"
    )


def _lines_with_stripe(image: np.ndarray, along: str) -> int:
    """Number of profile lines with a stripe, or several."""
    try:
        status = extract_stripe(image, stripe_along=along).status
    except ImageError:
        # Too few pixels to tell a stripe from its background.
        return 0
    return int(np.count_nonzero((status != StripeStatus.NO_STRIPE) & (status != StripeStatus.SATURATED)))
