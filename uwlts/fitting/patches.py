"""Second-order patches of a cloud's surface with covariance, and distances between two sets of patches.

A patch is a second-order fit to the points of a disc. Unlike a plane, it is unbiased on curved surfaces. Its covariance
gives the noise of distances and slopes.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any, NamedTuple

import numpy as np
from scipy.linalg import eigh
from scipy.sparse import csr_array
from scipy.spatial import KDTree

from uwlts.errors import EvaluationError
from uwlts.fitting.local_surface import PatchErrors, number_cubes
from uwlts.storage.cloud import PointUncertainty, project_image_errors, project_variance

_CELLS_PER_RADIUS = 3.0  # averaging cubes per disc radius: a disc contains 28 averages for 6 coefficients
_NEIGHBOURS = 40  # most averages in a disc; 28 are usual
_FEWEST = 10  # least number of averages in a disc; a second-order surface has 6 coefficients
_ROUND = 0.3  # least squared ratio of a disc's narrow to its wide extent; distant profiles give strips instead of discs
_LARGEST_PATCH = 0.1  # largest disc radius relative to the cloud's size; a larger disc is not local
_LEAST_NOISE_MM = 1e-6  # lower bound of a point's noise, mm, so that weights stay finite
_ROUGH = 5.0  # largest ratio of a patch's scatter to the median scatter; patches on edges exceed it
_MOST = 15_000  # number of patches above which they are thinned
_SAMPLE = 400  # number of discs used to find the radius
_SAME_WAY = 0.8  # least cosine (37 deg) between the normals of corresponding patches
_FACING = 0.15
"""Least cosine (81 deg) between a normal and the viewing direction; a sensor sees little of steeper surfaces."""

LEAST_INFORMATION = 5.0
"""Least information on a determined motion, relative to the information that noise of the normals alone produces."""
ROUNDING = 1e-9  # least information above rounding noise, relative to the information on the best determined motion


@dataclass(frozen=True, eq=False)
class Averages:
    """Averages of points in cubes: positions (C, 3) and systematic patterns (M, C, 3), mm, and point counts (C,)."""

    places_mm: np.ndarray
    counts: np.ndarray
    patterns_mm: np.ndarray

    @cached_property
    def tree(self) -> KDTree:
        return KDTree(self.places_mm)


@dataclass(frozen=True, eq=False)
class Patches:
    """P patches of the surface of a cloud, in its frame."""

    places_mm: np.ndarray  # (P, 3); centre of each patch, on the surface
    axes: np.ndarray  # (P, 3, 3); two tangents and the unit normal, in rows
    shape: np.ndarray  # (P, 6); coefficients of the height over the tangents: 1, u, v, u2, uv, v2
    covariance: np.ndarray  # (P, 6, 6); covariance of the shape by noise of the points
    patterns_mm: np.ndarray
    """(M, P, 3); shift of each patch for one standard deviation of each systematic pattern (`PointUncertainty`)."""
    numbers: np.ndarray  # (P,) int; number of a point near the centre of the patch
    radius_mm: float  # radius of the discs
    averages: Averages  # averages of points to which the patches are fitted
    errors: PatchErrors  # effect of the independent errors of the cloud on the heights of the patches
    image_variance_mm2: np.ndarray
    """(P,); variance of the heights by errors of images, which ``covariance`` does not contain."""
    one_sided: bool  # True if all normals point to the sensor (-Z); otherwise their signs have no meaning
    noise_stated: bool
    """True if the cloud states the noise of its points; otherwise it is that of their scatter, with the misfit of
    second-order surfaces."""
    shared: float  # variance of the sum of all heights by noise, relative to the sum of their variances
    overlap: float  # mean number of patches that contain a point
    strips: float  # number of independent groups of patches with regard to errors of images

    def correlated_count(self, count: int) -> float:
        """Return the number of patches that carry the information of one independent patch, among ``count`` patches."""
        of_images, of_noise = np.median(self.image_variance_mm2), np.median(self.covariance[:, 0, 0])
        share = float(of_images / (of_images + of_noise))
        return (1 - share) * self.shared + share * max(count / self.strips, self.shared)

    def corrected(self, amounts: np.ndarray) -> Patches:
        """Return the patches moved by amounts (M,) of the systematic patterns."""
        moved = replace(
            self.averages, places_mm=self.averages.places_mm + np.tensordot(amounts, self.averages.patterns_mm, axes=1)
        )
        places = self.places_mm + np.tensordot(amounts, self.patterns_mm, axes=1)
        return replace(self, places_mm=places, averages=moved)

    def __len__(self) -> int:
        return len(self.places_mm)

    @property
    def normals(self) -> np.ndarray:
        """Unit normals (P, 3)."""
        return self.axes[:, 2]

    @cached_property
    def tree(self) -> KDTree:
        return KDTree(self.places_mm)

    def __getitem__(self, selection: Any) -> Patches:
        """Select patches by a slice, indices or a mask."""
        of_each = ("places_mm", "axes", "shape", "covariance", "numbers", "errors", "image_variance_mm2")
        some = {name: getattr(self, name)[selection] for name in of_each}
        return replace(self, patterns_mm=self.patterns_mm[:, selection], **some)


def surface_patches(
    points_mm: np.ndarray,
    uncertainty: PointUncertainty | None = None,
    *,
    frame: np.ndarray | None = None,
    radius_mm: float | None = None,
) -> Patches:
    """Fit patches to the surface of a cloud.

    Errors of an image's position and pose average only over the images of a disc, and are common to all patches along
    the image.

    ``points_mm`` is (N, 3), ``frame`` (N,) the image of each point. The radius is by default the smallest one with
    enough points on several profiles (`find_disc_radius`).

    Raises EvaluationError if there are too few points, or they form no surface.
    """
    if len(points_mm) < 10 * _FEWEST:
        raise EvaluationError(f"the cloud has {len(points_mm)} points; at least {10 * _FEWEST} are needed")
    radius = radius_mm or find_disc_radius(points_mm)
    averages, owner, first = _average_in_cubes(points_mm, radius / _CELLS_PER_RADIUS, uncertainty)
    means, counts = averages.places_mm, averages.counts
    middle = _select_central(means, radius)
    discs = _gather_discs(averages, means[middle], radius)
    enough = discs.held.sum(axis=1) >= _FEWEST
    middle, discs = middle[enough], discs[enough]
    if not len(middle):
        raise EvaluationError(f"no disc of {radius:.3g} mm radius contains enough points: the cloud is too sparse")
    axes = _find_principal_frames(discs.about_mm, discs.weight)
    fit = _fit_discs(discs, axes, radius)
    variance = fit.point_variance
    kept = variance <= _ROUGH**2 * max(np.median(variance), 1e-30)
    grouped = frame is not None and bool(np.any(frame >= 0))
    variance = noise = np.maximum(variance, np.median(variance))
    if uncertainty is not None:
        known = uncertainty[first[middle]]
        noise = project_variance(known.random_mm2, axes[:, 2]) / radius**2
        of_images = np.sum(project_image_errors(known, axes[:, 2]) ** 2, axis=0) / radius**2
        noise = np.maximum(noise if grouped else noise + of_images, _LEAST_NOISE_MM**2 / radius**2)
        variance = np.maximum(variance, noise)
    units = radius ** np.array([1.0, 0, 0, -1, -1, -1])
    covariance = variance[:, None, None] * fit.inverse
    places, axes, shape = _level(means[middle], axes, fit.shape * units)
    flipped = axes[:, 2, 2] > 0
    one_sided = bool(np.mean(np.abs(axes[:, 2, 2]) > _FACING) > 0.98)
    sign = np.where(flipped, -1.0, 1.0)
    axes = axes * np.stack([np.ones_like(sign), sign, sign], axis=1)[:, :, None]
    # Reversing the second tangent changes the sign of v, and reversing the normal that of the height.
    signs = sign[:, None] ** np.array([1, 1, 2, 1, 2, 1])
    shape = shape * signs
    covariance = covariance * np.outer(units, units) * signs[:, :, None] * signs[:, None]
    images = _compute_image_errors(uncertainty if grouped else None, frame, owner, first)
    errors = PatchErrors(discs.near, fit.heights, radius * np.sqrt(noise), axes[:, 2], counts, *images)
    chosen = np.flatnonzero(kept)
    chosen = chosen[:: max(1, -(-len(chosen) // _MOST))]
    errors = errors[chosen]
    return Patches(
        places[chosen],
        axes[chosen],
        shape[chosen],
        covariance[chosen],
        averages.patterns_mm[:, middle[chosen]],
        first[middle][chosen],
        radius,
        averages,
        errors,
        errors.image_variance(),
        one_sided,
        uncertainty is not None,
        errors.correlation(by_images=False),
        max(float(discs.weight.sum() / counts.sum()), 1.0),
        len(chosen) / errors.correlation(by_images=True),
    )


@dataclass(frozen=True, eq=False)
class _Discs:
    """Averages ``near`` (P, K) in discs, where ``held`` (P, K), their positions from the middles, and their weights."""

    near: np.ndarray
    held: np.ndarray
    about_mm: np.ndarray
    weight: np.ndarray

    def __getitem__(self, selection: Any) -> _Discs:
        return _Discs(*(values[selection] for values in vars(self).values()))


def _gather_discs(averages: Averages, middles_mm: np.ndarray, radius: float) -> _Discs:
    """Find the averages in discs about middles (P, 3)."""
    tree = averages.tree
    found: Any = tree.query(middles_mm, k=min(_NEIGHBOURS, tree.n), distance_upper_bound=radius)
    held = np.isfinite(found[0])
    near = np.where(held, found[1], 0)
    about = averages.places_mm[near] - middles_mm[:, None]
    return _Discs(near, held, about, np.where(held, averages.counts[near], 0.0))


class _DiscFit(NamedTuple):
    """Second-order fits to discs; lengths are in radii, except for ``heights``.

    ``shape`` (P, 6) are coefficients, ``inverse`` (P, 6, 6) is their covariance for a unit variance of one point, and
    ``point_variance`` (P,) is that variance by the scatter. ``heights`` (P, K) are derivatives of the height in the
    middle by the heights of the averages.
    """

    shape: np.ndarray
    inverse: np.ndarray
    point_variance: np.ndarray
    heights: np.ndarray


def _fit_discs(discs: _Discs, axes: np.ndarray, radius: float) -> _DiscFit:
    """Fit second-order surfaces to the averages in discs, over the tangents of ``axes`` (P, 3, 3)."""
    weight = discs.weight
    u, v, w = np.einsum("pij,pkj->ipk", axes, discs.about_mm) / radius
    columns = _compute_terms(u, v)
    weighted = weight[:, :, None] * columns
    normal = weighted.transpose(0, 2, 1) @ columns
    # Points on a line leave second-order terms undetermined. A ridge of 1e-6 of the total weight sets these to zero.
    ridge = 1e-6 * weight.sum(axis=1)[:, None, None] * np.eye(6)
    inverse = np.linalg.inv(normal + ridge)
    shape = (inverse @ (weighted.transpose(0, 2, 1) @ w[:, :, None]))[:, :, 0]
    left = np.where(discs.held, w - (columns @ shape[:, :, None])[:, :, 0], 0.0)
    # Variance of one point: the variance of an average of n points is 1/n of it.
    variance = np.sum(weight * left**2, axis=1) / np.maximum(discs.held.sum(axis=1) - 6, 1)
    return _DiscFit(shape, inverse, variance, (weighted @ inverse[:, 0, :, None])[:, :, 0].astype(np.float32))


def find_disc_radius(points_mm: np.ndarray) -> float:
    """Find the radius of the smallest discs with enough points on several profiles.

    EvaluationError if a tenth of the cloud's size does not suffice, or points repeat.
    """
    size = float(np.linalg.norm(np.ptp(points_mm, axis=0)))
    sample = points_mm[:: max(1, len(points_mm) // _SAMPLE)][:_SAMPLE]
    radius = float(np.median(KDTree(points_mm).query(sample, k=7)[0][:, 6])) * np.sqrt(_FEWEST)
    if radius == 0:
        raise EvaluationError("most points have six others at the same place: omit repeated points")
    while radius < _LARGEST_PATCH * size:
        averages, *_ = _average_in_cubes(points_mm, radius / _CELLS_PER_RADIUS)
        discs = _gather_discs(averages, averages.places_mm[:: max(1, len(averages.counts) // _SAMPLE)], radius)
        spread = np.linalg.eigvalsh(np.einsum("pk,pki,pkj->pij", 1.0 * discs.held, discs.about_mm, discs.about_mm))
        enough = discs.held.sum(axis=1) >= 2 * _FEWEST
        round_ = spread[:, 1] > _ROUND * spread[:, 2]
        if np.mean(enough & round_) > 0.6:
            return radius
        radius *= 1.25
    raise EvaluationError("the spacing of the points is too large to find their surface: scan with a smaller step")


@dataclass(frozen=True, eq=False)
class PatchDistances:
    """Q distances of patches from the patches of another cloud, in the common frame."""

    # (Q,) int; numbers of the patches.
    source: np.ndarray
    target: np.ndarray
    # (Q, 3); centre of the source patch, and normal of the target surface below it.
    places_mm: np.ndarray
    normals: np.ndarray
    # (Q,); distance along the normal, positive on its side, and its standard deviation by noise of both patches.
    distance_mm: np.ndarray
    std_mm: np.ndarray
    slope_variance: np.ndarray  # (Q,); variance of the normal's slope in each tangential direction
    target_errors: PatchErrors | None = None
    """Effect of the target's errors on its heights, if its surface was fitted again."""
    target_patterns_mm: np.ndarray | None = None
    """(Q, M, 3) or None; systematic patterns of the target at the foot of each distance, if its surface was fitted
    again."""

    def __getitem__(self, selection: np.ndarray) -> PatchDistances:
        """Select distances by indices or a mask."""
        return replace(self, **{name: value[selection] for name, value in vars(self).items() if value is not None})


