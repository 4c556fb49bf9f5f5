"""Guidance during a calibration, without hardware: what the images determine, what is missing, and what to record next.

For the camera, it is the most helpful pose of the target; for the window, depths of the step standard.
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from itertools import product
from typing import Annotated

import cv2
import numpy as np
from pydantic import Field

from uwlts.calibration.camera.camera_parameters import (
    CameraOptions,
    Intrinsics,
    Placement,
    TargetImage,
    observe,
    pose_values,
)
from uwlts.calibration.camera.image_quality import LaserFault
from uwlts.calibration.camera.target_poses import CameraSolution, Poses, find_pose, solve_camera
from uwlts.calibration.capture_evidence import StepEvidence
from uwlts.calibration.sequential.sheet_fit import fit_sheet, points_on_target
from uwlts.calibration.sequential.step_images import label_step
from uwlts.errors import CalibrationError, EvaluationError, ImageError, RangeError
from uwlts.fitting.next_observation import Candidate, CovarianceRoot, Forecast, eliminate_others, rank_candidates
from uwlts.model.artefacts import StepStandard
from uwlts.model.calibration import Calibration, CameraModel, WindowModel, rigid_transform
from uwlts.model.parameter_keys import LensParameter
from uwlts.model.placement import laser_pose
from uwlts.model.sensor import Description, Medium, NotNegative, Positive, Sensor
from uwlts.optics.camera import directions, project
from uwlts.optics.triangulation import points_on_sheet
from uwlts.stripe import StripeStatus, extract_stripe
from uwlts.stripe.capture_stripes import FEWEST_LINES
from uwlts.targets import Target, TargetView

_CONTRADICTION = 3.0  # ratio to the residual of the other images above which an image contradicts them
_ALLOWANCE_PX = 0.1  # additional contribution of noise


@dataclass(frozen=True, eq=False)
class RecordedPose:
    """Recorded pose of the target: lamp image, stripe (N, 2) on the target, and stage position."""

    view: TargetView
    stripe: np.ndarray
    stage_mm: float


@dataclass(frozen=True)
class Setting:
    """Sensor, target, medium, and how the recorded poses are related."""

    sensor: Sensor
    target: Target
    medium: Medium
    poses: Poses
    approaching: bool = True

    def intrinsics(self) -> Intrinsics:
        """Return the camera parameters that are estimated."""
        camera = self.sensor.camera
        return Intrinsics(
            CameraOptions().with_described_pixels(camera), width_px=camera.width_px, height_px=camera.height_px
        )


def nominal_camera(setting: Setting) -> CameraModel:
    """Return the described camera; behind a window, the medium's index multiplies its focal length."""
    camera = setting.sensor.camera
    index = setting.medium.refractive_index(setting.sensor.laser.wavelength_nm) if camera.window.mounted else 1.0
    return CameraModel.from_description(camera, magnified=index)


def estimate_pose(view: TargetView | TargetImage, camera: CameraModel) -> np.ndarray:
    """Estimate ``T_camera_target`` (4, 4) of a view with a known camera.

    Raises CalibrationError if no pose fits the points.
    """
    pose = find_pose(view.points_mm, view.pixels, camera.matrix(), camera.coefficients())
    return rigid_transform(cv2.Rodrigues(pose[:3])[0], pose[3:])


def judge_residual(before: CameraSolution | None, after: CameraSolution) -> tuple[str, ...]:
    """Return a reason if the last image of ``after`` contradicts those of ``before``."""
    if before is None:
        return ()
    rms, usual = after.image_rms_px(), before.rms_px()
    limit = _CONTRADICTION * usual + _ALLOWANCE_PX
    # A wrong image also changes the residuals of the others.
    worst = max(float(rms[-1]), float(np.sqrt(np.mean(rms[:-1] ** 2))))
    reason = (
        f"contradicts the others: with it the residual is {worst:.2f} px, without it {usual:.2f} px, at most "
        f"{limit:.2f} px is plausible; did the target bend, the stage slip, the lens turn?"
    )
    return () if worst <= limit else (reason,)


