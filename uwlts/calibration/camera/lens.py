"""A lens from images of a target alone: the model that predicts best, without doubtful points and images.

Misses of the points of one image go together where the model is not perfect. So a model is chosen by how well it
predicts images that it was not calibrated from, an image is judged by how far it moves the parameters, and the
uncertainties follow from what leaving out one image after the other does (the delete-one-group jackknife). Tangential
distortion that prediction does not ask for is small, but not known to be zero, and moves the principal point.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import Literal

import cv2
import numpy as np

from uwlts.calibration.camera.camera_parameters import DISTORTION, CameraOptions, Intrinsics
from uwlts.calibration.camera.target_images import TargetImage
from uwlts.calibration.camera.target_poses import CameraSolution, Poses, solve_camera
from uwlts.errors import CalibrationError, DescriptionError
from uwlts.fitting.least_squares import MAD_TO_STD
from uwlts.model.calibration import CameraModel
from uwlts.model.sensor import Uncertainty
from uwlts.runtime.progress import ProgressListener, unheard

BESIDES = (("p1", "p2"), ("k3",), ("p1", "p2", "k3"))
"""Coefficients that lenses are tried with besides k1 and k2."""
RATIONAL_BESIDES = (("k4", "k5"), ("p1", "p2", "k4", "k5"))
"""Those that are tried where k3 helps."""
_USUAL = ("k1", "k2")
_DISTORTIONS = ((), ("k1",), _USUAL, *((*_USUAL, *names) for names in BESIDES))
_RATIONAL = tuple((*_USUAL, *names) for names in RATIONAL_BESIDES)
_FOLDS = 5
_WORSE = 1.0  # standard errors of the mean difference of squares; below, a model counts as good as the best
_LEAST_GAIN = 0.01  # of the mean square; less is of no use, however certain
_SOFT = 2.0  # robust standard deviations from where a point counts less
_OUTLIER = 5.0  # robust standard deviations from where a point does not count
_LARGEST_REJECTED = 0.3  # of an image's points; more are another board, or another pose
_LEAST_SCATTER_PX = 1e-6  # of points; drawn ones may have none
_MOVED = 3.0  # standard uncertainties by which one image may move a parameter
HALVES_APART = 4.0
"""Standard uncertainties that a parameter from one half of the images may differ from that by the other."""
_FEWEST_IMAGES = 5  # that are left: of fewer the influence of one says little
_LARGEST_LEFT_OUT = 0.2  # share of the images: where more move a parameter, it is not clear which are right

Coefficient = Literal["k1", "k2", "p1", "p2", "k3", "k4", "k5", "k6"]
Distortion = Literal["auto"] | tuple[Coefficient, ...]
Pixels = Literal["auto", "square", "free"]


def require_coefficients(distortion: Distortion) -> None:
    """Raise DescriptionError unless distortion is auto alone, or each coefficient at most once."""
    if distortion != "auto" and (not set(distortion) <= set(DISTORTION) or len(set(distortion)) < len(distortion)):
        given = distortion if isinstance(distortion, str) else " ".join(distortion)
        raise DescriptionError(f"`distortion` {given}: expected auto alone, or each of {', '.join(DISTORTION)} once")


@dataclass(frozen=True)
class LensChoice:
    """What of a lens is estimated; "auto" chooses by prediction of images left out.

    Where p1 and p2 are not chosen, they are estimated as known to be zero but for a standard deviation ``tangential``.
    Pixels that are not free are of ``pixel_aspect``, fy over fx.
    """

    distortion: Distortion = "auto"
    pixels: Pixels = "auto"
    tangential: float = Uncertainty().tangential
    pixel_aspect: float = 1.0


@dataclass(frozen=True)
class LensCandidate:
    """A lens model, and how well it predicts images that it was not calibrated from.

    ``rms_px`` is the root mean square miss of their points, NaN where the images do not determine the model; ``worse``
    the mean difference of the squares from the best model's, over its standard error: 0 for the best, infinite for NaN.
    """

    options: CameraOptions
    rms_px: float
    worse: float

    @property
    def name(self) -> str:
        """The coefficients and the pixels in words."""
        return _name(self.options)

    def parameters(self) -> int:
        """Number of parameters that are estimated."""
        return len(self.options.distortion) + (4 if self.options.pixel_aspect is None else 3)


@dataclass(frozen=True, eq=False)
class LensCalibration:
    """A calibrated lens and what it rests on.

    Attributes
    ----------
    solution : for the images used, in their order; its covariance is the one of independent points
    used, images : numbers (F,) of the images used, among those given, and these without their outliers
    left_out : number of an image left out, and the reason
    moved : (F,); how far leaving out each image used moves a parameter at most, in its standard deviations without it;
        NaN if without it nothing is determined
    rejected_share : share of the points that were left out, of the images used
    halves : (2,); the solutions from every second image and from the others, None where they determine none
    without : (F,); the solutions from all images used but one, None where they determine none
    candidates : models compared; none if the model was given
    options : the model that was taken
    covariance : (P, P); of the parameters, with the misses of an image taken to go together
    """

    solution: CameraSolution
    used: np.ndarray
    images: list[TargetImage]
    left_out: dict[int, str]
    moved: np.ndarray
    without: list[CameraSolution | None]
    halves: list[CameraSolution | None]
    rejected_share: float
    candidates: list[LensCandidate]
    options: CameraOptions
    covariance: np.ndarray

    @property
    def name(self) -> str:
        """The lens model in words."""
        return _name(self.options)

    def values(self) -> dict[str, float]:
        """Every estimated parameter."""
        return self.solution.values()

    def std(self) -> dict[str, float]:
        """Standard uncertainty of every estimated parameter."""
        return dict(zip(self.solution.parameters, np.sqrt(np.diag(self.covariance)).tolist(), strict=True))

    def half_values(self) -> list[dict[str, float]]:
        """Every estimated parameter by each half of the images; none where a half determines no camera."""
        found = [each for each in self.halves if each is not None]
        return [each.values() for each in found] if len(found) == 2 else []

    def half_doubts(self) -> list[str]:
        """What the halves of the images say against the uncertainties of the parameters, in words."""
        doubts, values = [], self.half_values()
        for name, std in self.std().items() if values else ():
            one, two = (each[name] for each in values)
            digits = 6 if name in DISTORTION else 2
            doubts += half_doubt(f"{name} is {one:.{digits}f} and {two:.{digits}f}", apart=abs(two - one), std=std)
        return doubts


def half_doubt(found: str, *, apart: float, std: float) -> list[str]:
    """A warning where two halves of the images are further ``apart`` than a standard uncertainty ``std`` of all allows.

    Of independent halves the difference has twice the standard uncertainty of all.
    """
    if apart <= HALVES_APART * 2 * std:
        return []
    sigmas = apart / (2 * std)
    return [
        f"two halves of the images disagree: {found}, {sigmas:.1f} standard uncertainties of such a difference apart: "
        "uncertainties are larger than stated"
    ]


def calibrate_lens(
    images: Sequence[TargetImage],
    *,
    width_px: int,
    height_px: int,
    poses: Poses = "free",
    approaching: bool = True,
    choice: LensChoice = LensChoice(),
    circle_diameter_mm: float | None = None,
    progress: ProgressListener = unheard,
) -> LensCalibration:
    """Calibrate a lens from images of a flat target.

    Parameters
    ----------
    choice : what is estimated. A stage's direction that is taken for the target's normal, and is not, looks like
        another lens: so with the poses "stage-normal" "auto" is k1 and k2; with both poses of a stage pixels are square
    progress : called with the number of models tried and of all

    Other parameters are those of `solve_camera`.

    Raises CalibrationError: no model is determined by the images, or they contradict each other.
    """

    def solved(
        chosen: Sequence[TargetImage], start: CameraSolution | None = None, *, options: CameraOptions, circles: bool
    ) -> CameraSolution:
        return solve_camera(
            chosen,
            width_px=width_px,
            height_px=height_px,
            poses=poses,
            approaching=approaching,
            options=options,
            start=start,
            circle_diameter_mm=circle_diameter_mm if circles else None,
        )

    tried = _candidates(_DISTORTIONS, choice, poses)
    usual = tried[0] if len(tried) == 1 else _candidates((_USUAL,), replace(choice, distortion="auto"), poses)[0]

    def inliers(options: CameraOptions) -> list[np.ndarray]:
        """Points (N,) of each image near to where the lens sees them, found without trust in any of them."""
        plain = solved(images, options=options, circles=True)
        robust = solved(images, plain, options=replace(options, soft_limit_px=_SOFT * _scatter(plain)), circles=True)
        return _inliers(robust)

    candidates: list[LensCandidate] = []
    options, keep = usual, inliers(usual)
    good = [_without_outliers(i, inside) for i, inside in zip(images, keep, strict=True) if _fits(inside)]
    if len(tried) > 1 and len(good) > _FEWEST_IMAGES:
        centred = _centred(good, solved(good, options=usual, circles=True))
        squares: dict[CameraOptions, np.ndarray] = {}
        for further in (tried, _candidates(_RATIONAL, choice, poses)):
            for number, each in enumerate(further):
                squares[each] = _misses_predicted(centred, partial(solved, options=each, circles=False))
                progress(number + 1, len(further))
            candidates = _compared(squares)
            options = _chosen(candidates, usual)
            if choice.distortion != "auto" or "k3" not in options.distortion:
                break
    if options != usual:
        keep = inliers(options)
    left_out = {
        number: f"{100 * (1 - inside.mean()):.0f} % of its points do not lie where the others' lens sees them"
        for number, inside in enumerate(keep)
        if not _fits(inside)
    }
    used = [number for number in range(len(images)) if number not in left_out]
    cleaned = {number: _without_outliers(images[number], keep[number]) for number in used}
    full = options
    if (
        choice.distortion == "auto"
        and poses != "stage-normal"
        and choice.tangential > 0
        and "p1" not in full.distortion
    ):
        scatter = _scatter(solved([*cleaned.values()], options=options, circles=True))
        names = (*options.distortion, "p1", "p2")
        full = replace(options, distortion=names, tangential=(choice.tangential, max(scatter, _LEAST_SCATTER_PX)))
    intrinsics = Intrinsics(full, width_px=width_px, height_px=height_px)
    solved_again = partial(solved, options=full, circles=False)
    while True:
        chosen = [cleaned[number] for number in used]
        solution = solved(chosen, options=full, circles=True)
        centred = _centred(chosen, solution)
        numbers = np.arange(len(used))
        all_but_one = [np.delete(numbers, number) for number in numbers]
        without = _of_some(centred, solution, all_but_one, solved_again)
        values, none = intrinsics.from_model(solution.model), np.full(len(intrinsics.names), np.nan)
        changes = np.array([none if s is None else intrinsics.from_model(s.model) - values for s in without])
        others_std = np.array([none if s is None else np.sqrt(np.diag(s.covariance)) for s in without])
        if not np.isfinite(changes).any():
            moved = np.full(len(used), np.nan)
            break
        unit = np.maximum(others_std, MAD_TO_STD * np.sqrt(len(used)) * np.nanmedian(np.abs(changes), axis=0))
        moved = np.nanmax(np.abs(changes) / unit, axis=1, initial=0.0)
        moved[np.isnan(changes).all(axis=1)] = np.nan
        worst = int(np.nanargmax(moved))
        enough = len(used) > max(_FEWEST_IMAGES, (1 - _LARGEST_LEFT_OUT) * len(images))
        if moved[worst] <= _MOVED or not enough:
            break
        name = solution.parameters[int(np.nanargmax(np.abs(changes[worst]) / unit[worst]))]
        left_out[used[worst]] = f"it alone moves {name} by {moved[worst]:.1f} standard uncertainties"
        del used[worst]
    std, known = np.sqrt(np.diag(solution.covariance)), changes[np.isfinite(changes).all(axis=1)]
    larger = np.maximum(np.sqrt(np.diag(jackknife(known))) / std, 1.0)
    return LensCalibration(
        solution=solution,
        used=np.array(used),
        images=chosen,
        left_out=left_out,
        moved=moved,
        without=without,
        halves=_of_some(centred, solution, [numbers[::2], numbers[1::2]], solved_again),
        rejected_share=float(1.0 - np.mean(np.concatenate([keep[number] for number in used]))),
        candidates=candidates,
        options=options,
        covariance=solution.covariance * np.outer(larger, larger),
    )


def _name(options: CameraOptions) -> str:
    coefficients = " ".join(options.distortion) or "no distortion"
    shape = {None: "free pixels", 1.0: "square pixels"}
    return f"{coefficients}, {shape.get(options.pixel_aspect) or f'pixels of aspect {options.pixel_aspect:g}'}"


def _candidates(any_of: Sequence[tuple[str, ...]], choice: LensChoice, poses: Poses) -> list[CameraOptions]:
    any_of = (_USUAL,) if poses == "stage-normal" else any_of
    sets = any_of if choice.distortion == "auto" else (choice.distortion,)
    known = choice.pixel_aspect
    any_shape = (known, None) if poses == "free" else (known,)
    shapes = {"auto": any_shape, "square": (known,), "free": (None,)}[choice.pixels]
    return [CameraOptions(names, pixel_aspect=shape) for names in sets for shape in shapes]


def _scatter(solution: CameraSolution) -> float:
    """Robust standard deviation of one coordinate of the misses."""
    # The median of a distance in two coordinates is 1.1774 of one coordinate's standard deviation.
    return float(np.median(np.linalg.norm(np.vstack(solution.residuals_px), axis=1))) / 1.1774


def _inliers(solution: CameraSolution) -> list[np.ndarray]:
    """Points (N,) of each image within five robust standard deviations of all."""
    limit = _OUTLIER * _scatter(solution)
    return [np.linalg.norm(residuals, axis=1) <= limit for residuals in solution.residuals_px]


def _fits(inside: np.ndarray) -> bool:
    """Whether an image has enough points (N,) within the limit to be one of the target."""
    return bool(inside.mean() >= 1 - _LARGEST_REJECTED)


def _without_outliers(image: TargetImage, keep: np.ndarray) -> TargetImage:
    return replace(image, points_mm=image.points_mm[keep], pixels=image.pixels[keep])


def _centred(images: Sequence[TargetImage], solution: CameraSolution) -> list[TargetImage]:
    """The images with the offsets of circles taken out."""
    if solution.bias_px is None:
        return list(images)
    return [replace(i, pixels=i.pixels - bias) for i, bias in zip(images, solution.bias_px, strict=True)]


def _misses_predicted(
    images: list[TargetImage], solve: Callable[[Sequence[TargetImage]], CameraSolution]
) -> np.ndarray:
    """Mean square miss (F,) of each image by a calibration without every fifth, it among them; NaN if one has none."""
    folds = min(_FOLDS, len(images))
    squares = np.full(len(images), np.nan)
    try:
        for fold in range(folds):
            model = solve([image for place, image in enumerate(images) if place % folds != fold]).model
            for place in range(fold, len(images), folds):
                squares[place] = _mean_square_miss(model, images[place])
    except CalibrationError:
        squares[:] = np.nan
    return squares


def _compared(squares: dict[CameraOptions, np.ndarray]) -> list[LensCandidate]:
    """Models by the mean squares of their misses (F,); none if no model has any."""
    means = {options: float(each.mean()) for options, each in squares.items()}
    least = np.nanmin([*means.values(), np.inf])
    if np.isinf(least):
        return []
    best = next(squares[options] for options, mean in means.items() if mean == least)
    found = []
    for options, each in squares.items():
        apart = each - best
        error = float(np.std(apart, ddof=1)) / np.sqrt(len(apart))
        small = means[options] - least <= _LEAST_GAIN * least
        worse = 0.0 if small else np.inf if np.isnan(means[options]) else float(np.mean(apart)) / error
        found.append(LensCandidate(options, float(np.sqrt(means[options])), worse))
    return found


def _mean_square_miss(model: CameraModel, image: TargetImage) -> float:
    """Mean square distance of an image's points from where the model sees them, in the pose that fits them best."""
    matrix, coefficients = model.matrix(), model.coefficients()
    found, rotation, shift = cv2.solvePnP(image.points_mm, image.pixels, matrix, coefficients)
    if not found:
        raise CalibrationError("no pose of the target explains one of its images")
    rotation, shift = cv2.solvePnPRefineLM(image.points_mm, image.pixels, matrix, coefficients, rotation, shift)
    seen = cv2.projectPoints(image.points_mm, rotation, shift, matrix, coefficients)[0].reshape(-1, 2)
    return float(np.mean(np.sum((image.pixels - seen) ** 2, axis=1)))


