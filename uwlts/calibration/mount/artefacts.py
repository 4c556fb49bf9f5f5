"""The artefacts that a profiler on a platform may look at: where they are in a profile, and distances from them.

Each kind is one class: with its start (`start`) and what is stored of it (`uwlts.model.mount`) it is complete.
Values of an artefact are an array; its parameters are steps from them.
"""

from abc import ABC, abstractmethod
from collections.abc import Sequence
from dataclasses import dataclass
from typing import ClassVar

import numpy as np

from uwlts.calibration.mount.profiles import Seen, find_arc, find_face, find_line, find_step, find_walls
from uwlts.model.mount import PlaneFound, RingFound, SphereFound, StepFound
from uwlts.storage.mount_files import Artefact

_FEWEST_WALLS = 5
"""Profiles with a ring's wall: for its place and radius, three unknowns, with some over."""


@dataclass(frozen=True)
class Shape(ABC):
    """A kind of artefact, and its size (radius or height) where that is known, mm.

    Points (N, 3) are those of the base frame. ``part`` (N,) says on which surface each lies, 0 for the first.
    """

    size_mm: float | None = None

    kind: ClassVar[Artefact]
    fewest_poses: ClassVar[int]
    """Poses whose profiles have more numbers (three each, or two) than there are unknowns, with some over."""
    flat: ClassVar[bool] = True
    """Whether profiles show straight or nearly straight lines, which say how a pose is turned."""
    has_size: ClassVar[bool] = False
    place: ClassVar[int] = 3
    """Number of parameters besides the size."""

    @property
    def size_unknown(self) -> bool:
        return self.has_size and self.size_mm is None

    @property
    def count(self) -> int:
        """Number of parameters; that of the size is the last."""
        return self.place + self.size_unknown

    @abstractmethod
    def find(self, points: np.ndarray, rng: np.random.Generator) -> Seen | None:
        """The artefact in a profile (N, 2), or None."""

    def find_again(self, points: np.ndarray, off: np.ndarray, reach_mm: float, rng: np.random.Generator) -> Seen | None:
        """The artefact in a profile (N, 2) whose points are ``off`` (N, surfaces) from it as other poses show it."""
        near = off.min(axis=1) < reach_mm
        seen = self.find(points[near], rng)
        return None if seen is None else seen.among(near)

    @abstractmethod
    def stepped(self, values: np.ndarray, step: np.ndarray) -> np.ndarray:
        """Values after a step (count,)."""

    @abstractmethod
    def distances(self, values: np.ndarray, points: np.ndarray, part: np.ndarray) -> np.ndarray:
        """Signed distances (N,)."""

    @abstractmethod
    def normals(self, values: np.ndarray, points: np.ndarray, part: np.ndarray) -> np.ndarray:
        """Derivatives (N, 3) of the distances by the points."""

    @abstractmethod
    def derivatives(self, values: np.ndarray, points: np.ndarray, part: np.ndarray) -> np.ndarray:
        """Derivatives (N, count) of the distances by the parameters."""

    @abstractmethod
    def found(self, values: np.ndarray, size_std_mm: float | None) -> SphereFound | PlaneFound | StepFound | RingFound:
        """What is stored."""

    def off(self, values: np.ndarray, points: np.ndarray) -> np.ndarray:
        """Distances (N, surfaces) from all surfaces."""
        parts = [np.full(len(points), part) for part in range(self.surfaces)]
        return np.abs(np.column_stack([self.distances(values, points, part) for part in parts]))

    surfaces: ClassVar[int] = 1

    def missing(self, parts: Sequence[np.ndarray]) -> str | None:
        """What too few profiles show, in words, or None; given the surfaces of the points of each."""
        return None

    def parallel(self, part: np.ndarray) -> list[np.ndarray]:
        """Masks (n,) of the points on surfaces that a sheet cuts in parallel lines."""
        return [np.ones(len(part), dtype=bool)]

    def lines(self, along: np.ndarray, part: np.ndarray) -> np.ndarray:
        """Columns (n, K) of what can change in a profile besides noise, for points ``along`` its surfaces (n,), mm."""
        return np.column_stack([np.ones(len(along)), along])


