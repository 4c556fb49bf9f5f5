"""Evaluates one campaign: calibrates by every method, measures every scan, and studies what the results rest on."""

import json
from collections.abc import Callable
from contextlib import ExitStack
from dataclasses import asdict
from functools import partial
from itertools import chain, count
from pathlib import Path
from typing import Any

import numpy as np

from uwlts.calibration.sequential import CalibrationOptions, gather
from uwlts.measurement.reconstruction import reconstruct
from uwlts.model.any_calibration import AnyCalibration
from uwlts.model.calibration import Calibration
from uwlts.model.errors import CaptureError
from uwlts.model.polynomial_calibration import PolynomialCalibration
from uwlts.optics.nominal import nominal_calibration
from uwlts.optics.reconstruction import reconstruct_by_polynomials
from uwlts.runtime.workers import work_through
from uwlts.storage.capture import Capture
from uwlts.thesis.campaign import MEDIA, CampaignFolder, ScanFile, keep, kept, up_to_date
from uwlts.thesis.measurements import POLYNOMIALS, PROPOSED, THESIS, TWO, Measurement, calibrations, measure_scan
from uwlts.thesis.monte_carlo import propagate
from uwlts.thesis.sphere_spacing import SphereScan, spacing_budget, sphere_scan, window_choices

RESULTS = "results.json"
FORMAT, VERSION = "uwlts-thesis-results", 1
TRIALS = 100
_SHOWN_LINES = {"one end": 0.05, "middle": 0.5, "other end": 0.95}
Progress = Callable[[str, int, int], None]


def evaluate_campaign(
    folder: CampaignFolder,
    *,
    trials: int = TRIALS,
    workers: int | None = None,
    overwrite: bool = False,
    progress: Progress = lambda stage, done, total: None,
) -> dict[str, Any]:
    """Results of a campaign as plain JSON, kept in its file results.json; read from there if no recording is newer.

    Kept results without the Monte-Carlo propagation, or with another number of trials, are completed.

    Raises
    ------
    CaptureError
        A recording that the calibration needs is missing, or a file is damaged.
    CalibrationError
        The recordings do not determine a calibration.
    """
    path = folder.path / RESULTS
    if not overwrite and up_to_date(path):
        results = read_results(path)
        if trials in (0, results["trials"]):
            return results
        calibrated = calibrations(folder)
        scans = _sphere_scans(folder, calibrated[PROPOSED, "water"])
        return _keep(path, results | _monte_carlo(folder, scans, trials, workers, progress))
    calibrated = calibrations(folder, progress=lambda done, total: progress("calibrations", done, total))
    measurements = _measured(folder, calibrated, workers, progress)
    proposed = calibrated[PROPOSED, "water"]
    scans = _sphere_scans(folder, proposed)
    choices, profiles = window_choices(folder, proposed, scans)
    results = {
        "measurements": [asdict(found) for found in measurements],
        "window": {choice.images: asdict(choice) for choice in choices},
        "window_profiles": profiles,
        "two_refractions_distance_mm": calibrated[TWO, "water"].window.distance_mm,
        "polynomials": {medium: _curves(calibrated[POLYNOMIALS, medium]) for medium in MEDIA},
        "budget": _budget(folder, measurements, proposed, scans),
        "line_profiles": {side: profile for side in ("width", "height") if (profile := _line_profile(folder, side))},
    }
    return _keep(path, results | _monte_carlo(folder, scans, trials, workers, progress))


def _keep(path: Path, results: dict[str, Any]) -> dict[str, Any]:
    return keep(path, results, format=FORMAT, version=VERSION)


def read_results(path: Path) -> dict[str, Any]:
    """Results as `evaluate_campaign` has kept them; CaptureError where the file is damaged or newer."""
    return kept(path, format=FORMAT, version=VERSION)


def _measured(
    folder: CampaignFolder, calibrated: dict[tuple[str, str], AnyCalibration], workers: int | None, progress: Progress
) -> list[Measurement]:
    """All scans, several at a time."""
    clouds = folder.path / "clouds"
    clouds.mkdir(exist_ok=True)
    scans, numbers = folder.scans(), count(1)
    found = work_through(
        partial(_measure, calibrated, clouds),
        scans,
        workers=workers,
        heard=lambda _: progress("measurements", next(numbers), len(scans)),
    )
    return list(chain.from_iterable(found))


