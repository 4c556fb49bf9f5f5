"""Label and arrays of the program's HDF5 files, also of files that are still being written.

The label consists of the attributes ``format``, ``version`` and ``header`` (JSON). They are fixed-length text, which is
protected by HDF5's checksums. Variable-length text is not: if it is damaged, HDF5 may search for its end forever.
"""

import io
import json
import math
import os
from contextlib import ExitStack
from pathlib import Path
from types import EllipsisType
from typing import TYPE_CHECKING, TypeVar

import h5py
import numpy as np

from uwlts.errors import CaptureError, Error
from uwlts.files.reading import MOST_JSON_BYTES, is_regular_file, parse_json
from uwlts.model.library import validate_description
from uwlts.model.sensor import Description, Table

if TYPE_CHECKING:
    from typing_extensions import Buffer


AnyHeader = TypeVar("AnyHeader", bound=Description)

DAMAGE = (OSError, RuntimeError, KeyError, ValueError, TypeError)
"""Exceptions of h5py for a damaged file, depending on the kind of damage."""

_FILTERS = {h5py.h5z.FILTER_DEFLATE, h5py.h5z.FILTER_SHUFFLE, h5py.h5z.FILTER_FLETCHER32, 32000, 32001, 32015}
"""Filters of a dataset's chunks: those of the program, and LZF and Zstandard, for files repacked by other tools."""

_MOST_SHRINKING = 1100  # largest compression ratio that is accepted: deflate reaches 1032 (zlib.net/zlib_tech.html)

_LARGEST_CHUNK = 2**23
"""Largest chunk in bytes, which is read as a whole. HDF5 makes chunks of up to 1 MiB, the program smaller ones."""


def write_label(file: h5py.File, *, file_format: str, version: int, header: Description) -> None:
    """Label a file that is open for writing."""
    file.attrs["format"] = np.bytes_(file_format.encode())
    file.attrs["version"] = version
    file.attrs["header"] = np.bytes_(header.model_dump_json().encode())


def read_label(
    file: h5py.File, model: type[AnyHeader], *, path: str | Path, file_format: str, version: int
) -> AnyHeader:
    """Return the header of a file.

    ``version`` is the newest one that can be read.

    Raises CaptureError if the file is foreign, newer or damaged.
    """
    found = _text(file, "format")
    if found != file_format:
        called = "it has no format" if found is None else f"its format is {found!r}"
        raise CaptureError(f"{path} is HDF5, but not what is expected here: {called}, expected '{file_format}'")
    number = _number(file, "version")
    if number is None or number < 1:
        found = "no number" if number is None else number
        raise CaptureError(f"{path} is damaged: its version is {found}, expected a whole number from 1")
    if number > version:
        raise CaptureError(f"{path} has version {number}; this program reads up to {version}: update it")
    if (header := _text(file, "header")) is None:
        raise CaptureError(f"{path} is damaged: its header is missing")
    try:
        content = parse_json(header)
    except ValueError as error:
        raise CaptureError(f"{path} is damaged: its header is not JSON: {error}") from error
    try:
        return validate_description(model, content, f"the header of {path}")
    except Error as error:
        raise CaptureError(str(error)) from error


def write_plan(file: h5py.File, plan: Table) -> None:
    """Store the plan of an unfinished file as JSON."""
    file.attrs["plan"] = np.bytes_(json.dumps(plan).encode())


def read_plan(file: h5py.File) -> Table | None:
    """Return the plan of an unfinished file, or None; raises CaptureError if it is damaged."""
    if (text := _text(file, "plan")) is None:
        return None
    try:
        plan = parse_json(text)
    except ValueError as error:
        raise CaptureError(f"{file.filename} is damaged: its plan is not JSON: {error}") from error
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
            return _text(file, "format")
    except DAMAGE:
        return None


def _text(file: h5py.File, name: str) -> str | None:
    """Return an attribute's text, or None if it is missing or of another kind."""
    if name not in file.attrs:
        return None
    known = file.attrs.get_id(name)
    if known.dtype.kind != "S" or known.shape != () or known.dtype.itemsize > MOST_JSON_BYTES:
        return None
    value = file.attrs[name]
    return value.decode() if isinstance(value, bytes) else None


