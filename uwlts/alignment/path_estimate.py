"""Smooth correction of a path from surfaces that it shows more than once.

The unknowns are a translation (mm) and a rotation vector (rad) of each pose, in the base frame about the platform. The
prior is that of `path_prior`. `path_solution` solves for them.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from itertools import product

import numpy as np
from scipy.linalg import solve_triangular

from uwlts.alignment.alignment_options import AlignmentOptions
from uwlts.alignment.path_prior import PathPrior
from uwlts.alignment.pieces import Piece, Survey
from uwlts.fitting.patches import PatchDistances, Patches, distances_between, rigid_derivatives

Pair = tuple[int, int]
"""Numbers of two pieces that show the same surface, in chronological order."""


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
        basis = self.prior.basis(self._middles_s[list(pair)])
        return np.einsum("ipj,pc->ijc", self._relative_twists(pair, at_mm), basis).reshape(6, -1)

    def relative_covariance(self, pair: Pair, at_mm: np.ndarray) -> np.ndarray:
        """Return the covariance (6, 6) of the later piece's motion relative to the earlier one at a place (3,)."""
        by = self._relative_twists(pair, at_mm).reshape(6, 12)
        return by @ self._middle_covariance[np.ix_(pair, range(6), pair, range(6))].reshape(12, 12) @ by.T

    def _relative_twists(self, pair: Pair, at_mm: np.ndarray) -> np.ndarray:
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
    def _middles_s(self) -> np.ndarray:
        """Times (N,) of the middle patches of all pieces, s."""
        return np.array([piece.times_s[piece.middle_patch] for piece in self.pieces])

    @cached_property
    def _middle_covariance(self) -> np.ndarray:
        """Covariance (N, 6, N, 6) of the corrections in the middle of all N pieces."""
        basis = self.prior.basis(self._middles_s)
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
