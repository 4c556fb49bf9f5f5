"""Figures of G. S. de Matos's thesis (UFSC 2017) that follow from several captures: Tables 4 and 9, and Figure 67."""

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple

import numpy as np
from scipy import special

from uwlts.calibration.capture_evidence import step_evidence
from uwlts.calibration.sequential.step_images import StepImage, label_step, solve_window
from uwlts.errors import CalibrationError
from uwlts.evaluation.artefact_figures import evaluate_spheres
from uwlts.model.artefacts import SphereStandard
from uwlts.model.calibration import AnyCalibration, Calibration, WindowModel
from uwlts.model.sensor import Medium
from uwlts.model.stripe import stack_pixels
from uwlts.optics.nominal import nominal_calibration
from uwlts.optics.triangulation import reconstruct_pixels
from uwlts.reconstruction.reconstruct import reconstruct, reconstruct_stripes
from uwlts.shapes.sphere import Sphere
from uwlts.storage.calibration_file import resolve_calibration
from uwlts.storage.capture import Capture, open_captures
from uwlts.storage.figure_table import FigureTable, MeasuredFigure
from uwlts.stripe import find_stripes

UNIFORM = 1 / math.sqrt(3)  # standard deviation of a uniform distribution divided by its half-width (GUM 4.3.7)


class UncertaintySource(NamedTuple):
    """Standard uncertainty, its degrees of freedom (infinite if exactly known), and a correction to be added."""

    std: float
    degrees_of_freedom: float = math.inf
    correction: float = 0.0


