"""Fits of exact shapes, their scatter over many noisy repeats, and their limits.

The references are the shapes of the drawn points; no test repeats a formula of the fits.
"""

from functools import partial

import numpy as np
import pytest
from hypothesis import given, settings, strategies as st
from scipy.spatial.transform import Rotation

from uwlts.errors import EvaluationError
from uwlts.fitting.least_squares import fit_robustly
from uwlts.shapes.cylinder import Cylinder
from uwlts.shapes.flat import Line, Plane
from uwlts.shapes.sphere import Sphere

poses = st.tuples(
    st.integers(0, 2**32 - 1).map(lambda seed: Rotation.random(random_state=seed).as_matrix()),
    st.tuples(*[st.floats(-500, 500)] * 3).map(np.array),
)


def cap(rng, count: int, *, radius: float, half_angle: float) -> np.ndarray:
    """Points evenly over the cap of a sphere about the origin, within the half angle of +Z."""
    z = 1 - rng.random(count) * (1 - np.cos(half_angle))
    turn = rng.uniform(0, 2 * np.pi, count)
    across = np.sqrt(1 - z**2)
    return radius * np.column_stack([across * np.cos(turn), across * np.sin(turn), z])


def patch(rng, count: int, *, radius: float, arc: float, length: float) -> np.ndarray:
    """Points evenly over a patch of a cylinder about the X axis, facing +Z."""
    angle, x = rng.uniform(-arc / 2, arc / 2, count), rng.uniform(-length / 2, length / 2, count)
    return np.column_stack([x, radius * np.sin(angle), radius * np.cos(angle)])


def flat(rng, count: int) -> np.ndarray:
    return np.column_stack([rng.uniform(-60, 60, count), rng.uniform(-90, 90, count), np.zeros(count)])


# --- exact points in any pose. Coordinates up to 600 mm carry rounding of 1e-13 mm. A cap of 10 deg magnifies errors of
# its points by about 1 / (1 - cos 10 deg) = 66 along its axis, a patch of 30 deg by 30, and 1e-9 mm leaves a margin.


@settings(deadline=None, max_examples=50)
@given(pose=poses, radius=st.floats(2, 300), half_angle=st.floats(0.18, 3.0), seed=st.integers(0, 1000))
def test_exact_spheres_are_recovered_from_any_cap(pose, radius, half_angle, seed):
    rotation, shift = pose
    points = cap(np.random.default_rng(seed), 60, radius=radius, half_angle=half_angle) @ rotation.T + shift
    for fit in (Sphere.fit(points), Sphere.fit(points, radius)):
        np.testing.assert_allclose(fit.centre_mm, shift, rtol=0, atol=1e-9)
        assert abs(fit.radius_mm - radius) < 1e-9
        assert np.abs(fit.residuals_mm).max() < 1e-10


@settings(deadline=None, max_examples=12)
@given(pose=poses, radius=st.floats(10, 300), arc=st.floats(0.5, 6.0), seed=st.integers(0, 1000))
def test_exact_cylinders_are_recovered_from_any_patch(pose, radius, arc, seed):
    rotation, shift = pose
    points = patch(np.random.default_rng(seed), 200, radius=radius, arc=arc, length=40) @ rotation.T + shift
    for fit in (Cylinder.fit(points), Cylinder.fit(points, radius), Cylinder.fit(points, axis_start=rotation[:, 0])):
        assert 1 - abs(fit.axis @ rotation[:, 0]) < 1e-12
        assert np.linalg.norm(np.cross(fit.point_mm - shift, rotation[:, 0])) < 1e-7
        assert abs(fit.radius_mm - radius) < 1e-7
        assert np.abs(fit.residuals_mm).max() < 1e-10
        np.testing.assert_allclose(
            np.vstack([fit.across, fit.axis]) @ np.vstack([fit.across, fit.axis]).T, np.eye(3), atol=1e-12
        )
        assert abs((points.mean(axis=0) - fit.point_mm) @ fit.axis) < 1e-9


