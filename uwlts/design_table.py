"""The design formulas applied to a sensor's description: a table of what it can do in a medium."""

import math
from dataclasses import replace
from typing import NamedTuple

import numpy as np

from uwlts.design import (
    FlatWindow,
    Triangulation,
    depth_mm,
    depth_per_pixel_mm,
    line_length_mm,
    line_needed_mm,
    measuring_volume,
    scheimpflug_angle_rad,
    speckle_limit_um,
    thesis_factor,
    window_thickness_mm,
)
from uwlts.errors import DesignError
from uwlts.placement import camera_from_object, laser_pose
from uwlts.sensor import Medium, Sensor


class Quantity(NamedTuple):
    """A row of the design table."""

    name: str
    value: float
    unit: str
    source: str


def nominal_setup(sensor: Sensor, medium: Medium) -> tuple[Triangulation, float]:
    """The sensor's triangulation behind its window, and Z along the laser's axis per depth along the camera's.

    A laser placed by its axis, or rolled, counts as the baseline and angle at which its sheet meets the plane of the
    image's middle line across the stripe and the pupil. Lens distortion and tilts are left out.

    Raises
    ------
    DesignError
        The sheet does not cross the camera's axis before the window, the stripe runs along the other side of the image,
        or no window keeps the medium out.
    """
    camera, wavelength = sensor.camera, sensor.laser.wavelength_nm
    pose, index = laser_pose(sensor), medium.refractive_index(wavelength)
    standoff = camera_from_object(sensor)[2, 3]
    if not camera.window.mounted and index != 1:
        raise DesignError(f"the camera's window is not mounted, but the medium's index is {index:.4f}: mount it")
    side = 1 if camera.stripe_along == "width" else 0
    if abs(pose.normal[side]) < 1e-6:
        raise DesignError(f"the stripe runs across the image's {camera.stripe_along}, not along it: turn the camera")
    trace = np.array([0.0, 0.0, 1.0])
    trace[side] = -pose.normal[2] / pose.normal[side]
    setup = Triangulation(
        baseline_mm=standoff * abs(trace[side]),
        triangulation_angle_rad=math.atan(abs(trace[side])),
        focal_length_mm=camera.focal_length_mm,
        pixel_size_mm=1e-3 * camera.pixel_size_um,
        window=FlatWindow(
            distance_mm=camera.window.distance_mm,
            thickness_mm=camera.window.thickness_mm,
            glass_index=camera.window.index(wavelength) if camera.window.mounted else 1.0,
            medium_index=index,
        ),
    )
    return setup, abs(trace @ pose.axis)


def design_table(sensor: Sensor, medium: Medium) -> list[Quantity]:
    """What the formulas say of a sensor in a medium; depths and ranges along the camera's axis unless named otherwise.

    Raises
    ------
    DesignError
        As `nominal_setup`.
    """
    camera = sensor.camera
    setup, leaning = nominal_setup(sensor, medium)
    window, tangent = setup.window, math.tan(setup.triangulation_angle_rad)
    sides = {"width": camera.width_px, "height": camera.height_px}
    along = sides.pop(camera.stripe_along)
    (across,) = sides.values()
    standoff, outer = float(depth_mm(setup, 0.0)), window.outer_mm
    per_pixel = float(depth_per_pixel_mm(setup, 0.0))
    by_factor = float(depth_per_pixel_mm(replace(setup, window=thesis_factor(window.medium_index)), 0.0))
    near, far = measuring_volume(setup, side_px=across)
    near_line, line, far_line = line_length_mm(
        setup, np.array([sensor.volume.near_mm + outer, standoff, sensor.volume.far_mm + outer]), side_px=along
    )
    apparent = float(window.reach_mm(standoff))
    tilt = scheimpflug_angle_rad(
        triangulation_angle_rad=math.atan(window.medium_index * tangent),
        magnification=camera.focal_length_mm / apparent,
    )
    speckle = speckle_limit_um(
        wavelength_nm=sensor.laser.wavelength_nm,
        focal_length_mm=camera.focal_length_mm,
        f_number=camera.f_number,
        distance_mm=apparent,
    )
    glass = window_thickness_mm(
        pressure_mpa=1.0, unsupported_diameter_mm=camera.window.aperture_diameter_mm, strength_mpa=60.0
    )
    needed = line_needed_mm(pipe_diameter_mm=300.0, passes=5)
    snell = "with Snell's law"
    return [
        Quantity("stand-off from the pupil", standoff, "mm", f"Eq. 2.8 {snell}"),
        Quantity("stand-off from the window", standoff - outer, "mm", f"Eq. 2.8 {snell}"),
        Quantity("sheet in view, nearest to the window", near - outer, "mm", f"Eq. 2.8 {snell}"),
        Quantity("sheet in view, farthest from the window", far - outer, "mm", f"Eq. 2.8 {snell}"),
        Quantity("depth in view", far - near, "mm", f"Eq. 2.8 {snell}"),
        Quantity("depth in view along the laser's axis", (far - near) * leaning, "mm", "over cos theta_t"),
        Quantity("depth per pixel at the stand-off", per_pixel, "mm/px", f"Eq. 2.9 {snell}"),
        Quantity("depth per pixel along the laser's axis", per_pixel * leaning, "mm/px", "over cos theta_t"),
        Quantity("depth per pixel by the thesis's factor n", by_factor, "mm/px", "Eq. 2.9 over n, section 3.1.2"),
        Quantity("line length at the volume's near end", float(near_line), "mm", f"Eq. 2.10, corrected, {snell}"),
        Quantity("line length at the stand-off", float(line), "mm", f"Eq. 2.10, corrected, {snell}"),
        Quantity("line length at the volume's far end", float(far_line), "mm", f"Eq. 2.10, corrected, {snell}"),
        Quantity("line needed for a 300 mm pipe in 5 passes", needed, "mm", "Figure 27"),
        Quantity("image plane to lens axis, sheet in focus", math.degrees(tilt), "deg", "Eq. 2.12, Scheimpflug"),
        Quantity("speckle limit across the camera's axis", speckle, "um", "Dorsch et al. 1994"),
        Quantity("speckle limit along the laser's axis", speckle * leaning / tangent, "um", "over sin theta_t"),
        Quantity("fused silica window for 1 MPa, clamped", glass, "mm", "Eq. 3.2, safety factor 4, 60 MPa"),
    ]


def table_lines(rows: list[Quantity]) -> list[str]:
    """The table as text."""
    width = max(len(row.name) for row in rows)
    return [f"{row.name:<{width}}  {row.value:>8.4g} {row.unit:<5}  {row.source}" for row in rows]
