"""Coverage of the stated 95 % intervals: ``python -m tests.bench.coverage [campaigns] [--varied] [--lab]``.

Campaigns are simulated by Fermat's principle (`tests.uwlts.simulated_campaign`), calibrated jointly, and a sphere
standard is scanned and measured with each calibration. With ``--varied``, campaigns in water use other sensors than the
thesis's, sensors whose uncertainty is stated wrongly, and errors that the calibration does not model. With ``--lab``,
scale, form and finish of the target are drawn as stated, or off by a factor of two, on two sensors. ``--kept FILE``
stores each varied campaign when it ends, and continues with those that are not stored.
"""

import json
import tempfile
import time
from collections.abc import Sequence
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Annotated, Any

import numpy as np
from cyclopts import App, Parameter

from docs.studies.result_tables import publish, table
from tests.uwlts.calibration_views import STEP_MM
from tests.uwlts.simulated_campaign import (
    PLACES_MM,
    SPHERES,
    ModelErrors,
    Reality,
    drawn_reality,
    evidence,
    scan_of_spheres,
)
from tests.virtual_sensors import altered
from uwlts.calibration.calibrate import solve_jointly
from uwlts.calibration.sequential.sequential_calibration import CalibrationOptions
from uwlts.errors import CalibrationError
from uwlts.evaluation.artefact_figures import evaluate_cloud
from uwlts.evaluation.figure_uncertainty import figure_uncertainties, linearise_figures
from uwlts.evaluation.figures import ArtefactEvaluation, FigureUncertainty
from uwlts.fitting.propagation import PointErrors
from uwlts.model.calibration import Calibration
from uwlts.model.library import load_sensor
from uwlts.model.parameter_keys import (
    LensParameter,
    MediumIndex,
    ParameterKey,
    StageParameter,
    StepHeight,
    TargetParameter,
    WindowParameter,
)
from uwlts.model.sensor import Sensor
from uwlts.reconstruction.reconstruct import reconstruct_stripes
from uwlts.runtime.workers import run_jobs
from uwlts.storage.capture import Capture, CaptureHeader, Frame
from uwlts.storage.capture_writer import CaptureWriter
from uwlts.storage.cloud import PointCloud
from uwlts.stripe import CaptureStripes

CAMPAIGNS = 200
NORMAL_95 = 1.96
OPTIONS = CalibrationOptions(poses="stage", correct_circles=False)
SPACING, DIAMETERS = "SSE", ("diameter error sphere 1", "diameter error sphere 2")
KNOWN_BETTER = {"drift_k": 0.05, "stage_alignment_deg": 0.005}
"""A scan in the same water, on an aligned stage, so that the calibration's own uncertainty dominates."""


@dataclass(frozen=True)
class Measured:
    """Figure of a scan: its error, and its stated uncertainties by noise and by the calibration, mm."""

    scan: str
    place: str
    figure: str
    error_mm: float
    random_mm: float
    systematic_mm: float

    @property
    def std_mm(self) -> float:
        """Standard uncertainty of the figure."""
        return float(np.hypot(self.random_mm, self.systematic_mm))


@dataclass(frozen=True)
class Variation:
    """Variation of a campaign: changes of the sensor's description; the others are parameters of `drawn_reality`."""

    name: str = "as described"
    changes: dict[str, Any] = field(default_factory=dict)
    spread: float = 1.0
    errors: ModelErrors = ModelErrors()
    apart: dict[str, float] = field(default_factory=dict)


@dataclass(frozen=True)
class Campaign:
    """Campaign by its seed; the target is seen in air, and optionally also in water.

    ``known_better`` leaves out the scan in water that has drifted, on a misaligned stage.
    """

    seed: int
    wet: bool
    step_mm: float = 3.0
    variation: Variation = Variation()
    known_better: bool = False


