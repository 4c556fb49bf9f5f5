"""Files of a data set: tar archives for the webdataset library, each frame a sample.

The files of a sample are consecutive and share the name up to the first dot. Frame 0 of scene 123 is
``000123-00``. ``.png`` is the image, and ``.mask.png`` and ``.object_map.png`` are 8-bit images. ``.json``
contains the metadata. Each further array is a ``.npy`` file with its name.
"""

from __future__ import annotations

import io
import json
import tarfile
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from uwlts.errors import CaptureError
from uwlts.files.reading import NPY_DAMAGE, require_regular_file
from uwlts.files.writing import write_atomically

SUFFIX = ".tar"
_PICTURES = ("mask", "object_map")
_PNG_UNFILTERED = [cv2.IMWRITE_PNG_COMPRESSION, 1, cv2.IMWRITE_PNG_FILTER, cv2.IMWRITE_PNG_FILTER_NONE]
_NOISY = [*_PNG_UNFILTERED, cv2.IMWRITE_PNG_STRATEGY, cv2.IMWRITE_PNG_STRATEGY_HUFFMAN_ONLY]
"""PNG of an image. Noise has no repetitions and no gradients: a search for them takes longer and saves nothing."""
_UNIFORM = [*_PNG_UNFILTERED, cv2.IMWRITE_PNG_STRATEGY, cv2.IMWRITE_PNG_STRATEGY_RLE]
"""PNG of a map of few values, which consists of runs."""


@dataclass(frozen=True)
class Sample:
    """Frame: its key, image (H, W), arrays by name, and metadata as a JSON table."""

    key: str
    image: np.ndarray
    arrays: dict[str, np.ndarray]
    info: dict[str, Any]


@contextmanager
def open_shard(path: Path) -> Iterator[ShardWriter]:
    """Open a shard for writing; it appears at ``path`` if the body ends without an exception."""
    with (
        write_atomically(path, overwrite=True) as aside,
        tarfile.open(aside, "w", format=tarfile.USTAR_FORMAT) as archive,
    ):
        yield ShardWriter(archive)


class ShardWriter:
    """Writer of the samples of a shard, in order."""

    def __init__(self, archive: tarfile.TarFile):
        self._archive = archive

    def add(self, sample: Sample) -> None:
        """Write a sample."""
        self._write_member(f"{sample.key}.png", _png(sample.image, _NOISY))
        for name, values in sample.arrays.items():
            if name in _PICTURES:
                self._write_member(f"{sample.key}.{name}.png", _png(values, _UNIFORM))
            else:
                self._write_member(f"{sample.key}.{name}.npy", _npy(values))
        self._write_member(f"{sample.key}.json", json.dumps(sample.info, allow_nan=False).encode())

    def _write_member(self, name: str, content: bytes) -> None:
        # Owner and time stay 0, so that equal samples give equal files.
        member = tarfile.TarInfo(name)
        member.size = len(content)
        self._archive.addfile(member, io.BytesIO(content))


def _png(values: np.ndarray, settings: list[int]) -> bytes:
    return cv2.imencode(".png", values, settings)[1].tobytes()


def _npy(values: np.ndarray) -> bytes:
    content = io.BytesIO()
    np.save(content, values, allow_pickle=False)
    return content.getvalue()


class ShardReader:
    """Reader of the samples of a shard in any order; the file is open only during a read.

    Raises CaptureError if the file is missing, damaged, or has another number of frames than ``frames``.
    """

    def __init__(self, path: Path, *, frames: int):
        self.path, self.frames = path, frames
        self._places: list[tuple[str, dict[str, tuple[int, int]]]] | None = None

    def sample(self, number: int, names: tuple[str, ...] | None) -> dict[str, Any]:
        """Read a sample: arrays by name, with "key", "image" and "info", its metadata; only ``names`` if given."""
        require_regular_file(self.path, called="shard of a data set")
        try:
            return self._read_sample(number, names)
        except (*NPY_DAMAGE, LookupError, TypeError, AttributeError, tarfile.TarError, cv2.error) as error:
            raise CaptureError(f"{self.path} is not a shard of this data set, or is damaged: {error}") from error

    def _read_sample(self, number: int, names: tuple[str, ...] | None) -> dict[str, Any]:
        if self._places is None:
            self._places = self._found_places()
        key, places = self._places[number]
        sample: dict[str, Any] = {"key": key}
        with open(self.path, "rb") as file:
            for ending, (offset, size) in places.items():
                name = {"png": "image", "json": "info"}.get(ending, ending.partition(".")[0])
                if names is None or name in names:
                    file.seek(offset)
                    sample[name] = _decode(ending, file.read(size))
        return sample

    def _found_places(self) -> list[tuple[str, dict[str, tuple[int, int]]]]:
        """Return the key of each sample, with offset and size of its files by their endings."""
        found: dict[str, dict[str, tuple[int, int]]] = {}
        with tarfile.open(self.path, "r:") as archive:
            for member in archive:
                key, _, ending = member.name.partition(".")
                found.setdefault(key, {})[ending] = member.offset_data, member.size
        if len(found) != self.frames:
            raise ValueError(f"it contains {len(found)} frames, expected {self.frames}")
        return list(found.items())


def _decode(ending: str, content: bytes) -> Any:
    if ending == "json":
        return json.loads(content)
    if ending.endswith("png"):
        image = cv2.imdecode(np.frombuffer(content, np.uint8), cv2.IMREAD_UNCHANGED)
        if image is None:
            raise ValueError("an image cannot be decoded")
        return image
    return np.load(io.BytesIO(content), allow_pickle=False)
