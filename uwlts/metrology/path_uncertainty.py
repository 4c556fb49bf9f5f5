"""Uncertainty of points along a corrected path: of sensor and mount as before, and of the corrected poses."""

from __future__ import annotations

import numpy as np
from scipy.spatial.transform import Rotation

from uwlts.storage.cloud import PAIRS, PointUncertainty

_MOST_SHAPES = 12
"""Shapes along the path; what they leave counts as independent from image to image."""
_LEFT = 0.01
"""Share of the variance that may be left to that."""
_SAMPLE = 1500
"""Points by which the shapes are chosen."""
_BLOCK = 50_000


def along_corrected_path(
    known: PointUncertainty,
    turns: np.ndarray,
    levers_mm: np.ndarray,
    image: np.ndarray,
    basis: np.ndarray,
    covariance: np.ndarray,
    poses: np.ndarray,
) -> PointUncertainty:
    """Uncertainty of N points after a correction of the path's poses, in place of that by the navigation.

    What they have by the calibrations of sensor and mount (``shared`` of ``known``) stays and turns with them, and so
    does their noise; all else was the navigation's and goes. The correction is a shift (mm) and a turn (rad) about the
    platform: the C coefficients of ``covariance`` (6 C, 6 C) with the weights ``basis`` (F, C) at the F images. What
    the covariances ``poses`` (F, 6, 6) of these have besides is independent from image to image.

    Parameters
    ----------
    turns, levers_mm : (N, 3)
        Rotation vectors by which the points were turned, rad, and where they lie from the platform then.
    image : (N,) int
        Row of the weights of each point.
    """
    values, vectors = np.linalg.eigh(covariance)
    root = (vectors * np.sqrt(np.maximum(values, 0.0))).reshape(-1, 6, len(values))

    def moved(by_image: np.ndarray, here: slice | np.ndarray) -> np.ndarray:
        """Motion (K, n, 3) of points where the poses of all images move by (F, 6, K)."""
        by = np.moveaxis(by_image[image[here]], 2, 0)
        return by[:, :, :3] + np.cross(by[:, :, 3:], levers_mm[here])

    some = np.linspace(0, len(image) - 1, min(_SAMPLE, len(image))).astype(int)
    by_pose = np.einsum("nc,cik->kni", basis[image[some]], root, optimize=True)
    flat = (by_pose[:, :, :3] + np.cross(by_pose[:, :, 3:], levers_mm[some])).reshape(len(values), -1)
    strengths, ways = np.linalg.eigh(flat @ flat.T)
    strengths, ways = np.maximum(strengths[::-1], 0.0), ways[:, ::-1]
    left = 1 - np.cumsum(strengths) / max(strengths.sum(), 1e-300)
    count = min(1 + int(np.argmax(left <= _LEFT)), _MOST_SHAPES)
    shapes = np.einsum("fc,cik->fik", basis, root @ ways[:, :count], optimize=True)
    variances, axes = np.linalg.eigh(poses - shapes @ shapes.transpose(0, 2, 1))
    rest = axes * np.sqrt(np.maximum(variances, 0.0))[:, None]
    # As few patterns as before that consist of the parts of sensor and mount alone.
    names = list(known.shared)
    parts = np.vstack([known.shared[name].T for name in names]) if names else np.zeros((0, len(known.patterns_mm)))
    factors, sizes, rows = np.linalg.svd(parts, full_matrices=False)
    kept = sizes > 1e-6
    mixing, factors = sizes[kept, None] * rows[kept], factors[:, kept]
    random, position = np.empty_like(known.random_mm2), np.empty_like(known.position_mm)
    patterns = np.empty((len(mixing) + count, len(image), 3), np.float32)
    poses = np.empty((6, len(image), 3), np.float32)
    for start in range(0, len(image), _BLOCK):
        here = slice(start, start + _BLOCK)
        matrices = Rotation.from_rotvec(turns[here]).as_matrix()
        full = np.empty((len(matrices), 3, 3))
        for column, (i, j) in enumerate(PAIRS):
            full[:, i, j] = full[:, j, i] = known.random_mm2[here, column]
        full = matrices @ full @ matrices.transpose(0, 2, 1)
        random[here] = np.stack([full[:, i, j] for i, j in PAIRS], axis=1)
        position[here] = np.einsum("nij,nj->ni", matrices, known.position_mm[here])
        own = np.tensordot(mixing, known.patterns_mm[:, here], axes=1)
        patterns[: len(mixing), here] = np.einsum("nij,knj->kni", matrices, own)
        patterns[len(mixing) :, here] = moved(shapes, here)
        poses[:, here] = moved(rest, here)
    shared, first = {}, 0
    for name in names:
        last = first + known.shared[name].shape[1]
        shared[name] = np.vstack([factors[first:last].T, np.zeros((count, last - first))])
        first = last
    return PointUncertainty(random, position, patterns, poses, shared)
