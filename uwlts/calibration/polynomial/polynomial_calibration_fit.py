"""One polynomial for each profile line; a joint fit makes them vary smoothly from line to line."""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.polynomial import legendre
from pydantic import JsonValue

from uwlts.calibration.capture_evidence import AirEvidence, find_air_evidence
from uwlts.calibration.polynomial.polynomial_evidence import (
    PlateStripes,
    common_header,
    object_coordinates,
    stripes_on_plate,
)
from uwlts.errors import CalibrationError, RangeError
from uwlts.fitting.least_squares import DEFAULT_K, robust_std
from uwlts.model.calibration import PolynomialCalibration
from uwlts.model.short_text import Brief
from uwlts.runtime.progress import ProgressListener, ignore_progress
from uwlts.storage.capture import Capture, CaptureHeader, open_captures
from uwlts.stripe import StripeSettings

MOST_SMOOTH = 8
"""Largest degree of the coefficients as functions of the line."""
_LINES_PER_DEGREE = 10  # lines needed for each degree over the lines
_DETERMINED = 1e-6  # smallest ratio of singular values: a full view has 0.1, a triangular one some thousandths
_ROUNDS = 20  # of outlier rejection; a few suffice
_RETURNING_ROUNDS = 10  # rounds in which outliers may return; afterwards they stay rejected, so that the iteration ends


@dataclass(frozen=True, eq=False)
class LinePolynomials:
    """Polynomials of one variable for each line, from the first to the last one with data."""

    first_line: int
    range: tuple[float, float]  # of the variable, for all lines; the Legendre polynomials' argument is -1 to 1
    coefficients: np.ndarray  # (L, degree + 1); Legendre coefficients of each line
    residuals: np.ndarray  # (N,); data minus polynomial, with outliers
    used: np.ndarray  # (N,) bool; inliers

    def rms(self) -> float:
        """Return the root mean square residual of the inliers."""
        return float(np.sqrt(np.mean(self.residuals[self.used] ** 2)))

    def evaluate(self, lines: np.ndarray, x: np.ndarray) -> np.ndarray:
        """Return the values (N,) on lines (N,) at positions x (N,); NaN outside the lines and positions of the data."""
        rows, (low, high) = lines - self.first_line, self.range
        known = (rows >= 0) & (rows < len(self.coefficients)) & (x >= low) & (x <= high)
        values = np.full(len(x), np.nan)
        coefficients = self.coefficients[rows[known]].T
        values[known] = legendre.legval(_scale_range(x[known], low, high), coefficients, tensor=False)
        return values


def fit_line_polynomials(lines: np.ndarray, x: np.ndarray, y: np.ndarray, *, degree: int) -> LinePolynomials:
    """Fit polynomials y(x) of all lines by least squares; coefficients are polynomials of the line number.

    The data are lines (N,), x and y (N,). The model is the sum over i, j of ``a_ij P_i(line) P_j(x)`` with Legendre
    polynomials P on scaled ranges. The index j runs to ``degree``, i to `MOST_SMOOTH`. Data beyond five robust standard
    deviations are rejected, and the fit is repeated until convergence.

    Raises CalibrationError if the data do not determine the polynomials.
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
                f"{degree} with {terms} coefficients over all lines: let the stripe cover more of the target"
            )
        first, last = int(lines[used].min()), int(lines[used].max())
        low, high = float(x[used].min()), float(x[used].max())
        if not (high > low and last > first):
            raise CalibrationError("the stripe is at the same place in all images: move the stage between them")
        design = legendre.legvander2d(
            _scale_range(lines, float(first), float(last)), _scale_range(x, low, high), [smooth, degree]
        )
        # The triangular factor has the same solution and singular values, and is small.
        triangle = np.asarray(np.linalg.qr(np.column_stack([design, y])[used], mode="r"))
        solution, _, _, singular = np.linalg.lstsq(triangle[:, :-1], triangle[:, -1], rcond=None)
        if singular[-1] < _DETERMINED * singular[0]:
            raise CalibrationError(
                f"the stripe points do not determine polynomials of degree {degree}: the stripe must be visible along "
                "its line at all depths"
            )
        residuals = y - design @ solution
        spread = robust_std(residuals[used])
        # Rounding errors of exact data are not outliers.
        within = np.abs(residuals) <= max(DEFAULT_K * spread, 1e-9 * float(np.ptp(y)))
        if rounds >= _RETURNING_ROUNDS:
            within &= used
        rounds += 1
        settled, used = np.array_equal(within, used), within
        if settled or rounds == _ROUNDS:
            break
    over_lines = legendre.legvander(_scale_range(np.arange(first, last + 1), float(first), float(last)), smooth)
    coefficients = over_lines @ solution.reshape(smooth + 1, degree + 1)
    return LinePolynomials(first, (low, high), coefficients, residuals, used)


def line_domains(lines: np.ndarray, pose: np.ndarray, centres_px: np.ndarray, *, largest_gap: int) -> np.ndarray:
    """Return the range (L, 2) of observed stripe positions for each line, from the first to the last line with data.

    The stripe points have lines (N,), image numbers (N,) and centres (N,) on the line. In each image, lines without a
    centre are interpolated from their neighbours on both sides, unless more than ``largest_gap`` successive lines lack
    one. Lines without data get NaN.
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


