"""Closed bright or dark blobs of an unevenly lit image, as candidates for the images of circles."""

from dataclasses import dataclass
from statistics import NormalDist

import cv2
import numpy as np

from uwlts.errors import ImageError
from uwlts.runtime.compiled import compiled, compiled_part

# Sides of the square window over which the two local grey levels are taken. A window serves blobs from about a tenth
# to three quarters of its side, so factors of four cover 4 px to 380 px with overlap.
WINDOWS_PX = (32, 128, 512)
# Local grey levels are means of blocks of so many pixels a side, with linear interpolation between their middles.
BLOCK_PX = 4
MIN_AREA_PX = 10.0  # a blob of fewer pixels has no measurable shape (a disc of 4 px diameter covers 12.6)
# Pure noise, which the median filter has more than halved, shows 0.7 of its standard deviation between both levels.
CONTRAST_OVER_NOISE = 3.0
SMOOTH_SHARE = 0.2  # of the pixels, in which even a fine pattern leaves no edge
# Most difference of a blob's area from that of the ellipse with its moments, as a share. Rectangles, at 0.05, pass; the
# fit to the edge leaves them out.
ELLIPSE_LIKE = 0.12
CONTRAST_OVER_RANGE = 0.04  # below this fraction of the image's grey range a contrast is dirt or compression noise


@dataclass(frozen=True)
class Blobs:
    """Blobs of one polarity, each with the ellipse that has the blob's moments.

    Attributes
    ----------
    centres : (N, 2) float64, px, (u, v)
    shapes : (N, 2, 2) float64, px, symmetric positive; ``centre + shape @ (cos t, sin t)`` is the ellipse
    bright : whether the blobs are brighter than their surroundings
    """

    centres: np.ndarray
    shapes: np.ndarray
    bright: bool

    def __len__(self):
        return len(self.centres)


def checked_grey(image):
    """The image as a read-only array (H, W), `ImageError` if it is not of uint8 or uint16."""
    if not isinstance(image, np.ndarray):
        raise ImageError(f"the image is a {type(image).__name__}; expected a NumPy array (H, W) of uint8 or uint16")
    if image.ndim != 2 or image.dtype not in (np.uint8, np.uint16) or min(image.shape) < 16:
        size = " x ".join(map(str, image.shape[1::-1]))
        raise ImageError(
            f"the image has {size} pixels, {image.ndim} dimensions and the type {image.dtype}; expected one grey "
            "channel (H, W) of uint8 or uint16, at least 16 x 16: convert colour images first"
        )
    # Compiled code is made once for arrays that can be written and once more for others.
    grey = np.ascontiguousarray(image).view()
    grey.flags.writeable = False
    return grey


def noise_level(image):
    """Standard deviation of the pixel noise of an image (H, W), in grey levels.

    The mask of Immerkaer (Fast noise variance estimation, CVIU 64, 1996, eq. 2) cancels linear shading and has norm 6.
    Its lower fifth is used instead of its mean because a fine pattern puts an edge into most neighbourhoods.
    """
    counts = np.zeros(8 * np.iinfo(image.dtype).max + 1, np.int64)
    _count_responses(image, counts)
    lower_part = np.searchsorted(np.cumsum(counts), SMOOTH_SHARE * counts.sum())
    return float(lower_part) / (6 * NormalDist().inv_cdf(0.5 + SMOOTH_SHARE / 2))


@compiled
def _count_responses(image, counts):
    """Count how often the mask's response has each size; one row in four is enough for a quantile."""
    for v in range(0, image.shape[0] - 2, 4):
        above, middle, below = image[v], image[v + 1], image[v + 2]
        before = np.int64(above[0]) - 2 * np.int64(middle[0]) + np.int64(below[0])
        here = np.int64(above[1]) - 2 * np.int64(middle[1]) + np.int64(below[1])
        for u in range(2, image.shape[1]):
            after = np.int64(above[u]) - 2 * np.int64(middle[u]) + np.int64(below[u])
            counts[abs(before - 2 * here + after)] += 1
            before, here = here, after


