"""Data card of a data set: content and origin, as JSON, as Markdown, and as a page with images."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from markupsafe import Markup
from pydantic import JsonValue

from twin.datasets.coco import write_coco
from twin.datasets.data_set import Constant, DataSetDescription, LineStatus, LogUniform, Mask, Normal, OneOf, Uniform
from twin.datasets.labels import MEANINGS
from twin.scene.paths import Value
from uwlts.files.json_files import write_model
from uwlts.files.writing import hash_file, write_atomically
from uwlts.pages.toolkit import BLUE, figure_svg, new_figure, plain_text, png_data_uri, render_page, write_page
from uwlts.storage.data_set import CARD, CARD_FORMAT, CARD_VERSION, SPLITS, DataCard, DataSet, Shard, Split

README = "README.md"
PAGE = "dataset.html"
_SHOWN = 12
"""Number of frames on the page."""
_SHOWN_WIDTH_PX = 480  # width of pictures on the page
_GAMMA = 0.5
"""Exponent of the displayed brightness, which makes haze visible."""
_OVERLAY = {
    Mask.HAZE: (70, 110, 200),
    Mask.SECONDARY: (230, 150, 40),
    Mask.PARTICLES: (200, 90, 210),
    Mask.STRIPE: (60, 180, 90),
    Mask.SATURATED: (230, 40, 60),
}
"""Colours (red, green, blue) of the masks on the page; later ones cover earlier ones."""


_QUALITY: dict[str, tuple[tuple[str, ...], Callable[..., np.floating]]] = {
    "width_px": (("width_px",), np.median),
    "snr": (("snr",), np.median),
    "bound_px": (("bound_px",), np.median),
    "rms of centroid_px - centre_px": (("centroid_px", "centre_px"), lambda a, b: np.sqrt(np.mean((a - b) ** 2))),
    "lines with visible_fraction < 0.99": (("visible_fraction",), lambda seen: np.mean(seen < 0.99)),
    "lines with mixed_fraction > 0.01": (("mixed_fraction",), lambda mixed: np.mean(mixed > 0.01)),
}
"""Statistics of a frame: the labels (lines,) that they need, and their function of the finite values."""


@dataclass
class _Collected:
    """Statistics of all frames; their memory does not grow with the size of the images."""

    drawn: dict[str, list[Value]] = field(default_factory=dict)
    status: Counter[int] = field(default_factory=Counter)
    quality: dict[str, list[float]] = field(default_factory=lambda: {name: [] for name in _QUALITY})
    redrawn: set[int] = field(default_factory=set)
    labels: list[str] = field(default_factory=list)


def write_card(
    folder: Path, description: DataSetDescription, shards: Sequence[tuple[Path, Split, int]], plan: dict[str, JsonValue]
) -> DataCard:
    """Write the card of a data set in all three forms, and its masks as COCO annotations.

    ``shards`` are path, split and number of frames of the complete shards.
    """
    per_scene, versions = description.frames_per_scene(), plan["versions"]
    frames: dict[Split, int] = {split: sum(count for _, own, count in shards if own == split) for split in SPLITS}
    card = DataCard(
        title=description.title,
        notes=description.notes,
        licence=description.licence,
        seed=description.seed,
        file_format=description.format,
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
    needed = dict.fromkeys(name for names, _ in _QUALITY.values() for name in names)
    found = _collect_statistics(DataSet(folder, card, None, ("info", "status", *needed)))
    names = _describe_storage(DataSet(folder, card, None, None))
    card = card.model_copy(
        update={
            "redrawn": len(found.redrawn),
            "labels": {name: MEANINGS[name] for name in names},
            "drawn": {path: _summary(values) for path, values in found.drawn.items()},
            "status": {LineStatus(number).name.lower(): count for number, count in sorted(found.status.items())},
        }
    )
    with write_atomically(folder / README, overwrite=True) as aside:
        aside.write_text(_format_markdown(card, description), encoding="utf-8")
    everything = DataSet(folder, card, None, ("image", "mask", "centre_px", "info"))
    write_page(folder / PAGE, _page(card, description, found, everything), overwrite=True)
    if "mask" in names:
        write_coco(folder, card)
    # The last file: with it the data set is complete.
    write_model(folder / CARD, card, file_format=CARD_FORMAT, version=CARD_VERSION, overwrite=True)
    return card


def _describe_storage(samples: DataSet) -> list[str]:
    return [name for name in samples[0] if name in MEANINGS]


def _collect_statistics(samples: DataSet) -> _Collected:
    found = _Collected()
    for sample in samples:
        info = sample["info"]
        for path, value in info["drawn"].items():
            # Values that all frames of a scene share count once.
            if info["frame"] == 0 or path == "frame.exposure":
                found.drawn.setdefault(path, []).append(value)
        if info["attempt"]:
            found.redrawn.add(info["scene"])
        if "status" in sample:
            numbers, counts = np.unique(sample["status"], return_counts=True)
            found.status.update(dict(zip(numbers.tolist(), counts.tolist(), strict=True)))
        for title, (names, statistic) in _QUALITY.items():
            if all(name in sample for name in names):
                values = np.stack([sample[name] for name in names])
                values = values[:, np.isfinite(values).all(axis=0)]
                if values.size:
                    found.quality[title].append(float(statistic(*values)))
    return found


def _summary(values: Sequence[Value]) -> dict[str, float | str]:
    if any(isinstance(value, str | bool) for value in values):
        return {str(value): float(count) for value, count in sorted(Counter(map(str, values)).items())}
    numbers = np.array(values, float)
    return {"least": float(numbers.min()), "mean": float(numbers.mean()), "most": float(numbers.max())}


def _format_markdown(card: DataCard, description: DataSetDescription) -> str:
    splits = [f"| {split} | {card.scenes[split]} | {card.frames[split]} |" for split in SPLITS]
    varied = [f"| `{path}` | {words} | {drawn} |" for path, words, drawn in _describe_varied(card, description)]
    return "\n".join(
        [
            f"# {card.title}",
            "",
            *([card.notes, ""] if card.notes else []),
            f"{sum(card.frames.values())} images of {sum(card.scenes.values())} scenes, {_size(card)}, rendered by the "
            f"twin (uwlts {card.versions.get('uwlts')}, Mitsuba {card.versions.get('mitsuba')}). Seed {card.seed}. "
            f"Licence: {card.licence}.",
            "",
            "| split | scenes | frames |",
            "| --- | --- | --- |",
            *splits,
            "",
            "All frames of a scene are in the same split.",
            "",
            "## What varies",
            "",
            "| path | distribution | drawn |",
            "| --- | --- | --- |",
            *varied,
            "",
            f"All other values are in `{CARD}`. {card.redrawn} scenes were drawn again, because the sensor could not "
            "measure the first draw.",
            "",
            "## Content of a sample",
            "",
            "- `image`: grey values (height, width)",
            *(f"- `{name}`: {words}" for name, words in card.labels.items()),
            "- `info`: scene, split, values drawn, exposure, poses, and the sensor if its label was chosen",
            "",
            "## Read it",
            "",
            "    import twin",
            '    train = twin.load_dataset("FOLDER", split="train")',
            '    sample = train[0]; sample["image"], sample.get("centre_px")',
            "",
        ]
    )


def _size(card: DataCard) -> str:
    return f"{card.image['width_px']} x {card.image['height_px']} px of {card.image['bits']} bit"


def _describe_varied(card: DataCard, description: DataSetDescription) -> list[tuple[str, str, str]]:
    """Return path, distribution and drawn values of all varied paths as texts."""
    rows = []
    for path, distribution in description.vary.items():
        match distribution:
            case Constant():
                words = f"always {distribution.value}"
            case OneOf():
                words = f"one of {', '.join(map(str, distribution.values))}"
                words += (
                    f", weights {', '.join(f'{w:g}' for w in distribution.weights)}" if distribution.weights else ""
                )
            case Uniform():
                words = f"uniform from {distribution.least:g} to {distribution.most:g}"
            case LogUniform():
                words = f"log-uniform from {distribution.least:g} to {distribution.most:g}"
            case Normal():
                words = f"normal, mean {distribution.mean:g}, std {distribution.std:g}"
                ends = (("least", distribution.least), ("most", distribution.most))
                words += "".join(f", {name} {end:g}" for name, end in ends if end is not None)
        drawn = card.drawn.get(path, {})
        numbers = [f"{name} {value:.4g}" for name, value in drawn.items() if isinstance(value, float)]
        rows.append((path, words, ", ".join(numbers)))
    return rows


# --- the page ---------------------------------------------------------------------------------------------------------


def _page(card: DataCard, description: DataSetDescription, found: _Collected, samples: DataSet) -> str:
    places = np.unique(np.linspace(0, len(samples) - 1, _SHOWN).astype(int))
    status, lines = card.status, sum(card.status.values())
    return render_page(
        "twin.datasets",
        "page.html.j2",
        title=card.title,
        introduction=[
            ("frames", f"{sum(card.frames.values())} of {sum(card.scenes.values())} scenes"),
            ("splits", ", ".join(f"{split} {card.frames[split]}" for split in SPLITS)),
            ("image", _size(card)),
            ("seed", str(card.seed)),
            ("licence", card.licence),
            ("made with", ", ".join(f"{name} {number}" for name, number in card.versions.items())),
        ],
        notes=[card.notes] if card.notes else [],
        pictures=[_pictures(samples[int(place)], along=description.sensor.camera.stripe_along) for place in places],
        colours=[(str(mask.name).lower(), "#" + bytes(colour).hex()) for mask, colour in _OVERLAY.items()],
        varied=[list(row) for row in _describe_varied(card, description)],
        drawn=_histograms({path: values for path, values in found.drawn.items() if path in description.vary}),
        quality=_histograms({name: values for name, values in found.quality.items() if values}),
        status=[[name, f"{count}", f"{100 * count / lines:.1f} %"] for name, count in status.items()],
        labels=[[name, words] for name, words in card.labels.items()],
        shards=[[one.name, one.split, f"{one.frames}", one.sha256[:16]] for one in card.shards],
    )


def _pictures(sample: dict[str, Any], *, along: str) -> tuple[str, str, str]:
    """Return the image and its labels as data URIs, and a caption."""
    image, info = sample["image"], sample["info"]
    full = 255 if image.dtype == np.uint8 else max(int(image.max()), 1)
    grey = (255 * (image / full) ** _GAMMA).astype(np.uint8)
    plain = cv2.cvtColor(grey, cv2.COLOR_GRAY2RGB)
    labelled = plain // 2
    for mask, colour in _OVERLAY.items():
        if "mask" in sample:
            labelled[(sample["mask"] & mask) > 0] = colour
    if "centre_px" in sample:
        line = np.flatnonzero(np.isfinite(sample["centre_px"]))
        across = np.clip(np.rint(sample["centre_px"][line]).astype(int), 0, None)
        row, column = (across, line) if along == "width" else (line, across)
        inside = (row < image.shape[0]) & (column < image.shape[1])
        labelled[row[inside], column[inside]] = (255, 255, 255)
    words = f"{sample['key']} ({info['split']}, {info['light']}, {info['exposure_ms']:.3g} ms)"
    return _address(plain), _address(labelled), words


def _address(picture: np.ndarray) -> str:
    """Return a reduced copy of an RGB image as a data URI."""
    height = max(1, round(picture.shape[0] * _SHOWN_WIDTH_PX / picture.shape[1]))
    small = picture
    if picture.shape[1] > _SHOWN_WIDTH_PX:
        small = cv2.resize(picture, (_SHOWN_WIDTH_PX, height), interpolation=cv2.INTER_AREA)
    return png_data_uri(cv2.imencode(".png", cv2.cvtColor(small, cv2.COLOR_RGB2BGR))[1].tobytes())


def _histograms(drawn: dict[str, list[Value]] | dict[str, list[float]]) -> Markup | None:
    """Draw histograms of values in three columns; None without values."""
    if not drawn:
        return None
    columns = min(3, len(drawn))
    rows = -(-len(drawn) // columns)
    figure, all_axes = new_figure(3.6 * columns, 2.1 * rows, rows=rows, columns=columns)
    for axes, (name, values) in zip(all_axes, drawn.items(), strict=False):
        axes.set_title(plain_text(name), fontsize=8)
        if any(isinstance(value, str | bool) for value in values):
            counts = sorted(Counter(map(str, values)).items())
            axes.bar([plain_text(word) for word, _ in counts], [count for _, count in counts], color=BLUE)
        else:
            axes.hist(np.array(values, float), bins=24, color=BLUE)
    for axes in all_axes[len(drawn) :]:
        axes.set_visible(False)
    return figure_svg(figure)
