"""Rendering of the irradiance on the image sensor, from the laser, the lamp and daylight.

A laser frame takes three passes. Rays through the nodes of a coarse grid locate the pixels near the lit stripe and give
the haze of the sheet. The pixels of the stripe are rendered with many samples over pixel, pupil and exposure, and with
fewer inside a wide stripe. Random walks add multiply scattered and reflected light, which is smooth
(`twin.light.multiple_scattering`).

The windows are fixed relative to the camera, so the nodes' rays behind the window are traced once. The objects are
fixed in the scene, so nothing is rebuilt or recompiled between frames.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field
from functools import cached_property, partial
from typing import Any, Literal, cast

import cv2
import drjit as dr
import mitsuba as mi
import numpy as np

from twin.backend.arrays import Float, UInt32, Vector4f, begin_kernels, opaque, to_jit
from twin.light.camera import CameraView, RaySegment, trace_segments
from twin.light.illumination import (
    Caustics,
    EvenLight,
    Light,
    SheetCrossing,
    compute_haze,
    intersect_sheet,
    make_lights,
)
from twin.light.image_sampling import (
    NODE_SPACING_PX,
    PixelSampler,
    combine_corners,
    dilate_cells,
    expand_cells,
    find_marked,
    mark_near_sheet,
    split_pixels,
)
from twin.light.multiple_scattering import IndirectLight, decay_with_distance
from twin.light.particles import Body, SpotSampler
from twin.light.pose import Rays, SensorPose, Travel
from twin.light.sheet import Sheet, SheetLight, lit_sigma_mm, spread_irradiance
from twin.light.walk import Walker
from twin.light.water import Scattering
from twin.rendering_options import ALL, Effects, Flaws
from twin.scene.description import Scene
from twin.scene.objects import MirrorFace, Objects, build_objects
from uwlts.model.placement import camera_from_object, check_design
from uwlts.model.sensor import Medium, Sensor

CHANGE_SHARE = 2e-3
"""In lamp images, pixels are sampled finely if their corners differ by more than this fraction of the maximum."""
EDGE_SHARE = 0.05
"""In lamp images, all samples are taken only beside larger differences: four average slighter ones to less than 1 %."""
BEND_SHARE = 1e-3
"""In a wide stripe, pixels are sampled finely if second differences exceed this fraction of the maximum."""
_FEWER_SAMPLES = 4  # divisor of the number of samples in other pixels of a wide stripe, and in faint side lobes
_LEAST_SPP = 4  # smallest number of samples there: one for each quarter of the pupil
_WIDE_PX = 64  # mean width of a stripe in px below which all pixels are sampled finely: most would need it
_MIRRORS = 2  # largest number of successive mirror reflections of a camera ray
_WALKS_PER_SAMPLE = 0.15  # random walks per cell and sample of a lit pixel in clear water; turbid water takes more
_DRIFTING_STREAM = 7  # random number stream of particles and bubbles, separate from those of walks and noise
_TRAVEL_STEP_MM = 0.2  # while the sensor moves, lit pixels are located at positions of this spacing
_STRIPE_SUMS, _LINE_SUMS = 3, 3
"""Numbers of means of the stripe, and of the lines' light."""
_REACH_SHARE = 1.5  # largest distance of visible surfaces from the OCS's origin, divided by the stand-off (approximate)


@dataclass(eq=False)
class _LocatedStripes:
    """Stripes of a pose in cells of the nodes' grid, and what else is known of that pose."""

    pose: SensorPose
    bright: np.ndarray  # mask of the cells that light of any stripe reaches, without faint side lobes
    lit: np.ndarray  # mask of the cells that light of any stripe reaches
    nodes: tuple[np.ndarray, list[np.ndarray]] | None
    """Haze (H, W) in W/mm2 and images of lit surfaces (`IndirectLight.image`).

    None once the laser's frame is rendered: the next one may show changed surfaces.
    """
    line_light: tuple[np.ndarray, int, tuple[np.ndarray, ...]] | None = None
    """Lines, number of samples, and result of `Renderer.render_line_light`, if the laser's frame measured it."""