def find_blobs(image, noise):
    """Find the most numerous family of ellipse-like blobs, whatever its polarity and size.

    Each window of `WINDOWS_PX` gives a threshold half-way between the mean levels of the local bright and dark pixels
    (one step of Ridler and Calvard's iteration per pass, taken locally, which removes uneven lighting). Holes are
    filled by keeping outer contours only; blobs at the image border and small ones are left out. The window and
    polarity with most blobs of about the same size win, of as many the smaller ones: what is bright around each dark
    circle is a blob too.

    ``noise`` is the standard deviation of a pixel of the image (H, W); the result may be empty.
    """
    low, high = np.quantile(image[::4, ::4], (0.001, 0.999))
    floor = max(CONTRAST_OVER_NOISE * noise, CONTRAST_OVER_RANGE * (high - low))
    smooth = cv2.medianBlur(image, 3)
    # All pixels are above -1.
    _, mean = _above(smooth, np.full([-(-size // BLOCK_PX) for size in smooth.shape], -1, np.float32))
    best, best_score = Blobs(np.empty((0, 2)), np.empty((0, 2, 2)), True), (0, 0.0)
    sides, wide = np.empty((2, *smooth.shape), np.uint8), np.empty((2, 2, BLOCK_PX * mean.shape[1]), np.float32)
    for window in WINDOWS_PX:
        if window > WINDOWS_PX[0] and window > max(image.shape):
            break
        threshold, contrast = _local_levels(smooth, mean, window)
        _set_sides(smooth, threshold, contrast, np.float32(floor), wide, sides[0], sides[1])
        for bright, side in zip((True, False), sides, strict=True):
            blobs = _ellipse_like(side, bright=bright, fewest=best_score[0])
            radii = np.sqrt(np.linalg.det(blobs.shapes))
            score = _largest_family(radii), -float(np.median(radii)) if len(radii) else 0.0
            if score > best_score:
                best, best_score = blobs, score
    return best


def _local_levels(smooth, mean, window):
    """Threshold and contrast between the local bright and dark levels, in grey levels, of the blocks of an image.

    ``mean`` is that of the blocks.
    """
    threshold = bright = dark = mean = _local_mean(mean, window)
    for _ in range(2):
        share, above = (_local_mean(values, window) for values in _above(smooth, threshold))
        share = np.clip(share, 1e-4, 1 - 1e-4)
        bright, dark = above / share, (mean - above) / (1 - share)
        threshold = (bright + dark) / 2
    return threshold, bright - dark


def _local_mean(blocks, window):
    side = window // BLOCK_PX + 1
    return cv2.blur(blocks, (side, side), borderType=cv2.BORDER_REFLECT)


def _above(smooth, threshold):
    """Of each block the share of pixels above the threshold, interpolated between blocks, and their sum over all."""
    share, above = np.empty_like(threshold), np.empty_like(threshold)
    wide, sums = np.empty((2, 2, BLOCK_PX * threshold.shape[1]), np.float32)
    _sum_above(smooth, threshold, wide, sums, share, above)
    return share, above


@compiled_part
def _between(blocks, v, wide):
    """Rows of blocks on either side of a row of pixels, interpolated for each column, and the share of the second one.

    To be called for all rows of pixels in turn; ``wide`` keeps both rows of blocks.
    """
    top = (v + BLOCK_PX // 2) // BLOCK_PX - 1
    if v == 0:
        _widen(blocks[0], wide[top & 1])
    if v == 0 or v % BLOCK_PX == BLOCK_PX // 2:
        _widen(blocks[min(top + 1, blocks.shape[0] - 1)], wide[(top + 1) & 1])
    return wide[top & 1], wide[(top + 1) & 1], np.float32((v + 0.5) / BLOCK_PX - 0.5 - top)


@compiled_part
def _widen(blocks, wide):
    """Values of a row of blocks, those at its ends repeated beyond them, interpolated for each column of pixels."""
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
            upper, lower, part = _between(threshold, v, wide)
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
    """Masks (H, W) of what is brighter and of what is darker than the threshold, where there is contrast."""
    for v in range(smooth.shape[0]):
        upper, lower, part = _between(threshold, v, wide[0])
        above, below, part = _between(contrast, v, wide[1])
        pixels, is_bright, is_dark = smooth[v], bright[v], dark[v]
        for u in range(pixels.size):
            level = upper[u] + part * (lower[u] - upper[u])
            clear = above[u] + part * (below[u] - above[u]) > floor
            is_bright[u] = clear & (np.float32(pixels[u]) > level)
            is_dark[u] = clear & (np.float32(pixels[u]) < level)


def _ellipse_like(mask, *, bright, fewest=0):
    """Blobs of a 0/1 mask whose outline encloses the area of the ellipse with the same moments.

    None where there would be less than the ``fewest``.
    """
    height, width = mask.shape
    contours, hierarchy = cv2.findContours(mask, cv2.RETR_CCOMP, cv2.CHAIN_APPROX_NONE)
    lengths = np.fromiter(map(len, contours), int, len(contours))
    # The outline of the largest circle that fits into the image has less than four times its shorter side.
    chosen = np.flatnonzero((lengths >= 8) & (lengths <= 4 * min(height, width)))
    chosen = chosen[hierarchy[0, chosen, 3] < 0] if len(contours) else chosen
    chosen = chosen[: len(chosen) if len(chosen) >= fewest else 0]
    found = np.empty((len(chosen), 7))
    if len(chosen):
        ends = np.cumsum(lengths[chosen])
        _outline_moments(np.concatenate([contours[k] for k in chosen])[:, 0], ends, width, height, found)
    # The outline runs through pixel centres: it leaves out half a pixel all around, and all of a line of pixels.
    found = found[(found[:, 1] > 0) & (found[:, 1] + found[:, 0] / 2 >= MIN_AREA_PX)]
    area, covariances = found[:, 1], found[:, 4:] / found[:, 1:2]
    determinant = covariances[:, 0] * covariances[:, 2] - covariances[:, 1] ** 2
    # The uniform disc of radius r has the variance r^2 / 4, so an ellipse has area 4 pi sqrt(det covariance).
    expected = 4 * np.pi * np.sqrt(np.maximum(determinant, 0))
    like = np.abs(area - expected) <= ELLIPSE_LIKE * expected
    centres, shapes = found[like, 2:4] / area[like, None], covariances[like][:, [0, 1, 1, 2]]
    values, vectors = np.linalg.eigh(shapes.reshape(-1, 2, 2))
    semi_axes = 2 * np.sqrt(values) + 0.5
    return Blobs(centres, (vectors * semi_axes[:, None, :]) @ vectors.swapaxes(1, 2), bright)


@compiled
def _outline_moments(points, ends, width, height, found):
    """Number of points, area, first moments and central second moments (K, 7) of polygons, by Green's theorem.

    Those of polygons at the image's border have no area. ``points`` (N, 2) are of one polygon after the other, up to
    ``ends`` (K,).
    """
    first = 0
    for number in range(ends.size):
        end, inside = ends[number], True
        # From the first point on, so that no digits are lost.
        u0, v0 = points[first, 0], points[first, 1]
        area, mu, mv, uu, uv, vv = 0.0, 0.0, 0.0, 0.0, 0.0, 0.0
        before_u, before_v = float(points[end - 1, 0] - u0), float(points[end - 1, 1] - v0)
        for k in range(first, end):
            inside &= 1 < points[k, 0] < width - 2 and 1 < points[k, 1] < height - 2
            u, v = float(points[k, 0] - u0), float(points[k, 1] - v0)
            cross = before_u * v - u * before_v
            area += cross
            mu += cross * (before_u + u)
            mv += cross * (before_v + v)
            uu += cross * (before_u * (before_u + u) + u * u)
            vv += cross * (before_v * (before_v + v) + v * v)
            uv += cross * (before_u * (2.0 * before_v + v) + u * (before_v + 2.0 * v))
            before_u, before_v = u, v
        sign = 1.0 if area > 0.0 else -1.0
        area, mu, mv = sign * area / 2.0, sign * mu / 6.0, sign * mv / 6.0
        result = found[number]
        result[0], result[1] = end - first, area if inside else 0.0
        result[2], result[3] = mu + area * u0, mv + area * v0
        if area > 0.0:
            result[4] = sign * uu / 12.0 - mu * mu / area
            result[5] = sign * uv / 24.0 - mu * mv / area
            result[6] = sign * vv / 12.0 - mv * mv / area
        first = end


def _largest_family(radii):
    """Number of radii in the best-filled interval of a factor of two."""
    ordered = np.sort(np.log2(radii))
    within = np.searchsorted(ordered, ordered + 1.0, side="right") - np.arange(len(ordered))
    return int(within.max(initial=0))
