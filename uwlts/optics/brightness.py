"""Shift of a stripe's centre caused by brightness gradients on the surface and by image blur.

The laser sheet has a thickness. If the surface reflects more light on one side of the sheet, the centroid of the light
moves to that side. For a Gaussian sheet profile with standard deviation s, the shift is s^2 times the gradient of the
logarithm of brightness across the sheet. The gradient is measured while the stage moves the sheet over the surface.

Image blur also shifts the centre. It moves light between neighbouring profile lines. The shift is large if the stripe
is tilted or curved in the image and its brightness changes along the stripe, as at the rim of a sphere.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from uwlts.model.calibration import Calibration, calibration_digest
from uwlts.model.placement import laser_pose
from uwlts.model.sensor import Laser, Sensor, Uncertainty, Vector
from uwlts.model.stripe import CaptureStripes, stack_pixels
from uwlts.optics.line_table import LineTable
from uwlts.optics.triangulation import MeasuredPoints, rays_on_sheet, to_object
from uwlts.optics.window import RayStatus
from uwlts.runtime.compiled import compiled, compiled_with_arrays
from uwlts.stripe.peak_window import FWHM_PER_SIGMA

BLUR_STD = 1.0 / math.sqrt(3.0)
"""Standard uncertainty of the blur shift, divided by the largest possible shift. The shift is not corrected; any value
between zero and the largest is equally likely (JCGM 100:2008, 4.3.7)."""

_MOST_BLUR_PX = 0.1  # Limit of the blur shift, about the shift by speckle. Centres above it are rejected.

_REACH_MM = 2.0  # largest stage distance of images whose brightness is compared

_LEAST_APART_MM = 0.05
"""Least standard deviation of the stage positions of compared images: a third of the sheet's thickness."""

_LINES = 12  # neighbouring lines on either side for slopes of brightness
_BEND_LINES = 6  # fewer for slopes of the stripe's position, because the stripe is curved
_LEAST_SHARE = 0.2  # fraction of the neighbours that must have a stripe centre

_LEAST_ACROSS = 0.3
"""Least cosine between stage direction and sheet normal for a measurement of the gradient across the sheet."""

_TABLE_TOLERANCE = np.array([1e-7] * 3 + [1e-6] * 5)
"""Tolerances of a table: points (mm), shift per slope (mm^2), sheet thickness (mm) and its image (px)."""

_MOST_FOR_FOOTPRINT = 1000  # lines, to limit time: a median needs no more
_FOOTPRINT_PER_SHEET = math.sqrt(3.0)
"""Standard deviation of a point's footprint across the sheet, divided by that of the sheet: see `footprint_mm`."""
_METHOD_STD = 0.15
"""Relative standard uncertainty of the squared factor because of the stripe method. The square ranges from 2.3 to 3.8
instead of 3: the weights of the profile fit depend on the stripe's brightness and on speckle."""
_PIXEL_VARIANCE = 1.0 / 12.0  # variance of a pixel's width in px^2: a lower limit of blur

_MOVED_PX = 0.5  # step in px for derivatives of the points with respect to the stripe centre


