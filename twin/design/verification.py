"""Verification of designs by rendering: the twin records, and the sensor software calibrates and measures.

The sensor software runs as a separate program, as with a real sensor. Its points are compared with the true plane, and
their scatter with the prediction of the formulas.
"""

from __future__ import annotations

import hashlib
import math
import shlex
import tempfile
import time
from collections.abc import Callable, Sequence
from contextlib import suppress
from dataclasses import asdict, dataclass, field, replace
from functools import partial
from pathlib import Path

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
from scipy import special

from twin.design.designs import HighlightedDesign
from twin.design.figures_of_merit import compute_figures, predict_scatter
from twin.design.sensor_arrays import extract_parameters
from twin.design.study import Study
from twin.design.verification_scenes import PlannedRecording, plan_recordings
from twin.experiments.runner import run_apart
from twin.recording.campaigns import make_folder, record_on_one_thread
from twin.rendering_options import CPU, Options
from uwlts import errors
from uwlts.errors import Error
from uwlts.files.writing import write_atomically
from uwlts.model.sensor import Sensor
from uwlts.runtime.progress import ProgressListener, ignore_progress
from uwlts.runtime.workers import Lost, Workers, run_jobs
from uwlts.storage.capture import Capture
from uwlts.storage.cloud_files import read_cloud

_USER_ERROR = 2  # exit code of the commands for a mistake of the user
_FEWEST_POINTS = 20  # of a profile, for its scatter to be known within a sixth
_LARGEST_RESIDUAL = 5.0
"""Limit of residuals from the profile's trend in robust standard deviations; larger ones are outliers."""


AGREES_WITHIN = 1.5  # largest factor between rendered and predicted scatter, see docs/results/designs.md


@dataclass(frozen=True, eq=False)
class VerifiedMeasurements:
    """Measurements of a plane normal to the laser's axis at K depths by a rendered sensor.

    Outliers, more than five robust standard deviations from the trend, are excluded except in ``points``. At depths
    with fewer than 20 points, scatter and error are NaN and the line length is 0.
    """

    z_mm: np.ndarray  # (K,); true Z of the plane in the OCS, ascending
    points: np.ndarray  # (K,); number of points, including outliers
    scatter_mm: np.ndarray  # (K,); standard deviation along Z about the profile's quadratic trend (random error)
    error_mm: np.ndarray
    """(K,); mean deviation along Z from the true plane (systematic error). It includes the error of the calibrated
    OCS's origin, which is equal at all depths."""
    line_mm: np.ndarray  # (K,); length of the profile along Y
    exposure_ms: float = math.nan  # exposure of the plane's images
    seconds: float = math.nan  # time to render, calibrate and measure


def verify(
    sensor: Sensor,
    medium: str,
    folder: Path,
    *,
    reflectance: float = 0.5,
    seed: int = 0,
    variant: str = CPU,
    workers: int = 2,
) -> VerifiedMeasurements:
    """Calibrate a sensor and measure a plane with it in one of its media, with rendered images.

    Equal arguments give equal results. ``folder`` is empty and receives captures, calibration and cloud.
    ``reflectance`` is that of the plane, ``seed`` that of the noise, ``variant`` one of Mitsuba. With one of
    ``workers``, images are rendered in this process, else in as many.

    Raises DescriptionError or DesignError if the sensor cannot work in the medium, or cannot be calibrated;
    CalibrationError or CaptureError if the software cannot calibrate, or does not find the stripe; EvaluationError if
    the cloud has too few points at every depth; OutputError if a file cannot be written; SetupError if a process was
    ended from outside, or the machine cannot render.
    """
    planned = plan_recordings(sensor, medium, reflectance=reflectance)
    calibration, cloud = folder / "calibration.json", folder / "standard.ply"
    make_folder(folder)
    # Each recording has its own seed, so that the noise is independent.
    jobs = [
        (recording, Options(seed=int(np.random.SeedSequence([seed, k]).generate_state(1)[0])))
        for k, recording in enumerate(planned)
        if recording is not None
    ]
    start = time.perf_counter()
    run_jobs(partial(_record, folder, variant), jobs, workers=min(workers, len(jobs)))
    steps = [] if planned.step is None else ["--step", str(_locate(folder, planned.step))]
    target, capture = (str(_locate(folder, recording)) for recording in (planned.target, planned.standard))
    _run("calibrate", "--air", target, *steps, "--out", str(calibration), fails_as=errors.CalibrationError)
    known = ("--calibration", str(calibration), "--out", str(cloud))
    _run("reconstruct", capture, *known, fails_as=errors.CaptureError)
    with Capture(capture) as opened:
        exposure, stage = float(opened.exposure_ms[0]), np.array(opened.stage_mm)
    found = read_cloud(cloud)
    profiles = _evaluate_points(np.column_stack([found.frame, found.points_mm[:, 1:]]), stage)
    return replace(profiles, exposure_ms=exposure, seconds=time.perf_counter() - start)


