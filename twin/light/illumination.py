"""Illumination of points by the laser sheets, with shadows and mirrors; light that reaches the camera by another way.

The water scatters light of the sheet once into the camera's rays (haze), and the camera's window reflects a ring lamp
around the lens, seen out of focus.

Daylight is focused by a wavy water surface to moving filaments: rays of the sun, which stands vertically above, are
refracted at a random surface of waves and counted on a horizontal plane. The surface is periodic, so the pattern covers
any area. The sun's disc blurs it.
"""

from __future__ import annotations

import math
from collections.abc import Iterable
from dataclasses import dataclass, replace
from typing import Any

import cv2
import drjit as dr
import mitsuba as mi
import numpy as np

from twin.backend.arrays import Bool, Float, Point3f, Vector3f, opaque, opaque_transform, to_jit
from twin.light.camera import CameraView, RaySegment
from twin.light.pose import CLEAR_MM, Rays, SensorPose
from twin.light.sheet import Sheet, SheetLight
from twin.light.water import AngleTable, Scattering, one_minus_cosine
from twin.scene.objects import MirrorFace, Objects
from twin.scene.platform_kinds import GRAVITY_M_S2
from uwlts.model.placement import camera_from_object
from uwlts.model.sensor import Sensor
from uwlts.runtime.compiled import compiled

_LARGEST_SLOPE = 0.7
"""Largest ratio of the distance from the sheet to the distance from the window that `SheetLobe` handles."""
_SPOT_ASIDE = 0.25  # offset of an uneven lamp's axis from the camera's axis, as a fraction of the view's corner slope


