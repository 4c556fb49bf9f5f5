"""Label and arrays of the program's HDF5 files, also of files that are still being written.

The label consists of the attributes ``format``, ``version`` and ``header`` (JSON). They are fixed-length text, which is
protected by HDF5's checksums. Variable-length text is not: if it is damaged, HDF5 may search for its end forever.
"""

import ctypes
import json
import math
import os
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager, suppress
from pathlib import Path
from types import EllipsisType
from typing import Any, TypeVar

import h5py
import numpy as np
from h5py._objects import phil
from pydantic import JsonValue

from uwlts.errors import CaptureError, Error
from uwlts.files.reading import MOST_JSON_BYTES, is_regular_file, parse_json
from uwlts.files.writing import write_atomically
from uwlts.model.library import validate_description
from uwlts.model.sensor import Description, Table

AnyHeader = TypeVar("AnyHeader", bound=Description)

DAMAGE = (OSError, RuntimeError, KeyError, ValueError, TypeError)
"""Exceptions of h5py for a damaged file, depending on the kind of damage."""

_FILTERS = {h5py.h5z.FILTER_DEFLATE, h5py.h5z.FILTER_SHUFFLE, h5py.h5z.FILTER_FLETCHER32, 32000, 32001, 32015}
"""Filters of a dataset's chunks: those of the program, and LZF and Zstandard, for files repacked by other tools."""

_MOST_SHRINKING = 1100  # largest compression ratio that is accepted: deflate reaches 1032 (zlib.net/zlib_tech.html)

_PACKED: dict[str, Any] = {"compression": "gzip", "compression_opts": 1, "shuffle": True, "fletcher32": True}
_MARGIN_BYTES = 2**18  # for HDF5's metadata of what is added: its index, and chunks of further datasets
_LARGEST_CHUNK = 2**23
"""Largest chunk in bytes, which is read as a whole. HDF5 makes chunks of up to 1 MiB, the program smaller ones."""


def write_label(file: h5py.File, *, file_format: str, version: int, header: Description) -> None:
    """Label a file that is open for writing."""
    file.attrs["format"] = np.bytes_(file_format.encode())
    file.attrs["version"] = version
    file.attrs["header"] = np.bytes_(header.model_dump_json().encode())


@contextmanager
def write_arrays(
    path: str | os.PathLike[str], *, file_format: str, version: int, overwrite: bool
) -> Iterator[Callable[[Mapping[str, np.ndarray | None], Description], None]]:
    """Give the body a function that appends compressed arrays to a labelled file, written completely or not at all.

    It takes arrays by name, None for those that are not written, and the header; the first header is stored. Arrays
    grow along their first axis, those with three axes along the second.
    """
    # The latest format protects all metadata by checksums.
    with write_atomically(path, overwrite=overwrite) as aside:
        with h5py.File(aside, "w", libver="latest", locking=False) as file:
            stored: dict[str, h5py.Dataset] = {}

            def append(arrays: Mapping[str, np.ndarray | None], header: Description) -> None:
                held = {name: data for name, data in arrays.items() if data is not None}
                claim_space(file, sum(data.nbytes for data in held.values()))
                if not file.attrs:
                    write_label(file, file_format=file_format, version=version, header=header)
                for name, data in held.items():
                    axis = int(data.ndim == 3)
                    if name not in stored:
                        most = tuple(None if k == axis else size for k, size in enumerate(data.shape))
                        stored[name] = file.create_dataset(name, data=data, maxshape=most, **_PACKED)
                    else:
                        first = stored[name].shape[axis]
                        stored[name].resize(first + data.shape[axis], axis)
                        stored[name][(slice(None),) * axis + (slice(first, None),)] = data

            yield append
        truncate(aside)


def claim_space(file: h5py.File, size: int) -> None:
    """Extend a file by zeros to hold ``size`` more bytes, and HDF5's metadata; raises OSError if the disk is full.

    HDF5 does not survive a full disk: closing the file fails and the process may crash.
    """
    wanted = file.id.get_filesize() + size + _MARGIN_BYTES
    with open(file.filename, "r+b", buffering=0) as claimed:
        there = claimed.seek(0, os.SEEK_END)
        while there < wanted:
            there += claimed.write(bytes(min(wanted - there, _LARGEST_CHUNK)))


