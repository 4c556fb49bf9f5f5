"""Scattering in the water: evaluation and sampling of its phase function.

All phase functions are tabulated in one form, computed in double precision by NumPy. With the scattering angle t and h
= sin^2(t / 2), 1 - cos t is 2 h. The table is evenly spaced in x = log(h / (1 - h)) = 2 log tan(t / 2), which resolves
both a forward and a backward peak.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import drjit as dr
import mitsuba as mi
import numpy as np

from twin.backend.arrays import Bool, Float, UInt32, Vector3f, opaque, to_jit
from uwlts.model.phase_functions import Molecular, PhaseFunction, Scatterer
from uwlts.model.sensor import Medium

NODES = 4096  # of a table, 0.4 % apart in angle below 90 deg
FORWARD_END = 1e-10  # below this 1 - cos (1.4e-5 rad) the tables are constant, at a height that preserves the integral
BACKWARD_END = 2.0**-17
"""Below this 1 + cos (0.22 deg) the tables are constant and continuous, about the resolution of single precision at 2.
"""
FORWARD_SR = 2 * math.pi * FORWARD_END  # solid angle below the first node
FIRST_PLACE = math.log(FORWARD_END / (2 - FORWARD_END))
STEP = (math.log((2 - BACKWARD_END) / BACKWARD_END) - FIRST_PLACE) / (NODES - 1)  # of the logarithm between nodes


@dataclass(frozen=True)
class PhaseTable:
    """Phase function on the nodes x = `FIRST_PLACE` + i `STEP`, normalised to 1.

    ``log_density`` (NODES,) is the logarithm of the fraction scattered per x, pi p (1 - cos) (1 + cos), with the phase
    function p in 1/sr. It is linear between nodes. ``cumulative`` (NODES,) is the fraction scattered by less than a
    node's angle. Beyond both ends p is constant; forwards it is ``cumulative[0]`` divided by `FORWARD_SR`.
    """

    log_density: np.ndarray
    cumulative: np.ndarray


def node_angles() -> np.ndarray:
    """Return the scattering angles (NODES,) in rad of the tables' nodes."""
    return 2 * np.arctan(np.exp((FIRST_PLACE + STEP * np.arange(NODES)) / 2))


def tabulate_phase_function(scatterers: Sequence[Scatterer]) -> PhaseTable:
    """Tabulate the phase function of a mixture: normalised phase functions weighted by their scattering coefficients.

    Without scatterers, the phase function of molecules is returned; its coefficient is then 0.
    """
    if not scatterers:
        return _make_table(Molecular())
    whole = sum(part.coefficient_per_mm for part in scatterers)
    tables = [_make_table(part.phase) for part in scatterers]
    shares = [part.coefficient_per_mm / whole for part in scatterers]
    mixed = sum(share * np.exp(table.log_density) for share, table in zip(shares, tables, strict=True))
    forward = sum(share * table.cumulative[0] for share, table in zip(shares, tables, strict=True))
    return _normalise(np.log(mixed), forward)


def _make_table(phase: PhaseFunction) -> PhaseTable:
    angle = node_angles()
    # p times 2 pi d(1 - cos) / dx = pi (1 - cos) (1 + cos)
    log_density = np.log(phase.per_sr(angle) * math.pi * np.sin(angle) ** 2)
    forward = phase.share_within(angle[0])
    if forward is None:
        # The integral of a power of the angle.
        forward = STEP * math.exp(log_density[0]) / (log_density[1] - log_density[0])
    return _normalise(log_density, forward)


def _normalise(log_density: np.ndarray, forward: float) -> PhaseTable:
    """Normalise a table to the integral 1; ``forward`` is the integral before the first node."""
    slope = np.diff(log_density)
    flat = np.abs(slope) < 1e-12
    mean = np.where(flat, 1.0, np.expm1(slope) / np.where(flat, 1.0, slope))
    cells = STEP * np.exp(log_density[:-1]) * mean
    # A constant p has the integral 2 pi p H over the cap of height H = 1 + cos; p is the density / (pi H (2 - H)).
    backward = 2 * math.exp(log_density[-1]) / (2 - BACKWARD_END)
    below = forward + np.concatenate([[0.0], np.cumsum(cells)])
    whole = below[-1] + backward
    return PhaseTable(log_density - math.log(whole), below / whole)


class Scattering:
    """Absorption, scattering and phase function of a medium at one wavelength; coefficients in 1/mm.

    ``coefficient`` is b, ``absorption`` a and ``extinction`` c = a + b; ``b`` and ``c`` are opaque copies for kernels.
    ``backward_share`` is the fraction of b at scattering angles above 90 deg. ``angles`` tabulates the phase function,
    ``over_sine`` the phase function divided by the sine of the angle, and ``narrow`` the mean of both densities.
    RangeError if the wavelength is outside the medium's tables.
    """

    def __init__(self, medium: Medium, wavelength_nm: float):
        self.absorption = medium.absorption_per_mm(wavelength_nm)
        self.coefficient = medium.scattering_per_mm(wavelength_nm)
        self.extinction = self.absorption + self.coefficient
        self.b, self.c = opaque(self.coefficient), opaque(self.extinction)
        table = tabulate_phase_function(medium.scatterers(wavelength_nm))
        self.backward_share = 1 - float(np.interp(math.pi / 2, node_angles(), table.cumulative))
        sine = np.sin(node_angles())
        over_sine = _normalise(table.log_density - np.log(sine), float(table.cumulative[0] / sine[0]))
        halves = np.log(0.5 * (np.exp(table.log_density) + np.exp(over_sine.log_density)))
        narrow = _normalise(halves, float(table.cumulative[0] + over_sine.cumulative[0]) / 2)
        self.angles, self.over_sine, self.narrow = AngleTable.join(table, over_sine, narrow)

    def phase(self, one_minus_cosine: Float) -> Float:
        """Return the phase function in 1/sr at 1 - cos of the scattering angle.

        Compute 1 - cos as |w1 - w2|^2 / 2 from the unit directions before and after: 1 minus their scalar product loses
        small angles in single precision.
        """
        return self.angles.density(one_minus_cosine)