def distances_between(
    source: Patches, source_pose: np.ndarray, target: Patches, target_pose: np.ndarray, *, reach_mm: float
) -> PatchDistances:
    """Measure the distances of the patches of one cloud from the surface of another.

    A patch is used if the nearest target patch has a similar normal and a lateral offset below one radius, so that no
    surface is extrapolated.

    The poses (4, 4) transform the frame of each cloud to the common frame; ``reach_mm`` is the largest distance.
    """
    places = source.places_mm @ source_pose[:3, :3].T + source_pose[:3, 3]
    inverse = target_pose[:3, :3].T
    local = (places - target_pose[:3, 3]) @ inverse.T
    within = float(np.hypot(reach_mm, target.radius_mm))
    found: Any = target.tree.query(local, distance_upper_bound=within)
    rows = np.flatnonzero(np.isfinite(found[0]))
    nearest = found[1][rows]
    u, v, w = np.einsum("qij,qj->iq", target.axes[nearest], local[rows] - target.places_mm[nearest])
    shape = target.shape[nearest]
    columns = _compute_terms(u, v)
    slopes = np.stack(
        [shape[:, 1] + 2 * shape[:, 3] * u + shape[:, 4] * v, shape[:, 2] + shape[:, 4] * u + 2 * shape[:, 5] * v]
    )
    steep = np.sqrt(1 + np.sum(slopes**2, axis=0))
    distance = (w - np.einsum("qa,qa->q", columns, shape)) / steep
    tilted = np.stack([-slopes[0] / steep, -slopes[1] / steep, 1 / steep], axis=1)
    normals = np.einsum("qi,qij->qj", tilted, target.axes[nearest]) @ target_pose[:3, :3].T
    facing = np.einsum("qi,qi->q", normals, source.normals[rows] @ source_pose[:3, :3].T)
    if not (source.one_sided and target.one_sided):
        facing = np.abs(facing)
    good = (facing > _SAME_WAY) & (np.hypot(u, v) < target.radius_mm) & (np.abs(distance) < reach_mm)
    rows, nearest, columns = rows[good], nearest[good], columns[good]
    covariance = target.covariance[nearest]
    of_target = np.einsum("qa,qa->q", columns, (covariance @ columns[:, :, None])[:, :, 0])
    variance = source.covariance[rows, 0, 0] + of_target
    variance += source.image_variance_mm2[rows] + target.image_variance_mm2[nearest]
    return PatchDistances(
        rows,
        nearest,
        places[rows],
        normals[good],
        distance[good],
        np.sqrt(np.maximum(variance, 1e-12)),
        (covariance[:, 1, 1] + covariance[:, 2, 2]) / 2,
    )


