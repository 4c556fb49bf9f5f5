"""Scale drawing of a sensor: rays, windows, sheet and measuring volume in side view.

The view is along the sheet, perpendicular to the camera's axis, so that the sheet is a line. The measuring volume
follows from the formulas.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from twin.design.figures_of_merit import find_line_ends
from twin.design.sensor_arrays import extract_parameters
from twin.design.study_tables import number_text
from uwlts.model.placement import laser_pose
from uwlts.model.sensor import Camera, Medium, Sensor, Window
from uwlts.optics.design import WindowGeometry, standoff_mm, trace_pixels, trace_rays
from uwlts.pages.toolkit import BLUE, INK, RED, SOFT, new_figure

_BEYOND = 1.06  # length of drawn rays and sheet relative to the distance of the volume's far end
_DEPTHS = 201  # depths at which the region that both camera and laser reach is searched


@dataclass(frozen=True, eq=False)
class Module:
    """Camera or laser in a view, in mm: origin (2,), and corners of the window, (4, 2) or (0, 2)."""

    origin: np.ndarray
    window: np.ndarray


@dataclass(frozen=True, eq=False)
class SideView:
    """Sensor in the plane of the camera's axis and the baseline; points are (baseline, depth) from the pupil, in mm."""

    camera: Module
    laser: Module
    pupil_mm: float  # diameter of the pupil
    baseline_mm: float  # distance of the fan's origin from the camera's axis
    edges: tuple[np.ndarray, ...]
    """(K, 2) each; rays at the image's edges: pupil, both faces of the window if there is one, and an end in the
    medium."""
    sheet: np.ndarray  # (K, 2); the laser's axis
    volume: np.ndarray  # (2, 2); points of the sheet at the ends of the measuring volume
    in_view: np.ndarray | None  # (2, 2), optional; ends of the part that both camera and laser reach
    crossing: np.ndarray  # (2,); intersection of the sheet with the camera's axis, at the angle ``angle_rad``
    outer_mm: float  # depth of the window's outer face
    angle_rad: float

    def outlines(self) -> list[np.ndarray]:
        """Return lines (K, 2) for drawing the design behind another one; they enclose the whole view."""
        modules = [points for module in (self.camera, self.laser) for points in (module.origin[None], module.window)]
        return [*self.edges, self.sheet, *modules, self.volume]


def make_view(sensor: Sensor, medium: Medium) -> SideView:
    """Return the side view of a sensor that works in a medium."""
    pose, p, camera = laser_pose(sensor), extract_parameters([sensor], [medium]), sensor.camera
    outer, crossing = (float(depth.item()) for depth in (p.outer_mm(np), standoff_mm(p.pose(np))))
    start = np.array([0.0, 0.0, crossing])

    def on_sheet(depths: np.ndarray) -> np.ndarray:
        """Return points (N, 3) at depths on the line through ``start`` along the laser's axis."""
        return start + ((depths - crossing) / pose.axis[2])[:, None] * pose.axis

    # Camera and laser are both modules: an origin, an axis, and optionally a window.
    pupil, ahead = np.zeros(3), np.array([0.0, 0.0, 1.0])
    frame = np.stack([pose.normal, np.cross(pose.axis, pose.normal), pose.axis], axis=1)
    windows = [
        WindowGeometry.from_description(one, medium, sensor.laser.wavelength_nm, turned) if one.mounted else None
        for one, turned in ((camera.window, np.eye(3)), (sensor.laser.window, frame))
    ]
    depths = outer + np.linspace(sensor.volume.near_mm, sensor.volume.far_mm, _DEPTHS)
    near, far = depths[[0, -1]]
    # Depths at which both camera and laser reach a part of the line.
    reached = np.diff(find_line_ends(p, (depths - crossing) / pose.axis[2]))[:, 0] >= 0

    end = pose.origin_mm + _BEYOND * ((on_sheet(np.array([far]))[0] - pose.origin_mm) @ pose.axis) * pose.axis
    (axis,) = _trace(pose.origin_mm, windows[1], pose.axis[None], end, pose.axis)

    # The side view is along the sheet for any roll of the fan, with the laser on the positive side.
    sideways = math.hypot(*pose.normal[:2])
    across = pose.normal[:2] / sideways * (-1 if pose.normal[:2] @ pose.origin_mm[:2] < 0 else 1)
    side_axes = np.array([[*across, 0.0], ahead])
    border = trace_pixels(camera, _find_border(camera, across))
    return SideView(
        camera=_project(pupil, ahead, camera.window, windows[0], side_axes),
        laser=_project(pose.origin_mm, pose.axis, sensor.laser.window, windows[1], side_axes),
        pupil_mm=camera.focal_length_mm / camera.f_number,
        baseline_mm=math.hypot(*pose.origin_mm[:2]),
        edges=tuple(_trace(pupil, windows[0], border, far * _BEYOND * ahead, ahead) @ side_axes.T),
        sheet=axis @ side_axes.T,
        volume=on_sheet(np.array([near, far])) @ side_axes.T,
        in_view=on_sheet(depths[reached][[0, -1]]) @ side_axes.T if reached.any() else None,
        crossing=np.array([0.0, crossing]),
        outer_mm=outer,
        angle_rad=math.atan2(abs(pose.normal[2]), sideways),
    )


