"""Images of a step standard: the faces in each, and the standard's rotation from facing the laser."""

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import groupby

import numpy as np

from uwlts.calibration.capture_evidence import StepEvidence
from uwlts.errors import EvaluationError
from uwlts.model.calibration import Calibration, WindowModel
from uwlts.model.sensor import Uncertainty
from uwlts.optics.triangulation import points_on_sheet
from uwlts.shapes.flat import Line, Plane
from uwlts.shapes.step import StepFace, label_step_faces

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
    seen = points_on_sheet(calibration.model_copy(update={"window": window}), pixels, medium_index=medium_index)
    object_from_camera = np.linalg.inv(calibration.object_transform())
    return seen.points_mm @ object_from_camera[1:3, :3].T + object_from_camera[1:3, 3]


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
        said = "the standard does not face the laser: it is rotated by"
        if self.about_stripe is None:
            return (
                f"{said} {np.degrees(angle):.1f}° about the sheet's normal. This does not change the height. But with "
                f"the same rotation about the stripe, which these images do not show, it {higher}: make it face "
                "the laser, or let the stage move the sensor across the stripe between three or more images"
            )
        return (
            f"{said} {np.degrees(angle):.1f} +- {np.degrees(self.std):.1f}° about the stripe, so that it {higher}. "
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
            stated = standard.height_uncertainty_mm
            std_mm = stated / 2 if stated else uncertainty.step_height_mm
            if doubt := turn.doubt(height_mm=standard.height_mm, std_mm=std_mm):
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