@settings(deadline=None, max_examples=40)
@given(pose=poses, seed=st.integers(0, 1000))
def test_exact_planes_and_lines_are_recovered(pose, seed):
    rotation, shift = pose
    rng = np.random.default_rng(seed)
    plane = Plane.fit(flat(rng, 30) @ rotation.T + shift, towards=rotation[:, 2])
    np.testing.assert_allclose(plane.normal, rotation[:, 2], rtol=0, atol=1e-12)
    assert abs((plane.point_mm - shift) @ rotation[:, 2]) < 1e-11
    assert plane.distances_mm(shift + 5 * rotation[:, 2]) == pytest.approx(5, abs=1e-11)
    along = rng.uniform(-90, 90, (20, 1))
    line = Line.fit(shift + along * rotation[:, 0], towards=rotation[:, 0])
    np.testing.assert_allclose(line.direction, rotation[:, 0], rtol=0, atol=1e-12)
    assert line.distances_mm((shift + 3 * rotation[:, 1])[None])[0] == pytest.approx(3, abs=1e-11)
    in_profile = Line.fit(shift[:2] + along * [0.6, 0.8], towards=[0.6, 0.8])
    np.testing.assert_allclose(in_profile.direction, [0.6, 0.8], rtol=0, atol=1e-12)
    assert in_profile.distances_mm(shift[:2] + np.array([[-1.6, 1.2]]))[0] == pytest.approx(2, abs=1e-11)
    assert in_profile.distances_mm(shift[:2] + np.array([[1.6, -1.2]]))[0] == pytest.approx(-2, abs=1e-11)


def test_residuals_are_positive_outside():
    rng = np.random.default_rng(0)
    ball, tube = cap(rng, 300, radius=25, half_angle=1.0), patch(rng, 300, radius=150, arc=1.2, length=40)
    assert Sphere.fit(ball).distances_mm([[0, 0, 26], [0, 0, 23]]) == pytest.approx([1, -2])
    assert Cylinder.fit(tube).distances_mm([[7, 0, 151], [-7, 0, 148]]) == pytest.approx([1, -2])


# --- noisy points: the least sum of squares, no bias, and the covariance that repeats show


SIGMA = 0.1


def shifted_line(points):
    """Offset and slope of a line along X in a profile."""
    fit = Line.fit(points, towards=[1, 0])
    return np.array([fit.distances_mm(np.zeros((1, 2)))[0] * -1, np.arctan2(fit.direction[1], fit.direction[0])]), fit


def plane_parameters(points):
    """Height over the origin and slopes along X and Y."""
    fit = Plane.fit(points, towards=[0, 0, 1])
    return np.array([-fit.distances_mm(np.zeros(3)), -fit.normal[0], -fit.normal[1]]), fit


def sphere_parameters(points, radius_mm=None):
    fit = Sphere.fit(points, radius_mm)
    return np.array([*fit.centre_mm, fit.radius_mm][: len(fit.covariance)]), fit


def cylinder_parameters(points, radius_mm=None):
    """Offsets of the axis along Y and Z at X = 0, its slopes, and the radius; the true axis is X."""
    fit = Cylinder.fit(points, radius_mm, axis_start=[1, 0, 0])
    offset = fit.point_mm - fit.axis * fit.point_mm[0] / fit.axis[0]
    return np.array([*offset[1:], *(fit.axis[1:] / fit.axis[0]), fit.radius_mm][: len(fit.covariance)]), fit


def in_world(fit, covariance):
    """Turn a cylinder's covariance from its own directions across the axis to Y and Z."""
    turn = np.eye(len(covariance))
    turn[:2, :2] = turn[2:4, 2:4] = fit.across[:, 1:].T
    return turn @ covariance @ turn.T


def plane_in_world(fit, covariance):
    """From slopes along the plane's own axes to slopes along X and Y."""
    turn = np.eye(3)
    turn[1:, 1:] = fit.axes[:, :2].T
    return turn @ covariance @ turn.T


def centred(points):
    return points - points.mean(axis=0)


ball, tube = partial(cap, radius=25.06), partial(patch, radius=150, arc=1.22, length=40)
CASES = {
    "sphere, 20 % of its surface": (partial(ball, half_angle=0.93), sphere_parameters, [0, 0, 0, 25.06], None),
    "sphere, 3 % of its surface": (partial(ball, half_angle=0.35), sphere_parameters, [0, 0, 0, 25.06], None),
    "sphere, known radius": (
        partial(ball, half_angle=0.35),
        partial(sphere_parameters, radius_mm=25.06),
        [0, 0, 0],
        None,
    ),
    "pipe, 70 deg": (tube, cylinder_parameters, [0, 0, 0, 0, 150], in_world),
    "pipe, known radius": (tube, partial(cylinder_parameters, radius_mm=150), [0, 0, 0, 0], in_world),
    "plane": (lambda rng, count: centred(flat(rng, count)), plane_parameters, [0, 0, 0], plane_in_world),
    "profile": (lambda rng, count: centred(flat(rng, count))[:, [1, 2]], shifted_line, [0, 0], None),
}
REPEATS = {"pipe, 70 deg": 200, "pipe, known radius": 200}
OTHER_REPEATS = 600


