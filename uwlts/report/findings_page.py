"""Inspection report for the owner of the object: findings, pictures, uncertainty and traceability."""

from __future__ import annotations

import inspect
import os
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from datetime import UTC, date, datetime
from pathlib import Path
from typing import Any, Literal

import numpy as np
from matplotlib.colors import ListedColormap

from uwlts._version import __version__
from uwlts.errors import DescriptionError, EvaluationError
from uwlts.evaluation.evaluate import read_evaluation
from uwlts.evaluation.figures import Figure
from uwlts.files.json_files import EDITED, json_text
from uwlts.files.writing import hash_file, refuse_unsuitable, write_file
from uwlts.inspection.features import (
    BLEMISHES,
    COVERAGE,
    COVERAGE_FACTOR,
    DEFINITIONS,
    Feature,
    FeatureKind,
    FeatureValue,
    Inspection,
)
from uwlts.inspection.findings_order import (
    VERDICTS,
    FindingOrder,
    format_place,
    judge_feature,
    load_order,
    resolve_datum,
    sort_by_severity,
)
from uwlts.inspection.picking import COLUMNS, MEASURED_ENDINGS, MeasuredValues, read_measured
from uwlts.inspection.pipe import inspect_pipe
from uwlts.inspection.weld import inspect_weld
from uwlts.model.calibration import calibration_digest
from uwlts.model.sensor import Table
from uwlts.pages.toolkit import (
    INK,
    MISSING,
    RED,
    figure_png,
    format_to_scale,
    new_figure,
    png_data_uri,
    refuse_unsuitable_page,
    render_page,
    write_page,
)
from uwlts.report.certificate import check_certificate
from uwlts.report.plot import DEVIATIONS, surface_limit_mm
from uwlts.storage.calibration_file import load_calibration
from uwlts.storage.cloud import PointCloud, compute_normal_std
from uwlts.storage.cloud_files import load_cloud
from uwlts.storage.number_tables import Unit

_FIRST = ("depth", "height", "remaining wall")
"""Quantities in the first columns of the table of findings."""
_MAIN = _FIRST[:2]  # quantities in the first column of sizes
_SMALLEST = 1e-6  # smaller uncertainties are shown as 0
_SMALLEST_MM = 0.002  # precision that determines the decimals of figures without uncertainty
_MOST_PICTURES = 40  # the largest findings come first
FINDINGS = "findings"  # kind of the page, in the name of its JSON file
_MOST_DRAWN = 60_000  # points of a picture; more look the same
_VERDICT_COLOURS = dict(zip(VERDICTS, (RED, "#d9822b", "#2e8b57", INK), strict=True))
_SEEN = "#b9c0c8", "#d9822b", "#8fb8a0"
"""Colours of cells without points, with points that were not inspected, and with inspected ones."""
_CELL_POINTS, _MOST_CELLS = 4, 160
"""Mean number of points in a cell of the map of what was seen, and most cells along a side."""
InspectionKind = Literal["pipe", "weld"]
_INSPECTIONS: dict[InspectionKind, Callable[..., Inspection]] = {"pipe": inspect_pipe, "weld": inspect_weld}
_AROUND = 1.2  # size of the area shown around a finding, relative to the finding


@dataclass(frozen=True)
class Source:
    """A file on which the findings are based: role, name, SHA-256 digest, and a note."""

    role: str
    name: str
    sha256: str
    note: str


