"""Layout of a cloud as ROS 2's message sensor_msgs/PointCloud2, without ROS.

The types of the messages come from any library that has them. Lengths are in m (REP 103), points in the OCS: X is the
direction of the scan, Y is along the stripe, and Z points away from the sensor.
"""

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

from uwlts.storage.cloud import PAIRS, PointCloud

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


def packed_layout(table: np.ndarray) -> dict[str, tuple[np.dtype, int]]:
    """Return type and offset of each field of packed rows."""
    return {name: (entry[0], entry[1]) for name, entry in (table.dtype.fields or {}).items()}


def point_cloud2(table: np.ndarray, types: MessageTypes, *, time_ns: int, frame_id: str) -> Any:
    """Return the message of packed rows (`pack_points`): one unordered row of points, all of them finite."""
    fields = [
        types.point_field(name=name, offset=int(offset), datatype=_DATATYPES[kind.str[1:]], count=1)
        for name, (kind, offset) in packed_layout(table).items()
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
    packed = np.ascontiguousarray(rows[:, : message.width * message.point_step])
    return packed.view(np.dtype(layout)).ravel()
