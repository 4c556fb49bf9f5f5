"""Brightness and width of the stripe at points of the sheet, and the uncertainty of its centre there."""

from __future__ import annotations

import math
from dataclasses import dataclass
from types import ModuleType

import numpy as np

from twin.design.geometry import (
    Array,
    FlatWindow,
    Pose,
    Seen,
    Vector,
    added,
    dot,
    length_outside_mm,
    path_to,
    pixels_per_mm,
    scaled,
    slopes_per_mm,
)
from twin.design.parameters import Parameters
from twin.sensor.detector import PLANCK_TIMES_LIGHT

_BRIGHT_LINES = 2.05
"""Automatic exposure lets 2 % of the profile lines be brighter: standard deviations of speckle above the mean."""
_UNMODELLED = 0.02
"""Part of the height by which stripes differ from the Gaussian that is fitted to them; it limits the flanks' weight."""
_FLANK, _NODES = 4.0, 16
"""The profile is summed up to so many standard deviations, at so many places."""
_DIFFRACTION = 0.42
"""Standard deviation of the Gaussian that is closest to an Airy pattern, in wavelengths times f-number."""


@dataclass(frozen=True)
class Stripe:
    """The stripe on a diffuse plate square to the laser's axis.

    ``sigma_px`` is the image's standard deviation across, ``blur_px`` the lens's part of it; ``rate_e_per_ms`` is the
    brightest pixel's, ``background_e_per_ms`` what other light adds to it.
    """

    sigma_px: Array
    blur_px: Array
    rate_e_per_ms: Array
    background_e_per_ms: Array


def stripe_at(
    xp: ModuleType, p: Parameters, pose: Pose, window: FlatWindow, point: Vector, view: Seen, *, reflectance: float
) -> Stripe:
    """The stripe at points of the sheet.

    Across the sheet the light is a Gaussian of standard deviation w / 2 with w^2 = w0^2 (1 + ((s - s0) / zR)^2)
    (Siegman, Lasers, Eqs. 17.5 and 17.6). The lens's pupil of radius R blurs what is out of focus evenly over a disc,
    whose standard deviation in one direction is R / 2; a pupil offset b shifts the image by b / a - ds/dP b, a being
    the focus distance and ds/dP how the image moves with the point. Light that the medium scatters counts as lost.
    """
    xa, xb, ya, yb = view.jacobian
    across = p.across((xa, ya)), p.across((xb, yb))
    from_laser = added(point, scaled(pose.origin, -1.0))
    away = xp.sqrt(dot(from_laser, from_laser))
    rayleigh = math.pi * p.waist_mm * p.waist_mm * p.medium_index / (p.beam_quality * p.wavelength_mm)
    sheet = 0.5 * p.waist_mm * xp.sqrt(1 + ((away - p.waist_distance_mm) / rayleigh) ** 2)
    # On a profile line, where the pixel along the stripe is given.
    by_x, by_y = (pixels_per_mm(view, window, direction) for direction in (pose.normal, pose.fan))
    thick = abs(p.across(by_x) - p.across(by_y) * p.along(by_x) / p.along(by_y)) * sheet

    number = p.working_f_number()
    radius = 0.5 * p.focal_mm / number
    shifts = []
    for axis in range(2):
        unit = tuple(1.0 + 0.0 * radius if k == axis else 0.0 * radius for k in range(3))
        change = slopes_per_mm(view, window, unit)
        own = [(1 / p.focus_mm if k == axis else 0.0) - change[k] for k in range(2)]
        shifts.append(across[0] * own[0] + across[1] * own[1])
    defocus = 0.5 * radius * xp.sqrt(shifts[0] ** 2 + shifts[1] ** 2 + 1e-24)
    diffraction = _DIFFRACTION * p.wavelength_mm * number / p.pixel_mm
    blur = xp.sqrt(defocus * defocus + diffraction * diffraction)
    sigma = xp.sqrt(thick * thick + blur * blur + 1 / 12)

    laser_window = p.laser_window(pose.axis)
    fan = path_to(xp, laser_window, from_laser)
    side = dot(from_laser, pose.fan)
    angle = xp.atan(fan.slope) * side / xp.sqrt(side * side + 1e-18)
    lit = _lit(xp, p, angle)
    per_mm = p.power_w * lit / (2 * p.fan_half_rad) / ((1 + fan.slope * fan.slope) * fan.growth_mm)
    back = length_outside_mm(xp, window, view.path)
    passed = xp.exp(-p.extinction_per_mm * (length_outside_mm(xp, laser_window, fan) + back))
    on_surface = per_mm / (math.sqrt(2 * math.pi) * sheet) * p.laser_window_passes * passed
    a, b = view.slopes
    cosine_squared = 1 / (1 + a * a + b * b)
    lens = math.pi / 4 / (number * number) * cosine_squared * cosine_squared
    per_radiance = lens * p.window_passes / (p.medium_index * p.medium_index)
    electrons = 1e-3 * p.pixel_mm * p.pixel_mm * 1e-3 * p.wavelength_mm / PLANCK_TIMES_LIGHT * p.quantum_efficiency
    rate = on_surface * reflectance / math.pi * per_radiance * electrons * thick / sigma
    ambient = (
        p.ambient_w_per_mm2 * reflectance / math.pi * per_radiance * electrons * xp.exp(-p.extinction_per_mm * back)
    )
    return Stripe(sigma, blur, rate, ambient)


