"""The figures of a calibration that its file keeps, as plain numbers and lists."""

from typing import Any

import numpy as np

from uwlts.calibration.camera_poses import CameraSolution
from uwlts.calibration.circle_bias import UnbiasedSolution
from uwlts.calibration.sheet import SheetSolution, StripePoints
from uwlts.calibration.window import WindowSolution


def camera_figures(solution: CameraSolution, unbiased: UnbiasedSolution | None) -> dict[str, Any]:
    """Residuals, standard deviations and covariance of the camera; the stage's direction in the camera frame."""
    direction, tilt, tilt_std = solution.stage_direction, solution.stage_tilt_rad, solution.stage_tilt_std_rad
    return {
        "images": len(solution.residuals_px),
        "points": sum(map(len, solution.residuals_px)),
        "rms_px": solution.rms_px(),
        "sigma_px": solution.sigma_px,
        "image_rms_px": solution.image_rms_px().tolist(),
        "std": solution.std(),
        "parameters": list(solution.parameters),
        "covariance": solution.covariance.tolist(),
        "stage_direction": None if direction is None else direction.tolist(),
        "stage_tilt_deg": None if tilt is None else float(np.degrees(tilt)),
        "stage_tilt_std_deg": None if tilt_std is None else float(np.degrees(tilt_std)),
        "largest_circle_bias_px": None if unbiased is None else unbiased.largest_bias_px(),
        "rounds": solution.rounds,
        "stopped": solution.stopped,
    }


def sheet_figures(solution: SheetSolution, points: StripePoints) -> dict[str, Any]:
    """Distances of the stripe points from the sheet."""
    return {
        "images": len(np.unique(points.image)),
        "points": len(points.points_mm),
        "rms_mm": solution.rms_mm,
        "max_mm": solution.max_mm,
        "rejected_share": solution.rejected_share,
        "normal_std_deg": float(np.degrees(solution.normal_std_rad)),
        "turn_from_nominal_deg": float(np.degrees(solution.turn_rad)),
    }


def window_figures(solution: WindowSolution, sources: list[str]) -> dict[str, Any]:
    """Step heights and their errors, the distance's standard deviations, the curve; what is missing is None."""
    return {
        "images": sources,
        "distance_mm": solution.model.distance_mm,
        "std_mm": solution.std_mm,
        "scatter_std_mm": solution.scatter_std_mm,
        "per_height": solution.per_height,
        "heights_mm": solution.heights_mm.tolist(),
        "errors_mm": solution.errors_mm.tolist(),
        "height_std_mm": solution.height_std_mm.tolist(),
        "image_distances_mm": _none_for_nan(solution.image_distances_mm),
        "curve_mm": [_none_for_nan(row) for row in solution.curve_mm],
        "bounds_mm": list(solution.bounds_mm),
    }


def _none_for_nan(values: np.ndarray) -> list[float | None]:
    return [float(value) if np.isfinite(value) else None for value in values]
