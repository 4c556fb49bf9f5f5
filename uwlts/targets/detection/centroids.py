"""Sub-pixel centres of elliptic blobs from the grey area within their edge."""

import numpy as np
from scipy.spatial import KDTree

from uwlts.targets.detection.ellipses import REACH_OVER_MINOR_AXIS, rim_directions, sample

PASSES = 2

# The edge of Gaussian blur s has the slope 0.4 / s over its contrast; 1.2 / slope is therefore three s.
REACH_TIMES_SLOPE = 1.2
MIN_REACH_PX = 2.5
MAX_REACH_PX = 8.0

MIN_RELATIVE_CONTRAST = 0.25

# A centroid further from the ellipse's centre than this has something other than a circle in its band.
MAX_SHIFT_PX = 0.5


def area_centroids(grey, ellipses):
    """Centroids of the areas that ellipses cover, with the pixels of the edge counted by their share.

    A pixel in the band around the ellipse counts by (I - outside) / (inside - outside), the share of it that the blob
    covers; a pixel further in counts whole and one further out not at all. Blur and the pixel's own area spread that
    share without moving its centroid, which is why this is less biased than an ellipse through points of the edge.
    Inside and outside levels are planes, so that shading does not pull the centre, and what lies deep inside (a mark)
    has no influence.

    Parameters
    ----------
    grey : (H, W) float32, grey levels
    ellipses : Ellipses
        Fitted to the edges; supplies band and start.

    Returns
    -------
    centres : (N, 2) float64, px, (u, v)
    agree : (N,) bool
        Whether the centroid is next to the ellipse's centre; where not, the ellipse's centre is given.
    """
    centres, agree = ellipses.centres.copy(), np.ones(len(ellipses), bool)
    if len(ellipses) == 0:
        return centres, agree
    wanted, *reaches = _reaches(grey.shape, ellipses)
    for _ in range(PASSES):
        planes = _level_planes(grey, centres, ellipses.shapes, reaches, wanted)
        moved = _centroids(grey, centres, ellipses.shapes, reaches, planes)
        agree &= np.linalg.norm(moved - ellipses.centres, axis=1) < MAX_SHIFT_PX
        centres = np.where(agree[:, None], moved, ellipses.centres)
    return centres, agree


def _reaches(shape, ellipses):
    """How far the band should extend, and extends inwards and outwards from each ellipse, three times (N,), px."""
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
    return wanted, inner, np.minimum(outer, np.maximum(room, 0.5))


def _level_planes(grey, centres, shapes, reaches, wanted):
    """Inside and outside level of each blob: (N, 2, 3), value at the centre and slopes along u and v per px."""
    directions = rim_directions()
    normals = directions @ np.linalg.inv(shapes)
    normals /= np.linalg.norm(normals, axis=2, keepdims=True)
    rim = directions @ shapes
    planes = np.zeros((len(centres), 2, 3))
    for side, reach in enumerate((-reaches[0], reaches[1])):
        offsets = rim + normals * reach[:, None, None]
        levels = sample(grey, centres[:, None] + offsets)
        planes[:, side, 0] = levels.mean(1)
        spread = offsets.swapaxes(1, 2) @ offsets
        slopes = np.linalg.solve(spread, offsets.swapaxes(1, 2) @ levels[:, :, None])[:, :, 0]
        # Levels read within the edge itself slope with the error of the centre, not with the shading. The pull of
        # shading grows with the square of the radius and is small where there is no room beyond the edge.
        planes[:, side, 1:] = np.where((np.abs(reach) < wanted)[:, None], 0.0, slopes)
    return planes


def _centroids(grey, centres, shapes, reaches, planes):
    widest = shapes + np.eye(2) * reaches[1][:, None, None]
    blob, v, outer, inner = _row_runs(centres, shapes - np.eye(2) * reaches[0][:, None, None], widest)
    # Pixels further in than the band, a run per row: their number and the sums of their coordinates.
    whole = np.maximum(inner[1] - inner[0] + 1, 0)
    area = np.bincount(blob, whole, len(centres))
    sum_u = np.bincount(blob, whole * ((inner[0] + inner[1]) / 2 - centres[blob, 0]), len(centres))
    sum_v = np.bincount(blob, whole * (v - centres[blob, 1]), len(centres))
    # Pixels of the band: the rest of the outer run, to the left and to the right of the inner one.
    starts = np.concatenate([outer[0], np.maximum(inner[1] + 1, inner[0])])
    lengths = np.maximum(np.concatenate([inner[0] - outer[0], outer[1] + 1 - starts[len(blob) :]]), 0)
    total = int(lengths.sum())
    u = np.arange(total) - np.repeat(np.cumsum(lengths) - lengths - starts, lengths)
    v, blob = np.repeat(np.tile(v, 2), lengths), np.repeat(np.tile(blob, 2), lengths)
    du, dv = u - centres[blob, 0], v - centres[blob, 1]
    inside, outside = (
        value[blob] + slope_u[blob] * du + slope_v[blob] * dv
        for value, slope_u, slope_v in (planes[:, side].T for side in (0, 1))
    )
    contrast = (planes[:, 0, 0] - planes[:, 1, 0])[blob]
    # Planes that meet within the band belong to no circle; their share stays finite, and the centre shows it.
    relative = np.maximum((inside - outside) / contrast, MIN_RELATIVE_CONTRAST)
    share = (grey[v, u] - outside) / (relative * contrast)
    area += np.bincount(blob, share, len(centres))
    sum_u += np.bincount(blob, share * du, len(centres))
    sum_v += np.bincount(blob, share * dv, len(centres))
    return centres + np.stack([sum_u, sum_v], 1) / area[:, None]


def _row_runs(centres, inner_shapes, outer_shapes):
    """Rows of pixels that ellipses cover: blob (R,), v (R,), first and last u within the outer and the inner ellipse.

    A row that misses the inner ellipse has an empty inner run, which starts after the end of the outer one.
    """
    half_height = np.linalg.norm(outer_shapes[:, 1], axis=1)
    top = np.ceil(centres[:, 1] - half_height).astype(int)
    count = np.floor(centres[:, 1] + half_height).astype(int) - top + 1
    blob = np.repeat(np.arange(len(centres)), count)
    v = np.arange(count.sum()) - np.repeat(np.cumsum(count) - count - top, count)
    dv = v - centres[blob, 1]
    runs = []
    for shapes in (outer_shapes, inner_shapes):
        # x' Q x = 1 with Q = shape^-2, solved for u.
        inverse = np.linalg.inv(shapes)
        quadratic = (inverse @ inverse)[blob]
        mixed = quadratic[:, 0, 1] * dv
        root = mixed**2 - quadratic[:, 0, 0] * (quadratic[:, 1, 1] * dv**2 - 1)
        half = np.sqrt(np.maximum(root, 0.0)) / quadratic[:, 0, 0]
        middle = centres[blob, 0] - mixed / quadratic[:, 0, 0]
        first, last = np.ceil(middle - half).astype(int), np.floor(middle + half).astype(int)
        runs.append((first, last, (root > 0) & (first <= last)))
    (first, last, covered), (inner_first, inner_last, inner_covered) = runs
    empty = last + 1
    inner = np.where(inner_covered, inner_first, empty), np.where(inner_covered, inner_last, empty - 1)
    return blob[covered], v[covered], (first[covered], last[covered]), (inner[0][covered], inner[1][covered])
