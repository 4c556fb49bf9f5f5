"""Registration of a cloud to a surface: points to local planes, weighted by their covariance, robust.

What the surface leaves open is named and left as it was. What all points of a cloud share is followed through the
estimate: a registration takes up whatever looks like a movement.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, NamedTuple, Protocol

import numpy as np
from scipy.spatial import KDTree
from scipy.spatial.transform import Rotation

from uwlts.errors import EvaluationError
from uwlts.fitting.least_squares import biweight, noise_factor, rms_distance
from uwlts.fitting.patches import rigid_derivatives
from uwlts.fitting.propagation import covariance_of_groups
from uwlts.model.calibration import rigid_transform
from uwlts.storage.cloud import PointUncertainty, images_along, variance_along

_ROUNDS = 40
_MOST_POINTS = 50_000
"""More add nothing but time."""
_OPEN_SHARE = 1e-3
"""Of the information of the best determined direction: a direction with less rests on the noise of the normals."""
_STILL_MM = 1e-5
_LEAST_MM2 = 1e-8
"""A tenth of a micrometre, squared, so that no point weighs infinitely."""
_FEWEST = 50
_NAMES = "shift along x", "shift along y", "shift along z", "turn about x", "turn about y", "turn about z"


@dataclass(frozen=True, eq=False)
class Nearest:
    """Signed distances (N,) of points from a surface along its unit normals (N, 3), and index (N,) of its points.

    A distance is NaN where the surface is farther than was looked for.
    """

    distance_mm: np.ndarray
    normals: np.ndarray
    index: np.ndarray


class ReferenceSurface(Protocol):
    """What a cloud can be registered to; ``uncertainty`` is of the points that `Nearest.index` counts."""

    @property
    def uncertainty(self) -> PointUncertainty | None: ...

    @property
    def frame(self) -> np.ndarray | None: ...

    def nearest(self, points_mm: np.ndarray, *, reach_mm: float) -> Nearest: ...


class SampledSurface:
    """A surface given by points (M, 3) with unit normals (M, 3), each with its tangent plane."""

    def __init__(
        self,
        points_mm: np.ndarray,
        normals: np.ndarray,
        *,
        uncertainty: PointUncertainty | None = None,
        frame: np.ndarray | None = None,
    ):
        self.points_mm, self.normals, self.uncertainty, self.frame = points_mm, normals, uncertainty, frame
        self._tree = KDTree(points_mm)

    def nearest(self, points_mm: np.ndarray, *, reach_mm: float) -> Nearest:
        found: Any = self._tree.query(points_mm, distance_upper_bound=reach_mm, workers=-1)
        near = np.isfinite(found[0])
        index = np.where(near, found[1], 0)
        normals = self.normals[index]
        distance = np.einsum("ni,ni->n", points_mm - self.points_mm[index], normals)
        return Nearest(np.where(near, distance, np.nan), normals, index)


@dataclass(frozen=True, eq=False)
class Registration:
    """Movement that brings a cloud to a surface.

    Attributes
    ----------
    transform : (4, 4) float64
        Reference from cloud, mm.
    covariance : (6, 6) float64
        Of a shift (mm), then a turn (rad) about the cloud's `middle_mm`, after the movement: by the noise of single
        points and the positions of images, 0 in directions that are open. Of a fitted shape whose size is free (7, 7),
        with the radius (mm).
    middle_mm : (3,) float64
    open_directions : tuple of str
        Movements that the surface does not tell; the cloud was not moved along them.
    rms_mm : float
        Root mean square distance of the points that count from the surface.
    points : int
        Points that count.
    by_cloud, by_reference : (M, 6) float64
        Steps by which the registration answers to each pattern that the points of cloud or reference share.
    """

    transform: np.ndarray
    covariance: np.ndarray
    middle_mm: np.ndarray
    open_directions: tuple[str, ...]
    rms_mm: float
    points: int
    by_cloud: np.ndarray
    by_reference: np.ndarray

    def std_along(self, points_mm: np.ndarray, normals: np.ndarray) -> np.ndarray:
        """Standard uncertainty (N,) of the moved points (N, 3) along normals (N, 3), mm, without shared patterns."""
        by = _by_movement(points_mm, normals, self.middle_mm, sized=len(self.covariance) == 7)
        return np.sqrt(np.maximum(np.einsum("ni,ij,nj->n", by, self.covariance, by), 0.0))

    def moves_mm(self, step: np.ndarray, points_mm: np.ndarray, normals: np.ndarray | None = None) -> np.ndarray:
        """How points (N, 3) move by a step (6,), or (7,) along normals (N, 3) of a surface whose size is free."""
        moved = step[:3] + np.cross(step[3:6], points_mm - self.middle_mm)
        return moved if normals is None or len(step) == 6 else moved + step[6] * normals


def register_to_surface(
    points_mm: np.ndarray,
    surface: ReferenceSurface,
    *,
    reach_mm: float,
    uncertainty: PointUncertainty | None = None,
    frame: np.ndarray | None = None,
    datums: np.ndarray | None = None,
) -> Registration:
    """Move points (N, 3) onto a surface, from where they are.

    Least squares of the distances along the surface's normals (Chen and Medioni, Image and Vision Computing 10, 1992),
    weighted by the variance of each point along the normal and by Tukey's biweight. Points farther than ``reach_mm``
    from the surface do not count, nor points outside the spheres ``datums`` (K, 4), centre and radius, if given. What
    the surface does not tell, as a shift along a plane or a cylinder, is left as it was.

    Raises
    ------
    EvaluationError
        Fewer than 50 points lie near the surface, within the datums.
    """
    counted = np.arange(len(points_mm)) if datums is None else np.flatnonzero(_within(points_mm, datums, reach_mm))
    chosen = counted[:: max(1, len(counted) // _MOST_POINTS)]
    moved = points_mm[chosen].astype(np.float64)
    known = None if uncertainty is None else uncertainty[chosen]
    image = None if frame is None else frame[chosen]
    centroid = moved.mean(axis=0) if len(moved) else np.zeros(3)
    transform, rounds = np.eye(4), 0
    while True:
        middle = (transform @ np.append(centroid, 1.0))[:3]
        near = surface.nearest(moved, reach_mm=reach_mm)
        used = np.isfinite(near.distance_mm)
        if datums is not None:
            used &= _within(moved, datums, 0.0)
        if np.count_nonzero(used) < _FEWEST:
            raise EvaluationError(
                f"{np.count_nonzero(used)} of {len(points_mm)} points lie within {reach_mm:g} mm of the reference"
                f"{'' if datums is None else ' and within the datums'}; at least {_FEWEST} are needed: do both have "
                "the same frame and unit?"
            )
        rotation = transform[:3, :3]
        variance = _variance_along(known, near.normals @ rotation)[used]
        by = _by_movement(moved[used], near.normals[used], middle)
        found = _estimate(by, near.distance_mm[used], variance, size=_size(moved, middle))
        turn = Rotation.from_rotvec(found.step[3:]).as_matrix()
        change = rigid_transform(turn, middle + found.step[:3] - turn @ middle)
        transform, moved = change @ transform, moved @ change[:3, :3].T + change[:3, 3]
        rounds += 1
        largest = max(np.abs(found.step[:3]).max(), np.abs(found.step[3:]).max() * _size(moved, middle))
        if largest < _STILL_MM or rounds == _ROUNDS:
            break
    normals = near.normals[used]
    cloud_side = _Shared(
        None if known is None else known[used], normals @ transform[:3, :3], None if image is None else image[used]
    )
    index = near.index[used]
    reference = surface.uncertainty
    reference_side = _Shared(
        None if reference is None else reference[index],
        -normals,
        None if surface.frame is None else surface.frame[index],
    )
    covariance = found.covariance + cloud_side.position(found.answer) + reference_side.position(found.answer)
    covariance += reference_side.noise(found.answer, index)
    return Registration(
        transform,
        covariance,
        (transform @ np.append(centroid, 1.0))[:3],
        tuple(_words(vector) for vector in found.open_directions),
        float(np.sqrt(np.mean(found.counted_mm**2))),
        len(found.counted_mm),
        cloud_side.steps(found.answer),
        reference_side.steps(found.answer),
    )


def fitted_shape(
    points_mm: np.ndarray, near: Nearest, *, sized: bool, uncertainty: PointUncertainty | None, frame: np.ndarray | None
) -> Registration:
    """Uncertainty of a shape that was fitted to points (N, 3) by least squares of their distances.

    As of a registration that found nothing to move; with ``sized`` the radius was fitted, too.
    """
    middle = points_mm.mean(axis=0)
    by = _by_movement(points_mm, near.normals, middle, sized=sized)
    found = _estimate(by, near.distance_mm, None, size=_size(points_mm, middle), open_share=1e-12)
    shared = _Shared(uncertainty, near.normals, frame)
    return Registration(
        np.eye(4),
        found.covariance + shared.position(found.answer),
        middle,
        (),
        float(np.sqrt(np.mean(near.distance_mm**2))),
        len(points_mm),
        shared.steps(found.answer),
        np.empty((0, by.shape[1])),
    )


def _within(points: np.ndarray, datums: np.ndarray, margin: float) -> np.ndarray:
    """Which points (N, 3) lie within one of the spheres (K, 4), or so far outside."""
    away = np.linalg.norm(points[:, None] - datums[:, :3], axis=2)
    return np.any(away <= datums[:, 3] + margin, axis=1)


def _size(points: np.ndarray, middle: np.ndarray) -> float:
    return max(rms_distance(points, middle), 1e-9)


def _by_movement(points: np.ndarray, normals: np.ndarray, middle: np.ndarray, *, sized: bool = False) -> np.ndarray:
    """Derivatives (N, 6) of distances along normals by shift and turn, (N, 7) with the radius of the cloud's shape."""
    by = rigid_derivatives(points, normals, middle)
    return np.hstack([by, np.ones((len(by), 1))]) if sized else by


