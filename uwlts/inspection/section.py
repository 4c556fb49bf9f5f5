"""Sections of a cloud along a strip, and profiles of single images, with distances and steps measured in them."""

from dataclasses import dataclass

import numpy as np

from uwlts.errors import EvaluationError
from uwlts.inspection.picking import PickedMeasurement, propagate_figures
from uwlts.storage.cloud import PointCloud

_FEWEST_POINTS = 3
"""Fewest points on each side of a step."""
_SMALLEST_MM = 1e-6
"""Shorter ways between two places have no direction."""


@dataclass(frozen=True, eq=False)
class Section:
    """Points in a strip of a cloud, in the order along it."""

    cloud: PointCloud  # points of the strip
    direction: np.ndarray  # (3,); unit vector along the strip, perpendicular to Z
    origin_mm: np.ndarray  # (3,); place where ``along_mm`` is zero

    @property
    def along_mm(self) -> np.ndarray:
        """Distance (N,) along the strip, mm."""
        return (self.cloud.points_mm - self.origin_mm) @ self.direction

    @property
    def depth_mm(self) -> np.ndarray:
        """Coordinate Z (N,), mm, which increases away from the sensor."""
        return self.cloud.points_mm[:, 2]

    def find_nearest(self, along_mm: float) -> int:
        """Return the index of the point nearest to a distance along the strip."""
        if len(self.cloud) == 0:
            raise EvaluationError("the section is empty: there are no points to measure")
        return int(np.argmin(np.abs(self.along_mm - along_mm)))


def cut_section(cloud: PointCloud, first_mm: np.ndarray, second_mm: np.ndarray, *, width_mm: float) -> Section:
    """Return the section of a cloud along the strip through two places (3,), ``width_mm`` wide and parallel to Z.

    EvaluationError if one place lies behind the other, or if there are no points in the strip.
    """
    way = np.array([*(second_mm - first_mm)[:2], 0.0])
    length = float(np.linalg.norm(way))
    if length < _SMALLEST_MM:
        raise EvaluationError("both places of the section have the same X and Y: pick places beside each other")
    direction = way / length
    away = (cloud.points_mm - first_mm) @ np.array([-direction[1], direction[0], 0.0])
    inside = np.flatnonzero(np.abs(away) <= width_mm / 2)
    if len(inside) == 0:
        raise EvaluationError(f"no points within the strip of {width_mm:g} mm: give a wider one")
    order = np.argsort(cloud.points_mm[inside] @ direction, kind="stable")
    return Section(cloud.select(inside[order]), direction, np.array(first_mm, dtype=float))


def order_profile(cloud: PointCloud) -> Section:
    """Return the points of a single image as a section along Y."""
    order = np.argsort(cloud.points_mm[:, 1], kind="stable")
    return Section(cloud.select(order), np.array([0.0, 1.0, 0.0]), np.zeros(3))


def measure_step(section: Section, first_mm: float, second_mm: float, *, width_mm: float) -> PickedMeasurement:
    """Return the height of the surface about the second place of a section above that about the first one.

    Two parallel lines are fitted to the points within ``width_mm`` / 2 of each place along the section (least squares).
    The height is their distance, as in ISO 5436-1 for type A1 standards, positive towards the sensor.

    EvaluationError if the ranges overlap or contain fewer than three points.
    """
    if abs(second_mm - first_mm) < width_mm:
        raise EvaluationError(
            f"the ranges of {width_mm:g} mm about {first_mm:.3f} and {second_mm:.3f} mm overlap: give a smaller width, "
            "or pick places further apart"
        )
    along = section.along_mm
    sides = [np.flatnonzero(np.abs(along - place) <= width_mm / 2) for place in (first_mm, second_mm)]
    for side, place in zip(sides, (first_mm, second_mm), strict=True):
        if len(side) < _FEWEST_POINTS:
            raise EvaluationError(
                f"{len(side)} points within {width_mm / 2:g} mm of {place:.3f} mm along the section: expected at least "
                f"{_FEWEST_POINTS}; give a larger width"
            )
    used, on_first = np.concatenate(sides), np.repeat([1.0, 0.0], [len(side) for side in sides])
    middle = (first_mm + second_mm) / 2

    def measure(points: np.ndarray) -> dict[str, float]:
        place = (points - section.origin_mm) @ section.direction - middle
        table = np.column_stack([on_first, 1 - on_first, place])
        lower, upper, slope = np.linalg.lstsq(table, points[:, 2], rcond=None)[0]
        return {"height": float((lower - upper) / np.hypot(1.0, slope))}

    stated = propagate_figures(section.cloud, used, measure)
    return PickedMeasurement("step", measure(section.cloud.points_mm[used]), stated, len(used), 0)
