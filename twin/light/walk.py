"""Multiply scattered and reflected light, by random walks from the camera.

A walk follows a camera ray through the water. It ends on a surface or is scattered on its path, and continues from
there. At each vertex it collects three parts of the laser's light:

- light that the sheet scatters into the next segment, at one position sampled from the sheet's profile along it;
- light that a lit surface reflects along that segment, if it ends on one;
- light of lit surfaces again, by connecting the vertex to a point sampled from the fan.

The last two estimate the same light and are combined by the balance heuristic (Veach 1997, Eq. 9.8). It prevents rare
bright samples: nearby stripes are found by the walk, distant ones by connections.

Directions are sampled from the scattering of the surface or the water. In scattering water they are also sampled from
forward scattering about the direction to the laser, which is the source of most scattered light. A third distribution
covers light that the nearby sheet scatters (`SheetLobe`).

Light that is both reflected by a mirror and scattered or reflected elsewhere is neglected.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass, replace
from typing import Any, cast

import drjit as dr
import mitsuba as mi
import numpy as np

from twin.backend.arrays import PCG32, Bool, BSDFPtr, Float, Point2f, Point3f, SurfaceInteraction3f, UInt32, Vector3f
from twin.light.illumination import Light, Passage, SheetLobe
from twin.light.pose import CLEAR_MM, Rays, SensorPose
from twin.light.sheet import SheetLight
from twin.light.water import Scattering, one_minus_cosine, rotate_about
from twin.rendering_options import Effects
from twin.scene.objects import Objects

_STEPS = 64
"""Largest number of segments of a walk; even in the most turbid waters fewer than one walk in 10^4 would be longer."""
_FEW = 2**16
"""Up to this number of walks, all segments are traced in one kernel, which is faster than one launch per segment."""
_TOWARDS_LASER = 0.15  # fraction of directions sampled about the direction to the laser
_TOWARDS_SHEET = 0.3  # fraction of directions sampled from the lobe of the nearby sheet
_NEAR_SHEET = 0.5  # fraction of scattering distances sampled about the position nearest to the sheet
_SURVIVES_FROM = 0.25  # walks with less than this fraction of their initial strength undergo Russian roulette


@dataclass
class _Walks:
    """State of walks in the sensor's OCS: ray, strength and weight, and the pixel or cell to add light to.

    ``density`` is the probability density of the ray's direction in 1/sr if a lit surface at its end counts, else 0.
    ``diffuse`` is True once the walk has left the camera's ray, ``reflected`` after a reflection, ``scattered`` after
    scattering by water.
    """

    origin: Point3f
    direction: Vector3f
    strength: Float
    weight: Float
    cell: UInt32
    number: UInt32
    density: Float
    diffuse: Bool
    reflected: Bool
    scattered: Bool

    def select(self, kept: UInt32) -> _Walks:
        """Return the walks with the given indices."""
        return _Walks(*(dr.gather(type(each), each, kept) for each in vars(self).values()))


@dataclass(frozen=True)
class Walker:
    """Tracer of walks for one scene, pose and set of direct lights; rays without a hit end after ``reach_mm``."""

    objects: Objects
    scattering: Scattering
    effects: Effects
    pose: SensorPose
    lights: list[Light]
    reach_mm: Float

    @property
    def scatters(self) -> bool:
        """True if the water scatters walks."""
        return self.effects.multiple_scattering and self.scattering.coefficient > 0

    @property
    def finds_light(self) -> bool:
        """True if any indirect light is rendered."""
        return self.scatters or self.effects.secondary_light

    def trace(self, bundle: Rays, cell: UInt32, *, seed: int) -> Iterator[tuple[np.ndarray, np.ndarray, np.ndarray]]:
        """Trace walks; yield for each group of segments the cells (N,) and two kinds of light (N,).

        The first kind was scattered by water, the second only reflected between surfaces. Both include the ray's
        weight.
        """
        width = dr.width(cell)
        if not self.finds_light:
            return
        walks = _Walks(
            bundle.origin,
            bundle.direction,
            dr.full(mi.Float, 1.0, width),
            bundle.weight,
            cell,
            dr.arange(mi.UInt32, width),
            dr.zeros(mi.Float, width),
            dr.full(mi.Bool, False, width),
            dr.full(mi.Bool, False, width),
            dr.full(mi.Bool, False, width),
        )
        step, stretches = 0, 1
        while True:
            number = dr.opaque(mi.UInt32, (seed * _STEPS + step) % 2**32)
            # Camera rays have a separate kernel, as most of their state is constant.
            walks, found, alive = (
                self._trace_segments(walks, number, stretches) if step else self._trace_segment(walks, number)
            )
            dr.eval(found, alive, *vars(walks).values())
            # Returned unsummed: parallel sums in Dr.Jit are not reproducible.
            yield walks.cell.numpy(), found.x.numpy(), found.y.numpy()
            step += stretches
            kept = cast(Any, dr.compress(alive))
            if dr.width(kept) == 0 or step >= _STEPS:
                return
            if dr.width(kept) == 1:
                # Arrays of one entry would compile another kernel: use two halves.
                kept = mi.UInt32([kept[0], kept[0]])
                walks.weight *= 0.5
            walks = walks.select(kept)
            stretches = 1 if dr.width(kept) > _FEW else _STEPS - step

    def _trace_segments(self, walks: _Walks, seed: UInt32, stretches: int) -> tuple[_Walks, Point2f, Bool]:
        """Trace several segments of the walks in one kernel, which does not depend on their number."""

        def following(walks: _Walks, found: Point2f, alive: Bool, seed: UInt32, left: UInt32):
            walks, more, alive = self._trace_segment(walks, seed)
            return walks, mi.Point2f(found + more), alive, seed + 1, left - 1

        width = dr.width(walks.cell)
        # Skip the search for loop invariants, which finds almost none and traces the loop twice.
        with dr.scoped_set_flag(dr.JitFlag.OptimizeLoops, False):
            walks, found, alive, _, _ = dr.while_loop(
                (
                    walks,
                    dr.zeros(mi.Point2f, width),
                    dr.full(mi.Bool, True, width),
                    seed,
                    dr.opaque(mi.UInt32, stretches),
                ),
                lambda walks, found, alive, seed, left: alive & (left > 0),
                following,
                mode="symbolic",
                label="walks",
            )
        return walks, found, alive

    def _trace_segment(self, walks: _Walks, seed: UInt32) -> tuple[_Walks, Point2f, Bool]:
        """Trace the next segment of all walks; return their new state, both kinds of light, and the live mask."""
        state, sequence = mi.sample_tea_32(seed, walks.number)
        random = cast(Any, mi.PCG32)
        rng: PCG32 = random(size=dr.width(walks.number), initstate=mi.UInt64(state), initseq=mi.UInt64(sequence))
        o, d, c = walks.origin, walks.direction, self.scattering.c
        si = self.objects.scene.ray_intersect(self.pose.ray(o, d))
        hit = si.is_valid()
        length = dr.select(hit, si.t, self.reach_mm)
        end = mi.Point3f(o + d * length)
        context = mi.BSDFContext()
        bsdf = si.bsdf()
        mirror = dr.select(hit, self.objects.mirror_share(si), 0.0)

        from_sheet, from_surfaces = mi.Float(0.0), mi.Float(0.0)
        passages = [light.locate_sheet(o, d, length) for light in self.lights if self.scatters]
        for light, passage in zip(self.lights, passages, strict=False):
            from_sheet += self._scatter_from_sheet(light, passage, o, d, walks.diffuse, rng.next_float32())
        for light in self.lights:
            from_surfaces += dr.exp(-c * length) * self._add_lit_end(light, walks, si, bsdf, end, hit)

        # The walk is scattered or reaches the surface, and survives Russian roulette.
        in_water, distance, passed = _sample_free_path(self.scattering, passages, length, hit, self.reach_mm, rng)
        vertex = mi.Point3f(o + d * distance)
        reflected, scattered_now = cast(Bool, walks.reflected | ~in_water), cast(Bool, walks.scattered | in_water)
        here = [light.evaluate(vertex) for light in self.lights]
        towards_laser = [-each.direction for each in here]
        sheets = [SheetLobe.from_light(each, self.scattering.over_sine) for each in here]
        by_water = walks.strength * (from_sheet + dr.select(walks.scattered, from_surfaces, 0.0))
        between_surfaces = walks.strength * dr.select(walks.scattered, 0.0, from_surfaces)
        strength = walks.strength * passed
        # Walks directed towards the laser may find more light after scattering, and survive more often.
        promise = mi.Float(1.0)
        for towards in towards_laser if self.scatters else ():
            ahead = 4 * math.pi * self.scattering.phase(one_minus_cosine(towards, d))
            promise = dr.maximum(promise, dr.select(in_water, ahead, 1.0))
        survival = dr.minimum(strength * promise / _SURVIVES_FROM, 1.0)
        alive = (strength > 0) & (rng.next_float32() < survival)
        strength = dr.select(alive, strength / survival, 0.0)

        whole = dr.select(in_water, 1.0, 1 - mirror)
        of_laser, of_sheet = _TOWARDS_LASER / len(self.lights), _TOWARDS_SHEET / len(self.lights)

        def scattered(onward: Vector3f) -> tuple[Float, Float]:
            """Return the light scattered from ``onward`` into the walk, per sr, and the sampling density."""
            reflectance, density = bsdf.eval_pdf(context, si, si.to_local(self.pose.direction(onward)), hit & ~in_water)
            value = dr.select(in_water, self.scattering.phase(one_minus_cosine(d, onward)), reflectance[0])
            density = dr.select(in_water, value, density * (1 - mirror))
            if self.scatters:
                density *= 1 - _TOWARDS_LASER - _TOWARDS_SHEET
                for towards, sheet in zip(towards_laser, sheets, strict=True):
                    density += whole * of_laser * self.scattering.narrow.density(one_minus_cosine(towards, onward))
                    density += whole * of_sheet * sheet.density(onward)
            return value, density

        may_connect = alive if self.effects.secondary_light else alive & ~reflected
        for light in self.lights:
            u = mi.Point3f(rng.next_float32(), rng.next_float32(), rng.next_float32())
            connected = strength * self._connect(light, vertex, scattered, u, may_connect)
            by_water += dr.select(scattered_now, connected, 0.0)
            between_surfaces += dr.select(scattered_now, 0.0, connected)

        # New direction: mirror reflection, about the laser's direction, into the sheet, or from the vertex.
        choice, which = rng.next_float32(), rng.next_float32()
        u1, u2 = rng.next_float32(), mi.Point2f(rng.next_float32(), rng.next_float32())
        specular = ~in_water & (choice < mirror)
        sample, _ = bsdf.sample(context, si, u1, u2, hit & ~in_water)
        onward = self.pose.object_direction(si.to_world(sample.wo))
        if self.scatters:
            # One look-up serves all tables.
            table, axis, share = self.scattering.angles, d, u2.x
            laser, first = dr.full(mi.Bool, False, dr.width(which)), 0.0
            by_sheet = []
            for towards, sheet in zip(towards_laser, sheets, strict=True):
                about = (which >= first) & (which < first + of_laser)
                first += of_laser
                chosen = (which >= first) & (which < first + of_sheet)
                first += of_sheet
                table = table.select(about, self.scattering.narrow).select(chosen, sheet.angles)
                axis = dr.select(about, towards, axis)
                share = dr.select(chosen, sheet.share_below(u2.x), share)
                laser |= about
                by_sheet.append((sheet, chosen))
            heights = table.heights(share)
            onward = dr.select(in_water | laser, rotate_about(axis, heights, u2.y), onward)
            for sheet, chosen in by_sheet:
                drawn, valid = sheet.rotate_to_angles(heights, u2.y)
                onward = dr.select(chosen & valid, drawn, onward)
                strength = dr.select(chosen & ~valid & ~specular, 0.0, strength)
        onward = dr.select(specular, self.pose.object_direction(si.to_world(mi.reflect(si.wi))), onward)
        value, density = scattered(onward)
        gain = dr.select(specular, 1.0, dr.select(density > 0, value / density, 0.0))
        strength *= gain
        alive &= (strength > 0) & dr.isfinite(strength)
        diffuse = walks.diffuse | ~specular
        following = replace(
            walks,
            origin=mi.Point3f(vertex + onward * dr.select(in_water, 0.0, CLEAR_MM)),
            direction=onward,
            strength=strength,
            density=dr.select(specular | ~diffuse, 0.0, density),
            diffuse=diffuse,
            reflected=reflected,
            scattered=scattered_now,
        )
        return following, mi.Point2f(walks.weight * by_water, walks.weight * between_surfaces), alive

    def _scatter_from_sheet(
        self, light: Light, passage: Passage, o: Point3f, d: Vector3f, active: Bool, u: Float
    ) -> Float:
        """Return the radiance that the sheet scatters once into rays, estimated at one position of each."""
        t, density = passage.sample(u)
        p = mi.Point3f(o + d * t)
        here = light.evaluate(p)
        active = active & (density > 0) & (here.irradiance > 0)
        lit = light.reaches(self.objects.scene, p, here, None, active)
        source = here.irradiance * self.scattering.phase(one_minus_cosine(-here.direction, d))
        value = self.scattering.b * source * dr.exp(-self.scattering.c * t) / density
        return dr.select(lit, value, 0.0)

    def _add_lit_end(
        self, light: Light, walks: _Walks, si: SurfaceInteraction3f, bsdf: BSDFPtr, end: Point3f, hit: Bool
    ) -> Float:
        """Return the radiance of the lit surface at the segment's end, with its balance-heuristic weight."""
        here = light.evaluate(end)
        towards = si.to_local(self.pose.direction(-here.direction))
        active = hit & (walks.density > 0) & (here.irradiance > 0)
        if not self.effects.secondary_light:
            active &= ~walks.reflected
        active = light.reaches(self.objects.scene, end, here, None, active)
        radiance = bsdf.eval(mi.BSDFContext(), si, towards, active)[0] * here.irradiance
        # Both densities are per sr: per mm2, the density of a walk along its own surface is unbounded.
        by_walk = walks.density * dr.abs(mi.Frame3f.cos_theta(si.wi))
        by_light = _find_light_density(self.scattering.c, light, here, mi.Frame3f.cos_theta(towards)) * dr.square(si.t)
        return dr.select(active & (by_walk > 0), radiance * by_walk / (by_walk + by_light), 0.0)

    def _connect(self, light: Light, vertex: Point3f, scattered, u: Point3f, active: Bool) -> Float:
        """Return the light that the vertex receives from a sampled lit point and scatters into the walk.

        Lit points are sampled in proportion to power.
        """
        origin, towards = light.sample_rays(u)
        ray = self.pose.ray(origin, towards)
        si = self.objects.scene.ray_intersect(ray, active)
        lit = mi.Point3f(origin + towards * si.t)
        active = active & si.is_valid()
        offset = vertex - lit
        distance = dr.norm(offset)
        direction = offset / distance
        local = si.to_local(self.pose.direction(direction))
        sent = si.bsdf().eval(mi.BSDFContext(), si, local, active)[0]
        value, density = scattered(-direction)
        shadow = self.pose.ray(lit + direction * CLEAR_MM, direction)
        shadow.maxt = distance - 2 * CLEAR_MM
        active &= (sent * value > 0) & (distance > 2 * CLEAR_MM)
        active &= ~self.objects.scene.ray_test(shadow, active)
        here = light.evaluate(lit)
        by_light = _find_light_density(self.scattering.c, light, here, mi.Frame3f.cos_theta(si.wi))
        by_walk = density * dr.abs(mi.Frame3f.cos_theta(local)) / dr.square(distance)
        way = here.exit_mm + distance
        light_there = light.power_w * sent * dr.exp(-self.scattering.c * way) / dr.square(distance)
        return dr.select(active & (by_light > 0), value * light_there * by_light / (by_light + by_walk), 0.0)


