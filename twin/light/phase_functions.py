"""One table form of all phase functions, from which the renderer evaluates and samples them.

Everything here is float64 NumPy. With the scattering angle t and h = sin^2(t / 2), 1 - cos t is 2 h; the table runs
over x = log(h / (1 - h)) = 2 log tan(t / 2) in even steps, which resolves a peak forwards as well as one backwards.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from uwlts.model.phase_functions import Molecular, PhaseFunction, Scatterer

NODES = 4096
FORWARD_END = 1e-10
"""Below this 1 - cos (1.4e-5 rad) the tables are constant, so high that as much is scattered there as should be."""
BACKWARD_END = 2.0**-17
"""Below this 1 + cos (0.22 deg) the tables are constant and continuous; 32 bits do not resolve much less of 2."""
FORWARD_SR = 2 * math.pi * FORWARD_END
FIRST_PLACE = math.log(FORWARD_END / (2 - FORWARD_END))
STEP = (math.log((2 - BACKWARD_END) / BACKWARD_END) - FIRST_PLACE) / (NODES - 1)


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
    log_density = np.log(phase.per_sr(angle) * math.pi * np.sin(angle) ** 2)
    forward = phase.share_within(angle[0])
    if forward is None:
        # The integral of a power of the angle.
        forward = STEP * math.exp(log_density[0]) / (log_density[1] - log_density[0])
    return _normalised(log_density, forward)


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
