"""Judges all designs of a study by formulas, a batch at a time, into parts that a stopped sweep goes on from."""

from __future__ import annotations

import json
import random
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq

from twin.study.crew import Crew, Lost
from twin.study.description import Study
from twin.study.designs import Design, judged
from twin.study.results import as_part, made_folder, part_path, read_parts, rows_in, write_part
from twin.study.results import parts as stored
from twin.study.sampling import designs_of, number_of_designs
from twin.study.search import Search
from uwlts.errors import DescriptionError
from uwlts.files import written_aside

Progress = Callable[[str, int, int], None]
PLAN, PARTS = "plan.json", "screen"
_FREE_TO_CHANGE = ("verify", "verify_tolerance", "refine", "title")
"""What may be different when a sweep is gone on with, besides the number of random, Sobol or optimised designs."""


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
    """What the formulas say of a batch, as the content of its part."""
    return as_part(judged(batch.study, batch.all()))


def screen(study: Study, folder: Path, crew: Crew, *, progress: Progress = lambda what, done, total: None) -> None:
    """Judge all designs of a study that are not judged yet, into parts below ``folder``.

    Raises
    ------
    DescriptionError
        The folder holds another study.
    OutputError
        A part cannot be written.
    SetupError
        The workers' cluster is gone.
    """
    keep_to_plan(study, folder)
    parts = made_folder(folder / PARTS)
    if study.sampling.kind == "optimise":
        _optimise(study, folder, parts, crew, progress)
        return
    total, size = number_of_designs(study), study.sampling.batch
    batches = [Batch(study, None, first, min(size, total - first)) for first in range(0, total, size)]
    waiting = [batch for batch in batches if rows_in(part_path(parts, batch.first)) < batch.count]
    # Several machines begin at different places, and look before each batch whether another has done it.
    random.shuffle(waiting)
    done = total - sum(batch.count for batch in waiting)
    progress("screening", done, total)

    def left() -> Iterator[Batch]:
        nonlocal done
        for batch in waiting:
            if rows_in(part_path(parts, batch.first)) < batch.count:
                yield batch
            else:
                done += batch.count

    for batch, result in crew.work(judged_part, left()):
        write_part(parts, batch.first, _content(batch, result), lost=isinstance(result, Lost))
        done += batch.count
        progress("screening", done, total)


def _optimise(study: Study, folder: Path, parts: Path, crew: Crew, progress: Progress) -> None:
    """Judge what the optimiser proposes, a generation at a time, shared among the workers."""
    search = Search(study, folder)
    known = read_parts(parts)
    if known:
        search.tell(known)
    total = study.sampling.designs
    # Other machines may add designs of their own.
    while (done := sum(map(rows_in, stored(parts)))) < total:
        progress("optimising", done, total)
        asked = search.ask(min(study.sampling.batch, total - done))
        share = -(-len(asked) // crew.workers)
        batches = [
            Batch(study, tuple(asked[i : i + share]), asked[i].number, len(asked[i : i + share]))
            for i in range(0, len(asked), share)
        ]
        for batch, result in crew.work(judged_part, batches):
            content = _content(batch, result)
            write_part(parts, batch.first, content)
            table = pq.read_table(pa.BufferReader(content))
            search.tell({name: table.column(name).to_numpy(zero_copy_only=False) for name in table.column_names})
            done += batch.count
            progress("optimising", done, total)


def _content(batch: Batch, result: bytes | Lost) -> bytes:
    """A part's content; of a batch whose worker died, all designs fail with the reason, until it is tried again."""
    if not isinstance(result, Lost):
        return result
    designs = batch.all()
    columns = judged(batch.study, [])
    columns = {name: np.full(len(designs), np.nan) for name in columns} | {
        "design": np.array([design.number for design in designs]),
        "violation": np.full(len(designs), np.inf),
        "failure": np.array([result.reason] * len(designs), dtype=object),
    }
    for name in batch.study.free():
        columns[name] = np.array([design.values[name] for design in designs])
    return as_part(columns)


def keep_to_plan(study: Study, folder: Path) -> None:
    """Write down what a folder's study is, or make sure that it is the same.

    Raises
    ------
    DescriptionError
        The folder holds another study, or other files.
    """
    made_folder(folder)
    plan = json.loads(study.model_dump_json(exclude=set(_FREE_TO_CHANGE)))
    del plan["sampling"]["designs"]
    plan["sensor"] = json.loads(study.base().model_dump_json())
    path = folder / PLAN
    if path.is_file():
        try:
            known = json.loads(path.read_text(encoding="utf-8"))
        except (OSError, ValueError) as error:
            raise DescriptionError(f"{path} cannot be read: {error}; give another folder, or --overwrite") from error
        if known != plan:
            other = ", ".join(key for key in plan if not isinstance(known, dict) or known.get(key) != plan[key])
            raise DescriptionError(
                f"{folder} holds a study with another {other}: give another folder, or --overwrite to start afresh"
            )
        return
    if any(not path.name.startswith(".") for path in folder.iterdir()):
        if path.is_file():
            # Another machine has just begun.
            return keep_to_plan(study, folder)
        raise DescriptionError(f"{folder} holds other files: give a folder of its own")
    with written_aside(path, overwrite=True) as aside:
        aside.write_text(json.dumps(plan, indent=2) + "\n", encoding="utf-8")
