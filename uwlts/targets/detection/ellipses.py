"""Images of circles: sub-pixel ellipses through their edges, their quality, and which of them carry a mark."""

import math
from dataclasses import dataclass, replace

import numpy as np
from scipy.spatial import KDTree

from uwlts.runtime.compiled import compiled, compiled_part, compiled_with_arrays
from uwlts.targets.detection.blobs import Blobs, checked_grey, find_blobs, noise_level

PASSES = 2  # of both fits; the second one measures along the normals of the first
# The edge of Gaussian blur s has the slope 0.4 / s over its contrast; 1.2 / slope is therefore three s.
REACH_TIMES_SLOPE = 1.2
MIN_REACH_PX = 2.5  # three s of a lens in focus
MAX_REACH_PX = 8.0  # three s of a blur of 2.7 px
MIN_RELATIVE_CONTRAST = 0.25  # of the middle's, to which the contrast of planes that meet is raised
NEIGHBOURS = 12  # their levels show the shading
MAX_LEVEL_DEPARTURE = 0.25  # a neighbour that differs by more differs by its print, or is no circle
_ON_A_LINE = 1e-3  # ratio of squares across and along a line, below which places lie on it
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
    where not, the ellipse's centre is given. ``grey`` is the image (H, W).
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
    planes = np.zeros((len(centres), 2, 3))
    inner, outer = reaches
    _mean_levels(grey, centres, shapes, np.linalg.inv(shapes), inner, outer, DIRECTIONS, planes)
    if len(centres) > 1:
        near = KDTree(centres).query(centres, k=min(NEIGHBOURS + 1, len(centres)))[1]
        _fit_slopes(centres, np.asarray(near), planes)
    return planes


@compiled
def _mean_levels(grey, centres, shapes, inverses, inner, outer, directions, planes):
    """Set the levels (N, 2) along the rims of ellipses, so far inwards and outwards from them."""
    around = directions.shape[0]
    for n in range(len(centres)):
        shape, inverse, inside, outside = shapes[n], inverses[n], 0.0, 0.0
        for p in range(around):
            e_u, e_v = directions[p, 0], directions[p, 1]
            at_u = centres[n, 0] + shape[0, 0] * e_u + shape[0, 1] * e_v
            at_v = centres[n, 1] + shape[0, 1] * e_u + shape[1, 1] * e_v
            n_u, n_v = inverse[0, 0] * e_u + inverse[0, 1] * e_v, inverse[0, 1] * e_u + inverse[1, 1] * e_v
            length = math.sqrt(n_u * n_u + n_v * n_v)
            n_u, n_v = n_u / length, n_v / length
            inside += _bilinear(grey, at_u - inner[n] * n_u, at_v - inner[n] * n_v)
            outside += _bilinear(grey, at_u + outer[n] * n_u, at_v + outer[n] * n_v)
        planes[n, 0, 0], planes[n, 1, 0] = inside / around, outside / around