# --- camera and laser -------------------------------------------------------------------------------------------------


def _trace(
    origin: np.ndarray, window: WindowGeometry | None, directions: np.ndarray, place: np.ndarray, normal: np.ndarray
) -> np.ndarray:
    """Trace rays (N, K, 3) from an origin through a window to a plane; NaN for rays that miss the plane."""
    points = np.broadcast_to(origin, directions.shape)[:, None]
    if window is not None:
        points, directions = trace_rays(window, origin, directions)
    last = points[:, -1]
    with np.errstate(invalid="ignore", divide="ignore"):
        length = (place - last) @ normal / (directions @ normal)
        end = last + np.where(length > 0, length, np.nan)[:, None] * directions
    return np.concatenate([points, end[:, None]], axis=1)


def _project(
    origin: np.ndarray, axis: np.ndarray, described: Window, window: WindowGeometry | None, view: np.ndarray
) -> Module:
    """Project a module in the camera frame, with its window as described and as mounted, onto the axes (2, 3)."""
    if window is None:
        return Module(view @ origin, np.empty((0, 2)))
    normal = np.array(window.normal)
    inner = origin + described.distance_mm * axis
    inner, outer, seen = (view @ each for each in (inner, inner + window.thickness_mm * normal, normal))
    along = described.aperture_diameter_mm / 2 * np.array([seen[1], -seen[0]]) / np.linalg.norm(seen)
    return Module(view @ origin, np.array([inner - along, inner + along, outer + along, outer - along]))


def _find_border(camera: Camera, across: np.ndarray) -> np.ndarray:
    """Return the border pixels (2, 2) in the directions +-``across`` (2,) from the principal point."""
    centre = np.array(camera.principal_point())
    least, most = np.array([-0.5, -0.5]), np.array([camera.width_px - 0.5, camera.height_px - 0.5])
    with np.errstate(divide="ignore", invalid="ignore"):
        ends = [np.where(d > 0, most - centre, least - centre) / d for d in (across, -across)]
    lengths = [float(np.min(end[np.abs(across) > 1e-12])) for end in ends]
    return np.stack([centre + lengths[0] * across, centre - lengths[1] * across])


# --- the drawing ------------------------------------------------------------------------------------------------------

_GLASS = "#12a3a8"
_BEHIND = "#98a3af"
_VOLUME = "#f1ecd9"
_VOLUME_END = "#bda96b"
_INCHES = (7.5, 7.0)  # width and height
_MARGIN = 0.1  # margin around a view for dimensions, relative to its larger side
_LABELS = 0.35  # margin at the right for labels, relative to the width
_ARC = 0.4  # radius of the arc at the triangulation angle, relative to the stand-off from the window


def draw(view: SideView, other: SideView | None = None) -> Figure:
    """Draw a design to scale; another design is drawn behind it as dashed lines, as far as it fits."""
    figure, (axes,) = new_figure(*_INCHES)
    points = np.concatenate(view.outlines())
    points = points[np.isfinite(points).all(axis=1)]
    margin = _MARGIN * np.ptp(points, axis=0).max()
    low, high = points.min(axis=0) - margin, points.max(axis=0) + margin
    for line in other.outlines() if other else ():
        axes.plot(*line.T, "--", color=_BEHIND, linewidth=0.8)
    axes.set(xlim=(low[0], high[0] + _LABELS * (high - low)[0]), ylim=(high[1], low[1]), aspect="equal")
    axes.grid(visible=False)
    _draw_side(axes, view, labels_at=float(high[0]))
    return figure


