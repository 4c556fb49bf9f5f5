"""Registration of a cloud to a surface, as the joint registration of two scans, and the uncertainty of fitted shapes.

Motions that the surface does not determine are reported and left unchanged. Systematic errors that resemble a rigid
motion are absorbed by the registration, so their effect on the estimated motion is propagated.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from uwlts.errors import EvaluationError
from uwlts.fitting.least_squares import rms_distance
from uwlts.fitting.patches import rigid_derivatives, surface_patches
from uwlts.fitting.propagation import grouped_covariance
from uwlts.registration.joint_registration import FEWEST_OF_PAIR, JointRegistration, approach, settle
from uwlts.storage.cloud import PointUncertainty, project_image_errors

_NAMES = "shift along x", "shift along y", "shift along z", "turn about x", "turn about y", "turn about z"
_OPEN_SHARE = 1e-3
"""Information on a direction, relative to the best determined one, below which the direction is undetermined. Errors of
images tilt the normals of a plane by as much."""
_KNOWN = 1e12  # prior information on the amplitudes of systematic patterns: they are not estimated here, but propagated


@dataclass(frozen=True, eq=False)
class SurfaceSample:
    """Points (N, 3) of a cloud with their uncertainty and images (N,), or samples of a mesh with normals (N, 3)."""

    points_mm: np.ndarray
    uncertainty: PointUncertainty | None = None
    frame: np.ndarray | None = None
    normals: np.ndarray | None = None
    rounding_std_mm: float = 0.0  # by the steps of a cloud's stored coordinates
    warnings: tuple[str, ...] = ()

    @property
    def meshed(self) -> bool:
        """True for samples of a mesh, which are free of noise."""
        return self.normals is not None

    def select(self, chosen: np.ndarray | slice) -> SurfaceSample:
        """Return some of the points."""
        known, frame = self.uncertainty, self.frame
        return SurfaceSample(
            self.points_mm[chosen], None if known is None else known[chosen], None if frame is None else frame[chosen]
        )


@dataclass(frozen=True, eq=False)
class Registration:
    """Rigid motion that registers a cloud to a surface."""

    transform: np.ndarray  # (4, 4); transform from the cloud's frame to the reference's, mm
    covariance: np.ndarray
    """(6, 6) or (7, 7); covariance of the translation (mm) and rotation (rad) about `middle_mm` after the motion, by
    the noise of points and the position of images; 0 in undetermined directions. For a fitted shape of unknown size,
    the radius (mm) comes last."""
    middle_mm: np.ndarray  # (3,); middle of the cloud after the motion
    open_directions: tuple[str, ...]
    """Motions that the surface does not determine. The cloud was not moved along them."""
    rms_mm: float  # root-mean-square distance from the surface of the patches, or points, with a positive weight
    counted: int  # number of these patches or points
    # (M, 6) or (M, 7); change of the estimated motion for one standard deviation of each systematic pattern of cloud or
    # reference.
    by_cloud: np.ndarray
    by_reference: np.ndarray

    def std_along(self, points_mm: np.ndarray, normals: np.ndarray) -> np.ndarray:
        """Return the standard uncertainty (N,), mm, of moved points (N, 3) along normals, without shared patterns."""
        by = _differentiate_by_motion(points_mm, normals, self.middle_mm, sized=len(self.covariance) == 7)
        return np.sqrt(np.maximum(np.einsum("ni,ij,nj->n", by, self.covariance, by), 0.0))

    def moves_mm(self, step: np.ndarray, points_mm: np.ndarray, normals: np.ndarray | None = None) -> np.ndarray:
        """Return the shift (N, 3) of points by a step (6,), or by a step (7,) with a change of radius along normals."""
        moved = step[:3] + np.cross(step[3:6], points_mm - self.middle_mm)
        return moved if normals is None or len(step) == 6 else moved + step[6] * normals

    def follow(
        self, known: PointUncertainty, steps: np.ndarray, points_mm: np.ndarray, normals: np.ndarray | None = None
    ) -> PointUncertainty:
        """Return an uncertainty of points (N, 3) whose patterns contain a step of the motion for each (M, 6)."""
        moves = [self.moves_mm(step, points_mm, normals) for step in steps]
        patterns = known.patterns_mm + np.array(moves, np.float32).reshape(known.patterns_mm.shape)
        return replace(known, patterns_mm=patterns.astype(np.float32))


def register_to_surface(
    cloud: SurfaceSample, reference: SurfaceSample, *, reach_mm: float, datums: np.ndarray | None = None
) -> Registration:
    """Register a cloud to a reference, starting from its current position, as two scans (`JointRegistration`).

    Only the reference within the spheres of ``datums`` (K, 4), centres and radii in mm, counts, if given. The initial
    distance is at most about ``reach_mm``. Undetermined motions, such as a shift along a plane, stay zero.

    Raises EvaluationError if the two do not overlap, or have too few points.
    """
    if datums is not None:
        reference = reference.select(select_within(reference.points_mm, datums))
        cloud = cloud.select(select_within(cloud.points_mm, datums + [0, 0, 0, 2 * reach_mm]))
    patches = [surface_patches(each.points_mm, each.uncertainty, frame=each.frame) for each in (reference, cloud)]
    joint = JointRegistration(
        patches, [[], []], np.tile(np.eye(4), (2, 1, 1)), start_std=None, sphere_mm=None, least_share=_OPEN_SHARE
    )
    joint.prior_information = _KNOWN * np.eye(len(joint.prior_information))
    if not joint.collect_evidence(joint.measure_distances(max(reach_mm, 2 * max(each.radius_mm for each in patches)))):
        raise EvaluationError(
            f"cloud and reference overlap on fewer than {FEWEST_OF_PAIR} patches within {reach_mm:g} mm"
            f"{'' if datums is None else ' and within the datums'}. Check that both have the same frame and unit"
        )
    names = "the reference", "the cloud"
    _, pairs, solution, covariance = settle(joint, approach(joint, reach_mm, names), names)
    (pair,) = pairs.values()
    of_reference, of_cloud = (-solution.response[:6, :6] @ pair.normal()[:6, each] for each in joint.pattern_columns)
    left, ways = pair.residuals[pair.counted], solution.open_directions / joint.units[:6]
    # Open motions are named by their large components.
    large = (np.flatnonzero(np.abs(way) > 0.3 * np.abs(way).max()) for way in ways)
    return Registration(
        joint.poses[1],
        covariance[:6, :6],
        joint.middles_mm[1],
        tuple(" with ".join(_NAMES[k] for k in each) for each in large),
        float(np.sqrt(np.mean(left**2))),
        len(left),
        of_cloud.T,
        of_reference.T,
    )


def shape_registration(
    cloud: SurfaceSample, distance_mm: np.ndarray, normals: np.ndarray, *, sized: bool
) -> Registration:
    """Return the uncertainty of a shape that was fitted to points by least squares, as a zero registration.

    The points have distances (N,) from the shape along its normals (N, 3). ``sized``: the radius was fitted, too.
    """
    points_mm, uncertainty = cloud.points_mm, cloud.uncertainty
    middle = points_mm.mean(axis=0)
    by = _differentiate_by_motion(points_mm, normals, middle, sized=sized)
    # Rotations are scaled by the rms radius, so that all unknowns are lengths.
    units = np.array([1.0] * 3 + [1 / max(rms_distance(points_mm, middle), 1e-9)] * 3 + [1.0] * sized)
    values, vectors = np.linalg.eigh((by * units).T @ (by * units))
    known = values > _LEAST * values[-1]
    answer = -units[:, None] * (vectors[:, known] / values[known]) @ vectors[:, known].T @ (by * units).T
    covariance, patterns = np.mean(distance_mm**2) * answer @ answer.T, np.empty((0, len(answer)))
    if uncertainty is not None:
        images = np.arange(len(points_mm)) if cloud.frame is None else cloud.frame
        covariance = covariance + grouped_covariance(answer, project_image_errors(uncertainty, normals), images)
        patterns = np.einsum("mni,ni->mn", uncertainty.patterns_mm, normals) @ answer.T
    rms = float(np.sqrt(np.mean(distance_mm**2)))
    none = np.empty((0, len(answer)))
    return Registration(np.eye(4), covariance, middle, (), rms, len(points_mm), patterns, none)


_LEAST = 1e-12
"""Information on a motion of a shape, relative to the best determined one, below which only rounding determines it."""


def select_within(points: np.ndarray, datums: np.ndarray) -> np.ndarray:
    """Return a mask (N,) of points within any of the spheres (K, 4)."""
    return np.any(np.linalg.norm(points[:, None] - datums[:, :3], axis=2) <= datums[:, 3], axis=1)


def _differentiate_by_motion(points: np.ndarray, normals: np.ndarray, middle: np.ndarray, *, sized: bool) -> np.ndarray:
    """Return the derivatives (N, 6) of distances by translation and rotation, or (N, 7) with the radius."""
    by = rigid_derivatives(points, normals, middle)
    return np.hstack([by, np.ones((len(by), 1))]) if sized else by
