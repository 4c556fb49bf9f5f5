"""Drawing of a sensor to scale: rays, windows, sheet and measuring volume, from the side and onto the sheet.

The side view looks along the sheet, square to the camera's axis, so that the sheet is a line; the front view looks onto
the sheet. The measuring volume is that of the formulas.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from itertools import pairwise

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from numpy.typing import ArrayLike

from twin.design.figures_of_merit import depths_in_view, field_of
from twin.design.geometry import Lens, WindowGeometry, directions_of, traced
from twin.design.parameters import SensorArrays, parameters_of
from twin.design.report.study_tables import number_text
from uwlts.errors import DesignError
from uwlts.model.placement import LaserPose, laser_pose
from uwlts.model.sensor import Camera, Medium, Sensor, Window
from uwlts.pages.toolkit import INK, SOFT, new_figure

_BEYOND = 1.06
"""Rays and sheet are drawn so much farther than the volume's far end."""
_DEPTHS, _PLACES = 201, 21
"""Points at which the part of the volume is sought that camera and laser reach: depths, and places along the stripe."""
_BORDER = 41
"""Pixels along each side of the image."""
_HOUSING_MM, _WALL_MM, _BARE_FRONT_MM, _BARE_HALF_MM = 42.0, 5.0, 12.0, 15.0
"""The description does not contain the housing: its depth, its wall, and its size where there is no window."""


@dataclass(frozen=True, eq=False)
class Module:
    """Camera or laser from one side, in mm: origin (2,), corners of window, (4, 2) or (0, 2), and housing (5, 2). Only
    origin and window are to scale: the description does not know the housing."""

    origin: np.ndarray
    window: np.ndarray
    housing: np.ndarray


@dataclass(frozen=True, eq=False)
class SideView:
    """A sensor in the plane of the camera's axis and the baseline; points are (baseline, depth) from the pupil, in mm.

    ``edges`` are rays (K, 2) of the image's edges: pupil, both faces of the window if there is one, and an end in the
    medium. ``sheet`` (K, 2) is the laser's axis, ``volume`` (2, 2) its points at the depths of the volume's ends,
    ``in_view`` the ends of the part that camera and laser reach, ``crossing`` where the sheet crosses the camera's
    axis, at ``angle_rad``. ``baseline_mm`` is the distance of the fan's origin from that axis, in any direction.
    """

    camera: Module
    laser: Module
    pupil_mm: float
    baseline_mm: float
    edges: tuple[np.ndarray, ...]
    sheet: np.ndarray
    volume: np.ndarray
    in_view: np.ndarray | None
    crossing: np.ndarray
    outer_mm: float
    angle_rad: float

    def outlines(self) -> list[np.ndarray]:
        """Lines (K, 2) that show the design behind another one; everything else lies within their extent."""
        return [*self.edges, self.sheet, self.camera.housing, self.laser.housing, self.volume]


@dataclass(frozen=True, eq=False)
class FrontView:
    """The sheet face on; points are (along the stripe, along the laser's axis) from the fan's origin, in mm.

    ``fan`` are the fan's edges (K, 2) and ``borders`` the image's four sides (N, 2) in the sheet, NaN where they miss
    it. ``lines`` (3, 2, 2) are the ends of the line at near end, middle and far end of what the camera sees of the
    volume, NaN if it sees nothing; ``region`` (N, 2) is the outline of what camera and laser reach, possibly empty.
    """

    laser: Module
    fan: tuple[np.ndarray, ...]
    borders: tuple[np.ndarray, ...]
    lines: np.ndarray
    region: np.ndarray

    def outlines(self) -> list[np.ndarray]:
        """Lines (K, 2) that show the design behind another one; everything else lies within their extent."""
        return [*self.fan, *self.lines, self.laser.housing]


