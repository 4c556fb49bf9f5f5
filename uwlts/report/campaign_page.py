"""The report of a campaign: one HTML page that contains everything it shows and loads nothing from the network."""

import json
import platform
from collections.abc import Sequence
from dataclasses import dataclass
from importlib.metadata import version
from pathlib import Path
from typing import Any

import numpy as np
from markupsafe import Markup

import uwlts
from uwlts.measurement.evaluation_file import ArtefactFigures, TruthComparisons, TruthFigures
from uwlts.model.calibration import Calibration
from uwlts.model.errors import OutputError
from uwlts.report import plot
from uwlts.report.gather import Campaign, GatheredCapture, Measurement, Reference, gather_campaign, load_reference
from uwlts.report.numbers import fixed, is_number, small_length, unit_of, words_of
from uwlts.report.page_toolkit import (
    Comparison,
    FigureCollector,
    InteractiveFigure,
    Tile,
    png_data_uri,
    render_page,
    svg_of,
    write_page,
)
from uwlts.report.pictures import MeasurementPictures, draw_pictures, write_pictures
from uwlts.report.summary_file import TruthSummary, summary, write_summary
from uwlts.report.tables import Row, parameter_table, residual_table, summary_table, true_window_distance

_LIBRARIES = ("numpy", "opencv-python-headless", "scipy", "h5py", "matplotlib", "plotly")
_CAPTIONS = {
    "camera image_rms_px": "Root mean square distance between found and calculated target points of each image.",
    "window heights_mm": "Height of the step in each image, with the estimated window distance.",
    "window errors_mm": "Error of the step's height in each image, with the estimated window distance.",
    "window height_std_mm": "Standard deviation of each height from the scatter of the stripe's points.",
    "window image_distances_mm": "Window distance that each image alone would give.",
}


@dataclass(frozen=True)
class Report:
    """Report of a campaign: its page and summary, what it shows, and the published values beside the measured ones."""

    page: Path
    summary: Path
    campaign: Campaign
    reference: Reference | None

    def rows(self) -> list[Row]:
        """The summary table."""
        return summary_table(self.campaign, self.reference)


def write_report(
    folder: str | Path,
    *,
    reference: str | Path | None = None,
    out: str | Path | None = None,
    pictures: str | Path | None = None,
    overwrite: bool = False,
) -> Report:
    """Write the report of a campaign: one page with pictures, and a summary in numbers beside it.

    Parameters
    ----------
    folder : str or Path
        Folder with captures NAME.h5, coloured clouds NAME.ply (or .h5), evaluations NAME.evaluation.json and
        calibrations.
    reference : str or Path, optional
        Published values to set beside the measured ones: "thesis", or the path of a TOML file.
    out : str or Path, optional
        Page to write; FOLDER/report.html unless given. The summary goes beside it, to summary.json.
    pictures : str or Path, optional
        Folder for the stripe and the cloud of every measurement as PNG files; not written unless given.
    overwrite : bool
        Replace an existing report, summary and pictures.

    Raises
    ------
    OutputError
        A file exists and ``overwrite`` is not given, or cannot be written.
    CaptureError
        A file of the campaign is damaged.
    DescriptionError
        The published values cannot be read.
    """
    campaign = gather_campaign(folder)
    published = load_reference(reference) if reference else None
    page = Path(out or campaign.folder / "report.html")
    report = Report(page, page.with_name("summary.json"), campaign, published)
    write_summary(report.summary, campaign, published, overwrite=overwrite)
    drawn = draw_pictures(campaign)
    write_page(page, report_page(campaign, published, pictures=drawn), overwrite=overwrite)
    if pictures:
        try:
            Path(pictures).mkdir(parents=True, exist_ok=True)
        except OSError as error:
            raise OutputError(f"cannot make the folder {pictures}: {error.strerror}") from error
        write_pictures(pictures, drawn, overwrite=overwrite)
    return report


def report_page(
    campaign: Campaign, reference: Reference | None = None, *, pictures: Sequence[MeasurementPictures] | None = None
) -> str:
    """The page as text; ``pictures`` are those of `draw_pictures`, drawn unless given."""
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
        measurements=[
            _measurement(measurement, drawn, collected)
            for measurement, drawn in zip(campaign.measurements, pictures or draw_pictures(campaign), strict=True)
        ],
        calibration=_calibrations(campaign),
        true_window=true_window_distance(campaign) is not None,
        seconds=svg_of(plot.seconds(campaign.seconds)) if campaign.seconds else None,
        seconds_in_all=sum(campaign.seconds.values()),
        provenance=_provenance(campaign),
    )


@dataclass(frozen=True)
class _MeasurementSection:
    """What the page shows of one measurement; what it lacks is None."""

    name: str
    facts: list[tuple[str, str]]
    stripe: str | None
    no_stripe: str
    cloud: InteractiveFigure | None
    histogram: Markup | None
    along: Markup | None
    deviation_from: str
    figures: Comparison | None
    truth: Comparison | None


