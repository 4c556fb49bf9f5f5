"""Design formulas of a laser triangulation sensor: depth, resolution, line length, volume, tilt, speckle, window.

"Thesis" is G. S. de Matos, UFSC 2017, chapters 2 and 3. Its camera frame: depth Z runs along the camera's axis from the
entrance pupil. Image coordinates are counted in pixels from the principal point: ``u_px`` across the stripe, positive
away from the laser, ``v_px`` along it. The laser's axis leans towards the camera's by the triangulation angle, and the
camera's window is square to the camera's axis; the laser's window does not turn a sheet that holds its normal.

A ray of slope (p, e) = (u, v) s / f in air has in a medium of index n, by Snell's law, the slope
(p, e) / sqrt(n^2 + (n^2 - 1) (p^2 + e^2)). So what the thesis writes for air holds exactly behind a window too.
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
"""K_w of Eq. 3.2. Plate theory (Timoshenko) gives 3/4 for a clamped edge, but 3 (3 + nu) / 8 for a supported one:
1.125 takes Poisson's ratio nu for 0, glass with 0.2 would have 1.2."""


@dataclass(frozen=True, kw_only=True)
class FlatWindow:
    """Layers before the camera: pupil to inner face, glass, medium; indices relative to air. Default: air alone.

    ``paraxial`` sets slopes in a medium to those in air over the index.
    """

    distance_mm: float = 0.0
    thickness_mm: float = 0.0
    glass_index: float = 1.0
    medium_index: float = 1.0
    paraxial: bool = False

    def __post_init__(self) -> None:
        lengths, indices = (self.distance_mm, self.thickness_mm), (self.glass_index, self.medium_index)
        if not (all(0 <= a < math.inf for a in lengths) and all(1 <= n < math.inf for n in indices)):
            raise RangeError(f"{self}: lengths must not be negative, indices not below 1")
        if self.distance_mm == 0 and not self.paraxial and max(indices) > 1:
            raise RangeError(f"{self}: a window in the pupil itself; give the distance from the pupil to the window")

    @property
    def outer_mm(self) -> float:
        """Pupil to outer face."""
        return self.distance_mm + self.thickness_mm

    def slope(self, index: float, slope_squared: np.ndarray | float) -> np.ndarray:
        """Slope in a layer over the slope in air, whose square is given."""
        squared = np.asarray(slope_squared, dtype=float)
        return tangent_ratio(index**2, 0.0 * squared if self.paraxial else squared)

    def layers(self, depth_mm: np.ndarray | float) -> tuple[tuple[np.ndarray, float], ...]:
        """Extent along the axis and index of air, glass, and medium up to a depth."""
        extents = self.distance_mm, self.thickness_mm, depth_mm - self.outer_mm
        return tuple(zip(map(np.asarray, extents), (1.0, self.glass_index, self.medium_index), strict=True))

    def reach_mm(self, depth_mm: np.ndarray | float, slope_squared: np.ndarray | float = 0.0) -> np.ndarray:
        """Way of a ray across the axis, up to a depth, over its slope in air; for slope 0 the apparent distance."""
        ways = [extent * self.slope(index, slope_squared) for extent, index in self.layers(depth_mm)]
        return ways[0] + ways[1] + ways[2]


def thesis_factor(index: float = 1.33) -> FlatWindow:
    """The thesis's approximation (section 3.1.2): the medium magnifies by its index, as if it began at the pupil.

    It makes the thesis's sensor 5 % too fine: air and glass before the water do not magnify.
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
        """Slopes p across and e along the stripe of a pixel's ray in air."""
        u, v = np.broadcast_arrays(np.asarray(u_px, dtype=np.float64), np.asarray(v_px, dtype=np.float64))
        if not (np.isfinite(u).all() and np.isfinite(v).all()):
            raise RangeError("pixel coordinates must be finite")
        return u * self.pixel_size_mm / self.focal_length_mm, v * self.pixel_size_mm / self.focal_length_mm


def depth_mm(setup: Triangulation, u_px: ArrayLike, v_px: ArrayLike = 0.0) -> np.ndarray:
    """Depth Z of the sheet at pixels, broadcast: thesis Eq. 2.8, in air Z = B f / (f tan theta_t - s u).

    Behind a window Z tan theta_t - B = p M(Z) with `FlatWindow.reach_mm` M, linear in Z.
    RangeError where a pixel does not see the sheet before the window, or is not finite.
    """
    depth = _depth_or_inf(setup, *setup.slopes(u_px, v_px))
    if not ((depth >= setup.window.outer_mm) & (depth < math.inf)).all():
        raise RangeError("a pixel does not see the sheet before the window: keep within the measuring volume")
    return depth


