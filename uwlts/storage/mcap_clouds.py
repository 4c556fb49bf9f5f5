"""Clouds as MCAP recordings: messages PointCloud2 of ROS 2; without ROS installed."""

from __future__ import annotations

from collections.abc import Iterator
from io import BytesIO
from pathlib import Path
from typing import Any

import numpy as np

from uwlts.errors import CaptureError, OutputError
from uwlts.runtime.optional_library import optional_library
from uwlts.storage.cloud import FARTHEST_SINGLE_MM, PointCloud, find_float_step, make_foreign_cloud
from uwlts.storage.number_tables import Unit
from uwlts.storage.point_cloud2 import (
    FRAME_ID,
    NANOSECONDS,
    MessageTypes,
    covariance_columns,
    pack_points,
    point_cloud2,
    unpack_points,
)
from uwlts.storage.ros_bags import list_topics, open_bag, read_messages

TOPIC = "/points"
_POINT_CLOUD2, _SCAN = "sensor_msgs/msg/PointCloud2", "sensor_msgs/msg/LaserScan"


def mcap_content(cloud: PointCloud) -> bytes:
    """Return a recording of a cloud on the topic ``/points``, with one message per time if times are known.

    Points have the fields x, y, z (m) and intensity as 32-bit floating point numbers, which viewers expect; frame and
    line as 32-bit integers; time (s, 64 bits) if known; and the covariance in mm2 (`covariance_columns`).

    Raises OutputError if a point is farther than 16 m from the origin, or a time is negative: messages cannot be
    earlier than the clock's zero; SetupError if a library is not installed.
    """
    if cloud.time_s is not None and cloud.time_s.min() < 0:
        raise OutputError(f"a point has the time {cloud.time_s.min():g} s: messages have no time before 0")
    if (farthest := float(np.abs(cloud.points_mm).max())) > FARTHEST_SINGLE_MM:
        raise OutputError(
            f"the cloud reaches {farthest:.6g} mm from the origin, where the 32-bit numbers of MCAP are coarser than a "
            "micrometre: write HDF5, PLY, E57 or LAZ, or move the cloud"
        )
    names = "mcap.writer", "rosbags.typesys"
    mcap, typesys = (optional_library(each, needed_by="MCAP", extra="ros") for each in names)
    store: Any = typesys.get_typestore(typesys.Stores.ROS2_HUMBLE)
    types = bag_types(store)
    table = pack_points(cloud, covariance_columns(cloud))
    content = BytesIO()
    writer = mcap.Writer(content)
    writer.start(profile="ros2", library="uwlts")
    text = store.generate_msgdef(_POINT_CLOUD2, ros_version=2)[0]
    schema = writer.register_schema(name=_POINT_CLOUD2, encoding="ros2msg", data=text.encode())
    channel = writer.register_channel(topic=TOPIC, message_encoding="cdr", schema_id=schema)
    for number, (time, rows) in enumerate(_moments(cloud)):
        message = point_cloud2(table[rows], types, time_ns=time, frame_id=FRAME_ID)
        data = bytes(store.serialize_cdr(message, _POINT_CLOUD2))
        writer.add_message(channel_id=channel, log_time=time, publish_time=time, sequence=number, data=data)
    writer.finish()
    return content.getvalue()


def _moments(cloud: PointCloud) -> Iterator[tuple[int, np.ndarray]]:
    """Iterate over the times in ns, and the indices of the points of each."""
    if cloud.time_s is None:
        yield 0, np.arange(len(cloud))
        return
    order = np.argsort(cloud.time_s, kind="stable")
    _, first = np.unique(cloud.time_s[order], return_index=True)
    for rows in np.split(order, first[1:]):
        yield round(float(cloud.time_s[rows[0]]) * NANOSECONDS), rows


def read_bag_cloud(path: Path, unit: Unit | None = None) -> PointCloud:
    """Read the points of all messages PointCloud2 of a recording of ROS 1 or 2, in m, without moving them.

    Without such messages the points are those of all LaserScan, each in the plane z = 0 of its scanner. Raises
    CaptureError if the file is damaged, or has neither; SetupError if the library is not installed.
    """
    with open_bag(path, error=CaptureError) as bag:
        kinds = [each.msgtype for each in bag.connections]
        kind, unpack = (_POINT_CLOUD2, unpack_points) if _POINT_CLOUD2 in kinds else (_SCAN, _unpack_scan)
        parts = [unpack(message) for _, message in read_messages(bag, lambda each: each.msgtype == kind)]
        if not parts:
            raise CaptureError(
                f"{path} has the topics {list_topics(bag)}, and no points (PointCloud2, LaserScan): write images to a "
                "folder, and read poses as a trajectory"
            )
        points = np.concatenate([np.column_stack([part[axis] for axis in "xyz"]) for part in parts])
        columns: dict[str, Any] = {
            name: np.concatenate([part[name] for part in parts])
            for name in ("intensity", "frame", "line", "time")
            if all(name in (part.dtype.names or ()) for part in parts)
        }
    times = columns.pop("time", None)
    step_mm = 1e3 * find_float_step(points)
    return make_foreign_cloud(1e3 * points.astype(float), time_s=times, step_mm=step_mm, **columns)


def _unpack_scan(message: Any) -> np.ndarray:
    """Return the points of a LaserScan that are within its range, as an array (N,) with the fields x, y, z in m."""
    far = np.asarray(message.ranges)
    seen = np.flatnonzero((far >= message.range_min) & (far <= message.range_max))
    far, angle = far[seen], message.angle_min + message.angle_increment * seen
    return np.rec.fromarrays([far * np.cos(angle), far * np.sin(angle), 0 * far], dtype=[(a, "f4") for a in "xyz"])


def bag_types(store: Any) -> MessageTypes:
    """Return the types of messages of a type store of the library rosbags."""
    names = (_POINT_CLOUD2, "sensor_msgs/msg/PointField", "std_msgs/msg/Header", "builtin_interfaces/msg/Time")
    return MessageTypes(*(store.types[name] for name in names), pack=lambda data: np.frombuffer(data, np.uint8))