def _scale_range(x: np.ndarray, low: float, high: float) -> np.ndarray:
    return (2 * x - low - high) / (high - low)


_LARGEST_REJECTED = 0.2  # outliers are few; more contradict the positions or the target
_LARGEST_GAP = 0.1  # fraction of the lines that may successively lack a centre and be interpolated
_LARGEST_MAP_SHARE = 0.004  # relative to the circles' spacing; twice the expected error of the map
_LARGEST_LINE_EXCESS = 1.5  # 1 by chance, within a few percent for thousands of points


@dataclass(frozen=True, eq=False, repr=False)
class PolynomialResult(Brief):
    """Polynomial calibration with the data of its report.

    Attributes
    ----------
    depth, along : fits of Z(position) and of Y(Z), with residuals of all stripe points for Z, and of the inliers of Z
        for Y
    """

    calibration: PolynomialCalibration
    stripes: PlateStripes
    depth: LinePolynomials
    along: LinePolynomials
    warnings: list[str]


def calibrate_polynomials(
    captures: Sequence[Capture | str | Path],
    *,
    degree: int = 6,
    stripe: StripeSettings = None,
    progress: ProgressListener = ignore_progress,
) -> PolynomialResult:
    """Calibrate by polynomials, position to Z and Z to Y for each profile line, completely in the medium of use.

    Parameters
    ----------
    captures : sequence of Capture or path
        Captures of a target at rest, perpendicular to the laser's axis, while the stage moves the sensor along Z. Every
        stage position has one image with the lamp and one with the laser.
    degree : int
        Degree of the polynomials; there must be more stage positions.
    stripe : StripeOptions or dict, optional
        As for `reconstruct`.
    progress : callable, optional
        Called with the number of images done, the total, and the name of the stage.

    Returns
    -------
    PolynomialResult
        The OCS has X = 0 on the sheet, Z along the stage's motion, away from the sensor, and Y along the stripe on the
        plate. Its origin is where the described sensor sees the stripe nearest to the camera's axis.

    Raises
    ------
    CalibrationError
        The captures do not belong together, the stage does not move along Z, there are too few positions, or the
        evidence contradicts the sensor's description or itself.
    DescriptionError
        A capture's target cannot be read.
    RangeError
        The degree is less than 1.
    """
    if degree < 1:
        raise RangeError(f"the polynomials' degree is {degree}; expected at least 1, usually 6")
    with open_captures(captures) as opened:
        header = common_header(opened)
        evidence = find_air_evidence(opened, stripe=stripe, progress=progress)
        sources = [{"file": capture.path.name, "name": capture.header.name} for capture in opened]
    return fit_polynomials(evidence, header, degree=degree, sources=sources)


