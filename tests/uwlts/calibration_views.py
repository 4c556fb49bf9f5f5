"""Views of a sensor for calibration tests, by NumPy and Fermat's principle, independent of the sensor software."""

from dataclasses import dataclass

import numpy as np

from tests.oracles.fermat import directions_seen, plate
from uwlts.calibration.camera.camera_parameters import TargetImage
from uwlts.model.library import find_description, read_table
from uwlts.model.placement import camera_from_object, laser_pose
from uwlts.model.sensor import Sensor

STEP_MM = 23.17
WATER = 1.3312


@dataclass(frozen=True)
class Lens:
    """Pinhole camera with the distortion model of descriptions."""

    fx: float
    fy: float
    cx: float
    cy: float
    k1: float
    k2: float
    p1: float = 0.0
    p2: float = 0.0
    k3: float = 0.0
    k4: float = 0.0
    k5: float = 0.0
    k6: float = 0.0

    def pixels(self, rays):
        x, y = rays[:, 0] / rays[:, 2], rays[:, 1] / rays[:, 2]
        square = x**2 + y**2
        radial = 1 + self.k1 * square + self.k2 * square**2 + self.k3 * square**3
        radial /= 1 + self.k4 * square + self.k5 * square**2 + self.k6 * square**3
        along = x * radial + 2 * self.p1 * x * y + self.p2 * (square + 2 * x**2)
        down = y * radial + self.p1 * (square + 2 * y**2) + 2 * self.p2 * x * y
        return np.column_stack([self.fx * along + self.cx, self.fy * down + self.cy])


def built_sensor() -> Sensor:
    """Return the thesis's sensor with realistic deviations from its drawings."""
    return Sensor.model_validate(read_table(find_description("thesis-as-built", "sensors"), "sensors"))


def square_sensor() -> Sensor:
    """Return the sensor as built, with the laser's window square to the sheet, which is then a plane in water."""
    laser = built_sensor().laser
    window = laser.window.model_copy(update={"tilt_y_deg": 0.0})
    return built_sensor().model_copy(update={"laser": laser.model_copy(update={"window": window})})


def lens_of(sensor: Sensor) -> Lens:
    camera = sensor.camera
    return Lens(*camera.focal_lengths_px(), *camera.principal_point(), *camera.distortion.model_dump().values())


def inside(pixels, sensor: Sensor):
    """Return the mask (N,) of pixels (N, 2) in the image."""
    return ((pixels >= 0) & (pixels <= [sensor.camera.width_px - 1, sensor.camera.height_px - 1])).all(axis=1)


