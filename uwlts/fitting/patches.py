"""Second-order patches of a cloud's surface with covariance, and distances between two sets of patches.

A patch is a second-order fit to the points of a disc. Unlike a plane, it is unbiased on curved surfaces. Its covariance
gives the noise of distances and slopes.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import numpy as np
from scipy.linalg import eigh
from scipy.sparse import csr_array
from scipy.spatial import KDTree

from uwlts.errors import EvaluationError
from uwlts.fitting.patch_errors import PatchErrors
from uwlts.storage.cloud import PointUncertainty, project_image_errors, project_variance

_CELLS_PER_RADIUS = 3.0
"""Averaging cubes per disc radius: a disc contains 28 averages for 6 coefficients."""
_NEIGHBOURS = 40
_FEWEST = 10
"""Least number of averages in a disc; a second-order surface has 6 coefficients."""
_ROUND = 0.3
"""Least squared ratio of a disc's narrow to its wide extent; distant profiles give strips instead of discs."""
_LARGEST_PATCH = 0.1
"""Largest disc radius relative to the cloud's size; a larger disc is not local."""
_ROUGH = 5.0
"""Largest ratio of a patch's scatter to the median scatter; patches on edges exceed it."""
_MOST = 15_000
"""Number of patches above which they are thinned."""
_SAMPLE = 400
"""Number of discs used to find the radius."""
_SAME_WAY = 0.8
"""Least cosine (37 deg) between the normals of corresponding patches."""
_FACING = 0.15
"""Least cosine (81 deg) between a normal and the viewing direction; a sensor sees little of steeper surfaces."""

LEAST_INFORMATION = 5.0
"""Least information on a determined motion, relative to the information that noise of the normals alone produces."""
_ROUNDING = 1e-9
"""Least information above rounding noise, relative to the information on the best determined motion."""


@dataclass(frozen=True, eq=False)
class Patches:
    """P patches of the surface of a cloud, in its frame.

    Attributes
    ----------
    places_mm : (P, 3) float64
        Centre of each patch, on the surface.
    axes : (P, 3, 3) float64
        Two tangents and the unit normal, in rows.
    shape : (P, 6) float64
        Coefficients of the height over the tangents: 1, u, v, u2, uv, v2.
    covariance : (P, 6, 6) float64
        Covariance of the shape by noise of the points.
    patterns_mm : (M, P, 3) float64
        Shift of each patch for one standard deviation of each systematic pattern (`PointUncertainty`).
    numbers : (P,) int
        Number of a point near the centre of the patch.
    radius_mm : float
        Radius of the discs.
    errors : PatchErrors
        Independent errors of the cloud, and their effect on the patches.
    shared : float
        Variance of the mean height of all patches by noise, relative to that of as many independent patches.
    one_sided : bool
        True if all normals point to the sensor (-Z); otherwise their signs have no meaning.
    by_images : float
        Fraction of the median patch variance due to image errors, which are common to all patches along an image.
    strips : float
        Number of strips, as wide as a patch, into which the images are divided.
    """

    places_mm: np.ndarray
    axes: np.ndarray
    shape: np.ndarray
    covariance: np.ndarray
    patterns_mm: np.ndarray
    numbers: np.ndarray
    radius_mm: float
    errors: PatchErrors
    shared: float
    one_sided: bool
    by_images: float = 0.0
    strips: float = 1.0

    def correlated_count(self, count: int) -> float:
        """Return the number of patches that carry the information of one independent patch, among ``count`` patches."""
        along = max(count / self.strips, self.shared)
        return (1 - self.by_images) * self.shared + self.by_images * along

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
        return Patches(
            self.places_mm[selection],
            self.axes[selection],
            self.shape[selection],
            self.covariance[selection],
            self.patterns_mm[:, selection],
            self.numbers[selection],
            self.radius_mm,
            self.errors[selection],
            self.shared,
            self.one_sided,
            self.by_images,
            self.strips,
        )


