"""Uncertainty of measured points: by the stripe's own noise, and by the calibration that all of them share.

GUM (JCGM 100:2008), section 5: the law of propagation, linear in the stripe's centre and in the calibration's
parameters. What the calibration leaves open moves all points together. It is kept as patterns: each moves every point
by one standard deviation of something that is independent of all other patterns, so that a figure's uncertainty
follows, correlations included, from calculating it again with each pattern added.
"""

from collections.abc import Callable

import numpy as np

from uwlts.calibration.joint.derivatives import COLUMNS
from uwlts.calibration.joint.evidence import STRIPE
from uwlts.calibration.joint.scanned_surfaces import SLOPES, across_of
from uwlts.calibration.joint.stored_estimate import StoredEstimate, covariance_root, require_joint, stored_estimate
from uwlts.metrology.least_squares import MAD_TO_STD
from uwlts.model.calibration import Calibration
from uwlts.model.errors import CalibrationError
from uwlts.model.parameter_keys import StageParameter
from uwlts.model.stripe import pixels_of
from uwlts.optics.brightness import BLUR_STD, beside_std
from uwlts.optics.line_table import LineTable
from uwlts.storage.capture import Capture, CaptureHeader, FrameTable
from uwlts.storage.cloud import PAIRS, PointUncertainty
from uwlts.storage.files import sha256_of

_BLOCK = 20000
# Patterns that together move the points by no more than this (root mean square) are left out.
_NEGLIGIBLE_MM = 5e-5
_FEWEST_NEIGHBOURS = 10
_TABLE_TOLERANCE_MM = 1e-6


def stripe_noise_px(frame: np.ndarray, line: np.ndarray, centre_px: np.ndarray) -> np.ndarray:
    """Standard deviation (N,) of stripe centres, from how they scatter about their neighbours in the same image.

    The centre of a line less the mean of its two neighbours has 3/2 of the variance of one, where the surface is
    smooth; edges and outliers do not count, as half the lines would have to hold some. Images with few lines take the
    value of all.
    """
    order = np.lexsort((line, frame))
    f, at, c = frame[order], line[order], centre_px[order].astype(np.float64)
    beside = (f[2:] == f[:-2]) & (at[2:] - at[:-2] == 2)
    off, image = np.abs(c[1:-1] - 0.5 * (c[2:] + c[:-2]))[beside], f[1:-1][beside]
    if len(off) < _FEWEST_NEIGHBOURS:
        raise CalibrationError(f"only {len(off)} stripe centres have two neighbours: too few to measure their noise")
    scale = MAD_TO_STD / np.sqrt(1.5)
    noise = np.full(int(frame.max()) + 1, scale * np.median(off))
    starts = np.flatnonzero(np.r_[True, image[1:] != image[:-1]])
    for number, values in zip(image[starts], np.split(off, starts[1:]), strict=True):
        if len(values) >= _FEWEST_NEIGHBOURS:
            noise[number] = scale * np.median(values)
    return noise[frame]


