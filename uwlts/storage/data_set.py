"""Data sets: tar archives for the webdataset library, each frame a sample, read with NumPy only.

The result of reading is also a map-style data set for PyTorch.

The files of a sample are consecutive and share the name up to the first dot. Frame 0 of scene 123 is
``000123-00``. ``.png`` is the image, and ``.mask.png`` and ``.object_map.png`` are 8-bit images. ``.json``
contains the metadata. Each further array is a ``.npy`` file with its name.
"""

from __future__ import annotations

import io
import json
import tarfile
from bisect import bisect_right
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from itertools import accumulate
from pathlib import Path
from typing import Any, Literal, get_args

import cv2
import numpy as np

from uwlts.errors import CaptureError, DescriptionError
from uwlts.files.json_files import read_model
from uwlts.files.reading import NPY_DAMAGE, require_regular_file
from uwlts.files.writing import write_atomically
from uwlts.model.sensor import Description, Table

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
        self._write_member(f"{sample.key}.png", cv2.imencode(".png", sample.image, _NOISY)[1].tobytes())
        for name, values in sample.arrays.items():
            if name in _PICTURES:
                self._write_member(f"{sample.key}.{name}.png", cv2.imencode(".png", values, _UNIFORM)[1].tobytes())
            else:
                np.save(content := io.BytesIO(), values, allow_pickle=False)
                self._write_member(f"{sample.key}.{name}.npy", content.getvalue())
        self._write_member(f"{sample.key}.json", json.dumps(sample.info, allow_nan=False).encode())

    def _write_member(self, name: str, content: bytes) -> None:
        # Owner and time stay 0, so that equal samples give equal files.
        member = tarfile.TarInfo(name)
        member.size = len(content)
        self._archive.addfile(member, io.BytesIO(content))


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
            if self._places is None:
                self._places = self._find_places()
            key, places = self._places[number]
            sample: dict[str, Any] = {"key": key}
            with open(self.path, "rb") as file:
                for ending, (offset, size) in places.items():
                    name = {"png": "image", "json": "info"}.get(ending, ending.partition(".")[0])
                    if names is None or name in names:
                        file.seek(offset)
                        sample[name] = _decode(ending, file.read(size))
        except (*NPY_DAMAGE, LookupError, TypeError, AttributeError, tarfile.TarError, cv2.error) as error:
            raise CaptureError(f"{self.path} is not a shard of this data set, or is damaged: {error}") from error
        return sample

    def _find_places(self) -> list[tuple[str, dict[str, tuple[int, int]]]]:
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


Split = Literal["train", "validation", "test"]
SPLITS: tuple[Split, ...] = get_args(Split)
CARD = "dataset.json"
CARD_FORMAT = "uwlts-dataset"
CARD_VERSION = 2  # of the file format


class Shard(Description):
    """File of a data set: name, split, number of frames, and SHA-256 of its content."""

    name: str
    split: Split
    frames: int
    sha256: str


class DataCard(Description):
    """Content of a data set's ``dataset.json``.

    ``description`` is the complete description, and ``labels`` the meaning of each stored array. ``drawn`` contains the
    least, mean and largest value of each varied path, or the counts of texts. ``status`` is the number of profile lines
    in all frames by `LineStatus`. ``redrawn`` is the number of scenes that were drawn more than once, because the
    sensor could not measure the first draw.
    """

    title: str
    notes: str
    licence: str
    seed: int
    versions: dict[str, str]
    image: dict[str, int]
    scenes: dict[Split, int]
    frames: dict[Split, int]
    redrawn: int
    labels: dict[str, str]
    drawn: dict[str, dict[str, float | str]]
    status: dict[str, int]
    description: Table
    shards: tuple[Shard, ...]


class DataSet(Sequence[dict[str, Any]]):
    """Samples of a data set in a folder, or of one of its splits, sorted by scene and frame.

    A sample is a dict: "key" (text), "image" (H, W), uint8 or uint16, the labels' arrays by name, and "info", the
    frame's metadata. It has the interface that PyTorch's DataLoader needs: `len`, indexing and iteration. It can be
    sent to other processes.

    Attributes
    ----------
    card
        Content of the data set (`uwlts.storage.data_set.DataCard`).
    """

    def __init__(self, folder: Path, card: DataCard, split: Split | None, names: tuple[str, ...] | None):
        self.card, self._names = card, names
        shards = [shard for shard in card.shards if split in (None, shard.split)]
        self._readers = [ShardReader(folder / one.name, frames=one.frames) for one in shards]
        self._ends = list(accumulate(one.frames for one in shards))

    def __len__(self) -> int:
        return self._ends[-1] if self._ends else 0

    def __getitem__(self, index: Any) -> Any:
        """Return a sample by its number (negative: from the end), or a list of samples by a slice."""
        if isinstance(index, slice):
            return [self[number] for number in range(*index.indices(len(self)))]
        number = index + len(self) if index < 0 else index
        if not 0 <= number < len(self):
            raise IndexError(f"sample {index} of {len(self)}")
        shard = bisect_right(self._ends, number)
        return self._readers[shard].sample(number - (self._ends[shard - 1] if shard else 0), self._names)

    def __iter__(self) -> Iterator[dict[str, Any]]:
        for reader in self._readers:
            # A temporary reader, so that its table of contents does not stay in memory.
            shard = ShardReader(reader.path, frames=reader.frames)
            yield from (shard.sample(number, self._names) for number in range(shard.frames))


def load_dataset(folder: str | Path, *, split: Split | None = None, names: Sequence[str] | None = None) -> DataSet:
    """Open a data set that was written by `dataset`, for indexing and iteration.

    Parameters
    ----------
    folder
        The data set's folder.
    split
        "train", "validation" or "test"; default: all.
    names
        Names of the arrays to read, such as ["image", "centre_px"]; default: all.

    Returns
    -------
    DataSet
        Sequence of samples: images with their labels, read when they are asked for.

    Raises
    ------
    CaptureError
        The folder does not contain a complete data set; or, when samples are read, a file is damaged.
    DescriptionError
        A name is unknown.

    Examples
    --------
    >>> train = twin.load_dataset("runs/stripes", split="train")
    >>> sample = train[0]
    >>> sample["image"].shape, sample["centre_px"].shape
    """
    folder = Path(folder)
    card_file = folder / CARD
    try:
        card = read_model(
            card_file, DataCard, file_format=CARD_FORMAT, version=CARD_VERSION, called="card of a data set"
        )
    except CaptureError as error:
        advice = f"; is {folder} a finished data set? run twin dataset again to complete it"
        raise CaptureError(f"{error}{'' if card_file.is_file() else advice}") from error
    for shard in card.shards:
        # Only plain file names are allowed, because a path could lead outside the folder.
        if Path(shard.name).name != shard.name or Path(shard.name).suffix != SUFFIX:
            raise CaptureError(f"{card_file} names a shard '{shard.name}', which is not a file of a data set")
    known = {"image", "info", *card.labels}
    if names is not None and (unknown := set(names) - known):
        raise DescriptionError(
            f"unknown {', '.join(sorted(unknown))}; the data set contains {', '.join(sorted(known))}"
        )
    return DataSet(folder, card, split, None if names is None else tuple(names))
