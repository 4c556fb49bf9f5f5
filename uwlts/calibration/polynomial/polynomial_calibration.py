"""Calibration by polynomials: one for each profile line, from stripe points on a target in the same image.

A map from pixels to the target's plane, fitted to the target's points, locates the stripe on it. A joint fit makes the
polynomials vary smoothly from line to line.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
from numpy.polynomial import legendre
from pydantic import JsonValue
from scipy.spatial import ConvexHull

from uwlts.calibration.camera.camera_parameters import TargetImage
from uwlts.calibration.capture_evidence import ALONG_Z, SAME_POSITION_MM, AirEvidence, common_sensor, find_air_evidence
from uwlts.errors import CalibrationError, RangeError
from uwlts.fitting.least_squares import DEFAULT_K, robust_std
from uwlts.model.calibration import PolynomialCalibration
from uwlts.model.placement import laser_pose
from uwlts.model.sensor import to_rows
from uwlts.model.short_text import Brief
from uwlts.optics.nominal import nominal_calibration
from uwlts.optics.triangulation import reconstruct_pixels
from uwlts.optics.window import RayStatus
from uwlts.runtime.progress import ProgressListener, ignore_progress
from uwlts.storage.capture import Capture, CaptureHeader, open_captures
from uwlts.stripe import StripeSettings
from uwlts.targets.detection.ellipses import circle_centre_bias

# The deviation of a plane's image from a homography, by lens and window, is smooth: the fifth degree describes it to a
# micrometre in a view 200 mm wide. With fewer than three points for each coefficient, noise would be fitted.
_HIGHEST_DEGREE = 5
_LOWEST_DEGREE = 3
_POINTS_PER_TERM = 3


@dataclass(frozen=True, eq=False)
class SmoothMap:
    """Smooth map from one plane to another: a homography and a correcting polynomial."""

    homography: np.ndarray  # (3, 3)
    low: np.ndarray  # (2,); first corner of the box of the fitted points: the polynomial's arguments are -1
    high: np.ndarray  # (2,); opposite corner, the arguments are 1
    degree: int  # total degree of the polynomial
    coefficients: np.ndarray  # (terms, 2); Legendre coefficients
    residuals: np.ndarray  # (N, 2); of the fitted points

    def __call__(self, points: np.ndarray) -> np.ndarray:
        """Map points (M, 2); return (M, 2)."""
        return self.coarsely(points) + _compute_terms(points, self.low, self.high, self.degree) @ self.coefficients

    def coarsely(self, points: np.ndarray) -> np.ndarray:
        """Map points (M, 2) with the homography only, which extrapolates well."""
        return cv2.perspectiveTransform(points[:, None], self.homography)[:, 0]


def fit_plate_map(image: TargetImage, *, circle_diameter_mm: float | None = None) -> SmoothMap:
    """Fit the map from pixels to the plate to the points of one image.

    For circles, the pixels are centres of the circles' images. The offsets from the images of the circles' centres are
    corrected with the map itself, as refraction can shift the centres as much as perspective.

    Raises CalibrationError if there are too few points, or they determine no homography; RangeError if a circle's image
    is not an ellipse.
    """
    points, pixels = image.points_mm, image.pixels
    if circle_diameter_mm is not None:
        to_image = fit_smooth_map(points[:, :2], pixels)
        pixels = pixels - circle_centre_bias(lambda rim: to_image(rim[:, :2]), points, diameter_mm=circle_diameter_mm)
    return fit_smooth_map(pixels, points[:, :2])


def fit_smooth_map(start: np.ndarray, end: np.ndarray) -> SmoothMap:
    """Fit a smooth map from points (N, 2) to points (N, 2) by least squares.

    Raises CalibrationError if there are too few points, or they determine no homography.
    """
    counts = {d: (d + 1) * (d + 2) // 2 for d in range(_LOWEST_DEGREE, _HIGHEST_DEGREE + 1)}
    degree = max((d for d, count in counts.items() if _POINTS_PER_TERM * count <= len(start)), default=None)
    if degree is None:
        raise CalibrationError(
            f"{len(start)} points of the target were found; at least {_POINTS_PER_TERM * counts[_LOWEST_DEGREE]} "
            "are needed to find the stripe's place on the target"
        )
    found = cv2.findHomography(np.ascontiguousarray(start), np.ascontiguousarray(end), method=0)[0]
    if found is None or not np.isfinite(found).all():
        raise CalibrationError(f"the {len(start)} points of the target determine no homography from image to target")
    low, high = start.min(axis=0), start.max(axis=0)
    left, terms = end - cv2.perspectiveTransform(start[:, None], found)[:, 0], _compute_terms(start, low, high, degree)
    coefficients = np.linalg.lstsq(terms, left, rcond=None)[0]
    return SmoothMap(found, low, high, degree, coefficients, left - terms @ coefficients)


def _compute_terms(points: np.ndarray, low: np.ndarray, high: np.ndarray, degree: int) -> np.ndarray:
    """Return products of Legendre polynomials in both coordinates up to a total degree, (M, terms)."""
    x, y = _scale_range(points, low, high).T
    products = legendre.legvander2d(x, y, [degree, degree])
    powers = np.add.outer(np.arange(degree + 1), np.arange(degree + 1)).ravel()
    return products[:, powers <= degree]


_ORIGIN_POINTS = 100  # stripe points near the camera's axis that define the origin of the OCS


@dataclass(frozen=True, eq=False)
class PlateStripes:
    """Stripe points of all images on the plate (N points)."""

    pixels: np.ndarray  # (N, 2)
    lines: np.ndarray  # (N,) int; profile line of each point
    centres_px: np.ndarray  # (N,); stripe's centre on the line
    plate_mm: np.ndarray  # (N, 2); place on the plate, in the target's frame
    pose: np.ndarray  # (N,) int; number of the image
    stage_mm: np.ndarray  # (N,); stage position


def common_header(captures: Sequence[Capture]) -> CaptureHeader:
    """Return the first capture's header.

    Raises CalibrationError if there is no capture, one has no target, the captures differ in their arrangement, or the
    stage does not move along Z.
    """
    common_sensor(
        captures,
        also=lambda header: {
            "medium": header.medium,
            "window": "mounted" if header.sensor.camera.window.mounted else "removed",
            "stage_direction": header.stage_direction,
        },
    )
    for capture in captures:
        if capture.header.target is None:
            raise CalibrationError(f"{capture.path.name} does not describe its target in its header")
    direction = captures[0].header.stage_direction
    if abs(direction[2]) < ALONG_Z:
        raise CalibrationError(
            f"the stage must move the sensor along the laser's axis (OCS Z); stage_direction is {direction}"
        )
    return captures[0].header


def stripes_on_plate(
    evidence: AirEvidence, header: CaptureHeader, degree: int
) -> tuple[PlateStripes, list[SmoothMap], list[str]]:
    """Return stripe points on the plate near the target's points in the same image, the maps, and warnings.

    Points are used up to one spacing outside the hull of the target's points in the image, and up to half a spacing
    outside the pattern. Images without such points have no map.

    Raises CalibrationError if there are fewer positions than coefficients of a polynomial of this degree.
    """
    target = evidence.target
    spacing, extent = target.spacing_mm, target.extent_mm
    along = 0 if header.sensor.camera.stripe_along == "width" else 1
    maps, parts, warnings = [], [], []
    for number, (image, pixels) in enumerate(zip(evidence.images, evidence.stripes, strict=True)):
        if not len(pixels):
            warnings.append(f"no stripe at the stage position {image.stage_mm:g} mm, where the target was found")
            continue
        try:
            plate_map = fit_plate_map(image, circle_diameter_mm=target.circle_diameter_mm)
        except CalibrationError as error:
            warnings.append(f"stage position {image.stage_mm:g} mm: left out, {error}")
            continue
        plate, hull = plate_map(pixels), ConvexHull(image.points_mm[:, :2]).equations
        beyond_mm = np.max(plate_map.coarsely(pixels) @ hull[:, :2].T + hull[:, 2], axis=1)
        in_pattern = (plate >= extent.min(axis=0) - spacing / 2) & (plate <= extent.max(axis=0) + spacing / 2)
        on_plate = in_pattern.all(axis=1) & (beyond_mm <= spacing)
        if on_plate.any():
            maps.append(plate_map)
            parts.append((pixels[on_plate], plate[on_plate], number, image.stage_mm))
        else:
            warnings.append(f"stage position {image.stage_mm:g} mm: left out, the stripe is not on the target")
    positions = np.sort([stage for *_, stage in parts])
    different = int(np.count_nonzero(np.diff(positions) > SAME_POSITION_MM)) + 1 if len(positions) else 0
    if evidence.no_stripe:
        raise CalibrationError(evidence.no_stripe)
    if different <= degree:
        raise CalibrationError(
            f"target and stripe were found together at {different} stage positions; polynomials of degree {degree} "
            f"need at least {degree + 1}, better twice as many: {'; '.join([*evidence.warnings, *warnings][:3])}"
        )
    each_pixels, each_plate, numbers, stage_mm = zip(*parts, strict=True)
    pixels, counts = np.vstack(each_pixels), [len(part) for part in each_pixels]
    stripes = PlateStripes(
        pixels=pixels,
        lines=np.rint(pixels[:, along]).astype(int),
        centres_px=pixels[:, 1 - along],
        plate_mm=np.vstack(each_plate),
        pose=np.repeat(numbers, counts),
        stage_mm=np.repeat(stage_mm, counts),
    )
    return stripes, maps, warnings


def object_coordinates(stripes: PlateStripes, header: CaptureHeader) -> tuple[np.ndarray, np.ndarray]:
    """Return Z and Y (N,) of the stripe points in the OCS.

    The plate is at rest, so in the OCS it moves opposite to the stage. Y is along the stripe on the plate, with the
    sign of the described fan in the image. The origin is where the described sensor sees the stripe points nearest to
    its camera's axis.
    """
    camera = header.sensor.camera
    direction = np.array(header.stage_direction)
    depth = -direction[2] * stripes.stage_mm
    _, number, count = np.unique(stripes.pose, return_inverse=True, return_counts=True)
    means = np.column_stack([np.bincount(number, column) / count for column in stripes.plate_mm.T])
    centred = stripes.plate_mm - means[number]
    along_stripe = np.linalg.svd(centred, full_matrices=False)[2][0]
    along = stripes.plate_mm @ along_stripe
    with_lines = np.sum(centred @ along_stripe * (stripes.lines - stripes.lines.mean()))
    fan = laser_pose(header.sensor).fan[0 if camera.stripe_along == "width" else 1]
    along = along * np.sign(with_lines * fan) - direction[1] * stripes.stage_mm

    nominal = nominal_calibration(header.sensor, header.medium)
    index = header.medium.refractive_index(nominal.wavelength_nm)
    seen = reconstruct_pixels(nominal, stripes.pixels, medium_index=index)
    known = np.flatnonzero(seen.status == RayStatus.OK)
    if not len(known):
        raise CalibrationError(
            "the described sensor sees the sheet at none of the stripe points: check baseline, angle and stripe_along"
        )
    _, along_nominal, depth_nominal = seen.points_mm[known].T
    nominal_motion, motion = (values - np.median(values) for values in (depth_nominal, depth[known]))
    if np.sum(nominal_motion * motion) <= 0:
        raise CalibrationError(
            "the stripe moves through the image opposite to the stage positions: check the sign of the captures' "
            f"stage_direction, {header.stage_direction}, the laser's side, and that the images are not rotated by 180 "
            "deg or mirrored"
        )
    from_axis = np.hypot(*(stripes.pixels[known] - camera.principal_point()).T)
    middle = np.argsort(from_axis, kind="stable")[:_ORIGIN_POINTS]
    depth_shift = np.median(depth_nominal[middle] - depth[known][middle])
    return depth + depth_shift, along + np.median(along_nominal[middle] - along[known][middle])


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
        members = np.flatnonzero(pose == number)
        members = members[np.argsort(lines[members], kind="stable")]
        for piece in np.split(members, np.flatnonzero(np.diff(lines[members]) > largest_gap + 1) + 1):
            seen = np.arange(int(lines[piece[0]]), int(lines[piece[-1]]) + 1)
            centres = np.interp(seen, lines[piece], centres_px[piece])
            part = domains[seen - first]
            domains[seen - first] = np.stack([np.minimum(part[:, 0], centres), np.maximum(part[:, 1], centres)], axis=1)
    return np.where(np.isfinite(domains), domains, np.nan)


def _scale_range(x: np.ndarray, low: float | np.ndarray, high: float | np.ndarray) -> np.ndarray:
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
        depth_coefficients=to_rows(depth.coefficients[rows[0]]),
        along_coefficients=to_rows(along.coefficients[rows[1]]),
    )
    map_rms_mm = float(np.sqrt(np.mean(np.sum(np.concatenate([m.residuals for m in maps]) ** 2, axis=1))))
    used, lines = depth.used, stripes.lines
    excess, along_excess = _compute_line_excess(depth, lines), _compute_line_excess(along, lines[used])
    poses, stripe_points = np.unique(stripes.pose, return_counts=True)
    figures = {
        "poses": {
            "stage_mm": [evidence.images[pose].stage_mm for pose in poses.tolist()],
            "stripe_points": stripe_points.tolist(),
        },
        "map": {"rms_mm": map_rms_mm, "points": sum(len(m.residuals) for m in maps)},
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


def _compute_line_excess(fit: LinePolynomials, lines: np.ndarray) -> float:
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
        "max_mm": float(np.max(np.abs(left[used]))),
        "points": int(np.count_nonzero(used)),
        "rejected_share": float(np.mean(~used)),
        "line_excess": excess,
        "pose_means_mm": (np.bincount(image, left[used]) / points).tolist(),
    }
