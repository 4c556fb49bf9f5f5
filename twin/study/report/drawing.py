"""Drawing of a sensor to scale: rays, windows, sheet and measuring volume, from the side and onto the sheet.

The side view looks along the sheet, square to the camera's axis, so that the sheet is a line; the front view looks onto
the sheet. The measuring volume is that of the formulas.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from markupsafe import Markup, escape

from twin.study.figures import depths_in_view, field_of
from twin.study.geometry import Face, border_towards, borders_on_sheet, directions, faces, frame, to_plane, traced
from twin.study.parameters import Parameters, parameters_of
from twin.study.report.tables import number_text
from uwlts.errors import DesignError
from uwlts.placement import LaserPose, laser_pose
from uwlts.sensor import Medium, Sensor, Window

_BEYOND = 1.06
"""Rays and sheet are drawn so much farther than the volume's far end."""
_DEPTHS, _PLACES = 201, 21
_HOUSING_MM, _WALL_MM = 42.0, 5.0


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
        As `twin.study.parameters.numbers_of`.
    """
    pose, p = laser_pose(sensor), parameters_of([sensor], [medium])
    outer = float(p.outer_mm(np).item())
    _require_crossing(pose, outer)
    rotation = frame(pose.axis, pose.normal)
    camera_faces = faces(sensor, sensor.camera.window, medium, np.zeros(3), np.eye(3))
    laser_faces = faces(sensor, sensor.laser.window, medium, pose.origin_mm, rotation)
    far = _on_sheet(pose, np.array([outer + sensor.volume.far_mm]))[0]
    end = pose.origin_mm + _BEYOND * ((far - pose.origin_mm) @ pose.axis) * pose.axis
    middle, low, high = 0.0, p.lit_from_rad.item(), p.lit_to_rad.item()
    fan = np.stack([math.cos(a) * pose.axis + math.sin(a) * pose.fan for a in (middle, low, high)])
    sheet_rays = to_plane(*traced(pose.origin_mm, fan, laser_faces), end, pose.axis)
    reach = _reach(sensor, p, pose, outer)
    return (
        _side_view(sensor, pose, camera_faces, laser_faces, sheet_rays[0], reach),
        _front_view(sensor, pose, camera_faces, laser_faces, sheet_rays[1:], reach),
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
    sensor: Sensor, pose: LaserPose, camera_faces: list[Face], laser_faces: list[Face], axis: np.ndarray, reach: _Reach
) -> SideView:
    camera, axes = sensor.camera, _side_axes(pose)
    near, far = reach.depths_mm[[0, -1]]
    edges = directions(camera, border_towards(camera, axes[0, :2]))
    ahead = np.array([0.0, 0.0, 1.0])
    rays = to_plane(*traced(np.zeros(3), edges, camera_faces), far * _BEYOND * ahead, ahead)
    seen = reach.depths_mm[np.isfinite(reach.low_mm)]
    return SideView(
        camera=_module_of(camera.window, camera_faces, np.zeros(3), ahead, axes),
        laser=_module_of(sensor.laser.window, laser_faces, pose.origin_mm, pose.axis, axes),
        pupil_mm=camera.focal_length_mm / camera.f_number, baseline_mm=math.hypot(*pose.origin_mm[:2]),
        edges=tuple(rays @ axes.T), sheet=axis @ axes.T, volume=_on_sheet(pose, np.array([near, far])) @ axes.T,
        in_view=_on_sheet(pose, seen[[0, -1]]) @ axes.T if len(seen) else None,
        crossing=np.array([0.0, _crossing_mm(pose)]), outer_mm=float(near - sensor.volume.near_mm),
        near_mm=float(near), far_mm=float(far),
        angle_rad=math.atan2(abs(pose.normal[2]), math.hypot(*pose.normal[:2])),
    )  # fmt: skip


def _front_view(
    sensor: Sensor, pose: LaserPose, camera_faces: list[Face], laser_faces: list[Face], edges: np.ndarray, reach: _Reach
) -> FrontView:
    axes = np.stack([pose.fan, pose.axis])
    heights, shown = ((_on_sheet(pose, d) - pose.origin_mm) @ pose.axis for d in (reach.depths_mm, reach.shown_mm))
    reached = np.isfinite(reach.low_mm)
    low, high = (np.stack([y, heights], axis=1)[reached] for y in (reach.low_mm, reach.high_mm))
    return FrontView(
        laser=_module_of(sensor.laser.window, laser_faces, pose.origin_mm, pose.axis, axes, about=pose.origin_mm),
        fan=tuple((edges - pose.origin_mm) @ axes.T),
        borders=tuple(
            (points - pose.origin_mm) @ axes.T for points in borders_on_sheet(sensor.camera, camera_faces, pose)
        ),
        lines=np.stack([reach.line_mm, np.repeat(shown[:, None], 2, axis=1)], axis=2),
        region=np.concatenate([low, high[::-1]]),
    )  # fmt: skip


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


# --- windows and housings ---------------------------------------------------------------------------------------------


def _module_of(
    window: Window,
    faces: list[Face],
    origin: np.ndarray,
    axis: np.ndarray,
    axes: np.ndarray,
    about: np.ndarray | float = 0.0,
) -> Module:
    """A module as seen along a direction; ``axes`` (2, 3) span the picture, whose origin is at ``about``."""
    forward = axes @ axis / np.linalg.norm(axes @ axis)
    sideways = np.array([forward[1], -forward[0]])
    place = axes @ (origin - about)
    front, half, corners = 12.0, 15.0, None
    if faces:
        normal = axes @ faces[0][1]
        along = np.array([normal[1], -normal[0]]) / np.linalg.norm(normal)
        half, front = window.aperture_diameter_mm / 2, window.distance_mm
        inner, outer = (axes @ (face[0] - about) for face in faces)
        corners = np.array([inner - half * along, inner + half * along, outer + half * along, outer - half * along])
    side, back = (half + _WALL_MM) * sideways, _HOUSING_MM * forward
    head = place + front * forward
    return Module(place, corners, np.array([place - back - side, place - back + side, head + side, head - side]))


def _corners(module: Module) -> list[np.ndarray]:
    return [module.origin[None], module.housing] + ([] if module.window is None else [module.window])


def _finite(parts: list[np.ndarray]) -> np.ndarray:
    points = np.concatenate(parts)
    return points[np.isfinite(points).all(axis=1)]


_INK, _SOFT, _RED, _BLUE, _GLASS = "#2b3440", "#5c6875", "#c22f2f", "#3573b1", "#12a3a8"
_WIDTH, _HEIGHT = 1080.0, 700.0
"""Most room in px for both drawings together, without the dimensions around them."""
_LETTER = 6.7
_LEFT, _TOP, _RIGHT, _BOTTOM = 108.0, 64.0, 62.0, 40.0
_FRONT_LEFT, _FRONT_RIGHT = 20.0, 150.0
_FITS = 1.7
"""A design behind the chosen one is drawn if the picture need not grow more than this for it."""


@dataclass(frozen=True)
class Drawing:
    """Two SVG elements, and whether the other design is drawn behind."""

    side: Markup
    front: Markup
    with_other: bool


def draw(side: SideView, front: FrontView, other: tuple[SideView, FrontView] | None = None) -> Drawing:
    """Draw a design's views, another design dashed behind them where it fits."""
    with_other = other is not None and _fits(side, other[0]) and _fits(front, other[1])
    sides = [side, other[0]] if with_other else [side]
    fronts = [front, other[1]] if with_other else [front]
    low, size = _box(np.concatenate([view.points() for view in sides]))
    front_low, front_size = _box(np.concatenate([view.points() for view in fronts]))
    room = _WIDTH - _LEFT - _RIGHT - _FRONT_LEFT - _FRONT_RIGHT
    scale = min(room / (size[0] + front_size[0]), _HEIGHT / max(size[1], front_size[1]))
    height = _TOP + scale * max(size[1], front_size[1]) + _BOTTOM
    sheets = [
        _Sheet(low, scale, (_LEFT, _TOP), _LEFT + scale * size[0] + _RIGHT, height),
        _Sheet(front_low, scale, (_FRONT_LEFT, _TOP), _FRONT_LEFT + scale * front_size[0] + _FRONT_RIGHT, height),
    ]
    return Drawing(
        side=_drawn_side(sheets[0], side, other[0] if with_other else None),
        front=_drawn_front(sheets[1], front, other[1] if with_other else None),
        with_other=with_other,
    )


