"""Images of a step standard: its faces, the window distance (thesis, sections 3.2.2 and 4.8.1), and plausible sizes."""

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import groupby

import numpy as np
from pydantic import JsonValue
from scipy.optimize import least_squares, root_scalar

from uwlts.calibration.camera.camera_parameters import TargetImage
from uwlts.calibration.camera.target_poses import CameraSolution
from uwlts.calibration.capture_evidence import StepEvidence
from uwlts.errors import CalibrationError, EvaluationError
from uwlts.model.calibration import Calibration, WindowModel
from uwlts.model.sensor import Uncertainty
from uwlts.optics.triangulation import reconstruct_pixels
from uwlts.shapes.flat import Line, Plane
from uwlts.shapes.step import StepFace, label_step_faces, step_height

_FEWEST_PLACES = 3  # images of a face: fewer do not show that it is a plane
_LEAST_TRAVEL_MM = 5.0  # travel of the stage across the stripe: less does not show that the face is a plane
_STOOD_STILL = 2.0
"""Largest ratio of the scatter about a common plane to that about single lines for a standard at rest."""
_STAGE_MM = 0.05  # additional error of a stage
_SCALE_STD = 0.05  # relative, of profiles with a window that is only described
_OF_SQUARE = np.sqrt(3) / 2
"""Root mean square of a²/2 divided by the variance of a normal angle a, as 1 / cos(a) is about 1 + a²/2."""


@dataclass(frozen=True, eq=False, kw_only=True)
class StepImage(StepEvidence):
    """Stripe on a step standard with the `StepFace` (N,) of every pixel.

    Within the sheet, the height is ``lengthened`` times the height along the normal, with the relative standard
    uncertainty ``lengthened_std``. A rotation by a about the stripe gives 1 / cos(a).
    """

    labels: np.ndarray
    lengthened: float = 1.0
    lengthened_std: float = 0.0

    def height_mm(self) -> float:
        """Return the calibrated height of the step within the sheet."""
        return self.lengthened * self.standard.height_mm

    def height_std_mm(self, known: Uncertainty) -> float:
        """Return the standard uncertainty of that height, from the certificate (or a usual value) and the rotation."""
        stated = self.standard.height_uncertainty_mm
        return math.hypot(stated / 2 if stated else known.step_height_mm, self.standard.height_mm * self.lengthened_std)


def step_profile(
    calibration: Calibration, window: WindowModel | None, pixels: np.ndarray, *, medium_index: float
) -> np.ndarray:
    """Return points (N, 2) of a profile, Y and Z of the OCS in mm, through a window; else NaN."""
    placed = calibration.model_copy(update={"window": window})
    return reconstruct_pixels(placed, pixels, medium_index=medium_index).points_mm[:, 1:]


def label_step(calibration: Calibration, window: WindowModel | None, step: StepEvidence) -> StepImage:
    """Separate the faces with the window's nominal distance: the profile is accurate to a few percent.

    Raises EvaluationError if the profile does not show two faces.
    """
    points = step_profile(calibration, window, step.pixels, medium_index=step.medium_index)
    found = np.isfinite(points).all(axis=1)
    labels = np.full(len(points), int(StepFace.NEITHER), dtype=np.int8)
    labels[found] = label_step_faces(points[found], height_mm=step.standard.height_mm, edge_mm=step.standard.edge_mm)
    return StepImage(**vars(step), labels=labels)


