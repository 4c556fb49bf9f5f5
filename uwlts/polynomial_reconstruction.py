"""From stripe centres to points by a polynomial calibration: position to Z, Z to Y (thesis, section 4.7)."""

import numpy as np
from numpy.polynomial import legendre

from uwlts.calibration.polynomial_model import PolynomialCalibration
from uwlts.errors import RangeError
from uwlts.reconstruction import ObjectPoints, stage_travel
from uwlts.refraction import RayStatus


def reconstruct_by_polynomials(
    calibration: PolynomialCalibration,
    lines: np.ndarray,
    centres_px: np.ndarray,
    *,
    stage_mm: np.ndarray | float,
    stage_direction: np.ndarray,
) -> ObjectPoints:
    """Measured points in the OCS at stage position 0 of stripe centres; X is 0 but for the stage's travel.

    A centre outside the range that its line was calibrated for, or on a line that was not calibrated, has no point:
    its status is OUTSIDE_CALIBRATION.

    Parameters
    ----------
    calibration : PolynomialCalibration
    lines : (N,) int
        Numbers of the profile lines: image columns if the stripe runs along the width, else image rows.
    centres_px : (N,)
        Stripe centre in each line.
    stage_mm : float or (N,)
    stage_direction : (3,)
        Unit direction in the OCS in which the stage moves the sensor.

    Raises
    ------
    RangeError
        A centre or a stage position is not finite, or the direction is not a unit vector.
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
    depth = _values(calibration.depth_coefficients, rows, centres_px[known], calibration.position_range_px)
    along = _values(calibration.along_coefficients, rows, depth, calibration.depth_range_mm)
    points = np.full((len(lines), 3), np.nan)
    points[known] = np.column_stack([np.zeros(len(rows)), along, depth])
    points += stage_travel(stage_mm, stage_direction).T
    status = np.where(known, RayStatus.OK, RayStatus.OUTSIDE_CALIBRATION).astype(np.uint8)
    return ObjectPoints(points, status)


def _values(
    coefficients: tuple[tuple[float, ...], ...], rows: np.ndarray, x: np.ndarray, limits: tuple[float, float]
) -> np.ndarray:
    """Values (N,) of the polynomials in ``rows`` (N,) at x (N,)."""
    low, high = limits
    return legendre.legval((2 * x - low - high) / (high - low), np.array(coefficients)[rows].T, tensor=False)
