"""Description of a sensor with the values that images of a scan show, and outlook for measurements in this water."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any

import numpy as np

from uwlts.model.calibration import Calibration
from uwlts.model.placement import laser_pose
from uwlts.model.sensor import CaptureHeader, Laser, Medium, Sensor
from uwlts.optics.triangulation import points_on_sheet
from uwlts.radiometry.result import ImageEstimate, Outlook
from uwlts.radiometry.stripe_images import StripeImages
from uwlts.radiometry.stripe_light import calibrated_pose, light_at
from uwlts.stripe import StripeOptions

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
    sensor, laser = header.sensor, _place_laser(header.sensor, calibration)
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
        waist = _solve_waist_radius_mm(sensor.laser, radius, sheet_distance_mm, medium_index=index)
        laser |= {} if waist is None else {"waist_radius_mm": waist}
    if "dark_noise_dn" in value:
        detector["read_noise_e"] = math.sqrt(max((value["dark_noise_dn"] / gain) ** 2 - dark_e, 0.0))
    if "background_dn" in value:
        detector["black_level_dn"] = max(value["background_dn"] - gain * dark_e, 0.0)
    medium = header.medium
    if {"attenuation_per_m", "scattering_per_m"} & value.keys():
        described = 1e3 * medium.scattering_per_mm(sensor.laser.wavelength_nm)
        medium = _fit_medium(medium, attenuation_per_m, value.get("scattering_per_m", described))
    exposure = sensor.exposure.model_copy(update={"laser_ms": exposure_ms})
    return sensor.model_copy(
        update={
            "exposure": exposure,
            "name": f"{sensor.name}-followed",
            "camera": _calibrate_camera(sensor, calibration),
            "laser": sensor.laser.model_copy(update=laser),
            "detector": sensor.detector.model_copy(update=detector),
            "media": sensor.media | {header.medium_name: medium},
        }
    )


def _calibrate_camera(sensor: Sensor, calibration: Calibration) -> Any:
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


def _place_laser(sensor: Sensor, calibration: Calibration) -> dict[str, Any]:
    """Return the keys of a laser in the calibrated sheet; the roll turns the described normal into the sheet's."""
    pose = calibrated_pose(sensor, calibration)
    vectors = {"origin_mm": tuple(pose.origin_mm.tolist()), "axis": tuple(pose.axis.tolist())}
    bare = {"baseline_mm": None, "triangulation_angle_deg": None, "roll_deg": 0.0, **vectors}
    without = laser_pose(sensor.model_copy(update={"laser": sensor.laser.model_copy(update=bare)}))
    roll = math.degrees(math.atan2(float(pose.normal @ without.fan), float(pose.normal @ without.normal)))
    return bare | {"roll_deg": roll}


def _solve_waist_radius_mm(laser: Laser, radius_mm: float, distance_mm: float, *, medium_index: float) -> float | None:
    """Return the waist radius at the described focus that gives a radius at a distance; None if diffraction forbids it.

    The equation of `sheet_sigma_mm` is quadratic in the squared waist. Of two solutions, the larger waist is returned:
    the wider sheet spreads less.
    """
    away_mm = distance_mm - laser.waist_distance_mm
    spread = laser.beam_quality_m2 * 1e-6 * laser.wavelength_nm * away_mm / (math.pi * medium_index)
    left = radius_mm**4 - 4 * spread**2
    return math.sqrt((radius_mm**2 + math.sqrt(left)) / 2) if radius_mm > 0 and left >= 0 else None


def _fit_medium(medium: Medium, attenuation_per_m: float, scattering_per_m: float) -> Medium:
    """Return the medium with fitted absorption and scattering; its phase function is the one of the fit."""
    scattering = max(scattering_per_m, 0.0)
    found = {"absorption_per_m": max(attenuation_per_m - scattering, 0.0), "scattering_per_m": scattering}
    return medium.model_copy(update={"water": None, "turbidity": None, "phase": medium.phase or PARTICLES} | found)


def outlook(
    header: CaptureHeader,
    calibration: Calibration,
    found: Mapping[str, ImageEstimate],
    images: StripeImages,
    *,
    determined: bool,
) -> Outlook:
    """Predict the stripe in the middle of the view, on a surface like the scanned one that faces the laser.

    The stripe is found where the peak of its light, blurred as in the scan, is above the least height of a stripe
    (`StripeOptions`).
    """
    sensor, camera = header.sensor, header.sensor.camera
    value = {name: each.value for name, each in found.items()}
    count = camera.height_px if camera.stripe_along == "width" else camera.width_px
    middle = np.full(count, (camera.lines() - 1) / 2)
    place = np.arange(count, dtype=float)
    pixels = np.column_stack((place, middle) if camera.stripe_along == "height" else (middle, place))
    index = calibration.medium_index(header.medium)
    frame = calibration.object_transform()[:3, :3]
    light = light_at(sensor, calibration, pixels, np.tile(-frame[:, 2], (count, 1)), medium_index=index)
    points = points_on_sheet(calibration, pixels, medium_index=index).points_mm
    exposure, paths = float(np.median(images.exposure_ms)), light.laser_path_mm + light.camera_path_mm
    attenuation = value["attenuation_per_m"]
    if not determined:
        attenuation = 1e3 * header.medium.extinction_per_mm(sensor.laser.wavelength_nm)
    whole = exposure * light.grey_per_mw * value["power_reflectance_mw"] * np.exp(-1e-3 * attenuation * paths)
    peak = whole / (math.sqrt(2 * math.pi) * math.hypot(value["stripe_sigma_px"], math.sqrt(1 / 12)))
    options = StripeOptions.resolve(sensor, None)
    noise = value.get("dark_noise_dn", sensor.detector.gain_dn_per_e() * sensor.detector.read_noise_e)
    least = max(options.threshold_sigmas * noise, options.threshold_floor)
    window = calibration.window
    outer = 0.0 if window is None or not camera.window.mounted else window.distance_mm + window.thickness_mm
    depth = points[:, 2] - outer
    seen = light.usable & (peak > least)
    level = sensor.exposure.auto_level * header.saturation_dn
    above = images.peak_dn - value["background_dn"]
    advised = exposure * (level - value["background_dn"]) / above
    return Outlook(
        attenuation_per_m=attenuation if determined else None,
        scattering_per_m=value["scattering_per_m"] if found["scattering_per_m"].determined else None,
        reach_mm=float(depth[seen].max()) if seen.any() else 0.0,
        view_mm=float(np.nanmax(depth[light.usable])),
        exposure_ms=exposure,
        advised_exposure_ms=float(min(advised, sensor.exposure.longest_ms)),
    )
