"""Scans of stationary bodies in water: geometric intersection with the sheet, images by Fermat's principle."""

from dataclasses import dataclass

import numpy as np

from tests.uwlts.calibration_views import WATER, inside
from tests.uwlts.joint_views import Noise, seen
from uwlts.calibration.joint.gathering import ScanStripes
from uwlts.calibration.joint.parameters import ViewMedium
from uwlts.model.placement import camera_from_object, laser_pose
from uwlts.model.sensor import Sensor
from uwlts.model.stripe import CaptureStripes
from uwlts.optics.brightness import estimate_blur_shift_px

VIEW = ViewMedium(True, 0)
SLOPE = np.array([0.004, -0.003])
"""True slopes of the stage's direction against the OCS's X, towards Y and Z."""
NONE = Noise()

_FACING = np.cos(np.radians(75))


def stage_direction(sensor: Sensor) -> np.ndarray:
    """Return the true unit direction (3,) of the sensor's motion on the stage, camera frame."""
    turned = camera_from_object(sensor)[:3, :3] @ np.array([1.0, *SLOPE])
    return turned / np.linalg.norm(turned)


@dataclass(frozen=True)
class Body:
    """Sphere; with ``axis``, a cylinder through the point; without ``radius``, a plane with that normal (OCS, mm)."""

    point: tuple[float, float, float]
    radius: float | None = None
    axis: tuple[float, float, float] | None = None

    def lit(self, origin, rays):
        """Return the first intersections of rays (N, 3) from a point, and outward unit normals; NaN for a miss."""
        away = np.array(self.point) - origin
        axis = np.zeros(3) if self.axis is None else np.array(self.axis) / np.linalg.norm(self.axis)
        if self.radius is None:
            reach = (axis @ away) / (rays @ axis)
            normals = np.broadcast_to(-axis * np.sign(axis @ away), rays.shape)
            return origin + reach[:, None] * rays, normals

        def across(vectors):
            return vectors - np.multiply.outer(vectors @ axis, axis)

        a, b = np.sum(across(rays) ** 2, axis=1), across(rays) @ across(away)
        with np.errstate(invalid="ignore"):
            reach = (b - np.sqrt(b**2 - a * (across(away) @ across(away) - self.radius**2))) / a
        points = origin + reach[:, None] * rays
        return points, across(points - self.point) / self.radius


def scan_of(sensor: Sensor, bodies, artefact, *, stage_mm, count=200, noise=NONE, source="scan"):
    """Return the stripes on bodies at stage positions (F,), and the number of the body for each point (N,).

    The stripes are sharp. Their stated shift by blur is that of a matt surface.
    """
    frame, pose = camera_from_object(sensor), laser_pose(sensor)
    rotation = frame[:3, :3]
    origin = rotation.T @ (pose.origin_mm - frame[:3, 3])
    angle = np.linspace(-1, 1, count) * np.radians(sensor.laser.fan_angle_deg / 2)
    rays = (np.sin(angle)[:, None] * pose.fan + np.cos(angle)[:, None] * pose.axis) @ rotation
    moves, pupil = rotation.T @ stage_direction(sensor), -rotation.T @ frame[:3, 3]
    pixels, brightness, image, which = [], [], [], []
    for number, position in enumerate(stage_mm):
        travel = (position + noise.draw(noise.stage_mm, ())) * moves
        for place, body in enumerate(bodies):
            points, normals = body.lit(origin + travel, rays)
            towards = pupil + travel - points
            facing = np.sum(towards * normals, axis=1) / np.linalg.norm(towards, axis=1)
            points, lit = points[facing > _FACING] - travel, -np.sum(rays * normals, axis=1)[facing > _FACING]
            if not len(points):
                continue
            found = seen(sensor, points @ rotation.T + frame[:3, 3], index=WATER, window=True)
            there = inside(found, sensor)
            found = found[there]
            brightness.append(np.maximum(lit[there], 0.01))
            pixels.append(found + np.column_stack([np.zeros(len(found)), noise.draw(noise.stripe_px, len(found))]))
            image.append(np.full(len(found), number))
            which.append(np.full(len(found), place))
    frames, width, brightness = np.concatenate(image), np.full(sum(map(len, pixels)), 4.0), np.concatenate(brightness)
    line, centre = np.vstack(pixels).T
    stripes = ScanStripes(
        source,
        CaptureStripes(frames, line, centre, brightness, width, {}),
        estimate_blur_shift_px(frames, np.rint(line).astype(int), centre, brightness, width),
        np.zeros(len(line)),
        np.asarray(stage_mm, dtype=float),
        np.array([1.0, 0.0, 0.0]),
        artefact,
        VIEW,
    )
    return stripes, np.concatenate(which)
