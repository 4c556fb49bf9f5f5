"""Sections and steps: exact on exact points in any direction, and uncertainties compared with drawn errors."""

import numpy as np
import pytest
from scipy.stats import f as f_distribution

from uwlts.errors import EvaluationError
from uwlts.inspection.picking import cut_section, measure_step, order_profile
from uwlts.storage.cloud import PointCloud, PointUncertainty

HEIGHT_MM, DEPTH_MM = 3.0, 350.0
DRAWS = 400
NOISE_MM, COMMON_MM = 0.01, 0.004
FALSE_ALARM = 1e-5


def cloud_of(points: np.ndarray, *, frame: np.ndarray | None = None, known: PointUncertainty | None = None):
    count = len(points)
    frame = np.zeros(count, int) if frame is None else frame
    return PointCloud(points, np.ones(count), frame, np.arange(count), uncertainty=known)


def step_points(*, slope: float = 0.0, turn: float = 0.0) -> np.ndarray:
    """Return exact points (N, 3) of a step of HEIGHT_MM at 0, inclined by ``slope`` and turned about Z, in rad."""
    u, v = (each.ravel() for each in np.meshgrid(np.linspace(-20, 20, 81), np.linspace(-10, 10, 21)))
    surface = np.column_stack([u, v, np.where(u > 0, -HEIGHT_MM, 0.0)])
    c, s = np.cos(slope), np.sin(slope)
    inclined = surface @ np.array([[c, 0, s], [0, 1, 0], [-s, 0, c]]).T
    c, s = np.cos(turn), np.sin(turn)
    return inclined @ np.array([[c, -s, 0], [s, c, 0], [0, 0, 1]]).T + [5.0, -7.0, DEPTH_MM]


@pytest.mark.parametrize("slope", [0.0, 0.3, -0.2])
@pytest.mark.parametrize("turn", [0.0, 1.0, 2.5])
def test_the_height_of_an_inclined_step_is_exact(slope, turn):
    points = step_points(slope=slope, turn=turn)
    way = np.array([np.cos(turn), np.sin(turn), 0.0])
    middle = np.array([5.0, -7.0, DEPTH_MM])
    section = cut_section(cloud_of(points), middle - 8 * way, middle + 8 * way, width_mm=5.0)
    assert 200 < len(section.cloud) < len(points) / 3
    assert (np.diff(section.along_mm) >= -1e-9).all()
    found = measure_step(section, 0.0, 16.0, width_mm=10.0)
    assert found.figures_mm["height"] == pytest.approx(HEIGHT_MM, abs=1e-9)
    # The other way round it is a depth.
    assert measure_step(section, 16.0, 0.0, width_mm=10.0).figures_mm["height"] == pytest.approx(-HEIGHT_MM, abs=1e-9)


def test_a_section_has_exactly_the_points_of_its_strip():
    points = np.random.default_rng(2).uniform(-10, 10, (3000, 3))
    first, second = np.array([1.0, 2.0, 3.0]), np.array([4.0, -2.0, -8.0])
    section = cut_section(cloud_of(points), first, second, width_mm=2.0)
    # Distance from the line in X and Y, by the area of a triangle.
    a, b = second[:2] - first[:2], points[:, :2] - first[:2]
    inside = np.abs(a[0] * b[:, 1] - a[1] * b[:, 0]) / 5.0 <= 1.0
    assert 200 < inside.sum() == len(section.cloud)
    assert set(section.cloud.line.tolist()) == set(np.flatnonzero(inside).tolist())
    assert section.along_mm == pytest.approx((section.cloud.points_mm - first)[:, :2] @ [0.6, -0.8])
    index = section.find_nearest(2.0)
    assert abs(section.along_mm[index] - 2.0) == np.abs(section.along_mm - 2.0).min()


def test_a_profile_is_ordered_along_y():
    points = np.random.default_rng(3).uniform(-10, 10, (50, 3))
    section = order_profile(cloud_of(points))
    assert section.along_mm.tolist() == sorted(points[:, 1].tolist())
    assert section.depth_mm.tolist() == points[np.argsort(points[:, 1]), 2].tolist()


def test_the_uncertainty_of_a_step_is_the_scatter_of_drawn_errors():
    """Noise of each point, and a common error that grows along the section."""
    points = step_points()
    points = points[np.abs(points[:, 1] + 7.0) < 0.1]
    random = np.zeros((len(points), 6), np.float32)
    random[:, 5] = NOISE_MM**2
    pattern = np.zeros((1, len(points), 3), np.float32)
    pattern[0, :, 2] = COMMON_MM * (points[:, 0] > 5.0)
    known = PointUncertainty(random, np.zeros((len(points), 3), np.float32), pattern)
    section = cut_section(cloud_of(points, known=known), points[0], points[-1], width_mm=1.0)
    stated = measure_step(section, 10.0, 30.0, width_mm=16.0).uncertainty["height"]
    rng = np.random.default_rng(4)
    heights = []
    for _ in range(DRAWS):
        moved = section.cloud.points_mm + rng.normal(0, NOISE_MM, (len(points), 1)) * [0, 0, 1]
        other = cut_section(cloud_of(moved), moved[0], moved[-1], width_mm=1.0)
        heights.append(measure_step(other, 10.0, 30.0, width_mm=16.0).figures_mm["height"])
    # Both variances are of draws, eight and DRAWS: their ratio has an F distribution.
    low, high = f_distribution.ppf([FALSE_ALARM / 2, 1 - FALSE_ALARM / 2], 7, DRAWS - 1)
    assert low < stated.random_mm**2 / np.var(heights, ddof=1) < high
    # The upper face as a whole is moved; float32 in the file's arrays.
    assert stated.systematic_mm == pytest.approx(COMMON_MM, rel=1e-5)


def test_wrong_places_are_refused():
    cloud = cloud_of(step_points())
    place = cloud.points_mm[0]
    with pytest.raises(EvaluationError, match="the same X and Y"):
        cut_section(cloud, place, place + [0, 0, 5.0], width_mm=1.0)
    with pytest.raises(EvaluationError, match="no points within the strip"):
        cut_section(cloud, place + [0, 0.5, 0], place + [9.0, 0.5, 0], width_mm=0.1)
    section = cut_section(cloud, place, place + [9.0, 0, 0], width_mm=0.5)
    with pytest.raises(EvaluationError, match="overlap"):
        measure_step(section, 10.0, 12.0, width_mm=5.0)
    with pytest.raises(EvaluationError, match="expected at least 3"):
        measure_step(section, 10.0, 500.0, width_mm=5.0)
    with pytest.raises(EvaluationError, match="is empty"):
        order_profile(cloud.select(np.empty(0, int))).find_nearest(0.0)
