"""Ground truth of a frame: stripe centres, surface points, depths, and image positions of scene points."""

from dataclasses import dataclass, replace

import drjit as dr
import mitsuba as mi
import numpy as np

from twin.backend.arrays import Float, UInt32, to_jit, to_numpy
from twin.light.image_sampling import find_marked
from twin.light.pose import Rays, SensorPose, Travel
from twin.light.renderer import Renderer
from uwlts.model.placement import camera_from_object
from uwlts.storage.truth import TruthStatus

_FALSE_POSITIONS = 5
"""Number of iterations: within a pixel, the distance is linear to about 1e-2, so each step gains two digits."""
_POINT_STEPS = 6
"""Number of iterations: refraction at the window is weak, so each Newton step reduces the error to a hundredth."""
_POINT_MM = 0.05
"""A point is visible if its ray ends on a surface at this distance from it, far above single-precision rounding."""
_POINT_PX = 1e-2  # a point is found if the last Newton step was smaller
_TOLERANCE_MM = 5e-4
"""Largest distance of a root from the sheet's centre; across a depth edge, the distance has a jump instead of a root.
"""


_FAINTEST = 1e-3
"""Fraction of the light at a stripe's centre at which the stripe ends: 3.7 standard deviations of a Gaussian."""
_LEAST_MIXED = 1e-6
"""Mixed fraction below which it is 0, because some processors and threads flush tiny numbers to zero."""


@dataclass(frozen=True)
class FrameTruth:
    """Truth of one frame, as `uwlts.storage.truth.Truth` without the frame axis."""

    centre_px: np.ndarray
    point_mm: np.ndarray
    normal: np.ndarray
    status: np.ndarray
    crossings: np.ndarray
    centroid_px: np.ndarray
    visible_fraction: np.ndarray
    mixed_fraction: np.ndarray

    def surface_lines(self) -> np.ndarray:
        """Return points and normals (2, L, 3) of the profile lines."""
        return np.stack([self.point_mm, self.normal])


def make_empty_truth(lines: int) -> FrameTruth:
    """Return the truth of a frame without laser light."""
    number, vector, empty = np.full(lines, np.nan), np.full((lines, 3), np.nan), np.zeros(lines, np.uint8)
    status = empty + TruthStatus.NO_STRIPE
    return FrameTruth(number, vector, vector.copy(), status, empty, *(number.copy() for _ in range(3)))


@dataclass(frozen=True)
class Crossings:
    """Intersections of the sheet's centre with surfaces on K profile lines, lit or in shadow."""

    line: np.ndarray  # (K,); number of the line
    centre_px: np.ndarray  # (K,); image coordinate across the stripe
    brightness: np.ndarray  # (K,); the laser's irradiance on the image sensor in W/mm2, 0 in shadow
    point_mm: np.ndarray  # (K, 3); in scene coordinates, as the normal
    normal: np.ndarray
    thing: np.ndarray  # (K,); index of the object in the scene


def find_true_stripe(renderer: Renderer, scene_from_object: np.ndarray, *, travel: Travel | None = None) -> FrameTruth:
    """Return the true stripe of a frame without its light: the brightest lit crossing of every profile line.

    It applies to chief rays in the middle of the exposure.
    """
    return select_brightest(find_crossings(renderer, scene_from_object, travel=travel), renderer.sensor.camera.lines())


