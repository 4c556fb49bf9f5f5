"""The thesis's uncertainty budget of the sphere spacing in water (section 4.8.5, Table 9), sensitivities computed."""

from collections.abc import Sequence

import numpy as np

from uwlts.calibration.model import Calibration
from uwlts.metrology.uncertainty_budget import Source, combine, thermal_expansion_mm
from uwlts.reconstruction import reconstruct_pixels
from uwlts.sensor import Medium
from uwlts.thesis.sphere_scan import SphereScan
from uwlts.thesis.window_study import spacing_error

TEMPERATURE_HALF_WIDTH_C = 5.0
_EXPANSION_PER_K = 22.2e-6
"""Of the standard: the thesis's 0.011 mm for 5 K over 99.18 mm, as aluminium expands."""
_STANDARD_EXPANDED_MM = 0.004
_SUBPIXEL = 0.1
"""The thesis takes a tenth of a pixel as the effective resolution."""


def spacing_budget(
    calibration: Calibration, scans: Sequence[SphereScan], medium: Medium, *, deviation_mm: float
) -> dict[str, float]:
    """Budget of the sphere spacing by the thesis's sources, as standard uncertainties and what follows from them, mm.

    Index: the change of the spacing when the index changes by what 5 degC do, the calibration left as it is; mean over
    the scans. Resolution: a tenth of what a pixel is worth along Z at the stand-off. SSE: the standard deviation of the
    scans' spacing errors, with their mean as the correction. ``deviation_mm`` enters as the thesis's PE.

    Parameters
    ----------
    calibration : Calibration
    scans : sequence of SphereScan
        At least two.
    medium : Medium
    deviation_mm : float
        Largest standard deviation of the points about the spheres.
    """
    errors = np.array([spacing_error(calibration, scan) for scan in scans])
    correction = float(np.mean(np.abs(errors)))
    ends = [
        medium.warmer_by(sign * TEMPERATURE_HALF_WIDTH_C).refractive_index(calibration.wavelength_nm)
        for sign in (1, -1)
    ]
    changes = [[spacing_error(calibration, scan, medium_index=index) for scan in scans] for index in ends]
    by_index = float(np.mean(np.abs(np.subtract(*changes)))) / 2
    expansion = thermal_expansion_mm(
        length_mm=scans[0].spacing_mm, alpha_per_k=_EXPANSION_PER_K, temperature_change_k=TEMPERATURE_HALF_WIDTH_C
    )
    resolution = _SUBPIXEL * mm_per_px(calibration, scans[0].medium_index)
    budget = combine(
        [
            Source(name="index", half_width=by_index, distribution="uniform"),
            Source(name="expansion", half_width=expansion, distribution="uniform"),
            Source(name="resolution", half_width=resolution / 2, distribution="uniform"),
            Source(name="standard", half_width=_STANDARD_EXPANDED_MM, coverage_factor=2.0),
            Source(
                name="SSE", half_width=float(np.std(errors, ddof=1)), degrees_of_freedom=len(errors) - 1,
                correction=correction,
            ),
            Source(name="PE", half_width=deviation_mm),
        ]
    )  # fmt: skip
    return {source.name: source.standard_uncertainty for source in budget.sources} | {
        "degrees_of_freedom": budget.degrees_of_freedom,
        "expanded": budget.expanded_uncertainty,
        "correction": budget.correction,
        "largest_error": budget.largest_error,
    }


def mm_per_px(calibration: Calibration, medium_index: float) -> float:
    """Change of Z per pixel across the stripe where the camera's axis meets the sheet, mm."""
    camera = calibration.camera
    across = np.array([0.0, 0.5] if calibration.stripe_along == "width" else [0.5, 0.0])
    pixels = np.array([camera.cx_px, camera.cy_px]) + np.array([-across, across])
    points = reconstruct_pixels(
        calibration, pixels, medium_index=medium_index, stage_mm=0.0, stage_direction=np.array([1.0, 0.0, 0.0])
    ).points_mm
    return float(abs(points[1, 2] - points[0, 2]))
