"""Mount of a calibrated sensor from target images at several platform poses (hand-eye calibration).

The same estimate gives the axis of a rotary table that turns the target.
"""

import warnings
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import cached_property, partial
from pathlib import Path
from typing import Any, NamedTuple, Self

import cv2
import numpy as np
from scipy.optimize import least_squares
from scipy.spatial.transform import Rotation

from uwlts.calibration.camera.camera_parameters import TargetImage
from uwlts.calibration.camera.lens import LensCalibration
from uwlts.calibration.camera.photographs import calibrate_camera
from uwlts.calibration.camera.target_poses import centre_offsets, find_pose
from uwlts.calibration.capture_evidence import detect_target
from uwlts.calibration.joint.stored_estimate import StoredEstimate, read_stored_estimate
from uwlts.calibration.mount.captured_profiles import mount_covariance
from uwlts.calibration.mount.next_pose import OPEN_RAD, describe_missing_turns, require_determined, weaknesses
from uwlts.calibration.mount.restricted_likelihood import (
    LARGEST_ROUGH,
    GroupedEvidence,
    RestrictedEstimate,
    settle_agreeing,
    solve_step,
)
from uwlts.errors import CalibrationError, DescriptionError
from uwlts.files.writing import hash_file
from uwlts.fitting.propagation import differences
from uwlts.model.calibration import Calibration, CameraModel, WindowModel, rigid_transform
from uwlts.model.mount import BoardFound, Mount, MountPose
from uwlts.model.sensor import to_rows
from uwlts.optics.camera import directions, project_through_window
from uwlts.optics.fitness import check_fits
from uwlts.optics.window import trace_window
from uwlts.runtime.workers import map_in_threads
from uwlts.storage.capture import Capture
from uwlts.storage.mount_files import SENSOR_AXES, SensorAxis, require_table
from uwlts.targets import Target, parse_target

FEWEST_IMAGES = 4
"""Three poses with rotations about two axes determine the mount; a fourth one shows whether they agree."""
_LEAST_PX = 1e-3  # lower bound of the detection error of a corner or circle
POSE_STEPS = np.array([1e-3] * 3 + [1e-6] * 3)  # step sizes of shift (mm) and rotation (rad) for finite differences
_NO_FIT = 0.1  # pose error divided by the extent of the target that no platform has; a wrong pose format exceeds it
_TRIPLES = 100
"""Random triples of images: with a third of the images wrong, all triples contain a wrong one once in 10^15 runs."""
_BOUNDS = np.array([(1.0, 100.0), (1e-4, 1e3), (1e-7, 1.0)])
"""Bounds of the scatter: factor of the image errors (at least 1), mm, and rad."""
_LEAST_MM = 1e-3  # smallest scatter of shifts to start from; no platform is better
_LEAST_RAD = 1e-6  # smallest scatter of rotations to start from


class TargetCamera(NamedTuple):
    """Calibrated camera that sees a target through window and medium; ``known`` is its estimate with covariance."""

    model: CameraModel
    window: WindowModel | None
    medium_index: float
    camera_from_sensor: np.ndarray  # (4, 4); the identity for a camera without a laser
    known: StoredEstimate | LensCalibration | None


def mount_by_capture(
    capture: Capture, calibration: Calibration, poses: np.ndarray | None, *, axis: SensorAxis | None
) -> Mount:
    """Estimate the mount of a sensor from images with the laser off; ``poses`` replace those of the capture."""
    header = capture.header
    check_fits(header, calibration, source=capture.path.name)
    known = None if calibration.joint is None else read_stored_estimate(calibration, header.sensor, header.medium)
    window = calibration.window if header.sensor.camera.window.mounted else None
    index, from_sensor = calibration.medium_index(header.medium), calibration.object_transform()
    target, at = parse_target(header.target or {}), capture.pose[~capture.laser_on] if poses is None else poses
    found = map_in_threads(partial(detect_target, capture, target, 0), capture.frames(laser_on=False))
    views = [(f"{capture.path.stem}, frame {k}", v if isinstance(v, str) else v[1]) for (k, _), v in found]
    camera, hashes = TargetCamera(calibration.camera, window, index, from_sensor, known), hash_file(capture.path)
    return mount_by_board(target, views, camera, at, axis=axis, inputs={capture.path.name: hashes})


