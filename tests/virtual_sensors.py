"""Sensors and scenes for the tests of the twin, and the same sensors as the oracles describe them."""

import math
from typing import Any

import cv2
import numpy as np
from scipy.spatial.transform import Rotation

from tests.oracles import fermat
from tests.oracles.fan import Fan
from tests.oracles.optics import fresnel_transmittance
from twin.scene.description import Scene
from uwlts.model.library import merge_tables
from uwlts.model.sensor import Medium, Sensor, Window

_TOWARDS_LASER = {"width": np.array([0.0, -1.0, 0.0]), "height": np.array([1.0, 0.0, 0.0])}


def altered(sensor: Sensor, changes: dict[str, Any]) -> Sensor:
    """Return the sensor with nested ``changes`` of its description."""
    return Sensor.model_validate(merge_tables(sensor.model_dump(), changes))


def with_fine_target(sensor: Sensor) -> Sensor:
    """Return the sensor with a matt target whose scale is known to 2e-5, as for a chromium mask on glass."""
    return altered(sensor, {"uncertainty": {"target_stretch": 2e-5, "target_stripe_px": 0.02}})


def cropped(sensor: Sensor, width_px: int, height_px: int) -> Sensor:
    """The sensor reading out only the middle of its image."""
    return altered(sensor, {"camera": {"width_px": width_px, "height_px": height_px}})


def scene_of(*objects: dict[str, Any], **rest: Any) -> Scene:
    """A scene of objects in the water."""
    return Scene.model_validate({"title": "test", "objects": list(objects)} | rest)


def plate(
    z: float = 0.0, *, reflectance: float = 0.8, side: float = 400.0, x: float = 0.0, y: float = 0.0
) -> dict[str, Any]:
    """A plate square to the laser's axis."""
    size = {"width_mm": side, "height_mm": side, "reflectance": reflectance}
    return {"kind": "plate", "position_mm": (x, y, z)} | size


def block(
    size: tuple[float, float, float], position: tuple[float, float, float], *, reflectance: float = 0.0
) -> dict[str, Any]:
    """A block, black by default."""
    return {"kind": "block", "size_mm": size, "position_mm": position, "reflectance": reflectance}


def sensor_at(z: float = 0.0, *, x: float = 0.0) -> np.ndarray:
    """Pose (4, 4) of the OCS that brings the scene's point (x, 0, z) to the stand-off."""
    pose = np.eye(4)
    pose[:3, 3] = x, 0.0, z
    return pose


def camera_axes(sensor: Sensor) -> tuple[np.ndarray, np.ndarray]:
    """Return columns X, Y, Z (3, 3) of the OCS in the camera frame and its origin (3,), by baseline and angle.

    An independent implementation of the description: the laser is beside the camera, above it or to its right. Its axis
    leans towards the camera's axis by the triangulation angle, and the roll turns the sheet about the laser's axis.
    """
    laser = sensor.laser
    towards = _TOWARDS_LASER[sensor.camera.stripe_along]
    lean = Rotation.from_rotvec(math.radians(laser.triangulation_angle_deg) * np.cross(towards, (0.0, 0.0, 1.0)))
    axis = lean.apply((0.0, 0.0, 1.0))
    normal = Rotation.from_rotvec(math.radians(laser.roll_deg) * axis).apply(lean.apply(towards))
    standoff = laser.baseline_mm / math.tan(math.radians(laser.triangulation_angle_deg))
    return np.stack([normal, np.cross(axis, normal), axis], axis=1), np.array([0.0, 0.0, standoff])


def laser_origin(sensor: Sensor) -> np.ndarray:
    """Origin (3,) of the fan in the OCS."""
    axes, standoff = camera_axes(sensor)
    towards = _TOWARDS_LASER[sensor.camera.stripe_along]
    return axes.T @ (sensor.laser.baseline_mm * towards - standoff)


def oracle_window(
    window: Window, medium: Medium, *, wavelength_nm: float = 635.0
) -> tuple[list[fermat.Face], list[float]]:
    """Return faces and indices of a window before a module that looks along +z; no faces if it is not mounted."""
    if not window.mounted:
        return [], [1.0]
    turned = Rotation.from_euler("xy", [window.tilt_x_deg, window.tilt_y_deg], degrees=True)
    faces = fermat.plate(
        distance=window.distance_mm, thickness=window.thickness_mm, normal=turned.apply((0.0, 0.0, 1.0))
    )
    return faces, [1.0, window.index(wavelength_nm), medium.refractive_index(wavelength_nm)]


def oracle_fan(sensor: Sensor, medium: Medium) -> Fan:
    """Return the sensor's fan in closed form; its origin is at `laser_origin`."""
    laser, window = sensor.laser, sensor.laser.window
    index = medium.refractive_index(laser.wavelength_nm)
    return Fan(
        power_w=1e-3 * laser.power_mw,
        full_angle=math.radians(laser.fan_angle_deg),
        window_distance=window.distance_mm,
        window_thickness=window.thickness_mm,
        glass_index=window.index(laser.wavelength_nm),
        medium_index=index,
        glass_absorption=window.absorption_per_mm(),
        extinction=medium.absorption_per_mm(laser.wavelength_nm) + medium.scattering_per_mm(laser.wavelength_nm),
        waist_radius=laser.waist_radius_mm,
        waist_distance=laser.waist_distance_mm,
        # The divergence of a beam is M2 times the diffraction limit of its waist (ISO 11146-1).
        divergence=laser.beam_quality_m2 * 1e-6 * laser.wavelength_nm / (math.pi * laser.waist_radius_mm * index),
    )


