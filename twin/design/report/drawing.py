"""Drawing of a sensor to scale: rays, windows, sheet and measuring volume, from the side and onto the sheet.

The side view looks along the sheet, square to the camera's axis, so that the sheet is a line; the front view looks onto
the sheet. The measuring volume is that of the formulas.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from twin.design.figures import depths_in_view, field_of
from twin.design.geometry import FlatWindow, Lens, directions_of, traced
from twin.design.parameters import Parameters, parameters_of
from twin.design.report.tables import number_text
from uwlts.model.errors import DesignError
from uwlts.model.placement import LaserPose, laser_pose
from uwlts.model.sensor import Camera, Medium, Sensor, Window
from uwlts.report.page_toolkit import INK, SOFT, new_figure

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
    """Camera or laser from one side: its origin, its window's corners (4, 2) or None, and its housing's (4, 2), mm.

    Only origin and window are to scale: the description does not know the housing.
    """

    origin: np.ndarray
    window: np.ndarray | None
    housing: np.ndarray


@dataclass(frozen=True, eq=False)
class SideView:
    """A sensor in the plane of the camera's axis and the baseline; points are (baseline, depth) from the pupil, in mm.

    Attributes
    ----------
    camera, laser : Module
    pupil_mm, baseline_mm : float
        Diameter of the entrance pupil; distance of the fan's origin from the camera's axis, in any direction.
    edges : tuple of (K, 2)
        Rays of the image's edges: pupil, both faces of the window if there is one, and an end in the medium.
    sheet : (K, 2)
        The laser's axis, from the fan's origin on.
    volume : (2, 2)
        Where the sheet has the depths of the volume's near and far end.
    in_view : (2, 2) or None
        Ends of the part of ``volume`` that camera and laser reach.
    crossing : (2,)
        Where the sheet crosses the camera's axis.
    outer_mm, near_mm, far_mm : float
        Depths of the window's outer face and of the volume's ends, on the camera's axis.
    angle_rad : float
        Between sheet and camera's axis, in this view.
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
    near_mm: float
    far_mm: float
    angle_rad: float

    def points(self) -> np.ndarray:
        """All points (N, 2) that a picture must hold."""
        modules = [corners for module in (self.camera, self.laser) for corners in _corners(module)]
        return _finite([*modules, *self.edges, self.sheet, self.volume])


@dataclass(frozen=True, eq=False)
class FrontView:
    """The sheet face on; points are (along the stripe, along the laser's axis) from the fan's origin, in mm.

    Attributes
    ----------
    laser : Module
    fan : tuple of (K, 2)
        The fan's edges.
    borders : tuple of (N, 2)
        Where the four sides of the image lie in the sheet; NaN where they miss it.
    lines : (3, 2, 2)
        Ends of the line at near end, middle and far end of what the camera sees of the volume; NaN if it sees nothing.
    region : (N, 2)
        Outline of what camera and laser reach between near and far end; empty if nothing.
    """

    laser: Module
    fan: tuple[np.ndarray, ...]
    borders: tuple[np.ndarray, ...]
    lines: np.ndarray
    region: np.ndarray

    def points(self) -> np.ndarray:
        """All points (N, 2) that a picture must hold."""
        return _finite([*_corners(self.laser), *self.fan, self.lines.reshape(-1, 2), self.region])


def views_of(sensor: Sensor, medium: Medium) -> tuple[SideView, FrontView]:
    """Side and front view of a sensor in a medium.

    Raises
    ------
    DesignError
        The sheet does not cross the camera's axis in front of the window, or the laser shines back.
    DescriptionError, RangeError
        As `twin.design.parameters.numbers_of`.
    """
    pose, p = laser_pose(sensor), parameters_of([sensor], [medium])
    outer = float(p.outer_mm(np).item())
    _require_crossing(pose, outer)
    # Camera and laser are modules of one kind: a frame with z along the axis, and perhaps a window.
    along = np.cross(pose.axis, pose.normal)
    camera = _mounted(sensor, sensor.camera.window, medium, np.zeros(3), np.eye(3))
    laser = _mounted(
        sensor, sensor.laser.window, medium, pose.origin_mm, np.stack([pose.normal, along, pose.axis], axis=1)
    )
    far = _on_sheet(pose, np.array([outer + sensor.volume.far_mm]))[0]
    end = pose.origin_mm + _BEYOND * ((far - pose.origin_mm) @ pose.axis) * pose.axis
    middle, low, high = 0.0, p.lit_from_rad.item(), p.lit_to_rad.item()
    fan = np.stack([math.cos(a) * pose.axis + math.sin(a) * pose.fan for a in (middle, low, high)])
    sheet_rays = laser.rays(fan, end, pose.axis)
    reach = _reach(sensor, p, pose, outer)
    return (
        _side_view(sensor, pose, camera, laser, sheet_rays[0], reach),
        _front_view(sensor, pose, camera, laser, sheet_rays[1:], reach),
    )


