"""Calibration from a sensor's description alone, for designs and for checks with true parameters."""

import math
from pathlib import Path

import numpy as np

from uwlts.model.calibration import Calibration, CameraModel, SheetModel, WindowModel
from uwlts.model.library import load_sensor
from uwlts.model.placement import camera_from_object, laser_pose, view_of_sheet
from uwlts.model.sensor import Medium, Sensor
from uwlts.optics.window import trace_window

# Number of rays across the fan for the fit of the plane.
_RAYS = 65
# Depths along each ray.
_DEPTHS = 9


def nominal(sensor: str | Path | Sensor, *, medium: str) -> Calibration:
    """Return the calibration that a sensor would have if it were built exactly as described.

    Parameters
    ----------
    sensor : str, Path or Sensor
        Name or path of a sensor description, or the description itself.
    medium : str
        One of the sensor's media. A tilted window of the laser refracts the sheet in it.

    Returns
    -------
    Calibration
        Parameters without uncertainty or evidence.

    Raises
    ------
    DescriptionError
        The sensor or the medium is unknown, or the description cannot be read.
    DesignError
        The sensor cannot work.
    """
    described = sensor if isinstance(sensor, Sensor) else load_sensor(sensor)
    return nominal_calibration(described, described.medium(medium)).model_copy(update={"medium_name": medium})


def nominal_calibration(sensor: Sensor, medium: Medium | None = None) -> Calibration:
    """Return the calibration that a sensor would have if it were built exactly as described.

    Without a medium, the sheet is the plane of the fan where it leaves the laser. With a medium, the sheet is the best
    plane through the fan's rays behind the laser's window, over the depths in the camera's view. A window that is
    turned about the sheet's normal does not change the sheet. A window that is turned about the fan's direction turns
    and bends it.
    """
    camera = sensor.camera
    return Calibration(
        sensor_name=sensor.name,
        stripe_along=camera.stripe_along,
        wavelength_nm=sensor.laser.wavelength_nm,
        # Without a window, the described focal length includes no refraction: it is that in air.
        medium_kind=medium.kind if medium is not None and camera.window.mounted else "air",
        camera=CameraModel.from_description(camera),
        window=WindowModel.from_description(camera.window, sensor.laser.wavelength_nm)
        if camera.window.mounted
        else None,
        sheet=_sheet(sensor, medium),
        camera_from_object=tuple(map(tuple, camera_from_object(sensor))),
        provenance={"source": f"description of the sensor '{sensor.name}'"},
    )


def _sheet(sensor: Sensor, medium: Medium | None) -> SheetModel:
    """Return the plane of the fan, or the plane fitted to its rays in a medium over the depths in the camera's view."""
    laser, pose = sensor.laser, laser_pose(sensor)
    if medium is None:
        return SheetModel(normal=tuple(pose.normal), offset_mm=float(pose.normal @ pose.origin_mm))
    half = math.radians(laser.fan_angle_deg / 2)
    angle = np.linspace(-half, half, _RAYS)
    fan = np.stack([np.zeros(_RAYS), np.sin(angle), np.cos(angle)], axis=1)
    window = WindowModel.from_description(laser.window, laser.wavelength_nm) if laser.window.mounted else None
    rays = trace_window(fan, window, medium_index=medium.refractive_index(laser.wavelength_nm))
    # Laser frame: x along the sheet's normal, y along the fan, z along the axis.
    module = np.stack([pose.normal, pose.fan, pose.axis])
    origins, directions = rays.origins @ module + pose.origin_mm, rays.directions @ module
    view = view_of_sheet(sensor, medium)
    outer = sensor.camera.window.distance_mm + sensor.camera.window.thickness_mm
    depths = np.linspace(view.nearest_mm, view.farthest_mm, _DEPTHS) + outer
    reach = (depths[:, None] - origins[:, 2]) / directions[:, 2]
    points = (origins + reach[..., None] * directions).reshape(-1, 3)
    middle = points.mean(axis=0)
    normal = np.linalg.svd(points - middle, full_matrices=False)[2][2]
    normal *= np.sign(normal @ pose.normal)
    return SheetModel(normal=tuple(normal), offset_mm=float(normal @ middle))
