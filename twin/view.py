"""The camera's view into the medium: rays behind the window, a grid of them, and how far they blur."""

from __future__ import annotations

from dataclasses import dataclass

import drjit as dr
import mitsuba as mi
import numpy as np

from twin.arrays import to_jit, to_numpy
from twin.camera import LensRays
from twin.windows import WindowFaces
from uwlts.placement import camera_from_object
from uwlts.sensor import Medium, Sensor

_FIELD = 0.96
"""Blur is measured in the image's middle and at this share of the way to its edges and corners."""
_RIM_POINTS, _DEPTHS = 8, 200


@dataclass(frozen=True)
class Bundle:
    """Camera rays in the medium, in the sensor's OCS: origins, unit directions, and sensor irradiance per radiance."""

    origin: mi.Point3f
    direction: mi.Vector3f
    weight: mi.Float


class View:
    """Lens and window of a sensor in a medium."""

    def __init__(self, sensor: Sensor, medium: Medium):
        self.camera = sensor.camera
        self.lens = LensRays(sensor.camera)
        self._faces = WindowFaces(
            sensor.camera.window, medium, wavelength_nm=sensor.laser.wavelength_nm,
            origin_mm=np.zeros(3), rotation=np.eye(3),
        )  # fmt: skip
        self._camera_from_object = camera_from_object(sensor)
        self._to_object = np.linalg.inv(self._camera_from_object)
        self._grids: dict[int, tuple[Bundle, tuple[int, int]]] = {}
        self._blur: tuple[np.ndarray, np.ndarray] | None = None

    def bundle(self, x: mi.Float, y: mi.Float, pupil: mi.Point2f | None = None) -> Bundle:
        """Rays behind the window of image points; pixel (0, 0) is the centre of the first pixel.

        ``pupil`` holds points of the unit disc; without them chief rays through the pupil's centre are returned.
        """
        chief = self.lens.directions(x, y)
        origin, direction = (mi.Point3f(0.0), chief) if pupil is None else self.lens.through_pupil(chief, pupil)
        path = self._faces.through(origin, direction, mode=mi.TransportMode.Radiance)
        transform = mi.Transform4f(mi.Matrix4f(self._to_object))
        cosine = dr.square(dr.square(chief.z))
        weight = dr.select(path.valid, path.weight * cosine * self.lens.irradiance_on_axis(), 0.0)
        return Bundle(transform @ path.origin, transform @ path.direction, weight)

    def grid(self, spacing: int) -> tuple[Bundle, tuple[int, int]]:
        """Chief rays of nodes at pixel corners every ``spacing`` pixels, and the grid's shape (rows, columns)."""
        if spacing not in self._grids:
            columns, rows = -(-self.camera.width_px // spacing) + 1, -(-self.camera.height_px // spacing) + 1
            x, y = np.meshgrid(np.arange(columns) * spacing - 0.5, np.arange(rows) * spacing - 0.5)
            bundle = self.bundle(to_jit(mi.Float, x), to_jit(mi.Float, y))
            dr.eval(bundle.origin, bundle.direction, bundle.weight)
            self._grids[spacing] = bundle, (rows, columns)
        return self._grids[spacing]

    def depth_mm(self, p: mi.Point3f) -> mi.Float:
        """Depth z in the camera frame of points of the OCS."""
        row = self._camera_from_object[2]
        return p.x * float(row[0]) + p.y * float(row[1]) + p.z * float(row[2]) + float(row[3])

    def blur_radius_px(self, depth_mm: np.ndarray) -> np.ndarray:
        """Largest distance in the image between a point's chief ray and its other rays, for depths of any shape.

        Rays through the pupil's rim and chief rays of neighbouring pixels are followed through the window to every
        depth; the largest blur anywhere in the image counts.
        """
        if self._blur is None:
            self._blur = self._blur_table()
        return np.interp(depth_mm, *self._blur)

    def _blur_table(self) -> tuple[np.ndarray, np.ndarray]:
        camera = self.camera
        field = _FIELD * np.array([(i, j) for i in (-0.5, 0.0, 0.5) for j in (-0.5, 0.0, 0.5)])
        middle = np.array([camera.width_px - 1, camera.height_px - 1]) / 2
        image = field * (camera.width_px, camera.height_px) + middle
        angle = 2 * np.pi * np.arange(_RIM_POINTS) / _RIM_POINTS
        rim = np.stack([np.cos(angle), np.sin(angle)], axis=1)
        # Per field point: the chief ray, its neighbours in x and y, then the rays through the rim.
        shift = np.concatenate([[(0, 0), (1, 0), (0, 1)], np.zeros((_RIM_POINTS, 2))])
        pupil = np.concatenate([np.zeros((3, 2)), rim])
        at = (image[:, None] + shift).reshape(-1, 2)
        through = np.tile(pupil, (len(image), 1))
        bundle = self.bundle(
            *(to_jit(mi.Float, v) for v in at.T), mi.Point2f(*(to_jit(mi.Float, v) for v in through.T))
        )
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
