"""Data card of a data set: content, statistics and origin as JSON."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
from pydantic import JsonValue

from twin.datasets.data_set import DataSetDescription, LineStatus
from twin.datasets.labels import MEANINGS
from twin.scene.paths import Value
from uwlts.files.json_files import write_model
from uwlts.files.reading import log_warnings
from uwlts.files.writing import hash_file
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
    """Write the card of a data set.

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
