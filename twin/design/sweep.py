"""Sweep of a study: designs are judged by formulas, the best is improved, a few are rendered, and results written.

Everything lies in one folder, to which several machines may append: ``plan.json`` holds the study, ``screen`` parts
with all designs that are judged, ``verified`` one file for every design that was rendered. A sweep that is stopped
continues where it was.
"""

from __future__ import annotations

import json
import math
import re
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np
import tomli_w

from twin.design.choice import choose
from twin.design.description import Study, Value, load_study
from twin.design.designs import Columns, Marked
from twin.design.report.page import write_study_page
from twin.design.screening import JOURNAL, PARTS, PLAN, Progress, read_parts, screen, write_csv
from twin.design.verification import Agreement, Candidate, render
from twin.options import CPU
from uwlts.model.errors import DescriptionError
from uwlts.runtime.workers import open_workers
from uwlts.storage.files import written_aside

RENDERED = "verified"


@dataclass(frozen=True)
class SweepPaths:
    """Files that a sweep writes: the page, the table of all designs, the winning sensor, and the summary."""

    page: Path
    table: Path
    winner: Path
    summary: Path

    @classmethod
    def below(cls, folder: Path) -> SweepPaths:
        """Those in a folder."""
        return cls(folder / "report.html", folder / "designs.csv", folder / "winner.toml", folder / "summary.json")


@dataclass(frozen=True)
class SweepResult:
    """Result of a sweep.

    ``columns`` hold all designs; ``marked`` are those pointed out, the last of which is the ``winner``; ``agreements``
    say whether the formulas agree with rendering; ``notes`` are sentences on the choice.
    """

    study: Study
    columns: Columns
    marked: tuple[Marked, ...]
    agreements: tuple[Agreement, ...]
    notes: tuple[str, ...]
    paths: SweepPaths

    @property
    def winner(self) -> Marked:
        """The design to build."""
        return self.marked[-1]

    def lines(self) -> list[str]:
        """The result in lines of text for a terminal."""
        violation = self.columns["violation"]
        works, meets = np.isfinite(violation).sum(), (violation == 0).sum()
        lines = [f"{len(violation)} designs, {works} work, {meets} meet all constraints", *self.notes]
        figures = [o.figure for o in self.study.objectives] + list(self.study.constraints)
        names = [*self.study.free(), *dict.fromkeys(figures)]
        for one in self.marked:
            table = one.design.table()
            values = (f"{name} {_short(table[name])}" for name in names)
            lines.append(f"{one.label}{' (chosen)' if one is self.winner else ''}: {', '.join(values)}")
        for found in self.agreements:
            if found.failure:
                lines.append(f"rendered {found.label}: {found.failure}")
                continue
            worst = max((abs(error) for error in found.error_mm if math.isfinite(error)), default=math.nan)
            verdict = "formulas and rendering agree" if found.agrees else "FORMULAS AND RENDERING DISAGREE"
            lines.append(
                f"rendered {found.label}: {verdict}, scatter {found.rendered_over_predicted:.2f} of the predicted one, "
                f"largest systematic error {worst:.3f} mm, {found.seconds:.0f} s"
            )
        return lines


def _short(value: Value) -> str:
    return f"{value:.5g}" if isinstance(value, float) else str(value)


