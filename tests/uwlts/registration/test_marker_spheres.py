"""Marker spheres: centres with their shifts by systematic errors, groups of several scans, and matches of two."""

import numpy as np
from scipy.spatial.transform import Rotation

from uwlts.registration.marker_spheres import MarkerSphere, find_markers, group_markers, match_markers
from uwlts.storage.cloud import PointCloud, PointUncertainty


def marker(*centre: float) -> MarkerSphere:
    return MarkerSphere(np.array(centre), np.eye(3), np.zeros((0, 3)))


def test_a_sphere_of_one_scan_is_in_no_group() -> None:
    """Centres within 1 mm of the mean of their group are one sphere; a scan has one of them in a group, the nearest."""
    near, far = marker(0.0, 0.0, 0.0), marker(30.0, 0.0, 0.0)
    alone, third = marker(0.0, 50.0, 0.0), marker(1.2, 0.0, 0.0)
    moved, beside = marker(0.8, 0.0, 0.0), marker(31.1, 0.0, 0.0)
    groups = group_markers([[near, far], [alone, moved, beside], [third]], 1.0)
    assert len(groups) == 1
    assert groups[0] == {0: near, 1: moved, 2: third}


def test_centres_follow_errors_of_the_points() -> None:
    """A pattern that moves all points moves the centre by the same, and one along the normals only does so too."""
    rng, centre, shift = np.random.default_rng(2), np.array([3.0, -2.0, 300.0]), np.array([0.1, -0.2, 0.05])
    way = rng.normal(size=(6000, 3))
    way /= np.linalg.norm(way, axis=1, keepdims=True)
    way = way[way[:, 2] < -0.3]
    count, std = len(way), 0.02
    points = centre + (10.0 + std * rng.standard_normal(count))[:, None] * way
    patterns = np.stack([np.tile(shift, (count, 1)), (way @ shift)[:, None] * way])
    known = PointUncertainty(np.zeros((count, 6)), np.zeros((count, 3)), patterns)
    zero = np.zeros(count, int)
    (found,) = find_markers(PointCloud(points, np.ones(count), zero, zero, uncertainty=known), 20.0)
    np.testing.assert_allclose(found.patterns_mm, [shift, shift], atol=1e-4)
    # The covariance is the noise's of the centre with a known radius; four standard deviations.
    expected = std**2 * np.linalg.inv(way.T @ way)
    np.testing.assert_allclose(found.covariance, expected, atol=0.15 * expected.max())
    assert np.abs(found.centre_mm - centre).max() < 4 * np.sqrt(expected.max())


def test_spheres_are_matched_by_their_distances() -> None:
    """Four of five spheres, in another order and beside a sixth: the transform is exact."""
    centres = np.array([[0, 0, 0], [100, 0, 0], [0, 70, 0], [20, 30, 50], [90, 80, 10.0]])
    turn, shift = Rotation.from_rotvec([0.5, -0.3, 1.2]).as_matrix(), np.array([10.0, 20.0, 300.0])
    moved = centres[[3, 1, 0, 4]] @ turn.T + shift
    target = [*map(marker, *moved.T), marker(500.0, 0.0, 0.0)]
    matched = match_markers([*map(marker, *centres.T)], target, 20.0)
    assert matched is not None and matched[1] == 4
    np.testing.assert_allclose(matched[0][:3], np.column_stack([turn, shift]), atol=1e-9)
    # Their mirror image matches three spheres at most, and two spheres match nothing.
    mirrored = match_markers([*map(marker, *(centres * [1, 1, -1]).T)], target[:4], 20.0)
    assert mirrored is not None and mirrored[1] == 3
    assert match_markers([*map(marker, *centres[:2].T)], target, 20.0) is None
