"""Prediction of a sensor's uncertainty before it is built: rendered campaigns, measured by the sensor's software."""

import math
import shlex
import warnings
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any, Literal

import numpy as np
from markupsafe import Markup
from pydantic import BaseModel

from twin.recording.campaigns import record_campaigns, require_at_least
from twin.recording.command_lines import AT_ONCE, run_lines
from twin.recording.detection import Flaw, FlawFindings, ProbabilityOfDetection, collect_findings, deep_values, flaws_of
from twin.rendering_options import CPU, Variant
from twin.scene.campaign import Campaign, Take, list_takes, load_campaign, replace_values
from twin.scene.description import Scene, medium_of
from twin.scene.forms import PittedPipe, Weld
from twin.scene.motion import Motion
from twin.scene.stated_deviations import Understated, find_understated
from uwlts._version import __version__
from uwlts.errors import CaptureError, DescriptionError, DescriptionWarning
from uwlts.files.json_files import read_json, write_model
from uwlts.model.artefacts import PlaneStandard, parse_artefact
from uwlts.model.brief import Brief, align_columns
from uwlts.model.library import validate_description
from uwlts.pages.toolkit import BLUE, figure_svg, new_figure, render_page, write_page
from uwlts.runtime.progress import ProgressListener, ignore_progress
from uwlts.runtime.workers import open_workers

RESULT = "prediction.json"
PAGE = "prediction.html"
_STEP_IMAGES = 5
"""Fewer images of a step standard belong to a calibration; a scan has at least this many profiles."""
_CERTIFICATE = {
    "SSE": "spacing_uncertainty_mm",
    "diameter error": "diameter_uncertainty_mm",
    "height error": "height_uncertainty_mm",
}
"""Figures that are errors of a calibrated value, by the start of their names, and the key of its uncertainty."""

Inspected = Literal["flange", "pipe", "weld"]
"""Kind of object for `uwlts inspect`; a plane is the face of a flange."""


class PredictedFigure(BaseModel, frozen=True):
    """Errors of a figure in N measurements, with the uncertainties that the sensor's software states for them.

    Attributes
    ----------
    scan : str
        Recording of the campaign.
    name : str
        Name of the figure in an evaluation, such as "SSE" (sphere-spacing error), or a value of an inspection with
        "error", such as "ovality error".
    checked : str
        Where the statement was checked: scene, place, profiles and water.
    expanded_mm : tuple of N float
        Expanded uncertainty (k = 2) of every measurement, by propagation from calibration and noise of the stripe. It
        includes that of the calibrated value.
    errors_mm : tuple of N float
        Measured minus true value: one of every campaign, or of every pit or undercut found.
    """

    scan: str
    name: str
    checked: str
    expanded_mm: tuple[float, ...]
    errors_mm: tuple[float, ...]

    @property
    def predicted_mm(self) -> float:
        """Expanded uncertainty (k = 2) by propagation: the root mean square of all measurements."""
        return float(np.sqrt(np.mean(np.square(self.expanded_mm))))

    @property
    def found_mm(self) -> float:
        """Twice the root mean square of the errors found."""
        return 2.0 * float(np.sqrt(np.mean(np.square(self.errors_mm))))

    @property
    def covered(self) -> int:
        """Number of errors within their own expanded uncertainty."""
        return int(np.count_nonzero(np.abs(self.errors_mm) <= np.array(self.expanded_mm)))