def _chosen(candidates: list[LensCandidate], usual: CameraOptions) -> CameraOptions:
    """The model with the fewest parameters among those as good as the best; the usual one if none was tried."""
    good = [each for each in candidates if each.worse <= _WORSE]
    return min(good, key=lambda each: (each.parameters(), each.rms_px)).options if good else usual


def _of_some(
    images: list[TargetImage],
    solution: CameraSolution,
    chosen: Sequence[np.ndarray],
    solve: Callable[[Sequence[TargetImage], CameraSolution], CameraSolution],
) -> list[CameraSolution | None]:
    """The solutions from some of the images, by their numbers; None where they determine none."""
    found: list[CameraSolution | None] = []
    for numbers in chosen:
        try:
            start = replace(solution, target_poses=solution.target_poses[numbers])
            found.append(solve([images[number] for number in numbers], start))
        except CalibrationError:
            found.append(None)
    return found


def jackknife(changes: np.ndarray) -> np.ndarray:
    """Covariance (P, P) of parameters from their changes (F, P) when one group of observations is left out after other.

    Of the delete-one-group jackknife: (F - 1) / F times the sum of squares (Efron and Stein, 1981, eq. 1.4).
    """
    return (len(changes) - 1) / max(len(changes), 1) * changes.T @ changes