class Light:
    """A laser sheet in a scene at a given sensor pose, either direct or reflected by one mirror face."""

    def __init__(self, sheet: Sheet, pose: SensorPose, mirror: MirrorFace | None = None):
        self.sheet, self._pose, self.mirror = sheet, pose, mirror
        self.power_w, transform = opaque(sheet.power_w), sheet.sheet_from_object
        if mirror is not None:
            object_from_face = np.linalg.inv(pose.scene_from_object) @ mirror.pose
            reflection = object_from_face @ np.diag([1.0, 1.0, -1.0, 1.0]) @ np.linalg.inv(object_from_face)
            self._reflection = opaque_transform(reflection)
            self._to_face = opaque_transform(np.linalg.inv(object_from_face))
            self._from_face = opaque_transform(object_from_face)
            self._half = mi.Vector2f(*(opaque(float(h)) for h in mirror.half_size_mm))
            self._share = opaque(mirror.share)
        self._to_sheet = None if transform is None else opaque_transform(transform)
        self._from_sheet = None if transform is None else opaque_transform(np.linalg.inv(transform))

    def to_sheet_frame(self, origin: Point3f, direction: Vector3f) -> tuple[Point3f, Vector3f]:
        """Transform a ray from the sensor's OCS into the frame of the sheet, where the nominal sheet is X = 0."""
        if self.mirror is not None:
            origin, direction = self._reflection @ mi.Point3f(origin), self._reflection @ mi.Vector3f(direction)
        if self._to_sheet is None:
            return origin, direction
        return self._to_sheet @ mi.Point3f(origin), self._to_sheet @ mi.Vector3f(direction)

    def evaluate(self, p: Point3f, after_s: Float | None = None) -> SheetLight:
        """Return the sheet's light at points in the sensor's OCS, without shadows; 0 where the mirror reflects none."""
        if self.mirror is None:
            return self._evaluate_direct(p)
        # Mirrors do not move with the sensor.
        resting = self._pose.to_rest_frame(p, after_s)
        light = self._evaluate_direct(self._pose.to_moving_frame(self._reflection @ resting, after_s))
        direction = self._reflection @ self._pose.rotate_to_rest_frame(light.direction, after_s)
        normal = self._reflection @ self._pose.rotate_to_rest_frame(light.normal, after_s)
        _, meets = self._intersect_mirror(resting, -direction)
        return replace(
            light,
            direction=self._pose.rotate_to_moving_frame(direction, after_s),
            normal=self._pose.rotate_to_moving_frame(normal, after_s),
            irradiance=dr.select(meets, light.irradiance * self._share, 0.0),
            in_middle=dr.select(meets, light.in_middle * self._share, 0.0),
        )

    def _evaluate_direct(self, p: Point3f) -> SheetLight:
        """Return the light of the sheet without mirrors at points in the OCS."""
        if self._to_sheet is None:
            return self.sheet.evaluate(p)
        light = self.sheet.evaluate(self._to_sheet @ mi.Point3f(p))
        return replace(light, direction=self._from_sheet @ light.direction, normal=self._from_sheet @ light.normal)

    def may_reach(self, p: Point3f, light: SheetLight) -> Bool | None:
        """Return the mask of points that the mirror can illuminate; None for a direct light, which has no limit."""
        return None if self.mirror is None else self._intersect_mirror(p, -light.direction)[1]

    def reaches(self, objects: mi.Scene, p: Point3f, light: SheetLight, after_s: Float | None, active: Bool):
        """Return the mask of points in the OCS, with their ``light``, that have a free path to the laser's window.

        ``after_s`` are times of the points after that of the pose, s; None: at rest. Only ``active`` points are tested.
        """
        towards = -light.direction
        if self.mirror is None:
            return active & ~self._is_blocked(objects, p, towards, light.exit_mm, after_s, active)
        resting = self._pose.rotate_to_rest_frame(towards, after_s)
        t, meets = self._intersect_mirror(self._pose.to_rest_frame(p, after_s), resting)
        active = active & meets & ~self._is_blocked(objects, p, towards, t, after_s, active & meets)
        folded = self._to_face @ resting
        folded.z = -folded.z
        onward = self._pose.rotate_to_moving_frame(self._from_face @ folded, after_s)
        turn = mi.Point3f(p + towards * t)
        return active & ~self._is_blocked(objects, turn, onward, light.exit_mm - t, after_s, active)

    def _intersect_mirror(self, p: Point3f, direction: Vector3f) -> tuple[Float, Bool]:
        """Return the distances of rays to the mirror face, and the mask of those that hit its front."""
        start, along = self._to_face @ mi.Point3f(p), self._to_face @ direction
        t = -start.z / along.z
        inside = (dr.abs(start.x + t * along.x) <= self._half.x) & (dr.abs(start.y + t * along.y) <= self._half.y)
        return t, (start.z > 0) & (along.z < 0) & inside

    def _is_blocked(
        self, objects: mi.Scene, p: Point3f, towards: Vector3f, length: Float, after_s: Float | None, active: Bool
    ) -> Bool:
        ray = self._pose.ray(p + towards * CLEAR_MM, towards, after_s)
        ray.maxt = length - 2 * CLEAR_MM
        return objects.ray_test(ray, active & (length > 2 * CLEAR_MM))

    def sample_rays(self, u: Point3f) -> tuple[Point3f, Vector3f]:
        """Sample origins and directions of a direct light's rays in the sensor's OCS, in proportion to power."""
        origin, direction = self.sheet.sample(u)
        if self._from_sheet is None:
            return origin, direction
        return self._from_sheet @ mi.Point3f(origin), self._from_sheet @ direction

    def intersect(self, origin: Point3f, direction: Vector3f) -> tuple[Float, SheetLight]:
        """Intersect rays in the sheet's frame with its centre; return distances along them, and the light."""
        t = -origin.x / direction.x
        light = self.sheet.evaluate(mi.Point3f(origin + direction * t))
        t -= light.distance_mm / dr.dot(direction, light.normal)
        light = self.sheet.evaluate(mi.Point3f(origin + direction * t))
        if self.mirror is not None:
            share = self._share
            light = replace(light, irradiance=light.irradiance * share, in_middle=light.in_middle * share)
        return t, light

    def locate_sheet(self, origin: Point3f, direction: Vector3f, length: Float) -> Passage:
        """Return the position of the sheet's centre along rays of length ``length`` in the sensor's OCS."""
        o, d = self.to_sheet_frame(origin, direction)
        back = (self.sheet.begins_at_z_mm - o.z) / d.z
        length = dr.select((d.z < 0) & (back > 0), dr.minimum(length, back), length)

        def step(middle: Float) -> tuple[SheetLight, Float, Float]:
            t = dr.clip(middle, 0.0, length)
            light = self.sheet.evaluate(mi.Point3f(o + d * t))
            slope = _bound_slope(dr.dot(d, light.normal))
            return light, slope, t - light.distance_mm / slope

        _, _, middle = step(-o.x / _bound_slope(d.x))
        light, slope, middle = step(middle)
        return Passage(length, middle, light.sigma_mm / dr.abs(slope))