def refit_distances(found: PatchDistances, source: Patches, target: Patches, target_pose: np.ndarray) -> PatchDistances:
    """Measure distances again, from second-order fits to the target's points about the foot of each distance.

    Both surfaces are then smoothed in the same way, and errors of their second-order approximation cancel. Feet whose
    height is less certain than a single point are omitted.
    """
    rotation, radius = target_pose[:3, :3], target.radius_mm
    places = (found.places_mm - target_pose[:3, 3]) @ rotation
    feet = places - found.distance_mm[:, None] * (found.normals @ rotation)
    discs = _gather_discs(target.averages, feet, radius)
    enough = discs.held.sum(axis=1) >= _FEWEST
    found, places, feet, discs = found[enough], places[enough], feet[enough], discs[enough]
    axes = target.axes[found.target]
    fit = _fit_discs(discs, axes, radius)
    slopes = fit.shape[:, 1:3]
    normals = np.column_stack([-slopes, np.ones(len(slopes))]) / np.sqrt(1 + np.sum(slopes**2, axis=1))[:, None]
    normals = np.einsum("qi,qij->qj", normals, axes)
    feet = feet + radius * fit.shape[:, :1] * axes[:, 2]
    noise = target.errors.noise_mm[found.target]
    errors = replace(target.errors, near=discs.near, rows=fit.heights, noise_mm=noise, normals=normals)
    variance = source.errors[found.source].noise_variance() + errors.noise_variance()
    variance += source.image_variance_mm2[found.source] + target.image_variance_mm2[found.target]
    patterns = np.zeros((len(feet), len(target.patterns_mm), 3))
    for number, pattern in enumerate(target.averages.patterns_mm):
        patterns[:, number] = np.einsum("qk,qki->qi", fit.heights, pattern[discs.near])
    again = replace(
        found,
        normals=normals @ rotation.T,
        distance_mm=np.einsum("qi,qi->q", places - feet, normals),
        std_mm=np.sqrt(np.maximum(variance, 1e-12)),
        slope_variance=(noise / radius) ** 2 * (fit.inverse[:, 1, 1] + fit.inverse[:, 2, 2]) / 2,
        target_errors=errors,
        target_patterns_mm=patterns,
    )
    return again[fit.inverse[:, 0, 0] < 1]


