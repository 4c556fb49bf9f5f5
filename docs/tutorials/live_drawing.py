"""Live drawing of a sensor in Jupyter: sliders for baseline, angle and stand-off change view, sheet and resolution.

    from live_drawing import explore

    explore("thesis", medium="water")

`explore` needs the package ipywidgets. `draw` returns the same figures without sliders.
"""

import math
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.figure import Figure
from scipy.optimize import brentq

import uwlts
from twin.design import drawing
from uwlts.optics.design import SheetGeometry, standoff_mm
from uwlts.pages.toolkit import figure_svg, new_figure

BASELINES_MM, ANGLES_DEG = (20.0, 600.0), (10.0, 65.0)


def variant(sensor: uwlts.Sensor, baseline_mm: float, angle_deg: float) -> uwlts.Sensor:
    """Return the sensor with another baseline and triangulation angle."""
    laser = {"baseline_mm": baseline_mm, "triangulation_angle_deg": angle_deg, "origin_mm": None, "axis": None}
    return sensor.model_copy(update={"laser": sensor.laser.model_copy(update=laser)})


def standoff(sensor: uwlts.Sensor, medium: str) -> float:
    """Return the distance in mm from the camera's pupil to where its axis meets the sheet."""
    return float(np.ravel(standoff_mm(SheetGeometry.from_description(sensor, sensor.medium(medium)).laser))[0])


def draw(sensor: uwlts.Sensor, medium: str) -> tuple[Figure, Figure]:
    """Return the side view to scale, and the map of the depth per pixel over the part of the sheet in view."""
    water = sensor.medium(medium)
    sheet, window = SheetGeometry.from_description(sensor, water), sensor.camera.window
    outer_mm = window.distance_mm + window.thickness_mm if window.mounted else 1.0
    crossing_mm = standoff(sensor, medium)
    near, far = (float(np.ravel(depth)[0]) for depth in sheet.depths_in_view(np, np.array(outer_mm)))
    volume = sensor.volume.model_copy(update={"near_mm": near - outer_mm, "far_mm": far - outer_mm})
    side = drawing.draw(drawing.make_view(sensor.model_copy(update={"volume": volume}), water))
    # Z is along the laser's axis, and a depth along the camera's.
    slant = float(np.ravel(sheet.laser.axis[2])[0])
    z = (np.linspace(near, far, 60) - crossing_mm) / slant
    ends = np.abs([np.ravel(sheet.line_ends(np, np.array(end))) for end in (z[0], z[-1])]).max()
    y_mm, z_mm = np.meshgrid(np.linspace(-ends, ends, 80), z)
    image = sheet.project(np, sheet.point(z_mm, y_mm))
    per_pixel_um = 1e3 * slant * np.abs(sheet.mm_per_pixel(image)[1])
    camera = sensor.camera
    inside = (np.abs(image.x - (camera.width_px - 1) / 2) <= camera.width_px / 2) & (
        np.abs(image.y - (camera.height_px - 1) / 2) <= camera.height_px / 2
    )
    figure, (axes,) = new_figure(5.6, 3.6)
    levels = axes.contourf(y_mm, crossing_mm + slant * z_mm, np.where(inside, per_pixel_um, np.nan), levels=12)
    axes.set(xlabel="Y along the stripe / mm", ylabel="depth from the pupil / mm", ylim=(far, near), aspect="equal")
    figure.colorbar(levels, label="depth per pixel / um")
    return side, figure


def explore(sensor: str | Path | uwlts.Sensor = "thesis", *, medium: str = "water") -> Any:
    """Return sliders with the drawings of the sensor; a moved stand-off changes the angle, and the reverse."""
    import ipywidgets

    base = sensor if isinstance(sensor, uwlts.Sensor) else uwlts.load_sensor(sensor)
    laser = base.laser
    baseline, angle, distance = (
        ipywidgets.FloatSlider(value=value, min=low, max=high, step=0.5, description=name, continuous_update=False)
        for name, value, (low, high) in (
            ("baseline, mm", laser.baseline_mm or 200.0, BASELINES_MM),
            ("angle, deg", laser.triangulation_angle_deg or 30.0, ANGLES_DEG),
            ("stand-off, mm", 300.0, (50.0, 3000.0)),
        )
    )
    views, said = ipywidgets.HTML(), ipywidgets.Label()

    def show(_: object = None) -> None:
        seen = variant(base, baseline.value, angle.value)
        try:
            side, resolution = draw(seen, medium)
            distance.value = round(standoff(seen, medium), 1)
            views.value = f"<div style='display: flex'>{figure_svg(side)}{figure_svg(resolution)}</div>"
            said.value = ""
        except (uwlts.Error, ValueError) as error:
            said.value = f"no such sensor: {error}"

    def follow(change: dict[str, Any]) -> None:
        """Choose the angle for a stand-off that the user has moved."""

        def miss_mm(degrees: float) -> float:
            return standoff(variant(base, baseline.value, degrees), medium) - change["new"]

        low, high = (miss_mm(degrees) for degrees in ANGLES_DEG)
        if math.copysign(1.0, low) != math.copysign(1.0, high):
            found = round(brentq(miss_mm, *ANGLES_DEG), 1)
            if abs(found - angle.value) > 0.5:  # a step of the slider
                angle.value = found

    baseline.observe(show, "value")
    angle.observe(show, "value")
    distance.observe(follow, "value")
    show()
    return ipywidgets.VBox([ipywidgets.HBox([baseline, angle, distance]), said, views])