@dataclass(frozen=True)
class Passage:
    """Position and width of a sheet along rays; ``middle_mm``, its centre, may be outside 0 to ``length_mm``.

    Only the part of the rays behind the laser's window is included. ``sigma_mm`` is the sheet's standard deviation
    measured along the rays.
    """

    length_mm: Float
    middle_mm: Float
    sigma_mm: Float

    def find_nearest(self) -> tuple[Float, Float]:
        """Return the ray position nearest to the sheet and its distance from the sheet, both in mm along the ray.

        The standard deviation of the sheet is added to the distance, which is therefore never 0.
        """
        t = dr.clip(self.middle_mm, 0.0, self.length_mm)
        return t, dr.abs(self.middle_mm - t) + self.sigma_mm

    def sample(self, u: Float) -> tuple[Float, Float]:
        """Sample a ray position from the sheet's Gaussian profile along the ray; return it and its density in 1/mm.

        The density is 0 for rays that stay clear of the sheet. Only the sampling depends on it: the caller evaluates
        the actual light at the position.
        """
        spread, length, middle = 1.1 * math.sqrt(2) * self.sigma_mm, self.length_mm, self.middle_mm
        low, high = dr.erf(-middle / spread), dr.erf((length - middle) / spread)
        x = dr.clip((middle + spread * dr.erfinv(dr.lerp(low, high, u))), 0.0, length)
        share = 0.5 * (high - low)
        density = dr.exp(-dr.square((x - middle) / spread)) / (math.sqrt(math.pi) * spread * share)
        return x, dr.select((share > 1e-5) & dr.isfinite(density), density, 0.0)


