"""Messages on weak directions; predictions for a further image, compared with calibrations that include it."""

from dataclasses import replace

import numpy as np
import pytest

from tests.uwlts.calibration_views import built_sensor, inside, lattice, square_sensor
from tests.uwlts.joint_views import TARGET, Noise, gathered, lit_points, seen, step_views, target_series
from tests.virtual_sensors import altered, with_fine_target
from uwlts.calibration.calibrate import solve_jointly
from uwlts.calibration.camera.camera_parameters import TargetImage
from uwlts.calibration.capture_evidence import AirEvidence
from uwlts.calibration.joint.gathering import Series
from uwlts.calibration.joint.next_shot import advice_lines, rank_next_shots
from uwlts.calibration.joint.observability import (
    Lengths,
    compute_mesh_lengths,
    find_weaknesses,
    format_weaknesses,
    list_regions,
    read_region_estimate,
)
from uwlts.calibration.sequential.sequential_calibration import CalibrationOptions
from uwlts.model.parameter_keys import SheetParameter, WindowParameter, parse_parameter
from uwlts.targets import parse_target

BUILT = built_sensor()
OPTIONS = CalibrationOptions(poses="stage", correct_circles=False)


def keys(*texts):
    return [parse_parameter(text) for text in texts]


def noise(seed):
    return Noise(circles_px=0.03, stripe_px=0.1, stage_mm=0.003, rng=np.random.default_rng(seed))


@pytest.fixture(scope="module")
def in_water():
    return target_series(BUILT, medium=0, positions=np.arange(6) * 36.0 - 120.0, noise=noise(4))


@pytest.fixture(scope="module")
def from_water(in_water, thesis):
    return solve_jointly(gathered(thesis, [in_water]), options=OPTIONS).calibration


def from_steps(thesis, *, height_mm):
    """A target in air and steps in water; the laser's window is square to the sheet, as the step views need it."""
    sensor = square_sensor()
    described = with_fine_target(
        altered(thesis, {"uncertainty": {"step_height_mm": height_mm, "window_tilt_deg": 0.01}})
    )
    air = target_series(sensor, window=False, positions=np.arange(6) * 46.0 - 200.0, noise=noise(2), columns=15)
    # The standards face the laser, so that the uncertainty of their heights is the stated one.
    steps = step_views(sensor, noise=noise(3), tilts=(0.0, 0.0, 0.0))
    return solve_jointly(gathered(described, [air], steps), options=OPTIONS).calibration


def lengths(by_parameters):
    """Lengths of 100 mm along Z with these derivatives (M, P)."""
    ends = np.tile([[0.0, 0.0], [0.0, 100.0]], (len(by_parameters), 1, 1))
    count = len(by_parameters)
    return Lengths(ends, np.full(count, 100.0), np.array(by_parameters, dtype=float), np.ones(count))


def of_calibration(calibration):
    region = list_regions(calibration)[0]
    known = read_region_estimate(calibration, region)
    over = compute_mesh_lengths(known, region)
    return known, over, find_weaknesses(over, known.parameters.keys, known.covariance)


def test_two_that_cannot_be_distinguished_are_named_together():
    """Each alone costs 10 µm, they trade places with a correlation of 0.99, and the third is known well."""
    names = keys("window_distance", "index of water", "cx")
    covariance = np.array([[1.0, 0.99, 0.0], [0.99, 1.0, 0.0], [0.0, 0.0, 0.01]])
    found = find_weaknesses(lengths([[0.01, 0.01, 0.001], [0.005, 0.005, 0.0]]), names, covariance)
    assert len(found) == 1
    assert set(found[0].parameters) == set(names[:2])
    # The standard uncertainty of their sum: 0.01 sqrt(2 + 2 * 0.99).
    assert found[0].cost_mm == pytest.approx(0.01 * np.sqrt(3.98), rel=1e-3)
    said = found[0].words()
    assert "window distance and index of water cannot be separated" in said or (
        "index of water and window distance cannot be separated" in said
    )
    assert "together they add 0.020 mm in a length of 100 mm along Z" in said


def test_what_cancels_in_every_length_is_not_named():
    """Two parameters, each known to 1, can compensate each other without an effect on lengths."""
    covariance = np.array([[1.0, -0.9999999, 0.0], [-0.9999999, 1.0, 0.0], [0.0, 0.0, 1.0]])
    found = find_weaknesses(lengths([[0.01, 0.01, 0.002]]), keys("window_distance", "f", "glass_index"), covariance)
    assert [each.parameters for each in found] == [(WindowParameter.GLASS_INDEX,)]
    assert "index of the window's glass is not known well enough; this adds 0.002 mm" in found[0].words()


