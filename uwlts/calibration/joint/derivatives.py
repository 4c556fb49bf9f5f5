"""Camera rays in the medium and points on the laser sheet, with derivatives by pixels and parameters."""

from dataclasses import dataclass

import numpy as np

from uwlts.model.calibration import CameraModel, FanModel, SheetModel, WindowModel
from uwlts.model.joint_estimate import NominalSheet
from uwlts.model.parameter_keys import LensParameter, SheetParameter, WindowParameter
from uwlts.optics.camera import directions, image_derivatives
from uwlts.optics.sheet import behind_window_mm, fan_distances, sheet_surface
from uwlts.optics.window import RayDerivatives, leaning, trace_derivatives

LENS = tuple(key for key in LensParameter if key is not LensParameter.F)
WINDOW = tuple(WindowParameter)
COLUMNS = ("u", "v", *LENS, *WINDOW, "medium_index")
"""By what rays are differentiated."""
SHEET = tuple(SheetParameter)
"""Turns of the normal in rad towards the axis and towards the fan's direction, shift in mm, numbers of `FanModel`."""


def ray_derivatives(
    camera: CameraModel, window: WindowModel | None, pixels: np.ndarray, *, medium_index: float
) -> RayDerivatives | None:
    """Rays of pixels (N, 2) with their derivatives by the `COLUMNS`; None where a pixel has no ray in the medium."""
    seen = directions(camera, pixels).T
    if not np.isfinite(seen).all():
        return None
    ideal = seen[:2] / seen[2]
    # Unit vector (x, y, 1) / length by x and y, which stand for the pixel and the lens until the window is passed.
    by_ideal = -seen * (seen[:2] * seen[2])[:, None]
    by_ideal[[0, 1], [0, 1]] += seen[2]
    if window is None:
        nothing = np.zeros((len(WINDOW) + 1, *seen.shape))
        by = np.concatenate([by_ideal, nothing])
        rays = RayDerivatives(np.zeros_like(seen), seen, np.zeros_like(by), by)
    elif (rays := trace_derivatives(seen, by_ideal, window, medium_index=medium_index)) is None:
        return None
    by_lens = image_derivatives(camera, pixels, ideal)[:, :, None]

    def by_columns(by: np.ndarray) -> np.ndarray:
        return np.concatenate([by[0] * by_lens[:, 0] + by[1] * by_lens[:, 1], by[2:]])

    return RayDerivatives(rays.origins, rays.directions, by_columns(rays.origins_by), by_columns(rays.directions_by))


@dataclass(frozen=True, eq=False)
class DescribedSheet:
    """The sheet as described, which parameters of zero stand for, camera frame, mm: vectors (3,) as `NominalSheet`."""

    normal: np.ndarray
    axis: np.ndarray
    middle_mm: np.ndarray
    apex_mm: np.ndarray
    pivot_mm: np.ndarray

    @classmethod
    def of(cls, nominal: NominalSheet) -> "DescribedSheet":
        """The sheet that a file describes."""
        return cls(*(np.array(getattr(nominal, name)) for name in NominalSheet.model_fields))

    def nominal(self) -> NominalSheet:
        """The sheet as a file describes it."""
        return NominalSheet.model_validate({name: vector.tolist() for name, vector in vars(self).items()})

    def fan(self, values: np.ndarray) -> FanModel:
        """The fan of the parameters (5,)."""
        apex, axis, pivot = (tuple(vector.tolist()) for vector in (self.apex_mm, self.axis, self.pivot_mm))
        return FanModel(
            apex_mm=apex, axis=axis, pivot_mm=pivot, bow_rad=float(values[3]), window_turn_rad=float(values[4])
        )

    def model(self, values: np.ndarray) -> SheetModel:
        """The sheet of the parameters (5,)."""
        normal, _ = self._normal(values)
        offset = float(normal @ self.middle_mm + values[2])
        return SheetModel(normal=tuple(normal.tolist()), offset_mm=offset, fan=self.fan(values))

    def _normal(self, values: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Normal (3,) and its derivatives (2, 3) by the two turns."""
        return leaning(self.normal, np.stack([self.axis, np.cross(self.axis, self.normal)]), values[:2])

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
        of_bow_by = behind * at.along / at.all - air_by
        of_turn_by = at.wet * (behind - air_by) - behind / at.along * at.wet * (at.along - at.in_air)
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
    """Points where rays in a medium meet the sheet; None if one does not."""
    surface = sheet_surface(start.model(values), medium_index=index)
    reach, slope = surface.crossings(rays.origins, rays.directions)
    if not (reach > 0).all():
        return None
    points = rays.origins + reach * rays.directions
    moved = rays.origins_by + reach * rays.directions_by
    along = -np.einsum("in,cin->cn", surface.gradient(points), moved) / slope
    by_sheet = -start.miss_by(values, points, index) / slope
    return PointDerivatives(points, moved + along[:, None] * rays.directions, by_sheet[:, None] * rays.directions)
