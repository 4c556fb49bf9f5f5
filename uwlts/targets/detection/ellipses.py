"""Images of circles: sub-pixel ellipses through their edges, their quality, and which of them carry a mark."""

import math
from dataclasses import dataclass, replace

import numpy as np
from scipy.spatial import KDTree

from uwlts.runtime.compiled import compiled
from uwlts.targets.detection.blobs import Blobs, checked_grey, find_blobs, noise_level

PASSES = 2
# The edge of Gaussian blur s has the slope 0.4 / s over its contrast; 1.2 / slope is therefore three s.
REACH_TIMES_SLOPE = 1.2
MIN_REACH_PX = 2.5
MAX_REACH_PX = 8.0
MIN_RELATIVE_CONTRAST = 0.25
NEIGHBOURS = 12  # their levels show the shading
MAX_LEVEL_DEPARTURE = 0.25  # a neighbour that differs by more differs by its print, or is no circle
MAX_SHIFT_PX = 0.5  # a centroid further from the ellipse's centre has something other than a circle in its band
PROFILES = 48  # around a blob
SAMPLES = 11  # on each profile
_ANGLES = np.arange(PROFILES) * (2 * np.pi / PROFILES)
DIRECTIONS = np.stack([np.cos(_ANGLES), np.sin(_ANGLES)], 1)
"""Unit vectors (PROFILES, 2) that an ellipse's shape matrix maps to points of its rim."""


def area_centroids(grey, ellipses):
    """Centroids of the areas that ellipses cover, with the pixels of the edge counted by their share.

    A pixel in the band around the ellipse counts by (I - outside) / (inside - outside), the share of it that the blob
    covers; a pixel further in counts whole and one further out not at all. Blur and the pixel's own area spread that
    share without moving its centroid, which is why this is less biased than an ellipse through points of the edge.
    Inside and outside levels are planes, so that shading does not pull the centre, and what lies deep inside (a mark)
    has no influence.

    Returns centres (N, 2) in px and whether (N,) the centroid is next to the centre of the ellipse fitted to the edge;
    where not, the ellipse's centre is given. ``grey`` is float32 (H, W).
    """
    centres, agree = ellipses.centres, np.ones(len(ellipses), bool)
    reaches = _reaches(grey.shape, ellipses)
    for _ in range(PASSES):
        planes = _level_planes(grey, centres, ellipses.shapes, reaches)
        moved = _centroids(grey, centres, ellipses.shapes, reaches, planes)
        agree &= np.linalg.norm(moved - ellipses.centres, axis=1) < MAX_SHIFT_PX
        centres = np.where(agree[:, None], moved, ellipses.centres)
    return centres, agree


def _reaches(shape, ellipses):
    """Reach of the band inwards and outwards from each ellipse, twice (N,), px."""
    semi_axes = np.linalg.eigvalsh(ellipses.shapes)
    wanted = np.clip(REACH_TIMES_SLOPE / np.maximum(ellipses.sharpness, 0.1), MIN_REACH_PX, MAX_REACH_PX)
    inner = np.minimum(wanted, REACH_OVER_MINOR_AXIS * semi_axes[:, 0])
    outer = wanted
    if len(ellipses) > 1:
        distance, index = KDTree(ellipses.centres).query(ellipses.centres, k=2)
        gap = distance[:, 1] - semi_axes[:, 1] - semi_axes[np.asarray(index)[:, 1], 1]
        outer = np.minimum(outer, np.maximum(gap / 2, 1.0))
    half_width = np.sqrt((ellipses.shapes**2).sum(2))
    limit = np.array([shape[1], shape[0]]) - 2.0
    room = np.minimum(ellipses.centres - half_width, limit - ellipses.centres - half_width).min(1)
    return inner, np.minimum(outer, np.maximum(room, 0.5))


