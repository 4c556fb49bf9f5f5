"""Laser sheet in a medium: a plane or a slightly conical surface, refracted by the laser's window.

A sheet is conical if the beam enters the line optics with a tilt b. A ray at the angle a to the axis then has the
component b (1 - cos a) across the sheet. Let t be the angle between the sheet and the normal of the laser's window.
Refraction divides the component of a ray along the window's face by the medium's index n (Snell's law).

Let r be the distance of a point from the rays' apparent origin, and z its component along the axis. The fraction w of z
is in the medium. The sheet in the medium deviates from a plane by (b (r - q) + t w (z - q)) / n. Here q = r cos a and
q^2 = n^2 z^2 - (n^2 - 1) r^2. The window turns that plane by t (1 - 1 / n). This is exact to first order in b and t;
the offset by the glass is neglected.
"""

from dataclasses import dataclass

import numpy as np

from uwlts.model.calibration import FanModel, SheetModel

# Iterations of `SheetSurface.crossings`. The deviation from the plane is a few hundredths of a millimetre and almost
# constant along a ray, so that each iteration gains at least three digits.
_ROUNDS = 4
# Lower limit of (q / r)^2, for points that a solver may try. Rays behind the window do not reach such points.
_GRAZING = 1e-3


@dataclass(frozen=True, eq=False)
class FanDistances:
    """Distances of points from the apparent origin of a fan in a medium."""

    away: np.ndarray  # (3, N); vectors from the origin to the points
    distance: np.ndarray  # (N,); their lengths r
    along: np.ndarray  # (N,); their components z along the fan's axis
    in_air: np.ndarray  # (N,); the lengths q in air (see the module's description)
    wet: np.ndarray  # (N,); fraction w of ``along`` that is in the medium

    def bulges(self) -> tuple[np.ndarray, np.ndarray]:
        """Return n times the sheet's deviation (N,), (N,) per beam tilt b and per window angle t."""
        return self.distance - self.in_air, self.wet * (self.along - self.in_air)


@dataclass(frozen=True, eq=False)
class SheetSurface:
    """Surface of the sheet in the camera frame, mm: the plane ``normal . x = offset_mm`` plus the fan's deviation.

    ``index`` is the medium's refractive index. Without a ``fan`` the surface is a plane.
    """

    normal: np.ndarray
    offset_mm: float
    index: float = 1.0
    fan: FanModel | None = None

    def is_plane(self) -> bool:
        """Return whether the surface is a plane."""
        return self.fan is None or (self.fan.bow_rad == 0.0 and self.fan.window_turn_rad == 0.0)

    def crossings(self, origins: np.ndarray, directions: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return distances (N,) in mm along rays (3, N) to the surface, and the gradient (N,) along each ray there."""
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
        """Return the signed distances (N,) of points (3, N) from the surface, positive on the side of the normal."""
        miss = self.normal @ points - self.offset_mm
        if (fan := self.fan) is None or self.is_plane():
            return miss
        of_bow, of_turn = fan_distances(points, fan, medium_index=self.index).bulges()
        return miss - (fan.bow_rad * of_bow + fan.window_turn_rad * of_turn) / self.index

    def gradient(self, points: np.ndarray) -> np.ndarray:
        """Return the gradient (3, N) of `miss_mm` at points (3, N)."""
        if (fan := self.fan) is None or self.is_plane():
            return np.repeat(self.normal[:, None], points.shape[1], axis=1)
        found, n = fan_distances(points, fan, medium_index=self.index), self.index
        axis = np.array(fan.axis)[:, None]
        of_air = (n**2 * found.along * axis - (n**2 - 1.0) * found.away) / found.in_air
        of_bow = found.away / found.distance - of_air
        of_turn = found.wet * (axis - of_air) + (1.0 - found.wet) * (1.0 - found.in_air / found.along) * axis
        return self.normal[:, None] - (fan.bow_rad * of_bow + fan.window_turn_rad * of_turn) / n


def fan_distances(points: np.ndarray, fan: FanModel, *, medium_index: float) -> FanDistances:
    """Return the distances of points (3, N) from a fan's apparent origin, which in a medium is behind the true one."""
    axis = np.array(fan.axis)
    behind = medium_index * behind_window_mm(fan)
    away = points - (np.array(fan.pivot_mm) - behind * axis)[:, None]
    along, square = axis @ away, np.einsum("in,in->n", away, away)
    in_air = np.sqrt(np.maximum(medium_index**2 * along**2 - (medium_index**2 - 1.0) * square, _GRAZING * square))
    return FanDistances(away, np.sqrt(square), along, in_air, 1.0 - behind / along)


def behind_window_mm(fan: FanModel) -> float:
    """Return the distance along the axis from the fan's origin to the window's outer face."""
    return float(np.array(fan.axis) @ (np.array(fan.pivot_mm) - np.array(fan.apex_mm)))


def sheet_surface(sheet: SheetModel, *, medium_index: float) -> SheetSurface:
    """Return the surface of a sheet in a medium; the index is relative to air."""
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
