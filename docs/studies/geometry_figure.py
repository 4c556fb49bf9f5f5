"""Side view of the thesis's sensor with its frames: the figure of docs/explanation/geometry.md.

``python docs/studies/geometry_figure.py`` writes docs/pictures/geometry.svg.
"""

import argparse
from pathlib import Path

import matplotlib
import numpy as np

import uwlts
from uwlts.model.placement import camera_from_object, laser_pose, view_of_sheet

PICTURE = Path(__file__).parents[1] / "pictures" / "geometry.svg"
SENSOR, MEDIUM = "thesis", "water"
CAMERA_COLOUR, LASER_COLOUR, WINDOW_COLOUR = "tab:blue", "tab:red", "0.45"


def draw(path: Path) -> None:
    """Draw camera, laser, windows, stand-off, volume and coordinate axes in the plane x = 0 of the camera frame."""
    matplotlib.use("Agg")
    matplotlib.rcParams["svg.hashsalt"] = "geometry"
    from matplotlib import pyplot as plt

    sensor = uwlts.load_sensor(SENSOR)
    laser, from_object = laser_pose(sensor), camera_from_object(sensor)
    view = view_of_sheet(sensor, sensor.media[MEDIUM])
    standoff = from_object[:3, 3]
    figure, ax = plt.subplots(figsize=(6.4, 6.6), layout="constrained")

    def flat(point: np.ndarray) -> tuple[float, float]:
        """Place of a point (3,) in the drawing: -y of the camera to the right, z downwards."""
        return -float(point[1]), float(point[2])

    def line(a: np.ndarray, b: np.ndarray, **style: object) -> None:
        ax.plot(*np.array([flat(a), flat(b)]).T, **style)

    def arrow(
        start: np.ndarray, direction: np.ndarray, name: str, colour: str, offset: tuple[float, float] = (0, 0)
    ) -> None:
        tip = start + 55.0 * direction
        ax.annotate("", flat(tip), flat(start), arrowprops={"arrowstyle": "-|>", "color": colour, "lw": 1.6})
        ax.text(*np.add(flat(start + 64.0 * direction), offset), name, color=colour, ha="center", va="center")

    axis = np.array([0.0, 0.0, 1.0])
    outside = sensor.camera.window.distance_mm + sensor.camera.window.thickness_mm
    line(0 * axis, (outside + view.farthest_mm) * axis, color=CAMERA_COLOUR, lw=1.0)
    reach = (outside + view.farthest_mm - laser.origin_mm[2]) / laser.axis[2]
    line(laser.origin_mm, laser.origin_mm + reach * laser.axis, color=LASER_COLOUR, lw=1.6)
    for origin, along, across, window in (
        (0 * axis, axis, np.array([0.0, 1.0, 0.0]), sensor.camera.window),
        (laser.origin_mm, laser.axis, laser.normal, sensor.laser.window),
    ):
        for depth in (window.distance_mm, window.distance_mm + window.thickness_mm):
            half = 0.5 * window.aperture_diameter_mm * across
            line(origin + depth * along - half, origin + depth * along + half, color=WINDOW_COLOUR, lw=1.4)
    ax.plot(*flat(0 * axis), "o", color=CAMERA_COLOUR)
    ax.plot(*flat(laser.origin_mm), "o", color=LASER_COLOUR)
    ax.plot(*flat(standoff), "ko")
    arrow(0 * axis, np.array([0.0, 1.0, 0.0]), "y", CAMERA_COLOUR)
    arrow(0 * axis, axis, "z", CAMERA_COLOUR, (-12, -12))
    arrow(standoff, from_object[:3, 0], "X", "k")
    arrow(standoff, from_object[:3, 2], "Z", "k", (-12, -8))
    ax.text(18, standoff[2] - 4, "stand-off, origin of the OCS", ha="left", va="center", fontsize=9)
    ax.text(-16, -14, "camera: entrance pupil", color=CAMERA_COLOUR, ha="center", fontsize=9)
    ax.text(
        *(np.array(flat(laser.origin_mm)) + [0, -14]), "laser: fan origin", color=LASER_COLOUR, ha="center", fontsize=9
    )
    ax.annotate("", (0, -48), flat(laser.origin_mm + np.array([0, 0, -48.0])), arrowprops={"arrowstyle": "<->"})
    ax.text(132, -56, f"baseline {sensor.laser.baseline_mm:g} mm", ha="center", fontsize=9)
    ax.text(46, standoff[2] - 112, f"{sensor.laser.triangulation_angle_deg:g}°", ha="center", fontsize=10)
    ax.text(-44, outside + 4, "window", color=WINDOW_COLOUR, ha="right", va="center", fontsize=9)
    for depth, name in ((view.nearest_mm, "near"), (view.farthest_mm, "far")):
        ax.axhline(outside + depth, color="0.8", lw=0.8, zorder=0)
        ax.text(-150, outside + depth - 4, f"{name} end of the sheet in view", fontsize=8, color="0.4")
    ax.set(
        aspect="equal", xlim=(-155, 330), ylim=(520, -75), xlabel="-y of the camera / mm", ylabel="z of the camera / mm"
    )
    figure.savefig(path, metadata={"Date": None})


if __name__ == "__main__":
    argparse.ArgumentParser(description=__doc__.split("\n")[0]).parse_args()
    draw(PICTURE)
