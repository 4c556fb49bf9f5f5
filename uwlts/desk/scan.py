"""Scans by a plan: a single one, or on request with the points of images.

The node of ROS 2 publishes these points as sensor_msgs/PointCloud2. Its libraries are imported when the node starts.
"""

import math
import sys
import threading
import time
from array import array
from collections.abc import Callable
from contextlib import ExitStack
from dataclasses import dataclass, replace
from functools import partial
from importlib import import_module
from itertools import count
from pathlib import Path
from typing import Any, Literal, NamedTuple

import numpy as np
from scipy.spatial.transform import Rotation

from uwlts.desk.recording_view import LOOK_S, BackgroundView, follow_frames
from uwlts.desk.shown_state import Ended, FrameProfile
from uwlts.errors import CalibrationError, DescriptionError, Error, HardwareError, SetupError
from uwlts.files.writing import refuse_unsuitable
from uwlts.hardware.camera_interface import CameraDevice
from uwlts.hardware.continuous import ScanListeners
from uwlts.hardware.grbl import GrblStage
from uwlts.hardware.scan_plan import ScanPlan, load_plan
from uwlts.hardware.scanning import ScanProgress, open_camera, record_scan
from uwlts.model.calibration import AnyCalibration, Calibration, rigid_transform
from uwlts.optics.fitness import check_fits
from uwlts.runtime.optional_library import pip_install
from uwlts.runtime.progress import ProgressListener, ignore_progress
from uwlts.storage.calibration_file import resolve_calibration
from uwlts.storage.capture import CAPTURES, CaptureHeader, Frame, open_capture, part_path
from uwlts.storage.cloud import PointCloud
from uwlts.storage.ros_messages import (
    FRAME_ID,
    NANOSECONDS,
    MessageTypes,
    covariance_columns_m2,
    pack_points,
    point_cloud2,
)
from uwlts.stripe import extract_stripe, warm_up


def scan(
    plan: str | Path | ScanPlan,
    out: str | Path,
    *,
    camera: str | None = None,
    stage: str | None = None,
    home: bool = False,
    unlock: bool = False,
    resume: bool = False,
    overwrite: bool = False,
    progress: ProgressListener = ignore_progress,
    report: Callable[[str], None] = lambda line: None,
    warn: Callable[[str], None] = lambda text: None,
) -> ScanProgress:
    """Record a scan with a camera and a stage into a capture.

    For each image: move, let the stage settle, switch the laser, take the image, and store it with the position read
    back. The plan is checked against travel and volume before anything moves. The laser goes off however the scan ends.
    An interrupted scan leaves its complete images in ``out.part``; ``resume`` continues with the exposures of the
    recorded images.

    Parameters
    ----------
    plan : ScanPlan or path of a TOML file
        TOML file with sensor, medium, positions, lights and exposures (docs: scan).
    out : str or Path
        Capture to write.
    camera : str, optional
        Address of the camera, instead of the plan's: gige:NAME or replay:PATH.
    stage : str, optional
        Serial port of the stage, instead of the plan's.
    home : bool
        Home the stage first.
    unlock : bool
        Accept the stage's position without homing.
    resume : bool
        Continue an interrupted scan; refused if the plan differs from that of the interrupted scan.
    overwrite : bool
        Replace an existing capture.
    progress : callable, optional
        Called with the number of finished images and the total.
    report, warn : callable, optional
        Called with lines of text about the scan, and with warnings.

    Returns
    -------
    ScanProgress
        Counts of profile lines and of faulty images, and the latest exposures.

    Raises
    ------
    DescriptionError
        Camera or stage are not named; sensor, medium, target or artefact are not valid.
    RangeError, DesignError
        The plan cannot be carried out; nothing has moved.
    HardwareError
        Camera, stage or laser fail, or the camera's image size differs from the sensor's description. Also raised at
        the end of a scan whose stage has lost steps: all images are in ``out.part``, and ``resume`` accepts them.
    OutputError
        The file exists, or cannot be written.
    """
    refuse_unsuitable(Path(out), overwrite=overwrite, endings=CAPTURES)
    plan, out = plan if isinstance(plan, ScanPlan) else load_plan(Path(plan)), Path(out)
    address, serial_port = plan.devices(camera=camera, stage=stage)
    with GrblStage(serial_port) as moved, open_camera(address) as opened:
        if home:
            report("homing")
            moved.home()
        elif unlock:
            moved.unlock()
        return record_scan(
            plan,
            out,
            camera=opened,
            stage=moved,
            resume=resume,
            overwrite=overwrite,
            listeners=ScanListeners(progress, report, warn),
        )