@dataclass(frozen=True, eq=False)
class SurfaceLight:
    """Light of laser sheets on surfaces, seen directly or after up to ``mirrors`` mirrors."""

    objects: Objects
    scattering: Scattering
    mirrors: int

    def segments(self, pose: SensorPose, bundle: Rays, after_s: Float | None) -> Iterator[RaySegment]:
        """Return the segments of camera rays, those after mirrors too."""
        return trace_segments(self.objects, self.scattering.c, pose, bundle, after_s, mirrors=self.mirrors)

    def radiance(
        self, pose: SensorPose, segment: RaySegment, sources: list[Light], after_s: Float | None
    ) -> tuple[Float, Float]:
        """Return the radiance in W/mm2/sr of lit surfaces along segments, attenuated to the segments' start.

        The second value is that of the first source alone, without the side lobes of its sheet.
        """
        total, main, end, si = mi.Float(0.0), mi.Float(0.0), segment.end(), segment.si
        bsdf = si.bsdf()
        for light in sources:
            here = light.evaluate(end, after_s)
            across = light.sheet.parts
            middle = across[0][0] * (here.in_middle * dr.exp(-0.5 * dr.square(here.distance_mm / here.sigma_mm)))
            # The light of a coat or metal leaves where it arrives, that of a body is spread.
            parts = [(mi.BSDFContext(), here.irradiance, middle)]
            if self.objects.translucent:
                body, coat = mi.BSDFContext(), mi.BSDFContext()
                body.type_mask, coat.type_mask = mi.BSDFFlags.DiffuseReflection, mi.BSDFFlags.GlossyReflection
                normal = pose.object_direction(si.n, after_s)
                spread = (spread_irradiance(self.objects, si, normal, here, each) for each in (across, across[:1]))
                parts = [(coat, here.irradiance, middle), (body, *spread)]
            bright = segment.valid & (sum((value for _, value, _ in parts), mi.Float(0.0)) > 0)
            lit = light.reaches(self.objects.scene, end, here, after_s, bright)
            towards = si.to_local(pose.direction(-here.direction, after_s))
            for context, value, of_main in parts:
                sent = bsdf.eval(context, si, towards, lit)[0]
                total += dr.select(lit, sent * value, 0.0)
                if light is sources[0]:
                    main += dr.select(lit, sent * of_main, 0.0)
        passed = dr.exp(-self.scattering.c * dr.select(segment.valid, segment.si.t, 0.0))
        return total * passed, main * passed

    def lit_near_sheets(self, pose: SensorPose, segment: RaySegment, ends: list[SheetLight]) -> list[Float]:
        """Return irradiance per ray of surfaces near the sheets for `IndirectLight`; ``ends`` is the light there."""
        bsdf = segment.si.bsdf()
        seen = segment.weight * dr.exp(-self.scattering.c * dr.select(segment.valid, segment.si.t, 0.0))
        parts = []
        for here in ends:
            active = segment.valid & (here.in_middle > 0)
            towards = segment.si.to_local(pose.direction(-here.direction))
            sent = bsdf.eval(mi.BSDFContext(), segment.si, towards, active)[0]
            sent *= seen * here.in_middle * here.sigma_mm
            parts.append(decay_with_distance(sent, here.distance_mm, active))
        return [sum(each, mi.Float(0.0)) for each in zip(*parts, strict=True)]

    def sums(
        self,
        pose: SensorPose,
        bundle: Rays,
        after_s: Float | None,
        pixel: UInt32,
        sources: list[Light],
        planes: Float | None,
    ) -> tuple[Float, ...]:
        """Return irradiance per ray of surfaces seen directly or in mirrors, plain and weighted for speckle.

        The weights are polarisation and roughness of the surfaces. With ``planes`` of the pixels' lines, samples of
        `render_line_light` follow.
        """
        total, polarised, rough = mi.Float(0.0), mi.Float(0.0), mi.Float(0.0)
        of_line: tuple[Float, ...] = ()
        for index, segment in enumerate(self.segments(pose, bundle, after_s)):
            value, main = (segment.weight * each for each in self.radiance(pose, segment, sources, after_s))
            total += value
            polarised += value * self.objects.polarisation(segment.si)
            rough += value * self.objects.roughness_um(segment.si)
            if planes is not None and index == 0:
                alone = len(sources) == len(sources[0].sheet.parts) == 1
                plane = dr.gather(mi.Vector4f, planes, pixel)
                of_line = self._sample_lines(segment, after_s, sources[0], value if alone else main, plane)
        return total, polarised, rough, *of_line

    def _sample_lines(
        self, segment: RaySegment, after_s: Float | None, light: Light, value: Float, plane: Vector4f
    ) -> tuple[Float, Float, Float]:
        """Return samples for `render_line_light`; ``value`` is the light of the main part of ``light``."""
        here = light.evaluate(segment.end(), after_s)
        height = dr.dot(mi.Vector3f(plane.x, plane.y, plane.z), mi.Vector3f(segment.si.p)) - plane.w
        same = dr.abs(height) <= here.sigma_mm
        profile = dr.exp(-0.5 * dr.square(here.distance_mm / here.sigma_mm))
        profile /= here.sigma_mm * math.sqrt(2 * math.pi)
        return value, dr.select(same, 0.0, value), dr.select(same & (value > 0), profile, 0.0)

    def distances(self, here: SheetLight, segment: RaySegment, pose: SensorPose, reach: float) -> Float:
        """Return distances of segment ends from a sheet in ``reach`` standard deviations; infinite off surfaces."""
        sigma = here.sigma_mm
        if self.objects.translucent:
            sigma = lit_sigma_mm(self.objects, segment.si, pose.object_direction(segment.si.n), here)
        if reach != 1:
            sigma = sigma * opaque(reach)
        return dr.select(segment.valid, here.distance_mm / sigma, dr.inf)