def _variance_along(known: PointUncertainty | None, normals: np.ndarray) -> np.ndarray:
    """Variance (N,) of points along normals (N, 3) by what is not common to them; the least where it is not known."""
    if known is None:
        # The scatter about the surface makes it as large as it is.
        return np.full(len(normals), _LEAST_MM2)
    of_images = np.sum(images_along(known, normals) ** 2, axis=0)
    return np.maximum(variance_along(known.random_mm2, normals) + of_images, _LEAST_MM2)


class _Found(NamedTuple):
    """A step (K,), its covariance by noise, its answer (K, N) to distances, open directions, and what counts."""

    step: np.ndarray
    covariance: np.ndarray
    answer: np.ndarray
    open_directions: np.ndarray
    counted_mm: np.ndarray


def _estimate(
    by: np.ndarray, left: np.ndarray, variance: np.ndarray | None, *, size: float, open_share: float = _OPEN_SHARE
) -> _Found:
    """Weighted step against distances (N,) with derivatives (N, K), along the directions that are determined.

    Without ``variance`` all distances count alike.
    """
    # Turns in units of the shift that they give to the usual point.
    units = np.array([1.0] * 3 + [1 / size] * 3 + [1.0] * (by.shape[1] - 6))
    scaled = by * units
    if variance is None:
        weight, noise = np.ones(len(left)), np.full(len(left), float(np.mean(left**2)))
        counted = left
    else:
        relative = left / np.sqrt(variance)
        spread = noise_factor(relative)
        weight, noise = biweight(relative / spread) / variance, variance * spread**2
        counted = left[weight > 0]
    values, vectors = np.linalg.eigh(scaled.T @ (weight[:, None] * scaled))
    known = values > open_share * values[-1]
    inverse = (vectors[:, known] / values[known]) @ vectors[:, known].T
    answer = -units[:, None] * (inverse @ (scaled.T * weight))
    covariance = (answer * noise) @ answer.T
    return _Found(answer @ left, covariance, answer, vectors[:, np.logical_not(known)].T, counted)