def write_findings(
    cloud: str | os.PathLike[str],
    kind: InspectionKind = "pipe",
    *,
    out: str | Path,
    pdf: bool = False,
    title: str | None = None,
    captures: Sequence[str | Path] = (),
    calibration: str | Path | None = None,
    certificate: str | Path | None = None,
    verification: Sequence[str | Path] = (),
    order: str | Path | None = None,
    measured: str | Path | None = None,
    unit: Unit | None = None,
    overwrite: bool = False,
    **options: Any,
) -> Inspection:
    """Inspect a cloud and write the report for the object's owner: a page, its content as JSON, and optionally a PDF.

    Parameters
    ----------
    cloud
        File of the object's cloud.
    kind
        Kind of the object.
    out
        Page to write; the JSON is written beside it, for pipe.html to pipe.findings.json.
    pdf
        Also print the page to a PDF beside it, with an installed Chromium or Chrome.
    title
        Title of the report (default: the order's object, else "Inspection of" and the cloud's name).
    captures
        Captures from which the cloud was reconstructed, for traceability.
    calibration
        Calibration of the sensor; it must be the one named by the cloud.
    certificate
        Certificate (JSON) of the calibration, whose seal is checked.
    verification
        Evaluations (JSON of uwlts evaluate) of artefacts measured with the same calibration; their figures are
        reported.
    order
        TOML file with client, object, report, revision, operator, checked_by, approved_by, date, sensor, water, and the
        tables ``datum`` (name, place_mm,
        direction, twelve_o_clock) and ``limits`` (depth_mm, remaining_wall_mm, ovality_percent, undercut_mm), by which
        findings are judged.
    measured
        List of values measured by hand (NAME.measured.json of the desk), shown as a table.
    unit
        Unit of a cloud of another program, mm or m, if neither format nor names of columns state it; by default mm.
    overwrite
        Replace existing files.
    **options
        Options of the inspection: `uwlts.inspect_pipe`, `uwlts.inspect_weld`.

    Returns
    -------
    Inspection
        What the report is about, as from ``uwlts.inspect_pipe`` or ``uwlts.inspect_weld``.

    Raises
    ------
    OutputError
        A file exists and ``overwrite`` is not given, or cannot be written.
    CaptureError, CalibrationError, DescriptionError
        A file cannot be read.
    EvaluationError
        The cloud does not show such an object, or does not belong to the calibration, certificate or verification.
    SetupError
        A PDF is requested, but no browser is installed.
    """
    page, path = Path(out), Path(cloud)
    refuse_unsuitable_page(page, kind=FINDINGS, pdf=pdf, overwrite=overwrite)
    stated = load_order(order)
    points = load_cloud(path, unit=unit)
    by_hand = None if measured is None else read_measured(measured)
    sources = _list_sources(path, points, captures, calibration, certificate)
    checks = [_find_artefact_check(each, points) for each in verification]
    sources += [
        Source("verification", Path(each).name, hash_file(each), "by the same calibration") for each in verification
    ]
    if measured is not None and by_hand is not None:
        note = f"measured by hand{', edited' if by_hand.edited else ''}"
        sources.append(Source("measured values", Path(measured).name, hash_file(measured), note))
    found = inspect_cloud(points, kind, **options)
    if kind == "pipe" and (note := resolve_datum(stated.datum, found.features[0].axes[2])[2]):
        found = replace(found, notes=(*found.notes, note))
    made, title = datetime.now(UTC), title or stated.object or f"Inspection of {path.name}"
    text = _render(found, points, sources, checks, stated, by_hand, title=title, made=made)
    record: Table = {
        "title": title,
        "made": made.isoformat(timespec="seconds"),
        "software": f"uwlts {__version__}",
        "sources": [vars(source) for source in sources],
        "verification": [
            {
                "artefact": artefact,
                "figures": [
                    {
                        "name": each.key.name,
                        "calibrated_mm": each.calibrated_mm,
                        "value_mm": each.value_mm,
                        "expanded_mm": each.expanded_uncertainty_mm,
                    }
                    for each in figures
                ],
            }
            for artefact, figures in checks
        ],
        "order": stated.model_dump(mode="json", exclude_none=True),
        "verdicts": {each.name: judge_feature(each, stated.limits)[0] for each in found.features},
        "measured": [] if by_hand is None else by_hand.model_dump(mode="json")["values"],
        "inspection": found.record(),
    }
    write_page(page, text, beside=json_text(record, indent=1), kind=FINDINGS, pdf=pdf, overwrite=overwrite)
    return found


