"""Uncertainty of points by the poses of their images, and along a corrected path."""

from __future__ import annotations

import numpy as np
from scipy.spatial.transform import Rotation

from uwlts.runtime.compiled import compiled
from uwlts.storage.cloud import PointUncertainty, turned_pairs

_MOST_SHAPES = 12
"""Shapes along the path; what they leave counts as independent from image to image."""
_LEFT = 0.01
"""Share of the variance that may be left to that."""
_SAMPLE = 1500
"""Points by which the shapes are chosen."""
_BLOCK = 50_000


def moved_by_poses(
    errors: np.ndarray, image: np.ndarray, levers_mm: np.ndarray, *, after: np.ndarray | None = None
) -> np.ndarray:
    """Motions (K, N, 3) float32 of points by K errors (F, 6, K) of the poses of F images, shift (mm) and turn (rad).

    ``image`` (N,) is that of each point, ``levers_mm`` (N, 3) its place from the platform along the base's axes. With
    others, ``after`` (M, N, 3), the result (M + K, N, 3) begins with these.
    """
    first = 0 if after is None else len(after)
    moved = np.empty((first + errors.shape[2], len(image), 3), np.float32)
    if after is not None:
        moved[:first] = after
    by_image = np.ascontiguousarray(errors.transpose(0, 2, 1), dtype=float)
    _move_by_poses(by_image, image.astype(np.int64), np.ascontiguousarray(levers_mm, dtype=float), moved[first:])
    return moved


@compiled
def _move_by_poses(errors: np.ndarray, image: np.ndarray, levers: np.ndarray, moved: np.ndarray) -> None:
    """Fill the motions (K, N, 3) by errors (F, K, 6); points of one image after the other are the fastest."""
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


def sampled(count: int, most: int = _SAMPLE) -> np.ndarray:
    """Numbers of some of so many, evenly: points by which errors of poses are weighed, or moments."""
    return np.linspace(0, count - 1, min(most, count)).astype(int)


def chief_parts(moved: np.ndarray, *, left: float = 0.0, left_mm: float = 0.0, most: int | None = None) -> np.ndarray:
    """Weights (K, C) for the fewest independent sums of K motions (K, N, 3) that hold nearly all of them.

    They leave no more than a share ``left`` of the variance, or ``left_mm`` root mean square; at ``most`` so many.
    """
    flat = moved.reshape(len(moved), -1).astype(float)
    strengths, ways = np.linalg.eigh(flat @ flat.T)
    strengths, ways = np.maximum(strengths[::-1], 0.0), ways[:, ::-1]
    missing = np.append(np.cumsum(strengths[::-1])[::-1][1:], 0.0)
    count = 1 + int(np.argmax(missing <= max(left * strengths.sum(), left_mm**2 * moved.shape[1])))
    return np.ascontiguousarray(ways[:, :most][:, :count])


def pose_roots(covariances: np.ndarray) -> np.ndarray:
    """Symmetric roots (F, 6, 6), which change as slowly along a path as the covariances do; 0 where one is NaN."""
    known = np.where(np.isfinite(covariances).all(axis=(1, 2), keepdims=True), covariances, 0.0)
    # Rotations are far smaller numbers than shifts: scaled, so that none is lost.
    sizes = np.sqrt(np.maximum(np.einsum("nii->ni", known), 1e-30))
    values, vectors = np.linalg.eigh(known / (sizes[:, :, None] * sizes[:, None]))
    root = (vectors * np.sqrt(np.maximum(values, 0.0))[:, None]) @ np.swapaxes(vectors, 1, 2)
    return sizes[:, :, None] * root


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

    some = sampled(len(image))
    by_pose = np.einsum("nc,cik->kni", basis[image[some]], root, optimize=True)
    by_pose = by_pose[:, :, :3] + np.cross(by_pose[:, :, 3:], levers_mm[some])
    shapes = np.einsum("fc,cik->fik", basis, root @ chief_parts(by_pose, left=_LEFT, most=_MOST_SHAPES), optimize=True)
    rest = pose_roots(poses - shapes @ shapes.transpose(0, 2, 1))
    # As few patterns as before that consist of the parts of sensor and mount alone.
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
        random[here] = turned_pairs(known.random_mm2[here], matrices)
        position[here] = np.einsum("nij,nj->ni", matrices, known.position_mm[here])
        own[:, here] = np.einsum("nij,knj->kni", matrices, np.tensordot(mixing, known.patterns_mm[:, here], axes=1))
    patterns = moved_by_poses(shapes, image, levers_mm, after=own)
    shared, first = {}, 0
    for name in names:
        last = first + known.shared[name].shape[1]
        shared[name] = np.vstack([factors[first:last].T, np.zeros((shapes.shape[2], last - first))])
        first = last
    return PointUncertainty(random, position, patterns, moved_by_poses(rest, image, levers_mm), shared)