def combine(sources: Sequence[UncertaintySource], *, coverage_probability: float = 0.95) -> dict[str, float]:
    """Combine uncorrelated sources (GUM Eq. 10) to the figures of their budget, in the unit of the sources.

    ``degrees_of_freedom`` are effective, from the Welch-Satterthwaite formula (GUM G.4.1, Eq. G.2b), not rounded.
    ``expanded`` is the combined uncertainty times Student's t for them, truncated to an integer (note 1).
    ``correction`` is the sum of the sources' corrections. ``largest_error`` applies to an uncorrected result: its
    absolute correction plus the expanded uncertainty (thesis section 4.8.5; the GUM would correct).

    The thesis's U of 0.37 mm (Table 9) has a coverage of 95.45 %, the probability of two normal standard deviations; 95
    % gives 0.36.
    """
    total = math.hypot(*(source.std for source in sources))
    spread = sum((source.std / total) ** 4 / source.degrees_of_freedom for source in sources)
    freedom = 1 / spread if spread > 0 else math.inf
    # Rounding errors must not turn 5 degrees of freedom into 4.
    whole = math.floor(freedom * (1 + 1e-9)) if math.isfinite(freedom) else math.inf
    expanded = float(special.stdtrit(whole, (1 + coverage_probability) / 2)) * total
    correction = sum(source.correction for source in sources)
    figures = {"degrees_of_freedom": freedom, "expanded": expanded, "correction": correction}
    return figures | {"largest_error": abs(correction) + expanded}


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
    used = evaluation.labels >= 0
    lines = int(stripes.line.max()) + 1
    kept = np.flatnonzero(np.isin(lines * stripes.frame + stripes.line, (lines * scan.frame + scan.line)[used]))
    line, centre = stripes.line[kept], stripes.centre_px[kept]
    return SphereScan(
        pixels=stack_pixels(line, centre, stripe_along=capture.header.sensor.camera.stripe_along),
        stage_mm=capture.stage_mm[stripes.frame[kept]],
        sphere=evaluation.labels[used],
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
_STANDARD_EXPANDED_MM = 0.004  # expanded uncertainty of its calibration, k = 2 (thesis, Table 9)
_SUBPIXEL = 0.1  # effective resolution in px, from the thesis


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
    sources = {name: UncertaintySource(UNIFORM * half) for name, half in half_widths.items()} | {
        "standard": UncertaintySource(_STANDARD_EXPANDED_MM / 2),
        "SSE": UncertaintySource(scatter, len(errors) - 1, correction),
        "PE": UncertaintySource(deviation_mm),
    }
    return {name: source.std for name, source in sources.items()} | combine(list(sources.values()))


def mm_per_px(calibration: Calibration, medium_index: float) -> float:
    """Return the change of Z per pixel across the stripe at the sheet's intersection with the camera's axis, mm."""
    camera = calibration.camera
    across = np.array([0.0, 0.5] if calibration.stripe_along == "width" else [0.5, 0.0])
    pixels = np.array([camera.cx_px, camera.cy_px]) + np.array([-across, across])
    points = reconstruct_pixels(calibration, pixels, medium_index=medium_index).points_mm
    return float(abs(points[1, 2] - points[0, 2]))


BUDGET = "budget of the sphere spacing"  # name of the budget's figures in the column ``scan``
_LOW_PASS = {"low_pass": 0.4}  # settings of the thesis's stripe detection


def evaluate_thesis(
    calibration: Calibration | str | Path,
    *,
    step: Sequence[Capture | str | Path] = (),
    spheres: Sequence[Capture | str | Path] = (),
    line: Sequence[Capture | str | Path] = (),
) -> FigureTable:
    """Measure figures of the thesis that follow from several captures: Tables 4 and 9, and Figure 67.

    Parameters
    ----------
    calibration : Calibration or path
        Sequential calibration with a window.
    step : sequence of Capture or path, optional
        Captures of the step standard: the window distance from every image, from those of each capture, and from all,
        and with each the mean sphere spacing error (Table 4).
    spheres : sequence of Capture or path, optional
        Scans of two spheres in the medium of use. Two or more give the uncertainty budget of their spacing (Table 9).
    line : sequence of Capture or path, optional
        Captures of one profile: the length of the stripe along Y with the calibration of the description (Figure 67).

    Returns
    -------
    FigureTable
        The figures by the names of captures and images.

    Raises
    ------
    CaptureError, EvaluationError
        A file cannot be read, or a capture does not show steps or spheres.
    CalibrationError
        The calibration has no window, or does not fit a capture.
    """
    known = resolve_calibration(calibration)
    if not isinstance(known, Calibration):
        raise CalibrationError("polynomials have no window: give a calibration of camera, window and sheet")
    method = "two refractions" if window_of(known).refractions == 2 else "one refraction"
    with open_captures(step) as steps, open_captures(spheres) as standards, open_captures(line) as lines:
        captures = [*steps, *standards, *lines]
        campaign = captures[0].path.resolve().parent.name if captures else ""
        return FigureTable(
            rows=tuple(
                MeasuredFigure(campaign=campaign, scan=scan, method=method, figure=figure, measured_mm=value)
                for scan, figure, value in _measure(known, steps, standards, lines)
            )
        )


def _measure(
    calibration: Calibration, steps: Sequence[Capture], spheres: Sequence[Capture], lines: Sequence[Capture]
) -> Iterator[tuple[str, str, float]]:
    """Yield scan, name and value of each figure."""
    scans = [sphere_scan(capture, calibration) for capture in spheres]
    for name, distance_mm, error_mm in window_choices(steps, calibration, scans) if steps else ():
        yield name, "window distance", distance_mm
        if scans:
            yield name, "mean SSE", error_mm
    if len(scans) > 1:
        deviation = max(_find_spread_mm(capture, calibration) for capture in spheres)
        budget = spacing_budget(calibration, scans, spheres[0].header.medium, deviation_mm=deviation)
        yield from ((BUDGET, name, value) for name, value in budget.items() if math.isfinite(value))
    for capture in lines:
        header = capture.header
        cloud = reconstruct(capture, nominal_calibration(header.sensor, header.medium))
        yield capture.path.stem, "line length", float(np.ptp(cloud.points_mm[:, 1]))


def _find_spread_mm(capture: Capture, calibration: Calibration) -> float:
    """Return the largest standard deviation of points about the spheres of a scan, with the thesis's stripes."""
    stripes = find_stripes(capture, options=_LOW_PASS)
    standard = SphereStandard.model_validate(capture.header.artefact)
    return evaluate_spheres(reconstruct_stripes(capture, stripes, calibration).points_mm, standard).std_mm
