"""Parameters of designs for the formulas: plain arrays, one value per design, taken from sensor descriptions."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cache
from types import ModuleType
from typing import Literal

import numpy as np
from numpy.polynomial import Chebyshev

from twin.design.geometry import (
    Array,
    LaserFan,
    Lens,
    Vector,
    WindowGeometry,
    dot,
    path_to,
    pose_at,
    standoff_mm,
    where,
)
from twin.sensor.speckle import coherence, pixel_contrast
from uwlts.errors import DescriptionError
from uwlts.model.placement import laser_pose
from uwlts.model.sensor import Medium, Sensor

Follow = Literal["focus", "waist", "volume"]

_DIFFUSE_ROUGHNESS_UM = 5.0
"""Rms height of a diffuse surface, for the loss of speckle contrast in light of some line width."""
_GRAINS_PX = (0.02, 64.0)
"""Speckle grains for which the averaging over pixels is known; others count as these."""

PARAMETER_OF: dict[str, tuple[str, float]] = {
    "laser.baseline_mm": ("baseline_mm", 1.0),
    "laser.triangulation_angle_deg": ("angle_rad", math.pi / 180),
    "laser.roll_deg": ("roll_rad", math.pi / 180),
    "laser.power_mw": ("power_w", 1e-3),
    "laser.waist_radius_mm": ("waist_mm", 1.0),
    "laser.waist_distance_mm": ("waist_distance_mm", 1.0),
    "laser.beam_quality_m2": ("beam_quality", 1.0),
    "laser.window.distance_mm": ("laser_window_distance_mm", 1.0),
    "laser.window.thickness_mm": ("laser_window_thickness_mm", 1.0),
    "camera.focal_length_mm": ("focal_mm", 1.0),
    "camera.f_number": ("f_number", 1.0),
    "camera.focus_distance_mm": ("focus_mm", 1.0),
    "camera.window.distance_mm": ("window_distance_mm", 1.0),
    "camera.window.thickness_mm": ("window_thickness_mm", 1.0),
    "camera.window.tilt_x_deg": ("window_tilt_x_rad", math.pi / 180),
    "camera.window.tilt_y_deg": ("window_tilt_y_rad", math.pi / 180),
    "volume.near_mm": ("near_mm", 1.0),
    "volume.far_mm": ("far_mm", 1.0),
}
"""Numbers of the description that are a parameter of their own, times a factor, and no part of another one.

