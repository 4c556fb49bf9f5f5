"""Scans of spheres, planes and pipes as evidence: distances of points from the surface, with their derivatives."""

from abc import ABC, abstractmethod
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import ClassVar

import numpy as np

from uwlts.calibration.joint.derivatives import COLUMNS
from uwlts.calibration.joint.evidence import Residuals
from uwlts.calibration.joint.parameters import Parameters, View
from uwlts.model.parameter_keys import StageParameter


@dataclass(frozen=True, eq=False)
class Distances:
    """Of points from a surface.

    Attributes
    ----------
    values_mm : (N,); signed, positive on the side of the normals
    outward : (3, N); unit normals, the derivatives by the points
    by_local : (N, k); derivatives by the surface's local parameters
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
    diameters_mm, diameter_std_mm : (S,); as known before; the standard uncertainty is infinite for unknown ones
    spacings_mm, spacing_std_mm : (S - 1,); distances of consecutive centres, likewise
    sphere : (N,) int; on which of them each pixel of the scan lies
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
    point_mm, normal : (3,); of the plane nearby; the distance is that from the point
    across : (2, 3); unit vectors across the normal and each other, towards which the slopes lean
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
    point_mm, axis : (3,); of the axis nearby
    across : (2, 3); unit vectors across the axis and each other, along which it shifts and leans
    diameter_mm, diameter_std_mm : as known before; the standard uncertainty is infinite for an unknown one
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


SLOPES = (StageParameter.SLOPE_1, StageParameter.SLOPE_2)
"""How far the stage's direction leans from the one described, towards two directions across it."""
# Where the ray's crossing with the sheet moves almost along the surface, a residual in px would be out of all bounds.
_LEAST_SHARE = 0.4


@dataclass(frozen=True, eq=False)
class SurfaceScanEvidence:
    """Stripe pixels on something that stands still while the stage moves the sensor.

    The local parameters are those of the surface, camera frame at the stage position 0, and an error of each of the F
    stage positions.

    Attributes
    ----------
    pixels : (N, 2)
    beside_mm : (3, N); from the sheet's middle to where their light comes from, camera frame; see
        `uwlts.optics.brightness`
    surface : on which they lie
    frame : (N,) int; in which image each lies, from 0
    stage_mm : (F,); positions of the stage
    direction, across_stage : (3,), (2, 3); in which growing positions move the sensor as described, and two directions
        across, orthonormal, camera frame
    across : {0, 1}; the coordinate of the pixel that runs across the stripe
    image : number of the scan's first image among all of scans
    source : name of the capture
    predicted : (N, 2), optional; pixels near those predicted, where rays are taken; as found unless given
    """

    view: View
    pixels: np.ndarray
    beside_mm: np.ndarray
    surface: Surface
    frame: np.ndarray
    stage_mm: np.ndarray
    direction: np.ndarray
    across_stage: np.ndarray
    across: int
    image: int
    source: str
    predicted: np.ndarray | None = None

    def sources(self) -> dict[int, str]:
        """Where each image comes from."""
        return {self.image + n: f"{self.source}, at {position:g} mm" for n, position in enumerate(self.stage_mm)}

    def local_std(self, *, alignment: float, position_mm: float) -> np.ndarray:
        """Standard uncertainty (k + F,) of the local parameters before; infinite where nothing is known."""
        return np.concatenate([self.surface.local_std(), np.full(len(self.stage_mm), position_mm)])

    def residuals(self, parameters: Parameters, global_values: np.ndarray, local: np.ndarray) -> list[Residuals] | None:
        """Those of each image; None where a ray misses the sheet."""
        at_px = self.pixels if self.predicted is None else self.predicted
        points = parameters.on_sheet(global_values, self.view, at_px)
        if points is None:
            return None
        count = len(local) - len(self.stage_mm)
        direction, by_slopes = self._direction(parameters, global_values)
        nominal = self.stage_mm[self.frame]
        travel = nominal * (1.0 + parameters.value(global_values, StageParameter.SCALE)) + local[count:][self.frame]
        off = self.surface.distances(points.points + self.beside_mm + direction[:, None] * travel, local[:count])
        by_rays = np.einsum("in,cin->cn", off.outward, points.by_rays)
        by_global = parameters.by_global(by_rays, self.view, np.einsum("in,cin->cn", off.outward, points.by_sheet))
        by_position = direction @ off.outward
        parameters.add(by_global, StageParameter.SCALE, by_position * nominal)
        for key, by in zip(SLOPES, by_slopes, strict=True):
            parameters.add(by_global, key, (by @ off.outward) * travel)
        column = COLUMNS.index("uv"[self.across])
        least = _LEAST_SHARE * np.linalg.norm(points.by_rays[column], axis=0)
        per_px = np.copysign(np.maximum(np.abs(by_rays[column]), least), by_rays[column])
        values = (self.pixels - at_px)[:, self.across] * (by_rays[column] / per_px) + off.values_mm / per_px
        by_local = np.column_stack([off.by_local, by_position])
        found = []
        for number in np.unique(self.frame):
            here = self.frame == number
            found.append(
                Residuals(
                    kind=self.surface.kind,
                    values=values[here],
                    by_global=by_global[here] / per_px[here, None],
                    by_local=by_local[here] / per_px[here, None],
                    local_columns=np.append(np.arange(count), count + number),
                    image=self.image + int(number),
                )
            )
        return found

    def known_lengths(self, local: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """What calibrated lengths are off (c,), in standard uncertainties, and derivatives (c, k) by the surface's."""
        return self.surface.known_lengths(local[: len(local) - len(self.stage_mm)])

    def linearised(self, residuals: Sequence[Residuals], used: Sequence[np.ndarray]) -> "SurfaceScanEvidence":
        """The same with rays taken at the pixels that these residuals predict, but as found where not ``used`` (n,)."""
        predicted = self.pixels.copy()
        for part, kept in zip(residuals, used, strict=True):
            predicted[self.frame == part.image - self.image, self.across] -= np.where(kept, part.values, 0.0)
        return replace(self, predicted=predicted)

    def moved_direction(self, parameters: Parameters, global_values: np.ndarray) -> np.ndarray:
        """The stage's direction (3,), camera frame."""
        return self._direction(parameters, global_values)[0]

    def _direction(self, parameters: Parameters, global_values: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """The stage's direction (3,) and its derivatives (2, 3) by the slopes."""
        slopes = np.array([parameters.value(global_values, key) for key in SLOPES])
        return leaning(self.direction, self.across_stage, slopes)


def across_of(direction: np.ndarray) -> np.ndarray:
    """Two unit vectors (2, 3) across a direction of the OCS and each other; along Y and Z for a motion along X."""
    second = np.cross((0.0, 0.0, 1.0) if abs(direction[2]) < 0.9 else (1.0, 0.0, 0.0), direction)
    second /= np.linalg.norm(second)
    return np.stack([second, np.cross(direction, second)])
