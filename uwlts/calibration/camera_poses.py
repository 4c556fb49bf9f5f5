"""Camera and target poses from images of a flat target, by the stage's displacements or by free poses."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

import cv2
import numpy as np

from uwlts.calibration.bordered import BorderedFit, Observation, fit_bordered
from uwlts.calibration.direct_linear import direct_linear
from uwlts.calibration.intrinsics import CameraOptions, Intrinsics
from uwlts.calibration.model import CameraModel
from uwlts.calibration.target_image import TargetImage, z_away
from uwlts.errors import CalibrationError

Poses = Literal["stage-normal", "stage", "free"]

# Beyond these shares a camera counts as not determined, whatever the residuals: lengths would be wrong as much.
_LARGEST_FOCAL_STD = 0.02
_LARGEST_CENTRE_STD = 0.05


@dataclass(frozen=True, eq=False)
class CameraSolution:
    """A calibrated camera and how well it was determined.

    Attributes
    ----------
    model : CameraModel
    target_poses : (F, 4, 4)
        ``T_camera_target`` of every image.
    residuals_px : list of (N, 2)
        Found minus calculated pixel, for every image.
    parameters : tuple of str
        Names of the camera parameters that were estimated.
    covariance : (P, P)
        Of these parameters.
    sigma_px : float
        Standard deviation of one coordinate, with the degrees of freedom counted.
    stage_direction : (3,) or None
        Unit direction in which the stage moves the sensor, in the camera frame; None where the stage did not move.
    stage_tilt_rad : float or None
        Angle between this direction and the target's normal, "stage" only; its standard deviation is
        ``stage_tilt_std_rad``.
    rounds : int
    stopped : str
        Why the iteration ended.
    """

    model: CameraModel
    target_poses: np.ndarray
    residuals_px: list[np.ndarray]
    parameters: tuple[str, ...]
    covariance: np.ndarray
    sigma_px: float
    stage_direction: np.ndarray | None
    stage_tilt_rad: float | None
    stage_tilt_std_rad: float | None
    rounds: int
    stopped: str

    def std(self) -> dict[str, float]:
        """Standard deviation of every estimated parameter."""
        return dict(zip(self.parameters, np.sqrt(np.diag(self.covariance)).tolist(), strict=True))

    def image_rms_px(self) -> np.ndarray:
        """Root mean square distance (F,) between found and calculated pixels of every image."""
        return np.array([np.sqrt(np.mean(np.sum(r**2, axis=1))) for r in self.residuals_px])

    def rms_px(self) -> float:
        """Root mean square distance between found and calculated pixels over all images."""
        return float(np.sqrt(np.mean(np.sum(np.vstack(self.residuals_px) ** 2, axis=1))))


def solve_camera(
    images: Sequence[TargetImage],
    *,
    width_px: int,
    height_px: int,
    poses: Poses = "stage-normal",
    approaching: bool = True,
    options: CameraOptions | None = None,
) -> CameraSolution:
    """Calibrate the camera by least squares of the pixel distances.

    The stage moves the sensor by s along d, so the target moves by -s d in the sensor's frame: a point x of the target
    is at R (x - (s - s0) d) + t in the camera frame, with d in the target's frame.

    Parameters
    ----------
    images : sequence of TargetImage
    poses : {"stage-normal", "stage", "free"}
        "stage-normal" (the thesis): one pose per placement of the target, d is the target's normal. "stage": d is
        estimated too, starting there; needs square pixels. "free": one pose per image, stage positions unused.
    approaching : bool
        Whether growing stage positions bring the sensor nearer to the target.
    options : CameraOptions

    Raises
    ------
    CalibrationError
        Too few images, a stage that did not move, a mirrored or undetermined problem.
    """
    options = CameraOptions() if options is None else options
    intrinsics = Intrinsics(options, width_px=width_px, height_px=height_px)
    views = _grouped(images, poses, approaching, options)
    start_matrix, starts = _linear_start(views, intrinsics) if poses != "free" else _planar_start(views, intrinsics)
    start = intrinsics.from_matrix(start_matrix)
    free_direction = [0.0, 0.0] if poses == "stage" else []

    def model(group: int, shared: np.ndarray, own: np.ndarray) -> Observation | None:
        return observe(views[group], intrinsics, shared, own)

    fit = fit_bordered(model, start, [np.r_[s, free_direction] for s in starts], soft_limit=options.soft_limit_px)
    _refuse_undetermined(fit, intrinsics)
    return _solution(images, views, fit, intrinsics, poses)


@dataclass(frozen=True, eq=False)
class TargetView:
    """All images of one placement: points (N, 3) at s0, displacement s - s0 (N,), pixels (N, 2) and image index (N,).

    ``away`` is the z of the start of the stage's direction d in the target's frame, +1 or -1.
    """

    points_mm: np.ndarray
    shifts_mm: np.ndarray
    pixels: np.ndarray
    image: np.ndarray
    away: float


def observe(view: TargetView, intrinsics: Intrinsics, shared: np.ndarray, own: np.ndarray) -> Observation | None:
    """Residuals (found minus calculated) of a placement and their derivatives; None with points behind the camera.

    ``own`` holds the rotation vector, the translation in mm and, where d is free, its components (a, b) with
    d = (a, b, away) / sqrt(1 + a^2 + b^2).
    """
    direction, by_parameters = _direction(own[6:], view.away)
    points = view.points_mm - view.shifts_mm[:, None] * direction
    rotation = cv2.Rodrigues(own[:3])[0]
    if np.min(points @ rotation[2] + own[5]) <= 0:
        return None
    matrix, coefficients = intrinsics.matrix(shared), intrinsics.coefficients(shared)
    projected, jacobian = cv2.projectPoints(points, own[:3], own[3:6], matrix, coefficients)
    by_own = [jacobian[:, :6]]
    if len(own) > 6:
        # A shift of a point along d acts like a translation of the target by R times it.
        by_direction = jacobian[:, 3:6] @ (rotation @ by_parameters)
        by_own.append(-np.repeat(view.shifts_mm, 2)[:, None] * by_direction)
    return Observation(
        residuals=view.pixels - projected.reshape(-1, 2),
        by_shared=-jacobian[:, 6:15] @ intrinsics.map,
        by_own=-np.hstack(by_own),
    )


def _direction(tilt: np.ndarray, away: float) -> tuple[np.ndarray, np.ndarray]:
    """Unit direction (3,) and its derivatives (3, 2) by the tilt."""
    raw = np.array([*(tilt if len(tilt) else (0.0, 0.0)), away])
    length = np.linalg.norm(raw)
    unit = raw / length
    return unit, (np.eye(3) - np.outer(unit, unit))[:, :2] / length


def _grouped(
    images: Sequence[TargetImage], poses: Poses, approaching: bool, options: CameraOptions
) -> list[TargetView]:
    if poses == "free":
        if len(images) < 3:
            raise CalibrationError(f"free poses need at least 3 target images; there are {len(images)}")
        groups = [[index] for index in range(len(images))]
    else:
        if poses == "stage" and not options.square_pixels:
            raise CalibrationError(
                "a free stage direction and pixels that are not square cannot be told apart: give square pixels, or "
                "poses='stage-normal' or 'free'"
            )
        placements = sorted({image.placement for image in images})
        groups = [[i for i, image in enumerate(images) if image.placement == p] for p in placements]
    views = []
    for group in groups:
        members = [images[i] for i in group]
        facing = {z_away(image) for image in members}
        if len(facing) > 1:
            raise CalibrationError("the target is mirrored in some of its images: its rows or columns run backwards")
        first = members[0].stage_mm
        views.append(
            TargetView(
                points_mm=np.vstack([m.points_mm for m in members]),
                shifts_mm=np.repeat([m.stage_mm - first for m in members], [len(m.points_mm) for m in members]),
                pixels=np.vstack([m.pixels for m in members]),
                image=np.repeat(group, [len(m.points_mm) for m in members]),
                away=1.0 if facing.pop() == approaching else -1.0,
            )
        )
    if poses != "free" and not any(np.ptp(view.shifts_mm) > 0 for view in views):
        raise CalibrationError(
            f"{len(images)} target images, all at one stage position: move the stage between them, or use poses='free'"
        )
    return views


def _linear_start(views: list[TargetView], intrinsics: Intrinsics) -> tuple[np.ndarray, list[np.ndarray]]:
    """Camera and pose of the placement that reaches farthest by the linear method, poses of the others from it."""
    farthest = int(np.argmax([np.ptp(view.shifts_mm) for view in views]))
    view = views[farthest]
    start = direct_linear(_displaced(view), view.pixels)
    poses = [_pose(other, intrinsics.plain_matrix(start.matrix)) for other in views]
    poses[farthest] = np.r_[cv2.Rodrigues(start.rotation)[0].ravel(), start.translation_mm]
    return start.matrix, poses


def _planar_start(views: list[TargetView], intrinsics: Intrinsics) -> tuple[np.ndarray, list[np.ndarray]]:
    """Focal length from the views' homographies with the principal point in the middle, poses from it."""
    size = (intrinsics.width_px, intrinsics.height_px)
    points = [view.points_mm.astype(np.float32) for view in views]
    matrix = cv2.initCameraMatrix2D(points, [view.pixels.astype(np.float32) for view in views], size, 1.0)
    if not (np.isfinite(matrix).all() and 0.1 < matrix[0, 0] / max(size) < 100):
        raise CalibrationError(
            "the target images do not show the focal length: tilt the target against the camera's axis, differently "
            "from image to image"
        )
    return matrix, [_pose(view, matrix) for view in views]