The description's rules for them are bounds of each and of the difference of two, so that numbers between such as keep
them keep them, too."""

_OF_BASELINE = ("laser.baseline_mm", "laser.triangulation_angle_deg", "laser.roll_deg")
"""Numbers without a meaning for a laser that is placed by its axis."""


@dataclass(frozen=True)
class SensorArrays:
    """One array of numbers per quantity, all of the same shape or 1; units are part of the names.

    ``placed`` is the pose (origin, axis, fan, normal) of lasers that are placed by their axis, NaN for those placed by
    baseline and angle. ``distortion`` is k1 k2 p1 p2 k3 k4 k5 k6. ``along_width`` is 1 where the stripe runs along the
    image's width, else 0. ``fan_nodes_rad`` and ``fan_powers`` hold tabulated profiles (relative power per angle).
    """

    baseline_mm: Array
    angle_rad: Array
    roll_rad: Array
    placed: tuple[Vector, Vector, Vector, Vector]
    along_width: Array
    width_px: Array
    height_px: Array
    pixel_mm: Array
    pixel_aspect: Array
    focal_mm: Array
    principal_px: tuple[Array, Array]
    distortion: tuple[Array, ...]
    f_number: Array
    focus_mm: Array
    window_mounted: Array
    window_distance_mm: Array
    window_thickness_mm: Array
    window_tilt_x_rad: Array
    window_tilt_y_rad: Array
    window_index: Array
    window_faces_pass: Array
    window_absorption_per_mm: Array
    window_aperture_mm: Array
    wavelength_mm: Array
    power_w: Array
    fan_half_rad: Array
    lit_from_rad: Array
    lit_to_rad: Array
    gaussian_fan: Array
    tabulated_fan: Array
    fan_nodes_rad: tuple[Array, ...]
    fan_powers: tuple[Array, ...]
    waist_mm: Array
    waist_distance_mm: Array
    beam_quality: Array
    laser_window_distance_mm: Array
    laser_window_thickness_mm: Array
    laser_window_index: Array
    laser_window_faces_pass: Array
    laser_window_absorption_per_mm: Array
    laser_window_aperture_mm: Array
    medium_index: Array
    extinction_per_mm: Array
    quantum_efficiency: Array
    full_well_e: Array
    read_noise_e: Array
    dark_e_per_ms: Array
    offset_e: Array
    prnu: Array
    step_e: Array
    exposure_ms: Array
    exposure_level: Array
    longest_ms: Array
    ambient_w_per_mm2: Array
    speckle_coherence: Array
    stage_resolution_mm: Array
    near_mm: Array
    far_mm: Array

    def at(self, places: np.ndarray) -> SensorArrays:
        """Parameters of the sensors at some places (M,) of arrays (N, 1, 1), as arrays (M, 1, 1)."""

        def taken(values: Array) -> Array:
            return tuple(map(taken, values)) if isinstance(values, tuple) else values[places]

        return SensorArrays(**{name: taken(values) for name, values in vars(self).items()})

    def pose(self, xp: ModuleType) -> LaserFan:
        """Fan of the laser in the camera frame."""
        towards = (1.0 - self.along_width, -self.along_width, 0.0 * self.along_width)
        baseline, angle, roll = self.baseline_mm, self.angle_rad, self.roll_rad
        by_angle = pose_at(xp, baseline_mm=baseline, angle_rad=angle, roll_rad=roll, towards=towards)
        vectors = by_angle.origin, by_angle.axis, by_angle.fan, by_angle.normal
        pairs = (zip(given, found, strict=True) for given, found in zip(self.placed, vectors, strict=True))
        return LaserFan(*(tuple(where(xp, xp.isfinite(own), own, other) for own, other in pair) for pair in pairs))

    def along(self, pixels: tuple[Array, Array]) -> Array:
        """The one of a pair for x and y that belongs to the pixel along the stripe."""
        return self.along_width * pixels[0] + (1 - self.along_width) * pixels[1]

    def across(self, pixels: tuple[Array, Array]) -> Array:
        """The one of a pair for x and y that belongs to the pixel across the stripe."""
        return self.along_width * pixels[1] + (1 - self.along_width) * pixels[0]

    def lens(self) -> Lens:
        """The camera's lens."""
        fx = self.focal_mm / self.pixel_mm
        return Lens(fx, self.pixel_aspect * fx, *self.principal_px, *self.distortion)

    def _normal(self, xp: ModuleType) -> Vector:
        """Unit normal of the camera's window, as `uwlts.model.sensor.Window.normal`."""
        x, y = self.window_tilt_x_rad, self.window_tilt_y_rad
        return xp.cos(x) * xp.sin(y), -xp.sin(x), xp.cos(x) * xp.cos(y)

    def window(self, xp: ModuleType) -> WindowGeometry:
        """The camera's window; unmounted one of no thickness in the pupil, with nothing but air behind it."""
        normal, mounted = self._normal(xp), self.window_mounted
        distance, thickness = mounted * self.window_distance_mm * normal[2], mounted * self.window_thickness_mm
        return WindowGeometry(normal, distance, thickness, self.window_index, self.medium_index)

    def outer_mm(self, xp: ModuleType) -> Array:
        """Depth on the camera's axis from which the volume counts: of the window's outer face, mounted or not."""
        return self.window_distance_mm + self.window_thickness_mm / self._normal(xp)[2]

    def laser_window(self, axis: Vector) -> WindowGeometry:
        """The laser's window, taken as square to its axis."""
        distance, thickness = self.laser_window_distance_mm, self.laser_window_thickness_mm
        return WindowGeometry(axis, distance, thickness, self.laser_window_index, self.medium_index)

    def window_passes(self, xp: ModuleType) -> Array:
        """Share of light that passes the camera's window (Beer and Lambert)."""
        return self.window_faces_pass * xp.exp(-self.window_absorption_per_mm * self.window_thickness_mm)

    def laser_window_passes(self, xp: ModuleType) -> Array:
        """Share of light that passes the laser's window."""
        return self.laser_window_faces_pass * xp.exp(
            -self.laser_window_absorption_per_mm * self.laser_window_thickness_mm
        )

    def pixel_contrast(self, xp: ModuleType) -> Array:
        """Speckle contrast of a pixel, averaged over its area and two polarisations that do not interfere."""
        return self._averaged(xp, _pixel_series()) * self.speckle_coherence / math.sqrt(2)

    def centre_contrast(self, xp: ModuleType, sigma_px: Array) -> Array:
        """Contrast with the same effect if neighbours across a stripe erred independently.

        Speckle is alike in neighbours where grains are as large as pixels. A stripe of standard deviation s is shifted
        by what changes across it at the frequency f = 1 / (2 pi s). Of the squared contrast, summed over all
        neighbours, the lens's and the pixel's transfer functions OTF(f g) and sinc^2(f) leave that part.
        """
        frequency = 1 / (2 * math.pi * sigma_px)
        v = xp.minimum(frequency * self.grain_px(), 0.999)
        lens = 2 / math.pi * (xp.acos(v) - v * xp.sqrt(1 - v * v))
        pixel = xp.sin(math.pi * frequency) / (math.pi * frequency)
        whole = self._averaged(xp, _line_series()) * self.speckle_coherence / math.sqrt(2)
        return whole * xp.sqrt(lens) * pixel

    def grain_px(self) -> Array:
        """Size of speckle grains, lambda N (1 + m), in px; along y, too, where pixels are not square."""
        return self.wavelength_mm * self.working_f_number() / self.pixel_mm

    def _averaged(self, xp: ModuleType, series: Chebyshev) -> Array:
        """The exponential of a series in the logarithm of the grain."""
        grain = xp.log(self.grain_px())
        shift, scale = map(float, series.mapparms())
        t = shift + scale * xp.minimum(xp.maximum(grain, math.log(_GRAINS_PX[0])), math.log(_GRAINS_PX[1]))
        # Clenshaw's recurrence.
        ahead, beyond = 0.0 * t, 0.0 * t
        for coefficient in series.coef[:0:-1]:
            ahead, beyond = 2 * t * ahead + (float(coefficient) - beyond), ahead
        return xp.exp(t * ahead + (float(series.coef[0]) - beyond))

    def working_f_number(self) -> Array:
        """N (1 + m) with the magnification m at the focus distance."""
        return self.f_number * (1 + self.focal_mm / (self.focus_mm - self.focal_mm))


