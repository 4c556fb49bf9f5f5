"""Lower limits of the error of any stripe centre: Cramer-Rao bound and speckle limit."""

import math

import numpy as np
from method_shots import Rendered
from scipy.interpolate import CubicSpline

from twin.sensor.speckle import pixel_contrast

WINDOW_PX = 16
"""Pixels on either side of the true centre that a method may use, as `StripeOptions.half_window_px`."""


def bound_px(shot: Rendered, *, speckle: bool, level: float = 1.0) -> float:
    """Return the Cramer-Rao bound of the centre's standard deviation on one line, px, median over the lines.

    A pixel with f signal electrons has the variance f + d + r^2 + q^2 / 12. The terms are dark current d, noise r of
    readout and fixed pattern, and q electrons per grey level. Speckle of contrast C over a pixel adds (C f)^2. The
    information about a shift is sum (df/dx)^2 / variance. This is exact for gamma-distributed speckle (1 / C^2
    patterns). Only the position is unknown. df/dx is that of a cubic spline through the noise-free pixels.
    """
    detector = shot.sensor.detector
    light = shot.electrons(level=level).astype(float)
    stripe = np.zeros_like(light)
    contrast = np.zeros_like(light)
    frame = shot.frame
    stripe[frame.rows, frame.columns] = light[frame.rows, frame.columns]
    if speckle:
        contrast[frame.rows, frame.columns] = shot.contrast() * pixel_contrast(grain_px(shot))
    dark = 1e-3 * level * shot.exposure_ms * detector.dark_current_e_per_s * detector.dark_current_growth()
    fixed = detector.read_noise_e**2 + detector.dsnu_e**2 + 1 / (12 * detector.gain_dn_per_e() ** 2)
    clipped = light >= detector.full_well_e
    deviations = []
    for line in np.flatnonzero(np.isfinite(shot.truth_px))[::8]:
        middle = round(shot.truth_px[line])
        rows = slice(max(0, middle - WINDOW_PX), middle + WINDOW_PX + 1)
        f = light[rows, line]
        slope = CubicSpline(np.arange(len(f)), f)(np.arange(len(f)), 1)
        variance = f + dark + fixed + (detector.prnu * f) ** 2 + (contrast * stripe)[rows, line] ** 2
        information = np.where(clipped[rows, line], 0.0, slope**2 / variance).sum()
        deviations.append(1 / math.sqrt(information))
    return float(np.median(deviations))


def grain_px(shot: Rendered) -> float:
    """Speckle grain lambda N (1 + m), px."""
    return _grain_um(shot) / shot.sensor.camera.pixel_size_um


def spot_limit_px(shot: Rendered) -> float:
    """Return the speckle limit of the centroid of a round spot's image, px: C lambda / (2 pi sin u').

    Dorsch, Haeusler and Herrmann, Laser triangulation: fundamental uncertainty in distance measurement, Applied Optics
    33 (1994) 1306-1314. C is the speckle's contrast over points, and u' the half angle of the light cone at the image
    sensor. With sin u' = 1 / (2 N (1 + m)), the limit is C lambda N (1 + m) / pi.
    """
    return float(np.median(shot.contrast())) * grain_px(shot) / math.pi


def _grain_um(shot: Rendered) -> float:
    camera = shot.sensor.camera
    magnification = camera.focal_length_mm / (camera.focus_distance_mm - camera.focal_length_mm)
    return 1e-3 * shot.sensor.laser.wavelength_nm * camera.f_number * (1 + magnification)