def _number(file: h5py.File, name: str) -> int | None:
    """Return an attribute's integer, or None if it is missing or of another kind."""
    if name not in file.attrs:
        return None
    known = file.attrs.get_id(name)
    return int(np.asarray(file.attrs[name])) if known.dtype.kind in "iu" and known.shape == () else None


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
# Superblock version 3 with 8-byte offsets (HDF5 File Format Specification 3.0, II.A): offsets of its entries.
_FLAGS, _END_OF_FILE, _ROOT, _CHECKSUM, _SIZE = 11, 28, 36, 44, 48
_ROOM = 2**28
"""Largest growth of a file in bytes while it is read."""


def has_writer(path: str | Path) -> bool:
    """Return whether the file is marked as open for writing, now or when its writer was killed."""
    with open(path, "rb") as file:
        start = file.read(_SIZE)
    return len(start) == _SIZE and start.startswith(_SIGNATURE_AND_VERSION) and start[_FLAGS] != 0


class UnfinishedFile(h5py.File):
    """A file that is being written, or whose writer was killed, as last flushed; raises the errors of ``h5py.File``.

    HDF5's single-writer-multiple-reader mode hangs on a damaged file: it tries a hundred times and doubles the pause
    each time. Two entries of the superblock prevent a normal opening: the writer's mark and the end of the used space.
    This class presents them to HDF5 as in a closed file; the file itself is not changed.
    """

    def __init__(self, path: str | Path):
        with ExitStack() as opened:
            self._view = opened.enter_context(_ClosedView(path))
            super().__init__(self._view, "r")
            opened.pop_all()

    def close(self) -> None:
        """Close the file."""
        super().close()
        self._view.close()


class _ClosedView(io.FileIO):
    """View of the file with the superblock that its writer would leave, and space for further data."""

    def __init__(self, path: str | Path):
        super().__init__(path, "r")
        start = self.read(_SIZE)
        self._end = os.fstat(self.fileno()).st_size + _ROOM
        settled = start[:_FLAGS] + b"\0" + start[_FLAGS + 1 : _END_OF_FILE] + self._end.to_bytes(8, "little")
        settled += start[_ROOT:_CHECKSUM]
        # A damaged superblock is not corrected.
        intact = lookup3(start[:_CHECKSUM]).to_bytes(4, "little") == start[_CHECKSUM:]
        self._start = settled + lookup3(settled).to_bytes(4, "little") if intact else start

    def seek(self, offset: int, whence: int = os.SEEK_SET) -> int:
        """Set the position; the end of the file is that of the corrected superblock."""
        return super().seek(offset + self._end) if whence == os.SEEK_END else super().seek(offset, whence)

    def readinto(self, buffer: "Buffer", /) -> int:
        """Read bytes; the superblock is the corrected one, and bytes that are not written yet are zero."""
        place, position = memoryview(buffer).cast("B"), self.tell()
        count = super().readinto(place)
        place[count:] = bytes(len(place) - count)
        settled = self._start[position : position + len(place)]
        place[: len(settled)] = settled
        return len(place)


def lookup3(data: bytes) -> int:
    """Return HDF5's metadata checksum: ``hashlittle`` of Bob Jenkins' lookup3.c (2006, public domain), seed 0."""

    def rotate(value: int, bits: int) -> int:
        return ((value << bits) | (value >> (32 - bits))) & 0xFFFFFFFF

    a = b = c = (0xDEADBEEF + len(data)) & 0xFFFFFFFF
    blocks = max(0, -(-len(data) // 12))
    words = data.ljust(12 * blocks, b"\0")
    for block in range(blocks):
        x, y, z = (int.from_bytes(words[12 * block + k : 12 * block + k + 4], "little") for k in (0, 4, 8))
        a, b, c = (a + x) & 0xFFFFFFFF, (b + y) & 0xFFFFFFFF, (c + z) & 0xFFFFFFFF
        if block < blocks - 1:
            for bits in (4, 6, 8, 16, 19, 4):
                a = ((a - c) & 0xFFFFFFFF) ^ rotate(c, bits)
                c = (c + b) & 0xFFFFFFFF
                a, b, c = b, c, a
        else:
            for bits in (14, 11, 25, 16, 4, 14, 24):
                c = ((c ^ b) - rotate(b, bits)) & 0xFFFFFFFF
                a, b, c = b, c, a
    # The last of the seven steps stored c in b.
    return b
