"""Verification of designs by rendering: the twin records, the sensor's software calibrates and measures.

The software runs as a separate program, as for a real sensor. Its points are compared with the true plane, and their
scatter with what the formulas predict.
"""

from __future__ import annotations

import hashlib
import json
import math
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
from plyfile import PlyData, PlyParseError

from twin.design.description import Study
from twin.design.figures import figures_of, scatter_at
from twin.design.parameters import parameters_of
from twin.design.screening import made_folder
from twin.design.verification_scenes import Recording, recordings
from twin.options import CPU, Options, use_variant
from uwlts.model.errors import (
    CalibrationError,
    CaptureError,
    DescriptionError,
    Error,
    EvaluationError,
    OutputError,
    SetupError,
)
from uwlts.model.sensor import Sensor
from uwlts.runtime.workers import Lost, Workers, work_through
from uwlts.storage.capture import Capture, part_path
from uwlts.storage.files import written_aside
from uwlts.storage.truth import truth_path

_USER_ERROR = 2
_FEWEST_POINTS = 20
_LARGEST_RESIDUAL = 5.0
"""In robust standard deviations: points farther from the profile's trend count as outliers."""
_MAD_TO_STD = 1.4826


@dataclass(frozen=True)
class CalibrationFigures:
    """Figures of a calibration: the window's distance found and the step heights' error with it (None where no window
    was sought), the residuals of camera and sheet, and warnings."""

    window_mm: float | None
    window_std_mm: float | None
    step_rms_mm: float | None
    camera_rms_px: float
    focal_length_px: float
    target_images: int
    sheet_rms_mm: float
    warnings: list[str]


@dataclass(frozen=True, eq=False)
class Profiles:
    """What a sensor measures of a plane square to the laser's axis, at K depths.

    Attributes
    ----------
    z_mm : (K,)
        True Z of the plane in the OCS, ascending.
    points : (K,) int
        Points found at each depth, including outliers.
    scatter_mm, error_mm : (K,)
        Along Z: standard deviation of the points about the profile's own quadratic trend (the random part), and their
        mean deviation from the true plane (the systematic part, with the error of the calibrated OCS's origin, which
        moves all depths alike). Outliers, farther from the trend than five robust standard deviations, are left out.
        NaN where fewer than 20 points were found.
    line_mm : (K,)
        Length along Y over which points were found, without outliers; 0 where there are fewer than 20.
    """

    z_mm: np.ndarray
    points: np.ndarray
    scatter_mm: np.ndarray
    error_mm: np.ndarray
    line_mm: np.ndarray


@dataclass(frozen=True, eq=False)
class Rendered(Profiles):
    """Profiles of a rendered sensor, exposure of the plane's images, and seconds to render, calibrate and measure."""

    exposure_ms: float
    calibration: CalibrationFigures
    seconds: dict[str, float]


