"""Spheres measured from images and from the centre lines of a 3D camera, rendered with the same noise.

python docs/studies/centre_lines.py [--write]
"""

import os
import tempfile
import time
from pathlib import Path

import numpy as np
from cyclopts import App
from result_tables import publish, table

import twin
import uwlts

WATERS = "clear", "coastal"
PLACES = "near", "standoff", "far"
CAMERAS = {"images": (), "centre lines": ("camera-3d",)}


def main(*, write: bool = False) -> None:
    """Print a row for each water and camera; with `--write`, put the table into its page."""
    calibration = uwlts.nominal("thesis", medium="water")
    cells = []
    with tempfile.TemporaryDirectory() as folder:
        for water in WATERS:
            for camera, effects in CAMERAS.items():
                rows = []
                for place in PLACES:
                    path = Path(folder) / "scan.h5"
                    twin.simulate("spheres", placement=place, water=water, effects=effects, out=path, overwrite=True)
                    with uwlts.read(path) as capture:
                        uwlts.reconstruct(capture, calibration)
                        began = time.process_time()
                        cloud = uwlts.reconstruct(capture, calibration)
                        rate = len(capture) / (time.process_time() - began)
                    result = uwlts.evaluate(cloud)
                    spacing, std = abs(result.sphere_spacing.value_mm), result.std.value_mm
                    rows.append((1e3 * spacing, 1e3 * std, os.path.getsize(path), rate))
                spacing, std, size, rate = np.mean(rows, axis=0)
                cells.append([water, camera, f"{spacing:.1f}", f"{std:.1f}", f"{size / 1e6:.3g} MB", f"{rate:,.0f}"])
    head = ["water", "camera", "spacing error, µm", "std about the spheres, µm", "file", "frames/s, one core"]
    publish({"centre lines": table(head, cells)}, write=write)


if __name__ == "__main__":
    App(help=__doc__, help_format="plaintext", default_command=main)()