class PredictedUncertainty(Brief, BaseModel, frozen=True):
    """Predicted uncertainties and probabilities of detection of a sensor, and the errors found in rendered campaigns.

    Attributes
    ----------
    campaign, sensor, as_built : str
        Names or paths of the descriptions.
    water : str or float or None
        Water of all scenes, by its name or turbidity; None for that of the scenes or the sensor.
    seeds : tuple of int
        Seeds of the campaigns.
    figures : tuple of PredictedFigure
        All figures with a known true value, by scan.
    detections : tuple of ProbabilityOfDetection
        Probabilities of detection, by kind and width of the flaws.
    understated : tuple of Understated
        Deviations of the campaign that are larger than the sensor states: U does not contain them.
    """

    campaign: str
    sensor: str
    as_built: str
    water: str | float | None = None
    seeds: tuple[int, ...]
    figures: tuple[PredictedFigure, ...]
    detections: tuple[ProbabilityOfDetection, ...] = ()
    understated: tuple[Understated, ...] = ()

    def covered_share(self) -> float:
        """Return the fraction of all errors within their expanded uncertainty."""
        return sum(each.covered for each in self.figures) / sum(len(each.errors_mm) for each in self.figures)

    def verdict(self) -> str:
        """Return the main result as a sentence."""
        if not self.figures:
            return "no errors to judge"
        share = f"{100 * self.covered_share():.0f} % of all errors are within U"
        doubted = ", ".join(each.quantity for each in self.understated)
        return f"{share}, which is too small: the sensor understates {doubted}" if doubted else share

    def validity(self) -> list[str]:
        """Return where each statement was checked, one line for each scan."""
        checked = {each.scan: each.checked for each in self.figures}
        checked |= {f"{each.flaw}s": each.checked for each in self.detections}
        return [f"{scan}: {text}" for scan, text in checked.items()]

    def lines(self) -> list[str]:
        """Return the result as lines of text."""
        figures = [
            (
                *(each.scan, each.name, f"{each.predicted_mm:.4f}", f"{each.found_mm:.4f}"),
                f"{each.covered} of {len(each.errors_mm)}",
            )
            for each in self.figures
        ]
        lines = [
            f"sensor {self.sensor}, built as {self.as_built}; campaigns {self.campaign}: {len(self.seeds)}",
            *align_columns([("scan", "figure", "U / mm", "found", "within U"), *figures], right=(2, 3)),
            self.verdict(),
            "U: expanded uncertainty (k = 2) by propagation; found: twice the rms error of the campaigns",
            *(f"understated: {each.text()}" for each in self.understated),
        ]
        if self.detections:
            lines += align_columns([_DETECTION_HEAD, *map(_detection_row, self.detections)], right=range(2, 7))
            lines += ["a90: depth found with 90 % probability; a90/95: its upper bound with 95 % confidence"]
        return [*lines, "valid for this sensor, and for imperfections as in the campaign, where it was checked:"] + [
            f"  {line}" for line in self.validity()
        ]


_DETECTION_HEAD = "flaw", "method", "width / mm", "found", "false", "a90 / mm", "a90/95", "limits"


def _detection_row(each: ProbabilityOfDetection) -> tuple[str, ...]:
    """Return the cells of a probability of detection."""
    depths = ("-" if depth is None else f"{depth:.3f}" for depth in (each.a90_mm, each.a90_95_mm))
    found = f"{sum(each.found)} of {len(each.found)}"
    return each.flaw, each.method, f"{each.width_mm:g}", found, str(each.false_calls), *depths, each.limits()