def _measure(
    calibrated: dict[tuple[str, str], AnyCalibration], clouds: Path, scan: ScanFile, tell: Callable[[None], None]
) -> list[Measurement]:
    found = measure_scan(scan, calibrated, clouds=clouds)
    tell(None)
    return found


def _sphere_scans(folder: CampaignFolder, calibration: Calibration) -> list[SphereScan]:
    found = []
    for scan in folder.scans():
        if (scan.thing, scan.medium) == ("spheres", "water"):
            with Capture(scan.path) as capture:
                found.append(sphere_scan(capture, calibration, placement=scan.placement))
    return found


def _curves(calibration: PolynomialCalibration) -> dict[str, Any]:
    """Z(v) and Y(Z) of an outer, the middle and the other outer profile line (Figures 58 and 59), and the residual."""
    lines = {}
    known = np.flatnonzero(np.isfinite(calibration.domains()[:, 0]))
    for name, share in _SHOWN_LINES.items():
        row = int(known[round(share * (len(known) - 1))])
        low, high = calibration.domains()[row]
        centres = np.linspace(low, high, 60)
        number = calibration.first_line + row
        points = reconstruct_by_polynomials(
            calibration, np.full(len(centres), number), centres, stage_mm=0.0, stage_direction=np.array([1.0, 0.0, 0.0])
        ).points_mm
        lines[name] = {
            "line": number,
            "centre_px": np.round(centres, 3).tolist(),
            "y_mm": np.round(points[:, 1], 4).tolist(),
            "z_mm": np.round(points[:, 2], 4).tolist(),
        }
    return {"lines": lines, "residual_mm": calibration.figures("depth")["rms_mm"]}


def _budget(
    folder: CampaignFolder, measurements: list[Measurement], calibration: Calibration, scans: list[SphereScan]
) -> dict[str, float]:
    if len(scans) < 2:
        return {}
    with Capture(folder.steps()[0]) as capture:
        medium = capture.header.medium
    wanted = ("spheres", "water", PROPOSED, THESIS)
    spheres = [m for m in measurements if (m.thing, m.medium, m.method, m.processing) == wanted]
    return spacing_budget(
        calibration,
        scans,
        medium,
        deviation_mm=max((m.figures_mm["STD"] for m in spheres if "STD" in m.figures_mm), default=0.0),
    )


def _monte_carlo(
    folder: CampaignFolder, scans: list[SphereScan], trials: int, workers: int | None, progress: Progress
) -> dict[str, Any]:
    """Intervals of every scan of spheres, and the number of trials they rest on."""
    if trials == 0 or not scans:
        return {"monte_carlo": [], "trials": trials}
    options = CalibrationOptions(refractions=1)
    with ExitStack() as stack:
        air = [stack.enter_context(Capture(folder.target("air")))]
        steps = [stack.enter_context(Capture(path)) for path in folder.steps()]
        evidence, medium = gather(air, steps, options=options), steps[0].header.medium
    found = propagate(
        evidence,
        scans,
        medium,
        _knowledge(folder),
        options=options,
        trials=trials,
        workers=workers,
        progress=lambda done, total: progress("Monte Carlo", done, total),
    )
    intervals = [
        {
            "placement": each.placement,
            "observed_mm": each.observed_mm,
            "std_mm": each.std_mm(),
            "interval_mm": each.interval_mm(),
            "contains_truth": each.contains_truth(),
        }
        for each in found
    ]
    return {"monte_carlo": intervals, "trials": trials}


def _knowledge(folder: CampaignFolder) -> dict[str, float]:
    """What is known of the inputs, from the plan that lies beside the campaigns; nothing without one."""
    path = folder.path.parent / "plan.json"
    try:
        return dict(json.loads(path.read_text(encoding="utf-8"))["campaign"]["imperfections"])
    except FileNotFoundError:
        return {}
    except (OSError, ValueError, KeyError, TypeError) as error:
        raise CaptureError(f"{path} does not tell the campaign's imperfections: {error}") from error


def _line_profile(folder: CampaignFolder, side: str) -> dict[str, Any] | None:
    """Stripe on the pipe by the calibration of a sensor that is as described: its length along Y and points, mm."""
    path = folder.line(side)
    if path is None:
        return None
    with Capture(path) as capture:
        header = capture.header
        scan = reconstruct(capture, nominal_calibration(header.sensor, header.medium))
    points = scan.points_mm[:, 1:]
    return {"length_mm": float(np.ptp(points[:, 0])), "points_mm": np.round(points[::4], 3).tolist()}
