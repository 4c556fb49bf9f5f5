"""Uncertainty of measured points: by the stripe's own noise, and by the calibration that all of them share.

GUM (JCGM 100:2008), section 5: the law of propagation, linear in the stripe's centre and in the calibration's
parameters. What the calibration leaves open moves all points together. It is kept as patterns: each moves every point
by one standard deviation of something that is independent of all other patterns, so that a figure's uncertainty
follows, correlations included, from calculating it again with each pattern added.
"""

from functools import partial
from hashlib import sha256
from itertools import pairwise

import numpy as np

from uwlts.calibration.joint.residuals import STRIPE
from uwlts.calibration.joint.scanned_surfaces import SLOPES, across_of
from uwlts.calibration.joint.stored_estimate import StoredEstimate, covariance_root, require_joint, stored_estimate
from uwlts.errors import CalibrationError
from uwlts.files.writing import sha256_of
from uwlts.fitting.least_squares import MAD_TO_STD
from uwlts.model.any_calibration import calibration_digest
from uwlts.model.calibration import Calibration
from uwlts.model.parameter_keys import StageParameter
from uwlts.optics.brightness import BLUR_STD, beside_std
from uwlts.optics.line_table import LineTable, sum_terms
from uwlts.reconstruction.path_uncertainty import chief_parts
from uwlts.runtime.compiled import compiled
from uwlts.storage.capture import Capture, CaptureHeader, FrameTable, sensor_poses
from uwlts.storage.cloud import WATER, PointUncertainty

# Patterns that together move the points by no more than this (root mean square) are left out.
_NEGLIGIBLE_MM = 5e-5
# Centres between two neighbours from which noise is measured: its relative standard error is then a third.
_FEWEST_NEIGHBOURS = 10
# Points by which patterns are chosen: their root mean square is within some percent that of all.
_SAMPLED = 500
_TABLE_TOLERANCE_MM = 1e-6
"""Error of tabulated moves of points: far below any of them that matters."""
_LEFT_OUT_MM = 1e-9
"""Sum of the last terms of tables that may be left out."""


def stripe_noise_px(frame: np.ndarray, line: np.ndarray, centre_px: np.ndarray) -> np.ndarray:
    """Standard deviation (N,) of stripe centres, from how they scatter about their neighbours in the same image.

    The centre of a line less the mean of its two neighbours has 3/2 of the variance of one, where the surface is
    smooth; edges and outliers do not count, as half the lines would have to hold some. Images with few lines take the
    value of all.
    """
    f, at, c = frame, line, centre_px.astype(np.float64)
    if np.any((f[1:] < f[:-1]) | ((f[1:] == f[:-1]) & (at[1:] < at[:-1]))):
        order = np.lexsort((line, frame))
        f, at, c = frame[order], line[order], c[order]
    beside = (f[2:] == f[:-2]) & (at[2:] - at[:-2] == 2)
    off, image = np.abs(c[1:-1] - 0.5 * (c[2:] + c[:-2]))[beside], f[1:-1][beside]
    if len(off) < _FEWEST_NEIGHBOURS:
        raise CalibrationError(f"only {len(off)} stripe centres have two neighbours: too few to measure their noise")
    scale = MAD_TO_STD / np.sqrt(1.5)
    noise = np.full(int(frame.max()) + 1, np.nan)
    starts = np.flatnonzero(np.r_[True, image[1:] != image[:-1], True])
    for start, end in pairwise(starts.tolist()):
        if end - start >= _FEWEST_NEIGHBOURS:
            noise[image[start]] = scale * _median(off[start:end])
    if (few := np.isnan(noise)).any():
        noise[few] = scale * _median(off)
    return noise[frame]


