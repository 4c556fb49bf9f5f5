"""Lengths and shapes at picked places: exact on exact points, and uncertainties compared with drawn errors."""

from typing import get_args

import numpy as np
import pytest
from scipy.stats import chi2

from uwlts.errors import EvaluationError
from uwlts.inspection.picking import Shape, find_nearest_point, fit_shape_near, measure_length
from uwlts.storage.cloud import PAIRS, PointCloud, PointUncertainty

CENTRE = np.array([30.0, -12.0, 350.0])
DRAWS = 3000
FALSE_ALARM = 5e-6
"""Probability of a false alarm in one of 16 comparisons; with other seeds, any of them fails with less than 1e-4."""
NOT_LINEAR = 1.02
"""Allowed ratio of the variance of a quantity at moved points to the variance of its linear approximation."""


def cloud_of(
    points: np.ndarray, *, frame: np.ndarray | None = None, known: PointUncertainty | None = None
) -> PointCloud:
    count = len(points)
    frame = np.zeros(count, int) if frame is None else frame
    return PointCloud(points, np.ones(count), frame, np.arange(count), uncertainty=known)


def on_shape(shape: Shape, count: int, *, seed: int = 0) -> np.ndarray:
    """Return exact points on a cap of a sphere of radius 20, on a plane, or on a cylinder of radius 8, about CENTRE."""
    rng = np.random.default_rng(seed)
    if shape == "sphere":
        away = rng.normal(size=(count, 3))
        away[:, 2] = -1.5 * np.abs(away[:, 2]) - 0.5
        return CENTRE + 20 * away / np.linalg.norm(away, axis=1, keepdims=True)
    x, y = rng.uniform(-14, 14, (2, count))
    if shape == "plane":
        return CENTRE + np.column_stack([x, y, 0.3 * x - 0.2 * y])
    turn = rng.uniform(0.5, np.pi - 0.5, count)
    return CENTRE + np.column_stack([8 * np.cos(turn), y, -8 * np.sin(turn)])


def disturbed(points: np.ndarray, *, seed: int = 1, patterns_by: float = 1.0) -> PointCloud:
    """Return points with noise along their rays, image offsets and patterns of the calibration."""
    rng = np.random.default_rng(seed)
    image = ((points[:, 0] - points[:, 0].min()) / 1.5).astype(int)
    rays = np.array([0.002, -0.004, 0.012]) * rng.uniform(0.7, 1.3, (len(points), 1))
    random = np.stack([rays[:, i] * rays[:, j] for i, j in PAIRS], axis=1).astype(np.float32)
    position = np.tile(np.float32([0.006, 0.001, 0.0]), (len(points), 1))
    about = points - CENTRE
    patterns = [rng.normal(0, 0.01, 3) + about @ rng.normal(0, 4e-4, (3, 3)) + 2e-5 * about**2 * k for k in range(3)]
    return cloud_of(
        # Uniform errors, so that no point is rejected as an outlier.
        points + rng.uniform(-1.7, 1.7, (len(points), 1)) * rays,
        frame=rng.permutation(image.max() + 1)[image],
        known=PointUncertainty(random, position, (patterns_by * np.array(patterns)).astype(np.float32)),
    )


class Errors:
    """Displacements (N, 3) of a cloud's points, drawn by the definitions of `PointUncertainty`."""

    def __init__(self, cloud: PointCloud):
        self._known, (self._images, self._image) = cloud.uncertainty, np.unique(cloud.frame, return_inverse=True)
        covariance = np.zeros((len(cloud), 3, 3))
        for column, (i, j) in enumerate(PAIRS):
            covariance[:, i, j] = covariance[:, j, i] = self._known.random_mm2[:, column]
        strengths, axes = np.linalg.eigh(covariance)
        self._roots = axes * np.sqrt(np.maximum(strengths, 0))[:, None]

    def random(self, rng: np.random.Generator) -> np.ndarray:
        """Draw the noise of each point and the position of each image."""
        noise = np.einsum("nij,nj->ni", self._roots, rng.standard_normal((len(self._roots), 3)))
        return noise + rng.standard_normal(len(self._images))[self._image][:, None] * self._known.position_mm

    def systematic(self, rng: np.random.Generator) -> np.ndarray:
        """Draw all patterns, each with its own factor."""
        return np.einsum("m,mni->ni", rng.standard_normal(len(self._known.patterns_mm)), self._known.patterns_mm)


