"""The served GigE Vision camera, read by the real driver over the loopback interface.

Both sides run Aravis in one process. If it is not installed, these tests fail and state how to install it.
"""

import threading
import time
from pathlib import Path

import numpy as np
import pytest

from twin.devices.gige_camera import PORT, ExposedFrame, GigeCamera
from uwlts.errors import HardwareError
from uwlts.hardware.aravis import list_aravis_cameras
from uwlts.hardware.camera_interface import FrameStatus
from uwlts.hardware.scanning import open_camera
from uwlts.model.sensor import Sensor
from uwlts.storage.capture import Capture, CaptureHeader, Frame
from uwlts.storage.capture_writer import CaptureWriter

WIDTH, HEIGHT = 1280, 1024
# Well above what a frame takes, about 10 ms, on a machine that is busy with other things.
WAIT_S = 3.0


class Scene:
    """Images that contain stage position and exposure in the corner, and noise elsewhere."""

    def __init__(self):
        self.stage_mm = 0
        self.seconds = 0.0
        self.calls = 0
        self._noise = np.random.default_rng(6).integers(0, 256, (HEIGHT, WIDTH), np.uint8)

    def frame(self, exposure_ms: float) -> np.ndarray:
        self.calls += 1
        image = self._noise.copy()
        image[0, :2] = self.stage_mm, round(exposure_ms)
        if self.seconds:
            time.sleep(self.seconds)
        return image


@pytest.fixture
def scene() -> Scene:
    return Scene()


@pytest.fixture
def served(scene):
    with GigeCamera(scene.frame) as camera:
        yield camera


@pytest.fixture
def camera(served):
    with open_camera(served.address) as opened:
        yield opened


def test_the_camera_says_who_it_is_and_what_it_set(camera):
    assert (camera.info.name, camera.info.serial, camera.info.bits) == ("UWLTS Twin", "1", 8)
    assert (camera.info.width_px, camera.info.height_px) == (WIDTH, HEIGHT)
    settings = camera.configure(exposure_ms=1.2344, frame_rate_hz=30)
    # The camera counts whole microseconds, of the exposure and of the period.
    assert settings.exposure_ms == pytest.approx(1.2344, abs=1e-3) and settings.exposure_ms != 1.2344
    assert settings.frame_rate_hz == pytest.approx(30, rel=1e-6 * 30)
    assert settings.gain_db is None
    assert camera.configure(exposure_ms=1e9).exposure_ms == pytest.approx(1e4)


def test_what_the_camera_cannot_do_is_an_error(camera):
    with pytest.raises(HardwareError, match="no setting for gain"):
        camera.configure(gain_db=6)
    with pytest.raises(HardwareError, match="does not offer Mono12, only .*Mono8"):
        camera.configure(bits=12)


def test_it_is_found_by_its_serial_number_and_identifier(served):
    assert "aravis:UWLTS-Twin-1 (GigEVision, 127.0.0.1)" in map(str, list_aravis_cameras())
    with open_camera("gige:1") as camera:
        assert camera.info.serial == "1"
    with pytest.raises(HardwareError, match=r"no camera is called 'U2'. Found:\n(.*\n)*  aravis:UWLTS-Twin-1"):
        open_camera("aravis:U2")


def test_it_listens_on_loopback_only(served):
    listening = [line.split()[1] for line in Path("/proc/net/udp").read_text().splitlines()[1:]]
    at_port = [address for address in listening if address.endswith(f":{PORT:04X}")]
    # 127.0.0.1, as the kernel writes it.
    assert at_port == [f"0100007F:{PORT:04X}"]


def test_only_one_program_and_one_camera(served, camera):
    with pytest.raises(HardwareError, match="used by another program"):
        open_camera(served.address)
    with pytest.raises(HardwareError, match="another camera is served"), GigeCamera(lambda exposure_ms: None):
        pass


