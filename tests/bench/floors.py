"""Plain computations by other libraries on the same data: what a task takes at least on the machine at hand.

Ratios to them hold on other machines, also on busy ones.
"""

import tempfile
import time
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

WINDOW_PX = 20
"""Pixels on either side of a line's brightest block in a plain centroid: the extraction's window."""

BLOCK_PX = 8
"""Pixels of a block along a line: the extraction's blocks."""

_FASTMATH = {"reassoc", "contract", "arcp", "nsz", "nnan"}


def line_maxima_seconds(image: np.ndarray, stripe_along: str) -> float:
    """Median seconds of processor time of NumPy's maximum along the profile lines of an image (H, W)."""
    axis = 1 if stripe_along == "height" else 0
    return median_seconds(lambda k: image.max(axis=axis), runs=101, clock=time.process_time)


def plain_centroid_seconds(image: np.ndarray, stripe_along: str) -> float:
    """Median seconds of processor time of a compiled centroid about the maximum of each line of an image (H, W).

    It returns what an extraction returns: centre, amplitude, width, and whether there is a stripe. But it assumes one
    stripe on each line and a constant background, and estimates no noise.
    """
    count = image.shape[0 if stripe_along == "height" else 1]
    result = np.empty((3, count), np.float32), np.empty(count, np.bool_)

    def run(k: int) -> None:
        profiles = cv2.transpose(image) if stripe_along == "height" else image
        highest = np.empty((-(-len(profiles) // BLOCK_PX), count), image.dtype)
        _centroids(profiles, highest, BLOCK_PX, WINDOW_PX, *result)

    return median_seconds(run, runs=101, clock=time.process_time)


@njit(nogil=True, error_model="numpy", fastmath=_FASTMATH)
def _centroids(
    profiles: np.ndarray, highest: np.ndarray, block: int, reach: int, measured: np.ndarray, found: np.ndarray
) -> None:
    """Measure lines of profiles (N, L): maxima of blocks in the order of memory, then moments about the best block."""
    for n in range(profiles.shape[0]):
        row, pixels = highest[n // block], profiles[n]
        for k in range(pixels.size):
            row[k] = pixels[k] if n % block == 0 else max(row[k], pixels[k])
    best, place = np.zeros(found.size, profiles.dtype), np.zeros(found.size, np.uint16)
    for number in range(highest.shape[0]):
        row = highest[number]
        for k in range(row.size):
            place[k] = np.uint16(number) if row[k] > best[k] else place[k]
            best[k] = max(best[k], row[k])
    for k in range(found.size):
        first = max(int(place[k]) * block + block // 2 - reach, 0)
        end = min(first + 2 * reach, profiles.shape[0])
        ground = np.float32(0.5) * (np.float32(profiles[first, k]) + np.float32(profiles[end - 1, k]))
        total, moment, square = np.float32(0.0), np.float32(0.0), np.float32(0.0)
        for n in range(first, end):
            light, u = np.float32(profiles[n, k]) - ground, np.float32(n - first)
            total, moment, square = total + light, moment + light * u, square + light * u * u
        middle = moment / max(total, np.float32(1.0))
        variance = max(square / max(total, np.float32(1.0)) - middle * middle, np.float32(0.0))
        measured[0, k], measured[1, k], measured[2, k] = first + middle, best[k] - ground, np.sqrt(variance)
        found[k] = best[k] > ground + np.float32(10.0)


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
