"""Least-squares correction of a path from distances between pieces and the drift of the navigation.

Motions that the surface does not determine, for example along a plain pipe, keep their prior.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from dataclasses import dataclass, replace
from functools import cache, cached_property
from itertools import product
from typing import Any

import numpy as np
from scipy.linalg import cho_solve, get_lapack_funcs, solve_triangular
from scipy.sparse import csr_array, vstack

from uwlts.alignment.path_prior import DriftModel, PathPrior, candidates_beside
from uwlts.alignment.pieces import AlignmentOptions, Piece, Survey, fit_piece
from uwlts.fitting.least_squares import biweight, noise_factor, rms_distance
from uwlts.fitting.patches import (
    LEAST_INFORMATION,
    PatchDistances,
    Patches,
    decompose_motions,
    distances_between,
    rigid_derivatives,
    slope_information,
)

Pair = tuple[int, int]  # numbers of two pieces that show the same surface, in chronological order


@dataclass(frozen=True, eq=False)
class PathEstimate:
    """Correction of a path by its pairs of crossing pieces."""

    survey: Survey
    options: AlignmentOptions
    prior: PathPrior
    pieces: tuple[Piece, ...]
    pairs: tuple[Pair, ...]
    values: np.ndarray  # (6 C,); translations and rotations at the nodes of the prior
    numbers: np.ndarray  # (6 C,); the same in whitened coordinates, which have a unit covariance in the prior
    factor: np.ndarray  # (6 C, 6 C); lower Cholesky factor of the normal matrix of the whitened coordinates

    def corrections(self, times_s: np.ndarray) -> np.ndarray:
        """Return translations and rotations (N, 6) at times (N,)."""
        return self.prior.evaluate(self.values, times_s)

    def rates(self, times_s: np.ndarray) -> np.ndarray:
        """Return the time derivative (N, 6) of translation and rotation, averaged over a patch at times (N,)."""
        return (self.corrections(times_s + self.half_s) - self.corrections(times_s - self.half_s)) / (2 * self.half_s)

    @property
    def half_s(self) -> float:
        """Time in which the stripe moves by the radius of a patch, s."""
        return self.survey.radius_mm / self.survey.speed_mm_s

    @cached_property
    def image_corrections(self) -> np.ndarray:
        """Translation and rotation (M, 6) of each image."""
        return self.corrections(self.survey.moments_s)

    @cached_property
    def _surfaces(self) -> dict[int, Patches]:
        return {}

    def surface(self, number: int) -> Patches:
        """Return the patches of a piece along the corrected path."""
        if number not in self._surfaces:
            piece = self.pieces[number]
            self._surfaces[number] = piece.along(self.corrections(piece.times_s), self.rates(piece.times_s))
        return self._surfaces[number]

    @property
    def reach_mm(self) -> float:
        """Largest distance of matched patches, mm."""
        return 2 * self.survey.radius_mm

    def points(self, number: int) -> np.ndarray:
        """Return the points (K, 3) of a piece along the corrected path."""
        return self.survey.points_along(self.pieces[number].part, self.image_corrections)

    def distances(self, source: int, target: int, *, reach_mm: float) -> tuple[PatchDistances, np.ndarray]:
        """Measure the distances (Q,) of one piece from another; return them with a mask (Q,) of held-out ones."""
        surfaces = self.surface(source), self.surface(target)
        found = distances_between(surfaces[0], np.eye(4), surfaces[1], np.eye(4), reach_mm=reach_mm)
        return found, self.pieces[source].held_out[found.source] | self.pieces[target].held_out[found.target]

    def measure_distances(self, pair: Pair) -> tuple[PatchDistances, np.ndarray]:
        """Measure the distances of the later piece of a pair from the earlier one, within twice the reach."""
        return self.distances(pair[1], pair[0], reach_mm=2 * self.reach_mm)

    def agrees(self, pair: Pair) -> bool:
        """Check whether the surfaces of a pair agree, including held-out patches."""
        found, held_out = self.measure_distances(pair)
        options = self.options
        fits = np.abs(found.distance_mm) < options.agreeing_sigmas * found.std_mm
        if np.count_nonzero(fits) < options.fewest_patches or np.mean(fits) < options.least_agreeing:
            return False
        judged = np.count_nonzero(held_out) >= options.fewest_held_out
        return bool(not judged or np.mean(fits[held_out]) >= options.least_held_out)

    def relative_movement(self, pair: Pair, at_mm: np.ndarray) -> np.ndarray:
        """Return the derivatives (6, 6 C) of the later piece's motion relative to the earlier one at a place (3,)."""
        basis = self.prior.basis(self._middle_times_s[list(pair)])
        return np.einsum("ipj,pc->ijc", self._compute_relative_twists(pair, at_mm), basis).reshape(6, -1)

    def relative_covariance(self, pair: Pair, at_mm: np.ndarray) -> np.ndarray:
        """Return the covariance (6, 6) of the later piece's motion relative to the earlier one at a place (3,)."""
        by = self._compute_relative_twists(pair, at_mm).reshape(6, 12)
        return by @ self._middle_covariance[np.ix_(pair, range(6), pair, range(6))].reshape(12, 12) @ by.T

    def _compute_relative_twists(self, pair: Pair, at_mm: np.ndarray) -> np.ndarray:
        """Return the derivatives (6, 2, 6) of this motion by the corrections in the middle of both pieces."""
        result = np.zeros((6, 2, 6))
        for column, number, sign in zip((0, 1), pair, (-1.0, 1.0), strict=True):
            piece = self.pieces[number]
            platform = piece.platform_mm[piece.middle_patch]
            platform = platform + self.corrections(piece.times_s[[piece.middle_patch]])[0, :3]
            result[:3, column] = sign * rigid_derivatives(at_mm, np.eye(3), platform)
            result[3:, column, 3:] = sign * np.eye(3)
        return result

    @cached_property
    def _middle_times_s(self) -> np.ndarray:
        """Times (N,) of the middle patches of all pieces, s."""
        return np.array([piece.times_s[piece.middle_patch] for piece in self.pieces])

    @cached_property
    def _middle_covariance(self) -> np.ndarray:
        """Covariance (N, 6, N, 6) of the corrections in the middle of all N pieces."""
        basis = self.prior.basis(self._middle_times_s)
        by = self.prior.times_transposed_root(np.einsum("ij,pc->icpj", np.eye(6), basis).reshape(len(self.values), -1))
        half = solve_triangular(self.factor, by, lower=True, check_finite=False)
        return (half.T @ half).reshape(len(basis), 6, len(basis), 6)

    @cached_property
    def covariance(self) -> np.ndarray:
        """Covariance (6 C, 6 C) of the values at the nodes."""
        root = self.prior.times_root(solve_triangular(self.factor, np.eye(len(self.factor)), lower=True).T)
        return root @ root.T

    def covariance_at(self, times_s: np.ndarray) -> np.ndarray:
        """Return the covariances (N, 6, 6) of the corrections at times (N,)."""
        before, after = self.prior.weights(times_s)
        blocks = self.covariance.reshape(6, self.prior.count, 6, self.prior.count)
        result = np.zeros((len(times_s), 6, 6))
        for (one, of_one), (other, of_other) in product(((before, 1 - after), (before + 1, after)), repeat=2):
            result += (of_one * of_other)[:, None, None] * blocks[:, one, :, other]
        return result


