"""Camera parameters and target poses from images of a flat target, with a stage or with free poses."""

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import Literal

import cv2
import numpy as np
from pydantic import JsonValue

from uwlts.calibration.camera.camera_parameters import (
    CameraOptions,
    Intrinsics,
    Placement,
    TargetImage,
    observe,
    placements,
    pose_values,
)
from uwlts.errors import CalibrationError
from uwlts.fitting.schur_least_squares import Observation, SchurFit, schur_least_squares
from uwlts.model.calibration import CameraModel
from uwlts.optics.camera import project
from uwlts.targets.detection.ellipses import circle_centre_bias

Poses = Literal["stage-normal", "stage", "free"]

# Coordinates are normalised: a direction with an extent of the points below this fraction of the largest one, or
# a null vector separated from others by less than this, cannot be distinguished from rounding and lens distortion.
_FLAT = 1e-4
_AMBIGUOUS = 1e-9


def direct_linear(points_mm: np.ndarray, pixels: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Estimate a pinhole camera without distortion from at least six points in space, by the normalised linear method.

    Hartley and Zisserman, Multiple View Geometry, 2nd ed., algorithm 7.1 (linear part) and section 6.2.4 (RQ). From
    points (N, 3) in mm, in any frame, and pixels (N, 2): camera matrix K (3, 3), rotation (3, 3) and translation (3,)
    in mm from the points' frame to the camera's.

    Raises CalibrationError if the points are coplanar or too few, or the image is mirrored relative to them.
    """
    if len(points_mm) < 6:
        raise CalibrationError(f"the linear start needs at least 6 target points; there are {len(points_mm)}")
    to_unit, unit = _normalise(points_mm)
    pixel_to_unit, unit_pixels = _normalise(pixels)
    extents = np.linalg.svd(unit[:, :3], compute_uv=False)
    if extents[2] < _FLAT * extents[0]:
        raise CalibrationError(
            "all target points are in one plane: move the stage between the target images, or use poses='free' with a "
            "tilted target"
        )
    nothing = np.zeros_like(unit)
    u, v = unit_pixels[:, :1], unit_pixels[:, 1:2]
    equations = np.vstack([np.hstack([unit, nothing, -u * unit]), np.hstack([nothing, unit, -v * unit])])
    # The triangular factor has the same singular values as the equations and is only 12 x 12.
    _, singular, rows = np.linalg.svd(np.linalg.qr(equations, mode="r"))
    if singular[10] < _AMBIGUOUS * singular[0]:
        raise CalibrationError("the target points do not determine the camera: use more points, spread over the image")
    projection = np.linalg.solve(pixel_to_unit, rows[11].reshape(3, 4)) @ to_unit
    if np.median(points_mm @ projection[2, :3] + projection[2, 3]) < 0:
        projection = -projection
    if np.linalg.det(projection[:, :3]) < 0:
        raise CalibrationError(
            "the target images are mirrored relative to the stage positions: the stage moved opposite to "
            "stage_direction, or the target's columns or rows are numbered in the wrong direction"
        )
    # RQ from QR of the rows in reverse order; the signs make the camera matrix's diagonal positive.
    orthogonal, triangular = np.linalg.qr(projection[::-1, :3].T)
    matrix, rotation = triangular.T[::-1, ::-1], orthogonal.T[::-1]
    signs = np.sign(np.diag(matrix))
    matrix, rotation = matrix * signs, signs[:, None] * rotation
    return matrix / matrix[2, 2], rotation, np.linalg.solve(matrix, projection[:, 3])


def _normalise(coordinates: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return a similarity (D + 1, D + 1) to centroid 0 and rms distance sqrt(D), and the result (N, D + 1)."""
    dimension = coordinates.shape[1]
    centroid = coordinates.mean(axis=0)
    spread = np.sqrt(np.mean(np.sum((coordinates - centroid) ** 2, axis=1)))
    if not spread > 0:
        raise CalibrationError("all target points have the same place: was the target detected correctly?")
    similarity = np.eye(dimension + 1) * np.sqrt(dimension) / spread
    similarity[:-1, -1] = -centroid * np.sqrt(dimension) / spread
    similarity[-1, -1] = 1.0
    return similarity, np.column_stack([coordinates, np.ones(len(coordinates))]) @ similarity.T


def _find_start(views: list[Placement], intrinsics: Intrinsics, poses: Poses) -> tuple[np.ndarray, list[np.ndarray]]:
    """Estimate camera parameters (P,) and poses (6,).

    If the stage moves the target along its normal, the placement with the largest motion gives both by the linear
    method. From single images, f follows from homographies and the principal point is the centre (see
    `cv2.initCameraMatrix2D`, after Zhang, A flexible new technique for camera calibration, PAMI 2000).
    """
    known = {}
    if poses == "free":
        size = (intrinsics.width_px, intrinsics.height_px)
        points, pixels = ([getattr(v, name).astype(np.float32) for v in views] for name in ("points_mm", "pixels"))
        matrix = cv2.initCameraMatrix2D(points, pixels, size, 1.0)
        if not (np.isfinite(matrix).all() and 0.1 < matrix[0, 0] / max(size) < 100):
            raise CalibrationError(
                "the target images do not determine the focal length: tilt the target differently relative to the "
                "camera's axis in each image"
            )
    else:
        farthest = int(np.argmax([np.ptp(view.shifts_mm) for view in views]))
        matrix, rotation, translation = direct_linear(views[farthest].displace(), views[farthest].pixels)
        known[farthest] = np.r_[cv2.Rodrigues(rotation)[0].ravel(), translation]
    values = intrinsics.from_matrix(matrix)
    matrix = intrinsics.matrix(values)
    return values, [known[n] if n in known else placement_pose(view, matrix) for n, view in enumerate(views)]


def placement_pose(placement: Placement, matrix: np.ndarray) -> np.ndarray:
    """Estimate rotation vector and shift (6,) of a placement for a camera without distortion."""
    return find_pose(placement.displace(), placement.pixels, matrix)


def find_pose(
    points_mm: np.ndarray, pixels: np.ndarray, matrix: np.ndarray, coefficients: np.ndarray | None = None
) -> np.ndarray:
    """Return rotation vector and shift (6,) from the target to a camera without a window; CalibrationError if none."""
    found, rotation, shift = cv2.solvePnP(points_mm, pixels, matrix, coefficients)
    if not found or not np.isfinite(shift).all():
        raise CalibrationError("no pose of the target fits its image: is it the described target?")
    return np.r_[rotation.ravel(), shift.ravel()]


# Largest standard deviations relative to f and to the image's side: lengths would have the same relative errors.
_LARGEST_FOCAL_STD = 0.02
_LARGEST_CENTRE_STD = 0.05
# Offsets of circle images are recalculated until they change by less; a few rounds suffice, unless the diameter is
# wrong.
_SETTLED_PX = 1e-4
_BIAS_ROUNDS = 10


@dataclass(frozen=True, eq=False)
class CameraSolution:
    """Calibrated camera with its uncertainty."""

    model: CameraModel
    target_poses: np.ndarray  # (F, 4, 4); ``T_camera_target`` of every image
    residuals_px: list[np.ndarray]  # list of (N, 2); found minus calculated pixel, for every image
    parameters: tuple[str, ...]  # names of the estimated camera parameters
    covariance: np.ndarray  # (P, P); of these parameters
    sigma_px: float  # standard deviation of one coordinate, corrected for the degrees of freedom
    stage_direction: np.ndarray | None
    """(3,) or None; unit direction of the sensor's motion by the stage, camera frame; None if free poses do not
    follow a stage."""
    stage_tilt_rad: float | None  # largest angle of that direction to a placement's normal, for poses "stage"
    rounds: int
    bias_px: list[np.ndarray] | None = None  # list of (N, 2) or None; corrected offsets of the circle images' centres

    def values(self) -> dict[str, float]:
        """Return every estimated parameter."""
        known = self.model.parameters()
        return {name: known[name] for name in self.parameters}

    def std(self) -> dict[str, float]:
        """Return the standard deviation of every estimated parameter."""
        return dict(zip(self.parameters, np.sqrt(np.diag(self.covariance)).tolist(), strict=True))

    def image_rms_px(self) -> np.ndarray:
        """Return the root mean square distance (F,) between detected and calculated pixels of every image."""
        return np.array([np.sqrt(np.mean(np.sum(r**2, axis=1))) for r in self.residuals_px])

    def rms_px(self) -> float:
        """Return the root mean square distance between detected and calculated pixels over all images."""
        return float(np.sqrt(np.mean(np.sum(np.vstack(self.residuals_px) ** 2, axis=1))))

    def figures(self) -> dict[str, JsonValue]:
        """Return residuals, standard deviations and covariance for files; None for missing values."""
        direction = self.stage_direction
        return {
            "images": len(self.residuals_px),
            "points": sum(map(len, self.residuals_px)),
            "rms_px": self.rms_px(),
            "sigma_px": self.sigma_px,
            "image_rms_px": self.image_rms_px().tolist(),
            "std": {**self.std()},
            "parameters": list(self.parameters),
            "covariance": self.covariance.tolist(),
            "stage_direction": None if direction is None else direction.tolist(),
        }


def solve_camera(
    images: Sequence[TargetImage],
    *,
    width_px: int,
    height_px: int,
    poses: Poses = "stage-normal",
    approaching: bool = True,
    options: CameraOptions | None = None,
    start: CameraSolution | None = None,
    circle_diameter_mm: float | None = None,
) -> CameraSolution:
    """Calibrate the camera by least squares of the pixel distances.

    The stage moves the sensor by s along d, so the target moves by -s d relative to the sensor. A point x of the target
    is at R (x - (s - s0) d) + t in the camera frame, with d in the target's frame.

    With the ``poses`` "stage-normal" (the thesis) there is one pose per placement of the target, and d is the target's
    normal. "stage": d is estimated too, for each placement; this needs pixels of known shape. "free": one pose per
    image, stage positions are not used. ``approaching`` states whether increasing stage positions move the sensor
    towards the target; it is unused for "free".

    ``start`` is a solution for nearly the same pixels, with the same options and poses. If the pixels are centres of
    images of circles with ``circle_diameter_mm``, their offsets from the images of the circles' centres are corrected
    iteratively.

    Raises CalibrationError if there are too few images, the stage did not move, or the target is mirrored relative to
    the stage. The same if the parameters are not determined, or the offsets do not converge; RangeError if a circle's
    image is not an ellipse.
    """
    options = CameraOptions() if options is None else options
    intrinsics = Intrinsics(options, width_px=width_px, height_px=height_px)

    def solve(images: Sequence[TargetImage], start: CameraSolution | None) -> CameraSolution:
        views = _group_views(images, poses, approaching, options)
        if start is not None:
            global_values, local = intrinsics.from_model(start.model), [_restart(view, start, poses) for view in views]
        else:
            global_values, local = _find_start(views, intrinsics, poses)
            local = [np.r_[pose, 0.0, 0.0] if poses == "stage" else pose for pose in local]

        def model(group: int, global_values: np.ndarray, local: np.ndarray) -> Observation | None:
            if group == len(views):
                return _make_prior_observation(intrinsics, global_values)
            return observe(views[group], intrinsics, global_values, local)

        if options.tangential is not None:
            local = [*local, np.empty(0)]
        fit = schur_least_squares(model, global_values, local, soft_limit=options.soft_limit_px)
        _refuse_undetermined(fit, intrinsics)
        return _make_solution(images, views, fit, intrinsics, poses)

    if circle_diameter_mm is None:
        return solve(images, start)
    bias = [np.zeros_like(image.pixels) for image in images]
    for _ in range(_BIAS_ROUNDS):
        centred = [replace(i, pixels=i.pixels - offset) for i, offset in zip(images, bias, strict=True)]
        start, before = solve(centred, start), bias
        seen_by = partial(project, start.model)
        bias = [
            centre_offsets(seen_by, pose, image.points_mm, diameter_mm=circle_diameter_mm)
            for image, pose in zip(images, start.target_poses, strict=True)
        ]
        if max(np.max(np.abs(b - a)) for a, b in zip(before, bias, strict=True)) <= _SETTLED_PX:
            return replace(start, bias_px=before)
    raise CalibrationError(
        f"the offsets of the circles' images did not converge in {_BIAS_ROUNDS} rounds: is the circles' diameter "
        f"{circle_diameter_mm:g} mm?"
    )


def _make_prior_observation(intrinsics: Intrinsics, global_values: np.ndarray) -> Observation:
    """Return the prior knowledge of p1 and p2 as residuals in px."""
    std, sigma_px = intrinsics.options.tangential or (math.inf, 0.0)
    by_global = np.array([[float(name == key) for name in intrinsics.names] for key in ("p1", "p2")]) * (sigma_px / std)
    return Observation(by_global @ global_values[:, None], by_global, np.empty((2, 0)))


def centre_offsets(
    project: Callable[[np.ndarray], np.ndarray], pose: np.ndarray, points_mm: np.ndarray, *, diameter_mm: float
) -> np.ndarray:
    """Return offsets (N, 2) in px of the centres of circle images from the images of the circles' centres.

    The circles are in the plane of a target at ``T_camera_target`` (4, 4); ``project`` maps points (M, 3) of the camera
    frame to pixels (M, 2).

    Raises CalibrationError if a circle's image is not an ellipse, as in a fit that diverged.
    """
    return circle_centre_bias(
        lambda points: project(points @ pose[:3, :3].T + pose[:3, 3]), points_mm, diameter_mm=diameter_mm
    )


def _group_views(
    images: Sequence[TargetImage], poses: Poses, approaching: bool, options: CameraOptions
) -> list[Placement]:
    if poses == "free":
        if len(images) < 3:
            raise CalibrationError(f"free poses need at least 3 target images; there are {len(images)}")
        return placements(images, approaching=None)
    if poses == "stage" and options.pixel_aspect is None:
        raise CalibrationError(
            "a free stage direction and the pixels' shape cannot be separated: use square pixels, or "
            "poses='stage-normal' or 'free'"
        )
    views = placements(images, approaching=approaching)
    if not any(np.any(view.shifts_mm) for view in views):
        raise CalibrationError(
            f"{len(images)} target images, but the stage did not move: move it between them, or use poses='free' with "
            f"a tilted target"
        )
    return views


def _restart(view: Placement, start: CameraSolution, poses: Poses) -> np.ndarray:
    pose = start.target_poses[view.image[0]]
    if poses != "stage":
        return pose_values(pose)
    direction = pose[:3, :3].T @ start.stage_direction
    return np.r_[pose_values(pose), direction[:2] / abs(direction[2])]


def _refuse_undetermined(fit: SchurFit, intrinsics: Intrinsics) -> None:
    values = dict(zip(intrinsics.names, fit.global_values, strict=True))
    limits = {name: _LARGEST_FOCAL_STD * values[name] for name in ("f", "fx", "fy") if name in values}
    limits |= {"cx": _LARGEST_CENTRE_STD * intrinsics.width_px, "cy": _LARGEST_CENTRE_STD * intrinsics.height_px}
    for name, std in zip(intrinsics.names, np.sqrt(np.diag(fit.covariance)), strict=True):
        if name in limits and not std <= limits[name]:
            raise CalibrationError(
                f"the target images determine {name} with a standard deviation of {std:.3g} px; at most "
                f"{limits[name]:.3g} px is allowed: take more images, tilted differently, or fix some parameters"
            )


def _make_solution(
    images: Sequence[TargetImage], views: list[Placement], fit: SchurFit, intrinsics: Intrinsics, poses: Poses
) -> CameraSolution:
    target_poses, directions, tilts = np.tile(np.eye(4), (len(images), 1, 1)), [], []
    residuals = [np.empty((0, 2))] * len(images)
    # Prior knowledge is the last group, after those of the views.
    per_image = (each[: len(views)] for each in (fit.local, fit.residuals))
    for view, local, misses in zip(views, *per_image, strict=True):
        rotation = cv2.Rodrigues(local[:3])[0]
        directions.append(rotation @ view.direction(local[6:]))
        for index in np.unique(view.image):
            here = view.image == index
            target_poses[index, :3, :3] = rotation
            target_poses[index, :3, 3] = local[3:6] - view.shifts_mm[here][0] * directions[-1]
            residuals[index] = misses[here]
        if poses == "stage":
            tilts.append(float(np.arctan(np.hypot(*local[6:]))))
    if poses == "free":
        stage = stage_direction(target_poses, np.array([image.stage_mm for image in images]))
    else:
        stage = np.mean(directions, axis=0) / np.linalg.norm(np.mean(directions, axis=0))
    return CameraSolution(
        model=intrinsics.model(fit.global_values),
        target_poses=target_poses,
        residuals_px=residuals,
        parameters=intrinsics.names,
        covariance=fit.covariance,
        sigma_px=fit.sigma,
        stage_direction=stage,
        stage_tilt_rad=max(tilts, default=None),
        rounds=fit.rounds,
    )


def stage_direction(target_poses: np.ndarray, stage_mm: np.ndarray) -> np.ndarray | None:
    """Estimate the unit direction (3,) of the sensor's motion by the stage, from poses of a fixed target.

    ``target_poses`` (F, 4, 4) are ``T_camera_target``; the result is in the camera frame. None if the stage did not
    move, or if the poses do not move as far as the stage: then the target was moved in another way.
    """
    moved = stage_mm - stage_mm.mean()
    if not np.any(moved):
        return None
    velocity = -(moved @ target_poses[:, :3, 3]) / (moved @ moved)
    speed = float(np.linalg.norm(velocity))
    return velocity / speed if abs(speed - 1) < 0.05 else None  # scales of stage and target agree better than this


_LEAST_TURN = np.radians(20)
"""Angle between a direction and its description above which images may be rotated: descriptions are rough."""
_MUCH_CLOSER = 1 / 3  # fraction of that angle within which a direction must agree with rotated images
_TURNS = {
    "turned by 180 deg": np.array([-1.0, -1.0, 1.0]),
    "mirrored top to bottom": np.array([1.0, -1.0, 1.0]),
    "mirrored left to right": np.array([-1.0, 1.0, 1.0]),
}


def turned_like(found: np.ndarray, described: np.ndarray, *, either_way: bool = False) -> str:
    """Describe the image rotation that explains a unit direction (3,) different from the description; else empty.

    Both are in the camera frame. ``either_way`` is for normals, whose opposite is equivalent.
    """

    def angle(other: np.ndarray) -> float:
        cosine = float(found @ other)
        return float(np.arccos(np.clip(abs(cosine) if either_way else cosine, -1.0, 1.0)))

    off = angle(described)
    if off < _LEAST_TURN:
        return ""
    return " or ".join(how for how, flip in _TURNS.items() if angle(flip * described) < _MUCH_CLOSER * off)


def refuse_turned_travel(found: np.ndarray | None, described: np.ndarray) -> None:
    """Raise CalibrationError if the stage's direction (3,) agrees with the described one (3,) only for rotated images.

    A board that looks the same in a mirror does not reveal this. Both directions are in the camera frame; None if poses
    do not follow a stage.
    """
    described = described / np.linalg.norm(described)
    if found is not None and (how := turned_like(found, described)):
        raise CalibrationError(
            f"from the target's poses, the stage moves the sensor along {np.round(found, 2).tolist()} (camera: right, "
            f"down, ahead); from stage_direction, along {np.round(described, 2).tolist()}. This occurs if the images "
            f"are {how}: correct the images' orientation, or stage_direction"
        )
