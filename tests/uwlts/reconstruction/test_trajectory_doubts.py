"""Mistakes in a trajectory raise doubts; correct trajectories of several kinds raise none."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from uwlts.errors import DescriptionError
from uwlts.model.trajectory import Trajectory
from uwlts.reconstruction.moving import find_trajectory_doubts
from uwlts.storage.pose_files import read_trajectory

IMAGES_S = np.linspace(0.5, 39.5, 30)
KNOWN_S = np.linspace(-1, 41, 421)
TURN = Rotation.from_euler("ZYX", [40, -20, 75], degrees=True)


def way(times: np.ndarray, kind: str) -> tuple[np.ndarray, Rotation]:
    """Positions and rotations of a sensor that moves by 58 mm along its x axis, or about an axis, in 40 s."""
    part, rng = times / 40, np.random.default_rng(7)
    turns = TURN * Rotation.from_rotvec(np.zeros((len(times), 3)))
    match kind:
        case "steady":
            along = 58 * part
        case "accelerating":
            along = 58 * np.clip(part, 0, 1) ** 2
        case "noisy":
            along = 58 * part + rng.normal(0, 0.1, len(times))
        case "stop and go":
            along = 2 * np.floor(times / 40 * 29) + 2 * np.clip((times / 40 * 29) % 1 / 0.2, 0, 1)
        case "late start":
            along = 58 * np.clip((times - 1) / 38, 0, 1)
        case "rotary":
            along = np.zeros(len(times))
            turns = TURN * Rotation.from_euler("Y", 90 * part[:, None], degrees=True)
        case "curved":
            along = 58 * part
            turns = TURN * Rotation.from_euler("Z", 20 * part[:, None], degrees=True)
    return TURN.apply(np.column_stack([along, 0 * along, 0 * along])) + [900, -340, 610], turns


def trajectory(kind: str, times: np.ndarray = KNOWN_S) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    places, turns = way(times, kind)
    return times, places, turns.as_quat()


def doubts_of(times: np.ndarray, places: np.ndarray, quaternions: np.ndarray) -> str:
    poses = np.tile(np.eye(4), (len(times), 1, 1))
    poses[:, :3, :3], poses[:, :3, 3] = Rotation.from_quat(quaternions).as_matrix(), places
    found = Trajectory(times, poses)
    return "; ".join(find_trajectory_doubts(found, IMAGES_S, found.poses_at(IMAGES_S)))


@pytest.mark.parametrize("kind", ["steady", "accelerating", "noisy", "rotary", "curved"])
@pytest.mark.parametrize("rate", [1.0, 10.0, 200.0])
def test_correct_trajectories_raise_no_doubt(kind, rate):
    times = np.arange(-1, 41, 1 / rate)
    assert doubts_of(*trajectory(kind, times)) == ""


@pytest.mark.parametrize("kind", ["stop and go", "late start"])
def test_a_platform_that_stops_has_no_outliers(kind):
    assert "jumps" not in doubts_of(*trajectory(kind))


def test_a_long_log_around_a_short_scan_raises_no_doubt():
    assert doubts_of(*trajectory("steady", np.arange(-3600, 7200, 0.1))) == ""


def test_metres_are_noticed():
    times, places, turns = trajectory("steady")
    assert "`pose_unit`" in doubts_of(times, places / 1000, turns)


def test_millimetres_read_as_metres_are_noticed():
    times, places, turns = trajectory("steady")
    assert "per image: are positions in mm" in doubts_of(times, places * 1000, turns)


@pytest.mark.parametrize("rate", [1.0, 10.0, 100.0])
def test_milliseconds_are_noticed(rate):
    times, places, turns = trajectory("steady", np.arange(-1, 41, 1 / rate))
    assert "are its times in s?" in doubts_of(1000 * times, places, turns)


def test_one_outlier_is_noticed():
    times, places, turns = trajectory("noisy")
    places[200, 1] += 320.0
    assert "jumps by up to 319.9 mm, at 19 s" in doubts_of(times, places, turns)


def test_a_frozen_trajectory_is_noticed():
    times, places, turns = trajectory("steady")
    places[150:260], turns[150:260] = places[150], turns[150]
    assert "8 of 30 images, from 15.29" in doubts_of(times, places, turns)


def test_a_swapped_quaternion_that_leads_along_the_sheet_is_noticed():
    times, places, turns = trajectory("steady")
    # The sensor's y axis, in the sheet, points along the motion.
    swapped = (Rotation.from_quat(turns) * Rotation.from_euler("Z", -90, degrees=True)).as_quat()
    assert "is across the laser sheet" in doubts_of(times, places, swapped)


@pytest.mark.parametrize("seed", range(3))
def test_a_turn_against_the_course_is_noticed(seed):
    angle = np.radians(np.linspace(0, 90, len(KNOWN_S)))
    noise = np.random.default_rng(seed).normal(0, 2.0, (len(angle), 3))
    places = 2000 * np.column_stack([np.sin(angle), 1 - np.cos(angle), 0 * angle]) + noise
    for sign in (1, -1, 0):
        turns = Rotation.from_euler("z", sign * angle[:, None]).as_quat()
        assert ("is yaw a compass angle" in doubts_of(KNOWN_S, places, turns)) is (sign == -1)


def test_images_in_a_gap_are_noticed():
    kept = KNOWN_S[(KNOWN_S < 10) | (KNOWN_S > 18)]
    # Images are 1.3 s apart, seven of them in the 8 s.
    assert "7 of 30 images are in gaps of the trajectory of up to 8" in doubts_of(*trajectory("steady", kept))


@pytest.mark.parametrize(
    ("kind", "set_s"), [("steady", s) for s in (-2.0, -0.3, 0.3, 2.0, 3600.0)] + [("noisy", 2.0), ("noisy", 3600.0)]
)
def test_a_clock_that_is_set_on_the_way_is_noticed(tmp_path, kind, set_s):
    """Between poses 0.1 s apart, with noise by two thirds of a step only a longer time."""
    times, places, quaternions = trajectory(kind)
    times = times + set_s * (times > 20)
    np.savetxt(tmp_path / "a.tum", np.column_stack([times, places / 1000, quaternions]), fmt="%.9f")
    if set_s < 0:
        with pytest.raises(DescriptionError, match="increas"):
            read_trajectory(tmp_path / "a.tum", pose_format="tum")
    else:
        assert doubts_of(times, places, quaternions)


@pytest.mark.parametrize(
    ("shift", "names"), [(18, "UTC and GNSS"), (-37, "UTC and TAI"), (7200, "time zones"), (29, "")]
)
def test_the_clocks_of_time_scales_are_named(shift, names):
    found = Trajectory(KNOWN_S + shift, np.tile(np.eye(4), (len(KNOWN_S), 1, 1)))
    with pytest.raises(DescriptionError) as refused:
        found.poses_at(IMAGES_S)
    assert (f"With `clock_offset_s` {shift}, as between {names}" in str(refused.value)) is bool(names)
    assert found.margins_s(IMAGES_S + shift) == pytest.approx((1.5, 1.5))


@pytest.mark.parametrize("kind", ["steady", "accelerating", "noisy", "stop and go", "rotary", "curved"])
@pytest.mark.parametrize("pattern", [(0, 1), (0, 0, 1), 5 * (0,) + 5 * (1,), (0,)])
@pytest.mark.parametrize("offset", ["place", "turn"])
def test_two_sources_in_one_track_are_noticed(tmp_path, kind, pattern, offset):
    times, places, quaternions = trajectory(kind)
    other = np.resize(pattern, len(times)) == 1
    if offset == "place":
        places[other] += [0, 25.0, 0]
    elif other.any():
        quaternions[other] = (Rotation.from_quat(quaternions[other]) * Rotation.from_rotvec([0.1, 0, 0])).as_quat()
    np.savetxt(tmp_path / "a.tum", np.column_stack([times, places / 1000, quaternions]), fmt="%.9f")
    warnings = read_trajectory(tmp_path / "a.tum", pose_format="tum").warnings
    assert ["two sources" in each for each in warnings] == [True] * (len(pattern) > 1)


@pytest.mark.parametrize("pattern", [(0, 1), (0, 0, 1), (0, 0, 1, 1), (0, 0, 0, 1)])
def test_two_sources_apart_along_the_path_are_noticed(tmp_path, pattern):
    times, places, quaternions = trajectory("steady")
    # The platform seems to go four steps forwards and two back.
    places[np.resize(pattern, len(times)) == 1] += 3 * (places[1] - places[0])
    np.savetxt(tmp_path / "a.tum", np.column_stack([times, places / 1000, quaternions]), fmt="%.9f")
    (warning,) = read_trajectory(tmp_path / "a.tum", pose_format="tum").warnings
    assert "two sources" in warning
