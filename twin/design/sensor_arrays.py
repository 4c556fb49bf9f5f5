"""Parameters of designs for the formulas: arrays with one value per design, from sensor descriptions."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cache
from operator import attrgetter
from types import ModuleType
from typing import Literal

import numpy as np
from numpy.polynomial import Chebyshev

from twin.sensor.speckle import coherence, pixel_contrast
from uwlts.errors import DescriptionError
from uwlts.model.media import FUSED_SILICA_MPA
from uwlts.model.placement import laser_pose
from uwlts.model.sensor import Medium, Sensor
from uwlts.optics.design import (
    Array,
    LaserFan,
    Lens,
    SheetGeometry,
    Vector,
    WindowGeometry,
    add_vectors,
    dot,
    scale_vector,
    select,
    standoff_mm,
    trace_to_points,
)

Follow = Literal["focus", "waist", "volume"]

_DIFFUSE_ROUGHNESS_UM = 5.0  # rms height of a diffuse surface, for the reduction of speckle contrast by the line width
_GRAINS_PX = (0.02, 64.0)
"""Range of tabulated speckle grain sizes for averaging over pixels; other sizes are clipped to it."""

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
"""Numbers of the description that each determine one parameter only, with the factor between them.

The description's rules for these numbers limit single numbers or the difference of two. If two values keep a rule,
every value between them keeps it, too."""

_OF_BASELINE = ("laser.baseline_mm", "laser.triangulation_angle_deg", "laser.roll_deg")
"""Numbers that do not apply to a laser that is placed by its axis."""


@dataclass(frozen=True)
class SensorArrays:
    """Parameters of designs: one array per quantity, all of the same shape or of size 1; units are in the names.

    ``placed`` is the pose (origin, axis, fan, normal) of lasers that are placed by their axis, NaN for others.
    ``distortion`` is k1 k2 p1 p2 k3 k4 k5 k6. ``along_width`` is 1 if the stripe runs along the image's width, else 0.
    ``fan_nodes_rad`` and ``fan_powers`` contain tabulated profiles (relative power per angle).
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
    window_strength_mpa: Array
    laser_window_strength_mpa: Array
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
    scattering_per_mm: Array
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

    def select(self, places: np.ndarray) -> SensorArrays:
        """Select sensors by indices (M,) from arrays (N, 1, 1); return arrays (M, 1, 1)."""

        def taken(values: Array) -> Array:
            return tuple(map(taken, values)) if isinstance(values, tuple) else values[places]

        return SensorArrays(**{name: taken(values) for name, values in vars(self).items()})

    def each(self, values: Array) -> np.ndarray:
        """Return one number (N,) for each design."""
        return np.broadcast_to(np.asarray(values, dtype=float).reshape(-1), (self.baseline_mm.size,)).copy()

    def pose(self, xp: ModuleType) -> LaserFan:
        """Return the laser's fan in the camera frame, placed as by `uwlts.model.placement.laser_pose`."""
        towards = (1.0 - self.along_width, -self.along_width, 0.0 * self.along_width)
        sine, cosine = xp.sin(self.angle_rad), xp.cos(self.angle_rad)
        axis = (-sine * towards[0], -sine * towards[1], cosine)
        across = (cosine * towards[0], cosine * towards[1], sine)
        along = (-towards[1], towards[0], 0.0 * sine)
        turn, keep = xp.sin(self.roll_rad), xp.cos(self.roll_rad)
        fan = add_vectors(scale_vector(along, keep), scale_vector(across, -turn))
        normal = add_vectors(scale_vector(across, keep), scale_vector(along, turn))
        vectors = scale_vector(towards, self.baseline_mm), axis, fan, normal
        pairs = (zip(given, found, strict=True) for given, found in zip(self.placed, vectors, strict=True))
        return LaserFan(*(tuple(select(xp, xp.isfinite(one), one, other) for one, other in pair) for pair in pairs))

    def geometry(self, xp: ModuleType) -> SheetGeometry:
        """Return the geometry of camera and sheet."""
        fx = self.focal_mm / self.pixel_mm
        lens = Lens(fx, self.pixel_aspect * fx, *self.principal_px, *self.distortion)
        size = self.width_px, self.height_px
        return SheetGeometry(lens, self.window(xp), self.pose(xp), self.along_width, *size)

    def _compute_normal(self, xp: ModuleType) -> Vector:
        """Return the unit normal of the camera's window, as `uwlts.model.sensor.Window.normal`."""
        x, y = self.window_tilt_x_rad, self.window_tilt_y_rad
        return xp.cos(x) * xp.sin(y), -xp.sin(x), xp.cos(x) * xp.cos(y)

    def window(self, xp: ModuleType) -> WindowGeometry:
        """Return the camera's window; if it is not mounted, one of zero thickness in the pupil, with air behind it."""
        normal, mounted = self._compute_normal(xp), self.window_mounted
        distance, thickness = mounted * self.window_distance_mm * normal[2], mounted * self.window_thickness_mm
        return WindowGeometry(normal, distance, thickness, self.window_index, self.medium_index)

    def outer_mm(self, xp: ModuleType) -> Array:
        """Return the depth of the window's outer face on the camera's axis, mounted or not: origin of the volume."""
        return self.window_distance_mm + self.window_thickness_mm / self._compute_normal(xp)[2]

    def laser_window(self, axis: Vector) -> WindowGeometry:
        """Return the laser's window, assumed normal to its axis."""
        distance, thickness = self.laser_window_distance_mm, self.laser_window_thickness_mm
        return WindowGeometry(axis, distance, thickness, self.laser_window_index, self.medium_index)

    def pixel_contrast(self, xp: ModuleType) -> Array:
        """Return the speckle contrast of a pixel, averaged over its area and two incoherent polarisations."""
        return self._evaluate_grain_average(xp, _fit_pixel_series()) * self.speckle_coherence / math.sqrt(2)

    def centre_contrast(self, xp: ModuleType, sigma_px: Array) -> Array:
        """Return the effective contrast: the one with the same effect for uncorrelated neighbours across the stripe.

        Speckle is correlated between neighbouring pixels if grains are as large as pixels. A stripe of standard
        deviation s is shifted by variations at the spatial frequency f = 1 / (2 pi s). The squared contrast at this
        frequency is that summed over all neighbours, times the transfer functions OTF(f g) of the lens and sinc^2(f) of
        the pixel.
        """
        frequency = 1 / (2 * math.pi * sigma_px)
        v = xp.minimum(frequency * self.grain_px(), 0.999)
        lens = 2 / math.pi * (xp.acos(v) - v * xp.sqrt(1 - v * v))
        pixel = xp.sin(math.pi * frequency) / (math.pi * frequency)
        whole = self._evaluate_grain_average(xp, _fit_line_series()) * self.speckle_coherence / math.sqrt(2)
        return whole * xp.sqrt(lens) * pixel

    def grain_px(self) -> Array:
        """Return the size of speckle grains, lambda N (1 + m), in px along x; it is also used along y."""
        return self.wavelength_mm * self.working_f_number() / self.pixel_mm

    def _evaluate_grain_average(self, xp: ModuleType, series: Chebyshev) -> Array:
        """Return the exponential of a Chebyshev series in the logarithm of the grain size."""
        grain = xp.log(self.grain_px())
        shift, scale = map(float, series.mapparms())
        t = shift + scale * xp.minimum(xp.maximum(grain, math.log(_GRAINS_PX[0])), math.log(_GRAINS_PX[1]))
        # Clenshaw's recurrence.
        ahead, beyond = 0.0 * t, 0.0 * t
        for coefficient in series.coef[:0:-1]:
            ahead, beyond = 2 * t * ahead + (float(coefficient) - beyond), ahead
        return xp.exp(t * ahead + (float(series.coef[0]) - beyond))

    def working_f_number(self) -> Array:
        """Return N (1 + m) with the magnification m at the focus distance."""
        return self.f_number * (1 + self.focal_mm / (self.focus_mm - self.focal_mm))