@dataclass(frozen=True)
class StandardTurn:
    """Rotation of a step standard from facing the laser, rad.

    ``aside`` (root mean square over the images) is about the sheet's normal; it is visible in profiles and does not
    change heights. ``about_stripe``, with the standard uncertainty ``std``, changes heights. If it is unknown, it is
    None, and ``std`` is assumed to be as large as ``aside``.
    """

    aside: float
    about_stripe: float | None
    std: float

    def compute_lengthening(self) -> tuple[float, float]:
        """Return the height within the sheet relative to that along the normal, and its standard uncertainty."""
        turn = self.about_stripe or 0.0
        return float(1 / np.cos(turn)), float(np.hypot(np.tan(turn) * self.std, _OF_SQUARE * self.std**2))

    def doubt(self, *, height_mm: float, std_mm: float) -> str:
        """Describe the effect on a height; empty if less than the height's standard uncertainty."""
        angle = self.aside if self.about_stripe is None else abs(self.about_stripe)
        share = 1 / np.cos(angle) - 1
        if share * height_mm <= std_mm:
            return ""
        higher = f"appears higher by {100 * share:.2f} % or {share * height_mm:.3f} mm"
        text = "the standard does not face the laser: it is rotated by"
        if self.about_stripe is None:
            return (
                f"{text} {np.degrees(angle):.1f}° about the sheet's normal. This does not change the height. But with "
                f"the same rotation about the stripe, which these images do not show, it {higher}: make it face "
                "the laser, or let the stage move the sensor across the stripe between three or more images"
            )
        return (
            f"{text} {np.degrees(angle):.1f} +- {np.degrees(self.std):.1f}° about the stripe, so that it {higher}. "
            "This is taken into account; to avoid it, make the standard face the laser"
        )


def label_steps(
    calibration: Calibration, window: WindowModel | None, steps: Sequence[StepEvidence], *, uncertainty: Uncertainty
) -> tuple[list[StepImage | None], list[str]]:
    """Separate the faces of each image and estimate the standard's rotation; None for an image without two faces.

    If the stage moves the sensor across the stripe and the standard is at rest, the images of a capture show its
    rotation about the stripe. Warnings list rejected images, and standards that do not face the laser.
    """
    found: list[StepImage | None] = []
    warnings = []
    for capture, images in groupby(steps, key=StepEvidence.capture):
        labelled: list[StepImage | None] = []
        for step in images:
            try:
                labelled.append(label_step(calibration, window, step))
            except EvaluationError as error:
                labelled.append(None)
                warnings.append(f"{step.source}: left out, {error}")
        seen = [image for image in labelled if image is not None]
        if seen:
            turn, standard = _estimate_turn(calibration, window, seen, uncertainty), seen[0].standard
            if doubt := turn.doubt(height_mm=standard.height_mm, std_mm=seen[0].height_std_mm(uncertainty)):
                warnings.append(f"{capture}: {doubt}")
            factor, std = turn.compute_lengthening()
            labelled = [
                None if image is None else replace(image, lengthened=factor, lengthened_std=std) for image in labelled
            ]
        found += labelled
    return found, warnings


def _estimate_turn(
    calibration: Calibration, window: WindowModel | None, images: Sequence[StepImage], uncertainty: Uncertainty
) -> StandardTurn:
    """Estimate the rotation of a standard from the lower face in images of one capture: lines, and a common plane."""
    faces = []
    for image in images:
        pixels = image.pixels[image.labels == StepFace.LOWER]
        faces.append(step_profile(calibration, window, pixels, medium_index=image.medium_index))
    lines = [Line.fit(face) for face in faces]
    aside = float(np.sqrt(np.mean([np.arctan(line.direction[1] / line.direction[0]) ** 2 for line in lines])))
    travel = np.array([image.travel_mm for image in images])
    if len(images) >= _FEWEST_PLACES and np.ptp(travel[:, 0]) > _LEAST_TRAVEL_MM:
        in_space = [np.pad(face, ((0, 0), (1, 0))) + moved for face, moved in zip(faces, travel, strict=True)]
        plane = Plane.fit(np.vstack(in_space))
        scatter = float(np.sqrt(np.mean([line.std_mm**2 for line in lines])))
        if plane.std_mm < np.hypot(_STOOD_STILL * scatter, _STAGE_MM):
            about_stripe = float(np.arcsin(min(abs(plane.normal[0]), 1.0)))
            slope = float(np.sqrt(np.diag(plane.covariance)[1:].max()))
            std = float(np.linalg.norm([uncertainty.stage_lean(), _SCALE_STD * about_stripe, slope]))
            return StandardTurn(aside, about_stripe, std)
    return StandardTurn(aside, None, aside)


_CURVE_POINTS = 31  # the curve has one minimum, several points wide
_SEARCHED = (0.2, 2.5)  # fractions of the described distance, which is measured to better than half
# Over the whole range of distances, the height must change by this factor of its scatter, and by more than rounding.
_LEAST_CHANGE = 10.0
_ROUNDING_MM = 1e-6
_INDEX_STEP = 1e-5  # for the derivative by the index
_USUALLY_KNOWN = Uncertainty()
_AT_BOUND = 1e-3  # fraction of the range; least squares with bounds stop this close to them


