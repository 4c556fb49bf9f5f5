"""Images of circles: sub-pixel ellipses fitted to their edges, quality, marks, and the offset of their centres."""

import math
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np
from scipy.spatial import KDTree

from uwlts.errors import CalibrationError
from uwlts.runtime.compiled import compiled, compiled_part, compiled_with_arrays
from uwlts.targets.detection.blobs import Blobs, check_grey, estimate_noise, find_blobs

PROFILES = 48  # edge profiles around a blob
SAMPLES = 11  # samples on each edge profile


class EllipseRule(NamedTuple):
    """Numbers of the ellipse fit; a named tuple, which compiled code reads as constants.

    Chosen by hand with the reasons below, not fitted to data. Results with these numbers are checked on the drawn
    plates of tests/uwlts/targets and on real photographs (tests/system/test_real_images.py).
    """

    passes: int = 2  # passes of both fits; the second pass samples along the normals of the first one
    reaches_px: tuple[float, ...] = (2.5, 6.0)
    """Reaches of an edge profile on either side of the ellipse, px, tried in order. 2.5 px cover the edge of a lens
    in focus, 6 px that of a lens out of focus."""
    reach_over_minor_axis: float = 0.5
    """Largest inner reach, in minor semi-axes: beyond it a small blob shows its opposite edge."""
    missed_share: float = 0.2  # fraction of blobs without a sharp edge above which the next reach is tried
    residual_over_reach: float = 0.06
    """Largest rms distance of the edge from its ellipse, as a fraction of the reach: 0.15 px of 2.5 px."""
    residual_over_radius: float = 0.01  # the same as a fraction of the mean radius; the larger limit applies
    residual_over_noise: float = 1.5
    """The same, relative to the effect of a pixel's noise on an edge; the larger limit applies."""
    residual_over_median: float = 2.5
    """The same, relative to the median of all blobs, which have similar noise and blur."""
    residual_floor_px: float = 0.03  # residual that always satisfies the limit relative to the median, px
    sharpness_times_reach: float = 0.25
    """Least slope of an edge divided by its contrast, times the reach: at a reach of 2.5 px, a Gaussian blur of 4
    px."""
    contrast_departure: float = 0.2
    """Largest difference of a profile's contrast from its smooth variation around the blob, as a fraction."""
    contrast_departure_if_small: float = 0.4
    """The same for small blobs: with blur, their inside level differs between the ends and flanks of the ellipse."""
    reach_times_slope: float = 1.2
    """Reach of the centroid's band, times the edge's slope divided by its contrast. A Gaussian blur s gives a slope
    of 0.4 / s, so that the reach is three s."""
    # Range of this reach, px: three s of a lens in focus, and of a blur of 2.7 px.
    least_reach_px: float = 2.5
    most_reach_px: float = 8.0
    relative_contrast: float = 0.25
    """Least contrast between the level planes, as a fraction of that in the middle; planes may intersect."""
    neighbours: int = 12  # neighbouring blobs that determine the shading
    level_departure: float = 0.25
    """Largest relative difference of a neighbour's level: others have a different print, or are no circles."""
    on_a_line: float = 1e-3  # ratio of squares across and along a line below which places are collinear
    shift_px: float = 0.5
    """Largest distance of a centroid from its ellipse's centre, px; beyond it the band contains other objects."""


RULE = EllipseRule()

_ANGLES = np.arange(PROFILES) * (2 * np.pi / PROFILES)  # of the profiles across an outline
DIRECTIONS = np.stack([np.cos(_ANGLES), np.sin(_ANGLES)], 1)
"""Unit vectors (PROFILES, 2) that an ellipse's shape matrix maps to points of its rim."""


