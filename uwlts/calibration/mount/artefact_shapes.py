"""Artefacts that a profiler on a platform may observe: detection in a profile, and distances from them.

Each artefact is one class. Its start values are in `start_values`, its stored form in `uwlts.model.mount`. The values
of an artefact form an array; its parameters are steps from these values.
"""

from abc import ABC, abstractmethod
from dataclasses import dataclass
from typing import ClassVar

import numpy as np

from uwlts.model.mount import PlaneFound, SphereFound
from uwlts.optics.window import tilt_direction
from uwlts.shapes.flat import perpendicular_to
from uwlts.shapes.profile_curves import Detection, find_arc, find_line
from uwlts.storage.mount_files import Artefact


@dataclass(frozen=True)
class Shape(ABC):
    """Kind of artefact; points (N, 3) are in the base frame."""

    radius_mm: float | None = None
    """Radius of a sphere, if known."""

    kind: ClassVar[Artefact]
    fewest_poses: ClassVar[int]
    """Number of poses that makes the problem overdetermined, with two or three equations per pose."""
    flat: ClassVar[bool] = True
    """True if profiles contain nearly straight lines, which determine the rotation of a pose."""

    @property
    def radius_unknown(self) -> bool:
        return not self.flat and self.radius_mm is None

    @property
    def count(self) -> int:
        """Number of parameters; an unknown radius is the last one."""
        return 3 + self.radius_unknown

    @abstractmethod
    def find(self, points: np.ndarray, rng: np.random.Generator) -> Detection | None:
        """Find the artefact in a profile (N, 2), or return None."""

    @abstractmethod
    def apply_step(self, values: np.ndarray, step: np.ndarray) -> np.ndarray:
        """Return the values after a step (count,)."""

    @abstractmethod
    def distances(self, values: np.ndarray, points: np.ndarray) -> np.ndarray:
        """Return signed distances (N,)."""

    @abstractmethod
    def normals(self, values: np.ndarray, points: np.ndarray) -> np.ndarray:
        """Return derivatives (N, 3) of the distances by the points."""

    @abstractmethod
    def derivatives(self, values: np.ndarray, points: np.ndarray) -> np.ndarray:
        """Return derivatives (N, count) of the distances by the parameters."""

    @abstractmethod
    def to_stored(self, values: np.ndarray, radius_std_mm: float | None) -> SphereFound | PlaneFound:
        """Return the stored form of the artefact."""


class SphereShape(Shape):
    """Values: centre and radius (4,)."""

    kind, fewest_poses, flat = "sphere", 5, False

    def find(self, points: np.ndarray, rng: np.random.Generator) -> Detection | None:
        return find_arc(points, self.radius_mm, rng)

    def apply_step(self, values: np.ndarray, step: np.ndarray) -> np.ndarray:
        return np.append(values[:3] + step[:3], values[3] + (step[3] if self.radius_unknown else 0.0))

    def distances(self, values: np.ndarray, points: np.ndarray) -> np.ndarray:
        return np.linalg.norm(points - values[:3], axis=1) - values[3]

    def normals(self, values: np.ndarray, points: np.ndarray) -> np.ndarray:
        away = points - values[:3]
        return away / np.linalg.norm(away, axis=1, keepdims=True)

    def derivatives(self, values: np.ndarray, points: np.ndarray) -> np.ndarray:
        by_radius = np.full((len(points), int(self.radius_unknown)), -1.0)
        return np.hstack([-self.normals(values, points), by_radius])

    def to_stored(self, values: np.ndarray, radius_std_mm: float | None) -> SphereFound:
        x, y, z, radius = values.tolist()
        return SphereFound(centre_mm=(x, y, z), radius_mm=radius, radius_std_mm=radius_std_mm)


class PlaneShape(Shape):
    """Values: normal and distance (4,). Parameters: two rotations of the normal, and the distance."""

    kind, fewest_poses = "plane", 8

    def find(self, points: np.ndarray, rng: np.random.Generator) -> Detection | None:
        return find_line(points, rng)

    def apply_step(self, values: np.ndarray, step: np.ndarray) -> np.ndarray:
        return np.append(tilt_direction(values[:3], perpendicular_to(values[:3]), step[:2])[0], values[3] + step[2])

    def distances(self, values: np.ndarray, points: np.ndarray) -> np.ndarray:
        return points @ values[:3] - values[3]

    def normals(self, values: np.ndarray, points: np.ndarray) -> np.ndarray:
        return np.broadcast_to(values[:3], points.shape)

    def derivatives(self, values: np.ndarray, points: np.ndarray) -> np.ndarray:
        return np.column_stack([points @ perpendicular_to(values[:3]).T, np.full(len(points), -1.0)])

    def to_stored(self, values: np.ndarray, radius_std_mm: float | None) -> PlaneFound:
        x, y, z, distance = values.tolist()
        return PlaneFound(normal=(x, y, z), distance_mm=distance)


SHAPES: dict[Artefact, type[Shape]] = {each.kind: each for each in (SphereShape, PlaneShape)}
