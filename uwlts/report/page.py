"""The report: one HTML page that holds everything it shows and asks nothing of the network."""

import json
import platform
from importlib.metadata import version
from pathlib import Path
from typing import Any

import uwlts
from uwlts.report.calibration_figures import residual_figures, seconds_figure, window_curve_figure
from uwlts.report.calibration_table import parameter_table, residual_table
from uwlts.report.figures import Drawn, along_stripe_figure, cloud_figure, histogram_figure
from uwlts.report.gather import Campaign, GatheredCapture, Measurement
from uwlts.report.headline import explanations, headline_tiles, introduction
from uwlts.report.judged import ArtefactFigures, TruthComparisons, TruthFigures
from uwlts.report.numbers import fixed, is_number, small_length, unit_of, words_of
from uwlts.report.page_toolkit import (
    Comparison,
    FigureCollector,
    InteractiveFigure,
    png_data_uri,
    render_page,
    write_page,
)
from uwlts.report.pictures import cloud_png, stripe_png
from uwlts.report.published import Reference
from uwlts.report.table import Row, summary_table, true_window_distance

_LIBRARIES = ("numpy", "opencv-python-headless", "scipy", "h5py", "plotly")


def write_report(
    path: str | Path, campaign: Campaign, reference: Reference | None = None, *, overwrite: bool = False
) -> None:
    """Write the report of a campaign, whole or not at all.

    Raises
    ------
    OutputError
        The page exists and ``overwrite`` is not given, or cannot be written.
    CaptureError
        An image of a capture is damaged.
    """
    write_page(path, report_page(campaign, reference), overwrite=overwrite)


def report_page(campaign: Campaign, reference: Reference | None = None) -> str:
    """The page as text."""
    collected = FigureCollector()
    rows = summary_table(campaign, reference)
    return render_page(
        "uwlts.report",
        "campaign.html.j2",
        interactive=collected,
        title=campaign.folder.resolve().name,
        introduction=introduction(campaign),
        key_figures=headline_tiles(campaign, reference),
        groups=_grouped(rows),
        published=None if reference is None else reference.title,
        explanations=explanations(rows, reference),
        measurements=[_measurement(measurement, collected) for measurement in campaign.measurements],
        calibration=_calibration(campaign, collected),
        seconds=_add(collected, seconds_figure(campaign.seconds)),
        provenance=_provenance(campaign),
    )


def _add(collected: FigureCollector, drawn: Drawn | None, still: bytes | None = None) -> InteractiveFigure | None:
    if drawn is None:
        return None
    address = None if still is None else png_data_uri(still)
    return collected.add(drawn.figure, drawn.caption, webgl=drawn.solid, still=address)


def _measurement(measurement: Measurement, collected: FigureCollector) -> dict[str, Any]:
    cloud, judged, capture = measurement.cloud, measurement.judged, measurement.capture
    coloured = cloud is not None and cloud.deviation_mm is not None
    stripe, still = stripe_png(measurement), cloud_png(measurement)
    return {
        "name": measurement.name,
        "facts": _facts(measurement),
        "stripe": None if stripe is None else png_data_uri(stripe),
        "no_stripe": "no image of its capture shows a stripe" if capture else "its capture is not in the folder",
        "cloud": None if cloud is None else _add(collected, cloud_figure(cloud), still),
        "histogram": _add(collected, histogram_figure(cloud.deviation_mm)) if coloured else None,
        "along": _add(collected, along_stripe_figure(cloud)) if coloured else None,
        "deviation_from": "the artefact's fitted surface" if judged and judged.evaluation else "the true surface",
        "figures": None if judged is None or judged.evaluation is None else _figure_table(judged.evaluation),
        "truth": None if judged is None or judged.truth is None else _truth_table(judged.truth),
    }  # fmt: skip


def _facts(measurement: Measurement) -> list[tuple[str, str]]:
    judged, capture, cloud = measurement.judged, measurement.capture, measurement.cloud
    facts = []
    if judged is not None and judged.artefact is not None:
        artefact = judged.artefact.model_dump(mode="json", exclude_none=True)
        kind = artefact.pop("kind")
        facts.append(("artefact", f"{kind}: {_pairs(artefact)}"))
    if capture is not None:
        laser = len(capture.laser_images)
        facts.append(("capture", f"{capture.path.name}, {capture.images} images, {laser} with the laser on"))
    if cloud is not None:
        facts.append(("points", f"{len(cloud):,}"))
    if judged is not None and judged.evaluation is not None:
        found = judged.evaluation
        share = found.points_rejected / max(1, found.points_used + found.points_rejected)
        allowed = "within" if found.within_vdi_outliers else "more than"
        stray = f"{100 * share:.2f} %, {allowed} the 0.3 % of VDI/VDE 2634"
        text = f"{found.points_used:,}, and {found.points_rejected:,} left out as stray ({stray})"
        facts.append(("points evaluated", text))
    if measurement.digest is not None:
        known = measurement.calibration
        facts.append(("calibration", known.name if known else f"not in the folder (digest {measurement.digest})"))
    return facts


