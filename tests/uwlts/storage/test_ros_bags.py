"""Poses from bags of ROS 1 and ROS 2, written by the usual library."""

import sys

import numpy as np
import pytest
from rosbags.rosbag1 import Writer as Writer1
from rosbags.rosbag2 import StoragePlugin, Writer
from rosbags.typesys import Stores, get_typestore
from scipy.spatial.transform import Rotation

import uwlts
from uwlts.errors import CaptureError, DescriptionError, SetupError

TIMES = 1.7e9 + np.arange(6) * 0.1
PLACES_M = np.column_stack([0.05 * np.arange(6), np.zeros(6), np.full(6, 0.4)])
TURNS = Rotation.from_euler("z", 5.0 * np.arange(6)[:, None], degrees=True)


def messages(types, kind):
    """The path as messages of a type, with zeros in all other fields."""
    held = types.types
    for time, place, turn in zip(TIMES, PLACES_M, TURNS.as_quat(), strict=True):
        seconds = int(time)
        stamp = held["builtin_interfaces/msg/Time"](sec=seconds, nanosec=round((time - seconds) * 1e9))
        more = {"seq": 0} if "seq" in held["std_msgs/msg/Header"].__dataclass_fields__ else {}
        header = held["std_msgs/msg/Header"](stamp=stamp, frame_id="map", **more)
        spot = held["geometry_msgs/msg/Point"](*place)
        quaternion = held["geometry_msgs/msg/Quaternion"](*turn)
        pose = held["geometry_msgs/msg/Pose"](position=spot, orientation=quaternion)
        if kind == "nav_msgs/msg/Odometry":
            zero = held["geometry_msgs/msg/Vector3"](0.0, 0.0, 0.0)
            twist = held["geometry_msgs/msg/Twist"](linear=zero, angular=zero)
            yield held[kind](
                header=header,
                child_frame_id="base",
                pose=held["geometry_msgs/msg/PoseWithCovariance"](pose=pose, covariance=np.zeros(36)),
                twist=held["geometry_msgs/msg/TwistWithCovariance"](twist=twist, covariance=np.zeros(36)),
            )
        elif kind == "geometry_msgs/msg/PoseStamped":
            yield held[kind](header=header, pose=pose)
        else:
            shift = held["geometry_msgs/msg/Vector3"](*place)
            transform = held["geometry_msgs/msg/Transform"](translation=shift, rotation=quaternion)
            other = held["geometry_msgs/msg/Transform"](
                translation=held["geometry_msgs/msg/Vector3"](9.0, 9.0, 9.0), rotation=quaternion
            )
            stamped = held["geometry_msgs/msg/TransformStamped"]
            moved = stamped(header=header, child_frame_id="base", transform=transform)
            away = stamped(header=header, child_frame_id="camera", transform=other)
            yield held[kind](transforms=[away, moved])


def write_ros2(path, topics, storage=StoragePlugin.MCAP):
    types = get_typestore(Stores.ROS2_HUMBLE)
    with Writer(path, version=9, storage_plugin=storage) as bag:
        for topic, kind in topics.items():
            connection = bag.add_connection(topic, kind, typestore=types)
            for time, message in zip(TIMES, messages(types, kind), strict=True):
                bag.write(connection, int(time * 1e9), types.serialize_cdr(message, kind))
    return path


def assert_path(found):
    np.testing.assert_allclose(found.times_s, TIMES, atol=1e-6)
    np.testing.assert_allclose(found.poses[:, :3, 3], 1000 * PLACES_M, atol=1e-9)
    np.testing.assert_allclose(found.poses[:, :3, :3], TURNS.as_matrix(), atol=1e-12)


@pytest.mark.parametrize("storage", list(StoragePlugin))
@pytest.mark.parametrize("kind", ["nav_msgs/msg/Odometry", "geometry_msgs/msg/PoseStamped"])
def test_poses_of_a_topic(tmp_path, storage, kind):
    path = write_ros2(tmp_path / "bag", {"/odom": kind}, storage)
    assert_path(uwlts.read(path, pose_format="ros"))
    assert_path(uwlts.read(path, pose_format="ros:/odom"))
    (file,) = (each for each in path.iterdir() if each.suffix in (".mcap", ".db3"))
    assert_path(uwlts.read(file, pose_format="ros"))


def test_poses_of_a_ros_1_bag(tmp_path):
    types, kind = get_typestore(Stores.ROS1_NOETIC), "geometry_msgs/msg/PoseStamped"
    with Writer1(tmp_path / "path.bag") as bag:
        connection = bag.add_connection("/pose", kind, typestore=types)
        for time, message in zip(TIMES, messages(types, kind), strict=True):
            bag.write(connection, int(time * 1e9), types.serialize_ros1(message, kind))
    assert_path(uwlts.read(tmp_path / "path.bag", pose_format="ros"))