def views_of(sensor: Sensor, medium: Medium) -> tuple[SideView, FrontView]:
    """Side and front view of a sensor in a medium. DesignError where the sheet does not cross the camera's axis in
    front of the window, or the laser shines back; else errors as of `twin.design.parameters.numbers_of`."""
    pose, p, camera = laser_pose(sensor), parameters_of([sensor], [medium]), sensor.camera
    outer = float(p.outer_mm(np).item())
    crossing = _crossing_mm(pose, outer)
    start = np.array([0.0, 0.0, crossing])

    def on_sheet(depths: np.ndarray) -> np.ndarray:
        """Points (N, 3) at depths on the line through ``start`` along the laser's axis."""
        return start + ((depths - crossing) / pose.axis[2])[:, None] * pose.axis

    # Camera and laser are modules of one kind: a frame with z along the axis, and perhaps a window.
    seeing = _Mounted.of(sensor, camera.window, medium, np.zeros(3), np.eye(3))
    frame = np.stack([pose.normal, np.cross(pose.axis, pose.normal), pose.axis], axis=1)
    lighting = _Mounted.of(sensor, sensor.laser.window, medium, pose.origin_mm, frame)
    lens = Lens.of(camera)
    depths, low, high, shown, line = _reach(sensor, p, float((start - pose.origin_mm) @ pose.fan))
    near, far = outer + depths[[0, -1]]
    reached = np.isfinite(low)

    end = pose.origin_mm + _BEYOND * ((on_sheet(np.array([far]))[0] - pose.origin_mm) @ pose.axis) * pose.axis
    angles = np.array([0.0, p.lit_from_rad.item(), p.lit_to_rad.item()])[:, None]
    axis, *fan = lighting.rays(np.cos(angles) * pose.axis + np.sin(angles) * pose.fan, end, pose.axis)

    # The side view runs along the sheet whatever the fan's roll; the laser is on the positive side.
    sideways = math.hypot(*pose.normal[:2])
    across = pose.normal[:2] / sideways * (-1 if pose.normal[:2] @ pose.origin_mm[:2] < 0 else 1)
    side_axes = np.array([[*across, 0.0], [0.0, 0.0, 1.0]])
    ahead = np.array([0.0, 0.0, 1.0])
    border = directions_of(lens, _border_towards(camera, across))
    side_view = SideView(
        camera=seeing.seen_along(side_axes, 0.0),
        laser=lighting.seen_along(side_axes, 0.0),
        pupil_mm=camera.focal_length_mm / camera.f_number,
        baseline_mm=math.hypot(*pose.origin_mm[:2]),
        edges=tuple(seeing.rays(border, far * _BEYOND * ahead, ahead) @ side_axes.T),
        sheet=axis @ side_axes.T,
        volume=on_sheet(np.array([near, far])) @ side_axes.T,
        in_view=on_sheet(outer + depths[reached][[0, -1]]) @ side_axes.T if reached.any() else None,
        crossing=np.array([0.0, crossing]),
        outer_mm=outer,
        angle_rad=math.atan2(abs(pose.normal[2]), sideways),
    )

    front_axes = np.stack([pose.fan, pose.axis])
    heights, shown = ((on_sheet(outer + at) - pose.origin_mm) @ pose.axis for at in (depths, shown))
    low, high = (np.stack([y, heights], axis=1)[reached] for y in (low, high))
    width, height = camera.width_px - 0.5, camera.height_px - 0.5
    corners = np.array([(-0.5, -0.5), (width, -0.5), (width, height), (-0.5, height), (-0.5, -0.5)])
    sides = [directions_of(lens, np.linspace(a, b, _BORDER)) for a, b in pairwise(corners)]
    borders = [seeing.rays(side, pose.origin_mm, pose.normal)[:, -1] for side in sides]
    front = FrontView(
        laser=lighting.seen_along(front_axes, pose.origin_mm),
        fan=tuple((edge - pose.origin_mm) @ front_axes.T for edge in fan),
        borders=tuple((border - pose.origin_mm) @ front_axes.T for border in borders),
        lines=np.stack([line, np.repeat(shown[:, None], 2, axis=1)], axis=2),
        region=np.concatenate([low, high[::-1]]),
    )
    return side_view, front


