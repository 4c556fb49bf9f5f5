"""Cells of a grid of camera rays: which of them show the stripe, and what lies between their corners."""

import cv2
import numpy as np

NODE_SPACING_PX = 2
"""Pixels from one ray of the coarse grid to the next, and side of its cells."""
LIT_SIGMAS = 4.5
"""The stripe is rendered up to this many standard deviations of the sheet: 4e-5 of its peak."""


def corner_mean(nodes: np.ndarray) -> np.ndarray:
    """Mean (rows - 1, columns - 1) of the four corners of every grid cell."""
    beside = nodes[:, :-1] + nodes[:, 1:]
    return 0.25 * (beside[:-1] + beside[1:])


def corner_extremes(nodes: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Least and greatest (rows - 1, columns - 1) of the four corners of every grid cell."""
    low, high = np.minimum(nodes[:, :-1], nodes[:, 1:]), np.maximum(nodes[:, :-1], nodes[:, 1:])
    return np.minimum(low[:-1], low[1:]), np.maximum(high[:-1], high[1:])


def any_corner(nodes: np.ndarray) -> np.ndarray:
    """Cells (rows - 1, columns - 1) of which some corner is True."""
    beside = nodes[:, :-1] | nodes[:, 1:]
    return beside[:-1] | beside[1:]


def near_sheet(across: np.ndarray) -> np.ndarray:
    """Cells with a corner within `LIT_SIGMAS` of the sheet's middle, or between whose corners it passes.

    ``across`` is the sheet's distance at the nodes in standard deviations, infinity where there is no surface.
    """
    seen = np.isfinite(across)
    return any_corner(np.abs(across) < LIT_SIGMAS) | any_corner(seen & (across < 0)) & any_corner(seen & (across > 0))


def widened(cells: np.ndarray, radius_px: np.ndarray, *, cell_px: int = NODE_SPACING_PX) -> np.ndarray:
    """Marked cells and all within each one's radius in px; radii are rounded up to one of eight."""
    radius = np.where(cells, radius_px, 0) / cell_px
    step = max(1.0, radius.max(initial=0) / 8)
    level = np.ceil(radius / step).astype(int)
    wide = cells.copy()
    for k in np.unique(level[level > 0]):
        away = cv2.distanceTransform((level != k).astype(np.uint8), cv2.DIST_L2, cv2.DIST_MASK_PRECISE)
        wide |= away <= k * step
    return wide
