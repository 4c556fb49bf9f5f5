"""A white picture with axes, drawn with OpenCV: pixels (x right, y down), colours blue-green-red."""

import math

import cv2
import numpy as np

INK = (60, 50, 45)
FAINT = (215, 210, 205)
ORANGE = (0, 120, 255)
_FONT, _SIZE = cv2.FONT_HERSHEY_SIMPLEX, 0.5
# OpenCV draws at sixteenths of a pixel if coordinates are given multiplied by 16.
_SHIFT = 4


def blank(width: int, height: int) -> np.ndarray:
    """White picture (height, width, 3) uint8."""
    return np.full((height, width, 3), 255, np.uint8)


def write(picture: np.ndarray, text: str, x: float, y: float, *, align: str = "left", size: float = _SIZE) -> None:
    """Text whose vertical middle is at y; ``align`` says which part of it is at x: left, middle or right."""
    (width, height), _ = cv2.getTextSize(text, _FONT, size, 1)
    start = x - {"left": 0.0, "middle": width / 2, "right": float(width)}[align]
    cv2.putText(picture, text, (round(start), round(y + height / 2)), _FONT, size, INK, 1, cv2.LINE_AA)


def write_upwards(picture: np.ndarray, text: str, x: float, y: float, *, size: float = _SIZE) -> None:
    """Text that reads upwards, its middle at (x, y)."""
    (width, height), baseline = cv2.getTextSize(text, _FONT, size, 1)
    strip = blank(width + 4, height + baseline + 4)
    write(strip, text, 2, (height + 4) / 2, size=size)
    turned = cv2.rotate(strip, cv2.ROTATE_90_COUNTERCLOCKWISE)
    top, left = max(0, round(y - turned.shape[0] / 2)), max(0, round(x - turned.shape[1] / 2))
    room = picture[top : top + turned.shape[0], left : left + turned.shape[1]]
    np.minimum(room, turned[: room.shape[0], : room.shape[1]], out=room)


def line(picture: np.ndarray, points: np.ndarray, *, colour: tuple[int, int, int] = INK, thickness: int = 1) -> None:
    """Smooth line through points (N, 2) at fractions of a pixel."""
    shifted = np.round(np.asarray(points) * 2**_SHIFT).astype(np.int32)
    cv2.polylines(picture, [shifted.reshape(-1, 1, 2)], False, colour, thickness, cv2.LINE_AA, _SHIFT)


def dot(picture: np.ndarray, x: float, y: float, *, radius: float, colour: tuple[int, int, int]) -> None:
    """Disc at a fraction of a pixel."""
    scale = 2**_SHIFT
    centre = (round(x * scale), round(y * scale))
    cv2.circle(picture, centre, round(radius * scale), colour, -1, cv2.LINE_AA, _SHIFT)


def ticks(low: float, high: float, *, count: int) -> list[float]:
    """Round numbers between low and high, about ``count`` of them, a step of 1, 2 or 5 times a power of ten apart."""
    rough = (high - low) / max(1, count)
    if not rough > 0:
        return [low]
    power = 10.0 ** math.floor(math.log10(rough))
    step = next(step * power for step in (1, 2, 5, 10) if step * power >= rough * (1 - 1e-9))
    first, last = math.ceil(low / step - 1e-9), math.floor(high / step + 1e-9)
    return [number * step for number in range(first, last + 1)]