def _require_crossing(pose: LaserPose, outer: float) -> None:
    crossing = pose.normal[2]
    depth = _crossing_mm(pose) if abs(crossing) > 1e-9 else math.inf
    if not outer < depth < 1e5 or math.hypot(*pose.normal[:2]) < 1e-9:
        raise DesignError(
            f"the sheet crosses the camera's axis {depth:.1f} mm from the entrance pupil; it must cross it aslant, in "
            f"front of the window's outer face at {outer:.1f} mm"
        )
    if pose.axis[2] <= 0:
        raise DesignError("the laser shines back towards the camera: turn its axis")


def _side_view(
    sensor: Sensor, pose: LaserPose, camera: _Mounted, laser: _Mounted, axis: np.ndarray, reach: _Reach
) -> SideView:
    axes = _side_axes(pose)
    near, far = reach.depths_mm[[0, -1]]
    edges = directions_of(_lens(sensor.camera), _border_towards(sensor.camera, axes[0, :2]))
    ahead = np.array([0.0, 0.0, 1.0])
    rays = camera.rays(edges, far * _BEYOND * ahead, ahead)
    seen = reach.depths_mm[np.isfinite(reach.low_mm)]
    return SideView(
        camera=camera.seen_along(axes, 0.0),
        laser=laser.seen_along(axes, 0.0),
        pupil_mm=sensor.camera.focal_length_mm / sensor.camera.f_number,
        baseline_mm=math.hypot(*pose.origin_mm[:2]),
        edges=tuple(rays @ axes.T),
        sheet=axis @ axes.T,
        volume=_on_sheet(pose, np.array([near, far])) @ axes.T,
        in_view=_on_sheet(pose, seen[[0, -1]]) @ axes.T if len(seen) else None,
        crossing=np.array([0.0, _crossing_mm(pose)]),
        outer_mm=float(near - sensor.volume.near_mm),
        near_mm=float(near),
        far_mm=float(far),
        angle_rad=math.atan2(abs(pose.normal[2]), math.hypot(*pose.normal[:2])),
    )


def _front_view(
    sensor: Sensor, pose: LaserPose, camera: _Mounted, laser: _Mounted, edges: np.ndarray, reach: _Reach
) -> FrontView:
    axes = np.stack([pose.fan, pose.axis])
    heights, shown = ((_on_sheet(pose, d) - pose.origin_mm) @ pose.axis for d in (reach.depths_mm, reach.shown_mm))
    reached = np.isfinite(reach.low_mm)
    low, high = (np.stack([y, heights], axis=1)[reached] for y in (reach.low_mm, reach.high_mm))
    return FrontView(
        laser=laser.seen_along(axes, pose.origin_mm),
        fan=tuple((edges - pose.origin_mm) @ axes.T),
        borders=tuple(
            (
                camera.rays(directions_of(_lens(sensor.camera), side), pose.origin_mm, pose.normal)[:, -1]
                - pose.origin_mm
            )
            @ axes.T
            for side in _image_sides(sensor.camera)
        ),
        lines=np.stack([reach.line_mm, np.repeat(shown[:, None], 2, axis=1)], axis=2),
        region=np.concatenate([low, high[::-1]]),
    )


# --- the sheet --------------------------------------------------------------------------------------------------------


def _side_axes(pose: LaserPose) -> np.ndarray:
    """Axes (2, 3) of the side view: the direction in the camera's x-y plane square to the sheet, and the depth.

    The view then runs along the sheet whatever the fan's roll; the laser is on the positive side.
    """
    across = pose.normal[:2] / math.hypot(*pose.normal[:2])
    if across @ pose.origin_mm[:2] < 0:
        across = -across
    return np.array([[across[0], across[1], 0.0], [0.0, 0.0, 1.0]])


def _crossing_mm(pose: LaserPose) -> float:
    """Depth at which the sheet crosses the camera's axis."""
    return float(pose.normal @ pose.origin_mm / pose.normal[2])


