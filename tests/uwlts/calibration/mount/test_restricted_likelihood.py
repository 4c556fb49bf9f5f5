"""Least squares with variance components: steps that oscillate, and estimates that cannot settle."""

from dataclasses import dataclass, replace

import numpy as np
import pytest
from scipy.optimize import brentq
from scipy.stats import f, norm, t

from tests.uwlts.mount_views import MOUNT, RADIUS_MM, SPHERE_MM, sphere_campaign
from uwlts.calibration.mount.profile_evidence import MountState, PlaneShape, Problem, SphereShape
from uwlts.calibration.mount.restricted_likelihood import NotSettled, settle, settle_agreeing


def profiles_of(kind: str) -> tuple[Problem, MountState]:
    """Return points near a sphere of unknown radius or a plane, with the true state, and a robot of unknown scale."""
    rng = np.random.default_rng(3)
    campaign = sphere_campaign(rng, poses=4, plane_only=kind == "plane")
    campaign.poses[:, :3, 3] += rng.normal(0, 0.05, (4, 3))
    points, height = [], SPHERE_MM[2] - 1.1 * RADIUS_MM
    for profile, pose in zip(campaign.profiles, campaign.poses, strict=True):
        seen = np.column_stack([profile[:, 0], np.zeros(len(profile)), profile[:, 1]])
        base = (seen @ MOUNT[:3, :3].T + MOUNT[:3, 3]) @ pose[:3, :3].T + pose[:3, 3]
        off = base[:, 2] - height if kind == "plane" else np.linalg.norm(base - SPHERE_MM, axis=1) - RADIUS_MM
        points.append(seen[np.abs(off) < 1])
    artefact = np.array([0.0, 0.0, 1.0, height]) if kind == "plane" else np.append(SPHERE_MM, RADIUS_MM)

    def motion(offset_s: float) -> tuple[np.ndarray, np.ndarray]:
        return campaign.poses[:, :3, :3], campaign.poses[:, :3, 3] + offset_s * np.array([3.0, 5.0, -2.0])

    problem = Problem(
        points,
        motion,
        np.array([0.0, 1.0, 0.0]),
        PlaneShape() if kind == "plane" else SphereShape(),
        scale=True,
        time=True,
    )
    return problem, MountState(MOUNT[:3, :3], MOUNT[:3, 3], artefact)


@pytest.mark.parametrize("kind", ["sphere", "plane"])
def test_variances_of_profiles_change_by_their_derivatives(kind: str):
    problem, state = profiles_of(kind)
    covariances = problem.covariance(state)
    logs = np.log([0.03, 0.07, 6.0, 0.05, 3e-4])
    total, changes = covariances(logs)
    for number, change in enumerate(changes):
        step = 1e-4 * np.eye(5)[number]
        expected = (covariances(logs + step)[0] - covariances(logs - step)[0]) / 2e-4
        np.testing.assert_allclose(change, expected, atol=1e-6 * total.max())
    # Each component doubles its standard deviation's square four times.
    for number in (0, 1, 3, 4):
        more = covariances(logs + np.log(2) * np.eye(5)[number])[0]
        np.testing.assert_allclose(more - total, 1.5 * changes[number], atol=1e-6 * total.max())


@pytest.mark.parametrize("turned_rad", [0.0, 0.3])
@pytest.mark.parametrize("kind", ["sphere", "plane"])
def test_distances_of_profiles_change_by_their_derivatives(kind: str, turned_rad: float):
    """At the state, and after a step that turns the mount."""
    problem, state = profiles_of(kind)
    here = np.zeros(problem.size)
    here[3:6] = turned_rad * np.array([0.6, -0.48, 0.64])
    by = problem.jacobian(state, here if turned_rad else None)
    assert by.shape[2] == problem.size == 6 + (4 if kind == "sphere" else 3) + 2
    sizes = np.array([*[0.01] * 3, *[1e-4] * 3, *[0.01 if kind == "sphere" else 1e-4] * 2, 0.01, 0.01, 1e-5, 1e-3])
    for number, size in enumerate(sizes[: problem.size]):
        step = size * np.eye(problem.size)[number]
        expected = (problem.residuals(state, here + step) - problem.residuals(state, here - step)) / (2 * size)
        np.testing.assert_allclose(by[:, :, number], expected, atol=1e-4 * np.abs(expected).max())


