"""Report of a campaign: one self-contained HTML page without network access."""

import json
import platform
from collections.abc import Sequence
from dataclasses import dataclass
from datetime import UTC, datetime
from importlib.metadata import version
from pathlib import Path
from typing import Any

from uwlts._version import __version__
from uwlts.errors import OutputError, RangeError
from uwlts.evaluation.evaluate import TruthComparisons
from uwlts.files.writing import refuse_unsuitable, require_ending
from uwlts.model.brief import Brief
from uwlts.pages.numbers import format_fixed, format_length, is_number, split_name, unit_of
from uwlts.pages.toolkit import (
    HTML,
    MISSING,
    ComparisonTable,
    FigureCollector,
    Tile,
    figure_svg,
    render_page,
    webp_data_uri,
    write_page,
)
from uwlts.reconstruction.verify import normalise_error
from uwlts.report import plot
from uwlts.report.campaign_tables import Row, parameter_table, residual_table, summary_table
from uwlts.report.gather import (
    GatheredCampaign,
    GatheredCapture,
    GatheredMeasurement,
    Reference,
    gather_campaign,
    load_reference,
)
from uwlts.report.pictures import MeasurementPictures, cloud_points, draw_pictures, svg_if_any, write_pictures
from uwlts.report.summary_file import KEY_FIGURES, summary, write_summary

_LIBRARIES = ("numpy", "opencv-python-headless", "scipy", "h5py", "matplotlib", "nicegui")
_CAPTIONS = {
    "camera image_rms_px": "Root mean square distance between found and calculated target points of each image.",
    "window heights_mm": "Height of the step in each image, with the estimated window distance.",
    "window errors_mm": "Error of the step's height in each image, with the estimated window distance.",
    "window height_std_mm": "Standard deviation of each height from the scatter of the stripe's points.",
    "window image_distances_mm": "Window distance that each image alone would give.",
}


@dataclass(frozen=True, repr=False)
class Report(Brief):
    """Report of a campaign: page and summary file, the campaign shown, and the published values for comparison."""

    page: Path
    summary: Path
    campaign: GatheredCampaign
    reference: Reference | None

    def rows(self) -> list[Row]:
        """Return the summary table."""
        return summary_table(self.campaign, self.reference)


def write_campaign(
    folder: str | Path,
    *,
    published: str | Path | None = None,
    out: str | Path | None = None,
    pictures: str | Path | None = None,
    workers: int = 1,
    overwrite: bool = False,
) -> Report:
    """Report a campaign's files as one page with pictures, and write a numerical summary beside it.

    Parameters
    ----------
    folder : str or Path
        Folder with captures NAME.h5, coloured clouds NAME.ply (or .h5), evaluations NAME.evaluation.json and
        calibrations.
    published : str or Path, optional
        Published values to compare with: name (thesis) or path of a TOML file.
    out : str or Path, optional
        Page to write (default: FOLDER/report.html). The summary is written beside it, to summary.json.
    pictures : str or Path, optional
        Folder for PNG files of the stripe and the cloud of every measurement (default: not written).
    workers : int
        Number of drawing processes; with more than one, a script needs Python's ``if __name__ == "__main__"``.
    overwrite : bool
        Replace an existing report, summary and pictures.

    Returns
    -------
    Report
        Paths of the page and the summary, the campaign, and the published values.

    Raises
    ------
    OutputError
        A file exists and ``overwrite`` is not given, or cannot be written.
    CaptureError
        A file of the campaign is damaged.
    DescriptionError
        The published values cannot be read.
    RangeError
        ``workers`` is less than 1.
    """
    if workers < 1:
        raise RangeError(f"workers is {workers}; it must be at least 1")
    if out:
        require_ending(Path(out), HTML)
    campaign = gather_campaign(folder)
    reference = load_reference(published) if published else None
    page = Path(out or campaign.folder / "report.html")
    refuse_unsuitable(page, overwrite=overwrite)
    report = Report(page, page.with_name("summary.json"), campaign, reference)
    write_summary(report.summary, campaign, reference, overwrite=overwrite)
    drawn = draw_pictures(campaign, workers=workers)
    write_page(page, report_page(campaign, reference, pictures=drawn), overwrite=overwrite)
    if pictures:
        try:
            Path(pictures).mkdir(parents=True, exist_ok=True)
        except OSError as error:
            raise OutputError(f"cannot create the folder {pictures}: {error.strerror}") from error
        write_pictures(pictures, drawn, overwrite=overwrite)
    return report


