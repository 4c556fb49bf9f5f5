"""Node of ROS 2 that records or plays scans, and publishes the points of each image as sensor_msgs/PointCloud2.

The libraries of ROS 2 are imported when the node starts.
"""

import sys
from array import array
from collections.abc import Callable
from contextlib import ExitStack
from importlib import import_module
from pathlib import Path
from typing import Any

from uwlts.desk.scan import ScanService
from uwlts.errors import Error, SetupError
from uwlts.hardware.grbl import GrblStage
from uwlts.hardware.scan_plan import ScanPlan, load_plan
from uwlts.hardware.scanning import open_camera
from uwlts.model.any_calibration import AnyCalibration
from uwlts.runtime.optional_library import pip_install
from uwlts.storage.calibration_file import resolve_calibration
from uwlts.storage.capture import CAPTURES
from uwlts.storage.cloud import PointCloud
from uwlts.storage.point_cloud2 import (
    FRAME_ID,
    NANOSECONDS,
    MessageTypes,
    covariance_columns_m2,
    pack_points,
    point_cloud2,
)

_QUEUED = 100  # messages that a slow subscriber may be behind: 10 s of a camera with 10 images a second
_WHEELS = ("ros-rclpy", "ros-rmw-fastrtps-cpp", "ros-sensor-msgs", "ros-std-srvs")
"""Wheels with ROS 2 for Python on Linux, from PyPI."""


class StampedClouds:
    """Messages of clouds whose times are those since the start of a scan.

    A message has the time of its image on the clock. The start of a scan on the clock follows from its first message.
    """

    def __init__(self, types: MessageTypes, now_ns: Callable[[], int], *, frame_id: str = FRAME_ID):
        self._types, self._now_ns, self._frame_id = types, now_ns, frame_id
        self._began_ns, self._scan = 0, -1

    def message(self, cloud: PointCloud, time_s: float, scan: int) -> Any:
        """Return the message of the cloud of an image, at its time in the scan with a number."""
        since_ns = round(time_s * NANOSECONDS)
        if scan != self._scan:
            self._began_ns, self._scan = self._now_ns() - since_ns, scan
        table = pack_points(cloud, covariance_columns_m2(cloud))
        return point_cloud2(table, self._types, time_ns=self._began_ns + since_ns, frame_id=self._frame_id)


def serve_ros(
    scans: str | Path | ScanPlan,
    *,
    calibration: AnyCalibration | str | Path,
    folder: str | Path = ".",
    camera: str | None = None,
    stage: str | None = None,
    home: bool = False,
    unlock: bool = False,
    frame_id: str = FRAME_ID,
) -> None:
    """Run a node of ROS 2 that records or plays scans and publishes their points; Ctrl-C ends it.

    The node ``uwlts`` publishes the points of each laser image on ``points`` (docs: ros). Its services ``~/start``,
    ``~/stop`` and ``~/laser_off`` are of the type std_srvs/Trigger.

    Parameters
    ----------
    scans : ScanPlan or path
        Plan (TOML) of scans to record, or capture to play, which another program may still be recording.
    calibration : Calibration, PolynomialCalibration or path
        Calibration of the sensor.
    folder : str or Path
        Folder of the captures, which are numbered.
    camera : str, optional
        As for `uwlts.scan`.
    stage : str, optional
        As for `uwlts.scan`.
    home : bool
        Home the stage first, before each scan for which it is locked.
    unlock : bool
        Accept the stage's position without homing.
    frame_id : str
        Frame of the points.

    Raises
    ------
    SetupError
        The libraries of ROS 2 are not installed.
    DescriptionError, CalibrationError, HardwareError
        The plan or the calibration cannot be read; camera and stage are not named, or cannot be opened.
    """
    rclpy, executors, sensor, std, builtin, services = _import_ros()
    known = resolve_calibration(calibration)
    played = not isinstance(scans, ScanPlan) and Path(scans).suffix in CAPTURES
    source = scans if isinstance(scans, ScanPlan) else Path(scans) if played else load_plan(Path(scans))
    with ExitStack() as stack:
        opened, moved = None, None
        if isinstance(source, ScanPlan):
            address, port = source.devices(camera=camera, stage=stage)
            moved, opened = stack.enter_context(GrblStage(port)), stack.enter_context(open_camera(address))
        rclpy.init()
        stack.callback(rclpy.try_shutdown)
        node = rclpy.create_node("uwlts")
        types = MessageTypes(
            sensor.PointCloud2, sensor.PointField, std.Header, builtin.Time, lambda data: array("B", data)
        )
        clouds = StampedClouds(types, lambda: node.get_clock().now().nanoseconds, frame_id=frame_id)
        publisher = node.create_publisher(sensor.PointCloud2, "points", _QUEUED)
        service = ScanService(
            source,
            known,
            lambda cloud, time_s: publisher.publish(clouds.message(cloud, time_s, service.scans)),
            folder=Path(folder),
            camera=opened,
            stage=moved,
            home=home,
            unlock=unlock,
            report=lambda line: node.get_logger().info(line),
        )
        stack.callback(service.close)
        for name in ("start", "stop", "laser_off"):
            node.create_service(services.Trigger, f"~/{name}", _answer(getattr(service, name)))
        node.get_logger().info("ready: start, stop and laser_off are services of the node")
        try:
            rclpy.spin(node)
        except executors.ExternalShutdownException as ended:
            raise KeyboardInterrupt from ended  # rclpy turns Ctrl-C into this


def _answer(work: Callable[[], str]) -> Callable[[Any, Any], Any]:
    """Return the callback of a service std_srvs/Trigger, whose response states an error as a failure."""

    def answer(_: Any, response: Any) -> Any:
        try:
            response.success, response.message = True, work()
        except Error as error:
            response.success, response.message = False, str(error)
        return response

    return answer


def _import_ros() -> tuple[Any, ...]:
    """Return rclpy, its executors, and the modules of the messages and of the service."""
    try:
        return (
            import_module("rclpy"),
            import_module("rclpy.executors"),
            import_module("sensor_msgs.msg"),
            import_module("std_msgs.msg"),
            import_module("builtin_interfaces.msg"),
            import_module("std_srvs.srv"),
        )
    except ImportError as error:
        raise SetupError(
            f"uwlts ros needs ROS 2 for Python, which cannot be imported ({error}): source an installation for "
            f"Python {sys.version_info.major}.{sys.version_info.minor} (source /opt/ros/DISTRIBUTION/setup.bash), or "
            f"install its wheels: {pip_install(_WHEELS)}"
        ) from error
