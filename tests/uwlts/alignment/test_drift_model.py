"""Model of a drift by the covariance that a navigation states, propagated here step by step."""

import numpy as np
import pytest

from uwlts.alignment.path_prior import RATES, DriftModel, candidates_beside, choose_drift_model
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


def test_a_navigation_a_hundred_times_as_accurate_has_a_hundredth_of_the_drift():
    usual = navigated(by_heading=True)
    better = Trajectory(usual.times_s, usual.poses, 1e-4 * usual.covariance)
    one, other = (choose_drift_model(each, None, None) for each in (usual, better))
    np.testing.assert_allclose(other.std, one.std / 100, rtol=1e-3)
    np.testing.assert_allclose(other.walk, one.walk, atol=1e-3)


@pytest.mark.parametrize(("share", "dead_reckoned"), [(0.6, True), (0.4, False), (-1.0, False)])
def test_positions_count_as_dead_reckoned_by_half_of_the_covariance_with_the_heading(share, dead_reckoned):
    path = navigated(by_heading=True)
    covariance = path.covariance.copy()
    covariance[:, :2, 5] *= share
    covariance[:, 5, :2] *= share
    found = choose_drift_model(Trajectory(path.times_s, path.poses, covariance), None, None)
    assert found.dead_reckoned == dead_reckoned


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


@pytest.mark.parametrize(("correlation", "smooth"), [(0.03, False), (1.0, False), (0.3, True), (np.inf, False)])
def test_a_drift_deviates_from_a_straight_line_by_its_covariance(correlation: float, smooth: bool):
    drift = DriftModel(
        np.arange(1.0, 7.0), np.array([0.0, 1e-4, 0.01, 0.1, 0.5, 1.0]), correlation, smooth, False, False
    )
    for step in (0.01, 0.2):
        t = np.array([0.5, 0.5 + step / 2, 0.5 + step])
        line = np.array([-0.5, 1.0, -0.5])
        expected = line @ drift.covariance(t[:, None], t, 1.0) @ line
        np.testing.assert_allclose(drift.deviation(step) ** 2, expected, rtol=1e-3, atol=1e-12)


def test_candidates_beside_another_keep_its_rates_if_only_the_walk_is_selected():
    models = DriftModel.of_size(300.0, 1.0).candidates()
    described = [(each.correlation, each.smooth, each.walk[0]) for each in models]
    own = described.index((1.0, False, 0.01))
    walks = {described[number] for number in candidates_beside(own, walk_only=True)}
    assert walks == {(1.0, False, share) for share in (0.003, 0.01, 0.03)}
    both = {described[number] for number in candidates_beside(own, walk_only=False)}
    assert both == walks | {(*rate, 0.01) for rate in RATES}
    # The smallest walk has one neighbour.
    assert len(candidates_beside(described.index((1.0, False, 0.0)), walk_only=True)) == 2


@pytest.mark.parametrize("correlation", [None, 0.1, 0.3, 1.0, np.inf])
def test_the_most_likely_drift_states_the_errors(correlation: float | None) -> None:
    """Displacements within and across three crossings are known; the most likely of the candidate drifts is used.

    The drift is a random walk, or the integral of a Gauss-Markov rate or of a rate with a random walk. With smooth
    rates of one correlation time as candidates, 72 to 87 % of the coordinates of rates are within twice the stated
    uncertainty. With these, eight other seeds of each drift have 91 to 96 %. The lowest mean is 92.8 %, with a standard
    deviation of 0.7 %: the limit is four of them below it.
    """
    t = np.append(np.linspace(0.02, 1, 50), np.ravel([(at, at + 0.007) for at in (0.05, 0.12, 0.35, 0.5, 0.6, 0.69)]))
    seen = np.zeros((6, len(t)))
    for row, (first, second) in zip(seen, [(0, 6), (1, 7), (2, 8), (3, 9), (4, 10), (5, 11)], strict=True):
        row[[50 + first, 50 + second]] = -1, 1
    earlier, later = np.minimum(t[:, None], t), np.maximum(t[:, None], t)
    if correlation is None:
        true = earlier
    elif np.isinf(correlation):
        true = earlier**2 * (3 * later - earlier) / 2
    else:
        # Covariance of the integral of a process with the covariance exp(-|t - u| / T), of unit variance at the end.
        at, by, apart = (np.exp(-each / correlation) for each in (earlier, later, later - earlier))
        true = 2 * earlier / correlation + at + by - 1 - apart
        true /= 2 / correlation + 2 * np.exp(-1 / correlation) - 2
    models = [each.covariance(t[:, None], t, 1.0)[0] for each in DriftModel.of_size(1.0, 1.0).candidates()]
    rng, inside = np.random.default_rng(5), []
    root = np.linalg.cholesky(true + 1e-9 * np.eye(len(t)))
    gains, variances, roots = [], [], []
    for model in models:
        of_seen = seen @ model @ seen.T + 1e-7 * np.eye(len(seen))
        gain = np.linalg.solve(of_seen, seen @ model).T
        gains.append(gain[:50])
        variances.append((np.diag(model) - np.einsum("tq,qt->t", gain, seen @ model))[:50])
        roots.append(np.linalg.cholesky(of_seen))
    for _ in range(80):
        drift = root @ rng.standard_normal((len(t), 6))
        known = seen @ drift
        likelihoods = [
            -np.sum(np.linalg.solve(each, known) ** 2) - 12 * np.sum(np.log(np.diag(each))) for each in roots
        ]
        best = int(np.argmax(likelihoods))
        inside.append(np.abs(gains[best] @ known - drift[:50]) < 2 * np.sqrt(variances[best])[:, None])
    assert np.mean(inside) > 0.90
