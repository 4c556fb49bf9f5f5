"""Joint solution of poses and pattern amplitudes against NumPy's least squares with the prior as further rows."""

import numpy as np
import pytest

from uwlts.fitting.patches import surface_patches
from uwlts.registration.joint_registration import JointRegistration, PairEvidence
from uwlts.registration.marker_spheres import MarkerSphere
from uwlts.registration.register import _compute_closure_rms
from uwlts.storage.cloud import PointUncertainty

OWN = 1e-4  # variance of an amplitude that no other scan shares


def joint_of(
    scans: int, *, patterns: int = 0, start_std: tuple[float, float] | None = None, shared: bool = False
) -> JointRegistration:
    """Return planes of 20 mm in one frame, with ``patterns`` patterns each."""
    rng = np.random.default_rng(1)
    flat = np.column_stack([rng.uniform(-10, 10, (800, 2)), np.full(800, 300.0)])
    known = PointUncertainty(np.full((800, 6), 1e-4), np.zeros((800, 3)), rng.normal(size=(patterns, 800, 3)))
    patches = [surface_patches(flat, known, radius_mm=4.0)] * scans
    parts = [{"sensor": np.eye(patterns)} if shared else {}] * scans
    poses = np.tile(np.eye(4), (scans, 1, 1))
    return JointRegistration(patches, [[]] * scans, poses, start_std=start_std, sphere_mm=None, shared=parts)


def evidence(
    seed: int, unknown: int, poses: int, *, columns: np.ndarray | None = None, count: int = 40
) -> PairEvidence:
    """Return distances with random derivatives by the chosen columns (default: all), weights and residuals."""
    rng = np.random.default_rng(seed)
    derivatives = np.zeros((count, unknown))
    columns = np.arange(unknown) if columns is None else columns
    derivatives[:, columns] = rng.normal(size=(count, len(columns)))
    weights = rng.uniform(0.5, 2.0, count)
    weights[0] = 0.0
    known = rng.normal(size=count), weights, rng.uniform(0.05, 0.2, count)
    return PairEvidence(derivatives, *known, 1.0, np.zeros((poses, poses)), (), np.zeros((count, 3)), count)


def rows_of(pairs: list[PairEvidence]) -> tuple[np.ndarray, np.ndarray]:
    roots = [np.sqrt(pair.weights) for pair in pairs]
    design = np.vstack([root[:, None] * pair.derivatives for root, pair in zip(roots, pairs, strict=True)])
    return design, np.concatenate([root * pair.residuals for root, pair in zip(roots, pairs, strict=True)])


@pytest.mark.parametrize("shared", [False, True])
@pytest.mark.parametrize("start_std", [None, (0.3, 0.02)])
def test_the_step_is_that_of_least_squares(start_std: tuple[float, float] | None, shared: bool) -> None:
    """After a first step, the priors pull back to no amplitudes and, if their uncertainty is known, to the start."""
    joint = joint_of(2, patterns=2, start_std=start_std, shared=shared)
    unknown = 6 + 4
    first = np.append(np.random.default_rng(2).normal(size=6) * [0.1, 0.1, 0.1, 1e-3, 1e-3, 1e-3], [0.5, -1, 2, 0.2])
    joint.move(first)
    pairs = [evidence(3, unknown, 6), evidence(4, unknown, 6)]
    design, values = rows_of(pairs)
    prior = (1 + OWN) * np.eye(4)
    if shared:
        prior[:2, 2:] = prior[2:, :2] = np.eye(2)
    root = np.linalg.cholesky(np.linalg.inv(prior)).T
    design = np.vstack([design, np.hstack([np.zeros((4, 6)), root])])
    values = np.append(values, root @ first[6:])
    if start_std is not None:
        std = np.repeat(start_std, 3)
        design = np.vstack([design, np.hstack([np.diag(1 / std), np.zeros((6, 4))])])
        values = np.append(values, first[:6] / std)
    found = joint.solve(pairs)
    # Turns of 1e-3 rad in another order differ by 1e-6.
    np.testing.assert_allclose(found.step, -np.linalg.lstsq(design, values)[0], atol=1e-5)
    # With a unit variance of the weighted distances, the covariance is the inverse of the normal matrix.
    information = pairs[0].normal() + pairs[1].normal()
    covariance = found.response @ information @ found.response.T + found.by_prior
    np.testing.assert_allclose(covariance, np.linalg.inv(design.T @ design), atol=1e-9)


