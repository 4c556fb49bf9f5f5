"""Water at a glance: to which depth the stripe will be found at an exposure, and which exposure to use."""

from __future__ import annotations

import math
from collections.abc import Mapping

import numpy as np

from uwlts.model.calibration import Calibration
from uwlts.model.sensor import CaptureHeader
from uwlts.optics.triangulation import points_on_sheet
from uwlts.radiometry.result import ImageEstimate, Outlook
from uwlts.radiometry.stripe_images import StripeImages
from uwlts.radiometry.stripe_light import light_at
from uwlts.stripe import StripeOptions


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
    exposure = float(np.median(images.exposure_ms))
    attenuation = value["attenuation_per_m"]
    if not determined:
        attenuation = 1e3 * header.medium.extinction_per_mm(sensor.laser.wavelength_nm)
    power = value["power_reflectance_mw"]
    whole = exposure * light.grey_per_mw * power * np.exp(-1e-3 * attenuation * light.path_mm())
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