def _on_sheet(pose: LaserPose, depths: np.ndarray) -> np.ndarray:
    """Points (N, 3) at depths, on the line along the laser's axis through where the sheet crosses the camera's axis."""
    depth = _crossing_mm(pose)
    return np.array([0.0, 0.0, depth]) + ((depths - depth) / pose.axis[2])[:, None] * pose.axis


@dataclass(frozen=True, eq=False)
class _Reach:
    """Of N depths (from the pupil): from where to where (N,) camera and laser reach, from the laser's axis; NaN where
    they reach nothing. Of the three depths to show: ends (3, 2) of the line."""

    depths_mm: np.ndarray
    low_mm: np.ndarray
    high_mm: np.ndarray
    shown_mm: np.ndarray
    line_mm: np.ndarray


def _reach(sensor: Sensor, p: Parameters, pose: LaserPose, outer: float) -> _Reach:
    shares, places = np.linspace(0, 1, _DEPTHS), np.linspace(-1, 1, _PLACES) * (1 - 1e-9)
    depths = sensor.volume.near_mm + shares * (sensor.volume.far_mm - sensor.volume.near_mm)
    aside = (np.array([0.0, 0.0, _crossing_mm(pose)]) - pose.origin_mm) @ pose.fan
    with np.errstate(all="ignore"):
        f = field_of(np, p, depths.reshape(1, -1, 1), places.reshape(1, 1, -1), reflectance=0.5)
        near, far = depths_in_view(np, p)
        shown = near + (far - near) * np.array([0.0, 0.5, 1.0]).reshape(1, -1, 1)
        line = field_of(np, p, shown, places[[0, -1]].reshape(1, 1, -1), reflectance=0.5).y_mm[0] + aside
    y, inside = (np.broadcast_to(values, (1, _DEPTHS, _PLACES))[0] for values in (f.y_mm + aside, f.in_view))
    reached = inside.any(axis=1)
    return _Reach(
        depths_mm=outer + depths,
        low_mm=np.where(reached, np.where(inside, y, np.inf).min(axis=1), np.nan),
        high_mm=np.where(reached, np.where(inside, y, -np.inf).max(axis=1), np.nan),
        shown_mm=outer + shown.ravel(),
        line_mm=np.where((np.diff(line) > 0) & (far > near)[0], line, np.nan),
    )


# --- camera and laser -------------------------------------------------------------------------------------------------


@dataclass(frozen=True, eq=False)
class _Mounted:
    """A module: its origin and axis in the camera frame, and its window with the opening's diameter, None without."""

    origin: np.ndarray
    axis: np.ndarray
    window: FlatWindow | None
    aperture_mm: float
    distance_mm: float

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
        front, half, corners = _BARE_FRONT_MM, _BARE_HALF_MM, None
        if self.window is not None:
            normal = np.array(self.window.normal)
            seen = axes @ normal
            along = np.array([seen[1], -seen[0]]) / np.linalg.norm(seen)
            half, front = self.aperture_mm / 2, self.distance_mm
            inner = self.origin + self.distance_mm * self.axis
            inner, outer = (axes @ (face - about) for face in (inner, inner + self.window.thickness_mm * normal))
            corners = np.array([inner - half * along, inner + half * along, outer + half * along, outer - half * along])
        side, back = (half + _WALL_MM) * sideways, _HOUSING_MM * forward
        head = place + front * forward
        return Module(place, corners, np.array([place - back - side, place - back + side, head + side, head - side]))


def _mounted(sensor: Sensor, window: Window, medium: Medium, origin: np.ndarray, rotation: np.ndarray) -> _Mounted:
    flat, wavelength = None, sensor.laser.wavelength_nm
    if window.mounted:
        normal = rotation @ window.normal()
        flat = FlatWindow(
            (normal[0], normal[1], normal[2]),
            window.distance_mm * float(rotation[:, 2] @ normal),
            window.thickness_mm,
            window.index(wavelength),
            medium.refractive_index(wavelength),
        )
    return _Mounted(origin, rotation[:, 2], flat, window.aperture_diameter_mm, window.distance_mm)


def _lens(camera: Camera) -> Lens:
    d = camera.distortion
    return Lens(camera.focal_length_px(), *camera.principal_point(), d.k1, d.k2, d.k3, d.p1, d.p2)


