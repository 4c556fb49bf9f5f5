"""Runs a study: judges its designs by formulas, improves the best, renders a few, and writes what was found.

Everything lies in one folder, to which several machines may append: ``plan.json`` says what is swept, ``screen`` holds
parts with all designs that are judged, ``verified`` one file for every design that was rendered. A sweep that is
stopped goes on where it was, for everything that is there counts.
"""

from __future__ import annotations

import json
import math
import re
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import tomli_w

from twin.study.choice import choose
from twin.study.description import Study
from twin.study.designs import Marked
from twin.study.report.page import write_page
from twin.study.screening import JOURNAL, PARTS, PLAN, Progress, read_parts, screen, write_csv
from twin.study.verification import Candidate, render
from uwlts.files import written_aside
from uwlts.workers import Workers

PAGE, TABLE, WINNER, SUMMARY = "report.html", "designs.csv", "winner.toml", "summary.json"
RENDERED = "verified"


@dataclass(frozen=True)
class Outcome:
    """What a sweep has found: the designs' columns, the marked designs (the last one wins), and what was rendered."""

    columns: dict[str, np.ndarray]
    marked: tuple[Marked, ...]
    verified: tuple[dict[str, Any], ...]
    notes: tuple[str, ...]


def sweep(
    study: Study, folder: Path, workers: Workers, *, variant: str, progress: Progress = lambda what, done, total: None
) -> Outcome:
    """Judge a study's designs, choose the best, render some, and write table, page, winner and summary into a folder.

    Raises
    ------
    DescriptionError
        The folder holds something else.
    DesignError
        No design can work.
    OutputError
        A file cannot be written.
    SetupError
        The workers' cluster is gone.
    """
    screen(study, folder, workers, progress=progress)
    columns = read_parts(folder / PARTS)
    write_csv(folder / TABLE, columns)
    chosen = choose(study, columns)
    winner = chosen.marked[-1]
    write_winner(folder / WINNER, study, winner)
    rows: list[dict[str, Any]] = []
    if study.verify:
        candidates = [Candidate(winner.label, winner.row["design"], winner.sensor)]
        candidates += [Candidate(m.label, m.row["design"], m.sensor) for m in chosen.marked if m.row["design"] < 0]
        candidates += [Candidate(m.label, m.row["design"], m.sensor) for m in chosen.further]
        rows = render(
            study, folder / RENDERED, candidates, workers, variant=variant,
            progress=lambda done, total: progress("rendering", done, total),
        )  # fmt: skip
    outcome = Outcome(columns, chosen.marked, tuple(rows), chosen.notes)
    write_page(folder / PAGE, study, columns, marked=chosen.marked, verified=rows, notes=chosen.notes)
    write_summary(folder / SUMMARY, study, outcome)
    return outcome


def write_winner(path: Path, study: Study, winner: Marked) -> None:
    """Write the winning sensor as a description that every command takes."""
    notes = f"{winner.label} of the study: {study.title}"
    sensor = winner.sensor.model_copy(update={"name": f"{winner.sensor.name}-winner", "notes": notes})
    with written_aside(path, overwrite=True) as aside, open(aside, "wb") as file:
        tomli_w.dump(sensor.model_dump(mode="json", exclude_none=True), file)


def write_summary(path: Path, study: Study, outcome: Outcome) -> None:
    """Write in numbers what the page shows of the marked and the rendered designs."""
    violation = outcome.columns["violation"]
    content = {
        "title": study.title,
        "designs": len(violation),
        "work": int(np.isfinite(violation).sum()),
        "meet_all_constraints": int((violation == 0).sum()),
        "marked": [{"label": one.label, **one.row} for one in outcome.marked],
        "verified": list(outcome.verified),
        "notes": list(outcome.notes),
    }
    with written_aside(path, overwrite=True) as aside:
        aside.write_text(json.dumps(_finite(content), indent=2) + "\n", encoding="utf-8")


def _finite(value: Any) -> Any:
    """The value with null in place of numbers that JSON cannot hold."""
    if isinstance(value, dict):
        return {key: _finite(one) for key, one in value.items()}
    if isinstance(value, list):
        return [_finite(one) for one in value]
    return None if isinstance(value, float) and not math.isfinite(value) else value


def outcome_lines(study: Study, outcome: Outcome) -> list[str]:
    """What the terminal says of a sweep."""
    violation, winner = outcome.columns["violation"], outcome.marked[-1]
    lines = [
        f"{len(violation)} designs, {np.isfinite(violation).sum()} work, {(violation == 0).sum()} meet all constraints",
        *outcome.notes,
    ]
    names = [*study.free(), *dict.fromkeys([o.figure for o in study.objectives] + list(study.constraints))]
    for one in outcome.marked:
        values = (f"{name} {_short(one.row[name])}" for name in names)
        lines.append(f"{one.label}{' (chosen)' if one is winner else ''}: {', '.join(values)}")
    for row in outcome.verified:
        if row["failure"]:
            lines.append(f"rendered {row['label']}: {row['failure']}")
            continue
        worst = max((abs(error) for error in row["error_mm"] if math.isfinite(error)), default=math.nan)
        says = "formulas and rendering agree" if row["agrees"] else "FORMULAS AND RENDERING DISAGREE"
        lines.append(
            f"rendered {row['label']}: {says}, scatter {row['rendered_over_predicted']:.2f} of the predicted one, "
            f"largest systematic error {worst:.3f} mm, {row['seconds']:.0f} s"
        )
    return lines


def _short(value: Any) -> str:
    return f"{value:.5g}" if isinstance(value, float) else str(value)


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
    for name in (PLAN, PAGE, TABLE, WINNER, SUMMARY, JOURNAL, f"{JOURNAL}.lock"):
        (folder / name).unlink(missing_ok=True)