def mount_by_photographs(folder: Path, poses: np.ndarray, *, axis: SensorAxis | None) -> Mount:
    """Calibrate the camera of photographs of a target, and estimate its mount from the same photographs."""
    found = calibrate_camera(folder)
    images, model = iter(found.lens.images), found.lens.solution.model
    views = [(each.name, each.reason or next(images)) for each in found.photographs]
    camera = TargetCamera(model, None, 1.0, np.eye(4), found.lens)
    hashes = {each.name: hash_file(folder / each.name) for each in found.photographs}
    return mount_by_board(found.target, views, camera, poses, axis=axis, inputs=hashes)


def mount_by_board(
    target: Target,
    views: Sequence[tuple[str, TargetImage | str]],
    camera: TargetCamera,
    poses: np.ndarray,
    *,
    axis: SensorAxis | None = None,
    inputs: dict[str, str],
) -> Mount:
    """Estimate ``T_platform_sensor`` from images of a target at an unknown fixed place.

    The calibration of the camera is fixed. Its covariance, if known, is propagated to the mount.

    Each image gives the target's pose in front of the camera, through window and medium. A closed-form solution (Park
    and Martin, IEEE Trans. Robotics and Automation 10, 1994) starts a least-squares estimate of the mount and the
    target's place. The weights follow from the covariance of each image and the platform's scatter in position and
    rotation. Restricted maximum likelihood estimates this scatter, and the ratio of image errors to the noise of their
    points (for example if the target is bent). Images that contradict the others are rejected.

    ``views`` are the images by name, or why they show no target, ``poses`` their ``T_base_platform`` (P, 4, 4).
    ``axis`` is set if the platform is a rotary table, as for `uwlts.calibrate_mount`; ``inputs`` are hashes of files.

    Raises DescriptionError if images have no pose, CalibrationError if too few show the target, or the poses do not
    determine the mount or contradict the images.
    """
    boards, reasons = place_boards(target, views, camera, poses)
    middle = target.points_mm.mean(axis=0)
    rotations = Rotation.from_matrix([image.base_from_platform[:3, :3] for image in boards])
    if axis is not None:
        require_table(np.array([image.base_from_platform for image in boards]))
    elif missing := describe_missing_turns(rotations, least_rad=OPEN_RAD):
        raise CalibrationError(f"the poses do not determine the mount: {'; '.join(missing)}")
    problem = BoardEvidence(boards, camera.camera_from_sensor, middle, axis is not None)
    estimate, kept = select_agreeing_images(problem)
    used, state = problem.select(kept), estimate.state
    _, position_mm, _ = estimate.scatter
    extent = float(np.linalg.norm(np.ptp(target.points_mm, axis=0)))
    if position_mm > _NO_FIT * extent or 2 * len(used.images) < len(boards):
        raise CalibrationError(
            f"no mount fits the images: the poses would have errors of {position_mm:.3g} mm (rms), with "
            f"{len(boards) - len(used.images)} of {len(boards)} images rejected. Check that the poses are "
            "T_base_platform, their format, their units, and that they are in the order of the images"
        )
    if axis is not None and state[0][2, :3] @ SENSOR_AXES[axis] <= 0:
        raise CalibrationError(
            f"the images turn about an axis that points away from {axis} of the sensor's frame, to "
            f"({', '.join(f'{each:.2f}' for each in state[0][2, :3])}): check the sign of the angles"
        )
    covariance, share, factor = mount_covariance(
        estimate, used.free, state[0][:3, :3], camera.known, lambda: used.residual_derivatives(state)
    )
    weak = weaknesses(covariance[:6, :6], Rotation.from_matrix(rotations.as_matrix()[kept]), table=used.table)
    require_determined(covariance, weak)
    without = [used.apply_step(state, step) for step, _ in estimate.without_each]
    rms, held = used.offsets_mm(state), np.array([used.offsets_mm(each)[k] for k, each in enumerate(without)])
    found: dict[str, Any] = {
        image.name: {"rms_mm": own, "held_out_mm": other}
        for image, own, other in zip(used.images, rms.tolist(), held.tolist(), strict=True)
    }
    contradicts = {"reason": "contradicts the other images"}
    rows = [
        MountPose(name=image.name, points=image.points, points_left_out=0, **found.get(image.name, contradicts))
        for image in boards
    ] + [MountPose(name=name, points=0, points_left_out=0, reason=reason) for name, reason in reasons.items()]
    distance = float(np.median([image.camera_from_target[2, 3] for image in used.images]))
    rms_px = float(np.sqrt(np.mean([image.rms_px**2 for image in used.images])))
    return Mount(
        T_platform_sensor=to_rows(state[0]),
        covariance=to_rows(covariance[:6, :6]),
        coverage_factor=factor,
        artefact=BoardFound(T_base_target=to_rows(state[1])),
        point_std_mm=rms_px * distance / camera.model.fx_px,
        pose_std_mm=float(position_mm),
        rms_mm=float(np.sqrt(np.mean(rms**2))),
        held_out_rms_mm=float(np.sqrt(np.mean(held**2))),
        table=axis is not None,
        sensor=share,
        poses=tuple(rows),
        weaknesses=tuple(weak),
        inputs=inputs,
    )