def _find_light_density(extinction: Float, light: Light, here: SheetLight, cosine: Float) -> Float:
    """Return the density per mm2 of the lit points sampled by `Walker._connect`: the fraction of power per area."""
    return here.irradiance * dr.exp(extinction * here.exit_mm) * dr.abs(cosine) / light.power_w


def _sample_free_path(
    scattering: Scattering, passages: list[Passage], length: Float, hit: Bool, reach_mm: Float, rng: PCG32
) -> tuple[Bool, Float, Float]:
    """Sample whether walks are scattered before the surface; return mask, distance and remaining strength.

    Scattering is selected in proportion to its expected light relative to the surface, with a probability of 0.3 to
    0.7. Distances are exponential with a decay length of at most a quarter of ``reach_mm``: in clear water,
    scattering must not be far behind the scene. Alternatively they are sampled in inverse proportion to the
    distance from the position nearest to the sheet, as the light of the sheet decays.
    """
    choice, near, u = rng.next_float32(), rng.next_float32(), rng.next_float32()
    c = scattering.c
    through = dr.exp(-c * length)
    if not passages:
        return dr.full(mi.Bool, False, dr.width(hit)), length, dr.select(hit, through, 0.0)
    fall = dr.maximum(c, 4 / reach_mm)
    share = 1 - dr.exp(-fall * length)
    promised = scattering.b / fall * share
    likely = dr.select(hit, dr.clip(promised / (promised + 0.5 * through), 0.3, 0.7), 1.0)
    in_water = choice < likely
    distance = -dr.log(1 - u * share) / fall
    each = _NEAR_SHEET / len(passages)
    crossings = [passage.find_nearest() for passage in passages]
    spans = [(dr.log(1 + t / to_sheet), dr.log(1 + (length - t) / to_sheet)) for t, to_sheet in crossings]
    for k, ((t, to_sheet), (before, after)) in enumerate(zip(crossings, spans, strict=True)):
        place = u * (before + after) - before
        drawn = t + dr.mulsign(to_sheet * (dr.exp(dr.abs(place)) - 1), place)
        distance = dr.select((near >= k * each) & (near < (k + 1) * each), dr.clip(drawn, 0.0, length), distance)
    density = (1 - _NEAR_SHEET) * fall * dr.exp(-fall * distance) / share
    for (t, to_sheet), (before, after) in zip(crossings, spans, strict=True):
        density += each / ((dr.abs(distance - t) + to_sheet) * (before + after))
    scattered = scattering.b * dr.exp(-c * distance) / (density * likely)
    return in_water, dr.select(in_water, distance, length), dr.select(in_water, scattered, through / (1 - likely))
