"""Spacing of points, and radius of the discs that show a surface."""

import numpy as np
import pytest

from uwlts.errors import EvaluationError
from uwlts.fitting.patches import find_disc_radius
from uwlts.fitting.point_spacing import measure_spacing


def grid(count: int, *, across: float = 1.0) -> np.ndarray:
    """Return places (count^2, 2) 1 mm apart along the first direction."""
    x, y = np.meshgrid(np.arange(count), across * np.arange(count), indexing="ij")
    return np.column_stack([x.ravel(), y.ravel()])


def test_the_spacing_is_that_of_most_places():
    """The first of 400 places has another one at 0.1 mm."""
    places = np.vstack([grid(20, across=2.5), [[0.1, 0.0]]])
    np.testing.assert_allclose(measure_spacing(places, np.arange(400)), [1.0, 2.5], rtol=1e-12)


def test_discs_must_be_small_relative_to_the_cloud():
    """Ten points need a radius of 1.8 spacings; discs begin with 4.5, more than a tenth of 30 by 30 points."""
    many, few = (np.column_stack([grid(count), np.zeros(count**2)]) for count in (80, 30))
    assert 1.8 < find_disc_radius(many) < 0.1 * 80 * np.sqrt(2)
    with pytest.raises(EvaluationError, match="spacing of the points is too large"):
        find_disc_radius(few)