def parameters_alone(sensor: Sensor) -> list[str]:
    """Paths of a sensor's numbers that are parameters of their own: `PARAMETER_OF`, as far as its laser has them."""
    by_axis = sensor.laser.origin_mm is not None
    return [path for path in PARAMETER_OF if not (by_axis and path in _OF_BASELINE)]


def parameters_of(sensors: Sequence[Sensor], media: Sequence[Medium]) -> SensorArrays:
    """Parameters of N sensors, each in its medium, as float64 arrays (N, 1, 1); errors as `numbers_of`."""
    return stacked([numbers_of(sensor, medium) for sensor, medium in zip(sensors, media, strict=True)])


def stacked(rows: Sequence[SensorArrays]) -> SensorArrays:
    """Parameters of N sensors, each of plain numbers, as arrays (N, 1, 1)."""
    columns = {name: [vars(row)[name] for row in rows] for name in vars(rows[0])}
    for name in ("fan_nodes_rad", "fan_powers"):
        nodes = max(map(len, columns[name]))
        # Short tables are filled up with their last node, which adds nothing.
        columns[name] = [(*table, *table[-1:] * (nodes - len(table))) for table in columns[name]]
    return SensorArrays(**{name: _columns(values) for name, values in columns.items()})


def _columns(values: Sequence[Array]) -> Array:
    """Arrays (N, 1, 1) of N numbers, or of N tuples of numbers in a tuple of the same kind."""
    if isinstance(values[0], tuple):
        return tuple(_columns(parts) for parts in zip(*values, strict=True))
    return np.array(values, dtype=np.float64).reshape(-1, 1, 1)


