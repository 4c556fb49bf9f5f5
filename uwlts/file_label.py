"""The label of the program's HDF5 files: the attributes ``format``, ``version`` and ``header`` (JSON).

They are stored as text of fixed length, which lies under HDF5's checksums. Text of variable length would not: where it
is damaged, HDF5 may search for its end for ever.
"""

import json
from pathlib import Path
from typing import TypeVar

import h5py
import numpy as np

from uwlts.errors import CaptureError, UwltsError
from uwlts.library import validated
from uwlts.sensor import Description

AnyHeader = TypeVar("AnyHeader", bound=Description)


def write_label(file: h5py.File, *, format: str, version: int, header: Description) -> None:
    """Label a file that is open for writing."""
    file.attrs["format"] = np.bytes_(format.encode())
    file.attrs["version"] = version
    file.attrs["header"] = np.bytes_(header.model_dump_json().encode())


def read_label(file: h5py.File, model: type[AnyHeader], *, path: str | Path, format: str, version: int) -> AnyHeader:
    """Header of a file; CaptureError where the file is foreign, newer or damaged."""
    found = _text(file, "format")
    if found != format:
        called = "it has no format" if found is None else f"its format is {found!r}"
        raise CaptureError(f"{path} is HDF5, but not what is expected here: {called}, expected '{format}'")
    number = file.attrs.get("version")
    if not isinstance(number, int | np.integer) or number < 1:
        raise CaptureError(f"{path} is damaged: its version is {number!r}, expected a whole number from 1")
    if number > version:
        raise CaptureError(f"{path} has version {number}; this program reads up to {version}: update it")
    header = _text(file, "header")
    if header is None:
        raise CaptureError(f"{path} is damaged: its header is missing")
    try:
        return validated(model, json.loads(header), f"the header of {path}")
    except json.JSONDecodeError as error:
        raise CaptureError(f"{path} is damaged: its header is not JSON: {error}") from error
    except UwltsError as error:
        raise CaptureError(str(error)) from error


def format_of(path: str | Path) -> str | None:
    """What an HDF5 file calls its format; None where it cannot be opened or calls it nothing."""
    try:
        # Unlocked, as it may be a recording that goes on.
        with h5py.File(path, "r", locking=False) as file:
            return _text(file, "format")
    except (OSError, RuntimeError, KeyError, ValueError, TypeError):
        return None


def _text(file: h5py.File, name: str) -> str | None:
    """An attribute's text, None where it is missing or something else."""
    if name not in file.attrs:
        return None
    attribute = file.attrs.get_id(name)
    if attribute.dtype.kind != "S" or attribute.shape != ():
        return None
    return bytes(file.attrs[name]).decode()
