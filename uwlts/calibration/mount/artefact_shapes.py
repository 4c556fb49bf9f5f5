"""Artefacts that a profiler on a platform may observe: detection in a profile, and distances from them.

Each artefact is one class. Its start values are in `start`, its stored form in `uwlts.model.mount`. The values of an
artefact form an array; its parameters are steps from these values.
"""

from abc import ABC, abstractmethod
from collections.abc import Sequence
from dataclasses import dataclass
from typing import ClassVar

import numpy as np

from uwlts.calibration.mount.profiles import Detection, find_arc, find_face, find_line, find_step, find_walls
from uwlts.fitting.shapes import perpendicular_to
from uwlts.model.mount import PlaneFound, RingFound, SphereFound, StepFound
from uwlts.storage.mount_files import Artefact

_FEWEST_WALLS = 5
"""Profiles with a wall of the ring: place and radius are three unknowns, and some profiles are redundant."""


@dataclass(frozen=True)
class Shape(ABC):
    """Kind of artefact, with its size (radius or height, mm) if known.

    Points (N, 3) are in the base frame. ``part`` (N,) is the number of the surface of each point, from 0.
    """

    size_mm: float | None = None

    kind: ClassVar[Artefact]
    fewest_poses: ClassVar[int]
    """Number of poses that makes the problem overdetermined, with two or three equations per pose."""
    flat: ClassVar[bool] = True
    """True if profiles contain nearly straight lines, which determine the rotation of a pose."""
    has_size: ClassVar[bool] = False
    place: ClassVar[int] = 3
    """Number of parameters besides the size."""

    @property
    def size_unknown(self) -> bool:
        return self.has_size and self.size_mm is None

    @property
    def count(self) -> int:
        """Number of parameters; the size is the last one."""
        return self.place + self.size_unknown

    @abstractmethod
    def find(self, points: np.ndarray, rng: np.random.Generator) -> Detection | None:
        """Find the artefact in a profile (N, 2), or return None."""

    def find_again(
        self, points: np.ndarray, off: np.ndarray, reach_mm: float, rng: np.random.Generator
    ) -> Detection | None:
        """Find the artefact in a profile (N, 2) again; ``off`` (N, surfaces) are distances from its estimate."""
        near = off.min(axis=1) < reach_mm
        seen = self.find(points[near], rng)
        return None if seen is None else seen.expand(near)

    @abstractmethod
    def apply_step(self, values: np.ndarray, step: np.ndarray) -> np.ndarray:
        """Return the values after a step (count,)."""

    @abstractmethod
    def distances(self, values: np.ndarray, points: np.ndarray, part: np.ndarray) -> np.ndarray:
        """Return signed distances (N,)."""

    @abstractmethod
    def normals(self, values: np.ndarray, points: np.ndarray, part: np.ndarray) -> np.ndarray:
        """Return derivatives (N, 3) of the distances by the points."""

    @abstractmethod
    def derivatives(self, values: np.ndarray, points: np.ndarray, part: np.ndarray) -> np.ndarray:
        """Return derivatives (N, count) of the distances by the parameters."""

    @abstractmethod
    def to_stored(
        self, values: np.ndarray, size_std_mm: float | None
    ) -> SphereFound | PlaneFound | StepFound | RingFound:
        """Return the stored form of the artefact."""

    def surface_distances(self, values: np.ndarray, points: np.ndarray) -> np.ndarray:
        """Return absolute distances (N, surfaces) from every surface."""
        parts = [np.full(len(points), part) for part in range(self.surfaces)]
        return np.abs(np.column_stack([self.distances(values, points, part) for part in parts]))

    surfaces: ClassVar[int] = 1

    def describe_missing(self, parts: Sequence[np.ndarray]) -> str | None:
        """Return a message if too few profiles show a surface; ``parts`` has the surface numbers of each profile."""
        return None

    def group_parallel(self, part: np.ndarray) -> list[np.ndarray]:
        """Return masks (n,) of the points on surfaces that the sheet cuts in parallel lines."""
        return [np.ones(len(part), dtype=bool)]

    def basis_lines(self, along: np.ndarray, part: np.ndarray) -> np.ndarray:
        """Return basis functions (n, K) of the noise-free changes of a profile, at ``along`` (n,) its surfaces, mm."""
        return np.column_stack([np.ones(len(along)), along])


