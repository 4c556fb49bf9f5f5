"""Robust point-to-plane registration of a cloud to a surface, weighted by the points' covariance.

Motions that the surface does not determine are reported and left unchanged. Systematic errors that resemble a rigid
motion are absorbed by the registration, so their effect on the estimated motion is propagated.
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
from uwlts.fitting.propagation import grouped_covariance
from uwlts.model.calibration import rigid_transform
from uwlts.storage.cloud import PointUncertainty, project_image_errors, project_variance

_NAMES = "shift along x", "shift along y", "shift along z", "turn about x", "turn about y", "turn about z"


class _Options:
    """Settings of `register_to_surface`.

    The history of the values names no data. The reason beside each value follows from the method.
    """

    rounds: int = 40  # largest number of Gauss-Newton rounds, each with new correspondences
    most_points: int = 50_000
    """Number of points above which the cloud is thinned: more points take longer without a benefit."""
    fewest_points: int = 50  # least number of points near the surface: about eight for each of the six parameters
    open_share: float = 1e-3
    """Information on a direction, relative to the best determined one, below which the direction is undetermined.
    Noise of the normals alone can produce less."""
    still_mm: float = 1e-5  # step, mm, that ends the iteration: far below any measurable change
    least_variance_mm2: float = 1e-8
    """Lower bound of a point's variance along the normal: (0.1 um) squared, so that weights stay finite."""


@dataclass(frozen=True, eq=False)
class Nearest:
    """Signed distances (N,) of points from a surface along unit normals (N, 3), and indices (N,) of surface points.

    A distance is NaN beyond the search distance.
    """

    distance_mm: np.ndarray
    normals: np.ndarray
    index: np.ndarray


class ReferenceSurface(Protocol):
    """Reference surface of a registration; `Nearest.index` refers to the points of ``uncertainty``."""

    @property
    def uncertainty(self) -> PointUncertainty | None: ...

    @property
    def frame(self) -> np.ndarray | None: ...

    def nearest(self, points_mm: np.ndarray, *, reach_mm: float) -> Nearest: ...


