"""Scans on request: played from a capture, and recorded with a replayed camera and the twin's controller."""

import math
import threading
import time
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from unittest.mock import Mock

import numpy as np
import pytest

import uwlts
from tests.uwlts.joint_views import MEDIUM, joint_calibration
from tests.uwlts.recalibration.test_recalibration import SENSOR, SHIFTED, WATER, campaign, write_capture
from tests.waiting import within
from twin.devices.grbl_controller import GrblController
from uwlts.desk import scan
from uwlts.desk.scan import PassAdvice, ScanDevices, ScanService, ServiceState
from uwlts.errors import CalibrationError, DescriptionError, HardwareError
from uwlts.hardware.camera_interface import Delivered, ReplayCamera
from uwlts.hardware.grbl import GrblStage
from uwlts.hardware.scan_plan import ScanPlan, load_plan
from uwlts.model.calibration import Calibration
from uwlts.model.sensor import Sensor
from uwlts.recalibration.as_built import as_built
from uwlts.storage.capture import CaptureHeader, Frame
from uwlts.storage.capture_writer import CaptureWriter
from uwlts.storage.cloud import PointCloud

EVERY_S = 0.15
LASER_ON = (True, True, False, True)


@pytest.fixture(scope="module")
def calibration(thesis: Sensor) -> Calibration:
    return joint_calibration(thesis)


def write_images(path: Path, sensor: Sensor, laser_on: tuple[bool, ...], *, peak_dn: float = 150.0) -> Path:
    """Write a capture whose laser images show a stripe at different rows."""
    header = CaptureHeader(
        name="scan", sensor=sensor, medium_name="water", medium=MEDIUM, stage_direction=(1, 0, 0), saturation_dn=255
    )
    camera, rng = sensor.camera, np.random.default_rng(0)
    with CaptureWriter(path, header, dtype=np.uint8) as writer:
        for number, on in enumerate(laser_on):
            rows = np.arange(camera.height_px)[:, None] - (420.3 + 20 * number)
            image = rng.normal(5, 1, (camera.height_px, camera.width_px)) + peak_dn * on * np.exp(-0.2 * rows**2)
            writer.append(Frame(image.astype(np.uint8), 2.0 * number, on, 1.0, EVERY_S * number))
    return path