def _image_sides(camera: Camera) -> list[np.ndarray]:
    """Pixels (N, 2) along the image's four sides."""
    width, height = camera.width_px - 0.5, camera.height_px - 0.5
    corners = np.array([(-0.5, -0.5), (width, -0.5), (width, height), (-0.5, height)])
    share = np.linspace(0, 1, _BORDER)[:, None]
    return [a + share * (b - a) for a, b in zip(corners, np.roll(corners, -1, axis=0), strict=True)]


def _border_towards(camera: Camera, across: np.ndarray) -> np.ndarray:
    """Pixels (2, 2) where lines from the principal point along +-``across`` (2,) leave the image."""
    centre = np.array(camera.principal_point())
    least, most = np.array([-0.5, -0.5]), np.array([camera.width_px - 0.5, camera.height_px - 0.5])
    with np.errstate(divide="ignore", invalid="ignore"):
        ends = [np.where(d > 0, most - centre, least - centre) / d for d in (across, -across)]
    lengths = [float(np.min(end[np.abs(across) > 1e-12])) for end in ends]
    return np.stack([centre + lengths[0] * across, centre - lengths[1] * across])


def _corners(module: Module) -> list[np.ndarray]:
    return [module.origin[None], module.housing] + ([] if module.window is None else [module.window])


def _finite(parts: list[np.ndarray]) -> np.ndarray:
    points = np.concatenate(parts)
    return points[np.isfinite(points).all(axis=1)]


# --- the drawing ------------------------------------------------------------------------------------------------------

_RED, _BLUE, _GLASS, _BEHIND, _THIN = "#c22f2f", "#3573b1", "#12a3a8", "#98a3af", "#b9c2cc"
_WIDTH, _HEIGHT = 1080.0, 700.0
"""Most room in px for both views together, without the dimensions around them."""
_PX_PER_INCH = 96.0
_SIDE_MARGINS, _FRONT_MARGINS = (108.0, 72.0), (30.0, 150.0)
"""Room in px left and right of the views."""
_TOP, _BOTTOM = 64.0, 44.0
_FITS = 1.7
"""A design behind the chosen one is drawn if the picture need not grow more than this for it."""


@dataclass(frozen=True, eq=False)
class Drawing:
    """Side and front view in one figure, and whether the other design is drawn behind."""

    figure: Figure
    with_other: bool


def draw(side: SideView, front: FrontView, other: tuple[SideView, FrontView] | None = None) -> Drawing:
    """Draw a design's views at one scale, another design dashed behind them where it fits."""
    behind = other if other is not None and _fits(side, other[0]) and _fits(front, other[1]) else None
    sides, fronts = ([side], [front]) if behind is None else ([side, behind[0]], [front, behind[1]])
    boxes = [_box(np.concatenate([view.points() for view in views])) for views in (sides, fronts)]
    (_, size), (_, front_size) = boxes
    margins = sum(_SIDE_MARGINS) + sum(_FRONT_MARGINS)
    tall = max(size[1], front_size[1])
    scale = min((_WIDTH - margins) / (size[0] + front_size[0]), _HEIGHT / tall)
    width, height = margins + scale * (size[0] + front_size[0]), _TOP + scale * tall + _BOTTOM
    figure, views = new_figure(width / _PX_PER_INCH, height / _PX_PER_INCH, columns=2)
    figure.set_layout_engine("none")
    start = 0.0
    for axes, (low, extent), (left, right) in zip(views, boxes, (_SIDE_MARGINS, _FRONT_MARGINS), strict=True):
        room = left + scale * extent[0] + right
        axes.set_position((start / width, 0.0, room / width, 1.0))
        axes.set_xlim(low[0] - left / scale, low[0] + (room - left) / scale)
        axes.set_ylim(low[1] + (height - _TOP) / scale, low[1] - _TOP / scale)
        axes.axis("off")
        start += room
    px = 1 / scale
    _draw_side(views[0], side, None if behind is None else behind[0], low=boxes[0][0], high=np.add(*boxes[0]), px=px)
    _draw_front(views[1], front, None if behind is None else behind[1], right=float(np.add(*boxes[1])[0]), px=px)
    return Drawing(figure, behind is not None)