def list_independent_paths(sensor: Sensor) -> list[str]:
    """Return the paths of `PARAMETER_OF` that apply to a sensor's laser."""
    by_axis = sensor.laser.origin_mm is not None
    return [path for path in PARAMETER_OF if not (by_axis and path in _OF_BASELINE)]


def extract_parameters(sensors: Sequence[Sensor], media: Sequence[Medium]) -> SensorArrays:
    """Return parameters of N sensors in their media as float64 arrays (N, 1, 1); errors as in `extract_numbers`."""
    return stack_parameters([extract_numbers(sensor, medium) for sensor, medium in zip(sensors, media, strict=True)])


def stack_parameters(rows: Sequence[SensorArrays]) -> SensorArrays:
    """Stack parameters of N sensors, given as numbers, to arrays (N, 1, 1)."""
    columns = {name: [vars(row)[name] for row in rows] for name in vars(rows[0])}
    for name in ("fan_nodes_rad", "fan_powers"):
        nodes = max(map(len, columns[name]))
        # Short tables are padded with their last node, which changes nothing.
        columns[name] = [(*table, *table[-1:] * (nodes - len(table))) for table in columns[name]]
    return SensorArrays(**{name: _make_column(values) for name, values in columns.items()})


def _make_column(values: Sequence[Array]) -> Array:
    """Return an array (N, 1, 1) of N numbers, or a tuple of arrays for N tuples of numbers."""
    if isinstance(values[0], tuple):
        return tuple(_make_column(parts) for parts in zip(*values, strict=True))
    return np.array(values, dtype=np.float64).reshape(-1, 1, 1)


