"""Uncertainty of measured points by stripe noise and by the calibration.

The propagation is linear in the stripe centre and in the calibration parameters (GUM, JCGM 100:2008, section 5). Errors
of the calibration are common to all points. They are stored as mutually independent patterns, each the shift of all
points for one standard deviation. To obtain the uncertainty of a figure including correlations, recalculate the figure
with each pattern added to the points.
"""

from functools import partial
from hashlib import sha256
from itertools import pairwise

import numpy as np

from uwlts.calibration.joint.scanned_surfaces import SLOPES, perpendicular_directions
from uwlts.calibration.joint.stored_estimate import StoredEstimate, read_stored_estimate, require_joint
from uwlts.errors import CalibrationError
from uwlts.files.writing import hash_file
from uwlts.fitting.least_squares import MAD_TO_STD
from uwlts.fitting.next_observation import CovarianceRoot
from uwlts.model.calibration import Calibration, calibration_digest
from uwlts.model.parameter_keys import StageParameter
from uwlts.model.sensor import Sensor
from uwlts.optics.brightness import BLUR_STD, brightness_shift_std
from uwlts.optics.line_table import LineTable, sum_terms
from uwlts.reconstruction.moving import ErrorPatterns, principal_components
from uwlts.runtime.compiled import compiled
from uwlts.storage.capture import Capture, CaptureHeader, FrameTable, sensor_poses
from uwlts.storage.cloud import WATER, PointUncertainty

_NEGLIGIBLE_MM = 5e-5
"""Largest rms shift of the points by all omitted patterns together."""
_FEWEST_NEIGHBOURS = 10
"""Least number of centres with two neighbours for the noise, whose relative standard error is then one third."""
_MEAN_LINES = 4
"""Lines of means: as many as speckle and filters correlate. The form of a sphere or pit is seen in longer means."""
_FEWEST_MEANS = 40
"""Least number of differences of means; one in four is independent."""
_NEIGHBOUR_SCALE = float(MAD_TO_STD / np.sqrt(1.5))
"""Standard deviation of a centre, divided by the median distance from the mean of its neighbours."""
MOST_CORRELATED = 4.0
"""Largest factor for correlated noise: 1.0 to 1.3 on rendered stripes, 1.3 to 1.7 on real ones of an industrial camera,
3.4 after averaging over five lines. Larger ratios are of a wavy surface or of a camera that smooths its images."""
_SAMPLED = 500
"""Number of points used to choose patterns: their rms agrees with that of all within some percent."""
_TABLE_TOLERANCE_MM = 1e-6
"""Error of tabulated shifts, far below any relevant shift."""
_LEFT_OUT_MM = 1e-9
"""Largest sum of omitted last terms of tables."""
_PULL = [2.0, 3.0], [0.12, 0.0]
"""Full widths at half maximum, px, and largest errors of simulated stripes in speckle relative to the noise."""
_LARGEST_NOISE_PX = 0.2  # noise above which a centre does not determine its place in the pixel
_Arrays = tuple[np.ndarray, np.ndarray, np.ndarray]


def estimate_stripe_noise_px(frame: np.ndarray, line: np.ndarray, centre_px: np.ndarray) -> np.ndarray:
    """Estimate the noise (N,) of stripe centres: the standard deviation of independent centres with equal means.

    On a smooth surface, the centre minus the mean of its two neighbours has 3/2 of the variance of one centre. The
    median makes the estimate robust against edges and outliers. Images with few lines receive the value of all images.

    Speckle, texture and the camera's processing give neighbours similar errors: these differences are small, and means
    scatter more than those of independent centres. Therefore the estimate is multiplied by `measure_correlation` of all
    images, up to `MOST_CORRELATED`.
    """
    f, at, c, off, image = _compare_neighbours(frame, line, centre_px)
    scale = _NEIGHBOUR_SCALE * min(_correlate(f, at, c, off), MOST_CORRELATED)
    noise = np.full(int(frame.max()) + 1, np.nan)
    starts = np.flatnonzero(np.r_[True, image[1:] != image[:-1], True])
    for start, end in pairwise(starts.tolist()):
        if end - start >= _FEWEST_NEIGHBOURS:
            noise[image[start]] = scale * _find_median(off[start:end])
    if (few := np.isnan(noise)).any():
        noise[few] = scale * _find_median(off)
    return noise[frame]


