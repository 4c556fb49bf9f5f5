"""Sub-pixel ellipses through the grey-level edges of blobs."""

from dataclasses import dataclass

import numpy as np

from uwlts.targets.detection.blobs import noise_level

# Profiles around a blob, and samples on each.
PROFILES = 48
SAMPLES = 11
PASSES = 2

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
class Ellipses:
    """Ellipses fitted to the edges of blobs.

    Attributes
    ----------
    centres : (N, 2) float64, px, (u, v)
    shapes : (N, 2, 2) float64, px, symmetric positive; ``centre + shape @ (cos t, sin t)`` is the ellipse
    residual_px : (N,) float64, rms distance of the edge points from the ellipse
    contrast : (N,) float64, grey levels, inside minus outside
    sharpness : (N,) float64, 1/px, slope of the edge over its contrast
    bright : whether the blobs are brighter than their surroundings
    """

    centres: np.ndarray
    shapes: np.ndarray
    residual_px: np.ndarray
    contrast: np.ndarray
    sharpness: np.ndarray
    bright: bool

    def __len__(self):
        return len(self.centres)

    def __getitem__(self, select):
        return Ellipses(
            self.centres[select],
            self.shapes[select],
            self.residual_px[select],
            self.contrast[select],
            self.sharpness[select],
            self.bright,
        )


def fit_ellipses(image, blobs):
    """Fit ellipses to the edges of blobs and keep those that are ellipses.

    The edge is where the grey level passes half-way between inside and outside, sampled along normals of the current
    ellipse. Both levels follow a constant and a first harmonic around the blob, so that shading does not shift the
    centre. The distance along the normal is linear in a small change of centre and shape, which gives the orthogonal
    least-squares fit after a few passes. Blobs cut by a stripe, a scratch or the plate's edge show a large residual or
    an uneven contrast and are left out; nothing is downweighted. Where the image is out of focus, the edge is sampled
    over a longer distance.

    Parameters
    ----------
    image : (H, W) uint8 or uint16
    blobs : Blobs

    Returns
    -------
    Ellipses
        Fitted and accepted, possibly none.
    """
    grey = image.astype(np.float32)
    noise = max(noise_level(grey), 0.5)
    best = _fitted(grey, blobs, REACHES_PX[0], noise)
    for reach in REACHES_PX[1:]:
        if len(best) >= (1 - MISSED_SHARE) * len(blobs.centres):
            break
        best = max(best, _fitted(grey, blobs, reach, noise), key=len)
    return best


def _fitted(grey, blobs, reach, noise):
    """Ellipses of a float32 image (H, W) with edges sampled over one reach in px."""
    centres, shapes = blobs.centres, blobs.shapes
    kept, residual, edge = np.ones(len(centres), bool), np.empty(0), None
    for _ in range(PASSES):
        kept = kept & _inside(grey.shape, centres, shapes, reach)
        centres, shapes = centres[kept], shapes[kept]
        if len(centres) == 0:
            break
        edge = _edges(grey, centres, shapes, reach, bright=blobs.bright, noise=noise)
        centres, shapes, residual, fitted = _moved(centres, shapes, edge)
        kept = edge.whole & fitted & _inside(grey.shape, centres, shapes, reach)
    if edge is None or len(centres) == 0:
        empty = np.empty(0)
        return Ellipses(np.empty((0, 2)), np.empty((0, 2, 2)), empty, empty, empty, blobs.bright)
    found = Ellipses(centres, shapes, residual, edge.contrast, edge.sharpness, blobs.bright)[kept]
    radii = np.sqrt(np.linalg.det(found.shapes))
    from_noise = noise / (found.contrast * np.maximum(found.sharpness, MIN_SHARPNESS_TIMES_REACH / reach))
    limit = np.maximum(MAX_RESIDUAL_OVER_REACH * reach, MAX_RESIDUAL_OVER_RADIUS * radii)
    round_enough = found.residual_px <= np.maximum(limit, MAX_RESIDUAL_OVER_NOISE * from_noise)
    if round_enough.any():
        usual = np.median(found.residual_px[round_enough])
        round_enough &= found.residual_px <= max(RESIDUAL_FLOOR_PX, MAX_RESIDUAL_OVER_MEDIAN * usual)
    return found[round_enough]


@dataclass(frozen=True)
class _Edges:
    directions: np.ndarray
    normals: np.ndarray
    distance: np.ndarray
    contrast: np.ndarray
    sharpness: np.ndarray
    whole: np.ndarray


def _inside(shape, centres, shapes, reach):
    """Whether the profiles of ellipses stay within the image, (N,) bool."""
    half_width = np.sqrt((shapes**2).sum(2)) + reach
    limit = np.array([shape[1], shape[0]]) - 1.001
    return (centres - half_width >= 0).all(1) & (centres + half_width <= limit).all(1)