def extract_numbers(sensor: Sensor, medium: Medium) -> SensorArrays:
    """Return the parameters of one sensor in a medium as numbers.

    Raises DescriptionError if a window is not mounted although the medium is not air; RangeError if the wavelength is
    outside the tables of a medium or glass; DesignError if the axis of a laser runs along the baseline.
    """
    camera, laser, detector, exposure = sensor.camera, sensor.laser, sensor.detector, sensor.exposure
    window, wavelength = camera.window, laser.wavelength_nm
    index = medium.refractive_index(wavelength)
    if not (window.mounted and laser.window.mounted) and index != 1:
        raise DescriptionError("a window is not mounted although the medium is not air: mount it, or choose air")
    by_axis = laser.origin_mm is not None
    placed: Array = ((math.nan,) * 3,) * 4
    if by_axis:
        pose = laser_pose(sensor)
        placed = tuple(tuple(v.tolist()) for v in (pose.origin_mm, pose.axis, pose.fan, pose.normal))
    table = laser.fan_table()
    half = math.radians(laser.fan_angle_deg / 2)
    lit = (-half, half) if not table else (math.radians(table[0][0]), math.radians(table[-1][0]))
    speckle = 1.0
    if (width := laser.linewidth_nm) > 0:
        # Reduction of contrast on a diffuse surface by the line width.
        speckle = coherence(_DIFFUSE_ROUGHNESS_UM, linewidth_nm=width, wavelength_nm=wavelength, index=index)
    applicable = list_independent_paths(sensor)
    numbers = {
        column: unit * attrgetter(path)(sensor) if path in applicable else math.nan
        for path, (column, unit) in PARAMETER_OF.items()
    }
    numbers |= {
        "along_width": float(camera.stripe_along == "width"),
        "width_px": camera.width_px,
        "height_px": camera.height_px,
        "pixel_mm": 1e-3 * camera.pixel_size_um,
        "pixel_aspect": camera.pixel_aspect,
        "window_mounted": float(window.mounted),
        "wavelength_mm": 1e-6 * wavelength,
        "fan_half_rad": half,
        "lit_from_rad": lit[0],
        "lit_to_rad": lit[1],
        "gaussian_fan": float(laser.fan_profile == "gaussian"),
        "tabulated_fan": float(bool(table)),
        "medium_index": index,
        "extinction_per_mm": medium.extinction_per_mm(wavelength),
        "scattering_per_mm": medium.scattering_per_mm(wavelength),
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
    }
    for name, one in (("window", window), ("laser_window", laser.window)):
        glass = one.index(wavelength) if one.mounted else 1.0
        # Transmittance of both faces at normal incidence (Fresnel).
        faces = (1 - ((glass - 1) / (glass + 1)) ** 2) * (1 - ((glass - index) / (glass + index)) ** 2)
        numbers |= {
            f"{name}_index": glass,
            f"{name}_faces_pass": faces,
            f"{name}_absorption_per_mm": one.absorption_per_mm() if one.mounted else 0.0,
            f"{name}_strength_mpa": one.strength_mpa() or FUSED_SILICA_MPA,
            f"{name}_aperture_mm": one.aperture_diameter_mm if one.mounted else math.inf,
        }
    # Power per rad, normalised to the integral 1.
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
def _fit_pixel_series() -> Chebyshev:
    """Return the log contrast after averaging over a pixel, as a series in the log grain size in px (error 0.5 %)."""
    grains = np.geomspace(*_GRAINS_PX, 60)
    return Chebyshev.fit(np.log(grains), np.log([pixel_contrast(float(grain)) for grain in grains]), 12)


