"""Reading of data sets by sample, with NumPy only; the result is also a map-style data set for PyTorch."""

from __future__ import annotations

from bisect import bisect_right
from collections.abc import Iterator, Sequence
from itertools import accumulate
from pathlib import Path
from typing import Any, Literal, get_args

from uwlts.errors import CaptureError, DescriptionError
from uwlts.files.json_files import read_model
from uwlts.model.sensor import Description, Table
from uwlts.storage.data_set_shards import SUFFIX, ShardReader

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
            own = ShardReader(reader.path, frames=reader.frames)
            yield from (own.sample(number, self._names) for number in range(own.frames))


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
        The split or a name is unknown.

    Examples
    --------
    >>> train = twin.load_dataset("runs/stripes", split="train")
    >>> sample = train[0]
    >>> sample["image"].shape, sample["centre_px"].shape
    """
    folder = Path(folder)
    if split is not None and split not in SPLITS:
        raise DescriptionError(f"unknown split '{split}'; known are {', '.join(SPLITS)}")
    advice = (
        "" if (folder / CARD).is_file() else f"; is {folder} a finished data set? run twin dataset again to complete it"
    )
    try:
        card = read_model(
            folder / CARD, DataCard, file_format=CARD_FORMAT, version=CARD_VERSION, called="card of a data set"
        )
    except CaptureError as error:
        raise CaptureError(f"{error}{advice}") from error
    for shard in card.shards:
        # Only plain file names are allowed, because a path could lead outside the folder.
        if Path(shard.name).name != shard.name or Path(shard.name).suffix != SUFFIX:
            raise CaptureError(f"{folder / CARD} names a shard '{shard.name}', which is not a file of a data set")
    known = {"image", "info", *card.labels}
    if names is not None and (unknown := set(names) - known):
        raise DescriptionError(
            f"unknown {', '.join(sorted(unknown))}; the data set contains {', '.join(sorted(known))}"
        )
    return DataSet(folder, card, split, None if names is None else tuple(names))
