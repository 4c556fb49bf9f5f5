"""Sensor models to choose from, and their predictions of images held out from the calibration."""

from dataclasses import dataclass, replace
from typing import Literal, assert_never

import cv2
import numpy as np
from scipy.stats import chi2

from uwlts.calibration.camera.camera_parameters import Intrinsics
from uwlts.calibration.camera.target_images import pose_values
from uwlts.calibration.joint.consistency import find_excess_outliers
from uwlts.calibration.joint.estimate import Estimate, Evidence, outlier_limit
from uwlts.calibration.joint.parameters import Parameters, ViewMedium
from uwlts.calibration.joint.procedure import JointProblem
from uwlts.calibration.joint.residuals import STEP, TARGET, Residuals, StepProfileEvidence, TargetEvidence
from uwlts.calibration.joint.scanned_surfaces import SurfaceScanEvidence
from uwlts.calibration.joint.subsets import keep_images, select_images
from uwlts.errors import CalibrationError
from uwlts.model.calibration import WindowModel
from uwlts.model.parameter_keys import LensParameter, ParameterKey, SheetParameter, TargetParameter, WindowParameter

_HELD: dict[str, tuple[ParameterKey, ...]] = {
    "window_tilt": (WindowParameter.SLOPE_X, WindowParameter.SLOPE_Y),
    "bow": (SheetParameter.BOW,),
    "window_turn": (SheetParameter.WINDOW_TURN,),
}
_WORDS = {
    "refractions": "one refraction",
    "window_tilt": "window not tilted",
    "bow": "sheet without bow",
    "window_turn": "laser window not turned",
}
_GLASS = (WindowParameter.THICKNESS, WindowParameter.GLASS_INDEX)


@dataclass(frozen=True)
class Candidate:
    """Sensor model; parameters that are not free keep their described values.

    ``refractions`` is 1 for a window modelled as one interface, 2 for a glass plate. The tilt of the camera's window,
    the bow of the sheet, and the turn of the laser's window can be free. Distortion coefficients that are not named are
    zero.
    """

    refractions: Literal[1, 2] = 2
    window_tilt: bool = True
    bow: bool = True
    window_turn: bool = True
    distortion: tuple[str, ...] = ("k1", "k2")

    def describe(self) -> str:
        """Describe the difference from the usual model."""
        usual = Candidate()
        parts = [words for name, words in _WORDS.items() if getattr(self, name) != getattr(usual, name)]
        if self.distortion != usual.distortion:
            parts.append(describe_distortion(self.distortion))
        return ", ".join(parts) or "usual (glass plate, tilts, bow, k1 k2)"


def describe_distortion(distortion: tuple[str, ...]) -> str:
    """Describe the free distortion coefficients."""
    return "distortion " + " ".join(distortion) if distortion else "no distortion"


DIMENSIONS: dict[str, tuple[object, ...]] = {
    "refractions": (1,),
    "window_tilt": (False,),
    "bow": (False,),
    "window_turn": (False,),
    "distortion": ((), ("k1",), ("k1", "k2", "k3"), ("k1", "k2", "p1", "p2")),
}
"""Alternatives to each property of the usual model."""


def select_dimensions(parameters: Parameters) -> dict[str, tuple[object, ...]]:
    """Return the properties that affect the parameters of the evidence, with their alternatives."""
    return {
        name: others
        for name, others in DIMENSIONS.items()
        if name == "distortion"
        or (name == "refractions" and parameters.window is not None)
        or any(held in parameters.keys for held in _HELD.get(name, ()))
    }


