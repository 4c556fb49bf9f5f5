"""Lens calibration from images of a target: selection of the model, of points and of images.

Residuals of the points of one image are correlated if the model is not perfect. Therefore, a model is scored by its
prediction of images that were not used for its calibration. An image is rejected if it changes the parameters too much.
The uncertainties follow from leaving out one image at a time (delete-one-group jackknife). Tangential distortion that
does not improve predictions is small but not known to be zero, and shifts the principal point.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import Literal

import cv2
import numpy as np

from uwlts.calibration.camera.camera_parameters import DISTORTION, CameraOptions, Intrinsics, TargetImage
from uwlts.calibration.camera.target_poses import CameraSolution, Poses, find_pose, solve_camera
from uwlts.errors import CalibrationError, DescriptionError
from uwlts.fitting.least_squares import DEFAULT_K, MAD_TO_STD
from uwlts.fitting.propagation import jackknife
from uwlts.model.calibration import CameraModel
from uwlts.model.sensor import Uncertainty
from uwlts.optics.camera import project
from uwlts.runtime.progress import ProgressListener, ignore_progress

_USUAL = ("k1", "k2")
DISTORTIONS = ((), ("k1",), _USUAL, *((*_USUAL, *names) for names in (("p1", "p2"), ("k3",), ("p1", "p2", "k3"))))
"""Coefficients of the lenses that are compared."""
RATIONAL = tuple((*_USUAL, *names) for names in (("k4", "k5"), ("p1", "p2", "k4", "k5")))
"""Coefficients that are tried if k3 helps."""
_WIDE_USUAL = RATIONAL[0]
WIDE_DEG = 45.0
"""Angle to the axis beyond which lenses are wide: tan > 1, so that the powers of k1 to k3 grow instead of fading."""
_FOLDS = 5  # parts of the images for cross-validation; 5 to 10 are usual
_WORSE = 1.0  # standard errors of the mean difference of squares within which a model is as good as the best
_LEAST_GAIN = 0.01  # relative to the mean square; a smaller gain is useless even if significant
_SOFT = 2.0  # robust standard deviations from which a point has less weight
_LARGEST_REJECTED = 0.3  # fraction of an image's points; more indicate another board or pose
_LEAST_SCATTER_PX = 1e-6  # scatter of points; simulated ones may have none
_FINEST_PX = 0.05
"""Scatter of a coordinate below which points and images are not distinguished. Blur, light and print differ between
good images by a few hundredths of a pixel; false points are off by much more. Chosen by hand, not fitted to data."""
_MOVED = 3.0  # standard uncertainties by which one image may change a parameter
HALVES_APART = 4.0  # largest difference of a parameter between two halves of the images, in its standard uncertainties
_FEWEST_IMAGES = 5  # images that must remain: with fewer, the influence of one image is uncertain
_LARGEST_LEFT_OUT = 0.2  # fraction of the images: if more change a parameter, it is unclear which are right

Coefficient = Literal["k1", "k2", "p1", "p2", "k3", "k4", "k5", "k6"]
Distortion = Literal["auto"] | tuple[Coefficient, ...]
Pixels = Literal["auto", "square", "free"]


def require_coefficients(distortion: Distortion) -> None:
    """Raise DescriptionError unless distortion is only auto, or each coefficient at most once."""
    if distortion != "auto" and (not set(distortion) <= set(DISTORTION) or len(set(distortion)) < len(distortion)):
        given = distortion if isinstance(distortion, str) else " ".join(distortion)
        raise DescriptionError(f"`distortion` {given}: expected only auto, or each of {', '.join(DISTORTION)} once")


@dataclass(frozen=True)
class LensChoice:
    """Parameters of a lens to estimate; "auto" selects them by prediction of held-out images.

    If p1 and p2 are not selected, they are estimated with zero prior mean and standard deviation ``tangential``. Pixels
    with a fixed shape have ``pixel_aspect``, fy / fx.
    """

    distortion: Distortion = "auto"
    pixels: Pixels = "auto"
    tangential: float = Uncertainty().tangential
    pixel_aspect: float = 1.0


@dataclass(frozen=True)
class LensCandidate:
    """Lens model with its prediction error for images that were not used for its calibration.

    ``rms_px`` is the root mean square error of their points, NaN if the images do not determine the model. ``worse`` is
    the mean difference of squared errors from the best model, divided by its standard error (0 for the best, infinite
    for NaN).
    """

    options: CameraOptions
    rms_px: float
    worse: float

    def parameters(self) -> int:
        """Return the number of estimated parameters."""
        return len(self.options.distortion) + (4 if self.options.pixel_aspect is None else 3)


@dataclass(frozen=True, eq=False)
class LensCalibration:
    """Calibrated lens and its evidence."""

    solution: CameraSolution  # solution for the used images, in their order; its covariance assumes independent points
    # Numbers (F,) of the used images, and these images without outliers.
    used: np.ndarray
    images: list[TargetImage]
    left_out: dict[int, str]  # number of each rejected image, and the reason
    moved: np.ndarray
    """(F,); largest change of a parameter without each used image, in its standard deviations without it (for points
    that scatter by at least 0.05 px); NaN if the parameters are then not determined."""
    without: list[CameraSolution | None]  # (F,); solutions from all used images except one; None if not determined
    halves: list[CameraSolution | None]
    """(2,); solutions from every second image and from the others; None if not determined."""
    rejected_share: float  # fraction of rejected points in the used images
    candidates: list[LensCandidate]  # compared models; empty if the model was given
    options: CameraOptions  # selected model
    covariance: np.ndarray  # (P, P); of the parameters, with correlated errors in each image

    def values(self) -> dict[str, float]:
        """Return every estimated parameter."""
        return self.solution.values()

    def project(self, points: np.ndarray, values: np.ndarray) -> np.ndarray:
        """Project points (N, 3) of the camera frame by other parameters (P,); return pixels (N, 2), else NaN."""
        model, names = self.solution.model, self.solution.parameters
        aspect = model.fy_px / model.fx_px if "f" in names else None
        options = CameraOptions(tuple(name for name in names if name in DISTORTION), aspect)
        return project(Intrinsics(options, model.width_px, model.height_px).model(values), points)

    def widest_deg(self) -> float:
        """Return the largest angle of a target point to the camera's axis, deg."""
        return _find_widest_deg(self.images, self.solution)

    def std(self) -> dict[str, float]:
        """Return the standard uncertainty of every estimated parameter."""
        return dict(zip(self.solution.parameters, np.sqrt(np.diag(self.covariance)).tolist(), strict=True))

    def half_values(self) -> list[dict[str, float]]:
        """Return every estimated parameter for each half of the images; empty if a half determines no camera."""
        found = [each for each in self.halves if each is not None]
        return [each.values() for each in found] if len(found) == 2 else []

    def half_doubts(self) -> list[str]:
        """Return warnings for parameters whose half-sample estimates differ by more than their uncertainties allow."""
        doubts, values = [], self.half_values()
        for name, std in self.std().items() if values else ():
            one, two = (each[name] for each in values)
            digits = 6 if name in DISTORTION else 2
            doubts += half_doubt(f"{name} is {one:.{digits}f} and {two:.{digits}f}", difference=abs(two - one), std=std)
        return doubts


