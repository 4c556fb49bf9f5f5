"""From stripe centres in the image to points on the surface.

By lens, window and sheet, then the stage (thesis Fig. 43); or by polynomials, position to Z and Z to Y (thesis, section
4.7).
"""

from dataclasses import dataclass

import numpy as np
from numpy.polynomial import legendre

from uwlts.errors import RangeError
from uwlts.model.calibration import Calibration
from uwlts.model.polynomial_calibration import PolynomialCalibration
from uwlts.model.stripe import pixels_of
from uwlts.optics.camera import directions
from uwlts.optics.line_table import LineTable
from uwlts.optics.sheet import SheetSurface, sheet_surface
from uwlts.optics.window import RaysInMedium, RayStatus, trace_window

# Sine of the angle to the sheet below which a ray counts as parallel to it: some thousand roundings. A ray at this
# angle would meet a sheet 1 mm away after a million kilometres.
_PARALLEL = 1e-12

# To which points of profiles are tabulated.
_TABLE_TOLERANCE_MM = 1e-7

# Pixels computed together, so that all intermediate results stay in the processor's cache.
_BLOCK = 4096


@dataclass(frozen=True)
class MeasuredPoints:
    """Measured points: in the camera frame, or in the object coordinate system (OCS) at the stage position 0.

    Attributes
    ----------
    points_mm : (N, 3) float64, NaN where the status is not OK
    status : (N,) uint8, `uwlts.optics.window.RayStatus`
    """

    points_mm: np.ndarray
    status: np.ndarray


def reconstruct_profile(
    calibration: Calibration,
    lines: np.ndarray,
    centres_px: np.ndarray,
    *,
    medium_index: float,
    stage_mm: np.ndarray | float,
    stage_direction: np.ndarray,
) -> MeasuredPoints:
    """Measured points of the stripe centres of one profile, or of many joined together.

    ``lines`` (N,) are image columns if the stripe runs along the width, else image rows; ``centres_px`` (N,) is the
    stripe's place on each. The rest is as for `reconstruct_pixels`.
    """
    found = _profile_points(calibration, lines, centres_px, medium_index=medium_index)
    points = to_object(calibration, found.points_mm, stage_mm=stage_mm, stage_direction=stage_direction)
    return MeasuredPoints(points, found.status)


def _profile_points(
    calibration: Calibration, lines: np.ndarray, centres_px: np.ndarray, *, medium_index: float
) -> MeasuredPoints:
    """As `points_on_sheet`, by a table where there are many points and all of their part of the image has some."""

    def exact(line: np.ndarray, place: np.ndarray) -> MeasuredPoints:
        pixels = pixels_of(line, place, stripe_along=calibration.stripe_along)
        return points_on_sheet(calibration, pixels, medium_index=medium_index)

    lines, centres_px = np.asarray(lines), np.asarray(centres_px)
    table = LineTable.about(
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
    stage_mm: np.ndarray | float,
    stage_direction: np.ndarray,
) -> MeasuredPoints:
    """Measured points in the OCS of pixels (N, 2), given as (u, v) in px; see `points_on_sheet` and `to_object`."""
    found = points_on_sheet(calibration, pixels, medium_index=medium_index)
    points = to_object(calibration, found.points_mm, stage_mm=stage_mm, stage_direction=stage_direction)
    return MeasuredPoints(points, found.status)


def points_on_sheet(calibration: Calibration, pixels: np.ndarray, *, medium_index: float) -> MeasuredPoints:
    """Crossings of the camera rays of pixels (N, 2), (u, v), with the sheet, camera frame (thesis Eqs. 3.3 to 3.9).

    The pixels may be those of many frames. The index of the medium, relative to air, matters only behind a window.
    RangeError where a pixel is not finite, or the index is not finite and positive.
    """
    return rays_on_sheet(calibration, pixels, medium_index=medium_index)[0]


def rays_on_sheet(
    calibration: Calibration, pixels: np.ndarray, *, medium_index: float
) -> tuple[MeasuredPoints, np.ndarray, np.ndarray]:
    """As `points_on_sheet`, with the rays' directions (N, 3) in the medium and the sheet's gradient (N,) along them."""
    pixels = np.asarray(pixels, dtype=float)
    sheet = sheet_surface(calibration.sheet, medium_index=medium_index)
    found = []
    for block in np.split(pixels, range(_BLOCK, len(pixels), _BLOCK)):
        rays = trace_window(directions(calibration.camera, block), calibration.window, medium_index=medium_index)
        found.append((*_crossings(rays, sheet), rays.directions))
    points, status, slope, along = found[0] if len(found) == 1 else map(np.concatenate, zip(*found, strict=True))
    return MeasuredPoints(points, status), along, slope


