"""A cloud as a still picture: seen obliquely from the sensor's side, without perspective, coloured by deviation."""

from itertools import product

import cv2
import numpy as np

from uwlts.cloud import PointCloud
from uwlts.report.canvas import FAINT, INK, blank, line, ticks, write
from uwlts.report.colours import colour_limit_mm, coloured
from uwlts.report.numbers import plain, unit_for

_WIDTH, _HEIGHT, _MARGIN, _BAR = 1120, 600, 84, 100
_FINER = 2
"""Points are drawn on a grid this many times finer and averaged, which smooths their edges."""

AZIMUTH_DEG, ELEVATION_DEG = 28.0, 38.0
"""Direction of view: turned from +X towards +Y, and down from there (towards +Z, away from the sensor)."""


def view_direction() -> np.ndarray:
    """Unit vector (3,) in the OCS along which the cloud is looked at."""
    azimuth, elevation = np.radians((AZIMUTH_DEG, ELEVATION_DEG))
    level = np.array([np.cos(azimuth), np.sin(azimuth), 0.0])
    return np.cos(elevation) * level + np.array([0.0, 0.0, np.sin(elevation)])


def cloud_picture(cloud: PointCloud) -> np.ndarray:
    """Picture (H, W, 3) uint8 of all points, with the box around them, its scales in mm, and a colour bar."""
    picture = blank(_WIDTH, _HEIGHT)
    if not len(cloud):
        write(picture, "the cloud has no points", _WIDTH / 2, _HEIGHT / 2, align="middle")
        return picture
    view = _View(cloud.points_mm)
    view.draw_box(picture)
    deviation = np.full(len(cloud), np.nan) if cloud.deviation_mm is None else cloud.deviation_mm.astype(np.float64)
    limit = colour_limit_mm(deviation)
    _draw_points(picture, view, cloud.points_mm, coloured(deviation / limit)[:, ::-1])
    view.draw_scales(picture)
    if np.isfinite(deviation).any():
        _draw_bar(picture, limit)
        if np.isnan(deviation).any():
            write(picture, "dark: not evaluated", _WIDTH - 150, _HEIGHT - 60, size=0.45)
    return picture


class _View:
    """Orthographic view that fits the box around the points into the picture."""

    def __init__(self, points: np.ndarray):
        self.low, self.high = points.min(axis=0), points.max(axis=0)
        # A flat box would have edges without length.
        pad = np.maximum(0.02 * np.ptp(points, axis=0), 1e-3 * max(1e-6, float(np.ptp(points, axis=0).max())))
        self.low, self.high = self.low - pad, self.high + pad
        self.forward = view_direction()
        right = np.cross(self.forward, (0.0, 0.0, -1.0))
        self.right = right / np.linalg.norm(right)
        self.down = np.cross(self.forward, self.right)
        corners = self._flat(np.array(list(product(*zip(self.low, self.high, strict=True)))))
        room = np.array([_WIDTH - 2 * _MARGIN - _BAR, _HEIGHT - 2 * _MARGIN])
        self.scale = float((room / np.maximum(np.ptp(corners, axis=0), 1e-12)).min())
        middle = (corners.min(axis=0) + corners.max(axis=0)) / 2
        self.shift = _MARGIN + room / 2 - self.scale * middle

    def _flat(self, points: np.ndarray) -> np.ndarray:
        return np.column_stack([points @ self.right, points @ self.down])

    def at(self, points: np.ndarray) -> np.ndarray:
        """Picture coordinates (N, 2) of points (N, 3)."""
        return self.scale * self._flat(np.atleast_2d(points)) + self.shift

    def draw_box(self, picture: np.ndarray) -> None:
        for axis in range(3):
            for ends in product((0, 1), repeat=2):
                line(picture, self.at(self._edge(axis, ends)), colour=FAINT)

    def _edge(self, axis: int, ends: tuple[int, ...]) -> np.ndarray:
        edge = np.array([self.low, self.high])
        for other, end in zip([a for a in range(3) if a != axis], ends, strict=True):
            edge[:, other] = (self.low, self.high)[end][other]
        return edge

    def draw_scales(self, picture: np.ndarray) -> None:
        """Scales along the lowest edges for X and Y, along the leftmost for Z."""
        centre = self.at((self.low + self.high) / 2)[0]
        for axis, name in enumerate("XYZ"):
            edges = [self._edge(axis, ends) for ends in product((0, 1), repeat=2)]
            places = np.array([self.at(edge).mean(axis=0) for edge in edges])
            edge = edges[int(np.argmin(places[:, 0]) if axis == 2 else np.argmax(places[:, 1]))]
            ends = self.at(edge)
            line(picture, ends, colour=INK)
            along = (ends[1] - ends[0]) / max(1e-12, float(np.linalg.norm(ends[1] - ends[0])))
            outward = np.array([-along[1], along[0]])
            outward *= np.sign(outward @ (ends.mean(axis=0) - centre)) or 1.0
            length = float(np.linalg.norm(ends[1] - ends[0]))
            for value in ticks(self.low[axis], self.high[axis], count=max(2, int(length / 60))):
                place = edge[0].copy()
                place[axis] = value
                start = self.at(place)[0]
                line(picture, np.array([start, start + 6 * outward]), colour=INK)
                write(picture, f"{value:g}", *(start + 19 * outward), align="middle", size=0.45)
            write(picture, f"{name} / mm", *(ends.mean(axis=0) + 46 * outward), align="middle")


def _draw_points(picture: np.ndarray, view: _View, points: np.ndarray, colours: np.ndarray) -> None:
    """Small squares, the farthest point's first, so that the nearest stay visible."""
    order = np.argsort(-(points @ view.forward), kind="stable")
    place = np.floor(_FINER * (view.at(points[order]) + 0.5)).astype(int)
    fine = cv2.resize(picture, None, fx=_FINER, fy=_FINER, interpolation=cv2.INTER_NEAREST)
    size = _point_size(len(points), view)
    for right, down in product(range(size), repeat=2):
        fine[place[:, 1] + down - size // 2, place[:, 0] + right - size // 2] = colours[order]
    picture[:] = cv2.resize(fine, (picture.shape[1], picture.shape[0]), interpolation=cv2.INTER_AREA)


def _point_size(count: int, view: _View) -> int:
    """Side of a point's square in fine pixels: sparse clouds get larger points."""
    area = float(np.prod(np.ptp(view.at(np.array([view.low, view.high])), axis=0))) * _FINER**2
    return int(np.clip(round(1.3 * (area / count) ** 0.5), 3, 9))


def _draw_bar(picture: np.ndarray, limit: float) -> None:
    unit, factor = unit_for(limit)
    left, top, height = _WIDTH - _BAR + 20, 110, _HEIGHT - 220
    shares = np.linspace(1, -1, height)
    picture[top : top + height, left : left + 22] = coloured(shares)[:, None, ::-1]
    cv2.rectangle(picture, (left, top), (left + 21, top + height - 1), INK, 1)
    for share in (1.0, 0.5, 0.0, -0.5, -1.0):
        y = top + (1 - share) / 2 * (height - 1)
        value = factor * share * limit
        write(picture, f"{plain(round(value, 1 if abs(limit * factor) >= 1 else 3)):>1}", left + 30, y, size=0.45)
    write(picture, "deviation", left - 14, top - 44)
    # The built-in letters have no Greek.
    write(picture, f"/ {'um' if unit == 'µm' else unit}", left - 14, top - 24)
