"""Illumination of points before the sensor by its laser sheets, directly or by way of a mirror, with shadows."""

from __future__ import annotations

import math
from collections.abc import Iterable
from dataclasses import dataclass, replace

import drjit as dr
import mitsuba as mi
import numpy as np

from twin.backend.arrays import Bool, Float, Point2f, Point3f, Vector3f, opaque, opaque_transform
from twin.light.pose import Rays, SensorPose
from twin.light.sheet import Sheet, SheetLight
from twin.light.water import AngleTable, one_minus_cosine
from twin.scene.objects import MirrorFace

_CLEAR_MM = 1e-2
"""Rays towards the laser start this far from the surface they leave."""
_LARGEST_SLOPE = 0.7
"""Farther from the sheet than this part of the way to the window, it fills no narrow range of directions."""


class Light:
    """A sheet before a posed scene, directly or by way of one mirror face."""

    def __init__(self, sheet: Sheet, pose: SensorPose, mirror: MirrorFace | None = None):
        self.sheet, self._pose, self._mirror = sheet, pose, mirror
        self.power_w, own = opaque(sheet.power_w), sheet.own_from_object
        if mirror is not None:
            object_from_face = np.linalg.inv(pose.scene_from_object) @ mirror.pose
            reflection = object_from_face @ np.diag([1.0, 1.0, -1.0, 1.0]) @ np.linalg.inv(object_from_face)
            self._reflection = opaque_transform(reflection)
            self._to_face = opaque_transform(np.linalg.inv(object_from_face))
            self._from_face = opaque_transform(object_from_face)
            self._half = mi.Vector2f(*(opaque(float(h)) for h in mirror.half_size_mm))
            self._share = opaque(mirror.share)
        self._to_own = None if own is None else opaque_transform(own)
        self._from_own = None if own is None else opaque_transform(np.linalg.inv(own))

    def in_own_frame(self, origin: Point3f, direction: Vector3f) -> tuple[Point3f, Vector3f]:
        """A ray of the sensor's OCS in the sheet's own, where the nominal sheet is X = 0."""
        if self._mirror is not None:
            origin, direction = self._reflection @ mi.Point3f(origin), self._reflection @ mi.Vector3f(direction)
        if self._to_own is None:
            return origin, direction
        return self._to_own @ mi.Point3f(origin), self._to_own @ mi.Vector3f(direction)

    def at(self, p: Point3f, after_s: Float | None = None) -> SheetLight:
        """The sheet's light at points of the sensor's OCS, shadows aside; nothing where the mirror does not send it."""
        if self._mirror is None:
            return self._unfolded(p)
        # Mirrors stand still in the scene.
        resting = self._pose.at_rest(p, after_s)
        light = self._unfolded(self._pose.moving(self._reflection @ resting, after_s))
        direction = self._reflection @ self._pose.direction_at_rest(light.direction, after_s)
        normal = self._reflection @ self._pose.direction_at_rest(light.normal, after_s)
        _, meets = self._on_mirror(resting, -direction)
        return replace(
            light,
            direction=self._pose.moving_direction(direction, after_s),
            normal=self._pose.moving_direction(normal, after_s),
            irradiance=dr.select(meets, light.irradiance * self._share, 0.0),
            in_middle=dr.select(meets, light.in_middle * self._share, 0.0),
        )

    def _unfolded(self, p: Point3f) -> SheetLight:
        """The sheet's light at points of the OCS, seen without mirrors."""
        if self._to_own is None:
            return self.sheet.at(p)
        light = self.sheet.at(self._to_own @ mi.Point3f(p))
        return replace(light, direction=self._from_own @ light.direction, normal=self._from_own @ light.normal)

    @property
    def mirrored(self) -> bool:
        """Whether the light comes by way of a mirror."""
        return self._mirror is not None

    def may_reach(self, p: Point3f, light: SheetLight) -> Bool | None:
        """Where a mirror may send the sheet's light; None for a direct one, which is sent everywhere."""
        return None if self._mirror is None else self._on_mirror(p, -light.direction)[1]

    def reaches(self, objects: mi.Scene, p: Point3f, light: SheetLight, after_s: Float | None, active: Bool):
        """Whether nothing stands between points of the sensor's OCS and the laser's window."""
        towards = -light.direction
        if self._mirror is None:
            return active & ~self._blocked(objects, p, towards, light.exit_mm, after_s, active)
        resting = self._pose.direction_at_rest(towards, after_s)
        t, meets = self._on_mirror(self._pose.at_rest(p, after_s), resting)
        active = active & meets & ~self._blocked(objects, p, towards, t, after_s, active & meets)
        folded = self._to_face @ resting
        folded.z = -folded.z
        onward = self._pose.moving_direction(self._from_face @ folded, after_s)
        turn = mi.Point3f(p + towards * t)
        return active & ~self._blocked(objects, turn, onward, light.exit_mm - t, after_s, active)

    def _on_mirror(self, p: Point3f, direction: Vector3f) -> tuple[Float, Bool]:
        """Distances that rays run to the mirror's face, and whether they meet its front."""
        start, along = self._to_face @ mi.Point3f(p), self._to_face @ direction
        t = -start.z / along.z
        inside = (dr.abs(start.x + t * along.x) <= self._half.x) & (dr.abs(start.y + t * along.y) <= self._half.y)
        return t, (start.z > 0) & (along.z < 0) & inside

    def _blocked(
        self, objects: mi.Scene, p: Point3f, towards: Vector3f, length: Float, after_s: Float | None, active: Bool
    ) -> Bool:
        ray = self._pose.ray(p + towards * _CLEAR_MM, towards, after_s)
        ray.maxt = length - 2 * _CLEAR_MM
        return objects.ray_test(ray, active & (length > 2 * _CLEAR_MM))

    def rays(self, u: Point3f) -> Rays:
        """Rays of a direct light in the sensor's OCS, drawn in proportion to its power."""
        rays = self.sheet.sample(u)
        if self._from_own is None:
            return rays
        return Rays(self._from_own @ mi.Point3f(rays.origin), self._from_own @ rays.direction, rays.weight)

    def crossing(self, origin: Point3f, direction: Vector3f) -> tuple[Float, SheetLight]:
        """Crossings of rays with the middle of the sheet, in its own OCS: distances along them, and the light there."""
        t = -origin.x / direction.x
        light = self.sheet.at(mi.Point3f(origin + direction * t))
        t -= light.distance_mm / dr.dot(direction, light.normal)
        light = self.sheet.at(mi.Point3f(origin + direction * t))
        if self._mirror is not None:
            share = self._share
            light = replace(light, irradiance=light.irradiance * share, in_middle=light.in_middle * share)
        return t, light

    def passage(self, origin: Point3f, direction: Vector3f, length: Float) -> Passage:
        """Where rays of the sensor's OCS, up to ``length``, pass the sheet's middle."""
        o, d = self.in_own_frame(origin, direction)
        back = (self.sheet.begins_at_z_mm - o.z) / d.z
        length = dr.select((d.z < 0) & (back > 0), dr.minimum(length, back), length)

        def step(middle: Float) -> tuple[SheetLight, Float, Float]:
            t = dr.clip(middle, 0.0, length)
            light = self.sheet.at(mi.Point3f(o + d * t))
            slope = _away_from_zero(dr.dot(d, light.normal))
            return light, slope, t - light.distance_mm / slope

        _, _, middle = step(-o.x / _away_from_zero(d.x))
        light, slope, middle = step(middle)
        return Passage(length, middle, light.sigma_mm / dr.abs(slope))