def truncate(path: Path) -> None:
    """Cut off unused space, which HDF5 does when a file is opened and closed again."""
    h5py.File(path, "r+", locking=False).close()


def read_label(
    file: h5py.File, model: type[AnyHeader], *, path: str | Path, file_format: str, version: int
) -> AnyHeader:
    """Return the header of a file.

    ``version`` is the newest one that can be read.

    Raises CaptureError if the file is foreign, newer or damaged.
    """
    found = _read_text(file, "format")
    if found != file_format:
        called = "it has no format" if found is None else f"its format is {found!r}"
        raise CaptureError(f"{path} is HDF5, but not what is expected here: {called}, expected '{file_format}'")
    number = _read_attribute(file, "version", "iu")
    if number is None or number < 1:
        found = "no number" if number is None else number
        raise CaptureError(f"{path} is damaged: its version is {found}, expected a whole number from 1")
    if number > version:
        raise CaptureError(f"{path} has version {number}; this program reads up to {version}: update it")
    if (header := _read_text(file, "header")) is None:
        raise CaptureError(f"{path} is damaged: its header is missing")
    content = _parse(header, f"{path} is damaged: its header")
    try:
        return validate_description(model, content, f"the header of {path}")
    except Error as error:
        raise CaptureError(str(error)) from error


def _parse(text: str, called: str) -> JsonValue:
    try:
        return parse_json(text)
    except ValueError as error:
        raise CaptureError(f"{called} is not JSON: {error}") from error


def write_plan(file: h5py.File, plan: Table) -> None:
    """Store the plan of an unfinished file as JSON."""
    file.attrs["plan"] = np.bytes_(json.dumps(plan).encode())


def read_plan(file: h5py.File) -> Table | None:
    """Return the plan of an unfinished file, or None; raises CaptureError if it is damaged."""
    if (text := _read_text(file, "plan")) is None:
        return None
    plan = _parse(text, f"{file.filename} is damaged: its plan")
    if not isinstance(plan, dict):
        raise CaptureError(f"{file.filename} is damaged: its plan is not a table")
    return plan


def forget_plan(path: str | Path) -> None:
    """Remove the plan from a finished file."""
    with h5py.File(path, "r+", locking=False) as file:
        # Overwritten first, because HDF5 leaves the bytes of removed attributes in the file.
        file.attrs.modify("plan", np.bytes_(b" " * file.attrs.get_id("plan").dtype.itemsize))
        del file.attrs["plan"]


def read_format(path: str | Path) -> str | None:
    """Return the format in an HDF5 file's label; None if the file cannot be opened or has no label."""
    if not is_regular_file(path):
        return None
    try:
        # Without a lock, because it may be a recording in progress.
        with h5py.File(path, "r", locking=False) as file:
            return _read_text(file, "format")
    except DAMAGE:
        return None


def _read_text(file: h5py.File, name: str) -> str | None:
    """Return an attribute's text, or None if it is missing or of another kind."""
    value = _read_attribute(file, name, "S")
    return value.decode() if isinstance(value, bytes) else None


def _read_attribute(file: h5py.File, name: str, kinds: str) -> Any:
    """Return an attribute that is a single value of some kinds; None if it is missing, another or too large."""
    if name not in file.attrs:
        return None
    known = file.attrs.get_id(name)
    usable = known.dtype.kind in kinds and known.shape == () and known.dtype.itemsize <= MOST_JSON_BYTES
    return file.attrs[name] if usable else None