@dataclass(frozen=True)
class AngleTable:
    """A `PhaseTable` for kernels: density and sampling of directions about an axis.

    Several tables share the same arrays, each with its own ``start``, so that each direction can use another table.
    """

    log_density: Float
    cumulative: Float
    forward: Float
    start: UInt32

    @classmethod
    def join(cls, *tables: PhaseTable) -> list[AngleTable]:
        """Return tables that share the same arrays."""
        log_density = to_jit(np.concatenate([each.log_density for each in tables]))
        cumulative = to_jit(np.concatenate([each.cumulative for each in tables]))
        return [
            cls(log_density, cumulative, opaque(each.cumulative[0] / FORWARD_SR), mi.UInt32(k * NODES))
            for k, each in enumerate(tables)
        ]

    def select(self, mask: Bool, other: AngleTable) -> AngleTable:
        """Return this table, replaced by ``other``, which shares its arrays, where ``mask`` is True."""
        forward, start = (dr.select(mask, *pair) for pair in ((other.forward, self.forward), (other.start, self.start)))
        return AngleTable(self.log_density, self.cumulative, forward, start)

    def density(self, one_minus_cosine: Float) -> Float:
        """Return the density in 1/sr at 1 - cos of the angle from the axis; it does not depend on azimuth."""
        before = dr.clip(one_minus_cosine, FORWARD_END, 2 - BACKWARD_END)
        cell, share = self._find_cell(before)
        low, high = self._gather_ends(cell)
        density = dr.exp(dr.fma(high - low, share, low)) / (math.pi * before * (2 - before))
        return dr.select(one_minus_cosine < FORWARD_END, self.forward, density)

    def share_below(self, one_minus_cosine: Float) -> Float:
        """Return the cumulative fraction of directions at the table's node at or below 1 - cos of an angle."""
        return self._sum_share(self._find_cell(dr.maximum(one_minus_cosine, FORWARD_END))[0])

    def heights(self, u: Float) -> tuple[Float, Float]:
        """Return 1 - cos and 1 + cos of the angle below which the fraction ``u`` of directions is scattered."""
        node = mi.UInt32(0)
        step = NODES // 2
        while step:
            node = dr.select(self._sum_share(node + step) <= u, node + step, node)
            step //= 2
        cell = dr.minimum(node, NODES - 2)
        below, above = self._sum_share(cell), self._sum_share(cell + 1)
        share = dr.clip((u - below) / (above - below), 0.0, 1.0)
        low, high = self._gather_ends(cell)
        # The density exp(k t), 0 < t < 1, has the inverse log(1 + share (exp(k) - 1)) / k, undefined at k = 0. This is
        # its expansion to third order in k, which is below 0.05.
        k = high - low
        t = share + k * share * (1 - share) * (0.5 + k * (1 - 2 * share) / 6)
        ratio = dr.exp(FIRST_PLACE + STEP * (mi.Float(cell) + t))
        before, after = 2 * ratio / (1 + ratio), 2 / (1 + ratio)
        # Beyond both ends of the table, directions are uniform over a cap.
        first, last = (self._sum_share(mi.UInt32(end)) for end in (0, NODES - 1))
        forward, backward = u < first, u >= last
        before = dr.select(forward, FORWARD_END * u / first, before)
        after = dr.select(backward, BACKWARD_END * (1 - u) / (1 - last), after)
        return dr.select(backward, 2 - after, before), dr.select(forward, 2 - before, after)

    def _find_cell(self, before: Float) -> tuple[UInt32, Float]:
        """Return the cell of 1 - cos, which is within the table, and the position in the cell from 0 to 1."""
        place = (dr.log(before / (2 - before)) - FIRST_PLACE) / STEP
        cell = dr.minimum(mi.UInt32(dr.maximum(place, 0.0)), NODES - 2)
        return cell, place - mi.Float(cell)

    def _gather_ends(self, cell: UInt32) -> tuple[Float, Float]:
        """Return the logarithm of the density at both ends of a cell."""
        place = self.start + cell
        return dr.gather(mi.Float, self.log_density, place), dr.gather(mi.Float, self.log_density, place + 1)

    def _sum_share(self, node: UInt32) -> Float:
        """Return the cumulative fraction of directions at a node."""
        return dr.gather(mi.Float, self.cumulative, self.start + node)


def rotate_about(axis: Vector3f, heights: tuple[Float, Float], u: Float) -> Vector3f:
    """Return directions at angles from an axis, given by 1 - cos and 1 + cos; the azimuth increases with ``u``."""
    before, after = heights
    sine = dr.sqrt(before * after)
    sin_azimuth, cos_azimuth = dr.sincos(2 * math.pi * u)
    direction = mi.Vector3f(sine * cos_azimuth, sine * sin_azimuth, 1 - before)
    return dr.normalize(mi.Frame3f(axis).to_world(direction))


def one_minus_cosine(a: Vector3f, b: Vector3f) -> Float:
    """Return 1 - cos of the angle between unit vectors, accurate for small angles."""
    return 0.5 * dr.squared_norm(a - b)