@dataclass(frozen=True)
class _ResidualPlots:
    """Plots of one calibration's residuals with their captions."""

    name: str
    plots: list[tuple[Markup, str]]


@dataclass(frozen=True)
class _CalibrationSection:
    """What the page shows of all calibrations."""

    parameters: Comparison
    residuals: Comparison
    warnings: list[tuple[str, str]]
    curve: Markup | None
    groups: list[_ResidualPlots]


def _measurement(
    measurement: Measurement, pictures: MeasurementPictures, collected: FigureCollector
) -> _MeasurementSection:
    cloud, judged, capture = measurement.cloud, measurement.judged, measurement.capture
    coloured = cloud is not None and cloud.deviation_mm is not None and bool(np.isfinite(cloud.deviation_mm).any())
    shown = None
    if cloud is not None and pictures.cloud is not None:
        figure, caption = plot.interactive_cloud(cloud)
        shown = collected.add(figure, caption, webgl=True, still=png_data_uri(pictures.cloud))
    return _MeasurementSection(
        name=measurement.name,
        facts=_facts(measurement),
        stripe=None if pictures.stripe is None else png_data_uri(pictures.stripe),
        no_stripe="no image of its capture shows a stripe" if capture else "its capture is not in the folder",
        cloud=shown,
        histogram=svg_of(plot.deviation_histogram(cloud)) if cloud is not None and coloured else None,
        along=svg_of(plot.along_stripe(cloud)) if cloud is not None and plot.has_profile(cloud) else None,
        deviation_from="the artefact's fitted surface" if judged and judged.evaluation else "the true surface",
        figures=None if judged is None or judged.evaluation is None else _figure_table(judged.evaluation),
        truth=None if judged is None or judged.truth is None else _truth_table(judged.truth),
    )


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
        outliers = f"{100 * share:.2f} %, {allowed} the 0.3 % of VDI/VDE 2634"
        text = f"{found.points_used:,}, and {found.points_rejected:,} left out as outliers ({outliers})"
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


def _calibrations(campaign: Campaign) -> _CalibrationSection | None:
    if not campaign.calibrations:
        return None
    by_name = {found.name: found.calibration for found in campaign.calibrations}
    true_mm = true_window_distance(campaign)
    return _CalibrationSection(
        parameters=parameter_table(campaign),
        residuals=residual_table(campaign.calibrations),
        warnings=[(name, text) for name, each in by_name.items() for text in _warnings(each.provenance)],
        curve=svg_of(plot.window_curves(by_name, true_mm=true_mm)) if plot.has_window_curve(by_name) else None,
        groups=[_ResidualPlots(name, _residual_plots(calibration)) for name, calibration in by_name.items()],
    )


def _residual_plots(calibration: Calibration) -> list[tuple[Markup, str]]:
    plots = []
    for found in plot.residual_lists(calibration):
        words = words_of(found.name)
        caption = _CAPTIONS.get(
            f"{found.group} {found.name}", f"{found.group}: {words}." if found.group else f"{words}."
        )
        plots.append((svg_of(plot.residuals(calibration, which=found)), caption))
    return plots


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


_TILES = {
    "sphere_spacing_error_mm": "Sphere spacing error",
    "probing_error_mm": "Probing error",
    "std_mm": "Standard deviation",
    "step_height_error_mm": "Step height error",
    "pipe_diameter_error_mm": "Pipe diameter error",
    "plane_range_error_mm": "Plane range error",
}

_EXPLANATIONS = {
    "sphere spacing": "Distance between the centres of spheres fitted to the points, each with its radius free "
    "(VDI/VDE 2634: SSE is its error).",
    "probing error PE": "Range of the points' distances from the fitted sphere without outliers, of which "
    "VDI/VDE 2634 allows 0.3 %; of several spheres the worst.",
    "range error RE": "Range of the points' distances from the fitted plane.",
    "deviations STD": "Standard deviation of the points' distances from the fitted surface; of several the largest.",
    "deviations range": "Largest less smallest distance of the points from the fitted surface.",
    "step height": "Mean distance of one face's points from the plane fitted to the other face.",
    "pipe diameter": "Diameter of the fitted cylinder.",
    "within": "Share of the points whose distance to the true surface, along its normal, is at most this.",
    "rms distance": "Root mean square of those distances. Only rendered captures have a true surface. A best fit turns "
    "and shifts the whole cloud, as aligning it with a drawing would.",
    "window distance": "From the camera's entrance pupil to the window's inner face, found from the step standard in "
    "water; true is what was set in the twin.",
    "interface distance": "With one refraction a single interface stands for the whole window; its distance has no "
    "true value.",
}
_PUBLISHED = (
    "Published values in mm for the same kind of measurement: errors where there is a calibrated value, else the "
    "quantity itself; several values are several positions."
)


