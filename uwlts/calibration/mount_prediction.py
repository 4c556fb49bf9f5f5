"""How well poses of a mount calibration predict each other, and how wide its intervals are."""

import numpy as np
from scipy.stats import chi2, t

from uwlts.calibration.mount_model import MountState, Problem, Scatter, sizes_of

_LEAST_SPAN = 1e-6
"""Of the largest thing that a pose's errors do to its profile: less counts as nothing."""


def misfits(problem: Problem, state: MountState) -> np.ndarray:
    """Root mean square distance (P,) of the points of each pose."""
    squares = problem.distances(state) ** 2
    return np.sqrt(np.bincount(problem.poses, squares) / problem.counts)


def held_out_mm(problem: Problem, state: MountState, scatter: Scatter, information: np.ndarray) -> np.ndarray:
    """Root mean square distance (P,) of each pose's points from the artefact by the mount of all other poses."""
    left_out = _each_left_out(problem, state, scatter, information)
    return np.array([misfits(problem, problem.stepped(state, step))[n] for n, (step, _) in enumerate(left_out)])


def left_out_excess(problem: Problem, state: MountState, scatter: Scatter, *, probability: float) -> np.ndarray:
    """How far each pose lies from what the others predict (P,), in units of what it exceeds with a probability.

    Squares are chi-square with as many degrees of freedom as a profile determines numbers.
    """
    share = problem.noise_along(state)
    derivatives, errors = problem.derivatives(state) / share, problem.errors(state) / share
    split = np.cumsum(problem.counts)[:-1]
    excess = []
    left_out = _each_left_out(problem, state, scatter, problem.information(state, scatter))
    moved = [np.split(problem.distances(state, step) / share[:, 0], split)[n] for n, (step, _) in enumerate(left_out)]
    sizes = sizes_of(errors.shape[1], scatter)
    for off, rows, error, (_, covariance) in zip(
        moved, np.split(derivatives, split), np.split(errors, split), left_out, strict=True
    ):
        # All that poses, mount and artefact can do lies in what the errors of the pose span.
        basis, spans, _ = np.linalg.svd(error / np.linalg.norm(error, axis=0).clip(1e-30), full_matrices=False)
        basis = basis[:, spans > _LEAST_SPAN * spans[0]]
        across, by_pose = basis.T @ rows, basis.T @ (error * sizes)
        spread = across @ covariance @ across.T + by_pose @ by_pose.T + scatter.point_mm**2 * np.eye(basis.shape[1])
        seen = basis.T @ off
        excess.append(float(seen @ np.linalg.solve(spread, seen) / chi2.isf(probability, len(seen))))
    return np.array(excess)


def coverage_factor(
    problem: Problem, state: MountState, scatter: Scatter, own: np.ndarray, covariance: np.ndarray
) -> float:
    """Student's factor for 95 %, with degrees of freedom by Welch and Satterthwaite (GUM, G.4).

    The shares of the variances that the points' noise and the sensor's calibration make are known from very many
    points, the rest from the poses. ``own`` is the covariance without the calibration.
    """
    by_points = inverse(problem.information(state, Scatter(scatter.point_mm, 0.0)).sum(axis=0))
    total, by_poses = np.diag(covariance)[:6], np.maximum(np.diag(own - problem.of_all(by_points))[:6], 0.0)
    share = 1 - float(np.mean(by_poses[total > 0] / total[total > 0]))
    of_poses = max(problem.numbers - problem.size, 1)
    of_points = max(int(problem.counts.sum()) - problem.numbers, 1)
    return float(t.ppf(0.975, 1 / (share**2 / of_points + (1 - share) ** 2 / of_poses)))


def inverse(information: np.ndarray) -> np.ndarray:
    """Covariance of an information matrix; directions without information get huge variances."""
    size = 1 / np.sqrt(np.maximum(np.diag(information), 1e-30))
    values, vectors = np.linalg.eigh(size[:, None] * information * size)
    return size[:, None] * (vectors / np.maximum(values, 1e-13)) @ vectors.T * size


def _each_left_out(
    problem: Problem, state: MountState, scatter: Scatter, information: np.ndarray
) -> list[tuple[np.ndarray, np.ndarray]]:
    """For every pose the step of the parameters without it (a Gauss-Newton step), and their covariance then."""
    whitened = problem.whitening(state, scatter)
    split = np.cumsum(problem.counts)[:-1]
    rows = np.split(whitened(problem.derivatives(state)), split)
    distances = np.split(whitened(problem.distances(state)), split)
    total, steps = information.sum(axis=0), []
    gradient = sum(row.T @ own for row, own in zip(rows, distances, strict=True))
    for row, own, one in zip(rows, distances, information, strict=True):
        covariance = inverse(total - one)
        steps.append((-covariance @ (gradient - row.T @ own), covariance))
    return steps