@dataclass(eq=False)
class StripeLocator:
    """Search for the pixels of stripes by the rays of a coarse grid, which also give haze and lit surfaces."""

    surfaces: SurfaceLight
    pixels: PixelSampler
    sheets: list[Sheet]
    mirrors: Sequence[MirrorFace]
    effects: Effects
    reach_mm: float
    _crossings: dict[Sheet, SheetCrossing] = field(default_factory=dict)
    _last: _LocatedStripes | None = None

    @property
    def _size(self) -> tuple[int, int]:
        return self.pixels.view.camera.height_px, self.pixels.view.camera.width_px

    def locate(self, pose: SensorPose, *, with_nodes: bool = False) -> _LocatedStripes:
        """Locate the stripes; they are known for the last pose, unless its nodes are wanted again."""
        last = self._last
        if last is None or not pose.equals(last.pose) or (with_nodes and last.nodes is None):
            begin_kernels()
            lights = make_lights(self.sheets, pose, self.mirrors)
            last = self._last = _LocatedStripes(pose, *self._find_laser_nodes(pose, *lights))
        return last

    def lit_pixels(self, pose: SensorPose) -> tuple[np.ndarray, np.ndarray]:
        """Return rows and columns of pixels, among them all whose chief rays meet the stripe of the first laser."""
        return find_marked(expand_cells(self.locate(pose).bright, *self._size))

    def _find_laser_nodes(
        self, pose: SensorPose, direct: list[Light], mirrored: list[Light]
    ) -> tuple[np.ndarray, np.ndarray, tuple[np.ndarray, list[np.ndarray]]]:
        """Return the masks of bright and lit cells (rows, columns) as in `_LocatedStripes`, haze and lit surfaces."""
        bundle, shape = self.pixels.view.trace_grid(NODE_SPACING_PX)
        lit = np.zeros((shape[0] - 1, shape[1] - 1), bool)
        bright, reach = lit.copy(), np.zeros_like(lit, np.float32)
        image = np.zeros(self._size, np.float32)
        surfaces: list[Float] = []
        scatters = self.surfaces.scattering.coefficient > 0 and (self.effects.haze or self.effects.multiple_scattering)
        for moment, sources in self._list_moments(pose, direct + mirrored):
            scattered = mi.Float(0.0)
            for index, segment in enumerate(self.surfaces.segments(moment, bundle, None)):
                ends = [light.evaluate(segment.end()) for light in sources]
                across = [
                    self.surfaces.distances(here, segment, moment, light.sheet.reach)
                    for light, here in zip(sources, ends, strict=True)
                ]
                straight = mi.Point3f(bundle.origin + bundle.direction * (segment.length_before + segment.si.t))
                depth = dr.select(segment.valid, self.pixels.view.depth_mm(straight), dr.nan)
                if index == 0 and moment is pose and scatters:
                    if self.effects.multiple_scattering:
                        surfaces = self.surfaces.lit_near_sheets(pose, segment, ends)
                    for light, here in zip(sources, ends, strict=True):
                        crossed = self._intersect_sheet(light, bundle)
                        scattered += compute_haze(crossed, light, self.surfaces.objects.scene, segment, here)
                reached = [light.may_reach(segment.end(), here) for light, here in zip(sources, ends, strict=True)]
                dr.eval(depth, scattered, surfaces, *across, *reached)
                near = np.zeros_like(lit)
                for light, each, there in zip(sources, across, reached, strict=True):
                    sigmas = each.numpy().reshape(shape)
                    mask = True if there is None else there.numpy().reshape(shape)
                    near |= mark_near_sheet(sigmas, mask)
                    bright |= mark_near_sheet(sigmas * (light.sheet.reach / light.sheet.bright_reach), mask)
                if self.pixels.defocus:
                    reach = np.fmax(reach, self.pixels.blur_px(near, depth.numpy().reshape(shape)))
                lit |= near
            if moment is pose and dr.width(scattered) > 1:
                image = expand_cells(0.25 * combine_corners(np.add, scattered.numpy().reshape(shape)), *self._size)
        bright, lit = (dilate_cells(each, reach) for each in (bright, lit))
        return bright, lit, (image, [each.numpy().reshape(shape) for each in surfaces])

    def _list_moments(self, pose: SensorPose, sources: list[Light]) -> Iterator[tuple[SensorPose, list[Light]]]:
        """Yield the pose and its lights, and further poses during the exposure if the sensor moves."""
        yield pose, sources
        if pose.travel is not None:
            first, last = pose.travel.time_range(self._size[0])
            fastest = np.linalg.norm(pose.travel.velocity_mm_s) + np.linalg.norm(pose.travel.turn_rad_s) * self.reach_mm
            way_mm = float((last - first) * fastest)
            for after_s in np.linspace(first, last, 2 + int(way_mm / _TRAVEL_STEP_MM)):
                moved = pose.displace(float(after_s))
                direct, mirrored = make_lights(self.sheets, moved, self.mirrors)
                yield moved, direct + mirrored

    def _intersect_sheet(self, light: Light, bundle: Rays) -> SheetCrossing:
        """Return the intersections of the nodes' rays with a sheet, cached for direct lights."""
        if light.mirror is not None:
            return intersect_sheet(light, self.surfaces.scattering, bundle)
        if light.sheet not in self._crossings:
            found = intersect_sheet(light, self.surfaces.scattering, bundle)
            dr.eval(vars(found))
            self._crossings[light.sheet] = found
        return self._crossings[light.sheet]


