"""Nominal placement of camera, laser and sheet, and checks of a design."""

import math
from dataclasses import dataclass
from typing import TypeVar

import numpy as np

from uwlts.errors import DesignError
from uwlts.model.sensor import Medium, Sensor, Window

ArrayT = TypeVar("ArrayT", float, np.ndarray)


@dataclass(frozen=True)
class LaserPose:
    """Laser fan in the camera frame: origin (3,) in mm; axis, fan direction and sheet normal as unit vectors (3,)."""

    origin_mm: np.ndarray
    axis: np.ndarray
    fan: np.ndarray
    normal: np.ndarray


def laser_pose(sensor: Sensor) -> LaserPose:
    """Return the nominal pose of the laser's fan in the camera frame, with fan = axis x normal.

    The sheet's normal is the baseline's direction (+x for a stripe along the height, -y along the width), projected
    onto the plane normal to the laser's axis and rotated by the roll about the axis.
    """
    laser = sensor.laser
    towards = np.array((1.0, 0.0, 0.0) if sensor.camera.stripe_along == "height" else (0.0, -1.0, 0.0))
    if laser.baseline_mm is not None and laser.triangulation_angle_deg is not None:
        angle = math.radians(laser.triangulation_angle_deg)
        origin = laser.baseline_mm * towards
        axis = -math.sin(angle) * towards + np.array([0.0, 0.0, math.cos(angle)])
    elif laser.origin_mm is not None and laser.axis is not None:
        origin = np.array(laser.origin_mm)
        axis = np.array(laser.axis) / np.linalg.norm(laser.axis)
    else:
        raise DesignError("the laser is not placed: give baseline and triangulation angle, or origin and axis")
    normal = towards - (towards @ axis) * axis
    if np.linalg.norm(normal) < 1e-6:
        raise DesignError("the laser's axis runs along the baseline, so that the sheet is undefined: change the axis")
    normal /= np.linalg.norm(normal)
    fan = np.cross(axis, normal)
    roll = math.radians(laser.roll_deg)
    normal = math.cos(roll) * normal + math.sin(roll) * fan
    return LaserPose(origin_mm=origin, axis=axis, fan=np.cross(axis, normal), normal=normal)


def camera_from_object(sensor: Sensor) -> np.ndarray:
    """Return ``T_camera_object`` (4, 4), which maps the object coordinate system (OCS) to the camera frame.

    The OCS is that of the thesis: X normal to the sheet, Z along the laser's axis away from the sensor, Y = Z x X along
    the stripe. Its origin is the intersection of the camera's axis with the sheet (the stand-off). Raises DesignError
    if the origin is not in front of the window.
    """
    pose = laser_pose(sensor)
    crossing = pose.normal[2]
    standoff = pose.normal @ pose.origin_mm / crossing if abs(crossing) > 1e-9 else math.inf
    window = sensor.camera.window
    if not window.distance_mm + window.thickness_mm < standoff < 1e5:
        raise DesignError(
            f"the sheet crosses the camera's axis {standoff:.1f} mm from the entrance pupil; it must cross in front of "
            f"the window's outer face at {window.distance_mm + window.thickness_mm:.1f} mm: change baseline or angle"
        )
    transform = np.eye(4)
    transform[:3, :3] = np.stack([pose.normal, pose.fan, pose.axis], axis=1)
    transform[:3, 3] = (0.0, 0.0, standoff)
    return transform


@dataclass(frozen=True)
class SheetView:
    """Camera's view of the sheet: line length at the stand-off, and depth range outside the window, mm."""

    standoff_mm: float
    line_length_mm: float
    nearest_mm: float
    farthest_mm: float


