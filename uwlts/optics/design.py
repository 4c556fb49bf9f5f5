"""Design formulas of a laser triangulation sensor: depth, resolution, line length, volume, tilt, speckle, window.

"Thesis" is G. S. de Matos, UFSC 2017, chapters 2 and 3. In its camera frame, depth Z runs along the camera's axis from
the entrance pupil. Image coordinates in pixels start at the principal point: ``u_px`` runs across the stripe, positive
away from the laser, and ``v_px`` along it. The triangulation angle is the angle between the laser's and the camera's
axes. The camera's window is normal to the camera's axis. The laser's window does not turn the sheet, because the sheet
contains the normal of that window.

In air a ray has the slope (p, e) = (u, v) s / f. By Snell's law, in a medium of index n the slope is
(p, e) / sqrt(n^2 + (n^2 - 1) (p^2 + e^2)). With it, the thesis's formulas for air hold exactly behind a window.
"""

import math
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from uwlts.errors import DesignError, RangeError
from uwlts.model.placement import camera_from_object, laser_pose
from uwlts.model.sensor import Medium, Sensor
from uwlts.optics.window import tangent_ratio

CLAMPED, UNCLAMPED = 0.75, 1.125
"""K_w of Eq. 3.2. Plate theory (Timoshenko) gives 3/4 for a clamped edge and 3 (3 + nu) / 8 for a supported edge.
The value 1.125 assumes Poisson's ratio nu = 0; glass with nu = 0.2 would have 1.2."""


@dataclass(frozen=True, kw_only=True)
class FlatWindow:
    """Layers in front of the camera: air from the pupil to the inner face, glass, and medium. The default is air only.

    Refractive indices are relative to air. With ``paraxial``, the slope in a medium is the slope in air divided by the
    index.
    """

    distance_mm: float = 0.0
    thickness_mm: float = 0.0
    glass_index: float = 1.0
    medium_index: float = 1.0
    paraxial: bool = False

    def __post_init__(self) -> None:
        lengths, indices = (self.distance_mm, self.thickness_mm), (self.glass_index, self.medium_index)
        if not (all(0 <= a < math.inf for a in lengths) and all(1 <= n < math.inf for n in indices)):
            raise RangeError(f"{self}: lengths must not be negative, and indices must be at least 1")
        if self.distance_mm == 0 and not self.paraxial and max(indices) > 1:
            raise RangeError(f"{self}: the window is in the pupil; give the distance from the pupil to the window")

    @property
    def outer_mm(self) -> float:
        """Distance from the pupil to the outer face."""
        return self.distance_mm + self.thickness_mm

    def slope(self, index: float, slope_squared: np.ndarray | float) -> np.ndarray:
        """Return the slope in a layer divided by the slope in air, from the squared slope in air."""
        squared = np.asarray(slope_squared, dtype=float)
        return tangent_ratio(index**2, 0.0 * squared if self.paraxial else squared)

    def layers(self, depth_mm: np.ndarray | float) -> tuple[tuple[np.ndarray, float], ...]:
        """Return the extent along the axis and the index of air, glass, and medium up to a depth."""
        extents = self.distance_mm, self.thickness_mm, depth_mm - self.outer_mm
        return tuple(zip(map(np.asarray, extents), (1.0, self.glass_index, self.medium_index), strict=True))

    def reach_mm(self, depth_mm: np.ndarray | float, slope_squared: np.ndarray | float = 0.0) -> np.ndarray:
        """Return a ray's lateral offset at a depth divided by its slope in air; for slope 0 the apparent distance."""
        offsets = [extent * self.slope(index, slope_squared) for extent, index in self.layers(depth_mm)]
        return offsets[0] + offsets[1] + offsets[2]


def thesis_factor(index: float = 1.33) -> FlatWindow:
    """Return the window of the thesis's approximation (section 3.1.2): a medium that begins at the pupil.

    The medium then magnifies by its index everywhere. The resolution of the thesis's sensor comes out 5 % too fine,
    because air and glass in front of the water do not magnify.
    """
    return FlatWindow(medium_index=index, paraxial=True)