VARIATIONS = (
    Variation(),
    Variation("lens of 8 mm", {"camera": {"focal_length_mm": 8.0}}),
    Variation("window 90 mm from the pupil", {"camera": {"window": {"distance_mm": 90.0}}}),
    Variation("sapphire, 4 mm", {"camera": {"window": {"glass": 1.766, "thickness_mm": 4.0}}}),
    Variation("acrylic, 20 mm", {"camera": {"window": {"glass": 1.488, "thickness_mm": 20.0}}}),
    Variation("window tilted by 5 deg", {"camera": {"window": {"tilt_x_deg": 5.0, "tilt_y_deg": -3.0}}}),
    Variation("narrow waist: half the noise", errors=ModelErrors(noise=0.5)),
    Variation("twice as far off as stated", spread=2.0),
    Variation("k3 of 0.1", errors=ModelErrors(distortion=(("k3", 0.1),))),
    Variation("saddle of 0.05 mm", errors=ModelErrors(saddle_mm=0.05)),
    Variation("target 0.01 % wider", errors=ModelErrors(stretch=1e-4)),
    Variation("target 0.02 % wider", errors=ModelErrors(stretch=2e-4)),
    Variation("target 0.1 % wider", errors=ModelErrors(stretch=1e-3)),
    Variation("stripe on the target 0.1 px off by gloss", errors=ModelErrors(gloss_px=0.1)),
    Variation("0.01 % wider, gloss, saddle, k3", errors=ModelErrors((("k3", 0.1),), 0.03, stretch=1e-4, gloss_px=0.1)),
)
"""Sizes of model errors: distortion that moves the image's corner by 0.1 to 1 px; boards and gloss of usual quality."""


OTHER_SENSOR: dict[str, Any] = {
    "camera": {"focal_length_mm": 8.0, "window": {"distance_mm": 90.0}},
    "laser": {"baseline_mm": 200.0, "triangulation_angle_deg": 25.0},
}
_TERMS = ("target_stretch", "target_bow_mm", "target_stripe_px")


def lab_variations() -> tuple[Variation, ...]:
    """Return variations of the target's scale, form and finish on two sensors.

    They are drawn as stated, and each alone and all together with twice that.
    """
    found = []
    for sensor, changes in (("thesis", {}), ("other sensor", OTHER_SENSOR)):
        found.append(Variation(f"{sensor}, as stated", changes))
        for names in (*((name,) for name in _TERMS), _TERMS):
            what = "all three" if len(names) > 1 else names[0]
            found.append(Variation(f"{sensor}, {what} x 2", changes, apart=dict.fromkeys(names, 2.0)))
    return tuple(found)


@dataclass(frozen=True)
class Outcome:
    """Results of a campaign, and the seconds taken by its calibration and by the uncertainties of its figures.

    ``pulls`` (K,) are the errors of the calibration's parameters, whitened with its covariance.
    """

    measured: list[Measured]
    pulls: np.ndarray
    warned: bool
    solve_s: float
    figures_s: float


def run_campaign(campaign: Campaign, send: Any = None) -> Outcome:
    """Calibrate, scan spheres at one of three places in turn, measure them; CalibrationError as `solve_jointly`."""
    how = campaign.variation
    described = altered(load_sensor("thesis"), how.changes)
    rng = np.random.default_rng(campaign.seed)
    real = drawn_reality(described, rng, spread=how.spread, errors=how.errors, apart=how.apart)
    gathered = evidence(real, described, wet=campaign.wet)
    start = time.perf_counter()
    calibration = solve_jointly(gathered, options=OPTIONS).calibration
    solve_s = time.perf_counter() - start
    scans = [] if campaign.known_better else [_scan(real, described, calibration, campaign)]
    uncertainty = described.uncertainty.model_copy(update=KNOWN_BETTER)
    better = described.model_copy(update={"uncertainty": uncertainty})
    scans.append(_scan(real, better, calibration, campaign, " known better"))
    return Outcome(
        [each for scan, _ in scans for each in scan],
        parameter_pulls(calibration, real, described),
        bool(calibration.origin().warnings),
        solve_s,
        sum(seconds for _, seconds in scans),
    )