def _box(points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    low, high = points.min(axis=0), points.max(axis=0)
    return low, np.maximum(high - low, 1e-6)


def _fits(view: SideView | FrontView, other: SideView | FrontView) -> bool:
    own, both = _box(view.points())[1], _box(np.concatenate([view.points(), other.points()]))[1]
    return bool((both <= _FITS * own.max()).all())


@dataclass(frozen=True, eq=False)
class _Sheet:
    """Paper of a view: what is left and on top in mm, px per mm, where that is in px, and the paper's size in px."""

    low: np.ndarray
    scale: float
    start: tuple[float, float]
    width: float
    height: float

    def at(self, points: np.ndarray) -> np.ndarray:
        """Points in mm as px."""
        return self.start + self.scale * (np.asarray(points) - self.low)

    def line(self, points: np.ndarray, colour: str, width: float, *, dash: str = "", fill: str = "none") -> str:
        """A polyline in as many pieces as NaN leave, closed where it is filled."""
        places = self.at(points)
        known = np.isfinite(places).all(axis=1)
        pieces = np.split(places, np.flatnonzero(np.diff(known.astype(int))) + 1)
        path = " ".join(
            "M" + " L".join(f"{x:.1f} {y:.1f}" for x, y in piece) + ("" if fill == "none" else " Z")
            for piece in pieces
            if len(piece) and np.isfinite(piece).all()
        )
        dashed = f' stroke-dasharray="{dash}"' if dash else ""
        return f'<path d="{path}" fill="{fill}" stroke="{colour}" stroke-width="{width}"{dashed}/>' if path else ""

    def page(self, parts: Sequence[str], title: str) -> Markup:
        """The SVG element."""
        size = f"{self.width:.0f} {self.height:.0f}"
        head = f'viewBox="0 0 {size}" width="{self.width:.0f}" height="{self.height:.0f}" role="img" font-size="12.5"'
        body = "\n".join(part for part in parts if part)
        return Markup(f'<svg {head} fill="{_INK}"><title>{escape(title)}</title>\n{body}</svg>')


# --- the side view ----------------------------------------------------------------------------------------------------


def _drawn_side(sheet: _Sheet, view: SideView, other: SideView | None) -> Markup:
    left, right = _LEFT - 4, sheet.width - _RIGHT + 4
    near, far = (sheet.at((0, depth))[1] for depth in (view.near_mm, view.far_mm))
    cone = np.concatenate([view.edges[0], view.edges[1][::-1]])
    parts = [_box_of(left, near, right, far, "#f1ecd9")]
    if other is not None:
        parts += _other_side(sheet, other)
    parts += [sheet.line(cone, "none", 0, fill="#3573b118")] if np.isfinite(cone).all() else []
    parts += [_straight((left, y), (right, y), "#bda96b", 1) for y in (near, far)]
    parts += [_text(word, right + 4, y + 4, anchor="start") for word, y in (("near", near), ("far", far))]
    parts += [
        *_module(sheet, view.camera, "camera"), *_module(sheet, view.laser, "laser"),
        sheet.line(np.array([(0.0, 0.0), (0.0, 1.06 * view.far_mm)]), _SOFT, 1, dash="10 3 2 3"),
        *(sheet.line(edge, _BLUE, 1.2) for edge in view.edges),
        sheet.line(view.sheet, _RED, 1.3),
        sheet.line(view.volume, _RED, 2.2, dash="3 3"),
        sheet.line(view.in_view, _RED, 4.5) if view.in_view is not None else "",
        sheet.line(np.array([(-0.5, 0.0), (0.5, 0.0)]) * view.pupil_mm, _INK, 3.5),
        *_dots(sheet, [view.laser.origin, view.crossing]),
    ]  # fmt: skip
    parts += _angle(sheet, view)
    parts += _depths(sheet, view)
    parts += _baseline(sheet, view)
    parts += _scale_bar(sheet)
    return sheet.page(parts, f"Side view, baseline {number_text(view.baseline_mm)} mm")


def _other_side(sheet: _Sheet, view: SideView) -> list[str]:
    outlines = [np.vstack([m.housing, m.housing[:1]]) for m in (view.camera, view.laser)]
    lines = [*view.edges, view.sheet, *outlines]
    return [sheet.line(line, "#98a3af", 1, dash="5 4") for line in lines] + [
        sheet.line(view.volume, "#98a3af", 2.4, dash="5 4")
    ]


def _module(sheet: _Sheet, module: Module, name: str) -> list[str]:
    """Housing, window and name, which stands at the housing's back."""
    parts = [sheet.line(module.housing, "#aab4c0", 1, fill="#e6eaef88")]
    if module.window is not None:
        parts.append(sheet.line(module.window, _GLASS, 1, fill="#12a3a855"))
    back = sheet.at(module.housing[:2].mean(axis=0))
    ahead = sheet.at(module.housing[2:].mean(axis=0)) - back
    place = back + 15 * ahead / max(np.hypot(*ahead), 1e-9)
    turned = math.degrees(math.atan2(ahead[1], ahead[0])) - 90
    return [*parts, _text(name, *place, turned=turned)]


def _angle(sheet: _Sheet, view: SideView) -> list[str]:
    """An arc between the camera's axis and the sheet, above their crossing."""
    at, angle = sheet.at(view.crossing), view.angle_rad
    radius = min(74.0, 0.6 * float(at[1] - sheet.at((0, view.outer_mm))[1]))
    towards = math.copysign(1.0, float(view.sheet[0, 0] - view.sheet[-1, 0]))
    end = at + radius * np.array([towards * math.sin(angle), -math.cos(angle)])
    start = at - (0, radius)
    place, anchor = at + (radius - 16) * np.array([towards * math.sin(angle / 2), -math.cos(angle / 2)]), "middle"
    if 2 * math.sin(angle / 2) * (radius - 16) < 40:
        place, anchor = end + (towards * 8, 0.0), "start" if towards > 0 else "end"
    sweep = 1 if towards > 0 else 0
    arc = f"M{start[0]:.1f} {start[1]:.1f} A{radius:.1f} {radius:.1f} 0 0 {sweep} {end[0]:.1f} {end[1]:.1f}"
    return [
        f'<path d="{arc}" fill="none" stroke="{_INK}" stroke-width="1"/>',
        _text(f"{number_text(math.degrees(angle), 3)}°", place[0], place[1] + 4, anchor=anchor, halo=True),
    ]


def _depths(sheet: _Sheet, view: SideView) -> list[str]:
    """Dimensions on the left: the volume's near end and depth in a chain, and the stand-off."""
    levels = {
        name: float(sheet.at((0, depth))[1])
        for name, depth in (("outer", view.outer_mm), ("near", view.near_mm), ("far", view.far_mm),
                            ("crossing", view.crossing[1]))
    }  # fmt: skip
    standoff = view.crossing[1] - view.outer_mm
    inner, outer = _LEFT - 22, _LEFT - 66
    edge = sheet.at((0, 0))[0]
    parts = [
        _straight((outer - 4, levels["outer"]), (edge, levels["outer"]), "#b9c2cc", 0.8),
        _straight((outer - 4, levels["crossing"]), (edge, levels["crossing"]), "#b9c2cc", 0.8),
    ]
    parts += _vertical(inner, levels["outer"], levels["near"], f"near {number_text(view.near_mm - view.outer_mm)}")
    parts += _vertical(inner, levels["near"], levels["far"], f"volume {number_text(view.far_mm - view.near_mm)}")
    parts += _vertical(outer, levels["outer"], levels["crossing"], f"stand-off {number_text(standoff)}")
    return parts


def _vertical(x: float, top: float, bottom: float, words: str) -> list[str]:
    """A vertical dimension; its words stand along it, beside its end where it is too short."""
    parts = [_straight((x, top), (x, bottom), _INK, 1), *_ticks(x, top), *_ticks(x, bottom)]
    middle, length = (top + bottom) / 2, abs(bottom - top)
    if length > _LETTER * len(words) + 6:
        return [*parts, _text(words, x - 6, middle, turned=-90, halo=True)]
    return [*parts, _text(words, x + 6, middle + 4, anchor="start", halo=True)]


def _baseline(sheet: _Sheet, view: SideView) -> list[str]:
    """The baseline, and what is seen of it where it does not run square to the sheet."""
    y, shown = 22.0, float(view.laser.origin[0])
    ends = [sheet.at((0.0, 0.0)), sheet.at(view.laser.origin)]
    parts = [_straight((end[0], y - 4), (end[0], end[1]), "#b9c2cc", 0.8) for end in ends]
    parts += [_straight((ends[0][0], y), (ends[1][0], y), _INK, 1)]
    parts += [mark for end in ends for mark in _ticks(end[0], y)]
    words = f"baseline {number_text(view.baseline_mm)} mm"
    if abs(view.baseline_mm - shown) > 1e-3 * view.baseline_mm:
        words = f"{number_text(shown)} mm of the {words}"
    if abs(ends[1][0] - ends[0][0]) > _LETTER * len(words):
        return [*parts, _text(words, (ends[0][0] + ends[1][0]) / 2, y - 6)]
    return [*parts, _text(words, max(ends[0][0], ends[1][0]) + 8, y + 4, anchor="start")]


def _scale_bar(sheet: _Sheet) -> list[str]:
    """A bar of a round length of about a fifth of the picture."""
    wanted = 0.2 * (sheet.width - _LEFT) / sheet.scale
    decade = 10.0 ** math.floor(math.log10(wanted))
    length = max(step * decade for step in (1, 2, 5) if step * decade <= wanted)
    x, y = _LEFT, sheet.height - 16
    end = x + sheet.scale * length
    marks = [*_ticks(x, y), *_ticks(end, y)]
    words = _text(f"{number_text(length)} mm", end + 8, y + 4, anchor="start")
    return [_straight((x, y), (end, y), _INK, 1.6), *marks, words]


# --- the front view ---------------------------------------------------------------------------------------------------


def _drawn_front(sheet: _Sheet, view: FrontView, other: FrontView | None) -> Markup:
    room = f'width="{sheet.width - _FRONT_RIGHT + 8:.0f}" height="{sheet.height:.0f}"'
    clip = f'<clipPath id="front-view"><rect {room}/></clipPath>'
    end = max(edge[-1, 1] for edge in view.fan)
    borders = [np.where(border[:, 1:] <= end, border, np.nan) for border in view.borders]
    fan = np.concatenate([view.fan[0], view.fan[1][::-1]])
    parts = [clip]
    if other is not None:
        outline = np.vstack([other.laser.housing, other.laser.housing[:1]])
        lines = [*other.fan, *other.lines, outline]
        parts += [sheet.line(line, "#98a3af", 1, dash="5 4") for line in lines]
    parts += [sheet.line(fan, "none", 0, fill="#c22f2f10")] if np.isfinite(fan).all() else []
    parts += [sheet.line(view.region, "none", 0, fill="#c22f2f2e")] if len(view.region) else []
    parts += _module(sheet, view.laser, "laser")
    parts += [sheet.line(edge, _RED, 1.1) for edge in view.fan]
    parts += ['<g clip-path="url(#front-view)">', *(sheet.line(border, _BLUE, 1.2) for border in borders), "</g>"]
    parts += _dots(sheet, [view.laser.origin])
    right = sheet.width - _FRONT_RIGHT
    for word, line in zip(("near", "middle", "far"), view.lines, strict=True):
        if not np.isfinite(line).all():
            continue
        parts.append(sheet.line(line, _RED, 3.5))
        end, length = sheet.at(line).max(axis=0), float(np.ptp(line[:, 0]))
        parts.append(_straight((end[0] + 4, end[1]), (right + 8, end[1]), "#b9c2cc", 0.8))
        parts.append(_text(f"{word} {number_text(length)} mm", right + 12, end[1] + 4, anchor="start"))
    return sheet.page(parts, "Front view, onto the sheet")


# --- SVG --------------------------------------------------------------------------------------------------------------


def _dots(sheet: _Sheet, points: Sequence[np.ndarray]) -> list[str]:
    places = [sheet.at(point) for point in points]
    return [f'<circle cx="{x:.1f}" cy="{y:.1f}" r="3.4" fill="{_INK}"/>' for x, y in places]


def _ticks(x: float, y: float) -> list[str]:
    """The oblique stroke that ends a dimension."""
    return [_straight((x - 4, y + 4), (x + 4, y - 4), _INK, 1.3)]


def _straight(a: tuple[float, float], b: tuple[float, float], colour: str, width: float) -> str:
    ends = f'x1="{a[0]:.1f}" y1="{a[1]:.1f}" x2="{b[0]:.1f}" y2="{b[1]:.1f}"'
    return f'<line {ends} stroke="{colour}" stroke-width="{width}"/>'


def _box_of(left: float, top: float, right: float, bottom: float, colour: str) -> str:
    size = f'width="{right - left:.1f}" height="{bottom - top:.1f}"'
    return f'<rect x="{left:.1f}" y="{top:.1f}" {size} fill="{colour}"/>'


def _text(
    words: str, x: float, y: float, *,
    anchor: str = "middle", turned: float = 0.0, colour: str = _INK, halo: bool = False,
) -> str:  # fmt: skip
    turn = f' transform="rotate({turned:.1f} {x:.1f} {y:.1f})"' if turned else ""
    under = ' stroke="#fff" stroke-width="3" paint-order="stroke"' if halo else ""
    return f'<text x="{x:.1f}" y="{y:.1f}" text-anchor="{anchor}" fill="{colour}"{turn}{under}>{escape(words)}</text>'
