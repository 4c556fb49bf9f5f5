"""Image of multiply scattered light and of light reflected between surfaces, estimated by random walks.

Walks start in square cells of the image: large cells away from the stripe, more walks per cell beside it, and small
cells for the pixels of the stripe. In scattering water, the light is smoothed with its sum preserved, with the help of
noise-free images of the light sources: the stripe, the haze, and the light reflected by surfaces near the sheet.

Most walks find little light, and a few find very much. Walks are therefore sorted into classes by the light they find,
each class four times brighter than the one below. The light of each class is estimated separately, with more smoothing
if it rests on fewer walks:

- The whole class is described by a sum of features, noise-free images of the light sources. Their weights are
  non-negative and maximise the likelihood of the counts. Expectation maximisation (Shepp and Vardi 1982, Eq. 2.13)
  preserves the sum of all light.
- If there are more walks, they correct the description locally by the ratio of found to predicted light. Both are
  summed under a Gaussian just wide enough for a noise below the tolerance.
- If there are enough walks in a cell, the cell keeps the light that they found.

Light that the features do not predict is therefore blurred only as far as its noise exceeds the tolerance.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

import cv2
import drjit as dr
import mitsuba as mi
import numpy as np
from scipy.ndimage import map_coordinates

from twin.backend.arrays import Bool, Float, to_jit
from twin.light.camera import CameraView
from twin.light.image_sampling import NODE_SPACING_PX, combine_corners, find_marked
from twin.light.walk import Walker
from uwlts.runtime.compiled import compiled

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

    def image(self, stripe: np.ndarray, haze: np.ndarray, surfaces: list[np.ndarray]) -> np.ndarray:
        """Return the irradiance (H, W) in W/mm2 from images of the light's sources.

        These are images (H, W) of stripe and haze in W/mm2, and images (rows + 1, columns + 1) of lit surfaces at the
        corners of the small cells. Each shows the light that surfaces reflect to the camera if the illumination decays
        with the distance from the sheet over one of `SPREAD_MM`.
        """
        height, width = stripe.shape
        cells, inside = self._smooth(stripe, haze, surfaces) if self._scatters else self._compute_means()
        size = self._shape[1] * WALK_CELL_PX, self._shape[0] * WALK_CELL_PX
        image = cv2.resize(cells.astype(np.float32), size, interpolation=cv2.INTER_LINEAR)[:height, :width]
        for down, right in np.ndindex(NODE_SPACING_PX, NODE_SPACING_PX):
            row, column = (
                NODE_SPACING_PX * each + part for each, part in zip(self._in_stripe, (down, right), strict=True)
            )
            there = (row < height) & (column < width)
            image[row[there], column[there]] = inside[there]
        return image

    def _smooth(
        self, stripe: np.ndarray, haze: np.ndarray, surfaces: list[np.ndarray]
    ) -> tuple[np.ndarray, np.ndarray]:
        """Return smoothed light in large cells (rows, columns) and in the small cells of the stripe (P,)."""
        # Positions of the small cells in large cells, relative to the centre of the first one.
        row, column = (
            ((small + 0.5) * (NODE_SPACING_PX / WALK_CELL_PX) - 0.5).astype(np.float32) for small in self._in_stripe
        )
        features, fine = self._build_features(stripe, haze, surfaces, row, column)
        tolerance = TOLERANCE * float(stripe.max(initial=0.0))
        cells, inside = np.zeros(self._shape), np.zeros(len(row))
        for (in_large, in_small), noise_share in zip(self._found, NOISE_SHARES, strict=True):
            walks = self._walks * self._times
            estimate = estimate_light(in_large, walks, features, tolerance=tolerance, noise_share=noise_share)
            cells += estimate.cells
            inside += estimate.evaluate(row, column, fine, in_small, self._walks * self._times_in_stripe)
        return cells, inside

    def _build_features(
        self, stripe: np.ndarray, haze: np.ndarray, surfaces: list[np.ndarray], row: np.ndarray, column: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray]:
        """Return images that may describe the light: a constant, the haze, lit surfaces, and blurred stripe and haze.

        They are sampled in the large cells (J, rows, columns), and in the small cells of the stripe (J, P) at rows and
        columns (P,) in units of large cells.
        """
        reflected = [0.25 * combine_corners(np.add, nodes) for nodes in surfaces]
        stripe_cells, haze_cells, *cells = (_average_cells(each, *self._shape) for each in (stripe, haze, *reflected))
        widths = [_NARROWEST_CELLS]
        while widths[-1] < 0.2 * max(self._shape):
            widths.append(3 * widths[-1])
        blurs = [blur_cells(source, width) for source in (stripe_cells, haze_cells) for width in widths]
        fine_haze = haze[::NODE_SPACING_PX, ::NODE_SPACING_PX][self._lit]
        fine_blurs = [interpolate_cells(blur, row, column) for blur in blurs]
        return (
            np.stack([np.ones_like(haze_cells), haze_cells, *cells, *blurs]),
            np.stack([np.ones_like(fine_haze), fine_haze, *(image[self._lit] for image in reflected), *fine_blurs]),
        )

    def _compute_means(self) -> tuple[np.ndarray, np.ndarray]:
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
    x, y, side = (to_jit(values) for values in (columns - 0.5, rows - 0.5, sides))
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


def _average_cells(image: np.ndarray, rows: int, columns: int) -> np.ndarray:
    """Return means over large cells (rows, columns) of an image of pixels or small cells."""
    height, width = (-(-size // cells) * cells for size, cells in zip(image.shape, (rows, columns), strict=True))
    missing = height - image.shape[0], width - image.shape[1]
    if any(missing):
        image = np.pad(image, [(0, each) for each in missing], mode="edge")
    return cv2.resize(image.astype(np.float32), (columns, rows), interpolation=cv2.INTER_AREA)


# --- smoothing --------------------------------------------------------------------------------------------------------


_AT_ONCE = 2**22  # number of samples kept before they are sorted; they take about 50 MB
_CLASS_BITS = 2  # light varies within a class of walks by a factor of 2 to this power
_FAINT_SHARE = 0.05  # walks that change their cell by less than this fraction of the tolerance are put into one class
_CLASSES_ADD = 4  # number of classes, each at its tolerance, whose noise is assumed to add in one place
_NO_WEIGHT = 1e-25  # light in W/mm2 below which a feature is dropped
_WIDTHS = (0.7, 1.4, 2.8, 5.6)  # standard deviations in cells of the local corrections
_STEPS = 40  # number of expectation-maximisation steps; further ones change the light by less than its noise
_TINY = np.finfo(np.float32).tiny


class FoundLight:
    """Light found by walks in cells (rows, columns), per class, and the sum of its squares."""

    def __init__(self, rows: int, columns: int):
        self.shape = rows, columns
        self._first = 0
        self._light, self._squares = np.zeros((0, rows * columns)), np.zeros(0)
        self._new: list[tuple[np.ndarray, np.ndarray]] = []

    def add(self, cell: np.ndarray, light: np.ndarray) -> None:
        """Add the light (N,), above 0, of walks in flat cell indices (N,)."""
        self._new.append((cell, light))
        if sum(len(light) for _, light in self._new) > _AT_ONCE:
            self._sort()

    def _sort(self) -> None:
        if not any(len(light) for _, light in self._new):
            return
        cell, light = (np.concatenate(each) for each in zip(*self._new, strict=True))
        self._new = []
        kind = np.frexp(light)[1] // _CLASS_BITS
        first, end = int(kind.min()), int(kind.max()) + 1
        if len(self._squares):
            first, end = min(first, self._first), max(end, self._first + len(self._squares))
        size, count = math.prod(self.shape), end - first
        sums = np.bincount((kind - first) * size + cell, light, count * size).reshape(count, size)
        squares = np.bincount(kind - first, np.square(light, dtype=float), count)
        known = slice(self._first - first, self._first - first + len(self._squares))
        sums[known] += self._light
        squares[known] += self._squares
        self._first, self._light, self._squares = first, sums, squares

    def classes(self, faint: float = 0.0) -> list[range]:
        """Return contiguous classes from the faintest on; those with less light than ``faint`` are merged into one."""
        self._sort()
        if not len(self._squares):
            return []
        first, last = self._first, self._first + len(self._squares) - 1
        joined = first
        while joined < last and 2.0 ** (_CLASS_BITS * (joined + 1)) <= faint:
            joined += 1
        return [range(first, joined + 1), *(range(kind, kind + 1) for kind in range(joined + 1, last + 1))]

    def light(self, kinds: range) -> np.ndarray:
        """Return the light (rows, columns) of the walks in some classes."""
        found = self._light[self._find_slice(kinds)]
        return (found[0] if len(found) == 1 else found.sum(axis=0)).reshape(self.shape)

    def squares(self, kinds: range) -> float:
        """Return the sum of squared light of the walks in some classes."""
        return float(self._squares[self._find_slice(kinds)].sum())

    def total(self) -> np.ndarray:
        """Return the light (rows, columns) of all walks."""
        self._sort()
        return self._light.sum(axis=0).reshape(self.shape)

    def _find_slice(self, kinds: range) -> slice:
        self._sort()
        return slice(max(kinds.start - self._first, 0), max(kinds.stop - self._first, 0))


@dataclass(frozen=True)
class SmoothLight:
    """Mean light per walk in cells (rows, columns), and its description by the features alone.

    ``classes`` (K) are the classes of the walks and ``weights`` (K, J) their feature weights. ``portions`` (K,) is the
    mean light of one walk, weighted by light.
    """

    cells: np.ndarray
    described: np.ndarray
    classes: list[range]
    weights: np.ndarray
    portions: np.ndarray
    tolerance: float
    noise_share: float

    def evaluate(
        self, rows: np.ndarray, columns: np.ndarray, features: np.ndarray, findings: FoundLight, walks: int
    ) -> np.ndarray:
        """Return the light (P,) at rows and columns (P,), in cells, from the findings of ``walks`` at each place.

        If the light found at a position is too noisy, the result follows from the ``features`` (J, P) there and their
        weights. They are multiplied by the interpolated ratio of the cells to their description.
        """
        ratio = np.divide(self.cells, self.described, out=np.ones_like(self.cells), where=self.described > 0)
        expected = interpolate_cells(ratio, rows, columns) * (self.weights @ features)
        allowed = np.maximum(self.tolerance, self.noise_share * expected.sum(axis=0))
        light = np.zeros_like(allowed)
        for kinds, each, portion in zip(self.classes, expected, self.portions / walks, strict=True):
            light += np.where(_is_quiet(each, portion, allowed), findings.light(kinds).ravel() / walks, each)
        return light


def estimate_light(
    findings: FoundLight, walks: np.ndarray, features: np.ndarray, *, tolerance: float, noise_share: float
) -> SmoothLight:
    """Estimate the light of each cell from the findings of ``walks`` (rows, columns), with the permitted noise.

    ``features`` (J, rows, columns) may describe the light. The permitted noise is ``tolerance``, in the unit of the
    light, or the fraction ``noise_share`` of the light if this is larger.
    """
    mean_walks = float(walks.mean())
    exposure = (walks / mean_walks).astype(np.float32)
    total = findings.total()
    faint = _FAINT_SHARE * max(tolerance * mean_walks, noise_share * float(total.mean()))
    classes = [kinds for kinds in findings.classes(faint) if findings.squares(kinds) > 0]
    each_found = [findings.light(kinds) for kinds in classes]
    light = np.array([found / mean_walks for found in each_found], np.float32).reshape(-1, *total.shape)
    portions = np.array(
        [findings.squares(kinds) / found.sum() for kinds, found in zip(classes, each_found, strict=True)]
    )
    weights = _fit_weights(light, features, exposure)
    each_described = (weights @ features.reshape(len(features), -1)).reshape(light.shape)
    described = each_described.sum(axis=0)
    allowed = np.maximum(tolerance, noise_share * described)
    cells = np.zeros(total.shape, np.float32)
    for found, expected, portion in zip(light, each_described, portions / mean_walks, strict=True):
        cells += _correct_locally(found, expected, exposure, portion, allowed)
    # Preserve the sum over all walks.
    cells *= light.sum(dtype=float) / max((exposure * cells).sum(dtype=float), float(_TINY))
    return SmoothLight(cells, described, classes, weights, portions, tolerance, noise_share)


def _correct_locally(
    found: np.ndarray, expected: np.ndarray, exposure: np.ndarray, portion: float, allowed: np.ndarray
) -> np.ndarray:
    """Return the light (rows, columns) of one class: as found if its noise is tolerated, else as predicted.

    The prediction is corrected locally. ``portion`` is the contribution of one walk of the class to the light at
    exposure 1.
    """
    accepted = _is_quiet(expected, portion / exposure, allowed)
    estimate = np.where(accepted, found / exposure, expected)
    for width in _WIDTHS:
        if accepted.all():
            break
        nearby = np.maximum(_blur(exposure * expected, width), _TINY)
        share = expected / nearby
        suffices = ~accepted & _is_quiet(expected, portion * share / (4 * math.pi * width**2), allowed)
        if suffices.any():
            estimate = np.where(suffices, share * _blur(found, width), estimate)
            accepted |= suffices
    return estimate


def _is_quiet(light: np.ndarray, per_walk: np.ndarray, allowed: np.ndarray) -> np.ndarray:
    """Return the mask of light with tolerated noise and no prominent single walk: none exceeds the tolerance.

    Each walk contributes ``per_walk``. The number of walks is Poisson distributed, so the variance of the light is the
    light times ``per_walk``.
    """
    return (light * per_walk <= np.square(allowed) / _CLASSES_ADD) & (per_walk <= allowed)


def _fit_weights(light: np.ndarray, features: np.ndarray, exposure: np.ndarray) -> np.ndarray:
    """Return the feature weights (K, J) with the largest likelihood.

    ``light`` (K, rows, columns) is the light of all walks, whose number is proportional to ``exposure`` (rows,
    columns).
    """
    # Blocks of cells suffice for the weights because all features are blurred.
    counts, seen = _average_blocks(light), _average_blocks(features * exposure)
    norm = seen.sum(axis=1)
    # The inverse of a smaller number overflows.
    bright = norm >= np.finfo(norm.dtype).tiny
    per_norm = np.divide(1, norm, out=np.zeros_like(norm), where=bright)
    weights = counts.sum(axis=1)[:, None] * per_norm / np.count_nonzero(bright)
    seen = np.ascontiguousarray(seen.T)
    scratch = np.empty_like(per_norm), np.empty(len(seen), np.int64)
    for each, found in zip(weights, counts, strict=True):
        _maximise(each, found, seen, seen * per_norm, _NO_WEIGHT * per_norm, *scratch)
    return weights


@compiled
def _maximise(
    weights: np.ndarray,
    counts: np.ndarray,
    seen: np.ndarray,
    back: np.ndarray,
    least: np.ndarray,
    gain: np.ndarray,
    found: np.ndarray,
) -> None:
    """Improve the weights (J,) by `_STEPS` expectation-maximisation steps for the counts of blocks (B,).

    ``seen`` (B, J) is the light of each feature in each block, ``back`` (B, J) the same divided by the feature's sum.
    Blocks without counts change nothing. Weights below ``least`` (J,) are set to 0, as denormal numbers are slow.
    ``gain`` (J,) and ``found`` (B,) are work arrays.
    """
    some = 0
    for block in range(len(counts)):
        if counts[block] > 0:
            found[some] = block
            some += 1
    for _ in range(_STEPS):
        gain[:] = 0
        for k in range(some):
            block = found[k]
            expected = np.float32(0)
            for j in range(len(weights)):
                expected += weights[j] * seen[block, j]
            ratio = counts[block] / max(expected, _TINY)
            for j in range(len(weights)):
                gain[j] += ratio * back[block, j]
        for j in range(len(weights)):
            weights[j] = weights[j] * gain[j] if weights[j] * gain[j] >= least[j] else np.float32(0)


def _average_blocks(cells: np.ndarray) -> np.ndarray:
    """Return means (K, B) over blocks of about 2 x 2 cells (K, rows, columns)."""
    rows, columns = cells.shape[1:]
    size = max(1, columns // 2), max(1, rows // 2)
    blocks = [cv2.resize(each, size, interpolation=cv2.INTER_AREA).ravel() for each in cells]
    return np.array(blocks, np.float32).reshape(len(cells), size[0] * size[1])


def interpolate_cells(cells: np.ndarray, rows: np.ndarray, columns: np.ndarray) -> np.ndarray:
    """Interpolate cells (rows, columns) linearly at positions (P,)."""
    return map_coordinates(cells, [rows, columns], order=1, mode="nearest")


def blur_cells(cells: np.ndarray, sigma: float) -> np.ndarray:
    """Blur cells (rows, columns) by a Gaussian; a wide one is applied to coarser cells."""
    rows, columns = cells.shape
    coarse = cells.astype(np.float32)
    while sigma > 4 and min(coarse.shape) > 8:
        size = coarse.shape[1] // 2, coarse.shape[0] // 2
        coarse, sigma = cv2.resize(coarse, size, interpolation=cv2.INTER_AREA), 0.5 * sigma
    return cv2.resize(_blur(coarse, sigma), (columns, rows), interpolation=cv2.INTER_LINEAR)


def _blur(cells: np.ndarray, sigma: float) -> np.ndarray:
    return cv2.GaussianBlur(cells, (0, 0), sigma, borderType=cv2.BORDER_REFLECT)