def parameter_pulls(calibration: Calibration, real: Reality, described: Sensor) -> np.ndarray:
    """Return errors (K,) of the parameters with a known true value, whitened by their stated covariance."""
    camera = real.sensor.camera
    window, (column, row) = camera.window, camera.principal_point()
    slope_x, slope_y = (window.normal()[:2] / window.normal()[2]).tolist()
    truth: dict[ParameterKey, float] = {
        LensParameter.F: camera.focal_length_px(),
        LensParameter.CX: column,
        LensParameter.CY: row,
        LensParameter.K1: camera.distortion.k1,
        LensParameter.K2: camera.distortion.k2,
        WindowParameter.DISTANCE: window.distance_mm,
        WindowParameter.SLOPE_X: slope_x,
        WindowParameter.SLOPE_Y: slope_y,
        WindowParameter.THICKNESS: window.thickness_mm,
        WindowParameter.GLASS_INDEX: window.index(real.sensor.laser.wavelength_nm),
        StageParameter.SCALE: real.stage_scale,
        LensParameter.P1: camera.distortion.p1,
        LensParameter.P2: camera.distortion.p2,
        TargetParameter.BOW: real.target_bow_mm,
        TargetParameter.SADDLE: real.target_saddle_mm,
        TargetParameter.TWIST: real.target_twist_mm,
        TargetParameter.STRETCH_X: real.stretch[0],
        TargetParameter.STRETCH_Y: real.stretch[1],
        TargetParameter.STRIPE: real.gloss_px,
        MediumIndex("water"): real.index(described.media["water"]),
        StepHeight(STEP_MM): real.step_mm,
    }
    estimate = calibration.joint
    assert estimate is not None
    known = [place for place, key in enumerate(estimate.parameters) if key in truth]
    error = [estimate.values[place] - truth[estimate.parameters[place]] for place in known]
    std = np.array(estimate.std)[known]
    correlation = estimate.covariance_matrix()[np.ix_(known, known)] / np.outer(std, std)
    return np.linalg.solve(np.linalg.cholesky(correlation), error / std)


def _scan(
    real: Reality, sensor: Sensor, calibration: Calibration, campaign: Campaign, how: str = ""
) -> tuple[list[Measured], float]:
    """Return figures of a scan, with stage and water varied as stated, and the seconds for their uncertainties."""
    known, medium = sensor.uncertainty, "water" if campaign.wet else "air"
    place = list(PLACES_MM)[campaign.seed % len(PLACES_MM)]
    positions = np.arange(-18.0, 18.5, campaign.step_mm)
    stripes = scan_of_spheres(
        real,
        index=real.index(sensor.media[medium], drift_k=real.rng.normal(0, known.drift_k)),
        place=place,
        positions=positions,
        lean=np.tan(np.radians(known.stage_alignment_deg)) * real.rng.standard_normal(2),
    )
    bright, wide = np.full(len(stripes.line), 100.0), np.full(len(stripes.line), 4.0)
    found = CaptureStripes(stripes.frame, stripes.line, stripes.centre_px, bright, wide, {})
    with tempfile.TemporaryDirectory() as folder, _empty_capture(Path(folder), sensor, medium, positions) as capture:
        cloud = reconstruct_stripes(capture, found, calibration, with_uncertainty=True)
    evaluation = evaluate_cloud(cloud, SPHERES)
    start = time.perf_counter()
    stated = (linear_uncertainties if campaign.known_better else figure_uncertainties)(cloud, evaluation)
    seconds = time.perf_counter() - start
    return [
        Measured(
            f"{medium}{how}",
            place,
            figure,
            evaluation.figures_mm[figure],
            stated[figure].random_mm,
            stated[figure].systematic_mm,
        )
        for figure in (SPACING, *DIAMETERS)
    ], seconds


