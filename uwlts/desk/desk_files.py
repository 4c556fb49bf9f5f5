"""The files of the desk's folder: plans, captures, calibrations, clouds and reports."""

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
from uwlts.storage.capture import part_path
from uwlts.storage.cloud_files import is_cloud

_SHOWN = 500
_REMEMBERED = 4 * _SHOWN
_FORMATS = {CALIBRATION_FORMAT: "calibration", POLYNOMIAL_FORMAT: "calibration", EVALUATION_FORMAT: "evaluation"}
_LONGEST_NAME = 200
"""Of a new file, in bytes: file systems take 255, with all that is appended."""


@dataclass(frozen=True)
class ListedFile:
    """A file by its name, what it probably is, its size in bytes and when it was last changed, in s."""

    name: str
    kind: str
    size: int
    time_s: float


def listed(folder: Path) -> list[ListedFile]:
    """The files that the program knows what to do with, the latest first; at most 500."""
    found = []
    try:
        entries = list(os.scandir(folder))
    except OSError as error:
        raise DescriptionError(f"the folder {folder} cannot be read: {error.strerror}") from error
    for entry in entries:
        # What was renamed or removed meanwhile, and links in a circle, are none.
        with suppress(OSError):
            if kind_of(entry.name) and not entry.name.startswith(".") and entry.is_file():
                about = entry.stat()
                if kind := _kind_by_content(entry.path, about.st_mtime_ns):
                    found.append(ListedFile(entry.name, kind, about.st_size, about.st_mtime))
    return sorted(found, key=lambda file: file.time_s, reverse=True)[:_SHOWN]


def kind_of(name: str) -> str:
    """What a file may be by its name; empty where the program makes no such files."""
    match name.split("."):
        case [_, *_, "h5", "part"]:
            return "interrupted capture"
        case [_, *_, "truth", "h5"]:
            return "truth"
        case [_, *_, "ply"] | [_, *_, "copc", "laz"]:
            return "cloud"
        case [_, *_, "h5"]:
            return "capture"
        case [_, *_, "json"]:
            return "calibration"
        case [_, *_, "toml"]:
            return "description"
        case [_, *_, "html"]:
            return "report"
        case _:
            return ""


@lru_cache(_REMEMBERED)
def _kind_by_content(path: str, changed_ns: int) -> str:
    """What a file is by the label in it, where its name does not tell; empty for those of other programs."""
    kind = kind_of(os.path.basename(path))
    try:
        if kind == "capture" and is_cloud(path):
            return "cloud"
        if kind == "calibration":
            return _FORMATS.get(str(read_json(path, called="file of this program").get("format")), "")
    except Error:
        return "damaged file"
    return kind


def file_in(folder: Path, name: str) -> Path:
    """A listed file's path; DescriptionError for names that lead elsewhere or to no regular file."""
    path = folder / name
    if not _is_plain(name) or not kind_of(name) or not is_regular_file(path):
        raise DescriptionError(f"'{name}' is not a file of the folder {folder}")
    return path


def new_in(folder: Path, name: str, *, suffix: str) -> Path:
    """Path for a result in the folder; DescriptionError for names that lead elsewhere."""
    name = name.strip()
    if not _is_plain(name) or len(name.encode()) > _LONGEST_NAME:
        raise DescriptionError(f"'{name}' is no name for a file of the folder: give letters, digits, - and _")
    return folder / (name if name.endswith(suffix) else f"{name}{suffix}")


def _is_plain(name: str) -> bool:
    """Whether a name is that of a file in the folder itself, and not hidden."""
    return bool(name) and Path(name).name == name and not name.startswith(".") and name.isprintable()


def interrupted(path: Path) -> bool:
    """Whether an interrupted recording of a path can be continued."""
    return part_path(path).is_file()
