"""The tests' sensors, media and scenes as stock Mitsuba scenes, rendered by Mitsuba's own integrators.

The twin and Mitsuba's integrators share the shapes and the BSDFs, but no light transport. Stock Mitsuba has two limits.
It cannot connect to a light through a smooth dielectric, so windows are left off and the medium's index is 1. A light
without extent must be a point. Therefore the sheet is a fan from a point, with a Gaussian profile in angle. The twin's
sheet has this form if its waist is at the origin (`opened_from_its_origin`). All coordinates are in the sensor's object
coordinate system (OCS), mm.
"""

from __future__ import annotations

import math
from typing import Any

import mitsuba as mi
import numpy as np

from tests.virtual_sensors import altered, camera_axes, laser_origin
from twin.scene.description import AnyObject, Ball, Block, Pipe, Plate, Scene
from twin.scene.finish import finish_bsdf
from uwlts.model.sensor import Medium, Sensor

MOLECULAR_ANISOTROPY = 0.925
"""k of water's phase function 1 + k cos^2; Mitsuba's Rayleigh scattering has k = 1."""
_WAIST_MM = 0.02
_ACROSS_SIGMAS, _ACROSS_TEXELS = 10.0, 640


def opened_from_its_origin(sensor: Sensor, *, sigma_deg: float, fan_angle_deg: float) -> Sensor:
    """Return the sensor without windows, with a sheet that has a Gaussian profile of ``sigma_deg`` in angle.

    A waist w0 at the origin gives w = w0 s / zR far away, and zR = pi w0^2 / (M2 lambda): M2 = 2 pi w0 sigma / lambda.
    The waist is 0.01 mm before the origin; beyond 300 mm, w differs from this by less than 4e-5.
    """
    quality = 2 * math.pi * _WAIST_MM * math.radians(sigma_deg) / (1e-6 * sensor.laser.wavelength_nm)
    laser = {
        "fan_angle_deg": fan_angle_deg,
        "waist_radius_mm": _WAIST_MM,
        "waist_distance_mm": 0.01,
        "beam_quality_m2": quality,
        "window": {"mounted": False},
    }
    return altered(sensor, {"camera": {"window": {"mounted": False}}, "laser": laser})


def fog(*, absorption_per_m: float, scattering_per_m: float, **phase: Any) -> Medium:
    """A medium of air's index that absorbs and scatters."""
    coefficients = {"absorption_per_m": absorption_per_m, "scattering_per_m": scattering_per_m}
    return Medium.model_validate({"kind": "air"} | coefficients | phase)


def stock_scene(
    sensor: Sensor, medium: Medium, scene: Scene, *, pixel_px: int = 1, across_texels: int = _ACROSS_TEXELS
) -> mi.Scene:
    """Mitsuba scene of the sensor's camera and laser before objects.

    ``pixel_px`` sensor pixels make one film pixel; the projected profile of the sheet has ``across_texels`` texels.
    """
    shapes = {
        f"object_{index}": _shape(thing, pose, sensor, medium)
        for index, (thing, pose) in enumerate(zip(scene.objects, scene.object_poses(), strict=True))
    }
    parts = {
        "type": "scene",
        "projector": projector(sensor, across_texels),
        "camera": _camera(sensor, pixel_px),
    } | shapes
    if medium.extinction_per_mm(sensor.laser.wavelength_nm) > 0:
        parts["fog"] = homogeneous(medium, wavelength_nm=sensor.laser.wavelength_nm)
        parts["camera"]["medium"] = {"type": "ref", "id": "fog"}
    return mi.load_dict(parts)


