"""Marks of clipped pixels in images that are calculated from others, within their grey values.

A pixel that the camera clipped has no known light. Subtracted backgrounds and formulas of channels may give it any grey
value. Such an image has a ``saturation_dn`` of 2^k - 1, and 2^k is added to its clipped pixels. Thus the marks travel
with the image through captures, exports and cuts, and clipped pixels are not below ``saturation_dn`` in any image.
Images from cameras of k bits have no grey values above 2^k - 1, which are marks only.
"""

import numpy as np


def mark_clipped(image: np.ndarray, clipped: np.ndarray, *, saturation_dn: int) -> np.ndarray:
    """Return grey values (H, W), limited to 0 to ``saturation_dn``, as uint16 with marks where ``clipped`` (H, W).

    ``saturation_dn`` is 2^k - 1, at most 2^15 - 1.
    """
    return np.clip(image, 0, saturation_dn).astype(np.uint16) + np.uint16(saturation_dn + 1) * clipped


def has_marks(image: np.ndarray, saturation_dn: float) -> bool:
    """Return whether an image (H, W) has marks of clipped pixels."""
    mark = saturation_dn + 1
    can = image.dtype == np.uint16 and mark <= 2**15 and mark == int(mark) and int(mark).bit_count() == 1
    return can and bool(image.max() >= mark)


def split_clipped(image: np.ndarray, saturation_dn: float) -> tuple[np.ndarray, np.ndarray]:
    """Return the grey values (H, W) of an image without marks, and whether each pixel was clipped (H, W)."""
    clipped = image >= saturation_dn
    if has_marks(image, saturation_dn):
        image = image & np.uint16(saturation_dn)
    return image, clipped
