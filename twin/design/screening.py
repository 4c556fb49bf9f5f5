"""Evaluation of all designs of a study by formulas, in batches, with results in parts that a stopped sweep reuses.

Results are Parquet files in a folder. Each part contains a batch of designs and has the number of its first design in
its name. Parts are written atomically. Two machines that evaluate the same batch write the same part, so that nothing
is lost or counted twice. An optimised study gets its designs from NSGA-II (Deb et al. 2002).
"""

from __future__ import annotations

import csv
import math
import random
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import optuna
import pyarrow as pa
import pyarrow.parquet as pq
from optuna.distributions import BaseDistribution, CategoricalDistribution, FloatDistribution
from optuna.storages import JournalStorage
from optuna.storages.journal import JournalFileBackend
from optuna.trial import Trial, TrialState
from pydantic import JsonValue

from twin.design.designs import Columns, Design, count_designs, evaluate_designs, make_failed_columns, sample_designs
from twin.design.study import Study
from twin.recording.campaigns import keep_to_plan, make_folder
from uwlts.errors import CaptureError
from uwlts.files.reading import require_regular_file
from uwlts.files.writing import write_atomically
from uwlts.runtime.progress import ProgressListener, ignore_progress
from uwlts.runtime.workers import Lost, Workers, map_in_threads

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
    with write_atomically(part_path(folder, first, lost=lost), overwrite=True) as aside:
        aside.write_bytes(content)
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
            advice = "remove it and run the sweep again"
            raise CaptureError(f"{path} is damaged: {error}; {advice}") from error
    if not tables:
        return {}
    try:
        table = pa.concat_tables(tables, promote_options="permissive")
    except pa.ArrowException as error:
        raise CaptureError(f"the parts in {folder} are not of one study: {error}") from error
    columns = _columns(table)
    _, first = np.unique(columns["design"], return_index=True)
    return {name: column[first] for name, column in columns.items()}


def _columns(table: pa.Table) -> Columns:
    return {name: table.column(name).to_numpy(zero_copy_only=False) for name in table.column_names}


def write_csv(path: Path, columns: Columns) -> None:
    """Write columns as CSV and replace an older file."""
    with write_atomically(path, overwrite=True) as aside, open(aside, "w", newline="", encoding="utf-8") as file:
        writer = csv.writer(file)
        writer.writerow(columns)
        writer.writerows(zip(*(column.tolist() for column in columns.values()), strict=True))


JOURNAL = "optimiser.log"
_NAME = "sweep"
_POPULATION = 64  # designs of a generation of NSGA-II


def _open_search(study: Study, folder: Path) -> optuna.Study:
    """Open the optimiser, with its history in a journal in the study's folder, which several machines can share."""
    optuna.logging.set_verbosity(optuna.logging.ERROR)
    journal = JournalStorage(JournalFileBackend(str(folder / JOURNAL)))
    # Only the first machine uses the seed, so that different machines propose different designs.
    seed = None if _NAME in optuna.get_all_study_names(journal) else study.sampling.seed
    return optuna.create_study(
        storage=journal,
        sampler=optuna.samplers.NSGAIISampler(population_size=_POPULATION, seed=seed),
        study_name=_NAME,
        load_if_exists=True,
        directions=["minimize" if one.goal == "minimise" else "maximize" for one in study.objectives],
    )


def _report(search: optuna.Study, study: Study, columns: Columns) -> None:
    """Report the results of designs to the optimiser, except those that were reported before."""
    trials = {trial.number: trial for trial in search.get_trials(deepcopy=False)}
    for place, number in enumerate(columns["design"].tolist()):
        if number not in trials or trials[number].state != TrialState.RUNNING:
            continue
        values = [float(columns[objective.figure][place]) for objective in study.objectives]
        violation = float(columns["violation"][place])
        if math.isfinite(violation) and all(map(math.isfinite, values)):
            Trial(search, trials[number]._trial_id).set_constraint("violation", violation)
            search.tell(number, values)
        else:
            search.tell(number, state=TrialState.FAIL)


PARTS = "screen"
_FREE_TO_CHANGE = ("verify", "verify_tolerance", "refine", "title")
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
    # Hidden files are temporary files of another machine, running or stopped.
    keep_to_plan(folder, _plan(study), set(), recorded="[!.]*", called="files", overwrite=False)
    place = make_folder(folder / PARTS)
    if study.sampling.kind == "optimise":
        _optimise(study, folder, place, workers, progress)
        return
    total, size = count_designs(study), study.sampling.batch
    batches = [Batch(study, None, first, min(size, total - first)) for first in range(0, total, size)]
    waiting = [batch for batch in batches if count_rows(part_path(place, batch.first)) < batch.count]
    # Machines work in different orders, and check before each batch whether another machine has done it.
    random.shuffle(waiting)
    done = total - sum(batch.count for batch in waiting)
    progress(done, total)

    def left() -> Iterator[Batch]:
        nonlocal done
        for batch in waiting:
            if count_rows(part_path(place, batch.first)) < batch.count:
                yield batch
            else:
                done += batch.count

    def write(evaluated: tuple[Batch, bytes | Lost]) -> None:
        batch, result = evaluated
        write_part(place, batch.first, _content(batch, result), lost=isinstance(result, Lost))

    # In threads: to flush a part to the disk takes as long as to evaluate one.
    for (batch, _), _ in map_in_threads(write, workers.map_unordered(evaluate_batch, left())):
        done += batch.count
        progress(done, total)


def _optimise(study: Study, folder: Path, place: Path, workers: Workers, progress: ProgressListener) -> None:
    """Evaluate the optimiser's designs, one generation at a time, distributed over the workers."""
    search, free = _open_search(study, folder), study.free()
    space: dict[str, BaseDistribution] = {
        name: FloatDistribution(*variable.ends(), log=variable.scale == "log")
        if variable.values is None
        else CategoricalDistribution(variable.values)
        for name, variable in free.items()
    }
    if known := read_parts(place):
        _report(search, study, known)
    total = study.sampling.designs
    # Other machines can add designs, too.
    while (done := sum(map(count_rows, list_parts(place)))) < total:
        progress(done, total)
        trials = [search.ask(space) for _ in range(min(study.sampling.batch, total - done))]
        asked = [
            Design(one.number, {name: free[name].round_value(one.params[name]) for name in free}) for one in trials
        ]
        share = -(-len(asked) // workers.count)
        shares = [tuple(asked[i : i + share]) for i in range(0, len(asked), share)]
        batches = [Batch(study, designs, designs[0].number, len(designs)) for designs in shares]
        for batch, result in workers.map_unordered(evaluate_batch, batches):
            content = _content(batch, result)
            write_part(place, batch.first, content)
            _report(search, study, _columns(pq.read_table(pa.BufferReader(content))))
            done += batch.count
            progress(done, total)


def _content(batch: Batch, result: bytes | Lost) -> bytes:
    """Return the content of a part; if the worker has died, a placeholder with failed designs and the reason."""
    if not isinstance(result, Lost):
        return result
    return encode_part(make_failed_columns(batch.study, batch.all(), [result.reason] * batch.count))


def _plan(study: Study) -> dict[str, JsonValue]:
    """Return the settings that determine the results of a study."""
    plan = study.model_dump(mode="json", exclude=set(_FREE_TO_CHANGE))
    del plan["sampling"]["designs"]
    return plan | {"sensor": study.sensor.model_dump(mode="json")}
