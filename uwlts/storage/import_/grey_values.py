"""Grey values of a camera from the pixels of image files: bits, channels and formulas of them, and backgrounds."""

import ast
from functools import reduce
from typing import Annotated

import cv2
import numpy as np
from pydantic import AfterValidator

from uwlts.errors import ImageError

# OpenCV's order of colours.
_COLOURS = {"blue": 0, "green": 1, "red": 2}
_NAMES = (*_COLOURS, "grey")
_OPERATORS = {ast.Add: np.add, ast.Sub: np.subtract, ast.Mult: np.multiply, ast.Div: np.divide}
_FUNCTIONS = {"max": np.maximum, "min": np.minimum}
_LONGEST = 500
"""Characters of a formula: four colours and a few numbers take a hundred."""
_EXPECTED = (
    "expected red, green, blue, grey, max (the brightest), or a formula of them with + - * /, numbers, max(...) and "
    "min(...), such as 'red - max(green, blue)'"
)


def checked_channel(text: str) -> str:
    """The name or formula of a channel; ValueError where it is none."""
    if text != "max":
        _evaluated(text, dict.fromkeys(_NAMES, np.ones(1, np.float32)))
    return text


Channel = Annotated[str, AfterValidator(checked_channel)]
"""Name or formula of a channel."""


def is_formula(channel: str | None) -> bool:
    """Whether a channel is calculated from others, so that its values may be below zero and none of the camera's."""
    return channel is not None and channel not in (*_NAMES, "max")


def one_channel(image: np.ndarray, channel: str | None, *, name: str) -> np.ndarray:
    """Grey image (H, W): a colour of an image, its luminance (grey), the brightest (max), or what a formula gives.

    Of the image's type, or int32 for a formula. ImageError for a colour image where no channel is chosen, and for a
    formula of colours where the image has none.
    """
    if image.ndim == 2:
        if is_formula(channel):
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
    mixed = _evaluated(channel, values | {"grey": grey.astype(np.float32)})
    return np.rint(np.clip(np.nan_to_num(mixed), -most, most)).astype(np.int32)


def _evaluated(text: str, values: dict[str, np.ndarray]) -> np.ndarray:
    """What a formula gives; ValueError where it is none of the channels."""

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

    if len(text) > _LONGEST:
        raise ValueError(f"the formula has {len(text):,} characters; expected at most {_LONGEST}")
    try:
        with np.errstate(all="ignore"):
            found = value(ast.parse(text.strip(), mode="eval").body)
    except (SyntaxError, RecursionError, MemoryError, OverflowError, ValueError) as error:
        raise ValueError(_EXPECTED) from error
    if not isinstance(found, np.ndarray):
        raise ValueError(_EXPECTED)
    return found


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