def measure_line_light(
    renderer: Renderer, scene_from_object: np.ndarray, truth: FrameTruth, *, spp: int, travel: Travel | None = None
) -> FrameTruth:
    """Return the truth of a frame with centroid, visible and mixed fraction of each line's stripe.

    Light comes directly from lit surfaces, over pixel, pupil and exposure. A line's stripe is the run of pixels about
    its centre that exceed 1e-3 of the light there. Speckle, haze, other indirect light, side lobes of the sheet, losses
    of the lens and noise are excluded.
    """
    lines = np.flatnonzero(truth.status == TruthStatus.VISIBLE)
    if len(lines) == 0:
        return truth
    pose, centre = SensorPose(scene_from_object, travel), truth.centre_px[lines]
    *pixels, values = renderer.render_line_light(pose, truth.surface_lines(), spp=spp)
    line, across = pixels[::-1] if renderer.sensor.camera.stripe_along == "width" else pixels
    # Pixels across the stripe from its centre, of the visible lines only.
    middle = np.rint(centre)
    column = np.searchsorted(lines, line)
    offset = across - middle[column].astype(int)
    reach = int(np.abs(offset[values[0] > 0]).max(initial=0)) + 1
    near = np.abs(offset) <= reach
    values, column, offset = values[:, near], column[near], offset[near]
    window = np.zeros((2 * reach + 1, len(lines)))
    window[offset + reach, column] = values[0]
    of_run = mark_run(window, np.full(len(lines), reach), _FAINTEST)[offset + reach, column]
    values, column, offset = values[:, of_run], column[of_run], offset[of_run]

    def sum_lines(weights: np.ndarray) -> np.ndarray:
        return np.bincount(column, weights, len(lines))

    total, other, profile = values
    light = sum_lines(total)
    slope = np.abs(_compute_distance_slopes(renderer, pose, truth, lines))
    with np.errstate(divide="ignore", invalid="ignore"):
        measured = {
            "centroid_px": centre + sum_lines((offset + middle[column] - centre[column]) * total) / light,
            "visible_fraction": np.where(light > 0, np.minimum(slope * sum_lines(profile), 1.0), np.nan),
            "mixed_fraction": sum_lines(other) / light,
        }
    measured["mixed_fraction"][measured["mixed_fraction"] < _LEAST_MIXED] = 0.0
    filled = {name: getattr(truth, name).copy() for name in measured}
    for name, values in measured.items():
        filled[name][lines] = values
    return replace(truth, **filled)


def mark_run(light: np.ndarray, centre: np.ndarray, share: float) -> np.ndarray:
    """Return the mask (A, L) of each line's run of pixels that exceed ``share`` of the light at its centre.

    ``light`` (A, L) is that of A pixels across the stripe on L lines, ``centre`` (L,) in px across the stripe. The
    light at a centre is the largest of three pixels.
    """
    across, place = len(light), np.arange(len(light))[:, None]
    middle = np.clip(np.rint(centre).astype(int), 0, across - 1)
    around = np.clip(middle + np.array([-1, 0, 1])[:, None], 0, across - 1)
    dark = light <= share * light[around, np.arange(len(centre))].max(axis=0)
    before = np.where(dark & (place <= middle), place, -1).max(axis=0)
    behind = np.where(dark & (place >= middle), place, across).min(axis=0)
    return (place > before) & (place < behind)


def _compute_distance_slopes(renderer: Renderer, pose: SensorPose, truth: FrameTruth, lines: np.ndarray) -> np.ndarray:
    """Return the derivative of the sheet's distance on the lines' tangent planes across the stripe, in mm/px."""
    point, normal = (mi.Vector3f(*(to_jit(axis) for axis in v[lines].T)) for v in (truth.point_mm, truth.normal))
    at, distance = to_jit(lines), []
    for aside in (-0.5, 0.5):
        bundle, after_s = _trace_lines(renderer, pose, at, to_jit(truth.centre_px[lines] + aside))
        ray = pose.ray(bundle.origin, bundle.direction, after_s)
        t = dr.dot(normal, point - mi.Vector3f(ray.o)) / dr.dot(normal, ray.d)
        place = mi.Point3f(bundle.origin + bundle.direction * t)
        distance.append(renderer.sheet.evaluate(place).distance_mm.numpy().astype(float))
    return distance[1] - distance[0]


