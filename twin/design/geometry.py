"""Geometry of camera and sheet: rays through flat windows, distortion, and derivatives of the image of a point.

The formulas accept arrays of any library ``xp`` with sqrt, sin and cos: NumPy, for many designs at once, or Dr.Jit,
which differentiates them. All quantities are in the camera frame, in mm; vectors are tuples of three arrays. The
renderer uses another method, ray tracing through real faces, so that each can be checked against the other.
"""

from __future__ import annotations

from dataclasses import dataclass
from types import ModuleType
from typing import Any

import numpy as np

from uwlts.model.sensor import Camera, Medium, Window

Array = Any
"""NumPy array, Dr.Jit array, or number."""
Vector = tuple[Array, Array, Array]

_NEWTON_STEPS = 4  # of the ray through the window; converges quadratically
_UNDISTORTING_STEPS = 100
"""Largest number of iterations; strong distortion converges slowly."""
_UNDISTORTED_PX = 1e-3
"""Tolerance of undistorted points, sufficient for a drawing."""
_TINY_MM = 1e-9
"""Offset that avoids an undefined direction for a point on the window's normal; negligible."""


def select(xp: ModuleType, mask: Array, true: Array, false: Array) -> Array:
    """Select elements of two arrays by a mask."""
    return (xp.where if xp is np else xp.select)(mask, true, false)


def dot(a: Vector, b: Vector) -> Array:
    """Return the inner product of two vectors."""
    return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]


def scale_vector(a: Vector, factor: Array) -> Vector:
    """Multiply a vector by a number."""
    return a[0] * factor, a[1] * factor, a[2] * factor


def add_vectors(a: Vector, b: Vector) -> Vector:
    """Add two vectors."""
    return a[0] + b[0], a[1] + b[1], a[2] + b[2]


@dataclass(frozen=True)
class LaserFan:
    """Laser fan: origin, and unit vectors along its axis, along the stripe and across the sheet."""

    origin: Vector
    axis: Vector
    fan: Vector
    normal: Vector


def place_laser(xp: ModuleType, *, baseline_mm: Array, angle_rad: Array, roll_rad: Array, towards: Vector) -> LaserFan:
    """Return the fan of a laser that is placed by baseline and triangulation angle.

    The result is that of `uwlts.model.placement.laser_pose`, but differentiable.

    ``xp`` is NumPy or Dr.Jit, ``towards`` the direction (x, y, 0) of the baseline, and ``roll_rad`` the rotation of the
    fan about the laser's axis.
    """
    sine, cosine = xp.sin(angle_rad), xp.cos(angle_rad)
    axis = (-sine * towards[0], -sine * towards[1], cosine)
    across = (cosine * towards[0], cosine * towards[1], sine)
    along = (-towards[1], towards[0], 0.0 * sine)
    turn, keep = xp.sin(roll_rad), xp.cos(roll_rad)
    normal = add_vectors(scale_vector(across, keep), scale_vector(along, turn))
    fan = add_vectors(scale_vector(along, keep), scale_vector(across, -turn))
    return LaserFan(scale_vector(towards, baseline_mm), axis, fan, normal)


def standoff_mm(pose: LaserFan) -> Array:
    """Return the depth of the sheet on the camera's axis, from the entrance pupil."""
    return dot(pose.normal, pose.origin) / pose.normal[2]


@dataclass(frozen=True)
class WindowGeometry:
    """Window: unit normal away from the module, distance of the inner face along the normal, thickness, indices."""

    normal: Vector
    distance_mm: Array
    thickness_mm: Array
    glass_index: Array
    medium_index: Array

    @classmethod
    def from_description(
        cls, window: Window, medium: Medium, wavelength_nm: float, rotation: np.ndarray
    ) -> WindowGeometry:
        """Make a mounted window; ``rotation`` (3, 3) rotates from its module's frame to the frame of the result."""
        normal = rotation @ window.normal()
        distance = window.distance_mm * float(rotation[:, 2] @ normal)
        indices = window.index(wavelength_nm), medium.refractive_index(wavelength_nm)
        return cls((normal[0], normal[1], normal[2]), distance, window.thickness_mm, *indices)

    @property
    def outer_mm(self) -> Array:
        """Distance of the outer face along the normal, mm."""
        return self.distance_mm + self.thickness_mm

    def layers(self, height_mm: Array) -> tuple[tuple[Array, Array], ...]:
        """Return the extent along the normal up to a height, and the index, of air, glass and medium."""
        return (
            (self.distance_mm, 1.0),
            (self.thickness_mm, self.glass_index),
            (height_mm - self.outer_mm, self.medium_index),
        )


