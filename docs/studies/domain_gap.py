"""Domain gap between rendered data sets and real photographs, exposure of the data sets, and pictures of both.

    python docs/studies/domain_gap.py FOLDER [PRESET ...] [--write]
    python docs/studies/domain_gap.py FOLDER --classifier [--write]   # needs the extra results
    python docs/studies/domain_gap.py FOLDER [PRESET ...] --pictures

Data sets in the folder are kept. The classifier has extremely randomised trees of grey values, gradients, spectra and
local binary patterns of pieces of the stripe. All scenes but one train it, and it judges the pieces of that scene.
"""

from itertools import combinations, pairwise
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from cyclopts import App
from result_tables import ROOT, publish, table

import twin
from twin.datasets.data_set import LineStatus
from uwlts.radiometry.domain_gap import measure_domain_gap
from uwlts.radiometry.stripe_windows import measure_windows, open_image_set

PRESETS = "stripe-clean", "stripe-turbid", "stripe-shiny", "stripe-tank"
DATA = ROOT / "tests" / "data"
REAL = {
    "etna": DATA / "etna",
    "bust": DATA / "ciclop" / "bust" / "laser_x400_y0.png",
    "board": DATA / "ciclop" / "board" / "laser_x200_y440.png",
}
STRIPE: Any = {"min_fwhm_px": 1.3}  # with the default of 1.0 the board shows fewer windows than a gap needs
BRIGHT, LINES = 0.05, 0.01
"""Largest fraction of pixels at the maximum, and smallest fraction of lines with a stripe, of a well exposed frame."""
TREES = 500


def gaps(sources: list[Path]) -> str:
    """Return the table of domain gaps, with the percentage of real windows covered in all statistics at once."""
    found = measure_domain_gap(sources, real=list(REAL.values()), stripe=STRIPE)
    pairs = {(each.name, each.real): each for each in found.gaps}
    rows = []
    for own in found.generated:
        of_real = [pairs[own.name, real.name] for real in found.real]
        cells = [f"{pair.gap:.2f} ± {pair.std:.2f} ({100 * pair.covered_at_once:.0f})" for pair in of_real]
        rows.append([own.name, f"{len(own.values)}", *cells])
    apart = [pairs[one.name, other.name].gap for one, other in combinations(found.real, 2)]
    print(f"gaps between real sets: {min(apart):.2f} to {max(apart):.2f}")
    rows.append(["two halves of the set", "", *(f"{floor.gap:.2f} ± {floor.std:.2f}" for floor in found.floors)])
    return table(["gap", "windows", *REAL], rows)


def exposures(sources: list[Path]) -> str:
    """Return the table of frames that are too bright, or whose laser leaves no stripe."""
    rows = []
    for folder in sources:
        samples = twin.load_dataset(folder, names=["image", "info", "status"])
        full = 2 ** samples.card.image["bits"] - 1
        bright, lines, middle = [], [], []
        for sample in samples:
            bright.append(sample["info"]["at_maximum"] > BRIGHT)
            middle.append(100 * np.median(sample["image"]) / full)
            if sample["info"]["light"] == "laser":
                lines.append(np.isin(sample["status"], (LineStatus.VISIBLE, LineStatus.SATURATED)).mean())
        cells = [100 * np.mean(bright), 100 * np.mean(np.array(lines) < LINES)]
        quantiles = ", ".join(f"{each:.1f}" for each in np.quantile(middle, (0.05, 0.5, 0.95)))
        rows.append([folder.name, f"{len(bright)}", *(f"{each:.1f} %" for each in cells), quantiles])
    return table(["set", "frames", "too bright", "without a stripe", "median grey value, % (5, 50, 95 %)"], rows)


