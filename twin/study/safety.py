"""Whether people and windows stand a design: the laser's class, and the glass's thickness for the depth."""

from __future__ import annotations

import math

import numpy as np

from twin.study.parameters import Parameters

CLASS_NAMES = {1: "1", 2: "2", 3: "3R", 4: "3B", 5: "4"}
_PUPIL_MM, _AWAY_MM = 7.0, 100.0
_CLASS_2_W, _CLASS_3R_W, _CLASS_3B_W = 1e-3, 5e-3, 0.5

_GRAVITY, _WATER_KG_PER_M3 = 9.81, 1030.0
_SILICA_STRENGTH_MPA, _CLAMPED, _SAFETY = 60.0, 0.75, 4.0


def laser_class(p: Parameters) -> np.ndarray:
    """Class after IEC 60825-1:2014 as a number, see `CLASS_NAMES`: an estimate for a design, not a classification.

    Limits for continuous visible light from a point source (Tables 3 to 8): class 1 up to 0.39 mW above 500 nm,
    0.039 mW below 450 nm and C3 = 10^(0.02 (nm - 450)) times that between; class 2 up to 1 mW, 3R up to 5 mW, 3B up to
    500 mW. What counts is the power through 7 mm at 100 mm from the line optics (condition 3), of a line that is
    spread by its fan in air, where the fan is brightest per angle. Every laser counts alone.
    """
    seen = 2 * math.atan(0.5 * _PUPIL_MM / _AWAY_MM) / (2 * p.fan_half_rad)
    gaussian = 2 / (math.sqrt(math.pi / 2) * math.erf(math.sqrt(2)))
    tabulated = 2 * p.fan_half_rad * np.maximum.reduce(p.fan_powers)
    peak = np.where(p.gaussian_fan > 0, gaussian, np.where(p.tabulated_fan > 0, tabulated, 1.0))
    power = p.power_w * np.minimum(1.0, peak * seen)
    nm = 1e6 * p.wavelength_mm
    class_1 = 3.9e-5 * 10 ** (0.02 * (np.clip(nm, 450, 500) - 450))
    limits = (class_1, _CLASS_2_W, _CLASS_3R_W, _CLASS_3B_W)
    return 1 + sum((power > limit).astype(int) for limit in limits)


def window_needed_mm(p: Parameters, *, water_depth_m: float) -> np.ndarray:
    """Thickness of a clamped round window of fused silica, t = A / 2 sqrt(K f P / S) (Harris 1999, thesis Eq. 3.2)."""
    pressure_mpa = 1e-6 * _GRAVITY * _WATER_KG_PER_M3 * water_depth_m
    opening = np.where(np.isfinite(p.window_aperture_mm), p.window_aperture_mm, 0.0)
    return 0.5 * opening * math.sqrt(_CLAMPED * _SAFETY * pressure_mpa / _SILICA_STRENGTH_MPA)
