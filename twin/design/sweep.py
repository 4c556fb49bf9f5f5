"""Sweep of a study: evaluate designs by formulas, refine the best, render a few, and write the results.

All files are in one folder. ``plan.json`` contains the study, ``screen`` the results of all evaluated designs in parts,
and ``verified`` one file for each rendered design. A stopped sweep can be continued.

Each part is a Parquet file of a batch of designs, written atomically, and has the number of its first design in its
name. An optimised study gets its designs from NSGA-II (Deb et al. 2002).
"""

from __future__ import annotations

import csv
import math
from collections.abc import Iterator
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import optuna
import pyarrow as pa
import pyarrow.parquet as pq
import tomli_w
from optuna.distributions import BaseDistribution, CategoricalDistribution, FloatDistribution
from optuna.storages import JournalStorage
from optuna.storages.journal import JournalFileBackend
from optuna.trial import Trial, TrialState
from pydantic import TypeAdapter

from twin.design.choice import StudyResults, choose
from twin.design.designs import (
    Columns,
    Design,
    HighlightedDesign,
    count_designs,
    evaluate_designs,
    make_failed_columns,
    sample_designs,
)
from twin.design.study import Study, load_study
from twin.design.study_tables import failure_counts
from twin.design.verification import Agreement, verify_candidates
from twin.recording.campaigns import PLAN, keep_to_plan, make_folder, require_at_least
from twin.rendering_options import CPU, Variant
from uwlts.errors import CaptureError, DescriptionError
from uwlts.files.reading import require_regular_file
from uwlts.files.writing import write_atomically, write_file
from uwlts.model.short_text import Brief
from uwlts.pages.toolkit import write_page
from uwlts.runtime.progress import ProgressListener, ignore_progress
from uwlts.runtime.workers import Lost, Workers, map_in_threads, open_workers

_MOST_PART_BYTES = 2**28  # thousands of times a usual part, far below the memory


def part_path(folder: Path, first: int, *, lost: bool = False) -> Path:
    """Return the path of the part with a first design; ``lost``: of its placeholder after its worker has died."""
    return folder / f"{'lost' if lost else 'part'}-{first:09d}.parquet"


def encode_part(columns: Columns) -> bytes:
    """Return the columns of a batch as the content of a part."""
    sink = pa.BufferOutputStream()
    pq.write_table(pa.table(columns), sink)
    return sink.getvalue().to_pybytes()


def write_part(folder: Path, first: int, content: bytes, *, lost: bool = False) -> None:
    """Write a part and replace an older one of the same batch."""
    write_file(part_path(folder, first, lost=lost), content, overwrite=True)
    if not lost:
        part_path(folder, first, lost=True).unlink(missing_ok=True)


def list_parts(folder: Path) -> list[Path]:
    """Return all parts in a folder, sorted by first design, including placeholders of lost parts."""
    lost = [path for path in folder.glob("lost-*.parquet") if not path.with_name(f"part{path.name[4:]}").exists()]
    return sorted([*folder.glob("part-*.parquet"), *lost], key=lambda path: path.name[5:])


def count_rows(path: Path) -> int:
    """Return the number of designs in a part; 0 if it is missing or damaged."""
    try:
        return pq.read_metadata(path).num_rows if path.is_file() else 0
    except (pa.ArrowInvalid, OSError):
        return 0


def read_parts(folder: Path) -> Columns:
    """Read the columns of all designs in a folder, sorted by number; empty if there are none.

    Raises CaptureError if a part is damaged or belongs to another study.
    """
    tables = []
    for path in list_parts(folder):
        require_regular_file(path, most_bytes=_MOST_PART_BYTES, called="part of a sweep")
        try:
            table = pq.read_table(path)
            # Column names are decoded here, which can fail.
            if "design" not in table.column_names:
                raise pa.ArrowInvalid("the column 'design' is missing")
            tables.append(table)
        except (pa.ArrowException, OSError, UnicodeDecodeError, KeyError) as error:
            raise CaptureError(f"{path} is damaged: {error}; remove it and run the sweep again") from error
    if not tables:
        return {}
    try:
        table = pa.concat_tables(tables, promote_options="permissive")
    except pa.ArrowException as error:
        raise CaptureError(f"the parts in {folder} are not of one study: {error}") from error
    columns = {name: table.column(name).to_numpy(zero_copy_only=False) for name in table.column_names}
    _, first = np.unique(columns["design"], return_index=True)
    return {name: column[first] for name, column in columns.items()}