def find_dataset(file: h5py.File, name: str, *, path: str | Path) -> h5py.Dataset | None:
    """Return a dataset of plain numbers stored in the file itself, or None if the name is unknown.

    Raises CaptureError if the name is a link, or the values are not numbers or booleans, are stored in other files, or
    are compressed by an unknown filter.
    """
    if name not in file:
        return None
    if not isinstance(file.get(name, getlink=True), h5py.HardLink):
        raise CaptureError(f"{path} is damaged: '{name}' is a link to another place; expected an array")
    dataset = file[name]
    if not isinstance(dataset, h5py.Dataset):
        return None
    if dataset.shape is None or dataset.dtype.kind not in "biuf" or dataset.dtype.itemsize > 8:
        raise CaptureError(f"{path} is damaged: the values of '{name}' are no numbers, but {dataset.dtype}")
    packing = dataset.id.get_create_plist()
    if dataset.is_virtual or packing.get_external_count():
        raise CaptureError(f"{path} refers to other files for '{name}'; expected an array in the file itself")
    filters = {packing.get_filter(number)[0] for number in range(packing.get_nfilters())}
    if filters - _FILTERS:
        raise CaptureError(f"{path} has '{name}' packed by filters of HDF5 that this program does not use")
    return dataset


def read_array(
    file: h5py.File, name: str, *, path: str | Path, selection: tuple[slice | EllipsisType, ...] = (...,)
) -> np.ndarray | None:
    """Read the values of `find_dataset`; also raises CaptureError if the file is too short to hold them."""
    dataset = find_dataset(file, name, path=path)
    if dataset is None:
        return None
    stored = dataset.id.get_storage_size()
    if dataset.nbytes > (stored if dataset.chunks is None else _MOST_SHRINKING * stored):
        raise CaptureError(
            f"{path} is damaged: '{name}' has the shape {dataset.shape}, but only {stored:,} bytes are stored"
        )
    require_small_chunks(dataset, name, path=path)
    return read_values(dataset, selection)


def read_values(dataset: h5py.Dataset, selection: object = ...) -> np.ndarray:
    """Read values in the byte order of this machine, which compiled functions need."""
    values = dataset[selection]
    return values.astype(values.dtype.newbyteorder("="), copy=False)


def require_small_chunks(dataset: h5py.Dataset, name: str, *, path: str | Path) -> None:
    """Raise CaptureError if a chunk, which is unpacked as a whole, is larger than any that is written."""
    piece = 0 if dataset.chunks is None else math.prod(dataset.chunks) * dataset.dtype.itemsize
    if piece > max(_LARGEST_CHUNK, 2 * dataset.nbytes):
        raise CaptureError(f"{path} is damaged: '{name}' is stored in chunks of {piece:,} bytes")


_SIGNATURE_AND_VERSION = b"\x89HDF\r\n\x1a\n\x03"
_FLAGS = 11  # place of the writer's mark in superblock version 3 (HDF5 File Format Specification 3.0, II.A)

_ATTEMPTS = 20
"""Attempts to read metadata that is being written. HDF5 doubles its pause from 1 ns each time: all take a millisecond,
and its usual hundred, at damage, for ever."""


def has_writer(path: str | Path) -> bool:
    """Return whether the file is marked as open for writing, now or when its writer was killed."""
    with open(path, "rb") as file:
        start = file.read(_FLAGS + 1)
    return len(start) > _FLAGS and start.startswith(_SIGNATURE_AND_VERSION) and start[_FLAGS] != 0


def open_unfinished(path: str | Path) -> h5py.File:
    """Open a file that is being written, or whose writer was killed, as last flushed; raises like ``h5py.File``."""
    access = h5py.h5p.create(h5py.h5p.FILE_ACCESS)
    access.set_file_locking(False, True)
    # h5py has no function for this setting; its module is linked with the library, which only one thread may call.
    with suppress(AttributeError), phil:
        set_attempts = ctypes.CDLL(h5py.h5p.__file__).H5Pset_metadata_read_attempts
        set_attempts(ctypes.c_int64(access.id), ctypes.c_uint(_ATTEMPTS))
    mode = h5py.h5f.ACC_RDONLY | h5py.h5f.ACC_SWMR_READ
    return h5py.File(h5py.h5f.open(os.fsencode(path), mode, fapl=access))
