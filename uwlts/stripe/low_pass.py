"""Stripe centres as in the thesis: a low-pass filter of LabVIEW, then a quadratic through the peak.

G. S. de Matos (UFSC 2017, section 4.5) applies a 5x5 low-pass filter and a quadratic "every few columns". The filter
IMAQ LowPass replaces a pixel by the mean of its neighbours only if it differs from them by more than a tolerance
(default: 40 %); it is not a plain mean. "Every few columns" is interpreted as five pixels, the size of the filter.
"""

from dataclasses import replace

import cv2
import numpy as np

from uwlts.model.stripe import Stripe

_SIZE_PX = 5  # of the window of the thesis's filter
_SEARCHED_PX = 8
"""Half width of the window around the stripe in which its peak is searched."""


def fit_low_passed(profiles: np.ndarray, stripe: Stripe, *, tolerance: float, fitted_px: int) -> Stripe:
    """Return the stripe with the centres of the low-passed profiles (N, L), position first, on the same lines.

    ``tolerance`` is that of the filter; 0 makes it a mean of the neighbours. ``fitted_px`` is an odd number.
    """
    smooth, centre = apply_low_pass(profiles, tolerance=tolerance), stripe.centre_px.copy()
    lines = stripe.lines
    centre[lines] = _peaks(smooth, lines, centre[lines], half=fitted_px // 2)
    return replace(stripe, centre_px=centre)


def apply_low_pass(image: np.ndarray, *, tolerance: float) -> np.ndarray:
    """Filter an image (H, W) with IMAQ LowPass of 5x5 pixels; return float32."""
    grey = image.astype(np.float32)
    count = _SIZE_PX**2
    neighbours = (cv2.blur(grey, (_SIZE_PX, _SIZE_PX)) * count - grey) / (count - 1)
    return np.where(np.abs(grey - neighbours) > tolerance * neighbours, neighbours, grey)


def _peaks(smooth: np.ndarray, line: np.ndarray, near_px: np.ndarray, *, half: int) -> np.ndarray:
    """Return vertices (N,) of parabolas through pixels around the maximum of columns (N,) near rows (N,)."""
    # On a plateau, the maximum nearest to the stripe's position is used.
    around = np.array(sorted(range(-_SEARCHED_PX, _SEARCHED_PX + 1), key=abs))
    rows = np.clip(np.rint(near_px).astype(int)[:, None] + around, 0, len(smooth) - 1)
    top = rows[np.arange(len(line)), smooth[rows, line[:, None]].argmax(axis=1)]
    offset = np.arange(-half, half + 1)
    rows = np.clip(top[:, None] + offset, 0, len(smooth) - 1)
    # Relative to the maximum, so that a plateau is exactly zero. It has no vertex; its position is used instead.
    below = smooth[rows, line[:, None]] - smooth[top, line][:, None]
    second, first, _ = np.linalg.pinv(np.vander(offset, 3)) @ below.T
    vertex = np.where(second < 0, -first / np.where(second < 0, 2 * second, 1.0), 0.0)
    return top + np.clip(vertex, -half, half)