def test_an_undetermined_direction_returns_to_the_start() -> None:
    """No distance changes with the shift along y: it is named, and goes back to where it was."""
    joint = joint_of(2)
    joint.move(np.array([0.1, 0.4, -0.2, 0.0, 0.0, 0.0]))
    pairs = [evidence(5, 6, 6, columns=np.array([0, 2, 3, 4, 5]))]
    found = joint.solve(pairs)
    assert found.step[1] == pytest.approx(-0.4)
    ((direction),) = found.open_directions
    np.testing.assert_allclose(np.abs(direction), [0, 1, 0, 0, 0, 0], atol=1e-6)
    design, values = rows_of(pairs)
    np.testing.assert_allclose(found.step[[0, 2, 3, 4, 5]], -np.linalg.lstsq(design[:, [0, 2, 3, 4, 5]], values)[0])


def test_the_closure_of_a_pair_is_what_the_others_leave() -> None:
    """Three scans: the distances between two, at the poses by the other overlaps, without their noise."""
    joint = joint_of(3)
    second, third = np.arange(6), np.arange(6, 12)
    pairs = {
        (0, 1): evidence(6, 12, 12, columns=second),
        (1, 2): evidence(7, 12, 12),
        (0, 2): evidence(8, 12, 12, columns=third),
    }
    solution = joint.solve(list(pairs.values()))
    design, values = rows_of([pairs[0, 1], pairs[1, 2]])
    step, pair = -np.linalg.lstsq(design, values)[0], pairs[0, 2]
    left = (pair.residuals + pair.derivatives @ step)[1:]
    expected = np.sqrt(np.mean(left**2) - np.mean(pair.std[1:] ** 2))
    assert _compute_closure_rms(joint, (0, 2), pairs, solution) == pytest.approx(expected)
    # Without the overlap of the last two, nothing determines the third.
    assert _compute_closure_rms(joint, (0, 2), {(0, 1): pairs[0, 1], (0, 2): pair}, solution) is None
    assert _compute_closure_rms(joint, (0, 2), {(0, 2): pair}, solution) is None


def test_common_spheres_are_observed_as_their_centres_differ() -> None:
    """Whitened differences of centres, and their changes by small motions and amplitudes of both scans."""
    joint = joint_of(3, patterns=1)
    rng, markers = np.random.default_rng(9), []
    for _ in range(3):
        root = 0.1 * np.eye(3) + 0.02 * rng.normal(size=(3, 3))
        markers.append([MarkerSphere(np.array([30.0, 5.0, 280.0]), root @ root.T, 0.1 * rng.normal(size=(1, 3)))])
    joint.markers, joint.sphere_mm = markers, 20.0
    joint.move(np.append(rng.normal(size=12) * np.tile(np.repeat([0.1, 0.01], 3), 2), rng.normal(size=3)))
    pairs = joint.collect_evidence({})
    assert set(pairs) == {(0, 1), (0, 2), (1, 2)}
    pair, centres, roots = pairs[1, 2], [], []
    for number in (1, 2):
        pose, own = joint.poses[number], markers[number][0]
        centres.append(pose[:3, :3] @ (own.centre_mm + joint.patterns[number] @ own.patterns_mm) + pose[:3, 3])
        roots.append(pose[:3, :3] @ own.covariance @ pose[:3, :3].T)
    off = centres[0] - centres[1]
    assert pair.residuals @ pair.residuals == pytest.approx(off @ np.linalg.solve(roots[0] + roots[1], off))
    # Three views give three pairs, but two independent differences.
    np.testing.assert_allclose(pair.weights, 2 / 3)
    assert (pair.patches, pair.spheres) == (0, 1)
    for seed in range(3):
        # Turns of 1e-8 rad also turn the covariances, which changes residuals by as much.
        step = 1e-6 * np.random.default_rng(seed).normal(size=15)
        step[[3, 4, 5, 9, 10, 11]] *= 0.01
        before, change = pair.residuals, pair.derivatives @ step
        joint.move(step)
        after = joint.collect_evidence({})[1, 2].residuals
        joint.move(-step)
        np.testing.assert_allclose(after - before, change, atol=1e-7)
        assert np.abs(change).max() > 3e-6
