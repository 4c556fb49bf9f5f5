"""Light of a laser stripe on a matt surface in water, and its halo by scattering, in closed form.

The sheet carries the power p per length across its rays. A surface point with the normal N, lit along d and seen along
r, has the radiance rho / pi times the irradiance |N . d| E. Integrated across the stripe, E gives p. The image of the
stripe, integrated over the pixels across it, is therefore proportional to p |N . d| / m, where m is the distance from
the sheet to the surface point of a pixel, per pixel. It does not depend on the thickness of the sheet or on blur.

For the halo, light is scattered on the way to the surface and on the way to the camera. Let a surface point be at the
distance x from the sheet. Along the path D before the surface, the sheet scatters the fraction b dl per length; from
the element at l and y, the point receives p(a) cos(a) / (x^2 + y^2 + l^2), with the phase function p at the angle a =
atan(sqrt(x^2 + y^2) / l). The cosine is that of incidence, relative to that of the unscattered light; on inclined
surfaces it is the mean of both sides of the stripe. The sum over y and l is the line spread q(x) of single scattering
per b. The same function describes the path to the camera, with the distance from the camera ray instead of the sheet
and the cosine of emission.

Small angles add up when light is scattered several times. The Fourier transform of the whole line spread is then that
of the unscattered stripe times exp(b Q), with the transform Q of q (Wells 1969, JOSA 59:686; Mobley, Light and Water,
Sec. 5.2). Light that is scattered once by a large angle, from the sheet straight into the camera, is neglected: it is a
thousandth of the halo.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from scipy.interpolate import CubicSpline

from uwlts.errors import CaptureError
from uwlts.fitting.local_surface import surface_normals
from uwlts.model.calibration import Calibration
from uwlts.model.placement import LaserPose, apparent_depth_mm, laser_pose
from uwlts.model.sensor import CaptureHeader, Laser, Sensor, Window
from uwlts.model.stripe import CaptureStripes, stack_pixels
from uwlts.optics.camera import directions
from uwlts.optics.design import WindowGeometry, length_outside_mm, trace_to_points
from uwlts.optics.triangulation import points_on_sheet, rays_on_sheet, to_object
from uwlts.optics.window import RayStatus, trace_window

_MOVED_PX = 0.5
"""Step in px for derivatives of the points with respect to the stripe centre."""
_GRAZING = 0.1
"""Least cosine of the angles of incidence and view: at smaller ones a matt surface is not a Lambertian one."""
_FEWEST_POSITIONS = 5
"""Least number of stage positions of a scan: those of one plane for a normal."""
_STEPS = 2.5
"""Radius of the planes that give the normals, in steps of the stage: five images, also on inclined surfaces."""
_JOULE_NM = 6.62607015e-34 * 299792458.0 * 1e9
"""Energy of a photon times its wavelength in nm, J nm (SI)."""
_LEAST_MM = 1e-3
"""Least distance from the sheet, far below a pixel; light scattered by less stays in the stripe."""
_DISTANCES, _ALONG, _ACROSS = 32, 96, 72
STEP_PX = 0.5  # below the width of any stripe
_CELLS = 4096
"""Step and number of cells of line spreads: some 2,000 px, beyond which little light is scattered."""


@dataclass(frozen=True, eq=False)
class StripeLight:
    """Light at N stripe centres."""

    usable: np.ndarray
    """(N,) bool; centres with a point, a normal, and light and view at no grazing angle; all values are NaN
    elsewhere."""
    grey_per_mw: np.ndarray
    """(N,); grey values times px across the stripe, per ms of exposure and mW of laser power times reflectance, without
    attenuation by the water."""
    # (N,); path in the medium from the laser's window and to the camera's window.
    laser_path_mm: np.ndarray
    camera_path_mm: np.ndarray
    distance_mm: np.ndarray  # (N,); distance from the laser's origin
    depth_mm: np.ndarray  # (N,); depth along the camera's axis from the entrance pupil
    # (N,); distance of the surface point of the next pixel from the sheet, and from the camera ray, mm.
    sheet_per_px: np.ndarray
    ray_per_px: np.ndarray
    fan_angle: np.ndarray  # (N,); angle of the fan ray in air divided by half the fan angle


def stripe_light(
    header: CaptureHeader, calibration: Calibration, stripes: CaptureStripes, stage_mm: np.ndarray
) -> StripeLight:
    """Calculate the light at the stripe centres of a scan, from stage positions (F,) of its images.

    The sensor of ``header`` gives laser, lens and detector. Raises CaptureError if all laser images are from one
    position of the stage, which does not show the surface's normals.
    """
    if len(np.unique(stage_mm[stripes.frame])) < _FEWEST_POSITIONS:
        raise CaptureError(
            f"{header.name} has laser images with a stripe at {len(np.unique(stage_mm[stripes.frame]))} positions of "
            f"the stage; the surface's slope needs {_FEWEST_POSITIONS} or more: give a scan"
        )
    index = calibration.medium_index(header.medium)
    pixels = stack_pixels(stripes.line, stripes.centre_px, stripe_along=calibration.stripe_along)
    found = points_on_sheet(calibration, pixels, medium_index=index)
    good = found.status == RayStatus.OK
    normal = _estimate_normals(header, calibration, found.points_mm, stage_mm[stripes.frame], good)
    return light_at(header.sensor, calibration, pixels, normal, medium_index=index)


def light_at(
    sensor: Sensor, calibration: Calibration, pixels: np.ndarray, normal: np.ndarray, *, medium_index: float
) -> StripeLight:
    """Calculate the light at stripe centres, pixels (N, 2), on surfaces with normals (N, 3) in the camera frame."""
    count = len(pixels)
    moved = np.array([_MOVED_PX, 0.0] if calibration.stripe_along == "height" else [0.0, _MOVED_PX])
    found, rays, slopes = rays_on_sheet(
        calibration, np.concatenate([pixels, pixels + moved]), medium_index=medium_index
    )
    point, ray, slope = found.points_mm[:count], rays[:count], slopes[:count]
    along = (found.points_mm[count:] - point) / _MOVED_PX
    pose = calibrated_pose(sensor, calibration)
    direction, per_mm, path, angle = _compute_fan_light(sensor.laser, pose, point, medium_index=medium_index)
    lit, seen = np.abs(np.vecdot(normal, direction)), np.abs(np.vecdot(normal, ray))
    window = calibration.window if sensor.camera.window.mounted else None
    in_air = directions(calibration.camera, pixels)
    camera_path = np.linalg.norm(point - trace_window(in_air, window, medium_index=medium_index).origins, axis=1)
    with np.errstate(invalid="ignore", divide="ignore"):
        # A ray one pixel further meets the surface at this distance along the ray from its crossing of the sheet.
        shift = -np.vecdot(normal, along) / np.vecdot(normal, ray)
        sheet_per_px = np.abs(slope * shift)
        grey = _convert_radiance(sensor, medium_index) * in_air[:, 2] ** 4 * per_mm * lit / (math.pi * sheet_per_px)
    across = along - np.vecdot(along, ray)[:, None] * ray
    good = (found.status[:count] == RayStatus.OK) & (found.status[count:] == RayStatus.OK)
    good &= (lit > _GRAZING) & (seen > _GRAZING) & np.isfinite(grey) & (grey > 0)
    distance = np.linalg.norm(point - pose.origin_mm, axis=1)
    values = grey, path, camera_path, distance, point[:, 2], sheet_per_px, np.linalg.norm(across, axis=1), angle
    return StripeLight(good, *(np.where(good, value, np.nan) for value in values))


def calibrated_pose(sensor: Sensor, calibration: Calibration) -> LaserPose:
    """Return the described pose of the laser, moved into the calibrated sheet."""
    described, normal = laser_pose(sensor), np.array(calibration.sheet.normal)
    sign = float(np.sign(normal @ described.normal))
    normal, offset = sign * normal, sign * calibration.sheet.offset_mm
    origin = described.origin_mm + (offset - normal @ described.origin_mm) * normal
    axis = described.axis - (described.axis @ normal) * normal
    axis /= np.linalg.norm(axis)
    return LaserPose(origin, axis, np.cross(axis, normal), normal)


def transmission(window: Window, *, wavelength_nm: float, medium_index: float) -> float:
    """Return the transmittance of a window at normal incidence: Fresnel's reflections and absorption; 1 without it."""
    if not window.mounted:
        return 1.0
    glass = window.index(wavelength_nm)
    faces = [1.0 - ((glass - n) / (glass + n)) ** 2 for n in (1.0, medium_index)]
    return faces[0] * faces[1] * math.exp(-window.absorption_per_mm() * window.thickness_mm)


