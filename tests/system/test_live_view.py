"""The page of a growing recording: what is seen of each image, and the command that serves it."""

import signal
import socket
import subprocess
import sys
import threading
import time
import urllib.request
from pathlib import Path

import numpy as np
import pytest

from uwlts.hardware.live_view import images_of, look
from uwlts.model.sensor import Sensor
from uwlts.optics.nominal import nominal_calibration
from uwlts.storage.capture import Capture, CaptureHeader, CaptureWriter, Frame

ROOT = Path(__file__).resolve().parents[2]


def header(sensor: Sensor) -> CaptureHeader:
    return CaptureHeader(
        name="live",
        sensor=sensor,
        medium_name="water",
        medium=sensor.medium("water"),
        stage_direction=(1, 0, 0),
        saturation_dn=255,
    )


def stripe_image(sensor: Sensor, *, height_dn: float, row: float = 500.3) -> np.ndarray:
    rows = np.arange(sensor.camera.height_px)[:, None]
    noise = np.random.default_rng(0).normal(5, 1, (sensor.camera.height_px, sensor.camera.width_px))
    return np.clip(height_dn * np.exp(-0.5 * ((rows - row) / 1.6) ** 2) + noise, 0, 255).astype(np.uint8)


def write(path: Path, sensor: Sensor, images: list[tuple[np.ndarray, bool]]) -> None:
    with CaptureWriter(path, header(sensor), dtype=np.uint8) as writer:
        for k, (image, laser_on) in enumerate(images):
            writer.append(Frame(image, float(k), laser_on, 1.0, float(k)))


def test_an_image_shows_its_stripe_points_and_faults(thesis, tmp_path):
    dark = stripe_image(thesis, height_dn=0.0)
    images = [(stripe_image(thesis, height_dn=h), True) for h in (150.0, 12.0, 900.0)] + [(dark, True), (dark, False)]
    write(tmp_path / "live.h5", thesis, images)
    calibration = nominal_calibration(thesis, thesis.medium("water"))
    with Capture(tmp_path / "live.h5") as capture:
        good, faint, bright, empty, lamp = (look(capture, number, calibration) for number in range(5))
    assert good.found == good.lines == 1280 and good.remarks == ()
    # On a row near the image's middle the stripe lies near the stand-off, all along one depth.
    assert len(good.points_mm) == 1280 and np.abs(good.points_mm[:, 2]).max() < 20
    assert good.picture.ndim == 3 and (good.picture == (255, 60, 40)).all(axis=2).any()
    assert any("faint" in remark for remark in faint.remarks)
    assert any("saturated" in remark for remark in bright.remarks)
    assert any("hardly any stripe" in remark for remark in empty.remarks) and len(empty.points_mm) == 0
    assert not lamp.laser_on and lamp.lines == 0 and lamp.remarks == ()


def test_a_recording_is_followed_while_it_grows(thesis, tmp_path):
    path, image = tmp_path / "live.h5", stripe_image(thesis, height_dn=150.0)

    def record() -> None:
        time.sleep(0.3)
        with CaptureWriter(path, header(thesis), dtype=np.uint8) as writer:
            for k in range(6):
                writer.append(Frame(image, float(k), True, 1.0, float(k)))
                time.sleep(0.15)

    recorder = threading.Thread(target=record)
    recorder.start()
    shown, pauses = [], 0
    for seen in images_of(path, None):
        if seen is None:
            pauses += 1
            time.sleep(0.05)
        else:
            shown.append((seen.number, path.exists()))
    recorder.join()
    assert [number for number, _ in shown] == list(range(6))
    # The first images were seen before the file was finished.
    assert not shown[0][1] and pauses >= 2


def test_the_page_is_served_to_this_machine_until_it_is_closed(thesis, tmp_path):
    write(tmp_path / "live.h5", thesis, [(stripe_image(thesis, height_dn=150.0), True)])
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        port = free.getsockname()[1]
    watching = subprocess.Popen(
        [sys.executable, "-m", "uwlts.cli", "watch", str(tmp_path / "live.h5"), "--port", str(port)],
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
    )
    try:
        for line in watching.stdout:
            if "is finished with 1 images" in line:
                break
        else:
            pytest.fail(f"the command ended: {watching.stderr.read()}")
        with urllib.request.urlopen(f"http://127.0.0.1:{port}", timeout=10) as answer:
            assert answer.status == 200 and b"<html" in answer.read().lower()
        listening = Path("/proc/net/tcp").read_text().splitlines()[1:]
        ports = [
            row.split()[1] for row in listening if row.split()[3] == "0A" and row.split()[1].endswith(f"{port:04X}")
        ]
        assert ports and all(address.startswith("0100007F") for address in ports)
        watching.send_signal(signal.SIGINT)
        _, said = watching.communicate(timeout=20)
        assert watching.returncode == 0 and "Traceback" not in said
    finally:
        watching.kill()
        watching.wait()
