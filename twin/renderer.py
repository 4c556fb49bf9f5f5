"""Renders what reaches the image sensor: laser and lamp images as irradiance, only where there is light.

A frame is made in two passes. Rays through the nodes of a coarse grid find the pixels near the lit stripe (or, under
the lamp, the pixels in which the picture changes); only these are rendered with many samples, all others take the mean
of their nodes. The windows stand still before the camera, so the nodes' rays behind the window are traced once; the
objects stand still in the scene, so nothing is rebuilt or recompiled between frames.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Literal

import drjit as dr
import mitsuba as mi
import numpy as np

from twin.arrays import to_jit
from twin.camera import LensRays
from twin.objects import build_objects
from twin.scene import Scene
from twin.sheet import Sheet
from twin.water import single_scattering
from twin.windows import WindowFaces
from uwlts.placement import camera_from_object, check_design
from uwlts.sensor import Medium, Sensor

NODE_SPACING_PX = 2
SAMPLES_AT_ONCE = 2**23
"""More samples are rendered one part after the other; this many take some 100 MB."""
LIT_SIGMAS = 4.5
"""The stripe is rendered up to this many standard deviations of the sheet: 4e-5 of its peak."""
CHANGE_SHARE = 2e-3
"""Under the lamp, pixels whose corners differ by more than this share of the brightest are rendered finely."""


@dataclass(frozen=True)
class Bundle:
    """Camera rays in the medium, in the sensor's OCS: origins, unit directions, and sensor irradiance per radiance."""

    origin: mi.Point3f
    direction: mi.Vector3f
    weight: mi.Float


class SensorPose:
    """Where the sensor's OCS stands in the scene, kept opaque so that moving it never recompiles a kernel."""

    def __init__(self, scene_from_object: np.ndarray):
        to_scene = mi.Matrix4f(scene_from_object)
        dr.make_opaque(to_scene)
        self._to_scene = mi.Transform4f(to_scene)

    def ray(self, origin: mi.Point3f, direction: mi.Vector3f) -> mi.Ray3f:
        """A ray of the OCS in the scene."""
        # A point plus a vector is a vector to Dr.Jit, and vectors are not moved.
        return mi.Ray3f(self._to_scene @ mi.Point3f(origin), self._to_scene @ direction)

    def direction(self, direction: mi.Vector3f) -> mi.Vector3f:
        """A direction of the OCS in the scene."""
        return self._to_scene @ direction


