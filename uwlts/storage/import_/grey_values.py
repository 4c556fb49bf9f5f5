"""Grey values from the pixels of image files: bit depths, channels, mosaics of colour sensors, and backgrounds."""

import ast
from functools import reduce
from typing import Annotated, Literal

import cv2
import numpy as np
from pydantic import AfterValidator

from uwlts.errors import ImageError
from uwlts.stripe.exposures import mark_clipped

# OpenCV's order of colours.
_COLOURS = {"blue": 0, "green": 1, "red": 2}
_NAMES = (*_COLOURS, "grey")
_OPERATORS = {ast.Add: np.add, ast.Sub: np.subtract, ast.Mult: np.multiply, ast.Div: np.divide}
_FUNCTIONS = {"max": np.maximum, "min": np.minimum}
_EXPECTED = (
    "expected red, green, blue, grey, max (the brightest), or a formula of them with + - * /, numbers, max(...) and "
    "min(...), such as 'red - max(green, blue)'"
)


def check_channel(text: str) -> str:
    """Return the name or formula of a channel unchanged; raises ValueError if it is not valid."""
    if text != "max":
        _evaluate(text, dict.fromkeys(_NAMES, np.ones(1, np.float32)))
    return text


Channel = Annotated[str, AfterValidator(check_channel)]
"""Name or formula of a channel."""


def is_formula(channel: str | None, image: np.ndarray) -> bool:
    """Return whether a channel of an image is calculated from several, so that clipped pixels have any value."""
    return channel is not None and channel not in (*_COLOURS, "max") and (channel != "grey" or image.ndim == 3)


def combine_clipped(clipped: np.ndarray, channel: str | None) -> np.ndarray:
    """Return where a channel, or one of those in its formula, is clipped (H, W), for an image (H, W) or (H, W, 3)."""
    if clipped.ndim == 2:
        return clipped
    named = "" if channel is None or "grey" in channel else channel
    used = [place for colour, place in _COLOURS.items() if colour in named]
    return np.asarray(clipped[:, :, used or slice(None)].any(axis=2))


def extract_channel(image: np.ndarray, channel: str | None, *, name: str) -> np.ndarray:
    """Return a grey image (H, W): a colour channel, the luminance (grey), the maximum (max), or a formula's result.

    It has the image's type, or int32 for a formula. Raises ImageError for a colour image without a selected channel,
    and for a formula of colours if the image has no colours.
    """
    if image.ndim == 2:
        if is_formula(channel, image):
            raise ImageError(f"{name} has no colours, so that {channel!r} means nothing: leave the channel out")
        return image
    if channel is None:
        if (image[:, :, :1] == image[:, :, 1:]).all():
            return np.ascontiguousarray(image[:, :, 0])
        raise ImageError(
            f"{name} is a colour image: choose the channel of the laser's colour, channel = 'red', 'green', 'blue', "
            "'grey' or 'max', or a formula such as 'red - max(green, blue)'"
        )
    if channel in _COLOURS:
        return cv2.extractChannel(image, _COLOURS[channel])
    grey = cv2.cvtColor(image, cv2.COLOR_BGR2GRAY)
    if channel == "grey":
        return grey
    if channel == "max":
        return image.max(axis=2)
    values = {colour: image[:, :, place].astype(np.float32) for colour, place in _COLOURS.items()}
    most = np.iinfo(image.dtype).max
    mixed = _evaluate(channel, values | {"grey": grey.astype(np.float32)})
    return np.rint(np.clip(np.nan_to_num(mixed), -most, most)).astype(np.int32)


def _evaluate(text: str, values: dict[str, np.ndarray]) -> np.ndarray:
    """Evaluate a formula of channels; raises ValueError if it is not valid."""

    def value(node: ast.AST) -> np.ndarray | float:
        match node:
            case ast.Name(id=name) if name in values:
                return values[name]
            case ast.Constant(value=int() | float() as number):
                return float(number)
            case ast.UnaryOp(op=ast.USub(), operand=operand):
                return -value(operand)
            case ast.BinOp(left=left, op=operator, right=right) if type(operator) in _OPERATORS:
                return _OPERATORS[type(operator)](value(left), value(right))
            case ast.Call(func=ast.Name(id=name), args=[_, _, *_] as parts, keywords=[]) if name in _FUNCTIONS:
                return reduce(_FUNCTIONS[name], map(value, parts))
        raise ValueError(_EXPECTED)

    try:
        with np.errstate(all="ignore"):
            found = value(ast.parse(text.strip(), mode="eval").body)
    except (SyntaxError, RecursionError, MemoryError, OverflowError, ValueError) as error:
        raise ValueError(_EXPECTED) from error
    if not isinstance(found, np.ndarray):
        raise ValueError(_EXPECTED)
    return found