def _compute_half_width_mm(
    window: Window, medium_index: float, wavelength_nm: float, half_slope: float, depth_mm: np.ndarray
) -> np.ndarray:
    """Return half the width of the view at depths outside an untilted window, from its half slope in air (Snell)."""
    sine = math.sin(math.atan(half_slope))
    slopes = [s / math.sqrt(1 - s * s) for s in (sine, sine / window.index(wavelength_nm), sine / medium_index)]
    return slopes[0] * window.distance_mm + slopes[1] * window.thickness_mm + slopes[2] * depth_mm


def view_of_sheet(sensor: Sensor, medium: Medium) -> SheetView:
    """Return line length and depth range of the nominal sensor in a medium, without lens distortion and tilts.

    Raises DesignError if the sheet does not cross the view within ten stand-offs.
    """
    camera, wavelength, pose = sensor.camera, sensor.laser.wavelength_nm, laser_pose(sensor)
    index = medium.refractive_index(wavelength)
    outer = camera.window.distance_mm + camera.window.thickness_mm
    standoff = camera_from_object(sensor)[2, 3] - outer
    fx, fy = camera.focal_lengths_px()
    across, along, axis = camera.width_px / fx / 2, camera.height_px / fy / 2, 0
    if camera.stripe_along == "width":
        across, along, axis = along, across, 1
    depth = np.linspace(0.0, 10 * standoff, 20001)
    sheet = (pose.normal @ pose.origin_mm - pose.normal[2] * (depth + outer)) / pose.normal[axis]
    seen = np.abs(sheet) <= _compute_half_width_mm(camera.window, index, wavelength, across, depth)
    if not seen.any():
        raise DesignError("the sheet never crosses the camera's view: change baseline, angle or focal length")
    length = 2 * _compute_half_width_mm(camera.window, index, wavelength, along, np.array([standoff]))[0]
    return SheetView(float(standoff), float(length), float(depth[seen][0]), float(depth[seen][-1]))


def check_design(sensor: Sensor, medium: Medium) -> SheetView:
    """Check a sensor's design in a medium and return its view of the sheet.

    Raises DesignError if a window is smaller than the camera's cone of view or the laser's fan. The same if the sheet
    is not seen in the measuring volume.
    """
    camera, laser = sensor.camera, sensor.laser
    window = camera.window
    if window.mounted:
        half = _compute_half_width_mm(window, 1.0, laser.wavelength_nm, camera.corner_slope(), np.zeros(1))[0]
        needed = 2 * half + camera.focal_length_mm / camera.f_number
        if needed > window.aperture_diameter_mm:
            raise DesignError(
                f"the camera's window has an aperture of {window.aperture_diameter_mm:.1f} mm, but the cone of view is "
                f"{needed:.1f} mm wide at its outer face: enlarge the window or move it closer to the lens"
            )
    if laser.window.mounted:
        spread = 2 * math.tan(math.radians(laser.fan_angle_deg / 2)) * laser.window.distance_mm
        if spread > laser.window.aperture_diameter_mm:
            raise DesignError(
                f"the laser's window has an aperture of {laser.window.aperture_diameter_mm:.1f} mm, but the fan is "
                f"{spread:.1f} mm wide at its inner face: enlarge the window or move it closer to the laser"
            )
    view = view_of_sheet(sensor, medium)
    if view.nearest_mm > sensor.volume.far_mm or view.farthest_mm < sensor.volume.near_mm:
        raise DesignError(
            f"the camera sees the sheet from {view.nearest_mm:.0f} to {view.farthest_mm:.0f} mm outside the window, "
            f"but the measuring volume reaches from {sensor.volume.near_mm:g} to {sensor.volume.far_mm:g} mm"
        )
    return view


def apparent_depth_mm(
    depth_mm: ArrayT, inner_mm: float, thickness_mm: float, *, glass_index: float, medium_index: float
) -> ArrayT:
    """Return the apparent depth of points behind a window for rays near the axis.

    A layer of index n appears n times thinner. ``inner_mm`` is the depth of the window's inner face.
    """
    return inner_mm + thickness_mm / glass_index + (depth_mm - inner_mm - thickness_mm) / medium_index
