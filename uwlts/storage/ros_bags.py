"""Poses in ROS recordings: bags of ROS 1 (.bag) and ROS 2 (.mcap, .db3, or their folder), without ROS installed."""

from __future__ import annotations

from collections.abc import Container, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np

from uwlts.errors import DescriptionError, Error
from uwlts.files.reading import require_regular_file
from uwlts.runtime.optional_library import optional_library

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

    Parameters
    ----------
    path : Path
        The bag.
    wanted : str
        Topic of messages Odometry, PoseStamped, PoseWithCovarianceStamped or TransformStamped; or ``PARENT>CHILD`` for
        the transforms of frame CHILD in frame PARENT among all messages of type TFMessage. Optional if the bag has one
        such topic, or none and the transforms of one pair of frames.

    Raises
    ------
    DescriptionError
        The path is not a bag, or the wanted poses are missing; the message names those in the bag.
    SetupError
        The library for bags is not installed.
    """
    with open_bag(path, error=DescriptionError) as bag:
        return _poses(bag, path, wanted)


@contextmanager
def open_bag(path: Path, *, error: type[Error]) -> Iterator[Any]:
    """Return a bag as a context; other exceptions than ``error`` are raised as one that calls the file damaged.

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
    except error:
        raise
    except Exception as fault:
        # The library raises errors of file formats, compression, SQLite and the operating system.
        raise error(f"{path} is no ROS bag (.bag, .mcap, .db3 or a bag's folder), or damaged: {fault}") from fault


def list_topics(bag: Any, kinds: Container[str] | None = None) -> str:
    """Return the topics of a bag, or those with messages of some kinds, as text."""
    found = {each.topic: each.msgtype for each in bag.connections if kinds is None or each.msgtype in kinds}
    return ", ".join(f"{name} ({kind.split('/')[-1]})" for name, kind in sorted(found.items())) or "none"


def _poses(bag: Any, path: Path, wanted: str) -> tuple[np.ndarray, np.ndarray, np.ndarray | None]:
    covariances: list[np.ndarray] = []
    topics = {connection.topic: connection.msgtype for connection in bag.connections if connection.msgtype in _POSES}
    parent, is_transform, child = wanted.partition(">")
    if is_transform or not (topics or wanted):
        rows = [row for pair, row in _transforms(bag) if not is_transform or pair == (parent.strip(), child.strip())]
        pairs = {pair for pair, _ in _transforms(bag)} if not (rows and is_transform) else {(parent, child)}
        if not rows or len(pairs) > 1:
            held = ", ".join(sorted(f"{above}>{below}" for above, below in pairs)) or "none"
            raise DescriptionError(f"{path} has transforms {held}; found {len(rows)} of '{wanted}': name one of them")
    else:
        topic = wanted or (next(iter(topics)) if len(topics) == 1 else "")
        if topic not in topics:
            raise DescriptionError(
                f"{path} has the topics with poses {list_topics(bag, _POSES)}; found none called '{wanted}': name one "
                "of them, or the frames of a transform as PARENT>CHILD"
            )
        rows = []
        for connection, message in read_messages(bag, lambda connection: connection.topic == topic):
            rows.append(_row(message.header.stamp, _POSES[connection.msgtype](message)))
            if connection.msgtype in _WITH_COVARIANCE:
                covariances.append(np.array(message.pose.covariance, dtype=np.float64).reshape(6, 6))
    table, known = np.array(rows, dtype=np.float64).reshape(-1, 8), np.array(covariances)
    stated = len(known) == len(table) > 0 and bool((np.einsum("nii->ni", known) > 0).all())
    return table[:, 0], table[:, 1:], known if stated else None


def read_messages(bag: Any, chosen: Any) -> Any:
    """Iterate over the connection and the message of all messages whose connection is ``chosen``."""
    connections = [connection for connection in bag.connections if chosen(connection)]
    for connection, _, data in bag.messages(connections=connections) if connections else ():
        yield connection, bag.deserialize(data, connection.msgtype)


def _transforms(bag: Any) -> Any:
    """Iterate over the frames (parent, child) and the row of every transform of the bag."""
    for _, message in read_messages(bag, lambda connection: connection.msgtype == _TRANSFORMS):
        for each in message.transforms:
            frames = each.header.frame_id.lstrip("/"), each.child_frame_id.lstrip("/")
            yield frames, _row(each.header.stamp, each.transform)


def _row(stamp: Any, pose: Any) -> tuple[float, ...]:
    """Return time and pose of a message with position and orientation, or translation and rotation."""
    place, turn = (pose.position, pose.orientation) if hasattr(pose, "position") else (pose.translation, pose.rotation)
    return stamp.sec + 1e-9 * stamp.nanosec, place.x, place.y, place.z, turn.x, turn.y, turn.z, turn.w