@dataclass(frozen=True, eq=False)
class WindowSolution:
    """Window at the distance that fits the steps best."""

    model: WindowModel
    # (S,); height of the step in every image, its error, and its standard deviation from the scatter of the points.
    heights_mm: np.ndarray
    errors_mm: np.ndarray
    height_std_mm: np.ndarray
    slopes: np.ndarray  # (S,); derivative of each height by the distance
    std_mm: float | None
    """Standard deviation of the distance from the remaining height errors; None with a single image."""
    scatter_std_mm: float  # standard deviation from the scatter of the points only
    per_height: float  # derivative of the distance by the calibrated height, if all images use the same step
    per_index: float  # derivative of the distance by the index, if all images are taken in the same medium
    uncertainty_mm: float
    """Standard uncertainty of the distance, from the remaining errors (or the scatter of a single image), the
    calibrated height and the medium's index, which are common to all images."""
    image_distances_mm: np.ndarray  # (S,); distance from each single image (thesis, Table 4); NaN outside the bounds
    curve_mm: np.ndarray
    """(C, 2); tested distances and root mean square height error, NaN if a point cannot be reconstructed."""
    bounds_mm: tuple[float, float]  # (2,)

    def figures(self, steps: Sequence[StepImage]) -> dict[str, JsonValue]:
        """Return step heights with errors, standard deviations of the distance, and the curve, for files."""
        return {
            "images": [step.source for step in steps],
            "distance_mm": self.model.distance_mm,
            "std_mm": self.uncertainty_mm,
            "left_over_std_mm": self.std_mm,
            "scatter_std_mm": self.scatter_std_mm,
            "per_height": self.per_height,
            "per_index": self.per_index,
            "heights_mm": self.heights_mm.tolist(),
            "errors_mm": self.errors_mm.tolist(),
            "height_std_mm": self.height_std_mm.tolist(),
            "image_distances_mm": _replace_nan(self.image_distances_mm),
            "curve_mm": [_replace_nan(row) for row in self.curve_mm],
            "bounds_mm": list(self.bounds_mm),
        }


def _replace_nan(values: np.ndarray) -> list[JsonValue]:
    return [value if np.isfinite(value) else None for value in values.tolist()]