@dataclass(frozen=True)
class LaserFrame:
    """Irradiance of the laser on the image sensor in W/mm2, separated by origin.

    ``rows`` and ``columns`` (P,) are the pixels of the stripe, and ``stripe`` (P,) is their direct light from lit
    surfaces. ``polarisation`` and ``roughness_um`` (P,) are properties of these surfaces, for speckle. ``haze`` (H, W)
    is light that the water scatters once from the sheet into the camera's rays. ``particles`` (H, W) is the light of
    particles and bubbles in the sheet. ``longer`` computes the image (H, W) of multiply scattered and reflected light.
    """

    longer: Callable[[], np.ndarray] | None
    haze: np.ndarray
    particles: np.ndarray
    rows: np.ndarray
    columns: np.ndarray
    stripe: np.ndarray
    polarisation: np.ndarray
    roughness_um: np.ndarray

    @cached_property
    def scattered(self) -> np.ndarray:
        """All indirect light (H, W), including haze; the random walks are smoothed on first access."""
        return self.haze if self.longer is None else self.longer() + self.haze

    def irradiance(self, factors: np.ndarray | float = 1.0) -> np.ndarray:
        """Return all light (H, W), with the stripe multiplied by ``factors`` (P,)."""
        image = self.scattered + self.particles
        image[self.rows, self.columns] += self.stripe * factors
        return image

    def direct(self) -> np.ndarray:
        """Return the light of the stripe alone (H, W), without speckle."""
        image = np.zeros_like(self.haze)
        image[self.rows, self.columns] = self.stripe
        return image


