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
    by_local : (N, k)
        Derivatives by the surface's local parameters.
    """

    values_mm: np.ndarray
    outward: np.ndarray
    by_local: np.ndarray


class Surface(ABC):
    """One surface, or several of a kind, all in the camera frame at the stage position 0.

    ``kind`` names what a stripe on it gives; ``local_std`` (k,) is the standard uncertainty of its local parameters
    before, infinite where nothing is known.
    """

    kind: ClassVar[str]

    @property
    def count(self) -> int:
        """How many bodies it consists of."""
        return 1

    @abstractmethod
    def local_std(self) -> np.ndarray: ...

    @abstractmethod
    def distances(self, points: np.ndarray, local: np.ndarray) -> Distances:
        """Of points (3, N) of the scan's pixels, in their order."""

    def known_lengths(self, local: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """What calibrated lengths between its parts are off (c,), in standard uncertainties, and derivatives (c, k)."""
        return np.empty(0), np.empty((0, len(local)))


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

    def local_std(self) -> np.ndarray:
        return np.concatenate([np.full(3 * self.count, np.inf), self.diameter_std_mm])

    def distances(self, points: np.ndarray, local: np.ndarray) -> Distances:
        away = points - self._centres(local)[self.sphere].T
        distance = np.linalg.norm(away, axis=0)
        outward = away / distance
        radius = 0.5 * (self.diameters_mm + local[3 * self.count :])[self.sphere]
        by_local, rows = np.zeros((len(distance), len(local))), np.arange(len(distance))
        for axis in range(3):
            by_local[rows, 3 * self.sphere + axis] = -outward[axis]
        by_local[rows, 3 * self.count + self.sphere] = -0.5
        return Distances(distance - radius, outward, by_local)

    def known_lengths(self, local: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        apart = np.diff(self._centres(local), axis=0)
        length = np.linalg.norm(apart, axis=1)
        by_local = np.zeros((len(length), len(local)))
        for number, unit in enumerate(apart / length[:, None]):
            by_local[number, 3 * number : 3 * number + 6] = np.concatenate([-unit, unit])
        known = np.isfinite(self.spacing_std_mm)
        std = self.spacing_std_mm[known]
        return (length - self.spacings_mm)[known] / std, by_local[known] / std[:, None]

    def _centres(self, local: np.ndarray) -> np.ndarray:
        return local[: 3 * self.count].reshape(-1, 3)


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

    def local_std(self) -> np.ndarray:
        return np.full(3, np.inf)

    def distances(self, points: np.ndarray, local: np.ndarray) -> Distances:
        normal, by_slopes = leaning(self.normal, self.across, local[:2])
        away = points - self.point_mm[:, None]
        by_local = np.column_stack([(by_slopes @ away).T, np.full(points.shape[1], -1.0)])
        return Distances(normal @ away - local[2], np.broadcast_to(normal[:, None], points.shape), by_local)


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

    def local_std(self) -> np.ndarray:
        return np.array([*[np.inf] * 4, self.diameter_std_mm])

    def distances(self, points: np.ndarray, local: np.ndarray) -> Distances:
        axis, by_slopes = leaning(self.axis, self.across, local[2:4])
        away = points - (self.point_mm + local[:2] @ self.across)[:, None]
        along = axis @ away
        radial = away - axis[:, None] * along
        distance = np.linalg.norm(radial, axis=0)
        outward = radial / distance
        by_local = np.column_stack(
            [-(self.across @ outward).T, -(along * (by_slopes @ outward)).T, np.full(len(distance), -0.5)]
        )
        return Distances(distance - 0.5 * (self.diameter_mm + local[4]), outward, by_local)


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
