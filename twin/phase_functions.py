"""Phase functions of what scatters in water, and one table form from which the renderer evaluates and samples them all.

Everything here is float64 NumPy. With the scattering angle t and h = sin^2(t / 2), 1 - cos t is 2 h; the table runs
over x = log(h / (1 - h)) = 2 log tan(t / 2) in even steps, which resolves a peak forwards as well as one backwards.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from uwlts.media import read_table
from uwlts.waters import FournierForand, HenyeyGreenstein, Molecular, PetzoldAverage, PhaseFunction, Scatterer

NODES = 4096
FORWARD_END = 1e-10
"""Below this 1 - cos (1.4e-5 rad) the tables are constant, so high that as much is scattered there as should be."""
BACKWARD_END = 2.0**-17
"""Below this 1 + cos (0.22 deg) the tables are constant and continuous; 32 bits do not resolve much less of 2."""
FORWARD_SR = 2 * math.pi * FORWARD_END
FIRST_PLACE = math.log(FORWARD_END / (2 - FORWARD_END))
STEP = (math.log((2 - BACKWARD_END) / BACKWARD_END) - FIRST_PLACE) / (NODES - 1)

MOLECULAR_ANISOTROPY = 0.925
"""k = (1 - d) / (1 + d) for water's depolarisation ratio d = 0.039 (Zhang, Hu and He 2009)."""
PETZOLD_FORWARD_EXPONENT = 1.346
"""Below the table's 0.1 deg the function goes on as angle^-1.346, the slope Petzold (1972) used for the harbour."""


def per_sr(phase: PhaseFunction, angle: np.ndarray) -> np.ndarray:
    """Phase function (N,) in 1/sr at scattering angles (N,) in rad between 0 and pi, both ends left out.

    All but Petzold's integrate to 1 in closed form; Petzold's does to the table's accuracy.
    """
    match phase:
        case Molecular():
            return _molecular(angle)
        case HenyeyGreenstein(asymmetry):
            return _henyey_greenstein(angle, asymmetry)
        case PetzoldAverage():
            return _petzold(angle)
        case FournierForand(index, slope):
            return _fournier_forand(angle, index, slope)


def _molecular(angle: np.ndarray) -> np.ndarray:
    """3 (1 + k cos^2) / (4 pi (3 + k)), Morel 1974."""
    k = MOLECULAR_ANISOTROPY
    return 3 * (1 + k * np.cos(angle) ** 2) / (4 * math.pi * (3 + k))


def _henyey_greenstein(angle: np.ndarray, g: float) -> np.ndarray:
    """(1 - g^2) / (4 pi (1 + g^2 - 2 g cos)^1.5), Henyey and Greenstein 1941, Eq. 2.

    The root's argument is written as a sum of squares, exact at a peak forwards (g > 0) or backwards (g < 0).
    """
    away = np.sin(angle / 2) if g >= 0 else np.cos(angle / 2)
    return (1 - g * g) / (4 * math.pi) * ((1 - abs(g)) ** 2 + 4 * abs(g) * away**2) ** -1.5


def _petzold(angle: np.ndarray) -> np.ndarray:
    """The table of Petzold's average particle, its logarithm linear in the angle's, and its extension forwards."""
    degrees, value = read_table("petzold_phase.csv")
    log_angle, log_end = np.log(angle), math.log(math.radians(degrees[0]))
    inside = np.interp(log_angle, np.log(np.radians(degrees)), np.log(value))
    return np.exp(inside - PETZOLD_FORWARD_EXPONENT * np.minimum(log_angle - log_end, 0.0))


def _fournier_forand(angle: np.ndarray, n: float, mu: float) -> np.ndarray:
    """Fournier and Forand 1994 in the form of Fournier and Jonasz 1999 (SPIE 3761:62).

    With d = 4 h / (3 (n - 1)^2), v = (3 - mu) / 2 and d180 = d at h = 1, it is

        (v (1 - d) - (1 - d^v) + (d (1 - d^v) - v (1 - d)) / h) / (4 pi (1 - d)^2 d^v)
        + (1 - d180^v) (3 cos^2 - 1) / (16 pi (d180 - 1) d180^v).

    Both numerators vanish as (1 - d)^2 at d = 1. With 1 - d^v = v (1 - d) - (1 - d)^2 s the first term becomes
    (s - (v + d s) / h) / (4 pi d^v), in which nothing is lost.
    """
    h = np.sin(angle / 2) ** 2
    v, whole = (3 - mu) / 2, 4 / (3 * (n - 1) ** 2)
    d = whole * h
    s = _second_remainder(d, v)
    around = (1 - whole**v) * (3 * np.cos(angle) ** 2 - 1) / (16 * math.pi * (whole - 1) * whole**v)
    return (s - (v + d * s) / h) / (4 * math.pi * d**v) + around