def verify(
    sensor: Sensor,
    medium: str,
    folder: Path,
    *,
    reflectance: float = 0.5,
    seed: int = 0,
    spp: int = 16,
    variant: str = CPU,
    workers: int = 2,
    keep: bool = False,
) -> Rendered:
    """Calibrate a sensor and measure a plane of a reflectance with it, all by rendered images, in one of its media.

    What an earlier run left in ``folder`` is overwritten. The calibration stays there; captures, their truth and the
    cloud stay only if ``keep`` is set. Equal arguments give equal results. With one worker the images are rendered in
    this process, else in processes of their own.

    Raises
    ------
    DescriptionError, DesignError
        The sensor cannot work in the medium, or not be calibrated.
    CalibrationError, CaptureError
        The sensor's software cannot calibrate the sensor or finds no stripe; the message is the software's.
    EvaluationError
        The cloud has too few points at every depth.
    OutputError
        A file cannot be written.
    SetupError
        A process was ended from outside, or the machine cannot render.
    """
    if workers < 1:
        raise DescriptionError(f"workers is {workers}; it must be at least 1")
    planned = recordings(sensor, medium, reflectance=reflectance)
    calibration, cloud = folder / "calibration.json", folder / "standard.ply"
    made_folder(folder)
    try:
        calibration.unlink(missing_ok=True)  # one of an earlier run must not pass for this one's
    except OSError as error:
        raise OutputError(f"cannot replace {calibration}: {error.strerror}") from error
    # Noise must differ between recordings: each has a seed of its own.
    seeds = [int(np.random.SeedSequence([seed, k]).generate_state(1)[0]) for k in range(len(planned.all()))]
    jobs = [
        _Job(recording, _capture(folder, recording), Options(spp=spp, seed=one), variant)
        for recording, one in zip(planned.all(), seeds, strict=True)
    ]
    seconds: dict[str, float] = {}
    try:
        with _timed(seconds, "render"):
            work_through(_record, jobs, workers=min(workers, len(jobs)))
        with _timed(seconds, "calibrate"):
            steps = [] if planned.step is None else ["--step", str(_capture(folder, planned.step))]
            target = str(_capture(folder, planned.target))
            _run("calibrate", "--air", target, *steps, "--out", str(calibration), fails_as=CalibrationError)
        with _timed(seconds, "measure"):
            capture = _capture(folder, planned.standard)
            known = ("--calibration", str(calibration), "--out", str(cloud))
            _run("reconstruct", str(capture), *known, fails_as=CaptureError)
            with Capture(capture) as opened:
                exposure, stage = float(opened.exposure_ms[0]), np.array(opened.stage_mm)
            profiles = _judged(_points(cloud), stage)
    finally:
        if not keep:
            for path in (cloud, *(path for job in jobs for path in job.files())):
                path.unlink(missing_ok=True)
    return Rendered(**vars(profiles), exposure_ms=exposure, calibration=_figures(calibration), seconds=seconds)


@contextmanager
def _timed(seconds: dict[str, float], name: str) -> Iterator[None]:
    begun = time.perf_counter()
    yield
    seconds[name] = time.perf_counter() - begun


# --- the twin's part --------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class _Job:
    """A recording to render into a file, one of several rendered at the same time."""

    recording: Recording
    path: Path
    options: Options
    variant: str

    def files(self) -> tuple[Path, Path, Path]:
        """Capture, truth and unfinished capture."""
        return self.path, truth_path(self.path), part_path(self.path)


def _capture(folder: Path, recording: Recording) -> Path:
    return folder / f"{recording.name}.h5"


def _record(job: _Job, report: Callable[[object], None]) -> None:
    use_variant(job.variant)
    import drjit as dr

    from twin.recording.studio import record_scene

    recording, threads = job.recording, dr.thread_count()
    dr.set_thread_count(1)
    try:
        record_scene(recording.scene, recording.sensor, job.path, options=job.options, overwrite=True)
    except Error as error:
        raise type(error)(f"{recording.scene.title}: {error}") from error
    finally:
        dr.set_thread_count(threads)


# --- the sensor's software --------------------------------------------------------------------------------------------


def _run(command: str, *arguments: str, fails_as: type[Error]) -> None:
    """Run a command of the sensor's software; its complaint as an error of a class where it fails."""
    line = [sys.executable, "-m", "uwlts.cli", command, *arguments, "--overwrite"]
    done = subprocess.run(line, check=False, capture_output=True, text=True)
    if done.returncode == 0:
        return
    said = done.stderr.strip().splitlines() or ["it says nothing"]
    if done.returncode == _USER_ERROR:
        raise fails_as(said[-1].removeprefix("error: "))
    raise SetupError(f"uwlts {command} has ended unexpectedly (exit code {done.returncode}): {said[-1]}")


