"""Spacing of points, and radius of the discs that show a surface."""

from dataclasses import replace

import numpy as np
import pytest

from uwlts.errors import EvaluationError
from uwlts.fitting.local_surface import choose_disc_diameter, measure_spacing, project_footprint
from uwlts.fitting.patches import find_disc_radius
from uwlts.storage.cloud import FOOTPRINT, FOOTPRINT_STD, PointCloud


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


def test_discs_hold_thirty_points_and_three_images():
    """In a square lattice the sixth neighbour is at sqrt(2): a disc with five times its area has thirty points."""
    places = np.column_stack([grid(30), np.zeros(900)])
    assert choose_disc_diameter(places) == pytest.approx(2 * np.sqrt(2 * 5))
    # Profiles 3 mm apart with points every 0.2 mm: the sixth neighbour is at 0.6 mm.
    x, y = (each.ravel() for each in np.meshgrid(3.0 * np.arange(12), 0.2 * np.arange(60), indexing="ij"))
    profiles, frame = np.column_stack([x, y, np.zeros(720)]), np.repeat(np.arange(12), 60)
    assert choose_disc_diameter(profiles) == pytest.approx(2 * 0.6 * np.sqrt(5))
    assert choose_disc_diameter(profiles, frame) == pytest.approx(3 * 3.0)
    assert choose_disc_diameter(profiles, np.zeros(720, int)) == pytest.approx(2 * 0.6 * np.sqrt(5))


def test_a_footprint_is_longer_on_an_inclined_surface():
    """The laser along Z: a plane that is inclined about X stretches the footprint along its steepest tangent."""
    angle = np.radians([0.0, 60.0, 89.0])
    across, down = np.tile([1.0, 0.0, 0.0], (3, 1)), np.column_stack([0 * angle, np.cos(angle), np.sin(angle)])
    cloud = PointCloud(
        np.zeros((3, 3)),
        np.ones(3),
        np.zeros(3, int),
        np.arange(3),
        metadata={FOOTPRINT: [0.3, 0.1], FOOTPRINT_STD: 0.2},
    )
    found, std = project_footprint(cloud, np.arange(3), np.stack([across, down], axis=1))
    np.testing.assert_allclose(found[:2], [[0.3, 0.1], [0.3, 0.2]])
    # Limited at 73 deg.
    assert found[2, 1] == pytest.approx(0.1 / 0.3) and std == 0.2
    turned, _ = project_footprint(cloud, np.arange(1), np.stack([down[:1], -across[:1]], axis=1))
    np.testing.assert_allclose(turned, [[0.1, 0.3]])
    diagonal = np.array([[[1.0, 1.0, 0.0], [-1.0, 1.0, 0.0]]]) / np.sqrt(2)
    np.testing.assert_allclose(project_footprint(cloud, np.arange(1), diagonal)[0], [[np.sqrt(0.05)] * 2])
    plain, std = project_footprint(replace(cloud, metadata={}), np.arange(2), np.zeros((2, 2, 3)))
    assert std == 0 and not plain.any()
