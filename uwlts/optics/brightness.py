"""Shift of a stripe's centre where the brightness varies over the surface, and by blur.

The sheet has a thickness. Where the surface under it shines brighter on one side, most of the light that is seen comes
from there and not from the sheet's middle: for a sheet of Gaussian profile with the standard deviation s, from s^2
times the slope of the brightness's logarithm beside it. The slope shows when the stage moves the sheet over the
surface.

The image is blurred, too. Where a stripe leans or bends in the image and fades along itself, as at the rim of a sphere,
blur moves light from one line to the next and with it the centre that is seen there.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from uwlts.model.calibration import Calibration
from uwlts.model.placement import laser_pose
from uwlts.model.sensor import Laser, Sensor, Uncertainty, Vector
from uwlts.model.stripe import CaptureStripes, pixels_of
from uwlts.optics.line_table import LineTable
from uwlts.optics.triangulation import MeasuredPoints, rays_on_sheet, to_object
from uwlts.optics.window import RayStatus
from uwlts.runtime.compiled import compiled, compiled_with_arrays
from uwlts.stripe.peak_window import FWHM_PER_SIGMA

BLUR_STD = 1.0 / math.sqrt(3.0)
"""Standard uncertainty of what blur moves centres by, over the largest possible: that is left as it is, and anything
between none and all of it is as likely (JCGM 100:2008, 4.3.7)."""

_MOST_BLUR_PX = 0.1
"""Centres that blur may move by more, which is as much as speckle does, are left out."""

_REACH_MM = 2.0
"""The brightness at a point is taken from images within this way of the stage."""

_LEAST_APART_MM = 0.05
"""Least standard deviation of the positions of images for their brightness to be compared: a third of a sheet."""

_LINES = 12  # neighbouring lines on either side for slopes of brightness
_BEND_LINES = 6  # the same for slopes of the stripe, which bends
_LEAST_SHARE = 0.2  # share of the neighbours that must show it

_LEAST_ACROSS = 0.3
"""Least cosine between the stage's motion and the sheet's normal for which a scan shows what lies beside the sheet."""

_TABLE_TOLERANCE = np.array([1e-7] * 3 + [1e-6] * 5)
"""Error of the tabulated points, mm, of the shift per slope, mm^2, of the thickness, mm, and of pixels for it."""

_MOST_FOR_FOOTPRINT = 1000
_FOOTPRINT_PER_SHEET = math.sqrt(3.0)
"""Standard deviations of what a point is the mean of, over that of the sheet: see `footprint_mm`."""
_METHOD_STD = 0.15
"""Relative standard uncertainty of its square by how a stripe's centre is taken: 2.3 to 3.8 instead of 3 where the
profile fit's weights run from those of faint stripes with weak speckle to those of bright ones with strong speckle."""
_PIXEL_VARIANCE = 1.0 / 12.0
"""Of a pixel's own width, px2: an image is blurred at least by that."""

_MOVED_PX = 0.5
"""Step for the derivatives of the points by the pixel."""


