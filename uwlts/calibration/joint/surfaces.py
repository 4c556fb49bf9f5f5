"""Surfaces of known kind that stand still during a scan: how far points are from them, and what that depends on."""

from abc import ABC, abstractmethod
from dataclasses import dataclass
from typing import ClassVar

import numpy as np


@dataclass(frozen=True, eq=False)
class Distances:
    """Of points from a surface.

    Attributes
    ----------
    values_mm : (N,)
        Signed, positive on the side of the normals.
    outward : (3, N)
        Unit normals, the derivatives by the points.
    by_own : (N, k)
        Derivatives by the surface's own parameters.
    """

    values_mm: np.ndarray
    outward: np.ndarray
    by_own: np.ndarray


class Surface(ABC):
    """One surface, or several of a kind, all in the camera frame at the stage position 0.

    ``kind`` names what a stripe on it gives; ``own_std`` (k,) is the standard uncertainty of its own parameters before,
    infinite where nothing is known.
    """

    kind: ClassVar[str]

    @property
    def count(self) -> int:
        """How many bodies it consists of."""
        return 1

    @abstractmethod
    def own_std(self) -> np.ndarray: ...

    @abstractmethod
    def distances(self, points: np.ndarray, own: np.ndarray) -> Distances:
        """Of points (3, N) of the scan's pixels, in their order."""

    def known_lengths(self, own: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """What calibrated lengths between its parts are off (c,), in standard uncertainties, and derivatives (c, k)."""
        return np.empty(0), np.empty((0, len(own)))


@dataclass(frozen=True, eq=False)
class Spheres(Surface):
    """S spheres. Own parameters: the centres in mm, then what the diameters are more than ``diameters_mm``.

    Attributes
    ----------
    diameters_mm, diameter_std_mm : (S,)
        As known before; the standard uncertainty is infinite for unknown ones.
    spacings_mm, spacing_std_mm : (S - 1,)
        Distances of consecutive centres, likewise.
    sphere : (N,) int
        On which of them each pixel of the scan lies.
    """

    kind: ClassVar[str] = "stripe on the spheres"

    diameters_mm: np.ndarray
    diameter_std_mm: np.ndarray
    spacings_mm: np.ndarray
    spacing_std_mm: np.ndarray
    sphere: np.ndarray

    @property
    def count(self) -> int:
        return len(self.diameters_mm)

    def own_std(self) -> np.ndarray:
        return np.concatenate([np.full(3 * self.count, np.inf), self.diameter_std_mm])

    def distances(self, points: np.ndarray, own: np.ndarray) -> Distances:
        away = points - self._centres(own)[self.sphere].T
        distance = np.linalg.norm(away, axis=0)
        outward = away / distance
        radius = 0.5 * (self.diameters_mm + own[3 * self.count :])[self.sphere]
        by_own, rows = np.zeros((len(distance), len(own))), np.arange(len(distance))
        for axis in range(3):
            by_own[rows, 3 * self.sphere + axis] = -outward[axis]
        by_own[rows, 3 * self.count + self.sphere] = -0.5
        return Distances(distance - radius, outward, by_own)

    def known_lengths(self, own: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        apart = np.diff(self._centres(own), axis=0)
        length = np.linalg.norm(apart, axis=1)
        by_own = np.zeros((len(length), len(own)))
        for number, unit in enumerate(apart / length[:, None]):
            by_own[number, 3 * number : 3 * number + 6] = np.concatenate([-unit, unit])
        known = np.isfinite(self.spacing_std_mm)
        std = self.spacing_std_mm[known]
        return (length - self.spacings_mm)[known] / std, by_own[known] / std[:, None]

    def _centres(self, own: np.ndarray) -> np.ndarray:
        return own[: 3 * self.count].reshape(-1, 3)


@dataclass(frozen=True, eq=False)
class Plane(Surface):
    """A plane near another. Own parameters: two slopes of its normal, and its distance in mm, from that one's.

    Attributes
    ----------
    point_mm, normal : (3,)
        Of the plane nearby; the distance is that from the point.
    across : (2, 3)
        Unit vectors across the normal and each other, towards which the slopes lean.
    """

    kind: ClassVar[str] = "stripe on the plane"

    point_mm: np.ndarray
    normal: np.ndarray
    across: np.ndarray

    def own_std(self) -> np.ndarray:
        return np.full(3, np.inf)

    def distances(self, points: np.ndarray, own: np.ndarray) -> Distances:
        normal, by_slopes = leaning(self.normal, self.across, own[:2])
        away = points - self.point_mm[:, None]
        by_own = np.column_stack([(by_slopes @ away).T, np.full(points.shape[1], -1.0)])
        return Distances(normal @ away - own[2], np.broadcast_to(normal[:, None], points.shape), by_own)


@dataclass(frozen=True, eq=False)
class Cylinder(Surface):
    """A cylinder near another, seen from outside or inside.

    Own parameters: two shifts of its axis in mm and two slopes of it from that one's, at ``point_mm``, and what the
    diameter is more than ``diameter_mm``.

    Attributes
    ----------
    point_mm, axis : (3,)
        Of the axis nearby.
    across : (2, 3)
        Unit vectors across the axis and each other, along which it shifts and leans.
    diameter_mm, diameter_std_mm : float
        As known before; the standard uncertainty is infinite for an unknown one.
    """

    kind: ClassVar[str] = "stripe on the pipe"

    point_mm: np.ndarray
    axis: np.ndarray
    across: np.ndarray
    diameter_mm: float
    diameter_std_mm: float

    def own_std(self) -> np.ndarray:
        return np.array([*[np.inf] * 4, self.diameter_std_mm])

    def distances(self, points: np.ndarray, own: np.ndarray) -> Distances:
        axis, by_slopes = leaning(self.axis, self.across, own[2:4])
        away = points - (self.point_mm + own[:2] @ self.across)[:, None]
        along = axis @ away
        radial = away - axis[:, None] * along
        distance = np.linalg.norm(radial, axis=0)
        outward = radial / distance
        by_own = np.column_stack(
            [-(self.across @ outward).T, -(along * (by_slopes @ outward)).T, np.full(len(distance), -0.5)]
        )
        return Distances(distance - 0.5 * (self.diameter_mm + own[4]), outward, by_own)


SCANNED = (Spheres.kind, Plane.kind, Cylinder.kind)
"""What residuals on such surfaces are called."""


def leaning(direction: np.ndarray, across: np.ndarray, slopes: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """A unit vector (3,) that leans from a direction by slopes (2,) towards two others (2, 3); its derivatives (2, 3).

    Unit vectors across the direction and each other are expected.
    """
    raw = direction + slopes @ across
    length = np.linalg.norm(raw)
    unit = raw / length
    return unit, (across - np.outer(across @ unit, unit)) / length
