"""Propagation of the errors of points to patches, against patches of surfaces whose errors are drawn again."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from scipy.stats import chi2

from tests.oracles.views import draw_views
from uwlts.fitting.patches import Patches, distances_between, refit_distances, rigid_derivatives, surface_patches
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


def plane_patches(turn: np.ndarray, shift_mm: np.ndarray) -> tuple[Patches, np.ndarray]:
    """Return patches of a plane of 30 mm and their pose; the plane faces the sensor in its own frame."""
    flat = np.random.default_rng(6).uniform(-15, 15, (3000, 2))
    pose = np.eye(4)
    pose[:3, :3], pose[:3, 3] = turn, shift_mm
    return surface_patches(np.column_stack([flat, np.zeros(3000)]), radius_mm=3.0), pose


@pytest.mark.parametrize(("angle_deg", "overlap"), [(0, True), (30, True), (45, False), (180, False)])
def test_planes_overlap_up_to_an_angle_between_their_normals(angle_deg: float, overlap: bool) -> None:
    """Distances are those from the plane, 0.2 mm away along its own normal; normals differ by up to 37 deg."""
    rotate = Rotation.from_euler("x", angle_deg, degrees=True).as_matrix()
    whole = Rotation.from_rotvec([0.2, -0.4, 1.0]).as_matrix()
    target, at = plane_patches(whole, np.array([1.0, 2.0, 300.0]))
    source, moved = plane_patches(whole @ rotate, at[:3, 3] + 0.2 * whole[:, 2])
    assert source.one_sided and target.one_sided
    found = distances_between(source, moved, target, at, reach_mm=1.0)
    assert (len(found.source) > 5) == overlap
    places = source.places_mm[found.source] @ moved[:3, :3].T + moved[:3, 3]
    np.testing.assert_allclose(found.places_mm, places)
    # Normals point to the sensor, -Z of the frame.
    normals = np.broadcast_to(-whole[:, 2], found.normals.shape)
    np.testing.assert_allclose(found.normals, normals, atol=1e-6)
    np.testing.assert_allclose(found.distance_mm, (places - at[:3, 3]) @ -whole[:, 2], atol=1e-6)


def test_motions_move_points_as_their_derivatives() -> None:
    """Against differences by small motions about a middle."""
    rng = np.random.default_rng(7)
    places, directions, middle = rng.normal(size=(3, 5, 3))
    by = rigid_derivatives(places, directions, middle[0])
    step = 1e-6 * rng.normal(size=6)
    turned = Rotation.from_rotvec(step[3:]).apply(places - middle[0]) + middle[0] + step[:3]
    np.testing.assert_allclose(by @ step, np.einsum("qi,qi->q", turned - places, directions), atol=1e-11)


def test_patterns_move_patches_as_a_whole() -> None:
    """A common pattern, in two amounts."""
    cloud = exact_cloud()
    patterns = np.tile([[0.3, 0.0, 0.1]], (2, len(cloud), 1)) * np.array([1.0, -2.0])[:, None, None]
    patches = surface_patches(cloud.points_mm, replace(cloud.uncertainty, patterns_mm=patterns), radius_mm=3.0)
    moved = patches.corrected(np.array([1.0, 0.25]))
    shift = 0.5 * np.array([0.3, 0.0, 0.1])
    np.testing.assert_allclose(moved.places_mm, patches.places_mm + shift, atol=1e-6)
    np.testing.assert_allclose(moved.averages.places_mm, patches.averages.places_mm + shift, atol=1e-6)


def test_errors_of_unknown_images_count_as_noise() -> None:
    """Noise of 0.02 mm and positions of 0.03 mm along a level plane; with known images, positions are common."""
    flat = np.random.default_rng(8).uniform(-15, 15, (3000, 2))
    along = np.tile([0.0, 0.0, 0.03], (3000, 1))
    known = PointUncertainty(np.tile([0, 0, 0, 0, 0, 0.02**2], (3000, 1)), along, np.zeros((0, 3000, 3)))
    points = np.column_stack([flat, np.full(3000, 300.0)])
    alone = surface_patches(points, known, radius_mm=3.0)
    np.testing.assert_allclose(alone.errors.noise_mm, np.hypot(0.02, 0.03), rtol=1e-6)
    assert not alone.image_variance_mm2.any()
    by_images = surface_patches(points, known, radius_mm=3.0, frame=np.zeros(3000, int))
    np.testing.assert_allclose(by_images.errors.noise_mm, 0.02, rtol=1e-6)
    # A single image moves all heights by its whole error.
    np.testing.assert_allclose(by_images.image_variance_mm2, 0.03**2, rtol=1e-4)
