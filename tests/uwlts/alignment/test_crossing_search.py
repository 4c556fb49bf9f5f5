"""Search for a crossing, and the path by it, on two short passes in any direction with a known drift."""

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest

from uwlts.alignment.align import _make_crossing
from uwlts.alignment.crossing_search import (
    _find_hypotheses,
    _has_rival,
    _is_beside,
    _is_likely,
    _search_range,
    accept_crossings,
    accept_hypothesis,
    correlate_heights,
)
from uwlts.alignment.path_prior import DriftModel, PathPrior
from uwlts.alignment.path_solution import (
    PathEstimate,
    _linearise_pair,
    _project_observable,
    initial_estimate,
    refine_nodes,
    settle,
)
from uwlts.alignment.pieces import AlignmentOptions, Survey
from uwlts.errors import EvaluationError
from uwlts.fitting.patches import distances_between, rigid_derivatives
from uwlts.model.trajectory import Trajectory
from uwlts.storage.cloud import PointCloud

SECONDS, PASS_S, LENGTH_MM, SWATH_MM, ALTITUDE_MM, NOISE_MM = 10.0, 4.0, 300.0, 100.0, 400.0, 0.05
STD = np.array([30.0, 20.0, 10.0, 1e-6, 1e-6, 1e-6])
"""Standard deviation of the drift at the end, by a constant rate; rotations are known."""
CROSSING = 1, 4
"""Pieces with the middle of each pass, of three."""
Ground = Callable[[np.ndarray, np.ndarray], np.ndarray]


def stones(x: np.ndarray, y: np.ndarray) -> np.ndarray:
    rng, height = np.random.default_rng(3), np.zeros_like(x)
    for u, v, wide, high in rng.uniform([-180, -180, 12, 3], [180, 180, 30, 15], (60, 4)):
        height += high * np.exp(-((x - u) ** 2 + (y - v) ** 2) / (2 * wide**2))
    return height


def two_passes(
    drift_mm: tuple[float, float, float] = (0, 0, 0),
    *,
    turned_deg: float = 30.0,
    ground: Ground = stones,
    later: Ground | None = None,
    std: np.ndarray = STD,
) -> PathEstimate:
    """Return the estimate before any correction; the second pass crosses the first one in its middle, to the left.

    The drift grows linearly to that stated. ``later`` is the ground of the second pass, if it differs.
    """
    rng = np.random.default_rng(1)
    way, across = np.arange(-LENGTH_MM / 2, LENGTH_MM / 2 + 0.1, 2.5), np.linspace(-SWATH_MM / 2, SWATH_MM / 2, 60)
    times = np.concatenate([np.linspace(0, PASS_S, len(way)), np.linspace(SECONDS - PASS_S, SECONDS, len(way))])
    points, poses = [], np.tile(np.eye(4), (len(times), 1, 1))
    for number, (angle, height) in enumerate([(turned_deg, ground), (turned_deg + 90, later or ground)]):
        c, s = np.cos(np.radians(angle)), np.sin(np.radians(angle))
        x, y = way[:, None] * c - across * s, way[:, None] * s + across * c
        points.append(np.stack([x, y, height(x, y) + NOISE_MM * rng.standard_normal(x.shape)], axis=-1))
        rows = slice(number * len(way), (number + 1) * len(way))
        poses[rows, :3, 3] = np.column_stack([way * c, way * s, np.full(len(way), ALTITUDE_MM)])
    drift = np.outer(times / SECONDS, drift_mm)
    poses[:, :3, 3] += drift
    places = np.concatenate(points) + drift[:, None]
    image, line = (each.ravel() for each in np.indices(places.shape[:2]))
    cloud = PointCloud(places.reshape(-1, 3), np.ones(len(image)), image, line, time_s=times[image])
    # Few nodes suffice for a constant rate.
    trajectory, options = Trajectory(times, poses), AlignmentOptions(intervals=10, most_nodes=30)
    model = DriftModel(std, np.zeros(6), np.inf, False, False, True)
    prior = PathPrior.from_times(times, model, trajectory, intervals=options.intervals)
    return initial_estimate(Survey.from_cloud(cloud, times[image], trajectory), prior, options)


def between(estimate: PathEstimate, pair: tuple[int, int]) -> float:
    """Return the share of the drift's time between the middle patches of two pieces."""
    first, second = (estimate.pieces[number] for number in pair)
    first_s, second_s = (each.times_s[np.argmin(np.abs(each.times_s - each.middle_s))] for each in (first, second))
    return (second_s - first_s) / SECONDS