def sweep(
    study: str | Path | Study,
    *,
    out: str | Path | None = None,
    designs: int | None = None,
    verify: int | None = None,
    workers: int | None = None,
    scheduler: str | None = None,
    overwrite: bool = False,
    variant: str = CPU,
    progress: Progress = lambda what, done, total: None,
) -> SweepResult:
    """Judge a study's designs, choose the best, render some, and write page, table, winner and summary into a folder.

    Parameters
    ----------
    study
        Name or path of the study's description, or the study itself.
    out
        Folder for all results; runs/STUDY unless given. A sweep that was stopped there continues.
    designs
        How many designs a random, Sobol or optimised study judges, in place of the study's own number.
    verify
        How many designs are rendered beside the base sensor, 0 for none, in place of the study's own number.
    workers, scheduler
        Processes of this machine, one per processor unless given, or the address of a Dask scheduler.
    overwrite
        Remove what an earlier sweep has left in the folder.
    variant
        Mitsuba variant for rendering.
    progress
        Called with what is being done, how many designs are done, and of how many.

    Raises
    ------
    DescriptionError
        ``workers`` is below 1, or the folder holds something else.
    DesignError
        No design can work.
    OutputError
        A file cannot be written.
    SetupError
        No scheduler answers, or the workers' cluster is gone.
    """
    if workers is not None and workers < 1:
        raise DescriptionError(f"workers is {workers}; it must be at least 1")
    if isinstance(study, Study):
        if out is None or designs is not None or verify is not None:
            raise DescriptionError("a study that is not loaded by name needs a folder, and states its numbers itself")
    else:
        out = out or Path("runs") / Path(study).stem
        study = load_study(study, designs=designs, verify=verify)
    out = Path(out)
    if overwrite:
        clear(out)
    paths = SweepPaths.below(out)
    with open_workers(workers=workers, scheduler=scheduler) as pool:
        screen(study, out, pool, progress=progress)
        columns = read_parts(out / PARTS)
        write_csv(paths.table, columns)
        chosen = choose(study, columns)
        winner = chosen.marked[-1]
        write_winner(paths.winner, study, winner)
        agreements: list[Agreement] = []
        if study.verify:
            rendered = [winner, *(one for one in chosen.marked if one.design.number < 0), *chosen.further]
            candidates = [Candidate(one.label, one.design.number, one.sensor) for one in rendered]
            agreements = render(
                study,
                out / RENDERED,
                candidates,
                pool,
                variant=variant,
                progress=lambda done, total: progress("rendering", done, total),
            )
    result = SweepResult(study, columns, chosen.marked, tuple(agreements), chosen.notes, paths)
    write_study_page(paths.page, study, columns, marked=chosen.marked, agreements=agreements, notes=chosen.notes)
    write_summary(result)
    return result


def write_winner(path: Path, study: Study, winner: Marked) -> None:
    """Write the winning sensor as a description that every command takes."""
    notes = f"{winner.label} of the study: {study.title}"
    sensor = winner.sensor.model_copy(update={"name": f"{winner.sensor.name}-winner", "notes": notes})
    with written_aside(path, overwrite=True) as aside, open(aside, "wb") as file:
        tomli_w.dump(sensor.model_dump(mode="json", exclude_none=True), file)


def write_summary(result: SweepResult) -> None:
    """Write in numbers what the page shows of the marked and the rendered designs."""
    violation = result.columns["violation"]
    content = {
        "title": result.study.title,
        "designs": len(violation),
        "work": int(np.isfinite(violation).sum()),
        "meet_all_constraints": int((violation == 0).sum()),
        "marked": [{"label": one.label} | one.design.table() for one in result.marked],
        "verified": [asdict(one) for one in result.agreements],
        "notes": list(result.notes),
    }
    with written_aside(result.paths.summary, overwrite=True) as aside:
        aside.write_text(json.dumps(_finite(content), indent=2) + "\n", encoding="utf-8")


def _finite(value: Any) -> Any:
    """The value with null in place of numbers that JSON cannot hold."""
    if isinstance(value, dict):
        return {key: _finite(one) for key, one in value.items()}
    if isinstance(value, list):
        return [_finite(one) for one in value]
    return None if isinstance(value, float) and not math.isfinite(value) else value


def clear(folder: Path) -> None:
    """Remove what an earlier sweep has left in a folder, and nothing else; a folder of other files stays as it is."""
    if not (folder / PLAN).is_file():
        return
    for pattern in (f"{PARTS}/part-*.parquet", f"{PARTS}/lost-*.parquet", f"{RENDERED}/*.parquet"):
        for path in folder.glob(pattern):
            path.unlink()
    for place in (folder, folder / PARTS, folder / RENDERED):
        for path in place.glob(".*"):
            # What was being written when an earlier sweep was killed.
            if path.is_file() and re.fullmatch(r"\.[0-9a-f]{16}\.(parquet|json|csv|toml|html)", path.name):
                path.unlink()
    for place in (folder / PARTS, folder / RENDERED):
        if place.is_dir() and not any(place.iterdir()):
            place.rmdir()
    journals = [folder / name for name in (PLAN, JOURNAL, f"{JOURNAL}.lock")]
    for path in (*journals, *vars(SweepPaths.below(folder)).values()):
        path.unlink(missing_ok=True)
