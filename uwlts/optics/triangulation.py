"""Triangulation: from stripe centres in the image to points on the laser sheet.

Either with models of lens, window, sheet and stage (thesis Fig. 43), or with polynomials from image position to Z and
from Z to Y (thesis section 4.7).

A sheet is conical if the beam enters the line optics with a tilt b. A ray at the angle a to the axis then has the
component b (1 - cos a) across the sheet. Let t be the angle between the sheet and the normal of the laser's window.
Refraction divides the component of a ray along the window's face by the medium's index n (Snell's law).

Let r be the distance of a point from the rays' apparent origin, and z its component along the axis. The fraction w of z
is in the medium. The sheet in the medium deviates from a plane by (b (r - q) + t w (z - q)) / n. Here q = r cos a and
q^2 = n^2 z^2 - (n^2 - 1) r^2. The window turns that plane by t (1 - 1 / n). This is exact to first order in b and t;
the offset by the glass is neglected.
"""

from dataclasses import dataclass

import numpy as np
from numpy.polynomial import legendre

from uwlts.errors import RangeError
from uwlts.model.calibration import Calibration, FanModel, PolynomialCalibration, SheetModel
from uwlts.model.stripe import stack_pixels
from uwlts.optics.camera import directions
from uwlts.optics.line_table import LineTable
from uwlts.optics.window import RaysInMedium, RayStatus, trace_window

# Iterations of `SheetSurface.crossings`. The deviation from the plane is a few hundredths of a millimetre and almost
# constant along a ray, so that each iteration gains at least three digits.
_ROUNDS = 4
# Lower limit of (q / r)^2, for points that a solver may try. Rays behind the window do not reach such points.
_GRAZING = 1e-3


@dataclass(frozen=True, eq=False)
class FanDistances:
    """Distances of points from the apparent origin of a fan in a medium."""

    away: np.ndarray  # (3, N); vectors from the origin to the points
    distance: np.ndarray  # (N,); their lengths r
    along: np.ndarray  # (N,); their components z along the fan's axis
    in_air: np.ndarray  # (N,); the lengths q in air (see the module's description)
    wet: np.ndarray  # (N,); fraction w of ``along`` that is in the medium

    def bulges(self) -> tuple[np.ndarray, np.ndarray]:
        """Return n times the sheet's deviation (N,), (N,) per beam tilt b and per window angle t."""
        return self.distance - self.in_air, self.wet * (self.along - self.in_air)