class _Shared:
    """What the points of one side share, along the normals (N, 3) in their own frame; nothing where it is not known."""

    def __init__(self, known: PointUncertainty | None, normals: np.ndarray, frame: np.ndarray | None):
        self._known, self._normals, self._frame = known, normals, frame

    def steps(self, answer: np.ndarray) -> np.ndarray:
        """The answer (M, K) to each pattern."""
        if self._known is None:
            return np.empty((0, len(answer)))
        return np.einsum("mni,ni->mn", self._known.patterns_mm, self._normals) @ answer.T

    def position(self, answer: np.ndarray) -> np.ndarray:
        """Covariance (K, K) of the answer by what moves the points of each image together: its position and pose."""
        if self._known is None:
            return np.zeros((len(answer), len(answer)))
        image = np.arange(answer.shape[1]) if self._frame is None else self._frame
        return covariance_of_groups(answer, images_along(self._known, self._normals), image)

    def noise(self, answer: np.ndarray, index: np.ndarray) -> np.ndarray:
        """Covariance (K, K) of the answer by the noise of points that are used several times, by index (N,)."""
        if self._known is None:
            return np.zeros((len(answer), len(answer)))
        return covariance_of_groups(answer, np.sqrt(variance_along(self._known.random_mm2, self._normals))[None], index)


def _words(direction: np.ndarray) -> str:
    """A movement in words: its parts that are not small."""
    large = np.flatnonzero(np.abs(direction) > 0.3 * np.abs(direction).max())
    return " with ".join(_NAMES[k] for k in large)
