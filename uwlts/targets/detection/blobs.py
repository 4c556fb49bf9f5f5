"""Closed bright or dark blobs of an unevenly lit image, as candidates for the images of circles."""

from dataclasses import dataclass
from statistics import NormalDist

import cv2
import numpy as np

from uwlts.errors import ImageError
from uwlts.runtime.compiled import compiled, compiled_part

BLOCK_PX = 4
"""Side of the blocks whose means give local grey levels, interpolated linearly between their middles; `_widen` has the
weights for this side."""


class _Rule:
    """Numbers of the search for blobs.

    Chosen by hand with the reasons below, not fitted to data. Results with these numbers are checked on the drawn
    plates of tests/uwlts/targets and on real photographs (tests/system/test_real_images.py).
    """

    windows_px: tuple[int, ...] = (32, 128, 512)
    """Sides of the square window for the two local grey levels, px. A window serves blobs from a tenth to three
    quarters of its side, so that factors of four cover 4 to 380 px with overlap."""
    least_area_px: float = 10.0
    """Least area of a blob, px^2: the shape of smaller blobs is unknown (a disc of 4 px diameter covers 12.6 px^2)."""
    contrast_over_noise: float = 3.0
    """Least contrast in standard deviations of the noise. Noise after the median filter, which more than halves it,
    gives a contrast of 0.7."""
    contrast_over_range: float = 0.04
    """Least contrast as a fraction of the image's grey range; less is dirt or compression noise."""
    smooth_share: float = 0.2
    """Fraction of the pixels that determine the noise: even a fine pattern leaves them without an edge."""
    ellipse_departure: float = 0.12
    """Largest difference of a blob's area from that of the ellipse with its moments, as a fraction. Rectangles, at
    0.05, pass; the fit to the edge rejects them."""
    size_range: float = 1.6
    """Largest ratio of radii in a family after the first one: an inclined plate shows its far circles smaller. Of 1.25,
    1.4, 1.6 and 2.0, chosen on 40 drawn plates among specks and judged on 40 others; all but 1.25 do about the same."""
    fewest: int = 4  # fewest blobs of such a family: one cell of a lattice
    most_families: int = 12  # most families after the first one; each costs about as much as the first


@dataclass(frozen=True)
class Blobs:
    """Blobs of one polarity, each with the ellipse that has the blob's moments."""

    centres: np.ndarray  # (N, 2) float64, px, (u, v)
    shapes: np.ndarray  # (N, 2, 2) float64, px, symmetric positive; ``centre + shape @ (cos t, sin t)`` is the ellipse
    bright: bool  # True if the blobs are brighter than their surroundings

    def __len__(self):
        return len(self.centres)

    def __getitem__(self, chosen):
        return Blobs(self.centres[chosen], self.shapes[chosen], self.bright)

    @property
    def radii(self):
        """Geometric means (N,) of the semi-axes, px."""
        return np.sqrt(np.linalg.det(self.shapes))


def check_grey(image):
    """Return the image (H, W) as a read-only array; raise `ImageError` unless it is uint8 or uint16."""
    if not isinstance(image, np.ndarray):
        raise ImageError(f"the image is a {type(image).__name__}; expected a NumPy array (H, W) of uint8 or uint16")
    if image.ndim != 2 or image.dtype not in (np.uint8, np.uint16) or min(image.shape) < 16:
        size = " x ".join(map(str, image.shape[1::-1]))
        raise ImageError(
            f"the image has {size} pixels, {image.ndim} dimensions and the type {image.dtype}; expected one grey "
            "channel (H, W) of uint8 or uint16, at least 16 x 16: convert colour images first"
        )
    # Compiled code is specialised for writable and for read-only arrays: make all read-only.
    grey = np.ascontiguousarray(image).view()
    grey.flags.writeable = False
    return grey


