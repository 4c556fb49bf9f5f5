"""Sphere spacing errors of scans, their dependence on step images (Table 4), and their budget (Table 9)."""

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np

from uwlts.calibration.capture_evidence import step_evidence
from uwlts.calibration.sequential.step_images import StepImage, label_step
from uwlts.calibration.sequential.window_distance import solve_window
from uwlts.errors import CalibrationError
from uwlts.evaluation.spheres import evaluate_spheres
from uwlts.model.any_calibration import AnyCalibration
from uwlts.model.artefacts import SphereStandard
from uwlts.model.calibration import Calibration, WindowModel
from uwlts.model.sensor import Medium
from uwlts.model.stripe import stack_pixels
from uwlts.optics.triangulation import reconstruct_pixels
from uwlts.reconstruction.reconstruct import reconstruct_stripes
from uwlts.shapes.sphere import Sphere
from uwlts.storage.capture import Capture
from uwlts.stripe import find_stripes
from uwlts.thesis.uncertainty_budget import UNIFORM, UncertaintySource, combine


@dataclass(frozen=True, eq=False)
class SphereScan:
    """Stripe on two spheres in one scan: ``pixels`` (N, 2), and the ``sphere`` (N,), 0 or 1, of each.

    ``stage_mm`` (N,) are positions of the stage along ``stage_direction`` (3,), ``spacing_mm`` is the calibrated
    distance of the centres.
    """

    pixels: np.ndarray
    stage_mm: np.ndarray
    sphere: np.ndarray
    stage_direction: np.ndarray
    medium_index: float
    spacing_mm: float

    def spacing_error(self, points: np.ndarray) -> float:
        """Return the sphere spacing error of points (N, 3) of these stripes, mm."""
        first, second = (Sphere.fit(points[self.sphere == number]).centre_mm for number in (0, 1))
        return float(np.linalg.norm(second - first)) - self.spacing_mm


def sphere_scan(capture: Capture, calibration: AnyCalibration) -> SphereScan:
    """Assign the stripes of a scan to two spheres, with a calibration.

    Raises EvaluationError if the scan shows no spheres.
    """
    standard = SphereStandard.model_validate(capture.header.artefact)
    stripes = find_stripes(capture)
    scan = reconstruct_stripes(capture, stripes, calibration)
    evaluation = evaluate_spheres(scan.points_mm, standard)
    centres = np.array([sphere.centre_mm for sphere in evaluation.spheres])
    radii = np.array(standard.diameters_mm) / 2
    used = np.isfinite(evaluation.deviation_mm)
    away = np.abs(np.linalg.norm(scan.points_mm[used, None] - centres, axis=2) - radii)
    lines = int(stripes.line.max()) + 1
    kept = np.flatnonzero(np.isin(lines * stripes.frame + stripes.line, (lines * scan.frame + scan.line)[used]))
    line, centre = stripes.line[kept], stripes.centre_px[kept]
    return SphereScan(
        pixels=stack_pixels(line, centre, stripe_along=capture.header.sensor.camera.stripe_along),
        stage_mm=capture.stage_mm[stripes.frame[kept]],
        sphere=np.argmin(away, axis=1),
        stage_direction=np.array(capture.header.stage_direction),
        medium_index=capture.header.medium.refractive_index(capture.header.sensor.laser.wavelength_nm),
        spacing_mm=standard.spacings_mm[0],
    )


def window_of(calibration: Calibration) -> WindowModel:
    """Return the window of a calibration; CalibrationError if it has none."""
    if calibration.window is None:
        raise CalibrationError("the calibration has no window: calibrate with step images")
    return calibration.window


def mean_spacing_error(calibration: Calibration, scans: Sequence[SphereScan]) -> float:
    """Return the mean absolute sphere spacing error of scans in mm."""
    return float(np.mean([abs(spacing_error(calibration, scan)) for scan in scans]))


def spacing_error(calibration: Calibration, scan: SphereScan, *, medium_index: float | None = None) -> float:
    """Return the sphere spacing error of a scan in mm, optionally for another medium index."""
    points = reconstruct_pixels(
        calibration,
        scan.pixels,
        medium_index=medium_index or scan.medium_index,
        stage_mm=scan.stage_mm,
        stage_direction=scan.stage_direction,
    )
    return scan.spacing_error(points.points_mm)


