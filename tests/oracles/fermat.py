"""Rays through flat faces by Fermat's principle: light takes the path of least optical length.

No law of refraction is used. A path from A to B is straight between faces. Its optical length, the sum of
``index * length``, is a convex function of the crossings, so Newton's method finds the only minimum.
"""

from dataclasses import dataclass

import numpy as np


@dataclass(frozen=True)
class Face:
    """A plane through ``point`` (3,) with unit normal (3,)."""

    point: np.ndarray
    normal: np.ndarray

    def basis(self) -> np.ndarray:
        """Two orthonormal directions in the plane, (3, 2)."""
        helper = np.eye(3)[np.argmin(np.abs(self.normal))]
        first = np.cross(self.normal, helper)
        first /= np.linalg.norm(first)
        return np.stack([first, np.cross(self.normal, first)], axis=1)


def plate(*, distance: float, thickness: float, normal: np.ndarray) -> list[Face]:
    """The two faces of a plate whose inner face passes through (0, 0, distance)."""
    inner = np.array([0.0, 0.0, distance])
    return [Face(inner, normal), Face(inner + thickness * normal, normal)]


def least_time_crossings(start: np.ndarray, ends: np.ndarray, faces: list[Face], indices: list[float]) -> np.ndarray:
    """Return the crossings (N, K, 3) of K faces by light from ``start`` (3,) to each of ``ends`` (N, 3).

    ``indices`` are the K + 1 refractive indices along the path. The straight line is the first guess.
    """
    bases = [face.basis() for face in faces]
    spread = np.zeros((3 * len(faces), 2 * len(faces)))
    for k, basis in enumerate(bases):
        spread[3 * k : 3 * k + 3, 2 * k : 2 * k + 2] = basis
    line = ends - start
    guess = [start + line * (((f.point - start) @ f.normal) / (line @ f.normal))[:, None] for f in faces]
    crossings = np.stack(guess, axis=1)
    for _ in range(100):
        gradient, hessian = _derivatives(start, ends, crossings, indices)
        step = -np.linalg.solve(spread.T @ hessian @ spread, (gradient @ spread)[..., None])[..., 0]
        move = (step @ spread.T).reshape(crossings.shape)
        crossings = crossings + _useful_share(start, ends, crossings, move, indices)[:, None, None] * move
        if np.abs(move).max() < 1e-10:
            return crossings  # the error left is of the order of this move's square
    raise ArithmeticError(f"the path of least time was not found: last move {np.abs(move).max():g} mm")


def directions_seen(ends: np.ndarray, faces: list[Face], indices: list[float]) -> np.ndarray:
    """Return the unit directions (N, 3) at a pupil at the origin of light from the points (N, 3)."""
    first = least_time_crossings(np.zeros(3), ends, faces, indices)[:, 0]
    return first / np.linalg.norm(first, axis=1, keepdims=True)


def points_seen_on_plane(
    directions: np.ndarray, plane: Face, first_guess: np.ndarray, faces: list[Face], indices: list[float]
) -> np.ndarray:
    """Return the points (N, 3) of a plane that a pupil at the origin sees in the given directions (N, 3).

    A search moves each point in the plane until the path of least time leaves the pupil in the given direction.
    ``first_guess`` (N, 3) are points of the plane beyond the last face.
    """
    basis, reach = plane.basis(), 1e-3
    across = _two_across(directions)

    def miss(points: np.ndarray) -> np.ndarray:
        return np.einsum("nij,nj->ni", across, directions_seen(points, faces, indices))

    points = np.array(first_guess)
    for _ in range(100):
        missing = miss(points)
        columns = [(miss(points + reach * axis) - miss(points - reach * axis)) / (2 * reach) for axis in basis.T]
        move = -np.linalg.solve(np.stack(columns, axis=2), missing[..., None])[..., 0] @ basis.T
        points = points + move
        if np.abs(move).max() < 3e-11:
            return points
    raise ArithmeticError(f"the point seen was not found: last move {np.abs(move).max():g} mm")


def _two_across(directions: np.ndarray) -> np.ndarray:
    """Two orthonormal vectors across each direction, (N, 2, 3)."""
    helper = np.where(np.abs(directions[:, :1]) < 0.6, [[1.0, 0.0, 0.0]], [[0.0, 1.0, 0.0]])
    first = np.cross(directions, helper)
    first /= np.linalg.norm(first, axis=1, keepdims=True)
    return np.stack([first, np.cross(directions, first)], axis=1)


def _legs(start: np.ndarray, ends: np.ndarray, crossings: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Unit vectors (N, K + 1, 3) and lengths (N, K + 1) of a path's straight parts."""
    first = np.broadcast_to(start, ends.shape)[:, None]
    legs = np.diff(np.concatenate([first, crossings, ends[:, None]], axis=1), axis=1)
    lengths = np.linalg.norm(legs, axis=2)
    return legs / lengths[..., None], lengths


def _derivatives(
    start: np.ndarray, ends: np.ndarray, crossings: np.ndarray, indices: list[float]
) -> tuple[np.ndarray, np.ndarray]:
    """Gradient (N, 3 K) and Hessian (N, 3 K, 3 K) of the optical length to free crossings."""
    units, lengths = _legs(start, ends, crossings)
    count, last = len(ends), crossings.shape[1]
    gradient = np.zeros((count, last, 3))
    hessian = np.zeros((count, last, 3, last, 3))
    for leg, index in enumerate(indices):
        unit = units[:, leg]
        bend = index * (np.eye(3) - unit[:, :, None] * unit[:, None, :]) / lengths[:, leg, None, None]
        for k, sign in ((leg, 1.0), (leg - 1, -1.0)):
            if 0 <= k < last:
                gradient[:, k] += sign * index * unit
                hessian[:, k, :, k] += bend
        if 0 < leg < last:
            hessian[:, leg, :, leg - 1] -= bend
            hessian[:, leg - 1, :, leg] -= bend
    return gradient.reshape(count, -1), hessian.reshape(count, 3 * last, 3 * last)


def _useful_share(
    start: np.ndarray, ends: np.ndarray, crossings: np.ndarray, move: np.ndarray, indices: list[float]
) -> np.ndarray:
    """Return the largest of the factors 1, 1/2, 1/4 ... (N,) of the step that does not lengthen the path (rounded)."""

    def optical_length(share: np.ndarray) -> np.ndarray:
        return _legs(start, ends, crossings + share[:, None, None] * move)[1] @ np.asarray(indices)

    share = np.ones(len(ends))
    present = optical_length(np.zeros(len(ends)))
    for _ in range(30):
        longer = optical_length(share) > present * (1 + 1e-14)
        if not longer.any():
            break
        share[longer] /= 2
    return share
