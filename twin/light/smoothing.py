"""Estimation of smooth light from few random walks, with the help of noise-free images and with the sum preserved.

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
from dataclasses import dataclass

import cv2
import numpy as np
from scipy.ndimage import map_coordinates

from uwlts.runtime.compiled import compiled

_AT_ONCE = 2**22  # number of samples kept before they are sorted; they take about 50 MB
_CLASS_BITS = 2  # light varies within a class of walks by a factor of 2 to this power
_FAINT_SHARE = 0.05  # walks that change their cell by less than this fraction of the tolerance are put into one class
_CLASSES_ADD = 4  # number of classes, each at its tolerance, whose noise is assumed to add in one place
_NO_WEIGHT = 1e-25  # light in W/mm2 below which a feature is dropped
_PORTION = 1.0  # largest contribution of one walk in one place, in units of the tolerance
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
        """Sort newly added samples into their classes."""
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
        found = self._light[self._slice_of(kinds)]
        return (found[0] if len(found) == 1 else found.sum(axis=0)).reshape(self.shape)

    def squares(self, kinds: range) -> float:
        """Return the sum of squared light of the walks in some classes."""
        return float(self._squares[self._slice_of(kinds)].sum())

    def total(self) -> np.ndarray:
        """Return the light (rows, columns) of all walks."""
        self._sort()
        return self._light.sum(axis=0).reshape(self.shape)

    def _slice_of(self, kinds: range) -> slice:
        """Return the slice of contiguous classes within the stored ones."""
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
        """Return the light (P,) at positions in cells.

        If the light found at a position is too noisy, the result follows from the feature weights and from the
        interpolated ratio of the cells to their description.

        Parameters
        ----------
        rows, columns : (P,)
            Positions, in cells.
        features : (J, P)
            Features at these positions.
        findings
            Light found at each position.
        walks
            Number of walks at each position.
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
    """Return the mask of light with tolerated noise and no prominent single walk.

    Each walk contributes ``per_walk``. The number of walks is Poisson distributed, so the variance of the light is the
    light times ``per_walk``.
    """
    return (light * per_walk <= np.square(allowed) / _CLASSES_ADD) & (per_walk <= _PORTION * allowed)


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