def to_object(
    calibration: Calibration, points_camera: np.ndarray, *, stage_mm: np.ndarray | float, stage_direction: np.ndarray
) -> np.ndarray:
    """Points (N, 3) in the OCS at stage position 0, mm, from points (N, 3) in the camera frame at ``stage_mm``.

    ``p_object = T_object_camera p_camera + stage_mm * stage_direction`` with a position for all points or for each, and
    the unit direction in the OCS in which the stage moves the sensor; rows of NaN stay NaN. Raises as `stage_travel`.
    """
    travel = stage_travel(stage_mm, stage_direction)
    object_from_camera = np.linalg.inv(calibration.object_transform())
    points = object_from_camera[:3, :3] @ np.asarray(points_camera, dtype=float).T + object_from_camera[:3, 3, None]
    points += travel
    return np.ascontiguousarray(points.T)


def stage_travel(stage_mm: np.ndarray | float, stage_direction: np.ndarray) -> np.ndarray:
    """Shift of points in the OCS by the stage's motion: (3, N), or (3, 1) where all share a position.

    RangeError where a stage position is not finite, or the direction is not a unit vector.
    """
    stage_mm, stage_direction = np.asarray(stage_mm, dtype=float), np.asarray(stage_direction, dtype=float)
    if not np.isfinite(stage_mm).all():
        raise RangeError("a stage position is not finite")
    if not abs(np.linalg.norm(stage_direction) - 1.0) <= 1e-6:
        raise RangeError(f"the stage's direction {stage_direction} is not a unit vector")
    return np.multiply.outer(stage_direction, stage_mm) if stage_mm.ndim else (stage_mm * stage_direction)[:, None]


def _crossings(rays: RaysInMedium, sheet: SheetSurface) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Crossings (N, 3) of rays in the medium with the sheet (thesis Eq. 3.9 for a plane), status and slope (N,).

    A crossing that is not ahead of the ray is BEHIND if the light passed the sheet between the pupil and the medium,
    that is, if the two lie on different sides of it; otherwise the ray runs away from the sheet.
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
    """Measured points in the OCS at stage position 0 of stripe centres; X is 0 but for the stage's travel.

    A centre outside the range that its line was calibrated for, or on a line that was not calibrated, has no point:
    its status is OUTSIDE_CALIBRATION.

    Arguments are as for `reconstruct_profile`; RangeError where a centre is not finite, or as from `stage_travel`.
    """
    lines, centres_px = np.asarray(lines), np.asarray(centres_px, dtype=float)
    if not np.isfinite(centres_px).all():
        raise RangeError("a stripe centre is not finite")
    domains = calibration.domains()
    rows = lines - calibration.first_line
    known = (rows >= 0) & (rows < len(domains))
    rows = np.where(known, rows, 0)
    # Comparisons with the NaN of a line without a range are false.
    known &= (centres_px >= domains[rows, 0]) & (centres_px <= domains[rows, 1])
    rows = rows[known]
    depth = _polynomial_values(calibration.depth_coefficients, rows, centres_px[known], calibration.position_range_px)
    along = _polynomial_values(calibration.along_coefficients, rows, depth, calibration.depth_range_mm)
    points = np.full((len(lines), 3), np.nan)
    points[known] = np.column_stack([np.zeros(len(rows)), along, depth])
    points += stage_travel(stage_mm, stage_direction).T
    status = np.where(known, RayStatus.OK, RayStatus.OUTSIDE_CALIBRATION).astype(np.uint8)
    return MeasuredPoints(points, status)


def _polynomial_values(
    coefficients: tuple[tuple[float, ...], ...], rows: np.ndarray, x: np.ndarray, limits: tuple[float, float]
) -> np.ndarray:
    """Values (N,) of the polynomials in ``rows`` (N,) at x (N,)."""
    low, high = limits
    return legendre.legval((2 * x - low - high) / (high - low), np.array(coefficients)[rows].T, tensor=False)
