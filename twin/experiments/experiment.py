"""Experiments with rendered campaigns: a sensor measures scenes, and its errors are compared with its uncertainties."""

import warnings
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import tomli_w

from twin.experiments.figures import describe_conditions, load_published, read_figures, read_flaws
from twin.experiments.result import ExperimentResult
from twin.experiments.runner import COLOURED, Method, evidence_of, inspected_as, plan_lines, run_stages
from twin.recording.campaigns import RecordingOptions, make_folder, record_campaigns, require_at_least
from twin.rendering_options import CPU, Variant
from twin.scene.campaign import Campaign, find_understated, list_takes, load_campaign
from uwlts.errors import DescriptionError, DescriptionWarning
from uwlts.files.writing import write_file
from uwlts.model.library import validate_description
from uwlts.model.sensor import Sensor
from uwlts.runtime.progress import ProgressListener, ignore_progress
from uwlts.storage.figure_table import FigureTable

JOINT = "joint"  # method of an experiment: all recordings of targets and of the step standard are calibrated together


def experiment(
    sensor: str | Path | Sensor,
    scenes: Sequence[str | Path | dict[str, Any]],
    seeds: Sequence[int],
    *,
    as_built: str | Path | Sensor | None = None,
    campaign: str | Path = "quick",
    imperfections: dict[str, float] | None = None,
    water: str | float | None = None,
    out: str | Path | None = None,
    every: int = 1,
    spp: int = 16,
    workers: int | None = None,
    scheduler: str | None = None,
    overwrite: bool = False,
    variant: Variant = CPU,
    progress: ProgressListener = ignore_progress,
) -> ExperimentResult:
    """Calibrate a sensor and measure scenes with it in rendered campaigns, and compare the results with the truth.

    Each seed draws a campaign with its own imperfections and noise. The sensor's software calibrates it jointly,
    reconstructs and evaluates the scans, and states uncertainties. An interrupted experiment is resumed, and seeds can
    be added. OUT/experiment.html and experiment.json are written, and commands.sh with all commands of the software.

    Parameters
    ----------
    sensor
        Sensor as described: a description, or its name or path.
    scenes
        Scenes to scan: names (see: twin scenes), paths, or recordings of a campaign as dict, such as
        ``{"scene": "spheres", "placements": ["near"]}``.
    seeds
        Seeds of the campaigns, such as ``range(10)``.
    as_built
        Sensor to render; default: as described.
    campaign
        Campaign with the recordings for the calibration and the imperfections; its other recordings are left out.
    imperfections
        Imperfections by name, instead of those of the campaign; ``{}`` for none.
    water
        As for `predict`.
    out
        Folder for campaigns and results (default: runs/experiment-SENSOR). Complete recordings in it are kept.
    scheduler
        Address of a Dask scheduler whose workers share the folder. Default: processes on this machine.
    every, workers, overwrite
        As for `record`.
    spp, variant
        As for `simulate`.
    progress
        Called with the number of images rendered or commands done, the total number, and the name of the stage.

    Returns
    -------
    ExperimentResult
        The table of figures, one row for each figure of every scan of every campaign.

    Raises
    ------
    DescriptionError
        An argument is out of its range, or the campaign has no calibration.
    DesignError, OutputError, SetupError
        As `record_campaigns`, or the scheduler does not answer.
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
    if not seeds or not scenes:
        missing = "seeds" if scenes else "scenes"
        raise DescriptionError(f"{missing} is empty; an experiment needs at least one of them")
    options = RecordingOptions(every, spp, variant, workers, scheduler, overwrite)
    described = load_campaign(campaign)
    name = sensor.name if isinstance(sensor, Sensor) else Path(sensor).stem
    folder = Path(out or Path("runs") / f"experiment-{name}")
    evidence = [
        each
        for each in described.recordings
        if any(map(evidence_of, list_takes(described.model_copy(update={"recordings": (each,)}), seed=0)))
    ]
    scans = [each if isinstance(each, dict) else {"scene": str(each)} for each in scenes]
    changes: dict[str, Any] = {
        "sensor": _store_sensor(sensor, folder / "sensor.toml"),
        "as_built": _store_sensor(sensor if as_built is None else as_built, folder / "as-built.toml"),
        "recordings": [*(each.model_dump() for each in evidence), *scans],
    }
    changes |= {} if imperfections is None else {"imperfections": imperfections}
    changes |= {} if water is None else {"water": water}
    described = validate_description(Campaign, described.model_dump() | changes, str(campaign))
    joint = choose_joint(described, every, with_truth=True)
    return run_experiment(described, folder, seeds, options, name=str(campaign), methods=[joint], progress=progress)


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
) -> ExperimentResult:
    """Predict the uncertainty of a sensor's measurements, and compare it with the errors in rendered campaigns.

    An `experiment` with the scans of a campaign. Pits, dents and undercuts of drawn depths give their probability of
    detection (MIL-HDBK-1823A).

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
    every, workers, overwrite
        As for `record`.
    spp, variant
        As for `simulate`.
    progress
        Called with the number of images rendered or commands done, the total number, and the name of the stage.

    Returns
    -------
    ExperimentResult
        The table of figures, and the probabilities of detection.

    Raises
    ------
    DescriptionError, DesignError, OutputError, SetupError, CommandFailed, CaptureError
        As for `experiment`, or the campaign has no scan with a known truth.

    Warns
    -----
    DescriptionWarning
        As for `experiment`.
    """
    require_at_least(1, campaigns=campaigns)
    require_at_least(0, first=first)
    options = RecordingOptions(every, spp, variant, workers, overwrite=overwrite)
    described = load_campaign(campaign)
    changes: dict[str, Any] = {} if water is None else {"water": water}
    if sensor is not None:
        changes |= {"sensor": str(sensor), "as_built": str(sensor)}
    described = validate_description(Campaign, described.model_dump() | changes, str(campaign))
    folder = Path(out or Path("runs") / f"predict-{Path(described.sensor).stem}")
    seeds = range(first, first + campaigns)
    joint = choose_joint(described, every, with_truth=False)
    return run_experiment(described, folder, seeds, options, name=str(campaign), methods=[joint], progress=progress)


def run_experiment(
    campaign: Campaign,
    folder: Path,
    seeds: Sequence[int],
    options: RecordingOptions,
    *,
    name: str,
    methods: Sequence[Method],
    published: str | Path | None = None,
    progress: ProgressListener = ignore_progress,
) -> ExperimentResult:
    """Record a campaign for each seed, calibrate it, measure its scans, and write table and page.

    ``methods`` are the calibrations, whose scans count if the campaign has them. ``published`` are tables to compare
    with, by name or path. Raises as `experiment`.
    """
    require_at_least(0, seed=min(seeds))
    takes = [{take.name: take for take in list_takes(campaign, seed=seed, every=options.every)} for seed in seeds]
    methods = [each for method in methods if (each := method.restrict_to(takes[0])).scans]
    if not methods:
        raise DescriptionError(f"campaign {campaign.title!r} has none of the scans that the calibrations measure")
    tables = None if published is None else load_published(published)
    understated = find_understated(campaign, [*takes[0].values()])
    for each in understated:
        warnings.warn(each.text(), DescriptionWarning, stacklevel=3)
    folders = record_campaigns(campaign, folder, seeds=seeds, options=options, progress=progress)
    by_folder = dict(zip(folders, takes, strict=True))
    lines = [
        line
        for place, of_seed in by_folder.items()
        for line in plan_lines(place, of_seed, methods, coloured=place == folders[0])
    ]
    write_file(folder / "commands.sh", "".join(f"{line.text}\n" for line in lines), overwrite=True)
    run_stages(lines, scheduler=options.scheduler, progress=progress)
    rows = [row for place, of_seed in by_folder.items() for row in read_figures(place, of_seed, methods)]
    detections, depths = read_flaws(by_folder, methods[0])
    conditions = {row.scan: describe_conditions(takes[0][row.scan]) for row in rows if row.scan in takes[0]}
    table = FigureTable(rows=(*rows, *depths))
    result = ExperimentResult(
        campaign=name,
        sensor=campaign.sensor,
        as_built=campaign.as_built,
        water=campaign.water,
        seeds=tuple(seeds),
        table=table,
        conditions=conditions | {f"{each.flaw}s": each.checked for each in detections},
        detections=detections,
        understated=understated,
        published=() if tables is None else tables.compare(table),
    )
    coloured = {scan: methods[0].result(folders[0], scan, COLOURED) for scan in methods[0].scans}
    result.write(folder, {scan: path for scan, path in coloured.items() if path.is_file()})
    return result


def choose_joint(campaign: Campaign, every: int, *, with_truth: bool) -> Method:
    """Return the joint calibration with all recordings of targets and steps of a campaign, and its scans.

    Without ``with_truth``, scans are those of an artefact, a pitted pipe or a weld. Raises DescriptionError if there is
    no recording of a target, or no scan.
    """
    evidence: dict[str, list[str]] = {"air": [], "water": [], "step": []}
    scans: list[str] = []
    for take in list_takes(campaign, seed=0, every=every):
        if (option := evidence_of(take)) is not None:
            evidence[option].append(take.name)
        elif with_truth or take.scene.artefact is not None or inspected_as(take.scene) is not None:
            scans.append(take.name)
    if not evidence["air"] and not evidence["water"]:
        raise DescriptionError(f"campaign {campaign.title!r} has no recording of a target for the calibration")
    if not scans:
        raise DescriptionError(f"campaign {campaign.title!r} has no scan of an artefact, a pitted pipe or a weld")
    return Method(JOINT, evidence, scans, with_truth=with_truth)


def _store_sensor(sensor: str | Path | Sensor, path: Path) -> str:
    """Return name or path of a sensor; a description is written to ``path``."""
    if not isinstance(sensor, Sensor):
        return str(sensor)
    make_folder(path.parent)
    write_file(path, tomli_w.dumps(sensor.model_dump(mode="json", exclude_none=True)), overwrite=True)
    return str(path)