def half_doubt(found: str, *, difference: float, std: float) -> list[str]:
    """Return a warning if two half-sample estimates differ by more than the standard uncertainty ``std`` allows.

    The difference of independent halves has twice the standard uncertainty of the full sample.
    """
    if difference <= HALVES_APART * 2 * std:
        return []
    sigmas = difference / (2 * std)
    return [
        f"two halves of the images disagree: {found}, which differ by {sigmas:.1f} standard uncertainties of this "
        "difference: uncertainties are larger than stated"
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
    progress: ProgressListener = ignore_progress,
) -> LensCalibration:
    """Calibrate a lens from images of a flat target.

    ``choice`` states the parameters to estimate. If the stage's direction is wrongly assumed to be the target's normal,
    this has the same effect as another lens. With the poses "stage-normal", "auto" therefore is k1 and k2; with both
    stage poses, pixels are square. Wide lenses, with points more than `WIDE_DEG` from the axis, usually have k1 k2 k4
    k5: a rational function follows the arctangent, which a polynomial cannot.

    ``progress`` is called with the number of models tried and the total; the other parameters are those of
    `solve_camera`.

    Raises CalibrationError if the images determine no model, or contradict each other.
    """

    solve_centres = partial(solve_camera, width_px=width_px, height_px=height_px, poses=poses, approaching=approaching)
    solve = partial(solve_centres, circle_diameter_mm=circle_diameter_mm)
    tried = _list_candidates(DISTORTIONS, choice, poses)
    usual = tried[0] if len(tried) == 1 else _list_candidates((_USUAL,), replace(choice, distortion="auto"), poses)[0]

    plain = solve(images, options=usual)
    wide = choice.distortion == "auto" and poses != "stage-normal" and _find_widest_deg(images, plain) > WIDE_DEG
    if wide:
        usual = replace(usual, distortion=_WIDE_USUAL)
        plain = solve(images, options=usual)

    def find_inliers(options: CameraOptions, plain: CameraSolution) -> dict[int, np.ndarray]:
        """Return masks (N,) of the points near their predicted positions, from a robust fit near a plain one.

        They are within five robust standard deviations, which are at least `_FINEST_PX`. Images with too many other
        points are left out.
        """
        robust = solve(images, start=plain, options=replace(options, soft_limit_px=_SOFT * _measure_scatter(plain)))
        limit = DEFAULT_K * max(_measure_scatter(robust), _FINEST_PX)
        misses = [np.linalg.norm(residuals, axis=1) for residuals in robust.residuals_px]
        shares.update(enumerate(float(np.mean(each <= limit)) for each in misses))
        return {n: each <= limit for n, each in enumerate(misses) if shares[n] >= 1 - _LARGEST_REJECTED}

    def clean(keep: dict[int, np.ndarray]) -> dict[int, TargetImage]:
        parts = ((n, images[n], inside) for n, inside in keep.items())
        return {n: replace(i, points_mm=i.points_mm[inside], pixels=i.pixels[inside]) for n, i, inside in parts}

    shares: dict[int, float] = {}
    candidates: list[LensCandidate] = []
    options, keep = usual, find_inliers(usual, plain)
    good = [*clean(keep).values()]
    if len(tried) > 1 and len(good) > _FEWEST_IMAGES:
        centred = _correct_circles(good, solve(good, options=usual))
        squares: dict[CameraOptions, np.ndarray] = {}
        for further in (tried, _list_candidates(RATIONAL, choice, poses)):
            for number, each in enumerate(further):
                squares[each] = _cross_validate(centred, partial(solve_centres, options=each))
                progress(number + 1, len(further))
            candidates = compare_models(squares)
            options = select_model(candidates, usual)
            if choice.distortion != "auto" or ("k3" not in options.distortion and not wide):
                break
    if options != usual:
        keep = find_inliers(options, solve(images, options=options))
    left_out = {
        number: f"{100 * (1 - share):.0f} % of its points are not where the other images predict them"
        for number, share in shares.items()
        if number not in keep
    }
    used, cleaned = [*keep], clean(keep)
    full = options
    if (
        choice.distortion == "auto"
        and poses != "stage-normal"
        and choice.tangential > 0
        and "p1" not in full.distortion
    ):
        scatter = _measure_scatter(solve([*cleaned.values()], options=options))
        names = (*options.distortion, "p1", "p2")
        full = replace(options, distortion=names, tangential=(choice.tangential, max(scatter, _LEAST_SCATTER_PX)))
    intrinsics = Intrinsics(full, width_px=width_px, height_px=height_px)
    solved_again = partial(solve_centres, options=full)
    while True:
        chosen = [cleaned[number] for number in used]
        solution = solve(chosen, options=full)
        centred = _correct_circles(chosen, solution)
        numbers = np.arange(len(used))
        all_but_one = [np.delete(numbers, number) for number in numbers]
        without = _solve_subsets(centred, solution, all_but_one, solved_again)
        values, none = intrinsics.from_model(solution.model), np.full(len(intrinsics.names), np.nan)
        changes = np.array([none if s is None else intrinsics.from_model(s.model) - values for s in without])
        # For points that scatter by at least `_FINEST_PX`.
        larger = [0 if s is None else max(_FINEST_PX / max(s.sigma_px, _LEAST_SCATTER_PX), 1.0) for s in without]
        std = [none if s is None else np.sqrt(np.diag(s.covariance)) for s in without]
        others_std = np.array(larger)[:, None] * np.array(std)
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
        left_out[used[worst]] = f"it alone changes {name} by {moved[worst]:.1f} standard uncertainties"
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
        halves=_solve_subsets(centred, solution, [numbers[::2], numbers[1::2]], solved_again),
        rejected_share=float(1.0 - np.mean(np.concatenate([keep[number] for number in used]))),
        candidates=candidates,
        options=options,
        covariance=solution.covariance * np.outer(larger, larger),
    )


