"""Haze: light of the sheet that the water scatters once into the camera's rays.

Windows and sheets are fixed relative to the camera. Only shadows and the surfaces that end the rays differ between
frames.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import drjit as dr
import mitsuba as mi

from twin.backend.arrays import Float, Vector3f
from twin.light.camera import RaySegment
from twin.light.illumination import Light
from twin.light.pose import Rays
from twin.light.sheet import SheetLight
from twin.light.water import Scattering


@dataclass(frozen=True)
class SheetCrossing:
    """Intersections of camera rays with the centre surface of a sheet, at ``distance_mm`` along them.

    ``sense`` is 1 if a ray crosses in the direction of the sheet's normal, else -1. ``irradiance`` is that of the
    scattered light on the image sensor in W/mm2, without occlusion. ``direction`` and ``exit_mm`` describe the sheet's
    light there.
    """

    distance_mm: Float
    sense: Float
    irradiance: Float
    direction: Vector3f
    exit_mm: Float


def intersect_sheet(light: Light, scattering: Scattering, rays: Rays) -> SheetCrossing:
    """Intersect camera rays with a sheet; for a direct light the result is the same at all poses.

    The line integral of a Gaussian along a straight ray is b p(angle) E sigma sqrt(2 pi) / |cos|. Here p is the phase
    function and E the irradiance in the sheet's centre.
    """
    origin, direction = light.to_sheet_frame(rays.origin, rays.direction)
    t, middle = light.intersect(origin, direction)
    towards = dr.dot(direction, middle.normal)
    peak = middle.irradiance * middle.sigma_mm * math.sqrt(2 * math.pi)
    # Light travels against the camera ray, so the difference of both directions is a sum here.
    phase = scattering.phase(0.5 * dr.squared_norm(middle.direction + direction))
    radiance = scattering.b * phase * peak / dr.maximum(dr.abs(towards), 1e-3) * dr.exp(-scattering.c * t)
    here = light.evaluate(mi.Point3f(rays.origin + rays.direction * t))
    return SheetCrossing(
        t, dr.sign(towards), rays.weight * dr.select(t > 0, radiance, 0.0), here.direction, here.exit_mm
    )


def compute_haze(
    crossed: SheetCrossing, light: Light, scene: mi.Scene, segment: RaySegment, at_end: SheetLight
) -> Float:
    """Return the haze on the image sensor in W/mm2.

    A surface removes the part of the Gaussian behind it. If the surface is in front of the sheet's centre, shadows are
    tested at the surface: it must not shadow the haze in front of it. ``at_end`` is the light of the sheet at the
    surfaces that end the rays.
    """
    end_sigmas = dr.select(segment.valid, crossed.sense * at_end.distance_mm / at_end.sigma_mm, dr.inf)
    scattered = crossed.irradiance * (0.5 * (1 + dr.erf(end_sigmas / math.sqrt(2.0))))
    before = ~segment.valid | (crossed.distance_mm < segment.si.t)
    place = segment.origin + segment.direction * dr.select(before, crossed.distance_mm, segment.si.t)
    direction = dr.select(before, crossed.direction, at_end.direction)
    exit_mm = dr.select(before, crossed.exit_mm, at_end.exit_mm)
    here = replace(at_end, direction=direction, exit_mm=exit_mm)
    return dr.select(light.reaches(scene, mi.Point3f(place), here, None, scattered > 0), scattered, 0.0)