@compiled
def _fit_slopes(places, near, planes):
    """Fill the slopes of planes through the values at each of the places (N, 2) and at those ``near`` it (N, K).

    Of places on one line the slope along it is all that they tell.
    """
    for n in range(len(places)):
        for side in range(2):
            value = planes[n, side, 0]
            count, su, sv, sz, uu, uv, vv, uz, vz = 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0
            for k in near[n]:
                z = planes[k, side, 0] - value
                if abs(z) <= MAX_LEVEL_DEPARTURE * abs(value):
                    u, v = places[k, 0] - places[n, 0], places[k, 1] - places[n, 1]
                    count, su, sv, sz = count + 1.0, su + u, sv + v, sz + z
                    uu, uv, vv, uz, vz = uu + u * u, uv + u * v, vv + v * v, uz + u * z, vz + v * z
            uu, uv, vv = uu - su * su / count, uv - su * sv / count, vv - sv * sv / count
            uz, vz = uz - su * sz / count, vz - sv * sz / count
            determinant, middle = uu * vv - uv * uv, 0.5 * (uu + vv)
            largest = middle + math.sqrt(max(middle * middle - determinant, 0.0))
            if determinant > _ON_A_LINE * largest * largest:
                slope_u, slope_v = (vv * uz - uv * vz) / determinant, (uu * vz - uv * uz) / determinant
            else:
                # By the direction along which the places lie, whose squares add up to the largest.
                least = 2.0 * middle - largest
                scale = 1.0 / (largest * max(largest - least, 1e-300)) if largest > 0.0 else 0.0
                slope_u = scale * ((uu - least) * uz + uv * vz)
                slope_v = scale * (uv * uz + (vv - least) * vz)
            planes[n, side, 1], planes[n, side, 2] = slope_u, slope_v


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
        sign, least = math.copysign(1.0, inside - outside), MIN_RELATIVE_CONTRAST * abs(inside - outside)
        half_height = math.sqrt(q[0, 0] / (q[0, 0] * q[1, 1] - q[0, 1] * q[0, 1]))
        top, bottom = math.ceil(centre_v - half_height), math.floor(centre_v + half_height)
        for v in range(max(top, 0), min(bottom + 1, height)):
            dv = v - centre_v
            first, last = _run(q, centre_u, dv)
            whole_from, whole_to = _run(inner[n], centre_u, dv)
            first, last = max(first, 0), min(last, width - 1)
            whole_from, whole_to = max(whole_from, first), min(whole_to, last)
            if whole_from > whole_to:
                whole_from, whole_to = last + 1, last
            whole = whole_to - whole_from + 1
            area, sum_v = area + whole, sum_v + whole * dv
            sum_u += whole * (0.5 * (whole_from + whole_to) - centre_u)
            for band in range(first, last + 1 - whole):
                u = band if band < whole_from else band + whole
                du = u - centre_u
                dark = outside + outside_u * du + outside_v * dv
                contrast = sign * (inside + inside_u * du + inside_v * dv - dark)
                # Planes that meet within the band belong to no circle; their share stays finite, and the centre shows
                # it.
                share = sign * (grey[v, u] - dark) / max(contrast, least)
                area, sum_u, sum_v = area + share, sum_u + share * du, sum_v + share * dv
        result[n, 0], result[n, 1] = centre_u + sum_u / area, centre_v + sum_v / area


