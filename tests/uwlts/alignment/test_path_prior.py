"""Prior of the correction of a path, against drifts that are drawn step by step."""

import numpy as np

from uwlts.alignment.path_prior import DriftKind, PathPrior, PathSpline
from uwlts.model.trajectory import Trajectory

SECONDS, SPEED_MM_S = 20.0, 200.0
DRIFT = np.array([30.0, 20.0, 10.0, 0.01, 0.01, 0.02])
MEASURED = np.array([False, False, True, False, False, False])


def straight_path() -> Trajectory:
    """Along X."""
    times = np.linspace(0, SECONDS, 81)
    poses = np.tile(np.eye(4), (len(times), 1, 1))
    poses[:, 0, 3] = SPEED_MM_S * times
    return Trajectory(times, poses)


def spline(*, closer_s: np.ndarray | None = None) -> PathSpline:
    """The path's spline, with closer knots where wanted."""
    path = PathSpline.of(straight_path(), DRIFT, MEASURED, np.linspace(0, SECONDS, 41))
    return path if closer_s is None else path.resolved(closer_s, 0.02)


def covariance(prior: PathPrior, times_s: np.ndarray) -> np.ndarray:
    """Of the drift at times (N,), (N, 6, N, 6)."""
    count = prior.path.count
    basis = prior.path.basis(times_s)
    blocks = prior.covariance(np.eye(6 * count)).reshape(count, 6, count, 6)
    return np.einsum("nc,cidj,md->nimj", basis, blocks, basis, optimize=True)


def test_kinds_of_drift_have_the_covariance_of_drifts_drawn_step_by_step():
    kind = DriftKind(smooth=0.7, wandering=0.4, walk=0.2, turn_walk=0.2)
    draws, steps = 20_000, 400
    rng = np.random.default_rng(4)
    t = np.arange(1, steps + 1) / steps
    walks = rng.standard_normal((3, draws, steps)).cumsum(axis=2) / np.sqrt(steps)
    once = walks[1].cumsum(axis=1) / steps
    twice = walks[2].cumsum(axis=1).cumsum(axis=1) / steps**2
    drawn = rng.standard_normal((draws, 1)) * t + np.sqrt(0.2) * walks[0]
    # Variances of the integrals at the end: 1/3 and 1/20.
    drawn = drawn + np.sqrt(0.4 * 3) * once + np.sqrt(0.7 * 20) * twice
    rows = np.array([99, 199, 299, 399])
    expected = np.cov(drawn[:, rows].T)
    prior = PathPrior(spline(closer_s=np.linspace(9, 11, 50)), kind)
    times = SECONDS * t[rows]
    found = covariance(prior, times)
    size = np.sqrt(np.diag(expected))
    for component in np.flatnonzero(~MEASURED):
        own = found[:, component, :, component] + np.diag(prior.unresolved(times)[:, component])
        # Five standard errors of a drawn covariance, sqrt(2 / draws), and a step's share in the sums.
        np.testing.assert_allclose(
            own / DRIFT[component] ** 2 / np.outer(size, size), expected / np.outer(size, size), atol=0.06
        )


def test_what_is_measured_walks_within_the_bounds_of_its_variance():
    prior = PathPrior(spline(), DriftKind(smooth=0.7, wandering=0.4, walk=0.2, turn_walk=0.2))
    found = covariance(prior, np.array([SECONDS / 4, SECONDS]))[:, 2, :, 2] / DRIFT[2] ** 2
    # A spline between knots of 1/100 of the path is a little stiffer than a walk.
    np.testing.assert_allclose(found, [[0.25, 0.25], [0.25, 1.0]], atol=0.01)


def test_closer_knots_follow_a_random_walk():
    kind = DriftKind(smooth=0.0, wandering=0.003, walk=0.1, turn_walk=0.1)
    times = np.linspace(9.5, 10.5, 200)
    even, closer = PathPrior(spline(), kind), PathPrior(spline(closer_s=np.linspace(9, 11, 50)), kind)
    assert closer.path.count < 2.5 * even.path.count
    # What is left of a walk grows with the distance of knots: 0.2 s, and 0.025 s.
    assert closer.unresolved(times)[:, 0].mean() < even.unresolved(times)[:, 0].mean() / 4


def test_a_heading_error_adds_to_a_dead_reckoned_position():
    prior = PathPrior(spline(), DriftKind(smooth=0.0, wandering=0.003, walk=1e-7, turn_walk=1e-7, by_heading=1.0))
    alone = PathPrior(spline(), DriftKind(smooth=0.0, wandering=0.003, walk=1e-7, turn_walk=1e-7))
    with_, without = (covariance(each, np.array([SECONDS]))[0, :, 0] for each in (prior, alone))
    # A heading that grows steadily to e shifts the end by e / 2 of the length of the path, to the side.
    aside = DRIFT[5] * SPEED_MM_S * SECONDS / 2
    np.testing.assert_allclose(with_[1, 1] - without[1, 1], aside**2, rtol=0.01)
    np.testing.assert_allclose(with_[1, 5], aside * DRIFT[5], rtol=0.01)
    np.testing.assert_allclose(with_[0], without[0], atol=1e-3)


def test_the_root_is_one_of_the_covariance():
    prior = PathPrior(spline(), DriftKind(smooth=0.3, wandering=0.1, walk=0.01, turn_walk=0.1, by_heading=1.0))
    count = 6 * prior.path.count
    root = prior.times_root(np.eye(count))
    np.testing.assert_allclose(prior.times_transposed_root(np.eye(count)), root.T, atol=1e-9)
    np.testing.assert_allclose(prior.covariance(np.eye(count)), root @ root.T, atol=1e-6)
    some = np.random.default_rng(1).standard_normal((count, 30))
    some[:300] = 0.0
    normal = some @ some.T
    expected = np.eye(count) + root.T @ normal @ root
    np.testing.assert_allclose(prior.with_evidence(normal), expected, rtol=1e-6, atol=1e-6 * expected.max())
