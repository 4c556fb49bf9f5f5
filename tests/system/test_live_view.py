"""A recording in progress: display of each image, and images that are read while it grows."""

import threading
import time
from pathlib import Path

import cv2
import numpy as np
import pytest

from uwlts.desk import recording_view
from uwlts.desk.recording_view import RecordingView, follow_frames
from uwlts.desk.shown_state import Board
from uwlts.errors import CaptureError
from uwlts.model.calibration import AnyCalibration
from uwlts.model.sensor import Sensor
from uwlts.optics.nominal import nominal_calibration
from uwlts.storage.capture import Capture, CaptureHeader, Frame, part_path
from uwlts.storage.capture_writer import CaptureWriter


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


def seen(path: Path, number: int, calibration: AnyCalibration | None) -> Board:
    """A board that shows one image of a recording."""
    board = Board("live")
    with Capture(path) as capture:
        RecordingView(board, capture.header, calibration).show(capture[number], number)
    return board


def warnings(board: Board) -> str:
    assert all(line.kind == "warning" for line in board.lines())
    return "; ".join(line.text for line in board.lines())


def test_an_image_shows_its_stripe_points_and_faults(thesis, tmp_path):
    dark = stripe_image(thesis, height_dn=0.0)
    images = [(stripe_image(thesis, height_dn=h), True) for h in (150.0, 12.0, 900.0)] + [(dark, True), (dark, False)]
    write(tmp_path / "live.h5", thesis, images)
    calibration = nominal_calibration(thesis, thesis.medium("water"))
    good, faint, bright, empty, lamp = (seen(tmp_path / "live.h5", number, calibration) for number in range(5))
    assert "image 1, laser" in good.picture.caption and "stripe on 1,280 of 1,280 profile lines" in good.picture.caption
    assert warnings(good) == "" and good.picture.saturated == 0.0
    # On a row near the image's middle the stripe is near the stand-off, at one depth.
    points = good.cloud.points()
    assert len(points) == 1280 and np.abs(points[:, 2]).max() < 20
    assert points[:, 3] == pytest.approx(150, abs=20)
    picture = cv2.imdecode(np.frombuffer(good.picture.jpeg, np.uint8), cv2.IMREAD_COLOR).astype(int)
    red = picture[..., 2] - picture[..., 0] > 50
    # Row 500 of 1024, shown at 1000 / 1280 of its size; a JPEG spreads colours over some rows and weakens them.
    assert picture.shape == (800, 1000, 3) and np.abs(np.flatnonzero(red.any(axis=1)) - 500.3 / 1.28).max() < 3
    assert red.any(axis=0).mean() > 0.99
    assert "image 2: faint" in warnings(faint)
    assert "image 3: saturated" in warnings(bright) and bright.picture.saturated > 0.9
    assert "image 4: faint" in warnings(empty) and "image 4: almost no stripe" in warnings(empty)
    assert empty.cloud.total == 0
    assert "lamp" in lamp.picture.caption and "stripe" not in lamp.picture.caption and warnings(lamp) == ""
    assert lamp.position_mm == 4.0 and lamp.cloud.total == 0


def test_a_warning_is_said_once_and_a_cloud_grows(thesis, tmp_path):
    image, faint = stripe_image(thesis, height_dn=150.0), stripe_image(thesis, height_dn=12.0)
    write(tmp_path / "live.h5", thesis, [(faint, True), (image, True), (faint, True), (image, True)])
    board = Board("live")
    with Capture(tmp_path / "live.h5") as capture:
        view = RecordingView(board, capture.header, nominal_calibration(thesis, thesis.medium("water")), name="wall.h5")
        totals = []
        for number in range(4):
            view.show(capture[number], number)
            totals.append(board.cloud.total)
    assert [line.text.split(":")[0] for line in board.lines()] == ["image 1"]
    assert np.diff([0, *totals])[[1, 3]].tolist() == [1280, 1280] and board.pictures == 4
    # The stage moves by 1 mm from image to image.
    last = board.cloud.points()[-1280:, 0] - board.cloud.points()[totals[0] : totals[0] + 1280, 0]
    np.testing.assert_allclose(last, 2.0, atol=0.01)
    # The next recording starts from the beginning.
    RecordingView(board, header(thesis), None)
    assert (board.cloud.total, board.cloud_name) == (0, "live")


def test_without_a_calibration_the_stripe_is_shown_and_no_cloud(thesis, tmp_path):
    write(tmp_path / "live.h5", thesis, [(stripe_image(thesis, height_dn=150.0), True)])
    board = seen(tmp_path / "live.h5", 0, None)
    assert "stripe on 1,280 of 1,280" in board.picture.caption and board.cloud.total == 0


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
    for following in follow_frames(path):
        if following is None:
            pauses += 1
            time.sleep(0.05)
        else:
            head, number, frame = following
            assert head.name == "live" and frame.stage_mm == number
            shown.append((number, path.exists()))
    recorder.join()
    assert [number for number, _ in shown] == list(range(6))
    # The first images were seen before the file was finished.
    assert not shown[0][1] and pauses >= 2


def test_a_damaged_file_is_no_recording_to_wait_for(tmp_path):
    (tmp_path / "live.h5").write_bytes(b"no capture")
    with pytest.raises(CaptureError):
        list(follow_frames(tmp_path / "live.h5"))


def test_a_recording_that_is_cut_off_is_not_waited_for(thesis, tmp_path, monkeypatch):
    monkeypatch.setattr(recording_view, "_DAMAGED_S", 0.3)
    write(tmp_path / "whole.h5", thesis, [(stripe_image(thesis, height_dn=150.0), True)])
    part_path(tmp_path / "a.h5").write_bytes((tmp_path / "whole.h5").read_bytes()[:5000])
    followed = follow_frames(tmp_path / "a.h5")
    assert next(followed) is None
    with pytest.raises(CaptureError, match="a.h5.part"):
        for _ in followed:
            time.sleep(0.05)