@dataclass(frozen=True)
class Passage:
    """Where rays pass the middle of a sheet: at ``middle_mm``, which may lie outside of 0 to ``length_mm``.

    The part of the rays before the laser's window counts. ``sigma_mm`` is the sheet's standard deviation along them.
    """

    length_mm: Float
    middle_mm: Float
    sigma_mm: Float

    def nearest(self) -> tuple[Float, Float]:
        """Where the rays come nearest to the sheet, and how near, in mm along them.

        Within the sheet, its standard deviation counts as the distance.
        """
        t = dr.clip(self.middle_mm, 0.0, self.length_mm)
        return t, dr.abs(self.middle_mm - t) + self.sigma_mm

    def pick(self, u: Float) -> tuple[Float, Float]:
        """A place on the rays, drawn like the sheet's Gaussian across them, and its density in 1/mm.

        The density is 0 where a ray keeps clear of the sheet. It only steers samples: whoever uses it evaluates the
        true light there.
        """
        spread, length, middle = 1.1 * math.sqrt(2) * self.sigma_mm, self.length_mm, self.middle_mm
        low, high = dr.erf(-middle / spread), dr.erf((length - middle) / spread)
        x = dr.clip((middle + spread * dr.erfinv(dr.lerp(low, high, u))), 0.0, length)
        share = 0.5 * (high - low)
        density = dr.exp(-dr.square((x - middle) / spread)) / (math.sqrt(math.pi) * spread * share)
        return x, dr.select((share > 1e-5) & dr.isfinite(density), density, 0.0)


