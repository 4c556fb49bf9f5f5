"""Uncertainty of the sphere spacing by propagation of distributions through the whole pipeline (JCGM 101:2008).

Each trial draws every input of the calibration and of the measurement from its known distribution. It calibrates
camera, sheet and window again, reconstructs the spheres and measures their spacing. The inputs are perturbed about the
observed values: circle centres, stripes, stage positions, the target's lattice, its tilt and bow, the step's height,
the window's tilt and the water's index. The sheet's bow is not included: the model has a plane.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from itertools import count

import numpy as np

from uwlts.calibration.capture_evidence import AirEvidence, StepEvidence
from uwlts.calibration.sequential.sequential_calibration import CalibrationOptions, CalibrationResult, Evidence, solve
from uwlts.errors import CalibrationError, EvaluationError, RangeError
from uwlts.model.sensor import Medium
from uwlts.optics.camera import project
from uwlts.runtime.progress import ProgressListener, ignore_progress
from uwlts.runtime.workers import run_jobs
from uwlts.shapes.flat import perpendicular_to
from uwlts.thesis.sphere_spacing import SphereScan, spacing_error

COVERAGE = 0.95  # of the stated intervals
LEAST_TRIALS = 20  # of 20, a 95 % interval leaves one out


@dataclass(frozen=True, eq=False)
class Propagated:
    """Trials of the sphere spacing error of one scan, mm, and the shortest 95 % interval.

    ``observed_mm`` is the error with the unperturbed calibration, ``trials_mm`` (T,) those of the trials.
    """

    placement: str
    observed_mm: float
    trials_mm: np.ndarray

    def std_mm(self) -> float:
        """Return the standard uncertainty of the spacing."""
        return float(np.std(self.trials_mm, ddof=1))

    def interval_mm(self) -> tuple[float, float]:
        """Return the shortest interval of spacing errors that contains 95 % of the trials (JCGM 101, 7.7.4)."""
        ordered = np.sort(self.trials_mm)
        held = int(np.ceil(COVERAGE * len(ordered)))
        widths = ordered[held - 1 :] - ordered[: len(ordered) - held + 1]
        first = int(np.argmin(widths))
        return float(ordered[first]), float(ordered[first + held - 1])

    def contains_truth(self) -> bool:
        """Return whether the interval contains an error of zero, that is, the calibrated spacing."""
        low, high = self.interval_mm()
        return low <= 0 <= high


def propagate(
    evidence: Evidence,
    scans: Sequence[SphereScan],
    medium: Medium,
    knowledge: Mapping[str, float],
    *,
    options: CalibrationOptions,
    trials: int,
    seed: int = 0,
    workers: int | None = None,
    progress: ProgressListener = ignore_progress,
) -> list[Propagated]:
    """Propagate the uncertainties of the inputs to the sphere spacing of every scan.

    ``knowledge`` holds standard deviations and half widths by the names of the campaign's imperfections; missing ones
    are 0. At least 20 trials are needed.

    Raises RangeError if there are fewer than 20 trials; CalibrationError if the unperturbed evidence gives no
    calibration, or more than a tenth of the trials fail.
    """
    if trials < LEAST_TRIALS:
        raise RangeError(f"{trials} trials give no 95 % interval; expected at least {LEAST_TRIALS}")
    start = solve(evidence, options=options)
    # Offsets of circle centres barely change between trials; they are corrected once.
    if start.camera.bias_px is not None:
        images = [
            replace(image, pixels=image.pixels - bias)
            for image, bias in zip(evidence.air.images, start.camera.bias_px, strict=True)
        ]
        evidence = replace(evidence, air=replace(evidence.air, images=images))
        options = replace(options, correct_circles=False)
    trial, numbers = partial(_trial, _Draw(evidence, start, medium, knowledge), scans, options, seed), count(1)
    made = run_jobs(trial, range(trials), workers=workers, on_message=lambda _: progress(next(numbers), trials))
    spacing = np.array([errors for errors in made if errors is not None])
    if trials - len(spacing) > trials // 10:
        raise CalibrationError(f"{trials - len(spacing)} of {trials} trials give no calibration or no spheres")
    return [
        Propagated(scan.placement, spacing_error(start.calibration, scan), spacing[:, number])
        for number, scan in enumerate(scans)
    ]


def _trial(
    draw: "_Draw",
    scans: Sequence[SphereScan],
    options: CalibrationOptions,
    seed: int,
    number: int,
    send: Callable[[None], None],
) -> list[float] | None:
    """Return sphere spacing errors of one trial; None if its inputs give no calibration or no spheres."""
    send(None)
    rng = np.random.default_rng([seed, number])
    try:
        calibration = solve(draw.evidence(rng), options=options, start=draw.start.camera).calibration
        index = draw.index(rng)
        lead, angles = draw.scan(rng)
        errors = []
        for scan in scans:
            pixels, direction = draw.stripe(scan.pixels, rng), _rotate_direction(scan.stage_direction, angles)
            drawn = replace(scan, pixels=pixels, stage_mm=scan.stage_mm * (1 + lead), stage_direction=direction)
            errors.append(spacing_error(calibration, drawn, medium_index=index))
        return errors
    except (CalibrationError, EvaluationError):
        return None


class _Draw:
    """Random inputs about the observed ones."""

    def __init__(self, evidence: Evidence, start: CalibrationResult, medium: Medium, knowledge: Mapping[str, float]):
        self.start, self._evidence, self._medium = start, evidence, medium
        self._known = {name: float(value) for name, value in knowledge.items()}
        self._across = 1 if start.calibration.stripe_along == "width" else 0
        self._stripe_px = _stripe_noise_px(start, self._across)
        # entrance pupil in the target's frame, for every image
        self._pupils = [-pose[:3, :3].T @ pose[:3, 3] for pose in start.camera.target_poses]

    def _std(self, name: str) -> float:
        return self._known.get(name, 0.0)

    def evidence(self, rng: np.random.Generator) -> Evidence:
        """Return the calibration's evidence with random inputs."""
        air, steps = self._air(self._evidence.air, rng), self._steps(rng)
        window = self._evidence.window
        x, y = (self._std("window_tilt_std_deg") * rng.standard_normal(2)).tolist()
        if window is not None:
            tilts = {"tilt_x_deg": window.tilt_x_deg + x, "tilt_y_deg": window.tilt_y_deg + y}
            window = window.model_copy(update=tilts)
        return replace(self._evidence, air=air, steps=steps, window=window)

    def _air(self, air: AirEvidence, rng: np.random.Generator) -> AirEvidence:
        # The target may be rotated relative to the stage's travel, and the travel relative to the laser's axis.
        turn = np.hypot(self._std("target_tilt_std_deg"), self._std("stage_misalignment_std_deg"))
        tilt = np.radians(turn) * rng.standard_normal(2)
        lead = self._std("stage_lead_std") * rng.standard_normal()
        bow = self._std("target_bow_std_mm") * rng.standard_normal()
        shifts: dict[tuple[float, ...], np.ndarray] = {}
        farthest = max(float(np.linalg.norm(image.points_mm, axis=1).max()) for image in air.images)
        middle = np.mean([image.stage_mm for image in air.images])
        images = []
        circle_mm = self._std("circle_centre_std_mm")
        for image, pupil in zip(air.images, self._pupils, strict=True):
            places = map(tuple, image.points_mm.tolist())
            drawn = (circle_mm * np.append(rng.standard_normal(2), 0.0) for _ in image.points_mm)
            printed = np.array([shifts.setdefault(place, shift) for place, shift in zip(places, drawn, strict=True)])
            # A target that is not perpendicular to the travel moves sideways on itself. Points above the plane of the
            # target are seen where their rays meet the plane.
            sideways = np.append(tilt, 0.0) * (image.stage_mm - middle)
            height = bow * (np.linalg.norm(image.points_mm, axis=1, keepdims=True) / farthest) ** 2
            out = height * (image.points_mm - pupil) / pupil[2] * (1.0, 1.0, 0.0)
            stage = image.stage_mm + lead * (image.stage_mm - middle)
            pixels = image.pixels + self.start.camera.sigma_px * rng.standard_normal(image.pixels.shape)
            stage += self._std("stage_position_std_mm") * rng.standard_normal()
            points = image.points_mm + printed + sideways + out
            images.append(replace(image, points_mm=points, pixels=pixels, stage_mm=stage))
        return replace(air, images=images, stripes=[self.stripe(pixels, rng) for pixels in air.stripes])

    def _steps(self, rng: np.random.Generator) -> list[StepEvidence]:
        higher = self._std("step_height_half_width_mm") * rng.uniform(-1, 1)
        index = self.index(rng)
        steps = []
        for step in self._evidence.steps:
            standard = step.standard.model_copy(update={"height_mm": step.standard.height_mm + higher})
            pixels = self.stripe(step.pixels, rng)
            steps.append(replace(step, pixels=pixels, standard=standard, medium_index=index))
        return steps

    def index(self, rng: np.random.Generator) -> float:
        """Return the index of the water at a random temperature."""
        warmer = self._std("temperature_half_width_c") * rng.uniform(-1, 1)
        return self._medium.warmer_by(warmer).refractive_index(self.start.calibration.wavelength_nm)

    def scan(self, rng: np.random.Generator) -> tuple[float, np.ndarray]:
        """Return a random relative error of the stage's lead, and rotations of its travel about two axes, rad."""
        lead = self._std("stage_lead_std") * rng.standard_normal()
        return lead, np.radians(self._std("stage_misalignment_std_deg")) * rng.standard_normal(2)

    def stripe(self, pixels: np.ndarray, rng: np.random.Generator) -> np.ndarray:
        """Add the noise of stripes on the target, across the stripe, to stripe pixels (N, 2)."""
        noise = np.zeros_like(pixels)
        noise[:, self._across] = self._stripe_px * rng.standard_normal(len(pixels))
        return pixels + noise


def _stripe_noise_px(start: CalibrationResult, across: int) -> float:
    """Return the root mean square distance of stripe points on the target from the sheet, in px across the stripe."""
    used, normal = start.sheet.used, np.array(start.sheet.model.normal)
    points = start.stripe_points.points_mm[used]
    faces = start.camera.target_poses[start.stripe_points.image[used], :3, 2]
    # An error of a stripe centre moves the point on the target, perpendicular to the sheet's line on it.
    along = normal - (faces @ normal)[:, None] * faces
    moves = along * (start.sheet.residuals_mm[used] / (along @ normal))[:, None]
    apart = project(start.camera.model, points) - project(start.camera.model, points - moves)
    return float(np.sqrt(np.mean(apart[:, across] ** 2)))


def _rotate_direction(direction: np.ndarray, angles: np.ndarray) -> np.ndarray:
    """Rotate a unit direction (3,) by two small angles about axes perpendicular to it."""
    first, second = perpendicular_to(direction)
    turned = direction + angles[0] * first + angles[1] * second
    return turned / np.linalg.norm(turned)