@dataclass(frozen=True, eq=False)
class SheetSurface:
    """Surface of the sheet in the camera frame, mm: the plane ``normal . x = offset_mm`` plus the fan's deviation.

    ``index`` is the medium's refractive index. Without a ``fan`` the surface is a plane.
    """

    normal: np.ndarray
    offset_mm: float
    index: float = 1.0
    fan: FanModel | None = None

    def is_plane(self) -> bool:
        """Return whether the surface is a plane."""
        return self.fan is None or (self.fan.bow_rad == 0.0 and self.fan.window_turn_rad == 0.0)

    def crossings(self, origins: np.ndarray, directions: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return distances (N,) in mm along rays (3, N) to the surface, and the gradient (N,) along each ray there."""
        along = self.normal @ directions
        reach = (self.offset_mm - self.normal @ origins) / along
        if self.is_plane():
            return reach, along
        slope = along
        for _ in range(_ROUNDS):
            points = origins + reach * directions
            slope = np.einsum("in,in->n", self.gradient(points), directions)
            reach = reach - self.miss_mm(points) / slope
        return reach, slope

    def miss_mm(self, points: np.ndarray) -> np.ndarray:
        """Return the signed distances (N,) of points (3, N) from the surface, positive on the side of the normal."""
        miss = self.normal @ points - self.offset_mm
        if (fan := self.fan) is None or self.is_plane():
            return miss
        of_bow, of_turn = fan_distances(points, fan, medium_index=self.index).bulges()
        return miss - (fan.bow_rad * of_bow + fan.window_turn_rad * of_turn) / self.index

    def gradient(self, points: np.ndarray) -> np.ndarray:
        """Return the gradient (3, N) of `miss_mm` at points (3, N)."""
        if (fan := self.fan) is None or self.is_plane():
            return np.repeat(self.normal[:, None], points.shape[1], axis=1)
        found, n = fan_distances(points, fan, medium_index=self.index), self.index
        axis = np.array(fan.axis)[:, None]
        of_air = (n**2 * found.along * axis - (n**2 - 1.0) * found.away) / found.in_air
        of_bow = found.away / found.distance - of_air
        of_turn = found.wet * (axis - of_air) + (1.0 - found.wet) * (1.0 - found.in_air / found.along) * axis
        return self.normal[:, None] - (fan.bow_rad * of_bow + fan.window_turn_rad * of_turn) / n


def fan_distances(points: np.ndarray, fan: FanModel, *, medium_index: float) -> FanDistances:
    """Return the distances of points (3, N) from a fan's apparent origin, which in a medium is behind the true one."""
    axis = np.array(fan.axis)
    behind = medium_index * behind_window_mm(fan)
    offset = points - (np.array(fan.pivot_mm) - behind * axis)[:, None]
    along, square = axis @ offset, np.einsum("in,in->n", offset, offset)
    in_air = np.sqrt(np.maximum(medium_index**2 * along**2 - (medium_index**2 - 1.0) * square, _GRAZING * square))
    return FanDistances(offset, np.sqrt(square), along, in_air, 1.0 - behind / along)


def behind_window_mm(fan: FanModel) -> float:
    """Return the distance along the axis from the fan's origin to the window's outer face."""
    return float(np.array(fan.axis) @ (np.array(fan.pivot_mm) - np.array(fan.apex_mm)))


def sheet_surface(sheet: SheetModel, *, medium_index: float) -> SheetSurface:
    """Return the surface of a sheet in a medium; the index is relative to air."""
    normal, fan = np.array(sheet.normal), sheet.fan
    if fan is None:
        return SheetSurface(normal, sheet.offset_mm)
    turn = fan.window_turn_rad * (1.0 - 1.0 / medium_index)
    axis = np.array(fan.axis)
    # (axis x normal) x normal
    across = (axis @ normal) * normal - (normal @ normal) * axis
    turned = np.cos(turn) * normal + np.sin(turn) * across
    return SheetSurface(
        normal=turned,
        offset_mm=float(sheet.offset_mm + (turned - normal) @ np.array(fan.pivot_mm)),
        index=medium_index,
        fan=fan,
    )


# Sine of the angle to the sheet below which a ray counts as parallel: some thousand rounding errors. A ray at this
# angle would meet a sheet 1 mm away after a million kilometres.
_PARALLEL = 1e-12

# Tolerance of the table of a profile's points.
_TABLE_TOLERANCE_MM = 1e-7

_ALONG_X = np.array([1.0, 0.0, 0.0])  # direction of a stage that stays at its position 0

# Pixels per block, so that all intermediate results stay in the processor's cache.
_BLOCK = 4096


@dataclass(frozen=True)
class MeasuredPoints:
    """Measured points in the camera frame, or in the object coordinate system (OCS) at stage position 0."""

    points_mm: np.ndarray  # (N, 3), NaN where the status is not OK
    status: np.ndarray  # (N,) uint8, `uwlts.optics.window.RayStatus`


def reconstruct_profile(
    calibration: Calibration,
    lines: np.ndarray,
    centres_px: np.ndarray,
    *,
    medium_index: float,
    stage_mm: np.ndarray | float = 0.0,
    stage_direction: np.ndarray = _ALONG_X,
) -> MeasuredPoints:
    """Reconstruct points (N, 3) in the OCS from stripe centres (N,) on lines (N,) of one or several profiles.

    Lines are image columns if the stripe runs along the width, else rows. The index is relative to air, and ignored
    without a window. ``stage_mm`` is one position or (N,), by default 0; ``stage_direction`` (3,) is the sensor's
    motion in the OCS.

    Raises RangeError as for `points_on_sheet` and `stage_travel`.
    """
    found = _compute_profile_points(calibration, lines, centres_px, medium_index=medium_index)
    points = to_object(calibration, found.points_mm, stage_mm=stage_mm, stage_direction=stage_direction)
    return MeasuredPoints(points, found.status)


def _compute_profile_points(
    calibration: Calibration, lines: np.ndarray, centres_px: np.ndarray, *, medium_index: float
) -> MeasuredPoints:
    """Return the points of `points_on_sheet`, from a `LineTable` if one is worth making."""

    def exact(line: np.ndarray, place: np.ndarray) -> MeasuredPoints:
        pixels = stack_pixels(line, place, stripe_along=calibration.stripe_along)
        return points_on_sheet(calibration, pixels, medium_index=medium_index)

    lines, centres_px = np.asarray(lines), np.asarray(centres_px)
    table = LineTable.over_range(
        lambda line, place: exact(line, place).points_mm, lines, centres_px, tolerance=_TABLE_TOLERANCE_MM
    )
    if table is not None:
        return MeasuredPoints(table.values(lines, centres_px), np.full(len(lines), RayStatus.OK, dtype=np.uint8))
    return exact(lines, centres_px)


def reconstruct_pixels(
    calibration: Calibration,
    pixels: np.ndarray,
    *,
    medium_index: float,
    stage_mm: np.ndarray | float = 0.0,
    stage_direction: np.ndarray = _ALONG_X,
) -> MeasuredPoints:
    """Reconstruct points in the OCS at stage position 0 from pixels (N, 2). Errors are those of `reconstruct_profile`.

    Stage, direction and index are those of `reconstruct_profile`, too.
    """
    found = points_on_sheet(calibration, pixels, medium_index=medium_index)
    points = to_object(calibration, found.points_mm, stage_mm=stage_mm, stage_direction=stage_direction)
    return MeasuredPoints(points, found.status)


def points_on_sheet(calibration: Calibration, pixels: np.ndarray, *, medium_index: float) -> MeasuredPoints:
    """Intersect the camera rays of pixels (N, 2), (u, v) in px, with the sheet, camera frame (thesis Eqs. 3.3 to 3.9).

    The pixels may belong to several frames. The medium's index, relative to air, is ignored without a window.

    Raises RangeError if a pixel is not finite, or the index is not finite and positive.
    """
    return rays_on_sheet(calibration, pixels, medium_index=medium_index)[0]


def rays_on_sheet(
    calibration: Calibration, pixels: np.ndarray, *, medium_index: float
) -> tuple[MeasuredPoints, np.ndarray, np.ndarray]:
    """Return `points_on_sheet`, ray directions (N, 3) in the medium, and the sheet's gradient (N,) along the rays."""
    pixels = np.asarray(pixels, dtype=float)
    sheet = sheet_surface(calibration.sheet, medium_index=medium_index)
    found = []
    for block in np.split(pixels, range(_BLOCK, len(pixels), _BLOCK)):
        rays = trace_window(directions(calibration.camera, block), calibration.window, medium_index=medium_index)
        found.append((*_intersect(rays, sheet), rays.directions))
    points, status, slope, along = found[0] if len(found) == 1 else map(np.concatenate, zip(*found, strict=True))
    return MeasuredPoints(points, status), along, slope


def to_object(
    calibration: Calibration,
    points_camera: np.ndarray,
    *,
    stage_mm: np.ndarray | float = 0.0,
    stage_direction: np.ndarray = _ALONG_X,
) -> np.ndarray:
    """Transform points (N, 3) from the camera frame at ``stage_mm`` to the OCS at stage position 0, mm.

    The result is ``T_object_camera p_camera + stage_mm * stage_direction``. Rows of NaN stay NaN. ``stage_mm`` is one
    position for all points or one for each; ``stage_direction`` is a unit vector in the OCS.

    Raises RangeError as for `stage_travel`.
    """
    travel = stage_travel(stage_mm, stage_direction)
    object_from_camera = np.linalg.inv(calibration.object_transform())
    points = object_from_camera[:3, :3] @ np.asarray(points_camera, dtype=float).T + object_from_camera[:3, 3, None]
    points += travel
    return np.ascontiguousarray(points.T)


def stage_travel(stage_mm: np.ndarray | float, stage_direction: np.ndarray) -> np.ndarray:
    """Return the shift of points in the OCS by the stage: (3, N), or (3, 1) for a single position.

    Raises RangeError if a stage position is not finite, or the direction is not a unit vector.
    """
    stage_mm, stage_direction = np.asarray(stage_mm, dtype=float), np.asarray(stage_direction, dtype=float)
    if not np.isfinite(stage_mm).all():
        raise RangeError("a stage position is not finite")
    if not abs(np.linalg.norm(stage_direction) - 1.0) <= 1e-6:
        raise RangeError(f"the stage's direction {stage_direction} is not a unit vector")
    return np.multiply.outer(stage_direction, stage_mm) if stage_mm.ndim else (stage_mm * stage_direction)[:, None]


def _intersect(rays: RaysInMedium, sheet: SheetSurface) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Intersect rays in the medium with the sheet: points (N, 3), status (N,), and gradient (N,) along the rays.

    For a plane this is thesis Eq. 3.9. The status of a ray that does not meet the sheet in the medium is BEHIND or
    NO_CROSSING: BEHIND if the pupil and the ray's origin in the medium are on different sides of the sheet.
    """
    normal = sheet.normal
    gap = sheet.offset_mm - rays.origins @ normal
    approach = rays.directions @ normal
    parallel = np.abs(approach) <= _PARALLEL
    if parallel.any():
        approach[parallel] = np.nan
    length, slope = gap / approach, approach
    if not sheet.is_plane():
        length, slope = sheet.crossings(rays.origins.T, rays.directions.T)
    points = (rays.origins.T + length * rays.directions.T).T
    status = rays.status
    if not np.all(length > 0):
        passed = gap * sheet.offset_mm <= 0
        missed = (status == RayStatus.OK) & ~(length > 0)
        status = np.where(missed, np.where(passed, RayStatus.BEHIND, RayStatus.NO_CROSSING), status).astype(np.uint8)
        points[status != RayStatus.OK] = np.nan
    return points, status, slope


def reconstruct_by_polynomials(
    calibration: PolynomialCalibration,
    lines: np.ndarray,
    centres_px: np.ndarray,
    *,
    stage_mm: np.ndarray | float,
    stage_direction: np.ndarray,
) -> MeasuredPoints:
    """Reconstruct points in the OCS at stage position 0 from stripe centres, with polynomials.

    X is 0 plus the stage's travel. The status is OUTSIDE_CALIBRATION if a line is not calibrated, or if a centre is
    outside the calibrated range of its line.

    Lines and centres are (N,); stage and direction are those of `reconstruct_profile`.

    Raises RangeError if a centre is not finite, or as for `stage_travel`.
    """
    lines, centres_px = np.asarray(lines), np.asarray(centres_px, dtype=float)
    if not np.isfinite(centres_px).all():
        raise RangeError("a stripe centre is not finite")
    domains = calibration.domains()
    rows = lines - calibration.first_line
    known = (rows >= 0) & (rows < len(domains))
    rows = np.where(known, rows, 0)
    # Lines without a range have NaN limits; comparisons with NaN are false.
    known &= (centres_px >= domains[rows, 0]) & (centres_px <= domains[rows, 1])
    rows = rows[known]
    depth = _evaluate(calibration.depth_coefficients, rows, centres_px[known], calibration.position_range_px)
    along = _evaluate(calibration.along_coefficients, rows, depth, calibration.depth_range_mm)
    points = np.full((len(lines), 3), np.nan)
    points[known] = np.column_stack([np.zeros(len(rows)), along, depth])
    points += stage_travel(stage_mm, stage_direction).T
    status = np.where(known, RayStatus.OK, RayStatus.OUTSIDE_CALIBRATION).astype(np.uint8)
    return MeasuredPoints(points, status)


def _evaluate(
    coefficients: tuple[tuple[float, ...], ...], rows: np.ndarray, x: np.ndarray, limits: tuple[float, float]
) -> np.ndarray:
    """Evaluate the polynomials in ``rows`` (N,) at x (N,)."""
    low, high = limits
    return legendre.legval((2 * x - low - high) / (high - low), np.array(coefficients)[rows].T, tensor=False)