def oracle_paths(sensor: Sensor, medium: Medium, points: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Find the paths of light from points (N, 3) of the OCS to the camera by Fermat's principle.

    Returns the unit directions (N, 3) at the pupil in the camera frame. For the part of the path in the medium, returns
    the points (N, 3) on the window's outer face, in the OCS, and the lengths (N,).
    """
    axes, standoff = camera_axes(sensor)
    faces, indices = oracle_window(sensor.camera.window, medium)
    ends = points @ axes.T + standoff
    crossings = fermat.least_time_crossings(np.zeros(3), ends, faces, indices)
    directions = crossings[:, 0] / np.linalg.norm(crossings[:, 0], axis=1, keepdims=True)
    return directions, (crossings[:, -1] - standoff) @ axes, np.linalg.norm(ends - crossings[:, -1], axis=1)


def clear(absorption_per_m: float = 0.0, scattering_per_m: float = 0.0, **rest: object) -> Medium:
    """A medium of water's index with given coefficients."""
    coefficients = {"absorption_per_m": absorption_per_m, "scattering_per_m": scattering_per_m}
    return Medium.model_validate({"kind": "custom", "index": 1.3312} | coefficients | rest)


def extinction(medium: Medium, *, wavelength_nm: float = 635.0) -> float:
    """Absorption and scattering in 1/mm."""
    return medium.absorption_per_mm(wavelength_nm) + medium.scattering_per_mm(wavelength_nm)


def window_transmittance(
    cosine: np.ndarray, window: Window, medium_index: float, *, absorption_per_mm: float
) -> np.ndarray:
    """Return the transmittance of both faces and the glass, for the cosine of the angle in air."""
    glass = window.index(635.0)
    in_glass = np.sqrt(1 - (1 - cosine**2) / glass**2)
    faces = fresnel_transmittance(cosine, n1=1.0, n2=glass) * fresnel_transmittance(in_glass, n1=glass, n2=medium_index)
    return faces * np.exp(-absorption_per_mm * window.thickness_mm / in_glass)


def lens_factor(sensor: Sensor, medium: Medium, rays: np.ndarray, *, wavelength_nm: float = 635.0) -> np.ndarray:
    """Return irradiance on the image sensor per radiance before the window, for unit directions (N, 3) at the pupil.

    Radiance divided by the squared index is constant along a ray, except for the window's losses. A thin lens of focal
    length f and diameter f / N has its image at f (1 + m). It collects the solid angle pi / 4 / (N (1 + m))^2, times
    cos^4 of the angle to the axis.
    """
    camera, window = sensor.camera, sensor.camera.window
    index = medium.refractive_index(wavelength_nm)
    passed = window_transmittance(rays[:, 2], window, index, absorption_per_mm=window.absorption_per_mm()) / index**2
    magnification = 1 / (camera.focus_distance_mm / camera.focal_length_mm - 1)
    return passed * math.pi / 4 / (camera.f_number * (1 + magnification)) ** 2 * rays[:, 2] ** 4


def image_of(sensor: Sensor, medium: Medium, points: np.ndarray) -> np.ndarray:
    """Image points (N, 2) of points (N, 3) of the OCS, for a lens without distortion."""
    rays = oracle_paths(sensor, medium, points)[0]
    return rays[:, :2] / rays[:, 2:] * sensor.camera.focal_length_px() + sensor.camera.principal_point()


def gauss_legendre(low: float, high: float, count: int) -> tuple[np.ndarray, np.ndarray]:
    """Nodes and weights of an integral from ``low`` to ``high``."""
    nodes, weights = np.polynomial.legendre.leggauss(count)
    return 0.5 * (high - low) * nodes + 0.5 * (high + low), 0.5 * (high - low) * weights


def seen_at(sensor: Sensor, medium: Medium, points: np.ndarray) -> np.ndarray:
    """Image points (N, 2) of points (N, 3) of the OCS by least time, straight without window, and OpenCV's lens."""
    camera, d = sensor.camera, sensor.camera.distortion
    fx, (cx, cy) = camera.focal_length_px(), camera.principal_point()
    matrix = np.array([[fx, 0, cx], [0, camera.pixel_aspect * fx, cy], [0, 0, 1.0]])
    axes, standoff = camera_axes(sensor)
    rays = oracle_paths(sensor, medium, points)[0] if camera.window.mounted else points @ axes.T + standoff
    return cv2.projectPoints(rays, np.zeros(3), np.zeros(3), matrix, np.array(list(d.model_dump().values())))[0][:, 0]


def stripe_on_plate(sensor: Sensor, medium: Medium, lines: np.ndarray, z: float) -> tuple[np.ndarray, np.ndarray]:
    """Return y (N,) on the plane Z = ``z`` and the coordinate across the stripe (N,) of the sheet X = 0 on lines.

    Uses a secant search along the sheet for the y that appears on each line.
    """
    along, across = (0, 1) if sensor.camera.stripe_along == "width" else (1, 0)

    def image(y: np.ndarray) -> np.ndarray:
        return seen_at(sensor, medium, np.stack([0 * y, y, np.full_like(y, z)], axis=1))

    y = np.linspace(-110, 110, len(lines))
    slope, offset = np.polyfit(y, image(y)[:, along], 1)
    old, new = (lines - offset) / slope, (lines - offset) / slope + 0.5
    miss_old = image(old)[:, along] - lines
    for _ in range(30):
        miss = image(new)[:, along] - lines
        if np.abs(miss).max() < 1e-9:
            return new, image(new)[:, across]
        change = np.where(miss == miss_old, 0.0, miss * (new - old) / np.where(miss == miss_old, 1.0, miss - miss_old))
        old, new, miss_old = new, new - change, miss
    raise ArithmeticError(f"the stripe was not found on every line: {np.abs(miss).max():g} px are left")
