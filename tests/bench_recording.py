"""From a camera to the disk: a thousand full frames at 60 per second, none lost."""

import tempfile
import time
from pathlib import Path

import numpy as np

from uwlts.capture import CaptureHeader, CaptureWriter, Frame
from uwlts.hardware.replay import ReplayCamera
from uwlts.library import load_sensor

SHOWN, TAKEN, RATE_HZ = 50, 1000, 60.0


def recording() -> tuple[float, int]:
    """Frames per second that reach the disk of a camera that gives 60, and how many of 1000 were lost.

    The camera repeats a capture of frames with a stripe and noise; a real one loses what nobody fetches in time.
    """
    sensor = load_sensor("thesis")
    header = CaptureHeader(
        name="bench", sensor=sensor, medium_name="air", medium=sensor.medium("air"), stage_direction=(1, 0, 0),
        saturation_dn=255,
    )  # fmt: skip
    rng = np.random.default_rng(0)
    height, width = sensor.camera.height_px, sensor.camera.width_px
    rows = np.arange(height)[:, None]
    with tempfile.TemporaryDirectory() as folder:
        source, out = Path(folder) / "source.h5", Path(folder) / "out.h5"
        with CaptureWriter(source, header, dtype=np.uint8) as writer:
            for k in range(SHOWN):
                stripe = 150 * np.exp(-0.5 * ((rows - height / 2 - k) / 1.5) ** 2)
                image = np.clip(stripe + rng.normal(4, 1, (height, width)), 0, 255).astype(np.uint8)
                writer.append(Frame(image, float(k), True, 1.0, float(k)))
        with ReplayCamera(source, repeat=True) as camera, CaptureWriter(out, header, dtype=np.uint8) as writer:
            camera.configure(frame_rate_hz=RATE_HZ)
            camera.start(faults="skip")
            start = time.perf_counter()
            for k in range(TAKEN):
                frame = camera.grab(2.0)
                writer.append(Frame(frame.image, float(k), True, 1.0, frame.time_s))
            seconds = time.perf_counter() - start
            lost = camera.counts.dropped
    return TAKEN / seconds, lost
