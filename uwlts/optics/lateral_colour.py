"""Lateral chromatic aberration: two colours of one scene lie apart in the image, moved and magnified."""

from dataclasses import dataclass

import numpy as np

_LEAST_PX = 0.1
"""Below it in the corners, two colours count as together."""
_SIGMAS = 5.0
"""A shift or magnification within so many standard errors of none is not certain."""
_BLUE_TO_GREEN_NM, _GREEN_TO_RED_NM = 490.0, 580.0


def laser_colour(wavelength_nm: float) -> str:
    """The channel of a colour camera that sees most of a laser's light."""
    if wavelength_nm < _BLUE_TO_GREEN_NM:
        return "blue"
    return "green" if wavelength_nm < _GREEN_TO_RED_NM else "red"


@dataclass(frozen=True)
class ColourShift:
    """Shift in px and magnification of a colour against another, and the largest distance in the image's corners."""

    shift_px: float
    magnification: float
    largest_px: float
    significant: bool


def colour_shift(places: np.ndarray, others: np.ndarray, size_px: np.ndarray) -> ColourShift:
    """Shift and magnification about the middle of an image (width, height) that lead from pixels (N, 2) to others.

    This is what lateral chromatic aberration and a colour filter array do. It is significant where it is certain, and
    large enough to matter.
    """
    middle = size_px / 2
    design = np.column_stack([np.tile(np.eye(2), (len(places), 1)), (places - middle).ravel()])
    off = (others - places).ravel()
    found = np.linalg.lstsq(design, off, rcond=None)[0]
    variance = np.sum((off - design @ found) ** 2) / (off.size - 3)
    std = np.sqrt(variance * np.diag(np.linalg.inv(design.T @ design)))
    corners = np.array([[-1, -1], [-1, 1], [1, -1], [1, 1]]) * size_px / 2
    largest = float(np.linalg.norm(found[:2] + found[2] * corners, axis=1).max())
    significant = largest >= _LEAST_PX and bool((np.abs(found) > _SIGMAS * std).any())
    return ColourShift(float(np.linalg.norm(found[:2])), 1 + float(found[2]), largest, significant)