@dataclass(frozen=True)
class Path:
    """Rays from a module's origin through its window to points outside."""

    # Tangent of the angle to the window's normal, in air and in the medium.
    slope: Array
    slope_outside: Array
    across: Vector  # unit vector of the ray's lateral direction, perpendicular to the normal
    height_mm: Array  # distance of the point from the origin along the normal
    apparent_mm: Array
    """Lateral distance of the point divided by the slope in air: apparent distance perpendicular to the plane of
    incidence."""
    growth_mm: Array
    """Derivative of the lateral distance with respect to the slope in air: apparent distance in the plane of
    incidence."""


def snell_root(xp: ModuleType, index: Array, slope: Array) -> Array:
    """Return sqrt(n^2 + (n^2 - 1) p^2), the ratio of a ray's slope p in air to its slope in a medium of index n.

    From n sin(b) = sin(a) with p = tan(a) follows tan(b) = p / sqrt(n^2 + (n^2 - 1) p^2).
    """
    return xp.sqrt(index * index + (index * index - 1) * slope * slope)


def across_mm(xp: ModuleType, window: WindowGeometry, height_mm: Array, slope: Array) -> Array:
    """Return the lateral distance, at a height along the normal, of rays with a slope in air."""
    return sum(extent * slope / snell_root(xp, n, slope) for extent, n in window.layers(height_mm))


