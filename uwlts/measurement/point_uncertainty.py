"""Uncertainty of measured points: by the stripe's own noise, and by the calibration that all of them share.

GUM (JCGM 100:2008), section 5: the law of propagation, linear in the stripe's centre and in the calibration's
parameters. What the calibration leaves open moves all points together. It is kept as patterns: each moves every point
by one standard deviation of something that is independent of all other patterns, so that a figure's uncertainty
follows, correlations included, from calculating it again with each pattern added.
"""

from collections.abc import Callable
from functools import partial

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
from uwlts.runtime.compiled import compiled
from uwlts.storage.capture import Capture, CaptureHeader, FrameTable, sensor_poses
from uwlts.storage.cloud import PointUncertainty
from uwlts.storage.files import sha256_of

_BLOCK = 20000
# Patterns that together move the points by no more than this (root mean square) are left out.
_NEGLIGIBLE_MM = 5e-5
_FEWEST_NEIGHBOURS = 10
# Parts of the parameters that move no point by more than this (root sum of squares over places) are joined with others.
_NOTHING_MM, _PLACES, _FEWEST_POINTS = 1e-7, 10, 2000
_TABLE_TOLERANCE_MM = 1e-6


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
    is part of it, about the middle of its positions; what poses add is not (`uwlts.measurement.moving`). The water may
    have drifted since the calibration, unless that was made from this very capture. ``blur_px`` (N,), how far blur may
    move the centres, and ``beside_mm`` (N, 3), how far points were moved to where their light comes from
    (`uwlts.optics.brightness`), are each wrong by some share, the same for all points.

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
    into_object = calibration.object_transform()[:3, :3].T
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
    exact = partial(_derivatives, known, stripe_along=calibration.stripe_along, turn=into_object)
    kept = _fewest_parts(exact, root, by_stage, line, centre_px, reach_mm=np.abs(stage).max(initial=0.0))
    root, by_stage = root @ kept, kept.T @ by_stage
    table = LineTable.about(
        lambda *where: exact(root, *where).reshape(len(where[0]), -1), line, centre_px, tolerance=_TABLE_TOLERANCE_MM
    )
    nothing = np.zeros((len(line), 3))
    beside = nothing if beside_mm is None else beside_std(header.sensor.uncertainty) * beside_mm
    blur = nothing[:, 0] if blur_px is None else BLUR_STD * blur_px
    random, moved = np.empty((len(line), 6), np.float32), np.empty((len(line), 3, 2 + root.shape[1]))
    for start in range(0, len(line), _BLOCK):
        here = slice(start, start + _BLOCK)
        parts, where = moved[here], (line[here], centre_px[here])
        if table is None:
            parts[:] = exact(root, *where)
        else:
            table.values(*where, out=parts.reshape(len(parts), -1))
        if posed.any():
            parts[:] = pose_of[frame[here]] @ parts
        _add_parts(parts, noise[here], stage[frame[here]], by_stage, blur[here], beside[here], random[here])
    if not np.isfinite(random).all():
        raise CalibrationError("a stripe centre has no point by the calibration's joint estimate")
    along = np.array(header.stage_direction)
    position = np.where(posed[frame, :, 0], 0.0, header.sensor.uncertainty.stage_position_mm * along)
    patterns, ways = _patterns(moved.reshape(-1, moved.shape[2]).T)
    # Of the water, of light beside the sheet, and of the calibration and stage; blur depends on what is scanned.
    whole = ways[2:].T @ kept.T
    shares = np.column_stack([whole[:, 0], ways[1], whole[:, 1:]])
    return PointUncertainty(random, position.astype(np.float32), patterns, shares=shares.astype(np.float32))