def inspect_cloud(cloud: PointCloud | str | os.PathLike[str], kind: InspectionKind, **options: object) -> Inspection:
    """Inspect a cloud as a kind of object; EvaluationError for an option that this kind does not have."""
    function = _INSPECTIONS[kind]
    if foreign := [f"`{name}`" for name in options if name not in inspect.signature(function).parameters]:
        raise EvaluationError(f"the inspection of a {kind} does not take {', '.join(foreign)}: remove the option")
    return function(cloud, **options)


def write_measured(page: str | Path, measured: MeasuredValues, *, title: str, overwrite: bool = False) -> list[Path]:
    """Write values measured by hand as a page NAME.measured.html, and beside it as JSON and CSV; return the paths.

    Raises DescriptionError if the list is empty; OutputError if a file exists and ``overwrite`` is not set, or cannot
    be written.
    """
    if not measured.values:
        raise DescriptionError("the list of measured values is empty: measure something first")
    paths = [Path(page).with_suffix(Path(each).suffix) for each in MEASURED_ENDINGS]
    for path, ending in zip(paths, MEASURED_ENDINGS, strict=True):
        refuse_unsuitable(path, overwrite=overwrite, endings=(ending,))
    rows = [each.row() for each in measured.values]
    text = render_page("uwlts.report", "measured.html.j2", title=title, columns=COLUMNS, rows=rows)
    measured.save(paths[1], overwrite=overwrite)
    write_file(paths[2], measured.table(), overwrite=overwrite)
    write_page(paths[0], text, overwrite=overwrite)
    return paths


def _list_sources(
    path: Path,
    cloud: PointCloud,
    captures: Sequence[str | Path],
    calibration: str | Path | None,
    certificate: str | Path | None,
) -> list[Source]:
    named = cloud.metadata.get("calibration")
    text = ", ".join(f"{key} {cloud.metadata[key]}" for key in ("sensor", "medium") if cloud.metadata.get(key))
    sources = [Source("cloud", path.name, hash_file(path), f"{len(cloud):,} points{', ' + text if text else ''}")]
    for each in captures:
        same = Path(each).name == cloud.metadata.get("capture")
        sources.append(Source("capture", Path(each).name, hash_file(each), "named by the cloud" if same else ""))
    if calibration is not None:
        known = load_calibration(calibration)
        digest, edited = calibration_digest(known), ", edited" if EDITED in known.provenance else ""
        if named is not None and named != digest:
            raise EvaluationError(
                f"the cloud {path.name} was reconstructed by another calibration than {calibration}: it names "
                f"{str(named)[:12]}..., and this one has {digest[:12]}...; give the calibration that it was made with"
            )
        note = "the one that the cloud names" if named == digest else "the cloud names no calibration"
        sources.append(Source("calibration", Path(calibration).name, hash_file(calibration), note + edited))
    if certificate is not None:
        if calibration is None:
            raise EvaluationError("a certificate belongs to a calibration: give that, too")
        if problems := check_certificate(certificate, calibration):
            raise EvaluationError(f"the certificate {certificate} is not valid: {'; '.join(problems)}")
        sources.append(Source("certificate", Path(certificate).name, hash_file(certificate), "its seal is intact"))
    return sources


def _find_artefact_check(path: str | Path, cloud: PointCloud) -> tuple[str, tuple[Figure, ...]]:
    """Return name and figures of an artefact that was measured with the calibration named by the cloud."""
    record, named = read_evaluation(path), cloud.metadata.get("calibration")
    if record.artefact is None or record.evaluation is None:
        raise EvaluationError(f"{path} is not an evaluation of an artefact: give that of spheres, a step or a plane")
    if named is None or record.calibration != named:
        raise EvaluationError(
            f"{path} is of a cloud made by another calibration: it names {str(record.calibration)[:12]}, the cloud "
            f"{str(named)[:12]}; measure the artefact with the calibration in use"
        )
    return f"{record.evaluation.kind}, {record.source}{', edited' if record.edited else ''}", record.figures