def write_csv(path: Path, columns: Columns) -> None:
    """Write columns as CSV and replace an older file."""
    with write_atomically(path, overwrite=True) as aside, open(aside, "w", newline="", encoding="utf-8") as file:
        writer = csv.writer(file)
        writer.writerow(columns)
        writer.writerows(zip(*(column.tolist() for column in columns.values()), strict=True))


PARTS = "screen"
_FREE_TO_CHANGE = ("verify", "title")
"""Settings that can differ when a sweep is continued, as can the number of random, Sobol or optimised designs."""


@dataclass(frozen=True)
class Batch:
    """Designs that are evaluated together; the number of the first one names the part."""

    study: Study
    designs: tuple[Design, ...] | None
    first: int
    count: int

    def all(self) -> list[Design]:
        """Return the designs."""
        return sample_designs(self.study, self.first, self.count) if self.designs is None else list(self.designs)


def evaluate_batch(batch: Batch) -> bytes:
    """Evaluate a batch by formulas; return the content of its part."""
    return encode_part(evaluate_designs(batch.study, batch.all()))


def evaluate_study(
    study: Study, folder: Path, workers: Workers, *, progress: ProgressListener = ignore_progress
) -> None:
    """Evaluate all remaining designs of a study and write the parts below ``folder``.

    Raises DescriptionError if the folder contains another study; OutputError if a part cannot be written; SetupError if
    the workers' cluster does not respond.
    """
    make_folder(folder)
    plan = study.model_dump(mode="json", exclude=set(_FREE_TO_CHANGE))
    del plan["sampling"]["designs"]
    plan |= {"sensor": study.sensor.model_dump(mode="json")}
    # Hidden files are temporary files of a stopped sweep.
    keep_to_plan(folder, plan, set(), recorded="[!.]*", called="files", overwrite=False)
    place, total = make_folder(folder / PARTS), count_designs(study)

    def write(evaluated: tuple[Batch, bytes | Lost]) -> None:
        batch, result = evaluated
        lost = isinstance(result, Lost)
        if lost:
            result = encode_part(make_failed_columns(study, batch.all(), [result.reason] * batch.count))
        write_part(place, batch.first, result, lost=lost)

    optimised = study.sampling.kind == "optimise"
    for done, batches in _propose(study, folder, workers.count) if optimised else [_find_missing(study, place)]:
        progress(done, total)
        # In threads: to flush a part to the disk takes as long as to evaluate one.
        for (batch, _), _ in map_in_threads(write, workers.map_unordered(evaluate_batch, batches)):
            done += batch.count
            progress(done, total)


def _find_missing(study: Study, place: Path) -> tuple[int, list[Batch]]:
    """Return the number of evaluated designs of a grid, random or Sobol study, and the batches without a part."""
    total, size = count_designs(study), study.sampling.batch
    batches = [Batch(study, None, first, min(size, total - first)) for first in range(0, total, size)]
    missing = [batch for batch in batches if count_rows(part_path(place, batch.first)) < batch.count]
    return total - sum(batch.count for batch in missing), missing