def estimate_noise(image):
    """Estimate the standard deviation of the pixel noise of an image (H, W), in grey levels.

    The mask of Immerkaer (Fast noise variance estimation, CVIU 64, 1996, eq. 2) cancels linear shading and has norm 6.
    The lower fifth of its responses is used instead of their mean, because a fine pattern has edges in most
    neighbourhoods.
    """
    # One row in four is sufficient for a quantile.
    across = image[:-2:4].astype(np.int32) - 2 * image[1:-1:4].astype(np.int32) + image[2::4]
    counts = np.bincount(np.abs(np.diff(across, 2, axis=1)).ravel())
    lower_part = np.searchsorted(np.cumsum(counts), _Rule.smooth_share * counts.sum())
    return float(lower_part) / (6 * NormalDist().inv_cdf(0.5 + _Rule.smooth_share / 2))


def find_blobs(image, noise):
    """Yield families of elliptic blobs: first the largest of any polarity and size, then all others by their number.

    Each window side in `_Rule.windows_px` gives a threshold halfway between the mean levels of the local bright and
    dark pixels. It is one local step of Ridler and Calvard's iteration per pass, and removes uneven lighting. Only
    outer contours are used, which fills holes. Blobs at the image border and small blobs are removed.

    The first family contains all blobs of its window and polarity; of equally many, the smaller blobs, because the
    bright region around each dark circle is also a blob. Other families are similar in size (`_Rule.size_range`).

    ``noise`` is the standard deviation of a pixel of the image (H, W). The first family may be empty.
    """
    best, best_score = Blobs(np.empty((0, 2)), np.empty((0, 2, 2)), True), (0, 0.0)
    for bright, mask in _make_local_masks(image, noise):
        blobs = _select_ellipses(mask, bright=bright, fewest=best_score[0])
        radii = blobs.radii
        first, last = _find_family(radii, 2.0)
        score = last - first, -float(np.median(radii)) if len(radii) else 0.0
        if score > best_score:
            best, best_score = blobs, score
    yield best
    families = []
    for bright, mask in _make_local_masks(image, noise):
        blobs = _select_ellipses(mask, bright=bright)
        blobs = blobs[np.argsort(blobs.radii)]
        while len(blobs) >= _Rule.fewest:
            first, last = _find_family(blobs.radii, _Rule.size_range)
            families.append(blobs[first:last])
            blobs = blobs[np.delete(np.arange(len(blobs)), slice(first, last))]
    yield from sorted(families, key=len, reverse=True)[: _Rule.most_families]


