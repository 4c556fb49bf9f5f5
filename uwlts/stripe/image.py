"""Checks an image and turns it so that every profile line is a column."""

from __future__ import annotations

import math

import cv2
import numpy as np

from uwlts.errors import ImageError

_LARGEST = {np.dtype(np.uint8): 255.0, np.dtype(np.uint16): 65535.0, np.dtype(np.float32): math.inf}

_LONGEST_SIDE = 32766
"""OpenCV's remap addresses pixels with 16 bits."""


def check_image(image: np.ndarray, *, name: str) -> None:
    """Refuse what is not a two-dimensional, finite uint8, uint16 or float32 array.

    Raises
    ------
    ImageError
    """
    if not isinstance(image, np.ndarray):
        raise ImageError(f"the {name} is a {type(image).__name__}; expected a NumPy array")
    if image.dtype not in _LARGEST:
        raise ImageError(f"the {name} has type {image.dtype}; convert it to uint8, uint16 or float32")
    if image.ndim != 2:
        raise ImageError(f"the {name} has shape {image.shape}; expected (height, width): choose one channel")
    if image.size == 0:
        raise ImageError(f"the {name} is empty, its shape is {image.shape}")
    if image.dtype == np.float32 and not np.isfinite(image).all():
        count = image.size - np.count_nonzero(np.isfinite(image))
        raise ImageError(f"the {name} has {count} pixels that are not finite; repair or mask them before")


def check_length(image: np.ndarray, *, stripe_along: str, least: int) -> None:
    """Refuse an unknown orientation, lines shorter than the search needs and images OpenCV cannot address.

    Raises
    ------
    ImageError
    """
    if stripe_along not in ("height", "width"):
        raise ImageError(f'stripe_along is {stripe_along!r}; use "height" (lines are rows) or "width" (columns)')
    if max(image.shape) > _LONGEST_SIDE:
        raise ImageError(f"the image is {image.shape}; each side may have at most {_LONGEST_SIDE} pixels: crop it")
    length = image.shape[1] if stripe_along == "height" else image.shape[0]
    if length < least:
        raise ImageError(
            f"the image's lines have {length} pixels; the search needs {least}: lower half_window_px or check "
            "stripe_along"
        )


def saturation_of(image: np.ndarray, saturation: float | None) -> float:
    """Grey value at which pixels clip: as given, else the type's largest (none for float32)."""
    if saturation is None:
        return _LARGEST[image.dtype]
    if not math.isfinite(saturation) or saturation <= 0:
        raise ImageError(f"saturation is {saturation!r}; expected the positive grey value at which pixels clip")
    return float(saturation)


def subtract_background(image: np.ndarray, background: np.ndarray) -> np.ndarray:
    """Image minus background with its sign kept: int16 for two uint8 images, otherwise float32.

    Raises
    ------
    ImageError
        If the background is no image or its size or type differs.
    """
    check_image(background, name="background")
    if background.shape != image.shape or background.dtype != image.dtype:
        raise ImageError(
            f"the background is {background.shape} {background.dtype} but the image {image.shape} {image.dtype}; "
            "take both with the same camera settings"
        )
    return cv2.subtract(image, background, dtype=cv2.CV_16S if image.dtype == np.uint8 else cv2.CV_32F)


def average_lines(image: np.ndarray, count: int, *, stripe_along: str) -> np.ndarray:
    """float32 image averaged over `count` neighbouring lines, the outermost repeated at the border."""
    kernel = (1, count) if stripe_along == "height" else (count, 1)
    return cv2.blur(image.astype(np.float32), kernel, borderType=cv2.BORDER_REPLICATE)


def as_profiles(image: np.ndarray, *, stripe_along: str) -> np.ndarray:
    """(N, L) contiguous array: position along the line first, so that whole-line steps run over adjacent memory."""
    return cv2.transpose(image) if stripe_along == "height" else np.ascontiguousarray(image)