def report_page(
    campaign: GatheredCampaign,
    reference: Reference | None = None,
    *,
    pictures: Sequence[MeasurementPictures] | None = None,
) -> str:
    """Return the page as text; ``pictures`` are those of `draw_pictures` (default: drawn here)."""
    collected, rows, main = FigureCollector(), summary_table(campaign, reference), campaign.main_measurements
    drawn = [*zip(campaign.measurements, pictures or draw_pictures(campaign), strict=True)]
    # Measurements with other calibrations come last.
    drawn.sort(key=lambda each: each[0] not in main)
    names, stripes = [measurement.name for measurement, _ in drawn], {}
    groups = sorted(_group_rows(rows), key=lambda group: names.index(group[0]) if group[0] in names else len(names))
    return render_page(
        "uwlts.report",
        "campaign.html.j2",
        interactive=collected,
        title=campaign.folder.resolve().name,
        introduction=introduction(campaign),
        conclusion=conclude(rows),
        key_figures=headline_tiles(campaign, reference),
        groups=groups,
        published=None if reference is None else reference.title,
        explanations=explanations(rows, reference),
        measurements=[_measurement(measurement, each, collected, stripes) for measurement, each in drawn],
        calibration=_calibrations(campaign) if campaign.calibrations else None,
        true_window=campaign.true_window_mm is not None,
        seconds=figure_svg(plot.seconds(campaign.seconds)) if campaign.seconds else None,
        seconds_in_all=sum(campaign.seconds.values()),
        provenance=_provenance(campaign),
    )


def _measurement(
    measurement: GatheredMeasurement,
    pictures: MeasurementPictures,
    collected: FigureCollector,
    stripes: dict[bytes, str],
) -> dict[str, Any]:
    """Return the parts of a measurement's section; missing ones are None.

    ``stripes`` are the pictures of stripes on the page so far, by measurement: one of the same images is not repeated.
    """
    cloud, judged = measurement.cloud, measurement.judged
    evaluation, truth = (None, None) if judged is None else (judged.evaluation, judged.truth)
    shown = figures = None
    if cloud is not None and pictures.cloud is not None:
        shown = collected.add_cloud(*cloud_points(cloud), still=webp_data_uri(pictures.cloud))
    if judged is not None and evaluation is not None:
        rows = []
        for name, value in evaluation.figures_mm.items():
            stated = judged.uncertainty[name].expanded_mm if name in judged.uncertainty else None
            values = format_length(value, signed="error" in name or "SSE" in name), format_length(stated)
            rows.append((name, "", values if judged.uncertainty else values[:1]))
        figures = ComparisonTable(("value", "U (k = 2)") if judged.uncertainty else ("value",), tuple(rows))
    stripe = pictures.stripe
    first = None if stripe is None else stripes.setdefault(stripe, measurement.name)
    recorded = measurement.capture is not None
    no_stripe = "no image of its capture shows a stripe" if recorded else "its capture is not in the folder"
    return {
        "name": measurement.name,
        "facts": _facts(measurement),
        "stripe": None if stripe is None or first != measurement.name else webp_data_uri(stripe),
        "same_stripe": first,
        "no_stripe": no_stripe,
        "cloud": shown,
        "histogram": pictures.histogram,
        "along": pictures.along,
        "deviation_from": "the artefact's fitted surface" if evaluation else "the true surface",
        "figures": figures,
        "truth": None if truth is None else _truth_table(truth),
    }


def _facts(measurement: GatheredMeasurement) -> list[tuple[str, str]]:
    judged, capture, cloud = measurement.judged, measurement.capture, measurement.cloud
    facts = []
    if judged is not None and judged.artefact is not None:
        artefact = judged.artefact.model_dump(mode="json", exclude_none=True)
        facts.append(("artefact", f"{artefact.pop('kind')}: {_pairs(artefact)}"))
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


def _truth_table(compared: TruthComparisons) -> ComparisonTable:
    """Return the distances to the true surface as measured and, if available, after the best fit."""
    columns = {"as measured": compared, "after best fit": compared.after_best_fit}
    shown = {heading: truth for heading, truth in columns.items() if truth is not None}
    texts = [
        {
            f"points within {1e3 * truth.tolerance_mm:g} µm": f"{100 * truth.share_within_tolerance:.2f} %",
            "mean distance": format_length(truth.mean_mm, signed=True),
            "standard deviation": format_length(truth.std_mm),
            "rms distance": format_length(truth.rms_mm),
            "95 % are closer than": format_length(truth.p95_mm),
            "99 % are closer than": format_length(truth.p99_mm),
            "largest distance": format_length(truth.largest_mm),
            "points compared": f"{truth.matched:,}",
            "points where no stripe is visible": f"{truth.false_points:,}",
            "visible stripe points not found": f"{truth.missed:,}",
        }
        for truth in shown.values()
    ]
    rows = [*zip(texts[0], zip(*(column.values() for column in texts), strict=True), strict=True)]
    stated = compared.shift_expanded_mm
    for number, shift in enumerate(compared.shift_mm or ()):
        text = format_length(shift, signed=True) + (f" ± {format_length(stated[number])}" if stated else "")
        rows.append((f"mean error along {'XYZ'[number]}, k = 2", (text, MISSING)[: len(shown)]))
    return ComparisonTable(tuple(shown), tuple((words, "", values) for words, values in rows))


