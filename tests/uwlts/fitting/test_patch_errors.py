"""Propagation of the errors of points to patches, against patches of surfaces whose errors are drawn again."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.stats import chi2

from docs.studies.registration_coverage import as_cloud
from tests.oracles.views import View, draw_views
from uwlts.fitting.patches import Patches, distances_between, refit_distances, surface_patches

DRAWS = 30


def exact_view(seed: int) -> View:
    """Return a view without errors, which states noise of 0.02 mm and offsets of profiles of 0.02 mm."""
    view = draw_views(seed, "free form", "none")[0]
    return replace(view, own_mm=0.02, profile_mm=np.full((1, len(view.points_mm)), 0.02))


def patches_of(view: View, shift_mm: np.ndarray) -> Patches:
    cloud = as_cloud(view)
    moved = cloud.points_mm + shift_mm[:, None] * view.towards
    return surface_patches(moved, cloud.uncertainty, frame=cloud.frame, radius_mm=4.5)


@pytest.mark.parametrize("by_images", [False, True], ids=["noise", "profiles"])
def test_sums_of_heights_vary_as_propagated(by_images: bool) -> None:
    """Sums of heights with smooth weights, over 30 draws; limits are exceeded 1 time in 10,000.

    A factor of 1.15 allows for averages that lie askew to normals, and for points of few images in a cube.
    """
    rng, view = np.random.default_rng(4), exact_view(3)
    still = patches_of(view, np.zeros(len(view.points_mm)))
    places = still.places_mm - still.places_mm.mean(axis=0)
    weights = np.stack([np.ones(len(still)), places[:, 0], places[:, 1], places[:, 0] * places[:, 1]])
    weights /= np.linalg.norm(weights, axis=1, keepdims=True)
    sums = []
    for _ in range(DRAWS):
        frame = view.frame if by_images else np.arange(len(view.frame))
        error = rng.standard_normal(frame.max() + 1)[frame]
        moved = patches_of(view, 0.02 * error)
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