def solve_window(
    calibration: Calibration,
    window: WindowModel,
    steps: Sequence[StepImage],
    *,
    bounds_mm: tuple[float, float] | None = None,
    known: Uncertainty = _USUALLY_KNOWN,
) -> WindowSolution:
    """Find the window distance that minimises the mean square height error over all step images.

    A coarse scan finds the valley, and Gauss-Newton steps within the bounds find the minimum.

    Of the ``calibration`` in air only camera, sheet and OCS are used, of the ``window`` all but its distance. The
    bounds are by default 0.2 and 2.5 times the nominal distance. ``known`` states the uncertainty of heights without a
    certificate.

    Raises CalibrationError if there is no step image, or a height is not positive. The same if the best distance is at
    a bound, or the heights depend too little on it; RangeError if a pixel or the medium's index is not finite.
    """
    if not steps:
        raise CalibrationError("the window's distance needs at least one image of a step standard")
    low, high = bounds_mm or tuple(share * window.distance_mm for share in _SEARCHED)
    if not 0 < low < high < np.inf:
        raise CalibrationError(f"the window's distance is searched from {low:g} to {high:g} mm; give 0 < low < high")
    true = np.array([step.height_mm() for step in steps])
    if not (np.isfinite(true) & (true > 0)).all():
        raise CalibrationError(f"the heights of the steps must be positive lengths in mm, not {true.tolist()}")

    def heights(distance: float) -> np.ndarray:
        return _measure(calibration, window, steps, distance)[:, 0]

    tried = np.linspace(low, high, _CURVE_POINTS)
    scanned = np.array([heights(distance) for distance in tried])
    mean_error = np.sqrt(np.mean((scanned - true) ** 2, axis=1))
    usable = np.isfinite(mean_error)
    if np.count_nonzero(usable) < 3:
        raise CalibrationError(
            f"the step cannot be reconstructed with a window {low:.1f} to {high:.1f} mm from the pinhole: the window "
            "would be behind the step"
        )
    # Distances with reconstructed points form one range: the window is in front of the nearest point.
    low, high = float(tried[usable][0]), float(tried[usable][-1])
    margin = _AT_BOUND * (high - low)
    best = least_squares(
        lambda d: heights(d[0]) - true,
        [np.clip(tried[np.nanargmin(mean_error)], low + margin, high - margin)],
        bounds=(low, high),
        xtol=1e-12,
        ftol=1e-12,
        gtol=1e-14,
        x_scale=high - low,
    )
    distance, slopes = float(best.x[0]), best.jac[:, 0]
    measured, height_std = _measure(calibration, window, steps, distance).T
    errors = measured - true
    change, scatter = (np.sqrt(np.mean(v**2)) for v in (np.ptp(scanned[usable], axis=0), height_std))
    if change < max(_LEAST_CHANGE * scatter, _ROUNDING_MM):
        raise CalibrationError(
            f"the step's height depends too little on the window's distance: it changes by {change:.3g} mm from "
            f"{low:.1f} to {high:.1f} mm, with a scatter of {scatter:.3g} mm; take images in the medium of a "
            "higher step"
        )
    if not low + margin < distance < high - margin:
        raise CalibrationError(
            f"the step's height fits best at the bound of the searched window distances, {low:.1f} to {high:.1f} mm: "
            "check the medium's index, the step's height and the window's described distance, and that the images are "
            "not rotated or mirrored"
        )
    pairs = zip(steps, scanned[usable].T - true[:, None], strict=True)
    squares, freedom = float(slopes @ slopes), len(steps) - 1
    std = float(np.sqrt(errors @ errors / freedom / squares)) if freedom else None
    scatter_std = float(np.linalg.norm(slopes * height_std)) / squares
    denser = [replace(step, medium_index=step.medium_index + _INDEX_STEP) for step in steps]
    by_index = (_measure(calibration, window, denser, distance)[:, 0] - measured) / _INDEX_STEP
    per_height, per_index = float(slopes.sum()) / squares, -float(slopes @ by_index) / squares
    height_std_mm = max(step.height_std_mm(known) for step in steps)
    index_std = max(step.index_std for step in steps)
    return WindowSolution(
        model=window.model_copy(update={"distance_mm": distance}),
        heights_mm=measured,
        errors_mm=errors,
        height_std_mm=height_std,
        slopes=slopes,
        std_mm=std,
        scatter_std_mm=scatter_std,
        per_height=per_height,
        per_index=per_index,
        uncertainty_mm=math.hypot(
            scatter_std if std is None else std, per_height * height_std_mm, per_index * index_std
        ),
        image_distances_mm=np.array(
            [_solve_single_distance(calibration, window, step, tried[usable], scan, distance) for step, scan in pairs]
        ),
        curve_mm=np.column_stack([tried, mean_error]),
        bounds_mm=(low, high),
    )


def _measure(calibration: Calibration, window: WindowModel, steps: Sequence[StepImage], distance: float) -> np.ndarray:
    """Return the height of the step in every image and its standard deviation, mm: (S, 2).

    NaN if a point of a tread cannot be reconstructed.
    """
    at_distance = window.model_copy(update={"distance_mm": float(distance)})
    heights = np.full((len(steps), 2), np.nan)
    for index in {step.medium_index for step in steps}:
        here = [number for number, step in enumerate(steps) if step.medium_index == index]
        treads = [steps[number].labels != StepFace.NEITHER for number in here]
        pixels = [steps[number].pixels[on_it] for number, on_it in zip(here, treads, strict=True)]
        points = step_profile(calibration, at_distance, np.vstack(pixels), medium_index=index)
        profiles = np.split(points, np.cumsum([len(part) for part in pixels])[:-1])
        for number, on_it, profile in zip(here, treads, profiles, strict=True):
            if np.isfinite(profile).all():
                step = steps[number]
                height = step_height(profile, step.labels[on_it], reference=step.standard.reference)
                heights[number] = height.height_mm, height.std_mm
    return heights