@compiled_part
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

    ``grey`` is the image (H, W), ``noise`` that of a pixel; possibly no ellipse is accepted.
    """
    best = _fitted(grey, blobs, REACHES_PX[0], noise)
    for reach in REACHES_PX[1:]:
        if len(best) >= (1 - MISSED_SHARE) * len(blobs):
            break
        best = max(best, _fitted(grey, blobs, reach, noise), key=len)
    return best


def _fitted(grey, blobs, reach, noise):
    """Ellipses of an image (H, W) with edges sampled over one reach in px."""
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


def _moved(grey, ellipses, longest, noise):
    """Ellipses moved to the edges around them by least squares, and whether (N,) the edges are whole."""
    count, reach = len(ellipses), np.minimum(longest, REACH_OVER_MINOR_AXIS * np.linalg.eigvalsh(ellipses.shapes)[:, 0])
    share = np.where(reach < longest, MAX_CONTRAST_DEPARTURE_IF_SMALL, MAX_CONTRAST_DEPARTURE)
    normal, right, figures = np.empty((count, 5, 5)), np.empty((count, 5)), np.empty((count, 4))
    sign, room = 1.0 if ellipses.bright else -1.0, np.empty((PROFILES, SAMPLES))
    blobs = ellipses.centres, ellipses.shapes, np.linalg.inv(ellipses.shapes), reach, share
    _measure_edges(grey, *blobs, DIRECTIONS, sign, 6 * noise, room, normal, right, figures)
    squares, contrast, slope, whole = figures[:, 0], figures[:, 1], figures[:, 2], figures[:, 3] > 0
    change = np.linalg.solve(normal, right[:, :, None])[:, :, 0]
    rms = np.sqrt(np.maximum(squares - (right * change).sum(1), 0.0) / (PROFILES - 5))
    centres, shapes = ellipses.centres + change[:, :2], ellipses.shapes + change[:, [2, 3, 3, 4]].reshape(-1, 2, 2)
    sharpness = slope / np.where(whole, contrast, 1.0)
    moved = Ellipses(centres, shapes, ellipses.bright, rms, contrast, sharpness)
    return moved, whole & (np.linalg.eigvalsh(shapes)[:, 0] > 1.0)


@compiled_with_arrays
def _measure_edges(
    grey, centres, shapes, inverses, reaches, shares, directions, sign, disturbed, room, normal, right, figures
):
    """Normal equations (N, 5, 5), (N, 5) of changes of centre (2) and shape (3) that move ellipses to their edges.

    Distances along the normals are linear in small changes. ``figures`` (N, 4) are the squares of all distances, the
    contrast, the edge's slope, and whether (0 or 1) every profile has the contrast and falls through its middle.
    """
    around, samples = room.shape
    middle, apart = samples // 2, 2.0 / (samples - 1)
    levels = np.empty((2, around))
    for n in range(centres.shape[0]):
        shape, inverse, reach = shapes[n], inverses[n], reaches[n]
        slope, squares, contrasts, whole = 0.0, 0.0, 0.0, True
        harmonics = np.zeros((2, 3))
        for p in range(around):
            e_u, e_v = directions[p, 0], directions[p, 1]
            n_u, n_v = inverse[0, 0] * e_u + inverse[0, 1] * e_v, inverse[0, 1] * e_u + inverse[1, 1] * e_v
            step = reach / math.sqrt(n_u * n_u + n_v * n_v)
            at_u = centres[n, 0] + shape[0, 0] * e_u + shape[0, 1] * e_v
            at_v = centres[n, 1] + shape[0, 1] * e_u + shape[1, 1] * e_v
            for s in range(samples):
                away = step * (apart * s - 1.0)
                room[p, s] = sign * _bilinear(grey, at_u + away * n_u, at_v + away * n_v)
            slope += room[p, middle - 2] - room[p, middle + 2]
            levels[0, p], levels[1, p] = (
                (room[p, 0] + room[p, 1]) / 2,
                (room[p, samples - 2] + room[p, samples - 1]) / 2,
            )
            for side in range(2):
                harmonics[side, 0] += levels[side, p] / around
                harmonics[side, 1] += 2.0 * levels[side, p] * e_u / around
                harmonics[side, 2] += 2.0 * levels[side, p] * e_v / around
        normal[n], right[n] = 0.0, 0.0
        for p in range(around):
            e_u, e_v = directions[p, 0], directions[p, 1]
            inside = harmonics[0, 0] + harmonics[0, 1] * e_u + harmonics[0, 2] * e_v
            outside = harmonics[1, 0] + harmonics[1, 1] * e_u + harmonics[1, 2] * e_v
            contrast, level = inside - outside, (inside + outside) / 2
            departure = abs(levels[0, p] - levels[1, p] - contrast)
            whole &= contrast > 0 and departure <= max(shares[n] * contrast, disturbed)
            contrasts += contrast / around
            # Where the profile falls through its middle level, nearest to its own middle.
            nearest, crossing = float(samples), 0.0
            for s in range(samples - 1):
                before, after = room[p, s] - level, room[p, s + 1] - level
                away = abs(s - (samples - 2) / 2)
                if before > 0 and after <= 0 and away < nearest:
                    nearest, crossing = away, apart * (s + before / (before - after)) - 1.0
            whole &= nearest < samples
            n_u, n_v = inverse[0, 0] * e_u + inverse[0, 1] * e_v, inverse[0, 1] * e_u + inverse[1, 1] * e_v
            length, distance = math.sqrt(n_u * n_u + n_v * n_v), crossing * reach
            n_u, n_v = n_u / length, n_v / length
            by = (n_u, n_v, n_u * e_u, n_u * e_v + n_v * e_u, n_v * e_v)
            squares += distance * distance
            for i in range(5):
                right[n, i] += by[i] * distance
                for j in range(5):
                    normal[n, i, j] += by[i] * by[j]
        figures[n, 0], figures[n, 1], figures[n, 3] = squares, contrasts, 1.0 if whole else 0.0
        figures[n, 2] = slope / around * (samples - 1) / (8.0 * reach)


def sample(grey, points):
    """Bilinear grey values (...) at pixel positions (..., 2), which must lie inside the image."""
    values = np.empty(points.shape[:-1], np.float32)
    _interpolate(grey, points.reshape(-1, 2), values.reshape(-1))
    return values


@compiled
def _interpolate(grey, points, values):
    for n in range(len(points)):
        values[n] = _bilinear(grey, points[n, 0], points[n, 1])


@compiled_part
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
    grey = checked_grey(image)
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
    grey = checked_grey(image)
    rim = DIRECTIONS @ circles.shapes
    dot = np.mean(
        [sample(grey, circles.centres[:, None] + share * mark_over_circle * rim) for share in (0.0, 0.25, 0.5)], (0, 2)
    )
    ring = sample(grey, circles.centres[:, None] + (1 + mark_over_circle) / 2 * rim).mean(1)
    return (ring - dot) / circles.contrast * (1.0 if circles.bright else -1.0)
