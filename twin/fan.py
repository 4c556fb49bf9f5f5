"""The laser's fan: where its rays run before the window, and how the power is spread over it, looked up or drawn from.

The laser's frame has x along the sheet's normal, y along the fan and z along the laser's axis. A fan ray is told by its
angle in rad, which its projection along x makes with the axis.
"""

from __future__ import annotations

import math

import drjit as dr
import mitsuba as mi
import numpy as np

from twin.arrays import to_jit
from uwlts.sensor import Laser


def half_angle(laser: Laser) -> float:
    """Angle of the fan's edge in rad."""
    return math.radians(laser.fan_angle_deg / 2)


def lit_angles(laser: Laser) -> np.ndarray:
    """Angles (K,) in rad between which the power per angle is smooth; outside the first and the last it is zero."""
    if isinstance(laser.fan_profile, str):
        return np.array([-half_angle(laser), half_angle(laser)])
    return np.radians([angle for angle, _ in laser.fan_profile])


def directions(laser: Laser, angle: np.ndarray) -> np.ndarray:
    """Unit directions (3, N) of fan rays in the laser's frame.

    A beam that enters line optics tilted by alpha leaves them as a cone, whose distance from a straight sheet is
    z tan(alpha) (1 / cos(angle) - 1); the ray in the middle keeps the laser's axis.
    """
    bow = math.tan(math.radians(laser.bow_deg))
    along = np.stack([bow * (1 / np.cos(angle) - 1), np.tan(angle), np.ones_like(angle)])
    return along / np.linalg.norm(along, axis=0)


def power_per_angle(laser: Laser, angle: np.ndarray) -> np.ndarray:
    """Power in W/rad at lit angles (N,), before the window. Its integral over the fan is the laser's power."""
    half = half_angle(laser)
    if laser.fan_profile == "flat":
        relative, total = np.ones_like(angle), 2 * half
    elif laser.fan_profile == "gaussian":
        relative, total = np.exp(-2 * (angle / half) ** 2), half * math.sqrt(math.pi / 2) * math.erf(math.sqrt(2))
    else:
        nodes, powers = lit_angles(laser), [power for _, power in laser.fan_profile]
        relative, total = np.interp(angle, nodes, powers), np.trapezoid(powers, nodes)
    return 1e-3 * laser.power_mw * relative / total


class PowerTable:
    """Power per unit of a coordinate along the fan: linear between even nodes, zero outside them.

    The values lie in arrays, not in the kernel: every profile is looked up, and drawn from, by the same few steps.

    Parameters
    ----------
    nodes
        (N,), evenly spaced and increasing.
    density
        (N,), relative power per unit of the coordinate at the nodes, smooth or not.
    power_w
        What the density is scaled to in total.
    """

    def __init__(self, nodes: np.ndarray, density: np.ndarray, *, power_w: float):
        self._low, self._step, self._cells = float(nodes[0]), float(nodes[1] - nodes[0]), len(nodes) - 1
        share = density / np.trapezoid(density)
        below = np.concatenate([[0.0], np.cumsum(0.5 * (share[1:] + share[:-1]))])
        self._share, self._below = to_jit(mi.Float, share), to_jit(mi.Float, below / below[-1])
        self._power_per_step = power_w / self._step

    def at(self, x: mi.Float) -> mi.Float:
        """Power in W per unit of the coordinate."""
        place = (x - self._low) / self._step
        # What is not a number becomes no index that clipping alone would keep within the table.
        cell = dr.minimum(mi.UInt32(dr.clip(place, 0.0, self._cells - 1.0)), self._cells - 1)
        share = dr.lerp(*self._ends(cell), place - mi.Float(cell))
        return dr.select((place >= 0) & (place <= self._cells), self._power_per_step * share, 0.0)

    def draw(self, u: mi.Float) -> mi.Float:
        """The coordinate below which the share ``u`` of the power lies: even ``u`` give places as dense as the power.

        Within a cell the share a t + (b - a) t^2 / 2 of its ends' densities a and b is solved for t, 0 to 1.
        """
        cell = dr.binary_search(0, self._cells - 1, lambda i: dr.gather(mi.Float, self._below, i + 1) <= u)
        rest = u - dr.gather(mi.Float, self._below, cell)
        a, b = self._ends(cell)
        t = 2 * rest / dr.maximum(a + dr.safe_sqrt(a * a + 2 * (b - a) * rest), 1e-30)
        return self._low + self._step * (mi.Float(cell) + dr.clip(t, 0.0, 1.0))

    def _ends(self, cell: mi.UInt32) -> tuple[mi.Float, mi.Float]:
        return dr.gather(mi.Float, self._share, cell), dr.gather(mi.Float, self._share, cell + 1)
