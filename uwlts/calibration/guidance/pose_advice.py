"""Advice during a camera calibration: what is still missing, and the pose of the target that would help most."""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass

import numpy as np

from uwlts.calibration.camera import CameraSolution
from uwlts.calibration.guidance.coverage import (
    Candidate,
    Coverage,
    candidates,
    coverage_of,
    information_of,
    place_words,
    target_middle,
    tilts_rad,
    working_range_mm,
)
from uwlts.calibration.guidance.solution import RecordedPose, Setting, nominal_camera, pose_of, sheet_of, solve_recorded
from uwlts.calibration.intrinsics import Intrinsics
from uwlts.model.calibration import CameraModel
from uwlts.model.errors import CalibrationError
from uwlts.model.parameter_keys import LensParameter
from uwlts.optics.camera import project
from uwlts.targets import TargetView

# How well points are usually found, used until residuals are known. Sharp circles do better, in reality too.
_USUAL_SIGMA_PX, _LEAST_SIGMA_PX = 0.1, 0.02
# What is known of a described lens before anything is seen, as standard deviations: shares of f and of the image's
# side, and plain coefficients.
_FOCAL: tuple[LensParameter, ...] = (LensParameter.F, LensParameter.FX, LensParameter.FY)
_CENTRE: tuple[LensParameter, ...] = (LensParameter.CX, LensParameter.CY)
_PRIOR = dict.fromkeys((*_FOCAL, *_CENTRE), 0.05) | {
    LensParameter.K1: 0.3,
    LensParameter.K2: 3.0,
    LensParameter.P1: 0.02,
    LensParameter.P2: 0.02,
    LensParameter.K3: 10.0,
}
# A fully uncovered image counts as a factor of 55 in a standard deviation, a side never tilted as one of 1.6.
_COVERAGE_WEIGHT, _SPREAD_WEIGHT = 4.0, 0.5
_SIDES = ("right side", "left side", "lower side", "upper side")
# Decides between poses once everything wanted is reached.
_BEYOND = 0.05
# What a hand can keep: closer to the advised pose nothing is said.
_SAME_TILT_RAD, _SAME_PLACE, _SAME_DISTANCE = np.radians(9.0), 0.15, 0.1


@dataclass(frozen=True)
class Wanted:
    """When a calibration is good enough.

    Attributes
    ----------
    focal_std_px, centre_std_px : standard deviations of the focal length and of the principal point
    coverage : share of the image's cells in which points were seen
    tilt_rad : free poses: each of the target's four sides was once farther by as much. A scatter of pixels does not
        need that, but a target that is not quite flat, or not quite as described, then shows.
    """

    focal_std_px: float = 0.5
    centre_std_px: float = 0.5
    coverage: float = 0.85
    tilt_rad: float = float(np.radians(12))
    fewest_images: int = 8

    def std_px(self) -> dict[LensParameter, float]:
        """Wanted standard deviation of every parameter of which one is wanted."""
        return dict.fromkeys(_FOCAL, self.focal_std_px) | dict.fromkeys(_CENTRE, self.centre_std_px)


@dataclass(frozen=True, eq=False)
class State:
    """How far a calibration has come.

    Attributes
    ----------
    camera : as far as it is known
    solution : None as long as the poses do not determine it
    undetermined : why not
    poses : (F, 4, 4); ``T_camera_target`` of the recorded poses
    information : (P, P); what is known of the camera's parameters, of the description alone at first
    """

    setting: Setting
    wanted: Wanted
    recorded: tuple[RecordedPose, ...]
    camera: CameraModel
    solution: CameraSolution | None
    undetermined: str
    poses: np.ndarray
    coverage: Coverage
    information: np.ndarray

    def std(self) -> dict[LensParameter, float]:
        """Standard deviation of every camera parameter: the solution's, or what is expected without one."""
        if self.solution is None:
            return self.expected_std(self.information)
        return dict(zip(_intrinsics(self.setting).keys, self.solution.std().values(), strict=True))

    def expected_std(self, information: np.ndarray) -> dict[LensParameter, float]:
        """Standard deviations that belong to information (P, P)."""
        std = np.sqrt(np.diag(np.linalg.inv(information))).tolist()
        return dict(zip(_intrinsics(self.setting).keys, std, strict=True))

    @property
    def enough(self) -> bool:
        """Whether everything wanted is reached."""
        return not missing(self)


@dataclass(frozen=True, eq=False)
class PoseAdvice:
    """The pose that would help most, by how much, and where the target's middle then lies.

    ``gain`` is in the units of `lack`; ``place`` are shares of the image's width and height, ``distance_mm`` runs along
    the camera's axis.
    """

    candidate: Candidate
    gain: float
    place: tuple[float, float]
    distance_mm: float


