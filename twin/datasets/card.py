"""Data card of a data set, content and origin as JSON, and its masks as COCO annotations for segmentation tools.

Each kind of mask is a category. Each kind that is present in an image is an annotation: the runs of the mask with
its box and area (https://cocodataset.org/#format-data). ``file_name`` is the image's name in the data set, such as
``train-000000.tar/000012-00.png``.
"""

from __future__ import annotations

import json
from collections import Counter
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from pydantic import JsonValue

from twin.datasets.data_set import DataSetDescription, LineStatus, Mask
from twin.datasets.labels import MEANINGS
from twin.scene.paths import Value
from uwlts.files.json_files import write_model
from uwlts.files.reading import log_warnings
from uwlts.files.writing import hash_file, write_atomically
from uwlts.storage.data_set import CARD, CARD_FORMAT, CARD_VERSION, SPLITS, DataCard, DataSet, Shard, Split

_BRIGHT = 0.03
"""Largest fraction of pixels at the maximum without a warning; a stripe of 20 px with all its pixels there has 2 %."""


@dataclass
class _Collected:
    """Statistics of all frames; their memory does not grow with the size of the images."""

    drawn: dict[str, list[Value]] = field(default_factory=dict)
    status: Counter[int] = field(default_factory=Counter)
    redrawn: set[int] = field(default_factory=set)
    bright: int = 0


def write_card(
    folder: Path, description: DataSetDescription, shards: Sequence[tuple[Path, Split, int]], plan: dict[str, JsonValue]
) -> DataCard:
    """Write the card of a data set, and its masks as COCO annotations.

    ``shards`` are path, split and number of frames of the complete shards.
    """
    per_scene, versions = description.frames_per_scene(), plan["versions"]
    frames: dict[Split, int] = {split: sum(count for _, own, count in shards if own == split) for split in SPLITS}
    card = DataCard(
        title=description.title,
        notes=description.notes,
        licence=description.licence,
        seed=description.seed,
        versions={str(k): str(v) for k, v in versions.items()} if isinstance(versions, dict) else {},
        image={
            "width_px": description.sensor.camera.width_px,
            "height_px": description.sensor.camera.height_px,
            "bits": description.sensor.detector.bits,
        },
        scenes={split: frames[split] // per_scene for split in SPLITS},
        frames=frames,
        redrawn=0,
        labels={},
        drawn={},
        status={},
        description=description.model_dump(mode="json"),
        shards=tuple(Shard(name=path.name, split=own, frames=n, sha256=hash_file(path)) for path, own, n in shards),
    )
    found = _collect_statistics(DataSet(folder, card, None, ("info", "status")))
    names = [name for name in DataSet(folder, card, None, None)[0] if name in MEANINGS]
    card = card.model_copy(
        update={
            "redrawn": len(found.redrawn),
            "labels": {name: MEANINGS[name] for name in names},
            "drawn": {path: _summary(values) for path, values in found.drawn.items()},
            "status": {LineStatus(number).name.lower(): count for number, count in sorted(found.status.items())},
        }
    )
    if found.bright:
        said = f"{found.bright} of {sum(frames.values())} images have more than {100 * _BRIGHT:g} % of their pixels"
        log_warnings(folder, [f"{said} at the maximum: lower exposure.auto_level, frame.exposure or the ambient light"])
    if "mask" in names:
        write_coco(folder, card)
    # The last file: with it the data set is complete.
    write_model(folder / CARD, card, file_format=CARD_FORMAT, version=CARD_VERSION, overwrite=True)
    return card


def _collect_statistics(samples: DataSet) -> _Collected:
    found = _Collected()
    for sample in samples:
        info = sample["info"]
        found.bright += info.get("at_maximum", 0.0) > _BRIGHT
        for path, value in info["drawn"].items():
            # Values that all frames of a scene share count once.
            if info["frame"] == 0 or path == "frame.exposure":
                found.drawn.setdefault(path, []).append(value)
        if info["attempt"]:
            found.redrawn.add(info["scene"])
        if "status" in sample:
            numbers, counts = np.unique(sample["status"], return_counts=True)
            found.status.update(dict(zip(numbers.tolist(), counts.tolist(), strict=True)))
    return found


def _summary(values: Sequence[Value]) -> dict[str, float | str]:
    if any(isinstance(value, str | bool) for value in values):
        return {str(value): float(count) for value, count in sorted(Counter(map(str, values)).items())}
    numbers = np.array(values, float)
    return {"least": float(numbers.min()), "mean": float(numbers.mean()), "most": float(numbers.max())}


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