def test_the_search_ends_at_three_standard_deviations_of_the_drift():
    # Between two times, a constant rate moves by its share of the drift at the end.
    estimate = two_passes()
    share = between(estimate, CROSSING)
    found = _search_range(estimate, CROSSING)
    assert found is not None
    np.testing.assert_allclose(found, 3 * STD[:3] * share, rtol=1e-4)
    # Piece 2 is beyond piece 0 along X: the drift reaches it or not.
    near, far = (estimate.surface(number).places_mm[:, 0] for number in (0, 2))
    for beyond_mm, reached in [(-0.3, False), (0.3, True)]:
        reach = far.min() - near.max() + beyond_mm
        std = np.array([reach / 3 / between(estimate, (0, 2)), 1e3, 1e3, 1e-9, 1e-9, 1e-9])
        assert (_search_range(two_passes(std=std), (0, 2)) is not None) == reached


def test_the_gate_is_as_probable_as_three_standard_deviations():
    # Survival function of chi-square with six degrees of freedom, in closed form (Johnson, Kotz and Balakrishnan,
    # Continuous Univariate Distributions 1, 1994, chapter 18). 0.27 % of normal errors exceed three sigmas.
    half = AlignmentOptions().gate / 2
    assert np.exp(-half) * (1 + half + half**2 / 2) == pytest.approx(0.0026998, rel=1e-4)


def test_a_pair_of_different_surfaces_is_dropped_and_no_drift_is_chosen():
    estimate = two_passes(later=lambda x, y: stones(x, y) + 60)
    drift = DriftModel.of_size(1.0, 0.1)
    settled = settle(replace(estimate, prior=replace(estimate.prior, drift=drift), pairs=(CROSSING,)))
    assert settled.pairs == ()
    assert settled.prior.drift is drift


def test_a_hypothesis_is_likely_within_the_gate_only():
    estimate = two_passes((5.0, -7.0, 3.0))
    (found,) = _find_hypotheses(estimate, CROSSING, np.full(3, 15.0))
    # Between the middles of both passes, the path is off by 0.6 of the drift.
    np.testing.assert_allclose(found.relative[:3], -between(estimate, CROSSING) * np.array([5.0, -7.0, 3.0]), atol=0.5)
    spread = np.hypot(STD[:3] * between(estimate, CROSSING), found.std[:3])
    for factor, likely in [(0.99, True), (1.01, False)]:
        along = factor * np.sqrt(estimate.options.gate) * np.array([0.6, 0.8, 0.0]) * spread
        assert _is_likely(estimate, replace(found, relative=np.append(along, np.zeros(3)))) == likely


@pytest.mark.parametrize("turned_deg", [30.0, 200.0])
def test_a_drift_is_recovered_from_one_crossing(turned_deg: float):
    drift = np.array([15.0, -21.0, 9.0])
    search = accept_crossings(two_passes((15.0, -21.0, 9.0), turned_deg=turned_deg))
    assert CROSSING in search.estimate.pairs and not search.doubtful
    times = np.linspace(0, SECONDS, 21)
    off = search.estimate.corrections(times)[1:, :3] + np.outer(times[1:] / SECONDS, drift)
    std = np.sqrt(np.einsum("nii->ni", search.estimate.covariance_at(times[1:])))[:, :3]
    # A constant rate is three numbers; five standard deviations are exceeded once in 600,000 passes.
    assert (np.abs(off) < 5 * std).all() and (std < 0.1).all()
    crossing = _make_crossing(search.estimate, CROSSING)
    # Half-way through the passes, 6 s apart; the median patch of each may be 0.2 s off.
    assert crossing.missed_mm == pytest.approx(0.6 * np.linalg.norm(drift), rel=0.05)
    assert crossing.times_s == pytest.approx((2.0, 8.0), abs=0.2)
    assert crossing.before_mm > 2 and crossing.after_mm < 0.05 * crossing.before_mm
    assert crossing.held_out_before_mm > 2 and crossing.held_out_after_mm < 0.05 * crossing.held_out_before_mm