def _box(points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    low, high = points.min(axis=0), points.max(axis=0)
    return low, np.maximum(high - low, 1e-6)


def _fits(view: SideView | FrontView, other: SideView | FrontView) -> bool:
    own, both = _box(view.points())[1], _box(np.concatenate([view.points(), other.points()]))[1]
    return bool((both <= _FITS * own.max()).all())


def _draw_side(
    axes: Axes, view: SideView, other: SideView | None, *, low: np.ndarray, high: np.ndarray, px: float
) -> None:
    """Draw the side view into the box from ``low`` to ``high``; ``px`` is the size of a pixel in mm."""
    band = [low[0] - 4 * px, high[0] + 4 * px]
    axes.fill_between(band, view.near_mm, view.far_mm, color="#f1ecd9", linewidth=0)
    if other is not None:
        _draw_behind(axes, [*other.edges, other.sheet, _closed(other.camera), _closed(other.laser), other.volume])
    cone = np.concatenate([view.edges[0], view.edges[1][::-1]])
    if np.isfinite(cone).all():
        axes.fill(*cone.T, color=_BLUE, alpha=0.1, linewidth=0)
    for depth, name in ((view.near_mm, "near"), (view.far_mm, "far")):
        axes.plot(band, [depth, depth], color="#bda96b", linewidth=0.8)
        axes.text(high[0] + 8 * px, depth, name, va="center")
    _draw_module(axes, view.camera, "camera", px)
    _draw_module(axes, view.laser, "laser", px)
    axes.plot([0, 0], [0, _BEYOND * view.far_mm], color=SOFT, linewidth=0.8, linestyle="-.")
    for edge in view.edges:
        axes.plot(*edge.T, color=_BLUE, linewidth=0.9)
    axes.plot(*view.sheet.T, color=_RED, linewidth=1.0)
    axes.plot(*view.volume.T, color=_RED, linewidth=1.8, linestyle=":")
    if view.in_view is not None:
        axes.plot(*view.in_view.T, color=_RED, linewidth=3.4)
    axes.plot([-view.pupil_mm / 2, view.pupil_mm / 2], [0, 0], color=INK, linewidth=2.6)
    axes.plot(*np.stack([view.laser.origin, view.crossing]).T, "o", color=INK, markersize=4.5)
    _draw_angle(axes, view, px)
    outer = view.outer_mm
    chain, whole = low[0] - 26 * px, low[0] - 70 * px
    for depth in (outer, view.crossing[1]):
        axes.plot([whole, 0], [depth, depth], color=_THIN, linewidth=0.6)
    _dimension(axes, (chain, outer), (chain, view.near_mm), f"near {number_text(view.near_mm - outer)}", px)
    depth = number_text(view.far_mm - view.near_mm)
    _dimension(axes, (chain, view.near_mm), (chain, view.far_mm), f"volume {depth}", px)
    standoff = number_text(view.crossing[1] - outer)
    _dimension(axes, (whole, outer), (whole, view.crossing[1]), f"stand-off {standoff}", px)
    shown, top = float(view.laser.origin[0]), low[1] - 40 * px
    for x, y in ((0.0, 0.0), view.laser.origin):
        axes.plot([x, x], [top, y], color=_THIN, linewidth=0.6)
    words = f"baseline {number_text(view.baseline_mm)} mm"
    if abs(view.baseline_mm - shown) > 1e-3 * view.baseline_mm:
        # The baseline does not run square to the sheet.
        words = f"{number_text(shown)} mm of the {words}"
    _dimension(axes, (0.0, top), (shown, top), words, px)
    # A bar of a round length of about a fifth of the picture.
    wanted = 0.2 * (high[0] - low[0])
    decade = 10.0 ** math.floor(math.log10(wanted))
    length = max(step * decade for step in (1, 2, 5) if step * decade <= wanted)
    bottom = axes.get_ylim()[0] - 16 * px
    _dimension(axes, (low[0], bottom), (low[0] + length, bottom), "", px)
    axes.text(low[0] + length + 8 * px, bottom, f"{number_text(length)} mm", va="center")


def _draw_front(axes: Axes, view: FrontView, other: FrontView | None, *, right: float, px: float) -> None:
    if other is not None:
        _draw_behind(axes, [*other.fan, *other.lines, _closed(other.laser)])
    fan = np.concatenate([view.fan[0], view.fan[1][::-1]])
    if np.isfinite(fan).all():
        axes.fill(*fan.T, color=_RED, alpha=0.06, linewidth=0)
    if len(view.region):
        axes.fill(*view.region.T, color=_RED, alpha=0.18, linewidth=0)
    _draw_module(axes, view.laser, "laser", px)
    for edge in view.fan:
        axes.plot(*edge.T, color=_RED, linewidth=0.9)
    end = max(edge[-1, 1] for edge in view.fan)
    for border in view.borders:
        shown = np.where((border[:, 1:] <= end) & (border[:, :1] <= right + 8 * px), border, np.nan)
        axes.plot(*shown.T, color=_BLUE, linewidth=0.9)
    axes.plot(*view.laser.origin, "o", color=INK, markersize=4.5)
    for word, line in zip(("near", "middle", "far"), view.lines, strict=True):
        if not np.isfinite(line).all():
            continue
        axes.plot(*line.T, color=_RED, linewidth=2.8)
        x, y = line.max(axis=0)
        axes.plot([x, right + 8 * px], [y, y], color=_THIN, linewidth=0.6)
        axes.text(right + 12 * px, y, f"{word} {number_text(float(np.ptp(line[:, 0])))} mm", va="center")


def _draw_behind(axes: Axes, lines: list[np.ndarray]) -> None:
    for line in lines:
        axes.plot(*line.T, color=_BEHIND, linewidth=0.8, linestyle="--")


def _closed(module: Module) -> np.ndarray:
    return np.vstack([module.housing, module.housing[:1]])


def _draw_module(axes: Axes, module: Module, name: str, px: float) -> None:
    """Housing, window and name, which stands at the housing's back."""
    axes.fill(*module.housing.T, facecolor="#e6eaef", edgecolor="#aab4c0", alpha=0.6, linewidth=0.8)
    if module.window is not None:
        axes.fill(*module.window.T, facecolor=_GLASS, edgecolor=_GLASS, alpha=0.4, linewidth=0.8)
    back = module.housing[:2].mean(axis=0)
    ahead = module.housing[2:].mean(axis=0) - back
    x, y = back + 10 * px * ahead / max(np.hypot(*ahead), 1e-9)
    turned = 90 - math.degrees(math.atan2(ahead[1], ahead[0]))
    axes.text(x, y, name, rotation=turned, ha="center", va="center", rotation_mode="anchor")


def _draw_angle(axes: Axes, view: SideView, px: float) -> None:
    """An arc between the camera's axis and the sheet, above their crossing."""
    radius = min(74.0 * px, 0.6 * float(view.crossing[1] - view.outer_mm))
    towards = math.copysign(1.0, float(view.sheet[0, 0] - view.sheet[-1, 0]))

    def at(angles: np.ndarray | float, r: float) -> np.ndarray:
        return view.crossing + r * np.stack([towards * np.sin(angles), -np.cos(angles)], axis=-1)

    axes.plot(*at(np.linspace(0, view.angle_rad, 60), radius).T, color=INK, linewidth=0.8)
    narrow = 2 * math.sin(view.angle_rad / 2) * (radius - 16 * px) < 40 * px
    x, y = at(view.angle_rad, radius + 8 * px) if narrow else at(view.angle_rad / 2, radius - 16 * px)
    side = ("left" if towards > 0 else "right") if narrow else "center"
    axes.text(x, y, f"{number_text(math.degrees(view.angle_rad), 3)}°", ha=side, va="center", bbox=_HALO)


_HALO = {"facecolor": "white", "edgecolor": "none", "alpha": 0.8, "pad": 0.8}


def _dimension(axes: Axes, a: tuple[float, float], b: tuple[float, float], words: str, px: float) -> None:
    """A dimension with its words along it, or beside its end where it is too short for them."""
    axes.plot(*np.stack([a, b]).T, color=INK, linewidth=0.8)
    for x, y in (a, b):
        axes.plot([x - 4 * px, x + 4 * px], [y + 4 * px, y - 4 * px], color=INK, linewidth=1.0)
    vertical = a[0] == b[0]
    fits = math.dist(a, b) > (_LETTER_PX * len(words) + 6) * px
    (x, y), turned = np.mean([a, b], axis=0), 90.0 if vertical and fits else 0.0
    if fits:
        x, y = (x - 9 * px, y) if vertical else (x, y - 9 * px)
    else:
        x, y = (x + 6 * px, y) if vertical else (max(a[0], b[0]) + 8 * px, y)
    axes.text(
        x, y, words, rotation=turned, ha="center" if fits else "left", va="center", bbox=_HALO if vertical else None
    )


_LETTER_PX = 6.7
"""Mean width of a letter."""