def numbers_of(sensor: Sensor, medium: Medium) -> SensorArrays:
    """Parameters of one sensor in a medium, as plain numbers.

    DescriptionError where a window is left out although the medium is not air, RangeError for a wavelength outside the
    tables of a medium or glass, DesignError for a laser placed by its axis that has no sheet.
    """
    camera, laser, detector, exposure = sensor.camera, sensor.laser, sensor.detector, sensor.exposure
    window, wavelength = camera.window, laser.wavelength_nm
    index = medium.refractive_index(wavelength)
    if not (window.mounted and laser.window.mounted) and index != 1:
        raise DescriptionError("a window is left out although the medium is not air: mount it, or choose air")
    by_axis = laser.origin_mm is not None
    placed: Array = ((math.nan,) * 3,) * 4
    if by_axis:
        pose = laser_pose(sensor)
        placed = tuple(tuple(v.tolist()) for v in (pose.origin_mm, pose.axis, pose.fan, pose.normal))
    table = () if isinstance(laser.fan_profile, str) else laser.fan_profile
    half = math.radians(laser.fan_angle_deg / 2)
    lit = (-half, half) if not table else (math.radians(table[0][0]), math.radians(table[-1][0]))
    angle, speckle = laser.triangulation_angle_deg, 1.0
    if (width := laser.linewidth_nm) > 0:
        # The contrast that the line width leaves on a diffuse surface.
        speckle = coherence(_DIFFUSE_ROUGHNESS_UM, linewidth_nm=width, wavelength_nm=wavelength, index=index)
    numbers = {
        "baseline_mm": math.nan if by_axis or laser.baseline_mm is None else laser.baseline_mm,
        "angle_rad": math.nan if by_axis or angle is None else math.radians(angle),
        "roll_rad": math.radians(laser.roll_deg),
        "along_width": float(camera.stripe_along == "width"),
        "width_px": camera.width_px,
        "height_px": camera.height_px,
        "pixel_mm": 1e-3 * camera.pixel_size_um,
        "pixel_aspect": camera.pixel_aspect,
        "focal_mm": camera.focal_length_mm,
        "f_number": camera.f_number,
        "focus_mm": camera.focus_distance_mm,
        "window_mounted": float(window.mounted),
        "window_tilt_x_rad": math.radians(window.tilt_x_deg),
        "window_tilt_y_rad": math.radians(window.tilt_y_deg),
        "wavelength_mm": 1e-6 * wavelength,
        "power_w": 1e-3 * laser.power_mw,
        "fan_half_rad": half,
        "lit_from_rad": lit[0],
        "lit_to_rad": lit[1],
        "gaussian_fan": float(laser.fan_profile == "gaussian"),
        "tabulated_fan": float(bool(table)),
        "waist_mm": laser.waist_radius_mm,
        "waist_distance_mm": laser.waist_distance_mm,
        "beam_quality": laser.beam_quality_m2,
        "medium_index": index,
        "extinction_per_mm": medium.extinction_per_mm(wavelength),
        "quantum_efficiency": detector.quantum_efficiency,
        "full_well_e": detector.full_well_e,
        "read_noise_e": detector.read_noise_e,
        "dark_e_per_ms": 1e-3 * detector.dark_current_e_per_s * detector.dark_current_growth(),
        "offset_e": math.hypot(detector.dsnu_e, detector.dsnu_row_e, detector.dsnu_column_e),
        "prnu": detector.prnu,
        "step_e": 1 / detector.gain_dn_per_e(),
        "exposure_ms": math.nan if isinstance(exposure.laser_ms, str) else exposure.laser_ms,
        "exposure_level": exposure.auto_level,
        "longest_ms": exposure.longest_ms,
        "ambient_w_per_mm2": 1e-6 * sensor.lamp.ambient_w_per_m2,
        "speckle_coherence": speckle,
        "stage_resolution_mm": sensor.stage.resolution_mm,
        "near_mm": sensor.volume.near_mm,
        "far_mm": sensor.volume.far_mm,
    }
    for name, one in (("window", window), ("laser_window", laser.window)):
        glass = one.index(wavelength) if one.mounted else 1.0
        # The light that passes both faces, square to them (Fresnel).
        faces = (1 - ((glass - 1) / (glass + 1)) ** 2) * (1 - ((glass - index) / (glass + index)) ** 2)
        numbers |= {
            f"{name}_distance_mm": one.distance_mm,
            f"{name}_thickness_mm": one.thickness_mm,
            f"{name}_index": glass,
            f"{name}_faces_pass": faces,
            f"{name}_absorption_per_mm": one.absorption_per_mm() if one.mounted else 0.0,
            f"{name}_aperture_mm": one.aperture_diameter_mm if one.mounted else math.inf,
        }
    # Powers per rad that integrate to 1.
    angles, powers = (
        np.radians([a for a, _ in table or ((0.0, 0.0),)]),
        np.array([p for _, p in table or ((0.0, 0.0),)]),
    )
    powers = powers / np.trapezoid(powers, angles) if table else powers
    return SensorArrays(
        **{name: float(value) for name, value in numbers.items()},
        placed=placed,
        principal_px=camera.principal_point(),
        distortion=tuple(camera.distortion.model_dump().values()),
        fan_nodes_rad=tuple(angles.tolist()),
        fan_powers=tuple(powers.tolist()),
    )