@dataclass(frozen=True, eq=False)
class BoardImage:
    """Target pose in an image, and the platform's pose.

    ``camera_from_target`` is (4, 4), mm. ``covariance`` (6, 6) is that of a shift of the target's middle (mm) and a
    rotation about it (rad), in the camera's axes. ``rms_px`` is the RMS residual of the detected ``points``.
    ``by_sensor`` (6, Q) contains the derivatives of shift and rotation by the parameters of the joint calibration, if
    any.
    """

    name: str
    camera_from_target: np.ndarray
    covariance: np.ndarray
    points: int
    rms_px: float
    base_from_platform: np.ndarray
    by_sensor: np.ndarray | None = None


def place_boards(
    target: Target, views: Sequence[tuple[str, TargetImage | str]], camera: TargetCamera, poses: np.ndarray
) -> tuple[list[BoardImage], dict[str, str]]:
    """Return the target's pose in every image that shows it, and the reasons why other images are not used."""
    if len(poses) != len(views):
        raise DescriptionError(f"found {len(poses)} poses for {len(views)} images: expected one for each")
    boards: list[BoardImage] = []
    reasons: dict[str, str] = {}
    for (name, view), pose in zip(views, poses, strict=True):
        if not np.isfinite(pose).all():
            raise DescriptionError(f"{name} has no platform pose: give a table of poses, or import the poses")
        if isinstance(view, str):
            reasons[name] = view
            continue
        try:
            boards.append(estimate_board_pose(name, view, target, camera, pose))
        except CalibrationError as error:
            reasons[name] = f"no target: {error}"
    if len(boards) < FEWEST_IMAGES:
        why = next(iter(reasons.values()), "there are no images with the laser off")
        raise CalibrationError(
            f"{len(boards)} of {len(views)} images show the target; at least {FEWEST_IMAGES} are needed ({why})"
        )
    return boards, reasons


def estimate_board_pose(
    name: str, view: TargetImage, target: Target, camera: TargetCamera, base_from_platform: np.ndarray
) -> BoardImage:
    """Estimate the target's pose in one image by least squares of the pixels of its points."""
    rays = trace_window(directions(camera.model, view.pixels), camera.window, medium_index=camera.medium_index)
    slopes = rays.directions[:, :2] / rays.directions[:, 2:]
    pose = find_pose(view.points_mm, slopes, np.eye(3))
    middle = target.points_mm.mean(axis=0)
    start = rigid_transform(cv2.Rodrigues(pose[:3])[0], pose[3:])

    def moved(step: np.ndarray) -> np.ndarray:
        return move_about(start, middle, step)

    seen_by = partial(project_through_window, camera.model, camera.window, medium_index=camera.medium_index)

    def projected(pose: np.ndarray, points: np.ndarray) -> np.ndarray:
        return seen_by(points @ pose[:3, :3].T + pose[:3, 3])

    pixels = view.pixels
    if (diameter_mm := target.circle_diameter_mm) is not None:
        pixels = pixels - centre_offsets(seen_by, start, view.points_mm, diameter_mm=diameter_mm)
    if not np.isfinite(projected(start, view.points_mm)).all():
        raise CalibrationError("its pose would be in front of the window")
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
    if (known := camera.known) is not None:
        # Derivative of the pose if the sensor's parameters change and the pixels do not.
        found, where = moved(fit.x), np.zeros(6)
        by_pose = differences(
            lambda step: projected(move_about(found, middle, step), view.points_mm), where, POSE_STEPS
        )
        placed = view.points_mm @ found[:3, :3].T + found[:3, 3]
        std = np.sqrt(np.diag(known.covariance))
        values = np.array([*known.values().values()]) if isinstance(known, LensCalibration) else known.values
        by_values = differences(partial(known.project, placed), values, 1e-2 * std)
        by_sensor = -np.linalg.lstsq(by_pose, by_values, rcond=None)[0]
    return BoardImage(name, moved(fit.x), covariance, len(pixels), spread, base_from_platform, by_sensor)


