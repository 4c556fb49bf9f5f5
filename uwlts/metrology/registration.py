"""Registration of a cloud to a surface: points to local planes, weighted, robust, with what stays open named."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
from scipy.spatial import KDTree
from scipy.spatial.transform import Rotation

from uwlts.metrology.least_squares import MAD_TO_STD
from uwlts.model.errors import EvaluationError

_ROUNDS = 40
_MOST_POINTS = 50_000
"""More add nothing but time."""
_OPEN_SHARE = 1e-3
"""Of the information of the best determined direction: a direction with less rests on the noise of the normals."""
_TUKEY = 4.685
"""Of Tukey's biweight, in standard deviations: 95 % efficient for normal noise."""
_STILL_MM = 1e-5
_FEWEST = 50
_NAMES = "shift along x", "shift along y", "shift along z", "turn about x", "turn about y", "turn about z"


@dataclass(frozen=True, eq=False)
class Registration:
    """Movement that brings a cloud to a surface.

    Attributes
    ----------
    transform : (4, 4) float64
        Reference from cloud, mm.
    covariance : (6, 6) float64
        Of a shift (mm), then a turn (rad) about the cloud's `middle_mm`, after the movement; of the points' noise, 0 in
        directions that are open.
    middle_mm : (3,) float64
    open_directions : tuple of str
        Movements that the surface does not tell; the cloud was not moved along them.
    rms_mm : float
        Root mean square distance of the points that count from the surface.
    points : int
        Points that count.
    """

    transform: np.ndarray
    covariance: np.ndarray
    middle_mm: np.ndarray
    open_directions: tuple[str, ...]
    rms_mm: float
    points: int

    def std_along(self, points_mm: np.ndarray, normals: np.ndarray) -> np.ndarray:
        """Standard uncertainty (N,) of the moved points (N, 3) along normals (N, 3), mm."""
        by = np.hstack([normals, np.cross(points_mm - self.middle_mm, normals)])
        return np.sqrt(np.einsum("ni,ij,nj->n", by, self.covariance, by))


def register_to_surface(
    points_mm: np.ndarray, surface_mm: np.ndarray, normals: np.ndarray, *, reach_mm: float, std_mm: np.ndarray
) -> Registration:
    """Move points (N, 3) onto a surface given by points (M, 3) with unit normals (M, 3), from where they are.

    Least squares of the distances along the normals of the nearest surface points (Chen and Medioni, Image and Vision
    Computing 10, 1992), weighted by ``std_mm`` (N,) of the points along the normal and by Tukey's biweight. Points
    farther than ``reach_mm`` from the surface do not count. What the surface does not tell, as a shift along a plane or
    a cylinder, is left as it was.

    Raises
    ------
    EvaluationError
        Fewer than 50 points lie near the surface.
    """
    every = slice(None, None, max(1, len(points_mm) // _MOST_POINTS))
    moved, std = points_mm[every].astype(np.float64), np.maximum(std_mm[every], 1e-6)
    tree, transform, middle = KDTree(surface_mm), np.eye(4), points_mm.mean(axis=0)
    size = max(float(np.sqrt(np.mean(np.sum((moved - middle) ** 2, axis=1)))), 1e-9)
    # Turns in units of the shift that they give to the usual point.
    units = np.array([1.0] * 3 + [1 / size] * 3)
    fit = _NO_FIT
    for _ in range(_ROUNDS):
        middle = (transform @ np.append(points_mm.mean(axis=0), 1.0))[:3]
        found: Any = tree.query(moved, distance_upper_bound=reach_mm, workers=-1)
        away, nearest = found
        near = np.isfinite(away)
        if np.count_nonzero(near) < _FEWEST:
            raise EvaluationError(
                f"{np.count_nonzero(near)} of {len(moved)} points lie within {reach_mm:g} mm of the reference; at "
                f"least {_FEWEST} are needed: do both have the same frame and unit?"
            )
        normal = normals[nearest[near]]
        left = np.einsum("ni,ni->n", moved[near] - surface_mm[nearest[near]], normal)
        fit = _fitted(np.hstack([normal, np.cross(moved[near] - middle, normal)]) * units, left, std[near])
        step = units * fit.step
        change = np.eye(4)
        change[:3, :3] = Rotation.from_rotvec(step[3:]).as_matrix()
        change[:3, 3] = middle + step[:3] - change[:3, :3] @ middle
        transform, moved = change @ transform, moved @ change[:3, :3].T + change[:3, 3]
        if np.abs(fit.step).max() < _STILL_MM:
            break
    return Registration(
        transform,
        units[:, None] * fit.covariance * units,
        (transform @ np.append(points_mm.mean(axis=0), 1.0))[:3],
        tuple(_words(vector) for vector in fit.open_directions),
        float(np.sqrt(np.mean(fit.counted_mm**2))),
        len(fit.counted_mm),
    )


class _Fit(NamedTuple):
    """A step (6,) of the movement, its covariance (6, 6), open directions (K, 6), and the distances that count."""

    step: np.ndarray
    covariance: np.ndarray
    open_directions: np.ndarray
    counted_mm: np.ndarray


_NO_FIT = _Fit(*(np.empty(0) for _ in range(4)))


def _fitted(by: np.ndarray, left: np.ndarray, std: np.ndarray) -> _Fit:
    """Weighted step against distances (N,) with derivatives (N, 6), along the directions that are determined."""
    relative = left / std
    spread = max(MAD_TO_STD * float(np.median(np.abs(relative))), 1.0)
    u = np.clip(relative / (_TUKEY * spread), -1, 1)
    weight = (1 - u * u) ** 2 / (std * spread) ** 2
    values, vectors = np.linalg.eigh(by.T @ (weight[:, None] * by))
    known = values > _OPEN_SHARE * values[-1]
    inverse = (vectors[:, known] / values[known]) @ vectors[:, known].T
    step = -inverse @ (by.T @ (weight * left))
    return _Fit(step, inverse, vectors[:, np.logical_not(known)].T, left[np.abs(u) < 1])


def _words(direction: np.ndarray) -> str:
    """A movement in words: its parts that are not small."""
    large = np.flatnonzero(np.abs(direction) > 0.3 * np.abs(direction).max())
    return " with ".join(_NAMES[k] for k in large)