_pivoted_cholesky: Any = get_lapack_funcs("pstrf", dtype=np.float64)
_NEGLIGIBLE = 1e-3
"""Information of all nodes together in units of the drift's variance, below which an observation shows nothing."""


@dataclass(frozen=True, eq=False)
class Hypothesis:
    """Pose in which the later piece of a pair may coincide with the earlier one."""

    pair: Pair
    at_mm: np.ndarray  # (3,); reference point of the rotation
    # (6,); translation (mm) and rotation (rad) of the later piece relative to the earlier one at ``at_mm``, and its
    # standard deviation.
    relative: np.ndarray
    std: np.ndarray
    patches: int  # number of agreeing patches


def initial_estimate(survey: Survey, prior: PathPrior, options: AlignmentOptions) -> PathEstimate:
    """Return the initial estimate, without correction."""
    still, zeros = np.zeros((len(survey.moments_s), 6)), np.zeros(6 * prior.count)
    laid = (fit_piece(survey, part, still, still, options) for part in survey.parts)
    pieces = tuple(piece for piece in laid if piece is not None)
    return PathEstimate(survey, options, prior, pieces, (), zeros, zeros, np.eye(len(zeros)))


def solve(estimate: PathEstimate) -> PathEstimate:
    """Iterate the least-squares steps until they are negligible."""
    for _ in range(estimate.options.rounds):
        before, estimate = estimate.numbers, _solve_step(estimate, *_sum_normal_equations(estimate))
        if _measure_step(estimate, before) < estimate.options.still:
            break
    return estimate


