"""Judging of all designs of a study by formulas, a batch at a time, into parts from which a stopped sweep continues.

Results are Parquet parts in a folder, each with the rows of a batch of designs and named after its first design. A part
appears whole, and a part that two machines have written is the same part: nothing is lost when one of them is stopped,
and nothing counts twice. An optimised study gets its designs from NSGA-II (Deb et al. 2002).
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

from twin.design.designs import Columns, Design, designs_of, failed, judged, number_of_designs
from twin.design.study import Study
from twin.recording.campaigns import keep_to_plan, made_folder
from uwlts.errors import CaptureError
from uwlts.files.reading import require_regular_file
from uwlts.files.writing import written_aside
from uwlts.runtime.progress import ProgressListener, unheard
from uwlts.runtime.workers import Lost, Workers

_MOST_PART_BYTES = 2**28


def part_path(folder: Path, first: int, *, lost: bool = False) -> Path:
    """The part that begins with a design, or what stands for it while it is lost with the process that made it."""
    return folder / f"{'lost' if lost else 'part'}-{first:09d}.parquet"


def as_part(columns: Columns) -> bytes:
    """A batch's columns as the content of a part."""
    sink = pa.BufferOutputStream()
    pq.write_table(pa.table(columns), sink)
    return sink.getvalue().to_pybytes()


def write_part(folder: Path, first: int, content: bytes, *, lost: bool = False) -> None:
    """Write a part, replacing what another run has written of the same batch."""
    with written_aside(part_path(folder, first, lost=lost), overwrite=True) as aside:
        aside.write_bytes(content)
    if not lost:
        part_path(folder, first, lost=True).unlink(missing_ok=True)


def parts(folder: Path) -> list[Path]:
    """All parts in a folder, by their first designs, and lost ones that have not been made since."""
    lost = [path for path in folder.glob("lost-*.parquet") if not path.with_name(f"part{path.name[4:]}").exists()]
    return sorted([*folder.glob("part-*.parquet"), *lost], key=lambda path: path.name[5:])


def rows_in(path: Path) -> int:
    """Number of designs in a part, 0 if there is none or it is damaged."""
    try:
        return pq.read_metadata(path).num_rows if path.is_file() else 0
    except (pa.ArrowInvalid, OSError):
        return 0


def read_parts(folder: Path) -> Columns:
    """Columns of all designs of a folder, in the order of their numbers; empty where there are none. CaptureError where
    a part is damaged or foreign."""
    tables = []
    for path in parts(folder):
        require_regular_file(path, most_bytes=_MOST_PART_BYTES, called="part of a sweep")
        try:
            table = pq.read_table(path)
            # Names of columns are decoded when they are asked for.
            if "design" not in table.column_names:
                raise pa.ArrowInvalid("it has no numbers of designs")
            tables.append(table)
        except (pa.ArrowException, OSError, UnicodeDecodeError, KeyError) as error:
            advice = "remove it, and the sweep judges its designs anew"
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
    """Write columns as CSV, replacing an older file."""
    with written_aside(path, overwrite=True) as aside, open(aside, "w", newline="", encoding="utf-8") as file:
        writer = csv.writer(file)
        writer.writerow(columns)
        writer.writerows(zip(*(column.tolist() for column in columns.values()), strict=True))


JOURNAL = "optimiser.log"
_NAME = "sweep"
_POPULATION = 64


def _open_search(study: Study, folder: Path) -> optuna.Study:
    """The optimiser, whose memory lies in a journal in the study's folder, which several machines may share."""
    optuna.logging.set_verbosity(optuna.logging.ERROR)
    journal = JournalStorage(JournalFileBackend(str(folder / JOURNAL)))
    # Several machines must not propose the same designs: the seed is for the first of them only.
    seed = None if _NAME in optuna.get_all_study_names(journal) else study.sampling.seed
    return optuna.create_study(
        storage=journal,
        sampler=optuna.samplers.NSGAIISampler(population_size=_POPULATION, seed=seed),
        study_name=_NAME,
        load_if_exists=True,
        directions=["minimize" if one.goal == "minimise" else "maximize" for one in study.objectives],
    )