def _check_row(figure: Figure) -> tuple[str, ...]:
    expanded = figure.expanded_uncertainty_mm
    fine = expanded or _SMALLEST_MM
    calibrated = MISSING if figure.calibrated_mm is None else f"{figure.calibrated_mm:g}"
    stated = MISSING if expanded is None else format_to_scale(expanded, fine)
    return figure.key.name.replace("_", " "), calibrated, format_to_scale(figure.value_mm, fine), stated


def _render(
    found: Inspection,
    cloud: PointCloud,
    sources: list[Source],
    checks: list[tuple[str, tuple[Figure, ...]]],
    order: FindingOrder,
    by_hand: MeasuredValues | None,
    *,
    title: str,
    made: datetime,
) -> str:
    parts = [each for each in found.features if each.kind in BLEMISHES]
    whole = [each for each in found.features if each.kind not in (*BLEMISHES, FeatureKind.SECTION)]
    repeated = found.select(FeatureKind.SECTION)
    limited = [each for each in whole if judge_feature(each, order.limits)[0] != "no limit"]
    parts, listed = (sort_by_severity(each, order.limits) for each in (parts, [*parts, *limited]))
    drawn = parts[:_MOST_PICTURES]
    kinds = list(dict.fromkeys(each.kind for each in found.features))
    depths = sorted(COVERAGE_FACTOR * each[name].uncertainty for each in parts for name in _MAIN if name in each)
    return render_page(
        "uwlts.report",
        "findings.html.j2",
        title=title,
        made=f"{_format_date(made)}, {made:%H:%M} UTC",
        order=order,
        scanned=order.date and _format_date(order.date),
        limits=[
            f"{name.rpartition('_')[0].replace('_', ' ')} {value:g} {name.rpartition('_')[2].replace('percent', '%')}"
            for name, value in order.limits.model_dump(exclude_none=True).items()
        ],
        metadata=cloud.metadata,
        sources=sources,
        conclusion=_conclude(listed, order, found),
        findings=_list_findings(listed, found, cloud, order) if listed else None,
        all_values=_list_features(parts),
        whole=[(each.name, [_make_value_row(value) for value in each.values]) for each in whole],
        repeated=_list_features(repeated),
        by_hand=None if by_hand is None else (COLUMNS, [each.row() for each in by_hand.values]),
        maps=_make_maps(found, cloud, parts, order),
        accuracy=_state_point_accuracy(cloud),
        depths=[format_to_scale(each, each) for each in dict.fromkeys((*depths[:1], *depths[-1:]))],
        pictures=[
            (each.title, judge_feature(each, order.limits)[0], _plot_finding(each, found, cloud)) for each in drawn
        ],
        left_out=len(parts) - len(drawn),
        notes=found.notes,
        checks=[(artefact, list(map(_check_row, figures))) for artefact, figures in checks],
        stated=cloud.uncertainty is not None,
        searched=found.kind == "pipe",
        coverage=f"{100 * COVERAGE:.0f} %",
        factor=f"{COVERAGE_FACTOR:g}",
        definitions=[
            (str(kind), name, known.unit, known.text, known.source)
            for kind in kinds
            for name, known in DEFINITIONS[kind].items()
            if any(name in each for each in found.features if each.kind == kind)
        ],
    )


def _format_date(day: date) -> str:
    return f"{day.day} {day:%B %Y}"


def _conclude(listed: Sequence[Feature], order: FindingOrder, found: Inspection) -> tuple[str, str]:
    """Return the most severe verdict, and the numbers of findings by verdict and of points without any as text."""
    verdicts = [judge_feature(each, order.limits)[0] for each in listed]
    counts = [f"{verdicts.count(each)} × {each}" for each in VERDICTS if each in verdicts]
    worst = min(verdicts, key=VERDICTS.index, default=VERDICTS[-1])
    text = f"Findings: {', '.join(counts)}." if listed else "No finding."
    omitted = round(100 * float(np.mean(np.isnan(found.deviation_mm)))) if found.kind == "pipe" else 0
    return worst, f"{text} {omitted} % of the points are not inspected." if omitted else text