def bring_together(estimate: PathEstimate, hypothesis: Hypothesis) -> PathEstimate:
    """Move the path by a hypothesis, so that the surfaces of its pair match, and add the pair."""
    by, (normal, right) = estimate.relative_movement(hypothesis.pair, hypothesis.at_mm), _sum_normal_equations(estimate)
    weighted = by.T / hypothesis.std**2
    moved = _solve_step(estimate, normal + weighted @ by, right + weighted @ hypothesis.relative[:, None])
    return replace(moved, pairs=(*moved.pairs, hypothesis.pair))


def refine_nodes(estimate: PathEstimate) -> PathEstimate:
    """Return the same correction with dense nodes where pairs overlap; `solve` continues from it.

    Between nodes, the drift deviates from a straight line by less than the noise of patches, or the spacing is
    ``node_spacing``.
    """
    survey, options, drift = estimate.survey, estimate.options, estimate.prior.drift
    even = PathPrior.from_times(survey.moments_s, drift, estimate.prior.trajectory, intervals=options.intervals)
    times, std, arms = [], [], []
    for earlier, later in estimate.pairs:
        found, _ = estimate.measure_distances((earlier, later))
        std += found.std_mm.tolist()
        for number, at in ((later, found.source), (earlier, found.target)):
            piece = estimate.pieces[number]
            times += piece.times_s[at].tolist()
            arms += np.linalg.norm(piece.places_mm[at] - piece.platform_mm[at], axis=1).tolist()
    if not times:
        return _change_prior(estimate, even)
    noise, arm = np.median(std), np.median(arms)
    lasting = float(np.ptp(even.nodes_s))
    step = options.node_spacing * estimate.half_s
    while 2 * step < lasting / options.intervals:
        deviation = drift.deviation(2 * step / lasting)
        if np.hypot(deviation[:3].max(), arm * deviation[3:].max()) > noise:
            break
        step *= 2
    return _change_prior(estimate, even.with_nodes(np.array(times), step, most=options.most_nodes))


def refit(estimate: PathEstimate, numbers: Iterable[int]) -> PathEstimate:
    """Refit the patches of some pieces to their points along the corrected path."""
    pieces, survey = list(estimate.pieces), estimate.survey
    rates = estimate.rates(survey.moments_s)
    for number in numbers:
        laid = fit_piece(survey, pieces[number].part, estimate.image_corrections, rates, estimate.options)
        pieces[number] = laid or pieces[number]
    return replace(estimate, pieces=tuple(pieces))


def settle(estimate: PathEstimate) -> PathEstimate:
    """Estimate path and patches alternately; drop pairs that then disagree.

    If no drift model is stated, the most likely random walk and rates are used.
    """
    estimate = solve(refine_nodes(estimate))
    crossing, selected = {number for pair in estimate.pairs for number in pair}, False
    for _ in range(estimate.options.refits):
        if not selected:
            drift, estimate = estimate.prior.drift, select_drift(estimate)
            selected = estimate.prior.drift is drift
        before, estimate = estimate.numbers, solve(refit(estimate, crossing))
        if selected and _measure_step(estimate, before) < estimate.options.settled:
            break
    agreeing = tuple(pair for pair in estimate.pairs if estimate.agrees(pair))
    return estimate if len(agreeing) == len(estimate.pairs) else settle(replace(estimate, pairs=agreeing))