def _crossing_mm(pose: LaserPose, outer: float) -> float:
    """Depth at which the sheet crosses the camera's axis; DesignError if it does not do so ahead of the window."""
    steep = abs(pose.normal[2]) > 1e-9  # otherwise the sheet is parallel to the axis, up to rounding
    depth = float(pose.normal @ pose.origin_mm / pose.normal[2]) if steep else math.inf
    # Beyond 100 m nothing is a design; a normal along the axis has no side view.
    if not outer < depth < 1e5 or math.hypot(*pose.normal[:2]) < 1e-9:
        raise DesignError(
            f"the sheet crosses the camera's axis {depth:.1f} mm from the entrance pupil; it must cross it aslant, in "
            f"front of the window's outer face at {outer:.1f} mm"
        )
    if pose.axis[2] <= 0:
        raise DesignError("the laser shines back towards the camera: turn its axis")
    return depth


def _reach(sensor: Sensor, p: SensorArrays, aside: float) -> tuple[np.ndarray, ...]:
    """N depths of the volume from the window, and from where to where (N,) camera and laser reach there, in mm from the
    laser's axis, NaN where they reach nothing; three depths to show, and the ends (3, 2) of the line there.

    ``aside`` is where Y = 0 lies, from the laser's axis.
    """
    places = np.linspace(-1, 1, _PLACES) * (1 - 1e-9)
    depths = np.linspace(sensor.volume.near_mm, sensor.volume.far_mm, _DEPTHS)
    with np.errstate(all="ignore"):
        f = field_of(np, p, depths.reshape(1, -1, 1), places.reshape(1, 1, -1), reflectance=0.5)
        near, far = depths_in_view(np, p)
        shown = near + (far - near) * np.array([0.0, 0.5, 1.0]).reshape(1, -1, 1)
        line = field_of(np, p, shown, places[[0, -1]].reshape(1, 1, -1), reflectance=0.5).y_mm[0] + aside
    y, inside = (np.broadcast_to(values, (1, _DEPTHS, _PLACES))[0] for values in (f.y_mm + aside, f.in_view))
    reached = inside.any(axis=1)
    low = np.where(reached, np.where(inside, y, np.inf).min(axis=1), np.nan)
    high = np.where(reached, np.where(inside, y, -np.inf).max(axis=1), np.nan)
    line = np.where((np.diff(line) > 0) & (far > near)[0], line, np.nan)
    return depths, low, high, shown.ravel(), line


# --- camera and laser -------------------------------------------------------------------------------------------------


@dataclass(frozen=True, eq=False)
class _Mounted:
    """A module: its origin and axis in the camera frame, and its window, as described and where one is mounted."""

    origin: np.ndarray
    axis: np.ndarray
    described: Window
    window: WindowGeometry | None

    @classmethod
    def of(cls, sensor: Sensor, window: Window, medium: Medium, origin: np.ndarray, rotation: np.ndarray) -> _Mounted:
        """A module whose frame, with z along its axis, ``rotation`` (3, 3) turns into the camera frame."""
        flat = WindowGeometry.of(window, medium, sensor.laser.wavelength_nm, rotation) if window.mounted else None
        return cls(origin, rotation[:, 2], window, flat)

    def rays(self, directions: np.ndarray, place: np.ndarray, normal: np.ndarray) -> np.ndarray:
        """Rays (N, K, 3) from the origin through the window on to a plane; NaN for a ray that does not get there."""
        points = np.broadcast_to(self.origin, directions.shape)[:, None]
        if self.window is not None:
            points, directions = traced(self.window, self.origin, directions)
        last = points[:, -1]
        with np.errstate(invalid="ignore", divide="ignore"):
            length = (place - last) @ normal / (directions @ normal)
            end = last + np.where(length > 0, length, np.nan)[:, None] * directions
        return np.concatenate([points, end[:, None]], axis=1)

    def seen_along(self, axes: np.ndarray, about: np.ndarray | float) -> Module:
        """The module in a picture spanned by ``axes`` (2, 3), with its origin at ``about``."""
        forward = axes @ self.axis / np.linalg.norm(axes @ self.axis)
        sideways = np.array([forward[1], -forward[0]])
        place = axes @ (self.origin - about)
        front, half, corners = _BARE_FRONT_MM, _BARE_HALF_MM, np.empty((0, 2))
        if self.window is not None:
            normal = np.array(self.window.normal)
            seen = axes @ normal
            half, front = self.described.aperture_diameter_mm / 2, self.described.distance_mm
            along = half * (np.array([seen[1], -seen[0]]) / np.linalg.norm(seen))
            inner = self.origin + front * self.axis
            inner, outer = (axes @ (face - about) for face in (inner, inner + self.window.thickness_mm * normal))
            corners = np.array([inner - along, inner + along, outer + along, outer - along])
        side, back = (half + _WALL_MM) * sideways, _HOUSING_MM * forward
        head = place + front * forward
        rear = place - back
        return Module(place, corners, np.array([rear - side, rear + side, head + side, head - side, rear - side]))


