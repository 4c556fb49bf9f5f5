"""Pieces of a path, each about as long as the stripe is wide, their surface patches, and settings of an alignment."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from scipy import special
from scipy.spatial import KDTree
from scipy.spatial.transform import Rotation

from uwlts.errors import EvaluationError
from uwlts.fitting.patches import Patches, find_disc_radius, surface_patches
from uwlts.model.trajectory import Trajectory
from uwlts.storage.cloud import PointCloud


@dataclass(frozen=True)
class AlignmentOptions:
    """Settings of `align_trajectory`.

    Values without a data set follow from the method.
    """

    search_sigmas: float = 3.0  # search range in standard deviations of the drift: 99.7 % of normal errors
    pixel: float = 0.5  # pixel of height maps (unit: patch radius): patches resolve no finer structures
    least_spread: float = 1e-3
    """Least product of both variances in an overlap, relative to the median; with less, the maps show no structure."""
    # Sizes of compared structures in height maps (unit: pixel). Coarser slopes are those of a tilted path. Chosen on a
    # simulated loop of 4 m.
    finest_px: float = 1.0
    coarsest_px: float = 12.0
    least_correlation: float = 0.35
    """Least correlation of two height maps of one surface; noise, tilts and gaps reduce it. Chosen on the same loop."""
    proposals: int = 4
    """Number of positions tried for each pair of pieces: the true one and its most similar alternatives."""
    least_lying: float = 0.6
    """Least fraction of coinciding patches after a rigid fit of two pieces, which the drift still deforms. Chosen on
    the same loop."""
    decided_after: int = 4
    """Number of pieces after which a hypothesis is decided: a crossing and its alternatives appear within this number
    of swath widths."""
    rival_share: float = 0.5
    """Least number of patches of a consistent rival position, relative to the best one, that makes a crossing
    ambiguous."""
    least_gain: float = 2.0
    """Least ratio of the navigation's position uncertainty at a crossing to that after the alignment; with less, the
    trajectory is not corrected."""
    fewest_patches: int = 30  # least number of patches of a crossing: five for each parameter of a rigid motion
    # Least fraction of all patches of a crossing, and of its held-out patches, that agree within ``agreeing_sigmas``.
    # Wrong positions reach 0.8 of all patches, since the path adapts, but few held-out ones. Chosen on rendered passes.
    least_agreeing: float = 0.9
    least_held_out: float = 0.8
    fewest_held_out: int = 10  # least number of held-out patches for a test of their fraction
    agreeing_sigmas: float = 5.0
    """Largest distance of an agreeing patch in standard deviations of the noise of the points."""
    held_out_every: int = 5  # one cube in this number is held out of the estimate for validation
    held_out_cube: float = 4.0
    """Side of these cubes (unit: patch radius), large because neighbouring patches share points."""
    intervals: int = 100
    """Number of intervals between regular nodes of the path: within one, a random walk moves by a tenth of its
    total."""
    most_nodes: int = 400  # largest number of nodes in crossings: normal matrices of 3000 unknowns take 72 MB
    node_spacing: float = 0.5
    """Least spacing of nodes in crossings (unit: patch radius). It is doubled while the drift deviates from a straight
    line between nodes by less than the noise of patches. Chosen on simulated passes with a walk of 30 mm."""
    rounds: int = 15  # largest number of least-squares rounds
    still: float = 0.03
    """Root-mean-square step, in standard deviations, that ends the rounds; changes of correspondences cause smaller
    steps."""
    refits: int = 8
    """Largest number of times that patches are refitted along the corrected path, because drift tilts them."""
    settled: float = 0.1  # root-mean-square step, in standard deviations, that ends the refits

    @property
    def gate(self) -> float:
        """Squared Mahalanobis distance in six dimensions with the same probability as ``search_sigmas`` in one."""
        return float(special.chdtri(6, special.chdtrc(1, self.search_sigmas**2)))


_FEWEST_POINTS = 200  # least number of points of a piece with patches
_ACROSS = 1e-6
"""Ridge relative to the extent of a patch's neighbours, which sets the time gradient along the normal to zero."""
_ALONE_MM2 = 1e-9  # ridge of a patch without neighbours, which sets its time gradient to zero


