"""Camera rays from the image through lens, pupil and window into the scene, with reflections at mirrors."""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass
from functools import cached_property

import drjit as dr
import mitsuba as mi
import numpy as np

from twin.backend.arrays import (
    Bool,
    Float,
    Point2f,
    Point3f,
    SurfaceInteraction3f,
    Vector3f,
    opaque,
    opaque_point,
    opaque_transform,
    to_jit,
    to_numpy,
)
from twin.light.pose import CLEAR_MM, Rays, SensorPose
from twin.scene.objects import Objects
from uwlts.errors import DesignError
from uwlts.model.placement import camera_from_object
from uwlts.model.sensor import Camera, Medium, Sensor, Window

_NEWTON_STEPS = 6  # steps after which the inverse distortion of real lenses is exact in single precision
_FIELD = 0.96  # the blur is measured at the image centre and at this fraction of the distance to its edges and corners
_RIM_POINTS = 8  # number of rays through the pupil's rim, enough for a stable largest blur radius
_DEPTHS = 200  # number of depths in the blur table, spaced logarithmically from 1 mm to 10 m behind the window


class LensRays:
    """Ray generator of a camera; the entrance pupil is a disc in the plane z = 0 of the camera frame.

    ``irradiance_on_axis`` is the image irradiance divided by the radiance at the pupil, in sr, on the optical axis;
    off-axis values follow cos^4. E = L (pi / 4) / (N (1 + m))^2 with the magnification m at the focus distance (Smith,
    Modern Optical Engineering, 4th ed., Eqs. 8.7 and 8.10).
    """

    def __init__(self, camera: Camera):
        working_f_number = camera.working_f_number()
        self.irradiance_on_axis = opaque(math.pi / 4 / working_f_number**2)
        self._pupil_radius_mm = opaque(0.5 * camera.focal_length_mm / working_f_number)
        self._focus_mm = opaque(camera.focus_distance_mm)
        numbers = *camera.focal_lengths_px(), *camera.principal_point()
        self._fx, self._fy, self._cx, self._cy = map(opaque, numbers)
        self._distortion = {name: opaque(value) for name, value in camera.distortion.model_dump().items()}
        self._distorts = any(camera.distortion.model_dump().values())

    def trace_through_pupil(self, chief: Vector3f, pupil: Point2f) -> tuple[Point3f, Vector3f]:
        """Return origin and unit direction in the camera frame of the ray through ``pupil``, a point of the unit disc.

        ``chief`` is the direction of the chief ray; both rays meet in the plane z = focus distance (thin lens). The
        pupil radius is D / 2 = c / (2 N (1 + m)) with the image distance c (camera constant).
        """
        origin = self._pupil_radius_mm * mi.Point3f(pupil.x, pupil.y, 0.0)
        focused = chief * (self._focus_mm / chief.z)
        return origin, dr.normalize(mi.Vector3f(focused - origin))

    def directions(self, x: Float, y: Float) -> Vector3f:
        """Return unit directions of chief rays in the camera frame; pixel (0, 0) is the centre of the first pixel."""
        true = self._undistort(mi.Point2f((x - self._cx) / self._fx, (y - self._cy) / self._fy))
        return dr.normalize(mi.Vector3f(true.x, true.y, 1.0))

    def _undistort(self, seen: Point2f) -> Point2f:
        """Invert the distortion, a rational Brown-Conrady model (`Distortion`), by Newton's method."""
        if not self._distorts:
            return seen
        k1, k2, k3, k4, k5, k6, p1, p2 = (self._distortion[name] for name in sorted(self._distortion))
        point = mi.Point2f(seen)
        for _ in range(_NEWTON_STEPS):
            x, y = point.x, point.y
            r2 = x * x + y * y
            below = 1 + r2 * (k4 + r2 * (k5 + r2 * k6))
            radial = (1 + r2 * (k1 + r2 * (k2 + r2 * k3))) / below
            above_by, below_by = k1 + r2 * (2 * k2 + r2 * 3 * k3), k4 + r2 * (2 * k5 + r2 * 3 * k6)
            slope = 2 * (above_by - radial * below_by) / below
            off_x = x * radial + 2 * p1 * x * y + p2 * (r2 + 2 * x * x) - seen.x
            off_y = y * radial + 2 * p2 * x * y + p1 * (r2 + 2 * y * y) - seen.y
            xx = radial + slope * x * x + 2 * p1 * y + 6 * p2 * x
            xy = slope * x * y + 2 * p1 * x + 2 * p2 * y
            yy = radial + slope * y * y + 2 * p2 * x + 6 * p1 * y
            determinant = xx * yy - xy * xy
            point = mi.Point2f(x - (yy * off_x - xy * off_y) / determinant, y - (xx * off_y - xy * off_x) / determinant)
        return point


def build_frame(axis: np.ndarray, across: np.ndarray) -> np.ndarray:
    """Return the right-handed rotation (3, 3) with columns x, y, z.

    The column z is ``axis``, normalised; x is the component of ``across`` perpendicular to it, normalised.
    """
    z = axis / np.linalg.norm(axis)
    x = across - (across @ z) * z
    x /= np.linalg.norm(x)
    return np.stack([x, np.cross(z, x), z], axis=1)