class Renderer:
    """Renderer of one sensor in one medium and one scene.

    Of the ``flaws``, those of lamp and water are rendered. ``seed`` is that of random reflectances and waves.
    DesignError if the sensor cannot work in the medium; DescriptionError if an object cannot be built.
    """

    def __init__(
        self,
        sensor: Sensor,
        medium: Medium,
        scene: Scene,
        *,
        effects: Effects = ALL,
        flaws: Flaws = Flaws(),
        seed: int = 0,
    ):
        self.design = check_design(sensor, medium)
        self.sensor, self.medium, self.effects, self._flaws = sensor, medium, effects, flaws
        self._size, wavelength = (sensor.camera.height_px, sensor.camera.width_px), sensor.laser.wavelength_nm
        index = medium.refractive_index(wavelength)
        self.objects = build_objects(
            scene, medium_index=index, wavelength_nm=wavelength, gloss=effects.gloss, seed=seed
        )
        self.view = CameraView(sensor, medium)
        self.scattering = Scattering(medium, wavelength)
        self._caustics = None
        if flaws.caustics and medium.kind != "air":
            water = {"depth_mm": 1e3 * scene.depth_m, "scattering_per_mm": self.scattering.coefficient}
            self._caustics = Caustics(wind_m_s=flaws.caustics, index=index, **water, seed=seed)
        self.sheet = Sheet(sensor, medium)
        self._sheets = [self.sheet, *(Sheet(sensor, medium, laser) for laser in sensor.more_lasers)]
        self._mirrors = self.objects.mirrors if effects.secondary_light else ()
        self._surfaces = SurfaceLight(self.objects, self.scattering, _MIRRORS if self._mirrors else 0)
        self._pixels = PixelSampler(self.view, effects.defocus)
        standoff_mm, reach_mm = self.design.standoff_mm, _REACH_SHARE * self.design.standoff_mm
        self._even = EvenLight(
            sensor, self.view, self.objects, self.scattering, standoff_mm, effects.haze, flaws.uneven_lamp
        )
        self.locator = StripeLocator(self._surfaces, self._pixels, self._sheets, self._mirrors, effects, reach_mm)
        # Mean number of scattering events from the sensor to the stand-off and back.
        scatterings = 2 * self.scattering.coefficient * self.design.standoff_mm
        self._walks_per_sample = _WALKS_PER_SAMPLE * (1 + 4 * scatterings * (1 + scatterings))
        self._reach_mm = opaque(4 * float(np.linalg.norm(camera_from_object(sensor)[:3, 3])))

    def irradiance(
        self,
        light: Literal["lamp", "day"],
        scene_from_object: np.ndarray,
        *,
        spp: int,
        travel: Travel | None = None,
        time_s: float = 0.0,
        exposure_s: float = 0.0,
    ) -> np.ndarray:
        """Return the irradiance (H, W) of lamp or daylight on the image sensor in W/mm2, float32.

        ``scene_from_object`` (4, 4) is the pose of the OCS in the scene, and ``travel`` the motion of the sensor during
        the exposure; None: at rest. Each lit pixel has ``spp`` samples, at the same positions in every pixel. Waves of
        the water surface depend on time and duration of the exposure.
        """
        if light == "day" and not (self.effects.ambient and self.sensor.lamp.ambient_w_per_m2 > 0):
            return np.zeros(self._size, np.float32)
        pose, ambient, pattern = SensorPose(scene_from_object, travel), light == "day", None
        if self._caustics is not None and ambient:
            drawn = mi.TensorXf(self._caustics.pattern(time_s, exposure_s)[..., None])
            pattern = cast(Any, mi).Texture2f(drawn, use_accel=False, wrap_mode=dr.WrapMode.Repeat)
        begin_kernels()
        bundle, shape = self.view.trace_grid(1)
        segment = next(self._surfaces.segments(pose, bundle, None))
        value = self._even.irradiance(segment, ambient, pattern)
        depth = dr.select(segment.valid, self.view.depth_mm(segment.end()), dr.nan)
        dr.eval(value, depth)
        nodes = value.numpy().reshape(shape)
        # Only pixels with changes are sampled finely.
        low, high = combine_corners(np.minimum, nodes), combine_corners(np.maximum, nodes)
        changes, steep = (high - low > share * nodes.max() for share in (CHANGE_SHARE, EDGE_SHARE))
        if self.effects.defocus:
            blur = partial(self._pixels.blur_px, depth_mm=depth.numpy().reshape(shape))
            changes, steep = (dilate_cells(each, blur(each), cell_px=1) for each in (changes, steep))
        if travel is not None:
            changes[:] = steep[:] = True  # motion may change any pixel
        image = 0.25 * combine_corners(np.add, nodes)

        def evenly_lit(pose: SensorPose, bundle: Rays, after_s: Float | None, pixel: UInt32) -> tuple[Float]:
            return (self._even.irradiance(next(self._surfaces.segments(pose, bundle, after_s)), ambient, pattern),)

        fewer = max(spp // _FEWER_SAMPLES, min(spp, _LEAST_SPP))
        for where, count in ((steep, spp), (changes & ~steep, fewer)):
            for rows, columns in split_pixels(*find_marked(where), spp=count):
                means = self._pixels.render(evenly_lit, pose, rows, columns, spp=count, shifted=True)
                image[rows, columns] = means()[0]
        return image

    def laser_frame(
        self,
        scene_from_object: np.ndarray,
        *,
        spp: int,
        seed: int = 0,
        travel: Travel | None = None,
        through_water: Travel | None = None,
        lines: np.ndarray | None = None,
    ) -> LaserFrame:
        """Return the light of the laser on the image sensor; see `irradiance`. Equal arguments give equal light.

        ``seed`` is that of the random walks and particles. ``through_water`` is the motion of the sensor relative to
        the water and its particles; None: at rest. ``lines`` are those of `render_line_light`, which is then measured
        in the same pass and needs no time later.
        """
        pose = SensorPose(scene_from_object, travel)
        located = self.locator.locate(pose, with_nodes=True)
        assert located.nodes is not None
        (haze, surfaces), located.nodes = located.nodes, None
        begin_kernels()
        direct, mirrored = make_lights(self._sheets, pose, self._mirrors)
        rows, columns, stripe_means = self._render_stripe(located, direct + mirrored, spp=spp, lines=lines)
        walker, walked = Walker(self.objects, self.scattering, self.effects, pose, direct, self._reach_mm), None
        if walker.finds_light:
            walks = math.ceil(spp * self._walks_per_sample)
            walked = IndirectLight(self.view, walker, located.bright, seed=seed, walks=walks)
        stripe, polarised, rough, *of_lines = stripe_means()
        if lines is not None:
            located.line_light = lines, spp, self._select_lines(lines, rows, columns, np.array(of_lines))
        longer = None
        if walked is not None:
            image = np.zeros_like(haze)
            image[rows, columns] = stripe
            longer = partial(walked.image, image, haze, surfaces)
        haze = haze if self.effects.haze else np.zeros_like(haze)
        bright = np.maximum(stripe, np.finfo(np.float32).tiny)
        particles = self._render_particles(direct, pose, through_water, seed=seed)
        polarisation = np.clip(polarised / bright, 0, 1)
        return LaserFrame(longer, haze, particles, rows, columns, stripe, polarisation, rough / bright)

    def _render_particles(
        self, direct: list[Light], pose: SensorPose, through_water: Travel | None, *, seed: int
    ) -> np.ndarray:
        """Return the irradiance (H, W) in W/mm2 of particles and bubbles in the sheets."""
        image = np.zeros(self._size, np.float32)
        wavelength, rng = self.sensor.laser.wavelength_nm, np.random.default_rng([seed, _DRIFTING_STREAM])
        sampler = SpotSampler(self.view, self.objects, self.scattering.c, wavelength, self.effects)
        bodies: tuple[tuple[Body, float], ...]
        bodies = ("particles", self._flaws.particles), ("bubbles", self._flaws.bubbles)
        for body, per_litre in bodies:
            for light in direct if per_litre > 0 else ():
                seen = sampler.sample(light, pose, body, travel=through_water, per_litre=per_litre, rng=rng)
                image += seen.draw(*self._size)
        return image

    def laser(self, pose: SensorPose, bundle: Rays, after_s: Float | None = None) -> tuple[Float, RaySegment]:
        """Return the irradiance in W/mm2 per ray of the first laser on directly visible surfaces, and the rays."""
        direct, _ = make_lights(self._sheets[:1], pose)
        segment = next(self._surfaces.segments(pose, bundle, after_s))
        return segment.weight * self._surfaces.radiance(pose, segment, direct, after_s)[0], segment

    def render_line_light(self, pose: SensorPose, lines: np.ndarray, *, spp: int) -> tuple[np.ndarray, ...]:
        """Return the first laser's light on directly visible surfaces, and how much of it is on the lines' surfaces.

        It is given by rows and columns (P,) of the pixels of lines with a point, and means (3, P) over each pixel:
        irradiance in W/mm2 from all surfaces, and from others than the line's; and the density of the sheet's
        normalised profile on the line's surface, in 1/mm of distance from the sheet.

        ``lines`` (2, L, 3) are a surface point in scene coordinates of each profile line, NaN for none, and the unit
        normal there. Side lobes of the sheet are excluded. A line's surface is what lies within one standard deviation
        of the sheet of the plane through its point. It is known if the last frame was rendered with the same arguments.
        """
        located = self.locator.locate(pose)
        if located.line_light is not None:
            known_lines, known_spp, light = located.line_light
            if known_spp == spp and np.array_equal(known_lines, lines, equal_nan=True):
                return light
        direct, mirrored = make_lights(self._sheets, pose, self._mirrors)
        rows, columns, means = self._render_stripe(located, direct + mirrored, spp=spp, lines=lines)
        return self._select_lines(lines, rows, columns, means()[_STRIPE_SUMS:])

    def _select_lines(
        self, lines: np.ndarray, rows: np.ndarray, columns: np.ndarray, means: np.ndarray
    ) -> tuple[np.ndarray, ...]:
        known = np.isfinite(lines[0, self._find_line_numbers(rows, columns), 0])
        return rows[known], columns[known], means[:, known]

    def _find_line_numbers(self, rows: np.ndarray, columns: np.ndarray) -> np.ndarray:
        return columns if self.sensor.camera.stripe_along == "width" else rows

    def _render_stripe(
        self, located: _LocatedStripes, sources: list[Light], *, spp: int, lines: np.ndarray | None = None
    ) -> tuple[np.ndarray, np.ndarray, Callable[[], np.ndarray]]:
        """Render the stripes; return rows, columns (P,) of their pixels, and a function that fetches means (K, P).

        The means are those of `SurfaceLight.sums`. Rendering is asynchronous. Pixels with smooth light take few samples
        in faint side lobes, and in a wide stripe unless the light of ``lines`` needs all.
        """
        rows, columns = find_marked(expand_cells(located.lit, *self._size))
        count, planes = _STRIPE_SUMS, None
        if lines is not None:
            points, normals = lines
            offset = np.sum(normals * points, axis=1, keepdims=True)
            count, planes = count + _LINE_SUMS, np.concatenate([normals, offset], axis=1).astype(np.float32)

        def start(where: np.ndarray, spp: int) -> Callable[[], np.ndarray]:
            found: list[Callable[[], np.ndarray]] = []
            for part in split_pixels(rows[where], columns[where], spp=spp):
                if found:
                    dr.sync_thread()  # limits memory to the samples of one part
                of_pixels = None if planes is None else to_jit(planes[self._find_line_numbers(*part)])
                found.append(self._pixels.render(self._surfaces.sums, located.pose, *part, sources, of_pixels, spp=spp))
            return lambda: np.concatenate([np.zeros((count, 0), np.float32), *(means() for means in found)], axis=1)

        fine = expand_cells(located.bright, *self._size)[rows, columns]
        if spp < _LEAST_SPP * _FEWER_SAMPLES:
            fine[:] = True
        elif lines is None and fine.sum() >= _WIDE_PX * self.sensor.camera.lines():
            fine[:] = False
        if fine.all():
            return rows, columns, start(fine, spp)
        parts = (fine, start(fine, spp)), (~fine, start(~fine, spp // _FEWER_SAMPLES))

        def fetch() -> np.ndarray:
            sums = np.zeros((count, len(rows)), np.float32)
            for where, means in parts:
                sums[:, where] = means()
            image = np.zeros(self._size, np.float32)
            image[rows, columns] = sums[0]
            bends = np.zeros(image.shape, np.uint8)
            for along_x, along_y in ((2, 0), (0, 2)):
                second = cv2.Sobel(image, cv2.CV_32F, along_x, along_y, ksize=1)
                bends |= (np.abs(second) > BEND_SHARE * sums[0].max(initial=0.0)).view(np.uint8)
            again = ~fine & (cv2.dilate(bends, np.ones((3, 3), np.uint8))[rows, columns] > 0)
            sums[:, again] = start(again, spp)()
            return sums

        return rows, columns, fetch
