"""Sensors as described: the nominal calibration, and the table of the design formulas' results."""

import math
from pathlib import Path
from typing import NamedTuple

import numpy as np

from uwlts.errors import DesignError
from uwlts.model.calibration import Calibration, CameraModel, FanModel, SheetModel, WindowModel
from uwlts.model.library import load_sensor
from uwlts.model.media import GLASSES
from uwlts.model.placement import camera_from_object, laser_pose, view_of_sheet
from uwlts.model.sensor import Medium, Sensor, to_rows
from uwlts.optics.design import (
    FARTHEST_MM,
    SheetGeometry,
    line_needed_mm,
    scheimpflug_angle_rad,
    speckle_limit_um,
    standoff_mm,
    trace_to_points,
    window_thickness_mm,
)


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

    With a medium, DesignError if the camera does not see the sheet in it. A bow bends the sheet, as does a laser window
    that is turned about the fan's direction (`uwlts.optics.triangulation`), to first order in the turn: the thesis's
    sheet in water is exact within 0.016 mm at 2 deg, and 0.13 mm at 8 deg.
    """
    if medium is not None:
        view_of_sheet(sensor, medium)
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
        sheet=_make_sheet(sensor),
        camera_from_object=to_rows(camera_from_object(sensor)),
        provenance={"source": f"description of the sensor '{sensor.name}'"},
    )


def _make_sheet(sensor: Sensor) -> SheetModel:
    """Return the described fan: a plane, unless it is bowed or the laser's window is turned out of it."""
    laser, pose, glass = sensor.laser, laser_pose(sensor), sensor.laser.window
    normal, offset, outer = tuple(pose.normal.tolist()), float(pose.normal @ pose.origin_mm), 0.0
    out, across, along = glass.normal().tolist() if glass.mounted else (0.0, 0.0, 1.0)
    if out == laser.bow_deg == 0.0:
        return SheetModel(normal=normal, offset_mm=offset)
    # Rays are refracted symmetrically about the window's normal, so that its part in the sheet replaces the fan's axis.
    part = math.hypot(across, along)
    axis = (across * pose.fan + along * pose.axis) / part
    if glass.mounted:
        outer = (glass.distance_mm * along + glass.thickness_mm) / part
        # An oblique pane shifts light (Born and Wolf, Principles of Optics, section 4.6.1).
        offset += glass.thickness_mm * out * (1.0 - part / math.sqrt(glass.index(laser.wavelength_nm) ** 2 - out**2))
    apex, along_fan, pivot = (tuple(p.tolist()) for p in (pose.origin_mm, axis, pose.origin_mm + outer * axis))
    bow, turn = math.radians(laser.bow_deg), math.asin(out)
    fan = FanModel(apex_mm=apex, axis=along_fan, pivot_mm=pivot, bow_rad=bow, window_turn_rad=turn)
    return SheetModel(normal=normal, offset_mm=offset, fan=fan)


class DesignRow(NamedTuple):
    """A row of the design table."""

    name: str
    value: float
    unit: str
    source: str