def test_independent_ones_are_not_called_confused():
    found = find_weaknesses(lengths([[0.01, 0.01]]), keys("window_distance", "glass_index"), np.eye(2))
    assert not found[0].confused
    assert "are not known well enough; together they add 0.014 mm" in found[0].words()


def test_less_than_a_micrometre_is_said_to_be_nothing():
    assert find_weaknesses(lengths([[0.0009, 0.0]]), keys("window_distance", "f"), np.eye(2)) == []
    assert format_weaknesses([])[0].startswith("no weakly determined parameter")


def test_a_height_that_is_the_cause_is_named_though_it_moves_no_point():
    """Knowing the height would leave 0.2 of the window distance's standard uncertainty."""
    covariance = np.array([[1.0, 0.98], [0.98, 1.0]])
    names = keys("window_distance", "height of the 23 mm step")
    found = find_weaknesses(lengths([[0.01, 0.0]]), names, covariance)
    assert found[0].parameters == tuple(names)
    assert found[0].confused


def test_what_changes_lengths_most_is_named_where_knowing_one_would_not_help():
    """Five trade places, each a fifth of the direction; knowing the height would close a quarter of it."""
    covariance = np.eye(6)
    covariance[:5, 5] = covariance[5, :5] = 0.5 / np.sqrt(5)
    names = keys("window_distance", "glass_index", "f", "cx", "cy", "height of the 23 mm step")
    (found,) = find_weaknesses(lengths([[0.0100, 0.0098, 0.0096, 0.0094, 0.0092, 0.0]]), names, covariance)
    assert found.parameters == tuple(names[:3])


@pytest.mark.parametrize(("smaller_mm", "count"), [(0.006, 1), (0.007, 2)])
def test_a_direction_of_less_than_a_tenth_of_the_variance_is_not_named(smaller_mm, count):
    """Beside 0.02 mm, 0.006 mm are 8 % of the sum of squares, and 0.007 mm are 11 %."""
    found = find_weaknesses(lengths([[0.02, 0.0], [0.0, smaller_mm]]), keys("window_distance", "f"), np.eye(2))
    assert [each.cost_mm for each in found] == pytest.approx([0.02, smaller_mm][:count])


def without(known, key):
    """Return the covariance for a known parameter."""
    place = known.parameters.keys.index(key)
    column = known.covariance[:, place]
    return known.covariance - np.outer(column, column) / column[place]


@pytest.mark.slow
def test_steps_alone_leave_the_window_open(thesis):
    """A step's height depends on window distance and sheet rotation in the same way; knowing one of them helps."""
    calibration, pair = from_steps(thesis, height_mm=1e-4), {WindowParameter.DISTANCE, SheetParameter.WINDOW_TURN}
    known, over, found = of_calibration(calibration)
    assert set(found[0].parameters[:2]) == pair
    assert found[0].confused
    before = np.mean(over.std_mm(known.covariance) ** 2)
    for key in pair:
        assert np.mean(over.std_mm(without(known, key)) ** 2) < 0.65 * before
    assert any(
        "target in air without the window" in forecast.candidate.words for forecast in rank_next_shots(calibration)
    )


def test_the_cost_is_part_of_the_lengths_uncertainty(from_water):
    known, over, found = of_calibration(from_water)
    largest = over.std_mm(known.covariance).max()
    assert 0.3 * largest < found[0].cost_mm <= 1.0001 * largest
    assert [line for line in advice_lines(from_water) if line.startswith("next: ")]


EDGES = {"left": (0, -1), "right": (0, 1), "upper": (1, -1), "lower": (1, 1)}


def test_shots_are_where_their_words_say(from_water):
    """Depths along the laser's axis, in the order of their words; the edge said to be nearer is so, by 20 deg."""
    frame, corner = from_water.object_transform(), np.abs(TARGET.extent_mm).max()
    square, tilted, depths = {}, [], {}
    for shot in (forecast.candidate for forecast in rank_next_shots(from_water)):
        if "of the target" in shot.words:
            words = shot.words.split(", ")
            where, depth = words[1].split(" (Z ")
            depths[where] = float(depth.removesuffix(" mm)"))
            along = frame[:3, 2] @ (shot.pose[:3, 3] - frame[:3, 3])
            assert along == pytest.approx(depths[where], abs=0.5)
            if "edge" in words[2]:
                tilted.append((where, words[2].split()[0], shot.pose))
            else:
                square[where] = shot.pose
    assert depths["near"] < depths["in the middle"] < depths["far"]
    for where, edge, pose in tilted:
        axis, side = EDGES[edge]
        # The edge's middle in the target's frame, by the camera's axis that it is far along, and its depth.
        at = side * square[where][axis, :2]
        at *= corner / np.linalg.norm(at)
        nearer = square[where][2, :2] @ at - pose[2, :2] @ at
        # The target is inclined to the camera by 35 deg: sin(55) - sin(35) or sin(35) - sin(15) about x.
        assert 0.2 * corner < nearer < 0.4 * corner
    assert len(tilted) >= 6