def state_of(recorded: Sequence[RecordedPose], setting: Setting, wanted: Wanted = Wanted()) -> State:
    """How far the recorded poses lead.

    Raises CalibrationError: no pose of the target explains one of its images.
    """
    solution, undetermined = None, "no image yet"
    camera = nominal_camera(setting)
    if recorded:
        try:
            solution = solve_recorded(recorded, setting)
            camera, undetermined = solution.model, ""
        except CalibrationError as error:
            undetermined = str(error)
    poses = np.array([pose_of(pose.view, camera) for pose in recorded]) if solution is None else solution.target_poses
    sigma = _sigma(solution)
    information = _prior(setting, camera)
    for pose, where in zip(recorded, poses, strict=True):
        information = information + _scaled(pose.view, where, camera, setting, sigma)
    image = setting.sensor.camera
    return State(
        setting=setting,
        wanted=wanted,
        recorded=tuple(recorded),
        camera=camera,
        solution=solution,
        undetermined=undetermined,
        poses=poses.reshape(-1, 4, 4),
        coverage=coverage_of([p.view.pixels for p in recorded], width_px=image.width_px, height_px=image.height_px),
        information=information,
    )


def lack(state: State, information: np.ndarray, coverage: Coverage, poses: Iterable[np.ndarray]) -> float:
    """How much is missing: 0 once all that is wanted is reached, else logarithms of ratios and weighted shares."""
    std = state.expected_std(information)
    ratios = np.log([std[key] / limit for key, limit in state.wanted.std_px().items() if key in std])
    short = state.wanted.coverage - coverage.share
    tilts = _untilted(state, poses).sum()
    beyond = _BEYOND * (ratios.sum() + _COVERAGE_WEIGHT * (1 - coverage.share))
    return float(np.maximum(ratios, 0).sum() + _COVERAGE_WEIGHT * max(short, 0.0) + _SPREAD_WEIGHT * tilts + beyond)


def _untilted(state: State, poses: Iterable[np.ndarray]) -> np.ndarray:
    """For each of the target's four sides, what share (4,) of the wanted tilt it was never farther by."""
    if state.setting.poses != "free":
        return np.zeros(4)
    across, down = np.array([tilts_rad(pose) for pose in poses]).reshape(-1, 2).T
    reached = np.array([np.max(tilts, initial=0.0) for tilts in (across, -across, down, -down)])
    return np.maximum(1 - reached / state.wanted.tilt_rad, 0.0)


def best_pose(state: State, *, spin_rad: float = 0.0) -> PoseAdvice | None:
    """The candidate pose that leaves least missing; None where the target can be found in none."""
    setting = state.setting
    options = candidates(
        setting.target, state.camera, setting.camera, range_mm=working_range_mm(setting.sensor), spin_rad=spin_rad
    )
    if not options:
        return None
    sigma = _sigma(state.solution)
    before = lack(state, state.information, state.coverage, state.poses)
    after = [
        lack(
            state,
            state.information + c.information / sigma**2,
            state.coverage.with_points(c.pixels),
            [*state.poses, c.pose],
        )
        for c in options
    ]
    best = int(np.argmin(after))
    place, distance = middle_of(options[best].pose, state)
    return PoseAdvice(options[best], before - after[best], place, distance)


def gain_of(state: State, view: TargetView, pose: np.ndarray) -> float:
    """By how much an image, seen at a pose ``T_camera_target`` (4, 4), would lessen what is missing."""
    information = state.information + _scaled(view, pose, state.camera, state.setting, _sigma(state.solution))
    before = lack(state, state.information, state.coverage, state.poses)
    return before - lack(state, information, state.coverage.with_points(view.pixels), [*state.poses, pose])


def middle_of(pose: np.ndarray, state: State) -> tuple[tuple[float, float], float]:
    """Where the target's middle appears, as shares of the image's sides, and its distance in mm along the axis."""
    middle = pose[:3, :3] @ target_middle(state.setting.target) + pose[:3, 3]
    u, v = project(state.camera, middle[None])[0]
    return (float(u / state.camera.width_px), float(v / state.camera.height_px)), float(middle[2])


