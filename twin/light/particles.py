"""Particles and bubbles in the laser sheet, each imaged as a separate spot.

Their positions are sampled in the image: each image area sees an area of the sheet, and its volume gives their number.
A body at the irradiance E that sends the radiant intensity I (W/sr) to the camera adds light to the image. The amount
is that of one pixel that sees a surface of radiance I / F. F is the area perpendicular to the ray that a pixel covers
there. Defocus and the size of the body spread the light over a disc.

While the sensor moves through the water, bodies cross the sheet. Each is lit while it is in the sheet, and its spot is
drawn out to a track.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Literal, assert_never

import drjit as dr
import mitsuba as mi
import numpy as np

from twin.backend.arrays import Float, Vector3f, to_jit
from twin.light.camera import CameraView
from twin.light.illumination import Light
from twin.light.pose import SensorPose, Travel
from twin.rendering_options import Effects
from twin.scene.objects import Objects

Body = Literal["particles", "bubbles"]

_LEAST_MM = 0.1  # smallest diameter of bodies rendered individually; smaller ones are part of the water's turbidity
_MOST_MM = 5.0  # largest diameter: with N(> d) ~ d^-3, one body in 125,000 is larger
_SLOPE = 3.0
"""Exponent of the size distribution N(> d) ~ d^-3: equal volume in equal logarithmic intervals.

