"""Rays, the pose of the sensor in the scene, and its travel during an exposure."""

from __future__ import annotations

from dataclasses import dataclass

import mitsuba as mi
import numpy as np

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
    """Travel of the sensor along ``direction`` (3,) of the scene, counted from the pose of the frame.

    An image row is exposed from -``exposure_mm`` / 2 to +``exposure_mm`` / 2 about its own middle, which a rolling
    shutter shifts by ``row_mm`` from row to row; the frame's pose is that of ``middle_row``.
    """

    direction: np.ndarray
    exposure_mm: float
    row_mm: float
    middle_row: float

    def at(self, row: Float, moment: Float | float) -> Float:
        """Travel in mm of image rows at a moment of their exposure, from 0 to 1."""
        exposure, per_row = opaque(self.exposure_mm), opaque(self.row_mm)
        return (row - opaque(self.middle_row)) * per_row + (moment - 0.5) * exposure

    def ends(self, rows: int) -> tuple[float, float]:
        """Smallest and largest travel in mm within a frame of ``rows`` rows."""
        at_edges = [(row - self.middle_row) * self.row_mm for row in (0, rows - 1)]
        half = abs(self.exposure_mm) / 2
        return min(at_edges) - half, max(at_edges) + half


class SensorPose:
    """The sensor's OCS in the scene, kept opaque so that moving it never recompiles a kernel."""

    def __init__(self, scene_from_object: np.ndarray, travel: Travel | None = None):
        self.scene_from_object, self.travel = np.asarray(scene_from_object, float), travel
        self._to_scene = opaque_transform(self.scene_from_object)
        self._to_object = opaque_transform(np.linalg.inv(self.scene_from_object))
        if travel is not None:
            self._direction = mi.Vector3f(opaque_point(travel.direction))

    def moved(self, travel_mm: float) -> SensorPose:
        """The pose after a travel, standing still."""
        assert self.travel is not None
        transform = self.scene_from_object.copy()
        transform[:3, 3] += travel_mm * self.travel.direction
        return SensorPose(transform)

    def ray(self, origin: Point3f, direction: Vector3f, travel_mm: Float | None = None) -> mi.Ray3f:
        """A ray of the OCS in the scene, where the sensor has travelled by ``travel_mm``."""
        # A point plus a vector is a vector to Dr.Jit, and vectors are not moved.
        start = self._to_scene @ mi.Point3f(origin)
        if travel_mm is not None:
            start += self._direction * travel_mm
        return mi.Ray3f(mi.Point3f(start), self.direction(direction))

    def direction(self, direction: Vector3f) -> Vector3f:
        """A direction of the OCS in the scene."""
        # The difference of two points is a point to Dr.Jit, which a transform would also shift.
        return self._to_scene @ mi.Vector3f(direction)

    def object_travel(self, travel_mm: Float) -> Vector3f:
        """The sensor's travel as a vector of the OCS."""
        return self.object_direction(self._direction) * travel_mm

    def object_direction(self, direction: Vector3f) -> Vector3f:
        """A direction of the scene in the OCS."""
        return self._to_object @ mi.Vector3f(direction)