class SampledSurface:
    """Surface given by points (M, 3) with unit normals (M, 3): each point has its tangent plane."""

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
    """Rigid motion that registers a cloud to a surface."""

    transform: np.ndarray  # (4, 4); transform from the cloud's frame to the reference's, mm
    covariance: np.ndarray
    """(6, 6) or (7, 7); covariance of the translation (mm) and rotation (rad) about `middle_mm` after the motion, by
    the noise of points and the position of images; 0 in undetermined directions. For a fitted shape of unknown size,
    the radius (mm) comes last."""
    middle_mm: np.ndarray  # (3,); centroid of the cloud after the motion
    open_directions: tuple[str, ...]
    """Motions that the surface does not determine. The cloud was not moved along them."""
    rms_mm: float  # root-mean-square distance from the surface of the points with a positive weight
    points: int  # number of these points
    # (M, 6) or (M, 7); change of the estimated motion for one standard deviation of each systematic pattern of cloud or
    # reference.
    by_cloud: np.ndarray
    by_reference: np.ndarray

    def std_along(self, points_mm: np.ndarray, normals: np.ndarray) -> np.ndarray:
        """Return the standard uncertainty (N,), mm, of moved points (N, 3) along normals, without shared patterns."""
        by = _motion_derivatives(points_mm, normals, self.middle_mm, sized=len(self.covariance) == 7)
        return np.sqrt(np.maximum(np.einsum("ni,ij,nj->n", by, self.covariance, by), 0.0))

    def moves_mm(self, step: np.ndarray, points_mm: np.ndarray, normals: np.ndarray | None = None) -> np.ndarray:
        """Return the shift (N, 3) of points by a step (6,), or by a step (7,) with a change of radius along normals."""
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
    """Register points (N, 3) to a surface, starting from their current position.

    Minimise the squared distances along the surface normals (Chen and Medioni, Image and Vision Computing 10, 1992),
    weighted by each point's variance along the normal and by Tukey's biweight. Undetermined motions, such as a shift
    along a plane, stay zero.

    Points farther than ``reach_mm`` from the surface are ignored, and those outside all spheres of ``datums`` (K, 4),
    centres and radii in mm, if given.

    Raises EvaluationError if fewer than 50 points are near the surface and within the datums.
    """
    counted = (
        np.arange(len(points_mm)) if datums is None else np.flatnonzero(_select_within(points_mm, datums, reach_mm))
    )
    chosen = counted[:: max(1, len(counted) // _Options.most_points)]
    moved = points_mm[chosen].astype(np.float64)
    known = None if uncertainty is None else uncertainty[chosen]
    image = None if frame is None else frame[chosen]
    centroid = moved.mean(axis=0) if len(moved) else np.zeros(3)
    transform, rounds, reference = np.eye(4), 0, surface.uncertainty
    while True:
        middle = (transform @ np.append(centroid, 1.0))[:3]
        near = surface.nearest(moved, reach_mm=reach_mm)
        used = np.isfinite(near.distance_mm)
        if datums is not None:
            used &= _select_within(moved, datums, 0.0)
        if np.count_nonzero(used) < _Options.fewest_points:
            raise EvaluationError(
                f"{np.count_nonzero(used)} of {len(points_mm)} points lie within {reach_mm:g} mm of the reference"
                f"{'' if datums is None else ' and within the datums'}; at least {_Options.fewest_points} are needed. "
                "Check that both have the same frame and unit"
            )
        rotation = transform[:3, :3]
        # Distances also contain the noise of the reference, which the scatter would count again.
        of_reference = np.zeros(np.count_nonzero(used))
        if reference is not None:
            of_reference = project_variance(reference.random_mm2[near.index[used]], near.normals[used])
        variance = of_reference + _variance_along(known, near.normals @ rotation, _Options.least_variance_mm2)[used]
        by = _motion_derivatives(moved[used], near.normals[used], middle)
        found = _solve_step(
            by, near.distance_mm[used], variance, size=_rms_radius(moved, middle), open_share=_Options.open_share
        )
        turn = Rotation.from_rotvec(found.step[3:]).as_matrix()
        change = rigid_transform(turn, middle + found.step[:3] - turn @ middle)
        transform, moved = change @ transform, moved @ change[:3, :3].T + change[:3, 3]
        rounds += 1
        largest = max(np.abs(found.step[:3]).max(), np.abs(found.step[3:]).max() * _rms_radius(moved, middle))
        if largest < _Options.still_mm or rounds == _Options.rounds:
            break
    normals = near.normals[used]
    cloud_side = _CorrelatedErrors(
        None if known is None else known[used], normals @ transform[:3, :3], None if image is None else image[used]
    )
    index = near.index[used]
    reference_side = _CorrelatedErrors(
        None if reference is None else reference[index],
        -normals,
        None if surface.frame is None else surface.frame[index],
    )
    covariance = (
        found.covariance
        + cloud_side.position_covariance(found.answer)
        + reference_side.position_covariance(found.answer)
    )
    # The step's covariance takes the reference's noise as independent.
    covariance += reference_side.noise_covariance(found.answer, index)
    covariance -= reference_side.noise_covariance(found.answer, np.arange(len(index)))
    return Registration(
        transform,
        covariance,
        (transform @ np.append(centroid, 1.0))[:3],
        tuple(_name_motion(vector) for vector in found.open_directions),
        float(np.sqrt(np.mean(found.counted_mm**2))),
        len(found.counted_mm),
        cloud_side.pattern_steps(found.answer),
        reference_side.pattern_steps(found.answer),
    )


def shape_registration(
    points_mm: np.ndarray, near: Nearest, *, sized: bool, uncertainty: PointUncertainty | None, frame: np.ndarray | None
) -> Registration:
    """Return the uncertainty of a shape that was fitted to points by least squares, as a zero registration.

    ``near`` are the distances of the points (N, 3) from the shape, and its normals; ``sized``: the radius was fitted,
    too. The uncertainty of the points may be unknown (None).
    """
    middle = points_mm.mean(axis=0)
    by = _motion_derivatives(points_mm, near.normals, middle, sized=sized)
    found = _solve_step(by, near.distance_mm, None, size=_rms_radius(points_mm, middle), open_share=1e-12)
    shared = _CorrelatedErrors(uncertainty, near.normals, frame)
    return Registration(
        np.eye(4),
        found.covariance + shared.position_covariance(found.answer),
        middle,
        (),
        float(np.sqrt(np.mean(near.distance_mm**2))),
        len(points_mm),
        shared.pattern_steps(found.answer),
        np.empty((0, by.shape[1])),
    )


def _select_within(points: np.ndarray, datums: np.ndarray, margin: float) -> np.ndarray:
    """Return a mask (N,) of points within any of the spheres (K, 4), enlarged by a margin."""
    away = np.linalg.norm(points[:, None] - datums[:, :3], axis=2)
    return np.any(away <= datums[:, 3] + margin, axis=1)


def _rms_radius(points: np.ndarray, middle: np.ndarray) -> float:
    return max(rms_distance(points, middle), 1e-9)


def _motion_derivatives(
    points: np.ndarray, normals: np.ndarray, middle: np.ndarray, *, sized: bool = False
) -> np.ndarray:
    """Return the derivatives (N, 6) of distances by translation and rotation, or (N, 7) with the radius."""
    by = rigid_derivatives(points, normals, middle)
    return np.hstack([by, np.ones((len(by), 1))]) if sized else by


def _variance_along(known: PointUncertainty | None, normals: np.ndarray, least: float) -> np.ndarray:
    """Return the variance (N,) of points along normals (N, 3), without systematic patterns; at least ``least``."""
    if known is None:
        # The robust scatter about the surface scales this variance up.
        return np.full(len(normals), least)
    of_images = np.sum(project_image_errors(known, normals) ** 2, axis=0)
    return np.maximum(project_variance(known.random_mm2, normals) + of_images, least)


class _Step(NamedTuple):
    """Step (K,), its noise covariance (K, K), its derivatives (K, N) by the distances, and the used distances."""

    step: np.ndarray
    covariance: np.ndarray
    answer: np.ndarray
    open_directions: np.ndarray
    counted_mm: np.ndarray


def _solve_step(
    by: np.ndarray, left: np.ndarray, variance: np.ndarray | None, *, size: float, open_share: float
) -> _Step:
    """Solve for the weighted least-squares step of distances (N,) with derivatives (N, K).

    Undetermined directions are excluded. Without ``variance``, all distances have equal weight.
    """
    # Rotations are scaled by the rms radius, so that all unknowns are lengths.
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
    return _Step(answer @ left, covariance, answer, vectors[:, np.logical_not(known)].T, counted)


class _CorrelatedErrors:
    """Correlated errors of the points of one side along normals (N, 3), in their own frame; zero if unknown."""

    def __init__(self, known: PointUncertainty | None, normals: np.ndarray, frame: np.ndarray | None):
        self._known, self._normals, self._frame = known, normals, frame

    def pattern_steps(self, answer: np.ndarray) -> np.ndarray:
        """Return the step (M, K) caused by each systematic pattern."""
        if self._known is None:
            return np.empty((0, len(answer)))
        return np.einsum("mni,ni->mn", self._known.patterns_mm, self._normals) @ answer.T

    def position_covariance(self, answer: np.ndarray) -> np.ndarray:
        """Return the covariance (K, K) of the step by errors of the image positions and poses."""
        if self._known is None:
            return np.zeros((len(answer), len(answer)))
        image = np.arange(answer.shape[1]) if self._frame is None else self._frame
        return grouped_covariance(answer, project_image_errors(self._known, self._normals), image)

    def noise_covariance(self, answer: np.ndarray, index: np.ndarray) -> np.ndarray:
        """Return the covariance (K, K) of the step by noise of points that are used repeatedly, by index (N,)."""
        if self._known is None:
            return np.zeros((len(answer), len(answer)))
        return grouped_covariance(answer, np.sqrt(project_variance(self._known.random_mm2, self._normals))[None], index)


def _name_motion(direction: np.ndarray) -> str:
    """Name the large components of a motion."""
    large = np.flatnonzero(np.abs(direction) > 0.3 * np.abs(direction).max())
    return " with ".join(_NAMES[k] for k in large)