def _list_candidates(any_of: Sequence[tuple[str, ...]], choice: LensChoice, poses: Poses) -> list[CameraOptions]:
    any_of = (_USUAL,) if poses == "stage-normal" else any_of
    sets = any_of if choice.distortion == "auto" else (choice.distortion,)
    known = choice.pixel_aspect
    any_shape = (known, None) if poses == "free" else (known,)
    shapes = {"auto": any_shape, "square": (known,), "free": (None,)}[choice.pixels]
    return [CameraOptions(names, pixel_aspect=shape) for names in sets for shape in shapes]


def _find_widest_deg(images: Sequence[TargetImage], solution: CameraSolution) -> float:
    """Return the largest angle of a target point to the camera's axis, deg, from the points' poses."""
    seen = [i.points_mm @ pose[:3, :3].T + pose[:3, 3] for i, pose in zip(images, solution.target_poses, strict=True)]
    points = np.vstack(seen)
    return float(np.degrees(np.arctan2(np.hypot(points[:, 0], points[:, 1]), points[:, 2]).max()))


def _measure_scatter(solution: CameraSolution) -> float:
    """Return the robust standard deviation of one coordinate of the residuals."""
    # median distance in two coordinates, divided by the standard deviation of one
    return float(np.median(np.linalg.norm(np.vstack(solution.residuals_px), axis=1))) / 1.1774


