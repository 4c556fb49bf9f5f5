"""Camera model: pixels to rays and points to pixels, with lens distortion, with or without a window.

Pinhole camera with OpenCV's Brown-Conrady or rational distortion. Pixel (0, 0) is the centre of the first pixel.
"""

import math
from collections.abc import Hashable
from functools import lru_cache
from typing import cast

import numpy as np
from numpy.polynomial import Polynomial

from uwlts.errors import RangeError
from uwlts.model.calibration import CameraModel, WindowModel
from uwlts.model.sensor import Distortion
from uwlts.optics.window import check_index, tangent_ratio, window_normal

# Newton's method doubles the number of correct digits with each step. At the edge of the invertible domain the
# derivative of the distortion vanishes, and a step gains only one of the 53 bits of a float.
_USUAL_STEPS = 8
_MOST_STEPS = 60
_MOST_HALVINGS = 12

# Tolerance of a distorted point in units of the focal length: about twenty rounding errors of numbers near 1. With a
# focal length of 10,000 px it is 4e-11 px.
_ROUNDING = 4e-15

# Tangent of the largest angle to the axis (89.9 deg): no lens images wider angles onto a plane.
_WIDEST = 1000.0


def directions(camera: CameraModel, pixels: np.ndarray) -> np.ndarray:
    """Return the unit vectors (N, 3) in the camera frame of the rays through pixels (N, 2), (u, v) in px.

    The distortion is inverted to rounding by Newton's method in two dimensions. The inverse exists in the image of the
    domain, the largest disc about the principal point where the distortion is one-to-one. Rows outside are NaN.

    Raises RangeError if a pixel is not finite.
    """
    pixels = _require_finite("pixels", pixels)
    x, y = (pixels[:, 0] - camera.cx_px) / camera.fx_px, (pixels[:, 1] - camera.cy_px) / camera.fy_px
    if camera.coefficients().any():
        x, y = _undistort(camera.distortion, x, y)
    result = np.empty((3, len(pixels))).T  # coordinates contiguous: three times faster to refract
    length = np.sqrt(x * x + y * y + 1.0)
    np.divide(x, length, out=result[:, 0])
    np.divide(y, length, out=result[:, 1])
    np.divide(1.0, length, out=result[:, 2])
    return result


def project(camera: CameraModel, points: np.ndarray) -> np.ndarray:
    """Project points (N, 3) in the camera frame, or directions, to pixels (N, 2) without a window.

    A row is NaN if the camera cannot see the point: at or behind the plane z = 0, or outside the domain of
    `directions`, where the polynomial would fold the point back into the image.

    Raises RangeError if a coordinate is not finite.
    """
    return _project(camera, _require_finite("points", points))


def project_through_window(
    camera: CameraModel, window: WindowModel | None, points: np.ndarray, *, medium_index: float
) -> np.ndarray:
    """Project points (N, 3) in the medium, camera frame, mm, through the window to pixels (N, 2).

    The window's faces are parallel, so a ray stays in the plane that contains their normal and the point. In this
    plane, the distance of the point from the normal through the pupil is the sum of ``height * tan(angle)`` over the
    layers. The product ``index * sin(angle)`` is the same in all layers. The sum is an increasing, concave function of
    the tangent in the layer with the lowest index. Newton's method from zero therefore converges to the only solution
    from below, without bracketing.

    A row is NaN if the camera cannot see the point: as for `project`, or in front of the window's outer face.

    Raises RangeError if a coordinate is not finite, or as for `uwlts.optics.window.trace_window`.
    """
    points = _require_finite("points", points)
    check_index("medium_index", medium_index)
    if window is None:
        return _project(camera, points)
    normal = window_normal(window)
    thickness = window.thickness_mm if window.refractions == 2 else 0.0
    inner = window.distance_mm * normal[2]
    height = points @ normal
    offset = points - height[:, None] * normal
    distance = np.linalg.norm(offset, axis=1)
    depth = height - inner - thickness
    depth[depth <= 0] = np.nan
    tangent = _solve_tangent_in_air((inner, thickness, depth), (1.0, window.glass_index, medium_index), distance)
    slope = np.divide(tangent, distance, out=np.zeros_like(distance), where=distance > 0)
    toward = normal + slope[:, None] * offset
    toward[np.isnan(depth)] = np.nan
    return _project(camera, toward)


def _require_finite(name: str, values: np.ndarray) -> np.ndarray:
    values = np.asarray(values, dtype=float)
    finite = np.isfinite(values)
    if not finite.all():
        example = values[~finite.all(axis=1)][0]
        raise RangeError(f"{name} must be finite, but one is {example}; remove such rows")
    return values