def apply_candidate(problem: JointProblem, candidate: Candidate) -> JointProblem:
    """Return the problem with the candidate's parameters and the same start values.

    The target may only have a bow: more shape parameters could absorb errors of the model. The distance of a single
    interface is free, as it stands for a whole glass plate.
    """
    known = problem.parameters
    options = replace(known.intrinsics.options, distortion=candidate.distortion)
    intrinsics = Intrinsics(options, width_px=known.intrinsics.width_px, height_px=known.intrinsics.height_px)
    held = {key for field, keys in _HELD.items() if not getattr(candidate, field) for key in keys}
    held |= {*TargetParameter} - {TargetParameter.BOW}
    window, priors = known.window, dict(known.priors)
    if candidate.refractions == 1 and window is not None:
        window = WindowModel(refractions=1, distance_mm=window.distance_mm, normal=window.normal)
        held |= set(_GLASS)
        priors |= {
            WindowParameter.DISTANCE: replace(priors[WindowParameter.DISTANCE], std=np.inf),
            WindowParameter.THICKNESS: replace(priors[WindowParameter.THICKNESS], mean=0.0),
            WindowParameter.GLASS_INDEX: replace(priors[WindowParameter.GLASS_INDEX], mean=1.0),
        }
    # lens parameters must be determined by the images alone
    known_before = {key: prior for key, prior in priors.items() if not isinstance(key, LensParameter)}
    priors = {key: replace(prior, std=0.0) if key in held else prior for key, prior in known_before.items()}
    parameters = replace(known, intrinsics=intrinsics, window=window, priors=priors)
    return problem.with_parameters(parameters, dict(zip(known.keys, problem.global_values, strict=True)))


INSIDE, OUTSIDE = "inside", "outside"
Image = tuple[int, int]
"""Number of the piece of evidence, and of the image in it."""

_EVERY = (4, 3, 2)  # one of 4, 3 or 2 inner images is held out: the first number that holds out enough
_OUTER = (1 / 6, 1 / 4, 1 / 3)  # fraction of the depth range, at either end: likewise
_FEWEST_KEPT = 4  # images for calibration
FEWEST_HELD = 4  # held-out images: fewer give no standard error


def split_images(problem: JointProblem) -> dict[str, frozenset[Image]]:
    """Select held-out images inside the volume of the others, and outside of it.

    The stripe's position in the image stands for the depth. Inside, every fourth image is held out; outside, all images
    in the outer sixths of the depth range. Of few images larger shares are held out. Images without a stripe are never
    held out.

    Raises CalibrationError if there are too few images.
    """
    views = list(_sort_by_depth(problem).values())
    inside = _first_large_enough([_hold_out_inside(views, every) for every in _EVERY])
    outside = _first_large_enough([_hold_out_outside(views, share) for share in _OUTER])
    fewest = min(len(inside), len(outside))
    if fewest < FEWEST_HELD:
        raise CalibrationError(
            f"too few images with a stripe: {fewest} can be held out, at least {FEWEST_HELD} are needed; take 12 or "
            "more images of the target at different depths"
        )
    return {INSIDE: inside, OUTSIDE: outside}


def _first_large_enough(choices: list[frozenset[Image]]) -> frozenset[Image]:
    """Return the first choice with enough images, else the largest."""
    return next((each for each in choices if len(each) >= FEWEST_HELD), max(choices, key=len))


def _hold_out_inside(views: list[list[tuple[float, Image]]], every: int) -> frozenset[Image]:
    """Return one of ``every`` images of each view, without the outermost ones."""
    return frozenset(image for found in views for _, image in found[1:-1:every])


def _hold_out_outside(views: list[list[tuple[float, Image]]], share: float) -> frozenset[Image]:
    """Return the images of each view in the outer ``share`` of its depth range, if enough others remain."""
    outside: set[Image] = set()
    for found in views:
        places = np.array([place for place, _ in found])
        reach = share * (places[-1] - places[0])
        outer = (places < places[0] + reach) | (places > places[-1] - reach)
        if np.count_nonzero(~outer) >= _FEWEST_KEPT:
            outside |= {image for (_, image), out in zip(found, outer, strict=True) if out}
    return frozenset(outside)