def _fill(axes: Axes, points: np.ndarray, colour: str, alpha: float) -> None:
    """Fill an outline (N, 2) if all its points are finite."""
    if len(points) and np.isfinite(points).all():
        axes.fill(*points.T, facecolor=colour, alpha=alpha)


def _draw_dimension(axes: Axes, start: tuple[float, float], end: tuple[float, float], text: str) -> None:
    """Draw a dimension line between two points, with a text beside its middle."""
    arrow = {"arrowstyle": "<->", "color": INK, "linewidth": 0.8, "shrinkA": 0, "shrinkB": 0}
    axes.annotate("", start, end, arrowprops=arrow)
    turned, aside = (90, (-7, 0)) if start[0] == end[0] else (0, (0, 7))
    style = {"textcoords": "offset points", "ha": "center", "va": "center", "rotation": turned}
    axes.annotate(text, np.mean([start, end], axis=0), xytext=aside, **style)


def _draw_side(axes: Axes, view: SideView, *, labels_at: float) -> None:
    cross, outer, (near, far) = float(view.crossing[1]), view.outer_mm, view.volume[:, 1].tolist()
    left, top = axes.get_xlim()[0], axes.get_ylim()[1]
    axes.axhspan(near, far, color=_VOLUME, zorder=0)
    for depth, name in ((near, "near"), (far, "far")):
        axes.axhline(depth, color=_VOLUME_END, linewidth=0.8, zorder=0)
        axes.text(labels_at, depth, f"{name} {number_text(depth - outer)} mm", va="bottom")
    _fill(axes, np.concatenate([view.edges[0], view.edges[1][::-1]]), BLUE, 0.1)
    for module, name in ((view.camera, "camera"), (view.laser, "laser")):
        _fill(axes, module.window, _GLASS, 0.4)
        axes.text(module.origin[0], module.origin[1], name, ha="center", va="bottom")
    axes.axvline(0.0, color=SOFT, linewidth=0.8, linestyle="-.", zorder=1)
    for edge in view.edges:
        axes.plot(*edge.T, color=BLUE, linewidth=0.9)
    axes.plot(*view.sheet.T, color=RED, linewidth=1.0)
    axes.plot(*view.volume.T, ":", color=RED, linewidth=1.8)
    if view.in_view is not None:
        axes.plot(*view.in_view.T, color=RED, linewidth=3.4)
    axes.plot([-view.pupil_mm / 2, view.pupil_mm / 2], [0, 0], color=INK, linewidth=2.6)
    axes.plot(*np.stack([view.laser.origin, view.crossing], axis=1), "o", color=INK, markersize=4.5)
    # Arc between the camera's axis and the sheet, above their intersection.
    angles = np.linspace(0, math.copysign(view.angle_rad, float(view.sheet[0, 0] - view.sheet[-1, 0])), 60)
    arc = view.crossing + _ARC * (cross - outer) * np.stack([np.sin(angles), -np.cos(angles)], axis=1)
    axes.plot(*arc.T, color=INK, linewidth=0.8)
    text = f"{number_text(math.degrees(view.angle_rad), 3)}°"
    axes.annotate(text, arc[30], xytext=(0, 8), textcoords="offset points", ha="center")
    shown = float(view.laser.origin[0])
    text = f"baseline {number_text(view.baseline_mm)} mm"
    if abs(view.baseline_mm - shown) > 1e-3 * view.baseline_mm:
        # The baseline is not perpendicular to the stripe.
        text = f"{number_text(shown)} mm of the {text}"
    _draw_dimension(axes, (0.0, 0.75 * top), (shown, 0.75 * top), text)
    _draw_dimension(axes, (0.8 * left, outer), (0.8 * left, cross), f"stand-off {number_text(cross - outer)} mm")
    for depth in (outer, cross):
        axes.plot([0.8 * left, 0.0], [depth, depth], color=_BEHIND, linewidth=0.6)
    axes.set(xlabel="across the stripe / mm", ylabel="depth from the pupil / mm")