@dataclass(frozen=True, kw_only=True)
class Triangulation:
    """Baseline B, angle theta_t, focal length f (the pinhole's image distance), pixel size s, and the window."""

    baseline_mm: float
    triangulation_angle_rad: float
    focal_length_mm: float
    pixel_size_mm: float
    window: FlatWindow = FlatWindow()

    def __post_init__(self) -> None:
        _require_positive(
            baseline_mm=self.baseline_mm, focal_length_mm=self.focal_length_mm, pixel_size_mm=self.pixel_size_mm
        )
        _require_acute(self.triangulation_angle_rad)

    def slopes(self, u_px: ArrayLike, v_px: ArrayLike) -> tuple[np.ndarray, np.ndarray]:
        """Return the slopes p across and e along the stripe of the rays of pixels in air."""
        u, v = np.broadcast_arrays(np.asarray(u_px, dtype=np.float64), np.asarray(v_px, dtype=np.float64))
        if not (np.isfinite(u).all() and np.isfinite(v).all()):
            raise RangeError("pixel coordinates must be finite")
        return u * self.pixel_size_mm / self.focal_length_mm, v * self.pixel_size_mm / self.focal_length_mm


def depth_mm(setup: Triangulation, u_px: ArrayLike, v_px: ArrayLike = 0.0) -> np.ndarray:
    """Return the depth Z of the sheet at pixels, broadcast.

    In air, Z = B f / (f tan theta_t - s u) (thesis Eq. 2.8). Behind a window, Z tan theta_t - B = p M(Z), where M is
    `FlatWindow.reach_mm`, linear in Z.

    Raises RangeError if a pixel is not finite, or its ray does not meet the sheet beyond the window.
    """
    depth = _depth_or_inf(setup, *setup.slopes(u_px, v_px))
    if not ((depth >= setup.window.outer_mm) & (depth < math.inf)).all():
        raise RangeError(
            "the ray of a pixel does not meet the sheet beyond the window: use pixels that see the measuring volume"
        )
    return depth


def depth_per_pixel_mm(setup: Triangulation, u_px: ArrayLike, v_px: ArrayLike = 0.0) -> np.ndarray:
    """Return the depth resolution dZ/du in mm per pixel, broadcast.

    In air, dZ/du = B f s / (f tan theta_t - s u)^2 = Z^2 s / (B f) (thesis Eq. 2.9, the derivative of Eq. 2.8).
    Eqs. 2.11 and 3.1 are wrong. Their denominators subtract s B cos theta_t (mm^2 per pixel) from a length, instead of
    s u, and the factor cos theta_t in the numerator is not justified.

    Z runs along the camera's axis. Along the laser's axis (Z of the object coordinate system) the resolution is larger
    by 1 / cos theta_t. The thesis's 0.22 mm per pixel is this value in water (0.221).
    """
    p, e = setup.slopes(u_px, v_px)
    slope = setup.window.slope(setup.window.medium_index, p**2 + e**2)
    shift = _growth_mm(setup.window, depth_mm(setup, u_px, v_px), p, e)
    return shift * setup.pixel_size_mm / setup.focal_length_mm / (math.tan(setup.triangulation_angle_rad) - p * slope)


def pixel_of_depth(setup: Triangulation, z_mm: ArrayLike, v_px: ArrayLike = 0.0) -> np.ndarray:
    """Return the pixel u of the sheet at depths Z, broadcast: the inverse of `depth_mm`.

    In air, u = f (tan theta_t - B / Z) / s. Behind a window, Newton's method solves for p. The lateral offset p M is a
    concave function of p, so that steps from a start below the solution never overshoot.

    Raises RangeError if a depth is not finite, is not beyond the window's outer face, or appears too far from the axis.
    """
    depth = np.asarray(z_mm, dtype=np.float64)
    if not ((depth > setup.window.outer_mm) & (depth < math.inf)).all():
        raise RangeError(f"depths must be finite and beyond the window's outer face at {setup.window.outer_mm:g} mm")
    depth, v = np.broadcast_arrays(depth, np.asarray(v_px, dtype=np.float64))
    _, e = setup.slopes(0.0, v)
    across = depth * math.tan(setup.triangulation_angle_rad) - setup.baseline_mm
    p = across / setup.window.reach_mm(depth, e**2)
    for _ in range(100):
        miss = across - p * setup.window.reach_mm(depth, p**2 + e**2)
        step = miss / _growth_mm(setup.window, depth, p, e)
        p = p + step
        # The remaining error is of the order of the squared step.
        if (np.abs(step) <= 1e-10 * (1 + np.abs(p))).all():
            return p * setup.focal_length_mm / setup.pixel_size_mm
    raise RangeError(
        f"the sheet appears up to {np.abs(p).max():.3g} focal lengths from the principal point, outside every image: "
        "give depths within the measuring volume"
    )