def _level_planes(grey, centres, shapes, reaches):
    """Inside and outside level of each blob: (N, 2, 3), value at the centre and slopes along u and v per px.

    The slopes are those of the levels of neighbouring blobs: levels read around a single one, close to a blurred edge,
    slope with the edge's tail, which reaches further on one side where the plate is inclined.
    """
    rim, normals = _rims(shapes)
    planes = np.zeros((len(centres), 2, 3))
    for side, reach in enumerate((-reaches[0], reaches[1])):
        offsets = rim + normals * reach[:, None, None]
        planes[:, side, 0] = sample(grey, centres[:, None] + offsets).mean(1)
        planes[:, side, 1:] = _slopes(centres, planes[:, side, 0])
    return planes


def _slopes(places, values):
    """Slopes (N, 2) of planes through values (N,) at each of the places (N, 2) and at those next to it."""
    count = min(NEIGHBOURS + 1, len(places))
    if count < 2:
        return np.zeros_like(places)
    near = KDTree(places).query(places, k=count)[1]
    alike = np.abs(values[near] - values[:, None]) <= MAX_LEVEL_DEPARTURE * np.abs(values[:, None])
    weights = alike / alike.sum(1, keepdims=True)
    at, level = places[near], values[near]
    at = at - np.einsum("nk,nki->ni", weights, at)[:, None]
    level = level - np.einsum("nk,nk->n", weights, level)[:, None]
    spread = np.einsum("nk,nki,nkj->nij", weights, at, at)
    # Of places on one line the slope along it is all that they tell.
    return np.einsum("nij,nj->ni", np.linalg.pinv(spread, rcond=1e-3), np.einsum("nk,nki,nk->ni", weights, at, level))


def _centroids(grey, centres, shapes, reaches, planes):
    """Centroids (N, 2) of ellipses, whose pixels in the band count by their share."""
    result = np.empty_like(centres)
    # x' Q x = 1 with Q = shape^-2.
    inner, outer = (np.linalg.inv(shapes + np.eye(2) * reach[:, None, None]) for reach in (-reaches[0], reaches[1]))
    _sum_shares(grey, centres, inner @ inner, outer @ outer, planes, result)
    return result


@compiled
def _sum_shares(grey, centres, inner, outer, planes, result):
    height, width = grey.shape
    for n in range(len(centres)):
        q, (centre_u, centre_v) = outer[n], centres[n]
        (inside, inside_u, inside_v), (outside, outside_u, outside_v) = planes[n]
        area, sum_u, sum_v = 0.0, 0.0, 0.0
        half_height = math.sqrt(q[0, 0] / (q[0, 0] * q[1, 1] - q[0, 1] * q[0, 1]))
        top, bottom = math.ceil(centre_v - half_height), math.floor(centre_v + half_height)
        for v in range(max(top, 0), min(bottom + 1, height)):
            dv = v - centre_v
            first, last = _run(q, centre_u, dv)
            whole_from, whole_to = _run(inner[n], centre_u, dv)
            for u in range(max(first, 0), min(last + 1, width)):
                du, share = u - centre_u, 1.0
                if u < whole_from or u > whole_to:
                    dark = outside + outside_u * du + outside_v * dv
                    relative = (inside + inside_u * du + inside_v * dv - dark) / (inside - outside)
                    # Planes that meet within the band belong to no circle; their share stays finite, and the centre
                    # shows it.
                    share = (grey[v, u] - dark) / (max(relative, MIN_RELATIVE_CONTRAST) * (inside - outside))
                area, sum_u, sum_v = area + share, sum_u + share * du, sum_v + share * dv
        result[n, 0], result[n, 1] = centre_u + sum_u / area, centre_v + sum_v / area


@compiled
def _run(q, centre_u, dv):
    """First and last u within an ellipse in a row; the first is after the last where the row misses it."""
    mixed = q[0, 1] * dv
    root = mixed * mixed - q[0, 0] * (q[1, 1] * dv * dv - 1.0)
    if root <= 0.0:
        return 1, 0
    half, middle = math.sqrt(root) / q[0, 0], centre_u - mixed / q[0, 0]
    return math.ceil(middle - half), math.floor(middle + half)