def measure_correlation(frame: np.ndarray, line: np.ndarray, centre_px: np.ndarray) -> float:
    """Return the noise of means of `_MEAN_LINES` neighbouring centres relative to that of independent ones, at least 1.

    It is 1 for too few centres. The third difference of means of neighbouring lines has 20 times the variance of one
    mean. Parabolas have none.
    """
    return _correlate(*_compare_neighbours(frame, line, centre_px)[:4])


def _compare_neighbours(
    frame: np.ndarray, line: np.ndarray, centre_px: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Sort centres (N,) by image and line; return them, distances (M,) from the mean of two neighbours, and images."""
    f, at, c = frame, line, centre_px.astype(np.float64)
    if np.any((f[1:] < f[:-1]) | ((f[1:] == f[:-1]) & (at[1:] < at[:-1]))):
        order = np.lexsort((line, frame))
        f, at, c = frame[order], line[order], c[order]
    beside = (f[2:] == f[:-2]) & (at[2:] - at[:-2] == 2)
    off = np.abs(c[1:-1] - 0.5 * (c[2:] + c[:-2]))[beside]
    if len(off) < _FEWEST_NEIGHBOURS:
        raise CalibrationError(
            f"only {len(off)} stripe centres have two neighbours; {_FEWEST_NEIGHBOURS} are needed to measure noise"
        )
    return f, at, c, off, f[1:-1][beside]


def _correlate(frame: np.ndarray, line: np.ndarray, centre_px: np.ndarray, off: np.ndarray) -> float:
    """Return `measure_correlation` of sorted centres (N,) with distances (M,) from the means of two neighbours."""
    count, usual = 4 * _MEAN_LINES, _find_median(off)
    if len(line) < count or usual <= 0:
        return 1.0
    whole = (frame[count - 1 :] == frame[: 1 - count]) & (line[count - 1 :] - line[: 1 - count] == count - 1)
    if np.count_nonzero(whole) < _FEWEST_MEANS:
        return 1.0
    weights = np.repeat([1.0, -3.0, 3.0, -1.0], _MEAN_LINES) / _MEAN_LINES
    third = np.abs(np.convolve(centre_px, weights, mode="valid")[whole])
    return max(1.0, float(np.sqrt(_MEAN_LINES / 20)) * MAD_TO_STD * _find_median(third) / (_NEIGHBOUR_SCALE * usual))


def _find_median(values: np.ndarray) -> float:
    """Return the median of finite values; several times faster than NumPy's for a few hundred values."""
    middle = [(len(values) - 1) // 2, len(values) // 2]
    low, high = np.partition(values, middle)[middle].tolist()
    return 0.5 * (low + high)


def estimate_pull_px(centre_px: np.ndarray, width_px: np.ndarray | float, noise_px: np.ndarray) -> np.ndarray:
    """Estimate errors (N,) of narrow stripes' centres with their place in the pixel; their common sign is unknown."""
    # Normal noise of standard deviation s lowers the mean sine of measured centres by exp(-2 pi^2 s^2).
    lowered = np.exp(-2 * np.pi**2 * np.minimum(noise_px, _LARGEST_NOISE_PX) ** 2)
    return np.interp(width_px, *_PULL) * noise_px * np.sin(2 * np.pi * centre_px) / lowered


def point_uncertainty(
    capture: Capture | FrameTable,
    calibration: Calibration,
    centres: _Arrays,
    *,
    width_px: np.ndarray | float = np.inf,
    blur_px: np.ndarray | float = 0.0,
    beside_mm: np.ndarray | float = 0.0,
    mount_by: np.ndarray | None = None,
    chosen: ErrorPatterns | None = None,
) -> PointUncertainty:
    """Calculate the uncertainty of points from stripe centres (N,) and a joint calibration.

    It refers to the OCS of the true laser and camera axes, or to the scene for frames with poses. It includes errors of
    the stage's position, scale and direction about its central position, and drift of the water since the calibration,
    unless the calibration uses this capture. It excludes errors of poses (`uwlts.reconstruction.moving`).

    ``centres`` are image, profile line and position in px of each stripe centre, ``width_px`` (N,) full widths at half
    maximum. ``blur_px`` (N,) are possible shifts of the centres by blur, ``beside_mm`` (N, 3) applied shifts of the
    points to the origin of their light (`uwlts.optics.brightness`). Their relative errors are common to all points.

    ``mount_by`` (6, P) are the derivatives of a calibrated mount by the parameters of the joint estimate
    (`uwlts.model.mount.SensorShare`), for frames with poses of a platform. They correlate the errors of points and
    mount. By default poses and described mount, or the stage, place the true OCS, from which the calibrated one differs
    by the errors of camera axis and sheet. Parts of one cloud have the patterns ``chosen`` in common.

    CalibrationError if the calibration has no joint estimate, or cannot reconstruct the points.
    """
    header, (frame, line, centre_px) = capture.header, centres
    sensor = header.sensor
    scans = {scan.sha256 for scan in calibration.origin().scan_captures if scan.file == capture.path.name}
    if scans and hash_file(capture.path) in scans:
        sensor = sensor.model_copy(update={"uncertainty": sensor.uncertainty.model_copy(update={"drift_k": 0.0})})
    known = read_stored_estimate(calibration, sensor, header.medium)
    noise = estimate_stripe_noise_px(frame, line, centre_px)
    of_sensor = sensor_poses(capture)
    posed = np.all(np.isfinite(of_sensor), axis=(1, 2), keepdims=True)
    pose_of = np.where(posed, of_sensor[:, :3, :3], np.eye(3))
    by_stage_alone = ~posed[:, 0, 0]
    middle = np.mean(capture.stage_mm[by_stage_alone]) if by_stage_alone.any() else 0.0
    stage = np.where(by_stage_alone, capture.stage_mm - middle, 0.0)
    root, by_stage = independent_components(known, calibration, header)
    frame_by = -known.frame_by
    if mount_by is not None:
        # Translation and rotation, from platform axes to sensor axes.
        frame_by = np.vstack(
            [np.array(header.T_platform_sensor)[:3, :3].T @ part for part in (mount_by[:3], mount_by[3:])]
        )
    rigid = frame_by @ root[: frame_by.shape[1]]
    rigid[0, -1] = window_shift_std_mm(sensor) if mount_by is None else 0.0
    exact = partial(_compute_derivatives, known, root, rigid)
    of_estimate = tuple(array.tobytes() for array in (known.values, root, rigid))
    key = ("uncertainty", calibration_digest(calibration), known.view, *of_estimate)
    table = LineTable.over_range(exact, line, centre_px, tolerance=_TABLE_TOLERANCE_MM, key=key)
    beside = np.zeros((len(line), 3)) + brightness_shift_std(header.sensor.uncertainty) * beside_mm
    # Blur shifts the centres on steep surfaces, the place in the pixel those on level ones: they share a pattern.
    shift = BLUR_STD * blur_px + estimate_pull_px(centre_px, width_px, noise)

    def moved(some: slice, weights: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return the noise covariance (n, 6) of some points, and weighted sums (M, n, 3) of their error components."""
        # The first column of each axis is the unweighted derivative by the pixel.
        of_parts = np.zeros((1 + len(by_stage), 1 + weights.shape[1]))
        of_parts[0, 0], of_parts[1:, 1:] = 1.0, weights[2:]
        of_axes, where = np.kron(np.eye(3), of_parts), (line[some], centre_px[some])
        if table is None:
            values = exact(*where) @ of_axes
            series, row, at = values[:, None], np.arange(len(values)), np.zeros(len(values))
        else:
            series, row, at = table.combine(of_axes).shorten(_LEFT_OUT_MM).series(*where)
        random, sums = np.empty((len(row), 6), np.float32), np.empty((weights.shape[1], len(row), 3), np.float32)
        image, error, by_shift, off = (np.ascontiguousarray(each[some]) for each in (frame, noise, shift, beside))
        factors = weights[0], weights[1], np.ascontiguousarray(by_stage.T @ weights[2:])
        errors, images, room = (error, by_shift, off), (pose_of, stage, image), np.empty(of_axes.shape[1])
        _fill_errors((series, row, at), images, errors, factors, room, random, sums)
        return random, sums

    # Patterns are smooth over the points, so that a sample determines the principal ones.
    chosen = ErrorPatterns() if chosen is None else chosen
    if chosen.of_sensor is None:
        sampled = moved(slice(None, None, max(1, len(line) // _SAMPLED)), np.eye(2 + len(by_stage)))[1]
        chosen.of_sensor = principal_components(sampled, left_mm=_NEGLIGIBLE_MM)
    weights = chosen.of_sensor
    random, patterns = moved(slice(None), weights)
    if not np.isfinite(random).all():
        raise CalibrationError("the calibration's joint estimate gives no point for some stripe centre")
    along = header.sensor.uncertainty.stage_position_mm * np.array(header.stage_direction)
    position = np.where(posed[:, :, 0], 0.0, along).astype(np.float32)
    position = position[frame] if posed.any() else np.broadcast_to(position[:1], (len(frame), 3))
    # Except for shifts of the centres, the errors of sensor, stage and water are common to all scans in this medium.
    source = f"{calibration_digest(calibration)} {header.medium_name} {header.stage_direction}"
    name = sha256(source.encode()).hexdigest()[:16]
    shared = {f"{WATER} {name}": weights[2:3].T, f"sensor {name}": np.delete(weights, [0, 2], axis=0).T}
    return PointUncertainty(random, position, patterns, shared=shared)


@compiled
def _fill_errors(
    table: _Arrays,
    images: _Arrays,
    errors: _Arrays,
    factors: _Arrays,
    flat: np.ndarray,
    random: np.ndarray,
    sums: np.ndarray,
) -> None:
    """Fill ``random`` (N, 6), in the order of `PAIRS`, and ``sums`` (M, N, 3); ``flat`` (3 + 3 M,) is a work array.

    ``table`` are series (L, n, 3 + 3 M), and row and place (N,) of each point. The series represent, for each axis, the
    derivative by the pixel across the stripe and the weighted sums of the estimate's error components. ``images`` are
    rotations (F, 3, 3) and stage positions (F,) of the images, and the image (N,) of each point. ``errors`` are noise
    and shift (N,) in px, and brightness shift (N, 3). ``factors``, (M,), (M,) and (3, M), are those of blur, brightness
    shift and stage in the sums.
    """
    series, row, at = table
    turns, stage, frame = images
    noise, blur, beside = errors
    of_blur, of_beside, of_stage = factors
    count = sums.shape[0]
    value = flat.reshape(3, 1 + count)
    for n in range(row.size):
        sum_terms(series[row[n]], at[n], flat)
        turn, far = turns[frame[n]], stage[frame[n]]
        if turn[0, 0] != 1.0 or turn[1, 1] != 1.0:
            for m in range(1 + count):
                a, b, c = value[0, m], value[1, m], value[2, m]
                for axis in range(3):
                    value[axis, m] = turn[axis, 0] * a + turn[axis, 1] * b + turn[axis, 2] * c
        x, y, z = value[0, 0] * noise[n], value[1, 0] * noise[n], value[2, 0] * noise[n]
        random[n, 0], random[n, 1], random[n, 2] = x * x, x * y, x * z
        random[n, 3], random[n, 4], random[n, 5] = y * y, y * z, z * z
        for axis in range(3):
            of_all, moved, by_stage = value[axis], value[axis, 0] * blur[n], of_stage[axis]
            for m in range(count):
                of_all[1 + m] += moved * of_blur[m] + beside[n, axis] * of_beside[m] + by_stage[m] * far
        for m in range(count):
            sums[m, n, 0], sums[m, n, 1], sums[m, n, 2] = value[0, 1 + m], value[1, 1 + m], value[2, 1 + m]


def independent_components(
    known: StoredEstimate, calibration: Calibration, header: CaptureHeader
) -> tuple[np.ndarray, np.ndarray]:
    """Return the independent error components of an estimate and a stage.

    They are changes of the parameters (P, M) and shifts (M, 3) of a point per mm of stage travel, in the OCS. The first
    is the additional error of the medium's index, by its drift or in a medium without calibration. The last ones change
    no parameter.
    """
    found = require_joint(calibration).covariance_matrix()
    root = np.zeros((len(known.covariance), 1 + len(found)))
    root[:, 0] = np.sqrt(np.maximum(np.diag(known.covariance) - np.pad(np.diag(found), (0, len(root) - len(found))), 0))
    root[: len(found), 1:] = CovarianceRoot.from_covariance(found).root
    by_stage = np.vstack([stage_components(known, calibration, header, root), np.zeros(3)])
    return np.hstack([root, np.zeros((len(root), len(by_stage) - root.shape[1]))]), by_stage


def window_shift_std_mm(sensor: Sensor) -> float:
    """Return the standard uncertainty of the sheet's offset from the laser's axis by the tilt of the laser's window.

    A plate of thickness t and index n that is tilted by a small angle shifts a ray by t (1 - 1 / n) times that angle.
    """
    window, tilt = sensor.laser.window, np.radians(sensor.uncertainty.laser_window_tilt_deg)
    return window.thickness_mm * (1 - 1 / window.index(sensor.laser.wavelength_nm)) * tilt if window.mounted else 0.0


def _compute_derivatives(
    known: StoredEstimate, root: np.ndarray, rigid: np.ndarray, line: np.ndarray, centre_px: np.ndarray
) -> np.ndarray:
    """Return the derivatives (N, 3 (1 + R)) of points by the pixel across the stripe and independent components.

    They are ordered by axis of the OCS. ``root`` (P, R) are the components of the parameters, which move the OCS by
    ``rigid`` (6, R), translation and rotation. The result is NaN for a centre without a point.
    """
    result = np.empty((len(line), 3, 1 + root.shape[1]))
    found = known.triangulate(line, centre_px)
    if found is None:
        result[:] = np.nan
    else:
        points, by = found
        result[:, :, 0] = by[:, :, 0]
        result[:, :, 1:] = by[:, :, 1:] @ root
        result[:, :, 1:] += rigid[:3] + np.cross(rigid[3:].T, points[:, None]).swapaxes(1, 2)
    return result.reshape(len(line), -1)


def stage_components(
    known: StoredEstimate, calibration: Calibration, header: CaptureHeader, root: np.ndarray
) -> np.ndarray:
    """Return the shift (R + E, 3) of a point per mm of stage travel by independent error components, in the OCS.

    Estimated stage parameters vary with the components ``root`` (P, R) of the estimate. All others have the uncertainty
    of the sensor's description. The estimated scale counts as an error, since it is not applied to scans.
    """
    described, uncertainty = np.array(header.stage_direction), header.sensor.uncertainty
    keys = known.parameters.keys
    found = calibration.stage_of(header.stage_direction)
    sign = 1.0 if found is None or found[1] else -1.0
    ways = dict(zip(SLOPES, sign * perpendicular_directions(sign * described), strict=True)) | {
        StageParameter.SCALE: described
    }
    calibrated = [key for key in ways if key in keys and (key not in SLOPES or found is not None)]
    std = dict.fromkeys(SLOPES, uncertainty.stage_lean()) | {StageParameter.SCALE: uncertainty.stage_scale}
    within = sum((np.outer(root[keys.index(key)], ways[key]) for key in calibrated), np.zeros((root.shape[1], 3)))
    if found is not None:
        # An estimated direction turns with the OCS, a described one does not.
        within = within - np.cross((known.frame_by[3:] @ root).T, described)
    besides = [std[key] * way for key, way in ways.items() if key not in calibrated]
    besides.append(known.parameters.value(known.values, StageParameter.SCALE) * described)
    return np.vstack([within, *besides])
