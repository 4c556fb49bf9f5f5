"""Uncertainty of values that are sums over points: by single points, by images, and by what all points share.

To first order the values of a fitted shape are sums of the points' distances from it along the normals, each with a
weight (GUM, JCGM 100:2008, Eq. 13). Noise counts at least as much as the residuals show in groups of neighbours
(the sandwich estimator of Liang and Zeger, Biometrika 73, 1986): neighbours err together, and roughness is noise.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from uwlts.inspection.features import COVERAGE_FACTOR, DEFINITIONS, FeatureKind, FeatureValue
from uwlts.storage.cloud import PointCloud, images_along, variance_along


@dataclass(frozen=True, eq=False)
class NormalErrors:
    """Errors of points (N,) along the normals of a surface, mm.

    ``single_mm`` (N,) is the standard uncertainty of each point alone, zero where the cloud states none, ``image_mm``
    (K, N) the motion for one standard deviation of each part of the position and pose of its ``image`` (N,),
    ``patterns_mm`` (M, N) that for one standard deviation of each common pattern; None where the cloud states nothing.
    """

    single_mm: np.ndarray
    image_mm: np.ndarray
    image: np.ndarray
    patterns_mm: np.ndarray | None

    def __getitem__(self, chosen: np.ndarray) -> NormalErrors:
        """Those of a selection of the points."""
        patterns = None if self.patterns_mm is None else self.patterns_mm[:, chosen]
        return NormalErrors(self.single_mm[chosen], self.image_mm[:, chosen], self.image[chosen], patterns)

    def drawn_of_images(self, rng: np.random.Generator) -> np.ndarray:
        """One draw (N,) of the motions that the points of an image share."""
        image = np.unique(self.image, return_inverse=True)[1]
        moves = np.zeros(len(image))
        for part in self.image_mm:
            moves += rng.standard_normal(image.max() + 1)[image] * part
        return moves

    def covariances(
        self, weights: np.ndarray, residuals: np.ndarray, groups: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray | None]:
        """Covariances (K, K) of values with weights (K, N) on the points: by noise, and by what all points share.

        ``residuals`` (N,) are the points' distances that are left, ``groups`` (N,) numbers of neighbourhoods whose
        points may err together. Where the residuals scatter more than stated, the noise is theirs.
        """
        noise = (weights * self.single_mm**2) @ weights.T
        noise = noise + sum(_grouped(weights * part, self.image) for part in self.image_mm)
        seen = _grouped(weights * residuals, groups)
        size = np.maximum(np.diag(seen), 1e-300) / np.maximum(np.diag(noise), 1e-300)
        # As a whole, so that what is left stays a covariance.
        random = seen if np.median(size) > 1 else noise
        scale = np.sqrt(np.maximum(np.maximum(np.diag(seen), np.diag(noise)) / np.maximum(np.diag(random), 1e-300), 1))
        random = random * np.outer(scale, scale)
        if self.patterns_mm is None:
            return random, None
        moved = weights @ self.patterns_mm.T
        return random, moved @ moved.T


def normal_errors(cloud: PointCloud, chosen: np.ndarray, normals: np.ndarray) -> NormalErrors:
    """Errors of the chosen (K,) points of a cloud along normals (K, 3)."""
    frame = cloud.frame[chosen]
    image = np.unique(frame, return_inverse=True)[1] if np.any(frame >= 0) else np.arange(len(chosen))
    if (known := cloud.uncertainty) is None:
        return NormalErrors(np.zeros(len(chosen)), np.empty((0, len(chosen))), image, None)
    known = known[chosen]
    single = np.sqrt(np.maximum(variance_along(known.random_mm2, normals), 0))
    return NormalErrors(
        single, images_along(known, normals), image, np.einsum("mni,ni->mn", known.patterns_mm, normals)
    )


def _grouped(moves: np.ndarray, group: np.ndarray) -> np.ndarray:
    """Covariance (K, K) of sums of moves (K, N) that are common within a group and independent between groups."""
    sums = np.array([np.bincount(group, row) for row in moves])
    return sums @ sums.T


def plain_value(
    kind: FeatureKind, name: str, value: float, random: float, systematic: float | None, *, least: float = -np.inf
) -> FeatureValue:
    """A value with a symmetric interval, cut at the least that it can be."""
    half = COVERAGE_FACTOR * float(np.hypot(random, systematic or 0.0))
    low, high = max(value - half, least), max(value + half, least)
    unit = DEFINITIONS[kind][name].unit
    common = None if systematic is None else float(systematic)
    return FeatureValue(name, float(value), unit, float(random), common, float(low), float(high))


def amplitude_value(
    kind: FeatureKind, name: str, vector: np.ndarray, random: np.ndarray, systematic: np.ndarray | None, *, scale: float
) -> FeatureValue:
    """Length of a vector (2,) with covariances (2, 2), times a scale.

    The length of a noisy vector is too large: its square by the trace of the covariance, which is taken off (Rice,
    Bell System Technical Journal 24, 1945, section 3.10). The interval reaches down to zero where the vector is not
    significant.
    """
    total = random if systematic is None else random + systematic
    length = float(np.linalg.norm(vector))
    corrected = float(np.sqrt(max(length**2 - float(np.trace(total)), 0.0)))
    along = vector / length if length > 0 else np.array([1.0, 0.0])

    def std(covariance: np.ndarray) -> float:
        # Near zero the direction is chance.
        near = float(np.linalg.eigvalsh(covariance)[-1])
        far = float(along @ covariance @ along)
        share = min(length**2 / max(float(np.trace(total)), 1e-300) / 9, 1.0)
        return float(np.sqrt(max(share * far + (1 - share) * near, 0.0)))

    by_noise, by_common = std(random), None if systematic is None else std(systematic)
    half = COVERAGE_FACTOR * float(np.hypot(by_noise, by_common or 0.0))
    ends = max(corrected - half, 0.0), max(length, corrected) + half
    common = None if by_common is None else scale * by_common
    unit = DEFINITIONS[kind][name].unit
    return FeatureValue(name, scale * corrected, unit, scale * by_noise, common, scale * ends[0], scale * ends[1])
