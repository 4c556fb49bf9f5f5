"""Stripes on a step standard as evidence: which tread each point lies on, and where the estimate starts."""

import numpy as np

from uwlts.calibration.joint.gathering import Gathered
from uwlts.calibration.joint.observations import StepProfileEvidence
from uwlts.calibration.joint.parameters import Parameters, Prior
from uwlts.calibration.model import Calibration, WindowModel
from uwlts.calibration.parameter_keys import StepHeight
from uwlts.calibration.procedure import step_image
from uwlts.errors import CalibrationError, EvaluationError
from uwlts.metrology.step_faces import StepFace


def step_profiles(
    gathered: Gathered, start: Calibration, window: WindowModel | None
) -> tuple[list[tuple[StepProfileEvidence, Prior]], list[str]]:
    """Evidence of every step image with what is known of its height, by a calibration nearly as sought; warnings."""
    transform = start.object_transform()
    usual = gathered.sensor.uncertainty.step_height_mm
    found, warnings = [], []
    for number, (step, view) in enumerate(gathered.steps):
        try:
            image = step_image(start, window, step)
        except EvaluationError as error:
            warnings.append(f"{step.source}: left out, {error}")
            continue
        on_tread = image.labels != StepFace.NEITHER
        height, stated = step.standard.height_mm, step.standard.height_uncertainty_mm
        evidence = StepProfileEvidence(
            view=view, pixels=image.pixels[on_tread], upper=image.labels[on_tread] == StepFace.UPPER,
            upward=-transform[:3, 2], along=transform[:3, 1],
            across=1 if gathered.sensor.camera.stripe_along == "width" else 0,
            height=StepHeight(height), image=number,
        )  # fmt: skip
        found.append((evidence, Prior(height, stated / 2 if stated else usual)))
    return found, warnings


def line_start(evidence: StepProfileEvidence, parameters: Parameters, global_values: np.ndarray) -> np.ndarray:
    """The lower tread's line (2,) at the parameters' start."""
    points = parameters.on_sheet(global_values, evidence.view, evidence.pixels)
    if points is None:
        raise CalibrationError("the stripe on a step meets no sheet at the calibration's start: check the window")
    up = evidence.upward @ points.points - evidence.upper * parameters.value(global_values, evidence.height)
    along = evidence.along @ points.points
    slope, offset = np.polyfit(along, up, 1)
    return np.array([-slope, offset / np.hypot(1.0, slope)])
