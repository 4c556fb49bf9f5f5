"""Ground truth of a frame: the stripe's centres, the surface there, depths, and the image of points of a scene."""

from dataclasses import dataclass

import drjit as dr
import mitsuba as mi
import numpy as np

from twin.backend.arrays import Float, UInt32, to_jit, to_numpy
from twin.light.image_sampling import places
from twin.light.pose import SensorPose, Travel
from twin.light.renderer import Renderer
from uwlts.model.placement import camera_from_object
from uwlts.storage.truth import TruthStatus

_FALSE_POSITIONS = 5
"""Within one pixel the distance bends by about 1e-2 of its change: each step gains two digits."""
_POINT_STEPS = 6
"""The window bends rays so little that each step of Newton's method leaves a hundredth of the error."""
_POINT_MM = 0.05
"""A point is seen if its ray meets nothing so much before it: far above the rounding of 32 bits."""
_POINT_PX = 1e-2
"""A point is found if the last step was no larger."""
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


@dataclass(frozen=True)
class Crossings:
    """Where profile lines see the middle of the sheet on a surface, K of them, lit or in the shadow.

    ``line`` (K,) is the line's number, ``centre_px`` (K,) the image coordinate across the stripe, ``brightness`` (K,)
    the laser's irradiance on the image sensor in W/mm2, 0 in the shadow. ``point_mm`` and ``normal`` (K, 3) are the
    surface there in scene coordinates, ``thing`` (K,) is the number of the object among the scene's.
    """

    line: np.ndarray
    centre_px: np.ndarray
    brightness: np.ndarray
    point_mm: np.ndarray
    normal: np.ndarray
    thing: np.ndarray


def true_stripe(renderer: Renderer, scene_from_object: np.ndarray, *, travel: Travel | None = None) -> FrameTruth:
    """True stripe of a frame: of every profile line's lit crossings of the sheet the brightest.

    It is what chief rays see in the middle of the exposure.
    """
    return brightest(crossings(renderer, scene_from_object, travel=travel), renderer.sensor.camera.lines())


def brightest(found: Crossings, lines: int) -> FrameTruth:
    """Truth of a frame of so many profile lines by its crossings."""
    truth = no_stripe(lines)
    dimmest_first = lit_dimmest_first(found)
    chosen = found.line[dimmest_first]
    np.add.at(truth.crossings, chosen, 1)
    truth.centre_px[chosen] = found.centre_px[dimmest_first]
    truth.point_mm[chosen] = found.point_mm[dimmest_first]
    truth.normal[chosen] = found.normal[dimmest_first]
    truth.status[chosen] = TruthStatus.VISIBLE
    return truth


def lit_dimmest_first(found: Crossings) -> np.ndarray:
    """Numbers of the lit crossings in the order of their brightness: the last of a line is its brightest."""
    lit = np.flatnonzero(found.brightness > 0)
    return lit[np.argsort(found.brightness[lit], kind="stable")]


def crossings(renderer: Renderer, scene_from_object: np.ndarray, *, travel: Travel | None = None) -> Crossings:
    """All crossings of a frame, by false position on Mitsuba's own hit points along every profile line."""
    camera = renderer.sensor.camera
    pose = SensorPose(scene_from_object, travel)
    along_width = camera.stripe_along == "width"
    rows, columns = renderer.lit_pixels(pose)
    line, cell = (columns, rows) if along_width else (rows, columns)
    none, vectors = np.zeros(0), np.zeros((0, 3))
    nothing = Crossings(none.astype(int), none, none, vectors, vectors, none.astype(int))
    if len(line) == 0:
        return nothing

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

    # Neighbours across the stripe share an edge.
    marked = np.zeros((camera.lines(), (camera.height_px if along_width else camera.width_px) + 1), bool)
    marked[line, cell] = marked[line, cell + 1] = True
    edge_line, edge = places(marked)
    edges = np.empty(marked.shape, np.float32)
    edges[edge_line, edge] = distance(to_jit(mi.Float, edge - 0.5), to_jit(mi.Float, edge_line)).numpy()
    below, above = edges[line, cell], edges[line, cell + 1]
    bracketed = (below <= 0) != (above <= 0)
    bracketed &= np.isfinite(below) & np.isfinite(above)
    line, cell, below, above = line[bracketed], cell[bracketed], below[bracketed], above[bracketed]
    if len(line) == 0:
        return nothing
    at, low, high = to_jit(mi.Float, line), to_jit(mi.Float, cell - 0.5), to_jit(mi.Float, cell + 0.5)
    below, above = to_jit(mi.Float, below), to_jit(mi.Float, above)

    def narrowed(low: Float, high: Float, below: Float, above: Float, at: Float, left: UInt32) -> tuple[Float, ...]:
        centre = low + (high - low) * below / (below - above)
        found = distance(centre, at)
        same_side = (found <= 0) == (below <= 0)
        low, below = dr.select(same_side, centre, low), dr.select(same_side, found, below)
        high, above = dr.select(same_side, high, centre), dr.select(same_side, above, found)
        return low, high, below, above, at, left - 1

    # Written down once, as in `Walker`.
    with dr.scoped_set_flag(dr.JitFlag.OptimizeLoops, False):
        low, high, below, above, at, _ = dr.while_loop(
            (low, high, below, above, at, dr.full(mi.UInt32, _FALSE_POSITIONS, len(line))),
            lambda low, high, below, above, at, left: left > 0,
            narrowed,
            mode="symbolic",
        )
    centre = low + (high - low) * below / (below - above)
    dr.eval(centre)
    bundle = renderer.view.bundle(*position(centre, at))
    brightness, seen = renderer.laser(pose, bundle, travelled(centre, at))
    si, offset = seen.si, dr.select(seen.valid, renderer.sheet.at(seen.end()).distance_mm, dr.nan)
    thing = renderer.objects.number(si.shape, seen.valid)
    dr.eval(centre, brightness, si.p, si.n, offset, thing)
    good = np.abs(offset.numpy()) < _TOLERANCE_MM
    # In the order of `Crossings`' fields.
    arrays = line, centre.numpy(), brightness.numpy(), to_numpy(si.p), to_numpy(si.n), thing.numpy()
    return Crossings(*(values[good] for values in arrays))


