"""Trajectories against motions known in closed form."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

import uwlts

AXIS = np.array([2.0, -1.0, 2.0]) / 3


def helix(times):
    """A turn about a fixed axis at a growing rate, and a place on a helix, in mm."""
    poses = np.tile(np.eye(4), (len(times), 1, 1))
    poses[:, :3, :3] = Rotation.from_rotvec(np.outer(0.4 * times + 0.1 * times**2, AXIS)).as_matrix()
    poses[:, :3, 3] = np.column_stack([50 * np.cos(times), 50 * np.sin(times), 8 * times])
    return poses


@pytest.mark.parametrize("step", [0.2, 0.1])
def test_poses_between_are_right_to_the_fourth_power_of_the_step(step):
    known = np.arange(0, 6 + step / 2, step)
    # Away from both ends, where a spline does not know the curvature.
    wanted = np.linspace(1, 5, 1001)
    found, true = uwlts.Trajectory(known, helix(known)).poses_at(wanted), helix(wanted)
    off = np.linalg.norm(found[:, :3, 3] - true[:, :3, 3], axis=1).max()
    turn = Rotation.from_matrix(found[:, :3, :3].swapaxes(1, 2) @ true[:, :3, :3]).magnitude().max()
    # Error of cubic splines: 5/384 of the fourth derivative, 50 mm/s4, and the fourth power of the step.
    assert off < 1.1 * 5 / 384 * 50 * step**4
    assert turn < 1e-5


def test_known_poses_are_kept():
    times = np.array([0.0, 0.7, 1.0, 3.5])
    np.testing.assert_allclose(uwlts.Trajectory(times, helix(times)).poses_at(times), helix(times), atol=1e-12)


def test_times_outside_are_refused():
    trajectory = uwlts.Trajectory(np.array([10.0, 11.0]), helix(np.array([0.0, 1.0])))
    with pytest.raises(uwlts.Error, match=r"2 of 3 times, 9.5.*to 11.2.*trajectory from 10 s to 11 s.*clocks"):
        trajectory.poses_at(np.array([9.5, 10.2, 11.2]))


@pytest.mark.parametrize(
    ("times", "message"),
    [([0.0], "N >= 2"), ([0.0, 1.0, 1.0], "pose 3 is at 1 s"), ([0.0, np.nan, 1.0], "finite and increase")],
)
def test_impossible_times_are_refused(times, message):
    with pytest.raises(uwlts.Error, match=message):
        uwlts.Trajectory(np.array(times), np.tile(np.eye(4), (len(times), 1, 1)))


def test_reflections_are_refused():
    poses = np.tile(np.diag([1.0, 1.0, -1.0, 1.0]), (2, 1, 1))
    with pytest.raises(uwlts.Error, match="rigid transforms"):
        uwlts.Trajectory(np.array([0.0, 1.0]), poses)


def test_tum_files_hold_seconds_metres_and_quaternions(tmp_path):
    times = 1.3e9 + np.arange(5) / 4
    poses = helix(times - times[0])
    quaternions = Rotation.from_matrix(poses[:, :3, :3]).as_quat()
    lines = ["# timestamp tx ty tz qx qy qz qw"]
    for row in np.column_stack([times, poses[:, :3, 3] / 1000, quaternions]):
        lines.append(" ".join(f"{value:.9f}" for value in row))
    (tmp_path / "path.txt").write_text("\n".join(lines))
    found = uwlts.read(tmp_path / "path.txt", pose_format="tum")
    np.testing.assert_allclose(found.times_s, times, atol=1e-6)
    np.testing.assert_allclose(found.poses, poses, atol=1e-5)


@pytest.mark.parametrize(
    ("text", "pose_format", "message"),
    [
        ("x,y,z,qx,qy,qz,qw\n0,0,0,0,0,0,1\n1,0,0,0,0,0,1\n", "quaternion-xyzw", "no column time_s"),
        ("0 1 2 3 0 0 1\n", "tum", "7 columns; expected time"),
        ("time_s,x,y,z,qx,qy,qz,qw\n1,0,0,0,0,0,0,1\n0,1,0,0,0,0,0,1\n", "quaternion-xyzw", "increase"),
    ],
)
def test_other_files_are_refused(tmp_path, text, pose_format, message):
    (tmp_path / "path.csv").write_text(text)
    with pytest.raises(uwlts.Error, match=message):
        uwlts.read(tmp_path / "path.csv", pose_format=pose_format)


def test_repeated_poses_are_dropped_and_counted(tmp_path):
    rows = [f"{1.7e9 + time:.2f} {time} 0 0 0 0 0 1" for time in (0.0, 0.25, 0.25, 0.25, 0.5)]
    (tmp_path / "a.tum").write_text("\n".join(rows))
    found = uwlts.read(tmp_path / "a.tum")
    assert (found.times_s - 1.7e9).tolist() == [0, 0.25, 0.5] and found.poses[:, 0, 3].tolist() == [0, 250, 500]
    assert "2 of 5 poses repeat" in found.warnings[0]
    found.save(tmp_path / "b.csv")
    assert uwlts.read(tmp_path / "b.csv").times_s.tolist() == found.times_s.tolist()


def test_different_poses_at_a_time_are_refused_with_date_and_seconds(tmp_path):
    rows = [f"{time} {x} 0 0 0 0 0 1" for time, x in ((1.7e9, 0), (1700000000.25, 1), (1700000000.25, 2))]
    (tmp_path / "a.tum").write_text("\n".join(rows))
    with pytest.raises(uwlts.Error, match=r"pose 3 is at 1700000000.25 s \(2023-11-14 22:13:20.25\d* UTC\), pose 2 at"):
        uwlts.read(tmp_path / "a.tum", pose_format="tum")


@pytest.mark.parametrize(
    ("header", "start"),
    [
        ("timestamp [ns]", 1700000000 * 10**9),
        ("time_us", 1700000000 * 10**6),
        ("Time (s)", 1700000000),
        ("t", 1700000000),
    ],
)
def test_times_in_other_units(tmp_path, header, start):
    factor = start // 1700000000
    rows = [f"{start + factor * second},{second},0,0,1,0,0,0" for second in range(3)]
    names = f"#{header},p_RS_R_x [m],p_RS_R_y [m],p_RS_R_z [m],q_RS_w [],q_RS_x [],q_RS_y [],q_RS_z []"
    (tmp_path / "a.csv").write_text("\n".join([names, *rows]))
    found = uwlts.read(tmp_path / "a.csv")
    # Half a unit in the last place of 1.7e18 ns.
    np.testing.assert_allclose(found.times_s - 1.7e9, [0, 1, 2], atol=2.4e-7)
    assert found.poses[:, 0, 3].tolist() == [0, 1000, 2000] and (found.poses[:, :3, :3] == np.eye(3)).all()
    (tmp_path / "a.csv").write_text("\n".join([names.replace(f"#{header}", "time"), *rows]))
    if factor == 10**9:
        with pytest.raises(uwlts.Error, match="expected s, or a unit in the name"):
            uwlts.read(tmp_path / "a.csv")