class WindowFaces:
    """Both faces of a window. Rays pass unchanged if the window is not mounted.

    Rays meet the faces in a known order, so each face is intersected on its own as a disc. ``origin_mm`` (3,) and
    ``rotation`` (3, 3) give the frame of the module (camera or laser) in the camera frame; the third column is its
    axis.
    """

    def __init__(
        self, window: Window, medium: Medium, *, wavelength_nm: float, origin_mm: np.ndarray, rotation: np.ndarray
    ):
        index = medium.refractive_index(wavelength_nm)
        self.mounted = window.mounted
        if not window.mounted:
            if medium.kind != "air":
                raise DesignError("the sensor is in water without a window: mount the window or measure in air")
            return
        glass = window.index(wavelength_nm)
        self._absorption = opaque(window.absorption_per_mm())
        normal = rotation @ window.normal()
        inner = origin_mm + window.distance_mm * rotation[:, 2]
        outer = inner + window.thickness_mm * normal
        self._normal = mi.Vector3f(opaque_point(normal))
        self._radius = opaque(window.aperture_diameter_mm / 2)
        self._faces = [(opaque_point(inner), opaque(glass)), (opaque_point(outer), opaque(index / glass))]

    def trace(self, origin: Point3f, direction: Vector3f, *, mode: mi.TransportMode) -> Rays:
        """Trace rays from the module through both faces; rays that do not pass get the weight 0.

        ``mode`` is Radiance for rays traced backwards from the camera, whose weights contain 1 / n^2. It is Importance
        for light traced forwards from the laser.
        """
        width = dr.width(direction)
        weight, valid = dr.full(mi.Float, 1.0, width), dr.full(mi.Bool, True, width)
        if not self.mounted:
            return Rays(origin, direction, weight)
        p: Point3f = mi.Point3f(origin)
        d: Vector3f = mi.Vector3f(direction)
        normal = self._normal
        for number, (centre, ratio) in enumerate(self._faces):
            cosine = dr.dot(d, normal)
            t = dr.dot(mi.Vector3f(centre - p), normal) / cosine
            p = mi.Point3f(p + d * t)
            valid &= (cosine > 0) & (t > 0) & (dr.norm(p - centre) <= self._radius)
            reflected, refracted_cosine, _, inverse = mi.fresnel(cosine, ratio)
            weight *= dr.select(valid, 1 - reflected, 0.0)
            if mode == mi.TransportMode.Radiance:
                weight *= dr.square(inverse)
            if number == 1:
                weight *= dr.exp(-self._absorption * t)
            # Snell's law: the tangential component scales with the ratio of the indices.
            d = mi.Vector3f((d - normal * cosine) * inverse - normal * refracted_cosine)
        return Rays(p, d, dr.select(valid & (weight > 0), weight, 0.0))


