"""Camera rays up to the first surface, and on by way of mirrors."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import drjit as dr
import mitsuba as mi

from twin.objects import Objects
from twin.pose import SensorPose
from twin.view import Bundle

_CLEAR_MM = 1e-2
"""Reflected rays start this far from the mirror."""


@dataclass(frozen=True)
class Leg:
    """A stretch of camera rays in the OCS up to a surface, and what lies behind them: weight, and way in mm."""

    origin: mi.Point3f
    direction: mi.Vector3f
    weight: mi.Float
    way: mi.Float
    si: mi.SurfaceInteraction3f
    valid: mi.Bool

    def end(self) -> mi.Point3f:
        """Where the stretch ends, in the OCS."""
        return mi.Point3f(self.origin + self.direction * dr.select(self.valid, self.si.t, 1.0))


def legs(
    objects: Objects,
    extinction: float,
    pose: SensorPose,
    bundle: Bundle,
    travel_mm: mi.Float | None,
    *,
    mirrors: int,
) -> Iterator[Leg]:
    """The first stretch of camera rays, then one for each of up to ``mirrors`` mirrors that they meet in turn."""
    o, d, weight, way = bundle.origin, bundle.direction, bundle.weight, mi.Float(0.0)
    for met in range(mirrors + 1):
        si = objects.scene.ray_intersect(pose.ray(o, d, travel_mm), weight > 0)
        valid = si.is_valid() & (weight > 0)
        yield Leg(o, d, weight, way, si, valid)
        if met < mirrors:
            front = valid & (si.wi.z > 0)
            length = dr.select(valid, si.t, 0.0)
            weight = weight * dr.select(front, objects.mirror_share(si), 0.0) * dr.exp(-extinction * length)
            way = way + length
            d_reflected = pose.object_direction(si.to_world(mi.reflect(si.wi)))
            o = mi.Point3f(o + d * length + d_reflected * _CLEAR_MM)
            d = dr.select(front, d_reflected, d)
