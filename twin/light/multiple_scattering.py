"""Image of multiply scattered light and of light reflected between surfaces, estimated by random walks.

Walks start in square cells of the image: large cells away from the stripe, more walks per cell beside it, and small
cells for the pixels of the stripe. In scattering water, `twin.light.smoothing` removes the noise. It uses noise-free
images of the light sources: the stripe, the haze, and the light reflected by surfaces near the sheet.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

import cv2
import drjit as dr
import mitsuba as mi
import numpy as np

from twin.backend.arrays import Bool, Float, to_jit
from twin.light.camera import CameraView
from twin.light.image_sampling import NODE_SPACING_PX, combine_corners, find_marked
from twin.light.smoothing import FoundLight, blur_cells, estimate_light, interpolate_cells
from twin.light.walk import Walker

WALK_CELL_PX = 8  # side length of the cells for multiply scattered light away from the stripe
WALKS_AT_ONCE = 2**21  # largest number of random walks traced together; this many take about 200 MB
SPREAD_MM = (0.3, 1.2, 5.0, 20.0, 80.0)
"""Decay lengths, to 1 / e, of light that the water scatters from the sheet onto surfaces."""
TOLERANCE = 2.5e-4
"""Tolerated noise as a fraction of the stripe's peak: a fifth of the 8-bit rounding error at a peak of 200."""
NOISE_SHARES = (0.05, 0.2)
"""Tolerated noise as a fraction of the light: of light scattered by water, and of the steeper light between surfaces.
"""
_NARROWEST_CELLS = 0.7
"""Standard deviation in cells of the least blurred images of stripe and haze; each further one is three times as wide.
"""
_WALKS_BESIDE_STRIPE = 8  # factor on the number of walks beside the stripe, where the light is bright and steep
_CELLS_BESIDE_STRIPE = 2  # width in cells of the border of the stripe that takes more walks
_WALKS_IN_STRIPE = 4
"""Factor on the number of walks in the small cells of the stripe; 1 if neighbouring cells determine the light there."""


@dataclass(frozen=True)
class LightSources:
    """Light sources of random walks: images (H, W) of the stripe and the haze in W/mm2, and images of lit surfaces.

    ``surfaces`` are images (rows + 1, columns + 1) at the corners of the small cells. Each shows the light that
    surfaces reflect to the camera if the illumination decays with the distance from the sheet over one of `SPREAD_MM`.
    """

    stripe: np.ndarray
    haze: np.ndarray
    surfaces: list[np.ndarray]


def decay_with_distance(reflected: Float, distance_mm: Float, active: Bool) -> list[Float]:
    """Return the reflected light, decayed with the distance from the sheet over each of `SPREAD_MM`."""
    return [dr.select(active, reflected * dr.exp(-dr.abs(distance_mm) / spread), 0.0) for spread in SPREAD_MM]