def _calibrations(campaign: GatheredCampaign) -> dict[str, Any]:
    """Return the parts of the section about all calibrations."""
    by_name = {found.name: found.calibration for found in campaign.calibrations}
    warnings, groups = [], []
    for name, calibration in by_name.items():
        found = calibration.provenance.get("warnings")
        warnings += [(name, _value(text)) for text in found] if isinstance(found, list) else []
        plots = []
        for each in plot.residual_lists(calibration):
            words = split_name(each.name)
            caption = f"{each.group}: {words}." if each.group else f"{words}."
            caption = _CAPTIONS.get(f"{each.group} {each.name}", caption)
            plots.append((figure_svg(plot.residuals(calibration, which=each)), caption))
        groups.append({"name": name, "plots": plots})
    curve = svg_if_any(plot.window_curves, by_name, true_mm=campaign.true_window_mm)
    return {
        "parameters": parameter_table(campaign),
        "residuals": residual_table(campaign.calibrations),
        "warnings": warnings,
        "curve": curve,
        "groups": groups,
        "drawn": curve is not None or any(group["plots"] for group in groups),
    }


def _group_rows(rows: list[Row]) -> list[tuple[str, list[tuple[str, ...]]]]:
    """Group rows as text by measurement; the uncertainty follows the calibrated value."""
    groups: dict[str, list[tuple[str, ...]]] = {}
    for row in rows:
        name, quantity, true, *others = row.texts()
        if row.uncertainty:
            true = f"{true} ± {format_fixed(row.uncertainty)}"
        groups.setdefault(name, []).append((quantity, true, *others))
    return list(groups.items())


def _provenance(campaign: GatheredCampaign) -> list[tuple[str, str]]:
    libraries = ", ".join(f"{name} {version(name)}" for name in _LIBRARIES)
    entries = [("report", f"uwlts {__version__}, Python {platform.python_version()}, {libraries}")]
    for found in campaign.calibrations:
        entries.append((f"calibration {found.name}", f"digest {found.digest}; {_pairs(found.calibration.provenance)}"))
    for capture in campaign.captures:
        header = capture.header
        of = f"'{header.name}', sensor '{header.sensor.name}', {header.medium_name}"
        origin = _pairs(header.provenance) or "origin unknown"
        entries.append((f"capture {capture.path.name}", f"{of}; {origin}"))
    return entries


def _pairs(table: dict[str, Any]) -> str:
    return "; ".join(f"{split_name(key)} {_value(value)} {unit_of(key)}".rstrip() for key, value in table.items())


def _value(value: Any) -> str:
    match value:
        case list():
            return ", ".join(map(_value, value)) or "none"
        case dict():
            return f"({_pairs(value)})"
        case str():
            return value
        case float() if is_number(value):
            return f"{value:g}"
        case _:
            return json.dumps(value, ensure_ascii=False)


_EXPLANATIONS = {
    "sphere spacing": "Distance between the centres of spheres fitted to the points, each with its radius free "
    "(VDI/VDE 2634: SSE is its error).",
    "probing error PE": "Range of the points' distances from the fitted sphere without outliers (VDI/VDE 2634 allows "
    "0.3 % of outliers); the largest of several spheres.",
    "range error RE": "Range of the points' distances from the fitted plane.",
    "deviations STD": "Standard deviation of the points' distances from the fitted surface; the largest of several.",
    "deviations range": "Largest minus smallest distance of the points from the fitted surface.",
    "step height": "Mean distance of one face's points from the plane fitted to the other face.",
    "pipe diameter": "Diameter of the fitted cylinder.",
    "within": "Fraction of the points whose distance to the true surface, along its normal, is at most this.",
    "rms distance": "Root mean square of those distances. Only rendered captures have a true surface. A best fit "
    "rotates and translates the whole cloud, like alignment with a drawing.",
    "window distance": "From the camera's entrance pupil to the window's inner face, estimated from the images in "
    "water; the true value is that of the twin.",
    "interface distance": "With one refraction, a single interface represents the whole window; no true value of its "
    "distance exists.",
}
_PUBLISHED = (
    "Published values in mm for the same kind of measurement: errors if a calibrated value exists, else the quantity "
    "itself; several values are for several positions."
)


