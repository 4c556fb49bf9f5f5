"""The thesis's way to the stripe's centre (section 4.5): a 5x5 low-pass, then a quadratic through the peak.

The thesis works in LabVIEW. There "low pass" is IMAQ LowPass, which replaces a pixel by the mean of its neighbours only
where it differs from them by more than a tolerance, 40 % unless set; it is no plain mean. "Every few columns" of the
quadratic fit is read as five pixels, the size of the filter. Which lines show a stripe is decided as for all methods.
"""

from dataclasses import replace

import cv2
import numpy as np

from uwlts.capture import Capture
from uwlts.stripe import FoundStripes

_SIZE_PX = 5
_SEARCHED_PX = 8
"""How far from the stripe's place the peak is looked for."""


def thesis_stripes(
    capture: Capture, found: FoundStripes, *, tolerance: float = 0.4, fitted_px: int = 5
) -> FoundStripes:
    """The same lines of the same images with the centres that the thesis's processing gives.

    ``tolerance`` is the low-pass filter's; 0 makes it a mean of the neighbours. ``fitted_px`` is an odd number.
    """
    along_width = capture.header.sensor.camera.stripe_along == "width"
    centre = np.empty(len(found.line))
    for number in np.unique(found.frame):
        own = found.frame == number
        image = capture.image(int(number))
        smooth = low_passed(image if along_width else image.T, tolerance=tolerance)
        centre[own] = _peaks(smooth, found.line[own], found.centre_px[own], half=fitted_px // 2)
    return replace(found, centre_px=centre)


def low_passed(image: np.ndarray, *, tolerance: float) -> np.ndarray:
    """An image (H, W) after IMAQ LowPass of 5x5 pixels, float32."""
    grey = image.astype(np.float32)
    count = _SIZE_PX**2
    neighbours = (cv2.blur(grey, (_SIZE_PX, _SIZE_PX)) * count - grey) / (count - 1)
    return np.where(np.abs(grey - neighbours) > tolerance * neighbours, neighbours, grey)


def _peaks(smooth: np.ndarray, line: np.ndarray, near_px: np.ndarray, *, half: int) -> np.ndarray:
    """Vertices (N,) of parabolas through pixels on either side of the largest one of columns (N,) near rows (N,)."""
    # Of several largest ones, those of a plateau, the nearest to the stripe's place is taken.
    around = np.array(sorted(range(-_SEARCHED_PX, _SEARCHED_PX + 1), key=abs))
    rows = np.clip(np.rint(near_px).astype(int)[:, None] + around, 0, len(smooth) - 1)
    top = rows[np.arange(len(line)), smooth[rows, line[:, None]].argmax(axis=1)]
    offset = np.arange(-half, half + 1)
    rows = np.clip(top[:, None] + offset, 0, len(smooth) - 1)
    # Below the largest one, so that a plateau is exactly zero. It has no vertex; the place is the best guess.
    below = smooth[rows, line[:, None]] - smooth[top, line][:, None]
    second, first, _ = np.linalg.pinv(np.vander(offset, 3)) @ below.T
    vertex = np.where(second < 0, -first / np.where(second < 0, 2 * second, 1.0), 0.0)
    return top + np.clip(vertex, -half, half)
