"""One polynomial for each profile line, fitted to all lines together so that it changes smoothly from line to line."""

from dataclasses import dataclass

import numpy as np
from numpy.polynomial import legendre

from uwlts.errors import CalibrationError
from uwlts.metrology.robust_fit import MAD_TO_STD

MOST_SMOOTH = 8
"""Degree of the coefficients over the lines."""

# A degree over the lines needs several lines of its own.
_LINES_PER_DEGREE = 10
# Smallest singular value over the largest one: a full view has 0.1, one cut to a triangle some thousandths.
_DETERMINED = 1e-6
_STRAYS = 5.0
_ROUNDS = 20
_RETURNING_ROUNDS = 10


@dataclass(frozen=True, eq=False)
class LinePolynomials:
    """Polynomials of one variable, one for each line from the first to the last one with data.

    Attributes
    ----------
    first_line : int
    range : (low, high)
        Range of the variable, on which the Legendre polynomials' argument runs from -1 to 1; the same for all lines.
    coefficients : (L, degree + 1)
        Legendre coefficients of each line.
    residuals : (N,)
        Data less polynomial, outliers included.
    used : (N,) bool
        The data that were not left out as outliers.
    """

    first_line: int
    range: tuple[float, float]
    coefficients: np.ndarray
    residuals: np.ndarray
    used: np.ndarray

    def rms(self) -> float:
        """Root mean square residual of the data used."""
        return float(np.sqrt(np.mean(self.residuals[self.used] ** 2)))


def fit_line_polynomials(lines: np.ndarray, x: np.ndarray, y: np.ndarray, *, degree: int) -> LinePolynomials:
    """Polynomials y(x) of all lines by least squares, their coefficients themselves polynomials of the line's number.

    The model is the sum over i, j of ``a_ij P_i(line) P_j(x)`` with Legendre polynomials P on the scaled ranges of the
    lines and of x, j up to ``degree`` and i up to `MOST_SMOOTH`. Data off by more than five robust standard deviations
    are left out, and the fit repeated until nothing changes.

    Parameters
    ----------
    lines : (N,) int
    x, y : (N,)
    degree : int
        Of each line's polynomial.

    Raises
    ------
    CalibrationError
        The data do not determine the polynomials.
    """
    span = int(np.ptp(lines)) + 1 if len(lines) else 0
    smooth = min(MOST_SMOOTH, (span - 1) // _LINES_PER_DEGREE)
    terms = (smooth + 1) * (degree + 1)
    used = np.ones(len(lines), dtype=bool)
    rounds = 0
    while True:
        if np.count_nonzero(used) <= terms:
            raise CalibrationError(
                f"{np.count_nonzero(used)} stripe points on {span} lines are too few for polynomials of degree "
                f"{degree} with {terms} coefficients over all lines: let the stripe fall on more of the target"
            )
        first, last = int(lines[used].min()), int(lines[used].max())
        low, high = float(x[used].min()), float(x[used].max())
        if not (high > low and last > first):
            raise CalibrationError("the stripe lies at one place in all images: move the stage between them")
        design = legendre.legvander2d(
            _scaled(lines, float(first), float(last)), _scaled(x, low, high), [smooth, degree]
        )
        # The triangular factor has the equations' solution and singular values and is small.
        triangle = np.asarray(np.linalg.qr(np.column_stack([design, y])[used], mode="r"))
        solution, _, _, singular = np.linalg.lstsq(triangle[:, :-1], triangle[:, -1], rcond=None)
        if singular[-1] < _DETERMINED * singular[0]:
            raise CalibrationError(
                f"the stripe points do not determine polynomials of degree {degree}: the stripe must be seen along its "
                "line at all depths"
            )
        residuals = y - design @ solution
        spread = MAD_TO_STD * np.median(np.abs(residuals[used]))
        # Rounding alone must not make outliers of exact data.
        within = np.abs(residuals) <= max(_STRAYS * spread, 1e-9 * float(np.ptp(y)))
        if rounds >= _RETURNING_ROUNDS:
            within &= used
        rounds += 1
        settled, used = np.array_equal(within, used), within
        if settled or rounds == _ROUNDS:
            break
    over_lines = legendre.legvander(_scaled(np.arange(first, last + 1), float(first), float(last)), smooth)
    coefficients = over_lines @ solution.reshape(smooth + 1, degree + 1)
    return LinePolynomials(first, (low, high), coefficients, residuals, used)


def line_domains(lines: np.ndarray, pose: np.ndarray, centres_px: np.ndarray, *, largest_gap: int) -> np.ndarray:
    """Range (L, 2) of the stripe positions that each line has seen, from the first to the last line with data.

    At each pose lines without a centre borrow one from their neighbours on both sides, by interpolation, unless more
    than ``largest_gap`` lines in succession have none. Lines that have seen nothing get NaN.

    Parameters
    ----------
    lines : (N,) int
    pose : (N,) int
        Number of the image of each stripe point.
    centres_px : (N,)
        Stripe centre on the line.
    largest_gap : int
    """
    first, count = int(lines.min()), int(np.ptp(lines)) + 1
    domains = np.tile([np.inf, -np.inf], (count, 1))
    for number in np.unique(pose):
        own = np.flatnonzero(pose == number)
        own = own[np.argsort(lines[own], kind="stable")]
        for piece in np.split(own, np.flatnonzero(np.diff(lines[own]) > largest_gap + 1) + 1):
            seen = np.arange(int(lines[piece[0]]), int(lines[piece[-1]]) + 1)
            centres = np.interp(seen, lines[piece], centres_px[piece])
            part = domains[seen - first]
            domains[seen - first] = np.stack([np.minimum(part[:, 0], centres), np.maximum(part[:, 1], centres)], axis=1)
    return np.where(np.isfinite(domains), domains, np.nan)


def _scaled(x: np.ndarray, low: float, high: float) -> np.ndarray:
    return (2 * x - low - high) / (high - low)