def bits_of(image: np.ndarray, bits: int | None, *, name: str) -> int:
    """Return the bit depth: 8 for a file of 8 bit, else ``bits``; raises ImageError if that is wrong or missing."""
    if image.dtype == np.uint8:
        if bits not in (None, 8):
            raise ImageError(f"{name} is a file of 8 bit, but bits = {bits}: save it with 16 bit, or leave out bits")
        return 8
    if bits is None:
        raise ImageError(f"{name} is a file of 16 bit: give the number that the camera used, bits = 10, 12 or 16")
    return bits


def grey_values(image: np.ndarray, *, bits: int, aligned: str, name: str) -> np.ndarray:
    """Return values from 0 to 2^bits - 1, from the lower or upper bits of an image.

    Raises ImageError if values are too large, or bits below the upper ones are used.
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
            f"{name} has the grey value {largest}, which exceeds {bits} bits: check bits, or give aligned = 'high' "
            "if the camera uses the upper bits"
        )
    return image


def subtract_background(image: np.ndarray, background: np.ndarray, clipped: np.ndarray, *, zero_dn: int) -> np.ndarray:
    """Return image minus background (H, W) of the same type as uint16, plus ``zero_dn``, a power of two.

    Pixels ``clipped`` (H, W) by the camera are marked above the difference's saturation, 2 ``zero_dn`` - 1.
    """
    difference = cv2.addWeighted(image, 1.0, background, -1.0, zero_dn, dtype=cv2.CV_16U)
    return mark_clipped(difference, clipped, saturation_dn=2 * zero_dn - 1)


BayerPattern = Literal["RGGB", "GRBG", "GBRG", "BGGR"]
"""Colours of the first two rows and columns of a sensor."""
_SMOOTH, _ALTERNATING = np.array([1, 2, 1], np.float32) / 4, np.array([-1, 2, -1], np.float32) / 4
_LIT = 0.3  # least brightness of the evaluated pixels, relative to the brightest
_LEAST_SHARE = 0.1
"""Least alternation of a mosaic relative to the mean signal: 0.8 for laser light, below 0.01 in images of grey cameras
and colour channels."""
_LEAST_SIGNIFICANCE = 6  # alternation over its standard error
_BORDER = 2  # pixels that the interpolation of a mosaic does not fill


def demosaic(image: np.ndarray, pattern: BayerPattern, *, name: str) -> np.ndarray:
    """Return a colour image (H, W, 3) in blue, green, red by bilinear interpolation of a raw image (H, W).

    Raises ImageError for a colour image.
    """
    if image.ndim != 2:
        raise ImageError(f"{name} is a colour image, which has no Bayer pattern: leave bayer out")
    return cv2.demosaicing(image, getattr(cv2, f"COLOR_Bayer{pattern}2BGR"))


def is_mosaic(image: np.ndarray) -> bool:
    """Return whether the bright parts of a grey image (H, W) alternate from pixel to pixel as a Bayer mosaic does.

    A mosaic alternates along rows and columns equally (red against blue), or in a chequerboard (green). Stripes and
    interlaced rows alternate in one direction at most; noise alternates with random sign.
    """
    grey = image.astype(np.float32)
    inner = np.s_[_BORDER:-_BORDER, _BORDER:-_BORDER]
    bright = cv2.sepFilter2D(grey, -1, _SMOOTH, _SMOOTH)[inner]
    if bright.size == 0:
        return False
    dark, most = np.percentile(bright, (20, 99.9))
    lit = bright > dark + _LIT * (most - dark)
    if not lit.any():
        return False
    signal = float(bright[lit].mean() - dark)
    sign_y, sign_x = (1 - 2 * (np.arange(size, dtype=np.float32) % 2) for size in grey.shape)

    def alternation(along_x: np.ndarray, along_y: np.ndarray, sign: np.ndarray) -> float:
        """Return the mean alternation relative to the signal; 0 if it is not significant."""
        values = (cv2.sepFilter2D(grey, -1, along_x, along_y) * sign)[inner][lit]
        # Neighbouring values of the filters are correlated over about 16 pixels.
        error = 4 * float(values.std()) / np.sqrt(values.size)
        mean = abs(float(values.mean()))
        return mean / signal if mean > _LEAST_SIGNIFICANCE * error else 0.0

    in_rows = alternation(_ALTERNATING, _SMOOTH, sign_x[None, :])
    in_columns = alternation(_SMOOTH, _ALTERNATING, sign_y[:, None])
    chequered = alternation(_ALTERNATING, _ALTERNATING, sign_y[:, None] * sign_x[None, :])
    return max(chequered, min(in_rows, in_columns)) > _LEAST_SHARE
