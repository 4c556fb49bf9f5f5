"""Design formulas of camera and sheet: rays through flat windows, distortion, resolution, view, speckle, strength.

The formulas accept arrays of any library ``xp`` with sqrt, sin and cos: NumPy, for many designs at once, or Dr.Jit,
which differentiates them. All quantities are in the camera frame, in mm; vectors are tuples of three arrays. The
renderer uses another method, ray tracing through real faces, so that each can be checked against the other.

"Thesis" is G. S. de Matos, UFSC 2017, chapters 2 and 3. Its equations hold in air, for a laser without roll. The pixel
is u across and v along the stripe from the principal point. Baseline is B, angle theta_t, focal length f, pixel size s.

- Eq. 2.8, Z = B f / (f tan theta_t - s u), is the depth along the camera's axis.
- Eq. 2.9, dZ/du = Z^2 s / (B f), is its derivative. Eqs. 2.11 and 3.1 are wrong: their denominators subtract
  s B cos theta_t (mm^2 per pixel) from a length, instead of s u, and the factor cos theta_t is not justified.
- Eq. 2.10 for the position along the stripe, Y = Z s v / f, has a superfluous factor f cos theta_t (mm^2).

Behind a window, `project_points` and `pixels_per_mm` replace them.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from types import ModuleType
from typing import Any

import numpy as np

from uwlts.errors import DesignError
from uwlts.model.calibration import CameraModel
from uwlts.model.placement import camera_from_object, laser_pose
from uwlts.model.sensor import Camera, Medium, Sensor, Window
from uwlts.optics.camera import directions

Array = Any  # NumPy array, Dr.Jit array, or number
Vector = tuple[Array, Array, Array]

_NEWTON_STEPS = 4  # of the ray through the window; converges quadratically
_TINY_MM = 1e-9  # offset that avoids an undefined direction for a point on the window's normal; negligible
_EDGE_STEPS = 5  # Newton steps to an edge of the image; converges quadratically from a close start
_NEAREST_MM = 1.0  # least distance of the sheet's entry into the image from the window's outer face
FARTHEST_MM = 1e6  # largest distance of the sheet's exit from the image, from the pupil; no water is transparent as far
_CLAMPED = 0.75  # K_w of thesis Eq. 3.2 for a clamped edge, by plate theory (Timoshenko)
DEPOLARISED_CONTRAST = math.sqrt(0.5)
"""Speckle contrast of a depolarising surface such as paint: the sum of two independent patterns of equal mean (Goodman,
Speckle Phenomena in Optics, section 3.4)."""


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


def trace_pixels(camera: Camera, pixels: np.ndarray) -> np.ndarray:
    """Return the rays (N, 3) in air of pixels (N, 2) of a described camera; NaN beyond the domain of its distortion."""
    return directions(CameraModel.from_description(camera), pixels)


def project_points(xp: ModuleType, lens: Lens, window: WindowGeometry, point: Vector) -> ImagePoints:
    """Project points beyond the window into the image."""
    path = trace_to_points(xp, window, point)
    ray = add_vectors(window.normal, scale_vector(path.across, path.slope))
    a, b = ray[0] / ray[2], ray[1] / ray[2]
    # OpenCV's distortion model.
    r2 = a * a + b * b
    radial, slope = lens.radial(r2)
    x = a * radial + 2 * lens.p1 * a * b + lens.p2 * (r2 + 2 * a * a)
    y = b * radial + 2 * lens.p2 * a * b + lens.p1 * (r2 + 2 * b * b)
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


@dataclass(frozen=True)
class SheetGeometry:
    """Geometry of a camera that sees a laser sheet: lens, window, laser fan, and image.

    ``along_width`` is 1 if the stripe runs along the image's width, else 0.
    """

    lens: Lens
    window: WindowGeometry
    laser: LaserFan
    along_width: Array
    width_px: Array
    height_px: Array

    @classmethod
    def from_description(cls, sensor: Sensor, medium: Medium) -> SheetGeometry:
        """Make the nominal geometry of a sensor in a medium; a window that is not mounted is left out.

        Raises DesignError if the sheet does not cross the camera's axis beyond the window, or the stripe runs along the
        other side of the image. The same if no window is mounted although the medium is not air.
        """
        camera, wavelength = sensor.camera, sensor.laser.wavelength_nm
        camera_from_object(sensor)
        pose, index = laser_pose(sensor), medium.refractive_index(wavelength)
        if not camera.window.mounted and index != 1:
            raise DesignError(f"the camera's window is not mounted, but the medium's index is {index:.4f}: mount it")
        if abs(pose.normal[1 if camera.stripe_along == "width" else 0]) < 1e-6:
            raise DesignError(
                f"the stripe runs across the image's {camera.stripe_along}, not along it: turn the camera"
            )
        window = WindowGeometry((0.0, 0.0, 1.0), 0.0, 0.0, 1.0, 1.0)
        if camera.window.mounted:
            window = WindowGeometry.from_description(camera.window, medium, wavelength, np.eye(3))
        return cls(
            Lens.from_description(camera),
            window,
            LaserFan(tuple(pose.origin_mm), tuple(pose.axis), tuple(pose.fan), tuple(pose.normal)),
            float(camera.stripe_along == "width"),
            camera.width_px,
            camera.height_px,
        )

    def along(self, pair: tuple[Array, Array]) -> Array:
        """Return the element of a pair (x, y) that belongs to the direction along the stripe."""
        return self.along_width * pair[0] + (1 - self.along_width) * pair[1]

    def across(self, pair: tuple[Array, Array]) -> Array:
        """Return the element of a pair (x, y) that belongs to the direction across the stripe."""
        return self.along_width * pair[1] + (1 - self.along_width) * pair[0]

    def point(self, z_mm: Array, y_mm: Array = 0.0) -> Vector:
        """Return points of the sheet, from its crossing of the camera's axis along laser axis (Z) and stripe (Y)."""
        standoff = standoff_mm(self.laser)
        crossing = (0.0 * standoff, 0.0 * standoff, standoff)
        along_axis = add_vectors(crossing, scale_vector(self.laser.axis, z_mm))
        return add_vectors(along_axis, scale_vector(self.laser.fan, y_mm))

    def project(self, xp: ModuleType, point: Vector) -> ImagePoints:
        """Project points beyond the window into the image."""
        return project_points(xp, self.lens, self.window, point)

    def depths_in_view(self, xp: ModuleType, outer_mm: Array) -> tuple[Array, Array]:
        """Return the depths from the pupil, near and far, where the middle of the line appears at the image's edges.

        ``outer_mm`` is the depth of the window's outer face, which limits the near end. Newton's method finds the
        depths. Its unknown is the inverse of the depth: the pixel is a nearly linear function of it, exactly linear
        without a window.
        """
        standoff, axis = standoff_mm(self.laser), self.laser.axis
        ends = []
        for edge in (-0.5, self.across((self.width_px, self.height_px)) - 0.5):
            inverse = 1 / standoff
            for _ in range(_EDGE_STEPS):
                depth = 1 / inverse
                image = self.project(xp, self.point((depth - standoff) / axis[2]))
                change = -(depth**2) / axis[2] * self.across(pixels_per_mm(image, self.window, axis))
                inverse = inverse + (edge - self.across((image.x, image.y))) / change
                inverse = xp.minimum(xp.maximum(inverse, 1 / FARTHEST_MM), 1 / (outer_mm + _NEAREST_MM))
            ends.append(1 / inverse)
        return xp.minimum(ends[0], ends[1]), xp.maximum(ends[0], ends[1])

    def line_ends(self, xp: ModuleType, z_mm: Array) -> tuple[Array, Array]:
        """Return the positions Y along the stripe of the image's edges, at distances Z along the laser's axis."""
        ends = []
        for edge in (-0.5, self.along((self.width_px, self.height_px)) - 0.5):
            y = 0.0 * z_mm
            for _ in range(_EDGE_STEPS):
                image = self.project(xp, self.point(z_mm, y))
                per_mm = pixels_per_mm(image, self.window, self.laser.fan)
                y = y + (edge - self.along((image.x, image.y))) / self.along(per_mm)
            ends.append(y)
        return xp.minimum(ends[0], ends[1]), xp.maximum(ends[0], ends[1])

    def mm_per_pixel(self, image: ImagePoints) -> tuple[Array, Array]:
        """Return the motion (Y, Z) in the sheet for a pixel across the stripe, on a fixed profile line.

        The motion is J^-1 (1, 0) with the Jacobian J of the pixel across and along the stripe for Y and Z.
        """
        by_y, by_z = (pixels_per_mm(image, self.window, along) for along in (self.laser.fan, self.laser.axis))
        determinant = self.across(by_y) * self.along(by_z) - self.across(by_z) * self.along(by_y)
        return self.along(by_z) / determinant, -self.along(by_y) / determinant

    def crossing_motion(self) -> np.ndarray:
        """Return the motion (3,) in the sheet per pixel across the stripe, where the camera's axis meets the sheet."""
        y, z = self.mm_per_pixel(self.project(np, self.point(0.0)))
        return np.ravel(y) * np.array(self.laser.fan) + np.ravel(z) * np.array(self.laser.axis)