def _correct_circles(images: Sequence[TargetImage], solution: CameraSolution) -> list[TargetImage]:
    """Correct images for the offsets of circle centres."""
    if solution.bias_px is None:
        return list(images)
    return [replace(i, pixels=i.pixels - bias) for i, bias in zip(images, solution.bias_px, strict=True)]


def _cross_validate(images: list[TargetImage], solve: Callable[[Sequence[TargetImage]], CameraSolution]) -> np.ndarray:
    """Return each image's mean square prediction error (F,) from five-fold calibrations; NaN if one fails."""
    folds = min(_FOLDS, len(images))
    squares = np.full(len(images), np.nan)
    try:
        for fold in range(folds):
            model = solve([image for place, image in enumerate(images) if place % folds != fold]).model
            for place in range(fold, len(images), folds):
                squares[place] = _compute_mean_square_miss(model, images[place])
    except CalibrationError:
        squares[:] = np.nan
    return squares


def compare_models(squares: dict[CameraOptions, np.ndarray], *, least_gain: float = _LEAST_GAIN) -> list[LensCandidate]:
    """Compare models by their mean square errors (F,); empty if no model has any.

    A gain below the fraction ``least_gain`` of the mean square is no gain.
    """
    means = {options: float(each.mean()) for options, each in squares.items()}
    least = np.nanmin([*means.values(), np.inf])
    if np.isinf(least):
        return []
    best = next(squares[options] for options, mean in means.items() if mean == least)
    found = []
    for options, each in squares.items():
        difference = each - best
        error = float(np.std(difference, ddof=1)) / np.sqrt(len(difference))
        small = means[options] - least <= least_gain * least
        worse = 0.0 if small else np.inf if np.isnan(means[options]) else float(np.mean(difference)) / error
        found.append(LensCandidate(options, float(np.sqrt(means[options])), worse))
    return found


def _compute_mean_square_miss(model: CameraModel, image: TargetImage) -> float:
    """Return the mean square distance of an image's points from their prediction, with the best-fitting pose."""
    matrix, coefficients = model.matrix(), model.coefficients()
    pose = find_pose(image.points_mm, image.pixels, matrix, coefficients)
    rotation, shift = cv2.solvePnPRefineLM(
        image.points_mm, image.pixels, matrix, coefficients, pose[:3, None], pose[3:, None]
    )
    seen = cv2.projectPoints(image.points_mm, rotation, shift, matrix, coefficients)[0].reshape(-1, 2)
    return float(np.mean(np.sum((image.pixels - seen) ** 2, axis=1)))


def select_model(candidates: list[LensCandidate], usual: CameraOptions) -> CameraOptions:
    """Select the model with the fewest parameters of those as good as the best, else the usual one."""
    good = [each for each in candidates if each.worse <= _WORSE]
    return min(good, key=lambda each: (each.parameters(), each.rms_px)).options if good else usual


def _solve_subsets(
    images: list[TargetImage],
    solution: CameraSolution,
    chosen: Sequence[np.ndarray],
    solve: Callable[..., CameraSolution],
) -> list[CameraSolution | None]:
    """Solve for subsets of the images, given by their numbers; None if a subset does not determine the camera."""
    found: list[CameraSolution | None] = []
    for numbers in chosen:
        try:
            start = replace(solution, target_poses=solution.target_poses[numbers])
            found.append(solve([images[number] for number in numbers], start=start))
        except CalibrationError:
            found.append(None)
    return found
