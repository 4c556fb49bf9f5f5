"""Uncertainty of points by pose errors of their images, and along a corrected path."""

from __future__ import annotations

import numpy as np
from scipy.spatial.transform import Rotation

from uwlts.runtime.compiled import compiled
from uwlts.storage.cloud import PointUncertainty, rotate_covariances

_MOST_SHAPES = 12
"""Largest number of modes along the path; the remainder counts as independent between images."""
_LEFT = 0.01
"""Largest fraction of the variance in this remainder."""
_SAMPLE = 1500
"""Number of points used to choose the modes."""
_BLOCK = 50_000  # points, to limit memory


def propagate_pose_errors(
    errors: np.ndarray, image: np.ndarray, levers_mm: np.ndarray, *, after: np.ndarray | None = None
) -> np.ndarray:
    """Return the shifts (K, N, 3) float32 of points by K pose errors, preceded by given patterns ``after`` (M, N, 3).

    ``errors`` (F, 6, K) are translations (mm) and rotations (rad) of the poses of F images, ``image`` (N,) the image of
    each point. ``levers_mm`` (N, 3) are positions relative to the platform, along the axes of the base.
    """
    first = 0 if after is None else len(after)
    moved = np.empty((first + errors.shape[2], len(image), 3), np.float32)
    if after is not None:
        moved[:first] = after
    by_image = np.ascontiguousarray(errors.transpose(0, 2, 1), dtype=float)
    _fill_shifts(by_image, image.astype(np.int64), np.ascontiguousarray(levers_mm, dtype=float), moved[first:])
    return moved


@compiled
def _fill_shifts(errors: np.ndarray, image: np.ndarray, levers: np.ndarray, moved: np.ndarray) -> None:
    """Fill the shifts (K, N, 3) by errors (F, K, 6); points sorted by image are fastest."""
    first = 0
    while first < image.size:
        end = first + 1
        while end < image.size and image[end] == image[first]:
            end += 1
        for k in range(errors.shape[1]):
            by, out = errors[image[first], k], moved[k]
            a, b, c, u, v, w = by[0], by[1], by[2], by[3], by[4], by[5]
            for n in range(first, end):
                x, y, z = levers[n, 0], levers[n, 1], levers[n, 2]
                out[n, 0], out[n, 1], out[n, 2] = a + v * z - w * y, b + w * x - u * z, c + u * y - v * x
        first = end


def sample_indices(count: int, most: int = _SAMPLE) -> np.ndarray:
    """Return at most ``most`` evenly spaced indices below ``count``."""
    return np.linspace(0, count - 1, min(most, count)).astype(int)


def principal_components(
    moved: np.ndarray, *, left: float = 0.0, left_mm: float = 0.0, most: int | None = None
) -> np.ndarray:
    """Return weights (K, C) of the principal components of K shifts (K, N, 3).

    The number of components is the smallest that omits at most the fraction ``left`` of the variance, or ``left_mm``
    root mean square, but never more than ``most``.
    """
    flat = moved.reshape(len(moved), -1).astype(float)
    strengths, ways = np.linalg.eigh(flat @ flat.T)
    strengths, ways = np.maximum(strengths[::-1], 0.0), ways[:, ::-1]
    missing = np.append(np.cumsum(strengths[::-1])[::-1][1:], 0.0)
    count = 1 + int(np.argmax(missing <= max(left * strengths.sum(), left_mm**2 * moved.shape[1])))
    return np.ascontiguousarray(ways[:, :most][:, :count])


def root_covariances(covariances: np.ndarray) -> np.ndarray:
    """Return symmetric square roots (F, 6, 6) of covariances, which vary smoothly with them; 0 for NaN."""
    known = np.where(np.isfinite(covariances).all(axis=(1, 2), keepdims=True), covariances, 0.0)
    # Scale to unit variances, because rotations are numerically far smaller than translations.
    sizes = np.sqrt(np.maximum(np.einsum("nii->ni", known), 1e-30))
    values, vectors = np.linalg.eigh(known / (sizes[:, :, None] * sizes[:, None]))
    root = (vectors * np.sqrt(np.maximum(values, 0.0))[:, None]) @ np.swapaxes(vectors, 1, 2)
    return sizes[:, :, None] * root


def correct_path_uncertainty(
    known: PointUncertainty,
    turns: np.ndarray,
    levers_mm: np.ndarray,
    image: np.ndarray,
    basis: np.ndarray,
    covariance: np.ndarray,
    poses: np.ndarray,
) -> PointUncertainty:
    """Return the uncertainty of N points after a correction of the path, which replaces that of the navigation.

    Noise and the patterns of sensor and mount calibration (``shared`` of ``known``) are kept and rotated by ``turns``
    (N, 3) in rad. All other patterns come from the navigation and are dropped. ``levers_mm`` (N, 3) are positions
    relative to the platform after the correction. ``basis`` (F, C) holds the weights of the C nodes at the F images.
    ``covariance`` (6 C, 6 C) is that of the correction at the nodes, translation (mm) and rotation (rad) about the
    platform. ``poses`` (F, 6, 6) are covariances of the corrected poses; the part beyond that of the nodes is
    independent between images.
    """
    values, vectors = np.linalg.eigh(covariance)
    root = (vectors * np.sqrt(np.maximum(values, 0.0))).reshape(-1, 6, len(values))

    some = sample_indices(len(image))
    by_pose = np.einsum("nc,cik->kni", basis[image[some]], root, optimize=True)
    by_pose = by_pose[:, :, :3] + np.cross(by_pose[:, :, 3:], levers_mm[some])
    shapes = np.einsum(
        "fc,cik->fik", basis, root @ principal_components(by_pose, left=_LEFT, most=_MOST_SHAPES), optimize=True
    )
    rest = root_covariances(poses - shapes @ shapes.transpose(0, 2, 1))
    # Compress the patterns to those that contain parts of sensor and mount.
    names = list(known.shared)
    parts = np.vstack([known.shared[name].T for name in names]) if names else np.zeros((0, len(known.patterns_mm)))
    factors, sizes, rows = np.linalg.svd(parts, full_matrices=False)
    kept = sizes > 1e-6
    mixing, factors = sizes[kept, None] * rows[kept], factors[:, kept]
    random, position = np.empty_like(known.random_mm2), np.empty_like(known.position_mm)
    own = np.empty((len(mixing), len(image), 3), np.float32)
    for start in range(0, len(image), _BLOCK):
        here = slice(start, start + _BLOCK)
        matrices = Rotation.from_rotvec(turns[here]).as_matrix()
        random[here] = rotate_covariances(known.random_mm2[here], matrices)
        position[here] = np.einsum("nij,nj->ni", matrices, known.position_mm[here])
        own[:, here] = np.einsum("nij,knj->kni", matrices, np.tensordot(mixing, known.patterns_mm[:, here], axes=1))
    patterns = propagate_pose_errors(shapes, image, levers_mm, after=own)
    shared, first = {}, 0
    for name in names:
        last = first + known.shared[name].shape[1]
        shared[name] = np.vstack([factors[first:last].T, np.zeros((shapes.shape[2], last - first))])
        first = last
    return PointUncertainty(random, position, patterns, propagate_pose_errors(rest, image, levers_mm), shared)
