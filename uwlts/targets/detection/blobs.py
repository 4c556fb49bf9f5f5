"""Closed bright or dark blobs of an unevenly lit image, as candidates for the images of circles."""

from dataclasses import dataclass

import cv2
import numpy as np

from uwlts.model.errors import ImageError
from uwlts.runtime.compiled import compiled

# Sides of the square window over which the two local grey levels are taken. A window serves blobs from about a tenth
# to three quarters of its side, so factors of four cover 4 px to 380 px with overlap.
WINDOWS_PX = (32, 128, 512)
MIN_AREA_PX = 10.0  # a blob of fewer pixels has no measurable shape (a disc of 4 px diameter covers 12.6)
# Pure noise, which the median filter has more than halved, shows 0.7 of its standard deviation between both levels.
CONTRAST_OVER_NOISE = 3.0
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
    """Return `image` unchanged if it is an (H, W) array of uint8 or uint16, else raise `ImageError`."""
    if not isinstance(image, np.ndarray):
        raise ImageError(f"the image is a {type(image).__name__}; expected a NumPy array (H, W) of uint8 or uint16")
    if image.ndim != 2 or image.dtype not in (np.uint8, np.uint16) or min(image.shape) < 16:
        size = " x ".join(map(str, image.shape[1::-1]))
        raise ImageError(
            f"the image has {size} pixels, {image.ndim} dimensions and the type {image.dtype}; expected one grey "
            "channel (H, W) of uint8 or uint16, at least 16 x 16: convert colour images first"
        )
    return image


def noise_level(grey):
    """Standard deviation of the pixel noise of a float32 image (H, W), in grey levels.

    The mask of Immerkaer (Fast noise variance estimation, CVIU 64, 1996, eq. 2) cancels linear shading and has norm 6.
    Its lower fifth is used instead of its mean because a fine pattern puts an edge into most neighbourhoods.
    """
    # One row in four is enough for a quantile.
    upper, middle, lower = grey[0:-2:4], grey[1:-1:4], grey[2::4]
    rows = upper[: len(lower)] - 2 * middle[: len(lower)] + lower
    response = np.abs(rows[:, :-2] - 2 * rows[:, 1:-1] + rows[:, 2:])
    lower_fifth_of_unit_normal = 0.2533
    return float(np.quantile(response, 0.2) / (6 * lower_fifth_of_unit_normal))


def find_blobs(grey, noise):
    """Find the most numerous family of ellipse-like blobs, whatever its polarity and size.

    Each window of `WINDOWS_PX` gives a threshold half-way between the mean levels of the local bright and dark pixels
    (one step of Ridler and Calvard's iteration per pass, taken locally, which removes uneven lighting). Holes are
    filled by keeping outer contours only; blobs at the image border and small ones are left out. The window and
    polarity with most blobs of about the same size win, of as many the smaller ones: what is bright around each dark
    circle is a blob too.

    ``grey`` is the image (H, W) in float32, ``noise`` the standard deviation of a pixel; the result may be empty.
    """
    low, high = np.quantile(grey[::4, ::4], (0.001, 0.999))
    floor = max(CONTRAST_OVER_NOISE * noise, CONTRAST_OVER_RANGE * (high - low))
    smooth = cv2.medianBlur(grey, 3)
    small = _reduced(smooth)
    best, best_score = Blobs(np.empty((0, 2)), np.empty((0, 2, 2)), True), (0, 0.0)
    for window in WINDOWS_PX:
        if window > WINDOWS_PX[0] and window > max(grey.shape):
            break
        threshold, contrast = _local_levels(smooth, small, window)
        clear = contrast > floor
        for bright in (True, False):
            side = smooth > threshold if bright else smooth < threshold
            blobs = _ellipse_like(np.logical_and(side, clear).view(np.uint8), bright=bright)
            radii = np.sqrt(np.linalg.det(blobs.shapes))
            score = _largest_family(radii), -float(np.median(radii)) if len(radii) else 0.0
            if score > best_score:
                best, best_score = blobs, score
    return best