def _sort_by_depth(problem: JointProblem) -> dict[ViewMedium, list[tuple[float, Image]]]:
    """Return images with a stripe for each view and medium, sorted by the stripe's position across its lines."""
    found: dict[ViewMedium, list[tuple[float, Image]]] = {}
    for number, piece in enumerate(problem.evidence):
        if isinstance(piece, TargetEvidence):
            places = {int(image): piece.pixels[piece.image == image, piece.across] for image in np.unique(piece.image)}
        elif isinstance(piece, StepProfileEvidence):
            places = {piece.image: piece.pixels[:, piece.across]}
        else:
            continue
        found.setdefault(piece.view, []).extend((float(np.median(at)), (number, i)) for i, at in places.items())
    return {view: sorted(images) for view, images in found.items()}


def remove_images(problem: JointProblem, held: frozenset[Image]) -> tuple[JointProblem, list[int]]:
    """Remove the held-out images; return the problem and the numbers of its remaining pieces of evidence."""
    evidence, local, numbers = keep_images(problem.evidence, problem.local, lambda image: image not in held)
    return replace(problem, evidence=evidence, local=local), numbers


_ROUNDS = 20  # Gauss-Newton steps of a pose; a few suffice
_SETTLED_PX = 1e-4  # change of the last step, far below the noise of a stripe centre
_CHOOSING_ROUNDS = 10  # rounds that update the set of inliers
_BY_CHANCE = 0.0027  # p-value of three standard deviations


@dataclass(frozen=True, eq=False)
class Misses:
    """Errors of the points of one kind in one image: (n,) each, in px in the image and in mm on the object."""

    image: Image
    kind: str
    px: np.ndarray
    mm: np.ndarray


@dataclass(frozen=True, eq=False)
class Prediction:
    """Errors in all held-out images, with the estimated global parameters (P,) and their covariance (P, P)."""

    misses: list[Misses]
    parameters: Parameters
    values: np.ndarray
    covariance: np.ndarray

    def separates_from(self, smaller: "Prediction") -> bool:
        """Return whether the estimate differs by three sigma from a smaller model's fixed parameters.

        True if neither model contains the other.
        """
        keys, others = self.parameters.keys, smaller.parameters.keys
        more = [place for place, key in enumerate(keys) if key not in others]
        if not set(others) <= set(keys) or not more:
            return True
        held = np.array([smaller.parameters.value(smaller.values, keys[place]) for place in more])
        off = self.values[more] - held
        square = off @ np.linalg.solve(self.covariance[np.ix_(more, more)], off)
        return bool(chi2.sf(square, len(more)) < _BY_CHANCE)


def predict(problem: JointProblem, candidate: Candidate, held: frozenset[Image]) -> Prediction:
    """Calibrate without the held-out images, and predict these.

    If the stage moved the target, the pose in a held-out image follows from the other images and the stage position,
    with their mean position error. Otherwise the pose is fitted to the points of the target, or the line of the lower
    tread to the stripe on a step. No calibration parameter is fitted to held-out images.

    Raises
    ------
    CalibrationError
        The other images do not determine the model or do not fit it, or a ray of a held-out image hits nothing.
    """
    whole = apply_candidate(problem, candidate)
    training, numbers = remove_images(whole, held)
    estimate = training.solve()
    if misfits := find_excess_outliers(estimate):
        kind, share = next(iter(misfits.items()))
        raise CalibrationError(f"{100 * share:.0f} % of the {kind} do not fit the model")
    local = dict(zip(numbers, estimate.local, strict=True))
    found = []
    for number in sorted({number for number, _ in held}):
        piece, images = whole.evidence[number], sorted(image for at, image in held if at == number)
        match piece:
            case TargetEvidence():
                posed = _pose_held_out(whole, piece, number, images, local.get(number))
            case StepProfileEvidence():
                posed = [(piece, whole.local[number], (STEP,))]
            case SurfaceScanEvidence():
                continue  # scans are never held out
            case _:
                assert_never(piece)
        for evidence, pose, fitted in posed:
            parts = _fit_residuals(whole, estimate, evidence, pose, fitted=fitted)
            found += [_measure_errors(number, part) for part in parts if part.image in images]
    return Prediction(found, estimate.parameters, estimate.values, estimate.covariance)


