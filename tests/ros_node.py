"""Test of `uwlts ros` with ROS 2: the node in a process of its own, and a subscriber and client in this one.

`python -m tests.ros_node` needs rclpy, sensor_msgs and std_srvs, which the tests of pytest do not need. A replayed
camera and the twin's controller are the hardware. The exit status is 1 if a point is not that of the capture's cloud.
"""

import os
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from cyclopts import App

import uwlts
from tests.uwlts.desk.test_scan_service import plan_for, write_images
from tests.uwlts.joint_views import joint_calibration
from tests.uwlts.storage.test_point_cloud2 import rows
from twin.devices.grbl_controller import GrblController
from uwlts.model.library import load_sensor

IMAGES = 12
PATIENCE_S = 60.0


class Client:
    """Subscriber and client of the node, with ROS 2's own types."""

    def __init__(self) -> None:
        import rclpy
        from diagnostic_msgs.msg import DiagnosticArray
        from geometry_msgs.msg import PoseStamped
        from sensor_msgs.msg import PointCloud2
        from std_msgs.msg import String
        from std_srvs.srv import Trigger

        rclpy.init()
        self._rclpy, self._trigger = rclpy, Trigger
        self._node = rclpy.create_node("test")
        self.messages: list[Any] = []
        self._node.create_subscription(PointCloud2, "points", self.messages.append, 100)
        self.states: list[Any] = []
        self._node.create_subscription(DiagnosticArray, "/diagnostics", self.states.append, 100)
        self.advice: list[str] = []
        self._node.create_subscription(String, "next_pass", lambda message: self.advice.append(message.data), 100)
        pose, publisher = PoseStamped(), self._node.create_publisher(PoseStamped, "pose", 1)
        pose.pose.orientation.w = 1.0
        self._node.create_timer(0.1, lambda: publisher.publish(pose))

    def call(self, name: str) -> tuple[bool, str]:
        """Call a service of the node, and return success and message."""
        client = self._node.create_client(self._trigger, f"/uwlts/{name}")
        assert client.wait_for_service(PATIENCE_S), f"no service {name}"
        answer = client.call_async(self._trigger.Request())
        self.spin(answer.done)
        return answer.result().success, answer.result().message

    def spin(self, done: Callable[[], bool]) -> None:
        """Receive messages until something is done."""
        until_s = time.monotonic() + PATIENCE_S
        while not done():
            assert time.monotonic() < until_s, f"not done after {PATIENCE_S:g} s, {len(self.messages)} messages"
            self._rclpy.spin_once(self._node, timeout_sec=0.1)


def main() -> None:
    """Record a scan, compare its messages with its cloud, and end a second scan by switching the laser off."""
    folder, sensor = Path(tempfile.mkdtemp()), load_sensor("thesis")
    images = write_images(folder / "camera.h5", sensor, (True,) * 4 * IMAGES)
    joint_calibration(sensor).save(folder / "calibration.json")
    with GrblController(speed_up=20.0, boot_s=0.2, position_mm=30.0) as controller:
        plan_for(folder, controller, images, count=IMAGES)
        words = ["ros", "plan.toml", "--calibration", "calibration.json", "--home", "--frame-id", "tank"]
        words += ["--pose-std-mm", "0.05", "--pose-std-deg", "0.02"]
        node = subprocess.Popen([sys.executable, "-m", "uwlts", *words], cwd=folder, env=os.environ)
        try:
            client = Client()
            # The pose counts at the start of a scan.
            client.spin(partial(lambda since_s: time.monotonic() > since_s + 2.0, time.monotonic()))
            print("start:", client.call("start"))
            print("start again:", client.call("start"))
            client.spin(lambda: len(client.messages) == IMAGES)
            client.spin(lambda: (folder / "test-plate-001.h5").exists())
            client.spin(lambda: len(client.advice) == 1)
            print(client.advice[0])
            assert client.advice[0].startswith("100 mm along Y: +-")
            whole = uwlts.reconstruct(folder / "test-plate-001.h5", folder / "calibration.json")
            tables = [rows(message) for message in client.messages]
            points = np.concatenate([np.stack([table[axis] for axis in "xyz"], 1) for table in tables])
            print(f"{len(tables)} messages, {len(points)} points, fields {', '.join(tables[0].dtype.names or ())}")
            print(f"largest difference from the cloud: {1e3 * np.abs(points - 1e-3 * whole.points_mm).max():.6f} mm")
            stamps = [message.header.stamp.sec + 1e-9 * message.header.stamp.nanosec for message in client.messages]
            times = [float(table["time"][0]) for table in tables]
            off_s = np.ptp(np.array(stamps) - times)
            frame = client.messages[0].header.frame_id
            print(f"stamps less times of the images: constant within {off_s:.1e} s; frame {frame}")
            # The correction for brightness needs the neighbouring images, which a single one lacks: some micrometres.
            assert np.abs(points - 1e-3 * whole.points_mm).max() < 2e-5
            # Numbers of 64 bits for seconds since 1970 have steps of 2e-7 s.
            assert off_s < 1e-6
            client.spin(lambda: client.states[-1].status[0].message == "the next pass is advised")
            state = client.states[-1].status[0]
            found = {each.key: each.value for each in state.values}
            print(f"diagnostics: level {state.level!r}, {state.hardware_id}, {found}")
            assert found == {"laser images": str(IMAGES), "points": str(len(points))}
            print("start:", client.call("start"))
            client.spin(lambda: len(client.messages) > IMAGES)
            print("laser_off:", client.call("laser_off"), "laser on:", controller.state().laser_on)
            print("stop:", client.call("stop"))
            assert not controller.state().laser_on
        finally:
            node.send_signal(signal.SIGINT)
            print("exit code of the node:", node.wait(PATIENCE_S))


if __name__ == "__main__":
    App(help=__doc__, help_format="plaintext", default_command=main)()