def test_equal_stones_at_equal_distances_are_ambiguous():
    def waves(x: np.ndarray, y: np.ndarray) -> np.ndarray:
        return 8 * np.cos(2 * np.pi * x / 40) * np.cos(2 * np.pi * y / 40)

    before = two_passes((15.0, -21.0, 9.0), ground=waves)
    reach = _search_range(before, CROSSING)
    assert reach is not None
    found = sorted(_find_hypotheses(before, CROSSING, reach), key=lambda each: -each.patches)
    rivals = [each for each in found[1:] if np.linalg.norm((each.relative - found[0].relative)[:2]) > 20]
    closed = accept_hypothesis(before, found[0])
    assert rivals and closed is not None
    assert _has_rival(before, closed, found[0], rivals)
    # Nearly the same position, or one with less than half the patches, is no rival.
    assert not _has_rival(before, closed, found[0], [found[0]])
    assert not _has_rival(before, closed, found[0], [replace(each, patches=found[0].patches // 3) for each in rivals])


@pytest.mark.parametrize(("pair", "beside"), [((10, 30), True), ((14, 26), True), ((15, 30), False), ((10, 25), False)])
def test_neighbours_of_a_crossing_are_within_some_pieces_in_both_passes(pair, beside):
    assert _is_beside(pair, [(50, 70), (10, 30)], 4) == beside and not _is_beside(pair, [], 4)


def test_a_surface_that_has_changed_in_part_does_not_agree():
    def with_box(x: np.ndarray, y: np.ndarray) -> np.ndarray:
        return stones(x, y) + 5.0 * (x > 20)

    same, changed = two_passes(), two_passes(later=with_box)
    assert same.agrees(CROSSING) and not changed.agrees(CROSSING)
    found, held_out = changed.measure_distances(CROSSING)
    fits = np.abs(found.distance_mm) < 0.5
    assert 0.5 < np.mean(fits) < 0.9
    for name, share in [("least_agreeing", np.mean(fits)), ("least_held_out", np.mean(fits[held_out]))]:
        for beyond, agrees in [(-0.05, True), (0.05, False)]:
            options = replace(changed.options, **{"least_agreeing": 0.0, "least_held_out": 0.0, name: share + beyond})
            assert replace(changed, options=options).agrees(CROSSING) == agrees
    # The result leaves out what has changed: only noise remains.
    crossing = _make_crossing(changed, CROSSING)
    assert crossing.patches == pytest.approx(np.count_nonzero(fits & ~held_out), abs=5)
    assert max(crossing.after_mm, crossing.held_out_after_mm) < 2 * NOISE_MM


def test_a_few_common_patches_are_not_used():
    estimate = two_passes()
    counts = []
    for source, target in (CROSSING[::-1], CROSSING):
        _, held_out = estimate.distances(source, target, reach_mm=estimate.reach_mm)
        counts.append(np.count_nonzero(~held_out))
    for least in (*counts, max(counts) + 1):
        limited = replace(estimate, options=replace(estimate.options, fewest_patches=2 * least))
        assert len(list(_linearise_pair(limited, CROSSING))) == np.count_nonzero(np.array(counts) >= least)


def check_derivatives(estimate: PathEstimate, values: np.ndarray) -> None:
    """Compare distances after a motion of the nodes with those by the derivatives, of patches with the same match."""
    for (source, target), (by, weight, before) in zip(
        (CROSSING[::-1], CROSSING), _linearise_pair(estimate, CROSSING), strict=True
    ):
        found, held_out = estimate.distances(source, target, reach_mm=estimate.reach_mm)
        np.testing.assert_allclose(before, found[~held_out].distance_mm)
        moved, _ = replace(estimate, values=values).distances(source, target, reach_mm=estimate.reach_mm)
        _, first, second = np.intersect1d(found[~held_out].source, moved.source, return_indices=True)
        expected, seen = (by @ values)[first], moved.distance_mm[second] - before[first]
        same = found[~held_out].target[first] == moved.target[second]
        assert np.count_nonzero(same) > 50 and (weight >= 0).all()
        assert np.median(np.abs(seen - expected)[same]) < 0.03 * np.std(expected)


@pytest.mark.parametrize("turned_deg", [30.0, 200.0])
def test_distances_change_by_their_derivatives(turned_deg: float):
    estimate = two_passes(turned_deg=turned_deg)
    rng = np.random.default_rng(2)
    size = np.repeat([0.02, 0.02, 0.02, 5e-5, 5e-5, 5e-5], estimate.prior.count)
    nodes = np.arange(estimate.prior.count)
    check_derivatives(
        estimate, size * (rng.standard_normal(6)[:, None] + (-1.0) ** nodes * rng.standard_normal(6)[:, None]).ravel()
    )


def test_distances_change_by_their_derivatives_with_several_nodes_in_a_patch():
    estimate = two_passes()
    step = estimate.half_s / 2
    prior = estimate.prior.with_nodes(np.linspace(0, SECONDS, 1000), step, most=1000)
    assert prior.count > 0.9 * SECONDS / step
    values = 0.02 * np.repeat([1, 1, 1, 2e-3, 2e-3, 2e-3], prior.count)
    values *= np.random.default_rng(2).standard_normal(len(values))
    check_derivatives(replace(estimate, prior=prior, values=np.zeros(len(values))), values)


def test_the_search_selects_the_walk_but_keeps_the_rates():
    estimate = two_passes((15.0, -21.0, 9.0))
    drift = DriftModel.of_size(30.0, 0.001)
    search = accept_crossings(replace(estimate, prior=replace(estimate.prior, drift=drift)))
    found = search.estimate.prior.drift
    assert CROSSING in search.estimate.pairs
    # The drift is a constant rate.
    assert (found.walk < drift.walk).all()
    assert (found.correlation, found.smooth, found.stated) == (drift.correlation, drift.smooth, False)


def test_nodes_are_as_far_apart_as_the_drift_permits():
    estimate = replace(two_passes(), pairs=(CROSSING,), options=AlignmentOptions(intervals=10))
    found, _ = estimate.measure_distances(CROSSING)
    noise, counts = np.median(found.std_mm), []
    for walk in (1e-12, 1e-5, 1e-4, 1e-3, 0.1):
        drift = replace(estimate.prior.drift, walk=np.full(6, walk))
        refined = refine_nodes(replace(estimate, prior=replace(estimate.prior, drift=drift)))
        step = float(np.diff(refined.prior.nodes_s).min())
        counts.append(refined.prior.count)
        least = estimate.options.node_spacing * estimate.half_s
        assert step > 0.99 * least
        if step > 1.01 * least:
            # At the middle of a step, a random walk deviates by half the root of its variance over the step.
            assert STD[0] * np.sqrt(walk * step / SECONDS) / 2 < noise
        if step < SECONDS / 10 / 4:
            assert STD[0] * np.sqrt(walk * 2 * step / SECONDS) / 2 > 0.9 * noise
    assert counts == sorted(counts) and len(set(counts)) > 2


@pytest.mark.parametrize("along_deg", [0.0, 37.0])
def test_a_ridge_determines_all_motions_but_that_along_it(along_deg: float):
    along = np.array([np.cos(np.radians(along_deg)), np.sin(np.radians(along_deg)), 0.0])

    def ridge(x: np.ndarray, y: np.ndarray) -> np.ndarray:
        return 20 * np.exp(-((along[0] * y - along[1] * x) ** 2) / (2 * 15**2))

    estimate = two_passes(ground=ridge, turned_deg=along_deg + 45)
    first, second = (estimate.surface(number) for number in CROSSING)
    found = distances_between(second, np.eye(4), first, np.eye(4), reach_mm=estimate.reach_mm)
    middle = found.places_mm.mean(axis=0)
    twist = rigid_derivatives(found.places_mm, found.normals, middle)
    projection = _project_observable([(found, found.std_mm**-2, twist)], middle)
    np.testing.assert_allclose(projection @ projection, projection, atol=1e-6)
    assert np.linalg.matrix_rank(projection, tol=1e-3) == 5
    # Motion along the ridge has no effect, and distances keep that of the others.
    assert np.linalg.norm(projection @ np.append(along, np.zeros(3))) < 0.05
    np.testing.assert_allclose((twist @ projection)[:, [2, 3, 4, 5]], twist[:, [2, 3, 4, 5]], atol=0.5)


def test_a_rotation_of_the_path_shifts_one_pass_against_the_other():
    estimate = two_passes()
    turn, at = np.array([2e-4, -3e-4, 1e-4]), np.array([10.0, -20.0, 5.0])
    values = np.repeat(np.append([1.0, 2.0, 3.0], turn), estimate.prior.count)
    moved = estimate.relative_movement(CROSSING, at) @ replace(estimate, values=np.zeros_like(values)).values
    np.testing.assert_array_equal(moved, 0)
    moved = estimate.relative_movement(CROSSING, at) @ values
    middles = [np.argmin(np.abs(each.times_s - each.middle_s)) for each in (estimate.pieces[n] for n in CROSSING)]
    earlier, later = (estimate.pieces[n].platform_mm[k] for n, k in zip(CROSSING, middles, strict=True))
    # Each piece turns about its own platform: turn x (at - later) - turn x (at - earlier).
    np.testing.assert_allclose(moved, np.append(np.cross(turn, earlier - later), np.zeros(3)), atol=1e-9)


def test_the_covariance_before_any_crossing_is_that_of_the_drift():
    times = np.array([0.0, 1.234, 5.0, 10.0])
    found = two_passes().covariance_at(times)
    np.testing.assert_allclose(found, (times[:, None, None] / SECONDS) ** 2 * np.diag(STD**2), atol=1e-4)


@pytest.mark.parametrize("turned_deg", [30.0, 200.0])
def test_time_grows_along_the_pass_by_its_speed(turned_deg: float):
    estimate = two_passes(turned_deg=turned_deg, ground=lambda x, y: 0.2 * x - 0.1 * y)
    for number, angle in [(CROSSING[0], turned_deg), (CROSSING[1], turned_deg + 90)]:
        ahead = np.array([np.cos(np.radians(angle)), np.sin(np.radians(angle))])
        left = np.array([-ahead[1], ahead[0]])
        slopes = np.array([0.2, -0.1])
        steps = np.array([np.append(each, slopes @ each) for each in (ahead, left)])
        # A step of 1 mm ahead takes 4 s / 300 mm, one to the left no time.
        np.testing.assert_allclose(
            np.median(estimate.pieces[number].slopes_s_mm @ steps.T, axis=0), [PASS_S / LENGTH_MM, 0], atol=2e-4
        )


def test_shifts_of_whole_pixels_are_exact():
    x, y = np.meshgrid(np.arange(120.0), np.arange(90.0), indexing="ij")
    rng = np.random.default_rng(4)
    z = sum(6 * np.exp(-((x - u) ** 2 + (y - v) ** 2) / 8) for u, v in rng.uniform(0, 100, (99, 2)))
    surface = np.column_stack([x.ravel() + 0.5, y.ravel() + 0.5, np.ravel(z)])
    first, second = surface[surface[:, 0] < 80], surface[surface[:, 0] > 30]
    shift = np.array([7.0, -4.0, 2.5])
    options = replace(AlignmentOptions(), coarsest_px=8.0)
    best, *others = correlate_heights(first - shift, second, options, pixel_mm=1.0, reach_mm=np.array([8, 5, 3.0]))
    np.testing.assert_allclose(best, shift, atol=1e-9)
    assert all(not np.allclose(each, shift) for each in others) and len(others) < options.proposals
    # So are shifts by more than the size of the maps, either way.
    for far in (np.array([300.0, 40.0, 2.5]), np.array([-40.0, -300.0, 2.5])):
        best, *_ = correlate_heights(first - far, second, options, pixel_mm=1.0, reach_mm=np.abs(far) + 1)
        np.testing.assert_allclose(best, far, atol=1e-9)
    # Shifts with few common pixels are not proposed, though these may agree by chance.
    many = replace(options, proposals=100)
    found = correlate_heights(first - shift, second, many, pixel_mm=1.0, reach_mm=np.array([200.0, 200, 10]))
    low, high = (np.array([each - shift[:2] for each in ends]) for ends in ([[0, 0]], [[80, 90]]))
    common = np.minimum(high + np.array(found)[:, :2], [120, 90]) - np.maximum(low + np.array(found)[:, :2], [30, 0])
    assert len(found) > 4 and common.prod(axis=1).min() > many.fewest_patches / many.pixel**2
    for reach in ([5.9, 5, 3], [8, 2.9, 3], [8, 5, 1.4]):
        found = correlate_heights(first - shift, second, options, pixel_mm=1.0, reach_mm=np.array(reach, float))
        assert all(np.linalg.norm(each - shift) > 1 for each in found)


def test_a_scan_with_a_pause_in_the_middle_is_divided():
    estimate = two_passes()
    assert len(estimate.pieces) == 6
    cloud = estimate.survey.cloud
    assert cloud.time_s is not None
    for every, message in [(60, "a single point"), (20, "200 points")]:
        few = cloud.line % every == 0
        times, places, ones = cloud.time_s[few], cloud.points_mm[few], cloud.intensity[few]
        thinned = PointCloud(places, ones, cloud.frame[few], cloud.line[few], time_s=times)
        with pytest.raises(EvaluationError, match=message):
            Survey.from_cloud(thinned, times, estimate.prior.trajectory)