def _report(search: optuna.Study, study: Study, columns: Columns) -> None:
    """Report columns of designs to the optimiser; those reported before are left alone."""
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
"""Settings that may differ when a sweep is resumed, besides the number of random, Sobol or optimised designs."""


@dataclass(frozen=True)
class Batch:
    """Designs to judge together, the first of which names the part."""

    study: Study
    designs: tuple[Design, ...] | None
    first: int
    count: int

    def all(self) -> list[Design]:
        """The designs."""
        return designs_of(self.study, self.first, self.count) if self.designs is None else list(self.designs)


def judged_part(batch: Batch) -> bytes:
    """Results of the formulas for a batch, as the content of its part."""
    return as_part(judged(batch.study, batch.all()))


def screen(study: Study, folder: Path, workers: Workers, *, progress: ProgressListener = unheard) -> None:
    """Judge all designs of a study that are not judged yet, into parts below ``folder``.

    DescriptionError where the folder holds another study, OutputError where a part cannot be written, SetupError where
    the workers' cluster is gone.
    """
    made_folder(folder)
    # Hidden files are being written by another machine that has just begun, or were by one that is gone.
    keep_to_plan(folder, _plan(study), set(), recorded="[!.]*", called="files", overwrite=False)
    place = made_folder(folder / PARTS)
    if study.sampling.kind == "optimise":
        _optimise(study, folder, place, workers, progress)
        return
    total, size = number_of_designs(study), study.sampling.batch
    batches = [Batch(study, None, first, min(size, total - first)) for first in range(0, total, size)]
    waiting = [batch for batch in batches if rows_in(part_path(place, batch.first)) < batch.count]
    # Several machines begin at different places, and look before each batch whether another has done it.
    random.shuffle(waiting)
    done = total - sum(batch.count for batch in waiting)
    progress(done, total)

    def left() -> Iterator[Batch]:
        nonlocal done
        for batch in waiting:
            if rows_in(part_path(place, batch.first)) < batch.count:
                yield batch
            else:
                done += batch.count

    for batch, result in workers.completed(judged_part, left()):
        write_part(place, batch.first, _content(batch, result), lost=isinstance(result, Lost))
        done += batch.count
        progress(done, total)


def _optimise(study: Study, folder: Path, place: Path, workers: Workers, progress: ProgressListener) -> None:
    """Judge what the optimiser proposes, a generation at a time, shared among the workers."""
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
    # Other machines may add designs of their own.
    while (done := sum(map(rows_in, parts(place)))) < total:
        progress(done, total)
        trials = [search.ask(space) for _ in range(min(study.sampling.batch, total - done))]
        asked = [Design(one.number, {name: free[name].taken(one.params[name]) for name in free}) for one in trials]
        share = -(-len(asked) // workers.count)
        shares = [tuple(asked[i : i + share]) for i in range(0, len(asked), share)]
        batches = [Batch(study, designs, designs[0].number, len(designs)) for designs in shares]
        for batch, result in workers.completed(judged_part, batches):
            content = _content(batch, result)
            write_part(place, batch.first, content)
            _report(search, study, _columns(pq.read_table(pa.BufferReader(content))))
            done += batch.count
            progress(done, total)


def _content(batch: Batch, result: bytes | Lost) -> bytes:
    """A part's content; of a batch whose worker died, all designs fail with the reason, until it is tried again."""
    if not isinstance(result, Lost):
        return result
    return as_part(failed(batch.study, batch.all(), [result.reason] * batch.count))


def _plan(study: Study) -> dict[str, JsonValue]:
    """What the results of a study follow from."""
    plan = study.model_dump(mode="json", exclude=set(_FREE_TO_CHANGE))
    del plan["sampling"]["designs"]
    return plan | {"sensor": study.sensor.model_dump(mode="json")}
