"""Where camera rays meet the laser sheet, with derivatives by the rays' columns and by the sheet's parameters."""

from dataclasses import dataclass

import numpy as np

from uwlts.calibration.joint.rays import RayDerivatives
from uwlts.calibration.joint_estimate import NominalSheet
from uwlts.calibration.model import FanModel, SheetModel
from uwlts.calibration.parameter_keys import SheetParameter
from uwlts.sheet_surface import behind_window_mm, fan_distances, sheet_surface

PARAMETERS = tuple(SheetParameter)
"""Turns of the normal in rad towards the axis and towards the fan's direction, shift in mm, numbers of `FanModel`."""


@dataclass(frozen=True, eq=False)
class DescribedSheet:
    """The sheet as described, which parameters of zero stand for, camera frame, mm.

    Attributes
    ----------
    normal, axis : (3,)
        The sheet's normal in air; the laser's axis, square to it.
    middle_mm : (3,)
        Point of the sheet about which it turns.
    apex_mm, pivot_mm : (3,)
        Where the fan begins, and where it leaves the laser's window.
    """

    normal: np.ndarray
    axis: np.ndarray
    middle_mm: np.ndarray
    apex_mm: np.ndarray
    pivot_mm: np.ndarray

    @classmethod
    def of(cls, nominal: NominalSheet) -> "DescribedSheet":
        """The sheet that a file describes."""
        normal, axis, middle, apex, pivot = np.array(
            [nominal.normal, nominal.axis, nominal.middle_mm, nominal.apex_mm, nominal.pivot_mm]
        )
        return cls(normal, axis, middle, apex, pivot)

    def nominal(self) -> NominalSheet:
        """The sheet as a file describes it."""
        return NominalSheet(
            normal=self.normal.tolist(), axis=self.axis.tolist(), middle_mm=self.middle_mm.tolist(),
            apex_mm=self.apex_mm.tolist(), pivot_mm=self.pivot_mm.tolist(),
        )  # fmt: skip

    def fan(self, values: np.ndarray) -> FanModel:
        """The fan of the parameters (5,)."""
        return FanModel(
            apex_mm=tuple(self.apex_mm.tolist()), axis=tuple(self.axis.tolist()),
            pivot_mm=tuple(self.pivot_mm.tolist()), bow_rad=float(values[3]), window_turn_rad=float(values[4]),
        )  # fmt: skip

    def model(self, values: np.ndarray) -> SheetModel:
        """The sheet of the parameters (5,)."""
        normal, _ = self._normal(values)
        offset = float(normal @ self.middle_mm + values[2])
        return SheetModel(normal=tuple(normal.tolist()), offset_mm=offset, fan=self.fan(values))

    def _normal(self, values: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Normal (3,) and its derivatives (2, 3) by the two turns."""
        across = np.stack([self.axis, np.cross(self.axis, self.normal)])
        raw = self.normal + values[:2] @ across
        length = np.linalg.norm(raw)
        normal = raw / length
        return normal, (across - np.outer(across @ normal, normal)) / length

    def miss_by(self, values: np.ndarray, points: np.ndarray, index: float) -> np.ndarray:
        """Derivatives (6, N) of `SheetSurface.miss_mm` at points (3, N) by the parameters and the medium's index."""
        normal, normal_by = self._normal(values)
        turn, bow = values[4], values[3]
        angle = turn * (1.0 - 1.0 / index)
        cosine, sine = np.cos(angle), np.sin(angle)

        def across(n: np.ndarray, m: np.ndarray) -> np.ndarray:
            """Vector (axis x n) x m."""
            return n * (self.axis @ m) - self.axis * (n @ m)

        from_middle, from_pivot = points - self.middle_mm[:, None], points - self.pivot_mm[:, None]
        by = np.empty((6, points.shape[1]))
        for row, n in enumerate(normal_by):
            turned = (cosine - 1.0) * n + sine * (across(n, normal) + across(normal, n))
            by[row] = n @ from_middle + turned @ from_pivot
        fan = self.fan(values)
        at, behind = fan_distances(points, fan, medium_index=index), behind_window_mm(fan)
        of_bow, of_turn = at.bulges()
        # The fan seems to begin farther away as the index grows.
        air_by = (index * (at.along**2 - at.all**2) + at.along * behind) / at.in_air
        wet_by = -behind / at.along * at.wet
        of_bow_by = behind * at.along / at.all - air_by
        of_turn_by = at.wet * (behind - air_by) + wet_by * (at.along - at.in_air)
        by_angle = (cosine * across(normal, normal) - sine * normal) @ from_pivot
        by[2] = -1.0
        by[3] = -of_bow / index
        by[4] = by_angle * (1.0 - 1.0 / index) - of_turn / index
        by[5] = by_angle * turn / index**2
        by[5] += (bow * of_bow + turn * of_turn) / index**2 - (bow * of_bow_by + turn * of_turn_by) / index
        return by


@dataclass(frozen=True, eq=False)
class PointDerivatives:
    """Points (3, N) in mm and their derivatives (C, 3, N) by the rays' columns and (6, 3, N) by sheet and index."""

    points: np.ndarray
    by_rays: np.ndarray
    by_sheet: np.ndarray


def points_on_sheet(
    start: DescribedSheet, values: np.ndarray, rays: RayDerivatives, index: float
) -> PointDerivatives | None:
    """Where rays in a medium meet the sheet; None where one does not."""
    surface = sheet_surface(start.model(values), medium_index=index)
    reach, slope = surface.crossings(rays.origins, rays.directions)
    if not (reach > 0).all():
        return None
    points = rays.origins + reach * rays.directions
    moved = rays.origins_by + reach * rays.directions_by
    along = -np.einsum("in,cin->cn", surface.gradient(points), moved) / slope
    by_sheet = -start.miss_by(values, points, index) / slope
    return PointDerivatives(points, moved + along[:, None] * rays.directions, by_sheet[:, None] * rays.directions)