def _truth(truth: TruthFigures) -> list[tuple[str, str]]:
    return [
        (f"points within {1e3 * truth.tolerance_mm:g} µm", f"{100 * truth.share_within_tolerance:.2f} %"),
        ("mean distance", small_length(truth.mean_mm, signed=True)),
        ("standard deviation", small_length(truth.std_mm)),
        ("rms distance", small_length(truth.rms_mm)),
        ("95 % are closer than", small_length(truth.p95_mm)),
        ("99 % are closer than", small_length(truth.p99_mm)),
        ("largest distance", small_length(truth.largest_mm)),
        ("points compared", f"{truth.matched:,}"),
        ("points where no stripe is visible", f"{truth.false_points:,}"),
        ("visible stripe points not found", f"{truth.missed:,}"),
    ]


def _truth_table(truth: TruthComparisons) -> Comparison:
    columns = {"as measured": truth} | ({"after best fit": truth.after_best_fit} if truth.after_best_fit else {})
    described = [_truth(found) for found in columns.values()]
    rows = tuple((entries[0][0], "", tuple(text for _, text in entries)) for entries in zip(*described, strict=True))
    return Comparison(tuple(columns), rows)


def _figure_table(evaluation: ArtefactFigures) -> Comparison:
    rows = [
        (name, "", (small_length(value, signed="error" in name or "SSE" in name),))
        for name, value in evaluation.figures_mm.items()
    ]
    return Comparison(("value",), tuple(rows))


def _calibration(campaign: Campaign, collected: FigureCollector) -> dict[str, Any] | None:
    if not campaign.calibrations:
        return None
    return {
        "parameters": parameter_table(campaign),
        "residuals": residual_table(campaign.calibrations),
        "warnings": [
            (found.name, text) for found in campaign.calibrations for text in _warnings(found.calibration.provenance)
        ],
        "curve": _add(collected, window_curve_figure(campaign.calibrations, true_window_distance(campaign))),
        "groups": [
            (found.name, [_add(collected, drawn) for drawn in residual_figures(found)])
            for found in campaign.calibrations
        ],
    }


def _warnings(provenance: dict[str, Any]) -> list[str]:
    found = provenance.get("warnings")
    return [_value(text) for text in found] if isinstance(found, list) else []


def _grouped(rows: list[Row]) -> list[tuple[str, list[tuple[str, ...]]]]:
    """Rows as text under their measurement; the uncertainty stands beside the calibrated value."""
    groups: dict[str, list[tuple[str, ...]]] = {}
    for row in rows:
        name, quantity, true, *others = row.texts()
        if row.uncertainty:
            true = f"{true} ± {fixed(row.uncertainty)}"
        groups.setdefault(name, []).append((quantity, true, *others))
    return list(groups.items())


def _provenance(campaign: Campaign) -> list[tuple[str, str]]:
    libraries = ", ".join(f"{name} {version(name)}" for name in _LIBRARIES)
    entries = [("report", f"uwlts {uwlts.__version__}, Python {platform.python_version()}, {libraries}")]
    for found in campaign.calibrations:
        entries.append((f"calibration {found.name}", f"digest {found.digest}; {_pairs(found.calibration.provenance)}"))
    entries += [(f"capture {capture.path.name}", _recorded(capture)) for capture in campaign.captures]
    return entries


def _recorded(capture: GatheredCapture) -> str:
    header = capture.header
    of = f"'{header.name}', sensor '{header.sensor.name}', {header.medium_name}"
    return f"{of}; {_pairs(header.provenance) or 'origin unknown'}"


def _pairs(table: dict[str, Any]) -> str:
    return "; ".join(f"{words_of(key)} {_value(value)} {unit_of(key)}".rstrip() for key, value in table.items())


def _value(value: Any) -> str:
    if isinstance(value, list):
        return ", ".join(map(_value, value)) or "none"
    if isinstance(value, dict):
        return f"({_pairs(value)})"
    if is_number(value):
        return f"{value:g}" if isinstance(value, float) else str(value)
    return value if isinstance(value, str) else json.dumps(value, ensure_ascii=False)