def remove_window(sensor: Sensor) -> Sensor:
    """Return the sensor without its camera's window."""
    window = sensor.camera.window.model_copy(update={"mounted": False})
    return sensor.model_copy(update={"camera": sensor.camera.model_copy(update={"window": window})})


_LONG_SIDE_CELLS = 8  # fine enough for distortion, coarse enough to be filled by about ten images
_POINTS_IN_CELL = 3  # one or two may be a corner of the target that touches the cell


@dataclass(frozen=True, eq=False)
class Coverage:
    """Points of all images in a grid of nearly square cells over the image: ``counts`` (rows, columns)."""

    counts: np.ndarray
    width_px: int
    height_px: int

    @property
    def covered(self) -> np.ndarray:
        """Mask (rows, columns) of the cells with at least three points."""
        return self.counts >= _POINTS_IN_CELL

    @property
    def share(self) -> float:
        """Fraction of the cells that are covered."""
        return float(self.covered.mean())

    def with_points(self, pixels: np.ndarray) -> "Coverage":
        """Add the points (N, 2) of one image; points outside the image are ignored."""
        # Pixel (0, 0) is the centre of the first pixel, so the image starts half a pixel before it.
        image = (-0.5, self.height_px - 0.5), (-0.5, self.width_px - 0.5)
        added = np.histogram2d(pixels[:, 1], pixels[:, 0], bins=self.counts.shape, range=image)[0]
        return replace(self, counts=self.counts + added.astype(int))

    def emptiest(self) -> str | None:
        """Name the ninth of the image with most empty cells; None if no cell is empty."""
        empty = ~self.covered
        if not empty.any():
            return None
        rows, columns = (3 * np.arange(n) // n for n in empty.shape)
        ninths = np.zeros((3, 3))
        np.add.at(ninths, (rows[:, None], columns[None, :]), empty)
        row, column = np.unravel_index(int(np.argmax(ninths)), (3, 3))
        return place_words((column + 0.5) / 3, (row + 0.5) / 3)


def coverage_of(views: Sequence[np.ndarray], *, width_px: int, height_px: int) -> Coverage:
    """Return the coverage by the points (N, 2) of any number of images."""
    side = max(width_px, height_px) / _LONG_SIDE_CELLS
    shape = max(2, round(height_px / side)), max(2, round(width_px / side))
    coverage = Coverage(np.zeros(shape, dtype=np.int64), width_px, height_px)
    for pixels in views:
        coverage = coverage.with_points(pixels)
    return coverage


def place_words(x: float, y: float) -> str:
    """Name a position in the image; x and y are fractions of its width and height."""
    across = "left" if x < 0.4 else "right" if x > 0.6 else ""
    if 0.4 <= y <= 0.6:
        return across or "middle"
    return f"{'upper' if y < 0.4 else 'lower'} {across}" if across else ("top" if y < 0.4 else "bottom")


def tilts_rad(pose: np.ndarray) -> tuple[float, float]:
    """Return the tilts of a pose ``T_camera_target`` (4, 4): right side farther, lower side farther."""
    normal = pose[:3, 2] * np.sign(pose[2, 2] or 1.0)
    return float(np.arctan2(-normal[0], normal[2])), float(np.arctan2(-normal[1], normal[2]))


_TILT_RAD = np.radians(25.0)  # easily reached by hand, and printed circles remain detectable
_PLACES = (0.2, 0.5, 0.8)  # fractions of the image's sides
_DEPTHS = (0.1, 0.5, 0.9)  # fractions of the working range
_MARGIN_PX = 10.0  # margin of the image, in which circles would be cut
_SAMPLE = 100  # points used for a candidate's information; more are redundant
_USUAL_SIGMA_PX = 0.1  # usual point noise, until residuals are known
_LEAST_SIGMA_PX = 0.02  # smallest point noise: sharp circles, also in reality
# Prior standard deviations of a described lens: relative to the focal length and the image's side, and of plain
# coefficients.
_FOCAL: tuple[LensParameter, ...] = (LensParameter.F, LensParameter.FX, LensParameter.FY)
_CENTRE: tuple[LensParameter, ...] = (LensParameter.CX, LensParameter.CY)
_PRIOR = dict.fromkeys((*_FOCAL, *_CENTRE), 0.05) | {
    LensParameter.K1: 0.3,
    LensParameter.K2: 3.0,
    LensParameter.P1: 0.02,
    LensParameter.P2: 0.02,
    LensParameter.K3: 10.0,
}
_COVERAGE_WEIGHT = 4.0  # log of the factor, 55, in a standard deviation that equals a fully uncovered image
_SPREAD_WEIGHT = 0.5  # the same, a factor of 1.6, for a side of the target that was never tilted
_SIDES = ("right side", "left side", "lower side", "upper side")
_BEYOND = 0.05  # decides between poses once all limits are reached
_SAME_TILT_RAD = np.radians(9.0)  # tilt difference from the advised pose without an instruction: a hand can keep it
_SAME_PLACE = 0.15  # the same for the target's middle, relative to the image's sides
_SAME_DISTANCE = 0.1  # the same for the distance, relative to it


class CompletionLimits(Description):
    """Limits of a complete calibration."""

    # Standard deviations of the focal length and of the principal point.
    focal_std_px: Positive = 0.5
    centre_std_px: Positive = 0.5
    coverage: Annotated[float, Field(gt=0, le=1)] = 0.85  # fraction of the image's cells with points
    tilt_deg: NotNegative = 12.0
    """For free poses, tilt that each of the target's four sides must reach once. It reveals a target that is not
    flat or not as described."""
    fewest_images: Annotated[int, Field(ge=3)] = 8

    def std_px(self) -> dict[LensParameter, float]:
        """Return the limits of the standard deviations by parameter."""
        return dict.fromkeys(_FOCAL, self.focal_std_px) | dict.fromkeys(_CENTRE, self.centre_std_px)


@dataclass(frozen=True, eq=False)
class State:
    """State of a calibration after the recorded poses."""

    setting: Setting
    wanted: CompletionLimits
    recorded: tuple[RecordedPose, ...]
    camera: CameraModel  # known so far
    solution: CameraSolution | None  # None if the poses do not determine it
    undetermined: str  # reason why the poses do not determine it
    poses: np.ndarray  # (F, 4, 4); ``T_camera_target`` of the recorded poses
    coverage: Coverage
    known: CovarianceRoot  # of the camera's parameters, initially from the description

    @property
    def keys(self) -> tuple[LensParameter, ...]:
        """Parameters of the camera."""
        return self.setting.intrinsics().keys

    @property
    def sigma_px(self) -> float:
        """Point noise of the images so far."""
        return _USUAL_SIGMA_PX if self.solution is None else max(self.solution.sigma_px, _LEAST_SIGMA_PX)

    def std(self) -> dict[LensParameter, float]:
        """Return the standard deviation of every camera parameter: the solution's, else the expected one."""
        if self.solution is None:
            return self.expected_std()
        return dict(zip(self.keys, self.solution.std().values(), strict=True))

    def expected_std(self) -> dict[LensParameter, float]:
        """Return the standard deviations that follow from the information."""
        return dict(zip(self.keys, self.known.std(np.eye(len(self.keys))).tolist(), strict=True))

    def information_of(self, points_mm: np.ndarray, pixels: np.ndarray, pose: np.ndarray) -> np.ndarray:
        """Return the information (P, P) of one image with unknown pose, near ``pose``, on the camera's parameters.

        Zeros for a pose behind the camera.
        """
        intrinsics, count = self.setting.intrinsics(), len(points_mm)
        placement = Placement(points_mm, np.zeros(count), pixels, np.zeros(count, dtype=int), 1.0)
        seen = observe(placement, intrinsics, intrinsics.from_model(self.camera), pose_values(pose))
        if seen is None:
            return np.zeros((len(self.keys),) * 2)
        rows = np.hstack([seen.by_global, seen.by_local]) / self.sigma_px
        return eliminate_others(rows.T @ rows, len(self.keys))

    def showing(self, pose: np.ndarray, pixels: np.ndarray) -> "State":
        """Add the tilt and the coverage of an image with a pose (4, 4) and pixels (N, 2)."""
        poses, coverage = np.concatenate([self.poses, pose[None]]), self.coverage.with_points(pixels)
        return replace(self, poses=poses, coverage=coverage)

    def with_view(self, view: TargetView, pose: np.ndarray) -> "State":
        """Add an expected image that shows the target at a pose ``T_camera_target`` (4, 4)."""
        information = self.information_of(view.points_mm, view.pixels, pose)
        return replace(self.showing(pose, view.pixels), known=self.known.with_information(information))


def solve_state(recorded: Sequence[RecordedPose], setting: Setting, wanted: CompletionLimits) -> State:
    """Solve the calibration with the recorded poses and return its state.

    Raises CalibrationError if no pose of the target fits one of its images.
    """
    image, camera, solution, undetermined = setting.sensor.camera, nominal_camera(setting), None, "no image yet"
    if recorded:
        try:
            solution = solve_camera(
                [TargetImage(pose.view.points_mm, pose.view.pixels, pose.stage_mm) for pose in recorded],
                width_px=image.width_px,
                height_px=image.height_px,
                poses=setting.poses,
                approaching=setting.approaching,
                circle_diameter_mm=setting.target.circle_diameter_mm,
            )
            camera, undetermined = solution.model, ""
        except (CalibrationError, RangeError) as error:
            undetermined = str(error)
    size = dict.fromkeys(_FOCAL, camera.fx_px) | {LensParameter.FY: camera.fy_px}
    size |= {LensParameter.CX: camera.width_px, LensParameter.CY: camera.height_px}
    stds = [_PRIOR[key] * size.get(key, 1.0) for key in setting.intrinsics().keys]
    state = State(
        setting=setting,
        wanted=wanted,
        recorded=tuple(recorded),
        camera=camera,
        solution=solution,
        undetermined=undetermined,
        poses=np.empty((0, 4, 4)),
        coverage=coverage_of([], width_px=image.width_px, height_px=image.height_px),
        known=CovarianceRoot(np.diag(stds)),
    )
    poses = [estimate_pose(one.view, camera) for one in recorded] if solution is None else solution.target_poses
    for one, pose in zip(recorded, poses, strict=True):
        state = state.with_view(one.view, pose)
    return state


def compute_shortfall(state: State, std: dict[LensParameter, float] | None = None) -> float:
    """Return a measure of missing evidence: 0 when all limits are reached, else log ratios and weighted fractions.

    The standard deviations ``std`` of the parameters are the expected ones by default.
    """
    std, share = std or state.expected_std(), state.coverage.share
    ratios = np.log([std[key] / limit for key, limit in state.wanted.std_px().items() if key in std])
    beyond = _BEYOND * (ratios.sum() + _COVERAGE_WEIGHT * (1 - share))
    short = _COVERAGE_WEIGHT * max(state.wanted.coverage - share, 0.0)
    return float(np.maximum(ratios, 0).sum() + short + _SPREAD_WEIGHT * _find_missing_tilt(state).sum() + beyond)


def _find_missing_tilt(state: State) -> np.ndarray:
    """Return for each side of the target the missing fraction (4,) of the wanted tilt."""
    if state.setting.poses != "free":
        return np.zeros(4)
    across, down = np.array([tilts_rad(pose) for pose in state.poses]).reshape(-1, 2).T
    reached = np.array([np.max(tilts, initial=0.0) for tilts in (across, -across, down, -down)])
    return np.maximum(1 - reached / np.radians(state.wanted.tilt_deg), 0.0)


def _project_inside(state: State, pose: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the pixels (N, 2) of all target points at a pose, and the mask (N,) of those well inside the image."""
    camera = state.camera
    pixels = project(camera, state.setting.target.points_mm @ pose[:3, :3].T + pose[:3, 3])
    largest = [camera.width_px - _MARGIN_PX, camera.height_px - _MARGIN_PX]
    return pixels, np.all((pixels > _MARGIN_PX) & (pixels < largest), axis=1)


def candidates(state: State, *, spin_rad: float = 0.0) -> Iterator[Candidate]:
    """Generate poses with a detectable target: three distances, nine places in the image, nine tilts.

    One tilt is zero; the others move one of eight sides away from the camera. ``spin_rad`` is the target's rotation in
    the image, from its x axis to the image's.
    """
    camera, target, sensor = state.camera, state.setting.target, state.setting.sensor
    volume, window = sensor.volume, sensor.camera.window
    outer, extent = window.distance_mm + window.thickness_mm, volume.far_mm - volume.near_mm
    points, middle = target.points_mm, target.points_mm.mean(axis=0)
    step = max(1, len(points) // _SAMPLE)
    spin = cv2.Rodrigues(np.array([0.0, 0.0, spin_rad]))[0]
    sides = np.arange(8) * np.pi / 4
    tilts = [np.zeros(3), *(_TILT_RAD * np.array([np.sin(side), -np.cos(side), 0.0]) for side in sides)]
    for depth, x, y, tilt in product(_DEPTHS, _PLACES, _PLACES, tilts):
        ray = directions(camera, np.array([[x * camera.width_px, y * camera.height_px]]))[0]
        turn = cv2.Rodrigues(tilt)[0] @ spin
        pose = rigid_transform(turn, ray / ray[2] * (outer + volume.near_mm + depth * extent) - turn @ middle)
        pixels, inside = _project_inside(state, pose)
        if target.is_findable(inside):
            sample = np.flatnonzero(inside)[::step]
            added = state.information_of(points[sample], pixels[sample], pose) * inside.sum() / len(sample)
            yield Candidate(information=added, pose=pose)


def best_pose(state: State, *, spin_rad: float = 0.0, skipped: int = 0) -> Forecast | None:
    """Return the most helpful candidate pose after ``skipped`` skipped ones; None if no candidate shows the target.

    The candidates are compared by `compute_shortfall`.
    """

    def figure(std: np.ndarray, candidate: Candidate | None) -> float:
        seen = state
        if candidate is not None:
            pixels, inside = _project_inside(state, candidate.pose)
            seen = state.showing(candidate.pose, pixels[inside])
        return compute_shortfall(seen, dict(zip(state.keys, std.tolist(), strict=True)))

    every = np.eye(len(state.keys))
    ranked = rank_candidates(state.known, every, candidates(state, spin_rad=spin_rad), figure=figure)
    return ranked[skipped % len(ranked)] if ranked else None


def compute_gain(state: State, view: TargetView, pose: np.ndarray) -> float:
    """Return the reduction of missing evidence by an image at a pose ``T_camera_target`` (4, 4)."""
    return compute_shortfall(state) - compute_shortfall(state.with_view(view, pose))


def middle_of(pose: np.ndarray, state: State) -> tuple[tuple[float, float], float]:
    """Return the place of the target's middle in fractions of the image's sides, and its distance, mm."""
    middle = pose[:3, :3] @ state.setting.target.points_mm.mean(axis=0) + pose[:3, 3]
    u, v = project(state.camera, middle[None])[0]
    return (float(u / state.camera.width_px), float(v / state.camera.height_px)), float(middle[2])


def format_pose_advice(aim: np.ndarray, state: State, pose: np.ndarray | None) -> str:
    """Describe how to move the target from its present pose (4, 4), None if unknown, to the advised one (4, 4)."""
    parts, (wanted, wanted_mm) = [], middle_of(aim, state)
    place, distance = (None, None) if pose is None else middle_of(pose, state)
    if pose is None or np.arccos(np.clip(pose[:3, 2] @ aim[:3, 2], -1, 1)) > _SAME_TILT_RAD:
        parts.append(_describe_tilt(aim, pose))
    if place is None or not np.linalg.norm(np.subtract(place, wanted)) <= _SAME_PLACE:
        there = place_words(*wanted)
        nothing = ": nothing seen there yet" if there == state.coverage.emptiest() else ""
        parts.append(f"bring its middle to the {there} of the image{nothing}")
    if distance is None:
        parts.append(f"to about {wanted_mm:.0f} mm from the camera")
    elif abs(distance / wanted_mm - 1) > _SAME_DISTANCE:
        how = "nearer" if wanted_mm < distance else "farther"
        parts.append(f"{how}, to about {wanted_mm:.0f} mm from the camera (now {distance:.0f} mm)")
    return "; ".join(parts) or "hold it still, just like this"


def _describe_tilt(aim: np.ndarray, pose: np.ndarray | None) -> str:
    """Describe how to tilt the target: the side to move away, and the angle."""
    across, down = tilts_rad(aim)
    size, present = (np.degrees(np.arccos(np.clip(abs(p[2, 2]), 0, 1))) for p in (aim, aim if pose is None else pose))
    if size < 5:
        return "hold the target square to the camera"
    farther = {"lower": down, "upper": -down, "right": across, "left": -across}
    sides = [side for side, tilt in farther.items() if tilt > np.radians(5)]
    what = f"{sides[0]} side" if len(sides) == 1 else f"{' '.join(sides)} corner"
    now = "" if pose is None else f" (now it is tilted by {present:.0f} deg)"
    return f"tilt the target so that its {what} is farther, {size:.0f} deg{now}"


def describe_missing(state: State) -> list[str]:
    """Describe limits that are not reached yet; empty if all are reached."""
    texts, wanted = [], state.wanted
    if len(state.recorded) < wanted.fewest_images:
        texts.append(f"{len(state.recorded)} images, at least {wanted.fewest_images} are wanted")
    if state.solution is None:
        texts.append(state.undetermined)
    std = state.std()
    texts += [
        f"{key.text} is known to {std[key]:.2g} px, {limit:g} px are wanted"
        for key, limit in wanted.std_px().items()
        if key in std and std[key] > limit
    ]
    if state.coverage.share < wanted.coverage:
        texts.append(
            f"{100 * state.coverage.share:.0f} % of the image is covered, {100 * wanted.coverage:.0f} % are wanted: "
            f"most is missing at the {state.coverage.emptiest()}"
        )
    level = [side for side, short in zip(_SIDES, _find_missing_tilt(state), strict=True) if short > 0]
    if level:
        texts.append(f"never tilted away by {wanted.tilt_deg:.0f} deg: the target's {', '.join(level)}")
    return texts


def describe_missing_sheet(state: State) -> list[str]:
    """Describe why the laser sheet is not determined yet; empty if the camera is not known."""
    if state.solution is None:
        return []
    target, stripes = state.setting.target, [pose.stripe for pose in state.recorded]
    try:
        points = points_on_target(state.camera, stripes, state.poses, plate_mm=target.plate_mm).points_mm
        fit_sheet(points, nominal_normal=laser_pose(state.setting.sensor).normal)
    except CalibrationError as error:
        shown = sum(len(stripe) > 0 for stripe in stripes)
        return [f"the laser line is on the target in {shown} of {len(state.recorded)} images: {error}"]
    return []


# --- images of the step standard --------------------------------------------------------------------------------------


PLACES = 3  # number of depths of the standard that are needed: near, middle and far
_APART = 1 / 7  # fraction of the volume's depth
_MOST_SATURATED = 0.05  # fraction of the lines; outlier tests tolerate this many wrong centres


@dataclass(frozen=True, eq=False)
class StepQuality:
    """Stripe pixels (N, 2) on the step standard, their depth outside the nominal window, and reasons for rejection."""

    pixels: np.ndarray
    depth_mm: float | None
    reasons: tuple[str, ...]


def next_depth_mm(seen_mm: Sequence[float], sensor: Sensor, *, skipped: int = 0) -> float | None:
    """Return the depth for the standard's next image, mm outside the window; None after three separate depths.

    Candidates are the centres of three equal parts of the measuring volume; the one farthest from previous depths is
    returned. After ``skipped`` skipped depths, the next candidates follow in turn.
    """
    if len(select_separate_depths(seen_mm, sensor)) >= PLACES:
        return None
    near, far = sensor.volume.near_mm, sensor.volume.far_mm
    middles = [near + (far - near) * (2 * k + 1) / (2 * PLACES) for k in range(PLACES)]
    middles.sort(key=lambda middle: min((abs(middle - depth) for depth in seen_mm), default=np.inf), reverse=True)
    return middles[skipped % PLACES]


def select_separate_depths(seen_mm: Sequence[float], sensor: Sensor) -> list[float]:
    """Return those depths that are far from each other."""
    chosen: list[float] = []
    for depth in seen_mm:
        chosen += [depth] if is_separate_depth(depth, chosen, sensor) else []
    return chosen


def is_separate_depth(depth_mm: float, seen_mm: Sequence[float], sensor: Sensor) -> bool:
    """Return whether a depth differs from all others by more than a seventh of the measuring volume's depth."""
    return all(abs(depth_mm - other) >= least_separation_mm(sensor) for other in seen_mm)


def least_separation_mm(sensor: Sensor) -> float:
    """Return the smallest difference between two depths of the standard, mm."""
    return _APART * (sensor.volume.far_mm - sensor.volume.near_mm)


def judge_step(
    image: np.ndarray,
    calibration: Calibration,
    window: WindowModel,
    standard: StepStandard,
    *,
    medium_index: float,
    full_dn: int,
) -> StepQuality:
    """Assess a laser image (H, W) of the step standard.

    ``calibration`` is that of camera and sheet in air, the window is the nominal one, and the index is relative to air.
    ``full_dn`` is the grey value of saturation.
    """
    along = calibration.stripe_along
    try:
        stripe = extract_stripe(image, stripe_along=along, saturation=full_dn)
    except ImageError as error:
        return StepQuality(np.empty((0, 2)), None, (str(error),))
    pixels, reasons = stripe.pixels(), []
    if len(pixels) < FEWEST_LINES:
        reason = f"the laser line is found on {len(pixels)} lines only; at least {FEWEST_LINES} are needed"
        return StepQuality(pixels, None, (f"{reason}; is the laser on, is the standard in the sheet?",))
    clipped = (image.max(axis=0 if along == "width" else 1) >= full_dn) & (stripe.status != StripeStatus.NO_STRIPE)
    saturated = float(clipped.sum()) / len(pixels)
    if saturated > _MOST_SATURATED:
        reasons.append(LaserFault(f"stripe saturated on {100 * saturated:.0f} % of its lines; shorten laser_ms"))
    try:
        label_step(calibration, window, StepEvidence(pixels, standard, medium_index, "this image"))
    except EvaluationError as error:
        reasons.append(f"no step: {error}")
    placed = calibration.model_copy(update={"window": window})
    depths = points_on_sheet(placed, pixels, medium_index=medium_index).points_mm[:, 2]
    if not np.isfinite(depths).any():
        return StepQuality(pixels, None, (*reasons, "the laser line is not on the sheet"))
    depth = float(np.median(depths[np.isfinite(depths)])) - window.distance_mm - window.thickness_mm
    return StepQuality(pixels, depth, tuple(reasons))