def _figures(path: Path) -> CalibrationFigures:
    """Figures of a calibration file."""
    content = json.loads(path.read_text(encoding="utf-8"))
    camera, sheet = content["residuals"]["camera"], content["residuals"]["sheet"]
    window = content["residuals"].get("window")
    return CalibrationFigures(
        window_mm=window and window["distance_mm"],
        window_std_mm=window and window["std_mm"],
        step_rms_mm=window and float(np.sqrt(np.mean(np.square(window["errors_mm"])))),
        camera_rms_px=camera["rms_px"],
        focal_length_px=content["camera"]["fx_px"],
        target_images=camera["images"],
        sheet_rms_mm=sheet["rms_mm"],
        warnings=content["provenance"]["warnings"],
    )


# --- the comparison ---------------------------------------------------------------------------------------------------


def _points(cloud: Path) -> np.ndarray:
    """Frame, Y and Z in mm, scene coordinates, of a cloud's points: (N, 3)."""
    try:
        vertices = PlyData.read(str(cloud))["vertex"].data
        return np.column_stack([vertices[name] for name in ("frame", "y", "z")]).astype(np.float64)
    except (OSError, PlyParseError, ValueError) as error:
        raise CaptureError(f"{cloud} is not the cloud of the plane standard: {error}") from error


def _judged(points: np.ndarray, stage_mm: np.ndarray) -> Profiles:
    """Profiles, nearest first, from points (N, 3) with frame, Y and Z about the plane Z = 0.

    The stage stood at ``stage_mm`` (K,) along Z.
    """
    order = np.argsort(-stage_mm)
    found = [points[points[:, 0] == frame, 1:] for frame in order]
    enough = [len(profile) >= _FEWEST_POINTS for profile in found]
    if not any(enough):
        raise EvaluationError(
            f"the plane standard shows {len(points)} points at {len(order)} depths, at least {_FEWEST_POINTS} are "
            "needed at one depth: check that the stripe is bright enough and in focus"
        )
    nothing = (math.nan, math.nan, 0.0)
    figures = np.array([_profile(p) if good else nothing for p, good in zip(found, enough, strict=True)])
    scatter, error, line = figures.T
    return Profiles(-stage_mm[order], np.array([len(profile) for profile in found]), scatter, error, line)


def _profile(points_yz: np.ndarray) -> tuple[float, float, float]:
    """Scatter, mean deviation and length in mm of a profile (N, 2) of the plane Z = 0, as `Rendered` defines them."""
    used = points_yz
    # The first trend is pulled by the outliers that the second one is free of.
    for _ in range(2):
        y, z = used.T
        trend = np.polynomial.Polynomial.fit(y, z, 2)
        residuals = points_yz[:, 1] - trend(points_yz[:, 0])
        centre = np.median(residuals)
        spread = _MAD_TO_STD * np.median(np.abs(residuals - centre))
        used = points_yz[np.abs(residuals - centre) <= _LARGEST_RESIDUAL * spread]
    y, z = used.T
    residuals = z - np.polynomial.Polynomial.fit(y, z, 2)(y)
    return float(np.sqrt(residuals @ residuals / (len(y) - 3))), float(z.mean()), float(np.ptp(y))


# --- candidates of a study ----------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Candidate:
    """A design to render: its name, its number in the study (-1 if it is none of it), and the sensor as built."""

    label: str
    number: int
    sensor: Sensor


@dataclass(frozen=True)
class Verification:
    """A job: a candidate of a study, the number of processes it may use, the Mitsuba variant, and the seed."""

    study: Study
    candidate: Candidate
    workers: int
    variant: str
    seed: int = 0


