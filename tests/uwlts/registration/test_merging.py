"""Merged clouds: points, images and uncertainty, propagated from the covariance of poses and patterns."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from uwlts.fitting.patches import surface_patches
from uwlts.registration.joint_registration import JointRegistration
from uwlts.registration.merging import merge_clouds
from uwlts.storage.cloud import NO_INDEX, PAIRS, PointCloud, PointUncertainty


def scan(seed: int, *, patterns: int, poses: bool = False, frames: int = 3) -> PointCloud:
    """Return a plane of 20 mm with noise, errors of images and systematic patterns; the first point has no image."""
    rng = np.random.default_rng(seed)
    points = np.column_stack([rng.uniform(-10, 10, (800, 2)), 300 + 0.01 * rng.normal(size=800)])
    roots = rng.normal(size=(800, 3, 3)) * 0.01
    full = roots @ roots.transpose(0, 2, 1)
    known = PointUncertainty(
        np.stack([full[:, i, j] for i, j in PAIRS], axis=1),
        0.01 * rng.normal(size=(800, 3)),
        0.02 * rng.normal(size=(patterns, 800, 3)),
        0.01 * rng.normal(size=(2, 800, 3)) if poses else None,
    )
    frame = rng.integers(0, frames, 800)
    frame[0], frame[1] = NO_INDEX, frames - 1
    metadata = {"sensor": "one", "scan": seed}
    return PointCloud(
        points, np.ones(800), frame, np.arange(800), uncertainty=known, time_s=np.full(800, seed), metadata=metadata
    )


def test_a_merged_cloud_has_the_errors_of_points_poses_and_patterns() -> None:
    """Covariances of single points from those of the unknowns by hand; 1e-4 of their sum is left out."""
    scans = [scan(1, patterns=2), scan(2, patterns=1, poses=True, frames=5)]
    patches = [surface_patches(each.points_mm, each.uncertainty, radius_mm=4.0) for each in scans]
    pose = np.eye(4)
    pose[:3, :3] = turn = Rotation.from_rotvec([0.3, -0.5, 0.9]).as_matrix()
    pose[:3, 3] = [5.0, -20.0, 40.0]
    joint = JointRegistration(patches, [[], []], np.array([np.eye(4), pose]), start_std=None, sphere_mm=None)
    joint.patterns = [np.array([0.5, -1.0]), np.array([2.0])]
    # Six parameters of the second pose, two amplitudes of the first scan and one of the second.
    # Their errors have four independent causes.
    root = np.random.default_rng(3).normal(size=(9, 4)) * np.array([0.1] * 3 + [0.005] * 3 + [1.0] * 3)[:, None]
    merged = merge_clouds(scans, ("a", "b"), joint, root @ root.T)
    first, second = (each.uncertainty for each in scans)
    corrected = [
        scans[0].points_mm + 0.5 * first.patterns_mm[0] - first.patterns_mm[1],
        (scans[1].points_mm + 2.0 * second.patterns_mm[0]) @ turn.T + pose[:3, 3],
    ]
    np.testing.assert_allclose(merged.points_mm, np.vstack(corrected), atol=1e-9)
    by = np.zeros((1600, 3, 9))
    by[:800, :, 6:8] = first.patterns_mm.transpose(1, 2, 0)
    by[800:, :, :3] = np.eye(3)
    about = corrected[1] - joint.middles_mm[1]
    by[800:, :, 3:6] = np.cross(np.eye(3)[None], about[:, None]).transpose(0, 2, 1)
    by[800:, :, 8] = second.patterns_mm[0] @ turn.T
    expected = np.einsum("nij,nkj->nik", by @ root, by @ root)
    patterns = merged.uncertainty.patterns_mm.astype(float)
    found = np.einsum("mni,mnk->nik", patterns, patterns)
    total = np.einsum("nii->", expected)
    assert abs(np.einsum("nii->", found) - total) < 1e-4 * total
    np.testing.assert_allclose(found, expected, atol=1e-3 * np.abs(expected).max())
    # Patterns are orthogonal over all points, and no more than the causes.
    gram = np.einsum("mni,kni->mk", patterns, patterns)
    assert len(gram) == 4 and np.abs(gram - np.diag(np.diag(gram))).max() < 1e-5 * gram[0, 0]
    own = merged.uncertainty.random_mm2[800:]
    full = np.zeros((800, 3, 3))
    for k, (i, j) in enumerate(PAIRS):
        full[:, i, j] = full[:, j, i] = second.random_mm2[:, k]
    np.testing.assert_allclose(own, np.stack([(turn @ full @ turn.T)[:, i, j] for i, j in PAIRS], axis=1), atol=1e-8)
    np.testing.assert_allclose(merged.uncertainty.position_mm[:800], first.position_mm, rtol=1e-6)
    np.testing.assert_allclose(merged.uncertainty.position_mm[800:], second.position_mm @ turn.T, atol=1e-8)
    assert not merged.uncertainty.poses_mm[:, :800].any()
    np.testing.assert_allclose(merged.uncertainty.poses_mm[:, 800:], second.poses_mm @ turn.T, atol=1e-8)
    assert merged.frame[0] == merged.frame[800] == NO_INDEX and merged.frame[801] == 3 + 4
    np.testing.assert_array_equal(merged.time_s, np.repeat([1.0, 2.0], 800))
    listed = merged.metadata["scans"]
    assert merged.metadata.keys() == {"sensor", "scans"} and [each["first_frame"] for each in listed] == [0, 3]
    assert listed[1]["name"] == "b" and listed[1]["pose"] == pytest.approx(pose)
