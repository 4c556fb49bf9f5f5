"""Surface finishes by name, random fields that vary their reflectance, and spread of light in translucent bodies.

A field is a sum of plane waves fixed to the object. It is defined in space, so that every shape has it, with or without
texture coordinates, and the texture of neighbouring profiles and of several scans fits together.

Light enters a translucent body, is scattered, and leaves at another point. Diffusion from a point source at a time is a
Gaussian along the surface, so the stationary spread is a mixture of Gaussians over the times: it widens the Gaussian
profile of a laser sheet without integration.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Literal

import numpy as np
from scipy.optimize import root_scalar
from scipy.special import ndtr, ndtri

Reflection = Literal["diffuse", "painted", "pvc", "metal"]
Finish = Literal[
    "diffuse",
    "painted",
    "pvc",
    "metal",
    "machined-steel",
    "painted-steel",
    "rusted-steel",
    "fouled-steel",
    "concrete",
    "pvc-pipe",
    "marine-growth",
]
Lengths = tuple[float, float, float]

WAVES = 64  # number of plane waves of a field: its autocorrelation over one object deviates from the mean by about 0.1
_FINEST = 10 * math.pi
"""Largest wave number times the correlation length: a wavelength of a fifth of that length. The omitted tail of the
spectrum has 4 % of the variance; pixels that are to resolve less would show it as noise of their samples."""
LARGEST_CLIPPED = 0.01  # largest relative loss of mean reflectance by the limit of 1


@dataclass(frozen=True)
class FinishProperties:
    """Properties of a finish that an object may replace; see `twin.scene.scene_object.SceneObject`."""

    reflection: Reflection
    reflectance: float = 0.8
    alpha: float = 1.0
    roughness_um: float = 5.0
    mottle: float = 0.0
    mottle_mm: float | Lengths = 1.0
    mean_free_path_mm: float = 0.0
    patch_share: float = 0.0
    patch_length_mm: float = 5.0
    patch_reflectance: float = 0.03
    relief_mm: float = 0.0
    relief_length_mm: float | Lengths = 2.0
    relief_exponent: float = 0.5


# Sources. Roughness of coats and metal (alpha): a satin paint, an extruded pipe, ground steel; assumed. Light from a
# diffuse body has travelled some um inside it, whatever its surface roughness. White, diffuse materials scatter 3 to 8
# times per mm (reduced; Sensors 23:6853, 2023), coral tissue once at 636 nm (Wangpraseurt et al. 2016, Front. Plant
# Sci. 7:1404), which is an albedo of 0.5 per mean free path of 0.5 mm. Brown algae reflect 0.02 to 0.04 below 520 nm
# (Maritorena, Morel and Gentili 1994, Limnol. Oceanogr. 39:1689). Other reflectances, mottle and lengths are assumed;
# docs/results/surfaces.md compares the stripes with real ones.
FINISHES: dict[Finish, FinishProperties] = {
    "diffuse": FinishProperties("diffuse"),
    "painted": FinishProperties("painted", alpha=0.3),
    "pvc": FinishProperties("pvc", alpha=0.15),
    "metal": FinishProperties("metal", alpha=0.3, roughness_um=1.0),
    "machined-steel": FinishProperties(
        "metal", reflectance=0.6, alpha=0.2, roughness_um=1.6, mottle=0.2, mottle_mm=(10.0, 0.2, 0.2)
    ),
    "painted-steel": FinishProperties("painted", reflectance=0.5, alpha=0.4, mottle=0.12, mottle_mm=1.5),
    "rusted-steel": FinishProperties("diffuse", reflectance=0.25, roughness_um=20.0, mottle=0.3, mottle_mm=0.8),
    "fouled-steel": FinishProperties(
        "diffuse",
        reflectance=0.25,
        roughness_um=20.0,
        mottle=0.3,
        mottle_mm=0.8,
        patch_share=0.25,
        patch_length_mm=10.0,
    ),
    "concrete": FinishProperties("diffuse", reflectance=0.35, roughness_um=50.0, mottle=0.2, mottle_mm=0.6),
    "pvc-pipe": FinishProperties("pvc", reflectance=0.7, alpha=0.15, mottle=0.05, mottle_mm=2.0, mean_free_path_mm=0.2),
    "marine-growth": FinishProperties(
        "diffuse", reflectance=0.12, roughness_um=50.0, mottle=0.4, mottle_mm=1.5, mean_free_path_mm=0.5
    ),
}


def draw_waves(rng: np.random.Generator, correlation_mm: float | Lengths, *, smooth: bool = False) -> np.ndarray:
    """Draw the plane waves (N, 4) of a Gaussian field of mean 0 and variance 1: wave vectors in 1/mm, and phases.

    The field is the sum of sqrt(2 / N) cos(k r + phase) (spectral representation, Shinozuka 1971, J. Acoust. Soc. Am.
    49:357). Its autocorrelation is exp(-d) at the distance d = sqrt(sum (r_j / l_j)^2), with the correlation length l_j
    along each of the object's axes. The density of exp(-d) in space is proportional to 1 / (1 + q^2)^2 with q_j = k_j
    l_j (Matern's class with exponent 1/2), a power law above 1 / l. Wave numbers are drawn one from each of N intervals
    of equal power, up to `_FINEST`. A ``smooth`` field has the autocorrelation exp(-d^2 / 2) and the density exp(-q^2 /
    2).
    """
    numbers = np.geomspace(1e-3, _FINEST, 4096)
    density = numbers**2 * (np.exp(-0.5 * numbers**2) if smooth else 1 / (1 + numbers**2) ** 2)
    # Per logarithm of the wave number.
    below = np.cumsum(density * numbers)
    share = (np.arange(WAVES) + rng.random(WAVES)) / WAVES
    number = np.interp(share * below[-1], below, numbers)
    direction = rng.standard_normal((WAVES, 3))
    direction /= np.linalg.norm(direction, axis=1, keepdims=True)
    lengths = np.broadcast_to(correlation_mm, 3)
    phase = rng.uniform(0, 2 * math.pi, WAVES)
    return np.column_stack([number[:, None] * direction / lengths, phase])


def draw_patches(rng: np.random.Generator, *, share: float, length_mm: float) -> tuple[np.ndarray, float]:
    """Draw the waves (N, 4) of a smooth field, and the level above which a ``share`` of the surface lies.

    A line crosses the level u upwards exp(-u^2 / 2) / (2 pi s) times per length if the autocorrelation is exp(-d^2 / (2
    s^2)) (Rice 1945, Bell Syst. Tech. J. 24:46, Eq. 3.3-14). The share divided by this rate is ``length_mm``, the mean
    length of the line in a patch.
    """
    level = float(ndtri(1 - share))
    correlation_mm = length_mm * math.exp(-(level**2) / 2) / (2 * math.pi * share)
    return draw_waves(rng, correlation_mm, smooth=True), level


def move_waves(waves: np.ndarray, pose: np.ndarray) -> np.ndarray:
    """Return waves (N, 4) of an object's own frame in the frame that ``pose`` (4, 4) transforms to."""
    towards = waves[:, :3] @ pose[:3, :3].T
    return np.column_stack([towards, waves[:, 3] - towards @ pose[:3, 3]])


def log_deviation(mottle: float) -> float:
    """Return the standard deviation of the logarithm of log-normal numbers with a relative standard deviation."""
    return math.sqrt(math.log1p(mottle**2))


def clipped_share(reflectance: float, mottle: float) -> float:
    """Return the relative loss of the mean of log-normal reflectances that are limited to 1.

    The mean of max(x - 1, 0) of a log-normal x with mean m and log deviation s is m N(d + s) - N(d) with d = ln(m) / s
    - s / 2 and the normal distribution function N.
    """
    if mottle == 0 or reflectance == 0:
        return 0.0
    s = log_deviation(mottle)
    d = math.log(reflectance) / s - s / 2
    return float(ndtr(d + s) - ndtr(d) / reflectance)


# --- translucent bodies -----------------------------------------------------------------------------------------------


GAUSSIANS = 8
"""Number of Gaussians, with standard deviations in steps of about 1.6: their sum is the profile to 2 % of its peak."""
_TAILS = (0.08, 0.999)
"""Fractions of the light between which the Gaussians are spaced; the first and the last take over the rest."""
_DEPTHS = 32  # number of depths of the first scattering (Gauss-Laguerre quadrature)


@dataclass(frozen=True)
class LateralSpread:
    """Distribution of the exit points along each direction of the surface, about the mean exit point.

    It is the sum of Gaussians with ``weights`` (K,), which sum to 1, and ``variances_mm2`` (K,). Light that enters at
    an angle t to the normal, after refraction by the relative ``index``, leaves ``path_mm`` sin(t) / (1 + ``decay``
    cos(t)) farther ahead on average.
    """

    weights: np.ndarray
    variances_mm2: np.ndarray
    path_mm: float
    decay: float
    index: float


NO_SPREAD = LateralSpread(np.eye(GAUSSIANS)[0], np.zeros(GAUSSIANS), 0.0, 0.0, 1.0)


def internal_reflectance(index: float) -> float:
    """Return the fraction of diffuse light in a body that its surface reflects inwards; ``index`` is relative.

    Fit of Egan and Hilgeman (1973), as in Jensen et al. 2001, section 2.1; 0 for an index of 1 or less.
    """
    return max(0.0, -1.440 / index**2 + 0.710 / index + 0.668 + 0.0636 * index) if index > 1 else 0.0


def lateral_spread(*, mean_free_path_mm: float, reflectance: float, index: float) -> LateralSpread:
    """Return the spread of light in a half-space, from the transport mean free path and the diffuse reflectance.

    The refracted light is scattered first at the depth z, with the density exp(-z / l) / l and the transport mean free
    path l. From there and from an image source it diffuses (d'Eon and Irving 2011, ACM Trans. Graph. 30:56). The
    image's depth is z1 = z + 4 A D, with D = l / 3 and A = (1 + F) / (1 - F). F is the internal reflectance (Farrell,
    Patterson and Wilson 1992, Med. Phys. 19:879).

    Light that leaves at one time is a Gaussian of variance v along the surface. Its fraction is proportional to
    v^(-3/2) exp(-u^2 v / 2) (z exp(-z^2 / (2 v)) + z1 exp(-z1^2 / (2 v))), with u^2 = absorption / D (Patterson, Chance
    and Wilson 1989, Appl. Opt. 28:2331, Eq. 7).

    The sum over all times is a (exp(-u z) + exp(-u z1)) / 2 with the albedo a = 1 - (u l)^2 / 3. Its mean over z gives
    u from the reflectance. Weighted so, the mean path before the first scattering is l / (1 + u l cos(t)) at the angle
    t to the normal. The spread is that of normal incidence.

    The transport mean free path is 1 / (reduced scattering + absorption). The diffuse ``reflectance`` of the body is
    the fraction that is reflected if nothing is reflected inwards. ``index`` is the refractive index of the body
    relative to the medium; 1 for a body without a smooth surface.
    """
    if mean_free_path_mm == 0 or reflectance == 0:
        return NO_SPREAD
    inwards = internal_reflectance(index)
    leaving = min(reflectance * (1 - inwards) / (1 - reflectance * inwards), 1 - 1e-6)
    # In units of the mean free path.
    boundary = 4 / 3 * (1 + inwards) / (1 - inwards)

    def excess(decay: float) -> float:
        return (1 - decay**2 / 3) * (1 + math.exp(-boundary * decay)) / (2 + 2 * decay) - leaving

    decay = root_scalar(excess, bracket=(0, math.sqrt(3))).root
    depth, share = np.polynomial.laguerre.laggauss(_DEPTHS)
    variance = np.geomspace(1e-5, 1e3 * boundary / max(decay, 1e-3), 4000)
    # Per logarithm of the variance.
    density = np.exp(-0.5 * decay**2 * variance) / np.sqrt(variance)
    density *= sum(z * np.exp(-0.5 * z**2 / variance[:, None]) @ share for z in (depth, depth + boundary))
    below = np.cumsum(density) / density.sum()
    low, high = np.interp(_TAILS, below, np.log(variance))
    edges = np.linspace(low, high, GAUSSIANS + 1)[1:-1]
    weights, moments = (
        np.diff(np.interp(edges, np.log(variance), np.cumsum(each) / density.sum()), prepend=0.0, append=last)
        for each, last in ((density, 1.0), (density * variance, density @ variance / density.sum()))
    )
    # Each Gaussian has the mean variance of its part, so that the variance of the whole is preserved.
    return LateralSpread(weights, moments / weights * mean_free_path_mm**2, mean_free_path_mm, decay, index)