def agree(ratio: float, freedom: int) -> bool:
    """Return True if the ratio of an estimated variance to the true one is within its statistical limits.

    The ratio times its degrees of freedom is chi-square distributed. The limits have the probability FALSE_ALARM, and
    are widened by the nonlinearity.
    """
    low, high = (chi2.ppf(p, freedom) / freedom for p in (FALSE_ALARM / 2, 1 - FALSE_ALARM / 2))
    return low / NOT_LINEAR <= ratio <= high * NOT_LINEAR


# Lengths


def test_the_nearest_point_is_found():
    cloud = cloud_of(np.array([[0.0, 0, 0], [10, 0, 0], [0, 10, 5]]))
    assert [find_nearest_point(cloud, np.array(place)) for place in ([1.0, 0, 0], [6, 0, 0], [0, 9, 90])] == [0, 1, 2]
    with pytest.raises(EvaluationError, match="no points to measure"):
        find_nearest_point(cloud_of(np.empty((0, 3))), np.zeros(3))


def test_a_length_is_that_of_its_two_points():
    points = np.array([[1.0, 2.0, 300.0], [4.0, -2.0, 312.0], [0, 0, 0]])
    measured = measure_length(cloud_of(points), 0, 1)
    assert measured.figures_mm == {"distance": pytest.approx(13.0, abs=1e-12)}
    assert measured.uncertainty == {} and (measured.points_used, measured.points_rejected) == (2, 0)
    assert measured.text() == "length: distance 13.0000 mm (2 points)"
    assert measure_length(cloud_of(points), 1, 0).figures_mm == measured.figures_mm


def test_a_length_between_one_point_is_refused():
    with pytest.raises(EvaluationError, match="same point"):
        measure_length(cloud_of(np.zeros((3, 3))), 1, 1)


def test_points_in_one_place_are_no_distance_apart():
    measured = measure_length(disturbed(np.tile(CENTRE, (2, 1))), 0, 1)
    assert measured.figures_mm["distance"] < 0.1 and np.isfinite(measured.uncertainty["distance"].expanded_mm)
    still = cloud_of(np.ones((2, 3)))
    assert measure_length(still, 0, 1).figures_mm == {"distance": 0.0}


@pytest.mark.parametrize("same_image", [True, False])
def test_a_lengths_uncertainty_is_that_of_drawn_errors(same_image):
    points = CENTRE + np.array([[-10.0, 3.0, 1.0], [-9.5 if same_image else 11.0, -6.0, 4.0]])
    cloud = disturbed(points)
    assert (cloud.frame[0] == cloud.frame[1]) is np.bool_(same_image)
    stated = measure_length(cloud, 0, 1).uncertainty["distance"]
    rng, errors = np.random.default_rng(5), Errors(cloud)
    for drawn, value in ((errors.random, stated.random_mm), (errors.systematic, stated.systematic_mm)):
        first, second = np.moveaxis([cloud.points_mm + drawn(rng) for _ in range(DRAWS)], 1, 0)
        lengths = np.linalg.norm(second - first, axis=1)
        assert agree(np.var(lengths, ddof=1) / value**2, DRAWS - 1)
    # Common errors cancel: a pattern that moves all points equally, the position of their common image.
    alike = PointUncertainty(np.zeros((2, 6)) + 1e-12, np.full((2, 3), 0.5), np.full((4, 2, 3), 0.7))
    together = measure_length(cloud_of(points, frame=np.array([3, 3]), known=alike), 0, 1).uncertainty["distance"]
    assert together.systematic_mm == pytest.approx(0, abs=1e-12) and together.random_mm < 1e-5
    apart = measure_length(cloud_of(points, frame=np.array([3, 4]), known=alike), 0, 1).uncertainty["distance"]
    unit = (points[1] - points[0]) / np.linalg.norm(points[1] - points[0])
    assert apart.random_mm == pytest.approx(0.5 * abs(unit.sum()) * np.sqrt(2), rel=1e-4)


# Shapes


@pytest.mark.parametrize(("shape", "diameter"), [("sphere", 40.0), ("plane", None), ("cylinder", 16.0)])
def test_a_shape_is_measured_exactly_on_exact_points(shape, diameter):
    points = on_shape(shape, 800)
    far = CENTRE + np.array([500.0, 0, 0]) + np.random.default_rng(3).normal(0, 5, (300, 3))
    measured = fit_shape_near(cloud_of(np.vstack([far, points])), CENTRE, 60.0, shape)
    assert measured.name == shape and measured.uncertainty == {}
    assert (measured.points_used, measured.points_rejected) == (800, 0)
    assert measured.figures_mm["standard deviation"] == pytest.approx(0.0, abs=1e-8)
    assert measured.figures_mm.get("diameter") == (None if diameter is None else pytest.approx(diameter, abs=1e-7))


