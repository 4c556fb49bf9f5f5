"""Files of the desk's folder: plans, captures, calibrations, clouds and reports.

Symbolic links are not followed, because a link could publish a file from outside the folder.
"""

import os
from contextlib import suppress
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path

from uwlts.errors import DescriptionError, Error
from uwlts.evaluation.evaluate import FORMAT as EVALUATION_FORMAT
from uwlts.files.json_files import read_json
from uwlts.files.reading import is_regular_file
from uwlts.storage.calibration_file import FORMAT as CALIBRATION_FORMAT, POLYNOMIALS_FORMAT as POLYNOMIAL_FORMAT
from uwlts.storage.cloud_files import is_cloud
from uwlts.storage.foreign_clouds import FORMATS

_SHOWN = 500  # the latest files; a longer list is not read
_REMEMBERED = 4 * _SHOWN  # files whose description is kept
_FORMATS = {CALIBRATION_FORMAT: "calibration", POLYNOMIAL_FORMAT: "calibration", EVALUATION_FORMAT: "evaluation"}
_KINDS = {
    ".h5.part": "interrupted capture",
    ".truth.h5": "truth",
    ".ply": "cloud",
    ".h5": "capture",
    **{ending: "exported cloud" for ending, each in FORMATS.items() if each.write is not None},
    ".measured.json": "measured values",
    **dict.fromkeys((".findings.json", ".registration.json", ".recalibration.json", ".measured.csv"), "figures"),
    ".csv": "table",
    ".json": "calibration",
    ".pdf": "printed report",
    ".toml": "description",
    ".html": "report",
}
"""Kinds by endings; the first that fits counts."""
_LONGEST_NAME = 200  # longest name of a new file in bytes: file systems allow 255, including appended endings


@dataclass(frozen=True)
class ListedFile:
    """A file with its name, probable kind, size in bytes and modification time in s."""

    name: str
    kind: str
    size: int
    time_s: float


def list_files(folder: Path) -> list[ListedFile]:
    """List the files of the kinds that the program uses, the latest first; at most 500."""
    found = []
    try:
        entries = list(os.scandir(folder))
    except OSError as error:
        raise DescriptionError(f"the folder {folder} cannot be read: {error.strerror}") from error
    for entry in entries:
        # Files that were renamed or removed meanwhile are skipped.
        with suppress(OSError):
            is_file = entry.is_file(follow_symlinks=False)
            if is_file and guess_kind(entry.name) and not entry.name.startswith("."):
                about = entry.stat(follow_symlinks=False)
                if kind := _find_kind_by_content(entry.path, about.st_mtime_ns):
                    found.append(ListedFile(entry.name, kind, about.st_size, about.st_mtime))
    return sorted(found, key=lambda file: file.time_s, reverse=True)[:_SHOWN]


def guess_kind(name: str) -> str:
    """Return the kind of a file by its name; empty if the program does not use such files."""
    return next((kind for ending, kind in _KINDS.items() if name.endswith(ending)), "")


@lru_cache(_REMEMBERED)
def _find_kind_by_content(path: str, changed_ns: int) -> str:
    """Return the kind of a file, by the label in it if its name is ambiguous; empty for other programs' files."""
    kind = guess_kind(os.path.basename(path))
    try:
        if kind == "capture" and is_cloud(path):
            return "cloud"
        if kind == "calibration":
            content = read_json(path, called="file of this program", check_seal=False)
            return _FORMATS.get(str(content.get("format")), "")
    except Error:
        return "damaged file"
    return kind


def find_file(folder: Path, name: str) -> Path:
    """Return a listed file's path; raises DescriptionError if the name is not that of a regular file in the folder."""
    path = folder / name
    if not _is_plain(name) or not guess_kind(name) or not is_regular_file(path) or path.is_symlink():
        raise DescriptionError(f"'{name}' is not a file of the folder {folder}")
    return path


def new_path(folder: Path, name: str, *, suffix: str) -> Path:
    """Return the path of a result in the folder; raises DescriptionError if the name is not a plain file name."""
    name = name.strip()
    if not _is_plain(name) or len(name.encode()) > _LONGEST_NAME:
        raise DescriptionError(f"'{name}' is not a name for a file in the folder: give letters, digits, - and _")
    return folder / (name if name.endswith(suffix) else f"{name}{suffix}")


def _is_plain(name: str) -> bool:
    """Return whether a name is that of a file in the folder itself, and not hidden."""
    return bool(name) and Path(name).name == name and not name.startswith(".") and name.isprintable()