def centre_noise_px(xp: ModuleType, p: Parameters, stripe: Stripe, exposure_ms: Array) -> Array:
    """Standard uncertainty of the stripe's centre in px, found by a fit that weighs pixels by their noise.

    With the mean signal m = A exp(-x^2 / 2 s^2), its derivative m' and weights m' / W the fit's variance is
    sum(m'^2 V / W^2) / sum(m'^2 / W)^2. V is the pixels' variance, m + (C m)^2 + read, dark, background and rounding
    noise: photons and speckle, whose contrast C allows for what neighbours have in common. W is what the fit takes for
    V: it knows of no neighbours, and adds how far real profiles may be from Gaussian ones, without which the dark
    flanks of a stripe under pure speckle would count ever more.
    """
    height = stripe.rate_e_per_ms * exposure_ms
    true, taken = p.centre_contrast(xp, stripe.sigma_px) ** 2 + p.prnu**2, p.pixel_contrast(xp) ** 2 + p.prnu**2
    floor = (
        p.read_noise_e**2
        + p.offset_e**2
        + p.step_e**2 / 12
        + (p.dark_e_per_ms + stripe.background_e_per_ms) * exposure_ms
    )
    information, noise = 0.0 * height, 0.0 * height
    width = _FLANK / _NODES
    for node in range(_NODES):
        t = (node + 0.5) * width
        signal = height * math.exp(-0.5 * t * t)
        weight = 1 / (floor + (_UNMODELLED * height) ** 2 + signal + taken * signal**2)
        slope = t * t * signal * signal
        information = information + slope * weight
        noise = noise + slope * weight * weight * (floor + signal + true * signal**2)
    return xp.sqrt(stripe.sigma_px * noise / (2 * width * information * information + 1e-30))


def exposure_ms(xp: ModuleType, p: Parameters, brightest_e_per_ms: Array) -> tuple[Array, Array]:
    """Exposure that brings the brightest light to the wanted level, and the exposure that the sensor then uses."""
    level = p.exposure_level * p.full_well_e / (1 + _BRIGHT_LINES * p.pixel_contrast(xp))
    required = level / brightest_e_per_ms
    automatic = xp.minimum(required, p.longest_ms)
    if xp is np:
        return required, np.where(np.isnan(p.exposure_ms), automatic, p.exposure_ms)
    return required, automatic if math.isnan(p.exposure_ms) else p.exposure_ms


def _lit(xp: ModuleType, p: Parameters, angle: Array) -> Array:
    """Power per angle over the mean one; 0 outside the fan where that is not needed smooth."""
    gauss = xp.exp(-2 * (angle / p.fan_half_rad) ** 2) * 2 / (math.sqrt(math.pi / 2) * math.erf(math.sqrt(2)))
    lit = p.gaussian_fan * gauss + (1 - p.gaussian_fan) * (1 - p.tabulated_fan)
    if len(p.fan_nodes_rad) > 1:
        lit = lit + p.tabulated_fan * 2 * p.fan_half_rad * _tabulated(xp, p, angle)
    return lit


def _tabulated(xp: ModuleType, p: Parameters, angle: Array) -> Array:
    """Power per angle between the nodes of a table: a sum of ramps that begin at the nodes."""
    total, slope_before = p.fan_powers[0] + 0.0 * angle, 0.0
    nodes, powers = p.fan_nodes_rad, p.fan_powers
    for k in range(len(nodes) - 1):
        width = nodes[k + 1] - nodes[k]
        slope = (powers[k + 1] - powers[k]) / xp.maximum(width, 1e-12)
        total = total + (slope - slope_before) * xp.maximum(angle - nodes[k], 0.0)
        slope_before = slope
    return xp.maximum(total, 0.0)