def format_pose_advice(advice: PoseAdvice, state: State, pose: np.ndarray | None) -> str:
    """What to do with the target to bring it from its present pose (4, 4), None if unknown, to the advised one."""
    parts = []
    across, down = tilts_rad(advice.candidate.pose)
    if pose is None or _angle(pose[:3, 2], advice.candidate.pose[:3, 2]) > _SAME_TILT_RAD:
        parts.append(_tilt_words(across, down, pose))
    place, distance = (None, None) if pose is None else middle_of(pose, state)
    if place is None or not np.linalg.norm(np.subtract(place, advice.place)) <= _SAME_PLACE:
        there = place_words(*advice.place)
        nothing = ": nothing seen there yet" if there == state.coverage.emptiest() else ""
        parts.append(f"bring its middle to the {there} of the image{nothing}")
    if distance is None or abs(distance / advice.distance_mm - 1) > _SAME_DISTANCE:
        how = "" if distance is None else "nearer, " if advice.distance_mm < distance else "farther, "
        now = "" if distance is None else f" (now {distance:.0f} mm)"
        parts.append(f"{how}to about {advice.distance_mm:.0f} mm from the camera{now}")
    return "; ".join(parts) or "hold it still, just like this"


def missing(state: State) -> list[str]:
    """What is still not good enough, in words; empty when all that is wanted is reached."""
    said, wanted = [], state.wanted
    if len(state.recorded) < wanted.fewest_images:
        said.append(f"{len(state.recorded)} images, at least {wanted.fewest_images} are wanted")
    if state.solution is None:
        said.append(state.undetermined)
    std = state.std()
    said += [
        f"{key.text} is known to {std[key]:.2g} px, {limit:g} px are wanted"
        for key, limit in wanted.std_px().items()
        if key in std and std[key] > limit
    ]
    if state.coverage.share < wanted.coverage:
        said.append(
            f"{100 * state.coverage.share:.0f} % of the image is covered, {100 * wanted.coverage:.0f} % are wanted: "
            f"most is missing at the {state.coverage.emptiest()}"
        )
    level = [side for side, short in zip(_SIDES, _untilted(state, state.poses), strict=True) if short > 0]
    if level:
        said.append(f"the target's {', '.join(level)} was never farther by {np.degrees(wanted.tilt_rad):.0f} deg")
    return said


def _scaled(view: TargetView, pose: np.ndarray, camera: CameraModel, setting: Setting, sigma: float) -> np.ndarray:
    return information_of(view.points_mm, view.pixels, pose, camera, setting.camera) / sigma**2


def _sigma(solution: CameraSolution | None) -> float:
    return _USUAL_SIGMA_PX if solution is None else max(solution.sigma_px, _LEAST_SIGMA_PX)


def _intrinsics(setting: Setting) -> Intrinsics:
    camera = setting.sensor.camera
    return Intrinsics(setting.camera, width_px=camera.width_px, height_px=camera.height_px)


def _prior(setting: Setting, camera: CameraModel) -> np.ndarray:
    """Information (P, P) of the description."""
    size = dict.fromkeys(_FOCAL, camera.fx_px) | {LensParameter.FY: camera.fy_px}
    size |= {LensParameter.CX: camera.width_px, LensParameter.CY: camera.height_px}
    stds = [_PRIOR[key] * size.get(key, 1.0) for key in _intrinsics(setting).keys]
    return np.diag(np.array(stds) ** -2.0)


def _angle(one: np.ndarray, other: np.ndarray) -> float:
    return float(np.arccos(np.clip(one @ other, -1, 1)))


def _tilt_words(across: float, down: float, pose: np.ndarray | None) -> str:
    """Which side of the target shall be farther, and by how much."""
    size = np.degrees(np.arccos(np.clip(1 / np.sqrt(1 + np.tan(across) ** 2 + np.tan(down) ** 2), -1, 1)))
    if size < 5:
        return "hold the target square to the camera"
    sides = [word for value, word in ((down, "lower"), (-down, "upper")) if value > np.radians(5)]
    sides += [word for value, word in ((across, "right"), (-across, "left")) if value > np.radians(5)]
    what = f"{sides[0]} side" if len(sides) == 1 else f"{' '.join(sides)} corner"
    now = ""
    if pose is not None:
        square = np.degrees(np.arccos(np.clip(abs(pose[2, 2]), 0, 1)))
        now = f" (now it is tilted by {square:.0f} deg)"
    return f"tilt the target so that its {what} is farther, {size:.0f} deg{now}"


def missing_sheet(state: State) -> list[str]:
    """What the laser sheet still lacks; nothing as long as the camera is not known."""
    if state.solution is None:
        return []
    shown = sum(len(pose.stripe) > 0 for pose in state.recorded)
    try:
        sheet_of(state.recorded, state.solution, state.setting)
    except CalibrationError as error:
        return [f"the laser line is on the target in {shown} of {len(state.recorded)} images: {error}"]
    return []
