"""Local means of few points: their intervals hold as often as stated."""

import numpy as np

from uwlts.comparison.local_means import TWO_SIDED, _student_ratio, average_locally


def test_intervals_of_few_points_hold_as_often_as_stated() -> None:
    """Five points a place: 95 +- 1.8 % of 3000 intervals (4.5 standard deviations); with a normal factor, 87.8 %."""
    rng = np.random.default_rng(4)
    places = np.column_stack([10.0 * np.arange(3000), np.zeros((3000, 2))])
    points = np.repeat(places, 5, axis=0) + np.column_stack([rng.uniform(-0.3, 0.3, (15000, 2)), np.zeros(15000)])
    points[:, 2] += rng.standard_normal(15000)
    normals = np.broadcast_to([0.0, 0.0, 1.0], places.shape)
    found = average_locally(places, normals, points, uncertainty=None, frame=None, disc_mm=2.0, deep_mm=8.0)
    inside = np.abs(found.mean_mm) < TWO_SIDED * np.sqrt(found.variance_mm2)
    assert abs(inside.mean() - 0.95) < 4.5 * np.sqrt(0.95 * 0.05 / 3000)


def test_the_factor_of_few_points_is_students() -> None:
    """Quantiles of 97.5 % for 1, 4, 10 and 30 degrees of freedom, from tables."""
    tabulated = np.array([12.706, 2.776, 2.228, 2.042])
    np.testing.assert_allclose(_student_ratio(np.array([2, 5, 11, 31])), tabulated / TWO_SIDED, rtol=2e-4)
