"""Figures of an experiment's scans: measured ones, true values of the twin's scenes, and published ones."""

import math
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any, Self

import numpy as np
from matplotlib.figure import Figure
from pydantic import BaseModel, model_validator

from twin.experiments.detection import FlawFindings, ProbabilityOfDetection, collect_findings, deep_values, flaws_of
from twin.experiments.runner import THESIS, Method, inspected_as
from twin.scene.campaign import Take
from twin.scene.description import Scene, medium_of
from twin.scene.forms import PittedPipe
from twin.scene.platforms import Motion
from uwlts.errors import CaptureError
from uwlts.files.json_files import read_json
from uwlts.model.artefacts import PipeStandard, PlaneStandard, SphereStandard, StepStandard, parse_artefact
from uwlts.model.library import find_description, read_table, validate_description
from uwlts.model.sensor import Description, Positive
from uwlts.pages.toolkit import BLUE, COLOURS, INK, RED, new_figure
from uwlts.storage.figure_table import FigureTable, MeasuredFigure, read_figures as read_table_of_figures

_AXES = "XYZ"
_RANGES = "PE", "RE"
"""Ranges that are also given without 0.3 % of the points, as VDI/VDE 2634 allows."""


def read_figures(folder: Path, takes: Mapping[str, Take], methods: Sequence[Method]) -> Iterator[MeasuredFigure]:
    """Yield the figures of a campaign's scans by all methods; CaptureError if a result is incomplete."""
    for method in methods:
        if method.suffix and method.made is None and method.calibration(folder).is_file():
            yield from _read_calibration(folder, method)
        if any(method.thesis.values()):
            yield from read_table_of_figures(method.result(folder, THESIS, "json")).rows
        for scan in method.scans:
            about = {"campaign": folder.name, "scan": scan, "method": method.name}
            if (path := method.result(folder, scan, "evaluation.json")).is_file():
                for row in _read_evaluation(path, takes[scan]):
                    yield MeasuredFigure(**about, **row)
            for row in _read_values(method, folder, takes[scan]):
                yield MeasuredFigure(**about, **row)


def _read_calibration(folder: Path, method: Method) -> Iterator[MeasuredFigure]:
    """Yield the window distance or the residual of one of several calibrations."""
    path = method.calibration(folder)
    content: dict[str, Any] = read_json(path, called="calibration")
    values = {"window distance": (content.get("window") or {}).get("distance_mm")}
    values["residual of Z"] = content.get("residuals", {}).get("depth", {}).get("rms_mm")
    for name, value in values.items():
        if value is not None:
            yield MeasuredFigure(
                campaign=folder.name, scan=path.stem, method=method.name, figure=name, measured_mm=value
            )


def _read_evaluation(path: Path, take: Take) -> Iterator[dict[str, Any]]:
    """Yield the figures of an evaluation: name, true and measured value, and expanded uncertainty."""
    content: dict[str, Any] = read_json(path, called="evaluation")
    calibrated = calibrated_values(take.scene)
    try:
        stated = content.get("uncertainty", {})
        found = content["evaluation"] or {"figures_mm": {}}
        for name, value in found["figures_mm"].items():
            if name in _RANGES:
                yield {"figure": f"{name}, 99.7 %", "measured_mm": found["vdi_range_mm"]}
            true, std = calibrated.get(name, (None, 0.0))
            known = stated.get(name)
            expanded = None if known is None else math.hypot(known["expanded_mm"], std)
            yield {"figure": name, "true_mm": true, "measured_mm": (true or 0.0) + value, "expanded_mm": expanded}
    except (KeyError, TypeError) as error:
        raise CaptureError(f"an evaluation of {take.name} is incomplete: {error}") from error
    if (truth := content.get("truth")) is not None:
        stated = truth.get("shift_expanded_mm") or (None,) * 3
        for axis, shift, expanded in zip(_AXES, truth["shift_mm"], stated, strict=True):
            yield {"figure": f"mean error {axis}", "true_mm": 0.0, "measured_mm": shift, "expanded_mm": expanded}
        for name, compared in {"as measured": truth, "after best fit": truth["after_best_fit"]}.items():
            yield {"figure": f"rms distance to truth, {name}", "measured_mm": compared["rms_mm"]}
        if content["evaluation"] is None:
            yield {"figure": "STD", "measured_mm": truth["after_best_fit"]["std_mm"]}


def calibrated_values(scene: Scene) -> dict[str, tuple[float, float]]:
    """Return calibrated sizes and their expanded uncertainties, mm, by the names of the figures that are their errors.

    The names are those of `uwlts evaluate`.
    """
    if scene.artefact is None:
        return {}
    match parse_artefact(scene.artefact):
        case SphereStandard() as spheres:
            sizes = {f"diameter error sphere {k}": size for k, size in enumerate(spheres.diameters_mm, start=1)}
            known = {name: (size, spheres.diameter_uncertainty_mm or 0.0) for name, size in sizes.items()}
            for k, spacing in enumerate(spheres.spacings_mm, start=1):
                pair = "" if len(spheres.spacings_mm) == 1 else f" {k}-{k + 1}"
                for name in (f"SSE{pair}", f"SSE{pair} known radius"):
                    known[name] = spacing, spheres.spacing_uncertainty_mm or 0.0
            return known
        case StepStandard() as step:
            return {"height error": (step.height_mm, step.height_uncertainty_mm or 0.0)}
        case PipeStandard() as pipe:
            return {"diameter error": (pipe.diameter_mm, pipe.diameter_uncertainty_mm or 0.0)}
        case PlaneStandard():
            return {}


