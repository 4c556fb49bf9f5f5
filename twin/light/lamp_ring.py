"""Reflection of a ring lamp around the lens in the camera's window, seen out of focus."""

import math

import cv2
import drjit as dr
import mitsuba as mi
import numpy as np

from twin.backend.arrays import to_jit
from twin.light.camera import CameraView
from uwlts.model.sensor import Sensor

RING_MM = 22.0, 28.0
"""Inner and outer radius of the ring in the plane of the entrance pupil, around a C-mount lens (assumed)."""
_CELL_PX = 4
"""Spacing of the computed pixels: at the distance of the reflected ring, the blur is many times wider."""
_PUPIL_SAMPLES = 128
"""Number of rays per computed pixel: a blurred edge has steps of a hundredth of the ring's brightness."""


def reflect_ring(
    view: CameraView, sensor: Sensor, *, irradiance_w_per_m2: float, distance_mm: float, reflectance: float
) -> np.ndarray:
    """Return the irradiance (H, W) in W/mm2 on the image sensor by a lamp ring that the window reflects.

    A diffuse ring of radius R and area A has the radiance L. It illuminates a surface on the axis at the distance d
    from the pupil with E = L A d^2 / (d^2 + R^2)^2; refraction is neglected. The camera sees the ring mirrored by the
    inner face of its mounted window.
    """
    camera, (inner, outer) = sensor.camera, RING_MM
    columns, rows = -(-camera.width_px // _CELL_PX), -(-camera.height_px // _CELL_PX)
    x, y = np.meshgrid(*((np.arange(count) + 0.5) * _CELL_PX - 0.5 for count in (columns, rows)))
    count = x.size * _PUPIL_SAMPLES
    index = dr.arange(mi.UInt32, count)
    pixel, sample = index // _PUPIL_SAMPLES, index % _PUPIL_SAMPLES
    chief = view.lens.directions(
        dr.gather(mi.Float, to_jit(mi.Float, x), pixel), dr.gather(mi.Float, to_jit(mi.Float, y), pixel)
    )
    # Evenly spread points of a disc: a spiral by the golden angle.
    turn = math.pi * (3 - math.sqrt(5)) * mi.Float(sample)
    radius = dr.sqrt((mi.Float(sample) + 0.5) / _PUPIL_SAMPLES)
    origin, direction = view.lens.trace_through_pupil(chief, mi.Point2f(radius * dr.cos(turn), radius * dr.sin(turn)))
    normal = mi.Vector3f(*sensor.camera.window.normal().tolist())
    face = mi.Point3f(0.0, 0.0, camera.window.distance_mm)
    towards = dr.dot(direction, normal)
    met = origin + direction * (dr.dot(mi.Vector3f(face - origin), normal) / towards)
    back = direction - normal * (2 * towards)
    ring = met + back * (-met.z / back.z)
    away = dr.norm(mi.Vector2f(ring.x, ring.y))
    cosine = dr.square(dr.square(chief.z))
    seen = dr.select((away > inner) & (away < outer) & (back.z < 0), cosine * view.lens.irradiance_on_axis, 0.0)
    shares = dr.block_sum(seen, _PUPIL_SAMPLES).numpy().reshape(rows, columns) / _PUPIL_SAMPLES
    middle, area = 0.5 * (inner + outer), math.pi * (outer**2 - inner**2)
    radiance = 1e-6 * irradiance_w_per_m2 * (distance_mm**2 + middle**2) ** 2 / (area * distance_mm**2)
    size = columns * _CELL_PX, rows * _CELL_PX
    whole = cv2.resize(shares.astype(np.float32), size, interpolation=cv2.INTER_LINEAR)
    return np.float32(radiance * reflectance) * whole[: camera.height_px, : camera.width_px]
