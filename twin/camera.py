"""Rays of the camera: from image points through a finite entrance pupil, with the lens's distortion undone.

The chief ray of an image point runs through the pupil's centre; all its other rays meet the chief ray in the focused
plane, so that whatever lies before or behind it is blurred. That plane is where the bare lens in air is focused: behind
a window and in water the sharp depth lies farther away, as the rays through the real faces show.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import drjit as dr
import mitsuba as mi

from uwlts.sensor import Camera

_NEWTON_STEPS = 6


@dataclass(frozen=True)
class LensRays:
    """Ray generator of a camera; the entrance pupil is a disc about the origin of the camera frame, square to z."""

    camera: Camera

    def pupil_radius_mm(self) -> float:
        """Radius of the entrance pupil, D / 2 = c / (2 N (1 + m)) with the image distance c (camera constant)."""
        return 0.5 * self.camera.focal_length_mm / self._working_f_number()

    def through_pupil(self, chief: mi.Vector3f, pupil: mi.Point2f) -> tuple[mi.Point3f, mi.Vector3f]:
        """Origin and unit direction in the camera frame of the ray through ``pupil``, a point of the unit disc.

        ``chief`` is the chief ray's direction; both rays meet in the plane z = focus distance (thin lens).
        """
        origin = self.pupil_radius_mm() * mi.Point3f(pupil.x, pupil.y, 0.0)
        focused = chief * (self.camera.focus_distance_mm / chief.z)
        return origin, dr.normalize(mi.Vector3f(focused - origin))

    def directions(self, x: mi.Float, y: mi.Float) -> mi.Vector3f:
        """Unit directions of chief rays in the camera frame; pixel (0, 0) is the centre of the first pixel."""
        focal = self.camera.focal_length_px()
        cx, cy = self.camera.principal_point()
        seen = mi.Point2f((x - cx) / focal, (y - cy) / focal)
        true = self._undistorted(seen)
        return dr.normalize(mi.Vector3f(true.x, true.y, 1.0))

    def _undistorted(self, seen: mi.Point2f) -> mi.Point2f:
        """Invert x_d = x (1 + k1 r2 + k2 r4 + k3 r6) + 2 p1 x y + p2 (r2 + 2 x2) (Brown 1971) by Newton's method."""
        d = self.camera.distortion
        if not any((d.k1, d.k2, d.p1, d.p2, d.k3)):
            return seen
        point = mi.Point2f(seen)
        for _ in range(_NEWTON_STEPS):
            x, y = point.x, point.y
            r2 = x * x + y * y
            radial = 1 + r2 * (d.k1 + r2 * (d.k2 + r2 * d.k3))
            slope = 2 * (d.k1 + r2 * (2 * d.k2 + r2 * 3 * d.k3))
            off_x = x * radial + 2 * d.p1 * x * y + d.p2 * (r2 + 2 * x * x) - seen.x
            off_y = y * radial + 2 * d.p2 * x * y + d.p1 * (r2 + 2 * y * y) - seen.y
            xx = radial + slope * x * x + 2 * d.p1 * y + 6 * d.p2 * x
            xy = slope * x * y + 2 * d.p1 * x + 2 * d.p2 * y
            yy = radial + slope * y * y + 2 * d.p2 * x + 6 * d.p1 * y
            determinant = xx * yy - xy * xy
            point = mi.Point2f(x - (yy * off_x - xy * off_y) / determinant, y - (xx * off_y - xy * off_x) / determinant)
        return point

    def irradiance_on_axis(self) -> float:
        """Irradiance on the image sensor per radiance at the pupil, in sr, on the axis; off it cos^4 comes on top.

        E = L (pi / 4) / (N (1 + m))^2 with the magnification m at the focus distance (Smith, Modern Optical
        Engineering, 4th ed., Eqs. 8.7 and 8.10).
        """
        return math.pi / 4 / self._working_f_number() ** 2

    def _working_f_number(self) -> float:
        focal = self.camera.focal_length_mm
        return self.camera.f_number * (1 + focal / (self.camera.focus_distance_mm - focal))