def trace_rays(window: WindowGeometry, origin: np.ndarray, directions: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Trace rays (N, 3) from an origin through a window.

    Return the points (N, 3, 3) of the rays at the origin and at both faces, and the directions behind the window. Rays
    away from the window are NaN.
    """
    normal = np.array(window.normal)
    with np.errstate(invalid="ignore", divide="ignore"):
        ahead = directions @ normal
        sideways = directions / np.where(ahead > 0, ahead, np.nan)[:, None] - normal
        slope = np.sqrt((sideways**2).sum(axis=1))
        leaning = sideways / np.maximum(slope, 1e-300)[:, None]
    asides = window.distance_mm * slope, across_mm(np, window, window.outer_mm, slope)
    heights = window.distance_mm, window.outer_mm
    points = [origin + h * normal + aside[:, None] * leaning for h, aside in zip(heights, asides, strict=True)]
    outside = slope / snell_root(np, window.medium_index, slope)
    return np.stack([np.broadcast_to(origin, directions.shape), *points], axis=1), normal + outside[:, None] * leaning


def trace_to_points(xp: ModuleType, window: WindowGeometry, point: Vector) -> Path:
    """Return the rays from the module's origin, 0, to points beyond a window, by Snell's law.

    A ray of slope p in air has the slope p S(n) in a layer of index n. Here S(n) = 1 / sqrt(n^2 + (n^2 - 1) p^2). Its
    lateral distance is p M(p), where M is the sum over the layers of extent times S. Newton's method solves
    p M = rho. The derivative of p M is the sum of extent times n^2 S^3.
    """
    height = dot(point, window.normal)
    sideways = add_vectors(point, scale_vector(window.normal, -height))
    rho = xp.sqrt(dot(sideways, sideways) + _TINY_MM**2)
    layers = window.layers(height)

    def reach(p: Array) -> tuple[Array, Array, Array]:
        total, growth, last = 0.0, 0.0, None
        for extent, n in layers:
            last = 1 / snell_root(xp, n, p)
            total, growth = total + extent * last, growth + extent * n * n * last**3
        return total, growth, last

    p = rho / reach(0.0 * rho)[0]
    for _ in range(_NEWTON_STEPS):
        total, growth, _ = reach(p)
        p = p + (rho - p * total) / growth
    total, growth, last = reach(p)
    return Path(p, p * last, scale_vector(sideways, 1 / rho), height, total, growth)


def direction_outside(xp: ModuleType, window: WindowGeometry, path: Path) -> Vector:
    """Return the unit vectors of rays in the medium, away from the module."""
    p = path.slope_outside
    return scale_vector(add_vectors(window.normal, scale_vector(path.across, p)), 1 / xp.sqrt(1 + p * p))


def length_outside_mm(xp: ModuleType, window: WindowGeometry, path: Path) -> Array:
    """Return the path length of rays in the medium."""
    return (path.height_mm - window.outer_mm) * xp.sqrt(1 + path.slope_outside * path.slope_outside)


@dataclass(frozen=True)
class Lens:
    """Pinhole with the distortion of `uwlts.model.sensor.Distortion`; focal lengths and principal point in px."""

    fx_px: Array
    fy_px: Array
    cx: Array
    cy: Array
    k1: Array
    k2: Array
    p1: Array
    p2: Array
    k3: Array
    k4: Array
    k5: Array
    k6: Array

    @classmethod
    def from_description(cls, camera: Camera) -> Lens:
        """Make the lens of a camera's description."""
        return cls(*camera.focal_lengths_px(), *camera.principal_point(), *camera.distortion.model_dump().values())

    def radial(self, r2: Array) -> tuple[Array, Array]:
        """Return the radial factor at squared radii, and twice its derivative with respect to them."""
        below = 1 + r2 * (self.k4 + r2 * (self.k5 + r2 * self.k6))
        factor = (1 + r2 * (self.k1 + r2 * (self.k2 + r2 * self.k3))) / below
        slope = self.k1 + r2 * (2 * self.k2 + r2 * 3 * self.k3)
        return factor, 2 * (slope - factor * (self.k4 + r2 * (2 * self.k5 + r2 * 3 * self.k6))) / below


@dataclass(frozen=True)
class ImagePoints:
    """Images of points: pixels x and y, rays, and their slopes (a, b) in air before distortion.

    ``jacobian`` contains the derivatives of the pixels, dx/da, dx/db, dy/da, dy/db in px.
    """

    x: Array
    y: Array
    path: Path
    slopes: tuple[Array, Array]
    jacobian: tuple[Array, Array, Array, Array]


def distort(lens: Lens, a: Array, b: Array) -> tuple[Array, Array, Array]:
    """Return image points (x, y) of slopes (a, b), and the radial factor; OpenCV's distortion model."""
    r2 = a * a + b * b
    radial, _ = lens.radial(r2)
    x = a * radial + 2 * lens.p1 * a * b + lens.p2 * (r2 + 2 * a * a)
    y = b * radial + 2 * lens.p2 * a * b + lens.p1 * (r2 + 2 * b * b)
    return x, y, radial


def undistort_pixels(lens: Lens, pixels: np.ndarray) -> np.ndarray:
    """Return the rays (N, 3) of pixels (N, 2), undistorted by fixed-point iteration; NaN without convergence."""
    wanted = (pixels - (lens.cx, lens.cy)) / (lens.fx_px, lens.fy_px)
    found = wanted.copy()
    missed = np.full(len(found), np.inf)
    with np.errstate(all="ignore"):
        for _ in range(_UNDISTORTING_STEPS):
            x, y, radial = distort(lens, *found.T)
            image = np.stack([x, y], axis=1)
            missed = np.abs(image - wanted).max(axis=1)
            found += (wanted - image) / radial[:, None]
        found[~(missed * lens.fx_px < _UNDISTORTED_PX)] = np.nan
    return np.column_stack([found, np.ones(len(found))])


def project_points(xp: ModuleType, lens: Lens, window: WindowGeometry, point: Vector) -> ImagePoints:
    """Project points beyond the window into the image."""
    path = trace_to_points(xp, window, point)
    ray = add_vectors(window.normal, scale_vector(path.across, path.slope))
    a, b = ray[0] / ray[2], ray[1] / ray[2]
    r2 = a * a + b * b
    x, y, radial = distort(lens, a, b)
    _, slope = lens.radial(r2)
    mixed = slope * a * b + 2 * lens.p1 * a + 2 * lens.p2 * b
    jacobian = (
        lens.fx_px * (radial + slope * a * a + 2 * lens.p1 * b + 6 * lens.p2 * a),
        lens.fx_px * mixed,
        lens.fy_px * mixed,
        lens.fy_px * (radial + slope * b * b + 2 * lens.p2 * a + 6 * lens.p1 * b),
    )
    return ImagePoints(lens.fx_px * x + lens.cx, lens.fy_px * y + lens.cy, path, (a, b), jacobian)


def slopes_per_mm(view: ImagePoints, window: WindowGeometry, along: Vector) -> tuple[Array, Array]:
    """Return the derivatives of the slopes (a, b) per mm of a point's motion along a direction.

    In the plane of incidence, p M(p, h) = rho gives dp = (d rho - p S dh) / growth, where h is the point's height.
    Motion perpendicular to it is divided by the apparent distance M.
    """
    path = view.path
    up = dot(along, window.normal)
    sideways = add_vectors(along, scale_vector(window.normal, -up))
    radial = dot(sideways, path.across)
    steeper = (radial - path.slope_outside * up) / path.growth_mm
    turned = scale_vector(add_vectors(sideways, scale_vector(path.across, -radial)), 1 / path.apparent_mm)
    change = add_vectors(scale_vector(path.across, steeper), turned)
    ray_z = window.normal[2] + path.across[2] * path.slope
    a, b = view.slopes
    return (change[0] - a * change[2]) / ray_z, (change[1] - b * change[2]) / ray_z


def pixels_per_mm(view: ImagePoints, window: WindowGeometry, along: Vector) -> tuple[Array, Array]:
    """Return the derivatives of the pixels (x, y) per mm of a point's motion along a direction."""
    da, db = slopes_per_mm(view, window, along)
    xa, xb, ya, yb = view.jacobian
    return xa * da + xb * db, ya * da + yb * db
