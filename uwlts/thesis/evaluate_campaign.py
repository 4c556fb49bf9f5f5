"""Evaluation of one campaign: calibration by every method, measurement of every scan, and studies of the inputs."""

from collections.abc import Callable
from contextlib import ExitStack
from functools import partial
from itertools import chain, count
from pathlib import Path

import numpy as np
from pydantic import BaseModel, ConfigDict, ValidationError

from uwlts.calibration.sequential.sequential_calibration import CalibrationOptions, gather
from uwlts.errors import CaptureError, describe_problems
from uwlts.files.json_files import read_json
from uwlts.model.any_calibration import AnyCalibration
from uwlts.model.calibration import Calibration
from uwlts.model.polynomial_calibration import PolynomialCalibration
from uwlts.optics.nominal import nominal_calibration
from uwlts.optics.triangulation import reconstruct_by_polynomials
from uwlts.reconstruction.reconstruct import reconstruct
from uwlts.runtime.progress import ProgressListener, ignore_progress
from uwlts.runtime.workers import run_jobs
from uwlts.storage.capture import Capture
from uwlts.thesis.campaign_folder import CampaignFolder, ScanFile, up_to_date
from uwlts.thesis.measurements import PROPOSED, THESIS, TWO, calibrations, measure_scan
from uwlts.thesis.monte_carlo import propagate
from uwlts.thesis.results import (
    CampaignResults,
    LineProfile,
    Measurement,
    PolynomialCurves,
    PolynomialLine,
    SpacingInterval,
)
from uwlts.thesis.sphere_spacing import SphereScan, spacing_budget, sphere_scan, window_choices, window_of

RESULTS = "results.json"
TRIALS = 100  # an interval of 95 % then leaves out five


class _Known(BaseModel):
    """Part of a campaign's plan with the uncertainties of its inputs."""

    model_config = ConfigDict(frozen=True, allow_inf_nan=False)
    imperfections: dict[str, float]


_SHOWN_LINES = {"one end": 0.05, "middle": 0.5, "other end": 0.95}


def evaluate_campaign(
    folder: CampaignFolder,
    *,
    trials: int = TRIALS,
    workers: int | None = None,
    overwrite: bool = False,
    progress: ProgressListener = ignore_progress,
) -> CampaignResults:
    """Evaluate a campaign and save the results in results.json; read them from there if no recording is newer.

    Saved results without the Monte-Carlo propagation, or with another number of trials, are completed.

    ``overwrite`` evaluates again, also without newer recordings.

    Raises CaptureError if a recording for the calibration is missing, or a file is damaged; CalibrationError if the
    recordings do not determine a calibration.
    """
    path = folder.path / RESULTS
    if not overwrite and up_to_date(path):
        kept = CampaignResults.read_file(path)
        if trials in (0, kept.trials):
            return kept
        scans = _sphere_scans(folder, _require_camera_model(calibrations(folder)[PROPOSED, "water"]))
        intervals = _monte_carlo(folder, scans, trials, workers, progress)
        return kept.model_copy(update={"monte_carlo": intervals, "trials": trials}).keep(path)
    calibrated = calibrations(folder, progress=partial(progress, stage="calibrations"))
    measurements = _measure_scans(folder, calibrated, workers, progress)
    proposed, two = (_require_camera_model(calibrated[method, "water"]) for method in (PROPOSED, TWO))
    scans = _sphere_scans(folder, proposed)
    choices, profiles = window_choices(folder, proposed, scans)
    return CampaignResults(
        measurements=measurements,
        window={choice.images: choice for choice in choices},
        window_profiles=profiles,
        two_refractions_distance_mm=window_of(two).distance_mm,
        polynomials={
            medium: _curves(each) for (_, medium), each in calibrated.items() if isinstance(each, PolynomialCalibration)
        },
        budget=_budget(folder, measurements, proposed, scans),
        line_profiles={side: profile for side in ("width", "height") if (profile := _line_profile(folder, side))},
        monte_carlo=_monte_carlo(folder, scans, trials, workers, progress),
        trials=trials,
    ).keep(path)


def _require_camera_model(calibration: AnyCalibration) -> Calibration:
    if not isinstance(calibration, Calibration):
        raise TypeError("a polynomial calibration has neither camera nor window")
    return calibration


def _measure_scans(
    folder: CampaignFolder,
    calibrated: dict[tuple[str, str], AnyCalibration],
    workers: int | None,
    progress: ProgressListener,
) -> list[Measurement]:
    """Measure all scans in parallel."""
    clouds = folder.path / "clouds"
    clouds.mkdir(exist_ok=True)
    scans, numbers = folder.scans(), count(1)
    found = run_jobs(
        partial(_measure, calibrated, clouds),
        scans,
        workers=workers,
        on_message=lambda _: progress(next(numbers), len(scans), "measurements"),
    )
    return list(chain.from_iterable(found))