def _median(values: np.ndarray) -> float:
    """Median of values that are finite; NumPy's own takes several times as long for a few hundred."""
    middle = [(len(values) - 1) // 2, len(values) // 2]
    low, high = np.partition(values, middle)[middle].tolist()
    return 0.5 * (low + high)


def point_uncertainty(
    capture: Capture | FrameTable,
    calibration: Calibration,
    frame: np.ndarray,
    line: np.ndarray,
    centre_px: np.ndarray,
    *,
    blur_px: np.ndarray | None = None,
    beside_mm: np.ndarray | None = None,
    mount_by: np.ndarray | None = None,
    digest: str | None = None,
) -> PointUncertainty:
    """Uncertainty of the points that stripe centres (N,) of a capture give by a joint calibration.

    In the OCS, or in the scene where the frames carry poses. What the stage does by its positions, scale and direction
    is part of it, about the middle of its positions; what poses add is not (`uwlts.reconstruction.moving`). The water
    may have drifted since the calibration, unless that was made from this very capture. ``blur_px`` (N,), how far blur
    may move the centres, and ``beside_mm`` (N, 3), how far points were moved to where their light comes from
    (`uwlts.optics.brightness`), are each wrong by some share, the same for all points. ``mount_by`` (6, P) are
    derivatives of the mount by the parameters of the joint estimate (`uwlts.model.mount.SensorShare`), where the frames
    carry poses of a platform: what the calibration does to points and mount then belongs together. ``digest`` is
    that of the calibration where it is known.

    Raises
    ------
    CalibrationError
        The calibration holds no joint estimate, or the points cannot be reconstructed by it.
    """
    header = capture.header
    sensor = header.sensor
    scans = {scan.sha256 for scan in calibration.origin().scan_captures if scan.file == capture.path.name}
    if scans and sha256_of(capture.path) in scans:
        sensor = sensor.model_copy(update={"uncertainty": sensor.uncertainty.model_copy(update={"drift_k": 0.0})})
    known = stored_estimate(calibration, sensor, header.medium)
    # Neighbours err together, so that they show only a part of the noise.
    shared = require_joint(calibration).shared_variance.get(STRIPE, 1.0)
    noise = stripe_noise_px(frame, line, centre_px) * float(np.sqrt(shared))
    of_sensor = sensor_poses(capture)
    pose = of_sensor[:, :3, :3]
    posed = np.all(np.isfinite(of_sensor), axis=(1, 2), keepdims=True)
    pose_of = np.where(posed, pose, np.eye(3))
    found = require_joint(calibration).covariance_matrix()
    root = np.zeros((len(known.covariance), 1 + len(found)))
    # What the medium's index adds to the estimate: its drift, or all of it in a medium that was not calibrated in.
    root[:, 0] = np.sqrt(np.maximum(np.diag(known.covariance) - np.pad(np.diag(found), (0, len(root) - len(found))), 0))
    root[: len(found), 1:] = covariance_root(found)
    by_stage_alone = ~posed[:, 0, 0]
    middle = np.mean(capture.stage_mm[by_stage_alone]) if by_stage_alone.any() else 0.0
    stage = np.where(by_stage_alone, capture.stage_mm - middle, 0.0)
    by_stage = stage_root(known, calibration, header, root)
    root = np.hstack([root, np.zeros((len(root), len(by_stage) - root.shape[1]))])
    rigid = (
        np.zeros((6, root.shape[1])) if mount_by is None else _in_sensor(mount_by, header) @ root[: mount_by.shape[1]]
    )
    exact = partial(_derivatives, known, root, rigid)
    of_estimate = tuple(array.tobytes() for array in (known.values, root, rigid))
    key = None if digest is None else ("uncertainty", digest, known.view, *of_estimate)
    table = LineTable.about(exact, line, centre_px, tolerance=_TABLE_TOLERANCE_MM, key=key)
    beside = np.zeros((len(line), 3)) if beside_mm is None else beside_std(header.sensor.uncertainty) * beside_mm
    blur = np.zeros(len(line)) if blur_px is None else BLUR_STD * blur_px

    def moved(some: slice, weights: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Covariance by noise (n, 6) of some points, and sums (M, n, 3) of their parts with weights (2 + R, M)."""
        # In each axis the derivative by the pixel first, as it is.
        of_parts = np.zeros((1 + len(by_stage), 1 + weights.shape[1]))
        of_parts[0, 0], of_parts[1:, 1:] = 1.0, weights[2:]
        of_axes, where = np.kron(np.eye(3), of_parts), (line[some], centre_px[some])
        if table is None:
            values = exact(*where) @ of_axes
            series, row, at = values[:, None], np.arange(len(values)), np.zeros(len(values))
        else:
            series, row, at = table.combined(of_axes).shortened(_LEFT_OUT_MM).series(*where)
        random, sums = np.empty((len(row), 6), np.float32), np.empty((weights.shape[1], len(row), 3), np.float32)
        image, error, by_blur, off = (np.ascontiguousarray(each[some]) for each in (frame, noise, blur, beside))
        of_blur, of_beside, of_stage = weights[0], weights[1], np.ascontiguousarray(by_stage.T @ weights[2:])
        room, images = np.empty(of_axes.shape[1]), (pose_of, stage, image)
        _move(series, row, at, *images, error, by_blur, off, of_blur, of_beside, of_stage, room, random, sums)
        return random, sums

    # What moves all points together is smooth, so that some of them show which patterns hold nearly all of it.
    few = slice(None, None, max(1, len(line) // _SAMPLED))
    sampled = moved(few, np.eye(2 + len(by_stage)))[1]
    weights = chief_parts(sampled, left_mm=_NEGLIGIBLE_MM)
    random, patterns = moved(slice(None), weights)
    if not np.isfinite(random).all():
        raise CalibrationError("a stripe centre has no point by the calibration's joint estimate")
    along = header.sensor.uncertainty.stage_position_mm * np.array(header.stage_direction)
    position = np.where(posed[:, :, 0], 0.0, along).astype(np.float32)
    position = position[frame] if posed.any() else np.broadcast_to(position[:1], (len(frame), 3))
    # All but blur is the sensor's, its stage's and its water's, whatever they scan in this medium.
    source = f"{digest or calibration_digest(calibration)} {header.medium_name} {header.stage_direction}"
    name = sha256(source.encode()).hexdigest()[:16]
    of_sensor_parts = np.delete(weights, [0, 2], axis=0)
    shared = {f"{WATER} {name}": weights[2:3].T, f"sensor {name}": of_sensor_parts.T}
    return PointUncertainty(random, position, patterns, shared=shared)


@compiled
def _move(
    series: np.ndarray,
    row: np.ndarray,
    at: np.ndarray,
    turns: np.ndarray,
    stage: np.ndarray,
    frame: np.ndarray,
    noise: np.ndarray,
    blur: np.ndarray,
    beside: np.ndarray,
    of_blur: np.ndarray,
    of_beside: np.ndarray,
    of_stage: np.ndarray,
    flat: np.ndarray,
    random: np.ndarray,
    sums: np.ndarray,
) -> None:
    """Fill ``random`` (N, 6), in the order of `PAIRS`, and ``sums`` (M, N, 3); ``flat`` (3 + 3 M,) is room to work in.

    ``series`` (L, n, 3 + 3 M) are of derivatives by the pixel across the stripe and of sums of the estimate's parts, in
    each axis; what images turn, blur, brightness beside the sheet (N, 3) and the stage add is ``of_...`` (M,) and
    (3, M) times that of the point.
    """
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


def _in_sensor(mount_by: np.ndarray, header: CaptureHeader) -> np.ndarray:
    """Derivatives (6, P) of a mount, shift and turn, along the axes of the sensor in place of the platform's."""
    turn = np.array(header.T_platform_sensor)[:3, :3]
    return np.vstack([turn.T @ mount_by[:3], turn.T @ mount_by[3:]])


def _derivatives(
    known: StoredEstimate, root: np.ndarray, rigid: np.ndarray, line: np.ndarray, centre_px: np.ndarray
) -> np.ndarray:
    """Derivatives (N, 3 (1 + R)), axis by axis, of points by the pixel across the stripe and independent parts.

    In the OCS. The parts are ``root`` (P, R), those of all parameters, and move the OCS by ``rigid`` (6, R), shift and
    turn. NaN where a centre has no point.
    """
    result = np.empty((len(line), 3, 1 + root.shape[1]))
    found = known.points_by(line, centre_px)
    if found is None:
        result[:] = np.nan
    else:
        points, by = found
        result[:, :, 0] = by[:, :, 0]
        result[:, :, 1:] = by[:, :, 1:] @ root
        if rigid.any():
            result[:, :, 1:] += rigid[:3] + np.cross(rigid[3:].T, points[:, None]).swapaxes(1, 2)
    return result.reshape(len(line), -1)


def stage_root(known: StoredEstimate, calibration: Calibration, header: CaptureHeader, root: np.ndarray) -> np.ndarray:
    """Motion of a point (R + E, 3) by independent parts for each mm that the stage has gone; OCS.

    What the estimate knows of the stage goes with its own parts, ``root`` (P, R). The others are as the sensor's
    description says, and the scale that was found, as it is not applied to scans.
    """
    described, uncertainty = np.array(header.stage_direction), header.sensor.uncertainty
    keys = known.parameters.keys
    found = calibration.stage_of(header.stage_direction)
    sign = 1.0 if found is None or found[1] else -1.0
    ways = dict(zip(SLOPES, sign * across_of(sign * described), strict=True)) | {StageParameter.SCALE: described}
    calibrated = [key for key in ways if key in keys and (key not in SLOPES or found is not None)]
    lean = uncertainty.stage_lean()
    std = dict.fromkeys(SLOPES, lean) | {StageParameter.SCALE: uncertainty.stage_scale}
    within = sum((np.outer(root[keys.index(key)], ways[key]) for key in calibrated), np.zeros((root.shape[1], 3)))
    besides = [std[key] * way for key, way in ways.items() if key not in calibrated]
    besides.append(known.parameters.value(known.values, StageParameter.SCALE) * described)
    return np.vstack([within, *besides])