@dataclass(frozen=True)
class SheetLobe:
    """Directions from points into which the sheet nearby scatters light, drawn as it does so.

    Seen from a point, the sheet is a plane at the distance x, whose light arrives from ``towards``. The direction at an
    angle a from there and with the azimuth f, counted from the sheet's side, crosses the plane at a slope sin a cos f,
    so that the sheet scatters p(a) / (sin a cos f) into it, p being the phase function. In that proportion directions
    are drawn down to the slope ``least``, half the x / Z at which they leave the light, which has come the way Z.
    """

    towards: Vector3f
    side: Vector3f
    least: Float
    share_on_side: Float
    angles: AngleTable

    @classmethod
    def at(cls, light: SheetLight, angles: AngleTable) -> SheetLobe:
        """The lobe at points of which the sheet's light is given; ``angles`` is in proportion to p(a) / sin a."""
        towards, across = -light.direction, dr.abs(light.distance_mm)
        side = -dr.mulsign(mi.Vector3f(light.normal), light.distance_mm)
        side = mi.Vector3f(dr.normalize(side - towards * dr.dot(side, towards)))
        # Within the sheet, light comes from both sides.
        share = 0.5 + 0.5 * dr.erf(across / (math.sqrt(2) * light.sigma_mm))
        away = dr.sqrt(dr.square(across) + dr.square(light.sigma_mm))
        return cls(towards, side, 0.5 * away / dr.maximum(light.exit_mm, 1e-3), share, angles)

    def present(self) -> Bool:
        """Whether any direction is drawn."""
        return self.least < _LARGEST_SLOPE

    def draw(self, u: Point2f) -> tuple[Vector3f, Bool]:
        """Directions, and whether they are valid; u.x draws the angle and u.y the azimuth."""
        return self.at_angles(self.angles.heights(self.share_below(u.x)), u.y)

    def share_below(self, u: Float) -> Float:
        """Share of all the table's directions that lies below the angle to be drawn."""
        return dr.lerp(self._share_left_out(), 1.0, u)

    def at_angles(self, heights: tuple[Float, Float], u: Float) -> tuple[Vector3f, Bool]:
        """Directions, and whether they are valid, at angles given by 1 - cos and 1 + cos; u draws the azimuth."""
        before, after = heights
        sine = dr.sqrt(before * after)
        reach = self._reach(sine)
        on_side = u < self.share_on_side
        v = dr.select(on_side, u / self.share_on_side, (1 - u) / (1 - self.share_on_side))
        # The azimuth is the Gudermannian of an even number, whose sine is tanh and whose cosine is 1 / cosh.
        tanh, cosh = dr.tanh((2 * v - 1) * reach), dr.cosh((2 * v - 1) * reach)
        x = dr.select(on_side, sine / cosh, -sine / cosh)
        beside = dr.cross(self.towards, self.side)
        drawn = self.towards * (1 - before) + self.side * x + beside * (sine * tanh)
        return dr.normalize(mi.Vector3f(drawn)), self.present() & (sine > self.least)

    def density(self, direction: Vector3f) -> Float:
        """Density in 1/sr with which `draw` chooses directions."""
        before = one_minus_cosine(self.towards, direction)
        sine = dr.sqrt(dr.maximum(before * (2 - before), 0.0))
        slope = dr.dot(direction, self.side)
        share = dr.select(slope > 0, self.share_on_side, 1 - self.share_on_side) / (1 - self._share_left_out())
        slope = dr.abs(slope)
        drawn = self.present() & (sine > self.least) & (slope > (1 - 1e-3) * self.least)
        density = share * self.angles.density(before) * math.pi * sine / (slope * self._reach(sine))
        return dr.select(drawn, density, 0.0)

    def _share_left_out(self) -> Float:
        """Share of the angles so small that all directions are flatter than ``least``."""
        squared = dr.square(dr.minimum(self.least, _LARGEST_SLOPE))
        return self.angles.share_below(squared / (1 + dr.sqrt(1 - squared)))

    def _reach(self, sine: Float) -> Float:
        """The inverse Gudermannian of the largest azimuth: arcosh(sin a / least)."""
        ratio = dr.maximum(sine / self.least, 1 + 1e-6)
        return dr.log(ratio + dr.sqrt(dr.square(ratio) - 1))


def lights(
    sheets: Iterable[Sheet], pose: SensorPose, mirrors: Iterable[MirrorFace] = ()
) -> tuple[list[Light], list[Light]]:
    """The sheets directly, and by way of each mirror face."""
    direct = [Light(sheet, pose) for sheet in sheets]
    return direct, [Light(sheet, pose, mirror) for sheet in sheets for mirror in mirrors]


def _away_from_zero(x: Float) -> Float:
    """Slopes whose size is at least 1e-4, so that they can be divided by."""
    return dr.select(dr.abs(x) < 1e-4, dr.mulsign(mi.Float(1e-4), x), x)
