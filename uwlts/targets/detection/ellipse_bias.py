"""Offset of the centre of a circle's image from the image of the circle's centre."""

import numpy as np

from uwlts.errors import RangeError

RIM_POINTS = 16


def circle_centre_bias(project, centres_mm, *, diameter_mm, axis_u, axis_v):
    """Offset of the centre of a circle's image from the image of the circle's centre.

    A detected centre minus this offset is the image of the circle's centre; a predicted image of the centre plus this
    offset is what a detector finds. For a pinhole the image is an ellipse and the offset exact (J. Heikkila and
    O. Silven, A four-step camera calibration procedure, CVPR 1997, section 3.2); with distortion or refraction the
    ellipse is the one that best fits the projected rim.

    ``project`` maps points (M, 3) in mm, target frame, to pixels (M, 2); ``centres_mm`` (N, 3) are in the target frame,
    ``axis_u`` and ``axis_v`` (3,) orthonormal vectors that span the plane of the circles. Returns (N, 2) in px, (u, v).

    Raises
    ------
    RangeError
        The diameter is not positive, the axes are not orthonormal, or the image of a circle is no ellipse (it reaches
        behind the camera or where `project` has no result).
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
            f"{broken.sum()} of {len(centres)} circles have no finite image, the first at {centres[broken][0]} mm; "
            "leave out circles that the camera cannot see"
        )
    return _ellipse_centres(pixels[:, 1:]) - pixels[:, 0]


def _ellipse_centres(points):
    """Centres (N, 2) of the conics that best fit N sets of points (N, M, 2), M >= 6."""
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
            f"the images of {np.count_nonzero(determinant <= 0)} of {len(points)} circles are no ellipses; leave out "
            "circles that reach behind the camera"
        )
    centre = np.stack([b * e - 2 * c * d, b * d - 2 * a * e], 1) / determinant[:, None]
    return middle[:, 0] + scale[:, 0] * centre
