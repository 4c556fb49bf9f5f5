"""Scattering in the water: phase functions, and the sheet's light scattered once towards the camera."""

from __future__ import annotations

import math

import drjit as dr
import mitsuba as mi

from twin.sheet import SheetLight
from uwlts.sensor import Medium

MOLECULAR_ANISOTROPY = 0.925
"""k = (1 - d) / (1 + d) for water's depolarisation ratio d = 0.039 (Zhang, Hu and He 2009)."""


def phase(medium: Medium, cosine: mi.Float) -> mi.Float:
    """Phase function in 1/sr of the cosine of the scattering angle.

    Molecular: 3 (1 + k cos^2) / (4 pi (3 + k)). Henyey and Greenstein 1941: (1 - g^2) / (4 pi (1 + g^2 - 2 g cos)^1.5).
    """
    if medium.phase == "molecular":
        k = MOLECULAR_ANISOTROPY
        return 3 * (1 + k * cosine * cosine) / (4 * math.pi * (3 + k))
    g = medium.asymmetry
    return (1 - g * g) / (4 * math.pi) * dr.power(1 + g * g - 2 * g * cosine, -1.5)


def single_scattering(
    medium: Medium, light: SheetLight, *, wavelength_nm: float, direction: mi.Vector3f, surface_sigmas: mi.Float
) -> mi.Float:
    """Radiance that the sheet scatters once into a camera ray where the ray crosses it, in W/mm2/sr.

    ``light`` is the sheet at the crossing, where the distance across is about zero; ``surface_sigmas`` the distance
    across, in standard deviations and along the ray, of its end on a surface, which cuts the Gaussian off.
    The line integral of a Gaussian along a straight ray is b p(angle) E sigma sqrt(2 pi) / |cos| times the share of the
    Gaussian that the ray has passed.
    """
    b = medium.scattering_per_mm(wavelength_nm)
    cosine = dr.maximum(dr.abs(dr.dot(direction, light.normal)), 1e-3)
    peak = light.irradiance * light.sigma_mm * math.sqrt(2 * math.pi)
    share = 0.5 * (1 + dr.erf(surface_sigmas / math.sqrt(2.0)))
    return b * phase(medium, -dr.dot(light.direction, direction)) * peak / cosine * share
