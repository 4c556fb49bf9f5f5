"""Clouds as MCAP recordings: messages PointCloud2 of ROS 2; without ROS installed."""

from __future__ import annotations

from collections.abc import Iterator
from io import BytesIO
from pathlib import Path
from types import ModuleType
from typing import Any

import numpy as np

from uwlts.errors import CaptureError, OutputError
from uwlts.files.reading import require_regular_file
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

TOPIC = "/points"
_POINT_CLOUD2 = "sensor_msgs/msg/PointCloud2"


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
    mcap, typesys = _library("mcap.writer"), _library("rosbags.typesys")
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

    Raises CaptureError if the file is damaged, or has no such message; SetupError if the library is not installed.
    """
    highlevel, typesys = _library("rosbags.highlevel"), _library("rosbags.typesys")
    require_regular_file(path, called="cloud")
    try:
        with highlevel.AnyReader([path], default_typestore=typesys.get_typestore(typesys.Stores.ROS2_HUMBLE)) as bag:
            chosen = [connection for connection in bag.connections if connection.msgtype == _POINT_CLOUD2]
            messages = (bag.deserialize(data, _POINT_CLOUD2) for _, _, data in bag.messages(connections=chosen))
            parts = [unpack_points(message) for message in messages] if chosen else []
            points = np.concatenate([np.column_stack([part[axis] for axis in "xyz"]) for part in parts])
            columns: dict[str, Any] = {
                name: np.concatenate([part[name] for part in parts])
                for name in ("intensity", "frame", "line", "time")
                if all(name in (part.dtype.names or ()) for part in parts)
            }
    except Exception as error:
        # The library raises errors of file formats, compression, SQLite and the operating system.
        raise CaptureError(f"{path} is no recording with messages PointCloud2, or damaged: {error}") from error
    times = columns.pop("time", None)
    step_mm = 1e3 * find_float_step(points)
    return make_foreign_cloud(1e3 * points.astype(float), time_s=times, step_mm=step_mm, **columns)


def bag_types(store: Any) -> MessageTypes:
    """Return the types of messages of a type store of the library rosbags."""
    names = (_POINT_CLOUD2, "sensor_msgs/msg/PointField", "std_msgs/msg/Header", "builtin_interfaces/msg/Time")
    return MessageTypes(*(store.types[name] for name in names), pack=lambda data: np.frombuffer(data, np.uint8))


def _library(module: str) -> ModuleType:
    return optional_library(module, needed_by="MCAP", extra="ros")
