"""Sweep of a study: evaluate designs by formulas, refine the best, render a few, and write the results.

All files are in one folder, which several machines can share. ``plan.json`` contains the study, ``screen`` the results
of all evaluated designs in parts, and ``verified`` one file for each rendered design. A stopped sweep can be continued.
"""

from __future__ import annotations

import re
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import tomli_w
from pydantic import TypeAdapter

from twin.design.choice import StudyResults, choose
from twin.design.designs import Columns, HighlightedDesign
from twin.design.report.study_page import page_text
from twin.design.report.study_tables import failure_counts
from twin.design.screening import JOURNAL, PARTS, evaluate_study, read_parts, write_csv
from twin.design.study import Study, load_study
from twin.design.verification import Agreement, verify_candidates
from twin.recording.campaigns import PLAN, require_at_least
from twin.rendering_options import CPU, Variant
from uwlts.errors import DescriptionError
from uwlts.files.writing import write_atomically
from uwlts.model.short_text import Brief
from uwlts.pages.toolkit import write_page
from uwlts.runtime.progress import ProgressListener, ignore_progress
from uwlts.runtime.workers import open_workers

RENDERED = "verified"
PAGE = "report.html"
TABLE = "designs.csv"
WINNER = "winner.toml"
SUMMARY = "summary.json"
_REASONS = 3
"""Most frequent reasons of failure in the lines of a result; the page lists all."""


@dataclass(frozen=True, repr=False)
class SweepResult(Brief):
    """Result of a sweep.

    Attributes
    ----------
    study : Study
        The study.
    folder : Path
        Folder of report.html, designs.csv, summary.json and winner.toml.
    columns : dict of str to (N,) array
        All N designs: "design", the free values, the figures of merit (units in their names), "violation", "failure".
    marked : tuple of HighlightedDesign
        Base sensor if it works, best design, and refined design if it is better; the last one is the winner.
    agreements : tuple of Agreement
        Comparison of formulas and rendering for each rendered design.
    notes : tuple of str
        Sentences on the choice.
    """

    study: Study
    folder: Path
    columns: Columns
    marked: tuple[HighlightedDesign, ...]
    agreements: tuple[Agreement, ...]
    notes: tuple[str, ...]

    @property
    def winner(self) -> HighlightedDesign:
        """Design to build."""
        return self.marked[-1]

    def counts(self) -> tuple[int, int, int]:
        """Return the numbers of all designs, of working designs, and of designs that meet all constraints."""
        violation = self.columns["violation"]
        return len(violation), int(np.isfinite(violation).sum()), int((violation == 0).sum())

    def lines(self) -> list[str]:
        """Return the result as lines of text."""
        lines = ["{} designs, {} work, {} meet all constraints".format(*self.counts()), *self.notes]
        reasons = failure_counts(StudyResults(self.study, self.columns))[:_REASONS]
        lines += [f"{count} cannot work: {' '.join(reason.split())}" for reason, count in reasons]
        names = [*self.study.free(), *self.study.figures()]
        for one in self.marked:
            table = one.design.table().items()
            texts = {name: f"{value:.5g}" if isinstance(value, float) else str(value) for name, value in table}
            values = (f"{name} {texts[name]}" for name in names)
            lines.append(f"{one.label}{' (chosen)' if one is self.winner else ''}: {', '.join(values)}")
        for found in self.agreements:
            if found.failure:
                lines.append(f"rendered {found.label}: {found.failure}")
                continue
            verdict = "formulas and rendering agree" if found.agrees else "FORMULAS AND RENDERING DISAGREE"
            lines.append(
                f"rendered {found.label}: {verdict}, scatter {found.rendered_over_predicted:.2f} of the predicted one, "
                f"largest systematic error {found.largest_error_mm:.3f} mm, {found.seconds:.0f} s"
            )
        return [*lines, f"wrote {self.folder / PAGE}, {TABLE}, {SUMMARY} and {WINNER}"]


