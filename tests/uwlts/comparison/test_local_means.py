"""Local means of few points: their intervals hold as often as stated, and blocks of pairs change nothing."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from uwlts.comparison.local_means import TWO_SIDED, _compute_student_ratio, average_locally
from uwlts.registration.surface_registration import SurfaceSample
from uwlts.storage.cloud import PointUncertainty


def test_intervals_of_few_points_hold_as_often_as_stated() -> None:
    """Five points a place: 95 +- 1.8 % of 3000 intervals (4.5 standard deviations); with a normal factor, 87.8 %."""
    rng = np.random.default_rng(4)
    places = np.column_stack([10.0 * np.arange(3000), np.zeros((3000, 2))])
    points = np.repeat(places, 5, axis=0) + np.column_stack([rng.uniform(-0.3, 0.3, (15000, 2)), np.zeros(15000)])
    points[:, 2] += rng.standard_normal(15000)
    normals = np.broadcast_to([0.0, 0.0, 1.0], places.shape)
    found = average_locally(places, normals, SurfaceSample(points), disc_mm=2.0, deep_mm=8.0)
    inside = np.abs(found.mean_mm) < TWO_SIDED * np.sqrt(found.variance_mm2)
    assert abs(inside.mean() - 0.95) < 4.5 * np.sqrt(0.95 * 0.05 / 3000)


def test_means_do_not_depend_on_how_many_pairs_are_averaged_at_once(monkeypatch: pytest.MonkeyPatch) -> None:
    """Points of eight images and of none, with uncertainty; some places have no points."""
    rng, count = np.random.default_rng(5), 4000
    points = rng.uniform(0, 30, (count, 3)) * [1, 1, 0.02]
    places = np.column_stack([rng.uniform(-20, 30, (60, 2)), np.zeros(60)])
    known = PointUncertainty(
        np.full((count, 6), [1, 0, 0, 1, 0, 1], np.float32),
        rng.normal(0, 0.1, (count, 3)).astype(np.float32),
        rng.normal(0, 0.1, (2, count, 3)).astype(np.float32),
    )
    frame = rng.integers(-1, 8, count)
    normals = np.broadcast_to([0.0, 0.0, 1.0], places.shape)
    given = places, normals, SurfaceSample(points, known, frame)
    whole = average_locally(*given, disc_mm=3.0, deep_mm=2.0)
    assert 10 < np.isnan(whole.mean_mm).sum() < 50
    monkeypatch.setattr("uwlts.comparison.local_means._PAIRS_AT_A_TIME", 70)
    for one, other in zip(whole, average_locally(*given, disc_mm=3.0, deep_mm=2.0), strict=True):
        np.testing.assert_allclose(one, other, rtol=1e-12)


def test_the_factor_of_few_points_is_students() -> None:
    """Quantiles of 97.5 % for 1, 4, 10 and 30 degrees of freedom, from tables."""
    tabulated = np.array([12.706, 2.776, 2.228, 2.042])
    np.testing.assert_allclose(_compute_student_ratio(np.array([2, 5, 11, 31])), tabulated / TWO_SIDED, rtol=2e-4)


def images(values: np.ndarray, each: int) -> tuple[np.ndarray, np.ndarray]:
    """Return points in a tilted disc of 1 mm radius, ``each`` of every image at its height, in mixed order."""
    image = np.random.default_rng(6).permutation(np.repeat(np.arange(len(values)), each))
    angle = np.arange(len(image))
    flat = np.column_stack([np.cos(angle), np.sin(angle), np.zeros(len(image))])
    return (flat + np.outer(values[image], [0, 0, 1])) @ TURN.T, image


TURN = Rotation.from_rotvec([0.4, -0.7, 0.2]).as_matrix()


@pytest.mark.parametrize("unit", [1.0, 1e-3])
def test_points_of_an_image_that_err_together_count_once(unit: float) -> None:
    """The variance is that of a mean of five images, times Student's factor of the 40 points, in mm or um."""
    heights = unit * np.array([0.3, -0.2, 0.05, 0.4, -0.1])
    points, image = images(heights, 8)
    sample = SurfaceSample(points, None, image)
    found = average_locally(np.zeros((1, 3)), TURN[:, 2][None], sample, disc_mm=2.1, deep_mm=1.0)
    assert found.mean_mm[0] == pytest.approx(heights.mean())
    student = 2.0227 / TWO_SIDED
    assert found.variance_mm2[0] == pytest.approx(student**2 * heights.var(ddof=1) / 5, rel=1e-4)


def test_a_disc_holds_the_points_within_its_radius_and_depth() -> None:
    """Of two rings of six points beside the radius of 3 mm, and two beside the depth of 5 mm, the inner ones count."""
    angle = np.arange(6) * np.pi / 3
    ring = np.column_stack([np.cos(angle), np.sin(angle), np.zeros(6)])
    up = np.array([0.0, 0.0, 1.0])
    rings = [2.99 * ring + 1.0 * up, 3.01 * ring + 2.0 * up, ring + 4.99 * up, ring - 5.01 * up]
    place = np.array([7.0, -3.0, 20.0])
    points = (place + np.vstack(rings)) @ TURN.T
    found, few = (
        average_locally((TURN @ place)[None], TURN[:, 2][None], SurfaceSample(some), disc_mm=6.0, deep_mm=5.0)
        for some in (points, points[:4])
    )
    assert found.mean_mm[0] == pytest.approx((1.0 + 4.99) / 2)
    # Four points are too few.
    assert np.isnan(few.mean_mm[0])


def test_variance_of_a_mean_without_scatter_is_that_stated() -> None:
    """Noise is divided by the number of points; errors of images by that of images; patterns are averaged."""
    points, image = images(np.zeros(4), 6)
    count, normal = len(points), TURN[:, 2]
    random = np.array([1.0, 0.2, -0.3, 2.0, 0.4, 3.0])
    full = np.array([[1.0, 0.2, -0.3], [0.2, 2.0, 0.4], [-0.3, 0.4, 3.0]])
    position, pose = np.array([0.1, -0.2, 0.3]), np.array([0.0, 0.5, 0.1])
    number = np.arange(count)[:, None]
    patterns = np.stack([np.outer(np.ones(count), [0.0, 0.0, 2.0]), number * np.array([[1.0, 0.0, 0.0]])])
    known = PointUncertainty(
        np.tile(random, (count, 1)), np.tile(position, (count, 1)), patterns, np.tile(pose, (1, count, 1))
    )
    sample = SurfaceSample(points, known, image)
    found = average_locally(np.zeros((1, 3)), normal[None], sample, disc_mm=2.1, deep_mm=1.0)
    expected = normal @ full @ normal / 24 + ((position @ normal) ** 2 + (pose @ normal) ** 2) / 4
    assert found.variance_mm2[0] == pytest.approx(expected)
    np.testing.assert_allclose(found.patterns_mm[0], [2 * normal[2], 11.5 * normal[0]])