def _propose(study: Study, folder: Path, workers: int) -> Iterator[tuple[int, list[Batch]]]:
    """Yield the number of evaluated designs and the optimiser's next ones, a batch for each of the workers.

    The parts are read before each proposal. The optimiser's history is a journal in the folder.
    """
    optuna.logging.set_verbosity(optuna.logging.ERROR)
    search = optuna.create_study(
        storage=JournalStorage(JournalFileBackend(str(folder / JOURNAL))),
        study_name="sweep",
        load_if_exists=True,
        directions=["minimize" if one.goal == "minimise" else "maximize" for one in study.objectives],
    )
    # With the seed of its beginning, a continued sweep would draw the same random numbers again.
    seed = study.sampling.seed + len(search.trials)
    search.sampler = optuna.samplers.NSGAIISampler(population_size=_POPULATION, seed=seed)
    free = study.free()
    space: dict[str, BaseDistribution] = {
        name: FloatDistribution(*variable.ends(), log=variable.scale == "log")
        if variable.values is None
        else CategoricalDistribution(variable.values)
        for name, variable in free.items()
    }
    while True:
        columns = read_parts(folder / PARTS)
        done = len(columns["design"]) if columns else 0
        _report(search, study, columns)
        if (left := study.sampling.designs - done) <= 0:
            return
        trials = [search.ask(space) for _ in range(min(study.sampling.batch, left))]
        whole = {name for name in free if free[name].whole and free[name].values is None}
        drawn = (
            {name: round(one.params[name]) if name in whole else one.params[name] for name in free} for one in trials
        )
        asked = [Design(one.number, values) for one, values in zip(trials, drawn, strict=True)]
        share = -(-len(asked) // workers)
        shares = [tuple(asked[i : i + share]) for i in range(0, len(asked), share)]
        yield done, [Batch(study, designs, designs[0].number, len(designs)) for designs in shares]


def _report(search: optuna.Study, study: Study, columns: Columns) -> None:
    """Report the results of designs to the optimiser, except those that were reported before."""
    places = {number: place for place, number in enumerate(columns["design"].tolist())} if columns else {}
    for trial in search.get_trials(deepcopy=False, states=(TrialState.RUNNING,)):
        if (place := places.get(trial.number)) is None:
            continue
        values = [float(columns[objective.figure][place]) for objective in study.objectives]
        violation = float(columns["violation"][place])
        if math.isfinite(violation) and all(map(math.isfinite, values)):
            Trial(search, trial._trial_id).set_constraint("violation", violation)
            search.tell(trial.number, values)
        else:
            search.tell(trial.number, state=TrialState.FAIL)


JOURNAL = "optimiser.log"
_POPULATION = 64  # designs of a generation of NSGA-II
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

    A stopped sweep continues when it is run again. OUT receives report.html, designs.csv, summary.json and the best
    design as winner.toml, a sensor for twin simulate --sensor.

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
        marked, further, remarks = choose(described, columns)
        winner = marked[-1]
        notes = f"{winner.label} of the study: {described.title}"
        sensor = winner.sensor.model_copy(update={"name": f"{winner.sensor.name}-winner", "notes": notes})
        write_file(folder / WINNER, tomli_w.dumps(sensor.model_dump(mode="json", exclude_none=True)), overwrite=True)
        agreements: list[Agreement] = []
        if described.verify:
            rendered = [winner, *(one for one in marked if one.design.number < 0), *further]
            agreements = verify_candidates(
                described, folder / RENDERED, rendered, pool, variant=variant, progress=progress
            )
    result = SweepResult(described, folder, columns, marked, tuple(agreements), remarks)
    # Its libraries of charts take seconds to import, which processes that evaluate designs do not need.
    from twin.design.study_page import page_text

    page = page_text(described, columns, marked=marked, agreements=agreements, notes=remarks)
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
    hidden = f".{'[0-9a-f]' * 16}"  # temporary files of a sweep that was killed
    patterns = [f"{PARTS}/part-*.parquet", f"{PARTS}/lost-*.parquet", f"{RENDERED}/[!.]*.parquet"]
    patterns += [f"{PARTS}/{hidden}.parquet", f"{RENDERED}/{hidden}.parquet"]
    patterns += [f"{hidden}.{ending}" for ending in ("json", "csv", "toml", "html")]
    names = (PLAN, JOURNAL, f"{JOURNAL}.lock", PAGE, TABLE, WINNER, SUMMARY)
    for path in [path for pattern in (*patterns, *names) for path in folder.glob(pattern)]:
        path.unlink()
    for place in (PARTS, RENDERED):
        with suppress(OSError):  # missing, or it contains other files
            (folder / place).rmdir()