@pytest.fixture(scope="module")
def capture(thesis: Sensor, tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_images(tmp_path_factory.mktemp("captures") / "scan.h5", thesis, LASER_ON)


@pytest.fixture(scope="module")
def lit(thesis: Sensor, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Images that are replayed as those of the camera."""
    return write_images(tmp_path_factory.mktemp("captures") / "lit.h5", thesis, (True, True))


class LoopedReplay(ReplayCamera):
    """Replay that begins again after its last image."""

    def _trigger(self) -> None:
        self._shown %= 2
        super()._trigger()


def test_a_played_capture_gives_its_cloud_image_by_image_at_its_speed(capture: Path, calibration: Calibration):
    clouds: list[PointCloud] = []
    said: list[str] = []
    service = ScanService(capture, calibration, lambda cloud, _: clouds.append(cloud), report=said.append)
    begun_s = time.monotonic()
    assert service.start() == "playing scan.h5"
    with pytest.raises(HardwareError, match="a scan is running"):
        service.start()
    service.wait()
    assert service.state == ServiceState(said[-1], "ok", len(clouds), sum(map(len, clouds)))
    assert said == [f"played {capture}"] and time.monotonic() - begun_s > EVERY_S * (len(LASER_ON) - 1)
    whole = uwlts.reconstruct(capture, calibration)
    assert len(clouds) == sum(LASER_ON) and len(whole) > 1000
    for number, cloud in zip(np.flatnonzero(LASER_ON), clouds, strict=True):
        same = whole.select(whole.frame == number)
        assert (cloud.frame == number).all() and np.array_equal(cloud.line, same.line)
        np.testing.assert_allclose(cloud.points_mm, same.points_mm, atol=1e-9)
        np.testing.assert_array_equal(cloud.time_s, EVERY_S * number)
        # The noise of the stripe is estimated from one image instead of from all.
        ratio = np.trace(cloud.covariance_mm2, axis1=1, axis2=2) / np.trace(same.covariance_mm2, axis1=1, axis2=2)
        assert 0.5 < np.median(ratio) < 2


def test_playing_stops_on_request_and_switches_no_laser(capture: Path, calibration: Calibration):
    first = threading.Event()
    said: list[str] = []
    service = ScanService(capture, calibration, lambda *_: first.set(), report=said.append)
    for refused, words in ((service.stop, "no scan is running"), (service.laser_off, "no laser is connected")):
        with pytest.raises(HardwareError, match=words):
            refused()
    service.start()
    assert first.wait(20)
    assert service.stop() == "the scan ends after the present image"
    service.wait()
    assert said == ["stopped"]


@pytest.fixture
def controller() -> Iterator[GrblController]:
    with GrblController(speed_up=100.0, boot_s=0.2, position_mm=30.0) as running:
        yield running


def plan_for(folder: Path, controller: GrblController, capture: Path, *, count: int = 3) -> ScanPlan:
    (folder / "plan.toml").write_text(
        f'title = "Test plate"\nsensor = "thesis"\nmedium = "water"\ncamera = "replay:{capture}"\nlaser_ms = 1.0\n'
        f'[stage]\nport = "{controller.port}"\nstart_mm = 20.0\nstep_mm = 1.0\ncount = {count}\nsettle_s = 0.0\n'
        "feed_mm_per_min = 600.0\n",
        encoding="utf-8",
    )
    return load_plan(folder / "plan.toml")


def test_recorded_scans_are_files_and_clouds(tmp_path, lit, calibration, controller):
    plan, clouds, said = plan_for(tmp_path, controller, lit), [], []

    def publish(cloud: PointCloud, time_s: float) -> None:
        clouds.append(cloud)
        assert (cloud.time_s == time_s).all()

    with GrblStage(controller.port) as stage, LoopedReplay(lit) as camera:
        devices = ScanDevices(camera, stage, home=True)
        service = ScanService(plan, calibration, publish, folder=tmp_path, devices=devices, report=said.append)
        for number in (1, 2):
            assert service.start() == f"recording test-plate-00{number}.h5"
            service.wait()
            assert said[-1].startswith(f"wrote {tmp_path / f'test-plate-00{number}.h5'}"), said
        service.close()
    assert len(uwlts.read(tmp_path / "test-plate-002.h5")) == 3
    assert [cloud.frame[0] for cloud in clouds] == [0, 1, 2] * 2 and min(map(len, clouds)) > 1000
    times_s = [cloud.time_s[0] for cloud in clouds]
    assert times_s[0] < times_s[1] < times_s[2]


class ReplayThatSetsClocks(LoopedReplay):
    """Sets the computer's clock by an hour, forwards and back, and the camera's by a day, before each image."""

    set_s, stamp_s = 0, 0.0

    def _trigger(self) -> None:
        self.set_s = -3600 if self.set_s > 0 else 3600
        self.stamp_s += math.copysign(86400.0, self.set_s)
        super()._trigger()

    def _deliver(self, shown: int) -> Delivered:
        frame = super()._deliver(shown)
        assert frame.time_s is not None
        return replace(frame, time_s=frame.time_s + self.stamp_s)


def test_clocks_that_are_set_during_a_scan_change_neither_times_nor_places(
    tmp_path, lit, calibration, controller, monkeypatch
):
    plan, camera, clouds, said = plan_for(tmp_path, controller, lit, count=5), ReplayThatSetsClocks(lit), [], []
    for name, real, per_s in (("time", time.time, 1), ("time_ns", time.time_ns, 10**9)):
        monkeypatch.setattr(time, name, lambda real=real, per_s=per_s: real() + per_s * camera.set_s)
    with GrblStage(controller.port) as stage, camera:
        used = {"folder": tmp_path, "devices": ScanDevices(camera, stage, home=True)}
        service = ScanService(plan, calibration, lambda cloud, _: clouds.append(cloud), report=said.append, **used)
        begun_s = time.monotonic()
        service.start()
        service.wait()
        service.close()
    with uwlts.Capture(tmp_path / "test-plate-001.h5") as capture:
        assert len(capture) == len(clouds) == 5, said
        np.testing.assert_allclose(capture.stage_mm, 20.0 + np.arange(5), atol=0.011)
        times = capture.time_s
        assert (np.diff(times) > 0).all() and times[0] >= 0 and times[-1] < time.monotonic() - begun_s


def test_a_scan_with_doubts_is_a_warning_of_the_node(tmp_path, thesis, calibration, controller):
    faint = write_images(tmp_path / "faint.h5", thesis, (True, True), peak_dn=15.0)
    plan, said = plan_for(tmp_path, controller, faint), []
    with GrblStage(controller.port) as stage, LoopedReplay(faint) as camera:
        used = {"folder": tmp_path, "devices": ScanDevices(camera, stage, home=True)}
        service = ScanService(plan, calibration, Mock(), report=said.append, **used)
        service.start()
        service.wait()
    assert "3 laser images are faint" in service.state.message, said
    kinds = Mock()
    scan._diagnose(service.state, calibration, kinds, "now")
    stated = kinds.DiagnosticStatus.call_args.kwargs
    assert (stated["level"], stated["hardware_id"]) == (kinds.DiagnosticStatus.WARN, "thesis") and stated[
        "message"
    ] == said[-1]


def test_a_scan_without_a_pose_is_kept_but_gives_no_advice(tmp_path, lit, calibration, controller):
    said: list[str] = []
    advice = PassAdvice(calibration, pose_std_mm=0.01, pose_std_deg=0.005)
    plan = plan_for(tmp_path, controller, lit)
    with GrblStage(controller.port) as stage, LoopedReplay(lit) as camera:
        used = {"folder": tmp_path, "devices": ScanDevices(camera, stage, home=True)}
        service = ScanService(plan, calibration, Mock(), advice=advice, report=said.append, **used)
        service.start()
        service.wait()
    assert said[-2].startswith(f"wrote {tmp_path / 'test-plate-001.h5'}"), said
    assert said[-1].startswith("error: no pose of the sensor is known for test-plate-001.h5"), said


@pytest.mark.slow
def test_the_next_pass_is_advised_after_each_one(tmp_path):
    *_, problem = campaign(9, dict(list(SHIFTED.items())[1:]))
    advice, told = PassAdvice(as_built(SENSOR, WATER), pose_std_mm=0.01, pose_std_deg=0.005), []
    advice.publish = told.append
    for each, (*along, turn) in zip(problem.passes, list(SHIFTED.values())[1:], strict=True):
        write_capture(tmp_path / f"{each.name}.h5", each)
        place = SimpleNamespace(x=0.0, y=along[0] / 1000, z=along[1] / 1000)
        rotation = SimpleNamespace(x=0.0, y=0.0, z=np.sin(np.radians(turn) / 2), w=np.cos(np.radians(turn) / 2))
        scan._place(advice, SimpleNamespace(pose=SimpleNamespace(position=place, orientation=rotation)))
        advice.add(tmp_path / f"{each.name}.h5", advice.pose, Mock())
        # Its stripes are kept.
        (tmp_path / f"{each.name}.h5").unlink()
    stated = [float(line.split("+-")[1].removesuffix(" mm")) for text in told for line in text.splitlines()[:2]]
    assert max(stated[:2]) > 0.5 and max(stated[2:]) < 0.25, told
    assert all("next pass: " in text for text in told)


@pytest.mark.parametrize(
    ("stated", "words"),
    [({"pose_std_mm": 0.1}, "`pose_std_deg`"), ({"pose_std_mm": -0.1, "pose_std_deg": 0.1}, "positive")],
)
def test_advice_without_the_uncertainty_of_poses_is_refused_before_anything_opens(capture, calibration, stated, words):
    with pytest.raises(DescriptionError, match=words):
        scan.serve_ros(capture, calibration=calibration, **stated)


def test_the_laser_off_service_ends_a_scan_with_the_laser_off(tmp_path, lit, calibration, controller):
    said: list[str] = []
    begun = threading.Event()
    plan = plan_for(tmp_path, controller, lit, count=90)
    with GrblStage(controller.port) as stage, LoopedReplay(lit) as camera:
        stage.home()
        used = {"folder": tmp_path, "devices": ScanDevices(camera, stage)}
        service = ScanService(plan, calibration, lambda *_: begun.set(), report=said.append, **used)
        service.start()
        assert begun.wait(30), said
        assert service.laser_off().startswith("laser switched off")
        assert within(1.0, lambda: not controller.state().laser_on)
        service.wait()
        # Without `home` the next scan is refused.
        service.start()
        service.wait()
        assert said[-1].startswith("error: ") and "home" in said[-1]
        assert (service.state.message, service.state.level, service.state.images) == (said[-1], "error", 0)
        stage.unlock()


def test_a_calibration_of_another_sensor_is_refused_before_anything_moves(tmp_path, lit, calibration, controller):
    other = replace_size(calibration)
    plan = plan_for(tmp_path, controller, lit)
    service = ScanService(plan, other, lambda *_: None, folder=tmp_path)
    with pytest.raises(CalibrationError):
        service.start()
    assert not controller.state().laser_on and list(tmp_path.glob("*.h5*")) == []


def replace_size(calibration: Calibration) -> Calibration:
    camera = calibration.camera.model_copy(update={"width_px": calibration.camera.width_px // 2})
    return calibration.model_copy(update={"camera": camera})


def test_a_node_of_ros_that_is_interrupted_ends_as_interrupted(capture: Path, calibration: Calibration, monkeypatch):
    class Ended(Exception):
        pass

    def spin(_: object) -> None:
        raise Ended

    done: list[str] = []
    node = Mock()
    rclpy = SimpleNamespace(
        init=lambda: done.append("init"), try_shutdown=lambda: done.append("end"), spin=spin, create_node=lambda _: node
    )
    modules = rclpy, SimpleNamespace(ExternalShutdownException=Ended), *(Mock() for _ in range(7))
    monkeypatch.setattr(scan, "_import_ros", lambda: modules)
    with pytest.raises(KeyboardInterrupt):
        scan.serve_ros(capture, calibration=calibration)
    assert done == ["init", "end"]