def headline_tiles(campaign: Campaign, reference: Reference | None) -> list[Tile]:
    """The key figures that the campaign has."""
    content = summary(campaign, reference)
    published = content.published
    tiles = []
    for key, name in _TILES.items():
        found = content.figure(key)
        count = len(found.by_measurement)
        if found.mean_abs is not None:
            note = f"mean absolute value of {count} measurements" if count > 1 else "one measurement"
            others = None if published is None else published.figure(key)
            theirs = None if others is None or others.mean_abs is None else small_length(others.mean_abs)
            if theirs and others and len(others.by_measurement) < count:
                theirs += f" for {len(others.by_measurement)} of them"
            tiles.append(Tile(name, small_length(found.mean_abs), _with_published(note, reference, theirs)))
    if content.truth.share_within_tolerance is not None:
        tiles.append(_truth_tile(content.truth))
    window = content.window_distance_mm
    if window.estimated is not None:
        true = "" if window.true is None else f"true {fixed(window.true)} mm"
        theirs = "" if published is None else ", ".join(f"{value:g} mm" for value in published.window_distance_mm)
        note = _with_published(true, reference, theirs)
        tiles.append(Tile("Window distance", f"{fixed(window.estimated)} mm", note))
    return tiles


def _with_published(note: str, reference: Reference | None, theirs: str | None) -> str:
    return f"{note}\n{reference.title}: {theirs}" if reference is not None and theirs else note


def _truth_tile(truth: TruthSummary) -> Tile:
    """Agreement with truth after the best-fit motion if there is one: the datum is the calibration's own choice."""
    fitted = truth.after_best_fit.share_within_tolerance is not None
    shown = truth.after_best_fit if fitted else truth
    note = f"rms distance {small_length(shown.rms_mm)}"
    if fitted:
        note += f" after a best-fit motion; in the sensor's own coordinates {small_length(truth.rms_mm)}"
    name = f"Points within {1e3 * (truth.tolerance_mm or 0):g} µm of the truth"
    return Tile(name, f"{100 * (shown.share_within_tolerance or 0):.2f} %", note)


def introduction(campaign: Campaign) -> list[tuple[str, str]]:
    """Sensor, medium, calibration and origin of the images, each in a sentence."""
    recorded = [m.capture for m in campaign.measurements if m.capture is not None] or list(campaign.captures)
    judged = [m.judged for m in campaign.measurements if m.judged is not None]
    facts = []
    if sensors := _once([_sensor(capture) for capture in recorded] or [j.sensor for j in judged if j.sensor]):
        facts.append(("Sensor", "; ".join(sensors)))
    indices = [text for m in campaign.measurements if (text := _index(m)) is not None]
    if media := _once([_medium(capture) for capture in recorded] + indices):
        facts.append(("Medium", "; ".join(media)))
    if origins := _once([_origin(capture) for capture in recorded]):
        facts.append(("Images", "; ".join(origins)))
    calibration = campaign.main_calibration
    if calibration is not None:
        window = calibration.calibration.window
        seen = (
            "no window"
            if window is None
            else (
                f"window {fixed(window.distance_mm)} mm from the entrance pupil, "
                + (
                    "glass plate with two refractions"
                    if window.refractions == 2
                    else "taken as one refracting interface"
                )
            )
        )
        source = calibration.calibration.provenance.get("source")
        facts.append(("Calibration", f"{calibration.name}: {seen}" + (f" ({source})" if source else "")))
    return facts


def explanations(rows: list[Row], reference: Reference | None) -> list[tuple[str, str]]:
    """Explanations of a table's quantities."""
    found = [
        (start, text) for start, text in _EXPLANATIONS.items() if any(row.quantity.startswith(start) for row in rows)
    ]
    if reference is not None:
        found.append((reference.title, _PUBLISHED))
    return found


def _sensor(capture: GatheredCapture) -> str:
    sensor = capture.header.sensor
    camera = sensor.camera
    return f"{sensor.name}, {camera.width_px} x {camera.height_px} pixels, {sensor.laser.wavelength_nm:g} nm"


def _medium(capture: GatheredCapture) -> str:
    medium = capture.header.medium
    parts = [f"{medium.temperature_c:g} °C"] if medium.kind != "custom" else []
    if medium.kind == "sea":
        parts.append(f"{medium.salinity_g_kg:g} g/kg salt")
    name = capture.header.medium_name
    return ", ".join([name if name == medium.kind else f"{name} ({medium.kind})", *parts])


def _index(measurement: Measurement) -> str | None:
    """The index that the points were calculated with, which need not be the description's."""
    recorded = {} if measurement.cloud is None else measurement.cloud.metadata
    index = measurement.judged.medium_index if measurement.judged is not None else recorded.get("medium_index")
    return f"points calculated with n = {index:.5f} relative to air" if is_number(index) else None


def _origin(capture: GatheredCapture) -> str:
    provenance = capture.header.provenance
    source = provenance.get("source")
    if source == "twin":
        effects = provenance.get("effects")
        return "rendered by the digital twin" + (", sharp and without noise" if effects == [] else "")
    return f"recorded by {source}" if isinstance(source, str) else "of unknown origin"


def _once(texts: list[str]) -> list[str]:
    return list(dict.fromkeys(texts))
