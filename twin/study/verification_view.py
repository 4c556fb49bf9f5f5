"""What a sensor's camera sees of its laser line and of things about it, for laying out scenes.

Points are in the sensor's object coordinate system (OCS), mm.
"""

import math
from dataclasses import dataclass

import numpy as np

from twin.study.geometry import FlatWindow, Lens, dot, seen
from uwlts.placement import camera_from_object, laser_pose
from uwlts.sensor import Camera, Medium, Sensor


@dataclass(frozen=True, eq=False)
class LineOfSight:
    """A sensor's camera and fan in a medium.

    ``pose`` is ``T_camera_object`` (4, 4), ``laser_mm`` (3,) the fan's origin in the OCS, ``fan_slope`` the tangent of
    half the fan's angle in the medium.
    """

    camera: Camera
    index: float
    glass_index: float
    pose: np.ndarray
    laser_mm: np.ndarray
    fan_slope: float

    @classmethod
    def of(cls, sensor: Sensor, medium: Medium) -> "LineOfSight":
        """That of a sensor as described; DesignError where it has no stand-off."""
        wavelength = sensor.laser.wavelength_nm
        index, pose = medium.refractive_index(wavelength), camera_from_object(sensor)
        sine = math.sin(math.radians(sensor.laser.fan_angle_deg / 2)) / index
        return cls(
            camera=sensor.camera, index=index, glass_index=sensor.camera.window.index(wavelength), pose=pose,
            laser_mm=(laser_pose(sensor).origin_mm - pose[:3, 3]) @ pose[:3, :3],
            fan_slope=sine / math.sqrt(1 - sine**2),
        )  # fmt: skip

    def depth_mm(self, z: np.ndarray | float) -> np.ndarray | float:
        """Depth along the camera's axis, from its pupil, of points on the laser's axis through the stand-off."""
        return self.pose[2, 3] + self.pose[2, 2] * z

    def z_at(self, depth_mm: np.ndarray | float) -> np.ndarray | float:
        """Z of the points at such a depth."""
        return (depth_mm - self.pose[2, 3]) / self.pose[2, 2]

    def blur_px(self, depth_mm: np.ndarray | float) -> np.ndarray | float:
        """Diameter in px of the blur of a point in air: that of the pupil over the distance from the focused plane."""
        camera = self.camera
        pupil = camera.focal_length_mm / camera.f_number
        return pupil * np.abs(1 / camera.focus_distance_mm - 1 / depth_mm) * camera.focal_length_px()

    def in_image(self, points: np.ndarray, *, margin_px: float = 0.0) -> np.ndarray:
        """Which points (N, 3) appear in the image, at least so far within its border: (N,) bool."""
        camera, window = self.camera, self._window()
        cx, cy = camera.principal_point()
        d = camera.distortion
        lens = Lens(camera.focal_length_px(), cx, cy, d.k1, d.k2, d.k3, d.p1, d.p2)
        point = tuple(self.pose[:3, :3] @ points.T + self.pose[:3, 3:])
        # Nothing before the window's outer face can be asked for.
        outside = (dot(point, window.normal) > window.outer_mm) & (point[2] > 0)
        image = seen(np, lens, window, tuple(np.where(outside, p, q) for p, q in zip(point, (0, 0, 1e3), strict=True)))
        within = margin_px - 0.5
        in_width = (image.x >= within) & (image.x <= camera.width_px - 1 - within)
        return outside & in_width & (image.y >= within) & (image.y <= camera.height_px - 1 - within)

    def _window(self) -> FlatWindow:
        window = self.camera.window
        normal = window.normal()
        if not window.mounted:
            return FlatWindow(tuple(normal), 0.0, 0.0, 1.0, 1.0)
        return FlatWindow(
            tuple(normal), window.distance_mm * normal[2], window.thickness_mm, self.glass_index, self.index
        )

    def line_mm(self, z: float) -> np.ndarray:
        """Y, closely spaced, where the fan lights what the camera sees at depth ``z``; possibly none."""
        reach = self.depth_mm(z) * self._diagonal_slope()
        middle = -self.pose[:3, 1] @ (self.pose[:3, 3] + self.pose[:3, 2] * z)
        y = np.linspace(middle - reach, middle + reach, 1001)
        visible = self.in_image(np.column_stack([np.zeros_like(y), y, np.full_like(y, z)]))
        lit = np.abs(y - self.laser_mm[1]) <= self.fan_slope * (z - self.laser_mm[2])
        return y[longest_run(visible & lit)]

    def half_plate_mm(self, z: float, y: float) -> np.ndarray:
        """Half sides (2,), X and Y, of a plate about (0, y, z) that fills the view, without window and distortion.

        Where it is seen at a glance it would have to be endless: it goes beyond the view's diagonal by a quarter.
        """
        camera, rotation = self.camera, self.pose[:3, :3]
        side = np.linspace(-0.5, 0.5, 41)
        edge = np.concatenate([[(t, -0.5), (t, 0.5), (-0.5, t), (0.5, t)] for t in side])
        pixels = (edge + 0.5) * (camera.width_px - 1, camera.height_px - 1)
        slopes = (pixels - camera.principal_point()) / camera.focal_length_px()
        rays = np.column_stack([slopes, np.ones(len(slopes))]) @ rotation
        pupil = -rotation.T @ self.pose[:3, 3]
        length = np.full(len(rays), 1e6)
        np.divide(z - pupil[2], rays[:, 2], out=length, where=rays[:, 2] > 1e-6)
        hits = np.abs(pupil[:2] + length[:, None] * rays[:, :2] - (0.0, y))
        return np.minimum(hits.max(axis=0), 1.25 * self.depth_mm(z) * self._diagonal_slope() / 2)

    def _diagonal_slope(self) -> float:
        return math.hypot(self.camera.width_px, self.camera.height_px) / self.camera.focal_length_px()


def longest_run(flags: np.ndarray | list[bool]) -> slice:
    """Where the longest row of true flags lies; empty where there is none."""
    edges = np.flatnonzero(np.diff(np.concatenate([[False], flags, [False]]).astype(int)))
    if not len(edges):
        return slice(0, 0)
    starts, ends = edges[::2], edges[1::2]
    longest = int(np.argmax(ends - starts))
    return slice(int(starts[longest]), int(ends[longest]))