def _solve_tangent_in_air(
    heights: tuple[float, float, np.ndarray], indices: tuple[float, float, float], distance: np.ndarray
) -> np.ndarray:
    """Return the tangent (N,) of the angle in the first layer, of index 1, of rays with a given lateral ``distance``.

    Solve for the tangent in the layer with the lowest index; `tangent_ratio` gives the tangents in the others.
    """
    layers = [(height, index) for height, index in zip(heights, indices, strict=True) if np.any(height != 0)]
    rarest = min(index for _, index in layers)
    layers = [(height, (index / rarest) ** 2) for height, index in layers]
    tangent = np.zeros_like(distance)
    for _ in range(_MOST_STEPS):
        missing, rise = -distance, 0.0
        for height, square in layers:
            ratio = tangent_ratio(square, tangent**2)
            missing = missing + height * tangent * ratio
            rise = rise + height * square * ratio**3
        step = missing / rise
        tangent = tangent - step
        if not np.any(np.abs(step) > 1e-10 * (1.0 + tangent)):
            break  # the remaining error is of the order of the squared step
    return tangent * tangent_ratio(rarest**-2, tangent**2)


def _project(camera: CameraModel, points: np.ndarray) -> np.ndarray:
    """Project points as `project`, but allow rows of NaN."""
    z = np.where(points[:, 2] > 0, points[:, 2], np.nan)
    x, y = points[:, 0] / z, points[:, 1] / z
    if camera.coefficients().any():
        outside = x * x + y * y >= _find_largest_square(cast(Hashable, camera.distortion))
        x, y = _distort(camera.distortion, x, y)
        x[outside] = np.nan
        y[outside] = np.nan
    return np.stack([camera.fx_px * x + camera.cx_px, camera.fy_px * y + camera.cy_px], axis=1)


@lru_cache(maxsize=16)
def _find_largest_square(d: Distortion) -> float:
    """Return the squared radius of the domain where the distortion is one-to-one, or infinity if it is everywhere.

    The Jacobian of the distortion is symmetric. If it is positive definite on a disc, no two points of the disc have
    the same image. With the radial factor g(r) = N / D, its eigenvalues are g and (r g)'. The tangential terms lower
    them by at most 6 r |(p1, p2)|. The disc therefore ends where the smaller eigenvalue first reaches 6 r |(p1, p2)|,
    or at a pole of g. For barrel distortion this edge is exact.

    The unknown of the polynomials is 1 / r, so that their leading coefficient is 1. Radii above `_WIDEST` count as
    infinite.
    """
    r = Polynomial([0.0, 1.0])
    tangential = 6.0 * math.hypot(d.p1, d.p2) * r
    above, below = (Polynomial([1.0, 0.0, a, 0.0, b, 0.0, c]) for a, b, c in ((d.k1, d.k2, d.k3), (d.k4, d.k5, d.k6)))
    across = above - tangential * below
    along = (above + r * above.deriv()) * below - r * above * below.deriv() - tangential * below**2
    roots = np.concatenate([np.roots(each.coef) for each in (across, along, below)])
    ends = roots.real[(np.abs(roots.imag) < 1e-9 * np.abs(roots)) & (roots.real > 1.0 / _WIDEST)]
    return float(ends.max() ** -2) if len(ends) else math.inf


def _compute_radial(d: Distortion, s: np.ndarray) -> np.ndarray:
    """Return the radial factor g at squared radii s."""
    above = 1.0 + s * (d.k1 + s * (d.k2 + s * d.k3))
    return above / _compute_denominator(d, s) if d.is_rational() else above


def _compute_denominator(d: Distortion, s: np.ndarray) -> np.ndarray:
    """Return the denominator of the radial factor at squared radii s."""
    return 1.0 + s * (d.k4 + s * (d.k5 + s * d.k6))


def _differentiate_radial(d: Distortion, s: np.ndarray) -> np.ndarray:
    """Return the derivative of the radial factor with respect to s."""
    slope = d.k1 + s * (2.0 * d.k2 + s * (3.0 * d.k3))
    if not d.is_rational():
        return slope
    return (slope - _compute_radial(d, s) * (d.k4 + s * (2.0 * d.k5 + s * (3.0 * d.k6)))) / _compute_denominator(d, s)


