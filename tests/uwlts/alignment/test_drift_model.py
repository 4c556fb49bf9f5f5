"""Model of a drift by the covariance that a navigation states, propagated here step by step."""

import numpy as np
import pytest

from uwlts.alignment.drift_model import DriftModel, choose_drift_model
from uwlts.errors import EvaluationError
from uwlts.model.trajectory import Trajectory

SECONDS, BEFORE_S, STEP_S = 100.0, 2.0, 0.05
BIAS_MM_S, NOISE, GYRO, HEADING_NOISE = 3.0, 2.0, 2e-4, 1e-4
"""Velocity: mm/s, mm/s per root Hz; heading: rad/s, rad/s per root Hz."""
DEPTH_MM, TILT = 3.0, 2e-3


def navigated(*, by_heading: bool) -> Trajectory:
    """Return a trajectory along X, then along Y, that starts 2 s after the navigation.

    The state is the error of x, y and heading, and their biases.
    """
    times = np.arange(-BEFORE_S, SECONDS + STEP_S / 2, STEP_S)
    velocity = np.where(times[:, None] < SECONDS / 3, (200.0, 0.0), (0.0, 150.0))
    spread = np.diag([0, 0, 0, BIAS_MM_S**2, BIAS_MM_S**2, GYRO**2])
    noise = np.diag([NOISE**2, NOISE**2, HEADING_NOISE**2, 0, 0, 0]) * STEP_S
    covariance = np.zeros((len(times), 6, 6))
    for number, (x, y) in enumerate(velocity):
        rows = np.array([0, 1, 5])
        covariance[number][np.ix_(rows, rows)] = spread[:3, :3]
        covariance[number, [2, 3, 4], [2, 3, 4]] = DEPTH_MM**2, TILT**2, TILT**2
        step = np.eye(6)
        step[[0, 1, 2], [3, 4, 5]] = STEP_S
        if by_heading:
            step[:2, 2] = -y * STEP_S, x * STEP_S
        spread = step @ spread @ step.T + noise
    poses = np.tile(np.eye(4), (len(times), 1, 1))
    poses[1:, :2, 3] = np.cumsum(velocity * STEP_S, axis=0)[:-1]
    used = times >= 0
    return Trajectory(times[used], poses[used], covariance[used])


@pytest.mark.parametrize("by_heading", [True, False])
def test_rates_walks_and_dead_reckoning_are_found_from_the_covariance(by_heading: bool):
    found = choose_drift_model(navigated(by_heading=by_heading), None, None)
    assert found.stated
    assert found.dead_reckoned == by_heading
    size, walk = found.std**2, found.std**2 * found.walk
    # Continuously measured quantities are modelled as random walks with twice their variance, an upper bound.
    np.testing.assert_allclose(size[2:5], 2 * np.array([DEPTH_MM, TILT, TILT]) ** 2)
    np.testing.assert_allclose(found.walk[2:5], 1.0)
    # The part caused by the heading is subtracted; its random walk leaves a small remainder.
    rates = np.sqrt((size - walk)[[0, 1, 5]])
    np.testing.assert_allclose(rates, np.array([BIAS_MM_S, BIAS_MM_S, GYRO]) * SECONDS, rtol=0.05)
    # The rate has drifted for 2 s before: v(t) - v(0) is not only quadratic.
    np.testing.assert_allclose(walk[:2], NOISE**2 * SECONDS, rtol=0.5)
    np.testing.assert_allclose(walk[5], HEADING_NOISE**2 * SECONDS, rtol=0.1)


@pytest.mark.parametrize("rate", [0.0, 0.3])
def test_a_random_walk_is_distinguished_from_an_earlier_rate(rate: float):
    times = np.linspace(0, SECONDS, 200)
    poses = np.tile(np.eye(4), (len(times), 1, 1))
    poses[:, 0, 3] = times
    grown = times + (rate * times) ** 2
    found = choose_drift_model(
        Trajectory(times, poses, grown[:, None, None] * np.diag(np.repeat([4.0, 1e-6], 3))), None, None
    )
    np.testing.assert_allclose(found.std**2, grown[-1] * np.repeat([4.0, 1e-6], 3), rtol=0.01)
    np.testing.assert_allclose(found.walk, SECONDS / grown[-1], rtol=0.01)


def test_a_given_drift_states_only_its_size():
    found = choose_drift_model(navigated(by_heading=True), 300.0, 1.0)
    assert not found.stated and not found.dead_reckoned
    np.testing.assert_allclose(found.std, np.repeat([300.0, np.radians(1.0)], 3))


def test_a_path_without_covariance_needs_the_size_of_its_drift():
    path = navigated(by_heading=False)
    with pytest.raises(EvaluationError, match="give drift_mm and drift_deg"):
        choose_drift_model(Trajectory(path.times_s, path.poses), None, None)
    with pytest.raises(EvaluationError, match="give both"):
        choose_drift_model(path, 300.0, None)


def test_the_most_likely_walk_states_the_errors_of_a_random_walk() -> None:
    """Three relative displacements of a path are known; the most likely of the candidate drifts is used.

    With candidates of at most 0.3, 77 % of the coordinates are within twice the stated uncertainty. With all of them,
    12 other seeds have 92 to 96 %, with a standard deviation of 1.3 %: the limit is four of them below the mean.
    """
    times = np.linspace(0.02, 1, 50)
    seen = np.zeros((3, 50))
    for row, (first, second) in zip(seen, [(2, 24), (5, 30), (17, 34)], strict=True):
        row[[first, second]] = -1, 1
    true = np.minimum(times[:, None], times)
    models = [each.covariance(times[:, None], times, 1.0)[0] for each in DriftModel.of_size(1.0, 1.0).with_walks()]
    rng, inside = np.random.default_rng(5), []
    for _ in range(80):
        drift = np.linalg.cholesky(true + 1e-9 * np.eye(50)) @ rng.standard_normal((50, 6))
        fits = []
        for model in models:
            of_seen = seen @ model @ seen.T + 1e-6 * np.eye(3)
            likelihood = (
                -np.sum((seen @ drift) * np.linalg.solve(of_seen, seen @ drift)) - 6 * np.linalg.slogdet(of_seen)[1]
            )
            gain = np.linalg.solve(of_seen, seen @ model).T
            fits.append((likelihood, gain, np.diag(model) - np.einsum("tq,qt->t", gain, seen @ model)))
        _, gain, variance = max(fits, key=lambda fit: fit[0])
        inside.append(np.abs(gain @ (seen @ drift) - drift) < 2 * np.sqrt(variance)[:, None])
    assert np.mean(inside) > 0.88