def test_every_trigger_gives_one_frame_of_its_moment(scene, camera):
    camera.configure(exposure_ms=7.0, trigger="software")
    camera.start()
    noise = scene.frame(0.0)[1:]
    scene.calls = 0
    for position in range(1, 6):
        scene.stage_mm = position
        camera.trigger()
        # Visible only if the image were made later than the trigger's answer.
        frame = camera.grab(WAIT_S)
        scene.stage_mm = 99
        assert (frame.image[0, 0], frame.image[0, 1], frame.frame_id) == (position, 7, position)
        assert frame.image.dtype == np.uint8 and np.array_equal(frame.image[1:], noise)
        assert frame.exposure_ms == pytest.approx(7.0)
    assert scene.calls == 5
    with pytest.raises(HardwareError, match=r"did not answer a trigger within 0.2 s"):
        camera.grab(0.2)
    assert camera.counts.ok == 5 and camera.counts.unanswered == 1


def test_binning_is_switched_off(scene, camera, caplog):
    camera._call("set_integer", b"BinningHorizontal", 2)
    camera.configure(trigger="software")
    camera.start()
    camera.trigger()
    assert np.array_equal(camera.grab(WAIT_S).image[1:], scene.frame(0.0)[1:])
    assert "BinningHorizontal was 2 and is now 1" in caplog.text


def test_free_running_frames_follow_each_other_past_the_end_of_the_counter(scene):
    with GigeCamera(scene.frame) as served, open_camera(served.address) as camera:
        served._number = 2**16 - 11
        camera.configure(frame_rate_hz=50)
        # A busy machine may be late; that is not what is tested here.
        camera.start(faults="skip")
        frames = [camera.grab(WAIT_S) for _ in range(20)]
    assert [frame.frame_id for frame in frames] == [*range(2**16 - 10, 2**16), *range(1, 11)]
    assert camera.counts.dropped == camera.counts.short == camera.counts.duplicated == 0
    # At least one period separates the frames, apart from the camera's clock, which ticks in whole milliseconds.
    assert frames[-1].time_s - frames[0].time_s > 19 / 50 - 2e-3 - 0.1


def test_images_that_are_late_do_not_answer_a_trigger(scene):
    def image(exposure_ms: float) -> np.ndarray:
        time.sleep(0.2)
        return scene.frame(exposure_ms)

    slow = GigeCamera(scene.frame, expose=lambda: ExposedFrame(time.monotonic(), 0, image))
    with slow as served, open_camera(served.address) as camera:
        camera.configure(frame_rate_hz=50)
        camera.start(faults="skip")
        camera.grab(WAIT_S)
        camera.stop()
        # Some ten images wait to be made.
        camera.configure(trigger="software")
        camera.start(faults="skip")
        asked_s = time.monotonic()
        camera.trigger()
        assert camera.grab(WAIT_S).time_s >= asked_s - 2e-3


@pytest.mark.parametrize(
    ("inject", "status", "message"),
    [
        (lambda served: served.inject("drop", 2), "dropped", "preceded by dropped frames"),
        (lambda served: served.inject("repeat"), "duplicated", "it repeats the previous frame"),
        (lambda served: served.inject("cut"), "short", "incomplete: packets were lost"),
        (lambda served: served.inject("delay", delay_s=0.8), "late", "more than one frame period"),
    ],
)
def test_each_fault_of_a_free_running_camera_is_named(served, camera, inject, status, message):
    # Slow, so that a busy machine makes no frame late by half a period.
    camera.configure(frame_rate_hz=4)
    camera.start()
    # The library sends the first frame at once, and all others at multiples of the period.
    camera.grab(WAIT_S)
    camera.grab(WAIT_S)
    inject(served)
    with pytest.raises(HardwareError, match=message):
        for _ in range(5):
            camera.grab(WAIT_S)
    assert getattr(camera.counts, status) == (2 if status == "dropped" else 1)
    # It can continue.
    camera.stop()
    camera.start()
    camera.grab(WAIT_S)


def test_with_skip_faults_are_counted_and_unusable_frames_passed_over(served, camera):
    camera.configure(frame_rate_hz=4)
    camera.start(faults="skip")
    camera.grab(WAIT_S)
    served.inject("cut")
    frames = [camera.grab(WAIT_S) for _ in range(4)]
    assert camera.counts.short == 1 and all(frame.status is FrameStatus.OK for frame in frames)
    served.inject("drop")
    frames = [camera.grab(WAIT_S) for _ in range(4)]
    assert camera.counts.dropped == 1
    assert [frame.status for frame in frames].count(FrameStatus.DROPPED) == 1


