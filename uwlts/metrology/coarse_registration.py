"""Start of a registration without known poses: by features of the surfaces (KISS-Matcher), or by spheres.

Pairs of scans are matched, judged by how much of their surfaces lies on each other then, and joined by a spanning tree.
KISS-Matcher: Lim et al., IEEE ICRA 2025.
"""

from __future__ import annotations

from collections.abc import Sequence
from itertools import combinations
from typing import Any

import numpy as np

from uwlts.metrology.joint_registration import JointRegistration
from uwlts.metrology.marker_spheres import MarkerSphere, movement_by_markers
from uwlts.metrology.patches import Patches, distances_between
from uwlts.model.errors import EvaluationError, SetupError

_VOXELS = 50.0
"""Size of a scan over that of the first voxels, from which features of that scale are taken."""
_FINER = (1.0, 0.5, 2.0)
_LEAST_OVERLAP = 30
"""Patches on each other that make a pair; chance gives a few."""
_REFINING_ROUNDS = 12
_CLOSE = 5.0
"""Standard deviations within which patches lie on each other."""


def coarse_poses(
    patches: Sequence[Patches],
    markers: Sequence[Sequence[MarkerSphere]],
    names: Sequence[str],
    *,
    sphere_mm: float | None,
) -> np.ndarray:
    """Poses (N, 4, 4) in the frame of the first scan, good to about a patch's radius.

    EvaluationError where some scan fits none of the others; SetupError where KISS-Matcher is not installed.
    """
    edges = []
    for a, b in combinations(range(len(patches)), 2):
        if (found := _movement(patches[a], patches[b], markers[a], markers[b], sphere_mm)) is not None:
            edges.append((found[1], a, b, found[0]))
    poses: dict[int, np.ndarray] = {0: np.eye(4)}
    # The best pair that leads to a new scan, again and again (Prim).
    while len(poses) < len(patches):
        leading = [edge for edge in edges if (edge[1] in poses) != (edge[2] in poses)]
        if not leading:
            lost = ", ".join(name for number, name in enumerate(names) if number not in poses)
            raise EvaluationError(
                f"{lost}: no start was found by the shape; the surfaces overlap too little or have too few features. "
                "Give poses at the start, or put at least three spheres into the scene (sphere_mm)"
            )
        _, a, b, movement = max(leading, key=lambda edge: edge[0])
        if a in poses:
            poses[b] = poses[a] @ np.linalg.inv(movement)
        else:
            poses[a] = poses[b] @ movement
    return np.array([poses[number] for number in range(len(patches))])


def _movement(
    a: Patches,
    b: Patches,
    spheres_a: Sequence[MarkerSphere],
    spheres_b: Sequence[MarkerSphere],
    sphere_mm: float | None,
) -> tuple[np.ndarray, float] | None:
    """Movement (4, 4) of the first scan onto the second and a score; None where nothing fits."""
    if sphere_mm is not None and (found := movement_by_markers(spheres_a, spheres_b, sphere_mm)) is not None:
        return found[0], 1e6 * found[1]
    best: tuple[np.ndarray, float] | None = None
    for finer in _FINER:
        movement = _by_features(a, b, finer)
        if movement is None:
            continue
        refined, score = _refined(a, b, movement)
        if score >= _LEAST_OVERLAP and (best is None or score > best[1]):
            best = refined, score
    return best


def _by_features(a: Patches, b: Patches, finer: float) -> np.ndarray | None:
    kiss = _library()
    size = float(np.linalg.norm(np.ptp(a.places_mm, axis=0)))
    voxel = max(size / _VOXELS * finer, 0.5 * a.radius_mm)
    matcher = kiss.KISSMatcher(kiss.KISSMatcherConfig(voxel_size=voxel))
    found = matcher.estimate(a.places_mm.astype(np.float32), b.places_mm.astype(np.float32))
    if not found.valid:
        return None
    result = np.eye(4)
    result[:3, :3], result[:3, 3] = np.asarray(found.rotation), np.asarray(found.translation)
    return result if np.isfinite(result).all() else None


def _refined(a: Patches, b: Patches, movement: np.ndarray) -> tuple[np.ndarray, float]:
    """A movement after a few rounds of the joint estimate for this pair, and the patches that lie on each other."""
    poses = np.array([np.eye(4), movement])
    joint = JointRegistration([b, a], [[], []], poses, start_std=None, sphere_mm=None)
    reach = 4 * max(a.radius_mm, b.radius_mm)
    for _ in range(_REFINING_ROUNDS):
        pairs = joint.evidence(reach)
        if not pairs:
            return movement, 0.0
        joint.move(joint.solved(list(pairs.values())).step)
        reach = max(0.8 * reach, a.radius_mm)
    found = distances_between(a, joint.poses[1], b, joint.poses[0], reach_mm=reach)
    return joint.poses[1], float(np.count_nonzero(np.abs(found.distance_mm) < _CLOSE * found.std_mm))


def _library() -> Any:
    try:
        import kiss_matcher
    except ImportError as error:
        raise SetupError(
            "the search for a start needs the library kiss-matcher, which is not installed: pip install "
            "'uwlts[registration]', or give poses at the start"
        ) from error
    return kiss_matcher