def pieces(source: Path) -> tuple[np.ndarray, np.ndarray]:
    """Return features (N, K) of pieces of the stripe, and their scenes (N,)."""
    images, found, scenes = open_image_set(source, stripe=STRIPE), [], []
    per_scene = 1
    if (source / "dataset.json").is_file():
        known = twin.load_dataset(source, names=["info"])
        per_scene = len(known) // sum(known.card.scenes.values())
    for number, image in enumerate(images.images(1000)):
        one = type(images)(**vars(images) | {"count": 1, "read": lambda _, image=image: iter([image])})
        own = measure_windows(one, most_images=1).pictures
        found += map(features, own)
        scenes += [number // per_scene] * len(own)
    return np.array(found), np.array(scenes)


def features(piece: np.ndarray) -> np.ndarray:
    """Return features (K,) of a piece (A, L) with the stripe along its width, relative to full scale."""
    shares = (0.01, 0.05, 0.25, 0.5, 0.75, 0.95, 0.99)
    values = [np.quantile(each, shares) for each in (piece, *(np.abs(np.diff(piece, axis=k)) for k in (0, 1)))]
    for axis in (0, 1):
        power = (np.abs(np.fft.rfft(piece - piece.mean(axis=axis, keepdims=True), axis=axis)) ** 2).mean(axis=1 - axis)
        edges = np.unique(np.geomspace(1, len(power), 9).astype(int))
        values.append(np.log10([power[a:b].mean() + 1e-9 for a, b in pairwise(edges)]))
    rows, columns = piece.shape
    around = [piece[i : rows - 2 + i, j : columns - 2 + j] for i in range(3) for j in range(3)]
    brighter = sum((each > around[4]).astype(int) for each in around)
    values.append(np.bincount(np.ravel(brighter), minlength=9) / np.size(brighter))
    return np.concatenate(values)


def classify(sources: list[Path]) -> str:
    """Return the table of areas under the curve: the probability that a real piece looks more real than a generated."""
    from sklearn.ensemble import ExtraTreesClassifier  # pyright: ignore[reportMissingImports]

    real, rows = [pieces(path) for path in REAL.values()], []
    # A set of one image is left out as a whole: the trees have never seen its kind.
    largest = [name for name, (_, scenes) in zip(REAL, real, strict=True) if len(np.unique(scenes)) > 1]
    for folder in sources:
        sets = [pieces(folder), *real]
        x, group = np.vstack([own for own, _ in sets]), np.repeat(range(len(sets)), [len(own) for own, _ in sets])
        scene = np.concatenate([1000 * number + scenes for number, (_, scenes) in enumerate(sets)])
        score = np.zeros(len(x))
        for left_out in np.unique(scene):
            own = scene == left_out
            trees = ExtraTreesClassifier(TREES, class_weight="balanced", min_samples_leaf=2, random_state=0)
            score[own] = trees.fit(x[~own], group[~own] > 0).predict_proba(x[own])[:, 1]
        cells = []
        for chosen in (group > 0, *(group == 1 + list(REAL).index(name) for name in largest)):
            apart = score[chosen][:, None] - score[group == 0]
            cells.append(f"{np.mean((apart > 0) + 0.5 * (apart == 0)):.2f}")
        rows.append([folder.name, *cells])
    return table(["AUC", "all", *largest], rows)


def draw(folder: Path, *, count: int = 12, size: int = 150) -> np.ndarray:
    """Return a picture of frames of a data set above as many photographs."""
    samples = twin.load_dataset(folder, names=["image", "info"])
    lit = [sample["image"] for sample in samples if sample["info"]["light"] == "laser"]
    full = 2 ** samples.card.image["bits"] - 1
    rendered = [255.0 / full * lit[k] for k in np.linspace(0, len(lit) - 1, count).astype(int)]
    real = [
        cv2.imread(str(path))[:, :, 2] for path in (REAL["bust"], REAL["board"], *sorted(REAL["etna"].glob("*.jpg")))
    ]
    rows = []
    for images in (rendered[: count // 2], rendered[count // 2 :], real[: count // 2], real[count // 2 : count]):
        squares = []
        for image in images:
            side = min(image.shape)
            top, left = ((length - side) // 2 for length in image.shape)
            small = cv2.resize(
                np.uint8(image[top : top + side, left : left + side]), (size, size), interpolation=cv2.INTER_AREA
            )
            squares.append(cv2.copyMakeBorder(small, 1, 1, 1, 1, cv2.BORDER_CONSTANT, value=128))
        rows.append(np.hstack(squares))
    return np.vstack(rows)


def main(
    folder: Path,
    *presets: str,
    scenes: int = 6,
    seed: int = 62,
    classifier: bool = False,
    pictures: bool = False,
    write: bool = False,
) -> None:
    """Render and print the tables; with `--write`, put them into their page.

    Nobody looked at scenes of the default seed while the ranges of the presets were chosen.
    """
    sources = [folder / preset for preset in presets or PRESETS]
    for source in sources:
        if not (source / "dataset.json").exists():
            twin.dataset(source.name, scenes=scenes, seed=seed, out=source)
    stripes = [source for source in sources if source.name.startswith("stripe")]
    if classifier:
        publish({"data set classifier": classify(stripes)}, write=write)
    elif pictures:
        for source in sources:
            path = ROOT / "docs" / "pictures" / f"data-set-{source.name}.jpg"
            cv2.imwrite(str(path), draw(source), [cv2.IMWRITE_JPEG_QUALITY, 70])
    else:
        print(exposures(sources))
        publish({"domain gap": gaps(stripes)}, write=write)


if __name__ == "__main__":
    App(help=__doc__, help_format="plaintext", default_command=main)()