class PassAdvice:
    """The recorded scans as passes over one scene, with the sensor's poses, and the next pass that would help most.

    ``pose`` (4, 4), mm, is that of the sensor now. ``publish`` is called with uncertainties, advice and doubts as text.
    The standard uncertainties are those of each pose, as for `recalibrate`.
    """

    def __init__(self, calibration: AnyCalibration, *, pose_std_mm: float | None, pose_std_deg: float | None):
        from uwlts.calibration.joint.stored_estimate import require_joint
        from uwlts.recalibration.recalibrate import KnownPasses

        if not isinstance(calibration, Calibration):
            raise CalibrationError("advice on passes needs a joint calibration, not one by polynomials")
        require_joint(calibration)
        if not (pose_std_mm and pose_std_deg and pose_std_mm > 0 and pose_std_deg > 0):
            raise DescriptionError("advice on passes needs `pose_std_mm` and `pose_std_deg`, both positive")
        self._passes = KnownPasses(calibration, pose_std_mm=pose_std_mm, pose_std_deg=pose_std_deg)
        self.pose: np.ndarray | None = None
        self.publish: Callable[[str], None] = lambda text: None

    def add(self, path: Path, pose: np.ndarray | None, progress: ProgressListener) -> None:
        """Publish the advice after a further pass, recorded with the sensor at ``pose``."""
        if pose is None:
            raise HardwareError(f"no pose of the sensor is known for {path.name}, so that no next pass is advised")
        with open_capture(path) as capture:
            self._passes.add(capture, pose)
        progress(1, 2)
        found = self._passes.solve()
        lengths = [f"100 mm along {each.axis}: +-{each.after_mm:.3f} mm" for each in found.lengths]
        self.publish("\n".join([*lengths, *found.advice(), *found.doubts]))


class ScanDevices(NamedTuple):
    """Camera and stage of recorded scans.

    ``home`` homes the stage before a scan for which it is locked, ``unlock`` accepts its position.
    """

    camera: CameraDevice
    stage: GrblStage
    home: bool = False
    unlock: bool = False


@dataclass
class ServiceState:
    """State of a scan as text, ``level`` "ok", "warning" or "error", and laser images and points published."""

    message: str
    level: Literal["ok", "warning", "error"] = "ok"
    images: int = 0
    points: int = 0