def move_about(pose: np.ndarray, middle: np.ndarray, step: np.ndarray) -> np.ndarray:
    """Shift a point ``middle`` of a pose (4, 4) by (3,) and rotate the pose about it by (3,)."""
    rotation = Rotation.from_rotvec(step[3:]).as_matrix() @ pose[:3, :3]
    place = pose[:3, :3] @ middle + pose[:3, 3] + step[:3]
    return rigid_transform(rotation, place - rotation @ middle)


_State = tuple[np.ndarray, np.ndarray]  # ``T_platform_sensor`` and ``T_base_target``, (4, 4) each


@dataclass(frozen=True, eq=False)
class BoardEvidence(GroupedEvidence[_State]):
    """Target images at several poses; ``camera_from_sensor`` (4, 4) and the target's middle (3,) in its own frame.

    The parameters are steps of the mount and of the target. The scatter components are a factor of the image errors,
    and the platform's scatter of position (mm) and rotation (rad).
    """

    images: Sequence[BoardImage]
    camera_from_sensor: np.ndarray
    middle: np.ndarray
    table: bool = False

    @property
    def values(self) -> int:
        return 12

    @cached_property
    def _platforms(self) -> np.ndarray:
        return np.array([image.base_from_platform for image in self.images])

    @cached_property
    def _sensor_from_target(self) -> np.ndarray:
        return np.linalg.inv(self.camera_from_sensor) @ np.array([image.camera_from_target for image in self.images])

    def select(self, kept: np.ndarray) -> Self:
        return replace(self, images=[self.images[k] for k in np.arange(len(self.images))[kept]])

    def bounds(self) -> np.ndarray:
        return _BOUNDS

    def start(self) -> _State:
        """Estimate mount and target in closed form (Park and Martin) from the relative motions of all image pairs."""
        seen, held = self._sensor_from_target, self._platforms
        first, second = np.triu_indices(len(held), 1)
        tools = np.linalg.inv(held[first]) @ held[second]
        boards = seen[first] @ np.linalg.inv(seen[second])
        by_tool, by_board = (Rotation.from_matrix(each[:, :3, :3]).as_rotvec() for each in (tools, boards))
        if self.table:
            # All rotations are about z: align the table's x axis with the sensor's, made perpendicular to the axis.
            axis = by_board.T @ by_tool[:, 2]
            by_tool, by_board = np.eye(3)[[2, 0]], np.array([axis, np.eye(3)[np.argmin(np.abs(axis))]])
        with warnings.catch_warnings():
            # Rotations about one axis only are reported from the covariance.
            warnings.simplefilter("ignore", UserWarning)
            weights = [np.inf, 1.0] if self.table else None
            rotation = Rotation.align_vectors(by_tool, by_board, weights)[0].as_matrix()
        known = boards[:, :3, 3] @ rotation.T - tools[:, :3, 3]
        unknown = (tools[:, :3, :3] - np.eye(3)).reshape(-1, 3)
        mount = rigid_transform(rotation, np.linalg.lstsq(unknown, known.ravel(), rcond=None)[0])
        places = held @ mount @ seen
        turns = Rotation.from_matrix(places[:, :3, :3]).mean().as_matrix()
        middles = places[:, :3, :3] @ self.middle + places[:, :3, 3]
        return mount, rigid_transform(turns, np.median(middles, axis=0) - turns @ self.middle)

    def residuals(self, state: _State, step: np.ndarray | None = None) -> np.ndarray:
        """Return each image's deviation (K, 6) from the common target pose: shift (mm) and rotation (rad)."""
        mount, common = state if step is None else self.apply_step(state, step)
        boards = self._platforms @ mount @ self._sensor_from_target
        shift = (boards - common)[:, :3] @ np.append(self.middle, 1.0)
        return np.hstack([shift, Rotation.from_matrix(boards[:, :3, :3] @ common[:3, :3].T).as_rotvec()])

    def covariance(self, state: _State) -> Callable[[np.ndarray], tuple[np.ndarray, np.ndarray]]:
        both, middle = self._differentiate_by_images(state[0]), state[1][:3] @ np.append(self.middle, 1.0)
        # A rotation error of the platform shifts points far from its origin.
        lever = np.tile(np.eye(6, 3, -3), (len(both), 1, 1))
        for axis, unit in enumerate(np.eye(3)):
            lever[:, :3, axis] = np.cross(unit, middle - self._platforms[:, :3, 3])
        images = both @ np.array([image.covariance for image in self.images]) @ both.swapaxes(1, 2)
        units = np.array(
            [images, np.broadcast_to(np.diag([1.0] * 3 + [0.0] * 3), images.shape), lever @ lever.swapaxes(1, 2)]
        )

        def covariances(logs: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
            parts = np.exp(2 * logs)[:, None, None, None] * units
            return parts.sum(axis=0), 2 * parts

        return covariances

    def pose_directions(self, state: _State) -> list[np.ndarray]:
        return [np.eye(6)] * len(self.images)

    def _differentiate_by_images(self, mount: np.ndarray) -> np.ndarray:
        """Return derivatives (K, 6, 6) of the residuals by the image errors, which are rotated into the base frame."""
        turn = (self._platforms @ mount @ np.linalg.inv(self.camera_from_sensor))[:, :3, :3]
        both = np.zeros((len(turn), 6, 6))
        both[:, :3, :3] = both[:, 3:, 3:] = turn
        return both

    def residual_derivatives(self, state: _State) -> np.ndarray:
        """Return derivatives (K, 6, Q) of the residuals by the parameters of the sensor's calibration."""
        return self._differentiate_by_images(state[0]) @ np.array([image.by_sensor for image in self.images])

    def jacobian(self, state: _State, step: np.ndarray | None = None) -> np.ndarray:
        at, steps = np.zeros(self.size) if step is None else step, np.tile(POSE_STEPS, 2) @ self.free
        return differences(partial(self.residuals, state), at, steps).reshape(-1, 6, self.size)

    def apply_step(self, state: _State, step: np.ndarray) -> _State:
        """Shift and rotate the mount along the platform's axes, then the target about its middle."""
        (mount, common), step = state, self.free @ step
        turned = Rotation.from_rotvec(step[3:6]).as_matrix() @ mount[:3, :3]
        return rigid_transform(turned, mount[:3, 3] + step[:3]), move_about(common, self.middle, step[6:])

    def typical_miss(self, state: _State) -> float:
        """Return the median deviation over the images, of the target's middle and of points beside it, mm."""
        left = self.residuals(state)
        distance = np.linalg.norm(self._sensor_from_target[:, :3, 3], axis=1) + 1.0
        return float(np.median(np.linalg.norm(left[:, :3], axis=1) + distance * np.linalg.norm(left[:, 3:], axis=1)))

    def offsets_mm(self, state: _State) -> np.ndarray:
        """Return the distances (K,) of the target's middle in each image from the common place."""
        return np.linalg.norm(self.residuals(state)[:, :3], axis=1)


def select_agreeing_images(evidence: BoardEvidence) -> tuple[RestrictedEstimate[_State], np.ndarray]:
    """Estimate the mount from the images that agree; return it with their mask.

    Raises CalibrationError if too few images agree.
    """
    rng, count = np.random.default_rng(0), len(evidence.images)
    # A wrong image spoils the closed form, so start from random triples of images too.
    triples = [evidence.select(rng.choice(count, 3, replace=False)).start() for _ in range(_TRIPLES)]
    state = min([evidence.start(), *triples], key=evidence.typical_miss)
    left = evidence.residuals(state)
    sizes = np.median(np.linalg.norm(left.reshape(count, 2, 3), axis=2), axis=0)
    spread = np.maximum(sizes, (_LEAST_MM, _LEAST_RAD))
    rough = np.tile(np.diag(np.repeat(spread, 3) ** 2), (count, 1, 1))
    state = evidence.apply_step(state, solve_step(evidence, state, rough, loss="cauchy"))
    sizes = (np.abs(evidence.residuals(state)) / np.repeat(spread, 3)).max(axis=1)
    near = np.flatnonzero(sizes < LARGEST_ROUGH * max(float(np.median(sizes)), 1.0))

    def require(kept: np.ndarray) -> None:
        if np.count_nonzero(kept) < FEWEST_IMAGES:
            raise CalibrationError(
                f"{np.count_nonzero(kept)} of {count} images of the target agree with the poses; at least "
                f"{FEWEST_IMAGES} are needed. Check that the poses are T_base_platform, their format, and that they "
                "are in the order of the images"
            )

    starts = [(each, np.array([1.0, *spread])) for each in (state, evidence.select(near).start())]
    found, among = settle_agreeing(evidence.select(near), starts, require=require)
    kept = np.zeros(count, dtype=bool)
    kept[near[among]] = True
    return found, kept