def _locate(folder: Path, recording: PlannedRecording) -> Path:
    return folder / f"{recording.name}.h5"


def _record(
    folder: Path, variant: str, job: tuple[PlannedRecording, Options], report: Callable[[object], None]
) -> None:
    """Render a recording to its file with one thread; several recordings are rendered at the same time."""
    recording, options = job
    try:
        record_on_one_thread(recording.scene, recording.sensor, _locate(folder, recording), variant, options=options)
    except Error as error:
        raise type(error)(f"{recording.scene.title}: {error}") from error


def _run(command: str, *arguments: str, fails_as: type[Error]) -> None:
    """Run a command of the sensor software; raise its message as ``fails_as`` if it fails."""
    code, output = run_apart(shlex.join(["uwlts", command, *arguments, "--overwrite"]))
    if code == 0:
        return
    last = (output.strip().splitlines() or ["no message"])[-1]
    if code == _USER_ERROR:
        raise fails_as(last.removeprefix("error: "))
    raise errors.SetupError(f"uwlts {command} has ended unexpectedly (exit code {code}): {last}")


def _evaluate_points(points: np.ndarray, stage_mm: np.ndarray) -> VerifiedMeasurements:
    """Evaluate points (N, 3), with frame, Y and Z, against the plane Z = 0.

    ``stage_mm`` (K,) are the stage positions along Z. The result is sorted by increasing depth.
    """
    order = np.argsort(-stage_mm)
    found = [points[points[:, 0] == frame, 1:] for frame in order]
    enough = [len(profile) >= _FEWEST_POINTS for profile in found]
    if not any(enough):
        raise errors.EvaluationError(
            f"the plane standard has {len(points)} points at {len(order)} depths, but at least {_FEWEST_POINTS} are "
            "needed at one depth: check that the stripe is bright enough and in focus"
        )
    nothing = (math.nan, math.nan, 0.0)
    figures = np.array([_measure_profile(p) if good else nothing for p, good in zip(found, enough, strict=True)])
    return VerifiedMeasurements(-stage_mm[order], np.array([*map(len, found)]), *figures.T)


def _measure_profile(points_yz: np.ndarray) -> tuple[float, float, float]:
    """Return scatter, mean deviation and length, mm, of a profile (N, 2) of Z = 0, as in `VerifiedMeasurements`."""
    used = points_yz
    # The first fit includes outliers; the second one excludes them.
    for _ in range(2):
        y, z = used.T
        trend = np.polynomial.Polynomial.fit(y, z, 2)
        off = points_yz[:, 1] - trend(points_yz[:, 0])
        off -= np.median(off)
        used = points_yz[np.abs(off) <= _LARGEST_RESIDUAL * np.median(np.abs(off)) / special.ndtri(0.75)]
    y, z = used.T
    residuals = z - np.polynomial.Polynomial.fit(y, z, 2)(y)
    return float(np.sqrt(residuals @ residuals / (len(y) - 3))), float(z.mean()), float(np.ptp(y))


# --- candidates of a study ----------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Agreement:
    """Rendered and predicted scatter of a candidate at depths Z, and whether they agree.

    ``rendered_over_predicted`` is the ratio of the root mean squares of rendered and predicted scatter over all points.
    ``ratio`` is this ratio or its inverse, whichever is larger. The two agree if it does not exceed the study's
    tolerance. ``failure`` is the message if rendering or measuring failed; then there are no depths.
    """

    label: str
    design: int
    z_mm: list[float] = field(default_factory=list)
    predicted_mm: list[float] = field(default_factory=list)
    rendered_mm: list[float] = field(default_factory=list)
    error_mm: list[float] = field(default_factory=list)
    line_mm: list[float] = field(default_factory=list)
    ratio: float = math.nan
    rendered_over_predicted: float = math.nan
    agrees: bool = False
    exposure_ms: float = math.nan
    predicted_exposure_ms: float = math.nan
    seconds: float = math.nan
    failure: str = ""

    @property
    def largest_error_mm(self) -> float:
        """Largest systematic error, NaN if it is unknown."""
        return max((abs(error) for error in self.error_mm if math.isfinite(error)), default=math.nan)