def _measure(
    calibrated: dict[tuple[str, str], AnyCalibration], clouds: Path, scan: ScanFile, send: Callable[[None], None]
) -> list[Measurement]:
    found = measure_scan(scan, calibrated, clouds=clouds)
    send(None)
    return found


def _sphere_scans(folder: CampaignFolder, calibration: Calibration) -> list[SphereScan]:
    found = []
    for scan in folder.scans():
        if (scan.thing, scan.medium) == ("spheres", "water"):
            with Capture(scan.path) as capture:
                found.append(sphere_scan(capture, calibration, placement=scan.placement))
    return found


def _curves(calibration: PolynomialCalibration) -> PolynomialCurves:
    """Return Z(v) and Y(Z) of the outer and middle profile lines (Figures 58 and 59), and the residual."""
    lines = {}
    known = np.flatnonzero(np.isfinite(calibration.domains()[:, 0]))
    for name, share in _SHOWN_LINES.items():
        row = int(known[round(share * (len(known) - 1))])
        low, high = calibration.domains()[row]
        centres, number = np.linspace(low, high, 60), calibration.first_line + row
        found = reconstruct_by_polynomials(
            calibration, np.full(len(centres), number), centres, stage_mm=0.0, stage_direction=np.eye(3)[0]
        )
        y_mm, z_mm = np.round(found.points_mm[:, 1:], 4).T.tolist()
        lines[name] = PolynomialLine(number, np.round(centres, 3).tolist(), y_mm, z_mm)
    rms = calibration.figures("depth")["rms_mm"]
    if not isinstance(rms, int | float):
        raise CaptureError(f"the polynomials' residual is {rms!r}; expected a number in mm: calibrate again")
    return PolynomialCurves(lines, rms)


def _budget(
    folder: CampaignFolder, measurements: list[Measurement], calibration: Calibration, scans: list[SphereScan]
) -> dict[str, float]:
    if len(scans) < 2:
        return {}
    with Capture(folder.steps()[0]) as capture:
        medium = capture.header.medium
    wanted = ("spheres", "water", PROPOSED, THESIS)
    spheres = [m.figures_mm for m in measurements if (m.thing, m.medium, m.method, m.processing) == wanted]
    deviation_mm = max((figures["STD"] for figures in spheres if "STD" in figures), default=0.0)
    return spacing_budget(calibration, scans, medium, deviation_mm=deviation_mm)


def _monte_carlo(
    folder: CampaignFolder, scans: list[SphereScan], trials: int, workers: int | None, progress: ProgressListener
) -> list[SpacingInterval]:
    """Return Monte-Carlo intervals of every scan of spheres."""
    if trials == 0 or not scans:
        return []
    options = CalibrationOptions(refractions=1)
    with ExitStack() as stack:
        air = [stack.enter_context(Capture(folder.target("air")))]
        steps = [stack.enter_context(Capture(path)) for path in folder.steps()]
        evidence, medium = gather(air, steps, options=options), steps[0].header.medium
    # Imperfections of the inputs are read from the plan in the campaigns' folder, if there is one.
    plan = folder.path.parent / "plan.json"
    try:
        campaign = read_json(plan, called="plan").get("campaign") if plan.exists() else {"imperfections": {}}
        knowledge = _Known.model_validate(campaign).imperfections
    except ValidationError as error:
        raise CaptureError(
            f"{plan} does not contain the campaign's imperfections: {describe_problems(error)}"
        ) from error
    shown = partial(progress, stage="Monte Carlo")
    return [
        SpacingInterval(each.placement, each.observed_mm, each.std_mm(), each.interval_mm(), each.contains_truth())
        for each in propagate(
            evidence, scans, medium, knowledge, options=options, trials=trials, workers=workers, progress=shown
        )
    ]


def _line_profile(folder: CampaignFolder, side: str) -> LineProfile | None:
    """Return the stripe on the pipe with the nominal calibration: its length along Y and its points, mm."""
    path = folder.line(side)
    if path is None:
        return None
    with Capture(path) as capture:
        header = capture.header
        scan = reconstruct(capture, nominal_calibration(header.sensor, header.medium))
    points = scan.points_mm[:, 1:]
    return LineProfile(float(np.ptp(points[:, 0])), [(x, y) for x, y in np.round(points[::4], 3).tolist()])
