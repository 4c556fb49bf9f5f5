"""Figures of an experiment's scans: results of the sensor's software, with the true values of the twin's scenes."""

import math
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

from twin.experiments.detection import FlawFindings, ProbabilityOfDetection, collect_findings, deep_values, flaws_of
from twin.experiments.runner import THESIS, Method, inspected_as
from twin.scene.campaign import Take
from twin.scene.description import Scene, medium_of
from twin.scene.forms import PittedPipe
from twin.scene.platforms import Motion
from uwlts.errors import CaptureError
from uwlts.files.json_files import read_json
from uwlts.model.artefacts import PipeStandard, PlaneStandard, SphereStandard, StepStandard, parse_artefact
from uwlts.storage.figure_table import MeasuredFigure, read_figures as read_table

_AXES = "XYZ"
_RANGES = "PE", "RE"
"""Ranges that are also given without 0.3 % of the points, as VDI/VDE 2634 allows."""


def read_figures(folder: Path, takes: Mapping[str, Take], methods: Sequence[Method]) -> Iterator[MeasuredFigure]:
    """Yield the figures of a campaign's scans by all methods; CaptureError if a result is incomplete."""
    for method in methods:
        if method.suffix and method.made is None and method.calibration(folder).is_file():
            yield from _read_calibration(folder, method)
        if any(method.thesis.values()):
            yield from read_table(method.result(folder, THESIS, "json")).rows
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
    """Yield the flatness of an inspected plane, or diameter and ovality of a pipe if both were measured."""
    match inspected_as(take.scene) if method.inspected else None:
        case "flange":
            plane = parse_artefact(take.scene.artefact)
            assert isinstance(plane, PlaneStandard)
            truth = {"flatness": plane.flatness_mm or 0.0}
        case "pipe":
            pipe = next(thing for thing in take.scene.objects if isinstance(thing, PittedPipe))
            truth = {"diameter": pipe.diameter_mm, "ovality": pipe.diameter_mm * pipe.ovality}
        case _:
            return
    whole = read_inspection(method, folder, take)["features"][0]["values"]
    # Without an ovality, the interval of a diameter is that of an assumed largest ovality.
    for name, true in truth.items() if "ovality" in whole or "flatness" in truth else ():
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
    apart = f" {scene.motion.step_mm:g} mm apart" if isinstance(scene.motion, Motion) else ""
    wavelength = take.sensor.laser.wavelength_nm
    water = (
        f", {scene.medium} with a = {1e3 * medium.absorption_per_mm(wavelength):.2g}/m "
        f"and b = {1e3 * medium.scattering_per_mm(wavelength):.2g}/m"
    )
    return (
        f"{scene.title}, {place}, {scene.motion.images()} profiles{apart}{water if medium.kind != 'air' else ', air'}"
    )