@pytest.mark.parametrize("fault", ["drop", "cut", "repeat"])
def test_after_a_fault_the_next_trigger_gives_its_own_frame(scene, served, camera, fault):
    camera.configure(trigger="software")
    camera.start()
    camera.trigger()
    camera.grab(WAIT_S)
    served.inject(fault)
    scene.stage_mm = 1
    camera.trigger()
    with pytest.raises(HardwareError):
        camera.grab(0.5)
    scene.stage_mm = 2
    camera.trigger()
    assert camera.grab(WAIT_S).image[0, 0] == 2


@pytest.mark.parametrize("pause_s", [0.0, 0.6])
def test_the_frame_of_a_trigger_given_up_is_not_taken_for_the_next(scene, served, camera, pause_s):
    camera.configure(trigger="software")
    camera.start()
    scene.stage_mm = 1
    served.inject("delay", delay_s=0.6)
    camera.trigger()
    with pytest.raises(HardwareError, match="did not answer"):
        camera.grab(0.3)
    # The frame comes before the next trigger, or is still being made.
    time.sleep(pause_s)
    scene.stage_mm = 2
    camera.trigger()
    assert camera.grab(WAIT_S).image[0, 0] == 2
    with pytest.raises(HardwareError, match="did not answer"):
        camera.grab(0.5)


def test_commands_are_answered_while_an_image_is_made(scene, camera):
    camera.configure(trigger="software", exposure_ms=5.0)
    camera.start()
    # Longer than hosts wait for the answer to a command, 0.5 s.
    scene.seconds = 1.0
    camera.trigger()
    began = time.monotonic()
    camera._check_answer()
    assert time.monotonic() - began < 0.4
    assert camera.grab(WAIT_S).image[0, 1] == 5


def test_an_image_that_cannot_be_made_is_left_out_and_reported(served, scene, camera):
    camera.configure(trigger="software")
    camera.start()
    scene.frame = None
    served._frame = lambda exposure_ms: np.zeros((2, 2), np.uint8)
    camera.trigger()
    with pytest.raises(HardwareError, match="did not answer"):
        camera.grab(0.3)
    assert "the image is (2, 2)" in str(served.failure)


def test_a_camera_that_goes_away_is_reported_and_can_come_back(served):
    with open_camera(served.address) as camera:
        camera.configure(frame_rate_hz=10)
        camera.start()
        camera.grab(WAIT_S)
        served.disconnect()
        began = time.monotonic()
        with pytest.raises(HardwareError, match="failed at .* does not answer, check power and cable"):
            # One frame may still be on the way.
            for _ in range(2):
                camera.grab(0.3)
    # Aravis repeats a command 5 times, waiting 0.5 s for each; nothing else is waited for, not even on closing.
    assert time.monotonic() - began < 2 * 0.3 + 5 * 0.5 + WAIT_S
    served.connect()
    with open_camera(served.address) as camera:
        camera.configure(trigger="software")
        camera.start()
        camera.trigger()
        camera.grab(WAIT_S)


def test_ctrl_c_gets_through_while_waiting(camera):
    import _thread

    camera.configure(trigger="software")
    camera.start()
    began = time.monotonic()
    threading.Timer(0.3, _thread.interrupt_main).start()
    with pytest.raises(KeyboardInterrupt):
        camera.grab(20.0)
    assert time.monotonic() - began < 3


def test_frames_go_into_a_capture(tmp_path, scene, camera, thesis: Sensor):
    header = CaptureHeader(
        name="grabbed",
        sensor=thesis,
        medium_name="water",
        medium=thesis.medium("water"),
        stage_direction=(1.0, 0.0, 0.0),
        saturation_dn=255,
    )
    camera.configure(exposure_ms=3.0, trigger="software")
    camera.start()
    with CaptureWriter(tmp_path / "grabbed.h5", header, dtype=np.uint8) as writer:
        for position in range(3):
            scene.stage_mm = position
            camera.trigger()
            frame = camera.grab(WAIT_S)
            writer.append(Frame(frame.image, float(position), True, frame.exposure_ms, frame.time_s))
    with Capture(tmp_path / "grabbed.h5") as capture:
        assert [capture.image(k)[0, 0] for k in range(3)] == [0, 1, 2]
        assert (np.diff(capture.time_s) > 0).all()
