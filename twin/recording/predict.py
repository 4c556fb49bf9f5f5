"""Prediction of a sensor's uncertainty before it is built: rendered campaigns, measured by the sensor's software."""

import math
import shlex
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
from pydantic import BaseModel

from twin.recording.campaigns import record_campaigns, require_at_least
from twin.recording.command_lines import AT_ONCE, run_lines
from twin.rendering_options import CPU, Variant
from twin.scene.campaign import Campaign, Take, list_takes, load_campaign, replace_values
from uwlts._version import __version__
from uwlts.errors import CaptureError, DescriptionError
from uwlts.files.json_files import read_json, write_model
from uwlts.model.brief import Brief
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


class PredictedFigure(BaseModel, frozen=True):
    """Error of a figure in N campaigns, with the uncertainty that the sensor's software states for it.

    Attributes
    ----------
    scan : str
        Recording of the campaign.
    name : str
        Name of the figure in an evaluation, such as "SSE" (sphere-spacing error).
    expanded_mm : tuple of N float
        Expanded uncertainty (k = 2) of every campaign, by propagation from calibration and noise of the stripe. It
        includes that of the calibrated value.
    errors_mm : tuple of N float
        Measured minus true value of every campaign.
    """

    scan: str
    name: str
    expanded_mm: tuple[float, ...]
    errors_mm: tuple[float, ...]

    @property
    def predicted_mm(self) -> float:
        """Expanded uncertainty (k = 2) by propagation: the root mean square over all campaigns."""
        return float(np.sqrt(np.mean(np.square(self.expanded_mm))))

    @property
    def found_mm(self) -> float:
        """Twice the root mean square of the errors found."""
        return 2.0 * float(np.sqrt(np.mean(np.square(self.errors_mm))))

    @property
    def covered(self) -> int:
        """Number of campaigns with an error within their own expanded uncertainty."""
        return int(np.count_nonzero(np.abs(self.errors_mm) <= np.array(self.expanded_mm)))


class PredictedUncertainty(Brief, BaseModel, frozen=True):
    """Predicted uncertainties of a sensor, and the errors found in rendered campaigns.

    Attributes
    ----------
    campaign, sensor, as_built : str
        Names or paths of the descriptions.
    seeds : tuple of int
        Seeds of the campaigns.
    figures : tuple of PredictedFigure
        All figures that are errors of a calibrated value, by scan.
    """

    campaign: str
    sensor: str
    as_built: str
    seeds: tuple[int, ...]
    figures: tuple[PredictedFigure, ...]

    def covered_share(self) -> float:
        """Return the fraction of all errors within their expanded uncertainty."""
        return sum(each.covered for each in self.figures) / (len(self.figures) * len(self.seeds))

    def verdict(self) -> str:
        """Return the main result as a sentence."""
        return f"{100 * self.covered_share():.0f} % of all errors are within U"

    def lines(self) -> list[str]:
        """Return the result as lines of text."""
        count = len(self.seeds)
        widths = [
            max(map(len, texts)) for texts in zip(*((each.scan, each.name) for each in self.figures), strict=True)
        ]
        rows = [
            f"{each.scan:{widths[0]}}  {each.name:{widths[1]}}  {each.predicted_mm:9.4f}  {each.found_mm:9.4f}  "
            f"{each.covered} of {count}"
            for each in self.figures
        ]
        head = f"{'scan':{widths[0]}}  {'figure':{widths[1]}}  {'U / mm':>9}  {'found':>9}  within U"
        return [
            f"sensor {self.sensor}, built as {self.as_built}; campaigns {self.campaign}: {count}",
            head,
            *rows,
            self.verdict(),
            "U: expanded uncertainty (k = 2) by propagation; found: twice the rms error of the campaigns",
            "valid for this sensor, for these objects and places, and for imperfections as in the campaign",
        ]