def find_centroids(grey, ellipses):
    """Return centroids of the areas covered by ellipses, with edge pixels weighted by their covered fraction.

    A pixel in the band around the ellipse has the weight (I - outside) / (inside - outside), the fraction covered by
    the blob. Pixels further inside have weight 1, pixels further outside 0. Blur and the pixel's area spread this
    fraction without moving its centroid. The centroid therefore has less bias than an ellipse through edge points.

    Inside and outside levels are planes, so that shading does not move the centre. Marks deep inside have no influence.

    Returns centres (N, 2) in px, and a mask (N,) of centroids close to the centre of their fitted ellipse. For others
    the ellipse's centre is returned. ``grey`` is the image (H, W).
    """
    centres, agree = ellipses.centres, np.ones(len(ellipses), bool)
    reaches = _find_band_reaches(grey.shape, ellipses)
    for _ in range(RULE.passes):
        planes = _level_planes(grey, centres, ellipses.shapes, reaches)
        moved = _compute_centroids(grey, centres, ellipses.shapes, reaches, planes)
        agree &= np.linalg.norm(moved - ellipses.centres, axis=1) < RULE.shift_px
        centres = np.where(agree[:, None], moved, ellipses.centres)
    return centres, agree


def _find_band_reaches(shape, ellipses):
    """Return the reach of the band inwards and outwards from each ellipse, two arrays (N,), px."""
    semi_axes = np.linalg.eigvalsh(ellipses.shapes)
    wanted = np.clip(
        RULE.reach_times_slope / np.maximum(ellipses.sharpness, 0.1), RULE.least_reach_px, RULE.most_reach_px
    )
    inner = np.minimum(wanted, RULE.reach_over_minor_axis * semi_axes[:, 0])
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
    """Return the inside and outside level of each blob (N, 2, 3): value at the centre, and slopes along u and v per px.

    The slopes are taken from the levels of neighbouring blobs. Levels around a single blob contain the tail of its
    blurred edge, which extends further on one side if the plate is inclined.
    """
    planes = np.zeros((len(centres), 2, 3))
    normals = DIRECTIONS @ np.linalg.inv(shapes)
    normals /= np.linalg.norm(normals, axis=2, keepdims=True)
    rim = centres[:, None] + DIRECTIONS @ shapes
    for side, reach in enumerate((-reaches[0], reaches[1])):
        planes[:, side, 0] = sample_grey(grey, rim + reach[:, None, None] * normals).mean(1, dtype=float)
    if len(centres) > 1:
        near = np.asarray(KDTree(centres).query(centres, k=min(RULE.neighbours + 1, len(centres)))[1])
        levels = planes[:, :, 0]
        change = levels[near] - levels[:, None]
        like = np.abs(change) <= RULE.level_departure * np.abs(levels)[:, None]
        weight = like / like.sum(1, keepdims=True)
        offsets = centres[near] - centres[:, None]
        offsets = offsets[:, :, None] - np.einsum("nks,nku->nsu", weight, offsets)[:, None]
        squares = np.einsum("nks,nksu,nksv->nsuv", weight, offsets, offsets)
        products = np.einsum("nks,nksu,nks->nsu", weight, offsets, change)
        # Collinear places determine the slope along their line only.
        inverse = np.linalg.pinv(squares, rcond=RULE.on_a_line, hermitian=True)
        planes[:, :, 1:] = (inverse @ products[..., None])[..., 0]
    return planes


def _compute_centroids(grey, centres, shapes, reaches, planes):
    """Compute the centroids (N, 2) of ellipses; pixels in the band count by their covered fraction."""
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
        sign, least = math.copysign(1.0, inside - outside), RULE.relative_contrast * abs(inside - outside)
        half_height = math.sqrt(q[0, 0] / (q[0, 0] * q[1, 1] - q[0, 1] * q[0, 1]))
        top, bottom = math.ceil(centre_v - half_height), math.floor(centre_v + half_height)
        for v in range(max(top, 0), min(bottom + 1, height)):
            dv = v - centre_v
            first, last = _find_row_extent(q, centre_u, dv)
            whole_from, whole_to = _find_row_extent(inner[n], centre_u, dv)
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
                # Planes that intersect in the band belong to no circle, whose centre is then rejected.
                share = sign * (grey[v, u] - dark) / max(contrast, least)
                area, sum_u, sum_v = area + share, sum_u + share * du, sum_v + share * dv
        result[n, 0], result[n, 1] = centre_u + sum_u / area, centre_v + sum_v / area