class SphereShape(Shape):
    """Values: centre and radius (4,)."""

    kind, fewest_poses, flat, has_size = "sphere", 5, False, True

    def find(self, points: np.ndarray, rng: np.random.Generator) -> Detection | None:
        return find_arc(points, self.size_mm, rng)

    def apply_step(self, values: np.ndarray, step: np.ndarray) -> np.ndarray:
        return np.append(values[:3] + step[:3], values[3] + (step[3] if self.size_unknown else 0.0))

    def distances(self, values: np.ndarray, points: np.ndarray, part: np.ndarray) -> np.ndarray:
        return np.linalg.norm(points - values[:3], axis=1) - values[3]

    def normals(self, values: np.ndarray, points: np.ndarray, part: np.ndarray) -> np.ndarray:
        away = points - values[:3]
        return away / np.linalg.norm(away, axis=1, keepdims=True)

    def derivatives(self, values: np.ndarray, points: np.ndarray, part: np.ndarray) -> np.ndarray:
        by_radius = np.full((len(points), int(self.size_unknown)), -1.0)
        return np.hstack([-self.normals(values, points, part), by_radius])

    def to_stored(self, values: np.ndarray, size_std_mm: float | None) -> SphereFound:
        x, y, z, radius = values.tolist()
        return SphereFound(centre_mm=(x, y, z), radius_mm=radius, radius_std_mm=size_std_mm)


class PlaneShape(Shape):
    """Values: normal and distance (4,). Parameters: two rotations of the normal, and the distance."""

    kind, fewest_poses = "plane", 8

    def find(self, points: np.ndarray, rng: np.random.Generator) -> Detection | None:
        return find_line(points, rng)

    def apply_step(self, values: np.ndarray, step: np.ndarray) -> np.ndarray:
        return np.append(_rotate_normal(values[:3], step[:2]), values[3] + step[2])

    def distances(self, values: np.ndarray, points: np.ndarray, part: np.ndarray) -> np.ndarray:
        return points @ values[:3] - values[3]

    def normals(self, values: np.ndarray, points: np.ndarray, part: np.ndarray) -> np.ndarray:
        return np.broadcast_to(values[:3], points.shape)

    def derivatives(self, values: np.ndarray, points: np.ndarray, part: np.ndarray) -> np.ndarray:
        return np.column_stack([points @ perpendicular_to(values[:3]).T, np.full(len(points), -1.0)])

    def to_stored(self, values: np.ndarray, size_std_mm: float | None) -> PlaneFound | StepFound:
        x, y, z, distance = values.tolist()
        return PlaneFound(normal=(x, y, z), distance_mm=distance)


class StepShape(PlaneShape):
    """Values (5,): normal and distance of the face at smaller z, and the offset of the other face along the normal."""

    kind, has_size, surfaces = "step", True, 2

    def find(self, points: np.ndarray, rng: np.random.Generator) -> Detection | None:
        return find_step(points, self.size_mm, rng)

    def apply_step(self, values: np.ndarray, step: np.ndarray) -> np.ndarray:
        return np.append(super().apply_step(values[:4], step), values[4] + (step[3] if self.size_unknown else 0.0))

    def distances(self, values: np.ndarray, points: np.ndarray, part: np.ndarray) -> np.ndarray:
        return super().distances(values, points, part) - values[4] * part

    def derivatives(self, values: np.ndarray, points: np.ndarray, part: np.ndarray) -> np.ndarray:
        by_plane = super().derivatives(values, points, part)
        return np.column_stack([by_plane, -part]) if self.size_unknown else by_plane

    def basis_lines(self, along: np.ndarray, part: np.ndarray) -> np.ndarray:
        return np.column_stack([super().basis_lines(along, part), part])

    def to_stored(self, values: np.ndarray, size_std_mm: float | None) -> StepFound:
        x, y, z, distance, height = values.tolist()
        return StepFound(normal=(x, y, z), distance_mm=distance, height_mm=height, height_std_mm=size_std_mm)


