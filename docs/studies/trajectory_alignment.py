"""Alignment of a pass of 20 m with three crossings: errors of the path and of lengths.

    python -m docs.studies.trajectory_alignment --seeds 0 1 2
    python -m docs.studies.trajectory_alignment --seeds 0 1 2 --navigation

The vehicle and the sea bed are those of `tests/uwlts/path_views.py`, with a drift of 0.3 m and 1 deg. Only the size of
the drift is given to the alignment. ``--walk`` adds a random walk, a multiple of the drift; ``--loop`` uses 4 m with
one crossing. With ``--navigation``, vehicle, sea and navigation are those of `scenes/vehicle-pass.toml`, and the
navigation states its covariance. ``--crossings-given`` closes the crossings at their true poses instead of searching
for them, with fewer nodes. First it prints the factors (`bounds`) that three exact crossings can
reduce the path error by, for several kinds of drift.
"""

import argparse
import tomllib
from itertools import product
from pathlib import Path

import numpy as np
from scipy.spatial import KDTree
from scipy.spatial.transform import Rotation

import uwlts
from tests.uwlts.alignment.test_align import LOOP_MM
from tests.uwlts.path_views import ALTITUDE_MM, STEP_MM, bed, ride, scan
from twin.scene.platform_kinds import Vehicle
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
INSIDE_MM, PAIRS = 60.0, 20_000
"""Largest distance of the points of a crossing from its middle, and number of lengths drawn there."""
NEAR = 200
"""Images of one pass at a crossing, half a metre."""
BESIDE = 6
"""Largest difference in pieces between pairs of the same crossing."""
LOOP_DRIFT = {"drift_mm": 60.0, "drift_deg": 0.3}
CROSSINGS = (0.057, 0.500), (0.124, 0.608), (0.351, 0.691)
"""Crossings of the pass, as fractions of its length."""
GRID, DRIFTS, EXACT = np.linspace(0.01, 1, 100), 200, 1e-7
"""Positions on the path as fractions of its length, number of drawn drifts, and variance of exact crossings.

The variance corresponds to 0.1 mm for a drift of 0.3 m.
"""
KINDS = {
    "steady rate": {"rate": 1.0},
    "steady rate 50 %, wandering rate 50 %": {"rate": 0.5, "wandering": 0.5},
    "wandering rate": {"wandering": 1.0},
    "steady rate 95 %, random walk 5 %": {"rate": 0.95, "walk": 0.05},
    "steady rate 50 %, random walk 50 %": {"rate": 0.5, "walk": 0.5},
    "random walk": {"walk": 1.0},
    "Gauss-Markov rate, correlation time 0.05 of the path": {"wandering": 1.0, "correlation": 0.05},
    "Gauss-Markov rate, correlation time 0.5 of the path": {"wandering": 1.0, "correlation": 0.5},
    "half steady rate, half Gauss-Markov rate of 0.2": {"rate": 0.5, "wandering": 0.5, "correlation": 0.2},
}
RIDE = {"rate": (1.2**3 - 0.7**3) / 1.5, "wave": 0.2}
"""Drift of `ride`: a rate of 0.7 to 1.2 times the drift, and a wave of a fifth of it."""


def main() -> None:
    parser = argparse.ArgumentParser()
    parser.add_argument("--seeds", type=int, nargs="*", default=[0, 1, 2])
    parser.add_argument("--drift-mm", type=float, default=300.0)
    parser.add_argument("--drift-deg", type=float, default=1.0)
    parser.add_argument("--walk", type=float, default=0.0)
    parser.add_argument("--loop", action="store_true")
    parser.add_argument("--navigation", action="store_true")
    parser.add_argument("--crossings-given", action="store_true")
    given = parser.parse_args()
    for words, kind in KINDS.items():
        print(f"{words}: {bounds(**kind)}", flush=True)
    print(f"drift of these rides: {bounds(**RIDE | {'walk': given.walk**2})}", flush=True)
    drift = LOOP_DRIFT if given.loop else {"drift_mm": given.drift_mm, "drift_deg": given.drift_deg}
    for seed in given.seeds:
        if given.navigation:
            print(f"seed {seed}: {errors(*vehicle_ride(seed), {})}", flush=True)
        else:
            route = LOOP_MM if given.loop else PASS_MM
            cloud, reported, true = ride(np.random.default_rng(seed), route, walk=given.walk, **drift)
            found = given_crossings if given.crossings_given else errors
            print(f"seed {seed}: {found(cloud, reported, true, true.poses, drift)}", flush=True)


def vehicle_ride(seed: int) -> tuple[PointCloud, uwlts.Trajectory, uwlts.Trajectory, np.ndarray]:
    """Return the cloud along the reported path, the reported and true paths, and the true sensor poses (F, 4, 4)."""
    scene = tomllib.loads((Path(__file__).parents[2] / "scenes/vehicle-pass.toml").read_text())
    described = scene["motion"] | {"errors_seed": seed, "true_mount": scene["motion"]["mount"]}
    vehicle = Vehicle.model_validate(described)
    course, mount = vehicle.course(), vehicle.mount.matrix()
    times = np.array([shot.time_s for shot in course.shots], float)
    sensor, clock = course.poses(times), times + vehicle.clock_offset_s
    assert course.report is not None
    reported = uwlts.Trajectory(*course.report)
    floor, stones = sensor[:, 2, 3].mean() + ALTITUDE_MM, bed(5000.0)
    # Z of the scene points down, and the bed begins at -0.5 m.
    frame, line, local = scan(np.random.default_rng(seed), sensor, lambda x, y: floor - stones.ev(x + 200, y + 200))
    cloud = PointCloud(
        _placed(reported.poses_at(clock) @ mount, frame, local), np.ones(len(frame)), frame, line, time_s=clock[frame]
    )
    return cloud, reported, uwlts.Trajectory(clock, sensor @ np.linalg.inv(mount)), sensor


