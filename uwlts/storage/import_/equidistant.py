"""Equidistant (Kannala-Brandt) lenses of other programs as the rational distortion of this program's camera."""

import numpy as np

from uwlts.errors import DescriptionError
from uwlts.model.sensor import Distortion

_WIDEST = np.radians(89.0)
"""Largest angle to the axis that is tried: at 90 deg the tangent, the radius of the rational model, is infinite."""
_BEYOND = 1.02
"""Fitted radius in the image, in radii of the corner: points just outside the image are projected as well."""
_SAMPLES = 500
"""Angles of the fit: fifty for each of its numbers."""
_PASSES = 20
"""Passes of the weighted linear fit; the weights settle in less than ten."""
_LARGEST_MISS_PX = 0.02
"""Largest difference of both models in the image, less than half the error of a good corner. For f = 436 px, lenses
with k = 0 and with three sets of coefficients of real size differ by 0.003 px up to 70 deg. The difference is 0.02 px
at 75 deg, and 0.1 px at 80 deg."""


def convert_equidistant(coefficients: np.ndarray, *, corner: float, focal_px: float, source: str) -> Distortion:
    """Return the rational distortion of a lens with the model of `cv2.fisheye`, up to the image's corner.

    The equidistant model has the image radius a (1 + k1 a^2 + k2 a^4 + k3 a^6 + k4 a^8) at the angle a to the axis (J.
    Kannala and S. S. Brandt, PAMI 28 (2006), 1335). The rational one is a function of tan a. Its six coefficients are
    fitted by linear least squares, weighted with the denominator of the previous pass.

    ``coefficients`` are k1 to k4. ``corner`` is the distance of the image's farthest corner from the principal point,
    in focal lengths; ``source`` names the file in messages.

    Raises DescriptionError if the lens does not image the corner, or its angle is too wide for the rational model.
    """
    angle = np.linspace(0.0, _WIDEST, 50 * _SAMPLES)
    radius = _image_radius(coefficients, angle)
    falls = np.flatnonzero(np.diff(radius) <= 0)
    end = falls[0] if len(falls) else len(angle) - 1
    if radius[end] < corner:
        raise DescriptionError(
            f"{source}: its equidistant lens images angles up to {np.degrees(angle[end]):.0f} deg, and the image's "
            f"corners are further out ({corner:.2f} focal lengths from the principal point, the angle is at "
            f"{radius[end]:.2f}); this program's camera needs rays for the whole image: cut the images, or check the "
            "coefficients"
        )
    reach = np.interp(min(_BEYOND * corner, radius[end]), radius[: end + 1], angle[: end + 1])
    angle = np.linspace(0.0, reach, _SAMPLES + 1)[1:]
    seen, r = _image_radius(coefficients, angle), np.tan(angle)
    powers = np.stack([r**2, r**4, r**6], axis=1)
    below, found = np.ones_like(r), np.zeros(6)
    for _ in range(_PASSES):
        weight = r / below
        terms = np.hstack([powers, -powers * (seen / r)[:, None]]) * weight[:, None]
        scale = np.linalg.norm(terms, axis=0)
        found = np.linalg.lstsq(terms / scale, (seen / r - 1.0) * weight, rcond=1e-14)[0] / scale
        below = 1.0 + powers @ found[3:]
        if not (below > 0).all():
            break
    fitted = r * (1.0 + powers @ found[:3]) / below
    miss = focal_px * float(np.abs(fitted - seen)[seen <= corner].max())
    if not (miss <= _LARGEST_MISS_PX and (below > 0).all() and (np.diff(fitted) > 0).all()):
        widest = np.degrees(angle[seen <= corner][-1])
        raise DescriptionError(
            f"{source}: its equidistant lens sees the image's corners at {widest:.0f} deg from the axis; "
            f"this program's camera (rational_polynomial) departs from it by {miss:.2g} px, at most "
            f"{_LARGEST_MISS_PX} px are allowed, as up to about 70 deg: cut the images, or calibrate with "
            "rational_polynomial"
        )
    names = ("k1", "k2", "k3", "k4", "k5", "k6")
    return Distortion(**dict(zip(names, found.tolist(), strict=True)))


def _image_radius(coefficients: np.ndarray, angle: np.ndarray) -> np.ndarray:
    """Return the image radius (N,) in focal lengths at angles (N,) to the axis, rad."""
    return angle * (1.0 + sum(k * angle ** (2 * n) for n, k in enumerate(coefficients.tolist(), 1)))
