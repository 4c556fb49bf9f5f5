"""Joint least-squares registration of scans by surface distances, common spheres and prior knowledge.

The unknowns are the pose of each scan except the first, and the amplitudes of the systematic patterns of all scans. A
pose step is a translation (mm) and a rotation vector (rad) about the scan's centroid, in the common frame. Scans that
share a calibration of the sensor or mount share its errors. The prior correlates their pattern amplitudes accordingly.
"""

from __future__ import annotations

from collections.abc import Callable, Collection, Sequence
from dataclasses import dataclass
from functools import partial
from itertools import combinations, pairwise, permutations

import numpy as np
from scipy.sparse import csr_array, diags_array
from scipy.spatial.transform import Rotation

from uwlts.errors import EvaluationError
from uwlts.fitting.least_squares import biweight, rms_distance, robust_std
from uwlts.fitting.patches import (
    LEAST_INFORMATION,
    ROUNDING,
    PatchDistances,
    Patches,
    decompose_motions,
    distances_between,
    refit_distances,
    rigid_derivatives,
    slope_information,
)
from uwlts.registration.marker_spheres import MarkerSphere, group_markers

FEWEST_OF_PAIR = 12  # least number of patches of a usable overlap: two for each of the six parameters of a rigid motion
_OWN_PART = 1e-4
"""Variance of each amplitude that is independent in every scan: 1 % of its errors change with temperature and load."""
_NARROWER = 0.8  # factor on the matching distance from one round to the next
_PAIR_REACH = 4.0
"""Matching distance in the first round of a pair fit (unit: patch radius); a search is accurate to about one radius."""
_PAIR_ROUNDS = 12  # rounds of a pair fit; after seven the matching distance is one patch radius
_LEAST_SPREAD = 0.05
"""Lower bound of the scatter relative to noise that is not stated: exact surfaces agree better than their patches."""
ROUNDS = 60  # largest number of rounds towards each other; 20 rounds narrow the matching distance a hundredfold
_REFITS = 12  # largest number of further rounds, with surfaces fitted again at each distance
_SETTLED = 0.1
"""Step, in standard uncertainties, below which a pose is settled: it would add 0.5 % to the standard uncertainty."""
_STILL_MM = 1e-5  # rms shift of the points, mm, that ends the iteration: far below any measurable change
_SPHERE_REACH = 0.25  # largest distance between the centres of one sphere in two scans, relative to its diameter


@dataclass(frozen=True, eq=False)
class PairEvidence:
    """Linearised observations of one pair of scans."""

    derivatives: np.ndarray
    """(Q, U); derivatives of the residuals by all unknowns. Rows of surface distances come first, then three for
    each sphere."""
    # (Q,); residuals, their weights and their stated standard deviations.
    residuals: np.ndarray
    weights: np.ndarray
    std: np.ndarray
    spread: float
    """Ratio of the robust scatter of the distances to their noise; at least 1 if both scans state their noise."""
    spurious: np.ndarray  # (P, P); information on the poses that noise of the normals alone would produce
    ways: tuple[tuple[int, int, PatchDistances], ...]
    """Source, target and distances in both directions, in the order of the rows."""
    places_mm: np.ndarray  # (patches, 3); positions of the surface distances
    patches: int  # number of surface distances

    @property
    def spheres(self) -> int:
        """Number of common spheres."""
        return (len(self.residuals) - self.patches) // 3

    def normal(self) -> np.ndarray:
        """Return the normal matrix (U, U)."""
        return self.derivatives.T @ (self.weights[:, None] * self.derivatives)

    def gradient(self) -> np.ndarray:
        """Return the gradient (U,) of half the sum of squares."""
        return self.derivatives.T @ (self.weights * self.residuals)

    @property
    def counted(self) -> np.ndarray:
        """Mask (Q,) of the surface distances with a positive weight."""
        return (self.weights > 0) & (np.arange(len(self.weights)) < self.patches)


