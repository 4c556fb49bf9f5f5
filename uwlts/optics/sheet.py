"""The laser sheet in a medium: a plane, or slightly a cone, turned by the laser's window.

A ray at the angle a to the axis leaves a sheet whose beam enters the line optics tilted by the angle b with the part
b (1 - cos a) across it; the laser's window, at the angle t to the sheet, keeps what runs along its face, divided by the
medium's index n (Snell's law). At the distance r from where the rays seem to come from, z of it along the axis, the
sheet in the medium therefore lies off a plane by (b (r - q) + t w (z - q)) / n, where q = r cos a follows from
q^2 = n^2 z^2 - (n^2 - 1) r^2, and w is the share of z that lies behind the window; and that plane is turned by
t (1 - 1 / n) about the window. This holds to first order in b and t; what the glass shifts is left out.
"""

from dataclasses import dataclass

import numpy as np

from uwlts.model.calibration import FanModel, SheetModel

# A bulge is a few hundredths of a millimetre and almost constant along a ray: each round gains three digits or more.
_ROUNDS = 4
# No ray that has passed the window runs there; the square of q / r of points that a search may try.
_GRAZING = 1e-3


@dataclass(frozen=True, eq=False)
class FanDistances:
    """Distances (N,) of points from the apparent origin of a fan in a medium: all, along the axis, and q.

    ``away`` (3, N) are the points from there, and ``wet`` is the share of the distance along that is in the medium.
    """

    away: np.ndarray
    all: np.ndarray
    along: np.ndarray
    in_air: np.ndarray
    wet: np.ndarray

    def bulges(self) -> tuple[np.ndarray, np.ndarray]:
        """Factors (N,), (N,) of the beam's tilt and the window's turn, over the index."""
        return self.all - self.in_air, self.wet * (self.along - self.in_air)


@dataclass(frozen=True, eq=False)
class SheetSurface:
    """Points that the sheet lights, camera frame, mm: the plane ``normal . x = offset_mm`` and the bulge of the fan.

    ``index`` is that of the medium; without a ``fan`` the surface is a plane.
    """

    normal: np.ndarray
    offset_mm: float
    index: float = 1.0
    fan: FanModel | None = None

    def is_plane(self) -> bool:
        """Whether nothing bends the sheet."""
        return self.fan is None or (self.fan.bow_rad == 0.0 and self.fan.window_turn_rad == 0.0)

    def crossings(self, origins: np.ndarray, directions: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Distances (N,) in mm along rays (3, N) to the surface, and its gradient along the rays there (N,)."""
        along = self.normal @ directions
        reach = (self.offset_mm - self.normal @ origins) / along
        if self.is_plane():
            return reach, along
        slope = along
        for _ in range(_ROUNDS):
            points = origins + reach * directions
            slope = np.einsum("in,in->n", self.gradient(points), directions)
            reach = reach - self.miss_mm(points) / slope
        return reach, slope

    def miss_mm(self, points: np.ndarray) -> np.ndarray:
        """Distances (N,) of points (3, N) beyond the surface."""
        miss = self.normal @ points - self.offset_mm
        if (fan := self.fan) is None or self.is_plane():
            return miss
        of_bow, of_turn = fan_distances(points, fan, medium_index=self.index).bulges()
        return miss - (fan.bow_rad * of_bow + fan.window_turn_rad * of_turn) / self.index

    def gradient(self, points: np.ndarray) -> np.ndarray:
        """Gradient (3, N) of `miss_mm`."""
        if (fan := self.fan) is None or self.is_plane():
            return np.repeat(self.normal[:, None], points.shape[1], axis=1)
        at, n = fan_distances(points, fan, medium_index=self.index), self.index
        axis = np.array(fan.axis)[:, None]
        of_air = (n**2 * at.along * axis - (n**2 - 1.0) * at.away) / at.in_air
        of_bow = at.away / at.all - of_air
        of_turn = at.wet * (axis - of_air) + (1.0 - at.wet) * (1.0 - at.in_air / at.along) * axis
        return self.normal[:, None] - (fan.bow_rad * of_bow + fan.window_turn_rad * of_turn) / n


def fan_distances(points: np.ndarray, fan: FanModel, *, medium_index: float) -> FanDistances:
    """Distances of points (3, N); in a medium a fan seems to begin farther away than it does."""
    axis = np.array(fan.axis)
    behind = medium_index * behind_window_mm(fan)
    away = points - (np.array(fan.pivot_mm) - behind * axis)[:, None]
    along, square = axis @ away, np.einsum("in,in->n", away, away)
    in_air = np.sqrt(np.maximum(medium_index**2 * along**2 - (medium_index**2 - 1.0) * square, _GRAZING * square))
    return FanDistances(away, np.sqrt(square), along, in_air, 1.0 - behind / along)


def behind_window_mm(fan: FanModel) -> float:
    """Distance from the fan's origin to the window's outer face, along its axis."""
    return float(np.array(fan.axis) @ (np.array(fan.pivot_mm) - np.array(fan.apex_mm)))


def sheet_surface(sheet: SheetModel, *, medium_index: float) -> SheetSurface:
    """The sheet in a medium of an index relative to air."""
    normal, fan = np.array(sheet.normal), sheet.fan
    if fan is None:
        return SheetSurface(normal, sheet.offset_mm)
    turn = fan.window_turn_rad * (1.0 - 1.0 / medium_index)
    axis = np.array(fan.axis)
    # (axis x normal) x normal
    across = (axis @ normal) * normal - (normal @ normal) * axis
    turned = np.cos(turn) * normal + np.sin(turn) * across
    return SheetSurface(
        normal=turned,
        offset_mm=float(sheet.offset_mm + (turned - normal) @ np.array(fan.pivot_mm)),
        index=medium_index,
        fan=fan,
    )