# Reaches of an edge profile on either side of the ellipse, tried in turn. Two and a half pixels hold the edge of a lens
# in focus, six that of one out of focus; inside a small blob half the minor semi-axis is all there is before the
# opposite edge is felt. The next is tried where this share of the blobs shows no sharp edge.
REACHES_PX = (2.5, 6.0)
REACH_OVER_MINOR_AXIS = 0.5
MISSED_SHARE = 0.2

# Largest rms distance of the edge from its ellipse: as a share of the reach (0.15 px of 2.5 px) and of the mean radius,
# against what the noise of a single pixel does to an edge, and against the median of all blobs, which have about the
# same noise and blur.
MAX_RESIDUAL_OVER_REACH = 0.06
MAX_RESIDUAL_OVER_RADIUS = 0.01
MAX_RESIDUAL_OVER_NOISE = 1.5
MAX_RESIDUAL_OVER_MEDIAN = 2.5
RESIDUAL_FLOOR_PX = 0.03

# Least slope over contrast of an edge, times the reach; at a reach of 2.5 px it is that under a Gaussian blur of 4 px.
MIN_SHARPNESS_TIMES_REACH = 0.25

# Largest departure of one profile's contrast from the smooth course around the blob. Where blur fills a small blob, its
# inside level differs between the ends and the flanks of the ellipse.
MAX_CONTRAST_DEPARTURE = 0.2
MAX_CONTRAST_DEPARTURE_IF_SMALL = 0.4


@dataclass(frozen=True)
class Ellipses(Blobs):
    """Ellipses fitted to the edges of blobs.

    Attributes
    ----------
    residual_px : (N,) float64, rms distance of the edge points from the ellipse
    contrast : (N,) float64, grey levels, inside minus outside
    sharpness : (N,) float64, 1/px, slope of the edge over its contrast
    """

    residual_px: np.ndarray
    contrast: np.ndarray
    sharpness: np.ndarray

    def __getitem__(self, select):
        own = vars(self).items()
        return Ellipses(**{name: value if name == "bright" else value[select] for name, value in own})


def fit_ellipses(grey, blobs, noise):
    """Fit ellipses to the edges of blobs and keep those that are ellipses.

    The edge is where the grey level passes half-way between inside and outside, sampled along normals of the current
    ellipse. Both levels follow a constant and a first harmonic around the blob, so that shading does not shift the
    centre. The distance along the normal is linear in a small change of centre and shape, which gives the orthogonal
    least-squares fit after a few passes. Blobs cut by a stripe, a scratch or the target's edge show a large residual or
    an uneven contrast and are left out; nothing is downweighted. Where the image is out of focus, the edge is sampled
    over a longer distance.

    ``grey`` is the image (H, W) in float32, ``noise`` that of a pixel; possibly no ellipse is accepted.
    """
    best = _fitted(grey, blobs, REACHES_PX[0], noise)
    for reach in REACHES_PX[1:]:
        if len(best) >= (1 - MISSED_SHARE) * len(blobs):
            break
        best = max(best, _fitted(grey, blobs, reach, noise), key=len)
    return best


def _fitted(grey, blobs, reach, noise):
    """Ellipses of a float32 image (H, W) with edges sampled over one reach in px."""
    found = Ellipses(blobs.centres, blobs.shapes, blobs.bright, *np.zeros((3, len(blobs))))
    found = found[_inside(grey.shape, found, reach)]
    for _ in range(PASSES):
        found, whole = _moved(grey, found, reach, noise)
        found = found[whole & _inside(grey.shape, found, reach)]
    radii = np.sqrt(np.linalg.det(found.shapes))
    from_noise = noise / (found.contrast * np.maximum(found.sharpness, MIN_SHARPNESS_TIMES_REACH / reach))
    limit = np.maximum(MAX_RESIDUAL_OVER_REACH * reach, MAX_RESIDUAL_OVER_RADIUS * radii)
    round_enough = found.residual_px <= np.maximum(limit, MAX_RESIDUAL_OVER_NOISE * from_noise)
    if round_enough.any():
        usual = np.median(found.residual_px[round_enough])
        round_enough &= found.residual_px <= max(RESIDUAL_FLOOR_PX, MAX_RESIDUAL_OVER_MEDIAN * usual)
    return found[round_enough]


