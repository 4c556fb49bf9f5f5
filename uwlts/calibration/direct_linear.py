"""Direct linear transform: a projection matrix from points in space, taken apart into camera and pose."""

from dataclasses import dataclass

import numpy as np

from uwlts.errors import CalibrationError

# Coordinates of size one: a direction in which points extend less than this share of the widest one, or a null vector
# of the equations that is not alone by this share, cannot be told from rounding and lens distortion.
_FLAT = 1e-4
_AMBIGUOUS = 1e-9


@dataclass(frozen=True, eq=False)
class LinearCamera:
    """Camera matrix K (3, 3), rotation (3, 3) and translation (3,) in mm from the points' frame to the camera's."""

    matrix: np.ndarray
    rotation: np.ndarray
    translation_mm: np.ndarray


def direct_linear(points_mm: np.ndarray, pixels: np.ndarray) -> LinearCamera:
    """Pinhole camera from at least six points in space, by the normalised linear method without lens distortion.

    Hartley and Zisserman, Multiple View Geometry, 2nd ed., algorithm 7.1 (linear part) and section 6.2.4 (RQ).

    Parameters
    ----------
    points_mm : (N, 3), mm, any frame
    pixels : (N, 2), px

    Raises
    ------
    CalibrationError
        The points lie in one plane or are too few, or the image is mirrored against them.
    """
    if len(points_mm) < 6:
        raise CalibrationError(f"the linear start needs at least 6 target points; there are {len(points_mm)}")
    to_unit, unit = _normalised(points_mm)
    pixel_to_unit, unit_pixels = _normalised(pixels)
    extents = np.linalg.svd(unit[:, :3], compute_uv=False)
    if extents[2] < _FLAT * extents[0]:
        raise CalibrationError(
            "all target points lie in one plane: move the stage between the target images, or use poses='free' with a "
            "tilted target"
        )
    nothing = np.zeros_like(unit)
    u, v = unit_pixels[:, :1], unit_pixels[:, 1:2]
    equations = np.vstack([np.hstack([unit, nothing, -u * unit]), np.hstack([nothing, unit, -v * unit])])
    # The triangular factor has the equations' singular values and is only 12 x 12.
    _, singular, rows = np.linalg.svd(np.linalg.qr(equations, mode="r"))
    if singular[10] < _AMBIGUOUS * singular[0]:
        raise CalibrationError("the target points do not determine the camera: use more points, spread over the image")
    projection = np.linalg.solve(pixel_to_unit, rows[11].reshape(3, 4)) @ to_unit
    return _taken_apart(projection, points_mm)


def _normalised(coordinates: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Similarity (D + 1, D + 1) to centroid zero and rms distance sqrt(D), and the homogeneous result (N, D + 1)."""
    dimension = coordinates.shape[1]
    centroid = coordinates.mean(axis=0)
    spread = np.sqrt(np.mean(np.sum((coordinates - centroid) ** 2, axis=1)))
    if not spread > 0:
        raise CalibrationError("all target points fall on one place: is the target detected at all?")
    similarity = np.eye(dimension + 1) * np.sqrt(dimension) / spread
    similarity[:-1, -1] = -centroid * np.sqrt(dimension) / spread
    similarity[-1, -1] = 1.0
    return similarity, np.column_stack([coordinates, np.ones(len(coordinates))]) @ similarity.T


def _taken_apart(projection: np.ndarray, points_mm: np.ndarray) -> LinearCamera:
    depths = points_mm @ projection[2, :3] + projection[2, 3]
    if np.median(depths) < 0:
        projection = -projection
    if np.linalg.det(projection[:, :3]) < 0:
        raise CalibrationError(
            "the target images are mirrored against the stage positions: the stage moved the other way than "
            "stage_direction says, or the target's columns or rows are numbered the wrong way round"
        )
    # RQ from QR of the rows in reverse order; the signs make the camera matrix's diagonal positive.
    orthogonal, triangular = np.linalg.qr(projection[::-1, :3].T)
    matrix, rotation = triangular.T[::-1, ::-1], orthogonal.T[::-1]
    signs = np.sign(np.diag(matrix))
    matrix, rotation = matrix * signs, signs[:, None] * rotation
    translation = np.linalg.solve(matrix, projection[:, 3])
    return LinearCamera(matrix / matrix[2, 2], rotation, translation)
