"""Key figures of a campaign, and their file summary.json."""

from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path

import numpy as np

from uwlts.evaluation.evaluate import TruthComparisons, TruthFigures
from uwlts.evaluation.figures import Quantity
from uwlts.files.json_files import write_record
from uwlts.model.sensor import Description
from uwlts.report.gather import CALIBRATION, GatheredCampaign, GatheredMeasurement, Reference

KEY_FIGURES = {
    "sphere_spacing_error_mm": ("Sphere spacing error", "spheres", Quantity.SPACING_ERROR),
    "probing_error_mm": ("Probing error", "spheres", Quantity.PROBING_ERROR),
    "std_mm": ("Standard deviation", None, Quantity.STD),
    "step_height_error_mm": ("Step height error", "step", Quantity.HEIGHT_ERROR),
    "pipe_diameter_error_mm": ("Pipe diameter error", "pipe", Quantity.DIAMETER_ERROR),
    "plane_range_error_mm": ("Plane range error", "plane", Quantity.RANGE_ERROR),
}
"""Key figures by name: heading, kind of artefact (None: any) and quantity; details are excluded."""


class KeyFigure(Description):
    """The largest error or the published errors of every measurement, and the mean of their absolute values."""

    mean_abs: float | None
    by_measurement: Mapping[str, float | tuple[float, ...]]


class _KeyFigures(Description):
    """The figures of `KEY_FIGURES`."""

    sphere_spacing_error_mm: KeyFigure
    probing_error_mm: KeyFigure
    std_mm: KeyFigure
    step_height_error_mm: KeyFigure
    pipe_diameter_error_mm: KeyFigure
    plane_range_error_mm: KeyFigure

    def figure(self, key: str) -> KeyFigure:
        """Return the figure of a key of `KEY_FIGURES`."""
        return getattr(self, key)


class PooledTruth(Description):
    """Fraction within the tolerance and rms distance over all points; None without points or if tolerances differ."""

    tolerance_mm: float | None = None
    share_within_tolerance: float | None = None
    rms_mm: float | None = None


class TruthSummary(PooledTruth):
    """Comparison with truth over the points of all measurements, also after best fits, and for each measurement."""

    after_best_fit: PooledTruth
    by_measurement: dict[str, TruthComparisons]


class WindowDistance(Description):
    """Distance of the camera's window in mm as calibrated, and as set in the twin."""

    estimated: float | None
    true: float | None


class PointCount(Description):
    """Numbers of points of an evaluation."""

    total: int
    used: int
    rejected: int


class CalibrationSummary(_KeyFigures):
    """Key figures of the measurements made with a calibration other than the main one."""

    truth: TruthSummary


class PublishedSummary(_KeyFigures):
    """Published key figures of the measurements, by the names used in the reference."""

    title: str
    window_distance_mm: tuple[float, ...]


class Summary(_KeyFigures):
    """Key figures of a campaign.

    Top-level figures are for measurements made with the campaign's main ``calibration``; others are in
    ``other_calibrations``. ``seconds`` is the time of each stage.
    """

    campaign: str
    calibration: str | None
    window_distance_mm: WindowDistance
    truth: TruthSummary
    points: dict[str, PointCount]
    seconds: dict[str, float]
    other_calibrations: dict[str, CalibrationSummary]
    published: PublishedSummary | None


def summary(campaign: GatheredCampaign, reference: Reference | None = None) -> Summary:
    """Return the key figures of a campaign, with published ones if a reference is given."""
    main = campaign.main_measurements
    others: dict[str, list[GatheredMeasurement]] = {}
    for measurement in campaign.measurements:
        if measurement not in main:
            known = measurement.calibration
            others.setdefault(known.name if known else str(measurement.digest), []).append(measurement)
    calibration = campaign.main_calibration
    return Summary(
        campaign=campaign.folder.resolve().name,
        calibration=None if calibration is None else calibration.name,
        **_key_figures(main),
        window_distance_mm=_window(campaign),
        truth=_truth(main),
        points={
            m.name: PointCount(total=found.points_total, used=found.points_used, rejected=found.points_rejected)
            for m in campaign.measurements
            if m.judged is not None and (found := m.judged.evaluation) is not None
        },
        seconds=campaign.seconds,
        other_calibrations={
            name: CalibrationSummary(**_key_figures(found), truth=_truth(found)) for name, found in others.items()
        },
        published=None if reference is None else _find_published(main, reference),
    )


def write_summary(
    path: str | Path, campaign: GatheredCampaign, reference: Reference | None = None, *, overwrite: bool = False
) -> None:
    """Write the summary as indented JSON, completely or not at all; OutputError if that fails."""
    write_record(path, summary(campaign, reference).model_dump(), overwrite=overwrite)


def _key_figures(measurements: Iterable[GatheredMeasurement]) -> dict[str, KeyFigure]:
    found = {}
    for name, (_, kind, quantity) in KEY_FIGURES.items():
        largest = {}
        for measurement in measurements:
            record = measurement.judged
            if record is None or record.evaluation is None or kind not in (None, record.evaluation.kind):
                continue
            keys = record.figure_keys().items()
            wanted = {figure for figure, key in keys if key.quantity is quantity and not key.is_detail}
            if errors := [value for figure, value in record.evaluation.figures_mm.items() if figure in wanted]:
                largest[measurement.name] = max(errors, key=abs)
        found[name] = KeyFigure(mean_abs=_mean_abs(largest.values()), by_measurement=largest)
    return found


def _mean_abs(values: Iterable[float]) -> float | None:
    sizes = np.abs(list(values))
    return float(sizes.mean()) if len(sizes) else None


def _window(campaign: GatheredCampaign) -> WindowDistance:
    found = campaign.main_calibration
    window = None if found is None else found.calibration.window
    true = None if window is not None and window.refractions == 1 else campaign.true_window_mm
    return WindowDistance(estimated=None if window is None else window.distance_mm, true=true)


def _truth(measurements: Iterable[GatheredMeasurement]) -> TruthSummary:
    compared = {m.name: m.judged.truth for m in measurements if m.judged is not None and m.judged.truth is not None}
    fitted = [truth.after_best_fit for truth in compared.values() if truth.after_best_fit is not None]
    return TruthSummary(
        **_pool(list(compared.values())).model_dump(),
        after_best_fit=_pool(fitted if len(fitted) == len(compared) else []),
        by_measurement=compared,
    )


def _pool(compared: Sequence[TruthFigures]) -> PooledTruth:
    weights = [truth.matched for truth in compared]
    if not sum(weights) or len({truth.tolerance_mm for truth in compared}) > 1:
        return PooledTruth()
    return PooledTruth(
        tolerance_mm=compared[0].tolerance_mm,
        share_within_tolerance=float(np.average([t.share_within_tolerance for t in compared], weights=weights)),
        rms_mm=float(np.sqrt(np.average([truth.rms_mm**2 for truth in compared], weights=weights))),
    )


def _find_published(measurements: Sequence[GatheredMeasurement], reference: Reference) -> PublishedSummary:
    figures = {}
    for key, (_, _, figure) in KEY_FIGURES.items():
        values = {m.name: found for m in measurements if (found := reference.values(m.known_as, figure))}
        mean = _mean_abs(value for several in values.values() for value in several)
        figures[key] = KeyFigure(mean_abs=mean, by_measurement=values)
    window = reference.values((CALIBRATION,), "window_distance_mm")
    return PublishedSummary(title=reference.title, **figures, window_distance_mm=window)