class CameraView:
    """Lens and window of a sensor in a medium."""

    def __init__(self, sensor: Sensor, medium: Medium):
        self.camera = sensor.camera
        self.lens = LensRays(sensor.camera)
        place = {"origin_mm": np.zeros(3), "rotation": np.eye(3)}
        self._faces = WindowFaces(self.camera.window, medium, wavelength_nm=sensor.laser.wavelength_nm, **place)
        self._camera_from_object = camera_from_object(sensor)
        self._to_camera = opaque_transform(self._camera_from_object)
        self._to_object = opaque_transform(np.linalg.inv(self._camera_from_object))
        self._grids: dict[int, tuple[Rays, tuple[int, int]]] = {}

    def trace_bundle(self, x: Float, y: Float, pupil: Point2f | None = None) -> Rays:
        """Trace rays of image points to behind the window; pixel (0, 0) is the centre of the first pixel.

        ``pupil`` gives points of the unit disc. Without it, the chief rays through the pupil's centre are returned.
        """
        chief = self.lens.directions(x, y)
        origin, direction = (mi.Point3f(0.0), chief) if pupil is None else self.lens.trace_through_pupil(chief, pupil)
        path = self._faces.trace(origin, direction, mode=mi.TransportMode.Radiance)
        cosine = dr.square(dr.square(chief.z))
        weight = dr.select(path.weight > 0, path.weight * cosine * self.lens.irradiance_on_axis, 0.0)
        return Rays(self._to_object @ path.origin, self._to_object @ path.direction, weight)

    def trace_grid(self, spacing: int) -> tuple[Rays, tuple[int, int]]:
        """Return the chief rays of pixel corners every ``spacing`` pixels, and the grid shape (rows, columns)."""
        if spacing not in self._grids:
            columns, rows = -(-self.camera.width_px // spacing) + 1, -(-self.camera.height_px // spacing) + 1
            x, y = np.meshgrid(np.arange(columns) * spacing - 0.5, np.arange(rows) * spacing - 0.5)
            bundle = self.trace_bundle(to_jit(x), to_jit(y))
            dr.eval(bundle.origin, bundle.direction, bundle.weight)
            self._grids[spacing] = bundle, (rows, columns)
        return self._grids[spacing]

    def slopes(self, p: Point3f) -> Point2f:
        """Return the slopes (x / z, y / z) in the camera frame of lines from the pupil to points in the OCS."""
        seen = self._to_camera @ mi.Point3f(p)
        return mi.Point2f(seen.x / seen.z, seen.y / seen.z)

    def depth_mm(self, p: Point3f) -> Float:
        """Return the depth z in the camera frame of points in the OCS."""
        return (self._to_camera @ mi.Point3f(p)).z

    def blur_radius_px(self, depth_mm: np.ndarray) -> np.ndarray:
        """Return the largest distance in the image of a point's rays from its chief ray, for depths of any shape.

        Rays through the pupil's rim and chief rays of neighbouring pixels are traced through the window to every depth.
        The largest blur of all image positions is taken.
        """
        return np.interp(depth_mm, *self._blur_table)

    @cached_property
    def _blur_table(self) -> tuple[np.ndarray, np.ndarray]:
        camera = self.camera
        field = _FIELD * np.array([(i, j) for i in (-0.5, 0.0, 0.5) for j in (-0.5, 0.0, 0.5)])
        middle = np.array([camera.width_px - 1, camera.height_px - 1]) / 2
        image = field * (camera.width_px, camera.height_px) + middle
        angle = 2 * np.pi * np.arange(_RIM_POINTS) / _RIM_POINTS
        rim = np.stack([np.cos(angle), np.sin(angle)], axis=1)
        # Rays of each field point: its chief ray, the neighbours in x and y, then the rim rays.
        shift = np.concatenate([[(0, 0), (1, 0), (0, 1)], np.zeros((_RIM_POINTS, 2))])
        at = (image[:, None] + shift).reshape(-1, 2)
        through = np.tile(np.concatenate([np.zeros((3, 2)), rim]), (len(image), 1))
        x, y, pupil_x, pupil_y = (to_jit(values) for values in (*at.T, *through.T))
        bundle = self.trace_bundle(x, y, mi.Point2f(pupil_x, pupil_y))
        dr.eval(bundle.origin, bundle.direction, bundle.weight)
        transform = self._camera_from_object
        o = to_numpy(bundle.origin).astype(float) @ transform[:3, :3].T + transform[:3, 3]
        d = to_numpy(bundle.direction).astype(float) @ transform[:3, :3].T
        o[bundle.weight.numpy() <= 0] = np.nan
        near = np.nanmax(o[:, 2])
        depths = near + np.geomspace(1.0, 1e4, _DEPTHS)
        hits = o[:, None, :2] + d[:, None, :2] / d[:, None, 2:] * (depths[:, None] - o[:, None, 2:])
        hits = hits.reshape(len(image), -1, _DEPTHS, 2)
        jacobian = np.moveaxis(hits[:, 1:3] - hits[:, :1], 1, -1)
        offset = np.linalg.solve(jacobian[:, None], (hits[:, 3:] - hits[:, :1])[..., None])[..., 0]
        return depths, np.nanmax(np.linalg.norm(offset, axis=-1), axis=(0, 1))


@dataclass(frozen=True)
class RaySegment:
    """Segment of camera rays in the OCS that ends on a surface.

    ``weight`` and ``length_before`` (mm) belong to the path before the segment.
    """

    origin: Point3f
    direction: Vector3f
    weight: Float
    length_before: Float
    si: SurfaceInteraction3f
    valid: Bool

    def end(self) -> Point3f:
        """Return the end point in the OCS."""
        return mi.Point3f(self.origin + self.direction * dr.select(self.valid, self.si.t, 1.0))


def trace_segments(
    objects: Objects, extinction: Float, pose: SensorPose, bundle: Rays, after_s: Float | None, *, mirrors: int
) -> Iterator[RaySegment]:
    """Yield the first segment of camera rays in the medium, then one for each of up to ``mirrors`` mirrors.

    ``extinction`` is that of the medium in 1/mm. ``after_s`` are times of the rays after that of the pose, s; None: at
    rest.
    """
    o, d, weight, length_before = bundle.origin, bundle.direction, bundle.weight, mi.Float(0.0)
    for met in range(mirrors + 1):
        si = objects.scene.ray_intersect(pose.ray(o, d, after_s), mi.RayFlags.All, objects.coherent, weight > 0)
        valid = si.is_valid() & (weight > 0)
        yield RaySegment(o, d, weight, length_before, si, valid)
        if met < mirrors:
            front = valid & (si.wi.z > 0)
            length = dr.select(valid, si.t, 0.0)
            weight = weight * dr.select(front, objects.mirror_share(si), 0.0) * dr.exp(-extinction * length)
            length_before = length_before + length
            d_reflected = pose.object_direction(si.to_world(mi.reflect(si.wi)), after_s)
            o = mi.Point3f(o + d * length + d_reflected * CLEAR_MM)
            d = dr.select(front, d_reflected, d)