def predict(
    sensor: str | Path | None = None,
    *,
    campaign: str | Path = "prediction",
    water: str | float | None = None,
    out: str | Path | None = None,
    campaigns: int = 3,
    first: int = 0,
    every: int = 1,
    spp: int = 16,
    workers: int | None = None,
    overwrite: bool = False,
    variant: Variant = CPU,
    progress: ProgressListener = ignore_progress,
) -> PredictedUncertainty:
    """Predict the uncertainty of a sensor's measurements, and compare it with the errors in rendered campaigns.

    Every campaign has its own imperfections and noise. The sensor's software calibrates jointly, measures and
    states an uncertainty, which is compared with the errors. Pits, dents and undercuts of drawn depths give their
    probability of detection (MIL-HDBK-1823A). An interrupted run is resumed, and campaigns are added if the number is
    increased. OUT/prediction.html and prediction.json are written.

    Parameters
    ----------
    sensor
        Name or path of a sensor description, such as that of `uwlts radiometry`; default: the sensors of the campaign,
        as described and as built.
    campaign
        Name (see: twin scenes) or path of the campaign's description: a calibration, and scans of artefacts, pitted
        pipes or welds.
    water
        Optical properties of the water in all scenes: a name, or a turbidity from 0 (pure) to 3 (harbour). By default
        those of the scenes, else of the sensor.
    out
        Folder for campaigns and results (default: runs/predict-SENSOR). Complete recordings in it are kept.
    campaigns
        Number of campaigns.
    first
        Seed of the first campaign; the others follow.
    overwrite
        Render everything again.
    every, workers
        As for `record`.
    spp, variant
        As for `simulate`.
    progress
        Called with the number of images rendered, the total number, and the name of the stage.

    Returns
    -------
    PredictedUncertainty
        Uncertainties and errors by scan and figure.

    Raises
    ------
    DescriptionError
        An argument is out of its range, or the campaign has no calibration or no scan with a known truth.
    DesignError, OutputError, SetupError
        As `record_campaigns`.
    CommandFailed
        The sensor's software failed; its output gives the reason.
    CaptureError
        A result cannot be read.

    Warns
    -----
    DescriptionWarning
        The campaign deviates by more than the sensor's table ``[uncertainty]`` states. The warning comes before
        anything is rendered, and is repeated in the result.
    """
    require_at_least(1, campaigns=campaigns, every=every, workers=workers)
    require_at_least(0, first=first)
    described = load_campaign(campaign)
    if sensor is not None:
        described = replace_values(described, sensor=str(sensor), as_built=str(sensor))
    if water is not None:
        described = validate_description(Campaign, described.model_dump() | {"water": water}, str(campaign))
    folder = Path(out or Path("runs") / f"predict-{Path(described.sensor).stem}")
    evidence, scans = _sort_recordings(described, every)
    seeds = range(first, first + campaigns)
    takes = [{take.name: take for take in list_takes(described, seed=seed, every=every)} for seed in seeds]
    understated = find_understated(described, [*takes[0].values()])
    for each in understated:
        warnings.warn(each.text(), DescriptionWarning, stacklevel=2)
    folders = record_campaigns(
        described,
        folder,
        seeds=seeds,
        every=every,
        spp=spp,
        variant=variant,
        workers=workers,
        overwrite=overwrite,
        progress=progress,
    )
    by_folder = [_command_lines(place, evidence, scans) for place in folders]
    with open_workers(workers=AT_ONCE) as processes:
        for number, stage in enumerate(zip(*by_folder, strict=True)):
            progress(number, len(by_folder[0]), "evaluate")
            run_lines(processes, [line for lines in stage for line in lines], quiet=True)
    progress(len(by_folder[0]), len(by_folder[0]), "evaluate")
    detections, of_flaws = _read_flaws(scans, takes, folders)
    figures = [
        figure for scan in scans.values() for figure in (*_read_errors(scan, folders), *_read_values(scan, folders))
    ]
    result = PredictedUncertainty(
        campaign=str(campaign),
        sensor=described.sensor,
        as_built=described.as_built,
        water=water,
        seeds=tuple(seeds),
        figures=(*figures, *of_flaws),
        detections=detections,
        understated=understated,
    )
    write_model(folder / RESULT, result, file_format="twin-prediction", version=2, overwrite=True)
    write_page(folder / PAGE, _page(result), overwrite=True)
    return result


def _sort_recordings(campaign: Campaign, every: int) -> tuple[dict[str, list[str]], dict[str, Take]]:
    """Return the names of the recordings for each option of the calibration, and the scans by name."""
    evidence: dict[str, list[str]] = {"air": [], "water": [], "step": []}
    scans: dict[str, Take] = {}
    for take in list_takes(campaign, seed=0, every=every):
        if (option := _evidence_of(take)) is not None:
            evidence[option].append(take.name)
        elif take.scene.artefact is not None or _inspected_as(take.scene) is not None:
            scans[take.name] = take
    if not evidence["air"] and not evidence["water"]:
        raise DescriptionError(f"campaign {campaign.title!r} has no recording of a target for the calibration")
    if not scans:
        raise DescriptionError(f"campaign {campaign.title!r} has no scan of an artefact, a pitted pipe or a weld")
    return evidence, scans


def _evidence_of(take: Take) -> str | None:
    """Return the option of the calibration for which a recording was made; None for a scan."""
    if take.scene.target is not None:
        return "air" if take.sensor.medium(take.scene.medium).kind == "air" else "water"
    is_step = (take.scene.artefact or {}).get("kind") == "step"
    return "step" if is_step and take.scene.motion.images() < _STEP_IMAGES else None


def _inspected_as(scene: Scene) -> Inspected | None:
    """Return the kind of object for the inspection of a scene; None for an artefact that is only evaluated."""
    if (scene.artefact or {}).get("kind") == "plane":
        return "flange"
    kinds: dict[type, Inspected] = {PittedPipe: "pipe", Weld: "weld"}
    return next((kind for thing in scene.objects for of, kind in kinds.items() if isinstance(thing, of)), None)