def position_along_mm(setup: Triangulation, u_px: ArrayLike, v_px: ArrayLike) -> np.ndarray:
    """Return the position Y along the stripe of the sheet's points at pixels, broadcast: in air Y = Z s v / f.

    Thesis Eq. 2.10 has a superfluous factor f cos theta_t, which gives mm^2. Z of Eq. 2.8 needs no cosine.
    """
    p, e = setup.slopes(u_px, v_px)
    return e * setup.window.reach_mm(depth_mm(setup, u_px, v_px), p**2 + e**2)


def line_length_mm(setup: Triangulation, z_mm: ArrayLike, *, side_px: float) -> np.ndarray:
    """Return the visible stripe length at depths Z on a plane normal to the laser's axis.

    ``side_px`` is the image side along the stripe, with the principal point in its middle. Thesis section 3.1.2
    multiplies the last term of Eq. 2.11 by the number of pixels. Because of the factor cos theta_t, the result is 18 %
    too short (see `position_along_mm`).

    The thesis measured 184 and 185.27 mm "at the stand-off". Its drawings give 204 mm in air and 160 mm in water at the
    stand-off, and 184 mm in water 60 mm beyond it.
    """
    _require_positive(side_px=side_px)
    return 2 * position_along_mm(setup, pixel_of_depth(setup, z_mm, side_px / 2), side_px / 2)


class MeasuringVolume(NamedTuple):
    """Limits of the sheet's visible part: depth Z from the pupil along the camera's axis."""

    near_mm: float
    far_mm: float


def measuring_volume(setup: Triangulation, *, side_px: float) -> MeasuringVolume:
    """Return the limits of depth in the middle of the line (Eq. 2.8).

    ``side_px`` is the image side across the stripe. The near limit is not below the window's outer face. The far limit
    is infinite if the ray at the image's edge does not meet the sheet.

    Raises RangeError if the camera does not see the sheet beyond the window.
    """
    _require_positive(side_px=side_px)
    near, far = _depth_or_inf(setup, *setup.slopes(np.array([-0.5, 0.5]) * side_px, 0.0))
    if not far > setup.window.outer_mm:
        raise RangeError(
            f"the sheet leaves the camera's view at {far:.1f} mm, before the window's outer face: increase the baseline"
        )
    return MeasuringVolume(float(max(near, setup.window.outer_mm)), float(far))


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
    _require_acute(triangulation_angle_rad)
    _require_positive(magnification=magnification)
    return math.atan(math.tan(triangulation_angle_rad) / magnification)


DEPOLARISED_CONTRAST = math.sqrt(0.5)
"""Speckle contrast of a depolarising surface such as paint: the sum of two independent patterns of equal mean (Goodman,
Speckle Phenomena in Optics, section 3.4)."""


def speckle_limit_um(
    *,
    wavelength_nm: float,
    focal_length_mm: float,
    f_number: float,
    distance_mm: float,
    contrast: float = DEPOLARISED_CONTRAST,
) -> float:
    """Return the standard uncertainty of a laser spot's position on the object because of speckle, in um.

    The uncertainty across the camera's axis is C lambda / (2 pi sin u), with speckle contrast C (Dorsch, Haeusler and
    Herrmann 1994, Applied Optics 33:1306). From the object, the pupil of diameter f / N appears under the half-angle u.

    The uncertainty along the laser's axis is larger by 1 / sin theta_t. The thesis's 16 um at 250 mm is the value
    across the axis for a contrast of 1; its value in depth is 28 um.

    Behind a window, ``distance_mm`` is the apparent distance from the pupil.
    """
    _require_positive(
        wavelength_nm=wavelength_nm,
        focal_length_mm=focal_length_mm,
        f_number=f_number,
        distance_mm=distance_mm,
        contrast=contrast,
    )
    sine = math.sin(math.atan(focal_length_mm / f_number / 2 / distance_mm))
    return 1e-3 * contrast * wavelength_nm / (2 * math.pi * sine)


def window_thickness_mm(
    *,
    pressure_mpa: float,
    unsupported_diameter_mm: float,
    strength_mpa: float,
    support: float = CLAMPED,
    safety: float = 4.0,
) -> float:
    """Return the thickness of a round window, t = A / 2 sqrt(K_w f_s dP / S_f) (Harris 1999, thesis Eq. 3.2).

    The thesis prints 5.53 mm for 1 MPa without A, K_w and S_f. Its Figure 34 lists only fused silica (60 MPa). With
    f_s = 4, the diameter A is then 49.5 mm if clamped and 40.4 mm if not. The bore of 63 mm would need 7.0 mm if
    clamped.

    A is ``unsupported_diameter_mm``, dP ``pressure_mpa``, S_f ``strength_mpa``, f_s ``safety``; K_w follows from the
    edge's ``support``.
    """
    _require_positive(
        pressure_mpa=pressure_mpa,
        unsupported_diameter_mm=unsupported_diameter_mm,
        strength_mpa=strength_mpa,
        support=support,
        safety=safety,
    )
    return 0.5 * unsupported_diameter_mm * math.sqrt(support * safety * pressure_mpa / strength_mpa)