def _trace_lines(renderer: Renderer, pose: SensorPose, line: Float, across: Float) -> tuple[Rays, Float | None]:
    """Return chief rays of places on profile lines, and their times in s after that of the pose; None: at rest."""
    x, y = (line, across) if renderer.sensor.camera.stripe_along == "width" else (across, line)
    return renderer.view.trace_bundle(x, y), None if pose.travel is None else pose.travel.compute_times(y, 0.5)


def select_brightest(found: Crossings, lines: int) -> FrameTruth:
    """Return the truth of a frame with ``lines`` profile lines from its crossings."""
    truth = make_empty_truth(lines)
    dimmest_first = sort_lit_crossings(found)
    chosen = found.line[dimmest_first]
    np.add.at(truth.crossings, chosen, 1)
    truth.centre_px[chosen] = found.centre_px[dimmest_first]
    truth.point_mm[chosen] = found.point_mm[dimmest_first]
    truth.normal[chosen] = found.normal[dimmest_first]
    truth.status[chosen] = TruthStatus.VISIBLE
    return truth


def sort_lit_crossings(found: Crossings) -> np.ndarray:
    """Return indices of the lit crossings in ascending brightness, so that the brightest of a line is the last."""
    lit = np.flatnonzero(found.brightness > 0)
    return lit[np.argsort(found.brightness[lit], kind="stable")]


def find_crossings(renderer: Renderer, scene_from_object: np.ndarray, *, travel: Travel | None = None) -> Crossings:
    """Find all crossings of a frame by the false-position method along every profile line."""
    camera = renderer.sensor.camera
    pose = SensorPose(scene_from_object, travel)
    along_width = camera.stripe_along == "width"
    rows, columns = renderer.locator.lit_pixels(pose)
    line, cell = (columns, rows) if along_width else (rows, columns)
    none, vectors = np.zeros(0), np.zeros((0, 3))
    nothing = Crossings(none.astype(int), none, none, vectors, vectors, none.astype(int))
    if len(line) == 0:
        return nothing

    def distance(across: Float, at: Float) -> Float:
        bundle, after_s = _trace_lines(renderer, pose, at, across)
        hit = renderer.objects.scene.ray_intersect_preliminary(pose.ray(bundle.origin, bundle.direction, after_s))
        light = renderer.sheet.evaluate(bundle.origin + bundle.direction * dr.select(hit.is_valid(), hit.t, 1.0))
        return dr.select(hit.is_valid() & (bundle.weight > 0), light.distance_mm, dr.nan)

    # Adjacent pixels across the stripe share an edge.
    marked = np.zeros((camera.lines(), (camera.height_px if along_width else camera.width_px) + 1), bool)
    marked[line, cell] = marked[line, cell + 1] = True
    edge_line, edge = find_marked(marked)
    edges = np.empty(marked.shape, np.float32)
    edges[edge_line, edge] = distance(to_jit(edge - 0.5), to_jit(edge_line)).numpy()
    below, above = edges[line, cell], edges[line, cell + 1]
    bracketed = (below <= 0) != (above <= 0)
    bracketed &= np.isfinite(below) & np.isfinite(above)
    line, cell, below, above = line[bracketed], cell[bracketed], below[bracketed], above[bracketed]
    if len(line) == 0:
        return nothing
    at, low, high = to_jit(line), to_jit(cell - 0.5), to_jit(cell + 0.5)
    below, above = to_jit(below), to_jit(above)

    def narrowed(low: Float, high: Float, below: Float, above: Float, at: Float, left: UInt32) -> tuple[Float, ...]:
        centre = low + (high - low) * below / (below - above)
        found = distance(centre, at)
        same_side = (found <= 0) == (below <= 0)
        low, below = dr.select(same_side, centre, low), dr.select(same_side, found, below)
        high, above = dr.select(same_side, high, centre), dr.select(same_side, above, found)
        return low, high, below, above, at, left - 1

    # Skip the search for loop invariants, as in `Walker`.
    with dr.scoped_set_flag(dr.JitFlag.OptimizeLoops, False):
        low, high, below, above, at, _ = dr.while_loop(
            (low, high, below, above, at, dr.full(mi.UInt32, _FALSE_POSITIONS, len(line))),
            lambda low, high, below, above, at, left: left > 0,
            narrowed,
            mode="symbolic",
        )
    centre = low + (high - low) * below / (below - above)
    dr.eval(centre)
    brightness, seen = renderer.laser(pose, *_trace_lines(renderer, pose, at, centre))
    si, offset = seen.si, dr.select(seen.valid, renderer.sheet.evaluate(seen.end()).distance_mm, dr.nan)
    thing = renderer.objects.number(si.shape, seen.valid)
    dr.eval(centre, brightness, si.p, si.n, offset, thing)
    good = np.abs(offset.numpy()) < _TOLERANCE_MM
    # In the order of `Crossings`' fields.
    arrays = line, centre.numpy(), brightness.numpy(), to_numpy(si.p), to_numpy(si.n), thing.numpy()
    return Crossings(*(values[good] for values in arrays))


