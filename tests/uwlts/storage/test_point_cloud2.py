"""The message PointCloud2 by ROS 2's own definitions: written and read back with their serialisation (CDR)."""

import numpy as np
import pytest
from rosbags.typesys import Stores, get_typestore

from uwlts.desk.scan import StampedClouds
from uwlts.storage.cloud import PAIRS, PointCloud, PointUncertainty
from uwlts.storage.ros_messages import bag_types

STORE = get_typestore(Stores.ROS2_JAZZY)
NAME = "sensor_msgs/msg/PointCloud2"
COUNT = 300


def cloud_at(time_s: float, *, known: bool = True) -> PointCloud:
    rng = np.random.default_rng(3)
    roots = rng.normal(0, 0.02, (COUNT, 3, 3))
    covariance = roots @ roots.transpose(0, 2, 1)
    pairs = np.stack([covariance[:, i, j] for i, j in PAIRS], axis=1)
    uncertainty = PointUncertainty(pairs, np.zeros((COUNT, 3)), np.zeros((0, COUNT, 3))) if known else None
    return PointCloud(
        rng.uniform(-300, 300, (COUNT, 3)),
        rng.uniform(1, 255, COUNT),
        np.full(COUNT, 7),
        np.arange(COUNT),
        uncertainty=uncertainty,
        time_s=np.full(COUNT, time_s),
    )


def sent(message):
    """Return a message after the way through its serialisation."""
    return STORE.deserialize_cdr(STORE.serialize_cdr(message, NAME), NAME)


def rows(message) -> np.ndarray:
    """Return the points as a subscriber reads them, with nothing but the message."""
    kinds = STORE.types["sensor_msgs/msg/PointField"]
    numbers = {kinds.INT32: "i4", kinds.FLOAT32: "f4", kinds.FLOAT64: "f8"}
    order = ">" if message.is_bigendian else "<"
    layout = {
        "names": [field.name for field in message.fields],
        "formats": [order + numbers[field.datatype] for field in message.fields],
        "offsets": [field.offset for field in message.fields],
        "itemsize": message.point_step,
    }
    assert message.row_step == message.width * message.point_step and len(message.data) == message.row_step
    assert all(field.count == 1 for field in message.fields)
    return np.frombuffer(message.data.tobytes(), np.dtype(layout))


def test_points_are_in_metres_with_time_and_covariance():
    cloud = cloud_at(0.25)
    message = sent(StampedClouds(bag_types(STORE), lambda: 0, frame_id="tank").message(cloud, 0.25, 1))
    assert message.header.frame_id == "tank" and message.is_dense and (message.height, message.width) == (1, COUNT)
    table = rows(message)
    # 32-bit numbers below 0.5 m have steps of 3e-8 m.
    np.testing.assert_allclose(np.stack([table[axis] for axis in "xyz"], 1), 1e-3 * cloud.points_mm, atol=3e-8)
    np.testing.assert_array_equal(table["time"], 0.25)
    np.testing.assert_array_equal(table["line"], cloud.line)
    np.testing.assert_array_equal(table["intensity"], cloud.intensity)
    assert table["time"].dtype == np.float64
    for i, j in PAIRS:
        # Two roundings to 32 bits, 6e-8 each.
        found, expected = table[f"cov_{'xyz'[i]}{'xyz'[j]}"], 1e-6 * cloud.covariance_mm2[:, i, j]
        np.testing.assert_allclose(found, expected, rtol=2e-7)
    # A field begins at a multiple of its size, or follows its neighbour without a gap.
    ends = np.cumsum([table.dtype[name].itemsize for name in table.dtype.names])
    assert [field.offset for field in message.fields] == [0, *ends[:-1]] and message.point_step == ends[-1]


def test_stamps_are_those_of_the_images_on_the_clock_of_the_node():
    moments_ns = iter([1_700_000_000_500_000_000, 1_800_000_000_000_000_000])
    clouds = StampedClouds(bag_types(STORE), lambda: next(moments_ns))
    # The first message of a scan may be later than the last one of the scan before.
    images = ((0.25, 1), (0.75, 1), (0.9, 2))
    stamps = [sent(clouds.message(cloud_at(time_s), time_s, scan)).header.stamp for time_s, scan in images]
    assert [(stamp.sec, stamp.nanosec) for stamp in stamps] == [
        (1_700_000_000, 500_000_000),
        (1_700_000_001, 0),
        (1_800_000_000, 0),
    ]


@pytest.mark.parametrize("known", [True, False])
def test_covariance_is_only_sent_if_known(known: bool):
    message = sent(StampedClouds(bag_types(STORE), lambda: 0).message(cloud_at(0.0, known=known), 0.0, 1))
    assert ("cov_xx" in [field.name for field in message.fields]) == known