def _local_levels(smooth, small, window):
    """Threshold (H, W) and contrast (H, W) between the local bright and dark levels, in grey levels.

    `small` is `smooth` at a quarter of its resolution, at which all local means are taken.
    """
    mean = _local_mean(small, window)
    threshold, bright, dark = _enlarged(mean, smooth.shape), mean, mean
    above, grey_above = np.empty_like(smooth), np.empty_like(smooth)
    for _ in range(2):
        _split(smooth, threshold, above, grey_above)
        share = np.clip(_local_mean(_reduced(above), window), 1e-4, 1 - 1e-4)
        above_sum = _local_mean(_reduced(grey_above), window)
        bright, dark = above_sum / share, (mean - above_sum) / (1 - share)
        threshold = _enlarged((bright + dark) / 2, smooth.shape)
    return threshold, _enlarged(bright - dark, smooth.shape)


@compiled
def _split(smooth, threshold, above, grey_above):
    """1 and the grey level where an image is above its threshold, 0 elsewhere."""
    height, width = smooth.shape
    for v in range(height):
        for u in range(width):
            is_above = np.float32(smooth[v, u] > threshold[v, u])
            above[v, u], grey_above[v, u] = is_above, is_above * smooth[v, u]


def _reduced(values):
    return cv2.resize(values, None, fx=0.25, fy=0.25, interpolation=cv2.INTER_AREA)


def _local_mean(small, window):
    side = window // 4 + 1
    return cv2.blur(small, (side, side), borderType=cv2.BORDER_REFLECT)


def _enlarged(values, shape):
    return cv2.resize(values, shape[::-1], interpolation=cv2.INTER_LINEAR)


def _ellipse_like(mask, *, bright):
    """Blobs of a 0/1 mask whose outline encloses the area of the ellipse with the same moments."""
    height, width = mask.shape
    contours, hierarchy = cv2.findContours(mask, cv2.RETR_CCOMP, cv2.CHAIN_APPROX_NONE)
    is_outline = hierarchy.reshape(-1, 4)[:, 3] < 0 if contours else ()
    found = []
    # The outline of the largest circle that fits into the image has less than four times its shorter side.
    for contour, outline in zip(contours, is_outline, strict=True):
        if outline and 8 <= (length := len(contour)) <= 4 * min(height, width):
            u, v, du, dv = cv2.boundingRect(contour)
            if u > 1 and v > 1 and u + du < width - 1 and v + dv < height - 1:
                moments = cv2.moments(contour)
                found.append((length, *(moments[name] for name in ("m00", "m10", "m01", "mu20", "mu11", "mu02"))))
    found = np.array(found).reshape(-1, 7)
    # The outline runs through pixel centres: it leaves out half a pixel all around, and all of a line of pixels.
    found = found[(found[:, 1] > 0) & (found[:, 1] + found[:, 0] / 2 >= MIN_AREA_PX)]
    area, covariances = found[:, 1], found[:, 4:] / found[:, 1:2]
    determinant = covariances[:, 0] * covariances[:, 2] - covariances[:, 1] ** 2
    # The uniform disc of radius r has the variance r^2 / 4, so an ellipse has area 4 pi sqrt(det covariance).
    expected = 4 * np.pi * np.sqrt(np.maximum(determinant, 0))
    like = np.abs(area - expected) <= 0.12 * expected
    centres, shapes = found[like, 2:4] / area[like, None], covariances[like][:, [0, 1, 1, 2]]
    values, vectors = np.linalg.eigh(shapes.reshape(-1, 2, 2))
    semi_axes = 2 * np.sqrt(values) + 0.5
    return Blobs(centres, (vectors * semi_axes[:, None, :]) @ vectors.swapaxes(1, 2), bright)


def _largest_family(radii):
    """Number of radii in the best-filled interval of a factor of two."""
    ordered = np.sort(np.log2(radii))
    within = np.searchsorted(ordered, ordered + 1.0, side="right") - np.arange(len(ordered))
    return int(within.max(initial=0))
