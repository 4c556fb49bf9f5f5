"""The laser sheet in the medium: fan rays traced through the real laser window, then a smooth ruled surface.

Everything is in the sensor's object coordinate system (OCS), in which the nominal sheet is X = 0, Y runs along the
stripe and Z along the laser's axis. A fan ray is the straight line Y = y0(m) + m Z, X = x0(m) + k(m) Z, with its slope
m = dY/dZ as the parameter of the surface.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import drjit as dr
import mitsuba as mi
import numpy as np
from numpy.polynomial import Polynomial

from twin.windows import WindowFaces, frame_about
from uwlts.errors import DesignError
from uwlts.placement import camera_from_object, laser_pose
from uwlts.sensor import Medium, Sensor

_RAYS, _DEGREE, _NEWTON_STEPS = 1025, 11, 3


@dataclass(frozen=True)
class SheetLight:
    """The sheet's light at points: signed distance across, width, irradiance in W/mm2 across the ray, its direction.

    ``distance_mm`` and ``sigma_mm`` are measured along X; ``exit_mm`` is the way back to the laser's window.
    """

    distance_mm: mi.Float
    sigma_mm: mi.Float
    irradiance: mi.Float
    direction: mi.Vector3f
    normal: mi.Vector3f
    exit_mm: mi.Float


class Sheet:
    """The lit surface of one sensor in one medium."""

    def __init__(self, sensor: Sensor, medium: Medium):
        laser, pose = sensor.laser, laser_pose(sensor)
        to_object = np.linalg.inv(camera_from_object(sensor))
        rotation = frame_about(pose.axis, pose.normal)
        faces = WindowFaces(
            laser.window, medium, wavelength_nm=laser.wavelength_nm, origin_mm=pose.origin_mm, rotation=rotation
        )
        half = math.radians(laser.fan_angle_deg / 2)
        angle = np.linspace(-half, half, _RAYS)
        directions = pose.axis[:, None] * np.cos(angle) + pose.fan[:, None] * np.sin(angle)
        path = faces.through(mi.Point3f(pose.origin_mm), mi.Vector3f(directions), mode=mi.TransportMode.Importance)
        if not bool(dr.all(path.valid)):
            raise DesignError(
                f"part of the laser's {laser.fan_angle_deg:g} deg fan does not pass its window of "
                f"{laser.window.aperture_diameter_mm:g} mm: enlarge the window or bring it closer"
            )
        o = to_object[:3, :3] @ path.origin.numpy().astype(float) + to_object[:3, 3:]
        d = to_object[:3, :3] @ path.direction.numpy().astype(float)
        slope, tilt = d[1] / d[2], d[0] / d[2]
        self.largest_slope = float(np.abs(slope).max())
        self._lowest, self._highest = float(slope.min()), float(slope.max())
        self._origin = to_object[:3, :3] @ pose.origin_mm + to_object[:3, 3]
        transmitted = path.weight.numpy().astype(float)

        def fitted(values: np.ndarray) -> np.ndarray:
            return (
                Polynomial.fit(slope, values, _DEGREE, domain=(-self.largest_slope, self.largest_slope)).convert().coef
            )

        self._y0, self._x0, self._tilt = (fitted(v) for v in (o[1] - slope * o[2], o[0] - tilt * o[2], tilt))
        self._exit_z = fitted(o[2])
        density = Polynomial(fitted(angle)).deriv()(slope) * transmitted / (2 * half)
        self._power = fitted(1e-3 * laser.power_mw * density)
        waist = laser.waist_radius_mm
        index = medium.refractive_index(laser.wavelength_nm)
        rayleigh = math.pi * waist**2 * index / (laser.beam_quality_m2 * 1e-6 * laser.wavelength_nm)
        self._waist, self._rayleigh, self._waist_at = waist, rayleigh, laser.waist_distance_mm
        self._extinction = medium.extinction_per_mm(laser.wavelength_nm)

    def at(self, p: mi.Point3f) -> SheetLight:
        """Light of the sheet at points in the OCS.

        The slope of the fan ray through a point solves y0(m) + m Z = Y (Newton). Between two fan rays flows the power
        P'(m) dm; across it spreads as a Gaussian of standard deviation w / 2 with w^2 = w0^2 (1 + ((s - s0) / zR)^2)
        (Siegman, Lasers, Eqs. 17.5, and 17.6 for zR, with M2).
        """
        m = p.y / (p.z - float(self._origin[2]))
        derivative = [k * c for k, c in enumerate(self._y0)][1:]
        for _ in range(_NEWTON_STEPS):
            m -= (_horner(self._y0, m) + m * p.z - p.y) / (_horner(derivative, m) + p.z)
            m = dr.clip(m, -1.05 * self.largest_slope, 1.05 * self.largest_slope)
        tilt = _horner(self._tilt, m)
        distance = p.x - (_horner(self._x0, m) + tilt * p.z)
        stretch = dr.sqrt(1 + m * m + tilt * tilt)
        exit_mm = (p.z - _horner(self._exit_z, m)) * stretch
        travelled = dr.norm(p - mi.Point3f(self._origin))
        radius = self._waist * dr.sqrt(1 + dr.square((travelled - self._waist_at) / self._rayleigh))
        sigma = 0.5 * radius
        gauss = dr.exp(-0.5 * dr.square(distance / sigma)) / (sigma * math.sqrt(2 * math.pi))
        density = _horner(self._power, m) / (_horner(derivative, m) + p.z)
        irradiance = density * gauss * stretch * dr.exp(-self._extinction * exit_mm)
        inside = (m >= self._lowest) & (m <= self._highest) & (exit_mm > 0)
        direction = mi.Vector3f(tilt, m, 1.0) / stretch
        normal = dr.normalize(mi.Vector3f(1.0, 0.0, -tilt))
        return SheetLight(distance, sigma, dr.select(inside, irradiance, 0.0), direction, normal, exit_mm)


def _horner(coefficients: np.ndarray | list[float], x: mi.Float) -> mi.Float:
    value = mi.Float(float(coefficients[-1]))
    for coefficient in reversed(coefficients[:-1]):
        value = dr.fma(value, x, float(coefficient))
    return value