def _is_evaluated(scene: Scene) -> bool:
    """Return whether a scene shows an artefact with a calibrated size."""
    return (scene.artefact or {}).get("kind") not in (None, "plane")


def _command_lines(folder: Path, evidence: dict[str, list[str]], scans: dict[str, Take]) -> tuple[list[str], ...]:
    """Return the command lines that calibrate, reconstruct, evaluate and inspect in a campaign's folder."""

    def quoted(name: str) -> str:
        return shlex.quote(str(folder / name))

    given = " ".join(
        f"--{option} {' '.join(quoted(f'{name}.h5') for name in names)}" for option, names in evidence.items() if names
    )
    calibration = quoted("calibration.json")
    judged: list[str] = []
    for scan, take in scans.items():
        cloud = quoted(f"{scan}.cloud.h5")
        if _is_evaluated(take.scene):
            judged.append(f"uwlts evaluate {cloud} --out {quoted(f'{scan}.evaluation.json')} --overwrite")
        if (kind := _inspected_as(take.scene)) is not None:
            judged.append(f"uwlts inspect {cloud} {kind} --out {quoted(f'{scan}.inspection.json')} --overwrite")
    return (
        [f"uwlts calibrate {given} --out {calibration} --overwrite"],
        [
            f"uwlts reconstruct {quoted(f'{scan}.h5')} --calibration {calibration} "
            f"--out {quoted(f'{scan}.cloud.h5')} --overwrite"
            for scan in scans
        ],
        judged,
    )


def _read_errors(take: Take, folders: list[Path]) -> Iterator[PredictedFigure]:
    """Yield the figures of a scan that are errors of a calibrated value; CaptureError if a result is incomplete."""
    if not _is_evaluated(take.scene):
        return
    scan = take.name
    results: list[dict[str, Any]] = [
        read_json(folder / f"{scan}.evaluation.json", called="evaluation") for folder in folders
    ]
    for name in results[0]["evaluation"]["figures_mm"]:
        key = next((key for start, key in _CERTIFICATE.items() if name.startswith(start)), None)
        if key is None:
            continue
        try:
            expanded = [
                math.hypot(each["uncertainty"][name]["expanded_mm"], each["artefact"].get(key) or 0.0)
                for each in results
            ]
            errors = [each["evaluation"]["figures_mm"][name] for each in results]
        except (KeyError, TypeError) as error:
            raise CaptureError(f"an evaluation of {scan} has no uncertainty of {name!r}") from error
        yield PredictedFigure(
            scan=scan, name=name, checked=_conditions(take), expanded_mm=tuple(expanded), errors_mm=tuple(errors)
        )


def _read_values(take: Take, folders: list[Path]) -> Iterator[PredictedFigure]:
    """Yield the flatness of an inspected plane, or diameter and ovality of a pipe if both were measured."""
    kind = _inspected_as(take.scene)
    if kind == "flange":
        plane = parse_artefact(take.scene.artefact)
        assert isinstance(plane, PlaneStandard)
        truth = {"flatness": plane.flatness_mm or 0.0}
    elif kind == "pipe":
        pipe = next(thing for thing in take.scene.objects if isinstance(thing, PittedPipe))
        truth = {"diameter": pipe.diameter_mm, "ovality": pipe.diameter_mm * pipe.ovality}
    else:
        return
    wholes = [_read_inspection(take, folder)["features"][0]["values"] for folder in folders]
    # Without an ovality, the interval of a diameter is that of an assumed largest ovality.
    if kind == "flange" or all("ovality" in whole for whole in wholes):
        for name, true in truth.items():
            values = [whole[name] for whole in wholes]
            yield PredictedFigure(
                scan=take.name,
                name=f"{name} error",
                checked=_conditions(take),
                expanded_mm=tuple(2 * math.hypot(each["random"], each["systematic"] or 0.0) for each in values),
                errors_mm=tuple(each["value"] - true for each in values),
            )


