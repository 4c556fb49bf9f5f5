"""Rays, the pose of the sensor in the scene, and its travel during an exposure."""

from __future__ import annotations

from dataclasses import dataclass

import drjit as dr
import mitsuba as mi
import numpy as np
from scipy.spatial.transform import Rotation

from twin.backend.arrays import Float, Point3f, Vector3f, opaque, opaque_point, opaque_transform


@dataclass(frozen=True)
class Rays:
    """Rays of one frame: origins in mm, unit directions, and what each carries, 0 if a window does not let it pass.

    Of camera rays ``weight`` is the image sensor's irradiance per radiance in sr, of rays through a window their share.
    """

    origin: Point3f
    direction: Vector3f
    weight: Float


@dataclass(frozen=True)
class Travel:
    """Motion of the sensor during an exposure: its OCS goes at a velocity and turns about its origin at a rate.

    ``velocity_mm_s`` (3,) and ``turn_rad_s`` (3,), a rotation vector per second, are in the scene; both are constant.
    Time counts from the pose of the frame, that of ``middle_row``. An image row is exposed from -``exposure_s`` / 2 to
    +``exposure_s`` / 2 about its own middle, which a rolling shutter shifts by ``row_s`` from row to row.
    """

    velocity_mm_s: np.ndarray
    exposure_s: float
    turn_rad_s: np.ndarray | None = None
    row_s: float = 0.0
    middle_row: float = 0.0

    def at(self, row: Float, moment: Float | float) -> Float:
        """Time in s of image rows at a moment of their exposure, from 0 to 1."""
        exposure, per_row = opaque(self.exposure_s), opaque(self.row_s)
        return (row - opaque(self.middle_row)) * per_row + (moment - 0.5) * exposure

    def ends(self, rows: int) -> tuple[float, float]:
        """First and last time in s within a frame of ``rows`` rows."""
        at_edges = [(row - self.middle_row) * self.row_s for row in (0, rows - 1)]
        half = self.exposure_s / 2
        return min(at_edges) - half, max(at_edges) + half

    def fastest_mm_s(self, reach_mm: float) -> float:
        """Largest speed in mm/s of points up to so far from the OCS's origin."""
        turn = 0.0 if self.turn_rad_s is None else float(np.linalg.norm(self.turn_rad_s))
        return float(np.linalg.norm(self.velocity_mm_s)) + turn * reach_mm


class SensorPose:
    """The sensor's OCS in the scene, kept opaque so that moving it never recompiles a kernel."""

    def __init__(self, scene_from_object: np.ndarray, travel: Travel | None = None):
        self.scene_from_object, self.travel = np.asarray(scene_from_object, float), travel
        self._to_scene = opaque_transform(self.scene_from_object)
        self._to_object = opaque_transform(np.linalg.inv(self.scene_from_object))
        self._axis, self._rate = None, 0.0
        if travel is not None:
            # Everything that moves does so in the OCS of the resting sensor.
            into = self.scene_from_object[:3, :3].T
            self._velocity = mi.Vector3f(opaque_point(into @ travel.velocity_mm_s))
            turn = np.zeros(3) if travel.turn_rad_s is None else into @ travel.turn_rad_s
            if rate := float(np.linalg.norm(turn)):
                self._axis, self._rate = mi.Vector3f(opaque_point(turn / rate)), opaque(rate)

    def equals(self, other: SensorPose) -> bool:
        """Whether the sensor stands and travels as at another pose."""
        if not np.array_equal(self.scene_from_object, other.scene_from_object):
            return False
        if self.travel is None or other.travel is None:
            return self.travel is other.travel
        pairs = zip(vars(self.travel).values(), vars(other.travel).values(), strict=True)
        return all(np.array_equal(mine, theirs) for mine, theirs in pairs)

    def moved(self, after_s: float) -> SensorPose:
        """The pose after a time, standing still."""
        assert self.travel is not None
        transform = self.scene_from_object.copy()
        transform[:3, 3] += after_s * self.travel.velocity_mm_s
        if self.travel.turn_rad_s is not None:
            turned = Rotation.from_rotvec(after_s * self.travel.turn_rad_s).as_matrix()
            transform[:3, :3] = turned @ transform[:3, :3]
        return SensorPose(transform)

    def at_rest(self, point: Point3f, after_s: Float | None) -> Point3f:
        """Points of the moving OCS after a time, in the OCS of the resting sensor."""
        if after_s is None:
            return mi.Point3f(point)
        return mi.Point3f(self.direction_at_rest(mi.Vector3f(point), after_s) + self._velocity * after_s)

    def moving(self, point: Point3f, after_s: Float | None) -> Point3f:
        """Points of the OCS of the resting sensor, in the moving OCS after a time."""
        if after_s is None:
            return mi.Point3f(point)
        return mi.Point3f(self.moving_direction(mi.Vector3f(point) - self._velocity * after_s, after_s))

    def direction_at_rest(self, direction: Vector3f, after_s: Float | None) -> Vector3f:
        """Directions of the moving OCS after a time, in the OCS of the resting sensor."""
        return self._turned(direction, after_s, sign=1.0)

    def moving_direction(self, direction: Vector3f, after_s: Float | None) -> Vector3f:
        """Directions of the OCS of the resting sensor, in the moving OCS after a time."""
        return self._turned(direction, after_s, sign=-1.0)

    def _turned(self, vector: Vector3f, after_s: Float | None, *, sign: float) -> Vector3f:
        """Vectors turned by as much as the sensor turns within a time (Rodrigues)."""
        if after_s is None or self._axis is None:
            return mi.Vector3f(vector)
        sine, cosine = dr.sincos(sign * self._rate * after_s)
        along = self._axis * dr.dot(self._axis, vector)
        return along + (vector - along) * cosine + dr.cross(self._axis, vector) * sine

    def ray(self, origin: Point3f, direction: Vector3f, after_s: Float | None = None) -> mi.Ray3f:
        """A ray of the OCS in the scene, as the sensor stands after a time."""
        # A point plus a vector is a vector to Dr.Jit, and vectors are not moved.
        start = self._to_scene @ self.at_rest(origin, after_s)
        return mi.Ray3f(mi.Point3f(start), self.direction(direction, after_s))

    def direction(self, direction: Vector3f, after_s: Float | None = None) -> Vector3f:
        """A direction of the OCS in the scene."""
        # The difference of two points is a point to Dr.Jit, which a transform would also shift.
        return self._to_scene @ self.direction_at_rest(mi.Vector3f(direction), after_s)

    def object_direction(self, direction: Vector3f, after_s: Float | None = None) -> Vector3f:
        """A direction of the scene in the OCS."""
        return self.moving_direction(self._to_object @ mi.Vector3f(direction), after_s)
