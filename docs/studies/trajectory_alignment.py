"""Alignment of paths that cross themselves: bounds for kinds of drift, and errors of simulated rides.

    python -m docs.studies.trajectory_alignment [--write]

The rides are those of `tests/uwlts/path_views.py`. Only the size of the drift is given to the alignment. On passes of
20 m, the crossings are closed at their true poses instead of searching for them, with fewer nodes.
"""

from itertools import product

import numpy as np
from cyclopts import App
from scipy.spatial import KDTree
from scipy.spatial.transform import Rotation

import uwlts
from docs.studies.result_tables import publish, table
from tests.uwlts.alignment.test_align import LOOP_MM
from tests.uwlts.path_views import ride
from uwlts.alignment.crossing_search import accept_hypothesis, add_overlaps
from uwlts.alignment.path_prior import DriftModel, PathPrior, choose_drift_model
from uwlts.alignment.path_solution import Hypothesis, initial_estimate, settle
from uwlts.alignment.pieces import AlignmentOptions, Survey, correct_places
from uwlts.storage.cloud import PointCloud

PASS_MM = np.array(
    [
        *((-400, 0), (3400, 0), (3400, 1600), (700, 1600), (700, -400), (2000, -400)),
        *((2000, 3400), (300, 3400), (300, 2300), (1700, 2300)),
    ],
    float,
)
"""Crosses itself at (700, 0), (2000, 0) and (2000, 1600)."""
SWATH_MM, LENGTH_MM = 140.0, 19_400.0
BESIDE = 6
"""Largest difference in pieces between pairs of the same crossing."""
LOOP_DRIFT, PASS_DRIFT = {"drift_mm": 60.0, "drift_deg": 0.3}, {"drift_mm": 300.0, "drift_deg": 1.0}
CROSSINGS = (0.057, 0.500), (0.124, 0.608), (0.351, 0.691)
"""Crossings of the pass, as fractions of its length."""
GRID, DRIFTS, EXACT = np.linspace(0.01, 1, 100), 200, 1e-7
"""Positions on the path as fractions of its length, number of drawn drifts, and variance of exact crossings.

The variance corresponds to 0.1 mm for a drift of 0.3 m.
"""
RIDE = {"rate": (1.2**3 - 0.7**3) / 1.5, "wave": 0.2}
"""Drift of `ride`: a rate of 0.7 to 1.2 times the drift, and a wave of a fifth of it."""
KINDS = {
    "steady rate": {"rate": 1.0},
    "wandering rate": {"wandering": 1.0},
    "random walk": {"walk": 1.0},
    "Gauss-Markov rate, correlation time 0.05 of the path": {"wandering": 1.0, "correlation": 0.05},
    "Gauss-Markov rate, correlation time 0.5": {"wandering": 1.0, "correlation": 0.5},
    "simulated rides: steady rate and a wave of a fifth": RIDE,
    "these with a random walk of 10 %": RIDE | {"walk": 0.1**2},
}
"""Kind of the drift: parts of its variance at the end, see `bounds`."""
LOOPS, PASSES, WALKS = (10, 11, 12), (40, 41, 42, 45, 46), (43, 44)
"""Seeds of rides of 4 m with one crossing, and of 20 m with three, without and with a random walk of a tenth."""


def main(*, write: bool = False) -> None:
    """Print the tables; with `--write`, put them into their page."""
    head = ["drift, of the variance at the end", "displacement", "rates", "size alone"]
    head += ["coordinates within twice the stated uncertainty", "error / stated, rms", f"worst of {DRIFTS}"]
    tables = {"drifts": table(head, [[name, *bounds(**kind)] for name, kind in KINDS.items()])}
    rows = []
    for name, seeds, walk in (("loop of 4 m", LOOPS, 0.0), ("20 m", PASSES, 0.0), ("20 m, random walk", WALKS, 0.1)):
        loop = seeds == LOOPS
        drift, found = (LOOP_DRIFT, aligned) if loop else (PASS_DRIFT, given_crossings)
        for seed in seeds:
            cloud, reported, true = ride(np.random.default_rng(seed), LOOP_MM if loop else PASS_MM, walk=walk, **drift)
            before, after, stated, within = found(cloud, reported, true, drift)
            cells = [f"{before:.1f}", f"{after:.1f}", f"{stated:.1f}", f"{before / after:.1f}", f"{100 * within:.0f} %"]
            rows.append([name, str(seed), *cells])
            print(*rows[-1], flush=True)
    head = ["ride", "seed", "path, mm", "after, mm", "stated, mm", "reduced by a factor of"]
    tables["rides"] = table([*head, "coordinates within twice the stated uncertainty"], rows)
    publish(tables, write=write)


