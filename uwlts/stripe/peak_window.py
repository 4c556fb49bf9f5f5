"""Windows about the peaks of profile lines: height, width and background of what stands in each."""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import lru_cache

import cv2
import numpy as np

from uwlts.stripe.candidates import count_true, first_true, last_true

FWHM_PER_SIGMA = 2.0 * math.sqrt(2.0 * math.log(2.0))
"""Full width at half maximum of a Gaussian over its standard deviation."""

LEAST_KERNEL = 1.0
"""Sigma of the narrowest weight, px. A narrower one rests on too few pixels: for a stripe of sigma 0.7 px the centre
would err by 0.015 px with the pixel phase instead of 0.005."""

FLANK = 5
"""Pixels of background taken on either side of a peak."""

_ONE = np.ones(1, np.float32)
_INWARD = np.array([[1], [-1]])
_INWARD_F = _INWARD.astype(np.float32)
_FLANK_FROM = np.array([[1 - FLANK], [-1]], np.float32)
"""First pixel of the flank on either side, counted from `reach` outside the middle."""


@dataclass(frozen=True)
class PeakWindow:
    """Peaks in M windows of W pixels. Positions count from the window's first pixel; px and grey levels.

    ``start`` (M,) int is the first pixel's position on its line, ``window`` (W, M) the pixels in the image's type, with
    the border pixel repeated beyond the border, ``smooth`` (W, M) float32 the window after the low-pass. All others are
    (M,): ``middle`` of the half-height crossings; ``sigma``, the half-height width over 2.355 with the low-pass taken
    out (variances add); ``reach``, the whole number of pixels from ``middle`` to the first background pixel; background
    ``base`` at ``middle`` and its ``slope`` per px, from the flanks beyond ``reach``; ``height`` of the peak of
    ``smooth`` above ``base``, or above the lowest surroundings where not ``closed``: both half-height crossings lie in
    the window; ``crowded`` where something outside the crossings reaches the given share of the peak again.
    """

    start: np.ndarray
    window: np.ndarray
    smooth: np.ndarray
    middle: np.ndarray
    sigma: np.ndarray
    reach: np.ndarray
    base: np.ndarray
    slope: np.ndarray
    height: np.ndarray
    closed: np.ndarray
    crowded: np.ndarray

    def keep(self, which: np.ndarray) -> PeakWindow:
        """The windows chosen by a boolean mask."""
        return PeakWindow(*(value[..., which] for value in vars(self).values()))

    def replaced(self, which: np.ndarray, by: PeakWindow) -> PeakWindow:
        """These windows with those chosen by a boolean mask taken from another `PeakWindow`."""
        values = []
        for own, other in zip(vars(self).values(), vars(by).values(), strict=True):
            value = own.copy()
            value[..., which] = other
            values.append(value)
        return PeakWindow(*values)


def measure_windows(
    profiles: np.ndarray,
    lines: np.ndarray,
    place: np.ndarray,
    *,
    half: int,
    block: int,
    smoothing: float,
    share: float,
    whole: bool,
) -> PeakWindow:
    """Measure what stands at or near the `block` pixels that begin at `place` (M,) on `lines` (M,) of profiles (N, L).

    The window is the block and `half` pixels on either side; it may run over the image border. The peak is sought in
    the block and half a block on either side. `smoothing` is the sigma of the low-pass, px. A second peak of `share` of
    the first one's height makes the window crowded; it is looked for in the `whole` window, else only as far as the
    pixels used reach.
    """
    size = 2 * half + block
    start = place - half
    window = _cut(profiles, lines, start, size)
    smooth = cv2.sepFilter2D(window, cv2.CV_32F, _ONE, _kernel(smoothing), borderType=cv2.BORDER_REPLICATE)
    columns, row = np.arange(lines.size), np.arange(size)[:, None]

    peak = smooth[_sought(half, block)].max(axis=0)
    before, after = smooth[:block].min(axis=0), smooth[-block:].min(axis=0)
    # Repeated border pixels may belong to the stripe itself, so that only the other side shows the background.
    if start.min() < 0:
        before[start < 0] = -np.inf
    if start.max() + size > profiles.shape[0]:
        after[start + size > profiles.shape[0]] = -np.inf
    ground = np.maximum(before, after)
    level = 0.5 * (peak + ground)

    high = smooth >= level
    edges = np.array([first_true(high) - 1, last_true(high) + 1])
    crowded = count_true(high) != edges[1] - edges[0] - 1
    several = np.flatnonzero(crowded)
    crowd = smooth.take(several, axis=1)
    if several.size:
        below, at = ~high.take(several, axis=1), peak_row(crowd, half=half, block=block)
        edges[:, several] = last_true(below & (row < at)), first_true(below & (row > at))
    closed = (edges[0] >= 0) & (edges[1] < size)
    x_left, x_right = _crossings(smooth, columns, edges, level)
    middle = 0.5 * (x_left + x_right)
    smooth_sigma = (x_right - x_left) * (1.0 / FWHM_PER_SIGMA)
    sigma = np.sqrt(np.maximum(smooth_sigma * smooth_sigma - np.float32(smoothing * smoothing), 0.0))

    reach = np.minimum(np.ceil(3.0 * smooth_sigma), np.float32(half - FLANK))
    near = np.rint(middle)
    # The lower of two low-passed values three pixels apart, so that a hot pixel in the flank does not raise it.
    first = np.minimum(np.maximum(near - _INWARD_F * reach + _FLANK_FROM, 0.0), size - FLANK)
    index = first.astype(np.intp) * lines.size + columns
    ends = (smooth.take(index + pixel * lines.size, mode="clip") for pixel in (1, FLANK - 1))
    before, after = np.minimum(*ends)
    if several.size:
        extent = size if whole else (reach + (FLANK - 1))[several]
        outside = (row <= edges[0, several]) | (row >= edges[1, several])
        again = crowd >= (ground + share * (peak - ground))[several]
        crowded[several] = (again & outside & (np.abs(row - near[several]) <= extent)).any(axis=0)
    slope = (after - before) / (2.0 * reach + (FLANK - 2))
    base = 0.5 * (before + after) + slope * (middle - near)
    height = peak - np.where(closed, base, ground)
    return PeakWindow(start, window, smooth, middle, sigma, reach, base, slope, height, closed, crowded)