def _find_growth(d: Distortion, x: np.ndarray, y: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the squared radius, and the factor of the coordinates in `_distort`."""
    s = x * x + y * y
    return s, _compute_radial(d, s) + 2.0 * (d.p1 * y + d.p2 * x)


def _distort(d: Distortion, x: np.ndarray, y: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Distort ideal image coordinates, in units of the focal length (OpenCV, module calib3d)."""
    s, growth = _find_growth(d, x, y)
    return x * growth + d.p2 * s, y * growth + d.p1 * s


def _compute_jacobian(
    d: Distortion, x: np.ndarray, y: np.ndarray, s: np.ndarray, growth: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return the derivatives xx, xy = yx, yy of `_distort`; ``s`` and ``growth`` are the results of `_find_growth`."""
    slope = _differentiate_radial(d, s)
    x_slope, y_slope = 2.0 * (slope * x + d.p2), 2.0 * (slope * y + d.p1)
    return growth + x * (x_slope + 2.0 * d.p2), x * y_slope + (2.0 * d.p2) * y, growth + y * (y_slope + 2.0 * d.p1)


def image_derivatives(camera: CameraModel, pixels: np.ndarray, ideal: np.ndarray) -> np.ndarray:
    """Return the derivatives (14, 2, N) of the ideal image coordinates (2, N) of pixels (N, 2).

    The derivatives are with respect to u, v, fx, fy, cx, cy, and the distortion in OpenCV's order, k1 k2 p1 p2 k3 k4 k5
    k6. Implicit differentiation of D(x, y; k) = ((u - cx) / fx, (v - cy) / fy) = w gives
    dD/d(x, y) d(x, y) = dw - dD/dk dk.
    """
    (x, y), d = ideal, camera.distortion
    focal, centre = np.array([camera.fx_px, camera.fy_px]), np.array([camera.cx_px, camera.cy_px])
    s, growth = _find_growth(d, x, y)
    xx, xy, yy = _compute_jacobian(d, x, y, s, growth)
    change = np.zeros((14, 2, len(x)))
    change[[0, 1], [0, 1]] = 1.0 / focal[:, None]
    change[[2, 3], [0, 1]] = (centre - pixels).T / focal[:, None] ** 2
    change[[4, 5], [0, 1]] = -1.0 / focal[:, None]
    powers = np.stack([s, s**2, s**3])[:, None] * ideal / _compute_denominator(d, s)
    change[[6, 7, 10]], change[11:] = -powers, _compute_radial(d, s) * powers
    change[8] = -2.0 * x * y, -s - 2.0 * y * y
    change[9] = -s - 2.0 * x * x, -2.0 * x * y
    first, second = yy * change[:, 0] - xy * change[:, 1], xx * change[:, 1] - xy * change[:, 0]
    return np.stack([first, second], axis=1) / (xx * yy - xy * xy)


def _compute_newton_step(
    d: Distortion, x_seen: np.ndarray, y_seen: np.ndarray, x: np.ndarray, y: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return Newton's step (x, y) towards the inverse of `_distort`, and the present residual."""
    s, growth = _find_growth(d, x, y)
    x_missing, y_missing = x_seen - x * growth - d.p2 * s, y_seen - y * growth - d.p1 * s
    xx, xy, yy = _compute_jacobian(d, x, y, s, growth)
    scale = 1.0 / (xx * yy - xy * xy)
    x_step, y_step = (yy * x_missing - xy * y_missing) * scale, (xx * y_missing - xy * x_missing) * scale
    return x_step, y_step, np.abs(x_missing) + np.abs(y_missing)


def _undistort(d: Distortion, x_seen: np.ndarray, y_seen: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Invert `_distort` in its domain about the centre; NaN outside the image of the domain."""
    allowed = _is_allowed(x_seen, y_seen)
    with np.errstate(all="ignore"):
        start = 1.0 / _compute_radial(d, x_seen * x_seen + y_seen * y_seen)
        x, y = start * x_seen, start * y_seen
        found = np.zeros(len(x), dtype=bool)
        for _ in range(_USUAL_STEPS):
            x_step, y_step, missing = _compute_newton_step(d, x_seen, y_seen, x, y)
            found = missing <= allowed
            if found.all():
                break
            x, y = x + x_step, y + y_step
        found &= x * x + y * y < _find_largest_square(cast(Hashable, d))
    if not found.all():
        hard = np.flatnonzero(~found)
        x[hard], y[hard] = _undistort_damped(d, x_seen[hard], y_seen[hard])
    return x, y


def _undistort_damped(d: Distortion, x_seen: np.ndarray, y_seen: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Invert `_distort` by damped Newton steps from the centre.

    A step is halved until it stays in the domain and reduces the residual. Because the Jacobian is positive definite in
    the domain, a short enough step always reduces it.
    """
    largest, allowed = _find_largest_square(cast(Hashable, d)), _is_allowed(x_seen, y_seen)
    x, y = np.zeros_like(x_seen), np.zeros_like(y_seen)
    x_next, y_next, missing = x, y, np.full_like(x, np.inf)
    for _ in range(_MOST_STEPS):
        x_step, y_step, missing = _compute_newton_step(d, x_seen, y_seen, x, y)
        length, helps = np.ones_like(x), np.zeros(len(x), dtype=bool)
        for _ in range(_MOST_HALVINGS):
            x_next, y_next = x + length * x_step, y + length * y_step
            x_now, y_now = _distort(d, x_next, y_next)
            left = np.abs(x_seen - x_now) + np.abs(y_seen - y_now)
            helps = (left < missing) & (x_next * x_next + y_next * y_next < largest)
            if helps.all():
                break
            length = np.where(helps, length, length / 2)
        if not helps.any():
            break
        x, y = np.where(helps, x_next, x), np.where(helps, y_next, y)
    found = missing <= allowed
    return np.where(found, x, np.nan), np.where(found, y, np.nan)


def _is_allowed(x_seen: np.ndarray, y_seen: np.ndarray) -> np.ndarray:
    return _ROUNDING * (1.0 + np.abs(x_seen) + np.abs(y_seen))