def verify_candidate(study: Study, candidate: HighlightedDesign, *, workers: int, variant: str) -> Agreement:
    """Render a candidate of a study in ``workers`` processes and compare its scatter with the prediction."""
    options = {"reflectance": study.reflectance, "variant": variant, "workers": workers}
    try:
        with tempfile.TemporaryDirectory(prefix="verify-") as folder:
            rendered = verify(candidate.sensor, study.medium, Path(folder), **options)
    except (Error, OSError) as error:
        return Agreement(candidate.label, candidate.design.number, failure=str(error))
    return compare_scatter(study, candidate, rendered)


def compare_scatter(study: Study, candidate: HighlightedDesign, rendered: VerifiedMeasurements) -> Agreement:
    """Compare the rendered with the predicted scatter of a candidate."""
    p = extract_parameters([candidate.sensor], [study.medium_of(candidate.sensor)])
    predicted = predict_scatter(p, rendered.z_mm, 0.5 * rendered.line_mm, reflectance=study.reflectance)
    figures, _ = compute_figures(p, reflectance=study.reflectance, water_depth_m=study.water_depth_m)
    found = np.isfinite(rendered.scatter_mm) & (predicted > 0)
    ratio = math.nan
    if found.any():
        weights = rendered.points[found]
        squares = [np.average(sigma[found] ** 2, weights=weights) for sigma in (rendered.scatter_mm, predicted)]
        ratio = math.sqrt(squares[0] / squares[1])
    factor = max(ratio, 1 / ratio)
    return Agreement(
        candidate.label,
        candidate.design.number,
        predicted_mm=predicted.tolist(),
        rendered_mm=rendered.scatter_mm.tolist(),
        **{name: getattr(rendered, name).tolist() for name in ("z_mm", "error_mm", "line_mm")},
        ratio=factor,
        rendered_over_predicted=ratio,
        agrees=bool(factor <= AGREES_WITHIN),
        exposure_ms=rendered.exposure_ms,
        predicted_exposure_ms=figures.exposure_ms.item(),
        seconds=rendered.seconds,
    )


def verify_candidates(
    study: Study,
    folder: Path,
    candidates: Sequence[HighlightedDesign],
    workers: Workers,
    *,
    variant: str,
    progress: ProgressListener = ignore_progress,
) -> list[Agreement]:
    """Verify candidates by rendering; return the results in the same order and keep each in a file of ``folder``.

    Results of an earlier run are read from their files; failed ones are rendered again.

    Raises OutputError if a file cannot be written; SetupError if the workers' cluster does not respond.
    """
    make_folder(folder)
    paths = []
    for candidate in candidates:
        what = "\n".join([candidate.sensor.model_dump_json(), study.medium, repr(study.reflectance), variant])
        paths.append(folder / f"{hashlib.sha256(what.encode()).hexdigest()[:16]}.parquet")
    known: dict[int, Agreement] = {}
    for place, path in enumerate(paths):
        with suppress(pa.ArrowInvalid, OSError):  # a file that is missing or damaged
            kept = Agreement(**pq.read_table(path).to_pylist()[0])
            known |= {} if kept.failure else {place: kept}
    waiting = [place for place in range(len(candidates)) if place not in known]
    work = partial(verify_candidate, study, workers=workers.processes_for(len(waiting)), variant=variant)
    progress(len(known), len(candidates))
    for candidate, result in workers.map_unordered(work, [candidates[place] for place in waiting]):
        place = next(place for place in waiting if candidates[place] is candidate)
        if isinstance(result, Lost):
            result = Agreement(candidate.label, candidate.design.number, failure=result.reason)
        with write_atomically(paths[place], overwrite=True) as aside:
            pq.write_table(pa.Table.from_pylist([asdict(result)]), aside)
        known[place] = result
        progress(len(known), len(candidates))
    # Label, number and tolerance can differ from those of the earlier run.
    return [
        replace(known[place], label=one.label, design=one.design.number, agrees=known[place].ratio <= AGREES_WITHIN)
        for place, one in enumerate(candidates)
    ]
