"""Masks of a data set as COCO annotations, one JSON file per split, for segmentation tools.

Each kind of mask is a category. Each kind that is present in an image is an annotation: the runs of the mask with
its box and area (https://cocodataset.org/#format-data). ``file_name`` is the image's name in the data set, such as
``train-000000.tar/000012-00.png``.
"""

import json
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np

from twin.datasets.data_set import Mask
from uwlts.files.writing import write_atomically
from uwlts.storage.data_set import SPLITS, DataCard, DataSet


def coco_path(folder: Path, split: str) -> Path:
    """Return the path of the annotations of a split."""
    return folder / f"coco-{split}.json"


def write_coco(folder: Path, card: DataCard) -> list[Path]:
    """Write the annotations of each split with images, from samples with masks; return the paths.

    Images are read and annotations written one at a time, so that memory does not grow with the data set.
    """
    paths = [coco_path(folder, split) for split in SPLITS if card.frames[split]]
    for path, split in zip(paths, (split for split in SPLITS if card.frames[split]), strict=True):
        with write_atomically(path, overwrite=True) as aside, open(aside, "w", encoding="utf-8") as file:
            head = {
                "info": {"description": card.title, "version": card.versions.get("uwlts", "")},
                "licenses": [{"id": 1, "name": card.licence, "url": ""}],
                "categories": [{"id": int(one), "name": str(one.name).lower()} for one in Mask],
            }
            file.write(json.dumps(head)[:-1])
            for key, entries in (("images", _images), ("annotations", _annotations)):
                file.write(f', "{key}": [')
                for number, entry in enumerate(entries(folder, card, split)):
                    file.write((",\n" if number else "\n") + json.dumps(entry))
                file.write("]")
            file.write("}\n")
    return paths


def _images(folder: Path, card: DataCard, split: Any) -> Iterator[dict[str, Any]]:
    names = _names(card, split)
    for number, sample in enumerate(DataSet(folder, card, split, ("key",))):
        size = {"width": card.image["width_px"], "height": card.image["height_px"]}
        yield {"id": number, "file_name": f"{names[number]}/{sample['key']}.png", "license": 1} | size


def _names(card: DataCard, split: Any) -> list[str]:
    """Return the name of the shard of each image of a split."""
    return [shard.name for shard in card.shards if shard.split == split for _ in range(shard.frames)]


def _annotations(folder: Path, card: DataCard, split: Any) -> Iterator[dict[str, Any]]:
    count = 0
    for image, sample in enumerate(DataSet(folder, card, split, ("mask",))):
        present = Mask(int(np.bitwise_or.reduce(sample["mask"], axis=None)))
        for kind in present:
            mask = (sample["mask"] & kind) > 0
            rows, columns = np.flatnonzero(mask.any(axis=1)), np.flatnonzero(mask.any(axis=0))
            first = int(columns[0]), int(rows[0])
            box = [*first, int(columns[-1]) + 1 - first[0], int(rows[-1]) + 1 - first[1]]
            code = {"size": list(mask.shape), "counts": _count_runs(mask)}
            where = {"image_id": image, "category_id": int(kind), "iscrowd": 1}
            yield {"id": count} | where | {"segmentation": code, "bbox": box, "area": int(mask.sum())}
            count += 1


def _count_runs(mask: np.ndarray) -> list[int]:
    """Return the lengths of runs of equal pixels of a mask (H, W) along its columns; the first is of unset pixels."""
    flat = np.concatenate([[False], mask.ravel(order="F")])
    starts = np.flatnonzero(flat[1:] != flat[:-1])
    return np.diff(np.concatenate([[0], starts, [mask.size]])).tolist()