@dataclass(frozen=True)
class Agreement:
    """Rendered and predicted scatter of a candidate at depths Z, and whether they agree.

    ``ratio`` is the root mean square over all points of the rendered scatter over that of the predicted one, or its
    inverse if that is larger; they agree up to the study's tolerance. What the software or the renderer refuses stands
    in ``failure``; the depths are empty then.
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


def verified(job: Verification) -> Agreement:
    """Render a candidate and compare its scatter with the predicted one."""
    study, candidate = job.study, job.candidate
    try:
        with tempfile.TemporaryDirectory(prefix="verify-") as folder:
            rendered = verify(
                candidate.sensor,
                study.medium,
                Path(folder),
                reflectance=study.reflectance,
                seed=job.seed,
                variant=job.variant,
                workers=job.workers,
            )
    except (Error, OSError) as error:
        return Agreement(candidate.label, candidate.number, failure=str(error))
    return compared(study, candidate, rendered)


def compared(study: Study, candidate: Candidate, rendered: Rendered) -> Agreement:
    """Rendered and predicted figures of a candidate side by side."""
    p = parameters_of([candidate.sensor], [study.medium_of(candidate.sensor)])
    predicted = scatter_at(p, rendered.z_mm, 0.5 * rendered.line_mm, reflectance=study.reflectance)
    figures, _ = figures_of(p, reflectance=study.reflectance, water_depth_m=study.water_depth_m)
    found = np.isfinite(rendered.scatter_mm) & (predicted > 0)
    ratio = math.nan
    if found.any():
        squares = [
            np.average(sigma[found] ** 2, weights=rendered.points[found]) for sigma in (rendered.scatter_mm, predicted)
        ]
        ratio = math.sqrt(squares[0] / squares[1])
    factor = max(ratio, 1 / ratio)
    return Agreement(
        candidate.label,
        candidate.number,
        z_mm=rendered.z_mm.tolist(),
        predicted_mm=predicted.tolist(),
        rendered_mm=rendered.scatter_mm.tolist(),
        error_mm=rendered.error_mm.tolist(),
        line_mm=rendered.line_mm.tolist(),
        ratio=factor,
        rendered_over_predicted=ratio,
        agrees=bool(factor <= study.verify_tolerance),
        exposure_ms=rendered.exposure_ms,
        predicted_exposure_ms=figures.exposure_ms.item(),
        seconds=sum(rendered.seconds.values()),
    )


def render(
    study: Study,
    folder: Path,
    candidates: Sequence[Candidate],
    workers: Workers,
    *,
    variant: str,
    progress: Callable[[int, int], None] = lambda done, total: None,
) -> list[Agreement]:
    """Verify candidates, in their order; each result is kept in a file of ``folder``.

    What was rendered before is taken from there, but what failed is tried again.

    Raises
    ------
    OutputError
        A file cannot be written.
    SetupError
        The workers' cluster is gone.
    """
    made_folder(folder)
    paths = [folder / f"{_digest(study, candidate, variant)}.parquet" for candidate in candidates]
    known = {place: kept for place, path in enumerate(paths) if (kept := _kept_in(path)) and not kept.failure}
    waiting = [place for place in range(len(candidates)) if place not in known]
    each = workers.processes_for(len(waiting))
    jobs = {place: Verification(study, candidates[place], each, variant) for place in waiting}
    progress(len(known), len(candidates))
    for job, result in workers.completed(verified, jobs.values()):
        place = next(place for place, one in jobs.items() if one is job)
        if isinstance(result, Lost):
            result = Agreement(job.candidate.label, job.candidate.number, failure=result.reason)
        with written_aside(paths[place], overwrite=True) as aside:
            pq.write_table(pa.Table.from_pylist([asdict(result)]), aside)
        known[place] = result
        progress(len(known), len(candidates))
    # Name and tolerance may be others than when a result was kept.
    return [
        replace(known[place], label=one.label, design=one.number, agrees=known[place].ratio <= study.verify_tolerance)
        for place, one in enumerate(candidates)
    ]


def _kept_in(path: Path) -> Agreement | None:
    """The result that a file holds, None if there is none."""
    try:
        return Agreement(**pq.read_table(path).to_pylist()[0]) if path.is_file() else None
    except (pa.ArrowInvalid, OSError):
        return None


def _digest(study: Study, candidate: Candidate, variant: str) -> str:
    """A name for what is rendered."""
    what = (candidate.sensor.model_dump_json(), study.medium, repr(study.reflectance), variant)
    return hashlib.sha256("\n".join(what).encode()).hexdigest()[:16]
