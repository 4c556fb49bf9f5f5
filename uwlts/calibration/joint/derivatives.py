"""Camera rays in the medium and points on the laser sheet, with derivatives by pixels and parameters."""

from dataclasses import dataclass

import numpy as np

from uwlts.model.calibration import CameraModel, FanModel, SheetModel, WindowModel
from uwlts.model.joint_estimate import NominalSheet
from uwlts.model.parameter_keys import LensParameter, SheetParameter, WindowParameter
from uwlts.optics.camera import directions
from uwlts.optics.sheet import behind_window_mm, fan_distances, sheet_surface

LENS = tuple(key for key in LensParameter if key is not LensParameter.F)
WINDOW = tuple(WindowParameter)
COLUMNS = ("u", "v", *LENS, *WINDOW, "medium_index")
"""By what rays are differentiated."""
_INNER = 8  # ideal image coordinates x and y, five numbers of the window, the medium's index


@dataclass(frozen=True, eq=False)
class RayDerivatives:
    """Rays in the medium, camera frame, mm, and their derivatives.

    Attributes
    ----------
    origins, directions : (3, N); directions of length one
    origins_by, directions_by : (C, 3, N); by the `COLUMNS`
    """

    origins: np.ndarray
    directions: np.ndarray
    origins_by: np.ndarray
    directions_by: np.ndarray


def ray_derivatives(
    camera: CameraModel, window: WindowModel | None, pixels: np.ndarray, *, medium_index: float
) -> RayDerivatives | None:
    """Rays of pixels (N, 2) with their derivatives; None where a pixel has no ray in the medium."""
    seen = directions(camera, pixels).T
    if not np.isfinite(seen).all():
        return None
    x, y = seen[0] / seen[2], seen[1] / seen[2]
    ray, by = seen, np.zeros((_INNER, 3, len(x)))
    # Unit vector (x, y, 1) / length by x and y.
    by[0], by[1] = -seen * seen[0] * seen[2], -seen * seen[1] * seen[2]
    by[0, 0] += seen[2]
    by[1, 1] += seen[2]
    origin, origin_by = np.zeros_like(ray), np.zeros_like(by)
    if window is not None:
        traced = _through(window, ray, by, medium_index)
        if traced is None:
            return None
        origin, origin_by, ray, by = traced
    image_by = _ideal_image_by(camera, pixels, x, y)
    return RayDerivatives(origin, ray, _by_columns(origin_by, image_by), _by_columns(by, image_by))


def _by_columns(by_inner: np.ndarray, image_by: np.ndarray) -> np.ndarray:
    lens = by_inner[0][None] * image_by[:, None, 0] + by_inner[1][None] * image_by[:, None, 1]
    return np.concatenate([lens, by_inner[2:]])


def _ideal_image_by(camera: CameraModel, pixels: np.ndarray, x: np.ndarray, y: np.ndarray) -> np.ndarray:
    """Derivatives (11, 2, N) of the ideal image coordinates by u, v and the lens.

    The distorted image D(x, y; k) stays at ((u - cx) / fx, (v - cy) / fy), so that dD/d(x, y) d(x, y) is the change of
    the latter minus dD/dk dk (Brown-Conrady distortion as in OpenCV, module calib3d).
    """
    d = camera.distortion
    s = x * x + y * y
    radial = 1.0 + s * (d.k1 + s * (d.k2 + s * d.k3))
    slope = 2.0 * (d.k1 + s * (2.0 * d.k2 + s * 3.0 * d.k3))
    xx = radial + slope * x * x + 2.0 * d.p1 * y + 6.0 * d.p2 * x
    xy = slope * x * y + 2.0 * d.p1 * x + 2.0 * d.p2 * y
    yy = radial + slope * y * y + 6.0 * d.p1 * y + 2.0 * d.p2 * x
    zero = np.zeros_like(x)
    right = np.array(
        [
            (zero + 1.0 / camera.fx_px, zero),
            (zero, zero + 1.0 / camera.fy_px),
            (-(pixels[:, 0] - camera.cx_px) / camera.fx_px**2, zero),
            (zero, -(pixels[:, 1] - camera.cy_px) / camera.fy_px**2),
            (zero - 1.0 / camera.fx_px, zero),
            (zero, zero - 1.0 / camera.fy_px),
            (-x * s, -y * s),
            (-x * s**2, -y * s**2),
            (-2.0 * x * y, -s - 2.0 * y * y),
            (-s - 2.0 * x * x, -2.0 * x * y),
            (-x * s**3, -y * s**3),
        ]
    )
    determinant = xx * yy - xy * xy
    first = (yy * right[:, 0] - xy * right[:, 1]) / determinant
    second = (xx * right[:, 1] - xy * right[:, 0]) / determinant
    return np.stack([first, second], axis=1)


