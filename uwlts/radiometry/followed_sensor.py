"""Description of a sensor with the values that a calibration and the images of a scan show."""

import math
from collections.abc import Mapping
from typing import Any

import numpy as np

from uwlts.model.calibration import Calibration
from uwlts.model.placement import LaserPose, laser_pose
from uwlts.model.sensor import CaptureHeader, Laser, Medium, Sensor
from uwlts.optics.brightness import sheet_sigma_mm

PARTICLES = "petzold"
"""Phase function of water whose description states none. The named waters have the same."""


def follow_sensor(
    header: CaptureHeader,
    calibration: Calibration,
    value: Mapping[str, float],
    *,
    reflectance: float,
    sheet_distance_mm: float,
    attenuation_per_m: float,
    dark_e: float,
    exposure_ms: float,
) -> Sensor:
    """Return the described sensor with calibrated lens, window and sheet, and fitted laser, water and detector.

    Properties without a determined estimate in ``value`` stay as described. ``reflectance`` of the surface
    divides the fitted product. ``sheet_distance_mm`` is the laser's distance from the fitted radius of the sheet.
    ``attenuation_per_m`` is the attenuation for which the power was fitted. ``dark_e`` is the dark current in electrons
    during the exposure of the laser images.
    """
    sensor, laser = header.sensor, _placement(header.sensor, calibration)
    detector: dict[str, Any] = {}
    gain = sensor.detector.gain_dn_per_e()
    if value.get("gain_dn_per_e", 0.0) > 0:
        gain = value["gain_dn_per_e"]
        detector["full_well_e"] = sensor.detector.full_scale_dn() / gain
    if "power_reflectance_mw" in value:
        # Quantum efficiency and gain have one product in the brightness, which the power contains.
        laser["power_mw"] = value["power_reflectance_mw"] / reflectance * sensor.detector.gain_dn_per_e() / gain
    if "sheet_radius_mm" in value:
        index, radius = calibration.medium_index(header.medium), value["sheet_radius_mm"]
        waist = _waist_radius_mm(sensor.laser, radius, sheet_distance_mm, medium_index=index)
        laser |= {} if waist is None else {"waist_radius_mm": waist}
    if "dark_noise_dn" in value:
        detector["read_noise_e"] = math.sqrt(max((value["dark_noise_dn"] / gain) ** 2 - dark_e, 0.0))
    if "background_dn" in value:
        detector["black_level_dn"] = max(value["background_dn"] - gain * dark_e, 0.0)
    medium = header.medium
    if {"attenuation_per_m", "scattering_per_m"} & value.keys():
        described = 1e3 * medium.scattering_per_mm(sensor.laser.wavelength_nm)
        medium = _followed_medium(medium, attenuation_per_m, value.get("scattering_per_m", described))
    exposure = sensor.exposure.model_copy(update={"laser_ms": exposure_ms})
    return sensor.model_copy(
        update={
            "exposure": exposure,
            "name": f"{sensor.name}-followed",
            "camera": _calibrated_camera(sensor, calibration),
            "laser": sensor.laser.model_copy(update=laser),
            "detector": sensor.detector.model_copy(update=detector),
            "media": sensor.media | {header.medium_name: medium},
        }
    )


def _calibrated_camera(sensor: Sensor, calibration: Calibration) -> Any:
    camera, model = sensor.camera, calibration.camera
    update: dict[str, Any] = {
        "focal_length_mm": 1e-3 * model.fx_px * camera.pixel_size_um,
        "pixel_aspect": model.fy_px / model.fx_px,
        "principal_point_px": (model.cx_px, model.cy_px),
        "distortion": model.distortion,
    }
    window = calibration.window
    if window is not None and window.refractions == 2 and camera.window.mounted:
        x, y, z = window.normal
        update["window"] = camera.window.model_copy(
            update={
                "distance_mm": window.distance_mm,
                "thickness_mm": window.thickness_mm,
                "glass": window.glass_index,
                "absorption_per_m": 1e3 * camera.window.absorption_per_mm(),
                "tilt_x_deg": math.degrees(-math.asin(y)),
                "tilt_y_deg": math.degrees(math.atan2(x, z)),
            }
        )
    return camera.model_copy(update=update)


def calibrated_pose(sensor: Sensor, calibration: Calibration) -> LaserPose:
    """Return the described pose of the laser, moved into the calibrated sheet."""
    described, normal = laser_pose(sensor), np.array(calibration.sheet.normal)
    sign = float(np.sign(normal @ described.normal))
    normal, offset = sign * normal, sign * calibration.sheet.offset_mm
    origin = described.origin_mm + (offset - normal @ described.origin_mm) * normal
    axis = described.axis - (described.axis @ normal) * normal
    axis /= np.linalg.norm(axis)
    return LaserPose(origin, axis, np.cross(axis, normal), normal)


def _placement(sensor: Sensor, calibration: Calibration) -> dict[str, Any]:
    """Return the keys of a laser in the calibrated sheet; the roll turns the described normal into the sheet's."""
    pose = calibrated_pose(sensor, calibration)
    vectors = {"origin_mm": tuple(pose.origin_mm.tolist()), "axis": tuple(pose.axis.tolist())}
    bare = {"baseline_mm": None, "triangulation_angle_deg": None, "roll_deg": 0.0, **vectors}
    without = laser_pose(sensor.model_copy(update={"laser": sensor.laser.model_copy(update=bare)}))
    roll = math.degrees(math.atan2(float(pose.normal @ without.fan), float(pose.normal @ without.normal)))
    return bare | {"roll_deg": roll}


def _waist_radius_mm(laser: Laser, radius_mm: float, distance_mm: float, *, medium_index: float) -> float | None:
    """Return the waist radius at the described focus that gives a radius at a distance; None if diffraction forbids it.

    Of two solutions, the one with the larger waist is returned: the wider sheet spreads less.
    """
    waists = np.geomspace(4 * radius_mm, 1e-3 * radius_mm, 4001)
    radii = np.array(
        [
            2 * float(sheet_sigma_mm(laser.model_copy(update={"waist_radius_mm": float(waist)}),
                                     np.array(distance_mm), medium_index=medium_index))
            for waist in waists
        ]
    )  # fmt: skip
    below = np.flatnonzero(radii <= radius_mm)
    return float(waists[below[0]]) if radius_mm > 0 and len(below) else None


def _followed_medium(medium: Medium, attenuation_per_m: float, scattering_per_m: float) -> Medium:
    """Return the medium with fitted absorption and scattering; its phase function is the one of the fit."""
    scattering = max(scattering_per_m, 0.0)
    found = {"absorption_per_m": max(attenuation_per_m - scattering, 0.0), "scattering_per_m": scattering}
    return medium.model_copy(update={"water": None, "turbidity": None, "phase": medium.phase or PARTICLES} | found)
