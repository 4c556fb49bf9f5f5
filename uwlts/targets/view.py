"""What one image shows of a calibration target."""

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np


@dataclass(frozen=True)
class TargetView:
    """Points of a target found in one image.

    Attributes
    ----------
    pixels : (N, 2) float64, px, (u, v), pixel (0, 0) is the centre of the first pixel
        Centre of the image of a circle (not the image of its centre: see `circle_centre_bias`), or a corner.
    points_mm : (N, 3) float64, mm, target frame, z = 0
    indices : (N, 2) int64, place (column, row) of the circle or inner corner, counted from the top left one
    quality : name to (N,) float64
        ``contrast``: grey levels between bright and dark at the point; ``sharpness``: steepest slope over contrast,
        1/px; for circles also ``residual_px``: rms distance of the edge from its ellipse, and ``radius_px``: geometric
        mean of the ellipse's semi-axes.
    """

    pixels: np.ndarray
    points_mm: np.ndarray
    indices: np.ndarray
    quality: Mapping[str, np.ndarray]
