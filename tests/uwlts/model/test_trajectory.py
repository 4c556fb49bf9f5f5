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
    with pytest.raises(uwlts.Error, match=r"2 of 3 times, 9.5.*to 11.2.*trajectory from 10.000 to 11.000 s.*clocks"):
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
