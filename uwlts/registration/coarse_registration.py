"""Start of a registration without known poses: by features of the surfaces (KISS-Matcher), or by spheres.

Pairs of scans are matched, judged by how much of their surfaces lies on each other then, and joined by a spanning tree.
KISS-Matcher: Lim et al., IEEE ICRA 2025.
"""

from __future__ import annotations

from collections.abc import Sequence
from itertools import combinations
from typing import Any

import numpy as np

from uwlts.errors import EvaluationError, SetupError
from uwlts.fitting.patches import Patches
from uwlts.model.calibration import rigid_transform
from uwlts.registration.joint_registration import fit_pair
from uwlts.registration.marker_spheres import MarkerSphere, movement_by_markers

_TRIES = ((0.55, 2.0, 6.0), (0.55, 3.0, 5.0), (0.8, 2.0, 6.0), (0.8, 3.0, 5.0), (1.6, 3.0, 5.0))
"""Size of the voxels in radii of patches, and in voxels the radii within which normals and features are taken."""
_VOXEL_UNITS = 0.3
"""Size of a voxel in the units of KISS-Matcher, its default."""
_LEAST_SHARE = 0.6
"""Of the patches that lie near each other, those that agree within their noise: a wrong start leaves a few."""
_LEAST_OVERLAP = 30
"""Patches on each other that make a pair; chance gives a few."""
_CLOSE = 5.0
"""Standard deviations within which patches lie on each other."""


def coarse_poses(
    points_mm: Sequence[np.ndarray],
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
        if found := _movement(patches[a], patches[b], points_mm[a], points_mm[b], markers[a], markers[b], sphere_mm):
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
    points_a: np.ndarray,
    points_b: np.ndarray,
    spheres_a: Sequence[MarkerSphere],
    spheres_b: Sequence[MarkerSphere],
    sphere_mm: float | None,
) -> tuple[np.ndarray, float] | None:
    """Movement (4, 4) of the first scan onto the second and a score; None where nothing fits."""
    if sphere_mm is not None and (found := movement_by_markers(spheres_a, spheres_b, sphere_mm)) is not None:
        return found[0], 1e6 * found[1]
    for voxel, *gains in _TRIES:
        movement = _by_features(points_a, points_b, voxel * a.radius_mm, *gains)
        if movement is not None and (found := _refined(a, b, movement))[1] >= _LEAST_OVERLAP:
            return found
    return None


def _by_features(
    a: np.ndarray, b: np.ndarray, voxel: float, normal_gain: float, feature_gain: float
) -> np.ndarray | None:
    """Movement (4, 4) of points (N, 3) onto others by features in voxels of a size, mm; None where none match.

    Normals and features are taken within so many voxels. SetupError where KISS-Matcher is not installed.
    """
    kiss = _library()
    # The library warns of bounds above one unit on standard output.
    gains = {"normal_r_gain": normal_gain, "fpfh_r_gain": feature_gain}
    matcher = kiss.KISSMatcher(kiss.KISSMatcherConfig(voxel_size=_VOXEL_UNITS, **gains))
    source, target = ((_VOXEL_UNITS / voxel * each).astype(np.float32) for each in (a, b))
    found = matcher.estimate(source, target)
    if not found.valid:
        return None
    result = rigid_transform(np.asarray(found.rotation), np.asarray(found.translation) * voxel / _VOXEL_UNITS)
    return result if np.isfinite(result).all() else None


def _refined(a: Patches, b: Patches, movement: np.ndarray) -> tuple[np.ndarray, float]:
    """A movement after a few rounds of the joint estimate for this pair, and the number of patches on each other.

    The number is 0 where many patches disagree, and where the shape leaves a direction open, as a pipe or a plane does:
    then any place along it would fit as well.
    """
    if (fitted := fit_pair(a, b, movement)) is None:
        return movement, 0.0
    found = fitted[1]
    fits = np.abs(found.distance_mm) < _CLOSE * found.std_mm
    return fitted[0], float(np.count_nonzero(fits)) if len(fits) and np.mean(fits) > _LEAST_SHARE else 0.0


def _library() -> Any:
    try:
        import kiss_matcher
    except ImportError as error:
        raise SetupError(
            "the search for a start needs the library kiss-matcher, which is not installed: pip install "
            "'uwlts[registration]', or give poses at the start"
        ) from error
    return kiss_matcher