def peak_row(smooth: np.ndarray, *, half: int, block: int) -> np.ndarray:
    """(M,) int: row of the highest pixel of `PeakWindow.smooth`, sought where `measure_windows` seeks it."""
    rows = _sought(half, block)
    sought = smooth[rows]
    return rows.start + first_true(sought == sought.max(axis=0))


def _sought(half: int, block: int) -> slice:
    """Rows of a window in which the peak is sought."""
    first = half - block // 2
    return slice(first, first + 2 * block)


def _cut(profiles: np.ndarray, lines: np.ndarray, start: np.ndarray, size: int) -> np.ndarray:
    """(size, M) array of the profiles' type: windows from them, the border pixel repeated beyond the border."""
    # Relative maps: row r of the window is r pixels after its start, column m is line m plus the difference.
    down = np.repeat(start.astype(np.float32)[None], size, axis=0)
    right = np.zeros(down.shape, np.float32)
    if lines.size < profiles.shape[1]:
        right += (lines - np.arange(lines.size)).astype(np.float32)
    nearest = cv2.INTER_NEAREST | cv2.WARP_RELATIVE_MAP
    return cv2.remap(profiles, right, down, nearest, borderMode=cv2.BORDER_REPLICATE)


@lru_cache(maxsize=16)
def _kernel(sigma: float) -> np.ndarray:
    """Gaussian weights to 3.5 sigma, sum 1."""
    reach = math.ceil(3.5 * sigma)
    weight = np.exp(-0.5 * (np.arange(-reach, reach + 1) / sigma) ** 2)
    return (weight / weight.sum()).astype(np.float32)


@lru_cache(maxsize=16)
def noise_gain(sigma: float) -> float:
    """Standard deviation of white unit noise after the low-pass."""
    return float(np.sqrt(np.sum(_kernel(sigma) ** 2)))


def _crossings(smooth: np.ndarray, columns: np.ndarray, rows: np.ndarray, level: np.ndarray) -> np.ndarray:
    """(2, M) float32: where the straight lines from two rows below `level` to their inner neighbours meet it.

    A row just outside the window stands for no crossing and gives a place less than a pixel further in.
    """
    width = smooth.shape[1]
    index = rows * width + columns
    low = smooth.take(index, mode="clip")
    rise = smooth.take(index + width * _INWARD, mode="clip") - low
    part = (level - low) / np.maximum(rise, 1e-6)
    part = np.minimum(np.maximum(part, 0.0), 1.0)
    return rows.astype(np.float32) + _INWARD_F * part


def gaussian_moments(peak: PeakWindow, centre: np.ndarray, sigma: np.ndarray, highest: int) -> list[np.ndarray]:
    """M0 ... Mk of the profile above `peak.base` under the Gaussian weight at `centre`; see `zero_crossing`."""
    # Rows beyond the weight of every window, less than 0.003 there, are left out.
    size = peak.window.shape[0]
    reach = 3.5 * float(sigma.max())
    rows = slice(max(0, math.floor(float(centre.min()) - reach)), min(size, math.ceil(float(centre.max()) + reach) + 1))
    t = np.arange(rows.start, rows.stop, dtype=np.float32)[:, None] - centre
    t *= 1.0 / sigma
    # OpenCV's exponential is several times as fast as NumPy's.
    weighted = cv2.exp(cv2.multiply(t, t, scale=-0.5))
    weighted *= peak.window[rows] - peak.base
    moments = [cv2.reduce(weighted, 0, cv2.REDUCE_SUM)[0]]
    for _ in range(highest):
        weighted *= t
        moments.append(cv2.reduce(weighted, 0, cv2.REDUCE_SUM)[0])
    return moments


def above_background(peak: PeakWindow, values: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """(W, 1) row numbers and (W, M) values above the line through the two flanks."""
    x = np.arange(values.shape[0], dtype=np.float32)[:, None]
    return x, values - (peak.base + peak.slope * (x - peak.middle))


def part_inside(u: np.ndarray, half: np.ndarray) -> np.ndarray:
    """Share of each pixel, u from the centre, that lies within `half` of it."""
    return np.clip(half + 0.5 - np.abs(u), 0.0, 1.0)