def rigid_derivatives(places_mm: np.ndarray, directions: np.ndarray, middle_mm: np.ndarray) -> np.ndarray:
    """Return the derivatives (Q, 6) of positions (Q, 3) along directions (Q, 3) by a translation and a rotation vector.

    The rotation is about ``middle_mm`` (3,).
    """
    return np.hstack([directions, np.cross(places_mm - middle_mm, directions)])


def slope_information(
    normals: np.ndarray, noise: np.ndarray, derivatives: Callable[[np.ndarray], np.ndarray]
) -> np.ndarray:
    """Return the information (K, K) on motions that noise of the normals alone would produce.

    ``noise`` (Q,) is the weight of each distance times its slope variance. ``derivatives`` returns the derivatives (Q,
    K) of distances by the motions, for directions (Q, 3) in place of the normals.
    """
    across = np.cross(normals, np.eye(3)[np.argmin(np.abs(normals), axis=1)])
    across /= np.linalg.norm(across, axis=1, keepdims=True)
    parts = (derivatives(directions) for directions in (across, np.cross(normals, across)))
    return sum((by.T @ (noise[:, None] * by) for by in parts), np.zeros(()))


def decompose_motions(
    information: np.ndarray, of_slopes: np.ndarray, *, least_share: float = ROUNDING
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Decompose motions into independent ones, ordered by information relative to that of slope noise.

    A motion is undetermined with less than `LEAST_INFORMATION`, or than ``least_share`` of the best determined one.

    ``information`` and ``of_slopes`` (K, K) are those of the distances and of slope noise (`slope_information`).
    Returns the relative information (K,), ascending; the motions (K, K) in columns, orthonormal in the metric; and the
    metric (K, K), the regularised slope information.
    """
    rounding = least_share / LEAST_INFORMATION * float(np.linalg.eigvalsh(information)[-1])
    metric = of_slopes + max(rounding, np.finfo(float).tiny) * np.eye(len(information))
    values, vectors = eigh(information, metric)
    return values, vectors, metric


def _compute_terms(u: np.ndarray, v: np.ndarray) -> np.ndarray:
    """Return the terms (..., 6) of a second-order surface."""
    return np.stack([np.ones_like(u), u, v, u * u, u * v, v * v], axis=-1)


def _average_in_cubes(
    points: np.ndarray, cell: float, uncertainty: PointUncertainty | None = None
) -> tuple[Averages, np.ndarray, np.ndarray]:
    """Average points in cubes; return also the cube (N,) of each point, and the first point (C,) of each cube."""
    keys = number_cubes(points - points.min(axis=0), cell)
    _, first, owner, counts = np.unique(keys, return_index=True, return_inverse=True, return_counts=True)
    vectors = (points, *(() if uncertainty is None else uncertainty.patterns_mm))
    means = [np.stack([np.bincount(owner, c) for c in each.T], axis=1) / counts[:, None] for each in vectors]
    patterns = np.reshape(means[1:], (-1, len(counts), 3))
    return Averages(means[0], counts.astype(np.float64), patterns), owner, first


def _select_central(points: np.ndarray, spacing: float) -> np.ndarray:
    """Select the point nearest to the centre of each non-empty cube of side ``spacing``."""
    place = (points - points.min(axis=0)) / spacing
    cells = np.floor(place).astype(np.int64)
    order = np.lexsort((np.sum((place - cells - 0.5) ** 2, axis=1), *cells.T))
    return np.sort(order[np.r_[True, np.any(np.diff(cells[order], axis=0), axis=1)]])


def _find_principal_frames(about: np.ndarray, weight: np.ndarray) -> np.ndarray:
    """Return right-handed principal axes (rows of (P, 3, 3)) of weighted points (P, K, 3), the normal last."""
    middle = np.einsum("pk,pki->pi", weight, about) / weight.sum(axis=1)[:, None]
    centred = about - middle[:, None]
    vectors = np.linalg.eigh((weight[:, :, None] * centred).transpose(0, 2, 1) @ centred)[1]
    first, normal = vectors[:, :, 2], vectors[:, :, 0]
    return np.stack([first, np.cross(normal, first), normal], axis=1)


def _level(places: np.ndarray, axes: np.ndarray, shape: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Move the origin of patches onto the surface and align their normals with it.

    Changes of the curvatures, which are of second order in the slope, are neglected.
    """
    slopes = shape[:, 1:3]
    moved = places + shape[:, :1] * axes[:, 2]
    normal = axes[:, 2] - slopes[:, :1] * axes[:, 0] - slopes[:, 1:] * axes[:, 1]
    normal /= np.linalg.norm(normal, axis=1, keepdims=True)
    first = axes[:, 0] - np.einsum("pi,pi->p", axes[:, 0], normal)[:, None] * normal
    first /= np.linalg.norm(first, axis=1, keepdims=True)
    level = shape.copy()
    level[:, :3] = 0
    return moved, np.stack([first, np.cross(normal, first), normal], axis=1), level


def _compute_image_errors(
    known: PointUncertainty | None, frame: np.ndarray | None, owner: np.ndarray, first: np.ndarray
) -> tuple[csr_array, np.ndarray]:
    """Return the fraction (C, I) of points of each average by image, and shifts (J, C, 3) by errors of the image."""
    if known is None or frame is None:
        return csr_array((len(first), 0)), np.zeros((0, len(first), 3))
    shifts = known[first].image_errors_mm()
    numbers = np.unique(frame, return_inverse=True)[1].ravel()
    shares = csr_array((1 / np.bincount(owner)[owner], (owner, numbers)))
    return shares, shifts[shifts.any(axis=(1, 2))].astype(np.float64)