def defocus_variance(
    sensor: Sensor, calibration: Calibration, depth_mm: np.ndarray, *, medium_index: float
) -> np.ndarray:
    """Return the variance in px² of the described lens's blur across the stripe, for depths (N,) of the surface.

    A disc of radius r has the variance r² / 4. Behind the window, depths appear divided by their index.
    """
    camera, window = sensor.camera, calibration.window
    pupil = 0.5 * camera.focal_length_mm / camera.working_f_number()
    apparent = depth_mm
    if window is not None and camera.window.mounted:
        behind = window.distance_mm, window.thickness_mm
        apparent = apparent_depth_mm(depth_mm, *behind, glass_index=window.glass_index, medium_index=medium_index)
    radius = pupil * camera.focal_length_px() * np.abs(1 / apparent - 1 / camera.focus_distance_mm)
    return radius**2 / 4


def _convert_radiance(sensor: Sensor, index: float) -> float:
    """Return the grey values per ms, and per radiance in the medium in mW / (mm2 sr), on the lens's axis.

    The image irradiance is pi / (4 N^2) L with the working f-number N; a radiance falls by the squared index on its way
    to air. Photo-electrons follow from EMVA 1288 release 4, Eq. 4.
    """
    camera, detector, wavelength = sensor.camera, sensor.detector, sensor.laser.wavelength_nm
    aperture = math.pi / (4 * camera.working_f_number() ** 2)
    area_mm2 = (1e-3 * camera.pixel_size_um) ** 2 / camera.pixel_aspect
    electrons_per_mj = 1e-3 * wavelength / _JOULE_NM * detector.quantum_efficiency
    windows = [
        transmission(each.window, wavelength_nm=wavelength, medium_index=index) for each in (camera, sensor.laser)
    ]
    per_irradiance = 1e-3 * area_mm2 * electrons_per_mj * detector.gain_dn_per_e()
    return per_irradiance * aperture / index**2 * windows[0] * windows[1]


