"""A sensor to scale: where its rays, windows, sheet and measuring volume lie, seen from the side and onto the sheet.

The side view looks along the sheet, square to the camera's axis, so that the sheet is a line; the front view looks onto
the sheet. Rays are bent at every face by Snell's law in vector form; the measuring volume is that of the formulas.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from twin.study.figures import depths_in_view, field_of
from twin.study.parameters import Parameters, parameters_of
from twin.study.report.rays import Face, border_towards, borders_on_sheet, directions, faces, frame, to_plane, traced
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
        camera=_module(camera.window, camera_faces, np.zeros(3), ahead, axes),
        laser=_module(sensor.laser.window, laser_faces, pose.origin_mm, pose.axis, axes),
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
        laser=_module(sensor.laser.window, laser_faces, pose.origin_mm, pose.axis, axes, about=pose.origin_mm),
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


def _module(
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
