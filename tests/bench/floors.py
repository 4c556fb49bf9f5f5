"""Plain computations by other libraries on the same data: what a task takes at least on the machine at hand.

Ratios to them hold on other machines, also on busy ones.
"""

import os
import subprocess
import sys
import tempfile
from pathlib import Path

import cv2
import h5py
import mitsuba as mi
import numpy as np
from numba import njit

from tests.bench.rows import median_seconds
from tests.stock_mitsuba import fog, stock_scene
from tests.virtual_sensors import altered
from twin.rendering_options import Options
from twin.scene.description import load_scene
from uwlts.model.library import load_sensor

WINDOW_PX = 16
"""Pixels on either side of a line's maximum in a plain centroid."""


def line_maxima_seconds(image: np.ndarray, stripe_along: str) -> float:
    """Median seconds of NumPy's maximum along the profile lines of an image (H, W)."""
    axis = 1 if stripe_along == "height" else 0
    return median_seconds(lambda k: image.max(axis=axis), runs=101)


def plain_centroid_seconds(image: np.ndarray, stripe_along: str) -> float:
    """Median seconds of a compiled centroid about the maximum of each profile line of an image (H, W)."""
    lines = np.ascontiguousarray(image if stripe_along == "height" else image.T)
    return median_seconds(lambda k: _centroids(lines, WINDOW_PX), runs=101)


@njit(nogil=True)
def _centroids(lines: np.ndarray, reach: int) -> np.ndarray:
    result = np.empty(lines.shape[0])
    for line in range(lines.shape[0]):
        pixels, highest = lines[line], 0
        for k in range(pixels.size):
            if pixels[k] > pixels[highest]:
                highest = k
        total, moment = 0.0, 0.0
        for k in range(max(highest - reach, 0), min(highest + reach + 1, pixels.size)):
            total += pixels[k]
            moment += k * pixels[k]
        result[line] = moment / max(total, 1.0)
    return result


def stored_image_seconds(image: np.ndarray) -> float:
    """Median seconds to append an image (H, W) to an HDF5 file, as one chunk without compression."""
    with tempfile.TemporaryDirectory() as folder, h5py.File(Path(folder, "floor.h5"), "w") as file:
        images = file.create_dataset(
            "images", (0, *image.shape), image.dtype, maxshape=(None, *image.shape), chunks=(1, *image.shape)
        )

        def append(k: int) -> None:
            images.resize(k + 1, axis=0)
            images[k] = image
            file.flush()

        return median_seconds(append, runs=31)


def stock_frame_seconds() -> float:
    """Median seconds of Mitsuba's own ``path`` integrator for a frame of two spheres lit by a projected sheet.

    Without water and windows: the sensor's pixels, one reflection, and the samples of a recorded frame.
    """
    bare = {"window": {"mounted": False}}
    sensor = altered(load_sensor("thesis"), {"camera": bare, "laser": bare})
    nothing = fog(absorption_per_m=0.0, scattering_per_m=0.0)
    scene = stock_scene(sensor, nothing, load_scene("spheres", medium="air"), across_texels=64)
    direct = mi.load_dict({"type": "path", "max_depth": 2})
    return median_seconds(
        lambda k: np.array(mi.render(scene, integrator=direct, spp=Options().spp, seed=k)), warm_up=2, runs=7
    )


def connected_parts_seconds(image: np.ndarray) -> float:
    """Median seconds of OpenCV's threshold by Otsu and its connected components of an image (H, W)."""

    def label(k: int) -> None:
        _, parts = cv2.threshold(image, 0, 255, cv2.THRESH_BINARY | cv2.THRESH_OTSU)
        cv2.connectedComponentsWithStats(parts)

    return median_seconds(label, runs=15)


def python_seconds(code: str) -> float:
    """Median seconds of a Python process that runs ``code``."""
    command = [sys.executable, "-c", code]
    return median_seconds(lambda k: subprocess.run(command, check=True, capture_output=True, env=dict(os.environ)))