class SphereShape(Shape):
    """Values: centre and radius (4,)."""

    kind, fewest_poses, flat, has_size = "sphere", 5, False, True

    def find(self, points: np.ndarray, rng: np.random.Generator) -> Seen | None:
        return find_arc(points, self.size_mm, rng)

    def stepped(self, values: np.ndarray, step: np.ndarray) -> np.ndarray:
        return np.append(values[:3] + step[:3], values[3] + (step[3] if self.size_unknown else 0.0))

    def distances(self, values: np.ndarray, points: np.ndarray, part: np.ndarray) -> np.ndarray:
        return np.linalg.norm(points - values[:3], axis=1) - values[3]

    def normals(self, values: np.ndarray, points: np.ndarray, part: np.ndarray) -> np.ndarray:
        away = points - values[:3]
        return away / np.linalg.norm(away, axis=1, keepdims=True)

    def derivatives(self, values: np.ndarray, points: np.ndarray, part: np.ndarray) -> np.ndarray:
        by_radius = np.full((len(points), int(self.size_unknown)), -1.0)
        return np.hstack([-self.normals(values, points, part), by_radius])

    def found(self, values: np.ndarray, size_std_mm: float | None) -> SphereFound:
        x, y, z, radius = values.tolist()
        return SphereFound(centre_mm=(x, y, z), radius_mm=radius, radius_std_mm=size_std_mm)


class PlaneShape(Shape):
    """Values: normal and distance (4,). Parameters: two turns of the normal, and the distance."""

    kind, fewest_poses = "plane", 8

    def find(self, points: np.ndarray, rng: np.random.Generator) -> Seen | None:
        return find_line(points, rng)

    def stepped(self, values: np.ndarray, step: np.ndarray) -> np.ndarray:
        return np.append(_turned(values[:3], step[:2]), values[3] + step[2])

    def distances(self, values: np.ndarray, points: np.ndarray, part: np.ndarray) -> np.ndarray:
        return points @ values[:3] - values[3]

    def normals(self, values: np.ndarray, points: np.ndarray, part: np.ndarray) -> np.ndarray:
        return np.broadcast_to(values[:3], points.shape)

    def derivatives(self, values: np.ndarray, points: np.ndarray, part: np.ndarray) -> np.ndarray:
        return np.column_stack([points @ square_to(values[:3]).T, np.full(len(points), -1.0)])

    def found(self, values: np.ndarray, size_std_mm: float | None) -> PlaneFound | StepFound:
        x, y, z, distance = values.tolist()
        return PlaneFound(normal=(x, y, z), distance_mm=distance)


class StepShape(PlaneShape):
    """Values: normal and distance of the face at smaller z of the profiles, and how far along the normal the other lies
    (5,)."""

    kind, has_size, surfaces = "step", True, 2

    def find(self, points: np.ndarray, rng: np.random.Generator) -> Seen | None:
        return find_step(points, self.size_mm, rng)

    def stepped(self, values: np.ndarray, step: np.ndarray) -> np.ndarray:
        return np.append(super().stepped(values[:4], step), values[4] + (step[3] if self.size_unknown else 0.0))

    def distances(self, values: np.ndarray, points: np.ndarray, part: np.ndarray) -> np.ndarray:
        return super().distances(values, points, part) - values[4] * part

    def derivatives(self, values: np.ndarray, points: np.ndarray, part: np.ndarray) -> np.ndarray:
        by_plane = super().derivatives(values, points, part)
        return np.column_stack([by_plane, -part]) if self.size_unknown else by_plane

    def lines(self, along: np.ndarray, part: np.ndarray) -> np.ndarray:
        return np.column_stack([super().lines(along, part), part])

    def found(self, values: np.ndarray, size_std_mm: float | None) -> StepFound:
        x, y, z, distance, height = values.tolist()
        return StepFound(normal=(x, y, z), distance_mm=distance, height_mm=height, height_std_mm=size_std_mm)


