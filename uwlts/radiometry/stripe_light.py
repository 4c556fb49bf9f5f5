"""Light of a laser stripe on a matt surface in water: geometry and power of every stripe centre, in closed form.

The sheet carries the power p per length across its rays. A surface point with the normal N, lit along d and seen along
r, has the radiance rho / pi times the irradiance |N . d| E. Integrated across the stripe, E gives p. The image of the
stripe, integrated over the pixels across it, is therefore proportional to p |N . d| / m, where m is the distance from
the sheet to the surface point of a pixel, per pixel. It does not depend on the thickness of the sheet or on blur.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from uwlts.errors import CaptureError
from uwlts.fitting.local_surface import surface_normals
from uwlts.model.calibration import Calibration
from uwlts.model.placement import LaserPose, apparent_depth_mm
from uwlts.model.sensor import Camera, CaptureHeader, Laser, Sensor, Window
from uwlts.model.stripe import CaptureStripes, stack_pixels
from uwlts.optics.camera import directions
from uwlts.optics.triangulation import points_on_sheet, rays_on_sheet, to_object
from uwlts.optics.window import RayStatus, trace_window
from uwlts.radiometry.followed_sensor import calibrated_pose

_MOVED_PX = 0.5
"""Step in px for derivatives of the points with respect to the stripe centre."""
_GRAZING = 0.1
"""Least cosine of the angles of incidence and view: at smaller ones a matt surface is not a Lambertian one."""
_FEWEST_POSITIONS = 5
"""Least number of stage positions of a scan: those of one plane for a normal."""
_STEPS = 2.5
"""Radius of the planes that give the normals, in steps of the stage: five images, also on inclined surfaces."""
_NEWTON_STEPS = 8  # of the ray through the window; converges quadratically
_JOULE_NM = 6.62607015e-34 * 299792458.0 * 1e9
"""Energy of a photon times its wavelength in nm, J nm (SI)."""


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

    def path_mm(self) -> np.ndarray:
        """Return the path (N,) of the light in the medium."""
        return self.laser_path_mm + self.camera_path_mm


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
    normal = _normals(header, calibration, found.points_mm, stage_mm[stripes.frame], good)
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
    fan = _fan_light(sensor.laser, calibrated_pose(sensor, calibration), point, medium_index=medium_index)
    lit, seen = np.abs(_dot(normal, fan.direction)), np.abs(_dot(normal, ray))
    window = calibration.window if sensor.camera.window.mounted else None
    in_air = directions(calibration.camera, pixels)
    camera_path = np.linalg.norm(point - trace_window(in_air, window, medium_index=medium_index).origins, axis=1)
    with np.errstate(invalid="ignore", divide="ignore"):
        # A ray one pixel further meets the surface at this distance along the ray from its crossing of the sheet.
        shift = -_dot(normal, along) / _dot(normal, ray)
        sheet_per_px = np.abs(slope * shift)
        grey = (
            _grey_per_radiance(sensor, medium_index) * in_air[:, 2] ** 4 * fan.per_mm * lit / (math.pi * sheet_per_px)
        )
    across = along - _dot(along, ray)[:, None] * ray
    good = (found.status[:count] == RayStatus.OK) & (found.status[count:] == RayStatus.OK)
    good &= (lit > _GRAZING) & (seen > _GRAZING) & np.isfinite(grey) & (grey > 0)
    values = (grey, fan.path_mm, camera_path, fan.distance_mm, point[:, 2], sheet_per_px)
    values += (np.linalg.norm(across, axis=1), fan.angle)
    return StripeLight(good, *(np.where(good, value, np.nan) for value in values))


def transmission(window: Window, *, wavelength_nm: float, medium_index: float) -> float:
    """Return the transmittance of a window at normal incidence: Fresnel's reflections and absorption; 1 without it."""
    if not window.mounted:
        return 1.0
    glass = window.index(wavelength_nm)
    faces = [1.0 - ((glass - n) / (glass + n)) ** 2 for n in (1.0, medium_index)]
    return faces[0] * faces[1] * math.exp(-window.absorption_per_mm() * window.thickness_mm)


def working_f_number(camera: Camera) -> float:
    """Return the f-number for the magnification m at the described focus: N (1 + m)."""
    magnified = camera.focal_length_mm / (camera.focus_distance_mm - camera.focal_length_mm)
    return camera.f_number * (1 + magnified)


