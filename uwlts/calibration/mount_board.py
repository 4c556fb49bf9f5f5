"""Mount of a calibrated sensor from images of a target from several poses of its platform (hand-eye calibration).

Or the axis of a rotary table that turns the target.
"""

import warnings
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from scipy.optimize import least_squares, minimize
from scipy.spatial.transform import Rotation
from scipy.stats import chi2, t

from uwlts.calibration.joint.stored_estimate import stored_estimate
from uwlts.calibration.mount_board_images import (
    FEWEST_IMAGES,
    POSE_STEPS,
    BoardImage,
    board_images,
    differences,
    moved_about,
    rigid_transform,
)
from uwlts.calibration.mount_next_pose import missing_turns
from uwlts.calibration.mount_sensor import with_sensor
from uwlts.errors import CalibrationError
from uwlts.files.writing import sha256_of
from uwlts.model.calibration import Calibration
from uwlts.model.mount import BoardFound, Mount, MountPose
from uwlts.storage.capture import Capture
from uwlts.storage.mount_files import SENSOR_AXES, SensorAxis, require_table

_FALSE_ALARM = 1e-3
"""Probability that any image of a campaign without wrong ones is left out."""
_NO_FIT = 0.1
"""Share of the target's extent by which platforms do not err; a wrong format of the poses gives more."""
_OPEN_MM, _OPEN_RAD = 5.0, np.radians(1.0)
"""Standard uncertainties from which a mount counts as not determined."""
_ROUNDS = 8
_TRIPLES = 100
"""With a third of the images wrong, three right ones are missed by all of them once in 10^15 times."""


def mount_by_board(
    captures: Sequence[Capture],
    calibration: Calibration,
    poses: np.ndarray | None = None,
    *,
    axis: SensorAxis | None = None,
) -> Mount:
    """``T_platform_sensor`` from images of a target at an unknown fixed place, the sensor's calibration held fixed.

    What a joint estimate of the calibration leaves open becomes part of the covariance.

    Each image gives the target's pose before the camera, through window and medium. A closed form (Park and Martin,
    IEEE Trans. Robotics and Automation 10, 1994) starts a least-squares estimate of mount and target's place, weighted
    by the covariance of each image and the scatter of the platform in position and rotation. Restricted maximum
    likelihood gives both, and by which factor images err more than their points' scatter says, as those of a bent
    target do. Images that contradict the others are left out.

    Parameters
    ----------
    captures
        Images with the laser off show the target that the captures describe.
    calibration
        Of the sensor.
    poses
        ``T_base_platform`` (P, 4, 4) of the images with the laser off, in their order, in place of the captures' own.
    axis
        The platform is a rotary table that turns the target, as for `uwlts.calibrate_mount`.

    Raises
    ------
    DescriptionError
        A capture does not describe its target, or images have no pose.
    CalibrationError
        Too few images show the target, or the poses do not determine the mount or contradict the images.
    """
    header = captures[0].header
    known = None if calibration.joint is None else stored_estimate(calibration, header.sensor, header.medium)
    target, images, reasons = board_images(captures, calibration, known, poses)
    middle = target.points_mm.mean(axis=0)
    rotations = Rotation.from_matrix([image.base_from_platform[:3, :3] for image in images])
    if axis is not None:
        require_table(np.array([image.base_from_platform for image in images]), axis=axis)
    elif missing := missing_turns(rotations, least_rad=_OPEN_RAD):
        raise CalibrationError(f"the poses do not determine the mount: {'; '.join(missing)}")
    problem = _Problem(images, calibration.object_transform(), middle, axis is not None)
    used, state, scatter = problem.robust()
    extent = float(np.linalg.norm(np.ptp(target.points_mm, axis=0)))
    left_out = [image for image in images if image not in used.images]
    if scatter[0] > _NO_FIT * extent or 2 * len(used.images) < len(images):
        raise CalibrationError(
            f"no mount makes the images fit: the poses would be wrong by {scatter[0]:.3g} mm (rms), with "
            f"{len(left_out)} of {len(images)} left out. Are the poses T_base_platform, is their format right, are "
            "their units right, and do they come in the order of the images?"
        )
    if axis is not None and state[0][2, :3] @ SENSOR_AXES[axis] <= 0:
        raise CalibrationError(
            f"the images turn about an axis that points away from {axis} of the sensor's frame, to "
            f"({', '.join(f'{each:.2f}' for each in state[0][2, :3])}): are the angles counted the other way round?"
        )
    covariance, share = used.free @ np.linalg.inv(used.information(state, scatter)) @ used.free.T, None
    if known is not None:
        covariance, share = with_sensor(covariance, used.by_sensor(state, scatter), state[0][:3, :3], known)
    missing = []
    if axis is None:
        missing = missing_turns(Rotation.from_matrix([each.base_from_platform[:3, :3] for each in used.images]))
    shift, turn = (float(np.sqrt(np.linalg.eigvalsh(covariance[k : k + 3, k : k + 3])[-1])) for k in (0, 3))
    if shift > _OPEN_MM or turn > _OPEN_RAD:
        known = f"known to {shift:.2g} mm and {np.degrees(turn):.2g} deg only"
        raise CalibrationError(f"the poses do not determine the mount, {known}: {'; '.join(missing) or 'add poses'}")
    found = {image.name: used.offsets_mm(state)[k] for k, image in enumerate(used.images)}
    held = {image.name: used.without(k).predicted_mm(image, scatter) for k, image in enumerate(used.images)}
    rows = [
        MountPose(
            name=image.name,
            points=image.points,
            points_left_out=0,
            rms_mm=found.get(image.name),
            held_out_mm=held.get(image.name),
            reason=None if image.name in found else "contradicts the other images",
        )
        for image in images
    ] + [MountPose(name=name, points=0, points_left_out=0, reason=reason) for name, reason in reasons.items()]
    distance = float(np.median([image.camera_from_target[2, 3] for image in used.images]))
    rms_px = float(np.sqrt(np.mean([image.rms_px**2 for image in used.images])))
    return Mount(
        T_platform_sensor=_rows(state[0]),
        covariance=tuple(tuple(row) for row in ((covariance + covariance.T) / 2)[:6, :6].tolist()),
        coverage_factor=float(t.ppf(0.975, 6 * len(used.images) - used.size - 3)),
        artefact=BoardFound(T_base_target=_rows(state[1])),
        point_std_mm=rms_px * distance / calibration.camera.fx_px,
        pose_std_mm=float(scatter[0]),
        rms_mm=float(np.sqrt(np.mean(np.square(list(found.values()))))),
        held_out_rms_mm=float(np.sqrt(np.mean(np.square(list(held.values()))))),
        table=axis is not None,
        sensor=share,
        poses=tuple(rows),
        weaknesses=tuple(missing),
        inputs={capture.path.name: sha256_of(capture.path) for capture in captures},
    )


