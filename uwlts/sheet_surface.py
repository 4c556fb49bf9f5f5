"""The laser sheet in a medium: a plane, or slightly a cone, turned by the laser's window.

A beam tilted by the angle b into the line optics keeps its component across the fan, so that the rays run on a cone
about the normal: at the distance r from the apex, z of it along the axis, the sheet bulges by b (r - z). A sheet that
meets the laser's window at the angle t to the window's normal is turned by t (1 - 1 / n) in a medium of the index n
(Snell's law). As rays off the axis meet the window at other angles, the sheet then bulges by n b + (n - 1 / n) t times
r - z. All this holds to second order in the rays' angles to the axis, with the shift in the glass left out.
"""

from dataclasses import dataclass

import numpy as np

from uwlts.calibration.model import FanModel, SheetModel

# A bulge is a few hundredths of a millimetre and almost constant along a ray: each round gains three digits or more.
_ROUNDS = 4


@dataclass(frozen=True, eq=False)
class SheetSurface:
    """The points x with ``normal . x - bulge (|x - apex| - axis . (x - apex)) = offset_mm``, camera frame.

    Attributes
    ----------
    normal : (3,)
    offset_mm : float
    bulge : float
    fan : FanModel or None
        Where the apex lies and the axis runs; None for a plane.
    """

    normal: np.ndarray
    offset_mm: float
    bulge: float = 0.0
    fan: FanModel | None = None

    def crossings(self, origins: np.ndarray, directions: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Distances (N,) in mm along rays (3, N) to the surface, and its gradient along the rays there (N,)."""
        along = self.normal @ directions
        reach = (self.offset_mm - self.normal @ origins) / along
        if self.fan is None or self.bulge == 0.0:
            return reach, along
        for _ in range(_ROUNDS):
            points = origins + reach * directions
            slope = np.einsum("in,in->n", self.gradient(points), directions)
            reach = reach - self.miss_mm(points) / slope
        return reach, slope

    def miss_mm(self, points: np.ndarray) -> np.ndarray:
        """How far points (3, N) lie beyond the surface, (N,)."""
        miss = self.normal @ points - self.offset_mm
        return miss if self.fan is None else miss - self.bulge * bulge_reach_mm(points, self.fan)

    def gradient(self, points: np.ndarray) -> np.ndarray:
        """Gradient (3, N) of `miss_mm`."""
        if self.fan is None:
            return np.repeat(self.normal[:, None], points.shape[1], axis=1)
        away = points - np.array(self.fan.apex_mm)[:, None]
        outward = away / np.linalg.norm(away, axis=0)
        return self.normal[:, None] - self.bulge * (outward - np.array(self.fan.axis)[:, None])


def bulge_reach_mm(points: np.ndarray, fan: FanModel) -> np.ndarray:
    """Distance (N,) of points (3, N) from the fan's apex less its part along the axis."""
    away = points - np.array(fan.apex_mm)[:, None]
    return np.linalg.norm(away, axis=0) - np.array(fan.axis) @ away


def sheet_surface(sheet: SheetModel, *, medium_index: float) -> SheetSurface:
    """The sheet in a medium of an index relative to air."""
    normal, fan = np.array(sheet.normal), sheet.fan
    if fan is None:
        return SheetSurface(normal, sheet.offset_mm)
    turn = fan.window_turn_rad * (1.0 - 1.0 / medium_index)
    across = np.cross(np.cross(fan.axis, normal), normal)
    turned = np.cos(turn) * normal + np.sin(turn) * across
    return SheetSurface(
        normal=turned,
        offset_mm=float(sheet.offset_mm + (turned - normal) @ np.array(fan.pivot_mm)),
        bulge=fan.bow_rad * medium_index + fan.window_turn_rad * (medium_index - 1.0 / medium_index),
        fan=fan,
    )