def _pose_held_out(
    problem: JointProblem, piece: TargetEvidence, number: int, images: list[int], local: np.ndarray | None
) -> list[tuple[Evidence, np.ndarray, tuple[str, ...]]]:
    """Return held-out images with their local parameters, and the residual kinds for a fit of these.

    ``local`` are the local parameters of the other images, or None. Elements from the ninth on are position errors.
    """
    if local is not None and piece.staged and len(local) > 8:
        rotation, direction = cv2.Rodrigues(local[:3])[0], piece.placement.direction(local[6:8])
        held = select_images(piece, images)
        shift = local[3:6] - rotation @ direction * np.append(local[8:], 0.0).mean()
        return [(held, np.concatenate([local[:3], shift, local[6:8], np.zeros(len(held.images()))]), ())]
    found = []
    for image in images:
        start = pose_values(piece.pose(problem.parameters, problem.global_values, problem.local[number], image))
        found.append((replace(select_images(piece, [image]), staged=False), start, (TARGET,)))
    return found


def _fit_residuals(
    problem: JointProblem, estimate: Estimate, evidence: Evidence, local: np.ndarray, *, fitted: tuple[str, ...]
) -> list[Residuals]:
    """Return the residuals of the evidence after fitting the local parameters to the ``fitted`` kinds."""
    near = np.empty(0, dtype=bool)
    for number in range(_ROUNDS):
        parts = _compute_residuals(problem, estimate, evidence, local)
        chosen = [part for part in parts if part.kind in fitted]
        if not chosen:
            return parts
        values, by_local = np.concatenate([p.values for p in chosen]), np.vstack([p.by_local for p in chosen])
        # Updating the inliers in every round could oscillate.
        if number < _CHOOSING_ROUNDS:
            near = np.abs(values) <= max(outlier_limit(values), _SETTLED_PX)
        step = -np.linalg.lstsq(by_local[near], values[near], rcond=None)[0]
        local = local + step
        if np.abs(by_local @ step).max() < _SETTLED_PX:
            return _compute_residuals(problem, estimate, evidence, local)
    raise CalibrationError("the pose of a held-out image does not converge with this model")


def _compute_residuals(
    problem: JointProblem, estimate: Estimate, evidence: Evidence, local: np.ndarray
) -> list[Residuals]:
    parameters, values = estimate.parameters, estimate.values
    if problem.diameter_mm is not None and isinstance(evidence, TargetEvidence):
        evidence = evidence.with_centres(parameters, values, local, problem.diameter_mm)
    parts = evidence.residuals(parameters, values, local)
    if parts is None:
        raise CalibrationError("with this model an observed ray does not hit the sheet or the target")
    return parts


def _measure_errors(number: int, part: Residuals) -> Misses:
    """Convert the residuals of a part to errors in px and mm; for target points, to distances.

    A shift m of the target changes the residuals r by J m. The shortest m that cancels r is J^T (J J^T)^-1 r. On a
    step, the local parameter 1 is the shift of the tread.
    """
    where = (number, part.image)
    if part.kind == TARGET:
        px, by = part.values.reshape(-1, 2), part.by_local.reshape(len(part.values) // 2, 2, -1)[:, :, 3:6]
        across = by.transpose(0, 2, 1)
        mm = (across @ np.linalg.solve(by @ across, px[:, :, None]))[:, :, 0]
        return Misses(where, part.kind, np.linalg.norm(px, axis=1), np.linalg.norm(mm, axis=1))
    moved = part.by_local[:, 3:6] if part.by_local.shape[1] > 2 else part.by_local[:, 1:]
    px = np.abs(part.values)
    return Misses(where, part.kind, px, px / np.linalg.norm(moved, axis=1))