class RingShape(Shape):
    """Cylindrical wall and a face perpendicular to its axis. Values (7,): axis, centre on the face, radius.

    Parameters: two rotations of the axis about the centre, the centre, and the radius. Part 0 is the face; each
    contiguous run of points on the wall is a separate part.
    """

    kind, fewest_poses, has_size, place, surfaces = "ring", 8, True, 5, 2

    def find(self, points: np.ndarray, rng: np.random.Generator) -> Detection | None:
        return find_face(points, rng)

    def find_again(
        self, points: np.ndarray, off: np.ndarray, reach_mm: float, rng: np.random.Generator
    ) -> Detection | None:
        near = off[:, 0] < reach_mm
        face = find_line(points[near], rng)
        if face is None:
            return None
        # Edges of a ring are chamfered: points near both surfaces are on neither.
        walls = find_walls(points, (off[:, 1] < reach_mm) & (off[:, 0] > 2 * reach_mm))
        return face.expand(near).with_parts(walls)

    def apply_step(self, values: np.ndarray, step: np.ndarray) -> np.ndarray:
        radius = values[6] + (step[5] if self.size_unknown else 0.0)
        return np.concatenate([_rotate_normal(values[:3], step[:2]), values[3:6] + step[2:5], [radius]])

    def _radial(self, values: np.ndarray, points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return heights (N,) above the face, and perpendicular vectors (N, 3) from the axis."""
        away = points - values[3:6]
        height = away @ values[:3]
        return height, away - np.outer(height, values[:3])

    def distances(self, values: np.ndarray, points: np.ndarray, part: np.ndarray) -> np.ndarray:
        height, radial = self._radial(values, points)
        return np.where(part == 0, height, np.linalg.norm(radial, axis=1) - values[6])

    def normals(self, values: np.ndarray, points: np.ndarray, part: np.ndarray) -> np.ndarray:
        _, radial = self._radial(values, points)
        outwards = radial / np.maximum(np.linalg.norm(radial, axis=1, keepdims=True), 1e-9)
        return np.where((part == 0)[:, None], values[:3], outwards)

    def derivatives(self, values: np.ndarray, points: np.ndarray, part: np.ndarray) -> np.ndarray:
        height, radial = self._radial(values, points)
        normals = self.normals(values, points, part)
        # The distance r from the axis has r^2 = |q|^2 - h^2 with h = n q; its derivative by n is -h q / r.
        arms = np.where((part == 0)[:, None], radial, -height[:, None] * normals)
        by_radius = -(part > 0).astype(np.float64)[:, None][:, : int(self.size_unknown)]
        return np.hstack([arms @ perpendicular_to(values[:3]).T, -normals, by_radius])

    def describe_missing(self, parts: Sequence[np.ndarray]) -> str | None:
        walls = sum(bool(part.any()) for part in parts)
        if walls >= _FEWEST_WALLS:
            return None
        return (
            f"{walls} of {len(parts)} profiles show a wall of radius {self.size_mm:g} mm square to the ring's face; at "
            f"least {_FEWEST_WALLS} are needed: tilt the sensor so that the sheet meets the wall, and check the radius"
        )

    def group_parallel(self, part: np.ndarray) -> list[np.ndarray]:
        return [part == run for run in np.unique(part)]

    def basis_lines(self, along: np.ndarray, part: np.ndarray) -> np.ndarray:
        columns = []
        for run in np.unique(part):
            # A wall that the sheet cuts along its axis is straight, any other is curved.
            columns += [(part == run) * along**power for power in range(2 if run == 0 else 3)]
        return np.column_stack(columns)

    def to_stored(self, values: np.ndarray, size_std_mm: float | None) -> RingFound:
        a, b, c, x, y, z, radius = values.tolist()
        return RingFound(axis=(a, b, c), centre_mm=(x, y, z), radius_mm=radius, radius_std_mm=size_std_mm)


SHAPES: dict[Artefact, type[Shape]] = {each.kind: each for each in (SphereShape, PlaneShape, StepShape, RingShape)}


def _rotate_normal(normal: np.ndarray, step: np.ndarray) -> np.ndarray:
    turned = normal + step @ perpendicular_to(normal)
    return turned / np.linalg.norm(turned)