class ScanService:
    """Scans on request, one at a time, each in a thread of its own: recorded by a plan, or played from a capture.

    `start`, `stop` and `laser_off` return at once, with a text for the caller; they raise Error if refused. ``publish``
    is called with the points of each laser image, and the time of the image in s since the start of the scan. A played
    capture may still be recorded by another program; it needs no ``devices``. ``advice`` is computed at the end of each
    recorded scan, as a part of it. ``scans`` is the number of scans begun, ``state`` that of the latest.
    """

    def __init__(
        self,
        source: ScanPlan | Path,
        calibration: AnyCalibration,
        publish: Callable[[PointCloud, float], None],
        *,
        folder: Path = Path(),
        devices: ScanDevices | None = None,
        advice: PassAdvice | None = None,
        report: Callable[[str], None] = lambda line: None,
    ):
        self._advice = advice
        self._source, self._calibration, self._publish, self._report = source, calibration, publish, report
        self._folder, self._devices = folder, devices
        self._stop, self._thread = threading.Event(), threading.Thread()
        self.scans, self.state = 0, ServiceState("ready")
        warm_up()

    def start(self) -> str:
        """Begin a scan; HardwareError if one is running, CalibrationError if the calibration is of another sensor."""
        if self._thread.is_alive():
            raise HardwareError("a scan is running: stop it first")
        if isinstance(self._source, Path):
            work, text = self._play, f"playing {self._source.name}"
        else:
            path = self._find_free_path(self._source.title)
            check_fits(self._source.header(path.stem), self._calibration, source=path.name)
            work, text = lambda: self._record(path), f"recording {path.name}"
        self._stop.clear()
        self.scans, self.state = self.scans + 1, ServiceState(text)
        self._thread = threading.Thread(target=self._run, args=(work,), name="scan", daemon=True)
        self._thread.start()
        return text

    def stop(self) -> str:
        """End the scan after the present image; HardwareError if none is running."""
        if not self._thread.is_alive():
            raise HardwareError("no scan is running")
        self._stop.set()
        return "the scan ends after the present image"

    def laser_off(self) -> str:
        """Switch the laser off at once, which ends a scan; HardwareError if that fails."""
        self._stop.set()
        if self._devices is None:
            raise HardwareError("no laser is connected: a capture is played")
        if not self._devices.stage.darken():
            raise HardwareError("the laser CANNOT be switched off: switch its power off before going near")
        return "laser switched off: the next start needs a stage that is homed, or unlocked if it stood still"

    def wait(self, timeout_s: float | None = None) -> None:
        """Wait for the end of the scan."""
        if self._thread.ident is not None:
            self._thread.join(timeout_s)

    def _run(self, work: Callable[[], str]) -> None:
        try:
            self._end(work(), self.state.level)
        except Ended:
            self._end("stopped", self.state.level)
        except Error as error:
            self._end(f"error: {error}", "error")

    def _end(self, message: str, level: Literal["ok", "warning", "error"]) -> None:
        self.state.message, self.state.level = message, level
        self._report(message)

    def _warn(self, text: str) -> None:
        self.state.level = "warning"
        self._report(f"warning: {text}")

    def _find_free_path(self, title: str) -> Path:
        name = "".join(sign if sign.isalnum() else "-" for sign in title.lower())
        paths = (self._folder / f"{name}-{number:03}.h5" for number in count(1))
        return next(path for path in paths if not (path.exists() or part_path(path).exists()))

    def _record(self, out: Path) -> str:
        plan, devices = self._source, self._devices
        if not isinstance(plan, ScanPlan) or devices is None:
            raise HardwareError("camera and stage are not connected")
        stage = devices.stage
        if not stage.position_known and devices.home:
            stage.home()
        elif not stage.position_known and devices.unlock:
            stage.unlock()
        header, pose = plan.header(out.stem), self._advice and self._advice.pose
        with BackgroundView(lambda frame, number: self._show(frame, number, header)) as shown:
            listeners = ScanListeners(
                report=self._report, warn=self._warn, between=self._end_if_stopped, recorded=shown.put
            )
            seen = record_scan(plan, out, camera=devices.camera, stage=stage, listeners=listeners)
        if warnings := seen.warnings():
            self.state.level = "warning"
        written = "; ".join([f"wrote {out}", *warnings])
        if self._advice is not None:
            self._report(written)
            self._advice.add(out, pose, lambda done, total, stage="": self._end_if_stopped())
            written = "the next pass is advised"
        return written

    def _play(self) -> str:
        """Publish the images of a capture at the speed of the recording, and new ones of a recording when they come."""
        path = Path(str(self._source))
        finished, ahead_s = path.is_file(), math.nan
        for seen in follow_frames(path):
            self._end_if_stopped()
            if seen is None:
                self._stop.wait(LOOK_S)
                continue
            header, number, frame = seen
            if math.isnan(ahead_s):
                ahead_s = time.monotonic() - frame.time_s
            if finished:
                self._stop.wait(max(ahead_s + frame.time_s - time.monotonic(), 0.0))
            self._show(frame, number, header)
        return f"played {path}"

    def _end_if_stopped(self) -> None:
        if self._stop.is_set():
            raise Ended

    def _show(self, frame: Frame, number: int, header: CaptureHeader) -> None:
        if not frame.laser_on:
            return
        stripe = extract_stripe(
            frame.image, stripe_along=header.sensor.camera.stripe_along, saturation=header.saturation_dn
        )
        if len(stripe.lines):
            cloud = FrameProfile(frame, stripe, header, self._calibration).measured()
            placed = {"frame": np.full(len(cloud), number), "time_s": np.full(len(cloud), frame.time_s)}
            self._publish(replace(cloud, **placed), frame.time_s)
        self.state.images, self.state.points = self.state.images + 1, self.state.points + len(stripe.lines)

    def close(self) -> None:
        """End the scan, and wait for its end."""
        self._stop.set()
        self.wait()


