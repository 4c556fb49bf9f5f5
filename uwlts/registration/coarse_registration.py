"""Global registration without initial poses, by surface features (KISS-Matcher) or marker spheres.

Each pair of scans is matched and scored by the number of coinciding patches. A maximum spanning tree joins the pairs.
KISS-Matcher: Lim et al., IEEE ICRA 2025.
"""

from __future__ import annotations

from collections.abc import Sequence
from itertools import combinations

import numpy as np

from uwlts.errors import EvaluationError
from uwlts.fitting.patches import Patches
from uwlts.model.calibration import rigid_transform
from uwlts.registration.joint_registration import fit_pair
from uwlts.registration.marker_spheres import MarkerSphere, match_markers
from uwlts.runtime.optional_library import optional_library

_TRIES = ((0.55, 2.0, 6.0), (0.55, 3.0, 5.0), (0.8, 2.0, 6.0), (0.8, 3.0, 5.0), (1.6, 3.0, 5.0))
"""Voxel size (unit: patch radius), normal radius and feature radius (unit: voxel) of each attempt."""
_VOXEL_UNITS = 0.3  # default voxel size of KISS-Matcher, in its own units
_LEAST_SHARE = 0.6
"""Least fraction of overlapping patches that coincide within their noise; at a wrong pose only a few do."""
_LEAST_OVERLAP = 30  # least number of coinciding patches of a matched pair; a few coincide by chance
_CLOSE = 5.0  # largest distance of coinciding patches, in standard deviations


def estimate_coarse_poses(
    points_mm: Sequence[np.ndarray],
    patches: Sequence[Patches],
    markers: Sequence[Sequence[MarkerSphere]],
    names: Sequence[str],
    *,
    sphere_mm: float | None,
) -> np.ndarray:
    """Estimate poses (N, 4, 4) in the frame of the first scan, accurate to about one patch radius.

    ``points_mm`` holds (K, 3) of each scan; ``sphere_mm`` is the diameter of the marker spheres, None without.

    Raises EvaluationError if a scan matches no other scan; SetupError if KISS-Matcher is not installed.
    """
    edges = []
    for a, b in combinations(range(len(patches)), 2):
        if found := _match_pair(patches[a], patches[b], points_mm[a], points_mm[b], markers[a], markers[b], sphere_mm):
            edges.append((found[1], a, b, found[0]))
    poses: dict[int, np.ndarray] = {0: np.eye(4)}
    # Prim's algorithm: add the best pair that reaches a new scan.
    while len(poses) < len(patches):
        leading = [edge for edge in edges if (edge[1] in poses) != (edge[2] in poses)]
        if not leading:
            lost = ", ".join(name for number, name in enumerate(names) if number not in poses)
            raise EvaluationError(
                f"{lost}: no initial pose was found from the surfaces. They overlap too little or have too few "
                "features. Give initial poses, or place at least three spheres in the scene (sphere_mm)"
            )
        _, a, b, movement = max(leading, key=lambda edge: edge[0])
        if a in poses:
            poses[b] = poses[a] @ np.linalg.inv(movement)
        else:
            poses[a] = poses[b] @ movement
    return np.array([poses[number] for number in range(len(patches))])


def _match_pair(
    a: Patches,
    b: Patches,
    points_a: np.ndarray,
    points_b: np.ndarray,
    spheres_a: Sequence[MarkerSphere],
    spheres_b: Sequence[MarkerSphere],
    sphere_mm: float | None,
) -> tuple[np.ndarray, float] | None:
    """Return the transform (4, 4) from the first scan to the second and its score; None without a match."""
    if sphere_mm is not None and (found := match_markers(spheres_a, spheres_b, sphere_mm)) is not None:
        return found[0], 1e6 * found[1]
    for voxel, *gains in _TRIES:
        movement = _match_features(points_a, points_b, voxel * a.radius_mm, *gains)
        # The transform is refined by the joint estimate of this pair, unless the overlap leaves a direction open.
        if movement is None or (fitted := fit_pair(a, b, movement)) is None:
            continue
        fits = np.abs(fitted[1].distance_mm) < _CLOSE * fitted[1].std_mm
        if np.count_nonzero(fits) >= _LEAST_OVERLAP and np.mean(fits) > _LEAST_SHARE:
            return fitted[0], float(np.count_nonzero(fits))
    return None


def _match_features(
    a: np.ndarray, b: np.ndarray, voxel: float, normal_gain: float, feature_gain: float
) -> np.ndarray | None:
    """Return the transform (4, 4) between points (N, 3) by features; None if none match.

    ``voxel`` is the voxel size in mm. The gains are the radii for normals and features, in voxels.
    """
    kiss = optional_library(
        "kiss_matcher",
        needed_by="the search for initial poses",
        extra="registration",
        instead=", or give initial poses",
    )
    # KISS-Matcher prints warnings for bounds above one unit, so coordinates are scaled.
    gains = {"normal_r_gain": normal_gain, "fpfh_r_gain": feature_gain}
    matcher = kiss.KISSMatcher(kiss.KISSMatcherConfig(voxel_size=_VOXEL_UNITS, **gains))
    source, target = ((_VOXEL_UNITS / voxel * each).astype(np.float32) for each in (a, b))
    found = matcher.estimate(source, target)
    if not found.valid:
        return None
    result = rigid_transform(np.asarray(found.rotation), np.asarray(found.translation) * voxel / _VOXEL_UNITS)
    return result if np.isfinite(result).all() else None