@cache
def _pixel_series() -> Chebyshev:
    """Logarithm of the contrast that averaging over a pixel leaves, by that of the grain in px; good to 0.5 %."""
    grains = np.geomspace(*_GRAINS_PX, 60)
    return Chebyshev.fit(np.log(grains), np.log([pixel_contrast(float(grain)) for grain in grains]), 12)


@cache
def _line_series() -> Chebyshev:
    """Half the logarithm of the squared contrast summed over the neighbours across the stripe, by that of the grain.

    The sum over the lags of the correlation of pixels' averages is the correlation's integral over all lags across, and
    its mean over pairs of points of a pixel along: (4 / pi) g^2 int OTF(f g) sinc^2(f) df, since the correlation
    |2 J1(z) / z|^2 has the spectrum (4 / pi) g^2 OTF, with OTF(v) = 2 / pi (acos v - v sqrt(1 - v^2)) up to v = 1
    (Goodman, Speckle Phenomena in Optics, Ch. 4).
    """
    grains = np.geomspace(*_GRAINS_PX, 60)
    # Gauss-Legendre over 0 to 1 in v, in pieces, for sinc^2 swings 1 / g times.
    nodes, weights = np.polynomial.legendre.leggauss(16)
    pieces = 200
    v = ((np.arange(pieces)[:, None] + 0.5 * (nodes + 1)) / pieces).ravel()
    w = np.tile(weights / (2 * pieces), pieces)
    transfer = 2 / math.pi * (np.arccos(v) - v * np.sqrt(1 - v * v))
    sums = np.array([4 / math.pi * g * 2 * (w * transfer * np.sinc(v / g) ** 2).sum() for g in grains])
    return Chebyshev.fit(np.log(grains), 0.5 * np.log(sums), 12)


def followed(xp: ModuleType, parameters: SensorArrays, follow: Sequence[Follow]) -> SensorArrays:
    """Parameters with what is adjusted on the bench set to the stand-off, see `following`."""
    return replace(parameters, **following(xp, parameters, follow))


def following(xp: ModuleType, parameters: SensorArrays, follow: Sequence[Follow]) -> dict[str, Array]:
    """Parameters, by their names, that are adjusted to the stand-off on the bench.

    "focus" focuses the lens where the stand-off appears to be through window and medium; "waist" focuses the laser on
    it; "volume" moves the measuring volume, in its own depth, so that it lies about the stand-off as it did.
    """
    pose, window = parameters.pose(xp), parameters.window(xp)
    depth = standoff_mm(pose)
    point = (0.0 * depth, 0.0 * depth, depth)
    changes: dict[str, Array] = {}
    if "focus" in follow:
        changes["focus_mm"] = path_to(xp, window, point).apparent_mm
    if "waist" in follow:
        away = tuple(p - o for p, o in zip(point, pose.origin, strict=True))
        changes["waist_distance_mm"] = xp.sqrt(dot(away, away))
    if "volume" in follow:
        middle = 0.5 * (parameters.near_mm + parameters.far_mm)
        moved = depth - parameters.outer_mm(xp) - middle
        changes |= {"near_mm": parameters.near_mm + moved, "far_mm": parameters.far_mm + moved}
    return changes
