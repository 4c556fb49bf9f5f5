"""Reading of HDF5 files that are still being written, or whose writer was killed."""

import io
import os
from contextlib import ExitStack
from pathlib import Path
from typing import TYPE_CHECKING

import h5py

if TYPE_CHECKING:
    from typing_extensions import Buffer

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
