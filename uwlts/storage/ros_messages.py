"""Clouds as ROS 2's messages sensor_msgs/PointCloud2, and recordings of clouds and poses, without ROS installed.

The types of the messages come from any library that has them. Lengths are in m (REP 103), points in the OCS: X is the
direction of the scan, Y is along the stripe, and Z points away from the sensor. Recordings are bags of ROS 1 (.bag) and
ROS 2 (.mcap, .db3, or their folder).
"""

from __future__ import annotations

from collections.abc import Callable, Container, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from io import BytesIO
from pathlib import Path
from typing import Any

import numpy as np

from uwlts.errors import CaptureError, DescriptionError, Error, OutputError
from uwlts.files.reading import require_regular_file
from uwlts.runtime.optional_library import optional_library
from uwlts.storage.cloud import FARTHEST_SINGLE_MM, PAIRS, PointCloud, find_float_step, make_foreign_cloud
from uwlts.storage.number_tables import Unit

FRAME_ID = "base"
"""Frame of the points, if no other is given."""
NANOSECONDS = 10**9  # of a second
_KINDS = dict(enumerate(("i1", "u1", "i2", "u2", "i4", "u4", "f4", "f8"), start=1))
"""Types of numbers by the constants of sensor_msgs/PointField."""
_DATATYPES = {kind: constant for constant, kind in _KINDS.items()}


@dataclass(frozen=True)
class MessageTypes:
    """Types sensor_msgs/PointCloud2, sensor_msgs/PointField, std_msgs/Header and builtin_interfaces/Time.

    ``pack`` converts bytes to the type of a message's ``uint8[]``.
    """

    point_cloud2: Callable[..., Any]
    point_field: Callable[..., Any]
    header: Callable[..., Any]
    time: Callable[..., Any]
    pack: Callable[[bytes], Any]


def covariance_columns(cloud: PointCloud) -> dict[str, np.ndarray]:
    """Return the columns (N,) float32 ``cov_xx_mm2`` to ``cov_zz_mm2`` of each point's covariance; empty if unknown."""
    covariance = cloud.covariance_mm2
    if covariance is None:
        return {}
    names = [f"cov_{'xyz'[i]}{'xyz'[j]}_mm2" for i, j in PAIRS]
    return {name: covariance[:, i, j].astype(np.float32) for name, (i, j) in zip(names, PAIRS, strict=True)}


def covariance_columns_m2(cloud: PointCloud) -> dict[str, np.ndarray]:
    """Return the columns (N,) float32 ``cov_xx`` to ``cov_zz`` of each point's covariance, m2; empty if unknown."""
    columns = covariance_columns(cloud).items()
    return {name.removesuffix("_mm2"): (1e-6 * values).astype(np.float32) for name, values in columns}


def pack_points(cloud: PointCloud, covariance: Mapping[str, np.ndarray]) -> np.ndarray:
    """Return the points as packed rows, little-endian, with columns (N,) of their covariance.

    Fields are x, y, z (m) and intensity as 32-bit floating point numbers, which viewers expect; frame and line as
    32-bit integers; time (s, 64 bits) if known; and the covariance.
    """
    columns: dict[str, np.ndarray] = dict(zip("xyz", (1e-3 * cloud.points_mm).astype(np.float32).T, strict=True))
    columns |= {"intensity": cloud.intensity, "frame": cloud.frame, "line": cloud.line}
    if cloud.time_s is not None:
        columns["time"] = cloud.time_s
    columns |= covariance
    table = np.empty(len(cloud), [(name, values.dtype.newbyteorder("<")) for name, values in columns.items()])
    for name, values in columns.items():
        table[name] = values
    return table


