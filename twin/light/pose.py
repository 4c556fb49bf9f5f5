"""Rays, the pose of the sensor in the scene, and its motion during an exposure."""

from __future__ import annotations

from dataclasses import dataclass, field

import drjit as dr
import mitsuba as mi
import numpy as np
from scipy.spatial.transform import Rotation

from twin.backend.arrays import Float, Point3f, Vector3f, opaque, opaque_point, opaque_transform

CLEAR_MM = 1e-2  # offset of rays from the surface they start on, which prevents an intersection with it


@dataclass(frozen=True)
class Rays:
    """Rays of one frame: origins in mm, unit directions, and weights, which are 0 for rays that a window blocks.

    The weight of a camera ray is image irradiance divided by radiance, in sr. The weight of a laser ray is the
    transmitted fraction.
    """

    origin: Point3f
    direction: Vector3f
    weight: Float


@dataclass(frozen=True)
class Travel:
    """Motion of the sensor during an exposure: its OCS translates at a velocity and rotates about its origin.

    ``velocity_mm_s`` (3,) and ``turn_rad_s`` (3,), a rotation vector per second, are constant and in scene coordinates.
    Time is relative to the pose of the frame, that of ``middle_row``. Each image row is exposed for ``exposure_s``,
    centred on its own time. With a rolling shutter, successive rows are ``row_s`` later.
    """

    velocity_mm_s: np.ndarray
    exposure_s: float
    turn_rad_s: np.ndarray = field(default_factory=lambda: np.zeros(3))
    row_s: float = 0.0
    middle_row: float = 0.0

    def compute_times(self, row: Float, moment: Float | float) -> Float:
        """Return the time in s of image rows at a fraction ``moment`` (0 to 1) of their exposure."""
        exposure, per_row = opaque(self.exposure_s), opaque(self.row_s)
        return (row - opaque(self.middle_row)) * per_row + (moment - 0.5) * exposure

    def time_range(self, rows: int) -> tuple[float, float]:
        """Return the first and last time in s of a frame of ``rows`` rows."""
        at_edges = [(row - self.middle_row) * self.row_s for row in (0, rows - 1)]
        half = self.exposure_s / 2
        return min(at_edges) - half, max(at_edges) + half


class SensorPose:
    """Pose of the sensor's OCS in the scene, stored opaquely so that a new pose does not recompile kernels."""

    def __init__(self, scene_from_object: np.ndarray, travel: Travel | None = None):
        self.scene_from_object, self.travel = np.asarray(scene_from_object, float), travel
        self._to_scene = opaque_transform(self.scene_from_object)
        self._to_object = opaque_transform(np.linalg.inv(self.scene_from_object))
        self._axis, self._rate = None, 0.0
        if travel is not None:
            # The motion is expressed in the OCS of the sensor at rest.
            into = self.scene_from_object[:3, :3].T
            self._velocity = mi.Vector3f(opaque_point(into @ travel.velocity_mm_s))
            turn = into @ travel.turn_rad_s
            if rate := float(np.linalg.norm(turn)):
                self._axis, self._rate = mi.Vector3f(opaque_point(turn / rate)), opaque(rate)

    def equals(self, other: SensorPose) -> bool:
        """Return whether pose and motion equal those of ``other``."""
        if not np.array_equal(self.scene_from_object, other.scene_from_object):
            return False
        if self.travel is None or other.travel is None:
            return self.travel is other.travel
        return all(map(np.array_equal, vars(self.travel).values(), vars(other.travel).values()))

    def displace(self, after_s: float) -> SensorPose:
        """Return the pose after a time, without motion."""
        assert self.travel is not None
        transform = self.scene_from_object.copy()
        transform[:3, 3] += after_s * self.travel.velocity_mm_s
        transform[:3, :3] = Rotation.from_rotvec(after_s * self.travel.turn_rad_s).as_matrix() @ transform[:3, :3]
        return SensorPose(transform)

    def to_rest_frame(self, point: Point3f, after_s: Float | None) -> Point3f:
        """Transform points from the moving OCS at a time to the OCS of the sensor at rest."""
        if after_s is None:
            return mi.Point3f(point)
        return mi.Point3f(self.rotate_to_rest_frame(mi.Vector3f(point), after_s) + self._velocity * after_s)

    def to_moving_frame(self, point: Point3f, after_s: Float | None) -> Point3f:
        """Transform points from the OCS of the sensor at rest to the moving OCS at a time."""
        if after_s is None:
            return mi.Point3f(point)
        return mi.Point3f(self.rotate_to_moving_frame(mi.Vector3f(point) - self._velocity * after_s, after_s))

    def rotate_to_rest_frame(self, direction: Vector3f, after_s: Float | None) -> Vector3f:
        """Transform directions from the moving OCS at a time to the OCS of the sensor at rest."""
        return self._rotate(direction, after_s, sign=1.0)

    def rotate_to_moving_frame(self, direction: Vector3f, after_s: Float | None) -> Vector3f:
        """Transform directions from the OCS of the sensor at rest to the moving OCS at a time."""
        return self._rotate(direction, after_s, sign=-1.0)

    def drift(self, point: Point3f, travel: Travel) -> Vector3f:
        """Return the displacement in mm of resting points, seen from the moving OCS, during the exposure of a motion.

        It applies in the middle of the exposure, in the OCS.
        """
        into = self.scene_from_object[:3, :3].T
        way, turn = (
            mi.Vector3f(opaque_point(into @ rate * travel.exposure_s))
            for rate in (travel.velocity_mm_s, travel.turn_rad_s)
        )
        return -(way + dr.cross(turn, mi.Vector3f(point)))

    def _rotate(self, vector: Vector3f, after_s: Float | None, *, sign: float) -> Vector3f:
        """Rotate vectors by the sensor's rotation within a time (Rodrigues' formula)."""
        if after_s is None or self._axis is None:
            return mi.Vector3f(vector)
        sine, cosine = dr.sincos(sign * self._rate * after_s)
        along = self._axis * dr.dot(self._axis, vector)
        return along + (vector - along) * cosine + dr.cross(self._axis, vector) * sine

    def ray(self, origin: Point3f, direction: Vector3f, after_s: Float | None = None) -> mi.Ray3f:
        """Transform a ray from the OCS at a time to the scene."""
        # Dr.Jit returns a vector for a transformed point plus a vector; the conversion restores the point.
        start = self._to_scene @ self.to_rest_frame(origin, after_s)
        return mi.Ray3f(mi.Point3f(start), self.direction(direction, after_s))

    def direction(self, direction: Vector3f, after_s: Float | None = None) -> Vector3f:
        """Transform a direction from the OCS at a time to the scene."""
        # Dr.Jit returns a point for the difference of two points; a transform would translate it.
        return self._to_scene @ self.rotate_to_rest_frame(mi.Vector3f(direction), after_s)

    def object_direction(self, direction: Vector3f, after_s: Float | None = None) -> Vector3f:
        """Transform a direction from the scene to the OCS at a time."""
        return self.rotate_to_moving_frame(self._to_object @ mi.Vector3f(direction), after_s)