def aligned(
    cloud: PointCloud, reported: uwlts.Trajectory, true: uwlts.Trajectory, drift: dict[str, float]
) -> tuple[float, float, float, float]:
    """Return the rms error of the path before and after, mm, the stated one, and the fraction within twice of it.

    The error of the first position, which no surface determines, is subtracted.
    """
    found = uwlts.align_trajectory(cloud, reported, **drift)
    off = [each.poses_at(true.times_s)[:, :3, 3] - true.poses[:, :3, 3] for each in (reported, found.trajectory)]
    before, after = (each - each[0] for each in off)
    covariance = found.trajectory.covariance_at(true.times_s)
    assert covariance is not None
    std = np.sqrt(np.einsum("nii->ni", covariance[:, :3, :3]))
    return _size(before), _size(after), _size(std), float(np.mean(np.abs(after) < 2 * std))


def given_crossings(
    cloud: PointCloud, reported: uwlts.Trajectory, true: uwlts.Trajectory, drift: dict[str, float]
) -> tuple[float, float, float, float]:
    """Return the figures of `aligned` with each crossing closed at its true pose, without a search.

    The few nodes cannot follow a random walk within a crossing.
    """
    assert cloud.time_s is not None
    options = AlignmentOptions(intervals=50, most_nodes=120)
    model = choose_drift_model(reported, drift.get("drift_mm"), drift.get("drift_deg"))
    prior = PathPrior.from_times(cloud.time_s, model, reported, intervals=options.intervals)
    survey = Survey.from_cloud(cloud, cloud.time_s, reported)
    estimate = initial_estimate(survey, prior, options)

    def correction(times_s: np.ndarray) -> np.ndarray:
        was, now = reported.poses_at(times_s), true.poses_at(times_s)
        turns = Rotation.from_matrix(now[:, :3, :3] @ was[:, :3, :3].transpose(0, 2, 1))
        return np.hstack([now[:, :3, 3] - was[:, :3, 3], turns.as_rotvec()])

    for pair in _true_pairs(
        [correct_places(correction(p.times_s), p.platform_mm, p.places_mm) for p in estimate.pieces]
    ):
        own = estimate.surface(pair[1]).places_mm
        middle = own.mean(axis=0)
        relative = estimate.relative_movement(pair, middle) @ correction(estimate.prior.nodes_s).T.ravel()
        std = survey.radius_mm * np.repeat([1.0, 1 / float(np.sqrt(np.mean(np.sum((own - middle) ** 2, axis=1))))], 3)
        closed = accept_hypothesis(estimate, Hypothesis(pair, middle, relative, std, len(own)))
        if closed is not None:
            estimate = add_overlaps(closed, pair[1] + 1)
    estimate = settle(add_overlaps(estimate, len(estimate.pieces)))
    off = reported.poses[:, :3, 3] - true.poses[:, :3, 3]
    left = off + estimate.corrections(reported.times_s)[:, :3]
    std = np.sqrt(np.einsum("nii->ni", estimate.covariance_at(reported.times_s))[:, :3])
    return _size(off), _size(left), _size(std), float(np.mean(np.abs(left) < 2 * std))


def _true_pairs(places: list[np.ndarray]) -> list[tuple[int, int]]:
    """Return the pair of pieces with the largest overlap at each crossing, in order of time."""
    trees = [KDTree(each) for each in places]
    overlaps = {
        (first, second): sum(map(bool, trees[first].query_ball_point(places[second], SWATH_MM / 20)))
        for second in range(len(places))
        for first in range(second - 3)
        if np.linalg.norm(places[first].mean(axis=0) - places[second].mean(axis=0)) < 1.5 * SWATH_MM
    }
    chosen: list[tuple[int, int]] = []
    for pair in sorted(overlaps, key=lambda pair: -overlaps[pair]):
        if overlaps[pair] > 0 and all(max(abs(pair[0] - a), abs(pair[1] - b)) > BESIDE for a, b in chosen):
            chosen.append(pair)
    return sorted(chosen, key=lambda pair: pair[1])


