"""Figures of each step of a calibration, as files hold them: residuals, standard deviations, what was left out."""

from collections.abc import Sequence

import numpy as np
from pydantic import JsonValue

from uwlts.calibration.camera.lens import LensCalibration
from uwlts.calibration.camera.target_poses import CameraSolution
from uwlts.calibration.capture_evidence import AirEvidence, StepEvidence
from uwlts.calibration.sequential.sheet_fit import SheetSolution, StripePoints
from uwlts.calibration.sequential.window_distance import WindowSolution


def camera_figures(solution: CameraSolution) -> dict[str, JsonValue]:
    """Residuals, standard deviations and covariance of the camera, as files hold them; None for what is missing."""
    direction, tilt, tilt_std = solution.stage_direction, solution.stage_tilt_rad, solution.stage_tilt_std_rad
    return {
        "images": len(solution.residuals_px),
        "points": sum(map(len, solution.residuals_px)),
        "rms_px": solution.rms_px(),
        "sigma_px": solution.sigma_px,
        "image_rms_px": solution.image_rms_px().tolist(),
        "std": {**solution.std()},
        "parameters": list(solution.parameters),
        "covariance": solution.covariance.tolist(),
        "stage_direction": None if direction is None else direction.tolist(),
        "stage_tilt_deg": None if tilt is None else float(np.degrees(tilt)),
        "stage_tilt_std_deg": None if tilt_std is None else float(np.degrees(tilt_std)),
        "largest_circle_bias_px": solution.largest_bias_px(),
        "rounds": solution.rounds,
        "stopped": solution.stopped,
    }


def lens_figures(lens: LensCalibration, found: AirEvidence) -> dict[str, JsonValue]:
    """Models tried and images used, of ``found`` those alone, as files hold them; None for what is missing."""
    rms = lens.solution.image_rms_px()
    columns = zip(found.names(), found.images, rms, lens.moved, found.stripes, found.outliers, strict=True)
    table: list[JsonValue] = [
        {
            "image": name,
            "points": len(image.pixels),
            "rms_px": float(miss),
            "moves": None if np.isnan(moved) else float(moved),
            "stripe_points": len(stripe),
            "stripe_outliers": outliers,
        }
        for name, image, miss, moved, stripe, outliers in columns
    ]
    tried: list[JsonValue] = [
        {"model": each.name, "rms_px": each.rms_px if np.isfinite(each.rms_px) else None} for each in lens.candidates
    ]
    return {
        "halves": [{**half} for half in lens.half_values()],
        "lens_model": lens.name,
        "models_tried": tried,
        "rejected_share": lens.rejected_share,
        "images_left_out": len(lens.left_out),
        "image_table": table,
    }


def sheet_figures(
    solution: SheetSolution, points: StripePoints, halves_apart_rad: float | None
) -> dict[str, JsonValue]:
    """Distances of the stripe points from the sheet, as files hold them; the angle between the sheets of halves."""
    return {
        "images": len(np.unique(points.image)),
        "points": len(points.points_mm),
        "rms_mm": solution.rms_mm,
        "max_mm": solution.max_mm,
        "rejected_share": solution.rejected_share,
        "normal_std_deg": float(np.degrees(solution.normal_std_rad)),
        "halves_apart_deg": None if halves_apart_rad is None else float(np.degrees(halves_apart_rad)),
        "turn_from_nominal_deg": float(np.degrees(solution.turn_rad)),
    }


def window_figures(solution: WindowSolution, steps: Sequence[StepEvidence]) -> dict[str, JsonValue]:
    """Step heights and their errors, the distance's standard deviations, the curve, as files hold them."""
    return {
        "images": [step.source for step in steps],
        "distance_mm": solution.model.distance_mm,
        "std_mm": solution.uncertainty_mm,
        "left_over_std_mm": solution.std_mm,
        "scatter_std_mm": solution.scatter_std_mm,
        "per_height": solution.per_height,
        "per_index": solution.per_index,
        "heights_mm": solution.heights_mm.tolist(),
        "errors_mm": solution.errors_mm.tolist(),
        "height_std_mm": solution.height_std_mm.tolist(),
        "image_distances_mm": _none_for_nan(solution.image_distances_mm),
        "curve_mm": [_none_for_nan(row) for row in solution.curve_mm],
        "bounds_mm": list(solution.bounds_mm),
    }


def _none_for_nan(values: np.ndarray) -> list[JsonValue]:
    return [value if np.isfinite(value) else None for value in values.tolist()]