def linear_uncertainties(cloud: PointCloud, evaluation: ArtefactEvaluation) -> dict[str, FigureUncertainty]:
    """Return uncertainties of spacings and diameters as `figure_uncertainties` does, without the draws for the others.

    The draws take a third of a campaign's time.
    """
    assert cloud.uncertainty is not None
    errors = PointErrors.from_uncertainty(cloud.uncertainty, cloud.frame)
    figures, plain = linearise_figures(cloud, evaluation), evaluation.figures_mm
    gradients = figures.gradients

    def changed(by: np.ndarray) -> np.ndarray:
        moved = figures.figures_mm(by)
        return np.array([moved[name] - plain[name] for name in gradients])

    systematic = errors.by_patterns(changed)
    assert systematic is not None
    return {
        name: FigureUncertainty(errors.linear_std(gradient), float(common))
        for (name, gradient), common in zip(gradients.items(), systematic, strict=True)
    }


def _empty_capture(folder: Path, sensor: Sensor, medium: str, positions: np.ndarray) -> Capture:
    """Return a capture with sensor, medium and stage, but without images; their contents are given elsewhere."""
    header = CaptureHeader(
        name="spheres",
        sensor=sensor,
        medium_name=medium,
        medium=sensor.media[medium],
        stage_direction=(1.0, 0.0, 0.0),
        saturation_dn=255,
    )
    image = np.zeros((sensor.camera.height_px, sensor.camera.width_px), np.uint8)
    with CaptureWriter(folder / "spheres.h5", header, dtype=np.uint8) as writer:
        for number, position in enumerate(positions):
            writer.append(Frame(image, float(position), True, 1.0, float(number)))
    return Capture(folder / "spheres.h5")


def judged(outcomes: Sequence[Outcome]) -> dict[tuple[str, str], list[Measured]]:
    """Return all measured figures by scan and quantity."""
    found: dict[tuple[str, str], list[Measured]] = {}
    for measured in (m for outcome in outcomes for m in outcome.measured):
        quantity = "spacing" if measured.figure == SPACING else "diameter"
        found.setdefault((measured.scan, quantity), []).append(measured)
    return found


def within(measured: Sequence[Measured]) -> float:
    """Return the fraction of errors within the stated 95 % interval."""
    return float(np.mean([abs(m.error_mm) <= NORMAL_95 * m.std_mm for m in measured]))


def attempt(campaign: Campaign, send: Any = None) -> Outcome | None:
    """Return the outcome of a campaign; None if the calibration rejects its evidence as contradictory."""
    try:
        outcome = run_campaign(campaign)
    except CalibrationError:
        outcome = None
    if send is not None:
        send((campaign, outcome))
    return outcome


def run_stored(
    jobs: Sequence[Campaign], kept: Path | None, workers: int | None
) -> dict[tuple[str, int], Outcome | None]:
    """Return outcomes by variation and seed; ``kept`` stores them when they end, and is read first."""
    found: dict[tuple[str, int], Outcome | None] = {}
    for line in kept.read_text().splitlines() if kept and kept.exists() else ():
        stored = json.loads(line)
        if (outcome := stored["outcome"]) is not None:
            measured = [Measured(**each) for each in outcome.pop("measured")]
            outcome = Outcome(**outcome | {"measured": measured, "pulls": np.array(outcome["pulls"])})
        found[stored["variation"], stored["seed"]] = outcome

    def keep(ended: tuple[Campaign, Outcome | None]) -> None:
        campaign, outcome = ended
        found[campaign.variation.name, campaign.seed] = outcome
        if kept:
            stored = None if outcome is None else asdict(outcome) | {"pulls": outcome.pulls.tolist()}
            line = {"variation": campaign.variation.name, "seed": campaign.seed, "outcome": stored}
            with kept.open("a") as file:
                file.write(json.dumps(line) + "\n")

    left = [each for each in jobs if (each.variation.name, each.seed) not in found]
    run_jobs(attempt, left, workers=workers, on_message=keep)
    return found