def defocus_variance(
    sensor: Sensor, calibration: Calibration, depth_mm: np.ndarray, *, medium_index: float
) -> np.ndarray:
    """Return the variance in px² of the described lens's blur across the stripe, for depths (N,) of the surface.

    A disc of radius r has the variance r² / 4. Behind the window, depths appear divided by their index.
    """
    camera, window = sensor.camera, calibration.window
    pupil = 0.5 * camera.focal_length_mm / working_f_number(camera)
    apparent = depth_mm
    if window is not None and camera.window.mounted:
        behind = window.distance_mm, window.thickness_mm
        apparent = apparent_depth_mm(depth_mm, *behind, glass_index=window.glass_index, medium_index=medium_index)
    radius = pupil * camera.focal_length_px() * np.abs(1 / apparent - 1 / camera.focus_distance_mm)
    return radius**2 / 4


def _grey_per_radiance(sensor: Sensor, index: float) -> float:
    """Return the grey values per ms, and per radiance in the medium in mW / (mm2 sr), on the lens's axis.

    The image irradiance is pi / (4 N^2) L with the working f-number N; a radiance falls by the squared index on its way
    to air. Photo-electrons follow from EMVA 1288 release 4, Eq. 4.
    """
    camera, detector, wavelength = sensor.camera, sensor.detector, sensor.laser.wavelength_nm
    aperture = math.pi / (4 * working_f_number(camera) ** 2)
    area_mm2 = (1e-3 * camera.pixel_size_um) ** 2 / camera.pixel_aspect
    electrons_per_mj = 1e-3 * wavelength / _JOULE_NM * detector.quantum_efficiency
    windows = [
        transmission(each.window, wavelength_nm=wavelength, medium_index=index) for each in (camera, sensor.laser)
    ]
    per_irradiance = 1e-3 * area_mm2 * electrons_per_mj * detector.gain_dn_per_e()
    return per_irradiance * aperture / index**2 * windows[0] * windows[1]


@dataclass(frozen=True, eq=False)
class _FanLight:
    """Rays of the fan at points (N,): direction, power per length across the rays for 1 mW (1/mm), paths, angle."""

    direction: np.ndarray
    per_mm: np.ndarray
    path_mm: np.ndarray
    distance_mm: np.ndarray
    angle: np.ndarray


def _fan_light(laser: Laser, pose: LaserPose, point: np.ndarray, *, medium_index: float) -> _FanLight:
    """Return the fan's light at points (N, 3), by refraction at a window normal to the axis.

    The ray at the angle a in air has the angles g in glass and m in the medium. Behind the lengths d, t and w along the
    axis, it is at y = d tan a + t tan g + w tan m. The power per length across a ray is P'(a) / (dy/da cos m).
    """
    away = point - pose.origin_mm
    y, z = away @ pose.fan, away @ pose.axis
    window = laser.window
    parts = [(0.0, 1.0), (0.0, 1.0), (z, medium_index)]
    if window.mounted:
        glass = window.index(laser.wavelength_nm)
        inside = window.distance_mm, window.thickness_mm
        parts = [(inside[0], 1.0), (inside[1], glass), (z - sum(inside), medium_index)]
    sine, by_sine = y / np.hypot(y, z), np.ones_like(y)
    for _ in range(_NEWTON_STEPS):
        reach, by_sine = np.zeros_like(y), np.zeros_like(y)
        for length, n in parts:
            cosine = np.sqrt(1 - (sine / n) ** 2)
            reach += length * sine / (n * cosine)
            by_sine += length / (n * cosine**3)
        sine = np.clip(sine - (reach - y) / by_sine, -0.99, 0.99)
    tilt = np.sqrt(1 - (sine / medium_index) ** 2)
    angle = np.arcsin(sine)
    direction = (sine / medium_index)[:, None] * pose.fan + tilt[:, None] * pose.axis
    per_mm = _power_per_rad(laser, angle) / (by_sine * np.cos(angle) * tilt)
    half = math.radians(laser.fan_angle_deg / 2)
    return _FanLight(direction, per_mm, parts[2][0] / tilt, np.linalg.norm(away, axis=1), angle / half)


def _power_per_rad(laser: Laser, angle: np.ndarray) -> np.ndarray:
    """Return the described fraction of the power per rad at angles (N,) in air; 0 outside the fan."""
    half = math.radians(laser.fan_angle_deg / 2)
    if not (table := laser.fan_table()):
        nodes = np.linspace(-half, half, 1001)
        power = np.exp(-2 * (nodes / half) ** 2) if laser.fan_profile == "gaussian" else np.ones_like(nodes)
    else:
        degrees, power = np.array(table).T
        nodes = np.radians(degrees)
    return np.interp(angle, nodes, power / np.trapezoid(power, nodes), left=0.0, right=0.0)


def _normals(
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


def _dot(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    return np.einsum("ij,ij->i", a, b)
