"""Offset of the centre of a circle's image from the image of the circle's centre."""

import numpy as np

from uwlts.errors import RangeError

RIM_POINTS = 16
"""Projected points on the rim of a circle."""


def circle_centre_bias(project, centres_mm, *, diameter_mm, axis_u, axis_v):
    """Return the offset of the centre of a circle's image from the image of the circle's centre.

    A detected centre minus this offset is the image of the circle's centre. For a pinhole camera the image is an
    ellipse and the offset is exact (J. Heikkila and O. Silven, A four-step camera calibration procedure, CVPR 1997,
    section 3.2). With distortion or refraction, the ellipse is fitted to the projected rim.

    Parameters
    ----------
    project : callable
        Maps points (M, 3) in mm, target frame, to pixels (M, 2).
    centres_mm : (N, 3) array
        Centres of the circles, target frame.
    diameter_mm : float
        Diameter of the circles.
    axis_u, axis_v : (3,) array
        Orthonormal vectors in the plane of the circles.

    Returns
    -------
    (N, 2) float64
        Offsets (u, v), px.

    Raises
    ------
    RangeError
        The diameter is not positive, the axes are not orthonormal, or the image of a circle is not an ellipse: the
        circle extends behind the camera, or `project` fails.
    """
    axes = np.array([axis_u, axis_v], float)
    if not np.allclose(axes @ axes.T, np.eye(2), rtol=0, atol=1e-9):
        raise RangeError(f"axis_u and axis_v are {axes[0]} and {axes[1]}; expected orthonormal vectors")
    if not (np.isfinite(diameter_mm) and diameter_mm > 0):
        raise RangeError(f"the diameter is {diameter_mm} mm; expected a positive length")
    centres = np.asarray(centres_mm, float).reshape(-1, 3)
    if len(centres) == 0:
        return np.empty((0, 2))
    angle = np.arange(RIM_POINTS) * (2 * np.pi / RIM_POINTS)
    rim = diameter_mm / 2 * np.stack([np.cos(angle), np.sin(angle)], 1) @ axes
    points = np.concatenate([centres[:, None], centres[:, None] + rim], 1)
    pixels = np.asarray(project(points.reshape(-1, 3)), float).reshape(len(centres), RIM_POINTS + 1, 2)
    broken = ~np.isfinite(pixels).all((1, 2))
    if broken.any():
        raise RangeError(
            f"{broken.sum()} of {len(centres)} circles cannot be projected, the first at {centres[broken][0]} mm; "
            "remove circles that the camera cannot see"
        )
    return _ellipse_centres(pixels[:, 1:]) - pixels[:, 0]


def _ellipse_centres(points):
    """Return the centres (N, 2) of the conics that best fit N sets of points (N, M, 2), M >= 6."""
    middle = points.mean(1, keepdims=True)
    scale = np.sqrt(((points - middle) ** 2).mean((1, 2), keepdims=True))
    if (scale == 0).any():
        raise RangeError(f"{np.count_nonzero(scale == 0)} circles are imaged onto a single point; expected ellipses")
    x, y = np.moveaxis((points - middle) / scale, 2, 0)
    design = np.stack([x * x, x * y, y * y, x, y, np.ones_like(x)], 2)
    a, b, c, d, e, _ = np.linalg.eigh(design.swapaxes(1, 2) @ design)[1][:, :, 0].T
    determinant = 4 * a * c - b * b
    if not (determinant > 0).all():
        raise RangeError(
            f"the images of {np.count_nonzero(determinant <= 0)} of {len(points)} circles are not ellipses; remove "
            "circles that extend behind the camera"
        )
    centre = np.stack([b * e - 2 * c * d, b * d - 2 * a * e], 1) / determinant[:, None]
    return middle[:, 0] + scale[:, 0] * centre