def line_needed_mm(*, pipe_diameter_mm: float, passes: int) -> float:
    """Return the line length that covers a pipe's circumference: the inscribed polygon's side (thesis Figure 27)."""
    _require_positive(pipe_diameter_mm=pipe_diameter_mm)
    if passes < 2:
        raise RangeError(f"passes is {passes}; a pipe's whole circumference needs at least 2")
    return pipe_diameter_mm * math.sin(math.pi / passes)


def _depth_or_inf(setup: Triangulation, p: np.ndarray, e: np.ndarray) -> np.ndarray:
    """Return the depth of the sheet on rays of slopes p, e in air; infinite on rays that do not meet the sheet."""
    window, squared = setup.window, p**2 + e**2
    slope = window.slope(window.medium_index, squared)
    # Distance from the baseline's end to the ray in the medium, extended back to the depth of the pupil.
    start = setup.baseline_mm + p * (window.reach_mm(window.outer_mm, squared) - window.outer_mm * slope)
    closing = math.tan(setup.triangulation_angle_rad) - p * slope
    return np.where(closing > 0, start / np.where(closing > 0, closing, 1.0), math.inf)


def _growth_mm(window: FlatWindow, depth_mm: np.ndarray, p: np.ndarray, e: np.ndarray) -> np.ndarray:
    """Return the derivative of p M(depth, p^2 + e^2) with respect to p."""
    if window.paraxial:
        return window.reach_mm(depth_mm) + 0 * p
    slopes = ((extent, n, window.slope(n, p**2 + e**2)) for extent, n in window.layers(depth_mm))
    return np.sum([extent * (n**2 + (n**2 - 1) * e**2) * slope**3 for extent, n, slope in slopes], axis=0)


def _require_positive(**values: float) -> None:
    for name, value in values.items():
        if not 0 < value < math.inf:
            raise RangeError(f"{name} is {value:g}; expected a positive number")


def _require_acute(angle_rad: float) -> None:
    if not 0 < angle_rad < math.pi / 2:
        raise RangeError(f"the triangulation angle is {angle_rad:g} rad; expected one between 0 and pi / 2")


def nominal_setup(sensor: Sensor, medium: Medium) -> tuple[Triangulation, float]:
    """Return the sensor's triangulation behind its window, and Z along the laser's axis per depth along the camera's.

    Baseline and angle are measured in the plane through the pupil and the image's middle line across the stripe. There,
    a laser that is placed by its axis, or rolled, has the baseline and angle of the sheet's trace. Lens distortion and
    tilts are neglected, and pixels are square.

    Raises
    ------
    DesignError
        The sheet does not cross the camera's axis beyond the window, or the stripe runs along the other side of the
        image. The medium is not air, but the camera's window is not mounted.
    """
    camera, wavelength = sensor.camera, sensor.laser.wavelength_nm
    pose, index = laser_pose(sensor), medium.refractive_index(wavelength)
    standoff = camera_from_object(sensor)[2, 3]
    if not camera.window.mounted and index != 1:
        raise DesignError(f"the camera's window is not mounted, but the medium's index is {index:.4f}: mount it")
    side = 1 if camera.stripe_along == "width" else 0
    if abs(pose.normal[side]) < 1e-6:
        raise DesignError(f"the stripe runs across the image's {camera.stripe_along}, not along it: turn the camera")
    trace = np.array([0.0, 0.0, 1.0])
    trace[side] = -pose.normal[2] / pose.normal[side]
    setup = Triangulation(
        baseline_mm=standoff * abs(trace[side]),
        triangulation_angle_rad=math.atan(abs(trace[side])),
        focal_length_mm=camera.focal_length_mm,
        pixel_size_mm=1e-3 * camera.pixel_size_um,
        window=FlatWindow(
            distance_mm=camera.window.distance_mm,
            thickness_mm=camera.window.thickness_mm,
            glass_index=camera.window.index(wavelength) if camera.window.mounted else 1.0,
            medium_index=index,
        ),
    )
    return setup, float(abs(trace @ pose.axis))