def point_uncertainty(
    capture: Capture | FrameTable,
    calibration: Calibration,
    frame: np.ndarray,
    line: np.ndarray,
    centre_px: np.ndarray,
    *,
    blur_px: np.ndarray | None = None,
    beside_mm: np.ndarray | None = None,
) -> PointUncertainty:
    """Uncertainty of the points that stripe centres (N,) of a capture give by a joint calibration.

    In the OCS, or in the scene where the frames carry poses. What the stage does by its positions, scale and direction
    is part of it, about the middle of its positions; what poses add is not. The water may have drifted since the
    calibration, unless that was made from this very capture. ``blur_px`` (N,), how far blur may move the centres, and
    ``beside_mm`` (N, 3), how far points were moved to where their light comes from (`uwlts.optics.brightness`), are
    each wrong by some share, the same for all points.

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
    pose = capture.pose[:, :3, :3]
    posed = np.all(np.isfinite(capture.pose), axis=(1, 2), keepdims=True)
    into_object = calibration.object_transform()[:3, :3].T
    into_scene = np.where(posed, pose, np.eye(3)) @ into_object
    root = covariance_root(known.covariance)
    stage = np.where(posed[:, 0, 0], 0.0, capture.stage_mm - np.mean(capture.stage_mm))
    by_stage = stage_root(known, calibration, header, root)
    root = np.hstack([root, np.zeros((len(root), len(by_stage) - root.shape[1]))])
    beside = beside_std(header.sensor.uncertainty)
    derivatives = _derivatives(known, root, line, centre_px, stripe_along=calibration.stripe_along)
    random, moved = [], []
    for start in range(0, len(line), _BLOCK):
        here = slice(start, start + _BLOCK)
        by_pixel, by_root = derivatives(line[here], centre_px[here])
        if posed.any():
            turned = into_scene[frame[here]]
            by_pixel, by_root = np.einsum("nij,nj->ni", turned, by_pixel), np.einsum("nij,rnj->rni", turned, by_root)
        else:
            by_pixel, by_root = by_pixel @ into_object.T, by_root @ into_object.T
        by_root += by_stage[:, None] * stage[frame[here], None]
        step = by_pixel * noise[here, None]
        random.append(np.stack([step[:, i] * step[:, j] for i, j in PAIRS], axis=1))
        if blur_px is not None:
            by_root = np.concatenate([by_root, [BLUR_STD * by_pixel * blur_px[here, None]]])
        if beside_mm is not None:
            by_root = np.concatenate([by_root, [beside * beside_mm[here]]])
        moved.append(by_root)
    along = np.array(header.stage_direction)
    position = np.where(posed[frame, :, 0], 0.0, header.sensor.uncertainty.stage_position_mm * along)
    return PointUncertainty(
        np.vstack(random).astype(np.float32),
        position.astype(np.float32),
        independent_patterns(np.concatenate(moved, axis=1)),
    )


def _derivatives(
    known: StoredEstimate, root: np.ndarray, line: np.ndarray, centre_px: np.ndarray, *, stripe_along: str
) -> Callable[[np.ndarray, np.ndarray], tuple[np.ndarray, np.ndarray]]:
    """Function of lines and centres like those given, for derivatives of their points in the camera frame.

    These are (N, 3) by the pixel across the stripe and (R, N, 3) by independent parts of all parameters.
    """
    column = COLUMNS.index("v" if stripe_along == "width" else "u")

    def exact(line: np.ndarray, centre_px: np.ndarray) -> np.ndarray:
        pixels = pixels_of(line, centre_px, stripe_along=stripe_along)
        points = known.parameters.on_sheet(known.values, known.view, pixels)
        if points is None:
            return np.full((len(line), 3 + 3 * root.shape[1]), np.nan)
        by_global = [
            known.parameters.by_global(points.by_rays[:, axis], known.view, points.by_sheet[:, axis]) @ root
            for axis in range(3)
        ]
        return np.hstack([points.by_rays[column].T, np.stack(by_global, axis=2).reshape(len(line), -1)])

    table = LineTable.about(exact, line, centre_px, tolerance=_TABLE_TOLERANCE_MM)

    def derivatives(line: np.ndarray, centre_px: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        values = exact(line, centre_px) if table is None else table.values(line, centre_px)
        if not np.isfinite(values).all():
            raise CalibrationError("a stripe centre has no point by the calibration's joint estimate")
        return values[:, :3], values[:, 3:].reshape(len(line), -1, 3).transpose(1, 0, 2)

    return derivatives


def independent_patterns(moved: np.ndarray) -> np.ndarray:
    """Patterns (M, N, 3), orthogonal over the points, from any (R, N, 3) that together have their covariance."""
    flat = moved.reshape(len(moved), -1)
    values, vectors = np.linalg.eigh(flat @ flat.T)
    order = np.argsort(values)[::-1]
    values, vectors = np.maximum(values[order], 0.0), vectors[:, order]
    left = np.append(np.cumsum(values[::-1])[::-1][1:], 0.0) / moved.shape[1]
    count = 1 + int(np.argmax(left <= _NEGLIGIBLE_MM**2))
    return (vectors[:, :count].T @ flat).reshape(count, *moved.shape[1:]).astype(np.float32)


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