def depth_per_pixel_mm(setup: Triangulation, u_px: ArrayLike, v_px: ArrayLike = 0.0) -> np.ndarray:
    """dZ/du in mm per pixel, broadcast: thesis Eq. 2.9, in air B f s / (f tan theta_t - s u)^2 = Z^2 s / (B f).

    Eq. 2.9 is the derivative of Eq. 2.8 and right. Eqs. 2.11 and 3.1 are not: their denominator subtracts s B cos
    theta_t (mm^2 per pixel) from a length, where s u belongs, and the numerator's cos theta_t has no reason.

    Z runs along the camera's axis. Along the laser's axis, the Z of the object coordinate system, it is larger by
    1 / cos theta_t: the thesis's 0.22 mm per pixel is this, in water (0.221).
    """
    p, e = setup.slopes(u_px, v_px)
    slope = setup.window.slope(setup.window.medium_index, p**2 + e**2)
    shift = _growth_mm(setup.window, depth_mm(setup, u_px, v_px), p, e)
    return shift * setup.pixel_size_mm / setup.focal_length_mm / (math.tan(setup.triangulation_angle_rad) - p * slope)


def pixel_of_depth(setup: Triangulation, z_mm: ArrayLike, v_px: ArrayLike = 0.0) -> np.ndarray:
    """Pixel u at which the sheet appears at depths Z, broadcast: the inverse of `depth_mm`.

    In air u = f (tan theta_t - B / Z) / s. Behind a window by Newton's method: how far a ray goes across, p M, grows
    ever less with p, so that starting from too small a p no step goes too far.
    RangeError where a depth is not finite or not beyond the window's outer face, or appears too far beside the axis.
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
        # What is left is of the order of the step's square.
        if (np.abs(step) <= 1e-10 * (1 + np.abs(p))).all():
            return p * setup.focal_length_mm / setup.pixel_size_mm
    raise RangeError(
        f"the sheet appears up to {np.abs(p).max():.3g} focal lengths beside the principal point: "
        "no camera sees that; give depths within the measuring volume"
    )


def position_along_mm(setup: Triangulation, u_px: ArrayLike, v_px: ArrayLike) -> np.ndarray:
    """Y along the stripe of what pixels see of the sheet, broadcast: in air Y = Z s v / f.

    Thesis Eq. 2.10 has f cos theta_t too much, which makes it mm^2; Z of Eq. 2.8 needs no cosine.
    """
    p, e = setup.slopes(u_px, v_px)
    return e * setup.window.reach_mm(depth_mm(setup, u_px, v_px), p**2 + e**2)


def line_length_mm(setup: Triangulation, z_mm: ArrayLike, *, side_px: float) -> np.ndarray:
    """Length of the stripe, on a plane square to the laser's axis, that an image side of ``side_px`` sees at depths Z.

    Thesis section 3.1.2 multiplies the last term of Eq. 2.11 by the number of pixels; with its cos theta_t that is 18 %
    too short (see `position_along_mm`). The principal point lies in the middle of the side.

    The thesis measured 184 and 185.27 mm "at the stand-off". Its drawings give 204 mm in air and 160 mm in water there;
    184 mm in water are seen 60 mm farther away.
    """
    _require_positive(side_px=side_px)
    return 2 * position_along_mm(setup, pixel_of_depth(setup, z_mm, side_px / 2), side_px / 2)


class MeasuringVolume(NamedTuple):
    """Depths Z between which the camera sees the sheet, from the pupil along its axis."""

    near_mm: float
    far_mm: float


def measuring_volume(setup: Triangulation, *, side_px: float) -> MeasuringVolume:
    """Limits of depth in the middle of the line, for an image side of ``side_px`` across the stripe (Eq. 2.8).

    The near limit is the window's outer face where the image reaches so far; the far limit is infinite where the
    image's edge looks along the sheet or past it.
    RangeError where the camera sees nothing of the sheet before the window.
    """
    _require_positive(side_px=side_px)
    near, far = _depth_or_inf(setup, *setup.slopes(np.array([-0.5, 0.5]) * side_px, 0.0))
    if not far > setup.window.outer_mm:
        raise RangeError(f"the sheet leaves the view at {far:.1f} mm, behind the window's face: widen the baseline")
    return MeasuringVolume(float(max(near, setup.window.outer_mm)), float(far))


def scheimpflug_angle_rad(*, triangulation_angle_rad: float, magnification: float) -> float:
    """Angle between image plane and lens axis that puts the whole sheet in focus; pi / 2 is an untilted sensor.

    Thesis Eq. 2.12, tan theta_t = k tan beta_s with k the magnification, image over object distance. It is right, but
    the printed 87.9 deg is not the built sensor's, whose k = 12.5 / 366 in air gives 87.2 deg. Two readings give 87.9:
    the 250 mm of the thesis's speckle limit (k = 12.5 / 237.5) with 90 deg - theta_t in place of theta_t, where theta_t
    itself gives 85.7; or the built sensor's k divided by 1.33, the sheet's apparent turn in water without its approach.

    Behind a flat window the sheet appears at tan theta = n tan theta_t, and k follows from the apparent distance.
    """
    _require_acute(triangulation_angle_rad)
    _require_positive(magnification=magnification)
    return math.atan(math.tan(triangulation_angle_rad) / magnification)


DEPOLARISED_CONTRAST = math.sqrt(0.5)
"""Speckle contrast of a surface that depolarises, as paint does: two independent patterns of equal mean on top of each
other (Goodman, Speckle Phenomena in Optics, section 3.4)."""


def speckle_limit_um(
    *,
    wavelength_nm: float,
    focal_length_mm: float,
    f_number: float,
    distance_mm: float,
    contrast: float = DEPOLARISED_CONTRAST,
) -> float:
    """Standard uncertainty of a laser spot's position across the camera's axis, on the object, for speckle contrast C.

    Dorsch, Haeusler and Herrmann 1994, Applied Optics 33:1306: C lambda / (2 pi sin u), where the object sees the pupil
    of diameter f / N under the half-angle u. The uncertainty along the laser's axis is larger by 1 / sin theta_t: the
    thesis's 16 um at 250 mm are across, for a contrast of 1, and 28 um in depth. Behind a window take the apparent
    distance.
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
    """Thickness of a round window, t = A / 2 sqrt(K_w f_s dP / S_f): Harris 1999, thesis Eq. 3.2.

    The thesis prints 5.53 mm for 1 MPa without A, K_w and S_f. With f_s = 4 and fused silica (60 MPa), the only glass
    of its Figure 34, that is A = 49.5 mm clamped or 40.4 mm unclamped. The bore of 63 mm would need 7.0 mm clamped.
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
    """Line that sees a pipe's whole circumference in some passes: the inscribed polygon's side (thesis Figure 27)."""
    _require_positive(pipe_diameter_mm=pipe_diameter_mm)
    if passes < 2:
        raise RangeError(f"{passes} passes; no line sees a pipe's whole circumference in fewer than 2")
    return pipe_diameter_mm * math.sin(math.pi / passes)


def _depth_or_inf(setup: Triangulation, p: np.ndarray, e: np.ndarray) -> np.ndarray:
    """Depth of the sheet on rays of slopes p, e in air; infinite on rays that run along the sheet or away from it."""
    window, squared = setup.window, p**2 + e**2
    slope = window.slope(window.medium_index, squared)
    # The ray's way in the medium, continued back to the pupil, starts beside it.
    start = setup.baseline_mm + p * (window.reach_mm(window.outer_mm, squared) - window.outer_mm * slope)
    closing = math.tan(setup.triangulation_angle_rad) - p * slope
    return np.where(closing > 0, start / np.where(closing > 0, closing, 1.0), math.inf)


def _growth_mm(window: FlatWindow, depth_mm: np.ndarray, p: np.ndarray, e: np.ndarray) -> np.ndarray:
    """Derivative of p M(depth, p^2 + e^2) by p."""
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
    """The sensor's triangulation behind its window, and Z along the laser's axis per depth along the camera's.

    A laser placed by its axis, or rolled, counts as the baseline and angle at which its sheet meets the plane of the
    image's middle line across the stripe and the pupil. Lens distortion and tilts are left out, pixels are square.
    DesignError where the sheet does not cross the camera's axis before the window, the stripe runs along the other side
    of the image, or no window keeps the medium out.
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