def varied_campaigns(
    count: int, variations: Sequence[Variation], *, name: str, write: bool, kept: Path | None, workers: int | None
) -> int:
    """Run ``count`` campaigns of each variation and print the coverage of their stated intervals."""
    rows = []
    jobs = [Campaign(seed, True, variation=each, known_better=True) for seed in range(count) for each in variations]
    outcomes = run_stored(jobs, kept, workers)
    for variation in variations:
        own = [outcomes[variation.name, seed] for seed in range(count)]
        kept = [outcome for outcome in own if outcome is not None]
        found = judged(kept)
        spacing = found.get(("water known better", "spacing"), [])
        if not spacing:
            rows.append([variation.name, str(count), *["-"] * 3])
            continue
        error, std = np.array([(m.error_mm, m.std_mm) for m in spacing]).T
        rows.append(
            [
                variation.name,
                str(count - len(kept) + sum(outcome.warned for outcome in kept)),
                f"{100 * within(spacing):.0f}",
                f"{np.sqrt(np.mean(error**2)):.4f}",
                f"{np.sqrt(np.mean(std**2)):.4f}",
            ]
        )
    head = ["campaigns", "refused or warned", "spacing within 95 %, %", "error, rms mm", "stated, mm"]
    if name == "coverage, lab":
        half, head = len(rows) // 2, ["thesis's sensor, other sensor", *2 * ["within 95 %, %", "error, rms mm"]]
        both = zip(rows[:half], rows[half:], strict=True)
        rows = [[first[0].removeprefix("thesis, "), *first[2:4], *other[2:4]] for first, other in both]
    publish({name: table(head, rows)}, write=write)
    return 0


def main(
    campaigns: int = CAMPAIGNS,
    *,
    varied: Annotated[bool, Parameter(negative="")] = False,
    lab: Annotated[bool, Parameter(negative="")] = False,
    kept: Path | None = None,
    workers: int | None = None,
    write: Annotated[bool, Parameter(negative="")] = False,
) -> int:
    """Run all campaigns and print the coverage of the stated intervals; with `--write`, put it into its page.

    Parameters
    ----------
    campaigns
        Number of campaigns of each kind or variation.
    varied
        Other sensors, wrong uncertainties, and errors that the calibration does not model.
    lab
        Errors of the target's scale, form and finish, on two sensors.
    kept
        File of the varied campaigns that have ended; those of a file that exists are not run again.
    workers
        Number of processes.
    write
        Put the table into its page of docs/results.
    """
    if varied or lab:
        variations, name = (lab_variations(), "coverage, lab") if lab else (VARIATIONS, "coverage, varied")
        return varied_campaigns(campaigns, variations, name=name, write=write, kept=kept, workers=workers)
    jobs = [Campaign(seed, wet) for seed in range(campaigns) for wet in (True, False)]
    outcomes = run_jobs(run_campaign, jobs, workers=workers)
    rows = []
    for (scan, quantity), measured in judged(outcomes).items():
        error, std = np.array([(m.error_mm, m.std_mm) for m in measured]).T
        rows.append(
            [
                scan,
                quantity,
                str(len(measured)),
                f"{100 * within(measured):.1f} %",
                f"{np.sqrt(np.mean((error / std) ** 2)):.2f}",
                f"{1e3 * np.mean(np.abs(error)):.1f} µm",
                f"{1e3 * np.mean(std):.1f} µm",
            ]
        )
    head = ["scan", "quantity", "number", "within 95 %", "error / stated, rms", "mean error", "mean stated"]
    publish({"coverage": table(head, rows)}, write=write)
    pulls = np.concatenate([outcome.pulls for outcome in outcomes])
    print(f"parameters: mean square of {len(pulls)} whitened errors {np.mean(pulls**2):.3f}; 1 is right")
    solve, figures = (np.median([getattr(o, name) for o in outcomes]) for name in ("solve_s", "figures_s"))
    print(f"medians: {solve:.2f} s for a calibration, {figures:.2f} s for the uncertainties of two scans")
    return 0


if __name__ == "__main__":
    App(help=__doc__, help_format="plaintext", default_command=main)()