def _list_findings(
    listed: Sequence[Feature], found: Inspection, cloud: PointCloud, order: FindingOrder
) -> tuple[tuple[str, ...], list[tuple[str, tuple[str, ...]]]]:
    """Return headings and rows of the first page: verdict, and texts on verdict, place and size of every finding."""
    whole, rows = found.features[0], []
    for each in listed:
        verdict, names = judge_feature(each, order.limits)
        at = format_place(each, whole, cloud.points_mm, order.datum) if each is not whole else (MISSING, MISSING)
        size = {value.name: format_interval(value) for value in each.values}
        first = next(iter(names), each.values[0].name)
        said = f"{verdict} ({', '.join(names)})" if names else verdict
        said = f"{said}; {each.reason}" if each.reason else said
        main = next((size[name] for name in _MAIN if name in size), f"{first} {size[first]}")
        more = tuple(size.get(name, MISSING) for name in ("remaining wall", "length", "width"))
        rows.append((verdict, (each.title, said, *at, main, *more)))
    heads = "finding", "verdict", "clock", "from datum / mm", "depth or height / mm"
    return (*heads, "remaining wall / mm", "length / mm", "width / mm"), rows


def format_interval(value: FeatureValue) -> str:
    """Return a value with its 95 % coverage interval as text, with two digits of the uncertainty and no unit."""
    half = COVERAGE_FACTOR * value.uncertainty
    if value.bound:
        text, number = value.bound
        return f"{text} {format_to_scale(number, max(half, _SMALLEST_MM))}"
    if half <= _SMALLEST:
        return f"{value.value:.4g}"
    shown = format_to_scale(value.value, half)
    if value.low > value.value - 0.9 * half:
        # The interval of a non-negative value is asymmetric.
        return f"{shown} ({format_to_scale(value.low, half)} to {format_to_scale(value.high, half)})"
    return f"{shown} ± {format_to_scale(half, half)}"


def _make_value_row(value: FeatureValue) -> tuple[str, ...]:
    parts = value.random, value.systematic
    fine = [MISSING if part is None else format_to_scale(part, part) if part > _SMALLEST else "0" for part in parts]
    return value.name, value.unit, format_interval(value), *fine


def _list_features(features: Sequence[Feature]) -> tuple[tuple[str, ...], list[tuple[str, ...]]] | None:
    """Return headings and rows of features; None without features."""
    if not features:
        return None
    units = {value.name: value.unit for each in features for value in each.values}
    units = {name: units[name] for name in (*(n for n in _FIRST if n in units), *(n for n in units if n not in _FIRST))}
    rows = []
    for each in features:
        place = " ".join(f"{number:.1f}" for number in each.place_mm)
        rows.append((each.title, place, *(format_interval(each[name]) if name in each else MISSING for name in units)))
    return ("finding", "place / mm", *(f"{name} / {unit}" for name, unit in units.items())), rows


