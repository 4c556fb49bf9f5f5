"""Figures of G. S. de Matos's thesis (UFSC 2017) that follow from several captures: Tables 4 and 9, and Figure 67."""

import math
from collections.abc import Iterator, Sequence
from pathlib import Path

import numpy as np

from uwlts.errors import CalibrationError
from uwlts.evaluation.spheres import evaluate_spheres
from uwlts.model.artefacts import SphereStandard
from uwlts.model.calibration import Calibration
from uwlts.optics.nominal import nominal_calibration
from uwlts.reconstruction.reconstruct import reconstruct, reconstruct_stripes
from uwlts.storage.calibration_file import resolve_calibration
from uwlts.storage.capture import Capture, open_captures
from uwlts.storage.figure_table import FigureTable, MeasuredFigure
from uwlts.stripe import find_stripes
from uwlts.thesis.sphere_spacing import spacing_budget, sphere_scan, window_choices, window_of

BUDGET = "budget of the sphere spacing"
"""Name of the budget's figures in the column ``scan``."""
_LOW_PASS = {"low_pass": 0.4}
"""Settings of the thesis's stripe detection."""


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
        deviation = max(_spread_mm(capture, calibration) for capture in spheres)
        budget = spacing_budget(calibration, scans, spheres[0].header.medium, deviation_mm=deviation)
        yield from ((BUDGET, name, value) for name, value in budget.items() if math.isfinite(value))
    for capture in lines:
        header = capture.header
        cloud = reconstruct(capture, nominal_calibration(header.sensor, header.medium))
        yield capture.path.stem, "line length", float(np.ptp(cloud.points_mm[:, 1]))


def _spread_mm(capture: Capture, calibration: Calibration) -> float:
    """Return the largest standard deviation of points about the spheres of a scan, with the thesis's stripes."""
    stripes = find_stripes(capture, options=_LOW_PASS)
    standard = SphereStandard.model_validate(capture.header.artefact)
    return evaluate_spheres(reconstruct_stripes(capture, stripes, calibration).points_mm, standard).std_mm