def _through(
    window: WindowModel, ray: np.ndarray, by: np.ndarray, medium_index: float
) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray] | None:
    """Origins and directions behind the window with derivatives by the inner columns; None where a ray has none."""
    raw = np.array(window.normal) / window.normal[2]
    length = np.linalg.norm(raw)
    normal = raw / length
    normal_by = np.zeros((_INNER, 3))
    normal_by[3] = (np.array([1.0, 0, 0]) - normal * normal[0]) / length
    normal_by[4] = (np.array([0, 1.0, 0]) - normal * normal[1]) / length
    cosine, cosine_by = _along(ray, by, normal, normal_by)
    if not (cosine > 0).all():
        return None
    reach = window.distance_mm * normal[2] / cosine
    reach_by = (window.distance_mm * normal_by[:, 2])[:, None] / cosine - reach * cosine_by / cosine
    reach_by[2] += normal[2] / cosine
    origin, origin_by = reach * ray, reach_by[:, None] * ray + reach * by
    index, index_by = 1.0, np.zeros(_INNER)
    if window.refractions == 2:
        index = window.glass_index
        index_by[6] = 1.0
        refracted = _refracted(ray, by, normal, normal_by, 1.0 / index, -index_by / index**2)
        if refracted is None:
            return None
        ray, by = refracted
        cosine, cosine_by = _along(ray, by, normal, normal_by)
        reach = window.thickness_mm / cosine
        reach_by = -reach * cosine_by / cosine
        reach_by[5] += 1.0 / cosine
        origin, origin_by = origin + reach * ray, origin_by + reach_by[:, None] * ray + reach * by
    ratio_by = index_by / medium_index
    ratio_by[7] = -index / medium_index**2
    refracted = _refracted(ray, by, normal, normal_by, index / medium_index, ratio_by)
    return None if refracted is None else (origin, origin_by, *refracted)


def _along(ray: np.ndarray, by: np.ndarray, normal: np.ndarray, normal_by: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Cosine (N,) between rays and normal and its derivatives (8, N)."""
    return normal @ ray, normal_by @ ray + np.einsum("i,cin->cn", normal, by)


def _refracted(
    ray: np.ndarray, by: np.ndarray, normal: np.ndarray, normal_by: np.ndarray, ratio: float, ratio_by: np.ndarray
) -> tuple[np.ndarray, np.ndarray] | None:
    """Snell's law in vector form (thesis Eq. 2.18) and its derivatives; None at total reflection."""
    cosine, cosine_by = _along(ray, by, normal, normal_by)
    sine_square = 1.0 - cosine**2
    square = 1.0 - ratio**2 * sine_square
    if not (square > 0).all():
        return None
    root = np.sqrt(square)
    along = root - ratio * cosine
    root_by = (ratio**2 * cosine * cosine_by - ratio * ratio_by[:, None] * sine_square) / root
    along_by = root_by - ratio_by[:, None] * cosine - ratio * cosine_by
    refracted = ratio * ray + along * normal[:, None]
    refracted_by = (
        ratio_by[:, None, None] * ray + ratio * by + along_by[:, None] * normal[:, None] + along * normal_by[:, :, None]
    )
    return refracted, refracted_by


PARAMETERS = tuple(SheetParameter)
"""Turns of the normal in rad towards the axis and towards the fan's direction, shift in mm, numbers of `FanModel`."""


@dataclass(frozen=True, eq=False)
class DescribedSheet:
    """The sheet as described, which parameters of zero stand for, camera frame, mm.

    Attributes
    ----------
    normal, axis : (3,); the sheet's normal in air; the laser's axis, square to it
    middle_mm : (3,); point of the sheet about which it turns
    apex_mm, pivot_mm : (3,); where the fan begins, and where it leaves the laser's window
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
            normal=self.normal.tolist(),
            axis=self.axis.tolist(),
            middle_mm=self.middle_mm.tolist(),
            apex_mm=self.apex_mm.tolist(),
            pivot_mm=self.pivot_mm.tolist(),
        )

    def fan(self, values: np.ndarray) -> FanModel:
        """The fan of the parameters (5,)."""
        return FanModel(
            apex_mm=tuple(self.apex_mm.tolist()),
            axis=tuple(self.axis.tolist()),
            pivot_mm=tuple(self.pivot_mm.tolist()),
            bow_rad=float(values[3]),
            window_turn_rad=float(values[4]),
        )

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
