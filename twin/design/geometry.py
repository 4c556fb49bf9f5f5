"""Geometry of camera and sheet: rays through flat windows, distortion, and how the image moves with points.

The formulas are written for arrays of any kind that has sqrt, sin and cos in its namespace ``xp``: NumPy, for many
designs at once, or Dr.Jit, which differentiates them. Everything lies in the camera frame (mm); vectors are tuples of
three arrays. The renderer has its own method, tracing rays through real faces, so that one can be checked against the
other.
"""

from __future__ import annotations

from dataclasses import dataclass
from types import ModuleType
from typing import Any

import numpy as np

from uwlts.model.sensor import Camera, Medium, Window

Array = Any
"""A NumPy or Dr.Jit array, or a number that goes with one."""
Vector = tuple[Array, Array, Array]

_NEWTON_STEPS = 4
_UNDISTORTING_STEPS = 100
"""Strong distortion converges slowly."""
_UNDISTORTED_PX = 1e-3
"""What may be left: far below what a drawing shows."""
_TINY_MM = 1e-9
"""Keeps the direction of a point on the window's normal defined; far below anything that matters."""


def where(xp: ModuleType, mask: Array, true: Array, false: Array) -> Array:
    """Elements of two arrays by a mask."""
    return (xp.where if xp is np else xp.select)(mask, true, false)


def dot(a: Vector, b: Vector) -> Array:
    """Inner product."""
    return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]


def scaled(a: Vector, factor: Array) -> Vector:
    """Vector times a number."""
    return a[0] * factor, a[1] * factor, a[2] * factor


def added(a: Vector, b: Vector) -> Vector:
    """Sum of two vectors."""
    return a[0] + b[0], a[1] + b[1], a[2] + b[2]


@dataclass(frozen=True)
class LaserFan:
    """The laser's fan: its origin, and unit vectors along its axis, along the stripe and across the sheet."""

    origin: Vector
    axis: Vector
    fan: Vector
    normal: Vector


def pose_at(xp: ModuleType, *, baseline_mm: Array, angle_rad: Array, roll_rad: Array, towards: Vector) -> LaserFan:
    """Fan of a laser placed by baseline and triangulation angle; ``towards`` is the baseline's direction, (x, y, 0).
    As `uwlts.model.placement.laser_pose`, in a form that can be derived."""
    sine, cosine = xp.sin(angle_rad), xp.cos(angle_rad)
    axis = (-sine * towards[0], -sine * towards[1], cosine)
    across = (cosine * towards[0], cosine * towards[1], sine)
    along = (-towards[1], towards[0], 0.0 * sine)
    turn, keep = xp.sin(roll_rad), xp.cos(roll_rad)
    normal = added(scaled(across, keep), scaled(along, turn))
    fan = added(scaled(along, keep), scaled(across, -turn))
    return LaserFan(scaled(towards, baseline_mm), axis, fan, normal)


def standoff_mm(pose: LaserFan) -> Array:
    """Depth at which the sheet crosses the camera's axis, from the entrance pupil."""
    return dot(pose.normal, pose.origin) / pose.normal[2]


@dataclass(frozen=True)
class WindowGeometry:
    """A window: unit normal away from the module, distance to its inner face along the normal, thickness, indices."""

    normal: Vector
    distance_mm: Array
    thickness_mm: Array
    glass_index: Array
    medium_index: Array

    @classmethod
    def of(cls, window: Window, medium: Medium, wavelength_nm: float, rotation: np.ndarray) -> WindowGeometry:
        """A mounted window before a medium; ``rotation`` (3, 3) leads from its module's frame to the one wanted."""
        normal = rotation @ window.normal()
        distance = window.distance_mm * float(rotation[:, 2] @ normal)
        indices = window.index(wavelength_nm), medium.refractive_index(wavelength_nm)
        return cls((normal[0], normal[1], normal[2]), distance, window.thickness_mm, *indices)

    @property
    def outer_mm(self) -> Array:
        """Distance of the outer face along the normal."""
        return self.distance_mm + self.thickness_mm

    def layers(self, height_mm: Array) -> tuple[tuple[Array, Array], ...]:
        """Extents along the normal up to a height, and indices, of the air, the glass and the medium."""
        return (
            (self.distance_mm, 1.0),
            (self.thickness_mm, self.glass_index),
            (height_mm - self.outer_mm, self.medium_index),
        )


@dataclass(frozen=True)
class Path:
    """Rays from a module's origin through its window to points outside.

    ``slope`` is the tangent of the angle to the window's normal in air, ``slope_outside`` that in the medium,
    ``across`` the unit vector square to the normal in which the ray leans, ``height_mm`` the point's distance from the
    origin along the normal. ``apparent_mm`` is the ray's distance across over its slope in air, the distance from which
    it seems to come sideways; ``growth_mm`` is the change of the distance across by the slope, the distance from which
    a bundle seems to come in the plane of incidence.
    """

    slope: Array
    slope_outside: Array
    across: Vector
    height_mm: Array
    apparent_mm: Array
    growth_mm: Array


def snell_root(xp: ModuleType, index: Array, slope: Array) -> Array:
    """The root sqrt(n^2 + (n^2 - 1) p^2) by which Snell's law divides the slope p that a ray has in air. From n sin(b)
    = sin(a) with p = tan(a): tan(b) = p / sqrt(n^2 + (n^2 - 1) p^2)."""
    return xp.sqrt(index * index + (index * index - 1) * slope * slope)


def across_mm(xp: ModuleType, window: WindowGeometry, height_mm: Array, slope: Array) -> Array:
    """Distance from the normal through the origin that a ray of some slope in air has at a height along the normal."""
    return sum(extent * slope / snell_root(xp, n, slope) for extent, n in window.layers(height_mm))