def select_drift(estimate: PathEstimate, *, walk_only: bool = False) -> PathEstimate:
    """Select random walk and rates of maximum marginal likelihood, by ascent from the present ones, unless stated.

    With ``walk_only``, the rates are kept. A new drift has its own nodes and is without a solution.

    The path is marginalised (empirical Bayes: MacKay, Neural Computation 4, 1992). A normal matrix B B^T corresponds
    to observations B^T x of the path x with unit noise. Their covariance is I + B^T P B for a prior covariance P.
    """
    prior, drift = estimate.prior, estimate.prior.drift
    if drift.stated or not estimate.pairs:
        return estimate
    normal, right = _sum_normal_equations(estimate)
    near = np.flatnonzero(normal.any(axis=0))
    if not len(near):
        return estimate
    size = np.repeat(drift.std, prior.count)[near]
    # Cholesky factor with pivots, which ends before negligible observations.
    packed, order, rank, _ = _pivoted_cholesky(
        size[:, None] * normal[np.ix_(near, near)] * size, tol=_NEGLIGIBLE / len(near), lower=1
    )
    half, order = np.tril(packed)[:, :rank], order - 1
    seen = solve_triangular(half[:rank], (size * right[near, 0])[order[:rank]], lower=True, check_finite=False)
    by = np.zeros((len(normal), rank))
    by[near[order]] = half / size[order, None]
    nodes, at = np.unique(near % prior.count), prior.nodes_s - prior.nodes_s[0]
    parts = by.reshape(6, prior.count, -1)[:, nodes]

    def observed(model: DriftModel) -> np.ndarray:
        each = model.covariance(at[nodes, None], at[nodes], at[-1]) @ parts
        return parts.reshape(-1, rank).T @ each.reshape(-1, rank)

    walk = observed(replace(drift, walk=np.ones(6)))

    @cache
    def by_rates(correlation: float, smooth: bool) -> np.ndarray:
        return observed(replace(drift, walk=np.zeros(6), correlation=correlation, smooth=smooth))

    models = drift.candidates()

    @cache
    def twice_log_likelihood(number: int) -> float:
        model = models[number]
        covariance = (1 - model.walk[0]) * by_rates(model.correlation, model.smooth) + model.walk[0] * walk
        covariance[np.diag_indices(rank)] += 1
        factor = np.linalg.cholesky(covariance)
        off = solve_triangular(factor, seen, lower=True, check_finite=False)
        return float(-np.sum(off**2) - 2 * np.sum(np.log(np.diag(factor))))

    described = (drift.correlation, drift.smooth, drift.walk[0])
    first = best = [(each.correlation, each.smooth, each.walk[0]) for each in models].index(described)
    while (better := max(candidates_beside(best, walk_only=walk_only), key=twice_log_likelihood)) != best:
        best = better
    return estimate if best == first else refine_nodes(with_drift(estimate, models[best]))


def with_drift(estimate: PathEstimate, drift: DriftModel) -> PathEstimate:
    """Return the same correction with another drift, without a solution."""
    return _change_prior(estimate, replace(estimate.prior, drift=drift))


def _change_prior(estimate: PathEstimate, prior: PathPrior) -> PathEstimate:
    """Return the same correction with another prior."""
    values = estimate.corrections(prior.nodes_s).T.ravel()
    zeros = np.zeros(len(values))
    return replace(estimate, prior=prior, values=values, numbers=zeros, factor=np.eye(len(zeros)))


def _measure_step(estimate: PathEstimate, before: np.ndarray) -> float:
    """Return the rms step from earlier whitened coordinates (6 C,), in standard deviations of the estimate."""
    return float(np.sqrt(np.mean((estimate.factor.T @ (estimate.numbers - before)) ** 2)))


def _solve_step(estimate: PathEstimate, normal: np.ndarray, right: np.ndarray) -> PathEstimate:
    """Perform one least-squares step."""
    prior = estimate.prior
    factor = prior.factor(normal)
    numbers = cho_solve((factor, True), prior.times_transposed_root(right))
    return replace(estimate, values=prior.times_root(numbers)[:, 0], numbers=numbers[:, 0], factor=factor)


def _sum_normal_equations(estimate: PathEstimate) -> tuple[np.ndarray, np.ndarray]:
    """Return the normal matrix (6 C, 6 C) and right-hand side (6 C, 1) of the values from all pairs, without prior."""
    count = len(estimate.values)
    parts = [part for pair in estimate.pairs for part in _linearise_pair(estimate, pair)]
    if not parts:
        return np.zeros((count, count)), np.zeros((count, 1))
    blocks, weights, distances = zip(*parts, strict=True)
    derivatives = csr_array(vstack(blocks))
    derivatives.sum_duplicates()
    derivatives.eliminate_zeros()
    weighted = derivatives.multiply(np.concatenate(weights)[:, None]).tocsr()
    total = (derivatives.T @ weighted).toarray()
    return total, (total @ estimate.values - weighted.T @ np.concatenate(distances))[:, None]