@dataclass(frozen=True)
class TwoReadings:
    """Two readings of one number, at -1 and at 1; the first has a weight that depends on the number itself.

    For the weight ``share``, the solution is 1 - 2 share.
    """

    slope: float

    size = 1

    def bounds(self):
        return np.array([(1.0, 1.0)])

    def apply_step(self, state, step):
        return state + float(step[0])

    def residuals(self, state, step=None):
        return np.array([[state + 1.0], [state - 1.0]]) + (0.0 if step is None else step[0])

    def jacobian(self, state, step=None):
        return np.ones((2, 1, 1))

    def covariance(self, state):
        share = np.clip(0.5 + self.slope * (state - 0.3), 0.05, 0.95)
        both = np.array([1 / share, 1 / (1 - share)]).reshape(2, 1, 1)
        return lambda logs: (both, np.zeros((1, 2, 1, 1)))

    def pool_repeats(self, state):
        return 0, 0.0

    def pose_directions(self, state):
        return [np.eye(1)] * 2


def test_steps_that_overshoot_are_damped():
    """The map x -> 1 - 2 share(x) has the slope -3: undamped it flips between two states; it is fixed at 0.225."""
    found = settle(TwoReadings(slope=1.5), [(-0.9, np.ones(1))])
    assert found.state == pytest.approx(0.225, abs=0.01)


def test_an_estimate_that_cannot_settle_is_an_error():
    """A weight that jumps where the number crosses 0.3 leaves no state that is its own solution."""
    with pytest.raises(
        NotSettled, match=r"does not converge: after \d+ rounds it still changes by .* Record more poses"
    ):
        settle(TwoReadings(slope=1e6), [(-0.9, np.ones(1)), (0.9, np.ones(1))])


@dataclass(frozen=True)
class Readings:
    """Readings of one number with a common unknown scatter, which repeats of another number share."""

    read: np.ndarray
    repeats: int
    squares: float

    size = 1

    def select(self, kept):
        return replace(self, read=self.read[kept])

    def pose_directions(self, state):
        return [np.eye(1)] * len(self.read)

    def bounds(self):
        return np.array([(1e-3, 1e3)])

    def apply_step(self, state, step):
        return state + float(step[0])

    def residuals(self, state, step=None):
        return state - self.read[:, None] + (0.0 if step is None else step[0])

    def jacobian(self, state, step=None):
        return np.ones((len(self.read), 1, 1))

    def covariance(self, state):
        every = np.ones((len(self.read), 1, 1))
        return lambda logs: (np.exp(2 * logs[0]) * every, 2 * np.exp(2 * logs[:, None, None, None]) * every[None])

    def pool_repeats(self, state):
        return self.repeats, self.squares


@pytest.mark.parametrize(("beyond", "rejected"), [(0.98, []), (1.02, [7])])
def test_one_of_a_thousand_sets_of_equal_readings_loses_one(beyond, rejected):
    """A reading's distance from the mean of n - 1 others has the variance s^2 n / (n - 1), and n may be rejected."""
    count = 40
    read = norm.ppf((np.arange(count) + 0.5) / count)
    read = np.random.default_rng(2).permutation(read)

    def squared_distance(value: float) -> float:
        every = np.append(np.delete(read, 7), value)
        return (value - every[:-1].mean()) ** 2 / (every.var(ddof=1) * count / (count - 1))

    limit = f.isf(1e-3 / count, 1, count - 1)
    read[7] = brentq(lambda value: squared_distance(value) - beyond * limit, 2.0, 1e3)
    _, kept = settle_agreeing(Readings(read, 0, 0.0), [(0.0, np.ones(1))], require=lambda kept: None)
    assert np.flatnonzero(~kept).tolist() == rejected


@pytest.mark.parametrize("repeats", [0, 4])
def test_a_mean_has_students_factor_and_the_pooled_scatter(repeats: int):
    """Six readings leave five degrees of freedom, and repeats add theirs (GUM, H.5: pooled variances)."""
    read, squares = np.array([1.2, 0.7, 1.9, 1.1, 0.4, 1.3]), 0.9 * repeats
    found = settle(Readings(read, repeats, squares), [(0.0, np.ones(1))])
    assert found.state == pytest.approx(read.mean(), abs=1e-6)
    pooled = (np.sum((read - read.mean()) ** 2) + squares) / (5 + repeats)
    assert found.scatter[0] == pytest.approx(np.sqrt(pooled), rel=1e-4)
    factor = found.coverage_factor(np.ones(1), np.ones((1, 1)))
    assert factor == pytest.approx(t.ppf(0.975, 5 + repeats), rel=1e-6)