def design(sensor: str | Path | Sensor, *, medium: str) -> list[DesignRow]:
    """Calculate resolution, line length, depth range and speckle limit of a sensor with the design formulas.

    Depths and ranges are measured along the camera's axis unless a row says otherwise.

    Parameters
    ----------
    sensor : str, Path or Sensor
        Name or path of a sensor description, or the description itself.
    medium : str
        One of the sensor's media.

    Returns
    -------
    list of DesignRow
        Rows of name, value, unit and source.

    Raises
    ------
    DescriptionError
        The sensor or the medium is unknown, or the description cannot be read.
    DesignError
        As `uwlts.optics.design.SheetGeometry.from_description`.
    """
    sensor = sensor if isinstance(sensor, Sensor) else load_sensor(sensor)
    camera, geometry = sensor.camera, SheetGeometry.from_description(sensor, sensor.medium(medium))
    window, standoff = geometry.window, float(standoff_mm(geometry.laser))
    outer = camera.window.distance_mm + camera.window.thickness_mm / window.normal[2] if camera.window.mounted else 0.0
    near, far = map(float, geometry.depths_in_view(np, outer))
    if not far > outer + 1:
        raise DesignError("the sheet leaves the camera's view before the window's outer face: increase the baseline")
    far = far if far < FARTHEST_MM else math.inf
    motion = geometry.crossing_motion()
    depth, along_laser = float(abs(motion[2])), float(abs(motion @ geometry.laser.axis))
    leaning, tangent = along_laser / depth, float(abs(motion[int(geometry.along_width)])) / depth
    apparent = float(trace_to_points(np, window, geometry.point(0.0)).apparent_mm)
    speckle = speckle_limit_um(
        wavelength_nm=sensor.laser.wavelength_nm,
        focal_length_mm=camera.focal_length_mm,
        f_number=camera.f_number,
        distance_mm=apparent,
    )
    depths = np.array([sensor.volume.near_mm + outer, standoff, sensor.volume.far_mm + outer])
    low, high = geometry.line_ends(np, (depths - standoff) / geometry.laser.axis[2])
    near_line, line, far_line = high - low
    index = window.medium_index
    by_factor = standoff * camera.pixel_size_um * 1e-3 / (camera.focal_length_mm * tangent * index)
    tilt = scheimpflug_angle_rad(
        triangulation_angle_rad=math.atan(index * tangent), magnification=camera.focal_length_mm / apparent
    )
    needed = line_needed_mm(pipe_diameter_mm=300.0, passes=5)
    snell = "with Snell's law"
    return [
        DesignRow("stand-off from the pupil", standoff, "mm", f"Eq. 2.8 {snell}"),
        DesignRow("stand-off from the window", standoff - outer, "mm", f"Eq. 2.8 {snell}"),
        DesignRow("sheet in view, nearest to the window", near - outer, "mm", f"Eq. 2.8 {snell}"),
        DesignRow("sheet in view, farthest from the window", far - outer, "mm", f"Eq. 2.8 {snell}"),
        DesignRow("depth in view", far - near, "mm", f"Eq. 2.8 {snell}"),
        DesignRow("depth in view along the laser's axis", (far - near) * leaning, "mm", "over cos theta_t"),
        DesignRow("depth per pixel at the stand-off", depth, "mm/px", f"Eq. 2.9 {snell}"),
        DesignRow("depth per pixel along the laser's axis", along_laser, "mm/px", "over cos theta_t"),
        DesignRow("depth per pixel by the thesis's factor n", by_factor, "mm/px", "Eq. 2.9 over n, section 3.1.2"),
        DesignRow("line length at the volume's near end", float(near_line), "mm", f"Eq. 2.10, corrected, {snell}"),
        DesignRow("line length at the stand-off", float(line), "mm", f"Eq. 2.10, corrected, {snell}"),
        DesignRow("line length at the volume's far end", float(far_line), "mm", f"Eq. 2.10, corrected, {snell}"),
        DesignRow("line needed for a 300 mm pipe in 5 passes", needed, "mm", "Figure 27"),
        DesignRow("image plane to lens axis, sheet in focus", math.degrees(tilt), "deg", "Eq. 2.12, Scheimpflug"),
        DesignRow("speckle limit across the camera's axis", speckle, "um", "Dorsch et al. 1994, contrast 0.71"),
        DesignRow("speckle limit along the laser's axis", speckle * leaning / tangent, "um", "over sin theta_t"),
        *_list_window_rows(camera.window.aperture_diameter_mm),
    ]


def _list_window_rows(aperture_mm: float) -> list[DesignRow]:
    """Return the thickness of a window of each material with a known strength, for the pressure at 100 m."""
    return [
        DesignRow(
            f"{name} window for 1 MPa, clamped",
            window_thickness_mm(pressure_mpa=1.0, unsupported_diameter_mm=aperture_mm, strength_mpa=glass.strength_mpa),
            "mm",
            f"Eq. 3.2, safety factor 4, {glass.strength_mpa:g} MPa ({glass.strength_source})",
        )
        for name, glass in GLASSES.items()
        if glass.strength_mpa is not None
    ]


def format_table(rows: list[DesignRow]) -> list[str]:
    """Format the table as lines of text; the last line names the window materials of unknown strength."""
    width = max(len(row.name) for row in rows)
    unknown = ", ".join(name for name, glass in GLASSES.items() if glass.strength_mpa is None)
    return [
        *(f"{row.name:<{width}}  {row.value:>8.4g} {row.unit:<5}  {row.source}" for row in rows),
        f"without a thickness: {unknown}, because no strength with a source is known; ask its maker",
    ]