def _displaced(view: TargetView) -> np.ndarray:
    return view.points_mm - view.shifts_mm[:, None] * np.array([0.0, 0.0, view.away])


def _pose(view: TargetView, matrix: np.ndarray) -> np.ndarray:
    found, rotation, translation = cv2.solvePnP(_displaced(view), view.pixels, matrix, None)
    if not found:
        raise CalibrationError("no pose of the target explains one of its images: is it the right target?")
    return np.r_[rotation.ravel(), translation.ravel()]


def _refuse_undetermined(fit: BorderedFit, intrinsics: Intrinsics) -> None:
    std = dict(zip(intrinsics.names, np.sqrt(np.diag(fit.covariance)), strict=True))
    values = dict(zip(intrinsics.names, fit.shared, strict=True))
    limits = {name: _LARGEST_FOCAL_STD * abs(values[name]) for name in values if name in ("f", "fx", "fy")}
    limits |= {"cx": _LARGEST_CENTRE_STD * intrinsics.width_px, "cy": _LARGEST_CENTRE_STD * intrinsics.height_px}
    for name, limit in limits.items():
        if name in std and not std[name] <= limit:
            raise CalibrationError(
                f"the target images determine {name} to {std[name]:.3g} px only (at most {limit:.3g} px is of use): "
                f"use more images, tilted differently, or fix some parameters"
            )


