"""Prior of a path correction, compared with drifts simulated step by step."""

from collections.abc import Sequence

import numpy as np
import pytest

from uwlts.alignment.path_prior import DriftModel, PathPrior
from uwlts.model.trajectory import Trajectory

SECONDS, SPEED_MM_S = 20.0, 200.0
STD = np.array([30.0, 20.0, 10.0, 0.01, 0.01, 0.02])
WALK = np.array([0.2, 0.2, 1.0, 0.05, 0.05, 0.05])


def straight_path(towards: Sequence[float]) -> Trajectory:
    """Along a horizontal direction (2,)."""
    times = np.linspace(0, SECONDS, 81)
    poses = np.tile(np.eye(4), (len(times), 1, 1))
    poses[:, :2, 3] = SPEED_MM_S * times[:, None] * np.asarray(towards)
    return Trajectory(times, poses)


def prior_of(
    *,
    correlation: float = np.inf,
    smooth: bool = False,
    dead_reckoned: bool = False,
    towards: Sequence[float] = (0.6, 0.8),
) -> PathPrior:
    """With 81 even nodes."""
    drift = DriftModel(STD, WALK, correlation, smooth, dead_reckoned, True)
    return PathPrior.from_times(np.linspace(0, SECONDS, 41), drift, straight_path(towards), intervals=80)


def covariance(prior: PathPrior, times_s: np.ndarray) -> np.ndarray:
    """Return the covariance (6, N, 6, N) of the drift at times (N,)."""
    root = prior.times_root(np.eye(6 * prior.count)).reshape(6, prior.count, -1)
    at = np.einsum("nc,ick->ink", prior.basis(times_s), root)
    return np.einsum("ink,jmk->injm", at, at)


@pytest.mark.parametrize(("correlation", "smooth"), [(0.3, False), (0.3, True), (np.inf, False)])
def test_the_drift_has_the_covariance_of_drifts_drawn_step_by_step(correlation: float, smooth: bool):
    draws, steps = 20_000, 400
    rng = np.random.default_rng(4)
    t = np.arange(1, steps + 1) / steps
    walk = rng.standard_normal((draws, steps)).cumsum(axis=1) / np.sqrt(steps)
    apart = np.abs(t[:, None] - t) / correlation
    root = np.linalg.cholesky((1 + smooth * apart) * np.exp(-apart) + 1e-9 * np.eye(steps))
    drifted = (rng.standard_normal((draws, steps)) @ root.T).cumsum(axis=1) / steps
    drifted /= drifted[:, -1].std()
    rows = np.array([99, 199, 299, 399])
    found = covariance(prior_of(correlation=correlation, smooth=smooth), SECONDS * t[rows])
    for component in range(6):
        share = WALK[component]
        drawn = np.sqrt(1 - share) * drifted[:, rows] + np.sqrt(share) * walk[:, rows]
        expected = np.cov(drawn.T) * STD[component] ** 2
        size = np.sqrt(np.diag(expected))
        # Five standard errors of a drawn covariance, sqrt(2 / draws), and a step's share in the sums.
        np.testing.assert_allclose(
            found[component, :, component] / np.outer(size, size), expected / np.outer(size, size), atol=0.06
        )


def test_closer_nodes_keep_the_correction_and_are_no_more_than_wanted():
    even, times = prior_of(), np.linspace(0, SECONDS, 801)
    closer = even.with_nodes(np.linspace(9, 11, 200), 0.02, most=400)
    np.testing.assert_allclose(even.nodes_s, np.linspace(0, SECONDS, 81), atol=1e-9)
    inside = (closer.nodes_s > 9) & (closer.nodes_s < 11)
    np.testing.assert_allclose(np.diff(closer.nodes_s[inside]), 0.02, atol=1e-9)
    assert closer.count < even.count + 2 / 0.02 + 5
    assert (np.diff(closer.nodes_s) > 0.0199).all()
    np.testing.assert_allclose(closer.nodes_s[[0, -1]], [0, SECONDS])
    fewer = even.with_nodes(np.linspace(9, 11, 200), 0.02, most=60)
    assert fewer.count < even.count + 60
    # A steady drift is one before and after.
    steady = np.outer(STD, even.nodes_s / SECONDS).ravel()
    values = even.evaluate(steady, closer.nodes_s).T.ravel()
    np.testing.assert_allclose(closer.evaluate(values, times), even.evaluate(steady, times), atol=1e-9)
    by_basis = closer.basis(times) @ values.reshape(6, -1).T
    np.testing.assert_allclose(by_basis, closer.evaluate(values, times), atol=1e-9)


