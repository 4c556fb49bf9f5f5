"""Stripes on the finishes of the twin beside real ones: their light along the stripe, and their centre, with a picture.

    python docs/studies/surface_finishes.py --real bust=FILE --real etna=FOLDER

Captures stay in a temporary folder. With --write, the table is put into its page, and the picture is drawn.
"""

from __future__ import annotations

import tempfile
from pathlib import Path
from typing import get_args

import matplotlib.pyplot as plt
import numpy as np
from cyclopts import App
from result_tables import publish, table

import twin
from twin.scene.description import Scene
from twin.scene.surfaces import Finish
from uwlts.radiometry.stripe_windows import STATISTICS, measure_windows, open_image_set

PICTURE = Path(__file__).resolve().parents[1] / "pictures" / "surface-finishes.png"
SHOWN = ("scatter", "correlation")
"""Statistics of windows in the table."""
FRAMES = 5
_LINES, _HALF_PX = (240, 1040), 20
"""Lines of the picture, and half its height."""
_TILT_DEG = (20.0, 15.0, 0.0)


def plate_scene(finish: Finish) -> Scene:
    """Return the scan of a tilted plate in coastal water, in steps far longer than the texture."""
    plate = {"kind": "plate", "width_mm": 300.0, "height_mm": 300.0, "finish": finish, "rotation_deg": _TILT_DEG}
    motion = {"start_mm": -10.0, "step_mm": 5.0, "count": FRAMES}
    return Scene.model_validate({"title": finish, "objects": [plate], "motion": motion, "water": "coastal"})


def cells_of(path: Path) -> list[str]:
    """Return the medians of the statistics of an image set's windows."""
    values = measure_windows(open_image_set(path), most_images=200).values
    columns = [values[:, [each.name for each in STATISTICS].index(name)] for name in SHOWN]
    return [f"{value:.2g}" for value in np.median(columns, axis=1)]


def main(*, real: tuple[str, ...] = (), write: bool = False) -> None:
    """Print the table; with ``write``, put it into its page, and draw the picture.

    ``real`` are sets of real images, as NAME=PATH.
    """
    rows, strips = [], []
    for each in real:
        name, _, path = each.partition("=")
        rows.append([f"real: {name}", *cells_of(Path(path)), "", ""])
        print(rows[-1], flush=True)
    for finish in get_args(Finish):
        scene = plate_scene(finish)
        with tempfile.TemporaryDirectory() as folder:
            path = twin.simulate(scene, out=Path(folder) / "stripe.h5", sensor="thesis")[0]
            cells = cells_of(path)
        recording = twin.render(scene, sensor="thesis", frames=[FRAMES // 2])
        centroid = recording.truth.centroid_px
        assert centroid is not None  # by rendering
        shift = (centroid - recording.truth.centre_px)[np.isfinite(centroid)]
        rows.append([finish, *cells, f"{shift.mean():+.3f}", f"{shift.std():.3f}"])
        strips.append((finish, straighten(recording.images[0], recording.truth.centre_px[0])))
        print(rows[-1], flush=True)
    head = ["surface", "scatter, %", "correlation", "mean shift, px", "scatter of the shift, px"]
    publish({"surfaces": table(head, rows)}, write=write)
    if write:
        draw(strips)


def straighten(image: np.ndarray, centre_px: np.ndarray) -> np.ndarray:
    """Return the middle lines of an image (H, W), shifted by whole pixels so that the true centre is in the middle."""
    columns = np.arange(*_LINES)
    rows = np.rint(centre_px[columns]).astype(int) + np.arange(-_HALF_PX, _HALF_PX + 1)[:, None]
    return image[rows, columns]


def draw(strips: list[tuple[Finish, np.ndarray]]) -> None:
    """Draw the straightened stripe on each finish."""
    figure, axes = plt.subplots(len(strips), 1, figsize=(8.0, 0.78 * len(strips)), layout="constrained")
    for axis, (finish, image) in zip(axes, strips, strict=True):
        axis.imshow((image / image.max()) ** 0.6, cmap="gray", interpolation="none", aspect="auto")
        axis.set(xticks=[], yticks=[])
        axis.set_ylabel(finish, rotation=0, ha="right", va="center")
    figure.savefig(PICTURE, dpi=110)


if __name__ == "__main__":
    App(help=__doc__, help_format="plaintext", default_command=main)()