# --- node of ROS 2 ----------------------------------------------------------------------------------------------------


_STATE_S = 1.0  # between two messages of diagnostics, which ROS's aggregator calls stale after 5 s
_QUEUED = 100  # messages that a slow subscriber may be behind: 10 s of a camera with 10 images a second
_MODULES = ("rclpy", "rclpy.executors", "sensor_msgs.msg", "std_msgs.msg", "builtin_interfaces.msg", "std_srvs.srv")
_MODULES += ("geometry_msgs.msg", "diagnostic_msgs.msg", "rcl_interfaces.msg")
_WHEELS = ("ros-rclpy", "ros-rmw-fastrtps-cpp", "ros-sensor-msgs", "ros-std-srvs", "ros-diagnostic-msgs")
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
    pose_std_mm: float | None = None,
    pose_std_deg: float | None = None,
) -> None:
    """Run a node of ROS 2 that records or plays scans and publishes their points; Ctrl-C ends it.

    The node ``uwlts`` publishes the points of each laser image on ``points`` (docs: ros). Its services ``~/start``,
    ``~/stop`` and ``~/laser_off`` are of the type std_srvs/Trigger. Its state is on ``/diagnostics`` once a second.

    Parameters
    ----------
    scans : ScanPlan or path
        Plan (TOML) of scans to record, or capture to play, which another program may still be recording.
    calibration : Calibration, PolynomialCalibration or path
        Calibration of the sensor.
    folder : str or Path
        Folder of the captures, which are numbered.
    camera, stage : str, optional
        As for `uwlts.scan`.
    home : bool
        Home the stage first, before each scan for which it is locked.
    unlock : bool
        Accept the stage's position without homing.
    frame_id : str
        Frame of the points.
    pose_std_mm, pose_std_deg : float, optional
        Standard uncertainties of the sensor's poses, which another program publishes on ``pose``. The node then
        publishes on ``next_pass`` which further pass over the same scene would help most, as `uwlts.recalibrate`.

    Raises
    ------
    SetupError
        The libraries of ROS 2 are not installed.
    DescriptionError, CalibrationError, HardwareError
        The plan or the calibration cannot be read; camera and stage are not named, or cannot be opened.
    """
    known, advice = resolve_calibration(calibration), None
    if pose_std_mm is not None or pose_std_deg is not None:
        advice = PassAdvice(known, pose_std_mm=pose_std_mm, pose_std_deg=pose_std_deg)
    rclpy, executors, sensor, std, builtin, services, geometry, diagnostic, interfaces = _import_ros()
    played = not isinstance(scans, ScanPlan) and Path(scans).suffix in CAPTURES
    source = scans if isinstance(scans, ScanPlan) else Path(scans) if played else load_plan(Path(scans))
    with ExitStack() as stack:
        devices = None
        if isinstance(source, ScanPlan):
            address, port = source.devices(camera=camera, stage=stage)
            moved, opened = stack.enter_context(GrblStage(port)), stack.enter_context(open_camera(address))
            devices = ScanDevices(opened, moved, home, unlock)
        rclpy.init()
        stack.callback(rclpy.try_shutdown)
        node = rclpy.create_node("uwlts")
        types = MessageTypes(
            sensor.PointCloud2, sensor.PointField, std.Header, builtin.Time, lambda data: array("B", data)
        )
        clouds = StampedClouds(types, lambda: node.get_clock().now().nanoseconds, frame_id=frame_id)
        publisher = node.create_publisher(sensor.PointCloud2, "points", _QUEUED)
        if advice is not None:
            advised = node.create_publisher(std.String, "next_pass", _QUEUED)
            advice.publish = lambda text: advised.publish(std.String(data=text))
            node.create_subscription(geometry.PoseStamped, "pose", partial(_place, advice), _QUEUED)
        service = ScanService(
            source,
            known,
            lambda cloud, time_s: publisher.publish(clouds.message(cloud, time_s, service.scans)),
            folder=Path(folder),
            devices=devices,
            advice=advice,
            report=lambda line: node.get_logger().info(line),
        )
        stack.callback(service.close)
        for name in ("start", "stop", "laser_off"):
            node.create_service(services.Trigger, f"~/{name}", _answer(getattr(service, name)))
        fixed = interfaces.ParameterDescriptor(read_only=True)
        for name, value in {"scans": scans, "calibration": calibration, "folder": folder, "frame_id": frame_id}.items():
            node.declare_parameter(name, str(value), fixed)
        states = node.create_publisher(diagnostic.DiagnosticArray, "/diagnostics", _QUEUED)

        def diagnose() -> None:
            stamp = node.get_clock().now().to_msg()
            states.publish(_diagnose(service.state, known, diagnostic, stamp))

        node.create_timer(_STATE_S, diagnose)
        node.get_logger().info("ready: start, stop and laser_off are services of the node")
        try:
            rclpy.spin(node)
        except executors.ExternalShutdownException as ended:
            raise KeyboardInterrupt from ended  # rclpy turns Ctrl-C into this