@dataclass(frozen=True, eq=False)
class IlluminatedPoints:
    """Points on a laser sheet of finite thickness, for N stripe centres."""

    found: MeasuredPoints  # points on the middle of the sheet, OCS at stage position 0
    of_slope: np.ndarray
    """(N, 3); shift of a point along its camera ray, mm, per gradient of log brightness across the sheet, 1/mm: unit
    mm^2."""
    sigma_mm: np.ndarray  # (N,); standard deviation of the sheet's profile
    per_sigma_px: np.ndarray
    """(N,); shift of the stripe in the image if the sheet moves by ``sigma_mm``, on a surface normal to the laser's
    axis."""
    calibration: Calibration
    # (N,); profile lines and stripe centres.
    line: np.ndarray
    centre_px: np.ndarray
    evaluate: Callable[[np.ndarray, np.ndarray], np.ndarray]
    """Function that returns points, ``of_slope``, ``sigma_mm`` and ``per_sigma_px`` as one array (M, 8) for lines
    (M,) and centres (M,)."""

    @classmethod
    def from_calibration(
        cls, calibration: Calibration, sensor: Sensor, line: np.ndarray, centre_px: np.ndarray, *, medium_index: float
    ) -> IlluminatedPoints:
        """Locate stripe centres (N,) on profile lines (N,) on the sheet; a window that is not mounted is ignored."""
        digest = calibration_digest(calibration)
        if not sensor.camera.window.mounted:
            calibration = calibration.model_copy(update={"window": None})
        origin_mm = laser_pose(sensor).origin_mm
        known = _make_sheet_function(calibration, sensor.laser, origin_mm, medium_index=medium_index)
        laser = sensor.laser.model_dump_json(), origin_mm.tobytes()
        key = ("sheet", digest, sensor.camera.window.mounted, *laser, medium_index)
        status = np.full(len(line), RayStatus.OK, dtype=np.uint8)

        def exact(line: np.ndarray, place_px: np.ndarray) -> np.ndarray:
            return known(line, place_px)[0]

        table = LineTable.over_range(exact, line, centre_px, tolerance=_TABLE_TOLERANCE, key=key)
        if table is None:
            values, status = known(line, centre_px)
        else:
            exact, values = table.values, table.values(line, centre_px)
        found = MeasuredPoints(values[:, :3], status)
        return cls(found, values[:, 3:6], values[:, 6], values[:, 7], calibration, line, centre_px, exact)

    def brightness_shift(self, width_px: np.ndarray, slopes: np.ndarray, *, stage_direction: Vector) -> np.ndarray:
        """Return the shifts (N, 3) in mm along the camera rays, from the middle of the sheet to the light's centroid.

        The sheet's thickness is the described one, limited by the median stripe width.

        ``width_px`` (N,) is the full width at half maximum; ``slopes`` (N,) are those of `fit_brightness_slopes`; the
        direction is as the capture describes it.
        """
        direction = np.array(self.calibration.stage_direction_of(stage_direction))
        across = float(
            np.array(self.calibration.sheet.normal) @ self.calibration.object_transform()[:3, :3] @ direction
        )
        if abs(across) < _LEAST_ACROSS or not slopes.any():
            return np.zeros((len(slopes), 3))
        widest = np.median(width_px) / FWHM_PER_SIGMA
        return self.of_slope * (slopes / across * np.minimum(1.0, (widest / self.per_sigma_px) ** 2))[:, None]

    def footprint_mm(self, width_px: np.ndarray) -> tuple[float, float]:
        """Return the standard deviations in mm, across the sheet (X) and along the stripe (Y), of a point's footprint.

        The footprint is the part of the surface over which a point averages, on a surface normal to the laser. Both
        values are medians over the stripe centres.

        Along the stripe it is the image blur: the stripe's width without the contribution of the sheet's thickness.

        Across the sheet it is sqrt(3) s for a sheet of standard deviation s. A pixel shows the radiance S(u) at
        position u. A surface height h(u) changes the image by -S' h, and the centroid by the integral of
        -u S' h = (u / s)^2 S h. These weights of h have the variance 3 s^2, whereas the light has s^2.

        ``width_px`` (N,) is the full width of each stripe at half maximum.
        """
        chosen = np.flatnonzero(self.found.status == RayStatus.OK)
        chosen = chosen[:: max(1, len(chosen) // _MOST_FOR_FOOTPRINT)]
        line, place = self.line[chosen], self.centre_px[chosen]
        # Neighbouring lines must stay within the table.
        beside = self.evaluate(line + np.where(line < line.max(), 1, -1), place)
        width, sigma = width_px[chosen] / FWHM_PER_SIGMA, self.sigma_mm[chosen]
        of_sheet = np.minimum(self.per_sigma_px[chosen], width)
        blur = np.sqrt(np.maximum(width**2 - of_sheet**2, _PIXEL_VARIANCE))
        spacing = np.abs(beside[:, 1] - self.found.points_mm[chosen, 1])
        thickness = sigma * of_sheet / self.per_sigma_px[chosen]
        return _FOOTPRINT_PER_SHEET * float(np.median(thickness)), float(np.median(blur * spacing))


def _make_sheet_function(
    calibration: Calibration, laser: Laser, origin_mm: np.ndarray, *, medium_index: float
) -> Callable[[np.ndarray, np.ndarray], tuple[np.ndarray, np.ndarray]]:
    """Return a function from lines and centres (N,) to the tabulated values (N, 8) and the status (N,)."""
    frame = calibration.object_transform()

    def exact(line: np.ndarray, place_px: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        count = len(line)
        places = np.concatenate([place_px, place_px + _MOVED_PX])
        pixels = stack_pixels(np.concatenate([line, line]), places, stripe_along=calibration.stripe_along)
        found, ray, slope = rays_on_sheet(calibration, pixels, medium_index=medium_index)
        in_camera = found.points_mm[:count]
        sigma = sheet_sigma_mm(laser, np.linalg.norm(in_camera - origin_mm, axis=1), medium_index=medium_index)
        # Shift of the point along its ray if the sheet moves by 1 mm along its normal.
        per_mm = ray[:count] @ frame[:3, :3] / slope[:count, None]
        per_px = (found.points_mm[count:, :] - in_camera) @ frame[:3, 2] / _MOVED_PX
        result = np.empty((count, 8))
        result[:, :3] = to_object(calibration, in_camera)
        result[:, 3:6] = per_mm * (sigma**2)[:, None]
        result[:, 6] = sigma
        # On a surface normal to the laser's axis, Z is constant: the shifts of sheet and pixel cancel in Z.
        result[:, 7] = np.abs(per_mm[:, 2] * sigma / per_px)
        return result, found.status[:count]

    return exact


def fit_brightness_slopes(
    frame: np.ndarray, line: np.ndarray, amplitude: np.ndarray, stage_mm: np.ndarray, exposure_ms: np.ndarray
) -> np.ndarray:
    """Return the slopes (N,) of the log stripe amplitude per mm of stage travel, 0 where they are unknown.

    Each slope belongs to a plane fitted to the log amplitudes of neighbouring lines and images. The fit averages noise
    and speckle. Images are at stage positions (F,) in any order. If one of their exposures (F,) is unknown (0), all are
    assumed equal.
    """
    there = np.bincount(frame, minlength=len(stage_mm)) > 0
    order = np.argsort(stage_mm, kind="stable")
    order = order[there[order]]
    row_of = np.zeros(len(there), np.intp)
    row_of[order] = np.arange(len(order))
    position = stage_mm[order]
    within = np.searchsorted(position, position + _REACH_MM, side="right") - np.arange(len(position)) - 1
    whole = position <= position[-1] - _REACH_MM
    reach = int(np.median(within[whole])) if whole.any() else len(position) - 1
    if reach < 1:
        return np.zeros(len(frame))
    bright = np.log(amplitude / exposure_ms[frame] if np.all(exposure_ms[there] > 0) else amplitude)
    return _fit_slopes_by_position(row_of[frame], line, bright, position, rows=reach)


def footprint_std(uncertainty: Uncertainty) -> float:
    """Return the relative standard uncertainty of the squares of `IlluminatedPoints.footprint_mm`.

    It combines the uncertainties of the sheet's thickness and of the stripe method.
    """
    return math.hypot(brightness_shift_std(uncertainty), _METHOD_STD)


def brightness_shift_std(uncertainty: Uncertainty) -> float:
    """Return the relative std of `IlluminatedPoints.brightness_shift`, proportional to the squared thickness."""
    return 2.0 * uncertainty.sheet_thickness


def sheet_sigma_mm(laser: Laser, distance_mm: np.ndarray, *, medium_index: float) -> np.ndarray:
    """Return the standard deviation of the described sheet's profile, mm, at distances from the laser in a medium.

    It is half the 1/e^2 radius w: w^2 = w0^2 (1 + ((z - z0) / zR)^2) with zR = pi w0^2 n / (M2 lambda)
    (Siegman, Lasers, Eqs. 17.5 and 17.6, with the beam quality M2).
    """
    waist = laser.waist_radius_mm
    rayleigh = math.pi * waist**2 * medium_index / (laser.beam_quality_m2 * 1e-6 * laser.wavelength_nm)
    return 0.5 * waist * np.sqrt(1.0 + ((distance_mm - laser.waist_distance_mm) / rayleigh) ** 2)


def estimate_blur_shift_px(
    frame: np.ndarray, line: np.ndarray, centre_px: np.ndarray, amplitude: np.ndarray, width_px: np.ndarray
) -> np.ndarray:
    """Estimate the largest shifts (N,) in px that blur can cause, from neighbouring centres in the same image.

    Let a stripe y(x) have the amplitude A(x). Isotropic blur of standard deviation b moves its centre to E[y(x - e) A(x
    - e)] / E[A(x - e)], where e has the standard deviation b. To second order, the shift is b^2 (y' (ln A)' + y'' / 2).
    The squared stripe width, corrected for the stripe's tilt in the image, is an upper limit of b^2. Centres may be in
    any order; amplitudes are positive, and widths full widths at half maximum.
    """
    if np.any((frame[1:] < frame[:-1]) | ((frame[1:] == frame[:-1]) & (line[1:] < line[:-1]))):
        order, moved = np.lexsort((line, frame)), np.empty(len(line))
        columns = frame, line, centre_px, amplitude, width_px
        moved[order] = estimate_blur_shift_px(*(column[order] for column in columns))
        return moved
    lean = _fit_slopes_along(frame, line, centre_px, _BEND_LINES)
    bend = _fit_slopes_along(frame, line, lean, _BEND_LINES)
    fading = _fit_slopes_along(frame, line, np.log(amplitude), _LINES)
    variance = (width_px / FWHM_PER_SIGMA) ** 2 / (1.0 + lean**2)
    return variance * (lean * fading + 0.5 * bend)


def select_sharp_lines(stripes: CaptureStripes) -> tuple[np.ndarray, np.ndarray]:
    """Return the indices (M,) of stripe centres that blur shifts by less than 0.1 px, and their largest shifts, px."""
    if len(stripes.line) == 0:
        return np.empty(0, np.intp), np.empty(0)
    moved = estimate_blur_shift_px(stripes.frame, stripes.line, stripes.centre_px, stripes.amplitude, stripes.width_px)
    sharp = np.flatnonzero(np.abs(moved) < _MOST_BLUR_PX)
    return sharp, moved[sharp]


def _fit_slopes_along(frame: np.ndarray, line: np.ndarray, values: np.ndarray, reach: int) -> np.ndarray:
    """Return the slopes (N,) per line of straight lines fitted to values within ``reach`` lines of the same image.

    The values are sorted by image and line.
    """
    slopes = np.zeros(len(line))
    _fit_lines(frame, line, np.ascontiguousarray(values, dtype=float), reach, slopes)
    return slopes


@compiled
def _fit_lines(frame: np.ndarray, line: np.ndarray, values: np.ndarray, reach: int, slopes: np.ndarray) -> None:
    """Write the slopes (N,) that can be fitted into ``slopes``, with running sums over the lines."""
    first, last, n, x1, x2, z1, xz = 0, 0, 0.0, 0.0, 0.0, 0.0, 0.0
    origin, base = 0, 0.0
    for k in range(line.size):
        if k == 0 or frame[k] != frame[k - 1]:
            first, last, n, x1, x2, z1, xz = k, k, 0.0, 0.0, 0.0, 0.0, 0.0
            origin, base = line[k], values[k]
        while last < line.size and frame[last] == frame[k] and line[last] <= line[k] + reach:
            x, z = float(line[last] - origin), values[last] - base
            n, x1, x2, z1, xz, last = n + 1.0, x1 + x, x2 + x * x, z1 + z, xz + x * z, last + 1
        while line[first] < line[k] - reach:
            x, z = float(line[first] - origin), values[first] - base
            n, x1, x2, z1, xz, first = n - 1.0, x1 - x, x2 - x * x, z1 - z, xz - x * z, first + 1
        square = x2 / n - (x1 / n) ** 2
        if n > _LEAST_SHARE * (2 * reach + 1) and square > 1.0:
            slopes[k] = (xz / n - x1 / n * z1 / n) / square


def _fit_slopes_by_position(
    row: np.ndarray, column: np.ndarray, values: np.ndarray, position: np.ndarray, *, rows: int
) -> np.ndarray:
    """Return the slopes (N,) per position of planes fitted to the values within ``rows`` images."""
    first = column.min()
    shape = len(position), int(column.max() - first) + 1
    there, z, slopes = np.zeros(shape, np.bool_), np.zeros(shape), np.zeros(shape)
    place = row * shape[1] + (column - first)
    there.ravel()[place] = True
    z.ravel()[place] = values - values.mean()
    # Images at nearly the same stage position do not determine the slope.
    least = max(0.15 * (np.median(position[rows:] - position[:-rows]) / rows) ** 2, _LEAST_APART_MM**2)
    _fit_planes(there, z, position - position.mean(), rows, _LINES, least, slopes)
    return slopes.ravel()[place]


@compiled_with_arrays
def _fit_planes(
    there: np.ndarray, z: np.ndarray, s: np.ndarray, rows: int, columns: int, least: float, slopes: np.ndarray
) -> None:
    """Write slopes (F, L) of planes fitted to the values z (F, L) marked by ``there``, at positions s (F,).

    Running sums over the window, first along each row, then from row to row. Unknown slopes are 0.
    """
    count, width = there.shape
    along, total = np.empty((count, 5, width)), np.zeros((9, width))
    _sum_along_rows(there, z, columns, along)
    fewest = _LEAST_SHARE * ((2 * rows + 1) * (2 * columns + 1))
    for k in range(count + rows):
        for row, sign in ((k, 1.0), (k - 2 * rows - 1, -1.0)):
            if 0 <= row < count:
                _add_row(along[row], s[row], sign, total)
        if k >= rows:
            for at in range(width):
                if there[k - rows, at] and total[0, at] > fewest:
                    slopes[k - rows, at] = _solve_slope(total[:, at], least)


@compiled
def _sum_along_rows(there: np.ndarray, z: np.ndarray, columns: int, along: np.ndarray) -> None:
    """Fill the sums (F, 5, L) of 1, x, x^2, z and x z over the marked values within ``columns`` in their row."""
    count, width = there.shape
    for row in range(count):
        n, x1, x2, z1, xz = 0.0, 0.0, 0.0, 0.0, 0.0
        for k in range(width + columns):
            for at, sign in ((k, 1.0), (k - 2 * columns - 1, -1.0)):
                if 0 <= at < width and there[row, at]:
                    x, value = at - 0.5 * width, z[row, at]
                    n, x1, x2 = n + sign, x1 + sign * x, x2 + sign * x * x
                    z1, xz = z1 + sign * value, xz + sign * x * value
            if k >= columns:
                to = along[row, :, k - columns]
                to[0], to[1], to[2], to[3], to[4] = n, x1, x2, z1, xz


@compiled
def _add_row(row: np.ndarray, s: float, sign: float, total: np.ndarray) -> None:
    """Add a row's sums (5, L) to those over rows (9, L), which also contain s, s^2, s x and s z."""
    for at in range(row.shape[1]):
        n, x1, z1 = sign * row[0, at], sign * row[1, at], sign * row[3, at]
        total[0, at] += n
        total[1, at] += x1
        total[2, at] += sign * row[2, at]
        total[3, at] += z1
        total[4, at] += sign * row[4, at]
        total[5, at] += s * n
        total[6, at] += s * s * n
        total[7, at] += s * x1
        total[8, at] += s * z1


@compiled
def _solve_slope(total: np.ndarray, least: float) -> float:
    """Return the slope by s of the plane with given sums (9,); 0 if they do not determine it."""
    n = total[0]
    mx, mz, ms = total[1] / n, total[3] / n, total[5] / n
    xx, xz = total[2] / n - mx * mx, total[4] / n - mx * mz
    ss, sx, sz = total[6] / n - ms * ms, total[7] / n - ms * mx, total[8] / n - ms * mz
    of_both = ss * xx - sx * sx
    known = xx > 1.0 and least < ss < _REACH_MM**2 and of_both > 1e-3 * ss * xx
    return (sz * xx - xz * sx) / of_both if known else 0.0
