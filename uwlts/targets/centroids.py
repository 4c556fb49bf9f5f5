"""Sub-pixel centres of elliptic blobs from the grey area within their edge."""

import numpy as np
from scipy.spatial import cKDTree

from uwlts.targets.edges import PROFILES, REACH_OVER_MINOR_AXIS, rim_directions, sample

PASSES = 2

# The edge of Gaussian blur s has the slope 0.4 / s over its contrast; 1.2 / slope is therefore three s.
REACH_TIMES_SLOPE = 1.2
MIN_REACH_PX = 2.5
MAX_REACH_PX = 8.0


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
    (N, 2) float64, px, (u, v)
    """
    centres = ellipses.centres.copy()
    if len(centres) == 0:
        return centres
    wanted, *reaches = _reaches(grey.shape, ellipses)
    for _ in range(PASSES):
        planes = _level_planes(grey, centres, ellipses.shapes, reaches, wanted)
        centres = _centroids(grey, centres, ellipses.shapes, reaches, planes)
    return centres


def _reaches(shape, ellipses):
    """How far the band should extend, and extends inwards and outwards from each ellipse, three times (N,), px."""
    semi_axes = np.linalg.eigvalsh(ellipses.shapes)
    wanted = np.clip(REACH_TIMES_SLOPE / np.maximum(ellipses.sharpness, 0.1), MIN_REACH_PX, MAX_REACH_PX)
    inner = np.minimum(wanted, REACH_OVER_MINOR_AXIS * semi_axes[:, 0])
    outer = wanted
    if len(ellipses) > 1:
        distance, index = cKDTree(ellipses.centres).query(ellipses.centres, k=2)
        gap = distance[:, 1] - semi_axes[:, 1] - semi_axes[index[:, 1], 1]
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
    inner_reach, outer_reach = reaches
    half_width = np.sqrt((shapes**2).sum(2)) + outer_reach[:, None]
    low = np.maximum(np.floor(centres - half_width).astype(int), 0)
    high = np.minimum(np.ceil(centres + half_width).astype(int), np.array(grey.shape[::-1]) - 1)
    size = high - low + 1
    count = size.prod(1)
    blob = np.repeat(np.arange(len(centres)), count)
    position = np.arange(count.sum()) - np.repeat(np.cumsum(count) - count, count)
    row, column = np.divmod(position, size[blob, 0])
    u, v = low[blob, 0] + column, low[blob, 1] + row
    du, dv = u - centres[blob, 0], v - centres[blob, 1]
    inverse = np.linalg.inv(shapes)[blob]
    x = inverse[:, 0, 0] * du + inverse[:, 0, 1] * dv
    y = inverse[:, 0, 1] * du + inverse[:, 1, 1] * dv
    radius = np.hypot(x, y)
    # First-order distance from the ellipse: (|x| - 1) / |gradient of |x||.
    steepness = np.hypot(inverse[:, 0, 0] * x + inverse[:, 0, 1] * y, inverse[:, 0, 1] * x + inverse[:, 1, 1] * y)
    distance = (radius - 1) * radius / np.maximum(steepness, 1e-9)
    share = np.where(distance < 0, 1.0, 0.0)
    band = (distance > -inner_reach[blob]) & (distance < outer_reach[blob])
    of = blob[band]
    inside, outside = (planes[of, side, 0] + planes[of, side, 1] * du[band] + planes[of, side, 2] * dv[band]
                       for side in (0, 1))
    share[band] = (grey[v[band], u[band]] - outside) / (inside - outside)
    area = np.bincount(blob, share)
    return centres + np.stack([np.bincount(blob, share * du), np.bincount(blob, share * dv)], 1) / area[:, None]