def _read_values(method: Method, folder: Path, take: Take) -> Iterator[dict[str, Any]]:
    """Yield diameter and ovality of an inspected pipe if both were measured."""
    if not method.inspected or inspected_as(take.scene) != "pipe":
        return
    pipe = next(thing for thing in take.scene.objects if isinstance(thing, PittedPipe))
    truth = {"diameter": pipe.diameter_mm, "ovality": pipe.diameter_mm * pipe.ovality}
    whole = read_inspection(method, folder, take)["features"][0]["values"]
    # Without an ovality, the interval of a diameter is that of an assumed largest ovality.
    for name, true in truth.items() if "ovality" in whole else ():
        value = whole[name]
        expanded = 2 * math.hypot(value["random"], value["systematic"] or 0.0)
        yield {"figure": f"{name} error", "true_mm": true, "measured_mm": value["value"], "expanded_mm": expanded}


def read_inspection(method: Method, folder: Path, take: Take) -> dict[str, Any]:
    """Return the content of an inspection's file; CaptureError if it has no feature."""
    content = read_json(method.result(folder, take.name, "inspection.json"), called="inspection")
    if not content.get("features"):
        raise CaptureError(f"the inspection of {take.name} has found nothing")
    return content


def read_flaws(
    folders: Mapping[Path, Mapping[str, Take]], method: Method
) -> tuple[tuple[ProbabilityOfDetection, ...], list[MeasuredFigure]]:
    """Return the probabilities of detection in campaigns, and the depths of all flaws found.

    ``folders`` are those of the campaigns with their recordings by name.
    """
    groups: dict[tuple[Any, ...], FlawFindings] = {}
    campaigns: dict[tuple[Any, ...], list[str]] = {}
    for scan in method.scans if method.inspected else ():
        for folder, takes in folders.items():
            if (kind := flaws_of(takes[scan].scene)) is None:
                continue
            group = *kind, describe_conditions(takes[scan])
            found = groups.setdefault(group, FlawFindings(*group))
            before = len(found.values)
            collect_findings(found, takes[scan], read_inspection(method, folder, takes[scan]))
            campaigns.setdefault(group, []).extend([folder.name] * (len(found.values) - before))
    detections, figures = [], []
    for group, found in groups.items():
        detections.append(found.detection())
        name = f"depth error, {found.width_mm:g} mm wide"
        about = {"scan": f"{found.flaw}s", "method": method.name, "figure": name}
        deep = set(deep_values(found, detections[-1]))
        figures += [
            MeasuredFigure(campaign=campaign, true_mm=true, measured_mm=value, expanded_mm=2 * std, **about)
            for campaign, (value, std, true) in zip(campaigns[group], found.values, strict=True)
            if (value, std, true) in deep
        ]
    return tuple(detections), figures


def describe_conditions(take: Take) -> str:
    """Return where a statement about a scan was checked: scene, place, profiles and water."""
    scene, medium = take.scene, medium_of(take.sensor, take.scene)
    z = scene.placements[scene.placement].position_mm[2]
    place = "at the stand-off" if z == 0 else f"{abs(z):g} mm {'behind' if z > 0 else 'before'} the stand-off"
    spacing = f" {scene.motion.step_mm:g} mm apart" if isinstance(scene.motion, Motion) else ""
    wavelength = take.sensor.laser.wavelength_nm
    water = (
        f", {scene.medium} with a = {1e3 * medium.absorption_per_mm(wavelength):.2g}/m "
        f"and b = {1e3 * medium.scattering_per_mm(wavelength):.2g}/m"
    )
    return (
        f"{scene.title}, {place}, {scene.motion.images()} profiles{spacing}{water if medium.kind != 'air' else ', air'}"
    )


MEAN = "mean"  # name of the mean over a table's scans
LARGEST_RATIO = 1.5  # means of the experiment should be within this factor of the published ones


