"""The flat windows as Mitsuba's own discs with dielectric surfaces, and rays sent through them.

A ray takes the refracted way at every face; Fresnel's transmittance, the change of radiance with the index squared and
the glass's absorption go into its weight instead of being sampled. New rays start a little further along their own new
direction: Mitsuba's own offset runs along the normal and would shift the ray sideways.
"""

from __future__ import annotations

from dataclasses import dataclass

import drjit as dr
import mitsuba as mi
import numpy as np

from twin.arrays import Bool, Float, Point3f, Vector3f, scalar_transform
from uwlts.errors import DesignError
from uwlts.sensor import Medium, Window

STEP_MM = 1e-3
"""How far along its direction a refracted ray starts; far above the spacing of 32-bit floats at 1 m (6e-5 mm)."""


def frame_about(axis: np.ndarray, across: np.ndarray) -> np.ndarray:
    """Right-handed rotation (3, 3) with columns x, y, z where z = ``axis`` and x is ``across`` made square to it."""
    z = axis / np.linalg.norm(axis)
    x = across - (across @ z) * z
    x /= np.linalg.norm(x)
    return np.stack([x, np.cross(z, x), z], axis=1)


@dataclass(frozen=True)
class LightPath:
    """Rays in the medium behind a window: origin, unit direction, weight, and whether they got there."""

    origin: Point3f
    direction: Vector3f
    weight: Float
    valid: Bool


class WindowFaces:
    """Both faces of a window. Rays meet them in a known order, so each is asked alone, without a scene around it.

    Parameters
    ----------
    window
        Description of the window; unmounted it lets rays pass unchanged.
    origin_mm, rotation
        Module frame in the camera frame: its origin (3,) and rotation (3, 3); the third column is the module's axis.
    """

    def __init__(
        self, window: Window, medium: Medium, *, wavelength_nm: float, origin_mm: np.ndarray, rotation: np.ndarray
    ):
        index = medium.refractive_index(wavelength_nm)
        self.mounted = window.mounted
        if not window.mounted:
            if medium.kind != "air":
                raise DesignError("a window is left out although the sensor is in water: mount it or measure in air")
            return
        glass = window.index(wavelength_nm)
        self._absorption = window.absorption_per_mm()
        normal = rotation @ window.normal()
        inner = origin_mm + window.distance_mm * rotation[:, 2]
        outer = inner + window.thickness_mm * normal
        self._faces = []
        for centre, outside, inside in ((inner, 1.0, glass), (outer, glass, index)):
            to_world = np.eye(4)
            to_world[:3, :3] = frame_about(-normal, rotation[:, 0]) * (
                window.aperture_diameter_mm / 2,
                window.aperture_diameter_mm / 2,
                1,
            )
            to_world[:3, 3] = centre
            bsdf = {"type": "dielectric", "int_ior": inside, "ext_ior": outside}
            self._faces.append(mi.load_dict({"type": "disk", "to_world": scalar_transform(to_world), "bsdf": bsdf}))

    def through(self, origin: Point3f, direction: Vector3f, *, mode: mi.TransportMode) -> LightPath:
        """Send rays from the module's side through both faces.

        ``mode`` is Radiance for rays traced backwards from the camera (weights carry 1 / n^2) and Importance for light
        sent forwards from the laser.
        """
        width = dr.width(direction)
        weight, valid = dr.full(mi.Float, 1.0, width), dr.full(mi.Bool, True, width)
        if not self.mounted:
            return LightPath(origin, direction, weight, valid)
        context = mi.BSDFContext(mode)
        context.component = 1
        ray = mi.Ray3f(origin, direction)
        for face in self._faces:
            si = face.ray_intersect(ray, active=valid)
            valid &= si.is_valid() & (mi.Frame3f.cos_theta(si.wi) > 0)
            sample, transmitted = face.bsdf().sample(context, si, mi.Float(0.5), mi.Point2f(0.5), valid)
            weight *= dr.select(valid, transmitted[0], 0.0)
            if face is self._faces[1] and self._absorption > 0:
                weight *= dr.exp(-self._absorption * (si.t + STEP_MM))
            onward = si.to_world(sample.wo)
            ray = mi.Ray3f(si.p + onward * STEP_MM, onward)
        return LightPath(ray.o, ray.d, weight, valid & (weight > 0))