def _compute_fan_light(
    laser: Laser, pose: LaserPose, point: np.ndarray, *, medium_index: float
) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Return the fan's light at points (N, 3), by refraction at a window normal to the axis.

    These are directions (N, 3), power per length across the rays for 1 mW (1/mm), paths in the medium, and angles in
    air divided by half the fan angle. A ray has the angles a in air and m in the medium, and ends at the distance y
    from the axis. The power per length across it is P'(a) / (dy/da cos m).
    """
    offset = point - pose.origin_mm
    y, z = offset @ pose.fan, offset @ pose.axis
    inside, glass = (0.0, 0.0), 1.0
    if (window := laser.window).mounted:
        inside, glass = (window.distance_mm, window.thickness_mm), window.index(laser.wavelength_nm)
    geometry = WindowGeometry((0.0, 0.0, 1.0), *inside, glass, medium_index)
    ray = trace_to_points(np, geometry, (y, np.zeros_like(y), z))
    tilt = 1 / np.sqrt(1 + ray.slope_outside**2)
    angle = np.copysign(np.arctan(ray.slope), y)
    direction = tilt[:, None] * (np.copysign(ray.slope_outside, y)[:, None] * pose.fan + pose.axis)
    per_mm = _compute_power_per_rad(laser, angle) / (ray.growth_mm * (1 + ray.slope**2) * tilt)
    path = length_outside_mm(np, geometry, ray)
    return direction, per_mm, path, angle / math.radians(laser.fan_angle_deg / 2)


def _compute_power_per_rad(laser: Laser, angle: np.ndarray) -> np.ndarray:
    """Return the described fraction of the power per rad at angles (N,) in air; 0 outside the fan."""
    half = math.radians(laser.fan_angle_deg / 2)
    if not (table := laser.fan_table()):
        nodes = np.linspace(-half, half, 1001)
        power = np.exp(-2 * (nodes / half) ** 2) if laser.fan_profile == "gaussian" else np.ones_like(nodes)
    else:
        degrees, power = np.array(table).T
        nodes = np.radians(degrees)
    return np.interp(angle, nodes, power / np.trapezoid(power, nodes), left=0.0, right=0.0)


def _estimate_normals(
    header: CaptureHeader, calibration: Calibration, point: np.ndarray, stage_mm: np.ndarray, good: np.ndarray
) -> np.ndarray:
    """Return the surface's normals (N, 3), camera frame, from the points of the whole scan; NaN where not good."""
    direction = np.array(calibration.stage_direction_of(header.stage_direction))
    points = to_object(calibration, point[good], stage_mm=stage_mm[good], stage_direction=direction)
    normals = np.full_like(point, np.nan)
    radius = _STEPS * float(np.median(np.diff(np.unique(stage_mm[good]))))
    found = surface_normals(points, radius_mm=radius, towards=np.array([0.0, 0.0, -1.0]))
    normals[good] = found @ calibration.object_transform()[:3, :3].T
    return normals