@compiled_part
def _find_row_extent(q, centre_u, dv):
    """Return first and last u within an ellipse in a row; first > last if the row does not meet the ellipse."""
    mixed = q[0, 1] * dv
    root = mixed * mixed - q[0, 0] * (q[1, 1] * dv * dv - 1.0)
    if root <= 0.0:
        return 1, 0
    half, middle = math.sqrt(root) / q[0, 0], centre_u - mixed / q[0, 0]
    return math.ceil(middle - half), math.floor(middle + half)


@dataclass(frozen=True)
class Ellipses(Blobs):
    """Ellipses fitted to the edges of blobs."""

    residual_px: np.ndarray  # (N,), rms distance of the edge points from the ellipse
    contrast: np.ndarray  # (N,), grey levels, inside minus outside
    sharpness: np.ndarray  # (N,), 1/px, slope of the edge divided by its contrast

    def __getitem__(self, select):
        columns = vars(self).items()
        return Ellipses(**{name: value if name == "bright" else value[select] for name, value in columns})


def fit_ellipses(grey, blobs, noise):
    """Fit ellipses to the edges of blobs and keep those that are ellipses.

    The edge is the place where the grey level is halfway between inside and outside, sampled along normals of the
    current ellipse. Both levels are a constant and a first harmonic around the blob, so that shading does not shift the
    centre.

    The distance along the normal is linear in small changes of centre and shape. A few passes give the orthogonal
    least-squares fit. Blobs cut by a stripe, a scratch or the target's edge have a large residual or an uneven contrast
    and are rejected; no point is downweighted. In an image out of focus, the edge is sampled over a longer distance.

    ``grey`` is the image (H, W), ``noise`` the standard deviation of a pixel. The result may be empty.
    """
    best = _fit_at_reach(grey, blobs, RULE.reaches_px[0], noise)
    for reach in RULE.reaches_px[1:]:
        if len(best) >= (1 - RULE.missed_share) * len(blobs):
            break
        best = max(best, _fit_at_reach(grey, blobs, reach, noise), key=len)
    return best


def _fit_at_reach(grey, blobs, reach, noise):
    """Fit ellipses in an image (H, W), with edges sampled over one reach in px."""
    found = Ellipses(blobs.centres, blobs.shapes, blobs.bright, *np.zeros((3, len(blobs))))
    found = found[_mask_inside(grey.shape, found, reach)]
    for _ in range(RULE.passes):
        found, whole = _update_ellipses(grey, found, reach, noise)
        found = found[whole & _mask_inside(grey.shape, found, reach)]
    radii = np.sqrt(np.linalg.det(found.shapes))
    from_noise = noise / (found.contrast * np.maximum(found.sharpness, RULE.sharpness_times_reach / reach))
    limit = np.maximum(RULE.residual_over_reach * reach, RULE.residual_over_radius * radii)
    round_enough = found.residual_px <= np.maximum(limit, RULE.residual_over_noise * from_noise)
    if round_enough.any():
        usual = np.median(found.residual_px[round_enough])
        round_enough &= found.residual_px <= max(RULE.residual_floor_px, RULE.residual_over_median * usual)
    return found[round_enough]


def _mask_inside(shape, ellipses, reach):
    """Return a mask (N,) of ellipses whose profiles are inside the image."""
    half_width = np.sqrt((ellipses.shapes**2).sum(2)) + reach
    limit = np.array([shape[1], shape[0]]) - 1.001
    return (ellipses.centres - half_width >= 0).all(1) & (ellipses.centres + half_width <= limit).all(1)