def surface_patches(
    points_mm: np.ndarray,
    uncertainty: PointUncertainty | None = None,
    *,
    frame: np.ndarray | None = None,
    radius_mm: float | None = None,
) -> Patches:
    """Fit patches to the surface of a cloud.

    Errors of an image's position and pose average only over the images of a disc, and are common to all patches along
    an image.

    Parameters
    ----------
    points_mm : (N, 3)
        Points of the cloud.
    uncertainty, frame
        Uncertainty of the points, and the image (N,) of each point.
    radius_mm
        Radius of the discs; by default the smallest one with enough points on several profiles (`find_disc_radius`).

    Raises
    ------
    EvaluationError
        There are too few points, or they form no surface.
    """
    if len(points_mm) < 10 * _FEWEST:
        raise EvaluationError(f"the cloud has {len(points_mm)} points; at least {10 * _FEWEST} are needed")
    radius = radius_mm or find_disc_radius(points_mm)
    owner, means, counts = _average_in_cubes(points_mm, radius / _CELLS_PER_RADIUS)
    middle = _select_central(means, radius)
    away, near = _nearest_within(KDTree(means), means[middle], radius)
    held = np.isfinite(away)
    enough = held.sum(axis=1) >= _FEWEST
    middle, near, held = middle[enough], near[enough], held[enough]
    if not len(middle):
        raise EvaluationError(f"no disc of {radius:.3g} mm radius contains enough points: the cloud is too sparse")
    near = np.where(held, near, 0)
    about = means[near] - means[middle][:, None]
    weight = np.where(held, counts[near], 0.0)
    axes = _principal_frames(about, weight)
    u, v, w = np.einsum("pij,pkj->ipk", axes, about) / radius
    columns = _columns(u, v)
    normal = np.einsum("pka,pk,pkb->pab", columns, weight, columns)
    # Points on a line leave second-order terms undetermined. A ridge of 1e-6 of the total weight sets these to zero.
    ridge = 1e-6 * weight.sum(axis=1)[:, None, None] * np.eye(6)
    inverse = np.linalg.inv(normal + ridge)
    shape = np.einsum("pab,pkb,pk,pk->pa", inverse, columns, weight, w)
    left = np.where(held, w - np.einsum("pka,pa->pk", columns, shape), 0.0)
    freedom = np.maximum(held.sum(axis=1) - 6, 1)
    # Variance of one point: the variance of an average of n points is 1/n of it.
    variance = np.einsum("pk,pk,pk->p", weight, left, left) / freedom
    kept = variance <= _ROUGH**2 * max(np.median(variance), 1e-30)
    first, grouped = _first_points(owner), frame is not None and bool(np.any(frame >= 0))
    if uncertainty is not None:
        known = uncertainty[first[middle]]
        stated = project_variance(known.random_mm2, axes[:, 2]) / radius**2
        of_images = np.sum(project_image_errors(known, axes[:, 2]) ** 2, axis=0) / radius**2
        # Errors of images scatter too, without averaging over the points of an image. They are added below.
        scatter = variance - of_images * weight.sum(axis=1) / held.sum(axis=1) if grouped else variance
        variance = np.maximum(scatter, stated if grouped else stated + of_images)
    variance = np.maximum(variance, np.median(variance))
    covariance = variance[:, None, None] * inverse
    units = radius ** np.array([1.0, 0, 0, -1, -1, -1])
    by_height = np.einsum("pab,pkb,pk->pak", inverse, columns, weight) * (units / radius)[:, None]
    places, axes, shape = _level(means[middle], axes, shape * units)
    flipped = axes[:, 2, 2] > 0
    one_sided = bool(np.mean(np.abs(axes[:, 2, 2]) > _FACING) > 0.98)
    sign = np.where(flipped, -1.0, 1.0)
    axes = axes * np.stack([np.ones_like(sign), sign, sign], axis=1)[:, :, None]
    # Reversing the second tangent changes the sign of v, and reversing the normal that of the height.
    signs = sign[:, None] ** np.array([1, 1, 2, 1, 2, 1])
    shape = shape * signs
    covariance = covariance * np.outer(units, units) * signs[:, :, None] * signs[:, None]
    patterns = _patch_patterns(uncertainty, owner, middle, len(counts))
    errors = PatchErrors(
        near,
        (by_height * (signs * sign[:, None])[:, :, None]).astype(np.float32),
        radius * np.sqrt(variance),
        counts,
        *(_image_errors(uncertainty, frame, owner, first) if grouped else _no_image_errors(len(counts))),
    )
    parts = (places, axes, shape, covariance, patterns, first[middle])
    patches = Patches(*parts, radius, errors, 1.0, one_sided)
    chosen = np.flatnonzero(kept)
    return _with_correlation(patches[chosen[:: max(1, -(-len(chosen) // _MOST))]])


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
        means = _average_in_cubes(points_mm, radius / _CELLS_PER_RADIUS)[1]
        away, near = _nearest_within(KDTree(means), means[:: max(1, len(means) // _SAMPLE)], radius)
        held = np.isfinite(away)
        near = np.where(held, near, 0)
        about = means[near] - means[near[:, 0]][:, None]
        spread = np.linalg.eigvalsh(np.einsum("pk,pki,pkj->pij", 1.0 * held, about, about))
        enough = held.sum(axis=1) >= 2 * _FEWEST
        round_ = spread[:, 1] > _ROUND * spread[:, 2]
        if np.mean(enough & round_) > 0.6:
            return radius
        radius *= 1.25
    raise EvaluationError("the spacing of the points is too large to find their surface: scan with a smaller step")


@dataclass(frozen=True, eq=False)
class PatchDistances:
    """Q distances of patches from the patches of another cloud, in the common frame.

    Attributes
    ----------
    source, target : (Q,) int
        Numbers of the patches.
    columns : (Q, 6) float64
        Terms of the second-order target surface at the foot of the distance.
    places_mm, normals : (Q, 3) float64
        Centre of the source patch, and normal of the target surface below it.
    distance_mm, std_mm : (Q,) float64
        Distance along the normal, positive on its side, and its standard deviation by noise of both patches.
    slope_variance : (Q,) float64
        Variance of the normal's slope in each tangential direction.
    """

    source: np.ndarray
    target: np.ndarray
    columns: np.ndarray
    places_mm: np.ndarray
    normals: np.ndarray
    distance_mm: np.ndarray
    std_mm: np.ndarray
    slope_variance: np.ndarray

    def __getitem__(self, selection: np.ndarray) -> PatchDistances:
        """Select distances by indices or a mask."""
        return PatchDistances(*(values[selection] for values in vars(self).values()))


def distances_between(
    source: Patches, source_pose: np.ndarray, target: Patches, target_pose: np.ndarray, *, reach_mm: float
) -> PatchDistances:
    """Measure the distances of the patches of one cloud from the surface of another.

    A patch is used if the nearest target patch has a similar normal and a lateral offset below one radius, so that no
    surface is extrapolated.

    Parameters
    ----------
    source, target
        Patches of both clouds.
    source_pose, target_pose : (4, 4)
        Transforms from the frame of each cloud to the common frame.
    reach_mm
        Largest distance.
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
    columns = _columns(u, v)
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
    variance = source.covariance[rows, 0, 0] + np.einsum("qa,qab,qb->q", columns, covariance, columns)
    return PatchDistances(
        rows,
        nearest,
        columns,
        places[rows],
        normals[good],
        distance[good],
        np.sqrt(np.maximum(variance, 1e-12)),
        (covariance[:, 1, 1] + covariance[:, 2, 2]) / 2,
    )


def rigid_derivatives(places_mm: np.ndarray, directions: np.ndarray, middle_mm: np.ndarray) -> np.ndarray:
    """Return the derivatives (Q, 6) of positions (Q, 3) along directions (Q, 3) by a translation and a rotation vector.

    The rotation is about ``middle_mm`` (3,).
    """
    return np.hstack([directions, np.cross(places_mm - middle_mm, directions)])


def slope_information(
    normals: np.ndarray, noise: np.ndarray, derivatives: Callable[[np.ndarray], np.ndarray]
) -> np.ndarray:
    """Return the information (K, K) on motions that noise of the normals alone would produce.

    Parameters
    ----------
    normals : (Q, 3)
        Normals of the distances.
    noise : (Q,)
        Weight of each distance times its slope variance.
    derivatives
        Function that returns the derivatives (Q, K) of distances by the motions, for directions (Q, 3) as normals.
    """
    across = np.cross(normals, np.eye(3)[np.argmin(np.abs(normals), axis=1)])
    across /= np.linalg.norm(across, axis=1, keepdims=True)
    parts = (derivatives(directions) for directions in (across, np.cross(normals, across)))
    return sum((by.T @ (noise[:, None] * by) for by in parts), np.zeros(()))


def decompose_motions(information: np.ndarray, of_slopes: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Decompose motions into independent ones, ordered by information relative to that of slope noise.

    A motion with less than `LEAST_INFORMATION` is undetermined.

    Parameters
    ----------
    information, of_slopes : (K, K)
        Information of the distances, and that of slope noise (`slope_information`).

    Returns
    -------
    values : (K,)
        Relative information on each motion, ascending.
    motions : (K, K)
        Motions in columns, orthonormal in the metric.
    metric : (K, K)
        Regularised slope information.
    """
    rounding = _ROUNDING / LEAST_INFORMATION * float(np.linalg.eigvalsh(information)[-1])
    metric = of_slopes + max(rounding, np.finfo(float).tiny) * np.eye(len(information))
    values, vectors = eigh(information, metric)
    return values, vectors, metric


def _columns(u: np.ndarray, v: np.ndarray) -> np.ndarray:
    """Return the terms (..., 6) of a second-order surface."""
    return np.stack([np.ones_like(u), u, v, u * u, u * v, v * v], axis=-1)


def _average_in_cubes(points: np.ndarray, cell: float) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Average points in cubes; return the cube (N,) of each point, and means (C, 3) and counts (C,) of the cubes."""
    cells = np.floor((points - points.min(axis=0)) / cell).astype(np.int64)
    size = cells.max(axis=0) + 1
    keys = (cells[:, 0] * size[1] + cells[:, 1]) * size[2] + cells[:, 2]
    _, owner, counts = np.unique(keys, return_inverse=True, return_counts=True)
    means = np.stack([np.bincount(owner, column) for column in points.T], axis=1) / counts[:, None]
    return owner, means, counts.astype(np.float64)


def _select_central(points: np.ndarray, apart: float) -> np.ndarray:
    """Select the point nearest to the centre of each non-empty cube of side ``apart``."""
    place = (points - points.min(axis=0)) / apart
    cells = np.floor(place).astype(np.int64)
    off = np.sum((place - cells - 0.5) ** 2, axis=1)
    order = np.lexsort((off, *cells.T))
    changed = np.any(np.diff(cells[order], axis=0), axis=1)
    return np.sort(order[np.r_[True, changed]])


def _nearest_within(tree: KDTree, places: np.ndarray, radius: float) -> tuple[np.ndarray, np.ndarray]:
    found: Any = tree.query(places, k=min(_NEIGHBOURS, tree.n), distance_upper_bound=radius)
    return found


def _principal_frames(about: np.ndarray, weight: np.ndarray) -> np.ndarray:
    """Return right-handed principal axes (rows of (P, 3, 3)) of weighted points (P, K, 3), the normal last."""
    middle = np.einsum("pk,pki->pi", weight, about) / weight.sum(axis=1)[:, None]
    centred = about - middle[:, None]
    vectors = np.linalg.eigh(np.einsum("pk,pki,pkj->pij", weight, centred, centred))[1]
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


def _first_points(owner: np.ndarray) -> np.ndarray:
    """Return the number of the first point in each cube, from the cubes (N,) of the points."""
    first = np.zeros(int(owner.max()) + 1, np.int64)
    first[owner[::-1]] = np.arange(len(owner))[::-1]
    return first


def _no_image_errors(count: int) -> tuple[csr_array, np.ndarray]:
    return csr_array((count, 0)), np.zeros((0, count, 3))


def _image_errors(
    known: PointUncertainty | None, frame: np.ndarray | None, owner: np.ndarray, first: np.ndarray
) -> tuple[csr_array, np.ndarray]:
    """Return the fraction (C, I) of the points of each average by image, and shifts (J, C, 3) by errors of the image."""
    if known is None or frame is None:
        return _no_image_errors(len(first))
    shifts = known[first].image_errors_mm()
    shifts = shifts[shifts.any(axis=(1, 2))]
    numbers = np.unique(frame, return_inverse=True)[1].ravel()
    counts = np.bincount(owner)
    return csr_array((1 / counts[owner], (owner, numbers))), shifts.astype(np.float64)


def _with_correlation(patches: Patches) -> Patches:
    """Return patches with the variance by image errors and with the correlation of their heights."""
    errors, count = patches.errors, len(patches)
    shared = errors.correlation()
    if not len(errors.image_shifts_mm):
        return replace(patches, shared=shared)
    centres = np.tile(np.eye(6)[0], (count, 1))
    moved = errors.loadings(np.arange(count), centres, patches.normals)[:, len(errors.counts) :]
    of_images = np.asarray((moved * moved).sum(axis=1)).ravel()
    covariance = patches.covariance.copy()
    covariance[:, 0, 0] += of_images
    together = np.sum(np.asarray(moved.sum(axis=0)) ** 2)
    return replace(
        patches,
        covariance=covariance,
        shared=shared,
        by_images=float(np.median(of_images) / np.median(covariance[:, 0, 0])),
        strips=max(float(count * of_images.sum() / together), 1.0) if together > 0 else 1.0,
    )


def _patch_patterns(known: PointUncertainty | None, owner: np.ndarray, middle: np.ndarray, cells: int) -> np.ndarray:
    """Return the patterns (M, P, 3) of patches, averaged over the points of the central cube."""
    if known is None:
        return np.zeros((0, len(middle), 3))
    counts = np.bincount(owner, minlength=cells)[middle]
    return np.array(
        [
            np.stack([np.bincount(owner, column, cells)[middle] for column in pattern.T], 1) / counts[:, None]
            for pattern in known.patterns_mm
        ]
    ).reshape(-1, len(middle), 3)