def test_transforms_of_a_pair_of_frames(tmp_path):
    path = write_ros2(tmp_path / "bag", {"/tf": "tf2_msgs/msg/TFMessage"})
    assert_path(uwlts.read(path, pose_format="ros:map>base"))
    with pytest.raises(DescriptionError, match=r"transforms map>base, map>camera; found 12 of ''"):
        uwlts.read(path, pose_format="ros")
    with pytest.raises(DescriptionError, match=r"transforms map>base, map>camera; found 0 of 'odom>base'"):
        uwlts.read(path, pose_format="ros:odom>base")


def test_what_is_not_there_is_named(tmp_path):
    kind = "geometry_msgs/msg/PoseStamped"
    path = write_ros2(tmp_path / "bag", {"/dvl": kind, "/usbl": kind})
    for pose_format in ("ros", "ros:/odom"):
        with pytest.raises(DescriptionError, match=r"/dvl \(PoseStamped\), /usbl \(PoseStamped\)"):
            uwlts.read(path, pose_format=pose_format)


@pytest.mark.parametrize("name", ["path.mcap", "path.bag", "path.db3", "path.txt"])
def test_other_files_are_refused(tmp_path, name):
    (tmp_path / name).write_bytes(b"no bag" * 100)
    for path in (tmp_path / name, tmp_path / "absent" / name, tmp_path):
        with pytest.raises(DescriptionError, match="bag"):
            uwlts.read(path, pose_format="ros")


def test_without_the_library_the_extra_is_named(tmp_path, monkeypatch):
    path = write_ros2(tmp_path / "bag", {"/odom": "geometry_msgs/msg/PoseStamped"})
    monkeypatch.setitem(sys.modules, "rosbags", None)
    with pytest.raises(SetupError, match=r"-m pip install 'rosbags>="):
        uwlts.read(path, pose_format="ros")


def test_a_topic_without_messages_is_refused(tmp_path):
    with Writer(tmp_path / "bag", version=9, storage_plugin=StoragePlugin.MCAP) as bag:
        bag.add_connection("/odom", "nav_msgs/msg/Odometry", typestore=get_typestore(Stores.ROS2_HUMBLE))
    with pytest.raises(DescriptionError, match="bag"):
        uwlts.read(tmp_path / "bag", pose_format="ros")


def write_messages(path, topic, *content):
    """Write messages of one type on a topic."""
    types = get_typestore(Stores.ROS2_HUMBLE)
    with Writer(path, version=9, storage_plugin=StoragePlugin.MCAP) as bag:
        connection = bag.add_connection(topic, content[0].__msgtype__, typestore=types)
        for number, message in enumerate(content):
            bag.write(connection, number, types.serialize_cdr(message, message.__msgtype__))
    (file,) = path.glob("*.mcap")
    return file


def test_points_of_laser_scans(tmp_path):
    held = get_typestore(Stores.ROS2_HUMBLE).types
    header = held["std_msgs/msg/Header"](held["builtin_interfaces/msg/Time"](0, 0), "scanner")
    # Out of range, unknown and nothing are no points.
    far = np.array([0.5, 0.05, np.inf, np.nan, 2.0, 11.0], np.float32)
    scan = held["sensor_msgs/msg/LaserScan"](header, 0.1, 1.0, 0.25, 0.0, 0.0, 0.1, 10.0, far, np.empty(0, np.float32))
    found = uwlts.read(write_messages(tmp_path / "bag", "/scan", scan, scan))
    expected = [[500 * np.cos(0.1), 500 * np.sin(0.1), 0], [2000 * np.cos(1.1), 2000 * np.sin(1.1), 0]] * 2
    np.testing.assert_allclose(found.points_mm, expected, atol=1e-3)


def test_a_bag_without_points_is_said_with_its_topics(tmp_path):
    held = get_typestore(Stores.ROS2_HUMBLE).types
    header = held["std_msgs/msg/Header"](held["builtin_interfaces/msg/Time"](0, 0), "camera")
    image = held["sensor_msgs/msg/Image"](header, 2, 2, "mono8", 0, 2, np.zeros(4, np.uint8))
    with pytest.raises(CaptureError, match=r"has the topics /cam \(Image\), and no points .*write images to a folder"):
        uwlts.read(write_messages(tmp_path / "bag", "/cam", image))