def _rows(matrix: np.ndarray) -> tuple[tuple[float, ...], ...]:
    return tuple(tuple(row) for row in matrix.tolist())


_State = tuple[np.ndarray, np.ndarray]
"""``T_platform_sensor`` and ``T_base_target``, (4, 4) each."""


@dataclass(frozen=True, eq=False)
class _Problem:
    """Images of a target, ``T_camera_sensor`` and the target's middle (3,) in its own frame.

    The parameters are steps of mount and target; on a rotary table (``table``) shift of the mount along its z axis and
    turn about it change nothing, and are none.
    """

    images: Sequence[BoardImage]
    camera_from_sensor: np.ndarray
    middle: np.ndarray
    table: bool = False

    @cached_property
    def free(self) -> np.ndarray:
        """Steps (12, size) of mount and target by the parameters."""
        return np.delete(np.eye(12), (2, 5), axis=1) if self.table else np.eye(12)

    @property
    def size(self) -> int:
        """Number of parameters."""
        return self.free.shape[1]

    @cached_property
    def _platforms(self) -> np.ndarray:
        return np.array([image.base_from_platform for image in self.images])

    @cached_property
    def _sensor_from_target(self) -> np.ndarray:
        return np.linalg.inv(self.camera_from_sensor) @ np.array([image.camera_from_target for image in self.images])

    @cached_property
    def _covariances(self) -> np.ndarray:
        return np.array([image.covariance for image in self.images])

    def without(self, number: int) -> "_Problem":
        kept = [image for k, image in enumerate(self.images) if k != number]
        return replace(self, images=kept)

    def start(self) -> _State:
        """Mount and target by Park and Martin from the relative motions of all pairs of images."""
        seen, held = self._sensor_from_target, self._platforms
        first, second = np.triu_indices(len(held), 1)
        tools = np.linalg.inv(held[first]) @ held[second]
        boards = seen[first] @ np.linalg.inv(seen[second])
        by_tool, by_board = (Rotation.from_matrix(each[:, :3, :3]).as_rotvec() for each in (tools, boards))
        if self.table:
            # Turns about z alone: the sensor's x axis, made square to the axis, shall be the table's.
            axis = by_board.T @ by_tool[:, 2]
            by_tool, by_board = np.eye(3)[[2, 0]], np.array([axis, np.eye(3)[np.argmin(np.abs(axis))]])
        with warnings.catch_warnings():
            # Turns about one axis only: the covariance tells.
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

    def residuals(self, state: _State) -> np.ndarray:
        """Per image (K, 6): where its target lies beside the common one, shift of the middle in mm and turn in rad."""
        mount, common = state
        own = self._platforms @ mount @ self._sensor_from_target
        shift = (own - common)[:, :3] @ np.append(self.middle, 1.0)
        return np.hstack([shift, Rotation.from_matrix(own[:, :3, :3] @ common[:3, :3].T).as_rotvec()])

    def covariances(self, state: _State, scatter: np.ndarray) -> np.ndarray:
        """Of the residuals (K, 6, 6).

        ``scatter`` (3,) are those of the platform's positions (mm) and turns (rad), and the factor of the images'.
        """
        both, middle = self._by_images(state[0]), state[1][:3] @ np.append(self.middle, 1.0)
        # A turn of the platform moves what is far from its origin.
        lever = np.tile(np.eye(6, 3, -3), (len(both), 1, 1))
        for axis, unit in enumerate(np.eye(3)):
            lever[:, :3, axis] = np.cross(unit, middle - self._platforms[:, :3, 3])
        result = scatter[2] ** 2 * both @ self._covariances @ both.swapaxes(1, 2)
        result += scatter[1] ** 2 * lever @ lever.swapaxes(1, 2)
        result[:, :3, :3] += scatter[0] ** 2 * np.eye(3)
        return result

    def _by_images(self, mount: np.ndarray) -> np.ndarray:
        """Derivatives (K, 6, 6) of the residuals by the errors of the images: these turned into the base frame."""
        turn = (self._platforms @ mount @ np.linalg.inv(self.camera_from_sensor))[:, :3, :3]
        both = np.zeros((len(turn), 6, 6))
        both[:, :3, :3] = both[:, 3:, 3:] = turn
        return both

    def by_sensor(self, state: _State, scatter: np.ndarray) -> np.ndarray:
        """Derivatives (12, Q) of the solution by the parameters of the sensor's calibration."""
        by, inverse = self.jacobian(state), np.linalg.inv(self.covariances(state, scatter))
        moved = self._by_images(state[0]) @ np.array([image.by_sensor for image in self.images])
        information = np.einsum("kij,kil,klm->jm", by, inverse, by)
        return -self.free @ np.linalg.solve(information, np.einsum("kij,kil,klq->jq", by, inverse, moved))

    def jacobian(self, state: _State) -> np.ndarray:
        """Derivatives (K, 6, size) by the parameters."""
        moved = differences(lambda step: self.residuals(self._moved(state, step)), np.zeros(12), np.tile(POSE_STEPS, 2))
        return moved.reshape(-1, 6, 12) @ self.free

    def stepped(self, state: _State, step: np.ndarray) -> _State:
        """The state after a step (size,) of the parameters."""
        return self._moved(state, self.free @ step)

    def _moved(self, state: _State, step: np.ndarray) -> _State:
        """The state after a shift and a turn of the mount about the platform's axes, and of the target's middle."""
        mount, common = state
        turned = Rotation.from_rotvec(step[3:6]).as_matrix() @ mount[:3, :3]
        return rigid_transform(turned, mount[:3, 3] + step[:3]), moved_about(common, self.middle, step[6:])

    def information(self, state: _State, scatter: np.ndarray) -> np.ndarray:
        """Information matrix (size, size) of the parameters."""
        by, inverse = self.jacobian(state), np.linalg.inv(self.covariances(state, scatter))
        return np.einsum("kij,kil,klm->jm", by, inverse, by)

    def solved(self, state: _State, scatter: np.ndarray) -> _State:
        """Weighted least squares by Gauss-Newton."""
        for _ in range(_ROUNDS):
            by, inverse = self.jacobian(state), np.linalg.inv(self.covariances(state, scatter))
            slope = np.einsum("kij,kil,kl->j", by, inverse, self.residuals(state))
            step = -np.linalg.lstsq(np.einsum("kij,kil,klm->jm", by, inverse, by), slope, rcond=1e-15)[0]
            state = self.stepped(state, step)
            if np.abs(step).max() < 1e-9:
                break
        return state

    def estimated(self, state: _State, scatter: np.ndarray) -> tuple[_State, np.ndarray]:
        """State and scatter by restricted maximum likelihood."""
        for _ in range(_ROUNDS):
            state = self.solved(state, scatter)
            left, by = self.residuals(state), self.jacobian(state)

            def cost(logs: np.ndarray, at: _State = state, left: np.ndarray = left, by: np.ndarray = by) -> float:
                variances = self.covariances(at, np.exp(logs))
                inverse = np.linalg.inv(variances)
                information = np.einsum("kij,kil,klm->jm", by, inverse, by)
                return float(
                    np.linalg.slogdet(variances)[1].sum()
                    + np.linalg.slogdet(information)[1]
                    + np.einsum("ki,kij,kj->", left, inverse, left)
                )

            bounds = [tuple(np.log(limits)) for limits in _BOUNDS]
            found = np.exp(minimize(cost, np.log(scatter), method="L-BFGS-B", bounds=bounds).x)
            if np.abs(np.log(found / scatter)).max() < 1e-3:
                return state, found
            scatter = found
        return state, scatter

    def robust(self) -> tuple["_Problem", _State, np.ndarray]:
        """The problem of the images that agree, its state and its scatter."""
        rng, count = np.random.default_rng(0), len(self.images)
        # A wrong image spoils the closed form, so that it starts from three images at a time too.
        triples = [self._only(rng.choice(count, 3, replace=False)).start() for _ in range(_TRIPLES)]
        state = min([self.start(), *triples], key=self._typical_miss)
        left = self.residuals(state)
        spread = [max(float(np.median(np.linalg.norm(left[:, k : k + 3], axis=1))), least) for k, least in _LEAST]
        fit = least_squares(
            lambda step: (self.residuals(self.stepped(state, step)) / np.repeat(spread, 3)).ravel(),
            np.zeros(self.size),
            x_scale=np.tile(np.repeat(spread, 3), 2) @ self.free,
            loss="cauchy",
        )
        state, used = self.stepped(state, fit.x), self
        sizes = np.abs(self.residuals(state)).reshape(-1, 2, 3).max(axis=2) / spread
        rough = sizes.max(axis=1) < 6 * max(float(np.median(sizes.max(axis=1))), 1.0)
        used = replace(self, images=[image for image, good in zip(self.images, rough, strict=True) if good])
        while True:
            used.require_enough(len(self.images))
            state, scatter = used.estimated(state, np.array([*spread, 1.0]))
            excess = [used.without(k).surprise(image, state, scatter) for k, image in enumerate(used.images)]
            if max(excess) <= chi2.isf(_FALSE_ALARM / len(self.images), 6):
                return used, state, scatter
            used = used.without(int(np.argmax(excess)))

    def _only(self, numbers: np.ndarray) -> "_Problem":
        return replace(self, images=[self.images[k] for k in numbers])

    def _typical_miss(self, state: _State) -> float:
        """Median distance by which images miss, of the target's middle and of what lies its distance aside, mm."""
        left = self.residuals(state)
        away = np.linalg.norm(self._sensor_from_target[:, :3, 3], axis=1) + 1.0
        return float(np.median(np.linalg.norm(left[:, :3], axis=1) + away * np.linalg.norm(left[:, 3:], axis=1)))

    def require_enough(self, images: int) -> None:
        """CalibrationError with too few images."""
        if len(self.images) < FEWEST_IMAGES:
            raise CalibrationError(
                f"{len(self.images)} of {images} images of the target agree with the poses; at least {FEWEST_IMAGES} "
                "are needed. Are the poses T_base_platform, is their format right, do they come in the images' order?"
            )

    def surprise(self, image: BoardImage, state: _State, scatter: np.ndarray) -> float:
        """Squared residuals of an image over the variance with which these images predict them: chi-square of six."""
        state = self.solved(state, scatter)
        other = replace(self, images=[image])
        by, left = other.jacobian(state)[0], other.residuals(state)[0]
        variance = other.covariances(state, scatter)[0] + by @ np.linalg.pinv(self.information(state, scatter)) @ by.T
        return float(left @ np.linalg.solve(variance, left))

    def predicted_mm(self, image: BoardImage, scatter: np.ndarray) -> float:
        """How far an image shows the target's middle from where these images place it, mm."""
        state = self.solved(self.start(), scatter)
        return float(replace(self, images=[image]).offsets_mm(state)[0])

    def offsets_mm(self, state: _State) -> np.ndarray:
        """Distances (K,) of the target's middle in each image from the common place."""
        return np.linalg.norm(self.residuals(state)[:, :3], axis=1)


_BOUNDS = (1e-4, 1e3), (1e-7, 1.0), (1.0, 100.0)
"""Of the scatter: mm, rad, and the factor of the images'."""
_LEAST = ((0, 1e-3), (3, 1e-6))
"""First component of shift and turn, and the least scatter that counts, mm and rad."""