def depth_map(renderer: Renderer, scene_from_object: np.ndarray) -> np.ndarray:
    """Camera-frame z in mm (H, W), float32, of the surface that every pixel's centre sees; NaN where there is none."""
    return seen_surfaces(renderer, scene_from_object)[0]


def seen_surfaces(renderer: Renderer, scene_from_object: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """What every pixel's centre sees: its depth as `depth_map`, and its object's number (H, W), -1 for nothing."""
    camera = renderer.sensor.camera
    x, y = np.meshgrid(np.arange(camera.width_px, dtype=np.float32), np.arange(camera.height_px, dtype=np.float32))
    bundle = renderer.view.bundle(to_jit(mi.Float, x), to_jit(mi.Float, y))
    ray = SensorPose(scene_from_object).ray(bundle.origin, bundle.direction)
    hit = renderer.objects.scene.ray_intersect_preliminary(ray)
    depth = renderer.view.depth_mm(mi.Point3f(bundle.origin + bundle.direction * hit.t))
    seen = hit.is_valid() & (bundle.weight > 0)
    depth, number = dr.select(seen, depth, dr.nan), renderer.objects.number(hit.shape, seen)
    dr.eval(depth, number)
    return depth.numpy().reshape(x.shape), number.numpy().reshape(x.shape)


def image_points(renderer: Renderer, scene_from_object: np.ndarray, points_mm: np.ndarray) -> np.ndarray:
    """Image points (N, 2) in px at which points (N, 3) of the scene are seen; NaN where one is hidden or out of view.

    Newton's method on the chief rays: a ray's distance from its point is brought to zero.
    """
    camera, transform = renderer.sensor.camera, np.linalg.inv(scene_from_object)
    points = points_mm @ transform[:3, :3].T + transform[:3, 3]
    seen = points @ camera_from_object(renderer.sensor)[:3, :3].T + camera_from_object(renderer.sensor)[:3, 3]
    size = np.array([camera.width_px, camera.height_px])
    pixels = seen[:, :2] / seen[:, 2:] * camera.focal_lengths_px() + camera.principal_point()
    steps = np.full_like(pixels, np.inf)
    for _ in range(_POINT_STEPS):
        pixels = np.clip(pixels, -0.1 * size, 1.1 * size)
        at = pixels[:, None] + [(0, 0), (1, 0), (0, 1)]
        bundle = renderer.view.bundle(to_jit(mi.Float, at[..., 0]), to_jit(mi.Float, at[..., 1]))
        dr.eval(bundle.origin, bundle.direction)
        origin, direction = (
            to_numpy(v).astype(float).reshape(at.shape[:2] + (3,)) for v in (bundle.origin, bundle.direction)
        )
        towards = points[:, None] - origin
        miss = towards - np.sum(towards * direction, axis=2, keepdims=True) * direction
        slopes = np.stack([miss[:, 1] - miss[:, 0], miss[:, 2] - miss[:, 0]], axis=2)
        steps = np.einsum("nij,nj->ni", np.linalg.pinv(slopes), miss[:, 0])
        pixels = pixels - steps
    bundle = renderer.view.bundle(*(to_jit(mi.Float, axis) for axis in pixels.T))
    hit = renderer.objects.scene.ray_intersect_preliminary(
        SensorPose(scene_from_object).ray(bundle.origin, bundle.direction)
    )
    dr.eval(hit.t, bundle.origin, bundle.weight)
    length = np.linalg.norm(points - to_numpy(bundle.origin), axis=1)
    inside = ((pixels > -0.5) & (pixels < size - 0.5)).all(axis=1) & (bundle.weight.numpy() > 0)
    found = inside & (np.abs(hit.t.numpy() - length) < _POINT_MM) & (np.abs(steps).max(axis=1) < _POINT_PX)
    return np.where(found[:, None], pixels, np.nan)