@pytest.mark.parametrize("shape", get_args(Shape))
def test_points_off_the_shape_are_left_out(shape):
    rng = np.random.default_rng(2)
    points = on_shape(shape, 800) + rng.normal(0, 0.01, (800, 3))
    clean = fit_shape_near(cloud_of(points), CENTRE, 60.0, shape)
    wrong = points[:12] + [0.0, 0.0, -3.0]
    measured = fit_shape_near(cloud_of(np.vstack([points, wrong])), CENTRE, 60.0, shape)
    assert measured.points_rejected == 12 + clean.points_rejected and measured.points_used == clean.points_used
    assert measured.figures_mm == pytest.approx(clean.figures_mm, abs=1e-6)
    assert f"{measured.points_rejected} left out" in measured.text()


def test_only_points_within_the_radius_count():
    points = on_shape("plane", 4000)
    for radius in (5.0, 9.0):
        within = int((np.linalg.norm(points - CENTRE, axis=1) <= radius).sum())
        assert fit_shape_near(cloud_of(points), CENTRE, radius, "plane").points_used == within


def test_of_very_many_points_a_part_is_used():
    points = on_shape("plane", 45_000)
    measured = fit_shape_near(cloud_of(points), CENTRE, 100.0, "plane")
    assert measured.points_used == 15_000 and measured.figures_mm["standard deviation"] < 1e-9


def sphere_figures(points: np.ndarray) -> list[float]:
    """Return diameter and standard deviation of the least-squares sphere, by Gauss-Newton."""
    centre, radius = points.mean(axis=0) + [0, 0, 10.0], 20.0
    for _ in range(6):
        way = points - centre
        length = np.linalg.norm(way, axis=1)
        slopes = np.column_stack([-way / length[:, None], -np.ones(len(points))])
        step = np.linalg.lstsq(slopes, radius - length, rcond=None)[0]
        centre, radius = centre + step[:3], radius + step[3]
    residuals = np.linalg.norm(points - centre, axis=1) - radius
    return [2 * radius, float(np.sqrt(residuals @ residuals / (len(points) - 4)))]


def plane_figures(points: np.ndarray) -> list[float]:
    """Return the standard deviation from the plane, by the smallest eigenvalue of the scatter matrix."""
    centred = points - points.mean(axis=0)
    return [float(np.sqrt(np.linalg.eigvalsh(centred.T @ centred)[0] / (len(points) - 3)))]


def cylinder_figures(points: np.ndarray) -> list[float]:
    """Return diameter and standard deviation of the least-squares cylinder about nearly the Y axis, by Gauss-Newton."""
    about = points - CENTRE
    x, z, by_x, by_z, radius = 0.0, 0.0, 0.0, 0.0, 8.0
    for _ in range(6):
        axis = np.array([by_x, 1.0, by_z])
        unit = axis / np.linalg.norm(axis)
        way = about - [x, 0.0, z]
        way = way - np.outer(way @ unit, unit)
        length = np.linalg.norm(way, axis=1)
        out = way / length[:, None]
        slopes = np.column_stack(
            [-out[:, 0], -out[:, 2], -out[:, 0] * about[:, 1], -out[:, 2] * about[:, 1], -np.ones(len(about))]
        )
        step = np.linalg.lstsq(slopes, radius - length, rcond=None)[0]
        x, z, by_x, by_z, radius = (np.array([x, z, by_x, by_z, radius]) + step).tolist()
    residuals = length - radius
    return [2 * radius, float(np.sqrt(residuals @ residuals / (len(points) - 5)))]


FIGURES = {"sphere": sphere_figures, "plane": plane_figures, "cylinder": cylinder_figures}


def remeasured(shape: Shape, cloud: PointCloud, kind: str, draws: int) -> np.ndarray:
    """Return variances of a shape's figures under repeatedly drawn errors."""
    rng, errors = np.random.default_rng(8), Errors(cloud)
    moved = (cloud.points_mm + getattr(errors, kind)(rng) for _ in range(draws))
    return np.var([FIGURES[shape](points) for points in moved], axis=0, ddof=1)


