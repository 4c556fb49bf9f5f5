"""Poses of a target in the images of a capture, and how they depend on the sensor's calibration."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from scipy.optimize import least_squares
from scipy.spatial.transform import Rotation

from uwlts.calibration.joint.stored_estimate import StoredEstimate
from uwlts.errors import CalibrationError, DescriptionError, TargetError
from uwlts.model.any_calibration import check_fits
from uwlts.model.calibration import Calibration, WindowModel
from uwlts.optics.camera import directions, project_through_window
from uwlts.optics.window import trace_window
from uwlts.storage.capture import Capture
from uwlts.targets import CircleTarget, Target, parse_target
from uwlts.targets.detection.ellipse_bias import circle_centre_bias

FEWEST_IMAGES = 4
"""Three poses with turns about two axes determine the mount; one more shows whether they agree."""
_LEAST_PX = 1e-3
"""No corner or circle is found closer."""
POSE_STEPS = np.array([1e-3] * 3 + [1e-6] * 3)
"""Of shift (mm) and turn (rad) for differences."""


@dataclass(frozen=True, eq=False)
class BoardImage:
    """An image of the target: its pose as the camera sees it, and that of the platform.

    ``camera_from_target`` (4, 4) in mm; ``covariance`` (6, 6) is of a shift of the target's middle (mm) and a turn
    about it (rad), in the camera's axes; ``points`` found, whose pixels miss by ``rms_px``; ``base_from_platform``
    (4, 4). ``by_sensor`` (6, Q) are derivatives of shift and turn by the parameters of the sensor's joint estimate,
    where it has one.
    """

    name: str
    camera_from_target: np.ndarray
    covariance: np.ndarray
    points: int
    rms_px: float
    base_from_platform: np.ndarray
    by_sensor: np.ndarray | None = None


def board_images(
    captures: Sequence[Capture], calibration: Calibration, known: StoredEstimate | None, poses: np.ndarray | None
) -> tuple[Target, list[BoardImage], dict[str, str]]:
    """The target, its pose in every image that shows it, and why others do not."""
    images: list[BoardImage] = []
    reasons: dict[str, str] = {}
    targets, taken = [], 0
    for capture in captures:
        check_fits(capture.header, calibration, source=capture.path.name)
        if capture.header.target is None:
            raise DescriptionError(f"{capture.path.name} does not describe its target")
        targets.append(parse_target(capture.header.target))
        if targets[-1] != targets[0]:
            raise DescriptionError("the captures show different targets: calibrate with one target, at one place")
        index = calibration.index_of(capture.header.medium)
        window = calibration.window if capture.header.sensor.camera.window.mounted else None
        for frame, image in capture.frames(laser_on=False):
            name = f"{capture.path.stem}, frame {frame}"
            pose = capture.pose[frame] if poses is None else poses[taken] if taken < len(poses) else None
            taken += 1
            if pose is None:
                continue
            if not np.isfinite(pose).all():
                raise DescriptionError(f"{name} has no pose of the platform: give a table of poses, or import them")
            try:
                images.append(posed_board(name, image, targets[0], calibration, known, window, index, pose))
            except (TargetError, CalibrationError) as error:
                reasons[name] = f"no target: {error}"
    if poses is not None and taken != len(poses):
        raise DescriptionError(f"there are {len(poses)} poses for {taken} images with the laser off: expected one each")
    if len(images) < FEWEST_IMAGES:
        why = next(iter(reasons.values()), "there are no images with the laser off")
        raise CalibrationError(
            f"{len(images)} of {taken} images show the target; at least {FEWEST_IMAGES} are needed ({why})"
        )
    return targets[0], images, reasons


def posed_board(
    name: str,
    image: np.ndarray,
    target: Target,
    calibration: Calibration,
    known: StoredEstimate | None,
    window: WindowModel | None,
    index: float,
    base_from_platform: np.ndarray,
) -> BoardImage:
    """The target's pose in one image by least squares of its points' pixels."""
    camera, view = calibration.camera, target.detect(image)
    if len(view.points_mm) < 6:
        raise CalibrationError(f"{len(view.points_mm)} points found; at least 6 are needed")
    rays = trace_window(directions(camera, view.pixels), window, medium_index=index)
    slopes = rays.directions[:, :2] / rays.directions[:, 2:]
    good, turn, shift = cv2.solvePnP(view.points_mm, slopes, np.eye(3), None)
    if not good or not np.isfinite(shift).all():
        raise CalibrationError("its points fit no pose")
    middle = target.points_mm.mean(axis=0)
    start = rigid_transform(cv2.Rodrigues(turn)[0], shift.ravel())

    def moved(step: np.ndarray) -> np.ndarray:
        return moved_about(start, middle, step)

    def projected(pose: np.ndarray, points: np.ndarray) -> np.ndarray:
        seen = points @ pose[:3, :3].T + pose[:3, 3]
        return project_through_window(camera, window, seen, medium_index=index)

    pixels = view.pixels
    if isinstance(target, CircleTarget):
        bias = circle_centre_bias(
            lambda points: projected(start, points),
            view.points_mm,
            diameter_mm=target.diameter_mm,
            axis_u=(1.0, 0.0, 0.0),
            axis_v=(0.0, 1.0, 0.0),
        )
        pixels = pixels - bias
    if not np.isfinite(projected(start, view.points_mm)).all():
        raise CalibrationError("it would lie before the window")
    fit = least_squares(
        lambda step: (projected(moved(step), view.points_mm) - pixels).ravel(),
        np.zeros(6),
        x_scale=[1.0, 1.0, 1.0, 1e-2, 1e-2, 1e-2],
        loss="soft_l1",
        f_scale=0.5,
    )
    spread = max(float(np.sqrt(np.mean(fit.fun**2) * fit.fun.size / (fit.fun.size - 6))), _LEAST_PX)
    covariance = spread**2 * np.linalg.inv(fit.jac.T @ fit.jac)
    by_sensor = None
    if known is not None:
        # The pose goes where the pixels stay as they are.
        found, where = moved(fit.x), np.zeros(6)
        by_pose = differences(
            lambda step: projected(moved_about(found, middle, step), view.points_mm), where, POSE_STEPS
        )
        placed = view.points_mm @ found[:3, :3].T + found[:3, 3]
        std = np.sqrt(np.diag(known.covariance))
        by_values = differences(
            lambda values: known.parameters.project(values, known.view, placed), known.values, 1e-2 * std
        )
        by_sensor = -np.linalg.lstsq(by_pose, by_values, rcond=None)[0]
    return BoardImage(name, moved(fit.x), covariance, len(pixels), spread, base_from_platform, by_sensor)


def differences(values: Callable[[np.ndarray], np.ndarray], at: np.ndarray, steps: np.ndarray) -> np.ndarray:
    """Derivatives (N, K) of values, flattened, by central differences with steps (K,); 0 where a step is 0."""
    columns = []
    for number, size in enumerate(steps):
        step = np.zeros(len(steps))
        step[number] = size
        columns.append((values(at + step) - values(at - step)).ravel() / (2 * size or 1.0))
    return np.stack(columns, axis=1)


def rigid_transform(rotation: np.ndarray, shift: np.ndarray) -> np.ndarray:
    result = np.eye(4)
    result[:3, :3], result[:3, 3] = rotation, shift
    return result


def moved_about(pose: np.ndarray, middle: np.ndarray, step: np.ndarray) -> np.ndarray:
    """A pose (4, 4) after a shift (3,) of the place of a point ``middle`` and a turn (3,) about it."""
    rotation = Rotation.from_rotvec(step[3:]).as_matrix() @ pose[:3, :3]
    place = pose[:3, :3] @ middle + pose[:3, 3] + step[:3]
    return rigid_transform(rotation, place - rotation @ middle)
