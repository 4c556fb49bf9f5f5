"""Time, image and covariance of each point in exchange formats, read back by the formats' own libraries."""

from dataclasses import replace

import laspy
import numpy as np
import pytest
from mcap.reader import make_reader
from mcap_ros2.decoder import DecoderFactory
from rosbags.highlevel import AnyReader
from rosbags.typesys import Stores, get_typestore

import uwlts
from uwlts.storage.cloud import PAIRS, PointCloud, PointUncertainty
from uwlts.storage.cloud_files import write_cloud

FIELDS = ("x", "y", "z", "intensity", "frame", "line", "time")
NUMBERS = {5: "<i4", 7: "<f4", 8: "<f8"}
"""Datatypes of sensor_msgs/PointField."""


@pytest.fixture
def cloud():
    rng, count = np.random.default_rng(3), 600
    frame = np.repeat(np.arange(12), 50)
    known = PointUncertainty(
        rng.uniform(0.001, 0.002, (count, 6)).astype(np.float32),
        rng.normal(0, 0.01, (count, 3)).astype(np.float32),
        rng.normal(0, 0.02, (2, count, 3)).astype(np.float32),
        rng.normal(0, 0.03, (6, count, 3)).astype(np.float32),
    )
    return PointCloud(
        rng.uniform(-300, 300, (count, 3)),
        rng.uniform(1, 255, count),
        frame,
        np.arange(count) % 50,
        uncertainty=known,
        time_s=1.7e9 + 0.125 * frame,
    )


def assert_same(cloud: PointCloud, table: dict[str, np.ndarray]) -> None:
    np.testing.assert_allclose(np.stack([table[a] for a in "xyz"], 1), 1e-3 * cloud.points_mm, atol=2e-8)
    for name, expected in {
        "frame": cloud.frame,
        "line": cloud.line,
        "time": cloud.time_s,
        "intensity": cloud.intensity,
    }.items():
        np.testing.assert_array_equal(table[name], expected)
    for i, j in PAIRS:
        expected = cloud.covariance_mm2[:, i, j].astype(np.float32)
        np.testing.assert_array_equal(table[f"cov_{'xyz'[i]}{'xyz'[j]}_mm2"], expected)


def test_point_cloud2_of_ros_2(cloud, tmp_path):
    path = tmp_path / "a.mcap"
    write_cloud(path, cloud)
    parts, stamps = [], []
    with path.open("rb") as file:
        for schema, channel, message, decoded in make_reader(
            file, decoder_factories=[DecoderFactory()]
        ).iter_decoded_messages():
            assert schema.name == "sensor_msgs/msg/PointCloud2" and channel.topic == "/points"
            assert message.log_time == decoded.header.stamp.sec * 10**9 + decoded.header.stamp.nanosec
            kind = np.dtype(
                {
                    "names": [field.name for field in decoded.fields],
                    "formats": [NUMBERS[field.datatype] for field in decoded.fields],
                    "offsets": [field.offset for field in decoded.fields],
                    "itemsize": decoded.point_step,
                }
            )
            parts.append(np.frombuffer(bytes(decoded.data), kind))
            assert len(parts[-1]) == decoded.width == 50
            stamps.append(decoded.header.stamp.sec)
    assert len(parts) == 12 and stamps[0] == 1_700_000_000
    table = np.concatenate(parts)
    assert_same(cloud, {name: table[name] for name in table.dtype.names})
    with AnyReader([path], default_typestore=get_typestore(Stores.ROS2_HUMBLE)) as bag:
        assert [c.msgtype for c in bag.connections] == ["sensor_msgs/msg/PointCloud2"] and bag.message_count == 12


def test_a_cloud_without_times_is_one_message(cloud, tmp_path):
    plain = PointCloud(cloud.points_mm, cloud.intensity, cloud.frame, cloud.line)
    write_cloud(tmp_path / "a.mcap", plain)
    with (tmp_path / "a.mcap").open("rb") as file:
        (found,) = make_reader(file, decoder_factories=[DecoderFactory()]).iter_decoded_messages()
    assert found[3].width == len(plain) and [field.name for field in found[3].fields] == list(FIELDS[:-1])


def test_laz_has_time_image_and_covariance(cloud, tmp_path):
    write_cloud(tmp_path / "a.laz", cloud)
    found = laspy.read(tmp_path / "a.laz")
    table = {axis: np.asarray(getattr(found, axis)) for axis in "xyz"}
    table |= {"time": np.asarray(found.gps_time), "intensity": np.asarray(found["amplitude"])}
    table |= {
        name: np.asarray(found[name])
        for name in ("frame", "line", *(f"cov_{'xyz'[i]}{'xyz'[j]}_mm2" for i, j in PAIRS))
    }
    np.testing.assert_allclose(table["x"], 1e-3 * cloud.points_mm[:, 0], atol=1e-7)
    assert_same(cloud, table | {a: (1e-3 * cloud.points_mm)[:, k] for k, a in enumerate("xyz")})


def test_times_before_zero_are_refused(cloud, tmp_path):
    early = PointCloud(cloud.points_mm, cloud.intensity, cloud.frame, cloud.line, time_s=cloud.time_s - 2e9)
    with pytest.raises(uwlts.Error, match="no time before 0"):
        write_cloud(tmp_path / "a.mcap", early)
    assert not list(tmp_path.iterdir())


def test_far_clouds_keep_their_micrometres(cloud, tmp_path):
    far = replace(cloud, points_mm=cloud.points_mm + [5e6, 0, 0], uncertainty=None)
    write_cloud(tmp_path / "a.laz", far)
    # Half a step of 0.1 um.
    np.testing.assert_allclose(uwlts.read(tmp_path / "a.laz").points_mm, far.points_mm, atol=6e-5)
    for name in ("a.mcap", "a.e57"):
        with pytest.raises(uwlts.Error, match="coarser than a micrometre"):
            write_cloud(tmp_path / name, far)


def test_mcap_gives_points_times_and_images_back(cloud, tmp_path):
    write_cloud(tmp_path / "a.mcap", cloud)
    again = uwlts.read(tmp_path / "a.mcap")
    # 32 bits at 0.3 m.
    np.testing.assert_allclose(again.points_mm, cloud.points_mm, atol=2e-5)
    for name in ("frame", "line", "time_s"):
        np.testing.assert_array_equal(getattr(again, name), getattr(cloud, name))