@dataclass(frozen=True)
class SheetLobe:
    """Distribution of directions from points into the nearby sheet, in proportion to the light scattered there.

    From a point, the sheet is seen as a plane at the distance x, lit from the direction ``towards``. A direction has an
    angle a to ``towards`` and an azimuth f, measured from the side of the sheet. It crosses the plane at a slope sin a
    cos f. The light scattered into it is p(a) / (sin a cos f) with the phase function p.

    Directions are sampled in this proportion for slopes above ``least``. This limit is half of x / Z, the slope of
    directions that leave the lit region at the window, with the distance Z from the window.
    """

    towards: Vector3f
    side: Vector3f
    least: Float
    share_on_side: Float
    angles: AngleTable

    @classmethod
    def from_light(cls, light: SheetLight, angles: AngleTable) -> SheetLobe:
        """Build the lobe from the sheet's light at points; ``angles`` tabulates p(a) / sin a."""
        towards, across = -light.direction, dr.abs(light.distance_mm)
        side = -dr.mulsign(mi.Vector3f(light.normal), light.distance_mm)
        side = mi.Vector3f(dr.normalize(side - towards * dr.dot(side, towards)))
        # Inside the sheet, scattered light arrives from both sides.
        share = 0.5 + 0.5 * dr.erf(across / (math.sqrt(2) * light.sigma_mm))
        distance = dr.sqrt(dr.square(across) + dr.square(light.sigma_mm))
        return cls(towards, side, 0.5 * distance / dr.maximum(light.exit_mm, 1e-3), share, angles)

    def has_directions(self) -> Bool:
        """Return the mask of points whose lobe is not empty."""
        return self.least < _LARGEST_SLOPE

    def share_below(self, u: Float) -> Float:
        """Return the value of the table's cumulative distribution that ``u`` selects."""
        return dr.lerp(self._exclude_angles(), 1.0, u)

    def rotate_to_angles(self, heights: tuple[Float, Float], u: Float) -> tuple[Vector3f, Bool]:
        """Return directions at angles given by 1 - cos and 1 + cos, and the mask of valid ones.

        ``u`` selects the azimuth.
        """
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
        return dr.normalize(mi.Vector3f(drawn)), self.has_directions() & (sine > self.least)

    def density(self, direction: Vector3f) -> Float:
        """Return the density in 1/sr of the sampled directions."""
        before = one_minus_cosine(self.towards, direction)
        sine = dr.sqrt(dr.maximum(before * (2 - before), 0.0))
        slope = dr.dot(direction, self.side)
        share = dr.select(slope > 0, self.share_on_side, 1 - self.share_on_side) / (1 - self._exclude_angles())
        slope = dr.abs(slope)
        drawn = self.has_directions() & (sine > self.least) & (slope > (1 - 1e-3) * self.least)
        density = share * self.angles.density(before) * math.pi * sine / (slope * self._reach(sine))
        return dr.select(drawn, density, 0.0)

    def _exclude_angles(self) -> Float:
        """Return the fraction of angles too small for any direction steeper than ``least``."""
        squared = dr.square(dr.minimum(self.least, _LARGEST_SLOPE))
        return self.angles.share_below(squared / (1 + dr.sqrt(1 - squared)))

    def _reach(self, sine: Float) -> Float:
        """Return the inverse Gudermannian of the largest azimuth: arcosh(sin a / least)."""
        ratio = dr.maximum(sine / self.least, 1 + 1e-6)
        return dr.log(ratio + dr.sqrt(dr.square(ratio) - 1))


def make_lights(
    sheets: Iterable[Sheet], pose: SensorPose, mirrors: Iterable[MirrorFace] = ()
) -> tuple[list[Light], list[Light]]:
    """Return the direct light of each sheet, and the light of each sheet in each mirror face."""
    direct = [Light(sheet, pose) for sheet in sheets]
    return direct, [Light(sheet, pose, mirror) for sheet in sheets for mirror in mirrors]


def _bound_slope(x: Float) -> Float:
    """Return slopes with a magnitude of at least 1e-4, so that they can be divisors."""
    return dr.select(dr.abs(x) < 1e-4, dr.mulsign(mi.Float(1e-4), x), x)


RING_MM = 22.0, 28.0
"""Inner and outer radius of the ring in the plane of the entrance pupil, around a C-mount lens (assumed)."""
_CELL_PX = 4  # spacing of the computed pixels: at the distance of the reflected ring, the blur is many times wider
_PUPIL_SAMPLES = 128
"""Number of rays per computed pixel: a blurred edge has steps of a hundredth of the ring's brightness."""