class RingShape(Shape):
    """A cylinder's wall and a face square to its axis. Values: axis, centre on the face, radius (7,).

    Parameters: two turns of the axis about the centre, the centre, and the radius. Part 0 is the face; each run of
    points on the wall is a part of its own.
    """

    kind, fewest_poses, has_size, place, surfaces = "ring", 8, True, 5, 2

    def find(self, points: np.ndarray, rng: np.random.Generator) -> Seen | None:
        return find_face(points, rng)

    def find_again(self, points: np.ndarray, off: np.ndarray, reach_mm: float, rng: np.random.Generator) -> Seen | None:
        near = off[:, 0] < reach_mm
        face = find_line(points[near], rng)
        if face is None:
            return None
        # Edges of a ring are broken: points near both surfaces lie on neither.
        walls = find_walls(points, (off[:, 1] < reach_mm) & (off[:, 0] > 2 * reach_mm))
        return face.among(near).with_parts(walls)

    def stepped(self, values: np.ndarray, step: np.ndarray) -> np.ndarray:
        radius = values[6] + (step[5] if self.size_unknown else 0.0)
        return np.concatenate([_turned(values[:3], step[:2]), values[3:6] + step[2:5], [radius]])

    def _radial(self, values: np.ndarray, points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Heights (N,) over the face, and vectors (N, 3) from the axis square to it."""
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
        # The distance from the axis r has r^2 = |q|^2 - h^2 and h = n q: it changes by -h q / r where n turns.
        arms = np.where((part == 0)[:, None], radial, -height[:, None] * normals)
        by_radius = -(part > 0).astype(np.float64)[:, None][:, : int(self.size_unknown)]
        return np.hstack([arms @ square_to(values[:3]).T, -normals, by_radius])

    def missing(self, parts: Sequence[np.ndarray]) -> str | None:
        walls = sum(bool(part.any()) for part in parts)
        if walls >= _FEWEST_WALLS:
            return None
        size = "" if self.size_mm is None else f" of radius {self.size_mm:g} mm"
        return (
            f"{walls} of {len(parts)} profiles show a wall{size} square to the ring's face; at least {_FEWEST_WALLS} "
            "are needed: tilt the sensor so that the sheet meets the wall"
        )

    def parallel(self, part: np.ndarray) -> list[np.ndarray]:
        return [part == run for run in np.unique(part)]

    def lines(self, along: np.ndarray, part: np.ndarray) -> np.ndarray:
        columns = []
        for run in np.unique(part):
            # A wall that the sheet cuts along its axis is straight, any other bent.
            columns += [(part == run) * along**power for power in range(2 if run == 0 else 3)]
        return np.column_stack(columns)

    def found(self, values: np.ndarray, size_std_mm: float | None) -> RingFound:
        a, b, c, x, y, z, radius = values.tolist()
        return RingFound(axis=(a, b, c), centre_mm=(x, y, z), radius_mm=radius, radius_std_mm=size_std_mm)


SHAPES: dict[Artefact, type[Shape]] = {each.kind: each for each in (SphereShape, PlaneShape, StepShape, RingShape)}


def square_to(normal: np.ndarray) -> np.ndarray:
    """Unit directions (2, 3) square to a normal and to each other."""
    first = np.cross(normal, np.eye(3)[np.argmin(np.abs(normal))])
    first /= np.linalg.norm(first)
    return np.array([first, np.cross(normal, first)])


def _turned(normal: np.ndarray, step: np.ndarray) -> np.ndarray:
    turned = normal + step @ square_to(normal)
    return turned / np.linalg.norm(turned)
