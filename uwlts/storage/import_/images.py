"""Grey values of a camera from the pixels of image files."""

import cv2
import numpy as np

from uwlts.errors import ImageError


def bits_of(image: np.ndarray, bits: int | None, *, name: str) -> int:
    """Bits of the grey values: 8 for a file of 8 bit, else as given; ImageError where that is contradictory or open."""
    if image.dtype == np.uint8:
        if bits not in (None, 8):
            raise ImageError(f"{name} is a file of 8 bit, but bits = {bits}: save it with 16 bit, or leave out bits")
        return 8
    if bits is None:
        raise ImageError(f"{name} is a file of 16 bit: say how many the camera used, bits = 10, 12 or 16")
    return bits


def grey_values(image: np.ndarray, *, bits: int, aligned: str, name: str) -> np.ndarray:
    """Values from 0 to 2^bits - 1 of an image whose camera put them into the lower or upper bits.

    ImageError where there are larger values, or bits below the upper ones are used.
    """
    if image.dtype == np.uint8:
        return image
    if aligned == "high":
        spare = 16 - bits
        if (image & np.uint16(2**spare - 1)).any():
            raise ImageError(f"{name} uses more than its upper {bits} bits: check bits and aligned")
        return image >> np.uint16(spare)
    largest = int(image.max())
    if largest >= 2**bits:
        raise ImageError(
            f"{name} holds the grey value {largest}, more than {bits} bits have: check bits, or give aligned = 'high' "
            "if the camera uses the upper bits"
        )
    return image


def without_background(image: np.ndarray, background: np.ndarray, *, zero_dn: int) -> np.ndarray:
    """Image minus background (H, W) of one type, as uint16: ``zero_dn`` stands for no difference; saturates."""
    return cv2.addWeighted(image, 1.0, background, -1.0, zero_dn, dtype=cv2.CV_16U)