Bader, J. Geophys. Res. 75, 2822, 1970; Sheldon et al., Limnol. Oceanogr. 17, 327, 1972.
"""
_REFLECTANCE = 0.3  # diffuse reflectance of particles (assumed): aggregates are grey to brownish white
_WATER_INDEX = 1.33  # of water at visible wavelengths, relative to the air in bubbles
_SIGMAS = 3.0  # bodies farther from the sheet's centre than this many standard deviations are treated as dark
_MOST_BODIES = 50_000  # largest number of bodies in one image; more of them would look like haze
_STEP_PX = 0.5  # largest distance of the discs that form a track; a disc is at least a pixel wide
_MOST_STEPS = 400  # largest number of discs of a track
_MARGIN_PX = 20.0
"""Width of the border around the image whose bodies are included, because their discs may reach into it."""


@dataclass(frozen=True)
class Spots:
    """Imaged bodies: positions (N,) in px, their light in W/mm2 times pixels, and radii (N,) of their discs."""

    x: np.ndarray
    y: np.ndarray
    light: np.ndarray
    radius_px: np.ndarray

    def draw(self, height: int, width: int) -> np.ndarray:
        """Draw all spots as an irradiance image (H, W), float32; the edge of a disc is one pixel wide."""
        image = np.zeros((height, width), np.float32)
        for x, y, light, radius in zip(self.x, self.y, self.light, self.radius_px, strict=True):
            reach = radius + 1
            first_row, first_column = max(0, math.floor(y - reach)), max(0, math.floor(x - reach))
            rows = np.arange(first_row, min(height, math.ceil(y + reach) + 1))[:, None]
            columns = np.arange(first_column, min(width, math.ceil(x + reach) + 1))
            if rows.size and columns.size:
                disc = np.clip(radius + 0.5 - np.hypot(rows - y, columns - x), 0, 1)
                # Discs cut by the image border contribute only their visible part.
                whole = max(math.pi * radius**2, 1.0)
                image[rows, columns] += light * disc / (max(disc.sum(), whole) if reach > 3 else max(disc.sum(), 1e-9))
        return image


@dataclass(frozen=True, eq=False)
class SpotSampler:
    """Sampling of bodies in a light's sheet that the camera sees, without those behind, inside or shadowed by objects.

    With speckle, the light of each spot varies, with as many independent grains as its disc holds (gamma distribution:
    Goodman, Speckle Phenomena, Sec. 4.6).
    """

    view: CameraView
    objects: Objects
    extinction: Float  # of the medium, 1/mm
    wavelength_nm: float
    effects: Effects

    def sample(
        self,
        light: Light,
        pose: SensorPose,
        body: Body,
        *,
        travel: Travel | None,
        per_litre: float,
        rng: np.random.Generator,
    ) -> Spots:
        """Sample the visible bodies of one kind, with ``per_litre`` bodies larger than 0.1 mm.

        ``travel`` is the motion of the sensor through the water during the exposure; None: at rest in it.
        """
        camera = self.view.camera
        width, height = camera.width_px + 2 * _MARGIN_PX, camera.height_px + 2 * _MARGIN_PX
        # The largest volume per pixel, found on a coarse grid, bounds the number of candidates.
        x, y = (g.ravel() for g in np.meshgrid(np.linspace(0, 1, 24) * width, np.linspace(0, 1, 24) * height))
        coarse = self._measure(x - _MARGIN_PX, y - _MARGIN_PX, np.zeros_like(x), light, pose, travel)["volume"]
        if not coarse.any():
            return Spots(*(np.zeros(0) for _ in range(4)))
        largest = 1.5 * coarse.max()
        tried = min(rng.poisson(1e-6 * per_litre * largest * width * height), _MOST_BODIES)
        # At least two: empty arrays would compile separate kernels.
        x, y = (rng.uniform(-_MARGIN_PX, side - _MARGIN_PX, max(tried, 2)) for side in (width, height))
        aside = rng.uniform(-_SIGMAS, _SIGMAS, len(x))
        found = self._measure(x, y, aside, light, pose, travel)
        kept = (rng.uniform(0, largest, len(x)) < found["volume"]) & (np.arange(len(x)) < tried)
        x, y, aside, found = x[kept], y[kept], aside[kept], {name: values[kept] for name, values in found.items()}
        below = 1 - (_LEAST_MM / _MOST_MM) ** _SLOPE
        diameter = _LEAST_MM * (1 - below * rng.random(len(x))) ** (-1 / _SLOPE)
        match body:
            case "particles":
                share, shown = diffuse_sphere(found["cosine"]), diameter
            case "bubbles":
                # A glint, much smaller than the bubble.
                share, shown = bubble(found["cosine"]), np.zeros_like(diameter)
            case _:
                assert_never(body)
        intensity = share * np.square(diameter / 2)
        blur = self.view.blur_radius_px(found["depth"]) if self.effects.defocus else 0.0
        size_px = 0.5 * shown / np.sqrt(np.maximum(found["across"], 1e-12))
        light_seen, radius = found["light"] * intensity / np.maximum(found["across"], 1e-12), np.hypot(size_px, blur)
        if self.effects.speckle:
            grain_px = 1e-3 * self.wavelength_nm * camera.working_f_number() / camera.pixel_size_um
            grains = np.maximum(1.0, math.pi * np.square(radius / grain_px))
            light_seen = light_seen * rng.gamma(grains) / grains
        spots = Spots(x, y, light_seen, radius)
        return spots if travel is None else _draw_out(spots, aside, found)

    def _measure(
        self, x: np.ndarray, y: np.ndarray, aside: np.ndarray, light: Light, pose: SensorPose, travel: Travel | None
    ) -> dict[str, np.ndarray]:
        """Return volume (mm3) per pixel, light of the sheet, and area per pixel at image positions ``x`` and ``y``."""
        at = [(to_jit(x + dx), to_jit(y + dy)) for dx, dy in ((0, 0), (1, 0), (0, 1))]
        bundles = [self.view.trace_bundle(*each) for each in at]
        crossed = [light.intersect(*light.to_sheet_frame(each.origin, each.direction)) for each in bundles]
        t, bundle = crossed[0][0], bundles[0]
        points = [each.origin + each.direction * where for each, (where, _) in zip(bundles, crossed, strict=True)]
        right, down = mi.Vector3f(points[1] - points[0]), mi.Vector3f(points[2] - points[0])
        area = dr.norm(dr.cross(right, down))
        middle = light.evaluate(mi.Point3f(points[0]))
        reach, tracks = middle.sigma_mm, {}
        if travel is not None:
            moved = pose.drift(mi.Point3f(points[0]), travel)
            through = dr.dot(moved, middle.normal)
            # Bodies that are in the sheet at any time of the exposure.
            reach = reach + dr.abs(through) / (2 * _SIGMAS)
            start = middle.normal * (reach * to_jit(aside))
            tracks = {"start": _compute_image_shift(start, right, down, bundle.direction)}
            tracks["moved"] = _compute_image_shift(moved, right, down, bundle.direction)
            tracks = {f"{name}_{axis}": values[k] for name, values in tracks.items() for k, axis in enumerate("xy")}
            tracks |= {"through": through, "reach": reach, "sigma": middle.sigma_mm}
        place = mi.Point3f(points[0] + middle.normal * (reach * to_jit(aside)))
        lit = light.evaluate(place)
        brightness = lit.irradiance if travel is None else lit.in_middle
        hit = self.objects.scene.ray_intersect_preliminary(pose.ray(bundle.origin, bundle.direction))
        free = (bundle.weight > 0) & (t > 0) & (~hit.is_valid() | (t < hit.t)) & (brightness > 0)
        free &= light.reaches(self.objects.scene, place, lit, None, free)
        volume = dr.select(free, area * 2 * _SIGMAS * reach, 0.0)
        across = area * dr.abs(dr.dot(bundle.direction, middle.normal))
        cosine = dr.dot(lit.direction, -bundle.direction)
        gathered = bundle.weight * brightness * dr.exp(-self.extinction * t)
        depth = self.view.depth_mm(mi.Point3f(points[0]))
        values = {"volume": volume, "light": gathered, "across": across, "cosine": cosine, "depth": depth} | tracks
        dr.eval(*values.values())
        return {name: value.numpy().astype(float) for name, value in values.items()}


def _compute_image_shift(way: Vector3f, right: Vector3f, down: Vector3f, ray: Vector3f) -> tuple[Float, Float]:
    """Return the shift in px, along x and y, of the image of points that move by ``way``, to first order.

    ``right`` and ``down`` are the ways in the sheet that shift the image by a pixel; ``ray`` is the camera ray.
    """
    volume = dr.dot(dr.cross(right, down), ray)
    return dr.dot(dr.cross(way, down), ray) / volume, dr.dot(dr.cross(right, way), ray) / volume


def _draw_out(spots: Spots, aside: np.ndarray, found: dict[str, np.ndarray]) -> Spots:
    """Return the tracks of bodies, as discs along the parts of their ways where they are in the sheet.

    A body's distance from the sheet's centre at the time t, from -1/2 to 1/2 of the exposure, is ``aside * reach +
    through * t``. A disc's light is in proportion to its duration and to the sheet's Gaussian.
    """
    sigma, through = found["sigma"], np.where(found["through"] == 0, 1e-12, found["through"])
    ends = np.sort((np.array([[-1.0], [1.0]]) * _SIGMAS * sigma - aside * found["reach"]) / through, axis=0)
    first, last = np.clip(ends, -0.5, 0.5)
    length = (last - first) * np.hypot(found["moved_x"], found["moved_y"])
    steps = np.clip(np.ceil(length / np.maximum(_STEP_PX, 0.5 * spots.radius_px)), 1, _MOST_STEPS).astype(int)
    body = np.repeat(np.arange(len(steps)), steps)
    step = np.arange(len(body)) - np.repeat(np.cumsum(steps) - steps, steps)
    duration = (last - first)[body] / steps[body]
    t = first[body] + duration * (step + 0.5)
    distance = (aside * found["reach"])[body] + through[body] * t
    share = duration * np.exp(-0.5 * np.square(distance / sigma[body]))
    x, y = (
        getattr(spots, axis)[body] + found[f"start_{axis}"][body] + found[f"moved_{axis}"][body] * t for axis in "xy"
    )
    return Spots(x, y, spots.light[body] * share, spots.radius_px[body])


def diffuse_sphere(cosine: np.ndarray) -> np.ndarray:
    """Return the radiant intensity in 1/sr of a diffuse sphere per irradiance and squared radius.

    It is 2 / 3 rho (sin a + (pi - a) cos a) / pi (Lambert's sphere: H. N. Russell, Astrophys. J. 43, 173, 1916). The
    phase angle a is that between the directions to the light and to the viewer. ``cosine`` is that of the scattering
    angle pi - a.
    """
    angle = np.pi - np.arccos(np.clip(cosine, -1, 1))
    return 2 / 3 * _REFLECTANCE * (np.sin(angle) + (np.pi - angle) * np.cos(angle)) / np.pi


def bubble(cosine: np.ndarray) -> np.ndarray:
    """Return the radiant intensity in 1/sr reflected by an air bubble per irradiance and squared radius.

    A reflecting sphere sends R / 4 into every direction (Davis, J. Opt. Soc. Am. 45, 572, 1955). R is the Fresnel
    reflectance at the incidence angle (180 deg - scattering angle) / 2: reflection is total up to a scattering angle of
    about 83 deg. ``cosine`` is that of the scattering angle. Light transmitted through the bubble is neglected.
    """
    index, incidence = _WATER_INDEX, (np.pi - np.arccos(np.clip(cosine, -1, 1))) / 2
    inside = index * np.sin(incidence)
    cos_in, cos_out = np.cos(incidence), np.sqrt(np.maximum(1 - np.square(inside), 0))
    square = (index * cos_in - cos_out) / (index * cos_in + cos_out)
    parallel = (cos_in - index * cos_out) / (cos_in + index * cos_out)
    reflected = np.where(inside >= 1, 1.0, 0.5 * (np.square(square) + np.square(parallel)))
    return reflected / 4
