"""Propagation of the errors of points to patches, against patches of surfaces whose errors are drawn again."""

import numpy as np
import pytest
from scipy.stats import chi2

from tests.oracles.views import draw_views
from uwlts.fitting.patches import Patches, distances_between, refit_distances, surface_patches
from uwlts.storage.cloud import PointCloud, PointUncertainty

DRAWS = 30


def exact_cloud() -> PointCloud:
    """Return a second-order surface in profiles 0.5 mm apart, with stated noise and offsets of profiles of 0.02 mm."""
    rng = np.random.default_rng(4)
    frame, line = (each.ravel() for each in np.indices((60, 60)))
    x, y = 0.5 * frame + rng.uniform(0, 0.1, frame.shape), 0.5 * line + rng.uniform(0, 0.4, line.shape)
    points = np.column_stack([x, y, 300 + 0.1 * x + 0.002 * x**2 - 0.003 * x * y])
    along = np.tile([0.0, 0.0, 0.02], (len(points), 1))
    random = np.tile([0.0, 0.0, 0.0, 0.0, 0.0, 0.02**2], (len(points), 1))
    known = PointUncertainty(random, along, np.zeros((0, len(points), 3)))
    return PointCloud(points, np.ones(len(points)), frame, line, uncertainty=known)


def patches_of(cloud: PointCloud, shift_mm: np.ndarray) -> Patches:
    points = cloud.points_mm + shift_mm[:, None] * [0.0, 0.0, 1.0]
    return surface_patches(points, cloud.uncertainty, frame=cloud.frame, radius_mm=3.0)


@pytest.mark.parametrize("by_images", [False, True], ids=["noise", "profiles"])
def test_sums_of_heights_vary_as_propagated(by_images: bool) -> None:
    """Sums of heights with smooth weights, over 30 draws; limits are exceeded 1 time in 10,000.

    A factor of 1.15 allows for averages that change their cube with the noise.
    """
    rng, cloud = np.random.default_rng(5), exact_cloud()
    still = patches_of(cloud, np.zeros(len(cloud)))
    places = still.places_mm - still.places_mm.mean(axis=0)
    weights = np.stack([np.ones(len(still)), places[:, 0], places[:, 1], places[:, 0] * places[:, 1]])
    weights /= np.linalg.norm(weights, axis=1, keepdims=True)
    sums = []
    for _ in range(DRAWS):
        frame = cloud.frame if by_images else np.arange(len(cloud))
        error = rng.standard_normal(frame.max() + 1)[frame]
        moved = patches_of(cloud, 0.02 * error)
        found = distances_between(moved, np.eye(4), still, np.eye(4), reach_mm=1.0)
        # Patches stand on the same averages, so that each has its own counterpart.
        assert len(found.source) > 0.9 * len(still)
        heights = np.zeros(len(still))
        heights[found.target] = found.distance_mm
        sums.append(weights @ heights)
    changes = still.errors.height_changes()
    count = len(still.errors.counts)
    parts = changes[:, count:] if by_images else changes[:, :count]
    stated = np.sum((weights @ parts.toarray()) ** 2, axis=1)
    ratio = np.sum(np.square(sums), axis=0) / stated
    low, high = chi2.ppf([5e-5 / 4, 1 - 5e-5 / 4], DRAWS)
    assert (low / 1.15 < ratio).all() and (ratio < 1.15 * high).all()


def test_large_distances_are_measured_at_their_feet() -> None:
    """A surface 2 mm from its like, two thirds of a patch's radius: all patches find their foot, on the surface."""
    cloud = exact_cloud()
    patches = patches_of(cloud, np.zeros(len(cloud)))
    away = np.eye(4)
    away[2, 3] = 2.0
    found = distances_between(patches, away, patches, np.eye(4), reach_mm=3.0)
    again = refit_distances(found, patches, patches, np.eye(4))
    assert len(again.source) > 0.8 * len(patches)
    # The distance along a normal inclined by up to 0.3, from a shift along z, without the edges.
    inner = np.abs(again.places_mm[:, :2] - 15).max(axis=1) < 9
    np.testing.assert_allclose(again.distance_mm[inner], 2.0 * again.normals[inner, 2], atol=0.01)


def test_errors_of_the_second_order_cancel_at_the_foot() -> None:
    """Two exact views of one surface: distances fall by half or more if both surfaces are smoothed in the same way.

    Waves are as short as three radii of a patch, where the third and fourth order matter.
    """
    views = draw_views(5, "free form", "none")[:2]
    poses = [view.pose for view in views]
    both = [surface_patches(view.points_mm, radius_mm=4.5) for view in views]
    found = distances_between(both[0], poses[0], both[1], poses[1], reach_mm=1.0)
    again = refit_distances(found, both[0], both[1], poses[1])
    assert len(again.source) > 50
    before, after = (np.median(np.abs(each.distance_mm)) for each in (found, again))
    assert after < 0.6 * before