def _update_ellipses(grey, ellipses, longest, noise):
    """Fit ellipses to the edges around them by least squares, and return them with a mask (N,) of whole edges."""
    count, reach = (
        len(ellipses),
        np.minimum(longest, RULE.reach_over_minor_axis * np.linalg.eigvalsh(ellipses.shapes)[:, 0]),
    )
    share = np.where(reach < longest, RULE.contrast_departure_if_small, RULE.contrast_departure)
    normal, right, figures = np.empty((count, 5, 5)), np.empty((count, 5)), np.empty((count, 4))
    sign, room = 1.0 if ellipses.bright else -1.0, np.empty((PROFILES, SAMPLES))
    blobs = ellipses.centres, ellipses.shapes, np.linalg.inv(ellipses.shapes), reach, share
    _measure_edges(grey, blobs, DIRECTIONS, sign, 6 * noise, room, (normal, right, figures))
    squares, contrast, slope, whole = figures[:, 0], figures[:, 1], figures[:, 2], figures[:, 3] > 0
    change = np.linalg.solve(normal, right[:, :, None])[:, :, 0]
    rms = np.sqrt(np.maximum(squares - (right * change).sum(1), 0.0) / (PROFILES - 5))
    centres, shapes = ellipses.centres + change[:, :2], ellipses.shapes + change[:, [2, 3, 3, 4]].reshape(-1, 2, 2)
    moved = Ellipses(centres, shapes, ellipses.bright, rms, contrast, slope / np.where(whole, contrast, 1.0))
    return moved, whole & (np.linalg.eigvalsh(shapes)[:, 0] > 1.0)


@compiled_with_arrays
def _measure_edges(grey, blobs, directions, sign, disturbed, room, results):
    """Set up normal equations (N, 5, 5), (N, 5) for changes of centre (2) and shape (3) of the ellipses.

    Distances along the normals are linear in small changes. The last result is figures (N, 4): sum of squared
    distances, contrast, slope of the edge, and whether every profile has the contrast and falls through its middle.
    ``blobs`` are centres, shapes and their inverses, reaches, and allowed departures of the contrast.
    """
    centres, shapes, inverses, reaches, shares = blobs
    normal, right, figures = results
    around, samples = room.shape
    middle, spacing = samples // 2, 2.0 / (samples - 1)
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
                offset = step * (spacing * s - 1.0)
                room[p, s] = sign * _sample_bilinear(grey, at_u + offset * n_u, at_v + offset * n_v)
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
            # Crossing of the middle level that is nearest to the middle of the profile.
            nearest, crossing = float(samples), 0.0
            for s in range(samples - 1):
                before, after = room[p, s] - level, room[p, s + 1] - level
                offset = abs(s - (samples - 2) / 2)
                if before > 0 and after <= 0 and offset < nearest:
                    nearest, crossing = offset, spacing * (s + before / (before - after)) - 1.0
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


def sample_grey(grey, points):
    """Return bilinear grey values (...) at pixel positions (..., 2) inside the image."""
    values = np.empty(points.shape[:-1], np.float32)
    _sample_all(grey, points.reshape(-1, 2), values.reshape(-1))
    return values


@compiled
def _sample_all(grey, points, values):
    for n in range(len(points)):
        values[n] = _sample_bilinear(grey, points[n, 0], points[n, 1])


@compiled_part
def _sample_bilinear(grey, u, v):
    height, width = grey.shape
    left, top = min(max(int(u), 0), width - 2), min(max(int(v), 0), height - 2)
    du, dv = np.float32(u - left), np.float32(v - top)
    upper = grey[top, left] * (1 - du) + grey[top, left + 1] * du
    lower = grey[top + 1, left] * (1 - du) + grey[top + 1, left + 1] * du
    return upper * (1 - dv) + lower * dv


def find_circles(image):
    """Yield families of images of circles of one polarity, bright on dark or dark on bright; the likeliest first.

    Blobs are found as by G. S. de Matos (UFSC 2017, section 4.5: median filter, background-corrected threshold, hole
    filling, removal of border and small particles, ellipse fit). Ellipse and centre are fitted to the grey levels.

    The image is (H, W) of uint8 or uint16; ImageError for others. Centres are centroids of the covered area, in px (u,
    v). The first family may be empty; the others are similar in size.
    """
    grey = check_grey(image)
    # An image without noise has rounding errors of half a grey level.
    noise = max(estimate_noise(grey), 0.5)
    for blobs in find_blobs(grey, noise):
        ellipses = fit_ellipses(grey, blobs, noise)
        centres, agree = find_centroids(grey, ellipses)
        yield replace(ellipses, centres=centres)[agree]