def traced(window: WindowGeometry, origin: np.ndarray, directions: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Points (N, 3, 3) where rays (N, 3) start and meet both faces of a window, and their directions behind it; NaN for
    rays that lead away from the window."""
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


def path_to(xp: ModuleType, window: WindowGeometry, point: Vector) -> Path:
    """The ray to points beyond a window, by Snell's law, with the module's origin at 0.

    A ray of slope p in air has in a layer of index n the slope p S(n), S(n) = 1 / sqrt(n^2 + (n^2 - 1) p^2), so that it
    goes p M(p) across, M being the sum of every layer's extent times its S. Newton's method solves p M = rho; its
    derivative is the sum of extent times n^2 S^3.
    """
    height = dot(point, window.normal)
    sideways = added(point, scaled(window.normal, -height))
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
    return Path(p, p * last, scaled(sideways, 1 / rho), height, total, growth)


def direction_outside(xp: ModuleType, window: WindowGeometry, path: Path) -> Vector:
    """Unit vectors of rays in the medium, away from the module."""
    p = path.slope_outside
    return scaled(added(window.normal, scaled(path.across, p)), 1 / xp.sqrt(1 + p * p))


def length_outside_mm(xp: ModuleType, window: WindowGeometry, path: Path) -> Array:
    """Path length of rays through the medium."""
    return (path.height_mm - window.outer_mm) * xp.sqrt(1 + path.slope_outside * path.slope_outside)


@dataclass(frozen=True)
class Lens:
    """A pinhole with distortion as in `uwlts.model.sensor.Distortion`: focal lengths and principal point in px."""

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
    def of(cls, camera: Camera) -> Lens:
        """That of a camera's description."""
        return cls(*camera.focal_lengths_px(), *camera.principal_point(), *camera.distortion.model_dump().values())

    def radial(self, r2: Array) -> tuple[Array, Array]:
        """Radial factor of the distortion at squares of the radius, and twice its derivative by them."""
        below = 1 + r2 * (self.k4 + r2 * (self.k5 + r2 * self.k6))
        factor = (1 + r2 * (self.k1 + r2 * (self.k2 + r2 * self.k3))) / below
        slope = self.k1 + r2 * (2 * self.k2 + r2 * 3 * self.k3)
        return factor, 2 * (slope - factor * (self.k4 + r2 * (2 * self.k5 + r2 * 3 * self.k6))) / below


@dataclass(frozen=True)
class ImagePoints:
    """Points as the camera sees them: pixels x, y, the ray there and its slopes (a, b) in air, before distortion; in
    ``jacobian`` how these change the pixels: dx/da, dx/db, dy/da, dy/db in px."""

    x: Array
    y: Array
    path: Path
    slopes: tuple[Array, Array]
    jacobian: tuple[Array, Array, Array, Array]


def distorted(lens: Lens, a: Array, b: Array) -> tuple[Array, Array, Array]:
    """Image points (x, y) of slopes (a, b), and the radial factor; distortion in OpenCV's form."""
    r2 = a * a + b * b
    radial, _ = lens.radial(r2)
    x = a * radial + 2 * lens.p1 * a * b + lens.p2 * (r2 + 2 * a * a)
    y = b * radial + 2 * lens.p2 * a * b + lens.p1 * (r2 + 2 * b * b)
    return x, y, radial


def directions_of(lens: Lens, pixels: np.ndarray) -> np.ndarray:
    """Rays (N, 3) of pixels (N, 2); distortion undone by fixed-point steps. NaN where they do not converge."""
    wanted = (pixels - (lens.cx, lens.cy)) / (lens.fx_px, lens.fy_px)
    found = wanted.copy()
    missed = np.full(len(found), np.inf)
    with np.errstate(all="ignore"):
        for _ in range(_UNDISTORTING_STEPS):
            x, y, radial = distorted(lens, *found.T)
            image = np.stack([x, y], axis=1)
            missed = np.abs(image - wanted).max(axis=1)
            found += (wanted - image) / radial[:, None]
        found[~(missed * lens.fx_px < _UNDISTORTED_PX)] = np.nan
    return np.column_stack([found, np.ones(len(found))])


def seen(xp: ModuleType, lens: Lens, window: WindowGeometry, point: Vector) -> ImagePoints:
    """Pixels at which points beyond the window appear."""
    path = path_to(xp, window, point)
    ray = added(window.normal, scaled(path.across, path.slope))
    a, b = ray[0] / ray[2], ray[1] / ray[2]
    r2 = a * a + b * b
    x, y, radial = distorted(lens, a, b)
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
    """Change of the image point's slopes (a, b) per mm that a point moves along a direction.

    From p M(p, h) = rho: the slope p changes by (d rho - p S dh) / growth, h being the point's height; and what goes
    square to the plane of incidence is seen from the apparent distance M.
    """
    path = view.path
    up = dot(along, window.normal)
    sideways = added(along, scaled(window.normal, -up))
    radial = dot(sideways, path.across)
    steeper = (radial - path.slope_outside * up) / path.growth_mm
    turned = scaled(added(sideways, scaled(path.across, -radial)), 1 / path.apparent_mm)
    change = added(scaled(path.across, steeper), turned)
    ray_z = window.normal[2] + path.across[2] * path.slope
    a, b = view.slopes
    return (change[0] - a * change[2]) / ray_z, (change[1] - b * change[2]) / ray_z


def pixels_per_mm(view: ImagePoints, window: WindowGeometry, along: Vector) -> tuple[Array, Array]:
    """Change of the pixels (x, y) per mm that a point moves along a direction."""
    da, db = slopes_per_mm(view, window, along)
    xa, xb, ya, yb = view.jacobian
    return xa * da + xb * db, ya * da + yb * db
