"""Drawn images of a circle target under the lamp and of the laser line on it: OpenCV's polygons, no renderer."""

import cv2
import numpy as np

from tests.uwlts.calibration_views import lens_of
from uwlts.model.placement import laser_pose
from uwlts.model.sensor import Sensor
from uwlts.targets import CircleTarget

FINER = 4
_BITS = 4
GROUND, CIRCLE, DOT = 60.0, 200.0, 10.0


def target_pose(*, tilt_deg=(0.0, 0.0), middle_mm=(0.0, 0.0, 378.0)):
    """``T_camera_target`` (4, 4): right side farther by the first angle, lower side by the second."""
    across, down = np.radians(tilt_deg)
    rotation = cv2.Rodrigues(np.array([down, -across, 0.0]))[0]
    pose = np.eye(4)
    pose[:3, :3], pose[:3, 3] = rotation, middle_mm
    return pose


def drawn_lamp(sensor: Sensor, target: CircleTarget, pose, *, blur_px=0.6, gain=1.0, noise_dn=1.0, seed=0):
    """Draw an image (H, W) of uint8 of the target at a pose."""
    width, height = sensor.camera.width_px, sensor.camera.height_px
    picture = np.full((height * FINER, width * FINER), GROUND, np.uint8)
    columns, rows = np.meshgrid(np.arange(target.columns), np.arange(target.rows))
    places = np.column_stack([columns.ravel(), rows.ravel()]) - target.origin
    marks = {(0, 0), target.marker_x, target.marker_y}
    for place in places:
        centre = place * [target.spacing_x_mm, target.spacing_y_mm]
        _disc(picture, sensor, pose, centre, target.diameter_mm / 2, CIRCLE)
        if tuple(place.tolist()) in marks:
            _disc(picture, sensor, pose, centre, target.marker_diameter_mm / 2, DOT)
    image = cv2.resize(picture, (width, height), interpolation=cv2.INTER_AREA).astype(np.float32)
    return _grey(cv2.GaussianBlur(image, (0, 0), blur_px), gain, noise_dn, seed)


def drawn_laser(sensor: Sensor, pose, *, gain=1.0, noise_dn=1.0, seed=0, half_mm=1000.0):
    """Draw an image (H, W) of uint8 of the laser line on the target's plane, up to ``half_mm`` from its origin."""
    laser, normal, origin = laser_pose(sensor), pose[:3, 2], pose[:3, 3]
    angle = np.linspace(-1, 1, 4000) * np.radians(sensor.laser.fan_angle_deg / 2)
    rays = np.cos(angle)[:, None] * laser.axis + np.sin(angle)[:, None] * laser.fan
    points = laser.origin_mm + rays * ((normal @ (origin - laser.origin_mm)) / (rays @ normal))[:, None]
    points = points[np.abs((points - origin) @ pose[:3, :2]).max(axis=1) < half_mm]
    u, v = lens_of(sensor).pixels(points).T
    width, height = sensor.camera.width_px, sensor.camera.height_px
    order = np.argsort(u)
    columns = np.arange(width)
    centre = np.interp(columns, u[order], v[order], left=np.nan, right=np.nan)
    across = np.arange(height)[:, None] - centre
    image = np.nan_to_num(150.0 * np.exp(-0.5 * (across / 1.6) ** 2)).astype(np.float32)
    return _grey(image, gain, noise_dn, seed)


def _grey(image, gain, noise_dn, seed):
    noise = np.random.default_rng(seed).normal(0, noise_dn, image.shape)
    return np.clip(np.rint(gain * image + 4 + noise), 0, 255).astype(np.uint8)


def _disc(picture, sensor, pose, centre, radius_mm, level):
    angle = np.linspace(0, 2 * np.pi, 40, endpoint=False)
    rim = np.column_stack([centre[0] + radius_mm * np.cos(angle), centre[1] + radius_mm * np.sin(angle)])
    points = rim @ pose[:3, :2].T + pose[:3, 3]
    if points[:, 2].min() <= 1.0:
        return
    # Pixel (0, 0) is the centre of the first pixel, whose finer pixels lie about it.
    pixels = (lens_of(sensor).pixels(points) + 0.5) * FINER - 0.5
    if (np.abs(pixels) > 1e5).any():
        return
    cv2.fillConvexPoly(picture, np.rint(pixels * 2**_BITS).astype(np.int32), level, cv2.LINE_AA, _BITS)