def _make_maps(
    found: Inspection, cloud: PointCloud, parts: list[Feature], order: FindingOrder
) -> tuple[str, str, list[str]]:
    """Plot all points by their deviation, and what was seen and inspected; say in sentences what was not.

    A pipe is unrolled along its axis, other objects are shown in X and Y, with the longer side along the page.
    """
    pipe = next((each for each in found.features if each.kind == FeatureKind.PIPE), None)
    labels = ["X / mm", "Y / mm"] if pipe is None else ["along the axis / mm", "around the circumference / mm"]
    middle = cloud.points_mm.mean(axis=0)
    at = _compute_map_coordinates(cloud.points_mm, pipe, middle)
    marks = _compute_map_coordinates(np.array([each.place_mm for each in parts]).reshape(-1, 3), pipe, middle)
    ends = [(side.min(), side.max()) for side in at]
    if pipe:
        ends[1] = -np.pi * pipe["diameter"].value / 2, np.pi * pipe["diameter"].value / 2
    # Cells have some points on average, and are not narrower than the distance of the profiles.
    profile = np.unique(cloud.frame, return_inverse=True)[1]
    apart = np.diff(np.sort(np.bincount(profile, at[0]) / np.bincount(profile)))
    narrowest = 1.5 * float(np.median(apart)) if len(apart) else 0.0
    cell = max(float(np.sqrt(_CELL_POINTS * np.prod(np.ptp(at, axis=1)) / len(cloud))), narrowest)
    if np.ptp(at[1]) > np.ptp(at[0]):
        at, marks, labels, ends = at[::-1], marks[::-1], labels[::-1], ends[::-1]
    inspected = np.isfinite(found.deviation_mm)
    shown = np.flatnonzero(inspected)[:: max(1, np.count_nonzero(inspected) // _MOST_DRAWN)]
    # Equal scales; points are as large as their distances.
    height = 7.2 * float(np.ptp(at[1]) / max(np.ptp(at[0]), 1e-9))
    figure, (axes,) = new_figure(8.0, height + 1.5)
    size = float(np.clip(1.5 * height * 7.2 * 72**2 / max(len(shown), 1), 1, 60))
    colours = axes.scatter(*at[:, shown], c=found.deviation_mm[shown], rasterized=True, s=size, **_scale_colour(found))
    figure.colorbar(colours, ax=axes, label="above the undamaged surface / mm", orientation="horizontal", aspect=50)
    for each, place in zip(parts, marks.T, strict=True):
        colour = _VERDICT_COLOURS[judge_feature(each, order.limits)[0]]
        axes.annotate(each.name, tuple(place), xytext=(8, 8), textcoords="offset points", fontsize=8, color=INK)
        axes.plot(*place, "o", markersize=14, markerfacecolor="none", markeredgecolor=colour, markeredgewidth=1.8)
    axes.set(xlabel=labels[0], ylabel=labels[1], aspect="equal")
    cells = [int(np.clip((high - low) / cell, 4, _MOST_CELLS)) for low, high in ends]
    every, own = (np.histogram2d(*at[:, some], bins=cells, range=ends)[0] > 0 for some in (slice(None), inspected))
    seen, (axes,) = new_figure(8.0, 1.9)
    (left, right), (low, high) = ends
    states, how = (every.astype(int) + own).T, {"cmap": ListedColormap(_SEEN), "vmin": 0, "vmax": 2}
    axes.imshow(states, extent=(left, right, low, high), origin="lower", **how)
    axes.set(xlabel=labels[0], ylabel=labels[1], aspect="auto")
    axes.grid(visible=False)
    whole = "circumference over the scanned length" if pipe else "rectangle around all points"
    said = [f"{100 * np.mean(~every):.0f} % of the {whole} have no points (grey; cells of {cell:.2g} mm)."]
    if (omitted := np.mean(every & ~own)) > 0:
        said.append(f"{100 * omitted:.1f} % were seen but not inspected (orange), for the reasons below.")
    if cut := [each.name for each in parts if each.reason]:
        said.append(f"Not seen whole or not sized, with bounds instead of intervals: {', '.join(cut)}.")
    return png_data_uri(figure, dpi=130), png_data_uri(seen, dpi=110), said


def _scale_colour(found: Inspection) -> dict[str, Any]:
    """Return the one scale of the map and of all pictures of findings."""
    limit = surface_limit_mm(found.deviation_mm)
    return {"cmap": DEVIATIONS, "vmin": -limit, "vmax": limit, "linewidths": 0}


def _state_point_accuracy(cloud: PointCloud) -> list[str] | None:
    """Return the expanded uncertainty of points across the surface; None if the cloud does not know it.

    The texts are the median, those of its random and common parts, and the 95 % quantile, in mm.
    """
    random, common = compute_normal_std(cloud)
    if random is None or common is None:
        return None
    every = COVERAGE_FACTOR * np.hypot(random, common)
    typical = [float(np.median(each)) for each in (every, COVERAGE_FACTOR * random, COVERAGE_FACTOR * common)]
    return [format_to_scale(each, typical[0]) for each in (*typical, float(np.quantile(every, COVERAGE)))]


def _compute_map_coordinates(points: np.ndarray, pipe: Feature | None, middle: np.ndarray) -> np.ndarray:
    """Return map coordinates (2, N) of points: along and around a pipe, centred at ``middle`` (3,), else X and Y."""
    if pipe is None:
        return points[:, :2].T
    away, side = ((some - pipe.place_mm) @ pipe.axes.T for some in (points, middle))
    angle = np.arctan2(away[:, 1], away[:, 0]) - np.arctan2(side[1], side[0])
    return np.array([away[:, 2], (np.remainder(angle + np.pi, 2 * np.pi) - np.pi) * pipe["diameter"].value / 2])


def _plot_finding(feature: Feature, found: Inspection, cloud: PointCloud) -> str:
    """Plot a finding from above with outline, neighbours and scale, and in a section through the deepest point."""
    local = (cloud.points_mm - feature.place_mm) @ feature.axes.T
    half = np.maximum(_AROUND * feature.extent_mm[:2], 2.0)
    near = np.isfinite(found.deviation_mm) & (np.abs(local[:, :2]) < half).all(axis=1)
    # Exclude the opposite side of a pipe.
    deep = max(2 * float(half.max()), 5.0)
    near &= np.abs(local[:, 2]) < deep
    local, deviation = local[near], found.deviation_mm[near]
    figure, (above, cut) = new_figure(7.4, 2.4, columns=2)
    size = float(np.clip(25_000 / max(len(local), 1), 2, 40))
    colours = above.scatter(local[:, 0], local[:, 1], c=deviation, s=size, **_scale_colour(found))
    figure.colorbar(colours, ax=above, label="deviation / mm")
    for other in found.select(*BLEMISHES):
        outline = (other.outline_mm - feature.place_mm) @ feature.axes.T
        shown = len(outline) > 0 and bool((np.abs(outline) < [*half, deep]).all(axis=1).any())
        if not shown:
            continue
        current = other is feature
        above.plot(*outline[:, :2].T, color=RED if current else INK, linewidth=1.4 if current else 0.9)
        if not current:
            at = np.clip(outline[:, :2].mean(axis=0), -0.85 * half, 0.85 * half)
            above.annotate(other.name, tuple(at), fontsize=8, ha="center", color=INK)
    for place in (feature.hollows_mm - feature.place_mm) @ feature.axes.T:
        above.plot(*place[:2], "+", color=RED, markersize=9)
    bar = float(f"{half[0] / 2:.0e}")
    left, low = -0.92 * half
    above.plot([left, left + bar], [low, low], color=INK, linewidth=3, solid_capstyle="butt")
    above.annotate(f"{bar:g} mm", (left, low), xytext=(0, 4), textcoords="offset points", fontsize=8, color=INK)
    ends: dict[str, Any] = {"xlim": (-half[0], half[0]), "ylim": (-half[1], half[1])}
    above.set(xlabel="along its length / mm", ylabel="across / mm", aspect="equal", **ends)
    width = max(0.15 * float(feature.extent_mm[1]), 0.5)
    inside = np.abs(local[:, 1]) < width
    cut.plot(local[inside, 0], deviation[inside], ".", markersize=3)
    cut.axhline(0, color=INK, linewidth=0.8)
    value = feature.values[0]
    sign = 1 if feature.kind == FeatureKind.PROTRUSION else -1
    cut.axhline(sign * (value.bound[1] if value.bound else value.value), color=RED, linewidth=1)
    cut.set(xlabel="along its length / mm", ylabel="deviation / mm")
    cut.set_title(f"{value.name} {format_interval(value)} {value.unit}; cut ±{width:.2g} mm", fontsize=8)
    return png_data_uri(figure_png(figure, dpi=110, few_colours=True))
