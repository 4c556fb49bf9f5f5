"""Holds the formulas against the rendered measurement of one design."""

from __future__ import annotations

import hashlib
import math
import tempfile
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq

from twin.study.crew import Crew, Lost
from twin.study.description import Study
from twin.study.figures import figures_of, scatter_at
from twin.study.parameters import parameters_of
from twin.study.results import made_folder
from twin.study.verification import Rendered, verify
from uwlts.errors import UwltsError
from uwlts.files import written_aside
from uwlts.sensor import Sensor


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


def verified(job: Verification) -> dict[str, Any]:
    """A row that says what rendering found of a candidate, what the formulas had said, and whether they agree.

    "ratio" is the root mean square over all points of the rendered scatter over that of the predicted one, or its
    inverse if that is larger; they agree up to the study's tolerance. What the software or the renderer refuses stands
    in "failure".
    """
    study, candidate = job.study, job.candidate
    try:
        with tempfile.TemporaryDirectory(prefix="verify-") as folder:
            rendered = verify(
                candidate.sensor, study.medium, Path(folder), reflectance=study.reflectance,
                seed=job.seed, variant=job.variant, workers=job.workers,
            )  # fmt: skip
    except (UwltsError, OSError) as error:
        return _failed(candidate, str(error))
    return _named(candidate) | compared(study, candidate.sensor, rendered)


def compared(study: Study, sensor: Sensor, rendered: Rendered) -> dict[str, Any]:
    """Rendered and predicted figures of a sensor side by side."""
    p = parameters_of([sensor], [study.medium_of(sensor)])
    predicted = scatter_at(p, rendered.z_mm, 0.5 * rendered.line_mm, reflectance=study.reflectance)
    figures, _ = figures_of(p, reflectance=study.reflectance, water_depth_m=study.water_depth_m)
    found = np.isfinite(rendered.scatter_mm) & (predicted > 0)
    ratio = math.nan
    if found.any():
        squares = [np.average(sigma[found] ** 2, weights=rendered.points[found])
                   for sigma in (rendered.scatter_mm, predicted)]  # fmt: skip
        ratio = math.sqrt(squares[0] / squares[1])
    factor = max(ratio, 1 / ratio)
    return {
        "z_mm": rendered.z_mm.tolist(), "predicted_mm": predicted.tolist(), "rendered_mm": rendered.scatter_mm.tolist(),
        "error_mm": rendered.error_mm.tolist(), "line_mm": rendered.line_mm.tolist(),
        "ratio": factor, "rendered_over_predicted": ratio, "agrees": bool(factor <= study.verify_tolerance),
        "exposure_ms": rendered.exposure_ms, "predicted_exposure_ms": figures.exposure_ms.item(),
        "seconds": sum(rendered.seconds.values()), "failure": "",
    }  # fmt: skip


def _named(candidate: Candidate) -> dict[str, Any]:
    return {"label": candidate.label, "design": candidate.number}


def _failed(candidate: Candidate, reason: str) -> dict[str, Any]:
    lists = {name: [] for name in ("z_mm", "predicted_mm", "rendered_mm", "error_mm", "line_mm")}
    numbers = ("ratio", "rendered_over_predicted", "exposure_ms", "predicted_exposure_ms", "seconds")
    return _named(candidate) | lists | dict.fromkeys(numbers, math.nan) | {"agrees": False, "failure": reason}


def render(
    study: Study, folder: Path, candidates: Sequence[Candidate], crew: Crew, *, variant: str,
    progress: Callable[[int, int], None] = lambda done, total: None,
) -> list[dict[str, Any]]:  # fmt: skip
    """Rows of the candidates' verifications, in their order; each is kept in a file of ``folder``.

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
    rows = [_row_in(path) for path in paths]
    waiting = [place for place, row in enumerate(rows) if row is None or row["failure"]]
    each = crew.processes_for(len(waiting))
    jobs = {place: Verification(study, candidates[place], each, variant) for place in waiting}
    done = len(candidates) - len(waiting)
    progress(done, len(candidates))
    for job, result in crew.work(verified, jobs.values()):
        place = next(place for place, one in jobs.items() if one is job)
        row = _failed(job.candidate, result.reason) if isinstance(result, Lost) else result
        with written_aside(paths[place], overwrite=True) as aside:
            pq.write_table(pa.Table.from_pylist([row]), aside)
        rows[place] = row
        done += 1
        progress(done, len(candidates))
    # Name and tolerance may be others than when a row was kept.
    return [
        row | {"label": one.label, "design": one.number, "agrees": bool(row["ratio"] <= study.verify_tolerance)}
        for row, one in zip(rows, candidates, strict=True)
    ]


def _row_in(path: Path) -> dict[str, Any] | None:
    """The row that a file holds, None if there is none."""
    try:
        return pq.read_table(path).to_pylist()[0] if path.is_file() else None
    except (pa.ArrowInvalid, OSError):
        return None


def _digest(study: Study, candidate: Candidate, variant: str) -> str:
    """A name for what is rendered."""
    what = (candidate.sensor.model_dump_json(), study.medium, repr(study.reflectance), variant)
    return hashlib.sha256("\n".join(what).encode()).hexdigest()[:16]