def predict(
    sensor: str | Path | None = None,
    *,
    campaign: str | Path = "demo",
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
    states an uncertainty, which is compared with the errors. An interrupted run is resumed, and campaigns are added if
    the number is increased. OUT/prediction.html and prediction.json are written.

    Parameters
    ----------
    sensor
        Name or path of a sensor description; default: the sensors of the campaign, as described and as built.
    campaign
        Name (see: twin scenes) or path of the campaign's description: a calibration, and scans of artefacts.
    out
        Folder for campaigns and results (default: runs/predict-SENSOR). Complete recordings in it are kept.
    campaigns
        Number of campaigns.
    first
        Seed of the first campaign; the others follow.
    every
        Take only every n-th profile of the scans; calibrations keep all images.
    workers
        Number of parallel recordings (default: number of processors).
    overwrite
        Render everything again.
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
        An argument is out of its range, or the campaign has no calibration or no scan of an artefact.
    DesignError, OutputError, SetupError
        As `record_campaigns`.
    CommandFailed
        The sensor's software failed; its output gives the reason.
    CaptureError
        A result cannot be read.
    """
    require_at_least(1, campaigns=campaigns, every=every, workers=workers)
    require_at_least(0, first=first)
    described = load_campaign(campaign)
    if sensor is not None:
        described = replace_values(described, sensor=str(sensor), as_built=str(sensor))
    folder = Path(out or Path("runs") / f"predict-{Path(described.sensor).stem}")
    evidence, scans = _sort_recordings(described)
    seeds = range(first, first + campaigns)
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
    figures = tuple(figure for scan in scans for figure in _read_figures(scan, folders))
    result = PredictedUncertainty(
        campaign=str(campaign),
        sensor=described.sensor,
        as_built=described.as_built,
        seeds=tuple(seeds),
        figures=figures,
    )
    write_model(folder / RESULT, result, file_format="twin-prediction", version=1, overwrite=True)
    write_page(folder / PAGE, _page(result), overwrite=True)
    return result


def _sort_recordings(campaign: Campaign) -> tuple[dict[str, list[str]], list[str]]:
    """Return the names of the recordings for each option of the calibration, and of the scans of artefacts."""
    evidence: dict[str, list[str]] = {"air": [], "water": [], "step": []}
    scans: list[str] = []
    for take in list_takes(campaign, seed=0):
        if (option := _evidence_of(take)) is not None:
            evidence[option].append(take.name)
        elif take.scene.artefact is not None:
            scans.append(take.name)
    if not evidence["air"] and not evidence["water"]:
        raise DescriptionError(f"campaign {campaign.title!r} has no recording of a target for the calibration")
    if not scans:
        raise DescriptionError(f"campaign {campaign.title!r} has no scan of an artefact")
    return evidence, scans


def _command_lines(folder: Path, evidence: dict[str, list[str]], scans: list[str]) -> tuple[list[str], ...]:
    """Return the command lines that calibrate, reconstruct and evaluate in a campaign's folder."""

    def quoted(name: str) -> str:
        return shlex.quote(str(folder / name))

    given = " ".join(
        f"--{option} {' '.join(quoted(f'{name}.h5') for name in names)}" for option, names in evidence.items() if names
    )
    calibration = quoted("calibration.json")
    clouds = [(quoted(f"{scan}.h5"), quoted(f"{scan}.cloud.h5"), quoted(f"{scan}.evaluation.json")) for scan in scans]
    return (
        [f"uwlts calibrate {given} --out {calibration} --overwrite"],
        [
            f"uwlts reconstruct {capture} --calibration {calibration} --out {cloud} --overwrite"
            for capture, cloud, _ in clouds
        ],
        [f"uwlts evaluate {cloud} --out {result} --overwrite" for _, cloud, result in clouds],
    )


def _evidence_of(take: Take) -> str | None:
    """Return the option of the calibration for which a recording was made; None for a scan."""
    if take.scene.target is not None:
        return "air" if take.sensor.medium(take.scene.medium).kind == "air" else "water"
    is_step = (take.scene.artefact or {}).get("kind") == "step"
    return "step" if is_step and take.scene.motion.images() < _STEP_IMAGES else None


def _read_figures(scan: str, folders: list[Path]) -> Iterator[PredictedFigure]:
    """Yield the figures of a scan that are errors of a calibrated value; CaptureError if a result is incomplete."""
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
        yield PredictedFigure(scan=scan, name=name, expanded_mm=tuple(expanded), errors_mm=tuple(errors))


def _page(result: PredictedUncertainty) -> str:
    """Return a page with the uncertainties and errors as a figure and a table."""
    figure, (axes,) = new_figure(8.0, 1.2 + 0.3 * len(result.figures))
    for row, each in enumerate(result.figures):
        axes.barh(row, 2 * each.predicted_mm, left=-each.predicted_mm, height=0.6, color=BLUE, alpha=0.25)
        axes.plot(each.errors_mm, [row] * len(each.errors_mm), "o", color=BLUE, markersize=4)
    axes.axvline(0.0, color="black", linewidth=0.5)
    axes.set_yticks(range(len(result.figures)), [f"{each.scan}, {each.name}" for each in result.figures])
    axes.invert_yaxis()
    axes.set_xlabel("measured minus true value, mm")
    count = len(result.seeds)
    return render_page(
        "twin.recording",
        "prediction.html.j2",
        sensor=Path(result.sensor).stem,
        verdict=f"{result.verdict()}, in {count} rendered campaign{'s' if count > 1 else ''}.",
        introduction=[
            ("sensor", result.sensor),
            ("built as", result.as_built),
            ("campaign", result.campaign),
            ("seeds", f"{result.seeds[0]} to {result.seeds[-1]}"),
        ],
        figure=figure_svg(figure),
        rows=[
            (each.scan, each.name, f"{each.predicted_mm:.4f}", f"{each.found_mm:.4f}", f"{each.covered} of {count}")
            for each in result.figures
        ],
        version=__version__,
    )
