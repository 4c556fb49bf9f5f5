"""Stripes on the sphere standard, sorted by sphere once, so that many calibrations can be tried on them quickly."""

from dataclasses import dataclass

import numpy as np

from uwlts.calibration.any_calibration import AnyCalibration
from uwlts.capture import Capture
from uwlts.metrology.artefact_descriptions import SphereStandard
from uwlts.metrology.sphere_evaluation import evaluate_spheres
from uwlts.metrology.sphere_fit import fit_sphere
from uwlts.scan import reconstruct_stripes
from uwlts.stripe import find_stripes


@dataclass(frozen=True, eq=False)
class SphereScan:
    """The stripe on two spheres in one scan.

    Attributes
    ----------
    placement : str
    pixels : (N, 2)
    stage_mm : (N,)
    sphere : (N,) int
        Sphere 0 or 1 on which each point lies.
    stage_direction : (3,)
    medium_index : float
    spacing_mm : float
        Calibrated distance of the centres.
    """

    placement: str
    pixels: np.ndarray
    stage_mm: np.ndarray
    sphere: np.ndarray
    stage_direction: np.ndarray
    medium_index: float
    spacing_mm: float

    def spacing_error(self, points: np.ndarray) -> float:
        """Sphere spacing error of points (N, 3) of these stripes, mm."""
        first, second = (fit_sphere(points[self.sphere == number]).centre_mm for number in (0, 1))
        return float(np.linalg.norm(second - first)) - self.spacing_mm


def sphere_scan(capture: Capture, calibration: AnyCalibration, *, placement: str) -> SphereScan:
    """Find the stripes of a scan of two spheres and tell by a calibration on which sphere each point lies.

    Raises
    ------
    EvaluationError
        The scan does not show the spheres.
    """
    standard = SphereStandard.model_validate(capture.header.artefact)
    stripes = find_stripes(capture)
    scan = reconstruct_stripes(capture, stripes, calibration)
    evaluation = evaluate_spheres(scan.cloud.points_mm, standard)
    centres = np.array([sphere.centre_mm for sphere in evaluation.spheres])
    radii = np.array(standard.diameters_mm) / 2
    used = np.isfinite(evaluation.deviation_mm)
    away = np.abs(np.linalg.norm(scan.cloud.points_mm[used, None] - centres, axis=2) - radii)
    kept = scan.stripe[used]
    line, centre = stripes.line[kept], stripes.centre_px[kept]
    along_width = capture.header.sensor.camera.stripe_along == "width"
    return SphereScan(
        placement=placement,
        pixels=np.stack((line, centre) if along_width else (centre, line), axis=1).astype(float),
        stage_mm=capture.stage_mm[stripes.frame[kept]],
        sphere=np.argmin(away, axis=1),
        stage_direction=np.array(capture.header.stage_direction),
        medium_index=capture.header.medium.refractive_index(capture.header.sensor.laser.wavelength_nm),
        spacing_mm=standard.spacings_mm[0],
    )