def sweep(
    study: str | Path | Study,
    *,
    out: str | Path | None = None,
    designs: int | None = None,
    verify: int | None = None,
    workers: int | None = None,
    scheduler: str | None = None,
    overwrite: bool = False,
    variant: Variant = CPU,
    progress: ProgressListener = ignore_progress,
) -> SweepResult:
    """Find the sensor to build: evaluate many designs by formulas, refine the best, and verify some by rendering.

    A stopped sweep continues when it is run again. Several machines can run it on the same folder at the same time. OUT
    receives report.html, designs.csv, summary.json and the best design as winner.toml, a sensor for twin simulate
    --sensor.

    Parameters
    ----------
    study : str, Path or Study
        Name (see: twin scenes) or path of the study's description, or a study.
    out : str or Path, optional
        Folder for all results; default: runs/STUDY.
    designs : int, optional
        Number of designs of a random, Sobol or optimised study; default: the study's.
    verify : int, optional
        Number of designs to render in addition to the base sensor, 0 for no rendering; default: the study's.
    workers : int, optional
        Number of processes on this machine; default: one per processor.
    scheduler : str, optional
        Address of a Dask scheduler, such as tcp://host:8786, to use its workers instead of this machine.
    overwrite : bool
        Remove the files of an earlier sweep from the folder.
    variant : str
        As for `simulate`.
    progress : callable
        Called with the number of designs done, the number in all, and the name of the stage.

    Returns
    -------
    SweepResult
        All designs, the winner, and the comparison of formulas and rendering.

    Raises
    ------
    DescriptionError
        The study is not valid, ``workers`` is below 1, or the folder contains other files.
    DesignError
        No design can work.
    OutputError
        A file cannot be written.
    SetupError
        The scheduler or the workers' cluster does not respond.

    Examples
    --------
    >>> result = twin.sweep("baseline-angle", out="runs/baseline-angle", verify=0)
    >>> result.winner.design.figures["sigma_z_rms_mm"]
    """
    require_at_least(1, workers=workers)
    if out is None and isinstance(study, Study):
        raise DescriptionError("`out` is missing: give the folder for a study that is not read from a file")
    folder = Path("runs") / Path(str(study)).stem if out is None else Path(out)
    described = load_study(study, designs=designs, verify=verify)
    if overwrite:
        remove_results(folder)
    with open_workers(workers=workers, scheduler=scheduler) as pool:
        evaluate_study(described, folder, pool, progress=progress)
        columns = read_parts(folder / PARTS)
        write_csv(folder / TABLE, columns)
        chosen = choose(described, columns)
        winner = chosen.marked[-1]
        notes = f"{winner.label} of the study: {described.title}"
        sensor = winner.sensor.model_copy(update={"name": f"{winner.sensor.name}-winner", "notes": notes})
        with write_atomically(folder / WINNER, overwrite=True) as aside:
            aside.write_text(tomli_w.dumps(sensor.model_dump(mode="json", exclude_none=True)), encoding="utf-8")
        agreements: list[Agreement] = []
        if described.verify:
            rendered = [winner, *(one for one in chosen.marked if one.design.number < 0), *chosen.further]
            agreements = verify_candidates(
                described, folder / RENDERED, rendered, pool, variant=variant, progress=progress
            )
    result = SweepResult(described, folder, columns, chosen.marked, tuple(agreements), chosen.notes)
    page = page_text(described, columns, marked=chosen.marked, agreements=agreements, notes=chosen.notes)
    write_page(folder / PAGE, page, overwrite=True)
    counts = dict(zip(("designs", "work", "meet_all_constraints"), result.counts(), strict=True))
    content: dict[str, Any] = {"title": described.title} | counts
    content["marked"] = [{"label": one.label} | one.design.table() for one in result.marked]
    content |= {"verified": result.agreements, "notes": result.notes}
    with write_atomically(folder / SUMMARY, overwrite=True) as aside:
        # NaN and infinity become null in JSON.
        aside.write_bytes(TypeAdapter(dict[str, Any]).dump_json(content, indent=2) + b"\n")
    return result


def remove_results(folder: Path) -> None:
    """Remove only the files of an earlier sweep from a folder; a folder without a plan is not changed."""
    if not (folder / PLAN).is_file():
        return
    for pattern in (f"{PARTS}/part-*.parquet", f"{PARTS}/lost-*.parquet", f"{RENDERED}/*.parquet"):
        for path in folder.glob(pattern):
            path.unlink()
    for place in (folder / PARTS, folder / RENDERED, folder):
        for path in place.glob(".*"):
            # Temporary files of a sweep that was killed.
            if path.is_file() and re.fullmatch(r"\.[0-9a-f]{16}\.(parquet|json|csv|toml|html)", path.name):
                path.unlink()
        if place != folder and place.is_dir() and not any(place.iterdir()):
            place.rmdir()
    for name in (PLAN, JOURNAL, f"{JOURNAL}.lock", PAGE, TABLE, WINNER, SUMMARY):
        (folder / name).unlink(missing_ok=True)
