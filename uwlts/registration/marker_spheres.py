"""Marker spheres: detection in each scan and correspondence between scans."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import permutations

import numpy as np

from uwlts.fitting.least_squares import fit_rigid_transform
from uwlts.fitting.propagation import LinearisedFit
from uwlts.shapes.sphere import Sphere
from uwlts.storage.cloud import PointCloud

_AGREE = 0.05  # tolerance of centre distances before registration, relative to the sphere diameter
_TRIPLES = 200  # number of sphere triples that are tried, spread evenly over all; up to six spheres give fewer


@dataclass(frozen=True, eq=False)
class MarkerSphere:
    """Centre (3,) of a sphere, its noise covariance (3, 3), and its shift (M, 3) by each systematic pattern, in mm."""

    centre_mm: np.ndarray
    covariance: np.ndarray
    patterns_mm: np.ndarray

    def transform(self, pose: np.ndarray, amounts: np.ndarray) -> MarkerSphere:
        """Return the sphere shifted by amounts (M,) of its patterns, in the frame of a pose (4, 4)."""
        rotation, centre = pose[:3, :3], self.centre_mm + amounts @ self.patterns_mm
        covariance = rotation @ self.covariance @ rotation.T
        return MarkerSphere(rotation @ centre + pose[:3, 3], covariance, self.patterns_mm @ rotation.T)


def find_markers(cloud: PointCloud, diameter_mm: float) -> list[MarkerSphere]:
    """Find all spheres of the given diameter in a cloud."""
    usable, found = np.ones(len(cloud), bool), []
    rng = np.random.default_rng(0)
    while (sphere := Sphere.find(cloud.points_mm, diameter_mm / 2, usable=usable, rng=rng)) is not None:
        members = sphere.members[sphere.robust.inliers]
        usable[sphere.near] = False
        # On a cap, centre and radius are strongly correlated. The known diameter removes this correlation.
        fit = Sphere.fit(cloud.points_mm[members], diameter_mm / 2)
        linear, patterns = LinearisedFit(fit, cloud.points_mm, members), np.zeros((0, 3))
        if cloud.uncertainty is not None:
            patterns = np.array([linear.shift(each)[0] for each in cloud.uncertainty.patterns_mm]).reshape(-1, 3)
        found.append(MarkerSphere(fit.centre_mm, fit.covariance[:3, :3], patterns))
    return found


def group_markers(scans: Sequence[Sequence[MarkerSphere]], reach_mm: float) -> list[dict[int, MarkerSphere]]:
    """Group spheres of different scans that are within ``reach_mm`` of each other in the common frame.

    Each group maps scan numbers to spheres. Spheres seen in one scan only are omitted.
    """
    groups: list[dict[int, MarkerSphere]] = []
    for number, markers in enumerate(scans):
        for marker in markers:
            means = [np.mean([each.centre_mm for each in group.values()], axis=0) for group in groups]
            distances = [
                np.inf if number in group else float(np.linalg.norm(mean - marker.centre_mm))
                for group, mean in zip(groups, means, strict=True)
            ]
            if distances and min(distances) < reach_mm:
                groups[int(np.argmin(distances))][number] = marker
            else:
                groups.append({number: marker})
    return [group for group in groups if len(group) > 1]


def match_markers(
    source: Sequence[MarkerSphere], target: Sequence[MarkerSphere], diameter_mm: float
) -> tuple[np.ndarray, int] | None:
    """Find the transform (4, 4) that matches the most spheres of two scans; return it with their number.

    Return None if fewer than three spheres match.
    """
    a, b = (np.array([each.centre_mm for each in markers]).reshape(-1, 3) for markers in (source, target))
    if min(len(a), len(b)) < 3:
        return None
    limit, best = _AGREE * diameter_mm, None
    sides_a, sides_b = (np.linalg.norm(x[:, None] - x[None], axis=2) for x in (a, b))
    triples = list(permutations(range(len(a)), 3))
    for i, j, k in triples[:: -(-len(triples) // _TRIPLES)]:
        near = np.argwhere(np.abs(sides_b - sides_a[i, j]) < limit)
        for p, q in near[near[:, 0] != near[:, 1]]:
            last = np.flatnonzero(
                (np.abs(sides_b[p] - sides_a[i, k]) < limit) & (np.abs(sides_b[q] - sides_a[j, k]) < limit)
            )
            for r in last[(last != p) & (last != q)]:
                movement = fit_rigid_transform(a[[i, j, k]], b[[p, q, r]])
                off = np.linalg.norm((a @ movement[:3, :3].T + movement[:3, 3])[:, None] - b[None], axis=2)
                fits = off.min(axis=1) < limit
                if best is None or np.count_nonzero(fits) > best[1]:
                    best = fit_rigid_transform(a[fits], b[off.argmin(axis=1)[fits]]), int(np.count_nonzero(fits))
    return best if best is not None and best[1] >= 3 else None