def lattice(columns=25, rows=25):
    """Return the thesis's circle centres (N, 3) in mm, target frame, with the origin in the middle."""
    x, y = np.meshgrid(np.arange(columns) - columns // 2, np.arange(rows) - rows // 2)
    return np.column_stack([9.375 * x.ravel(), 9.372 * y.ravel(), np.zeros(x.size)])


def turn(x=0.0, y=0.0, z=0.0):
    """Rotation by angles in rad about the three axes, x first."""
    (cx, sx), (cy, sy), (cz, sz) = ((np.cos(a), np.sin(a)) for a in (x, y, z))
    about_x = np.array([[1, 0, 0], [0, cx, -sx], [0, sx, cx]])
    about_y = np.array([[cy, 0, sy], [0, 1, 0], [-sy, 0, cy]])
    return np.array([[cz, -sz, 0], [sz, cz, 0], [0, 0, 1]]) @ about_y @ about_x


def stage_images(
    sensor, *, positions=np.arange(31) * 10.0, stage_tilt=(0.0, 0.0), noise_px=0.0, rng=None, points=None, spin=0.02
):
    """Return the thesis's target images in air, and the true ``T_camera_target`` of each.

    The target faces the laser, with a small rotation in its plane. The stage moves the sensor towards the target along
    its normal, tilted by ``stage_tilt`` in the target's frame.
    """
    lens, points = lens_of(sensor), lattice() if points is None else points
    rotation = camera_from_object(sensor)[:3, :3] @ turn(0.004, -0.007, np.pi / 2 + spin)
    direction = rotation @ np.array([*stage_tilt, 1.0]) / np.linalg.norm([*stage_tilt, 1.0])
    frame = camera_from_object(sensor)
    middle = frame[:3, 3] + 60.0 * frame[:3, 2]
    images, poses = [], []
    for position in positions:
        pose = np.eye(4)
        pose[:3, :3] = rotation
        pose[:3, 3] = middle - (position - positions.mean()) * direction
        seen = lens.pixels(points @ rotation.T + pose[:3, 3])
        here = inside(seen, sensor)
        pixels = seen[here] + (rng.normal(0, noise_px, (here.sum(), 2)) if noise_px else 0.0)
        images.append(TargetImage(points[here], pixels, float(position)))
        poses.append(pose)
    return images, np.array(poses), direction


def stripes_on_target(sensor, poses, *, count=1280, noise_px=0.0, rng=None):
    """Return stripe pixels of each image: the sheet's line on the target, within the fan and the image."""
    lens, laser = lens_of(sensor), laser_pose(sensor)
    stripes = []
    for pose in poses:
        normal, origin = pose[:3, 2], pose[:3, 3]
        angle = np.linspace(-1, 1, count) * np.radians(sensor.laser.fan_angle_deg / 2)
        rays = np.cos(angle)[:, None] * laser.axis + np.sin(angle)[:, None] * laser.fan
        points = laser.origin_mm + rays * ((normal @ (origin - laser.origin_mm)) / (rays @ normal))[:, None]
        pixels = lens.pixels(points)
        pixels = pixels[inside(pixels, sensor)]
        if noise_px:
            pixels = pixels + np.column_stack([np.zeros(len(pixels)), rng.normal(0, noise_px, len(pixels))])
        stripes.append(pixels)
    return stripes


def step_profile(depth_mm, *, shift_mm=0.0, tilt=0.0, height_mm=STEP_MM, count=1280):
    """Return points (N, 3) in the OCS of base, block, base at a depth, tilted about X; the block is nearer."""
    along = np.linspace(-75, 75, count)
    up = np.where(np.abs(along - shift_mm) < 30, -height_mm, 0.0)
    y, z = np.cos(tilt) * along - np.sin(tilt) * up, np.sin(tilt) * along + np.cos(tilt) * up
    return np.column_stack([np.zeros(count), y, depth_mm + z])


def nine_steps(*, count=1280, tilts=(0.01, -0.02, 0.03)):
    """The thesis's nine poses of the step standard: three near, three at the stand-off, three far; OCS."""
    return [
        step_profile(depth, shift_mm=shift, tilt=tilt, count=count)
        for depth in (-50.0, 15.0, 90.0)
        for shift, tilt in zip((-15.0, 0.0, 12.0), tilts, strict=True)
    ]


def through_window(sensor, points_object, *, index=WATER, refractions=2, noise_px=0.0, rng=None):
    """Return pixels of points in the OCS through the sensor's window, by least optical length."""
    window, frame = sensor.camera.window, camera_from_object(sensor)
    faces = plate(distance=window.distance_mm, thickness=window.thickness_mm, normal=window.normal())
    indices = [1.0, window.index(sensor.laser.wavelength_nm), index]
    if refractions == 1:
        faces, indices = faces[:1], [1.0, index]
    rays = directions_seen(points_object @ frame[:3, :3].T + frame[:3, 3], faces, indices)
    pixels = lens_of(sensor).pixels(rays)
    pixels = pixels[inside(pixels, sensor)]
    if noise_px:
        pixels = pixels + np.column_stack([np.zeros(len(pixels)), rng.normal(0, noise_px, len(pixels))])
    return pixels
