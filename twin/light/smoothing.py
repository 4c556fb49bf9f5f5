"""Smooth light from few random walks: their noise is removed by what its sources predict, and the sum is kept.

Most light of a walk is small; now and then one finds very much. So walks are sorted into classes by how much they
found, each four times brighter than the one below, and the light of each class is estimated on its own, the more widely
the fewer walks it rests on:

- The class as a whole is described by a sum of features, images without noise of what sends the light. The weights,
  none negative, are those of the largest likelihood of counts, found by expectation and maximisation (Shepp and Vardi
  1982, Eq. 2.13), which keeps the sum of all light.
- Where more walks are at hand, they correct that locally: by the ratio of what they found to what the features
  predict, both summed under a Gaussian that is just wide enough for a noise below the tolerance.
- Where they suffice, each cell keeps what its own walks found.

Light that the features do not predict is therefore blurred only as far as its noise exceeds the tolerance.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import cv2
import numpy as np
from scipy.ndimage import map_coordinates

from uwlts.runtime.compiled import compiled

_AT_ONCE = 2**22
"""So many findings are kept before they are sorted; they take some 50 MB."""
_CLASS_BITS = 2
"""The light of a class of walks varies by this power of two."""
_FAINT_SHARE = 0.05
"""Walks that change their cell by less than this share of the tolerance need no classes of their own."""
_CLASSES_ADD = 4
"""So many classes at most add to the noise in one place, each at its tolerance."""
_NO_WEIGHT = 1e-25
"""Light in W/mm2 that is none."""
_PORTION = 1.0
"""What one walk adds in one place may be so many times the tolerance."""
_WIDTHS = (0.7, 1.4, 2.8, 5.6)
"""Standard deviations in cells of the local corrections."""
_STEPS = 40
"""Further steps of the likelihood change the light by less than its noise."""
_TINY = np.finfo(np.float32).tiny


class FoundLight:
    """Light that walks found in cells (rows, columns), by its class, and the sum of its squares."""

    def __init__(self, rows: int, columns: int):
        self.shape = rows, columns
        self._first = 0
        self._light, self._squares = np.zeros((0, rows * columns)), np.zeros(0)
        self._new: list[tuple[np.ndarray, np.ndarray]] = []

    def add(self, cell: np.ndarray, light: np.ndarray) -> None:
        """Add the light (N,), above 0, of walks of flat cells (N,)."""
        self._new.append((cell, light))
        if sum(len(light) for _, light in self._new) > _AT_ONCE:
            self._sort()

    def _sort(self) -> None:
        """Bring what was added to its classes."""
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
        """Classes without gaps, from the faintest on; all those of walks that found less than ``faint`` are one."""
        self._sort()
        if not len(self._squares):
            return []
        first, last = self._first, self._first + len(self._squares) - 1
        joined = first
        while joined < last and 2.0 ** (_CLASS_BITS * (joined + 1)) <= faint:
            joined += 1
        return [range(first, joined + 1), *(range(kind, kind + 1) for kind in range(joined + 1, last + 1))]

    def light(self, kinds: range) -> np.ndarray:
        """Light (rows, columns) of the walks of some classes."""
        found = self._light[self._among(kinds)]
        return (found[0] if len(found) == 1 else found.sum(axis=0)).reshape(self.shape)

    def squares(self, kinds: range) -> float:
        """Sum of the squares of what each of these walks found."""
        return float(self._squares[self._among(kinds)].sum())

    def total(self) -> np.ndarray:
        """Light (rows, columns) of all walks."""
        self._sort()
        return self._light.sum(axis=0).reshape(self.shape)

    def _among(self, kinds: range) -> slice:
        """Places of classes without gaps among those that were found."""
        self._sort()
        return slice(max(kinds.start - self._first, 0), max(kinds.stop - self._first, 0))


@dataclass(frozen=True)
class SmoothLight:
    """Mean light of a walk: in cells (rows, columns), and what its features alone say of it there.

    ``classes`` (K) are those of the walks, ``weights`` (K, J) the features' in each, ``portions`` (K,) the light of a
    walk, in the mean over light.
    """

    cells: np.ndarray
    described: np.ndarray
    classes: list[range]
    weights: np.ndarray
    portions: np.ndarray
    tolerance: float
    noise_share: float

    def at(
        self, rows: np.ndarray, columns: np.ndarray, features: np.ndarray, findings: FoundLight, walks: int
    ) -> np.ndarray:
        """Light (P,) in places at ``rows`` and ``columns`` (P,) of the cells, with features (J, P) of their own.

        ``findings`` are those of ``walks`` in each place; where they are noisy, the features' weights and the cells'
        deviations from them say what the light is.
        """
        ratio = np.divide(self.cells, self.described, out=np.ones_like(self.cells), where=self.described > 0)
        expected = interpolated(ratio, rows, columns) * (self.weights @ features)
        allowed = np.maximum(self.tolerance, self.noise_share * expected.sum(axis=0))
        light = np.zeros_like(allowed)
        for kinds, each, portion in zip(self.classes, expected, self.portions / walks, strict=True):
            light += np.where(_quiet(each, portion, allowed), findings.light(kinds).ravel() / walks, each)
        return light


def estimated(
    findings: FoundLight, walks: np.ndarray, features: np.ndarray, *, tolerance: float, noise_share: float
) -> SmoothLight:
    """Light in cells that were given ``walks`` (rows, columns) each, described by features (J, rows, columns).

    Noise of up to ``tolerance``, or the share ``noise_share`` of the light where that is more, is left.
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
    weights = _weights(light, features, exposure)
    each_described = (weights @ features.reshape(len(features), -1)).reshape(light.shape)
    described = each_described.sum(axis=0)
    allowed = np.maximum(tolerance, noise_share * described)
    cells = np.zeros(total.shape, np.float32)
    for found, expected, portion in zip(light, each_described, portions / mean_walks, strict=True):
        cells += _corrected(found, expected, exposure, portion, allowed)
    # Over all walks, nothing is added or lost.
    cells *= light.sum(dtype=float) / max((exposure * cells).sum(dtype=float), float(_TINY))
    return SmoothLight(cells, described, classes, weights, portions, tolerance, noise_share)