def _solve_single_distance(
    calibration: Calibration, window: WindowModel, step: StepImage, tried: np.ndarray, errors: np.ndarray, near: float
) -> float:
    """Return the distance near ``near`` that gives the true height in one image, else NaN.

    ``errors`` are the height errors at the tested distances.
    """
    changes = np.flatnonzero(errors[:-1] * errors[1:] <= 0)
    if not len(changes):
        return float("nan")
    left = changes[np.argmin(np.abs(tried[changes] - near))]

    def error(distance: float) -> float:
        return float(_measure(calibration, window, [step], distance)[0, 0]) - step.height_mm()

    return float(root_scalar(error, bracket=(tried[left], tried[left + 1]), method="brentq", xtol=1e-7).root)


# Limits for doubts about stated sizes. Chosen on views of the as-built thesis sensor without drawn pixels, two draws of
# each fault; judged on other draws and on drawn images of a coarse sensor.
_ROUGH = 2e-3  # least relative error: the usual error of sizes that are stated without an uncertainty
_SIGMAS = 4.0  # least error in standard uncertainties: one normal error in 16,000 is larger
_FEWEST_STEPS = 4  # images of a step for its height: fewer leave no scatter beside distance and height


def doubt_target_size(images: Sequence[TargetImage], free: CameraSolution, *, known: Uncertainty) -> list[str]:
    """Compare distances between target poses with the travel of the stage; return a warning if they contradict.

    ``free`` is the camera from the same images with one free pose per image: its lengths are those of the target's
    spacing.
    """
    placement = np.array([image.placement for image in images])
    stage, places = np.array([image.stage_mm for image in images]), free.target_poses[:, :3, 3].copy()
    squares, moved, rests, freedom = 0.0, 0.0, 0.0, 0
    for number in set(placement.tolist()):
        here = placement == number
        travel, shift = stage[here] - stage[here].mean(), places[here] - places[here].mean(axis=0)
        square, vector = float(travel @ travel), travel @ shift
        length = float(np.linalg.norm(vector))
        if square > 0 and length > 0:
            squares, moved = squares + square, moved + length
            rests += float(np.sum((shift @ vector / length - travel * length / square) ** 2))
            freedom += int(here.sum()) - 2
    if freedom < 1:
        return []
    std = {name: value / free.model.parameters()[name] for name, value in free.std().items() if name in ("f", "fx")}
    rows, columns = known.stretch_by_axis()
    parts = math.sqrt(rests / freedom / squares), max(std.values(), default=0.0), known.stage_scale, rows, columns
    error, total = moved / squares - 1, math.hypot(*parts)
    if abs(error) <= max(_ROUGH, _SIGMAS * total):
        return []
    return [
        f"distances between the target's poses differ by {100 * error:+.2f} ± {100 * total:.2f} % from the stage's "
        "positions, and all lengths with them: check the target's spacing, and the scale of the stage"
    ]


def doubt_step_height(window: WindowSolution, steps: Sequence[StepImage], *, known: Uncertainty) -> list[str]:
    """Estimate height and window distance together from step images; return a warning if the stated height is wrong.

    At different distances from the sensor, both have different effects on measured heights: at the same distance from
    the sensor, this finds nothing.
    """
    stated = np.array([step.height_mm() for step in steps])
    if len(steps) < _FEWEST_STEPS:
        return []
    design = np.column_stack([window.slopes, -stated])
    found = np.linalg.lstsq(design, -window.errors_mm, rcond=None)[0]
    rest = window.errors_mm + design @ found
    variance = max(float(rest @ rest) / (len(steps) - 2), float(np.mean(window.height_std_mm**2)))
    spread = np.linalg.svd(design / np.linalg.norm(design, axis=0), compute_uv=False)
    if spread[-1] < 1e-6 * spread[0]:
        return []
    std = math.sqrt(variance * np.linalg.inv(design.T @ design)[1, 1])
    total = math.hypot(std, *(step.height_std_mm(known) / step.height_mm() for step in steps[:1]))
    if abs(found[1]) <= max(_ROUGH, _SIGMAS * total):
        return []
    return [
        f"the step fits best with a height {100 * found[1]:+.2f} ± {100 * total:.2f} % from the stated one, and a "
        f"window {window.model.distance_mm + found[0]:.1f} mm from the pupil, not {window.model.distance_mm:.1f} mm: "
        "check the step's height, the medium, and the target's spacing"
    ]