def stock_irradiance(
    sensor: Sensor,
    medium: Medium,
    scene: Scene,
    *,
    integrator: str,
    max_depth: int,
    spp: int,
    runs: int,
    pixel_px: int = 1,
) -> np.ndarray:
    """Irradiance (runs, H, W) on the image sensor in W/mm2 from independent runs of a stock integrator.

    ``max_depth`` is as in Mitsuba: 2 is light with one reflection or one scattering event between laser and camera; -1
    is all orders.
    """
    built = stock_scene(sensor, medium, scene, pixel_px=pixel_px)
    # Russian roulette saves time but adds noise; here it starts late.
    walker = mi.load_dict({"type": integrator, "max_depth": max_depth, "rr_depth": 16})
    radiance = [np.array(mi.render(built, integrator=walker, spp=spp, seed=run))[..., 0] for run in range(runs)]
    return np.stack(radiance).astype(float) * blocks(per_radiance(sensor), pixel_px)


def blocks(image: np.ndarray, side: int) -> np.ndarray:
    """Means (..., H / side, W / side) over square blocks of pixels."""
    *runs, height, width = image.shape
    return image.reshape(*runs, height // side, side, width // side, side).astype(float).mean(axis=(-3, -1))


def per_radiance(sensor: Sensor) -> np.ndarray:
    """Irradiance on the image sensor per radiance (H, W) in sr: pi / 4 / (N (1 + m))^2 cos^4 of the field angle."""
    camera = sensor.camera
    x, y = np.meshgrid(np.arange(camera.width_px), np.arange(camera.height_px))
    cx, cy = camera.principal_point()
    squared_tangent = ((x - cx) ** 2 + (y - cy) ** 2) / camera.focal_length_px() ** 2
    magnification = 1 / (camera.focus_distance_mm / camera.focal_length_mm - 1)
    return math.pi / 4 / (camera.f_number * (1 + magnification)) ** 2 / (1 + squared_tangent) ** 2


def _camera(sensor: Sensor, pixel_px: int) -> dict[str, Any]:
    """Return Mitsuba's pinhole camera: it also looks along +z, but in its image x points left and y up.

    The edges of its film are the outer edges of the outermost pixels. Therefore the principal point in the middle of
    the image needs no shift by half a pixel.
    """
    camera = sensor.camera
    axes, standoff = camera_axes(sensor)
    object_from_camera = np.eye(4)
    object_from_camera[:3, :3] = axes.T
    object_from_camera[:3, 3] = -axes.T @ standoff
    return {
        "type": "perspective",
        "fov_axis": "x",
        "fov": math.degrees(2 * math.atan(camera.width_px / 2 / camera.focal_length_px())),
        "near_clip": 1.0,
        "far_clip": 1e4,
        "to_world": mi.ScalarTransform4f(object_from_camera @ np.diag([-1.0, -1.0, 1.0, 1.0])),
        "film": {
            "type": "hdrfilm",
            "width": camera.width_px // pixel_px,
            "height": camera.height_px // pixel_px,
            "rfilter": {"type": "box"},
            "pixel_format": "luminance",
            "component_format": "float32",
        },
        "sampler": {"type": "independent"},
    }


def projector(sensor: Sensor, across_texels: int) -> dict[str, Any]:
    """Return the sheet as Mitsuba's projector at the fan's origin.

    In a uniform fan of full angle A and power P, the power between the angles a and a + da is P da / A. For the point
    (x, y, 1), tan(a) = y gives da = dy / (1 + y^2). Its squared distance from the origin is r^2 = 1 + x^2 + y^2, and
    the Gaussian profile has the standard deviation sigma r. The plane z = 1 thus receives

        E1(x, y) = P / A / (1 + y^2) exp(-(x / (sigma r))^2 / 2) / (sqrt(2 pi) sigma r),

    and any plane z receives the irradiance E1 / z^2. Mitsuba's projector gives pi times its texture there (as if the
    texture were radiance on a diffuse screen), so the texture is E1 / pi. Its aspect ratio is that of the texture.
    """
    laser = sensor.laser
    fan = math.radians(laser.fan_angle_deg)
    sigma = laser.beam_quality_m2 * 1e-6 * laser.wavelength_nm / (2 * math.pi * laser.waist_radius_mm)
    height = 2 * math.tan(fan / 2)
    rows = round(height / (_ACROSS_SIGMAS * sigma) * across_texels)
    texel = height / rows
    x, y = np.meshgrid(
        (np.arange(across_texels) + 0.5 - across_texels / 2) * texel, (np.arange(rows) + 0.5 - rows / 2) * texel
    )
    spread = sigma * np.sqrt(1 + x * x + y * y)
    across = np.exp(-0.5 * (x / spread) ** 2) / (math.sqrt(2 * math.pi) * spread)
    irradiance = 1e-3 * laser.power_mw / fan / (1 + y * y) * across
    pose = np.eye(4)
    pose[:3, 3] = laser_origin(sensor)
    return {
        "type": "projector",
        "fov_axis": "y",
        "fov": laser.fan_angle_deg,
        "to_world": mi.ScalarTransform4f(pose),
        "irradiance": {
            "type": "bitmap",
            "raw": True,
            "filter_type": "bilinear",
            "wrap_mode": "clamp",
            "bitmap": mi.Bitmap((irradiance / math.pi)[..., None].astype(np.float32)),
        },
    }


def homogeneous(medium: Medium, *, wavelength_nm: float) -> dict[str, Any]:
    """Return Mitsuba's description of the medium.

    Molecular scattering of water is a mixture of Mitsuba's Rayleigh and isotropic scattering. With the fraction w of
    Rayleigh scattering, the phase function is (4 - w + 3 w cos^2) / (16 pi). The anisotropy 3 w / (4 - w) must equal
    k, so w = 4 k / (3 + k).
    """
    match medium.phase:
        case "henyey-greenstein" if medium.asymmetry == 0:
            phase = {"type": "isotropic"}
        case "henyey-greenstein":
            phase = {"type": "hg", "g": medium.asymmetry}
        case "molecular":
            share = 4 * MOLECULAR_ANISOTROPY / (3 + MOLECULAR_ANISOTROPY)
            parts = {"even": {"type": "isotropic"}, "rayleigh": {"type": "rayleigh"}}
            phase = {"type": "blendphase", "weight": share} | parts
        case other:
            raise ValueError(f"stock Mitsuba has no phase function '{other}'")
    extinction = medium.extinction_per_mm(wavelength_nm)
    albedo = medium.scattering_per_mm(wavelength_nm) / extinction
    return {"type": "homogeneous", "sigma_t": extinction, "albedo": albedo, "phase": phase}


def _shape(thing: AnyObject, pose: np.ndarray, sensor: Sensor, medium: Medium) -> dict[str, Any]:
    """Return Mitsuba's description of an object at its pose (4, 4) in the OCS."""
    if thing.mirror_share() > 0:
        raise ValueError("stock Mitsuba cannot connect to a point light through a mirror")
    wavelength = sensor.laser.wavelength_nm
    bsdf = finish_bsdf(thing, medium_index=medium.refractive_index(wavelength), wavelength_nm=wavelength)
    at, scaled = mi.ScalarTransform4f(pose), mi.ScalarTransform4f().scale
    match thing:
        case Ball():
            return {"type": "sphere", "to_world": at @ scaled(thing.diameter_mm / 2), "bsdf": bsdf}
        case Block():
            return {"type": "cube", "to_world": at @ scaled([side / 2 for side in thing.size_mm]), "bsdf": bsdf}
        case Plate():
            # Mitsuba's rectangle looks along +z, a plate along -z.
            turned = mi.ScalarTransform4f().rotate([1, 0, 0], 180)
            size = scaled([thing.width_mm / 2, thing.height_mm / 2, 1])
            return {"type": "rectangle", "to_world": at @ turned @ size, "bsdf": bsdf}
        case Pipe():
            half = [thing.length_mm / 2, 0, 0]
            ends = {"p0": [-half[0], 0, 0], "p1": half, "radius": thing.diameter_mm / 2}
            return {"type": "cylinder", "to_world": at, "bsdf": bsdf} | ends
    raise ValueError(f"no stock shape for a {thing.kind}")