def headline_tiles(campaign: GatheredCampaign, reference: Reference | None) -> list[Tile]:
    """Return the key figures available in the campaign."""
    content = summary(campaign, reference)
    published, truth, window = content.published, content.truth, content.window_distance_mm
    tiles = []

    def add(name: str, value: str, note: str, theirs: str | None = None) -> None:
        if reference is not None and theirs:
            note += f"\n{reference.title}: {theirs}"
        tiles.append(Tile(name, value, note))

    for key, (name, _, _) in KEY_FIGURES.items():
        found, others = content.figure(key), None if published is None else published.figure(key)
        if found.mean_abs is None:
            continue
        count, theirs = len(found.by_measurement), None
        if others is not None and others.mean_abs is not None:
            fewer = len(others.by_measurement) < count
            theirs = format_length(others.mean_abs) + (f" for {len(others.by_measurement)} of them" if fewer else "")
        note = f"mean absolute value of {count} measurements" if count > 1 else "one measurement"
        add(name, format_length(found.mean_abs), note, theirs)
    if truth.share_within_tolerance is not None:
        # After the best-fit motion if there is one: the coordinate system depends on the calibration.
        fitted = truth.after_best_fit.share_within_tolerance
        note = f"rms distance {format_length(truth.rms_mm)}"
        if fitted is not None:
            note = (
                f"rms distance {format_length(truth.after_best_fit.rms_mm)} after a best-fit motion; in the sensor's "
                f"own coordinates {format_length(truth.rms_mm)}"
            )
        share = truth.share_within_tolerance if fitted is None else fitted
        add(f"Points within {1e3 * (truth.tolerance_mm or 0):g} µm of the truth", f"{100 * share:.2f} %", note)
    if window.estimated is not None:
        true = "" if window.true is None else f"true {format_fixed(window.true)} mm"
        theirs = "" if published is None else ", ".join(f"{value:g} mm" for value in published.window_distance_mm)
        add("Window distance", f"{format_fixed(window.estimated)} mm", true, theirs)
    return tiles


def conclude(rows: Sequence[Row]) -> str:
    """Return the date, and whether errors agree with the expanded uncertainties of both values (E_n at most 1)."""
    known = {
        f"{row.quantity} of {row.measurement}": normalise_error(row.error, row.stated, row.uncertainty)
        for row in rows
        if row.error is not None and row.stated
    }
    ratios = {name: value for name, value in known.items() if value is not None}
    today = datetime.now(UTC).date().isoformat()
    if not ratios:
        return f"{today}: no error has a stated uncertainty, so that none can be judged."
    worst, within = max(ratios, key=ratios.__getitem__), sum(each <= 1 for each in ratios.values())
    return (
        f"{today}: {within} of {len(ratios)} errors are within the expanded uncertainties of measured and true value; "
        f"the largest |E| / U (E_n of ISO/IEC 17043) is {ratios[worst]:.2f} ({worst})."
    )


def introduction(campaign: GatheredCampaign) -> list[tuple[str, str]]:
    """Return sensor, medium, calibration and origin of the images, one sentence each."""
    recorded = [m.capture for m in campaign.measurements if m.capture is not None] or list(campaign.captures)
    judged = [m.judged for m in campaign.measurements if m.judged is not None]
    indices = [text for m in campaign.measurements if (text := _index(m)) is not None]
    found = {
        "Sensor": [_sensor(capture) for capture in recorded] or [j.sensor for j in judged if j.sensor],
        "Medium": [_medium(capture) for capture in recorded] + indices,
        "Images": [_origin(capture) for capture in recorded],
    }
    facts = [(name, "; ".join(dict.fromkeys(texts))) for name, texts in found.items() if texts]
    main = campaign.main_calibration
    if main is not None:
        window, source = main.calibration.window, main.calibration.provenance.get("source")
        seen = "no window"
        if window is not None:
            model = (
                "glass plate with two refractions" if window.refractions == 2 else "taken as one refracting interface"
            )
            seen = f"window {format_fixed(window.distance_mm)} mm from the entrance pupil, {model}"
        facts.append(("Calibration", f"{main.name}: {seen}" + (f" ({source})" if source else "")))
    return facts


def explanations(rows: list[Row], reference: Reference | None) -> list[tuple[str, str]]:
    """Return explanations of the quantities in a table."""
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


def _index(measurement: GatheredMeasurement) -> str | None:
    """Return the index used for the points, by which calibration: it may differ from that of the description."""
    recorded = {} if measurement.cloud is None else measurement.cloud.metadata
    index = measurement.judged.medium_index if measurement.judged is not None else recorded.get("medium_index")
    by = "" if measurement.calibration is None else f" ({measurement.calibration.name})"
    return f"points calculated with n = {index:.5f} relative to air{by}" if is_number(index) else None


def _origin(capture: GatheredCapture) -> str:
    provenance = capture.header.provenance
    source = provenance.get("source")
    if source == "twin":
        effects = provenance.get("effects")
        return "rendered by the digital twin" + (", sharp and without noise" if effects == [] else "")
    return f"recorded by {source}" if isinstance(source, str) else "of unknown origin"
