"""Side view of a sensor and view onto its sheet with the keys of its description: docs/how-to/describe-your-sensor.md.

``python docs/studies/sensor_keys_figure.py`` writes docs/pictures/sensor-keys.svg.
"""

import argparse
from pathlib import Path

import matplotlib
import numpy as np

import uwlts
from uwlts.model.placement import camera_from_object, laser_pose

PICTURE = Path(__file__).parents[1] / "pictures" / "sensor-keys.svg"
SENSOR = "thesis"
CAMERA_COLOUR, LASER_COLOUR, VOLUME_COLOUR = "tab:blue", "tab:red", "tab:green"
SMALL = {"fontsize": 8.5, "family": "monospace"}


def draw(path: Path) -> None:
    """Draw the sensor `SENSOR` to scale, in the plane of camera and laser axis and in the plane of the sheet."""
    matplotlib.use("Agg")
    matplotlib.rcParams["svg.hashsalt"] = "sensor-keys"
    from matplotlib import pyplot as plt

    sensor = uwlts.load_sensor(SENSOR)
    camera, laser, volume = sensor.camera, sensor.laser, sensor.volume
    pose, standoff = laser_pose(sensor), float(camera_from_object(sensor)[2, 3])
    figure, (side, front) = plt.subplots(1, 2, figsize=(10.4, 6.2), width_ratios=(5, 2), layout="constrained")
    # Drawing of the side view: -y of the camera to the right, z of the camera downwards.
    origin = np.array([-pose.origin_mm[1], pose.origin_mm[2]])
    along, crossing = np.array([-pose.axis[1], pose.axis[2]]), np.array([0.0, standoff])
    across = np.array([along[1], -along[0]])
    outer = camera.window.distance_mm + camera.window.thickness_mm

    def span(start: np.ndarray, end: np.ndarray, colour: str) -> None:
        side.annotate("", end, start, arrowprops={"arrowstyle": "<->", "color": colour, "lw": 1.0, "shrinkA": 0})

    def name(place: tuple[float, float], text: str, colour: str, horizontal: str = "left") -> None:
        side.text(*place, text, color=colour, ha=horizontal, va="center", **SMALL)

    side.plot([0, 0], [0, outer + volume.far_mm + 30], color=CAMERA_COLOUR, lw=0.9)
    reach = (outer + volume.far_mm + 20) / along[1]
    side.plot(*np.array([origin, origin + reach * along]).T, color=LASER_COLOUR, lw=1.6)
    for place, direction, normal, window, colour in (
        (np.zeros(2), np.array([0.0, 1.0]), np.array([1.0, 0.0]), camera.window, CAMERA_COLOUR),
        (origin, along, across, laser.window, LASER_COLOUR),
    ):
        half = 0.5 * window.aperture_diameter_mm * normal
        faces = [place + depth * direction for depth in (window.distance_mm, window.distance_mm + window.thickness_mm)]
        corners = [faces[0] - half, faces[0] + half, faces[1] + half, faces[1] - half]
        side.fill(*np.array(corners).T, color=colour, alpha=0.35)
        side.plot(*place, "o", color=colour)
    side.plot(*crossing, "ko")
    near, far = outer + volume.near_mm, outer + volume.far_mm
    for depth in (near, far):
        side.plot([-345, 60], [depth, depth], color=VOLUME_COLOUR, lw=0.8, ls=":")
    side.plot([-345, 0], [outer, outer], color="0.7", lw=0.8, ls=":")

    span(np.array([0, -45]), np.array([origin[0], -45]), LASER_COLOUR)
    name((origin[0] / 2, -58), "laser.baseline_mm", LASER_COLOUR, "center")
    name((-12, -14), "entrance pupil", CAMERA_COLOUR, "right")
    name((origin[0] + 10, -14), "fan's origin", LASER_COLOUR, "center")
    for key, row, depth in (
        ("distance_mm", 14, 0.5 * camera.window.distance_mm),
        ("thickness_mm, .glass", 34, camera.window.distance_mm),
        ("aperture_diameter_mm", 54, outer),
    ):
        side.plot([-40, -2 if row == 14 else -30], [row, depth if row == 14 else outer - 3], color="0.6", lw=0.6)
        name((-42, row), f"camera.window.{key}", CAMERA_COLOUR, "right")
    inner = origin + laser.window.distance_mm * along
    for key, row in (("distance_mm", 16), ("thickness_mm, .glass", 38), ("aperture_diameter_mm", 60)):
        side.plot([302, inner[0] + 18], [row, inner[1] + 8], color="0.6", lw=0.6)
        name((305, row), f"laser.window.{key}", LASER_COLOUR)
    shift = 42 * across
    span(origin + shift, crossing + shift, LASER_COLOUR)
    name(tuple(0.6 * origin + 0.4 * crossing + shift + [10, 0]), "laser.waist_distance_mm", LASER_COLOUR)
    name(tuple(crossing + [60, 16]), "stand-off: 1/e² radius of the\nsheet laser.waist_radius_mm", LASER_COLOUR)
    angles = np.linspace(0, np.radians(laser.triangulation_angle_deg or 0), 30)
    side.plot(150 * np.sin(angles), standoff - 150 * np.cos(angles), color="k", lw=0.8)
    name((130, standoff - 60), "laser.triangulation_angle_deg", "k")
    side.plot([45, 127], [standoff - 142, standoff - 62], color="0.6", lw=0.6)
    span(np.array([-18, 0]), np.array([-18, standoff]), CAMERA_COLOUR)
    name((-26, 165), "camera.focus_distance_mm\n(apparent, through the\nwindow and the medium)", CAMERA_COLOUR, "right")
    for column, depth, key in ((-270, near, "near_mm"), (-330, far, "far_mm")):
        span(np.array([column, outer]), np.array([column, depth]), VOLUME_COLOUR)
        name((column + 5, depth - 10), f"volume.{key}", VOLUME_COLOUR)
    side.set(aspect="equal", xlim=(-350, 520), ylim=(520, -75), title="side view")

    # View onto the sheet: the stripe's direction to the right, the laser's axis downwards.
    half = np.radians(laser.fan_angle_deg / 2)
    end = float(np.linalg.norm(crossing - origin))
    front.plot([-end * np.tan(half), 0, end * np.tan(half)], [end, 0, end], color=LASER_COLOUR)
    front.plot([-end * np.tan(half), end * np.tan(half)], [end, end], color="k", lw=2)
    bow = np.linspace(-half, half, 40)
    front.plot(170 * np.sin(bow), 170 * np.cos(bow), color=LASER_COLOUR, lw=0.8)
    front.text(0, 225, "laser.fan_angle_deg", color=LASER_COLOUR, ha="center", **SMALL)
    front.text(0, -14, "laser.wavelength_nm, .power_mw", color=LASER_COLOUR, ha="center", **SMALL)
    front.text(0, end + 22, "stripe, along the image's side\ncamera.stripe_along", ha="center", va="top", **SMALL)
    image = "camera.width_px, .height_px,\n.pixel_size_um,\n.focal_length_mm, .f_number"
    front.text(0, end + 80, image, color=CAMERA_COLOUR, ha="center", va="top", **SMALL)
    front.set(aspect="equal", xlim=(-215, 215), ylim=(end + 160, -50), title="view onto the sheet")
    for axes in (side, front):
        axes.set_axis_off()
    figure.savefig(path, metadata={"Date": None})


if __name__ == "__main__":
    argparse.ArgumentParser(description=(__doc__ or "").split("\n")[0]).parse_args()
    draw(PICTURE)