def _make_local_masks(image, noise):
    """Yield the polarity (True: bright) and mask (H, W) of pixels beyond each window's local threshold.

    A mask is valid until the next one is asked for.
    """
    low, high = np.quantile(image[::4, ::4], (0.001, 0.999))
    floor = max(_Rule.contrast_over_noise * noise, _Rule.contrast_over_range * (high - low))
    smooth = cv2.medianBlur(image, 3)
    # All pixels are above -1.
    _, mean = _average_above(smooth, np.full([-(-size // BLOCK_PX) for size in smooth.shape], -1, np.float32))
    sides, wide = np.empty((2, *smooth.shape), np.uint8), np.empty((2, 2, BLOCK_PX * mean.shape[1]), np.float32)
    for window in _Rule.windows_px:
        if window > _Rule.windows_px[0] and window > max(image.shape):
            break
        threshold, contrast = _estimate_levels(smooth, mean, window)
        _set_sides(smooth, threshold, contrast, np.float32(floor), wide, sides[0], sides[1])
        yield from zip((True, False), sides, strict=True)


def _estimate_levels(smooth, mean, window):
    """Return threshold and contrast of the local bright and dark levels, in grey levels, for the blocks of an image.

    ``mean`` contains the means of the blocks.
    """
    threshold = bright = dark = mean = _average_window(mean, window)
    for _ in range(2):
        share, above = (_average_window(values, window) for values in _average_above(smooth, threshold))
        share = np.clip(share, 1e-4, 1 - 1e-4)
        bright, dark = above / share, (mean - above) / (1 - share)
        threshold = (bright + dark) / 2
    return threshold, bright - dark


def _average_window(blocks, window):
    side = window // BLOCK_PX + 1
    return cv2.blur(blocks, (side, side), borderType=cv2.BORDER_REFLECT)


def _average_above(smooth, threshold):
    """Return the means per block of a mask of pixels above the interpolated threshold, and of their grey values.

    Other pixels count as zero in both means.
    """
    share, above = np.empty_like(threshold), np.empty_like(threshold)
    wide, sums = np.empty((2, 2, BLOCK_PX * threshold.shape[1]), np.float32)
    _sum_above(smooth, threshold, wide, sums, share, above)
    return share, above


@compiled_part
def _interpolate_blocks(blocks, v, wide):
    """Return two rows of blocks around a row of pixels, interpolated for each column, and the second row's weight.

    It has to be called for all rows of pixels in order; ``wide`` keeps both rows of blocks.
    """
    top = (v + BLOCK_PX // 2) // BLOCK_PX - 1
    if v == 0:
        _widen(blocks[0], wide[top & 1])
    if v == 0 or v % BLOCK_PX == BLOCK_PX // 2:
        _widen(blocks[min(top + 1, blocks.shape[0] - 1)], wide[(top + 1) & 1])
    return wide[top & 1], wide[(top + 1) & 1], np.float32((v + 0.5) / BLOCK_PX - 0.5 - top)


@compiled_part
def _widen(blocks, wide):
    """Interpolate a row of blocks for each column of pixels; beyond its ends the last value is repeated."""
    far, near, last = np.float32(0.375), np.float32(0.125), blocks.size - 1
    for c in range(last + 1):
        before, after = blocks[max(c - 1, 0)] - blocks[c], blocks[min(c + 1, last)] - blocks[c]
        wide[4 * c], wide[4 * c + 1] = blocks[c] + far * before, blocks[c] + near * before
        wide[4 * c + 2], wide[4 * c + 3] = blocks[c] + near * after, blocks[c] + far * after


@compiled
def _sum_above(smooth, threshold, wide, sums, share, above):
    height, width = smooth.shape
    number, total = sums[0], sums[1]
    for block in range(share.shape[0]):
        first, last = BLOCK_PX * block, min(BLOCK_PX * (block + 1), height)
        for u in range(width):
            number[u], total[u] = np.float32(0.0), np.float32(0.0)
        for v in range(first, last):
            upper, lower, part = _interpolate_blocks(threshold, v, wide)
            pixels = smooth[v]
            for u in range(width):
                grey = np.float32(pixels[u])
                is_above = np.float32(grey > upper[u] + part * (lower[u] - upper[u]))
                number[u] += is_above
                total[u] += is_above * grey
        for c in range(share.shape[1]):
            left, right = BLOCK_PX * c, min(BLOCK_PX * (c + 1), width)
            count, grey, area = np.float32(0.0), np.float32(0.0), np.float32((last - first) * (right - left))
            for u in range(left, right):
                count, grey = count + number[u], grey + total[u]
            share[block, c], above[block, c] = count / area, grey / area


@compiled
def _set_sides(smooth, threshold, contrast, floor, wide, bright, dark):
    """Set masks (H, W) of pixels above and below the threshold, at sufficient contrast."""
    for v in range(smooth.shape[0]):
        upper, lower, part = _interpolate_blocks(threshold, v, wide[0])
        above, below, part = _interpolate_blocks(contrast, v, wide[1])
        pixels, is_bright, is_dark = smooth[v], bright[v], dark[v]
        for u in range(pixels.size):
            level = upper[u] + part * (lower[u] - upper[u])
            clear = above[u] + part * (below[u] - above[u]) > floor
            is_bright[u] = clear & (np.float32(pixels[u]) > level)
            is_dark[u] = clear & (np.float32(pixels[u]) < level)


def _select_ellipses(mask, *, bright, fewest=0):
    """Return the blobs of a 0/1 mask whose outline encloses the area of the ellipse with the same moments.

    The result is empty if the mask has fewer than ``fewest`` outlines.
    """
    height, width = mask.shape
    contours, hierarchy = cv2.findContours(mask, cv2.RETR_CCOMP, cv2.CHAIN_APPROX_NONE)
    lengths = np.fromiter(map(len, contours), int, len(contours))
    # The outline of the largest circle in the image is shorter than four times its shorter side.
    chosen = np.flatnonzero((lengths >= 8) & (lengths <= 4 * min(height, width)))
    chosen = chosen[hierarchy[0, chosen, 3] < 0] if len(contours) else chosen
    if len(chosen) < max(fewest, 1):
        return Blobs(np.empty((0, 2)), np.empty((0, 2, 2)), bright)
    points = np.concatenate([contours[k] for k in chosen])[:, 0]
    first = np.cumsum(lengths[chosen]) - lengths[chosen]
    area, centres, covariances = _compute_outline_moments(points, first)
    inside = np.logical_and.reduceat(((points > 1) & (points < (width - 2, height - 2))).all(1), first)
    # The outline passes through pixel centres: it excludes half a pixel all around, and lines of pixels completely.
    inside &= (area > 0) & (area + lengths[chosen] / 2 >= _Rule.least_area_px)
    area, covariances = area[inside], covariances[inside]
    # The uniform disc of radius r has the variance r^2 / 4, so an ellipse has area 4 pi sqrt(det covariance).
    determinant = covariances[:, 0] * covariances[:, 3] - covariances[:, 1] ** 2
    expected = 4 * np.pi * np.sqrt(np.maximum(determinant, 0))
    like = np.abs(area - expected) <= _Rule.ellipse_departure * expected
    values, vectors = np.linalg.eigh(covariances[like].reshape(-1, 2, 2))
    semi_axes = 2 * np.sqrt(values) + 0.5
    return Blobs(centres[inside][like], (vectors * semi_axes[:, None, :]) @ vectors.swapaxes(1, 2), bright)


def _compute_outline_moments(points, first):
    """Return areas (K,), centroids (K, 2) and covariances xx, xy, yx, yy (K, 4) of polygons, by Green's theorem.

    ``points`` (N, 2) contains the polygons one after another, from the indices ``first`` (K,) on. Lines have area 0.
    """
    # Coordinates relative to the first point: all sums are integers, and exact.
    counts = np.diff(first, append=len(points))
    u, v = (points - np.repeat(points[first], counts, axis=0)).T.astype(float)
    before = np.arange(len(points)) - 1
    before[first] += counts
    p, q = u[before], v[before]
    squares = p * (p + u) + u * u, p * (2 * q + v) + u * (q + 2 * v), q * (q + v) + v * v
    sums = np.add.reduceat(np.stack([np.ones(len(u)), p + u, q + v, *squares]) * (p * v - u * q), first, axis=1)
    area, mu, mv, uu, uv, vv = (
        sums * np.where(sums[0] > 0, 1.0, -1.0) / np.array([2.0, 6.0, 6.0, 12.0, 24.0, 12.0])[:, None]
    )
    unit = np.where(area > 0, area, 1.0)
    xy = uv - mu * mv / unit
    covariances = np.stack([uu - mu * mu / unit, xy, xy, vv - mv * mv / unit], axis=1) / unit[:, None]
    return area, points[first] + np.stack([mu / unit, mv / unit], axis=1), covariances


def _find_family(radii, ratio):
    """Return the first and the last place, plus one, among sorted radii of most radii within a ratio of each other."""
    ordered = np.sort(np.log(radii))
    ends = np.searchsorted(ordered, ordered + np.log(ratio), side="right")
    first = int(np.argmax(ends - np.arange(len(ordered)))) if len(ordered) else 0
    return first, int(ends[first]) if len(ordered) else 0