@cache
def _fit_line_series() -> Chebyshev:
    """Return half the log of the squared contrast, summed over neighbours across the stripe, by log grain size.

    The correlation |2 J1(z) / z|^2 of speckle is summed over pixel lags across the stripe and averaged within a pixel
    along it. The result is (4 / pi) g^2 int OTF(f g) sinc^2(f) df. The correlation has the spectrum (4 / pi) g^2 OTF
    with OTF(v) = 2 / pi (acos v - v sqrt(1 - v^2)) up to v = 1 (Goodman, Speckle Phenomena in Optics, Ch. 4).
    """
    grains = np.geomspace(*_GRAINS_PX, 60)
    # Piecewise Gauss-Legendre quadrature over v from 0 to 1, because sinc^2 oscillates 1 / g times.
    nodes, weights = np.polynomial.legendre.leggauss(16)
    pieces = 200
    v = ((np.arange(pieces)[:, None] + 0.5 * (nodes + 1)) / pieces).ravel()
    w = np.tile(weights / (2 * pieces), pieces)
    transfer = 2 / math.pi * (np.arccos(v) - v * np.sqrt(1 - v * v))
    sums = np.array([4 / math.pi * g * 2 * (w * transfer * np.sinc(v / g) ** 2).sum() for g in grains])
    return Chebyshev.fit(np.log(grains), 0.5 * np.log(sums), 12)


def adjust_to_standoff(xp: ModuleType, parameters: SensorArrays, follow: Sequence[Follow]) -> SensorArrays:
    """Return the parameters with bench adjustments to the stand-off, see `compute_adjustments`."""
    return replace(parameters, **compute_adjustments(xp, parameters, follow))


def compute_adjustments(xp: ModuleType, parameters: SensorArrays, follow: Sequence[Follow]) -> dict[str, Array]:
    """Return the parameters, by name, that are adjusted to the stand-off as on the bench.

    "focus" focuses the lens on the apparent position of the stand-off through window and medium. "waist" focuses the
    laser on the stand-off. "volume" centres the measuring volume on the stand-off, with its depth unchanged.
    """
    pose, window = parameters.pose(xp), parameters.window(xp)
    depth = standoff_mm(pose)
    point = (0.0 * depth, 0.0 * depth, depth)
    changes: dict[str, Array] = {}
    if "focus" in follow:
        changes["focus_mm"] = trace_to_points(xp, window, point).apparent_mm
    if "waist" in follow:
        offset = tuple(p - o for p, o in zip(point, pose.origin, strict=True))
        changes["waist_distance_mm"] = xp.sqrt(dot(offset, offset))
    if "volume" in follow:
        middle = 0.5 * (parameters.near_mm + parameters.far_mm)
        moved = depth - parameters.outer_mm(xp) - middle
        changes |= {"near_mm": parameters.near_mm + moved, "far_mm": parameters.far_mm + moved}
    return changes