def window_choices(
    steps: Sequence[Capture], calibration: Calibration, scans: Sequence[SphereScan]
) -> Iterator[tuple[str, float, float]]:
    """Yield the window distance from every step image, from those of each capture, and from all.

    An item has the name of the images, the distance, and the mean absolute sphere spacing error of the scans with it,
    mm. Images that determine no distance are left out. Raises CaptureError if a capture shows no step; CalibrationError
    if the calibration has no window.
    """
    nominal = window_of(calibration)
    images: dict[str, list[StepImage]] = {}
    for capture in steps:
        camera, laser = capture.header.sensor.camera, capture.header.sensor.laser
        described = WindowModel.from_description(camera.window, laser.wavelength_nm, refractions=nominal.refractions)
        images[capture.path.stem] = [label_step(calibration, described, step) for step in step_evidence([capture])[0]]
    subsets = {f"{name} {number}": [image] for name in images for number, image in enumerate(images[name], start=1)}
    subsets |= images | {"all step images": [image for name in images for image in images[name]]}
    for name, chosen in subsets.items():
        try:
            window = solve_window(calibration, nominal, chosen).model
        except CalibrationError:
            continue
        moved = calibration.model_copy(update={"window": window})
        yield name, window.distance_mm, mean_spacing_error(moved, scans) if scans else math.nan


TEMPERATURE_HALF_WIDTH_C = 5.0  # the thesis's 5 K
_EXPANSION_PER_K = 22.2e-6
"""Thermal expansion of the standard: the thesis's 0.011 mm for 5 K and 99.18 mm, as for aluminium."""
_STANDARD_EXPANDED_MM = 0.004
"""Expanded uncertainty of its calibration, k = 2 (thesis, Table 9)."""
_SUBPIXEL = 0.1
"""Effective resolution in px, from the thesis."""


def spacing_budget(
    calibration: Calibration, scans: Sequence[SphereScan], medium: Medium, *, deviation_mm: float
) -> dict[str, float]:
    """Return the budget of the sphere spacing with the thesis's sources: standard uncertainties and results, mm.

    Index: change of the spacing if the index changes as for 5 degC, with an unchanged calibration; mean over the scans.
    Resolution: a tenth of the change of Z per pixel at the stand-off. SSE: standard deviation of the scans' spacing
    errors (at least two), with their mean as the correction. ``deviation_mm``, the largest standard deviation of the
    points about the spheres, is used as the thesis's PE.
    """
    errors = np.array([spacing_error(calibration, scan) for scan in scans])
    warm, cold = (
        medium.warmer_by(kelvin).refractive_index(calibration.wavelength_nm)
        for kelvin in (TEMPERATURE_HALF_WIDTH_C, -TEMPERATURE_HALF_WIDTH_C)
    )
    changes = [[spacing_error(calibration, scan, medium_index=index) for scan in scans] for index in (warm, cold)]
    half_widths = {
        "index": float(np.mean(np.abs(np.diff(changes, axis=0)))) / 2,
        "expansion": scans[0].spacing_mm * _EXPANSION_PER_K * TEMPERATURE_HALF_WIDTH_C,
        "resolution": _SUBPIXEL * mm_per_px(calibration, scans[0].medium_index) / 2,
    }
    scatter, correction = float(np.std(errors, ddof=1)), float(np.mean(np.abs(errors)))
    certain = {name: UNIFORM * half for name, half in half_widths.items()} | {"standard": _STANDARD_EXPANDED_MM / 2}
    freedom = {"degrees_of_freedom": len(errors) - 1, "correction": correction}
    budget = combine(
        [
            *(UncertaintySource(name=name, standard_uncertainty=std) for name, std in certain.items()),
            UncertaintySource(name="SSE", standard_uncertainty=scatter, **freedom),
            UncertaintySource(name="PE", standard_uncertainty=deviation_mm),
        ]
    )
    return {source.name: source.standard_uncertainty for source in budget.sources} | {
        "degrees_of_freedom": budget.degrees_of_freedom,
        "expanded": budget.expanded_uncertainty,
        "correction": budget.correction,
        "largest_error": budget.largest_error,
    }


def mm_per_px(calibration: Calibration, medium_index: float) -> float:
    """Return the change of Z per pixel across the stripe at the sheet's intersection with the camera's axis, mm."""
    camera = calibration.camera
    across = np.array([0.0, 0.5] if calibration.stripe_along == "width" else [0.5, 0.0])
    pixels = np.array([camera.cx_px, camera.cy_px]) + np.array([-across, across])
    points = reconstruct_pixels(
        calibration, pixels, medium_index=medium_index, stage_mm=0.0, stage_direction=np.array([1.0, 0.0, 0.0])
    ).points_mm
    return float(abs(points[1, 2] - points[0, 2]))
