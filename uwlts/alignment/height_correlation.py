"""Shifts between two surfaces by the correlation of their maps of heights, with gaps, for all shifts at once."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.fft import irfft2, rfft2
from scipy.fft import next_fast_len
from scipy.ndimage import gaussian_filter, maximum_filter

_SMOOTH = 1.0
_COARSE = 12.0
"""Pixels: structures between these two sizes are compared; slopes, by which a path may be tilted, are not."""
_LEAST_OVERLAP = 0.06
"""Of the smaller map."""
_ALIKE = 0.35
"""Correlation of surfaces that may be one: noise, tilts and gaps lower it."""
_PROPOSALS = 4
_APART = 7
"""Pixels between two proposals."""


def shifts_of_heights(
    source_mm: np.ndarray, target_mm: np.ndarray, *, pixel_mm: float, reach_mm: np.ndarray
) -> list[np.ndarray]:
    """The likeliest shifts (3,) of points (N, 3) onto others (M, 3), both with heights along z, the best first.

    Shifts are within ``reach_mm`` (3,). The correlation is normalised within the overlap (Padfield, IEEE Transactions
    on Image Processing 21, 2012) and counts by the root of its area.
    """
    low = np.minimum(source_mm[:, :2].min(axis=0), target_mm[:, :2].min(axis=0))
    maps = [_height_map(points, low, pixel_mm) for points in (source_mm, target_mm)]
    sizes: list[Any] = [
        next_fast_len(a + b - 1, real=True) for a, b in zip(maps[0][0].shape, maps[1][0].shape, strict=True)
    ]
    (f, m), (g, k) = (
        [rfft2(each, sizes) for each in (h * w, w)] for h, w in ((d, w) for _, d, w in _with_detail(maps))
    )
    squares = [rfft2(d * d * w, sizes) for _, d, w in _with_detail(maps)]

    def correlated(second: np.ndarray, first: np.ndarray) -> np.ndarray:
        return irfft2(second * np.conj(first), sizes)

    count = np.maximum(np.rint(correlated(k, m)), 1e-9)
    of_target, of_source = correlated(g, m), correlated(k, f)
    both = correlated(g, f) - of_target * of_source / count
    spread = (correlated(squares[1], m) - of_target**2 / count) * (correlated(k, squares[0]) - of_source**2 / count)
    least = _LEAST_OVERLAP * min(each[1].sum() for each in maps)
    usual = max(float(np.median(spread[count > least])), 0.0) if (count > least).any() else 0.0
    good = (count > max(least, 30)) & (spread > 1e-3 * usual)
    with np.errstate(invalid="ignore", divide="ignore"):
        alike = np.where(good, both / np.sqrt(spread), 0.0)
        score = np.where(alike > _ALIKE, alike * np.sqrt(count), -np.inf)
    steps = [np.where(np.arange(n) > n // 2, np.arange(n) - n, np.arange(n)) for n in sizes]
    for axis, each in enumerate(steps):
        outside = np.abs(each * pixel_mm) > reach_mm[axis] + pixel_mm
        score[outside if axis == 0 else (slice(None), outside)] = -np.inf
    peaks = np.argwhere((score == maximum_filter(score, _APART, mode="wrap")) & np.isfinite(score))
    order = np.argsort(-score[tuple(peaks.T)])[:_PROPOSALS]
    found = []
    for row, column in peaks[order]:
        shift = np.array([steps[0][row], steps[1][column]], dtype=float) * pixel_mm
        along = _offset(maps, steps[0][row], steps[1][column])
        if along is not None and abs(along) <= reach_mm[2] + pixel_mm:
            found.append(np.append(shift, along))
    return found


def _height_map(points: np.ndarray, low: np.ndarray, pixel: float) -> tuple[np.ndarray, np.ndarray]:
    """Mean heights (H, W), and a mask (H, W) of 1 where there are points."""
    cells = np.floor((points[:, :2] - low) / pixel).astype(np.int64)
    shape = tuple(cells.max(axis=0) + 1)
    flat = np.ravel_multi_index(tuple(cells.T), shape)
    count = np.bincount(flat, minlength=shape[0] * shape[1]).reshape(shape)
    total = np.bincount(flat, points[:, 2], shape[0] * shape[1]).reshape(shape)
    return total / np.maximum(count, 1), (count > 0).astype(float)


def _with_detail(maps: list[tuple[np.ndarray, np.ndarray]]) -> list[tuple[np.ndarray, np.ndarray, np.ndarray]]:
    """Heights, their structures of the compared sizes, and masks."""
    result = []
    for height, mask in maps:
        smooth, coarse = (
            gaussian_filter(height * mask, size) / np.maximum(gaussian_filter(mask, size), 1e-3)
            for size in (_SMOOTH, _COARSE)
        )
        result.append((height, smooth - coarse, mask))
    return result


def _offset(maps: list[tuple[np.ndarray, np.ndarray]], rows: int, columns: int) -> float | None:
    """Median height of the target above the source where both are known after a shift of the source."""
    (source, own), (target, other) = maps
    i, j = np.nonzero(own)
    p, q = i + rows, j + columns
    inside = (p >= 0) & (q >= 0) & (p < target.shape[0]) & (q < target.shape[1])
    i, j, p, q = i[inside], j[inside], p[inside], q[inside]
    seen = other[p, q] > 0
    return float(np.median(target[p, q][seen] - source[i, j][seen])) if seen.any() else None
