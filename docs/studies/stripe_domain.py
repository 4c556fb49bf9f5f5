"""Compare real and generated stripes by width, height, speckle, haze and background, in a table and a picture.

    python docs/studies/stripe_domain.py --generated runs/clean runs/turbid runs/shiny --real etna=height bust=height

Real images are given as FOLDER=DIRECTION, with the direction of their stripe. Without --out, no picture is drawn;
--write puts the table into its page.
"""

from __future__ import annotations

import argparse
from collections.abc import Iterable, Iterator
from pathlib import Path

import cv2
import matplotlib.pyplot as plt
import numpy as np
from result_tables import publish, table

import twin
from uwlts.stripe import StripeOptions, extract_stripe

FIGURES = {
    "width": "full width at half maximum, px",
    "height": "height, % of full scale",
    "speckle": "scatter of the height from line to line, %",
    "grain": "length over which heights agree, lines",
    "haze": "light 3 to 5 widths away, % of the height",
    "background": "background, % of full scale",
    "noise": "scatter of the background, % of full scale",
}
_SMOOTH = 41
"""Lines over which the height of a surface is nearly constant."""
_FULL = 255.0
_FEWEST = 100
"""Fewest lines with a stripe for an image to be used."""


def figures_of(image: np.ndarray, along: str) -> dict[str, np.ndarray] | None:
    """Return figures of the lines of an image (H, W) uint8 by name; None if fewer than `_FEWEST` show a stripe."""
    stripe = extract_stripe(image, stripe_along=along, options=StripeOptions(end_lines=0))
    lines = stripe.lines
    if len(lines) < _FEWEST:
        return None
    profiles = (image if along == "height" else image.T).astype(float)[lines]
    centre, width, height = stripe.centre_px[lines], stripe.width_px[lines], stripe.amplitude[lines].astype(float)
    away = np.abs(np.arange(profiles.shape[1]) - centre[:, None]) / width[:, None]

    def mean_where(chosen: np.ndarray) -> np.ndarray:
        return np.where(chosen, profiles, 0).sum(axis=1) / np.maximum(chosen.sum(axis=1), 1)

    far, near = (away > 10) & (away < 20), (away > 3) & (away < 5)
    background = mean_where(far)
    whole = (height > 0.02 * _FULL) & far.any(axis=1) & near.any(axis=1)
    found = {
        "width": width[whole],
        "height": 100 * height[whole] / _FULL,
        "haze": 100 * (mean_where(near) - background)[whole] / height[whole],
        "background": 100 * background[whole] / _FULL,
        "noise": np.atleast_1d(100 * np.mean(np.abs(np.diff(profiles[away > 10]))) / (_FULL * 2 / np.sqrt(np.pi))),
    }
    ratio = np.log(height[whole & (height < 0.7 * _FULL)])
    if len(ratio) > 2 * _SMOOTH:
        ratio = ratio - np.convolve(np.pad(ratio, _SMOOTH // 2, "edge"), np.ones(_SMOOTH) / _SMOOTH, "valid")
        spread = 1.4826 * np.median(np.abs(ratio - np.median(ratio)))
        found["speckle"] = np.atleast_1d(100 * spread)
        ratio = np.clip(ratio, -3 * spread, 3 * spread)
        same = np.correlate(ratio, ratio, "full")[len(ratio) - 1 :]
        found["grain"] = np.atleast_1d(float(np.argmax(same < same[0] / np.e)))
    return found


def real_images(folder: Path) -> Iterator[np.ndarray]:
    """Images of a folder, of coloured ones the red channel."""
    for path in sorted(folder.iterdir()):
        if path.suffix.lower() in (".png", ".jpg", ".bmp", ".tif") and (image := cv2.imread(str(path))) is not None:
            yield image[..., 2]


def gathered(images: Iterable[np.ndarray], along: str) -> dict[str, np.ndarray]:
    """Figures of all images, joined."""
    found = [figures for image in images if (figures := figures_of(image, along)) is not None]
    return {name: np.concatenate([one[name] for one in found if name in one] or [np.empty(0)]) for name in FIGURES}


def main() -> None:
    """Print the table; draw the picture."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--generated", nargs="*", type=Path, default=[], help="data sets of twin dataset")
    parser.add_argument("--real", nargs="*", default=[], help="FOLDER=height or FOLDER=width")
    parser.add_argument("--out", type=Path, help="picture to write")
    parser.add_argument("--write", action="store_true", help="put the tables into their page of docs/results")
    given = parser.parse_args()
    sets: dict[str, dict[str, np.ndarray]] = {}
    for folder in given.generated:
        images = (sample["image"] for sample in twin.load_dataset(folder, names=("image",)))
        sets[folder.name] = gathered(images, "width")
    for each in given.real:
        folder, _, along = each.partition("=")
        sets[f"{Path(folder).name} (real)"] = gathered(real_images(Path(folder)), along)
    rows = []
    for name, words in FIGURES.items():
        cells = []
        for figures in sets.values():
            values = figures[name]
            cells.append(", ".join(f"{x:.3g}" for x in np.quantile(values, [0.05, 0.5, 0.95])) if len(values) else "-")
        rows.append([words, *cells])
    publish({"stripe domain": table(["5 %, median, 95 %", *sets], rows)}, write=given.write)
    if given.out:
        figure, axes = plt.subplots(4, 2, figsize=(11, 11), layout="constrained")
        axes.flat[-1].set_axis_off()
        for axis, (name, words) in zip(axes.flat, FIGURES.items(), strict=False):
            values = [figures[name] if len(figures[name]) else [np.nan] for figures in sets.values()]
            axis.boxplot(values, whis=(5, 95), showfliers=False, orientation="horizontal")
            axis.set_yticks(range(1, len(sets) + 1), list(sets))
            axis.set_xlabel(words)
        figure.savefig(given.out)


if __name__ == "__main__":
    main()