def _inside(shape, ellipses, reach):
    """Whether the profiles of ellipses stay within the image, (N,) bool."""
    half_width = np.sqrt((ellipses.shapes**2).sum(2)) + reach
    limit = np.array([shape[1], shape[0]]) - 1.001
    return (ellipses.centres - half_width >= 0).all(1) & (ellipses.centres + half_width <= limit).all(1)


def _rims(shapes):
    """Points of the rims of ellipses about their centres, and the normals there, both (N, PROFILES, 2)."""
    normals = DIRECTIONS @ np.linalg.inv(shapes)
    return DIRECTIONS @ shapes, normals / np.linalg.norm(normals, axis=2, keepdims=True)


def _moved(grey, ellipses, longest, noise):
    """Ellipses moved to the edges around them by least squares, and whether (N,) the edges are whole."""
    rim, normals = _rims(ellipses.shapes)
    reach = np.minimum(longest, REACH_OVER_MINOR_AXIS * np.linalg.eigvalsh(ellipses.shapes)[:, 0])
    profiles = np.empty((len(ellipses), PROFILES, SAMPLES), np.float32)
    _sample_profiles(grey, ellipses.centres[:, None] + rim, normals, reach, profiles)
    if not ellipses.bright:
        profiles = -profiles
    inner, outer = profiles[:, :, :2].mean(2), profiles[:, :, -2:].mean(2)
    harmonics = np.stack([np.ones(PROFILES), *DIRECTIONS.T], 1)
    smoother = harmonics @ np.linalg.pinv(harmonics)
    inner_level, outer_level = inner @ smoother, outer @ smoother
    contrast = inner_level - outer_level
    departure = np.abs(inner - outer - contrast)
    share = np.where(reach < longest, MAX_CONTRAST_DEPARTURE_IF_SMALL, MAX_CONTRAST_DEPARTURE)
    whole = (contrast > 0).all(1) & (departure <= np.maximum(share[:, None] * contrast, 6 * noise)).all(1)
    crossing, crossed = _crossing(profiles - (inner_level + outer_level)[:, :, None] / 2)
    distance, middle = crossing * reach[:, None], SAMPLES // 2
    slope = (profiles[:, :, middle - 2] - profiles[:, :, middle + 2]).mean(1) / (8 * reach / (SAMPLES - 1))
    mean_contrast = contrast.mean(1)
    sharpness = slope / np.where(whole, mean_contrast, 1.0)
    # The distances along the normals are linear in small changes of the centre (2) and of the shape (3).
    (n_u, n_v), (e_u, e_v) = np.moveaxis(normals, 2, 0), DIRECTIONS.T
    design = np.stack([n_u, n_v, n_u * e_u, n_u * e_v + n_v * e_u, n_v * e_v], 2)
    normal = design.swapaxes(1, 2) @ design
    change = np.linalg.solve(normal, design.swapaxes(1, 2) @ distance[:, :, None])
    residual = distance - (design @ change)[:, :, 0]
    rms = np.sqrt((residual**2).sum(1) / (PROFILES - 5))
    centres = ellipses.centres + change[:, :2, 0]
    shapes = ellipses.shapes + change[:, [2, 3, 3, 4], 0].reshape(-1, 2, 2)
    moved = Ellipses(centres, shapes, ellipses.bright, rms, mean_contrast, sharpness)
    return moved, whole & crossed & (np.linalg.eigvalsh(shapes)[:, 0] > 1.0)