def _border_towards(camera: Camera, across: np.ndarray) -> np.ndarray:
    """Pixels (2, 2) where lines from the principal point along +-``across`` (2,) leave the image."""
    centre = np.array(camera.principal_point())
    least, most = np.array([-0.5, -0.5]), np.array([camera.width_px - 0.5, camera.height_px - 0.5])
    with np.errstate(divide="ignore", invalid="ignore"):
        ends = [np.where(d > 0, most - centre, least - centre) / d for d in (across, -across)]
    lengths = [float(np.min(end[np.abs(across) > 1e-12])) for end in ends]
    return np.stack([centre + lengths[0] * across, centre - lengths[1] * across])


# --- the drawing ------------------------------------------------------------------------------------------------------

_RED, _BLUE, _GLASS, _BEHIND, _THIN = "#c22f2f", "#3573b1", "#12a3a8", "#98a3af", "#b9c2cc"
_WIDTH, _HEIGHT, _PX_PER_INCH = 720.0, 700.0, 96.0
"""Most room in px for both views together, without labels: what the page's width and a screen's height leave."""
_LEFT, _BETWEEN, _RIGHT, _TOP, _BOTTOM = 108.0, 102.0, 150.0, 64.0, 44.0
"""Room in px for the dimensions and labels around the views."""
_FITS = 1.7
"""A design behind the chosen one is drawn if the picture need not grow more than this for it."""
_LETTER_PX = 6.7
"""Mean width of a letter."""


def draw(side: SideView, front: FrontView, other: tuple[SideView, FrontView] | None = None) -> tuple[Figure, bool]:
    """Draw a design's views beside each other at one scale, another design dashed behind them where it fits. The
    figure, and whether the other design is drawn."""
    for view, behind in zip((side, front), other or (), strict=False):
        if (_box(view, behind)[1] > _FITS * _box(view)[1].max()).any():
            other = None
    behind_side, behind_front = other or (None, None)
    low, size = _box(side, behind_side)
    front_low, front_size = _box(front, behind_front)
    tall = max(size[1], front_size[1])
    px = 1 / min(_WIDTH / (size[0] + front_size[0]), _HEIGHT / tall)
    width = size[0] + front_size[0] + (_LEFT + _BETWEEN + _RIGHT) * px
    height = tall + (_TOP + _BOTTOM) * px
    figure, (axes,) = new_figure(width / px / _PX_PER_INCH, height / px / _PX_PER_INCH)
    left, top = low - (_LEFT * px, _TOP * px)
    axes.set(xlim=(left, left + width), ylim=(top + height, top), aspect="equal")
    axes.axis("off")
    _draw_side(_Pen(axes, px, np.zeros(2)), side, behind_side, low, low + size)
    shift = np.array([low[0] + size[0] + _BETWEEN * px, low[1]]) - front_low
    _draw_front(_Pen(axes, px, shift), front, behind_front, right=float(front_low[0] + front_size[0]))
    return figure, other is not None


def _box(*views: SideView | FrontView | None) -> tuple[np.ndarray, np.ndarray]:
    """Least coordinates and size of all points of views."""
    points = np.concatenate([points for view in views if view is not None for points in view.outlines()])
    points = points[np.isfinite(points).all(axis=1)]
    return points.min(axis=0), np.maximum(np.ptp(points, axis=0), 1e-6)


