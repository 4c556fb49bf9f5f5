"""Platforms that carry the sensor: true and reported poses."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from twin.scene.platform_kinds import Navigation, Robot, RotaryTable, Sea, Vehicle, sample_waves, simulate_drift
from twin.scene.platforms import IdealPath
from twin.scene.scene_object import Pose
from uwlts.errors import DescriptionError
from uwlts.model.trajectory import Trajectory
from uwlts.storage.pose_files import read_trajectory

ALONG = ({"position_mm": (0.0, 0.0, 0.0)}, {"position_mm": (300.0, 0.0, 0.0)})
MOUNT = Pose(position_mm=(30.0, -20.0, 80.0), rotation_deg=(10.0, 20.0, 30.0))


def angle_of(poses: np.ndarray, others: np.ndarray) -> np.ndarray:
    return Rotation.from_matrix(poses[..., :3, :3] @ np.swapaxes(others[..., :3, :3], -1, -2)).magnitude()


def views(count: int) -> tuple[dict[str, object], ...]:
    rng = np.random.default_rng(1)
    return tuple(
        {"position_mm": tuple(rng.uniform(-30, 30, 3)), "rotation_deg": tuple(rng.uniform(-20, 20, 3))}
        for _ in range(count)
    )


def test_a_path_is_travelled_at_its_speed_with_the_sensor_where_the_waypoints_say():
    path = IdealPath(kind="path", waypoints=ALONG, speed_mm_per_s=100.0, frame_rate_hz=20.0, mount=MOUNT)
    course = path.course()
    assert len(course.shots) == path.images() == 61
    times = np.array([shot.time_s for shot in course.shots])
    sensor = course.poses(times)
    np.testing.assert_allclose(sensor[:, 0, 3], 100 * times, atol=1e-9)
    np.testing.assert_allclose(course.reported @ MOUNT.matrix(), sensor, atol=1e-9)
    velocity, turn = path.twist(course.shots[30], exposure_s=0.01)
    np.testing.assert_allclose([*velocity, *turn], [100, 0, 0, 0, 0, 0], atol=1e-8)
    np.testing.assert_allclose([shot.travelled_mm for shot in course.shots], 100 * times, atol=1e-9)


def test_a_path_passes_its_waypoints_and_goes_on_straight():
    path = IdealPath(kind="path", waypoints=views(5), speed_mm_per_s=20.0, turn_deg_per_s=10.0, frame_rate_hz=20.0)
    expected = np.array([waypoint.matrix() for waypoint in path.waypoints])
    ways = np.linalg.norm(np.diff(expected[:, :3, 3], axis=0), axis=1) / 20.0
    times = np.append(0.0, np.cumsum(np.maximum(ways, angle_of(expected[1:], expected[:-1]) / np.radians(10.0))))
    poses = path.command_poses()
    np.testing.assert_allclose(poses(times), expected, atol=1e-9)
    # Before and after it, each step is that of the path's ends, to second order within it.
    for end, away in ((times[0], -1.0), (times[-1], 1.0)):
        inner, last, outer, far = poses(end + away * np.array([-1e-4, 0.0, 1e-4, 1.0]))
        velocity, shift = last[:3, 3] - inner[:3, 3], far[:3, 3] - last[:3, 3]
        np.testing.assert_allclose(shift, 1e4 * velocity, atol=0.02)
        np.testing.assert_allclose(outer - last, last - inner, atol=1e-6)
        turns = [Rotation.from_matrix(last[:3, :3].T @ other[:3, :3]).as_rotvec() for other in (inner, far)]
        np.testing.assert_allclose(turns[1], -1e4 * turns[0], atol=1e-3)


def test_the_same_path_is_described_again():
    described = {"kind": "path", "frame_rate_hz": 10.0, "speed_mm_per_s": 100.0}
    described["waypoints"] = [{"position_mm": (0.0, 0.0, 0.0)}, {"position_mm": (30.0, 0.0, 0.0)}]
    first, again = IdealPath.model_validate(described), IdealPath.model_validate(described)
    assert first.images() == again.images() == 4
    assert first.shots() == again.shots()
    assert first == again


def test_the_clock_of_the_platform_is_ahead():
    """The pose at a time of the platform's clock is that at the camera's time minus the offset."""
    path = IdealPath(kind="path", waypoints=ALONG, speed_mm_per_s=100.0, frame_rate_hz=20.0, clock_offset_s=0.02)
    course = path.course()
    times = np.array([shot.time_s for shot in course.shots])
    np.testing.assert_allclose(course.reported[:, 0, 3], 100 * (times - 0.02), atol=1e-9)
    own, poses, _ = course.report
    found = Trajectory(own, poses).poses_at(times + 0.02)
    np.testing.assert_allclose(found, course.poses(times), atol=1e-9)


def test_stops_take_all_images_at_the_same_place():
    path = IdealPath(kind="path", waypoints=views(4), lights=("lamp", "laser"), bracket=(1.0, 4.0))
    course = path.course()
    assert path.images() == 12
    assert [shot.light for shot in course.shots[:3]] == ["lamp", "laser", "laser"]
    assert course.report is None
    for place in range(4):
        expected = Pose(**path.waypoints[place].model_dump()).matrix()
        np.testing.assert_allclose(course.reported[3 * place : 3 * place + 3], [expected] * 3, atol=1e-12)
        np.testing.assert_allclose(path.twist(course.shots[3 * place], exposure_s=0.01), 0, atol=1e-12)


def test_a_table_turns_the_sensor_the_other_way_round_its_axis():
    axis = Pose(position_mm=(5.0, 6.0, 40.0), rotation_deg=(90.0, 0.0, 0.0))
    table = RotaryTable(kind="rotary_table", axis=axis, count=9, turn_deg=320.0, mount=MOUNT)
    poses = table.course().poses(np.array([shot.time_s for shot in table.shots()]))
    # A point that the table carries comes back to the sensor's view where the sensor was.
    carried = np.linalg.inv(axis.matrix()) @ np.array([20.0, 3.0, 10.0, 1.0])
    for number, pose in enumerate(poses):
        turned = np.eye(4)
        turned[:3, :3] = Rotation.from_rotvec([0, 0, np.radians(40.0 * number)]).as_matrix()
        seen = np.linalg.inv(axis.matrix() @ MOUNT.matrix()) @ axis.matrix() @ turned @ carried
        np.testing.assert_allclose(np.linalg.inv(pose) @ axis.matrix() @ carried, seen, atol=1e-9)
    wobbling = table.model_copy(update={"tilt_arcsec": 30.0, "radial_um": 10.0})
    off = wobbling.course().poses(np.array([shot.time_s for shot in table.shots()]))
    # Amplitudes of both components, with a third of them at two periods: at most 4/3 sqrt(2) of one.
    assert 5 < np.degrees(angle_of(off, poses).max()) * 3600 < 30 * 4 / 3 * 2**0.5
    moving = RotaryTable(kind="rotary_table", count=11, turn_deg=-100.0, speed_deg_per_s=20.0)
    assert moving.frame_rate_hz == pytest.approx(2.0)
    _, turn = moving.twist(moving.shots()[3], exposure_s=0.01)
    np.testing.assert_allclose(turn, [0, 0, np.radians(20)], atol=1e-9)


def test_a_robot_reports_its_own_kinematics_and_errs_by_its_joints():
    """Wrong zeros of 0.01 deg at a reach of 0.4 to 0.8 m: tenths of a mm. A perfect robot is where it should be."""
    perfect = Robot(kind="robot", waypoints=views(3), mount=MOUNT)
    course = perfect.course()
    times = np.array([shot.time_s for shot in course.shots])
    expected = np.array([waypoint.matrix() for waypoint in perfect.waypoints])
    np.testing.assert_allclose(course.poses(times), expected, atol=0.01)
    np.testing.assert_allclose(course.reported @ MOUNT.matrix(), expected, atol=0.01)
    wrong = Robot(
        kind="robot", waypoints=views(3), joint_zero_std_deg=0.01, joint_repeat_std_deg=0.002, link_std_mm=0.1
    )
    course = wrong.course()
    off = np.linalg.norm(course.poses(times)[:, :3, 3] - course.reported[:, :3, 3], axis=1)
    assert 0.02 < off.mean() < 1.0
    with pytest.raises(DescriptionError, match="does not reach place 1"):
        Robot(kind="robot", waypoints=views(1), base=Pose(position_mm=(3000.0, 0.0, 0.0))).shots()


def test_waves_have_their_height_and_die_out_below():
    """Heights of one sea over 2 h: 4 times the standard deviation is the significant height.

    24 bands from half to thrice the peak hold 96 % of the variance; components beat within 2 h by some %.
    """
    times = np.arange(0, 7200, 0.5)
    surface, below = (
        sample_waves(Sea(significant_height_mm=1000.0, depth_mm=depth, tilt_deg=2.0), np.random.default_rng(0))(times)
        for depth in (0.0, 10_000.0)
    )
    assert 4 * surface[:, 2].std() == pytest.approx(1000, rel=0.08)
    assert np.degrees(surface[:, 3].std()) == pytest.approx(2.0, rel=0.08)
    # At the peak of 1.25 rad/s the motion of 10 m depth is exp(-1.6) = 0.2 of that above.
    assert 0.15 < below[:, 0].std() / surface[:, 0].std() < 0.4


@pytest.mark.parametrize("heading_deg", [0.0, 120.0])
def test_a_gyro_bias_bends_the_path_to_the_side_of_the_heading_error(heading_deg: float):
    """A positive heading error rotates the velocity to the left: the position error is its integral."""
    heading = np.radians(heading_deg)

    def poses(times: np.ndarray) -> np.ndarray:
        straight = np.tile(np.eye(4), (len(times), 1, 1))
        straight[:, :2, 3] = 200 * times[:, None] * [np.cos(heading), np.sin(heading)]
        return straight

    navigation = Navigation(gyro_bias_deg_per_s=0.005)
    errors_at, covariance_at = simulate_drift(
        navigation, poses, lead_s=1.0, lasting_s=100.0, rng=np.random.default_rng(1)
    )
    times, left = np.linspace(0, 100.0, 1001), np.array([-np.sin(heading), np.cos(heading)])
    error, covariance = errors_at(times), covariance_at(times[-1:])[0]
    aside = np.trapezoid(200 * error[:, 5], times)
    assert abs(aside) > 1.0
    np.testing.assert_allclose(error[-1, :2] - error[0, :2], aside * left, atol=0.02 * abs(aside))
    cross = covariance[:2, 5]
    np.testing.assert_allclose(cross, (cross @ left) * left, atol=1e-6 * abs(cross @ left))
    assert cross @ left > 0


@pytest.mark.slow
def test_the_navigation_states_the_covariance_of_its_errors():
    """Chi-square of the errors of 200 vehicles after 100 s with the stated covariance, 6 degrees of freedom each.

    The sum has the mean 1200 and the standard deviation 49; the gate is at 5 of them (false-alarm probability 6e-7).
    """
    navigation = Navigation(
        velocity_mm_per_sqrt_s=5.0,
        velocity_bias_mm_per_s=2.0,
        heading_deg_per_sqrt_s=0.02,
        gyro_bias_deg_per_s=0.005,
        tilt_std_deg=0.2,
        depth_std_mm=10.0,
    )

    def poses(times: np.ndarray) -> np.ndarray:
        straight = np.tile(np.eye(4), (len(times), 1, 1))
        straight[:, 0, 3] = 200 * times
        return straight

    total, at = 0.0, np.array([100.0])
    for number in range(200):
        rng = np.random.default_rng(number)
        error, covariance = (
            each(at)[0] for each in simulate_drift(navigation, poses, lead_s=1.0, lasting_s=100.0, rng=rng)
        )
        total += error @ np.linalg.solve(covariance, error)
    assert abs(total - 1200) < 5 * 49
    assert np.sqrt(covariance[1, 1]) > 50, "heading errors cause cross-track errors"


def test_a_vehicle_shakes_and_reports_a_path_that_drifts(tmp_path):
    vehicle = Vehicle(
        kind="vehicle",
        waypoints=ALONG,
        speed_mm_per_s=100.0,
        frame_rate_hz=20.0,
        vibration_mm=0.2,
        vibration_hz=25.0,
        navigation=Navigation(velocity_mm_per_sqrt_s=5.0, heading_deg_per_sqrt_s=0.1),
        states_covariance=True,
        position_std_mm=1.0,
        rotation_std_deg=0.01,
    )
    course = vehicle.course()
    assert course.covariance.shape == (61, 6, 6)
    drift = np.sqrt(np.trace(course.covariance[:, :3, :3], axis1=1, axis2=2))
    assert drift[-1] > drift[0]
    # 2 pi 25 Hz 0.2 mm is 31 mm/s at the middle of an oscillation, beside the 100 mm/s of the path.
    velocities = np.array([vehicle.twist(shot, exposure_s=0.002)[0] for shot in course.shots])
    assert 10 < np.ptp(velocities[:, 1]) < 63
    Trajectory(*course.report).save(tmp_path / "a.csv")
    read = read_trajectory(tmp_path / "a.csv", pose_format="quaternion-xyzw")
    np.testing.assert_allclose(read.poses, course.report[1], atol=1e-7)
    np.testing.assert_allclose(read.covariance, course.report[2], rtol=1e-9, atol=1e-12)


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"waypoints": ()}, "either waypoints or a trajectory"),
        ({"speed_mm_per_s": 10.0}, "needs frame_rate_hz"),
        ({"frame_rate_hz": 10.0}, "without a speed"),
        ({"speed_mm_per_s": 10.0, "frame_rate_hz": 5.0, "bracket": (1.0, 4.0)}, "one image at a time"),
        ({"lights": ()}, "lights is empty"),
    ],
)
def test_contradictions_are_refused(change, words):
    with pytest.raises(ValueError, match=words):
        IdealPath(**({"kind": "path", "waypoints": ALONG} | change))
