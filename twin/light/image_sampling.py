"""Selection of the pixels that are rendered with many samples, and the samples over pixel, pupil and exposure.

Cells of a coarse grid of camera rays locate the stripe. All pixels use one rank-1 lattice of samples. It is evenly
spaced along every axis: a smooth stripe is integrated as by the midpoint rule, without the noise of random samples.
Lattice points are symmetric about the centre, so that few samples per pixel or pupil do not shift the image.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from functools import cache

import cv2
import drjit as dr
import mitsuba as mi
import numpy as np

from twin.backend.arrays import Float, to_jit
from twin.light.camera import CameraView
from twin.light.pose import SensorPose

SAMPLES_AT_ONCE = 2**23  # largest number of samples rendered together; this many take about 100 MB
NODE_SPACING_PX = 2  # spacing of the rays of the coarse grid, and side length of its cells
LIT_SIGMAS = 4.5  # the stripe is rendered up to this many standard deviations of the sheet, to 4e-5 of its peak
_LARGEST_DISC = 24  # up to this radius in cells, dilation by a disc is faster than a distance transform
_CANDIDATES = 64
"""Number of generators tried for each further axis; more candidates improve the lattice by a few percent only."""


def golden_step(count: int) -> int:
    """Return the second generator of a lattice: the coprime number nearest to the golden section of ``count``."""
    golden = count * 0.5 * (math.sqrt(5.0) - 1.0)
    return min((k for k in range(1, count + 1) if math.gcd(k, count) == 1), key=lambda k: abs(k - golden))


@cache
def make_lattice(count: int, axes: int) -> np.ndarray:
    """Return a rank-1 lattice (axes, count) in the unit cube, each point centred in its interval along every axis.

    The first two generators are 1 and the golden step. Each further generator minimises the worst-case error of the
    lattice so far (component by component). The error for periodic functions with mixed second derivatives is the mean
    of prod (1 + 2 pi^2 B2(x)) with B2(x) = x^2 - x + 1/6 (Sloan and Joe 1994, Eq. 4.8; Nuyens and Cools 2006).
    """
    index = np.arange(count, dtype=np.int64)
    steps = [1, golden_step(count)][:axes]
    # A step and its negative give the same points in reverse order.
    coprime = [k for k in range(1, count // 2 + 1) if math.gcd(k, count) == 1] or [1]
    spread = np.linspace(0, len(coprime) - 1, min(_CANDIDATES, len(coprime))).astype(int)
    merit = np.prod([_evaluate_kernel(index * step % count / count) for step in steps], axis=0)
    while len(steps) < axes:
        taken = {min(step, count - step) for step in steps}
        free = [coprime[k] for k in spread if coprime[k] not in taken] or coprime
        steps.append(min(free, key=lambda k: merit @ _evaluate_kernel(index * k % count / count)))
        merit = merit * _evaluate_kernel(index * steps[-1] % count / count)
    # An offset of half a step makes the lattice symmetric about the cube's centre. Steps must be odd: half an even step
    # would move points to the edges of their intervals. If the count is odd, either the step or its negative is odd.
    odd = [step if step % 2 else count - step for step in steps]
    return np.stack([(index + 0.5) * step / count % 1 for step in odd])


def pupil_shifts(rows: np.ndarray, columns: np.ndarray) -> np.ndarray:
    """Return cyclic shifts (2, P), from 0 to 1, of the pupil samples for pixels (P,).

    Few samples per pixel turn a blurred edge into steps. Different pupil samples in neighbouring pixels break these
    steps up. The 16 pixels of a 4 x 4 block use 8 evenly spread shifts (the R2 sequence, Roberts 2018) and their
    negatives. The shifts are thus symmetric about the pupil's centre and do not shift the image of the block.
    """
    order = np.array([[0, 8, 2, 10], [12, 4, 14, 6], [3, 11, 1, 9], [15, 7, 13, 5]])
    shift = (order % 8 + 0.5) * np.array([0.7548776662466927, 0.5698402909980532])[:, None, None] % 1
    return np.where(order < 8, shift, 1 - shift)[:, rows & 3, columns & 3]


def _evaluate_kernel(x: np.ndarray) -> np.ndarray:
    return 1 + 2 * math.pi**2 * (x * x - x + 1 / 6)


def combine_corners(combine: np.ufunc, nodes: np.ndarray) -> np.ndarray:
    """Combine the four corners of every cell (rows - 1, columns - 1) with a binary ufunc such as `numpy.maximum`."""
    beside = combine(nodes[:, :-1], nodes[:, 1:])
    return combine(beside[:-1], beside[1:])


def find_marked(marked: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return rows and columns of the nonzero pixels of an image (H, W); faster than `numpy.nonzero` if they are few."""
    row, column = np.divmod(np.flatnonzero(marked), marked.shape[1])
    return row, column


def expand_cells(cells: np.ndarray, height: int, width: int) -> np.ndarray:
    """Expand cell values of the coarse grid to pixels (H, W); faster than `numpy.repeat`."""
    side = NODE_SPACING_PX
    full = np.empty((cells.shape[0], side, cells.shape[1], side), cells.dtype)
    for k in range(side):
        full[:, 0, :, k] = cells
    full[:, 1:] = full[:, :1]
    return np.ascontiguousarray(full.reshape(side * cells.shape[0], -1)[:height, :width])


