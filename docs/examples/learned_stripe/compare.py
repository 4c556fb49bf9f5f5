"""Compare a trained network with the project's own methods, on the test scenes of data sets and on real images.

    python compare.py stripe.onnx runs/clean runs/turbid runs/shiny --real FOLDER

Only lines with a visible stripe and a Cramer-Rao bound below one pixel are evaluated. A line is found if the method's
centre is within `NEAR_PX` of the true one. A centre farther away, or on a line without a stripe, is false. Errors are
those of the found lines. The bound is for detector noise without speckle. The truth of real images is unknown: for
them, the table shows the scatter of the centres about a smooth stripe.
"""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path

import cv2
import numpy as np

import twin
from twin.datasets.data_set import LineStatus
from uwlts.stripe import StripeOptions, extract_stripe, method_names

NEAR_PX = 3.0
SMOOTH_LINES = 31
"""Lines over which a real stripe is a parabola."""


@dataclass
class Tally:
    """Results of a method on a data set: errors of found lines and their bounds, in px, and counts of lines."""

    errors: list[np.ndarray] = field(default_factory=list)
    bounds: list[np.ndarray] = field(default_factory=list)
    seen: int = 0
    other: int = 0
    false: int = 0

    def add(self, centre: np.ndarray, sample: dict[str, np.ndarray]) -> None:
        """Count the centres (L,) of one image."""
        status, truth = sample["status"], sample["centre_px"]
        visible = np.isin(status, (LineStatus.VISIBLE, LineStatus.SATURATED)) & (sample["bound_px"] < 1)
        judged = visible | np.isin(status, (LineStatus.NOT_CROSSED, LineStatus.SHADOWED))
        near = visible & (np.abs(centre - truth) <= NEAR_PX)
        self.errors.append((centre - truth)[near])
        self.bounds.append(sample["bound_px"][near])
        self.seen, self.other = self.seen + int(visible.sum()), self.other + int(judged.sum())
        self.false += int((judged & np.isfinite(centre) & ~near).sum())

    def row(self, name: str) -> str:
        """A line of the table."""
        error = np.concatenate(self.errors)
        bound = np.sqrt(np.nanmean(np.square(np.concatenate(self.bounds))))
        return (
            f"| {name} | {100 * len(error) / self.seen:.1f} | {100 * self.false / self.other:.2f} | "
            f"{np.sqrt(np.mean(error**2)):.3f} | {np.median(np.abs(error)):.3f} | {np.mean(error):+.3f} | {bound:.3f} |"
        )


def methods(model: Path) -> dict[str, StripeOptions]:
    """Return the options of all methods and of the network; all keep the lines beside ends of the stripe."""
    known = {name: StripeOptions(method=name, end_lines=0) for name in method_names()}
    return known | {"learned": StripeOptions(method="learned", model=str(model), end_lines=0)}


def judge(folder: Path, options: dict[str, StripeOptions]) -> dict[str, Tally]:
    """Return the tallies of all methods on the test scenes of a data set."""
    tallies = {name: Tally() for name in options}
    for sample in twin.load_dataset(folder, split="test", names=("image", "centre_px", "status", "bound_px")):
        for name, how in options.items():
            stripe = extract_stripe(sample["image"], stripe_along="width", options=how)
            tallies[name].add(stripe.centre_px, sample)
    return tallies


def smooth_scatter(images: Sequence[np.ndarray], along: str, how: StripeOptions) -> tuple[float, float]:
    """Return the fraction of lines with a centre, and the centres' scatter in px about parabolas of `SMOOTH_LINES`."""
    found, lines, left = 0, 0, []
    for image in images:
        centre = extract_stripe(image, stripe_along=along, options=how).centre_px
        found, lines = found + int(np.isfinite(centre).sum()), lines + len(centre)
        for start in range(0, len(centre) - SMOOTH_LINES, SMOOTH_LINES):
            part = centre[start : start + SMOOTH_LINES]
            good = np.isfinite(part)
            # A stripe without gaps and edges.
            if good.all() and np.abs(np.diff(part)).max() < NEAR_PX:
                place = np.arange(SMOOTH_LINES) - SMOOTH_LINES // 2
                left.append(part - np.polyval(np.polyfit(place, part, 2), place))
    return found / max(lines, 1), float(np.std(np.concatenate(left))) if left else np.nan


def main() -> None:
    """Print the tables."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("model", type=Path)
    parser.add_argument("folders", nargs="*", type=Path, help="data sets of twin dataset")
    parser.add_argument("--real", type=Path, help="folder of real laser images")
    parser.add_argument("--along", choices=("width", "height"), default="width", help="how their stripe runs")
    given = parser.parse_args()
    options = methods(given.model)
    for folder in given.folders:
        print(f"\n{folder.name}\n\n| method | found % | false % | rms px | median px | bias px | bound px |")
        print("| --- | --- | --- | --- | --- | --- | --- |")
        for name, tally in judge(folder, options).items():
            print(tally.row(name))
    if given.real:
        paths = sorted(p for p in given.real.iterdir() if p.suffix.lower() in (".png", ".jpg", ".bmp", ".tif"))
        images = [image[..., 2] for p in paths if (image := cv2.imread(str(p))) is not None]
        print(f"\n{given.real.name}, {len(images)} images\n\n| method | lines % | scatter px |\n| --- | --- | --- |")
        for name, how in options.items():
            share, scatter = smooth_scatter(images, given.along, how)
            print(f"| {name} | {100 * share:.1f} | {scatter:.3f} |")


if __name__ == "__main__":
    main()