class PublishedFigure(BaseModel, frozen=True):
    """A published value and that of every campaign.

    Attributes
    ----------
    table, method, scan, figure : str
        Table, and the method, scan and figure as in the experiment; the scan is "mean" for the mean of a table.
    published : float
        Published value, in mm unless the figure states another unit.
    measured : tuple of float
        Absolute values of the campaigns; errors for figures with a known true value.
    """

    table: str
    method: str
    scan: str
    figure: str
    published: float
    measured: tuple[float, ...]

    @property
    def mean(self) -> float:
        """Mean over the campaigns."""
        return float(np.mean(self.measured))

    @property
    def ratio(self) -> float:
        """Mean divided by the published value."""
        return self.mean / self.published

    def texts(self) -> tuple[str, ...]:
        """Return table, scan, figure, published value, mean, range of the campaigns, and ratio."""
        low, high = min(self.measured), max(self.measured)
        values = f"{self.published:.4g}", f"{self.mean:.4g}", f"{low:.4g} to {high:.4g}", f"{self.ratio:.2f}"
        return self.table, self.scan, self.figure, *values


class _Table(Description):
    """Published values of one method: lists with one value for each scan, by figure.

    With ``depth_mm``, each list has the largest value of all scans instead, in % of this depth.
    """

    name: str
    method: str
    scans: tuple[str, ...]
    figures: dict[str, tuple[Positive, ...]]
    means: bool = True
    depth_mm: Positive | None = None

    @model_validator(mode="after")
    def _check_lengths(self) -> Self:
        wanted = len(self.scans) if self.depth_mm is None else 1
        for figure, values in self.figures.items():
            if len(values) != wanted:
                raise ValueError(f"{figure} has {len(values)} values; expected {wanted}, as there are scans")
        return self

    def compare(self, measured: dict[tuple[str, str, str], dict[str, float]]) -> Iterator[PublishedFigure]:
        """Yield the rows for values by scan, method and figure, and then by campaign."""
        for figure, published in self.figures.items():
            about = {"table": self.name, "method": self.method, "figure": figure}
            found = [measured.get((scan, self.method, figure), {}) for scan in self.scans]
            known = [each for each in found if each]
            complete = [campaign for campaign in known[0] if all(campaign in each for each in known)] if known else []
            columns = [[each[campaign] for each in known] for campaign in complete]
            if self.depth_mm is not None:
                if complete and len(known) == len(found):
                    share = tuple(100 * max(values) / self.depth_mm for values in columns)
                    about["figure"] = f"largest {figure}, % of the depth"
                    yield PublishedFigure(**about, scan="all scans", published=published[0], measured=share)
                continue
            for scan, value, values in zip(self.scans, published, found, strict=True):
                if values:
                    yield PublishedFigure(**about, scan=scan, published=value, measured=tuple(values.values()))
            if self.means and complete and len(found) > 1:
                theirs = float(np.mean([value for value, values in zip(published, found, strict=True) if values]))
                ours = tuple(float(np.mean(values)) for values in columns)
                yield PublishedFigure(**about, scan=MEAN, published=theirs, measured=ours)


class Publication(Description):
    """Published tables; see ``scenes/references/thesis-tables.toml``."""

    title: str
    tables: tuple[_Table, ...]

    def compare(self, table: FigureTable) -> tuple[PublishedFigure, ...]:
        """Return a row for every published value that the experiment has measured, and the means of the tables."""
        measured: dict[tuple[str, str, str], dict[str, float]] = {}
        for row in table.rows:
            value = row.measured_mm if row.error_mm is None else row.error_mm
            measured.setdefault((row.scan, row.method, row.figure), {})[row.campaign] = abs(value)
        return tuple(row for each in self.tables for row in each.compare(measured))


def load_published(name_or_path: str | Path) -> Publication:
    """Read published tables by name or path; DescriptionError if the file contains none."""
    path = find_description(name_or_path, "references")
    return validate_description(Publication, read_table(path, "references"), str(path))


def select_means(rows: Sequence[PublishedFigure]) -> list[PublishedFigure]:
    """Return the means over the scans of the tables, the main results of a reproduction."""
    return [row for row in rows if row.scan == MEAN]


def state_agreement(rows: Sequence[PublishedFigure]) -> str:
    """Return how many means of the tables are close to the published ones, as a sentence."""
    means = select_means(rows)
    close = sum(1 / LARGEST_RATIO <= row.ratio <= LARGEST_RATIO for row in means)
    return (
        f"{close} of {len(means)} means over the positions are within a factor of {LARGEST_RATIO} of the published ones"
    )


def draw_means(rows: Sequence[PublishedFigure]) -> Figure:
    """Draw the means of the tables: bars with the campaigns' range, blue in water, red in air; diamonds published."""
    shown = select_means(rows)
    figure, (axes,) = new_figure(9.0, 0.8 + 0.25 * len(shown))
    places = np.arange(len(shown))
    colours = [RED if row.table.endswith("in air") else BLUE for row in shown]
    axes.barh(places, [row.mean for row in shown], height=0.55, color=colours, alpha=0.75)
    axes.hlines(places, [min(row.measured) for row in shown], [max(row.measured) for row in shown], color=INK)
    axes.plot([row.published for row in shown], places, "D", color=COLOURS[1], markeredgecolor=INK)
    axes.set_yticks(places, [f"{row.table}: {row.figure}" for row in shown])
    axes.invert_yaxis()
    axes.set_xlim(left=0.0)
    axes.set_xlabel("mean of the campaigns / mm")
    return figure
