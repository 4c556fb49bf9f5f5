"""Lateral spread of light in the body of a translucent material, by diffusion theory.

Light enters the body, is scattered, and leaves at another point. Diffusion from a point source at a time is a Gaussian
along the surface, so the stationary spread is a mixture of Gaussians over the times: it widens the Gaussian profile of
a laser sheet without integration.
"""

import math
from dataclasses import dataclass

import numpy as np
from scipy.optimize import root_scalar

GAUSSIANS = 8
"""Number of Gaussians, with standard deviations in steps of about 1.6: their sum is the profile to 2 % of its peak."""
_TAILS = (0.08, 0.999)
"""Fractions of the light between which the Gaussians are spaced; the first and the last take over the rest."""
_DEPTHS = 32
"""Number of depths of the first scattering (Gauss-Laguerre quadrature)."""


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

    Parameters
    ----------
    mean_free_path_mm
        Transport mean free path: 1 / (reduced scattering + absorption).
    reflectance
        Diffuse reflectance of the body: the fraction that is reflected if nothing is reflected inwards.
    index
        Refractive index of the body relative to the medium; 1 for a body without a smooth surface.
    """
    if mean_free_path_mm == 0 or reflectance == 0:
        return NO_SPREAD
    inwards = internal_reflectance(index)
    leaving = min(reflectance * (1 - inwards) / (1 - reflectance * inwards), 1 - 1e-6)
    # In units of the mean free path.
    apart = 4 / 3 * (1 + inwards) / (1 - inwards)

    def excess(decay: float) -> float:
        return (1 - decay**2 / 3) * (1 + math.exp(-apart * decay)) / (2 + 2 * decay) - leaving

    decay = root_scalar(excess, bracket=(0, math.sqrt(3))).root
    depth, share = np.polynomial.laguerre.laggauss(_DEPTHS)
    variance = np.geomspace(1e-5, 1e3 * apart / max(decay, 1e-3), 4000)
    # Per logarithm of the variance.
    density = np.exp(-0.5 * decay**2 * variance) / np.sqrt(variance)
    density *= sum(z * np.exp(-0.5 * z**2 / variance[:, None]) @ share for z in (depth, depth + apart))
    below = np.cumsum(density) / density.sum()
    low, high = np.interp(_TAILS, below, np.log(variance))
    edges = np.linspace(low, high, GAUSSIANS + 1)[1:-1]
    weights, moments = (
        np.diff(np.interp(edges, np.log(variance), np.cumsum(each) / density.sum()), prepend=0.0, append=last)
        for each, last in ((density, 1.0), (density * variance, density @ variance / density.sum()))
    )
    # Each Gaussian has the mean variance of its part, so that the variance of the whole is preserved.
    return LateralSpread(weights, moments / weights * mean_free_path_mm**2, mean_free_path_mm, decay, index)