def measure_marks(image, circles, *, mark_over_circle):
    """Return the strength (N,) of a centred dot of opposite brightness in each circle of an image.

    The strength is (ring - dot) / contrast: about 0 without a dot, nearly 1 for a sharp dot. ``mark_over_circle`` is
    the diameter of the dot divided by that of the circle.
    """
    grey = check_grey(image)
    rim = DIRECTIONS @ circles.shapes
    dot = np.mean(
        [sample_grey(grey, circles.centres[:, None] + share * mark_over_circle * rim) for share in (0.0, 0.25, 0.5)],
        (0, 2),
    )
    ring = sample_grey(grey, circles.centres[:, None] + (1 + mark_over_circle) / 2 * rim).mean(1)
    return (ring - dot) / circles.contrast * (1.0 if circles.bright else -1.0)


RIM_POINTS = 16  # projected points on the rim of a circle


def circle_centre_bias(project, centres_mm, *, diameter_mm):
    """Return the offset of the centre of a circle's image from the image of the circle's centre.

    A detected centre minus this offset is the image of the circle's centre. For a pinhole camera the image is an
    ellipse and the offset is exact (J. Heikkila and O. Silven, A four-step camera calibration procedure, CVPR 1997,
    section 3.2). With distortion or refraction, the ellipse is fitted to the projected rim.

    ``project`` maps points (M, 3) in mm, target frame, to pixels (M, 2). The circles with ``centres_mm`` (N, 3) are in
    planes of constant z. Returns (N, 2) float64, (u, v) in px.

    Raises CalibrationError if the image of a circle is not an ellipse: the circle extends behind the camera, or
    ``project`` fails, as in a fit that diverged.
    """
    centres = np.asarray(centres_mm, float).reshape(-1, 3)
    if len(centres) == 0:
        return np.empty((0, 2))
    angle = np.arange(RIM_POINTS) * (2 * np.pi / RIM_POINTS)
    rim = diameter_mm / 2 * np.stack([np.cos(angle), np.sin(angle), 0 * angle], 1)
    points = np.concatenate([centres[:, None], centres[:, None] + rim], 1)
    pixels = np.asarray(project(points.reshape(-1, 3)), float).reshape(len(centres), RIM_POINTS + 1, 2)
    broken = ~np.isfinite(pixels).all((1, 2))
    if broken.any():
        raise CalibrationError(
            f"{broken.sum()} of {len(centres)} circles cannot be projected, the first at {centres[broken][0]} mm: the "
            "images do not fit the described target and sensor, or the camera cannot see these circles"
        )
    return _fit_centres(pixels[:, 1:]) - pixels[:, 0]


def _fit_centres(points):
    """Return the centres (N, 2) of the conics that best fit N sets of points (N, M, 2), M >= 6."""
    middle = points.mean(1, keepdims=True)
    scale = np.sqrt(((points - middle) ** 2).mean((1, 2), keepdims=True))
    if (scale == 0).any():
        raise CalibrationError(f"{np.count_nonzero(scale == 0)} circles are imaged onto a single point, not an ellipse")
    x, y = np.moveaxis((points - middle) / scale, 2, 0)
    design = np.stack([x * x, x * y, y * y, x, y, np.ones_like(x)], 2)
    a, b, c, d, e, _ = np.linalg.eigh(design.swapaxes(1, 2) @ design)[1][:, :, 0].T
    determinant = 4 * a * c - b * b
    if not (determinant > 0).all():
        count = np.count_nonzero(determinant <= 0)
        raise CalibrationError(f"{count} of {len(points)} circles extend behind the camera: no ellipses in the image")
    centre = np.stack([b * e - 2 * c * d, b * d - 2 * a * e], 1) / determinant[:, None]
    return middle[:, 0] + scale[:, 0] * centre