def find_visible_surfaces(renderer: Renderer, scene_from_object: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return depth and object number (H, W) of the surface at every pixel centre; NaN and -1 if there is none.

    The depth is the camera-frame z in mm, float32.
    """
    camera = renderer.sensor.camera
    x, y = np.meshgrid(np.arange(camera.width_px, dtype=np.float32), np.arange(camera.height_px, dtype=np.float32))
    bundle = renderer.view.trace_bundle(to_jit(x), to_jit(y))
    ray = SensorPose(scene_from_object).ray(bundle.origin, bundle.direction)
    hit = renderer.objects.scene.ray_intersect_preliminary(ray)
    depth = renderer.view.depth_mm(mi.Point3f(bundle.origin + bundle.direction * hit.t))
    seen = hit.is_valid() & (bundle.weight > 0)
    depth, number = dr.select(seen, depth, dr.nan), renderer.objects.number(hit.shape, seen)
    dr.eval(depth, number)
    return depth.numpy().reshape(x.shape), number.numpy().reshape(x.shape)


def project_points(renderer: Renderer, scene_from_object: np.ndarray, points_mm: np.ndarray) -> np.ndarray:
    """Return the image positions (N, 2) in px of scene points (N, 3); NaN for points that are hidden or out of view.

    Newton's method minimises the distance of chief rays from the points.
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
        bundle = renderer.view.trace_bundle(to_jit(at[..., 0]), to_jit(at[..., 1]))
        dr.eval(bundle.origin, bundle.direction)
        direction = to_numpy(bundle.direction).astype(float).reshape(*at.shape[:2], 3)
        # Without a window all rays have one origin.
        origin = np.resize(to_numpy(bundle.origin).astype(float), direction.shape)
        towards = points[:, None] - origin
        miss = towards - np.sum(towards * direction, axis=2, keepdims=True) * direction
        slopes = np.stack([miss[:, 1] - miss[:, 0], miss[:, 2] - miss[:, 0]], axis=2)
        steps = np.einsum("nij,nj->ni", np.linalg.pinv(slopes), miss[:, 0])
        pixels = pixels - steps
    bundle = renderer.view.trace_bundle(*(to_jit(axis) for axis in pixels.T))
    hit = renderer.objects.scene.ray_intersect_preliminary(
        SensorPose(scene_from_object).ray(bundle.origin, bundle.direction)
    )
    dr.eval(hit.t, bundle.origin, bundle.weight)
    length = np.linalg.norm(points - to_numpy(bundle.origin), axis=1)
    inside = ((pixels > -0.5) & (pixels < size - 0.5)).all(axis=1) & (bundle.weight.numpy() > 0)
    found = inside & (np.abs(hit.t.numpy() - length) < _POINT_MM) & (np.abs(steps).max(axis=1) < _POINT_PX)
    return np.where(found[:, None], pixels, np.nan)