def _linearise_pair(estimate: PathEstimate, pair: Pair) -> Iterator[tuple[csr_array, np.ndarray, np.ndarray]]:
    """Yield sparse derivatives (Q, 6 C), weights (Q,) and distances (Q,) of a pair, measured in both directions."""
    ways = []
    for source, target in (pair[::-1], pair):
        found, held_out = estimate.distances(source, target, reach_mm=estimate.reach_mm)
        used = found[~held_out]
        if len(used.source) < estimate.options.fewest_patches // 2:
            continue
        relative = used.distance_mm / used.std_mm
        spread = noise_factor(relative)
        # Each direction has half the weight, and overlapping patches share points.
        shared = 2 * estimate.pieces[source].patches.overlap
        ways.append((source, target, used, biweight(relative / spread) / (used.std_mm * spread) ** 2 / shared))
    if not ways:
        return
    middle = np.vstack([used.places_mm for _, _, used, _ in ways]).mean(axis=0)
    twists = [rigid_derivatives(used.places_mm, used.normals, middle) for _, _, used, _ in ways]
    observable = _project_observable([(*way[2:], twist) for way, twist in zip(ways, twists, strict=True)], middle)
    component, half_s = estimate.prior.count * np.arange(6), estimate.half_s
    for (source, target, used, weight), twist in zip(ways, twists, strict=True):
        seen, columns, values = twist @ observable, [], []
        for number, at, sign in ((source, used.source, 1.0), (target, used.target, -1.0)):
            piece, by = estimate.pieces[number], seen.copy()
            # Points off the centre of a patch were measured slightly earlier or later.
            off = used.places_mm - estimate.surface(number).places_mm[at]
            later, times = np.einsum("qi,qi->q", piece.slopes_s_mm[at], off), piece.times_s[at]
            # Rotations of the path are about the platform.
            platform = piece.platform_mm[at] + later[:, None] * piece.velocity_mm_s[at]
            by[:, 3:] += np.cross(middle - platform - estimate.corrections(times)[:, :3], by[:, :3])
            # The surface of a patch moves with the rates averaged over it.
            tilt = later / (2 * half_s)
            for moment, part in ((times, 1.0), (times + half_s, tilt), (times - half_s, -tilt)):
                before, after = estimate.prior.weights(moment)
                for node, share in ((before, part * (1 - after)), (before + 1, part * after)):
                    columns.append(node[:, None] + component)
                    values.append(sign * share[:, None] * by)
        ends = np.arange(0, 6 * len(columns) * len(weight) + 1, 6 * len(columns))
        places = np.hstack(values).ravel(), np.hstack(columns).ravel(), ends
        yield csr_array(places, shape=(len(weight), len(estimate.values))), weight, used.distance_mm


def _project_observable(ways: list[tuple[PatchDistances, np.ndarray, np.ndarray]], middle: np.ndarray) -> np.ndarray:
    """Return the projection (6, 6) of a motion onto the part that the surfaces determine.

    ``ways`` are distances, their weights (Q,), and their derivatives (Q, 6) by translation and rotation about
    ``middle`` (3,).
    """
    normal, feigned = np.zeros((6, 6)), np.zeros((6, 6))
    places = np.vstack([used.places_mm for used, *_ in ways])
    scale = np.repeat([1.0, 1 / rms_distance(places, middle)], 3)
    for used, weight, twist in ways:
        by = twist * scale
        normal += by.T @ (weight[:, None] * by)

        def scaled_twists(directions: np.ndarray, places: np.ndarray = used.places_mm) -> np.ndarray:
            return rigid_derivatives(places, directions, middle) * scale

        feigned += slope_information(used.normals, weight * used.slope_variance, scaled_twists)
    information, movements, metric = decompose_motions(normal, feigned)
    open_ = movements[:, information <= LEAST_INFORMATION]
    return scale[:, None] * (np.eye(6) - open_ @ open_.T @ metric) / scale
