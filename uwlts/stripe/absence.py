"""Why images show no stripe: they are black, white or turned, or nothing in them tells."""

from collections.abc import Iterable

import cv2
import numpy as np

from uwlts.errors import ImageError
from uwlts.stripe.extract import extract_stripe
from uwlts.stripe.result import StripeStatus

BLACK = 0.02
"""Share of the full scale that no pixel of a black image reaches: above offset and noise of a covered lens."""

WHITE = 0.5
"""Share of clipped pixels above which an image is white: lit targets and stripes clip in spots only."""

FEWEST_LINES = 20
"""Profile lines with a stripe from which an image shows one; noise passes for it on single lines."""

_CLEARLY = 3
"""A stripe runs across if so many times as many lines show it when the image is read the other way; a right one is
seen on a fifth of as many, at its steep places."""


def is_black(image: np.ndarray, full_dn: float) -> bool:
    """Whether nothing in an image (H, W) is above offset and noise; single hot pixels shine in the dark too."""
    return bool(cv2.medianBlur(image, 3).max() < BLACK * full_dn)


def white_share(image: np.ndarray, full_dn: float) -> float:
    """Share of the pixels of an image (H, W) that clip."""
    return float(np.mean(image >= full_dn))


def has_stripe(image: np.ndarray, *, stripe_along: str) -> bool:
    """Whether an image (H, W) shows a stripe, or several."""
    lines = _lines_with_stripe(image, stripe_along)
    return lines >= FEWEST_LINES and not _more_across(image, stripe_along, lines)


def runs_across(image: np.ndarray, *, stripe_along: str) -> bool:
    """Whether a stripe runs along the other side of the image (H, W)."""
    return _more_across(image, stripe_along, _lines_with_stripe(image, stripe_along))


def _more_across(image: np.ndarray, stripe_along: str, lines: int) -> bool:
    across = _lines_with_stripe(image, "height" if stripe_along == "width" else "width")
    return across >= FEWEST_LINES and across > _CLEARLY * lines


def why_no_stripe(images: Iterable[np.ndarray], *, stripe_along: str, full_dn: int) -> str:
    """What images (H, W) without a stripe show instead, and what to do about it; ``full_dn`` is where pixels clip."""
    count = black = white = across = 0
    for image in images:
        count += 1
        if is_black(image, full_dn):
            black += 1
        elif white_share(image, full_dn) > WHITE:
            white += 1
        else:
            across += runs_across(image, stripe_along=stripe_along)
    if black > count / 2:
        return (
            f"{_so_many(black, count)} black, no pixel reaches {100 * BLACK:g} % of full scale: is the laser on, the "
            "exposure long enough, the lens open?"
        )
    if white > count / 2:
        return f"{_so_many(white, count)} white, saturated over more than half of their pixels: expose shorter"
    if across:
        return (
            f"in {across} of {count} one runs across: the images are turned by a quarter turn, or the sensor's "
            f"stripe_along ('{stripe_along}') is wrong"
        )
    return (
        "no bright line stands out of their background: are they laser images, is the exposure long enough, the "
        "object in view?"
    )


def _so_many(some: int, count: int) -> str:
    return "all are" if some == count else f"{some} of {count} are"


def _lines_with_stripe(image: np.ndarray, along: str) -> int:
    """Number of profile lines with a stripe, or several."""
    try:
        status = extract_stripe(image, stripe_along=along).status
    except ImageError:
        # Too few pixels to tell a stripe from its background.
        return 0
    return int(np.count_nonzero((status != StripeStatus.NO_STRIPE) & (status != StripeStatus.SATURATED)))
