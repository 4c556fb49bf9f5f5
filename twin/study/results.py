"""Results of a study: Parquet parts in a folder, each with the rows of a batch of designs, read together as a table.

A part is named after its first design. It appears whole, and a part that two machines have written is the same part:
nothing is lost when one of them is stopped, and nothing counts twice.
"""

from __future__ import annotations

import csv
from collections.abc import Iterable
from pathlib import Path

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq

from uwlts.errors import CaptureError, OutputError
from uwlts.files import written_aside


def part_path(folder: Path, first: int, *, lost: bool = False) -> Path:
    """The part that begins with a design, or what stands for it while it is lost with the process that made it."""
    return folder / f"{'lost' if lost else 'part'}-{first:09d}.parquet"


def as_part(columns: dict[str, np.ndarray]) -> bytes:
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
    """How many designs a part holds, 0 if there is none or it is damaged."""
    try:
        return pq.read_metadata(path).num_rows if path.is_file() else 0
    except (pa.ArrowInvalid, OSError):
        return 0


def read_parts(folder: Path) -> dict[str, np.ndarray]:
    """Columns of all designs of a folder, in the order of their numbers; empty where there are none.

    Raises
    ------
    CaptureError
        A part is damaged or foreign.
    """
    columns: dict[str, np.ndarray] = {}
    tables = []
    for path in parts(folder):
        try:
            tables.append(pq.read_table(path))
        except (pa.ArrowException, OSError) as error:
            raise CaptureError(
                f"{path} is damaged: {error}; remove it, and the sweep judges its designs anew"
            ) from error
    if not tables:
        return columns
    try:
        table = pa.concat_tables(tables, promote_options="permissive")
    except pa.ArrowException as error:
        raise CaptureError(f"the parts in {folder} are not of one study: {error}") from error
    numbers = table.column("design").to_numpy()
    _, first = np.unique(numbers, return_index=True)
    for name in table.column_names:
        columns[name] = table.column(name).to_numpy(zero_copy_only=False)[first]
    return columns


def write_csv(path: Path, columns: dict[str, np.ndarray], *, names: Iterable[str] | None = None) -> None:
    """Write columns as CSV, replacing an older file."""
    chosen = list(columns if names is None else names)
    with written_aside(path, overwrite=True) as aside, open(aside, "w", newline="", encoding="utf-8") as file:
        writer = csv.writer(file)
        writer.writerow(chosen)
        writer.writerows(zip(*(columns[name].tolist() for name in chosen), strict=True))


def made_folder(folder: Path) -> Path:
    """The folder, made if there is none."""
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise OutputError(f"cannot make the folder {folder}: {error.strerror}") from error
    return folder