@pytest.mark.parametrize(
    ("shape", "patterns_by", "names"),
    [
        ("sphere", 1.0, {"diameter"}),
        ("cylinder", 1.0, {"diameter"}),
        ("sphere", 0.002, {"diameter", "standard deviation"}),
        ("cylinder", 0.002, {"diameter", "standard deviation"}),
        ("plane", 0.002, {"standard deviation"}),
    ],
)
def test_what_the_calibration_does_to_a_shape_is_that_of_drawn_patterns(shape, patterns_by, names):
    """The standard deviation is linear in the patterns only if they are small relative to it."""
    cloud, draws = disturbed(on_shape(shape, 120), patterns_by=patterns_by), 1000
    measured = fit_shape_near(cloud, CENTRE, 60.0, shape)
    assert measured.points_used == len(cloud)
    np.testing.assert_allclose(FIGURES[shape](cloud.points_mm), list(measured.figures_mm.values()), atol=1e-7)
    for name, variance in zip(measured.figures_mm, remeasured(shape, cloud, "systematic", draws), strict=True):
        if name in names:
            assert agree(variance / measured.uncertainty[name].systematic_mm ** 2, draws - 1), name


@pytest.mark.slow
@pytest.mark.parametrize("shape", get_args(Shape))
def test_what_noise_does_to_a_shape_is_that_of_drawn_noise(shape):
    """Stated uncertainties from 8 draws have an error of 27 %: those of ten clouds are compared together."""
    ratios = []
    for number in range(10):
        cloud = disturbed(on_shape(shape, 100 + 7 * number, seed=number), seed=50 + number)
        measured = fit_shape_near(cloud, CENTRE, 60.0, shape)
        assert measured.points_used == len(cloud)
        stated = [measured.uncertainty[name].random_mm for name in measured.figures_mm]
        ratios.append(np.square(stated) / remeasured(shape, cloud, "random", 150))
    for ratio in np.mean(ratios, axis=0):
        # The drawn variances' own chance, 12 % each and 4 % together, hides in that of 7 degrees of freedom ten times.
        assert agree(ratio, 10 * 7), ratios


def test_what_moves_a_shape_as_a_whole_leaves_its_figures():
    points = on_shape("sphere", 300)
    shifts = np.ones((2, 300, 1), np.float32) * np.float32([[[0.3, 0, 0.1]], [[0, -0.2, 0]]])
    known = PointUncertainty(np.full((300, 6), 1e-12, np.float32), np.zeros((300, 3), np.float32), shifts)
    stated = fit_shape_near(cloud_of(points, known=known), CENTRE, 60.0, "sphere").uncertainty["diameter"]
    assert stated.systematic_mm < 1e-6 and stated.random_mm < 1e-5
    # A pattern that scales the cloud by 1.001 scales the diameter by the same factor.
    larger = PointUncertainty(known.random_mm2, known.position_mm, (1e-3 * (points - CENTRE))[None].astype(np.float32))
    stated = fit_shape_near(cloud_of(points, known=larger), CENTRE, 60.0, "sphere").uncertainty["diameter"]
    assert stated.systematic_mm == pytest.approx(0.04, rel=1e-4)


@pytest.mark.parametrize(
    ("points", "radius", "shape", "says"),
    [
        (np.zeros((5, 3)) + CENTRE + 90, 15.0, "plane", "no points within 15 mm"),
        (np.empty((0, 3)), 15.0, "plane", "no points within"),
        (on_shape("plane", 100), 0.0, "plane", "no points within"),
        (on_shape("plane", 100), float("nan"), "plane", "no points within"),
        (on_shape("plane", 3), 60.0, "plane", "needs at least 4 points"),
        (np.tile(CENTRE, (50, 1)), 15.0, "plane", "coincide"),
        (CENTRE + np.outer(np.arange(30.0), [1, 0, 0]), 60.0, "plane", "on one line"),
        (on_shape("plane", 100), 60.0, "sphere", "sphere"),
        (on_shape("sphere", 4), 60.0, "sphere", "needs at least 5 points"),
        (on_shape("plane", 100), 60.0, "cylinder", "cylinder"),
    ],
)
def test_points_that_determine_no_shape_are_refused(points, radius, shape, says):
    with pytest.raises(EvaluationError, match=says):
        fit_shape_near(cloud_of(points), CENTRE, radius, shape)


def test_the_text_has_expanded_uncertainties_and_is_the_same_each_time():
    cloud = disturbed(on_shape("sphere", 200))
    measured, again = (fit_shape_near(cloud, CENTRE, 60.0, "sphere") for _ in range(2))
    assert measured.text() == again.text()
    stated = measured.uncertainty["diameter"]
    assert stated.expanded_mm == pytest.approx(2 * np.hypot(stated.random_mm, stated.systematic_mm))
    assert f"diameter {measured.figures_mm['diameter']:.4f} ± {stated.expanded_mm:.4f} mm" in measured.text()