@dataclass(frozen=True, eq=False)
class _Pen:
    """Draws on axes with points (2,) in mm moved by ``shift``; ``px`` is the size of a pixel in mm."""

    axes: Axes
    px: float
    shift: np.ndarray

    def line(self, points: ArrayLike, color: str, linewidth: float, style: str = "-") -> None:
        """A line through points (N, 2)."""
        self.axes.plot(*(np.asarray(points) + self.shift).T, style, color=color, linewidth=linewidth, markersize=4.5)

    def area(self, points: np.ndarray, color: str, alpha: float, edge: str = "none") -> None:
        """A filled outline (N, 2), nothing if a point is not finite."""
        if len(points) and np.isfinite(points).all():
            self.axes.fill(*(points + self.shift).T, facecolor=color, edgecolor=edge, alpha=alpha, linewidth=0.8)

    def text(self, at: ArrayLike, words: str, *, turned: float = 0.0, ha: str = "left", halo: bool = False) -> None:
        """Words beside or about a point."""
        x, y = np.asarray(at) + self.shift
        box = {"facecolor": "white", "edgecolor": "none", "alpha": 0.8, "pad": 0.8} if halo else None
        self.axes.text(x, y, words, rotation=turned, ha=ha, va="center", rotation_mode="anchor", bbox=box)

    def behind(self, view: SideView | FrontView | None) -> None:
        """Another design."""
        for line in view.outlines() if view else ():
            self.line(line, _BEHIND, 0.8, "--")

    def module(self, module: Module, name: str) -> None:
        """Housing, window, and name at the housing's back."""
        self.area(module.housing, "#e6eaef", 0.6, edge="#aab4c0")
        self.area(module.window, _GLASS, 0.4, edge=_GLASS)
        back = module.housing[:2].mean(axis=0)
        ahead = module.housing[2:4].mean(axis=0) - back
        place = back + 10 * self.px * ahead / max(np.hypot(*ahead), 1e-9)
        self.text(place, name, turned=90 - math.degrees(math.atan2(ahead[1], ahead[0])), ha="center")

    def dimension(self, a: tuple[float, float], b: tuple[float, float], words: str = "") -> None:
        """A dimension with its words along it, or beside its end where it is too short for them."""
        px, vertical = self.px, a[0] == b[0]
        self.line([a, b], INK, 0.8)
        for x, y in (a, b):
            self.line([(x - 4 * px, y + 4 * px), (x + 4 * px, y - 4 * px)], INK, 1.0)
        if math.dist(a, b) > (_LETTER_PX * len(words) + 6) * px:
            place = np.mean([a, b], axis=0) - ((9 * px, 0.0) if vertical else (0.0, 9 * px))
            self.text(place, words, turned=90.0 * vertical, ha="center", halo=vertical)
        else:
            place = (a[0] + 6 * px, (a[1] + b[1]) / 2) if vertical else (max(a[0], b[0]) + 8 * px, a[1])
            self.text(place, words, halo=vertical)