@dataclass(frozen=True, eq=False)
class LitSheet:
    """What stripe centres (N,) see of a sheet that has a thickness.

    ``found`` are the points on the sheet's middle, OCS at the stage's position 0. ``of_slope`` (N, 3), mm2, is how far
    their light comes from beside them, along the camera's rays, for each 1/mm by which the brightness's logarithm grows
    across the sheet; ``sigma_mm`` (N,) is the sheet's thickness, and ``per_sigma_px`` (N,) how far the stripe moves on
    a surface square to the laser's axis where the sheet does so by its thickness.
    """

    found: MeasuredPoints
    of_slope: np.ndarray
    sigma_mm: np.ndarray
    per_sigma_px: np.ndarray
    calibration: Calibration
    line: np.ndarray
    centre_px: np.ndarray
    at: Callable[[np.ndarray, np.ndarray], np.ndarray]

    @classmethod
    def of(
        cls,
        calibration: Calibration,
        sensor: Sensor,
        line: np.ndarray,
        centre_px: np.ndarray,
        *,
        medium_index: float,
        digest: str | None = None,
    ) -> LitSheet:
        """The sheet as described of a sensor by a calibration, without a window where the sensor has none.

        With the calibration's ``digest`` tables are kept for the next scan.
        """
        if not sensor.camera.window.mounted:
            calibration = calibration.model_copy(update={"window": None})
        origin_mm = laser_pose(sensor).origin_mm
        known = _on_sheet(calibration, sensor.laser, origin_mm, medium_index=medium_index)
        laser = sensor.laser.model_dump_json(), origin_mm.tobytes()
        key = None if digest is None else ("sheet", digest, sensor.camera.window.mounted, *laser, medium_index)
        status = np.full(len(line), RayStatus.OK, dtype=np.uint8)

        def exact(line: np.ndarray, place_px: np.ndarray) -> np.ndarray:
            return known(line, place_px)[0]

        table = LineTable.about(exact, line, centre_px, tolerance=_TABLE_TOLERANCE, key=key)
        if table is None:
            values, status = known(line, centre_px)
        else:
            exact, values = table.values, table.values(line, centre_px)
        found = MeasuredPoints(values[:, :3], status)
        return cls(found, values[:, 3:6], values[:, 6], values[:, 7], calibration, line, centre_px, exact)

    def beside(self, width_px: np.ndarray, slopes: np.ndarray, *, stage_direction: Vector) -> np.ndarray:
        """From the points on the sheet's middle to where their light comes from, along the camera's rays: (N, 3), mm.

        The sheet is as thick as described, but no thicker than the stripes would make it on a surface square to the
        laser. ``width_px`` (N,) is the stripe's full width at half maximum, ``slopes`` (N,) those of
        `slopes_of_brightness`, ``stage_direction`` as the capture describes it.
        """
        direction = np.array(self.calibration.stage_direction_of(stage_direction))
        across = float(
            np.array(self.calibration.sheet.normal) @ self.calibration.object_transform()[:3, :3] @ direction
        )
        if abs(across) < _LEAST_ACROSS or not slopes.any():
            return np.zeros((len(slopes), 3))
        known = width_px[np.isfinite(width_px)]
        widest = (np.median(known) if len(known) else np.inf) / FWHM_PER_SIGMA
        return self.of_slope * (slopes / across * np.minimum(1.0, (widest / self.per_sigma_px) ** 2))[:, None]

    def footprint_mm(self, width_px: np.ndarray) -> tuple[float, float]:
        """Standard deviations of the part of a surface square to the laser that a point is the mean of, mm.

        Along the stripe (Y) it is the image's blur, which is what the sheet leaves of the stripe's width (N,); medians
        over the stripe centres. Across the sheet (X) it is the square root of 3 times the sheet's thickness: a pixel
        shows the radiance S(u) of the place u that it sees, so that a surface's height h(u) changes the image by -S' h,
        and its centroid by the integral of -u S' h = (u / s)^2 S h for a sheet of standard deviation s. As weights of h
        these have the variance 3 s^2, not the s^2 of the light.
        """
        chosen = np.flatnonzero(np.isfinite(width_px) & (self.found.status == RayStatus.OK))
        chosen = chosen[:: max(1, len(chosen) // _MOST_FOR_FOOTPRINT)]
        line, place = self.line[chosen], self.centre_px[chosen]
        # To the neighbouring line, within the table.
        beside = self.at(line + np.where(line < line.max(), 1, -1), place)
        width, sigma = width_px[chosen] / FWHM_PER_SIGMA, self.sigma_mm[chosen]
        of_sheet = np.minimum(self.per_sigma_px[chosen], width)
        blur = np.sqrt(np.maximum(width**2 - of_sheet**2, _PIXEL_VARIANCE))
        spacing = np.abs(beside[:, 1] - self.found.points_mm[chosen, 1])
        thickness = sigma * of_sheet / self.per_sigma_px[chosen]
        return _FOOTPRINT_PER_SHEET * float(np.median(thickness)), float(np.median(blur * spacing))


def _on_sheet(
    calibration: Calibration, laser: Laser, origin_mm: np.ndarray, *, medium_index: float
) -> Callable[[np.ndarray, np.ndarray], tuple[np.ndarray, np.ndarray]]:
    """Values (N, 8) for lines and places (N,), points, and ``of_slope`` to ``per_sigma_px``; and status (N,)."""
    frame = calibration.object_transform()

    def exact(line: np.ndarray, place_px: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        count = len(line)
        places = np.concatenate([place_px, place_px + _MOVED_PX])
        pixels = pixels_of(np.concatenate([line, line]), places, stripe_along=calibration.stripe_along)
        found, ray, slope = rays_on_sheet(calibration, pixels, medium_index=medium_index)
        in_camera = found.points_mm[:count]
        sigma = sheet_sigma_mm(laser, np.linalg.norm(in_camera - origin_mm, axis=1), medium_index=medium_index)
        # A sheet that moves by 1 mm moves the point along its ray by so much over the slope.
        per_mm = ray[:count] @ frame[:3, :3] / slope[:count, None]
        per_px = (found.points_mm[count:, :] - in_camera) @ frame[:3, 2] / _MOVED_PX
        result = np.empty((count, 8))
        at_start = {"stage_mm": 0.0, "stage_direction": np.array([1.0, 0.0, 0.0])}
        result[:, :3] = to_object(calibration, in_camera, **at_start)
        result[:, 3:6] = per_mm * (sigma**2)[:, None]
        result[:, 6] = sigma
        # Where the surface is square to the laser's axis, Z stays: the pixel follows the sheet as both move Z alike.
        result[:, 7] = np.abs(per_mm[:, 2] * sigma / per_px)
        return result, found.status[:count]

    return exact


def slopes_of_brightness(
    frame: np.ndarray, line: np.ndarray, amplitude: np.ndarray, stage_mm: np.ndarray, exposure_ms: np.ndarray
) -> np.ndarray:
    """Slope (N,) per mm of the stage of the logarithm of a scan's stripe amplitudes; 0 where it is unknown.

    It is unknown everywhere if a 3D camera does not give all amplitudes.

    A plane is fitted to the logarithms of all neighbours, so that noise and speckle of the single ones hardly count.
    ``amplitude`` (N,) is positive, ``stage_mm`` and ``exposure_ms`` (F,) are those of every image, in any order; where
    an exposure is not known, all are taken as equal.
    """
    if not np.isfinite(amplitude).all():
        return np.zeros(len(frame))
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
    return _slopes_by_position(row_of[frame], line, bright, position, rows=reach)


def footprint_std(uncertainty: Uncertainty) -> float:
    """Relative standard uncertainty of the squares of `footprint_mm`: by the sheet's thickness and the method."""
    return math.hypot(beside_std(uncertainty), _METHOD_STD)


def beside_std(uncertainty: Uncertainty) -> float:
    """Relative standard uncertainty of `LitSheet.beside`, which goes with the square of the sheet's thickness."""
    return 2.0 * uncertainty.sheet_thickness


def sheet_sigma_mm(laser: Laser, distance_mm: np.ndarray, *, medium_index: float) -> np.ndarray:
    """Standard deviation of the sheet's profile, mm, so far from the laser in a medium, as described.

    Half the 1/e2 radius w, with w^2 = w0^2 (1 + ((z - z0) / zR)^2), zR = pi w0^2 n / (M2 lambda) (Siegman, Lasers, Eqs.
    17.5 and 17.6, with the beam quality M2).
    """
    waist = laser.waist_radius_mm
    rayleigh = math.pi * waist**2 * medium_index / (laser.beam_quality_m2 * 1e-6 * laser.wavelength_nm)
    return 0.5 * waist * np.sqrt(1.0 + ((distance_mm - laser.waist_distance_mm) / rayleigh) ** 2)


def moved_by_blur_px(
    frame: np.ndarray, line: np.ndarray, centre_px: np.ndarray, amplitude: np.ndarray, width_px: np.ndarray
) -> np.ndarray:
    """Shift (N,) of stripe centres that blur may cause, px, by their neighbours in the same image.

    A stripe y(x), blurred by the standard deviation b in all directions, is seen at E[y(x - e) A(x - e)] / E[A(x - e)]
    with e of that deviation: beside y(x) by b^2 (y' (ln A)' + y'' / 2) to second order. The stripe's width squared,
    less what it owes to leaning, stands for b^2, of which it is the largest possible value.
    """
    if np.any((frame[1:] < frame[:-1]) | ((frame[1:] == frame[:-1]) & (line[1:] < line[:-1]))):
        order, moved = np.lexsort((line, frame)), np.empty(len(line))
        columns = frame, line, centre_px, amplitude, width_px
        moved[order] = moved_by_blur_px(*(column[order] for column in columns))
        return moved
    lean = _slopes_along(frame, line, centre_px, _BEND_LINES)
    bend = _slopes_along(frame, line, lean, _BEND_LINES)
    fading = _slopes_along(frame, line, np.log(amplitude), _LINES)
    variance = (width_px / FWHM_PER_SIGMA) ** 2 / (1.0 + lean**2)
    return variance * (lean * fading + 0.5 * bend)


def sharp_lines(stripes: CaptureStripes) -> tuple[np.ndarray, np.ndarray]:
    """Numbers (M,) of the stripe centres that blur hardly moves, and by how much it may, px.

    All of them, and 0, if a 3D camera does not give all amplitudes and widths, by which it is known.
    """
    if len(stripes.line) == 0:
        return np.empty(0, np.intp), np.empty(0)
    if not (np.isfinite(stripes.amplitude).all() and np.isfinite(stripes.width_px).all()):
        return np.arange(len(stripes.line)), np.zeros(len(stripes.line))
    moved = moved_by_blur_px(stripes.frame, stripes.line, stripes.centre_px, stripes.amplitude, stripes.width_px)
    sharp = np.flatnonzero(np.abs(moved) < _MOST_BLUR_PX)
    return sharp, moved[sharp]


def _slopes_along(frame: np.ndarray, line: np.ndarray, values: np.ndarray, reach: int) -> np.ndarray:
    """Slopes (N,) by line of straight lines through the values so many lines around, of images in order."""
    slopes = np.zeros(len(line))
    _fit_lines(frame, line, np.ascontiguousarray(values, dtype=float), reach, slopes)
    return slopes


@compiled
def _fit_lines(frame: np.ndarray, line: np.ndarray, values: np.ndarray, reach: int, slopes: np.ndarray) -> None:
    """Fill the slopes (N,) that are known; sums over the window are running ones."""
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


def _slopes_by_position(
    row: np.ndarray, column: np.ndarray, values: np.ndarray, position: np.ndarray, *, rows: int
) -> np.ndarray:
    """Slopes (N,) by position of planes fitted to the values within so many rows."""
    first = column.min()
    shape = len(position), int(column.max() - first) + 1
    there, z, slopes = np.zeros(shape, np.bool_), np.zeros(shape), np.zeros(shape)
    place = row * shape[1] + (column - first)
    there.ravel()[place] = True
    z.ravel()[place] = values - values.mean()
    # Images taken nearly at one place do not show the slope across it.
    least = max(0.15 * (np.median(position[rows:] - position[:-rows]) / rows) ** 2, _LEAST_APART_MM**2)
    _fit_planes(there, z, position - position.mean(), rows, _LINES, least, slopes)
    return slopes.ravel()[place]


@compiled_with_arrays
def _fit_planes(
    there: np.ndarray, z: np.ndarray, s: np.ndarray, rows: int, columns: int, least: float, slopes: np.ndarray
) -> None:
    """Slopes (F, L) of planes through the values z (F, L) that are there, at positions s (F,), 0 where unknown.

    The sums over the window are running ones, first along a row and then from row to row.
    """
    count, width = there.shape
    along = np.zeros((count, 5, width))
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
    size = (2 * rows + 1) * (2 * columns + 1)
    total = np.zeros((9, width))
    for k in range(count + rows):
        for row, sign in ((k, 1.0), (k - 2 * rows - 1, -1.0)):
            if 0 <= row < count:
                for at in range(width):
                    n, x1, z1 = sign * along[row, 0, at], sign * along[row, 1, at], sign * along[row, 3, at]
                    total[0, at] += n
                    total[1, at] += x1
                    total[2, at] += sign * along[row, 2, at]
                    total[3, at] += z1
                    total[4, at] += sign * along[row, 4, at]
                    total[5, at] += s[row] * n
                    total[6, at] += s[row] * s[row] * n
                    total[7, at] += s[row] * x1
                    total[8, at] += s[row] * z1
        if k < rows:
            continue
        for at in range(width):
            n = total[0, at]
            if not there[k - rows, at] or n <= _LEAST_SHARE * size:
                continue
            mx, mz, ms = total[1, at] / n, total[3, at] / n, total[5, at] / n
            xx, xz = total[2, at] / n - mx * mx, total[4, at] / n - mx * mz
            if xx <= 1.0:
                continue
            ss, sx, sz = total[6, at] / n - ms * ms, total[7, at] / n - ms * mx, total[8, at] / n - ms * mz
            of_both = ss * xx - sx * sx
            if least < ss < _REACH_MM**2 and of_both > 1e-3 * ss * xx:
                slopes[k - rows, at] = (sz * xx - xz * sx) / of_both
