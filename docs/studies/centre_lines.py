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
                    diameter = np.abs([figure.value_mm for figure in result.diameters])
                    spacing, std = abs(result.sphere_spacing.value_mm), result.std.value_mm
                    rows.append(
                        (1e3 * spacing, 1e3 * std, 1e3 * diameter.max(), len(cloud), os.path.getsize(path), rate)
                    )
                spacing, std, diameter, points, size, rate = np.mean(rows, axis=0)
                errors = [f"{value:.1f} µm" for value in (spacing, std, diameter)]
                cells.append(
                    [water, camera, *errors, f"{points:,.0f}", f"{size / 1e6:.3g} MB", f"{rate:,.0f} frames/s"]
                )
    head = ["water", "camera", "spacing error", "std about the spheres", "diameter error", "points", "file"]
    publish({"centre lines": table([*head, "stripes and points, one core"], cells)}, write=write)


if __name__ == "__main__":
    App(help=__doc__, help_format="plaintext", default_command=main)()