@pytest.mark.parametrize("name", CASES)
def test_repeats_scatter_about_the_truth_as_the_covariance_says(name):
    draw, solve, truth, turned = CASES[name]
    rng = np.random.default_rng(11)
    exact, repeats = draw(rng, 200), REPEATS.get(name, OTHER_REPEATS)
    errors, covariances = [], []
    for _ in range(repeats):
        parameters, fit = solve(exact + rng.normal(0, SIGMA, exact.shape))
        errors.append(parameters - truth)
        covariances.append(fit.covariance if turned is None else turned(fit, fit.covariance))
        assert fit.std_mm == pytest.approx(SIGMA, rel=0.3)  # 200 points: 5 % standard deviation
    errors, stated = np.array(errors), np.mean(covariances, axis=0)
    size = len(truth)
    # 4.5 standard errors of the mean are passed once in 1e5. The least-squares sphere and cylinder have a bias of
    # second order in the noise; a tenth of a standard deviation is allowed for it.
    limit = (4.5 / np.sqrt(repeats) + 0.1) * np.sqrt(np.diag(stated))
    assert (np.abs(errors.mean(axis=0)) < limit).all()
    # Squared errors in the metric of the covariance: chi square with `size` degrees of freedom each. The stated
    # covariances scatter with the estimate of the noise, whose mean over the repeats is accurate to a percent. Four
    # standard deviations of the mean and 3 % for the curvature of the problem.
    squared = np.einsum("ni,ij,nj->n", errors, np.linalg.inv(stated), errors)
    assert squared.mean() == pytest.approx(size, abs=4 * np.sqrt(2 * size / repeats) + 0.03 * size)
    # Each variance by itself has a relative standard deviation of sqrt(2 / repeats), at most 10 %.
    np.testing.assert_allclose(errors.var(axis=0) / np.diag(stated), 1, atol=4.5 * np.sqrt(2 / repeats))


@pytest.mark.parametrize("size", [1e-4, 1e-2])
def test_no_neighbouring_shape_has_a_smaller_sum_of_squares(size):
    rng = np.random.default_rng(5)
    ball = cap(rng, 500, radius=25, half_angle=0.6) + rng.normal(0, SIGMA, (500, 3)) + [100, -30, 320]
    tube = patch(rng, 500, radius=150, arc=1.2, length=40) + rng.normal(0, SIGMA, (500, 3)) + [100, -30, 320]
    sphere, cylinder = Sphere.fit(ball), Cylinder.fit(tube)
    least = [np.sum(sphere.residuals_mm**2), np.sum(cylinder.residuals_mm**2)]
    for _ in range(200):
        centre = sphere.centre_mm + rng.normal(0, size, 3)
        radius = sphere.radius_mm + rng.normal(0, size)
        assert np.sum((np.sqrt(((ball - centre) ** 2).sum(axis=1)) - radius) ** 2) > least[0]
        point, axis = cylinder.point_mm + rng.normal(0, size, 3), cylinder.axis + rng.normal(0, size / 20, 3)
        across = np.linalg.norm(np.cross(tube - point, axis / np.linalg.norm(axis)), axis=1)
        assert np.sum((across - cylinder.radius_mm - rng.normal(0, size)) ** 2) > least[1]


def test_pipe_patches_in_any_pose_find_the_axis_without_a_start():
    rng = np.random.default_rng(2)
    checked = 0
    for seed in range(20):
        rotation = Rotation.random(random_state=seed).as_matrix()
        points = patch(rng, 1500, radius=150, arc=np.radians(rng.uniform(60, 80)), length=40)
        fit = Cylinder.fit(points @ rotation.T + rng.uniform(-300, 300, 3) + rng.normal(0, SIGMA, points.shape))
        # 6 standard deviations as the fit states them, tested above.
        assert abs(fit.radius_mm - 150) < 6 * np.sqrt(fit.covariance[4, 4])
        assert np.hypot(*(fit.across @ rotation[:, 0])) < 6 * np.sqrt(fit.covariance[2, 2] + fit.covariance[3, 3])
        checked += 1
    assert checked == 20


def test_the_known_radius_does_not_end_on_the_wrong_side_of_a_noisy_cap():
    # A sagitta of 25 (1 - cos 5 deg) = 0.1 mm, as large as the noise of one point. The curvature of 400 points is
    # known to a few percent, so that the right side is never in doubt.
    wrong = 0
    for seed in range(60):
        rng = np.random.default_rng(seed)
        points = cap(rng, 400, radius=25, half_angle=np.radians(5)) + rng.normal(0, SIGMA, (400, 3))
        wrong += Sphere.fit(points, 25).centre_mm[2] > 12.5
    assert wrong == 0


# --- refusals


def circle(count):
    angle = np.linspace(0, 5, count)
    return np.column_stack([np.cos(angle), np.sin(angle), np.zeros(count)])