def line_spread(per_sr: Callable[[np.ndarray], np.ndarray], distance_mm: np.ndarray, path_mm: float) -> np.ndarray:
    """Return the line spread (N,) of single scattering, per mm and per scattering coefficient in 1/mm: no unit.

    ``per_sr`` is the phase function, 1/sr at angles in rad. Distances (N,) from the sheet are positive; ``path_mm`` is
    the path in the water before the surface.
    """
    # Logarithmic nodes: the integrand varies over the scale of the distance.
    x = distance_mm[:, None, None]
    along = np.geomspace(1e-2 * _LEAST_MM, path_mm, _ALONG)[:, None]
    across = np.geomspace(1e-2 * _LEAST_MM, path_mm, _ACROSS)
    aside = np.sqrt(x**2 + across**2)
    value = per_sr(np.clip(np.arctan2(aside, along), 1e-7, np.pi - 1e-7)) * along / np.hypot(aside, along) ** 3
    over_y = np.trapezoid(value * across, np.log(across), axis=2)
    return 2 * np.asarray(np.trapezoid(over_y * along[:, 0], np.log(along[:, 0])))


class HaloKernel:
    """Halo of single scattering per scattering coefficient in 1/mm, in cells of `STEP_PX` across the stripe.

    Parameters
    ----------
    per_sr
        Phase function: 1/sr at angles in rad.
    paths : sequence of (path_mm, mm_per_px)
        Paths of the light, and the distance from sheet or ray of the next pixel.
    """

    def __init__(self, per_sr: Callable[[np.ndarray], np.ndarray], paths: tuple[tuple[float, float], ...]):
        edges_px = STEP_PX * (np.arange(_CELLS // 2) + 0.5)
        half = np.zeros(_CELLS // 2 + 1)
        for path_mm, mm_per_px in paths:
            distance = np.geomspace(_LEAST_MM, edges_px[-1] * mm_per_px, _DISTANCES)
            spread = line_spread(per_sr, distance, path_mm)
            # Of the spread by the logarithm of the distance; light below the least distance stays in the stripe.
            integral = CubicSpline(np.log(distance), spread * distance).antiderivative()
            held = integral(np.log(edges_px * mm_per_px)) + spread[0] * distance[0]
            half[:-1] += np.concatenate([[2 * held[0]], np.diff(held)])
        self._transform = np.fft.rfft(np.concatenate([half, half[-2:0:-1]])).real
        place = np.fft.fftfreq(_CELLS, 1 / (_CELLS * STEP_PX))
        self._order = np.argsort(place)
        self.place_px = place[self._order]

    def profile(self, scattering_per_mm: float, *, sigma_px: float) -> np.ndarray:
        """Return the image of the stripe per px at `place_px`, for unscattered light with the integral 1.

        ``sigma_px`` is the standard deviation of the unscattered stripe.
        """
        turn = 2 * np.pi * np.fft.rfftfreq(_CELLS, STEP_PX)
        whole = np.exp(scattering_per_mm * self._transform - 0.5 * (turn * sigma_px) ** 2)
        return np.fft.irfft(whole, _CELLS)[self._order] / STEP_PX