def _diagnose(state: ServiceState, calibration: AnyCalibration, messages: Any, stamp: Any) -> Any:
    """Return the state of a scan as a DiagnosticArray."""
    kinds, array = messages.DiagnosticStatus, messages.DiagnosticArray()
    levels = {"ok": kinds.OK, "warning": kinds.WARN, "error": kinds.ERROR}
    array.header.stamp = stamp
    values = {"laser images": state.images, "points": state.points}
    array.status = [
        kinds(
            level=levels[state.level],
            name="uwlts: scan",
            message=state.message,
            hardware_id=calibration.sensor_name,
            values=[messages.KeyValue(key=key, value=str(value)) for key, value in values.items()],
        )
    ]
    return array


def _place(advice: PassAdvice, message: Any) -> None:
    """Take the pose of the sensor from a PoseStamped; one without a rotation is none."""
    at, turn = message.pose.position, message.pose.orientation
    quaternion = np.array([turn.x, turn.y, turn.z, turn.w])
    if quaternion.any():
        advice.pose = rigid_transform(Rotation.from_quat(quaternion).as_matrix(), 1e3 * np.array([at.x, at.y, at.z]))


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
    """Import `_MODULES`: rclpy, its executors, and messages and services."""
    try:
        return tuple(map(import_module, _MODULES))
    except ImportError as error:
        raise SetupError(
            f"uwlts ros needs ROS 2 for Python, which cannot be imported ({error}): source an installation for "
            f"Python {sys.version_info.major}.{sys.version_info.minor} (source /opt/ros/DISTRIBUTION/setup.bash), or "
            f"install its wheels: {pip_install(_WHEELS)}"
        ) from error
