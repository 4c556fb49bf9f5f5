"""The campaign's key figures as plain JSON."""

import json
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from uwlts.evaluation_file import TruthFigures
from uwlts.files import written_aside
from uwlts.metrology.evaluation import Quantity
from uwlts.report.gather import CALIBRATION, Campaign, Measurement, Reference
from uwlts.report.tables import true_window_distance

KEY_FIGURES = {
    "sphere_spacing_error_mm": ("spheres", Quantity.SPACING_ERROR),
    "probing_error_mm": ("spheres", Quantity.PROBING_ERROR),
    "std_mm": (None, Quantity.STD),
    "step_height_error_mm": ("step", Quantity.HEIGHT_ERROR),
    "pipe_diameter_error_mm": ("pipe", Quantity.DIAMETER_ERROR),
    "plane_range_error_mm": ("plane", Quantity.RANGE_ERROR),
}
"""Key figures by name: kind of the artefact (None: any) and quantity; details are left out."""


def summary(campaign: Campaign, reference: Reference | None = None) -> dict[str, Any]:
    """Key figures of a campaign; what was not measured is None or empty.

    The figures at the top are those of the measurements made with the campaign's main calibration; others stand under
    ``other_calibrations``. An error's ``mean_abs`` is the mean of its absolute values over the measurements, each of
    which counts with its largest.
    """
    main = campaign.main_measurements
    others: dict[str, list[Measurement]] = {}
    for measurement in campaign.measurements:
        if measurement not in main:
            known = measurement.calibration
            others.setdefault(known.name if known else str(measurement.digest), []).append(measurement)
    calibration = campaign.main_calibration
    return {
        "campaign": campaign.folder.resolve().name,
        "calibration": None if calibration is None else calibration.name,
        **_key_figures(main),
        "window_distance_mm": _window(campaign),
        "truth": _truth(main),
        "points": {
            m.name: {
                "total": m.judged.evaluation.points_total,
                "used": m.judged.evaluation.points_used,
                "rejected": m.judged.evaluation.points_rejected,
            }
            for m in campaign.measurements
            if m.judged is not None and m.judged.evaluation is not None
        },
        "seconds": dict(campaign.seconds),
        "other_calibrations": {name: _key_figures(found) | {"truth": _truth(found)} for name, found in others.items()},
        "published": None if reference is None else _published(main, reference),
    }


def write_summary(
    path: str | Path, campaign: Campaign, reference: Reference | None = None, *, overwrite: bool = False
) -> None:
    """Write the summary as indented JSON, whole or not at all; OutputError where that fails."""
    text = json.dumps(summary(campaign, reference), indent=2, allow_nan=False)
    with written_aside(path, overwrite=overwrite) as aside:
        aside.write_text(text + "\n", encoding="utf-8")


def _key_figures(measurements: Iterable[Measurement]) -> dict[str, Any]:
    figures = {}
    for name, (kind, quantity) in KEY_FIGURES.items():
        values = {}
        for measurement in measurements:
            record = measurement.judged
            evaluation = None if record is None else record.evaluation
            if record is None or evaluation is None or kind not in (None, evaluation.kind):
                continue
            keys = record.figure_keys()
            found = [
                value
                for figure, value in evaluation.figures_mm.items()
                if figure in keys and keys[figure].quantity is quantity and not keys[figure].is_detail
            ]
            if found:
                values[measurement.name] = max(found, key=abs)
        figures[name] = {"mean_abs": _mean_abs(values.values()), "by_measurement": values}
    return figures


def _mean_abs(values: Iterable[float]) -> float | None:
    sizes = np.abs(list(values))
    return float(sizes.mean()) if len(sizes) else None


def _window(campaign: Campaign) -> dict[str, float | None]:
    found = campaign.main_calibration
    window = None if found is None else found.calibration.window
    true = None if window is not None and window.refractions == 1 else true_window_distance(campaign)
    return {"estimated": None if window is None else window.distance_mm, "true": true}


def _truth(measurements: Iterable[Measurement]) -> dict[str, Any]:
    """Comparisons with truth: over the points of all measurements, and of each."""
    compared = {m.name: m.judged.truth for m in measurements if m.judged is not None and m.judged.truth is not None}
    fitted = [truth.after_best_fit for truth in compared.values() if truth.after_best_fit is not None]
    return {
        **_pooled(list(compared.values())),
        "after_best_fit": _pooled(fitted if len(fitted) == len(compared) else []),
        "by_measurement": {name: truth.model_dump() for name, truth in compared.items()},
    }


def _pooled(compared: Sequence[TruthFigures]) -> dict[str, float | None]:
    """Share and rms over all points; None without any, or where the tolerances differ."""
    weights = [truth.matched for truth in compared]
    if not sum(weights) or len({truth.tolerance_mm for truth in compared}) > 1:
        return dict.fromkeys(("tolerance_mm", "share_within_tolerance", "rms_mm"))
    return {
        "tolerance_mm": compared[0].tolerance_mm,
        "share_within_tolerance": float(np.average([t.share_within_tolerance for t in compared], weights=weights)),
        "rms_mm": float(np.sqrt(np.average([truth.rms_mm**2 for truth in compared], weights=weights))),
    }


def _published(measurements: Iterable[Measurement], reference: Reference) -> dict[str, Any]:
    """Published key figures of the measurements made, by the names that the reference gives them."""
    measurements = list(measurements)
    result: dict[str, Any] = {"title": reference.title}
    for key, (_, figure) in KEY_FIGURES.items():
        values = {m.name: list(found) for m in measurements if (found := reference.values(m.known_as, figure))}
        result[key] = {
            "mean_abs": _mean_abs(value for several in values.values() for value in several), "by_measurement": values,
        }  # fmt: skip
    result["window_distance_mm"] = list(reference.values((CALIBRATION,), "window_distance_mm"))
    return result