def _draw_side(pen: _Pen, view: SideView, other: SideView | None, low: np.ndarray, high: np.ndarray) -> None:
    """Draw the side view into the box from ``low`` to ``high``."""
    px, outer, cross = pen.px, view.outer_mm, float(view.crossing[1])
    near, far = view.volume[:, 1].tolist()
    left, right = low[0] - 4 * px, high[0] + 4 * px
    pen.area(np.array([(left, near), (right, near), (right, far), (left, far)]), "#f1ecd9", 1.0)
    pen.behind(other)
    pen.area(np.concatenate([view.edges[0], view.edges[1][::-1]]), _BLUE, 0.1)
    for depth, name in ((near, "near"), (far, "far")):
        pen.line([(left, depth), (right, depth)], "#bda96b", 0.8)
        pen.text((high[0] + 8 * px, depth), name)
    pen.module(view.camera, "camera")
    pen.module(view.laser, "laser")
    pen.line([(0, 0), (0, _BEYOND * far)], SOFT, 0.8, "-.")
    for edge in view.edges:
        pen.line(edge, _BLUE, 0.9)
    pen.line(view.sheet, _RED, 1.0)
    pen.line(view.volume, _RED, 1.8, ":")
    if view.in_view is not None:
        pen.line(view.in_view, _RED, 3.4)
    pen.line([(-view.pupil_mm / 2, 0), (view.pupil_mm / 2, 0)], INK, 2.6)
    pen.line([view.laser.origin, view.crossing], INK, 0.0, "o")
    # An arc between the camera's axis and the sheet, above their crossing.
    radius = min(74.0 * px, 0.6 * (cross - outer))
    towards = math.copysign(1.0, float(view.sheet[0, 0] - view.sheet[-1, 0]))

    def on_arc(angles: np.ndarray | float, r: float) -> np.ndarray:
        return view.crossing + r * np.stack([towards * np.sin(angles), -np.cos(angles)], axis=-1)

    pen.line(on_arc(np.linspace(0, view.angle_rad, 60), radius), INK, 0.8)
    words = f"{number_text(math.degrees(view.angle_rad), 3)}°"
    if 2 * math.sin(view.angle_rad / 2) * (radius - 16 * px) < 40 * px:
        pen.text(on_arc(view.angle_rad, radius + 8 * px), words, ha="left" if towards > 0 else "right", halo=True)
    else:
        pen.text(on_arc(view.angle_rad / 2, radius - 16 * px), words, ha="center", halo=True)

    chain, whole = low[0] - 26 * px, low[0] - 70 * px
    for depth in (outer, cross):
        pen.line([(whole, depth), (0, depth)], _THIN, 0.6)
    pen.dimension((chain, outer), (chain, near), f"near {number_text(near - outer)}")
    pen.dimension((chain, near), (chain, far), f"volume {number_text(far - near)}")
    pen.dimension((whole, outer), (whole, cross), f"stand-off {number_text(cross - outer)}")
    shown, top = float(view.laser.origin[0]), low[1] - 40 * px
    for x, y in ((0.0, 0.0), view.laser.origin):
        pen.line([(x, top), (x, y)], _THIN, 0.6)
    words = f"baseline {number_text(view.baseline_mm)} mm"
    if abs(view.baseline_mm - shown) > 1e-3 * view.baseline_mm:
        # The baseline does not run square to the sheet.
        words = f"{number_text(shown)} mm of the {words}"
    pen.dimension((0.0, top), (shown, top), words)
    # A bar of a round length of about a fifth of the picture.
    wanted = 0.2 * (high[0] - low[0])
    decade = 10.0 ** math.floor(math.log10(wanted))
    length = max(step * decade for step in (1, 2, 5) if step * decade <= wanted)
    bottom = pen.axes.get_ylim()[0] - 16 * px
    pen.dimension((low[0], bottom), (low[0] + length, bottom))
    pen.text((low[0] + length + 8 * px, bottom), f"{number_text(length)} mm")


def _draw_front(pen: _Pen, view: FrontView, other: FrontView | None, *, right: float) -> None:
    """Draw the front view, with its labels right of ``right``."""
    px = pen.px
    pen.behind(other)
    pen.area(np.concatenate([view.fan[0], view.fan[1][::-1]]), _RED, 0.06)
    pen.area(view.region, _RED, 0.18)
    pen.module(view.laser, "laser")
    for edge in view.fan:
        pen.line(edge, _RED, 0.9)
    end = max(edge[-1, 1] for edge in view.fan)
    for border in view.borders:
        pen.line(np.where((border[:, 1:] <= end) & (border[:, :1] <= right + 8 * px), border, np.nan), _BLUE, 0.9)
    pen.line([view.laser.origin], INK, 0.0, "o")
    for word, line in zip(("near", "middle", "far"), view.lines, strict=True):
        if np.isfinite(line).all():
            pen.line(line, _RED, 2.8)
            x, y = line.max(axis=0)
            pen.line([(x, y), (right + 8 * px, y)], _THIN, 0.6)
            pen.text((right + 12 * px, y), f"{word} {number_text(float(np.ptp(line[:, 0])))} mm")