def _fournier_forand_within(angle: float, n: float, mu: float) -> float:
    """Share that the function of Fournier and Forand scatters by less than an angle: Fournier and Jonasz 1999.

    (1 - d^(v + 1) - (1 - d^v) h) / ((1 - d) d^v) + (1 - d180^v) cos sin^2 / (8 (d180 - 1) d180^v), for d < 1.
    """
    h = math.sin(angle / 2) ** 2
    v, whole = (3 - mu) / 2, 4 / (3 * (n - 1) ** 2)
    d = whole * h
    around = (1 - whole**v) * math.cos(angle) * math.sin(angle) ** 2 / (8 * (whole - 1) * whole**v)
    return (1 - d ** (v + 1) - (1 - d**v) * h) / ((1 - d) * d**v) + around


def _second_remainder(d: np.ndarray, v: float) -> np.ndarray:
    """(v (1 - d) - (1 - d^v)) / (1 - d)^2; near d = 1 by the binomial series of d^v."""
    x = 1 - d
    near = np.abs(x) < 0.05
    far = np.where(near, 0.5, x)
    series, coefficient = np.zeros_like(x), v
    for k in range(2, 14):
        coefficient *= -(v - k + 1) / k
        series += -coefficient * np.where(near, x, 0.0) ** (k - 2)
    return np.where(near, series, (v * far - (1 - np.where(near, 0.5, d) ** v)) / far**2)


@dataclass(frozen=True)
class PhaseTable:
    """A phase function on the nodes x = `FIRST_PLACE` + i `STEP`.

    ``log_density`` (NODES,) is the logarithm of the share scattered per x, pi p (1 - cos) (1 + cos) with the phase
    function p in 1/sr, and linear between the nodes. ``cumulative`` (NODES,) is the share scattered by less than a
    node's angle. Beyond both ends p is constant: ``cumulative[0]`` over `FORWARD_SR` forwards. All together is 1.
    """

    log_density: np.ndarray
    cumulative: np.ndarray


def node_angles() -> np.ndarray:
    """Scattering angles (NODES,) in rad of the tables' nodes."""
    return 2 * np.arctan(np.exp((FIRST_PLACE + STEP * np.arange(NODES)) / 2))


def tabulated(scatterers: Sequence[Scatterer]) -> PhaseTable:
    """The phase function of a mixture: each scatterer's, normalised, weighted by its share of the coefficient.

    What does not scatter at all is given the function of molecules, which then weighs nothing.
    """
    if not scatterers:
        return _table_of(Molecular())
    whole = sum(part.coefficient_per_mm for part in scatterers)
    tables = [_table_of(part.phase) for part in scatterers]
    shares = [part.coefficient_per_mm / whole for part in scatterers]
    mixed = sum(share * np.exp(table.log_density) for share, table in zip(shares, tables, strict=True))
    forward = sum(share * table.cumulative[0] for share, table in zip(shares, tables, strict=True))
    return _normalised(np.log(mixed), forward)


def backward_share(table: PhaseTable) -> float:
    """Share scattered by more than 90 deg, b_b / b."""
    return 1 - float(np.interp(math.pi / 2, node_angles(), table.cumulative))


def _table_of(phase: PhaseFunction) -> PhaseTable:
    angle = node_angles()
    # p times 2 pi d(1 - cos) / dx = pi (1 - cos) (1 + cos)
    log_density = np.log(per_sr(phase, angle) * math.pi * np.sin(angle) ** 2)
    if isinstance(phase, FournierForand):
        return _normalised(log_density, _fournier_forand_within(angle[0], phase.index, phase.slope))
    # All others are powers of the angle down there, of which this is the integral.
    return _normalised(log_density, STEP * math.exp(log_density[0]) / (log_density[1] - log_density[0]))


def _normalised(log_density: np.ndarray, forward: float) -> PhaseTable:
    """The table with its own integral, ``forward`` before the first node, brought to 1."""
    slope = np.diff(log_density)
    flat = np.abs(slope) < 1e-12
    mean = np.where(flat, 1.0, np.expm1(slope) / np.where(flat, 1.0, slope))
    cells = STEP * np.exp(log_density[:-1]) * mean
    # A constant p scatters 2 pi p H into the cap of height H = 1 + cos; p is the density / (pi H (2 - H)).
    backward = 2 * math.exp(log_density[-1]) / (2 - BACKWARD_END)
    below = forward + np.concatenate([[0.0], np.cumsum(cells)])
    whole = below[-1] + backward
    return PhaseTable(log_density - math.log(whole), below / whole)