def _solution(
    images: Sequence[TargetImage], views: list[TargetView], fit: BorderedFit, intrinsics: Intrinsics, poses: Poses
) -> CameraSolution:
    target_poses, residuals, directions, tilts = np.tile(np.eye(4), (len(images), 1, 1)), {}, [], []
    for view, own, covariance, misses in zip(views, fit.own, fit.own_covariances, fit.residuals, strict=True):
        rotation = cv2.Rodrigues(own[:3])[0]
        direction = rotation @ _direction(own[6:], view.away)[0]
        for index in np.unique(view.image):
            here = view.image == index
            target_poses[index, :3, :3] = rotation
            target_poses[index, :3, 3] = own[3:6] - view.shifts_mm[here][0] * direction
            residuals[index] = misses[here]
        directions.append(direction)
        if len(own) > 6:
            size = np.hypot(*own[6:])
            radial = own[6:] / size if size > 0 else np.array([1.0, 0.0])
            tilts.append((np.arctan(size), np.sqrt(radial @ covariance[6:, 6:] @ radial) / (1 + size**2)))
    if poses == "free":
        direction = stage_direction(target_poses, np.array([image.stage_mm for image in images]))
    else:
        direction = np.mean(directions, axis=0)
        direction /= np.linalg.norm(direction)
    tilt, tilt_std = max(tilts) if tilts else (None, None)
    return CameraSolution(
        model=intrinsics.model(fit.shared),
        target_poses=target_poses,
        residuals_px=[residuals[index] for index in range(len(images))],
        parameters=intrinsics.names,
        covariance=fit.covariance,
        sigma_px=fit.sigma,
        stage_direction=direction,
        stage_tilt_rad=None if tilt is None else float(tilt),
        stage_tilt_std_rad=None if tilt_std is None else float(tilt_std),
        rounds=fit.rounds,
        stopped=fit.stopped,
    )


def stage_direction(target_poses: np.ndarray, stage_mm: np.ndarray) -> np.ndarray | None:
    """Unit direction (3,) in the camera frame in which the stage moves the sensor, from poses of a fixed target.

    ``target_poses`` (F, 4, 4) are ``T_camera_target``; the target's origin moves against the sensor. None where the
    stage stood still or the poses do not follow it.
    """
    moved = stage_mm - stage_mm.mean()
    origins = target_poses[:, :3, 3] - target_poses[:, :3, 3].mean(axis=0)
    if not np.any(moved):
        return None
    velocity = -(moved @ origins) / (moved @ moved)
    # A stage moves the target by what its scale says; anything else is a target moved by hand.
    if abs(np.linalg.norm(velocity) - 1) > 0.05:
        return None
    return velocity / np.linalg.norm(velocity)