def _read_flaws(
    scans: dict[str, Take], takes: list[dict[str, Take]], folders: list[Path]
) -> tuple[tuple[ProbabilityOfDetection, ...], list[PredictedFigure]]:
    """Return the probabilities of detection, and the errors of the depths of all flaws."""
    groups: dict[tuple[Flaw, float, str], FlawFindings] = {}
    for scan, take in scans.items():
        if (kind := flaws_of(take.scene)) is None:
            continue
        group = *kind, _conditions(take)
        found = groups.setdefault(group, FlawFindings(*group))
        for drawn, folder in zip(takes, folders, strict=True):
            collect_findings(found, drawn[scan], _read_inspection(take, folder))
    detections, figures = [], []
    for found in groups.values():
        detections.append(found.detection())
        if values := list(deep_values(found, detections[-1])):
            figure = PredictedFigure(
                scan=f"{found.flaw}s",
                name=f"depth error, {found.width_mm:g} mm wide",
                checked=found.checked,
                expanded_mm=tuple(2 * std for _, std, _ in values),
                errors_mm=tuple(value - true for value, _, true in values),
            )
            figures.append(figure)
    return tuple(detections), figures


def _read_inspection(take: Take, folder: Path) -> dict[str, Any]:
    """Return the content of an inspection's file; CaptureError if it has no feature."""
    content = read_json(folder / f"{take.name}.inspection.json", called="inspection")
    if not content.get("features"):
        raise CaptureError(f"the inspection of {take.name} has found nothing")
    return content


def _conditions(take: Take) -> str:
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


def _page(result: PredictedUncertainty) -> str:
    """Return a page with the uncertainties and errors, and the probabilities of detection, as figures and tables."""
    figure, (axes,) = new_figure(8.0, 1.2 + 0.3 * len(result.figures))
    for row, each in enumerate(result.figures):
        axes.barh(row, 2 * each.predicted_mm, left=-each.predicted_mm, height=0.6, color=BLUE, alpha=0.25)
        axes.plot(each.errors_mm, [row] * len(each.errors_mm), "o", color=BLUE, markersize=4)
    axes.axvline(0.0, color="black", linewidth=0.5)
    axes.set_yticks(range(len(result.figures)), [f"{each.scan}, {each.name}" for each in result.figures])
    axes.invert_yaxis()
    axes.set_xlabel("measured minus true value, mm")
    count = len(result.seeds)
    water = [] if result.water is None else [("water", f"{result.water}")]
    return render_page(
        "twin.recording",
        "prediction.html.j2",
        sensor=Path(result.sensor).stem,
        verdict=f"{result.verdict()}, in {count} rendered campaign{'s' if count > 1 else ''}.",
        introduction=[
            ("sensor", result.sensor),
            ("built as", result.as_built),
            ("campaign", result.campaign),
            *water,
            ("seeds", f"{result.seeds[0]} to {result.seeds[-1]}"),
        ],
        understated=[each.text() for each in result.understated],
        figure=figure_svg(figure),
        rows=[
            (
                *(each.scan, each.name, f"{each.predicted_mm:.4f}", f"{each.found_mm:.4f}"),
                f"{each.covered} of {len(each.errors_mm)}",
            )
            for each in result.figures
        ],
        curves=_draw_curves(result.detections) if result.detections else None,
        detection_head=_DETECTION_HEAD,
        detections=[*map(_detection_row, result.detections)],
        validity=[line.split(": ", 1) for line in result.validity()],
        version=__version__,
    )


def _draw_curves(detections: Sequence[ProbabilityOfDetection]) -> Markup:
    """Draw the probability of detection against the depth, with all hits and misses, and a90/95 as dots."""
    from matplotlib.ticker import LogLocator

    figure, panels = new_figure(8.0, 2.6 * len(detections), rows=len(detections))
    for axes, each in zip(panels, detections, strict=True):
        depth = np.array(each.depths_mm)
        shown = np.geomspace(depth.min(), depth.max(), 200)
        axes.semilogx(shown, each.probability(shown), color=BLUE)
        axes.plot(depth, np.where(each.found, 1.0, 0.0), "|", color=BLUE)
        if each.a90_95_mm is not None:
            axes.plot([each.a90_95_mm], [0.9], "o", color=BLUE)
        axes.axhline(0.9, color="black", linewidth=0.5)
        axes.set_ylim(-0.05, 1.05)
        axes.xaxis.set_major_locator(LogLocator(subs=(1.0, 2.0, 5.0)))
        axes.xaxis.set_major_formatter("{x:g}")
        axes.xaxis.set_minor_formatter("")
        axes.set_title(f"{each.flaw}s, {each.width_mm:g} mm wide")
        axes.set_ylabel("probability of detection")
    panels[-1].set_xlabel("depth, mm")
    return figure_svg(figure)
