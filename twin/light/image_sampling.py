"""Choice of the pixels that are rendered finely, and of the samples over pixel, pupil and exposure.

Cells of a coarse grid of camera rays show where the stripe is. All pixels share one rank-1 lattice of samples: it is
evenly spaced along every axis, so that a smooth stripe is integrated as by the midpoint rule, without the noise of
random samples. Its points come in pairs about the middle, so that neither the pixel's nor the pupil's few samples shift
what they see.
"""

import math
from functools import cache

import cv2
import numpy as np

NODE_SPACING_PX = 2
"""Pixels from one ray of the coarse grid to the next, and side of its cells."""
LIT_SIGMAS = 4.5
"""The stripe is rendered up to this many standard deviations of the sheet: 4e-5 of its peak."""
_LARGEST_DISC = 24
"""Radius in cells up to which dilation by a disc is faster than a map of distances."""
_CANDIDATES = 64
"""Number of generators tried for every further axis; more improve the lattice by a few percent."""


def golden_step(count: int) -> int:
    """Second generator of a lattice of ``count`` points: the coprime number nearest to its golden section."""
    golden = count * 0.5 * (math.sqrt(5.0) - 1.0)
    return min((k for k in range(1, count + 1) if math.gcd(k, count) == 1), key=lambda k: abs(k - golden))


@cache
def lattice(count: int, axes: int) -> np.ndarray:
    """Points (axes, count) in the unit cube, in the middle of their strips along every axis.

    The first two generators are 1 and the golden step; each further one is the candidate with the least worst-case
    error of periodic functions with mixed second derivatives together with those before it: component by component,
    the mean of prod (1 + 2 pi^2 B2(x)) with B2(x) = x^2 - x + 1/6 (Sloan and Joe 1994, Eq. 4.8; Nuyens and Cools 2006).
    """
    index = np.arange(count, dtype=np.int64)
    steps = [1, golden_step(count)][:axes]
    # A step and its negative place the same points in mirrored order.
    coprime = [k for k in range(1, count // 2 + 1) if math.gcd(k, count) == 1] or [1]
    spread = np.linspace(0, len(coprime) - 1, min(_CANDIDATES, len(coprime))).astype(int)
    merit = np.prod([_kernel(index * step % count / count) for step in steps], axis=0)
    while len(steps) < axes:
        taken = {min(step, count - step) for step in steps}
        free = [coprime[k] for k in spread if coprime[k] not in taken] or coprime
        steps.append(min(free, key=lambda k: merit @ _kernel(index * k % count / count)))
        merit = merit * _kernel(index * steps[-1] % count / count)
    # Counted from half a step on, every point has its mirror image about the cube's middle among the others. Half an
    # even step would lead to the strips' edges; of an odd count, the step or its negative is odd.
    odd = [step if step % 2 else count - step for step in steps]
    return np.stack([(index + 0.5) * step / count % 1 for step in odd])


def pupil_shifts(rows: np.ndarray, columns: np.ndarray) -> np.ndarray:
    """Cyclic shifts (2, P), from 0 to 1, of the points on the pupil in pixels (P,).

    The few points of a pixel turn a blurred edge into steps; where they lie elsewhere in neighbouring pixels, the steps
    do too. The 16 pixels of a block 4 px square take 8 evenly spread shifts (the R2 sequence, Roberts 2018) and their
    negatives, whose points are mirrored about the pupil's middle: the block as a whole does not shift what it sees.
    """
    return _block_shifts()[:, rows & 3, columns & 3]


@cache
def _block_shifts() -> np.ndarray:
    """Shifts (2, 4, 4) of a block's pixels."""
    order = np.array([[0, 8, 2, 10], [12, 4, 14, 6], [3, 11, 1, 9], [15, 7, 13, 5]])
    shift = (order % 8 + 0.5) * np.array([0.7548776662466927, 0.5698402909980532])[:, None, None] % 1
    return np.where(order < 8, shift, 1 - shift)


def _kernel(x: np.ndarray) -> np.ndarray:
    return 1 + 2 * math.pi**2 * (x * x - x + 1 / 6)


def over_corners(combine: np.ufunc, nodes: np.ndarray) -> np.ndarray:
    """Four corners of every cell (rows - 1, columns - 1) combined by a ufunc of two arrays, such as `numpy.maximum`."""
    beside = combine(nodes[:, :-1], nodes[:, 1:])
    return combine(beside[:-1], beside[1:])


def places(marked: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Rows and columns of what is marked in an image (H, W), faster than by `numpy.nonzero` where little is."""
    row, column = np.divmod(np.flatnonzero(marked), marked.shape[1])
    return row, column


def repeated(cells: np.ndarray, height: int, width: int) -> np.ndarray:
    """Values of the coarse grid's cells given to their pixels (H, W), faster than by `numpy.repeat`."""
    side = NODE_SPACING_PX
    full = np.empty((cells.shape[0], side, cells.shape[1], side), cells.dtype)
    for k in range(side):
        full[:, 0, :, k] = cells
    full[:, 1:] = full[:, :1]
    return np.ascontiguousarray(full.reshape(side * cells.shape[0], -1)[:height, :width])


def near_sheet(across: np.ndarray, reached: np.ndarray | bool = True) -> np.ndarray:
    """Cells with a corner within `LIT_SIGMAS` of the sheet's middle, or between whose corners it passes.

    ``across`` is the sheet's distance at the nodes in standard deviations, infinity where there is no surface; cells
    without a corner that the sheet has ``reached`` are left out.
    """
    seen = np.isfinite(across)
    close, before, behind, there = (
        over_corners(np.logical_or, np.broadcast_to(nodes, across.shape))
        for nodes in (np.abs(across) < LIT_SIGMAS, seen & (across < 0), seen & (across > 0), reached)
    )
    return there & (close | before & behind)


def widened(cells: np.ndarray, radius_px: np.ndarray, *, cell_px: int = NODE_SPACING_PX) -> np.ndarray:
    """Marked cells and all within each one's radius in px; radii are rounded up to one of eight."""
    marked = np.flatnonzero(cells)
    radius = radius_px.ravel()[marked] / cell_px
    step = max(1.0, float(radius.max(initial=0)) / 8)
    level = np.ceil(radius / step).astype(int)
    wide = cells.copy()
    for k in np.unique(level[level > 0]).tolist():
        of_level = np.zeros(cells.shape, np.uint8)
        of_level.ravel()[marked[level == k]] = 1
        wide |= _within(of_level, k * step)
    return wide


def _within(marked: np.ndarray, radius: float) -> np.ndarray:
    """Cells whose distance from the next one that is 1 in ``marked``, uint8, is no larger than a radius in cells."""
    if radius > _LARGEST_DISC:
        return cv2.distanceTransform(1 - marked, cv2.DIST_L2, cv2.DIST_MASK_PRECISE) <= radius
    away = np.arange(-int(radius), int(radius) + 1)
    disc = np.square(away)[:, None] + np.square(away) <= radius**2
    return cv2.dilate(marked, disc.view(np.uint8)) > 0