@pytest.mark.parametrize(
    "fit, points, message",
    [
        (Sphere.fit, circle(4), "at least 5"),
        (partial(Sphere.fit, radius_mm=2.0), circle(3), "at least 4"),
        (Plane.fit, circle(3), "at least 4"),
        (Line.fit, circle(2), "at least 3"),
        (Cylinder.fit, circle(5), "at least 6"),
        (partial(Cylinder.fit, radius_mm=2.0), circle(4), "at least 5"),
        (Sphere.fit, circle(50), "in one plane"),
        (partial(Sphere.fit, radius_mm=2.0), circle(50), "in one plane"),
        (Cylinder.fit, circle(50), "in one plane"),
        (Plane.fit, np.outer(np.arange(9.0), [1, 2, 3]), "on one line"),
        (Line.fit, np.array([[1.0, 0], [-1, 0], [0, 1], [0, -1]]), "equally"),
        (Plane.fit, np.ones((9, 3)), "points coincide"),
        (Sphere.fit, np.full((9, 3), np.nan), "9 of 9 points are not finite"),
        (partial(fit_robustly, Plane.fit), np.full((9, 3), np.inf), "9 of 9 points are not finite"),
    ],
)
def test_points_that_leave_the_shape_open_are_refused(fit, points, message):
    with pytest.raises(EvaluationError, match=message):
        fit(points)


@pytest.mark.parametrize("fit", [Sphere.fit, Cylinder.fit])
def test_a_noisy_plane_is_no_sphere_and_no_cylinder(fit):
    refused = 0
    for seed in range(8):
        rng = np.random.default_rng(seed)
        with pytest.raises(EvaluationError, match=r"do not determine|does not converge"):
            fit(flat(rng, 800) + rng.normal(0, SIGMA, (800, 3)))
        refused += 1
    assert refused == 8


@pytest.mark.parametrize(
    "call",
    [
        lambda: Sphere.fit(np.zeros((9, 2))),
        lambda: Plane.fit(np.zeros(9)),
        lambda: Sphere.fit(circle(9), -1.0),
        lambda: Cylinder.fit(circle(9) + np.arange(9.0)[:, None] ** 2, np.nan),
        lambda: Cylinder.fit(circle(9) + np.arange(9.0)[:, None] ** 2, axis_start=[0, 0, 0]),
    ],
)
def test_wrong_calls_are_refused(call):
    with pytest.raises(ValueError):
        call()


# --- outliers


@pytest.mark.parametrize(
    "fit, draw",
    [
        (Sphere.fit, partial(cap, radius=25.06, half_angle=1.0)),
        (Plane.fit, flat),
        (partial(Cylinder.fit, axis_start=[1, 0, 0]), partial(patch, radius=150, arc=1.2, length=40)),
    ],
)
def test_planted_outliers_and_only_they_are_rejected(fit, draw):
    rng = np.random.default_rng(8)
    points = draw(rng, 4000) + rng.normal(0, SIGMA, (4000, 3))
    outliers = rng.choice(4000, 40, replace=False)
    points[outliers, 2] += rng.uniform(2, 15, 40)  # at least 20 standard deviations up
    robust = fit_robustly(fit, points)
    clean = fit(np.delete(points, outliers, axis=0))
    # Of 3960 normal residuals, 0.002 are expected beyond 5 standard deviations.
    np.testing.assert_array_equal(np.flatnonzero(~robust.inliers), np.sort(outliers))
    assert (robust.rejected, robust.rejected_share) == (40, 0.01)
    np.testing.assert_allclose(robust.fit.residuals_mm, clean.residuals_mm, atol=1e-8)
    np.testing.assert_array_equal(robust.fit.residuals_mm, robust.distances_mm[robust.inliers])
    assert robust.limit_mm == pytest.approx(5 * SIGMA, rel=0.1)
    assert robust.rounds > 1


def test_clean_points_are_all_kept_noisy_or_exact():
    rng = np.random.default_rng(9)
    points = cap(rng, 20000, radius=25, half_angle=1.0)
    # 20000 normal residuals: 0.01 expected beyond 5 standard deviations.
    assert fit_robustly(Sphere.fit, points + rng.normal(0, SIGMA, points.shape)).rejected == 0
    assert fit_robustly(Sphere.fit, points + np.array([0, 0, 500])).rejected == 0


def test_the_limit_follows_k():
    rng = np.random.default_rng(10)
    points = flat(rng, 20000) + rng.normal(0, SIGMA, (20000, 3))
    # 0.27 % of a normal distribution are beyond 3 standard deviations: 54 +- 7.3; iterations shift the limit by 1 %.
    assert fit_robustly(Plane.fit, points, k=3.0).rejected == pytest.approx(54, abs=35)
