"""Local means of few points: their intervals hold as often as stated."""

import numpy as np

from uwlts.comparison.local_means import TWO_SIDED, average_locally


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