def test_lengths_do_not_change_by_how_the_frame_turns(from_water):
    """Another OCS, turned by 2 deg about X and shifted, gives the same uncertainties at the same points."""
    known, over, _ = of_calibration(from_water)
    frame = from_water.object_transform()
    cosine, sine = np.cos(np.radians(2.0)), np.sin(np.radians(2.0))
    turn = np.array([[1, 0, 0], [0, cosine, -sine], [0, sine, cosine]])
    outline = np.array(from_water.joint.covered[0].outline_mm) @ turn[1:, 1:]
    frame[:3, :3] = frame[:3, :3] @ turn
    moved = from_water.model_copy(update={"camera_from_object": tuple(map(tuple, frame.tolist()))})
    region = replace(list_regions(from_water)[0], outline_mm=outline)
    there = compute_mesh_lengths(replace(known, calibration=moved), region).std_mm(known.covariance)
    # Meshes of a turned outline differ; the largest length runs between the same corners but for the inset of 2 %.
    assert there.max() == pytest.approx(over.std_mm(known.covariance).max(), rel=0.06)


def test_targets_points_are_those_that_are_found():
    assert np.allclose(TARGET.points_mm[:, :2], lattice()[:, :2])
    board = parse_target({"kind": "charuco", "columns": 5, "rows": 4, "square_mm": 10.0, "marker_mm": 7.0})
    assert board.points_mm.shape == (12, 3)
    assert board.points_mm[0].tolist() == [10.0, 10.0, 0.0]


def shot(sensor, pose, view, spoilt):
    """Return the true image of the target and the stripe for a pose ``T_camera_target``."""
    index = 1.0 if view.medium is None else 1.3312
    points = lattice()
    pixels = seen(sensor, points @ pose[:3, :3].T + pose[:3, 3], index=index, window=view.window)
    here = inside(pixels, sensor)
    found = pixels[here] + spoilt.draw(spoilt.circles_px, (here.sum(), 2))
    lit = lit_points(sensor, normal=pose[:3, 2], point=pose[:3, 3], index=index, count=1000)
    stripe = seen(sensor, lit, index=index, window=view.window)
    stripe = stripe[inside(stripe, sensor)]
    stripe = stripe + np.column_stack([np.zeros(len(stripe)), spoilt.draw(spoilt.stripe_px, len(stripe))])
    evidence = AirEvidence(TARGET, [TargetImage(points[here], found, 0.0)], [(0, 0)], [stripe], [], captures=["shot"])
    return Series(view, evidence, None)


@pytest.mark.slow
def test_the_advised_shot_does_what_was_predicted(from_water, in_water, thesis):
    """The prediction is within 20 %, because the noise and the weights are estimated again from all residuals."""
    forecasts = rank_next_shots(from_water)
    best = forecasts[0]
    assert "an image of the target in water" in best.candidate.words
    assert best.after < 0.9 * best.before
    added = shot(BUILT, best.candidate.pose, in_water.view, noise(9))
    result = solve_jointly(gathered(thesis, [in_water, added]), options=OPTIONS)
    known, over, _ = of_calibration(from_water)
    reached = np.sqrt(np.mean(over.std_mm(result.estimate.covariance) ** 2))
    assert known.parameters.keys == result.estimate.parameters.keys
    assert reached == pytest.approx(best.after, rel=0.2)
    assert [each.after for each in forecasts] == sorted(each.after for each in forecasts)
    every = " ".join(each.candidate.words for each in forecasts)
    assert all(kind in every for kind in ("target in water", "step in water", "spheres of 30 mm in water"))
    assert "in air" not in every


def test_a_single_line_covers_no_area(from_water):
    """One stripe alone cannot be solved; of a calibration whose outline is a line nothing is said of lengths."""
    joint = from_water.joint
    line = joint.covered[0].model_copy(update={"outline_mm": ((-50.0, 10.0), (50.0, 10.0))})
    calibration = from_water.model_copy(update={"joint": joint.model_copy(update={"covered": (line,)})})
    assert rank_next_shots(calibration) == []
    assert "cover no area" in advice_lines(calibration)[0]