def _crossing(excess):
    """Places, -1 to 1, where profiles (N, P, S) fall through zero nearest their middle, and whether all N x P do."""
    falls = (excess[:, :, :-1] > 0) & (excess[:, :, 1:] <= 0)
    from_middle = np.abs(np.arange(SAMPLES - 1) - (SAMPLES - 2) / 2)
    first = np.where(falls, from_middle, np.inf).argmin(2)
    before = np.take_along_axis(excess, first[:, :, None], 2)[:, :, 0]
    after = np.take_along_axis(excess, first[:, :, None] + 1, 2)[:, :, 0]
    crossed = falls.any(2)
    share = np.where(crossed, before / np.where(crossed, before - after, 1.0), 0.5)
    return 2 * (first + share) / (SAMPLES - 1) - 1, crossed.all(1)


def sample(grey, points):
    """Bilinear grey values (...) at pixel positions (..., 2), which must lie inside the image."""
    values = np.empty(points.shape[:-1], np.float32)
    _interpolate(grey, points.reshape(-1, 2), values.reshape(-1))
    return values


@compiled
def _sample_profiles(grey, middles, normals, reach, profiles):
    """Grey values (N, P, S) from minus to plus ``reach`` (N,) along normals (N, P, 2) about middles (N, P, 2)."""
    count, around, samples = profiles.shape
    for n in range(count):
        for p in range(around):
            for s in range(samples):
                step = reach[n] * (2 * s / (samples - 1) - 1)
                u, v = middles[n, p, 0] + step * normals[n, p, 0], middles[n, p, 1] + step * normals[n, p, 1]
                profiles[n, p, s] = _bilinear(grey, u, v)


@compiled
def _interpolate(grey, points, values):
    for n in range(len(points)):
        values[n] = _bilinear(grey, points[n, 0], points[n, 1])


@compiled
def _bilinear(grey, u, v):
    height, width = grey.shape
    left, top = min(max(int(u), 0), width - 2), min(max(int(v), 0), height - 2)
    du, dv = np.float32(u - left), np.float32(v - top)
    upper = grey[top, left] * (1 - du) + grey[top, left + 1] * du
    lower = grey[top + 1, left] * (1 - du) + grey[top + 1, left + 1] * du
    return upper * (1 - dv) + lower * dv


def find_circles(image):
    """Find the images of circles of one polarity and similar size, bright on dark or dark on bright.

    Follows G. S. de Matos (UFSC 2017, section 4.5: median filter, background-corrected threshold, hole filling,
    removal of border and small particles, ellipse fit) up to the blobs; ellipse and centre come from the grey levels.

    The image is (H, W) of uint8 or uint16, ImageError for others. Centres are centroids of the covered area, in px
    (u, v); possibly none are found.
    """
    grey = checked_grey(image).astype(np.float32)
    # Half a grey level covers an image without noise, whose only disturbance is its rounding.
    noise = max(noise_level(grey), 0.5)
    ellipses = fit_ellipses(grey, find_blobs(grey, noise), noise)
    centres, agree = area_centroids(grey, ellipses)
    return replace(ellipses, centres=centres)[agree]


def mark_strength(image, circles, *, mark_over_circle):
    """Strength (N,) with which each circle of an image shows a centred dot of the opposite brightness.

    (ring - dot) / contrast: about 0 without a dot, towards 1 with a sharp one. ``mark_over_circle`` is the diameter of
    the dot over that of the circle.
    """
    grey = image.astype(np.float32)
    rim = DIRECTIONS @ circles.shapes
    dot = np.mean(
        [sample(grey, circles.centres[:, None] + share * mark_over_circle * rim) for share in (0.0, 0.25, 0.5)], (0, 2)
    )
    ring = sample(grey, circles.centres[:, None] + (1 + mark_over_circle) / 2 * rim).mean(1)
    return (ring - dot) / circles.contrast * (1.0 if circles.bright else -1.0)