class Renderer:
    """One sensor in one medium before one scene.

    Raises
    ------
    DesignError, DescriptionError
        The sensor cannot work in the medium, or an object cannot be built.
    """

    def __init__(self, sensor: Sensor, medium: Medium, scene: Scene):
        self.view = check_design(sensor, medium)
        self.sensor, self.medium = sensor, medium
        self.wavelength_nm = sensor.laser.wavelength_nm
        self.objects = build_objects(scene)
        self.sheet = Sheet(sensor, medium)
        self.lens = LensRays(sensor.camera)
        self._faces = WindowFaces(
            sensor.camera.window, medium, wavelength_nm=self.wavelength_nm, origin_mm=np.zeros(3), rotation=np.eye(3)
        )
        self._to_object = np.linalg.inv(camera_from_object(sensor))
        self._extinction = medium.extinction_per_mm(self.wavelength_nm)
        self._scatters = medium.scattering_per_mm(self.wavelength_nm) > 0
        self._grids: dict[int, tuple[Bundle, tuple[int, int]]] = {}

    def bundle(self, x: mi.Float, y: mi.Float) -> Bundle:
        """Rays behind the window of image points; pixel (0, 0) is the centre of the first pixel."""
        directions = self.lens.directions(x, y)
        path = self._faces.through(mi.Point3f(0.0), directions, mode=mi.TransportMode.Radiance)
        transform = mi.Transform4f(mi.Matrix4f(self._to_object))
        cosine = dr.square(dr.square(directions.z))
        weight = dr.select(path.valid, path.weight * cosine * self.lens.irradiance_on_axis(), 0.0)
        return Bundle(transform @ path.origin, transform @ path.direction, weight)

    def _grid(self, spacing: int) -> tuple[Bundle, tuple[int, int]]:
        """Rays of the nodes at pixel corners every ``spacing`` pixels, and the grid's shape (rows, columns)."""
        if spacing not in self._grids:
            camera = self.sensor.camera
            columns, rows = -(-camera.width_px // spacing) + 1, -(-camera.height_px // spacing) + 1
            x, y = np.meshgrid(np.arange(columns) * spacing - 0.5, np.arange(rows) * spacing - 0.5)
            bundle = self.bundle(to_jit(mi.Float, x), to_jit(mi.Float, y))
            dr.eval(bundle.origin, bundle.direction, bundle.weight)
            self._grids[spacing] = bundle, (rows, columns)
        return self._grids[spacing]

    def irradiance(self, light: Literal["lamp", "laser"], scene_from_object: np.ndarray, *, spp: int) -> np.ndarray:
        """Irradiance (H, W) on the image sensor in W/mm2, float32, with the sensor's OCS at a pose (4, 4) in the scene.

        ``spp`` samples are taken per lit pixel, the same places in every pixel: equal arguments give equal images.
        """
        pose = SensorPose(scene_from_object)
        if light == "laser":
            image, rows, columns = self._laser_nodes(pose)
        else:
            image, rows, columns = self._lamp_nodes(pose)
        for some in np.array_split(np.arange(len(rows)), -(-len(rows) * spp // SAMPLES_AT_ONCE)) if len(rows) else ():
            at = rows[some], columns[some]
            fine = self._fine(light, pose, *at, spp=spp)
            # The stripe lies before the haze, which the nodes have rendered; a lamp image is replaced.
            image[at] = fine + image[at] if light == "laser" else fine
        return image

    def lit_pixels(self, pose: SensorPose) -> tuple[np.ndarray, np.ndarray]:
        """Rows and columns of the pixels close to the lit stripe."""
        bundle, shape = self._grid(NODE_SPACING_PX)
        _, across = self._nodes_on_surface(pose, bundle)
        return self._pixels_of(_near_sheet(across.numpy().reshape(shape)))

    def _nodes_on_surface(self, pose: SensorPose, bundle: Bundle) -> tuple[mi.Float, mi.Float]:
        """How far away rays meet a surface (infinity: nowhere), and the sheet's distance across there in sigmas."""
        hit = self.objects.ray_intersect_preliminary(pose.ray(bundle.origin, bundle.direction))
        valid = hit.is_valid() & (bundle.weight > 0)
        light = self.sheet.at(bundle.origin + bundle.direction * dr.select(valid, hit.t, 1.0))
        return dr.select(valid, hit.t, dr.inf), dr.select(valid, light.distance_mm / light.sigma_mm, dr.inf)

    def _laser_nodes(self, pose: SensorPose) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Haze (H, W) in W/mm2 from the nodes, and rows and columns of the pixels close to the lit stripe."""
        bundle, shape = self._grid(NODE_SPACING_PX)
        depth, across = self._nodes_on_surface(pose, bundle)
        if self._scatters:
            haze = bundle.weight * self._haze(pose, bundle, depth, across)
            dr.eval(across, haze)
            image = self._spread(_corner_mean(haze.numpy().reshape(shape)))
        else:
            image = np.zeros((self.sensor.camera.height_px, self.sensor.camera.width_px), np.float32)
        return image, *self._pixels_of(_near_sheet(across.numpy().reshape(shape)))

    def _pixels_of(self, cells: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Rows and columns of the pixels in the marked grid cells."""
        row, column = np.nonzero(cells)
        inside = np.arange(NODE_SPACING_PX)
        rows = (row[:, None, None] * NODE_SPACING_PX + inside[:, None] + 0 * inside).ravel()
        columns = (column[:, None, None] * NODE_SPACING_PX + 0 * inside[:, None] + inside).ravel()
        camera = self.sensor.camera
        kept = (rows < camera.height_px) & (columns < camera.width_px)
        return rows[kept], columns[kept]

    def _lamp_nodes(self, pose: SensorPose) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Lamp image (H, W) in W/mm2 from the pixels' corners; rows and columns of the pixels in which it changes."""
        bundle, shape = self._grid(1)
        nodes = self._lamp(pose, bundle).numpy().reshape(shape)
        low, high = _corner_extremes(nodes)
        return _corner_mean(nodes), *np.nonzero(high - low > CHANGE_SHARE * nodes.max())

    def _spread(self, cells: np.ndarray) -> np.ndarray:
        """Values of grid cells given to their pixels, (H, W)."""
        camera = self.sensor.camera
        full = cells.repeat(NODE_SPACING_PX, axis=0).repeat(NODE_SPACING_PX, axis=1)
        return np.ascontiguousarray(full[: camera.height_px, : camera.width_px])

    def _fine(self, light: str, pose: SensorPose, rows: np.ndarray, columns: np.ndarray, *, spp: int) -> np.ndarray:
        """Mean irradiance (P,) in W/mm2 over the area of pixels.

        The samples are a rank-1 lattice centred in the pixel: along either side they are evenly spaced, so that a
        smooth stripe is integrated as by the midpoint rule, without the noise of random samples.
        """
        count = len(rows)
        x, y = to_jit(mi.Float, columns), to_jit(mi.Float, rows)
        index = dr.arange(mi.UInt32, count * spp)
        pixel, sample = index // spp, index % spp
        u, v = mi.Float(sample), mi.Float(sample * _lattice_step(spp) % spp)
        bundle = self.bundle(
            dr.gather(mi.Float, x, pixel) + (u + 0.5) / spp - 0.5, dr.gather(mi.Float, y, pixel) + (v + 0.5) / spp - 0.5
        )
        values = self.laser(pose, bundle) if light == "laser" else self._lamp(pose, bundle)
        return dr.block_sum(values, spp).numpy() / spp

    def laser(self, pose: SensorPose, bundle: Bundle) -> mi.Float:
        """Irradiance of laser light per ray, in W/mm2: the lit surface seen through the water, without the haze."""
        ray = pose.ray(bundle.origin, bundle.direction)
        si = self.objects.ray_intersect(ray)
        valid = si.is_valid() & (bundle.weight > 0)
        point = bundle.origin + bundle.direction * si.t
        light = self.sheet.at(point)
        towards = pose.direction(-light.direction)
        lit = valid & (light.irradiance > 0) & ~self._shadowed(si.p, towards, light.exit_mm, valid)
        reflected = si.bsdf().eval(mi.BSDFContext(), si, si.to_local(towards), lit)[0]
        radiance = dr.select(lit, reflected * light.irradiance * dr.exp(-self._extinction * si.t), 0.0)
        return bundle.weight * radiance

    def _shadowed(self, p: mi.Point3f, towards: mi.Vector3f, exit_mm: mi.Float, active: mi.Bool) -> mi.Bool:
        """Whether an object stands between points of the scene and the laser's window."""
        ray = mi.Ray3f(p + towards * 1e-2, towards)
        ray.maxt = exit_mm - 2e-2
        return self.objects.ray_test(ray, active)

    def _haze(self, pose: SensorPose, bundle: Bundle, depth: mi.Float, across: mi.Float) -> mi.Float:
        """Radiance scattered once by the water where rays cross the sheet, in W/mm2/sr.

        ``depth`` is how far rays go to a surface, ``across`` the sheet's distance there in standard deviations.
        """
        t = -bundle.origin.x / bundle.direction.x
        light = self.sheet.at(bundle.origin + bundle.direction * t)
        t -= light.distance_mm / dr.dot(bundle.direction, light.normal)
        light = self.sheet.at(bundle.origin + bundle.direction * t)
        end = dr.select(dr.isfinite(depth), across * dr.sign(bundle.direction.x), dr.inf)
        scattered = single_scattering(
            self.medium, light, wavelength_nm=self.wavelength_nm, direction=bundle.direction, surface_sigmas=end
        )
        # A surface just before the sheet's middle cuts the sheet's light, but does not shadow what lies before it.
        ray = pose.ray(bundle.origin + bundle.direction * dr.minimum(t, depth), -light.direction)
        blocked = self._shadowed(ray.o, ray.d, light.exit_mm, scattered > 0)
        return dr.select((t > 0) & ~blocked, scattered * dr.exp(-self._extinction * t), 0.0)

    def _lamp(self, pose: SensorPose, bundle: Bundle) -> mi.Float:
        """Irradiance of lamp light per ray in W/mm2: every surface evenly lit, seen through the water."""
        si = self.objects.ray_intersect(pose.ray(bundle.origin, bundle.direction))
        valid = si.is_valid() & (bundle.weight > 0)
        # A diffuse surface reflects the irradiance E as the radiance albedo E / pi; looking at it square on, the
        # BSDF's value times cosine is albedo / pi.
        straight = mi.SurfaceInteraction3f(si)
        straight.wi = mi.Vector3f(0.0, 0.0, 1.0)
        facing = valid & (si.wi.z > 0)
        albedo = si.bsdf().eval(mi.BSDFContext(), straight, mi.Vector3f(0.0, 0.0, 1.0), facing)[0]
        lamp = 1e-6 * self.sensor.lamp.irradiance_w_per_m2
        return dr.select(facing, bundle.weight * albedo * lamp * dr.exp(-self._extinction * si.t), 0.0)


def _corner_mean(nodes: np.ndarray) -> np.ndarray:
    """Mean (rows - 1, columns - 1) of the four corners of every grid cell."""
    beside = nodes[:, :-1] + nodes[:, 1:]
    return 0.25 * (beside[:-1] + beside[1:])


def _corner_extremes(nodes: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Least and greatest (rows - 1, columns - 1) of the four corners of every grid cell."""
    low, high = np.minimum(nodes[:, :-1], nodes[:, 1:]), np.maximum(nodes[:, :-1], nodes[:, 1:])
    return np.minimum(low[:-1], low[1:]), np.maximum(high[:-1], high[1:])


def _near_sheet(across: np.ndarray) -> np.ndarray:
    """Cells with a corner within `LIT_SIGMAS` of the sheet's middle, or between whose corners it passes."""
    nearest, _ = _corner_extremes(np.abs(across))
    low, high = _corner_extremes(across)
    return (nearest < LIT_SIGMAS) | ((low < 0) & (high > 0) & np.isfinite(high))


def _lattice_step(count: int) -> int:
    """Second generator of a rank-1 lattice of ``count`` points: the coprime number nearest to its golden section."""
    golden = count * 0.5 * (math.sqrt(5.0) - 1.0)
    return min((k for k in range(1, count + 1) if math.gcd(k, count) == 1), key=lambda k: abs(k - golden))