def errors(
    cloud: PointCloud, reported: uwlts.Trajectory, true: uwlts.Trajectory, sensor: np.ndarray, drift: dict[str, float]
) -> str:
    """Return, as text, errors of the path and of lengths between the passes of each crossing, before and after.

    The error of the first position, which no surface determines, is subtracted from those of the path.
    """
    try:
        found = uwlts.align_trajectory(cloud, reported, **drift)
    except uwlts.Error as error:
        return str(error)
    before, after = (each.poses_at(true.times_s) for each in (reported, found.trajectory))
    assert cloud.frame is not None
    mount = np.linalg.inv(true.poses[0]) @ sensor[0]
    local = _placed(np.linalg.inv(before @ mount), cloud.frame, cloud.points_mm)
    truth, crossings = _placed(sensor, cloud.frame, local), _crossings(sensor[:, :2, 3])
    last = max(second for _, second in crossings)
    off = [each[:, :3, 3] - true.poses[:, :3, 3] for each in (before, after)]
    own_before, own = (each - each[0] for each in off)
    covariance = found.trajectory.covariance_at(true.times_s)
    assert covariance is not None
    std = np.sqrt(np.einsum("nii->ni", covariance[:, :3, :3]))
    lengths = [
        _length_error(points, truth, cloud.frame, sensor[:, :2, 3], each)
        for points in (cloud.points_mm, found.cloud.points_mm)
        for each in crossings
    ]
    count = len(crossings)
    return (
        f"path {_size(own_before):.1f} -> {_size(own):.2f} mm (rms), {_size(own_before) / _size(own):.1f} times, "
        f"{_size(std):.1f} mm stated, {100 * np.mean(np.abs(own) < 2 * std):.0f} % of coordinates within twice it; "
        f"to the last crossing {_size(own[:last]):.2f} mm, behind it {_size(own[last:]):.1f} mm; lengths between both "
        f"passes {_rms(lengths[:count]):.1f} -> {_rms(lengths[count:]):.3f} mm of {count} crossings, "
        f"{len(found.doubtful_s)} left out"
    )


def given_crossings(
    cloud: PointCloud, reported: uwlts.Trajectory, true: uwlts.Trajectory, sensor: np.ndarray, drift: dict[str, float]
) -> str:
    """Return, as text, errors of the path with each crossing closed at its true pose, without a search.

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
    return (
        f"path {_size(off):.1f} -> {_size(left):.2f} mm (rms), {_size(off) / _size(left):.1f} times, "
        f"{_size(std):.1f} mm stated, {100 * np.mean(np.abs(left) < 2 * std):.0f} % of coordinates within twice it; "
        f"{len(estimate.pairs)} pairs of pieces"
    )


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
) -> str:
    """Return, as text, the factors that three exact crossings can reduce the rms error of a path by.

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
    return (
        f"at best {min(found[0], 1000):.1f} times, {min(found[1], 1000):.1f} with the rates within crossings; by the "
        f"model of a drift of known size {_rms(np.array(before)) / _rms(np.array(after)):.1f} times, "
        f"{100 * np.mean(inside):.0f} % within twice what is stated; errors of one drift are {_rms(sizes):.2f} times "
        f"those stated (rms), {max(sizes):.1f} times in the worst of {DRIFTS}"
    )


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


def _placed(poses: np.ndarray, frame: np.ndarray, points: np.ndarray) -> np.ndarray:
    """Points (N, 3) moved by the poses (F, 4, 4) of their frames (N,)."""
    return np.einsum("nij,nj->ni", poses[frame, :3, :3], points) + poses[frame, :3, 3]


def _crossings(places: np.ndarray) -> list[tuple[int, int]]:
    """Numbers of the images of both passes of each crossing of a path (N, 2)."""
    pairs = KDTree(places).query_pairs(2 * STEP_MM, output_type="ndarray")
    pairs = pairs[pairs[:, 1] - pairs[:, 0] > NEAR]
    pairs = pairs[np.argsort(pairs[:, 1])]
    parts = np.split(pairs, 1 + np.flatnonzero(np.diff(pairs[:, 1]) > NEAR))
    return [(int(first), int(second)) for first, second in (np.median(part, axis=0) for part in parts)]


def _length_error(
    points: np.ndarray, truth: np.ndarray, frame: np.ndarray, places: np.ndarray, crossing: tuple[int, int]
) -> float:
    """Return the rms error of lengths between points of both passes of a crossing, mm."""
    near = np.linalg.norm(truth[:, :2] - places[list(crossing)].mean(axis=0), axis=1) < INSIDE_MM
    rng = np.random.default_rng(0)
    ends = [rng.choice(np.flatnonzero(near & (np.abs(frame - number) < NEAR)), PAIRS) for number in crossing]
    lengths = [np.linalg.norm(each[ends[0]] - each[ends[1]], axis=1) for each in (points, truth)]
    return _rms(lengths[0] - lengths[1])


if __name__ == "__main__":
    main()