def reflect_ring(view: CameraView, sensor: Sensor, *, reflectance: float) -> np.ndarray:
    """Return the irradiance (H, W) in W/mm2 on the image sensor by a lamp ring that the window reflects.

    A diffuse ring of radius R and area A has the radiance L. It illuminates a surface on the axis at the distance d
    from the pupil with E = L A d^2 / (d^2 + R^2)^2; refraction is neglected. E is that of the sensor's lamp, d the
    depth of the stand-off. The camera sees the ring mirrored by the inner face of its mounted window.
    """
    camera, (inner, outer) = sensor.camera, RING_MM
    columns, rows = -(-camera.width_px // _CELL_PX), -(-camera.height_px // _CELL_PX)
    x, y = np.meshgrid(*((np.arange(count) + 0.5) * _CELL_PX - 0.5 for count in (columns, rows)))
    count = x.size * _PUPIL_SAMPLES
    index = dr.arange(mi.UInt32, count)
    pixel, sample = index // _PUPIL_SAMPLES, index % _PUPIL_SAMPLES
    chief = view.lens.directions(dr.gather(mi.Float, to_jit(x), pixel), dr.gather(mi.Float, to_jit(y), pixel))
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
    distance = dr.norm(mi.Vector2f(ring.x, ring.y))
    cosine = dr.square(dr.square(chief.z))
    seen = dr.select((distance > inner) & (distance < outer) & (back.z < 0), cosine * view.lens.irradiance_on_axis, 0.0)
    shares = dr.block_sum(seen, _PUPIL_SAMPLES).numpy().reshape(rows, columns) / _PUPIL_SAMPLES
    middle, area = 0.5 * (inner + outer), math.pi * (outer**2 - inner**2)
    distance_mm = float(camera_from_object(sensor)[2, 3])
    irradiance = 1e-6 * sensor.lamp.irradiance_w_per_m2
    radiance = irradiance * (distance_mm**2 + middle**2) ** 2 / (area * distance_mm**2)
    size = columns * _CELL_PX, rows * _CELL_PX
    whole = cv2.resize(shares.astype(np.float32), size, interpolation=cv2.INTER_LINEAR)
    return np.float32(radiance * reflectance) * whole[: camera.height_px, : camera.width_px]


# --- haze -------------------------------------------------------------------------------------------------------------


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


# --- daylight under waves ---------------------------------------------------------------------------------------------


PATCH_MM = 512.0  # period of the surface; the focus of longer waves is at depths of many metres
CELLS = 1024
"""Number of cells of the pattern along each axis: 0.5 mm each, narrower than the sun's blur 0.2 m below the surface."""
_SHORTEST_MM = 17.0
"""Shortest wavelength: the slowest waves, between gravity and capillary waves, after which viscosity damps."""
_GRAVITY_MM_S2 = 1e3 * GRAVITY_M_S2
_TENSION_MM3_S2 = 7.3e4
"""Surface tension of water divided by its density (0.073 N/m, 1000 kg/m3)."""
_PEAK = 0.877
"""Angular frequency of the longest waves times the wind speed, divided by gravity (Pierson and Moskowitz 1964)."""
_SUN_RAD = 4.65e-3  # angular radius of the sun (half of 32 arc minutes)
_DIRECT = 0.9  # fraction of the daylight that comes directly from the sun under a clear sky
_STEP_MM = 4.0
_FAST_MM_S = 500.0
"""Exposures are divided so that waves, at this typical speed, advance by at most `_STEP_MM`."""
_MOST_MOMENTS = 8
_STREAM = 43
"""Random number stream of the waves, separate from others of the same seed."""


class Caustics:
    """Random water surface above a scene.

    The mean square slope is that of a clean sea, 0.003 + 0.00512 U at the wind speed U in m/s (Cox and Munk 1954). It
    is spread evenly over the logarithm of the wave number, from the longest waves to ``_SHORTEST_MM`` (saturated
    spectrum, elevation in proportion to k^-4: Phillips 1958). The patch holds those up to its period. Waves run in all
    directions with cos^2 of half the angle to the wind, which blows along X. ``index`` is that of the water; light that
    it scatters counts as even light.
    """

    def __init__(self, *, wind_m_s: float, depth_mm: float, index: float, scattering_per_mm: float, seed: int):
        self._depth_mm, self._index = depth_mm, index
        self._direct = _DIRECT * math.exp(-scattering_per_mm * depth_mm)
        number = 2 * math.pi * np.fft.fftfreq(CELLS, PATCH_MM / CELLS)
        self._kx, self._ky = number[None, :], number[:, None]
        k = np.hypot(self._kx, self._ky)
        k[0, 0] = 1.0
        largest = 2 * math.pi / _SHORTEST_MM
        held = (k <= largest) & (k >= 2 * math.pi / PATCH_MM * (1 - 1e-9))
        held[0, 0] = False
        spread = (1 + self._kx / k) / (2 * math.pi)
        # Slope variance per area of the wave-number plane: that per ln k, divided by k^2 and the directions.
        slopes = slope_variance_per_octave(wind_m_s) / math.log(2) * spread / k**2 * (2 * math.pi / PATCH_MM) ** 2
        rng = np.random.default_rng([seed, _STREAM])
        drawn = rng.normal(size=(2, CELLS, CELLS))
        # The mean of the squared real part of a wave is half of its squared amplitude; |drawn|^2 is 2 in the mean.
        self._elevation = np.where(held, np.sqrt(slopes) / k, 0.0) * (drawn[0] + 1j * drawn[1])
        self._frequency = angular_frequency(k)

    def slopes(self, time_s: float) -> tuple[np.ndarray, np.ndarray]:
        """Return the slopes of the surface along X and Y (CELLS, CELLS) at a time."""
        waves = self._elevation * np.exp(-1j * time_s * self._frequency)
        along, across = (np.fft.ifft2(1j * k * waves, norm="forward").real for k in (self._kx, self._ky))
        return along, across

    def pattern(self, time_s: float, exposure_s: float = 0.0) -> np.ndarray:
        """Return the daylight on horizontal surfaces, relative to its mean (CELLS, CELLS), during an exposure."""
        moments = min(_MOST_MOMENTS, 1 + int(exposure_s * _FAST_MM_S / _STEP_MM))
        times = time_s + exposure_s * ((np.arange(moments) + 0.5) / moments - 0.5)
        light = np.mean(
            [focus_light(*self.slopes(t), depth_mm=self._depth_mm, index=self._index) for t in times], axis=0
        )
        # A disc of radius r has the variance r^2 / 4 along each axis. A cell more removes the spacing of the rays.
        blur = math.hypot(0.5 * self._depth_mm * _SUN_RAD / self._index, PATCH_MM / CELLS)
        passed = np.exp(-0.5 * blur**2 * (self._kx**2 + self._ky**2))
        sharp = np.fft.irfft2(np.fft.rfft2(light) * passed[:, : CELLS // 2 + 1], light.shape)
        return (1 - self._direct + self._direct * sharp).astype(np.float32)


def slope_variance_per_octave(wind_m_s: float) -> float:
    """Return the mean square slope of the waves within a factor of two in wavelength."""
    longest_mm = 2e6 * math.pi * wind_m_s**2 / (_PEAK**2 * _GRAVITY_MM_S2)
    octaves = math.log2(max(longest_mm, 2 * _SHORTEST_MM) / _SHORTEST_MM)
    return (0.003 + 0.00512 * wind_m_s) / octaves


def angular_frequency(number: np.ndarray) -> np.ndarray:
    """Return the angular frequency in 1/s of waves in deep water, from their wave number in 1/mm.

    omega^2 = g k + T k^3 with surface tension T per density (Lamb, Hydrodynamics, Sec. 267).
    """
    return np.sqrt(_GRAVITY_MM_S2 * number + _TENSION_MM3_S2 * number**3)


def focus_light(along: np.ndarray, across: np.ndarray, *, depth_mm: float, index: float) -> np.ndarray:
    """Return the irradiance (N, N) below a periodic surface, relative to its mean.

    A vertical ray meets the surface at the angle i of its slope and is refracted to r, sin r = sin i / n. It is shifted
    by the depth times tan(i - r) against the slope. Each ray's light is divided among the four nearest nodes. Slopes
    (N, N) are those along X (columns) and Y (rows) at nodes of `PATCH_MM` / N.
    """
    count = len(along)
    steepness = np.hypot(along, across)
    incidence = np.arctan(steepness)
    aside = depth_mm * count / PATCH_MM * np.tan(incidence - np.arcsin(np.sin(incidence) / index))
    aside /= np.maximum(steepness, 1e-12)
    x, y = np.arange(count) - aside * along, np.arange(count)[:, None] - aside * across
    light = np.zeros((count, count))
    _divide_among_nodes(x, y, light)
    return light


@compiled
def _divide_among_nodes(x: np.ndarray, y: np.ndarray, light: np.ndarray) -> None:
    """Add a ray's light at each place (N, N), in cells, to the four nearest nodes of the periodic ``light`` (N, N)."""
    count = len(light)
    for i in range(count):
        for j in range(count):
            column, row = math.floor(x[i, j]), math.floor(y[i, j])
            right, down = x[i, j] - column, y[i, j] - row
            for beside in range(2):
                for below in range(2):
                    share = (right if beside else 1 - right) * (down if below else 1 - down)
                    light[(row + below) % count, (column + beside) % count] += share


@dataclass(frozen=True, eq=False)
class EvenLight:
    """Light of lamp and day on surfaces; the lamp loses the fraction ``uneven_lamp`` towards the image's corners."""

    sensor: Sensor
    view: CameraView
    objects: Objects
    scattering: Scattering
    standoff_mm: float
    haze: bool
    uneven_lamp: float

    def irradiance(self, segment: RaySegment, ambient: bool, pattern: Any) -> Float:
        """Return the irradiance per ray in W/mm2 for evenly lit surfaces, seen through the water and its veiling light.

        A surface of albedo A at the irradiance E has the radiance A E / pi. Daylight comes evenly from the half-space
        of the sensor, -Z: a surface tilted by the angle a gets (1 + cos a) / 2 of E. The water scatters the radiance
        E / pi into every ray. The lamp is beside the camera, so only backscattered light returns.
        Up to the distance t, the veiling light is E / pi (1 - exp(-c t)) times the scattered fraction of the extinction
        c (Duntley 1963, Eq. 4, for an even light field). ``pattern`` is that of focused daylight on surfaces.
        """
        lamp = self.sensor.lamp
        level = opaque(1e-6 / math.pi * (lamp.ambient_w_per_m2 if ambient else lamp.irradiance_w_per_m2))
        left = dr.exp(-self.scattering.c * dr.select(segment.valid, segment.si.t, dr.inf))
        albedo = self.objects.albedo(segment.si) if ambient else self.objects.lamp_albedo(segment.si)
        albedo *= 0.5 - 0.5 * dr.mulsign(segment.si.n.z, segment.si.wi.z) if ambient else 1.0
        radiance = dr.select(segment.valid, albedo * left, 0.0)
        if pattern is not None:
            # Texels are at half cells, the pattern's nodes at whole ones.
            place = mi.Point2f(segment.si.p.x, segment.si.p.y) / PATCH_MM + 0.5 / CELLS
            radiance *= pattern.eval(place)[0]
        if self.haze and self.scattering.coefficient > 0:
            scattered = self.scattering.coefficient * (1 if ambient else self.scattering.backward_share)
            radiance += opaque(scattered / self.scattering.extinction) * (1 - left)
        if self.uneven_lamp and not ambient:
            radiance *= self._compute_lamp_share(segment)
        return segment.weight * level * radiance

    def _compute_lamp_share(self, segment: RaySegment) -> Float:
        """Return the fraction of lamp light at the end of camera rays: a round Gaussian spot about the lamp's axis.

        The fraction ``uneven_lamp`` is lost at the corner slope's distance from that axis.
        """
        length = dr.select(segment.valid, segment.si.t, self.standoff_mm)
        x, y = self.view.slopes(mi.Point3f(segment.origin + segment.direction * length))
        corner = self.sensor.camera.corner_slope()
        squared = dr.square(x / corner - _SPOT_ASIDE) + dr.square(y / corner)
        return dr.exp(math.log(1 - self.uneven_lamp) * squared)