def fit_polynomials(
    evidence: AirEvidence, header: CaptureHeader, *, degree: int, sources: Sequence[dict[str, str]] = ()
) -> PolynomialResult:
    """Fit polynomials to gathered evidence; ``sources`` names the captures. Errors as `calibrate_polynomials`."""
    stripes, maps, warnings = stripes_on_plate(evidence, header, degree)
    warnings = [*evidence.warnings, *warnings]
    depth_mm, along_mm = object_coordinates(stripes, header)

    depth = fit_line_polynomials(stripes.lines, stripes.centres_px, depth_mm, degree=degree)
    kept = np.flatnonzero(depth.used)
    along = fit_line_polynomials(stripes.lines[kept], depth_mm[kept], along_mm[kept], degree=degree)
    kept = kept[along.used]
    rejected = 1 - len(kept) / len(depth_mm)
    if rejected > _LARGEST_REJECTED:
        raise CalibrationError(
            f"{100 * rejected:.0f} % of the stripe points are not on the polynomials of the others: check the stage "
            "positions, and that the stripe is on the target"
        )
    sensor, camera = header.sensor, header.sensor.camera
    gap = int(_LARGEST_GAP * camera.lines())
    domains = line_domains(stripes.lines[kept], stripes.pose[kept], stripes.centres_px[kept], largest_gap=gap)
    first = int(stripes.lines[kept].min())
    rows = [slice(first - fit.first_line, first - fit.first_line + len(domains)) for fit in (depth, along)]
    calibration = PolynomialCalibration(
        sensor_name=sensor.name,
        stripe_along=camera.stripe_along,
        wavelength_nm=sensor.laser.wavelength_nm,
        medium_name=header.medium_name,
        medium=header.medium,
        window_mounted=camera.window.mounted,
        width_px=camera.width_px,
        height_px=camera.height_px,
        degree=degree,
        first_line=first,
        position_range_px=depth.range,
        depth_range_mm=along.range,
        domains_px=tuple(tuple(pair) if np.isfinite(pair[0]) else None for pair in domains.tolist()),
        depth_coefficients=tuple(map(tuple, depth.coefficients[rows[0]].tolist())),
        along_coefficients=tuple(map(tuple, along.coefficients[rows[1]].tolist())),
    )
    map_rms_mm = float(np.sqrt(np.mean(np.concatenate([m.residuals for m in maps]) ** 2) * 2))
    used, lines = depth.used, stripes.lines
    excess, along_excess = _line_excess(depth, lines), _line_excess(along, lines[used])
    poses, stripe_points = np.unique(stripes.pose, return_counts=True)
    figures = {
        "poses": {
            "stage_mm": [evidence.images[pose].stage_mm for pose in poses.tolist()],
            "stripe_points": stripe_points.tolist(),
        },
        "map": {
            "rms_mm": map_rms_mm,
            "largest_image_rms_mm": max(m.rms_mm() for m in maps),
            "points": sum(len(m.residuals) for m in maps),
        },
        "depth": _fit_figures(depth, excess, stripes.pose),
        "along": _fit_figures(along, along_excess, stripes.pose[used]),
    }
    largest = _LARGEST_MAP_SHARE * evidence.target.spacing_mm
    if map_rms_mm > largest:
        warnings.append(
            f"the target's points scatter by {map_rms_mm:.3f} mm about a smooth map of its plane; "
            f"expected less than {largest:.3f} mm: is the target flat, sharp and described correctly?"
        )
    if excess > _LARGEST_LINE_EXCESS:
        warnings.append(
            f"residuals of the same line are correlated, {excess:.1f} times more than by chance: the laser line has a "
            "shape that is too fine for polynomials smooth over the lines"
        )
    provenance = {"source": "polynomials from captures", "captures": list(sources), "warnings": warnings}
    provenance |= {} if camera.offset_px is None else {"offset_px": list(camera.offset_px)}
    calibration = calibration.model_copy(update={"residuals": figures, "provenance": provenance})
    return PolynomialResult(calibration, stripes, depth, along, warnings)


def _line_excess(fit: LinePolynomials, lines: np.ndarray) -> float:
    """Return the scatter of the lines' means relative to its expectation by chance, std / sqrt(n)."""
    _, line, count = np.unique(lines[fit.used], return_inverse=True, return_counts=True)
    means, several, rms = np.bincount(line, fit.residuals[fit.used]) / count, count > 1, fit.rms()
    if not (several.any() and rms > 0):
        return 1.0
    return float(np.sqrt(np.mean(count[several] * means[several] ** 2)) / rms)


def _fit_figures(fit: LinePolynomials, excess: float, pose: np.ndarray) -> dict[str, JsonValue]:
    left, used = fit.residuals, fit.used
    _, image, points = np.unique(pose[used], return_inverse=True, return_counts=True)
    return {
        "rms_mm": fit.rms(),
        "mean_absolute_mm": float(np.mean(np.abs(left[used]))),
        "max_mm": float(np.max(np.abs(left[used]))),
        "points": int(np.count_nonzero(used)),
        "rejected_share": float(np.mean(~used)),
        "line_excess": excess,
        "pose_means_mm": (np.bincount(image, left[used]) / points).tolist(),
    }