def scheimpflug_angle_rad(*, triangulation_angle_rad: float, magnification: float) -> float:
    """Return the angle between image plane and lens axis that focuses the whole sheet; pi / 2 is an untilted image.

    Thesis Eq. 2.12 is tan theta_t = k tan beta_s, where the magnification k is the image distance divided by the object
    distance. The equation is correct, but the printed 87.9 deg is not the value of the built sensor, whose
    k = 12.5 / 366 in air gives 87.2 deg. Two readings give 87.9 deg:

    - The distance of the thesis's speckle limit, 250 mm (k = 12.5 / 237.5), with 90 deg - theta_t in place of theta_t.
      With theta_t the result is 85.7 deg.
    - The built sensor's k divided by 1.33. This includes the apparent angle of the sheet in water, but not its apparent
      distance.

    Behind a flat window the sheet appears at tan theta = n tan theta_t, and k follows from the apparent distance.
    """
    return math.atan(math.tan(triangulation_angle_rad) / magnification)


def speckle_limit_um(*, wavelength_nm: float, focal_length_mm: float, f_number: float, distance_mm: float) -> float:
    """Return the standard uncertainty of a laser spot's position on the object because of speckle, in um.

    The uncertainty across the camera's axis is C lambda / (2 pi sin u), with the speckle contrast C of
    `DEPOLARISED_CONTRAST` (Dorsch, Haeusler and Herrmann 1994, Applied Optics 33:1306). From the object, the pupil of
    diameter f / N appears under the half-angle u.

    The uncertainty along the laser's axis is larger by 1 / sin theta_t. The thesis's 16 um at 250 mm is the value
    across the axis for a contrast of 1; its value in depth is 28 um.

    Behind a window, ``distance_mm`` is the apparent distance from the pupil.
    """
    sine = math.sin(math.atan(focal_length_mm / f_number / 2 / distance_mm))
    return 1e-3 * DEPOLARISED_CONTRAST * wavelength_nm / (2 * math.pi * sine)


SAFETY_FACTOR = 4.0  # of a window against fracture (thesis Eq. 3.2)


def window_thickness_mm(*, pressure_mpa: Array, unsupported_diameter_mm: Array, strength_mpa: Array) -> Array:
    """Return the thickness of a clamped round window, t = A / 2 sqrt(K_w f_s dP / S_f) (Harris 1999, thesis Eq. 3.2).

    A is ``unsupported_diameter_mm``, dP ``pressure_mpa``, S_f ``strength_mpa``, and f_s is `SAFETY_FACTOR`.

    The thesis prints 5.53 mm for 1 MPa without A, K_w and S_f. Its Figure 34 lists only fused silica (60 MPa). With
    f_s = 4, the diameter A is then 49.5 mm. The bore of 63 mm would need 7.0 mm.
    """
    return 0.5 * unsupported_diameter_mm * np.sqrt(_CLAMPED * SAFETY_FACTOR * pressure_mpa / strength_mpa)


def line_needed_mm(*, pipe_diameter_mm: float, passes: int) -> float:
    """Return the line length that covers a pipe's circumference: the inscribed polygon's side (thesis Figure 27)."""
    return pipe_diameter_mm * math.sin(math.pi / passes)