@dataclass(frozen=True, eq=False)
class PoseSolution:
    """Step of all unknowns in the determined directions."""

    step: np.ndarray  # (U,)
    response: np.ndarray  # (U, U); derivatives of the step by the negative gradient
    by_prior: np.ndarray
    """(U, U); covariance of the step by errors of the initial poses and by the true pattern amplitudes."""
    open_directions: np.ndarray  # (K, P); undetermined directions of the poses


class JointRegistration:
    """Iterative joint estimate with the current `poses` (N, 4, 4) and pattern amplitudes `patterns` (N arrays (M,))."""

    def __init__(
        self,
        patches: Sequence[Patches],
        markers: Sequence[Sequence[MarkerSphere]],
        poses: np.ndarray,
        *,
        start_std: tuple[float, float] | None,
        sphere_mm: float | None,
        shared: Sequence[dict[str, np.ndarray]] | None = None,
        least_share: float = ROUNDING,
    ) -> None:
        self.patches, self.markers, self.start = patches, markers, poses
        self.poses = poses.copy()
        self.patterns = [np.zeros(len(each.patterns_mm)) for each in patches]
        self.start_std, self.sphere_mm, self.least_share = start_std, sphere_mm, least_share
        self.local_middles = np.array([each.places_mm.mean(axis=0) for each in patches])
        self._start_middles_mm = self.middles_mm
        self.sizes = np.array([rms_distance(each.places_mm, each.places_mm.mean(axis=0)) for each in patches])
        ends = 6 * (len(patches) - 1) + np.cumsum([0, *map(len, self.patterns)])
        self.pattern_columns = [np.arange(a, b) for a, b in pairwise(ends)]
        self.pose_columns = [np.arange(6 * (n - 1), 6 * n) if n else np.arange(0) for n in range(len(patches))]
        # Rotations are scaled by the scan's rms radius, so that all pose unknowns are lengths.
        turns = np.repeat(np.array([[1.0, 1 / size] for size in self.sizes[1:]]).ravel(), 3)
        self.units = np.append(turns, np.ones(ends[-1] - ends[0]))
        self.prior_information = _compute_prior_information(self.patterns, shared or [{}] * len(patches))

    @property
    def unknown_poses(self) -> int:
        """Number of pose parameters; the first pose is fixed."""
        return 6 * (len(self.patches) - 1)

    @property
    def middles_mm(self) -> np.ndarray:
        """Centroids (N, 3) of the scans in the common frame."""
        return np.einsum("nij,nj->ni", self.poses[:, :3, :3], self.local_middles) + self.poses[:, :3, 3]

    def measure_distances(self, reach_mm: float, *, refit: bool = False) -> dict[tuple[int, int], PatchDistances]:
        """Measure the patch distances of each ordered pair of scans that overlap within ``reach_mm``.

        With ``refit``, the target's surface is fitted again at each distance (`refit_distances`).
        """
        moved = [patches.corrected(amounts) for patches, amounts in zip(self.patches, self.patterns, strict=True)]
        found = {
            (a, b): distances_between(moved[a], self.poses[a], moved[b], self.poses[b], reach_mm=reach_mm)
            for a, b in permutations(range(len(moved)), 2)
        }
        if refit:
            found = {
                (a, b): refit_distances(distances, moved[a], moved[b], self.poses[b])
                for (a, b), distances in found.items()
            }
        return {pair: distances for pair, distances in found.items() if len(distances.source)}

    def collect_evidence(self, found: dict[tuple[int, int], PatchDistances]) -> dict[tuple[int, int], PairEvidence]:
        """Linearise the observations of all pairs of scans that overlap or share spheres."""
        others = [np.ones(len(each)) for each in self.patches]
        for (a, _), distances in found.items():
            others[a][distances.source] += 1
        centres = [
            [marker.transform(pose, amounts) for marker in markers]
            for markers, pose, amounts in zip(self.markers, self.poses, self.patterns, strict=True)
        ]
        common = group_markers(centres, _SPHERE_REACH * (self.sphere_mm or 0.0))
        pairs = {}
        for a, b in combinations(range(len(self.patches)), 2):
            ways = _measure_both_ways(found, a, b) if _count_patches(found, a, b) >= FEWEST_OF_PAIR else []
            shared = [(views[a], views[b], len(views)) for views in common if a in views and b in views]
            if ways or shared:
                pairs[a, b] = self._gather_evidence(a, b, ways, others, shared)
        return pairs

    def find_narrow_overlaps(self, found: dict[tuple[int, int], PatchDistances]) -> tuple[tuple[int, int, int], ...]:
        """Return the pairs of scans whose overlap has too few patches to be used, with the number of patches."""
        counts = ((a, b, _count_patches(found, a, b)) for a, b in combinations(range(len(self.patches)), 2))
        return tuple((a, b, count) for a, b, count in counts if 0 < count < FEWEST_OF_PAIR)

    def solve(self, pairs: Sequence[PairEvidence]) -> PoseSolution:
        """Solve for the least-squares step from the observations of pairs and the prior.

        Raises EvaluationError if the uncertainties differ by too many orders of magnitude.
        """
        try:
            return self._solve(pairs)
        except np.linalg.LinAlgError as error:
            raise EvaluationError(
                f"the observations have no solution ({error}): uncertainties of the clouds differ by too many orders "
                "of magnitude"
            ) from error

    def _solve(self, pairs: Sequence[PairEvidence]) -> PoseSolution:
        count, unknown = self.unknown_poses, len(self.units)
        normal, gradient, spurious = np.zeros((unknown, unknown)), np.zeros(unknown), np.zeros((count, count))
        for pair in pairs:
            normal += pair.normal()
            gradient += pair.gradient()
            spurious += pair.spurious
        scale = np.outer(self.units, self.units)
        normal, gradient = normal * scale, gradient * self.units
        spurious *= scale[:count, :count]
        beside = normal[count:, count:] + self.prior_information
        gradient[count:] += self.prior_information @ np.concatenate(self.patterns)
        within = np.linalg.solve(beside, normal[count:, :count])
        reduced = normal[:count, :count] - normal[:count, count:] @ within
        reduced = (reduced + reduced.T) / 2
        values, vectors, metric = decompose_motions(reduced, spurious, least_share=self.least_share)
        known = values > LEAST_INFORMATION
        ways, strengths = vectors[:, known], values[known]
        open_ways = np.linalg.qr(vectors[:, np.logical_not(known)])[0]
        off = self._compute_offset()
        if self.start_std is None:
            ways = ways - open_ways @ (open_ways.T @ ways)
            inverse, by, beforehand = (ways / strengths) @ ways.T, np.eye(count), np.zeros(count)
        else:
            beforehand = np.tile(np.repeat(1 / np.square(self.start_std), 3), count // 6) * self.units[:count] ** 2
            by = metric @ ways
            inverse = np.linalg.inv((by * strengths) @ by.T + np.diag(beforehand))
            by = by @ ways.T
        poses = np.vstack([inverse, -within @ inverse])
        response = poses @ by @ np.hstack([np.eye(count), -within.T])
        response[count:, count:] += np.linalg.inv(beside)
        step = -response @ gradient - poses @ (beforehand * off / self.units[:count])
        if self.start_std is None:
            # Undetermined directions return to the initial pose: far from the solution they may appear determined.
            back = open_ways @ (open_ways.T @ (off / self.units[:count]))
            step -= np.append(back, -within @ back)
        by_prior = response[:, count:] @ self.prior_information @ response[:, count:].T
        by_prior += (poses * beforehand) @ poses.T
        return PoseSolution(self.units * step, response * scale, by_prior * scale, open_ways.T * self.units[:count])

    def covariance(self, pairs: Sequence[PairEvidence], solution: PoseSolution) -> np.ndarray:
        """Return the joint covariance (U, U) of a step by all independent errors of the scans and by the prior.

        The distances of the pairs must be refitted (`measure_distances`).
        """
        information = np.zeros((len(self.units),) * 2)
        changes: dict[int, np.ndarray] = {}
        for pair in pairs:
            weighted = pair.weights[:, None] * pair.derivatives
            information += weighted[pair.patches :].T @ pair.derivatives[pair.patches :]
            first = 0
            for source, target, found in pair.ways:
                rows = pair.spread * weighted[first : first + len(found.source)]
                first += len(found.source)
                for number, by_errors in self._compute_height_changes(source, target, found):
                    changes[number] = changes.get(number, 0.0) + by_errors.T @ rows
        for each in changes.values():
            information += each.T @ each
        return solution.response @ information @ solution.response.T + solution.by_prior

    def _compute_height_changes(self, source: int, target: int, found: PatchDistances) -> list[tuple[int, csr_array]]:
        """Return the changes (Q, E) of distances by the independent errors of both scans, with the scans' numbers."""
        errors = self.patches[source].errors[found.source]
        # Without a known side, the normals of both surfaces may have opposite signs.
        sign = np.sign(np.einsum("qi,qi->q", found.normals @ self.poses[source, :3, :3], errors.normals))
        parts = [(source, csr_array(diags_array(sign) @ errors.height_changes()))]
        if found.target_errors is not None:
            parts.append((target, -found.target_errors.height_changes()))
        return parts

    def largest_move(self, solution: PoseSolution, covariance: np.ndarray) -> float:
        """Return the largest component of the poses' step in standard uncertainties, without undetermined directions.

        ``covariance`` (U, U) is that of the solution.
        """
        units = self.units[: self.unknown_poses]
        step, ways = solution.step[: len(units)] / units, solution.open_directions / units
        std = np.sqrt(np.diag(covariance)[: len(units)]) / units
        step = step - ways.T @ (ways @ step)
        return float(np.max(np.abs(step) / np.where(std > 0, std, np.inf), initial=0.0))

    def move(self, step: np.ndarray) -> None:
        """Update poses and pattern amplitudes by a step (U,)."""
        middles = self.middles_mm
        for number, columns in enumerate(self.pose_columns):
            if not len(columns):
                continue
            shift, turn = step[columns].reshape(2, 3)
            rotation = Rotation.from_rotvec(turn).as_matrix()
            pose, middle = self.poses[number], middles[number]
            pose[:3, 3] = rotation @ (pose[:3, 3] - middle) + middle + shift
            pose[:3, :3] = rotation @ pose[:3, :3]
        self.patterns = [z + step[columns] for z, columns in zip(self.patterns, self.pattern_columns, strict=True)]

    def _gather_evidence(
        self,
        a: int,
        b: int,
        ways: list[tuple[int, int, PatchDistances]],
        others: list[np.ndarray],
        spheres: list[tuple[MarkerSphere, MarkerSphere, int]],
    ) -> PairEvidence:
        unknown, middles = len(self.units), self.middles_mm
        relative = np.concatenate([each.distance_mm / each.std_mm for *_, each in ways]) if ways else np.empty(0)
        stated = self.patches[a].noise_stated and self.patches[b].noise_stated
        spread = max(robust_std(relative) if ways else 1.0, 1.0 if stated else _LEAST_SPREAD)
        rows, spurious = [], np.zeros((self.unknown_poses, self.unknown_poses))
        for source, target, found in ways:
            std = found.std_mm * spread
            # Each pair is measured in both directions. K scans of one place form K (K - 1) / 2 pairs, but only K - 1
            # independent differences.
            each = 1 / (others[source][found.source] * self.patches[source].correlated_count(len(found.source)))
            weight = biweight(found.distance_mm / std) / std**2 * each
            by_poses = partial(self._differentiate, source, target, found.places_mm)
            block = np.zeros((len(weight), unknown))
            block[:, : self.unknown_poses] = by_poses(found.normals)
            shifts_there, other = (
                self.patches[n].patterns_mm[:, chosen].transpose(1, 0, 2)
                for n, chosen in ((source, found.source), (target, found.target))
            )
            if found.target_patterns_mm is not None:
                other = found.target_patterns_mm
            for number, shifts, sign in ((source, shifts_there, 1.0), (target, other, -1.0)):
                turned = shifts @ self.poses[number, :3, :3].T
                block[:, self.pattern_columns[number]] = sign * np.einsum("qmi,qi->qm", turned, found.normals)
            rows.append((block, found.distance_mm, weight, found.std_mm))
            # A scatter above the noise may come from a deformation, which does not turn the normals.
            spurious += slope_information(
                found.normals, weight * min(spread, 1.0) ** 2 * found.slope_variance, by_poses
            )
        for first, second, views in spheres:
            covariance = first.covariance + second.covariance
            root = np.linalg.cholesky(np.linalg.inv(covariance)).T
            off = root @ (first.centre_mm - second.centre_mm)
            block = np.zeros((3, unknown))
            for number, marker, sign in ((a, first, 1.0), (b, second, -1.0)):
                if len(columns := self.pose_columns[number]):
                    block[:, columns] = sign * rigid_derivatives(marker.centre_mm, root, middles[number])
                block[:, self.pattern_columns[number]] = sign * root @ marker.patterns_mm.T
            # Spheres are scaled by the same spread as surfaces, since they would otherwise dominate a poor fit.
            rows.append((block, off, np.full(3, 2 / views / max(spread, 1.0) ** 2), np.ones(3)))
        derivatives, residuals, weights, std = (np.concatenate(each) for each in zip(*rows, strict=True))
        places = np.concatenate([np.empty((0, 3)), *(found.places_mm for *_, found in ways)])
        known = derivatives, residuals, weights, std, spread, spurious
        return PairEvidence(*known, tuple(ways), places, len(relative))

    def _differentiate(self, source: int, target: int, places: np.ndarray, directions: np.ndarray) -> np.ndarray:
        """Return the derivatives (Q, P), by all poses, of distances between two scans along directions (Q, 3)."""
        block, middles = np.zeros((len(places), self.unknown_poses)), self.middles_mm
        for number, sign in ((source, 1.0), (target, -1.0)):
            if len(columns := self.pose_columns[number]):
                block[:, columns] = sign * rigid_derivatives(places, directions, middles[number])
        return block

    def _compute_offset(self) -> np.ndarray:
        """Return the translations and rotations (P,) of the poses relative to the initial poses."""
        turned = Rotation.from_matrix(self.poses[1:, :3, :3] @ self.start[1:, :3, :3].transpose(0, 2, 1)).as_rotvec()
        return np.hstack([(self.middles_mm - self._start_middles_mm)[1:], turned]).ravel()


def approach(
    joint: JointRegistration, reach_mm: float, names: Sequence[str], progress: Callable[[int], None] = lambda done: None
) -> float:
    """Move the poses until they rest, with less and less matching distance; return the last one.

    It starts at ``reach_mm`` and ends at two patch radii. ``progress`` is called with the number of rounds done. Raises
    EvaluationError if a scan overlaps no other one.
    """
    least = 2 * max(each.radius_mm for each in joint.patches)
    reach = max(reach_mm, least)
    for done in range(ROUNDS):
        pairs = joint.collect_evidence(joint.measure_distances(reach))
        _require_connected(pairs, names)
        step = joint.solve(list(pairs.values())).step
        joint.move(step)
        progress(done + 1)
        moved = step[: joint.unknown_poses] / joint.units[: joint.unknown_poses]
        if reach <= least and np.abs(moved).max() < _STILL_MM:
            break
        reach = max(_NARROWER * reach, least)
    return reach


def settle(
    joint: JointRegistration, reach_mm: float, names: Sequence[str]
) -> tuple[dict[tuple[int, int], PatchDistances], dict[tuple[int, int], PairEvidence], PoseSolution, np.ndarray]:
    """Move the poses until they are settled; return distances, evidence, the last solution, and its covariance (U, U).

    Raises EvaluationError if a further step would move a pose by more than its standard uncertainty.
    """
    rounds = 0
    while True:
        distances = joint.measure_distances(reach_mm, refit=True)
        pairs = joint.collect_evidence(distances)
        _require_connected(pairs, names)
        solution = joint.solve(list(pairs.values()))
        covariance = joint.covariance(list(pairs.values()), solution)
        moves = joint.largest_move(solution, covariance)
        if moves < _SETTLED or (rounds == _REFITS and moves <= 1):
            return distances, pairs, solution, covariance
        if rounds == _REFITS:
            raise EvaluationError(
                f"the registration does not converge: the next round would move a scan by {moves:.2g} standard "
                "uncertainties. Give more accurate initial poses, or scans with more overlap"
            )
        joint.move(solution.step)
        rounds += 1


def fit_pair(source: Patches, target: Patches, start: np.ndarray) -> tuple[np.ndarray, PatchDistances] | None:
    """Fit the pose (4, 4) that moves ``source`` onto ``target``; return it and the remaining distances.

    Return None if the patches do not overlap, or if their shape leaves a direction undetermined. A plane or a plain
    pipe does so.
    """
    joint = JointRegistration([target, source], [[], []], np.array([np.eye(4), start]), start_std=None, sphere_mm=None)
    reach = _PAIR_REACH * max(source.radius_mm, target.radius_mm)
    for _ in range(_PAIR_ROUNDS):
        if not (pairs := joint.collect_evidence(joint.measure_distances(reach))):
            return None
        joint.move(joint.solve(list(pairs.values())).step)
        reach = max(_NARROWER * reach, source.radius_mm)
    pairs = joint.collect_evidence(joint.measure_distances(reach))
    if not pairs or len(joint.solve(list(pairs.values())).open_directions):
        return None
    return joint.poses[1], distances_between(source, joint.poses[1], target, np.eye(4), reach_mm=reach)


def _measure_both_ways(
    found: dict[tuple[int, int], PatchDistances], a: int, b: int
) -> list[tuple[int, int, PatchDistances]]:
    """Return source, target and distances of two scans in both directions, where they overlap."""
    return [(*way, found[way]) for way in ((a, b), (b, a)) if way in found]


def _count_patches(found: dict[tuple[int, int], PatchDistances], a: int, b: int) -> int:
    """Count the patches in the overlap of two scans."""
    return sum(len(distances.source) for *_, distances in _measure_both_ways(found, a, b))


def _compute_prior_information(patterns: Sequence[np.ndarray], shared: Sequence[dict[str, np.ndarray]]) -> np.ndarray:
    """Return the prior information (U, U) on the pattern amplitudes of all scans, each of unit variance."""
    ends = np.cumsum([0, *map(len, patterns)])
    covariance = (1 + _OWN_PART) * np.eye(ends[-1])
    for a, b in permutations(range(len(patterns)), 2):
        for name in shared[a].keys() & shared[b].keys():
            if shared[a][name].shape[1] == shared[b][name].shape[1]:
                covariance[ends[a] : ends[a + 1], ends[b] : ends[b + 1]] += shared[a][name] @ shared[b][name].T
    # Keep the matrix positive definite despite rounding and inconsistent shared parts.
    least = float(np.linalg.eigvalsh(covariance)[0]) if len(covariance) else 1.0
    return np.linalg.inv(covariance + max(_OWN_PART - least, 0.0) * np.eye(ends[-1]))


def _require_connected(pairs: Collection[tuple[int, int]], names: Sequence[str]) -> None:
    """Raise EvaluationError if a scan is not connected with the first by overlaps."""
    reached = {0}
    while more := {number for pair in pairs if reached & set(pair) for number in pair} - reached:
        reached |= more
    if lost := [names[number] for number in range(len(names)) if number not in reached]:
        raise EvaluationError(
            f"{', '.join(lost)}: not connected with {names[0]} by overlaps. Give better initial poses, a larger "
            "reach or spheres, or search for the initial poses (search)"
        )