def _edges(grey, centres, shapes, longest, *, bright, noise):
    directions = rim_directions()
    rim = centres[:, None] + directions @ shapes
    normals = directions @ np.linalg.inv(shapes)
    normals /= np.linalg.norm(normals, axis=2, keepdims=True)
    reach = np.minimum(longest, REACH_OVER_MINOR_AXIS * np.linalg.eigvalsh(shapes)[:, 0])
    offsets = np.linspace(-1, 1, SAMPLES)
    steps = reach[:, None] * offsets
    profiles = sample(grey, rim[:, :, None] + normals[:, :, None] * steps[:, None, :, None])
    if not bright:
        profiles = -profiles
    inner, outer = profiles[:, :, :2].mean(2), profiles[:, :, -2:].mean(2)
    harmonics = np.stack([np.ones(PROFILES), *directions.T], 1)
    smoother = harmonics @ np.linalg.pinv(harmonics)
    inner_level, outer_level = inner @ smoother, outer @ smoother
    contrast = inner_level - outer_level
    departure = np.abs(inner - outer - contrast)
    share = np.where(reach < longest, MAX_CONTRAST_DEPARTURE_IF_SMALL, MAX_CONTRAST_DEPARTURE)
    whole = (contrast > 0).all(1) & (departure <= np.maximum(share[:, None] * contrast, 6 * noise)).all(1)
    excess = profiles - (inner_level + outer_level)[:, :, None] / 2
    distance, crossed = _crossing(excess)
    middle = SAMPLES // 2
    slope = (profiles[:, :, middle - 2] - profiles[:, :, middle + 2]).mean(1) / (8 * reach / (SAMPLES - 1))
    mean_contrast = contrast.mean(1)
    sharpness = slope / np.where(whole, mean_contrast, 1.0)
    return _Edges(directions, normals, distance * reach[:, None], mean_contrast, sharpness, whole & crossed)


def _crossing(excess):
    """Where profiles (N, P, S) fall through zero nearest their middle, from -1 to 1, and whether all N x P do."""
    falls = (excess[:, :, :-1] > 0) & (excess[:, :, 1:] <= 0)
    from_middle = np.abs(np.arange(SAMPLES - 1) - (SAMPLES - 2) / 2)
    first = np.where(falls, from_middle, np.inf).argmin(2)
    before = np.take_along_axis(excess, first[:, :, None], 2)[:, :, 0]
    after = np.take_along_axis(excess, first[:, :, None] + 1, 2)[:, :, 0]
    crossed = falls.any(2)
    share = np.where(crossed, before / np.where(crossed, before - after, 1.0), 0.5)
    return 2 * (first + share) / (SAMPLES - 1) - 1, crossed.all(1)


def _moved(centres, shapes, edge):
    """Least-squares change of centre and shape for the distances along the normals, and the rms residual."""
    n, e = edge.normals, edge.directions
    design = np.stack(
        [n[..., 0], n[..., 1], n[..., 0] * e[:, 0], n[..., 0] * e[:, 1] + n[..., 1] * e[:, 0], n[..., 1] * e[:, 1]], 2
    )
    normal = design.swapaxes(1, 2) @ design
    change = np.linalg.solve(normal, design.swapaxes(1, 2) @ edge.distance[:, :, None])
    residual = edge.distance - (design @ change)[:, :, 0]
    change = change[:, :, 0]
    shapes = shapes + change[:, [2, 3, 3, 4]].reshape(-1, 2, 2)
    values = np.linalg.eigvalsh(shapes)
    fitted = values[:, 0] > 1.0
    rms = np.sqrt((residual**2).sum(1) / (PROFILES - 5))
    return centres + change[:, :2], shapes, rms, fitted


def rim_directions():
    """Unit vectors (PROFILES, 2) that an ellipse's shape matrix maps to points of its rim."""
    angle = np.arange(PROFILES) * (2 * np.pi / PROFILES)
    return np.stack([np.cos(angle), np.sin(angle)], 1)


def sample(grey, points):
    """Bilinear grey values (...) at pixel positions (..., 2), which must lie inside the image."""
    width = grey.shape[1]
    whole = points.astype(np.int32)
    part = (points - whole).astype(np.float32)
    index = whole[..., 1] * width + whole[..., 0]
    flat = grey.reshape(-1)
    du, dv = part[..., 0], part[..., 1]
    top = flat[index] * (1 - du) + flat[index + 1] * du
    bottom = flat[index + width] * (1 - du) + flat[index + width + 1] * du
    return top * (1 - dv) + bottom * dv