@dataclass(frozen=True, eq=False)
class Survey:
    """Points of a scan, with the platform's positions from its navigation."""

    cloud: PointCloud
    moments_s: np.ndarray  # (M,); times of the images
    image: np.ndarray  # (N,) int; image of each point
    # (M, 3); position and velocity of the platform at each image.
    platform_mm: np.ndarray
    velocity_mm_s: np.ndarray
    parts: tuple[np.ndarray, ...]  # (K,) int; indices of the points of each piece
    radius_mm: float  # radius of patches
    speed_mm_s: float  # speed of the stripe on the surface

    @classmethod
    def from_cloud(cls, cloud: PointCloud, times_s: np.ndarray, trajectory: Trajectory) -> Survey:
        """Divide a cloud into pieces, given the times (N,) of its points on the trajectory's clock.

        EvaluationError if no piece has enough points, or images have a single one.
        """
        moments, image = np.unique(times_s, return_inverse=True)
        order = np.argsort(image, kind="stable")
        by_image = np.split(cloud.points_mm[order], np.searchsorted(image[order], np.arange(1, len(moments))))
        swath = float(np.median([np.linalg.norm(np.ptp(points, axis=0)) for points in by_image]))
        if swath == 0:
            raise EvaluationError("most times of the cloud have a single point: expected the points of a whole stripe")
        middles = np.array([points.mean(axis=0) for points in by_image])
        way = np.append(0.0, np.cumsum(np.linalg.norm(np.diff(middles, axis=0), axis=1)))
        count = max(2, round(way[-1] / swath))
        number = np.minimum((way / way[-1] * count).astype(int), count - 1)[image]
        parts = tuple(np.flatnonzero(number == each) for each in range(count))
        long_enough = tuple(part for part in parts if len(part) >= _FEWEST_POINTS)
        if not long_enough:
            raise EvaluationError(
                f"no piece of the path as long as the stripe is wide ({swath:.0f} mm) has {_FEWEST_POINTS} points: "
                "record images with a smaller spacing"
            )
        radius = find_disc_radius(cloud.points_mm[long_enough[len(long_enough) // 2]])
        platform, velocity = trajectory.poses_at(moments)[:, :3, 3], trajectory.rates_at(moments)[:, :3]
        return cls(cloud, moments, image, platform, velocity, long_enough, radius, way[-1] / float(np.ptp(moments)))

    def points_along(self, part: np.ndarray, corrections: np.ndarray) -> np.ndarray:
        """Return the points (K, 3) with given indices, along the path with corrections (M, 6) of the images."""
        image = self.image[part]
        return correct_places(corrections[image], self.platform_mm[image], self.cloud.points_mm[part])


@dataclass(frozen=True, eq=False)
class Piece:
    """Piece of a path with P surface patches."""

    part: np.ndarray  # (K,) int; indices of its points
    patches: Patches  # patches along the path that was current when they were fitted
    back: np.ndarray  # (P, 3, 3); linear map from the surface around each patch to that along the navigated path
    places_mm: np.ndarray  # (P, 3); positions of the patches along the navigated path
    # (P,) and (P, 3); times of the patches, and the gradient of time over the surface.
    times_s: np.ndarray
    slopes_s_mm: np.ndarray
    # (P, 3); position and velocity of the platform at these times.
    platform_mm: np.ndarray
    velocity_mm_s: np.ndarray
    held_out: np.ndarray  # (P,) bool; patches that validate the estimate

    @property
    def middle_s(self) -> float:
        """Median time of the piece, s."""
        return float(np.median(self.times_s))

    @cached_property
    def middle_patch(self) -> int:
        """Number of the patch nearest to the median time."""
        return int(np.argmin(np.abs(self.times_s - self.middle_s)))

    def along(self, corrections: np.ndarray, rates: np.ndarray) -> Patches:
        """Return the patches along the path with corrections (P, 6) and their rates per second (P, 6).

        Drift between images shears the surface in addition to its rotation.
        """
        places = correct_places(corrections, self.platform_mm, self.places_mm)
        tangents = np.einsum("pij,pkj->pki", self.around(corrections, rates) @ self.back, self.patches.axes[:, :2])
        first = tangents[:, 0] / np.linalg.norm(tangents[:, 0], axis=1, keepdims=True)
        normal = np.cross(first, tangents[:, 1])
        normal /= np.linalg.norm(normal, axis=1, keepdims=True)
        axes = np.stack([first, np.cross(normal, first), normal], axis=1)
        return replace(self.patches, places_mm=places, axes=axes, one_sided=False)

    def around(self, corrections: np.ndarray, rates: np.ndarray) -> np.ndarray:
        """Return the derivatives (P, 3, 3) of corrected positions by navigated positions around patches.

        The corrected position is p' = R(t) (p - X(t)) + X(t) + s(t), with the time t(p). R is the rotation, s the
        translation, and X the platform's position.
        """
        turn = Rotation.from_rotvec(corrections[:, 3:])
        drifting = np.cross(rates[:, 3:], turn.apply(self.places_mm - self.platform_mm)) + rates[:, :3]
        drifting += self.velocity_mm_s - turn.apply(self.velocity_mm_s)
        return turn.as_matrix() + drifting[:, :, None] * self.slopes_s_mm[:, None]


def fit_piece(
    survey: Survey, part: np.ndarray, corrections: np.ndarray, rates: np.ndarray, options: AlignmentOptions
) -> Piece | None:
    """Fit patches to points of indices ``part`` along the corrected path; return None if they form no surface.

    ``corrections`` and ``rates`` (M, 6) are corrections of the poses of all images, and their time derivatives.
    """
    known = None if survey.cloud.uncertainty is None else survey.cloud.uncertainty[part]
    # Errors common to all points do not affect differences between passes.
    known = None if known is None else replace(known, patterns_mm=known.patterns_mm[:0], poses_mm=None)
    try:
        patches = surface_patches(survey.points_along(part, corrections), known, radius_mm=survey.radius_mm)
    except EvaluationError:
        return None
    image = survey.image[part[patches.numbers]]
    platform, times = survey.platform_mm[image], survey.moments_s[image]
    turned_back = Rotation.from_rotvec(-corrections[image, 3:])
    places = turned_back.apply(patches.places_mm - platform - corrections[image, :3]) + platform
    cubes = np.floor(places / (options.held_out_cube * survey.radius_mm)).astype(np.int64)
    held_out = (cubes @ np.array([1, 2, 3])) % options.held_out_every == 0
    slopes = _fit_time_gradients(places, times, 2 * survey.radius_mm)
    piece = Piece(part, patches, np.empty(0), places, times, slopes, platform, survey.velocity_mm_s[image], held_out)
    return replace(piece, back=np.linalg.inv(piece.around(corrections[image], rates[image])))


def _fit_time_gradients(places: np.ndarray, times: np.ndarray, reach_mm: float) -> np.ndarray:
    """Return the gradients (P, 3), s/mm, of times (P,) over places (P, 3), from their neighbours."""
    pairs = KDTree(places).query_pairs(reach_mm, output_type="ndarray")
    first, second = np.vstack([pairs, pairs[:, ::-1]]).T
    about, later = places[second] - places[first], times[second] - times[first]
    normal, right = np.zeros((len(places), 3, 3)), np.zeros((len(places), 3))
    np.add.at(normal, first, about[:, :, None] * about[:, None])
    np.add.at(right, first, about * later[:, None])
    ridge = _ACROSS * np.trace(normal, axis1=1, axis2=2) + _ALONE_MM2
    normal += ridge[:, None, None] * np.eye(3)
    return np.linalg.solve(normal, right[:, :, None])[:, :, 0]


def correct_places(corrections: np.ndarray, platform_mm: np.ndarray, places_mm: np.ndarray) -> np.ndarray:
    """Apply corrections (N, 6) about the platform's positions (N, 3) to places (N, 3)."""
    turned = Rotation.from_rotvec(corrections[:, 3:]).apply(places_mm - platform_mm)
    return turned + platform_mm + corrections[:, :3]
