"""Advice during a camera calibration: what is still missing, and the pose of the target that would help most."""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from uwlts.calibration.camera import CameraSolution
from uwlts.calibration.guidance.coverage import (
    Candidate,
    Coverage,
    candidates,
    coverage_of,
    information_of,
    place_words,
    tilts_rad,
)
from uwlts.calibration.guidance.solution import RecordedPose, Setting, nominal_camera, pose_of, solve_recorded
from uwlts.calibration.sheet import fit_sheet, points_on_target
from uwlts.model.calibration import CameraModel
from uwlts.model.errors import CalibrationError
from uwlts.model.parameter_keys import LensParameter
from uwlts.model.placement import laser_pose
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
            return self.expected_std()
        return dict(zip(self.setting.intrinsics().keys, self.solution.std().values(), strict=True))

    def expected_std(self) -> dict[LensParameter, float]:
        """Standard deviations that belong to the information."""
        std = np.sqrt(np.diag(np.linalg.inv(self.information))).tolist()
        return dict(zip(self.setting.intrinsics().keys, std, strict=True))

    def with_image(self, pose: np.ndarray, pixels: np.ndarray, information: np.ndarray) -> "State":
        """As expected with one more image: its pose (4, 4), pixels (N, 2) and information (P, P) by points of 1 px."""
        sigma = _USUAL_SIGMA_PX if self.solution is None else max(self.solution.sigma_px, _LEAST_SIGMA_PX)
        return replace(
            self,
            poses=np.concatenate([self.poses, pose[None]]),
            coverage=self.coverage.with_points(pixels),
            information=self.information + information / sigma**2,
        )

    def with_view(self, view: TargetView, pose: np.ndarray) -> "State":
        """As expected with one more image that shows the target at a pose ``T_camera_target`` (4, 4)."""
        information = information_of(view.points_mm, view.pixels, pose, self.camera, self.setting)
        return self.with_image(pose, view.pixels, information)

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
    image = setting.sensor.camera
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
        information=np.diag(np.array(stds) ** -2.0),
    )
    poses = [pose_of(one.view, camera) for one in recorded] if solution is None else solution.target_poses
    for one, pose in zip(recorded, poses, strict=True):
        state = state.with_view(one.view, pose)
    return state


def lack(state: State) -> float:
    """How much is missing: 0 once all that is wanted is reached, else logarithms of ratios and weighted shares."""
    std, share = state.expected_std(), state.coverage.share
    ratios = np.log([std[key] / limit for key, limit in state.wanted.std_px().items() if key in std])
    beyond = _BEYOND * (ratios.sum() + _COVERAGE_WEIGHT * (1 - share))
    short = _COVERAGE_WEIGHT * max(state.wanted.coverage - share, 0.0)
    return float(np.maximum(ratios, 0).sum() + short + _SPREAD_WEIGHT * _untilted(state).sum() + beyond)


def _untilted(state: State) -> np.ndarray:
    """For each of the target's four sides, what share (4,) of the wanted tilt it was never farther by."""
    if state.setting.poses != "free":
        return np.zeros(4)
    across, down = np.array([tilts_rad(pose) for pose in state.poses]).reshape(-1, 2).T
    reached = np.array([np.max(tilts, initial=0.0) for tilts in (across, -across, down, -down)])
    return np.maximum(1 - reached / state.wanted.tilt_rad, 0.0)


def best_pose(state: State, *, spin_rad: float = 0.0) -> PoseAdvice | None:
    """The candidate pose that leaves least missing; None where the target can be found in none."""
    options = candidates(state.setting, state.camera, spin_rad=spin_rad)
    if not options:
        return None
    after = [lack(state.with_image(each.pose, each.pixels, each.information)) for each in options]
    best = int(np.argmin(after))
    place, distance = middle_of(options[best].pose, state)
    return PoseAdvice(options[best], lack(state) - after[best], place, distance)


def gain_of(state: State, view: TargetView, pose: np.ndarray) -> float:
    """By how much an image, seen at a pose ``T_camera_target`` (4, 4), would lessen what is missing."""
    return lack(state) - lack(state.with_view(view, pose))


def middle_of(pose: np.ndarray, state: State) -> tuple[tuple[float, float], float]:
    """Place of the target's middle in shares of the image's sides, and its distance in mm along the axis."""
    middle = pose[:3, :3] @ state.setting.target.points_mm.mean(axis=0) + pose[:3, 3]
    u, v = project(state.camera, middle[None])[0]
    return (float(u / state.camera.width_px), float(v / state.camera.height_px)), float(middle[2])


def format_pose_advice(advice: PoseAdvice, state: State, pose: np.ndarray | None) -> str:
    """What to do with the target to bring it from its present pose (4, 4), None if unknown, to the advised one."""
    parts, aim = [], advice.candidate.pose
    place, distance = (None, None) if pose is None else middle_of(pose, state)
    if pose is None or np.arccos(np.clip(pose[:3, 2] @ aim[:3, 2], -1, 1)) > _SAME_TILT_RAD:
        parts.append(_tilt_words(aim, pose))
    if place is None or not np.linalg.norm(np.subtract(place, advice.place)) <= _SAME_PLACE:
        there = place_words(*advice.place)
        nothing = ": nothing seen there yet" if there == state.coverage.emptiest() else ""
        parts.append(f"bring its middle to the {there} of the image{nothing}")
    if distance is None:
        parts.append(f"to about {advice.distance_mm:.0f} mm from the camera")
    elif abs(distance / advice.distance_mm - 1) > _SAME_DISTANCE:
        how = "nearer" if advice.distance_mm < distance else "farther"
        parts.append(f"{how}, to about {advice.distance_mm:.0f} mm from the camera (now {distance:.0f} mm)")
    return "; ".join(parts) or "hold it still, just like this"


def _tilt_words(aim: np.ndarray, pose: np.ndarray | None) -> str:
    """Which side of the target shall be farther, and by how much."""
    across, down = tilts_rad(aim)
    size = np.degrees(np.arccos(np.clip(1 / np.sqrt(1 + np.tan(across) ** 2 + np.tan(down) ** 2), -1, 1)))
    if size < 5:
        return "hold the target square to the camera"
    farther = {"lower": down, "upper": -down, "right": across, "left": -across}
    sides = [side for side, tilt in farther.items() if tilt > np.radians(5)]
    what = f"{sides[0]} side" if len(sides) == 1 else f"{' '.join(sides)} corner"
    now = (
        ""
        if pose is None
        else f" (now it is tilted by {np.degrees(np.arccos(np.clip(abs(pose[2, 2]), 0, 1))):.0f} deg)"
    )
    return f"tilt the target so that its {what} is farther, {size:.0f} deg{now}"


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
    level = [side for side, short in zip(_SIDES, _untilted(state), strict=True) if short > 0]
    if level:
        said.append(f"the target's {', '.join(level)} was never farther by {np.degrees(wanted.tilt_rad):.0f} deg")
    return said


def missing_sheet(state: State) -> list[str]:
    """What the laser sheet still lacks; nothing as long as the camera is not known."""
    if state.solution is None:
        return []
    target, stripes = state.setting.target, [pose.stripe for pose in state.recorded]
    extent, margin = target.extent_mm, target.spacing_mm / 2
    try:
        points = points_on_target(state.camera, stripes, state.poses, extent_mm=extent, margin_mm=margin).points_mm
        fit_sheet(points, nominal_normal=laser_pose(state.setting.sensor).normal)
    except CalibrationError as error:
        shown = sum(len(stripe) > 0 for stripe in stripes)
        return [f"the laser line is on the target in {shown} of {len(state.recorded)} images: {error}"]
    return []