def point_cloud2(table: np.ndarray, types: MessageTypes, *, time_ns: int, frame_id: str) -> Any:
    """Return the message of packed rows (`pack_points`): one unordered row of points, all of them finite."""
    fields = [
        types.point_field(name=name, offset=int(offset), datatype=_DATATYPES[kind.str[1:]], count=1)
        for name, (kind, offset, *_) in (table.dtype.fields or {}).items()
    ]
    stamp = types.time(sec=time_ns // NANOSECONDS, nanosec=time_ns % NANOSECONDS)
    return types.point_cloud2(
        header=types.header(stamp=stamp, frame_id=frame_id),
        height=1,
        width=len(table),
        fields=fields,
        is_bigendian=False,
        point_step=table.itemsize,
        row_step=table.itemsize * len(table),
        data=types.pack(table.tobytes()),
        is_dense=True,
    )


def unpack_points(message: Any) -> np.ndarray:
    """Return the points of a message as rows (N,) with its fields."""
    order = ">" if message.is_bigendian else "<"
    fields = [field for field in message.fields if field.count == 1]
    layout: Any = {
        "names": [field.name for field in fields],
        "formats": [order + _KINDS[field.datatype] for field in fields],
        "offsets": [field.offset for field in fields],
        "itemsize": message.point_step,
    }
    rows = np.frombuffer(bytes(message.data), np.uint8).reshape(message.height, message.row_step)
    return np.ascontiguousarray(rows[:, : message.width * message.point_step]).view(np.dtype(layout)).ravel()


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
            "micrometre: write HDF5, PLY or LAZ, or move the cloud"
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
    for number, (time, rows) in enumerate(_split_moments(cloud)):
        message = point_cloud2(table[rows], types, time_ns=time, frame_id=FRAME_ID)
        data = bytes(store.serialize_cdr(message, _POINT_CLOUD2))
        writer.add_message(channel_id=channel, log_time=time, publish_time=time, sequence=number, data=data)
    writer.finish()
    return content.getvalue()


def _split_moments(cloud: PointCloud) -> Iterator[tuple[int, np.ndarray]]:
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


_POSES = {
    "nav_msgs/msg/Odometry": lambda message: message.pose.pose,
    "geometry_msgs/msg/PoseStamped": lambda message: message.pose,
    "geometry_msgs/msg/PoseWithCovarianceStamped": lambda message: message.pose.pose,
    "geometry_msgs/msg/TransformStamped": lambda message: message.transform,
}
# By definition, a message without covariance has zeros.
_WITH_COVARIANCE = ("nav_msgs/msg/Odometry", "geometry_msgs/msg/PoseWithCovarianceStamped")
_TRANSFORMS = "tf2_msgs/msg/TFMessage"


def read_bag_poses(path: Path, wanted: str = "") -> tuple[np.ndarray, np.ndarray, np.ndarray | None]:
    """Read times (N,) in s of the messages' headers, and poses (N, 7): x, y, z in m and a quaternion x y z w.

    Also returns covariances (N, 6, 6) in m and rad about fixed axes if every message states one, else None.

    ``wanted`` is the topic of messages Odometry, PoseStamped, PoseWithCovarianceStamped or TransformStamped; or
    ``PARENT>CHILD`` for the transforms of frame CHILD in frame PARENT among all messages of type TFMessage. Optional if
    the bag has one such topic, or none and the transforms of one pair of frames.

    DescriptionError if the path is no bag, or lacks these poses; the message names those in it. SetupError without the
    library for bags.
    """
    with open_bag(path, error=DescriptionError) as bag:
        covariances: list[np.ndarray] = []
        topics = [each.topic for each in bag.connections if each.msgtype in _POSES]
        parent, is_transform, child = wanted.partition(">")
        if is_transform or not (topics or wanted):
            found = [*_read_transforms(bag)]
            pairs, pair = {each for each, _ in found}, (parent.strip(), child.strip())
            rows = [row for each, row in found if not is_transform or each == pair]
            if not rows or (len(pairs) > 1 and not is_transform):
                held = ", ".join(sorted(f"{above}>{below}" for above, below in pairs)) or "none"
                raise DescriptionError(
                    f"{path} has transforms {held}; found {len(rows)} of '{wanted}': name one of them"
                )
        else:
            topic = wanted or (topics[0] if len({*topics}) == 1 else "")
            if topic not in topics:
                raise DescriptionError(
                    f"{path} has the topics with poses {list_topics(bag, _POSES)}; found none called '{wanted}': name "
                    "one of them, or the frames of a transform as PARENT>CHILD"
                )
            rows = []
            for connection, message in read_messages(bag, lambda each: each.topic == topic):
                rows.append(_read_row(message.header.stamp, _POSES[connection.msgtype](message)))
                if connection.msgtype in _WITH_COVARIANCE:
                    covariances.append(np.array(message.pose.covariance, dtype=np.float64).reshape(6, 6))
        table, known = np.array(rows, dtype=np.float64).reshape(-1, 8), np.array(covariances)
        stated = len(known) == len(table) > 0 and bool((np.einsum("nii->ni", known) > 0).all())
        return table[:, 0], table[:, 1:], known if stated else None


@contextmanager
def open_bag(path: Path, *, error: type[Error]) -> Iterator[Any]:
    """Return a bag as a context; exceptions of the library are raised as an ``error`` that calls the file damaged.

    Raises SetupError if the library for bags is not installed.
    """
    highlevel, typesys = (
        optional_library(f"rosbags.{part}", needed_by="a ROS bag", extra="ros") for part in ("highlevel", "typesys")
    )
    if not path.is_dir():
        require_regular_file(path, error=error, called="bag")
    try:
        with highlevel.AnyReader([path], default_typestore=typesys.get_typestore(typesys.Stores.ROS2_HUMBLE)) as bag:
            yield bag
    except Error:
        raise
    except Exception as fault:
        # The library raises errors of file formats, compression, SQLite and the operating system.
        raise error(f"{path} is no ROS bag (.bag, .mcap, .db3 or a bag's folder), or damaged: {fault}") from fault


def list_topics(bag: Any, kinds: Container[str] | None = None) -> str:
    """Return the topics of a bag, or those with messages of some kinds, as text."""
    found = {each.topic: each.msgtype for each in bag.connections if kinds is None or each.msgtype in kinds}
    return ", ".join(f"{name} ({kind.split('/')[-1]})" for name, kind in sorted(found.items())) or "none"


def read_messages(bag: Any, chosen: Any) -> Any:
    """Iterate over the connection and the message of all messages whose connection is ``chosen``."""
    connections = [connection for connection in bag.connections if chosen(connection)]
    for connection, _, data in bag.messages(connections=connections) if connections else ():
        yield connection, bag.deserialize(data, connection.msgtype)


def _read_transforms(bag: Any) -> Any:
    """Iterate over the frames (parent, child) and the row of every transform of the bag."""
    for _, message in read_messages(bag, lambda connection: connection.msgtype == _TRANSFORMS):
        for each in message.transforms:
            frames = each.header.frame_id.lstrip("/"), each.child_frame_id.lstrip("/")
            yield frames, _read_row(each.header.stamp, each.transform)


def _read_row(stamp: Any, pose: Any) -> tuple[float, ...]:
    """Return time and pose of a message with position and orientation, or translation and rotation."""
    place, turn = (pose.position, pose.orientation) if hasattr(pose, "position") else (pose.translation, pose.rotation)
    return stamp.sec + 1e-9 * stamp.nanosec, place.x, place.y, place.z, turn.x, turn.y, turn.z, turn.w