@compiled
def _add_parts(
    parts: np.ndarray,
    noise: np.ndarray,
    stage: np.ndarray,
    by_stage: np.ndarray,
    blur: np.ndarray,
    beside: np.ndarray,
    random: np.ndarray,
) -> None:
    """Add to ``parts`` (N, 3, 2 + R) what stage, blur and brightness beside the sheet do; fill ``random`` (N, 6).

    The first two parts, derivatives by the pixel across the stripe and room, become those of blur and brightness.
    """
    # In the order of `PAIRS`.
    for n in range(parts.shape[0]):
        x, y, z = parts[n, 0, 0] * noise[n], parts[n, 1, 0] * noise[n], parts[n, 2, 0] * noise[n]
        random[n, 0], random[n, 1], random[n, 2] = x * x, x * y, x * z
        random[n, 3], random[n, 4], random[n, 5] = y * y, y * z, z * z
        for axis in range(3):
            parts[n, axis, 0] *= blur[n]
            parts[n, axis, 1] = beside[n, axis]
            for r in range(by_stage.shape[0]):
                parts[n, axis, 2 + r] += by_stage[r, axis] * stage[n]


def _fewest_parts(
    exact: Callable[[np.ndarray, np.ndarray, np.ndarray], np.ndarray],
    root: np.ndarray,
    by_stage: np.ndarray,
    line: np.ndarray,
    centre_px: np.ndarray,
    *,
    reach_mm: float,
) -> np.ndarray:
    """Combinations (R, K) of the independent parts ``root`` (P, R), ``by_stage`` (R, 3) that move points the same.

    As few as `_NOTHING_MM` lets. Points move smoothly over the image, so that what some hundred places over all of it
    show holds for all of them.
    """
    if len(line) < _FEWEST_POINTS:
        return np.eye(root.shape[1])
    lines, places = (np.linspace(values.min(), values.max(), _PLACES) for values in (line, centre_px))
    at = np.meshgrid(lines, places)
    moved = exact(root, at[0].ravel(), at[1].ravel())[:, :, 2:]
    if not np.isfinite(moved).all():
        return np.eye(root.shape[1])
    together = np.vstack([moved.reshape(-1, root.shape[1]), reach_mm * by_stage.T])
    _, values, parts = np.linalg.svd(together, full_matrices=False)
    return parts[values > _NOTHING_MM].T


def _derivatives(
    known: StoredEstimate,
    root: np.ndarray,
    line: np.ndarray,
    centre_px: np.ndarray,
    *,
    stripe_along: str,
    turn: np.ndarray,
) -> np.ndarray:
    """Derivatives (N, 3, 2 + R) of points by the pixel across the stripe, 0, and independent parts of all parameters.

    ``turn`` (3, 3) turns them from the camera's frame; they are NaN where a centre has no point.
    """
    column = COLUMNS.index("v" if stripe_along == "width" else "u")
    pixels = pixels_of(line, centre_px, stripe_along=stripe_along)
    points = known.parameters.on_sheet(known.values, known.view, pixels)
    result = np.zeros((len(line), 3, 2 + root.shape[1]))
    if points is None:
        result[:] = np.nan
        return result
    result[:, :, 0] = points.by_rays[column].T
    for axis in range(3):
        by_global = known.parameters.by_global(points.by_rays[:, axis], known.view, points.by_sheet[:, axis])
        result[:, axis, 2:] = by_global @ root
    return np.einsum("ij,njr->nir", turn, result)


def independent_patterns(moved: np.ndarray) -> np.ndarray:
    """Patterns (M, N, 3), orthogonal over the points, from any (R, N, 3) that together have their covariance."""
    return _patterns(moved.reshape(len(moved), -1))[0]


def _patterns(flat: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Patterns (M, N, 3) as of `independent_patterns` from any (R, 3 N), in any order of memory; their ways (R, M)."""
    values, vectors = np.linalg.eigh(flat @ flat.T)
    order = np.argsort(values)[::-1]
    values = np.maximum(values[order], 0.0)
    left = 3.0 * np.append(np.cumsum(values[::-1])[::-1][1:], 0.0) / flat.shape[1]
    count = 1 + int(np.argmax(left <= _NEGLIGIBLE_MM**2))
    ways = vectors[:, order[:count]]
    return (ways.T @ flat).astype(np.float32).reshape(count, -1, 3), ways


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