def _corrected(
    found: np.ndarray, expected: np.ndarray, exposure: np.ndarray, portion: float, allowed: np.ndarray
) -> np.ndarray:
    """Light (rows, columns) of one class: what was found as far as that is quiet, else what its features predict.

    ``portion`` is what a walk of the class adds to the light at the exposure 1.
    """
    accepted = _quiet(expected, portion / exposure, allowed)
    estimate = np.where(accepted, found / exposure, expected)
    for width in _WIDTHS:
        if accepted.all():
            break
        nearby = np.maximum(_under_gaussian(exposure * expected, width), _TINY)
        share = expected / nearby
        suffices = ~accepted & _quiet(expected, portion * share / (4 * math.pi * width**2), allowed)
        if suffices.any():
            estimate = np.where(suffices, share * _under_gaussian(found, width), estimate)
            accepted |= suffices
    return estimate


def _quiet(light: np.ndarray, per_walk: np.ndarray, allowed: np.ndarray) -> np.ndarray:
    """Whether light that comes in portions of ``per_walk`` is as quiet as is allowed, and no portion stands out.

    The number of portions scatters as its root, so that the variance of the light is a portion times it.
    """
    return (light * per_walk <= np.square(allowed) / _CLASSES_ADD) & (per_walk <= _PORTION * allowed)


def _weights(light: np.ndarray, features: np.ndarray, exposure: np.ndarray) -> np.ndarray:
    """Weights (K, J) of features (J, rows, columns) that make the light of walks most likely.

    ``light`` (K, rows, columns) is that of all walks, whose number goes as ``exposure`` (rows, columns).
    """
    # Blocks of cells tell the weights as well, as all features are blurred.
    counts, seen = _in_blocks(light), _in_blocks(features * exposure)
    norm = seen.sum(axis=1)
    # The inverse of a smaller number is not finite.
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
    """Improve the weights (J,) by `_STEPS` steps, so that they make the counts of blocks (B,) more likely.

    ``seen`` (B, J) is what the features send to each block, ``back`` each feature's share of itself there. Blocks
    without counts change nothing. Weights below ``least`` (J,), numbers so small that they are slow, become 0. ``gain``
    (J,) and ``found`` (B,) are overwritten.
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


def _in_blocks(cells: np.ndarray) -> np.ndarray:
    """Means (K, B) over blocks of about 2 x 2 cells (K, rows, columns)."""
    rows, columns = cells.shape[1:]
    size = max(1, columns // 2), max(1, rows // 2)
    blocks = [cv2.resize(each, size, interpolation=cv2.INTER_AREA).ravel() for each in cells]
    return np.array(blocks, np.float32).reshape(len(cells), size[0] * size[1])


def interpolated(cells: np.ndarray, rows: np.ndarray, columns: np.ndarray) -> np.ndarray:
    """Cells (rows, columns) linearly between their middles at places (P,)."""
    return map_coordinates(cells, [rows, columns], order=1, mode="nearest")


def blurred(cells: np.ndarray, sigma: float) -> np.ndarray:
    """Cells (rows, columns) under a Gaussian, wide ones in coarser cells."""
    rows, columns = cells.shape
    coarse = cells.astype(np.float32)
    while sigma > 4 and min(coarse.shape) > 8:
        size = coarse.shape[1] // 2, coarse.shape[0] // 2
        coarse, sigma = cv2.resize(coarse, size, interpolation=cv2.INTER_AREA), 0.5 * sigma
    return cv2.resize(_under_gaussian(coarse, sigma), (columns, rows), interpolation=cv2.INTER_LINEAR)


def _under_gaussian(cells: np.ndarray, sigma: float) -> np.ndarray:
    return cv2.GaussianBlur(cells, (0, 0), sigma, borderType=cv2.BORDER_REFLECT)
