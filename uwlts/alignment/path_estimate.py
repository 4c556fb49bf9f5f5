"""Least squares for a smooth correction of a path, by the surfaces that it shows more than once.

The unknowns are a correction of every pose, a shift (mm) and a turn (rad) in the base frame about the platform, with
the prior of `path_prior`. The kind of drift is the one of maximum marginal likelihood (empirical Bayes: MacKay, Neural
Computation 4, 1992). Residuals are distances between patches of the surface where the path crosses itself. Movements
that the surface leaves open there, as along a plain pipe, keep their prior.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, replace
from functools import cache
from itertools import product
from typing import Any

import numpy as np
from scipy.linalg import cho_factor, cho_solve, inv, solve_triangular
from scipy.spatial import KDTree
from scipy.spatial.transform import Rotation

from uwlts.alignment.path_prior import USUAL_DRIFT, DriftKind, PathPrior, PathSpline
from uwlts.errors import EvaluationError
from uwlts.fitting.least_squares import biweight, noise_factor
from uwlts.fitting.patches import (
    LEAST_INFORMATION,
    PatchDistances,
    Patches,
    averaged_points,
    disc_radius,
    distances_between,
    information_of_slopes,
    surface_patches,
    ways_of_moving,
)
from uwlts.storage.cloud import PointCloud

Pair = tuple[int, int]
"""Numbers of two pieces that show the same surface, the earlier first."""

_VOXEL = 0.4
"""Of the radius of patches: points for a search by heights."""
_WALKS = (1e-7, 1e-6, 1e-5, 1e-4, 1e-3, 3e-3, 0.01, 0.03, 0.1, 0.3, 0.6)
_KINDS = {
    "smooth": (0.0, 0.1, 0.3, 1.0, 3.0, 10.0),
    "wandering": (0.003, 0.01, 0.03, 0.1, 0.3, 0.6, 1.0),
    "walk": _WALKS,
    "turn_walk": _WALKS,
    "by_heading": (0.0, 1.0),
}
"""Values of `DriftKind` that are compared."""
_STRONG = 6.0
"""Twice the logarithm of a ratio of likelihoods that is strong evidence (Kass and Raftery, Journal of the American
Statistical Association 90, 1995): by so much a drift must be likelier than that which is stated, and one that the
heading makes than one without where nothing is stated."""
_FLAT = 0.1
"""A smaller difference of the same counts as none."""
_STEP = 0.5
"""Of the radius of patches: distance of knots within a crossing. With a whole one a random walk of a third of a
millimetre an image leaves more between knots than patches scatter; with a quarter nothing is gained.
"""
_UNLIKELY = 0.02
"""Of the likelihood of the likeliest kind: less is left out of the average."""
_TURNS, _LITTLE = 8, 0.1
"""Times that patches are laid anew at most, and by how much of its standard deviations the path may still move then."""
_BESIDE = 13
"""Patches from which it is taken how times grow: two rings around one."""
FEWEST = 30
"""Patches of a piece, and of a crossing."""
_ROUNDS, _STILL = 15, 0.03
"""Rounds of an estimate at most, and the step that ends it, root mean square in standard deviations: matches that come
and go keep smaller ones from ending."""
_HELD_OUT = 5
"""Every fifth cube of a crossing, of four radii, is held out and judges the gain."""
_AGREEING, _AGREEING_HELD_OUT = 0.9, 0.8
"""Of the patches of a crossing within four radii, those that agree within five of their standard deviations; and of
those held out, which do not bend the path to them. Wrong places reach 0.8 of all where it bends, but few held out."""
_FEWEST_HELD_OUT = 10
"""Held-out patches whose share is judged."""
_PER_PARAMETER = 3.0
"""Independent distances of a crossing for each parameter of the path that it determines: a surface without features
fits anywhere if the path may bend as much as it takes."""


@dataclass(frozen=True, eq=False)
class Piece:
    """A part of the path, and P patches of its surface.

    Attributes
    ----------
    patches : Patches
        By the path when they were laid.
    back : (P, 3, 3)
        From the surface around each patch then to that by the path as it was; see `_around`.
    places_mm : (P, 3)
        Of the patches, by the path as it was.
    times_s, slopes : (P,) and (P, 3)
        Times of the patches, and how they grow over the surface, s/mm.
    platform_mm, speed : (P, 3)
        The platform's places at these times, and its velocity, mm/s.
    held_out : (P,) bool
        Patches that judge the gain.
    points_mm, patch_of : (N, 3) and (N,)
        Averages of the points by the path as it was, and the patch nearest to each.
    """

    patches: Patches
    back: np.ndarray
    places_mm: np.ndarray
    times_s: np.ndarray
    slopes: np.ndarray
    platform_mm: np.ndarray
    speed: np.ndarray
    held_out: np.ndarray
    points_mm: np.ndarray
    patch_of: np.ndarray

    @property
    def middle_s(self) -> float:
        """Time in the middle of the piece."""
        return float(np.median(self.times_s))


class PathEstimate:
    """Coefficients of the correction, round by round, and the pairs of pieces that cross."""

    def __init__(
        self,
        cloud: PointCloud,
        times_s: np.ndarray,
        path: PathSpline,
        kind: DriftKind,
        *,
        stated: DriftKind | None = None,
    ) -> None:
        """With the kind of drift that is assumed first, and that which the navigation states."""
        self.cloud, self.stated = cloud, stated
        moments, self._image = np.unique(times_s, return_inverse=True)
        self._moments, self._platform = moments, path.trajectory.poses_at(moments)[:, :3, 3]
        self._speed = path.trajectory.rates_at(moments)[:, :3]
        self.coefficients = np.zeros(6 * path.count)
        self.prior, self._normal = PathPrior(path, kind), np.eye(6 * path.count)
        self._numbers = np.zeros((6 * path.count, 1))
        self._covariance: Any = None
        self.pairs: list[Pair] = []
        self._own, self._radius = _divided(cloud, times_s)
        laid = [(own, self._laid(own)) for own in self._own]
        self._own = [own for own, piece in laid if piece is not None]
        self.pieces = [piece for _, piece in laid if piece is not None]

    @property
    def path(self) -> PathSpline:
        return self.prior.path

    @property
    def reach_mm(self) -> float:
        """Within which patches are matched."""
        return 2 * self._radius

    def corrections(self, times_s: np.ndarray) -> np.ndarray:
        """Shift and turn (N, 6) at times (N,)."""
        return self.path.corrections(self.coefficients, times_s)

    def moved(self, number: int) -> Patches:
        """Patches of a piece along the path as it is now."""
        piece = self.pieces[number]
        places = _moved(self.corrections(piece.times_s), piece.platform_mm, piece.places_mm)
        # Images move one by one: what lies along the path is not turned with them, but sheared by how they drift apart.
        tangents = np.einsum("pij,pkj->pki", self._around(piece) @ piece.back, piece.patches.axes[:, :2])
        first = tangents[:, 0] / np.linalg.norm(tangents[:, 0], axis=1, keepdims=True)
        normal = np.cross(first, tangents[:, 1])
        normal /= np.linalg.norm(normal, axis=1, keepdims=True)
        axes = np.stack([first, np.cross(normal, first), normal], axis=1)
        return replace(piece.patches, places_mm=places, axes=axes, one_sided=False)

    def moved_points(self, number: int) -> np.ndarray:
        """Points (N, 3) of a piece along the path as it is now."""
        piece = self.pieces[number]
        correction = self.corrections(piece.times_s)[piece.patch_of]
        return _moved(correction, piece.platform_mm[piece.patch_of], piece.points_mm)

    def _around(self, piece: Piece) -> np.ndarray:
        """Derivatives (P, 3, 3) of the surface around patches, along the path as it is now, by it as it was.

        Of p' = R(t) (p - X(t)) + X(t) + s(t) by p, with the time t that grows over the surface, the turn R, the shift
        s, and the platform's place X.
        """
        correction = self.corrections(piece.times_s)
        rates = self.path.corrections(self.coefficients, piece.times_s, rates=True)
        turn = Rotation.from_rotvec(correction[:, 3:])
        drifting = np.cross(rates[:, 3:], turn.apply(piece.places_mm - piece.platform_mm)) + rates[:, :3]
        drifting += piece.speed - turn.apply(piece.speed)
        return turn.as_matrix() + drifting[:, :, None] * piece.slopes[:, None]

    def relative_movement(self, pair: Pair, at_mm: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Times (2,) of both pieces, and derivatives (2, 6, 6) of shift and turn of the later against the earlier, at
        a place (3,), by the corrections then."""
        times = np.array([self.pieces[number].middle_s for number in pair])
        twists = np.tile(np.eye(6), (2, 1, 1))
        for twist, number, time in zip(twists, pair, times, strict=True):
            piece = self.pieces[number]
            platform = piece.platform_mm[np.argmin(np.abs(piece.times_s - time))]
            twist[:3, 3:] = np.cross(np.eye(3), at_mm - platform - self.corrections(time[None])[0, :3]).T
        return times, np.array([-1.0, 1.0])[:, None, None] * twists

    @property
    def covariance(self) -> np.ndarray:
        """Of the coefficients (6 C, 6 C)."""
        if self._covariance is None:
            self._covariance = self.prior.covariance(inv(self._normal, assume_a="pos"))
        return self._covariance

    def covariance_at(self, times_s: np.ndarray) -> np.ndarray:
        """Covariances (N, 6, 6) of the corrections at times (N,), with what the spline cannot follow."""
        result = np.zeros((len(times_s), 6, 6))
        blocks = self.covariance.reshape(self.path.count, 6, self.path.count, 6)
        weights, number = self.path.weights(times_s)
        for first in range(4):
            for second in range(4):
                weight = weights[:, first] * weights[:, second]
                result += weight[:, None, None] * blocks[number[:, first], :, number[:, second]]
        return result + self.prior.unresolved(times_s)[:, :, None] * np.eye(6)

    def state(self) -> tuple[Any, ...]:
        """What `restore` needs to return to the present estimate."""
        return self.coefficients, self.prior, self._normal, self._numbers, self.pairs[:], self.pieces[:]

    def restore(self, state: tuple[Any, ...]) -> None:
        """Return to an earlier estimate."""
        self.coefficients, self.prior, self._normal, self._numbers = state[:4]
        self.pairs, self.pieces, self._covariance = state[4][:], state[5][:], None

    def resolve(self, seed: dict[Pair, np.ndarray]) -> None:
        """Lay knots as close as patches tell where pairs lie on each other; poses (4, 4) as in `estimate`."""
        times, steps = [], []
        for pair in self.pairs:
            earlier, later = (self.moved(number) for number in pair)
            pose = seed.get(pair, np.eye(4))
            found = distances_between(later, pose, earlier, np.eye(4), reach_mm=2 * self.reach_mm)
            for number, rows in zip(pair, (found.target, found.source), strict=True):
                piece = self.pieces[number]
                times.append(piece.times_s[rows])
                steps.append(_STEP * self._radius * np.linalg.norm(piece.slopes[rows], axis=1))
        if times and len(together := np.concatenate(times)):
            path = self.path.resolved(together, float(np.median(np.concatenate(steps))))
            self._assume(PathPrior(path, self.prior.kind))

    def lay_anew(self, numbers: Iterable[int]) -> None:
        """Fit the patches of pieces to the points along the path as it is now.

        A patch moves as a whole: a drift within it, of the path as it was, has tilted it.
        """
        for number in numbers:
            self.pieces[number] = self._laid(self._own[number]) or self.pieces[number]

    def estimate(self, seed: dict[Pair, np.ndarray]) -> None:
        """Estimate until nothing moves any more; poses (4, 4) of pairs give their first matches."""
        for done in range(_ROUNDS):
            if self._round(seed if done == 0 else {}) < _STILL and (done > 1 or not seed):
                break

    def settle(self) -> None:
        """Estimate the path and the kind of its drift alternately; pairs that do not agree afterwards are dropped."""
        self._settled()
        if len(agreeing := [pair for pair in self.pairs if self.agrees(pair)]) < len(self.pairs):
            self.pairs = agreeing
            self._settled()

    def average(self) -> None:
        """Average over the kinds of rates, each by its likelihood: few crossings hardly tell them apart, and behind the
        last one they differ (Hoeting et al., Statistical Science 14, 1999).

        Standard deviations of equal steps are equally likely beforehand (Gelman, Bayesian Analysis 1, 2006).
        """
        if self.stated is not None and self.prior.kind[:2] == self.stated[:2]:
            return
        normal, right = self._normal_equations({})
        kinds = [
            self.prior.kind._replace(smooth=smooth, wandering=wandering)
            for smooth, wandering in product(_KINDS["smooth"], _KINDS["wandering"])
        ]
        # The factors of all kinds together would take gigabytes: those that count are calculated again.
        likelihoods = np.array([_integrated(PathPrior(self.path, kind), normal, right)[0] for kind in kinds])
        steps = (np.gradient(np.sqrt(_KINDS[name])) for name in ("smooth", "wandering"))
        weights = np.exp((likelihoods - likelihoods.max()) / 2) * np.outer(*steps).ravel()
        weights /= weights.max()
        kept = np.flatnonzero(weights > _UNLIKELY)
        mean, square = np.zeros_like(self.coefficients), np.zeros_like(normal)
        for number in kept:
            weight, prior = weights[number] / weights[kept].sum(), PathPrior(self.path, kinds[number])
            factor = _integrated(prior, normal, right)[1]
            inverse = cho_solve((factor, True), np.eye(len(factor)))
            found = prior.times_root(inverse @ prior.times_transposed_root(right))[:, 0]
            mean += weight * found
            square += weight * (prior.covariance(inverse) + np.outer(found, found))
        self.coefficients, self._covariance = mean, square - np.outer(mean, mean)

    def _settled(self) -> None:
        """Lay the patches and estimate anew until the path moves by little and its drift is of the likeliest kind."""
        self.resolve({})
        self.estimate({})
        kind, known = self.prior.kind, False
        for _ in range(_TURNS):
            before = self.coefficients
            self.lay_anew({number for pair in self.pairs for number in pair})
            self._assume(PathPrior(self.path, kind))
            self.estimate({})
            if not known:
                kind = self._likeliest()
                known = kind == self.prior.kind
            moved = (self.coefficients - before) ** 2 / np.diag(self.covariance)
            if known and np.sqrt(np.mean(moved)) < _LITTLE:
                break

    def agrees(self, pair: Pair) -> bool:
        """Whether the surfaces of a pair agree, also where they were held out."""
        found, fits = self.matched(pair)
        if np.count_nonzero(fits) < FEWEST or np.mean(fits) < _AGREEING:
            return False
        held = self.held_out(pair, found)
        return bool(np.count_nonzero(held) < _FEWEST_HELD_OUT or np.mean(fits[held]) >= _AGREEING_HELD_OUT)

    def is_overdetermined(self, pair: Pair) -> bool:
        """Whether a pair has several independent distances for each parameter of the path that it determines.

        Random walks do not count: they are small within a crossing, and held-out patches judge what they take.
        """
        columns, normal, _ = self._of_pair(pair, None)
        # What is measured all along walks, too.
        path = replace(self.path, measured=np.zeros(6, bool))
        steady = PathPrior(path, self.prior.kind._replace(walk=_WALKS[0], turn_walk=_WALKS[0]))
        covariance = steady.covariance(inv(steady.with_evidence(self._normal_equations({})[0]), assume_a="pos"))
        determined = float(np.sum(normal * covariance[np.ix_(columns, columns)]))
        fits = self.matched(pair)[1]
        return bool(np.count_nonzero(fits) / self.pieces[pair[1]].patches.shared > _PER_PARAMETER * determined)

    def matched(self, pair: Pair) -> tuple[PatchDistances, np.ndarray]:
        """Distances (Q,) of the later piece from the earlier, and which of them agree with zero."""
        earlier, later = (self.moved(number) for number in pair)
        found = distances_between(later, np.eye(4), earlier, np.eye(4), reach_mm=2 * self.reach_mm)
        return found, np.abs(found.distance_mm) < 5 * found.std_mm

    def held_out(self, pair: Pair, found: PatchDistances) -> np.ndarray:
        """Mask (Q,) of the distances from the later piece to the earlier that are held out of the estimate."""
        return self.pieces[pair[1]].held_out[found.source] | self.pieces[pair[0]].held_out[found.target]

    def _laid(self, own: np.ndarray) -> Piece | None:
        """Patches of points by their numbers, along the path as it is now; None where they lie on no surface."""
        image = self._image[own]
        correction, platform = self.corrections(self._moments)[image], self._platform[image]
        known = None if self.cloud.uncertainty is None else self.cloud.uncertainty[own]
        # What all points share does not tell one pass from another along a path.
        known = None if known is None else replace(known, patterns_mm=known.patterns_mm[:0], poses_mm=None)
        points = _moved(correction, platform, self.cloud.points_mm[own])
        try:
            patches = surface_patches(points, known, radius_mm=self._radius)
        except EvaluationError:
            return None
        at = image[patches.numbers]
        correction, platform, times = correction[patches.numbers], self._platform[at], self._moments[at]
        back = Rotation.from_rotvec(-correction[:, 3:])
        places = back.apply(patches.places_mm - platform - correction[:, :3]) + platform
        cubes = np.floor(places / (4 * self._radius)).astype(np.int64)
        held_out = (cubes @ np.array([1, 2, 3])) % _HELD_OUT == 0
        averages = averaged_points(self.cloud.points_mm[own], self._radius * _VOXEL)
        tree = KDTree(places)
        near: Any = tree.query(averages)
        piece = Piece(
            patches,
            np.empty(0),
            places,
            times,
            _slopes(tree, times),
            platform,
            self._speed[at],
            held_out,
            averages,
            near[1],
        )
        return replace(piece, back=np.linalg.inv(self._around(piece)))

    def _assume(self, prior: PathPrior) -> None:
        """Take a kind of drift, or a path with other knots; the correction stays as it is."""
        if prior.path is not self.path:
            at = prior.path.at_s
            self.coefficients = np.linalg.solve(prior.path.basis(at), self.corrections(at)).ravel()
        self.prior, self._covariance = prior, None
        self._normal, self._numbers = np.eye(len(self.coefficients)), np.zeros((len(self.coefficients), 1))

    def _round(self, seed: dict[Pair, np.ndarray]) -> float:
        """One step of least squares; returns its root mean square, in standard deviations of what is estimated."""
        normal, right = self._normal_equations(seed)
        self._normal, self._covariance = self.prior.with_evidence(normal), None
        factor = cho_factor(self._normal, check_finite=False)
        before, self._numbers = self._numbers, cho_solve(factor, self.prior.times_transposed_root(right))
        self.coefficients = self.prior.times_root(self._numbers)[:, 0]
        step = self._numbers - before
        return float(np.sqrt(np.sum(step * (self._normal @ step)) / len(step)))

    def _likeliest(self) -> DriftKind:
        """Kind of the drift with which the matches as they are now are likeliest.

        Where a kind is stated only what they strongly contradict is changed.
        """
        normal, right = self._normal_equations({})
        least = 0.0 if self.stated is None else _STRONG

        @cache
        def likelihood(kind: DriftKind) -> float:
            found = _integrated(PathPrior(self.path, kind), normal, right)[0]
            return found - (_STRONG * kind.by_heading if self.stated is None else 0.0)

        best, before = self.stated or USUAL_DRIFT, None
        while best != before:
            before = best
            for name, values in _KINDS.items():
                here = getattr(best, name)
                larger, smaller = ([each for each in values if (each - here) * side > 0] for side in (1, -1))
                for beyond in (larger, smaller[::-1]):
                    found = best
                    for value in beyond:
                        tried = best._replace(**{name: value})
                        if likelihood(tried) <= likelihood(found) + _FLAT:
                            break
                        found = tried
                    if likelihood(found) > likelihood(best) + least:
                        best = found
        return best

    def _normal_equations(self, seed: dict[Pair, np.ndarray]) -> tuple[np.ndarray, np.ndarray]:
        """Normal matrix (6 C, 6 C) and right-hand side (6 C, 1) for the coefficients by the distances between all
        pairs, without the prior."""
        count = 6 * self.path.count
        normal, gradient = np.zeros((count, count)), np.zeros(count)
        for pair in self.pairs:
            columns, own, slope = self._of_pair(pair, seed.get(pair))
            normal[np.ix_(columns, columns)] += own
            gradient[columns] += slope
        return normal, (normal @ self.coefficients - gradient)[:, None]

    def _of_pair(self, pair: Pair, seed: np.ndarray | None) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Numbers (K,) of the unknowns that one pair depends on, normal matrix and gradient; by its pose (4, 4) where
        that differs from the present one."""
        patches = {number: self.moved(number) for number in pair}
        poses = {pair[0]: np.eye(4), pair[1]: np.eye(4) if seed is None else seed}
        ways = []
        for source, target in (pair[::-1], pair):
            found = distances_between(
                patches[source], poses[source], patches[target], poses[target], reach_mm=self.reach_mm
            )
            used = ~(self.pieces[source].held_out[found.source] | self.pieces[target].held_out[found.target])
            if np.count_nonzero(used) < FEWEST // 2:
                continue
            std = found.std_mm[used]
            if seed is None:
                std = std * noise_factor(found.distance_mm[used] / std)
            likely = biweight(found.distance_mm[used] / std) if seed is None else np.ones(len(std))
            # Both directions count by half.
            ways.append((source, target, found, used, likely / std**2 / (2 * patches[source].shared)))
        if not ways:
            return np.zeros(0, int), np.zeros((0, 0)), np.zeros(0)
        middle = np.vstack([found.places_mm[used] for _, _, found, used, _ in ways]).mean(axis=0)
        observable = np.eye(6) if seed is not None else _observable([each[2:] for each in ways], middle)
        back = np.eye(4) if seed is None else np.linalg.inv(seed)
        rows = []
        for source, target, found, used, weight in ways:
            normals, places = found.normals[used], found.places_mm[used]
            # Matched by another pose than the present one: where the later piece's surface lies now.
            now = {pair[0]: places, pair[1]: places @ back[:3, :3].T + back[:3, 3]}
            gap = np.einsum("qi,qi->q", now[source] - now[target], normals)
            parts = []
            for number, at, sign in ((source, found.source[used], 1.0), (target, found.target[used], -1.0)):
                piece = self.pieces[number]
                # Beside the middle of a patch the surface was seen a little earlier or later.
                off = now[number] - patches[number].places_mm[at]
                later = np.einsum("qi,qi->q", piece.slopes[at], off)
                times = piece.times_s[at] + later
                by = np.hstack([normals, np.cross(places - middle, normals)]) @ observable
                # Turns are about the platform where the present correction has it.
                platform = piece.platform_mm[at] + later[:, None] * piece.speed[at]
                platform += self.corrections(times)[:, :3]
                by[:, 3:] += np.cross(middle + now[number] - places - platform, by[:, :3])
                parts.append((sign * self.path.basis(times), by))
            rows.append((parts, weight, found.distance_mm[used] + gap))
        # Of all coefficients those around both passes.
        near = np.flatnonzero(np.any([basis.any(axis=0) for parts, _, _ in rows for basis, _ in parts], axis=0))
        columns = (6 * near[:, None] + np.arange(6)).ravel()
        normal, gradient = np.zeros((len(columns), len(columns))), np.zeros(len(columns))
        for parts, weight, off in rows:
            derivatives = sum(np.einsum("qc,qi->qci", basis[:, near], by) for basis, by in parts)
            derivatives = np.reshape(derivatives, (len(weight), -1))
            normal += derivatives.T @ (weight[:, None] * derivatives)
            gradient += derivatives.T @ (weight * off)
        return columns, normal, gradient


def _integrated(prior: PathPrior, normal: np.ndarray, right: np.ndarray) -> tuple[float, np.ndarray]:
    """Twice the logarithm of the likelihood, but for what all kinds have in common, with the path integrated out; and
    the lower root (6 C, 6 C) of the normal matrix with the prior."""
    factor = np.linalg.cholesky(prior.with_evidence(normal))
    off = solve_triangular(factor, prior.times_transposed_root(right), lower=True)
    return float(np.sum(off**2) - 2 * np.sum(np.log(np.diag(factor)))), factor


def _moved(correction: np.ndarray, platform: np.ndarray, places: np.ndarray) -> np.ndarray:
    """Places (N, 3) after corrections (N, 6) about the platform's places (N, 3)."""
    return Rotation.from_rotvec(correction[:, 3:]).apply(places - platform) + platform + correction[:, :3]


