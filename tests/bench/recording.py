"""Recording from a camera to disk: a thousand full frames at 60 per second without losses, and followed live."""

import itertools
import multiprocessing
import multiprocessing.connection
import multiprocessing.synchronize
import tempfile
import time
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from twin.devices.gige_camera import ExposedFrame, GigeCamera
from uwlts.desk.recording_view import LOOK_S, RecordingView, follow_frames
from uwlts.desk.shown_state import Board
from uwlts.hardware.camera_interface import CameraDevice, CameraSettings, Delivered, ReplayCamera
from uwlts.hardware.scanning import open_camera
from uwlts.model.library import load_sensor
from uwlts.model.sensor import Sensor
from uwlts.optics.nominal import nominal_calibration
from uwlts.storage.capture import CaptureHeader, Frame
from uwlts.storage.capture_writer import CaptureWriter

SHOWN, TAKEN, RATE_HZ = 50, 1000, 60.0
BUFFERS = 32  # as in the library of cameras
# Through a cable of 1 Gbit/s, which takes 11 ms for a frame.
SERVED = 300


@dataclass(frozen=True)
class Recorded:
    """Frames per second written to disk, by a straight line through their times, and the number of lost frames.

    With the first and the last frame only, a first frame stored 10 ms late would raise 60 frames per second by 0.1.

    A second process read ``followed`` frames from the growing file and reconstructed them, at ``followed_hz`` from the
    first to the last. It finished ``behind_s`` after the recording.
    """

    rate_hz: float
    lost: int
    followed: int = 0
    followed_hz: float = 0.0
    behind_s: float = 0.0


class PacedReplay(ReplayCamera):
    """Replay without end at the rate `RATE_HZ`; images beyond the buffers of a camera are lost."""

    def _configure(self, wanted: CameraSettings) -> CameraSettings:
        self._began_s, self._due = time.monotonic(), 0
        return super()._configure(wanted)

    def _take_next(self, timeout_s: float) -> Delivered | None:
        self._due = max(self._due, int((time.monotonic() - self._began_s) * RATE_HZ) - BUFFERS)
        wait_s = self._began_s + self._due / RATE_HZ - time.monotonic()
        time.sleep(min(max(wait_s, 0.0), timeout_s))
        if wait_s > timeout_s:
            return None
        self._due += 1
        return replace(self._deliver(self._due % SHOWN), frame_id=self._due)


def recording(*, live: bool = False) -> Recorded:
    """Record from a camera with 60 frames per second, which repeats a capture of frames with a stripe and noise.

    Frames that are not fetched in time are lost, as with a real camera.
    """
    sensor = load_sensor("thesis")
    with tempfile.TemporaryDirectory() as folder:
        source, out = Path(folder) / "source.h5", Path(folder) / "out.h5"
        with CaptureWriter(source, _header(sensor), dtype=np.uint8) as writer:
            for k, image in enumerate(_images(sensor)):
                writer.append(Frame(image, float(k), True, 1.0, float(k)))
        with PacedReplay(source) as camera:
            if live:
                return _followed(out, lambda: _record(camera, sensor, out, TAKEN))
            return _record(camera, sensor, out, TAKEN)


def gige_recording() -> Recorded:
    """Record from a GigE Vision camera on the loopback interface that sends images at the speed of a 1 Gbit/s cable.

    It exposes at its frame rate, and images wait in its memory for the cable, as in a real camera.
    """
    sensor = load_sensor("thesis")
    images = itertools.cycle(_images(sensor))

    def expose() -> ExposedFrame:
        image = next(images)
        return ExposedFrame(time.monotonic(), None, lambda exposure_ms: image)

    with (
        tempfile.TemporaryDirectory() as folder,
        GigeCamera(lambda exposure_ms: next(images), expose=expose) as served,
        open_camera(served.address) as camera,
    ):
        return _record(camera, sensor, Path(folder) / "out.h5", SERVED)


def example_image() -> np.ndarray:
    """Return one of the recorded images (H, W)."""
    return _images(load_sensor("thesis"))[0]


def _images(sensor: Sensor) -> list[np.ndarray]:
    rng = np.random.default_rng(0)
    height, width = sensor.camera.height_px, sensor.camera.width_px
    rows = np.arange(height)[:, None]
    stripes = (150 * np.exp(-0.5 * ((rows - height / 2 - k) / 1.5) ** 2) for k in range(SHOWN))
    return [np.clip(stripe + rng.normal(4, 1, (height, width)), 0, 255).astype(np.uint8) for stripe in stripes]


def _header(sensor: Sensor) -> CaptureHeader:
    return CaptureHeader(
        name="bench",
        sensor=sensor,
        medium_name="air",
        medium=sensor.medium("air"),
        stage_direction=(1, 0, 0),
        saturation_dn=255,
    )


def _record(camera: CameraDevice, sensor: Sensor, out: Path, count: int) -> Recorded:
    with CaptureWriter(out, _header(sensor), dtype=np.uint8) as writer:
        camera.configure(frame_rate_hz=RATE_HZ)
        camera.start(faults="skip")
        stored_s = np.empty(count)
        for k in range(count):
            frame = camera.grab(2.0)
            writer.append(Frame(frame.image, float(k), True, 1.0, frame.time_s))
            stored_s[k] = time.perf_counter()
        counts = camera.counts
    return Recorded(float(1.0 / np.polyfit(np.arange(count), stored_s, 1)[0]), counts.dropped + counts.short)


def _followed(out: Path, record: Callable[[], Recorded]) -> Recorded:
    context = multiprocessing.get_context("spawn")
    ready, (ours, theirs) = context.Event(), context.Pipe()
    follower = context.Process(target=_follow, args=(out, ready, theirs))
    follower.start()
    ready.wait()
    recorded = record()
    start = time.perf_counter()
    followed, followed_hz = ours.recv()
    behind_s = time.perf_counter() - start
    follower.join()
    return Recorded(recorded.rate_hz, recorded.lost, followed, followed_hz, behind_s)


def _follow(out: Path, ready: multiprocessing.synchronize.Event, result: multiprocessing.connection.Connection) -> None:
    """Follow a recording and show its images on a board, without a browser."""
    sensor = load_sensor("thesis")
    calibration = nominal_calibration(sensor, sensor.medium("air"))
    moments: list[float] = []
    board, view = Board("bench"), None
    ready.set()
    for seen in follow_frames(out):
        if seen is None:
            time.sleep(LOOK_S)
            continue
        header, number, frame = seen
        view = view or RecordingView(board, header, calibration)
        before = board.cloud.total
        view.show(frame, number)
        if board.cloud.total > before:
            moments.append(time.perf_counter())
    result.send((len(moments), (len(moments) - 1) / (moments[-1] - moments[0])))


def following_rate() -> float:
    """Return frames per second that a follower shows, with stripe and points, without reading of files."""
    sensor = load_sensor("thesis")
    view = RecordingView(Board("bench"), _header(sensor), nominal_calibration(sensor, sensor.medium("air")))
    frames = [Frame(image, float(k), True, 1.0, float(k)) for k, image in enumerate(_images(sensor))]
    view.show(frames[0], 0)
    start = time.perf_counter()
    for number, frame in enumerate(frames):
        view.show(frame, number)
    return len(frames) / (time.perf_counter() - start)