class IndirectLight:
    """Multiply scattered light and light between surfaces, traced on construction; ``walks`` start in most large cells.

    ``lit`` (rows, columns) marks the small cells of the stripe's pixels. `image` smooths the result without the
    renderer.
    """

    def __init__(self, view: CameraView, walker: Walker, lit: np.ndarray, *, seed: int, walks: int):
        self._lit, self._walks, self._scatters = lit, walks, walker.scatters
        height, width = view.camera.height_px, view.camera.width_px
        rows, columns = self._shape = -(-height // WALK_CELL_PX), -(-width // WALK_CELL_PX)
        self._times = np.where(_mark_near_stripe(lit, rows, columns), _WALKS_BESIDE_STRIPE, 1)
        self._times_in_stripe = 1 if walker.scatters else _WALKS_IN_STRIPE
        self._in_stripe = row_in_stripe, column_in_stripe = find_marked(lit)
        large = np.repeat(np.arange(rows * columns), self._times.ravel())
        small = np.repeat(np.arange(len(row_in_stripe)), self._times_in_stripe)
        self._found = [(FoundLight(rows, columns), FoundLight(1, len(row_in_stripe))) for _ in NOISE_SHARES]
        for cell, *parts in trace_walks(
            view,
            walker,
            np.concatenate([large // columns * WALK_CELL_PX, row_in_stripe[small] * NODE_SPACING_PX]),
            np.concatenate([large % columns * WALK_CELL_PX, column_in_stripe[small] * NODE_SPACING_PX]),
            np.repeat([WALK_CELL_PX, NODE_SPACING_PX], [len(large), len(small)]),
            seed=seed,
            walks=walks,
        ):
            for (in_large, in_small), light in zip(self._found, parts, strict=True):
                found = np.flatnonzero(light > 0)
                where, light = cell[found], light[found]
                is_large = where < len(large)
                in_large.add(large[where[is_large]], light[is_large])
                in_small.add(small[where[~is_large] - len(large)], light[~is_large])

    def image(self, sources: LightSources) -> np.ndarray:
        """Return the irradiance (H, W) in W/mm2."""
        height, width = sources.stripe.shape
        cells, inside = self._smooth(sources) if self._scatters else self._means()
        size = self._shape[1] * WALK_CELL_PX, self._shape[0] * WALK_CELL_PX
        image = cv2.resize(cells.astype(np.float32), size, interpolation=cv2.INTER_LINEAR)[:height, :width]
        for down, right in np.ndindex(NODE_SPACING_PX, NODE_SPACING_PX):
            row, column = (
                NODE_SPACING_PX * each + part for each, part in zip(self._in_stripe, (down, right), strict=True)
            )
            there = (row < height) & (column < width)
            image[row[there], column[there]] = inside[there]
        return image

    def _smooth(self, sources: LightSources) -> tuple[np.ndarray, np.ndarray]:
        """Return smoothed light in large cells (rows, columns) and in the small cells of the stripe (P,)."""
        row, column = map(_to_large_cells, self._in_stripe)
        features, fine = _build_features(sources, self._lit, *self._shape, row, column)
        tolerance = TOLERANCE * float(sources.stripe.max(initial=0.0))
        cells, inside = np.zeros(self._shape), np.zeros(len(row))
        for (in_large, in_small), noise_share in zip(self._found, NOISE_SHARES, strict=True):
            walks = self._walks * self._times
            estimate = estimate_light(in_large, walks, features, tolerance=tolerance, noise_share=noise_share)
            cells += estimate.cells
            inside += estimate.evaluate(row, column, fine, in_small, self._walks * self._times_in_stripe)
        return cells, inside

    def _means(self) -> tuple[np.ndarray, np.ndarray]:
        """Return unsmoothed light in the same cells: without scattering there are no rare bright samples."""
        cells = np.sum([in_large.total() for in_large, _ in self._found], axis=0) / (self._walks * self._times)
        inside = np.sum([in_small.total()[0] for _, in_small in self._found], axis=0)
        return cells, inside / (self._walks * self._times_in_stripe)


def trace_walks(
    view: CameraView, walker: Walker, rows: np.ndarray, columns: np.ndarray, sides: np.ndarray, *, seed: int, walks: int
) -> Iterator[tuple[np.ndarray, np.ndarray, np.ndarray]]:
    """Trace random walks; yield cells (N,) and both kinds of irradiance (N,) in W/mm2 as `Walker.trace` does.

    ``rows`` and ``columns`` (C,) give the first pixel of each square cell, ``sides`` (C,) its side length in pixels.
    ``walks`` start in each cell.
    """
    x, y, side = (to_jit(mi.Float, values) for values in (columns - 0.5, rows - 0.5, sides))
    most = max(1, WALKS_AT_ONCE // len(rows))
    for part, first in enumerate(range(0, walks, most)):
        some = min(most, walks - first)
        count, place_seed = len(rows) * some, (1009 * part + 2 * seed) % 2**32
        cell = dr.arange(mi.UInt32, count) // dr.opaque(mi.UInt32, some)
        place: Any = dr.arange(mi.UInt32, count)
        keys: list[Any] = [dr.opaque(mi.UInt32, (place_seed + k) % 2**32) for k in (0, 1)]
        u, v = (mi.sample_tea_float32(place, key) for key in keys)
        left, above, width = (dr.gather(mi.Float, values, cell) for values in (x, y, side))
        bundle = view.trace_bundle(left + u * width, above + v * width)
        yield from walker.trace(bundle, cell, seed=seed + 1013 * part)


def _mark_near_stripe(lit: np.ndarray, rows: int, columns: int) -> np.ndarray:
    """Return the mask of large cells (rows, columns) on or next to the stripe, whose small cells are ``lit``."""
    on_stripe = np.zeros((rows, columns), np.uint8)
    row, column = find_marked(lit)
    on_stripe[row * NODE_SPACING_PX // WALK_CELL_PX, column * NODE_SPACING_PX // WALK_CELL_PX] = 1
    across = 2 * _CELLS_BESIDE_STRIPE + 1
    return cv2.dilate(on_stripe, np.ones((across, across), np.uint8)) > 0


def _build_features(
    sources: LightSources, lit: np.ndarray, rows: int, columns: int, place_rows: np.ndarray, place_columns: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Return images that may describe the light: a constant, the haze, lit surfaces, and blurred stripe and haze.

    They are sampled in the large cells (J, rows, columns), and in the small cells of the stripe (J, P). ``place_rows``
    and ``place_columns`` (P,) are the positions of the small cells in units of large cells.
    """
    stripe, haze = (_average_cells(image, rows, columns) for image in (sources.stripe, sources.haze))
    surfaces = [0.25 * combine_corners(np.add, nodes) for nodes in sources.surfaces]
    widths = [_NARROWEST_CELLS]
    while widths[-1] < 0.2 * max(rows, columns):
        widths.append(3 * widths[-1])
    blurs = [blur_cells(source, width) for source in (stripe, haze) for width in widths]
    fine_haze = sources.haze[::NODE_SPACING_PX, ::NODE_SPACING_PX][lit]
    fine_blurs = [interpolate_cells(blur, place_rows, place_columns) for blur in blurs]
    return (
        np.stack([np.ones_like(haze), haze, *(_average_cells(image, rows, columns) for image in surfaces), *blurs]),
        np.stack([np.ones_like(fine_haze), fine_haze, *(image[lit] for image in surfaces), *fine_blurs]),
    )


def _average_cells(image: np.ndarray, rows: int, columns: int) -> np.ndarray:
    """Return means over large cells (rows, columns) of an image of pixels or small cells."""
    height, width = (-(-size // cells) * cells for size, cells in zip(image.shape, (rows, columns), strict=True))
    missing = height - image.shape[0], width - image.shape[1]
    if any(missing):
        image = np.pad(image, [(0, each) for each in missing], mode="edge")
    return cv2.resize(image.astype(np.float32), (columns, rows), interpolation=cv2.INTER_AREA)


def _to_large_cells(small: np.ndarray) -> np.ndarray:
    """Convert rows or columns of small cells to positions in large cells, relative to the centre of the first one."""
    return ((small + 0.5) * (NODE_SPACING_PX / WALK_CELL_PX) - 0.5).astype(np.float32)
