"""Ground truth of a frame: true stripe centres of all profile lines, the points of the surface there, and depths."""

from __future__ import annotations

from dataclasses import dataclass

import drjit as dr
import mitsuba as mi
import numpy as np

from twin.backend.arrays import Float, to_jit, to_numpy
from twin.light.pose import SensorPose, Travel
from twin.light.renderer import Renderer
from uwlts.storage.truth import TruthStatus

_FALSE_POSITIONS = 5
"""Within one pixel the distance bends by about 1e-2 of its change: each step gains two digits."""
_TOLERANCE_MM = 5e-4
"""A root is where the surface truly passes the sheet's middle; across a depth edge the distance jumps instead."""


@dataclass(frozen=True)
class FrameTruth:
    """Truth of one frame, as in `uwlts.storage.truth.Truth` without the frames' axis."""

    centre_px: np.ndarray
    point_mm: np.ndarray
    normal: np.ndarray
    status: np.ndarray
    crossings: np.ndarray


def no_stripe(lines: int) -> FrameTruth:
    """Truth of a frame without laser light."""
    nothing = np.full(lines, np.nan)
    empty = np.zeros(lines, np.uint8)
    return FrameTruth(
        nothing, np.full((lines, 3), np.nan), np.full((lines, 3), np.nan), empty + TruthStatus.NO_STRIPE, empty
    )


def true_stripe(renderer: Renderer, scene_from_object: np.ndarray, *, travel: Travel | None = None) -> FrameTruth:
    """True stripe of a frame, by false position on Mitsuba's own hit points along every profile line.

    It is what chief rays see in the middle of the exposure.
    """
    camera = renderer.sensor.camera
    pose = SensorPose(scene_from_object, travel)
    along_width = camera.stripe_along == "width"
    rows, columns = renderer.lit_pixels(pose)
    line, cell = (columns, rows) if along_width else (rows, columns)
    truth = no_stripe(camera.lines())
    if len(line) == 0:
        return truth

    def position(across: Float, at: Float) -> tuple[Float, Float]:
        return (at, across) if along_width else (across, at)

    def travelled(across: Float, at: Float) -> Float | None:
        return None if travel is None else travel.at(position(across, at)[1], 0.5)

    def distance(across: Float, at: Float) -> Float:
        bundle = renderer.view.bundle(*position(across, at))
        ray = pose.ray(bundle.origin, bundle.direction, travelled(across, at))
        hit = renderer.objects.scene.ray_intersect_preliminary(ray)
        light = renderer.sheet.at(bundle.origin + bundle.direction * dr.select(hit.is_valid(), hit.t, 1.0))
        return dr.select(hit.is_valid() & (bundle.weight > 0), light.distance_mm, dr.nan)

    at, middle = to_jit(mi.Float, line), to_jit(mi.Float, cell)
    below, above = distance(middle - 0.5, at), distance(middle + 0.5, at)
    dr.eval(below, above)
    below, above = below.numpy(), above.numpy()
    bracketed = (below <= 0) != (above <= 0)
    bracketed &= np.isfinite(below) & np.isfinite(above)
    line, cell, below, above = line[bracketed], cell[bracketed], below[bracketed], above[bracketed]
    if len(line) == 0:
        return truth
    at, low, high = to_jit(mi.Float, line), to_jit(mi.Float, cell - 0.5), to_jit(mi.Float, cell + 0.5)
    below, above = to_jit(mi.Float, below), to_jit(mi.Float, above)
    for _ in range(_FALSE_POSITIONS):
        centre = low + (high - low) * below / (below - above)
        found = distance(centre, at)
        same_side = (found <= 0) == (below <= 0)
        low, below = dr.select(same_side, centre, low), dr.select(same_side, found, below)
        high, above = dr.select(same_side, high, centre), dr.select(same_side, above, found)
        dr.eval(low, high, below, above)  # one small kernel five times instead of a large one
    centre = low + (high - low) * below / (below - above)
    dr.eval(centre)
    bundle = renderer.view.bundle(*position(centre, at))
    brightness = renderer.laser(pose, bundle, travelled(centre, at))
    si = renderer.objects.scene.ray_intersect(pose.ray(bundle.origin, bundle.direction, travelled(centre, at)))
    offset = distance(centre, at)
    dr.eval(centre, brightness, si.p, si.n, offset)
    brightness = brightness.numpy()
    good = (np.abs(offset.numpy()) < _TOLERANCE_MM) & (brightness > 0)
    dimmest_first = np.flatnonzero(good)[np.argsort(brightness[good], kind="stable")]
    chosen = line[dimmest_first]
    np.add.at(truth.crossings, chosen, 1)
    truth.centre_px[chosen] = centre.numpy()[dimmest_first]
    truth.point_mm[chosen] = to_numpy(si.p)[dimmest_first]
    truth.normal[chosen] = to_numpy(si.n)[dimmest_first]
    truth.status[chosen] = TruthStatus.VISIBLE
    return truth


def depth_map(renderer: Renderer, scene_from_object: np.ndarray) -> np.ndarray:
    """Camera-frame z in mm (H, W), float32, of the surface that every pixel's centre sees; NaN where there is none."""
    camera = renderer.sensor.camera
    x, y = np.meshgrid(np.arange(camera.width_px, dtype=np.float32), np.arange(camera.height_px, dtype=np.float32))
    bundle = renderer.view.bundle(to_jit(mi.Float, x), to_jit(mi.Float, y))
    ray = SensorPose(scene_from_object).ray(bundle.origin, bundle.direction)
    hit = renderer.objects.scene.ray_intersect_preliminary(ray)
    depth = renderer.view.depth_mm(mi.Point3f(bundle.origin + bundle.direction * hit.t))
    return dr.select(hit.is_valid() & (bundle.weight > 0), depth, dr.nan).numpy().reshape(x.shape)