@pytest.mark.parametrize("heading_deg", [0.0, 53.13, 200.0])
def test_a_heading_error_adds_to_a_dead_reckoned_position(heading_deg: float):
    """A positive heading error rotates the travelled path to its left, seen against Z."""
    heading = np.radians(heading_deg)
    towards, left = np.array([np.cos(heading), np.sin(heading)]), np.array([-np.sin(heading), np.cos(heading)])
    at = np.array([SECONDS])
    with_, without = (
        covariance(prior_of(dead_reckoned=each, towards=tuple(towards)), at)[:, 0, :, 0] for each in (True, False)
    )
    # A heading error that grows linearly to e shifts the end sideways by e / 2 of the way, and a walk by e / sqrt(3).
    way = SPEED_MM_S * SECONDS
    aside = STD[5] ** 2 * way**2 * ((1 - WALK[5]) / 4 + WALK[5] / 3)
    np.testing.assert_allclose((with_ - without)[:2, :2], aside * np.outer(left, left), atol=0.01 * aside)
    # Covariance with the heading: one half of its variance, by either.
    both = STD[5] ** 2 * way / 2
    np.testing.assert_allclose(with_[:2, 5], both * left, atol=0.01 * both)
    np.testing.assert_allclose(with_[2:5, :5], without[2:5, :5], atol=1e-3)


@pytest.mark.parametrize("dead_reckoned", [False, True])
def test_the_root_is_one_of_the_covariance(dead_reckoned: bool):
    even = prior_of(correlation=0.3, dead_reckoned=dead_reckoned)
    prior = even.with_nodes(np.linspace(9, 11, 200), 0.1, most=400)
    count = 6 * prior.count
    root = prior.times_root(np.eye(count))
    np.testing.assert_allclose(prior.times_transposed_root(np.eye(count)), root.T, atol=1e-9)
    # Observations of the dense nodes only, as in crossings.
    some = np.random.default_rng(1).standard_normal((6, prior.count, 30))
    some[:, (prior.nodes_s < 9) | (prior.nodes_s > 11)] = 0
    some = some.reshape(count, -1)
    normal = some @ some.T
    expected = np.eye(count) + root.T @ normal @ root
    factor = prior.factor(normal)
    np.testing.assert_allclose(factor @ factor.T, expected, rtol=1e-6, atol=1e-6 * expected.max())


@pytest.mark.parametrize("dead_reckoned", [False, True])
def test_observations_between_some_nodes_add_to_the_prior(dead_reckoned: bool):
    even = prior_of(dead_reckoned=dead_reckoned)
    prior = even.with_nodes(np.concatenate([np.linspace(4, 5, 50), np.linspace(14, 15, 50)]), 0.1, most=400)
    times, rng = np.append(np.linspace(4, 5, 30), np.linspace(14, 15, 30)), np.random.default_rng(3)
    by = np.einsum("qi,qc->qic", rng.standard_normal((60, 6)) / STD, prior.basis(times)).reshape(60, -1)
    normal = by.T @ by
    factor = prior.factor(normal)
    root = prior.times_root(np.eye(6 * prior.count))
    np.testing.assert_allclose(factor, np.tril(factor))
    np.testing.assert_allclose(factor @ factor.T, np.eye(len(root)) + root.T @ normal @ root, atol=1e-9)