def _slopes(tree: KDTree, times: np.ndarray) -> np.ndarray:
    """How times (P,) grow over the places of a tree (P, 3), s/mm."""
    near: Any = tree.query(tree.data, k=min(_BESIDE, tree.n))[1]
    about, later = np.asarray(tree.data)[near] - np.asarray(tree.data)[:, None], times[near] - times[:, None]
    normal = np.einsum("pki,pkj->pij", about, about)
    # Across a plane surface times do not grow: the ridge is a millionth of what tells along it.
    normal += 1e-6 * np.trace(normal, axis1=1, axis2=2)[:, None, None] * np.eye(3)
    return np.linalg.solve(normal, np.einsum("pki,pk->pi", about, later)[:, :, None])[:, :, 0]


def _observable(ways: list[tuple[PatchDistances, np.ndarray, np.ndarray]], middle: np.ndarray) -> np.ndarray:
    """Projection (6, 6) of shift and turn about a middle to the part that distances tell more of than noise would."""
    normal, spurious = np.zeros((6, 6)), np.zeros((6, 6))
    places = np.vstack([found.places_mm[used] for found, used, _ in ways]) - middle
    scale = np.repeat([1.0, 1 / float(np.sqrt(np.mean(np.sum(places**2, axis=1))))], 3)
    for found, used, weight in ways:
        normals, levers = found.normals[used], found.places_mm[used] - middle

        def by_movement(directions: np.ndarray, levers: np.ndarray = levers) -> np.ndarray:
            return np.hstack([directions, np.cross(levers, directions)]) * scale

        by = by_movement(normals)
        normal += by.T @ (weight[:, None] * by)
        spurious += information_of_slopes(normals, weight * found.slope_variance[used], by_movement)
    values, movements, metric = ways_of_moving(normal, spurious)
    open_ = movements[:, values <= LEAST_INFORMATION]
    return scale[:, None] * (np.eye(6) - open_ @ open_.T @ metric) / scale


def _divided(cloud: PointCloud, times: np.ndarray) -> tuple[list[np.ndarray], float]:
    """Numbers of the points of parts of the path about as long as the stripe is wide, and the radius of patches."""
    frames = np.unique(times)
    order = np.argsort(times, kind="stable")
    sorted_times = times[order]
    starts = np.searchsorted(sorted_times, frames)
    ends = np.append(starts[1:], len(times))
    widths = [np.linalg.norm(np.ptp(cloud.points_mm[order[a:b]], axis=0)) for a, b in zip(starts, ends, strict=True)]
    swath = float(np.median(widths))
    middles = np.array([cloud.points_mm[order[a:b]].mean(axis=0) for a, b in zip(starts, ends, strict=True)])
    way = np.append(0.0, np.cumsum(np.linalg.norm(np.diff(middles, axis=0), axis=1)))
    count = max(2, round(way[-1] / swath))
    number = np.minimum((way / way[-1] * count).astype(int), count - 1)
    of_piece = number[np.searchsorted(frames, sorted_times)]
    radius = disc_radius(cloud.points_mm[order[of_piece == count // 2]])
    parts = [order[of_piece == k] for k in range(count)]
    return [part for part in parts if len(part) >= 200], radius