def bounds(
    *, rate: float = 0.0, wandering: float = 0.0, walk: float = 0.0, wave: float = 0.0, correlation: float = np.inf
) -> list[str]:
    """Return the factors that three exact crossings can reduce the rms error of a path by, and the coverage.

    The drift is a Gaussian process. Its variance at the end is the sum of ``rate`` (steady rate), ``wandering`` (rate
    with a random walk, or Gauss-Markov rate with a ``correlation`` time) and ``walk`` (random walk). ``wave`` is the
    amplitude of the wave of `ride`. The known displacement is that within each crossing, or at two positions of it,
    which also determines the rates. The linear Gaussian estimate with the true covariance has the smallest possible
    error. `align_trajectory` knows only the size of the drift: it uses its own model with the most likely random walk
    and correlation time.
    """
    found = []
    for apart in (0.0, SWATH_MM / LENGTH_MM):
        ends = [np.add(crossing, off) for crossing, off in product(CROSSINGS, (-apart / 2, apart / 2))]
        t = np.concatenate([GRID, np.ravel(ends)])
        first, second = np.minimum(t[:, None], t), np.maximum(t[:, None], t)
        true = rate * np.outer(t, t) + wandering * _wandered(first, second, correlation) + walk * first
        turns = 2 * np.pi * 0.8 * t
        true += wave**2 / 2 * (np.cos(turns[:, None] - turns) - np.cos(turns)[:, None] - np.cos(turns) + 1)
        seen = np.zeros((len(ends), len(t)))
        for row, values in enumerate(seen):
            values[len(GRID) + 2 * row : len(GRID) + 2 * row + 2] = -1, 1
        _, std, _ = _estimated(true, seen)
        found.append(float(np.sqrt(np.mean(np.diag(true)[: len(GRID)]) / np.mean(std**2))))
    models = [
        _estimated(model.covariance(t[:, None], t, 1.0)[0], seen) for model in DriftModel.of_size(1.0, 1.0).candidates()
    ]
    rng, root = np.random.default_rng(0), np.linalg.cholesky(true + EXACT * np.eye(len(t)))
    before, after, inside, sizes = [], [], [], []
    for _ in range(DRIFTS):
        drift = root @ rng.standard_normal((len(t), 6))
        gain, std, _ = max(models, key=lambda model: _twice_log_likelihood(seen @ drift, model[2]))
        off = gain @ (seen @ drift) - drift[: len(GRID)]
        before.append(drift[: len(GRID)])
        after.append(off)
        inside.append(np.abs(off) < 2 * std[:, None])
        sizes.append(_rms(off / std[:, None]))
    factors = ["exact" if value > 1000 else f"{value:.1f}" for value in found]
    size = f"{_rms(np.array(before)) / _rms(np.array(after)):.1f}"
    return [*factors, size, f"{100 * np.mean(inside):.0f} %", f"{_rms(sizes):.2f}", f"{max(sizes):.1f}"]


def _wandered(first: np.ndarray, second: np.ndarray, correlation: float) -> np.ndarray:
    """Return the covariance of the integral of a rate between times, relative to the variance at time 1.

    The rate has the covariance exp(-|t - u| / T) of a Gauss-Markov process, or that of a random walk for T = inf.
    """
    if np.isinf(correlation):
        return first**2 * (3 * second - first) / 2
    of_first, of_second, apart = (np.exp(-each / correlation) for each in (first, second, second - first))
    end = 2 / correlation + 2 * np.exp(-1 / correlation) - 2
    return (2 * first / correlation + of_first + of_second - 1 - apart) / end


def _estimated(covariance: np.ndarray, seen: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return gain (G, Q) and standard deviations (G,) of an estimate on the grid, and observation covariance (Q, Q)."""
    of_seen = seen @ covariance @ seen.T + EXACT * np.eye(len(seen))
    shared = covariance[: len(GRID)] @ seen.T
    gain = np.linalg.solve(of_seen, shared.T).T
    left = np.diag(covariance)[: len(GRID)] - np.sum(gain * shared, axis=1)
    return gain, np.sqrt(np.maximum(left, 0.0)), of_seen


def _twice_log_likelihood(values: np.ndarray, covariance: np.ndarray) -> float:
    """Return twice the log likelihood of columns (Q, K), without a constant."""
    root = np.linalg.cholesky(covariance)
    return float(-np.sum(np.linalg.solve(root, values) ** 2) - 2 * values.shape[1] * np.sum(np.log(np.diag(root))))


def _rms(values: list[float] | np.ndarray) -> float:
    return float(np.sqrt(np.mean(np.square(values))))


def _size(vectors: np.ndarray) -> float:
    """Root mean square size of vectors (N, 3)."""
    return _rms(np.linalg.norm(vectors, axis=1))


if __name__ == "__main__":
    App(help=__doc__, help_format="plaintext", default_command=main)()