def mark_near_sheet(across: np.ndarray, reached: np.ndarray | bool = True) -> np.ndarray:
    """Return the mask of cells near the sheet: a corner within `LIT_SIGMAS` of its centre, or corners on both sides.

    ``across`` is the distance of the nodes from the sheet's centre in standard deviations, infinite if there is no
    surface. Cells without any corner in the mask ``reached`` are excluded.
    """
    seen = np.isfinite(across)
    close, before, behind, there = (
        combine_corners(np.logical_or, np.broadcast_to(nodes, across.shape))
        for nodes in (np.abs(across) < LIT_SIGMAS, seen & (across < 0), seen & (across > 0), reached)
    )
    return there & (close | before & behind)


def dilate_cells(cells: np.ndarray, radius_px: np.ndarray, *, cell_px: int = NODE_SPACING_PX) -> np.ndarray:
    """Dilate each marked cell by its own radius in px; radii are rounded up to one of eight levels."""
    marked = np.flatnonzero(cells)
    radius = radius_px.ravel()[marked] / cell_px
    step = max(1.0, float(radius.max(initial=0)) / 8)
    level = np.ceil(radius / step).astype(int)
    wide = cells.copy()
    for k in (1 + np.flatnonzero(np.bincount(level)[1:])).tolist():
        of_level = np.zeros(cells.shape, np.uint8)
        of_level.ravel()[marked[level == k]] = 1
        wide |= _dilate(of_level, k * step)
    return wide


def _dilate(marked: np.ndarray, radius: float) -> np.ndarray:
    """Return the mask of cells within a radius in cells of the nonzero cells of ``marked`` (uint8)."""
    if radius > _LARGEST_DISC:
        return cv2.distanceTransform(1 - marked, cv2.DIST_L2, cv2.DIST_MASK_PRECISE) <= radius
    offsets = np.arange(-int(radius), int(radius) + 1)
    disc = np.square(offsets)[:, None] + np.square(offsets) <= radius**2
    return cv2.dilate(marked, disc.view(np.uint8)) > 0


@dataclass(frozen=True, eq=False)
class PixelSampler:
    """Rendering of pixels by samples over pixel, exposure and, with ``defocus``, the pupil."""

    view: CameraView
    defocus: bool

    def render(
        self,
        light: Callable[..., tuple[Float, ...]],
        pose: SensorPose,
        rows: np.ndarray,
        columns: np.ndarray,
        *rest: object,
        spp: int,
        shifted: bool = False,
    ) -> Callable[[], np.ndarray]:
        """Render pixels; return a function that fetches the means (K, P) of ``light`` over pixel, pupil and exposure.

        Rendering is asynchronous. ``shifted`` uses different pupil samples in neighbouring pixels, so that a blurred
        edge shows no steps.
        """
        index = dr.arange(mi.UInt32, len(rows) * spp)
        per_pixel = dr.opaque(mi.UInt32, spp)
        pixel = index // per_pixel
        sample = index - pixel * per_pixel
        # Adjacent values are read together, which is much faster.
        axes = make_lattice(spp, 2 + 2 * self.defocus + (pose.travel is not None))
        places = np.zeros((spp, 4))
        places[:, : 2 + 2 * self.defocus] = axes[: 2 + 2 * self.defocus].T
        across, down, u, v = dr.gather(mi.Vector4f, to_jit(places), sample)
        x, y = dr.gather(mi.Point2f, to_jit(np.stack([columns, rows], axis=1)), pixel)
        pupil = None
        if self.defocus:
            if shifted:
                shift_u, shift_v = dr.gather(mi.Point2f, to_jit(pupil_shifts(rows, columns).T), pixel)
                u, v = u + shift_u, v + shift_v
                u, v = u - dr.floor(u), v - dr.floor(v)
            pupil = mi.warp.square_to_uniform_disk_concentric(mi.Point2f(u, v))
        after_s = None
        if pose.travel is not None:
            after_s = pose.travel.compute_times(y, dr.gather(mi.Float, to_jit(axes[-1]), sample))
        bundle = self.view.trace_bundle(x + across - 0.5, y + down - 0.5, pupil)
        values = light(pose, bundle, after_s, pixel, *rest)
        dr.eval(values)  # together: separate sums would trace the rays again
        sums = [dr.block_sum(value, spp) for value in values]
        dr.eval(sums)
        return lambda: np.stack([each.numpy() / spp for each in sums])

    def blur_px(self, marked: np.ndarray, depth_mm: np.ndarray) -> np.ndarray:
        """Return the largest blur in px at the corners of marked cells, 0 elsewhere, from the depths at all nodes."""
        row, column = find_marked(marked)
        corners = np.stack([depth_mm[row + down, column + right] for down, right in np.ndindex(2, 2)])
        blur = np.zeros(marked.shape, np.float32)
        blur[row, column] = np.fmax(np.fmax.reduce(self.view.blur_radius_px(corners)), 0)
        return blur


def split_pixels(rows: np.ndarray, columns: np.ndarray, *, spp: int) -> Iterator[tuple[np.ndarray, np.ndarray]]:
    """Yield pixels in parts of at most `SAMPLES_AT_ONCE` samples."""
    if len(rows):
        count = -(-len(rows) * spp // SAMPLES_AT_ONCE)
        yield from zip(np.array_split(rows, count), np.array_split(columns, count), strict=True)
