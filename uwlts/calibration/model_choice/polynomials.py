"""Polynomials fitted to the stripes of all images but those held out, and by how much they miss in these."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.polynomial import legendre

from uwlts.calibration.joint.noise import stray_limit
from uwlts.calibration.joint.observations import STRIPE
from uwlts.calibration.joint.start import Series
from uwlts.calibration.line_polynomials import fit_line_polynomials
from uwlts.calibration.model_choice.held_out import Image
from uwlts.calibration.model_choice.prediction import Prediction
from uwlts.calibration.model_choice.scores import rms_of_images
from uwlts.calibration.polynomial_evidence import object_coordinates, stripes_on_plate
from uwlts.capture import CaptureHeader

DEGREE = 6


@dataclass(frozen=True)
class PolynomialScore:
    """Root mean square misses in mm of stripes on the target, inside the calibrated volume.

    Polynomials have no camera, so that only the object can tell; outside they do not measure.

    Attributes
    ----------
    medium : str
    images : int
    all_mm, std_mm : float
        By polynomials, with the standard error.
    model_mm, model_std_mm : float
        In the same images by the model they are compared with.
    """

    medium: str
    images: int
    all_mm: float
    std_mm: float
    model_mm: float
    model_std_mm: float


def polynomial_score(
    series: Series, header: CaptureHeader, images: Sequence[Image], model: Prediction
) -> PolynomialScore | None:
    """Score of polynomials in the images of a series that are held out; None where there is no such image.

    Raises
    ------
    CalibrationError
        The series is not fit for polynomials.
    """
    if not images:
        return None
    stripes, _, _ = stripes_on_plate(series.found, header, DEGREE)
    depth_mm, _ = object_coordinates(stripes, header)
    held = np.isin(stripes.pose, [image for _, image in images])
    fit = fit_line_polynomials(stripes.lines[~held], stripes.centres_px[~held], depth_mm[~held], degree=DEGREE)
    low, high = fit.range
    rows, x = stripes.lines[held] - fit.first_line, stripes.centres_px[held]
    known = (rows >= 0) & (rows < len(fit.coefficients)) & (x >= low) & (x <= high)
    argument = (2 * x[known] - low - high) / (high - low)
    found = legendre.legval(argument, fit.coefficients[rows[known]].T, tensor=False)
    off, pose = found - depth_mm[held][known], stripes.pose[held][known]
    by_model = [m.mm for m in model.misses if m.image in images and m.kind == STRIPE]
    all_mm, std_mm = _robust_rms([off[pose == image] for image in np.unique(pose)])
    model_mm, model_std_mm = _robust_rms(by_model)
    return PolynomialScore(header.medium_name, len(images), all_mm, std_mm, model_mm, model_std_mm)


def _robust_rms(misses: Sequence[np.ndarray]) -> tuple[float, float]:
    """Root mean square of the misses in several images, without strays, and its standard error."""
    limit = stray_limit(np.concatenate(misses))
    kept = [off[np.abs(off) <= limit] for off in misses]
    squares, counts = np.array([np.sum(off**2) for off in kept]), np.array([len(off) for off in kept])
    return rms_of_images(squares, counts)
